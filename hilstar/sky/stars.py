"""The stars of one bench: directions, colours and electron rates, sorted for culling."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from hilstar.arrays import FloatArray, IntArray
from hilstar.sky.astrometry import aberrate
from hilstar.sky.catalog import Catalog
from hilstar.sky.cells import CellGrid, cell_grid
from hilstar.units import LIGHT_KM_S

MAX_SHIFT = 1.1  # of a direction by aberration, times v/c; for speeds up to a tenth of light's


@dataclass(frozen=True, slots=True)
class Stars:
    """Stars in the order of `grid`; `vectors` (n, 3) are ICRS unit vectors, the rest has shape (n,).

    `row` is each star's place in `catalog`, which has what no frame needs; -1 for what is in no catalogue. With a
    `velocity_km_s` (3,), ICRS, they are seen by an observer who moves so against the one who sees `vectors`: `near` and
    `directions` then say what that observer sees.
    """

    hip: npt.NDArray[np.int32]
    vectors: FloatArray
    v_mag: FloatArray
    bv_mag: FloatArray
    temperature_k: FloatArray
    electrons_per_s: FloatArray
    grid: CellGrid
    catalog: Catalog
    row: IntArray
    velocity_km_s: FloatArray | None = None

    def __len__(self) -> int:
        return len(self.hip)

    def near(self, axis: FloatArray, radius_rad: float) -> IntArray:
        """Every star seen within `radius_rad` of the unit vector `axis` (ICRS), and some more."""
        if self.velocity_km_s is not None:
            radius_rad += MAX_SHIFT * float(np.linalg.norm(self.velocity_km_s)) / LIGHT_KM_S
        return self.grid.near(axis, radius_rad)

    def directions(self, which: IntArray) -> FloatArray:
        """Where stars are seen: ICRS unit vectors (n, 3)."""
        vectors = self.vectors[which]
        return vectors if self.velocity_km_s is None else aberrate(vectors, self.velocity_km_s)

    def seen_at(self, velocity_km_s: FloatArray | None) -> Stars:
        """The same stars for such an observer; None: for the one who sees `vectors`."""
        return self if velocity_km_s is None else replace(self, velocity_km_s=velocity_km_s)


def split_by_rate(stars: Stars, faintest_e_per_s: float) -> tuple[Stars, Stars]:
    """The stars of at least `faintest_e_per_s` electrons per second, and the fainter ones, each in their own cells.

    The first are `stars` itself where no star is fainter.
    """
    kept = stars.electrons_per_s >= faintest_e_per_s
    return stars if kept.all() else _selected(stars, kept), _selected(stars, ~kept)


def _selected(stars: Stars, kept: npt.NDArray[np.bool_]) -> Stars:
    grid = cell_grid(stars.vectors[kept])
    order = np.flatnonzero(kept)[grid.order]
    return Stars(
        hip=stars.hip[order],
        vectors=np.ascontiguousarray(stars.vectors[order]),
        v_mag=stars.v_mag[order],
        bv_mag=stars.bv_mag[order],
        temperature_k=stars.temperature_k[order],
        electrons_per_s=stars.electrons_per_s[order],
        grid=grid,
        catalog=stars.catalog,
        row=stars.row[order],
    )


def make_stars(catalog: Catalog, vectors: FloatArray, temperature_k: FloatArray, electrons_per_s: FloatArray) -> Stars:
    """Sort a catalogue's stars by cell."""
    grid = cell_grid(vectors)
    order = grid.order
    return Stars(
        hip=catalog.hip[order],
        vectors=np.ascontiguousarray(vectors[order]),
        v_mag=catalog.v_mag[order],
        bv_mag=catalog.bv_mag[order],
        temperature_k=temperature_k[order],
        electrons_per_s=electrons_per_s[order],
        grid=grid,
        catalog=catalog,
        row=order,
    )
