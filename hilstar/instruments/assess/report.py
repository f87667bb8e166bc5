"""An assessment for its readers: the JSON object, tables and lines on the terminal."""

from collections.abc import Iterator
from dataclasses import astuple, fields
from pathlib import Path
from typing import Any

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.charts import write_csv
from hilstar.instruments.assess.assessment import Assessment
from hilstar.instruments.assess.bench_effects import DisplayCost, Slice
from hilstar.instruments.assess.budget import Axes, DecomposedRun
from hilstar.instruments.assess.figure_rows import FigureRow, limit_rows, limit_text, part_rows
from hilstar.server.bench.certificate_file import Certificate, off_by

MAX_NAMED = 10
MAX_SHARE_SIGMA = 0.5  # a share of the display's error that is less sure says nothing


def budget_of(found: Assessment) -> dict[str, Any]:
    """The JSON object of `hilstar assess`.

    `clock` is the tracker's minus the run's at the run's start, and its excess rate; null where the
    motion does not tell.
    """
    parts = found.found
    clock = found.found.clock
    return {
        "bias_arcsec": parts.bias_arcsec.tolist(),
        "fov_arcsec": parts.fov_arcsec,
        "pixel_arcsec": parts.pixel_arcsec,
        "noise_arcsec": found.noise_arcsec,
        "clock": {
            "offset_ms": 1e3 * found.offset_s if clock.offset_told else None,
            "drift_ppm": 1e6 * clock.drift if clock.drift_told else None,
            "sigma_ms": 1e3 * clock.sigma_offset_s,
        },
        "availability": found.lock.availability,
        "wrong": found.wrong,
        "missed": {"frames": found.run.run.missed, "answers_left_out": len(parts.held)},
        "out_of_order": found.out_of_order,
        "limit_arcsec": found.limit_arcsec,
        **({} if found.glass is None else {"glass": found.glass}),
        **({} if found.certificate is None else {"bench": bench_part(found.certificate, parts)}),
        **({} if found.cube is None else {"cube_to_boresight": found.cube}),
    }


def bench_part(certificate: Certificate, parts: DecomposedRun) -> dict[str, Any]:
    """How much of the tracker's bias the bench could have made: how far it may be off at 95 %,
    and that over the bias.
    """
    bias = np.abs(parts.bias_arcsec)
    part: dict[str, Any] = {
        "certificate": certificate.number,
        "off_arcsec": None,
        "share_of_bias": None,
    }
    if certificate.attitude_arcsec is not None:
        sizes = zip(
            ("cross", "roll"),
            certificate.attitude_arcsec,
            (float(np.hypot(*bias[:2])), float(bias[2])),
            strict=True,
        )
        shares = {
            name: (bench_arcsec, min(bench_arcsec / measured, 1.0) if measured else 1.0)
            for name, bench_arcsec, measured in sizes
        }
        part["off_arcsec"] = {name: bench_arcsec for name, (bench_arcsec, _) in shares.items()}
        part["share_of_bias"] = {name: share for name, (_, share) in shares.items()}
    return part


def rows_of(found: Assessment) -> Iterator[FigureRow]:
    """The rows of budget.csv."""
    yield from part_rows(found.found, found.noise_arcsec)
    clock = found.found.clock
    for name, value, sigma, unit, note in (
        ("clock offset", 1e3 * found.offset_s, 1e3 * clock.sigma_offset_s, "ms", clock.offset_told),
        ("clock drift", 1e6 * clock.drift, 1e6 * clock.sigma_drift, "ppm", clock.drift_told),
    ):
        yield FigureRow(
            name, "", value if note else None, unit, value - 1.96 * sigma, value + 1.96 * sigma
        )
    lock = found.lock
    yield FigureRow("availability", "", lock.availability)
    yield FigureRow("answers due", "", lock.due)
    yield FigureRow("right answers", "", lock.right)
    yield FigureRow("wrong answers", "", len(found.wrong))
    yield FigureRow("missed frames", "", found.run.run.missed)
    yield FigureRow("answers left out for held frames", "", len(found.found.held))
    yield FigureRow("answers out of order", "", found.out_of_order)
    yield FigureRow("lock lost", "", len(lock.lost))
    yield FigureRow("acquisition probability", "", lock.acquisition_probability)
    yield FigureRow("acquisition time, median", "", lock.acquisition_s, "s")
    if found.display is not None:
        yield FigureRow("display's own error", "cross", found.display.cross_arcsec, "arcsec")
        yield FigureRow("display's own error", "roll", found.display.roll_arcsec, "arcsec")
        yield FigureRow("display's own error, share seen", "", found.display.seen)
    yield from limit_rows(found.limit_arcsec)
    for name, axes in found.glass.fov_arcsec.items() if found.glass is not None else ():
        for axis in ("cross", "roll"):
            yield FigureRow(f"glass {name.replace('_', ' ')}", axis, getattr(axes, axis), "arcsec")


def write_tables(directory: Path, found: Assessment) -> None:
    """Write budget.csv, slices.csv, wrong.csv and outages.csv. Raises InputError."""
    write_csv(directory / "budget.csv", FigureRow._fields, [_plain(row) for row in rows_of(found)])
    slices = [("rate_deg_s", row_slice) for row_slice in found.by_rate] + [
        ("field_v_mag", row_slice) for row_slice in found.by_magnitude
    ]
    names = ["by", *(field.name for field in fields(Slice))]
    write_csv(
        directory / "slices.csv",
        names,
        [_plain((by, *astuple(row_slice))) for by, row_slice in slices],
    )
    write_csv(
        directory / "wrong.csv",
        ("row", "t_s", "run_s", "off_deg"),
        [
            (
                row_slice.row,
                repr(row_slice.t_s),
                f"{row_slice.run_s:.6f}",
                f"{row_slice.off_deg:.6g}",
            )
            for row_slice in found.wrong
        ],
    )
    write_csv(
        directory / "outages.csv",
        ("run_s", "length_s", "lost", "rows", "wrong"),
        [
            (f"{o.start_s:.6f}", f"{o.length_s:.6f}", int(o.lost), o.rows, o.wrong)
            for o in found.lock.outages
        ],
    )


def _plain(row: tuple[object, ...]) -> list[object]:
    return [
        "" if value is None else f"{value:.9g}" if isinstance(value, float) else value
        for value in row
    ]


def lines_of(found: Assessment) -> list[tuple[str, str]]:
    """The lines of the assessment on the terminal: name and text."""
    parts = found.found
    lock = found.lock
    clock = found.found.clock
    x, y, z = parts.bias_arcsec.tolist()
    named = ", ".join(str(answer.row) for answer in found.wrong[:MAX_NAMED]) + (
        ", ..." if len(found.wrong) > MAX_NAMED else ""
    )
    if found.telemetry.of_lines:
        where = "on lines"
    else:
        where = "attitudes"
    if clock.offset_told:
        offset = f"{1e3 * found.offset_s:.3f} +- {1e3 * clock.sigma_offset_s:.2g} ms"
    else:
        offset = "unknown"
    drift = f"{1e6 * clock.drift:.2f} +- {1e6 * clock.sigma_drift:.2g} ppm"
    share = lock.acquisition_probability
    wait_s = lock.acquisition_s
    wait = "-" if wait_s is None else f"{wait_s:.3g}"
    answers = (
        f"{len(parts.row)} right of {int(found.telemetry.valid.sum())} valid and"
        f" {len(found.telemetry.t_ns)} rows"
    )
    answers += (
        f"; {found.out_of_order} came out of order, sorted by their stamps"
        if found.out_of_order
        else ""
    )
    return [
        ("answers", answers),
        ("missed frames", found.missed_line),
        ("bias", f"x {x:.2f}, y {y:.2f}, about the boresight {z:.2f} arcsec"),
        ("field-of-view error", size_text(parts.fov_arcsec, parts.intervals.fov)),
        ("pixel error", size_text(parts.pixel_arcsec, parts.intervals.pixel)),
        ("noise", size_text(found.noise_arcsec, parts.intervals.noise)),
        (
            "clock",
            (
                f"offset {offset}, fast by {drift}"
                if clock.drift_told
                else "cannot be told: the run does not turn enough"
            ),
        ),
        (
            "availability",
            (
                f"{100 * lock.availability:.2f} % of {lock.due} answers due, one each"
                f" {1e3 * lock.cycle_s:.4g} ms"
            ),
        ),
        ("lock lost", f"{len(lock.lost)} times"),
        ("acquisition", "-" if share is None else f"{100 * share:.0f} %, median {wait} s"),
        ("wrong", f"{len(found.wrong)}, {where} {named}" if found.wrong else "none"),
        ("display's own error", display_text(found.display)),
        ("limit of its stars", limit_text(found.limit_arcsec)),
        *([("bench's own error", bench_text(found))] if found.certificate is not None else []),
        *([("glass", found.glass.line())] if found.glass is not None else []),
        *([("cube to boresight", found.cube.line)] if found.cube is not None else []),
    ]


def display_text(display: DisplayCost | None) -> str:
    """The display's own error and its share in the tracker's answers, in words."""
    if display is None:
        return "not looked at"
    size = (
        f"{display.cross_arcsec:.2g} arcsec across, {display.roll_arcsec:.2g} arcsec about the"
        f" boresight, at {display.attitudes} attitudes"
    )
    if display.sigma_seen > MAX_SHARE_SIGMA:
        return f"{size}; it is too small beside the noise to be found in the answers"
    share = f"{100 * display.seen:.0f} +- {100 * display.sigma_seen:.0f} %"
    return f"{size}; {share} of it is in the answers"


def bench_text(found: Assessment) -> str:
    """The bench's own error by its certificate, and how much of the bias it could have made, in
    words.
    """
    assert found.certificate is not None
    part = bench_part(found.certificate, found.found)
    line = f"{found.certificate.line}: {off_by(found.certificate)}"
    if part["share_of_bias"] is None:
        return line
    cross, roll = (100 * share for share in part["share_of_bias"].values())
    return (
        f"{line}; it could have made {cross:.0f} % of the bias across and {roll:.0f} % of that"
        " about"
    )


def size_text(axes: Axes, interval: FloatArray) -> str:
    """A part of the budget with its 95 % intervals (2, 2), arcsec, in words."""
    if axes.cross is None or axes.roll is None:
        return "cannot be told"
    (cross_low, roll_low), (cross_high, roll_high) = interval.tolist()
    cross = f"{axes.cross:.3g} ({cross_low:.3g} to {cross_high:.3g})"
    return (
        f"{cross} across, {axes.roll:.3g} ({roll_low:.3g} to {roll_high:.3g}) arcsec about the"
        " boresight"
    )
