"""What first light reads of a star's image and of several images of one pattern: shares of light,
noise, scatter and areas, each against a closed form or planted noise.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.special import erf, ndtr

from hilstar.display.geometry import monitor_camera
from hilstar.display.panel import Panel
from hilstar.display.response import Levels, table_response
from hilstar.instruments.calibrate.first_light.context import DarkSubtracted
from hilstar.instruments.calibrate.first_light.photometer import PixelScatter, Range, monitor_area
from hilstar.instruments.calibrate.first_light.seen_stars import (
    Beyond,
    ExpectedStars,
    ImageLimits,
    Scatter,
    StarSpot,
    StarsSeen,
    _fields,
    _mean_dark,
    codes_mag,
    compared,
    difference_noise_dn,
    from_middle,
    see_stars,
    stars_alone,
)
from hilstar.instruments.calibrate.first_light.stars import frames_for, place_reasons
from hilstar.instruments.calibrate.plan import Patch
from hilstar.instruments.simulate.bench_geometry import BenchGeometry
from hilstar.optics.layers.truth import TRUTH_DTYPE
from hilstar.server.bench.build import open_bench
from hilstar.tracker.centroids import noisiest_background
from hilstar.tracker.rounding import rounded_light
from tests.support.closed_camera import AXIS_PX, DETECTOR_PX, RATIO, ClosedCamera, closed_context
from tests.support.seen_stars import stars_seen

WIDE = StarSpot((0.9, 1.4), gain_e_per_dn=4.0, prnu=0.0, electronics_dn=0.0)
MAG_A_RELATIVE = 2.5 / np.log(10)


def test_shares_of_a_star_are_the_gaussian_s():
    half_px = WIDE.radius_px + 0.5
    for share, half in ((WIDE.window_share, half_px), (WIDE.peak_share, 0.5)):
        closed = erf(half / 0.9 / np.sqrt(2)) * erf(half / 1.4 / np.sqrt(2))
        assert share == pytest.approx(closed, rel=1e-12)
    assert WIDE.mean_sigma_px**2 == pytest.approx(0.9 * 1.4)


@pytest.mark.parametrize("place_px", [(7.0, 9.0), (7.3, 9.1), (6.9, 8.6), (7.45, 9.49)])
def test_the_second_pixel_of_a_star_is_the_brighter_of_its_neighbours(place_px):
    pixels = np.arange(20.0)
    axes = []
    for place, sigma in zip(place_px, WIDE.sigma_px, strict=True):
        axes.append(ndtr((pixels + 0.5 - place) / sigma) - ndtr((pixels - 0.5 - place) / sigma))
    second = np.sort(np.outer(*axes).ravel())[-2]
    assert WIDE.second_share(np.array([place_px]))[0] == pytest.approx(second, rel=1e-9)


def test_light_is_as_noisy_as_its_photons_and_its_window_s_background():
    """Of N electrons in the window 1 / sqrt(N); of k pixels of noise s, s sqrt(k) over the light."""
    dn = np.array([1e5, 4e5])
    window_dn = dn * WIDE.window_share
    photons = MAG_A_RELATIVE / np.sqrt(4.0 * window_dn)
    # a thousandth: the ADC's rounding, 1 DN / sqrt(12) a pixel
    assert WIDE.light_noise_mag(dn, 1e-3) == pytest.approx(photons, rel=0.02)
    pixels = (2 * WIDE.radius_px + 1) ** 2
    faint_dn = np.array([2000.0])
    background = MAG_A_RELATIVE * 60.0 * np.sqrt(pixels) / (faint_dn * WIDE.window_share)
    assert WIDE.light_noise_mag(faint_dn, 60.0) == pytest.approx(background, rel=0.01)
    # the mean of nine frames has a third of the photons' noise
    nine = StarSpot((0.9, 1.4), 4.0, 0.0, 0.0, frames=9)
    assert nine.light_noise_mag(dn, 1e-3)[1] == pytest.approx(photons[1] / 3, rel=0.05)


@pytest.mark.parametrize("frames", [1, 4])
def test_rounding_is_that_of_the_noise_of_one_image_before_the_adc(frames):
    """Less a dark frame's, in the mean of frames: of 0.25 DN, two images have twice the variance
    and the ADC adds 1/12 to each.
    """
    spot = StarSpot((0.9, 1.4), 4.0, 0.0, electronics_dn=1.0, frames=frames)
    noise_dn = np.sqrt(2 * (0.25**2 + 1 / 12) / frames)
    share, _ = spot._shares
    light_dn = np.array([3.0, 40.0])
    for rounded_dn, star_dn in zip(spot.rounded_dn(light_dn, noise_dn), light_dn, strict=True):
        pixel_dn = rounded_light(star_dn * share.ravel(), 0.25, 1 / 4.0)
        assert np.abs(pixel_dn).max() > 1e-4
        np.testing.assert_allclose(rounded_dn, share.size * pixel_dn, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("scatter", [0.0, 0.05])
def test_a_scatter_beyond_noise_is_between_its_bounds(rng, scatter):
    """Each bound is missed in one of 20 trials: of 300 in 15, and five sigmas are 19. The mean
    square comes out right.
    """
    over = under = 0
    squares = []
    for _ in range(300):
        noise = rng.uniform(0.03, 0.06, 300)
        beyond = Beyond.of(np.hypot(scatter, noise) * rng.standard_normal(300), noise)
        over += beyond.high < scatter
        under += beyond.low > scatter
        squares.append(beyond.sigma**2)
    assert over <= 34
    assert under <= 34
    if scatter:
        assert np.mean(squares) == pytest.approx(scatter**2, rel=0.03)
        assert min(over, under) > 0


def seen(rng, *, place_noise_px=0.01, off_px=0.0, count: int = 200, **columns) -> StarsSeen:
    """Stars all over the screen in four frames, off by an error beside the noise of their places,
    rms.
    """
    residual_px = rng.standard_normal((count, 2))
    residual_px *= np.hypot(off_px, place_noise_px) / np.sqrt((residual_px**2).mean())
    all_over = {
        "residual_px": residual_px,
        "place_noise_px": np.full(count, place_noise_px),
        "e_per_s": np.exp(rng.uniform(0, 5, count)),
        "screen": rng.uniform(-1, 1, (count, 2)),
        "frames": 4,
    }
    return stars_seen(**all_over | columns)


def test_what_follows_place_or_light_is_told_apart(rng):
    stars = seen(rng)
    used = np.ones(200, dtype=bool)
    noise = 0.01 * rng.standard_normal(200)
    by_place = stars.scatter(0.3 * stars.screen[:, 0] + noise, used)
    by_light = stars.scatter(0.1 * np.log(stars.e_per_s) + noise + 7.0, used)
    neither = stars.scatter(0.2 * rng.standard_normal(200), used)
    assert "follows the place on the screen" in by_place.finding
    assert by_place.by_place > 0.95
    assert by_place.by_light < 0.2
    assert "follows the light asked for" in by_light.finding
    assert by_light.by_light > 0.95
    assert by_light.by_place < 0.2
    assert "follows neither" in neither.finding
    assert stars.scatter(noise + 7.0, used).finding == ""
    # what the codes are known to cost is no scatter
    codes_mag = 0.3 * rng.standard_normal(200)
    coarse = replace(stars, codes_mag=codes_mag)
    assert coarse.scatter(codes_mag + noise, used).finding == ""
    assert Scatter(0.031, 0.01, 0.0, 0.0).finding != "" == Scatter(0.029, 0.01, 0.0, 0.0).finding


@pytest.mark.parametrize(
    ("sigma_px", "radius_px"),
    [((0.5, 0.6), 4), ((1.3, 1.3), 4), ((1.4, 1.0), 5), ((1.0, 1.4), 5), ((2.1, 0.5), 7)],
)
def test_a_window_is_three_sigmas_of_the_wider_axis_and_four_pixels_or_more(sigma_px, radius_px):
    assert StarSpot(sigma_px, 4.0, 0.0, 0.0).radius_px == radius_px


# Under 0.01 mag; of fewer than ten such stars the ten with the least noise, under 0.1 mag.
@pytest.mark.parametrize(
    ("noise_mag", "sure"),
    [
        ([0.002, 0.009, 0.005], [True, True, True]),
        ([0.002, 0.05, 0.09], [True, True, True]),
        ([0.002, 0.05, 0.11], [True, True, False]),
        ([0.2, 0.3], [False, False]),
        ([0.001] * 10 + [0.009, 0.011], [True] * 11 + [False]),
        ([0.03] * 9 + [0.05, 0.04], [True] * 9 + [False, True]),
    ],
)
def test_stars_are_sure_by_their_noise_or_by_being_the_few_with_the_least(rng, noise_mag, sure):
    stars = seen(rng, count=len(sure), noise_mag=np.array(noise_mag))
    assert stars.sure.tolist() == sure


def test_places_are_refused_by_what_is_sure_and_frames_asked_for_by_what_is_not(rng):
    limit_px = 0.1
    sure = seen(rng, off_px=0.2).beyond_px
    assert "run the geometry again" in place_reasons(sure, 4, limit_px)[0]
    assert frames_for(sure, 4, limit_px) == 4
    well = seen(rng, off_px=0.0).beyond_px
    assert place_reasons(well, 4, limit_px) == []
    doubtful = seen(rng, place_noise_px=0.3, count=40).beyond_px
    frames = frames_for(doubtful, 4, limit_px)
    assert frames > 4
    assert f"--average {frames}" in place_reasons(doubtful, 4, limit_px)[0]


def test_images_of_one_pattern_tell_noise_and_dn_an_electron(rng):
    """Dark images of 3 DN, and light of 0.25 DN an electron, over 60 x 50 pixels."""
    scatter = PixelScatter(default_dn_per_e=0.7)
    assert scatter.dn_per_e == 0.7
    lit, black, at = Patch(200, "w"), Patch(0, "w"), Range(2, 1)
    size = (50, 60)
    for _ in range(40):
        scatter.add(black, at, 30 + rng.normal(0, 3.0, size))
        light = 0.25 * rng.poisson(800.0, size)
        scatter.add(lit, at, 30 + rng.normal(0, 3.0, size) + light)
    pixels = size[0] * size[1]
    # of 39 differences of 3000 pixels: 0.4 %, and five sigmas
    assert scatter.dark_dn2(1) == pytest.approx(pixels * 9.0, rel=0.02)
    assert scatter.dark_dn2(4) == scatter.dark_dn2(1)  # of an exposure that was not taken
    assert scatter.dark_sum_dn(1) == pytest.approx(30 * pixels, rel=0.01)
    assert scatter.dn_per_e == pytest.approx(0.25, rel=0.03)
    light_dn = 200.0 * pixels
    assert scatter.sum_dn2(light_dn, 1) == pytest.approx(
        0.25 * light_dn + 2 * 9.0 * pixels, rel=0.03
    )
    assert scatter.sum_dn2(-5.0, 1, blacks=0.0) == scatter.dark_dn2(1)


def test_a_part_of_an_image_sees_its_area_of_the_screen():
    """A pixel's side on the screen is the ratio of the focal lengths; beyond its edge is none."""
    upright = np.array([1.0, 0.0, 0.0, 0.0])
    geometry = BenchGeometry(
        monitor_camera((640, 480), 50.0, 100.0, upright),
        monitor_camera((400, 300), 10.0, 30.0, upright),
    )
    # 2000 px to a focal length of the monitor's, 3000 px of the tracker's
    pixel_px2 = (2000 / 3000) ** 2
    rows, columns = slice(140, 160), slice(150, 190)
    assert monitor_area(geometry, rows, columns) == pytest.approx(20 * 40 * pixel_px2)
    even = np.full((480, 640), 0.5, dtype=np.float32)
    even[:, 320:] = 0.25
    # the middle of the screen is the tracker's column 199.5
    halves = slice(180, 220)
    assert monitor_area(geometry, rows, halves, even) == pytest.approx(
        20 * 40 * pixel_px2 * 0.375, rel=0.02
    )
    narrow = BenchGeometry(monitor_camera((60, 480), 50.0, 100.0, upright), geometry.tracker)
    whole = monitor_area(narrow, rows, slice(0, 400))
    # 60 columns of the screen, to a pixel of the tracker at each side
    assert whole == pytest.approx(60 * 20 * 2000 / 3000, abs=2 * 20 * pixel_px2)


def test_codes_are_summed_over_the_tracker_s_window_on_the_monitor():
    """Two pixels of the monitor to one of the tracker's, and a window of 9: 19 pixels. The light
    asked for is even, and what is shown stands in the outermost ring of those alone.
    """
    spot = StarSpot((0.7, 0.9), 4.0, 0.0, 0.0)
    assert spot.radius_px == 4
    upright = np.array([1.0, 0.0, 0.0, 0.0])
    geometry = BenchGeometry(
        monitor_camera((80, 60), 50.0, 80.0, upright), monitor_camera((40, 30), 50.0, 40.0, upright)
    )
    reach = spot.reach_on_screen(geometry)
    assert reach == 9
    levels = np.zeros((60, 80), dtype=np.uint16)
    x, y = 50, 25
    levels[y - 9 : y + 10, x - 9 : x + 10] = 3
    levels[y - 8 : y + 9, x - 8 : x + 9] = 0
    panel = Panel(table_response(2, np.array([0.0, 0.1, 0.4, 1.0])), 7.0)
    linear = np.ones((60, 80), dtype=np.float32)
    places = np.array([[50.2, 24.9], [10.0, 50.0]])
    both = (Levels(levels), Levels(np.zeros_like(levels)))
    (off_mag, dark_mag) = codes_mag(linear, both, panel, places, reach)
    ring = 19**2 - 17**2
    # in one of two frames, of white's 7 electrons per second
    assert off_mag == pytest.approx(-2.5 * np.log10(7.0 * ring / 2 / 19**2))
    assert dark_mag == 0.0  # such a star is not shown
    # at a corner of the screen the window is what of it is on the screen: 10 by 11 pixels
    corner = np.zeros((60, 80), dtype=np.uint16)
    corner[:10, :11] = 3
    shown = (Levels(corner),)
    (corner_mag,) = codes_mag(linear, shown, panel, np.array([[1.0, 0.0]]), reach)
    assert corner_mag == pytest.approx(-2.5 * np.log10(7.0))


@pytest.mark.parametrize("frames", [1, 4])
def test_as_many_frames_are_asked_for_as_bring_the_doubt_to_the_limit(frames):
    """The doubt of a scatter's square shrinks with the number of frames."""
    p95_of_two = 2.4477
    for sigma_px, high_px in ((0.02, 0.09), (0.0, 0.3), (0.038, 0.06)):
        beyond = Beyond(sigma_px, 0.0, high_px)
        limit_px = 0.1
        limit = limit_px / p95_of_two
        room = max(limit**2 - sigma_px**2, limit**2 / 4)
        wanted = math.ceil(frames * (high_px**2 - sigma_px**2) / room)
        assert frames_for(beyond, frames, limit_px) == max(wanted, frames + 1)
    assert frames_for(Beyond(0.01, 0.0, 0.04), frames, 0.1) == frames


def test_fields_have_the_most_stars_that_both_tracker_and_screen_have(tmp_path):
    """Of a screen that covers a fifth of the tracker's field; all but the sky's few
    brightest stars are readable."""
    bright = {
        "monitor": {"resolution_px": [64, 60]},
        "collimator": {"principal_point_px": [30.0, 32.0]},
        "render": {"flux_at_white_e_per_s": 1e12},
        "tracker.detector": {"gain_e_per_dn": 100.0, "full_well_e": 1e9, "bits": 16},
    }
    context = closed_context(tmp_path, ClosedCamera(), bright)
    spot = StarSpot((0.9, 0.9), 4.0, 0.0, 0.0)
    with open_bench(context.file) as bench:
        fields = _fields(bench, context, spot, noise_dn=0.5)
        vectors = bench.stars.directions(np.flatnonzero(bench.stars.row >= 0))
    assert len(fields) >= 3
    counts = []
    for q in fields:
        x, y, z = Rotation.from_quat(q, scalar_first=True).as_matrix() @ vectors.T
        ahead = z > 0
        right, down = x[ahead] / z[ahead], y[ahead] / z[ahead]
        inside = np.ones(len(right), dtype=bool)
        for axis_px, focal_px, size_px, margin_px in (
            (AXIS_PX, 10e3 / 13, DETECTOR_PX, spot.radius_px + 12),
            ((30.0, 32.0), 40e3 / 57.65, (64, 60), 12),
        ):
            column = axis_px[0] + focal_px * right
            row = axis_px[1] + focal_px * down
            inside &= (column > margin_px) & (column < size_px[0] - margin_px)
            inside &= (row > margin_px) & (row < size_px[1] - margin_px)
        counts.append(int(inside.sum()))
    assert counts == sorted(counts, reverse=True)
    # the screen has 3.3 x 3.0 degrees without its margins
    assert counts[0] >= 4


def test_a_star_is_as_wide_as_its_sprite_its_pixels_and_the_psf_of_the_focus(tmp_path):
    """The focus found the PSF twice as wide as the bench file has it."""
    bench = {
        "tracker": {"psf_sigma_px": [0.6, 1.0]},
        "render": {"sprite_sigma_px": [1.2, 0.9]},
        "tracker.detector": {"prnu": 0.01, "read_noise_e": 10.0},
    }
    known = {"focus.psf_sigma_px": 1.6}
    spot = StarSpot.of(closed_context(tmp_path, ClosedCamera(), bench, known=known))
    # the square of light and that of the drawing's pixel: a twelfth each
    wanted = (
        math.hypot(1.2, RATIO * math.sqrt(1.2**2 + 1 / 6)),
        math.hypot(2.0, RATIO * math.sqrt(0.9**2 + 1 / 6)),
    )
    assert spot.sigma_px == pytest.approx(wanted)
    assert (spot.gain_e_per_dn, spot.prnu, spot.electronics_dn) == (4.0, 0.01, 2.5)


def test_each_star_s_place_counts_by_its_own_noise(rng):
    """A star far off within its noise, and others near: no scatter beyond noise."""
    noise_px = np.array([3.0] + [0.01] * 9)
    off_px = noise_px[:, None] * np.tile([1.0, -1.0], (10, 1))
    stars = replace(seen(rng, count=10), residual_px=off_px, place_noise_px=noise_px)
    assert stars.beyond_px.sigma == pytest.approx(0.0, abs=1e-9)


def test_an_image_less_a_dark_one_has_the_noise_of_both(rng):
    dark = 50 + rng.normal(0, 2.0, (90, 120))
    noise_dn = math.sqrt(2) * noisiest_background(dark).noise
    assert difference_noise_dn(dark) == pytest.approx(noise_dn)


def test_fields_are_shown_as_often_as_they_are_averaged(tmp_path):
    camera = ClosedCamera()
    context = closed_context(tmp_path, camera)
    stars = see_stars(context, frames=2)
    names = [name for name, _ in camera.taken]
    fields = (len(names) - 2) // 2
    wanted = ["dark_000", "dark_001"]
    for number in range(fields):
        wanted += [f"stars_{number:03}", f"stars_{number:03}_01"]
    assert fields >= 3 and names == wanted
    assert [path.stem for path in stars.images] == names
    assert stars.frames == 2


def test_a_mean_dark_is_a_mean(tmp_path):
    camera = ClosedCamera()
    dark, paths = _mean_dark(closed_context(tmp_path, camera), 2)
    first, second = (camera.images[path] for path in paths)
    assert (first != second).any()
    np.testing.assert_allclose(dark, (first + second) / 2)


def test_stars_that_are_compared_are_alone_whole_within_both_edges_and_no_planets():
    """A tracker of 200 x 150 px; places on it and on a screen of 401 x 301 px, a star a row."""
    rows = [
        # hip, place, screen, light, drawn, clipped
        (1, (100, 75), (250, 100), 100.0, 1, 0),
        (0, (60, 75), (100, 200), 100.0, 1, 0),  # a planet
        (3, (30, 30), (200, 150), 100.0, 0, 0),  # not drawn
        (4, (30, 60), (200, 150), 100.0, 1, 1),  # clipped
        (5, (11, 100), (200, 150), 100.0, 1, 0),  # at the tracker's edge
        (6, (150, 40), (395, 150), 100.0, 1, 0),  # at the screen's
        (7, (150, 100), (200, 290), 100.0, 1, 0),
        (8, (150, 107), (200, 150), 1.0, 1, 0),  # beside a brighter one
        (9, (160, 20), (200, 150), 100.0, 1, 0),
        (10, (165, 20), (210, 150), 0.09, 1, 0),  # too faint to disturb that
        (11, (np.nan, np.nan), (200, 150), 100.0, 1, 0),
        (12, (20, 130), (40, 280), 100.0, 1, 0),
    ]
    columns = [np.array(column) for column in zip(*rows, strict=True)]
    hip, place, screen, light, drawn, clipped = columns
    truth = np.zeros(len(rows), dtype=TRUTH_DTYPE)
    truth["hip"], truth["electrons_per_s"] = hip, light
    truth["x_px"], truth["y_px"] = screen.T
    truth["drawn"], truth["clipped"] = drawn, clipped
    spot = StarSpot((1.0, 1.0), 4.0, 0.0, 0.0)
    row = np.where(hip > 0, hip + 3, -1)
    is_alone = stars_alone(truth, row, place, ((200, 150), (401, 301)), spot)
    assert hip[is_alone].tolist() == [1, 9, 12]


def test_a_place_on_the_screen_is_from_its_middle():
    screen_px = np.array([[250.0, 100.0], [200.0, 150.0], [40.0, 280.0]])
    wanted = [[0.25, -1 / 3], [0.0, 0.0], [-0.8, 130 / 150]]
    np.testing.assert_allclose(from_middle(screen_px, (401, 301)), wanted)


def test_stars_are_measured_in_the_mean_of_images_of_a_screen_that_is_half_as_bright(rng):
    """Seven stars of which one saturates above its dark level, two that are not there, one of which
    half the light would not show, and one that nothing is asked of.
    """
    spot = StarSpot((0.9, 1.1), 4.0, 0.0, 0.0)
    place = np.array([[20.0 + 25 * k, 20.3 + 7 * k] for k in range(9)])
    dn = np.array([3000.0, 4000, 5000, 6000, 8000, 9000, 24_000, 0, 0])
    noise_dn = 4.0
    # at which a star's second pixel is three thresholds of eight sigmas, in the mean of four
    shown_dn = 24 * noise_dn / 2 / spot.second_share(place)
    asked_dn = 2 * dn
    asked_dn[7:] = 2 * shown_dn[7:] * [1.2, 0.7]
    axes = []
    for axis, (size, sigma) in enumerate(((240, 0.9), (100, 1.1))):
        edges = np.arange(size + 1) - 0.5
        axes.append(np.diff(ndtr((edges - place[:, axis, None]) / sigma), axis=1))
    drawn = np.einsum("n,ny,nx->yx", dn, axes[1], axes[0])
    exposure_s, floor_dn = 0.5, 600.0

    paths = tuple(Path(f"{name}.png") for name in "abcd")
    looked = [
        DarkSubtracted(path, drawn + rng.normal(0, noise_dn, drawn.shape), 0.0, floor_dn)
        for path in paths
    ]
    none = np.zeros((9, 2))
    wanted = ExpectedStars(
        hip=np.arange(9, dtype=np.int32),
        place_px=place,
        e_per_s=asked_dn * 4.0 / exposure_s,
        screen=none,
        codes_mag=none[:, 0],
    )
    stars = compared(iter(looked), wanted, spot, ImageLimits(exposure_s, 4095))
    assert stars.hip.tolist() == [0, 1, 2, 3, 4, 5, 6]
    assert (stars.images, stars.frames) == (paths, 4)
    np.testing.assert_allclose(stars.dn, dn[:7], rtol=0.03)
    # 0.8 of 4095 DN, of which the dark level has 600: 2676 DN; the brightest has 3500 in a pixel
    assert 2676 < drawn.max() < 0.8 * 4095 + floor_dn
    assert np.isinf(stars.noise_mag).tolist() == [False] * 6 + [True]
    assert stars.lost == 1
    pixels = (2 * spot.radius_px + 1) ** 2
    photons = dn[0] / (4.0 * 4)
    faint = MAG_A_RELATIVE * math.sqrt(photons + pixels * noise_dn**2 / 4) / dn[0]
    assert stars.noise_mag[0] == pytest.approx(faint, rel=0.1)
