"""The sender's clock against the host's: offset, drift and their uncertainty, from what messages carry; no I/O.

Where the sender answers time requests the offset comes from exchanges (`exchanges`), otherwise from the arrivals alone
(`one_way`). Where the sender stamps with this machine's own clock nothing is estimated ("shared"). An offset is host time
minus sender time, ns.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

from hilstar.attitude.clock.exchanges import Exchange, ExchangeFilter
from hilstar.attitude.clock.offset_line import OffsetLine
from hilstar.attitude.clock.one_way import OneWayFilter
from hilstar.units import NS_PER_MS, NS_PER_S

# A corrected offset is applied gradually: a turn seems at most this much faster or slower. A larger correction is a step.
SLEW = 0.01
MAX_SLEWED_NS = 50 * NS_PER_MS
SETTLING_NS = 2 * NS_PER_S
# A one-way stream cannot measure its minimum delay. That of sockets on one machine (0.02 to 0.1 ms) is in the uncertainty, so
# that it contains the truth there; the delay of a longer link is not.
LOCAL_DELAY_NS = 100_000

ClockMode = Literal["none", "one-way", "exchange", "shared"]


@dataclass(frozen=True, slots=True)
class ClockSummary:
    """Offset (host minus sender), drift (positive: the sender's clock runs fast), uncertainty, exchanges and jumps.

    The uncertainty bounds the error of the times that frames use; it is None until enough is known. On a one-way stream it
    excludes the minimum transport delay beyond LOCAL_DELAY_NS, which such a stream cannot measure.
    """

    mode: ClockMode
    offset_ms: float | None = None
    drift_ppm: float | None = None
    uncertainty_ms: float | None = None
    exchanges: int = 0
    jumps: int = 0


class _Used(NamedTuple):
    """The offset that the last frame used."""

    host_ns: int
    offset_ns: float


class SenderClock:
    """The sender's time at any host time. One thread may observe while another asks. A `shared` one is the host's own."""

    def __init__(self, *, shared: bool = False) -> None:
        self._one_way = OneWayFilter()
        self._exchanges = ExchangeFilter()
        self._shared = shared
        self._base_ns: int | None = 0 if shared else None  # the first offset: the rest fits a float64 to below 1 ns
        self._line = OffsetLine(0, 0.0, uncertainty_ns=0.0) if shared else None  # one attribute: read whole by other threads
        self._mode: ClockMode = "shared" if shared else "none"
        self._first_ns: int | None = None
        self._used: _Used | None = None

    def observe(self, t_ns: int, host_ns: int) -> None:
        """Take one message: its time on the sender's clock and its arrival."""
        if not self._shared:
            self._first_ns = host_ns if self._first_ns is None else self._first_ns
            self._one_way.observe(host_ns, host_ns - t_ns - self._base(host_ns - t_ns))
            self._choose(host_ns)

    def guess(self, t_ns: int, host_ns: int) -> None:
        """Take one message that waited unread: better than nothing, until one arrives that did not."""
        if not self._shared:
            self._one_way.guess(host_ns, host_ns - t_ns - self._base(host_ns - t_ns))
            self._choose(host_ns)

    def exchange(self, exchange: Exchange) -> None:
        """Take one exchange; an impossible one is ignored."""
        if not exchange.possible or self._shared:
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
        self._mode = "one-way" if exchanged is None else "exchange"
        self._line = exchanged or self._one_way.line

    def to_sender_ns(self, host_ns: int) -> int:
        """The sender's time at a host time, slewed to the newest estimate without a step; host time before any message.

        For one thread, with host times that do not go back.
        """
        line, first_ns, base_ns = self._line, self._first_ns, self._base_ns
        if line is None or base_ns is None:
            return host_ns
        offset_ns = line.at(host_ns)
        if self._used is not None and first_ns is not None and host_ns - first_ns > SETTLING_NS:
            change_ns = offset_ns - self._used.offset_ns
            if abs(change_ns) < MAX_SLEWED_NS:
                max_ns = SLEW * (host_ns - self._used.host_ns)
                offset_ns = self._used.offset_ns + min(max(change_ns, -max_ns), max_ns)
        self._used = _Used(host_ns, offset_ns)
        return host_ns - base_ns - round(offset_ns)

    def latency_ns(self, t_ns: int, host_ns: int) -> float | None:
        """A message's delay: the whole of it where exchanges run, else its excess over the minimum; None before any."""
        line, base_ns = self._line, self._base_ns
        return None if line is None or base_ns is None else host_ns - t_ns - base_ns - line.at(host_ns)

    def late_ns(self, t_ns: int, host_ns: int) -> float:
        """A message's delay above the line of the arrivals alone; 0 before any message."""
        line, base_ns = self._one_way.line, self._base_ns
        return 0.0 if line is None or base_ns is None else host_ns - t_ns - base_ns - line.at(host_ns)

    @property
    def unheard(self) -> bool:
        """True before the first message that did not wait."""
        return self._one_way.guessed

    @property
    def synchronised(self) -> bool:
        """True while four-timestamp exchanges carry the offset."""
        return self._mode == "exchange"

    def summary(self) -> ClockSummary:
        """What is known of the clock now."""
        line = self._line
        if line is None or self._base_ns is None:
            return ClockSummary(self._mode)
        behind_ns = 0.0 if self._used is None else abs(line.at(self._used.host_ns) - self._used.offset_ns)
        uncertainty_ns = line.uncertainty_ns
        if self._mode == "one-way":
            uncertainty_ns = max(uncertainty_ns, self._one_way.all_above_ns) + LOCAL_DELAY_NS
        return ClockSummary(
            self._mode,
            offset_ms=(self._base_ns + line.offset_ns) / NS_PER_MS,
            drift_ppm=0.0 - line.drift * 1e6,
            uncertainty_ms=(uncertainty_ns + behind_ns) / NS_PER_MS if math.isfinite(uncertainty_ns) else None,
            exchanges=self._exchanges.count,
        )
