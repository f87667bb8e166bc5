"""`temporal`: `exact` from frame to frame, so that a star's light and place are right over any
exposure of several frames.

What a frame leaves of the ten sums of `balance` the same star has to make up for in the next one.
The errors of any N frames in a row add up to the difference of two such remainders, each about as
large as the error of one frame of `exact`: their mean falls as 1/N, whichever frame the exposure
begins with, and with parts of a frame at its ends. A remainder is about the star's own centre and
moves with it. A star too faint to light a pixel in every frame lights one in some: its light is
then a rate of pulses (a sigma-delta modulation), and each star begins at a place of its own in that
cycle, so that alike stars do not blink in step. A star keeps its remainder for as long as every
frame has it, and begins anew when it comes back.
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

# What a star is given to make up for, in its largest steps: more than the 3 that occur, little
# enough for one that cannot (its pixels are white) to be right again a few frames after it can.
MAX_CARRIED_STEPS = 8.0
# 2^32 over the golden ratio: its multiples, modulo 2^32, are spread evenly, any number of them
GOLDEN = 2654435769
NONE_BEFORE = -1


class TemporalQuantiser(ExactQuantiser):
    """Levels of one frame after another, each of which makes up for what the last one left."""

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
        """All frames of the exposure: each is unlike the one before."""
        return range(before, before + count)

    @classmethod
    def fewest(cls, order: PixelOrder) -> int:
        """All pixels: those that stay dark are off the same way in each frame, and the others
        cannot make up for it.
        """
        return order.near

    @classmethod
    def floor_turn(cls, number: int) -> float:
        """See `mask_turn`."""
        return mask_turn(number)

    def levels(self, sprites: FrameLight | None, floor: Levels | None = None) -> Levels:
        """The levels of the next frame, as `exact`'s."""
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
        """At most MAX_CARRIED_STEPS of each star's largest step."""
        limit = np.float32(MAX_CARRIED_STEPS) * step.max(axis=0)
        return np.clip(error, -limit, limit)

    def _keep(self, sprites: FrameLight, left: Float32Array) -> None:
        """Keep what the last sprite of each star leaves, for the next frame."""
        _, last = ends_of_paths(sprites)
        self.left = Left(sprites.star[last].copy(), left[:, last])


def ends_of_paths(sprites: FrameLight) -> tuple[IntArray, IntArray]:
    """The places of the first and of the last sprite of each star."""
    if sprites.per_star == 1:
        every = np.arange(len(sprites))
        return every, every
    first = np.flatnonzero(np.diff(sprites.star, prepend=sprites.star[0] - 1))
    return first, np.append(first[1:], len(sprites)) - 1


def places_before(before: IntArray | None, star: IntArray) -> IntArray:
    """Where each of `star` (n,) was among those of the frame before, int32 (n,); NONE_BEFORE for
    new ones.

    Of several of one number the last counts.
    """
    if before is None or not len(before) or not len(star):
        return np.full(len(star), NONE_BEFORE, dtype=np.int32)
    order = np.argsort(before, kind="stable")
    last = np.searchsorted(before[order], star, side="right") - 1
    place = order[np.maximum(last, 0)]
    is_there = before[place] == star
    return np.where(is_there, place, NONE_BEFORE).astype(np.int32)


def first_phases(star: IntArray, before: IntArray) -> Float32Array:
    """The part of a step (n,), -0.5 to 0.5, that new stars have in hand; 0 for those that were
    there before.
    """
    product = star.astype(np.uint64) * np.uint64(GOLDEN)
    low_bits = product & np.uint64(0xFFFFFFFF)
    phase = low_bits.astype(np.float64) / 2**32 - 0.5
    return np.where(before == NONE_BEFORE, phase, 0.0).astype(np.float32)
