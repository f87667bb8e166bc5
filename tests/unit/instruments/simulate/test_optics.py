"""The monitor's light through both lenses, against NumPy."""

from __future__ import annotations

import math
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import ndtr

from hilstar.basics.rotation import to_matrix
from hilstar.display.geometry import monitor_camera
from hilstar.display.panel import Panel
from hilstar.display.response import gamma_response, table_response
from hilstar.instruments.simulate import bench_geometry
from hilstar.instruments.simulate import optics as twin_optics
from hilstar.instruments.simulate.bench_geometry import BenchGeometry
from hilstar.instruments.simulate.optics import TwinOptics
from hilstar.instruments.verify.measure import on_screen_median
from hilstar.optics.camera import Lens, bounded
from hilstar.optics.psf import GaussianPsf, SampledPsf
from tests.support.psfs import gaussian, sampled

TRACKER_PX = (60, 50)
PSF_PX = (0.55, 0.6)
SIDE = 24  # squares along a monitor pixel in the oracle
# Each of a pixel's nine sprites is cut at 1e-6 of its light, and summed in float32, 6e-8 a sum.
CUT = 2e-6
# Nine Gaussians for a square have its variance and not its fourth moment: measured 1.3e-4 of the
# brightest pixel.
NINE_FOR_A_SQUARE = 2e-4
# Newton's method inverts a lens to 1e-8 px of its own image; a monitor pixel is about a tracker
# pixel.
INVERSE_PX = 1e-7
MARGIN_PX = 6.0
MAX_PEAK = 5.0  # memory over that of one coordinate: two results and a block of a dozen arrays


@pytest.fixture
def geometry():
    """A monitor of 0.9 tracker pixels a pixel, turned by 7 degrees and tilted by 0.2 and 0.1."""
    tracker = monitor_camera(TRACKER_PX, 13.0, 25.0, np.array([1.0, 0.0, 0.0, 0.0]))
    angles = np.radians([0.2, -0.1, 7.0]) / 2
    monitor = monitor_camera(
        (64, 48), 57.65, 120.0, np.array([1.0, *angles]) / math.hypot(1.0, *angles), (30.0, 25.0)
    )
    return BenchGeometry(monitor, tracker)


def oracle(geometry: BenchGeometry, light: np.ndarray) -> np.ndarray:
    """The tracker's image by NumPy alone: SIDE^2 points a lit pixel, each a Gaussian integrated
    over every tracker pixel.
    """
    image = np.zeros(TRACKER_PX[::-1])
    steps = (np.arange(SIDE) + 0.5) / SIDE - 0.5
    turn = matrix_of(geometry)
    for row, column in zip(*np.nonzero(light), strict=True):
        x, y = (part.ravel() for part in np.meshgrid(column + steps, row + steps))
        cx, cy = geometry.monitor.principal_point_px
        f_mon, f_trk = 120e3 / 57.65, 25e3 / 13.0
        ray = np.stack([(x - cx) / f_mon, (y - cy) / f_mon, np.ones_like(x)]).T @ turn
        at_x, at_y = (f_trk * ray[:, k] / ray[:, 2] + (TRACKER_PX[k] - 1) / 2 for k in (0, 1))
        shares = []
        for place, size, sigma in (
            (at_x, TRACKER_PX[0], PSF_PX[0]),
            (at_y, TRACKER_PX[1], PSF_PX[1]),
        ):
            edges = np.arange(size + 1) - 0.5 - place[:, None]
            shares.append(np.diff(ndtr(edges / sigma), axis=1))
        image += light[row, column] / SIDE**2 * shares[1].T @ shares[0]
    return image


def matrix_of(geometry: BenchGeometry) -> np.ndarray:
    angles = np.radians([0.2, -0.1, 7.0]) / 2
    matrix = to_matrix(np.array([1.0, *angles]) / math.hypot(1.0, *angles))
    assert np.allclose(matrix, geometry.monitor.cam_to_image)
    return matrix


def test_the_monitor_s_light_is_an_independent_sum_of_squares_through_both_lenses(geometry, rng):
    light = np.zeros((48, 64))
    light[14:34, 20:44] = rng.uniform(0, 1e6, (20, 24)) * (rng.random((20, 24)) < 0.1)
    with TwinOptics(geometry, GaussianPsf(PSF_PX)) as optics:
        image = optics.image_e_per_s(light)
    wanted = oracle(geometry, light)
    assert wanted.sum() == pytest.approx(light.sum(), rel=1e-9)
    assert image.sum() == pytest.approx(light.sum(), rel=CUT)
    assert np.abs(image - wanted).max() < NINE_FOR_A_SQUARE * wanted.max()


def test_a_psf_of_samples_shows_the_monitor_as_its_gaussian_does(geometry, rng):
    light = np.zeros((48, 64))
    light[14:34, 20:44] = rng.uniform(0, 1e6, (20, 24)) * (rng.random((20, 24)) < 0.1)
    images = []
    for psf in (GaussianPsf(PSF_PX), SampledPsf(sampled(gaussian(*PSF_PX), 5, 5), 5)):
        with TwinOptics(geometry, psf) as optics:
            images.append(optics.image_e_per_s(light))
    assert images[1].sum() == pytest.approx(light.sum(), rel=1e-6)
    assert np.abs(images[1] - images[0]).max() < 2e-4 * images[0].max()  # the table's step


def test_a_monitor_pixel_is_seen_where_its_direction_is_whatever_the_lenses_do(geometry, rng):
    """Distortion and a tilted screen on both sides; the way back is the inverse."""
    collimator = Lens(radial=(0.3, -0.1, 0.0), tangential=(2e-3, -1e-3), tilt_rad=(0.01, -0.02))
    monitor = bounded(replace(geometry.monitor, lens=collimator), MARGIN_PX)
    tracker = bounded(replace(geometry.tracker, lens=Lens(radial=(-0.2, 0.0, 0.0))), MARGIN_PX)
    bent = BenchGeometry(monitor, tracker)
    direction = np.column_stack([rng.uniform(-8e-3, 8e-3, (50, 2)), np.ones(50)])
    shown = monitor.project(direction @ monitor.cam_to_image.T)
    seen = bent.to_tracker(*shown)
    assert np.allclose(seen, tracker.project(direction @ tracker.cam_to_image.T), atol=INVERSE_PX)
    assert np.abs(np.array(seen) - geometry.to_tracker(*shown)).max() > 100 * INVERSE_PX
    assert np.allclose(bent.to_monitor(*seen), shown, atol=INVERSE_PX)


def test_the_places_of_a_large_detector_are_found_in_blocks(geometry, monkeypatch):
    """All pixels of 2048 x 2048 at once took 0.5 GB of intermediate values, and a session 2.6."""
    monkeypatch.setattr(bench_geometry, "PIXELS_AT_ONCE", 10_000)
    y_px, x_px = np.mgrid[0:300, 0:400].reshape(2, -1).astype(np.float64)
    tracemalloc.start()
    try:
        found = geometry.to_monitor(x_px, y_px)
        _, peak_bytes = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    # The two results, and the intermediate values of one block in twelve.
    assert peak_bytes < MAX_PEAK * x_px.nbytes
    assert np.array_equal(found, geometry._to_monitor(x_px, y_px), equal_nan=True)


@pytest.mark.parametrize("mirror", ["none", "x", "y", "swap"])
def test_a_mirror_is_about_the_middle_of_the_screen_and_its_own_inverse(geometry, mirror):
    bent = replace(geometry, mirror=mirror)
    middle = np.array([31.5]), np.array([23.5])
    assert np.allclose(bent.to_tracker(*middle), geometry.to_tracker(*middle))
    right = bent.to_tracker(middle[0] + 5, middle[1])
    steps = {"none": (5, 0), "x": (-5, 0), "y": (5, 0), "swap": (0, 5)}
    dx, dy = steps[mirror]
    assert np.allclose(right, geometry.to_tracker(middle[0] + dx, middle[1] + dy))


def test_the_glow_of_a_small_screen_is_not_diluted_by_the_detector_around_it(geometry):
    small = replace(
        geometry, monitor=monitor_camera((16, 12), 57.65, 120.0, np.array([1.0, 0.0, 0.0, 0.0]))
    )
    black = table_response(8, gamma_response(8).light, black=1e-3)
    with TwinOptics(small, GaussianPsf(PSF_PX)) as optics:
        glow = optics.glow_e_per_s(Panel(black, 1e6))
    scale = (57.65e-3 / 120) / (13e-3 / 25)
    assert np.median(glow) == 0
    assert on_screen_median(glow) == pytest.approx(1e3 / scale**2, rel=1e-4)
    # Its edge is cut at whole pixels: at most one along each of four sides.
    wide, high = 16 * scale, 12 * scale
    assert glow.sum() == pytest.approx(16 * 12 * 1e3, rel=1 / wide + 1 / high)
    assert on_screen_median(np.zeros((3, 3))) == 0


@pytest.mark.parametrize("turn_deg", [0.0, 30.0, 80.0, -150.0])
def test_a_glow_is_as_dense_however_the_screen_is_turned(geometry, turn_deg):
    """Of pixels that are wider than high in neither: as many a square pixel as the scale says."""
    half = math.radians(turn_deg) / 2
    q_turned = np.array([math.cos(half), 0.0, 0.0, math.sin(half)])
    turned = replace(geometry, monitor=monitor_camera((160, 160), 57.65, 120.0, q_turned))
    black = table_response(8, gamma_response(8).light, black=1e-3)
    with TwinOptics(turned, GaussianPsf(PSF_PX)) as optics:
        glow = optics.glow_e_per_s(Panel(black, 1e6))
    scale = (57.65e-3 / 120) / (13e-3 / 25)
    assert glow == pytest.approx(1e3 / scale**2, rel=1e-9)


def test_a_glow_is_as_uneven_as_the_panel_at_the_pixel_that_is_seen(geometry, rng):
    """A screen of 28 x 32 px, each of which is two of the tracker's: beside it there is no light, and
    below it there is no detector.
    """
    screen = monitor_camera((28, 32), 124.8, 120.0, np.array([1.0, 0.0, 0.0, 0.0]))
    uneven = rng.uniform(0.5, 1.0, (32, 28))
    black = table_response(8, gamma_response(8).light, black=1e-3)
    with TwinOptics(replace(geometry, monitor=screen), GaussianPsf(PSF_PX)) as optics:
        glow = optics.glow_e_per_s(Panel(black, 1e6, uniformity=uneven))
    column = np.floor((np.arange(60) - 29.5) / 2 + 14).astype(int)
    row = np.floor((np.arange(50) - 24.5) / 2 + 16).astype(int)
    is_seen = (column >= 0) & (column < 28)
    assert is_seen.sum() == 56
    assert glow[:, is_seen] == pytest.approx(1e3 / 4 * uneven[row[:, None], column[is_seen]])
    assert not glow[:, ~is_seen].any()


def test_a_glow_beyond_a_lens_is_nothing_and_never_nan(geometry):
    """A tracker that sees far past a screen, whose lens is known as far as its corners."""
    small = monitor_camera((16, 12), 57.65, 120.0, np.array([1.0, 0.0, 0.0, 0.0]))
    bent = replace(
        geometry, monitor=bounded(replace(small, lens=Lens(radial=(0.3, 0.0, 0.0))), 0.0)
    )
    black = table_response(8, gamma_response(8).light, black=1e-3)
    with TwinOptics(bent, GaussianPsf(PSF_PX)) as optics:
        glow = optics.glow_e_per_s(Panel(black, 1e6))
    assert np.isfinite(glow).all()
    assert (glow > 0).sum() > 100
    assert np.median(glow) == 0


def test_a_glow_is_the_same_in_bands_of_rows(geometry, monkeypatch):
    """A detector of 4096 x 4096 px would take 2.7 GB at once."""
    panel = Panel(table_response(8, gamma_response(8).light, black=1e-3), 1e6)
    with TwinOptics(geometry, GaussianPsf(PSF_PX)) as optics:
        whole = optics.glow_e_per_s(panel)
        monkeypatch.setattr(twin_optics, "PIXELS_AT_ONCE", 7 * TRACKER_PX[0])
        bands = optics.glow_e_per_s(panel)
    assert np.array_equal(bands, whole)


@pytest.mark.parametrize("beside_px", [(-4.0, 25.0), (63.0, 25.0), (30.0, -4.0), (30.0, 53.0)])
def test_what_a_wide_pixel_beside_the_detector_lights_of_it_is_there(geometry, beside_px):
    """A monitor pixel of 9 tracker pixels whose middle is about 4 px off one of the detector's sides,
    against the integral over its square.
    """
    upright = np.array([1.0, 0.0, 0.0, 0.0])
    screen = monitor_camera((64, 48), 576.5, 120.0, upright, (31.5, 23.0))
    wide = replace(geometry, monitor=screen)
    x_px, y_px = (part.ravel() for part in np.meshgrid(np.arange(64.0), np.arange(48.0)))
    seen_x, seen_y = wide.to_tracker(x_px, y_px)
    beside = int(np.argmin(np.hypot(seen_x - beside_px[0], seen_y - beside_px[1])))
    light = np.zeros((48, 64))
    light.ravel()[beside] = 1.0
    with TwinOptics(wide, GaussianPsf(PSF_PX)) as optics:
        image = optics.image_e_per_s(light)
    side = (576.5e-3 / 120) / (13e-3 / 25)
    shares = []
    for at, sigma, count in (
        (seen_x[beside], PSF_PX[0], TRACKER_PX[0]),
        (seen_y[beside], PSF_PX[1], TRACKER_PX[1]),
    ):
        edges = at + side * (np.arange(SIDE * 8) + 0.5) / (SIDE * 8) - side / 2
        pixels = np.arange(count)[:, None]
        inside = ndtr((pixels + 0.5 - edges) / sigma) - ndtr((pixels - 0.5 - edges) / sigma)
        shares.append(inside.mean(axis=1))
    expected = shares[1][:, None] * shares[0]
    assert expected.sum() > 0.02  # some of it is on the detector
    assert np.abs(image - expected).max() < NINE_FOR_A_SQUARE * expected.max() * 10


@pytest.mark.parametrize("mirror", ["none", "x", "y", "swap"])
def test_a_subpixel_is_beside_the_middle_of_its_pixel_where_that_is_shown(geometry, mirror):
    """A mirrored screen shows a pixel elsewhere, with its subpixels the same way round."""
    shown = replace(geometry, mirror=mirror)
    x_px, y_px = np.array([3.0, 40.0]), np.array([7.0, 11.0])
    right, down = {
        "none": (x_px, y_px),
        "x": (63 - x_px, y_px),
        "y": (x_px, 47 - y_px),
        "swap": (31.5 + (y_px - 23.5), 23.5 + (x_px - 31.5)),
    }[mirror]
    wanted = geometry.to_tracker(right + 0.3, down - 0.2)
    np.testing.assert_allclose(shown.to_tracker(x_px, y_px, (0.3, -0.2)), wanted)


def test_light_that_is_spread_part_by_part_is_all_there(geometry, rng, monkeypatch):
    """Of 41 pixels seven at once: the last part has six."""
    light = np.zeros((48, 64))
    places = rng.choice(20 * 24, 41, replace=False)
    light[14 + places // 24, 20 + places % 24] = rng.uniform(1e3, 1e6, 41)
    with TwinOptics(geometry, GaussianPsf(PSF_PX)) as optics:
        whole = optics.image_e_per_s(light)
        monkeypatch.setattr(twin_optics, "POINTS_AT_ONCE", 7 * len(optics._steps) ** 2)
        in_parts = optics.image_e_per_s(light)
    # each part is drawn in float32
    np.testing.assert_allclose(in_parts, whole, atol=1e-6 * whole.max())
