"""The quantiser `temporal`: `exact` continued from frame to frame, so that a star's light and place
are right over any exposure of several frames.

A frame's codes leave an error in the ten sums of `balance` for each star: its remainder. The next
frame makes up for it. The errors of any N frames in a row add up to the difference of two
remainders, each about as large as the error of one frame of `exact`. So their mean falls as 1/N,
whichever frame the exposure begins with, also where it has parts of a frame at its ends. A
remainder is about the star's own centre and moves with it.

A star too faint to light a pixel in every frame lights one in some frames: its light is then a rate
of pulses (a sigma-delta modulation). Each star begins at another point of that cycle, so that
similar stars do not blink in step. A star's remainder lasts for as long as every frame shows the
star; a star that comes back begins anew.
"""

import numpy as np

from hilstar.basics.arrays import Float32Array, IntArray
from hilstar.display.balance import Weights
from hilstar.display.exact import Carried, ExactQuantiser, Left, nothing_carried
from hilstar.display.footprints import PixelOrder
from hilstar.display.panel import Panel
from hilstar.display.quantise import mask_turn
from hilstar.display.response import Levels
from hilstar.optics.psf import Psf
from hilstar.optics.sprites import FrameLight

# The largest remainder that a star carries over, in units of its largest step. It is more than the
# 3 that occur. A star that cannot make up for its remainder, as its pixels are white, has so little
# of it that it is right a few frames after it can again.
MAX_CARRIED_STEPS = 8.0
# 2^32 over the golden ratio: any number of its multiples, modulo 2^32, are spread evenly
GOLDEN = 2654435769
NONE_BEFORE = -1


class TemporalQuantiser(ExactQuantiser):
    """Computes the levels of successive frames, each of which makes up for the errors that the one
    before left.
    """

    words = (
        "and so that each frame makes up for what the one before left, by which the mean of any N"
        " frames is about N times as right."
    )
    other_codes = 0.35
    # Over frames no star weighs its light more, or faint stars' moments would drift; the larger box
    # leaves 0.0034 px in place of 0.0038 over six frames of a star of 66 steps, and the others stay
    # under 0.0031.
    weights = Weights(
        light=1.0,
        moments=0.75,
        window_light=0.8,
        window_moments=3.0,
        box_3=2.2,
        box_5=1.2,
        few_steps=0.0,
        last_light=3.5,
        window_blurs=0.6,
    )
    remembers = True

    @classmethod
    def faintest_e_per_s(cls, panel: Panel, psf: Psf) -> float:
        """0: every star lights a pixel in some frame."""
        return 0.0

    @classmethod
    def exposure(cls, before: int, count: int) -> range:
        """All frames of the exposure, `count` from `before` on, as no two frames are alike."""
        return range(before, before + count)

    @classmethod
    def fewest(cls, order: PixelOrder) -> int:
        """The minimum number of a star's pixels to choose among: all near ones. Any that stay dark
        cause the same error in every frame, and the others cannot make up for it.
        """
        return order.near

    @classmethod
    def floor_turn(cls, number: int) -> float:
        """See `mask_turn`."""
        return mask_turn(number)

    def levels(self, sprites: FrameLight | None, floor: Levels | None = None) -> Levels:
        """The levels of the next frame; see `ExactQuantiser.levels`."""
        # a frame without stars ends the sequence: nothing makes up for the errors before it
        if sprites is None or not len(sprites):
            self.left = None
        return super().levels(sprites, floor)

    def _carried(self, sprites: FrameLight) -> Carried:
        first, _ = ends_of_paths(sprites)
        star = sprites.star[first]
        before = places_before(None if self.left is None else self.left.star, star)
        carried = nothing_carried(len(sprites))
        known = before != NONE_BEFORE
        if self.left is not None:
            carried.error[:, first[known]] = self.left.error[:, before[known]]
        carried.phase[first] = first_phases(star, before)
        return carried

    def _bounded(self, error: Float32Array, step: Float32Array) -> Float32Array:
        """The remainders, limited to MAX_CARRIED_STEPS times each star's largest step."""
        limit = np.float32(MAX_CARRIED_STEPS) * step.max(axis=0)
        return np.clip(error, -limit, limit)

    def _keep(self, sprites: FrameLight, left: Float32Array) -> None:
        """Store the remainder of each star's last sprite for the next frame."""
        _, last = ends_of_paths(sprites)
        self.left = Left(sprites.star[last].copy(), left[:, last])


def ends_of_paths(sprites: FrameLight) -> tuple[IntArray, IntArray]:
    """The indices (stars,) of the first and of the last sprite of each star."""
    if sprites.per_star == 1:
        every = np.arange(len(sprites))
        return every, every
    first = np.flatnonzero(np.diff(sprites.star, prepend=sprites.star[0] - 1))
    return first, np.append(first[1:], len(sprites)) - 1


def places_before(before: IntArray | None, star: IntArray) -> IntArray:
    """The index in `before`, the star numbers of the frame before, of each of `star` (n,), int32
    (n,); NONE_BEFORE for a new star.

    Where a number is there several times, the last counts.
    """
    if before is None or not len(before) or not len(star):
        return np.full(len(star), NONE_BEFORE, dtype=np.int32)
    order = np.argsort(before, kind="stable")
    last = np.searchsorted(before[order], star, side="right") - 1
    place = order[np.maximum(last, 0)]
    is_there = before[place] == star
    return np.where(is_there, place, NONE_BEFORE).astype(np.int32)


def first_phases(star: IntArray, before: IntArray) -> Float32Array:
    """The part of a step (n,), -0.5 to 0.5, by which new stars begin ahead in their cycle; 0 for
    stars that were in the frame before.
    """
    product = star.astype(np.uint64) * np.uint64(GOLDEN)
    low_bits = product & np.uint64(0xFFFFFFFF)
    phase = low_bits.astype(np.float64) / 2**32 - 0.5
    return np.where(before == NONE_BEFORE, phase, 0.0).astype(np.float32)
