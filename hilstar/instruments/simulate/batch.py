"""Frames of the virtual tracker along a log, over all cores."""

import os
from collections.abc import Callable
from pathlib import Path

from hilstar.basics.errors import MachineError
from hilstar.basics.files import make_directory
from hilstar.basics.process.pool import ProcessPool
from hilstar.instruments.simulate.exposures import LogFaults
from hilstar.instruments.simulate.pictures import write_exposure_fits
from hilstar.instruments.simulate.simulator import (
    ExposurePiece,
    FaultyExposure,
    FrameNoise,
    Simulator,
    simulator_view,
)
from hilstar.optics.layers.view import View
from hilstar.server.bench.bench_file import BenchFile
from hilstar.server.bench.scenario import Scenario


def simulate_views(
    file: BenchFile,
    views: list[View],
    noise: FrameNoise,
    directory: Path,
    on_done: Callable[[int], None],
    faults: LogFaults | None = None,
) -> None:
    """Write `exposure_000000.fits` and on into `directory`, each with its own noise: seeds
    (seed, number).
    """
    with Simulator(file) as first:  # an error in the bench file is reported once, here
        pieces: list[tuple[ExposurePiece, ...]] = (
            [()] * len(views) if faults is None else faults.pieces(first, views)
        )
    make_directory(directory)
    scenario = None if faults is None else faults.scenario
    tasks = iter(enumerate(zip(views, pieces, strict=True)))
    with ProcessPool(_start_exposing, (file, noise, directory, scenario), (Exception,)) as pool:
        for _ in range(min(len(views), len(os.sched_getaffinity(0)))):
            pool.start()
        done = 0
        while done < len(views):
            for worker, news, payload in pool.heard():
                if news == "error":
                    raise payload
                if news == "died":
                    raise MachineError(
                        f"a process of the pool ended with code {payload}; is there enough memory?"
                    )
                if news == "answer":
                    done += 1
                    on_done(done)
                task = next(tasks, None)
                if task is not None:
                    number, (view, cuts) = task
                    worker.give(number, number, view, cuts)


def _start_exposing(
    file: BenchFile, noise: FrameNoise, directory: Path, scenario: Scenario | None
) -> tuple[None, Callable[[int, View, tuple[ExposurePiece, ...]], None]]:
    """In a worker: no greeting, and the work, which writes one exposure."""
    simulator = Simulator(file)
    if scenario is None:
        seen_by = None
    else:
        seen_by = simulator_view(simulator, scenario)
    if seen_by is not None and scenario is not None:
        scenario.prepared(seen_by.prepare)

    def expose(number: int, view: View, pieces: tuple[ExposurePiece, ...]) -> None:
        if seen_by is None:
            faults = None
        else:
            faults = FaultyExposure(seen_by, pieces)
        exposure = simulator.expose(view, noise.rng(number), faults=faults)
        write_exposure_fits(directory / f"exposure_{number:06d}.fits", simulator, exposure, noise)

    return None, expose
