"""The faults of a bench as its two cameras see them: the monitor, and the virtual tracker."""

from functools import cache, lru_cache
from typing import TYPE_CHECKING

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.optics.camera import Camera
from hilstar.optics.layers.fault_light import FaultCamera, FaultView
from hilstar.optics.layers.faults import FaultLayer
from hilstar.optics.layers.star_layer import StarLayer
from hilstar.optics.layers.view import Canvas
from hilstar.server.bench.bench_file import BenchFile
from hilstar.server.bench.cameras import bench_camera, tracker_camera
from hilstar.server.bench.frame import Bench
from hilstar.server.bench.scenario import NO_SCENARIO, FaultSchedule, Scenario
from hilstar.server.bench.star_rates import star_rates
from hilstar.sky.stars import Stars, aberrate

if TYPE_CHECKING:
    from hilstar.sky.bodies.moving import MovingSky


def display_view(bench: Bench, scenario: Scenario = NO_SCENARIO) -> FaultView:
    """The faults of a scenario as the monitor shows them."""
    tracker = tracker_camera(bench.config.tracker, bench.file.folder)
    camera = _fault_camera(
        bench.file, bench.canvas, bench.camera, tracker, bench.stars, bench.moving
    )
    return FaultView(
        camera,
        scenario.seed,
        scenario.folder if scenario.faults else None,
        frozenset(scenario.faults),
    )


def tracker_view(
    file: BenchFile,
    canvas: Canvas,
    stars: Stars,
    moving: "MovingSky | None",
    scenario: Scenario = NO_SCENARIO,
) -> FaultView:
    """The faults of a scenario as they fall on the virtual tracker's detector, which is
    `canvas`.
    """
    camera = _fault_camera(
        file, canvas, bench_camera(file.config, file.folder), canvas.camera, stars, moving
    )
    return FaultView(
        camera,
        scenario.seed,
        scenario.folder if scenario.faults else None,
        frozenset(scenario.faults),
    )


def _fault_camera(
    file: BenchFile,
    canvas: Canvas,
    monitor: Camera,
    tracker: Camera,
    stars: Stars,
    moving: "MovingSky | None",
) -> FaultCamera:
    velocity_km_s = file.config.sky.observer_velocity_km_s
    tables = cache(lambda: star_rates(file.config, file.folder))  # 0.1 s, which only a fault needs

    def apparent(vectors: FloatArray) -> FloatArray:
        if moving is not None:
            return moving.stars_seen(vectors, np.zeros(len(vectors)))
        if any(velocity_km_s):
            return aberrate(vectors, velocity_km_s)
        return vectors

    @lru_cache(maxsize=256)
    def v0_e_per_s(bv_mag: float) -> float:
        return float(tables()(np.zeros(1), np.array([bv_mag]), np.array([np.nan]))[0])

    points = StarLayer(canvas)
    exposure_s = file.config.tracker.exposure_s
    return FaultCamera(canvas, monitor, tracker, exposure_s, points, apparent, v0_e_per_s, stars)


def faults_at(bench: Bench, scenario: Scenario, t_ns: int) -> FaultLayer:
    """The faults of one frame shown at a moment of a scenario. Raises InputError (see
    `FaultSchedule`).
    """
    view = display_view(bench, scenario)
    schedule = FaultSchedule(scenario, 1 / bench.config.monitor.refresh_hz, view.prepare)
    schedule.begin(0)
    return FaultLayer(view, schedule.at(t_ns))
