"""A large disc as tiles of its image, whose light is known at their corners.

Far from limb and terminator a Lambert or lunar face changes little over a tile: its light is
computed at the corners and interpolated linearly, within SMOOTH. Of air it is the rays and the
light of ground that they touch. Nearer to the limb pixels have a ray each, and tiles at the edges,
which are divided anew, all that is spread to them.

Where a disc is all extended light that a frame has, its levels need no linear image but about
sprites and edges: other tiles are drawn as levels, tiles over white as one level, and tiles under
the first level not at all (`Sure`).
"""

import math
from dataclasses import dataclass
from itertools import product

import numpy as np

from hilstar.basics.arrays import BoolArray, Float32Array, FloatArray, IntArray
from hilstar.optics.extended import DiscLight, Rectangle
from hilstar.sky.bodies.disc import AIR_TOP

TILE_PX, FINE_PX = 32, 8  # tiles, and the parts of those at edges
MIN_TILED_PX = 40_000  # a rectangle of fewer pixels is drawn whole
SMOOTH = 5e-4  # share of the light: a level of 12 bits
# share that the Gaussian changes air's light by more than tile.glsl says: thinner air is drawn ray
# by ray
SPREAD = 1e-3
REACH_SIGMAS = 5.0
# a radius: from here one ray is within 4e-5 of the spread light of a face, as in disc.frag
LARGE_PX = 200.0
# factor on the angle across a tile: allows for a lens, a field's corner and a flattened body
WIDER = 1.5
# Light between the corners of a tile is over and under theirs by less; a limb spreads half of it.
SMOOTH_TIMES, SURE_TIMES = 1.5, 4.0
CORNERS = ((0, 0), (0, 1), (1, 0), (0, 1), (1, 1), (1, 0))  # rows and columns of two triangles
NOTHING = np.empty((0, 6), dtype=np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class Sure:
    """A frame's levels: light of `dark_e_per_s` and less has level 0, and of `white_e_per_s` and
    more white.

    Sprites (n,) whose light lies up to `reach_px` from their pixels `sprites_px` (n, 2) are added
    to the disc's.
    """

    dark_e_per_s: float
    white_e_per_s: float
    sprites_px: IntArray
    reach_px: int

    def levels(self, e_per_s: FloatArray, smooth: BoolArray) -> tuple[BoolArray, BoolArray]:
        """Which tiles of lattices (..., rows, columns) of light are white and which black;
        `smooth` ones have no limb.
        """
        times = np.where(smooth, SMOOTH_TIMES, SURE_TIMES)
        rows, columns = smooth.shape[-2:]
        corners = []
        for row, column in set(CORNERS):
            corners.append(e_per_s[..., row : row + rows, column : column + columns])
        brightest = np.maximum.reduce(corners)
        darkest = np.minimum.reduce(corners)
        return darkest > times * self.white_e_per_s, brightest * times < self.dark_e_per_s

    def apart(self, corner_px: tuple[int, int], shape: tuple[int, ...]) -> BoolArray:
        """Which tiles (rows, columns) from a corner of the image on have no sprite's light."""
        rows, columns = shape
        # one row and column more, for sprites off the tiles
        apart = np.ones((rows + 1, columns + 1), dtype=np.bool_)
        reach = self.reach_px
        # a tile's side is the largest step that passes over no tile
        steps_px = range(-reach, reach + TILE_PX, TILE_PX)
        for across, down in product(steps_px, steps_px):
            away = min(across, reach) - corner_px[0], min(down, reach) - corner_px[1]
            tile = (self.sprites_px + away) // TILE_PX
            column, row = np.clip(tile, -1, (columns, rows)).T
            apart[row, column] = False
        return apart[:-1, :-1]


@dataclass(frozen=True, slots=True)
class Tiles:
    """Tiles in `region`: corners (n, 6) of two triangles each: x and y from the image's edge (px),
    light (e-/s), three values.

    Light on a `face` is its own, with its cover first; that of `air` is what a ray has that is
    stopped, with the ray in the sphere's axes. `inside` and `edges` are drawn ray by ray, and
    `white` is white: their values are not used. `face_levels` and `air_levels` are as `face` and
    `air`, but are drawn as levels alone. `of_air` is the uniform `air` of tile.glsl.
    """

    region: Rectangle
    face: Float32Array
    air: Float32Array
    inside: Float32Array
    edges: Float32Array
    white: Float32Array
    face_levels: Float32Array
    air_levels: Float32Array
    of_air: tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class _Lattice:
    """Corners (..., rows, columns, 6) as in Tiles and their light; masks of the tiles, one less
    along rows and columns.
    """

    face: FloatArray
    air: FloatArray
    e_per_s: FloatArray
    is_face: BoolArray
    is_inside: BoolArray
    is_air: BoolArray
    is_beside: BoolArray
    spread: float


def disc_tiles(light: DiscLight, region: Rectangle, sure: Sure | None = None) -> Tiles | None:
    """The tiles of a disc in a rectangle of its image; None where the rectangle has fewer than
    MIN_TILED_PX pixels.
    """
    first_x, first_y, width, height = region
    if width * height < MIN_TILED_PX:
        return None
    x = first_x + _nodes_px(width)
    y = first_y + _nodes_px(height)
    places = np.stack(np.meshgrid(x, y), axis=-1)
    whole = _lattice(light, places.astype(np.float64), TILE_PX)
    drawn, white, apart = _ways(whole, (first_x, first_y), sure)
    disc = light.disc
    of_air = disc.distance_radii, disc.air_radii, disc.slant_depth, whole.spread
    inner = _inner(region, drawn)
    if inner is None:
        nothing = (NOTHING,) * 7
        return Tiles((first_x, first_y, 0, 0), *nothing, of_air)
    drawn &= ~white
    fine = _fine_lattice(light, whole, drawn)
    fine_white = np.zeros_like(fine.is_face)
    if sure is not None:
        fine_white, _ = sure.levels(fine.e_per_s, fine.is_inside | fine.is_air)
    fine_edges = ~fine.is_inside & ~fine.is_air & ~fine.is_beside & ~fine_white
    fine_inside = fine.is_inside & ~fine_white
    fine_air = fine.is_air & ~fine_white
    face = whole.is_face & drawn
    inside = whole.is_inside & drawn & ~whole.is_face
    air = whole.is_air & drawn
    of_large = {
        "air": _corners(whole.air, air & ~apart),
        "inside": _corners(whole.face, inside),
        "white": _runs(x[1:-1], y[1:-1], white),
    }
    of_fine = {
        "air": _corners(fine.air, fine_air),
        "inside": _corners(fine.face, fine_inside),
        "white": _corners(fine.face, fine_white),
    }
    return Tiles(
        region=inner,
        face=_corners(whole.face, face & ~apart),
        edges=_corners(fine.face, fine_edges),
        face_levels=_corners(whole.face, face & apart),
        air_levels=_corners(whole.air, air & apart),
        of_air=of_air,
        **{kind: np.concatenate([of_large[kind], of_fine[kind]]) for kind in of_large},
    )


def _ways(
    whole: _Lattice, corner_px: tuple[int, int], sure: Sure | None
) -> tuple[BoolArray, BoolArray, BoolArray]:
    """Which tiles (rows, columns) from a corner of the image on are drawn at all, which are white,
    and which have no sprite's light, so that levels alone can be drawn.
    """
    drawn = ~whole.is_beside
    if sure is None:
        no_tile = np.zeros_like(whole.is_face)
        return drawn, no_tile, no_tile
    smooth = whole.is_inside | whole.is_air
    white, dark = sure.levels(whole.e_per_s, smooth)
    apart = sure.apart(corner_px, white.shape)
    # A limb may bulge into a tile between its corners, but not without a corner of a tile beside
    # it.
    is_dark_around = _all(_all(np.pad(dark, 1, constant_values=True)))
    is_black = dark & (smooth | is_dark_around)
    return drawn & ~(apart & is_black), white, apart


def _fine_lattice(light: DiscLight, whole: _Lattice, drawn: BoolArray) -> _Lattice:
    """The lattices of the `drawn` tiles at edges, in parts.

    They are drawn in the linear image, for their sprites and rays are encoded tile by tile.
    """
    steps = np.arange(-FINE_PX, TILE_PX + FINE_PX + 1, FINE_PX)
    parts = np.stack(np.meshgrid(steps, steps), axis=-1)
    is_edge = drawn & ~whole.is_inside & ~whole.is_air
    corners = whole.face[:-1, :-1, :2][is_edge]
    return _lattice(light, corners[:, None, None] + parts, FINE_PX)


def _nodes_px(size_px: int) -> IntArray:
    """Nodes of tiles along an axis from a rectangle's first pixel, with a tile beyond both ends."""
    count = math.ceil(size_px / TILE_PX)
    return TILE_PX * np.arange(-1, count + 2)


def _inner(region: Rectangle, drawn: BoolArray) -> Rectangle | None:
    """The part of a rectangle within which its tiles (rows, columns) are `drawn`; None for none."""
    places = np.argwhere(drawn)
    if not len(places):
        return None
    x, y, width, height = region
    first_y, first_x = (places.min(axis=0) * TILE_PX).tolist()
    end_y, end_x = ((places.max(axis=0) + 1) * TILE_PX).tolist()
    inner_width = min(width, end_x) - first_x
    inner_height = min(height, end_y) - first_y
    return x + first_x, y + first_y, inner_width, inner_height


def _lattice(light: DiscLight, places: FloatArray, size_px: int) -> _Lattice:
    """The light at lattices of places (..., rows, columns, 2), `size_px` apart, and between
    them, but for the outer ones.
    """
    disc = light.disc
    px_per_rad, *_ = light.camera.scales_px_rad()
    shape = places.shape[:-1]
    rays, sr = _rays(light, places.reshape(-1, 2))
    directions = rays @ light.icrs_to_image
    on_sphere = directions @ disc.to_sphere.T
    impact = disc.impact(directions).reshape(shape)
    electrons_per_radiance = sr * light.times
    face = (disc.radiance(directions) * electrons_per_radiance).reshape(shape)
    largest = (disc.normal_e_per_s_sr * electrons_per_radiance).reshape(shape)
    beside = _beside(light, on_sphere.reshape(*shape, 3), size_px)
    within = _Within.of(light, impact)
    is_inside = _all(within.is_far) & ~beside
    is_inside[..., 1:-1, 1:-1] &= _even(face > 0)
    is_face = _all(within.is_smooth(face, largest, size_px)) & is_inside
    is_air = np.zeros_like(is_face)
    touched = np.zeros_like(face)
    hidden = np.zeros_like(face)
    spread = 0.0
    if disc.air is not None and disc.distance_radii > 1:
        touched = (disc.touched_light(directions) * electrons_per_radiance).reshape(shape)
        height = np.maximum(impact - 1, 0.0) / disc.air_radii
        hidden = -np.expm1(-disc.slant_depth * np.exp(-height))
        spread, omitted = _spread_of_air(light, px_per_rad)
        if omitted < SPREAD:
            is_air = _all(impact > 1 + within.margin) & ~beside
            is_air[..., 1:-1, 1:-1] &= _even(touched > 0)
    cover = np.ones((*shape, 3))
    of_face = np.concatenate([places, face[..., None], cover], axis=-1)
    rays_on_sphere = on_sphere.reshape(*shape, 3)
    of_air = np.concatenate([places, touched[..., None], rays_on_sphere], axis=-1)
    e_per_s = np.where(impact < 1, face, touched * hidden)
    inner = (..., slice(1, -1), slice(1, -1))
    return _Lattice(
        face=of_face[*inner, :],
        air=of_air[*inner, :],
        e_per_s=e_per_s[inner],
        is_face=is_face[inner],
        is_inside=is_inside[inner],
        is_air=is_air[inner],
        is_beside=beside[inner],
        spread=spread,
    )


def _reach_px(light: DiscLight) -> float:
    """How far the Gaussian of a disc's PSF reaches."""
    return float(REACH_SIGMAS * max(light.psf.variance_px2) ** 0.5)


def _beside(light: DiscLight, on_sphere: FloatArray, size_px: int) -> BoolArray:
    """Tiles of lattices whose corners are so far from the disc that neither it, its air nor the
    Gaussian reaches them; `on_sphere` (..., rows, columns, 3) are rays to the corners.
    """
    disc = light.disc
    px_per_rad, *_ = light.camera.scales_px_rad()
    x, y, z = np.moveaxis(on_sphere, -1, 0)
    angle_rad = np.arctan2(np.hypot(x, y), z)
    rim_radii = 1 + AIR_TOP * disc.air_radii
    rim_rad = np.arcsin(min(1.0, rim_radii / disc.distance_radii))
    diagonal_px = size_px * np.sqrt(2)
    reach_rad = (diagonal_px + _reach_px(light)) / px_per_rad
    return _all(angle_rad > rim_rad + WIDER * reach_rad)


@dataclass(frozen=True, slots=True)
class _Within:
    """How far corners of tiles are within a disc's limb: their `impact`, radii, at most 1; radii of
    the disc to a pixel there; the Gaussian's reach, radii; and which are so far within that one ray
    does.
    """

    impact: FloatArray
    radii_per_px: FloatArray
    margin: FloatArray
    is_far: BoolArray

    @classmethod
    def of(cls, light: DiscLight, impact: FloatArray) -> "_Within":
        """The corners with an impact parameter each (..., rows, columns), radii."""
        distance = light.disc.distance_radii
        px_per_rad, *_ = light.camera.scales_px_rad()
        inside = np.minimum(impact, 1.0)  # NaN stays
        away_radii = np.sqrt(np.maximum(distance**2 - inside**2, 0.0))
        radii_per_px = away_radii / px_per_rad
        margin = _reach_px(light) * np.minimum(WIDER * radii_per_px, distance / px_per_rad)
        is_far = (impact < 1 - margin) & (radii_per_px * LARGE_PX < 1)
        return cls(inside, radii_per_px, margin, is_far)

    def is_smooth(self, face: FloatArray, largest: FloatArray, size_px: int) -> BoolArray:
        """Where linear light between corners is within SMOOTH, or dark; `face` is the light at the
        corners, `largest` that of a face under the Sun.

        A face's height over the plane of its limb goes as the root of 1 - impact^2, whose second
        derivative is its power -3/2.
        """
        bulge = (size_px * self.radii_per_px) ** 2 / 8 * largest
        is_lit = face > 0
        return np.asarray(SMOOTH * face * (1 - self.impact**2) ** 1.5 >= bulge * is_lit)


def _spread_of_air(light: DiscLight, px_per_rad: float) -> tuple[float, float]:
    """By what share the Gaussian raises air's light by tile.glsl, and what share that omits.

    The one is half of the mean of the Gaussian's variances along x and y in scale heights.
    """
    disc = light.disc
    scale_px = disc.air_radii * px_per_rad
    variance_px2 = np.array(light.psf.variance_px2)
    along_x, along_y = variance_px2 * (disc.distance_radii**2 - 1) / scale_px**2
    omitted = abs(along_x - along_y) / 4 + max(along_x, along_y) ** 2 / 8
    return float(along_x + along_y) / 4, float(omitted)


def _rays(light: DiscLight, places: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Directions (n, 3), image axes, of places (n, 2) in pixels' edges while they are lit, and
    steradians to a pixel there.
    """
    x_px, y_px = places.T - 0.5
    u, v = light.camera.tangents(x_px, y_px)
    rays = np.stack([u, v, np.ones_like(u)], axis=1)
    if light.shear is not None:
        late_s = light.shear.late_s(x_px, y_px)
        rays += late_s[:, None] * np.cross(light.shear.rate_image_rad_s, rays)
    a, b, c, d = light.camera.slopes(u, v)
    px_per_tangents = a * d - b * c
    distance = np.linalg.norm(rays, axis=1)
    return rays, 1 / (px_per_tangents * distance**3)


def _all(nodes: BoolArray) -> BoolArray:
    """Which tiles of lattices (..., rows, columns) are true at all four corners."""
    return nodes[..., :-1, :-1] & nodes[..., 1:, :-1] & nodes[..., :-1, 1:] & nodes[..., 1:, 1:]


def _even(nodes: BoolArray) -> BoolArray:
    """Which tiles but the outer ones are alike, true or not, at all corners and those of the
    tiles beside them.
    """
    is_lit = _all(_all(_all(nodes)))
    is_dark = _all(_all(_all(~nodes)))
    return np.asarray(is_lit | is_dark)


def _corners(nodes: FloatArray, tiles: BoolArray) -> Float32Array:
    """The corners (n, 6) of two triangles for each of `tiles`, from lattices (..., rows,
    columns, 6).
    """
    if not tiles.any():
        return NOTHING
    rows = nodes.shape[-3] - 1
    columns = nodes.shape[-2] - 1
    parts = []
    for row, column in CORNERS:
        corners = nodes[..., row : row + rows, column : column + columns, :]
        parts.append(corners[tiles])
    return np.stack(parts, axis=-2).reshape(-1, 6).astype(np.float32)


def _runs(x: IntArray, y: IntArray, tiles: BoolArray) -> Float32Array:
    """The corners of tiles (rows, columns) between `x` and `y`, as one that follow each other in
    a row, or equal rows.
    """
    is_begin = np.diff(tiles, axis=1, prepend=False) & tiles
    is_end = np.diff(tiles, axis=1, append=False) & tiles
    row, begin = np.nonzero(is_begin)
    end = np.nonzero(is_end)[1] + 1
    order = np.lexsort((row, end, begin))
    row = row[order]
    begin = begin[order]
    end = end[order]
    goes_on = (np.diff(begin) == 0) & (np.diff(end) == 0) & (np.diff(row) == 1)
    first = np.append(True, ~goes_on)[: len(row)]
    last = np.append(~goes_on, True)[: len(row)]
    rows_px = y[row[first]], y[row[last] + 1]
    columns_px = x[begin[first]], x[end[first]]
    unused = [np.zeros(first.sum())] * 4
    places = []
    for j, k in CORNERS:
        places.append(np.stack([columns_px[k], rows_px[j], *unused], axis=-1))
    return np.stack(places, axis=-2).reshape(-1, 6).astype(np.float32)
