"""Requirements of a plan against its cases: for each a figure, the bound that the cases support,
and a verdict.

Each figure has a one-sided limit on either side at the requirement's confidence c. A maximum is
**met** where the upper limit is within it, **not met** where the lower one exceeds it, else **not
shown**; a minimum the other way round. The limits:

- rates by Clopper & Pearson (1934). Answers of one case go together, so their number is divided by
  the design effect, the
  variance between cases over the binomial one (Korn & Graubard 1998); where all or none are right,
  cases are counted;
- quantiles (a time, or an error with `share`) by order statistics, free of any distribution. A case
  that never had an attitude
  has an infinite time;
- what answers carry beside the attitude as answer_figures.py has it;
- a bias by Student's t, across the boresight the larger of x and y;
- a sigma by chi-square where the errors pass for Gaussian (kurtosis at 1 %), else by the bootstrap
  over blocks of cases;
- field-of-view and pixel error by the bootstrap. What the noise alone could hide is added to their
  upper limit.
"""

import math
import operator
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import stats

from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError
from hilstar.instruments.assess.budget import Decomposed, assess_cases
from hilstar.instruments.assess.components import HARMONICS, SURE_OF_MANY, Component
from hilstar.instruments.assess.places import Scale
from hilstar.instruments.campaign.answer_figures import answer_figure
from hilstar.instruments.campaign.case_table import Columns
from hilstar.instruments.campaign.figures import (
    BoundedFigure,
    TooFewCases,
    clopper_pearson,
    drawn_limits,
    quantile_limits,
    sigma_limits,
)
from hilstar.instruments.campaign.plan import (
    AXIS_QUANTITIES,
    QUANTITY_COLUMNS,
    SHARE_QUANTITIES,
    Require,
    checked_conditions,
)
from hilstar.instruments.campaign.results import MAX_FITTED_CASES, attitudes_of

AXIS_INDICES = {"x": [0], "y": [1], "z": [2], "cross": [0, 1], "roll": [2]}
COMPARISONS: dict[str, Callable[[Any, Any], Any]] = {
    **{
        "<=": operator.le,
        "<": operator.lt,
        ">=": operator.ge,
        ">": operator.gt,
        "==": operator.eq,
        "!=": operator.ne,
    }
}
MET, NOT_MET, NOT_SHOWN = "met", "not met", "not shown"
TIME_SHARE = 0.95  # a time's share where `share` is not given
MIN_TESTED, GAUSSIAN_P = 20, 0.01  # values, and the probability below which they are not Gaussian
MAX_MORE = 10_000_000  # cases: more are not worth a figure
WAVE_COLUMNS = 2 * len(HARMONICS)


@dataclass(frozen=True, slots=True)
class RequirementVerdict:
    """A requirement's verdict. `value` is the figure itself, None where it is not known, `low` and
    `high` its one-sided limits, `guard` what the limit was narrowed by for the bench, and `more`
    the cases still wanted.
    """

    require: Require
    cases: int
    value: float | None
    bound: float | None
    verdict: str
    more: int | None
    method: str
    low: float | None = None
    high: float | None = None
    guard: float = 0.0

    @property
    def margin(self) -> float | None:
        """How far the bound keeps the limit, less the guard band; negative where it does not. None
        where the figure is not known.
        """
        if self.require.minimum is None:
            if self.high is None:
                return None
            return self.require.limit - self.guard - self.high
        if self.low is None:
            return None
        return self.low - self.require.limit - self.guard

    @property
    def words(self) -> str:
        """The verdict in a line."""
        require = self.require
        verdict_text = f"{require.words}: {self.verdict}"
        if self.bound is not None and self.value is not None:
            if (self.verdict == NOT_MET) == (require.minimum is not None):
                side = "not more"
            else:
                side = "not less"
            verdict_text += (
                f", {self.value:.4g} in {self.cases} cases, {side} than {self.bound:.4g} at"
                f" {100 * require.confidence:g} %"
            )
        if self.verdict == NOT_SHOWN:
            verdict_text += (
                f"; about {self.more} more cases would show it" if self.more else f"; {self.method}"
            )
        return verdict_text


def verdicts_of(
    requires: list[Require],
    cases: Columns,
    scale: Scale,
    seed: int,
    bench_arcsec: tuple[float, float] | None = None,
    bench_s: float = 0.0,
) -> list[RequirementVerdict]:
    """The verdict of each requirement over the cases. Raises InputError for a condition on a column
    that is not there.

    `bench_arcsec` is how far the bench's own attitude may be off, across and about, and `bench_s`
    its own time: that is taken off an error's limit.
    """
    cases = cases.some(
        np.arange(len(cases.numbers["frames"]))
        % -(-len(cases.numbers["frames"]) // MAX_FITTED_CASES)
        == 0
    )
    decomposed: dict[str, Decomposed | InputError] = {}

    def parts(condition: str, some: Columns) -> Decomposed:
        if condition not in decomposed:
            try:
                decomposed[condition] = assess_cases(
                    *attitudes_of(some), scale, np.random.default_rng(seed)
                )
            except InputError as error:
                decomposed[condition] = error
        decomposition = decomposed[condition]
        if isinstance(decomposition, InputError):
            answers = int(np.isfinite(some.numbers["error_x_arcsec"]).sum())
            raise TooFewCases(str(decomposition), answers, max(30 - answers, 0) or None)
        return decomposition

    verdicts = []
    for require in requires:
        chosen = chosen_cases(require.condition, cases)
        some = cases.some(chosen)
        try:
            figure = _figure(
                require,
                some,
                partial(parts, require.condition, some),
                scale.resolution_px,
                np.random.default_rng(seed),
            )
        except TooFewCases as few:
            verdicts.append(
                RequirementVerdict(require, few.cases, None, None, NOT_SHOWN, few.more, str(few))
            )
            continue
        verdicts.append(judged_figure(require, figure, bench_arcsec, bench_s))
    return verdicts


def chosen_cases(condition: str, cases: Columns) -> npt.NDArray[np.bool_]:
    """Which cases (n,) meet a condition. Raises InputError for a key that is neither varied nor
    a column.
    """
    kinds = dict.fromkeys(cases.numbers, "float64") | dict.fromkeys(cases.texts, "text")
    chosen = np.ones(len(cases.numbers["frames"]), dtype=np.bool_)
    for name, comparison, value in checked_conditions(condition, kinds):
        column: Any = (
            np.array(cases.texts[name], dtype=object)
            if name in cases.texts
            else cases.numbers[name]
        )
        chosen &= np.asarray(COMPARISONS[comparison](column, value), dtype=np.bool_)
    return chosen


def judged_figure(
    require: Require,
    figure: BoundedFigure,
    bench_arcsec: tuple[float, float] | None = None,
    bench_s: float = 0.0,
) -> RequirementVerdict:
    """The verdict on a figure; the bench's own error narrows the limit (see `verdicts_of`)."""
    limit, maximum = require.limit, require.minimum is None
    bench_error = 0.0  # what of the error the bench could have made, or hidden
    if bench_arcsec is not None and require.quantity in AXIS_QUANTITIES and maximum:
        bench_error = bench_arcsec[1 if AXIS_INDICES[require.axis or "cross"] == [2] else 0]
        share = f"{100 * min(bench_error / figure.value, 1.0):.0f} %" if figure.value > 0 else "all"
        note = (
            f"{bench_error:.2g} arcsec taken off for the bench, which could have made {share} of it"
        )
        figure = replace(figure, method=f"{figure.method}; {note}")
    if bench_s and require.quantity == "time-bias" and maximum:
        bench_error = bench_s
        note = f"{bench_error:.2g} s taken off for the bench"
        figure = replace(figure, method=f"{figure.method}; {note}")
    met = figure.high <= limit - bench_error if maximum else figure.low >= limit
    missed = figure.low > limit + bench_error if maximum else figure.high < limit
    verdict = MET if met else NOT_MET if missed else NOT_SHOWN
    bound = figure.high if maximum != missed else figure.low
    more = _more(require, figure) if verdict == NOT_SHOWN else None
    value = figure.value if math.isfinite(figure.value) else None
    return RequirementVerdict(
        require,
        figure.cases,
        value,
        bound if math.isfinite(bound) else None,
        verdict,
        more,
        figure.method,
        figure.low if math.isfinite(figure.low) else None,
        figure.high if math.isfinite(figure.high) else None,
        bench_error,
    )


def _more(require: Require, figure: BoundedFigure) -> int | None:
    """How many more cases would decide, if the figure stays as it is; None where no number of
    cases would.
    """
    limit = require.limit
    maximum = require.minimum is None
    c = require.confidence
    if figure.rate is not None:
        count, of = figure.rate
        share = count / of
        allowed = limit if require.quantity in SHARE_QUANTITIES else 1 - _share(require)

        def decided(cases: int) -> bool:
            n = cases * of / figure.cases
            low, high = clopper_pearson(round(share * n), n, c)
            return (
                high <= allowed
                or low > allowed
                or (not maximum and (low >= allowed or high < allowed))
            )

        if share == allowed or not decided(MAX_MORE):
            return None
        # by halves: a count's steps move the end by a case or two
        few = figure.cases
        enough = MAX_MORE
        while enough - few > 1:
            middle = (few + enough) // 2
            few, enough = (few, middle) if decided(middle) else (middle, enough)
        return enough - figure.cases
    away = abs(limit - figure.value)
    if limit > figure.value:
        width = figure.high - figure.value
    else:
        width = figure.value - figure.low
    if not away or not math.isfinite(width) or width <= 0:
        return None
    more = math.ceil(figure.cases * (width / away) ** 2) - figure.cases
    return max(more, 1) if more <= MAX_MORE else None


def _share(require: Require) -> float:
    if require.share is None:
        return TIME_SHARE
    return require.share


def _figure(
    require: Require,
    cases: Columns,
    parts: Callable[[], Decomposed],
    resolution_px: tuple[int, int],
    rng: np.random.Generator,
) -> BoundedFigure:
    quantity = require.quantity
    c = require.confidence
    axes = AXIS_INDICES[require.axis or "cross"]
    count = len(cases.numbers["frames"])
    if not count:
        raise TooFewCases("no case meets its condition", 0)
    if quantity in QUANTITY_COLUMNS:
        return answer_figure(require, cases, axes, resolution_px, rng)
    if quantity in SHARE_QUANTITIES:
        return _rate(*_share_of(quantity, cases), c)
    if quantity in ("time-to-first-attitude", "recovery"):
        return _time(require, cases)
    if quantity == "nea" and np.nansum(cases.numbers["frames"] > 1):
        return _within(cases, axes, require, rng)
    return _decomposed(require, parts(), axes, rng)


def _share_of(quantity: str, cases: Columns) -> tuple[FloatArray, FloatArray]:
    """What is counted in each case (n,), and among how many (n,)."""
    solved, wrong = (np.nan_to_num(cases.numbers[name]) for name in ("solved", "wrong"))
    asked = np.nan_to_num(cases.numbers["frames"])
    shares = {
        "wrong-rate": (wrong, solved),
        "false-attitude": (wrong, asked),
        "no-attitude": (asked - solved, asked),
        "availability": (solved - wrong, asked),
    }
    return shares[quantity]


def _decomposed(
    require: Require, components: Decomposed, axes: list[int], rng: np.random.Generator
) -> BoundedFigure:
    """A figure of the error budget, and the wild answers that it leaves out."""
    figure = _of_parts(components, axes, require, rng)
    if len(components.wrong):
        return replace(
            figure, method=f"{figure.method}; {len(components.wrong)} wild answers left out"
        )
    return figure


def _of_parts(
    found: Decomposed, axes: list[int], require: Require, rng: np.random.Generator
) -> BoundedFigure:
    """A figure of the error budget's parts."""
    quantity = require.quantity
    c = require.confidence
    n = len(found.row)
    components = found.components
    if quantity == "bias":
        total = components.left + components.fov.fitted + components.pixel.fitted
        return _bias(components.mean[axes], total[:, axes].std(axis=0, ddof=1), n, c)
    if quantity in ("noise", "nea"):
        freedom = n - 1 - components.fov.freedom - components.pixel.freedom
        return _noise(
            components.left[:, axes] * math.sqrt(n / max(freedom, 1.0)), freedom, require, rng
        )
    if quantity == "fov-error":
        part = components.fov
    else:
        part = components.pixel
    if part.reason:
        raise TooFewCases(part.reason, n)
    return _repeating(part, components.noise_variance, axes, require, rng)


def _rate(hits: FloatArray, asked: FloatArray, confidence: float) -> BoundedFigure:
    """The rate of hits (n,) among what was asked (n,) of each case."""
    hits = hits[asked > 0]
    asked = asked[asked > 0]
    cases = len(asked)
    total = float(asked.sum())
    if not cases:
        raise TooFewCases("there is no answer", 0)
    share = float(hits.sum()) / total
    effective = total
    method = "Clopper-Pearson"
    if total > cases:
        method += " of cases"
        effective = float(cases)
        if 0 < share < 1 and cases > 1:
            between = cases / (cases - 1) * float(((hits - share * asked) ** 2).sum()) / total**2
            effect = max(between / (share * (1 - share) / total), 1.0)
            effective = max(total / effect, 1.0)
            method = f"Clopper-Pearson, design effect {effect:.3g}"
    low, high = clopper_pearson(share * effective, effective, confidence)
    return BoundedFigure(share, low, high, cases, method, (share * effective, effective))


def _quantile(values: FloatArray, require: Require, cases: int, method: str) -> BoundedFigure:
    share = _share(require)
    low, high = quantile_limits(values, share, require.confidence)
    ordered = np.sort(values)
    value = float(ordered[min(math.ceil(share * len(values)), len(values)) - 1])
    beyond = float((values > require.limit).sum())
    return BoundedFigure(value, max(low, 0.0), high, cases, method, (beyond, float(len(values))))


def _time(require: Require, cases: Columns) -> BoundedFigure:
    numbers = cases.numbers
    column, known = (
        ("first_attitude_s", "frames")
        if require.quantity != "recovery"
        else ("recovery_s", "fault_end_s")
    )
    if column not in numbers or known not in numbers:
        if column == "recovery_s":
            why = "the table has no such column: a plan that varies scenario has"
        else:
            why = "no such column"
        raise TooFewCases(f"{column}: {why}", 0)
    is_timed = np.isfinite(numbers[known])
    if not is_timed.any():
        raise TooFewCases("no fault ended within a case", 0)
    times = np.where(np.isfinite(numbers[column]), numbers[column], math.inf)[is_timed]
    return _quantile(times, require, len(times), "order statistics")


def _bias(mean: FloatArray, sigma: FloatArray, n: int, confidence: float) -> BoundedFigure:
    standard = sigma / math.sqrt(n)
    size = np.abs(mean)
    upper = stats.t.ppf(confidence, n - 1)
    # Bonferroni: of several axes any one may be the larger
    lower = stats.t.ppf(1 - (1 - confidence) / len(size), n - 1)
    low = max(float((size - lower * standard).max()), 0.0)
    return BoundedFigure(
        float(size.max()), low, float((size + upper * standard).max()), n, "Student's t"
    )


def _noise(
    left: FloatArray, freedom: float, require: Require, rng: np.random.Generator
) -> BoundedFigure:
    """The noise of errors (n, axes) that already have the spread of the noise itself."""
    n = len(left)
    c = require.confidence
    if require.share is not None:
        return _quantile(np.abs(left).ravel(), require, n, "order statistics")
    variance = float((left**2).mean())
    freedom = max(freedom, 1.0)
    # Few values cannot show that they are not Gaussian.
    if n < MIN_TESTED or float(stats.kurtosistest(left.ravel()).pvalue) > GAUSSIAN_P:
        low, high = sigma_limits(variance, freedom * left.shape[1], c)
        return BoundedFigure(math.sqrt(variance), low, high, n, "chi-square, Gaussian")
    low, high = np.sqrt(drawn_limits((left**2).mean(axis=1), np.ones(n), rng, c))
    return BoundedFigure(math.sqrt(variance), float(low), float(high), n, "bootstrap, not Gaussian")


def _within(
    cases: Columns, axes: list[int], require: Require, rng: np.random.Generator
) -> BoundedFigure:
    """The noise between the frames of a case, over all cases."""
    scatter = cases.vectors("scatter_{}_arcsec", "xyz")[:, axes]
    answers = cases.numbers["solved"] - cases.numbers["wrong"]
    some = np.isfinite(scatter).all(axis=1) & (answers > 1)
    if not some.any():
        raise TooFewCases("no case has two right answers", 0)
    square = (scatter[some] ** 2).mean(axis=1)
    freedom = answers[some] - 1
    variance = float(square @ freedom / freedom.sum())
    n = int(some.sum())
    method = "chi-square, Gaussian"
    if require.share is None:
        factor = 1.0
    else:
        factor = float(stats.norm.ppf((1 + require.share) / 2))
    excess = float((freedom * len(axes) * (square / max(variance, 1e-300) - 1) ** 2).mean()) / 2 - 1
    # 14: the variance of that square, one degree of freedom a case
    if n < MIN_TESTED or excess < 3 * math.sqrt(14 / n):
        low, high = sigma_limits(variance, float(freedom.sum()) * len(axes), require.confidence)
    else:
        low, high = np.sqrt(
            drawn_limits(square * freedom, freedom, rng, require.confidence)
        ).tolist()
        method = "bootstrap, not Gaussian"
    return BoundedFigure(factor * math.sqrt(variance), factor * low, factor * high, n, method)


def _repeating(
    part: Component,
    noise_variance: FloatArray,
    axes: list[int],
    require: Require,
    rng: np.random.Generator,
) -> BoundedFigure:
    n = len(part.fitted)
    c = require.confidence
    noise = float(noise_variance[axes].mean())
    variance = float(part.variance[axes].mean())
    taken = part.freedom / n * noise
    square = (part.fitted[:, axes] ** 2).mean(axis=1)
    low, high = (
        max(bound - taken, 0.0) for bound in drawn_limits(square, np.ones(n), rng, c).tolist()
    )
    if part.freedom:  # the noise in the fit: its own power, and what it adds to that of the part
        power = noise * (2 * part.freedom * noise / n + 4 * variance) / (n * len(axes))
        hidden = float(stats.norm.ppf(c)) * math.sqrt(power)
        method = "bootstrap over blocks of cases"
    else:  # no waves were sure: as much power as they would have needed may be there
        hidden = SURE_OF_MANY * math.sqrt(6 * WAVE_COLUMNS) / 3 * noise / n
        method = "what the search for it would have missed"
    low = max(variance - math.hypot(variance - min(low, variance), hidden), 0.0)
    high = variance + math.hypot(max(high, variance) - variance, hidden)
    factor = 1.0
    if require.share is not None and variance > 0:
        size = np.abs(part.fitted[:, axes]).ravel()
        factor = float(np.quantile(size, require.share)) / math.sqrt(float((size**2).mean()))
    elif require.share is not None:
        factor = float(stats.norm.ppf((1 + require.share) / 2))
    return BoundedFigure(
        factor * math.sqrt(variance), factor * math.sqrt(low), factor * math.sqrt(high), n, method
    )
