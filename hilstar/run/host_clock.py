"""This host's monotonic clock, and waiting for a moment of it."""

from __future__ import annotations

import threading
import time

from hilstar.units import NS_PER_MS, NS_PER_S

MAX_WAIT_S = 3600.0  # the platform's own limit is some centuries; a longer wait is done in parts
# An event wakes up to 0.1 ms late, and the thread then waits for Python's lock: the last of a wait is slept without either.
COARSE_NS = round(0.7 * NS_PER_MS)


class HostClock:
    """The clock that times a run: `time.monotonic_ns()`."""

    def now_ns(self) -> int:
        """The time now."""
        return time.monotonic_ns()

    def asleep_ns(self) -> int:
        """How long the machine has slept since it was switched on; CLOCK_MONOTONIC stands still meanwhile."""
        return time.clock_gettime_ns(time.CLOCK_BOOTTIME) - time.clock_gettime_ns(time.CLOCK_MONOTONIC)

    def wait_until(self, due_ns: int, stop: threading.Event) -> bool:
        """Wait until the clock reaches `due_ns`; True if stopped before that."""
        while (wait_ns := due_ns - self.now_ns() - COARSE_NS) > 0:
            if stop.wait(min(wait_ns / NS_PER_S, MAX_WAIT_S)):
                return True
        if (rest_ns := due_ns - self.now_ns()) > 0:
            time.sleep(rest_ns / NS_PER_S)
        return stop.is_set()


HOST_CLOCK = HostClock()
