"""Every combination of a scene measured: its error over some exposures, and its time in turn with all others."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hilstar.rotation import propagate
from hilstar.study.chain.bench_parts import Marks, Parts
from hilstar.study.chain.combinations import Combination, combinations
from hilstar.study.chain.drawing import STAGES, Chain, Stopwatch
from hilstar.study.chain.motion import Movement
from hilstar.study.chain.panel import exposure
from hilstar.study.chain.scenes import Scene
from hilstar.study.chain.tracker import Judge, Off, Tracker, attitude_off_arcsec, off
from hilstar.units import ERROR_OF_MEDIAN

FIRST_FRAMES = (20, 151, 325)  # of the exposures: apart by no whole number of cycles of `temporal` or of the jitter
PHASE_STEP_PX = (3.37, 4.71)  # of the tracker, from exposure to exposure
SIGMAS_IN_IQR = 1.349  # of a normal distribution
FRAMES_A_VISIT = 2
MIN_ROUNDS, MAX_ROUNDS = 4, 60
SEED = 1


@dataclass(frozen=True, slots=True)
class Plan:
    """How many exposures each combination is judged by, and for how long a scene's combinations are timed, s."""

    exposures: int = len(FIRST_FRAMES)
    time_s: float = 12.0


QUICK = Plan(exposures=1, time_s=2.0)


@dataclass(frozen=True, slots=True)
class Error:
    """What a combination's stars are off by, rms: each star on its own, arcsec and mag, and all of them as one attitude."""

    arcsec: float
    mag: float
    attitude_arcsec: float
    roll_arcsec: float
    stars: int
    lost: int


@dataclass(frozen=True, slots=True)
class Times:
    """A frame's median time, quartile range and one sigma of the median, ms; its processor time; how many were timed."""

    median_ms: float
    iqr_ms: float
    noise_ms: float
    cpu_ms: float
    frames: int


@dataclass(frozen=True, slots=True)
class StageTime:
    """The median time of a stage of a frame, ms."""

    stage: str
    ms: float


@dataclass(frozen=True, slots=True)
class Outcome:
    """A combination as measured."""

    combination: Combination
    sprite_px: str
    error: Error
    times: Times


class SceneMeasurement:
    """A scene on a study's benches: what is judged in it, and its combinations."""

    def __init__(self, parts: Parts, tracker: Tracker, scene: Scene, plan: Plan) -> None:
        self.parts, self.tracker, self.scene, self.plan = parts, tracker, scene, plan
        self.movement = Movement(scene.q_icrs_to_cam, scene.rate_deg_s)
        self.marks: Marks = parts.marks(self.movement)
        found = combinations(self.movement.turns, parts.can_steal_bits, parts.faintest_v_mag)
        marked = (self.marks.default, self.marks.auto, self.marks.as_filed)
        self.combinations = list(dict.fromkeys([*found, *marked]))
        self.judges = [
            Judge(tracker, self._moved(k), exposure(parts.own, number))
            for k, number in enumerate(FIRST_FRAMES[: plan.exposures])
        ]

    @property
    def star_count(self) -> int:
        """The stars that are judged, over all exposures."""
        return sum(len(judge) for judge in self.judges)

    def chain(self, combination: Combination, exposure_number: int = 0) -> Chain:
        """A combination, ready to draw what an exposure sees."""
        return Chain(combination, self.parts.bench(combination), self.judges[exposure_number].movement)

    def _moved(self, number: int) -> Movement:
        """The movement that an exposure sees: at rest each has its stars at other sub-pixel phases."""
        if self.movement.turns:
            return self.movement
        step_rad = np.array([*PHASE_STEP_PX, 0.0]) / self.tracker.camera.focal_length_px
        return replace(self.movement, q_icrs_to_cam=propagate(self.movement.q_icrs_to_cam, step_rad, number))

    def outcomes(self) -> tuple[list[Outcome], list[StageTime]]:
        """Every combination's error and time, and what the stages of `auto` take."""
        chains = [self.chain(combination) for combination in self.combinations]
        times, stages = timed(chains, self.plan.time_s, self.combinations.index(self.marks.auto))
        found = [
            Outcome(chain.combination, sprite_px(chain), self.error(chain.combination), spent)
            for chain, spent in zip(chains, times, strict=True)
        ]
        return found, stages

    def error(self, combination: Combination) -> Error:
        """A combination's error over all exposures."""
        found, turns = [], []
        for number, judge in enumerate(self.judges):
            light = self.chain(combination, number).exposed(judge.seen)
            shown = judge.measure(self.tracker.image_e(light, judge.seen))
            found.append(off(judge, shown, judge.sky))
            turns.append(attitude_off_arcsec(shown, judge.sky))
        arcsec, mag = pooled(found)
        cross, roll = (rms_of_known(column) for column in zip(*turns, strict=True))
        return Error(arcsec, mag, cross, roll, self.star_count, sum(int(one.lost.sum()) for one in found))


def rms_of_known(values: Sequence[float]) -> float:
    """The rms of the values that are numbers, NaN for none."""
    known = [value for value in values if math.isfinite(value)]
    return math.sqrt(sum(value**2 for value in known) / len(known)) if known else math.nan


def pooled(found: Sequence[Off]) -> tuple[float, float]:
    """The rms over the stars of several exposures, arcsec and mag."""
    arcsec, mag = (np.concatenate([getattr(one, name) for one in found]) for name in ("arcsec", "mag"))
    return math.sqrt(float(np.mean(arcsec**2))), math.sqrt(float(np.mean(mag**2)))


def sprite_px(chain: Chain) -> str:
    """The sides of a chain's sprites, px."""
    sides = [side.side_px for side in chain.bench.renderer.target.sides]
    low, high = min(sides, default=chain.bench.renderer.footprint_px), max(sides, default=chain.bench.renderer.footprint_px)
    return f"{low}" if low == high else f"{low} to {high}"


def timed(chains: Sequence[Chain], time_s: float, staged: int) -> tuple[list[Times], list[StageTime]]:
    """The times of all chains, and those of the stages of one of them.

    In rounds, each with an order of its own, so that other load on the machine affects all. A visit's first frame is not
    counted: it fills what the chain before has emptied.
    """
    watches = [Stopwatch(chain) for chain in chains]
    for watch in watches:
        watch.frame_ms()
    spent: list[list[tuple[float, float]]] = [[] for _ in watches]
    stages: list[tuple[float, ...]] = []
    rng, begin = np.random.default_rng(SEED), time.perf_counter()
    for number in range(MAX_ROUNDS):
        if number >= MIN_ROUNDS and time.perf_counter() - begin > time_s:
            break
        for k in rng.permutation(len(watches) + 1):
            if k == len(watches):
                watches[staged].frame_ms()
                stages += [watches[staged].stages_ms() for _ in range(FRAMES_A_VISIT)]
                continue
            watches[k].frame_ms()
            spent[k] += [watches[k].frame_ms() for _ in range(FRAMES_A_VISIT)]
    middle = np.median(stages, axis=0).tolist()
    return [_times(np.array(one)) for one in spent], [StageTime(*pair) for pair in zip(STAGES, middle, strict=True)]


def _times(spent: np.ndarray) -> Times:
    low, middle, high = np.percentile(spent[:, 0], (25, 50, 75))
    noise = ERROR_OF_MEDIAN * (high - low) / SIGMAS_IN_IQR / math.sqrt(len(spent))
    return Times(float(middle), float(high - low), float(noise), float(np.median(spent[:, 1])), len(spent))
