"""Waiting for a moment of the host's clock, stoppable."""

from __future__ import annotations

import threading
import time

from hilstar.attitude.clock import NS_PER_S

LONGEST_WAIT_S = 3600.0  # the platform's own limit is some centuries; a wait is begun anew


def wait_until(due_ns: int, stop: threading.Event) -> bool:
    """Wait until `time.monotonic_ns()` reaches `due_ns`; True when stopped before."""
    while (wait_s := (due_ns - time.monotonic_ns()) / NS_PER_S) > 0:
        if stop.wait(min(wait_s, LONGEST_WAIT_S)):
            return True
    return stop.is_set()
