"""The clock offset of a sender that answers time requests: four timestamps, as NTP (RFC 5905, section 8); no I/O."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hilstar.attitude.clock.offset_line import MAX_DRIFT, MIN_DRIFT_SPAN_NS, WINDOW_NS, OffsetLine, plausible_drift
from hilstar.units import NS_PER_S

EXCHANGE_LIFE_NS = 5 * NS_PER_S
MIN_EXCHANGES = 3
# Exchanges whose delay is within this of the minimum met no queue.
QUICK_DELAY_RATIO = 1.25
QUICK_DELAY_NS = 100_000
RECENT_EXCHANGES = 3


@dataclass(frozen=True, slots=True)
class Exchange:
    """A request leaves the host at t1 and reaches the sender at t2; the reply leaves it at t3 and arrives at t4.

    t1 and t4 are host times, t2 and t3 sender times, ns. `there_ns` and `back_ns` are how long the wire alone takes for
    request and reply: a reply longer than its request would otherwise shift the offset by half of the difference.
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
        """Host minus sender time, less `base_ns`, with the difference of the two wire times removed."""
        known = self.delay_ns >= self.there_ns + self.back_ns  # a pty has a baud rate and no wire
        longer_ns = self.back_ns - self.there_ns if known else 0
        return ((self.t1_ns - self.t2_ns - base_ns) + (self.t4_ns - self.t3_ns - base_ns) - longer_ns) / 2


class _Measured(NamedTuple):
    host_ns: int
    offset_ns: float
    delay_ns: int


class ExchangeFilter:
    """The line through the quickest of the exchanges."""

    def __init__(self) -> None:
        self._measured: deque[_Measured] = deque()
        self.count = 0
        self.line: OffsetLine | None = None

    def observe(self, exchange: Exchange, base_ns: int) -> None:
        """Take one exchange; the line's offsets are less `base_ns`."""
        new = _Measured((exchange.t1_ns + exchange.t4_ns) // 2, exchange.offset_ns(base_ns), exchange.delay_ns)
        self.count += 1
        if self._contradicts(new):
            self.restart()
        self._measured.append(new)
        while new.host_ns - self._measured[0].host_ns > WINDOW_NS:
            self._measured.popleft()
        self.line = self._fit(new)

    def _fit(self, new: _Measured) -> OffsetLine:
        min_ns = min(each.delay_ns for each in self._measured)
        limit_ns = max(min_ns * QUICK_DELAY_RATIO, min_ns + QUICK_DELAY_NS)
        quick = [each for each in self._measured if each.delay_ns <= limit_ns]
        x = np.array([each.host_ns - new.host_ns for each in quick], dtype=np.float64)
        y = np.array([each.offset_ns - new.offset_ns for each in quick], dtype=np.float64)
        drift = 0.0
        if np.ptp(x) >= MIN_DRIFT_SPAN_NS:
            drift = plausible_drift(float(np.polyfit(x, y, 1)[0]))
        level = float(np.mean(y - drift * x))
        # The truth lies within half the delay of each exchange's own offset, however the delay divides between the two ways.
        bounds = np.abs(y - drift * x - level) + 0.5 * np.array([each.delay_ns for each in quick])
        uncertainty_ns = float(bounds[-RECENT_EXCHANGES:].max())
        if not drift and len(y) > 1:
            uncertainty_ns += abs(float(y[-1] - y[-2]))  # it may go on like that
        return OffsetLine(new.host_ns, new.offset_ns + level, drift, uncertainty_ns)

    def _contradicts(self, new: _Measured) -> bool:
        """True where no drift explains the new exchange: the clock was set, by however little."""
        line = self.line
        if line is None:
            return False
        drifted_ns = MAX_DRIFT * (new.host_ns - line.host_ns)
        return abs(new.offset_ns - line.at(new.host_ns)) > new.delay_ns / 2 + line.uncertainty_ns + drifted_ns

    def current_line(self, host_ns: int) -> OffsetLine | None:
        """The line while enough exchanges are recent, else None."""
        if len(self._measured) < MIN_EXCHANGES or host_ns - self._measured[-1].host_ns > EXCHANGE_LIFE_NS:
            return None
        return self.line

    def restart(self) -> None:
        """Forget every exchange."""
        self._measured.clear()
        self.line = None
