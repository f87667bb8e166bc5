"""From stars and an attitude to sprites: the only thing that crosses from mathematics to the GPU."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hilstar.arrays import Float32Array, FloatArray, IntArray
from hilstar.scene.camera import Camera
from hilstar.scene.psf import peak_share, pixel_share
from hilstar.sky.stars import Stars

# A whole pixel and a float32 fraction: float32 alone would cost 1e-4 px at 2000 px and 1e-3 px further out.
# results/tradeoff.csv, projection: 4e-8 px, where float32 throughout is 6e-4 px off.
SPRITE_DTYPE = np.dtype([("pixel", "<i4", 2), ("fraction_px", "<f4", 2), ("electrons_per_s", "<f4")])

# A star at most this much over white is not called clipped: flux and white are float32 on the way.
CLIP_TOLERANCE = 1e-6


@dataclass(frozen=True, slots=True)
class Sprites:
    """Stars on the image: `data` (n,) of SPRITE_DTYPE, their centres, and where each lies in `Stars`.

    A sprite covers `footprint_px` squared pixels, the first of them at `pixel - (footprint_px - 1) // 2`. A star's light is
    divided among up to `per_star` sprites.
    """

    data: npt.NDArray[np.void]
    footprint_px: int
    star: IntArray
    x_px: FloatArray
    y_px: FloatArray
    per_star: int = 1

    def __len__(self) -> int:
        return len(self.data)

    @property
    def star_count(self) -> int:
        """How many stars have a sprite here."""
        return len(self) if self.per_star == 1 else len(np.unique(self.star))


def make_sprites(stars: Stars, icrs_to_image: FloatArray, camera: Camera, footprint_px: int) -> Sprites:
    """The sprites of every star whose footprint touches the image, centres off the edge included.

    `icrs_to_image` (3, 3) turns ICRS components into image components.
    """
    near = stars.grid.near(icrs_to_image[2], camera.field_radius_rad(footprint_px / 2 + 1))
    x_px, y_px = camera.project(stars.vectors[near] @ icrs_to_image.T)
    return pack_sprites(x_px, y_px, stars.electrons_per_s[near], near, (camera.resolution_px, footprint_px))


def pack_sprites(
    x_px: FloatArray, y_px: FloatArray, electrons_per_s: FloatArray, star: IntArray, frame: tuple[tuple[int, int], int]
) -> Sprites:
    """Sprites at `x_px`, `y_px` (n,), those left out whose footprints miss the image; NaN misses it.

    `frame` is the image's (width, height) and the footprint's side, px.
    """
    (width, height), footprint_px = frame
    # An odd footprint has the star in its middle pixel, an even one within half a pixel of its middle corner.
    bias = 0.5 if footprint_px % 2 else 0.0
    pixel_x, pixel_y = np.floor(x_px + bias), np.floor(y_px + bias)
    before = (footprint_px - 1) // 2
    after = footprint_px - 1 - before
    seen = (pixel_x >= -after) & (pixel_x < width + before) & (pixel_y >= -after) & (pixel_y < height + before)
    x_px, y_px = x_px[seen], y_px[seen]
    data = np.empty(len(x_px), dtype=SPRITE_DTYPE)
    data["pixel"][:, 0] = pixel_x = pixel_x[seen]
    data["pixel"][:, 1] = pixel_y = pixel_y[seen]
    data["fraction_px"][:, 0] = x_px - pixel_x
    data["fraction_px"][:, 1] = y_px - pixel_y
    data["electrons_per_s"] = electrons_per_s[seen]
    return Sprites(data, footprint_px, star[seen], x_px, y_px)


def join_sprites(parts: Sequence[Sprites], footprint_px: int) -> Sprites:
    """All sprites of `parts`, which have one footprint."""
    if not parts:
        nothing = np.empty(0)
        return Sprites(np.empty(0, dtype=SPRITE_DTYPE), footprint_px, np.empty(0, dtype=np.intp), nothing, nothing)
    return Sprites(
        np.concatenate([part.data for part in parts]),
        footprint_px,
        np.concatenate([part.star for part in parts]),
        np.concatenate([part.x_px for part in parts]),
        np.concatenate([part.y_px for part in parts]),
    )


def clipped_sprites(
    sprites: Sprites,
    sigma_px: tuple[float, float],
    flux_at_white_e_per_s: float,
    resolution_px: tuple[int, int],
    uniformity: Float32Array | None = None,
) -> IntArray:
    """Positions of the sprites whose brightest pixel lies on the image and, neighbours' light included, is over white.

    White is `flux_at_white_e_per_s` times a pixel's `uniformity` (height, width), where that is given.

    Only a star that alone reaches half of white in a pixel is looked at: two fainter ones on one pixel go unnamed.
    """
    least_white = flux_at_white_e_per_s * (1.0 if uniformity is None else float(uniformity.min()))
    alone = 0.5 * least_white / peak_share(sigma_px) / sprites.per_star
    bright = np.flatnonzero(sprites.data["electrons_per_s"] > alone)
    if not len(bright):
        return bright
    x, y = np.rint(sprites.x_px[bright]).astype(int), np.rint(sprites.y_px[bright]).astype(int)
    inside = (x >= 0) & (x < resolution_px[0]) & (y >= 0) & (y < resolution_px[1])
    bright, x, y = bright[inside], x[inside], y[inside]
    limit = np.full(len(bright), flux_at_white_e_per_s * (1 + CLIP_TOLERANCE))
    if uniformity is not None:
        limit *= uniformity[y, x]
    over = [_peak_light(sprites, int(i), sigma_px) > most for i, most in zip(bright, limit, strict=True)]
    return np.asarray(bright[np.array(over, dtype=bool)], dtype=np.intp)


def _peak_light(sprites: Sprites, i: int, sigma_px: tuple[float, float]) -> float:
    """Light of all sprites in the pixel that holds the centre of sprite `i`."""
    offset_x = sprites.x_px - np.rint(sprites.x_px[i])
    offset_y = sprites.y_px - np.rint(sprites.y_px[i])
    reach = sprites.footprint_px / 2
    total = 0.0
    for k in np.flatnonzero((np.abs(offset_x) <= reach) & (np.abs(offset_y) <= reach)):
        share = pixel_share(offset_x[k], sigma_px[0]) * pixel_share(offset_y[k], sigma_px[1])
        total += float(sprites.data["electrons_per_s"][k]) * share
    return total
