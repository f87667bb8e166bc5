"""Waiting for what another process or thread does: as short as it takes, and with an end."""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from hilstar.process.priority import FIFO_PRIORITY

# A machine whose cores are all busy takes seconds to start a command; what never comes costs a failing test this long.
PATIENCE_S = 30.0


def wait_for(holds: Callable[[], object], what: object = "", poll_s: float = 0.05) -> None:
    """Return once `holds()` is true; an AssertionError that says `what` after PATIENCE_S."""
    deadline_s = time.monotonic() + PATIENCE_S
    while not holds():
        assert time.monotonic() < deadline_s, what
        time.sleep(poll_s)


@contextmanager
def repeating(work: Callable[[], object], pause_s: float) -> Iterator[None]:
    """`work` called again and again, in a thread of its own, as long as this is open."""
    stop = threading.Event()

    def repeat() -> None:
        while not stop.wait(pause_s):
            work()

    thread = threading.Thread(target=repeat)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


@contextmanager
def real_time() -> Iterator[None]:
    """This thread, and the processes that it starts meanwhile, at real-time priority where that is allowed.

    For what stands for hardware (a display, a diode and its line): what else the machine has to do holds up neither.
    """
    policy = os.sched_getscheduler(0), os.sched_getparam(0)
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(FIFO_PRIORITY))
    try:
        yield
    finally:
        os.sched_setscheduler(0, *policy)
