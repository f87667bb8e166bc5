"""The trade-off of depth: how faint the catalogue goes."""

from __future__ import annotations

from contextlib import ExitStack
from functools import partial
from pathlib import Path

from hilstar.arrays import FloatArray
from hilstar.bench.build import bench_calibration, brightest_peak_e_per_s
from hilstar.bench.cameras import ideal_monitor
from hilstar.bench.config import SkySettings
from hilstar.render.renderer import Renderer, Target
from hilstar.scene.camera import Camera
from hilstar.scene.sprites import make_sprites
from hilstar.sky.stars import Stars
from hilstar.study.shared.predictors import ORION
from hilstar.study.tradeoff.demo import (
    NO_LIMIT_V_MAG,
    SIGMA_PX,
    demo_config,
    stars_to,
    turn_to_image,
)
from hilstar.study.tradeoff.table import Figure, Trial, Trials

LIMITS_V_MAG = (5.0, 6.0, 6.5, 7.0, 7.5, 8.0, 8.5, 9.0, 10.0)


def depth(stack: ExitStack, quick: bool) -> Trials:
    """How deep the catalogue goes: light of the whole sky that is lost, %, and stars drawn in the field."""
    del quick
    config, camera = demo_config(), ideal_monitor(demo_config())
    calibration, white = bench_calibration(config, Path()), brightest_peak_e_per_s(stars_to(NO_LIMIT_V_MAG), SIGMA_PX)
    renderer = stack.enter_context(Renderer(Target(camera.resolution_px, SIGMA_PX, calibration.response, white)))
    everything = stars_to(NO_LIMIT_V_MAG).electrons_per_s.sum()
    default, turn, trials = SkySettings().faintest_v_mag, turn_to_image(ORION, camera), []
    for limit in sorted({*LIMITS_V_MAG, default, NO_LIMIT_V_MAG}):
        stars = stars_to(limit)
        lost = 100 * (1 - stars.electrons_per_s.sum() / everything) if len(stars) < len(stars_to(NO_LIMIT_V_MAG)) else 0.0
        drawn = len(make_sprites(stars, turn, camera, renderer.footprint_px))
        name = "all of Hipparcos" if limit == NO_LIMIT_V_MAG else f"V to {limit:g}"
        work = partial(_frame, renderer, stars, turn, camera)
        trials.append(Trial(name, lost, drawn, work, limit == default, limit == NO_LIMIT_V_MAG))
    return Trials(
        "depth",
        f"a frame of Orion to codes, {camera.resolution_px[0]} x {camera.resolution_px[1]}",
        Figure("light of the catalogue lost", "%", 0.1),
        Figure("sprites in the frame", "stars"),
        "Hipparcos is complete to about V = 7.5",
        trials,
        "stars missing from Hipparcos are in no figure; it is complete to V = 7.3 to 9, by position and type (ESA SP-1200)",
    )


def _frame(renderer: Renderer, stars: Stars, icrs_to_image: FloatArray, camera: Camera) -> None:
    renderer.draw(make_sprites(stars, icrs_to_image, camera, renderer.footprint_px))
    renderer.codes()
