"""A scenario file: faults by name and time, and the seed of what is random in them."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from hilstar.bench.faults.kinds import KINDS, REFERENCE, TYPE_WORDS, Fault, Gradient, MeasuredMap, fault_of
from hilstar.errors import InputError, shortened
from hilstar.reading import MAX_TOML_BYTES, parse_toml, read_text
from hilstar.toml_tables import Kind, Table, explained
from hilstar.units import NS_PER_S

ADVICE = f"give the path of a scenario file (see {REFERENCE})"
MAX_FAULTS = 256
MAX_SURFACES = 16  # 8 MB each on a full HD monitor


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
    """Where a fault stands: by its number, and its name where it has one."""
    name = table.get("name") if isinstance(table, dict) else None
    return f"[[fault]] {number} ({shortened(name, 40)}):" if isinstance(name, str) and name else f"[[fault]] {number}:"


def lasts_ns(fault: Fault) -> int | None:
    """How long a fault lasts; None without an end."""
    return None if fault.for_s is None else round(fault.for_s * NS_PER_S)
