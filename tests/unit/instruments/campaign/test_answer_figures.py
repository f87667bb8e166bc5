"""What answers carry beside the attitude: planted errors of rates, stamps, aberration and stars are
found, and intervals hold at their stated confidence.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from scipy import stats

from hilstar.instruments.assess.bounded_figures import (
    BoundedFigure,
    drawn_limits,
    lowest_size,
    studentized_limits,
)
from hilstar.instruments.assess.case_fits import fit_by_cases, root_mean
from hilstar.instruments.campaign.case_table import Columns
from hilstar.instruments.campaign.cases import FRAME_RATE_ERRORS, FRAME_RATES
from hilstar.instruments.campaign.plan import Require
from hilstar.instruments.campaign.requirements import (
    MET,
    NOT_MET,
    NOT_SHOWN,
    RequirementVerdict,
    judged_figure,
    verdicts_of,
)
from hilstar.instruments.campaign.star_motion import (
    OBSERVER_KM_S,
    PARALLAX_TURN,
    YEARLY_TURN,
    YEARS,
)
from tests.support.planted_answers import (
    CASES,
    FRAMES,
    SCALE,
    WILD_SIGMAS,
    answers,
    old_places,
    reported_stars,
)

# found within 10 %, or within three standard errors where those are larger
SHARE, SIGMAS = 0.1, 3.0
COVERED, TRIES = 0.95, 200
# binomial: of 100 intervals at 95 % each way, 87 and fewer hold once in 680
INTERVALS, MIN_HELD = 100, 88
# binomial: of 1000 intervals at 95 %, 927 and fewer hold once in 1000
HEAVY_TRIES, MIN_HEAVY_HELD = 1000, 928
SQUARE_TRIES = 400
# sigma of the logarithm of a case's variance; binomial: of 200 limits at 92 %, 28 and more are
# before the truth once in 300
SKEW, MAX_BEFORE = 0.8, 28
# three sigmas of a binomial count
SIZE_TRIES, SIZE_BAND = 4000, 42
# binomial: of 800 tries at 5 %, over 59 are met once in 1000
JITTER_TRIES, MAX_JITTER_MET = 800, 59


def figure_verdict(cases: Columns, quantity: str, **keys: Any) -> RequirementVerdict:
    return verdicts_of([Require(quantity=quantity, **keys)], cases, SCALE, 1)[0]  # type: ignore[arg-type]


# quantity: the planted keys by size, the size, and how its cases are made
PLANTED: dict[str, tuple[Any, Any, float]] = {
    "rate-bias": (answers, lambda size: {"rate_bias": (size, 0.0, 0.0)}, 0.02),
    "rate-noise": (answers, lambda size: {"rate_noise": size}, 0.05),
    "rate-scale": (answers, lambda size: {"rate_scale": size}, 0.05),
    "rate-lag": (answers, lambda size: {"rate_lag": size}, 0.3),
    "time-bias": (answers, lambda size: {"stamp_bias": size}, 0.02),
    "time-jitter": (answers, lambda size: {"stamp_jitter": size}, 0.02),
    "aberration": (answers, lambda size: {"aberration": size}, 1.0),
    "star-noise": (reported_stars, lambda size: {"noise": size}, 0.3),
    "star-fov-error": (reported_stars, lambda size: {"fov": size}, 0.3),
    "star-colour": (reported_stars, lambda size: {"colour": size}, 0.1),
    "star-limit": (reported_stars, lambda size: {"limit": size}, 5.0),
    "false-stars": (reported_stars, lambda size: {"false": size}, 2.0),
}


LIMIT = "star-limit"  # its detection curves are drawn again and again: as long as all others


@pytest.mark.parametrize("quantity", [name for name in PLANTED if name != LIMIT])
def test_a_planted_error_is_found_and_judged(quantity: str, rng: np.random.Generator) -> None:
    found_and_judged(quantity, rng)


def test_a_planted_limit_of_magnitude_is_found_and_judged(rng: np.random.Generator) -> None:
    found_and_judged(LIMIT, rng)


def found_and_judged(quantity: str, rng: np.random.Generator) -> None:
    """Whether a planted error is found, and its limit judged on both sides."""
    make, keys, size = PLANTED[quantity]
    cases = make(rng, **keys(size))
    side = "minimum" if quantity == LIMIT else "maximum"
    broken = size * (1.5 if side == "minimum" else 0.5)
    found = figure_verdict(cases, quantity, **{side: broken})
    assert found.value is not None and found.low is not None and found.high is not None
    # one sigma by the one-sided limits at 95 %
    sigma = (found.high - found.low) / (2 * 1.645)
    assert abs(found.value - size) <= max(SHARE * size, SIGMAS * sigma)
    assert found.low < size * (1 + SHARE) and found.high > size * (1 - SHARE)
    assert found.verdict == NOT_MET and found.margin is not None and found.margin < 0
    kept = size * (0.5 if side == "minimum" else 1.5)
    assert figure_verdict(cases, quantity, **{side: kept}).verdict == MET


def test_one_value_a_case_has_the_covariance_of_a_mean(rng: np.random.Generator) -> None:
    values = rng.normal(3.0, 2.0, 6)
    fit = fit_by_cases(np.ones((6, 1)), values, np.arange(6))
    assert fit.value == pytest.approx([values.mean()])
    assert fit.covariance[0, 0] == pytest.approx(values.var(ddof=1) / 6)
    assert fit.freedom == pytest.approx([5.0])


@pytest.mark.parametrize("together", [0.0, 0.9])
def test_the_mean_square_of_errors_is_found_whether_or_not_they_go_together(
    rng: np.random.Generator, together: float
) -> None:
    """Twelve cases of eight rows and three terms: plain residuals lack 3 and 20 % of it."""
    case = np.repeat(np.arange(12), 8)
    squares = []
    for _ in range(SQUARE_TRIES):
        rates = rng.uniform(-1, 1, (12, 2))[case] + 0.1 * rng.standard_normal((96, 2))
        lasting = math.sqrt(together) * rng.standard_normal(12)[case]
        errors = lasting + math.sqrt(1 - together) * rng.standard_normal(96)
        fit = fit_by_cases(np.column_stack([np.ones(96), rates]), errors, case)
        squares.append(float((fit.even**2).mean()))
    error = np.std(squares) / math.sqrt(SQUARE_TRIES)
    assert math.fsum(squares) / SQUARE_TRIES == pytest.approx(1.0, abs=3 * error)


def test_the_size_of_nothing_is_shown_in_one_of_twenty(rng: np.random.Generator) -> None:
    """A figure of 0 may be seen with either sign, and counts as shown by its size."""
    seen = np.abs(rng.standard_normal(SIZE_TRIES))
    shown = sum(lowest_size(size, 1.0, math.inf, 0.05) > 0 for size in seen.tolist())
    assert abs(shown - 0.05 * SIZE_TRIES) <= SIZE_BAND
    # far from 0 the other sign does not count: the limit is the one-sided one
    assert lowest_size(10.0, 1.0, 20.0, 0.05) == pytest.approx(10 - stats.t.ppf(0.95, 20))


def test_limits_hold_where_a_few_cases_weigh_most(rng: np.random.Generator) -> None:
    """24 cases of two rows whose errors go together, by a column that is large in a few of them, as
    the turn by parallax is.
    """
    held = 0
    case = np.repeat(np.arange(24), 2)
    for _ in range(HEAVY_TRIES):
        column = rng.lognormal(0.0, 1.5, 24)[case] * rng.choice([-1, 1], 24)[case]
        errors = rng.normal(size=24)[case] + 0.5 * rng.normal(size=48)
        fit = fit_by_cases(np.stack([np.ones(48), column], axis=1), errors + 3 * column, case)
        sigma = math.sqrt(fit.covariance[1, 1])
        held += fit.value[1] - 3 <= stats.t.ppf(COVERED, fit.freedom[1]) * sigma
    assert held >= MIN_HEAVY_HELD


def test_a_late_stamp_and_a_slow_gyroscope_are_found_in_seconds(
    rng: np.random.Generator,
) -> None:
    """Stamps 20 ms off, and rates that lag by 0.3 s: errors of arcsec and deg/s in slews."""
    late = figure_verdict(answers(rng, stamp_bias=0.02), "time-bias", maximum=1.0)
    assert late.value == pytest.approx(0.02, rel=0.05)
    lagging = figure_verdict(answers(rng, rate_lag=0.3), "rate-lag", maximum=0.28)
    assert lagging.value == pytest.approx(0.3, rel=0.05)


def test_a_case_without_an_attitude_tells_nothing_of_the_aberration(
    rng: np.random.Generator,
) -> None:
    cases = answers(rng, aberration=1.0)
    numbers = {name: values.copy() for name, values in cases.numbers.items()}
    numbers["qw"][:3] = np.nan
    whole = figure_verdict(cases, "aberration", maximum=2.0)
    some = dataclasses.replace(cases, numbers=numbers)
    fewer = figure_verdict(some, "aberration", maximum=2.0)
    assert fewer.cases == whole.cases - 3
    assert fewer.value == pytest.approx(1.0, abs=0.1)


def test_a_lag_is_told_about_an_axis_about_which_cases_accelerate(
    rng: np.random.Generator,
) -> None:
    cases = answers(rng, rate_lag=0.3)
    still = np.zeros_like(cases.numbers["vary.acceleration_deg_s2.x"])
    numbers = cases.numbers | {"vary.acceleration_deg_s2.x": still}
    cases = dataclasses.replace(cases, numbers=numbers)
    words = figure_verdict(cases, "rate-lag", maximum=0.5, axis="x").words
    assert "no case accelerates about that axis" in words
    about_y = figure_verdict(cases, "rate-lag", maximum=0.5, axis="y")
    assert about_y.value == pytest.approx(0.3, rel=0.05)


@pytest.mark.parametrize("quantity", ["rate-bias", "rate-scale", "time-bias", "aberration"])
def test_limits_hold_at_their_confidence(quantity: str, rng: np.random.Generator) -> None:
    make, keys, size = PLANTED[quantity]
    above = below = 0
    for _ in range(INTERVALS):
        found = figure_verdict(
            make(rng, 40, **keys(size)), quantity, maximum=size, axis=_axis(quantity)
        )
        assert found.low is not None and found.high is not None
        above += found.high >= size
        below += found.low <= size
    assert above >= MIN_HELD and below >= MIN_HELD


def test_a_jitter_at_its_limit_is_met_in_one_of_twenty(rng: np.random.Generator) -> None:
    size = 0.02
    figures = []
    for _ in range(JITTER_TRIES):
        cases = answers(rng, 40, stamp_jitter=size)
        figures.append(figure_verdict(cases, "time-jitter", maximum=size))
    met = sum(figure.verdict == MET for figure in figures)
    assert met <= MAX_JITTER_MET
    # the fit of bias and stamp takes 1.3 % of the variance of 200 answers, which is given back
    squares = [figure.value**2 for figure in figures if figure.value is not None]
    assert math.fsum(squares) / len(figures) == pytest.approx(size**2, rel=0.01)


def _axis(quantity: str) -> str | None:
    return "x" if quantity.startswith("rate-") else None


@pytest.mark.parametrize(("wild", "is_left_out"), [(0.01, True), (0.1, False)])
def test_few_wild_rates_are_left_out_by_name_and_many_are_noise(
    wild: float, is_left_out: bool, rng: np.random.Generator
) -> None:
    """Of 3360 rates some 34, or 336, are 20 sigmas off: of these the variance is 41 times as large."""
    noise = 0.05
    cases = answers(rng, 140, rate_noise=noise, wild=wild)
    judged = figure_verdict(cases, "rate-noise", maximum=1.0, axis="cross")
    assert judged.value is not None
    assert ("rates left out" in judged.method) == is_left_out
    true = noise if is_left_out else noise * math.sqrt(1 + WILD_SIGMAS**2 * wild)
    # the wild ones' number and squares are known to 1 / sqrt(120) and worse
    assert judged.value == pytest.approx(true, rel=SHARE if is_left_out else 2 * SHARE)


def test_the_noise_of_stars_that_come_again_in_each_frame_is_whole(
    rng: np.random.Generator,
) -> None:
    """At rest a star is off by the same in every frame: the map's 21 terms take as much of four
    frames' stars as of one's, which is 21 of 10 x 30.
    """
    noise, tries = 0.1, 40
    squares = []
    for _ in range(tries):
        once = reported_stars(rng, 10, noise=noise, limit=9.0)
        lists = {}
        for name, values in once.lists.items():
            lists[name] = [np.tile(own, 4) for own in values]
        again = Columns(10, once.numbers, {}, lists)
        judged = figure_verdict(again, "star-noise", maximum=1.0)
        assert judged.value is not None
        squares.append(judged.value**2)
    # three sigmas of a mean square of 40 x 600 errors, each four times; the map's terms, taken as
    # if of 1200 stars, would leave it 5 % too small
    assert np.mean(squares) == pytest.approx(noise**2, rel=0.029)


def test_the_upper_end_of_a_noise_that_differs_by_case_is_before_the_truth_less_often(
    rng: np.random.Generator,
) -> None:
    """Variances of cases as fields' stars make them: lognormal, of 24 cases."""
    true = math.exp(0.5 * SKEW**2)
    before = {"percentile": 0, "bootstrap-t": 0}
    for _ in range(TRIES):
        own = np.exp(SKEW * rng.standard_normal(24))
        _, percentile = drawn_limits(own, np.ones(24), rng, COVERED)
        _, studentized = studentized_limits(own, np.ones(24), rng, COVERED)
        before["percentile"] += int(percentile < true)
        before["bootstrap-t"] += int(studentized < true)
    assert before["bootstrap-t"] <= MAX_BEFORE < before["percentile"]


def test_a_signal_that_is_not_linear_in_light_is_no_colour(rng: np.random.Generator) -> None:
    """A signal that saturates by 0.1 mag at V 2, beside stars that are the bluer the brighter."""
    cases = reported_stars(rng, 200)
    for k, v_mag in enumerate(cases.lists["star_v_mag"]):
        cases.lists["star_bv"][k] = 0.3 * v_mag + rng.uniform(-0.5, 0.5, len(v_mag))
        cases.lists["star_signal_mag"][k] += 0.004 * np.maximum(7 - v_mag, 0) ** 2
    found = figure_verdict(cases, "star-colour", maximum=0.01)
    assert found.low == 0.0 and found.verdict == MET


def test_magnitudes_in_the_place_of_signals_are_named(rng: np.random.Generator) -> None:
    cases = reported_stars(rng)
    for k, lit_mag in enumerate(cases.lists["star_lit_mag"]):
        cases.lists["star_signal_mag"][k] = -2 * lit_mag
    found = figure_verdict(cases, "star-colour", maximum=0.1)
    assert found.value is None and "give DN, or 10^(-0.4 m)" in found.method


def test_slews_of_one_sign_do_not_tell_a_stamp_from_a_bias(rng: np.random.Generator) -> None:
    cases = answers(rng)
    for name in FRAME_RATES:
        cases.lists[name] = [np.abs(values) for values in cases.lists[name]]
    found = figure_verdict(cases, "time-bias", maximum=0.01)
    assert found.verdict == NOT_SHOWN and "both signs" in found.method


@pytest.mark.parametrize(
    "factor, told",
    [(180 / math.pi, "as in deg/s"), (-1.0, "rad/s of the opposite sign"), (1e3, "as in mrad/s")],
)
def test_rates_in_another_unit_are_not_judged(
    factor: float, told: str, rng: np.random.Generator
) -> None:
    cases = answers(rng)
    for rates, errors in zip(FRAME_RATES, FRAME_RATE_ERRORS, strict=True):
        for k, true in enumerate(cases.lists[rates]):
            cases.lists[errors][k] = factor * (true + cases.lists[errors][k]) - true
    for quantity in ("rate-bias", "rate-noise", "rate-scale"):
        found = figure_verdict(cases, quantity, maximum=0.01)
        assert found.value is None and found.more is None and told in found.method


def test_a_figure_of_noise_wants_many_more_cases(rng: np.random.Generator) -> None:
    """A size beyond the limit whose interval reaches from 0 far above: its lower side is cut off,
    and says nothing of how few cases would do.
    """
    figure = BoundedFigure(3.42, 0.0, 60.7, 24, "")
    found = judged_figure(Require(quantity="parallax", maximum=1.0), figure)
    # the upper side is as wide as one sigma times so much: it shrinks by the root of the cases
    assert found.more == math.ceil(24 * ((60.7 - 3.42) / 2.42) ** 2) - 24


def test_answers_without_rates_or_stars_say_so(rng: np.random.Generator) -> None:
    cases = answers(rng)
    for name in FRAME_RATE_ERRORS:
        cases.lists[name] = [np.full(FRAMES, np.nan)] * CASES
    found = figure_verdict(cases, "rate-bias", maximum=0.01)
    assert found.value is None and found.more is None and "no rate" in found.method
    assert "no single stars" in figure_verdict(answers(rng), "star-noise", maximum=0.1).method


@pytest.mark.parametrize(
    ("squares", "value", "high"),
    [
        (np.zeros(80), 0.0, 0.0),
        (np.full(80, 4.0), 2.0, 2.0),
        (np.tile([1.0, -1.0], 40), 0.0, 0.0),  # excesses that cancel in each case
    ],
    ids=["none", "alike", "cancel"],
)
def test_noise_that_is_alike_in_every_case_has_limits_without_width(
    squares: np.ndarray, value: float, high: float, rng: np.random.Generator
) -> None:
    """A tracker without noise got limits that are no numbers."""
    case = np.repeat(np.arange(20), 4)
    figure = root_mean(squares, np.ones(80), case, 0.975, rng)
    assert figure.value == pytest.approx(value, abs=1e-12)
    assert figure.high == pytest.approx(high, abs=1e-12)
    assert figure.low <= figure.value
    assert "one case" not in figure.method


def test_a_case_that_has_most_of_the_squares_is_named(rng: np.random.Generator) -> None:
    squares = np.append(60.0, np.ones(79))
    figure = root_mean(squares, np.ones(80), np.repeat(np.arange(20), 4), 0.975, rng)
    assert "one case has 45% of the squares" in figure.method  # 63 of 139


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_old_places_are_told_by_their_age_at_the_date_and_by_what_is_left_of_their_motion(
    sign: float, rng: np.random.Generator
) -> None:
    """Of stars that follow a third of their motion, 12 years old at the bench's date; or of a
    parallax of which a half is left.
    """
    planted = {"proper_motion": sign * 0.3, "age": 12.0}
    cases = old_places(rng, **planted)
    motion = figure_verdict(cases, "proper-motion", maximum=1.0)
    age = figure_verdict(cases, "catalogue-age", maximum=100.0)
    assert_found(motion, 0.3)
    assert_found(age, 12.0)
    assert_found(figure_verdict(old_places(rng, parallax=sign * 0.5), "parallax", maximum=1.0), 0.5)


def assert_found(verdict: RequirementVerdict, value: float) -> None:
    """Within four standard errors, which are small: a term's size has no sign."""
    assert verdict.value is not None and verdict.low is not None and verdict.high is not None
    sigma = (verdict.high - verdict.low) / (2 * stats.norm.isf(1 - COVERED))
    assert abs(verdict.value - value) < 4 * sigma < 0.2 * value


def test_places_of_one_date_tell_no_motion(rng: np.random.Generator) -> None:
    cases = old_places(rng, age=12.0)
    numbers = cases.numbers | {YEARS: np.full(cases.cases, 3.0)}
    one_date = dataclasses.replace(cases, numbers=numbers)
    verdict = figure_verdict(one_date, "proper-motion", maximum=1.0)
    assert (verdict.value, verdict.method) == (None, "cases at several dates tell it")
    assert figure_verdict(one_date, "catalogue-age", maximum=100.0).value is not None


@pytest.mark.parametrize(
    ("quantity", "gap"),
    [
        ("parallax", "error_y_arcsec"),
        ("parallax", PARALLAX_TURN.format("y")),
        ("parallax", OBSERVER_KM_S.format("z")),
        ("proper-motion", "error_y_arcsec"),
        ("proper-motion", YEARLY_TURN.format("y")),
    ],
)
def test_a_case_without_all_of_a_turn_tells_nothing_of_it(
    quantity: str, gap: str, rng: np.random.Generator
) -> None:
    cases = old_places(rng, proper_motion=0.5, parallax=0.5)
    whole = figure_verdict(cases, quantity, maximum=1.0)
    values = cases.numbers[gap].copy()
    values[:3] = np.nan
    some = dataclasses.replace(cases, numbers=cases.numbers | {gap: values})
    fewer = figure_verdict(some, quantity, maximum=1.0)
    assert fewer.cases == whole.cases - 3
    assert fewer.value is not None and math.isfinite(fewer.value)


def test_a_parallax_is_told_with_how_far_it_turns_a_field_in_both_axes(
    rng: np.random.Generator,
) -> None:
    cases = old_places(rng, parallax=0.5)
    numbers = dict(cases.numbers)
    for axis, turn_arcsec in (("x", 3.0), ("y", 4.0)):
        name = PARALLAX_TURN.format(axis)
        numbers[name] = turn_arcsec * np.sign(numbers[name])
    found = figure_verdict(dataclasses.replace(cases, numbers=numbers), "parallax", maximum=9.0)
    assert "turns of 5 arcsec rms" in found.method


def test_cases_without_a_frame_that_reports_stars_tell_nothing_of_false_ones(
    rng: np.random.Generator,
) -> None:
    cases = reported_stars(rng, false=2.0)
    silent = CASES // 4
    frames = cases.numbers["star_frames"].copy()
    false = cases.numbers["star_false"].copy()
    frames[:silent] = 0.0
    false[:silent] = 99.0
    numbers = cases.numbers | {"star_frames": frames, "star_false": false}
    found = figure_verdict(dataclasses.replace(cases, numbers=numbers), "false-stars", maximum=9.0)
    assert found.cases == CASES - silent
    assert found.value == pytest.approx(false[silent:].sum() / frames[silent:].sum())
