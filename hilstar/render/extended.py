"""Extended light, drawn into the linear image before the sprites: maps, glows and discs, each in its rectangle, in order.

A large disc is divided into tiles. Far from limb and terminator a Lambert or lunar face changes little over a tile: its light
is computed at the corners and interpolated linearly, within SMOOTH. Of air it is the rays and the light of ground that they
touch. Nearer to the limb pixels have a ray each, and tiles at the edges, which are divided anew, all that is spread to them.

Where a disc is all extended light that a frame has, its levels need no linear image but about sprites and edges: other tiles
are drawn as levels, tiles over white as one level, and tiles under the first level not at all (`Sure`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import moderngl
import numpy as np
import numpy.typing as npt

from hilstar.arrays import Float32Array, FloatArray, IntArray
from hilstar.render.encoder import build_program, draw_tiles
from hilstar.scene.camera import Camera, ray_shifts
from hilstar.scene.extended import DiscLight, ExtendedLight, GlowLight, LightMap, Rectangle
from hilstar.sky.bodies.disc import AIR_TOP, SOLAR_LIMB, gauss_legendre

TILE_PX, FINE_PX = 32, 8  # of tiles, and of the parts of those at edges
MIN_TILED_PX = 40_000  # a rectangle of fewer pixels is drawn whole
SMOOTH = 5e-4  # share of the light: a level of 12 bits
SPREAD = 1e-3  # share that the Gaussian changes air's light by more than tile.glsl says: thinner air is drawn ray by ray
REACH_SIGMAS = 5.0
LARGE_PX = 200.0  # of a radius: from here one ray is within 4e-5 of the spread light of a face, as in disc.frag
WIDER = 1.5  # factor on the angle across a tile: allows for a lens, a field's corner and a flattened body
# Light between the corners of a tile is over and under theirs by less; a limb spreads half of it.
SMOOTH_TIMES, SURE_TIMES = 1.5, 4.0
CORNERS = ((0, 0), (0, 1), (1, 0), (0, 1), (1, 1), (1, 0))  # rows and columns of two triangles

Mask = npt.NDArray[np.bool_]
KEPT_TEXTURES = 6  # lasting maps and lenses: a bench has one lens, and few maps at a time
LAWS = ("uniform", "lambert", "lunar-lambert", "limb-darkened")  # by their numbers in disc.frag
NODES = 16  # as in disc.frag


@dataclass(frozen=True, slots=True, eq=False)
class Sure:
    """A frame's levels: light of `dark_e_per_s` and less has level 0, and of `white_e_per_s` and more white.

    Sprites (n,) whose light lies up to `reach_px` from their pixels `sprites_px` (n, 2) are added to the disc's.
    """

    dark_e_per_s: float
    white_e_per_s: float
    sprites_px: IntArray
    reach_px: int

    def levels(self, e_per_s: FloatArray, smooth: Mask) -> tuple[Mask, Mask]:
        """Which tiles of lattices (..., rows, columns) of light are white and which black; `smooth` ones have no limb."""
        times = np.where(smooth, SMOOTH_TIMES, SURE_TIMES)
        rows, columns = smooth.shape[-2:]
        corners = [e_per_s[..., row : row + rows, column : column + columns] for row, column in set(CORNERS)]
        brightest, darkest = np.maximum.reduce(corners), np.minimum.reduce(corners)
        return darkest > times * self.white_e_per_s, brightest * times < self.dark_e_per_s

    def apart(self, left: int, top: int, rows: int, columns: int) -> Mask:
        """Which tiles (rows, columns) from a corner of the image on have no sprite's light."""
        apart, reach = np.ones((rows + 1, columns + 1), dtype=np.bool_), self.reach_px
        for across in range(-reach, reach + TILE_PX, TILE_PX):
            for down in range(-reach, reach + TILE_PX, TILE_PX):
                away = min(across, reach) - left, min(down, reach) - top
                column, row = np.clip((self.sprites_px + away) // TILE_PX, -1, (columns, rows)).T
                apart[row, column] = False  # those off the tiles in a row or column that is not used
        return apart[:-1, :-1]


@dataclass(frozen=True, slots=True)
class Tiles:
    """Tiles in `region`: corners (n, 6) of two triangles each: x and y from the image's edge (px), light (e-/s), three values.

    Light on a `face` is its own, with its cover first; that of `air` is what a ray has that is stopped, with the ray in the
    sphere's axes. `inside` and `edges` are drawn ray by ray, and `white` is white: their values are not used. `face_levels` and
    `air_levels` are as `face` and `air`, but are drawn as levels alone. `of_air` is the uniform `air` of tile.glsl.
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
    """Corners (..., rows, columns, 6) as in Tiles and their light; masks of the tiles, one less along rows and columns."""

    face: FloatArray
    air: FloatArray
    e_per_s: FloatArray
    is_face: Mask
    is_inside: Mask
    is_air: Mask
    is_beside: Mask
    spread: float


def disc_tiles(light: DiscLight, region: Rectangle, sure: Sure | None = None) -> Tiles | None:
    """The tiles of a disc in a rectangle of its image; None where the rectangle has fewer than MIN_TILED_PX pixels."""
    left, top, width, height = region
    if width * height < MIN_TILED_PX:
        return None
    x, y = (begin + TILE_PX * np.arange(-1, -(-size // TILE_PX) + 2) for begin, size in ((left, width), (top, height)))
    whole = _lattice(light, np.stack(np.meshgrid(x, y), axis=-1).astype(np.float64), TILE_PX)
    drawn, white = ~whole.is_beside, np.zeros_like(whole.is_face)
    apart = white
    if sure is not None:
        smooth = whole.is_inside | whole.is_air
        white, dark = sure.levels(whole.e_per_s, smooth)
        apart = sure.apart(left, top, *white.shape)
        # A limb may bulge into a tile between its corners, but not without a corner of a tile beside it.
        around = _all(_all(np.pad(dark, 1, constant_values=True)))
        drawn &= ~(apart & dark & (smooth | around))
    some, of_air = np.argwhere(drawn), (light.disc.distance_radii, light.disc.air_radii, light.disc.slant_depth, whole.spread)
    nothing = np.empty((0, 6), dtype=np.float32)
    if not len(some):
        return Tiles((left, top, 0, 0), nothing, nothing, nothing, nothing, nothing, nothing, nothing, of_air)
    (first_y, first_x), (last_y, last_x) = some.min(axis=0) * TILE_PX, (some.max(axis=0) + 1) * TILE_PX
    inner = left + first_x, top + first_y, min(width, last_x) - first_x, min(height, last_y) - first_y
    drawn &= ~white
    # Tiles at the edges in parts: in the linear image, for their sprites and rays are encoded tile by tile.
    steps = np.arange(-FINE_PX, TILE_PX + FINE_PX + 1, FINE_PX)
    edges = whole.face[:-1, :-1, :2][drawn & ~whole.is_inside & ~whole.is_air]
    fine = _lattice(light, edges[:, None, None] + np.stack(np.meshgrid(steps, steps), axis=-1), FINE_PX)
    fine_white = np.zeros_like(fine.is_face) if sure is None else sure.levels(fine.e_per_s, fine.is_inside | fine.is_air)[0]
    fine_inside, fine_air = fine.is_inside & ~fine_white, fine.is_air & ~fine_white
    face, inside, air = whole.is_face & drawn, whole.is_inside & drawn & ~whole.is_face, whole.is_air & drawn
    return Tiles(
        (int(inner[0]), int(inner[1]), int(inner[2]), int(inner[3])),
        _corners(whole.face, face & ~apart),
        np.concatenate([_corners(whole.air, air & ~apart), _corners(fine.air, fine_air)]),
        np.concatenate([_corners(whole.face, inside), _corners(fine.face, fine_inside)]),
        _corners(fine.face, ~fine.is_inside & ~fine.is_air & ~fine.is_beside & ~fine_white),
        np.concatenate([_runs(x[1:-1], y[1:-1], white), _corners(fine.face, fine_white)]),
        _corners(whole.face, face & apart),
        _corners(whole.air, air & apart),
        of_air,
    )


def _lattice(light: DiscLight, places: FloatArray, size_px: int) -> _Lattice:
    """The light at lattices of places (..., rows, columns, 2), `size_px` apart, and between them, but for the outer ones."""
    disc, px_per_rad, sigma_px = light.disc, light.camera.scales_px_rad()[0], max(light.psf.variance_px2) ** 0.5
    shape, distance = places.shape[:-1], disc.distance_radii
    seen, sr = _rays(light, places.reshape(-1, 2))
    directions = seen @ light.icrs_to_image
    on_sphere = directions @ disc.to_sphere.T
    impact = disc.impact(directions).reshape(shape)
    face = (disc.radiance(directions) * sr * light.times).reshape(shape)
    # Corners so far away that neither the disc, its air nor the Gaussian reaches their tiles
    angle = np.arctan2(np.hypot(on_sphere[:, 0], on_sphere[:, 1]), on_sphere[:, 2]).reshape(shape)
    rim = np.arcsin(min(1.0, (1 + AIR_TOP * disc.air_radii) / distance))
    beside = _all(angle > rim + WIDER * (size_px * np.sqrt(2) + REACH_SIGMAS * sigma_px) / px_per_rad)
    # Tiles far enough within the limb, and off the terminator where that would be seen. A face's height over the plane of its
    # limb goes as the root of 1 - impact^2, whose second derivative is its power -3/2.
    inside, lit = np.minimum(impact, 1.0), face > 0  # NaN stays
    radii_per_px = np.sqrt(np.maximum(distance**2 - inside**2, 0.0)) / px_per_rad
    margin = REACH_SIGMAS * sigma_px * np.minimum(WIDER * radii_per_px, distance / px_per_rad)  # the Gaussian's reach, radii
    most = (size_px * radii_per_px) ** 2 / 8 * (disc.normal_e_per_s_sr * light.times * sr).reshape(shape)
    is_inside = _all((impact < 1 - margin) & (radii_per_px * LARGE_PX < 1)) & ~beside
    is_inside[..., 1:-1, 1:-1] &= _even(lit)
    is_face = _all(SMOOTH * face * (1 - inside**2) ** 1.5 >= most * lit) & is_inside
    is_air, touched, hidden, spread = np.zeros_like(is_face), np.zeros_like(face), np.zeros_like(face), 0.0
    if disc.air is not None and distance > 1:
        touched = (disc.touched_light(directions) * sr * light.times).reshape(shape)
        hidden = -np.expm1(-disc.slant_depth * np.exp(-np.maximum(impact - 1, 0.0) / disc.air_radii))
        # The variances of the Gaussian in scale heights: half of their mean by tile.glsl, and what it leaves out.
        along_x, along_y = np.array(light.psf.variance_px2) * (distance**2 - 1) / (disc.air_radii * px_per_rad) ** 2
        spread = (along_x + along_y) / 4
        if abs(along_x - along_y) / 4 + max(along_x, along_y) ** 2 / 8 < SPREAD:
            is_air = _all(impact > 1 + margin) & ~beside
            is_air[..., 1:-1, 1:-1] &= _even(touched > 0)
    of_face = np.concatenate([places, face[..., None], np.ones((*shape, 3))], axis=-1)
    of_air = np.concatenate([places, touched[..., None], on_sphere.reshape(*shape, 3)], axis=-1)
    e_per_s, inner = np.where(impact < 1, face, touched * hidden), (..., slice(1, -1), slice(1, -1))
    masks = is_face[inner], is_inside[inner], is_air[inner], beside[inner]
    return _Lattice(of_face[*inner, :], of_air[*inner, :], e_per_s[inner], *masks, spread)


def _rays(light: DiscLight, places: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Directions (n, 3), image axes, of places (n, 2) in pixels' edges while they are lit, and steradians to a pixel there."""
    x_px, y_px = places.T - 0.5
    u, v = light.camera.tangents(x_px, y_px)
    seen = np.stack([u, v, np.ones_like(u)], axis=1)
    if light.shear is not None:
        seen += light.shear.late_s(x_px, y_px)[:, None] * np.cross(light.shear.rate_image_rad_s, seen)
    a, b, c, d = light.camera.slopes(u, v)
    return seen, 1 / ((a * d - b * c) * np.linalg.norm(seen, axis=1) ** 3)


def _all(nodes: Mask) -> Mask:
    """Which tiles of lattices (..., rows, columns) are true at all four corners."""
    return nodes[..., :-1, :-1] & nodes[..., 1:, :-1] & nodes[..., :-1, 1:] & nodes[..., 1:, 1:]


def _even(nodes: Mask) -> Mask:
    """Which tiles but the outer ones are alike, true or not, at all corners and those of the tiles beside them."""
    return np.logical_or(*(_all(_all(_all(alike))) for alike in (nodes, ~nodes)))


def _corners(nodes: FloatArray, tiles: Mask) -> Float32Array:
    """The corners (n, 6) of two triangles for each of `tiles`, from lattices (..., rows, columns, 6)."""
    if not tiles.any():
        return np.empty((0, 6), dtype=np.float32)
    size = nodes.shape[-3] - 1, nodes.shape[-2] - 1
    parts = [nodes[..., row : row + size[0], column : column + size[1], :][tiles] for row, column in CORNERS]
    return np.stack(parts, axis=-2).reshape(-1, 6).astype(np.float32)


def _runs(x: IntArray, y: IntArray, tiles: Mask) -> Float32Array:
    """The corners of tiles (rows, columns) between `x` and `y`, as one that follow each other in a row, or equal rows."""
    row, begin = np.nonzero(np.diff(tiles, axis=1, prepend=False) & tiles)
    end = np.nonzero(np.diff(tiles, axis=1, append=False) & tiles)[1] + 1
    order = np.lexsort((row, end, begin))
    row, begin, end = row[order], begin[order], end[order]
    goes_on = (np.diff(begin) == 0) & (np.diff(end) == 0) & (np.diff(row) == 1)
    first, last = np.append(True, ~goes_on)[: len(row)], np.append(~goes_on, True)[: len(row)]
    sides = (y[row[first]], y[row[last] + 1]), (x[begin[first]], x[end[first]])
    places = [np.stack([sides[1][k], sides[0][j], *[np.zeros(first.sum())] * 4], axis=-1) for j, k in CORNERS]
    return np.stack(places, axis=-2).reshape(-1, 6).astype(np.float32)


class ExtendedLayer:
    """Draws extended light of one image; it lives in its renderer's context, which is current in every call.

    Programs and textures are made when they are first needed: a bench without such light has none.
    """

    def __init__(self, ctx: moderngl.Context, resolution_px: tuple[int, int]) -> None:
        self._ctx = ctx
        self._resolution_px = resolution_px
        self._programs: dict[tuple[str, ...], tuple[moderngl.Program, moderngl.VertexArray]] = {}
        self._textures: dict[int, tuple[object, moderngl.Texture]] = {}

    def draw(
        self, fbo: moderngl.Framebuffer, lights: Sequence[ExtendedLight], sure: Sure | None = None
    ) -> tuple[tuple[Rectangle, ...], Tiles | None]:
        """Add `lights` to a linear image, in their order; the rectangles that they may have changed.

        Where a frame is `sure` of its levels and a disc alone is on the image, what its `Tiles` have as levels is left out.
        """
        ctx, regions, found = self._ctx, [], None
        on_image = [(light, region) for light in lights if (region := light.region(self._resolution_px)) is not None]
        sure = sure if len(on_image) == 1 else None
        fbo.use()
        ctx.enable(moderngl.BLEND)
        # Alpha is the share of a pixel that the light's body covers: what was drawn before it is behind it.
        ctx.blend_func = (moderngl.ONE, moderngl.ONE_MINUS_SRC_ALPHA)
        for light, region in on_image:
            tiles = disc_tiles(light, region, sure) if isinstance(light, DiscLight) else None
            if isinstance(light, DiscLight) and tiles is not None:
                region = tiles.region
                if not region[2]:
                    continue
                fbo.viewport, fbo.scissor = (0, 0, *self._resolution_px), region
                self._draw_tiles(light, tiles)
                fbo.scissor = None  # type: ignore[assignment]  # as its documentation has it: no test
                found = tiles if sure is not None else None
            else:
                fbo.viewport = region
                self._draw_one(light)
            regions.append(region)
        ctx.blend_func = (moderngl.ONE, moderngl.ONE)
        ctx.disable(moderngl.BLEND)
        return tuple(regions), found

    def _draw_one(self, light: ExtendedLight) -> None:
        if isinstance(light, LightMap):
            self._draw_map(light)
            return
        if isinstance(light, GlowLight):
            program, triangle = self._with_rays("glow.frag", light.camera)
            program["direction"] = tuple(light.direction_image.tolist())
            program["peak_e_per_s"] = light.peak_e_per_s
            program["scale_rad"] = light.scale_rad
            program["exponent"] = light.exponent
        else:
            program, triangle = self._with_rays("disc.frag", light.camera)
            _set_disc(program, light)
        triangle.render(moderngl.TRIANGLES, vertices=3)

    def _draw_map(self, light: LightMap) -> None:
        program, triangle = self._program("light_map.frag", (), *(() if light.cover is None else ("COVER",)))
        own = []
        for unit, image in enumerate((light.image, light.cover)):
            if image is not None:
                texture = self._texture(image, image, 1) if light.lasting else self._upload(image, 1)
                texture.use(unit)
                own += [] if light.lasting else [texture]
        if light.cover is not None:
            program["cover"] = 1
        program["corner_px"] = light.corner_px
        program["times"] = light.times
        triangle.render(moderngl.TRIANGLES, vertices=3)
        for texture in own:
            texture.release()

    def _draw_tiles(self, light: DiscLight, tiles: Tiles) -> None:
        for corners, defines in ((tiles.face, ()), (tiles.air, ("AIR",))):
            if len(corners):
                program, _ = self._program("tile.frag", ("tile.glsl",), *defines, vertex="tile.vert")
                program["covers"] = float(light.covers)
                draw_tiles(program, corners, self._resolution_px, tiles.of_air)
        for corners, defines in ((tiles.inside, ("INSIDE",)), (tiles.edges, ())):
            if len(corners):
                program, _ = self._with_rays("disc.frag", light.camera, *defines, vertex="tile.vert")
                _set_disc(program, light)
                draw_tiles(program, corners, self._resolution_px)

    def _with_rays(
        self, fragment: str, camera: Camera, *defines: str, vertex: str = "full.vert"
    ) -> tuple[moderngl.Program, moderngl.VertexArray]:
        """A program whose pixels know their directions through `camera`, whose image this is."""
        defines = (*defines, *["LENS"] * (camera.lens is not None))
        program, triangle = self._program(fragment, ("rays.glsl",), *defines, vertex=vertex)
        program["principal_px"] = camera.principal_point_px
        program["focal_px"] = camera.focal_length_px
        if camera.lens is not None:
            shifts = self._texture(camera, None, 2)
            program["nodes_per_px"] = tuple((n - 1) / size for n, size in zip(shifts.size, self._resolution_px, strict=True))
            shifts.use(0)
        return program, triangle

    def _program(
        self, fragment: str, include: tuple[str, ...] = (), *defines: str, vertex: str = "full.vert"
    ) -> tuple[moderngl.Program, moderngl.VertexArray]:
        """A program, and the triangle of `full.vert`; nothing is drawn by that with another vertex shader."""
        key = (vertex, fragment, *include, *defines)
        if key not in self._programs:
            program = build_program(self._ctx, vertex, fragment, defines, include)
            self._programs[key] = program, self._ctx.vertex_array(program, [])
        return self._programs[key]

    def _texture(self, owner: object, image: Any, components: int) -> moderngl.Texture:
        """The float32 texture of an array, or of a camera's ray shifts; kept while its owner is used."""
        kept = self._textures.pop(id(owner), None)
        if kept is None:
            if len(self._textures) >= KEPT_TEXTURES:
                self._textures.pop(next(iter(self._textures)))[1].release()
            kept = owner, self._upload(ray_shifts(owner) if isinstance(owner, Camera) else image, components)
        self._textures[id(owner)] = kept  # the last used is the last to go
        return kept[1]

    def forget(self) -> None:
        """Upload what is kept on the GPU again when it is next drawn."""
        for _, texture in self._textures.values():
            texture.release()
        self._textures.clear()

    def _upload(self, image: Any, components: int) -> moderngl.Texture:
        values = np.ascontiguousarray(image, dtype=np.float32)
        texture = self._ctx.texture(values.shape[1::-1], components, values, dtype="f4")
        texture.filter = (moderngl.NEAREST, moderngl.NEAREST)
        return texture


def _set_disc(program: moderngl.Program, light: DiscLight) -> None:
    """The body, its face, the turn and the Gaussian, in a program of disc.frag."""
    disc, shear = light.disc, light.shear
    from_image, (place, weight) = disc.to_sphere @ light.icrs_to_image.T, gauss_legendre(NODES)
    values: dict[str, Any] = {
        "to_sphere": tuple(from_image.T.ravel().tolist()),  # column by column
        "variance_px": light.psf.variance_px2,
        "times": light.times,
        "covers": float(light.covers),
        "turn_rad_s": (0.0, 0.0, 0.0) if shear is None else tuple(shear.rate_image_rad_s.tolist()),
        "late_s_per_px": (0.0, 0.0) if shear is None else shear.s_per_px,
        "middle_px": (0.0, 0.0) if shear is None else shear.middle_px,
        "node": ((place + 1) / 2).tolist(),
        "weight": (weight / 2).tolist(),
        "distance_radii": disc.distance_radii,
        "sun": tuple(disc.sun_sphere.tolist()),
        "normal_e_per_s_sr": disc.normal_e_per_s_sr,
        "law": LAWS.index(disc.law),
        "lunar_share": disc.lunar_share,
        "solar_limb": SOLAR_LIMB,
        "air_radii": disc.air_radii,
        "slant_depth": disc.slant_depth,
        "air_top": AIR_TOP,
    }
    for name, value in values.items():
        if name in program:  # a smooth face needs few
            program[name] = value
