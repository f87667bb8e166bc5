"""Light that is no star's sprite: what the renderer adds to the linear image before levels are chosen.

Its unit is that of the linear image, electrons per second of each pixel. It travels with a frame's `Sprites.extended`
and is drawn in its order, before them. Compared by identity: one object drawn twice is the same light.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hilstar.arrays import Float32Array, FloatArray
from hilstar.scene.camera import Camera

Rectangle = tuple[int, int, int, int]  # left, top, width, height, pixels


@dataclass(frozen=True, slots=True, eq=False)
class LightMap:
    """An image of light, float32 (height, width), `times` a factor, its first pixel at `corner_px` (x, y) of the image.

    Keep one array for as long as the light is the same, and do not write to it: it is uploaded once.
    """

    image: Float32Array
    corner_px: tuple[int, int] = (0, 0)
    times: float = 1.0

    def region(self, resolution_px: tuple[int, int]) -> Rectangle | None:
        """The part of an image that it lights, None where that is nothing."""
        height, width = self.image.shape
        left, top = self.corner_px
        return clipped((left, top, left + width, top + height), resolution_px)


@dataclass(frozen=True, slots=True, eq=False)
class Glow:
    """A glow about a direction (3,), unit, image axes: `peak_e_per_s` (1 + (angle / scale)^2)^(-exponent / 2) in each pixel.

    The direction may be off the image, or behind the camera.
    """

    direction_image: FloatArray
    peak_e_per_s: float
    scale_rad: float
    exponent: float
    camera: Camera

    def region(self, resolution_px: tuple[int, int]) -> Rectangle | None:
        """The whole image."""
        return (0, 0, *resolution_px)


ExtendedLight = LightMap | Glow


def clipped(edges_px: tuple[float, float, float, float], resolution_px: tuple[int, int]) -> Rectangle | None:
    """The pixels of an image within left, top, right and bottom (the last two excluded); None where there is none."""
    (left, right), (top, bottom) = (
        np.clip((np.floor(edges_px[k]), np.ceil(edges_px[k + 2])), 0, resolution_px[k]).astype(int).tolist() for k in (0, 1)
    )
    return (left, top, right - left, bottom - top) if right > left and bottom > top else None
