"""A dot's shape in the tracker's image, and the S-curve that it gives to the dot's centroid.

A tracker's pixels sample a dot. Where the PSF is narrower than a pixel, a windowed centroid is
biased by the dot's place within its pixel, up to 0.04 px for a PSF of 0.35 px. The bias follows
from the dot's shape: a square of light, turned as the screen is, behind the tracker's PSF. So it is
measured by the centroider itself on images of such dots, at places all over a pixel, and taken off.
"""

import functools
import math
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import map_coordinates
from scipy.special import ndtr

from hilstar.basics.arrays import FloatArray
from hilstar.tracker.centroids import CentroidSettings, LocalBackground, find_stars

# A bias is at most what is left of a dot at one cycle a pixel, over pi: of a PSF exp(-2 pi^2
# sigma^2), 3e-6 here, and of a square 1 / (pi side), 0.001 px behind a PSF of 0.35 px.
SMOOTH_PSF_PX, SMOOTH_SIDE_PX = 0.8, 8.0
PHASES = 24  # places within a pixel, along each axis
SIDE_POINTS = 16  # along a dot's side, each for a square of its own
# share of a dot's light that a pixel of its blob has
FAINTEST_SHARE = 1e-3
# Of the place that is corrected by the bias at the corrected place: the bias changes by up to 0.25
# px a pixel, so that each round leaves a quarter of the last.
ROUNDS = 8


@dataclass(frozen=True, slots=True)
class DotShape:
    """A dot in the tracker's image: the PSF's sigma, and the side of the square of light and its
    turn.
    """

    psf_sigma_px: float
    side_px: float
    turn_deg: float

    def shares(self, x_px: FloatArray, y_px: FloatArray, half_px: int) -> FloatArray:
        """Shares (m, n, k, k) of a dot's light in the pixels about the middle one, for its places
        `x_px` (n,) and `y_px` (m,) from that one's middle; k is 2 `half_px` + 1.
        """
        along = (np.arange(SIDE_POINTS) + 0.5) / SIDE_POINTS - 0.5
        right, down = np.meshgrid(along, along)
        turn = math.radians(self.turn_deg)
        across_px = self.side_px * (math.cos(turn) * right - math.sin(turn) * down).ravel()
        along_px = self.side_px * (math.sin(turn) * right + math.cos(turn) * down).ravel()
        in_columns = self._shares_along(x_px, across_px, half_px)
        in_rows = self._shares_along(y_px, along_px, half_px)
        shares = np.tensordot(in_rows, in_columns, axes=(2, 2)) / SIDE_POINTS**2
        return np.asarray(shares.transpose(0, 2, 1, 3))

    def _shares_along(
        self, place_px: FloatArray, points_px: FloatArray, half_px: int
    ) -> FloatArray:
        """Shares (n, k, p) in pixels along an axis of points (p,) of dots at places (n,)."""
        edges = np.arange(2 * half_px + 2) - half_px - 0.5
        middles = place_px[:, None, None] + points_px
        # with the variance of a point's square, the twelfth of its side's square
        sigma_px = math.hypot(self.psf_sigma_px, self.side_px / SIDE_POINTS / math.sqrt(12))
        return np.asarray(np.diff(ndtr((edges[:, None] - middles) / sigma_px), axis=1))


def without_s_curve(
    x_px: FloatArray, y_px: FloatArray, shape: DotShape, settings: CentroidSettings
) -> tuple[FloatArray, FloatArray]:
    """Centroids (n,) of dots without the bias by their place within a pixel.

    Method: pixel-phase errors (Anderson & King 2000, PASP 112, 1360), here by a known shape.
    """
    if shape.psf_sigma_px > SMOOTH_PSF_PX or shape.side_px > SMOOTH_SIDE_PX:
        return x_px, y_px
    bias_x_px, bias_y_px = _biases(shape, settings)
    true_x_px = x_px
    true_y_px = y_px
    for _ in range(ROUNDS):
        # a place in the tables, whose first is at the pixel's lower edge
        phase = (np.stack([true_y_px, true_x_px]) + 0.5) % 1.0 * PHASES
        true_x_px = x_px - map_coordinates(bias_x_px, phase, order=3, mode="grid-wrap")
        true_y_px = y_px - map_coordinates(bias_y_px, phase, order=3, mode="grid-wrap")
    return true_x_px, true_y_px


@functools.lru_cache(maxsize=8)
def _biases(shape: DotShape, settings: CentroidSettings) -> tuple[FloatArray, FloatArray]:
    """The bias of a noiseless dot's centroid along x and y, px, at places over a pixel (y, x)."""
    place_px = np.arange(PHASES) / PHASES - 0.5
    half_px = settings.radius_px + 2
    tile_px = 2 * half_px + 1
    tiles = shape.shares(place_px, place_px, half_px)
    image = tiles.transpose(0, 2, 1, 3).reshape(PHASES * tile_px, PHASES * tile_px)
    threshold = FAINTEST_SHARE / settings.threshold_sigma
    centroids = find_stars(image, settings, LocalBackground(0.0, threshold))
    column, x_in_tile_px = np.divmod(centroids.x_px + 0.5, tile_px)
    row, y_in_tile_px = np.divmod(centroids.y_px + 0.5, tile_px)
    columns = column.astype(np.intp)
    rows = row.astype(np.intp)
    bias_x_px = np.zeros((PHASES, PHASES))
    bias_y_px = np.zeros((PHASES, PHASES))
    middle_px = half_px + 0.5
    bias_x_px[rows, columns] = x_in_tile_px - middle_px - place_px[columns]
    bias_y_px[rows, columns] = y_in_tile_px - middle_px - place_px[rows]
    return bias_x_px, bias_y_px
