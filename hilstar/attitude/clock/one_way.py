"""The clock offset of a stream that answers nothing, from its arrivals alone; no I/O.

A message is never early, so the line under all (arrival - t_ns) is nearest the true offset (Moon, Skelly and Towsley 1999).
It is too large by the minimum transport delay, which a one-way stream cannot measure. A message that waited unread gives
only an upper bound: a guess, until one arrives that did not wait.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.attitude.clock.offset_line import MIN_DRIFT_SPAN_NS, WINDOW_NS, OffsetLine, Slots, plausible_drift

RECENT_SLOTS = 4  # the last second: the uncertainty comes from it, and is infinite before it is over
NEWEST = 8


class OneWayFilter:
    """The line under the offsets of a one-way stream."""

    def __init__(self) -> None:
        self._slots = Slots()
        self._newest_above_ns: deque[float] = deque(maxlen=NEWEST)
        self.line: OffsetLine | None = None

    @property
    def all_above_ns(self) -> float:
        """The smallest excess of the newest messages over the line."""
        return min(self._newest_above_ns, default=0.0)

    @property
    def guessed(self) -> bool:
        """True while every message so far had waited unread."""
        return not self._slots

    def guess(self, host_ns: int, offset_ns: int) -> None:
        """Take a message that waited unread: an upper bound, which the first one that did not wait replaces."""
        if self.guessed and (self.line is None or offset_ns < self.line.at(host_ns)):
            self.line = OffsetLine(host_ns, offset_ns)

    def observe(self, host_ns: int, offset_ns: int) -> None:
        """Take one message's arrival and (arrival - t_ns)."""
        if self.guessed:
            self.line = None
        if not self._slots.lower(host_ns, offset_ns):
            self._fit()
            self._slots.begin(host_ns, offset_ns)
            while host_ns - self._slots[0].host_ns > WINDOW_NS:
                self._slots.popleft()
        if self.line is None:
            self.line = OffsetLine(host_ns, offset_ns)
        elif offset_ns < self.line.at(host_ns):
            # The line was wrong by at least this much.
            uncertainty_ns = self.line.uncertainty_ns + self.line.at(host_ns) - offset_ns
            self.line = OffsetLine(host_ns, offset_ns, self.line.drift, uncertainty_ns)
        self._newest_above_ns.append(offset_ns - self.line.at(host_ns))

    def _fit(self) -> None:
        if len(self._slots) < 2:
            return
        newest = self._slots[-1]
        x, y = self._slots.relative_to(newest)
        drift = 0.0 if -x[0] < MIN_DRIFT_SPAN_NS else supporting_slope(x, y)
        above = y - drift * x
        level = float(above.min())
        self.line = OffsetLine(newest.host_ns, newest.offset_ns + level, drift, _spread_ns(above - level))


def _spread_ns(above: FloatArray) -> float:
    """How far the line may lie below the truth: a slot's smallest offset is never below it.

    The last slots count one by one and are extrapolated, so that the bound also holds for a clock that was set by less than a
    jump, and for one whose drift is not known yet.
    """
    if len(above) < RECENT_SLOTS:
        return math.inf
    last = above[-RECENT_SLOTS:]
    rise = max(0.0, last[-1] - last[0]) * 2 / (RECENT_SLOTS - 1)  # the line is used for two more slots
    return float(max(np.median(above), last.max(), last[-1] + rise))


def supporting_slope(x: FloatArray, y: FloatArray) -> float:
    """The slope of the line under all points with the smallest sum of distances: the lower hull's edge at their mean x."""
    hull: list[int] = []
    for i in range(len(x)):
        while len(hull) > 1 and _turns_down(x, y, hull[-2], hull[-1], i):
            hull.pop()
        hull.append(i)
    right = int(np.searchsorted(x[hull], x.mean()))
    a, b = hull[max(right - 1, 0)], hull[max(right, 1)]
    return plausible_drift(float((y[b] - y[a]) / (x[b] - x[a])))


def _turns_down(x: FloatArray, y: FloatArray, a: int, b: int, c: int) -> bool:
    return bool((y[b] - y[a]) * (x[c] - x[a]) >= (y[c] - y[a]) * (x[b] - x[a]))
