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
    asked, solved, wrong = (
        float(np.nansum(cases.numbers[name])) for name in ("frames", "solved", "wrong")
    )
    tracker = file.config.tracker
    scale = Scale(tracker.focal_length_mm * 1e3 / tracker.pixel_pitch_um, tracker.resolution_px)
    commanded, reported = attitudes_of(cases)
    step = -(-len(commanded) // MAX_FITTED_CASES)
    parts: Decomposed | None = None
    try:
        parts = assess_cases(commanded[::step], reported[::step], scale, rng)
        notes = parts.notes
    except InputError as refusal:
        notes = (str(refusal),)
    # between the frames of a case; none where cases have one
    scatter = cases.vectors("scatter_{}_arcsec", "xyz")
    scatter = scatter[np.isfinite(scatter).all(axis=1)]
    return {
        "bias_arcsec": None if parts is None else parts.bias_arcsec.tolist(),
        **{
            f"{name}_arcsec": None if parts is None else getattr(parts, f"{name}_arcsec")
            for name in PARTS
        },
        "scatter_arcsec": axes_of_variance((scatter**2).mean(axis=0)) if len(scatter) else None,
        "availability": (solved - wrong) / asked if asked else 0.0,
        "wrong": int(wrong),
        "centroids": _centroids(cases),
        "limit_arcsec": noise_limit(file, commanded),
        "notes": notes,
    }, parts


def attitudes_of(cases: Columns) -> tuple[FloatArray, FloatArray]:
    """Commanded attitudes (n, 4), and reported ones, NaN where there is none: the case's mean
    error on the commanded one.
    """
    commanded, reported = (cases.vectors(form, "wxyz") for form in ("q{}", "solved_q{}"))
    # on the bench a case in motion is where it was lit when the tracker looked
    if "lit_qw" in cases.numbers:
        lit = cases.vectors("lit_q{}", "wxyz")
        commanded = np.where(np.isfinite(lit), lit, commanded)
    error = cases.vectors("error_{}_arcsec", "xyz") / ARCSEC_PER_RAD
    known = np.isfinite(error).all(axis=1)
    reported[known] = multiply(from_rotation_vectors(error[known]), commanded[known])
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
    for name, value in (budget["centroids"] or {}).items():
        yield FigureRow(f"centroids: {name}", "", value, "px" if name.endswith("_px") else "1")


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

    off_px = {axis: numbers[f"centroid_d{axis}_px"] for axis in "xy"}
    bias_px = {axis: mean(off) for axis, off in off_px.items()}
    square_px2 = {
        axis: mean(numbers[f"centroid_sigma_{axis}_px"] ** 2 + off**2)
        for axis, off in off_px.items()
    }
    return {
        **{f"bias_{axis}_px": bias for axis, bias in bias_px.items()},
        **{
            f"sigma_{axis}_px": math.sqrt(max(0.0, square_px2[axis] - bias**2))
            for axis, bias in bias_px.items()
        },
        "found_share": float(np.nansum(numbers["matched"]) / max(np.nansum(numbers["stars"]), 1.0)),
        "false_a_frame": float(
            np.nansum(numbers["false"]) / max(np.nansum(numbers["frames"]), 1.0)
        ),
    }


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
    errors = (numbers[f"error_{axis}_arcsec"] for axis in "xyz")
    x, y, z = (
        axis_errors - np.nanmedian(axis_errors) if np.isfinite(axis_errors).any() else axis_errors
        for axis_errors in errors
    )
    error_measures = [
        Measure("cross", "arcsec", np.sqrt((x**2 + y**2) / 2)),
        Measure("roll", "arcsec", np.abs(z)),
    ]
    if "centroid_sigma_x_px" in numbers:
        dx, dy, sx, sy = (
            numbers[f"centroid_{name}_px"] for name in ("dx", "dy", "sigma_x", "sigma_y")
        )
        error_measures.append(
            Measure("centroid", "px", np.sqrt((dx**2 + dy**2 + sx**2 + sy**2) / 2))
        )
    right = np.nan_to_num(numbers["solved"]) - np.nan_to_num(numbers["wrong"])
    frames = np.maximum(np.nan_to_num(numbers["frames"], nan=1.0), 1.0)
    error_measures.append(
        Measure("unanswered", "1", 1 - np.minimum(right / frames, 1.0), mean=True)
    )
    return [
        measure for measure in error_measures if np.isfinite(measure.values).sum() >= 2 * MIN_IN_BIN
    ]


def costs(cases: Columns) -> list[Cost]:
    """The cost of each varied parameter in each measure, the largest first within a measure."""
    varied_costs = []
    for measure in measures(cases):
        measure_costs = [
            cost for name in cases.varied if (cost := _cost(measure, name, cases)) is not None
        ]
        varied_costs += sorted(measure_costs, key=lambda cost: (not cost.sure, -cost.cost))
    return varied_costs


def _cost(measure: Measure, name: str, cases: Columns) -> Cost | None:
    good = np.isfinite(measure.values)
    places, index = _bins(name, cases, good)
    if len(places) < 2:
        return None
    y = measure.values[good]
    levels, errors = np.array([_level(y[index == k], measure.mean) for k in range(len(places))]).T
    best = int(np.argmin(levels))
    worst = int(np.argmax(levels))
    return Cost(
        measure=measure.name,
        unit=measure.unit,
        parameter=name.removeprefix(VARY),
        places=places,
        level=levels,
        error=errors,
        overall=_level(y, measure.mean)[0],
        cost=(
            float(levels.mean() - levels[best])
            if measure.mean
            else math.sqrt(float((levels**2).mean() - levels[best] ** 2))
        ),
        share=_share(y, index, len(places)),
        sure=float(levels[worst] - levels[best])
        > SURE * math.hypot(float(errors[best]), float(errors[worst])),
    )


def _level(values: FloatArray, mean: bool) -> tuple[float, float]:
    """A bin's median, or mean, and its standard error."""
    count = len(values)
    if mean:
        return float(values.mean()), float(values.std() / math.sqrt(max(count - 1, 1)))
    beside = 0.5 / math.sqrt(count)
    low, middle, high = np.quantile(values, [max(0.0, 0.5 - beside), 0.5, min(1.0, 0.5 + beside)])
    return float(middle), float(high - low) / 2


def _share(values: FloatArray, index: IntArray, bins: int) -> float:
    """The first-order index of the values' ranks."""
    rank = rankdata(values)
    count = np.bincount(index, minlength=bins)
    mean = np.bincount(index, rank, minlength=bins) / count
    within = np.bincount(index, (rank - mean[index]) ** 2, minlength=bins) / np.maximum(
        count - 1, 1
    )
    between = float((count * (mean - rank.mean()) ** 2).sum() - within.sum()) / len(rank)
    return max(0.0, between) / max(float(rank.var()), 1e-300)


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
        ends = np.quantile(numbers, np.linspace(0, 1, count + 1))[1:-1]
        filled, index = np.unique(np.searchsorted(ends, numbers, side="right"), return_inverse=True)
        values = np.array([np.median(numbers[index == k]) for k in range(len(filled))])
    enough = len(values) < 2 or np.bincount(index).min() >= MIN_IN_BIN // 2
    if enough:
        return (tuple(values.tolist()), index)
    return ((), index)


def finding(found: list[Cost]) -> str:
    """The parameter that costs most of a measure, in one line."""
    first = found[0]
    what = WORDS[found[0].measure]
    if not first.sure:
        return (
            f"No parameter changes the {what} beyond these cases' noise:"
            f" {_figure(first.overall, first)} in the median"
        )

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
        top = 1.15 * max(float((cost.level + cost.error).max()) for cost in shown) or 1.0
        for axis, cost in zip(axes, shown, strict=True):
            where = [float(k) for k in range(len(cost.places))]
            if not any(isinstance(place, str) for place in cost.places):
                where = [float(place) for place in cost.places]
            else:
                axis.set_xticks(where, [str(place) for place in cost.places])
            axis.errorbar(
                where, cost.level, yerr=cost.error, fmt="o-", capsize=3, color=INK, ecolor=MUTED
            )
            axis.axhline(cost.overall, linewidth=0.8, linestyle="--", color=MUTED)
            axis.set_ylim(0, top)
            if len(where) > 2 and min(where) > 0 and max(where) / min(where) > 30:
                axis.set_xscale("log")
            sure = "" if cost.sure else "  (no more than noise)"
            axis.set_xlabel(f"{cost.parameter}: costs {_figure(cost.cost, cost)}{sure}")
            axis.set_ylabel("share" if cost.unit == "1" else f"{cost.unit}, median")
    return axes[0].figure


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
        rows.append(
            (cost.parameter, text, _level_text(cost, cost.best), _level_text(cost, cost.worst))
        )
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
    best, worst = cost.best, cost.worst
    at_best, at_worst = float(cost.level[best]), float(cost.level[worst])
    about = (cost.measure, cost.unit, cost.parameter, cost.overall, cost.cost, cost.share, sure)
    return (*about, cost.places[best], at_best, cost.places[worst], at_worst)


def write_results(table: Path, file: BenchFile, seed: int) -> dict[str, Any]:
    """Write `budget.csv`, `sensitivity.csv`, a chart for each measure that varies, and the page
    `campaign.html`; the JSON object of `hilstar campaign`.

    Raises InputError where the table cannot be read, or a file not be written.
    """
    because = failures(table)
    cases = read_cases(table)
    budget, parts = case_budget(cases, file, np.random.default_rng(seed))
    budget_table = list(budget_rows(budget, parts))
    write_csv(table.with_name("budget.csv"), FigureRow._fields, budget_table)
    varied_costs = costs(cases)
    rows = [_sensitivity_row(varied_cost) for varied_cost in varied_costs]
    write_csv(table.with_name("sensitivity.csv"), SENSITIVITY_COLUMNS, rows)
    findings = []
    measure_costs = {}
    for measure in dict.fromkeys(cost.measure for cost in varied_costs):
        of_it = [cost for cost in varied_costs if cost.measure == measure]
        if max(float(cost.level.max()) for cost in of_it) > 0:
            figure = cost_chart(of_it)
            measure_costs[WORDS[measure]] = page_costs(of_it, figure)
            write_whole(table.with_name(f"sensitivity_{measure}.png"), png(figure))
            findings.append(finding(of_it))
    summary = {
        "cases": cases.cases,
        "failed": sum(because.values()),
        "failed_because": because,
        "table": str(table),
        "sha256": file_sha256(table),
        **budget,
        "findings": findings,
    }
    write_campaign_page(table.with_name(PAGE_FILE), summary, budget_table, measure_costs)
    return summary


def lines_of(summary: dict[str, Any]) -> list[str]:
    """The summary's lines on the terminal."""
    lines = [f"{summary['cases']} cases in {summary['table']}, sha256 {summary['sha256']}"]
    lines += [
        f"{count} failed: {line}"
        for line, count in list(summary["failed_because"].items())[:MAX_REASONS]
    ]
    lines.append(
        f"{'availability':20}{100 * summary['availability']:.4g} %, {summary['wrong']} wrong"
        " answers"
    )
    if summary["bias_arcsec"] is not None:
        lines.append(
            f"{'bias':20}{', '.join(f'{value:.3g}' for value in summary['bias_arcsec'])} arcsec"
            " about x, y, z"
        )
        for part, name in (*PARTS.items(), ("scatter", SCATTER)):
            axes: Axes | None = summary[f"{part}_arcsec"]
            if axes is not None:
                values = (
                    "-" if value is None else f"{value:.3g} arcsec {axis}"
                    for axis, value in asdict(axes).items()
                )
                lines.append(f"{name:20}{', '.join(values)}")
    centroids = summary["centroids"]
    if centroids is not None:
        sigma_x_px, sigma_y_px = centroids["sigma_x_px"], centroids["sigma_y_px"]
        share = f"{100 * centroids['found_share']:.3g} % of stars found"
        false = f"{centroids['false_a_frame']:.3g} false a frame"
        sigma = f"{sigma_x_px:.3g}, {sigma_y_px:.3g} px one sigma"
        lines.append(f"{'centroids':20}{sigma}, {share}, {false}")
    lines.append(f"{'limit of its stars':20}{limit_text(summary['limit_arcsec'])}")
    return [*lines, *summary["notes"], *summary["findings"]]
