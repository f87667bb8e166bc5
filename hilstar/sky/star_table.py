"""From a table's columns to a catalogue: one unit for each figure, V and colours, and which rows
are no star.

A table's stars added to Hipparcos: in their overlap Hipparcos' star stands, and no other in its
place.

Catalogues made of tables, kept in the user's cache directory: whole or not at all, and made anew
where they are damaged.

A file is found by what it was made of. Nothing depends on it: without a cache directory, on a full
disk or beside another process that writes the same file, a table is read again.

The catalogue of a bench: the packaged one, a `hip_main.dat`, or a user's table, alone or added to
Hipparcos.
"""

import contextlib
import hashlib
import json
import logging
import math
import os
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.errors import HilstarError, InputError
from hilstar.basics.files import make_directory, whole_file
from hilstar.basics.reading import open_named, open_regular
from hilstar.basics.units import plain_unit
from hilstar.sky import table_reader
from hilstar.sky.catalog import (
    PACKAGED_CATALOG,
    RANGES,
    TYC_REGION,
    TYCHO,
    Catalog,
    column_names,
    load_catalog,
    plain_catalog,
)
from hilstar.sky.stars import cell_grid, unit_vectors_icrs

# Epochs of the places, Julian years, where a table has its catalogue's own names and no epoch.
EPOCH_OF_PLACES = {"ramdeg": 2000.0, "raicrs": 1991.25, "raj2000": 2000.0, "_raj2000": 2000.0}
GAIA_DR2_JYEAR, GAIA_DR3_JYEAR = 2015.5, 2016.0
EPOCHS_JYEAR = (1800.0, 2200.0)
# Right ascensions below this may be hours, and below 2 pi radians: without a unit they are refused,
# whatever the rest says.
HOURS_A_TURN, RAD_A_TURN = 24.0, 2 * math.pi
TURNS = {
    "h": HOURS_A_TURN,
    "hr": HOURS_A_TURN,
    "hrs": HOURS_A_TURN,
    "hou": HOURS_A_TURN,
    "rad": RAD_A_TURN,
}
ROUNDED = 1e-6  # of a turn in radians, as written
# Half of Hipparcos' stars move by more than 23 mas a year, of its brightest 900 by more than 60. In
# arcsec a year that is 0.06.
MIN_MEDIAN_MAS_YR, MOTION_STARS = 1.0, 3
MAX_AMPLITUDE_MAG = 10.0  # half of the range: chi Cygni has 5
MAX_STEM = 16  # characters of a file's name in the name of its stars, which has 32 in a truth table
UNIT_ADVICE = "give the column its unit"
# Two catalogues' places of one star at a common epoch differ by far less, but for orbits.
# Hipparcos' photometry has the light from both components of an unresolved pair.
SAME_ARCSEC = 2.0
# A star that is left alone there is looked for this far, where the magnitude has to agree as well.
FAR_ARCSEC, FAR_MAG = 10.0, 0.5
# A pair's orbit may have taken it so far past the separation that Hipparcos gives; no component is
# brighter than the sum by more than this.
PAIR_ARCSEC, PAIR_MAG = 2.0, 1.0
ODD_MAG = 1.0
OVERLAP_LIMIT_MAG = 0.03  # limit for the median
FEW_MATCHES, BRIGHT_STARS, BRIGHT_V_MAG = 0.5, 20, 7.0
RAD_PER_ARCSEC = np.pi / (180 * 3600)
NO_IDENTIFIER = (
    "no identifier of their own (blank, repeated, or a floating-point number: its 15 digits hold no"
    " source_id); all are named by their rows"
)
VERSION = 4  # version of the cached result: count up whenever it changes
KEPT_FILES = 6  # the newest; 250 MB each for 2.5 million stars
MAX_STORED_BYTES = 3_000_000_000
DTYPES = {"hip": "i4", "identifier": "i8", "variable": "S1", "multiple": "S1"} | dict.fromkeys(
    ("range_mag", "period_d", "separation_arcsec"), "f4"
)
MOTIONS = ("pm_ra_cosdec_mas_yr", "pm_dec_mas_yr")
ALWAYS_KNOWN = ("ra_deg", "dec_deg", "v_mag", "bv_mag", *MOTIONS)
log = logging.getLogger(__name__)
MAY_BE_UNKNOWN = ("vi_mag", "parallax_mas")
_STATE_EPOCH = "write [sky] catalogue_epoch_jyear, such as 2000.0"
_REASONS = (
    "",
    "without a place",
    "without a magnitude and a colour",
    "beyond what a star has",
    "repeated",
)


@dataclass(frozen=True, slots=True)
class Assembled:
    """A table's stars, one line about what became of its rows, and what else is to be said each
    time.
    """

    catalog: Catalog
    line: str
    dropped: int
    doubts: tuple[str, ...] = ()


def assemble(
    path: Path,
    table: table_reader.RawTable,
    stated_epoch_jyear: float | None,
    compared: bool = False,
) -> Assembled:
    """The stars of a table, whose epoch matters where they move or are to be `compared` with stars
    that do.

    Raises InputError where no row is a star, and where a unit or the epoch has to be stated.
    """
    columns = _Columns(path, table)
    columns.check_turn()
    ra_deg, dec_deg = columns.places()
    v_mag, bv_mag, vi_mag, notes = columns.magnitudes()
    pm = {role: columns.role(role, 0.0) for role in MOTIONS}
    figures: dict[str, npt.NDArray[Any]] = {
        "ra_deg": ra_deg,
        "dec_deg": dec_deg,
        "v_mag": v_mag,
        "bv_mag": bv_mag,
        "vi_mag": vi_mag,
        **pm,
        "parallax_mas": columns.role("parallax_mas", np.nan),
        **columns.variables(),
    }
    designation, identifier = columns.identifiers()
    reason = _dropped(figures)
    is_usable = reason == 0
    if not is_usable.any():
        raise InputError(
            f"{path}: none of its {len(reason)} rows is a star ({_reasons(reason)});"
            f" {table_reader.COLUMNS_WANTED}"
        )
    is_moving = any(motion[is_usable].any() for motion in pm.values())
    dated = compared or is_moving
    epoch, epoch_words = columns.epoch(stated_epoch_jyear, dated, designation)
    for doubt in (columns.places_doubt(), columns.motions_doubt(pm)):
        if doubt and not columns.is_gaia:
            raise InputError(f"{path}: {doubt}")
        if doubt:
            columns.notices.append(f"{doubt}; taken as Gaia's archive has it")
    repeats = _repeats(identifier[is_usable])
    if repeats:
        columns.notices.append(f"{repeats} of its stars have {NO_IDENTIFIER}")
        designation, identifier = columns.row_numbers()
    hip = columns.hip()
    repeated = _repeated_hip(hip, is_usable)
    if repeated:
        columns.notices.append(repeated)
    figures |= {
        "epoch_jyear": epoch,
        "identifier": identifier,
        "hip": _once(hip, is_usable, v_mag),
    }
    usable = {name: values[is_usable] for name, values in figures.items()}
    catalog = plain_catalog(designation, len(is_usable), usable)
    if is_usable.all():
        rest = ""
    else:
        rest = f"; not used: {_reasons(reason)}"
    line = (
        f"{path.name}: {len(catalog)} stars of {len(is_usable)} rows, {notes}; {epoch_words}{rest}"
    )
    doubts = tuple(f"{path.name}: {notice}" for notice in columns.notices)
    dropped = len(is_usable) - len(catalog)
    return Assembled(catalog, line, dropped, doubts)


class TableMagnitudes(NamedTuple):
    """V, B-V and V-I of a table's rows (n,), NaN for unknown, and how they were found, in words."""

    v_mag: FloatArray
    bv_mag: FloatArray
    vi_mag: FloatArray
    words: str


class _Columns:
    """A table's columns by role, in the units of a catalogue."""

    def __init__(self, path: Path, table: table_reader.RawTable) -> None:
        self.path = path
        self.table = table
        self.layout = table.layout
        self.pair = self.layout.places[0]
        self.notices = list(table.notices)

    @property
    def is_gaia(self) -> bool:
        """Whether the table has the names of Gaia's archive, which say the units."""
        role = self.layout.role
        if "gaia" not in role or "g_mag" not in role:
            return False
        return self.pair[0].lower() == "ra"

    def has_unit(self, column: str) -> bool:
        """Whether the table states a column's unit."""
        return bool((self.table.unit.get(column) or "").strip())

    def _in_unit(self, role: str, column: str) -> FloatArray:
        """A column (n,) in the unit that a role has; another one is told."""
        unit = self.table.unit.get(column)
        factor = table_reader.factor_to(role, column, unit, self.path)
        values = np.asarray(self.table.columns[column], dtype=np.float64)
        if factor == 1.0:
            return values
        notice = f"column {column} is in {unit}, and is multiplied by {factor:.9g}"
        if notice not in self.notices:
            self.notices.append(notice)
        return values * factor

    def check_turn(self) -> None:
        """Raises InputError for right ascensions beyond a turn of their unit."""
        name = self.pair[0]
        unit = (self.table.unit.get(name) or "").strip()
        turn = TURNS.get(plain_unit(unit)[:3])
        largest = float(np.nanmax(self.table.columns[name], initial=0.0))
        if turn is not None and largest > turn + ROUNDED:
            raise InputError(
                f"{self.path}: column {name} is in {unit} and runs to {largest:g}; name it ra_deg"
                " if it is in degrees"
            )

    def places_doubt(self) -> str:
        """Why places without a unit may be hours or radians, and what to write; "" where they are
        degrees.
        """
        name, dec_name = self.pair
        ra = np.asarray(self.table.columns[name], dtype=np.float64)
        dec = np.asarray(self.table.columns[dec_name], dtype=np.float64)
        placed = np.isfinite(ra) & np.isfinite(dec)
        if self.has_unit(name) or not placed.any():
            return ""
        low = ra[placed].min()
        high = ra[placed].max()
        steepest = np.abs(dec[placed]).max()
        base = f"column {name} has no unit and runs from {low:.6g} to {high:.6g}"
        names = "ra_deg, ra_hours or ra_rad"
        is_a_turn = low >= -RAD_A_TURN / 2 and high <= RAD_A_TURN
        if is_a_turn and steepest <= RAD_A_TURN / 4:
            return (
                f"{base}: radians, hours or degrees? {UNIT_ADVICE}: {names}, with dec_deg or"
                " dec_rad"
            )
        if low >= 0 and high < HOURS_A_TURN:
            return f"{base}: so it is in hours, or of one field in degrees; {UNIT_ADVICE}: {names}"
        return ""

    def motions_doubt(self, motions: dict[str, FloatArray]) -> str:
        """Why proper motions without a unit are too small to be mas a year; "" where they are
        not.
        """
        given = []
        for role in motions:
            if role in self.layout.role:
                given.append(self.layout.role[role])
        if not given or any(map(self.has_unit, given)):
            return ""
        total = np.hypot(*motions.values())
        moving = total[total > 0]
        if len(moving) < MOTION_STARS:
            return ""
        median = np.median(moving)
        if median >= MIN_MEDIAN_MAS_YR:
            return ""
        name = given[0]
        return (
            f"column {name} has no unit, and half of its stars move by less than {median:.3g}, so"
            f" they are in arcsec a year; {UNIT_ADVICE}: {name}_arcsec_yr or {name}_mas_yr"
        )

    def role(self, role: str, blank: float) -> FloatArray:
        if role not in self.layout.role:
            return np.full(self.table.row_count, blank)
        values = self._in_unit(role, self.layout.role[role])
        return np.where(np.isfinite(values), values, blank)

    def places(self) -> tuple[FloatArray, FloatArray]:
        """Right ascension, 0 to 360, and declination, degrees; NaN where no pair of columns has
        both.
        """
        ra_deg = np.full(self.table.row_count, np.nan)
        dec_deg = np.full(self.table.row_count, np.nan)
        for ra, dec in self.layout.places:
            blank = ~(np.isfinite(ra_deg) & np.isfinite(dec_deg))
            if not blank.any():
                break
            ra_deg = np.where(blank, self._in_unit("ra_deg", ra), ra_deg)
            dec_deg = np.where(blank, self._in_unit("dec_deg", dec), dec_deg)
        west = (ra_deg < 0) & (ra_deg >= -180)
        return np.where(west, ra_deg + 360, ra_deg), dec_deg

    def magnitudes(self) -> TableMagnitudes:
        """The magnitudes of each row by the first conversion that its columns allow."""
        v = np.full(self.table.row_count, np.nan)
        bv = np.full(self.table.row_count, np.nan)
        vi = np.full(self.table.row_count, np.nan)
        notes: list[str] = []
        for route in table_reader.ROUTES:
            if route.roles not in self.layout.magnitudes:
                continue
            blank = ~(np.isfinite(v) & np.isfinite(bv))
            if not blank.any():
                break
            magnitudes = [self.role(role, np.nan)[blank] for role in route.roles]
            route_v, route_bv, route_vi = route.convert(*magnitudes)
            v[blank] = route_v
            bv[blank] = route_bv
            vi[blank] = route_vi
            if np.isfinite(route_v).any() and route.words not in notes:
                notes.append(route.words)
        if "vi_mag" in self.layout.role:
            given = self.role("vi_mag", np.nan)
            vi = np.where(np.isfinite(given), given, vi)
        return TableMagnitudes(v, bv, vi, ", ".join(notes))

    def variables(self) -> dict[str, npt.NDArray[Any]]:
        """Type, range, period and a time of largest light, where a row has all of its three
        figures; nothing without them.
        """
        if not self.layout.role.keys() >= {"maximum_jd", "period_d", "amplitude_mag"}:
            return {}
        maximum = self.role("maximum_jd", np.nan)
        period = self.role("period_d", np.nan)
        amplitude = self.role("amplitude_mag", np.nan)
        has_range = (amplitude > 0) & (amplitude < MAX_AMPLITUDE_MAG)
        known = np.isfinite(maximum) & (period > 0) & has_range
        kind = np.where(known, b"P", b"")
        range_mag = np.where(known, 2 * amplitude, np.nan)
        return {
            "variable": kind.astype("S1"),
            "range_mag": range_mag.astype(np.float32),
            "period_d": np.where(known, period, np.nan),
            "maximum_jd": np.where(known, maximum, np.nan),
        }

    def identifiers(self) -> tuple[str, npt.NDArray[np.int64]]:
        """What the stars are called, and the number of each: Gaia's, Tycho's, or that of the
        row, from 1.
        """
        role = self.layout.role
        columns = self.table.columns
        if "gaia" in role:
            epoch = self.role("epoch_jyear", GAIA_DR3_JYEAR)
            release = "Gaia DR2" if (epoch == GAIA_DR2_JYEAR).all() else "Gaia DR3"
            return release, np.asarray(columns[role["gaia"]], dtype=np.int64)
        if role.keys() >= {"tyc1", "tyc2", "tyc3"}:
            region = np.asarray(columns[role["tyc1"]], dtype=np.int64)
            number = np.asarray(columns[role["tyc2"]], dtype=np.int64)
            component = np.asarray(columns[role["tyc3"]], dtype=np.int64)
            return TYCHO, region * TYC_REGION + number * 10 + component
        return self.row_numbers()

    def row_numbers(self) -> tuple[str, npt.NDArray[np.int64]]:
        """The designation and the number of each row, from 1."""
        numbers = np.arange(1, self.table.row_count + 1, dtype=np.int64)
        return f"{self.path.stem[:MAX_STEM]} row", numbers

    def hip(self) -> npt.NDArray[np.int64]:
        """The HIP number of each row, 0 for none."""
        name = self.layout.role.get("hip")
        if name is None:
            return np.zeros(self.table.row_count, dtype=np.int64)
        return np.asarray(self.table.columns[name], dtype=np.int64)

    def epoch(
        self, stated_jyear: float | None, dated: bool, designation: str
    ) -> tuple[FloatArray, str]:
        """The epoch of each place, Julian years, and where it comes from. Raises InputError
        where it has to be stated.
        """
        known = EPOCH_OF_PLACES.get(self.pair[0].lower())
        if known is None and designation == "Gaia DR3":
            known = GAIA_DR3_JYEAR
        if stated_jyear is not None:
            words = f"places of J{stated_jyear:g} as stated"
            return np.full(self.table.row_count, stated_jyear), words
        if "epoch_jyear" in self.layout.role:
            values = self.role("epoch_jyear", np.nan)
            first, last = EPOCHS_JYEAR
            is_epoch = (values > first) & (values < last)
            if not is_epoch.all():
                raise InputError(
                    f"{self.path}: column {self.layout.role['epoch_jyear']} is no Julian year;"
                    f" {_STATE_EPOCH}"
                )
            return values, f"places of J{float(np.median(values)):g} by its column"
        if known is not None:
            words = f"places of J{known:g} by its columns' names"
            return np.full(self.table.row_count, known), words
        if dated:
            raise InputError(
                f"{self.path}: has no epoch of its places, and stars move; {_STATE_EPOCH}"
            )
        return np.full(self.table.row_count, GAIA_DR3_JYEAR), "places without motion"


def _dropped(figures: dict[str, npt.NDArray[Any]]) -> npt.NDArray[np.int8]:
    """For each row why it is no star, an index into _REASONS; 0 for a star."""
    reason = np.zeros(len(figures["v_mag"]), dtype=np.int8)
    for name, (low, high) in RANGES.items():
        if name not in figures:
            continue
        beyond = (figures[name] < low) | (figures[name] > high)
        if name in MAY_BE_UNKNOWN:
            figures[name][beyond] = np.nan
        else:
            reason[beyond] = 3
    has_light = np.isfinite(figures["v_mag"]) & np.isfinite(figures["bv_mag"])
    has_place = np.isfinite(figures["ra_deg"]) & np.isfinite(figures["dec_deg"])
    reason[~has_light] = 2
    reason[~has_place] = 1
    stars = np.flatnonzero(reason == 0)
    # Rows that stand in the table before, with the same place and magnitude.
    alike = [figures[name][stars] for name in ("v_mag", "dec_deg", "ra_deg")]
    order = np.lexsort(alike)
    repeated = np.all([np.diff(values[order]) == 0 for values in alike], axis=0)
    later = order[1:][repeated]
    reason[stars[later]] = 4
    return reason


def _reasons(reason: npt.NDArray[np.int8]) -> str:
    """How many rows are not used, by reason."""
    counts = np.bincount(reason, minlength=len(_REASONS)).tolist()
    parts = []
    for count, text in zip(counts, _REASONS, strict=True):
        if count and text:
            parts.append(f"{count} {text}")
    return ", ".join(parts)


def _repeated_hip(hip: npt.NDArray[np.int64], kept: npt.NDArray[np.bool_]) -> str:
    """What to tell of HIP numbers that several stars have: which, and who keeps them; "" of
    none.
    """
    given = hip[kept & (hip > 0)]
    numbers, counts = np.unique(given, return_counts=True)
    several = counts > 1
    if not several.any():
        return ""
    place = int(np.argmax(counts))
    example = f"HIP {numbers[place]} of {counts[place]}"
    number = int(several.sum())
    if number == 1:
        what = "1 HIP number is"
    else:
        what = f"{number} HIP numbers are"
    return f"{what} of several stars each ({example}); the brightest keeps it, the others have none"


def _once(
    hip: npt.NDArray[np.int64], kept: npt.NDArray[np.bool_], v_mag: FloatArray
) -> npt.NDArray[np.int32]:
    """HIP numbers of which each stands once, at the brightest star that has it."""
    is_hip = (hip > 0) & (hip < 2**31)
    usable = np.where(kept & is_hip, hip, 0)
    rows = np.flatnonzero(usable)
    brightest_first = rows[np.argsort(v_mag[rows], kind="stable")]
    _, first = np.unique(usable[brightest_first], return_index=True)
    keepers = brightest_first[first]
    result = np.zeros(len(hip), dtype=np.int32)
    result[keepers] = usable[keepers]
    return result


def _repeats(identifier: npt.NDArray[np.int64]) -> int:
    """How many stars have no identifier, or that of another star."""
    _, place, count = np.unique(identifier, return_inverse=True, return_counts=True)
    is_repeated = count[place] > 1
    return int((is_repeated | (identifier == 0)).sum())


@dataclass(frozen=True, slots=True)
class Joined:
    """Hipparcos with a table's further stars, one line about the overlap, and what is suspect
    about it (None: nothing).
    """

    catalog: Catalog
    line: str
    doubt: str | None


def join(hipparcos: Catalog, table: Catalog) -> Joined:
    """Add the table's stars that Hipparcos does not have.

    Stars are compared at the median epoch of the table's places. Hipparcos' own row stays for each
    star of both, with its place, magnitude and number; so do pairs that it has as one star of the
    sum.
    """
    epoch_jyear = float(np.median(table.epoch_jyear))
    owner, arcsec = _nearest_owner(hipparcos, table, epoch_jyear)
    held = _held(hipparcos, table, owner, arcsec)
    difference = _differences(hipparcos, table, owner, held)
    added = table.taken(~held)
    joined: dict[str, Any] = {}
    for name in column_names():
        joined[name] = np.concatenate([getattr(hipparcos, name), getattr(added, name)])
    catalog = replace(
        hipparcos,
        **joined,
        designation=table.designation,
        rows_read=hipparcos.rows_read + table.rows_read,
    )
    line = f"{difference.words}; {len(added)} stars added to Hipparcos' {len(hipparcos)}"
    return Joined(catalog, line, _doubt(table, held, difference))


def _nearest_owner(
    hipparcos: Catalog, table: Catalog, epoch_jyear: float
) -> tuple[IntArray, FloatArray]:
    """For each star of the table (n,) Hipparcos' nearest star and its distance, arcsec; infinite
    beyond any pair's reach.
    """
    from scipy.spatial import cKDTree

    widest_arcsec = float(np.nanmax(hipparcos.separation_arcsec, initial=0.0))
    reach = max(FAR_ARCSEC, widest_arcsec + PAIR_ARCSEC)
    tree = cKDTree(unit_vectors_icrs(hipparcos, epoch_jyear))
    table_vectors = unit_vectors_icrs(table, epoch_jyear)
    chord, owner = tree.query(table_vectors, distance_upper_bound=reach * RAD_PER_ARCSEC)
    # beyond the reach the tree gives a place after the last
    near = np.minimum(np.asarray(owner, dtype=np.intp), len(hipparcos) - 1)
    return near, np.asarray(chord) / RAD_PER_ARCSEC


def _held(
    hipparcos: Catalog, table: Catalog, owner: IntArray, arcsec: FloatArray
) -> npt.NDArray[np.bool_]:
    """The stars of the table (n,) whose light is in their owner's magnitude."""
    fainter_mag = table.v_mag - hipparcos.v_mag[owner]
    known_arcsec = hipparcos.separation_arcsec[owner].astype(np.float64)
    separation = np.nan_to_num(known_arcsec, nan=-np.inf)
    is_same = arcsec <= SAME_ARCSEC
    is_of_pair = (arcsec <= separation + PAIR_ARCSEC) & (fainter_mag > -PAIR_MAG)
    held = is_same | is_of_pair
    alone = np.ones(len(hipparcos), dtype=np.bool_)
    alone[owner[held]] = False
    # one that is farther off is the owner where no other is and it is as bright
    is_alike = (arcsec <= FAR_ARCSEC) & (np.abs(fainter_mag) <= FAR_MAG)
    return np.asarray(held | (alone[owner] & is_alike))


@dataclass(frozen=True, slots=True)
class _Differences:
    """How a table differs from Hipparcos: by how many stars, in the median of V, and in words."""

    count: int
    median_mag: float
    words: str


def _differences(
    hipparcos: Catalog, table: Catalog, owner: IntArray, held: npt.NDArray[np.bool_]
) -> _Differences:
    """Differences between the table's V and B-V and Hipparcos', from single stars in both that
    do not vary.
    """
    shares = np.bincount(owner[held], minlength=len(hipparcos))
    plain = (shares == 1) & (hipparcos.variable == b"") & (hipparcos.multiple == b"")
    star = np.flatnonzero(held)[plain[owner[held]]]
    of_both = int((shares > 0).sum())
    if not len(star):
        return _Differences(0, 0.0, f"{of_both} stars of Hipparcos are among them")
    v_mag = table.v_mag[star] - hipparcos.v_mag[owner[star]]
    bv_mag = table.bv_mag[star] - hipparcos.bv_mag[owner[star]]
    median_mag = float(np.median(v_mag))
    wide_mag = float(np.quantile(np.abs(v_mag), 0.95))
    odd = int((np.abs(v_mag) > ODD_MAG).sum())
    difference_note = (
        f"{of_both} stars of Hipparcos are among them, of {len(star)} single constant ones V"
        f" differs by {median_mag:+.3f} mag in the median ({wide_mag:.3f} at 95 %, {odd} by more"
        f" than {ODD_MAG:g}) and B-V by {float(np.median(bv_mag)):+.3f}"
    )
    return _Differences(len(star), median_mag, difference_note)


def _doubt(table: Catalog, held: npt.NDArray[np.bool_], difference: _Differences) -> str | None:
    """Why a table's places or magnitudes may be others than it says; None where they fit."""
    held_bright = held[table.v_mag < BRIGHT_V_MAG]
    count = len(held_bright)
    if count >= BRIGHT_STARS and held_bright.mean() < FEW_MATCHES:
        return (
            f"of its {count} stars to V = {BRIGHT_V_MAG:g} Hipparcos has"
            f" {held_bright.mean():.0%} at their place; are its places ICRS degrees, and of the"
            " epoch that it gives?"
        )
    if difference.count and abs(difference.median_mag) > OVERLAP_LIMIT_MAG:
        return (
            f"its V differs by {difference.median_mag:+.3f} mag from Hipparcos' in the median; are"
            " these magnitudes V?"
        )
    return None


@dataclass(frozen=True, slots=True)
class Kept:
    """A catalogue, and what is to be said of it each time."""

    catalog: Catalog
    doubts: tuple[str, ...] = ()


_digests: dict[tuple[int, ...] | None, str] = {}  # of files, by their states


def file_sha256(path: Path, advice: str) -> str:
    """The SHA-256 of a file of at most MAX_TABLE_BYTES, computed once for each state of it.
    Raises InputError.
    """
    try:
        status = path.stat()
    except (OSError, ValueError):  # its reader says why
        state = None
    else:
        state = (status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns)
    if state in _digests:
        return _digests[state]
    with open_named(path, advice, table_reader.MAX_TABLE_BYTES) as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    if state is not None:
        _digests[state] = digest
    return digest


def store_path(made_of: Sequence[str]) -> Path | None:
    """The cache's file for what was made of these words (a file's hash, settings); None where
    there is no cache directory.
    """
    named = os.environ.get("XDG_CACHE_HOME", "")
    try:
        if named.startswith("/"):
            root = Path(named)
        else:
            root = Path.home() / ".cache"
    except RuntimeError:  # no home
        return None
    words = json.dumps([VERSION, *made_of])
    key = hashlib.sha256(words.encode()).hexdigest()
    return root / "hilstar" / f"catalogue-{key[:40]}.npz"


def kept(path: Path) -> Kept | None:
    """The cached catalogue at `path`; None if it is missing or damaged."""
    try:
        with open_regular(path, "", MAX_STORED_BYTES) as file:
            status = os.fstat(file.fileno())
            # Nothing in it is packed, so that it cannot unfold into more than the file is long.
            entries = zipfile.ZipFile(file).infolist()
            is_plain = all(entry.compress_type == zipfile.ZIP_STORED for entry in entries)
            if status.st_uid != os.getuid() or not is_plain:
                return None
            file.seek(0)
            with np.load(file, allow_pickle=False) as packed:
                columns = {name: packed[name] for name in column_names()}
                about = json.loads(str(packed["about"]))
        notes = tuple(map(str, about["notes"]))
        catalog = Catalog(
            **columns,
            designation=str(about["designation"]),
            rows_read=int(about["rows_read"]),
            notes=notes,
        )
        stored = Kept(catalog, tuple(map(str, about["doubts"])))
    except Exception:  # whatever a damaged file raises in the layers of zipfile, NumPy and json
        return None
    if not _is_sound(catalog):
        return None
    return stored


def _is_sound(catalog: Catalog) -> bool:
    """Whether each column has its type, one length, and figures that a star can have."""
    for name in column_names():
        values = getattr(catalog, name)
        dtype = np.dtype(DTYPES.get(name, "f8"))
        is_column = values.ndim == 1 and values.shape == catalog.v_mag.shape
        if not is_column or values.dtype != dtype:
            return False
        if name in ALWAYS_KNOWN:
            low, high = RANGES[name]
            lowest = values.min(initial=high)
            highest = values.max(initial=low)
            if not (low <= lowest and highest <= high):  # NaN too
                return False
    return bool(np.isfinite(catalog.epoch_jyear).all())


def keep(path: Path, made: Kept) -> None:
    """Put a catalogue into the cache, and drop the oldest others; nothing happens where that
    cannot be.
    """
    about = {"designation": made.catalog.designation, "rows_read": made.catalog.rows_read}
    about |= {"notes": made.catalog.notes, "doubts": made.doubts}
    columns = {name: getattr(made.catalog, name) for name in column_names()}
    with contextlib.suppress(OSError, HilstarError):
        make_directory(path.parent)
        with whole_file(path) as file:
            np.savez(file, allow_pickle=False, about=np.array(json.dumps(about)), **columns)
        others = path.parent.glob("catalogue-*.npz")
        by_age = sorted(others, key=lambda file: file.stat().st_mtime_ns, reverse=True)
        for old in by_age[KEPT_FILES:]:
            old.unlink(missing_ok=True)


@dataclass(frozen=True, slots=True)
class TableChoice:
    """A bench's catalogue as its file names it; `epoch_jyear` is that of a table's places, where
    the file states it.

    Of Hipparcos stars fainter than `faintest_v_mag` may be left out.
    """

    source: str | Path = "hipparcos"
    with_hipparcos: bool = False
    epoch_jyear: float | None = None
    faintest_v_mag: float = math.inf


def choose_catalog(choice: TableChoice) -> Catalog:
    """The stars of a choice, with notes on what became of a table's rows.

    A table is read once; then what was made of it comes from the user's cache directory. Rows that
    are no star, and an overlap that does not fit, are said in the log each time. Raises InputError.
    """
    packaged = str(choice.source) == "hipparcos"
    if packaged or _is_hip_main(Path(choice.source)):
        if choice.with_hipparcos:
            raise InputError(
                "[sky] with_hipparcos adds a table's stars to Hipparcos; name a table as [sky]"
                " catalogue"
            )
        if choice.epoch_jyear is not None:
            raise InputError(
                "[sky] catalogue_epoch_jyear is for a table; Hipparcos has its own, J1991.25"
            )
        return load_catalog(choice.source, choice.faintest_v_mag)
    path = Path(choice.source)
    hipparcos_sha256 = ""
    if choice.with_hipparcos:
        hipparcos_sha256 = hashlib.sha256(PACKAGED_CATALOG.read_bytes()).hexdigest()
    made_of = (
        path.name,
        file_sha256(path, table_reader.FILE_WANTED),
        repr(choice.epoch_jyear),
        hipparcos_sha256,
    )
    place = store_path(made_of)
    made = kept(place) if place is not None else None
    if made is None:
        made = _made(path, choice)
        if place is not None:
            keep(place, made)
    for line in made.doubts:
        log.warning("%s", line)
    return made.catalog


def _made(path: Path, choice: TableChoice) -> Kept:
    """The stars of a table, joined with Hipparcos' where the choice says so. Raises InputError."""
    table = table_reader.read_table(path)
    assembled = assemble(path, table, choice.epoch_jyear, choice.with_hipparcos)
    doubts = list(assembled.doubts)
    if assembled.dropped:
        doubts.append(assembled.line)
    if not choice.with_hipparcos:
        return Kept(_by_cell(assembled.catalog, assembled.line), tuple(doubts))
    joined = join(load_catalog(), assembled.catalog)
    if joined.doubt is not None:
        doubts.append(f"{path.name}: {joined.doubt}")
    return Kept(_by_cell(joined.catalog, assembled.line, joined.line), tuple(doubts))


def _by_cell(catalog: Catalog, *notes: str) -> Catalog:
    """The same stars, neighbours together: a bench that sorts them by cell then reads each array
    from its start to its end.
    """
    grid = cell_grid(unit_vectors_icrs(catalog, GAIA_DR3_JYEAR))
    return replace(catalog.taken(grid.order), notes=notes)


def table_facts(
    choice: TableChoice, stars: Catalog, facts: dict[str, npt.NDArray[Any]]
) -> dict[str, npt.NDArray[Any]]:
    """Hipparcos' `facts` (n,) of the `stars` of a choice, and in their place what its table says of
    its own stars.

    Reads the table once more, for the columns that no bench needs. Raises InputError.
    """
    path = Path(choice.source)
    if str(choice.source) == "hipparcos" or _is_hip_main(path):
        return facts
    table = table_reader.read_table(path, table_reader.NAMES | table_reader.ERROR_NAMES)
    columns = _Columns(path, table)
    if not any(role in columns.layout.role for role in table_reader.ERROR_NAMES):
        return facts
    designation, identifier = columns.row_numbers()
    if stars.designation != designation:
        _, identifier = columns.identifiers()
    order = np.argsort(identifier, kind="stable")
    place = np.searchsorted(identifier, stars.identifier, sorter=order)
    row = order[np.minimum(place, len(order) - 1)]
    is_own_row = identifier[row] == stars.identifier
    if choice.with_hipparcos:
        is_own_row &= stars.hip != stars.identifier
    row_facts = dict(facts)
    for role in table_reader.ERROR_NAMES:
        name = columns.layout.role.get(role)
        if name is None:
            continue
        if role == table_reader.SPECTRAL_TYPE:
            own = columns.table.columns[name]
            source = np.where(is_own_row, b"U", facts["spectral_type_source"])
            row_facts["spectral_type_source"] = source
        else:
            own = columns.role(role, np.nan)
        row_facts[role] = np.where(is_own_row, own[row], facts[role])
    if "sigma_measured_mag" in columns.layout.role:
        row_facts["v_source"] = np.where(is_own_row, b"U", facts["v_source"])
    return row_facts


def _is_hip_main(path: Path) -> bool:
    """Whether a file begins as Hipparcos' main catalogue does."""
    with open_named(path, table_reader.FILE_WANTED, table_reader.MAX_TABLE_BYTES) as file:
        return file.read(2) == b"H|"
