"""Programs of shaders/, a PSF for them, and the pass that makes levels of a linear image by
counting thresholds.
"""

from collections.abc import Mapping, Sequence
from functools import cache, partial
from typing import TYPE_CHECKING, Any, cast

import moderngl
import numpy as np
import numpy.typing as npt

from hilstar.basics.arrays import Float32Array
from hilstar.basics.errors import InputError
from hilstar.basics.process.interrupts import held
from hilstar.basics.resources import resource_path
from hilstar.display.panel import Panel
from hilstar.display.quantise import PixelQuantiser, code_table, level_dtype
from hilstar.display.render.context import is_software, pinned, shares_memory
from hilstar.display.render.target import MAX_SIDES, SpriteSide, SpriteSides
from hilstar.display.response import Levels, Response
from hilstar.optics.extended import Rectangle
from hilstar.optics.psf import Psf
from hilstar.optics.sprites import SPRITE_DTYPE, FrameLight

if TYPE_CHECKING:
    from hilstar.display.render.disc_tiles import Tiles

TABLE_WIDTH = 1024  # that of encode.frag
_shader = cache(lambda name: resource_path("shaders", name).read_text())
TABLE_UNIT = 15  # the last texture unit that every OpenGL has: nothing else takes it
MAX_RATE = 3e38  # in float32
# star.vert's, in the order of SPRITE_DTYPE
INPUTS = {"pixel": "2i", "fraction_px": "2f", "electrons_per_s": "1f"}
# cost of a pixel under a sprite, in pixels of a pass over the whole image (llvmpipe, sprites of 6
# px)
SPRITE_PIXEL_COST = 4
# Share of the image: beyond it a clear is faster than erasing sprites, of levels sooner than of
# light (llvmpipe, 1080p and 4K).
MAX_ERASED_LEVELS, MAX_ERASED_LIGHT = 0.02, 0.03
MAX_ERASED_REGION = 0.25  # as much of rectangles, which sprites' overheads do not slow
# On a graphics card: an H100 cleared 7680 x 4320 in 4 ms, and erased 10 000 sprites on it in 0.1
# ms.
MAX_ERASED_BY_CARD = 1.0
IMAGES_VERSION = 420  # the OpenGL that has images in shaders
STEPS_BLOCK, EDGES_BLOCK = 0, 1  # uniform blocks of encode.frag
# A level is missed only where the wings of more stars than this meet outside all of their own
# squares (see `lit_sides`).
MEETING_WINGS = 16
# In frames that are not in units (see `LightUnits`) and whose stars are apart, `round` cuts each
# star's light at a square. No pixel beyond it has more than 1 / CUT_WINGS of the light that lights
# one, 1 / 64 of the first step. A lone star has the same levels; of 10 000 on 1080p three in a
# thousand have a pixel (twelve of 82 000 lit ones in all) that is one level lower, where wings
# meet, and all have 0.002 mag rms.
CUT_WINGS = 32


def build_program(
    ctx: moderngl.Context,
    vertex: str,
    fragment: str,
    defines: Sequence[str] = (),
    include: Sequence[str] = (),
    last: Sequence[str] = (),
) -> moderngl.Program:
    """A program from two files of shaders/; the fragment shader stands between the files
    `include` and `last`.
    """
    # moderngl makes a program's members by Python, and an exception there ends the process
    with held():
        return ctx.program(
            _source(vertex, defines), fragment_shader=_source(fragment, defines, include, last)
        )


def build_compute(
    ctx: moderngl.Context,
    main: str,
    defines: Sequence[str],
    parts: Sequence[str] = (),
    last: Sequence[str] = (),
) -> moderngl.ComputeShader:
    """A compute program from a file of shaders/, between the files `parts` and `last`."""
    with held():  # as for any program
        return ctx.compute_shader(_source(main, defines, parts, last))


def _source(
    main: str, defines: Sequence[str], before: Sequence[str] = (), after: Sequence[str] = ()
) -> str:
    """A file of shaders/ after `defines`, between others."""
    version, body = _shader(main).split("\n", 1)
    head = [version, *(f"#define {name}" for name in defines)]
    return "\n".join([*head, *map(_shader, before), body, *map(_shader, after)])


def set_uniforms(
    program: moderngl.Program | moderngl.ComputeShader, values: Mapping[str, Any]
) -> None:
    """Set the uniforms of a program by name; compilers drop what it does not need."""
    for name, value in values.items():
        if name in program:
            program[name] = value


class Shares:
    """The defines, uniforms and table of a PSF for programs with shares.glsl. It lives in its
    renderer's context.
    """

    def __init__(self, ctx: moderngl.Context, psf: Psf, footprint_px: int | None = None) -> None:
        self.footprint_px = footprint_px or psf.footprint_px
        self.defines, self._uniforms, table = psf.shader(self.footprint_px)
        self._table: moderngl.Texture | None = None
        if table is not None:
            self._table = ctx.texture(table.shape[1::-1], table.shape[2], table, dtype="f4")
            self._table.filter = (moderngl.NEAREST, moderngl.NEAREST)

    def set(self, program: moderngl.Program | moderngl.ComputeShader) -> None:
        """Set the uniforms of a program; compilers drop what a program does not need."""
        set_uniforms(program, {**self._uniforms, "share_table": TABLE_UNIT})

    def bind(self) -> None:
        """Bind the table, if there is one, for the next passes: another renderer of the context
        may have bound its own.
        """
        if self._table is not None:
            self._table.use(TABLE_UNIT)


def splat_program(
    ctx: moderngl.Context,
    resolution_px: tuple[int, int],
    shares: Shares,
    in_units: bool = False,
) -> moderngl.Program:
    """The program of star.vert and splat.frag; `in_units` draws light in the whole units of a
    LightUnits.
    """
    defines = (*shares.defines, *["UNITS"] * in_units)
    program = build_program(ctx, "star.vert", "splat.frag", defines, ("shares.glsl",))
    shares.set(program)
    program["resolution_px"] = resolution_px
    program["footprint_px"] = shares.footprint_px
    return program


def sprites_array(program: moderngl.Program, buffer: moderngl.Buffer) -> moderngl.VertexArray:
    """A vertex array of what a program of star.vert asks of sprites in a buffer."""
    layout = []
    names = []
    for name in SPRITE_DTYPE.names or ():
        form = INPUTS[name]
        if name in program:
            layout.append(form)
            names.append(name)
        else:
            layout.append(f"{4 * int(form[0])}x")  # bytes that this program does not read
    return program.ctx.vertex_array(program, [(buffer, " ".join(layout), *names)])


def viewport_of_sprites(size_px: tuple[int, int], footprint_px: int) -> Rectangle:
    """The viewport of star.vert: a footprint beyond every edge, for GL drops a point whose centre
    is outside it.
    """
    width, height = size_px
    return -footprint_px, -footprint_px, width + 2 * footprint_px, height + 2 * footprint_px


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


def lit_sides(
    panel: Panel, lit_e_per_s: float, psf: Psf, wings: int = MEETING_WINGS
) -> SpriteSides:
    """The squares outside which no pixel of a star has 1 / `wings` of the light that lights one, by
    falling rates.

    There the level is 0 wherever the wings of no more stars than that meet.
    """
    gain = panel.gain()
    light = lit_e_per_s
    if gain is not None:
        light = lit_e_per_s / float(gain.max())
    sizes = range(psf.footprint_px - 2, 0, -2)
    every = -(-len(sizes) // MAX_SIDES) or 1
    sides = []
    for size in sizes[::every]:
        below_e_per_s = light / wings / psf.outside_share(size)
        sides.append(SpriteSide(min(below_e_per_s, MAX_RATE), size))
    return tuple(sides)


def most_covered_px(sprites: FrameLight, footprint_px: int, sides: SpriteSides, few_px: int) -> int:
    """Pixels that all sprites together may light, fainter stars within these sides; at most,
    where that is under `few_px`.
    """
    most = len(sprites) * footprint_px**2
    if not sides or most < few_px:
        return most
    rates = np.ascontiguousarray(sprites.data["electrons_per_s"])
    larger_px = footprint_px
    for side in sides:
        smaller = int(np.count_nonzero(rates < side.below_e_per_s / sprites.per_star))
        most -= smaller * (larger_px**2 - side.side_px**2)
        larger_px = side.side_px
    return most


class Eraser:
    """Makes an image black again where the last frame's sprites were, or all of it where that is
    faster.

    On llvmpipe a clear of 1920 x 1080 takes 0.7 ms of two cores, as long as 1000 stars. It lives in
    its renderer's context.
    """

    def __init__(self, ctx: moderngl.Context, size_px: tuple[int, int], of_levels: bool) -> None:
        self._ctx = ctx
        self._size_px = size_px
        max_share = MAX_ERASED_BY_CARD
        self._most_share = MAX_ERASED_BY_CARD
        if is_software(ctx):
            max_share = MAX_ERASED_LEVELS if of_levels else MAX_ERASED_LIGHT
            self._most_share = MAX_ERASED_REGION
        self._most_px = size_px[0] * size_px[1] * max_share
        defines = ("LEVELS 0u",) if of_levels else ()
        self._program = build_program(ctx, "star.vert", "erase.frag", defines)
        self._program["resolution_px"] = size_px
        self._triangle = ctx.vertex_array(
            build_program(ctx, "full.vert", "erase.frag", defines), []
        )
        self._vao: moderngl.VertexArray | None = None
        self._footprint_px = 0

    def erase_regions(self, fbo: moderngl.Framebuffer, regions: Sequence[Rectangle]) -> None:
        """Make rectangles of `fbo` black, by a pass: Mesa 22.3's zink loses a clear of a part
        before which nothing is drawn.
        """
        if not regions:
            return
        fbo.use()
        width, height = self._size_px
        erased_px = sum(wide * high for _, _, wide, high in regions)
        if erased_px >= self._most_share * width * height:
            fbo.clear()
            return
        for region in regions:
            fbo.viewport = region
            self._triangle.render(moderngl.TRIANGLES, vertices=3)

    def take_places_from(self, buffer: moderngl.Buffer, footprint_px: int) -> None:
        """Read the places of sprites from a buffer."""
        if self._vao is not None:
            self._vao.release()
        self._vao = sprites_array(self._program, buffer)
        self._program["footprint_px"] = self._footprint_px = footprint_px

    def clears(self, count: int | None) -> bool:
        """Whether a clear of all is faster than erasing `count` sprites (None: it is not known
        where they are).
        """
        return count is None or count * self._footprint_px**2 > self._most_px

    def erase(self, fbo: moderngl.Framebuffer, count: int | None) -> None:
        """Make `fbo` black where the first `count` sprites of the buffer are; all of it where
        that is not known.
        """
        fbo.use()
        if self.clears(count):
            fbo.clear()
        elif count and self._vao is not None:
            fbo.viewport = viewport_of_sprites(self._size_px, self._footprint_px)
            self._vao.render(moderngl.POINTS, vertices=count)


def draw_tiles(
    program: moderngl.Program,
    corners: Float32Array,
    size_px: tuple[int, int],
    of_air: tuple[float, float, float, float] | None = None,
) -> None:
    """Draw tiles by their corners (n, 6) with a program of tile.vert, into an image whose
    framebuffer is in use.
    """
    if not len(corners):
        return
    set_uniforms(program, {"size_px": size_px, "air": of_air})
    buffer = program.ctx.buffer(corners)
    content: tuple[moderngl.Buffer, *tuple[str, ...]] = (buffer, "2f 16x", "place_px")
    if "given" in program:
        content = (buffer, "2f 4f", "place_px", "given")
    triangles = program.ctx.vertex_array(program, [content])
    triangles.render(moderngl.TRIANGLES)
    triangles.release()
    buffer.release()


class LevelTexture:
    """The levels of the last frame on the GPU, R8UI up to 256 levels and R16UI beyond; `texture` is
    what a window shows.

    It lives in its renderer's context, which is current in every call.
    """

    def __init__(
        self, ctx: moderngl.Context, resolution_px: tuple[int, int], response: Response
    ) -> None:
        kind = level_dtype(response)
        shape = resolution_px[::-1]
        made: tuple[npt.NDArray[Any], moderngl.Buffer | None] = np.zeros(shape, dtype=kind), None
        self.image, self.memory = pinned(ctx, shape, kind) if shares_memory(ctx) else made
        self._dtype = f"u{self.image.itemsize}"
        bits = 8 * self.image.itemsize
        self._levels = Levels(self.image)
        self.defines = f"LEVELS_FORMAT r{bits}ui", f"LEVEL_BITS {bits}"
        self.texture = ctx.texture(resolution_px, 1, dtype=self._dtype)
        self.fbo = ctx.framebuffer([self.texture])
        self.fbo.clear()
        self.in_memory = False  # whether the last levels are in the array alone

    def write(self, levels: Levels) -> None:
        """Upload levels."""
        self._levels[...] = levels
        self.texture.write(self.image, alignment=1)

    def upload(self) -> moderngl.Texture:
        """The texture, with what was made in the array."""
        if self.in_memory:
            self.texture.write(self.image, alignment=1)
            self.in_memory = False
        return self.texture

    def read(self) -> Levels:
        """The levels (height, width); the next frame overwrites the same array."""
        if not self.in_memory:
            self.fbo.read_into(self.image, components=1, dtype=self._dtype, alignment=1)
        return self._levels


def write(buffer: moderngl.Buffer, values: npt.NDArray[Any]) -> None:
    """Give a buffer these values and no others; it grows by doubling."""
    size = buffer.size
    if size < values.nbytes:
        size = 2 * values.nbytes
    buffer.orphan(size)
    buffer.write(values)


class LookupTable:
    """Values (n,) of four bytes that a shader looks up: in a uniform block where there is room,
    else in a storage buffer.
    """

    def __init__(
        self, ctx: moderngl.Context, name: str, binding: int, values: npt.NDArray[Any]
    ) -> None:
        rows = table_rows(values, ctx)
        self.define = [] if rows is None else [f"{name} {len(rows)}"]
        self._binding = binding
        self._in_block = rows is not None
        self.buffer = ctx.buffer((values if rows is None else rows).tobytes())

    def bind(self) -> None:
        """Bind it for the next pass."""
        if self._in_block:
            self.buffer.bind_to_uniform_block(self._binding)
        else:
            self.buffer.bind_to_storage_buffer(self._binding)


class Encoder:
    """Draws the levels of a linear image: only the sprites' footprints where that is less work than
    the whole image.

    `sprite_program`, of star.vert, encodes sprites. It lives in its renderer's context, which is
    current in every call.
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
        gain = panel.gain()
        rises = quantiser.shader
        defines = [*["RISES"] * bool(rises), *["UNIFORMITY"] * (gain is not None)]
        self._linear_image = linear if ctx.version_code >= IMAGES_VERSION else None
        self._of_image = ("IMAGES",) if self._linear_image is not None else ()
        self._sprite_vao: moderngl.VertexArray | None = None
        self._white = panel.response.white
        self._textures = {"linear_e_per_s": linear}
        self._blocks: dict[int, moderngl.Buffer] = {}
        edges = quantiser.edges_e_per_s(panel)
        table = code_table(edges)
        last, first, shift = len(table.first_code) - 1, table.first_bin, table.bin_shift
        steps = table.steps()
        edge_rows = table_rows(edges, ctx) if rises else None
        if edge_rows is not None:
            defines.append(f"EDGES {len(edge_rows)}")
            self._blocks[EDGES_BLOCK] = ctx.buffer(edge_rows.tobytes())
        elif steps is None or rises:
            self._textures["threshold_e_per_s"] = self._texture(_rows(edges))
        # `bins` of levels.glsl and of encode.frag
        if steps is None:
            self._textures["first_code"] = self._texture(_rows(table.first_code))
            bins = first, last, shift
        else:
            bins = (first - 1) << shift, ((first + last + 1) << shift) - 1, shift
            step_rows = table_rows(steps, ctx)
            if step_rows is None:
                self._textures["steps"] = self._texture(_rows(steps))
                defines.append("STEPS 0")
            else:
                self._blocks[STEPS_BLOCK] = ctx.buffer(step_rows.tobytes())
                defines.append(f"STEPS {len(step_rows)}")
        if gain is not None:
            self._textures["gain"] = self._texture(gain)
        self._textures |= {name: self._texture(mask) for name, mask in quantiser.masks().items()}
        after = ["levels.glsl"] * (steps is not None) + [rises] * bool(rises)
        self._built = partial(build_program, ctx, fragment="encode.frag", last=after)
        self._defines = tuple(defines)
        self._counts = {"bins": bins, "white": len(edges)}
        self._programs: dict[tuple[str, ...], moderngl.Program] = {}
        self.sprite_program, self._whole = (
            self._program(vertex) for vertex in ("star.vert", "full.vert")
        )
        self.sprite_program["resolution_px"] = linear.size
        self._whole_vao = ctx.vertex_array(self._whole, [])

    def _program(self, vertex: str, *of_tiles: str) -> moderngl.Program:
        """The program that encodes the linear image with a vertex shader, or tiles' own light;
        made when first asked for.
        """
        key = (vertex, *of_tiles)
        if key not in self._programs:
            program = self._built(
                vertex=vertex,
                defines=(*self._defines, *(of_tiles or self._of_image)),
                include=["tile.glsl"] * bool(of_tiles),
            )
            if "Edges" in program:
                cast(moderngl.UniformBlock, program["Edges"]).binding = EDGES_BLOCK
            units = {name: unit for unit, name in enumerate(self._textures)}
            set_uniforms(program, self._counts | units)
            self._programs[key] = program
        return self._programs[key]

    def _texture(self, values: npt.NDArray[Any]) -> moderngl.Texture:
        """A texture of float32 or uint32 `values` (height, width), read texel by texel."""
        dtype = "f4" if values.dtype == np.float32 else "u4"
        texture = self._ctx.texture(
            values.shape[::-1], 1, np.ascontiguousarray(values), dtype=dtype
        )
        texture.filter = (moderngl.NEAREST, moderngl.NEAREST)
        return texture

    @property
    def tables(self) -> list[moderngl.Texture | moderngl.Buffer]:
        """The tables by which light becomes levels."""
        textures = [texture for name, texture in self._textures.items() if name != "linear_e_per_s"]
        return [*textures, *self._blocks.values()]

    def take_places_from(self, buffer: moderngl.Buffer, footprint_px: int) -> None:
        """Read the places and rates of sprites from a buffer."""
        if self._sprite_vao is not None:
            self._sprite_vao.release()
        self._sprite_vao = sprites_array(self.sprite_program, buffer)
        self.sprite_program["footprint_px"] = self._footprint_px = footprint_px

    def draw(
        self,
        count: int,
        per_star: int,
        covered_px: int,
        uniforms: Mapping[str, float],
        regions: Sequence[Rectangle] = (),
        tiles: "Tiles | None" = None,
        *,
        is_black: bool = True,
    ) -> None:
        """Encode the linear image under the first `count` sprites of the buffer and in `regions`;
        the rest is black.

        Instead of `regions` it may have `tiles`, of which the image has what is no level.

        `uniforms` are the quantiser's of this frame. Each star has `per_star` sprites; together
        they cover `covered_px`, and where that is most of the image the pass covers all of it.
        `is_black` says that the levels were erased before.
        """
        width, height = self._size_px
        whole = (0, 0, width, height)
        regions = regions if tiles is None else ()
        if covered_px * SPRITE_PIXEL_COST >= width * height or whole in regions:
            regions = (whole,)
            count = 0
        self._fbo.use()
        if not is_black and whole not in regions:
            self._fbo.clear()
        self._bind()
        for program in (self.sprite_program, self._whole):
            set_uniforms(program, uniforms)
        for region in regions:
            self._fbo.viewport = region
            self._whole_vao.render(moderngl.TRIANGLES, vertices=3)
        if count and self._sprite_vao is not None:
            self.sprite_program["sprites_per_star"] = float(per_star)
            self._fbo.viewport = viewport_of_sprites(self._size_px, self._footprint_px)
            self._sprite_vao.render(moderngl.POINTS, vertices=count)
        if tiles is not None:
            self._draw_tiles(tiles, uniforms)

    def _bind(self) -> None:
        """Bind the linear image and the tables for the next pass."""
        for unit, texture in enumerate(self._textures.values()):
            texture.use(unit)
        if self._linear_image is not None:
            self._linear_image.bind_to_image(0, read=True, write=False)
        for place, block in self._blocks.items():
            block.bind_to_uniform_block(place)

    def _draw_tiles(self, tiles: "Tiles", uniforms: Mapping[str, float]) -> None:
        """Encode tiles: of the linear image where it has them, of their own light, or white."""
        self._fbo.viewport, self._fbo.scissor = (0, 0, *self._size_px), tiles.region
        of_image = np.concatenate([tiles.face, tiles.air, tiles.inside, tiles.edges])
        given = (
            (of_image, ()),
            (tiles.face_levels, ("TILE",)),
            (tiles.air_levels, ("TILE", "AIR")),
        )
        for corners, defines in given:
            if len(corners):
                program = self._program("tile.vert", *defines)
                set_uniforms(program, uniforms)
                draw_tiles(program, corners, self._size_px, tiles.of_air)
        key = ("white",)
        if key not in self._programs:
            self._programs[key] = build_program(
                self._ctx, "tile.vert", "erase.frag", (f"LEVELS {self._white}u",)
            )
        draw_tiles(self._programs[key], tiles.white, self._size_px)  # last, for sprites add to it
        self._fbo.scissor = None  # type: ignore[assignment]  # as its documentation has it: no test


def _rows(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Values (n,) in rows of TABLE_WIDTH, with 0 after the last."""
    rows = -(-len(values) // TABLE_WIDTH)
    padded = np.zeros((rows, TABLE_WIDTH), dtype=values.dtype)
    padded.ravel()[: len(values)] = values
    return padded


def table_rows(values: npt.NDArray[Any], ctx: moderngl.Context) -> npt.NDArray[Any] | None:
    """`values` (n,) of four bytes in rows of four, for a uniform block; None where this GL has no
    room for so many.

    On llvmpipe a block is read in two thirds of the time of a texture, and in half of that of a
    storage buffer.
    """
    if 4 * len(values) + 16 > ctx.info["GL_MAX_UNIFORM_BLOCK_SIZE"]:
        return None
    return np.resize(values, (-(-len(values) // 4), 4))
