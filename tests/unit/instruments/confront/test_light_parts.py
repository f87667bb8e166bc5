"""How the light of photographs is fitted, and what its scatter is made of, part by part: stars that
are trusted, corrections that stay in bounds, fits that leave stars out, pixels and neighbours.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hilstar.instruments.confront.background import FixedPattern, fixed_pattern
from hilstar.instruments.confront.excess import (
    LAW,
    Part,
    _blends,
    _by_law,
    _light,
    _places,
    _response,
    _rest,
    _scintillation,
    _Sightings,
    _variables,
    shot_sigma,
)
from hilstar.instruments.confront.judge import Expected, StarRow, Verdict
from hilstar.instruments.confront.light import (
    CORRECTION_PRIOR,
    MAX_CORRECTION,
    NO_CORRECTION,
    LightFit,
    StarLight,
    _correction,
    _CorrectionFit,
    _held_out,
    _robust,
    _trusted,
    _vignetting,
    fit_light,
    join_light,
    with_extinction,
)
from hilstar.instruments.confront.star_psf import StarPsf
from hilstar.sky.catalog import plain_catalog
from tests.support.confrontations import (
    a_session,
    a_shot,
    a_star,
    a_verdict,
    seen_shot,
    some_pixels,
)

MAG_A_RELATIVE = 2.5 / math.log(10)


def stars_of(mag: np.ndarray, sigma_mag: float, **changes: Any) -> StarLight:
    """Stars of these magnitudes (n,) in one photograph."""
    count = len(mag)
    dn = 10 ** (-0.4 * mag)
    none = np.zeros(count)
    every = np.ones(count, dtype=bool)
    image = np.zeros(count, dtype=np.intp)
    sigma_dn = sigma_mag / MAG_A_RELATIVE * dn
    stars = StarLight(image, dn, sigma_dn, mag, none, none, every, image)
    return replace(stars, **changes)


def test_extinction_is_as_sure_as_skies_are_alike(rng):
    """0.01 mag from sky to sky, whatever number of stars: by air masses of 1, 1.4 and 2."""
    image = np.repeat(np.arange(3), 400)
    v_mag = rng.uniform(2, 6, 1200)
    masses = np.array([1.0, 1.4, 2.0])
    mag = v_mag + 0.2 * masses[image] - 12
    stars = stars_of(mag + 0.01 * rng.standard_normal(1200), 0.01, image=image, v_mag=v_mag)
    fit = fit_light(stars, 3, lambda correction: v_mag)
    told = with_extinction(fit, stars, masses.tolist(), known=False)
    about = math.sqrt(float(((masses - masses.mean()) ** 2).sum()))
    sigma = told.sigma["extinction_mag_per_air_mass"]
    assert sigma == pytest.approx(0.01 / about, rel=0.01)
    assert fit.zero_point_mag == pytest.approx(12 - 0.2 * masses.mean(), abs=2e-3)
    # that of a photograph by its 400 stars
    assert fit.sigma["zero_point_mag"] == pytest.approx(0.01 / math.sqrt(400), rel=0.1)


@pytest.mark.parametrize("known", [False, True])
def test_extinction_weighs_a_photograph_by_its_clean_stars_and_what_skies_differ_by(known):
    """Four, ten and a hundred stars 0.03 mag to either side, and about as many that are not clean."""
    image = np.repeat([0, 1, 2], [8, 18, 200])
    each = np.arange(len(image))
    clean = each % 4 < 2
    offsets_mag = np.array([-11.7, -11.66, -11.65])
    masses = [1.0, 1.2, 1.31]
    mag = 5.0 + each * 0.01
    off_mag = np.where(clean, 0.03, 2.0) * (-1) ** each
    stars = stars_of(offsets_mag[image] + mag - off_mag, 1e-3, image=image, clean=clean)
    light = LightFit(offsets_mag, (0.0, 0.0), NO_CORRECTION, 12.0, 0.0, 1.0, mag=mag)
    assert stars.sigma_mag == pytest.approx(1e-3)
    told = with_extinction(light, stars, masses, known=known)
    spread_mag = 1.482602 * 0.03
    sigma_mag = np.hypot(spread_mag / np.sqrt([4, 10, 100]), 0.01)
    values, covariance = np.polyfit(masses, offsets_mag, 1, w=1 / sigma_mag, cov="unscaled")
    assert told.extinction_mag == pytest.approx(values[0])
    name = "extinction_beyond_table_mag_per_air_mass" if known else "extinction_mag_per_air_mass"
    assert told.sigma == {name: pytest.approx(math.sqrt(covariance[0, 0]))}
    assert told.masses == (1.0, 1.2, 1.31)
    # a span of less than 0.3 tells none, nor do two photographs
    near = with_extinction(light, stars, [1.0, 1.2, 1.29], known=known)
    two = replace(light, offsets_mag=offsets_mag[:2])
    few = with_extinction(two, replace(stars, image=image % 2), [1.0, 1.5], known=known)
    assert (near.extinction_mag, few.extinction_mag, few.masses) == (None, None, (1.0, 1.5))


def test_a_zero_point_is_the_mean_of_the_photographs_and_no_vignetting(rng):
    image = np.repeat(np.arange(3), 60)
    v_mag = rng.uniform(2, 6, 180)
    radius2 = rng.uniform(0, 1, 180)
    mag = v_mag + np.array([-12.0, -11.4, -11.9])[image] + 0.3 * radius2 + 0.2 * radius2**2
    stars = stars_of(mag + 1e-3 * rng.standard_normal(180), 1e-3)
    stars = replace(stars, image=image, v_mag=v_mag, radius2=radius2)
    fit = fit_light(stars, 3, lambda correction: v_mag)
    assert fit.zero_point_mag == pytest.approx((12.0 + 11.4 + 11.9) / 3, abs=2e-3)
    assert fit.colour_term == pytest.approx(0.0, abs=2e-3)


def test_stars_are_trusted_by_the_light_that_their_own_photograph_should_have():
    """Noise of 1 DN, zero points of 10 and 7 mag: V 6.7 makes 21 DN in the first, V 3.7 in the
    second. Fainter stars that came out as bright are not trusted, and stars that are not clean.
    """
    v_mag = np.array([*np.linspace(2, 6.7, 10), 6.8, 5.0, *np.linspace(0, 3.7, 10), 3.8])
    image = np.repeat([0, 1], [12, 11])
    zero_mag = np.array([10.0, 7.0])[image]
    dn = 10 ** (-0.4 * (v_mag - zero_mag))
    dn[[10, 22]] = 30.0
    clean = np.ones(23, dtype=bool)
    clean[11] = False
    stars = stars_of(v_mag, 0.01)
    stars = replace(stars, dn=dn, sigma_dn=np.ones(23), v_mag=v_mag, image=image, clean=clean)
    trusted = _trusted(stars, np.eye(2)[image])
    assert np.flatnonzero(~trusted).tolist() == [10, 11, 22]
    # however noisy what is not clean, as most of them
    noisy = stars_of(np.full(40, 5.0), 0.01)
    none = np.zeros(40, dtype=bool)
    noisy = replace(noisy, dn=np.full(40, 100.0), sigma_dn=np.full(40, 50.0), clean=none)
    more = join_light([stars, noisy])
    assert _trusted(more, np.eye(2)[more.image])[:23].tolist() == trusted.tolist()
    dark = replace(stars, sigma_dn=np.full(23, 1e9))
    assert _trusted(dark, np.eye(2)[image]).tolist() == clean.tolist()


@pytest.mark.parametrize("values", [(2.0, -3.0), (-1.0, 0.5)])
def test_a_correction_that_nothing_asks_for_goes_back_to_none(values):
    """Of magnitudes that do not change with it: the prior alone tells."""
    fit = _CorrectionFit(np.zeros(20), np.ones(20), np.ones((20, 1)), lambda pair: np.zeros(20), 2)
    at = np.array(values)
    loss = fit.loss(at)
    assert loss.value == pytest.approx(float(((at / CORRECTION_PRIOR) ** 2).sum()) / 2)
    assert fit.step(at, loss) == pytest.approx(-at, rel=1e-6)


def test_a_loss_is_a_square_up_to_one_and_a_half_sigmas_and_a_line_from_there():
    off = np.array([3.0, 0.5, 1.0])
    target = 7 + 2 * np.concatenate([off, -off])
    fit = _CorrectionFit(target, np.full(6, 2.0), np.ones((6, 1)), lambda pair: np.zeros(6), 2)
    loss = fit.loss(np.zeros(2))
    np.testing.assert_allclose(loss.off, (target - 7) / 2, atol=1e-9)
    assert loss.value == pytest.approx(2 * (1.5 * (3 - 1.5 / 2) + 0.5**2 / 2 + 1 / 2))
    np.testing.assert_allclose(loss.weight, np.minimum(1, 1.5 / np.abs(loss.off)))


@pytest.mark.parametrize(("count", "is_free"), [(17, False), (18, True)])
def test_a_tilt_takes_fifteen_stars_more_than_what_is_fitted_beside_it(count, is_free, rng):
    """Beside the zero points of three photographs."""
    bv = rng.uniform(-0.2, 1.6, 20)
    image = np.arange(20) % 3
    use = np.arange(20) < count
    stars = stars_of(-12 + image - 0.1 * bv, 1e-4, bv_mag=bv)

    def magnitudes(pair: tuple[float, float]) -> np.ndarray:
        return -0.1 * pair[0] * bv - 0.01 * pair[1] * bv**2

    tilted, bow = _correction(stars, magnitudes, np.eye(3)[image], use)
    assert (tilted > 0.3, bow) == (is_free, 0.0)


@pytest.mark.parametrize(("tilt", "found"), [(4.0, 4.0), (-30.0, -10.0), (30.0, 10.0)])
def test_a_correction_is_that_of_the_colours_within_bounds(tilt, found, rng):
    """A tilt of 1 makes a mag of B-V 0.1 mag brighter; no star tells a bow."""
    bv = rng.uniform(-0.2, 1.6, 60)
    v_mag = rng.uniform(2, 6, 60)
    every = np.ones(60, dtype=bool)
    stars = stars_of(v_mag - 12 - 0.1 * tilt * bv, 1e-4, bv_mag=bv, v_mag=v_mag)

    def magnitudes(pair: tuple[float, float]) -> np.ndarray:
        return v_mag - 0.1 * pair[0] * bv

    tilted, bow = _correction(stars, magnitudes, np.ones((60, 1)), every)
    # the prior of 3 takes a share of it: 0.05 mag a star over 0.05 of its colour's 0.1
    assert tilted == pytest.approx(found, rel=0.05)
    assert abs(tilted) <= MAX_CORRECTION[0]
    assert bow == pytest.approx(0.0, abs=0.1)
    # those that are used have to differ in colour
    alike = np.where(np.arange(60) < 40, 0.6, bv)
    same = replace(stars, bv_mag=alike)
    assert _correction(same, magnitudes, np.ones((60, 1)), np.arange(60) < 40) == NO_CORRECTION


@pytest.mark.parametrize(("fall_mag", "columns"), [(0.02, 0), (0.1, 1)])
def test_vignetting_is_taken_where_it_foretells_better_by_more_than_a_hundredth(fall_mag, columns):
    """Of a scatter of 0.05 mag in 2000 stars a fall of 0.02 mag is 0.7 %, one of 0.1 is 15 %."""
    rng = np.random.default_rng(5)
    radius2 = rng.uniform(0, 1, 2000)
    noise = 0.05 * rng.standard_normal(2000)
    off_mag = noise + fall_mag * radius2
    stars = stars_of(np.zeros(2000), 0.05, radius2=radius2)
    every = np.ones(2000, dtype=bool)
    assert len(_vignetting(stars, np.ones((2000, 1)), off_mag, every)) == columns


@pytest.mark.parametrize(("count", "columns"), [(10, 0), (12, 1)])
def test_vignetting_is_sought_by_eight_stars_more_than_photographs(count, columns):
    """Of three photographs, where it is plain."""
    radius2 = np.linspace(0, 1, count)
    image = np.arange(count) % 3
    off_mag = image + radius2 + 1e-3 * np.cos(7 * np.arange(count))
    stars = stars_of(np.zeros(count), 1e-3, radius2=radius2, image=image)
    every = np.ones(count, dtype=bool)
    assert len(_vignetting(stars, np.eye(3)[image], off_mag, every)) == columns


@pytest.mark.parametrize("noise", [1e-4, 0.4])
def test_a_robust_fit_s_errors_are_by_the_scatter_that_its_freedom_leaves(noise):
    """Six numbers 0.3 to either side of their mean, whatever noise has of it: 1.4826 x 0.3 x
    sqrt(6/5).
    """
    target = 5 + 0.3 * np.tile([1.0, -1.0], 3)
    every = np.ones(6, dtype=bool)
    fit = _robust(np.ones((6, 1)), target, np.full(6, noise), every)
    assert fit.values == pytest.approx([5.0])
    assert fit.sigma == pytest.approx([1.4826 * 0.3 * math.sqrt(6 / 5) / math.sqrt(6)], rel=1e-3)
    assert fit.off == pytest.approx(target - 5)


def test_stars_that_are_held_out_are_not_in_their_own_fit():
    """Twelve columns of chance over sixty stars: what a fit takes of its own stars it adds to
    others, 1 - 12/60 and 1 + 12/48 and more.
    """
    rng = np.random.default_rng(6)
    every = np.ones(60, dtype=bool)
    squares = []
    for _ in range(12):
        design = rng.standard_normal((60, 12))
        target = 0.1 * rng.standard_normal(60)
        squares.append(_held_out(design, target, np.full(60, 0.1), every) ** 2)
    assert np.mean(squares) / 0.01 > 1.1
    assert math.isnan(_held_out(np.ones((4, 1)), np.zeros(4), np.ones(4), np.zeros(4, dtype=bool)))


def row(star: int, off_mag: float = 0.0, **changes: Any) -> StarRow:
    """A star that is so much fainter than predicted."""
    dn = 1000 * 10 ** (-0.4 * off_mag)
    light = {"dn": dn, "dn_predicted": 1000.0}
    return a_star("", star, 4.0, (10.0, 20.0), **(light | changes))


def sightings(rows: list[StarRow], verdicts: list[Verdict] | None = None) -> _Sightings:
    """Stars that count, as the parts of an excess ask for them."""
    return _Sightings(verdicts or [a_verdict(a_shot(0), 0)] * len(rows), rows)


def test_a_star_s_place_has_its_own_error_in_its_own_photograph():
    shot = seen_shot([(1.0, 2.0)] * 3, [5, 7, 9])
    shot.found.sigma_px[:] = [0.1, 0.2, 0.3]
    verdict = a_verdict(shot, 0)
    assert [shot_sigma(verdict, row(star)).tolist() for star in (7, 5)] == [[0.2], [0.1]]
    assert shot_sigma(verdict, row(8)).tolist() == []


def test_what_changes_between_photographs_is_beyond_noise_and_by_the_stars_seen_again():
    """Twenty stars twice, 0.03 mag to either side of their own mean, with noise of 0.02: 0.06^2 / 2
    less 0.02^2; stars seen once tell nothing.
    """
    off_mag = [0.1 * star + sign * 0.03 for star in range(20) for sign in (1, -1)]
    rows = [row(k // 2, off) for k, off in enumerate(off_mag)] + [row(90, 5.0), row(91, -5.0)]
    noise_mag = np.append(np.full(40, 0.02), [9.0, 9.0])
    session = a_session()
    part = _scintillation(session, sightings(rows), noise_mag)
    assert part.rms == pytest.approx(math.sqrt(2 * 0.03**2 - 0.02**2))
    assert part.how.endswith("by 20 stars seen again")
    assert _scintillation(session, sightings(rows), 9 * noise_mag).rms == 0.0
    few = _scintillation(session, sightings(rows[18:]), noise_mag[18:])
    assert few == _by_law(session) and few.name == LAW


def test_what_a_law_says_stays_in_the_rest():
    parts = [Part("a", 0.3, ""), Part(LAW, 0.2, ""), Part("b", math.nan, "")]
    assert _rest(0.25, parts).rms == pytest.approx(0.4)


def test_a_pixel_response_takes_of_a_star_as_its_light_lies_on_pixels():
    """A Gaussian of 1.5 px, with a pixel's twelfth: the sum of its squares is 1 / 4 pi sigma^2, and
    that by the square of x 1 / 8 pi, whatever its width.
    """
    psf = StarPsf(np.array([[2.25], [2.25], [0.0]]), 0.0, 0.0, 2.0, (80, 60))
    pattern = FixedPattern((0.02**2, 0.0, 0.0, 0.0), (1e-9,) * 4)
    session = a_session(psf=psf, pixels=replace(some_pixels(), pattern=pattern))
    light = 0.02 / math.sqrt(4 * math.pi * (2.25 + 1 / 12))
    assert _response(session) == pytest.approx((light, 0.02 / math.sqrt(8 * math.pi)), rel=0.01)


def test_known_variables_and_doubles_are_told_by_what_the_others_scatter():
    """Sixteen steady stars of 0.1 mag, one double and one variable one of 0.7."""
    rows = [row(k, 0.1 * (-1) ** k) for k in range(16)]
    rows += [row(20, 0.7, flags=("double",)), row(21, -0.7, flags=("variable", "blended"))]
    part = _variables(sightings(rows))
    whole = (16 * 0.01 + 2 * 0.49) / 18
    assert part.rms == pytest.approx(math.sqrt(whole - 0.01))
    assert "with 2 known variables and doubles" in part.how
    # too few steady ones tell nothing
    assert _variables(sightings(rows[6:])).rms == 0.0


STARS = 64  # of a photograph whose scatter is told apart


def scattered(off_px: np.ndarray, off_mag: np.ndarray, bv_mag: np.ndarray) -> _Sightings:
    """Stars of one photograph, so far off, by 0.1 and 0.3 px and by 1 and 3 % of their light, at
    places of all phases of a pixel in both axes.
    """
    number = np.arange(STARS)
    x_px = 5.0 + 9 * (number % 8) + number % 8 / 8
    y_px = 4.0 + 6 * (number // 8) + number // 8 / 8
    columns = {name: np.zeros(STARS) for name in ("v_mag", "ra_deg", "dec_deg")}
    catalog = plain_catalog("HIP", STARS, {"bv_mag": bv_mag, **columns})
    shot = seen_shot(np.column_stack([x_px, y_px]), number.tolist())
    shot.sky = replace(shot.sky, catalog=catalog, order=number)
    shot.found.sigma_px[:] = np.where(number % 2, 0.3, 0.1)
    rows = []
    for k in number:
        made = row(
            int(k),
            off_mag[k],
            x_px=x_px[k],
            y_px=y_px[k],
            x_predicted_px=x_px[k] - off_px[k, 0],
            y_predicted_px=y_px[k] - off_px[k, 1],
            b_v_mag=bv_mag[k],
        )
        rows.append(replace(made, sigma_dn=made.dn * (0.03 if k % 2 else 0.01)))
    return sightings(rows, [a_verdict(shot, 0)] * STARS)


def test_places_are_off_by_noise_and_by_what_repeats_in_a_pixel_along_either_axis():
    """By a wave of 0.2 px along x and one of 0.1 px along y, an axis: the rest is in no part."""
    phases = 2 * np.pi * np.array([np.arange(STARS) % 8, np.arange(STARS) // 8]) / 8
    off_px = np.column_stack([0.2 * np.cos(phases[0]), 0.1 * np.sin(phases[1])])
    stars = scattered(off_px, np.zeros(STARS), np.zeros(STARS))
    session = a_session()
    parts = {part.name: part.rms for part in _places(session, stars)}
    wave_ms = (0.2**2 / 2 + 0.1**2 / 2) / 2
    response_px = _response(session)[1]
    assert parts == {
        "photon and background noise": pytest.approx(math.sqrt((0.1**2 + 0.3**2) / 2)),
        "place within the pixel": pytest.approx(math.sqrt(wave_ms)),
        "pixel response": response_px,
        "colour": 0.0,
        "unexplained": 0.0,
    }


@pytest.mark.parametrize("name", ["colour", "flat field", "place within the pixel"])
def test_light_is_off_by_noise_and_by_what_goes_with_one_thing_alone(name):
    """A curve of B-V, a slope over the field, or a wave in a pixel: a part of the scatter that is
    that of the whole, and noise in magnitudes.
    """
    number = np.arange(STARS)
    bv_mag = 0.2 + 0.1 * (number * 5 % 16)
    off_mag = {
        "colour": 0.1 * bv_mag - 0.2 * bv_mag**2,
        "flat field": 0.02 * (number // 8) - 0.01 * (number % 8),
        "place within the pixel": 0.1 * np.cos(2 * np.pi * (number % 8) / 8),
    }[name]
    stars = scattered(np.zeros((STARS, 2)), off_mag, bv_mag)
    parts = {part.name: part.rms for part in _light(a_session(), stars)}
    assert parts[name] == pytest.approx(np.std(off_mag), rel=1e-6)
    noise = MAG_A_RELATIVE * math.sqrt((0.01**2 + 0.03**2) / 2)
    assert parts["photon and background noise"] == pytest.approx(noise)


def test_blends_are_other_stars_by_how_far_they_lie_within_a_profile():
    """Two stars, of which one has another of half of its light a pixel aside, with a PSF of one
    pixel: e^(-1/4) of it. The mean is in the zero point.
    """
    first = Expected(np.array([1, 7]), np.array([10.0, 11.0]), np.zeros(2), np.array([100.0, 50.0]))
    second = Expected(np.array([2]), np.array([40.0]), np.zeros(1), np.array([80.0]))
    verdicts = [a_verdict(a_shot(0), 0, expected=expected) for expected in (first, second)]
    rows = [
        row(1, x_predicted_px=10.0, y_predicted_px=0.0, dn_predicted=100.0),
        row(2, x_predicted_px=40.0, y_predicted_px=0.0, dn_predicted=80.0),
    ]
    core_px2 = 1 - 1 / 12  # the pixel has a twelfth
    psf = StarPsf(np.array([[core_px2], [core_px2], [0.0]]), 0.0, 0.0, 2.0, (80, 60))
    added_mag = MAG_A_RELATIVE * 0.5 * math.exp(-0.25)
    blends = _blends(a_session(psf=psf), sightings(rows, verdicts))
    # a width at half maximum is looked for by hundredths of a pixel
    assert blends.rms == pytest.approx(added_mag / 2, rel=0.005)


def test_a_pattern_of_pixels_is_none_of_lines_of_a_detector_that_is_no_square():
    """Offsets of 10 DN a pixel in 16 rows of 800: a column's mean has a sixteenth of their square,
    a row's an eight hundredth.
    """
    rng = np.random.default_rng(9)
    offsets = 10 * rng.standard_normal((16, 800))
    level = np.full((16, 800), 100.0)
    every = np.ones((16, 800), dtype=bool)
    photographs = [(offsets + rng.standard_normal((16, 800)), level, every) for _ in range(3)]
    found = fixed_pattern(photographs)
    assert found is not None
    # of 800 columns the mean square is known to sqrt(2 / n), of 16 rows to a third
    assert found.squares[2] == pytest.approx(0.0, abs=5 * 100 / 16 * math.sqrt(2 / 800))
    assert found.squares[3] == pytest.approx(0.0, abs=5 * 100 / 800 * math.sqrt(2 / 16))
    # all is response where light is of one level
    assert found.rms[0] == pytest.approx(0.1, rel=0.05)


def test_lines_with_few_pixels_in_use_tell_no_pattern_of_lines():
    """Columns of 5 DN in photographs whose columns have a quarter of their pixels in use at most,
    or a little more.
    """
    rng = np.random.default_rng(10)
    columns = 5 * rng.standard_normal(300)
    level = np.full((40, 300), 100.0)
    for used, is_known in ((10, False), (12, True)):
        photographs = []
        for _ in range(3):
            use = np.zeros((40, 300), dtype=bool)
            use[:used] = True
            photographs.append((columns + rng.standard_normal((40, 300)), level, use))
        found = fixed_pattern(photographs)
        is_found = found is not None and found.rms[2] > 0
        assert is_found is is_known
