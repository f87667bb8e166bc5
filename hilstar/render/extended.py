"""Extended light, drawn into the linear image before the sprites: maps, glows and discs, each in its rectangle, in their order.

A large disc is divided into tiles. Far from limb and terminator a Lambert or lunar face changes little over a tile, as does
air over a part of its scale height: light is computed at the corners and interpolated linearly, within SMOOTH of the radiance
under a zenith Sun, and within AIR_SMOOTH for air. Tiles at the edges are drawn ray by ray, and tiles without light not at all.
On llvmpipe this draws a disc that fills the field several times faster.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import moderngl
import numpy as np
import numpy.typing as npt

from hilstar.arrays import Float32Array, FloatArray
from hilstar.render.encoder import build_program
from hilstar.scene.camera import Camera, ray_shifts
from hilstar.scene.extended import DiscLight, ExtendedLight, GlowLight, LightMap, Rectangle
from hilstar.sky.bodies.disc import AIR_TOP, SOLAR_LIMB, gauss_legendre

TILE_PX = 24
MIN_TILED_PX = 40_000  # a rectangle of fewer pixels is drawn whole
SMOOTH = 5e-4  # share of the radiance under a zenith Sun
STEEP = 4 * SMOOTH  # tile width in radii: over a wider tile the terminator bends light by more than SMOOTH
# Scale heights per interpolated part. The second derivative of air's light, 1 - exp(-depth exp(-height)), is at most 0.2 of its
# maximum per squared scale height.
AIR_STEP = 0.4
AIR_SMOOTH = AIR_STEP**2 / 8 * 0.2
MAX_PARTS = 6  # per side of a tile: thinner air is drawn ray by ray
REACH_SIGMAS = 5.0
WIDER = 1.5  # factor on the angle across a tile: allows for a lens, a field's corner and a flattened body
CORNERS = ((0, 0), (0, 1), (1, 0), (0, 1), (1, 1), (1, 0))  # rows and columns of two triangles

Mask = npt.NDArray[np.bool_]
KEPT_TEXTURES = 6  # lasting maps and lenses: a bench has one lens, and few maps at a time
LAWS = ("uniform", "lambert", "lunar-lambert", "limb-darkened")  # by their numbers in disc.frag
NODES = 16  # as in disc.frag


@dataclass(frozen=True, slots=True)
class Tiles:
    """Tiles in `region`: corners (n, 4) of two triangles each, as x and y from the image's edge (px), light (e-/s) and cover.

    Tiles of `linear` are interpolated. Those of `edges` are drawn ray by ray, and their light and cover are not used.
    """

    region: Rectangle
    linear: Float32Array
    edges: Float32Array


def disc_tiles(light: DiscLight, region: Rectangle) -> Tiles | None:
    """The tiles of a disc in a rectangle of its image; None where the rectangle has fewer than MIN_TILED_PX pixels."""
    left, top, width, height = region
    if width * height < MIN_TILED_PX:
        return None
    x, y = (begin + TILE_PX * np.arange(-(-size // TILE_PX) + 1) for begin, size in ((left, width), (top, height)))
    places = np.stack(np.meshgrid(x, y), axis=-1).astype(np.float64)
    seen, sr = _rays(light, places.reshape(-1, 2))
    directions, shape = seen @ light.icrs_to_image, places.shape[:2]
    impact = light.disc.impact(directions).reshape(shape)
    rates = (light.disc.radiance(directions) * sr * light.times).reshape(shape)
    disc, px_per_rad, sigma_px = light.disc, light.camera.scales_px_rad()[0], max(light.psf.variance_px2) ** 0.5
    # Corners so far away that neither the disc, its air nor the Gaussian reaches their tiles
    on_sphere = directions @ disc.to_sphere.T
    angle = np.arctan2(np.hypot(on_sphere[:, 0], on_sphere[:, 1]), on_sphere[:, 2])
    rim = np.arcsin(min(1.0, (1 + AIR_TOP * disc.air_radii) / disc.distance_radii))
    far = angle > rim + WIDER * (TILE_PX * np.sqrt(2) + REACH_SIGMAS * sigma_px) / px_per_rad
    beside = _all(far.reshape(shape))
    margin = REACH_SIGMAS * sigma_px * disc.distance_radii / px_per_rad  # maximum reach of the Gaussian, in radii
    # Tiles far enough within the limb, and off the terminator where that would be seen. A face's height over the plane of its
    # limb goes as the root of 1 - impact^2, whose second derivative is its power -3/2.
    inside, lit = np.minimum(impact, 1.0), rates > 0  # NaN stays
    tile_radii = TILE_PX * np.sqrt(np.maximum(disc.distance_radii**2 - inside**2, 0.0)) / px_per_rad
    flat = ((1 - inside**2) ** 1.5 > tile_radii**2 / (8 * SMOOTH)) & (impact < 1 - margin)
    face = _all(flat) & (_all(lit) | _all(~lit) | _all(tile_radii < STEEP)) & ~beside
    # Parts per side of a tile of air: thinner air, and that of a body from within, is drawn ray by ray. A height at the limb,
    # px: impact grows by the cosine of the angle from the middle there.
    parts = 0
    if disc.air is not None and disc.distance_radii > 1:
        scale_px = disc.air_radii * px_per_rad / np.sqrt(disc.distance_radii**2 - 1)
        parts = int(np.ceil(TILE_PX / (AIR_STEP * scale_px)))
    air = _all(impact > 1 + margin) & ~beside if 0 < parts <= MAX_PARTS else np.zeros_like(face)
    drawn = np.argwhere(~beside)
    if not len(drawn):
        return Tiles((left, top, 0, 0), *np.empty((2, 0, 4), dtype=np.float32))
    (first_y, first_x), (last_y, last_x) = drawn.min(axis=0) * TILE_PX, (drawn.max(axis=0) + 1) * TILE_PX
    inner = left + first_x, top + first_y, min(width, last_x) - first_x, min(height, last_y) - first_y
    of_face = np.concatenate([places, rates[..., None], np.ones((*shape, 1))], axis=-1)
    return Tiles(
        (int(inner[0]), int(inner[1]), int(inner[2]), int(inner[3])),
        np.concatenate([_corners(of_face, face), _air(light, places[:-1, :-1][air], parts)]),
        _corners(of_face, ~face & ~air & ~beside),
    )


def _rays(light: DiscLight, places: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Directions (n, 3), image axes, of places (n, 2) in pixels' edges while they are lit, and steradians to a pixel there."""
    x_px, y_px = places.T - 0.5
    u, v = light.camera.tangents(x_px, y_px)
    seen = np.stack([u, v, np.ones_like(u)], axis=1)
    if light.shear is not None:
        seen += light.shear.late_s(x_px, y_px)[:, None] * np.cross(light.shear.rate_image_rad_s, seen)
    a, b, c, d = light.camera.slopes(u, v)
    return seen, 1 / ((a * d - b * c) * np.linalg.norm(seen, axis=1) ** 3)


def _air(light: DiscLight, tiles: FloatArray, parts: int) -> Float32Array:
    """Corners of the parts of tiles of air, whose first corners are (n, 2)."""
    if not len(tiles):
        return np.empty((0, 4), dtype=np.float32)
    steps = TILE_PX / parts * np.arange(parts + 1)
    places = tiles[:, None, None, :] + np.stack(np.meshgrid(steps, steps), axis=-1)
    seen, sr = _rays(light, places.reshape(-1, 2))
    radiance, cover = light.disc.air_light(seen @ light.icrs_to_image)
    corners = np.concatenate([places.reshape(-1, 2), (radiance * sr * light.times)[:, None], cover[:, None]], axis=1)
    return _corners(corners.reshape(*places.shape[:3], 4))


def _all(nodes: Mask) -> Mask:
    """Which tiles are true at all four corners."""
    return nodes[:-1, :-1] & nodes[1:, :-1] & nodes[:-1, 1:] & nodes[1:, 1:]


def _corners(nodes: FloatArray, tiles: Mask | None = None) -> Float32Array:
    """The corners (n, 4) of two triangles a tile, from lattices (..., rows, columns, 4); `tiles` selects (None: all)."""
    size = nodes.shape[-3] - 1, nodes.shape[-2] - 1
    parts = [nodes[..., row : row + size[0], column : column + size[1], :] for row, column in CORNERS]
    found = np.stack(parts, axis=-2)
    return (found if tiles is None else found[tiles]).reshape(-1, 4).astype(np.float32)


class ExtendedLayer:
    """Draws extended light of one image; it lives in its renderer's context, which is current in every call.

    Programs and textures are made when they are first needed: a bench without such light has none.
    """

    def __init__(self, ctx: moderngl.Context, resolution_px: tuple[int, int]) -> None:
        self._ctx = ctx
        self._resolution_px = resolution_px
        self._programs: dict[tuple[str, ...], tuple[moderngl.Program, moderngl.VertexArray]] = {}
        self._textures: dict[int, tuple[object, moderngl.Texture]] = {}

    def draw(self, fbo: moderngl.Framebuffer, lights: Sequence[ExtendedLight]) -> tuple[Rectangle, ...]:
        """Add `lights` to a linear image, in their order; the rectangles that they may have changed."""
        ctx, regions = self._ctx, []
        fbo.use()
        ctx.enable(moderngl.BLEND)
        # Alpha is the share of a pixel that the light's body covers: what was drawn before it is behind it.
        ctx.blend_func = (moderngl.ONE, moderngl.ONE_MINUS_SRC_ALPHA)
        for light in lights:
            region = light.region(self._resolution_px)
            if region is None:
                continue
            tiles = disc_tiles(light, region) if isinstance(light, DiscLight) else None
            if isinstance(light, DiscLight) and tiles is not None:
                region = tiles.region
                if not region[2]:
                    continue
                fbo.viewport, fbo.scissor = (0, 0, *self._resolution_px), region
                self._draw_tiles(light, tiles)
                fbo.scissor = None  # type: ignore[assignment]  # as its documentation has it: no test
            else:
                fbo.viewport = region
                self._draw_one(light)
            regions.append(region)
        ctx.blend_func = (moderngl.ONE, moderngl.ONE)
        ctx.disable(moderngl.BLEND)
        return tuple(regions)

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
        program, _ = self._program("tile.frag", vertex="tile.vert")
        program["covers"] = float(light.covers)
        self._draw_corners(program, tiles.linear)
        program, _ = self._with_rays("disc.frag", light.camera, "tile.vert")
        _set_disc(program, light)
        self._draw_corners(program, tiles.edges)

    def _draw_corners(self, program: moderngl.Program, corners: Float32Array) -> None:
        if not len(corners):
            return
        program["size_px"] = self._resolution_px
        buffer = self._ctx.buffer(corners)
        layout = "2f 2f" if "given" in program else "2f 8x"
        names = ("place_px", "given") if "given" in program else ("place_px",)
        triangles = self._ctx.vertex_array(program, [(buffer, layout, *names)])
        triangles.render(moderngl.TRIANGLES)
        triangles.release()
        buffer.release()

    def _with_rays(
        self, fragment: str, camera: Camera, vertex: str = "full.vert"
    ) -> tuple[moderngl.Program, moderngl.VertexArray]:
        """A program whose pixels know their directions through `camera`, whose image this is."""
        defines = () if camera.lens is None else ("LENS",)
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
    from_image = disc.to_sphere @ light.icrs_to_image.T
    program["to_sphere"] = tuple(from_image.T.ravel().tolist())  # column by column
    program["variance_px"] = light.psf.variance_px2
    program["times"] = light.times
    program["covers"] = float(light.covers)
    program["turn_rad_s"] = (0.0, 0.0, 0.0) if shear is None else tuple(shear.rate_image_rad_s.tolist())
    program["late_s_per_px"] = (0.0, 0.0) if shear is None else shear.s_per_px
    program["middle_px"] = (0.0, 0.0) if shear is None else shear.middle_px
    place, weight = gauss_legendre(NODES)
    program["node"] = ((place + 1) / 2).tolist()
    program["weight"] = (weight / 2).tolist()
    program["distance_radii"] = disc.distance_radii
    program["sun"] = tuple(disc.sun_sphere.tolist())
    program["normal_e_per_s_sr"] = disc.normal_e_per_s_sr
    program["law"] = LAWS.index(disc.law)
    program["lunar_share"] = disc.lunar_share
    program["solar_limb"] = SOLAR_LIMB
    program["air_radii"] = disc.air_radii
    program["slant_depth"] = disc.slant_depth
    program["air_top"] = AIR_TOP
