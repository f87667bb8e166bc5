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

BODY_CELL_RAD = 1e-6  # of a cell with one body in it: rounding


@dataclass(frozen=True, slots=True)
class Stars:
    """Stars in the order of `grid`; `vectors` (n, 3) are ICRS unit vectors, the rest has shape (n,).

    Vectors are kept component by component (Fortran's order): they are gathered and turned several times faster.

    `row` is each star's place in `catalog`, which has what no frame needs; -1 for what is in no catalogue. With a
    `velocity_km_s` (3,), ICRS, they are seen by an observer who moves so against the one who sees `vectors`: `near` and
    `directions` then say what that observer sees. The last stars may be `bodies`, by name: whoever moves them rewrites their
    part of the arrays. Those that `near` does not find (satellites) come first.
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
    bodies: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.hip)

    @property
    def rates_e_per_s(self) -> FloatArray:
        """The electron rates of the stars alone, without bodies."""
        return self.electrons_per_s[: len(self) - len(self.bodies)]

    def near(self, axis: FloatArray, radius_rad: float, edges: FloatArray | None = None, reach_rad: float = 0.0) -> IntArray:
        """Every star seen within `radius_rad` and `reach_rad` of the unit vector `axis` (ICRS), and some more; rising.

        With `edges` (k, 3), unit vectors (ICRS), those within `reach_rad` of the inner side of each one's plane.
        """
        if self.velocity_km_s is not None:
            reach_rad += MAX_SHIFT * float(np.linalg.norm(self.velocity_km_s)) / LIGHT_KM_S
        return self.grid.near(axis, radius_rad, edges, reach_rad)

    def directions(self, which: IntArray) -> FloatArray:
        """Where stars are seen: ICRS unit vectors (n, 3)."""
        vectors = self.vectors
        vectors = vectors.T.take(which, axis=1).T if vectors.flags.f_contiguous else vectors[which]
        return vectors if self.velocity_km_s is None else aberrate(vectors, self.velocity_km_s)

    def seen_at(self, velocity_km_s: FloatArray | None) -> Stars:
        """The same stars for such an observer; None: for the one who sees `vectors`."""
        return self if velocity_km_s is None else replace(self, velocity_km_s=velocity_km_s)

    def names(self, which: IntArray) -> list[str]:
        """The names of bodies and of stars without a HIP number among stars (n,), empty text for the others."""
        first, named = len(self) - len(self.bodies), (self.hip[which] == 0).tolist()
        return [self._name(i, first) if has_name else "" for i, has_name in zip(which.tolist(), named, strict=True)]

    def _name(self, star: int, first_body: int) -> str:
        if star >= first_body:
            return self.bodies[star - first_body]
        return "" if self.row[star] < 0 else self.catalog.name(int(self.row[star]))

    def designations(self, which: IntArray) -> list[int | str]:
        """The HIP numbers of stars (n,), and the names of those that have none."""
        return [name or hip for name, hip in zip(self.names(which), self.hip[which].tolist(), strict=True)]


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
        vectors=np.asfortranarray(stars.vectors[order]),
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
        vectors=np.asfortranarray(vectors[order]),
        v_mag=catalog.v_mag[order],
        bv_mag=catalog.bv_mag[order],
        temperature_k=temperature_k[order],
        electrons_per_s=electrons_per_s[order],
        grid=grid,
        catalog=catalog,
        row=order,
    )


def with_bodies(stars: Stars, bodies: tuple[str, ...], bv_mag: FloatArray, found: bool = True) -> Stars:
    """The stars, in arrays of their own, and after them bodies of colours `bv_mag` (k,), which have no place or light yet.

    Bodies not to be `found` are in no cell: `near` passes over them, whoever moves them adds them to an image.
    """
    count, order = len(bodies), len(stars) + np.arange(len(bodies))
    cells = order[: count if found else 0]
    nowhere = np.full(count, np.nan)
    grid = stars.grid
    return Stars(
        hip=np.concatenate([stars.hip, np.zeros(count, dtype=np.int32)]),
        vectors=np.asfortranarray(np.concatenate([stars.vectors, np.full((count, 3), np.nan)])),
        v_mag=np.concatenate([stars.v_mag, nowhere]),
        bv_mag=np.concatenate([stars.bv_mag, bv_mag]),
        temperature_k=np.concatenate([stars.temperature_k, nowhere]),
        electrons_per_s=np.concatenate([stars.electrons_per_s, nowhere]),
        grid=replace(
            grid,
            order=np.concatenate([grid.order, order]),
            start=np.concatenate([grid.start, cells]),
            count=np.concatenate([grid.count, np.ones(len(cells), dtype=grid.count.dtype)]),
            centre=np.concatenate([grid.centre, np.full((len(cells), 3), np.nan)]),
            cos_radius=np.concatenate([grid.cos_radius, np.full(len(cells), np.cos(BODY_CELL_RAD))]),
            sin_radius=np.concatenate([grid.sin_radius, np.full(len(cells), np.sin(BODY_CELL_RAD))]),
        ),
        catalog=stars.catalog,
        row=np.concatenate([stars.row, np.full(count, -1)]),
        bodies=(*stars.bodies, *bodies),
    )
