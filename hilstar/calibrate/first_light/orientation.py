"""Which way round the tracker sees the screen, from one image of an asymmetric figure."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.bench.config import Monitor
from hilstar.calibrate.first_light.patterns import Figure
from hilstar.errors import InputError
from hilstar.tracker.centroids import CentroidSettings, find_stars, noisiest_background
from hilstar.twin.bench_geometry import BenchGeometry

THRESHOLD_SIGMA = 8.0
MIN_PIXELS = 3
MAX_MISFIT = 0.5  # of the nearest of the eight ways round: half way to another one is 1
MAX_SCALE = 2.0
MIN_SIZE_STEP = 1.3  # between the pixels of one square and the next
UPRIGHT = (1, 0, 0, 1)
WAYS = {
    UPRIGHT: "upright",
    (-1, 0, 0, 1): "mirrored left to right",
    (1, 0, 0, -1): "mirrored top to bottom",
    (-1, 0, 0, -1): "turned by 180 degrees",
    (0, -1, 1, 0): "turned by 90 degrees clockwise",
    (0, 1, -1, 0): "turned by 270 degrees clockwise",
    (0, 1, 1, 0): "with columns and rows swapped",
    (0, -1, -1, 0): "with columns and rows swapped, and turned by 180 degrees",
}
CORNERS = {(-1, -1): "top left", (1, -1): "top right", (-1, 1): "bottom left", (1, 1): "bottom right"}
SIDES = {(1, 0): "to its right", (-1, 0): "to its left", (0, 1): "below it", (0, -1): "above it"}
NOT_SEEN = "show the monitor to the whole of the tracker's field, expose longer, and look at the focus"


@dataclass(frozen=True, slots=True)
class SeenFigure:
    """How the tracker saw the figure: the right-angled way round (4,) row by row, its scale and its turn beyond that."""

    way: tuple[int, int, int, int]
    scale: float
    turn_deg: float
    x_px: FloatArray
    y_px: FloatArray

    @property
    def words(self) -> str:
        """The way round for a person."""
        return WAYS[self.way]


def see_figure(image: FloatArray, figure: Figure, geometry: BenchGeometry) -> SeenFigure:
    """The figure in a tracker's image (h, w) above its dark frame, by the bench file's own lens.

    Raises InputError where it is not there, or not as large as the focal lengths say.
    """
    settings = CentroidSettings(threshold_sigma=THRESHOLD_SIGMA, minimum_pixels=MIN_PIXELS)
    found = find_stars(image, settings, noisiest_background(image))
    if len(found) < len(figure.x_px):
        raise InputError(f"{len(found)} of the figure's three squares are in the image; {NOT_SEEN}")
    largest = np.argsort(-found.pixels, kind="stable")[:3]
    sizes = found.pixels[largest]
    if (sizes[:-1] < MIN_SIZE_STEP * sizes[1:]).any():
        counts = ", ".join(map(str, sizes))
        raise InputError(
            f"the three largest spots have {counts} pixels and cannot be told apart; look at focus and stray light"
        )
    x_px, y_px = found.x_px[largest], found.y_px[largest]
    shown_x, shown_y = geometry.to_monitor(x_px, y_px)
    corner, right, below = np.stack([shown_x, shown_y], axis=1)
    seen = np.column_stack([right - corner, below - corner]) / (2 * figure.reach_px)
    scale = float(np.sqrt(abs(np.linalg.det(seen))))
    if not 1 / MAX_SCALE < scale < MAX_SCALE:
        raise InputError(f"the figure is {scale:.2f} times as large as the bench file says; look at focal lengths and pitches")
    ways = {way: np.array(way, dtype=np.float64).reshape(2, 2) for way in WAYS}
    way = max(ways, key=lambda each: float((ways[each] * seen).sum()))
    left = np.linalg.inv(ways[way]) @ seen / scale
    if np.linalg.norm(left - np.eye(2)) > MAX_MISFIT:
        raise InputError("the figure is turned by no right angle; turn the tracker or the screen to within 15 degrees")
    return SeenFigure(way, scale, float(np.degrees(np.arctan2(left[1, 0] - left[0, 1], left[0, 0] + left[1, 1]))), x_px, y_px)


def keys_of_ways() -> dict[str, tuple[int, int, int, int]]:
    """The key for each way round; the first is upright."""
    return {str(number): way for number, way in enumerate(WAYS, start=1)}


def look_of(way: tuple[int, int, int, int]) -> str:
    """Where a person sees the figure's squares when it stands this way round."""
    right, below = (way[0], way[2]), (way[1], way[3])
    corner = CORNERS[-right[0] - below[0], -right[1] - below[1]]
    return f"the largest square {corner}, the next one {SIDES[right]}, the smallest {SIDES[below]} ({WAYS[way]})"


@dataclass(frozen=True, slots=True)
class Mounting:
    """The keys of [monitor] that say how the screen is mounted."""

    flip_x: bool
    flip_y: bool
    rotate_deg: int

    @property
    def matrix(self) -> FloatArray:
        """From the image's axes to the screen's (2, 2), x right and y down."""
        turn = np.linalg.matrix_power(np.array([[0, -1], [1, 0]]), self.rotate_deg // 90)
        return np.asarray(np.diag([-1.0 if self.flip_x else 1.0, -1.0 if self.flip_y else 1.0]) @ turn)

    def changed(self, other: Mounting) -> int:
        """How many keys differ."""
        return sum(
            a != b
            for a, b in (
                (self.flip_x, other.flip_x),
                (self.flip_y, other.flip_y),
                (self.rotate_deg, other.rotate_deg),
            )
        )


def mounting_of(monitor: Monitor) -> Mounting:
    """The mounting that a bench file has."""
    return Mounting(monitor.flip_x, monitor.flip_y, monitor.rotate_deg)


def corrected(mounting: Mounting, way: tuple[int, int, int, int]) -> Mounting:
    """The mounting under which an image that was seen `way` round is upright, with the fewest keys changed."""
    wanted = mounting.matrix @ np.linalg.inv(np.array(way, dtype=np.float64).reshape(2, 2))
    flips = (False, True)
    all_ways = [Mounting(x, y, turn) for x, y, turn in itertools.product(flips, flips, (0, 90, 180, 270))]
    right = [each for each in all_ways if np.allclose(each.matrix, wanted)]
    return min(right, key=lambda each: (each.changed(mounting), each.flip_y, each.rotate_deg))
