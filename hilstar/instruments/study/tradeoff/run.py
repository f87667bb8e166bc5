"""For each step of the chain: every method against the exact one, error against time, on the
machine at hand.
"""

import os
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from hilstar.basics.charts import (
    BLUE,
    MUTED,
    RED,
    capital,
    chart,
    name_at_side,
    title_lines,
    two_digits,
    write_csv,
)
from hilstar.display.render.backend import Target
from hilstar.display.render.renderer import Renderer
from hilstar.instruments.study.sweep import NOT_JUDGED, Figure, Judged, Trials, measured
from hilstar.instruments.study.tradeoff.light import brightness, depth, psf, quantisation, spectrum
from hilstar.instruments.study.tradeoff.places import (
    SPRITE_PSF,
    culling,
    prediction,
    projection,
    smear,
)
from hilstar.tracker.centroiders import FAMILY

LABEL_COLUMNS = 40  # characters along an axis as high as a panel
# In the order of the chain.
STEPS: tuple[Callable[[ExitStack, bool], Trials], ...] = (
    *(brightness, spectrum, depth),
    *(culling, projection, prediction, smear),
    *(psf, quantisation),
)
# Time for the rounds of one step, s: 30 s in all with --quick, five minutes without, set-up and
# charts included.
QUICK_BUDGET_S, BUDGET_S = 0.8, 25.0
COLUMNS = (
    *(
        "step",
        "work",
        "method",
        "error",
        "error_unit",
        "error_is",
        "second",
        "second_unit",
        "second_is",
    ),
    *("time_ms", "quartile_1_ms", "quartile_3_ms", "default", "exact", "front", "beaten_by"),
)
# Columns of the step `quantisation` alone: the error by centroiders of every kind.
MORE_COLUMNS = tuple(f"max_px_{kind}" for kind in FAMILY)


def run(directory: Path, quick: bool = False) -> Judged:
    """Write a chart for each step and one table (CSV) into `directory`; the table as lines for a
    person.

    A step that was timed on a busy machine has no front: its `front` and `beaten_by` are empty.
    """
    machine = this_machine()
    steps = []
    for plan in STEPS:
        with ExitStack() as stack:
            steps.append(measured(plan(stack, quick), QUICK_BUDGET_S if quick else BUDGET_S))
        draw(directory / f"tradeoff_{steps[-1].name}", steps[-1], machine)
    rows = [
        (
            *(step.name, step.work, row.method, row.error, step.error.unit, step.error.name),
            *(row.second, step.second.unit, step.second.name, row.time_ms, *row.quartiles_ms),
            *(row.is_default, row.is_exact, "" if step.load.busy else row.on_front, row.beaten),
            *(row.more.get(name, "") for name in MORE_COLUMNS),
        )
        for step in steps
        for row in step.trials
    ]
    write_csv(directory / "tradeoff.csv", (*COLUMNS, *MORE_COLUMNS), rows)
    head = (
        f"medians on {machine}; * no method is both as accurate (by the first figure) and as fast;"
        " > hilstar's default"
    )
    load = max((step.load for step in steps), key=lambda load: load.cores)
    return load.judged([head, *(line for step in steps for line in table_lines(step))])


def this_machine() -> str:
    """The machine and GL that the times hold for."""
    with Renderer(Target((8, 8), SPRITE_PSF)) as renderer:
        return f"{renderer.gl_renderer}, {os.cpu_count()} cores"


def table_lines(step: Trials) -> list[str]:
    """A step's table for a person, the fastest method first."""
    wide = max(len(row.method) for row in step.trials)
    columns = (
        f"{step.error.name} [{step.error.unit}]",
        f"{step.second.name} [{step.second.unit}]",
        "ms",
    )
    lines = ["", f"{step.name}: {step.work}", f"   {'method':{wide}}  {'   '.join(columns)}"]
    for row in step.trials:
        marks = ("*" if row.on_front else " ") + (">" if row.is_default else " ")
        errors = "  ".join(
            f"{value:>{len(name)}.3g} "
            for value, name in zip((row.error, row.second), columns, strict=False)
        )
        lines.append(f"{marks} {row.method:{wide}}  {errors} {row.time_ms:.3g}")
    beaten = step.default.beaten
    if step.load.busy:
        lines.append(f"   {NOT_JUDGED}")
    if beaten:
        lines.append(f"   the default: {beaten}")
    if step.remark:
        lines.append(f"   {step.remark}")
    return lines


def finding(step: Trials) -> str:
    """The title of a step's chart; its times only where they can be judged."""
    own, exact = step.default, next((row for row in step.trials if row.is_exact), None)
    off = (
        "has no error"
        if own.error <= step.error.floor
        else f"is off by {said(own.error, step.error)}"
    )
    text = f"{'PSF' if step.name == 'psf' else step.name}: '{own.method}' {off}"
    compared = "" if exact is None else f"; '{exact.method}' takes {exact.time_ms:.3g} ms"
    return step.load.title(f"{text} in {own.time_ms:.3g} ms{compared}", text)


def said(value: float, figure: Figure) -> str:
    """A figure with its unit; a share has none."""
    return two_digits(value) + ("" if figure.unit == "1" else f" {figure.unit}")


def draw(path: Path, step: Trials, machine: str) -> None:
    """Draw error against time on logarithmic axes: the front as a line, the default ringed,
    every method named at the side.
    """
    floor, own = step.error.floor, step.default
    shown = {row.method: (row.time_ms, max(row.error, floor)) for row in step.trials}
    dotted = f" Dotted: {said(floor, step.error)}, no error below it." if floor else ""
    front_words = (
        "" if step.load.busy else " Blue: the front, which nothing else is as right and as fast as."
    )
    note = (
        f"{capital(step.work)}.{front_words} Ring: hilstar's default. Bars: quartiles.{dotted}"
        f" {machine}."
    )
    height = max(4.2, 1.9 + 0.17 * len(step.trials))
    with chart(path, finding(step), note=step.load.note(note), height_inch=height) as (axes,):
        front = [shown[row.method] for row in step.trials if row.on_front]
        if len(front) > 1:
            axes.step(*np.array(front).T, where="post", color=BLUE, lw=1.4)
        for row in step.trials:
            # A default that is alone on the front has the colour of its name.
            colour = RED if row is own and len(front) == 1 else BLUE if row.on_front else MUTED
            axes.plot(
                row.quartiles_ms,
                [shown[row.method][1]] * 2,
                color=colour,
                lw=3.5,
                alpha=0.4,
                solid_capstyle="butt",
            )
            axes.plot(*shown[row.method], "o", color=colour, ms=6, zorder=3)
        axes.plot(*shown[own.method], "o", color=RED, ms=14, mfc="none", mew=2.0, zorder=4)
        axes.set(
            xscale="log",
            yscale="log",
            xlabel="median time [ms]",
            ylabel=title_lines(
                f"{step.error.name} [{step.error.unit.replace('1', 'share')}]", LABEL_COLUMNS
            ),
        )
        axes.margins(0.06, 0.08)
        if any(row.error < floor for row in step.trials):
            axes.axhline(floor, color=MUTED, ls=":", lw=1.2)
        falling = sorted(step.trials, key=lambda row: (-shown[row.method][1], row.time_ms))
        colours = [RED if row is own else BLUE if row.on_front else MUTED for row in falling]
        name_at_side(
            axes,
            [
                (row.method, shown[row.method], colour)
                for row, colour in zip(falling, colours, strict=True)
            ],
        )
