"""A frame loop that its own process does not interrupt: scheduling, Python's lock, and the garbage collector."""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

FIFO_PRIORITY = 10
# How long another thread may keep Python's lock from the frame loop; 5 ms by default, a third of a frame.
SWITCH_INTERVAL_S = 0.0005


@contextmanager
def steady_loop() -> Iterator[str]:
    """Run this thread at real-time priority where that is allowed; yields the scheduling that it got.

    Python's garbage collector is off meanwhile: the frame path makes no cycles (tests/screen/test_screen_run.py measures
    it), and a full collection would take a frame's time.
    """
    interval_s = sys.getswitchinterval()
    policy = os.sched_getscheduler(0), os.sched_getparam(0)
    collecting = gc.isenabled()
    scheduling = raise_priority()
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield scheduling
    finally:
        if collecting:
            gc.enable()
        gc.unfreeze()
        sys.setswitchinterval(interval_s)
        if scheduling.startswith("SCHED_FIFO"):
            os.sched_setscheduler(0, *policy)


def raise_priority() -> str:
    """Give this thread real-time priority where that is allowed; the scheduling that it got."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(FIFO_PRIORITY))
    except (OSError, AttributeError) as error:
        return f"normal: SCHED_FIFO is not allowed ({getattr(error, 'strerror', error)}); give this user rtprio in limits.conf"
    return f"SCHED_FIFO {FIFO_PRIORITY}"
