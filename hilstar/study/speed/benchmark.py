"""How long a frame takes, stage by stage, beside other methods for the same image, in one run and on the same stars."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from hilstar.bench.bench_file import BenchFile, read_bench_file
from hilstar.bench.build import open_bench
from hilstar.rotation import from_radec_roll_deg
from hilstar.study.shared.bench_text import Table, Value, bench_text
from hilstar.study.shared.other_work import OtherWork, is_busy
from hilstar.study.speed.cells import CellMeasurement
from hilstar.study.speed.other_methods import other_methods
from hilstar.study.speed.result import REFERENCE_PX, Aim, Cell, Result, SceneOrigin, Size, Skipped
from hilstar.study.speed.scenes import scene
from hilstar.study.speed.starts import fresh_start, this_machine

SIZES: tuple[Size, ...] = ((1024, 1024), REFERENCE_PX, (2560, 2048), (3840, 2160))
COUNTS = (100, 1000, 10_000, 50_000)
MAX_STARS = 200_000  # NumPy's method takes 2.9 kB of memory for each
RADEC_ROLL_DEG = (84.057, -1.2, 10.0)
# What the project set itself on two cores, ms: whole frames by image and stars, Python at REFERENCE_PX by stars; how many times
# a still frame one may take that turns by 10 deg/s.
AIMS_MS = {(REFERENCE_PX, 1000): 3.5, (REFERENCE_PX, 10_000): 10.0, ((3840, 2160), 50_000): 40.0}
PYTHON_AIMS_MS = {1000: 0.2, 10_000: 1.0}
TURNING_TIMES = 2.0
START_AIM_MS = 1500.0


@dataclass(frozen=True, slots=True)
class Plan:
    """What to measure: image sizes (px), star counts, and the maximum rounds and seconds of a method in one cell.

    `file` replaces the benchmark's own bench file; `sizes` is then that file's image size.
    """

    sizes: tuple[Size, ...] = SIZES
    counts: tuple[int, ...] = COUNTS
    rounds: int = 100
    budget_s: float = 10.0
    starts: int = 3
    file: BenchFile | None = None


QUICK = Plan(sizes=(REFERENCE_PX,), counts=COUNTS[:3], rounds=30, budget_s=2.0)


def run(plan: Plan, rng: np.random.Generator, advance: Callable[[int], object]) -> Result:
    """Measure every cell of a plan; `advance` hears how many are done. Raises InputError, MachineError."""
    methods, missing = other_methods()
    others = OtherWork()
    result = Result(this_machine(), does={method.name: method.does for method in methods})
    result.skipped += [Skipped(method=name, why=why) for name, why in missing.items()]
    q_icrs_to_cam = from_radec_roll_deg(*RADEC_ROLL_DEG)
    with TemporaryDirectory() as folder:
        for place, size in enumerate(plan.sizes):
            file = plan.file or own_bench_file(Path(folder) / "bench.toml", size, motion="on")
            with open_bench(file) as bench:
                result.gl_renderer = bench.renderer.gl_renderer
                every = bench.shown_stars
                for k, count in enumerate(plan.counts):
                    shown = scene(bench, every, q_icrs_to_cam, count, rng)
                    result.scenes.append(SceneOrigin(*size, count, shown.catalogue_count, count - shown.catalogue_count))
                    with CellMeasurement(
                        bench.with_stars(shown.stars), q_icrs_to_cam, Cell(*size, count), result
                    ) as measurement:
                        measurement.measure(methods, plan.rounds, plan.budget_s)
                    advance(place * len(plan.counts) + k + 1)
            result.startup += [fresh_start(file.path, q_icrs_to_cam, size) for _ in range(plan.starts)]
    _summarise_starts(result, plan.sizes)
    result.others_cores = round(others.cores(), 2)
    result.aims += _aims(result)
    return result


def own_bench_file(path: Path, size_px: Size, **render: Value) -> BenchFile:
    """The benchmark's own bench file for an image size, written to `path`; `render` are further keys of [render]."""
    tables: dict[str, Table] = {
        "tracker": {"resolution_px": (1024, 1024)},
        "sky": {"faintest_v_mag": 14},
        "monitor": {"resolution_px": size_px, "pixel_pitch_um": 57.65},
        "collimator": {"focal_length_mm": 200},
        "render": {"flux_at_white_e_per_s": 2e6, "quantisation": "round", **render},
    }
    path.write_text(bench_text(tables))
    return read_bench_file(path)


def _summarise_starts(result: Result, sizes: tuple[Size, ...]) -> None:
    """Medians at REFERENCE_PX, or at the first size."""
    size = REFERENCE_PX if REFERENCE_PX in sizes else sizes[0]
    here = [start for start in result.startup if start.size == size]
    result.import_ms = float(np.median([start.import_ms for start in here]))
    result.first_frame_ms = float(np.median([start.first_frame_ms for start in here]))
    result.memory_mb = float(np.median([start.memory_mb for start in here]))


def _aims(result: Result) -> list[Aim]:
    """The aims that this run can judge."""
    at = {(row.size, row.stars, row.method, row.kind): row.ms.median for row in result.rows}
    aims = []
    for (size, stars, method, kind), ms in at.items():
        where = f"{stars} stars, {size[0]} x {size[1]}"
        still, numba = (at.get((size, stars, *key)) for key in (("hilstar", "whole_frame"), ("numba", "linear_only")))
        if kind == "whole_frame" and (size, stars) in AIMS_MS:
            aims.append((f"whole frame to codes, {where}", AIMS_MS[size, stars], ms))
        elif kind == "turning" and still is not None:
            aims.append((f"turning by 10 deg/s, {where}, {TURNING_TIMES:g} still frames", TURNING_TIMES * still, ms))
        elif kind == "linear_only" and method == "hilstar" and numba is not None:
            aims.append((f"linear image, {where}, numba's time", numba, ms))
    for python in result.python_ms:
        if python.size == REFERENCE_PX and python.stars in PYTHON_AIMS_MS:
            aims.append((f"Python outside GL, {python.stars} stars", PYTHON_AIMS_MS[python.stars], python.ms.median))
    starts = [start.import_ms + start.first_frame_ms for start in result.startup if start.size == REFERENCE_PX]
    if starts:
        aims.append(("import and first frame", START_AIM_MS, float(np.median(starts))))
    judged = not is_busy(result.others_cores)
    return [Aim(what, aim_ms, ms, ms <= aim_ms if judged else None) for what, aim_ms, ms in aims]
