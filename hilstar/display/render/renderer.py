"""The renderer: sprites to a linear image and code values, in OpenGL (3.3 core or newer).

This room is the only user of moderngl.
"""

import math
import zlib
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import cached_property
from typing import TYPE_CHECKING, Self

import moderngl
import numpy as np

from hilstar.basics.arrays import Float32Array
from hilstar.display.exact import ExactQuantiser
from hilstar.display.panel import Panel
from hilstar.display.quantise import MASK_TURNS, DitherQuantiser, PixelQuantiser
from hilstar.display.quantisers import QUANTISERS
from hilstar.display.render.backend import NO_FRAME, Backend, Path, ScreenView, as_maps
from hilstar.display.render.context import (
    MAX_WRITTEN_BYTES,
    Context,
    check_limits,
    create_context,
    draws_by_cpu,
    shares_memory,
)
from hilstar.display.render.cpu_stars import CpuImage, CpuStars, least_side_px
from hilstar.display.render.driver import Driver
from hilstar.display.render.encoder import (
    CUT_WINGS,
    SPRITE_PIXEL_COST,
    Encoder,
    Eraser,
    LevelTexture,
    Shares,
    lit_sides,
    most_covered_px,
    set_sides,
    set_uniforms,
    splat_program,
    sprites_array,
    viewport_of_sprites,
)
from hilstar.display.render.exact_pass import ExactPass, PixelSums
from hilstar.display.render.light_units import LightUnits
from hilstar.display.render.target import Target
from hilstar.display.response import Levels
from hilstar.optics.extended import Rectangle
from hilstar.optics.sprites import SPRITE_DTYPE, FrameLight

if TYPE_CHECKING:
    from hilstar.display.render.disc_tiles import Sure, Tiles
    from hilstar.display.render.extended_drawing import ExtendedLayer

FIRST_CAPACITY = 4096  # sprites; the buffer grows by doubling
UNTIMED = nullcontext()
NO_LEVELS = "this target has no monitor response, so no levels"


class Renderer(Backend):
    """Draws sprites of one grey Target, in a context of its own or in a window's. Free it with
    `close`.

    `before` are the renderers of the target's `turn`, for whose stars' errors those here make up.
    """

    context: Context
    MAY_USE_CPU = True  # else points draw, whatever HILSTAR_DRAW says

    def __init__(
        self, target: Target, context: Context | None = None, before: Sequence[Backend] = ()
    ) -> None:
        super().__init__(target)
        self._before = [renderer for renderer in before if isinstance(renderer, Renderer)]
        self._panel = target.panel()
        self.footprint_px = target.psf.footprint_px
        self._undrawn: tuple[FrameLight | None, bool] | None = None
        self._by_numpy = False
        quantiser = QUANTISERS[target.quantisation]
        self._by_pixel = quantiser.by_pixel()
        self._by_star: type[ExactQuantiser] | None = None
        if target.response is not None and issubclass(quantiser, ExactQuantiser):
            self._by_star = quantiser
        self._last_frame = NO_FRAME
        self.context = self._ctx = context or create_context()
        self.gl_renderer = str(self._ctx.info["GL_RENDERER"])
        self.gl_version = str(self._ctx.info["GL_VERSION"])
        try:
            with self._ctx:
                self._driver = Driver(self._ctx)
                self._uses_cpu = self.MAY_USE_CPU and draws_by_cpu(self.gl_renderer)
                if target.response:
                    key = "sprite_sigma_px"
                else:
                    key = "psf_sigma_px"
                check_limits(
                    self._ctx.info,
                    target.resolution_px,
                    self.footprint_px,
                    f"{key} = {list(target.psf.width_px)}",
                )
                self._build()
        except BaseException:
            self._ctx.release()
            raise

    def _build(self) -> None:
        """Make images and programs; those of levels only where there is a response."""
        ctx = self._ctx
        target = self.target
        ctx.enable(moderngl.PROGRAM_POINT_SIZE)
        ctx.blend_func = (moderngl.ONE, moderngl.ONE)
        self._linear = ctx.texture(target.resolution_px, 1, dtype="f4")
        self._linear.filter = (moderngl.NEAREST, moderngl.NEAREST)
        self._linear_fbo = ctx.framebuffer([self._linear])
        self._shares = Shares(ctx, target.psf, self.footprint_px)
        self._splat = splat_program(ctx, target.resolution_px, self._shares)
        self._eraser = Eraser(ctx, target.resolution_px, of_levels=False)
        self._level_eraser = Eraser(ctx, target.resolution_px, of_levels=True)
        self._regions: tuple[Rectangle, ...] = ()  # where extended light is on the images
        self._tiles: Tiles | None = None  # a disc whose levels need no linear image everywhere
        self._cut_sides = target.sides
        self._build_levels()
        set_sides(self._splat, self._cut_sides)
        self._reserve(FIRST_CAPACITY)
        width, height = target.resolution_px
        self._linear_image = np.empty((height, width), dtype=np.float32)
        self._cpu_image: CpuImage | None = None  # the linear image of stars alone
        if self._uses_cpu and target.response is None:
            self._cpu_image = CpuImage(target.resolution_px, target.psf)
        self._is_cpu_image = False  # where the last draw is

    def _build_levels(self) -> None:
        """Make what turns light into levels, and choose the path of frames of stars alone."""
        target = self.target
        panel = self._panel
        # What turns light into codes; a window adds its own.
        self.tables: list[moderngl.Texture | moderngl.Buffer] = []
        self._checksums: list[tuple[moderngl.Texture | moderngl.Buffer, int]] = []
        self.path = "points"
        self._levels: LevelTexture | None = None
        self._levels_black = True  # but for the last frame
        self._encoder: Encoder | None = None
        self._exact_pass: ExactPass | None = None
        self._units: LightUnits | None = None
        self._cpu_stars: CpuStars | None = None
        self._pixel_sums: PixelSums | None = None  # those of `_cpu_stars`, for `exact`
        self._unit_splat: moderngl.Program | None = None  # where points are in units
        self._exact: ExactQuantiser | None = None
        self._floor_encoder: Encoder | None = None
        self._floor_levels: LevelTexture | None = None
        self._floor_key: tuple[object, float] = ((), 0.0)
        if panel is None:
            return
        gain = panel.gain()
        self._gains = (1.0, 1.0) if gain is None else (float(gain.min()), float(gain.max()))
        self._levels = LevelTexture(self._ctx, target.resolution_px, panel.response)
        by_star, ctx = self._by_star, self._ctx
        if by_star is not None and by_star.takes(target.psf, ctx.version_code):
            passes = [renderer._exact_pass for renderer in self._before]
            self._exact_pass = ExactPass(
                by_star,
                target,
                panel,
                [exact_pass for exact_pass in passes if exact_pass is not None],
                linear=self._linear,
                levels=self._levels,
                shares=self._shares,
            )
            self.tables += self._exact_pass.tables
        if by_star is None or self._exact_pass is not None:
            self._encoder = Encoder(ctx, self._linear, self._levels, panel, self._by_pixel)
            self.tables += self._encoder.tables
            lit_e_per_s = self._by_pixel.lit_from_e_per_s(panel)
            self._lit_sides = (
                () if not lit_e_per_s else target.sides or lit_sides(panel, lit_e_per_s, target.psf)
            )
            set_sides(self._encoder.sprite_program, self._lit_sides)
            if lit_e_per_s and not target.sides:
                self._cut_sides = lit_sides(panel, lit_e_per_s, target.psf, CUT_WINGS)
            if not self._by_pixel.shader:  # light in units is compared with thresholds alone
                self._build_units(panel, self._levels, self._encoder)
        self.path = self._path_of_levels()

    def _path_of_levels(self) -> Path:
        if self._by_star is None:
            return "points" if self._cpu_stars is None else "CPU"
        if self._exact_pass is None:
            return "NumPy"
        if self._cpu_stars is None:
            return "points, then compute shaders"
        return "CPU, then compute shaders"

    def _build_units(self, panel: Panel, levels: LevelTexture, encoder: Encoder) -> None:
        """Build what draws light in whole units: on the CPU, else points.

        `exact` takes the sums of both from memory that the GL shares; where it shares none, points.
        """
        target = self.target
        units = self._units = LightUnits(panel, target.resolution_px, target.psf, target.sides)
        if self._uses_cpu and self._exact_pass is None:
            self._cpu_stars = CpuStars(units, levels.image)
            return
        size = 4 * math.prod(target.resolution_px)
        if self._uses_cpu and shares_memory(self._ctx) and size <= MAX_WRITTEN_BYTES:
            sums = self._pixel_sums = PixelSums(levels)
            side_px = least_side_px(target.psf)
            self._cpu_stars = CpuStars(units, levels.image, sums.values, side_px)
            return
        self._unit_splat = splat_program(
            self._ctx, target.resolution_px, self._shares, in_units=True
        )
        set_uniforms(self._unit_splat, {"most_e_per_s": units.most_e_per_s})
        for program in (self._unit_splat, encoder.sprite_program):
            program["reach_px2"], program["largest_px"] = units.axes_px2, units.side_px

    def _array_of(self, program: moderngl.Program | None) -> moderngl.VertexArray | None:
        """The sprites in the buffer as a program takes them."""
        if program is None:
            return None
        return sprites_array(program, self._buffer)

    def _reserve(self, sprites: int) -> None:
        """Make room for `sprites` sprites on the GPU; it grows by doubling and never shrinks."""
        self._capacity = sprites
        self._buffer = self._ctx.buffer(reserve=sprites * SPRITE_DTYPE.itemsize, dynamic=True)
        self._splat_vao = self._array_of(self._splat)
        self._unit_vao = self._array_of(self._unit_splat)
        self._last_count: int | None = None  # sprites in the buffer and on the images
        for eraser in (self._eraser, self._level_eraser):
            eraser.take_places_from(self._buffer, self.footprint_px)
        if self._encoder is not None:
            self._encoder.take_places_from(self._buffer, self.footprint_px)

    def draw(self, sprites: FrameLight | None, frame: int = 0) -> None:
        """See `Backend.draw`."""
        with self._ctx:
            if frame <= self._last_frame:
                self.begin_anew()
            self._last_frame = frame
            stars = self._cpu_stars
            by_star = self._by_star
            exact_pass = self._exact_pass
            if by_star is None or exact_pass is not None:
                sprites = as_maps(sprites, self.target)
            if exact_pass is not None:
                exact_pass.forget_over()
            if self._exact is not None:
                self._exact.over = None
            extended = sprites is not None and bool(sprites.extended)
            # Stars are added to levels of extended light, on the CPU or by NumPy.
            on_floor = extended and by_star is not None
            in_units = not extended or (on_floor and stars is not None)
            units = self._units if in_units else None
            if units is None:
                unit_e_per_s = None
            else:
                unit_e_per_s = units.unit_for(sprites)
            self._by_numpy = by_star is not None and (
                exact_pass is None or (on_floor and unit_e_per_s is None)
            )
            # `exact` takes no finer units
            if stars is not None and in_units and (unit_e_per_s or by_star is None):
                floor = None
                if sprites is not None and on_floor and by_star is not None:
                    with self._stage("extended"):
                        floor = self._floor(sprites, by_star.floor_turn(frame))
                self._draw_on_cpu(stars, sprites, unit_e_per_s, floor)
                return
            if stars is not None:
                self._forget_cpu(stars)
            if self._by_numpy:
                self._draw_by_numpy(sprites, frame)
                self._undrawn = (sprites, False)
                self._last_count = None
            else:
                self._draw_by_points(sprites, unit_e_per_s)

    def _draw_on_cpu(
        self,
        stars: CpuStars,
        sprites: FrameLight | None,
        unit_e_per_s: float | None,
        floor: LevelTexture | None,
    ) -> None:
        """Levels star by star; the linear image is drawn only when it is read."""
        self._undrawn = (sprites, True)
        self._levels_black = False
        with self._stage("erase"):
            stars.lay(None if floor is None else floor.read())
        if self._levels is not None:
            self._levels.in_memory = True
        if sprites is not None and len(sprites):
            with self._stage("splat"):
                stars.add(sprites, unit_e_per_s)
            with self._stage("encode"):
                stars.encode()
        sums = self._pixel_sums
        if sprites is not None and sums is not None:
            with self._stage("upload"):
                sums.upload(sprites, stars.unit_e_per_s, floor)
        self._choose(sprites, sums)

    def _forget_cpu(self, stars: CpuStars) -> None:
        """Forget what the CPU drew last: the levels are drawn by something else now, or were
        changed.
        """
        stars.forget()
        if self._levels is not None:
            self._levels.in_memory = False

    def draw_linear(self, sprites: FrameLight) -> None:
        """See `Backend.draw_linear`."""
        with self._ctx:
            self._draw_linear(sprites, whole=True)

    @cached_property
    def _extended(self) -> "ExtendedLayer":
        # no frame of stars alone needs it
        from hilstar.display.render.extended_drawing import ExtendedLayer

        return ExtendedLayer(self._ctx, self.target.resolution_px)

    def begin_anew(self) -> None:
        """See `Backend.begin_anew`."""
        self._last_frame = NO_FRAME
        if self._exact is not None:
            self._exact.left = None
        if self._exact_pass is not None:
            self._exact_pass.left = None

    def _draw_by_points(self, sprites: FrameLight | None, unit_e_per_s: float | None) -> None:
        """The linear image and its levels by rasterised sprites, in units where one is given."""
        few_px = math.prod(self.target.resolution_px) // SPRITE_PIXEL_COST
        sides = () if self._encoder is None else self._lit_sides
        if sprites is None:
            covered_px = 0
        else:
            covered_px = most_covered_px(sprites, self.footprint_px, sides, few_px)
        units = self._units
        encoder = self._encoder
        splat = self._unit_splat
        in_units = sprites is not None and unit_e_per_s is not None and splat is not None
        if units is not None and encoder is not None and splat is not None:
            if sprites is None or unit_e_per_s is None:
                reach_per_e = 0.0
            else:
                reach_per_e = units.reach_per_e(sprites)
            encoder.sprite_program["reach_per_e"] = reach_per_e
            if in_units and unit_e_per_s is not None:
                splat["reach_per_e"] = reach_per_e
                splat["unit_e_per_s"] = unit_e_per_s
        cut = in_units or (bool(self._cut_sides) and sprites is not None and covered_px < few_px)
        if sprites is None or not sprites.extended or covered_px >= few_px:
            sure = None
        else:
            sure = self._sure(self._by_pixel, sprites)
        self._draw_linear(
            sprites, whole=not (self.target.sides or cut), in_units=in_units, sure=sure
        )
        if self._encoder is not None:
            with self._stage("encode"):
                count, per_star = (0, 1) if sprites is None else (len(sprites), sprites.per_star)
                uniforms = self._by_pixel.uniforms(self._last_frame)
                lit = self._regions, self._tiles
                self._encoder.draw(
                    count, per_star, covered_px, uniforms, *lit, is_black=self._levels_black
                )
                self._levels_black = True  # but for what this frame has
        if in_units or (cut and not self.target.sides) or self._tiles is not None:
            self._undrawn = (sprites, True)  # without what is left out, when somebody asks
        self._choose(sprites, None)

    def _stage(self, name: str) -> AbstractContextManager[object]:
        """The context in which a stage of a frame runs; see StagedRenderer."""
        return UNTIMED

    def _choose(self, sprites: FrameLight | None, sums: PixelSums | None) -> None:
        """Choose the levels of the sprites that are drawn, star by star, with what NumPy's last
        frame left.
        """
        exact_pass = self._exact_pass
        if exact_pass is None:
            return
        # what NumPy's quantiser carries goes on here
        if self._exact is not None and self._exact.left is not None:
            exact_pass.left = self._exact.left
            self._exact.left = None
        if sprites is None or not len(sprites):
            exact_pass.left = None
            return
        with self._stage("choose"):
            exact_pass.draw(self._buffer if sums is None else sums.sprites, sprites, sums)

    def _draw_by_numpy(self, sprites: FrameLight | None, frame: int) -> None:
        """Levels by the sprites themselves: the linear image is drawn only when it is read."""
        levels = self._levels
        quantiser = self._numpy_exact()
        if levels is None or quantiser is None:
            return
        # what the shader carries goes on here
        exact_pass = self._exact_pass
        if exact_pass is not None and exact_pass.left is not None:
            quantiser.left = exact_pass.left
            exact_pass.left = None
        floor = None
        if sprites is not None and sprites.extended:
            floor = self._floor(sprites, quantiser.floor_turn(frame)).read()
        self._exact_levels = quantiser.levels(sprites, floor)
        levels.write(self._exact_levels)

    def _numpy_exact(self) -> ExactQuantiser | None:
        """`exact` in NumPy, made by the first frame that needs it: its arrays are as large as the
        image.
        """
        target = self.target
        if self._exact is None and self._by_star is not None and self._panel is not None:
            before = [renderer._numpy_exact() for renderer in self._before]
            self._exact = self._by_star(self._panel, target.resolution_px, target.psf, target.seen)
            self._exact.turn = target.turn
            self._exact.before = [quantiser for quantiser in before if quantiser is not None]
        return self._exact

    def _floor(self, sprites: FrameLight, turn: float) -> LevelTexture:
        """The levels of extended light alone, dithered by a turned mask: stars are added to them in
        light.

        The same lights and turn again give the same levels, which are kept.
        """
        key = sprites.extended, turn
        panel = self._panel
        if panel is None:
            raise TypeError(NO_LEVELS)
        if self._floor_encoder is None or self._floor_levels is None:
            self._floor_key = (), 0.0
            self._floor_levels = LevelTexture(self._ctx, self.target.resolution_px, panel.response)
            self._floor_encoder = Encoder(
                self._ctx, self._linear, self._floor_levels, panel, DitherQuantiser
            )
        if key != self._floor_key:
            self._erase(levels=False)
            self._draw_extended(sprites, self._sure(DitherQuantiser, None))
            self._floor_encoder.draw(
                0, 1, 0, {"shift": turn}, self._regions, self._tiles, is_black=False
            )
            self._floor_levels.in_memory = False
            self._floor_levels.read()
            self._floor_levels.in_memory = True  # read back once, for all frames that keep it
            self._floor_key = key
        return self._floor_levels

    def _sure(self, quantiser: type[PixelQuantiser], sprites: FrameLight | None) -> "Sure | None":
        """The bounds beyond which a disc's levels are sure without its exact light: black below the
        first and white above the second. None without a response.
        """
        panel = self._panel
        if panel is None:
            return None
        from hilstar.display.render.disc_tiles import Sure

        least, most = self._gains
        white_e_per_s = panel.flux_at_white_e_per_s
        # The first step by the smallest threshold of a mask, at all of its turns
        dark_e_per_s = quantiser.lit_from_e_per_s(panel) or float(
            panel.response.light[1]
        ) * white_e_per_s / (2 * MASK_TURNS)
        if sprites is None:
            places_px = np.empty((0, 2), dtype=np.intp)
        else:
            places_px = sprites.data["pixel"]
        return Sure(dark_e_per_s / most, white_e_per_s / least, places_px, self.footprint_px)

    def _draw_extended(self, sprites: FrameLight, sure: "Sure | None" = None) -> None:
        """Add extended light to the linear image."""
        self._regions, self._tiles = self._extended.draw(self._linear_fbo, sprites.extended, sure)

    def _draw_linear(
        self,
        sprites: FrameLight | None,
        whole: bool,
        levels: bool = True,
        in_units: bool = False,
        sure: "Sure | None" = None,
    ) -> None:
        """Draw the linear image; `levels` says whether the last frame's are erased."""
        self._undrawn, sprites = None, as_maps(sprites, self.target)
        extended = sprites is not None and bool(sprites.extended)
        image = self._cpu_image
        self._is_cpu_image = image is not None and whole and not extended
        if image is not None and self._is_cpu_image:
            image.draw(sprites)
            return
        with self._stage("erase"):
            self._erase(levels)
        if sprites is not None and sprites.extended:
            self._draw_extended(sprites, sure)
        if sprites is not None and len(sprites):
            with self._stage("upload"):
                if len(sprites) > self._capacity:
                    for held in (self._splat_vao, self._unit_vao, self._buffer):
                        if held is not None:
                            held.release()
                    self._reserve(max(2 * self._capacity, len(sprites)))
                self._buffer.orphan()
                self._buffer.write(sprites.data)
            self._last_count = len(sprites)
            with self._stage("splat"):
                if not in_units:
                    self._splat["sides"] = 0 if whole else len(self._cut_sides)
                    self._splat["sprites_per_star"] = float(sprites.per_star)
                self._linear_fbo.use()
                self._shares.bind()
                self._linear_fbo.viewport = viewport_of_sprites(
                    self.target.resolution_px, self.footprint_px
                )
                self._ctx.enable(moderngl.BLEND)
                vao = self._unit_vao if in_units and self._unit_vao is not None else self._splat_vao
                if vao is not None:
                    vao.render(moderngl.POINTS, vertices=len(sprites))
                self._ctx.disable(moderngl.BLEND)

    def _erase(self, levels: bool = True) -> None:
        """Make black what the last frame drew."""
        if levels and self._encoder is not None and self._levels is not None:
            # A clear waits for the encoder: the fewer changes from image to image, the faster.
            self._levels_black = self._levels_black and not self._level_eraser.clears(
                self._last_count
            )
            if self._levels_black:
                self._level_eraser.erase(self._levels.fbo, self._last_count)
                self._level_eraser.erase_regions(self._levels.fbo, self._regions)
        self._eraser.erase(self._linear_fbo, self._last_count)
        self._eraser.erase_regions(self._linear_fbo, self._regions)
        self._regions = ()
        self._tiles = None
        self._last_count = 0

    def levels(self) -> Levels:
        """See `Backend.levels`."""
        if self._by_numpy:
            return self._exact_levels
        if self._levels is None:
            raise TypeError(NO_LEVELS)
        if self._levels.in_memory:  # nothing of them is left to draw
            return self._levels.read()
        with self._ctx:
            self._driver.wait()
            return self._levels.read()

    @property
    def codes_texture(self) -> moderngl.Texture:
        """The levels of the last draw, R8UI or R16UI, for whom its `ctx` is current; TypeError
        without a response.
        """
        if self._levels is None:
            raise TypeError(NO_LEVELS)
        with self._ctx:
            return self._levels.upload()

    def linear(self) -> Float32Array:
        """See `Backend.linear`."""
        if self._cpu_image is not None and self._is_cpu_image:
            return self._cpu_image.image
        with self._ctx:
            if self._undrawn is not None:
                self._draw_linear(*self._undrawn, levels=self._by_numpy)
            self._driver.wait()
            self._linear_fbo.read_into(self._linear_image, components=1, dtype="f4", alignment=1)
        return self._linear_image

    def show_on(self, view: ScreenView, beside: Sequence[Backend] = ()) -> None:
        """See `Backend.show_on`."""
        from hilstar.display.render.presenter import Presenter

        self._screen = view
        self._shown = [self, *(other for other in beside if isinstance(other, Renderer))]
        textures = [renderer.codes_texture for renderer in self._shown]
        self._presenter = Presenter(textures[0], view, textures[1:])
        self.tables.append(self._presenter.table)

    def present(
        self, overlay: int = 0, patch_code: int = 0, marker: tuple[int, int] = (0, 0)
    ) -> None:
        """See `Backend.present`."""
        for renderer in self._shown:
            _ = renderer.codes_texture  # with the last levels
        self._presenter.present(overlay, patch_code, marker)

    def take_back_buffer(self) -> None:
        """See `Backend.take_back_buffer`."""
        self._presenter.wait()

    def changed_codes(self) -> str:
        """See `Backend.changed_codes`."""
        from hilstar.display.render.presenter import changed_codes

        return changed_codes(self._ctx, self._screen.screen_px, self._screen.bits)

    def fault(self) -> str:
        """See `Backend.fault`."""
        with self._ctx:
            return self._driver.fault()

    def remember_tables(self) -> None:
        """See `Backend.remember_tables`."""
        with self._ctx:
            self._checksums = [(table, _checksum(table)) for table in self.tables]

    def changed_tables(self) -> int:
        """See `Backend.changed_tables`."""
        with self._ctx:
            return sum(_checksum(table) != checksum for table, checksum in self._checksums)

    def forget_images(self) -> None:
        """See `Backend.forget_images`."""
        self._last_count = None  # so that all is cleared
        self._floor_encoder = None
        self._floor_levels = None
        with self._ctx:
            if self._cpu_stars is not None:
                self._forget_cpu(self._cpu_stars)
            self._extended.forget()
        self.begin_anew()

    def gl_error(self) -> str:
        """The GL error since the last call, "GL_NO_ERROR" when there is none."""
        with self._ctx:
            return str(self._ctx.error)

    def finish(self) -> None:
        """Wait until everything that was asked for is drawn."""
        with self._ctx:
            self._driver.wait()

    def close(self) -> None:
        """Free the GL context and everything in it."""
        self._ctx.release()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _checksum(table: moderngl.Texture | moderngl.Buffer) -> int:
    if isinstance(table, moderngl.Buffer):
        data = table.read()
    else:
        data = table.read(alignment=1)
    return zlib.crc32(data)
