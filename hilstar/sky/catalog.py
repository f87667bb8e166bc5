"""The Hipparcos main catalogue (ESA SP-1200, CDS I/239): packaged, or read from a `hip_main.dat`.

What people call bright stars: Bayer's letters, Flamsteed's numbers and proper names, by HIP number.
"""

import csv
import math
from dataclasses import dataclass, fields, replace
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from hilstar.basics.arrays import BoolArray, Float32Array, FloatArray, IntArray
from hilstar.basics.errors import InputError, cannot_read, shortened
from hilstar.basics.reading import open_lines

HIPPARCOS_EPOCH_JYEAR = 1991.25
PACKAGED_CATALOG = Path(__file__).resolve().parent / "data" / "hipparcos.npz"

# Fields of hip_main.dat (CDS I/239 ReadMe): name -> (column counted from 0, steps per unit).
# Every figure in the file is a decimal of fixed depth, so integers hold it without loss.
FIELDS: dict[str, tuple[int, int]] = {
    "hip": (1, 1),
    "v_mag": (5, 100),
    "ra_deg": (8, 10**8),
    "dec_deg": (9, 10**8),
    "parallax_mas": (11, 100),
    "pm_ra_cosdec_mas_yr": (12, 100),
    "pm_dec_mas_yr": (13, 100),
    "bv_mag": (37, 1000),
    "vi_mag": (40, 100),
    "hp_brightest_mag": (49, 100),
    "hp_faintest_mag": (50, 100),
    "period_d": (51, 100),
    "separation_arcsec": (64, 1000),
}
# Fields of one letter, kept as its code point; a blank one is 0.
LETTERS = {"variable": 52, "multiple": 59}
COLUMN_COUNT = 78
MAX_CATALOGUE_BYTES = 100_000_000  # hip_main.dat has 53 MB
REQUIRED = ("hip", "v_mag", "ra_deg", "dec_deg", "bv_mag")
ZERO_WHERE_MISSING = ("pm_ra_cosdec_mas_yr", "pm_dec_mas_yr")
# Field H52: stars whose light varies by themselves. C is constant; D and R are neighbours' light
# and revised colours.
VARIABLE_TYPES = b"PUM"

# A Tycho number TYC1-TYC2-TYC3 as one integer: TYC1 to 9537, TYC2 to 12121, TYC3 to 3.
TYCHO, TYC_REGION = "TYC", 1_000_000
MAX_DIGITS = 19  # a 64-bit identifier

Letters = npt.NDArray[np.bytes_]
STAR_NAMES = Path(__file__).resolve().parent / "data" / "star_names.csv"
MISSING = np.iinfo(np.int64).min
# The range of each field; beyond it no rate or place means anything.
RANGES: dict[str, tuple[float, float]] = {
    "hip": (0, 2**31 - 1),
    "v_mag": (-30, 40),
    "ra_deg": (0, 360),
    "dec_deg": (-90, 90),
    "parallax_mas": (-1000, 1000),  # Proxima: 772
    "pm_ra_cosdec_mas_yr": (-20_000, 20_000),  # Barnard's star: 10 400
    "pm_dec_mas_yr": (-20_000, 20_000),
    "bv_mag": (-10, 20),
    "vi_mag": (-10, 20),
    "hp_brightest_mag": (-30, 40),
    "hp_faintest_mag": (-30, 40),
    "period_d": (0, 100_000),
    "separation_arcsec": (0, 1000),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Catalog:
    """Stars with a position, V and B-V; ICRS, each at its own epoch; every array has shape (n,).

    `pm_ra_cosdec_mas_yr` carries the cos(dec), as Hipparcos publishes it. `vi_mag` and
    `parallax_mas` are NaN where the catalogue gives none. `hip` is 0 for stars of another
    catalogue, which `designation` and `identifier` name instead. `variable` is Hipparcos' type of a
    variable star (P periodic, U unsolved, M within 0.03 mag; blank for others), which varies by
    `range_mag` in Hp with `period_d`, NaN where none is given; `maximum_jd` is a time of its
    largest light, which a user's table may have. `multiple` is its flag H59 of doubles (C resolved,
    G accelerated, O orbit, V variability-induced, X unexplained scatter), with `separation_arcsec`
    where it resolved the pair: V and the colours are then those of both, except for 472 of 11 101
    entries. `rows_read` counts all rows of the source, and `notes` say what became of them.
    """

    hip: npt.NDArray[np.int32]
    ra_deg: FloatArray
    dec_deg: FloatArray
    pm_ra_cosdec_mas_yr: FloatArray
    pm_dec_mas_yr: FloatArray
    v_mag: FloatArray
    bv_mag: FloatArray
    vi_mag: FloatArray
    parallax_mas: FloatArray
    epoch_jyear: FloatArray
    identifier: npt.NDArray[np.int64]
    variable: Letters
    range_mag: Float32Array
    period_d: Float32Array
    maximum_jd: FloatArray
    multiple: Letters
    separation_arcsec: Float32Array
    designation: str = "HIP"
    rows_read: int
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.hip)

    def taken(self, rows: IntArray | npt.NDArray[np.bool_]) -> "Catalog":
        """The stars at `rows`: places, or a mask (n,)."""
        columns = {name: getattr(self, name)[rows] for name in column_names()}
        return replace(self, **columns)

    def at_phase(self, jd: float) -> "Catalog":
        """The stars with their V at a Julian date: a sinusoid of magnitudes about V, of those
        that have a `maximum_jd`.
        """
        known = np.flatnonzero(np.isfinite(self.maximum_jd))
        turns = (jd - self.maximum_jd[known]) / self.period_d[known]
        v_mag = self.v_mag.copy()
        half_mag = self.range_mag[known] / 2
        v_mag[known] -= half_mag * np.cos(2 * np.pi * turns)
        is_variable = _vary(self.variable)
        count = int(is_variable.sum()) - len(known)
        note = (
            f"{len(known)} variable stars have their light of JD {jd:.4f}; {count} without an epoch"
            " of phase have their mean"
        )
        return replace(self, v_mag=v_mag, notes=(*self.notes, note))

    def brighter_than(self, faintest_v_mag: float) -> "Catalog":
        """The stars with v_mag <= `faintest_v_mag` (inclusive)."""
        # places: a mask is searched again for each column
        bright = np.flatnonzero(self.v_mag <= faintest_v_mag)
        if len(bright) == len(self):
            return self
        return self.taken(bright)

    def name(self, row: int) -> str:
        """The designation of the star at `row`: "HIP 26311", "Gaia DR3 4295806720", "TYC 1-2-3"."""
        if self.hip[row]:
            return f"HIP {self.hip[row]}"
        identifier = int(self.identifier[row])
        if self.designation == TYCHO:
            region, rest = divmod(identifier, TYC_REGION)
            number, component = divmod(rest, 10)
            return f"{TYCHO} {region}-{number}-{component}"
        return f"{self.designation} {identifier}"

    def identifier_of(self, name: str) -> int | None:
        """The identifier in a name that `name` gives to a star without a HIP number; None for
        any other text.
        """
        prefix = f"{self.designation} "
        if not self.designation or not name.startswith(prefix):
            return None
        numbers: list[int] = []
        for digits in name.removeprefix(prefix).split("-"):
            if not (digits.isascii() and digits.isdigit()) or len(digits) > MAX_DIGITS:
                return None
            numbers.append(int(digits))
        if self.designation == TYCHO:
            if len(numbers) != 3:
                return None
            region, number, component = numbers
            return region * TYC_REGION + number * 10 + component
        if len(numbers) != 1:
            return None
        return numbers[0]


def column_names() -> list[str]:
    """The names of a catalogue's arrays."""
    facts_of_all = ("designation", "rows_read", "notes")
    return [field.name for field in fields(Catalog) if field.name not in facts_of_all]


def plain_catalog(
    designation: str, rows_read: int, columns: dict[str, npt.NDArray[np.generic]]
) -> Catalog:
    """A catalogue of these `columns` (n,) alone, of which hip, v_mag, ra_deg and dec_deg have to be
    there.

    No motion, no parallax, no variability and no companion is known where the column is not given;
    the epoch is Hipparcos'.
    """
    n = len(columns["v_mag"])
    unknown = np.full(n, np.nan)
    zero = np.zeros(n)
    blank = np.zeros(n, dtype="S1")
    none: dict[str, npt.NDArray[np.generic]] = {
        **dict.fromkeys(("pm_ra_cosdec_mas_yr", "pm_dec_mas_yr", "bv_mag"), zero),
        **dict.fromkeys(("vi_mag", "parallax_mas", "maximum_jd"), unknown),
        **dict.fromkeys(("range_mag", "period_d", "separation_arcsec"), unknown.astype(np.float32)),
        **dict.fromkeys(("variable", "multiple"), blank),
        "hip": np.zeros(n, dtype=np.int32),
        "epoch_jyear": np.full(n, HIPPARCOS_EPOCH_JYEAR),
        "identifier": np.arange(1, n + 1, dtype=np.int64),
    }
    by_name: dict[str, Any] = none | columns
    return Catalog(**by_name, designation=designation, rows_read=rows_read)


def load_catalog(source: str | Path = "hipparcos", faintest_v_mag: float = math.inf) -> Catalog:
    """Load the packaged catalogue ("hipparcos"), of which fainter stars may be left out, or a
    user's own `hip_main.dat`.

    Raises InputError when the file is missing or is not a Hipparcos main catalogue.
    """
    if str(source) == "hipparcos":
        return _packaged(faintest_v_mag)
    path = Path(source)
    columns, rows_read = read_hip_main(path)
    return unpack(columns, rows_read)


@lru_cache(maxsize=4)
def _packaged(faintest_v_mag: float) -> Catalog:
    """The packaged catalogue in read-only arrays, read once: a verdict, a campaign and a study
    open several benches.
    """
    with np.load(PACKAGED_CATALOG) as packed:
        v_mag = packed["v_mag"] / FIELDS["v_mag"][1]
        bright = np.flatnonzero(v_mag <= faintest_v_mag)
        columns = {name: packed[name][bright] for name in (*FIELDS, *LETTERS)}
        catalog = unpack(columns, int(packed["rows_read"]))
    for name in column_names():
        getattr(catalog, name).setflags(write=False)
    return catalog


def read_hip_main(path: Path) -> tuple[dict[str, npt.NDArray[np.int64]], int]:
    """Read a `hip_main.dat` into integer steps (see FIELDS) of the usable stars, and its row count.

    A missing figure becomes the smallest int64. Raises InputError with the line number.
    """
    rows: list[list[int]] = []
    rows_read = 0
    try:
        with open_lines(path, "give the CDS I/239 hip_main.dat", MAX_CATALOGUE_BYTES) as lines:
            rows_of_fields = csv.reader(lines, delimiter="|", quoting=csv.QUOTE_NONE)
            for line_number, row in enumerate(rows_of_fields, start=1):
                if not row:
                    continue
                rows_read += 1
                steps = _parse_row(row, f"{path}:{line_number}")
                if steps is not None:
                    rows.append(steps)
    except csv.Error as error:
        raise cannot_read(path, error, "give the CDS I/239 hip_main.dat") from error
    if not rows:
        raise InputError(
            f"{path}: holds no star with position, V and B-V; give the CDS I/239 hip_main.dat"
        )
    table = np.array(rows, dtype=np.int64)
    names = (*FIELDS, *LETTERS)
    return dict(zip(names, table.T, strict=True)), rows_read


def _parse_row(row: list[str], where: str) -> list[int] | None:
    """The steps of a row's fields and its letters; None for a star without what is REQUIRED.
    Raises InputError.
    """
    if len(row) != COLUMN_COUNT or row[0] != "H":
        raise InputError(
            f"{where}: not a row of hip_main.dat ({COLUMN_COUNT} fields after 'H|'); give the CDS"
            " I/239 file"
        )
    steps: dict[str, int] = {}
    for name, (column, per_unit) in FIELDS.items():
        text = row[column].strip()
        if not text:
            if name in REQUIRED:
                return None
            steps[name] = 0 if name in ZERO_WHERE_MISSING else int(MISSING)
            continue
        low, high = RANGES[name]
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not low <= value <= high:
            shown = shortened(text)
            raise InputError(
                f"{where}: field {column} ({name}) is {shown!r}; write a number from {low:g} to"
                f" {high:g}"
            )
        steps[name] = round(value * per_unit)
    for name, column in LETTERS.items():
        text = row[column].strip()
        if len(text) > 1 or not text.isascii():
            raise InputError(
                f"{where}: field {column} ({name}) is {shortened(text)!r}; write one letter, or"
                " none"
            )
        steps[name] = ord(text) if text else 0
    return [*steps.values()]


def unpack(columns: dict[str, npt.NDArray[np.int64]], rows_read: int) -> Catalog:
    """Turn integer steps (see FIELDS) into a Catalog in physical units."""
    values: dict[str, FloatArray] = {}
    for name, (_, per_unit) in FIELDS.items():
        steps = columns[name]
        blank = np.iinfo(steps.dtype).min
        values[name] = np.where(steps == blank, np.nan, steps / per_unit)
    letters = {name: columns[name].astype(np.uint8).view("S1") for name in LETTERS}
    variable = letters["variable"]
    varies = _vary(variable)
    hip = columns["hip"].astype(np.int32)
    range_mag = values.pop("hp_faintest_mag") - values.pop("hp_brightest_mag")
    range_mag = np.where(varies, range_mag, np.nan)
    period_d = np.where(varies, values["period_d"], np.nan)
    plain: dict[str, npt.NDArray[Any]] = {
        "hip": hip,
        "identifier": hip.astype(np.int64),
        "variable": np.where(varies, variable, b""),
        "range_mag": range_mag.astype(np.float32),
        "period_d": period_d.astype(np.float32),
        "multiple": letters["multiple"],
        "separation_arcsec": values["separation_arcsec"].astype(np.float32),
    }
    return plain_catalog("HIP", rows_read, values | plain)


def _vary(variable: Letters) -> BoolArray:
    """Which stars (n,) vary by themselves, by their types."""
    types = [bytes([letter]) for letter in VARIABLE_TYPES]
    return np.isin(variable, types)


class StarName(NamedTuple):
    """A star's designation ("α Ori", "51 Peg") and its proper name ("Betelgeuse"), each "" where
    it has none.
    """

    designation: str
    name: str


@cache
def star_names() -> dict[int, StarName]:
    """The designations and names of 3300 stars by HIP number (see `tools/make_star_names.py`)."""
    star_of_hip: dict[int, StarName] = {}
    with STAR_NAMES.open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(line for line in file if not line.startswith("#")):
            hip = int(row["hip"])
            star_of_hip[hip] = StarName(row["designation"], row["name"])
    return star_of_hip


def label_of(hip: int) -> str:
    """A star's label on a chart: its designation, else its name, else its HIP number; "" without
    any.
    """
    designation, name = star_names().get(hip, ("", ""))
    if designation or name or not hip:
        return designation or name
    return f"HIP {hip}"
