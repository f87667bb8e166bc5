"""A scenario as a timetable, for what looks at moments and not at frames in a row: one frame, an exposure, the twin."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from hilstar.bench.faults.desk import Now
from hilstar.bench.faults.kinds import CosmicRays, Drop, Fault, Freeze
from hilstar.bench.faults.scenario import Scenario, lasts_ns
from hilstar.bench.faults.view import FaultView
from hilstar.units import NS_PER_S

MAX_EDGES = 2000  # within one exposure


@dataclass(frozen=True, slots=True)
class Entry:
    """A fault with a time of its own: from `begin_ns` to `end_ns` of the run (None: to its end)."""

    number: int
    fault: Fault
    begin_ns: int
    end_ns: int | None


class Timetable:
    """The faults of a scenario that begin by themselves, prepared for a view. Raises InputError (see `FaultView.prepare`)."""

    def __init__(self, scenario: Scenario, view: FaultView, exposure_s: float) -> None:
        self._exposure_ns = round(exposure_s * NS_PER_S)
        self._entries = []
        for number, fault in enumerate(view.prepared(scenario), start=1):
            if fault.at_s is not None:
                begin_ns, length_ns = round(fault.at_s * NS_PER_S), lasts_ns(fault)
                self._entries.append(Entry(number, fault, begin_ns, None if length_ns is None else begin_ns + length_ns))

    def on(self, t_ns: int, since_ns: int | None = None) -> tuple[Now, ...]:
        """The faults that are on at a moment, each as long as it has been on at `since_ns` (by default then)."""
        at_ns = t_ns if since_ns is None else since_ns
        there = [e for e in self._entries if e.begin_ns <= t_ns and (e.end_ns is None or t_ns < e.end_ns)]
        return tuple(Now(e.number, e.fault, at_ns - e.begin_ns) for e in there)

    def edges_ns(self, begin_ns: int, end_ns: int) -> list[int]:
        """The ends of the pieces of a time within which nothing begins, ends or is renewed; the time's own among them."""
        found = {begin_ns, end_ns}
        for entry in self._entries:
            marks = [entry.begin_ns, *([] if entry.end_ns is None else [entry.end_ns])]
            if isinstance(entry.fault, CosmicRays):
                first = max(0, (begin_ns - entry.begin_ns) // self._exposure_ns)
                marks += [entry.begin_ns + k * self._exposure_ns for k in range(first, first + 3)]
            found.update(mark for mark in marks if begin_ns < mark < end_ns)
        return sorted(found)[:MAX_EDGES]

    def stands_since_ns(self, t_ns: int) -> int | None:
        """When the display began to show the same frame as at a moment, by faults that overlap; None where it goes on."""
        since_ns = None
        while True:
            at_ns = t_ns if since_ns is None else since_ns - 1
            stuck = [one for one in self.on(at_ns) if isinstance(one.fault, Freeze) or _loses_all(one.fault)]
            if not stuck:
                return since_ns
            since_ns = min(at_ns - one.since_ns for one in stuck)

    def moments_ns(self) -> list[int]:
        """A moment of each time in which the same faults are on, in order; none of those in which nothing is."""
        marks = sorted({mark for e in self._entries for mark in (e.begin_ns, e.end_ns) if mark is not None})
        if any(e.end_ns is None for e in self._entries):
            marks.append(marks[-1] + 2 * self._exposure_ns)
        middles = (int(np.mean(pair)) for pair in itertools.pairwise(marks))
        return [middle for middle in middles if self.on(middle)]


def _loses_all(fault: Fault) -> bool:
    return isinstance(fault, Drop) and fault.share == 1
