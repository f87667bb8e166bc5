"""The threads of a software OpenGL, each kept on a core of its own.

Mesa's llvmpipe begins as many as there are cores, once to rasterise and once to compute. They wait for work that takes a tenth
of a millisecond, and Linux then often wakes two of them on one core: frames of 1000 stars took 1.6 ms in place of 1.1 ms, of
10 000 stars 9 ms in place of 6.5 (two cores, nothing else running); beside a busy process on each core they take the same time.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

TASKS = Path("/proc/self/task")
RASTERISERS = "llvmpipe-"
LOOK_S = 1e-3
# A thread names itself, a little after it has begun: on a busy machine, when it is first given a core.
NAMING_S, BUSY_NAMING_S = 0.02, 0.5


@contextmanager
def drawing_threads_apart() -> Iterator[None]:
    """Keep each thread that llvmpipe begins in this context on a core of its own, where it begins one for each core."""
    before = _threads()
    yield
    begun_s = time.monotonic()
    while True:
        rasterisers, computing = _drawing_threads(before)
        if len(rasterisers) == len(computing):
            break
        may_be_llvmpipe = len(rasterisers) + len(computing) >= 2 * len(_cores())
        if time.monotonic() - begun_s > (BUSY_NAMING_S if may_be_llvmpipe else NAMING_S):
            break
        time.sleep(LOOK_S)
    for group in (rasterisers, computing):
        if len(group) == len(rasterisers):
            _spread(group)


def _drawing_threads(before: Collection[int]) -> tuple[list[int], list[int]]:
    """The threads begun since that rasterise, and those that compute."""
    begun = {thread: name for thread, name in sorted(_threads().items()) if thread not in before}
    rasterisers = [thread for thread, name in begun.items() if name.startswith(RASTERISERS)]
    # Those that compute have the process's own name; others of the driver's have one with a colon.
    return rasterisers, [thread for thread, name in begun.items() if thread not in rasterisers and ":" not in name]


def _threads() -> dict[int, str]:
    """The names of this process's threads; none where there is no /proc."""
    names: dict[int, str] = {}
    with contextlib.suppress(OSError):
        for task in TASKS.iterdir():
            with contextlib.suppress(OSError):  # it has ended
                names[int(task.name)] = (task / "comm").read_text().strip()
    return names


def _cores() -> list[int]:
    """Those that this process may run on; none where the system does not say."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []


def _spread(threads: list[int]) -> None:
    """A core for each thread, if there are as many cores as threads."""
    cores = _cores()
    if len(threads) < 2 or len(threads) != len(cores):
        return
    for thread, core in zip(threads, cores, strict=True):
        with contextlib.suppress(OSError):  # it has ended, or may not be told
            os.sched_setaffinity(thread, {core})
