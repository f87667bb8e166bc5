"""Extended light, drawn into the linear image before the sprites: maps, glows and discs, each in
its rectangle, in order.
"""

from collections.abc import Sequence
from typing import Any

import moderngl
import numpy as np

from hilstar.display.render.disc_tiles import Sure, Tiles, disc_tiles
from hilstar.display.render.encoder import build_program, draw_tiles, set_uniforms
from hilstar.optics.camera import Camera, ray_shifts
from hilstar.optics.extended import DiscLight, ExtendedLight, GlowLight, LightMap, Rectangle
from hilstar.sky.bodies.disc import AIR_TOP, SOLAR_LIMB, gauss_legendre

KEPT_TEXTURES = 6  # lasting maps and lenses: a bench has one lens, and few maps at a time
LAWS = ("uniform", "lambert", "lunar-lambert", "limb-darkened")  # by their numbers in disc.frag
NODES = 16  # as in disc.frag


class ExtendedLayer:
    """Draws extended light of one image; it lives in its renderer's context, which is current in
    every call.

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
        """Add `lights` to a linear image, in their order; the rectangles that they may have
        changed.

        Where a frame is `sure` of its levels and a disc alone is on the image, what its `Tiles`
        have as levels is left out.
        """
        ctx = self._ctx
        regions = []
        sure_tiles = None
        on_image = []
        for light in lights:
            region = light.region(self._resolution_px)
            if region is not None:
                on_image.append((light, region))
        sure = sure if len(on_image) == 1 else None
        fbo.use()
        ctx.enable(moderngl.BLEND)
        # Alpha is the share of a pixel that the light's body covers: what was drawn before it is
        # behind it.
        ctx.blend_func = (moderngl.ONE, moderngl.ONE_MINUS_SRC_ALPHA)
        for light, region in on_image:
            if isinstance(light, DiscLight):
                tiles = disc_tiles(light, region, sure)
            else:
                tiles = None
            if isinstance(light, DiscLight) and tiles is not None:
                region = tiles.region
                if not region[2]:
                    continue
                fbo.viewport = (0, 0, *self._resolution_px)
                fbo.scissor = region
                self._draw_tiles(light, tiles)
                # as its documentation has it: no test
                fbo.scissor = None  # type: ignore[assignment]
                sure_tiles = tiles if sure is not None else None
            else:
                fbo.viewport = region
                self._draw_one(light)
            regions.append(region)
        ctx.blend_func = (moderngl.ONE, moderngl.ONE)
        ctx.disable(moderngl.BLEND)
        return tuple(regions), sure_tiles

    def _draw_one(self, light: ExtendedLight) -> None:
        """Add one light to all pixels of the viewport."""
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
        """Add a map; what lasts is uploaded once."""
        defines = () if light.cover is None else ("COVER",)
        program, triangle = self._program("light_map.frag", (), *defines)
        textures = []
        for unit, image in enumerate((light.image, light.cover)):
            if image is not None:
                if light.lasting:
                    texture = self._texture(image, image, 1)
                else:
                    texture = self._upload(image, 1)
                texture.use(unit)
                textures += [] if light.lasting else [texture]
        if light.cover is not None:
            program["cover"] = 1
        program["corner_px"] = light.corner_px
        program["times"] = light.times
        triangle.render(moderngl.TRIANGLES, vertices=3)
        for texture in textures:
            texture.release()

    def _draw_tiles(self, light: DiscLight, tiles: Tiles) -> None:
        """Add a disc tile by tile, but for those that are drawn as levels."""
        for corners, defines in ((tiles.face, ()), (tiles.air, ("AIR",))):
            if len(corners):
                program, _ = self._program(
                    "tile.frag", ("tile.glsl",), *defines, vertex="tile.vert"
                )
                program["covers"] = float(light.covers)
                draw_tiles(program, corners, self._resolution_px, tiles.of_air)
        for corners, defines in ((tiles.inside, ("INSIDE",)), (tiles.edges, ())):
            if len(corners):
                program, _ = self._with_rays(
                    "disc.frag", light.camera, *defines, vertex="tile.vert"
                )
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
            program["nodes_per_px"] = tuple(
                (n - 1) / size for n, size in zip(shifts.size, self._resolution_px, strict=True)
            )
            shifts.use(0)
        return program, triangle

    def _program(
        self, fragment: str, include: tuple[str, ...] = (), *defines: str, vertex: str = "full.vert"
    ) -> tuple[moderngl.Program, moderngl.VertexArray]:
        """A program, and the triangle of `full.vert`; nothing is drawn by that with another
        vertex shader.
        """
        key = (vertex, fragment, *include, *defines)
        if key not in self._programs:
            program = build_program(self._ctx, vertex, fragment, defines, include)
            self._programs[key] = program, self._ctx.vertex_array(program, [])
        return self._programs[key]

    def _texture(self, owner: object, image: Any, components: int) -> moderngl.Texture:
        """The float32 texture of an array, or of a camera's ray shifts; kept while its owner is
        used.
        """
        cached = self._textures.pop(id(owner), None)
        if cached is None:
            if len(self._textures) >= KEPT_TEXTURES:
                self._textures.pop(next(iter(self._textures)))[1].release()
            if isinstance(owner, Camera):
                image = ray_shifts(owner)
            cached = owner, self._upload(image, components)
        self._textures[id(owner)] = cached  # the last used is the last to go
        return cached[1]

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
    disc = light.disc
    shear = light.shear
    from_image, (place, weight) = disc.to_sphere @ light.icrs_to_image.T, gauss_legendre(NODES)
    values = {
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
    set_uniforms(program, values)
