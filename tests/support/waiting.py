"""Waiting for what another process or thread does: as short as it takes, and with an end."""

from __future__ import annotations

import contextlib
import functools
import math
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from hilstar.basics.process.scheduling import FIFO_PRIORITY
from hilstar.basics.units import NS_PER_S

# Ten times what anything here takes on an idle machine, for one that has ten times the work of its
# cores to do; what never comes costs a failing test this long.
PATIENCE_S = 300
INSTALLED_WITHIN_S = 1800  # what pip brings, from a registry that may be slow
CHANCES = 3
MAX_HELD_UP_S = 20.0
LOOK_S = 0.02
ESTABLISHED = "01"  # in /proc/net/tcp


def wait_for(holds: Callable[[], object], what: object = "", poll_s: float = 0.05) -> None:
    """Return once `holds()` is true; an AssertionError that says `what` after PATIENCE_S."""
    deadline_s = time.monotonic() + PATIENCE_S
    while not holds():
        assert time.monotonic() < deadline_s, what
        time.sleep(poll_s)


class TooLate(AssertionError):
    """What was to be in time was not: because of the program, or because the machine stood still
    or was busy elsewhere.
    """


def in_time(holds: object, what: object = "") -> None:
    """Raise TooLate unless it holds: for what a machine that stands still for half a second
    breaks.
    """
    if not holds:
        raise TooLate(what)


def best_of_three(reason: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """A test whose program was TooLate has two more chances, each in a folder of its own: a fault
    of the program stays.

    Only for claims of time that the program makes, and only what is asked through `in_time`; all
    else fails at once. `reason` says what of this machine, that the test cannot measure, makes it
    late.
    """
    assert reason

    def decorate(test: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(test)
        def best(*values: object, **named: object) -> None:
            for attempt in range(CHANCES):
                again = dict(named)
                if isinstance(folder := named.get("tmp_path"), Path):
                    again["tmp_path"] = folder / f"attempt{attempt}"
                    (folder / f"attempt{attempt}").mkdir()
                try:
                    return test(*values, **again)
                except TooLate:
                    if attempt == CHANCES - 1:
                        raise
            return None

        return best

    return decorate


class CoreWaits:
    """How long a process, what it has begun and this one have waited for a core while this is open:
    `s`.

    Linux counts it for each thread (proc(5), schedstat); a kernel that does not gives 0. Waits of
    threads at the same time add up, so at most MAX_HELD_UP_S count: what never comes fails on any
    machine, and what is late on an idle one at once.
    """

    def __init__(self, pid: int) -> None:
        self._roots = {pid, os.getpid()}
        self._first: dict[str, int] = {}
        self._last: dict[str, int] = {}
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)

    @property
    def s(self) -> float:
        """Seconds so far."""
        waited_ns = sum(last - self._first[thread] for thread, last in list(self._last.items()))
        return min(waited_ns / NS_PER_S, MAX_HELD_UP_S)

    def _run(self) -> None:
        self._look(self._roots)
        while not self._stop.wait(LOOK_S):
            self._look(self._roots)
        self._look(self._roots)

    def _look(self, processes: set[int]) -> None:
        for process in processes:
            tasks: list[Path] = []
            with contextlib.suppress(OSError):  # it has ended
                tasks = list(Path(f"/proc/{process}/task").glob("*"))
            for task in tasks:
                with contextlib.suppress(OSError, IndexError):  # it has ended
                    waited_ns = int((task / "schedstat").read_text().split()[1])
                    self._first.setdefault(str(task), waited_ns)
                    self._last[str(task)] = waited_ns
                    # what else this one has begun is no part of the claim
                    if process != os.getpid():
                        self._look(set(map(int, (task / "children").read_text().split())))

    def __enter__(self) -> CoreWaits:
        self._thread.start()
        return self

    def __exit__(self, *raised: object) -> None:
        self._stop.set()
        self._thread.join()


def missed_in(waited_s: float, refresh_hz: float = 60.0) -> int:
    """How many frames a run misses while its process waits for a core."""
    return math.ceil(waited_s * refresh_hz)


def is_connected_to(port: int) -> bool:
    """Whether somebody on this machine has a TCP connection to that port of it."""
    rows = (line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:])
    return any(row[3] == ESTABLISHED and int(row[2].rpartition(":")[2], 16) == port for row in rows)


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
    """This thread, and the processes that it starts meanwhile, at real-time priority where that is
    allowed.

    For what stands for hardware (a display, a diode and its line): what else the machine has to do
    holds up neither.
    """
    policy = os.sched_getscheduler(0), os.sched_getparam(0)
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(FIFO_PRIORITY))
    try:
        yield
    finally:
        os.sched_setscheduler(0, *policy)
