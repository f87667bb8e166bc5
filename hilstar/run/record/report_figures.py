"""The figures of a run of any length, frame by frame, in memory that does not grow."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

from hilstar.notices import MAX_DETAIL_CHARACTERS
from hilstar.run.record.ledger_reader import MAX_REASON_CHARACTERS, MAX_REASONS, PacketTally
from hilstar.run.record.ledger_records import (
    PULSES,
    CountRecord,
    EventRecord,
    FrameRecord,
    PacketForm,
    ProcessRecord,
    RunRecord,
)
from hilstar.run.record.series import SAMPLES, Bins, Sample, Spans
from hilstar.running_statistics import RunningStatistics
from hilstar.units import NS_PER_MS, NS_PER_S

MEGABYTE = 1e6
WARM_UP_S = 60.0  # after this the process has allocated all the memory that it needs
KEYFRAMES = 16
MAX_EVENTS = 1000  # of which the first and as many of the last are kept
SMALL_RAD = 1e-8


class Keyframes:
    """Frames of a run that are worth a picture: evenly over it, and the first or worst of each kind."""

    def __init__(self, capacity: int = KEYFRAMES) -> None:
        self._even: list[FrameRecord] = []
        self._capacity, self._stride, self._seen = capacity, 1, 0
        self._best: dict[str, tuple[float, FrameRecord]] = {}

    def add(self, frame: FrameRecord) -> None:
        """Look at a frame."""
        if self._seen % self._stride == 0:
            if len(self._even) == self._capacity:
                self._even, self._stride = self._even[::2], 2 * self._stride
            if self._seen % self._stride == 0:
                self._even.append(frame)
        self._seen += 1
        self._keep("first stale", frame, float(frame.stale and frame.q is not None))
        self._keep("most clipped stars", frame, float(frame.clipped))
        self._keep("most stars", frame, float(frame.stars_drawn))

    def _keep(self, why: str, frame: FrameRecord, worth: float) -> None:
        if worth > self._best.get(why, (0.0,))[0]:
            self._best[why] = (worth, frame)

    def chosen(self, last: FrameRecord | None) -> list[tuple[FrameRecord, str]]:
        """The frames in order, each with what is special of it, "" for nothing."""
        found = {id(frame): (frame, "") for frame in self._even}
        for why, (_, frame) in self._best.items():
            before = found.get(id(frame), (frame, ""))[1]
            found[id(frame)] = (frame, ", ".join(part for part in (before, why) if part))
        if last is not None:
            found.setdefault(id(last), (last, ""))
        return sorted(found.values(), key=lambda each: each[0].swap_ns)


METRICS = ("interval", "late", "draw", "age", "prediction", "packet")  # ms
# The columns of the spans: METRICS, then these.
COUNTS = ("missed", "stars", "clipped", "below_step", "stale", "blank")
ACCEPTED, REFUSED = range(2)


@dataclass(slots=True)
class Figures:
    """The figures of a run's report."""

    head: dict[str, str]
    packets: PacketTally = field(default_factory=PacketTally)
    events: dict[str, int] = field(default_factory=dict)
    pulses: dict[str, int] = field(default_factory=dict)  # by PULSES; {} where none was due
    frames: int = 0
    stale: int = 0
    blank: int = 0
    late: int = 0  # stale, with an attitude
    capped: int = 0
    operator: int = 0
    hidden: int = 0
    right: int = 0  # frames that nothing of these was wrong with
    most: dict[str, int] = field(default_factory=lambda: dict.fromkeys(("clipped", "below_step", "stars_drawn"), 0))
    last: FrameRecord | None = None
    first_swap_ns: int = 0
    spreads: dict[str, RunningStatistics] = field(default_factory=lambda: {name: RunningStatistics() for name in METRICS})
    samples: Sample = field(default_factory=lambda: Sample(len(METRICS)))
    spans: Spans = field(default_factory=lambda: Spans(len(METRICS) + len(COUNTS)))
    # run_s, t_s, q, turned about x, y, z (rad)
    path: Sample = field(default_factory=lambda: Sample(9, SAMPLES // 8))
    process: Sample = field(default_factory=lambda: Sample(3, SAMPLES // 16))  # host time in s, MB, CPU time in s
    keyframes: Keyframes = field(default_factory=Keyframes)
    packet_times: Bins = field(default_factory=lambda: Bins(2))
    first_events: list[EventRecord] = field(default_factory=list)
    last_events: deque[EventRecord] = field(default_factory=lambda: deque(maxlen=MAX_EVENTS))
    first_process: ProcessRecord | None = None
    warm: ProcessRecord | None = None
    last_process: ProcessRecord | None = None
    _turned: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    _q: tuple[float, float, float, float] | None = None
    _first_t_ns: int | None = None

    @property
    def duration_s(self) -> float:
        """From the first swap to the last."""
        return 0.0 if self.last is None else (self.last.swap_ns - self.first_swap_ns) / NS_PER_S

    @property
    def memory_growth_mb(self) -> float | None:
        """How much the process's memory has grown since its first minute; None for a shorter run."""
        if self.warm is None or self.last_process is None or self.warm is self.last_process:
            return None
        return (self.last_process.resident_bytes - self.warm.resident_bytes) / MEGABYTE

    def add(self, record: RunRecord) -> None:
        """Add a record of the ledger."""
        if isinstance(record, FrameRecord):
            self._add_frame(record)
        elif isinstance(record, ProcessRecord):
            self._add_process(record)
        elif isinstance(record, EventRecord):
            kind = record.kind[:MAX_REASON_CHARACTERS]
            if kind in self.events or len(self.events) < MAX_REASONS:
                self.events[kind] = self.events.get(kind, 0) + 1
            record.detail = record.detail[:MAX_DETAIL_CHARACTERS]
            (self.last_events if len(self.first_events) == MAX_EVENTS else self.first_events).append(record)
        else:
            self.packets.add(record)
            self._add_packets(record)

    def _add_packets(self, record: PacketForm | CountRecord) -> None:
        if isinstance(record, PacketForm):
            if record.receive_ns is not None:
                self.packet_times.add(record.receive_ns, ACCEPTED if record.accepted else REFUSED)
        elif record.kind == "pulse" and record.reason in PULSES:
            self.pulses = dict.fromkeys(PULSES, 0) | self.pulses
            self.pulses[record.reason] += record.count
        elif record.kind == "packet":
            self.packet_times.add(record.host_ns, ACCEPTED if record.reason == "accepted" else REFUSED, record.count)

    def _add_frame(self, frame: FrameRecord) -> None:
        before = self.last
        if before is None:
            self.first_swap_ns = frame.swap_ns
        self.last = frame
        self.frames += 1
        self.stale += frame.stale
        self.blank += frame.q is None
        self.late += frame.stale and frame.q is not None
        self.capped += frame.capped > 0
        self.operator += bool(frame.operator)
        self.hidden += bool(frame.hidden)
        self.right += not (frame.stale or frame.q is None or frame.operator or frame.hidden)
        for name in self.most:
            self.most[name] = max(self.most[name], getattr(frame, name))
        values = _times_ms(frame, before)
        for name, value in zip(METRICS, values, strict=True):
            if not math.isnan(value):
                self.spreads[name].add(value)
        self.samples.add(values)
        run_s = (frame.swap_ns - self.first_swap_ns) / NS_PER_S
        counts = (frame.missed_before, frame.stars_drawn, frame.clipped, frame.below_step, frame.stale, frame.q is None)
        self.spans.add(run_s, (*values, *map(float, counts)))
        self.keyframes.add(frame)
        if frame.q is not None:
            if self._q is not None:
                self._turned = [a + b for a, b in zip(self._turned, _turn_rad(self._q, frame.q), strict=True)]
            self._q = frame.q
            self._first_t_ns = frame.t_ns if self._first_t_ns is None else self._first_t_ns
            self.path.add((run_s, (frame.t_ns - self._first_t_ns) / NS_PER_S, *frame.q, *self._turned))

    def _add_process(self, process: ProcessRecord) -> None:
        first = self.first_process = self.first_process or process
        run_s = (process.host_ns - first.host_ns) / NS_PER_S
        if self.warm is None and run_s >= WARM_UP_S:
            self.warm = process
        self.last_process = process
        self.process.add((process.host_ns / NS_PER_S, process.resident_bytes / MEGABYTE, process.cpu_s))


def _times_ms(frame: FrameRecord, before: FrameRecord | None) -> tuple[float, ...]:
    """The METRICS of a frame; NaN where there is none. An interval over missed frames is none."""

    def ms(value: int | None) -> float:
        return math.nan if value is None else value / NS_PER_MS

    return (
        ms(None if before is None or frame.missed_before else frame.swap_ns - before.swap_ns),
        ms(None if frame.predicted_swap_ns is None else frame.swap_ns - frame.predicted_swap_ns),
        ms(frame.swap_ns - frame.draw_ns),
        ms(frame.age_ns),
        ms(frame.prediction_ns),
        ms(None if frame.receive_ns is None else frame.swap_ns - frame.receive_ns),
    )


def _turn_rad(a: tuple[float, ...], b: tuple[float, ...]) -> tuple[float, float, float]:
    """The turn from one attitude to the next about the camera's axes: as `rotation.rate_between_rad_s`, fast for one."""
    w = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]
    x = -b[0] * a[1] + b[1] * a[0] - b[2] * a[3] + b[3] * a[2]
    y = -b[0] * a[2] + b[1] * a[3] + b[2] * a[0] - b[3] * a[1]
    z = -b[0] * a[3] - b[1] * a[2] + b[2] * a[1] + b[3] * a[0]
    sine = math.sqrt(x * x + y * y + z * z)
    scale = -2.0 * math.copysign(1.0, w) * (math.atan2(sine, abs(w)) / sine if sine > SMALL_RAD else 1.0)
    return scale * x, scale * y, scale * z
