"""What a run watches: whether an attitude is there, how long each stage of a frame takes, and
whether the GPU is well.
"""

import threading
from typing import Self

from hilstar.attitude.clock.timeline import Attitude
from hilstar.basics.notices import Notices
from hilstar.basics.process.scheduling import HOST_CLOCK, HostClock
from hilstar.basics.units import NS_PER_MS, NS_PER_S
from hilstar.display.render.backend import Backend

NONE_YET_NS = 2 * NS_PER_S
LOOK_S = 0.25
STUCK_NS = NS_PER_S
# A frame is reported as late after this many refresh periods and this many ms; shorter delays
# happen on any busy machine.
LATE_PERIODS = 3.0
LATE_NS = 50 * NS_PER_MS
TOLD_EVERY_NS = NS_PER_S
GPU_LOST = "gpu-lost"
GPU_LOOK_NS = NS_PER_S
# two clocks read one after the other, with the process interrupted between them, differ by less
SLEPT_NS = 200 * NS_PER_MS


class AttitudeWatch:
    """Watches the attitude of each frame, before an operator's keys change it."""

    def __init__(self, notices: Notices, clock: HostClock = HOST_CLOCK) -> None:
        self._notices = notices
        self._clock = clock
        self._begun_ns: int | None = None
        self._seen = self._missed = False
        self._stale_ns: int | None = None  # since when, host time

    def see(self, attitude: Attitude | None, stale: bool) -> None:
        """Take the next frame's attitude (None if none has come yet), and whether it is too old."""
        now_ns = self._clock.now_ns()
        if self._begun_ns is None:
            self._begun_ns = now_ns
        for_s = (now_ns - self._begun_ns) / NS_PER_S
        if attitude is None:
            if not self._seen and not self._missed and now_ns - self._begun_ns > NONE_YET_NS:
                self._missed = True
                self._notices.tell(
                    "no-attitude", f"no attitude yet, for {for_s:.0f} s: the frames are blank"
                )
            return
        if not self._seen:
            self._seen = True
            self._notices.tell(
                "first-attitude", f"the first attitude has come, after {for_s:.1f} s"
            )
        if stale and self._stale_ns is None:
            self._stale_ns = now_ns
            self._notices.tell(
                "stale",
                f"the attitude is stale: the newest is {attitude.age_ns / NS_PER_S:.3g} s old",
            )
        elif not stale and self._stale_ns is not None:
            stale_s = (now_ns - self._stale_ns) / NS_PER_S
            self._stale_ns = None
            self._notices.tell("fresh", f"the attitude is fresh again, after {stale_s:.1f} s")


class FrameWatch:
    """Takes the stages of each frame from the loop's thread; a second thread reports a stage
    that does not end.
    """

    def __init__(self, period_ns: float, notices: Notices, clock: HostClock = HOST_CLOCK) -> None:
        self._late_ns = max(LATE_PERIODS * period_ns, LATE_NS)
        self._clock = clock
        self._notices = notices
        self._number = 0
        # name and begin; one list, so that the other thread reads a whole one
        self._stages: list[tuple[str, int]] = []
        self._told_ns = 0
        # when the loop last was between two stages, host time; 0 before its first frame
        self.alive_ns = 0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="hilstar-watchdog", daemon=True)

    def begin(self, number: int) -> None:
        """A frame begins, with its sprites."""
        self._number = number
        self.alive_ns = now_ns = self._clock.now_ns()
        self._stages = [("sprites", now_ns)]

    def enter(self, stage: str) -> None:
        """Its next stage begins."""
        self._stages.append((stage, self._clock.now_ns()))

    def end(self, timed: bool) -> None:
        """The frame is done, or given up; one that is not `timed` is never late."""
        now_ns = self._clock.now_ns()
        stages = self._stages
        self._stages = []
        self.alive_ns = now_ns
        if not timed or not stages or now_ns - stages[0][1] <= self._late_ns:
            return
        if now_ns - self._told_ns > TOLD_EVERY_NS:
            self._told_ns = now_ns
            took_ms = (now_ns - stages[0][1]) / NS_PER_MS
            ends = zip(stages, [*(begin for _, begin in stages[1:]), now_ns], strict=True)
            stage_times = ", ".join(
                f"{name} {(end - begin) / NS_PER_MS:.1f}" for (name, begin), end in ends
            )
            self._notices.tell(
                "frame-late", f"frame {self._number} took {took_ms:.0f} ms: {stage_times}"
            )

    def idle(self) -> None:
        """No frame is due, and the loop waits for one."""
        self.alive_ns = self._clock.now_ns()

    def _run(self) -> None:
        stuck: tuple[str, int] | None = None
        while not self._stop.wait(LOOK_S):
            stages = self._stages
            number = self._number
            if not stages or stages[-1] == stuck:
                continue
            now_ns = self._clock.now_ns()
            if now_ns - stages[-1][1] > STUCK_NS:
                stuck = stages[-1]
                self._notices.tell(
                    "frame-stuck",
                    f"frame {number} hangs in its stage {stuck[0]} since"
                    f" {(now_ns - stuck[1]) / NS_PER_S:.1f} s",
                )

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()


class GpuWatch:
    """Looks once a second, in the loop's thread and between its frames, whether the GPU is lost;
    then the run is stopped.

    After the machine has slept it also compares the tables that turn light into codes, and has the
    next frame drawn on black: a driver may lose the GPU's memory without an error.
    """

    def __init__(
        self,
        backend: Backend,
        notices: Notices,
        stop: threading.Event,
        clock: HostClock = HOST_CLOCK,
    ) -> None:
        self._backend = backend
        self._notices = notices
        self._stop = stop
        self._clock = clock
        backend.remember_tables()
        if fault := backend.fault():  # a fault from before the run
            notices.tell("gpu-error", f"before the first frame {fault}")
        self._asleep_ns = clock.asleep_ns()
        self._next_ns = clock.now_ns() + GPU_LOOK_NS

    def look(self) -> None:
        """Look, if a second has passed since the last time; microseconds, but after the machine
        has slept.
        """
        now_ns = self._clock.now_ns()
        if now_ns < self._next_ns:
            return
        self._next_ns = now_ns + GPU_LOOK_NS
        fault = self._backend.fault()
        before_ns = self._asleep_ns
        self._asleep_ns = self._clock.asleep_ns()
        if not fault and (slept_ns := self._asleep_ns - before_ns) > SLEPT_NS:
            self._notices.tell(
                "resumed",
                f"the machine slept for {slept_ns / NS_PER_S:.1f} s; the GPU's tables are compared",
            )
            changed = self._backend.changed_tables()
            self._backend.forget_images()
            if changed:
                fault = (
                    f"the GPU's memory was lost in sleep, {changed} of the tables that make codes"
                )
            else:
                fault = ""
        if fault:
            self.lost(fault)

    def lost(self, fault: str) -> None:
        """Stop the run."""
        self._notices.begin(GPU_LOST, f"{fault}: the run ends")
        self._stop.set()
