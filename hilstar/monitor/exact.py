"""`exact`: the levels of one star's footprint chosen together, so that its light and its centroid are right in one frame.

Every pixel shows one of the two levels around its light, so that no pixel is off by a whole level. The choice between the
two minimises three sums over the star's pixels: the error of light, and its first moments about the star along x and y.
First the errors are carried outwards from the star's middle, to where the steps of light are finer; then flips of one or
two pixels are searched until none reduces the errors.
In the straight foot of sRGB all steps are equal, so a star of N steps cannot be closer than half a step: 1 / 2N of its
light, and about 1 / 2N px along each axis. That limit is the monitor's, and the method reaches it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hilstar.arrays import Float32Array, FloatArray, IntArray
from hilstar.monitor.footprints import FootprintMap, Footprints, PlaceArray
from hilstar.monitor.level_table import ThresholdCounter
from hilstar.monitor.quantise import Panel, level_dtype
from hilstar.monitor.response import Codes
from hilstar.scene.sprites import Sprites

# The weight of a squared error of light against that of a squared moment of the same light times 1 px. One suits a star
# whose steps differ. Where they are equal no moment may cost a whole step of light: four prevents it.
LIGHT_WEIGHT = 1.0
LIGHT_WEIGHT_ON_GRID = 4.0
CHUNK = 512  # stars at a time: their arrays stay in a core's cache
FLIPS = 24  # pixels of a star that are tested together, spread evenly from its middle to its reach
SWEEPS = 4  # flips of one or two pixels; few stars take more
GOOD_ENOUGH = 5e-4  # of the light, and px: a star with smaller errors is not flipped
SAME_STEP = 1e-4  # steps that differ by less, relatively, are equal


@dataclass(frozen=True, slots=True)
class _Choice:
    """The near pixels of n stars, (near, n), light relative to white; and what their errors add up to.

    `short` is what the lower level is off the wanted light (0 or less), `step` how much the next one adds (0 where there
    is none to take), `up` whether it is taken. `arm` (3, near, n) weighs a pixel's error into the three of `error` (3, n):
    light and two moments. `grid` (n,) is the step of a star whose steps are all equal, else 0.
    """

    short: FloatArray
    step: FloatArray
    up: npt.NDArray[np.bool_]
    arm: FloatArray
    error: FloatArray
    grid: FloatArray

    def unfinished(self, stars: IntArray, good: FloatArray) -> IntArray:
        """Those of `stars` whose error is above `good` (n,) and whose steps, where equal, could bring it nearer."""
        error = self.error[:, stars]
        half_step = 0.5 * (1 + SAME_STEP) * self.grid[stars]
        far = (np.square(error).sum(axis=0) > good[stars] ** 2) & (np.abs(error) > half_step).any(axis=0)
        return np.asarray(stars[far])


class ExactQuantiser:
    """Levels of sprites on a panel, one image after another; `sigma_px` is that of the sprites."""

    def __init__(self, panel: Panel, resolution_px: tuple[int, int], sigma_px: tuple[float, float]) -> None:
        self._map = FootprintMap(resolution_px, sigma_px)
        self._panel = panel
        response = panel.response
        self._light = np.append(response.light, response.light[-1])  # there is no step above white
        self._lower = ThresholdCounter(response.light[1:].astype(np.float32))
        self._nearest = ThresholdCounter(response.threshold.astype(np.float32))
        self._first_threshold = np.float32(response.threshold[0])
        self._flat = np.zeros(self._map.pixels + 1, dtype=level_dtype(response))  # one more, for pixels off the image
        self._lit: PlaceArray = np.empty(0, dtype=np.int32)
        self._on_floor = False
        uniformity = panel.uniformity
        self._output = None if uniformity is None else np.append(uniformity.ravel(), np.float32(1))

    def levels(self, sprites: Sprites | None, floor: Codes | None = None) -> Codes:
        """The levels of `sprites` (None: black), (height, width); the next call overwrites the same array.

        Their light is added to that of the levels `floor` (height, width), None for black.
        """
        width, height = self._map.resolution_px
        if floor is None:
            self._flat[slice(None) if self._on_floor else self._lit] = 0
        else:
            self._flat[:-1] = floor.ravel()
        self._on_floor = floor is not None
        self._lit = np.empty(0, dtype=np.int32)
        if sprites is not None and len(sprites):
            found = self._map.find(sprites)
            levels = np.empty(found.place.shape, dtype=self._flat.dtype)
            for start in range(0, len(sprites), CHUNK):
                some = slice(start, start + CHUNK)
                levels[:, some] = self._choose(_part(found, some))
            self._lit = found.place.ravel()
            self._flat[self._lit] = levels.ravel()
            self._flat[-1] = 0
        return self._flat[:-1].reshape(height, width)

    def _choose(self, found: Footprints) -> IntArray:
        """The levels of a chunk of stars, (pixels, n)."""
        near = self._map.near
        output = None if self._output is None else self._output[found.place]
        asked = found.light / np.float32(self._panel.flux_at_white_e_per_s)
        if output is not None:
            asked /= output
        floor = self._light[self._flat[found.place]].astype(np.float32) if self._on_floor else None
        if floor is not None:
            asked += floor
        np.minimum(asked, np.float32(1), out=asked)  # light over white is lost; neighbours do not make up for it
        lower, upper = self._lower.count(asked[:near]), self._round(asked[near:])
        shown = self._light[np.concatenate([lower, upper])]
        step = self._light[lower + 1] - shown[:near]
        short = shown - asked
        if output is not None:
            short *= output
            step *= output[:near]
            asked *= output
        step[found.place[:near] == self._map.pixels] = 0.0
        light = asked.sum(axis=0, dtype=np.float64)
        if floor is not None:
            light -= (floor if output is None else floor * output).sum(axis=0, dtype=np.float64)
        grid = _equal_step(step)
        weight = np.where(grid > 0, LIGHT_WEIGHT_ON_GRID**0.5, LIGHT_WEIGHT**0.5)
        arm = np.stack([np.broadcast_to(weight, short.shape), found.dx_px, found.dy_px])
        error = np.einsum("kpn,pn->kn", arm[:, near:], short[near:])
        choice = _Choice(short[:near], step, np.zeros(step.shape, dtype=np.bool_), arm[:, :near], error, grid)
        _aim_at_whole_steps(choice)
        _carry_outwards(choice)
        _flip(choice, GOOD_ENOUGH * light)
        return np.concatenate([lower + choice.up, upper])

    def _round(self, asked: Float32Array) -> IntArray:
        """The nearest levels; this far out they are 0 for all but the brightest stars."""
        levels = np.zeros(asked.shape, dtype=np.intp)
        bright = asked >= self._first_threshold
        levels[bright] = self._nearest.count(asked[bright])
        return levels


def _part(found: Footprints, some: slice) -> Footprints:
    return Footprints(found.light[:, some], found.place[:, some], found.dx_px[:, some], found.dy_px[:, some])


def _equal_step(step: FloatArray) -> FloatArray:
    """The step of each star whose steps are all equal, else 0, (n,)."""
    largest = step.max(axis=0)
    smallest = np.min(step, axis=0, initial=np.inf, where=step > 0)
    return np.where(largest <= smallest * (1 + SAME_STEP), largest, 0.0)


def _aim_at_whole_steps(choice: _Choice) -> None:
    """Where all steps are equal, aim at the nearest light that can be shown: no moment is then worth a step of light."""
    equal = np.flatnonzero(choice.grid)
    root, step = LIGHT_WEIGHT_ON_GRID**0.5, choice.grid[equal]
    short = choice.short[:, equal].sum(axis=0) + choice.error[0, equal] / root
    choice.error[0, equal] -= root * (short - np.rint(short / step) * step)


def _carry_outwards(choice: _Choice) -> None:
    """Decide pixel by pixel from the middle outwards, each so that the errors carried so far become smallest."""
    arm, error = choice.arm, choice.error
    bound = -(choice.short + choice.step / 2) * np.square(arm).sum(axis=0)
    bound[choice.step == 0] = -np.inf
    for pixel in range(len(choice.step)):
        choice.up[pixel] = (arm[:, pixel] * error).sum(axis=0) < bound[pixel]
        left = choice.short[pixel] + choice.step[pixel] * choice.up[pixel]
        error += arm[:, pixel] * left


def _flip(choice: _Choice, good: FloatArray) -> None:
    """Flip the best one or two pixels of each star while its errors shrink and exceed `good` (n,)."""
    error = choice.error
    near = len(choice.step)
    stride = -(-near // FLIPS)  # of a large star, another part of its pixels each time
    stars = choice.unfinished(np.arange(error.shape[1]), good)
    for sweep in range(SWEEPS + 2 * (stride - 1)):
        if not len(stars):
            return
        pixels = np.arange(sweep % stride, near, stride)
        some = np.ix_(pixels, stars)
        change = np.where(choice.up[some], -choice.step[some], choice.step[some])
        moves = choice.arm[:, pixels[:, None], stars] * change
        first, second = _best_pair(moves, error[:, stars])
        each, two = np.arange(len(stars)), first != second
        flipped = error[:, stars] + moves[:, first, each] + two * moves[:, second, each]
        better = np.square(flipped).sum(axis=0) < np.square(error[:, stars]).sum(axis=0) * (1 - 1e-9)
        error[:, stars[better]] = flipped[:, better]
        choice.up[pixels[first[better]], stars[better]] ^= True
        choice.up[pixels[second[better & two]], stars[better & two]] ^= True
        stars = choice.unfinished(stars[better] if stride == 1 else stars, good)


def _best_pair(moves: FloatArray, error: FloatArray) -> tuple[IntArray, IntArray]:
    """The two of p `moves` (3, p, n), or one twice, that added to `error` (3, n) make the smallest square."""
    alone = np.square(moves).sum(axis=0) + 2 * (moves * error[:, None]).sum(axis=0)
    ones = np.ones_like(alone)
    # |e + a + b|^2 - |e|^2 = alone(a) + alone(b) + 2 a b, as one product of matrices.
    left = np.stack([*(2 * moves), alone, ones]).transpose(2, 1, 0).astype(np.float32, order="C")
    right = np.stack([*moves, ones, alone]).transpose(2, 0, 1).astype(np.float32, order="C")
    square = left @ right
    count = len(alone)
    square[:, range(count), range(count)] = alone.T
    return np.divmod(square.reshape(len(square), -1).argmin(axis=1), count)
