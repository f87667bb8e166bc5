"""The replay of a log or of a ledger: which part of it, how fast, the run itself, and its frames
as files.
"""

import csv
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np
from msgspec.structs import replace as replaced

from hilstar.attitude.clock.resolution import coarse_lines
from hilstar.attitude.clock.timeline import Attitude
from hilstar.attitude.logs.entries import Stated
from hilstar.attitude.logs.log_file import log_timeline, open_log
from hilstar.attitude.logs.log_formats import NOTHING_STATED, check_stated
from hilstar.attitude.logs.log_times import TIMES, span_line
from hilstar.attitude.logs.mcap_log import holds_ros, is_mcap, read_attitudes
from hilstar.attitude.receiver import PacketCounts
from hilstar.attitude.wire.packet import rate_refusal
from hilstar.attitude.wire.source import PACKETS, Conventions
from hilstar.basics.errors import InputError, cannot_write, printable
from hilstar.basics.files import make_directory, refuse_ledger
from hilstar.basics.notices import Notices
from hilstar.basics.process.interrupts import stop_on_signal
from hilstar.basics.units import NS_PER_S
from hilstar.basics.wrong_sky import ENDS, WrongSky
from hilstar.display.quantise import Quantisation
from hilstar.display.quantisers import QUANTISERS
from hilstar.server.bench.config import BenchConfig
from hilstar.server.bench.frame import Bench
from hilstar.server.bench.frame_files import write_codes_png
from hilstar.server.faults import NO_RECORDING, Recording, ReplayedFaults, RunFaults, read_recording
from hilstar.server.loop import Limit, policy_of
from hilstar.server.pacer import FrameSink, Moment, Shown, ignore
from hilstar.server.record.ledger_records import (
    FrameRecord,
    codes_ms_of,
    drawable_frames,
    event_records,
    frame_records,
    read_head,
)
from hilstar.server.run_progress import Running
from hilstar.server.serve import Outlet
from hilstar.server.summary import RunSummary

MAX_FRAMES = 100_000_000
ROUNDING = 1e-6  # of a frame, by which a span of whole steps may fall short
SAME_S = 1e-9  # two times of a run that are as near as this are one
# `exact` in NumPy is another program than its shader: of two choices that are as good it may take
# the other.
OTHER_CODES_BY_NUMPY = 0.35
COLUMNS = ("frame", "t_s", "qw", "qx", "qy", "qz", "stars_drawn", "clipped")


@dataclass(frozen=True, slots=True)
class Wanted:
    """What the command line asks of a replay: a factor of real time, infinite for as fast as
    possible, and seconds of the log.

    `start_s` and `stop_s` count from the log's first sample.
    """

    speed: float = 1.0
    start_s: float | None = None
    stop_s: float | None = None
    step_s: float | None = None


@dataclass(frozen=True, slots=True)
class DrawnBy:
    """Who draws a run's codes: the GL renderer and version as the driver names them, and the
    path (see `Backend.path`).
    """

    gl_renderer: str
    gl_version: str
    path: str

    def __str__(self) -> str:
        """As a person reads it."""
        return f"{self.gl_renderer}, OpenGL {self.gl_version}, by {self.path}"

    def other_codes(self, other: "DrawnBy", quantisation: Quantisation) -> float:
        """The largest share of lit pixels whose codes the two may draw one off; 0: the same bit
        for bit.
        """
        if self == other:
            return 0.0
        by_numpy = (self.path == "NumPy") != (other.path == "NumPy")
        if by_numpy:
            return OTHER_CODES_BY_NUMPY
        return QUANTISERS[quantisation].other_codes


class PlayedFrame(NamedTuple):
    """Number, time and attitude of a frame to be replayed, and an earlier run's record; without
    an attitude it is blank.
    """

    number: int
    t_ns: int
    attitude: Attitude | None
    past: FrameRecord | None = None


@dataclass(frozen=True, slots=True)
class Play:
    """Recorded frames, in order; `paced` as on a monitor, where late ones are missed, else as fast
    as possible.

    `first_ns` is the time of the first frame, and `zero_ns` that from which a scenario counts its
    seconds: the log's first sample, or the run's first frame. `moving` says whether stars are drawn
    along their paths; None: as the bench file says. `told` are events to report before it begins,
    `span` says how long a log is, and its step. `wrong_sky` is when the sky
    of an earlier run was wrong: it is so again. Only an earlier run has faults in its `recording`,
    and a
    renderer (`drawn_by`) and what codes cost (`codes_ms`) that its ledger may name. The same
    renderer draws the same codes from them bit for bit; another draws them within
    `DrawnBy.other_codes`.
    """

    frame: Callable[[int], PlayedFrame]
    frame_count: int
    packet_count: int
    paced: bool
    first_ns: int
    zero_ns: int
    moving: bool | None = None
    told: Sequence[tuple[str, str]] = ()
    span: str = ""
    conventions: Conventions = PACKETS
    recording: Recording = NO_RECORDING
    drawn_by: DrawnBy | None = None
    codes_ms: tuple[float, float] | None = None
    wrong_sky: WrongSky = field(default_factory=WrongSky)


def played_again(
    read: Callable[[], Iterator[FrameRecord]],
    count: int,
    packet_count: int,
    paced: bool,
    recording: Recording,
) -> Play:
    """The play of an earlier run's `count` frames, each with the attitude and the motion that it
    had.

    They are read as they are played, in order, so that memory does not grow with the run.
    """
    frames = read()
    at = -1
    past = first = next(read())

    def frame(slot: int) -> PlayedFrame:
        nonlocal at, past
        while at < slot:
            if (next_frame := next(frames, None)) is None:
                raise InputError("the ledger became shorter while it was replayed; replay it again")
            past = next_frame
            at = at + 1
        if past.q is None:
            return PlayedFrame(past.frame, past.t_ns, None, past)
        rate, velocity, place = (
            None if v is None else np.array(v)
            for v in (past.rate, past.velocity_km_s, past.place_km)
        )
        attitude = Attitude(
            np.array(past.q), 0, False, rate_cam_rad_s=rate, velocity_km_s=velocity, place_km=place
        )
        return PlayedFrame(past.frame, past.t_ns, attitude, past)

    return Play(
        frame, count, packet_count, paced, first.t_ns, first.t_ns, moving=True, recording=recording
    )


def plan_play(
    log: Path, wanted: Wanted, config: BenchConfig, stated: Stated = NOTHING_STATED
) -> Play:
    """The frames of a replay: of a log one each refresh period, stretched by the speed, unless a
    step is given.

    Of a ledger those that its run drew. `stated` is what the log does not say itself. Raises
    InputError for a speed, a span or a step that gives no frame.
    """
    check_stated(log, stated)
    if is_mcap(log) and not holds_ros(log):
        past = _look_through(log, wanted, math.radians(config.attitude.max_rate_deg_s))
        if past is not None:
            return _plan_run(log, wanted, past)
    read = open_log(log, stated)
    samples = read.samples
    for number, sample in enumerate(samples, start=1):  # what a stream would refuse
        refusal = rate_refusal(sample, math.radians(config.attitude.max_rate_deg_s))
        if refusal is not None:
            raise InputError(f"{log}: attitude {number}: {refusal.detail}")
    try:
        start_s, stop_s = _span(log, wanted, (samples[-1].t_ns - samples[0].t_ns) / NS_PER_S)
        step_s = _frame_step_s(log, wanted, config.monitor.refresh_hz, stop_s - start_s)
    except InputError as error:
        # a span of the wrong length is most often one in the wrong unit
        doubts = "".join(f"; {line}" for kind, line in read.told if kind == TIMES)
        raise InputError(f"{error}{doubts}") from error
    first_ns = samples[0].t_ns + round(start_s * NS_PER_S)
    joins = read.joins()
    timeline = log_timeline(samples, policy_of(config.attitude), joins)

    def frame(slot: int) -> PlayedFrame:
        t_ns = first_ns + round(slot * step_s * NS_PER_S)
        return PlayedFrame(slot, t_ns, timeline.at(t_ns))

    count = int((stop_s - start_s) / step_s + ROUNDING) + 1
    play = Play(
        frame, count, len(timeline), not math.isinf(wanted.speed), first_ns, samples[0].t_ns
    )
    notices = [*read.told, *joins.told, *coarse_lines(samples)]
    return replace(play, told=notices, conventions=read.conventions, span=span_line(samples))


def _frame_step_s(log: Path, wanted: Wanted, refresh_hz: float, length_s: float) -> float:
    """The time of the log from frame to frame. Raises InputError where that gives too many."""
    step_s = (1.0 if math.isinf(wanted.speed) else wanted.speed) / refresh_hz
    if wanted.step_s is not None:
        if wanted.step_s <= 0 or wanted.speed not in {1.0, math.inf}:
            raise InputError(
                f"--step {wanted.step_s:g}: write seconds above 0, with --speed realtime or max"
            )
        step_s = wanted.step_s
    count = length_s / step_s + ROUNDING
    if count > MAX_FRAMES:
        raise InputError(
            f"{log}: gives {count:.3g} frames; write a longer --step, or --start and --stop"
        )
    return step_s


@dataclass(frozen=True, slots=True)
class PastFrames:
    """The first and the last frame of a ledger, and how many are in the span that is wanted."""

    first: FrameRecord
    last: FrameRecord
    count: int


def _look_through(log: Path, wanted: Wanted, max_rate_rad_s: float) -> PastFrames | None:
    """The frames of a ledger, each decoded and checked; None without any. Raises InputError for
    one that cannot be drawn again.
    """
    first = last = None
    count = 0
    for last in drawable_frames(log, max_rate_rad_s):
        if first is None:
            first = last
        count += _is_wanted(wanted, (last.swap_ns - first.swap_ns) / NS_PER_S)
    if first is None or last is None:
        return None
    return PastFrames(first, last, count)


def _is_wanted(wanted: Wanted, at_s: float) -> bool:
    """Whether a frame so long after the first is in the span that is wanted."""
    after = wanted.start_s is None or wanted.start_s <= at_s
    before = wanted.stop_s is None or at_s <= wanted.stop_s + SAME_S
    return after and before


def _plan_run(log: Path, wanted: Wanted, past: PastFrames) -> Play:
    first = past.first
    last = past.last
    count = past.count
    if wanted.step_s is not None or wanted.speed not in {1.0, math.inf}:
        raise InputError(
            f"{log}: an earlier run is replayed frame by frame; use --speed realtime or max, and no"
            " --step"
        )
    start_s, stop_s = _span(log, wanted, (last.swap_ns - first.swap_ns) / NS_PER_S)

    def in_span() -> Iterator[FrameRecord]:
        return (
            record
            for record in frame_records(log, tell=False)
            if _is_wanted(wanted, (record.swap_ns - first.swap_ns) / NS_PER_S)
        )

    if not count:
        raise InputError(
            f"{log}: has no frame from --start {start_s:g} to --stop {stop_s:g}; write a longer"
            " span"
        )
    play = played_again(
        in_span,
        count,
        sum(1 for _ in read_attitudes(log)),
        not math.isinf(wanted.speed),
        read_recording(log),
    )
    head = read_head(log)
    names = ("gl_renderer", "gl_version", "render_path")
    if set(names) <= head.keys():
        drawn_by = DrawnBy(*(printable(head[name]) for name in names))
    else:
        drawn_by = None
    wrong_sky = WrongSky()
    for event in event_records(log):
        wrong_sky.see(event.kind, event.detail, event.host_ns, event.since_ns)
    return replace(
        play, zero_ns=first.t_ns, drawn_by=drawn_by, codes_ms=codes_ms_of(head), wrong_sky=wrong_sky
    )


def _tell_of(play: Play, notices: Notices) -> None:
    """Tell what is to be told before a replay begins; a condition of a log lasts for all of it."""
    for kind, line in play.told:
        tell = notices.begin if kind in ENDS else notices.tell
        tell(kind, line)


def _recall_conditions(wrong_sky: WrongSky, past: FrameRecord | None, notices: Notices) -> None:
    """Begin and end the conditions of the run that is replayed, as they were at the swap of its
    frame.
    """
    if past is None:
        held = {}
    else:
        held = dict(wrong_sky.at(past.swap_ns))
    for condition in notices.wrong_sky.now():
        if condition.kind not in held:
            notices.end(condition.kind, ENDS[condition.kind], "no more in the run that is replayed")
    for kind, text in held.items():
        notices.begin(kind, f"in the run that is replayed: {text}")


def _tell_other_renderer(before: DrawnBy | None, bench: Bench, notices: Notices) -> None:
    renderer = bench.renderer
    now = DrawnBy(printable(renderer.gl_renderer), printable(renderer.gl_version), renderer.path)
    if before is not None and before != now:
        share = before.other_codes(now, renderer.target.quantisation)
        line = (
            f"the run was drawn by {before}, and is now by {now}: at most {share:.2g} of a frame's"
            " lit pixels"
        )
        notices.tell("other-renderer", f"{line} may be one code off")


def _span(log: Path, wanted: Wanted, length_s: float) -> tuple[float, float]:
    if wanted.start_s is None:
        start_s = 0.0
    else:
        start_s = wanted.start_s
    if wanted.stop_s is None:
        stop_s = length_s
    else:
        stop_s = wanted.stop_s
    if not 0 <= start_s <= stop_s <= length_s + SAME_S:
        raise InputError(
            f"{log}: --start {start_s:g} --stop {stop_s:g}; write seconds between 0 and its length,"
            f" {length_s:g}"
        )
    return start_s, stop_s


def replay(
    bench: Bench, play: Play, sink: FrameSink = ignore, outlet: Outlet | None = None
) -> RunSummary:
    """Replay recorded frames: paced, where late ones are missed as on a monitor, or all of them
    as fast as possible.
    """
    outlet = outlet or Outlet()
    if outlet.faults is None and play.recording.faults:
        outlet = replace(outlet, faults=ReplayedFaults(bench, play.recording, outlet.ledger))
    faults = outlet.faults
    if isinstance(faults, RunFaults):
        faults.begin(play.zero_ns)
    loop = outlet.loop(bench, sink, play.moving)
    clock = loop.pacer.clock
    _tell_of(play, outlet.notices)
    _tell_other_renderer(play.drawn_by, bench, outlet.notices)

    def draw_slot(moment: Moment) -> Shown | None:
        number, t_ns, attitude, past = play.frame(moment.slot)
        if isinstance(faults, ReplayedFaults) and past is not None:
            faults.recall(past)
        if play.wrong_sky.any:
            _recall_conditions(play.wrong_sky, past, outlet.notices)
        shown = loop.draw(number, t_ns, attitude, moment.lit_on_grid())
        if shown is not None:
            outlet.record(bench, loop, shown, t_ns)
        return shown

    counts = PacketCounts(received=play.packet_count)
    outlet.follower(Running(loop, counts, answers=outlet.answers))
    bench.warm_up()
    begin_ns = clock.now_ns()
    with stop_on_signal(loop.stop), loop.watch:
        if play.paced:
            loop.paced(Limit(slots=play.frame_count), draw_slot)
        else:
            for slot in range(play.frame_count):
                if loop.stop.is_set():
                    break
                draw_slot(Moment(slot))
    summary = loop.tally.summary((clock.now_ns() - begin_ns) / NS_PER_S, counts, bench.renderer)
    return replaced(outlet.complete(summary, loop), stale_events=loop.gate.events)


class FrameImages:
    """Writes `frame_000000.png` and on, and `frames.csv`; without a directory it writes nothing."""

    def __init__(self, directory: Path | None, bench: Bench) -> None:
        self._directory = directory
        self._bench = bench
        self._table = Path()
        self._bits = bench.config.monitor.bits
        self._stack = ExitStack()

    def __call__(self, shown: Shown) -> None:
        """Write one frame. A blank one has no quaternion."""
        if self._directory is None:
            return
        path = self._directory / f"frame_{shown.number:06d}.png"
        write_codes_png(path, self._bench.code_values(shown.drawn.levels), self._bits)
        if shown.attitude is None:
            q = ["", "", "", ""]
        else:
            q = [repr(float(v)) for v in shown.attitude.q_icrs_to_cam]
        row = [
            shown.number,
            f"{shown.t_ns / 1e9:.9f}",
            *q,
            shown.drawn.star_count,
            len(shown.drawn.clipped_hip),
        ]
        with self._said():
            self._writer.writerow(row)

    @contextmanager
    def _said(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise cannot_write(self._table, error) from error

    def __enter__(self) -> Self:
        if self._directory is not None:
            self._table = make_directory(self._directory) / "frames.csv"
            refuse_ledger(self._table)
            with self._said():
                file = self._stack.enter_context(
                    self._table.open("w", encoding="ascii", newline="")
                )
            self._writer = csv.writer(file, lineterminator="\n")
            self._writer.writerow(COLUMNS)
        return self

    def __exit__(self, *_: object) -> None:
        with self._said():
            self._stack.close()
