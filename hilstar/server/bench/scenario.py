"""A scenario: the file of faults with their times and the seed of their randomness, and which are
on at a moment.

`FaultSchedule` has the faults of a run: those of the scenario at their times, and those that
somebody asked for. Anybody may ask, from any thread: the operator's console by name, the stream
with a fault of its own. What was asked for begins
and ends with the next frame, so that a ledger has one moment for it, and a replay the same light.
Memory is bounded: at most MAX_ON faults are on at once, and MAX_ASKED requests wait; the others are
refused.
"""

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from hilstar.basics.errors import InputError, did_you_mean, shortened
from hilstar.basics.reading import MAX_TOML_BYTES, parse_toml, read_text
from hilstar.basics.toml_tables import Kind, Table, explained
from hilstar.basics.units import NS_PER_S
from hilstar.optics.layers.fault_kinds import (
    KINDS,
    REFERENCE,
    TYPE_WORDS,
    CosmicRays,
    Drop,
    Fault,
    Freeze,
    Glow,
    Gradient,
    MeasuredMap,
    Now,
    fault_of,
)

ADVICE = f"give the path of a scenario file (see {REFERENCE})"
MAX_FAULTS = 256
MAX_SURFACES = 16  # 8 MB each on a full HD monitor
MAX_EDGES = 2000  # within one exposure
MAX_ON = 64
MAX_ASKED = 256
SURFACES = (Glow, Gradient, MeasuredMap)  # each is drawn over the whole image
MAX_SURFACES_ON = 8
FILE = "file"  # who starts what a scenario has a time for


class Head(Table, frozen=True):
    """The keys of a scenario beside its faults."""

    seed: Annotated[int, Meta(ge=0, le=2**63 - 1)] = 0
    fault: list[Any] = msgspec.field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Scenario:
    """A scenario at the moment it was read; `folder` is where the files that it names are."""

    path: Path
    text: str
    seed: int = 0
    faults: tuple[Fault, ...] = ()
    folder: Path = field(default_factory=Path)

    @property
    def end_s(self) -> float:
        """When the last fault with a beginning and an end of its own is over; 0 where there is
        none.
        """
        end_s = 0.0
        for fault in self.faults:
            if fault.at_s is not None and fault.for_s is not None:
                end_s = max(end_s, fault.at_s + fault.for_s)
        return end_s

    def prepared(self, prepare: Callable[[Fault], Fault]) -> list[Fault]:
        """The faults as `prepare` returns them. Raises InputError with the file and the fault
        where `prepare` does.
        """
        prepared_faults = []
        for fault in self.faults:
            try:
                prepared_faults.append(prepare(fault))
            except InputError as error:
                raise InputError(f"{self.path}: [[fault]] ({fault.name}): {error}") from error
        return prepared_faults


NO_SCENARIO = Scenario(Path(), "")


def read_scenario(path: Path) -> Scenario:
    """Read and check a scenario. Raises InputError: file, fault, key, what is wrong and what to
    write.
    """
    return parse_scenario(path, read_text(path, ADVICE, MAX_TOML_BYTES))


def parse_scenario(path: Path, text: str) -> Scenario:
    """Check the text of a scenario file. Raises InputError as `read_scenario` does."""
    tables = parse_toml(path, text)
    try:
        head = msgspec.convert(tables, Head)
    except (msgspec.ValidationError, RecursionError) as error:
        if isinstance(tables.get("fault"), dict):
            raise InputError(
                f"{path}: [fault] is one table; write [[fault]] above each fault"
            ) from error
        raise InputError(
            f"{path}: {explained(str(error), tables, Kind(Head, REFERENCE, TYPE_WORDS))}"
        ) from error
    if len(head.fault) > MAX_FAULTS:
        raise InputError(f"{path}: has {len(head.fault)} faults; write at most {MAX_FAULTS}")
    faults: list[Fault] = []
    for number, table in enumerate(head.fault, start=1):
        try:
            fault = fault_of(table)
        except InputError as error:
            raise InputError(f"{path}: {_place(number, table)} {error}") from error
        if any(other.name == fault.name for other in faults):
            raise InputError(
                f'{path}: {_place(number, table)} another fault has name = "{fault.name}"; write a'
                " name of its own"
            )
        faults.append(fault)
    wide = sum(isinstance(fault, Gradient | MeasuredMap) for fault in faults)
    if wide > MAX_SURFACES:
        raise InputError(
            f"{path}: has {wide} gradients and maps, each an image of its own; write at most"
            f" {MAX_SURFACES}"
        )
    if not faults:
        raise InputError(
            f"{path}: has no fault; write [[fault]] tables, with kind = one of {', '.join(KINDS)}"
        )
    return Scenario(path, text, head.seed, tuple(faults), path.parent)


def _place(number: int, table: Any) -> str:
    """The number of a fault in its file, with its name if it has one."""
    if isinstance(table, dict):
        name = table.get("name")
    else:
        name = None
    if isinstance(name, str) and name:
        return f"[[fault]] {number} ({shortened(name, 40)}):"
    return f"[[fault]] {number}:"


def lasts_ns(fault: Fault) -> int | None:
    """How long a fault lasts; None without an end."""
    if fault.for_s is None:
        return None
    return round(fault.for_s * NS_PER_S)


@dataclass(frozen=True, slots=True)
class ScheduledFault:
    """A fault with a time of its own: from `begin_ns` to `end_ns` of the run (None: to its end)."""

    number: int
    fault: Fault
    begin_ns: int
    end_ns: int | None


class Timetable:
    """When the faults of a scenario are on that begin by themselves, for whoever looks at moments
    and not at frames in a row.

    `prepare` is called with each fault. Raises InputError where that does.
    """

    def __init__(
        self, scenario: Scenario, prepare: Callable[[Fault], Fault], exposure_s: float
    ) -> None:
        self._exposure_ns = round(exposure_s * NS_PER_S)
        self._entries = []
        for number, fault in enumerate(scenario.prepared(prepare), start=1):
            if fault.at_s is not None:
                begin_ns = round(fault.at_s * NS_PER_S)
                length_ns = lasts_ns(fault)
                self._entries.append(
                    ScheduledFault(
                        number, fault, begin_ns, None if length_ns is None else begin_ns + length_ns
                    )
                )

    def on(self, t_ns: int, since_ns: int | None = None) -> tuple[Now, ...]:
        """The faults that are on at a moment, each as long as it has been on at `since_ns` (by
        default then).
        """
        at_ns = t_ns if since_ns is None else since_ns
        there = [
            e for e in self._entries if e.begin_ns <= t_ns and (e.end_ns is None or t_ns < e.end_ns)
        ]
        return tuple(Now(e.number, e.fault, at_ns - e.begin_ns) for e in there)

    def edges_ns(self, begin_ns: int, end_ns: int) -> list[int]:
        """The ends of the pieces of a time within which nothing begins, ends or is renewed; the
        time's own among them.
        """
        edges = {begin_ns, end_ns}
        for entry in self._entries:
            marks = [entry.begin_ns]
            if entry.end_ns is not None:
                marks.append(entry.end_ns)
            if isinstance(entry.fault, CosmicRays):
                first = max(0, (begin_ns - entry.begin_ns) // self._exposure_ns)
                marks += [entry.begin_ns + k * self._exposure_ns for k in range(first, first + 3)]
            edges.update(mark for mark in marks if begin_ns < mark < end_ns)
        return sorted(edges)[:MAX_EDGES]

    def stands_since_ns(self, t_ns: int) -> int | None:
        """When the display began to show the same frame as at a moment, by faults that overlap;
        None where it goes on.
        """
        since_ns = None
        while True:
            at_ns = t_ns if since_ns is None else since_ns - 1
            stuck = [active for active in self.on(at_ns) if _stops_frames(active.fault)]
            if not stuck:
                return since_ns
            since_ns = min(at_ns - active.since_ns for active in stuck)


def _stops_frames(fault: Fault) -> bool:
    """Whether the display shows the frame before for as long as the fault is on."""
    return isinstance(fault, Freeze) or (isinstance(fault, Drop) and fault.share == 1)


@dataclass(frozen=True, slots=True)
class FaultChange:
    """A fault begins or ends at a moment of the run, ns from its zero, or falls between two
    frames; and who wanted that.
    """

    what: Literal["start", "end", "missed"]
    number: int
    fault: Fault
    t_ns: int
    who: str


@dataclass(slots=True)
class _Planned:
    """A fault that is to begin: `start_ns` of the run; None: with the next frame. It has a
    number once it is on.
    """

    fault: Fault
    who: str
    start_ns: int | None
    number: int = 0


class FaultSchedule:
    """The faults of a run whose frames last `frame_s` each.

    `prepare` is called with each fault of the scenario at once, and with each that is asked for
    before it is taken; it returns the fault that is to be drawn, and raises InputError for one that
    cannot be. `listen` hears of each beginning and end, on the frames' thread.
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
        self._prepare = prepare
        self._listen = listen
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
        """Begin a fault of the scenario with the next frame. Raises InputError for a name that
        is unknown, or on already.
        """
        fault = self._listed.get(name)
        if fault is None:
            known = ", ".join(self.names())
            if known:
                advice = f"{did_you_mean(name, self.names())}known are {known}"
            else:
                advice = "the run has no scenario"
            raise InputError(f"no fault is called {name!r}; {advice}")
        self._ask(_Planned(fault, who, None))

    def ask(self, fault: Fault, who: str) -> None:
        """Begin a fault of somebody's own, at its `at_s` or with the next frame.

        Raises InputError where it cannot be drawn, its name is on, or too many are.
        """
        with self._lock:
            self._check_room(fault)  # before what takes time
        fault = self._prepare(fault)
        self._ask(
            _Planned(fault, who, None if fault.at_s is None else round(fault.at_s * NS_PER_S))
        )

    def stop(self, name: str, who: str = "") -> None:
        """End a fault with the next frame, whoever began it. Raises InputError for one that is
        not on.
        """
        with self._lock:
            waiting = [planned for planned in self._asked if planned.fault.name == name]
            for planned in waiting:
                self._asked.remove(planned)
            if any(planned.fault.name == name for planned in self._on):
                self._stops[name] = who
            elif not waiting:
                names = ", ".join(planned.fault.name for planned in self._on)
                raise InputError(
                    f"the fault {name!r} is not on; " + (f"on are {names}" if names else "none is")
                )

    def _ask(self, wanted: _Planned) -> None:
        with self._lock:
            self._check_room(wanted.fault)
            self._asked.append(wanted)

    def _check_room(self, fault: Fault) -> None:
        """Refuse (InputError) a fault whose name is on, and one too many; the caller has the
        lock.
        """
        there = [planned.fault for planned in (*self._on, *self._asked)]
        if any(other.name == fault.name for other in there) and fault.name not in self._stops:
            raise InputError(
                f"the fault {fault.name!r} is on already; stop it first, or give another name"
            )
        surfaces = sum(isinstance(other, SURFACES) for other in there)
        if isinstance(fault, SURFACES) and surfaces >= MAX_SURFACES_ON:
            raise InputError(f"{surfaces} gradients, glows and maps are on or wait; stop one first")
        if len(self._on) >= MAX_ON or len(self._asked) >= MAX_ASKED:
            raise InputError(
                f"{len(self._on)} faults are on and {len(self._asked)} wait; stop one first"
            )

    # Called by the frames' thread

    def begin(self, t_ns: int) -> None:
        """Say which time is the run's zero, from which `at_s` counts; by default that of the
        first frame.
        """
        self._zero_ns = t_ns

    def at(self, t_ns: int) -> tuple[Now, ...]:
        """The faults that are on in the frame whose light begins at `t_ns`; begins and ends what
        is due.
        """
        if self._zero_ns is None:
            self._zero_ns = t_ns
        if not (self._asked or self._planned or self._on):
            return ()
        run_ns = t_ns - self._zero_ns
        with self._lock:
            changes, active = self._step(run_ns)
        for change in changes:
            self._listen(change)
        return active

    def _step(self, run_ns: int) -> tuple[list[FaultChange], tuple[Now, ...]]:
        changes: list[FaultChange] = []
        for planned in self._on[:]:
            if planned.fault.name in self._stops:
                self._on.remove(planned)
                changes.append(self._ended(planned, run_ns, self._stops[planned.fault.name]))
        self._stops.clear()
        self._admit(run_ns)
        active: list[Now] = []
        for planned in self._on[:]:
            since_ns = run_ns - (planned.start_ns or 0)
            share = share_on(planned.fault, since_ns, self._frame_ns)
            if share and not planned.number:
                self._count += 1
                planned.number = self._count
                changes.append(
                    FaultChange("start", planned.number, planned.fault, run_ns, planned.who)
                )
            if share:
                active.append(Now(planned.number, planned.fault, since_ns, share))
            elif since_ns > 0:
                self._on.remove(planned)
                if planned.number:
                    changes.append(self._ended(planned, run_ns, planned.who))
                elif self._last_ns is not None and (planned.start_ns or 0) > self._last_ns:
                    changes.append(FaultChange("missed", 0, planned.fault, run_ns, planned.who))
        self._last_ns = run_ns
        return changes, tuple(active)

    def _ended(self, planned: _Planned, run_ns: int, who: str) -> FaultChange:
        return FaultChange("end", planned.number, planned.fault, run_ns, who or planned.who)

    def _admit(self, run_ns: int) -> None:
        """Let in what may be on within this frame."""
        soon = []
        for p in (*self._asked, *self._planned):
            if p.start_ns is None or p.start_ns < run_ns + 2 * self._frame_ns:
                soon.append(p)
        names = {planned.fault.name for planned in self._on}
        for planned in soon:
            (self._asked if planned in self._asked else self._planned).remove(planned)
            if planned.fault.name in names or len(self._on) >= MAX_ON:
                continue  # the console was faster than the file
            late = (
                planned.start_ns is not None and planned.who != FILE and planned.start_ns < run_ns
            )
            if planned.start_ns is None or late:
                planned.start_ns = run_ns
            names.add(planned.fault.name)
            self._on.append(planned)


def share_on(fault: Fault, since_ns: int, frame_ns: int) -> float:
    """The part of a frame for which a fault is on that began `since_ns` before its light does; 0
    where it is not.

    Light is drawn in proportion; any other fault is on or off, in the frame nearest to its
    beginning at least.
    """
    length_ns = lasts_ns(fault)
    if not fault.OF_LIGHT:
        begun = since_ns + frame_ns // 2 >= 0
        return float(
            begun and (length_ns is None or since_ns + frame_ns // 2 < max(length_ns, frame_ns))
        )
    begin_ns = max(0, -since_ns)
    end_ns = frame_ns if length_ns is None else min(frame_ns, length_ns - since_ns)
    return max(0, end_ns - begin_ns) / frame_ns
