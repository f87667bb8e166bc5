"""An assessment in figures: the JSON object, the tables, and lines for a person."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path

import msgspec

from hilstar.arrays import FloatArray
from hilstar.campaign.assessment.assess import Assessment, Wrong
from hilstar.campaign.assessment.slices import Slice
from hilstar.campaign.budget.budget import Axes
from hilstar.charts import write_csv

COUNT = "1"  # the unit of counts and shares in the tables
COLUMNS = ("quantity", "axis", "value", "unit", "low_95", "high_95")
MAX_NAMED = 10


class BothAxes(msgspec.Struct, frozen=True):
    """One sigma across the boresight, an axis, and about it; null where the run does not tell."""

    cross: float | None
    roll: float | None


class Clock(msgspec.Struct, frozen=True):
    """The tracker's clock less the run's at the run's start, and how much faster it is; null where the motion does not tell."""

    offset_ms: float | None
    drift_ppm: float | None
    sigma_ms: float


class Budget(msgspec.Struct, frozen=True):
    """The JSON object of `hilstar assess`."""

    bias_arcsec: tuple[float, float, float]
    fov_arcsec: BothAxes
    pixel_arcsec: BothAxes
    noise_arcsec: BothAxes
    clock: Clock
    availability: float
    wrong: tuple[Wrong, ...]


def budget_of(found: Assessment) -> Budget:
    """The figures of an assessment."""
    clock = found.found.clock
    if clock is None:
        raise AssertionError("a run has a clock")
    x, y, z = found.found.bias_arcsec.tolist()
    return Budget(
        bias_arcsec=(x, y, z),
        fov_arcsec=_both(found.found.fov_arcsec),
        pixel_arcsec=_both(found.found.pixel_arcsec),
        noise_arcsec=_both(found.noise_arcsec),
        clock=Clock(
            offset_ms=1e3 * found.offset_s if clock.offset_told else None,
            drift_ppm=1e6 * clock.drift if clock.drift_told else None,
            sigma_ms=1e3 * clock.sigma_offset_s,
        ),
        availability=found.lock.availability,
        wrong=found.wrong,
    )


def _both(axes: Axes) -> BothAxes:
    return BothAxes(axes.cross, axes.roll)


Row = tuple[str, str, float | int | None, str, float | None, float | None]


def rows_of(found: Assessment) -> Iterator[Row]:
    """The rows of budget.csv."""
    parts, intervals = found.found, found.found.intervals
    for k, axis in enumerate("xyz"):
        low, high = intervals.bias[:, k].tolist()
        yield "bias", axis, float(parts.bias_arcsec[k]), "arcsec", low, high
    for name, axes, interval in (
        ("field-of-view error", parts.fov_arcsec, intervals.fov),
        ("pixel error", parts.pixel_arcsec, intervals.pixel),
        ("noise", found.noise_arcsec, intervals.noise),
    ):
        yield from _of_axes(name, axes, interval)
    clock = parts.clock
    if clock is not None:
        for name, value, sigma, unit, told in (
            ("clock offset", 1e3 * found.offset_s, 1e3 * clock.sigma_offset_s, "ms", clock.offset_told),
            ("clock drift", 1e6 * clock.drift, 1e6 * clock.sigma_drift, "ppm", clock.drift_told),
        ):
            yield name, "", value if told else None, unit, value - 1.96 * sigma, value + 1.96 * sigma
    lock = found.lock
    yield "availability", "", lock.availability, COUNT, None, None
    yield "answers due", "", lock.due, COUNT, None, None
    yield "right answers", "", lock.right, COUNT, None, None
    yield "wrong answers", "", len(found.wrong), COUNT, None, None
    yield "lock lost", "", len(lock.lost), COUNT, None, None
    yield "acquisition probability", "", lock.acquisition_probability, COUNT, None, None
    yield "acquisition time, median", "", lock.acquisition_s, "s", None, None
    if found.display is not None:
        yield "display's own error", "cross", found.display.cross_arcsec, "arcsec", None, None
        yield "display's own error", "roll", found.display.roll_arcsec, "arcsec", None, None
        yield "display's own error, share seen", "", found.display.seen, COUNT, None, None


def _of_axes(name: str, axes: Axes, interval: FloatArray) -> Iterator[Row]:
    for k, axis in enumerate(("cross", "roll")):
        value = getattr(axes, axis)
        low, high = interval[:, k].tolist() if value is not None else (None, None)
        yield name, axis, value, "arcsec", low, high


def write_tables(directory: Path, found: Assessment) -> None:
    """Write budget.csv, slices.csv, wrong.csv and outages.csv. Raises InputError."""
    write_csv(directory / "budget.csv", COLUMNS, [_plain(row) for row in rows_of(found)])
    names = [field.name for field in fields(Slice)]
    slices = [("rate_deg_s", each) for each in found.by_rate] + [("field_v_mag", each) for each in found.by_magnitude]
    write_csv(
        directory / "slices.csv", ["by", *names], [_plain((by, *(getattr(each, n) for n in names))) for by, each in slices]
    )
    write_csv(
        directory / "wrong.csv",
        ("row", "t_s", "run_s", "off_deg"),
        [(each.row, repr(each.t_s), f"{each.run_s:.6f}", f"{each.off_deg:.6g}") for each in found.wrong],
    )
    write_csv(
        directory / "outages.csv",
        ("run_s", "length_s", "lost", "rows", "wrong"),
        [(f"{o.start_s:.6f}", f"{o.length_s:.6f}", int(o.lost), o.rows, o.wrong) for o in found.lock.outages],
    )


def _plain(row: tuple[object, ...]) -> list[object]:
    return ["" if value is None else f"{value:.9g}" if isinstance(value, float) else value for value in row]


def lines_of(found: Assessment) -> list[tuple[str, str]]:
    """The assessment for a person: name and text."""
    parts, lock = found.found, found.lock
    x, y, z = parts.bias_arcsec.tolist()
    named = ", ".join(str(each.row) for each in found.wrong[:MAX_NAMED]) + (", ..." if len(found.wrong) > MAX_NAMED else "")
    where = "on lines" if found.telemetry.of_lines else "attitudes"
    share = lock.acquisition_probability
    return [
        ("answers", f"{len(parts.row)} right of {int(found.telemetry.valid.sum())} valid and {len(found.telemetry.t_ns)} rows"),
        ("bias", f"x {x:.2f}, y {y:.2f}, about the boresight {z:.2f} arcsec"),
        ("field-of-view error", _text(parts.fov_arcsec, parts.intervals.fov)),
        ("pixel error", _text(parts.pixel_arcsec, parts.intervals.pixel)),
        ("noise", _text(found.noise_arcsec, parts.intervals.noise)),
        ("clock", clock_text(found)),
        ("availability", f"{100 * lock.availability:.2f} % of {lock.due} answers due, one each {1e3 * lock.cycle_s:.4g} ms"),
        ("lock lost", f"{len(lock.lost)} times"),
        ("acquisition", "-" if share is None else f"{100 * share:.0f} %, median {_number(lock.acquisition_s)} s"),
        ("wrong", f"{len(found.wrong)}, {where} {named}" if found.wrong else "none"),
        ("display's own error", _display_text(found)),
    ]


def clock_text(found: Assessment) -> str:
    """The clock in words."""
    clock = found.found.clock
    if clock is None or not clock.drift_told:
        return "cannot be told: the run does not turn enough"
    offset = f"{1e3 * found.offset_s:.3f} +- {1e3 * clock.sigma_offset_s:.2g} ms" if clock.offset_told else "unknown"
    return f"offset {offset}, fast by {1e6 * clock.drift:.2f} +- {1e6 * clock.sigma_drift:.2g} ppm"


def _display_text(found: Assessment) -> str:
    display = found.display
    if display is None:
        return "not looked at"
    size = f"{display.cross_arcsec:.2g} arcsec across, {display.roll_arcsec:.2g} about the boresight"
    return f"{size}, at {display.attitudes} attitudes; {display.seen:.2f} +- {display.sigma_seen:.2f} of it in the answers"


def _text(axes: Axes, interval: FloatArray) -> str:
    if axes.cross is None or axes.roll is None:
        return "cannot be told"
    (cross_low, roll_low), (cross_high, roll_high) = interval.tolist()
    cross = f"{axes.cross:.3g} ({cross_low:.3g} to {cross_high:.3g})"
    return f"{cross} across, {axes.roll:.3g} ({roll_low:.3g} to {roll_high:.3g}) arcsec about the boresight"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"
