"""Stars drawn by a processor: only the pixels that they light, in NumPy's own memory.

Each star's light is computed in a square as large as it needs, cut at the ellipse that it lights,
and added to its pixels' sums in whole units (`light_units`). Points of OpenGL add the same units,
so both ways choose the same levels. Nothing here visits a pixel that no star has lit in this frame
or the one before, unless stars cover so much of the image that a pass over all of it is faster.
"""

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from hilstar.basics.arrays import BoolArray, Float32Array, IntArray
from hilstar.display.footprints import PixelOrder
from hilstar.display.quantise import RoundQuantiser, ThresholdCounter
from hilstar.display.render.light_units import LightUnits
from hilstar.display.response import Levels
from hilstar.optics.psf import Psf
from hilstar.optics.sprites import FrameLight

# Pixels that are computed at once: their arrays stay in a core's cache.
CHUNK_PX = 2**16
# A group of stars has one side; a smaller side for some of them saves less than a group costs where
# it saves fewer pixels than this.
WORTH_A_GROUP_PX = 4096
# Share of the image: where squares cover more, all of it is made black and looked through faster.
MAX_LISTED = 1 / 16
LEAST_PX = 1e-6  # as in splat.frag
MARGIN_PX = 0.001  # as in star.vert
ROUNDED_DOWN = 1 - 1e-6  # float32 light times gain may be rounded up to the first threshold
NOWHERE: IntArray = np.empty(0, dtype=np.intp)


class Squares(NamedTuple):
    """Squares of pixels about stars of one side: rows, columns, stars.

    `some` (n,) are the stars' places among the sprites, `fraction_px` (2, n) their x and y from
    their own pixels, and `place` (side * side, n) the pixels' places in the flat image; `on_image`
    (side, side, n) is None where all are on it, and a pixel off it has place 0.
    """

    some: IntArray
    side_px: int
    fraction_px: Float32Array
    place: IntArray
    on_image: BoolArray | None

    @property
    def offset_px(self) -> Float32Array:
        """The rows or columns (side,) from the stars' own pixels."""
        return np.arange(self.side_px, dtype=np.float32) - (self.side_px - 1) // 2


def squares_of(
    sprites: FrameLight, side_px: IntArray, resolution_px: tuple[int, int]
) -> Iterator[Squares]:
    """The squares of sprites of these sides (n,), chunk by chunk."""
    order = np.argsort(side_px.astype(np.uint16), kind="stable")
    # by rows of words, for records are slow to index
    columns = words_of(sprites).take(order, axis=0).T
    x, y = columns[:2].astype(np.intp)
    fraction_px = np.ascontiguousarray(columns[2:]).view(np.float32)
    begin = 0
    for side, count in groups_of(side_px):
        at_once = max(1, CHUNK_PX // side**2)
        for first in range(begin, begin + count, at_once):
            some = slice(first, min(first + at_once, begin + count))
            place, on_image = _places(x[some], y[some], side, resolution_px)
            yield Squares(order[some], side, fraction_px[:, some], place, on_image)
        begin += count


def words_of(sprites: FrameLight) -> npt.NDArray[np.int32]:
    """The words (n, 4) of the sprites' pixels and fractions."""
    data = np.ascontiguousarray(sprites.data)
    return data.view(np.int32).reshape(len(data), -1)[:, :4]


def groups_of(side_px: IntArray) -> list[tuple[int, int]]:
    """The sides of squares, rising, and how many stars have each; few stars take the next side."""
    count = np.bincount(side_px)
    sides = np.flatnonzero(count).tolist()
    groups: list[tuple[int, int]] = []
    waiting = 0
    for side, following in zip(sides, [*sides[1:], None], strict=True):
        waiting += int(count[side])
        if following is None or waiting * (following**2 - side**2) > WORTH_A_GROUP_PX:
            groups.append((side, waiting))
            waiting = 0
    return groups


def _places(
    x: IntArray, y: IntArray, side: int, resolution_px: tuple[int, int]
) -> tuple[IntArray, BoolArray | None]:
    """The places of the pixels of squares about pixels x and y (n,), and which are on the image;
    see `Squares`.
    """
    width, height = resolution_px
    step = np.arange(side) - (side - 1) // 2
    in_square = np.add.outer(width * step, step).reshape(-1, 1)
    place = in_square + (y * width + x)
    low = step[0]
    high = step[-1]
    is_cut = (x + low < 0) | (x + high >= width)
    is_cut |= (y + low < 0) | (y + high >= height)
    if not is_cut.any():
        return place, None
    cut = np.flatnonzero(is_cut)
    columns = step[:, None] + x[cut]
    rows = step[:, None] + y[cut]
    in_columns = (columns >= 0) & (columns < width)
    in_rows = (rows >= 0) & (rows < height)
    on_image = np.ones((side, side, len(x)), dtype=np.bool_)
    on_image[..., cut] = in_rows[:, None] & in_columns
    place[:, cut] *= on_image[..., cut].reshape(-1, len(cut))
    return place, on_image


class CpuStars:
    """Draws stars into pixels' sums and levels, in memory that is given or its own.

    `levels` (height, width) are black at first. The sums stay for `exact` to look at:
    `unit_e_per_s` is their unit. Where a frame has a floor, its stars are added to those levels in
    light. `least_side_px` is the smallest square that a star has, for what else may be lit about
    it.
    """

    def __init__(
        self,
        units: LightUnits,
        levels: npt.NDArray[np.unsignedinteger[Any]],
        sums: npt.NDArray[np.int32] | None = None,
        least_side_px: int = 1,
    ) -> None:
        self._units = units
        self._size_px = units.size_px
        self._psf = units.psf
        panel = units.panel
        self._least_side_px = least_side_px
        self._levels = levels.reshape(-1)
        if sums is None:
            self._whole_sums = np.zeros(math.prod(self._size_px), dtype=np.int32)
        else:
            self._whole_sums = sums
        self._fine_sums: npt.NDArray[np.float64] | None = None  # where an int32 is too small
        self._sums: npt.NDArray[Any] = self._whole_sums  # the last frame's
        self.unit_e_per_s = units.most_e_per_s
        gain = panel.gain()
        self._gain = None if gain is None else gain.ravel()
        self._most_gain = 1.0 if gain is None else float(gain.max())
        thresholds = RoundQuantiser.edges_e_per_s(panel)
        self._counter = ThresholdCounter(thresholds)
        self._dark_e_per_s = float(thresholds[0]) / self._most_gain * ROUNDED_DOWN
        self._level_light = panel.light_e_per_s()
        self._axes_px2 = np.array(units.axes_px2, dtype=np.float32)
        self._drawn: IntArray | None = None  # places of the last frame's squares; None: anywhere
        self._on_floor = False

    def forget(self) -> None:
        """The next `lay` makes all black: something else has drawn on the levels."""
        self._drawn = None

    def lay(self, floor: Levels | None) -> None:
        """Make black what the last frame drew, and take a frame's floor, which becomes its levels;
        None for black.
        """
        if self._on_floor and floor is None:
            drawn = None
        else:
            drawn = self._drawn
        for image in self._images():
            _blacken(image, drawn)
        self._on_floor = floor is not None
        if floor is not None:
            self._levels[:] = floor.ravel()
        self._drawn = NOWHERE

    def _images(self) -> list[npt.NDArray[Any]]:
        """The levels and the sums, which a frame changes in the same places."""
        if self._fine_sums is None:
            fine = []
        else:
            fine = [self._fine_sums]
        return [self._levels, self._whole_sums, *fine]

    def add(self, sprites: FrameLight, unit_e_per_s: float | None) -> None:
        """Add the light of `sprites` to the sums, after `lay`: in this unit (see `LightUnits`), or
        where an int32 is too small for it (None) in a finer one.
        """
        if unit_e_per_s is None:
            self.unit_e_per_s, self._sums = self._units.fine_unit_for(sprites), self._fine()
        else:
            self.unit_e_per_s, self._sums = unit_e_per_s, self._whole_sums
        reach_px = self._reach_px(sprites)
        side_px = self._sides_px(reach_px)
        rates = sprites.data["electrons_per_s"] * np.float32(1 / self.unit_e_per_s)
        is_listed = int((side_px**2).sum()) <= MAX_LISTED * len(self._levels)
        places = []
        for squares in squares_of(sprites, side_px, self._size_px):
            self._add(squares, rates, reach_px[:, squares.some])
            if is_listed:
                places.append(squares.place.ravel())
        self._drawn = np.concatenate([NOWHERE, *places]) if is_listed else None

    def _fine(self) -> npt.NDArray[np.float64]:
        """The sums in finer units; a frame that needs them is rare."""
        if self._fine_sums is None:
            self._fine_sums = np.zeros(self._whole_sums.shape)
        return self._fine_sums

    def _sides_px(self, reach_px: Float32Array) -> IntArray:
        """The sides (n,) of the squares about ellipses of half axes (2, n), as in star.vert."""
        away_px = reach_px.max(axis=0) + np.float32(MARGIN_PX)
        if self._psf.footprint_px % 2:
            around = 2 * (away_px + np.float32(0.5)).astype(np.intp) + 1
        else:
            around = 2 * away_px.astype(np.intp) + 2
        sides: IntArray = np.minimum(around, self._units.side_px)
        return np.maximum(sides, self._least_side_px)

    def _reach_px(self, sprites: FrameLight) -> Float32Array:
        """The half axes (2, n) of the ellipses that sprites light."""
        lit = sprites.data["electrons_per_s"] * np.float32(self._units.reach_per_e(sprites))
        squares = np.log(np.maximum(lit, np.float32(1)))
        return np.sqrt(squares * self._axes_px2[:, None])

    def _add(self, squares: Squares, rates: Float32Array, reach_px: Float32Array) -> None:
        """Add the light of the stars of squares, which reaches so far, to their pixels' sums;
        `rates` (n,) are all sprites', in units.
        """
        is_lit = self._within_reach(squares, reach_px)
        if squares.on_image is not None:
            is_lit &= squares.on_image
        units = self._psf.drawn_stamps(
            squares.fraction_px, rates[squares.some], squares.side_px, self._psf.footprint_px
        )
        most = self._units.most_e_per_s / self.unit_e_per_s
        np.minimum(units, np.float32(most), out=units)
        units *= is_lit
        units += np.float32(0.5)
        added = units.astype(self._sums.dtype)
        np.add.at(self._sums, squares.place.ravel(), added.ravel())

    def _within_reach(self, squares: Squares, reach_px: Float32Array) -> BoolArray:
        """Which pixels (side, side, n) of squares lie within their stars' ellipses, as in
        splat.frag.
        """
        offset_px = squares.offset_px[:, None]
        x_px, y_px = squares.fraction_px
        away_x = np.abs(offset_px - x_px)
        away_y = np.abs(offset_px - y_px)
        up = away_y / np.maximum(reach_px[1], np.float32(LEAST_PX))
        wide = reach_px[0] * np.sqrt(np.maximum(1 - up * up, np.float32(0)))
        wide[away_y > reach_px[1]] = -1.0
        is_lit = np.asarray(away_x <= wide[:, None])
        beyond = (squares.side_px - self._units.side_px) // 2
        if beyond > 0:  # the square is wider than the sprite, for what `exact` may light
            inside = np.zeros(squares.side_px, dtype=np.bool_)
            inside[beyond:-beyond] = True
            is_lit &= inside[:, None, None] & inside[:, None]
        return is_lit

    def encode(self) -> None:
        """Make levels of the sums, the nearest, where they light a pixel."""
        sums = self._sums
        if self._on_floor:
            least = 1
        else:
            least = max(1, int(self._dark_e_per_s / self.unit_e_per_s))
        if self._drawn is None:
            place = np.flatnonzero(sums >= least)
            lit = sums[place]
        else:
            every = sums[self._drawn]
            is_lit = np.flatnonzero(every >= least)
            place = self._drawn[is_lit]
            lit = every[is_lit]
        light = lit.astype(np.float32) * np.float32(self.unit_e_per_s)
        if self._gain is not None:
            light *= self._gain[place]
        if self._on_floor:
            light += self._level_light[self._levels[place]]
        self._levels[place] = self._counter.count(light)


def _blacken(image: npt.NDArray[Any], place: IntArray | None) -> None:
    """Make an image (pixels,) black at these places; None for everywhere."""
    if place is None:
        image.fill(0)
    else:
        image[place] = 0


class CpuImage:
    """A linear image of stars alone; only their squares are visited.

    `image`, electrons per second, float32 (height, width), is read-only. Each pixel's stars are
    added in one order: the same sprites give the same bits.
    """

    def __init__(self, resolution_px: tuple[int, int], psf: Psf) -> None:
        self._size_px = resolution_px
        self._psf = psf
        self._light = np.zeros(math.prod(resolution_px), dtype=np.float32)
        self.image = self._light.reshape(resolution_px[::-1])
        self.image.flags.writeable = False
        self._drawn: IntArray | None = NOWHERE  # as in CpuStars

    def draw(self, sprites: FrameLight | None, side_px: IntArray | None = None) -> None:
        """Draw the light of sprites (None: none) in place of the last ones', within squares of
        these sides (n,), by default all of their footprints.
        """
        _blacken(self._light, self._drawn)
        self._drawn = NOWHERE
        if sprites is None or not len(sprites):
            return
        if side_px is None:
            side_px = np.full(len(sprites), self._psf.footprint_px)
        is_listed = int((side_px**2).sum()) <= MAX_LISTED * len(self._light)
        rates = np.ascontiguousarray(sprites.data["electrons_per_s"])
        places = []
        for squares in squares_of(sprites, side_px, self._size_px):
            rate = rates[squares.some]
            light = self._psf.drawn_stamps(
                squares.fraction_px, rate, squares.side_px, self._psf.footprint_px
            )
            if squares.on_image is not None:
                light *= squares.on_image
            place = squares.place.ravel()
            np.add.at(self._light, place, light.ravel())
            if is_listed:
                places.append(place)
        self._drawn = np.concatenate([NOWHERE, *places]) if is_listed else None


def least_side_px(psf: Psf) -> int:
    """The side of the square that holds all pixels which `exact` may light about a star."""
    order = PixelOrder(psf)
    place = np.stack([order.row, order.column])[:, : order.near] + order.first
    before = -int(place.min())
    after = int(place.max())
    if order.size % 2:
        return 2 * max(before, after) + 1
    return 2 * max(before + 1, after)
