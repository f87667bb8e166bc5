"""The figures that requirements limit, of cases few enough to count by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from hilstar.instruments.assess.bounded_figures import (
    BoundedFigure,
    TooFewCases,
    clopper_pearson,
    drawn_limits,
    quantile_limits,
    sigma_limits,
)
from hilstar.instruments.assess.budget import Decomposed
from hilstar.instruments.assess.components import Component
from hilstar.instruments.assess.places import Scale
from hilstar.instruments.campaign import requirements
from hilstar.instruments.campaign.case_table import Columns
from hilstar.instruments.campaign.plan import Require
from hilstar.instruments.campaign.requirements import (
    MET,
    NOT_MET,
    NOT_SHOWN,
    RequirementVerdict,
    _bias,
    _noise,
    verdicts_of,
)
from tests.support.assessments import a_budget

SCALE = Scale(2000.0, (1024, 1024))
FRAMES = 10
# Of ten cases: frames with an attitude, and those of them that are wrong.
SOLVED = np.array([10, 10, 9, 8, 10, 10, 10, 7, 10, 6], dtype=float)
WRONG = np.array([0, 1, 0, 2, 0, 0, 3, 0, 0, 0], dtype=float)
NEVER = math.nan
TIMES_S = np.array([0.5, 0.1, 0.4, 0.2, 0.3, *(0.6 + 0.01 * np.arange(25))])


def cases_of(**columns: np.ndarray) -> Columns:
    """A table of cases with these columns."""
    count = len(next(iter(columns.values())))
    numbers = {"case": np.arange(count, dtype=float), "frames": np.full(count, float(FRAMES))}
    return Columns(count, numbers | columns, {})


def found(cases: Columns, quantity: str, **keys: object) -> RequirementVerdict:
    return verdicts_of([Require(quantity=quantity, **keys)], cases, SCALE, 1)[0]  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("quantity", "keys", "value"),
    [
        ("availability", {"minimum": 0.5}, (90 - 6) / 100),
        ("wrong-rate", {"maximum": 0.5}, 6 / 90),
        ("false-attitude", {"maximum": 0.5}, 6 / 100),
        ("no-attitude", {"maximum": 0.5}, 10 / 100),
    ],
)
def test_a_share_is_what_is_counted_among_what_was_asked(quantity, keys, value):
    verdict = found(cases_of(solved=SOLVED, wrong=WRONG), quantity, **keys)
    assert verdict.value == pytest.approx(value)
    assert verdict.low < value < verdict.high
    # answers of a case go together: fewer independent ones than there are frames
    counted = clopper_pearson(value * 100, 100, 0.95)
    assert verdict.low <= counted[0]
    assert verdict.high >= counted[1]


def test_frames_of_a_case_that_all_go_together_count_as_one():
    """Half of 20 cases have no attitude at all: not as 100 of 200, but as a variance between cases
    of 19 degrees of freedom has it.
    """
    solved = np.repeat([0.0, FRAMES], 10)
    verdict = found(cases_of(solved=solved, wrong=np.zeros(20)), "no-attitude", maximum=0.9)
    assert (verdict.low, verdict.high) == pytest.approx(clopper_pearson(9.5, 19, 0.95))
    assert "design effect 10.5" in verdict.method


@pytest.mark.parametrize(("share", "value"), [(0.5, 0.69), (0.1, 0.3), (1 / 30, 0.1), (0.9, 0.81)])
def test_a_time_is_the_quantile_of_its_share_of_cases(share, value):
    """Of 30 times in order the third is at a tenth of them, and the fifteenth at a half."""
    verdict = found(
        cases_of(first_attitude_s=TIMES_S), "time-to-first-attitude", maximum=9.0, share=share
    )
    assert verdict.value == pytest.approx(value)


def test_a_case_that_never_had_an_attitude_is_later_than_all_others():
    """Of 30 cases five never had one: half of them are in time as before, nine tenths are not."""
    times_s = TIMES_S.copy()
    times_s[:5] = NEVER
    cases = cases_of(first_attitude_s=times_s)
    median = found(cases, "time-to-first-attitude", maximum=2.0, share=0.5)
    assert (median.value, median.verdict) == (pytest.approx(0.74), MET)
    late = found(cases, "time-to-first-attitude", maximum=2.0, share=0.9)
    assert (late.value, late.high) == (None, None)
    assert late.verdict in (NOT_SHOWN, NOT_MET)


def test_a_recovery_counts_where_a_fault_ended_and_else_says_so():
    ended = np.where(np.arange(30) < 20, 4.0, np.nan)
    cases = cases_of(recovery_s=TIMES_S, fault_end_s=ended)
    assert found(cases, "recovery", maximum=9.0, share=1 / 20).value == pytest.approx(0.1)
    none = cases_of(recovery_s=TIMES_S, fault_end_s=np.full(30, np.nan))
    verdict = found(none, "recovery", maximum=9.0)
    assert (verdict.value, verdict.verdict) == (None, NOT_SHOWN)
    assert "no fault ended within a case" in verdict.words


def test_the_noise_within_cases_is_pooled_by_their_freedom():
    """3 arcsec of 10 answers, 1 arcsec of 4, a case without two: (9 x 9 + 3 x 1) / 12."""
    scatter = np.array([3.0, 1.0, 50.0])
    columns = {f"scatter_{axis}_arcsec": scatter for axis in "xyz"}
    cases = cases_of(solved=np.array([10.0, 6.0, 1.0]), wrong=np.array([0.0, 2.0, 0.0]), **columns)
    verdict = found(cases, "nea", maximum=9.0, axis="x")
    assert verdict.value == pytest.approx(math.sqrt(84 / 12))
    limits = sigma_limits(84 / 12, 12.0, 0.95)
    assert (verdict.low, verdict.high) == pytest.approx(limits)
    assert verdict.cases == 2
    within = found(cases, "nea", maximum=9.0, axis="x", share=0.997)
    assert within.value == pytest.approx(stats.norm.ppf(0.9985) * math.sqrt(84 / 12))


def test_the_noise_of_cases_of_one_frame_is_that_between_them(rng):
    """All over the sky, where nothing repeats: their standard deviation about the mean."""
    attitudes = Rotation.random(40, random_state=5).as_quat(scalar_first=True)
    errors = np.array([2.0, 3.0, 20.0]) * rng.standard_normal((40, 3)) + 50.0
    columns = {f"error_{axis}_arcsec": errors[:, k] for k, axis in enumerate("xyz")}
    for k, axis in enumerate("wxyz"):
        columns[f"q{axis}"] = columns[f"solved_q{axis}"] = attitudes[:, k]
    scatter = {f"scatter_{axis}_arcsec": np.full(40, np.nan) for axis in "xyz"}
    once = np.ones(40)
    cases = cases_of(frames=once, solved=once, wrong=0 * once, **columns, **scatter)
    for axis, chosen in (("x", [0]), ("cross", [0, 1]), ("roll", [2])):
        verdict = found(cases, "nea", maximum=900.0, axis=axis)
        variance = errors[:, chosen].var(axis=0, ddof=1).mean()
        assert verdict.value == pytest.approx(math.sqrt(variance))
        assert verdict.cases == 40


def test_a_bias_of_one_axis_has_student_s_limits():
    """5 +- 2 of 25 values: 5 +- 1.7109 x 0.4, where the other sign is out of reach."""
    figure = _bias(np.array([-5.0]), np.array([2.0]), 25, 0.95)
    assert figure.value == 5.0
    assert figure.high == pytest.approx(5 + 1.7109 * 0.4, abs=1e-4)
    assert figure.low == pytest.approx(5 - 1.7109 * 0.4, abs=1e-4)
    # of two axes the larger counts, and any one of them may be it
    two = _bias(np.array([-5.0, 1.0]), np.array([2.0, 2.0]), 25, 0.95)
    assert two.value == 5.0
    assert two.low == pytest.approx(5 - stats.t.ppf(0.975, 24) * 0.4, abs=1e-4)


def test_a_sigma_s_limits_are_those_of_chi_square():
    """Of 10 degrees of freedom 3.940 and 18.307 are the points of 5 and 95 %."""
    low, high = sigma_limits(4.0, 10.0, 0.95)
    assert low == pytest.approx(math.sqrt(40 / 18.307), rel=1e-4)
    assert high == pytest.approx(math.sqrt(40 / 3.940), rel=1e-4)


def test_a_noise_of_two_axes_has_the_freedom_of_both(rng):
    require = msgspec.convert({"quantity": "noise", "maximum": 9.0}, Require)
    left = rng.normal(0.0, 2.0, (60, 2))
    figure = _noise(left, 58.0, require, rng)
    assert figure.value == pytest.approx(math.sqrt((left**2).mean()))
    limits = sigma_limits(float((left**2).mean()), 116.0, require.confidence)
    assert (figure.low, figure.high) == pytest.approx(limits)


def test_a_quantile_s_limits_are_order_statistics():
    """Of 59 values the largest is above the 95 % quantile at 95 %: 1 - 0.95^59; of 58 it is not."""
    values = np.random.default_rng(1).permutation(np.arange(1.0, 60.0))
    assert quantile_limits(values, 0.95, 0.95)[1] == 59.0
    assert quantile_limits(values[values < 59], 0.95, 0.95)[1] == math.inf
    # the median of 11: the third and the ninth are one-sided limits at 96.7 %
    low, high = quantile_limits(np.arange(1.0, 12.0), 0.5, 0.95)
    assert (low, high) == (3.0, 9.0)


def test_a_bootstrap_keeps_what_goes_together_in_blocks(rng):
    """Of 4000 values that are alike in runs of 20, 200 are independent: sqrt(20) times as wide."""
    count = 4000
    runs = np.repeat(rng.standard_normal(count // 20), 20)
    apart = rng.standard_normal(count)
    widths = []
    for values in (runs, apart):
        low, high = drawn_limits(values, np.ones(count), rng, 0.95)
        widths.append(float(high - low) / values.std())
    # of 1000 drawn a quantile of 5 % is known to some percent; and 200 blocks to 5 %
    assert widths[1] == pytest.approx(2 * 1.645 / math.sqrt(count), rel=0.25)
    assert widths[0] == pytest.approx(2 * 1.645 / math.sqrt(count / 20), rel=0.25)


def test_a_verdict_s_words_say_the_limit_the_figure_and_what_would_decide():
    cases = cases_of(solved=SOLVED, wrong=WRONG)
    kept = found(cases, "availability", minimum=0.5)
    assert kept.verdict == MET
    assert f"met, 0.84 in 10 cases, not less than {kept.low:.4g} at 95 %" in kept.words
    assert kept.margin == pytest.approx(kept.low - 0.5)
    missed = found(cases, "availability", minimum=0.99)
    assert missed.verdict == NOT_MET
    assert f"not met, 0.84 in 10 cases, not more than {missed.high:.4g} at 95 %" in missed.words
    assert missed.margin < 0
    open_ = found(cases, "availability", minimum=0.83)
    assert open_.verdict == NOT_SHOWN
    assert f"about {open_.more} more cases would decide" in open_.words


# An interval of +-1 about the figure in 100 cases, a limit of 10: (1 / away)^2 times the cases.
@pytest.mark.parametrize(
    ("value", "bench_arcsec", "more"),
    [
        (9.5, 0.0, 300),
        (10.5, 0.0, 300),
        (10.0, 0.0, None),
        (9.0 + 1e-9, 0.0, 1),
        (7.5, 2.0, 300),
        (12.5, 2.0, 300),
        (8.5, 2.0, None),
        (11.5, 2.0, None),
    ],
)
def test_what_would_decide_is_more_cases_but_within_the_bench_s_error(value, bench_arcsec, more):
    """The bench's error is taken off the limit, and more cases make it no smaller."""
    figure = BoundedFigure(value, value - 1, value + 1, 100, "")
    require = Require(quantity="bias", maximum=10.0, axis="cross")
    verdict = requirements.judged_figure(require, figure, (bench_arcsec, bench_arcsec))
    assert (verdict.verdict, verdict.more) == (NOT_SHOWN, more)


def parts_of(rng: np.random.Generator, count: int = 400) -> Decomposed:
    """A budget of so many answers: noise of 2 and 3 arcsec across and 10 about, a wave of 4 about y
    that took 20 numbers, and no pixel error.
    """
    found = a_budget()
    left = np.array([2.0, 3.0, 10.0]) * rng.standard_normal((count, 3))
    wave = np.zeros((count, 3))
    wave[:, 1] = 4 * math.sqrt(2) * np.sin(np.arange(count))
    components = replace(
        found.components,
        mean=np.array([1.0, -7.0, 30.0]),
        left=left,
        noise_variance=np.array([4.0, 9.0, 100.0]),
        fov=Component(np.array([0.0, 16.0, 0.0]), wave, 20.0),
        pixel=Component(np.zeros(3), np.zeros((count, 3)), 0.0),
    )
    return replace(found, components=components, row=np.arange(count))


def figure_of(parts: Decomposed, quantity: str, axes: list[int], **keys: object):
    require = Require(quantity=quantity, maximum=1.0, **keys)  # type: ignore[arg-type]
    return requirements._of_parts(parts, axes, require, np.random.default_rng(1))


def test_parts_of_a_budget_are_the_figures_that_requirements_limit(rng):
    """Of 400 answers of which 21 numbers are taken; the wave's power is over both axes."""
    parts = parts_of(rng)
    left = parts.components.left
    spread = math.sqrt(400 / 379)
    for axes in ([0, 1], [1], [2]):
        noise = figure_of(parts, "noise", axes)
        assert noise.value == pytest.approx(spread * math.sqrt((left[:, axes] ** 2).mean()))
        ends = np.sqrt(379 * len(axes) / stats.chi2.isf([0.05, 0.95], 379 * len(axes)))
        assert (noise.low, noise.high) == pytest.approx(tuple(noise.value * ends), rel=0.02)
    fov = figure_of(parts, "fov-error", [0, 1])
    assert fov.value == pytest.approx(math.sqrt(8.0))
    assert 0.8 * fov.value < fov.low < fov.value < fov.high < 1.2 * fov.value
    bias = figure_of(parts, "bias", [0, 1])
    total = left + parts.components.fov.fitted
    upper = stats.t.ppf(0.95, 399) * total[:, :2].std(axis=0, ddof=1) / 20
    assert bias.value == 7.0
    assert bias.high == pytest.approx(7.0 + upper[1])
    assert figure_of(parts, "bias", [2]).value == 30.0


def test_a_share_of_noise_is_its_quantile_and_of_a_part_that_of_its_own_shape(rng):
    parts = parts_of(rng)
    sizes = math.sqrt(400 / 379) * np.abs(parts.components.left[:, [0, 1]]).ravel()
    noise = figure_of(parts, "noise", [0, 1], share=0.9)
    assert noise.value == pytest.approx(np.quantile(sizes, 0.9), rel=0.02)
    fov = figure_of(parts, "fov-error", [1], share=0.9)
    # a wave is within sqrt(2) sin(0.9 pi / 2) sigmas for 90 % of its time
    assert fov.value == pytest.approx(4 * math.sqrt(2) * math.sin(0.45 * math.pi), rel=0.02)


def test_a_part_that_was_not_found_may_be_what_its_search_would_have_missed(rng):
    parts = parts_of(rng)
    pixel = figure_of(parts, "pixel-error", [0, 1])
    assert (pixel.value, pixel.low) == (0.0, 0.0)
    assert 0 < pixel.high < 2.0
    assert pixel.method == "what the search for it would have missed"
    fewer = figure_of(parts_of(rng, 100), "pixel-error", [0, 1])
    assert fewer.high == pytest.approx(2 * pixel.high, rel=0.01)
    missing = replace(parts.components.pixel, reason="no motion")
    still = replace(parts, components=replace(parts.components, pixel=missing))
    with pytest.raises(TooFewCases, match="no motion"):
        figure_of(still, "pixel-error", [0, 1])


def test_noise_with_tails_has_the_limits_of_a_bootstrap(rng):
    parts = parts_of(rng)
    wild = parts.components.left * (1 + 9 * (rng.random((400, 1)) < 0.05))
    tailed = replace(parts, components=replace(parts.components, left=wild))
    noise = figure_of(tailed, "noise", [0, 1])
    assert noise.method == "bootstrap, not Gaussian"
    gaussian = figure_of(parts, "noise", [0, 1])
    assert noise.high / noise.low > 2 * gaussian.high / gaussian.low - 1
    assert noise.low < noise.value < noise.high


def test_a_part_is_as_sure_as_the_noise_in_its_fit_makes_it(rng):
    """Of fits that are alike in every answer a bootstrap has no width: what is left is the scatter
    of a noncentral chi-square, of 20 numbers an axis.
    """
    parts = parts_of(rng)
    count, freedom, noise = 400, 20.0, 4.0
    for axes, size in (([0], 3.0), ([0, 1], 3.0)):
        fitted = np.zeros((count, 3))
        fitted[:, axes] = size * np.where(np.arange(count) % 2, 1.0, -1.0)[:, None]
        variance = size**2 - freedom / count * noise
        fov = Component(np.full(3, variance), fitted, freedom)
        components = replace(parts.components, fov=fov, noise_variance=np.full(3, noise))
        figure = figure_of(replace(parts, components=components), "fov-error", axes)
        values = count * len(axes)
        chi_square = stats.ncx2(freedom * len(axes), values * variance / noise)
        hidden = stats.norm.ppf(0.95) * chi_square.std() * noise / values
        assert figure.value == pytest.approx(math.sqrt(variance))
        assert figure.low == pytest.approx(math.sqrt(variance - hidden))
        assert figure.high == pytest.approx(math.sqrt(variance + hidden))


@pytest.mark.parametrize(
    ("value", "axis", "told"),
    [
        (4.0, "cross", "1.5 arcsec taken off for the bench, which could have made 38 % of it"),
        (1.0, "cross", "1.5 arcsec taken off for the bench, which could have made 100 % of it"),
        (40.0, "roll", "10 arcsec taken off for the bench, which could have made 25 % of it"),
        (0.0, "z", "10 arcsec taken off for the bench, which could have made all of it"),
    ],
)
def test_a_verdict_says_how_much_of_an_error_the_bench_could_have_made(value, axis, told):
    figure = BoundedFigure(value, value, value, 100, "planted")
    require = Require(quantity="bias", maximum=90.0, axis=axis)
    assert requirements.judged_figure(require, figure, (1.5, 10.0)).method == f"planted; {told}"
    least = Require(quantity="availability", minimum=0.1)
    assert requirements.judged_figure(least, figure, (1.5, 10.0)).method == "planted"


@pytest.mark.parametrize(("count", "judged"), [(20, 20), (21, 11), (39, 20), (41, 14)])
def test_of_too_many_cases_some_are_judged_spread_over_all(count, judged, monkeypatch):
    monkeypatch.setattr(requirements, "MAX_FITTED_CASES", 20)
    solved = np.full(count, float(FRAMES))
    solved[0] = 0.0
    verdict = found(cases_of(solved=solved, wrong=np.zeros(count)), "availability", minimum=0.5)
    assert verdict.cases == judged
    assert verdict.value == pytest.approx(1 - 1 / judged)


def test_a_figure_that_no_case_tells_says_what_is_missing() -> None:
    """Frames without an answer, a table without the column, and one right answer a case."""
    count = 30
    none, one = np.zeros(count), np.ones(count)
    silent = cases_of(solved=none, wrong=none)
    single = cases_of(solved=one, wrong=none, **{f"scatter_{axis}_arcsec": one for axis in "xyz"})
    for cases, quantity, words in (
        (silent, "wrong-rate", "there is no answer"),
        (silent, "time-to-first-attitude", "first_attitude_s: no such column"),
        (silent, "recovery", "no such column: a plan that varies scenario has"),
        (single, "nea", "no case has two right answers"),
    ):
        verdict = found(cases, quantity, maximum=1.0)
        assert (verdict.value, verdict.verdict) == (None, NOT_SHOWN)
        assert words in verdict.words


def test_a_scatter_of_few_wild_cases_has_the_limits_of_a_bootstrap(rng) -> None:
    """Of 60 cases of ten answers three scatter tenfold: its square is 5.95 of 1."""
    scatter = np.ones(60)
    scatter[::20] = 10.0
    columns = {f"scatter_{axis}_arcsec": scatter for axis in "xyz"}
    cases = cases_of(solved=np.full(60, 10.0), wrong=np.zeros(60), **columns)
    verdict = found(cases, "nea", maximum=99.0)
    assert verdict.value == pytest.approx(math.sqrt(5.95))
    assert "bootstrap, not Gaussian" in verdict.method
    narrow = sigma_limits(5.95, 60 * 9 * 2.0, 0.95)
    assert 1.0 <= verdict.low < narrow[0] < verdict.value < narrow[1] < verdict.high


@pytest.mark.parametrize(("off", "more"), [(1e-2, 999_900), (2.9e-3, None)])
def test_more_cases_than_ten_million_are_not_worth_a_figure(off: float, more: int | None) -> None:
    """An interval of +-1 in 100 cases about a value so far from its limit: 100 / off^2 cases."""
    figure = BoundedFigure(10.0 - off, 9.0 - off, 11.0 - off, 100, "")
    verdict = requirements.judged_figure(Require(quantity="bias", maximum=10.0), figure, (0.0, 0.0))
    assert verdict.verdict == NOT_SHOWN
    assert verdict.more == (None if more is None else pytest.approx(more, abs=1))
