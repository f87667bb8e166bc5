"""The seven outputs of chapter 5: three plots of the stars, two images and a part of each.

Of the three simulations that the thesis has, as they were published and with their errors mended;
or of a bench, for the same three fields and any other.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from hilstar.basics.arrays import BoolArray, FloatArray
from hilstar.basics.charts import INK, MUTED, SMALL_PT, chart, write_csv
from hilstar.basics.resources import resource_path
from hilstar.basics.rotation import from_radec_roll_deg
from hilstar.instruments.simulate.pictures import write_exposure_fits
from hilstar.instruments.simulate.simulator import Exposure, FrameNoise, Simulator
from hilstar.instruments.study.fields import FIELDS, SkyField, fields_of
from hilstar.optics.camera import Camera
from hilstar.server.bench.bench_file import BenchFile, read_bench_file
from hilstar.tracker.settings import DetectorSettings

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SEED = 1
ZOOM_PX = 160  # side of the part that is shown
STRETCH_PERCENT = (1, 99.8)  # of the pixels below black, and below white
# From black to white, in sigmas of the sky's noise: at least, and at most where a body fills
# pixels.
MIN_SIGMAS, MAX_SIGMAS = 10.0, 300.0
HEIGHT_INCH = 8.4
PUBLISHED = "_as_published"
WITHOUT_NOISE = "_without_noise"
DECIMALS = {"mag": 2, "K": 0}  # of a mean
# The thesis's figures of each field.
FIGURES = {"orion": "5.3 to 5.7", "lyra": "5.8 to 5.12", "rosetta": "5.14 to 5.18"}


@dataclass(frozen=True, slots=True)
class OutputScene:
    """A field before a camera: the stem of its files, its title, and the star of its zoom (None:
    the brightest).
    """

    stem: str
    title: str
    field: SkyField
    zoom_hip: int | None = None


@dataclass(frozen=True, slots=True)
class Outputs:
    """A scene's exposures without and with noise, and its sky."""

    clean: Exposure
    noisy: Exposure
    inside: BoolArray  # (n,) whether the centre of a star of the truth table is on the image
    sky_e: float
    noise_e: float
    gain_e_per_dn: float
    camera_words: str

    @property
    def truth(self) -> npt.NDArray[np.void]:
        """The stars whose light falls on the image, brightest first."""
        return self.noisy.truth


def run(
    directory: Path,
    file: BenchFile | None = None,
    radec_roll_deg: tuple[float, float, float] | None = None,
) -> list[str]:
    """Write each scene's figure, images (FITS) and truth (CSV); a line for each. Raises
    InputError.
    """
    lines = []
    if file is not None:
        for field in fields_of(radec_roll_deg):
            title = f"{field.name}, {file.path.name}"
            scene = OutputScene(field.stem, title, field)
            lines.append(_output(directory, file, scene))
        return lines
    for name, scene in thesis_scenes():
        lines.append(_output(directory, thesis_bench(name), scene))
    return lines


def thesis_scenes() -> Iterator[tuple[str, OutputScene]]:
    """The thesis's fields, as published and mended, each with its bench file's name."""
    for field in FIELDS:
        figures = FIGURES[field.stem]
        published = f"{field.name} as published (thesis figures {figures})"
        mended = f"{field.name} with the thesis's errors mended"
        stem = field.stem + PUBLISHED
        yield (
            f"thesis-{field.stem}-as-published.toml",
            OutputScene(stem, published, field, field.zoom_hip),
        )
        yield (
            f"thesis-{field.stem}.toml",
            OutputScene(field.stem, mended, field, field.zoom_hip),
        )


def thesis_bench(name: str) -> BenchFile:
    """A bench file of the thesis's simulations."""
    return read_bench_file(resource_path("configs", name))


def output_files(fields: tuple[SkyField, ...]) -> list[str]:
    """The names of all files that `run` writes of a bench."""
    endings = (".png", ".svg", ".csv", ".fits", f"{WITHOUT_NOISE}.fits")
    names = []
    for field in fields:
        names += [field.stem + ending for ending in endings]
    return names


def thesis_total_e(detector: DetectorSettings, light_e: float, exposure_s: float) -> float:
    """The n_TOT of table 4.1 and eq. 4.14 as printed, whose PRNU and DSNU have no dimension."""
    fixed_e2 = light_e * detector.prnu + detector.dsnu_e_per_s * exposure_s
    dark_e = detector.dark_e_per_s * exposure_s
    readout_e2 = detector.adc_noise_e**2 + detector.read_noise_e**2
    return math.sqrt(light_e + dark_e + fixed_e2 + readout_e2)


def _output(directory: Path, file: BenchFile, scene: OutputScene) -> str:
    """Expose a scene and write its files; a line about it."""
    noise = FrameNoise(seed=SEED)
    with Simulator(file) as simulator:
        q_icrs_to_cam = from_radec_roll_deg(*scene.field.radec_roll_deg)
        view = simulator.view(q_icrs_to_cam, np.zeros(3))
        clean = simulator.expose(view, None)
        noisy = simulator.expose(view, noise.rng())
        exposure_s = simulator.config.tracker.exposure_s
        sky_e = float(np.median(clean.mean_e))
        sky_noise = simulator.detector.settings.noise(sky_e, exposure_s)
        noise_e = math.sqrt(sky_noise.total_e2)
        x_px = noisy.truth["x_px"]
        y_px = noisy.truth["y_px"]
        inside = simulator.camera.contains_px(x_px, y_px)
        camera_text = _camera_words(file, simulator.camera, sky_e, noise_e)
        gain = simulator.detector.settings.gain_e_per_dn
        outputs = Outputs(clean, noisy, inside, sky_e, noise_e, gain, camera_text)
        write_exposure_fits(directory / f"{scene.stem}.fits", simulator, noisy, noise)
        clean_path = directory / f"{scene.stem}{WITHOUT_NOISE}.fits"
        without_noise = FrameNoise("none", SEED)
        write_exposure_fits(clean_path, simulator, clean, without_noise)
    truth = outputs.truth
    names = truth.dtype.names or ()
    write_csv(directory / f"{scene.stem}.csv", names, truth.tolist())
    _figure(directory / scene.stem, scene, outputs)
    return f"{scene.stem}: {_scene_words(outputs)}"


def _scene_words(outputs: Outputs) -> str:
    """Stars, temperatures and sky of a scene in words."""
    level_dn = np.median(outputs.noisy.dn)
    sky = f"sky {level_dn:.0f} DN; n_TOT of a pixel of sky {outputs.noise_e:.0f} e-"
    truth = outputs.truth
    if not len(truth):
        return f"no star; {sky}"
    v_mag = truth["v_mag"]
    kelvin = truth["temperature_k"]
    off_image = ~outputs.inside
    beyond = int(off_image.sum())
    edge = ""
    if beyond:
        edge = f", {beyond} more whose light reaches the image"
    heat = heat_words(kelvin)
    if heat and beyond:
        mean_k = np.nanmean(kelvin[outputs.inside])
        heat += f" ({mean_k:.0f} K on the image)"
    on_image = int(outputs.inside.sum())
    stars = f"{on_image} stars{edge}"
    extent = f"V {v_mag.min():.2f} to {v_mag.max():.2f}, mean {v_mag.mean():.2f}"
    saturated = int(truth["clipped"].sum())
    return f"{stars}, {extent}{heat}; {saturated} stars saturated; {sky}"


def heat_words(kelvin: FloatArray) -> str:
    """The hottest and the mean of temperatures (n,), in words; empty where none is known."""
    if not np.isfinite(kelvin).any():
        return ""
    hottest_k = np.nanmax(kelvin)
    mean_k = np.nanmean(kelvin)
    return f"; hottest {hottest_k:.0f} K, mean {mean_k:.0f} K"


def _camera_words(file: BenchFile, camera: Camera, sky_e: float, noise_e: float) -> str:
    tracker = file.config.tracker
    width_deg, height_deg = _field_deg(camera)
    lines = [
        f"Aperture {tracker.aperture_mm:g} mm",
        f"Focal length {tracker.focal_length_mm:g} mm",
        f"Field {width_deg:.3g} x {height_deg:.3g}°",
        f"Exposure {tracker.exposure_s:g} s",
        f"Gain {tracker.detector.gain_e_per_dn:g} e-/DN",
        f"Sky {sky_e:.0f} e-/px",
        f"Its noise {noise_e:.0f} e-",
    ]
    return "\n".join(lines)


def _field_deg(camera: Camera) -> tuple[float, float]:
    """The angles across the middle of the image, and down it."""
    width, height = camera.resolution_px
    middle_x = np.full(2, width / 2 - 0.5)
    middle_y = np.full(2, height / 2 - 0.5)
    ends_x = np.array([-0.5, width - 0.5])
    across = camera.rays(ends_x, middle_y)
    ends_y = np.array([-0.5, height - 0.5])
    down = camera.rays(middle_x, ends_y)
    return _angle_deg(across), _angle_deg(down)


def _angle_deg(rays: FloatArray) -> float:
    length = np.linalg.norm(rays, axis=1, keepdims=True)
    first, last = rays / length
    cosine = float(np.clip(first @ last, -1, 1))
    return math.degrees(math.acos(cosine))


def _figure(path: Path, scene: OutputScene, outputs: Outputs) -> None:
    """The seven outputs of a scene."""
    saturated = int(outputs.truth["clipped"].sum()) or "none"
    stars = int(outputs.inside.sum())
    heat = heat_words(outputs.truth["temperature_k"])
    finding = f"{scene.title}: {stars} stars, {saturated} saturated{heat}"
    note = (
        "Stars count from the brightest; lines: means of all whose light reaches the image. One"
        " stretch for all images."
    )
    with chart(path, finding, 3, 3, note=note, share_x=False, height_inch=HEIGHT_INCH) as panels:
        centroids, magnitudes, temperatures = panels[:3]
        _draw_centroids(centroids, outputs)
        _draw_property(magnitudes, outputs.truth["v_mag"], "V", "mag")
        _draw_property(temperatures, outputs.truth["temperature_k"], "T", "K")
        temperatures.set_yscale("log")
        _draw_images(panels[3:], scene, outputs)


def _draw_centroids(axes: "Axes", outputs: Outputs) -> None:
    height, width = outputs.noisy.dn.shape
    stars = outputs.truth[outputs.inside]
    axes.plot(stars["x_px"], stars["y_px"], ".", color=INK, ms=3)
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal")
    axes.set(xlabel="x [px]", ylabel="y [px]", title="Centroids")


def _draw_property(axes: "Axes", values: FloatArray, name: str, unit: str) -> None:
    known = np.isfinite(values)
    title = f"{name}, no star"
    if known.any():
        mean = float(values[known].mean())
        decimals = DECIMALS[unit]
        title = f"{name}, mean {mean:.{decimals}f} {unit}"
        numbers = np.arange(1, len(values) + 1)
        axes.plot(numbers, values, ".", color=INK, ms=3)
        axes.axhline(mean, color=MUTED, lw=1)
    axes.set(xlabel="star", title=title, ylabel=f"{name} [{unit}]")


def _draw_images(panels: "list[Axes]", scene: OutputScene, outputs: Outputs) -> None:
    """The images without and with noise, each with its zoom, and beside them scale and camera."""
    star, (x_px, y_px) = _zoom(scene, outputs)
    low, high = stretch_dn(outputs.noisy.dn, outputs.noise_e, outputs.gain_e_per_dn)
    images = (outputs.clean, outputs.clean, outputs.noisy, outputs.noisy)
    titles = ("Without noise", f"The same, {star}", "With noise", f"The same, {star}")
    drawn = [panels[0], panels[1], panels[3], panels[4]]
    for axes, exposure, title in zip(drawn, images, titles, strict=True):
        image = axes.imshow(exposure.dn, cmap="gray", vmin=low, vmax=high, interpolation="nearest")
        axes.grid(False)
        axes.set(xlabel="x [px]", ylabel="y [px]", title=title)
    half = ZOOM_PX / 2
    for zoomed in (drawn[1], drawn[3]):
        zoomed.set(xlim=(x_px - half, x_px + half), ylim=(y_px + half, y_px - half))
    facts = panels[2]
    scale = panels[5]
    facts.text(0, 1, outputs.camera_words, va="top", transform=facts.transAxes, fontsize=SMALL_PT)
    for axes in (facts, scale):
        axes.axis("off")
    scale.figure.colorbar(
        image, ax=scale, label="Signal [DN]", orientation="horizontal", location="top", fraction=0.5
    )


def stretch_dn(
    noisy_dn: npt.NDArray[Any], noise_e: float, gain_e_per_dn: float
) -> tuple[float, float]:
    """The DN that are black and white in all images: by the noisy one's pixels, within limits by
    the sky's noise.
    """
    low, high = np.percentile(noisy_dn, STRETCH_PERCENT).tolist()
    noise_dn = max(noise_e / gain_e_per_dn, 0.1)
    lowest = low + MIN_SIGMAS * noise_dn
    highest = low + MAX_SIGMAS * noise_dn
    return low, float(np.clip(high, lowest, highest))


def _zoom(scene: OutputScene, outputs: Outputs) -> tuple[str, tuple[float, float]]:
    """The name and place of the star in a zoom's middle; without one the image's middle."""
    stars = outputs.truth[outputs.inside]
    if scene.zoom_hip is not None:
        stars = stars[stars["hip"] == scene.zoom_hip]
    if not len(stars):
        height, width = outputs.noisy.dn.shape
        middle_px = ((width - 1) / 2, (height - 1) / 2)
        return "the middle", middle_px
    star = stars[0]
    if star["hip"] > 0:
        name = f"HIP {star['hip']}"
    else:
        name = str(star["name"])
    place_px = (float(star["x_px"]), float(star["y_px"]))
    return name, place_px
