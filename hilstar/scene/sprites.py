"""From stars and an attitude to sprites: the only thing that crosses from mathematics to the GPU."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from hilstar.arrays import FloatArray, IntArray
from hilstar.scene.camera import Camera
from hilstar.scene.candidates import Candidates, stars_about
from hilstar.scene.extended import ExtendedLight
from hilstar.sky.stars import Stars

# A whole pixel and a float32 fraction: float32 alone would be off by 1e-4 px at 2000 px and 1e-3 px further out.
# results/tradeoff.csv, projection: 4e-8 px, where float32 throughout is 6e-4 px off.
SPRITE_DTYPE = np.dtype([("pixel", "<i4", 2), ("fraction_px", "<f4", 2), ("electrons_per_s", "<f4")])

# The work and memory of a frame are bounded by the pixels that its sprites cover: 250 000 stars of sigma 0.85 px. Of more
# stars only the brightest are drawn.
MAX_COVERED_PX = 25_000_000


@dataclass(frozen=True, slots=True)
class AddedLight:
    """Light of a frame's own, which is no star's: its name, magnitude, colour, and electrons per second."""

    name: str
    v_mag: float
    bv_mag: float
    electrons_per_s: float


@dataclass(frozen=True, slots=True)
class Sprites:
    """Stars on the image: `data` (n,) of SPRITE_DTYPE, their centres, and where each lies in `Stars`.

    A sprite covers `footprint_px` squared pixels, the first of them at `pixel - (footprint_px - 1) // 2`. A star's light is
    divided among up to `per_star` sprites. `capped` stars are drawn coarser than they should be, or not at all, because
    the work of a frame is bounded. `rate_cam_rad_s` (3,) is the turn along which stars are drawn as paths, None for points.
    `extended` is the frame's light that is no star's, in the order in which it is drawn; `discs` names the bodies among it, and
    `over_white` those of them that are brighter than white. Sprites of `added` light have -1, -2 and on for `star`.
    """

    data: npt.NDArray[np.void]
    footprint_px: int
    star: IntArray
    x_px: FloatArray
    y_px: FloatArray
    per_star: int = 1
    capped: int = 0
    rate_cam_rad_s: FloatArray | None = None
    extended: tuple[ExtendedLight, ...] = ()
    added: tuple[AddedLight, ...] = ()
    discs: tuple[str, ...] = ()
    over_white: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.data)

    @property
    def star_count(self) -> int:
        """How many stars have a sprite here."""
        return len(self) if self.per_star == 1 else len(np.unique(self.star))


def make_sprites(
    stars: Stars, icrs_to_image: FloatArray, camera: Camera, footprint_px: int, candidates: Candidates | None = None
) -> Sprites:
    """The sprites of every star whose footprint touches the image, centres off the edge included.

    `icrs_to_image` (3, 3) turns ICRS components into image components. With `candidates` of the last frame stars need not be
    looked for anew; the sprites are the same.
    """
    margin_px = footprint_px / 2 + 1
    if candidates is None:
        near = stars_about(stars, icrs_to_image, camera, margin_px)
        directions, electrons_per_s = stars.directions(near).T, stars.electrons_per_s.take(near)
    else:
        near, directions, electrons_per_s = candidates.near(stars, icrs_to_image, camera, margin_px)
    seen = (icrs_to_image @ directions).T  # component by component, as they are kept
    if camera.lens is not None:  # a pinhole's places cost less than the choice
        close = camera.in_view(seen, margin_px, 0.0)
        near, seen, electrons_per_s = near[close], seen[close], electrons_per_s[close]
    x_px, y_px = camera.project(seen)
    sprites = pack_sprites(x_px, y_px, electrons_per_s, near, camera.resolution_px, footprint_px)
    kept = brightest(sprites.data["electrons_per_s"], max_stars(footprint_px))
    if kept is None:
        return sprites
    dropped = len(sprites) - len(kept)
    star, x_px, y_px = sprites.star[kept], sprites.x_px[kept], sprites.y_px[kept]
    return Sprites(sprites.data[kept], footprint_px, star, x_px, y_px, capped=dropped)


def max_stars(footprint_px: int) -> int:
    """The maximum number of stars drawn with footprints of that side."""
    return MAX_COVERED_PX // footprint_px**2


def brightest(electrons_per_s: npt.NDArray[np.floating[Any]], count: int) -> IntArray | None:
    """The places of the `count` brightest, in order; None where there are no more than `count`."""
    if len(electrons_per_s) <= count:
        return None
    return np.sort(np.argpartition(-electrons_per_s, count)[:count])


def pack_sprites(
    x_px: FloatArray,
    y_px: FloatArray,
    electrons_per_s: FloatArray,
    star: IntArray,
    size_px: tuple[int, int],
    footprint_px: int,
) -> Sprites:
    """Sprites of the stars at `x_px`, `y_px` (n,) whose footprints touch an image of `size_px` (width, height).

    `footprint_px` is the side of a footprint. A star at NaN touches no image.
    """
    width, height = size_px
    # An odd footprint has the star in its middle pixel, an even one within half a pixel of its middle corner.
    bias = 0.5 if footprint_px % 2 else 0.0
    before = (footprint_px - 1) // 2
    after = footprint_px - 1 - before
    inside = _between(x_px, -after - bias, width + before - bias)
    inside &= _between(y_px, -after - bias, height + before - bias)
    seen = inside.nonzero()[0]
    x_px, y_px = x_px.take(seen), y_px.take(seen)
    data = np.empty(len(seen), dtype=SPRITE_DTYPE)
    whole, part = (data.view(kind).reshape(-1, 5) for kind in (np.int32, np.float32))
    for column, place_px in enumerate((x_px, y_px)):
        pixel = np.floor(place_px + bias)
        whole[:, column] = pixel
        part[:, 2 + column] = place_px - pixel
    part[:, 4] = electrons_per_s.take(seen)
    return Sprites(data, footprint_px, star.take(seen), x_px, y_px)


def _between(place_px: FloatArray, first: float, end: float) -> npt.NDArray[np.bool_]:
    return np.asarray((place_px >= first) & (place_px < end))


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
