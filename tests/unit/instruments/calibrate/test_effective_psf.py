"""The parts of an effective PSF, each against a closed form: its Gaussian and its spline, the dots'
sides, their cut-outs and scatter, and where a glass has its centroids.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import ndtr

from hilstar.basics.errors import InputError
from hilstar.instruments.calibrate import effective_psf
from hilstar.instruments.calibrate.effective_psf import (
    KNOT_PX,
    MAX_HALF_PX,
    POINTS,
    QUANTISED_DN2,
    Dots,
    Effective,
    Found,
    HeldOut,
    _dot_sides,
    _functions,
    _glass,
    _half_px,
    _held_out,
    _knots,
    _of_frames,
    _placed,
    _Places,
    _rms,
    _spline,
    _Sums,
    _variance,
    are_alone,
    cut_out,
    dots_of_image,
    draw_effective,
    fit_effective,
    lines_of,
    summary_of,
)
from hilstar.instruments.calibrate.geometric.dots import DOT_PX
from hilstar.instruments.calibrate.geometric.fit import MatchedDots
from hilstar.instruments.calibrate.geometric.observed import Observed
from hilstar.server.bench.frame_files import png_of

ROUNDING = 1e-9  # of sums of a few thousand doubles
SIDE_PX = 0.8
MIDDLE_PX = np.array([50.0, 40.0])


def effective(covariance, knots_px=(), spline=None) -> Effective:
    """A PSF about the middle of a field of 100 px."""
    if spline is None:
        spline = np.zeros((0, 0, 0))
    return Effective(MIDDLE_PX, 50.0, np.array(covariance), np.array(knots_px), spline)


def reach(half_px: int, count: int = 1) -> np.ndarray:
    """Offsets of pixels (count, side)."""
    return np.tile(np.arange(-half_px, half_px + 1.0), (count, 1))


def test_a_gaussian_of_a_place_has_the_variance_of_its_polynomials():
    model = effective([[1.0, 0.5, 0.0], [0.4, 0.0, 0.0], [0.0, 0.2, 0.0]])
    x_px = np.array([50.0, 75.0, 50.0])
    y_px = np.array([40.0, 40.0, 90.0])
    offsets = reach(12, 3)
    shares = model.of(x_px, y_px, (offsets, offsets), np.full(3, SIDE_PX))
    light = shares.sum(axis=(1, 2))
    np.testing.assert_allclose(light, 1.0, atol=ROUNDING)
    # a pixel and a dot are squares: each adds a twelfth of its area
    squares_px2 = (1 + SIDE_PX**2) / 12
    across = shares.sum(axis=1) @ offsets[0] ** 2 - squares_px2
    down = shares.sum(axis=2) @ offsets[0] ** 2 - squares_px2
    # the variance of a Gaussian's samples is that of the Gaussian to exp(-2 pi^2 sigma^2)
    aliased_px2 = 2e-3
    np.testing.assert_allclose(across, [1.0, 1.2, 1.0], atol=aliased_px2)
    np.testing.assert_allclose(down, [0.5, 0.5, 0.7], atol=aliased_px2)


@pytest.mark.parametrize("side_px", [0.0, 0.8, 1.7])
def test_a_spline_s_functions_add_up_to_polynomials(side_px):
    knots_px = KNOT_PX * np.arange(-16, 17)
    offsets = np.linspace(-2.0, 2.0, 9)[None]
    side = np.array([side_px])
    functions = _functions(knots_px, offsets, side)[0]
    # cubic B-splines of step h: sums over knots are 1, x and x^2 + h^2 / 3; a square's mean of x^2
    # is a twelfth of its side's square more
    square_px2 = offsets[0] ** 2 + KNOT_PX**2 / 3 + side_px**2 / 12
    tolerance = 1e-6  # a side of 0 is taken as one of 0.001 px
    np.testing.assert_allclose(functions.sum(axis=1), 1.0, atol=tolerance)
    np.testing.assert_allclose(functions @ knots_px, offsets[0], atol=tolerance)
    np.testing.assert_allclose(functions @ knots_px**2, square_px2, atol=tolerance)


def test_a_spline_s_rows_go_down_and_its_columns_across():
    knots_px = KNOT_PX * np.arange(-12, 13)
    # coefficients that are their row's place give the place down
    spline = np.repeat(knots_px[:, None], len(knots_px), axis=1)[None]
    model = effective([[1.0, 1.0, 0.0]], knots_px, spline)
    plain = effective([[1.0, 1.0, 0.0]])
    offsets = reach(2)
    place = np.array([50.0]), np.array([40.0])
    side = np.array([SIDE_PX])
    beside = model.of(*place, (offsets, offsets), side) - plain.of(*place, (offsets, offsets), side)
    np.testing.assert_allclose(beside[0], np.repeat(offsets.T, 5, axis=1), atol=1e-6)


def matched(x_px: np.ndarray, y_px: np.ndarray, dot: np.ndarray) -> MatchedDots:
    """Centroids of dots in one image."""
    none = np.zeros(len(dot), dtype=np.intp)
    return MatchedDots(Observed(none, none, x_px, y_px, np.ones(len(dot))), dot)


@pytest.mark.parametrize(
    "matrix", [[[2.0, 0.0], [0.0, 0.5]], [[0.0, -2.0], [2.0, 0.0]], [[1.5, 0.7], [-0.3, 0.9]]]
)
@pytest.mark.parametrize("count", [20, 60])
def test_a_dot_s_side_is_the_root_of_its_map_s_area(matrix, count, rng):
    x_px, y_px = rng.uniform(0, 200, size=(2, count))
    tracker_px = np.array(matrix) @ np.stack([x_px, y_px])
    dot = rng.permutation(count)
    inverse = np.argsort(dot)
    data = matched(*tracker_px, dot)
    sides_px = _dot_sides(data, x_px[inverse], y_px[inverse])
    wanted_px = DOT_PX * np.sqrt(abs(np.linalg.det(matrix)))
    np.testing.assert_allclose(sides_px, wanted_px, rtol=1e-6)


def test_a_dot_s_side_grows_with_the_field_s_own_scale(rng):
    u, v = rng.uniform(-100, 100, size=(2, 80))
    # monitor px by tracker px: d(x)/du = 1 + u / 200, d(y)/dv = 1
    x_px = u + u**2 / 400

    sides_px = _dot_sides(matched(u, v, np.arange(80)), x_px, v)
    np.testing.assert_allclose(sides_px, DOT_PX / np.sqrt(1 + u / 200), rtol=1e-6)


def test_a_cut_out_is_about_its_dot_and_has_nothing_beyond_an_edge():
    row, column = np.indices((60, 80), dtype=float)
    image = 1000 * row + column
    x_px = np.array([30.4, 79.0])
    y_px = np.array([20.6, 0.0])
    places = _Places.of(x_px, y_px, np.ones(2))
    inner, corner = places.cutouts(image, np.array([0, 1]))
    side = np.arange(-MAX_HALF_PX, MAX_HALF_PX + 1)
    np.testing.assert_array_equal(inner, 1000 * (21 + side[:, None]) + 30 + side)
    assert np.isnan(corner[:MAX_HALF_PX]).all()
    assert np.isnan(corner[:, MAX_HALF_PX + 1 :]).all()
    np.testing.assert_array_equal(
        corner[MAX_HALF_PX:, : MAX_HALF_PX + 1],
        1000 * np.arange(MAX_HALF_PX + 1)[:, None] + 79 + side[: MAX_HALF_PX + 1],
    )


def test_dots_are_alone_where_no_square_reaches_another():
    wide_px = 2.0 * MAX_HALF_PX
    x_px = np.array([0.0, wide_px + 0.1, 0.0, 200.0, 200.0 + wide_px - 0.1, 500.0])
    y_px = np.array([0.0, 0.0, wide_px + 0.1, 0.0, wide_px - 0.1, 0.0])
    assert are_alone(x_px, y_px, MAX_HALF_PX).tolist() == [True, True, True, False, False, True]
    assert are_alone(np.array([3.0]), np.array([4.0]), MAX_HALF_PX).tolist() == [True]
    assert not len(are_alone(np.zeros(0), np.zeros(0), MAX_HALF_PX))
    # two at one place have no room beside each other
    assert not are_alone(np.zeros(2), np.zeros(2), MAX_HALF_PX).any()


def test_pixels_scatter_by_their_light_as_the_frames_of_a_dot_do():
    light = np.linspace(0, 400, 25 * 9).reshape(9, 5, 5)
    mean = light + 7.0
    frames = np.full(9, 4.0)
    frames[0] = 1.0  # one frame tells no scatter
    level = np.median(mean)
    # the scatter of n frames about their mean is short by (n - 1) / n
    truth = 3.0 + 0.25 * np.clip(mean - level, 0, None)
    variance = _variance(mean, truth * 3 / 4, frames)
    dim = truth[(mean - level) < np.median((mean - level)[1:]) + 0.1 * np.ptp(mean[1:])]
    bright = mean > level + 100
    # the floor is the mean of the dim ones: below a tenth of the range, 0.25 * 40 DN over it
    assert 3.0 <= variance.min() <= dim.max()
    np.testing.assert_allclose(variance[bright], truth[bright], rtol=0.02)
    alone = _variance(mean, np.zeros_like(mean), np.ones(9))
    edge = np.concatenate([mean[:, 0].ravel(), mean[:, -1].ravel()])
    np.testing.assert_allclose(alone, edge.var() + QUANTISED_DN2)


def gaussian_image(x_px, y_px, sigma_px: float, flux: float, oval: float = 1.0) -> np.ndarray:
    """Light of Gaussians integrated over pixels (200, 300), by erf; `oval` times as high as wide."""
    image = np.zeros((200, 300))
    for x, y in zip(x_px, y_px, strict=True):
        across = np.diff(ndtr((np.arange(301) - 0.5 - x) / sigma_px))
        down = np.diff(ndtr((np.arange(201) - 0.5 - y) / (oval * sigma_px)))
        image += flux * np.outer(down, across)
    return image


def field_of_dots(flux: float = 1e4) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Light of dots 40 px apart, and their places, all at other places within a pixel."""
    grid_x, grid_y = np.meshgrid(np.arange(20, 290, 40.0), np.arange(20, 190, 40.0))
    x_px = grid_x.ravel() + np.linspace(-0.4, 0.4, grid_x.size)
    y_px = grid_y.ravel() + np.linspace(0.3, -0.3, grid_x.size)
    return gaussian_image(x_px, y_px, 1.0, flux), x_px, y_px


def test_dots_of_an_image_are_as_wide_as_their_light_and_the_edge_cuts_none():
    image, x_px, y_px = field_of_dots()
    near_edge = np.append(x_px, 295.0), np.append(y_px, 100.0)
    dots = dots_of_image(image, *near_edge, SIDE_PX)
    assert len(dots.x_px) == len(x_px)
    half_px = dots.images.shape[1] // 2
    # a pixel 4 px away has 2.9e-5 of the light, under 3e-4 of the middle's 0.147; one 3 px away
    # 1.0e-3: two pixels more
    assert half_px == 5
    across, down = dots.offsets
    k = 7
    shares = np.outer(
        ndtr(down[k] + 0.5) - ndtr(down[k] - 0.5), ndtr(across[k] + 0.5) - ndtr(across[k] - 0.5)
    )
    np.testing.assert_allclose(dots.images[k], 1e4 * shares, atol=1e-6)
    with pytest.raises(InputError, match="0 dots stand alone"):
        dots_of_image(image, x_px[0] + np.arange(9), np.full(9, y_px[0]), SIDE_PX)


@pytest.mark.parametrize("frames", [1, 4, 9])
def test_the_mean_of_frames_is_as_noisy_as_their_number_says(frames, rng):
    image, x_px, y_px = field_of_dots()
    places = _Places.of(x_px, y_px, np.full(len(x_px), SIDE_PX))
    sums = _Sums.none(len(x_px))
    every = np.arange(len(x_px))
    for _ in range(frames):
        frame = image + rng.normal(0, 2.0, image.shape)
        sums.add(every, places.cutouts(frame, every))
    dots = _of_frames(sums, places)
    # one frame tells its noise by the squares' edges, and what the codes round beside it
    one_dn2 = 4.0 if frames > 1 else 4.0 + QUANTISED_DN2
    assert float(dots.variance.mean()) == pytest.approx(one_dn2 / frames, rel=0.1)


def test_a_square_ends_two_pixels_beyond_the_last_light():
    images = np.zeros((3, 25, 25))
    images[:, 12 - 5 : 12 + 6, 12 - 5 : 12 + 6] = 10.0
    none = np.zeros(3)
    middle = np.zeros(3, dtype=np.intp)
    dots = Dots(images, np.full_like(images, 1e-4), middle, middle, none, none, none)
    assert _half_px(dots) == 7


@pytest.mark.parametrize(("half_px", "side_px", "last_px"), [(6, 1.0, 5.0), (4, 0.0, 3.5)])
def test_a_spline_s_knots_end_where_their_functions_do_at_the_image_s_edge(
    half_px, side_px, last_px
):
    side = 2 * half_px + 1
    images = np.zeros((3, side, side))
    none = np.zeros(3)
    middle = np.zeros(3, dtype=np.intp)
    dots = Dots(images, images, middle, middle, none, none, np.full(3, side_px))
    knots_px = _knots(dots)
    # half of the image's side, less the dot's and two steps of a function
    assert knots_px[-1] == last_px
    np.testing.assert_allclose(np.diff(knots_px), KNOT_PX)
    np.testing.assert_allclose(knots_px, -knots_px[::-1])


def test_dots_are_moved_to_where_their_light_is_with_flux_and_background():
    image, x_px, y_px = field_of_dots()
    off_px = 0.05
    dots = dots_of_image(image + 30.0, x_px + off_px, y_px - 2 * off_px, 0.0)
    model = effective([[1.0, 1.0, 0.0]])
    placed, _, amplitudes = _placed(model, dots)
    # Newton's one step leaves the square of the way
    np.testing.assert_allclose(placed.x_px, x_px, atol=3 * off_px**2)
    np.testing.assert_allclose(placed.y_px, y_px, atol=3 * (2 * off_px) ** 2)
    np.testing.assert_allclose(amplitudes[:, 0], 1e4, rtol=2 * off_px**2 + 0.02)
    np.testing.assert_allclose(amplitudes[:, 1], 30.0, atol=5.0)


def test_a_glass_has_its_centroids_in_the_middle_wherever_the_model_has_them():
    knots_px = KNOT_PX * np.arange(-6, 7)
    spline = np.zeros((1, len(knots_px), len(knots_px)))
    spline[0, 8, 3] = 0.05  # light 1 px down and 1.5 px left of the middle
    model = effective([[0.6, 0.8, 0.0]], knots_px, spline)
    place_px = np.array([[10.0, 5.0], [90.0, 75.0]])
    per_px = 4
    glass = _glass(model, place_px, 5, per_px)
    assert len(glass.places_px) == POINTS**2
    np.testing.assert_allclose(glass.places_px.min(axis=0), place_px[0])
    np.testing.assert_allclose(glass.places_px.max(axis=0), place_px[1])
    image = glass.images[0, 0, 0]
    steps_px = (np.arange(image.shape[0]) - image.shape[0] // 2) / per_px
    light = image.sum()
    assert image.sum(axis=0) @ steps_px / light == pytest.approx(0.0, abs=2e-3)
    assert image.sum(axis=1) @ steps_px / light == pytest.approx(0.0, abs=2e-3)
    # of two parts d apart: w (1 - w) ((1 - 2 w) d^3 + 3 d (their variances' difference))
    spline_light = 0.05 * KNOT_PX**2
    w = spline_light / (1 + spline_light)
    for axis, off_px, variance_px2 in ((0, -1.5, 0.6), (1, 1.0, 0.8)):
        # the Gaussian is integrated over pixels, the spline is what pixels get
        wider_px2 = KNOT_PX**2 / 3 - variance_px2 - 1 / 12
        third_px3 = w * (1 - w) * ((1 - 2 * w) * off_px**3 + 3 * off_px * wider_px2)
        seen_px3 = image.sum(axis=axis) @ steps_px**3 / light
        assert seen_px3 == pytest.approx(third_px3, rel=0.05)


def test_dots_are_held_against_a_model_of_the_others_alone():
    image, x_px, y_px = field_of_dots()
    dots = dots_of_image(image, x_px, y_px, 0.0)
    fold = np.arange(len(x_px)) % 4
    # all are of 1 px^2, and those of the first fold are said to be of 2
    covariance = np.tile([1.0, 1.0, 0.0], (len(x_px), 1))
    covariance[fold == 0, :2] = 2.0
    held = _held_out(effective(np.zeros((1, 3))), dots, covariance, fold, 0)
    assert held.name == "Gaussian"
    is_first = fold == 0
    # a model of the others is right, and one that has the first is not
    assert held.chi2[is_first].max() < 1e-3 * held.chi2[~is_first].min()


@pytest.mark.parametrize("noise_dn", [0.5, 2.0])
def test_a_spline_follows_light_beside_the_gaussian_where_it_is_over_the_noise(noise_dn):
    image, x_px, y_px = field_of_dots()
    ghost = gaussian_image(x_px + 2, y_px, 0.7, 400.0)
    dots = dots_of_image(image + ghost, x_px, y_px, 0.0)
    dots = replace(dots, variance=np.full_like(dots.images, noise_dn**2))
    knots_px = _knots(dots)
    gaussian = effective([[1.0, 1.0, 0.0]], knots_px)
    amplitudes = np.column_stack([np.full(len(x_px), 1e4), np.zeros(len(x_px))])
    spline = _spline(gaussian, dots, amplitudes, 1)
    model = replace(gaussian, spline=spline)
    beside = model.of(dots.x_px, dots.y_px, dots.offsets, dots.side_px)
    beside -= gaussian.of(dots.x_px, dots.y_px, dots.offsets, dots.side_px)
    # 4 % of the light, 2 px to the right; to the image's edge it has most of it
    assert beside.sum(axis=(1, 2)) == pytest.approx(np.full(len(x_px), 0.04), rel=0.05)
    across_px = dots.offsets[0]
    middle_px = (beside.sum(axis=1) * across_px).sum(axis=1) / beside.sum(axis=(1, 2))
    assert middle_px == pytest.approx(np.full(len(x_px), 2.0), abs=0.1)


def test_errors_of_dots_that_are_held_out_are_beside_their_brightest_pixels():
    """Of a model that is 1.3 px^2 wide before dots of 1: by its share of a pixel and theirs."""
    image, x_px, y_px = field_of_dots()
    dots = dots_of_image(image, x_px, y_px, 0.0)
    dots = replace(dots, variance=np.full_like(dots.images, 9.0))
    covariance = np.tile([1.3, 1.3, 0.0], (len(x_px), 1))
    held = _held_out(effective([[1.3, 1.3, 0.0]]), dots, covariance, np.arange(len(x_px)) % 4, 0)
    _, shares, amplitudes = _placed(effective([[1.3, 1.3, 0.0]]), dots)
    flux, background = amplitudes.T[:, :, None, None]
    off = dots.images - background - flux * shares
    brightest = (flux * shares).max(axis=(1, 2))
    np.testing.assert_allclose(held.chi2, (off**2).mean(axis=(1, 2)) / 9, rtol=0.02)
    rms = np.sqrt(np.mean((off**2).mean(axis=(1, 2)) / brightest**2))
    assert held.rms == pytest.approx(rms, rel=0.01)
    assert _rms(np.array([1.0, -7.0, 0.0])) == pytest.approx(np.sqrt(50 / 3))
    assert held.noise == pytest.approx(3 * np.sqrt(np.mean(brightest**-2.0)), rel=0.01)


@pytest.mark.parametrize("slope_dn", [0.3, 0.0, -0.1])
def test_a_variance_grows_with_light_or_is_the_dark_s(slope_dn):
    """Of four frames: 4/3 of their spread. Light that has less noise than none has no law."""
    mean = np.full((1, 5, 5), 7.0)
    mean[0, 2, 1:4] += [10.0, 20.0, 15.0]
    light = mean - 7.0
    spread = 0.75 * (3.0 + slope_dn * light)
    expected = 3.0 + max(slope_dn, 0.0) * light
    np.testing.assert_allclose(_variance(mean, spread, np.array([4.0])), expected, rtol=1e-12)


def test_few_dots_have_the_side_of_a_linear_map_whatever_their_noise(rng):
    """A cubic of ten terms would follow the noise of eleven dots."""
    x_px, y_px = rng.uniform(0, 200, size=(2, 11))
    noise_px = rng.normal(0, 0.3, size=(2, 11))
    data = matched(2 * x_px + noise_px[0], 2 * y_px + noise_px[1], np.arange(11))
    # a slope of eleven dots over 400 px is known to 0.3 px / 115 px / sqrt(11)
    np.testing.assert_allclose(_dot_sides(data, x_px, y_px), 2 * DOT_PX, rtol=0.01)


@pytest.mark.parametrize(("gain", "asks"), [(0.2, False), (0.4, True), (-0.4, False)])
def test_more_than_a_gaussian_is_asked_for_beyond_three_standard_errors(monkeypatch, gain, asks):
    """Of 35 dots whose chi squares differ by 0.6 from dot to dot: 0.1 of their mean."""
    x_px, y_px = field_of_dots()[1:]
    image = gaussian_image(x_px, y_px, 1.0, 1e4, oval=1.3)
    dots = dots_of_image(image, x_px, y_px, 0.0)
    off = np.linspace(-1, 1, len(x_px))
    off *= 0.6 / off.std(ddof=1)

    def held(start, dots, covariance, fold, count):
        """The linear spline is the best, by `gain`."""
        chi2 = np.full(len(fold), 2.0)
        if count:
            chi2 = chi2 - gain - off * np.sqrt(len(fold) / 36) + 0.05 * abs(count - 3)
        return HeldOut(effective_psf.MODEL_NAMES[count], 0.1, 0.1, chi2)

    monkeypatch.setattr(effective_psf, "_held_out", held)
    found = fit_effective(dots, 1)
    assert found.asks_for_more == asks
    wanted = "spline, linear over the field" if asks else "Gaussian"
    assert found.chosen.name == wanted
    assert len(found.models) == 4
    # a Gaussian is fitted to light that is one: 1 px wide and 1.3 px high
    assert found.sigma_px == pytest.approx((1.0, 1.3), abs=0.02)
    assert (found.dots, found.half_px) == (len(x_px), dots.images.shape[1] // 2)


def test_a_chosen_spline_has_its_own_terms_over_the_field(monkeypatch):
    """Light 2 px beside each dot that grows with its column: to the right of a Gaussian's."""
    image, x_px, y_px = field_of_dots()
    for x, y in zip(x_px, y_px, strict=True):
        image += gaussian_image([x + 2], [y], 0.7, 2.0 * x)
    dots = dots_of_image(image, x_px, y_px, 0.0).at(np.arange(0, len(x_px), 2))
    dots = replace(dots, variance=np.full_like(dots.images, 4.0))

    def held(start, dots, covariance, fold, count):
        """The linear spline, of three terms, is the best of those held out."""
        chi2 = np.linspace(1.0, 1.1, len(fold)) + abs(count - 3)
        return HeldOut(effective_psf.MODEL_NAMES[count], 0.1, 0.1, chi2)

    monkeypatch.setattr(effective_psf, "_held_out", held)
    glass = fit_effective(dots, 1).glass
    # points are sorted by x, then y
    left, middle, right = glass.images[[2, 12, 22], 0, 0].sum(axis=1)
    steps_px = np.arange(len(left)) - len(left) // 2
    thirds_px3 = [light @ steps_px**3 / light.sum() for light in (left, middle, right)]
    # in the middle, of two parts: see the test of a glass's centroids
    w = 0.028 / 1.028
    third_px3 = w * (1 - w) * ((1 - 2 * w) * 2.0**3 + 3 * 2.0 * (0.7**2 - 1))
    # The prior of a spline's coefficients takes up to a tenth, by which a constant would differ.
    assert thirds_px3[1] == pytest.approx(third_px3, rel=0.1)
    assert thirds_px3[0] < 0.5 * thirds_px3[1]
    assert thirds_px3[2] > 1.3 * thirds_px3[1]


def test_a_dot_s_image_is_the_mean_over_its_pose_s_frames_in_which_none_is_near(tmp_path):
    """Two poses of two frames; in each frame the dots have another level, in one a third dot is
    beside the first. The dark image is taken off all.
    """
    width, height = 260, 120
    places_px = np.stack(np.meshgrid([30.2, 80.0, 130.0, 180.0, 230.4], [30.0, 85.3]))
    x_px, y_px = places_px.reshape(2, -1)
    count = len(x_px)
    column, row = np.meshgrid(np.arange(width), np.arange(height))
    dark = (column + 3 * row).astype(np.uint16)
    paths = {}
    centroids = []
    for number, (frame, pose) in enumerate(((0, 0), (1, 0), (0, 1), (1, 1))):
        path = tmp_path / f"pose{pose}_frame_{frame}.png"
        path.write_bytes(png_of((dark + 1000 * (number + 1) + row).astype(np.uint16)))
        paths[frame, pose] = path
        # the second pose stands 2 px lower
        for dot in range(count):
            centroids.append((frame, pose, x_px[dot], y_px[dot] + 2 * pose, dot))
    near = (1, 0, x_px[0] + 9.0, y_px[0] + 9.0, count)
    # a frame of which no dot was recognised
    paths[2, 0] = tmp_path / "frame_2.png"
    frame, pose, seen_x_px, seen_y_px, dot = np.array([*centroids, near]).T
    observed = Observed(
        frame.astype(int), pose.astype(int), seen_x_px, seen_y_px, np.ones(len(dot))
    )
    data = MatchedDots(observed, dot.astype(int))
    dots = cut_out(paths, (width, height), dark.astype(float), data, 0.5 + 0.01 * dot)
    # the third dot is never alone
    assert len(dots.x_px) == 2 * count
    np.testing.assert_allclose(dots.x_px, np.tile(x_px, 2))
    np.testing.assert_allclose(dots.y_px, np.concatenate([y_px, y_px + 2]))
    np.testing.assert_allclose(dots.side_px, np.tile(0.5 + 0.01 * np.arange(count), 2))
    # beside the near one the first dot has the first frame alone; the second pose has frames of
    # 3000 and 4000 DN
    middles = dots.images[:, dots.images.shape[1] // 2, dots.images.shape[1] // 2]
    wanted_dn = np.repeat([1500.0, 3500.0], count) + np.rint(dots.y_px)
    wanted_dn[0] -= 500.0
    np.testing.assert_allclose(middles, wanted_dn)
    with pytest.raises(InputError, match="0 dots stand alone by 24 px in some frame"):
        cut_out({}, (width, height), None, data, dot)


def test_an_effective_psf_is_told_with_all_its_figures():
    glass = _glass(effective([[1.0, 1.2, 0.0]]), np.array([[10.0, 5.0], [90.0, 75.0]]), 4, 1)
    gaussian = HeldOut("Gaussian", 0.0123, 0.0045, np.array([1.0, 3.0]))
    spline = HeldOut("spline, linear over the field", 0.0061, 0.0046, np.array([0.5, 1.5]))
    found = Found(glass, [gaussian, spline], spline, True, (0.611, 0.722), 35, 5)
    assert lines_of(found) == [
        "dots                           35, each within 11 x 11 px",
        (
            "Gaussian                       sigma 0.611 and 0.722 px in the middle of the field,"
            " without dot and pixel"
        ),
        (
            "Gaussian                       1.23% of the peak off held-out dots (noise: 0.45%),"
            " reduced chi square 2.00"
        ),
        (
            "spline, linear over the field  0.61% of the peak off held-out dots (noise: 0.46%),"
            " reduced chi square 1.00"
        ),
        "chosen                         spline, linear over the field",
    ]
    figures = {"rms": 0.0061, "noise": 0.0046, "reduced_chi2": 1.0}
    first = {"name": "Gaussian", "rms": 0.0123, "noise": 0.0045, "reduced_chi2": 2.0}
    assert summary_of(found) == {
        "dots": 35,
        "half_px": 5,
        "sigma_px": [0.611, 0.722],
        "model": "spline, linear over the field",
        "more_than_gaussian": True,
        "held_out": figures,
        "models": [first, {"name": "spline, linear over the field", **figures}],
        "components": len(glass.basis),
    }
    plain = replace(found, chosen=gaussian, asks_for_more=False)
    assert lines_of(plain)[-1].endswith("Gaussian: the data ask for no more")


def test_psfs_are_drawn_where_they_are_in_the_field(tmp_path, monkeypatch):
    """Wider to the right, higher to the bottom."""
    drawn = []
    monkeypatch.setattr("hilstar.basics.charts.save", lambda figure, path: drawn.append(figure))
    model = effective([[1.0, 1.0, 0.0], [0.6, 0.0, 0.0], [0.0, 0.5, 0.0]])
    glass = _glass(model, np.array([[10.0, 5.0], [90.0, 75.0]]), 6, 1)
    gaussian = HeldOut("Gaussian", 0.0123, 0.0045, np.ones(2))
    draw_effective(tmp_path / "psf", Found(glass, [gaussian], gaussian, False, (1, 1), 9, 6))
    (figure,) = drawn
    (axes,) = figure.axes
    picture = axes.images[0].get_array() ** 2
    side = 13
    offset_px = np.arange(side) - side // 2
    widths = np.zeros((3, 3))
    heights = np.zeros((3, 3))
    for row in range(3):
        for column in range(3):
            light = picture[row * side : (row + 1) * side, column * side : (column + 1) * side]
            widths[row, column] = light.sum(axis=0) @ offset_px**2 / light.sum()
            heights[row, column] = light.sum(axis=1) @ offset_px**2 / light.sum()
    # the Gaussian's and its pixel's
    wide = np.tile([0.52, 1.0, 1.48], (3, 1)) + 1 / 12
    high = np.tile([[0.65], [1.0], [1.35]], (1, 3)) + 1 / 12
    np.testing.assert_allclose(widths, wide, atol=0.02)
    np.testing.assert_allclose(heights, high, atol=0.02)


def test_a_spline_stays_at_its_prior_where_dots_tell_less():
    """Dots whose pixels are known to no more than their light: a coefficient is known to 2 by
    them, and within 0.03 without.
    """
    image, x_px, y_px = field_of_dots()
    ghost = gaussian_image(x_px + 2, y_px, 0.7, 400.0)
    dots = dots_of_image(image + ghost, x_px, y_px, 0.0).at(np.arange(12))
    dots = replace(dots, variance=np.full_like(dots.images, 1e4**2))
    gaussian = effective([[1.0, 1.0, 0.0]], _knots(dots))
    amplitudes = np.column_stack([np.full(12, 1e4), np.zeros(12)])
    spline = _spline(gaussian, dots, amplitudes, 1)
    # a ghost of 4 % of the light would be that in all functions together
    assert 0 < spline.sum() * KNOT_PX**2 < 0.05 * 0.04
