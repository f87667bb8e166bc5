"""The oracle: what the renderer should draw, in NumPy float64 with an exact erf."""

from __future__ import annotations

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.scene.psf import pixel_shares
from hilstar.scene.sprites import Sprites


def linear_image(
    sprites: Sprites, resolution_px: tuple[int, int], sigma_px: tuple[float, float], footprint_px: int | None = None
) -> FloatArray:
    """Electrons per second of each pixel, float64, shape (height, width).

    `footprint_px` larger than the sprites' own shows what their footprints cut.
    """
    width, height = resolution_px
    size = sprites.footprint_px if footprint_px is None else footprint_px
    image = np.zeros((height, width))
    steps = np.arange(size) - (size - 1) // 2
    for sprite, x_px, y_px in zip(sprites.data, sprites.x_px, sprites.y_px, strict=True):
        columns, rows = sprite["pixel"][0] + steps, sprite["pixel"][1] + steps
        columns, rows = columns[(columns >= 0) & (columns < width)], rows[(rows >= 0) & (rows < height)]
        share_x, share_y = pixel_shares(columns - x_px, sigma_px[0]), pixel_shares(rows - y_px, sigma_px[1])
        image[np.ix_(rows, columns)] += float(sprite["electrons_per_s"]) * np.outer(share_y, share_x)
    return image
