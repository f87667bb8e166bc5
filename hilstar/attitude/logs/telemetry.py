"""A tracker's telemetry: CSV with every row that it has, valid or not, or a log of attitudes
(AEM, MCAP, JSON lines). JSON lines may have the stars that it reports, as its answers have them,
and CSV has them as columns.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from hilstar.attitude.logs.csv_log import RATE_COLUMNS, RATE_UNIT, rates_of_others
from hilstar.attitude.logs.json_lines import JSON_LINES, json_stars
from hilstar.attitude.logs.log_file import read_log
from hilstar.attitude.logs.log_formats import format_of
from hilstar.attitude.logs.log_times import ns_of_seconds
from hilstar.attitude.logs.star_columns import StarColumns
from hilstar.attitude.wire.protocol import NORM_TOLERANCE
from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.errors import InputError, shortened
from hilstar.basics.reading import warn_once
from hilstar.basics.rotation import normalise
from hilstar.basics.text_tables import (
    CUT,
    VALID,
    finite_numbers,
    is_no_number,
    is_valid,
    needed,
    open_table,
)
from hilstar.basics.units import NS_PER_S

COLUMNS = ("t_s", "qw", "qx", "qy", "qz")
ADVICE = (
    f"write a CSV with the columns {','.join(COLUMNS)} and, where known, {','.join(RATE_COLUMNS)}"
    f" ({RATE_UNIT}) and {VALID} (1 or 0); or give an AEM or an MCAP file"
)
MAX_BYTES = 500_000_000
MAX_ROWS = 3_000_000
MAX_T_NS = 9 * 10**18
NO_RATE = [math.nan] * 3


@dataclass(frozen=True, slots=True)
class Telemetry:
    """Times (n,), ns of the tracker's clock, with attitudes (n, 4), unit q_icrs_to_cam, NaN where
    not `valid` (n,).

    `line` (n,) is each row's line in its file, or its number from 1 where `of_lines` is False.
    `rate_cam_rad_s` (n, 3) are the reported rates, NaN where a row has none. `star_rows` are the
    stars of each row, [x_px, y_px, dn, hip, width_px] with None for what is not known; empty where
    no row has any.
    """

    path: Path
    t_ns: IntArray
    q: FloatArray
    valid: npt.NDArray[np.bool_]
    line: IntArray
    of_lines: bool = True
    rate_cam_rad_s: FloatArray | None = None
    star_rows: Sequence[list[list[float | None]]] = ()


def read_telemetry(path: Path, rising: bool = True) -> Telemetry:
    """Read telemetry. Raises InputError with the line of what is no attitude and, if `rising`,
    of a time that does not rise.
    """
    if format_of(path).name == "CSV":
        telemetry = _read_csv(path, rising)
    else:
        telemetry = _read_log(path)
    if not telemetry.valid.any():
        if len(telemetry.t_ns):
            rows = f"{len(telemetry.t_ns)} rows, none of them valid"
        else:
            rows = "no row"
        raise InputError(f"{path}: has {rows}; {ADVICE}")
    return telemetry


def _read_log(path: Path) -> Telemetry:
    """The samples of a log, and of JSON lines the stars that they have."""
    samples = read_log(path)
    rate_rad_s = np.full((len(samples), 3), math.nan)
    for k, sample in enumerate(samples):
        if sample.rate_cam_rad_s is not None:
            rate_rad_s[k] = sample.rate_cam_rad_s
    star_rows: list[list[list[float | None]]] = []
    if format_of(path).name == JSON_LINES:
        stars = json_stars(path)
        star_rows = [stars.get(sample.t_ns, []) for sample in samples]
    return Telemetry(
        path,
        np.array([sample.t_ns for sample in samples], dtype=np.int64),
        np.array([sample.q_icrs_to_cam for sample in samples]).reshape(-1, 4),
        np.ones(len(samples), dtype=np.bool_),
        np.arange(1, len(samples) + 1),
        of_lines=False,
        rate_cam_rad_s=rate_rad_s,
        star_rows=star_rows,
    )


def _read_csv(path: Path, rising: bool) -> Telemetry:
    t_ns: list[int] = []
    q: list[list[float]] = []
    valid: list[bool] = []
    line: list[int] = []
    rates_rad_s: list[list[float]] = []
    star_rows: list[list[list[float | None]]] = []
    for row in _answers(path):
        number, cells = row.line, row.cells
        star_rows.append(row.stars)
        t_ns.append(_time(path, number, cells[0]))
        if rising and len(t_ns) > 1 and t_ns[-1] <= t_ns[-2]:
            fault = f"t_s = {shortened(cells[0])} after {t_ns[-2] / NS_PER_S:.9g}"
            raise InputError(
                f"{path}:{number}: time does not increase ({fault}); sort the rows, and give one"
                " recording"
            )
        valid.append(is_valid(path, number, cells[5]))
        q.append(_attitude(path, number, cells[1:5]) if valid[-1] else [math.nan] * 4)
        rates_rad_s.append(_rate(path, number, cells[6:]) if valid[-1] else NO_RATE)
        line.append(number)
        if len(t_ns) > MAX_ROWS:
            raise InputError(f"{path}: more than {MAX_ROWS} rows; give a shorter recording")
    attitudes = np.array(q).reshape(len(q), 4)
    flags = np.array(valid, dtype=np.bool_)
    if not any(star_rows):
        star_rows = []
    attitudes[flags] = normalise(attitudes[flags])
    return Telemetry(
        path,
        np.array(t_ns, dtype=np.int64),
        attitudes,
        flags,
        np.array(line, dtype=np.intp),
        rate_cam_rad_s=np.array(rates_rad_s).reshape(len(q), 3),
        star_rows=star_rows,
    )


@dataclass(frozen=True, slots=True)
class TelemetryRow:
    """A row of a table: its line, the cells of COLUMNS, of the flag and of RATE_COLUMNS ("": not
    there), and its stars; `has_one_star` where the table has one star in each row.
    """

    line: int
    cells: list[str]
    stars: list[list[float | None]]
    has_one_star: bool


def _answers(path: Path) -> Iterator[TelemetryRow]:
    """The rows of a table's answers: of one star a row those of one time together. Raises
    InputError where their attitudes differ.
    """
    answer: TelemetryRow | None = None
    for row in _rows(path):
        is_same = row.has_one_star and answer is not None and row.cells[0] == answer.cells[0]
        if answer is None or not is_same:
            if answer is not None:
                yield answer
            answer = row
            continue
        if row.cells != answer.cells:
            fault = f"another attitude at t_s = {shortened(row.cells[0])}"
            raise InputError(f"{path}:{row.line}: {fault}; repeat the answer beside each star")
        answer.stars.extend(row.stars)
    if answer is not None:
        yield answer


def _rows(path: Path) -> Iterator[TelemetryRow]:
    """The rows of a table.

    What was taken that is not plainly stated is logged as a warning. Raises InputError for a column
    that is missing or there twice, and for one or two columns of a rate.
    """
    with open_table(path, ADVICE, MAX_BYTES) as table:
        places = [needed(table, name) for name in COLUMNS]
        flag = table.valid()
        rates = [table.chosen(name, RATE_UNIT) for name in RATE_COLUMNS]
        if any(rates) and not all(rates):
            missing = [name for name, rate in zip(RATE_COLUMNS, rates, strict=True) if rate is None]
            fault = f"column {missing[0]} is missing beside the others of a rate"
            raise table.refusal(table.header_line, fault)
        others = rates_of_others(table)
        if others and not any(rates):
            table.notices.append(others)
        star_columns = StarColumns(table)
        table.warn()
        for line, cells in table.rows(keep_cut=False):
            answer = [table.cell(cells, chosen) for chosen in (*places, flag, *rates)]
            stars = star_columns.of_row(path, line, cells)
            yield TelemetryRow(line, answer, stars, star_columns.one_a_row)
        if table.is_cut:
            warn_once(f"{path}: {CUT}")


def _attitude(path: Path, line: int, cells: list[str]) -> list[float]:
    """The quaternion of a valid row. Raises InputError."""
    q = finite_numbers(path, line, COLUMNS[1:], cells, "write valid = 0 where there is no answer")
    if abs(math.hypot(*q) - 1) > NORM_TOLERANCE:
        fault = f"the norm of qw,qx,qy,qz is {math.hypot(*q):.6g}"
        raise InputError(
            f"{path}:{line}: {fault}; write unit quaternions, within {NORM_TOLERANCE:g}"
        )
    return q


def _rate(path: Path, line: int, cells: list[str]) -> list[float]:
    """The rate of a row, NaN where its cells hold no number; InputError where some do."""
    if all(map(is_no_number, cells)):
        return NO_RATE
    advice = "leave all three blank where no rate is reported"
    return finite_numbers(path, line, RATE_COLUMNS, cells, advice)


def _time(path: Path, line: int, cell: str) -> int:
    try:
        t_ns = ns_of_seconds(cell)
    except (ArithmeticError, ValueError):
        t_ns = None
    if t_ns is None or abs(t_ns) > MAX_T_NS:
        raise InputError(
            f"{path}:{line}: t_s = {shortened(cell)!r} is no time; write seconds, of any clock that"
            " runs evenly"
        )
    return t_ns
