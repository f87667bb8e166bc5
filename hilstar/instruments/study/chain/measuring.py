"""Measurements of the study of the chain: error over some exposures, time in turn with all other
combinations, error budget.

A frame goes from the sender's samples to codes; an exposure sums the light of its frames. The
budget starts from a display that does everything exactly and adds one step at a time, in the order
of the chain. Each step is charged with the change of the measured stars; the steps add up to the
whole error, star by star. Cut sprites come last, because codes leave the cut light dark: earlier it
would be charged twice.
"""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from hilstar.attitude.clock.timeline import Attitude, Timeline
from hilstar.basics.arrays import FloatArray
from hilstar.basics.rotation import propagate
from hilstar.basics.units import ERROR_OF_MEDIAN, NS_PER_S
from hilstar.display.response import Levels
from hilstar.instruments.study.chain import choices
from hilstar.instruments.study.chain.tracker import (
    Off,
    StarJudge,
    StudyTracker,
    attitude_off_arcsec,
    linear_light,
    off,
    points,
)
from hilstar.instruments.study.predictors import Movement, attitude_at
from hilstar.instruments.study.sweep import Spent, spent
from hilstar.optics.frame_motion import CameraTurn, swept_sprites
from hilstar.optics.sprites import FrameLight
from hilstar.server.bench.drawn import Drawn
from hilstar.server.bench.frame import Bench
from hilstar.sky.stars import Stars

STAGES = ("prediction", "sprites", "drawing and codes", "read-back")
# Each frame that is timed has an attitude of its own, as a sender's have: nothing can be kept from
# the frame before.
NUDGE_RAD = np.array([1e-7, 1e-7, 0.0])
# first frames of the exposures: no whole number of cycles of `temporal` or of the jitter apart
FIRST_FRAMES = (20, 151, 325)
PHASE_STEP_PX = (3.37, 4.71)  # tracker pixels, from exposure to exposure
SIGMAS_IN_IQR = 1.349  # normal distribution
FRAMES_A_VISIT = 2  # timed in a row, after one that does not count
MIN_ROUNDS, MAX_ROUNDS = 4, 60  # whatever time they take
SEED = 1
STEPS = ("refresh", "prediction", "smear", "depth", "codes", "sprites")
RSS, WHOLE = "rss", "whole"
DEFAULT, AUTO = "default", "auto"
DIGITS, MS_PLACES = 4, 4  # significant digits of an error, decimal places of a time


@dataclass(slots=True)
class DrawingChain:
    """A combination on its bench, before a moving sky. `timed_frames` counts the frames timed so
    far.
    """

    combination: choices.ChainCombination
    bench: Bench
    movement: Movement
    timed_frames: int = 0

    def timeline(self, movement: Movement, light_ns: int) -> Timeline:
        """The samples that have arrived when the frame starts whose light is at `light_ns`."""
        samples = movement.samples(light_ns - choices.lead_ns(self.bench.config))
        return choices.filled_timeline(
            samples, self.combination.prediction, self.bench.config.attitude
        )

    def attitude(self, light_ns: int) -> Attitude:
        """The attitude at a frame's light, predicted when the frame starts."""
        return attitude_at(self.timeline(self.movement, light_ns), light_ns)

    def rate(self, attitude: Attitude) -> FloatArray | None:
        """The rate along which stars are drawn as paths, rad/s; None where they are drawn as
        points.
        """
        if self.combination.smear == "path":
            return attitude.rate_cam_rad_s
        return None

    def lit(self, number: int, light_ns: int) -> choices.Lit:
        """The pixels that a frame's codes light, and each one's light, electrons per second."""
        attitude = self.attitude(light_ns)
        panel = self.bench.panel
        levels = self.bench.draw(attitude.q_icrs_to_cam, number, self.rate(attitude)).levels.ravel()
        place = np.flatnonzero(levels)
        light = panel.response.light[levels[place]] * panel.flux_at_white_e_per_s
        if panel.uniformity is not None:
            light = light * panel.uniformity.ravel()[place]
        return place, light

    def exposed(self, seen: choices.PanelExposure) -> FloatArray:
        """The mean light (H, W) over an exposure; at rest one frame stands for all, except with
        `temporal`.
        """
        alike = is_alike(self.movement, self.combination)
        return (seen.at_rest if alike else seen.mean)(self.lit, self.bench.camera.resolution_px)

    def sprite_px(self) -> str:
        """The sides of its sprites, px."""
        sides_px = [side.side_px for side in self.bench.renderer.target.sides]
        return range_words(sides_px or [self.bench.psf.footprint_px])

    def frame_ms(self) -> Spent:
        """Wall and processor time of the next frame, ms."""
        timeline, light_ns = self.next_frame()

        def draw() -> object:
            attitude = attitude_at(timeline, light_ns)
            return self.bench.draw(
                attitude.q_icrs_to_cam, self.timed_frames, self.rate(attitude)
            ).levels

        return spent(draw)

    def stages_ms(self) -> tuple[float, ...]:
        """The next frame's time by STAGES, with a wait for the GPU before its codes are read."""
        (timeline, light_ns), bench = self.next_frame(), self.bench

        def predicted(_: object) -> Attitude:
            return attitude_at(timeline, light_ns)

        def light(attitude: Attitude) -> FrameLight:
            return bench.light(bench.view(attitude.q_icrs_to_cam, self.rate(attitude)))

        def drawn(sprites: FrameLight) -> Drawn:
            drawn = bench.draw_sprites(sprites, self.timed_frames)
            bench.renderer.finish()
            return drawn

        def read(drawn: Drawn) -> Levels:
            return drawn.levels

        return laps_ms((predicted, light, drawn, read))

    def next_frame(self) -> tuple[Timeline, int]:
        """The timeline of the next frame that is timed, and its moment of light."""
        self.timed_frames += 1
        light_ns = NS_PER_S + self.timed_frames * round(
            NS_PER_S / self.bench.config.monitor.refresh_hz
        )
        return self.timeline(nudged(self.movement, self.timed_frames), light_ns), light_ns


def is_alike(movement: Movement, combination: choices.ChainCombination) -> bool:
    """Whether all frames of a scene are alike: at rest, except with `temporal`."""
    return not movement.turns and combination.quantisation != "temporal"


def range_words(sizes: Sequence[int]) -> str:
    """The smallest and the largest of sizes, in words."""
    low, high = min(sizes), max(sizes)
    return f"{low}" if low == high else f"{low} to {high}"


def nudged(movement: Movement, frame: int) -> Movement:
    """The movement of a frame that is timed, with an attitude of its own."""
    q_icrs_to_cam = propagate(movement.q_icrs_to_cam, NUDGE_RAD, frame)
    return replace(movement, q_icrs_to_cam=q_icrs_to_cam)


def laps_ms(works: Sequence[Callable[[Any], Any]]) -> tuple[float, ...]:
    """The time of each of several works, ms, each of which is given what the one before gave."""
    given = None
    marks = [time.perf_counter()]
    for work in works:
        given = work(given)
        marks.append(time.perf_counter())
    return tuple((np.diff(marks) * 1e3).tolist())


@dataclass(frozen=True, slots=True)
class Rounds:
    """The exposures that judge a combination, and the time for a scene's combinations, s."""

    exposures: int = len(FIRST_FRAMES)
    time_s: float = 12.0


QUICK = Rounds(exposures=1, time_s=0.5)


@dataclass(frozen=True, slots=True)
class Error:
    """The rms error of a combination: of each star, arcsec and mag, and of their attitude."""

    stars: int
    lost: int
    error_arcsec: float
    error_mag: float
    attitude_arcsec: float
    roll_arcsec: float


@dataclass(frozen=True, slots=True)
class Times:
    """A frame's median time, its quartile range and the sigma of the median, ms; its processor
    time, ms; the number of frames.
    """

    time_ms: float
    iqr_ms: float
    noise_ms: float
    cpu_ms: float
    frames: int


@dataclass(frozen=True, slots=True)
class StageTime:
    """The median time of a stage of a frame at a scene's `chosen` point; its fields are the
    columns of `chain_time.csv`.
    """

    scene: str
    chosen: str
    stage: str
    time_ms: float


@dataclass(frozen=True, slots=True)
class ErrorPart:
    """What a step adds to the error (rms) at a scene's `chosen` point; its fields are the columns
    of `chain_budget.csv`.

    The steps RSS and WHOLE are the root sum of squares of the others, and the whole error.
    """

    scene: str
    chosen: str
    step: str
    error_arcsec: float
    error_mag: float


@dataclass(frozen=True, slots=True)
class CombinationRow:
    """A combination in a scene; its fields are the columns of `chain.csv`.

    `exposure_s` is the measured part of the tracker's exposure. `error_arcsec` and `error_mag` are
    rms over the `stars` of all exposures, `lost` of them not found. `on_front` and `on_front_mag`
    are the fronts of `time_ms` against these two. `on_front_as_filed` is the first of them among
    the choices of effort: rows with the `bit_stealing`, `faintest_v_mag` and `prediction` of the
    bench file.
    """

    scene: str
    rate_deg_s: float
    exposure_s: float
    bits: int
    bit_stealing: str
    faintest_v_mag: float
    sprite: str
    sprite_px: str
    smear: str
    prediction: str
    quantisation: str
    stars: int
    lost: int
    error_arcsec: float
    error_mag: float
    attitude_arcsec: float
    roll_arcsec: float
    time_ms: float
    iqr_ms: float
    noise_ms: float
    cpu_ms: float
    frames: int
    on_front: str = ""
    on_front_mag: str = ""
    on_front_as_filed: str = ""
    chosen: str = ""
    as_filed: str = ""


def said(flag: bool) -> str:
    """A flag as the table writes it."""
    return "true" if flag else "false"


class SceneMeasurement:
    """A scene on a study's benches: its judges, one an exposure, and its combinations."""

    def __init__(
        self, parts: choices.Parts, tracker: StudyTracker, scene: choices.ChainScene, plan: Rounds
    ) -> None:
        self.parts = parts
        self.tracker = tracker
        self.scene = scene
        self.plan = plan
        self.movement = Movement(scene.q_icrs_to_cam, scene.rate_deg_s)
        self.marks: choices.Marks = parts.marks(self.movement)
        possible = choices.combinations(
            self.movement.turns, parts.can_steal_bits, parts.faintest_v_mag
        )
        marked = (self.marks.default, self.marks.auto, self.marks.as_filed)
        self.combinations = list(dict.fromkeys([*possible, *marked]))
        self.judges = []
        for k, number in enumerate(FIRST_FRAMES[: plan.exposures]):
            moved = moved_on(self.movement, k, tracker.camera.focal_length_px)
            self.judges.append(StarJudge(tracker, moved, choices.exposure(parts.own, number)))

    @property
    def star_count(self) -> int:
        """The stars that are judged, over all exposures."""
        return sum(len(judge) for judge in self.judges)

    def chain(
        self, combination: choices.ChainCombination, exposure_number: int = 0
    ) -> DrawingChain:
        """A combination with the movement of one exposure."""
        return DrawingChain(
            combination, self.parts.bench(combination), self.judges[exposure_number].movement
        )

    def outcomes(self) -> tuple[list[CombinationRow], list[StageTime]]:
        """Every combination's error and time, and the times of the stages of `auto`."""
        chains = []
        for combination in self.combinations:
            chains.append(self.chain(combination))
        times, stages = timed(chains, self.plan.time_s, self.combinations.index(self.marks.auto))
        rows = []
        for chain, taken in zip(chains, times, strict=True):
            rows.append(self.row(chain, taken))
        return rows, [
            StageTime(self.scene.name, AUTO, stage, round(ms, MS_PLACES))
            for stage, ms in zip(STAGES, stages, strict=True)
        ]

    def untimed(self) -> list[CombinationRow]:
        """Every combination's error, which is the same on every machine; its times are NaN."""
        untimed = Times(math.nan, math.nan, math.nan, math.nan, 0)
        rows = []
        for combination in self.combinations:
            rows.append(self.row(self.chain(combination), untimed))
        return rows

    def row(self, chain: DrawingChain, taken: Times) -> CombinationRow:
        """A combination's row of the table."""
        own_combination = chain.combination
        return CombinationRow(
            scene=self.scene.name,
            rate_deg_s=self.scene.rate_deg_s,
            exposure_s=rounded(self.judges[0].seen.length_s),
            bits=self.parts.own.config.monitor.bits,
            sprite_px=chain.sprite_px(),
            chosen=chosen_words(own_combination, self.marks),
            as_filed=said(own_combination == self.marks.as_filed),
            **(asdict(own_combination) | {"bit_stealing": said(own_combination.bit_stealing)}),
            **asdict(self.error(own_combination)),
            **asdict(taken),
        )

    def error(self, combination: choices.ChainCombination) -> Error:
        """A combination's error over all exposures."""
        star_errors = []
        turns = []
        for number, judge in enumerate(self.judges):
            light = self.chain(combination, number).exposed(judge.seen)
            shown = judge.measure(self.tracker.image_e(light, judge.seen))
            star_errors.append(off(shown, judge.sky, judge.lost_arcsec))
            turns.append(attitude_off_arcsec(shown, judge.sky))
        return error_of(star_errors, turns)


def moved_on(movement: Movement, exposure_number: int, focal_length_px: float) -> Movement:
    """The movement of a scene's exposure: at rest each has its stars at other sub-pixel phases."""
    if movement.turns:
        return movement
    step_rad = np.array([*PHASE_STEP_PX, 0.0]) / focal_length_px
    q_icrs_to_cam = propagate(movement.q_icrs_to_cam, step_rad, exposure_number)
    return replace(movement, q_icrs_to_cam=q_icrs_to_cam)


def chosen_words(combination: choices.ChainCombination, marks: choices.Marks) -> str:
    """What the table calls a combination: DEFAULT, AUTO, both or nothing."""
    chosen = {DEFAULT: marks.default, AUTO: marks.auto}
    return " ".join(name for name, marked in chosen.items() if marked == combination)


def error_of(star_errors: Sequence[Off], turns: Sequence[tuple[float, float]]) -> Error:
    """The error over several exposures, by the stars of each and their attitude's, arcsec."""
    arcsec, mag = pooled(star_errors)
    cross, roll = (rms_of_known(column) for column in zip(*turns, strict=True))
    stars = sum(len(field_errors.lost) for field_errors in star_errors)
    lost = sum(int(field_errors.lost.sum()) for field_errors in star_errors)
    return Error(stars, lost, *map(rounded, (arcsec, mag, cross, roll)))


def rms_of_known(values: Sequence[float]) -> float:
    """The rms of the finite values; NaN where there is none."""
    known = [value for value in values if math.isfinite(value)]
    if known:
        return math.sqrt(sum(value**2 for value in known) / len(known))
    return math.nan


def pooled(found: Sequence[Off]) -> tuple[float, float]:
    """The rms over the stars of several exposures, arcsec and mag."""
    arcsec = np.concatenate([field_errors.arcsec for field_errors in found])
    mag = np.concatenate([field_errors.mag for field_errors in found])
    return math.sqrt(float(np.mean(arcsec**2))), math.sqrt(float(np.mean(mag**2)))


def timed(
    chains: Sequence[DrawingChain], time_s: float, staged: int
) -> tuple[list[Times], list[float]]:
    """Time all chains, and the STAGES of one of them; the stages' medians are in ms.

    Each round has an order of its own, so that other load on the machine affects all. A visit's
    first frame does not count: it fills caches that the chain before has emptied.
    """
    for chain in chains:
        chain.frame_ms()
    taken: list[list[Spent]] = [[] for _ in chains]
    stages: list[tuple[float, ...]] = []
    rng = np.random.default_rng(SEED)
    begin = time.perf_counter()
    for number in range(MAX_ROUNDS):
        if number >= MIN_ROUNDS and time.perf_counter() - begin > time_s:
            break
        for k in rng.permutation(len(chains) + 1):
            chain = chains[staged if k == len(chains) else k]
            chain.frame_ms()
            if k == len(chains):
                for _ in range(FRAMES_A_VISIT):
                    stages.append(chain.stages_ms())
            else:
                for _ in range(FRAMES_A_VISIT):
                    taken[k].append(chain.frame_ms())
    return [times_of(np.array(times_ms)) for times_ms in taken], np.median(stages, axis=0).tolist()


def times_of(taken: FloatArray) -> Times:
    """The statistics of frames' times (n, 2): wall and processor, ms."""
    low, middle, high = np.percentile(taken[:, 0], (25, 50, 75))
    noise = ERROR_OF_MEDIAN * (high - low) / SIGMAS_IN_IQR / math.sqrt(len(taken))
    time_ms, iqr_ms, noise_ms, cpu_ms = (
        round(float(ms), MS_PLACES) for ms in (middle, high - low, noise, np.median(taken[:, 1]))
    )
    return Times(time_ms, iqr_ms, noise_ms, cpu_ms, len(taken))


def noise_ends_ms(time_ms: float, noise_ms: float) -> tuple[float, float]:
    """The ends of the bar that shows a time's noise; at least half of the time, for a logarithmic
    axis.
    """
    return max(time_ms - noise_ms, time_ms / 2), time_ms + noise_ms


def rounded(value: float) -> float:
    """A figure with the tables' four digits."""
    if math.isfinite(value):
        return float(f"{value:.{DIGITS}g}")
    return value


def error_budget(scene: SceneMeasurement, combination: choices.ChainCombination) -> list[ErrorPart]:
    """The parts of the error of `auto`'s combination: STEPS, then RSS and WHOLE."""
    # by exposure: what is measured in the sky itself, then behind each step
    measured_by_step = []
    for number, judge in enumerate(scene.judges):
        measured = [judge.sky]
        for light in _lights(scene, combination, number):
            measured.append(judge.measure(scene.tracker.image_e(light, judge.seen)))
        measured_by_step.append(measured)

    def between(before: int, after: int) -> tuple[float, float]:
        offs = []
        for judge, measured in zip(scene.judges, measured_by_step, strict=True):
            offs.append(off(measured[after], measured[before], judge.lost_arcsec))
        return pooled(offs)

    errors = {step: between(k, k + 1) for k, step in enumerate(STEPS)}
    arcsec, mag = np.sqrt(np.sum(np.square(list(errors.values())), axis=0)).tolist()
    errors[RSS] = arcsec, mag
    errors[WHOLE] = between(0, -1)
    return [
        ErrorPart(scene.scene.name, AUTO, step, rounded(arcsec), rounded(mag))
        for step, (arcsec, mag) in errors.items()
    ]


def _lights(
    scene: SceneMeasurement, combination: choices.ChainCombination, number: int
) -> Iterator[FloatArray]:
    """The mean light (H, W) of an exposure after each of STEPS."""
    chain = scene.chain(combination, number)
    visible = scene.judges[number].seen
    movement = chain.movement
    bench = chain.bench
    every = scene.parts.own.stars

    def exposed(light_of: Callable[[int, int], choices.Lit]) -> FloatArray:
        light_by_pixel = visible.mean if movement.turns else visible.at_rest
        return light_by_pixel(light_of, bench.camera.resolution_px)

    def whole(stars: Stars, turn: CameraTurn, along_paths: bool) -> choices.Lit:
        if along_paths:
            return linear_light(
                bench, swept_sprites(stars, turn, bench.scan, bench.camera, bench.psf)
            )
        return linear_light(bench, points(bench, turn.q_icrs_to_cam, stars))

    def true(_: int, light_ns: int) -> choices.Lit:
        return whole(
            every, CameraTurn(movement.at(light_ns), movement.rate_rad_s(light_ns)), movement.turns
        )

    def shown_as(stars: Stars, along_paths: bool) -> FloatArray:
        def light_of(_: int, light_ns: int) -> choices.Lit:
            attitude = chain.attitude(light_ns)
            rate = attitude.rate_cam_rad_s
            turn = CameraTurn(attitude.q_icrs_to_cam, np.zeros(3) if rate is None else rate)
            return whole(stars, turn, along_paths and rate is not None)

        return exposed(light_of)

    along_paths = movement.turns and combination.smear == "path"
    yield exposed(true)
    yield shown_as(every, movement.turns)
    yield shown_as(every, along_paths)
    yield shown_as(bench.shown_stars, along_paths)
    yield scene.chain(replace(combination, sprite="full"), number).exposed(visible)
    yield chain.exposed(visible)
