"""The sender's clock against the host's: offset, drift and their uncertainty, from the messages'
times alone; no I/O.

An offset is host time minus sender time, ns, as a line over host time. Three modes:
- "exchange": the sender answers time requests; four timestamps, as in NTP (RFC 5905, section 8).
- "one-way": arrivals alone. A message is never early, so the line under all (arrival - t_ns) is
  nearest the true offset (Moon,
  Skelly and Towsley 1999). It is too large by the minimum transport delay, which a one-way stream
  cannot measure. A message that waited unread gives only an upper bound, which counts until one
  arrives that did not wait.
- "shared": the sender stamps with this machine's own clock; nothing is estimated.
- "unix": the sender stamps with Unix time, which NTP or PTP keeps on both machines; the offset is
  that of this machine's own
  clock of Unix time, its uncertainty what the kernel states of that. The error of the sender's
  clock comes on top.
"""

import math
from collections import deque
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.process.scheduling import UnixOffset
from hilstar.basics.units import NS_PER_MS, NS_PER_S

WINDOW_NS = 30 * NS_PER_S
SLOT_NS = NS_PER_S // 4
# over a shorter span, 50 us of noise would read as more than 25 ppm
MIN_DRIFT_SPAN_NS = 2 * NS_PER_S
# ten times the worst crystal's; a steeper slope is a step, or t_ns is not a clock
MAX_DRIFT = 0.002
# the last second: the uncertainty comes from it, and is infinite before it is over
RECENT_SLOTS = 4
NEWEST = 8
EXCHANGE_LIFE_NS = 5 * NS_PER_S
MIN_EXCHANGES = 3
# Exchanges whose delay is within this of the minimum met no queue.
QUICK_DELAY_RATIO = 1.25
QUICK_DELAY_NS = 100_000
RECENT_EXCHANGES = 3
# A corrected offset is applied gradually: a turn seems at most this much faster or slower. A larger
# correction is a step.
SLEW = 0.01
MAX_SLEWED_NS = 50 * NS_PER_MS
SETTLING_NS = 2 * NS_PER_S
# A one-way stream cannot measure its minimum delay. That of sockets on one machine (0.02 to 0.1 ms)
# is in the uncertainty, so that it contains the truth there; the delay of a longer link is not.
LOCAL_DELAY_NS = 100_000

ClockMode = Literal["none", "one-way", "exchange", "shared", "unix"]
KNOWN_MODES = frozenset[ClockMode]({"exchange", "shared", "unix"})  # their latencies are absolute


@dataclass(frozen=True, slots=True)
class _OffsetLine:
    """offset(host) = offset_ns + drift (host - host_ns), known to `uncertainty_ns`."""

    host_ns: int
    offset_ns: float
    drift: float = 0.0
    uncertainty_ns: float = math.inf

    def at(self, host_ns: int) -> float:
        return self.offset_ns + self.drift * (host_ns - self.host_ns)


class _Slot(NamedTuple):
    """The message with the smallest offset within SLOT_NS."""

    host_ns: int
    offset_ns: int


class Slots(deque[_Slot]):
    """The smallest offset of each slot, oldest first."""

    def lower(self, host_ns: int, offset_ns: int) -> bool:
        """Take a message into the newest slot; False, and nothing taken, where it begins a new
        one.
        """
        if not self or self[-1].host_ns // SLOT_NS != host_ns // SLOT_NS:
            return False
        if offset_ns < self[-1].offset_ns:
            self[-1] = _Slot(host_ns, offset_ns)
        return True

    def begin(self, host_ns: int, offset_ns: int) -> None:
        """Begin a new slot with this message."""
        self.append(_Slot(host_ns, offset_ns))

    def relative_to(self, origin: _Slot) -> tuple[FloatArray, FloatArray]:
        """Host times and offsets (n,), ns, from those of `origin`."""
        x = np.array([slot.host_ns - origin.host_ns for slot in self], dtype=np.float64)
        y = np.array([slot.offset_ns - origin.offset_ns for slot in self], dtype=np.float64)
        return x, y


class OneWayFilter:
    """The line under the offsets of a one-way stream."""

    def __init__(self) -> None:
        self._slots = Slots()
        self._newest_above_ns: deque[float] = deque(maxlen=NEWEST)
        self.line: _OffsetLine | None = None

    @property
    def all_above_ns(self) -> float:
        """The smallest excess of the newest messages over the line."""
        return min(self._newest_above_ns, default=0.0)

    @property
    def guessed(self) -> bool:
        """True while every message so far had waited unread."""
        return not self._slots

    def guess(self, host_ns: int, offset_ns: int) -> None:
        """Take a message that waited unread: an upper bound, which the first one that did not
        wait replaces.
        """
        if self.guessed and (self.line is None or offset_ns < self.line.at(host_ns)):
            self.line = _OffsetLine(host_ns, offset_ns)

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
            self.line = _OffsetLine(host_ns, offset_ns)
        elif offset_ns < self.line.at(host_ns):
            # The line was wrong by at least this much.
            uncertainty_ns = self.line.uncertainty_ns + self.line.at(host_ns) - offset_ns
            self.line = _OffsetLine(host_ns, offset_ns, self.line.drift, uncertainty_ns)
        self._newest_above_ns.append(offset_ns - self.line.at(host_ns))

    def _fit(self) -> None:
        if len(self._slots) < 2:
            return
        newest = self._slots[-1]
        x, y = self._slots.relative_to(newest)
        if -x[0] < MIN_DRIFT_SPAN_NS:
            drift = 0.0
        else:
            drift = _supporting_slope(x, y)
        above = y - drift * x
        level = float(above.min())
        above -= level
        # The line may lie below the truth by as much as a slot's smallest offset is above it. The
        # last slots count one by one and are carried on to the two for which the line is used: a
        # clock may be set by less than a jump, or drift unknown.
        uncertainty_ns = math.inf
        last = above[-RECENT_SLOTS:]
        if len(last) == RECENT_SLOTS:
            rise = (last[-1] - last[0]) * 2 / (RECENT_SLOTS - 1)
            uncertainty_ns = float(max(np.median(above), last.max(), last[-1] + rise))
        self.line = _OffsetLine(newest.host_ns, newest.offset_ns + level, drift, uncertainty_ns)


def _supporting_slope(x: FloatArray, y: FloatArray) -> float:
    """The slope of the line under all points with the smallest sum of distances: the lower hull's
    edge at their mean x.

    0 where it is steeper than any clock drifts.
    """
    hull: list[int] = []
    for c in range(len(x)):
        while len(hull) > 1:
            a, b = hull[-2:]
            if (y[b] - y[a]) * (x[c] - x[a]) < (y[c] - y[a]) * (x[b] - x[a]):
                break
            hull.pop()
        hull.append(c)
    right = int(np.searchsorted(x[hull], x.mean()))
    a, b = hull[right - 1 : right + 1]
    slope = float((y[b] - y[a]) / (x[b] - x[a]))
    return slope if abs(slope) <= MAX_DRIFT else 0.0


@dataclass(frozen=True, slots=True)
class Exchange:
    """A request leaves the host at t1 and reaches the sender at t2; the reply leaves it at t3 and
    arrives at t4.

    t1 and t4 are host times, t2 and t3 sender times, ns. `there_ns` and `back_ns` are how long the
    wire alone takes for request and reply: a reply longer than its request would otherwise shift
    the offset by half of the difference.
    """

    t1_ns: int
    t2_ns: int
    t3_ns: int
    t4_ns: int
    there_ns: int = 0
    back_ns: int = 0

    @property
    def delay_ns(self) -> int:
        """How long request and reply were under way."""
        return (self.t4_ns - self.t1_ns) - (self.t3_ns - self.t2_ns)

    @property
    def possible(self) -> bool:
        """False where a reply leaves before its request arrives, or arrives before it leaves."""
        return self.delay_ns >= 0 and self.t3_ns >= self.t2_ns

    def offset_ns(self, base_ns: int) -> float:
        """Host minus sender time, less `base_ns`, with the difference of the two wire times
        removed.
        """
        known = self.delay_ns >= self.there_ns + self.back_ns  # a pty has a baud rate and no wire
        longer_ns = self.back_ns - self.there_ns if known else 0
        return (
            (self.t1_ns - self.t2_ns - base_ns) + (self.t4_ns - self.t3_ns - base_ns) - longer_ns
        ) / 2


class _MeasuredExchange(NamedTuple):
    host_ns: int
    offset_ns: float
    delay_ns: int


class _ExchangeFilter:
    """The line through the quickest of the exchanges."""

    def __init__(self) -> None:
        self._measured: deque[_MeasuredExchange] = deque()
        self.count = 0
        self.line: _OffsetLine | None = None

    def observe(self, exchange: Exchange, base_ns: int) -> None:
        """Take one exchange; the line's offsets are less `base_ns`."""
        new = _MeasuredExchange(
            (exchange.t1_ns + exchange.t4_ns) // 2, exchange.offset_ns(base_ns), exchange.delay_ns
        )
        self.count += 1
        if self.line is not None:
            bound_ns = (
                new.delay_ns / 2
                + self.line.uncertainty_ns
                + MAX_DRIFT * (new.host_ns - self.line.host_ns)
            )
            # no drift explains it: the clock was set
            if abs(new.offset_ns - self.line.at(new.host_ns)) > bound_ns:
                self._measured.clear()
        self._measured.append(new)
        while new.host_ns - self._measured[0].host_ns > WINDOW_NS:
            self._measured.popleft()
        self.line = self._fit(new)

    def _fit(self, new: _MeasuredExchange) -> _OffsetLine:
        min_ns = min(exchange.delay_ns for exchange in self._measured)
        limit_ns = max(min_ns * QUICK_DELAY_RATIO, min_ns + QUICK_DELAY_NS)
        quick = [exchange for exchange in self._measured if exchange.delay_ns <= limit_ns]
        x = np.array([exchange.host_ns - new.host_ns for exchange in quick], dtype=np.float64)
        y = np.array([exchange.offset_ns - new.offset_ns for exchange in quick], dtype=np.float64)
        drift = 0.0
        if np.ptp(x) >= MIN_DRIFT_SPAN_NS:
            drift = float(np.polyfit(x, y, 1)[0])
            drift = drift if abs(drift) <= MAX_DRIFT else 0.0
        level = float(np.mean(y - drift * x))
        # The truth lies within half the delay of each exchange's own offset, however the delay
        # divides between the two ways.
        bounds = np.abs(y - drift * x - level) + 0.5 * np.array(
            [exchange.delay_ns for exchange in quick]
        )
        uncertainty_ns = float(bounds[-RECENT_EXCHANGES:].max())
        if not drift and len(y) > 1:
            uncertainty_ns += abs(float(y[-1] - y[-2]))  # it may go on like that
        return _OffsetLine(new.host_ns, new.offset_ns + level, drift, uncertainty_ns)

    def current_line(self, host_ns: int) -> _OffsetLine | None:
        """The line while enough exchanges are recent, else None."""
        if (
            len(self._measured) < MIN_EXCHANGES
            or host_ns - self._measured[-1].host_ns > EXCHANGE_LIFE_NS
        ):
            return None
        return self.line


@dataclass(frozen=True, slots=True)
class ClockSummary:
    """Offset (host minus sender), drift (positive: the sender's clock runs fast), uncertainty,
    exchanges and jumps.

    The uncertainty bounds the error of the times that frames use; it is None until enough is known.
    On a one-way stream it excludes the minimum transport delay beyond LOCAL_DELAY_NS, which such a
    stream cannot measure.
    """

    mode: ClockMode
    offset_ms: float | None = None
    drift_ppm: float | None = None
    uncertainty_ms: float | None = None
    exchanges: int = 0
    jumps: int = 0


class SenderClock:
    """The sender's time at any host time; `mode` says where the offset comes from. One thread may
    observe, another ask.

    `known` is the offset of a clock that is not estimated: of the host's own one ("shared"), or of
    Unix time.
    """

    def __init__(self, known: UnixOffset | None = None, mode: ClockMode = "none") -> None:
        self._one_way = OneWayFilter()
        self._exchanges = _ExchangeFilter()
        self._known = known is not None
        self._base_ns: int | None = None  # the first offset: the rest fits a float64 to below 1 ns
        self._line: _OffsetLine | None = None  # one attribute: read whole by other threads
        self.mode: ClockMode = mode
        if known is not None:
            self.know(known)
        self._first_ns: int | None = None
        self._used: tuple[int, float] | None = None  # host time and offset of the last frame

    def know(self, known: UnixOffset) -> None:
        """Take the offset of a clock that is not estimated: a step of it is one of the next
        frame.
        """
        self._line = _OffsetLine(
            0, known.offset_ns - self._base(known.offset_ns), uncertainty_ns=known.error_ns
        )

    def observe(self, t_ns: int, host_ns: int) -> None:
        """Take one message: its time on the sender's clock and its arrival."""
        if not self._known:
            self._first_ns = host_ns if self._first_ns is None else self._first_ns
            self._one_way.observe(host_ns, host_ns - t_ns - self._base(host_ns - t_ns))
            self._choose(host_ns)

    def guess(self, t_ns: int, host_ns: int) -> None:
        """Take one message that waited unread: better than nothing, until one arrives that did
        not.
        """
        if not self._known:
            self._one_way.guess(host_ns, host_ns - t_ns - self._base(host_ns - t_ns))
            self._choose(host_ns)

    def exchange(self, exchange: Exchange) -> None:
        """Take one exchange; an impossible one is ignored."""
        if not exchange.possible or self._known:
            return
        self._first_ns = exchange.t4_ns if self._first_ns is None else self._first_ns
        self._exchanges.observe(exchange, self._base(exchange.t1_ns - exchange.t2_ns))
        self._choose(exchange.t4_ns)

    def widen(self, by_ns: float) -> None:
        """Add to the uncertainty until the next fit: the clock was carried across a jump."""
        line = self._one_way.line
        if line is not None:
            self._one_way.line = replace(line, uncertainty_ns=line.uncertainty_ns + by_ns)

    def _base(self, offset_ns: int) -> int:
        if self._base_ns is None:
            self._base_ns = offset_ns
        return self._base_ns

    def _choose(self, host_ns: int) -> None:
        exchanged = self._exchanges.current_line(host_ns)
        self.mode = "one-way" if exchanged is None else "exchange"
        self._line = exchanged or self._one_way.line

    def to_sender_ns(self, host_ns: int) -> int:
        """The sender's time at a host time, slewed to the newest estimate without a step; host time
        before any message.

        For one thread, with host times that do not go back.
        """
        line = self._line
        first_ns = self._first_ns
        base_ns = self._base_ns
        if line is None or base_ns is None:
            return host_ns
        offset_ns = line.at(host_ns)
        if self._used is not None and first_ns is not None and host_ns - first_ns > SETTLING_NS:
            used_host_ns, used_ns = self._used
            change_ns = offset_ns - used_ns
            if abs(change_ns) < MAX_SLEWED_NS:
                max_ns = SLEW * (host_ns - used_host_ns)
                offset_ns = used_ns + min(max(change_ns, -max_ns), max_ns)
        self._used = host_ns, offset_ns
        return host_ns - base_ns - round(offset_ns)

    def latency_ns(self, t_ns: int, host_ns: int) -> float | None:
        """A message's delay: the whole of it where exchanges run, else its excess over the
        minimum; None before any.
        """
        line = self._line
        base_ns = self._base_ns
        if line is None or base_ns is None:
            return None
        return host_ns - t_ns - base_ns - line.at(host_ns)

    def late_ns(self, t_ns: int, host_ns: int) -> float:
        """A message's delay above the line of the arrivals alone; 0 before any message."""
        line = self._one_way.line
        base_ns = self._base_ns
        if line is None or base_ns is None:
            return 0.0
        return host_ns - t_ns - base_ns - line.at(host_ns)

    @property
    def unheard(self) -> bool:
        """True before the first message that did not wait."""
        return self._one_way.guessed

    @property
    def synchronised(self) -> bool:
        """True while four-timestamp exchanges carry the offset."""
        return self.mode == "exchange"

    def summary(self) -> ClockSummary:
        """What is known of the clock now."""
        line = self._line
        if line is None or self._base_ns is None:
            return ClockSummary(self.mode)
        if self._used is None:
            behind_ns = 0.0
        else:
            behind_ns = abs(line.at(self._used[0]) - self._used[1])
        uncertainty_ns = line.uncertainty_ns
        if self.mode == "one-way":
            uncertainty_ns = max(uncertainty_ns, self._one_way.all_above_ns) + LOCAL_DELAY_NS
        uncertainty_ms = None
        if math.isfinite(uncertainty_ns):
            uncertainty_ms = (uncertainty_ns + behind_ns) / NS_PER_MS
        return ClockSummary(
            self.mode,
            offset_ms=(self._base_ns + line.offset_ns) / NS_PER_MS,
            drift_ppm=0.0 - line.drift * 1e6,
            uncertainty_ms=uncertainty_ms,
            exchanges=self._exchanges.count,
        )
