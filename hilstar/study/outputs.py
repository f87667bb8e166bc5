"""The thesis's three published outputs (chapter 5): centroids, magnitudes, temperatures, and images without and with noise."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from hilstar.bench.bench_file import read_bench_file
from hilstar.charts import STYLE, save, write_csv
from hilstar.resources import resource_path
from hilstar.rotation import from_radec_roll_deg
from hilstar.twin.exposure_files import write_exposure_fits
from hilstar.twin.simulator import Exposure, FrameNoise, Simulator

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SEED = 1
ZOOM_PX = 160


@dataclass(frozen=True, slots=True)
class Scene:
    """One of the thesis's simulations: its bench, where it points, and the star in the middle of its zoom."""

    name: str
    title: str
    radec_roll_deg: tuple[float, float, float]
    zoom_hip: int


SCENES = (
    Scene("orion", "Orion, 25 degrees, zodiacal light (thesis figures 5.3 to 5.7)", (84.057, -1.200, 0.0), 26311),
    Scene("lyra", "Lyra, 10.8 degrees, 3000 e-/px of background (figures 5.8 to 5.12)", (283.021, 35.349, 0.0), 92420),
    Scene("rosetta", "zeta Cas, Rosetta NAVCAM, 28000 e-/px of stray light (figures 5.14 to 5.18)", (9.122, 53.817, 0.0), 2920),
)


def run(directory: Path) -> list[str]:
    """Write each scene's figure (PNG), noisy image (FITS) and truth (CSV); a line for each."""
    return [_draw_scene(directory, scene) for scene in SCENES]


def _draw_scene(directory: Path, scene: Scene) -> str:
    with Simulator(read_bench_file(resource_path("configs", f"thesis-{scene.name}.toml"))) as simulator:
        motion = simulator.motion(from_radec_roll_deg(*scene.radec_roll_deg), np.zeros(3))
        clean = simulator.expose(motion, None)
        noise = FrameNoise(seed=SEED)
        noisy = simulator.expose(motion, noise.rng())
        write_exposure_fits(directory / f"{scene.name}.fits", simulator, noisy, noise)
    truth = noisy.truth
    write_csv(directory / f"{scene.name}.csv", truth.dtype.names or (), truth.tolist())
    _figure(directory / f"{scene.name}.png", scene, clean, noisy)
    background = float(np.median(noisy.dn))
    v_mag, saturated = truth["v_mag"], int(truth["clipped"].sum())
    return (
        f"{scene.name}: {len(truth)} stars, V {v_mag.min():.2f} to {v_mag.max():.2f}, mean {v_mag.mean():.2f};"
        f" sky {background:.0f} DN, {saturated} stars saturated"
    )


def _figure(path: Path, scene: Scene, clean: Exposure, noisy: Exposure) -> None:
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(STYLE):
        figure = Figure(figsize=(17, 11), layout="constrained")
        grid = figure.subplots(2, 3)
        _star_plots(list(grid[0]), noisy.truth, noisy.dn.shape)
        _images(list(grid[1]), scene, clean, noisy)
        figure.suptitle(scene.title, fontsize=14)
        save(figure, path)


def _star_plots(axes: list[Axes], truth: npt.NDArray[np.void], shape: tuple[int, ...]) -> None:
    centroids, magnitudes, temperatures = axes
    height, width = shape
    centroids.plot(truth["x_px"], truth["y_px"], ".", ms=4)
    centroids.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal")
    centroids.set(xlabel="x [px]", ylabel="y [px]", title=f"centroids of {len(truth)} stars")
    number = np.arange(1, len(truth) + 1)
    for axis, column, label in ((magnitudes, "v_mag", "V [mag]"), (temperatures, "temperature_k", "temperature [K]")):
        axis.plot(number, truth[column], ".", ms=4)
        axis.axhline(truth[column].mean(), color="k", lw=1, label=f"mean {truth[column].mean():.4g}")
        axis.set(xlabel="star, brightest first", ylabel=label)
        axis.legend()
    magnitudes.set(title="apparent magnitudes")
    temperatures.set(title="black-body temperatures", yscale="log")


def _images(axes: list[Axes], scene: Scene, clean: Exposure, noisy: Exposure) -> None:
    star = noisy.truth[noisy.truth["hip"] == scene.zoom_hip]
    height, width = noisy.dn.shape
    x, y = (float(star["x_px"][0]), float(star["y_px"][0])) if len(star) else (width / 2, height / 2)
    low, high = np.percentile(noisy.dn, (1, 99.8))
    stretch: dict[str, Any] = {"cmap": "gray", "vmin": low, "vmax": high, "interpolation": "nearest"}
    titles = ("without noise", "with noise", f"with noise, around HIP {scene.zoom_hip}")
    for axis, exposure, title in zip(axes, (clean, noisy, noisy), titles, strict=True):
        image = axis.imshow(exposure.dn, **stretch)
        axis.grid(False)
        axis.set(xlabel="x [px]", ylabel="y [px]", title=title)
    axes[2].set(xlim=(x - ZOOM_PX / 2, x + ZOOM_PX / 2), ylim=(y + ZOOM_PX / 2, y - ZOOM_PX / 2))
    axes[2].figure.colorbar(image, ax=axes, label="DN", shrink=0.8)
