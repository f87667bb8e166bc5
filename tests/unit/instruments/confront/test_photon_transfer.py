"""The detector behind photographs: a gain that they do not tell is the bench file's, and the
rest of the noise the pixels'.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from hilstar.instruments.confront.background import (
    FixedPattern,
    SkyLevel,
    fixed_pattern,
    sky_level,
)
from hilstar.instruments.confront.photon_transfer import (
    PixelFit,
    _median_error,
    fit_pedestal,
    fit_pixels,
    transfer_points,
)
from hilstar.instruments.confront.session import _pixels
from hilstar.tracker.settings import DetectorSettings
from tests.support.claims import holds
from tests.support.confrontations import a_shot

GAIN, PRNU, READ_E = 17.0, 0.03, 2.0  # the Rosetta NAVCAM of the thesis
SKY_E = 28_000.0
SHAPE = (512, 512)
SIGMAS = 4.0
BENCH = DetectorSettings(gain_e_per_dn=GAIN, read_noise_e=READ_E, prnu=PRNU)
EVERY = np.zeros(SHAPE, dtype=bool)


def photographs(rng, levels_e, prnu=PRNU):
    """Photographs (n, height, width), DN, of one detector: each of a level, e-, or of an image
    of levels.
    """
    response = 1 + prnu * rng.standard_normal(SHAPE)
    for level_e in levels_e:
        charge_e = rng.poisson(np.broadcast_to(level_e, SHAPE) * response)
        yield np.rint((charge_e + READ_E * rng.standard_normal(SHAPE)) / GAIN)


def fitted_transfer(images, bench=BENCH):
    images = list(images)
    levels = [sky_level(dn, 1.0).level for dn in images]
    points = [transfer_points(dn, level, EVERY) for dn, level in zip(images, levels, strict=True)]
    pattern = fixed_pattern(
        (dn - level, level, ~EVERY) for dn, level in zip(images, levels, strict=True)
    )
    return fit_pixels(np.concatenate(points), 1.0, None, bench, pattern or FixedPattern())


def test_one_photograph_s_response_is_beside_its_own_exposure_s_dark_counts(rng):
    """400 DN of light at 4 e- a DN, 8 e- of read noise, offsets of 30 e- and of 80 e- a second in
    half a second, and a response of 4 %: each pixel's variances add up.
    """
    settings = {"gain_e_per_dn": 4.0, "read_noise_e": 8.0, "offset_dn": 60.0}
    assumed = DetectorSettings(**settings, dsnu_e=30.0, dsnu_e_per_s=80.0)
    variance_dn2 = 400 / 4 + 2**2 + (30**2 + 40**2) / 4**2 + (0.04 * 400) ** 2 + 1 / 12
    dn = 460.0 + math.sqrt(variance_dn2) * rng.standard_normal((240, 320))
    noise_dn = np.full_like(dn, math.sqrt(variance_dn2))
    level = SkyLevel(np.full_like(dn, 460.0), noise_dn, 16)
    shot = a_shot(0)
    shot = replace(shot, photo=replace(shot.photo, dn=dn, exposure_s=0.5), level=level)
    pixels = _pixels([shot], assumed)
    assert pixels.gain_e_per_dn == 4.0
    # of a variance of 516 DN^2 by 76 800 pixels the response is 256: five standard deviations
    assert pixels.pattern.rms[0] == pytest.approx(0.04, rel=5 * 516 / 256 / math.sqrt(2 * dn.size))


@pytest.mark.parametrize("ramp_e", [0.0, 12_000.0])
def test_one_photograph_does_not_tell_the_gain_from_the_response(rng, ramp_e):
    """3 % of response was taken for shot noise: 0.65 e- a DN, where 17 is true; a gradient made
    it no better.
    """
    levels_e = SKY_E + ramp_e * np.linspace(-0.5, 0.5, SHAPE[1])
    pixels = fitted_transfer(photographs(rng, [levels_e]))
    assert pixels.gain_e_per_dn == GAIN
    assert not pixels.gain_told
    assert "gain_e_per_dn" not in pixels.sigma
    (note,) = [note for note in pixels.notes if "do not tell the gain" in note]
    percent = 100 * pixels.pattern.rms[0]
    assert f"the rest of the noise is a response of {percent:.2g} %, if no more" in note
    holds("navcam-response", percent)
    level_dn = np.array([SKY_E / GAIN])
    true_dn2 = (SKY_E + READ_E**2) / GAIN**2 + (PRNU * SKY_E / GAIN) ** 2 + 1 / 12
    assert pixels.variance_dn2(level_dn)[0] == pytest.approx(true_dn2, rel=0.02)


def test_several_photographs_of_one_level_tell_the_gain_with_its_sigma(rng):
    pixels = fitted_transfer(
        photographs(rng, [SKY_E] * 4), DetectorSettings(gain_e_per_dn=24, read_noise_e=READ_E)
    )
    assert pixels.gain_told
    sigma = pixels.sigma["gain_e_per_dn"]
    assert sigma < 0.05 * GAIN
    assert abs(pixels.gain_e_per_dn - GAIN) < SIGMAS * sigma


def test_columns_are_no_share_of_the_response(rng):
    """A column's mean has its pixels' response in it: 1.5 DN of columns were stated, where there
    are none.
    """
    pixels = fitted_transfer(photographs(rng, [SKY_E] * 4))
    assert pixels.pattern.rms[0] == pytest.approx(PRNU, rel=0.02)
    assert pixels.pattern.rms[2:] == (0.0, 0.0)


def test_one_photograph_of_levels_that_differ_widely_tells_the_gain(rng):
    """From 200 to 30 000 e- shot noise and response part: the gain is the photograph's own."""
    levels_e = np.geomspace(200.0, 30_000.0, SHAPE[1])
    pixels = fitted_transfer(
        photographs(rng, [levels_e]), DetectorSettings(gain_e_per_dn=24, read_noise_e=READ_E)
    )
    assert pixels.gain_told
    assert abs(pixels.gain_e_per_dn - GAIN) < SIGMAS * pixels.sigma["gain_e_per_dn"]


def test_a_gain_too_small_for_the_noise_is_named_with_the_least_that_is_possible(rng):
    pixels = fitted_transfer(
        photographs(rng, [SKY_E], prnu=0.0), DetectorSettings(gain_e_per_dn=5, read_noise_e=READ_E)
    )
    assert pixels.gain_e_per_dn == 5
    assert any("write [tracker.detector] gain_e_per_dn = 1" in note for note in pixels.notes)
    assert pixels.pattern.rms[0] == 0


def test_read_noise_is_what_variance_is_left_of_no_light_but_for_the_codes_own(rng):
    """A code's step adds 1/12 DN^2, a quarter of what a quiet sensor's electronics add."""
    gain, read_e = 2.0, 1.2
    level_dn = np.linspace(5.0, 200.0, 400)
    true_dn2 = level_dn / gain + (read_e / gain) ** 2 + 1 / 12
    points = np.column_stack([level_dn, true_dn2 * rng.normal(1.0, 1e-4, len(level_dn))])
    bench = DetectorSettings(gain_e_per_dn=gain, read_noise_e=10.0)
    pixels = fit_pixels(points, 1.0, None, bench, FixedPattern())
    assert pixels.gain_told
    assert pixels.gain_e_per_dn == pytest.approx(gain, rel=1e-3)
    assert pixels.read_noise_e == pytest.approx(read_e, rel=0.01)


def test_one_level_s_noise_is_of_light_and_of_reading():
    """A signal of 100 DN at 2 e-/DN has 50 DN^2 of shot noise; 4 e- of reading add 4."""
    gain, read_e, level_dn = 2.0, 4.0, 100.0
    true_dn2 = level_dn / gain + (read_e / gain) ** 2 + 1 / 12
    points = np.tile([level_dn, true_dn2], (400, 1))
    bench = DetectorSettings(gain_e_per_dn=5.0, read_noise_e=read_e)
    pixels = fit_pixels(points, 1.0, None, bench, FixedPattern(errors=(1e-9,) * 4))
    assert pixels.gain_told
    assert pixels.gain_e_per_dn == pytest.approx(gain)


def test_a_median_s_stated_error_is_the_scatter_of_medians(rng):
    draws = rng.normal(0.0, 2.0, (2000, 101))
    stated = np.mean([_median_error(draw) for draw in draws[:200]])
    # 2000 medians tell their scatter to 1.6 %; the law is of many values
    assert stated == pytest.approx(np.median(draws, axis=1).std(), rel=0.08)


PATTERN_SHAPE = (240, 200)
NOISE_DN = 5.0
# a square of 48 000 pixels' neighbours, weighed by their light, scatters by 1 % from device to device
DRAWN = 0.04


def pattern_photographs(rng, response, pixel_dn, column_dn, row_dn):
    """Eight photographs less their levels, the levels, and masks, of one detector whose fixed
    pattern has these sigmas: light that grows to the right and to the top, in turn.
    """
    height, width = PATTERN_SHAPE
    shares = response * rng.standard_normal(PATTERN_SHAPE)
    offsets_dn = pixel_dn * rng.standard_normal(PATTERN_SHAPE)
    offsets_dn += column_dn * rng.standard_normal(width)
    offsets_dn += row_dn * rng.standard_normal((height, 1))
    along_x = np.broadcast_to(np.linspace(100, 3000, width), PATTERN_SHAPE)
    along_y = np.broadcast_to(np.linspace(3000, 100, height)[:, None], PATTERN_SHAPE)
    for level_dn in [along_x, along_y] * 4:
        noise_dn = NOISE_DN * rng.standard_normal(PATTERN_SHAPE)
        off_dn = shares * level_dn + offsets_dn + noise_dn
        yield off_dn, level_dn, np.ones(PATTERN_SHAPE, dtype=bool)


@pytest.mark.parametrize(
    "planted",
    [(0.01, 0, 0, 0), (0, 12, 0, 0), (0, 0, 6, 0), (0, 0, 0, 6), (0.01, 12, 6, 3)],
    ids=["response", "pixels", "columns", "rows", "all"],
)
def test_each_part_of_a_fixed_pattern_is_told_from_the_others(rng, planted):
    """Columns of 6 DN were told as 5.7 DN of pixels, and 1 % of response as 1.2 DN besides."""
    pattern = fixed_pattern(pattern_photographs(rng, *planted))
    squares = np.square(planted)
    off = np.abs(pattern.squares - squares)
    assert np.all(off < SIGMAS * np.array(pattern.errors) + DRAWN * squares)
    assert np.array_equal(np.array(pattern.rms) > 0, squares > 0)
    light_dn = np.array([1000.0])
    variance_dn2 = (pattern.rms[0] * 1000) ** 2 + np.sum(np.square(pattern.rms[1:]))
    assert pattern.variance_dn2(light_dn) == pytest.approx(variance_dn2)


def test_one_level_has_all_pattern_as_response_and_what_no_noise_is_is_none(rng):
    """Light that is the same to the last bit in all photographs tells no offsets."""
    level_dn = np.full(PATTERN_SHAPE, 700.0)
    every = np.ones(PATTERN_SHAPE, dtype=bool)
    shares = 0.01 * rng.standard_normal(PATTERN_SHAPE)
    images = []
    for _ in range(4):
        off_dn = shares * level_dn + NOISE_DN * rng.standard_normal(PATTERN_SHAPE)
        images.append((off_dn, level_dn, every))
    pattern = fixed_pattern(images)
    assert pattern.rms == pytest.approx((0.01, 0, 0, 0), rel=DRAWN)
    assert "offsets of pixels" not in pattern.words()
    quiet = fixed_pattern([(np.zeros(PATTERN_SHAPE), level_dn, every)] * 3)
    assert quiet.rms == (0, 0, 0, 0)


def test_a_photograph_that_is_all_sources_has_no_pattern(rng):
    two = list(pattern_photographs(rng, 0.01, 0, 0, 0))[:2]
    off_dn, level_dn, every = two[0]
    covered = (off_dn, level_dn, ~every)
    assert fixed_pattern([covered, covered, covered]) is None
    with_it = fixed_pattern([covered, *two])
    assert with_it == fixed_pattern(two)


def test_a_fixed_pattern_s_words_have_each_part_in_its_unit():
    pattern = FixedPattern((1e-4, 144.0, 0.0, 9.0), (1e-6, 2.4, 2.0, np.inf))
    assert pattern.words() == (
        "response of pixels 1 +- 0.005 %, offsets of pixels 12 +- 0.1 DN, of columns under 2 DN"
    )


PEDESTAL_DN = 100.0


def skies(factors, slopes) -> tuple[list[np.ndarray], np.ndarray]:
    """One shade over the image, darker at its corners, times each sky's light and slope, above a
    pedestal; and the places of its blocks.
    """
    x, y = (part.ravel() / 12 - 0.5 for part in np.meshgrid(np.arange(13), np.arange(13)))
    shade = 300 * (1 - 0.5 * (x**2 + 0.6 * y**2))
    levels = []
    for factor, (along, down) in zip(factors, slopes, strict=True):
        levels.append(PEDESTAL_DN + factor * shade * np.exp(along * x + down * y))
    return levels, np.column_stack([x, y])


def test_skies_of_one_shade_tell_the_level_without_light():
    factors = (1.0, 2.5, 4.0)
    found = fit_pedestal(*skies(factors, ((0.1, -0.2), (-0.15, 0.05), (0.0, 0.1))))
    assert found is not None
    level_dn, sigma_dn = found
    assert level_dn == pytest.approx(PEDESTAL_DN, abs=0.5)
    # a hundredth of the darkest sky where photographs without one agree
    assert sigma_dn == pytest.approx(0.01 * 400, rel=0.3)
    two = fit_pedestal(*skies(factors[:2], ((0.1, -0.2), (-0.15, 0.05))))
    assert two is not None
    assert two == pytest.approx((PEDESTAL_DN, PEDESTAL_DN / 2), abs=0.5)


def test_a_pedestal_s_sigma_is_the_jackknife_s_of_leaving_out_one_sky(rng):
    """Of four skies, (n - 1) / n times the sum of squares about the mean of four pedestals."""
    factors = (1.0, 2.5, 4.0, 6.0)
    levels, places = skies(factors, ((0.1, -0.2), (-0.15, 0.05), (0.0, 0.1), (0.05, 0.0)))
    levels = [level + rng.normal(0, 4.0, level.shape) for level in levels]
    without = []
    for k in range(4):
        fitted = fit_pedestal(levels[:k] + levels[k + 1 :], places)
        assert fitted is not None
        without.append(fitted[0])
    found = fit_pedestal(levels, places)
    assert found is not None
    off_dn = np.array(without) - np.mean(without)
    assert found[1] > 0.02 * 400
    assert found[1] == pytest.approx(math.sqrt(0.75 * float((off_dn**2).sum())))


def test_skies_that_are_alike_or_single_tell_none():
    assert fit_pedestal(*skies((1.0, 1.1), ((0.1, 0.0), (0.0, 0.1)))) is None
    assert fit_pedestal(*skies((1.0,), ((0.1, 0.0),))) is None


def test_a_background_without_a_free_part_has_the_bench_file_s_detector():
    bench = DetectorSettings(gain_e_per_dn=3.0, read_noise_e=12.0, offset_dn=40.0)
    nothing = FixedPattern((0.0,) * 4, (0.0,) * 4)
    for pedestal, offset_dn in ((None, 40.0), ((55.0, 1.0), 55.0)):
        found = fit_pixels(np.empty((0, 2)), 1.0, pedestal, bench, nothing)
        assert (found.gain_e_per_dn, found.read_noise_e) == (3.0, 12.0)
        assert found.pedestal_dn == offset_dn
        assert "no part of the background is free of sources" in found.notes[0]
        assert not found.gain_told


def test_a_pixel_s_variance_is_of_its_light_above_the_pedestal_reading_and_rounding():
    """100 DN above 60 at 0.4 e- a DN are 250 DN^2, 4 e- are 10 DN, and steps of 6 DN are 3 DN^2;
    what lies under the pedestal has no light.
    """
    pixels = PixelFit(0.4, 60.0, 4.0, 6.0, {}, np.empty((0, 2)))
    found = pixels.variance_dn2(np.array([160.0, 60.0, 20.0]))
    assert found == pytest.approx([250 + 103, 103, 103])


@pytest.mark.parametrize(
    ("told_dn", "pedestal_dn"), [(40.0, 60.0), (80.0, 60.0), (20.0, 20.0), (100.0, 100.0)]
)
def test_a_pedestal_is_the_bench_s_unless_skies_are_three_sigmas_off_to_either_side(
    told_dn, pedestal_dn
):
    """Of levels of 300 DN a shade of 3 % is 9 DN, beside 5 DN of the skies' own: 10.3."""
    points = np.tile([300.0, 100.0], (400, 1))
    bench = DetectorSettings(gain_e_per_dn=5.0, read_noise_e=10.0, offset_dn=60.0)
    nothing = FixedPattern((0.0,) * 4, (math.inf,) * 4)
    pixels = fit_pixels(points, 1.0, (told_dn, 5.0), bench, nothing)
    assert pixels.pedestal_dn == pedestal_dn
    assert pixels.sigma["pedestal_dn"] == pytest.approx(math.hypot(5.0, 9.0))


def test_a_pattern_of_lines_is_in_half_of_the_differences():
    """Columns of 8 DN and rows of 6 DN: differences along a row have the one, down a column the
    other, of which points are the mean.
    """
    gain, read_e, light_dn = 4.0, 8.0, 200.0
    squares = (0.0, 0.0, 64.0, 36.0)
    pattern = FixedPattern(squares, (1e-9,) * 4)
    variance_dn2 = light_dn / gain + (read_e / gain) ** 2 + 1 / 12 + (64.0 + 36.0) / 2
    bench = DetectorSettings(gain_e_per_dn=9.0, read_noise_e=read_e)
    points = np.tile([light_dn, variance_dn2], (400, 1))
    pixels = fit_pixels(points, 1.0, None, bench, pattern)
    assert pixels.gain_told
    assert pixels.gain_e_per_dn == pytest.approx(gain)
