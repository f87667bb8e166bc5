"""Satellites of one image: each a chain of sprites along its own path while the camera turns.

The light of such a path is not even: a satellite flashes, and goes into the Earth's shadow or
behind the Earth. So a path is cut into equal times, each with a sprite in its middle that has the
mean light of that time: the sum is exact for any flash.

Satellites wide enough to have a face: diffuse spheres along their paths, which hide the stars
behind them.
"""

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from hilstar.basics.arrays import BoolArray, FloatArray, IntArray
from hilstar.basics.rotation import propagate, to_matrix
from hilstar.optics.camera import Camera
from hilstar.optics.extended import DiscLight, DiscView, ExtendedLight, LightMap, Pose, disc_lights
from hilstar.optics.paths import Chords, Paths
from hilstar.optics.psf import Psf
from hilstar.optics.sprites import FrameLight, pack_sprites, with_sprites
from hilstar.sky.bodies.disc import Disc

if TYPE_CHECKING:
    from hilstar.sky.bodies.passes import Pass

# At this spacing no pixel of a streak is wrong by more than 1e-3 of the satellite's light:
# spacing^2 / 24 times the slope at its end (held by tests/unit/optics/test_trails.py).
SPACING_SIGMA = 0.3
LIGHT_S = 0.25  # the longest time of one sprite; a low orbit enters the shadow in 8 s
SAMPLES = 9  # samples of a path that give its length and its part on the image
REACH = 2.0  # times the speed at a moment, as a bound for some seconds about it
BULGE = 2.0  # how much farther than its samples a path may be from the line between its ends
EVERY = slice(None)
# places of a disc along its path: its edge is then uneven by 1 % of the radius
STEPS_A_RADIUS = 4.0
AT_REST = np.array([1.0, 0.0, 0.0, 0.0])
NORTH = np.array([0.0, 0.0, 1.0])
M_PER_KM = 1000.0


@dataclass(frozen=True, slots=True)
class TrailView:
    """A camera that turns: `icrs_to_image` (3, 3) and the rate (3,) in image axes, rad/s, both at
    the moment of a pass.

    `velocity_km_s` (3,) is the observer's against that for which directions are aberrated (see
    `Stars`), None for the same.
    """

    camera: Camera
    icrs_to_image: FloatArray
    rate_image_rad_s: FloatArray
    velocity_km_s: FloatArray | None = None

    def places_px(
        self, seen: "Pass", which: IntArray | slice, seconds: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Pixel x and y of satellites `which` (k,) of a pass, each at its own of `seconds` (k,);
        NaN behind the camera.
        """
        turned = seen.directions(which, seconds, self.velocity_km_s) @ self.icrs_to_image.T
        if not self.rate_image_rad_s.any():
            return self.camera.project_outward(turned)
        return Paths(turned, self.rate_image_rad_s, self.camera).places_px(EVERY, seconds)

    def in_reach(self, seen: "Pass", longest_s: float, margin_px: float) -> IntArray:
        """Places of the satellites that can come within a margin of the image within that time
        of the moment, and some more.
        """
        directions = seen.directions(EVERY, np.zeros(len(seen)), self.velocity_km_s)
        turned = directions @ self.icrs_to_image.T
        fastest_rad_s = float(seen.speeds_rad_s().max())
        turning_rad_s = float(np.linalg.norm(self.rate_image_rad_s))
        reach_rad = (fastest_rad_s + turning_rad_s) * longest_s
        return self.camera.in_view(turned, margin_px, REACH * reach_rad)


@dataclass(frozen=True, slots=True)
class Brush:
    """A sprite's PSF, and the maximum number for all satellites together; above it sprites are
    spaced more widely.

    A satellite that is a disc is drawn at up to `poses` places.
    """

    psf: Psf
    most: int
    poses: int = 33


@dataclass(frozen=True, slots=True)
class Lit:
    """When satellites (n,) send light to an image, seconds: each from its own `begin_s` for
    `length_s`.
    """

    begin_s: FloatArray
    length_s: float

    @property
    def middle_s(self) -> FloatArray:
        """The middle of each one's time."""
        return np.asarray(self.begin_s + self.length_s / 2)


@dataclass(frozen=True, slots=True)
class Trails:
    """Sprites of satellites, their `star` the place in the list, and those in the image:
    `index`, their mean rates (k,).
    """

    sprites: FrameLight
    index: IntArray
    electrons_per_s: FloatArray
    # unit vectors (k, 3), ICRS, in the middle of each one's time, as `Pass.directions`
    middle: FloatArray


def trails(
    seen: "Pass", view: TrailView, lit: Lit, brush: Brush, faintest_e_per_s: float = 0.0
) -> Trails:
    """The satellites of a pass along their paths; one whose mean rate is fainter than
    `faintest_e_per_s` is left out.
    """
    wanted, (begin, end) = sprite_counts(seen, view, lit, brush)
    counts = wanted
    total = int(wanted.sum())
    if total > brush.most:  # in proportion, one at least
        in_proportion = (wanted * (brush.most / total)).astype(np.intp)
        counts = np.minimum(wanted, np.maximum(1, in_proportion))
    path = np.repeat(np.arange(len(seen)), counts)
    first_of_path = np.cumsum(counts) - counts
    order = np.arange(len(path)) - np.repeat(first_of_path, counts)
    part_of_path = (end - begin) / np.maximum(counts, 1)
    part = part_of_path[path]
    first_part = begin[path] + order * part
    first_s = lit.begin_s[path] + first_part * lit.length_s
    last_s = first_s + part * lit.length_s
    x_px, y_px = view.places_px(seen, path, (first_s + last_s) / 2)
    light = seen.rates_e_per_s(path, first_s, last_s) * part
    rates = np.asarray(np.bincount(path, light, minlength=len(seen)), dtype=np.float64)
    shown = (rates > 0) & (rates >= faintest_e_per_s)
    is_lit = shown[path] & (light > 0)
    star = seen.index[path[is_lit]]
    size_px = view.camera.resolution_px
    sprites = pack_sprites(
        x_px[is_lit], y_px[is_lit], light[is_lit], star, size_px, brush.psf.footprint_px
    )
    trailed = np.flatnonzero(np.isin(seen.index, sprites.star))
    most = int(np.bincount(path[is_lit], minlength=1).max(initial=1))
    coarser = (counts < wanted)[trailed]
    sprites = replace(sprites, per_star=max(1, most), capped=int(coarser.sum()))
    middle = seen.directions(trailed, lit.middle_s[trailed])
    return Trails(sprites, seen.index[trailed], rates[trailed], middle)


def sprite_counts(
    seen: "Pass", view: TrailView, lit: Lit, brush: Brush
) -> tuple[IntArray, tuple[FloatArray, FloatArray]]:
    """How many sprites each path should have (0: it misses the image), and its part on the
    image.
    """
    at = np.linspace(0.0, 1.0, SAMPLES)[:, None]
    which = np.tile(np.arange(len(seen)), SAMPLES)
    seconds = lit.begin_s + at * lit.length_s
    x_px, y_px = view.places_px(seen, which, seconds.ravel())
    x_px = x_px.reshape(SAMPLES, -1)
    y_px = y_px.reshape(SAMPLES, -1)
    ends = Chords(x_px[[0, -1]], y_px[[0, -1]])
    off_x = (1 - at) * x_px[0] + at * x_px[-1] - x_px
    off_y = (1 - at) * y_px[0] + at * y_px[-1] - y_px
    largest_px2 = (off_x * off_x + off_y * off_y).max(axis=0)
    bulge_px = BULGE * np.sqrt(largest_px2)
    margin_px = brush.psf.footprint_px / 2 + 1 + np.nan_to_num(bulge_px)
    begin, end = ends.on_image(view.camera.resolution_px, margin_px)
    sigma_x, sigma_y = brush.psf.width_px
    step_x = np.diff(x_px, axis=0) / sigma_x
    step_y = np.diff(y_px, axis=0) / sigma_y
    steps = np.sqrt(step_x * step_x + step_y * step_y)
    length = steps.sum(axis=0) * (end - begin)
    length = np.nan_to_num(length, nan=brush.most * SPACING_SIGMA)
    spaces = np.floor(np.minimum(length / SPACING_SIGMA, brush.most))
    at_least = np.ceil((end - begin) * lit.length_s / LIGHT_S)
    wanted = np.maximum(1 + spaces.astype(np.intp), at_least.astype(np.intp))
    wanted[end <= begin] = 0
    return wanted, (begin, end)


def with_trails(sprites: FrameLight, found: Trails, first: int) -> FrameLight:
    """Stars' sprites and after them those of satellites, whose places in `Stars` begin at
    `first`.
    """
    trail_sprites = found.sprites
    numbered = replace(trail_sprites, star=trail_sprites.star + first)
    whole = with_sprites(sprites, [numbered])
    return replace(
        whole,
        per_star=max(sprites.per_star, trail_sprites.per_star),
        capped=sprites.capped + trail_sprites.capped,
    )


@dataclass(frozen=True, slots=True)
class DiscTrail:
    """One satellite in an image: its place in the list, its mean rate, its discs, one after the
    other, and the share of each.

    `lights` draw them in this order, `brightest_e_per_s` is about their brightest pixel.
    """

    index: int
    electrons_per_s: float
    middle: FloatArray
    along: tuple[Disc, ...]
    shares: FloatArray
    lights: tuple[ExtendedLight, ...]
    brightest_e_per_s: float


def wide(seen: "Pass", px_per_rad: float, wider_px: float) -> BoolArray:
    """Which satellites (n,) of a pass are wider than so many pixels."""
    size_km = seen.brightness.size_m[seen.index] / M_PER_KM
    distance_km = np.linalg.norm(seen.seen_km[0], axis=1)
    return np.asarray(size_km * px_per_rad > wider_px * distance_km)


def disc_of(seen: "Pass", name: str, second: float, velocity_km_s: FloatArray | None) -> Disc:
    """The disc of the only satellite of a pass at a time after its moment, without light."""
    at = np.array([second])
    radius_km = float(seen.brightness.size_m[seen.index[0]]) / M_PER_KM / 2
    distance_km = float(np.linalg.norm(seen.vectors_km(at)[0]))
    return Disc(
        name=name,
        direction=seen.directions(slice(None), at, velocity_km_s)[0],
        distance_km=max(distance_km, 1.001 * radius_km),
        equator_km=radius_km,
        polar_km=radius_km,
        pole=NORTH,
        sun=seen.now.sun_km / np.linalg.norm(seen.now.sun_km),
        law="lambert",
        normal_e_per_s_sr=0.0,
    )


def disc_trail(
    seen: "Pass", name: str, view: TrailView, lit: Lit, brush: Brush
) -> DiscTrail | None:
    """The only satellite of a pass along its path; None where it misses the image or has no
    light.
    """
    counts, (begin, end) = sprite_counts(seen, view, lit, brush)
    disc_now = disc_of(seen, name, 0.0, None)
    radius_px = disc_now.radius_rad * view.camera.focal_length_px
    radius_sigma = radius_px / min(brush.psf.width_px)
    coarser = max(1.0, radius_sigma / (STEPS_A_RADIUS * SPACING_SIGMA))
    count = min(math.ceil(int(counts[0]) / coarser), brush.poses)
    if not count:
        return None
    parts = np.linspace(begin[0], end[0], count + 1)
    edges_s = lit.begin_s[0] + parts * lit.length_s
    begins_s = edges_s[:-1]
    ends_s = edges_s[1:]
    middles_s = ((ends_s + begins_s) / 2).tolist()
    share = float(end[0] - begin[0]) / count
    itself = np.zeros(count, dtype=np.intp)
    rates = seen.rates_e_per_s(itself, begins_s, ends_s)
    if not rates.any():
        return None
    bare = [disc_of(seen, name, second, view.velocity_km_s) for second in middles_s]
    lights: list[ExtendedLight] = []
    if count > 1:
        # Together they hide what the one in the middle hides: each after the other would hide the
        # light of those before.
        k = count // 2
        lights += _lights(bare[k], view, middles_s[k], brush, 0.0, covers=True)
    along: list[Disc] = []
    for disc, rate, second in zip(bare, rates.tolist(), middles_s, strict=True):
        lit_disc = disc.of_rate(rate)
        along.append(lit_disc)
        lights += _lights(lit_disc, view, second, brush, share, covers=count == 1)
    if not lights:
        return None
    middle = seen.directions(slice(None), lit.middle_s)[0]
    image_max = 0.0
    radiance = 0.0
    for light in lights:
        if isinstance(light, LightMap):
            image_max += float(light.image.max(initial=0.0))
        elif isinstance(light, DiscLight):
            radiance += light.times * light.disc.normal_e_per_s_sr
    smallest_px_rad, _ = view.camera.scales_px_rad()
    return DiscTrail(
        index=int(seen.index[0]),
        electrons_per_s=float(rates.sum()) * share,
        middle=middle,
        along=tuple(along),
        shares=np.full(count, share),
        lights=tuple(lights),
        brightest_e_per_s=image_max + radiance / smallest_px_rad**2,
    )


def _lights(
    disc: Disc, view: TrailView, second: float, brush: Brush, share: float, covers: bool
) -> list[ExtendedLight]:
    """A disc as a turning camera has it at a time, with a share of its light."""
    turn = to_matrix(propagate(AT_REST, view.rate_image_rad_s, second))
    pose = Pose(turn @ view.icrs_to_image, share)
    return disc_lights(disc, DiscView(view.camera, brush.psf, (pose,)), covers)


def hidden(sprites: FrameLight, directions: FloatArray, found: DiscTrail) -> FrameLight:
    """Sprites of stars seen in `directions` (n, 3), each without the share of its light that a
    satellite hides.
    """
    share_left = np.ones(len(sprites))
    for disc, share in zip(found.along, found.shares, strict=True):
        is_behind = directions @ disc.direction > np.cos(disc.radius_rad)
        share_left -= share * is_behind
    is_visible = share_left > 0
    data = sprites.data[is_visible]
    data["electrons_per_s"] *= share_left[is_visible].astype(np.float32)
    star = sprites.star[is_visible]
    x_px = sprites.x_px[is_visible]
    y_px = sprites.y_px[is_visible]
    return replace(sprites, data=data, star=star, x_px=x_px, y_px=y_px)
