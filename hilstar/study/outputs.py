"""The thesis's three published outputs (chapter 5): centroids, magnitudes, temperatures, and images without and with noise."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hilstar.bench.bench_file import read_bench_file
from hilstar.charts import INK, MUTED, chart, write_csv
from hilstar.resources import resource_path
from hilstar.rotation import from_radec_roll_deg
from hilstar.tracker.settings import DetectorSettings
from hilstar.twin.pictures import write_exposure_fits
from hilstar.twin.simulator import Exposure, FrameNoise, Simulator

SEED = 1
ZOOM_PX = 160


@dataclass(frozen=True, slots=True)
class OutputScene:
    """One of the thesis's simulations: its bench, where it points, and the star in the middle of its zoom."""

    name: str
    title: str
    radec_roll_deg: tuple[float, float, float]
    zoom_hip: int


SCENES = (
    OutputScene("orion", "Orion, 25 degrees, zodiacal light (thesis figures 5.3 to 5.7)", (84.057, -1.200, 0.0), 26311),
    OutputScene("lyra", "Lyra, 10.8 degrees, 3000 e-/px of background (figures 5.8 to 5.12)", (283.021, 35.349, 0.0), 92420),
    OutputScene(
        "rosetta", "zeta Cas, Rosetta NAVCAM, 28000 e-/px of stray light (figures 5.14 to 5.18)", (9.122, 53.817, 0.0), 2920
    ),
)


def run(directory: Path) -> list[str]:
    """Write each scene's figure, noisy image (FITS) and truth (CSV); a line for each."""
    lines, noise = [], FrameNoise(seed=SEED)
    for scene in SCENES:
        with Simulator(read_bench_file(resource_path("configs", f"thesis-{scene.name}.toml"))) as simulator:
            view = simulator.view(from_radec_roll_deg(*scene.radec_roll_deg), np.zeros(3))
            clean, noisy = simulator.expose(view, None), simulator.expose(view, noise.rng())
            sky_e, exposure_s = float(np.median(clean.mean_e)), simulator.config.tracker.exposure_s
            total_e = math.sqrt(simulator.detector.settings.noise(sky_e, exposure_s).total_e2)
            thesis_e = thesis_total_e(simulator.detector.settings, sky_e, exposure_s)
            write_exposure_fits(directory / f"{scene.name}.fits", simulator, noisy, noise)
        truth = noisy.truth
        write_csv(directory / f"{scene.name}.csv", truth.dtype.names or (), truth.tolist())
        _figure(directory / scene.name, scene, clean, noisy)
        v_mag, saturated = truth["v_mag"], int(truth["clipped"].sum())
        lines.append(
            f"{scene.name}: {len(truth)} stars, V {v_mag.min():.2f} to {v_mag.max():.2f}, mean {v_mag.mean():.2f};"
            f" sky {np.median(noisy.dn):.0f} DN, {saturated} stars saturated; n_TOT of a pixel of sky {total_e:.0f} e-"
            f" (table 4.1: {thesis_e:.0f})"
        )
    return lines


def thesis_total_e(detector: DetectorSettings, light_e: float, exposure_s: float) -> float:
    """The n_TOT of the thesis's table 4.1 and eq. 4.14 as printed, with the roots of PRNU and DSNU that have no dimension."""
    fixed_e2 = light_e * detector.prnu + detector.dsnu_e_per_s * exposure_s
    return math.sqrt(
        light_e + detector.dark_e_per_s * exposure_s + fixed_e2 + detector.adc_noise_e**2 + detector.read_noise_e**2
    )


def _figure(path: Path, scene: OutputScene, clean: Exposure, noisy: Exposure) -> None:
    truth, saturated, (height, width) = noisy.truth, int(noisy.truth["clipped"].sum()), noisy.dn.shape
    finding = f"{scene.title}: {len(truth)} stars to V = {truth['v_mag'].max():.1f}, {saturated or 'none'} saturated"
    note = "Stars are counted with the brightest first; lines: means. All three images have one stretch."
    with chart(path, finding, 2, 3, note=note, share_x=False, height_inch=6.4) as (
        centroids,
        magnitudes,
        temperatures,
        *images,
    ):
        centroids.plot(truth["x_px"], truth["y_px"], ".", color=INK, ms=3)
        centroids.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal")
        centroids.set(xlabel="x [px]", ylabel="y [px]", title="Centroids")
        number = np.arange(1, len(truth) + 1)
        for axes, column, label, unit in (
            (magnitudes, "v_mag", "V", "mag"),
            (temperatures, "temperature_k", "Black-body temperature", "K"),
        ):
            mean = float(truth[column].mean())
            axes.plot(number, truth[column], ".", color=INK, ms=3)
            axes.axhline(mean, color=MUTED, lw=1)
            axes.set(xlabel="star", title=f"{label}, mean {mean:.4g} {unit}", ylabel=f"{label} [{unit}]")
        temperatures.set(yscale="log", title=f"T, mean {truth['temperature_k'].mean():.0f} K")
        low, high = np.percentile(noisy.dn, (1, 99.8))
        titles = ("Without noise", "With noise", f"The same, HIP {scene.zoom_hip}")
        for axes, exposure, title in zip(images, (clean, noisy, noisy), titles, strict=True):
            image = axes.imshow(exposure.dn, cmap="gray", vmin=low, vmax=high, interpolation="nearest")
            axes.grid(False)
            axes.set(xlabel="x [px]", title=title)
        images[0].set_ylabel("y [px]")
        star = truth[truth["hip"] == scene.zoom_hip]
        x, y = (float(star["x_px"][0]), float(star["y_px"][0])) if len(star) else (width / 2, height / 2)
        images[2].set(xlim=(x - ZOOM_PX / 2, x + ZOOM_PX / 2), ylim=(y + ZOOM_PX / 2, y - ZOOM_PX / 2))
        images[2].figure.colorbar(image, ax=images, label="Signal [DN]", orientation="horizontal", shrink=0.6, aspect=40)
