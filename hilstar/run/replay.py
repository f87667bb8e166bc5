"""The replay of a log or of a ledger: which part of it, how fast, and the run itself."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

import numpy as np
from msgspec import UNSET
from msgspec.structs import replace as replaced

from hilstar.attitude.clock.timeline import Attitude, Timeline
from hilstar.attitude.logs.entries import Stated
from hilstar.attitude.logs.gaps import log_joins
from hilstar.attitude.logs.log_file import NOTHING_STATED, log_timeline, open_log
from hilstar.attitude.logs.mcap_log import holds_ros, is_mcap, read_attitudes
from hilstar.attitude.receiver import PacketCounts
from hilstar.attitude.wire.packet import AttitudeSample, rate_refusal
from hilstar.attitude.wire.source import PACKETS, Conventions
from hilstar.bench.config import BenchConfig
from hilstar.bench.frame import Bench
from hilstar.errors import InputError, printable
from hilstar.monitor.quantise import QUANTISERS, Quantisation
from hilstar.notices import Notices
from hilstar.process.interrupts import stop_on_signal
from hilstar.run.faults import NO_RECORDING, Recording, read_recording, replayed_faults
from hilstar.run.loop import FrameLoop, Limit, policy_of
from hilstar.run.pacer import Moment
from hilstar.run.record.ledger_reader import drawable_frames, read_head
from hilstar.run.record.ledger_records import FrameRecord, below_step, frame_record
from hilstar.run.serve import Outlet, Running
from hilstar.run.shown import FrameSink, Shown, ignore
from hilstar.run.summary import RunSummary
from hilstar.units import NS_PER_S

MAX_FRAMES = 100_000_000
# `exact` in NumPy is another program than its shader: of two choices that are as good it may take the other.
OTHER_CODES_BY_NUMPY = 0.35


@dataclass(frozen=True, slots=True)
class Wanted:
    """What the command line asks of a replay: a factor of real time, infinite for as fast as possible, and seconds of the log.

    `start_s` and `stop_s` count from the log's first sample.
    """

    speed: float = 1.0
    start_s: float | None = None
    stop_s: float | None = None
    step_s: float | None = None


class Play(Protocol):
    """Recorded frames, in order; paced as on a monitor, or as fast as possible."""

    @property
    def paced(self) -> bool:
        """As on a monitor, where late frames are missed."""

    @property
    def frame_count(self) -> int:
        """How many frames there are."""

    @property
    def packet_count(self) -> int:
        """How many attitudes they come from."""

    @property
    def moving(self) -> bool | None:
        """Whether stars are drawn along their paths; None: as the bench file says."""

    @property
    def first_ns(self) -> int:
        """The time of the log's or the run's first frame."""

    @property
    def zero_ns(self) -> int:
        """The time from which a scenario counts its seconds: the log's first sample, or the run's first frame."""

    @property
    def recording(self) -> Recording:
        """The faults of an earlier run."""

    def past(self, slot: int) -> FrameRecord | None:
        """The frame of an earlier run; None of a log."""

    @property
    def drawn_by(self) -> DrawnBy | None:
        """Who drew an earlier run; None of a log, and where its ledger does not say."""

    @property
    def told(self) -> list[tuple[str, str]]:
        """Events to report before it begins: kinds and lines."""

    @property
    def conventions(self) -> Conventions:
        """What the log's numbers mean."""

    def frame(self, slot: int) -> tuple[int, int, Attitude | None]:
        """Number, time and attitude of a frame; None is blank."""


@dataclass(frozen=True, slots=True)
class DrawnBy:
    """Who draws a run's codes: the GL renderer and version as the driver names them, and the path (see `Backend.path`)."""

    gl_renderer: str
    gl_version: str
    path: str

    def __str__(self) -> str:
        """As a person reads it."""
        return f"{self.gl_renderer}, OpenGL {self.gl_version}, by {self.path}"

    def other_codes(self, other: DrawnBy, quantisation: Quantisation) -> float:
        """The largest share of lit pixels whose codes the two may draw one off; 0: the same bit for bit."""
        if self == other:
            return 0.0
        by_numpy = (self.path == "NumPy") != (other.path == "NumPy")
        return OTHER_CODES_BY_NUMPY if by_numpy else QUANTISERS[quantisation].other_codes


@dataclass(frozen=True, slots=True)
class LogPlay:
    """A log: frame k shows its time `first_ns + k step_s`."""

    timeline: Timeline
    first_ns: int
    step_s: float
    frame_count: int
    paced: bool
    moving: bool | None = None
    told: list[tuple[str, str]] = field(default_factory=list)
    conventions: Conventions = PACKETS
    zero_ns: int = 0
    recording: Recording = NO_RECORDING
    drawn_by: None = None

    @property
    def packet_count(self) -> int:
        """The samples of the log."""
        return len(self.timeline)

    def frame(self, slot: int) -> tuple[int, int, Attitude | None]:
        """Number, time and attitude of a frame."""
        t_ns = self.first_ns + round(slot * self.step_s * NS_PER_S)
        return slot, t_ns, self.timeline.at(t_ns)

    def past(self, slot: int) -> FrameRecord | None:
        """A log has no frames."""
        return None


@dataclass(frozen=True, slots=True)
class RunPlay:
    """An earlier run, from its ledger: the same frames with the same attitudes, so the same light.

    The same renderer draws the same codes bit for bit; another draws them within `DrawnBy.other_codes`.
    """

    frames: list[FrameRecord]
    packet_count: int
    paced: bool
    moving: bool | None = True  # where the run's own were
    told: list[tuple[str, str]] = field(default_factory=list)
    conventions: Conventions = PACKETS
    zero_ns: int = 0
    recording: Recording = NO_RECORDING
    drawn_by: DrawnBy | None = None

    @property
    def first_ns(self) -> int:
        """The time of the first frame that is replayed."""
        return self.frames[0].t_ns

    @property
    def frame_count(self) -> int:
        """The frames that the run drew."""
        return len(self.frames)

    def frame(self, slot: int) -> tuple[int, int, Attitude | None]:
        """Number, time and attitude of a frame."""
        past = self.frames[slot]
        rate = None if past.rate is None else np.array(past.rate)
        velocity = None if past.velocity_km_s is None else np.array(past.velocity_km_s)
        if past.q is None:
            return past.frame, past.t_ns, None
        place = None if past.place_km is None else np.array(past.place_km)
        attitude = Attitude(np.array(past.q), 0, False, rate_cam_rad_s=rate, velocity_km_s=velocity, place_km=place)
        return past.frame, past.t_ns, attitude

    def past(self, slot: int) -> FrameRecord | None:
        """The frame as it was recorded."""
        return self.frames[slot]


def plan_play(log: Path, wanted: Wanted, config: BenchConfig, stated: Stated = NOTHING_STATED) -> Play:
    """The frames of a replay: of a log one each refresh period, stretched by the speed, unless a step is given.

    Of a ledger those that its run drew. `stated` is what the log does not say itself. Raises InputError for a speed, a span or
    a step that gives no frame.
    """
    factor = wanted.speed
    if is_mcap(log) and not holds_ros(log):
        frames = list(drawable_frames(log, math.radians(config.attitude.max_rate_deg_s)))
        if frames:
            return _plan_run(log, wanted, factor, frames)
    read = open_log(log, stated)
    samples = read.samples
    _check_rates(log, samples, math.radians(config.attitude.max_rate_deg_s))
    start_s, stop_s = _span(log, wanted, (samples[-1].t_ns - samples[0].t_ns) / NS_PER_S)
    step_s = (1.0 if math.isinf(factor) else factor) / config.monitor.refresh_hz
    if wanted.step_s is not None:
        if wanted.step_s <= 0 or factor not in {1.0, math.inf}:
            raise InputError(f"--step {wanted.step_s:g}: write seconds above 0, with --speed realtime or max")
        step_s = wanted.step_s
    count = (stop_s - start_s) / step_s + 1e-6
    if count > MAX_FRAMES:
        raise InputError(f"{log}: gives {count:.3g} frames; write a longer --step, or --start and --stop")
    first_ns = samples[0].t_ns + round(start_s * NS_PER_S)
    joins = log_joins(samples)
    timeline = log_timeline(samples, policy_of(config.attitude), joins)
    told = [*read.told, *joins.told]
    play = LogPlay(timeline, first_ns, step_s, int(count) + 1, not math.isinf(factor), None)
    return replace(play, told=told, conventions=read.conventions, zero_ns=samples[0].t_ns)


def _check_rates(log: Path, samples: list[AttitudeSample], max_rate_rad_s: float) -> None:
    """Refuse (InputError) in a log what is refused in a stream."""
    for number, sample in enumerate(samples, start=1):
        refusal = rate_refusal(sample, max_rate_rad_s)
        if refusal is not None:
            raise InputError(f"{log}: attitude {number}: {refusal.detail}")


def _plan_run(log: Path, wanted: Wanted, factor: float, frames: list[FrameRecord]) -> RunPlay:
    if wanted.step_s is not None or factor not in {1.0, math.inf}:
        raise InputError(f"{log}: an earlier run is replayed frame by frame; use --speed realtime or max, and no --step")
    first_ns = frames[0].swap_ns
    start_s, stop_s = _span(log, wanted, (frames[-1].swap_ns - first_ns) / NS_PER_S)
    kept = [frame for frame in frames if start_s <= (frame.swap_ns - first_ns) / NS_PER_S <= stop_s + 1e-9]
    if not kept:
        raise InputError(f"{log}: has no frame from --start {start_s:g} to --stop {stop_s:g}; write a longer span")
    play = RunPlay(kept, sum(1 for _ in read_attitudes(log)), not math.isinf(factor))
    return replace(play, zero_ns=frames[0].t_ns, recording=read_recording(log), drawn_by=_drawn_by(log))


def _drawn_by(log: Path) -> DrawnBy | None:
    """Who drew a ledger's run; None where its head does not say all."""
    head = read_head(log)
    if not {"gl_renderer", "gl_version", "render_path"} <= head.keys():
        return None
    return DrawnBy(printable(head["gl_renderer"]), printable(head["gl_version"]), printable(head["render_path"]))


def _tell_other_renderer(before: DrawnBy | None, bench: Bench, notices: Notices) -> None:
    """Say where another renderer drew the run, and how far its codes may be from these."""
    renderer = bench.renderer
    now = DrawnBy(printable(renderer.gl_renderer), printable(renderer.gl_version), renderer.path)
    if before is None or before == now:
        return
    share = before.other_codes(now, renderer.target.quantisation)
    notices.tell(
        "other-renderer",
        f"the run was drawn by {before}, and is now by {now}: at most {share:.2g} of a frame's lit pixels may be one code off",
    )


def _span(log: Path, wanted: Wanted, length_s: float) -> tuple[float, float]:
    start_s = 0.0 if wanted.start_s is None else wanted.start_s
    stop_s = length_s if wanted.stop_s is None else wanted.stop_s
    if not 0 <= start_s <= stop_s <= length_s + 1e-9:
        raise InputError(f"{log}: --start {start_s:g} --stop {stop_s:g}; write seconds between 0 and its length, {length_s:g}")
    return start_s, stop_s


def replay(bench: Bench, play: Play, sink: FrameSink = ignore, outlet: Outlet | None = None) -> RunSummary:
    """Replay recorded frames; returns the summary.

    Paced, late frames are missed, as on a monitor; otherwise every frame is drawn, as fast as it can be.
    """
    outlet = outlet or Outlet()
    ledger = outlet.ledger
    faults = outlet.faults or replayed_faults(bench, play.recording, ledger)
    if faults is not None:
        faults.begin(play.zero_ns)
    frames = None if faults is None else faults.frames
    loop = outlet.on(FrameLoop(bench, sink, outlet.pacer(bench), play.moving, outlet.notices, frames))
    for kind, line in play.told:
        outlet.notices.tell(kind, line)
    _tell_other_renderer(play.drawn_by, bench, outlet.notices)

    def draw_slot(moment: Moment) -> Shown | None:
        if faults is not None:
            faults.recall(play.past(moment.slot))
        number, t_ns, attitude = play.frame(moment.slot)
        shown = loop.draw(number, t_ns, attitude, moment)
        if ledger.on and shown is not None:
            ledger.frame(frame_record(shown, t_ns, loop.tally.missed_frames, below_step(bench, shown)))
        return shown

    counts = PacketCounts(received=play.packet_count)
    outlet.follower(Running(loop, counts))
    bench.warm_up()
    begin_ns = time.monotonic_ns()
    with stop_on_signal(loop.stop), loop.watch:
        _draw_all(play, loop, draw_slot)
    duration_s = (time.monotonic_ns() - begin_ns) / NS_PER_S
    summary = loop.tally.summary(duration_s, counts, bench.renderer)
    summary = replaced(summary, faults=UNSET if faults is None else faults.summary(), sync=outlet.pulses())
    told = outlet.notices.counts()
    return replaced(summary, stale_events=loop.gate.events, events=told, screen=loop.screen_summary())


def _draw_all(play: Play, loop: FrameLoop, draw_slot: Callable[[Moment], Shown | None]) -> None:
    """All frames of a replay, paced or as fast as possible, until a signal."""
    if play.paced:
        loop.paced(Limit(slots=play.frame_count), draw_slot)
        return
    for slot in range(play.frame_count):
        if loop.stop.is_set():
            return
        draw_slot(Moment(slot))
