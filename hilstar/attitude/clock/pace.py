"""How t_ns advances: its usual step from message to message, and its rate against the host's clock; no I/O."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from hilstar.attitude.clock.offset_line import Slots
from hilstar.attitude.wire.packet import AttitudeSample

PACE_SLOTS = 9
MIN_ODD_PACE = 0.004  # twice what a crystal is allowed: beyond it, and steadily, t_ns runs slow or fast
STEPS = 31
MIN_STEPS = 8
MAX_MISSING = 1000  # a sequence that advances by more does not count packets


class _Step(NamedTuple):
    """From one message to the next."""

    ns: int
    packets: int


class Steps:
    """By how much t_ns usually advances from one message to the next."""

    def __init__(self) -> None:
        self._last: AttitudeSample | None = None
        self._usual_ns: deque[float] = deque(maxlen=STEPS)
        self._newest = _Step(0, 1)

    def add(self, sample: AttitudeSample) -> None:
        """Take the next message, refused or not."""
        if self._last is not None:
            packets = sample.sequence - self._last.sequence
            self._newest = _Step(sample.t_ns - self._last.t_ns, packets if 1 <= packets <= MAX_MISSING else 1)
            self._usual_ns.append(self._newest.ns / self._newest.packets)
        self._last = sample

    def show_no_jump(self, by_ns: float) -> bool:
        """True where a jump by `by_ns` would show in the newest step of t_ns, and does not."""
        if len(self._usual_ns) < MIN_STEPS:
            return False
        usual_ns = np.array(self._usual_ns)
        period_ns = float(np.median(usual_ns))
        if np.median(np.abs(usual_ns - period_ns)) > abs(by_ns) / 4:
            return False
        newest = self._newest
        irregular_ns = min(abs(newest.ns - newest.packets * period_ns), abs(newest.ns - period_ns))
        return irregular_ns < abs(by_ns) / 2


class Pace:
    """The rate of the sender's clock, from the earliest messages of each slot of the last two seconds."""

    def __init__(self) -> None:
        self.slowness = 0.0
        self._slots = Slots(maxlen=PACE_SLOTS)

    def add(self, host_ns: int, offset_ns: int) -> None:
        """Take one message's arrival and (arrival - t_ns), as sent."""
        if self._slots.lower(host_ns, offset_ns):
            return
        if len(self._slots) == PACE_SLOTS:
            self._look()
        self._slots.begin(host_ns, offset_ns)

    def _look(self) -> None:
        """A slow or a fast clock drifts steadily; a jump or a queue is a step, and decides nothing."""
        x, y = self._slots.relative_to(self._slots[0])
        slope = y[-1] / x[-1]
        uneven_ns = np.abs(y - slope * x).max()
        if abs(slope) > MIN_ODD_PACE and uneven_ns < abs(y[-1]) / 5:
            self.slowness = float(slope)
        elif abs(slope) < MIN_ODD_PACE / 2 and uneven_ns < MIN_ODD_PACE * x[-1]:
            self.slowness = 0.0
