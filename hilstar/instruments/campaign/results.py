"""The results of a campaign's table: the error budget of its cases, and what each parameter costs.

**Budget.** The same decomposition as that of a run (`instruments/assess`), over cases that are
independent of each other.

**Costs.** Each measure (attitude error, centroid error, missing answers) is compared in bins of
each parameter, with all others spread as the plan has them. A bin's level is the median of its
cases, so that one field with two stars does not hide the effect in all others. Its standard error
is half the distance between the order statistics sqrt(k) / 2 either side of the middle. (For
missing answers the level is the mean.) A parameter's **cost** is the excess of the bins' rms over
the best bin, in quadrature. Its **share** is the first-order index of Sobol (1993) of the cases'
ranks: the variance of the bins' mean ranks over that of all, less what bins of that size have by
chance. Attitude errors are taken about their median: a bias common to all cases is alignment, which
no parameter costs.
"""

import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.stats import rankdata

from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.charts import INK, MUTED, panels_of, png, write_csv
from hilstar.basics.errors import InputError
from hilstar.basics.files import write_whole
from hilstar.basics.rotation import from_rotation_vectors, multiply
from hilstar.basics.units import ARCSEC_PER_RAD
from hilstar.instruments.assess.bench_effects import noise_limit
from hilstar.instruments.assess.budget import Axes, Decomposed, assess_cases, axes_of_variance
from hilstar.instruments.assess.figure_rows import (
    PARTS,
    FigureRow,
    limit_rows,
    limit_text,
    part_rows,
)
from hilstar.instruments.assess.places import Scale
from hilstar.instruments.campaign.case_table import VARY, Columns, read_cases
from hilstar.instruments.campaign.page import PAGE_FILE, MeasureCosts, write_campaign_page
from hilstar.instruments.campaign.store import failures, file_sha256
from hilstar.server.bench.bench_file import BenchFile

SCATTER = "noise within a case"
MAX_FITTED_CASES = 20_000  # cases in the fit of the budget, whose time grows with them
MAX_BINS, MIN_IN_BIN = 8, 8
# standard errors between the worst and the best bin; in 1 of 100 sets of 8 bins, noise alone has so
# many
SURE = 4.0
MAX_PANELS = 6
WORDS = {
    "cross": "error across the boresight",
    "roll": "error about the boresight",
    "centroid": "centroid error",
    "unanswered": "answers that are missing or wrong",
}
MAX_REASONS = 5
SENSITIVITY_COLUMNS = (
    *("measure", "unit", "parameter", "overall", "cost", "share", "sure"),
    *("best", "at_best", "worst", "at_worst"),
)


def case_budget(
    cases: Columns, file: BenchFile, rng: np.random.Generator
) -> tuple[dict[str, Any], Decomposed | None]:
    """The budget of a campaign's cases by the keys of --json, and its parts, as `hilstar assess`
    has them.

    A figure that too few answers determine is None, and a note says why.
    """
    numbers = cases.numbers
    asked = float(np.nansum(numbers["frames"]))
    solved = float(np.nansum(numbers["solved"]))
    wrong = float(np.nansum(numbers["wrong"]))
    tracker = file.config.tracker
    focal_length_px = tracker.focal_length_mm * 1e3 / tracker.pixel_pitch_um
    scale = Scale(focal_length_px, tracker.resolution_px)
    commanded, reported = attitudes_of(cases)
    step = -(-len(commanded) // MAX_FITTED_CASES)
    parts: Decomposed | None = None
    try:
        parts = assess_cases(commanded[::step], reported[::step], scale, rng)
        notes = parts.notes
    except InputError as refusal:
        notes = (str(refusal),)
    budget: dict[str, Any] = _parts_arcsec(parts)
    budget["scatter_arcsec"] = _scatter_arcsec(cases)
    budget["availability"] = 0.0
    if asked:
        budget["availability"] = (solved - wrong) / asked
    budget["wrong"] = int(wrong)
    budget["centroids"] = _centroids(cases)
    budget["limit_arcsec"] = noise_limit(file, commanded)
    budget["notes"] = notes
    return budget, parts


def _parts_arcsec(parts: Decomposed | None) -> dict[str, Any]:
    """The bias and the parts of a budget by the keys of --json; None where they are unknown."""
    keys = ["bias_arcsec"]
    for name in PARTS:
        keys.append(f"{name}_arcsec")
    if parts is None:
        return dict.fromkeys(keys)
    values = {}
    for key in keys:
        values[key] = getattr(parts, key)
    values["bias_arcsec"] = parts.bias_arcsec.tolist()
    return values


def _scatter_arcsec(cases: Columns) -> Axes | None:
    """The scatter between the frames of a case; None where each case has a single frame."""
    scatter = cases.vectors("scatter_{}_arcsec", "xyz")
    known = np.isfinite(scatter).all(axis=1)
    if not known.any():
        return None
    variance = (scatter[known] ** 2).mean(axis=0)
    return axes_of_variance(variance)


def attitudes_of(cases: Columns) -> tuple[FloatArray, FloatArray]:
    """Commanded attitudes (n, 4), and reported ones, NaN where there is none: the case's mean
    error on the commanded one.
    """
    commanded = cases.vectors("q{}", "wxyz")
    reported = cases.vectors("solved_q{}", "wxyz")
    # on the bench a case in motion is where it was lit when the tracker looked
    if "lit_qw" in cases.numbers:
        lit = cases.vectors("lit_q{}", "wxyz")
        commanded = np.where(np.isfinite(lit), lit, commanded)
    error = cases.vectors("error_{}_arcsec", "xyz") / ARCSEC_PER_RAD
    known = np.isfinite(error).all(axis=1)
    turn = from_rotation_vectors(error[known])
    reported[known] = multiply(turn, commanded[known])
    return commanded, reported


def budget_rows(budget: dict[str, Any], parts: Decomposed | None) -> Iterator[FigureRow]:
    """The rows of budget.csv, as `hilstar assess` has them."""
    unknown = Axes(None, None)
    yield from part_rows(parts, budget["noise_arcsec"] or unknown)
    scatter = budget["scatter_arcsec"] or unknown
    yield FigureRow(SCATTER, "cross", scatter.cross, "arcsec")
    yield FigureRow(SCATTER, "roll", scatter.roll, "arcsec")
    yield from limit_rows(budget["limit_arcsec"])
    yield FigureRow("availability", "", budget["availability"])
    yield FigureRow("wrong answers", "", budget["wrong"])
    centroids = budget["centroids"] or {}
    for name, value in centroids.items():
        unit = "1"
        if name.endswith("_px"):
            unit = "px"
        yield FigureRow(f"centroids: {name}", "", value, unit)


def _centroids(cases: Columns) -> dict[str, float] | None:
    """The centroider alone: mean error and one sigma, px, the share of stars found, and false
    finds per frame.
    """
    numbers = cases.numbers
    if "measured" not in numbers:
        return None
    weight = np.nan_to_num(numbers["measured"])
    some = weight > 1
    if not some.any():
        return None

    def mean(values: FloatArray) -> float:
        return float(np.average(values[some], weights=weight[some]))

    bias_px = {}
    sigma_px = {}
    for axis in "xy":
        off = numbers[f"centroid_d{axis}_px"]
        sigma = numbers[f"centroid_sigma_{axis}_px"]
        bias = mean(off)
        variance = mean(sigma**2 + off**2) - bias**2
        bias_px[f"bias_{axis}_px"] = bias
        sigma_px[f"sigma_{axis}_px"] = math.sqrt(max(0.0, variance))
    figures = bias_px | sigma_px
    figures["found_share"] = _ratio(numbers["matched"], numbers["stars"])
    figures["false_a_frame"] = _ratio(numbers["false"], numbers["frames"])
    return figures


def _ratio(counts: FloatArray, of_counts: FloatArray) -> float:
    """The sum of counts (n,) over that of others (n,), which counts as 1 where it is less."""
    whole = max(np.nansum(of_counts), 1.0)
    return float(np.nansum(counts) / whole)


@dataclass(frozen=True)
class Measure:
    """A figure of each case (n,), NaN where it has none. A bin's level is its median, with
    `mean` its mean.
    """

    name: str
    unit: str
    values: FloatArray
    mean: bool = False


@dataclass(frozen=True)
class Cost:
    """A parameter's effect on a measure: the bins' places (b,), levels and standard errors."""

    measure: str
    unit: str
    parameter: str
    places: tuple[float | str, ...]
    level: FloatArray
    error: FloatArray
    overall: float
    cost: float
    share: float
    sure: bool

    @property
    def best(self) -> int:
        """The bin with the smallest error."""
        return int(np.argmin(self.level))

    @property
    def worst(self) -> int:
        """The bin with the largest error."""
        return int(np.argmax(self.level))


def measures(cases: Columns) -> list[Measure]:
    """The measures of the cases: attitude errors across and about the boresight, centroid
    errors, and missing answers.
    """
    numbers = cases.numbers
    x = _unbiased(numbers["error_x_arcsec"])
    y = _unbiased(numbers["error_y_arcsec"])
    z = _unbiased(numbers["error_z_arcsec"])
    cross_arcsec = np.sqrt((x**2 + y**2) / 2)
    candidates = [Measure("cross", "arcsec", cross_arcsec), Measure("roll", "arcsec", np.abs(z))]
    if "centroid_sigma_x_px" in numbers:
        dx = numbers["centroid_dx_px"]
        dy = numbers["centroid_dy_px"]
        sx = numbers["centroid_sigma_x_px"]
        sy = numbers["centroid_sigma_y_px"]
        centroid_px = np.sqrt((dx**2 + dy**2 + sx**2 + sy**2) / 2)
        candidates.append(Measure("centroid", "px", centroid_px))
    solved = np.nan_to_num(numbers["solved"])
    right = solved - np.nan_to_num(numbers["wrong"])
    frames = np.nan_to_num(numbers["frames"], nan=1.0)
    answered = right / np.maximum(frames, 1.0)
    candidates.append(Measure("unanswered", "1", 1 - answered, mean=True))
    known_measures = []
    for measure in candidates:
        known = np.isfinite(measure.values).sum()
        if known >= 2 * MIN_IN_BIN:
            known_measures.append(measure)
    return known_measures


def _unbiased(errors: FloatArray) -> FloatArray:
    """Errors of an axis (n,) about their median."""
    if not np.isfinite(errors).any():
        return errors
    return errors - np.nanmedian(errors)


def costs(cases: Columns) -> list[Cost]:
    """The cost of each varied parameter in each measure, the largest first within a measure."""
    varied_costs = []
    for measure in measures(cases):
        measure_costs = []
        for name in cases.varied:
            cost = _cost(measure, name, cases)
            if cost is not None:
                measure_costs.append(cost)
        varied_costs += sorted(measure_costs, key=lambda cost: (not cost.sure, -cost.cost))
    return varied_costs


def _cost(measure: Measure, name: str, cases: Columns) -> Cost | None:
    good = np.isfinite(measure.values)
    places, index = _bins(name, cases, good)
    if len(places) < 2:
        return None
    y = measure.values[good]
    bin_levels = []
    for k in range(len(places)):
        bin_levels.append(_level(y[index == k], measure.mean))
    levels, errors = np.array(bin_levels).T
    best = int(np.argmin(levels))
    worst = int(np.argmax(levels))
    overall, _ = _level(y, measure.mean)
    if measure.mean:
        excess = float(levels.mean() - levels[best])
    else:
        excess_square = (levels**2).mean() - levels[best] ** 2
        excess = math.sqrt(float(excess_square))
    step = float(levels[worst] - levels[best])
    step_error = math.hypot(float(errors[best]), float(errors[worst]))
    return Cost(
        measure=measure.name,
        unit=measure.unit,
        parameter=name.removeprefix(VARY),
        places=places,
        level=levels,
        error=errors,
        overall=overall,
        cost=excess,
        share=_share(y, index, len(places)),
        sure=step > SURE * step_error,
    )


def _level(values: FloatArray, mean: bool) -> tuple[float, float]:
    """A bin's median, or mean, and its standard error."""
    count = len(values)
    if mean:
        freedom = max(count - 1, 1)
        error = values.std() / math.sqrt(freedom)
        return float(values.mean()), float(error)
    beside = 0.5 / math.sqrt(count)
    below = max(0.0, 0.5 - beside)
    above = min(1.0, 0.5 + beside)
    low, middle, high = np.quantile(values, [below, 0.5, above])
    return float(middle), float(high - low) / 2


def _share(values: FloatArray, index: IntArray, bins: int) -> float:
    """The first-order index of the values' ranks."""
    rank = rankdata(values)
    count = np.bincount(index, minlength=bins)
    mean = np.bincount(index, rank, minlength=bins) / count
    squares = (rank - mean[index]) ** 2
    square_sums = np.bincount(index, squares, minlength=bins)
    # what bins of that size have by chance
    within = square_sums / np.maximum(count - 1, 1)
    spread = count * (mean - rank.mean()) ** 2
    between = float(spread.sum() - within.sum()) / len(rank)
    variance = float(rank.var())
    return max(0.0, between) / max(variance, 1e-300)


def _bins(
    name: str, cases: Columns, good: npt.NDArray[np.bool_]
) -> tuple[tuple[float | str, ...], IntArray]:
    """The places of a parameter's bins, and the bin of each good case; none where one of them has
    too few cases.

    Few distinct values are bins themselves.
    """
    if name in cases.texts:
        column = np.array(cases.texts[name])
    else:
        column = cases.numbers[name]
    values, index = np.unique(column[good], return_inverse=True)
    if name not in cases.texts and len(values) > MAX_BINS:
        numbers = cases.numbers[name][good]
        count = min(MAX_BINS, len(numbers) // MIN_IN_BIN)
        shares = np.linspace(0, 1, count + 1)
        ends = np.quantile(numbers, shares)[1:-1]
        interval = np.searchsorted(ends, numbers, side="right")
        filled, index = np.unique(interval, return_inverse=True)
        medians = []
        for k in range(len(filled)):
            medians.append(np.median(numbers[index == k]))
        values = np.array(medians)
    enough = len(values) < 2 or np.bincount(index).min() >= MIN_IN_BIN // 2
    if enough:
        return (tuple(values.tolist()), index)
    return ((), index)


def finding(found: list[Cost]) -> str:
    """The parameter that costs most of a measure, in one line."""
    first = found[0]
    what = WORDS[found[0].measure]
    if not first.sure:
        overall = _figure(first.overall, first)
        return f"No parameter changes the {what} beyond these cases' noise: {overall} in the median"
    smallest = _level_text(first, first.best)
    largest = _level_text(first, first.worst)
    return f"{first.parameter} costs the most of the {what}: {smallest}, {largest}"


def _figure(value: float, cost: Cost) -> str:
    if cost.unit == "1":
        return f"{100 * value:.3g} %"
    return f"{value:.3g} {cost.unit}"


def cost_chart(found: list[Cost]) -> Any:
    """A figure of one measure's costs, with a panel for each of the parameters that cost most."""
    shown = found[:MAX_PANELS]
    with panels_of(finding(shown), len(shown), share_x=False) as axes:
        highest = []
        for cost in shown:
            ends = cost.level + cost.error
            highest.append(float(ends.max()))
        top = 1.15 * max(highest) or 1.0
        for axis, cost in zip(axes, shown, strict=True):
            _cost_panel(axis, cost)
            axis.set_ylim(0, top)
    return axes[0].figure


def _cost_panel(axis: Any, cost: Cost) -> None:
    """Draw a parameter's bins with their standard errors."""
    where: list[float] = list(range(len(cost.places)))
    if any(isinstance(place, str) for place in cost.places):
        axis.set_xticks(where, list(map(str, cost.places)))
    else:
        where = list(map(float, cost.places))
    axis.errorbar(where, cost.level, yerr=cost.error, fmt="o-", capsize=3, color=INK, ecolor=MUTED)
    axis.axhline(cost.overall, linewidth=0.8, linestyle="--", color=MUTED)
    first, last = min(where), max(where)
    if len(where) > 2 and first > 0 and last / first > 30:
        axis.set_xscale("log")
    label = f"{cost.parameter}: costs {_figure(cost.cost, cost)}"
    if not cost.sure:
        label = f"{label}  (no more than noise)"
    axis.set_xlabel(label)
    if cost.unit == "1":
        axis.set_ylabel("share")
    else:
        axis.set_ylabel(f"{cost.unit}, median")


def page_costs(found: list[Cost], figure: Any) -> MeasureCosts:
    """The costs of one measure for the page, with their chart."""
    first = found[0]
    of = f"cost of {first.parameter}"
    if not first.sure:
        of = f"{of}: no more than the cases' noise"
    rows = []
    for cost in found:
        text = _figure(cost.cost, cost)
        if not cost.sure:
            text = f"{text} (noise)"
        best = _level_text(cost, cost.best)
        worst = _level_text(cost, cost.worst)
        rows.append((cost.parameter, text, best, worst))
    return MeasureCosts(_figure(first.cost, first), of, rows, figure)


def _level_text(cost: Cost, place: int) -> str:
    """A bin's level, and where it is."""
    where = cost.places[place]
    if not isinstance(where, str):
        where = f"{where:.3g}"
    return f"{_figure(float(cost.level[place]), cost)} at {where}"


def _sensitivity_row(cost: Cost) -> tuple[Any, ...]:
    """A row of sensitivity.csv."""
    sure = str(cost.sure).lower()
    about = (cost.measure, cost.unit, cost.parameter, cost.overall, cost.cost, cost.share, sure)
    at_best = float(cost.level[cost.best])
    at_worst = float(cost.level[cost.worst])
    best = cost.places[cost.best]
    worst = cost.places[cost.worst]
    return (*about, best, at_best, worst, at_worst)


def write_results(table: Path, file: BenchFile, seed: int) -> dict[str, Any]:
    """Write `budget.csv`, `sensitivity.csv`, a chart for each measure that varies, and the page
    `campaign.html`; the JSON object of `hilstar campaign`.

    Raises InputError where the table cannot be read, or a file not be written.
    """
    because = failures(table)
    cases = read_cases(table)
    rng = np.random.default_rng(seed)
    budget, parts = case_budget(cases, file, rng)
    budget_table = list(budget_rows(budget, parts))
    budget_file = table.with_name("budget.csv")
    write_csv(budget_file, FigureRow._fields, budget_table)
    by_measure: dict[str, list[Cost]] = {}
    rows = []
    for cost in costs(cases):
        rows.append(_sensitivity_row(cost))
        by_measure.setdefault(cost.measure, []).append(cost)
    sensitivity_file = table.with_name("sensitivity.csv")
    write_csv(sensitivity_file, SENSITIVITY_COLUMNS, rows)
    findings = []
    measure_costs = {}
    for measure, parameter_costs in by_measure.items():
        if any(cost.level.max() > 0 for cost in parameter_costs):
            figure = cost_chart(parameter_costs)
            measure_costs[WORDS[measure]] = page_costs(parameter_costs, figure)
            chart_file = table.with_name(f"sensitivity_{measure}.png")
            write_whole(chart_file, png(figure))
            findings.append(finding(parameter_costs))
    summary = {
        "cases": cases.cases,
        "failed": sum(because.values()),
        "failed_because": because,
        "table": str(table),
        "sha256": file_sha256(table),
        **budget,
        "findings": findings,
    }
    page_file = table.with_name(PAGE_FILE)
    write_campaign_page(page_file, summary, budget_table, measure_costs)
    return summary


def lines_of(summary: dict[str, Any]) -> list[str]:
    """The summary's lines on the terminal."""
    lines = [f"{summary['cases']} cases in {summary['table']}, sha256 {summary['sha256']}"]
    reasons = list(summary["failed_because"].items())
    for reason, count in reasons[:MAX_REASONS]:
        lines.append(f"{count} failed: {reason}")
    availability_percent = 100 * summary["availability"]
    wrong = summary["wrong"]
    lines.append(f"{'availability':20}{availability_percent:.4g} %, {wrong} wrong answers")
    bias_arcsec = summary["bias_arcsec"]
    if bias_arcsec is not None:
        bias = ", ".join(f"{value:.3g}" for value in bias_arcsec)
        lines.append(f"{'bias':20}{bias} arcsec about x, y, z")
        for part, name in (*PARTS.items(), ("scatter", SCATTER)):
            axes: Axes | None = summary[f"{part}_arcsec"]
            if axes is not None:
                lines.append(f"{name:20}{_axes_text(axes)}")
    centroids = summary["centroids"]
    if centroids is not None:
        sigma_x_px, sigma_y_px = centroids["sigma_x_px"], centroids["sigma_y_px"]
        share = f"{100 * centroids['found_share']:.3g} % of stars found"
        false = f"{centroids['false_a_frame']:.3g} false a frame"
        sigma = f"{sigma_x_px:.3g}, {sigma_y_px:.3g} px one sigma"
        lines.append(f"{'centroids':20}{sigma}, {share}, {false}")
    lines.append(f"{'limit of its stars':20}{limit_text(summary['limit_arcsec'])}")
    return [*lines, *summary["notes"], *summary["findings"]]


def _axes_text(axes: Axes) -> str:
    """A part of the budget across and about the boresight."""
    texts = []
    for axis, value in asdict(axes).items():
        if value is None:
            texts.append("-")
        else:
            texts.append(f"{value:.3g} arcsec {axis}")
    return ", ".join(texts)
