"""When and where the kernel runs what must not wait: the frame loop, a process that stamps
arrivals.

`HostClock` waits for a moment of the host's clock.
"""

import contextlib
import ctypes
import gc
import os
import platform
import resource
import struct
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

FIFO_PRIORITY = 10  # of 1 to 99, all of which are above every ordinary process
# How long another thread may keep Python's lock from the frame loop; 5 ms by default, a third of a
# frame.
SWITCH_INTERVAL_S = 0.0005
PROMPT_PRIORITY = FIFO_PRIORITY + 1
HEAVY = 0.3
LOOK_S = 0.25
SHORT_SLICE_NS = 100_000  # the shortest that the kernel gives
# Linux's numbers of a call that the C library does not have
SCHED_SETATTR = {"x86_64": 314, "aarch64": 274}
# sched_setattr(2): size, policy, flags, nice, priority, runtime, deadline, period
SCHED_ATTRIBUTES = struct.Struct("=IIQiIQQQ")

MAX_WAIT_S = 3600.0  # the platform's own limit is some centuries; a longer wait is done in parts
# An event wakes up to 0.1 ms late, and the thread then waits for Python's lock: the last of a wait
# is slept without either.
COARSE_NS = 700_000
NS_PER_S = 1_000_000_000

CLOCK_TRIES, NEAR_NS = 3, 20_000
# NTP_PHASE_LIMIT of linux/timex.h: what the kernel states where nothing disciplines its clock
UNDISCIPLINED_NS = 16 * NS_PER_S

Clock = Callable[[], float]


class Timex(ctypes.Structure):
    """The first fields of adjtimex(2)'s structure, and room for the others; times in us."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        *((name, ctypes.c_long) for name in ("offset", "freq", "maxerror")),
        ("others", ctypes.c_byte * 256),
    )


class UnixOffset(NamedTuple):
    """CLOCK_MONOTONIC minus CLOCK_REALTIME, ns, and the largest error of CLOCK_REALTIME that the
    kernel states, ns.
    """

    offset_ns: int
    error_ns: int


class HostClock:
    """The clock that times a run: `time.monotonic_ns()`."""

    def now_ns(self) -> int:
        """The time now."""
        return time.monotonic_ns()

    def thread_cpu_ns(self) -> int:
        """How long this thread has had a core, ns: beside other work less than has passed."""
        return time.thread_time_ns()

    def asleep_ns(self) -> int:
        """How long the machine has slept since it was switched on; CLOCK_MONOTONIC stands still
        meanwhile.
        """
        return time.clock_gettime_ns(time.CLOCK_BOOTTIME) - time.clock_gettime_ns(
            time.CLOCK_MONOTONIC
        )

    def realtime_ns(self) -> int:
        """The time that the machine's calendar shows, ns since 1970; somebody may set it."""
        return time.time_ns()

    def monotonic_minus_realtime_ns(self) -> int:
        """The offset between the two clocks of this machine, both read within a few microseconds
        where that succeeds.
        """
        best_ns = None
        offset_ns = 0
        for _ in range(CLOCK_TRIES):
            before_ns = self.now_ns()
            realtime_ns = self.realtime_ns()
            after_ns = self.now_ns()
            took_ns = after_ns - before_ns
            if best_ns is None or took_ns < best_ns:
                best_ns = took_ns
                offset_ns = (before_ns + after_ns) // 2 - realtime_ns
            if took_ns < NEAR_NS:
                break
        return offset_ns

    def unix_offset(self) -> UnixOffset:
        """The offset to Unix time, and how wrong that may be: what NTP or PTP told the kernel
        (adjtimex, `maxerror`).
        """
        kernel_clock = Timex()  # modes = 0: nothing is set
        uncertainty_ns = UNDISCIPLINED_NS
        if ctypes.CDLL(None).adjtimex(ctypes.byref(kernel_clock)) >= 0:
            uncertainty_ns = kernel_clock.maxerror * 1000  # from microseconds
        return UnixOffset(self.monotonic_minus_realtime_ns(), uncertainty_ns)

    def sleep(self, seconds: float) -> None:
        """Do nothing for a while; nothing for 0 or less."""
        if seconds > 0:
            time.sleep(seconds)

    def within(self, seconds: float) -> "Deadline":
        """The moment that is so many seconds from now."""
        return Deadline(self, self.now_ns() + round(seconds * 1e9))

    def wait_until(self, due_ns: int, stop: threading.Event) -> bool:
        """Wait until the clock reaches `due_ns`; True if stopped before that."""
        while (wait_ns := due_ns - self.now_ns() - COARSE_NS) > 0:
            if stop.wait(min(wait_ns / NS_PER_S, MAX_WAIT_S)):
                return True
        if (rest_ns := due_ns - self.now_ns()) > 0:
            time.sleep(rest_ns / NS_PER_S)
        return stop.is_set()


class Deadline:
    """A moment of a clock."""

    def __init__(self, clock: HostClock, due_ns: int) -> None:
        self._clock = clock
        self._due_ns = due_ns

    @property
    def left_s(self) -> float:
        """How long it is until then; 0 once it is past."""
        return max(0, self._due_ns - self._clock.now_ns()) / 1e9

    @property
    def over(self) -> bool:
        """Whether it has come."""
        return self._clock.now_ns() >= self._due_ns


class BackOff(Deadline):
    """The moment of the next try: at once, then `min_s` after a failure, and twice as long after
    each further one.
    """

    def __init__(self, min_s: float, max_s: float, clock: HostClock) -> None:
        super().__init__(clock, clock.now_ns())
        self._min_s = min_s
        self._max_s = max_s
        self._wait_s = min_s

    def put_off(self, *, anew: bool = False) -> None:
        """The try failed; `anew` for the first failure after all was well."""
        wait_s = self._min_s if anew else self._wait_s
        self._due_ns = self._clock.now_ns() + round(wait_s * 1e9)
        self._wait_s = min(2 * wait_s, self._max_s)


HOST_CLOCK = HostClock()


@contextmanager
def steady_loop() -> Iterator[str]:
    """Run this thread at real-time priority where that is allowed; yields the scheduling that it
    got.

    Python's garbage collector is off meanwhile: the frame path makes no cycles
    (tests/screen/test_screen_run.py measures it), and a full collection would take a frame's time.
    """
    interval_s = sys.getswitchinterval()
    policy = os.sched_getscheduler(0), os.sched_getparam(0)
    collecting = gc.isenabled()
    scheduling = raise_priority()
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    gc.collect()
    gc.disable()
    try:
        yield scheduling
    finally:
        if collecting:
            gc.enable()
        sys.setswitchinterval(interval_s)
        if scheduling.startswith("SCHED_FIFO"):
            try:
                os.sched_setscheduler(0, *policy)
            except PermissionError:
                # the kernel lets nobody but an administrator take that flag back
                os.sched_setscheduler(0, policy[0] | os.SCHED_RESET_ON_FORK, policy[1])


def raise_priority() -> str:
    """Give this thread real-time priority where that is allowed; the scheduling that it got.

    What it starts has the normal one: a process that runs a user's code would else keep a core from
    everything.
    """
    try:
        os.sched_setscheduler(
            0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(FIFO_PRIORITY)
        )
    except (OSError, AttributeError) as error:
        return (
            f"normal: SCHED_FIFO is not allowed ({getattr(error, 'strerror', error)}); give this"
            " user rtprio in limits.conf"
        )
    return f"SCHED_FIFO {FIFO_PRIORITY}"


class PromptWhileLight:
    """A process that only wakes, stamps and sleeps again is woken before all others; one that works
    for long is not.

    Real-time priority above the frame loop's where that is allowed; else the shortest slice of the
    normal scheduler, which Linux 6.12 and later gives anybody (a task that asks for less runs
    sooner). While the process takes more than HEAVY of a core, as in a flood, its priority is the
    normal one, so that it takes no frame's time.
    """

    def __init__(self, wall_s: Clock = time.monotonic, cpu_s: Clock = time.process_time) -> None:
        number = SCHED_SETATTR.get(platform.machine())
        if number is not None:
            asked = SCHED_ATTRIBUTES.pack(
                SCHED_ATTRIBUTES.size, os.SCHED_OTHER, 0, os.nice(0), 0, SHORT_SLICE_NS, 0, 0
            )
            with contextlib.suppress(OSError, AttributeError):  # an older kernel refuses
                ctypes.CDLL(None).syscall(
                    number, 0, ctypes.create_string_buffer(asked, len(asked)), 0
                )
        self._prompt = _set_all_threads(os.SCHED_FIFO, PROMPT_PRIORITY)
        self._allowed = self._prompt
        self._wall_s = wall_s
        self._cpu_s = cpu_s
        self._looked_s = wall_s()
        self._used_s = cpu_s()

    def give_up(self) -> None:
        """Drop the real-time priority of this process, and of what it starts: it is about to run a
        user's code.
        """
        _set_all_threads(os.SCHED_OTHER, 0)
        self._allowed = self._prompt = False
        with contextlib.suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))

    def tend(self) -> None:
        """Look how much the process has done; quick, so that it may be called often."""
        now_s = self._wall_s()
        if not self._allowed or now_s - self._looked_s < LOOK_S:
            return
        used_s = self._cpu_s()
        heavy = used_s - self._used_s > HEAVY * (now_s - self._looked_s)
        self._looked_s = now_s
        self._used_s = used_s
        if heavy and self._prompt:
            self._prompt = not _set_all_threads(os.SCHED_OTHER, 0)
        elif not heavy and not self._prompt:
            self._prompt = _set_all_threads(os.SCHED_FIFO, PROMPT_PRIORITY)


def _set_all_threads(policy: int, priority: int) -> bool:
    """Whether every thread of this process has this scheduling now; those to come inherit it."""
    try:
        for thread in Path("/proc/self/task").iterdir():
            with contextlib.suppress(ProcessLookupError):
                os.sched_setscheduler(int(thread.name), policy, os.sched_param(priority))
    except (OSError, AttributeError):
        return False
    return True
