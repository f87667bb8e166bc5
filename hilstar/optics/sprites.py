"""From stars and an attitude to sprites: the only thing that crosses from mathematics to the GPU.

Candidates, the stars about a field, are kept from frame to frame, because most frames turn the
field by a fraction of a degree. `clipped_sprites` finds the stars that need more light than one
monitor pixel has.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from hilstar.basics.arrays import BoolArray, Float32Array, FloatArray, IntArray
from hilstar.optics.camera import Camera
from hilstar.optics.extended import ExtendedLight, GlowLight, times
from hilstar.optics.psf import Psf
from hilstar.sky.stars import BV_MAG, Stars

# How far the field may turn before its stars are looked for again. A frame's work grows with it by
# the stars around the image.
KEPT_TURN_RAD = math.radians(1.0)
# The square of the chord between two attitudes is right to 1e-15, so an angle this near to the
# limit is over it.
ROUNDING_RAD = 1e-6
# A whole pixel and a float32 fraction: float32 alone would be off by 1e-4 px at 2000 px and 1e-3 px
# further out. results/tradeoff.csv, projection: 4e-8 px, where float32 throughout is 6e-4 px off.
SPRITE_DTYPE = np.dtype(
    [("pixel", "<i4", 2), ("fraction_px", "<f4", 2), ("electrons_per_s", "<f4")]
)

# The work and memory of a frame are bounded by the pixels that its sprites cover: 250 000 stars of
# sigma 0.85 px. Of more stars only the brightest are drawn.
MAX_COVERED_PX = 25_000_000
# A star over white by no more than this is not called clipped: flux and white pass through float32.
CLIP_TOLERANCE = 1e-6
# Number of sprites (the brightest) that are tested for clipping with the light of others: the work
# is bounded.
MAX_DOUBTFUL = 512
# pairs of pixels and sprites near them: up to so many are tested all at once, without sorting
FEW_PAIRS = 4096


class NearStars(NamedTuple):
    """Stars about a field: their places in `Stars`, rising, directions (3, n), ICRS, and
    electrons per second (n,).
    """

    star: IntArray
    directions: FloatArray
    electrons_per_s: FloatArray


class Candidates:
    """The stars near a camera's field, looked for again once it has turned by KEPT_TURN_RAD from
    where they were.

    No direction of the field moves farther than the field turns, so none that comes into view is
    missed. Stars among which bodies are moved, or whose observer moves, are looked for in every
    frame.
    """

    def __init__(self) -> None:
        # The stars, the camera and the margin that were asked about, the attitude then, and what
        # was found
        self._kept: tuple[Stars, Camera, float, FloatArray, NearStars] | None = None

    def near(
        self, stars: Stars, icrs_to_image: FloatArray, camera: Camera, margin_px: float
    ) -> NearStars:
        """The stars within `margin_px` of the image, and some more. The caller must not change
        the arrays.
        """
        keeps = not stars.bodies and stars.velocity_km_s is None and stars.air is None
        if keeps and self._kept is not None:
            last, last_camera, last_margin_px, last_icrs_to_image, near = self._kept
            same_stars = (
                stars.vectors is last.vectors
                and stars.electrons_per_s is last.electrons_per_s
                and stars.grid is last.grid
            )
            same_image = camera is last_camera and margin_px == last_margin_px
            difference = (icrs_to_image - last_icrs_to_image).ravel()
            # |R - S| by its elements is sqrt(8) sin(angle / 2), whatever the axis of the turn from
            # R to S: roll counts as well.
            chord = math.sqrt(float(difference @ difference) / 8)
            turned_rad = 2 * math.asin(min(1.0, chord))
            if same_stars and same_image and turned_rad <= KEPT_TURN_RAD - ROUNDING_RAD:
                return near
        reach_rad = KEPT_TURN_RAD if keeps else 0.0
        star = stars_about(stars, icrs_to_image, camera, margin_px, reach_rad)
        near = NearStars(star, stars.directions(star).T, stars.electrons_per_s.take(star))
        if keeps:
            self._kept = stars, camera, margin_px, icrs_to_image.copy(), near
        return near


def stars_about(
    stars: Stars,
    icrs_to_image: FloatArray,
    camera: Camera,
    margin_px: float,
    reach_rad: float = 0.0,
) -> IntArray:
    """Every star that can come within `margin_px` of the image by a turn of `reach_rad`, and
    some more; rising.
    """
    radius_rad, edges = camera.field(margin_px)
    return stars.near(icrs_to_image[2], radius_rad, edges @ icrs_to_image, reach_rad)


@dataclass(frozen=True, slots=True)
class AddedLight:
    """Light that a fault adds to a frame: its name, magnitude, colour, and electrons per second."""

    name: str
    v_mag: float
    bv_mag: float
    electrons_per_s: float


@dataclass(frozen=True, slots=True)
class FrameLight:
    """Stars on the image: `data` (n,) of SPRITE_DTYPE, their centres, and where each lies in
    `Stars`.

    A sprite covers `footprint_px` squared pixels, the first of them at `pixel - (footprint_px - 1)
    // 2`. A star's light is divided among up to `per_star` sprites. `capped` stars are drawn
    coarser than they should be, or not at all, because the work of a frame is bounded.
    `rate_cam_rad_s` (3,) is the turn along which stars are drawn as paths, None for points.
    `spectra` (n, L) or (L,) are shares of the wavelengths of a PSF that changes over the field;
    None draws all by its mean. `extended` is the frame's light other than stars, in the order in
    which it is drawn; `discs` names the bodies among it, and `over_white` those of them that are
    brighter than white. Sprites of `added` light have -1, -2 and on for `star`. Where the monitor's
    primaries are driven apart, `primaries` float32 (n, 3) is the light of each, and `lights` the
    extended light of each, moved to where that primary has to be drawn.
    """

    data: npt.NDArray[np.void]
    footprint_px: int
    star: IntArray
    x_px: FloatArray
    y_px: FloatArray
    per_star: int = 1
    capped: int = 0
    rate_cam_rad_s: FloatArray | None = None
    spectra: FloatArray | None = None
    extended: tuple[ExtendedLight, ...] = ()
    added: tuple[AddedLight, ...] = ()
    discs: tuple[str, ...] = ()
    over_white: tuple[str, ...] = ()
    primaries: Float32Array | None = None
    lights: tuple[tuple[ExtendedLight, ...], ...] = ()

    def __len__(self) -> int:
        return len(self.data)

    @property
    def star_count(self) -> int:
        """How many stars have a sprite here."""
        if self.per_star == 1:
            return len(self)
        return len(np.unique(self.star))


def make_sprites(
    stars: Stars,
    icrs_to_image: FloatArray,
    camera: Camera,
    footprint_px: int,
    candidates: Candidates | None = None,
) -> FrameLight:
    """The sprites of every star whose footprint touches the image, centres off the edge included.

    `icrs_to_image` (3, 3) turns ICRS components into image components. With `candidates` of the
    last frame stars need not be looked for anew; the sprites are the same.
    """
    margin_px = footprint_px / 2 + 1
    if candidates is None:
        near = stars_about(stars, icrs_to_image, camera, margin_px)
        directions = stars.directions(near).T
        electrons_per_s = stars.electrons_per_s.take(near)
    else:
        known = candidates.near(stars, icrs_to_image, camera, margin_px)
        near, directions, electrons_per_s = known
    image_directions = (icrs_to_image @ directions).T  # component by component, as they are kept
    if camera.lens is not None:  # with a pinhole, projecting all costs less than selecting
        close = camera.in_view(image_directions, margin_px, 0.0)
        near = near[close]
        image_directions = image_directions[close]
        electrons_per_s = electrons_per_s[close]
    x_px, y_px = camera.project(image_directions)
    sprites = pack_sprites(x_px, y_px, electrons_per_s, near, camera.resolution_px, footprint_px)
    brightest_rows = brightest(sprites.data["electrons_per_s"], max_stars(footprint_px))
    if brightest_rows is None:
        return sprites
    dropped = len(sprites) - len(brightest_rows)
    star = sprites.star[brightest_rows]
    x_px = sprites.x_px[brightest_rows]
    y_px = sprites.y_px[brightest_rows]
    return FrameLight(sprites.data[brightest_rows], footprint_px, star, x_px, y_px, capped=dropped)


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
) -> FrameLight:
    """Sprites of the stars at `x_px`, `y_px` (n,) whose footprints touch an image of `size_px`
    (width, height).

    `footprint_px` is the side of a footprint. A star at NaN touches no image.
    """
    width, height = size_px
    # An odd footprint has the star in its middle pixel, an even one within half a pixel of its
    # middle corner.
    bias = 0.5 if footprint_px % 2 else 0.0
    before = (footprint_px - 1) // 2
    after = footprint_px - 1 - before
    inside = _between(x_px, -after - bias, width + before - bias)
    inside &= _between(y_px, -after - bias, height + before - bias)
    inside_rows = inside.nonzero()[0]
    x_px = x_px.take(inside_rows)
    y_px = y_px.take(inside_rows)
    data = np.empty(len(inside_rows), dtype=SPRITE_DTYPE)
    integers = data.view(np.int32).reshape(-1, 5)
    floats = data.view(np.float32).reshape(-1, 5)
    for column, place_px in enumerate((x_px, y_px)):
        pixel = np.floor(place_px + bias)
        integers[:, column] = pixel
        floats[:, 2 + column] = place_px - pixel
    floats[:, 4] = electrons_per_s.take(inside_rows)
    return FrameLight(data, footprint_px, star.take(inside_rows), x_px, y_px)


def _between(place_px: FloatArray, first: float, end: float) -> npt.NDArray[np.bool_]:
    """True for places from `first` to before `end`; not so at NaN."""
    return np.asarray((place_px >= first) & (place_px < end))


def join_sprites(parts: Sequence[FrameLight], footprint_px: int) -> FrameLight:
    """All sprites of `parts`, which have one footprint."""
    if not parts:
        no_sprites = np.empty(0, dtype=SPRITE_DTYPE)
        no_stars = np.empty(0, dtype=np.intp)
        no_places = np.empty(0)
        return FrameLight(no_sprites, footprint_px, no_stars, no_places, no_places)
    return FrameLight(
        np.concatenate([part.data for part in parts]),
        footprint_px,
        np.concatenate([part.star for part in parts]),
        np.concatenate([part.x_px for part in parts]),
        np.concatenate([part.y_px for part in parts]),
    )


def without_stars(sprites: FrameLight) -> FrameLight:
    """The extended light of sprites alone."""
    return replace(join_sprites([], sprites.footprint_px), extended=sprites.extended)


def with_sprites(sprites: FrameLight, parts: Sequence[FrameLight]) -> FrameLight:
    """Sprites and those of `parts`, which have the same footprint, end to end; the rest stays
    that of the first.
    """
    joined = join_sprites([sprites, *parts], sprites.footprint_px)
    return replace(sprites, data=joined.data, star=joined.star, x_px=joined.x_px, y_px=joined.y_px)


def by_channel(sprites: FrameLight, stars: Stars) -> list[FrameLight]:
    """The sprites of each channel of the tracker: every light times its share there; the sprites
    themselves where it has one.

    `stars` are those among which `sprites.star` has its places.
    """
    if stars.colours is None:
        return [sprites]
    return by_share(sprites, stars, stars.colours, stars.colours_by_bv)


def mean_share(shares: FloatArray, stars: Stars) -> FloatArray:
    """The shares (columns,) of all stars' light together, without bodies', by those of each (n,
    columns).
    """
    rates = stars.rates_e_per_s
    total = rates.sum() or 1.0
    return np.asarray(rates @ shares[: len(rates)] / total)


def shares_at(shares: FloatArray, stars: Stars, places: IntArray) -> FloatArray:
    """Shares (n, columns) of stars at places (n,); below 0, where light is no star's, their
    `mean_share`.
    """
    place_shares = np.empty((len(places), shares.shape[1]))
    is_star = places >= 0
    place_shares[is_star] = shares[places[is_star]]
    if not is_star.all():
        place_shares[~is_star] = mean_share(shares, stars)
    return place_shares


def shares_by_bv(by_bv: FloatArray, bv_mag: FloatArray | float) -> FloatArray:
    """Shares (n, columns) of light of colours (n,), by those of BV_MAG."""
    shares = [np.interp(bv_mag, BV_MAG, column) for column in by_bv.T]
    return np.stack(shares, axis=-1)


def shares_of_sprites(
    sprites: FrameLight, stars: Stars, shares: FloatArray, by_bv: FloatArray | None
) -> FloatArray:
    """The shares (n, columns) of each sprite's light, by those of each star; see `by_share`."""
    sprite_shares = shares_at(shares, stars, sprites.star)
    added = sprites.star < 0
    if by_bv is not None and added.any():
        added_bv_mag = np.array([light.bv_mag for light in sprites.added])
        of_sprites_mag = added_bv_mag[-1 - sprites.star[added]]
        sprite_shares[added] = shares_by_bv(by_bv, of_sprites_mag)
    return sprite_shares


def by_primary(sprites: FrameLight, places_px: FloatArray, k: int) -> FrameLight:
    """The sprites of primary `k`, each where it is drawn so that its light, at its place (3, 2)
    within a pixel, lies there.
    """
    # as in pack_sprites
    data = sprites.data.copy()
    bias = np.float32(0.5 if sprites.footprint_px % 2 else 0.0)
    if sprites.primaries is not None:
        data["electrons_per_s"] = sprites.primaries[:, k]
    for column, away_px in enumerate(places_px[k]):
        if not away_px:
            continue
        # as in shaders/exact/stars.glsl
        part = data["fraction_px"][:, column] - np.float32(away_px)
        whole = np.floor(part + bias)
        data["pixel"][:, column] += whole.astype(np.int32)
        data["fraction_px"][:, column] = part - whole
    right, down = places_px[k]
    x_px = sprites.x_px - right
    y_px = sprites.y_px - down
    lights = sprites.lights[k] if sprites.lights else ()
    return replace(
        sprites, data=data, x_px=x_px, y_px=y_px, extended=lights, primaries=None, lights=()
    )


def by_share(
    sprites: FrameLight, stars: Stars, shares: FloatArray, by_bv: FloatArray | None = None
) -> list[FrameLight]:
    """The sprites once for each column of `shares` (stars, columns): every light times its star's
    or body's share.

    Light that is neither a star's nor a body's, as a fault's, has that of its B-V, `by_bv`; without
    one the mean of the stars.
    """
    of_sprites = shares_of_sprites(sprites, stars, shares, by_bv).astype(np.float32)
    of_extended = extended_by_share(sprites, stars, shares, by_bv)
    parts = []
    for share, lights in zip(of_sprites.T, of_extended, strict=True):
        data = sprites.data.copy()
        data["electrons_per_s"] *= share
        parts.append(replace(sprites, data=data, extended=lights))
    return parts


def extended_by_share(
    sprites: FrameLight, stars: Stars, shares: FloatArray, by_bv: FloatArray | None = None
) -> list[tuple[ExtendedLight, ...]]:
    """The extended light of sprites once for each column of `shares`, as `by_share`."""
    first_body = len(stars.rates_e_per_s)
    bodies = {name: first_body + k for k, name in enumerate(stars.bodies)}
    light_bodies = []
    for light in sprites.extended:
        if isinstance(light, GlowLight):
            light_bodies.append(-1)
        else:
            light_bodies.append(bodies.get(light.name, -1))
    wide = shares_at(shares, stars, np.array(light_bodies, dtype=np.intp))
    for place, (light, body) in enumerate(zip(sprites.extended, light_bodies, strict=True)):
        # light that is neither a star's nor a body's, as a fault's, has a colour of its own
        bv_mag = getattr(light, "bv_mag", None)
        if by_bv is not None and body < 0 and bv_mag is not None:
            wide[place] = shares_by_bv(by_bv, bv_mag)
    lights_by_column: list[tuple[ExtendedLight, ...]] = []
    for column_shares in wide.T.tolist():
        lights_by_column.append(tuple(map(times, sprites.extended, column_shares)))
    return lights_by_column


def clipped_sprites(
    sprites: FrameLight,
    psf: Psf,
    flux_at_white_e_per_s: float,
    resolution_px: tuple[int, int],
    uniformity: Float32Array | None = None,
    darkest: float = 1.0,
) -> IntArray:
    """Positions of the sprites whose brightest pixel lies on the image and, neighbours' light
    included, is over white.

    White is `flux_at_white_e_per_s` times a pixel's `uniformity` (height, width), whose minimum is
    `darkest`.

    Only stars that alone reach half of white in a pixel are tested: two fainter ones on one pixel
    are not reported.
    """
    bright_e_per_s = 0.5 * flux_at_white_e_per_s * darkest / psf.peak_share
    if sprites.per_star * sprites.data["electrons_per_s"].max(initial=0.0) <= bright_e_per_s:
        # most frames: no star is that bright, however its light is divided
        return np.empty(0, dtype=np.intp)
    rates: Float32Array | FloatArray = sprites.data["electrons_per_s"]
    if sprites.per_star > 1:  # the light of each sprite's whole star
        _, star = np.unique(sprites.star, return_inverse=True)
        rates = np.asarray(np.bincount(star, rates)[star], dtype=np.float64)
    bright = (rates > bright_e_per_s).nonzero()[0]
    x = np.rint(sprites.x_px[bright]).astype(int)
    y = np.rint(sprites.y_px[bright]).astype(int)
    width, height = resolution_px
    across = (x >= 0) & (x < width)
    down = (y >= 0) & (y < height)
    inside = across & down
    bright = bright[inside]
    x = x[inside]
    y = y[inside]
    limit = np.full(len(bright), flux_at_white_e_per_s * (1 + CLIP_TOLERANCE))
    if uniformity is not None:
        limit *= uniformity[y, x]
    shares = psf.shares(x - sprites.x_px[bright], y - sprites.y_px[bright])
    own_light = sprites.data["electrons_per_s"][bright] * shares
    over = own_light > limit
    doubtful = (~over).nonzero()[0]
    if len(doubtful) > MAX_DOUBTFUL:
        brightest_first = np.argpartition(-own_light[doubtful], MAX_DOUBTFUL)
        doubtful = doubtful[brightest_first[:MAX_DOUBTFUL]]
    if len(doubtful):
        light = _light_at(sprites, x[doubtful], y[doubtful], psf)
        over[doubtful] = light > limit[doubtful]
    return np.asarray(bright[over], dtype=np.intp)


def _light_at(sprites: FrameLight, x: IntArray, y: IntArray, psf: Psf) -> FloatArray:
    """Light of all sprites together in the pixels at x, y (k,), electrons per second (k,)."""
    pixel = sprites.data["pixel"]
    reach = sprites.footprint_px / 2
    # Sprites whose footprints can reach one of the columns and rows, and some more
    close_x = _reach(pixel[:, 0], x, sprites.footprint_px)
    close_y = _reach(pixel[:, 1], y, sprites.footprint_px)
    close = np.flatnonzero(close_x & close_y)
    if len(x) * len(close) <= FEW_PAIRS:
        offset_x = x[:, None] - sprites.x_px[close]
        offset_y = y[:, None] - sprites.y_px[close]
        share = psf.shares(offset_x, offset_y)
        farther = np.maximum(np.abs(offset_x), np.abs(offset_y))
        share[farther > reach] = 0.0
        rates = sprites.data["electrons_per_s"][close].astype(np.float64)
        return np.asarray(share @ rates)
    order = close[np.argsort(sprites.x_px[close])]
    rising_px = sprites.x_px[order]
    first = np.searchsorted(rising_px, x - reach)
    count = np.searchsorted(rising_px, x + reach, side="right") - first
    pixel = np.repeat(np.arange(len(x)), count)
    # the pairs of a pixel are `count` sprites of `order` from its first on
    first_pair = np.cumsum(count) - count
    to_sprite = np.repeat(first - first_pair, count)
    other = order[np.arange(len(pixel)) + to_sprite]
    offset_y = y[pixel] - sprites.y_px[other]
    near = np.abs(offset_y) <= reach
    pixel = pixel[near]
    other = other[near]
    offset_y = offset_y[near]
    share = psf.shares(x[pixel] - sprites.x_px[other], offset_y)
    light = sprites.data["electrons_per_s"][other] * share
    return np.asarray(np.bincount(pixel, light, minlength=len(x)), dtype=np.float64)


def _reach(pixel: IntArray, wanted: IntArray, size_px: int) -> BoolArray:
    """Which pixels (n,) of an axis are within a footprint of one of the `wanted` (k,)."""
    last = int(wanted.max(initial=0)) + 2 * size_px + 1
    near = np.zeros(last + 1, dtype=np.bool_)
    for place in set(wanted.tolist()):
        near[place : place + 2 * size_px + 1] = True
    return near.take(pixel + size_px, mode="clip")
