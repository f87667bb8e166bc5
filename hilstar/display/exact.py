"""`exact`: the levels of one star's footprint chosen together, so that its light and its place are
right in one frame.

Every pixel shows one of the two levels around its light, so that no pixel is off by a whole level.
The choice between the two minimises the ten sums of `balance`. From the star's middle outwards each
pixel is decided, with several choices of the pixels before it kept side by side: of the four that
two of them lead to the better two are kept, and who is compared with whom changes from pixel to
pixel. The last pixels, and the choice among what is left, weigh the light more.
A star drawn as a path hands its errors from sprite to sprite.
In the straight foot of sRGB all steps are equal, so a star of N steps cannot have its light closer
than half a step: 1 / 2N. This is the oracle of shaders/exact.comp, and what draws where that cannot
run.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt

from hilstar.basics.arrays import Float32Array, IntArray
from hilstar.basics.units import COMPUTE_VERSION
from hilstar.display import quantise
from hilstar.display.balance import AS_USUAL, SUMS, Balance, Seen, Weights
from hilstar.display.footprints import FEWEST, FootprintMap, Footprints, PixelOrder, PlaceArray
from hilstar.display.panel import Panel
from hilstar.display.response import Levels
from hilstar.optics.psf import Psf
from hilstar.optics.sprites import FrameLight

# choices side by side, a power of two: 4 leave the centroid a fifth more error, 16 a tenth less
KEPT = 8
KEPT_BEFORE = 4  # where another primary makes up for what these leave
CHUNK = 256  # stars at a time: their arrays stay in a core's cache
OFF = 0.6  # in steps, where steps are equal: beyond it one more pixel is turned
SAME_STEP = 1e-4  # steps that differ by less, relatively, are equal
CARRIED = 32  # sprites of a path that hand on their errors; the next ones begin anew, beside them
NONE = np.float32(1e30)  # the square of a choice that does not exist yet
MAX_NEAR = 128  # pixels of a star that exact.comp has bits for: sprites up to a sigma of 1.8 px
MAX_SIZE = 63  # largest footprint whose places fit into six bits
# As MS_A_STAR. NumPy: 0.03 to 0.06 of 150 to 1800 stars, and more for sprites that are too wide for
# the shader. A field of the Milky Way has twice the stars of an average one.
EXACT_MS_A_STAR, NUMPY_EXACT_MS_A_STAR, WIDE_EXACT_MS_A_STAR = 0.003, 0.05, 0.23


class Turn(NamedTuple):
    """The turn of a panel among those of one monitor, which choose their levels one after another.

    A star makes up in it for these shares `makes_up` of the errors that it left in the panels
    before, in their order, in steps of both. Where it `is_followed`, the next panel makes up for
    what it leaves itself.
    """

    makes_up: tuple[float, ...] = ()
    is_followed: bool = False

    @property
    def kept(self) -> int:
        """How many choices are kept side by side."""
        return KEPT_BEFORE if self.is_followed else KEPT


@dataclass(frozen=True, slots=True)
class Carried:
    """The errors (SUMS, n) that earlier sprites or frames left and n sprites have to make up for,
    in steps from black.

    Errors of light and first moments are as they are, all others times their weights. Where all
    steps are equal, `phase` (n,), 0 to 1, is the part of a step that the star's light is ahead.
    """

    error: Float32Array
    phase: Float32Array

    def of(self, some: IntArray) -> "Carried":
        """The same of some of the sprites."""
        return Carried(self.error[:, some], self.phase[some])


def nothing_carried(count: int) -> Carried:
    """No errors, for `count` sprites of a frame that stands by itself."""
    return Carried(np.zeros((SUMS, count), dtype=np.float32), np.zeros(count, dtype=np.float32))


@dataclass(frozen=True, slots=True)
class Left:
    """The errors (SUMS, n) that the stars of a frame leave to the next frame; `star` (n,) are their
    numbers, as in `FrameLight.star`.
    """

    star: IntArray
    error: Float32Array


def _fits(psf: Psf) -> bool:
    """Whether exact.comp has bits enough for the pixels of such sprites, and their shares are
    products, as it takes them.
    """
    order = PixelOrder(psf)
    return psf.separable and order.near <= MAX_NEAR and order.size <= MAX_SIZE


class ExactQuantiser(quantise.Quantiser):
    """Chooses the levels of all pixels of a star together, so that the star's light and centroid
    are right.

    `shader` is the compute shader that does so, starting from the nearest levels. An instance does
    it for sprites of `psf` on a panel, image after image, for a tracker that sees the panel as
    `seen`. `weights` are those of the sums of errors that it keeps small (see `balance`). A
    quantiser that `remembers` starts each star with the errors that the last frame left, `left`;
    None at the beginning of a sequence, and where each frame stands by itself.
    """

    words = (
        "all codes of a star are chosen together, so that its flux and centroid are right in a"
        " single frame."
    )
    shader = "exact.comp"
    other_codes = 1e-2
    weights: ClassVar[Weights] = Weights()
    remembers: ClassVar[bool] = False
    left: Left | None = None
    turn: Turn = Turn()
    before: Sequence["ExactQuantiser"] = ()  # of the panels before, as in `turn`
    over: Float32Array | None = None  # what the last frame's sprites left, where each is a star

    def __init__(
        self, panel: Panel, resolution_px: tuple[int, int], psf: Psf, seen: Seen = AS_USUAL
    ) -> None:
        super().__init__(panel, resolution_px, psf, seen)
        self._map = FootprintMap(resolution_px, psf)
        self._balance = Balance(psf, seen, self.weights)
        response = panel.response
        self._light = np.append(response.light, response.light[-1])  # there is no step above white
        self._step_e_per_s = float(response.light[1]) * panel.flux_at_white_e_per_s
        self._lower = quantise.ThresholdCounter(response.light[1:].astype(np.float32))
        self._nearest = quantise.ThresholdCounter(response.threshold.astype(np.float32))
        self._first_threshold = np.float32(response.threshold[0])
        # one more, for pixels off the image
        self._flat = np.zeros(self._map.pixels + 1, dtype=quantise.level_dtype(response))
        self._lit: PlaceArray = np.empty(0, dtype=np.int32)
        self._on_floor = False
        uniformity = panel.uniformity
        self._output = None if uniformity is None else np.append(uniformity.ravel(), np.float32(1))

    def draw(self, light: quantise.UnquantisedFrame) -> Levels:
        """The levels of the next frame: its stars are added to its dithered extended light."""
        if light.sprites is None or not light.sprites.extended:
            return self.levels(light.sprites)
        turn = self.floor_turn(light.number)
        floor = quantise.dither_levels(light.extended(), self._panel, turn)
        return self.levels(light.sprites, floor)

    def begin_anew(self) -> None:
        """The next frame is the first of a sequence."""
        self.left = None

    @classmethod
    def by_pixel(cls) -> type[quantise.PixelQuantiser]:
        """The nearest levels, which its pass changes."""
        return quantise.RoundQuantiser

    @classmethod
    def takes(cls, psf: Psf, gl_version: int) -> bool:
        """Whether the shader runs on this version of OpenGL, and draws sprites of this PSF."""
        return gl_version >= COMPUTE_VERSION and _fits(psf)

    @classmethod
    def cost(cls, psf: Psf, gl_version: int) -> quantise.LevelCost:
        """The cost of the shader, or of NumPy where the shader cannot draw."""
        why = ""
        if gl_version < COMPUTE_VERSION:
            why = "in NumPy: its compute shaders need OpenGL 4.3"
        if cls.takes(psf, gl_version):
            ms_a_star = EXACT_MS_A_STAR
        elif _fits(psf):
            ms_a_star = NUMPY_EXACT_MS_A_STAR
        else:
            ms_a_star = WIDE_EXACT_MS_A_STAR
        return quantise.LevelCost(ms_a_star, why)

    @classmethod
    def fewest(cls, order: PixelOrder) -> int:
        """The minimum number of a star's pixels to choose among."""
        return min(FEWEST, order.near)

    @classmethod
    def floor_turn(cls, number: int) -> float:
        """How far the mask that dithers extended light is turned in frame `number`, 0 to 1."""
        return 0.0

    @classmethod
    def faintest_e_per_s(cls, panel: Panel, psf: Psf) -> float:
        """The rate of half a step: any pixel of the star may show it."""
        return panel.response.half_step * panel.flux_at_white_e_per_s

    def levels(self, sprites: FrameLight | None, floor: Levels | None = None) -> Levels:
        """The levels of `sprites` (None: black), (height, width); the next call overwrites the same
        array.

        Their light is added to that of the levels `floor` (height, width), None for black.
        """
        width, height = self._map.resolution_px
        if floor is None:
            self._flat[slice(None) if self._on_floor else self._lit] = 0
        else:
            self._flat[:-1] = floor.ravel()
        self._on_floor = floor is not None
        if sprites is not None and len(sprites):
            footprint = self._map.find(sprites)
            levels = np.empty(footprint.place.shape, dtype=self._flat.dtype)
            carried = self._carried(sprites)
            remainder = np.empty_like(carried.error)
            of_star_e_per_s = footprint.rate_e_per_s * _sprites_in_path(sprites).astype(np.float32)
            reach = self._reach(of_star_e_per_s)
            for some in _turns(sprites):
                stars = _part(footprint, some)
                levels[:, some], remainder[:, some] = self._choose(
                    stars, carried.of(some), reach[some]
                )
                _hand_on(carried.error, remainder, some, sprites)
            self._keep(sprites, remainder)
            self._lit = footprint.place.ravel()
            self._flat[self._lit] = levels.ravel()
            self._flat[-1] = 0
        return Levels(self._flat[:-1].reshape(height, width))

    def _reach(self, of_star_e_per_s: Float32Array) -> IntArray:
        """How many pixels of stars of so much light (n,) are chosen, (n,)."""
        order = self._map.order
        steps = of_star_e_per_s / np.float32(self._step_e_per_s)
        return np.maximum(order.reach(steps), self.fewest(order))

    def _carried(self, sprites: FrameLight) -> Carried:
        """The errors that each sprite begins with: what its light in other primaries left, or
        none.
        """
        carried = nothing_carried(len(sprites))
        if sprites.per_star > 1:
            return carried
        for share, panel in zip(self.turn.makes_up, self.before, strict=True):
            if panel.over is not None:
                np.add(carried.error, np.float32(share) * panel.over, out=carried.error)
        return carried

    def _bounded(self, error: Float32Array, step: Float32Array) -> Float32Array:
        """The errors (SUMS, n) that stars whose pixels have these steps (near, n) are given to
        make up for.
        """
        return error

    def _keep(self, sprites: FrameLight, left: Float32Array) -> None:
        """Take notice of the errors (SUMS, n) that a frame's sprites leave."""
        self.over = left

    def _choose(
        self, stars: Footprints, carried: Carried, reach: IntArray
    ) -> tuple[IntArray, Float32Array]:
        """The levels of a chunk of stars, (pixels, n), and the errors that they and those `carried`
        leave, (SUMS, n).

        Of each star the nearest `reach` (n,) pixels are chosen.
        """
        near = self._map.order.near
        lower, upper, short, step = self._levels_about(stars)
        is_chosen = np.arange(near)[:, None] < reach
        far = short.copy()
        short = np.where(is_chosen, short[:near], np.float32(0))
        step = np.where(is_chosen, step, np.float32(0))
        far[:near][is_chosen] = 0.0
        d = stars.offset_px - stars.fraction_px[:, None]
        weights = self._balance.weights
        steps_of_star = stars.rate_e_per_s / np.float32(self._step_e_per_s)
        arm = self._balance.arms(stars.offset_px[:, :near], stars.fraction_px, steps_of_star)
        error = self._bounded(carried.error, step).copy()
        moments_of_far = np.einsum("kpn,pn->kn", d, far)
        error[:3] += np.stack([far.sum(axis=0), *moments_of_far])
        # Where all steps of a star are equal: the step; 0 elsewhere. What lies between two of them
        # no choice can show.
        largest = step.max(axis=0)
        smallest = np.min(step, axis=0, initial=np.inf, where=step > 0)
        grid = np.where(largest <= smallest * (1 + SAME_STEP), largest, np.float32(0))
        error[0] += carried.phase * grid
        lowest = short.sum(axis=0) + error[0]
        is_even = grid > 0
        unit = np.where(is_even, grid, np.float32(1))
        between = lowest - np.rint(lowest / unit) * unit
        hidden = np.where(is_even, between, np.float32(0))
        error[0] -= hidden
        of_moments = np.full((2, len(grid)), np.float32(weights.moments))
        weight = np.stack([arm[0, 0], *of_moments])
        error[:3] *= weight
        up, remainder = _decide(short, step, arm, error, weights.last_light, self.turn.kept)
        _turn_one_more(step, arm, up, remainder, grid)
        remainder[:3] /= weight
        remainder[0] += hidden
        return np.concatenate([lower + up, upper]), remainder

    def _levels_about(
        self, stars: Footprints
    ) -> tuple[IntArray, IntArray, Float32Array, Float32Array]:
        """The lower levels of the near pixels and the nearest ones of the others, what these are
        off the wanted light (pixels, n), and what the next level adds to the near ones' (near, n),
        in steps from black.
        """
        near = self._map.order.near
        if self._output is None:
            output = None
        else:
            output = self._output[stars.place]
        asked = stars.light / np.float32(self._panel.flux_at_white_e_per_s)
        if output is not None:
            asked /= output
        if self._on_floor:
            floor = self._flat[stars.place]
            asked += self._light[floor].astype(np.float32)
        # light over white is lost; neighbours do not make up for it
        np.minimum(asked, np.float32(1), out=asked)
        # The nearest level this far out is 0 for all but the brightest stars.
        lower = self._lower.count(asked[:near])
        beyond = asked[near:]
        upper = np.zeros(beyond.shape, dtype=np.intp)
        is_bright = beyond >= self._first_threshold
        upper[is_bright] = self._nearest.count(beyond[is_bright])
        shown = self._light[np.concatenate([lower, upper])]
        step = self._light[lower + 1] - shown[:near]
        short = shown - asked
        if output is not None:
            short *= output
            step *= output[:near]
        step[stars.place[:near] == self._map.pixels] = 0.0
        short /= self._light[1]
        step /= self._light[1]
        return lower, upper, short.astype(np.float32), step.astype(np.float32)


def _part(stars: Footprints, some: IntArray) -> Footprints:
    return Footprints(
        stars.light[:, some],
        stars.place[:, some],
        stars.offset_px[..., some],
        stars.fraction_px[:, some],
        stars.rate_e_per_s[some],
    )


def _turns(sprites: FrameLight) -> Iterator[IntArray]:
    """The sprites in chunks, each of a path after those before it; a long path is begun anew in
    places.
    """
    order = np.arange(len(sprites))
    turn = np.zeros_like(order)
    if sprites.per_star > 1:
        begins, lengths = _paths(sprites)
        place_in_path = order - np.repeat(begins, lengths)
        turn = place_in_path % CARRIED
        order = np.argsort(turn, kind="stable")
    ends = np.flatnonzero(np.diff(turn[order])) + 1
    for some in np.split(order, ends):
        for start in range(0, len(some), CHUNK):
            yield some[start : start + CHUNK]


def _paths(sprites: FrameLight) -> tuple[IntArray, IntArray]:
    """Where the path of each star begins among sprites, and how many it has."""
    begins = np.flatnonzero(np.diff(sprites.star, prepend=sprites.star[0] - 1))
    return begins, np.diff(begins, append=len(sprites))


def _sprites_in_path(sprites: FrameLight) -> IntArray:
    """How many sprites the path of each has, (n,)."""
    if sprites.per_star == 1:
        return np.ones(len(sprites), dtype=np.intp)
    _, lengths = _paths(sprites)
    return np.asarray(np.repeat(lengths, lengths))


def _hand_on(
    carried: Float32Array, left: Float32Array, some: IntArray, sprites: FrameLight
) -> None:
    """Pass the errors `left` (SUMS, n) of sprites `some` to the sprites that follow them on their
    paths.

    Moments are about a sprite's centre: they are moved to the centre of the one that follows.
    """
    if sprites.per_star == 1:
        return
    after = np.minimum(some + 1, len(sprites) - 1)
    goes_on = (sprites.star[after] == sprites.star[some]) & (after > some)
    here = some[goes_on]
    there = here + 1
    carried[:, there] = left[:, here]
    light = left[0, here]
    carried[1, there] -= light * (sprites.x_px[there] - sprites.x_px[here])
    carried[2, there] -= light * (sprites.y_px[there] - sprites.y_px[here])


def _decide(
    short: Float32Array,
    step: Float32Array,
    arm: Float32Array,
    error: Float32Array,
    last_light: float,
    choices: int,
) -> tuple[npt.NDArray[np.bool_], Float32Array]:
    """Which near pixels of n stars take the upper level, (near, n), and the sums that leaves,
    (SUMS, n).

    `short` (near, n) is what the lower level is off the wanted light (0 or less), `step` (near, n)
    how much the next one adds (0 where there is none to take), both in steps from black. `arm`
    (SUMS, near, n) weighs a pixel's error into the sums of `error` (SUMS, n), of which that of
    light counts `last_light` times at the end.
    """
    near, count = step.shape
    carried = np.repeat(error[:, None], choices, axis=1)
    up = np.zeros((near, choices, count), dtype=np.bool_)
    missing = np.zeros((choices, count), dtype=np.float32)
    missing[1:] = NONE
    for pixel in range(near):
        weight = arm[:, pixel, None]
        by = step[pixel]
        carried += weight * short[pixel]
        down = np.square(carried).sum(axis=0) + missing
        across = (weight * carried).sum(axis=0)
        squares = np.square(weight).sum(axis=0)
        rise = by * (2 * across + by * squares)
        rise[:, by == 0] = NONE
        # Of the four choices that two of those kept lead to keep two, in their places. Where both
        # of one lead to less than either of the other, the other's place takes the second.
        partners = pixel % (choices.bit_length() - 1)
        other = np.arange(choices) ^ (1 << partners)
        better = down + np.minimum(rise, 0)
        worse = down + np.maximum(rise, 0)
        taken = worse[other] < better
        place, star = np.nonzero(taken)
        carried[:, place, star] = carried[:, other[place], star]
        up[:pixel, place, star] = up[:pixel, other[place], star]
        missing[place, star] = missing[other[place], star]
        up[pixel] = np.where(taken, rise[other] >= 0, rise < 0)
        carried += weight * by * up[pixel]
    heavier = (last_light**2 - 1) * np.square(carried[0])
    cost = np.square(carried).sum(axis=0) + heavier + missing
    best = cost.argmin(axis=0)[None, None]
    best_up = np.take_along_axis(up, best, axis=1)
    best_error = np.take_along_axis(carried, best, axis=1)
    return best_up[:, 0], best_error[:, 0]


def _turn_one_more(
    step: Float32Array,
    arm: Float32Array,
    up: npt.NDArray[np.bool_],
    error: Float32Array,
    grid: Float32Array,
) -> None:
    """Change one more pixel of each star whose light is a step off though all steps are equal
    (`grid` > 0): the one that adds least to the errors of the other sums.

    `step` and `arm` are as in `_decide`, whose results are changed.
    """
    even_step = np.where(grid > 0, grid, np.inf)
    is_off = np.abs(error[0]) > OFF * arm[0, 0] * even_step
    stars = np.flatnonzero(is_off)
    if not len(stars):
        return
    rise = error[0, stars] < 0
    by = np.where(rise, step[:, stars], -step[:, stars])
    arm = arm[:, :, stars]
    across = (arm * error[:, None, stars]).sum(axis=0)
    squares = np.square(arm).sum(axis=0)
    more = by * (2 * across + by * squares)
    # a pixel without a step, or on the side already that the light has to go to
    more[(by == 0) | (up[:, stars] == rise)] = np.inf
    pixel = more.argmin(axis=0)
    can = np.flatnonzero(np.isfinite(more.min(axis=0)))
    changed = pixel[can]
    up[changed, stars[can]] ^= True
    error[:, stars[can]] += arm[:, changed, can] * by[changed, can]
