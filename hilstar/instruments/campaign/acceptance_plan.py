"""The plan of an acceptance: named sets of cases, each a campaign's plan, and the clauses that they
are judged by.

The file is TOML. `[cases.NAME]` has the keys of a campaign's plan but `bench`, `require` and
`through`; `quick_cases` is how many there are with --quick, and `sweep` makes them a sweep with an
edge. `[[clause]]` has the keys of `[[require]]`, the `capability` in a buyer's words, and `of`, the
name of its cases. `[[untested]]` says what no clause tests, and why.
"""

import copy
import re
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from hilstar.basics.errors import InputError, did_you_mean
from hilstar.basics.reading import MAX_TOML_BYTES, parse_toml, read_text
from hilstar.basics.resources import resource_path
from hilstar.basics.toml_tables import Kind, Table, explained, toml_text
from hilstar.instruments.campaign.cases import ON_BENCH
from hilstar.instruments.campaign.plan import (
    MAX_CASES,
    MAX_SEED,
    QUANTITY_COLUMNS,
    SCENARIO,
    TYPE_WORDS,
    PlantedFaults,
    Require,
    check_require,
)
from hilstar.instruments.campaign.sweep import SweepTable

NAME = re.compile(r"[a-z0-9][a-z0-9-]{0,39}")
OWN = ("about", "quick_cases", "sweep")  # keys of a set that are not a campaign's
GIVEN = ("bench", "require", "through", "planted")  # and those of a campaign that a set has not
ONLY_TRACKER = ("step_s", "noise", "centroids")  # of a virtual tracker, left out on a bench
ORBIT = "spacecraft.orbit"  # a path, which a campaign takes from the bench file's folder
PLANS = "plans"  # the folder of configs with plans that ship
Through = Literal["tracker", "display", "bench"]


class CaseKeys(Table, frozen=True):
    """The keys of [cases.NAME] that are not a campaign's."""

    about: Annotated[str, Meta(max_length=500)] = ""
    quick_cases: Annotated[int, Meta(ge=1, le=MAX_CASES)] | None = None
    sweep: SweepTable | None = None


class ClauseTable(Require, frozen=True, kw_only=True):
    """[[clause]]: a capability, the cases that show it, and its requirement."""

    capability: Annotated[str, Meta(min_length=1, max_length=200)]
    of: Annotated[str, Meta(min_length=1, max_length=40)]

    @property
    def require(self) -> Require:
        """The requirement alone."""
        names = [field.name for field in msgspec.structs.fields(Require)]
        return Require(**{name: getattr(self, name) for name in names})


class UntestedTable(Table, frozen=True, kw_only=True):
    """[[untested]]: a capability that no clause tests."""

    capability: Annotated[str, Meta(min_length=1, max_length=200)]
    why: Annotated[str, Meta(min_length=1, max_length=500)]


class AcceptanceTables(Table, frozen=True, kw_only=True):
    """A whole plan of an acceptance."""

    title: Annotated[str, Meta(max_length=200)] = "Acceptance"
    seed: Annotated[int, Meta(ge=0, le=MAX_SEED)] = 0
    through: Through = "tracker"
    planted: PlantedFaults | None = None
    cases: dict[str, dict[str, Any]]
    clause: Annotated[list[ClauseTable], Meta(min_length=1, max_length=256)]
    untested: Annotated[list[UntestedTable], Meta(max_length=256)] = msgspec.field(
        default_factory=list
    )


KIND = Kind(AcceptanceTables, "docs/accept.md", TYPE_WORDS)


@dataclass(frozen=True, slots=True)
class CaseSet:
    """A named set of cases: the tables of its campaign's plan, and its sweep, if it is one.

    `refused` says why it cannot be run here, "" where it can.
    """

    name: str
    about: str
    tables: dict[str, Any]
    sweep: SweepTable | None
    refused: str = ""

    def text(self, level: float | None = None) -> str:
        """The text of its campaign's plan, at a level of its sweep."""
        tables = copy.deepcopy(self.tables)
        if self.sweep is not None and level is not None:
            value: float | int = level
            if self.sweep.whole:
                value = round(level)
            varied = {"key": self.sweep.key, "values": [value]}
            tables["vary"] = [*tables.get("vary", []), varied]
        return toml_text(tables)


@dataclass(frozen=True, slots=True)
class AcceptancePlan:
    """A plan of an acceptance that is checked."""

    path: Path
    text: str
    title: str
    seed: int
    through: Through
    sets: tuple[CaseSet, ...]
    clauses: tuple[ClauseTable, ...]
    untested: tuple[UntestedTable, ...]
    quick: bool = False

    @property
    def sha256(self) -> str:
        """The SHA-256 of its text."""
        return sha256(self.text.encode()).hexdigest()

    def clauses_of(self, name: str) -> list[ClauseTable]:
        """The clauses of a set of cases."""
        return [clause for clause in self.clauses if clause.of == name]


def plan_path(name: Path) -> Path:
    """The path of a plan: the file of that name, or the one that ships under it."""
    if name.exists() or name.parent != Path():
        return name
    try:
        return resource_path("configs", f"{PLANS}/{name.name}")
    except InputError:
        return name


def read_acceptance_plan(
    path: Path, bench: Path, quick: bool, through: Through | None
) -> AcceptancePlan:
    """Read and check a plan for a bench file. Raises InputError with file, key, fault and
    remedy.
    """
    text = read_text(path, "give the path of a plan, or write ecss.toml", MAX_TOML_BYTES)
    tables = parse_toml(path, text)
    try:
        plan = msgspec.convert(tables, AcceptanceTables)
    except RecursionError as error:
        raise InputError(f"{path}: its tables are nested too deep; see {KIND.reference}") from error
    except msgspec.ValidationError as error:
        raise InputError(f"{path}: {explained(str(error), tables, KIND)}") from error
    try:
        sets = _sets(plan, path.parent, bench, quick, through or plan.through)
        for number, clause in enumerate(plan.clause, start=1):
            _check_clause(
                f"[[clause]] number {number}",
                clause,
                {case_set.name: case_set for case_set in sets},
            )
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    asked = {clause.of for clause in plan.clause}
    return AcceptancePlan(
        path=path,
        text=text,
        title=plan.title,
        seed=plan.seed,
        through=through or plan.through,
        sets=tuple(case_set for case_set in sets if case_set.name in asked),
        clauses=tuple(plan.clause),
        untested=tuple(plan.untested),
        quick=quick,
    )


def _sets(
    plan: AcceptanceTables, folder: Path, bench: Path, quick: bool, through: Through
) -> list[CaseSet]:
    sets = []
    for name, tables in plan.cases.items():
        where = f"[cases.{name}]"
        set_keys = _own_keys(where, name, tables)
        campaign = {key: value for key, value in tables.items() if key not in OWN}
        campaign |= {"bench": str(bench.resolve()), "through": through}
        if "vary" in campaign:
            campaign["vary"] = [_with_files(varied, folder) for varied in campaign["vary"]]
        campaign.setdefault("seed", plan.seed)
        if quick and set_keys.quick_cases is not None:
            campaign["cases"] = set_keys.quick_cases
        asked = {
            QUANTITY_COLUMNS[clause.quantity]
            for clause in plan.clause
            if clause.of == name and clause.quantity in QUANTITY_COLUMNS
        }
        if set_keys.sweep is not None and set_keys.sweep.star_v_mag is not None:
            asked.add("stars")
        if asked:
            campaign["columns"] = sorted({*asked, *campaign.get("columns", [])})
        refused = ""
        if through == "bench":
            campaign, refused = _on_bench(campaign, set_keys.sweep)
        elif plan.planted is not None:
            campaign["planted"] = _without_defaults(plan.planted)
        sets.append(CaseSet(name, set_keys.about, campaign, set_keys.sweep, refused))
    return sets


def _with_files(varied: Any, folder: Path) -> Any:
    """A varied key, whose files are found: those beside the plan, or else those that ship."""
    if not isinstance(varied, dict) or varied.get("key") not in (SCENARIO, ORBIT):
        return varied
    values = varied.get("values")
    if not isinstance(values, list):
        return varied
    is_orbit = varied["key"] == ORBIT
    return varied | {"values": [_file_value(value, folder, is_orbit) for value in values]}


def _file_value(value: Any, folder: Path, is_orbit: bool) -> Any:
    """The path of a plan's file as a campaign takes it. A scenario stands beside the plan anyway;
    what is no file stays as it is.
    """
    if not isinstance(value, str) or not value:
        return value
    beside = folder / value
    if beside.is_file():
        return str(beside.resolve()) if is_orbit else value
    shipped = plan_path(Path(value))
    return str(shipped.resolve()) if shipped.is_file() else value


def _own_keys(where: str, name: str, tables: dict[str, Any]) -> CaseKeys:
    """The keys of a set that are not a campaign's. Raises InputError for a wrong one."""
    if not NAME.fullmatch(name):
        raise InputError(f"{where}: write a name of small letters, digits and -")
    for key in GIVEN:
        if key in tables:
            raise InputError(f"{where} {key}: is not of a set of cases; leave it out")
    try:
        set_keys = msgspec.convert({key: tables[key] for key in OWN if key in tables}, CaseKeys)
    except msgspec.ValidationError as error:
        raise InputError(f"{where}: {error}") from error
    if set_keys.sweep is not None:
        set_keys.sweep.check(f"{where} sweep")
    return set_keys


def _without_defaults(planted: PlantedFaults) -> dict[str, Any]:
    """The keys that are planted."""
    usual = msgspec.to_builtins(PlantedFaults())
    given = msgspec.to_builtins(planted)
    return {key: value for key, value in given.items() if value != usual[key]}


def _on_bench(campaign: dict[str, Any], sweep: SweepTable | None) -> tuple[dict[str, Any], str]:
    """A set's plan before a real tracker: frames are answers, and what varies has to be the
    display's.
    """
    tables = {key: value for key, value in campaign.items() if key not in ONLY_TRACKER}
    if "frames" in tables:
        tables["answers"] = tables.pop("frames")
    keys = [varied.get("key", "") for varied in tables.get("vary", [])]
    if sweep is not None:
        keys.append(sweep.key)
    for key in keys:
        if str(key).split(".")[0] not in ON_BENCH:
            return tables, f"{key} cannot be changed on a real bench"
    return tables, ""


def _check_clause(where: str, clause: ClauseTable, sets: dict[str, CaseSet]) -> None:
    check_require(where, clause.require)
    if clause.of not in sets:
        advice = did_you_mean(clause.of, sets)
        raise InputError(
            f'{where} ({clause.quantity}): of = "{clause.of}" is no set of cases; {advice}write one'
            f" of {', '.join(sets)}"
        )
    if (clause.quantity == "edge") != (sets[clause.of].sweep is not None):
        kind = "has no sweep" if clause.quantity == "edge" else "is a sweep, whose quantity is edge"
        raise InputError(f"{where} ({clause.quantity}): [cases.{clause.of}] {kind}; write another")
