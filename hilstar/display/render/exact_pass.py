"""An ExactQuantiser on the GPU: after the nearest levels are drawn, a compute pass chooses each
star's together.

With `temporal` what each star leaves is kept on the GPU from frame to frame.
"""

import math
from collections.abc import Sequence
from typing import Any

import moderngl
import numpy as np
import numpy.typing as npt

from hilstar.basics.arrays import Float32Array, FloatArray, IntArray
from hilstar.display.balance import SUMS, Balance
from hilstar.display.exact import CARRIED, ExactQuantiser, Left
from hilstar.display.footprints import LEAST_LIGHT, REACH_SIGMA, PixelOrder
from hilstar.display.panel import Panel
from hilstar.display.render.context import pinned
from hilstar.display.render.encoder import (
    LevelTexture,
    LookupTable,
    Shares,
    build_compute,
    set_uniforms,
    write,
)
from hilstar.display.render.target import Target
from hilstar.display.temporal import NONE_BEFORE, first_phases, places_before
from hilstar.optics.psf import PIXEL_VARIANCE
from hilstar.optics.sprites import SPRITE_DTYPE, FrameLight

IN_BOX = 1023  # what a pixel's part in a box is counted in: ten bits
# Narrower sprites have moments of their pixels: exp(-2 pi^2 sigma^2) / pi px, here 5e-6, of
# thousands of steps of light.
NARROW_PX = 0.75
OVERRATED = 1.0001  # rounding
PARTS = (
    "floor.glsl",
    "exact/inputs.glsl",
    "shares.glsl",
    "exact/stars.glsl",
    "exact/pixels.glsl",
    "exact/choices.glsl",
)
LOCAL_SIZE = 32  # as in exact.comp
TURNS_BINDING, SUMS_BINDING, LEVELS_BINDING = 3, 7, 8
# runs of stars are sorted by light; runs times half octaves fill 16 bits
RUN, MAX_RUNS, HALF_OCTAVES = 256, 2048, 32
FIRST_BINDING = 4  # first binding of a Memory's buffers, and of what panels before left
LEFT_BINDING = 6
BEGIN_DTYPE = np.dtype([("before", "<i4"), ("phase", "<f4")])
SUMS_BYTES = 4 * SUMS


class PixelSums:
    """Sprites, sums of light and levels that `cpu_stars` has drawn, as compute shaders read them.

    `values` int32 (n,) are the sums, in memory that this GL shares. It lives in its renderer's
    context, which is current in every call.
    """

    def __init__(self, levels: LevelTexture) -> None:
        ctx = levels.texture.ctx
        self._levels = levels
        self.values, self._memory = pinned(ctx, (math.prod(levels.texture.size),), np.int32)
        self.sprites = ctx.buffer(reserve=SPRITE_DTYPE.itemsize, dynamic=True)
        self.floor: LevelTexture | None = None
        self._unit_e_per_s = 0.0

    def upload(self, sprites: FrameLight, unit_e_per_s: float, floor: LevelTexture | None) -> None:
        """Take the sprites of a frame, the unit of its sums, and the floor that it stands on."""
        write(self.sprites, sprites.data)
        self._unit_e_per_s = unit_e_per_s
        self.floor = floor

    def bind(self, program: moderngl.ComputeShader) -> None:
        """Let a program look at the sums (see shaders/sums.glsl) and change levels."""
        set_uniforms(program, {"unit_e_per_s": self._unit_e_per_s})
        self._memory.bind_to_storage_buffer(SUMS_BINDING)
        if self._levels.memory is not None:
            self._levels.memory.bind_to_storage_buffer(LEVELS_BINDING)
        if self.floor is not None:
            self.floor.texture.bind_to_image(1, read=True, write=False)


class ExactPass:
    """Chooses the levels of stars by a compute shader, on a LevelTexture that has the nearest
    levels.

    `before` are the passes of the panels before, for whose errors stars make up as the target's
    `turn` has it. It lives in its renderer's context.
    """

    def __init__(
        self,
        quantiser: type[ExactQuantiser],
        target: Target,
        panel: Panel,
        before: Sequence["ExactPass"],
        *,
        linear: moderngl.Texture,
        levels: LevelTexture,
        shares: Shares,
    ) -> None:
        ctx = self._ctx = linear.ctx
        self._turn = target.turn
        self._before = before
        # What the last frame's stars leave to the next panel, and how many they are: none where
        # they are paths, or where NumPy has drawn them.
        self._over = ctx.buffer(reserve=SUMS_BYTES, dynamic=True)
        self._over_count = 0
        balance = Balance(target.psf, target.seen, quantiser.weights)
        self._linear = linear
        self._levels = levels.texture
        self._level_defines = levels.defines
        self._pixels = PixelOrder(balance.psf)
        self._shares = shares
        light = panel.light_e_per_s()
        self._order = LookupTable(ctx, "ORDER_ROWS", 1, _places(self._pixels, balance).ravel())
        self._light = LookupTable(ctx, "LIGHT_ROWS", 2, np.append(light, light[-1]))
        gain = panel.gain()
        self._gain: moderngl.Texture | None = None
        if gain is not None:
            self._gain = ctx.texture(linear.size, 1, np.ascontiguousarray(gain), dtype="f4")
        self._memory = Memory(ctx) if quantiser.remembers else None
        self._step_e_per_s = float(light[1])
        self._turns = ctx.buffer(reserve=4, dynamic=True)
        self._quantiser = quantiser
        self._panel = panel
        self._balance = balance
        self._programs: dict[tuple[bool, bool, bool], moderngl.ComputeShader] = {}

    def _program(self, paths: bool, summed: bool, floor: bool) -> moderngl.ComputeShader:
        """The program for stars or paths, whose light is summed, on a `floor` of levels or not,
        or in the linear image.
        """
        key = paths, summed, floor
        if key not in self._programs:
            program = self._build(paths, summed, floor)
            self._shares.set(program)
            for values in (self._reach(paths), self._light_of_panel(), self._weights()):
                set_uniforms(program, values)
            self._programs[key] = program
        return self._programs[key]

    def _build(self, paths: bool, summed: bool, floor: bool) -> moderngl.ComputeShader:
        """The program, without the values of its uniforms."""
        order = self._pixels
        before = 0 if paths else len(self._before)
        defines = [
            f"NEAR {order.near}",
            f"KEPT {self._turn.kept}",
            f"BEFORE {before}",
            *self._level_defines,
            *self._shares.defines,
        ]
        defines += [
            f"SIZE {order.size}",
            f"FIRST ({order.first})",
            *self._order.define,
            *self._light.define,
        ]
        whether = {
            "LEAVES": self._turn.is_followed and not paths,
            "NARROW": min(self._balance.psf.width_px) < NARROW_PX,
            "PATHS": paths,
            "UNIFORMITY": self._gain is not None,
            "TEMPORAL": self._memory is not None,
            "SUMS": summed,
            "FLOOR": floor,
        }
        defines += [name for name, is_so in whether.items() if is_so]
        files = (*["sums.glsl"] * summed, *PARTS)
        return build_compute(self._ctx, self._quantiser.shader, defines, files)

    def _reach(self, paths: bool) -> dict[str, Any]:
        """Uniforms: which pixels are a star's, and how many of them are chosen."""
        order = self._pixels
        psf = self._balance.psf
        least_e_per_s = order.area_px2 * LEAST_LIGHT * float(self._panel.light_e_per_s()[1])
        variance_x, variance_y = psf.variance_px2
        return {
            "footprint": order.size**2,
            "overrated": overrated(psf.width_px) if paths else OVERRATED,
            "reach_px2": order.area_px2,
            "reach_per_e": 1 / least_e_per_s,
            "fewest": self._quantiser.fewest(order),
            "resolution_px": self._linear.size,
            "odd": order.bias,
            "half_inverse_spread2": (0.5 / variance_x, 0.5 / variance_y),
        }

    def _light_of_panel(self) -> dict[str, Any]:
        """Uniforms: the panel's levels, and the unit of its gain, which is bound there."""
        panel = self._panel
        threshold = panel.response.threshold[0]
        return {
            "white": panel.response.white,
            "first_threshold_e_per_s": float(threshold * panel.flux_at_white_e_per_s),
            "gain": 0,
        }

    def _weights(self) -> dict[str, Any]:
        """Uniforms: the weights of the ten sums."""
        balance = self._balance
        weights = balance.weights
        sigma_x, sigma_y = balance.window_px
        of_all = weights.light, weights.moments
        under_window = weights.window_light, weights.window_moments
        return {
            "half_inverse_window2": (0.5 / sigma_x**2, 0.5 / sigma_y**2),
            "boxes": (weights.box_3 / IN_BOX, weights.box_5 / IN_BOX),
            "follows": (*balance.follows(3), *balance.follows(5)),
            "weights": (*of_all, *under_window),
            "few_steps": weights.few_steps,
            "last_light": weights.last_light,
        }

    @property
    def left(self) -> Left | None:
        """The errors of the last frame of `temporal`; None at the beginning of a sequence.
        NumPy's quantiser may give them.
        """
        if self._memory is None:
            return None
        return self._memory.left

    @left.setter
    def left(self, left: Left | None) -> None:
        if self._memory is not None:
            self._memory.left = left

    @property
    def tables(self) -> list[moderngl.Texture | moderngl.Buffer]:
        """The tables by which levels are chosen."""
        tables: list[moderngl.Texture | moderngl.Buffer] = [self._order.buffer, self._light.buffer]
        if self._gain is not None:
            tables.append(self._gain)
        return tables

    def draw(
        self, buffer: moderngl.Buffer, sprites: FrameLight, sums: PixelSums | None = None
    ) -> None:
        """Choose the levels of `sprites`, which `buffer` holds and `sums` show, or else the linear
        image.
        """
        paths = sprites.per_star > 1
        on_floor = sums is not None and sums.floor is not None
        program = self._program(paths, sums is not None, on_floor)
        if sums is None:
            self._linear.bind_to_image(1, read=True, write=False)
        else:
            sums.bind(program)
        if paths:
            turns = stretches_of(sprites.star)
        else:
            turns = turns_of(sprites.data["electrons_per_s"], self._step_e_per_s)
        write(self._turns, turns.astype(np.int32))
        self._turns.bind_to_storage_buffer(TURNS_BINDING)
        count = len(turns)
        if self._memory is not None and paths:
            self._memory.bind(sprites.star[turns[:, 0]], turns[:, 0] != turns[:, 2])
        elif self._memory is not None:
            self._memory.bind(sprites.star, np.zeros(count, dtype=np.bool_))
        elif not paths:
            self._bind_before(program, count)
        buffer.bind_to_storage_buffer(0)
        self._order.bind()
        self._light.bind()
        if self._gain is not None:
            self._gain.use(0)
        self._levels.bind_to_image(0, read=True, write=True)
        program["count"] = count
        program.run(-(-count // LOCAL_SIZE))
        self._ctx.memory_barrier()
        if sums is not None:
            self._ctx.finish()  # before NumPy looks at the levels

    def forget_over(self) -> None:
        """The stars of the next frame leave nothing, unless this pass draws them."""
        self._over_count = 0

    def _bind_before(self, program: moderngl.ComputeShader, count: int) -> None:
        """Bind what `count` stars left in the panels before, and room for what they leave here."""
        makes_up = [0.0, 0.0]  # as many as inputs.glsl has
        for place, panel in enumerate(self._before):
            panel._over.bind_to_storage_buffer(FIRST_BINDING + place)
            if panel._over_count == count:
                makes_up[place] = self._turn.makes_up[place]
        set_uniforms(program, {"makes_up": tuple(makes_up)})
        if self._turn.is_followed:
            if self._over.size < count * SUMS_BYTES:
                self._over.orphan(2 * count * SUMS_BYTES)
            self._over.bind_to_storage_buffer(LEFT_BINDING)
            self._over_count = count


class Memory:
    """The errors that the stars of one frame leave to the next, on the GPU; it lives in its
    renderer's context.
    """

    def __init__(self, ctx: moderngl.Context) -> None:
        self._ctx = ctx
        self._star: IntArray | None = None  # the last frame's stars
        self._room = 0
        self._begins = self._reserved(BEGIN_DTYPE.itemsize)
        self._before = self._reserved(SUMS_BYTES)
        self._left = self._reserved(SUMS_BYTES)

    def _reserved(self, size: int) -> moderngl.Buffer:
        return self._ctx.buffer(reserve=max(self._room, 1) * size, dynamic=True)

    def bind(self, star: IntArray, goes_on: npt.NDArray[np.bool_]) -> None:
        """Bind it for a pass over stars, or stretches of their paths, of these numbers (n,).

        One that goes on with a path is no star's first, and begins with nothing.
        """
        places = places_before(self._star, star)
        begins = np.empty(len(star), dtype=BEGIN_DTYPE)
        begins["before"] = np.where(goes_on, NONE_BEFORE, places)
        begins["phase"] = np.where(goes_on, 0, first_phases(star, places))
        self._before, self._left = self._left, self._before
        if len(star) > self._room:
            self._room = 2 * len(star)
            self._begins.release()
            self._begins = self._reserved(BEGIN_DTYPE.itemsize)
        if self._left.size < len(star) * SUMS_BYTES:
            self._left.release()
            self._left = self._reserved(SUMS_BYTES)
        self._begins.write(begins)
        self._begins.bind_to_storage_buffer(FIRST_BINDING)
        self._before.bind_to_storage_buffer(FIRST_BINDING + 1)
        self._left.bind_to_storage_buffer(LEFT_BINDING)
        self._star = star.copy()

    @property
    def left(self) -> Left | None:
        """The errors of the last frame, read back; None at the beginning of a sequence."""
        if self._star is None:
            return None
        data = self._left.read(len(self._star) * SUMS_BYTES)
        sums = np.frombuffer(data, dtype="<f4").reshape(-1, SUMS)
        return Left(self._star, np.ascontiguousarray(sums.T))

    @left.setter
    def left(self, left: Left | None) -> None:
        self._star = None if left is None else left.star
        if left is None:
            return
        self._room = max(self._room, len(left.star))
        self._left.release()
        self._left = self._reserved(SUMS_BYTES)
        self._left.write(np.ascontiguousarray(left.error.T, dtype="<f4"))


def _places(order: PixelOrder, balance: Balance) -> npt.NDArray[np.uint32]:
    """The pixels of a footprint, nearest first, for each phase, packed for the shader: x and y in 6
    bits each, then the pixel's shares of the 3 x 3 and the 5 x 5 box in 10 bits each.
    """
    x, y = order.places()
    middle_x, middle_y = np.rint(order.phases)
    away = x - middle_x[:, None], y - middle_y[:, None]
    box_3 = np.rint(balance.in_box(3, *away) * IN_BOX).astype(np.intp)
    box_5 = np.rint(balance.in_box(5, *away) * IN_BOX).astype(np.intp)
    packed = x + 32 | (y + 32) << 6 | box_3 << 12 | box_5 << 22
    return np.asarray(packed, dtype=np.uint32)


def overrated(width_px: tuple[float, float]) -> float:
    """Largest ratio of a path's light as the shader takes it to the true light in a pixel within
    reach.

    The shader takes a Gaussian of the width and a pixel's variance together; where stars are
    narrow, the true light. Two stars must never own the same pixel, or the order in which threads
    reach it would choose its level.
    """
    if min(width_px) < NARROW_PX:
        return OVERRATED
    away = np.linspace(0.0, REACH_SIGMA, 200)  # in sigmas, a pixel's width included
    along_x = _largest_ratios(away, width_px[0])
    along_y = _largest_ratios(away, width_px[1])
    # how far along y a pixel within reach may be
    rest = np.sqrt(REACH_SIGMA**2 - away**2)
    last = np.searchsorted(away, rest, side="right") - 1
    ratios = along_x * along_y[last]
    return OVERRATED * float(ratios.max())


def _largest_ratios(places: FloatArray, width_px: float) -> FloatArray:
    """The largest `_ratio` up to each of rising places (n,)."""
    ratios = [_ratio(place, width_px) for place in places.tolist()]
    return np.maximum.accumulate(np.array(ratios))


def _ratio(place: float, width_px: float) -> float:
    """A Gaussian's density of the sigma and a pixel together, over the light in the pixel,
    `place` wide sigmas off.
    """
    wide = math.sqrt(width_px**2 + PIXEL_VARIANCE)
    scale = width_px * math.sqrt(2)
    below = math.erf((place * wide - 0.5) / scale)
    above = math.erf((place * wide + 0.5) / scale)
    light = (above - below) / 2
    return math.exp(-(place**2) / 2) / (math.sqrt(math.tau) * wide * light)


def stretches_of(star: IntArray) -> IntArray:
    """Stretches of paths along which sprites pass on their errors, (n, 4): the first sprite and the
    end of each, and those of its path.
    """
    begins = np.flatnonzero(np.diff(star, prepend=star[0] - 1))
    ends = np.append(begins[1:], len(star))
    parts = -(-(ends - begins) // CARRIED)
    path = np.repeat(np.arange(len(begins)), parts)
    first_of_path = np.cumsum(parts) - parts
    number = np.arange(len(path)) - np.repeat(first_of_path, parts)
    path_begin = begins[path]
    path_end = ends[path]
    first = path_begin + number * CARRIED
    end = np.minimum(first + CARRIED, path_end)
    return np.stack([first, end, path_begin, path_end], axis=1)


def turns_of(electrons_per_s: Float32Array, step_e_per_s: float) -> IntArray:
    """The order (n,) in which sprites go through the pass: in runs of near neighbours, each by
    light.

    Eight stars go together in a software OpenGL, for as long as the brightest of them needs. A
    run's own pixels stay in the cache.
    """
    count = len(electrons_per_s)
    runs = max(1, min(count // RUN, MAX_RUNS))
    # A float's exponent and the first bit of its mantissa: in half an octave a star's reach grows
    # by a pixel or two.
    first_half_octave = np.float32(step_e_per_s).view(np.int32) >> 22
    half_octaves = (electrons_per_s.view(np.int32) >> 22) - first_half_octave
    run = np.arange(count) * runs // max(count, 1)
    key = run * HALF_OCTAVES + np.clip(half_octaves, 0, HALF_OCTAVES - 1)
    # 16-bit keys are sorted by radix
    return np.asarray(np.argsort(key.astype(np.uint16), kind="stable"))
