"""A campaign's table as arrays, of as many cases as a figure needs.

The error budget of a campaign's cases, by the same code as that of a run.

Which parameter costs how much: the error in bins of each parameter, all others as the plan spreads them.

A bin's level is the median of its cases, so that one field with two stars does not hide what a parameter does to all others;
its standard error is half of what lies between the order statistics sqrt(k) / 2 on either side of the middle. (For answers not
given it is their mean.) A parameter's **cost** is what the bins, rms over them, exceed the best one by, in quadrature. Its
**share** is the first-order index of Sobol (1993) of the cases' ranks: the variance of the bins' mean ranks in that of all,
less what bins of so many cases have by chance. Attitude errors are those about their median: a bias that all cases have is
alignment, which no parameter costs.

What is written beside a campaign's table once it is whole: budget, costs and charts.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.stats import rankdata

from hilstar.arrays import FloatArray, IntArray
from hilstar.assess.budget import assess_cases
from hilstar.assess.places import Scale
from hilstar.bench.config import BenchConfig
from hilstar.charts import INK, MUTED, chart, write_csv
from hilstar.errors import InputError
from hilstar.rotation import from_rotation_vectors, multiply
from hilstar.units import ARCSEC_PER_RAD

MAX_READ_CASES = 50_000  # that figures are made from; of a larger table evenly many from each part
VARY = "vary."
CSV_COLUMNS = ("quantity", "axis", "value", "unit", "low_95", "high_95")
PARTS = {"fov": "field-of-view error", "pixel": "pixel error", "noise": "noise", "scatter": "noise within a case"}
MAX_FITTED_CASES = 20_000  # that the parts are told apart in; the fit's time grows with them
MAX_BINS, MIN_IN_BIN = 8, 8
SURE = 4.0  # standard errors between the worst and the best bin; of 8 bins of noise, 1 in 100 are so far apart
MAX_PANELS = 6


@dataclass(frozen=True)
class Columns:
    """Columns (n,) by name: numbers as float64 with NaN where there are none, and text. `cases` counts the whole table's."""

    cases: int
    numbers: dict[str, FloatArray]
    texts: dict[str, list[str]]

    @property
    def varied(self) -> list[str]:
        """The names of the varied columns."""
        return [name for name in (*self.numbers, *self.texts) if name.startswith(VARY)]

    def vectors(self, form: str, names: str) -> FloatArray:
        """Columns (n, k) side by side: `form` with each of `names` in it."""
        return np.stack([self.numbers[form.format(name)] for name in names], axis=1)


def read_cases(path: Path, max_cases: int = MAX_READ_CASES) -> Columns:
    """A campaign's table. Raises InputError where it is none."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    numbers: dict[str, list[FloatArray]] = {}
    texts: dict[str, list[str]] = {}
    try:
        file = pq.ParquetFile(path)
        step = -(-file.metadata.num_rows // max_cases) or 1
        for group in range(file.num_row_groups):
            table = file.read_row_group(group)
            table = table.take(pa.array(np.arange(0, table.num_rows, step)))
            for name in table.column_names:
                column: Any = table.column(name)
                if pa.types.is_string(column.type):
                    texts.setdefault(name, []).extend(value or "" for value in column.to_pylist())
                else:
                    values = np.array([np.nan if v is None else float(v) for v in column.to_pylist()])
                    numbers.setdefault(name, []).append(values)
        return Columns(file.metadata.num_rows, {name: np.concatenate(parts) for name, parts in numbers.items()}, texts)
    except (OSError, pa.ArrowException, ValueError) as error:
        raise InputError(f"{path}: is no table of a campaign ({error}); delete it, and run the same command again") from error


def reported_attitudes(cases: Columns) -> FloatArray:
    """The attitudes (n, 4) that the solver reported, NaN where none: a case's mean error put on its commanded attitude."""
    commanded = cases.vectors("q{}", "wxyz")
    error = cases.vectors("error_{}_arcsec", "xyz") / ARCSEC_PER_RAD
    known = np.isfinite(error).all(axis=1)
    reported = cases.vectors("solved_q{}", "wxyz")
    reported[known] = multiply(from_rotation_vectors(error[known]), commanded[known])
    return reported


def case_budget(cases: Columns, config: BenchConfig, rng: np.random.Generator) -> dict[str, Any]:
    """The budget as `hilstar assess` has it, with `scatter_arcsec` within cases of several frames, and notes.

    What too few answers cannot tell is None, and a note says why.
    """
    asked = np.nansum(cases.numbers["frames"])
    solved, wrong = (float(np.nansum(cases.numbers[name])) for name in ("solved", "wrong"))
    found: dict[str, Any] = {
        "bias_arcsec": None,
        "fov_arcsec": None,
        "pixel_arcsec": None,
        "noise_arcsec": None,
        "scatter_arcsec": _scatter(cases),
        "availability": (solved - wrong) / asked if asked else 0.0,
        "wrong": int(wrong),
        "centroids": _centroids(cases),
        "notes": [],
        "intervals": {},
    }
    tracker = config.tracker
    scale = Scale(tracker.focal_length_mm * 1e3 / tracker.pixel_pitch_um, tracker.resolution_px)
    commanded, reported = cases.vectors("q{}", "wxyz"), reported_attitudes(cases)
    step = -(-len(commanded) // MAX_FITTED_CASES)
    try:
        parts = assess_cases(commanded[::step], reported[::step], scale, rng)
    except InputError as error:
        found["notes"] = [str(error)]
        return found
    found |= {name: asdict(getattr(parts, name)) for name in ("fov_arcsec", "pixel_arcsec", "noise_arcsec")}
    found |= {"bias_arcsec": parts.bias_arcsec.tolist(), "notes": list(parts.notes)}
    found["intervals"] = {name: getattr(parts.intervals, name).tolist() for name in ("bias", "fov", "pixel", "noise")}
    return found


def _scatter(cases: Columns) -> dict[str, float] | None:
    """One sigma across and about the boresight between the frames of a case, arcsec; None where cases have one frame."""
    scatter = cases.vectors("scatter_{}_arcsec", "xyz")
    scatter = scatter[np.isfinite(scatter).all(axis=1)]
    if not len(scatter):
        return None
    variance = (scatter**2).mean(axis=0)
    return {"cross": math.sqrt((variance[0] + variance[1]) / 2), "roll": math.sqrt(variance[2])}


def _centroids(cases: Columns) -> dict[str, float] | None:
    """What the centroider alone did: its mean error and one sigma, px, the share of stars found, and false finds a frame."""
    numbers = cases.numbers
    if "measured" not in numbers:
        return None
    weight = np.nan_to_num(numbers["measured"])
    some = weight > 1
    if not some.any():
        return None

    def mean(values: FloatArray) -> float:
        return float(np.average(values[some], weights=weight[some]))

    bias_px = [mean(numbers[f"centroid_d{axis}_px"]) for axis in "xy"]
    spread = [numbers[f"centroid_sigma_{axis}_px"] ** 2 + numbers[f"centroid_d{axis}_px"] ** 2 for axis in "xy"]
    sigma_px = [math.sqrt(max(0.0, mean(values) - bias**2)) for values, bias in zip(spread, bias_px, strict=True)]
    return {
        "bias_x_px": bias_px[0],
        "bias_y_px": bias_px[1],
        "sigma_x_px": sigma_px[0],
        "sigma_y_px": sigma_px[1],
        "found_share": float(np.nansum(numbers["matched"]) / max(np.nansum(numbers["stars"]), 1.0)),
        "false_a_frame": float(np.nansum(numbers["false"]) / max(np.nansum(numbers["frames"]), 1.0)),
    }


def write_budget(path: Path, budget: dict[str, Any]) -> None:
    """The budget as a table, with the columns of `hilstar assess`. Raises InputError where it cannot be written."""
    rows: list[tuple[Any, ...]] = []
    for k, axis in enumerate("xyz"):
        low, high = _interval(budget, "bias", k)
        rows.append(("bias", axis, (budget["bias_arcsec"] or [None] * 3)[k], "arcsec", low, high))
    for part, name in PARTS.items():
        for k, axis in enumerate(("cross", "roll")):
            low, high = _interval(budget, part, k)
            rows.append((name, axis, (budget[f"{part}_arcsec"] or {}).get(axis), "arcsec", low, high))
    rows.append(("availability", "", budget["availability"], "1", None, None))
    rows.append(("wrong answers", "", budget["wrong"], "1", None, None))
    for name, value in (budget["centroids"] or {}).items():
        unit = name.rpartition("_")[2] if name.endswith("_px") else "1"
        rows.append((f"centroids: {name}", "", value, unit, None, None))
    write_csv(path, CSV_COLUMNS, [["" if value is None else value for value in row] for row in rows])


def _interval(budget: dict[str, Any], part: str, k: int) -> tuple[float | None, float | None]:
    ends = budget["intervals"].get(part)
    return (None, None) if ends is None else (ends[0][k], ends[1][k])


@dataclass(frozen=True)
class Measure:
    """A figure of each case (n,), NaN where it has none; of a bin its median is taken, or its mean where `mean` says so."""

    name: str
    unit: str
    values: FloatArray
    mean: bool = False


@dataclass(frozen=True)
class Cost:
    """A parameter's effect on a measure: in each bin the parameter's place (b,), the measure, and its standard error."""

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
    """What is measured of each case: attitude errors across and about the boresight, centroids, and answers not given."""
    numbers = cases.numbers
    x, y, z = (_about_median(numbers[f"error_{axis}_arcsec"]) for axis in "xyz")
    found = [Measure("cross", "arcsec", np.sqrt((x**2 + y**2) / 2)), Measure("roll", "arcsec", np.abs(z))]
    if "centroid_sigma_x_px" in numbers:
        dx, dy, sx, sy = (numbers[f"centroid_{name}_px"] for name in ("dx", "dy", "sigma_x", "sigma_y"))
        found.append(Measure("centroid", "px", np.sqrt((dx**2 + dy**2 + sx**2 + sy**2) / 2)))
    right = np.nan_to_num(numbers["solved"]) - np.nan_to_num(numbers["wrong"])
    frames = np.maximum(np.nan_to_num(numbers["frames"], nan=1.0), 1.0)
    found.append(Measure("unanswered", "1", 1 - np.minimum(right / frames, 1.0), mean=True))
    return [measure for measure in found if np.isfinite(measure.values).sum() >= 2 * MIN_IN_BIN]


def _about_median(values: FloatArray) -> FloatArray:
    known = values[np.isfinite(values)]
    return values - np.median(known) if len(known) else values


def costs(cases: Columns) -> list[Cost]:
    """The cost of each varied parameter in each measure, the dearest first within a measure."""
    found = []
    for measure in measures(cases):
        each = [cost for name in cases.varied if (cost := _cost(measure, name, cases)) is not None]
        found += sorted(each, key=lambda cost: (not cost.sure, -cost.cost))
    return found


def _cost(measure: Measure, name: str, cases: Columns) -> Cost | None:
    good = np.isfinite(measure.values)
    places, index = _bins(name, cases, good)
    if len(places) < 2:
        return None
    y = measure.values[good]
    levels, errors = (
        np.array(part) for part in zip(*(_level(y[index == k], measure.mean) for k in range(len(places))), strict=True)
    )
    best, worst = int(np.argmin(levels)), int(np.argmax(levels))
    total = _level(y, measure.mean)[0]
    return Cost(
        measure=measure.name,
        unit=measure.unit,
        parameter=name.removeprefix(VARY),
        places=places,
        level=levels,
        error=errors,
        overall=total,
        cost=float(levels.mean() - levels[best]) if measure.mean else math.sqrt(float((levels**2).mean() - levels[best] ** 2)),
        share=_share(y, index, len(places)),
        sure=float(levels[worst] - levels[best]) > SURE * math.hypot(float(errors[best]), float(errors[worst])),
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
    within = np.bincount(index, (rank - mean[index]) ** 2, minlength=bins) / np.maximum(count - 1, 1)
    between = float((count * (mean - rank.mean()) ** 2).sum() - within.sum()) / len(rank)
    return max(0.0, between) / max(float(rank.var()), 1e-300)


def _bins(name: str, cases: Columns, good: npt.NDArray[np.bool_]) -> tuple[tuple[float | str, ...], IntArray]:
    """Where a parameter's bins lie, and which one each good case is in; values of a list are bins themselves."""
    if name in cases.texts:
        texts = np.array(cases.texts[name])[good]
        values, index = np.unique(texts, return_inverse=True)
        return _full(tuple(values.tolist()), index)
    numbers = cases.numbers[name][good]
    values, index = np.unique(numbers, return_inverse=True)
    if len(values) > MAX_BINS:
        count = min(MAX_BINS, len(numbers) // MIN_IN_BIN)
        ends = np.quantile(numbers, np.linspace(0, 1, count + 1))[1:-1]
        index = np.searchsorted(ends, numbers, side="right")
        filled, index = np.unique(index, return_inverse=True)
        values = np.array([np.median(numbers[index == k]) for k in range(len(filled))])
    return _full(tuple(values.tolist()), index)


def _full(places: tuple[float | str, ...], index: IntArray) -> tuple[tuple[float | str, ...], IntArray]:
    """The bins, or none where one of them has too few cases to say anything."""
    enough = len(places) < 2 or np.bincount(index).min() >= MIN_IN_BIN // 2
    return (places, index) if enough else ((), index)


def write_costs(path: Path, found: list[Cost]) -> None:
    """The costs as a table. Raises InputError where it cannot be written."""
    names = ("measure", "unit", "parameter", "overall", "cost", "share", "sure", "best", "at_best", "worst", "at_worst")
    rows = [
        (
            *(each.measure, each.unit, each.parameter, each.overall, each.cost, each.share, str(each.sure).lower()),
            *(each.places[each.best], float(each.level[each.best]), each.places[each.worst], float(each.level[each.worst])),
        )
        for each in found
    ]
    write_csv(path, names, rows)


def finding(found: list[Cost]) -> str:
    """The dearest parameter of a measure in one line."""
    first = found[0]
    if not first.sure:
        return (
            f"No parameter changes the {_words(first)} beyond these cases' noise: {_figure(first.overall, first)} in the median"
        )
    best, worst = first.best, first.worst
    return (
        f"{first.parameter} costs the most of the {_words(first)}: {_figure(float(first.level[best]), first)} at"
        f" {_place(first.places[best])}, {_figure(float(first.level[worst]), first)} at {_place(first.places[worst])}"
    )


def _words(cost: Cost) -> str:
    return {
        "cross": "error across the boresight",
        "roll": "error about the boresight",
        "centroid": "centroid error",
        "unanswered": "answers that are missing or wrong",
    }[cost.measure]


def _figure(value: float, cost: Cost) -> str:
    return f"{100 * value:.3g} %" if cost.unit == "1" else f"{value:.3g} {cost.unit}"


def _place(place: float | str) -> str:
    return place if isinstance(place, str) else f"{place:.3g}"


def draw_costs(path: Path, found: list[Cost]) -> None:
    """A chart of one measure's costs, a panel for each of the dearest parameters. Raises InputError."""
    shown = found[:MAX_PANELS]
    with chart(path, finding(shown), panels=len(shown), share_x=False) as axes:
        top = 1.15 * max(float((cost.level + cost.error).max()) for cost in shown) or 1.0
        for axis, cost in zip(axes, shown, strict=True):
            where = [float(k) for k in range(len(cost.places))]
            if not any(isinstance(place, str) for place in cost.places):
                where = [float(place) for place in cost.places]
            else:
                axis.set_xticks(where, [str(place) for place in cost.places])
            axis.errorbar(where, cost.level, yerr=cost.error, fmt="o-", capsize=3, color=INK, ecolor=MUTED)
            axis.axhline(cost.overall, linewidth=0.8, linestyle="--", color=MUTED)
            axis.set_ylim(0, top)
            if len(where) > 2 and min(where) > 0 and max(where) / min(where) > 30:
                axis.set_xscale("log")
            sure = "" if cost.sure else "  (no more than noise)"
            axis.set_xlabel(f"{cost.parameter}: costs {_figure(cost.cost, cost)}{sure}")
            axis.set_ylabel("share" if cost.unit == "1" else f"{cost.unit}, median")


def write_results(table: Path, config: BenchConfig, seed: int) -> dict[str, Any]:
    """Write `budget.csv`, `sensitivity.csv` and a chart for each measure that varies; the budget, and what was found.

    Raises InputError where the table cannot be read, or a file not be written.
    """
    cases = read_cases(table)
    budget = case_budget(cases, config, np.random.default_rng(seed))
    write_budget(table.with_name("budget.csv"), budget)
    found = costs(cases)
    write_costs(table.with_name("sensitivity.csv"), found)
    findings = []
    for measure in dict.fromkeys(cost.measure for cost in found):
        of_it = [cost for cost in found if cost.measure == measure]
        if max(float(cost.level.max()) for cost in of_it) > 0:
            draw_costs(table.with_name(f"sensitivity_{measure}.png"), of_it)
            findings.append(finding(of_it))
    del budget["intervals"]
    return budget | {"findings": findings}
