"""The views of a bench: the display's, and its tracker's."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, lru_cache
from typing import TYPE_CHECKING

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.bench.bench_file import BenchFile
from hilstar.bench.build import star_rates
from hilstar.bench.cameras import bench_camera, tracker_camera
from hilstar.bench.faults.desk import FaultDesk
from hilstar.bench.faults.effects import Effects
from hilstar.bench.faults.scenario import NO_SCENARIO, Scenario
from hilstar.bench.faults.view import FaultView, Sight
from hilstar.bench.frame import Bench
from hilstar.scene.camera import Camera
from hilstar.sky.stars import Stars, aberrate

if TYPE_CHECKING:
    from hilstar.sky.bodies.moving import MovingSky


def display_view(bench: Bench, scenario: Scenario = NO_SCENARIO) -> FaultView:
    """The faults of a scenario as the monitor shows them."""
    tracker = tracker_camera(bench.config.tracker, bench.file.folder)
    sigma_px, footprint_px = bench.config.render.sprite_sigma_px, bench.renderer.footprint_px
    sight = _sight(bench.file, (bench.camera, bench.camera, tracker), (footprint_px, sigma_px), bench.stars, bench.moving)
    return FaultView(sight, scenario)


def tracker_view(
    file: BenchFile,
    camera: Camera,
    footprint_px: int,
    stars: Stars,
    moving: MovingSky | None,
    scenario: Scenario = NO_SCENARIO,
) -> FaultView:
    """The faults of a scenario as they fall on the virtual tracker's detector, whose `camera` it is."""
    monitor = bench_camera(file.config, file.folder)
    spread = footprint_px, file.config.tracker.psf_sigma_px
    return FaultView(_sight(file, (camera, monitor, camera), spread, stars, moving), scenario)


def _sight(
    file: BenchFile,
    cameras: tuple[Camera, Camera, Camera],
    spread: tuple[int, tuple[float, float]],
    stars: Stars,
    moving: MovingSky | None,
) -> Sight:
    """What a camera sees; `cameras` are itself, the monitor and the tracker, `spread` is its footprint and sigmas."""
    config = file.config
    return Sight(
        *cameras,
        *spread,
        exposure_s=config.tracker.exposure_s,
        apparent=_apparent(file, moving),
        v0_e_per_s=_v0_e_per_s(file),
        stars=stars,
    )


def _apparent(file: BenchFile, moving: MovingSky | None) -> Callable[[FloatArray], FloatArray]:
    """Directions as the bench's observer sees them, like its stars' own."""
    velocity_km_s = file.config.sky.observer_velocity_km_s
    if moving is not None:
        return lambda vectors: moving.stars_seen(vectors, np.zeros(len(vectors)))
    if any(velocity_km_s):
        return lambda vectors: aberrate(vectors, velocity_km_s)
    return lambda vectors: vectors


def _v0_e_per_s(file: BenchFile) -> Callable[[float], float]:
    tables = cache(lambda: star_rates(file.config, file.folder))  # 0.1 s, which only a fault needs

    @lru_cache(maxsize=256)
    def rate(bv_mag: float) -> float:
        return float(tables()(np.zeros(1), np.array([bv_mag]), np.array([np.nan]))[0])

    return rate


def effects_at(bench: Bench, scenario: Scenario, t_ns: int) -> Effects:
    """The faults of one frame of the display that is shown at a moment of a scenario. Raises InputError (see `FaultDesk`)."""
    view = display_view(bench, scenario)
    desk = FaultDesk(scenario, 1 / bench.config.monitor.refresh_hz, view.prepare)
    desk.begin(0)
    return Effects(view, desk.at(t_ns))
