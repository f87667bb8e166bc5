"""For each step of the chain: every method against the exact one, error against time, on the
machine at hand.
"""

import os
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path

from hilstar.basics.charts import write_csv
from hilstar.display.render.renderer import Renderer
from hilstar.display.render.target import Target
from hilstar.instruments.study.sweep import Judged
from hilstar.instruments.study.tradeoff.light import brightness, depth, psf, quantisation, spectrum
from hilstar.instruments.study.tradeoff.places import (
    SPRITE_PSF,
    culling,
    prediction,
    projection,
    smear,
)
from hilstar.instruments.study.trials import Trial, Trials, draw_trials, measured, table_lines
from hilstar.tracker.centroiders import FAMILY

# In the order of the chain.
STEPS: tuple[Callable[[ExitStack, bool], Trials], ...] = (
    *(brightness, spectrum, depth),
    *(culling, projection, prediction, smear),
    *(psf, quantisation),
)
# Time for the rounds of one step, s: 30 s in all with --quick, five minutes without, set-up and
# charts included.
QUICK_BUDGET_S, BUDGET_S = 0.8, 25.0
# Columns of the step `quantisation` alone: the error by centroiders of every kind.
MORE_COLUMNS = tuple(f"max_px_{kind}" for kind in FAMILY)


def run(directory: Path, quick: bool = False) -> Judged:
    """Write a chart for each step and one table (CSV) into `directory`; the table as lines for a
    person.
    """
    return report(directory, measure(quick))


def measure(quick: bool) -> list[Trials]:
    """Every step's methods, with their times."""
    budget_s = QUICK_BUDGET_S if quick else BUDGET_S
    steps = []
    for plan in STEPS:
        with ExitStack() as stack:
            steps.append(measured(plan(stack, quick), budget_s))
    return steps


def report(directory: Path, steps: Sequence[Trials]) -> Judged:
    """Write what was measured; the table as lines. Raises InputError.

    A step that was timed on a busy machine has no front: its `front` and `beaten_by` are empty.
    """
    machine = this_machine()
    table = []
    for step in steps:
        draw_trials(directory / f"tradeoff_{step.name}", step, machine)
        for trial in step.trials:
            table.append(cells_of_trial(step, trial))
    rows = [list(cells.values()) for cells in table]
    write_csv(directory / "tradeoff.csv", list(table[0]), rows)
    lines = [
        f"medians on {machine}; * no method is both as accurate (by the first figure) and as fast;"
        " > hilstar's default"
    ]
    for step in steps:
        lines += table_lines(step)
    load = max((step.load for step in steps), key=lambda load: load.cores)
    return load.judged(lines)


def cells_of_trial(step: Trials, trial: Trial) -> dict[str, object]:
    """A trial's cells by column; a cell that does not apply is empty."""
    first_ms, third_ms = trial.quartiles_ms
    cells: dict[str, object] = {
        "step": step.name,
        "work": step.work,
        "method": trial.method,
        "error": trial.error,
        "error_unit": step.error.unit,
        "error_is": step.error.name,
        "second": trial.second,
        "second_unit": step.second.unit,
        "second_is": step.second.name,
        "time_ms": trial.time_ms,
        "quartile_1_ms": first_ms,
        "quartile_3_ms": third_ms,
        "default": trial.is_default,
        "exact": trial.is_exact,
        "front": "" if step.load.busy else trial.on_front,
        "beaten_by": trial.beaten,
    }
    for name in MORE_COLUMNS:
        cells[name] = trial.more.get(name, "")
    return cells


def this_machine() -> str:
    """The renderer and the cores on which the times were taken."""
    with Renderer(Target((8, 8), SPRITE_PSF)) as renderer:
        return f"{renderer.gl_renderer}, {os.cpu_count()} cores"
