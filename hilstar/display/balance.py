"""The ten sums over a star's pixels that `exact` balances, so that any centroider finds its light
and its place.

A centroider's error is a weighted sum of the errors of the pixels, and centroiders differ by their
weights. Those of all are near the span of ten: light and first moments of all pixels, the same
under a Gaussian (a fitted PSF and a Gaussian window, before and after the tracker's own blur), and
moments in boxes of 3 x 3 and 5 x 5 of the tracker's pixels (centres of mass).
"""

import math
from dataclasses import dataclass, field

import numpy as np

from hilstar.basics.arrays import Float32Array, FloatArray
from hilstar.optics.psf import Psf

SUMS = 10
BOX_REACH = 15  # px from a star's nearest pixel; the boxes' weights are tabulated up to there


@dataclass(frozen=True, slots=True)
class Weights:
    """Weights of the sums in a squared error, in light or light times 1 px.

    A star of `few_steps` steps weighs its light twice; its flux is then as near as the panel's step
    allows. `last_light` weighs the light in the last choice, after which no pixel can make up for
    it. `window_blurs` is the Gaussian's variance beyond the sprite's, in variances of the blur: a
    fit has 0 before the blur and 2 after it.
    """

    # Found by search, for the centroider that gains least over rounding in one frame: stars of 46
    # to 95 steps, most of all 66 at 32 x 32 phases.
    light: float = 1.0
    moments: float = 0.587
    window_light: float = 0.676
    window_moments: float = 3.262
    box_3: float = 2.05
    box_5: float = 0.484
    few_steps: float = 8.64
    last_light: float = 1.891
    window_blurs: float = 0.497


@dataclass(frozen=True, slots=True)
class Seen:
    """How a tracker sees the monitor: its optics' blur (sigma) and the side of its pixel, both
    in monitor pixels.
    """

    blur_px: float = 0.62
    pixel_px: float = 1.0


AS_USUAL = Seen()


@dataclass(frozen=True, slots=True)
class Balance:
    """The ten sums of stars of one PSF, seen by one tracker, by weights in one frame or over
    several (`temporal`).
    """

    psf: Psf
    seen: Seen = AS_USUAL
    weights: Weights = field(default_factory=Weights)

    @property
    def window_px(self) -> tuple[float, float]:
        """The Gaussian's sigma along x and y."""
        x_px2, y_px2 = self.psf.variance_px2
        more_px2 = self.weights.window_blurs * self.seen.blur_px**2
        return math.sqrt(x_px2 + more_px2), math.sqrt(y_px2 + more_px2)

    def in_box(
        self, side: int, away_x: FloatArray | Float32Array, away_y: FloatArray | Float32Array
    ) -> FloatArray:
        """The part that is in a box of `side` tracker pixels of a pixel so many pixels from a
        star's nearest.
        """
        half = side * self.seen.pixel_px / 2
        # A box without blur keeps an edge of half a pixel: where the tracker's pixels lie on the
        # monitor's is not known.
        blur = max(self.seen.blur_px, 0.25)
        scale = 1 / (blur * math.sqrt(2))  # scipy.special would take 0.12 s to import
        in_side = []
        for at in range(BOX_REACH + 1):
            below = math.erf((at - half) * scale)
            above = math.erf((at + half) * scale)
            in_side.append((above - below) / 2)
        along_axis = np.array(in_side)
        x = np.minimum(np.abs(away_x), BOX_REACH).astype(np.intp)
        y = np.minimum(np.abs(away_y), BOX_REACH).astype(np.intp)
        return np.asarray(along_axis[x] * along_axis[y])

    def follows(self, side: int) -> tuple[float, float]:
        """How far a star's centre of mass in a box follows the box: 0 where it holds all light,
        1 in an even field.
        """
        slopes = []
        for variance in self.psf.variance_px2:
            # The slope of the mean of a unit Gaussian between -h and h, as both edges move
            sigma_px = math.sqrt(variance + self.seen.blur_px**2)
            h = side * self.seen.pixel_px / 2 / sigma_px
            density = math.exp(-(h**2) / 2) / math.sqrt(2 * math.pi)
            slopes.append(2 * h * density / math.erf(h / math.sqrt(2)))
        return slopes[0], slopes[1]

    def arms(
        self, offset_px: Float32Array, fraction_px: Float32Array, steps: Float32Array
    ) -> Float32Array:
        """The factor of each pixel's error in each sum, (SUMS, pixels, n).

        `offset_px` (2, pixels, n) are whole pixels from the stars' own, `fraction_px` (2, n) the
        stars' places from there, `steps` (n,) their light in steps from black.
        """
        fraction = np.asarray(fraction_px, dtype=np.float32)[:, None]
        nearest = np.rint(fraction)
        away = offset_px - nearest
        d = (offset_px - fraction).astype(np.float32)
        off = fraction - nearest
        # An eighth power stands for exp(-u), within 0.033, to save the shader's time.
        sigma_x, sigma_y = self.window_px
        along_x = np.square(d[0] / np.float32(sigma_x))
        along_y = np.square(d[1] / np.float32(sigma_y))
        u = 0.5 * (along_x + along_y)
        window = (1 + u / 8) ** -8
        arms = np.empty((SUMS, *window.shape), dtype=np.float32)
        weights = self.weights
        arms[0] = weights.light * (1 + weights.few_steps / np.maximum(steps, 1e-3))
        arms[1:3] = weights.moments * d
        arms[3] = weights.window_light * window
        arms[4:6] = weights.window_moments * window * d
        for first, side, weight in ((6, 3, weights.box_3), (8, 5, weights.box_5)):
            follows = np.array(self.follows(side), dtype=np.float32)[:, None, None]
            box = np.float32(weight) * self.in_box(side, *away).astype(np.float32)
            arms[first : first + 2] = box * (d + follows * off)
        return arms
