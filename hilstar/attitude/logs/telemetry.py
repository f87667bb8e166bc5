"""A tracker's telemetry: CSV with every row that it has, valid or not, or a log of attitudes
(AEM, MCAP, JSON lines).
"""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from hilstar.attitude.logs.log_file import read_log
from hilstar.attitude.logs.log_formats import format_of
from hilstar.attitude.logs.log_times import ns_of_seconds
from hilstar.attitude.wire.protocol import NORM_TOLERANCE
from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.errors import InputError, shortened
from hilstar.basics.rotation import normalise
from hilstar.basics.text_tables import finite_numbers, is_valid, read_rows
from hilstar.basics.units import NS_PER_S

COLUMNS = ("t_s", "qw", "qx", "qy", "qz")
ADVICE = (
    f"write a CSV with the columns {','.join(COLUMNS)} and, where known, valid (1 or 0); or give an"
    " AEM or an MCAP file"
)
MAX_BYTES = 500_000_000
MAX_ROWS = 3_000_000
MAX_T_NS = 9 * 10**18


@dataclass(frozen=True, slots=True)
class Telemetry:
    """Times (n,), ns of the tracker's clock, with attitudes (n, 4), unit q_icrs_to_cam, NaN where
    not `valid` (n,).

    `line` (n,) is each row's line in its file, or its number from 1 where `of_lines` is False.
    """

    path: Path
    t_ns: IntArray
    q: FloatArray
    valid: npt.NDArray[np.bool_]
    line: IntArray
    of_lines: bool = True


def read_telemetry(path: Path, rising: bool = True) -> Telemetry:
    """Read telemetry. Raises InputError with the line of what is no attitude and, if `rising`,
    of a time that does not rise.
    """
    if format_of(path).name == "CSV":
        telemetry = _read_csv(path, rising)
    else:
        samples = read_log(path)
        t_ns = np.array([sample.t_ns for sample in samples], dtype=np.int64)
        q = np.array([sample.q_icrs_to_cam for sample in samples]).reshape(-1, 4)
        valid = np.ones(len(samples), dtype=np.bool_)
        telemetry = Telemetry(path, t_ns, q, valid, np.arange(1, len(samples) + 1), of_lines=False)
    if not telemetry.valid.any():
        if len(telemetry.t_ns):
            rows = f"{len(telemetry.t_ns)} rows, none of them valid"
        else:
            rows = "no row"
        raise InputError(f"{path}: has {rows}; {ADVICE}")
    return telemetry


def _read_csv(path: Path, rising: bool) -> Telemetry:
    t_ns: list[int] = []
    q: list[list[float]] = []
    valid: list[bool] = []
    line: list[int] = []
    for number, cells in read_rows(path, COLUMNS, ADVICE, MAX_BYTES, keep_cut=False):
        t_ns.append(_time(path, number, cells[0]))
        if rising and len(t_ns) > 1 and t_ns[-1] <= t_ns[-2]:
            fault = f"t_s = {shortened(cells[0])} after {t_ns[-2] / NS_PER_S:.9g}"
            raise InputError(
                f"{path}:{number}: time does not increase ({fault}); sort the rows, and give one"
                " recording"
            )
        valid.append(is_valid(path, number, cells[5]))
        own_q = [math.nan] * 4
        if valid[-1]:
            own_q = finite_numbers(
                path, number, COLUMNS[1:], cells[1:5], "write valid = 0 where there is no answer"
            )
            if abs(math.hypot(*own_q) - 1) > NORM_TOLERANCE:
                fault = f"the norm of qw,qx,qy,qz is {math.hypot(*own_q):.6g}"
                raise InputError(
                    f"{path}:{number}: {fault}; write unit quaternions, within {NORM_TOLERANCE:g}"
                )
        q.append(own_q)
        line.append(number)
        if len(t_ns) > MAX_ROWS:
            raise InputError(f"{path}: more than {MAX_ROWS} rows; give a shorter recording")
    attitudes = np.array(q).reshape(len(q), 4)
    flags = np.array(valid, dtype=np.bool_)
    attitudes[flags] = normalise(attitudes[flags])
    return Telemetry(
        path, np.array(t_ns, dtype=np.int64), attitudes, flags, np.array(line, dtype=np.intp)
    )


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
