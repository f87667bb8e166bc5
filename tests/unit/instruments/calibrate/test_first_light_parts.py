"""The parts of first light's steps on stars and on the screen's evenness, each against a closed
form: shares, scatter, errors of full scale, verdicts, and maps of light.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.special import ndtr

from hilstar.display.calibration import weights_of_grid
from hilstar.instruments.calibrate.first_light.context import FittedFigure
from hilstar.instruments.calibrate.first_light.photometer import (
    BLACK,
    Assumed,
    LatticeRatio,
    Photometer,
    PixelScatter,
    Range,
    _Pair,
    _Reading,
    _Values,
)
from hilstar.instruments.calibrate.first_light.photometry import shares_of_white
from hilstar.instruments.calibrate.first_light.seen_stars import (
    StarSpot,
    _explained,
    _is_in_image,
    _is_inside,
    _why_few,
)
from hilstar.instruments.calibrate.first_light.stars import (
    LOST_SHARE,
    SYSTEMATIC_MAG,
    _contradictions,
    _place_figures,
    _scale_error_mag,
    _scale_trend,
    _star_reasons,
    trend,
)
from hilstar.instruments.calibrate.first_light.uniformity import (
    JOINED,
    DotLight,
    UniformityMap,
    _design,
    _fitted,
    _is_surely_larger,
    _Maps,
    _not_negative,
    _shown,
    _smoothness,
    draw_uniformity,
    known_error_mag,
    spacing_for,
)
from hilstar.instruments.calibrate.plan import Patch
from hilstar.instruments.calibrate.scale import MeasuredScale
from hilstar.instruments.simulate.bench_geometry import BenchGeometry
from hilstar.optics.camera import Camera
from tests.support.closed_camera import (
    BITS,
    EXPOSURE_S,
    FULL_DN,
    SIGMA_PX,
    ClosedCamera,
    closed_context,
    power_of,
)
from tests.support.seen_stars import stars_seen
from tests.support.spectra import bump, write_channels, write_panel

MAG_A_RELATIVE = 2.5 / math.log(10)
SPOT = StarSpot((0.9, 1.4), gain_e_per_dn=4.0, prnu=0.05, electronics_dn=0.0)


def camera(size_px: tuple[int, int], focal_length_px: float) -> Camera:
    """An upright camera about its middle."""
    width, height = size_px
    middle_px = ((width - 1) / 2, (height - 1) / 2)
    return Camera(size_px, focal_length_px, middle_px, np.eye(3))


def test_places_are_inside_by_more_than_the_margin_from_the_outermost_pixels():
    # of 100 x 50 px, 10 px within the pixels 0 and 99, 0 and 49
    places_px = np.array([[10.1, 10.1], [88.9, 38.9], [9.9, 20], [89.1, 20], [20, 9.9], [20, 39.1]])
    assert _is_inside(places_px, (100, 50), 10.0).tolist() == [True, True] + [False] * 4


def test_directions_are_in_an_image_where_they_are_projected_into_it():
    tangent = np.array([[0.0, 0.0], [0.19, 0.0], [0.21, 0.0], [0.0, 0.06], [0.0, 0.09]])
    in_cam = np.append(tangent, np.ones((5, 1)), axis=1)
    assert _is_in_image(camera((100, 50), 200.0), in_cam, 10.0).tolist() == [
        True,
        True,
        False,
        True,
        False,
    ]


def test_shapes_without_a_share_explain_nothing_on_the_mean(rng):
    shares = []
    for _ in range(400):
        off = rng.normal(size=12)
        shares.append(_explained(off, rng.normal(size=12), rng.normal(size=12)))
    # of R^2 by chance, without its correction 2 / 11; its scatter is 0.15, over the root of 400
    assert np.mean(shares) == pytest.approx(0.0, abs=4 * 0.15 / 20)
    x = np.linspace(-1, 1, 12)
    assert _explained(3 + 2 * x, x) == pytest.approx(1.0)
    assert _explained(np.ones(12), x) == 0.0
    assert _explained(np.array([1.0, 2.0]), np.array([1.0, 2.0])) == 0.0


@pytest.mark.parametrize(
    ("lost", "sigma_px", "why"),
    [
        (0, (0.9, 1.4), "; the field has few bright stars: write a longer"),
        (0, (3.0, 12.0), "; a star's sigma is 6.0 px: write a longer"),
        (4, (3.0, 12.0), "; 4 that should be bright enough are not there: measure the response"),
    ],
)
def test_why_few_stars_are_seen_is_said_by_what_is_wrong(lost, sigma_px, why):
    seen = stars_seen(residual_px=np.zeros((3, 2)), lost=lost)
    line = _why_few(seen, replace(SPOT, sigma_px=sigma_px), 2)
    assert line.startswith("3 stars can be seen where the sky has them, in 2 fields, and 5 are")
    assert why in line


def window_sums(place_px: tuple[float, float], spot: StarSpot) -> tuple[np.ndarray, np.ndarray]:
    """A star's shares in the window about the origin (k, k), and the pixels' offsets."""
    reach = np.arange(-spot.radius_px, spot.radius_px + 1.0)
    axes = []
    for place, sigma in zip(place_px, spot.sigma_px, strict=True):
        axes.append(ndtr((reach + 0.5 - place) / sigma) - ndtr((reach - 0.5 - place) / sigma))
    across, down = axes
    return np.outer(down, across), reach


@pytest.mark.parametrize("part", ["background", "photons", "response"])
def test_a_place_is_as_noisy_as_its_window_s_first_moment(part):
    """The moment along x of light w times a pixel's noise, over its slope by the star's place: by a
    step of the place.
    """
    prnu = 0.05 if part == "response" else 0.0
    spot = StarSpot((0.9, 1.4), gain_e_per_dn=4.0, prnu=prnu, electronics_dn=0.0)
    dn, noise_dn = 1e4, 7.0 if part == "background" else 0.0
    shares, reach = window_sums((0.0, 0.0), spot)
    sigma = spot.settings.window_sigma_px
    window = np.exp(-(reach**2 + reach[:, None] ** 2) / (2 * sigma**2))
    pull = window * reach
    variance = {
        "background": noise_dn**2 * np.ones_like(shares),
        "photons": dn * shares / 4.0,
        "response": (prnu * dn * shares) ** 2 + dn * shares / 4.0,
    }[part]
    if part == "background":
        variance = variance + dn * shares / 4.0
    # a window that follows the star sees the moment of a star off its middle
    slope = float((shares * window * (1 - reach**2 / sigma**2)).sum())
    step_px = 1e-4
    moved = []
    for off_px in (step_px, -step_px):
        there, _ = window_sums((off_px, 0.0), spot)
        moved.append(float((there * pull).sum()))
    by_step = (moved[0] - moved[1]) / (2 * step_px)
    wanted_px = math.sqrt(float((pull**2 * variance).sum())) / (dn * slope)
    assert spot.place_noise_px(np.array([dn]), noise_dn)[0] == pytest.approx(wanted_px)
    # the slope is that of light moving under a window at rest, to what light is at its edge
    assert slope == pytest.approx(by_step, rel=0.1)


def test_a_response_s_noise_is_of_each_pixel_s_own_light():
    dn = np.array([1e7])
    shares, _ = window_sums((0.0, 0.0), SPOT)
    # of 10^7 DN, photons are a 3e4th and PRNU of 5 % the rest
    wanted = MAG_A_RELATIVE * 0.05 * math.sqrt(float((shares**2).sum())) / SPOT.window_share
    assert SPOT.light_noise_mag(dn, 0.0)[0] == pytest.approx(wanted, rel=1e-3)


def test_full_scale_is_as_sure_as_readings_sessions_and_the_adc_together():
    # by phase the weighted means of the stars: 0.01 and -0.02 mag
    rounding_mag = np.array([[0.01, -0.05], [0.01, -0.01]])
    rounding = math.sqrt((0.01**2 + 0.02**2) / 2)
    two = MeasuredScale(7e4, 8e4, np.ones(2), np.array([1.0, 3.0]), noise_mag=0.003)
    error_mag = _scale_error_mag(two, rounding_mag)
    assert error_mag == pytest.approx(math.hypot(0.003, SYSTEMATIC_MAG, rounding))
    one = MeasuredScale(7e4, 8e4, np.ones(1), np.ones(1), noise_mag=0.003)
    assert _scale_error_mag(one, np.zeros((1, 2))) == pytest.approx(SYSTEMATIC_MAG)


def test_a_trend_is_what_a_line_over_the_logarithm_changes_between_its_ends(rng):
    e_per_s = np.geomspace(100.0, 1e4, 30)
    noise = rng.normal(0, 0.02, 30)
    line = stats.linregress(np.log(e_per_s), noise)
    span = math.log(100)
    trend_mag, error_mag = trend(e_per_s, noise)
    assert trend_mag == pytest.approx(line.slope * span)
    assert error_mag == pytest.approx(line.stderr * span)
    weights = rng.uniform(1, 4, 30)
    slope = np.polyfit(np.log(e_per_s), noise, 1, w=np.sqrt(weights))[0]
    rounding_mag = np.column_stack([0.1 * np.log(e_per_s), -0.1 * np.log(e_per_s)])
    trend_mag, with_rounding_mag = _scale_trend(e_per_s, noise, weights, rounding_mag)
    assert trend_mag == pytest.approx(slope * span)
    alone_mag = trend(e_per_s, noise, np.sqrt(weights))[1]
    assert with_rounding_mag == pytest.approx(math.hypot(alone_mag, 0.1 * span))


@pytest.mark.parametrize(
    ("figures", "is_scattered", "words"),
    [
        ({"stars": 90, "lost": 10}, False, []),
        ({"stars": 89, "lost": 11}, False, ["11 bright stars are not there"]),
        ({"stars": 9, "lost": 0, "flux_beyond_noise_p95_mag": 0.06}, False, ["0.060 mag off"]),
        ({"stars": 9, "lost": 0, "flux_beyond_noise_p95_mag": 0.06}, True, []),
        ({"stars": 9, "lost": 0, "flux_zero_point_mag": -0.06}, True, ["-0.060 mag off"]),
        ({"stars": 9, "lost": 0, "flux_zero_point_mag": 0.04}, False, []),
    ],
)
def test_stars_that_miss_a_limit_are_a_reason_each(figures, is_scattered, words):
    reasons = _star_reasons(figures, 0.05, is_scattered=is_scattered)
    assert len(reasons) == len(words)
    for reason, word in zip(reasons, words, strict=True):
        assert word in reason
    assert LOST_SHARE == 0.1


# Limits of 0.05 mag, and of three errors where those are more.
@pytest.mark.parametrize(
    ("scatter", "over_light", "error_mag", "words"),
    [
        ((0.01, 0.01), (0.01, 0.01), 0.001, []),
        ((0.049, 0.001), (0.049, 0.001), 0.049, []),
        ((0.9, 0.001), (0.0, 0.0), 0.001, ["disagree by 0.900 mag"]),
        ((0.29, 0.1), (0.0, 0.0), 0.001, []),
        ((0.31, 0.1), (0.0, 0.0), 0.001, ["disagree by 0.310 mag"]),
        ((0.01, 0.01), (0.0, 0.0), 0.9, ["too noisy"]),
        ((0.01, 0.01), (0.051, 0.01), 0.001, ["changes by 0.051 +- 0.010 mag"]),
        ((0.01, 0.01), (-0.051, 0.01), 0.001, ["changes by 0.051 +- 0.010 mag"]),
        ((0.01, 0.01), (0.29, 0.1), 0.001, []),
        ((0.01, 0.01), (-0.29, 0.1), 0.001, []),
        ((0.01, 0.01), (-0.31, 0.1), 0.001, ["changes by 0.310 +- 0.100 mag"]),
        ((0.9, 0.01), (0.9, 0.1), 0.9, ["disagree", "too noisy", "changes by 0.900"]),
    ],
)
def test_a_scale_that_stars_contradict_says_by_how_much(scatter, over_light, error_mag, words):
    contradictions = _contradictions(scatter, over_light, error_mag)
    assert len(contradictions) == len(words)
    for contradiction, word in zip(contradictions, words, strict=True):
        assert word in contradiction


@pytest.mark.parametrize("sign", [-1, 1])
def test_the_psf_of_the_focus_counts_where_it_contradicts_the_bench_file(tmp_path, sign):
    """Within two of its errors it is the bench file's, narrower or wider; unmeasured, too."""

    def agreed_px(measured_px: float, **error: float) -> float:
        known = {"focus.psf_sigma_px": measured_px} | error
        step = closed_context(tmp_path, ClosedCamera(), known=known)
        return step.agreed_psf_sigma_px

    error = {"focus.psf_sigma_error_px": 0.1}
    assert agreed_px(SIGMA_PX + 0.19 * sign, **error) == SIGMA_PX
    assert agreed_px(SIGMA_PX + 0.21 * sign, **error) == SIGMA_PX + 0.21 * sign
    assert agreed_px(SIGMA_PX + 0.9 * sign) == SIGMA_PX


def dots(count: int, rng, size_px=(160, 90)) -> DotLight:
    """Dots at random pixels."""
    x = rng.integers(0, size_px[0], count)
    y = rng.integers(0, size_px[1], count)
    return DotLight(x, y, np.ones(count), 0.001)


@pytest.mark.parametrize("shape", [(1, 1), (2, 4), (3, 5)])
def test_a_map_s_weights_are_those_that_draw_it(shape, rng):
    at = dots(60, rng)
    rows, columns = shape
    field = rng.uniform(0.5, 1, shape)
    image = weights_of_grid(90, rows) @ field @ weights_of_grid(160, columns).T
    np.testing.assert_allclose(_design(at, shape, (160, 90)) @ field.ravel(), image[at.y, at.x])


def test_neighbouring_fields_are_joined_once_each():
    penalty = _smoothness((2, 3))
    field = np.array([[1.0, 4.0, 9.0], [1.0, 2.0, 0.0]])
    squares = 3**2 + 5**2 + 1**2 + 2**2 + 0**2 + 2**2 + 9**2
    assert field.ravel() @ penalty @ field.ravel() == pytest.approx(JOINED * squares)
    assert not penalty.sum(axis=0).any()


def test_a_field_without_dots_follows_its_neighbours_and_none_is_dark(rng):
    at = dots(200, rng)
    left = at.x < 40
    at = DotLight(at.x[left], at.y[left], at.light[left], 0.001)
    light = 0.8 + 0.001 * at.x
    field = _fitted(light, _design(at, (2, 4), (160, 90)), (2, 4)).reshape(2, 4)
    # fields' middles are 20, 60, 100 and 140 px; those beyond the dots are as the last one known
    np.testing.assert_allclose(field[:, 0], 0.82, atol=0.005)
    np.testing.assert_allclose(field[:, 3], field[:, 2], atol=0.005)
    assert field.min() >= light.min() / 2


@pytest.mark.parametrize(("square", "error"), [(0.5, 0.2), (0.1, 0.4), (-0.6, 0.3), (0.0, 1.0)])
def test_a_square_that_cannot_be_negative_is_the_mean_of_a_cut_normal(square, error):
    cut = stats.truncnorm((0 - square) / error, math.inf, loc=square, scale=error)
    assert _not_negative(square, error) == pytest.approx(cut.mean(), rel=1e-9)
    assert _not_negative(square, 0.0) == max(square, 0.0)


def test_a_map_is_surely_worse_from_two_standard_errors_on(rng):
    others = rng.uniform(size=100)
    noise = rng.normal(size=100)
    noise -= noise.mean()
    noise /= noise.std()
    # the mean's standard error is a tenth
    assert _is_surely_larger(others + noise + 0.21, others)
    assert not _is_surely_larger(others + noise + 0.19, others)


def test_a_map_s_figures_are_of_the_dots_that_are_used():
    light = np.array([1.0, 0.8, 0.5, 9.0])
    used = np.array([True, True, True, False])
    made = UniformityMap(np.ones((2, 2)), light, 0.05, 1e-9, used, 0.01, 0.02)
    assert made.darkest_of_brightest == 0.5
    assert made.rms_mag == pytest.approx(np.std(2.5 * np.log10(light[:3])))
    # held-out dots differ by 0.05 mag: 0.03 by noise, 0.01 by the fit, the rest by its form
    form_mag = math.sqrt(0.05**2 - 0.03**2 - 0.01**2)
    assert made.error_mag(0.03) == pytest.approx(math.hypot(0.01, form_mag), rel=1e-4)
    # a finer map that shows more counts where that is larger
    assert made.error_mag(0.049) == pytest.approx(math.hypot(0.01, 0.02), rel=1e-3)
    # three times their noise is far, and 0.01 mag where that is more
    assert (made.is_far(0.0166), made.is_far(0.0167)) == (True, False)
    for left_mag, is_far in ((0.0101, True), (0.0099, False)):
        assert replace(made, left_mag=left_mag).is_far(0.001) == is_far


def test_dots_are_drawn_as_much_fainter_as_they_are_than_the_brightest_place_and_the_map(
    tmp_path, figures
):
    """Seven dots, of which the faintest is on a dead pixel and not drawn."""
    faint_mag = np.array([0.3, 0.0, 0.1, 0.2, 0.4, 0.5, 5.0])
    off_mag = np.array([0.01, -0.02, 0.0, 0.03, -0.04, 0.05, 0.0])
    used = faint_mag < 1
    x, y = np.arange(7) * 10, np.arange(7) * 3 + 1
    # relative to the median dot, of 0.3 mag
    at_dots = 10 ** (-0.4 * (faint_mag - 0.3 - off_mag))
    made = UniformityMap(np.ones((2, 2)), at_dots, 0.05, 1e-9, used, 0.01, 0.02)
    seen = DotLight(x, y, 700 * 10 ** (-0.4 * faint_mag), 0.002)
    draw_uniformity(tmp_path / "light", seen, made, "a finding")
    brightest_mag = (faint_mag - 0.3 - off_mag)[used].min()
    wanted = [(faint_mag - 0.3 - brightest_mag)[used], off_mag[used]]
    for axes, drawn_mag in zip(figures[0].axes, wanted, strict=False):
        (points,) = axes.collections
        np.testing.assert_array_equal(points.get_offsets(), np.stack([x, y], axis=1)[used])
        np.testing.assert_allclose(points.get_array(), drawn_mag, atol=1e-12)
        # a few outliers do not set the scale
        assert points.get_clim() == pytest.approx(np.percentile(drawn_mag, (0.5, 99.5)))
        assert axes.yaxis_inverted()


def test_dots_shown_are_squares_about_their_lattice():
    codes = _shown([4, 6], 8, 200, (40, 30))
    rows, columns = np.nonzero(codes)
    # three pixels wide about every eighth, from the first on
    assert set(columns.tolist()) == {x + off for x in (4, 12, 20, 28, 36) for off in (-1, 0, 1)}
    assert set(rows.tolist()) == {y + off for y in (6, 14, 22) for off in (-1, 0, 1)} | {29}
    assert set(codes[codes > 0].tolist()) == {200}


def test_dots_determine_a_map_s_fields_where_each_has_many(rng):
    at = dots(3000, rng)
    maps = _Maps.of(at, np.ones(3000), (160, 90))
    for place, (rows, columns) in enumerate(maps.shapes[:3]):
        # of a thousandth's weight on a join: 3 dots of 3000 at most
        assert maps.freedom(place) == pytest.approx(rows * columns, rel=1e-3)
    few = _Maps.of(DotLight(at.x[:6], at.y[:6], at.light[:6], 0.1), np.ones(6), (160, 90))
    assert few.shapes == [(1, 1)]


def test_places_are_off_by_their_distance_in_pixels_and_in_arcsec():
    residual_px = np.array([[0.3, 0.4], [0.0, -1.0], [0.0, 0.0], [1.2, 0.5]])
    place_noise_px = np.full(4, 0.2)
    seen = stars_seen(residual_px=residual_px, place_noise_px=place_noise_px, lost=3, frames=2)
    beyond = seen.beyond_px
    figures = _place_figures(seen, 5000.0)
    rms_px = math.sqrt((0.25 + 1 + 1.69) / 4)
    assert figures["star_rms_px"] == pytest.approx(rms_px)
    assert figures["star_rms_arcsec"] == pytest.approx(rms_px / 5000 * 206264.806)
    assert (figures["star_max_px"], figures["lost"]) == (pytest.approx(1.3), 3)
    # two axes: the root of 2, and the 95 % of a Rayleigh distribution
    assert figures["star_noise_px"] == pytest.approx(0.2 * math.sqrt(2))
    p95 = stats.rayleigh.ppf(0.95)
    assert figures["star_beyond_noise_p95_px"] == pytest.approx(beyond.sigma * p95, rel=1e-4)
    assert figures["star_beyond_noise_max_px"] == pytest.approx(beyond.high * p95, rel=1e-4)


@pytest.mark.parametrize(("low", "high"), [(-4.0, 10.0), (2.0, 5.0)])
def test_a_figure_is_at_an_end_within_a_thousandth_of_that(low, high):
    for value, is_at_end in (
        (low, True),
        (low + 0.9e-3 * abs(low), True),
        (low + 1.1e-3 * abs(low), False),
        ((low + high) / 2, False),
        (high - 1.1e-3 * high, False),
        (high - 0.9e-3 * high, True),
        (high, True),
    ):
        assert FittedFigure("power", value, low, high).is_at_end == is_at_end


@pytest.mark.parametrize(("rms_mag", "is_even"), [(0.0019, True), (0.0021, False)])
def test_light_is_even_where_it_varies_by_less_than_a_star_s_error(rms_mag, is_even):
    """Of a map of six fields; one of a single field always is."""
    fields = 10 ** (-0.4 * rms_mag * np.array([-1.0, 1.0, -1.0, 1.0]))
    used = np.ones(4, dtype=bool)
    of_six = UniformityMap(np.ones((2, 3)), fields, 0.0, 0.0, used, 0.0, 0.0)
    assert of_six.rms_mag == pytest.approx(rms_mag)
    assert of_six.is_even == is_even
    assert UniformityMap(np.ones((1, 1)), fields**9, 0.0, 0.0, used, 0.0, 0.0).is_even


@pytest.mark.parametrize(
    ("psf_px", "screen_px", "period"),
    [
        # dots of a sigma of 0.83 px: 16 of them and 26.5 px of the monitor
        (0.7, (640, 480), 28),
        # of 0.47 px: ten px of the tracker, 20 of the monitor
        (0.2, (640, 480), 20),
        # 64 dots along the longer side: 30 px
        (0.2, (1080, 1920), 30),
        (0.2, (1080, 1921), 32),
    ],
)
def test_a_lattice_has_dots_apart_and_not_too_many(psf_px, screen_px, period):
    """Half a pixel of the tracker's to one of the monitor's, and dots of three."""
    geometry = BenchGeometry(camera(screen_px, 1600.0), camera((400, 300), 800.0))
    spacing = spacing_for(geometry, psf_px)
    sigma_px = math.hypot(psf_px, 1.5 / math.sqrt(12))
    assert spacing.sigma_px == pytest.approx(sigma_px)
    assert spacing.period == period
    assert spacing.reach == pytest.approx(min(period / 4, 9 * sigma_px))


def test_where_light_is_called_even_what_its_map_has_is_an_error():
    """Maps of 0.0015 mag, less than is worth a map: their standard deviation adds to the error of
    the map that the bench file then has.
    """
    even = 10 ** (-0.4 * 0.0015 * np.tile([1.0, -1.0], 20))
    used = np.ones(40, dtype=bool)
    uneven = UniformityMap(np.ones((2, 2)), even**20, 0.005, 0.0, used, 0.007, 0.0)
    called_even = UniformityMap(np.ones((2, 2)), even, 0.0005, 0.0, used, 0.001, 0.0)
    noise_mag = 0.002
    with_map_mag = math.hypot(0.001, 0.0015)
    for light_map, against, wanted_mag in (
        # the bench file has it so
        (uneven, called_even, with_map_mag),
        # it has a map, which goes
        (called_even, uneven, with_map_mag),
        (uneven, uneven, uneven.error_mag(noise_mag)),
    ):
        found_mag = known_error_mag(light_map, against, noise_mag)
        assert found_mag == pytest.approx(wanted_mag)


def test_each_primary_s_share_is_of_all_channels(tmp_path):
    """Channels of an efficiency of their own, even over the spectrum, have of each primary what it
    has of photons, of all three.
    """
    nm = np.arange(400.0, 701.0, 10.0)
    spectra = [bump(middle, 30, nm) for middle in (620, 540, 460)]
    write_panel(tmp_path / "panel.csv", spectra, nm)
    efficiencies = {"r": 0.2, "g": 0.5, "b": 0.3}
    curves = {name: np.full_like(nm, share) for name, share in efficiencies.items()}
    keys = write_channels(tmp_path, nm, curves) | {"transmission": 1.0}
    primaries = {"file": "panel.csv", "layout": "rgb-stripe"}
    bench = {"tracker": keys, "monitor.primaries": primaries}
    shares = shares_of_white(closed_context(tmp_path, ClosedCamera(), bench).file)
    photons = np.array(spectra) @ nm
    # the spectra end at 400 and 700 nm, where a bump of 460 nm is not over
    assert shares / shares.sum() == pytest.approx(photons / photons.sum(), rel=3e-3)


def made_photometer(folder, camera: ClosedCamera | None = None, **changes) -> Photometer:
    """A photometer of white light on the closed bench."""
    context = closed_context(folder, camera or ClosedCamera(), **changes)
    return Photometer(context, SIGMA_PX, Assumed({"w": power_of(2.2)}, 0.0))


def test_a_hot_pixel_does_not_fill_a_range(tmp_path):
    photometer = made_photometer(tmp_path)
    photometer._cold[3, 5] = False
    part = np.full(photometer._cold.shape, 0.1 * FULL_DN)
    part[3, 5], part[5, 3] = 0.9 * FULL_DN, 0.25 * FULL_DN
    assert photometer._filled(part) == pytest.approx(0.25)


@pytest.mark.parametrize(("times", "name"), [(1, "patch"), (4, "patch_4"), (16, "patch_16")])
def test_an_image_is_named_by_its_longer_exposure(tmp_path, times, name):
    camera = ClosedCamera()
    photometer = made_photometer(tmp_path, camera)
    path = photometer._take("patch", Range(4, times), Patch(100, "w"))
    assert camera.taken[-1] == (name, EXPOSURE_S * times)
    assert photometer.images[-1] == path


def test_light_that_rounding_hides_has_shot_noise(tmp_path):
    """Light of -3 DN is none, of 50 DN is that, and each has what rounding hides of it. Black images
    have a variance of 16 DN^2, light 0.25 DN an electron.
    """
    photometer = made_photometer(tmp_path)
    photometer.scatter = PixelScatter(default_dn_per_e=0.25)
    for off_dn in (0.0, math.sqrt(32.0)):
        photometer.scatter.add(BLACK, Range(1, 4), np.array([[off_dn]]))
    patches = [Patch(5, "w"), Patch(9, "w"), BLACK, BLACK]
    at = Range(2, 4)
    lights_dn = (-3.0, 50.0)
    lit = {}
    for order, light_dn in enumerate(lights_dn):
        lit[order] = _Reading(patches[order], at, light_dn, blacks=0.5)
    values = photometer._values(patches, lit, np.array([5.0, 15.0]), {("w", at): 2.0})
    dots_s = photometer.field.lit(2) * 4 * 2.0 * EXPOSURE_S
    screen_s = photometer.field.monitor_px * EXPOSURE_S
    np.testing.assert_allclose(
        values.light, [-3 / dots_s, 50 / dots_s, -5 / screen_s, 5 / screen_s]
    )
    for order, light_dn in enumerate(lights_dn):
        hidden_dn = math.sqrt(float((photometer._rounded(at, light_dn) ** 2).mean()))
        assert hidden_dn > 0
        variance = 0.25 * (max(light_dn, 0.0) + hidden_dn) + 1.5 * 16
        assert values.sigma[order] == pytest.approx(math.sqrt(variance) / dots_s)
    np.testing.assert_allclose(values.sigma[2:], 4 / screen_s)


def test_what_the_lowest_code_adds_is_less_by_what_it_adds_to_a_ratio(tmp_path):
    """Dark images of 0 DN, whose noise an ADC cuts at its lowest code."""
    photometer = made_photometer(tmp_path)
    photometer.scatter = PixelScatter(default_dn_per_e=0.25)
    photometer.scatter.add(BLACK, Range(1), np.zeros((2, 2)))
    patch, at, less = Patch(100, "w"), Range(1), Range(4)
    added_dn = [photometer._cut_dn(*lit) for lit in ((at, 200.0), (at, 1000.0), (less, 100.0))]
    # light takes noise off the lowest code
    assert max(added_dn) < 0
    pair = _Pair(patch, at, less, (1000.0, 100.0), (1.0,))
    link = LatticeRatio(patch, 1, 4, 1.0)
    values = _Values(np.array([0.0, 5.0]), np.ones(2), np.array([0.0, 0.5]))
    lit = {1: _Reading(patch, at, 200.0, 1.0)}
    effect = photometer._of_cut(values, lit, [pair], [link])
    of_ratio = added_dn[1] / 1000 - added_dn[2] / 100
    np.testing.assert_allclose(effect, [0.0, added_dn[0] * 0.5 - 5 * of_ratio])


@pytest.mark.parametrize(
    ("folder", "name"), [("", "s/geometry.toml"), ("other", "../s/geometry.toml")]
)
def test_a_file_is_named_from_the_bench_file_s_folder(tmp_path, folder, name):
    (tmp_path / folder).mkdir(exist_ok=True)
    context = replace(closed_context(tmp_path / folder, ClosedCamera()), session=tmp_path / "s")
    (change,) = context.names("collimator", "geometry", tmp_path / "s" / "geometry.toml")
    assert (change.table, change.key, change.after) == ("collimator", "geometry", name)
    assert change.before is None
    (again,) = context.change("monitor", "bits", 12)
    assert (again.before, again.after) == (BITS, 12)
