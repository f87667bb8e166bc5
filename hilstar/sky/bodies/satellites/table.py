"""A table of what users know of satellites: their brightness, flashes and sizes, by catalogue number."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Sequence

import numpy as np

from hilstar.errors import InputError, shortened
from hilstar.sky.bodies.satellites.elements import Satellite
from hilstar.sky.bodies.satellites.light import Brightness
from hilstar.units import flux_ratio

KEY = "norad"
# Each column that a row may leave empty, with its limits.
COLUMNS = {
    "standard_mag": (-30.0, 50.0),
    "period_s": (1e-3, 1e7),
    "amplitude_mag": (0.0, 20.0),
    "flash_s": (1e-4, 5e6),
    "flash_at_s": (-1e10, 1e10),
    "size_m": (0.0, 1e5),
}
ADVICE = f"write a CSV with the columns {KEY},{','.join(COLUMNS)}, of which only the first has to be there"
Row = dict[str, float]


def read_table(text: str, file: str) -> dict[int, Row]:
    """The rows of a table by catalogue number, each with the columns that are filled. Raises InputError with the line."""
    lines = _lines(text, file)
    at, header = next(lines, (1, []))
    names = [name.lower() for name in header]
    unknown = [name for name in names if name != KEY and name not in COLUMNS]
    if KEY not in names or unknown or len(set(names)) < len(names):
        wrong = f"no column {shortened(unknown[0])!r} is known" if unknown else f"no header with {KEY} and each column once"
        raise InputError(f"{file}:{at}: {wrong}; {ADVICE}")
    rows: dict[int, Row] = {}
    for at, cells in lines:
        where = f"{file}:{at}"
        if len(cells) > len(names):
            raise InputError(f"{where}: {len(cells)} values for {len(names)} columns; {ADVICE}")
        row = dict(zip(names, cells, strict=False))
        number = _number(row.pop(KEY, ""), where)
        if number in rows:
            raise InputError(f"{where}: satellite {number} is there twice; leave one row")
        rows[number] = _values(row, where)
    return rows


def _lines(text: str, file: str) -> Iterator[tuple[int, list[str]]]:
    """Each line's number and cells, without empty ones and comments."""
    for at, line in enumerate(text.splitlines(), start=1):
        if line.strip() and not line.lstrip().startswith("#"):
            try:
                yield at, [cell.strip() for cell in next(csv.reader([line], strict=True))]
            except csv.Error as error:
                raise InputError(f"{file}:{at}: {error}; {ADVICE}") from error


def _number(text: str, where: str) -> int:
    from sgp4.alpha5 import from_alpha5

    try:
        return int(from_alpha5(text) if len(text) <= 5 else text)
    except (ValueError, IndexError, KeyError) as error:
        raise InputError(f"{where}: {KEY} = {shortened(text)!r}; write a catalogue number, such as 25544") from error


def _values(row: dict[str, str], where: str) -> Row:
    values: Row = {}
    for name, text in row.items():
        if not text:
            continue
        low, high = COLUMNS[name]
        try:
            values[name] = float(text)
        except ValueError:
            values[name] = math.nan
        if not low <= values[name] <= high:
            raise InputError(f"{where}: {name} = {shortened(text)!r}; write {low:g} to {high:g}, or leave it empty")
    if "amplitude_mag" in values or "flash_s" in values or "period_s" in values:
        if "period_s" not in values or "amplitude_mag" not in values:
            raise InputError(f"{where}: light that varies has a period_s and an amplitude_mag; write both")
        if values.get("flash_s", 0.0) > values["period_s"] / 2:
            raise InputError(f"{where}: flash_s is over half of period_s; leave it out: the light then goes up and down")
    return values


def brightness_of(satellites: Sequence[Satellite], rows: dict[int, Row], default_mag: float, v0_e_per_s: float) -> Brightness:
    """The brightness of satellites by a table's rows and a standard magnitude for those that have none.

    `v0_e_per_s` is the electron rate of sunlight of V = 0.
    """

    def column(name: str, default: float) -> np.ndarray:
        return np.array([rows.get(one.number, {}).get(name, default) for one in satellites], dtype=np.float64)

    return Brightness(
        standard_e_per_s=v0_e_per_s * flux_ratio(column("standard_mag", default_mag)),
        period_s=column("period_s", math.nan),
        amplitude_mag=column("amplitude_mag", 0.0),
        flash_s=column("flash_s", math.nan),
        flash_at_s=column("flash_at_s", 0.0),
        size_m=column("size_m", 0.0),
    )
