"""A spatial index over directions: which stars can lie within an angle of an axis."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from hilstar.arrays import FloatArray, IntArray

# Measured over 116 812 stars and an 18 by 10 degree monitor: cells of 2 to 10 degrees take 23 to 11 us
# and pass on 1200 to 2700 stars; 4 degrees (13 us, 1500 stars) minimises the time of both steps.
# results/tradeoff.csv, culling: 1 to 6 degrees take the same time, a scan twenty times as long.
CELL_DEG = 4.0
# Within a cell stars are sorted by PARTS^2 parts of it: neighbours on the image follow each other, which
# saves a twelfth of drawing them.
PARTS = 4
# arccos near 1 is accurate to 1e-8 rad only; a cell is enlarged by this.
RADIUS_MARGIN_RAD = 1e-6


@dataclass(frozen=True, slots=True)
class CellGrid:
    """Stars grouped in cells of the sphere, each cell bounded by a cap.

    `order` (n,) sorts the stars by cell: cell k holds `order[start[k] : start[k] + count[k]]`.
    """

    order: IntArray
    start: IntArray
    count: IntArray
    centre: FloatArray
    cos_radius: FloatArray
    sin_radius: FloatArray

    def near(self, axis: FloatArray, radius_rad: float, edges: FloatArray | None = None, reach_rad: float = 0.0) -> IntArray:
        """Positions in `order`, rising, of every star within `radius_rad` and `reach_rad` of the unit vector `axis`, and more.

        With `edges` (k, 3), unit normals of planes through the centre, the stars within `reach_rad` of the inner side of each.
        """
        if not len(self.start):
            return np.empty(0, dtype=np.intp)
        widest_rad = math.acos(self.cos_radius.min())  # one bound for all cells, then each hit cell's own
        farthest_rad = min(radius_rad + reach_rad + widest_rad, math.pi)
        hit = (self.centre @ axis >= math.cos(farthest_rad)).nonzero()[0]
        centre = self.centre.take(hit, axis=0).T
        cos_radius, sin_radius = self.cos_radius.take(hit), self.sin_radius.take(hit)
        cosine, sine = math.cos(radius_rad + reach_rad), math.sin(radius_rad + reach_rad)
        within = axis @ centre >= cosine * cos_radius - sine * sin_radius
        if edges is not None and reach_rad < math.pi / 2:
            cosine, sine = math.cos(reach_rad), math.sin(reach_rad)
            deepest = cosine * sin_radius + sine * cos_radius
            if widest_rad + reach_rad >= math.pi / 2:
                deepest[cosine * cos_radius <= sine * sin_radius] = 1.0  # a cell wider than a plane bounds
            within &= (edges @ centre + deepest).min(axis=0) >= 0
        return self._stars(hit[within])

    def _stars(self, cells: IntArray) -> IntArray:
        """Positions in `order` of the stars of rising `cells`."""
        if not len(cells):
            return np.empty(0, dtype=np.intp)
        start = self.start.take(cells)
        end = start + self.count.take(cells)
        gaps = (start[1:] != end[:-1]).nonzero()[0]  # neighbours in a band follow each other: few ranges
        firsts, lasts = [int(start[0]), *start[gaps + 1].tolist()], [*end[gaps].tolist(), int(end[-1])]
        return np.concatenate([np.arange(first, last) for first, last in zip(firsts, lasts, strict=True)])


def cell_grid(vectors: FloatArray, cell_deg: float = CELL_DEG) -> CellGrid:
    """Group unit vectors (n, 3) into bands of declination, cut into cells of about `cell_deg` squared."""
    bands = max(1, round(180.0 / cell_deg))
    down = np.arccos(np.clip(vectors[:, 2], -1, 1)) / np.pi * bands
    band = np.minimum(down.astype(np.intp), bands - 1)
    per_band = np.maximum(1, np.round(360.0 / cell_deg * np.sin((np.arange(bands) + 0.5) * np.pi / bands))).astype(np.intp)
    along = np.arctan2(vectors[:, 1], vectors[:, 0]) / (2 * np.pi) % 1.0 * per_band[band]
    sector = np.minimum(along.astype(np.intp), per_band[band] - 1)
    cell = (np.cumsum(per_band) - per_band)[band] + sector
    # Few bits make NumPy's stable sort a radix sort, in a fifth of the time.
    part = ((down - band) * PARTS).astype(np.uint8) * np.uint8(PARTS + 1) + ((along - sector) * PARTS).astype(np.uint8)
    order = np.argsort(part, kind="stable")
    order = order[np.argsort(cell.astype(np.min_scalar_type(per_band.sum()))[order], kind="stable")]
    _, start, count = np.unique(cell[order], return_index=True, return_counts=True)
    if not len(start):
        nothing = np.empty(0)
        return CellGrid(order, start, count, np.empty((0, 3)), nothing, nothing)
    centre = np.add.reduceat(vectors[order], start)
    centre /= np.linalg.norm(centre, axis=1, keepdims=True)
    cosine = np.einsum("ij,ij->i", vectors[order], np.repeat(centre, count, axis=0))
    radius = np.arccos(np.clip(np.minimum.reduceat(cosine, start), -1, 1)) + RADIUS_MARGIN_RAD
    return CellGrid(order, start, count, centre, np.cos(radius), np.sin(radius))
