"""Light in whole units, and the compute passes that add it up star by star.

Each pixel's light is a sum of whole units, which is the same in whatever order several threads add to it. A software OpenGL
draws star by star, in a quarter of the time of rasterised sprites; a graphics card blends sprites of the same units.
"""

import math

import moderngl
import numpy as np

from hilstar.monitor.footprints import PixelOrder
from hilstar.monitor.quantise import Panel, code_table
from hilstar.render.backend import SpriteSides
from hilstar.render.context import MAX_ROUNDS, MAX_WRITTEN_BYTES
from hilstar.render.encoder import LevelTexture, LookupTable, Shares, build_compute
from hilstar.scene.psf import Psf
from hilstar.scene.sprites import SPRITE_DTYPE, Sprites

LOCAL_SIZE = 32  # as in light.comp
STEPS_BINDING, SUMS_BINDING = 1, 7
MAX_SUM = 2**31 - 2**24  # what an int holds, less what a float32 that large is rounded by
# Share of the first level's light. Where stars are so many and so bright that a unit would be more, their light is blended.
MAX_UNIT = 1 / 64
# A star's light ends where a pixel has one part in WINGS of what lights one, and where footprints cover the whole image one in
# WINGS * DENSER_WINGS. A star alone has the same levels; of 10 000 on 1080p eleven of 82 000 lit pixels are one level lower,
# where wings meet, and of 50 000 one in seven thousand.
WINGS, DENSER_WINGS = 128, 8
# A square that is large enough at its worst phase, and in its corners, leaves out as little as an ellipse with so many times
# the wings: with 4, streaks at 10 deg/s were off by 1.4 arcsec rms and 0.004 mag, by squares 0.6 and 0.001.
SQUARE_WINGS = 16
# Share of the image: where footprints cover more, a clear of levels and sums is faster (llvmpipe, 1080p and 4K).
MAX_ERASED = 0.1
MAX_ERASED_KEPT = 0.1  # with the sums, and all pixels among which `exact` chooses
ANY_RATE = 1e-6  # the largest side of all, for stars of any rate, has fewer wings
PHASE_PX = 0.1  # a star is at most so far from the middle of its phase


class LightUnits:
    """The whole units in which a panel's pixels add up stars, and the ellipse within which a star lights them.

    Whatever draws in these units chooses the same levels. `sides` (see `Target.sides`) say how large sprites are at most, and
    what light of a star alone they may leave out.
    """

    def __init__(self, panel: Panel, size_px: tuple[int, int], psf: Psf, sides: SpriteSides = ()) -> None:
        self._size_px, self._footprint_px = size_px, psf.footprint_px
        gain = panel.gain()
        low, high = (1.0, 1.0) if gain is None else (float(gain.min()), float(gain.max()))
        thresholds = panel.response.thresholds_e_per_s(panel.flux_at_white_e_per_s)
        self._lit_e_per_s, self.white_e_per_s = float(thresholds[0]) / high, panel.flux_at_white_e_per_s / low
        self._peak_share = psf.peak_share
        self.axes_px2, self._share_bound = psf.reach
        self.wings = float(WINGS)
        if sides:  # what part of the light that lights a pixel the squares leave out beside them at most: one in so many
            outside = [self._lit_e_per_s / (side.below_e_per_s * psf.outside_share(side.side_px)) for side in sides]
            fewest = min([wings for wings in outside if wings > ANY_RATE], default=WINGS / SQUARE_WINGS)
            self.wings = SQUARE_WINGS * max(1.0, fewest)
        self.side_px = max((side.side_px for side in sides), default=self._footprint_px)

    @staticmethod
    def takes(panel: Panel, size_px: tuple[int, int], footprint_px: int) -> bool:
        """Whether such an image, such sprites and such a panel are drawn in units: those that StarPasses can draw.

        The panel's table may have no bin with several thresholds.
        """
        if 4 * size_px[0] * size_px[1] > MAX_WRITTEN_BYTES or footprint_px * (footprint_px + 2) > MAX_ROUNDS:
            return False
        return code_table(panel.response.thresholds_e_per_s(panel.flux_at_white_e_per_s)).steps() is not None

    def unit_for(self, sprites: Sprites | None) -> float | None:
        """The unit (e-/s) in which no pixel's sum of these sprites can be too large; None where it is too coarse for the panel.

        A power of two, from the sum of all stars' brightest pixels, of white at most each.
        """
        if sprites is None or not len(sprites):
            return self.white_e_per_s
        rates = np.minimum(sprites.data["electrons_per_s"], np.float32(self.white_e_per_s / self._peak_share))
        most_e_per_s = max(float(rates.sum(dtype=np.float64)) * self._peak_share * 1.000001, self.white_e_per_s)
        unit = 2.0 ** math.ceil(math.log2(most_e_per_s / (MAX_SUM - len(sprites))))
        return unit if unit <= self._lit_e_per_s * MAX_UNIT else None

    def reach_per_e(self, sprites: Sprites) -> float:
        """The factor of a star's rate whose logarithm, times `axes_px2`, gives the squared half axes of its ellipse (px2)."""
        width, height = self._size_px
        wings = self.wings * (DENSER_WINGS if len(sprites) * self._footprint_px**2 > width * height else 1)
        return self._share_bound * sprites.per_star * wings / self._lit_e_per_s


class StarPasses:
    """Draws sprites into pixels' sums and a LevelTexture; it lives in its renderer's context, which is current in every call.

    With `keep` the sums stay for `exact` to look at.
    """

    def __init__(self, levels: LevelTexture, panel: Panel, psf: Psf, shares: Shares, keep: bool, units: LightUnits) -> None:
        ctx = self._ctx = levels.texture.ctx
        self._levels, self._keep, self._units, self._shares = levels, keep, units, shares
        self._size_px = levels.texture.size
        self._footprint_px = psf.footprint_px
        gain = panel.gain()
        self._gain = None if gain is None else ctx.texture(self._size_px, 1, np.ascontiguousarray(gain), dtype="f4")
        thresholds = panel.response.thresholds_e_per_s(panel.flux_at_white_e_per_s)
        self._sums = ctx.buffer(np.zeros(self._size_px[0] * self._size_px[1], dtype=np.int32))
        self._unit_e_per_s = 0.0  # unit of the sums
        self.sprites = ctx.buffer(reserve=SPRITE_DTYPE.itemsize, dynamic=True)
        self._drawn: int | None = None  # sprites that are in the buffer and on the images; None: it is not known
        table = code_table(thresholds)
        steps = table.steps()
        if steps is None:
            raise ValueError("several thresholds in a bin; ask `LightUnits.takes` first")
        self._steps = LookupTable(ctx, "STEPS", STEPS_BINDING, steps)
        texel = {"u1": "r8ui", "u2": "r16ui"}[levels.texture.dtype]
        defines = [f"LEVELS_FORMAT {texel}", f"BIN_SHIFT {table.bin_shift}", *shares.defines, *["KEEP"] * keep]
        defines += ["UNIFORMITY"] * (gain is not None) + self._steps.define
        side, all_px = f"FOOTPRINT {units.side_px}", f"FOOTPRINT {self._footprint_px}"
        self._light, self._encode, self._black = (
            build_compute(ctx, "light.comp", [*part, *defines], ("shares", "sums"))
            for part in (["LIGHT", side], ["LEVELS", side], [all_px])
        )
        for program in (self._light, self._encode, self._black):
            program["resolution_px"], program["reach_px2"] = self._size_px, units.axes_px2
        if keep:
            self._black["least_reach"] = 0.5 * PixelOrder(psf).near_sigmas(PHASE_PX) ** 2
        shares.set(self._light)
        self._light["most_e_per_s"] = units.white_e_per_s
        self._encode["lowest"] = (table.first_bin - 1) << table.bin_shift
        self._encode["highest"] = ((table.first_bin + len(table.first_code)) << table.bin_shift) - 1

    @property
    def tables(self) -> list[moderngl.Texture | moderngl.Buffer]:
        """The tables by which light becomes levels."""
        return [self._steps.buffer, *([] if self._gain is None else [self._gain])]

    def forget(self, sums: bool) -> None:
        """The next `erase` makes all levels black: something else has drawn on them. With `sums`, those may be lost too."""
        self._drawn = None
        if sums:
            self._sums.clear()

    def erase(self) -> None:
        """Make black what the last frame drew."""
        most_px = (MAX_ERASED_KEPT if self._keep else MAX_ERASED) * self._size_px[0] * self._size_px[1]
        if self._drawn is None or self._drawn * self._footprint_px**2 > most_px:
            if self._keep:
                self._sums.clear()
            self._levels.fbo.use()
            self._levels.fbo.clear()
        else:
            self._run(self._black)
        self._drawn = 0

    def upload(self, sprites: Sprites) -> None:
        """Take the sprites that `add_light` and `encode` are about."""
        size = len(sprites) * SPRITE_DTYPE.itemsize
        if self.sprites.size < size:
            self.sprites.release()
            self.sprites = self._ctx.buffer(reserve=2 * size, dynamic=True)
        self.sprites.orphan()
        self.sprites.write(sprites.data)
        self._drawn = len(sprites)
        reach_per_e = self._units.reach_per_e(sprites)
        for program in (self._light, self._encode, self._black):
            program["reach_per_e"] = reach_per_e

    def add_light(self, unit_e_per_s: float) -> None:
        """Add the light of the sprites to their pixels' sums, which are of that unit."""
        self._unit_e_per_s = self._light["unit_e_per_s"] = self._encode["unit_e_per_s"] = unit_e_per_s
        self._run(self._light)

    def encode(self) -> None:
        """Make levels of the sums under the sprites, the nearest."""
        if self._gain is not None:
            self._gain.use(0)
        self._steps.bind()
        self._run(self._encode)

    def bind_sums(self, program: moderngl.ComputeShader) -> None:
        """Let another program look at the sums (see shaders/sums.glsl)."""
        program["unit_e_per_s"] = self._unit_e_per_s
        self._sums.bind_to_storage_buffer(SUMS_BINDING)

    def _run(self, program: moderngl.ComputeShader) -> None:
        if not self._drawn:
            return
        program["count"] = self._drawn
        self._shares.bind()
        self.sprites.bind_to_storage_buffer(0)
        self._sums.bind_to_storage_buffer(SUMS_BINDING)
        self._levels.texture.bind_to_image(0, read=False, write=True)
        program.run(-(-self._drawn // LOCAL_SIZE))
        self._ctx.memory_barrier()
