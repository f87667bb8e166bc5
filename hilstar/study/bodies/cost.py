"""What each body costs: the time of a frame with it, against the same frame of a bench that knows no bodies."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.bench.discs import When
from hilstar.bench.frame import Bench
from hilstar.study.bodies.scenes import DAY_SIDE_NS, REFRESH_HZ, Aim, attitude
from hilstar.units import NS_PER_S

FRAME_NS = round(NS_PER_S / REFRESH_HZ)


@dataclass(frozen=True, slots=True)
class Scene:
    """A bench by its name, where it looks, and how far its clock goes from frame to frame."""

    name: str
    bench: str
    aim: Aim
    step_ns: int = FRAME_NS


@dataclass(frozen=True, slots=True)
class Cost:
    """One scene: the fastest frame of the rounds, ms, with the body and without any, and the difference.

    `cpu_ms` is the difference in processor time, all cores together, the driver's threads too: what a busy machine changes
    least, and in software rendering the whole cost. `discs` are the bodies drawn as such, `stars` counts the stars drawn.
    """

    scene: str
    frame_ms: float
    without_ms: float
    cost_ms: float
    cpu_ms: float
    discs: str
    stars: int


SCENES = (
    Scene("from the Earth's centre, no body", "observer", Aim("Moon", 60.0)),
    Scene("planets, none in view", "planets", Aim("Jupiter", 60.0)),
    Scene("Uranus in view, a point", "planets", Aim("Uranus", 0.3)),
    Scene("Jupiter in view, 1.1 px", "planets", Aim("Jupiter", 0.3)),
    Scene("Moon, not in view", "Moon", Aim("Moon", 60.0)),
    Scene("Moon in view, 55 px", "Moon", Aim("Moon", 0.3)),
    Scene("Sun, not in view", "Sun", Aim("Sun", 60.0)),
    Scene("Sun in view, 57 px", "Sun", Aim("Sun", 0.3)),
    Scene("from a low orbit, no body", "low orbit", Aim("Earth", 80.0, DAY_SIDE_NS)),
    Scene("Earth, not in view", "Earth", Aim("Earth", 80.0, DAY_SIDE_NS)),
    Scene("Earth's limb across the middle", "Earth", Aim("Earth", 0.0, DAY_SIDE_NS)),
    Scene("Earth fills the field", "Earth", Aim("Earth", -60.0, DAY_SIDE_NS)),
    Scene("all of them, none in view", "all", Aim("Earth", 80.0, DAY_SIDE_NS)),
    Scene("the same, at a step of the orbit", "all", Aim("Earth", 80.0, DAY_SIDE_NS), 2 * NS_PER_S),
)


def measure(benches: Mapping[str, Bench], scene: Scene, rounds: int) -> Cost:
    """A scene and the same frame without bodies, timed in turn. `benches` has "nothing", "all" and the scene's."""
    bench, nothing = benches[scene.bench], benches["nothing"]
    knows = bench.moving is not None and scene.aim.body in bench.moving.names
    q = attitude(bench if knows else benches["all"], scene.aim)
    times = []
    for k in range(rounds + 1):
        t_ns = scene.aim.t_ns + k * scene.step_ns
        times.append((*frame_ms(nothing, q, None), *frame_ms(bench, q, t_ns)))
    stars = bench.draw(q, t_ns=scene.aim.t_ns).star_count
    discs = " ".join(disc.name for disc in bench.discs(q, When(scene.aim.t_ns)))
    without_ms, without_cpu_ms, with_ms, with_cpu_ms = np.min(np.array(times[1:]), axis=0).tolist()
    return Cost(scene.name, with_ms, without_ms, with_ms - without_ms, with_cpu_ms - without_cpu_ms, discs, stars)


def frame_ms(bench: Bench, q: FloatArray, t_ns: int | None) -> tuple[float, float]:
    """The time of drawing one frame and reading its levels back, ms, and the processor time."""
    begin, begin_cpu = time.perf_counter(), time.process_time()
    _ = bench.draw(q, t_ns=t_ns).levels
    return (time.perf_counter() - begin) * 1e3, (time.process_time() - begin_cpu) * 1e3
