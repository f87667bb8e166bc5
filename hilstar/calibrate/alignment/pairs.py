"""Commanded and reported attitudes, pair by pair: a table of both, or a tracker's telemetry beside a run's ledger."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hilstar.arrays import FloatArray, IntArray
from hilstar.attitude.wire.protocol import NORM_TOLERANCE
from hilstar.csv_tables import finite_numbers, is_valid, read_rows
from hilstar.errors import InputError
from hilstar.rotation import normalise

MAX_TABLE_BYTES = 200_000_000
MAX_ROWS = 100_000
COMMANDED, REPORTED = ("qw", "qx", "qy", "qz"), ("tw", "tx", "ty", "tz")
TELEMETRY = ("t_s", *COMMANDED)
SKIP = "delete the row, or write valid = 0"
PAIRS_ADVICE = f"write a CSV with the columns {','.join((*COMMANDED, *REPORTED))} (commanded, then the tracker's; scalar first)"
TELEMETRY_ADVICE = f"write a CSV with the columns {','.join(TELEMETRY)} and, where known, valid (1 or 0)"
MAX_T_S = 9e9  # of int64 nanoseconds


@dataclass(frozen=True, slots=True)
class Pairs:
    """Commanded and reported q_icrs_to_cam, (n, 4) each, unit, with each pair's line in its file.

    `rate_rad_s` (n, 3), cam, is the commanded turn where a ledger says it, else None. `skipped` counts the rows that are not
    valid, or had no commanded attitude. `names` are the reported columns.
    """

    source: Path
    line: IntArray
    commanded: FloatArray
    reported: FloatArray
    skipped: int = 0
    rate_rad_s: FloatArray | None = None
    names: tuple[str, ...] = REPORTED

    def __len__(self) -> int:
        return len(self.line)


@dataclass(frozen=True, slots=True)
class Telemetry:
    """A tracker's attitudes (n, 4) at times (n,), ns, with each one's line; `skipped` rows were not valid."""

    line: IntArray
    t_ns: IntArray
    reported: FloatArray
    skipped: int


def read_pairs(path: Path) -> Pairs:
    """The pairs of a table; rows with valid = 0 are skipped. Raises InputError with the line of what is no attitude."""
    lines, numbers, skipped = _read(path, (*COMMANDED, *REPORTED), PAIRS_ADVICE)
    commanded = _unit(path, lines, numbers[:, :4], COMMANDED)
    return Pairs(path, lines, commanded, _unit(path, lines, numbers[:, 4:], REPORTED), skipped)


def read_telemetry(path: Path) -> Telemetry:
    """A tracker's telemetry; rows with valid = 0 are skipped. Raises InputError with the line of what is no attitude."""
    lines, numbers, skipped = _read(path, TELEMETRY, TELEMETRY_ADVICE)
    t_s = numbers[:, 0]
    if (np.abs(t_s) > MAX_T_S).any():
        worst = int(np.argmax(np.abs(t_s)))
        raise InputError(f"{path}:{lines[worst]}: t_s = {t_s[worst]:g}; write seconds on the ledger's time base")
    return Telemetry(lines, np.round(t_s * 1e9).astype(np.int64), _unit(path, lines, numbers[:, 1:], COMMANDED), skipped)


def _read(path: Path, columns: tuple[str, ...], advice: str) -> tuple[IntArray, FloatArray, int]:
    """Line numbers (n,) and values (n, columns) of the valid rows, and how many were not."""
    lines, numbers, skipped = [], [], 0
    for line, cells in read_rows(path, columns, advice, MAX_TABLE_BYTES):
        if not is_valid(path, line, cells[-1]):
            skipped += 1
            continue
        lines.append(line)
        numbers.append(finite_numbers(path, line, columns, cells[:-1], SKIP))
        if len(lines) > MAX_ROWS:
            raise InputError(f"{path}: more than {MAX_ROWS} rows; write fewer")
    return np.array(lines, dtype=np.intp), np.array(numbers).reshape(len(lines), len(columns)), skipped


def _unit(path: Path, lines: IntArray, q: FloatArray, names: tuple[str, ...]) -> FloatArray:
    norm = np.sqrt((q * q).sum(axis=1))
    off = np.abs(norm - 1) > NORM_TOLERANCE
    if off.any():
        first = int(np.argmax(off))
        raise InputError(
            f"{path}:{lines[first]}: the norm of {','.join(names)} is {norm[first]:.6g}; write unit quaternions, within"
            f" {NORM_TOLERANCE:g}"
        )
    return normalise(q) if len(q) else q
