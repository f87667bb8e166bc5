"""From a table's columns to a catalogue: one unit for each figure, V and colours, and which rows are no star."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from hilstar.arrays import FloatArray
from hilstar.errors import InputError
from hilstar.sky.catalog import RANGES, TYC_REGION, TYCHO, Catalog, plain_catalog
from hilstar.sky.tables.columns import WANTED, factor_to
from hilstar.sky.tables.photometry import ROUTES
from hilstar.sky.tables.reader import RawTable

# Epochs of the places, Julian years, where a table has its catalogue's own names and no epoch.
EPOCH_OF_PLACES = {"ramdeg": 2000.0, "raicrs": 1991.25, "raj2000": 2000.0, "_raj2000": 2000.0}
GAIA_DR2_JYEAR, GAIA_DR3_JYEAR = 2015.5, 2016.0
EPOCHS_JYEAR = (1800.0, 2200.0)
# Right ascensions within 24 and declinations that span more than this, of so many stars, are hours: no field is so narrow.
HOURS_SPAN_DEG, HOURS_STARS = 60.0, 100
# Of a thousand stars the fastest moves by some 100 mas a year; no star of the sky moves by 12 arcsec a year.
SLOWEST_MAS_YR, MOTION_STARS = 12.0, 1000
MAX_STEM = 16  # characters of a file's name in the name of its stars, which has 32 in a truth table
ADVICE = "give the column its unit in a FITS, ECSV or VOTable, or convert it"


@dataclass(frozen=True, slots=True)
class Assembled:
    """A table's stars, and one line about what became of its rows."""

    catalog: Catalog
    line: str
    dropped: int


def assemble(path: Path, table: RawTable, stated_epoch_jyear: float | None, compared: bool = False) -> Assembled:
    """The stars of a table, whose epoch matters where they move or are to be `compared` with stars that do.

    Raises InputError where no row is a star, and where a unit or the epoch has to be stated.
    """
    columns = _Columns(path, table)
    ra_deg, dec_deg = columns.places()
    v_mag, bv_mag, vi_mag, words = columns.magnitudes()
    pm = {role: columns.role(role, 0.0) for role in ("pm_ra_cosdec_mas_yr", "pm_dec_mas_yr")}
    if not any(columns.has_unit(table.layout.role[role]) for role in pm if role in table.layout.role):
        _check_motions(path, *pm.values())
    figures: dict[str, npt.NDArray[Any]] = {
        "ra_deg": ra_deg,
        "dec_deg": dec_deg,
        "v_mag": v_mag,
        "bv_mag": bv_mag,
        "vi_mag": vi_mag,
        **pm,
        "parallax_mas": columns.role("parallax_mas", np.nan),
    }
    designation, identifier = columns.identifiers()
    _check_hours(path, ra_deg, dec_deg, columns.has_unit(columns.pair[0]))
    reason = _dropped(figures)
    kept = reason == 0
    if not kept.any():
        raise InputError(f"{path}: none of its {len(reason)} rows is a star ({_reasons(reason)}); {WANTED}")
    dated = compared or any((motion[kept] != 0).any() for motion in pm.values())
    epoch, epoch_words = columns.epoch(stated_epoch_jyear, dated, designation)
    figures |= {"epoch_jyear": epoch, "identifier": identifier, "hip": _once(columns.hip(), kept, v_mag)}
    catalog = plain_catalog(designation, len(kept), {name: values[kept] for name, values in figures.items()})
    rest = "" if kept.all() else f"; not used: {_reasons(reason)}"
    line = f"{path.name}: {len(catalog)} stars of {len(kept)} rows, {words}; {epoch_words}{rest}"
    return Assembled(catalog, line, int((~kept).sum()))


class _Columns:
    """A table's columns by role, in the units of a catalogue."""

    def __init__(self, path: Path, table: RawTable) -> None:
        self.path, self.table, self.layout = path, table, table.layout
        self.pair = self.layout.places[0]

    def has_unit(self, column: str) -> bool:
        return bool((self.table.unit.get(column) or "").strip())

    def _in_unit(self, role: str, column: str) -> FloatArray:
        factor = factor_to(role, column, self.table.unit.get(column), self.path)
        values = np.asarray(self.table.columns[column], dtype=np.float64)
        return values if factor == 1.0 else values * factor

    def role(self, role: str, blank: float) -> FloatArray:
        """The figures of a role, `blank` where the table has none."""
        if role not in self.layout.role:
            return np.full(self.table.row_count, blank)
        values = self._in_unit(role, self.layout.role[role])
        return np.where(np.isfinite(values), values, blank)

    def places(self) -> tuple[FloatArray, FloatArray]:
        """Right ascension, 0 to 360, and declination, degrees; NaN where no pair of columns has both."""
        ra_deg, dec_deg = (np.full(self.table.row_count, np.nan) for _ in range(2))
        for ra, dec in self.layout.places:
            blank = ~(np.isfinite(ra_deg) & np.isfinite(dec_deg))
            if not blank.any():
                break
            ra_deg = np.where(blank, self._in_unit("ra_deg", ra), ra_deg)
            dec_deg = np.where(blank, self._in_unit("dec_deg", dec), dec_deg)
        west = (ra_deg < 0) & (ra_deg >= -180)
        return np.where(west, ra_deg + 360, ra_deg), dec_deg

    def magnitudes(self) -> tuple[FloatArray, FloatArray, FloatArray, str]:
        """V, B-V and V-I by the first road that a row's columns allow, and the roads in words."""
        v, bv, vi = (np.full(self.table.row_count, np.nan) for _ in range(3))
        words: list[str] = []
        for route in (route for route in ROUTES if route.roles in self.layout.magnitudes):
            blank = ~(np.isfinite(v) & np.isfinite(bv))
            if not blank.any():
                break
            new_v, new_bv, new_vi = route.convert(*(self.role(role, np.nan)[blank] for role in route.roles))
            if np.isfinite(new_v).any() and route.words not in words:
                words.append(route.words)
            v[blank], bv[blank], vi[blank] = new_v, new_bv, new_vi
        if "vi_mag" in self.layout.role:
            given = self.role("vi_mag", np.nan)
            vi = np.where(np.isfinite(given), given, vi)
        return v, bv, vi, ", ".join(words)

    def identifiers(self) -> tuple[str, npt.NDArray[np.int64]]:
        """What the stars are called, and the number of each: Gaia's, Tycho's, or that of the row, from 1."""
        role, columns = self.layout.role, self.table.columns
        if "gaia" in role:
            epoch = self.role("epoch_jyear", GAIA_DR3_JYEAR)
            return "Gaia DR2" if (epoch == GAIA_DR2_JYEAR).all() else "Gaia DR3", np.asarray(
                columns[role["gaia"]], dtype=np.int64
            )
        if all(name in role for name in ("tyc1", "tyc2", "tyc3")):
            region, number, part = (np.asarray(columns[role[name]], dtype=np.int64) for name in ("tyc1", "tyc2", "tyc3"))
            return TYCHO, region * TYC_REGION + number * 10 + part
        return f"{self.path.stem[:MAX_STEM]} row", np.arange(1, self.table.row_count + 1, dtype=np.int64)

    def hip(self) -> npt.NDArray[np.int64]:
        """HIP numbers, 0 where the table has none."""
        if "hip" not in self.layout.role:
            return np.zeros(self.table.row_count, dtype=np.int64)
        return np.asarray(self.table.columns[self.layout.role["hip"]], dtype=np.int64)

    def epoch(self, stated_jyear: float | None, dated: bool, designation: str) -> tuple[FloatArray, str]:
        """The epoch of each place, Julian years, and where it comes from. Raises InputError where it has to be stated."""
        known = EPOCH_OF_PLACES.get(self.pair[0].lower())
        if known is None and designation == "Gaia DR3":
            known = GAIA_DR3_JYEAR
        if stated_jyear is not None:
            return np.full(self.table.row_count, stated_jyear), f"places of J{stated_jyear:g} as stated"
        if "epoch_jyear" in self.layout.role:
            values = self.role("epoch_jyear", np.nan)
            if not ((values > EPOCHS_JYEAR[0]) & (values < EPOCHS_JYEAR[1])).all():
                raise InputError(f"{self.path}: column {self.layout.role['epoch_jyear']} is no Julian year; {_STATE_EPOCH}")
            return values, f"places of J{float(np.median(values)):g} by its column"
        if known is not None:
            return np.full(self.table.row_count, known), f"places of J{known:g} by its columns' names"
        if dated:
            raise InputError(f"{self.path}: has no epoch of its places, and stars move; {_STATE_EPOCH}")
        return np.full(self.table.row_count, GAIA_DR3_JYEAR), "places without motion"


MAY_BE_UNKNOWN = ("vi_mag", "parallax_mas")
_STATE_EPOCH = "write [sky] catalogue_epoch_jyear, such as 2000.0"
_REASONS = ("", "without a place", "without a magnitude and a colour", "beyond what a star has", "repeated")


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
    reason[~(np.isfinite(figures["v_mag"]) & np.isfinite(figures["bv_mag"]))] = 2
    reason[~(np.isfinite(figures["ra_deg"]) & np.isfinite(figures["dec_deg"]))] = 1
    stars = np.flatnonzero(reason == 0)
    reason[stars[_repeated({name: figures[name][stars] for name in ("ra_deg", "dec_deg", "v_mag")})]] = 4
    return reason


def _repeated(figures: dict[str, FloatArray]) -> npt.NDArray[np.bool_]:
    """Rows that stand in the table before, with the same place and magnitude."""
    order = np.lexsort((figures["v_mag"], figures["dec_deg"], figures["ra_deg"]))
    repeated = np.zeros(len(order), dtype=np.bool_)
    repeated[order[1:]] = np.all([np.diff(values[order]) == 0 for values in figures.values()], axis=0)
    return repeated


def _reasons(reason: npt.NDArray[np.int8]) -> str:
    counts = np.bincount(reason, minlength=len(_REASONS))
    return ", ".join(f"{counts[k]} {_REASONS[k]}" for k in range(1, len(_REASONS)) if counts[k])


def _once(hip: npt.NDArray[np.int64], kept: npt.NDArray[np.bool_], v_mag: FloatArray) -> npt.NDArray[np.int32]:
    """HIP numbers of which each stands once, at the brightest star that has it."""
    usable = np.where(kept & (hip > 0) & (hip < 2**31), hip, 0)
    rows = np.flatnonzero(usable)
    rows = rows[np.argsort(v_mag[rows], kind="stable")]
    _, first = np.unique(usable[rows], return_index=True)
    result = np.zeros(len(hip), dtype=np.int32)
    result[rows[first]] = usable[rows[first]]
    return result


def _check_hours(path: Path, ra_deg: FloatArray, dec_deg: FloatArray, has_unit: bool) -> None:
    placed = np.isfinite(ra_deg) & np.isfinite(dec_deg)
    if has_unit or placed.sum() < HOURS_STARS:
        return
    if ra_deg[placed].max() < 24 and ra_deg[placed].min() >= 0 and np.ptp(dec_deg[placed]) > HOURS_SPAN_DEG:
        raise InputError(
            f"{path}: right ascension runs from 0 to 24 over the whole sky, so it is in hours; {ADVICE} to degrees"
        )


def _check_motions(path: Path, *motions: FloatArray) -> None:
    largest = max(float(np.abs(motion).max(initial=0.0)) for motion in motions)
    if 0 < largest < SLOWEST_MAS_YR and len(motions[0]) >= MOTION_STARS:
        raise InputError(
            f"{path}: no proper motion exceeds {largest:.3g}, so they are in arcsec a year; {ADVICE} to mas a year"
        )
