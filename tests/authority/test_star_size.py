"""How wide a star of the display is, against an integral written down here: sprite, monitor pixel,
lens, tracker pixel.

Along one axis a star in the middle of a monitor pixel gives monitor pixel k what its Gaussian has
between k - 1/2 and k + 1/2; that pixel is a square of even light, r tracker pixels wide; the lens
blurs it by a Gaussian; a tracker pixel sums it up. Each is an integral of the one before, taken
here on a fine grid. The figures of the two benches in words are those worked out that asked for
them, rounded: sigma 4.0 px against 0.55 and 3.9 mag; sigma 1.0 px and 1.1 mag.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.special import ndtr

from hilstar.server.bench.bench_file import bench_file_of, read_bench_file
from hilstar.server.bench.cameras import bench_camera
from hilstar.server.bench.star_size import star_size
from tests.support.benches import ROOT, bench_text
from tests.support.claims import holds

SPRITE_PX = 0.85
# of the grid: the midpoint rule is off by a 24th of its squared step times curvatures of under 10 /
# px^2
STEPS_A_PX = 200
GRID_ERROR = 1e-4
# `square_points` stands for the squares: Gaussians that ripple by 1e-3 (hilstar/optics/psf.py).
POINTS_ERROR = 2e-3
NEWCOMER = bench_text(
    {
        "tracker": {"focal_length_mm": 50, "pixel_pitch_um": 5.5, "resolution_px": [2048, 2048]},
        "monitor": {"resolution_px": [2560, 1440], "pixel_pitch_um": 233.1},
        "collimator": {"focal_length_mm": 500},
    }
)
README = (ROOT / "examples" / "bench.toml").read_text()
FINE = bench_text({"monitor": {"pixel_pitch_um": 10.0}, "tracker": {"psf_sigma_px": [1.2, 1.2]}})


def along_an_axis(
    ratio: float, lens_px: float, *, of_the_sky: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Places on the detector, px, and the density of a star's light there before the tracker's
    pixel.
    """
    reach_px = 6 * (lens_px + ratio * (0 if of_the_sky else 1.5)) + 1
    count = 2 * round(reach_px * STEPS_A_PX) + 1
    x_px = (np.arange(count) - count // 2) / STEPS_A_PX
    if of_the_sky:
        return x_px, np.exp(-0.5 * (x_px / lens_px) ** 2) / (lens_px * math.sqrt(2 * math.pi))
    density = np.zeros(count)
    for k in range(-6, 7):
        light = ndtr((k + 0.5) / SPRITE_PX) - ndtr((k - 0.5) / SPRITE_PX)
        left, right = (k - 0.5) * ratio, (k + 0.5) * ratio
        density += light / ratio * (ndtr((x_px - left) / lens_px) - ndtr((x_px - right) / lens_px))
    return x_px, density


def figures(ratio: float, lens_px: float, *, of_the_sky: bool) -> tuple[float, float, float]:
    """Sigma before the pixel, the brightest pixel's share, and over how many pixels the light is
    shared out.
    """
    x_px, density = along_an_axis(ratio, lens_px, of_the_sky=of_the_sky)
    total = density.sum()
    sigma = math.sqrt(float((density * x_px**2).sum() / total))
    shares = []
    for pixel in range(math.floor(x_px[0]) + 1, math.floor(x_px[-1])):
        # A grid point on the border between two pixels is half of either's.
        within = np.clip((0.5 - np.abs(x_px - pixel)) * STEPS_A_PX + 0.5, 0, 1)
        shares.append(float((density * within).sum() / total))
    along = np.array(shares)
    return sigma, float(along.max()) ** 2, 1 / float((along**2).sum()) ** 2


def found_of(text: str, folder):
    file = bench_file_of(folder / "bench.toml", text)
    camera = bench_camera(file.config, folder)
    return file.config, star_size(file.config, folder, camera), camera


# the benches of the table in docs/twin.md, and one with a wider star
BENCHES = {"newcomer": NEWCOMER, "readme": README, "fine": FINE}
TOLD = ("demo", "microdisplay", "monitor-10bit", "office-8bit")


@pytest.mark.parametrize("name", [*BENCHES, *TOLD])
def test_a_star_is_as_wide_as_the_integral_over_its_pixels_says(tmp_path, name):
    if name in TOLD:
        file = read_bench_file(ROOT / "configs" / f"{name}.toml")
        config, camera = file.config, bench_camera(file.config, file.folder)
        found = star_size(config, file.folder, camera)
    else:
        config, found, camera = found_of(BENCHES[name], tmp_path)
    lens_px = config.tracker.psf_sigma_px[0]
    tracker_px_a_rad = config.tracker.focal_length_mm * 1e3 / config.tracker.pixel_pitch_um
    ratio = tracker_px_a_rad / camera.focal_length_px
    sigma, peak, shared = figures(ratio, lens_px, of_the_sky=False)
    sky_sigma, sky_peak, sky_shared = figures(ratio, lens_px, of_the_sky=True)
    assert found.sigma_px == pytest.approx(sigma, rel=GRID_ERROR)
    assert found.sky_sigma_px == pytest.approx(sky_sigma, rel=GRID_ERROR)
    # A tracker's pixel adds the variance of a square of side 1.
    with_pixel = math.sqrt((sigma**2 + 1 / 12) / (sky_sigma**2 + 1 / 12))
    assert found.sigma_ratio == pytest.approx(with_pixel, rel=GRID_ERROR)
    assert found.peak_loss_mag == pytest.approx(
        -2.5 * math.log10(peak / sky_peak), abs=2.5 * POINTS_ERROR
    )
    assert found.shared_px == pytest.approx(shared, rel=5 * POINTS_ERROR)
    assert found.sky_shared_px == pytest.approx(sky_shared, rel=5 * POINTS_ERROR)
    if name in ("newcomer", *TOLD):
        holds(f"width-{name}", found.sigma_px)
        holds(f"width-{name}-ratio", found.sigma_ratio)
        holds(f"width-{name}-peak", found.peak_loss_mag)


def test_the_two_benches_have_the_figures_that_were_worked_out_by_hand(tmp_path):
    _, newcomer, _ = found_of(NEWCOMER, tmp_path)
    assert [round(newcomer.sigma_px, 1), newcomer.sky_sigma_px] == [4.0, 0.55]
    assert round(newcomer.peak_loss_mag, 1) == 3.9
    _, readme, _ = found_of(README, tmp_path)
    assert [round(readme.sigma_px, 1), round(readme.peak_loss_mag, 1)] == [1.0, 1.1]
