"""An assessment for its readers: the JSON object, tables and lines on the terminal."""

from collections.abc import Iterator
from dataclasses import astuple, fields
from pathlib import Path
from typing import Any

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.charts import write_csv
from hilstar.instruments.assess.assessment import Assessment, Lock
from hilstar.instruments.assess.bench_effects import DisplayCost, Slice
from hilstar.instruments.assess.budget import Axes, DecomposedRun
from hilstar.instruments.assess.figure_rows import (
    AXIS_WORDS,
    FigureRow,
    limit_rows,
    limit_text,
    part_rows,
    row_text,
)
from hilstar.server.bench.certificate_file import Certificate, off_by

MAX_NAMED = 10
WRONG_COLUMNS = ("row", "t_s", "run_s", "off_deg")
OUTAGE_COLUMNS = ("run_s", "length_s", "lost", "rows", "wrong")
MAX_SHARE_SIGMA = 0.5  # a share of the display's error that is less sure says nothing


def budget_of(found: Assessment) -> dict[str, Any]:
    """The JSON object of `hilstar assess`.

    `clock` is the tracker's minus the run's at the run's start, and its excess rate; null where the
    motion does not tell.
    """
    parts = found.found
    missed_frames = found.run.run.missed
    budget: dict[str, Any] = {
        "bias_arcsec": parts.bias_arcsec.tolist(),
        "fov_arcsec": parts.fov_arcsec,
        "pixel_arcsec": parts.pixel_arcsec,
        "noise_arcsec": found.noise_arcsec,
        "clock": _clock_part(found),
        "availability": found.lock.availability,
        "wrong": found.wrong,
        "missed": {"frames": missed_frames, "answers_left_out": len(parts.held)},
        "out_of_order": found.out_of_order,
        "limit_arcsec": found.limit_arcsec,
    }
    if found.further.rows:
        budget["further"] = list(_further_part(found))
    if found.glass is not None:
        budget["glass"] = found.glass
    if found.certificate is not None:
        budget["bench"] = bench_part(found.certificate, parts)
    if found.cube is not None:
        budget["cube_to_boresight"] = found.cube
    return budget


def _further_part(found: Assessment) -> Iterator[dict[str, Any]]:
    """The figures of what answers carry beside the attitude in the JSON object."""
    for row in found.further.rows:
        why = "" if row.value is not None else found.further.why[row.quantity]
        yield row._asdict() | {"why": why}


def _clock_part(found: Assessment) -> dict[str, float | None]:
    """The tracker's clock in the JSON object."""
    clock = found.found.clock
    offset_ms = None
    drift_ppm = None
    if clock.offset_told:
        offset_ms = 1e3 * found.offset_s
    if clock.drift_told:
        drift_ppm = 1e6 * clock.drift
    sigma_ms = 1e3 * clock.sigma_offset_s
    return {"offset_ms": offset_ms, "drift_ppm": drift_ppm, "sigma_ms": sigma_ms}


def bench_part(certificate: Certificate, parts: DecomposedRun) -> dict[str, Any]:
    """How much of the tracker's bias the bench could have made: how far it may be off at 95 %,
    and that over the bias.
    """
    part: dict[str, Any] = {
        "certificate": certificate.number,
        "off_arcsec": None,
        "share_of_bias": None,
    }
    if certificate.attitude_arcsec is None:
        return part
    bench_cross_arcsec, bench_roll_arcsec = certificate.attitude_arcsec
    bias_x, bias_y, bias_z = np.abs(parts.bias_arcsec)
    bias_cross_arcsec = float(np.hypot(bias_x, bias_y))
    cross_share = _share_of(bench_cross_arcsec, bias_cross_arcsec)
    roll_share = _share_of(bench_roll_arcsec, float(bias_z))
    part["off_arcsec"] = {"cross": bench_cross_arcsec, "roll": bench_roll_arcsec}
    part["share_of_bias"] = {"cross": cross_share, "roll": roll_share}
    return part


def _share_of(bench_arcsec: float, bias_arcsec: float) -> float:
    """How much of a bias the bench could have made; all of one that is zero."""
    if not bias_arcsec:
        return 1.0
    return min(bench_arcsec / bias_arcsec, 1.0)


def rows_of(found: Assessment) -> Iterator[FigureRow]:
    """The rows of budget.csv."""
    yield from part_rows(found.found, found.noise_arcsec)
    clock = found.found.clock
    offset_ms = 1e3 * found.offset_s
    sigma_ms = 1e3 * clock.sigma_offset_s
    yield _clock_row("clock offset", offset_ms, sigma_ms, "ms", clock.offset_told)
    drift_ppm = 1e6 * clock.drift
    sigma_ppm = 1e6 * clock.sigma_drift
    yield _clock_row("clock drift", drift_ppm, sigma_ppm, "ppm", clock.drift_told)
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
    display = found.display
    if display is not None:
        yield FigureRow("display's own error", "cross", display.cross_arcsec, "arcsec")
        yield FigureRow("display's own error", "roll", display.roll_arcsec, "arcsec")
        yield FigureRow("display's own error, share seen", "", display.seen)
    yield from limit_rows(found.limit_arcsec)
    yield from found.further.rows
    if found.glass is None:
        return
    for name, axes in found.glass.fov_arcsec.items():
        quantity = f"glass {name.replace('_', ' ')}"
        yield FigureRow(quantity, "cross", axes.cross, "arcsec")
        yield FigureRow(quantity, "roll", axes.roll, "arcsec")


def _clock_row(name: str, value: float, sigma: float, unit: str, is_told: bool) -> FigureRow:
    """A row of the clock, without a value where the motion does not tell it."""
    low = value - 1.96 * sigma
    high = value + 1.96 * sigma
    if is_told:
        return FigureRow(name, "", value, unit, low, high)
    return FigureRow(name, "", None, unit, low, high)


def write_tables(directory: Path, found: Assessment) -> None:
    """Write budget.csv, slices.csv, wrong.csv and outages.csv. Raises InputError."""
    budget_rows = map(_plain, rows_of(found))
    write_csv(directory / "budget.csv", FigureRow._fields, list(budget_rows))
    slice_rows = []
    for row_slice in found.by_rate:
        slice_rows.append(_plain(("rate_deg_s", *astuple(row_slice))))
    for row_slice in found.by_magnitude:
        slice_rows.append(_plain(("field_v_mag", *astuple(row_slice))))
    names = ["by", *(field.name for field in fields(Slice))]
    write_csv(directory / "slices.csv", names, slice_rows)
    wrong_rows = []
    for answer in found.wrong:
        run_text = f"{answer.run_s:.6f}"
        off_text = f"{answer.off_deg:.6g}"
        wrong_rows.append((answer.row, repr(answer.t_s), run_text, off_text))
    write_csv(directory / "wrong.csv", WRONG_COLUMNS, wrong_rows)
    outage_rows = []
    for outage in found.lock.outages:
        start = f"{outage.start_s:.6f}"
        length = f"{outage.length_s:.6f}"
        outage_rows.append((start, length, int(outage.lost), outage.rows, outage.wrong))
    write_csv(directory / "outages.csv", OUTAGE_COLUMNS, outage_rows)


def _plain(row: tuple[object, ...]) -> list[object]:
    return [_cell(value) for value in row]


def _cell(value: object) -> object:
    """A cell of a table: nothing for None, nine digits of a float."""
    if value is None:
        return ""
    if isinstance(value, float):
        return f"{value:.9g}"
    return value


def lines_of(found: Assessment) -> list[tuple[str, str]]:
    """The lines of the assessment on the terminal: name and text."""
    return list(_lines(found))


def _lines(found: Assessment) -> Iterator[tuple[str, str]]:
    """The lines one after another; those of bench, glass and cube only where there is such."""
    parts = found.found
    intervals = parts.intervals
    yield "answers", _answers_text(found)
    yield "missed frames", found.missed_line
    x, y, z = parts.bias_arcsec.tolist()
    yield "bias", f"x {x:.2f}, y {y:.2f}, about the boresight {z:.2f} arcsec"
    yield "field-of-view error", size_text(parts.fov_arcsec, intervals.fov)
    yield "pixel error", size_text(parts.pixel_arcsec, intervals.pixel)
    yield "noise", size_text(found.noise_arcsec, intervals.noise)
    yield "clock", _clock_text(found)
    lock = found.lock
    percent = f"{100 * lock.availability:.2f} %"
    cycle_ms = 1e3 * lock.cycle_s
    yield "availability", f"{percent} of {lock.due} answers due, one each {cycle_ms:.4g} ms"
    yield "lock lost", f"{len(lock.lost)} times"
    yield "acquisition", _acquisition_text(lock)
    yield "wrong", _wrong_text(found)
    yield "display's own error", display_text(found.display)
    yield "limit of its stars", limit_text(found.limit_arcsec)
    yield from further_lines(found)
    if found.certificate is not None:
        yield "bench's own error", bench_text(found)
    if found.glass is not None:
        yield "glass", found.glass.line()
    if found.cube is not None:
        yield "cube to boresight", found.cube.line


def further_lines(found: Assessment) -> Iterator[tuple[str, str]]:
    """Lines of what answers carry beside the attitude, a quantity each."""
    texts: dict[str, list[str]] = {}
    for row in found.further.rows:
        text = row_text(row)
        if text is None:
            text = f"not known: {found.further.why[row.quantity]}"
        elif row.axis:
            text = f"{text} {AXIS_WORDS[row.axis]}"
        texts.setdefault(row.quantity, []).append(text)
    for name, parts in texts.items():
        yield name, "; ".join(dict.fromkeys(parts))


def _answers_text(found: Assessment) -> str:
    """How many answers were right, and how many came out of order."""
    right = len(found.found.row)
    valid = int(found.telemetry.valid.sum())
    rows = len(found.telemetry.t_ns)
    counts = f"{right} right of {valid} valid and {rows} rows"
    if found.out_of_order:
        return f"{counts}; {found.out_of_order} came out of order, sorted by their stamps"
    return counts


def _clock_text(found: Assessment) -> str:
    """The tracker's clock against the run's."""
    clock = found.found.clock
    if not clock.drift_told:
        return "cannot be told: the run does not turn enough"
    offset = "unknown"
    if clock.offset_told:
        sigma_ms = 1e3 * clock.sigma_offset_s
        offset = f"{1e3 * found.offset_s:.3f} +- {sigma_ms:.2g} ms"
    drift_ppm = 1e6 * clock.drift
    sigma_ppm = 1e6 * clock.sigma_drift
    return f"offset {offset}, fast by {drift_ppm:.2f} +- {sigma_ppm:.2g} ppm"


def _acquisition_text(lock: Lock) -> str:
    """How often a sky was acquired, and after what time."""
    share = lock.acquisition_probability
    if share is None:
        return "-"
    wait_s = lock.acquisition_s
    wait = "-"
    if wait_s is not None:
        wait = f"{wait_s:.3g}"
    return f"{100 * share:.0f} %, median {wait} s"


def _wrong_text(found: Assessment) -> str:
    """The number of wrong answers and where the first of them stand."""
    count = len(found.wrong)
    if not count:
        return "none"
    rows = [str(answer.row) for answer in found.wrong[:MAX_NAMED]]
    if count > MAX_NAMED:
        rows.append("...")
    where = "attitudes"
    if found.telemetry.of_lines:
        where = "on lines"
    return f"{count}, {where} {', '.join(rows)}"


def display_text(display: DisplayCost | None) -> str:
    """The display's own error and its share in the tracker's answers, in words."""
    if display is None:
        return "not looked at"
    across = f"{display.cross_arcsec:.2g} arcsec across"
    about = f"{display.roll_arcsec:.2g} arcsec about the boresight"
    size = f"{across}, {about}, at {display.attitudes} attitudes"
    if display.sigma_seen > MAX_SHARE_SIGMA:
        return f"{size}; it is too small beside the noise to be found in the answers"
    sigma_percent = 100 * display.sigma_seen
    share = f"{100 * display.seen:.0f} +- {sigma_percent:.0f} %"
    return f"{size}; {share} of it is in the answers"


def bench_text(found: Assessment) -> str:
    """The bench's own error by its certificate, and how much of the bias it could have made, in
    words.
    """
    certificate = found.certificate
    assert certificate is not None
    line = f"{certificate.line}: {off_by(certificate)}"
    shares = bench_part(certificate, found.found)["share_of_bias"]
    if shares is None:
        return line
    cross = 100 * shares["cross"]
    roll = 100 * shares["roll"]
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
    roll = f"{axes.roll:.3g} ({roll_low:.3g} to {roll_high:.3g})"
    return f"{cross} across, {roll} arcsec about the boresight"
