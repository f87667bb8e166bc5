"""A trigger pulse for the tracker at each frame, from a separate thread, because a line may be
slow.
"""

import threading
import time
from collections import Counter
from collections.abc import Callable
from typing import Self

from hilstar.attitude.wire.serial_link import LOST, RtsLine
from hilstar.basics.errors import one_line
from hilstar.basics.notices import Notices
from hilstar.basics.process.closing import Closing
from hilstar.basics.process.scheduling import HOST_CLOCK, BackOff, raise_priority
from hilstar.basics.running_statistics import RunningStatistics
from hilstar.basics.units import NS_PER_MS, NS_PER_S
from hilstar.server.bench.config import SyncSettings
from hilstar.server.pulse_summary import SyncSummary

# A frame waits this long for the thread to take over, which would otherwise wait 0.5 ms or more for
# Python's lock.
HANDOVER_S = 0.0005
MIN_BACK_OFF_S, MAX_BACK_OFF_S = 0.1, 2.0
END_S = 1.0
LAST_S = 0.25  # for the last pulse of a run: what follows has a second, after a signal


class FramePulse(Closing):
    """Raises a line at every `every_frames`th frame for `pulse_ms`, and never keeps a frame
    waiting. End it with `close`.

    A frame that comes while the line is still busy, or lost, has no pulse; a lost line is opened
    again, with back-off. `counted` hears what becomes of each, from any thread: "sent", "skipped"
    or "lost".
    """

    def __init__(self, line: RtsLine, settings: SyncSettings, notices: Notices) -> None:
        self._line = line
        self._pulse_ns = round(settings.pulse_ms * NS_PER_MS)
        self._every = settings.every_frames
        self._notices = notices
        self._wanted = threading.Event()
        self._taken = threading.Event()
        self._idle = threading.Event()
        self._idle.set()
        self._frame_ns = 0
        self._ends = False
        self._delay_ms = RunningStatistics()
        self._line_ms = RunningStatistics()
        self._counts: Counter[str] = Counter()
        self.counted: Callable[[str], None] = lambda what: None
        self._retry = BackOff(MIN_BACK_OFF_S, MAX_BACK_OFF_S, HOST_CLOCK)
        self._thread = threading.Thread(target=self._run, name="hilstar-pulse", daemon=True)
        self._thread.start()

    @classmethod
    def of(cls, settings: SyncSettings, notices: Notices) -> Self:
        """The pulse that a bench file asks for. Raises InputError where its port cannot be had."""
        return cls(RtsLine(str(settings.port), settings.active == "high"), settings, notices)

    def frame(self, number: int, frame_ns: int) -> None:
        """Start the pulse of frame `number`, whose time stamp (host, ns) is `frame_ns`; waits at
        most HANDOVER_S.
        """
        if number % self._every:
            return
        if not self._idle.is_set():
            self._count("skipped")
            return
        self._idle.clear()
        self._taken.clear()
        self._frame_ns = frame_ns
        self._wanted.set()
        self._taken.wait(HANDOVER_S)

    def _run(self) -> None:
        raise_priority()
        while True:
            self._wanted.wait()
            self._wanted.clear()
            if self._ends:
                return
            if self._line.is_open:
                self._pulse()
            else:
                self._taken.set()
                self._count("skipped")
                self._reopen()
            self._idle.set()

    def _pulse(self) -> None:
        try:
            self._taken.set()
            begin_ns = time.monotonic_ns()
            self._line.set(True)
            set_ns = time.monotonic_ns()
            # From when the line is known to be raised: a trigger may be wider than asked for, but
            # not narrower.
            time.sleep(max(set_ns + self._pulse_ns - time.monotonic_ns(), 0) / NS_PER_S)
            self._line.set(False)
        except LOST as error:
            self._count("lost")
            self._count("skipped")
            why = one_line(str(error))
            self._notices.tell(
                "sync-lost",
                f"[sync] port {self._line.port} is gone ({why}): frames go on without their pulse",
            )
            self._line.close()
            self._retry.put_off(anew=True)
            return
        self._count("sent")
        self._delay_ms.add((begin_ns - self._frame_ns) / NS_PER_MS)
        self._line_ms.add((set_ns - begin_ns) / NS_PER_MS)

    def _count(self, what: str) -> None:
        self._counts[what] += 1
        self.counted(what)

    def _reopen(self) -> None:
        if not self._retry.over:
            return
        try:
            self._line.open()
        except LOST:
            self._line.close()
            self._retry.put_off()
            return
        self._notices.tell("sync-back", f"[sync] port {self._line.port} is back")

    def summary(self) -> SyncSummary:
        """The pulses so far, with one that lasts."""
        self._idle.wait(LAST_S)
        delay = self._delay_ms
        line = self._line_ms
        return SyncSummary(
            port=self._line.port,
            pulses=delay.count,
            skipped=self._counts["skipped"],
            lost=self._counts["lost"],
            delay_ms=delay.mean,
            jitter_ms=delay.deviation,
            max_delay_ms=delay.max if delay.count else None,
            line_ms=line.mean,
        )

    def close(self) -> None:
        """End the pulse that lasts, and close the port with the line at rest; one that hangs is
        left to the process's end.
        """
        self._idle.wait(END_S)
        self._ends = True
        self._wanted.set()
        self._thread.join(END_S)
        if not self._thread.is_alive():
            self._line.close()
