"""From a catalogue's own passbands to Johnson V, B-V and Cousins V-I, by published relations.

Which column of a table is which: the names of Gaia, Tycho-2, Hipparcos and this project, and what
their units say.

Tables of stars as files: FITS, VOTable, ECSV and CSV through Astropy, only the columns that are
used.
"""

import io
import itertools
import re
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from numpy.polynomial.polynomial import polyval

from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError, cannot_read, shortened, size_text
from hilstar.basics.image_files import ImageSizeError, is_fits, unpacked
from hilstar.basics.reading import (
    HEAD_BYTES,
    kind_of,
    named_bytes,
    open_named,
    wide_encoding,
)
from hilstar.basics.text_tables import NO_NUMBERS, TextTable, open_table
from hilstar.basics.units import ascii_text, factor, is_unit, plain_unit, suffix_unit
from hilstar.sky.catalog import load_catalog

# BT - VT to V - VT, and to (B - V) - (BT - VT) in the blue and in the red: Mamajek, Meyer and
# Liebert 2002, AJ 124, 1670, appendix C, with the sign of the erratum (2006, AJ 131, 2360). For
# -0.25 < BT - VT < 2; beyond, the offsets of the ends.
TYCHO_RANGE_MAG, TYCHO_RED_MAG = (-0.25, 2.0), 0.5
V_FROM_VT = (9.7e-4, -0.1334, 0.05486, -0.01998)
BV_BLUE, BV_RED = (-0.006, -0.1069, 0.1459), (0.0, -0.007813, -0.1489, 0.03384)

# BP - RP to G - V and to G - I: Riello et al. 2021, A&A 649, A3, table C.2 (Gaia DR3 documentation,
# table 5.9), scatter 0.030 and 0.038 mag, for -0.5 < BP - RP < 4.5; beyond, the values of the ends.
GAIA_RANGE_MAG = (-0.5, 4.5)
G_LESS_V = (-0.02704, 0.01424, -0.2156, 0.01426)
G_LESS_I = (0.01753, 0.76, -0.0991)

# V - I to B - V: the median of Hipparcos' stars in bins of this width and at least so many.
BIN_MAG, MIN_STARS = 0.05, 20
# Names in lower case, the first that a table has is taken. A later pair of places fills the rows of
# an earlier one that are blank: Tycho-2 has no mean place for one star in 20.
PLACES = (
    ("ra", "dec"),
    ("ramdeg", "demdeg"),
    ("ra_icrs", "de_icrs"),
    ("raicrs", "deicrs"),
    ("ra_deg", "dec_deg"),
    ("radeg", "dedeg"),
    ("raj2000", "dej2000"),
    ("ra(icrs)", "de(icrs)"),
    ("rarad", "derad"),
    ("ra_icrs_", "de_icrs_"),
    ("_raj2000", "_dej2000"),
)
NAMES: dict[str, tuple[str, ...]] = {
    "pm_ra_cosdec_mas_yr": ("pmra", "pm_ra_cosdec_mas_yr", "pm_ra_cosdec", "pm_ra"),
    "pm_dec_mas_yr": ("pmdec", "pmde", "pm_dec_mas_yr", "pm_dec"),
    "parallax_mas": ("parallax", "plx", "parallax_mas"),
    "maximum_jd": ("epoch_jd",),
    "period_d": ("period_d",),
    "amplitude_mag": ("amplitude_mag",),
    "epoch_jyear": ("ref_epoch", "epoch_jyear"),
    "v_mag": ("v_mag", "vmag", "v"),
    "b_mag": ("b_mag", "bmag", "b"),
    "bv_mag": ("bv_mag", "b-v", "b_v", "bv"),
    "vi_mag": ("vi_mag", "v-i", "v_i", "vi"),
    "bt_mag": ("btmag", "bt_mag", "bt"),
    "vt_mag": ("vtmag", "vt_mag", "vt"),
    "g_mag": ("phot_g_mean_mag", "gmag", "g"),
    "bp_mag": ("phot_bp_mean_mag", "bpmag"),
    "rp_mag": ("phot_rp_mean_mag", "rpmag"),
    "bp_rp_mag": ("bp_rp", "bp-rp"),
    "gaia": ("source_id", "source"),
    "tyc1": ("tyc1",),
    "tyc2": ("tyc2",),
    "tyc3": ("tyc3",),
    "hip": ("hip",),
}
# What `hilstar catalogue` alone asks for: the errors of Gaia, Tycho-2, Hipparcos and this project,
# and the MK type.
SPECTRAL_TYPE = "spectral_type"
ERROR_NAMES: dict[str, tuple[str, ...]] = {
    "sigma_ra_mas": (
        "ra_error",
        "e_ra_icrs",
        "e_raicrs",
        "e_radeg",
        "e_raj2000",
        "e_ramdeg",
        "sigma_ra_mas",
    ),
    "sigma_dec_mas": (
        "dec_error",
        "e_de_icrs",
        "e_deicrs",
        "e_dedeg",
        "e_dej2000",
        "e_demdeg",
        "sigma_dec_mas",
    ),
    "sigma_parallax_mas": ("parallax_error", "e_plx", "sigma_parallax_mas"),
    "sigma_pm_ra_mas_yr": ("pmra_error", "e_pmra", "sigma_pm_ra_mas_yr"),
    "sigma_pm_dec_mas_yr": ("pmdec_error", "e_pmde", "sigma_pm_dec_mas_yr"),
    "ra_dec_correlation": ("ra_dec_corr", "ra_dec_correlation"),
    "ra_pm_ra_correlation": ("ra_pmra_corr", "ra_pm_ra_correlation"),
    "dec_pm_ra_correlation": ("dec_pmra_corr", "dec_pm_ra_correlation"),
    "ra_pm_dec_correlation": ("ra_pmdec_corr", "ra_pm_dec_correlation"),
    "dec_pm_dec_correlation": ("dec_pmdec_corr", "dec_pm_dec_correlation"),
    "pm_ra_pm_dec_correlation": ("pmra_pmdec_corr", "pm_ra_pm_dec_correlation"),
    "sigma_measured_mag": ("e_vmag", "sigma_v_mag"),
    "sigma_bv_mag": ("e_b-v", "e_b_v", "sigma_b_v_mag"),
    "sigma_vi_mag": ("e_v-i", "e_v_i", "sigma_v_i_mag"),
    SPECTRAL_TYPE: ("sptype", "sp_type", "spectral_type", "mk"),
}
COLUMNS_WANTED = (
    "name V with B-V or V-I (vmag, b-v, v-i), Tycho's vtmag and btmag, or Gaia's phot_g_mean_mag"
    " with bp_rp or with phot_bp_mean_mag and phot_rp_mean_mag"
)
# The roles whose figures are identifiers.
WHOLE = ("gaia", "tyc1", "tyc2", "tyc3", "hip")
MAX_NAMED = 12
HOURS = ("h", "hr", "hrs", "hour", "hours", "hourangle")
IN_RADIANS = ("rarad", "derad")
SEXAGESIMAL = {"h:m:s": "hourangle", "d:m:s": "deg"}
MAX_WHOLE_FLOAT = {4: 2.0**24, 8: 2.0**53}  # by a float's bytes: beyond, it holds no identifier
UNITS = {
    "deg": ("ra_deg", "dec_deg"),
    "mas / yr": (
        "pm_ra_cosdec_mas_yr",
        "pm_dec_mas_yr",
        "sigma_pm_ra_mas_yr",
        "sigma_pm_dec_mas_yr",
    ),
    "mas": ("parallax_mas", "sigma_ra_mas", "sigma_dec_mas", "sigma_parallax_mas"),
}
UNIT_OF = {role: unit for unit, roles in UNITS.items() for role in roles}
FILE_WANTED = "give a table of stars as FITS, ECSV, CSV or VOTable, or the CDS I/239 hip_main.dat"
MAX_TABLE_BYTES = 4_000_000_000
MAX_XML_BYTES = 500_000_000  # a VOTable is parsed as a whole
MAX_HEAD_BYTES = 1_000_000  # lines before a text's rows
MAX_ROWS = 10_000_000
CHUNK_BYTES = 64_000_000  # parsed at once
# Astropy compares them letter by letter.
BLANKS = sorted(
    {"NaN", "NaT"}.union(NO_NUMBERS, map(str.upper, NO_NUMBERS), map(str.capitalize, NO_NUMBERS))
)
UNIT_SEPARATOR = "\x1f"
ELSEWHERE = re.compile(rb"<STREAM\b[^>]*\bhref\s*=", re.IGNORECASE)


def from_tycho(bt_mag: FloatArray, vt_mag: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Johnson V and B-V, shape (n,), of Tycho's BT and VT."""
    colour = bt_mag - vt_mag
    held = np.clip(colour, *TYCHO_RANGE_MAG)
    offset = np.where(held < TYCHO_RED_MAG, polyval(held, BV_BLUE), polyval(held, BV_RED))
    return vt_mag + polyval(held, V_FROM_VT), colour + offset


def from_gaia(g_mag: FloatArray, bp_rp_mag: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Johnson V and Cousins V-I, shape (n,), of Gaia's G and BP-RP (DR3)."""
    held = np.clip(bp_rp_mag, *GAIA_RANGE_MAG)
    g_less_v = polyval(held, G_LESS_V)
    return g_mag - g_less_v, polyval(held, G_LESS_I) - g_less_v


def bv_from_vi(vi_mag: FloatArray) -> FloatArray:
    """The B-V, shape (n,), that Hipparcos' stars of that V-I have in the median; the colours of
    its ends beyond them.
    """
    return np.asarray(np.interp(vi_mag, *_bv_along_vi()))


@cache
def _bv_along_vi() -> tuple[FloatArray, FloatArray]:
    """V-I of the bins that are full enough, and the median B-V in each."""
    stars = load_catalog()
    known = np.isfinite(stars.vi_mag)
    bv_mag = stars.bv_mag[known]
    vi_mag = stars.vi_mag[known]
    order = np.argsort(vi_mag, kind="stable")
    bins, start = np.unique(np.round(vi_mag[order] / BIN_MAG), return_index=True)
    parts = np.split(bv_mag[order], start[1:])
    full_vi_mag = []
    median_bv_mag = []
    for middle, part in zip(bins * BIN_MAG, parts, strict=True):
        if len(part) >= MIN_STARS:
            full_vi_mag.append(middle)
            median_bv_mag.append(np.median(part))
    return np.array(full_vi_mag), np.array(median_bv_mag)


Converted = tuple[FloatArray, FloatArray, FloatArray]


@dataclass(frozen=True, slots=True)
class Route:
    """One way from a table's magnitudes to V, B-V and V-I, (n,) each, V-I NaN where it is not
    known.
    """

    roles: tuple[str, ...]
    words: str
    convert: Callable[..., Converted]


def _given(v: FloatArray, bv: FloatArray) -> Converted:
    """Johnson's own, without V-I."""
    return v, bv, np.full(len(v), np.nan)


def _by_vi(v: FloatArray, vi: FloatArray) -> Converted:
    return v, bv_from_vi(vi), vi


def _by_tycho(vt: FloatArray, bt: FloatArray) -> Converted:
    v, bv = from_tycho(bt, vt)
    return v, bv, np.full(len(v), np.nan)


def _by_gaia(g: FloatArray, bp_rp: FloatArray) -> Converted:
    return _by_vi(*from_gaia(g, bp_rp))


# The best first.
ROUTES = (
    Route(("v_mag", "bv_mag"), "V and B-V as given", _given),
    Route(("v_mag", "vi_mag"), "V and V-I as given, B-V of Hipparcos' stars of that V-I", _by_vi),
    Route(("v_mag", "b_mag"), "B and V as given", lambda v, b: _given(v, b - v)),
    Route(
        ("vt_mag", "bt_mag"), "V and B-V from Tycho's BT and VT (Mamajek et al. 2002)", _by_tycho
    ),
    Route(
        ("g_mag", "bp_rp_mag"), "V and V-I from Gaia's G, BP and RP (Riello et al. 2021)", _by_gaia
    ),
    Route(
        ("g_mag", "bp_mag", "rp_mag"),
        "V and V-I from Gaia's G, BP and RP (Riello et al. 2021)",
        lambda g, bp, rp: _by_gaia(g, bp - rp),
    ),
)


@dataclass(frozen=True, slots=True)
class Layout:
    """The table's column for each role, the pairs that give places, and the sets of roles that
    give V and a colour.
    """

    role: Mapping[str, str]
    places: tuple[tuple[str, str], ...]
    magnitudes: tuple[tuple[str, ...], ...]

    def needed(self) -> list[str]:
        """The columns to read."""
        return sorted({*self.role.values(), *itertools.chain(*self.places)})


def layout_of(
    path: Path, names: Sequence[str], roles: Mapping[str, tuple[str, ...]] = NAMES
) -> Layout:
    """Which of a table's columns have the `roles`, by their names with or without a unit at the end
    (`ra_hours`).

    Raises InputError where there is no place or no magnitude with a colour, and for a column that
    is there twice.
    """
    layout = _layout_by(_plain_names(names, roles), roles)
    shown = [shortened(name, 40) for name in names[:MAX_NAMED]]
    if len(names) > MAX_NAMED:
        shown.append("...")
    columns = ", ".join(shown)
    if not layout.places:
        pairs = ", ".join(f"{ra} and {dec}" for ra, dec in PLACES[:4])
        raise InputError(
            f"{path}: has no right ascension and declination among its columns ({columns}); name"
            f" them {pairs}"
        )
    if not layout.magnitudes:
        raise InputError(
            f"{path}: has no magnitude with a colour among its columns ({columns});"
            f" {COLUMNS_WANTED}"
        )
    columns_of_name = Counter(name.strip().lower() for name in names)
    for name in layout.needed():
        if columns_of_name[name.strip().lower()] > 1:
            raise InputError(f"{path}: column {name} is there twice; leave one of them")
    return layout


def _layout_by(known: Mapping[str, str], roles: Mapping[str, tuple[str, ...]]) -> Layout:
    """The layout of a table's names by the names that are known (`_plain_names`)."""
    places = []
    for ra, dec in PLACES:
        if ra in known and dec in known:
            places.append((known[ra], known[dec]))
    column_of: dict[str, str] = {}
    for role, synonyms in roles.items():
        for synonym in synonyms:
            if synonym in known:
                column_of[role] = known[synonym]
                break
    magnitudes = []
    for route in ROUTES:
        if column_of.keys() >= set(route.roles):
            magnitudes.append(route.roles)
    return Layout(column_of, tuple(places), tuple(magnitudes))


def _plain_names(names: Sequence[str], roles: Mapping[str, tuple[str, ...]]) -> dict[str, str]:
    """A table's names by the names that are known: in small letters, without a unit at the end
    where that one is not known.
    """
    known: dict[str, str] = {}
    for name in names:
        known.setdefault(name.strip().lower(), name)
    bases = set(itertools.chain(*PLACES, *roles.values()))
    for name in names:
        base, unit = _name_and_unit(name)
        if unit and base in bases:
            known.setdefault(base, name)
    return known


def _name_and_unit(name: str) -> tuple[str, str]:
    """A name in small letters and the unit at its end: "pmRA_arcsec_yr" is pmra and arcsec/yr."""
    plain = name.strip().lower()
    for place in range(1, len(plain)):
        if plain[place] in "_ ":
            unit = suffix_unit(plain[place + 1 :])
            if is_unit(unit):
                return plain[:place], unit
    return plain, ""


def unit_by_name(name: str) -> str | None:
    """The unit that a column's name says: `ra_hours`, `RArad`, `pm_ra_mas_yr`; None where it says
    none.
    """
    plain, unit = _name_and_unit(name)
    if unit:
        return unit
    if plain in IN_RADIANS:
        return "rad"
    return "deg" if plain.endswith("deg") else None


def factor_to(role: str, column: str, unit: str | None, path: Path) -> float:
    """By what a column's figures are multiplied to have the role's unit; 1 where the table says
    none. Raises InputError.
    """
    from astropy import units as u

    wanted = UNIT_OF.get(role)
    if unit is None or not unit.strip() or wanted is None:
        return 1.0
    by_spelling = factor(unit, wanted)
    if by_spelling is not None and (plain_unit(unit) not in HOURS or role == "ra_deg"):
        return float(by_spelling)
    try:
        stated = u.Unit(unit, parse_strict="raise")
        angles = u.dimensionless_angles()
        return float(stated.to(u.Unit(wanted), equivalencies=angles))
    except (ValueError, TypeError, u.UnitConversionError) as error:
        raise InputError(
            f"{path}: column {column} is in {shortened(unit)!r}; give it in"
            f" {wanted.replace(' ', '')}"
        ) from error


@dataclass(frozen=True, slots=True)
class RawTable:
    """The columns of a table by its own names: figures as float64 with NaN where blank, identifiers
    as int64 with 0.

    `unit` is as the table or the column's name states it; `notices` say what was taken that is not
    plain.
    """

    layout: Layout
    columns: Mapping[str, FloatArray | npt.NDArray[np.int64]]
    unit: Mapping[str, str | None]
    row_count: int
    notices: tuple[str, ...] = ()


def read_table(path: Path, roles: Mapping[str, tuple[str, ...]] = NAMES) -> RawTable:
    """Read the columns of a table of stars that have `roles`. Raises InputError for another
    file, or one that is too large.
    """
    with open_named(path, FILE_WANTED, MAX_TABLE_BYTES) as file:
        head = file.read(4096)
    kind = kind_of(head[:HEAD_BYTES])
    if kind == "a gzip file":
        packed = named_bytes(path, FILE_WANTED, MAX_TABLE_BYTES)
        if is_fits(packed):
            return _read_packed_fits(path, packed, roles)
    if kind is not None and kind != "a FITS file" and wide_encoding(head) is None:
        advice = FILE_WANTED
        if kind.endswith("zip file"):
            advice = "unpack it first"
        raise cannot_read(path, f"it is {kind}", advice)
    text = head.lstrip(b"\xef\xbb\xbf \r\n\t")
    if kind == "a FITS file":
        # one in memory is not opened again; a larger one is not read as a whole
        in_memory = open_named(path, FILE_WANTED, MAX_TABLE_BYTES)
        if isinstance(in_memory, io.BytesIO):
            return _read_fits(path, in_memory, roles)
        in_memory.close()
        return _read_fits(path, path, roles)
    if text[:5] == b"<?xml" or text[:8].upper() == b"<VOTABLE":
        return _read_votable(path, roles)
    if not text:
        raise InputError(f"{path}: is empty; {FILE_WANTED}")
    return _read_text(path, roles)


@contextmanager
def _quiet(path: Path) -> Iterator[None]:
    """Astropy's warnings silenced, and whatever its layers raise over a broken file as one line."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except InputError:
        raise
    except MemoryError as error:
        raise cannot_read(
            path, "it needs more memory than there is", "cut it to the stars that are used"
        ) from error
    except Exception as error:
        reason = f"{type(error).__name__}: {error}".rstrip(": ")
        raise cannot_read(path, reason, FILE_WANTED) from error


def _read_packed_fits(path: Path, packed: bytes, roles: Mapping[str, tuple[str, ...]]) -> RawTable:
    try:
        data = unpacked(packed, MAX_TABLE_BYTES)
    except ImageSizeError as error:
        raise InputError(f"{path}: {error}; {FILE_WANTED}") from error
    return _read_fits(path, io.BytesIO(data), roles)


def _read_fits(
    path: Path, source: Path | io.BytesIO, roles: Mapping[str, tuple[str, ...]]
) -> RawTable:
    from astropy.io import fits

    with _quiet(path), fits.open(source, memmap=isinstance(source, Path)) as hdus:
        tables = [hdu for hdu in hdus if isinstance(hdu, fits.BinTableHDU | fits.TableHDU)]
        if not tables:
            raise InputError(f"{path}: holds no table; {FILE_WANTED}")
        table = tables[0]
        layout = layout_of(path, table.columns.names, roles)
        _check_rows(path, int(table.header["NAXIS2"]))
        by_name = {column.name: column for column in table.columns}
        columns = {}
        unit = {}
        for name in layout.needed():
            column = by_name[name]
            values = np.asarray(table.data[name])
            mask = None
            if column.null is not None and values.dtype.kind in "iu":
                mask = values == column.null
            columns[name] = _numbers(path, layout, name, values, mask)
            unit[name] = column.unit or unit_by_name(name)
        return RawTable(layout, columns, unit, len(table.data))


def _read_votable(path: Path, roles: Mapping[str, tuple[str, ...]]) -> RawTable:
    from astropy.io import votable

    size_bytes = path.stat().st_size
    if size_bytes > MAX_XML_BYTES:
        reason = f"a VOTable of {size_text(size_bytes)}, {size_text(MAX_XML_BYTES)} at most"
        raise cannot_read(path, reason, "give it as FITS")
    content = named_bytes(path, FILE_WANTED, MAX_XML_BYTES)
    if ELSEWHERE.search(content):
        raise cannot_read(
            path,
            "its data are in another file or at another place",
            "give a VOTable that holds them",
        )
    with _quiet(path):
        table = votable.parse_single_table(io.BytesIO(content), verify="ignore")
        fields = {field.name: field for field in table.fields}
        layout = layout_of(path, list(fields), roles)
        _check_rows(path, len(table.array))
        columns = {}
        unit: dict[str, str | None] = {}
        array_names = table.array.dtype.names or ()
        for name in layout.needed():
            field = fields[name]
            array_name = field.ID if field.ID in array_names else name
            column = table.array[array_name]
            values = np.asarray(column.data)
            mask = np.ma.getmaskarray(column)
            columns[name] = _numbers(path, layout, name, values, mask)
            if field.unit is None:
                unit[name] = unit_by_name(name)
            else:
                unit[name] = str(field.unit)
        return RawTable(layout, columns, unit, len(table.array))


def _read_text(path: Path, roles: Mapping[str, tuple[str, ...]]) -> RawTable:
    with open_table(path, FILE_WANTED, MAX_TABLE_BYTES) as table:
        if not table.header or len(table.columns) < 2:
            raise cannot_read(path, "its first line names no columns", FILE_WANTED)
        names = [column.name for column in table.columns]
        by_yaml = _ecsv_units(path)
        layout = layout_of(path, names, roles)
        unit: dict[str, str | None] = {}
        for column in table.columns:
            unit[column.name] = column.unit or by_yaml.get(column.name) or unit_by_name(column.name)
        parts: dict[str, list[Any]] = {name: [] for name in layout.needed()}
        place = {name: names.index(name) for name in parts}
        count = 0
        with _quiet(path):
            for chunk in _chunks(table, list(place.values())):
                count += len(chunk)
                _check_rows(path, count)
                for name, pieces in parts.items():
                    column = chunk[_numbered(place[name])]
                    values, mask = _cells(column, unit[name])
                    pieces.append(_numbers(path, layout, name, values, mask))
    if not count:
        raise InputError(f"{path}: has no rows; {FILE_WANTED}")
    columns = {name: np.concatenate(pieces) for name, pieces in parts.items()}
    for name, stated in unit.items():
        if _turn_of(stated) is not None:
            unit[name] = "deg"  # which `_cells` made of them
    return RawTable(layout, columns, unit, count, tuple(table.notices))


def _turn_of(unit: str | None) -> str | None:
    """The unit of the first figure of sexagesimal places; None for another unit."""
    return SEXAGESIMAL.get((unit or "").strip('"'))


def _cells(column: Any, unit: str | None) -> tuple[npt.NDArray[Any], npt.NDArray[np.bool_]]:
    """A column's values and which are blank; sexagesimal ones as degrees."""
    values = np.asarray(column)
    mask = np.ma.getmaskarray(column)
    turn = _turn_of(unit)
    if turn is not None and values.dtype.kind == "U":
        values = _degrees(values, mask, turn)
    return values, mask


def _degrees(values: npt.NDArray[Any], mask: npt.NDArray[np.bool_], unit: str) -> FloatArray:
    """Sexagesimal texts as degrees, 0 where masked."""
    from astropy.coordinates import Angle

    texts = np.where(mask, "0", values)
    return np.asarray(Angle(texts, unit=unit).deg)


def _ecsv_units(path: Path) -> dict[str, str | None]:
    """The units of an ECSV's columns by its YAML head; nothing for other texts."""
    with open_named(path, FILE_WANTED, MAX_TABLE_BYTES) as file:
        head = file.read(MAX_HEAD_BYTES).decode("utf-8-sig", errors="replace")
    comments = []
    for line in head.splitlines():
        if line.startswith("#"):
            comments.append(line[1:].strip())
    if not comments or not comments[0].startswith("%ECSV"):
        return {}
    from astropy.table import meta

    with _quiet(path):
        yaml_lines = [line for line in comments if not line.startswith("%ECSV")]
        header = meta.get_header_from_yaml(yaml_lines)
    return {column["name"]: column.get("unit") for column in header["datatype"]}


def _numbered(place: int) -> str:
    """A column's name for Astropy, which takes none twice."""
    return f"column{place}"


def _chunks(table: TextTable, places: list[int]) -> Iterator[Any]:
    """Pieces of a text's rows as Astropy tables of the columns at `places`; its parser reads ASCII
    alone.
    """
    from astropy.io import ascii as text

    # A line that begins or ends with a tab has a blank cell there, and Astropy strips tabs.
    if table.delimiter == "\t":
        delimiter = UNIT_SEPARATOR
    else:
        delimiter = table.delimiter
    for number, lines in table.blocks(CHUNK_BYTES):
        block = _plain_block(table, "".join(lines))
        if not block.strip():
            continue
        options = {
            "format": "fast_no_header",
            "delimiter": delimiter,
            "comment": "#",
            "guess": False,
            "names": list(map(_numbered, range(len(table.columns)))),
            "include_names": list(map(_numbered, places)),
            "fill_values": [(blank, "0") for blank in BLANKS],
            "fast_reader": {"enable": "force"},
        }
        if not table.quoted:
            options["quotechar"] = UNIT_SEPARATOR if delimiter != UNIT_SEPARATOR else "\x1e"
        try:
            yield text.read(block, **options)
        except text.InconsistentTableError:
            options["delimiter"] = UNIT_SEPARATOR
            yield text.read(_even_block(table, number, lines), **options)


def _plain_block(table: TextTable, block: str) -> str:
    """A piece of a table in ASCII, with points in its numbers and no tab between its cells."""
    if not block.isascii():
        block = ascii_text(block).encode("ascii", "replace").decode()
    if table.decimal_comma:
        block = block.replace(",", ".")
    if table.delimiter == "\t":
        return block.replace("\t", UNIT_SEPARATOR)
    return block


def _even_block(table: TextTable, number: int, lines: list[str]) -> str:
    """The rows of a piece without blank cells behind the last column. Raises InputError for the
    first row of other cells.
    """
    rows = []
    for line, text in enumerate(lines, start=number):
        if text.strip() and not text.startswith("#"):
            try:
                rows.append(UNIT_SEPARATOR.join(table.row_of(line, text)))
            except InputError as error:
                raise cannot_read(
                    table.path, str(error).removeprefix(f"{table.path}:"), FILE_WANTED
                ) from error
    return _plain_block(table, "\n".join(rows) + "\n")


def _numbers(path: Path, layout: Layout, name: str, values: npt.NDArray[Any], mask: Any) -> Any:
    """A column as float64, int64 where it identifies the star, or bytes of the MK type. Raises
    InputError for other text.
    """
    if name == layout.role.get(SPECTRAL_TYPE):
        types = []
        for text in values.tolist():
            types.append(str(text).strip().encode("ascii", "replace"))
        texts = np.array(types, dtype=np.bytes_)
        if mask is None:
            return texts
        return np.where(mask, b"", texts)
    whole = name in {layout.role.get(role) for role in WHOLE}
    is_number = values.dtype.kind in "iufb"
    if not is_number and values.size == 0:
        raise InputError(f"{path}: has no rows; {FILE_WANTED}")
    if not is_number:
        first = str(values.flat[0])[:40]
        raise InputError(
            f"{path}: column {name} is no column of numbers (its first is {first!r}); write decimal"
            " figures, places in degrees"
        )
    if whole:
        plain = _whole_numbers(values)
        if mask is None:
            return plain
        return np.where(mask, 0, plain)
    figures = values.astype(np.float64)
    if mask is not None:
        figures[mask] = np.nan
    return figures


def _whole_numbers(values: npt.NDArray[Any]) -> npt.NDArray[np.int64]:
    """Identifiers as int64, 0 where a floating-point number is too large to hold each."""
    if values.dtype.kind != "f":
        return values.astype(np.int64)
    numbers = np.nan_to_num(values, nan=0.0)
    largest = MAX_WHOLE_FLOAT.get(values.dtype.itemsize, 2.0**53)
    lost = np.abs(numbers) > largest
    return np.where(lost, 0.0, numbers).astype(np.int64)


def _check_rows(path: Path, count: int) -> None:
    """Raise InputError for more than MAX_ROWS."""
    if count > MAX_ROWS:
        raise InputError(
            f"{path}: has more than {MAX_ROWS} rows; cut it to the magnitudes that the tracker sees"
        )
