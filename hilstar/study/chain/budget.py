"""Where a combination's error comes from.

The steps are added one by one to a display that does everything exactly, in the order of the chain, and each is charged with
what it changes in the stars that the tracker measures: all of them together are the whole error, star by star. Cut sprites come
last, for their cut is in the light that codes leave dark: without them it would be charged to both.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.bench.frame import Bench
from hilstar.rotation import to_matrix
from hilstar.scene.frame_motion import Turn, swept_sprites
from hilstar.scene.sprites import Sprites, make_sprites
from hilstar.sky.stars import Stars
from hilstar.study.chain.combinations import Combination
from hilstar.study.chain.measuring import SceneMeasurement, pooled
from hilstar.study.chain.panel import Lit
from hilstar.study.chain.tracker import Measured, off
from hilstar.study.chain.true_light import linear_light

STEPS = ("refresh", "prediction", "smear", "depth", "codes", "sprites")
RSS, WHOLE = "rss", "whole"


@dataclass(frozen=True, slots=True)
class Part:
    """What a step adds to the error, rms arcsec and mag; the last two are the steps' root sum of squares, and the whole."""

    step: str
    arcsec: float
    mag: float


def error_budget(scene: SceneMeasurement, combination: Combination) -> list[Part]:
    """The parts of a combination's error by STEPS, then RSS and WHOLE."""
    found = [[judge.sky, *_measured(scene, combination, number)] for number, judge in enumerate(scene.judges)]
    parts = []
    for k, step in enumerate(STEPS):
        off_by = [off(judge, one[k + 1], one[k]) for judge, one in zip(scene.judges, found, strict=True)]
        parts.append(Part(step, *pooled(off_by)))
    rss = [float(np.sqrt(sum(getattr(part, name) ** 2 for part in parts))) for name in ("arcsec", "mag")]
    whole = pooled([off(judge, one[-1], one[0]) for judge, one in zip(scene.judges, found, strict=True)])
    return [*parts, Part(RSS, *rss), Part(WHOLE, *whole)]


def _measured(scene: SceneMeasurement, combination: Combination, number: int) -> Iterator[Measured]:
    """The stars of an exposure after each of STEPS."""
    judge = scene.judges[number]
    for light in _lights(scene, combination, number):
        yield judge.measure(scene.tracker.image_e(light, judge.seen))


def _lights(scene: SceneMeasurement, combination: Combination, number: int) -> Iterator[FloatArray]:
    """The mean light (H, W) of an exposure after each of STEPS."""
    chain, seen = scene.chain(combination, number), scene.judges[number].seen
    movement = chain.movement
    bench, every = chain.bench, scene.parts.own.stars

    def exposed(light_of: Callable[[int, int], Lit]) -> FloatArray:
        return (seen.mean if movement.turns else seen.at_rest)(light_of, bench.camera.resolution_px)

    def true(_: int, light_ns: int) -> Lit:
        turn = Turn(movement.at(light_ns), movement.rate_rad_s(light_ns))
        return linear_light(bench, _sprites(bench, every, turn, movement.turns))

    def shown_as(stars: Stars, along_paths: bool) -> FloatArray:
        def light_of(_: int, light_ns: int) -> Lit:
            attitude = chain.attitude(light_ns)
            rate = attitude.rate_cam_rad_s
            turn = Turn(attitude.q_icrs_to_cam, np.zeros(3) if rate is None else rate)
            return linear_light(bench, _sprites(bench, stars, turn, along_paths and rate is not None))

        return exposed(light_of)

    along_paths = movement.turns and combination.smear == "path"
    yield exposed(true)
    yield shown_as(every, movement.turns)
    yield shown_as(every, along_paths)
    yield shown_as(bench.shown_stars, along_paths)
    yield scene.chain(replace(combination, sprite="full"), number).exposed(seen)
    yield chain.exposed(seen)


def _sprites(bench: Bench, stars: Stars, turn: Turn, along_paths: bool) -> Sprites:
    """Whole sprites of stars in a frame, along their paths or as points."""
    footprint_px, sigma_px = bench.renderer.footprint_px, bench.config.render.sprite_sigma_px
    if along_paths:
        return swept_sprites(stars, turn, bench.scan, bench.camera, footprint_px, sigma_px)
    return make_sprites(stars, bench.camera.cam_to_image @ to_matrix(turn.q_icrs_to_cam), bench.camera, footprint_px)
