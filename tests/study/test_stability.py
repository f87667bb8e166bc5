"""The study of stability: hilstar is right wherever it draws, the methods named there are not,
and a verdict can be wrong.
"""

from __future__ import annotations

import math
import re
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.special import erf

from hilstar.basics.charts import two_digits
from hilstar.display.response import table_response
from hilstar.instruments.study.stability import CaseFigures, FailureCase, image, recorded
from hilstar.instruments.study.stability import run as stability
from hilstar.optics.sprites import pack_sprites

CASES = 43


CURVES = ("narrow_stars", "weak_perspective", "popping", "turns")  # tables with a chart each


@contextmanager
def few_cases(steps=image.STEPS):
    """A study of two cases that are drawn, with all curves, one of them of so many steps: each case
    has a test of its own.
    """
    image.moving_code_fluxes.cache_clear()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(image, "DRAWN", (image.no_stars, image.wide_star))
        patch.setattr(image, "STEPS", steps)
        yield
    image.moving_code_fluxes.cache_clear()


@pytest.fixture(scope="module")
def small(small_run):
    with few_cases(steps=31):
        return small_run(stability.run)


def test_a_whole_study_draws_its_curves(whole_study):
    with few_cases():
        found = whole_study("stability", CURVES, "")
    assert found.right is True and len(found.findings) == CASES - len(image.DRAWN) + 2


def test_a_wide_star_s_light_is_said_by_how_much_it_is_off():
    case = image.wide_star()
    peak, light = case.happens.split(" of the peak; the star's flux off by ")
    assert float(peak) == pytest.approx(case.figures.error, rel=0.5)
    assert abs(float(light)) < 1e-4


def test_light_by_index_is_that_of_stars_apart_and_of_the_last_of_those_at_one_place():
    on = image.target(image.SIGMA_PX, (64, 48))
    first = image.one_star(15.3, 20.8, on, 100.0)
    second = image.one_star(45.6, 31.1, on, 50.0)
    both = image.join_sprites([first, second], first.footprint_px)
    wanted = image.linear_image(both, on.resolution_px, on.psf)
    np.testing.assert_allclose(
        image.indexed_light(both, (64, 48)), wanted, atol=1e-4 * wanted.max()
    )
    at_one = image.join_sprites([first, image.one_star(15.3, 20.8, on, 7.0)], first.footprint_px)
    assert image.indexed_light(at_one, (64, 48)).sum() == pytest.approx(7.0, rel=1e-4)


def test_stars_stand_in_the_middles_of_their_own_parts():
    x_px, y_px = image.middles()
    number = np.arange(image.COUNT)
    middle_px = (number + 0.5) * image.TILE_PX - 0.5
    # each at another phase of a pixel
    assert len(set((x_px[: image.COUNT] % 1).round(6).tolist())) == image.COUNT
    for place, wanted in ((x_px, np.tile(middle_px, image.COUNT)), (y_px, np.repeat(middle_px, 8))):
        np.testing.assert_allclose(place, wanted, atol=0.5)


def test_what_was_recorded_is_right_where_the_other_is_not():
    cases = [*recorded("catalogue_and_geometry"), *recorded("detector_and_attitude")]
    assert len(cases) == CASES - len(image.DRAWN)
    for case in cases:
        assert_right_where_the_other_is_not(case)


def assert_right_where_the_other_is_not(case):
    assert case.right, case
    assert not case.figures.fault <= case.figures.tolerance, case
    assert all((case.case, case.method, case.fails, case.happens, case.why))
    theirs = replace(case, figures=replace(case.figures, error=case.figures.fault))
    assert not theirs.right


def test_what_is_no_number_is_not_right():
    assert not FailureCase("c", "m", "f", "h", "w", CaseFigures(math.nan, math.nan, 1.0)).right


def rendered_by(method):
    return lambda on: nullcontext(partial(method, on))


code_fluxes = image.moving_code_fluxes


def rounded(_quantisation):
    return code_fluxes("round")


def rounded_codes(scene):
    return image.codes_of(scene, "round")


# What a place would say if hilstar did as the method that fails there: the module's road is
# replaced by it.
WRONG_ROADS = (
    (image.narrow_star, "by_renderer", rendered_by(image.point_sampled)),
    (image.popping, "by_renderer", rendered_by(image.point_sampled)),
    (image.wide_star, "by_renderer", rendered_by(image.half_float)),
    (image.negative_wings, "by_renderer", rendered_by(image.bare_polynomial)),
    (image.star_on_pixel_edge, "by_renderer", rendered_by(image.nearest_pixel)),
    (image.star_on_image_edge, "by_renderer", rendered_by(image.nearest_pixel)),
    (image.popping_codes, "moving_code_fluxes", rounded),
    *((visit, "exact_codes", rounded_codes) for visit in image.CODES),
)


@pytest.mark.parametrize(
    ("visit", "name", "method"), WRONG_ROADS, ids=lambda value: getattr(value, "__name__", "")
)
def test_a_verdict_is_wrong_where_hilstar_goes_the_failing_way(visit, name, method, monkeypatch):
    monkeypatch.setitem(visit.__globals__, name, method)
    place = visit()
    assert not place.right, place


def test_the_polynomial_of_the_shader_is_the_shader_s():
    x = np.linspace(-5, 5, 20_001)
    # float32 rounds the inputs too: 2e-7 at 4, where erf is flat, and 6e-8 at 1.
    assert np.abs(image.erf_float32(x) - erf(x)).max() <= image.ERF_ERROR + 6e-8


# The failing method's error by a closed form, and how near it comes to that.
FAULTS = (
    # the Gaussian's value at its middle, for a light of 1
    (image.narrow_star, 1 / (2 * math.pi * 0.1**2) - 1, 1e-3),
    # a half float near 1 is off by 2^-12 at the most, a share by as much, over the peak's two
    (image.wide_star, 2**-12 * math.sqrt(2 * math.pi) * 20, 0.05),
    # a floor in all pixels but those within 4.6 px of the star
    (image.floored_wings, 1e-7 * (512**2 - math.pi * 4.6**2), 1e-3),
    (image.absurd_sigmas, 1.0, 1e-6),
    (image.star_on_pixel_edge, 0.5, 1e-6),
    (image.star_on_image_edge, 0.5, 1e-3),
    (image.flux_range, 1.0, 1e-6),
    # all that is over white
    (image.spilled_beside, 1.0, 1e-3),
    (image.spilled_everywhere, 1.0, 1e-3),
)


def assert_off_by(case, fault, within):
    assert case.right, case
    assert case.figures.fault == pytest.approx(fault, rel=within)
    assert case.figures.tolerance < 0.01


@pytest.mark.parametrize(
    ("visit", "fault", "within"), FAULTS, ids=lambda value: getattr(value, "__name__", "")
)
def test_a_failing_method_is_off_by_what_its_own_arithmetic_says(visit, fault, within):
    assert_off_by(visit(), fault, within)


def test_of_a_crowd_each_pixel_keeps_one_star():
    """Of n stars on it, of a Poisson mean of 10 or 11 px squared."""
    assert_off_by(image.many_stars(), 1 - (1003 / 10.5) ** 2 / 1e5, 0.02)


def test_a_sampled_star_pops_by_the_first_harmonic_of_its_pixels():
    """2 exp(-2 pi^2 sigma^2), both ways on both axes."""
    assert_off_by(image.popping(), 8 * math.exp(-2 * math.pi**2 * 0.5**2), 0.05)


def test_exact_codes_pop_less_than_they_may_and_rounded_ones_more():
    assert_right_where_the_other_is_not(image.popping_codes())


@pytest.mark.parametrize(
    "visit",
    [*image.CODES, image.negative_wings, image.no_stars],
    ids=lambda visit: visit.__name__,
)
def test_exact_codes_and_light_are_right_where_the_usual_ways_are_not(visit):
    case = visit()
    assert_right_where_the_other_is_not(case)
    assert case.figures.tolerance <= 1.0


def test_every_case_that_draws_is_in_one_of_these_tables():
    known = [*(visit for visit, *_ in FAULTS), *image.CODES]
    known += [image.negative_wings, image.no_stars]
    known += [image.many_stars, image.popping, image.popping_codes]
    assert set(known) == set(image.DRAWN)


def test_a_case_says_its_own_figures():
    """Each in words: how much light too large sigmas lose, and how far stars are moved."""
    refused = image.absurd_sigmas()
    inside = math.erf(255 / 2 / 60 / math.sqrt(2)) ** 2
    assert f"{100 * (1 - inside):.1f} % and 100.00000 %" in refused.fails
    assert refused.happens.count("px") >= 2 and refused.figures.error == 0.0
    flux = image.flux_range()
    # a step of 16 bits of the brightest pixel, 4.4e-3 of its star, in up to 121 pixels
    assert re.search(r"off by \de-0[456] and 1e\+00", flux.fails)
    assert "adds 2.6 % to each star" in image.floored_wings().fails
    assert image.no_stars().fails.startswith("100 %")
    assert image.narrow_star().fails.startswith("flux off by up to 1492 %")


def test_a_star_crosses_the_image_along_a_straight_line():
    on = image.target(image.SIGMA_PX, image.MOVING_PX)
    places = np.array([(s.x_px[0], s.y_px[0]) for s in image.moving_star(on, 5.0)])
    assert len(places) == image.STEPS
    shares = np.linspace(0, 1, image.STEPS)
    # from the image's middle, to the right and up; the tangent of 0.03 degrees is its angle
    np.testing.assert_allclose(places[:, 0], 15.5 + 3.0 * shares, atol=1e-5)
    np.testing.assert_allclose(places[:, 1], 15.5 - 1.7 * shares, atol=1e-5)


def test_diffusion_hands_on_by_floyd_and_steinberg_s_sixteenths():
    """Of a pixel of twice white one white is over, which its neighbours have: 7, 3, 5, 1; each
    shows it to half a step of 255, and hands on what is left.
    """
    response = table_response(8, np.linspace(0, 1, 256))
    linear = np.zeros((3, 5))
    linear[0, 2] = 2.0
    shown = image.diffused_light(linear, response)
    wanted = np.array([[0, 0, 1, 7 / 16, 0], [0, 3 / 16, 5 / 16, 1 / 16, 0], [0] * 5])
    np.testing.assert_allclose(shown, wanted, atol=2 / 255)


def test_a_repeated_index_keeps_one_star_of_a_pixel():
    on = image.target(image.SIGMA_PX, (64, 48))
    side_px = on.psf.footprint_px
    x_px, y_px = np.array([20.2, 20.2, 45.7]), np.array([11.6, 11.6, 30.1])
    sprites = pack_sprites(x_px, y_px, np.array([5.0, 2.0, 3.0]), np.arange(3), (64, 48), side_px)
    light = image.indexed_light(sprites, (64, 48))
    assert light.shape == (48, 64)
    # the second of two stars on one place, and one alone
    assert light.sum() == pytest.approx(2.0 + 3.0, rel=1e-5)
    assert np.unravel_index(light.argmax(), light.shape) == (30, 46)


def columns_of(run, name):
    """A table's columns by name."""
    rows = run.rows(name)
    return {column: np.array([float(row[column]) for row in rows]) for column in rows[0]}


def test_sampling_s_errors_by_sigma_are_those_of_a_gaussian(small):
    """Sampled at 21 places within a pixel: its sum by the Gaussian's harmonics, its middle against
    the integral by erf; hilstar's light and middle are right to float32.
    """
    figure, table = small.charts["narrow_stars"], columns_of(small, "narrow_stars")
    sigma = table["sigma_px"]
    assert (sigma[0], sigma[-1], len(sigma)) == pytest.approx((0.1, 2.0, 27))
    orders = np.arange(1, 12)[:, None]
    comb = 1 + 2 * np.exp(-2 * (math.pi * orders * sigma) ** 2).sum(axis=0)
    at_middle = comb**2 - 1
    between = (1 + 2 * ((-1.0) ** orders * np.exp(-2 * (math.pi * orders * sigma) ** 2)).sum(0)) * (
        comb
    ) - 1
    largest = np.maximum(np.abs(at_middle), np.abs(between))
    np.testing.assert_allclose(table["sampled_flux_error"], largest, rtol=1e-4, atol=1e-7)
    assert table["flux_error"].max() <= image.FLUX_ERROR
    assert np.abs(table["peak_error"]).max() < 2e-5
    # its middle over the mean of the pixel around it, at any place
    middle = 1 / (2 * math.pi * sigma**2) / erf(0.5 / sigma / math.sqrt(2)) ** 2 - 1
    assert (np.abs(table["sampled_peak_error"]) > 0.99 * middle).all()
    harmonic = np.exp(-2 * math.pi**2 * sigma**2) / math.pi
    wide = (sigma > 0.3) & (sigma < 0.6)
    np.testing.assert_allclose(table["centroid_error_px"][wide], harmonic[wide], rtol=0.03)
    lines = [line.get_ydata() for axes in figure.axes for line in axes.get_lines()]
    for name in stability.NARROW_COLUMNS:
        assert any(np.array_equal(np.abs(table[name]), line) for line in lines)


def test_the_sigma_from_which_sampling_is_nearer_is_the_first_of_its_kind():
    names = stability.NARROW_COLUMNS
    columns = {name: np.zeros(4) for name in names}
    columns["centroid_error_px"] = np.array([0.1, 0.02, 0.003, 0.001])
    columns["sampled_centroid_error_px"] = np.array([0.3, 0.05, 0.002, 1e-4])
    columns["sampled_peak_error"] = np.array([9.0, 0.5, -0.12, 0.03])
    text = stability.narrow_finding(np.array([0.1, 0.3, 0.85, 2.0]), columns)
    assert text.startswith("From sigma 0.85 px on")
    assert "(0.002 px, integrated 0.003)" in text and text.endswith("12 % too faint")
    columns["sampled_centroid_error_px"][:] = 1.0
    text = stability.narrow_finding(np.array([0.1, 0.3, 0.85, 2.0]), columns)
    assert text.endswith("at every sigma to 2 px")


def test_one_depth_for_all_is_off_by_the_tangent_less_the_sine(small):
    figure, table = small.charts["weak_perspective"], columns_of(small, "weak_perspective")
    angle = np.radians(table["field_angle_deg"])
    off_px = 350e3 / 57.65 * (np.tan(angle) - np.sin(angle))
    np.testing.assert_allclose(np.abs(table["error_px"]), off_px, rtol=1e-6)
    ten, five = np.radians((10.0, 5.0))
    ten_px = 350e3 / 57.65 * (math.tan(ten) - math.sin(ten))
    share = (math.tan(five) - math.sin(five)) / (math.tan(ten) - math.sin(ten))
    # where sin(10 degrees) is the tangent
    ten_arcsec = (ten - math.atan(math.sin(ten))) * 206_264.8
    title = small.title("weak_perspective")
    assert f"off by {ten_px:.0f} px or {ten_arcsec:.0f} arcsec ten degrees" in title
    assert f"by {share:.2f} of that at five" in title
    (upper,), (lower,) = (axes.get_lines() for axes in figure.axes)
    np.testing.assert_array_equal(upper.get_ydata(), np.abs(table["error_px"]))
    np.testing.assert_array_equal(lower.get_ydata(), np.abs(table["error_arcsec"]))


def test_a_turn_between_samples_is_drawn_by_its_way(small):
    figure, table = small.charts["turns"], columns_of(small, "turns")
    turn_deg, line, slerp, rated = table.values()
    assert (slerp[turn_deg < 180] < 1e-3).all() and (slerp[turn_deg > 185] > 1e5).all()
    assert f"within {two_digits(rated.max())} arcsec" in small.title("turns")
    drawn = [curve.get_ydata() for curve in figure.axes[0].get_lines()[:3]]
    for wanted, curve in zip((line, slerp, rated), drawn, strict=True):
        np.testing.assert_array_equal(curve, np.maximum(wanted, 1e-12))


def test_the_chart_of_popping_has_each_way_s_light_in_magnitudes(small):
    figure, table = small.charts["popping"], columns_of(small, "popping")
    np.testing.assert_allclose(table["x_px"], np.linspace(0, 3, 31))
    spread = {name: np.ptp(values) for name, values in table.items()}
    # two axes of a first harmonic of 2 exp(-2 pi^2 / 4), in magnitudes, at chance places
    largest = 2 * 2.5 / math.log(10) * 4 * math.exp(-(math.pi**2) / 2)
    assert 0.5 * largest < spread["point sampled, sigma 0.5 px [mag]"] < 1.01 * largest
    assert spread["linear image [mag]"] < image.RIPPLE < spread["codes, exact [mag]"]
    assert spread["codes, exact [mag]"] < 0.5 * spread["codes, round [mag]"]
    title = small.title("popping")
    assert f"by {spread['codes, exact [mag]']:.3f} mag with exact" in title
    assert f"by {spread['codes, round [mag]']:.3f} mag with rounded" in title
    (millionths,) = figure.axes[1].get_lines()
    np.testing.assert_allclose(millionths.get_ydata(), 1e6 * table["linear image [mag]"])
    # codes hold the light that is asked for: no share of it is the scale's
    assert np.abs(table["codes, exact [mag]"]).max() < 0.1


def test_a_study_has_the_recorded_cases_about_those_that_draw(small):
    """In the order of the chain, with a verdict each; then a chart of each kind of curve."""
    cases = small.told
    assert list(small.charts) == list(CURVES)
    first, last = recorded("catalogue_and_geometry"), recorded("detector_and_attitude")
    known = [case.case for case in (*first, image.no_stars(), image.wide_star(), *last)]
    assert [case.case for case in cases] == known
    assert [case.case for case in cases[len(first) : len(first) + 2]] == [
        "no star in view",
        "sigma 20 px",
    ]
    rows = small.rows("stability")
    assert [row["case"] for row in rows] == [case.case for case in cases]
    for row, case in zip(rows, cases, strict=True):
        assert row["verdict"] == "right" and row["failing method"] == case.method
        assert (row["its failure"], row["what happens"]) == (case.fails, case.happens)
        assert float(row["error"]) == case.figures.error
        assert float(row["tolerance"]) == case.figures.tolerance
    wrong = FailureCase("c", "m", "f", "h", "w", CaseFigures(2.0, 3.0, 1.0))
    assert wrong.row() == ("c", "WRONG", "m", "f", "h", "w", 2.0, 3.0, 1.0)


def test_a_star_s_shares_are_along_its_own_axes():
    """Of sigmas and places that differ by axis, on an image that is no square: sampled, in half
    floats and in the nearest pixel.
    """
    on = image.Target((40, 30), image.GaussianPsf((0.8, 1.7)))
    sprites = image.one_star(12.3, 20.1, on, 5.0)
    columns, rows = np.arange(40) - 12.3, np.arange(30) - 20.1
    middle = np.exp(-0.5 * ((columns / 0.8) ** 2 + (rows[:, None] / 1.7) ** 2))
    wanted = 5 * middle / (2 * math.pi * 0.8 * 1.7)
    np.testing.assert_allclose(image.point_sampled(on, sprites), wanted, rtol=1e-5, atol=1e-12)
    exact = image.linear_image(sprites, (40, 30), on.psf)
    # a share is half of a difference of two numbers near 1, each known to 2^-12
    halves = image.half_float(on, sprites)
    np.testing.assert_allclose(halves, exact, atol=3 * 5 * 2**-12)
    assert np.abs(halves - exact).max() > 1e-5
    np.testing.assert_allclose(image.bare_polynomial(on, sprites), exact, atol=1e-5)
    nearest = image.nearest_pixel(on, sprites)
    assert (nearest[20, 12], nearest.sum()) == (pytest.approx(5.0), pytest.approx(5.0))


def test_a_star_s_largest_errors_are_those_of_either_sign():
    """Of planted images: 3 % too much light, 5 % too little a pixel to the left, and a middle of 60 %."""
    on = image.target(image.SIGMA_PX)

    def draw(sprites):
        drawn = image.linear_image(sprites, on.resolution_px, on.psf)
        phase = sprites.x_px[0] - image.MIDDLE_PX
        if phase < -0.2:
            return 1.03 * drawn
        if phase < 0.0:
            return 0.95 * np.roll(drawn, -1, axis=1)
        drawn[image.MIDDLE_PX, image.MIDDLE_PX] *= 0.6 if phase < 0.2 else 1.0
        return drawn

    errors = image.star_errors(draw, on, np.array([-0.3, -0.1, 0.1, 0.3]))
    assert errors.centroid_px == pytest.approx(1.0, abs=1e-4)
    peak_share = image.pixel_shares(np.array([0.1]), image.SIGMA_PX)[0]
    peak_share *= image.pixel_shares(np.zeros(1), image.SIGMA_PX)[0]
    assert errors.flux == pytest.approx(0.4 * peak_share, rel=1e-3)
    # the middle has 95 % of the light of its neighbour, 1.1 px from the star
    beside, own = image.pixel_shares(np.array([1.1, 0.1]), image.SIGMA_PX)
    assert errors.peak == pytest.approx(0.95 * beside / own - 1, rel=1e-4)
    # beyond half a pixel the middle is the next one's
    right = image.star_errors(
        lambda s: image.linear_image(s, on.resolution_px, on.psf), on, np.array([0.7, -0.7])
    )
    assert abs(right.peak) < 1e-6 and right.flux < 2e-6
    brighter = image.star_errors(lambda s: 1.03 * draw(s), on, np.array([-0.3]))
    assert (brighter.flux, brighter.peak) == pytest.approx((1.03**2 - 1,) * 2, rel=1e-3)


def test_a_ripple_is_the_range_of_light_by_its_mean_and_in_magnitudes():
    fluxes = np.array([1.0, 0.8, 1.3, 0.9])
    assert image.ripple(fluxes) == pytest.approx(0.5)
    assert image.ripple_mag(fluxes) == pytest.approx(2.5 * math.log10(1.3 / 0.8))


def test_a_panel_s_wanted_light_is_what_each_of_its_pixels_can_show():
    """White at most, times the pixel's own light."""
    scene = image.uneven_panel()
    bright = replace(scene, sprites=image.lone_stars(-3.0, scene.panel.response).sprites)
    uniformity = scene.panel.uniformity
    wanted = bright.wanted()
    over = bright.linear() > 1.4
    assert over.sum() > 100
    np.testing.assert_allclose(wanted[over], uniformity[over])
    under = bright.linear() < 0.3
    np.testing.assert_allclose(wanted[under], bright.linear()[under])
    # 30 % fainter half a screen's side from the middle, and 5 % by chance
    y, x = np.mgrid[: image.SIDE_PX, : image.SIDE_PX] / image.SIDE_PX - 0.5
    noise = uniformity - (1 - 0.3 * np.hypot(x, y))
    assert noise.std() == pytest.approx(0.05, rel=0.02) and abs(noise.mean()) < 1e-3
    for part in (np.s_[:40, :40], np.s_[-40:, -40:], np.s_[:40, -40:]):
        assert abs(noise[part].mean()) < 0.006  # 4 of its sigmas


def test_the_error_of_groups_is_in_the_smallest_steps_of_their_own_light():
    """A step too much in each of a group's nine pixels, and dark parts that do not count."""
    response = table_response(4, np.array([0.0, 0.01, 0.05, *np.linspace(0.1, 1.0, 13)]))
    scene = image.lone_stars(0.0, response)
    parts = scene.sprites
    only = image.CodeScene(
        image.join_sprites([first_of(parts, 1)], parts.footprint_px), 0.85, scene.panel
    )
    wanted = only.wanted()
    codes = np.zeros((image.SIDE_PX, image.SIDE_PX), dtype=np.uint16)
    row, column = np.unravel_index(wanted.argmax(), wanted.shape)
    codes[row - 1 : row + 2, column - 1 : column + 2] = 1
    codes[0, -1] = 3  # in a part without a star
    steps = (9 * 0.01 - wanted.sum()) / 0.01
    assert image.error_steps(image.Levels(codes), only) == pytest.approx(abs(steps), rel=1e-4)
    light = np.zeros((image.SIDE_PX, image.SIDE_PX))
    light[30, 100] = 7.0
    by_part = image.light_by_part(light)
    assert by_part[30 // image.TILE_PX, 100 // image.TILE_PX] == by_part.sum() == 7.0


def first_of(sprites, count):
    """The first of some sprites."""
    columns = {name: getattr(sprites, name)[:count] for name in ("data", "star", "x_px", "y_px")}
    return replace(sprites, **columns)


def test_neighbours_are_at_their_distance_in_all_directions_each_with_its_light():
    scene = image.neighbours((2.0, 4.5), 3.0)
    count = image.COUNT**2
    x_px, y_px = scene.sprites.x_px, scene.sprites.y_px
    first = np.argsort(scene.sprites.star)  # as they were given
    x_px, y_px = x_px[first], y_px[first]
    light = scene.sprites.data["electrons_per_s"][first]
    across_px, down_px = x_px[count:] - x_px[:count], y_px[count:] - y_px[:count]
    np.testing.assert_allclose(np.hypot(across_px, down_px), 3.0, atol=1e-5)
    angles = np.unwrap(np.arctan2(down_px, across_px))
    np.testing.assert_allclose(np.diff(angles), 2 * math.pi / count, atol=1e-4)
    np.testing.assert_allclose(light[:count] / light[count:], 10 ** (0.4 * 2.5), rtol=1e-5)
    assert scene.stars == 2


def test_stars_half_off_are_on_every_edge_at_every_phase():
    sprites = image.half_off().sprites
    last = image.SIDE_PX - 1
    x_px, y_px = sprites.x_px, sprites.y_px
    for across, along in ((x_px, y_px), (last - x_px, y_px), (y_px, x_px), (last - y_px, x_px)):
        near = across < 1.0
        # about the first pixel's outer edge, -0.5: six places from -1 to 0 evenly
        inside = near & (along > 10) & (along < last - 10)
        places = np.sort(across[inside])
        np.testing.assert_allclose(places, (np.arange(6) + 0.5) / 6 - 1, atol=1e-5)


def test_a_case_is_judged_by_its_largest_figure():
    """A refusal by what would be cut at the worst, a crowd's by its worst pixel, too, a range's by
    both stars, and spilled light by the panel's largest step.
    """
    assert image.absurd_sigmas().figures.fault == pytest.approx(1.0, abs=1e-6)
    flux = image.flux_range().figures
    assert flux.fault == pytest.approx(1.0, abs=1e-6)
    spilled = image.spilled_everywhere().figures
    response = image.srgb_response(8)
    assert spilled.tolerance == pytest.approx(np.diff(response.light).max())
    assert image.coded_neighbours().figures.tolerance == pytest.approx(1.0)
    assert image.coded_coarse().figures.tolerance == pytest.approx(0.5)
    assert image.no_stars().figures.error == 0.0


def test_codes_are_judged_on_the_panels_that_their_cases_name(monkeypatch):
    """Bits, and magnitudes under the star whose peak is white."""
    scenes = {}

    def judged(case, scene, *given, **more):
        scenes[case] = scene

    monkeypatch.setattr(image, "judged", judged)
    for visit in image.CODES:
        visit()
    said = {}
    for case, scene in scenes.items():
        light = scene.sprites.data["electrons_per_s"] * scene.psf.peak_share
        said[case] = scene.panel.response.bits, round(float(-2.5 * np.log10(light.max())), 3)
    assert said == {
        "stars half off the screen, 6 mag under white on 8 bits": (8, 6.0),
        "two stars 1 px apart, 6 mag under white": (8, 6.0),
        "codes of stars of sigma 0.3 px, 3 mag under white": (8, 3.0),
        "pixels 5 % apart, stars 6 mag under white": (8, 6.0),
        "a panel of 2 bits, stars whose peak is white": (2, 0.0),
        "a panel of 16 bits, stars 10 mag under white": (16, 10.0),
    }


@pytest.mark.parametrize("place", ["a pixel of the corner", "all beyond it"])
def test_a_crowd_is_wrong_by_a_pixel_as_by_its_light(place, monkeypatch):
    """Light that two pixels of the corner exchange, or a thousandth of it away from there."""
    monkeypatch.setattr(image, "CROWD", 300)
    monkeypatch.setattr(image, "CROWD_PX", (200, 200))
    monkeypatch.setattr(image, "CORNER_PX", 64)

    def drawn(on, sprites):
        light = image.linear_image(sprites, on.resolution_px, on.psf)
        if place == "all beyond it":
            light[100:] *= 1.002
        else:
            light[20, 20], light[20, 21] = (
                light[20, 20] + 0.01 * light.max(),
                light[20, 21] - 0.01 * light.max(),
            )
        return light

    monkeypatch.setattr(image, "drawn", drawn)
    case = image.many_stars()
    assert not case.right and case.figures.error > 5e-4
    assert case.figures.tolerance < 1e-5
