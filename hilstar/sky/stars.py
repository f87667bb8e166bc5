"""The stars of one bench: directions, colours and electron rates, sorted for culling."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hilstar.arrays import FloatArray
from hilstar.sky.catalog import Catalog
from hilstar.sky.cells import CellGrid, cell_grid


@dataclass(frozen=True, slots=True)
class Stars:
    """Stars in the order of `grid`; `vectors` (n, 3) are ICRS unit vectors, the rest has shape (n,)."""

    hip: npt.NDArray[np.int32]
    vectors: FloatArray
    v_mag: FloatArray
    bv_mag: FloatArray
    temperature_k: FloatArray
    electrons_per_s: FloatArray
    grid: CellGrid

    def __len__(self) -> int:
        return len(self.hip)


def brighter_stars(stars: Stars, faintest_e_per_s: float) -> Stars:
    """The stars of at least so many electrons per second, in their own cells; `stars` itself where that is all of them."""
    kept = stars.electrons_per_s >= faintest_e_per_s
    if kept.all():
        return stars
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
    )
