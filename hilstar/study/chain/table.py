"""The study's table: a row for each combination of each scene, rounded, and the fronts of the rounded figures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from hilstar.charts import write_records
from hilstar.study.chain.budget import Part
from hilstar.study.chain.front import Point, beaters, front
from hilstar.study.chain.measuring import Outcome, SceneMeasurement, StageTime

DIGITS, MS_PLACES = 4, 4
AUTO, DEFAULT = "auto", "default"


@dataclass(frozen=True, slots=True)
class Row:
    """A combination in a scene; its fields are the columns of `chain.csv`.

    `exposure_s` is what is measured of the tracker's exposure. `error_arcsec`, `error_mag`: rms over the `stars` of all
    exposures, `lost` of them not found. The fronts are those of `time_ms` against `error_arcsec` and `error_mag`;
    `on_front_as_filed` that of what effort may choose, against `error_arcsec`: the rows whose `bit_stealing`,
    `faintest_v_mag` and `prediction` are those of the bench file.
    """

    scene: str
    rate_deg_s: float
    exposure_s: float
    bits: int
    bit_stealing: str
    faintest_v_mag: float
    sprite: str
    sprite_px: str
    smear: str
    prediction: str
    quantisation: str
    stars: int
    lost: int
    error_arcsec: float
    error_mag: float
    attitude_arcsec: float
    roll_arcsec: float
    time_ms: float
    iqr_ms: float
    noise_ms: float
    cpu_ms: float
    frames: int
    on_front: str = ""
    on_front_mag: str = ""
    on_front_as_filed: str = ""
    chosen: str = ""
    as_filed: str = ""


@dataclass(frozen=True, slots=True)
class BudgetRow:
    """A step's part of the error at a scene's `chosen` point; its fields are the columns of `chain_budget.csv`."""

    scene: str
    chosen: str
    step: str
    error_arcsec: float
    error_mag: float


@dataclass(frozen=True, slots=True)
class StageRow:
    """A stage's part of the time at a scene's `chosen` point; its fields are the columns of `chain_time.csv`."""

    scene: str
    chosen: str
    stage: str
    time_ms: float


def said(flag: bool) -> str:
    """A flag as the table has it."""
    return "true" if flag else "false"


def rounded(value: float) -> float:
    """A figure with the table's digits."""
    return float(f"{value:.{DIGITS}g}") if math.isfinite(value) else value


def rows_of(scene: SceneMeasurement, outcomes: Sequence[Outcome]) -> list[Row]:
    """The rows of a scene, the fastest first."""
    rows = sorted((_row(scene, one) for one in outcomes), key=lambda row: (row.time_ms, row.error_arcsec))
    by_arcsec, by_mag = (front(points(rows, name)) for name in ("error_arcsec", "error_mag"))
    filed = [k for k, row in enumerate(rows) if left_to_effort(row, rows[auto_of(rows)])]
    as_filed = dict(zip(filed, front(points([rows[k] for k in filed], "error_arcsec")), strict=True))
    return [
        replace(row, on_front=said(a), on_front_mag=said(m), on_front_as_filed=said(as_filed.get(k, False)))
        for k, (row, a, m) in enumerate(zip(rows, by_arcsec, by_mag, strict=True))
    ]


def points(rows: Sequence[Row], error: str) -> list[Point]:
    """The rows as points, by `error_arcsec` or `error_mag`."""
    return [Point(row.time_ms, getattr(row, error), row.noise_ms) for row in rows]


def auto_of(rows: Sequence[Row]) -> int:
    """The place of the row that `effort = "auto"` takes."""
    return next(k for k, row in enumerate(rows) if AUTO in row.chosen)


def left_to_effort(row: Row, own: Row) -> bool:
    """Whether a row has what the bench file and its sender say as `auto` has it."""
    given = ("bit_stealing", "faintest_v_mag", "prediction")
    return all(getattr(row, name) == getattr(own, name) for name in given)


def beating(rows: Sequence[Row], as_filed: bool = False) -> tuple[list[Row], list[Row]]:
    """The rows that beat `auto` by arcsec and time, beyond the noise and within it; only those that effort may choose."""
    own = rows[auto_of(rows)]
    kept = [row for row in rows if not as_filed or left_to_effort(row, own)]
    beyond, within = beaters(points(kept, "error_arcsec"), kept.index(own))
    return [kept[k] for k in beyond], [kept[k] for k in within]


def write_tables(directory: Path, rows: Sequence[Row], budgets: Sequence[BudgetRow], stages: Sequence[StageRow]) -> None:
    """Write `chain.csv`, `chain_budget.csv` and `chain_time.csv`. Raises InputError."""
    for name, records in (("chain", rows), ("chain_budget", budgets), ("chain_time", stages)):
        write_records(directory / f"{name}.csv", records)


def budget_rows(scene: str, parts: Sequence[Part]) -> list[BudgetRow]:
    """An error budget's rows."""
    return [BudgetRow(scene, AUTO, part.step, rounded(part.arcsec), rounded(part.mag)) for part in parts]


def stage_rows(scene: str, times: Sequence[StageTime]) -> list[StageRow]:
    """A time budget's rows."""
    return [StageRow(scene, AUTO, one.stage, round(one.ms, MS_PLACES)) for one in times]


def _row(scene: SceneMeasurement, one: Outcome) -> Row:
    own, marks, error, times = one.combination, scene.marks, one.error, one.times
    marked = [name for name, at in ((DEFAULT, marks.default), (AUTO, marks.auto)) if own == at]
    return Row(
        scene=scene.scene.name,
        rate_deg_s=scene.scene.rate_deg_s,
        exposure_s=rounded(scene.judges[0].seen.length_s),
        bits=scene.parts.own.config.monitor.bits,
        bit_stealing=said(own.bit_stealing),
        faintest_v_mag=own.faintest_v_mag,
        sprite=own.sprite,
        sprite_px=one.sprite_px,
        smear=own.smear,
        prediction=own.prediction,
        quantisation=own.quantisation,
        stars=error.stars,
        lost=error.lost,
        error_arcsec=rounded(error.arcsec),
        error_mag=rounded(error.mag),
        attitude_arcsec=rounded(error.attitude_arcsec),
        roll_arcsec=rounded(error.roll_arcsec),
        time_ms=round(times.median_ms, MS_PLACES),
        iqr_ms=round(times.iqr_ms, MS_PLACES),
        noise_ms=round(times.noise_ms, MS_PLACES),
        cpu_ms=round(times.cpu_ms, MS_PLACES),
        frames=times.frames,
        chosen=" ".join(marked),
        as_filed=said(own == marks.as_filed),
    )
