"""Availability, acquisition and loss of lock: which of the answers that were due came."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from hilstar.arrays import BoolArray, FloatArray
from hilstar.run.record.commanded import Commanded

MISSED_CYCLES = 1.5  # a longer time between right answers is an outage
LOST_CYCLES = 3.0  # in a longer outage the lock is lost
MAX_CYCLES = 20_000_000


@dataclass(frozen=True, slots=True)
class Outage:
    """A time without right answers: its start in run time and its length, s; `lost` if longer than LOST_CYCLES."""

    start_s: float
    length_s: float
    lost: bool
    rows: int
    wrong: int


@dataclass(frozen=True, slots=True)
class Acquisition:
    """The run time, s, at which a sky appeared, and the wait for the first right answer; None if none came before it went."""

    start_s: float
    wait_s: float | None


@dataclass(frozen=True)
class Lock:
    """The answers that were due and the right ones among them; `availability` is right over due."""

    cycle_s: float
    due: int
    right: int
    availability: float
    outages: tuple[Outage, ...]
    acquisitions: tuple[Acquisition, ...]

    @property
    def lost(self) -> tuple[Outage, ...]:
        """The outages in which the lock was lost."""
        return tuple(each for each in self.outages if each.lost)

    @property
    def acquisition_probability(self) -> float | None:
        """The share of appearances of a sky and losses of lock after which a right answer came."""
        if not self.acquisitions:
            return None
        return sum(each.wait_s is not None for each in self.acquisitions) / len(self.acquisitions)

    @property
    def acquisition_s(self) -> float | None:
        """The median time until the first right answer."""
        waits = [each.wait_s for each in self.acquisitions if each.wait_s is not None]
        return float(np.median(waits)) if waits else None


def lock_of(commanded: Commanded, t_s: FloatArray, right: BoolArray, wrong: BoolArray) -> Lock:
    """The lock over rows at rising run times (n,): right answers, wrong ones, and rows without an answer."""
    cycle_s = max(float(np.median(np.diff(t_s))), 1e-6)
    cycle_s = max(cycle_s, float(t_s[-1] - t_s[0]) / MAX_CYCLES)
    due = commanded.at(np.arange(t_s[0], t_s[-1] + cycle_s / 2, cycle_s)).known
    outages = []
    for before, after in pairwise(np.flatnonzero(right).tolist()):
        gap_s = float(t_s[after] - t_s[before])
        if gap_s <= MISSED_CYCLES * cycle_s:
            continue
        inner = np.arange(t_s[before] + cycle_s, t_s[after] - cycle_s / 2, cycle_s)
        if len(inner) and commanded.at(inner).known.mean() > 0.5:
            length_s, rows = gap_s - cycle_s, after - before - 1
            lost = length_s > LOST_CYCLES * cycle_s
            outages.append(Outage(float(inner[0]), length_s, lost, rows, int(wrong[before + 1 : after].sum())))
    # After each appearance of the sky during the telemetry, and after each loss of the lock.
    acquisitions = []
    shown = np.flatnonzero(np.diff(np.r_[False, commanded.joined].astype(int)) == 1)
    ends = np.flatnonzero(np.diff(np.r_[commanded.joined, False].astype(int)) == -1) + 1
    answers = t_s[right]
    for first, last in zip(commanded.t_s[shown], commanded.t_s[ends], strict=True):
        if last > t_s[0] and first < t_s[-1]:
            first = max(first, t_s[0])  # what the tracker did before its first row is unknown
            inside = answers[(answers >= first) & (answers <= last)]
            acquisitions.append(Acquisition(float(first), float(inside[0] - first) if len(inside) else None))
    acquisitions += [Acquisition(each.start_s, each.length_s) for each in outages if each.lost]
    return Lock(
        cycle_s=cycle_s,
        due=int(due.sum()),
        right=int(right.sum()),
        availability=min(int(right.sum()) / max(int(due.sum()), 1), 1.0),
        outages=tuple(outages),
        acquisitions=tuple(sorted(acquisitions, key=lambda each: each.start_s)),
    )
