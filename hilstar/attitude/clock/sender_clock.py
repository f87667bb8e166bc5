"""Host time and bench time: offset, drift and their uncertainty, from what messages carry; no I/O.

Where the bench answers time requests, four timestamps give offset and delay as NTP does (RFC 5905, section 8). Where it
only talks, a message is never early: the line under all (arrival - t_ns) is nearest the truth (Moon, Skelly and Towsley
1999), and too large by the minimum one-way delay, which a one-way stream cannot tell. Where the sender reads this
machine's own clock there is nothing to estimate ("shared").

Offset is host time minus bench time, in ns; a line over host time. A message that waited unread says only that the offset
is smaller: a guess, until one comes that did not wait.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.units import NS_PER_MS, NS_PER_S

WINDOW_NS = 30 * NS_PER_S
SLOT_NS = NS_PER_S // 4
SHORTEST_FOR_DRIFT_NS = 2 * NS_PER_S  # below, 50 us of noise would read as more than 25 ppm
STEEPEST_DRIFT = 0.002  # ten times the worst crystal's; what seems steeper is a step, or t_ns is no clock
# A correction of the offset enters the frames so slowly that a turn seems at most so much faster or slower.
SLEW = 0.01
SLEWED_AT_MOST_NS = 50 * NS_PER_MS
SETTLING_NS = 2 * NS_PER_S
# The uncertainty is what the last second says of the line, and nothing is said of it before.
RECENT_SLOTS = 4
NEWEST = 8
EXCHANGE_LIFE_NS = 5 * NS_PER_S
ENOUGH_EXCHANGES = 3
# Of all exchanges, those whose delay is within so much of the minimum had no queue in the way.
QUICK_DELAY_RATIO = 1.25
QUICK_DELAY_NS = 100_000
RECENT_EXCHANGES = 3
# A one-way stream cannot tell its minimum delay. That of sockets on one machine (0.02 to 0.1 ms) is in its uncertainty, so that
# it contains the truth there; a longer road's is not.
LOCAL_DELAY_NS = 100_000

ClockMode = Literal["none", "one-way", "exchange", "shared"]


@dataclass(frozen=True, slots=True)
class OffsetLine:
    """offset(host) = offset_ns + drift (host - host_ns), known to `uncertainty_ns`."""

    host_ns: int
    offset_ns: float
    drift: float = 0.0
    uncertainty_ns: float = math.inf

    def at(self, host_ns: int) -> float:
        """The offset at a host time, ns."""
        return self.offset_ns + self.drift * (host_ns - self.host_ns)


class OneWayFilter:
    """The line under the offsets of a stream that only talks."""

    def __init__(self) -> None:
        self._slots: deque[tuple[int, int, int]] = deque()  # (slot, host_ns, offset_ns) of the smallest offset in it
        self._newest_above_ns: deque[float] = deque(maxlen=NEWEST)
        self.line: OffsetLine | None = None

    @property
    def all_above_ns(self) -> float:
        """By how much each of the newest messages was later than the line says."""
        return min(self._newest_above_ns, default=0.0)

    @property
    def guessed(self) -> bool:
        """True while only messages have come that waited."""
        return not self._slots

    def guess(self, host_ns: int, offset_ns: int) -> None:
        """Take in a message that waited unread: a bound from above, which the first one that did not wait replaces."""
        if self.guessed and (self.line is None or offset_ns < self.line.at(host_ns)):
            self.line = OffsetLine(host_ns, offset_ns)

    def observe(self, host_ns: int, offset_ns: int) -> None:
        """Take in one message's arrival and (arrival - t_ns)."""
        if self.guessed:
            self.line = None
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
            # So much it was wrong by, at least.
            uncertainty_ns = self.line.uncertainty_ns + self.line.at(host_ns) - offset_ns
            self.line = OffsetLine(host_ns, offset_ns, self.line.drift, uncertainty_ns)
        self._newest_above_ns.append(offset_ns - self.line.at(host_ns))

    def _fit(self) -> None:
        if len(self._slots) < 2:
            return
        origin_ns, base_ns = self._slots[-1][1], self._slots[-1][2]
        x = np.array([host_ns - origin_ns for _, host_ns, _ in self._slots], dtype=np.float64)
        y = np.array([offset_ns - base_ns for *_, offset_ns in self._slots], dtype=np.float64)
        drift = 0.0 if -x[0] < SHORTEST_FOR_DRIFT_NS else supporting_slope(x, y)
        above = y - drift * x
        level = float(above.min())
        self.line = OffsetLine(origin_ns, base_ns + level, drift, _spread_ns(above - level))


def _spread_ns(above: FloatArray) -> float:
    """How far the line may lie below the truth: a slot's smallest offset is never below it.

    The last slots count one by one, and go on as they do, so that a clock that was set by less than a jump, or whose drift is
    not known yet, is within the bound.
    """
    if len(above) < RECENT_SLOTS:
        return math.inf
    last = above[-RECENT_SLOTS:]
    rise = max(0.0, last[-1] - last[0]) * 2 / (RECENT_SLOTS - 1)  # the line is used for two slots more
    return float(max(np.median(above), last.max(), last[-1] + rise))


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
        if self._contradicts(host_ns, offset_ns, delay_ns):
            self.restart()
        self._exchanges.append((host_ns, offset_ns, delay_ns))
        while host_ns - self._exchanges[0][0] > WINDOW_NS:
            self._exchanges.popleft()
        minimum_ns = min(delay for *_, delay in self._exchanges)
        limit_ns = max(minimum_ns * QUICK_DELAY_RATIO, minimum_ns + QUICK_DELAY_NS)
        quick = [each for each in self._exchanges if each[2] <= limit_ns]
        x = np.array([host - host_ns for host, *_ in quick], dtype=np.float64)
        y = np.array([offset - offset_ns for _, offset, _ in quick], dtype=np.float64)
        drift = 0.0
        if np.ptp(x) >= SHORTEST_FOR_DRIFT_NS:
            drift = plausible_drift(float(np.polyfit(x, y, 1)[0]))
        level = float(np.mean(y - drift * x))
        # The truth lies within half the delay of each exchange's own offset, whatever the two ways took.
        bounds = np.abs(y - drift * x - level) + 0.5 * np.array([delay for *_, delay in quick])
        uncertainty_ns = float(bounds[-RECENT_EXCHANGES:].max())
        if not drift and len(y) > 1:
            uncertainty_ns += abs(float(y[-1] - y[-2]))  # it may go on like that
        self.line = OffsetLine(host_ns, offset_ns + level, drift, uncertainty_ns)

    def _contradicts(self, host_ns: int, offset_ns: float, delay_ns: int) -> bool:
        """No drift explains that exchange: the clock was set, by however little."""
        line = self.line
        if line is None:
            return False
        drifted_ns = STEEPEST_DRIFT * (host_ns - line.host_ns)
        return abs(offset_ns - line.at(host_ns)) > delay_ns / 2 + line.uncertainty_ns + drifted_ns

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
    """What the frames go by. One thread may observe while another asks. A `shared` one is the host's own."""

    def __init__(self, *, shared: bool = False) -> None:
        self.one_way = OneWayFilter()
        self.exchanges = ExchangeFilter()
        self._shared = shared
        self._base_ns: int | None = 0 if shared else None  # the first offset: what is left fits a float64 to below 1 ns
        self._line = OffsetLine(0, 0.0, uncertainty_ns=0.0) if shared else None  # one attribute: read whole by other threads
        self._mode: ClockMode = "shared" if shared else "none"
        self._first_ns: int | None = None
        self._used: tuple[int, float] | None = None  # (host_ns, offset_ns) of the last frame

    def observe(self, t_ns: int, host_ns: int) -> None:
        """Take in one message: its bench time and its arrival."""
        if not self._shared:
            self.one_way.observe(host_ns, self._begin(host_ns - t_ns, host_ns))
            self._choose(host_ns)

    def guess(self, t_ns: int, host_ns: int) -> None:
        """Take in one message that waited unread: better than nothing, until one comes that did not."""
        if not self._shared:
            self.one_way.guess(host_ns, self._begin(host_ns - t_ns))
            self._choose(host_ns)

    def exchange(self, asked_ns: tuple[int, int], bench_ns: tuple[int, int], wire_ns: tuple[int, int] = (0, 0)) -> None:
        """Take in one exchange: (t1, t4) of the host, (t2, t3) of the bench, and what the wire alone takes (there, back).

        A reply longer than its request would else shift the offset by half of what it takes longer.
        """
        (t1, t4), (t2, t3) = asked_ns, bench_ns
        delay_ns = (t4 - t1) - (t3 - t2)
        if delay_ns < 0 or t3 < t2 or self._shared:
            return
        there_ns, back_ns = wire_ns if delay_ns >= sum(wire_ns) else (0, 0)  # a pty has a baud rate and no wire
        offset_ns = (2 * self._begin(t1 - t2, t4) + (t4 - t3) - (t1 - t2) - (back_ns - there_ns)) / 2
        self.exchanges.observe((t1 + t4) // 2, offset_ns, delay_ns)
        self._choose(t4)

    def widen(self, by_ns: float) -> None:
        """The sender's clock was carried across a jump: until the line is fitted anew it is known so much worse."""
        line = self.one_way.line
        if line is not None:
            self.one_way.line = replace(line, uncertainty_ns=line.uncertainty_ns + by_ns)

    def _begin(self, offset_ns: int, host_ns: int | None = None) -> int:
        """What is left of an offset without the first one; a `host_ns` is the time at which the clock was first known."""
        if self._base_ns is None:
            self._base_ns = offset_ns
        if self._first_ns is None:
            self._first_ns = host_ns
        return offset_ns - self._base_ns

    def _choose(self, host_ns: int) -> None:
        exchanged = self.exchanges.current_line(host_ns)
        self._mode = "one-way" if exchanged is None else "exchange"
        self._line = exchanged or self.one_way.line

    def to_bench_ns(self, host_ns: int) -> int:
        """Bench time at a host time, moved towards the newest estimate without a step; host time itself before any message.

        For one thread, with host times that do not go back.
        """
        line, first_ns, base_ns = self._line, self._first_ns, self._base_ns
        if line is None or base_ns is None:
            return host_ns
        wanted_ns = line.at(host_ns)
        if self._used is not None and first_ns is not None and host_ns - first_ns > SETTLING_NS:
            then_ns, offset_ns = self._used
            change_ns = wanted_ns - offset_ns
            if abs(change_ns) < SLEWED_AT_MOST_NS:
                most_ns = SLEW * (host_ns - then_ns)
                wanted_ns = offset_ns + min(max(change_ns, -most_ns), most_ns)
        self._used = (host_ns, wanted_ns)
        return host_ns - base_ns - round(wanted_ns)

    def latency_ns(self, t_ns: int, host_ns: int) -> float | None:
        """How long a message was under way: in full where exchanges run, else above the minimum; None before any."""
        line, base_ns = self._line, self._base_ns
        return None if line is None or base_ns is None else host_ns - t_ns - base_ns - line.at(host_ns)

    @property
    def unheard(self) -> bool:
        """True before the first message that did not wait."""
        return self.one_way.guessed

    @property
    def synchronised(self) -> bool:
        """True while four-timestamp exchanges carry the offset."""
        return self._mode == "exchange"

    def summary(self) -> dict[str, float | int | str | None]:
        """Mode, offset (host minus bench), drift (positive: the bench's clock runs fast) and uncertainty.

        The uncertainty bounds the error of what frames go by, and is None while little is known: in full where exchanges run,
        and where the sender only talks, but for what its minimum delay is over LOCAL_DELAY_NS.
        """
        line = self._line
        if line is None or self._base_ns is None:
            return {"mode": self._mode, "offset_ms": None, "drift_ppm": None, "uncertainty_ms": None, "exchanges": 0}
        behind_ns = 0.0 if self._used is None else abs(line.at(self._used[0]) - self._used[1])
        uncertainty_ns = line.uncertainty_ns
        if self._mode == "one-way":
            uncertainty_ns = max(uncertainty_ns, self.one_way.all_above_ns) + LOCAL_DELAY_NS
        return {
            "mode": self._mode,
            "offset_ms": (self._base_ns + line.offset_ns) / NS_PER_MS,
            "drift_ppm": 0.0 - line.drift * 1e6,
            "uncertainty_ms": (uncertainty_ns + behind_ns) / NS_PER_MS if math.isfinite(uncertainty_ns) else None,
            "exchanges": self.exchanges.count,
        }
