"""For each step of the chain: every method against the exact one, error against time, on the machine at hand."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hilstar.charts import STYLE, plain_ticks, save, title_lines, write_csv
from hilstar.render.renderer import Renderer, Target
from hilstar.study.tradeoff.brightness import brightness
from hilstar.study.tradeoff.culling import culling
from hilstar.study.tradeoff.demo import SIGMA_PX
from hilstar.study.tradeoff.depth import depth
from hilstar.study.tradeoff.prediction import prediction
from hilstar.study.tradeoff.projection import projection
from hilstar.study.tradeoff.psf import psf
from hilstar.study.tradeoff.quantisation import quantisation
from hilstar.study.tradeoff.smear import smear
from hilstar.study.tradeoff.spectrum import spectrum
from hilstar.study.tradeoff.table import Figure, Row, Step, Trials, measured
from hilstar.tracker.centroiders import FAMILY

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MAX_POWERS = 8
# In the order of the chain.
STEPS: tuple[Callable[[ExitStack, bool], Trials], ...] = (
    brightness,
    spectrum,
    depth,
    culling,
    projection,
    prediction,
    smear,
    psf,
    quantisation,
)
# Time for the rounds of one step, s: 30 s in all with --quick, five minutes without, set-up and charts included.
QUICK_BUDGET_S, BUDGET_S = 0.8, 25.0
COLUMNS = (
    "step",
    "work",
    "method",
    "error",
    "error_unit",
    "error_is",
    "second",
    "second_unit",
    "second_is",
    "time_ms",
    "quartile_1_ms",
    "quartile_3_ms",
    "default",
    "exact",
    "front",
    "beaten_by",
)
# Of the step `quantisation`: what centroiders of every kind find; empty in the others.
MORE_COLUMNS = tuple(f"max_px_{kind}" for kind in FAMILY)


def run(directory: Path, quick: bool = False) -> list[str]:
    """Write a chart for each step (PNG) and one table (CSV) into `directory`; the table as lines for a person."""
    machine = this_machine()
    steps = []
    for plan in STEPS:
        with ExitStack() as stack:
            steps.append(measured(plan(stack, quick), QUICK_BUDGET_S if quick else BUDGET_S))
        draw(directory / f"tradeoff_{steps[-1].name}.png", steps[-1], machine)
    write_csv(directory / "tradeoff.csv", (*COLUMNS, *MORE_COLUMNS), [cells(step, row) for step in steps for row in step.rows])
    head = f"medians on {machine}; * no method is both as accurate (by the first figure) and as fast; > hilstar's default"
    return [head, *(line for step in steps for line in table_lines(step))]


def this_machine() -> str:
    """The machine and GL that the times hold for."""
    with Renderer(Target((8, 8), SIGMA_PX)) as renderer:
        return f"{renderer.gl_renderer}, {os.cpu_count()} cores"


def cells(step: Step, row: Row) -> tuple[str | float | bool, ...]:
    """A row of the CSV: COLUMNS and MORE_COLUMNS."""
    figures = (
        row.error,
        step.error.unit,
        step.error.name,
        row.second,
        step.second.unit,
        step.second.name,
        row.time_ms,
        *row.quartiles_ms,
    )
    more = (row.more.get(name, "") for name in MORE_COLUMNS)
    return step.name, step.work, row.method, *figures, row.is_default, row.is_exact, row.on_front, row.beaten, *more


def table_lines(step: Step) -> list[str]:
    """A step's table for a person, the fastest method first."""
    wide = max(len(row.method) for row in step.rows)
    columns = (f"{step.error.name} [{step.error.unit}]", f"{step.second.name} [{step.second.unit}]", "ms")
    lines = ["", f"{step.name}: {step.work}", f"   {'method':{wide}}  {'   '.join(columns)}"]
    for row in step.rows:
        marks = ("*" if row.on_front else " ") + (">" if row.is_default else " ")
        errors = "  ".join(f"{value:>{len(name)}.3g} " for value, name in zip((row.error, row.second), columns, strict=False))
        lines.append(f"{marks} {row.method:{wide}}  {errors} {row.time_ms:.3g}")
    beaten = step.default.beaten
    return [*lines, *([f"   the default: {beaten}"] if beaten else []), *([f"   {step.remark}"] if step.remark else [])]


def finding(step: Step) -> str:
    """What a chart says in its title."""
    own, exact = step.default, next((row for row in step.rows if row.is_exact), None)
    right = own.error <= step.error.floor
    text = (
        f"{step.name}, {step.work}: '{own.method}' has {'no error' if right else 'an error of ' + said(own.error, step.error)}"
    )
    compared = "" if exact is None else f"; '{exact.method}' takes {exact.time_ms:.3g} ms"
    return f"{text} and takes {own.time_ms:.3g} ms{compared}"


def said(value: float, figure: Figure) -> str:
    """A figure with its unit; a share has none."""
    return f"{value:.2g}" + ("" if figure.unit == "1" else f" {figure.unit}")


def draw(path: Path, step: Step, machine: str) -> None:
    """Draw error against time on logarithmic axes: the front as a line, the default ringed, every method named at the side."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure as Canvas

    floor = step.error.floor
    with rc_context(STYLE):
        canvas = Canvas(figsize=(11.0, 6.4), layout="constrained")
        axis = canvas.subplots()
        shown = {row.method: (row.time_ms, max(row.error, floor)) for row in step.rows}
        front = [shown[row.method] for row in step.rows if row.on_front]
        axis.step(
            *np.array(front).T, where="post", color="C0", lw=1.4, label="front: no other method is as accurate and as fast"
        )
        for row in step.rows:
            colour = "C0" if row.on_front else "C7"
            axis.plot(row.quartiles_ms, [shown[row.method][1]] * 2, color=colour, lw=3.5, alpha=0.4, solid_capstyle="butt")
            axis.plot(*shown[row.method], "o", color=colour, ms=6, zorder=3)
        own = step.default
        axis.plot(*shown[own.method], "o", ms=15, mfc="none", mec="C3", mew=2.0, zorder=4, label="hilstar's default")
        if any(row.error < floor for row in step.rows):
            axis.axhline(floor, color="0.5", ls=":", lw=1.2, label=f"counts as no error: below {said(floor, step.error)}")
        axis.set(xscale="log", yscale="log", xlabel=f"median time [ms], bar: quartiles; {machine}")
        axis.set(ylabel=f"{step.error.name} [{step.error.unit}]")
        axis.margins(0.06, 0.08)
        plain_ticks(axis.xaxis, round_ticks(*axis.get_xlim()))
        plain_ticks(axis.yaxis, round_ticks(*axis.get_ylim()))
        name_methods(axis, step.rows, shown)
        canvas.legend(loc="outside lower center", ncols=3)
        canvas.suptitle(title_lines(finding(step)), fontsize=12)
        save(canvas, path)


def round_ticks(low: float, high: float) -> list[float]:
    """Round ticks of a logarithmic axis: several in each power of ten, or for a long axis only some of the powers."""
    first, last = math.floor(math.log10(low)), math.ceil(math.log10(high))
    steps = (1, 2, 3, 4, 5, 7) if high < 10 * low else (1, 2, 5) if last - first <= 3 else (1,)
    every = -(-(last - first) // MAX_POWERS)
    ticks = (step * 10.0**power for power in range(first, last) if power % every == 0 for step in steps)
    return [tick for tick in ticks if low <= tick <= high]


def name_methods(axis: Axes, rows: Sequence[Row], shown: dict[str, tuple[float, float]]) -> None:
    """Every method's name in a column right of the chart, at its error's height as far as the others leave room."""
    falling = sorted(rows, key=lambda row: (-shown[row.method][1], row.time_ms))
    points = axis.transScale.transform([shown[row.method] for row in falling])
    low, high = axis.transScale.transform([[1.0, limit] for limit in axis.get_ylim()])[:, 1]
    heights = spread((points[:, 1] - low) / (high - low), 0.98 / max(len(rows), 24))
    for row, height in zip(falling, heights, strict=True):
        colour = "C3" if row.is_default else "C0" if row.on_front else "0.35"
        axis.annotate(
            row.method,
            shown[row.method],
            (1.03, height),
            textcoords="axes fraction",
            va="center",
            fontsize=9,
            color=colour,
            arrowprops={"arrowstyle": "-", "color": colour, "alpha": 0.35, "lw": 0.7, "shrinkB": 4, "relpos": (0, 0.5)},
        )


def spread(heights: np.ndarray, gap: float) -> list[float]:
    """Falling heights moved apart by at least `gap`, within 0 and 1 where there is room."""
    placed: list[float] = []
    for height in heights:
        placed.append(min(float(height), 1.0 if not placed else placed[-1] - gap))
    lowest = 0.0
    for k in reversed(range(len(placed))):
        placed[k] = max(placed[k], lowest)
        lowest = placed[k] + gap
    return placed
