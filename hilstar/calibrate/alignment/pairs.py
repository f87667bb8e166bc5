"""Commanded and reported attitudes, pair by pair: a table of both, or a tracker's telemetry beside a run's ledger."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hilstar.arrays import FloatArray, IntArray
from hilstar.attitude.wire.protocol import NORM_TOLERANCE
from hilstar.errors import InputError, shortened
from hilstar.reading import open_lines
from hilstar.rotation import normalise

MAX_TABLE_BYTES = 200_000_000
MAX_ROWS = 100_000
COMMANDED, REPORTED = ("qw", "qx", "qy", "qz"), ("tw", "tx", "ty", "tz")
TELEMETRY = ("t_s", *COMMANDED)
VALID = "valid"
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
    for line, cells in _rows(path, columns, advice):
        if not _is_valid(path, line, cells.get(VALID, "")):
            skipped += 1
            continue
        lines.append(line)
        numbers.append(_numbers(path, line, [cells[name] for name in columns], columns))
        if len(lines) > MAX_ROWS:
            raise InputError(f"{path}: more than {MAX_ROWS} rows; write fewer")
    return np.array(lines, dtype=np.intp), np.array(numbers).reshape(len(lines), len(columns)), skipped


def _rows(path: Path, columns: tuple[str, ...], advice: str) -> Iterator[tuple[int, dict[str, str]]]:
    with open_lines(path, advice, MAX_TABLE_BYTES) as text:
        reader = csv.reader(text)
        try:
            rows = (row for row in reader if any(cell.strip() for cell in row) and not row[0].startswith("#"))
            header = [name.strip() for name in next(rows, [])]
            missing = [name for name in columns if name not in header]
            if missing:
                raise InputError(f"{path}:{max(reader.line_num, 1)}: column {missing[0]} is missing; {advice}")
            repeated = [name for name in columns if header.count(name) > 1]
            if repeated:
                raise InputError(f"{path}:{reader.line_num}: column {repeated[0]} is there twice; {advice}")
            for row in rows:
                if len(row) < len(header):
                    raise InputError(f"{path}:{reader.line_num}: {len(row)} cells and {len(header)} columns; {advice}")
                yield reader.line_num, {name: row[place].strip() for place, name in enumerate(header)}
        except csv.Error as error:
            raise InputError(f"{path}:{reader.line_num}: not CSV ({error}); {advice}") from error


def _is_valid(path: Path, line: int, cell: str) -> bool:
    known = {"": True, "1": True, "0": False, "true": True, "false": False}
    if cell.lower() not in known:
        raise InputError(f"{path}:{line}: valid = {shortened(cell)}; write 1 or 0")
    return known[cell.lower()]


def _numbers(path: Path, line: int, cells: list[str], columns: tuple[str, ...]) -> list[float]:
    numbers = []
    for name, cell in zip(columns, cells, strict=True):
        try:
            numbers.append(float(cell))
        except ValueError:
            numbers.append(math.nan)
        if not math.isfinite(numbers[-1]):
            raise InputError(
                f"{path}:{line}: {name} = {shortened(cell)!r} is not a finite number; delete the row, or write valid = 0"
            )
    return numbers


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
