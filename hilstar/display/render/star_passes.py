"""Light in whole units, and the compute passes that add it up star by star.

Each pixel's light is a sum of whole units, which is the same in whatever order several threads add
to it. A software OpenGL draws star by star, in a quarter of the time of rasterised sprites; a
graphics card blends sprites of the same units.
"""

import math
from collections.abc import Sequence

import moderngl
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from hilstar.basics.arrays import BoolArray, Float32Array, FloatArray, IntArray
from hilstar.display.footprints import PixelOrder
from hilstar.display.quantise import RoundQuantiser, ThresholdCounter
from hilstar.display.render.backend import SpriteSides
from hilstar.display.render.context import MAX_ROUNDS, MAX_WRITTEN_BYTES, pinned
from hilstar.display.render.encoder import (
    LevelTexture,
    LookupTable,
    Planes,
    Shares,
    build_compute,
    level_steps,
    set_uniforms,
    write,
)
from hilstar.optics.psf import Psf
from hilstar.optics.sprites import FrameLight

LOCAL_SIZE = 32  # as in light.comp
STEPS_BINDING, ORDER_BINDING, TURNS_BINDING, SUMS_BINDING, LEVELS_BINDING = 1, 2, 3, 7, 8
MAX_SUM = 2**31 - 2**24  # what an int holds, less what a float32 that large is rounded by
# Share of the first level's light. Where stars are so many and so bright that a unit would be more,
# their light is blended.
MAX_UNIT = 1 / 64
# A star's light ends where a pixel has one part in WINGS of what lights one, and where footprints
# cover the whole image one in WINGS * DENSER_WINGS. A star alone has the same levels; of 10 000 on
# 1080p eleven of 82 000 lit pixels are one level lower, where wings meet, and of 50 000 one in
# seven thousand.
WINGS, DENSER_WINGS = 128, 8
# A square that is large enough at its worst phase, and in its corners, leaves out as little as an
# ellipse with so many times the wings: with 4, streaks at 10 deg/s were off by 1.4 arcsec rms and
# 0.004 mag, by squares 0.6 and 0.001.
SQUARE_WINGS = 16
# Share of the image: where footprints cover more, all of it is made black and looked through faster
# (llvmpipe, 1080p and 4K).
MAX_GATHERED = 0.1
NOWHERE = (np.empty(0, dtype=np.intp),) * 2
ANY_RATE = 1e-6  # the largest side of all, for stars of any rate, has fewer wings
# runs of stars are sorted by light; runs times half octaves fill 16 bits
RUN, MAX_RUNS, HALF_OCTAVES = 256, 2048, 32
STRIP_PX = 64.0
PHASE_PX = 0.1  # a star is at most so far from the middle of its phase


def edges_of(planes: Planes) -> list[Float32Array]:
    """The thresholds of each plane, by which the nearest levels are counted."""
    return [RoundQuantiser.edges_e_per_s(panel) for panel in planes.panels]


class LightUnits:
    """The whole units in which each plane's pixels add up stars, and the ellipse within which a
    star lights them.

    Whatever draws in these units chooses the same levels. `sides` (see `Target.sides`) say how
    large sprites are at most, and what light of a star alone they may leave out.
    """

    def __init__(
        self, planes: Planes, size_px: tuple[int, int], psf: Psf, sides: SpriteSides = ()
    ) -> None:
        panel, self._share = planes.lit, planes.share
        self._size_px, self._footprint_px = size_px, planes.footprint_px
        gain = panel.gain()
        low, high = (1.0, 1.0) if gain is None else (float(gain.min()), float(gain.max()))
        thresholds = panel.response.thresholds_e_per_s(panel.flux_at_white_e_per_s)
        self.lit_e_per_s, self._white_e_per_s = (
            float(thresholds[0]) / high,
            panel.flux_at_white_e_per_s / low,
        )
        self.most_e_per_s = [self._white_e_per_s * share for share in planes.share]
        self._peak_share = psf.peak_share
        self.axes_px2, self._share_bound = psf.reach
        self.wings = float(WINGS)
        # what part of the light that lights a pixel the squares leave out beside them at most: one
        # in so many
        if sides:
            outside = [
                self.lit_e_per_s / (side.below_e_per_s * psf.outside_share(side.side_px))
                for side in sides
            ]
            fewest = min(
                [wings for wings in outside if wings > ANY_RATE], default=WINGS / SQUARE_WINGS
            )
            self.wings = SQUARE_WINGS * max(1.0, fewest)
        more_px = planes.footprint_px - psf.footprint_px
        self.side_px = max((side.side_px + more_px for side in sides), default=self._footprint_px)

    @staticmethod
    def takes(planes: Planes, size_px: tuple[int, int]) -> bool:
        """Whether such an image, such sprites and such panels are drawn in units: those that
        StarPasses can draw.

        A panel's table may have no bin with several thresholds.
        """
        size, side_px = 4 * size_px[0] * size_px[1] * len(planes.panels), planes.footprint_px
        return (
            size <= MAX_WRITTEN_BYTES
            and side_px * (side_px + 2) <= MAX_ROUNDS
            and level_steps(edges_of(planes)) is not None
        )

    def unit_for(self, sprites: FrameLight | None) -> list[float] | None:
        """The unit of each plane (e-/s) in which no pixel's sum can be too large; None where one is
        too coarse for its panel.

        A power of two, from the sum of all stars' brightest pixels, of white at most each.
        """
        if sprites is None or not len(sprites):
            return self.most_e_per_s
        rates = np.minimum(
            sprites.data["electrons_per_s"], np.float32(self._white_e_per_s / self._peak_share)
        )
        most_e_per_s = max(
            float(rates.sum(dtype=np.float64)) * self._peak_share * 1.000001, self._white_e_per_s
        )
        units = [
            2.0 ** math.ceil(math.log2(most_e_per_s * share / (MAX_SUM - len(sprites))))
            for share in self._share
        ]
        fine = all(
            unit <= self.lit_e_per_s * share * MAX_UNIT
            for unit, share in zip(units, self._share, strict=True)
        )
        return units if fine else None

    def reach_per_e(self, sprites: FrameLight, alone: bool = False) -> float:
        """The factor of a star's rate whose logarithm, times `axes_px2`, gives the squared half
        axes of its ellipse (px2).

        Of one that stands `alone` no pixel beyond it is lit.
        """
        denser = (
            DENSER_WINGS if len(sprites) * self._footprint_px**2 > math.prod(self._size_px) else 1
        )
        return (
            self._share_bound
            * sprites.per_star
            * (1.0 if alone else self.wings * denser)
            / self.lit_e_per_s
        )


class StarPasses:
    """Draws sprites into pixels' sums and a LevelTexture; it lives in its renderer's context, which
    is current in every call.

    A compute shader adds up the light of one plane in NumPy's own memory. NumPy makes levels of the
    sums that light a pixel, of 10 000 stars in a third of the time of another pass over stars. The
    sums stay for `exact` to look at. Where a frame has a `floor`, its stars' levels are added to
    those in light.
    """

    def __init__(
        self,
        levels: LevelTexture,
        planes: Planes,
        shares: Shares,
        units: LightUnits,
        exact_psf: Psf | None,
    ) -> None:
        ctx = self._ctx = levels.texture.ctx
        self._levels, self._planes, self._units, self._shares = levels, planes, units, shares
        width, height = self._size_px = levels.texture.size
        self._footprint_px, self._gain, (edges, *_) = (
            planes.footprint_px,
            planes.panels[0].gain(),
            edges_of(planes),
        )
        self._counter = ThresholdCounter(edges)
        self._dark_e_per_s = (
            float(edges[0]) / (1.0 if self._gain is None else float(self._gain.max())) * (1 - 1e-6)
        )
        sums, self._sums = pinned(ctx, (height, width * len(planes.panels)), np.int32)
        self._unit_e_per_s: list[float] = []  # units of the sums
        self.sprites = ctx.buffer(reserve=planes.dtype.itemsize, dynamic=True)
        self._drawn = 0  # sprites in the buffer
        side_px = min(self._footprint_px, width, height)
        self._square = np.add.outer(width * np.arange(side_px), np.arange(side_px)).ravel()
        self._images = sums, levels.image.reshape(height, -1)
        wide = [image.shape[1] // width * side_px for image in self._images]
        self._squares = [
            sliding_window_view(image, (side_px, wide[k]), writeable=True)
            for k, image in enumerate(self._images)
        ]
        # row and column of the squares about sprites; None: anywhere
        self._corner: tuple[IntArray, IntArray] | None = None
        self._alone = 0  # how many stars need no sums, the first in an order
        self._programs = [self._program("LIGHT", f"FOOTPRINT {units.side_px}")]
        # by which light becomes levels, on the GPU
        self.tables: list[moderngl.Texture | moderngl.Buffer] = []
        self.floor: LevelTexture | None = None
        self._level_light = planes.panels[0].light_e_per_s()

    def _program(self, *defines: str, last: Sequence[str] = ()) -> moderngl.ComputeShader:
        """A program of light.comp."""
        defines = (*defines, *self._levels.defines, *self._planes.defines, *self._shares.defines)
        program = build_compute(
            self._ctx, "light.comp", defines, ("planes.glsl", "shares.glsl", "sums.glsl"), last
        )
        program["resolution_px"], program["reach_px2"] = self._size_px, self._units.axes_px2
        self._planes.set(program, most_e_per_s=self._units.most_e_per_s)
        self._shares.set(program)
        return program

    def forget(self) -> None:
        """The next `lay` makes all levels and sums black: something else has drawn on them, or
        they may be lost.
        """
        self._corner, self._levels.in_memory = None, False

    def lay(self, floor: LevelTexture | None) -> None:
        """Make black what the last frame drew, and take a frame's floor, which becomes its
        levels; None for black.
        """
        corner = None if floor is None and self.floor is not None else self._corner
        self.floor, self._levels.in_memory, self._corner = floor, True, NOWHERE
        for image, squares in zip(self._images, self._squares, strict=True):
            if corner is None:
                image.fill(0)
            else:
                squares[corner[0], image.shape[1] // self._size_px[0] * corner[1]] = 0
        if floor is not None:
            self._levels.image[..., 0] = floor.read()
            floor.texture.bind_to_image(1, read=True, write=False)  # for all passes of the frame

    def upload(self, sprites: FrameLight) -> None:
        """Take the sprites that `add_light` and `encode` are about."""
        write(self.sprites, sprites.data)
        self._drawn = len(sprites)
        for program in self._programs:
            program["reach_per_e"] = self._units.reach_per_e(sprites)
        (width, height), side_px, self._corner = self._size_px, self._footprint_px, None
        if len(sprites) * side_px**2 <= MAX_GATHERED * width * height and side_px <= min(
            width, height
        ):
            x, y = np.clip(
                sprites.data["pixel"] - (side_px - 1) // 2, 0, (width - side_px, height - side_px)
            ).T
            self._corner = y, x

    def add_light(self, unit_e_per_s: list[float]) -> None:
        """Add the light of the sprites to their pixels' sums, which are of these units."""
        self._unit_e_per_s = unit_e_per_s
        self._run(self._programs[0], self._alone)

    def encode(self) -> None:
        """Make levels of the sums under the sprites, the nearest."""
        sums = (self._images[0] if self._corner is None else self._squares[0][self._corner]).ravel()
        least = 1 if self.floor is not None else int(self._dark_e_per_s / self._unit_e_per_s[0])
        places = lit = np.flatnonzero(sums >= least)
        if self._corner is not None:
            star, at = np.divmod(lit, len(self._square))
            places = (self._corner[0] * self._size_px[0] + self._corner[1])[star] + self._square[at]
        light = sums[lit].astype(np.float32) * np.float32(self._unit_e_per_s[0])
        if self._gain is not None:
            light *= self._gain.ravel()[places]
        levels = self._levels.image.reshape(-1)
        if self.floor is not None:
            light += self._level_light[levels[places]]
        levels[places] = self._counter.count(light)

    def bind(self, program: moderngl.ComputeShader) -> None:
        """Let another program look at the sums (see shaders/sums.glsl) and change levels."""
        self._planes.set(program, unit_e_per_s=self._unit_e_per_s)
        for binding, buffer in (
            (0, self.sprites),
            (SUMS_BINDING, self._sums),
            (LEVELS_BINDING, self._levels.memory),
        ):
            if buffer is not None:
                buffer.bind_to_storage_buffer(binding)

    def _run(self, program: moderngl.ComputeShader, without: int = 0) -> None:
        if self._drawn == without:
            return
        self.bind(program)
        program["count"] = self._drawn
        self._shares.bind()
        program.run(-(-(self._drawn - without) // LOCAL_SIZE))
        self._ctx.memory_barrier()
        self._ctx.finish()  # before NumPy looks at the sums


class ApartPasses(StarPasses):
    """The same for the planes of primaries: the shader makes the levels, those of stars that stand
    alone without sums.

    There each pixel's three levels lie beside each other, which NumPy would look for three times.
    """

    def __init__(
        self,
        levels: LevelTexture,
        planes: Planes,
        shares: Shares,
        units: LightUnits,
        exact_psf: Psf | None,
    ) -> None:
        super().__init__(levels, planes, shares, units, exact_psf)
        table, gain = level_steps(edges_of(planes)), self._gain
        if table is None:
            raise ValueError("several thresholds in a bin; ask `LightUnits.takes` first")
        self._steps = LookupTable(self._ctx, "STEPS", STEPS_BINDING, table[0])
        self._gains = (
            None
            if gain is None
            else self._ctx.texture(self._size_px, 1, np.ascontiguousarray(gain), dtype="f4")
        )
        of_levels = (
            "LEVELS",
            f"FOOTPRINT {units.side_px}",
            *self._steps.define,
            *["UNIFORMITY"] * (gain is not None),
        )
        self._programs.append(self._program(*of_levels, last=["levels.glsl"]))
        planes.set(self._programs[1], bins=table[1])
        self._least_reach = (
            0.0 if exact_psf is None else 0.5 * PixelOrder(exact_psf).near_sigmas(PHASE_PX) ** 2
        )
        self._order = self._ctx.buffer(reserve=4, dynamic=True)
        self.tables += [self._steps.buffer, *([] if self._gains is None else [self._gains])]

    def upload(self, sprites: FrameLight) -> None:
        """Take the sprites that `add_light` and `encode` are about: those alone come first,
        alike light one after another.
        """
        super().upload(sprites)
        reach_per_e, rates = (
            self._units.reach_per_e(sprites),
            np.ascontiguousarray(sprites.data["electrons_per_s"]),
        )
        crowded = np.ones(len(sprites), dtype=np.bool_)
        # else few do
        if sprites.per_star == 1 and len(sprites) * self._footprint_px**2 < math.prod(
            self._size_px
        ):
            squares = np.maximum(
                np.log(np.maximum(reach_per_e * rates, 1e-30)), self._least_reach
            ) * max(self._units.axes_px2)
            crowded = crowded_at(
                sprites.x_px, sprites.y_px, np.sqrt(squares) + math.hypot(*self._planes.margin_px)
            )
        order = turns_of(rates, self._units.lit_e_per_s)
        last = crowded[order]
        order = np.concatenate([order[~last], order[last]]).astype(np.int32)
        write(self._order, order)
        self._alone = len(order) - int(np.count_nonzero(last))
        for program in self._programs:
            program["alone"], program["reach_of_alone_per_e"] = (
                self._alone,
                self._units.reach_per_e(sprites, alone=True),
            )

    def encode(self) -> None:
        """Make levels of the sums under the sprites, the nearest."""
        if self._gains is not None:
            self._gains.use(0)
        self._steps.bind()
        self._run(self._programs[1])

    def bind(self, program: moderngl.ComputeShader) -> None:
        """Let another program look at the sums, and take the stars in their order."""
        super().bind(program)
        self._order.bind_to_storage_buffer(TURNS_BINDING)
        set_uniforms(program, {"alone": self._alone})

    def _run(self, program: moderngl.ComputeShader, without: int = 0) -> None:
        self._order.bind_to_storage_buffer(ORDER_BINDING)
        super()._run(program, without)


def turns_of(electrons_per_s: Float32Array, step_e_per_s: float) -> IntArray:
    """The order (n,) in which sprites go through the pass: in runs of near neighbours, each by
    light.

    Eight stars go together on a CPU, for as long as the brightest of them needs. A run's own pixels
    stay in the cache.
    """
    count = len(electrons_per_s)
    runs = max(1, min(count // RUN, MAX_RUNS))
    # A float's exponent and the first bit of its mantissa: in half an octave a star's reach grows
    # by a pixel or two.
    half_octaves = (electrons_per_s.view(np.int32) >> 22) - (
        np.float32(step_e_per_s).view(np.int32) >> 22
    )
    key = np.arange(count) * runs // max(count, 1) * HALF_OCTAVES + np.clip(
        half_octaves, 0, HALF_OCTAVES - 1
    )
    # 16-bit keys are sorted by radix
    return np.asarray(np.argsort(key.astype(np.uint16), kind="stable"))


def crowded_at(x_px: FloatArray, y_px: FloatArray, reach_px: FloatArray) -> BoolArray:
    """Whether the circle of a star, `reach_px` (n,) about it, meets another's, (n,): sought in
    strips of the image.
    """
    low, high = y_px.min(), y_px.max()
    most_px = 2 * float(reach_px.max())  # by which two stars may be apart
    strip, long = np.floor(x_px / max(most_px, STRIP_PX)), high - low + 2 * most_px
    key = strip * long + (y_px - low)
    order = key.argsort()
    x, y, reach, key, crowded = (
        x_px[order],
        y_px[order],
        reach_px[order],
        key[order],
        np.zeros(len(x_px), dtype=np.bool_),
    )
    count = key.searchsorted(key + (reach + most_px / 2)) - np.arange(1, len(key) + 1)
    pairs = [(np.arange(1, len(key) + 1), np.maximum(count, 0))]
    if strip.max() > strip.min():
        first = key.searchsorted(key + long - most_px)
        pairs.append((first, key.searchsorted(key + long + most_px) - first))
    for first, count in pairs:
        end = count.cumsum()
        one = np.repeat(np.arange(len(key)), count)
        other = np.arange(end[-1]) + np.repeat(first - (end - count), count)
        meet = (x[one] - x[other]) ** 2 + (y[one] - y[other]) ** 2 <= (
            reach[one] + reach[other]
        ) ** 2
        crowded[one[meet]] = crowded[other[meet]] = True
    return np.asarray(crowded[order.argsort()])
