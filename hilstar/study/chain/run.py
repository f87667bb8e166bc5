"""The whole frame's error against its time: each combination of a bench's choices, in five scenes of its own sky."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from hilstar.bench.bench_file import BenchFile
from hilstar.errors import InputError
from hilstar.files import make_directory
from hilstar.study.chain.bench_parts import Parts
from hilstar.study.chain.budget import error_budget
from hilstar.study.chain.chart import draw, draw_budget
from hilstar.study.chain.measuring import QUICK, Plan, SceneMeasurement
from hilstar.study.chain.panel import shortened_line
from hilstar.study.chain.scenes import five_scenes
from hilstar.study.chain.table import BudgetRow, Row, StageRow, budget_rows, rows_of, stage_rows, write_tables
from hilstar.study.chain.tracker import Tracker
from hilstar.study.chain.verdict import headline, is_right, scene_line
from hilstar.study.shared.other_work import OtherWork, busy_line, is_busy

OUTPUTS = (
    *(f"{name}{ending}" for name in ("chain", "chain_budget") for ending in (".png", ".svg")),
    "chain.csv",
    "chain_budget.csv",
    "chain_time.csv",
)


def run(
    file: BenchFile, directory: Path, quick: bool = False, advance: Callable[[int], object] | None = None
) -> tuple[list[str], bool | None]:
    """Measure a bench file's scenes; write OUTPUTS into `directory`.

    A line for each scene, and whether `auto` is on the front of all, or within the noise of it: None on a busy machine.
    `advance` hears how many scenes are done. Raises InputError, MachineError.
    """
    rows: list[Row] = []
    budget: list[BudgetRow] = []
    stages: list[StageRow] = []
    lines, judged, others = [], [], OtherWork()
    with Parts(file) as parts:
        tracker = Tracker(parts.own)
        try:
            for number, scene in enumerate(five_scenes(parts.own)):
                measurement = SceneMeasurement(parts, tracker, scene, QUICK if quick else Plan())
                if not measurement.star_count:
                    lines.append(f"{scene.name}: not measured: no star stands alone and stays in view over the exposure")
                    continue
                outcomes, stage_times = measurement.outcomes()
                own = rows_of(measurement, outcomes)
                auto = measurement.marks.auto
                parts_of_error = budget_rows(scene.name, error_budget(measurement, auto))
                parts_of_time = stage_rows(scene.name, stage_times)
                judged.append((own, parts_of_error, parts_of_time))
                rows, budget, stages = rows + own, budget + parts_of_error, stages + parts_of_time
                if advance is not None:
                    advance(number + 1)
            machine = f"{parts.own.renderer.gl_renderer}, {os.cpu_count()} cores"
            shortened = shortened_line(parts.own)
        finally:
            tracker.close()
    if not rows:
        raise InputError(f"{file.path}: no star stands alone in view in any scene; write a larger [sky] faintest_v_mag")
    others_cores = others.cores()
    busy = is_busy(others_cores)
    lines = [*(scene_line(*scene, busy) for scene in judged), *lines]
    make_directory(directory)
    write_tables(directory, rows, budget, stages)
    notes = [f"times on {machine}", *([] if shortened is None else [shortened]), *([busy_line(others_cores)] if busy else [])]
    draw(directory / "chain", rows, headline(rows, busy), "; ".join(notes))
    draw_budget(directory / "chain_budget", rows, budget, stages)
    return [*lines, *notes], None if busy else all(is_right(own) for own, _, _ in judged)
