"""A footprint's pixels by their distance from the star, for each sub-pixel phase: in what order `exact` decides them."""

from __future__ import annotations

import numpy as np

from hilstar.arrays import Float32Array, FloatArray, IntArray
from hilstar.monitor.balance import PIXEL_VARIANCE
from hilstar.scene.psf import footprint_px

PHASES = 8  # sub-pixel phases per axis for which the order is tabulated
# How far from a star a pixel may be lit that the star's own light leaves dark: 3 give a star of 267 steps twice the error.
REACH_SIGMA = 3.4
MIN_REACH_PX = 1.6  # narrower stars still get their eight neighbours, to choose among
# Of a step: pixels in which a star has less light stay dark. 0.1 gives stars of 17 steps a fifth more error, 0.02 no less.
LEAST_LIGHT = 0.07
FEWEST = 9  # pixels to choose among, whatever the light


class PixelOrder:
    """The order for sprites of one sigma: `size` is the footprint's side, the first `near` pixels lie within reach.

    `first` is the footprint's first column (and row), in whole pixels from the star's own; `row` and `column`
    (size^2, PHASES^2) count from there, nearest first. `bias` is added to a star's place in its pixel for its phase, and
    `area_px2` is 2 pi times the product of the sigmas, a pixel's width among them.
    """

    def __init__(self, sigma_px: tuple[float, float]) -> None:
        self.size = footprint_px(sigma_px)
        self.first = -((self.size - 1) // 2)
        self.bias = 0.5 if self.size % 2 else 0.0
        distance = self._distances(sigma_px)
        self._least_spread_px = float(_spread_px(sigma_px).min())
        self.near = int((distance <= self.reach_sigmas()).sum(axis=0).max())
        order = np.argsort(distance, axis=0, kind="stable")
        self.area_px2 = 2 * np.pi * float(_spread_px(sigma_px).prod())
        self.row, self.column = (part.astype(np.int32) for part in np.divmod(order, self.size))

    def _distances(self, sigma_px: tuple[float, float]) -> FloatArray:
        """The footprint's pixels from a star of each phase, in sigmas, (size^2, PHASES^2)."""
        phase = (np.arange(PHASES) + 0.5) / PHASES - self.bias
        steps = np.arange(self.size) + self.first
        x, y = (((steps[:, None] - phase) / s) ** 2 for s in _spread_px(sigma_px))
        return np.asarray(np.sqrt(y[:, None, :, None] + x[None, :, None, :]).reshape(self.size**2, PHASES**2))

    def reach_sigmas(self, more_px: float = 0.0) -> float:
        """How far the pixels lie that are within reach, in sigmas with a pixel's width among them, and `more_px` farther."""
        return max(REACH_SIGMA, MIN_REACH_PX / self._least_spread_px) + more_px / self._least_spread_px

    def reach(self, steps: Float32Array) -> IntArray:
        """How many of its nearest pixels stars of so many steps of light (n,) have enough light in to choose, (n,)."""
        # A Gaussian's k-th nearest pixel has exp(-k / area) of its peak.
        least = np.float32(1 / (self.area_px2 * LEAST_LIGHT))
        pixels = np.float32(self.area_px2) * np.log(np.maximum(steps * least, np.float32(1)))
        return np.asarray(np.clip(pixels.astype(np.intp), min(FEWEST, self.near), self.near))

    def places(self) -> IntArray:
        """The pixels of a footprint from the star's own, nearest first, by phase: x and y (2, PHASES^2, pixels)."""
        return np.stack([self.column.T, self.row.T]).astype(np.intp) + self.first

    @property
    def phases(self) -> FloatArray:
        """The middle of each phase, px from the star's own pixel: x and y (2, PHASES^2)."""
        middle = (np.arange(PHASES) + 0.5) / PHASES - self.bias
        return np.stack([np.tile(middle, PHASES), np.repeat(middle, PHASES)])


def _spread_px(sigma_px: tuple[float, float]) -> FloatArray:
    return np.asarray(np.sqrt(np.square(sigma_px) + PIXEL_VARIANCE))
