"""The whole units in which pixels add up stars, and how far a star lights them.

Each pixel's light is a sum of whole units, which is the same in whatever order stars are added, and
the same for both ways of drawing them. Nothing here needs OpenGL.
"""

import math

import numpy as np

from hilstar.display.panel import Panel
from hilstar.display.render.target import SpriteSides
from hilstar.optics.psf import Psf
from hilstar.optics.sprites import FrameLight

MAX_SUM = 2**31 - 2**24  # what an int holds, less what a float32 that large is rounded by
MAX_FINE_SUM = 2**52  # what a float64 holds exactly, and as much again for rounding
# Share of the first level's light. Where stars are so many and so bright that a unit would be more,
# points are blended and a processor sums in
# float64.
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
ANY_RATE = 1e-6  # the largest side of all, for stars of any rate, has fewer wings
# float32 light may be rounded up by 1e-7 of it, star by star: the bound of a sum must not be passed
ROUNDED_UP = 1.000001


class LightUnits:
    """The whole units in which pixels add up stars, and the ellipse within which a star lights
    them.

    Both ways of drawing take them, and so choose the same levels. `sides` (see `Target.sides`) say
    how large sprites are at most, and what light of a star alone they may leave out.
    """

    def __init__(
        self, panel: Panel, size_px: tuple[int, int], psf: Psf, sides: SpriteSides = ()
    ) -> None:
        self.panel = panel
        self.size_px = size_px
        self.psf = psf
        self._footprint_px = psf.footprint_px
        gain = panel.gain()
        low, high = (1.0, 1.0) if gain is None else (float(gain.min()), float(gain.max()))
        thresholds = panel.response.thresholds_e_per_s(panel.flux_at_white_e_per_s)
        self.lit_e_per_s = float(thresholds[0]) / high
        self.most_e_per_s = panel.flux_at_white_e_per_s / low
        self._peak_share = psf.peak_share
        self.axes_px2, self._share_bound = psf.reach
        self.wings = float(WINGS)
        # what part of the light that lights a pixel the squares leave out beside them at most: one
        # in so many
        if sides:
            fewest = []
            for side in sides:
                outside_e_per_s = side.below_e_per_s * psf.outside_share(side.side_px)
                wings = self.lit_e_per_s / outside_e_per_s
                if wings > ANY_RATE:
                    fewest.append(wings)
            self.wings = SQUARE_WINGS * max(1.0, min(fewest, default=WINGS / SQUARE_WINGS))
        self.side_px = max((side.side_px for side in sides), default=self._footprint_px)

    def unit_for(self, sprites: FrameLight | None) -> float | None:
        """The unit (e-/s) in which no pixel's sum is too large for an int32; None where it is too
        coarse for the panel.
        """
        unit_e_per_s = self._unit_in(sprites, MAX_SUM)
        if unit_e_per_s > self.lit_e_per_s * MAX_UNIT:
            return None
        return unit_e_per_s

    def fine_unit_for(self, sprites: FrameLight) -> float:
        """The unit (e-/s) in which a float64 holds every sum exactly."""
        return self._unit_in(sprites, MAX_FINE_SUM)

    def _unit_in(self, sprites: FrameLight | None, max_sum: int) -> float:
        """A power of two, from the sum of all stars' brightest pixels, of white at most each."""
        if sprites is None or not len(sprites):
            return self.most_e_per_s
        white_e_per_s = np.float32(self.most_e_per_s / self._peak_share)
        rates = np.minimum(sprites.data["electrons_per_s"], white_e_per_s)
        total_e_per_s = float(rates.sum(dtype=np.float64))
        most_e_per_s = total_e_per_s * self._peak_share * ROUNDED_UP
        most_e_per_s = max(most_e_per_s, self.most_e_per_s)
        room = max_sum - len(sprites)
        exponent = math.ceil(math.log2(most_e_per_s / room))
        return float(2.0**exponent)

    def reach_per_e(self, sprites: FrameLight, alone: bool = False) -> float:
        """The factor of a star's rate whose logarithm, times `axes_px2`, gives the squared half
        axes of its ellipse (px2).

        Of one that stands `alone` no pixel beyond it is lit.
        """
        # how many stars' wings may meet in a pixel
        if alone:
            wings = 1.0
        elif len(sprites) * self._footprint_px**2 > math.prod(self.size_px):
            wings = self.wings * DENSER_WINGS
        else:
            wings = self.wings
        return self._share_bound * sprites.per_star * wings / self.lit_e_per_s
