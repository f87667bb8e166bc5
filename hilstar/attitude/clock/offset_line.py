"""Offsets between two clocks: host time minus sender time, ns, as a line over host time; no I/O."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.units import NS_PER_S

WINDOW_NS = 30 * NS_PER_S
SLOT_NS = NS_PER_S // 4
MIN_DRIFT_SPAN_NS = 2 * NS_PER_S  # over a shorter span, 50 us of noise would read as more than 25 ppm
MAX_DRIFT = 0.002  # ten times the worst crystal's; a steeper slope is a step, or t_ns is not a clock


@dataclass(frozen=True, slots=True)
class OffsetLine:
    """offset(host) = offset_ns + drift (host - host_ns), known to `uncertainty_ns`."""

    host_ns: int
    offset_ns: float
    drift: float = 0.0
    uncertainty_ns: float = math.inf

    def at(self, host_ns: int) -> float:
        """The offset at a host time, ns."""
        return self.offset_ns + self.drift * (host_ns - self.host_ns)


def plausible_drift(slope: float) -> float:
    """The slope itself, or 0 where it is steeper than any clock drifts."""
    return slope if abs(slope) <= MAX_DRIFT else 0.0


class Slot(NamedTuple):
    """The message with the smallest offset within SLOT_NS."""

    number: int
    host_ns: int
    offset_ns: int


class Slots(deque[Slot]):
    """The smallest offset of each slot, oldest first."""

    def lower(self, host_ns: int, offset_ns: int) -> bool:
        """Take a message into the newest slot; False, and nothing taken, where it begins a new one."""
        number = host_ns // SLOT_NS
        if not self or self[-1].number != number:
            return False
        if offset_ns < self[-1].offset_ns:
            self[-1] = Slot(number, host_ns, offset_ns)
        return True

    def begin(self, host_ns: int, offset_ns: int) -> None:
        """Begin a new slot with this message."""
        self.append(Slot(host_ns // SLOT_NS, host_ns, offset_ns))

    def relative_to(self, origin: Slot) -> tuple[FloatArray, FloatArray]:
        """Host times and offsets (n,), ns, from those of `origin`."""
        x = np.array([slot.host_ns - origin.host_ns for slot in self], dtype=np.float64)
        y = np.array([slot.offset_ns - origin.offset_ns for slot in self], dtype=np.float64)
        return x, y
