"""The second pass of the renderer: a linear image to code values, by counting thresholds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import moderngl
import numpy as np
import numpy.typing as npt

from hilstar.arrays import Float32Array
from hilstar.monitor.photometry import Codes, code_dtype
from hilstar.resources import resource_path

TABLE_WIDTH = 1024  # that of encode.frag
MANTISSA_BITS = 23


def build_program(ctx: moderngl.Context, vertex: str, fragment: str) -> moderngl.Program:
    """A program from two files of shaders/."""
    return ctx.program(
        vertex_shader=resource_path("shaders", vertex).read_text(),
        fragment_shader=resource_path("shaders", fragment).read_text(),
    )


class Encoder:
    """Draws the codes of a linear image: only the sprites' footprints where that is less than the whole image.

    It lives in its renderer's context, which is current in every call.
    """

    def __init__(
        self, ctx: moderngl.Context, linear: moderngl.Texture, bits: int, thresholds_e_per_s: Float32Array, footprint_px: int
    ) -> None:
        self._ctx = ctx
        self._linear = linear
        self._footprint_px = footprint_px
        self._size_px = linear.size
        self._read_dtype = "u1" if bits <= 8 else "u2"
        self._fbo = ctx.framebuffer([ctx.texture(linear.size, 1, dtype=self._read_dtype)])
        self._sprites = build_program(ctx, "star.vert", "encode.frag")
        self._whole = build_program(ctx, "full.vert", "encode.frag")
        self._sprites["resolution_px"] = linear.size
        self._sprites["footprint_px"] = footprint_px
        self._whole_vao = ctx.vertex_array(self._whole, [])
        self._sprite_vao: moderngl.VertexArray | None = None
        self._load_table(code_table(thresholds_e_per_s))
        width, height = linear.size
        self._image: Codes = np.empty((height, width), dtype=code_dtype(bits))

    def _load_table(self, table: CodeTable) -> None:
        self._tables = (self._table_texture(table.threshold, "f4"), self._table_texture(table.first_code, "u4"))
        for program in (self._sprites, self._whole):
            program["linear_e_per_s"] = 0
            program["threshold_e_per_s"] = 1
            program["first_code"] = 2
            program["bin_shift"] = table.bin_shift
            program["first_bin"] = table.first_bin
            program["last_bin"] = len(table.first_code) - 1
            program["white"] = len(table.threshold)

    def _table_texture(self, values: npt.NDArray[Any], dtype: str) -> moderngl.Texture:
        rows = -(-len(values) // TABLE_WIDTH)
        padded = np.zeros((rows, TABLE_WIDTH), dtype=values.dtype)
        padded.ravel()[: len(values)] = values
        texture = self._ctx.texture((TABLE_WIDTH, rows), 1, padded.tobytes(), dtype=dtype)
        texture.filter = (moderngl.NEAREST, moderngl.NEAREST)
        return texture

    def take_places_from(self, buffer: moderngl.Buffer) -> None:
        """Use a buffer of SPRITE_DTYPE, of which only the pixels are read here."""
        if self._sprite_vao is not None:
            self._sprite_vao.release()
        self._sprite_vao = self._ctx.vertex_array(self._sprites, [(buffer, "2i 12x", "pixel")])

    def draw(self, count: int) -> None:
        """Encode the linear image under the first `count` sprites of the buffer; the rest is black."""
        width, height = self._size_px
        self._fbo.use()
        for unit, texture in enumerate((self._linear, *self._tables)):
            texture.use(unit)
        if count * self._footprint_px**2 >= width * height:
            self._fbo.viewport = (0, 0, width, height)
            self._whole_vao.render(moderngl.TRIANGLES, vertices=3)
            return
        self._fbo.clear()
        if count and self._sprite_vao is not None:
            margin = self._footprint_px
            self._fbo.viewport = (-margin, -margin, width + 2 * margin, height + 2 * margin)
            self._sprite_vao.render(moderngl.POINTS, vertices=count)

    def read(self) -> Codes:
        """The codes (height, width); the next call overwrites the same array."""
        self._fbo.read_into(self._image, components=1, dtype=self._read_dtype, alignment=1)
        return self._image


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
