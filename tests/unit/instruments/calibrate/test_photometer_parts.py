"""The parts of the tracker as a photometer, each against a closed form: lattices, ranges, the light
between black images, and the error of a ratio of ranges.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

from hilstar.basics.errors import InputError
from hilstar.display.geometry import monitor_camera
from hilstar.instruments.calibrate.first_light.photometer import (
    APART_TRACKER_PX,
    BLACK,
    FAINT_DN,
    LONGER,
    SHARE,
    Assumed,
    DotField,
    LatticeRatio,
    Look,
    Photometer,
    PixelScatter,
    Range,
    _between,
    _first_px,
    _lit,
    _Pair,
    _passes,
    _Reading,
    _Values,
    field_for,
    lattice_profile,
    monitor_area,
    peak_shares,
)
from hilstar.instruments.calibrate.plan import Patch
from hilstar.instruments.simulate.bench_geometry import BenchGeometry
from hilstar.tracker.rounding import rounding_rms
from tests.support.closed_camera import (
    DETECTOR_PX,
    SIGMA_PX,
    ClosedCamera,
    closed_context,
    power_of,
)
from tests.support.closed_camera import EXPOSURE_S as CLOSED_EXPOSURE_S

UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])
PIXELS = 50 * 60
EXPOSURE_S = 0.5


def geometry(ratio: float = 1.5) -> BenchGeometry:
    """A monitor of 640 x 480 px, before a tracker of 400 x 300 px with `ratio` px to each."""
    return BenchGeometry(
        monitor_camera((640, 480), 50.0, 100.0, UPRIGHT),
        monitor_camera((400, 300), 50.0 / (2 * ratio), 50.0, UPRIGHT),
    )


@pytest.fixture
def made(tmp_path) -> Photometer:
    """A photometer on the closed bench, of two primaries: lattices of 1 to 8 px on 64 x 64 px, and
    light of 0.25 DN an electron.
    """
    assumed = Assumed({"r": power_of(2.2), "g": power_of(2.2)}, 0.0)
    context = closed_context(tmp_path, ClosedCamera())
    photometer = Photometer(context, SIGMA_PX, assumed, longest_s=10.0)
    photometer.field = DotField(0, 0, 64, slice(0, 50), slice(0, 60), monitor_px=1000.0)
    photometer.periods = (1, 2, 4, 8)
    photometer.exposure_s = EXPOSURE_S
    photometer.scatter = PixelScatter(default_dn_per_e=0.25)
    return photometer


def scatter_of(dark_dn2: dict[int, float]) -> PixelScatter:
    """Black images whose sums have these variances, by how many times longer they are exposed."""
    scatter = PixelScatter(default_dn_per_e=0.25)
    for times, variance in dark_dn2.items():
        # two images whose pixels differ by +-d: d^2 / 2 of variance in each
        off = np.sqrt(2 * variance / PIXELS)
        scatter.add(BLACK, Range(1, times), np.zeros((50, 60)))
        scatter.add(BLACK, Range(1, times), np.full((50, 60), off))
    return scatter


@pytest.mark.parametrize(
    ("middle_px", "size_px", "square_px", "first_px"),
    [
        (319.5, 640, 100, 270),  # pixels 270 to 369: their middle is 319.5
        (100.0, 640, 21, 90),
        (10.0, 640, 100, 0),
        (630.0, 640, 100, 540),
        (float("nan"), 640, 100, 270),
    ],
)
def test_a_square_is_about_its_middle_and_on_the_screen(middle_px, size_px, square_px, first_px):
    assert _first_px(middle_px, size_px, square_px) == first_px


def test_a_field_of_lattices_is_of_whole_cells_about_the_middle_of_what_is_seen():
    ratio, sigma_px = 1.5, 1.0
    field, periods = field_for(geometry(ratio), sigma_px)
    sparsest = 8  # the power of 2 from APART_TRACKER_PX / ratio = 5.3 px on
    assert periods == (1, 2, 4, 8)
    assert periods[-1] >= APART_TRACKER_PX / ratio > periods[-2]
    # half of the smaller side: the tracker's 300 px of 1.5 a monitor pixel
    assert field.side == SHARE * 300 / ratio // sparsest * sparsest
    assert (field.left + (field.side - 1) / 2, field.top + (field.side - 1) / 2) == pytest.approx(
        (319.5, 239.5)
    )
    columns_px = field.columns.stop - field.columns.start
    assert (field.columns.start + field.columns.stop - 1) / 2 == pytest.approx(199.5, abs=0.51)
    # six sigmas of a dot and three pixels at each side
    wings_px = 2 * (3 + 6 * np.hypot(sigma_px, ratio / np.sqrt(12)))
    # both ends are whole pixels: one more than their distance, and up to one more at each
    assert 1 <= columns_px - ((field.side - 1) * ratio + wings_px) <= 3
    assert field.monitor_px == pytest.approx(field.tracker_px / ratio**2, rel=1e-6)
    even = np.full((480, 640), 0.5, dtype=np.float32)
    dimmed, _ = field_for(geometry(ratio), sigma_px, even)
    assert dimmed.monitor_px == pytest.approx(field.monitor_px, rel=1e-6)
    with pytest.raises(InputError, match="sees too little of the monitor"):
        field_for(geometry(40.0), sigma_px)


def test_a_field_has_all_pixels_of_the_rows_and_columns_that_its_light_falls_on():
    field = DotField(0, 0, 64, slice(10, 60), slice(20, 90), 1.0)
    image = np.ones((300, 400))
    assert field.tracker_px == image[field.rows, field.columns].sum() == 50 * 70


# Half of the smallest side, in whole cells: of the monitor, upright or not, or of the tracker; and
# at most 200 px of the tracker.
@pytest.mark.parametrize("size_px", [(40, 24), (31, 19)])
def test_the_area_that_a_part_sees_is_that_of_the_screen_and_not_beyond_it(size_px):
    """Of a tracker whose pixels are the monitor's, about the same middle: each sees one, by its own
    light.
    """
    width, height = size_px
    monitor = monitor_camera(size_px, 50.0, 100.0, UPRIGHT)
    tracker = monitor_camera((width + 20, height + 20), 50.0, 100.0, UPRIGHT)
    same = BenchGeometry(monitor, tracker)
    even = np.random.default_rng(3).uniform(0.5, 1.0, (height, width)).astype(np.float32)
    for rows, columns, own_rows, own_columns in (
        (slice(0, height + 20), slice(0, width + 20), slice(0, height), slice(0, width)),
        (slice(12, 17), slice(0, 14), slice(2, 7), slice(0, 4)),
        (slice(height, height + 20), slice(15, 19), slice(height - 10, height), slice(5, 9)),
    ):
        part = even[own_rows, own_columns]
        assert monitor_area(same, rows, columns) == pytest.approx(part.size)
        assert monitor_area(same, rows, columns, even) == pytest.approx(float(part.sum()))


@pytest.mark.parametrize(
    ("monitor_px", "tracker_px", "ratio", "side_px"),
    [
        ((640, 480), (4000, 3000), 0.5, 240),
        ((480, 640), (4000, 3000), 0.5, 240),
        ((640, 480), (150, 3000), 0.5, 144),
        ((640, 480), (4000, 150), 0.5, 144),
        ((640, 480), (4000, 3000), 1.5, 128),
    ],
)
def test_a_field_is_half_of_the_smallest_side(monitor_px, tracker_px, ratio, side_px):
    bench = geometry(ratio)
    monitor = replace(bench.monitor, resolution_px=monitor_px)
    tracker = replace(bench.tracker, resolution_px=tracker_px)
    field, _ = field_for(replace(bench, monitor=monitor, tracker=tracker), 1.0)
    assert field.side == side_px


@pytest.mark.parametrize("period", [1, 2, 4, 8])
def test_a_lattice_lights_one_pixel_in_the_middle_of_each_cell(period):
    field = DotField(16, 8, 64, slice(0, 1), slice(0, 1), 1.0)
    codes = field.lattice((100, 90), period, Patch(200, "w"))
    rows, columns = np.nonzero(codes if codes.ndim == 2 else codes.any(axis=-1))
    assert len(rows) == field.lit(period) == (64 / period) ** 2
    np.testing.assert_array_equal(np.unique(np.diff(np.unique(columns))), [period])
    assert columns.min() == 16 + period // 2
    assert rows.min() == 8 + period // 2
    assert columns.max() < 16 + 64
    assert rows.max() < 8 + 64


@pytest.mark.parametrize("period", [1, 2, 4, 16])
def test_light_between_a_lattice_s_dots_is_the_sum_of_all_of_them(period):
    ratio, sigma_px = 1.5, 0.9
    profile = lattice_profile(period, ratio, sigma_px)
    step_px = period * ratio
    # a monitor pixel is a square: its variance is a twelfth of its area
    spread_px = np.sqrt(sigma_px**2 + ratio**2 / 12)
    place_px = np.linspace(-step_px / 2, step_px / 2, len(profile))
    dots_px = step_px * np.arange(-40, 41)
    edge = place_px[:, None] - dots_px
    light = norm.cdf(edge + 0.5, scale=spread_px) - norm.cdf(edge - 0.5, scale=spread_px)
    np.testing.assert_allclose(profile, light.sum(axis=1), rtol=1e-7)
    # whatever the place, a cell's light is one dot's: the mean over a cell
    mean = np.trapezoid(profile, place_px) / step_px
    assert mean == pytest.approx(1 / step_px, rel=0.01)
    assert peak_shares((period,), ratio, sigma_px)[0] == pytest.approx(profile.max() ** 2)


def test_black_between_two_images_is_read_by_the_time_between_them():
    orders = np.array([0, 10, 14])
    black = np.array([100.0, 120.0, 116.0])
    # value, and the variance of (1 - s) a + s b
    assert _between(5, orders, black) == pytest.approx((110.0, 0.5))
    assert _between(2, orders, black) == pytest.approx((104.0, 0.64 + 0.04))
    assert _between(13, orders, black) == pytest.approx((117.0, 1 / 16 + 9 / 16))
    assert _between(20, orders, black) == pytest.approx((116.0, 1.0))
    assert _between(3, orders[:1], black) == (100.0, 1.0)


def test_a_lit_patch_is_above_the_black_of_its_own_exposure():
    planned = [Patch(0, "w"), Patch(9, "w"), Patch(200, "w"), Patch(0, "w")]
    chosen = {planned[1]: Range(1, 4), planned[2]: Range(8)}
    blacks = {1: np.array([10.0, 16.0]), 4: np.array([40.0, 46.0])}
    lit = _lit(planned, chosen, blacks, {1: 142.0, 2: 1014.0})
    assert lit[1].light_dn == pytest.approx(142.0 - 42.0)
    assert lit[2].light_dn == pytest.approx(1014.0 - 14.0)
    assert lit[1].blacks == lit[2].blacks == pytest.approx(5 / 9)
    assert lit[1].at == Range(1, 4)


@pytest.mark.parametrize(
    ("peaks_dn", "sets_exposure", "wanted"),
    [
        # half of 4095 DN is the most; the densest that holds it
        ((8000.0, 4000.0, 2000.0, 1500.0), True, Range(4)),
        ((9000.0, 8000.0, 7000.0, 6000.0), True, Range(8)),
        ((1000.0, 300.0, 100.0, 50.0), True, Range(1)),
        # 0.5 s, 2 s and 8 s: a faint one longer, until its peak is FAINT_DN
        ((FAINT_DN / LONGER, 1.0, 1.0, 1.0), True, Range(1, 4)),
        ((FAINT_DN / LONGER - 0.1, 1.0, 1.0, 1.0), True, Range(1, 16)),
        # 32 s are over 10 s
        ((0.1, 0.1, 0.1, 0.1), True, Range(1, 16)),
        ((0.1, 0.1, 0.1, 0.1), False, Range(1)),
    ],
)
def test_a_range_is_the_densest_that_holds_and_longer_where_that_is_faint(
    made, peaks_dn, sets_exposure, wanted
):
    made.context.source.sets_exposure = sets_exposure
    assert made._range(np.array(peaks_dn)) == wanted


@pytest.mark.parametrize("pairs", [1, 4])
def test_a_ratio_is_as_sure_as_its_sums_and_their_number(made, pairs):
    made.scatter = scatter_of({1: 200.0, 4: 800.0})
    light_dn = (4000.0, 1000.0)
    ratios = (0.9,) * pairs
    photons = 0.25 / 4000 + 0.25 / 1000
    apart = _Pair(Patch(9, "r"), Range(1, 4), Range(1), light_dn, ratios)
    # each sum has its own noise and that of its own black image
    variance = photons + 2 * 800 / 4000**2 + 2 * 200 / 1000**2
    assert made._link(apart).error == pytest.approx(0.9 * np.sqrt(variance / pairs))
    alike = _Pair(Patch(9, "r"), Range(1), Range(2), light_dn, ratios)
    # one black image under both: its noise goes with 1 / more - 1 / less
    shared = 200 * (1 / 4000 - 1 / 1000) ** 2
    variance = photons + 200 / 4000**2 + 200 / 1000**2 + shared
    link = made._link(alike)
    assert link.error == pytest.approx(0.9 * np.sqrt(variance / pairs))
    assert (link.dense, link.sparse, link.times) == (1, 2, (1, 1))
    assert link.sigmas == pytest.approx(0.1 / link.error)


def test_a_black_sum_is_the_last_of_its_own_exposure_and_else_the_largest():
    scatter = PixelScatter(default_dn_per_e=0.25)
    assert scatter.dark_sum_dn(1) == 0.0
    for times, black_dn in ((1, 9.0), (1, 2.0), (4, 5.0)):
        scatter.add(BLACK, Range(1, times), np.full((50, 60), black_dn))
    scatter.add(Patch(9, "w"), Range(1, 2), np.full((50, 60), 100.0))
    sums_dn = [scatter.dark_sum_dn(times) for times in (1, 4, 2)]
    assert sums_dn == [2.0 * PIXELS, 5.0 * PIXELS, 5.0 * PIXELS]


def test_black_noise_is_of_its_own_exposure_and_else_of_any():
    scatter = scatter_of({1: 200.0, 4: 800.0})
    assert scatter.dark_dn2(1) == pytest.approx(200.0)
    assert scatter.dark_dn2(4) == pytest.approx(800.0)
    assert scatter.dark_dn2(16) == pytest.approx(500.0)
    assert PixelScatter(1.0).dark_dn2(1) == 0.0


def ratio_of(channel: str, dense: Range, sparse: Range, ratio: float) -> LatticeRatio:
    """A ratio of two ranges, known to a hundredth of it."""
    return LatticeRatio(
        patch=Patch(50, channel),
        dense=dense.period,
        sparse=sparse.period,
        ratio=ratio,
        error=ratio / 100,
        times=(dense.times, sparse.times),
    )


def test_ranges_are_tied_to_the_sparsest_lattice_link_by_link(made):
    links = [
        ratio_of("r", Range(1, 4), Range(1), 0.5),
        ratio_of("r", Range(1), Range(8), 0.8),
        ratio_of("g", Range(2), Range(8), 0.9),
    ]
    factors = made._factors(links)
    assert factors["r", Range(8)] == factors["g", Range(8)] == 1.0
    assert factors["r", Range(1)] == pytest.approx(0.8)
    assert factors["r", Range(1, 4)] == pytest.approx(0.4)
    assert factors["g", Range(2)] == pytest.approx(0.9)
    lit = {
        0: _Reading(Patch(3, "r"), Range(1, 4), 1.0, 1.0),
        1: _Reading(Patch(40, "r"), Range(1), 1.0, 1.0),
        2: _Reading(Patch(200, "r"), Range(8), 1.0, 1.0),
        3: _Reading(Patch(40, "g"), Range(2), 1.0, 1.0),
    }
    light = np.array([1.0, 10.0, 100.0, 20.0])
    # by one sigma of a ratio, a hundredth, all light below it falls by a hundredth
    effects = made._of_ratios(light, lit, links)
    wanted = [[-0.01, -0.01, 0], [0, -0.1, 0], [0, 0, 0], [0, 0, -0.2]]
    np.testing.assert_allclose(effects, wanted, atol=1e-12)


def test_light_passes_the_ratios_of_its_own_channel_from_its_range_on():
    link = ratio_of("r", Range(2), Range(8), 0.8)
    assert _passes(Patch(9, "r"), Range(2), link)
    assert _passes(Patch(9, "r"), Range(1), link)
    assert _passes(Patch(9, "r"), Range(4, 4), link)  # exposed longer: fainter light
    assert not _passes(Patch(9, "r"), Range(4), link)
    assert not _passes(Patch(9, "g"), Range(1), link)


def test_a_patch_s_peaks_are_white_s_on_the_sparsest_lattice_by_light_and_share(made):
    made.shares = np.array([0.9, 0.6, 0.4, 0.3])
    made.assumed = Assumed({"w": np.array([0.0, 0.25, 1.0])}, 0.0)
    peaks = made._peaks([Patch(0, "w"), Patch(1, "w"), Patch(2, "w")], 1200.0)
    assert list(peaks) == [Patch(1, "w"), Patch(2, "w")]
    np.testing.assert_allclose(peaks[Patch(2, "w")], [3600, 2400, 1600, 1200])
    np.testing.assert_allclose(peaks[Patch(1, "w")], [900, 600, 400, 300])


def test_what_the_adc_cuts_at_0_goes_by_a_dot_s_own_light(made):
    """Of a noise of 1.5 DN, whose black pixels are at 0 DN, or 20 sigmas above that."""
    made.profiles = {period: lattice_profile(period, 1.5, 0.9) for period in made.periods}
    made.scatter.add(BLACK, Range(1), np.zeros((50, 60)))
    light_dn, lattices = 2000.0, (Range(4), Range(8))
    cut_dn = [made._cut_dn(at, light_dn) for at in lattices]
    rounded_dn = [made._rounded(at, light_dn) for at in lattices]
    made.field = replace(made.field, side=128)
    for at, of_cut, of_rounding in zip(lattices, cut_dn, rounded_dn, strict=True):
        assert of_cut != pytest.approx(0.0, abs=1.0)
        # four times as many dots of the same light
        assert made._cut_dn(at, 4 * light_dn) == pytest.approx(4 * of_cut)
        assert made._rounded(at, 4 * light_dn) == pytest.approx(4 * of_rounding)
    made.scatter = PixelScatter(default_dn_per_e=0.25)
    made.scatter.add(BLACK, Range(1), np.full((50, 60), 30.0))
    assert made._cut_dn(Range(4), light_dn) == pytest.approx(0.0, abs=1e-6)


def test_rounding_of_both_sums_of_a_ratio_is_taken_off_one_another(made):
    pair = _Pair(Patch(9, "r"), Range(1), Range(2), (1000.0, 1000.0), (1.0,))
    made._rounded = lambda at, light_dn: np.full(16, 30.0)
    link = ratio_of("r", Range(1), Range(2), 1.0)
    lit = {0: _Reading(Patch(3, "r"), Range(1), 500.0, 1.0)}
    values = _Values(np.array([5.0]), np.array([1e-6]), np.array([0.01]))
    modes = made._of_rounding(values, lit, [pair], [link])
    # the same share of both sums leaves the ratio as it is: the reading's own rounding alone
    np.testing.assert_allclose((modes**2).sum(), (30.0 * 0.01) ** 2, rtol=1e-6)
    made._rounded = lambda at, light_dn: np.full(16, 30.0 if at == Range(1) else 0.0)
    modes = made._of_rounding(values, lit, [pair], [link])
    # 3 % of the ratio, of which the light loses 3 %: 0.3 less 0.15 DN/s
    np.testing.assert_allclose((modes**2).sum(), (0.3 - 0.15) ** 2, rtol=1e-6)


def test_a_code_brighter_than_stated_is_read_shorter_and_then_on_the_next_lattice(made):
    """Until it does not saturate; once read, it stays where it is."""
    taken = []

    def look(name, at, patch):
        taken.append((name, at))
        is_bright = at.times > 1 or at.period < 4 or len(taken) > 7
        return Look(100.0 * at.period, 0.81 if is_bright else 0.8)

    made._look = look
    patch = Patch(9, "w")
    chosen = {patch: Range(1, 4)}
    blacks, sums = made._sums([Patch(0, "w"), patch, Patch(0, "w"), patch], chosen)
    black = [Range(1), Range(1, 4)]
    tried = [Range(1, 4), Range(1), Range(2), Range(4)]
    assert [at for _, at in taken] == [*black, *tried, *black, Range(4)]
    assert [name for name, _ in taken[2:6]] == [f"patch_001_{at.period}" for at in tried]
    assert sums == {1: 400.0, 3: 400.0}
    assert chosen == {patch: Range(4)}
    assert {times: sums.tolist() for times, sums in blacks.items()} == dict.fromkeys(
        (1, 4), [100.0] * 2
    )


def test_a_ratio_is_said_with_each_lattice_s_own_exposure():
    link = ratio_of("g", Range(1, 4), Range(2), 0.98765)
    said = "a pixel of every 1, exposed 4 times longer is 0.98765 +- 0.00988 times one of every 2"
    assert link.words == f"code 50 of g: {said}"
    sparse = ratio_of("r", Range(1, 16), Range(1, 4), 1.0).words
    assert sparse.endswith("one of every 1, exposed 4 times longer")


@pytest.mark.parametrize("even_relative", [0.0, 0.1])
def test_black_is_the_mean_of_two_screens_over_one_that_is_off(tmp_path, made, even_relative):
    """Screens of 100 DN a pixel that differ by 2 DN, and 60 DN without glow; rounding is hidden by
    a noise of 2 DN.
    """
    levels_dn = {"black_screen_0": 99.0, "black_screen_1": 101.0, "unlit_000": 60.0}
    paths = {name: tmp_path / f"{name}.png" for name in levels_dn}
    camera = made.context.source
    for name, level_dn in levels_dn.items():
        camera.images[paths[name]] = np.full(DETECTOR_PX[::-1], level_dn)
    made.context = replace(made.context, images=paths)
    made._dark_screen = paths["black_screen_0"]
    made._even_relative, made.images = even_relative, []
    light, error = made._with_black([], np.array([3.0, 7.0]))
    seconds = 1000.0 * CLOSED_EXPOSURE_S
    more_dn = 40.0 * PIXELS
    np.testing.assert_allclose(light, np.array([3.0, 7.0]) + more_dn / seconds)
    screens_dn2 = 2.0**2 * PIXELS / 2
    # of the mean of two, and of one whose glow has no shot noise: more than there is
    variance = screens_dn2 / 2 + max(screens_dn2 - 0.25 * more_dn, 0.0)
    for image_dn2, sum_dn in ((screens_dn2, 100 * PIXELS), (0.0, 60 * PIXELS)):
        variance += (PIXELS * rounding_rms(made._noise_dn(image_dn2, sum_dn))) ** 2
    variance += (even_relative * more_dn) ** 2
    assert error == pytest.approx(math.sqrt(variance) / seconds, rel=1e-6)
    assert made.images == [paths["black_screen_1"], paths["unlit_000"]]
