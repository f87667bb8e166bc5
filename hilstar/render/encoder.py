"""Programs of shaders/, a PSF for them, and the pass that makes levels of a linear image by counting thresholds."""

from collections.abc import Mapping, Sequence
from typing import Any

import moderngl
import numpy as np
import numpy.typing as npt

from hilstar.errors import InputError
from hilstar.monitor.quantise import Panel, PixelQuantiser, code_table, level_dtype
from hilstar.monitor.response import Levels
from hilstar.process.interrupts import held
from hilstar.render.backend import MAX_SIDES, SpriteSide, SpriteSides
from hilstar.render.context import is_software
from hilstar.resources import resource_path
from hilstar.scene.extended import Rectangle
from hilstar.scene.psf import Psf
from hilstar.scene.sprites import Sprites

TABLE_WIDTH = 1024  # that of encode.frag
TABLE_UNIT = 15  # the last texture unit that every OpenGL has: nothing else takes it


def build_program(
    ctx: moderngl.Context, vertex: str, fragment: str, defines: tuple[str, ...] = (), include: str = "", last: str = ""
) -> moderngl.Program:
    """A program from two files of shaders/; the fragment shader stands between its `defines`, `include` and the file `last`."""
    version, body = resource_path("shaders", fragment).read_text().split("\n", 1)
    before = [resource_path("shaders", include).read_text()] if include else []
    after = [resource_path("shaders", last).read_text()] if last else []
    lines = [version, *(f"#define {name}" for name in defines), *before, body, *after]
    with held():  # moderngl makes a program's members by Python, and an exception there ends the process
        return ctx.program(
            vertex_shader=resource_path("shaders", vertex).read_text(),
            fragment_shader="\n".join(lines),
        )


def build_compute(
    ctx: moderngl.Context, main: str, defines: Sequence[str], parts: Sequence[str] = ()
) -> moderngl.ComputeShader:
    """A compute program from a file of shaders/, after `defines` and the parts of it that are in files of their own."""
    version, body = resource_path("shaders", main).read_text().split("\n", 1)
    before = [resource_path("shaders", f"{part}.glsl").read_text() for part in parts]
    with held():  # as for any program
        return ctx.compute_shader("\n".join([version, *(f"#define {name}" for name in defines), *before, body]))


class Shares:
    """The defines, uniforms and table of a PSF for programs with shares.glsl. It lives in its renderer's context."""

    def __init__(self, ctx: moderngl.Context, psf: Psf, footprint_px: int | None = None) -> None:
        self.footprint_px = footprint_px or psf.footprint_px
        self.defines, self._uniforms, table = psf.shader(self.footprint_px)
        self._table: moderngl.Texture | None = None
        if table is not None:
            self._table = ctx.texture(table.shape[1::-1], table.shape[2], table, dtype="f4")
            self._table.filter = (moderngl.NEAREST, moderngl.NEAREST)

    def set(self, program: moderngl.Program | moderngl.ComputeShader) -> None:
        """Set the uniforms of a program; compilers drop what a program does not need."""
        for name, value in self._uniforms.items():
            if name in program:
                program[name] = value
        if "share_table" in program:
            program["share_table"] = TABLE_UNIT

    def bind(self) -> None:
        """Bind the table, if there is one, for the next passes: another renderer of the context may have bound its own."""
        if self._table is not None:
            self._table.use(TABLE_UNIT)


def splat_program(
    ctx: moderngl.Context, resolution_px: tuple[int, int], shares: Shares, in_units: bool = False
) -> moderngl.Program:
    """The program of star.vert and splat.frag; `in_units` draws light in the whole units of a LightUnits."""
    program = build_program(ctx, "star.vert", "splat.frag", (*shares.defines, *["UNITS"] * in_units), "shares.glsl")
    shares.set(program)
    program["resolution_px"] = resolution_px
    program["footprint_px"] = shares.footprint_px
    return program


MAX_RATE = 3e38  # in float32
PLACES = "2i 8x 1f"  # SPRITE_DTYPE's places and rates
SPRITE_PIXEL_COST = 4  # cost of a pixel under a sprite, in pixels of a pass over the whole image (llvmpipe, sprites of 6 px)
# Share of the image: beyond it a clear is faster than erasing sprites, of levels sooner than of light (llvmpipe, 1080p and 4K).
MAX_ERASED_LEVELS, MAX_ERASED_LIGHT = 0.02, 0.03
# On a graphics card: an H100 cleared 7680 x 4320 in 4 ms, and erased 10 000 sprites on it in 0.1 ms.
MAX_ERASED_BY_CARD = 1.0
IMAGES_VERSION = 420  # the OpenGL that has images in shaders
# A level is missed only where the wings of more stars than this meet outside all of their own squares (see `lit_sides`).
MEETING_WINGS = 16
# In frames that are not in units (see `LightUnits`) and whose stars are apart, `round` cuts each star's light at a square.
# No pixel beyond it has more than 1 / CUT_WINGS of the light that lights one, 1 / 64 of the first step. A lone star has the
# same levels; of 10 000 on 1080p three in a thousand have a pixel (twelve of 82 000 lit ones in all) that is one level lower,
# where wings meet, and all have 0.002 mag rms.
CUT_WINGS = 32


def set_sides(program: moderngl.Program, sides: SpriteSides) -> None:
    """Set the sides of fainter stars' sprites, by falling rates, in a program of star.vert.

    Raises InputError for more sides than the shader has room for.
    """
    if len(sides) > MAX_SIDES:
        raise InputError(f"{len(sides)} sizes of sprites; give at most {MAX_SIDES}")
    padded = [*sides, *[SpriteSide(0.0, 0)] * (MAX_SIDES - len(sides))]
    program["sides"] = len(sides)
    program["below_e_per_s"] = [side.below_e_per_s for side in padded]
    program["side_px"] = [side.side_px for side in padded]


def lit_sides(panel: Panel, lit_e_per_s: float, psf: Psf, wings: int = MEETING_WINGS) -> SpriteSides:
    """The squares outside which no pixel of a star has 1 / `wings` of the light that lights one, by falling rates.

    There the level is 0 wherever the wings of no more stars than that meet.
    """
    gain = panel.gain()
    light = lit_e_per_s / (1.0 if gain is None else float(gain.max()))
    sizes = range(psf.footprint_px - 2, 0, -2)
    every = -(-len(sizes) // MAX_SIDES) or 1
    rates = {size: light / wings / psf.outside_share(size) for size in sizes[::every]}
    return tuple(SpriteSide(min(rate, MAX_RATE), size) for size, rate in rates.items())


def most_covered_px(sprites: Sprites, footprint_px: int, sides: SpriteSides, few_px: int) -> int:
    """Pixels that all sprites together may light, fainter stars within these sides; at most, where that is under `few_px`."""
    most = len(sprites) * footprint_px**2
    if not sides or most < few_px:
        return most
    rates, larger_px = np.ascontiguousarray(sprites.data["electrons_per_s"]), footprint_px
    for side in sides:
        smaller = int(np.count_nonzero(rates < side.below_e_per_s / sprites.per_star))
        most -= smaller * (larger_px**2 - side.side_px**2)
        larger_px = side.side_px
    return most


class Eraser:
    """Makes an image black again where the last frame's sprites were, or all of it where that is faster.

    On llvmpipe a clear of 1920 x 1080 takes 0.7 ms of two cores, as long as 1000 stars. It lives in its renderer's context.
    """

    def __init__(self, ctx: moderngl.Context, size_px: tuple[int, int], of_levels: bool) -> None:
        self._ctx = ctx
        self._size_px = size_px
        on_processor = MAX_ERASED_LEVELS if of_levels else MAX_ERASED_LIGHT
        self._most_px = size_px[0] * size_px[1] * (on_processor if is_software(ctx) else MAX_ERASED_BY_CARD)
        self._program = build_program(ctx, "star.vert", "erase.frag", ("LEVELS",) if of_levels else ())
        self._program["resolution_px"] = size_px
        self._triangle = ctx.vertex_array(build_program(ctx, "full.vert", "erase.frag", ("LEVELS",) if of_levels else ()), [])
        self._vao: moderngl.VertexArray | None = None
        self._footprint_px = 0

    def erase_regions(self, fbo: moderngl.Framebuffer, regions: Sequence[Rectangle]) -> None:
        """Make rectangles of `fbo` black, by a pass: Mesa 22.3's zink loses a clear of a part before which nothing is drawn."""
        if not regions:
            return
        fbo.use()
        if (0, 0, *self._size_px) in regions:
            fbo.clear()
            return
        for region in regions:
            fbo.viewport = region
            self._triangle.render(moderngl.TRIANGLES, vertices=3)

    def take_places_from(self, buffer: moderngl.Buffer, footprint_px: int) -> None:
        """Read the places of sprites from a buffer of SPRITE_DTYPE."""
        if self._vao is not None:
            self._vao.release()
        self._vao = self._ctx.vertex_array(self._program, [(buffer, PLACES, "pixel", "electrons_per_s")])
        self._program["footprint_px"] = self._footprint_px = footprint_px

    def clears(self, count: int | None) -> bool:
        """Whether a clear of all is faster than erasing `count` sprites (None: it is not known where they are)."""
        return count is None or count * self._footprint_px**2 > self._most_px

    def erase(self, fbo: moderngl.Framebuffer, count: int | None) -> None:
        """Make `fbo` black where the first `count` sprites of the buffer are; all of it where that is not known."""
        width, height = self._size_px
        fbo.use()
        if self.clears(count):
            fbo.clear()
        elif count and self._vao is not None:
            margin = self._footprint_px
            fbo.viewport = (-margin, -margin, width + 2 * margin, height + 2 * margin)
            self._vao.render(moderngl.POINTS, vertices=count)


class LevelTexture:
    """The levels of the last frame on the GPU, R8UI up to 256 levels and R16UI beyond; `texture` is what a window shows.

    It lives in its renderer's context, which is current in every call.
    """

    def __init__(self, ctx: moderngl.Context, resolution_px: tuple[int, int], panel: Panel) -> None:
        width, height = resolution_px
        self._image = Levels(np.zeros((height, width), dtype=level_dtype(panel.response)))
        self._dtype = f"u{self._image.itemsize}"
        self.texture = ctx.texture(resolution_px, 1, dtype=self._dtype)
        self.fbo = ctx.framebuffer([self.texture])
        self.fbo.clear()

    def write(self, levels: Levels) -> None:
        """Upload `levels` (height, width)."""
        self.texture.write(levels, alignment=1)

    def read(self) -> Levels:
        """The levels (height, width); the next call overwrites the same array."""
        self.fbo.read_into(self._image, components=1, dtype=self._dtype, alignment=1)
        return self._image


class LookupTable:
    """Values (n,) of four bytes that a shader looks up: in a uniform block where there is room, else in a storage buffer."""

    def __init__(self, ctx: moderngl.Context, name: str, binding: int, values: npt.NDArray[Any]) -> None:
        rows = table_rows(values, ctx)
        self.define = [] if rows is None else [f"{name} {len(rows)}"]
        self._binding, self._in_block = binding, rows is not None
        self.buffer = ctx.buffer((values if rows is None else rows).tobytes())

    def bind(self) -> None:
        """Bind it for the next pass."""
        if self._in_block:
            self.buffer.bind_to_uniform_block(self._binding)
        else:
            self.buffer.bind_to_storage_buffer(self._binding)


class Encoder:
    """Draws the levels of a linear image: only the sprites' footprints where that is less work than the whole image.

    `sprite_program`, of star.vert, encodes sprites. It lives in its renderer's context, which is current in every call.
    """

    def __init__(
        self,
        ctx: moderngl.Context,
        linear: moderngl.Texture,
        levels: LevelTexture,
        panel: Panel,
        quantiser: type[PixelQuantiser],
    ) -> None:
        self._ctx = ctx
        self._fbo = levels.fbo
        self._size_px = linear.size
        self._footprint_px = 0
        gain, rises = panel.gain(), quantiser.shader
        defines = (("RISES",) if rises else ()) + (("UNIFORMITY",) if gain is not None else ())
        table = code_table(quantiser.edges_e_per_s(panel))
        found = None if rises else table.steps()
        steps = None if found is None else table_rows(found, ctx)
        defines += () if steps is None else (f"STEPS {len(steps)}",)
        self._linear_image = linear if ctx.version_code >= IMAGES_VERSION else None
        defines += (f"BIN_SHIFT {table.bin_shift}", *(("IMAGES",) if self._linear_image is not None else ()))
        self.sprite_program, self._whole = (
            build_program(ctx, vertex, "encode.frag", defines, last=rises) for vertex in ("star.vert", "full.vert")
        )
        self.sprite_program["resolution_px"] = linear.size
        self._whole_vao = ctx.vertex_array(self._whole, [])
        self._sprite_vao: moderngl.VertexArray | None = None
        self._textures = {"linear_e_per_s": linear}
        self._steps = None if steps is None else ctx.buffer(steps.tobytes())
        if steps is None:
            self._textures |= {"threshold_e_per_s": self._texture(_rows(table.threshold))}
            self._textures |= {"first_code": self._texture(_rows(table.first_code))}
        for program in (self.sprite_program, self._whole):
            if steps is None:
                program["first_bin"] = table.first_bin
                program["last_bin"] = len(table.first_code) - 1
                program["white"] = len(table.threshold)
            else:
                program["lowest"] = (table.first_bin - 1) << table.bin_shift
                program["highest"] = ((table.first_bin + len(table.first_code)) << table.bin_shift) - 1
        if gain is not None:
            self._textures["gain"] = self._texture(gain)
        self._textures |= {name: self._texture(mask) for name, mask in quantiser.masks().items()}
        for program in (self.sprite_program, self._whole):
            for unit, name in enumerate(self._textures):
                program[name] = unit

    def _texture(self, values: npt.NDArray[Any]) -> moderngl.Texture:
        """A texture of float32 or uint32 `values` (height, width), read texel by texel."""
        dtype = "f4" if values.dtype == np.float32 else "u4"
        texture = self._ctx.texture(values.shape[::-1], 1, np.ascontiguousarray(values), dtype=dtype)
        texture.filter = (moderngl.NEAREST, moderngl.NEAREST)
        return texture

    @property
    def tables(self) -> list[moderngl.Texture | moderngl.Buffer]:
        """The tables by which light becomes levels."""
        textures = [texture for name, texture in self._textures.items() if name != "linear_e_per_s"]
        return [*textures, *([] if self._steps is None else [self._steps])]

    def take_places_from(self, buffer: moderngl.Buffer, footprint_px: int) -> None:
        """Read the places and rates of sprites from a buffer of SPRITE_DTYPE."""
        if self._sprite_vao is not None:
            self._sprite_vao.release()
        self._sprite_vao = self._ctx.vertex_array(self.sprite_program, [(buffer, PLACES, "pixel", "electrons_per_s")])
        self.sprite_program["footprint_px"] = self._footprint_px = footprint_px

    def draw(
        self,
        count: int,
        per_star: int,
        covered_px: int,
        uniforms: Mapping[str, float],
        regions: Sequence[Rectangle] = (),
        is_black: bool = True,
    ) -> None:
        """Encode the linear image under the first `count` sprites of the buffer and in `regions`; the rest is black.

        `uniforms` are the quantiser's of this frame. Each star has `per_star` sprites; together they cover `covered_px`, and
        where that is most of the image the pass covers all of it. `is_black` says that the levels were erased before.
        """
        width, height = self._size_px
        whole = (0, 0, width, height)
        if covered_px * SPRITE_PIXEL_COST >= width * height or whole in regions:
            regions, count = (whole,), 0
        self._fbo.use()
        if not is_black and whole not in regions:
            self._fbo.clear()
        for unit, texture in enumerate(self._textures.values()):
            texture.use(unit)
        if self._linear_image is not None:
            self._linear_image.bind_to_image(0, read=True, write=False)
        if self._steps is not None:
            self._steps.bind_to_uniform_block(0)
        for name, value in uniforms.items():
            self.sprite_program[name] = self._whole[name] = value
        for region in regions:
            self._fbo.viewport = region
            self._whole_vao.render(moderngl.TRIANGLES, vertices=3)
        if count and self._sprite_vao is not None:
            self.sprite_program["sprites_per_star"] = float(per_star)
            margin = self._footprint_px
            self._fbo.viewport = (-margin, -margin, width + 2 * margin, height + 2 * margin)
            self._sprite_vao.render(moderngl.POINTS, vertices=count)


def _rows(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    rows = -(-len(values) // TABLE_WIDTH)
    padded = np.zeros((rows, TABLE_WIDTH), dtype=values.dtype)
    padded.ravel()[: len(values)] = values
    return padded


def table_rows(values: npt.NDArray[Any], ctx: moderngl.Context) -> npt.NDArray[Any] | None:
    """`values` (n,) of four bytes in rows of four, for a uniform block; None where this GL has no room for so many.

    On llvmpipe a block is read in two thirds of the time of a texture, and in half of that of a storage buffer.
    """
    if 4 * len(values) + 16 > ctx.info["GL_MAX_UNIFORM_BLOCK_SIZE"]:
        return None
    return np.resize(values, (-(-len(values) // 4), 4))
