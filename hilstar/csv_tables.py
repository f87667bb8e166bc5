"""Rows of CSV tables: columns by name, an optional `valid`, and one line for an error."""

import csv
import math
from collections.abc import Iterator
from pathlib import Path

from hilstar.errors import InputError, shortened
from hilstar.reading import open_lines

VALID = "valid"
FLAGS = {"": True, "1": True, "0": False, "true": True, "false": False}


def read_rows(
    path: Path, columns: tuple[str, ...], advice: str, limit_bytes: int, more: tuple[str, ...] = (VALID,)
) -> Iterator[tuple[int, list[str]]]:
    """Line numbers with the cells of `columns` and of `more`, "" where these are not there.

    Blank rows and comments are skipped.

    Raises InputError, with `advice`, for a column that is missing or there twice, and for a row that is cut short.
    """
    with open_lines(path, advice, limit_bytes) as text:
        reader = csv.reader(text)
        try:
            rows = (row for row in reader if any(cell.strip() for cell in row) and not row[0].startswith("#"))
            header = [name.strip() for name in next(rows, [])]
            wrong = [f"{name} is missing" for name in columns if name not in header]
            wrong += [f"{name} is there twice" for name in columns if header.count(name) > 1]
            if wrong:
                raise InputError(f"{path}:{max(reader.line_num, 1)}: column {wrong[0]}; {advice}")
            places = [header.index(name) if name in header else None for name in (*columns, *more)]
            for row in rows:
                if len(row) < len(header):
                    raise InputError(f"{path}:{reader.line_num}: {len(row)} cells and {len(header)} columns; {advice}")
                yield reader.line_num, ["" if place is None else row[place].strip() for place in places]
        except csv.Error as error:
            raise InputError(f"{path}:{reader.line_num}: not CSV ({error}); {advice}") from error


def is_valid(path: Path, line: int, cell: str) -> bool:
    """The flag in a cell of `valid`. Raises InputError."""
    if cell.lower() not in FLAGS:
        raise InputError(f"{path}:{line}: valid = {shortened(cell)!r}; write 1 or 0")
    return FLAGS[cell.lower()]


def finite_numbers(path: Path, line: int, columns: tuple[str, ...], cells: list[str], advice: str) -> list[float]:
    """The numbers of the cells of `columns`. Raises InputError, with `advice`, for a cell without a finite number."""
    numbers = []
    for name, cell in zip(columns, cells, strict=True):
        try:
            numbers.append(float(cell))
        except ValueError:
            numbers.append(math.nan)
        if not math.isfinite(numbers[-1]):
            raise InputError(f"{path}:{line}: {name} = {shortened(cell)!r} is not a finite number; {advice}")
    return numbers
