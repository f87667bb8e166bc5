"""Light in whole units, and the compute passes that add it up star by star.

Each pixel's light is a sum of whole units, which is the same in whatever order several threads add to it. A software OpenGL
draws star by star, in a quarter of the time of rasterised sprites; a graphics card blends sprites of the same units.
"""

import math
from functools import partial

import moderngl
import numpy as np

from hilstar.arrays import BoolArray, Float32Array, FloatArray, IntArray
from hilstar.monitor.footprints import PixelOrder
from hilstar.monitor.quantise import RoundQuantiser
from hilstar.render.backend import SpriteSides
from hilstar.render.context import MAX_ROUNDS, MAX_WRITTEN_BYTES
from hilstar.render.encoder import LevelTexture, LookupTable, Planes, Shares, build_compute, level_steps, write
from hilstar.scene.psf import Psf
from hilstar.scene.sprites import Sprites

LOCAL_SIZE = 32  # as in light.comp
STEPS_BINDING, ORDER_BINDING, LIGHT_BINDING, SUMS_BINDING = 1, 2, 2, 7
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
RUN, MAX_RUNS, HALF_OCTAVES = 256, 2048, 32  # runs of stars are sorted by light; runs times half octaves fill 16 bits
STRIP_PX = 64.0
PHASE_PX = 0.1  # a star is at most so far from the middle of its phase


def edges_of(planes: Planes) -> list[Float32Array]:
    """The thresholds of each plane, by which the nearest levels are counted."""
    return [RoundQuantiser.edges_e_per_s(panel) for panel in planes.panels]


class LightUnits:
    """The whole units in which each plane's pixels add up stars, and the ellipse within which a star lights them.

    Whatever draws in these units chooses the same levels. `sides` (see `Target.sides`) say how large sprites are at most, and
    what light of a star alone they may leave out.
    """

    def __init__(self, planes: Planes, size_px: tuple[int, int], psf: Psf, sides: SpriteSides = ()) -> None:
        panel, self._share = planes.lit, planes.share
        self._size_px, self._footprint_px = size_px, planes.footprint_px
        gain = panel.gain()
        low, high = (1.0, 1.0) if gain is None else (float(gain.min()), float(gain.max()))
        thresholds = panel.response.thresholds_e_per_s(panel.flux_at_white_e_per_s)
        self.lit_e_per_s, self._white_e_per_s = float(thresholds[0]) / high, panel.flux_at_white_e_per_s / low
        self.most_e_per_s = [self._white_e_per_s * share for share in planes.share]
        self._peak_share = psf.peak_share
        self.axes_px2, self._share_bound = psf.reach
        self.wings = float(WINGS)
        if sides:  # what part of the light that lights a pixel the squares leave out beside them at most: one in so many
            outside = [self.lit_e_per_s / (side.below_e_per_s * psf.outside_share(side.side_px)) for side in sides]
            fewest = min([wings for wings in outside if wings > ANY_RATE], default=WINGS / SQUARE_WINGS)
            self.wings = SQUARE_WINGS * max(1.0, fewest)
        more_px = planes.footprint_px - psf.footprint_px
        self.side_px = max((side.side_px + more_px for side in sides), default=self._footprint_px)

    @staticmethod
    def takes(planes: Planes, size_px: tuple[int, int]) -> bool:
        """Whether such an image, such sprites and such panels are drawn in units: those that StarPasses can draw.

        A panel's table may have no bin with several thresholds.
        """
        size, side_px = 4 * size_px[0] * size_px[1] * len(planes.panels), planes.footprint_px
        return size <= MAX_WRITTEN_BYTES and side_px * (side_px + 2) <= MAX_ROUNDS and level_steps(edges_of(planes)) is not None

    def unit_for(self, sprites: Sprites | None) -> list[float] | None:
        """The unit of each plane (e-/s) in which no pixel's sum can be too large; None where one is too coarse for its panel.

        A power of two, from the sum of all stars' brightest pixels, of white at most each.
        """
        if sprites is None or not len(sprites):
            return self.most_e_per_s
        rates = np.minimum(sprites.data["electrons_per_s"], np.float32(self._white_e_per_s / self._peak_share))
        most_e_per_s = max(float(rates.sum(dtype=np.float64)) * self._peak_share * 1.000001, self._white_e_per_s)
        units = [2.0 ** math.ceil(math.log2(most_e_per_s * share / (MAX_SUM - len(sprites)))) for share in self._share]
        fine = all(unit <= self.lit_e_per_s * share * MAX_UNIT for unit, share in zip(units, self._share, strict=True))
        return units if fine else None

    def reach_per_e(self, sprites: Sprites, alone: bool = False) -> float:
        """The factor of a star's rate whose logarithm, times `axes_px2`, gives the squared half axes of its ellipse (px2).

        Of one that stands `alone` no pixel beyond it is lit.
        """
        if alone:
            return self._share_bound * sprites.per_star / self.lit_e_per_s
        width, height = self._size_px
        wings = self.wings * (DENSER_WINGS if len(sprites) * self._footprint_px**2 > width * height else 1)
        return self._share_bound * sprites.per_star * wings / self.lit_e_per_s


class StarPasses:
    """Draws sprites into pixels' sums and a LevelTexture; it lives in its renderer's context, which is current in every call.

    With `exact` the sums stay for it to look at. Where a frame has a `floor`, its stars' levels are added to those in light.
    """

    def __init__(self, levels: LevelTexture, planes: Planes, psf: Psf, shares: Shares, exact: bool, units: LightUnits) -> None:
        ctx = self._ctx = levels.texture.ctx
        keep = self._keep = exact or planes.apart
        self._levels, self._planes, self._units, self._shares = levels, planes, units, shares
        self._size_px = levels.texture.size
        self._footprint_px = planes.footprint_px
        gain = planes.panels[0].gain()
        self._gain = None if gain is None else ctx.texture(self._size_px, 1, np.ascontiguousarray(gain), dtype="f4")
        self._sums = ctx.buffer(reserve=4 * math.prod(self._size_px) * len(planes.panels))
        self._sums.clear()
        self._unit_e_per_s: list[float] = []  # units of the sums
        self.sprites = ctx.buffer(reserve=planes.dtype.itemsize, dynamic=True)
        self._drawn: int | None = None  # sprites that are in the buffer and on the images; None: it is not known
        table = level_steps(edges_of(planes))
        if table is None:
            raise ValueError("several thresholds in a bin; ask `LightUnits.takes` first")
        self._steps = LookupTable(ctx, "STEPS", STEPS_BINDING, table[0])
        defines = [f"LEVELS_FORMAT {levels.format}", *planes.defines, *shares.defines, *["KEEP"] * keep]
        defines += ["UNIFORMITY"] * (gain is not None) + self._steps.define
        side, all_px = f"FOOTPRINT {units.side_px}", f"FOOTPRINT {self._footprint_px}"
        files, defines = ["planes.glsl", "shares.glsl", "sums.glsl"], defines + ["ORDER"] * planes.apart
        self.floor: LevelTexture | None = None
        light = planes.panels[0].light_e_per_s()
        self._level_light = LookupTable(ctx, "LIGHT_ROWS", LIGHT_BINDING, np.append(light, light[-1]))

        def built(*part: str) -> moderngl.ComputeShader:
            more, last = ["floor.glsl"] * (len(part) > 2), ["levels.glsl"] * (part[0] == "LEVELS")
            program = build_compute(ctx, "light.comp", [*part, *defines], files + more, last)
            program["resolution_px"], program["reach_px2"] = self._size_px, units.axes_px2
            planes.set(program, bins=table[1], most_e_per_s=units.most_e_per_s)
            shares.set(program)
            return program

        self._light, self._encode, self._black = self._programs = [built("LIGHT", side), built("LEVELS", side), built(all_px)]
        self._encode_on_floor = partial(built, "LEVELS", side, f"FLOOR {levels.format}", *self._level_light.define)
        self._least_reach = 0.5 * PixelOrder(psf).near_sigmas(PHASE_PX) ** 2 if exact else 0.0
        if exact:
            self._black["least_reach"] = self._least_reach
        self._order = ctx.buffer(reserve=4, dynamic=True)
        self._alone = 0  # how many stars stand alone, the first in the order

    @property
    def tables(self) -> list[moderngl.Texture | moderngl.Buffer]:
        """The tables by which light becomes levels."""
        return [self._steps.buffer, self._level_light.buffer, *([] if self._gain is None else [self._gain])]

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

    def lay(self, floor: LevelTexture | None) -> None:
        """Take a frame's floor, which becomes its levels; None for black, which `erase` has drawn."""
        if self.floor is not None and floor is None:
            self.forget(sums=False)
        self.erase()
        self.floor = floor
        if floor is not None:
            self._ctx.copy_framebuffer(self._levels.fbo, floor.fbo)
            floor.texture.bind_to_image(1, read=True, write=False)  # for all passes of the frame
            if len(self._programs) == 3:
                self._programs.append(self._encode_on_floor())

    def upload(self, sprites: Sprites) -> None:
        """Take the sprites that `add_light` and `encode` are about."""
        write(self.sprites, sprites.data)
        self._drawn = len(sprites)
        reach_per_e = self._units.reach_per_e(sprites)
        for program in self._programs:
            program["reach_per_e"] = reach_per_e
        if self._planes.apart:
            self._order_stars(sprites, reach_per_e)

    def _order_stars(self, sprites: Sprites, reach_per_e: float) -> None:
        """Those that stand alone come first, stars of alike light one after another."""
        rates = np.ascontiguousarray(sprites.data["electrons_per_s"])
        crowded = np.ones(len(sprites), dtype=np.bool_)
        if sprites.per_star == 1 and len(sprites) * self._footprint_px**2 < math.prod(self._size_px):  # else few do
            squares = np.maximum(np.log(np.maximum(reach_per_e * rates, 1e-30)), self._least_reach) * max(self._units.axes_px2)
            crowded = crowded_at(sprites.x_px, sprites.y_px, np.sqrt(squares) + math.hypot(*self._planes.margin_px))
        order = turns_of(rates, self._units.lit_e_per_s)
        last = crowded[order]
        order = np.concatenate([order[~last], order[last]]).astype(np.int32)
        write(self._order, order)
        self._alone = len(order) - int(np.count_nonzero(last))
        for program in self._programs:
            program["alone"], program["reach_of_alone_per_e"] = self._alone, self._units.reach_per_e(sprites, alone=True)

    def add_light(self, unit_e_per_s: list[float]) -> None:
        """Add the light of the sprites to their pixels' sums, which are of these units."""
        self._unit_e_per_s = unit_e_per_s
        for program in self._programs:
            self._planes.set(program, unit_e_per_s=unit_e_per_s)
        self._run(self._light, self._alone)

    def encode(self) -> None:
        """Make levels of the sums under the sprites, the nearest."""
        if self._gain is not None:
            self._gain.use(0)
        self._steps.bind()
        if self.floor is not None:
            self._level_light.bind()
        self._run(self._encode if self.floor is None else self._programs[-1])

    def bind_order(self, binding: int) -> int:
        """Bind the order of stars, for another program; how many stand alone, first in it."""
        self._order.bind_to_storage_buffer(binding)
        return self._alone

    def bind_sums(self, program: moderngl.ComputeShader) -> None:
        """Let another program look at the sums (see shaders/sums.glsl)."""
        self._planes.set(program, unit_e_per_s=self._unit_e_per_s)
        self._sums.bind_to_storage_buffer(SUMS_BINDING)

    def _run(self, program: moderngl.ComputeShader, without: int = 0) -> None:
        if not self._drawn or self._drawn == without:
            return
        program["count"] = self._drawn
        if self._planes.apart:
            self._order.bind_to_storage_buffer(ORDER_BINDING)
        self._shares.bind()
        self.sprites.bind_to_storage_buffer(0)
        self._sums.bind_to_storage_buffer(SUMS_BINDING)
        self._levels.texture.bind_to_image(0, read=False, write=True)
        program.run(-(-(self._drawn - without) // LOCAL_SIZE))
        self._ctx.memory_barrier()


def turns_of(electrons_per_s: Float32Array, step_e_per_s: float) -> IntArray:
    """The order (n,) in which sprites go through the pass: in runs of near neighbours, each by light.

    Eight stars go together on a CPU, for as long as the brightest of them needs. A run's own pixels stay in the cache.
    """
    count = len(electrons_per_s)
    runs = max(1, min(count // RUN, MAX_RUNS))
    # A float's exponent and the first bit of its mantissa: in half an octave a star's reach grows by a pixel or two.
    half_octaves = (electrons_per_s.view(np.int32) >> 22) - (np.float32(step_e_per_s).view(np.int32) >> 22)
    key = np.arange(count) * runs // max(count, 1) * HALF_OCTAVES + np.clip(half_octaves, 0, HALF_OCTAVES - 1)
    return np.asarray(np.argsort(key.astype(np.uint16), kind="stable"))  # 16-bit keys are sorted by radix


def crowded_at(x_px: FloatArray, y_px: FloatArray, reach_px: FloatArray) -> BoolArray:
    """Whether the circle of a star, `reach_px` (n,) about it, meets another's, (n,): sought in strips of the image."""
    if not len(x_px):
        return np.zeros(0, dtype=np.bool_)
    low, high = y_px.min(), y_px.max()
    most_px = 2 * float(reach_px.max())  # by which two stars may be apart
    strip, long = np.floor(x_px / max(most_px, STRIP_PX)), high - low + 2 * most_px
    key = strip * long + (y_px - low)
    order = key.argsort()
    x, y, reach, key, crowded = x_px[order], y_px[order], reach_px[order], key[order], np.zeros(len(x_px), dtype=np.bool_)
    count = key.searchsorted(key + (reach + most_px / 2)) - np.arange(1, len(key) + 1)
    pairs = [(np.arange(1, len(key) + 1), np.maximum(count, 0))]
    if strip.max() > strip.min():
        first = key.searchsorted(key + long - most_px)
        pairs.append((first, key.searchsorted(key + long + most_px) - first))
    for first, count in pairs:
        end = count.cumsum()
        one = np.repeat(np.arange(len(key)), count)
        other = np.arange(end[-1]) + np.repeat(first - (end - count), count)
        meet = (x[one] - x[other]) ** 2 + (y[one] - y[other]) ** 2 <= (reach[one] + reach[other]) ** 2
        crowded[one[meet]] = crowded[other[meet]] = True
    return np.asarray(crowded[order.argsort()])
