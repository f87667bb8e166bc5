"""Computes the figures of a run's report from its ledger, block by block, in memory that does not
grow with the run.
"""

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt
from msgspec import UNSET, UnsetType

from hilstar.basics.arrays import BoolArray, FloatArray, IntArray
from hilstar.basics.errors import InputError
from hilstar.basics.notices import MAX_DETAIL_CHARACTERS
from hilstar.basics.running_statistics import Percentiles, RunningStatistics
from hilstar.basics.units import NS_PER_MS, NS_PER_S
from hilstar.basics.wrong_sky import WrongSky, WrongSkyTotal
from hilstar.server.record.answer_figures import AnswerReport, AnswerTally, answer_rows
from hilstar.server.record.ledger_records import (
    MAX_REASON_CHARACTERS,
    MAX_REASONS,
    NO_FRAMES,
    PULSES,
    AnswerRecord,
    CountRecord,
    EventRecord,
    FaultRecord,
    FrameRecord,
    PacketForm,
    PacketTally,
    ProcessRecord,
    RunRecord,
    attitudes_of,
    config_of,
    read_head,
    run_blocks,
)

SAMPLES = 1 << 16  # frames with stored times: at 60 Hz all of a run of a quarter of an hour
SPANS = 8192  # largest number of points of a chart along the run
BLOCK = 4096  # records that are added at once
MEGABYTE = 1e6
WARM_UP_S = 60.0  # after this the process has allocated all the memory that it needs
KEYFRAMES = 16  # drawn in the report, evenly over the run
MAX_EVENTS = 1000  # so many of the first events and of the last are stored
SMALL_RAD = 1e-8  # up to this angle, angle / sine is 1 to the last bit
# A condition is noticed after it began: it may change the count of this many newest frames, over a
# minute at 120 Hz.
RECOUNTED = 8192
# Times of a frame, ms, and the keys that a report has them under.
METRICS = {
    "interval": "interval_ms",
    "late": "swap_late_ms",
    "draw": "draw_to_swap_ms",
    "age": "attitude_age_ms",
    "prediction": "prediction_ms",
    "packet": "packet_to_swap_ms",
}
HEAD = (
    "bench_sha256",
    "calibration",
    "calibration_sha256",
    "certificate",
    "gl_renderer",
    "gl_version",
    "render_path",
)
FAULTS = ("stale_frames", "blank_frames", "operator_frames", "hidden_frames", "wrong_frames")
COUNTED = ("frames", "right_frames", "capped_frames", *FAULTS)
# The columns of the spans: METRICS, then these.
COUNTS = ("missed", "stars", "clipped", "below_step", "stale", "blank")
ACCEPTED, REFUSED = range(2)
# The whole numbers and the texts of a frame's record that are counted.
NUMBERS = ("stale", "capped", "missed_before", "stars_drawn", "clipped", "below_step")
WORDS = ("operator", "hidden")
# The figures of a RunFigures that a report has under the same name.
SAME_NAME = ("duration_s", "events", "pulses", "memory_growth_mb")


class ThinnedRows:
    """Stores every n-th row of a stream, at most `capacity` rows: n (`stride`) doubles whenever
    the storage is full.
    """

    def __init__(self, columns: int, capacity: int = SAMPLES, kind: type = float) -> None:
        self._rows: npt.NDArray[Any] = np.zeros((capacity, columns), dtype=kind)
        self._kept = 0
        self._seen = 0
        self.stride = 1

    def add(self, rows: npt.NDArray[Any]) -> None:
        """Take the next rows (n, columns) of the stream, and store every n-th."""
        while len(rows):
            first = -self._seen % self.stride
            free = len(self._rows) - self._kept
            fitting = rows[first :: self.stride][:free]
            end = self._kept + len(fitting)
            self._rows[self._kept : end] = fitting
            self._kept = end
            taken = min(len(rows), first + len(fitting) * self.stride)
            self._seen = self._seen + taken
            rows = rows[taken:]
            if len(rows) and self._kept == len(self._rows):
                half = len(self._rows) // 2
                self._rows[:half] = self._rows[::2]
                self._kept = half
                self.stride = 2 * self.stride

    @property
    def rows(self) -> npt.NDArray[Any]:
        """The stored rows, (n, columns)."""
        return self._rows[: self._kept]


class SpanColumn(NamedTuple):
    """One column of a SpanTable: minimum and maximum of each span, NaN where it has no value, and
    the sum, (n,) each.
    """

    low: FloatArray
    high: FloatArray
    total: FloatArray


class SpanTable:
    """The minimum, maximum and sum of each column over spans of equal numbers of frames (`length`),
    at most `capacity` spans: the length doubles whenever all are used.
    """

    def __init__(self, columns: int, capacity: int = SPANS) -> None:
        shape = (capacity, columns)
        self._low = np.full(shape, np.inf)
        self._high = np.full(shape, -np.inf)
        self._sum = np.zeros(shape)
        self._begin = np.zeros(capacity)
        self._used = self._in_last = 0
        self.length = 1

    def add(self, rows: FloatArray) -> None:
        """Add frames, rows (n, 1 + columns) of the frame's time and its values; NaN is no value."""
        while len(rows):
            if self._used == 0 or self._in_last == self.length:
                if self._used == len(self._begin):
                    self._halve()
                    continue
                self._begin[self._used] = rows[0, 0]
                self._used = self._used + 1
                self._in_last = 0
            # Whole spans are added at once, for speed; a span that has begun is filled first.
            spans = 1
            if not self._in_last:
                free = len(self._begin) - self._used + 1
                whole = min(len(rows) // self.length, free)
                spans = max(whole, 1)
            count = spans * self.length - self._in_last
            self._add(rows[:count], spans)
            rows = rows[count:]

    def _add(self, rows: FloatArray, spans: int) -> None:
        """Add rows to the last span; if it is empty, they fill it and more: `spans` in all."""
        columns = rows.shape[1] - 1
        values = rows[:, 1:].reshape(spans, -1, columns)
        first = self._used - 1
        end = first + spans
        span_frames = max(len(rows) // spans, 1)
        begin = rows[::span_frames, 0]
        self._begin[self._used : end] = begin[1:spans]
        low = np.fmin.reduce(values, axis=1)
        high = np.fmax.reduce(values, axis=1)
        self._low[first:end] = np.fmin(self._low[first:end], low)
        self._high[first:end] = np.fmax(self._high[first:end], high)
        self._sum[first:end] += np.nansum(values, axis=1)
        self._used = end
        self._in_last += values.shape[1]

    def _halve(self) -> None:
        """Join the spans in pairs; the last one is full then."""
        half = self._used // 2
        self._low[:half] = np.minimum(self._low[::2], self._low[1::2])
        self._high[:half] = np.maximum(self._high[::2], self._high[1::2])
        self._sum[:half] = self._sum[::2] + self._sum[1::2]
        self._begin[:half] = self._begin[::2]
        self._low[half:] = np.inf
        self._high[half:] = -np.inf
        self._sum[half:] = 0.0
        self._used = half
        self.length = 2 * self.length
        self._in_last = self.length

    @property
    def begin(self) -> FloatArray:
        """The time of each span's first frame, (n,)."""
        return self._begin[: self._used]

    def column(self, number: int) -> SpanColumn:
        """Minimum, maximum and sum of a column, by its number, over all spans."""
        low = self._low[: self._used, number]
        high = self._high[: self._used, number]
        total = self._sum[: self._used, number]
        has_value = np.isfinite(low)
        low = np.where(has_value, low, np.nan)
        high = np.where(has_value, high, np.nan)
        return SpanColumn(low, high, total)


class TimeBins:
    """Counts events of several kinds in bins of time, at most `capacity` bins: their width doubles
    whenever a run outgrows them.
    """

    def __init__(self, kinds: int, capacity: int = SPANS) -> None:
        self._counts = np.zeros((capacity, kinds), dtype=np.int64)
        self._first_ns: int | None = None
        self._used = 0
        self.width_ns = NS_PER_S

    def add(self, at_ns: npt.NDArray[np.int64], kinds: IntArray, number: int = 1) -> None:
        """Count `number` events of `kinds` (n,), column numbers, at each of the host times (n,),
        ns. A time before the first one counts in the first bin.
        """
        if not len(at_ns):
            return
        if self._first_ns is None:
            self._first_ns = int(at_ns[0])
        since_ns = np.maximum(at_ns - self._first_ns, 0)
        latest_ns = int(since_ns.max())
        while latest_ns >= len(self._counts) * self.width_ns:
            self._halve()
        np.add.at(self._counts, (since_ns // self.width_ns, kinds), number)
        self._used = max(self._used, latest_ns // self.width_ns + 1)

    def _halve(self) -> None:
        half = len(self._counts) // 2
        self._counts[:half] = self._counts[::2] + self._counts[1::2]
        self._counts[half:] = 0
        self._used = (self._used + 1) // 2
        self.width_ns = 2 * self.width_ns

    def rates_hz(self, zero_ns: int) -> tuple[FloatArray, FloatArray]:
        """The beginning of each bin, s after the host time `zero_ns`, (n,), and the rate of each
        kind in it, 1/s, (n, kinds).
        """
        if self._first_ns is None:
            return np.zeros(0), np.zeros((0, self._counts.shape[1]))
        bins = np.arange(self._used, dtype=np.float64)
        begin_s = (self._first_ns - zero_ns) / NS_PER_S + bins * (self.width_ns / NS_PER_S)
        counts = self._counts[: self._used].astype(np.float64)
        return begin_s, counts * (NS_PER_S / self.width_ns)


class Keyframes:
    """Chooses the frames that a report draws: KEYFRAMES evenly over the run, and the first or the
    worst frame of each kind.
    """

    def __init__(self) -> None:
        self._even = ThinnedRows(1, KEYFRAMES, object)
        self._best: dict[str, tuple[int, FrameRecord]] = {}

    def add(self, frames: list[FrameRecord], worths: dict[str, IntArray]) -> None:
        """Add frames (n). `worths` has, by the reason to draw a frame, a number (n,) for each: the
        first frame with the largest number over 0 is drawn.
        """
        rows = np.empty((len(frames), 1), dtype=object)
        rows[:, 0] = frames
        self._even.add(rows)
        for why, worth in worths.items():
            place = int(worth.argmax())
            highest, _ = self._best.get(why, (0, None))
            if worth[place] > highest:
                self._best[why] = int(worth[place]), frames[place]

    def chosen(self, last: FrameRecord | None) -> list[tuple[FrameRecord, str]]:
        """The chosen frames and the `last` one in order of time, each with the reasons to draw it,
        "" for none.
        """
        frames = list(self._even.rows[:, 0])
        # By the object's id: a frame may be chosen for several reasons.
        reasons: dict[int, list[str]] = {}
        for why, (_, frame) in self._best.items():
            frames.append(frame)
            reasons.setdefault(id(frame), []).append(why)
        if last is not None:
            frames.append(last)
        by_identity = {id(frame): frame for frame in frames}
        in_order = sorted(by_identity.values(), key=attrgetter("swap_ns"))
        return [(frame, ", ".join(reasons.get(id(frame), []))) for frame in in_order]


@dataclass(slots=True)
class FrameMarks:
    """The newest frames (n,): host time of the swap, ns; whether the frame is right apart from a
    wrong sky (`plain`); and whether it falls within a wrong sky (`wrong`).
    """

    swap_ns: npt.NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    plain: BoolArray = field(default_factory=lambda: np.zeros(0, dtype=bool))
    wrong: BoolArray = field(default_factory=lambda: np.zeros(0, dtype=bool))

    def add(self, swap_ns: npt.NDArray[np.int64], plain: BoolArray, wrong: BoolArray) -> None:
        """Add frames (n,), and forget the oldest beyond RECOUNTED."""
        self.swap_ns = np.concatenate([self.swap_ns, swap_ns])[-RECOUNTED:]
        self.plain = np.concatenate([self.plain, plain])[-RECOUNTED:]
        self.wrong = np.concatenate([self.wrong, wrong])[-RECOUNTED:]


def _covered(wrong_sky: WrongSky, swap_ns: npt.NDArray[np.int64]) -> BoolArray:
    """Whether each host time (n,), ns, falls within a span of a wrong sky."""
    covered = np.zeros(len(swap_ns), dtype=bool)
    if wrong_sky.any:
        for begin_ns, end_ns in wrong_sky.spans_ns():
            covered |= (swap_ns >= begin_ns) & (swap_ns < end_ns)
    return covered


@dataclass(slots=True)
class RunFigures:
    """Adds up the records of a run, from which `summarise` makes the figures of its report.

    `head` is the ledger's head.
    """

    head: dict[str, str]
    packets: PacketTally = field(default_factory=PacketTally)
    events: dict[str, int] = field(default_factory=dict)
    pulses: dict[str, int] = field(default_factory=dict)  # by PULSES; {} where none was due
    # Numbers of all "frames", of frames with each of FAULTS, of "right_frames" with none of these,
    # and of "late" frames: stale, but with an attitude.
    counted: Counter[str] = field(default_factory=Counter)
    most: dict[str, int] = field(
        default_factory=lambda: dict.fromkeys(("clipped", "below_step", "stars_drawn"), 0)
    )
    last: FrameRecord | None = None
    first_swap_ns: int = 0
    spreads: dict[str, RunningStatistics] = field(
        default_factory=lambda: {name: RunningStatistics() for name in METRICS}
    )
    samples: ThinnedRows = field(default_factory=lambda: ThinnedRows(len(METRICS)))
    spans: SpanTable = field(default_factory=lambda: SpanTable(len(METRICS) + len(COUNTS)))
    # run_s, t_s, q, turned about x, y, z (rad)
    path: ThinnedRows = field(default_factory=lambda: ThinnedRows(9, SAMPLES // 8))
    # host time in s, MB, CPU time in s
    process: ThinnedRows = field(default_factory=lambda: ThinnedRows(3, SAMPLES // 16))
    keyframes: Keyframes = field(default_factory=Keyframes)
    packet_times: TimeBins = field(default_factory=lambda: TimeBins(2))
    answers: AnswerTally = field(default_factory=AnswerTally)
    faults: list[FaultRecord] = field(default_factory=list)
    # host time in s, x, y, z in arcsec
    residuals: ThinnedRows = field(default_factory=lambda: ThinnedRows(4, SAMPLES // 4))
    first_events: list[EventRecord] = field(default_factory=list)
    last_events: deque[EventRecord] = field(default_factory=lambda: deque(maxlen=MAX_EVENTS))
    wrong_sky: WrongSky = field(default_factory=WrongSky)
    lost: int = 0  # packets
    first_process: ProcessRecord | None = None
    warm: ProcessRecord | None = None
    last_process: ProcessRecord | None = None
    _newest: FrameMarks = field(default_factory=FrameMarks)
    _turned: FloatArray = field(default_factory=lambda: np.zeros(3))
    _q: FloatArray | None = None
    _first_t_ns: int | None = None

    @property
    def duration_s(self) -> float:
        """The time from the first swap to the last, s."""
        if self.last is None:
            return 0.0
        return (self.last.swap_ns - self.first_swap_ns) / NS_PER_S

    @property
    def memory_growth_mb(self) -> float | None:
        """The growth of the process's memory after its first minute, MB; None for a shorter run."""
        if self.warm is None or self.last_process is None or self.warm is self.last_process:
            return None
        return (self.last_process.resident_bytes - self.warm.resident_bytes) / MEGABYTE

    def add(self, *records: RunRecord) -> None:
        """Add records of the ledger, in their order. Many in one call take a third of the time."""
        frames = [record for record in records if type(record) is FrameRecord]
        packets = [record for record in records if type(record) is PacketForm]
        others = [record for record in records if type(record) not in {FrameRecord, PacketForm}]
        # The frames of a replayed run say when its faults are on: answers, faults and frames are
        # then added in the ledger's order.
        in_order = self.answers.replayed or FaultRecord in set(map(type, others))
        for record in records if in_order else others:
            if isinstance(record, FrameRecord):
                self.answers.frame(record)
            elif not isinstance(record, PacketForm):
                self._add_one(record)
        accepted = _whole(packets, "accepted")[0] > 0
        # If all packets are accepted, only their number matters: one call counts them, for speed.
        all_at_once = bool(accepted.all()) and "accepted" in self.packets.counts
        if all_at_once:
            self.packets.count("accepted", len(packets))
        for record in others if all_at_once else records:
            self.packets.add(record)
        times_ns, known = _whole(packets, "receive_ns")
        self.packet_times.add(times_ns[known], np.where(accepted, ACCEPTED, REFUSED)[known])
        self._recount()
        if frames:
            self._add_frames(frames)

    def _recount(self) -> None:
        """Correct the counts of frames that were added before a wrong sky was noticed: its event
        says since when it holds.
        """
        if not self.wrong_sky.any:
            return
        newest = self._newest
        is_covered = _covered(self.wrong_sky, newest.swap_ns) & ~newest.wrong
        newest.wrong |= is_covered
        self.counted["wrong_frames"] += int(is_covered.sum())
        self.counted["right_frames"] -= int((is_covered & newest.plain).sum())

    def _add_one(
        self, record: ProcessRecord | CountRecord | EventRecord | FaultRecord | AnswerRecord
    ) -> None:
        if isinstance(record, ProcessRecord):
            first = self.first_process = self.first_process or record
            if self.warm is None and (record.host_ns - first.host_ns) / NS_PER_S >= WARM_UP_S:
                self.warm = record
            self.last_process = record
            resident_mb = record.resident_bytes / MEGABYTE
            row = (record.host_ns / NS_PER_S, resident_mb, record.cpu_s)
            self.process.add(np.array([row]))
        elif isinstance(record, EventRecord):
            self._add_event(record)
        elif isinstance(record, FaultRecord):
            self.faults.append(record)
            self.answers.fault(record)
        elif isinstance(record, AnswerRecord):
            self.answers.answer(record)
            if record.verdict == "right" and record.residual_arcsec is not None:
                middle_s = record.middle_ns / NS_PER_S
                self.residuals.add(np.array([(middle_s, *record.residual_arcsec)]))
        elif record.kind == "pulse" and record.reason in PULSES:
            self.pulses = dict.fromkeys(PULSES, 0) | self.pulses
            self.pulses[record.reason] += record.count
        elif record.kind == "lost":
            self.lost += record.count
        elif record.kind == "packet":
            kind = ACCEPTED if record.reason == "accepted" else REFUSED
            self.packet_times.add(np.array([record.host_ns]), np.array([kind]), record.count)

    def _add_event(self, record: EventRecord) -> None:
        kind = record.kind[:MAX_REASON_CHARACTERS]
        if kind in self.events or len(self.events) < MAX_REASONS:
            self.events[kind] = self.events.get(kind, 0) + 1
        record.detail = record.detail[:MAX_DETAIL_CHARACTERS]
        self.wrong_sky.see(kind, record.detail, record.host_ns, record.since_ns)
        if len(self.first_events) < MAX_EVENTS:
            self.first_events.append(record)
        else:
            self.last_events.append(record)

    def _add_frames(self, frames: list[FrameRecord]) -> None:
        before = self.last
        self.last = frames[-1]
        if before is None:
            self.first_swap_ns = frames[0].swap_ns
        self.counted["frames"] += len(frames)
        stale, capped, missed, stars, clipped, below = (_whole(frames, name)[0] for name in NUMBERS)
        blank = np.array([frame.q is None for frame in frames])
        operator, hidden = (_has_text(frames, name) for name in WORDS)
        swap_ns, _ = _whole(frames, "swap_ns")
        wrong = _covered(self.wrong_sky, swap_ns)
        is_stale = stale > 0
        late = is_stale & ~blank
        plain = ~(is_stale | blank | operator | hidden)
        self._newest.add(swap_ns, plain, wrong)
        masks = dict(zip(FAULTS, (is_stale, blank, operator, hidden, wrong), strict=True))
        masks["right_frames"] = plain & ~wrong
        masks["late"] = late
        masks["capped_frames"] = capped > 0
        for name, mask in masks.items():
            self.counted[name] += int(mask.sum())
        for name, number in (("clipped", clipped), ("below_step", below), ("stars_drawn", stars)):
            self.most[name] = max(self.most[name], int(number.max()))
        times = _times_ms(frames, swap_ns, before, missed > 0)
        for name, values in zip(METRICS, times.T, strict=True):
            self.spreads[name].add_all(values[~np.isnan(values)])
        self.samples.add(times)
        run_s = (swap_ns - self.first_swap_ns) / NS_PER_S
        self.spans.add(np.column_stack([run_s, times, missed, stars, clipped, below, stale, blank]))
        worths = {"first stale": late, "most clipped stars": clipped, "most stars": stars}
        self.keyframes.add(frames, worths)
        if not blank.all():
            self._add_path(frames, np.flatnonzero(~blank), run_s)

    def _add_path(
        self, frames: list[FrameRecord], shown_rows: npt.NDArray[np.intp], run_s: FloatArray
    ) -> None:
        q = attitudes_of(frames)
        all_t_ns, _ = _whole(frames, "t_ns")
        t_ns = all_t_ns[shown_rows]
        if self._first_t_ns is None:
            self._first_t_ns = int(t_ns[0])
        last_q = q[0] if self._q is None else self._q
        q_before = np.vstack([last_q, q[:-1]])
        steps_rad = _turns_rad(q_before, q)
        turned = np.cumsum(np.vstack([self._turned, steps_rad]), axis=0)
        self._q = q[-1]
        self._turned = turned[-1]
        t_s = (t_ns - self._first_t_ns) / NS_PER_S
        self.path.add(np.column_stack([run_s[shown_rows], t_s, q, turned[1:]]))


def _times_ms(
    frames: list[FrameRecord],
    swap_ns: npt.NDArray[np.int64],
    before: FrameRecord | None,
    after_missed: BoolArray,
) -> FloatArray:
    """The METRICS of frames, ms, (n, 6); NaN where a frame has none. `before` is the frame before
    them. The interval after missed frames (`after_missed`) is NaN.
    """
    swap_before_ns = swap_ns[0] if before is None else before.swap_ns
    intervals_ns = np.diff(swap_ns, prepend=swap_before_ns).astype(np.float64)
    intervals_ns[after_missed] = np.nan
    if before is None:
        intervals_ns[0] = np.nan
    times_ns = [intervals_ns]
    for name in ("predicted_swap_ns", "draw_ns", "age_ns", "prediction_ns", "receive_ns"):
        ns, known = _whole(frames, name)
        if name not in {"age_ns", "prediction_ns"}:
            ns = swap_ns - ns
        times_ns.append(np.where(known, ns, np.nan))
    return np.column_stack(times_ns) / NS_PER_MS


def _has_text(frames: Sequence[FrameRecord], name: str) -> BoolArray:
    """Whether the field `name` of each frame has a text, (n,)."""
    return np.array([getattr(frame, name) != "" for frame in frames])


def _whole(records: Sequence[RunRecord], name: str) -> tuple[npt.NDArray[np.int64], BoolArray]:
    """The whole number in the field `name` of each record, 0 for None, and whether it is not None,
    (n,) each.
    """
    count = len(records)
    try:
        numbers = np.fromiter(map(attrgetter(name), records), np.int64, count)
    except TypeError:  # the number of some record is None
        values = [getattr(record, name) for record in records]
        known = np.array([value is not None for value in values])
        return np.array([value or 0 for value in values], dtype=np.int64), known
    return numbers, np.ones(count, dtype=bool)


def _turns_rad(a: FloatArray, b: FloatArray) -> FloatArray:
    """The rotation vectors (n, 3), rad, about the camera's axes from attitudes `a` (n, 4) to `b`
    (n, 4), unit q_icrs_to_cam.
    """
    (aw, ax, ay, az), (bw, bx, by, bz) = a.T, b.T
    w = aw * bw + ax * bx + ay * by + az * bz
    x = -bw * ax + bx * aw - by * az + bz * ay
    y = -bw * ay + bx * az + by * aw - bz * ax
    z = -bw * az - bx * ay + by * ax + bz * aw
    sine = np.sqrt(x * x + y * y + z * z)
    small = sine <= SMALL_RAD
    half_rad = np.arctan2(sine, np.abs(w))
    angle_over_sine = np.where(small, 1.0, half_rad / np.where(small, 1.0, sine))
    sign = np.copysign(1.0, w)
    scale = -2.0 * sign * angle_over_sine
    return np.asarray(scale[:, None] * np.stack([x, y, z], axis=1))


def figures_of(path: Path) -> RunFigures:
    """Read a ledger and add up its records. Raises InputError for a file that is no ledger, has no
    frame, or is damaged.
    """
    figures = RunFigures(read_head(path))
    figures.answers = AnswerTally(_begun_ns(figures.head))
    for block in run_blocks(path, BLOCK):
        figures.add(*block)
    if figures.last is None:
        raise InputError(f"{path}: {NO_FRAMES}")
    return figures


def _begun_ns(head: dict[str, str]) -> int:
    text = head.get("monotonic_ns", "")
    return int(text) if text.isdecimal() else 0


class RunReport(msgspec.Struct, frozen=True, kw_only=True):
    """The figures of a run, the JSON object of `hilstar report`. Percentiles of times are in ms.

    Figures without a value are None. `clipped`, `below_step` and `stars_drawn` are the largest
    numbers of stars in any frame.
    """

    frames: int
    duration_s: float
    missed_frames: int
    stale_frames: int
    blank_frames: int
    operator_frames: int
    hidden_frames: int
    capped_frames: int
    timestamp_source: str
    refresh_hz: float | None
    pacing_jitter_ms: float | None
    interval_ms: Percentiles
    swap_late_ms: Percentiles
    draw_to_swap_ms: Percentiles
    attitude_age_ms: Percentiles
    attitude_age_frames: Percentiles | None
    prediction_ms: Percentiles
    packet_to_swap_ms: Percentiles
    packets: dict[str, int]
    events: dict[str, int]
    pulses: dict[str, int]
    # Frames on the screen with a fresh attitude and the right sky, unchanged by an operator.
    right_frames: int = 0
    wrong_frames: int = 0
    wrong_sky: WrongSkyTotal = WrongSkyTotal()
    lost_packets: int = 0
    clipped: int
    below_step: int
    stars_drawn: int
    memory_growth_mb: float | None
    bench_sha256: str | None
    calibration: str | None
    calibration_sha256: str | None
    certificate: str | None
    gl_renderer: str | None
    gl_version: str | None
    render_path: str | None
    answers: AnswerReport | UnsetType = UNSET


def summarise(run: RunFigures) -> RunReport:
    """The figures of a run's report, from its added records."""
    figures: dict[str, Any] = dict(run.most)
    for name, key in METRICS.items():
        figures[key] = run.spreads[name].percentiles()
    for name in COUNTED:
        figures[name] = run.counted[name]
    for name in HEAD:
        figures[name] = run.head.get(name)
    for name in SAME_NAME:
        figures[name] = getattr(run, name)
    config = config_of(run.head)
    refresh_hz = None
    age_frames = None
    if config is not None:
        refresh_hz = config.monitor.refresh_hz
        age_frames = figures["attitude_age_ms"].times(refresh_hz / 1e3)
    missed = 0
    source = ""
    last_swap_ns = run.first_swap_ns
    if run.last is not None:
        missed = run.last.missed
        source = run.last.timestamp_source
        last_swap_ns = run.last.swap_ns
    return RunReport(
        **figures,
        missed_frames=missed,
        timestamp_source=source,
        refresh_hz=refresh_hz,
        pacing_jitter_ms=run.spreads["interval"].deviation,
        attitude_age_frames=age_frames,
        packets=run.packets.counts,
        lost_packets=run.lost,
        wrong_sky=run.wrong_sky.total(run.first_swap_ns, last_swap_ns),
        answers=run.answers.report(run.first_swap_ns) or UNSET,
    )


def table_rows(report: RunReport) -> list[tuple[str, str]]:
    """The figures of a report as rows of text, (name, value)."""
    rows = [*_frame_rows(report).items(), *_time_rows(report).items()]
    for condition in report.wrong_sky.conditions:
        rows.append((condition.kind, f"{condition.seconds:.1f} s: {condition.text}"))
    rows.extend(_event_rows(report).items())
    rows.extend(answer_rows(report.answers or None))
    rows.extend(_origin_rows(report).items())
    return rows


def _frame_rows(report: RunReport) -> dict[str, str]:
    frames = f"{report.frames} in {report.duration_s:.1f} s, {report.missed_frames} missed"
    operator = f"{report.operator_frames} by an operator's keys"
    rows = {}
    rows["frames"] = f"{frames}, {report.stale_frames} stale, {report.blank_frames} blank"
    rows["not the plain sky"] = f"{operator}, {report.hidden_frames} hidden"
    rows["coarser paths"] = f"{report.capped_frames} frames, because the turn was too fast"
    return rows


def _time_rows(report: RunReport) -> dict[str, str]:
    refresh = _number(report.refresh_hz, "Hz")
    jitter = _number(report.pacing_jitter_ms, "ms")
    age = _percentiles(report.attitude_age_ms)
    age_frames = _percentiles(report.attitude_age_frames, "frames")
    rows = {}
    rows["time stamps"] = f"{report.timestamp_source}; the bench file's refresh rate is {refresh}"
    rows["pacing jitter"] = f"{jitter} (standard deviation of the interval between swaps)"
    rows["interval"] = _percentiles(report.interval_ms)
    rows["swap later than predicted"] = _percentiles(report.swap_late_ms)
    rows["start of drawing to swap"] = _percentiles(report.draw_to_swap_ms)
    rows["age of the attitude at light"] = f"{age} = {age_frames}"
    rows["predicted past the last packet"] = _percentiles(report.prediction_ms)
    rows["packet to swap"] = _percentiles(report.packet_to_swap_ms)
    return rows


def _event_rows(report: RunReport) -> dict[str, str]:
    accepted = report.packets.get("accepted", 0)
    refused = sum(report.packets.values()) - accepted
    events = [f"{kind} {count}" for kind, count in report.events.items()]
    pulses = "none"
    if report.pulses:
        pulses = f"{report.pulses['sent']} at their frames, {report.pulses['skipped']} skipped"
        lost = report.pulses["lost"]
        if lost:
            pulses += f", losses of the line: {lost}"
    stars = f"at most {report.stars_drawn} drawn, {report.clipped} clipped"
    rows = {}
    rows["packets"] = f"{accepted} accepted, {refused} refused, {report.lost_packets} lost"
    rows["events"] = ", ".join(events) or "none"
    rows["pulses"] = pulses
    rows["stars"] = f"{stars}, {report.below_step} too faint"
    return rows


def _origin_rows(report: RunReport) -> dict[str, str]:
    growth = _number(report.memory_growth_mb, "MB more at the end")
    opengl = report.gl_version or "-"
    levels = report.render_path or "-"
    rows = {}
    rows["memory after the first minute"] = growth
    rows["bench file"] = f"SHA-256 {report.bench_sha256}"
    rows["calibration"] = f"{report.calibration}, SHA-256 {report.calibration_sha256}"
    if report.certificate:
        rows["certificate"] = report.certificate
    rows["renderer"] = f"{report.gl_renderer}, OpenGL {opengl}; levels by {levels}"
    return rows


def _percentiles(figure: Percentiles | None, unit: str = "ms") -> str:
    values: tuple[float | None, ...] = (None, None, None)
    if figure is not None:
        values = (figure.p50, figure.p99, figure.max)
    numbers = ["-" if value is None else f"{value:.2f}" for value in values]
    return f"{' / '.join(numbers)} {unit} (p50 / p99 / max)"


def _number(value: float | None, unit: str) -> str:
    if value is None:
        return "-"
    return f"{value:.2f} {unit}"
