"""Which faults are on at a frame: those of the scenario at their times, and those that somebody asked for.

Anybody may ask, from any thread: the operator's console by name, the stream with a fault of its own. What was asked for begins
and ends with the next frame, so that a ledger has one moment for it, and a replay the same light. Memory is bounded: at most
MAX_ON faults are on at once, and MAX_ASKED requests wait; the others are refused.
"""

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from hilstar.bench.scenario import NO_SCENARIO, Scenario, lasts_ns
from hilstar.errors import InputError, did_you_mean
from hilstar.frame.fault_kinds import Fault, Glow, Gradient, MeasuredMap, Now
from hilstar.units import NS_PER_S

MAX_ON = 64
MAX_ASKED = 256
SURFACES = (Glow, Gradient, MeasuredMap)  # each is drawn over the whole image
MAX_SURFACES_ON = 8
FILE = "file"  # who starts what a scenario has a time for


@dataclass(frozen=True, slots=True)
class FaultChange:
    """A fault begins or ends at a moment of the run, ns from its zero, or falls between two frames; and who wanted that."""

    what: Literal["start", "end", "missed"]
    number: int
    fault: Fault
    t_ns: int
    who: str


@dataclass(slots=True)
class _Planned:
    """A fault that is to begin: `start_ns` of the run; None: with the next frame. It has a number once it is on."""

    fault: Fault
    who: str
    start_ns: int | None
    number: int = 0


class FaultSchedule:
    """The faults of a run whose frames last `frame_s` each.

    `prepare` is called with each fault of the scenario at once, and with each that is asked for before it is taken; it
    returns the fault that is to be drawn, and raises InputError for one that cannot be. `listen` hears of each beginning and
    end, on the frames' thread.
    """

    def __init__(
        self,
        scenario: Scenario = NO_SCENARIO,
        frame_s: float = 1 / 60,
        prepare: Callable[[Fault], Fault] = lambda fault: fault,
        listen: Callable[[FaultChange], None] = lambda change: None,
    ) -> None:
        self.scenario = scenario
        self._frame_ns = round(frame_s * NS_PER_S)
        self._prepare, self._listen = prepare, listen
        self._zero_ns: int | None = None
        self._last_ns: int | None = None
        self._count = 0
        self._lock = threading.Lock()
        self._asked: list[_Planned] = []
        self._stops: dict[str, str] = {}
        self._planned: list[_Planned] = []
        self._on: list[_Planned] = []
        self._listed: dict[str, Fault] = {}
        for fault, ready in zip(scenario.faults, scenario.prepared(prepare), strict=True):
            self._listed[fault.name] = ready
            if ready.at_s is not None:
                self._planned.append(_Planned(ready, FILE, round(ready.at_s * NS_PER_S)))

    # Called from any thread

    def names(self) -> list[str]:
        """The faults that can be started by name: those of the scenario, in its order."""
        return list(self._listed)

    def on(self) -> list[str]:
        """The names of the faults that are on, or asked for and yet to begin."""
        with self._lock:
            return [planned.fault.name for planned in (*self._on, *self._asked)]

    def start(self, name: str, who: str) -> None:
        """Begin a fault of the scenario with the next frame. Raises InputError for a name that is unknown, or on already."""
        fault = self._listed.get(name)
        if fault is None:
            known = ", ".join(self.names())
            advice = f"{did_you_mean(name, self.names())}known are {known}" if known else "the run has no scenario"
            raise InputError(f"no fault is called {name!r}; {advice}")
        self._ask(_Planned(fault, who, None))

    def ask(self, fault: Fault, who: str) -> None:
        """Begin a fault of somebody's own, at its `at_s` or with the next frame.

        Raises InputError where it cannot be drawn, its name is on, or too many are.
        """
        with self._lock:
            self._check_room(fault)  # before what takes time
        fault = self._prepare(fault)
        self._ask(_Planned(fault, who, None if fault.at_s is None else round(fault.at_s * NS_PER_S)))

    def stop(self, name: str, who: str = "") -> None:
        """End a fault with the next frame, whoever began it. Raises InputError for one that is not on."""
        with self._lock:
            waiting = [planned for planned in self._asked if planned.fault.name == name]
            for planned in waiting:
                self._asked.remove(planned)
            if any(planned.fault.name == name for planned in self._on):
                self._stops[name] = who
            elif not waiting:
                names = ", ".join(planned.fault.name for planned in self._on)
                raise InputError(f"the fault {name!r} is not on; " + (f"on are {names}" if names else "none is"))

    def _ask(self, wanted: _Planned) -> None:
        with self._lock:
            self._check_room(wanted.fault)
            self._asked.append(wanted)

    def _check_room(self, fault: Fault) -> None:
        """Refuse (InputError) a fault whose name is on, and one too many; the caller has the lock."""
        there = [planned.fault for planned in (*self._on, *self._asked)]
        if any(other.name == fault.name for other in there) and fault.name not in self._stops:
            raise InputError(f"the fault {fault.name!r} is on already; stop it first, or give another name")
        surfaces = sum(isinstance(other, SURFACES) for other in there)
        if isinstance(fault, SURFACES) and surfaces >= MAX_SURFACES_ON:
            raise InputError(f"{surfaces} gradients, glows and maps are on or wait; stop one first")
        if len(self._on) >= MAX_ON or len(self._asked) >= MAX_ASKED:
            raise InputError(f"{len(self._on)} faults are on and {len(self._asked)} wait; stop one first")

    # Called by the frames' thread

    def begin(self, t_ns: int) -> None:
        """Say which time is the run's zero, from which `at_s` counts; by default that of the first frame."""
        self._zero_ns = t_ns

    def at(self, t_ns: int) -> tuple[Now, ...]:
        """The faults that are on in the frame whose light begins at `t_ns`; begins and ends what is due."""
        if self._zero_ns is None:
            self._zero_ns = t_ns
        if not (self._asked or self._planned or self._on):
            return ()
        run_ns = t_ns - self._zero_ns
        with self._lock:
            changes, found = self._step(run_ns)
        for change in changes:
            self._listen(change)
        return found

    def _step(self, run_ns: int) -> tuple[list[FaultChange], tuple[Now, ...]]:
        changes: list[FaultChange] = []
        for planned in self._on[:]:
            if planned.fault.name in self._stops:
                self._on.remove(planned)
                changes.append(self._ended(planned, run_ns, self._stops[planned.fault.name]))
        self._stops.clear()
        self._admit(run_ns)
        found: list[Now] = []
        for planned in self._on[:]:
            since_ns = run_ns - (planned.start_ns or 0)
            share = share_on(planned.fault, since_ns, self._frame_ns)
            if share and not planned.number:
                self._count += 1
                planned.number = self._count
                changes.append(FaultChange("start", planned.number, planned.fault, run_ns, planned.who))
            if share:
                found.append(Now(planned.number, planned.fault, since_ns, share))
            elif since_ns > 0:
                self._on.remove(planned)
                if planned.number:
                    changes.append(self._ended(planned, run_ns, planned.who))
                elif self._last_ns is not None and (planned.start_ns or 0) > self._last_ns:
                    changes.append(FaultChange("missed", 0, planned.fault, run_ns, planned.who))
        self._last_ns = run_ns
        return changes, tuple(found)

    def _ended(self, planned: _Planned, run_ns: int, who: str) -> FaultChange:
        return FaultChange("end", planned.number, planned.fault, run_ns, who or planned.who)

    def _admit(self, run_ns: int) -> None:
        """Let in what may be on within this frame."""
        soon = [p for p in (*self._asked, *self._planned) if p.start_ns is None or p.start_ns < run_ns + 2 * self._frame_ns]
        names = {planned.fault.name for planned in self._on}
        for planned in soon:
            (self._asked if planned in self._asked else self._planned).remove(planned)
            if planned.fault.name in names or len(self._on) >= MAX_ON:
                continue  # the console was faster than the file
            late = planned.start_ns is not None and planned.who != FILE and planned.start_ns < run_ns
            if planned.start_ns is None or late:
                planned.start_ns = run_ns
            names.add(planned.fault.name)
            self._on.append(planned)


def share_on(fault: Fault, since_ns: int, frame_ns: int) -> float:
    """The part of a frame for which a fault is on that began `since_ns` before its light does; 0 where it is not.

    Light is drawn in proportion; any other fault is on or off, in the frame nearest to its beginning at least.
    """
    length_ns = lasts_ns(fault)
    if not fault.OF_LIGHT:
        begun = since_ns + frame_ns // 2 >= 0
        return float(begun and (length_ns is None or since_ns + frame_ns // 2 < max(length_ns, frame_ns)))
    begin_ns, end_ns = max(0, -since_ns), frame_ns if length_ns is None else min(frame_ns, length_ns - since_ns)
    return max(0, end_ns - begin_ns) / frame_ns
