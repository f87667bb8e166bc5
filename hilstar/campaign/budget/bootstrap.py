"""Confidence intervals by the block bootstrap (Kuensch 1989): errors of neighbouring answers go together."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.campaign.budget.components import Components

BLOCKS, MIN_IN_BLOCK = 40, 5
DRAWS = 1000
COVERED = (2.5, 97.5)  # percent
HALF_OF_95 = 1.96


@dataclass(frozen=True, slots=True)
class Intervals:
    """95 % intervals, low and high: of the bias (2, 3), and (2, 2) of each part across and about the boresight, arcsec."""

    bias: FloatArray
    fov: FloatArray
    pixel: FloatArray
    noise: FloatArray


def intervals_of(parts: Components, rng: np.random.Generator, sigma_bias_arcsec: FloatArray | None) -> Intervals:
    """The intervals of components, by drawing stretches of the run anew.

    Where the clock is found together with the bias, `sigma_bias_arcsec` (3,) is how uncertain that leaves it at the least.
    """
    left, fov, pixel = parts.left, parts.fov, parts.pixel
    n = len(left)
    blocks = max(2, min(BLOCKS, n // MIN_IN_BLOCK))
    block = np.arange(n) * blocks // n
    count = np.bincount(block).astype(float)

    def sums(values: FloatArray) -> FloatArray:
        return np.stack([np.bincount(block, column) for column in values.T], axis=1)

    drawn = rng.integers(0, blocks, (DRAWS, blocks))
    rows = count[drawn].sum(axis=1)[:, None]
    total = sums(left + fov.fitted + pixel.fitted)[drawn].sum(axis=1) / rows
    spread = np.std(total, axis=0)
    if sigma_bias_arcsec is not None:
        spread = np.maximum(spread, sigma_bias_arcsec)
    freedom = n - 1 - fov.freedom - pixel.freedom
    noise = sums(left**2)[drawn].sum(axis=1) / rows * (n / max(freedom, 1.0))
    repeating = [
        np.maximum(sums(each.fitted**2)[drawn].sum(axis=1) / rows - each.freedom / n * noise, 0.0) for each in (fov, pixel)
    ]
    return Intervals(
        bias=np.stack([parts.mean - HALF_OF_95 * spread, parts.mean + HALF_OF_95 * spread]),
        fov=_covered(repeating[0]),
        pixel=_covered(repeating[1]),
        noise=_covered(noise),
    )


def _covered(variance: FloatArray) -> FloatArray:
    """Low and high one sigma across and about the boresight, (2, 2), of variances drawn (draws, 3)."""
    axes = np.sqrt(np.stack([variance[:, :2].mean(axis=1), variance[:, 2]], axis=1))
    return np.asarray(np.percentile(axes, COVERED, axis=0))
