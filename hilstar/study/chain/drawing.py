"""A combination's frames: from the sender's samples to codes, and the light that an exposure gathers of them."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.attitude.clock.timeline import Attitude, Timeline
from hilstar.bench.frame import Bench, Drawn
from hilstar.rotation import propagate
from hilstar.study.chain.combinations import Combination
from hilstar.study.chain.motion import Movement, attitude_at, filled_timeline, lead_ns
from hilstar.study.chain.panel import Exposure, Lit
from hilstar.units import NS_PER_S

STAGES = ("prediction", "sprites", "drawing and codes", "read-back")
# Each frame that is timed has an attitude of its own, as a sender's have: nothing can be kept from the frame before.
NUDGE_RAD = np.array([1e-7, 1e-7, 0.0])


@dataclass(frozen=True, slots=True)
class Chain:
    """A combination on its bench, before a moving sky."""

    combination: Combination
    bench: Bench
    movement: Movement

    def attitude(self, light_ns: int) -> Attitude:
        """The attitude for a frame's light, by the samples that are there when the frame is begun."""
        samples = self.movement.samples(light_ns - lead_ns(self.bench.config))
        timeline = filled_timeline(samples, self.combination.prediction, self.bench.config.attitude)
        return attitude_at(timeline, light_ns)

    def rate(self, attitude: Attitude) -> FloatArray | None:
        """The rate by which stars are drawn along their paths, None for points."""
        return attitude.rate_cam_rad_s if self.combination.smear == "path" else None

    def draw(self, number: int, light_ns: int) -> Drawn:
        """Draw the frame of a moment of light."""
        attitude = self.attitude(light_ns)
        return self.bench.draw(attitude.q_icrs_to_cam, number, self.rate(attitude))

    def lit(self, number: int, light_ns: int) -> Lit:
        """The pixels that a frame's codes light, and their light."""
        levels, panel = self.draw(number, light_ns).levels.ravel(), self.bench.panel
        place = np.flatnonzero(levels)
        light = panel.response.light[levels[place]] * panel.flux_at_white_e_per_s
        return place, light if panel.uniformity is None else light * panel.uniformity.ravel()[place]

    def exposed(self, seen: Exposure) -> FloatArray:
        """The mean light (H, W) over an exposure; one frame of a sky at rest stands for all that are like it."""
        alike = not self.movement.turns and self.combination.quantisation != "temporal"
        return (seen.at_rest if alike else seen.mean)(self.lit, self.bench.camera.resolution_px)


class Stopwatch:
    """Times a chain's frames one after the other, from the samples to the codes in memory."""

    def __init__(self, chain: Chain) -> None:
        self._chain = chain
        self._lead_ns = lead_ns(chain.bench.config)
        self._period_ns = round(NS_PER_S / chain.bench.config.monitor.refresh_hz)
        self._number = 0

    def frame_ms(self) -> tuple[float, float]:
        """Wall and processor time of the next frame, ms."""
        chain, (timeline, light_ns, number) = self._chain, self._next()
        begin, begin_cpu = time.perf_counter(), time.process_time()
        attitude = attitude_at(timeline, light_ns)
        _ = chain.bench.draw(attitude.q_icrs_to_cam, number, chain.rate(attitude)).levels
        return (time.perf_counter() - begin) * 1e3, (time.process_time() - begin_cpu) * 1e3

    def stages_ms(self) -> tuple[float, ...]:
        """The next frame's time by STAGES, with a wait for the GPU before its codes are read."""
        chain, (timeline, light_ns, number) = self._chain, self._next()
        bench = chain.bench
        marks = [time.perf_counter()]
        attitude = attitude_at(timeline, light_ns)
        marks.append(time.perf_counter())
        sprites = bench.frame_sprites(attitude.q_icrs_to_cam, chain.rate(attitude))
        marks.append(time.perf_counter())
        drawn = bench.draw_sprites(sprites, number)
        bench.renderer.context.finish()
        marks.append(time.perf_counter())
        _ = drawn.levels
        marks.append(time.perf_counter())
        return tuple((np.diff(marks) * 1e3).tolist())

    def _next(self) -> tuple[Timeline, int, int]:
        """The timeline of the next frame, its moment of light, and its number."""
        self._number += 1
        chain = self._chain
        light_ns = NS_PER_S + self._number * self._period_ns
        own = propagate(chain.movement.q_icrs_to_cam, NUDGE_RAD, self._number)
        samples = replace(chain.movement, q_icrs_to_cam=own).samples(light_ns - self._lead_ns)
        return (
            filled_timeline(samples, chain.combination.prediction, chain.bench.config.attitude),
            light_ns,
            self._number,
        )
