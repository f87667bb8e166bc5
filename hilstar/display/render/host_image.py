"""The linear image on a software OpenGL: a compute pass adds up stars in NumPy's own memory, and
nothing is read back.

On llvmpipe this takes a third of the time of sprites that are rasterised into a texture, which is
then read.
"""

from typing import cast

import moderngl
import numpy as np
import numpy.typing as npt

from hilstar.basics.arrays import IntArray
from hilstar.display.render.context import MAX_ROUNDS, pinned
from hilstar.display.render.encoder import Shares, build_compute
from hilstar.optics.sprites import SPRITE_DTYPE, FrameLight

BANDS = 16  # bands of rows, each drawn by one thread at a time; an even number
FEW_PX = 12_800  # sprites' pixels that one thread draws before more threads would have begun
FIRST_CAPACITY = 1024  # sprites
STEP = 8  # as in linear.comp
# Share of the image: beyond it a clear is faster than making sprites black (llvmpipe, 1080p and
# 4K).
MAX_ERASED = 0.06
ROW_DTYPE = np.uint16  # sorted by digits: in a tenth of the time of larger numbers
RowArray = npt.NDArray[np.uint16]


class HostImage:
    """A linear image in the process's memory, drawn by shaders/linear.comp; it lives in its
    renderer's context.

    `image`, electrons per second, float32 (height, width), is read-only and outlives the context.
    Each pixel's stars are added in one order, whatever the number of threads: the same sprites give
    the same bits.
    """

    def __init__(
        self, ctx: moderngl.Context, resolution_px: tuple[int, int], shares: Shares
    ) -> None:
        self._ctx, self._size_px, self._footprint_px = ctx, resolution_px, shares.footprint_px
        self._shares = shares
        footprint_px = shares.footprint_px
        width, height = resolution_px
        self.image, self._light = pinned(ctx, (height, width), np.float32)
        self.image.flags.writeable = False
        self._capacity = FIRST_CAPACITY  # sprites that fit into half of the buffer
        self._half = 0  # the half with the last frame's
        self._sprites = self._reserved()
        # the last frame's sprites, as they are in the buffer
        self._rows: RowArray = np.empty(0, dtype=ROW_DTYPE)
        edges_px = np.arange(BANDS + 1) * resolution_px[1] // BANDS
        # A sprite's row here is that of its last pixels; its first are footprint - 1 rows before.
        self._first_row, self._end_row = edges_px[:-1], edges_px[1:] + footprint_px - 1
        named = [*shares.defines, f"FOOTPRINT {footprint_px}", f"BANDS {BANDS}"]
        self._program = build_compute(ctx, "linear.comp", named, ["shares.glsl"])
        shares.set(self._program)
        self._program["resolution_px"] = resolution_px

    def _reserved(self) -> moderngl.Buffer:
        return self._ctx.buffer(reserve=2 * self._capacity * SPRITE_DTYPE.itemsize, dynamic=True)

    def draw(self, sprites: FrameLight | None) -> None:
        """Draw the light of sprites (None: none) in place of the last ones'; extended light is
        not drawn.
        """
        width, height = self._size_px
        count = 0 if sprites is None else len(sprites)
        if (
            len(self._rows) * self._footprint_px**2 > MAX_ERASED * width * height
            or count > self._capacity
        ):
            self._light.clear()
            self._rows = self._rows[:0]
        if count > self._capacity:
            self._sprites.release()
            self._capacity = 2 * count
            self._sprites = self._reserved()
        bands = 1 if self._is_few(count) else BANDS
        ranges = np.zeros((BANDS, 4), dtype=np.int32)
        ranges[:, :2] = self._half * self._capacity + self._in_bands(bands)
        self._half = 1 - self._half
        self._rows = self._upload(sprites) if sprites is not None and count else self._rows[:0]
        ranges[:, 2:] = self._half * self._capacity + self._in_bands(bands)
        self._run(ranges, bands)

    def _is_few(self, sprites: int) -> bool:
        return sprites * self._footprint_px**2 <= FEW_PX

    def _upload(self, sprites: FrameLight) -> RowArray:
        """Put the sprites into the buffer, by rows where they are many; their rows."""
        height, data = self._size_px[1], sprites.data
        before = (self._footprint_px - 1) // 2
        last = data["pixel"][:, 1] + (self._footprint_px - 1 - before)
        rows: RowArray = np.clip(last, 0, height + 2 * self._footprint_px).astype(ROW_DTYPE)
        if not self._is_few(len(data)):
            order = np.argsort(rows, kind="stable")
            data, rows = np.take(data, order), rows[order]
        self._sprites.write(data, offset=self._half * self._capacity * SPRITE_DTYPE.itemsize)
        return rows

    def _in_bands(self, bands: int) -> IntArray:
        """The first of the sprites in the buffer that touches each band and the end of them
        (BANDS, 2).
        """
        if bands == 1 or self._is_few(len(self._rows)):  # all, in any order
            return np.array([[0, len(self._rows)]])
        return np.stack(
            [
                np.searchsorted(self._rows, self._first_row),
                np.searchsorted(self._rows, self._end_row),
            ],
            axis=1,
        )

    def _run(self, ranges: npt.NDArray[np.int32], bands: int) -> None:
        """Make black and draw the sprites in these ranges of the buffer, in as many passes as
        the shader's loops need.
        """
        longest = int((ranges @ np.array([-1, 1, -1, 1])).max())
        if not longest:
            return
        program, (_, height) = self._program, self._size_px
        cast(moderngl.Uniform, program["stars"]).write(ranges)
        program["bands"] = bands
        self._shares.bind()
        self._sprites.bind_to_storage_buffer(0)
        self._light.bind_to_storage_buffer(1)
        rows = -(-min(self._footprint_px, -(-height // bands)) // STEP)
        # rounds for a star: the end of a loop is one too
        rounds = 2 + (rows + 1) + rows * (self._footprint_px + 1)
        at_once = max(MAX_ROUNDS // rounds, 1)
        program["at_once"] = at_once
        for done in range(0, longest, at_once):
            program["done"] = done
            program.run(bands)
            self._ctx.memory_barrier()
        self._ctx.finish()  # before somebody reads the image
