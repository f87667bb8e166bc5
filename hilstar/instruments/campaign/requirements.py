"""Requirements of a plan against its cases: for each a figure, the bound that the cases support,
and a verdict.

Each figure has a one-sided limit on either side at the requirement's confidence c. A maximum is
**met** where the upper limit is within it, **not met** where the lower one exceeds it, else **not
shown**; a minimum the other way round. The limits:

- rates by Clopper & Pearson (1934). Answers of one case go together, so their number is divided by
  the design effect, the variance between cases over the binomial one (Korn & Graubard 1998); where
  all or none are right, cases are counted;
- quantiles (a time, or an error with `share`) by order statistics, free of any distribution. A case
  that never had an attitude has an infinite time;
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
from hilstar.instruments.assess.bounded_figures import (
    BoundedFigure,
    TooFewCases,
    clopper_pearson,
    drawn_limits,
    lowest_size,
    quantile_limits,
    sigma_limits,
)
from hilstar.instruments.assess.budget import Decomposed, assess_cases
from hilstar.instruments.assess.components import HARMONICS, SURE_OF_MANY, Component
from hilstar.instruments.assess.places import Scale
from hilstar.instruments.campaign.answer_figures import answer_figure
from hilstar.instruments.campaign.case_table import Columns
from hilstar.instruments.campaign.plan import (
    AXIS_QUANTITIES,
    QUANTITY_COLUMNS,
    SHARE_QUANTITIES,
    Require,
    checked_conditions,
)
from hilstar.instruments.campaign.results import MAX_FITTED_CASES, attitudes_of
from hilstar.server.bench.bench_file import BenchFile
from hilstar.server.bench.certificate_file import Certificate

AXIS_INDICES = {"x": [0], "y": [1], "z": [2], "cross": [0, 1], "roll": [2]}
COMPARISONS: dict[str, Callable[[Any, Any], Any]] = {
    "<=": operator.le,
    "<": operator.lt,
    ">=": operator.ge,
    ">": operator.gt,
    "==": operator.eq,
    "!=": operator.ne,
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
            percent = 100 * require.confidence
            verdict_text += f", {self.value:.4g} in {self.cases} cases"
            verdict_text += f", {side} than {self.bound:.4g} at {percent:g} %"
        if self.verdict != NOT_SHOWN:
            return verdict_text
        if self.more:
            return f"{verdict_text}; about {self.more} more cases would decide"
        return f"{verdict_text}; {self.method}"


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
    count = len(cases.numbers["frames"])
    step = -(-count // MAX_FITTED_CASES)
    cases = cases.some(np.arange(count) % step == 0)
    decomposed: dict[str, Decomposed | InputError] = {}

    def parts(condition: str, some: Columns) -> Decomposed:
        if condition not in decomposed:
            rng = np.random.default_rng(seed)
            try:
                commanded, reported = attitudes_of(some)
                decomposed[condition] = assess_cases(commanded, reported, scale, rng)
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
        some_parts = partial(parts, require.condition, some)
        rng = np.random.default_rng(seed)
        try:
            figure = _figure(require, some, some_parts, scale.resolution_px, rng)
        except TooFewCases as few:
            why = str(few)
            verdict = RequirementVerdict(require, few.cases, None, None, NOT_SHOWN, few.more, why)
        else:
            verdict = judged_figure(require, figure, bench_arcsec, bench_s)
        verdicts.append(verdict)
    return verdicts


def bench_error(
    file: BenchFile, certificate: Certificate | None
) -> tuple[tuple[float, float] | None, float]:
    """How far a bench's own attitude may be off at 95 %, arcsec across and about, and its own time,
    s; None and 0 where no certificate says it.
    """
    if certificate is None:
        return None, 0.0
    late_ms = certificate.late_ms(file.config.monitor.panel_delay_ms) or 0.0
    return certificate.attitude_arcsec, late_ms / 1e3


def chosen_cases(condition: str, cases: Columns) -> npt.NDArray[np.bool_]:
    """Which cases (n,) meet a condition. Raises InputError for a key that is neither varied nor
    a column.
    """
    kinds = dict.fromkeys(cases.numbers, "float64") | dict.fromkeys(cases.texts, "text")
    chosen = np.ones(len(cases.numbers["frames"]), dtype=np.bool_)
    for name, comparison, value in checked_conditions(condition, kinds):
        column: Any
        if name in cases.texts:
            column = np.array(cases.texts[name], dtype=object)
        else:
            column = cases.numbers[name]
        met = COMPARISONS[comparison](column, value)
        chosen &= np.asarray(met, dtype=np.bool_)
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
        across, about = bench_arcsec
        bench_error = across
        if AXIS_INDICES[require.axis or "cross"] == [2]:
            bench_error = about
        share = "all"
        if figure.value > 0:
            percent = 100 * min(bench_error / figure.value, 1.0)
            share = f"{percent:.0f} %"
        note = f"{bench_error:.2g} arcsec taken off for the bench"
        note = f"{note}, which could have made {share} of it"
        figure = replace(figure, method=f"{figure.method}; {note}")
    if bench_s and require.quantity == "time-bias" and maximum:
        bench_error = bench_s
        note = f"{bench_error:.2g} s taken off for the bench"
        figure = replace(figure, method=f"{figure.method}; {note}")
    low, high = figure.low, figure.high
    if maximum:
        met = high <= limit - bench_error
        missed = low > limit + bench_error
    else:
        met = low >= limit
        missed = high < limit
    verdict, more = NOT_SHOWN, None
    if met:
        verdict = MET
    elif missed:
        verdict = NOT_MET
    else:
        more = _more(require, figure, bench_error)
    bound = low
    if maximum != missed:
        bound = high
    return RequirementVerdict(
        require,
        figure.cases,
        _finite(figure.value),
        _finite(bound),
        verdict,
        more,
        figure.method,
        _finite(low),
        _finite(high),
        bench_error,
    )


def _finite(value: float) -> float | None:
    """A value, None where it is infinite or unknown."""
    if math.isfinite(value):
        return value
    return None


def _more(require: Require, figure: BoundedFigure, bench_error: float) -> int | None:
    """How many more cases would decide, if the figure stays as it is; None where no number of
    cases would: a figure as near to its limit as the bench's own error stays there.
    """
    if figure.rate is not None:
        return _more_of_rate(require, figure.rate, figure.cases)
    limit = require.limit
    away = abs(limit - figure.value) - bench_error
    if limit > figure.value:
        width = figure.high - figure.value
    else:
        width = figure.value - figure.low
        # of a size the interval ends at 0, which says nothing of its width
        if figure.low == 0:
            width = max(width, figure.high - figure.value)
    if away <= 0 or not math.isfinite(width) or width <= 0:
        return None
    needed = math.ceil(figure.cases * (width / away) ** 2)
    more = needed - figure.cases
    if more > MAX_MORE:
        return None
    return max(more, 1)


def _more_of_rate(require: Require, rate: tuple[float, float], cases: int) -> int | None:
    """How many more cases would decide on a rate: what was counted, and in how many."""
    maximum = require.minimum is None
    count, of = rate
    share = count / of
    if require.quantity in SHARE_QUANTITIES:
        allowed = require.limit
    else:
        allowed = 1 - _share(require)

    def decided(all_cases: int) -> bool:
        n = all_cases * of / cases
        low, high = clopper_pearson(round(share * n), n, require.confidence)
        if high <= allowed or low > allowed:
            return True
        return not maximum and (low >= allowed or high < allowed)

    if share == allowed or not decided(MAX_MORE):
        return None
    # by halves: a count's steps move the end by a case or two
    few = cases
    enough = MAX_MORE
    while enough - few > 1:
        middle = (few + enough) // 2
        if decided(middle):
            enough = middle
        else:
            few = middle
    return enough - cases


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
        hits, asked = _share_of(quantity, cases)
        return _rate(hits, asked, c)
    if quantity in ("time-to-first-attitude", "recovery"):
        return _time(require, cases)
    if quantity == "nea" and np.nansum(cases.numbers["frames"] > 1):
        return _within(cases, axes, require, rng)
    return _decomposed(require, parts(), axes, rng)


def _share_of(quantity: str, cases: Columns) -> tuple[FloatArray, FloatArray]:
    """What is counted in each case (n,), and among how many (n,)."""
    solved = np.nan_to_num(cases.numbers["solved"])
    wrong = np.nan_to_num(cases.numbers["wrong"])
    asked = np.nan_to_num(cases.numbers["frames"])
    if quantity == "wrong-rate":
        return wrong, solved
    if quantity == "false-attitude":
        return wrong, asked
    if quantity == "no-attitude":
        return asked - solved, asked
    if quantity == "availability":
        return solved - wrong, asked
    raise KeyError(quantity)


def _decomposed(
    require: Require, components: Decomposed, axes: list[int], rng: np.random.Generator
) -> BoundedFigure:
    """A figure of the error budget, and the wild answers that it leaves out."""
    figure = _of_parts(components, axes, require, rng)
    wild = len(components.wrong)
    if not wild:
        return figure
    return replace(figure, method=f"{figure.method}; {wild} wild answers left out")


def _of_parts(
    found: Decomposed, axes: list[int], require: Require, rng: np.random.Generator
) -> BoundedFigure:
    """A figure of the error budget's parts."""
    quantity = require.quantity
    c = require.confidence
    n = len(found.row)
    components = found.components
    fov, pixel = components.fov, components.pixel
    if quantity == "bias":
        total = components.left + fov.fitted + pixel.fitted
        sigma = total[:, axes].std(axis=0, ddof=1)
        return _bias(components.mean[axes], sigma, n, c)
    if quantity in ("noise", "nea"):
        freedom = n - 1 - fov.freedom - pixel.freedom
        spread = math.sqrt(n / max(freedom, 1.0))
        noise = components.left[:, axes] * spread
        return _noise(noise, freedom, require, rng)
    part = pixel
    if quantity == "fov-error":
        part = fov
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
            off_square = float(((hits - share * asked) ** 2).sum())
            between = cases / (cases - 1) * off_square / total**2
            binomial = share * (1 - share) / total
            effect = max(between / binomial, 1.0)
            effective = max(total / effect, 1.0)
            method = f"Clopper-Pearson, design effect {effect:.3g}"
    effective_hits = share * effective
    low, high = clopper_pearson(effective_hits, effective, confidence)
    return BoundedFigure(share, low, high, cases, method, (effective_hits, effective))


def _quantile(values: FloatArray, require: Require, cases: int, method: str) -> BoundedFigure:
    share = _share(require)
    low, high = quantile_limits(values, share, require.confidence)
    ordered = np.sort(values)
    count = len(values)
    place = min(math.ceil(share * count), count) - 1
    value = float(ordered[place])
    beyond = float((values > require.limit).sum())
    rate = (beyond, float(count))
    return BoundedFigure(value, max(low, 0.0), high, cases, method, rate)


def _time(require: Require, cases: Columns) -> BoundedFigure:
    numbers = cases.numbers
    column, known = "first_attitude_s", "frames"
    if require.quantity == "recovery":
        column, known = "recovery_s", "fault_end_s"
    if column not in numbers or known not in numbers:
        if column == "recovery_s":
            why = "the table has no such column: a plan that varies scenario has"
        else:
            why = "no such column"
        raise TooFewCases(f"{column}: {why}", 0)
    is_timed = np.isfinite(numbers[known])
    if not is_timed.any():
        raise TooFewCases("no fault ended within a case", 0)
    times = numbers[column][is_timed]
    # a case that never had an attitude
    times = np.where(np.isfinite(times), times, math.inf)
    return _quantile(times, require, len(times), "order statistics")


def _bias(mean: FloatArray, sigma: FloatArray, n: int, confidence: float) -> BoundedFigure:
    standard = sigma / math.sqrt(n)
    size = np.abs(mean)
    upper = stats.t.ppf(confidence, n - 1)
    # Bonferroni: of several axes any one may be the larger
    doubt = (1 - confidence) / len(size)
    low = max(
        lowest_size(axis_size, axis_standard, n - 1, doubt)
        for axis_size, axis_standard in zip(size.tolist(), standard.tolist(), strict=True)
    )
    highest = size + upper * standard
    high = float(highest.max())
    largest = float(size.max())
    return BoundedFigure(largest, low, high, n, "Student's t")


def _noise(
    left: FloatArray, freedom: float, require: Require, rng: np.random.Generator
) -> BoundedFigure:
    """The noise of errors (n, axes) that already have the spread of the noise itself."""
    n = len(left)
    c = require.confidence
    if require.share is not None:
        sizes = np.abs(left).ravel()
        return _quantile(sizes, require, n, "order statistics")
    squares = left**2
    variance = float(squares.mean())
    sigma = math.sqrt(variance)
    freedom = max(freedom, 1.0)
    # Few values cannot show that they are not Gaussian.
    if n < MIN_TESTED or float(stats.kurtosistest(left.ravel()).pvalue) > GAUSSIAN_P:
        low, high = sigma_limits(variance, freedom * left.shape[1], c)
        return BoundedFigure(sigma, low, high, n, "chi-square, Gaussian")
    limits = drawn_limits(squares.mean(axis=1), np.ones(n), rng, c)
    low, high = np.sqrt(limits).tolist()
    return BoundedFigure(sigma, low, high, n, "bootstrap, not Gaussian")


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
    factor = _gaussian_factor(require)
    ratio = square / max(variance, 1e-300)
    scatter_square = freedom * len(axes) * (ratio - 1) ** 2
    excess = float(scatter_square.mean()) / 2 - 1
    # 14: the variance of that square, one degree of freedom a case
    if n < MIN_TESTED or excess < 3 * math.sqrt(14 / n):
        all_freedom = float(freedom.sum()) * len(axes)
        low, high = sigma_limits(variance, all_freedom, require.confidence)
    else:
        limits = drawn_limits(square * freedom, freedom, rng, require.confidence)
        low, high = np.sqrt(limits).tolist()
        method = "bootstrap, not Gaussian"
    sigma = math.sqrt(variance)
    return BoundedFigure(factor * sigma, factor * low, factor * high, n, method)


def _gaussian_factor(require: Require) -> float:
    """How many sigma of Gaussian errors the requirement's share is within; 1 without a share."""
    if require.share is None:
        return 1.0
    return float(stats.norm.ppf((1 + require.share) / 2))


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
    fitted = part.fitted[:, axes]
    square = (fitted**2).mean(axis=1)
    limits = drawn_limits(square, np.ones(n), rng, c) - taken
    low, high = np.maximum(limits, 0.0).tolist()
    if part.freedom:  # the noise in the fit: its own power, and what it adds to that of the part
        fit_noise = 2 * part.freedom * noise / n
        power = noise * (fit_noise + 4 * variance) / (n * len(axes))
        hidden = float(stats.norm.ppf(c)) * math.sqrt(power)
        method = "bootstrap over blocks of cases"
    else:  # no waves were sure: as much power as they would have needed may be there
        hidden = SURE_OF_MANY * math.sqrt(6 * WAVE_COLUMNS) / 3 * noise / n
        method = "what the search for it would have missed"
    below = variance - min(low, variance)
    above = max(high, variance) - variance
    low = max(variance - math.hypot(below, hidden), 0.0)
    high = variance + math.hypot(above, hidden)
    if require.share is not None and variance > 0:
        size = np.abs(fitted).ravel()
        mean_square = float((size**2).mean())
        factor = float(np.quantile(size, require.share)) / math.sqrt(mean_square)
    else:
        factor = _gaussian_factor(require)
    sigma = factor * math.sqrt(variance)
    low_sigma = factor * math.sqrt(low)
    high_sigma = factor * math.sqrt(high)
    return BoundedFigure(sigma, low_sigma, high_sigma, n, method)
