"""The plan's file: TOML in, checked and frozen tables out."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from hilstar.errors import InputError
from hilstar.reading import MAX_TOML_BYTES, parse_toml, read_text
from hilstar.toml_tables import Kind, Table, explained

TYPE_WORDS = {
    "float": "number",
    "int": "whole number",
    "str": "text",
    "object": "table",
    "array": "list",
    "bool": "true or false",
}
MAX_CASES = 1_000_000_000
MAX_FRAMES = 10_000
MAX_VALUES = 10_000
MAX_SEED = 2**63 - 1

Sampling = Literal["grid", "latin-hypercube", "sobol"]
Number = Annotated[float, Meta(ge=-1e12, le=1e12)]
Ra = Annotated[float, Meta(ge=-360, le=360)]
Dec = Annotated[float, Meta(ge=-90, le=90)]
Roll = Annotated[float, Meta(ge=-360, le=720)]


class Attitudes(Table, frozen=True):
    """[attitudes]: where the cases look. `field` is a cap of `radius_deg` around `radec_deg`; `log` goes along a log."""

    kind: Literal["all-sky", "field", "log"] = "all-sky"
    radec_deg: tuple[Ra, Dec] | None = None
    radius_deg: Annotated[float, Meta(ge=0, le=180)] = 5.0
    roll_deg: tuple[Roll, Roll] = (0.0, 360.0)
    log: str | None = None


class Varied(Table, frozen=True):
    """[[vary]]: one key, with the values that it takes, or the range that it is drawn from."""

    key: Annotated[str, Meta(min_length=1, max_length=200)]
    values: Annotated[list[Any], Meta(min_length=1, max_length=MAX_VALUES)] | None = None
    minimum: Number | None = None
    maximum: Number | None = None
    steps: Annotated[int, Meta(ge=1, le=MAX_VALUES)] | None = None
    scale: Literal["linear", "log"] = "linear"


class Centroiding(Table, frozen=True):
    """[centroids]: how `--solver centroids` finds stars, and below which separation a star is crowded out of the errors."""

    threshold_sigma: Annotated[float, Meta(ge=0, le=1e6)] = 5.0
    minimum_pixels: Annotated[int, Meta(ge=1, le=1000)] = 1
    window: Literal["gaussian", "plain"] = "gaussian"
    window_sigma_px: Annotated[float, Meta(ge=0.1, le=100)] | None = None
    remove_s_curve: bool = False


class Plan(Table, frozen=True):
    """A whole plan."""

    bench: Annotated[str, Meta(min_length=1)]
    seed: Annotated[int, Meta(ge=0, le=MAX_SEED)] = 0
    cases: Annotated[int, Meta(ge=1, le=MAX_CASES)] | None = None
    sampling: Sampling = "sobol"
    through: Literal["tracker", "display"] = "tracker"
    frames: Annotated[int, Meta(ge=1, le=MAX_FRAMES)] = 1
    step_s: Annotated[float, Meta(ge=1e-6, le=1e6)] = 0.2
    noise: Literal["full", "none"] = "full"
    wrong_above_arcsec: Annotated[float, Meta(ge=0, le=648000)] = 1800.0
    attitudes: Attitudes = msgspec.field(default_factory=Attitudes)
    centroids: Centroiding = msgspec.field(default_factory=Centroiding)
    vary: Annotated[list[Varied], Meta(max_length=64)] = msgspec.field(default_factory=list)


KIND = Kind(Plan, "docs/campaign.md", TYPE_WORDS)


def read_plan(path: Path) -> Plan:
    """Read and check a plan. Raises InputError: file, key, what is wrong and what to write."""
    return parse_plan(path, read_text(path, "give the path of a plan", MAX_TOML_BYTES))


def parse_plan(path: Path, text: str) -> Plan:
    """Check the text of the plan `path`. Raises InputError as `read_plan` does."""
    tables = parse_toml(path, text)
    _check_finite(path, tables)
    try:
        plan = msgspec.convert(tables, Plan)
    except RecursionError as error:
        raise InputError(f"{path}: its tables are nested too deep; see {KIND.reference}") from error
    except msgspec.ValidationError as error:
        raise InputError(f"{path}: {explained(str(error), tables, KIND)}") from error
    try:
        _check_attitudes(plan.attitudes)
        _check_varied(plan)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    return plan


def plan_bytes(plan: Plan) -> bytes:
    """All that a plan says, in one form whatever its file looks like."""
    return msgspec.json.encode(plan, order="sorted", enc_hook=str)


def _check_finite(path: Path, value: Any) -> None:
    if isinstance(value, dict | list):
        for inner in value.values() if isinstance(value, dict) else value:
            _check_finite(path, inner)
    elif isinstance(value, float) and not math.isfinite(value):
        raise InputError(f"{path}: has the value {value}; a finite number is wanted")


def _check_attitudes(attitudes: Attitudes) -> None:
    if attitudes.kind == "field" and attitudes.radec_deg is None:
        raise InputError('[attitudes] kind = "field" needs radec_deg = [RA, DEC]; add it')
    if attitudes.kind == "log" and attitudes.log is None:
        raise InputError('[attitudes] kind = "log" needs log = "FILE"; add it')
    if attitudes.kind != "field" and attitudes.radec_deg is not None:
        raise InputError(
            f'[attitudes] radec_deg is for kind = "field", and kind is "{attitudes.kind}"; write that, or leave it out'
        )
    if attitudes.kind != "log" and attitudes.log is not None:
        raise InputError(f'[attitudes] log is for kind = "log", and kind is "{attitudes.kind}"; write that, or leave it out')


def _check_varied(plan: Plan) -> None:
    keys = [varied.key for varied in plan.vary]
    twice = next((key for key in keys if keys.count(key) > 1), None)
    if twice is not None:
        raise InputError(f'[[vary]] key = "{twice}" stands there twice; leave one of them out')
    for varied in plan.vary:
        _check_range(varied, plan.sampling)
    if plan.cases is None and plan.sampling != "grid":
        raise InputError(f'sampling = "{plan.sampling}" needs the number of cases; add cases = 1000')


def _check_range(varied: Varied, sampling: Sampling) -> None:
    where = f'[[vary]] key = "{varied.key}"'
    ends = varied.minimum, varied.maximum
    if (varied.values is None) == (ends == (None, None)):
        raise InputError(f"{where}: write either values = [...], or minimum and maximum")
    if varied.values is not None:
        if varied.steps is not None or varied.scale != "linear":
            raise InputError(f"{where}: steps and scale are for minimum and maximum; leave them out beside values")
        return
    low, high = ends
    if low is None or high is None or not low < high:
        raise InputError(f"{where}: minimum = {low}, maximum = {high}; write two numbers, the smaller one first")
    if varied.scale == "log" and low <= 0:
        raise InputError(f'{where}: minimum = {low:g} with scale = "log"; write a number above 0')
    if sampling == "grid" and varied.steps is None:
        raise InputError(f'{where}: sampling = "grid" needs values, or steps beside minimum and maximum; add steps = 5')
    if sampling != "grid" and varied.steps is not None:
        raise InputError(f'{where}: steps is for sampling = "grid"; leave it out')
