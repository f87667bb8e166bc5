"""Dots on a lattice: light of one code that a tracker takes without saturating, by how far apart the lit pixels stand.

A lit pixel is as a star's pixels are: alone among black ones. The fainter a code, the denser its lattice can be.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from hilstar.arrays import FloatArray
from hilstar.calibrate.first_light.patterns import CodeImage, black, in_channel
from hilstar.calibrate.plan import Patch
from hilstar.errors import InputError
from hilstar.twin.bench_geometry import BenchGeometry

SHARE = 0.5  # of the smaller side of what both screen and tracker have
MAX_SIDE_TRACKER_PX = 200.0
APART_TRACKER_PX = 8.0  # of the sparsest lattice's dots: their wings do not add up
MIN_DOTS = 4  # along a side of the sparsest lattice
MARGIN_SIGMAS, MARGIN_PX = 6.0, 3.0
PHASES = 24


@dataclass(frozen=True, slots=True)
class DotField:
    """A square of the monitor (left, top, side; px) and the part of the tracker's image that has its light (slices).

    `monitor_px` is how many of the monitor's pixels stand in that part.
    """

    left: int
    top: int
    side: int
    rows: slice
    columns: slice
    monitor_px: float

    def lattice(self, resolution_px: tuple[int, int], period: int, patch: Patch) -> CodeImage:
        """Each `period`-th pixel of the square, across and down, in a patch's code and channel; from its cell's middle on."""
        codes = black(resolution_px)
        first = period // 2
        inside = codes[self.top : self.top + self.side, self.left : self.left + self.side]
        inside[first::period, first::period] = patch.code
        return in_channel(codes, patch.channel)

    def lit(self, period: int) -> int:
        """How many pixels such a lattice has."""
        return (self.side // period) ** 2


def field_for(geometry: BenchGeometry, sigma_px: float) -> tuple[DotField, tuple[int, ...]]:
    """Where lattices are shown, and their periods, dense to sparse; `sigma_px` is the tracker's PSF.

    Raises InputError where too little of the monitor is seen.
    """
    ratio = geometry.tracker.focal_length_px / geometry.monitor.focal_length_px
    sides = *(ratio * size for size in geometry.monitor.resolution_px), *geometry.tracker.resolution_px
    side = min(SHARE * min(sides), MAX_SIDE_TRACKER_PX) / ratio
    sparsest = 2 ** math.ceil(math.log2(max(APART_TRACKER_PX / ratio, 1.0)))
    cells = int(side // sparsest)
    if cells < MIN_DOTS:
        raise InputError("the tracker sees too little of the monitor for the response; look at focal lengths and pixel pitches")
    (x,), (y,) = geometry.to_monitor(*(np.array([(size - 1) / 2]) for size in geometry.tracker.resolution_px))
    places = zip((x, y), geometry.monitor.resolution_px, strict=True)
    left, top = (_within(middle, cells * sparsest, size) for middle, size in places)
    margin = MARGIN_PX + MARGIN_SIGMAS * math.hypot(sigma_px, ratio / math.sqrt(12))
    rows, columns = _seen(geometry, (left, top), cells * sparsest, margin)
    area = (rows.stop - rows.start) * (columns.stop - columns.start)
    periods = tuple(2**power for power in range(int(math.log2(sparsest)) + 1))
    return DotField(left, top, cells * sparsest, rows, columns, area / ratio**2), periods


def _within(middle: float, side: int, size: int) -> int:
    """The first pixel of a side about the middle of what is seen, within the screen."""
    wanted = middle if math.isfinite(middle) else (size - 1) / 2
    return int(np.clip(round(wanted - (side - 1) / 2), 0, size - side))


def _seen(geometry: BenchGeometry, corner: tuple[int, int], side: int, margin: float) -> tuple[slice, slice]:
    """The rows and columns of the tracker's image that the square's border and its wings fall on."""
    along = np.linspace(0, side - 1, 33)
    low, high = np.zeros_like(along), np.full_like(along, side - 1)
    x = corner[0] + np.concatenate([along, along, low, high])
    y = corner[1] + np.concatenate([low, high, along, along])
    seen = geometry.to_tracker(x, y)
    if not all(np.isfinite(part).all() for part in seen):
        raise InputError("the middle of the tracker's field sees no screen; run the geometry again")
    ends = []
    for part, size in zip(seen, geometry.tracker.resolution_px, strict=True):
        first, last = math.floor(part.min() - margin), math.ceil(part.max() + margin) + 1
        if first < 0 or last > size:
            raise InputError("the dots are not whole in the tracker's field; look at [collimator] and run the geometry again")
        ends.append(slice(first, last))
    return ends[1], ends[0]


def peak_shares(periods: tuple[int, ...], ratio: float, sigma_px: float) -> FloatArray:
    """Of one lit pixel's light, what the brightest tracker pixel has under each lattice; `ratio` tracker px a monitor px."""
    sigma = math.hypot(sigma_px, ratio / math.sqrt(12))
    shares = []
    for period in periods:
        step = period * ratio
        reach = np.arange(-math.ceil(MARGIN_SIGMAS * sigma / step) - 1, math.ceil(MARGIN_SIGMAS * sigma / step) + 2) * step
        phase = np.linspace(-0.5, 0.5, PHASES)[:, None] * step + reach
        along = (ndtr((phase + 0.5) / sigma) - ndtr((phase - 0.5) / sigma)).sum(axis=1)
        shares.append(float(along.max()) ** 2)
    return np.array(shares)
