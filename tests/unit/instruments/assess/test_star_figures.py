"""Single stars against what was planted: turns that a frame's stars share, a map of a detector that
is no square, limits of a map and of a detection curve.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.instruments.assess import star_figures
from hilstar.instruments.assess.bounded_figures import TooFewCases, clopper_pearson
from hilstar.instruments.assess.star_drawing import _detection, star_drawing
from hilstar.instruments.assess.star_figures import (
    DetectionBins,
    StarTable,
    false_stars,
    half_seen,
    place_map,
    star_figure,
    without_turns,
)
from tests.support.card_texts import drawn_figures

SIZE_PX = (1200, 700)
CONFIDENCE = 0.975
NOISE_PX = 0.1
# 1600 numbers know a sigma to 1 / sqrt(2 n), of which a frame of four takes 1.5 of four: three of
# these
SIGMA_WITHIN = 3 / math.sqrt(2 * 1600 * 2.5 / 4)


def table(
    case: IntArray, places_px: FloatArray, offsets_px: FloatArray, v_mag: FloatArray | None = None
) -> StarTable:
    """Stars (n,) at places (2, n) with their offsets (2, n)."""
    count = len(case)
    same = np.full(count, 5.0)
    magnitudes = same if v_mag is None else v_mag
    none = np.zeros(count)
    return StarTable(case, *places_px, magnitudes, none, *offsets_px, none, magnitudes)


def places_in(count: int, rng: np.random.Generator) -> FloatArray:
    return np.stack([rng.uniform(-0.5, side - 0.5, count) for side in SIZE_PX])


def turned(places_px: FloatArray, angle_rad: FloatArray) -> FloatArray:
    """What a turn (n,) about the image's middle moves places (2, n) by, to the first order."""
    x, y = places_px - np.array([[599.5], [349.5]])
    return np.stack([-angle_rad * y, angle_rad * x])


@pytest.mark.parametrize("each", [4, 9])
def test_a_turn_that_a_frame_shares_is_taken_and_the_scatter_is_that_of_its_stars(each, rng):
    frames = 1600 // each
    frame = np.repeat(np.arange(frames), each)
    places_px = places_in(len(frame), rng)
    noise_px = NOISE_PX * rng.standard_normal(places_px.shape)
    turn_rad = rng.normal(0, 3e-4, frames)[frame]
    shift_px = rng.normal(0, 0.2, (2, frames))[:, frame]
    stars = table(frame, places_px, noise_px + shift_px + turned(places_px, turn_rad))

    found = without_turns(stars, frame, SIZE_PX)

    left_px = np.stack([found.dx_px, found.dy_px])
    assert np.sqrt((left_px**2).mean()) == pytest.approx(NOISE_PX, rel=SIGMA_WITHIN)
    # the same for other numbers of the frames, in any order
    order = rng.permutation(len(frame))
    shuffled = table(
        frame[order], places_px[:, order], np.stack([stars.dx_px, stars.dy_px])[:, order]
    )
    again = without_turns(shuffled, 7 * frame[order] - 3, SIZE_PX)
    assert again.dx_px == pytest.approx(found.dx_px[order], abs=1e-9)


def test_of_frames_with_two_stars_or_one_nothing_is_taken_and_nothing_given_back(rng):
    """They stand beside frames of ten, by which the map is told."""
    frame = np.concatenate([np.repeat(np.arange(60), 10), np.repeat([60, 61], 2), [62]])
    places_px = places_in(len(frame), rng)
    offsets_px = NOISE_PX * rng.standard_normal(places_px.shape)
    found = without_turns(table(frame, places_px, offsets_px), frame, SIZE_PX)
    assert found.dx_px[-5:] == pytest.approx(offsets_px[0, -5:])
    assert found.dy_px[-5:] == pytest.approx(offsets_px[1, -5:])
    assert np.abs(found.dx_px[:600] - offsets_px[0, :600]).max() > 0.1 * NOISE_PX


def test_the_map_of_a_detector_is_told_in_the_middles_of_its_parts_less_its_mean(rng):
    """A cubic along x that goes with y, on 1200 by 700 pixels, the first of which begins at -0.5."""
    places_px = places_in(500, rng)

    def bent(x_px: FloatArray, y_px: FloatArray) -> FloatArray:
        u, v = (x_px - 599.5) / 600, (y_px - 349.5) / 350
        return np.stack([u**3 + 0.3, u * v])

    stars = table(np.arange(500), places_px, bent(*places_px))
    found = place_map(stars, SIZE_PX, 4)
    assert sorted(set(found.x_px.tolist())) == [149.5, 449.5, 749.5, 1049.5]
    assert sorted(set(found.y_px.tolist())) == [87.0, 262.0, 437.0, 612.0]
    wanted = bent(found.x_px, found.y_px)
    assert found.dx_px == pytest.approx(wanted[0] - wanted[0].mean(), abs=1e-9)
    assert found.dy_px == pytest.approx(wanted[1] - wanted[1].mean(), abs=1e-9)
    with pytest.raises(TooFewCases, match="83 stars, and 84 are needed for a map"):
        place_map(table(np.arange(83), places_px[:, :83], places_px[:, :83]), SIZE_PX, 4)


def test_a_map_at_places_that_are_the_same_in_all_cases_is_as_unsure_as_noise_makes_it(rng):
    """The bootstrap over such cases has no width: what is left is what noise puts into 21 terms,
    to either side.
    """
    once = places_in(100, rng)
    case = np.repeat(np.arange(12), 100)
    bent = ((once[0] - 599.5) / 600) ** 2
    errors_px = np.stack([np.tile(bent, 12), np.zeros(1200)])
    noisy = errors_px + 0.2 * rng.standard_normal(errors_px.shape)
    figure = star_figure(
        "star-fov-error", table(case, np.tile(once, 12), noisy), SIZE_PX, CONFIDENCE, rng
    )
    above = figure.high**2 - figure.value**2
    below = figure.value**2 - figure.low**2
    assert above == pytest.approx(below)
    # noise of 0.2 by 1200 stars, in 20 terms of one axis: 7e-4 px^2 beside the map's power
    power = bent.var() / 2
    assert figure.value**2 == pytest.approx(power, abs=3 * math.sqrt(4 * power * 7e-4 / 20))
    assert 0.3 * 2 * math.sqrt(power * 7e-4 / 40) < above < power


@pytest.mark.parametrize("limit_mag", [5.0, 4.35])
def test_a_sharp_limit_is_where_the_last_star_was_reported(limit_mag, rng):
    """Bins begin at multiples of 0.05; two cases, of which one sees nothing."""
    v_mag = np.tile(np.arange(2.005, 7.0, 0.01), 2)
    case = np.repeat([3, 8], len(v_mag) // 2)
    offsets_px = np.where(v_mag < limit_mag, 0.0, np.nan) * np.ones((2, 1))
    bins = DetectionBins.of(table(case, places_in(len(v_mag), rng), offsets_px, v_mag))
    assert bins.middle_mag[[0, -1]] == pytest.approx([2.025, 6.975])
    assert bins.lit.tolist() == [[5] * 100] * 2
    seen = bins.middle_mag < limit_mag
    assert bins.reported.tolist() == [(5 * seen).tolist()] * 2
    assert bins.half_seen() == pytest.approx(limit_mag, abs=0.01)
    offsets_px[:, case == 8] = np.nan
    blind = DetectionBins.of(table(case, places_in(len(v_mag), rng), offsets_px, v_mag))
    assert blind.half_seen(np.array([0, 0])) == pytest.approx(limit_mag, abs=0.01)
    # nothing is seen, and all is: the ends of what was lit
    assert blind.half_seen(np.array([1])) == pytest.approx(2.025, abs=0.06)
    all_seen = half_seen(bins.middle_mag, bins.lit[0], bins.lit[0])
    assert all_seen == pytest.approx(6.975, abs=1e-9)


def test_a_limit_of_drawn_cases_is_by_the_stars_that_were_lit_in_them() -> None:
    """Ten bins of ten stars: all are seen but in the second case, which sees half of all bins'."""
    lit = np.full((2, 10), 10)
    reported = np.stack([lit[0], np.repeat([10, 0], 5)])
    middle_mag = 4.025 + 0.05 * np.arange(10)
    bins = DetectionBins(middle_mag, lit, reported)
    assert bins.half_seen(np.array([1])) == pytest.approx(4.25, abs=0.01)
    assert bins.half_seen(np.array([0])) == pytest.approx(middle_mag[-1], abs=1e-9)


@pytest.mark.parametrize("colour", [0.0, 0.1])
def test_a_colour_is_told_beside_a_signal_that_bends_with_the_light(colour, rng):
    """Stars that are the redder the further they are from V 5, by signals that are too: 0.1 mag at
    two magnitudes.
    """
    count = 600
    v_mag = rng.uniform(3, 7, count)
    bv = 0.2 * (v_mag - 5) ** 2 + 0.1 * rng.standard_normal(count)
    signal_mag = 0.025 * (v_mag - 5) ** 2 + colour * bv + 0.02 * rng.standard_normal(count)
    none = np.zeros((2, count))
    stars = table(np.arange(count) // 10, places_in(count, rng), none, v_mag)
    stars = replace(stars, bv=bv, signal_mag=signal_mag)
    figure = star_figure("star-colour", stars, SIZE_PX, CONFIDENCE, rng)
    # 0.02 mag over a colour's own 0.1 and the root of 600
    assert figure.value == pytest.approx(colour, abs=4 * 0.2 / math.sqrt(count))
    assert (figure.low > 0) == (colour > 0)


def test_detection_is_drawn_in_the_middles_of_twelve_bins_from_the_brightest_star(rng):
    """Four stars in each of the bins of half a magnitude but the fourth; the faintest is the last."""
    v_mag = np.concatenate([np.repeat(2.1 + 0.5 * np.arange(12), 4), [2.0, 8.0]])
    v_mag = v_mag[(v_mag < 3.5) | (v_mag > 4.0)]
    offsets_px = np.where(v_mag < 5.0, 0.0, np.nan) * np.ones((2, 1))
    stars = table(np.arange(len(v_mag)), places_in(len(v_mag), rng), offsets_px, v_mag)
    drawn = np.array(list(_detection(stars)))
    middles = 2.25 + 0.5 * np.delete(np.arange(12), 3)
    assert drawn[:, 0] == pytest.approx(middles, abs=1e-5)
    assert drawn[:, 1].tolist() == (middles < 5.0).astype(float).tolist()
    low, high = clopper_pearson(5, 5, 0.975)
    assert drawn[0, 2:] == pytest.approx([1 - low, high - 1])
    low, high = clopper_pearson(0, 4, 0.975)
    assert drawn[-2, 2:] == pytest.approx([0 - low, high])


def test_a_limit_of_detection_is_known_to_a_bin_where_all_cases_have_the_same(rng, monkeypatch):
    """Each case has a star every tenth of a magnitude from 3 to 6.9; those to 4.9 are reported."""
    monkeypatch.setattr(star_figures, "LIMIT_DRAWS", 5)
    v_mag = np.tile(3.0 + 0.1 * np.arange(40), 30)
    case = np.repeat(np.arange(30), 40)
    offsets_px = np.where(v_mag < 4.99, 0.0, np.nan) * np.ones((2, 1))
    stars = table(case, places_in(len(case), rng), offsets_px, v_mag)
    figure = star_figure("star-limit", stars, SIZE_PX, CONFIDENCE, rng)
    half_bin_mag = star_figures.LIMIT_BIN_MAG / 2
    assert 4.9 < figure.value < 5.0
    assert figure.low == pytest.approx(figure.value - half_bin_mag)
    assert figure.high == pytest.approx(figure.value + half_bin_mag)
    assert figure.cases == 30


@pytest.mark.parametrize("count", [0, 1, 4])
def test_false_stars_that_are_as_many_in_each_case_have_poisson_s_limits(count, rng):
    """By chi-square with 2 n and 2 n + 2 degrees of freedom; there is no scatter to draw from."""
    cases, frames = 6, 10.0
    figure = false_stars(np.full(cases, count), np.full(cases, frames), CONFIDENCE, rng)
    total, exposed = cases * count, cases * frames
    assert figure.value == pytest.approx(total / exposed)
    assert figure.high == pytest.approx(chi2.ppf(CONFIDENCE, 2 * total + 2) / 2 / exposed)
    low = chi2.ppf(1 - CONFIDENCE, 2 * total) / 2 / exposed if total else 0.0
    assert figure.low == pytest.approx(low)
    assert figure.cases == cases


def test_a_map_is_drawn_as_arrows_of_the_detector_whose_rows_go_down(rng):
    """Stars that are all off by a third of a pixel along x at the right edge, and by none left."""
    places_px = places_in(1600, rng)
    right = (places_px[0] + 0.5) / SIZE_PX[0]
    stars = table(np.arange(1600) // 40, places_px, np.stack([right / 3, np.zeros(1600)]))
    with drawn_figures() as drawn:
        text = star_drawing(stars, SIZE_PX)
    assert text.startswith("<")
    (figure,) = drawn
    _, axes = figure.axes
    (arrows,) = axes.collections
    wanted = place_map(stars, SIZE_PX, 8)
    assert arrows.get_offsets() == pytest.approx(np.stack([wanted.x_px, wanted.y_px], axis=1))
    # less the mean: from -7/16 to 7/16 of it, in the middles of eight columns
    dx_px, dy_px = arrows.U, arrows.V
    assert dx_px.reshape(8, 8)[0] == pytest.approx((np.arange(8) - 3.5) / 24)
    assert dy_px == pytest.approx(np.zeros(64), abs=1e-9)
    assert axes.yaxis_inverted()
    title = " ".join(figure.get_suptitle().split())
    assert title == f"Stars reported by magnitude; their places are off by at most {7 / 48:.2g} px"


@pytest.mark.parametrize("axis", [0, 1])
def test_a_map_over_the_whole_of_a_detector_is_no_noise_of_its_stars(axis, rng):
    """A cube of the place along an axis, up to a pixel at its ends, beside planted noise."""
    places_px = places_in(1600, rng)
    ends = (2 * places_px[axis] + 1) / SIZE_PX[axis] - 1
    offsets_px = NOISE_PX * rng.standard_normal(places_px.shape) + ends**3
    stars = table(np.arange(1600) // 40, places_px, offsets_px)
    figure = star_figure("star-noise", stars, SIZE_PX, CONFIDENCE, rng)
    assert figure.value == pytest.approx(NOISE_PX, rel=SIGMA_WITHIN)
    assert figure.low < figure.value < figure.high
