"""A clock that stands still until somebody waits or works: runs of minutes in no time, to the
nanosecond.
"""

from __future__ import annotations

import threading
from collections.abc import Callable

from hilstar.basics.process.scheduling import HostClock


class FakeClock(HostClock):
    """Time passes by `work` and by waiting; each wait wakes `wakes_late_ns` after its moment."""

    def __init__(self, start_ns: int = 1_000_000_000, wakes_late_ns: int = 0) -> None:
        self.ns = start_ns
        self.held_up_ns = 0
        self.wakes_late_ns = wakes_late_ns
        self.waited_until: list[int] = []
        self.slept_s: list[float] = []

    def now_ns(self) -> int:
        return self.ns

    def thread_cpu_ns(self) -> int:
        return self.ns - self.held_up_ns

    def sleep(self, seconds: float) -> None:
        self.slept_s.append(seconds)
        self.work(seconds * 1e9)

    def work(self, ns: float) -> None:
        """Let time pass."""
        self.ns += round(ns)

    def hold_up(self, ns: float) -> None:
        """Let time pass in which other programs have the core."""
        self.work(ns)
        self.held_up_ns += round(ns)

    def wait_until(self, due_ns: int, stop: threading.Event) -> bool:
        if stop.is_set():
            return True
        self.waited_until.append(due_ns)
        if due_ns > self.ns:
            self.ns = due_ns + self.wakes_late_ns
        return False


class WellGpu:
    """What a screen and a frame loop ask of a renderer whose GPU is well."""

    def __init__(self, take_back_buffer: Callable[[], None] = lambda: None) -> None:
        self.take_back_buffer = take_back_buffer

    def show_on(self, view: object) -> None:
        """Any screen."""

    def present(self, *values: object) -> None:
        """At once."""

    def changed_codes(self) -> str:
        """None."""
        return ""

    def remember_tables(self) -> None:
        """Nothing to remember."""

    def fault(self) -> str:
        """All is well."""
        return ""
