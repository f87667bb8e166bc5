"""Light that is no star's sprite: what the renderer adds to the linear image before levels are chosen.

Its unit is that of the linear image, electrons per second of each pixel. It travels with a frame's `Sprites.extended`
and is drawn in its order, before them. Compared by identity: one object drawn twice is the same light.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hilstar.arrays import Float32Array, FloatArray
from hilstar.scene.camera import Camera
from hilstar.sky.bodies.disc import AIR_TOP, Disc

REACH_SIGMAS = 4.0  # as in disc.frag
PIXEL_VARIANCE = 1 / 12  # of a square pixel, px squared
LIMB_PLACES = 128
BEHIND = 0.05  # of a unit direction's z: a limb that comes nearer to the camera's plane has no useful outline
BOW = 1.01  # of an outline: what bows between its places
Rectangle = tuple[int, int, int, int]  # left, top, width, height, pixels


@dataclass(frozen=True, slots=True, eq=False)
class LightMap:
    """An image of light, float32 (height, width), `times` a factor, its first pixel at `corner_px` (x, y) of the image.

    `cover`, of the same shape, is the share of what was drawn before that each pixel hides; None hides nothing. `name` is the
    body's whose disc it is.

    Keep one array for as long as the light is the same, and do not write to it: it is uploaded once. What a single frame has is
    not `lasting`.
    """

    image: Float32Array
    corner_px: tuple[int, int] = (0, 0)
    times: float = 1.0
    cover: Float32Array | None = None
    name: str = ""
    lasting: bool = True

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


@dataclass(frozen=True, slots=True, eq=False)
class Shear:
    """A camera that turns at `rate_image_rad_s` (3,), image axes, while pixels light up one after the other.

    A pixel is lit `s_per_px` (x, y) times its distance from `middle_px` after the moment of the attitude.
    """

    rate_image_rad_s: FloatArray
    s_per_px: tuple[float, float]
    middle_px: tuple[float, float]

    def late_s(self, x_px: FloatArray, y_px: FloatArray) -> FloatArray:
        """How long after the attitude's moment pixels (n,) are lit."""
        (a, b), (x, y) = self.s_per_px, self.middle_px
        return a * (x_px - x) + b * (y_px - y)


@dataclass(frozen=True, slots=True, eq=False)
class DiscLight:
    """A body's disc through a camera, spread by a Gaussian of `sigma_px`; `icrs_to_image` (3, 3) as for sprites.

    Its light is multiplied by `times`. Where it `covers`, it hides what was drawn before it. `scene.discs.disc_lights`
    chooses between it and, for a small disc, a map.
    """

    disc: Disc
    icrs_to_image: FloatArray
    camera: Camera
    sigma_px: tuple[float, float]
    times: float = 1.0
    covers: bool = True
    shear: Shear | None = None

    @property
    def name(self) -> str:
        """The body's name."""
        return self.disc.name

    @property
    def variance_px(self) -> tuple[float, float]:
        """Of the Gaussian and of a square pixel, along x and y, px squared."""
        return self.sigma_px[0] ** 2 + PIXEL_VARIANCE, self.sigma_px[1] ** 2 + PIXEL_VARIANCE

    def region(self, resolution_px: tuple[int, int]) -> Rectangle | None:
        """The pixels within the outline of its limb, its air and the Gaussian's reach; all where that is partly behind."""
        air = 1 + AIR_TOP * self.disc.air_radii
        seen = self.disc.limb(LIMB_PLACES, air) @ self.icrs_to_image.T
        if (seen[:, 2] < BEHIND).any():
            return (0, 0, *resolution_px)
        x_px, y_px = self.camera.project_outward(seen)
        if not (np.isfinite(x_px).all() and np.isfinite(y_px).all()):
            return (0, 0, *resolution_px)
        edges = []
        for k, place in enumerate((x_px, y_px)):
            low, high = float(place.min()), float(place.max())
            half = (high - low) / 2 * BOW + REACH_SIGMAS * float(np.sqrt(self.variance_px[k])) + 1 + self._sheared_px
            edges.append(((low + high) / 2 - half, (low + high) / 2 + half))
        return clipped((edges[0][0], edges[1][0], edges[0][1], edges[1][1]), resolution_px)

    @property
    def _sheared_px(self) -> float:
        """How far the first and the last pixels' light is moved at most, about."""
        if self.shear is None:
            return 0.0
        late_s = sum(abs(s) * size for s, size in zip(self.shear.s_per_px, self.camera.resolution_px, strict=True)) / 2
        turn = float(np.linalg.norm(self.shear.rate_image_rad_s)) * late_s
        return 2 * turn * float(np.hypot(self.camera.focal_length_px, max(self.camera.resolution_px)))


ExtendedLight = LightMap | Glow | DiscLight


def clipped(edges_px: tuple[float, float, float, float], resolution_px: tuple[int, int]) -> Rectangle | None:
    """The pixels of an image within left, top, right and bottom (the last two excluded); None where there is none."""
    (left, right), (top, bottom) = (
        np.clip((np.floor(edges_px[k]), np.ceil(edges_px[k + 2])), 0, resolution_px[k]).astype(int).tolist() for k in (0, 1)
    )
    return (left, top, right - left, bottom - top) if right > left and bottom > top else None
