"""What a plan varies: a key of the bench file by its dotted name, or one of the case's own, and its value at a point."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from typing import Any

import msgspec

from hilstar.bench.bench_file import BenchFile, changed_file
from hilstar.campaign.plan.tables import Plan, Varied
from hilstar.errors import InputError, shortened
from hilstar.reading import parse_toml

# What a case has beside its bench file. Rates are of cam with respect to icrs, cam components; `across` is about an axis
# in the image plane whose direction each case draws. `misalignment_arcsec` turns the display's true mounting about cam's axes.
OWN_KEYS = (
    "rate_deg_s.x",
    "rate_deg_s.y",
    "rate_deg_s.z",
    "rate_deg_s.across",
    "misalignment_arcsec.x",
    "misalignment_arcsec.y",
    "misalignment_arcsec.z",
    "time_s",
    "noise_seed",
    "scenario",
)
MAX_OWN = {"rate_deg_s": 360.0, "misalignment_arcsec": 36_000.0, "time_s": 9e9, "noise_seed": 2.0**63 - 1}
WHOLE = ("noise_seed",)
SCENARIO = "scenario"  # the path of a file of faults, or none where it is empty
Value = float | int | bool | str


@dataclass(frozen=True, slots=True)
class Parameter:
    """One varied key: its values in order, or its range. `whole` ones are rounded to whole numbers."""

    key: str
    values: tuple[Any, ...] = ()
    minimum: float = 0.0
    maximum: float = 1.0
    log: bool = False
    whole: bool = False

    def value(self, share: float) -> Any:
        """The value at a place in [0, 1)."""
        if self.values:
            return self.values[min(int(share * len(self.values)), len(self.values) - 1)]
        low, high = (math.log(end) for end in (self.minimum, self.maximum)) if self.log else (self.minimum, self.maximum)
        value = low + share * (high - low)
        value = min(max(math.exp(value), self.minimum), self.maximum) if self.log else value
        return round(value) if self.whole else value

    @property
    def own(self) -> bool:
        """Whether it belongs to the case, and not to the bench file."""
        return self.key in OWN_KEYS


def parameters(plan: Plan, file: BenchFile) -> list[Parameter]:
    """The plan's parameters, each tried at its ends in the bench file alone. Raises InputError for what that refuses."""
    tables = parse_toml(file.path, file.text)
    found = []
    for varied in plan.vary:
        parameter = _parameter(varied, file)
        ends = parameter.values or (parameter.value(0.0), parameter.value(1.0))
        for value in ends:
            try:
                _check(parameter, value, file, tables)
            except InputError as error:
                raise InputError(f'[[vary]] key = "{shortened(varied.key)}": {error}') from error
        found.append(parameter)
    return found


def grid_levels(plan: Plan) -> list[int]:
    """How many values each key of a grid has."""
    return [len(varied.values or ()) or varied.steps or 1 for varied in plan.vary]


def changed_bench(file: BenchFile, tables: dict[str, Any], values: dict[str, Any]) -> BenchFile:
    """The bench file with some keys (dotted name -> value) changed. Raises InputError as the file itself would."""
    changes = {key: value for key, value in values.items() if key not in OWN_KEYS}
    if not changes:
        return file
    tables = copy.deepcopy(tables)
    for key, value in changes.items():
        _set(tables, key.split("."), value, file.config)
    return changed_file(file, tables)


def _parameter(varied: Varied, file: BenchFile) -> Parameter:
    whole = varied.key in WHOLE or (varied.values is None and _is_whole(varied.key, file.config))
    if varied.values is not None:
        return Parameter(varied.key, tuple(varied.values))
    if varied.minimum is None or varied.maximum is None:
        raise AssertionError("the plan has been checked")
    if varied.steps is None:
        return Parameter(varied.key, (), varied.minimum, varied.maximum, varied.scale == "log", whole)
    ends = Parameter(varied.key, (), varied.minimum, varied.maximum, varied.scale == "log", whole)
    return Parameter(varied.key, tuple(ends.value(step / max(1, varied.steps - 1)) for step in range(varied.steps)))


def _check(parameter: Parameter, value: Any, file: BenchFile, tables: dict[str, Any]) -> None:
    if not parameter.own:
        changed_bench(file, tables, {parameter.key: value})
        return
    if parameter.key == SCENARIO:
        if not isinstance(value, str):
            raise InputError(f'the value {shortened(value)}; write paths of scenario files, and "" for none')
        return
    largest = MAX_OWN[parameter.key.split(".")[0]]
    low = 0 if parameter.key in WHOLE else -largest
    if (
        isinstance(value, bool)
        or not isinstance(value, int if parameter.key in WHOLE else int | float)
        or not low <= value <= largest
    ):
        raise InputError(f"the value {shortened(value)}; write a number from {low:g} to {largest:g}")


def _is_whole(key: str, config: Any) -> bool:
    value = _now(key.split("."), config)
    if isinstance(value, tuple) and value:
        value = value[0]
    return isinstance(value, int) and not isinstance(value, bool)


def _now(names: list[str], config: Any) -> Any:
    """What the bench file has there, defaults included; None where it has nothing."""
    for name in names:
        if isinstance(config, tuple):
            config = config[int(name)] if name.isdigit() and int(name) < len(config) else None
        elif isinstance(config, msgspec.Struct):
            config = getattr(config, name, None)
        else:
            return None
    return config


def _set(tables: dict[str, Any], names: list[str], value: Any, config: Any) -> None:
    """Set the key of dotted `names`; one number for a key of several, such as a sigma along x and y, is given to each."""
    table: Any = tables
    for name in names[:-1]:
        inside = table.get(name) if isinstance(table, dict) else None
        if inside is None or not isinstance(inside, dict | list):
            present = _now(names[: names.index(name) + 1], config)
            inside = list(present) if isinstance(present, tuple) else {}
            table[name] = inside
        table = inside
    last = names[-1]
    present = _now(names, config)
    if isinstance(present, tuple) and not isinstance(value, list):
        value = [value] * len(present)
    if isinstance(table, list):
        if not last.isdigit() or int(last) >= len(table):
            raise InputError(f"{'.'.join(names)}: write a number from 0 to {len(table) - 1} after the last dot")
        table[int(last)] = value
    else:
        table[last] = value
