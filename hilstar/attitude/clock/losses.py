"""What a sender's packets show of it, whatever they say: how many were lost on the way, and the
unit of their times; no I/O.

Laws of the count:
1. A sender counts its packets in `sequence`, by one each or by another constant; what is missing
   between the first and the
   newest was lost. One that comes late was not, and one that comes twice counts once.
2. `sequence` wraps at 2^32. A step back beyond RECENT, or ahead by more than MAX_GAP, is a sender
   that began anew.
3. A sender whose `sequence` never changes does not count.
"""

from collections import deque

from hilstar.attitude.wire.packet import U32
from hilstar.basics.notices import Notices
from hilstar.basics.units import NS_PER_S

RECENT = 256
MAX_GAP = 100_000
UNIT = "time-unit"
# How fast t_ns runs in units that senders confuse with nanoseconds.
UNITS = {
    1e-9: ("seconds", 10**9),
    1e-6: ("milliseconds", 10**6),
    1e-4: ("ticks of 10 us", 10**4),
    1e-3: ("microseconds", 10**3),
    1e-2: ("ticks of 100 ns", 100),
    1e3: ("picoseconds", 0),
}
UNIT_SHARE = 0.05  # of a pace: no simulation is by chance as near to a thousandth of real time
MIN_PACE_NS, MIN_PACE_PACKETS = NS_PER_S // 2, 5
MIN_TICKS, PATIENCE_NS = 20, 3 * NS_PER_S  # whole seconds advance by less in any short time
MAX_PACE_GAP_NS = NS_PER_S
OTHERS = 3  # paces in a row that are of no such unit: one may be uneven
# of the pace of a unit that was named: on a busy machine arrivals are uneven by a tenth of
# MIN_PACE_NS for seconds, and nothing else is between units and a sender that is put right
NAMED_SHARE = 0.5


class LossCount:
    """Counts packets that never came, from the `sequence` of those that did; `lost` falls where
    one comes late.
    """

    def __init__(self) -> None:
        self._closed = 0  # of senders that have begun anew since
        self._advance = 0  # of `sequence`, from the first packet to the newest
        self._came = 0  # packets after the first
        self._unit = 0  # the smallest step
        self._newest: int | None = None
        self._recent: deque[int] = deque(maxlen=RECENT)

    @property
    def lost(self) -> int:
        """Packets lost so far."""
        if not self._unit:
            return self._closed
        return self._closed + max(self._advance // self._unit - self._came, 0)

    def see(self, sequence: int) -> None:
        """Take the next packet that came."""
        newest = self._newest
        if newest is None:
            self._begin(sequence)
            return
        step = (sequence - newest + U32 // 2) % U32 - U32 // 2
        if (
            step == 0
            or (step < 0 and sequence in self._recent)
            or (sequence == 0 and not 0 < step <= RECENT)
        ):
            return  # 0: a message that does not count, among others that do
        if not -RECENT * max(self._unit, 1) <= step <= MAX_GAP * max(self._unit, 1):
            self._closed = self.lost
            self._begin(sequence)
            return
        self._came += 1
        self._recent.append(sequence)
        if step > 0:
            self._unit = min(step, self._unit) if self._unit else step
            self._advance += step
            self._newest = sequence

    def _begin(self, sequence: int) -> None:
        self._advance = self._came = self._unit = 0
        self._newest = sequence
        self._recent.clear()
        self._recent.append(sequence)


class TimeUnit:
    """Names the unit of a sender's times where it is not the nanosecond, by how fast they run
    against the host's clock.
    """

    def __init__(self, notices: Notices) -> None:
        self._notices = notices
        self._first: tuple[int, int] | None = None
        self._last_ns = 0
        self._packets = self._others = 0
        self.named = ""
        self._named_pace = 1.0

    def see(self, t_ns: int, host_ns: int) -> None:
        """Take the next packet's time as it was sent, and its arrival."""
        first = self._first
        if first is None or host_ns - self._last_ns > MAX_PACE_GAP_NS or t_ns < first[0]:
            self._first = (t_ns, host_ns)
            self._packets = 0
            self._last_ns = host_ns
            return
        self._last_ns = host_ns
        self._packets += 1
        passed_ns = host_ns - first[1]
        ticks = t_ns - first[0]
        if (
            passed_ns < MIN_PACE_NS
            or self._packets < MIN_PACE_PACKETS
            or (ticks < MIN_TICKS and passed_ns < PATIENCE_NS)
        ):
            return
        self._first = (t_ns, host_ns)
        self._packets = 0
        if ticks > 1:
            self._judge(ticks / passed_ns, UNIT_SHARE + 1 / ticks)

    def _judge(self, pace: float, share: float) -> None:
        for unit_pace, (name, factor) in UNITS.items():
            if abs(pace / unit_pace - 1) < share:
                send = "send nanoseconds" + (f": multiply by {factor}" if factor else "")
                line = (
                    f"t_ns runs at {pace:.3g} times real time: it is in {name}, not in nanoseconds;"
                    f" {send}"
                )
                self.named = name
                self._named_pace = unit_pace
                self._others = 0
                self._notices.begin(UNIT, line)
                return
        if self.named and abs(pace / self._named_pace - 1) < NAMED_SHARE:
            self._others = 0
            return
        self._others += 1
        if self._others < OTHERS:
            return
        self.named = ""
        self._notices.end(UNIT, "time-unit-right", f"t_ns runs at {pace:.3g} times real time")
