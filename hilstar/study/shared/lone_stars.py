"""Stars that stand alone on an image: a window around each, and its light and centroid there."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.scene.sprites import Sprites

Window = tuple[slice, slice]


@dataclass(frozen=True, slots=True)
class Isolation:
    """How far a window reaches beyond a star's sprites, px, and what share of the star's light others may bring into it."""

    margin_px: float
    max_share: float


def lone_windows(
    sprites: Sprites, x_px: FloatArray, y_px: FloatArray, size_px: tuple[int, int], isolation: Isolation
) -> Iterator[tuple[int, Window]]:
    """Each star whose window lies on an image of `size_px` (width, height) and holds hardly any other's light, and the window.

    `x_px` and `y_px` (n,) are the places of the sprites on that image. A window is rows and columns.
    """
    light, (width, height), margin = sprites.data["electrons_per_s"], size_px, isolation.margin_px
    for star in np.unique(sprites.star):
        own = sprites.star == star
        left, right = x_px[own].min() - margin, x_px[own].max() + margin
        top, bottom = y_px[own].min() - margin, y_px[own].max() + margin
        if left < 0 or top < 0 or right > width - 1 or bottom > height - 1:
            continue
        near = (x_px > left - margin) & (x_px < right + margin) & (y_px > top - margin) & (y_px < bottom + margin) & ~own
        if light[near].sum() <= isolation.max_share * light[own].sum():
            yield int(star), (slice(int(top), int(bottom) + 1), slice(int(left), int(right) + 1))


def moments(image: FloatArray, window: Window) -> tuple[float, float, float]:
    """Light and centroid (x, y), px, of a window; NaN for the centroid where it is dark."""
    part = image[window]
    y_px, x_px = np.mgrid[window]
    total = float(part.sum())
    if total <= 0:
        return 0.0, math.nan, math.nan
    return total, float((part * x_px).sum() / total), float((part * y_px).sum() / total)
