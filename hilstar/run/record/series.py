"""What a run of any length leaves along its time, in memory that does not grow: samples, spans with extremes, and counts."""

from __future__ import annotations

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.units import NS_PER_S

SAMPLES = 1 << 16  # frames of which each figure is kept: all of a run of a quarter of an hour
SPANS = 8192  # in which a run is drawn along its time
BLOCK = 1024  # frames that are summed up at once


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
        self._waiting: list[tuple[float, ...]] = []
        self._used = self._in_last = 0
        self.length = 1

    def add(self, at: float, row: tuple[float, ...]) -> None:
        """Add a frame; NaN is no value."""
        self._waiting.append((at, *row))
        if len(self._waiting) == BLOCK:
            self._take()

    def _take(self) -> None:
        """Sum up the frames that wait."""
        rows, self._waiting = np.array(self._waiting).reshape(-1, 1 + self._low.shape[1]), []
        while len(rows):
            if self._used == 0 or self._in_last == self.length:
                if self._used == len(self._begin):
                    self._halve()
                    continue
                self._begin[self._used] = rows[0, 0]
                self._used, self._in_last = self._used + 1, 0
            whole = 0 if self._in_last else min(len(rows) // self.length, len(self._begin) - self._used + 1)
            count = max(whole, 1) * self.length - self._in_last
            self._add(rows[:count], max(whole, 1))
            rows = rows[count:]

    def _add(self, rows: FloatArray, spans: int) -> None:
        """Frames of the last span, or of so many whole ones from it on."""
        values = rows[:, 1:].reshape(spans, -1, rows.shape[1] - 1)
        place = slice(self._used - 1, self._used - 1 + spans)
        self._begin[self._used : place.stop] = rows[:: max(len(rows) // spans, 1), 0][1:spans]
        self._low[place] = np.fmin(self._low[place], np.fmin.reduce(values, axis=1))
        self._high[place] = np.fmax(self._high[place], np.fmax.reduce(values, axis=1))
        self._sum[place] += np.nansum(values, axis=1)
        self._used, self._in_last = place.stop, self._in_last + values.shape[1]

    def _halve(self) -> None:
        half = self._used // 2
        self._low[:half] = np.minimum(self._low[::2], self._low[1::2])
        self._high[:half] = np.maximum(self._high[::2], self._high[1::2])
        self._sum[:half] = self._sum[::2] + self._sum[1::2]
        self._begin[:half] = self._begin[::2]
        self._low[half:], self._high[half:], self._sum[half:] = np.inf, -np.inf, 0.0
        self._used, self._in_last, self.length = half, 2 * self.length, 2 * self.length

    @property
    def begin(self) -> FloatArray:
        """When each span begins, (n,)."""
        self._take()
        return self._begin[: self._used]

    def column(self, number: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Minimum and maximum, NaN where a span has no value, and the sum of a column, each (n,)."""
        self._take()
        low, high, total = (table[: self._used, number] for table in (self._low, self._high, self._sum))
        some = np.isfinite(low)
        return np.where(some, low, np.nan), np.where(some, high, np.nan), total


class Bins:
    """Counts of some kinds over time, in bins of a width that doubles as the run grows."""

    def __init__(self, kinds: int, capacity: int = SPANS) -> None:
        self._counts = np.zeros((capacity, kinds), dtype=np.int64)
        self._first_ns: int | None = None
        self._used = 0
        self.width_ns = NS_PER_S

    def add(self, at_ns: int, kind: int, number: int = 1) -> None:
        """Count what came at a host time; before the first it counts with the first."""
        if self._first_ns is None:
            self._first_ns = at_ns
        while (place := max(at_ns - self._first_ns, 0) // self.width_ns) >= len(self._counts):
            half = len(self._counts) // 2
            self._counts[:half] = self._counts[::2] + self._counts[1::2]
            self._counts[half:] = 0
            self._used, self.width_ns = (self._used + 1) // 2, 2 * self.width_ns
        self._counts[place, kind] += number
        self._used = max(self._used, place + 1)

    def rates_hz(self, zero_ns: int) -> tuple[FloatArray, FloatArray]:
        """When each bin begins, s after a host time, (n,), and how many of each kind came in it, per second, (n, kinds)."""
        if self._first_ns is None:
            return np.zeros(0), np.zeros((0, self._counts.shape[1]))
        begin_s = (self._first_ns - zero_ns) / NS_PER_S + np.arange(self._used, dtype=np.float64) * (self.width_ns / NS_PER_S)
        return begin_s, self._counts[: self._used].astype(np.float64) * (NS_PER_S / self.width_ns)
