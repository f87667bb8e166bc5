"""Host time and bench time: offset, drift and their uncertainty, from what messages carry; no I/O.

Where the bench answers time requests, four timestamps give offset and delay as NTP does (RFC 5905, section 8). Where it
only talks, a message is never early: the line under all (arrival - t_ns) is nearest the truth (Moon, Skelly and Towsley
1999), and too large by the least one-way delay, which a one-way stream cannot tell.

Offset is host time minus bench time, in ns; a line over host time.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Literal

import numpy as np

from hilstar.arrays import FloatArray

NS_PER_MS = 1_000_000
NS_PER_S = 1_000_000_000

WINDOW_NS = 30 * NS_PER_S
SLOT_NS = NS_PER_S // 4
SHORTEST_FOR_DRIFT_NS = 2 * NS_PER_S  # below, 50 us of noise would read as more than 25 ppm
STEEPEST_DRIFT = 0.002  # ten times the worst crystal's; what seems steeper is a step, or t_ns is no clock
# A correction of the offset enters the frames so slowly that a turn seems at most so much faster or slower.
SLEW = 0.01
SLEWED_AT_MOST_NS = 50 * NS_PER_MS
SETTLING_NS = NS_PER_S
EXCHANGE_LIFE_NS = 5 * NS_PER_S
ENOUGH_EXCHANGES = 3
# Of all exchanges, those whose delay is within so much of the least one's had no queue in the way.
QUICK_DELAY_RATIO = 1.25
QUICK_DELAY_NS = 100_000

ClockMode = Literal["none", "one-way", "exchange"]


@dataclass(frozen=True, slots=True)
class OffsetLine:
    """offset(host) = offset_ns + drift (host - host_ns), known to `uncertainty_ns`."""

    host_ns: int
    offset_ns: float
    drift: float = 0.0
    uncertainty_ns: float = 0.0

    def at(self, host_ns: int) -> float:
        """The offset at a host time, ns."""
        return self.offset_ns + self.drift * (host_ns - self.host_ns)


class OneWayFilter:
    """The line under the offsets of a stream that only talks."""

    def __init__(self) -> None:
        self._slots: deque[tuple[int, int, int]] = deque()  # (slot, host_ns, offset_ns) of the least offset in it
        self.line: OffsetLine | None = None

    def observe(self, host_ns: int, offset_ns: int) -> None:
        """Take in one message's arrival and (arrival - t_ns)."""
        slot = host_ns // SLOT_NS
        if self._slots and self._slots[-1][0] == slot:
            if offset_ns < self._slots[-1][2]:
                self._slots[-1] = (slot, host_ns, offset_ns)
        else:
            self._fit()
            self._slots.append((slot, host_ns, offset_ns))
            while host_ns - self._slots[0][1] > WINDOW_NS:
                self._slots.popleft()
        if self.line is None:
            self.line = OffsetLine(host_ns, offset_ns)
        elif offset_ns < self.line.at(host_ns):
            self.line = OffsetLine(host_ns, offset_ns, self.line.drift, self.line.uncertainty_ns)

    def restart(self) -> None:
        """Forget the past."""
        self._slots.clear()
        self.line = None

    def _fit(self) -> None:
        if len(self._slots) < 2:
            return
        origin_ns, base_ns = self._slots[-1][1], self._slots[-1][2]
        x = np.array([host_ns - origin_ns for _, host_ns, _ in self._slots], dtype=np.float64)
        y = np.array([offset_ns - base_ns for *_, offset_ns in self._slots], dtype=np.float64)
        if -x[0] < SHORTEST_FOR_DRIFT_NS:
            drift, level = 0.0, float(y.min())
        else:
            drift = supporting_slope(x, y)
            level = float((y - drift * x).min())
        uncertainty = float(np.median(y - drift * x - level))
        self.line = OffsetLine(origin_ns, base_ns + level, drift, uncertainty)


def supporting_slope(x: FloatArray, y: FloatArray) -> float:
    """The slope of the line under all points that is nearest them in the sum: the lower hull's edge at their mean x."""
    hull: list[int] = []
    for i in range(len(x)):
        while len(hull) > 1 and _turns_down(x, y, hull[-2], hull[-1], i):
            hull.pop()
        hull.append(i)
    right = int(np.searchsorted(x[hull], x.mean()))
    a, b = hull[max(right - 1, 0)], hull[max(right, 1)]
    slope = float((y[b] - y[a]) / (x[b] - x[a]))
    return plausible_drift(slope)


def _turns_down(x: FloatArray, y: FloatArray, a: int, b: int, c: int) -> bool:
    return bool((y[b] - y[a]) * (x[c] - x[a]) >= (y[c] - y[a]) * (x[b] - x[a]))


def plausible_drift(slope: float) -> float:
    """The slope itself, or none where no clock drifts so."""
    return slope if abs(slope) <= STEEPEST_DRIFT else 0.0


class ExchangeFilter:
    """The line through the quickest of the four-timestamp exchanges."""

    def __init__(self) -> None:
        self._exchanges: deque[tuple[int, float, int]] = deque()  # (host_ns, offset_ns, delay_ns)
        self.count = 0
        self.line: OffsetLine | None = None

    def observe(self, host_ns: int, offset_ns: float, delay_ns: int) -> None:
        """Take in one exchange: its middle, its offset, and its delay there and back."""
        self.count += 1
        if self.line is not None and abs(offset_ns - self.line.at(host_ns)) > max(delay_ns, 5 * NS_PER_MS):
            self.restart()
        self._exchanges.append((host_ns, offset_ns, delay_ns))
        while host_ns - self._exchanges[0][0] > WINDOW_NS:
            self._exchanges.popleft()
        least_ns = min(delay for *_, delay in self._exchanges)
        limit_ns = max(least_ns * QUICK_DELAY_RATIO, least_ns + QUICK_DELAY_NS)
        quick = [(host, offset) for host, offset, delay in self._exchanges if delay <= limit_ns]
        x = np.array([host - host_ns for host, _ in quick], dtype=np.float64)
        y = np.array([offset - offset_ns for _, offset in quick], dtype=np.float64)
        drift = 0.0
        if np.ptp(x) >= SHORTEST_FOR_DRIFT_NS:
            drift = plausible_drift(float(np.polyfit(x, y, 1)[0]))
        level = float(np.mean(y - drift * x))
        self.line = OffsetLine(host_ns, offset_ns + level, drift, least_ns / 2)

    def current_line(self, host_ns: int) -> OffsetLine | None:
        """The line while enough exchanges are fresh, else None."""
        if len(self._exchanges) < ENOUGH_EXCHANGES or host_ns - self._exchanges[-1][0] > EXCHANGE_LIFE_NS:
            return None
        return self.line

    def restart(self) -> None:
        """Forget the past."""
        self._exchanges.clear()
        self.line = None


class BenchClock:
    """What the frames go by. One thread may observe while another asks."""

    def __init__(self) -> None:
        self.one_way = OneWayFilter()
        self.exchanges = ExchangeFilter()
        self._base_ns = 0  # the first offset, an integer: what is left fits a float64 to far below a nanosecond
        self._line: OffsetLine | None = None  # one attribute, so that another thread reads a whole value
        self._mode: ClockMode = "none"
        self._first_ns: int | None = None
        self._used: tuple[int, float] | None = None  # (host_ns, offset_ns) of the last frame

    def observe(self, t_ns: int, host_ns: int) -> None:
        """Take in one message: its bench time and its arrival."""
        self._begin(host_ns, host_ns - t_ns)
        self.one_way.observe(host_ns, host_ns - t_ns - self._base_ns)
        self._choose(host_ns)

    def exchange(self, asked_ns: tuple[int, int], bench_ns: tuple[int, int], wire_ns: tuple[int, int] = (0, 0)) -> None:
        """Take in one exchange: (t1, t4) of the host, (t2, t3) of the bench, and what the wire alone takes (there, back).

        A reply longer than its request would else shift the offset by half of what it takes longer.
        """
        (t1, t4), (t2, t3) = asked_ns, bench_ns
        delay_ns = (t4 - t1) - (t3 - t2)
        if delay_ns < 0 or t3 < t2:
            return
        there_ns, back_ns = wire_ns if delay_ns >= sum(wire_ns) else (0, 0)  # a pty has a baud rate and no wire
        self._begin(t4, t1 - t2)
        offset_ns = (t1 - t2 + t4 - t3 - 2 * self._base_ns - (back_ns - there_ns)) / 2
        self.exchanges.observe((t1 + t4) // 2, offset_ns, delay_ns)
        self._choose(t4)

    def _begin(self, host_ns: int, offset_ns: int) -> None:
        if self._first_ns is None:
            self._first_ns, self._base_ns = host_ns, offset_ns

    def _choose(self, host_ns: int) -> None:
        exchanged = self.exchanges.current_line(host_ns)
        self._mode = "one-way" if exchanged is None else "exchange"
        self._line = exchanged or self.one_way.line

    def to_bench_ns(self, host_ns: int) -> int:
        """Bench time at a host time, moved towards the newest estimate without a step; host time itself before any message.

        For one thread, with host times that do not go back.
        """
        line, first_ns = self._line, self._first_ns
        if line is None:
            return host_ns
        wanted_ns = line.at(host_ns)
        if self._used is not None and first_ns is not None and host_ns - first_ns > SETTLING_NS:
            then_ns, offset_ns = self._used
            change_ns = wanted_ns - offset_ns
            if abs(change_ns) < SLEWED_AT_MOST_NS:
                most_ns = SLEW * (host_ns - then_ns)
                wanted_ns = offset_ns + min(max(change_ns, -most_ns), most_ns)
        self._used = (host_ns, wanted_ns)
        return host_ns - self._base_ns - round(wanted_ns)

    def latency_ns(self, t_ns: int, host_ns: int) -> float | None:
        """How long a message was under way: in full where exchanges run, else above the least; None before any."""
        line = self._line
        return None if line is None else host_ns - t_ns - self._base_ns - line.at(host_ns)

    @property
    def synchronised(self) -> bool:
        """True while four-timestamp exchanges carry the offset."""
        return self._mode == "exchange"

    def summary(self) -> dict[str, float | int | str | None]:
        """Mode, offset (host minus bench), drift (positive: the bench's clock runs fast) and uncertainty."""
        line = self._line
        if line is None:
            return {"mode": self._mode, "offset_ms": None, "drift_ppm": None, "uncertainty_ms": None, "exchanges": 0}
        return {
            "mode": self._mode,
            "offset_ms": (self._base_ns + line.offset_ns) / NS_PER_MS,
            "drift_ppm": -line.drift * 1e6,
            "uncertainty_ms": line.uncertainty_ns / NS_PER_MS,
            "exchanges": self.exchanges.count,
        }
