"""Satellites of one image: each a chain of sprites along its own path while the camera turns.

The light of such a path is not even: a satellite flashes, and goes into the Earth's shadow or behind the Earth. So a path is
cut into equal times, each with a sprite in its middle that has the mean light of that time: the sum is exact for any flash.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from hilstar.arrays import FloatArray, IntArray
from hilstar.scene.camera import Camera
from hilstar.scene.paths import Chords, Paths
from hilstar.scene.sprites import Sprites, join_sprites, pack_sprites

if TYPE_CHECKING:
    from hilstar.sky.bodies.passes import Pass

# Sprites so far apart make no pixel of a streak wrong by more than 1e-3 of the satellite's light (spacing^2 / 24 of the slope
# of its end; tests/unit/scene/test_trails.py holds it).
SPACING_SIGMA = 0.3
LIGHT_S = 0.25  # the longest time of one sprite: of the 8 s in which a low orbit enters the shadow, for one
SAMPLES = 9  # of a path, from which its length and its part on the image are found
REACH = 2.0  # times the speed at a moment, as a bound for some seconds about it
BULGE = 2.0  # how much farther than its samples a path may be from the line between its ends
EVERY = slice(None)


@dataclass(frozen=True, slots=True)
class View:
    """A camera that turns: `icrs_to_image` (3, 3) and the rate (3,) in image axes, rad/s, both at the moment of a pass.

    `velocity_km_s` (3,) is the observer's against that for which directions are aberrated (see `Stars`), None for the same.
    """

    camera: Camera
    icrs_to_image: FloatArray
    rate_image_rad_s: FloatArray
    velocity_km_s: FloatArray | None = None

    def places_px(self, seen: Pass, which: IntArray | slice, seconds: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Pixel x and y of satellites `which` (k,) of a pass, each at its own of `seconds` (k,); NaN behind the camera."""
        turned = seen.directions(which, seconds, self.velocity_km_s) @ self.icrs_to_image.T
        if not self.rate_image_rad_s.any():
            return self.camera.project_outward(turned)
        return Paths(turned, self.rate_image_rad_s, self.camera).places_px(EVERY, seconds)

    def in_reach(self, seen: Pass, longest_s: float, margin_px: float) -> IntArray:
        """Places of the satellites that can come within a margin of the image within that time of the moment, and some more."""
        turned = seen.directions(EVERY, np.zeros(len(seen)), self.velocity_km_s) @ self.icrs_to_image.T
        reach_rad = (float(seen.speeds_rad_s().max()) + float(np.linalg.norm(self.rate_image_rad_s))) * longest_s
        return self.camera.in_view(turned, margin_px, REACH * reach_rad)


@dataclass(frozen=True, slots=True)
class Brush:
    """What a sprite is: its side and sigma; and how many all satellites get at most, beyond which they are farther apart.

    One that is a disc is drawn at up to `poses` places.
    """

    footprint_px: int
    sigma_px: tuple[float, float]
    most: int
    poses: int = 33


@dataclass(frozen=True, slots=True)
class Lit:
    """When satellites (n,) send light to an image, seconds: each from its own `begin_s` for `length_s`."""

    begin_s: FloatArray
    length_s: float

    @property
    def middle_s(self) -> FloatArray:
        """The middle of each one's time."""
        return np.asarray(self.begin_s + self.length_s / 2)


@dataclass(frozen=True, slots=True)
class Trails:
    """Sprites of satellites, their `star` the place in the list, and those in the image: `index`, their mean rates (k,)."""

    sprites: Sprites
    index: IntArray
    electrons_per_s: FloatArray
    middle: FloatArray  # unit vectors (k, 3), ICRS, in the middle of each one's time, as `Pass.directions`


def trails(seen: Pass, view: View, lit: Lit, brush: Brush, faintest_e_per_s: float = 0.0) -> Trails:
    """The satellites of a pass along their paths; one whose mean rate is fainter than `faintest_e_per_s` is left out."""
    wanted, (begin, end) = sprite_counts(seen, view, lit, brush)
    counts = _within(wanted, brush.most)
    path = np.repeat(np.arange(len(seen)), counts)
    order = np.arange(len(path)) - np.repeat(np.cumsum(counts) - counts, counts)
    part = ((end - begin) / np.maximum(counts, 1))[path]
    first_s = lit.begin_s[path] + (begin[path] + order * part) * lit.length_s
    last_s = first_s + part * lit.length_s
    x_px, y_px = view.places_px(seen, path, (first_s + last_s) / 2)
    light = seen.rates_e_per_s(path, first_s, last_s) * part
    total = np.asarray(np.bincount(path, light, minlength=len(seen)), dtype=np.float64)
    shown = (total > 0) & (total >= faintest_e_per_s)
    kept = shown[path] & (light > 0)
    star, size_px = seen.index[path[kept]], view.camera.resolution_px
    sprites = pack_sprites(x_px[kept], y_px[kept], light[kept], star, size_px, brush.footprint_px)
    found = np.flatnonzero(np.isin(seen.index, sprites.star))
    most = int(np.bincount(path[kept], minlength=1).max(initial=1))
    sprites = replace(sprites, per_star=max(1, most), capped=int((counts < wanted)[found].sum()))
    return Trails(sprites, seen.index[found], total[found], seen.directions(found, lit.middle_s[found]))


def _within(wanted: IntArray, most: int) -> IntArray:
    """The sprites that paths get of those they want: in proportion where that is more than `most`, one at least."""
    total = int(wanted.sum())
    return wanted if total <= most else np.minimum(wanted, np.maximum(1, (wanted * (most / total)).astype(np.intp)))


def sprite_counts(seen: Pass, view: View, lit: Lit, brush: Brush) -> tuple[IntArray, tuple[FloatArray, FloatArray]]:
    """How many sprites each path should have (0: it misses the image), and its part on the image."""
    at = np.linspace(0.0, 1.0, SAMPLES)[:, None]
    which = np.tile(np.arange(len(seen)), SAMPLES)
    x_px, y_px = view.places_px(seen, which, (lit.begin_s + at * lit.length_s).ravel())
    x_px, y_px = x_px.reshape(SAMPLES, -1), y_px.reshape(SAMPLES, -1)
    ends = Chords(x_px[[0, -1]], y_px[[0, -1]])
    off_x, off_y = ((1 - at) * place[0] + at * place[-1] - place for place in (x_px, y_px))
    bulge_px = BULGE * np.sqrt((off_x * off_x + off_y * off_y).max(axis=0))
    begin, end = ends.on_image(view.camera.resolution_px, brush.footprint_px / 2 + 1 + np.nan_to_num(bulge_px))
    step_x, step_y = (np.diff(place, axis=0) / s for place, s in zip((x_px, y_px), brush.sigma_px, strict=True))
    length = np.sqrt(step_x * step_x + step_y * step_y).sum(axis=0) * (end - begin)
    length = np.nan_to_num(length, nan=brush.most * SPACING_SIGMA)
    wanted = 1 + np.floor(np.minimum(length / SPACING_SIGMA, brush.most)).astype(np.intp)
    wanted = np.maximum(wanted, np.ceil((end - begin) * lit.length_s / LIGHT_S).astype(np.intp))
    wanted[end <= begin] = 0
    return wanted, (begin, end)


def with_trails(sprites: Sprites, found: Trails, first: int) -> Sprites:
    """Stars' sprites and after them those of satellites, whose places in `Stars` begin at `first`."""
    own = found.sprites
    joined = join_sprites([sprites, replace(own, star=own.star + first)], sprites.footprint_px)
    return replace(
        sprites,
        data=joined.data,
        star=joined.star,
        x_px=joined.x_px,
        y_px=joined.y_px,
        per_star=max(sprites.per_star, own.per_star),
        capped=sprites.capped + own.capped,
    )
