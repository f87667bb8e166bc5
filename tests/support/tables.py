"""Tables that commands and studies write, and readings as people write them."""

from __future__ import annotations

import csv
from collections.abc import Iterable
from pathlib import Path


def csv_rows(path: Path) -> list[dict[str, str]]:
    """The rows of a CSV file."""
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def readings_text(rows: Iterable[Iterable[object]], header: str = "code,channel,value") -> str:
    """Measurements of a monitor as a table."""
    lines = [",".join(map(str, row)) for row in rows]
    return "\n".join([header, *lines]) + "\n"


def write_readings(
    path: Path, rows: Iterable[Iterable[object]], header: str = "code,channel,value"
) -> Path:
    """Write them to a file; its path."""
    path.write_text(readings_text(rows, header))
    return path


def csv_numbers(path: Path) -> list[dict[str, float]]:
    """The rows of a table of numbers."""
    rows = []
    for row in csv_rows(path):
        rows.append({name: float(text) for name, text in row.items()})
    return rows
