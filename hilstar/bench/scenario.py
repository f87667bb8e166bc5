"""A scenario: the file of faults with their times and the seed of their randomness, and which are on at a moment."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from hilstar.errors import InputError, shortened
from hilstar.frame.fault_kinds import (
    KINDS,
    REFERENCE,
    TYPE_WORDS,
    CosmicRays,
    Drop,
    Fault,
    Freeze,
    Gradient,
    MeasuredMap,
    Now,
    fault_of,
)
from hilstar.reading import MAX_TOML_BYTES, parse_toml, read_text
from hilstar.toml_tables import Kind, Table, explained
from hilstar.units import NS_PER_S

ADVICE = f"give the path of a scenario file (see {REFERENCE})"
MAX_FAULTS = 256
MAX_SURFACES = 16  # 8 MB each on a full HD monitor
MAX_EDGES = 2000  # within one exposure


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
        """When the last fault with a beginning and an end of its own is over; 0 where there is none."""
        return max((f.at_s + f.for_s for f in self.faults if f.at_s is not None and f.for_s is not None), default=0.0)

    def prepared(self, prepare: Callable[[Fault], Fault]) -> list[Fault]:
        """The faults as `prepare` returns them. Raises InputError with the file and the fault where `prepare` does."""
        found = []
        for fault in self.faults:
            try:
                found.append(prepare(fault))
            except InputError as error:
                raise InputError(f"{self.path}: [[fault]] ({fault.name}): {error}") from error
        return found


NO_SCENARIO = Scenario(Path(), "")


def read_scenario(path: Path) -> Scenario:
    """Read and check a scenario. Raises InputError: file, fault, key, what is wrong and what to write."""
    return parse_scenario(path, read_text(path, ADVICE, MAX_TOML_BYTES))


def parse_scenario(path: Path, text: str) -> Scenario:
    """Check the text of a scenario file. Raises InputError as `read_scenario` does."""
    tables = parse_toml(path, text)
    try:
        head = msgspec.convert(tables, Head)
    except (msgspec.ValidationError, RecursionError) as error:
        if isinstance(tables.get("fault"), dict):
            raise InputError(f"{path}: [fault] is one table; write [[fault]] above each fault") from error
        raise InputError(f"{path}: {explained(str(error), tables, Kind(Head, REFERENCE, TYPE_WORDS))}") from error
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
                f'{path}: {_place(number, table)} another fault has name = "{fault.name}"; write a name of its own'
            )
        faults.append(fault)
    wide = sum(isinstance(fault, Gradient | MeasuredMap) for fault in faults)
    if wide > MAX_SURFACES:
        raise InputError(f"{path}: has {wide} gradients and maps, each an image of its own; write at most {MAX_SURFACES}")
    if not faults:
        raise InputError(f"{path}: has no fault; write [[fault]] tables, with kind = one of {', '.join(KINDS)}")
    return Scenario(path, text, head.seed, tuple(faults), path.parent)


def _place(number: int, table: Any) -> str:
    """The number of a fault in its file, with its name if it has one."""
    name = table.get("name") if isinstance(table, dict) else None
    return f"[[fault]] {number} ({shortened(name, 40)}):" if isinstance(name, str) and name else f"[[fault]] {number}:"


def lasts_ns(fault: Fault) -> int | None:
    """How long a fault lasts; None without an end."""
    return None if fault.for_s is None else round(fault.for_s * NS_PER_S)


@dataclass(frozen=True, slots=True)
class ScheduledFault:
    """A fault with a time of its own: from `begin_ns` to `end_ns` of the run (None: to its end)."""

    number: int
    fault: Fault
    begin_ns: int
    end_ns: int | None


class Timetable:
    """When the faults of a scenario are on that begin by themselves, for whoever looks at moments and not at frames in a row.

    `prepare` is called with each fault. Raises InputError where that does.
    """

    def __init__(self, scenario: Scenario, prepare: Callable[[Fault], Fault], exposure_s: float) -> None:
        self._exposure_ns = round(exposure_s * NS_PER_S)
        self._entries = []
        for number, fault in enumerate(scenario.prepared(prepare), start=1):
            if fault.at_s is not None:
                begin_ns, length_ns = round(fault.at_s * NS_PER_S), lasts_ns(fault)
                self._entries.append(
                    ScheduledFault(number, fault, begin_ns, None if length_ns is None else begin_ns + length_ns)
                )

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
            stuck = [
                one
                for one in self.on(at_ns)
                if isinstance(one.fault, Freeze) or (isinstance(one.fault, Drop) and one.fault.share == 1)
            ]
            if not stuck:
                return since_ns
            since_ns = min(at_ns - one.since_ns for one in stuck)
