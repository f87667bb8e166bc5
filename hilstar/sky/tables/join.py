"""A table's stars added to Hipparcos: in their overlap Hipparcos' star stands, and no other in its place."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from hilstar.arrays import FloatArray, IntArray
from hilstar.sky.astrometry import unit_vectors_icrs
from hilstar.sky.catalog import Catalog, column_names

# Of one star at a common epoch, two catalogues' places differ by far less, but for orbits. Hipparcos' photometry has the light
# of both components of a pair that it did not part.
SAME_ARCSEC = 2.0
# A star that is left alone there is looked for this far, where the magnitude has to agree as well.
FAR_ARCSEC, FAR_MAG = 10.0, 0.5
# A pair's orbit may have taken it so far past the separation that Hipparcos gives; no component is brighter than the sum by
# more than this.
PAIR_ARCSEC, PAIR_MAG = 2.0, 1.0
ODD_MAG = 1.0
OVERLAP_LIMIT_MAG = 0.03  # of the median
FEW_MATCHES, BRIGHT_STARS, BRIGHT_V_MAG = 0.5, 20, 7.0
RAD_PER_ARCSEC = np.pi / (180 * 3600)


@dataclass(frozen=True, slots=True)
class Joined:
    """Hipparcos with a table's further stars, one line about the overlap, and what is suspect about it (None: nothing)."""

    catalog: Catalog
    line: str
    doubt: str | None


def join(hipparcos: Catalog, table: Catalog) -> Joined:
    """Add the table's stars that Hipparcos does not have.

    Stars are compared at the median epoch of the table's places. Hipparcos' own row stays for each star of both, with
    its place, magnitude and number; so do pairs that it has as one star of the sum.
    """
    epoch_jyear = float(np.median(table.epoch_jyear))
    owner, arcsec = _nearest_owner(hipparcos, table, epoch_jyear)
    held = _held(hipparcos, table, owner, arcsec)
    difference = _differences(hipparcos, table, owner, held)
    added = table.taken(~held)
    joined: dict[str, Any] = {name: np.concatenate([getattr(hipparcos, name), getattr(added, name)]) for name in column_names()}
    catalog = replace(hipparcos, **joined, designation=table.designation, rows_read=hipparcos.rows_read + table.rows_read)
    line = f"{difference.words}; {len(added)} stars added to Hipparcos' {len(hipparcos)}"
    return Joined(catalog, line, _doubt(table, held, difference))


def _nearest_owner(hipparcos: Catalog, table: Catalog, epoch_jyear: float) -> tuple[IntArray, FloatArray]:
    """For each star of the table (n,) Hipparcos' nearest star and its distance, arcsec; infinite beyond any pair's reach."""
    from scipy.spatial import cKDTree

    reach = max(FAR_ARCSEC, float(np.nanmax(hipparcos.separation_arcsec, initial=0.0)) + PAIR_ARCSEC)
    tree = cKDTree(unit_vectors_icrs(hipparcos, epoch_jyear))
    chord, owner = tree.query(unit_vectors_icrs(table, epoch_jyear), distance_upper_bound=reach * RAD_PER_ARCSEC)
    return np.minimum(np.asarray(owner, dtype=np.intp), len(hipparcos) - 1), np.asarray(chord) / RAD_PER_ARCSEC


def _held(hipparcos: Catalog, table: Catalog, owner: IntArray, arcsec: FloatArray) -> npt.NDArray[np.bool_]:
    """The stars of the table (n,) whose light is in their owner's magnitude."""
    fainter_mag = table.v_mag - hipparcos.v_mag[owner]
    separation = np.nan_to_num(hipparcos.separation_arcsec[owner].astype(np.float64), nan=-np.inf)
    held = (arcsec <= SAME_ARCSEC) | ((arcsec <= separation + PAIR_ARCSEC) & (fainter_mag > -PAIR_MAG))
    alone = np.ones(len(hipparcos), dtype=np.bool_)
    alone[owner[held]] = False
    return np.asarray(held | (alone[owner] & (arcsec <= FAR_ARCSEC) & (np.abs(fainter_mag) <= FAR_MAG)))


@dataclass(frozen=True, slots=True)
class _Differences:
    count: int
    median_mag: float
    words: str


def _differences(hipparcos: Catalog, table: Catalog, owner: IntArray, held: npt.NDArray[np.bool_]) -> _Differences:
    """Of stars that both have alone, and that do not vary: how the table's V and B-V differ."""
    shares = np.bincount(owner[held], minlength=len(hipparcos))
    plain = (shares == 1) & (hipparcos.variable == b"") & (hipparcos.multiple == b"")
    star = np.flatnonzero(held)[plain[owner[held]]]
    of_both = int((shares > 0).sum())
    if not len(star):
        return _Differences(0, 0.0, f"{of_both} stars of Hipparcos are among them")
    v_mag = table.v_mag[star] - hipparcos.v_mag[owner[star]]
    bv_mag = table.bv_mag[star] - hipparcos.bv_mag[owner[star]]
    median_mag, wide_mag = float(np.median(v_mag)), float(np.quantile(np.abs(v_mag), 0.95))
    odd = int((np.abs(v_mag) > ODD_MAG).sum())
    words = (
        f"{of_both} stars of Hipparcos are among them, of {len(star)} single constant ones V differs by {median_mag:+.3f} mag"
        f" in the median ({wide_mag:.3f} at 95 %, {odd} by more than {ODD_MAG:g}) and B-V by {float(np.median(bv_mag)):+.3f}"
    )
    return _Differences(len(star), median_mag, words)


def _doubt(table: Catalog, held: npt.NDArray[np.bool_], difference: _Differences) -> str | None:
    bright = table.v_mag < BRIGHT_V_MAG
    if bright.sum() >= BRIGHT_STARS and held[bright].mean() < FEW_MATCHES:
        return (
            f"of its {int(bright.sum())} stars to V = {BRIGHT_V_MAG:g} Hipparcos has {held[bright].mean():.0%} at their place;"
            " are its places ICRS degrees, and of the epoch that it gives?"
        )
    if difference.count and abs(difference.median_mag) > OVERLAP_LIMIT_MAG:
        return f"its V differs by {difference.median_mag:+.3f} mag from Hipparcos' in the median; are these magnitudes V?"
    return None
