"""The figures of a run of any length, frame by frame, in memory that does not grow."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.run.record.ledger_reader import MAX_REASON_CHARACTERS, MAX_REASONS, PacketTally
from hilstar.run.record.ledger_records import EventRecord, FrameRecord, ProcessRecord, RunRecord
from hilstar.running_statistics import RunningStatistics
from hilstar.units import NS_PER_MS, NS_PER_S

MEGABYTE = 1e6
WARM_UP_S = 60.0  # after this the process has allocated all the memory that it needs
SAMPLES = 1 << 16  # frames of which each figure is kept: all of a run of a quarter of an hour
SPANS = 4096  # in which a run is drawn along its time
SMALL_RAD = 1e-8


class Sample:
    """Every n-th row of a stream, n doubling as the stream grows."""

    def __init__(self, columns: int, capacity: int = SAMPLES) -> None:
        self._rows = np.zeros((capacity, columns))
        self._kept = 0
        self.stride = 1
        self._seen = 0

    def add(self, row: tuple[float, ...]) -> None:
        """Add a row, or skip it."""
        if self._seen % self.stride == 0:
            if self._kept == len(self._rows):
                half = len(self._rows) // 2
                self._rows[:half] = self._rows[::2]
                self._kept, self.stride = half, 2 * self.stride
            if self._seen % self.stride == 0:
                self._rows[self._kept] = row
                self._kept += 1
        self._seen += 1

    @property
    def rows(self) -> FloatArray:
        """The rows that are kept, (n, columns)."""
        return self._rows[: self._kept]


class Spans:
    """The minimum, maximum and sum of each column over equal numbers of frames: at most `capacity` spans."""

    def __init__(self, columns: int, capacity: int = SPANS) -> None:
        shape = (capacity, columns)
        self._low, self._high, self._sum = np.full(shape, np.inf), np.full(shape, -np.inf), np.zeros(shape)
        self._begin = np.zeros(capacity)
        self._used = self._in_last = 0
        self._length = 1

    def add(self, at: float, row: tuple[float, ...]) -> None:
        """Add a frame; NaN is no value."""
        if self._used == 0 or self._in_last == self._length:
            if self._used == len(self._begin):
                self._halve()
            self._begin[self._used] = at
            self._used, self._in_last = self._used + 1, 0
        k = self._used - 1
        for column, value in enumerate(row):
            if not math.isnan(value):
                self._low[k, column] = min(self._low[k, column], value)
                self._high[k, column] = max(self._high[k, column], value)
                self._sum[k, column] += value
        self._in_last += 1

    def _halve(self) -> None:
        half = self._used // 2
        self._low[:half] = np.minimum(self._low[::2], self._low[1::2])
        self._high[:half] = np.maximum(self._high[::2], self._high[1::2])
        self._sum[:half] = self._sum[::2] + self._sum[1::2]
        self._begin[:half] = self._begin[::2]
        self._low[half:], self._high[half:], self._sum[half:] = np.inf, -np.inf, 0.0
        self._used, self._in_last, self._length = half, 2 * self._length, 2 * self._length

    def column(self, number: int) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Begin, minimum, maximum and sum of each span that has any value in this column."""
        low, high, total = (table[: self._used, number] for table in (self._low, self._high, self._sum))
        some = np.isfinite(low)
        return self._begin[: self._used][some], low[some], high[some], total[some]


METRICS = ("interval", "late", "draw", "age", "prediction", "packet")  # ms
INTERVAL, AGE, MISSED, DRAWN, CLIPPED, BELOW_STEP = range(6)  # columns of the spans


@dataclass(slots=True)
class Figures:
    """The figures of a run's report."""

    head: dict[str, str]
    packets: PacketTally = field(default_factory=PacketTally)
    events: dict[str, int] = field(default_factory=dict)
    frames: int = 0
    stale: int = 0
    blank: int = 0
    capped: int = 0
    operator: int = 0
    hidden: int = 0
    most: dict[str, int] = field(default_factory=lambda: dict.fromkeys(("clipped", "below_step", "stars_drawn"), 0))
    last: FrameRecord | None = None
    first_swap_ns: int = 0
    spreads: dict[str, RunningStatistics] = field(default_factory=lambda: {name: RunningStatistics() for name in METRICS})
    samples: Sample = field(default_factory=lambda: Sample(len(METRICS)))
    spans: Spans = field(default_factory=lambda: Spans(6))
    path: Sample = field(default_factory=lambda: Sample(8, SAMPLES // 8))  # t_s, q, turned about x, y, z (rad)
    process: Sample = field(default_factory=lambda: Sample(2, SAMPLES // 8))  # run_s, MB
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
        else:
            self.packets.add(record)

    def _add_frame(self, frame: FrameRecord) -> None:
        before = self.last
        if before is None:
            self.first_swap_ns = frame.swap_ns
        self.last = frame
        self.frames += 1
        self.stale += frame.stale
        self.blank += frame.q is None
        self.capped += frame.capped > 0
        self.operator += bool(frame.operator)
        self.hidden += bool(frame.hidden)
        for name in self.most:
            self.most[name] = max(self.most[name], getattr(frame, name))
        values = _times_ms(frame, before)
        for name, value in zip(METRICS, values, strict=True):
            if not math.isnan(value):
                self.spreads[name].add(value)
        self.samples.add(values)
        run_s = (frame.swap_ns - self.first_swap_ns) / NS_PER_S
        counts = (frame.missed_before, frame.stars_drawn, frame.clipped, frame.below_step)
        self.spans.add(run_s, (values[0], values[3], *map(float, counts)))
        if frame.q is not None:
            if self._q is not None:
                self._turned = [a + b for a, b in zip(self._turned, _turn_rad(self._q, frame.q), strict=True)]
            self._q = frame.q
            self._first_t_ns = frame.t_ns if self._first_t_ns is None else self._first_t_ns
            self.path.add(((frame.t_ns - self._first_t_ns) / NS_PER_S, *frame.q, *self._turned))

    def _add_process(self, process: ProcessRecord) -> None:
        first = self.first_process = self.first_process or process
        run_s = (process.host_ns - first.host_ns) / NS_PER_S
        if self.warm is None and run_s >= WARM_UP_S:
            self.warm = process
        self.last_process = process
        self.process.add((run_s, process.resident_bytes / MEGABYTE))


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
