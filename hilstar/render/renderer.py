"""The renderer: sprites to a linear image and code values, in OpenGL 3.3 core through EGL.

The only module that knows moderngl.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import TracebackType
from typing import Any, Self

import moderngl
import numpy as np
import numpy.typing as npt

from hilstar.arrays import Float32Array
from hilstar.errors import InputError, MachineError
from hilstar.monitor.photometry import Codes, Response, code_dtype
from hilstar.resources import resource_path
from hilstar.scene.psf import SQRT2, footprint_px
from hilstar.scene.sprites import SPRITE_DTYPE, Sprites

EGL_LIBRARY = "libEGL.so.1"
INSTALL_EGL = "install it: apt-get install libegl1 libgl1-mesa-dri"
TABLE_WIDTH = 1024  # that of encode.frag
MANTISSA_BITS = 23
FIRST_CAPACITY = 4096


@dataclass(frozen=True, slots=True)
class Target:
    """What the renderer draws for: the monitor's pixels, its sprites and its response."""

    resolution_px: tuple[int, int]
    sigma_px: tuple[float, float]
    response: Response
    flux_at_white_e_per_s: float


def create_context() -> moderngl.Context:
    """A headless OpenGL 3.3 core context. Raises MachineError with what to install.

    Every GL function comes through libEGL's own loader: a bare machine has no libGL.so.
    """
    try:
        settings: Any = {"backend": "egl", "libgl": EGL_LIBRARY, "libegl": EGL_LIBRARY}
        return moderngl.create_context(require=330, standalone=True, **settings)
    except Exception as error:  # moderngl and glcontext raise plain Exceptions here
        raise MachineError(f"OpenGL 3.3 through EGL is not there ({error}); {INSTALL_EGL}") from error


class Renderer:
    """Draws sprites of one Target. Free it with `close`, or use it as a context manager."""

    def __init__(self, target: Target) -> None:
        self.target = target
        self.footprint_px = footprint_px(target.sigma_px)
        self._ctx = create_context()
        try:
            with self._ctx:
                self._check_limits()
                self._build()
        except BaseException:
            self._ctx.release()
            raise

    @property
    def gl_renderer(self) -> str:
        """The name of the GL renderer, as the driver gives it."""
        return str(self._ctx.info["GL_RENDERER"])

    def _check_limits(self) -> None:
        info = self._ctx.info
        largest = int(min(info["GL_MAX_TEXTURE_SIZE"], *info["GL_MAX_VIEWPORT_DIMS"])) - 2 * self.footprint_px
        if max(self.target.resolution_px) > largest:
            raise InputError(f"[monitor] resolution_px = {list(self.target.resolution_px)}: this GL draws at most {largest} px")
        if self.footprint_px > info["GL_POINT_SIZE_RANGE"][1]:
            raise InputError(
                f"[render] sprite_sigma_px = {list(self.target.sigma_px)}: needs sprites of {self.footprint_px} px;"
                f" this GL draws at most {info['GL_POINT_SIZE_RANGE'][1]:g} px"
            )

    def _build(self) -> None:
        ctx, target = self._ctx, self.target
        ctx.enable(moderngl.PROGRAM_POINT_SIZE)
        ctx.blend_func = (moderngl.ONE, moderngl.ONE)
        self._linear = ctx.texture(target.resolution_px, 1, dtype="f4")
        self._codes = ctx.texture(target.resolution_px, 1, dtype="u1" if target.response.bits <= 8 else "u2")
        self._linear_fbo = ctx.framebuffer([self._linear])
        self._code_fbo = ctx.framebuffer([self._codes])
        for texture in (self._linear, self._codes):
            texture.filter = (moderngl.NEAREST, moderngl.NEAREST)
        self._splat = self._program("star.vert", "splat.frag")
        self._encode_sprites = self._program("star.vert", "encode.frag")
        self._encode_all = self._program("full.vert", "encode.frag")
        sigma_x, sigma_y = target.sigma_px
        self._splat["inverse_sigma_sqrt2"] = (1 / (sigma_x * SQRT2), 1 / (sigma_y * SQRT2))
        for program in (self._splat, self._encode_sprites):
            program["resolution_px"] = target.resolution_px
            program["footprint_px"] = self.footprint_px
        self._load_response()
        self._reserve(FIRST_CAPACITY)
        self._encode_all_vao = ctx.vertex_array(self._encode_all, [])
        width, height = target.resolution_px
        self._code_image: Codes = np.empty((height, width), dtype=code_dtype(target.response.bits))
        self._linear_image = np.empty((height, width), dtype=np.float32)

    def _program(self, vertex: str, fragment: str) -> moderngl.Program:
        return self._ctx.program(
            vertex_shader=resource_path("shaders", vertex).read_text(),
            fragment_shader=resource_path("shaders", fragment).read_text(),
        )

    def _load_response(self) -> None:
        table = code_table(self.target.response.thresholds_e_per_s(self.target.flux_at_white_e_per_s))
        self._threshold = self._table_texture(table.threshold, "f4")
        self._first_code = self._table_texture(table.first_code, "u4")
        for program in (self._encode_sprites, self._encode_all):
            program["linear_e_per_s"] = 0
            program["threshold_e_per_s"] = 1
            program["first_code"] = 2
            program["bin_shift"] = table.bin_shift
            program["first_bin"] = table.first_bin
            program["last_bin"] = len(table.first_code) - 1
            program["white"] = self.target.response.white

    def _table_texture(self, values: npt.NDArray[Any], dtype: str) -> moderngl.Texture:
        rows = -(-len(values) // TABLE_WIDTH)
        padded = np.zeros((rows, TABLE_WIDTH), dtype=values.dtype)
        padded.ravel()[: len(values)] = values
        texture = self._ctx.texture((TABLE_WIDTH, rows), 1, padded.tobytes(), dtype=dtype)
        texture.filter = (moderngl.NEAREST, moderngl.NEAREST)
        return texture

    def _reserve(self, sprites: int) -> None:
        """Room for so many sprites on the GPU; grows by doubling, never shrinks."""
        self._capacity = sprites
        self._buffer = self._ctx.buffer(reserve=sprites * SPRITE_DTYPE.itemsize, dynamic=True)
        layout = [(self._buffer, "2i 2f 1f", "pixel", "fraction_px", "electrons_per_s")]
        encode_layout = [(self._buffer, "2i 12x", "pixel")]
        self._splat_vao = self._ctx.vertex_array(self._splat, layout)
        self._encode_vao = self._ctx.vertex_array(self._encode_sprites, encode_layout)

    def draw(self, sprites: Sprites | None) -> None:
        """Draw the linear image and the codes of `sprites` (None: blank); read them with `linear` and `codes`."""
        count = 0 if sprites is None else len(sprites)
        with self._ctx:
            if sprites is not None and count:
                self._upload(sprites)
            self._draw_linear(count)
            self._draw_codes(count)

    def _upload(self, sprites: Sprites) -> None:
        if len(sprites) > self._capacity:
            for old in (self._splat_vao, self._encode_vao, self._buffer):
                old.release()
            self._reserve(max(2 * self._capacity, len(sprites)))
        self._buffer.orphan()
        self._buffer.write(sprites.data)

    def _viewport(self) -> tuple[int, int, int, int]:
        width, height = self.target.resolution_px
        margin = self.footprint_px
        return (-margin, -margin, width + 2 * margin, height + 2 * margin)

    def _draw_linear(self, count: int) -> None:
        self._linear_fbo.use()
        self._linear_fbo.clear()
        if count:
            self._linear_fbo.viewport = self._viewport()
            self._ctx.enable(moderngl.BLEND)
            self._splat_vao.render(moderngl.POINTS, vertices=count)
            self._ctx.disable(moderngl.BLEND)

    def _draw_codes(self, count: int) -> None:
        width, height = self.target.resolution_px
        self._code_fbo.use()
        for unit, texture in enumerate((self._linear, self._threshold, self._first_code)):
            texture.use(unit)
        if count * self.footprint_px**2 < width * height:
            self._code_fbo.clear()
            self._code_fbo.viewport = self._viewport()
            if count:
                self._encode_vao.render(moderngl.POINTS, vertices=count)
        else:
            self._code_fbo.viewport = (0, 0, width, height)
            self._encode_all_vao.render(moderngl.TRIANGLES, vertices=3)

    def codes(self) -> Codes:
        """The code values of the last draw, (height, width); the next call overwrites the same array."""
        with self._ctx:
            self._code_fbo.read_into(
                self._code_image, components=1, dtype="u1" if self._code_image.itemsize == 1 else "u2", alignment=1
            )
        return self._code_image

    def linear(self) -> Float32Array:
        """The linear image of the last draw, electrons per second, float32 (height, width); overwritten as `codes`."""
        with self._ctx:
            self._linear_fbo.read_into(self._linear_image, components=1, dtype="f4", alignment=1)
        return self._linear_image

    def gl_error(self) -> str:
        """The GL error since the last call, "GL_NO_ERROR" when there is none."""
        with self._ctx:
            return str(self._ctx.error)

    def close(self) -> None:
        """Free the GL context and everything in it."""
        self._ctx.release()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


@dataclass(frozen=True, slots=True)
class CodeTable:
    """Thresholds, and the code at the lower edge of each bin of the light's leading bits (see encode.frag)."""

    threshold: Float32Array
    first_code: npt.NDArray[np.uint32]
    bin_shift: int
    first_bin: int


def code_table(thresholds: Float32Array) -> CodeTable:
    """The table for rising, positive `thresholds`.

    As many bins to an octave as there are thresholds, 4096 at most: few bins then hold more than one.
    """
    shift = MANTISSA_BITS - min(12, len(thresholds).bit_length())
    first_bin = int(thresholds[0].view(np.int32)) >> shift
    last_bin = int(thresholds[-1].view(np.int32)) >> shift
    edges = (np.arange(first_bin, last_bin + 1, dtype=np.int64) << shift).astype(np.int32).view(np.float32)
    first_code = np.searchsorted(thresholds, edges, side="right").astype(np.uint32)
    first_code[0] = 0
    return CodeTable(thresholds, first_code, shift, first_bin)
