"""A sender on this machine that stamps with the clock hilstar itself goes by: times are taken as they are; no I/O."""

from __future__ import annotations

from dataclasses import replace

from hilstar.attitude.clock.jumps import Arrived
from hilstar.attitude.wire.packet import Refusal
from hilstar.notices import Notices
from hilstar.units import NS_PER_S

FARTHEST_NS = NS_PER_S  # a sender may predict, or be late
MIN_FUTURE_NS = 5_000_000
PERSISTENT_NS = NS_PER_S  # a queue may be older for a moment
ENOUGH = 3
UNSHARED = "clock-not-shared"


class SharedTimes:
    """In the place of a `JumpFilter`: refuses what lies far in the future, and says once that a clock is not the host's."""

    correction_ns = 0
    jumps = 0
    slowness = spread_ns = 0.0

    def __init__(self, notices: Notices) -> None:
        self.clock_known = True
        self._notices = notices
        self._off_since_ns: int | None = None
        self._off = 0

    def take(self, arrived: Arrived) -> list[Arrived]:
        """The sample itself, refused where its time is more than FARTHEST_NS ahead of this machine's."""
        late_ns = arrived.host_ns - arrived.sample.t_ns
        self._look(arrived.host_ns, late_ns)
        if late_ns >= -FARTHEST_NS:
            return [arrived]
        refusal = Refusal("time", f"t_ns {arrived.sample.t_ns} is {-late_ns / NS_PER_S:.3g} s ahead of this machine's clock")
        return [replace(arrived, refusal=refusal)]

    def _look(self, host_ns: int, late_ns: int) -> None:
        if -MIN_FUTURE_NS <= late_ns <= FARTHEST_NS:
            self._off_since_ns, self._off = None, 0
            return
        if self._off_since_ns is None:
            self._off_since_ns = host_ns
        self._off += 1
        if self._off >= ENOUGH and host_ns - self._off_since_ns >= PERSISTENT_NS:
            which = f"{late_ns / NS_PER_S:.3f} s behind" if late_ns > 0 else f"{-late_ns / NS_PER_S:.3f} s ahead of"
            self._notices.begin(
                UNSHARED,
                f'[attitude] clock = "shared", but t_ns is {which} CLOCK_MONOTONIC of this machine:'
                ' stamp with that clock, or write clock = "estimated"',
            )

    def forgive(self) -> None:
        """No jump is ever counted."""

    def expire(self, host_ns: int) -> list[Arrived]:
        """Nothing waits."""
        return []

    def release(self) -> list[Arrived]:
        """Nothing waits."""
        return []
