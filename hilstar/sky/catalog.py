"""The Hipparcos main catalogue (ESA SP-1200, CDS I/239): packaged, or read from a `hip_main.dat`."""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from hilstar.arrays import FloatArray
from hilstar.errors import InputError, cannot_read, shortened
from hilstar.reading import open_lines

HIPPARCOS_EPOCH_JYEAR = 1991.25
PACKAGED_CATALOG = Path(__file__).resolve().parent / "data" / "hipparcos.npz"

# Fields of hip_main.dat (CDS I/239 ReadMe): name -> (column counted from 0, steps per unit).
# Every figure in the file is a decimal of fixed depth, so integers hold it without loss.
FIELDS: dict[str, tuple[int, int]] = {
    "hip": (1, 1),
    "v_mag": (5, 100),
    "ra_deg": (8, 10**8),
    "dec_deg": (9, 10**8),
    "pm_ra_cosdec_mas_yr": (12, 100),
    "pm_dec_mas_yr": (13, 100),
    "bv_mag": (37, 1000),
    "vi_mag": (40, 100),
}
COLUMN_COUNT = 78
MAX_CATALOGUE_BYTES = 100_000_000  # hip_main.dat has 53 MB
REQUIRED = ("v_mag", "ra_deg", "dec_deg", "bv_mag")


@dataclass(frozen=True, slots=True)
class Catalog:
    """Stars with a position, V and B-V; ICRS, epoch J1991.25; every array has shape (n,).

    `pm_ra_cosdec_mas_yr` carries the cos(dec), as Hipparcos publishes it. `vi_mag` is NaN where the
    catalogue gives none. `rows_read` counts all rows of the source, skipped ones included.
    """

    hip: npt.NDArray[np.int32]
    ra_deg: FloatArray
    dec_deg: FloatArray
    pm_ra_cosdec_mas_yr: FloatArray
    pm_dec_mas_yr: FloatArray
    v_mag: FloatArray
    bv_mag: FloatArray
    vi_mag: FloatArray
    rows_read: int

    def __len__(self) -> int:
        return len(self.hip)

    def brighter_than(self, faintest_v_mag: float) -> Catalog:
        """The stars with v_mag <= `faintest_v_mag` (inclusive)."""
        keep = self.v_mag <= faintest_v_mag
        columns = {name: getattr(self, name)[keep] for name in FIELDS}
        return Catalog(**columns, rows_read=self.rows_read)


def load_catalog(source: str | Path = "hipparcos") -> Catalog:
    """Load the packaged catalogue ("hipparcos") or a user's own `hip_main.dat`.

    Raises InputError when the file is missing or is not a Hipparcos main catalogue.
    """
    if str(source) == "hipparcos":
        with np.load(PACKAGED_CATALOG) as packed:
            return unpack({name: packed[name] for name in FIELDS}, int(packed["rows_read"]))
    path = Path(source)
    columns, rows_read = read_hip_main(path)
    return unpack(columns, rows_read)


def read_hip_main(path: Path) -> tuple[dict[str, npt.NDArray[np.int64]], int]:
    """Read a `hip_main.dat` into integer steps (see FIELDS) of the usable stars, and its row count.

    A missing V-I becomes the smallest int64. Raises InputError with the line number.
    """
    rows: list[list[int]] = []
    rows_read = 0
    try:
        with open_lines(path, "give the CDS I/239 hip_main.dat", MAX_CATALOGUE_BYTES) as lines:
            for line_number, row in enumerate(csv.reader(lines, delimiter="|", quoting=csv.QUOTE_NONE), start=1):
                if not row:
                    continue
                rows_read += 1
                steps = _parse_row(row, f"{path}:{line_number}")
                if steps is not None:
                    rows.append(steps)
    except csv.Error as error:
        raise cannot_read(path, error, "give the CDS I/239 hip_main.dat") from error
    if not rows:
        raise InputError(f"{path}: holds no star with position, V and B-V; give the CDS I/239 hip_main.dat")
    table = np.array(rows, dtype=np.int64)
    return {name: table[:, i] for i, name in enumerate(FIELDS)}, rows_read


MISSING = np.iinfo(np.int64).min
# The range of each field; beyond it no rate or place means anything.
RANGES: dict[str, tuple[float, float]] = {
    "hip": (0, 2**31 - 1),
    "v_mag": (-30, 40),
    "ra_deg": (0, 360),
    "dec_deg": (-90, 90),
    "pm_ra_cosdec_mas_yr": (-20_000, 20_000),  # Barnard's star: 10 400
    "pm_dec_mas_yr": (-20_000, 20_000),
    "bv_mag": (-10, 20),
    "vi_mag": (-10, 20),
}


def _parse_row(row: list[str], where: str) -> list[int] | None:
    if len(row) != COLUMN_COUNT or row[0] != "H":
        raise InputError(f"{where}: not a row of hip_main.dat ({COLUMN_COUNT} fields after 'H|'); give the CDS I/239 file")
    steps: dict[str, int] = {}
    for name, (column, per_unit) in FIELDS.items():
        text = row[column].strip()
        if not text:
            if name in REQUIRED:
                return None
            steps[name] = 0 if name.startswith("pm_") else int(MISSING)
            continue
        low, high = RANGES[name]
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not low <= value <= high:
            shown = shortened(text)
            raise InputError(f"{where}: field {column} ({name}) is {shown!r}; write a number from {low:g} to {high:g}")
        steps[name] = round(value * per_unit)
    return list(steps.values())


def unpack(columns: dict[str, npt.NDArray[np.int64]], rows_read: int) -> Catalog:
    """Turn integer steps (see FIELDS) into a Catalog in physical units."""
    values: dict[str, FloatArray] = {}
    for name, (_, per_unit) in FIELDS.items():
        steps = columns[name]
        values[name] = steps / per_unit
        if name == "vi_mag":
            values[name] = np.where(steps == np.iinfo(steps.dtype).min, np.nan, values[name])
    hip = columns["hip"].astype(np.int32)
    return Catalog(hip=hip, **{k: v for k, v in values.items() if k != "hip"}, rows_read=rows_read)
