"""A sender on this machine that stamps with the clock hilstar itself uses: its times are taken as they are; no I/O."""

from __future__ import annotations

from dataclasses import replace

from hilstar.attitude.wire.links import SampleArrival
from hilstar.attitude.wire.packet import Refusal
from hilstar.notices import Notices
from hilstar.units import NS_PER_MS, NS_PER_S

MAX_OFF_NS = NS_PER_S  # a sender may predict, or be late
MIN_FUTURE_NS = 5 * NS_PER_MS
PERSISTENT_NS = NS_PER_S  # a queue may be older for a moment
MIN_OFF = 3
UNSHARED = "clock-not-shared"


class SharedClockFilter:
    """Takes the place of a `JumpFilter`: refuses times far ahead, and says once where the clock is not the host's."""

    correction_ns = 0
    jumps = 0
    slowness = 0.0

    def __init__(self, notices: Notices) -> None:
        self._notices = notices
        self._off_since_ns: int | None = None
        self._off = 0

    def take(self, arrival: SampleArrival) -> list[SampleArrival]:
        """The sample itself, refused where its time is more than MAX_OFF_NS ahead of this machine's."""
        t_ns = arrival.event.t_ns
        late_ns = arrival.host_ns - t_ns
        self._look(arrival.host_ns, late_ns)
        if late_ns >= -MAX_OFF_NS:
            return [arrival]
        refusal = Refusal("time", f"t_ns {t_ns} is {-late_ns / NS_PER_S:.3g} s ahead of this machine's clock")
        return [replace(arrival, refusal=refusal)]

    def _look(self, host_ns: int, late_ns: int) -> None:
        if -MIN_FUTURE_NS <= late_ns <= MAX_OFF_NS:
            self._off_since_ns, self._off = None, 0
            return
        if self._off_since_ns is None:
            self._off_since_ns = host_ns
        self._off += 1
        if self._off >= MIN_OFF and host_ns - self._off_since_ns >= PERSISTENT_NS:
            where = f"{late_ns / NS_PER_S:.3f} s behind" if late_ns > 0 else f"{-late_ns / NS_PER_S:.3f} s ahead of"
            self._notices.begin(
                UNSHARED,
                f'[attitude] clock = "shared", but t_ns is {where} CLOCK_MONOTONIC of this machine:'
                ' stamp with that clock, or write clock = "estimated"',
            )

    def forgive(self) -> None:
        """Jumps are never counted."""

    def expire(self, host_ns: int) -> list[SampleArrival]:
        """Nothing waits."""
        return []

    def release(self) -> list[SampleArrival]:
        """Nothing waits."""
        return []
