"""For each step of the chain: every method against the exact one, error against time, on the
machine at hand.
"""

import os
from collections.abc import Callable
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
    budget_s = QUICK_BUDGET_S if quick else BUDGET_S
    steps = []
    rows = []
    for plan in STEPS:
        with ExitStack() as stack:
            step = measured(plan(stack, quick), budget_s)
        draw_trials(directory / f"tradeoff_{step.name}", step, machine)
        steps.append(step)
        rows += [_table_row(step, trial) for trial in step.trials]
    write_csv(directory / "tradeoff.csv", (*COLUMNS, *MORE_COLUMNS), rows)
    head = (
        f"medians on {machine}; * no method is both as accurate (by the first figure) and as fast;"
        " > hilstar's default"
    )
    load = max((step.load for step in steps), key=lambda load: load.cores)
    return load.judged([head, *(line for step in steps for line in table_lines(step))])


def _table_row(step: Trials, trial: Trial) -> list[object]:
    """A trial's cells, by COLUMNS and MORE_COLUMNS."""
    on_front = "" if step.load.busy else trial.on_front
    more = [trial.more.get(name, "") for name in MORE_COLUMNS]
    return [
        *(step.name, step.work, trial.method, trial.error, step.error.unit, step.error.name),
        *(trial.second, step.second.unit, step.second.name, trial.time_ms, *trial.quartiles_ms),
        *(trial.is_default, trial.is_exact, on_front, trial.beaten),
        *more,
    ]


def this_machine() -> str:
    """The machine and GL that the times hold for."""
    with Renderer(Target((8, 8), SPRITE_PSF)) as renderer:
        return f"{renderer.gl_renderer}, {os.cpu_count()} cores"
