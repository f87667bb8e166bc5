"""A bench clock that jumps: samples in, the same samples on a clock without jumps out; no I/O.

A message that comes much too early, or a row of messages that are all late by the same, is a clock that was set anew.
The samples in doubt wait for the next ones: three that agree are a jump, and go on from where the old clock stood;
an early one that the next contradicts is refused; late ones that do not agree were queued, and go on as they are.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

from hilstar.attitude.clock import NS_PER_MS, NS_PER_S, OneWayFilter
from hilstar.attitude.packet import AttitudeSample, Refusal

ENOUGH = 3
LATE_FOR_NS = 100 * NS_PER_MS  # a queue can be late by the same for a moment
SURELY_A_JUMP_NS = NS_PER_S  # and never for as long as this
LEAST_NS = 5 * NS_PER_MS
AGREEMENT_NS = 2 * NS_PER_MS
UNSETTLED_NS = 100 * NS_PER_MS
SETTLED_AFTER = 50
LONGEST_DOUBT_NS = 250 * NS_PER_MS
# All late for so long, and ever later: t_ns stands or runs slow, and the past says nothing about it.
EVER_LATER_NS = 3 * LATE_FOR_NS
EVER_LATER = 10


@dataclass(frozen=True, slots=True)
class Arrived:
    """A sample, when it came (host time), its bytes, and why it is refused, if it is."""

    sample: AttitudeSample
    host_ns: int
    raw: bytes = b""
    refusal: Refusal | None = None


class JumpFilter:
    """Samples with the bench's times in, samples with continuous times out, in the order of arrival."""

    def __init__(self) -> None:
        self.correction_ns = 0  # continuous time minus the bench's
        self.jumps = 0
        self._model = OneWayFilter()
        self._base_ns: int | None = None
        self._usual_ns: deque[float] = deque(maxlen=256)  # how late messages are that raise no doubt
        self._limit_ns: float = UNSETTLED_NS
        self._agreement_ns: float = AGREEMENT_NS
        self._doubtful: list[tuple[Arrived, float]] = []
        self._near_ns = 0
        self._near_count = 0
        self._late_run_ns: list[float] = []  # how late each was since the last that was not

    def take(self, arrived: Arrived) -> list[Arrived]:
        """The samples that this one decides, itself among them unless it is in doubt."""
        host_ns = arrived.host_ns
        late_ns = self._late_ns(arrived)
        if abs(late_ns) <= self._limit_ns:
            return [*self._contradicted(), self._accept(arrived)]
        decided: list[Arrived] = []
        if self._doubtful and abs(late_ns - self._doubtful[0][1]) > self._agreement_ns:
            decided = self.release()
            late_ns = self._late_ns(arrived)
        self._doubtful.append((arrived, late_ns))
        if late_ns > 0:
            self._late_run_ns.append(late_ns)
        if self._is_jump(host_ns):
            decided += self._jump()
        return decided

    def expire(self, host_ns: int) -> list[Arrived]:
        """Samples in doubt that nothing followed."""
        if self._doubtful and host_ns - self._doubtful[-1][0].host_ns > LONGEST_DOUBT_NS:
            return self.release()
        return []

    def release(self) -> list[Arrived]:
        """The samples in doubt, as they are."""
        released = [self._accept(arrived) for arrived, _ in self._doubtful]
        self._doubtful.clear()
        return released

    def _contradicted(self) -> list[Arrived]:
        """The samples in doubt, once one came that is as late as usual: early ones were never true."""
        early = [item for item in self._doubtful if item[1] < 0]
        self._doubtful = [item for item in self._doubtful if item[1] >= 0]
        refused = [
            replace(
                arrived, refusal=Refusal("time", f"t_ns {arrived.sample.t_ns} is {-late / NS_PER_S:.3g} s ahead of the bench")
            )
            for arrived, late in early
        ]
        return refused + self.release()

    def _late_ns(self, arrived: Arrived) -> float:
        offset_ns = arrived.host_ns - arrived.sample.t_ns - self.correction_ns
        if self._base_ns is None or self._model.line is None:
            self._base_ns = offset_ns
            return 0.0
        return offset_ns - self._base_ns - self._model.line.at(arrived.host_ns)

    def _accept(self, arrived: Arrived) -> Arrived:
        late_ns = self._late_ns(arrived)
        offset_ns = arrived.host_ns - arrived.sample.t_ns - self.correction_ns
        self._model.observe(arrived.host_ns, offset_ns - (self._base_ns or 0))
        if abs(late_ns) <= self._limit_ns:
            self._near_ns = arrived.host_ns
            self._late_run_ns.clear()
            self._usual_ns.append(max(late_ns, 0.0))
            self._near_count += 1
            if self._near_count % SETTLED_AFTER == 0:
                self._settle()
        return replace(arrived, sample=replace(arrived.sample, t_ns=arrived.sample.t_ns + self.correction_ns))

    def _settle(self) -> None:
        usual_ns = sorted(self._usual_ns)
        most_ns = usual_ns[int(0.95 * len(usual_ns))]
        self._limit_ns = min(max(LEAST_NS, 2 * most_ns), UNSETTLED_NS)
        self._agreement_ns = max(AGREEMENT_NS, most_ns)

    def _is_jump(self, host_ns: int) -> bool:
        late_ns = self._doubtful[-1][1]
        run = self._late_run_ns
        if len(run) >= EVER_LATER and host_ns - self._near_ns > EVER_LATER_NS and run[-1] >= run[0]:
            return True
        if len(self._doubtful) < ENOUGH:
            return False
        long_enough = host_ns - self._doubtful[0][0].host_ns >= LATE_FOR_NS
        return late_ns < 0 or late_ns > SURELY_A_JUMP_NS or long_enough

    def _jump(self) -> list[Arrived]:
        """Carry the clock on: the least late of the samples in doubt is as late as the least late ever was."""
        self.correction_ns += round(min(late for _, late in self._doubtful))
        self.jumps += 1
        self._late_run_ns.clear()
        return self.release()
