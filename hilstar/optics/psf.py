"""Point spread functions: how the light of a point spreads over pixels.

A `Psf` says what share of a star's light falls into a pixel at any offset, how far that reaches,
and gives the shaders the same arithmetic (shaders/shares.glsl). `GaussianPsf` is the Gaussian of
thesis eq. 4.7: along one axis a pixel's share is (erf((d + 1/2)/(s sqrt 2)) - erf((d - 1/2)/(s sqrt
2)))/2, d from the star's centre to the pixel's centre and s the sigma, both in pixels. `SampledPsf`
is an image on a fine grid: its shares are tabulated by offset and interpolated.
"""

import math
from abc import ABC, abstractmethod
from bisect import bisect_left
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import count, zip_longest
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from hilstar.basics.arrays import Float32Array, FloatArray
from hilstar.basics.errors import InputError
from hilstar.basics.image_files import ImageSizeError, opened_fits
from hilstar.basics.reading import named_bytes

# The maximum share of a star's flux outside its footprint, at the worst sub-pixel phase. 1e-5 would
# be enough for the flux; but at sigma 3 px the centroid would then move by 1e-4 px, so a tenth of
# that is cut, at the cost of one pixel. results/tradeoff.csv, psf: 10 px at sigma 0.85 are on the
# front; 8 px save a tenth and cut 4e-5 mag.
MAX_CUT = 1e-6
MAX_GAUSSIAN_PX = 100_000  # the largest footprint that is tried
PIXEL_VARIANCE = 1 / 12  # variance of a square pixel, px squared
SQRT2 = math.sqrt(2.0)
# Error of the polynomial in a pixel along one axis, relative to a star's flux. The float32 erf is
# 4.4e-7 off.
MAX_SHARE_ERROR = 1e-7
MIN_DEGREE, MAX_DEGREE = 3, 8  # beyond it a polynomial costs as much as erf
# distances that the polynomial is fitted to; rounds of Lawson's weights
FIT_PLACES, FIT_ROUNDS = 120, 15
BOUND_PLACES = 200  # along an axis, at which an upper bound is taken
# The rational approximation of erf in shaders/shares.glsl, above and below the line, the highest
# power first.
ERF_REACH = 4.0
ERF_ABOVE = (
    -2.72614225801306e-10,
    2.77068142495902e-08,
    -2.10102402082508e-06,
    -5.69250639462346e-05,
    -7.34990630326855e-04,
    -2.95459980854025e-03,
    -1.60960333262415e-02,
)
ERF_BELOW = (
    -1.45660718464996e-05,
    -2.13374055278905e-04,
    -1.68282697438203e-03,
    -7.37332916720468e-03,
    -1.42647390514189e-02,
)
# A sampled PSF. Its footprint leaves out so much of its light at the worst phase; what is left is
# scaled to the star's rate.
MAX_SAMPLED_CUT = 1e-4
# share of a PSF's light below zero, of noise or of a spline's overshoot: it is set to zero
MAX_NEGATIVE = 0.02
MAX_UNEVEN = 0.05  # by which the light of a star's pixels may change with its place in a pixel
SPLINE_DEGREE: Final = 5  # the spline through the samples
BLACK_SAMPLES = 12  # so many stand round them
# Shares are tabulated at most so finely, and with so many places along a side, or twice as many for
# FINE_STEPS_A_PX. Interpolated linearly they are off by an eighth of the squared step times their
# curvatures: 7e-5 of a star's light in a pixel at a sigma of 0.5 px. An Airy pattern with a core of
# 0.6 px is off by 3e-4 in a footprint of 100 px, by 1.2e-3 in one of 200.
MAX_STEPS_A_PX, FINE_STEPS_A_PX, MAX_TABLE_SIDE = 64, 20, 1024
MAX_FOOTPRINT_PX = 255  # as any OpenGL draws
# the Gaussian nearest to a sampled PSF; how often it is fitted anew
MIN_WIDTH_PX, WIDTH_ROUNDS = 0.05, 60
# Gaussians along the side of a lit square, in sides, in place of its light. Thirds of it: against
# squares a star's centroid is off by 3e-6 px and its flux by 1e-9 mag on the demo's bench (a
# monitor pixel is 0.9 tracker pixels, the PSF's sigma 0.55), by 1e-5 px with a PSF of 0.3, by 1e-4
# px with monitor pixels of 2.7 tracker pixels. Two are off by 3e-6 px on the demo's bench too, for
# their fourth moment is near the square's; by 5e-5 where a side is 2 sigmas of the PSF.
TWO, TWO_UP_TO_SIGMAS = np.array([-0.2525, 0.2525]), 1.7
# A Gaussian's side of a wide square: its edge is then softer than the PSF's by 2 % of sigma. By
# thirds of 4.2 tracker pixels before a PSF of 0.55 it is softer by 24 %, which a fit of the PSF to
# dots takes for the PSF's own. What is sharper than SHARPEST_PX is summed up by pixels anyway.
FINE_SIGMAS, MIN_PARTS, MAX_PARTS, SHARPEST_PX = 0.7, 3, 16, 0.2
ONE_PSF = "one PSF for all stars"  # by this name it may be chosen
# A PSF that is the same for all light gives all of it to one wavelength, whichever.
ALL_LIGHT, ONE_WAVELENGTH_NM = np.ones(1), np.array([550.0])
MAX_FILE_BYTES = 20_000_000
FILE_ADVICE = "give a FITS file with one image of odd sides, the chief ray in its middle"


class ShareShader(NamedTuple):
    """What shares.glsl needs of a PSF: lines to define before it, its uniforms by name, and its
    table (h, w, channels), if it has one.
    """

    defines: tuple[str, ...]
    uniforms: dict[str, tuple[float, float]]
    table: Float32Array | None = None


class Reach(NamedTuple):
    """The ellipse about a star within which a pixel of its footprint can get more than a share s of
    its light.

    It is x^2 / `axes_px2[0]` + y^2 / `axes_px2[1]` < log(`factor` / s), with x and y from the star,
    px.
    """

    axes_px2: tuple[float, float]
    factor: float


class Psf(ABC):
    """How the light of a point spreads over pixels. Offsets are pixel centre minus star, px, x
    right and y down.

    `by_place` and `by_colour` say whether it changes over the field and with a star's spectrum. One
    that does has an odd footprint and overrides `stamps_at`, `image` and `centroids_px`: those who
    draw ask these. A spectrum is the shares (L,) that light has at each of a PSF's L wavelengths,
    or (n, L) of n stars; `mean_shares` (L,) are those of light without a spectrum of its own.
    """

    by_place = False
    by_colour = False
    mean_shares: FloatArray = ALL_LIGHT
    wavelengths_nm: FloatArray = ONE_WAVELENGTH_NM
    # whether a share is the product of one along x and one along y, as exact.comp takes it
    separable = False

    @property
    @abstractmethod
    def width_px(self) -> tuple[float, float]:
        """The sigma of the Gaussian nearest to it, before the pixel, along x and y: paths and
        windows are sized by it.
        """

    @property
    @abstractmethod
    def footprint_px(self) -> int:
        """The side of the square within which a star is drawn."""

    @property
    @abstractmethod
    def peak_share(self) -> float:
        """The largest share that one pixel can get, at any phase."""

    @property
    @abstractmethod
    def reach(self) -> Reach:
        """The ellipse beyond which a pixel of a footprint has less than a share of the light."""

    @abstractmethod
    def shares(self, x_px: FloatArray, y_px: FloatArray) -> FloatArray:
        """Shares of a star's light in pixels at these offsets, which are broadcast against each
        other.
        """

    @abstractmethod
    def stamps(
        self, fraction_px: FloatArray, electrons_per_s: FloatArray | Float32Array, side_px: int
    ) -> Float32Array:
        """The light of n stars in squares of pixels (side, side, n): rows, columns, stars.

        `fraction_px` (2, n) is each star's x and y from the middle of its pixel, which is the
        (side - 1) // 2-th of its square.
        """

    def drawn_stamps(
        self, fraction_px: Float32Array, rates: Float32Array, side_px: int, footprint_px: int
    ) -> Float32Array:
        """As `stamps`, of rates in any unit, by the arithmetic of `shader` for a footprint that
        holds all of these pixels.
        """
        return self.stamps(fraction_px.astype(np.float64), rates, side_px)

    @abstractmethod
    def spread(
        self,
        x_px: FloatArray,
        y_px: FloatArray,
        electrons_per_s: FloatArray,
        region: tuple[int, int, int, int],
    ) -> Float32Array:
        """The light of n points in all pixels of a region: left, top, width, height."""

    def stamps_at(
        self,
        x_px: FloatArray,
        y_px: FloatArray,
        spectra: FloatArray,
        electrons_per_s: FloatArray | Float32Array | None = None,
    ) -> Float32Array:
        """The light of stars at places (n,) in squares (n, side, side) about the pixels nearest to
        them: of 1 electron per second each without `electrons_per_s` (n,).

        The side is odd: the footprint's, or one more.
        """
        rates = np.ones(len(x_px)) if electrons_per_s is None else electrons_per_s
        fraction_x = x_px - np.floor(x_px + 0.5)
        fraction_y = y_px - np.floor(y_px + 0.5)
        fraction_px = np.stack([fraction_x, fraction_y])
        stamps = self.stamps(fraction_px, rates, self.footprint_px | 1)
        return np.moveaxis(stamps, 2, 0)

    def image(
        self,
        x_px: FloatArray,
        y_px: FloatArray,
        spectra: FloatArray,
        electrons_per_s: FloatArray | Float32Array,
        resolution_px: tuple[int, int],
    ) -> Float32Array:
        """The light of stars at places (n,) in all pixels (height, width), electrons per second."""
        rates = np.asarray(electrons_per_s, dtype=np.float64)
        return self.spread(x_px, y_px, rates, (0, 0, *resolution_px))

    def centroids_px(
        self, x_px: FloatArray, y_px: FloatArray, spectra: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The centroids (n,) of the light of stars at places (n,), px, and their illumination
        relative to the axis.
        """
        return x_px, y_px, np.ones(len(x_px))

    @property
    def in_the_middle(self) -> "Psf":
        """The one PSF of all stars that comes nearest: of the field's middle and mean light."""
        return self

    def simpler(self) -> Iterator[tuple[str, Callable[[], "Psf"]]]:
        """PSFs that are cheaper to draw, the cheapest first: the name of each, and a function that
        makes it. None by default.
        """
        yield from ()

    @property
    def components(self) -> int:
        """How many images a star's PSF is the sum of."""
        return 1

    @abstractmethod
    def cut_share(self, size_px: int) -> float:
        """The flux outside a square of `size_px`, for a star half a pixel off its centre (the
        worst).
        """

    @abstractmethod
    def outside_share(self, size_px: int) -> float:
        """The largest share of a star's light in one pixel outside a square sprite, at the worst
        phase.
        """

    @abstractmethod
    def shader(self, side_px: int) -> ShareShader:
        """The same shares for shaders/shares.glsl, right within a footprint of `side_px`."""

    @abstractmethod
    def blurred(self, sigma_px: float) -> "Psf":
        """This PSF convolved with a round Gaussian."""

    @property
    def variance_px2(self) -> tuple[float, float]:
        """Variance of the nearest Gaussian and of a square pixel together, along x and y."""
        x, y = self.width_px
        return x**2 + PIXEL_VARIANCE, y**2 + PIXEL_VARIANCE


@dataclass(frozen=True)
class GaussianPsf(Psf):
    """A Gaussian of its own sigma along x and along y."""

    sigma_px: tuple[float, float]
    separable = True

    @property
    def width_px(self) -> tuple[float, float]:
        """The sigmas."""
        return self.sigma_px

    @cached_property
    def footprint_px(self) -> int:
        """The side of the smallest square that cuts at most MAX_CUT of a star's flux. InputError
        where none is enough.
        """
        sizes = range(1, MAX_GAUSSIAN_PX + 1)
        place = bisect_left(sizes, -MAX_CUT, key=lambda size: -self.cut_share(size))
        if place == len(sizes):
            raise InputError(
                f"sprite sigma {self.sigma_px} px: too large for any footprint; write a few pixels"
            )
        return sizes[place]

    @cached_property
    def peak_share(self) -> float:
        """The share of the pixel that a star is centred on."""
        sigma_x, sigma_y = self.sigma_px
        return pixel_share(0.0, sigma_x) * pixel_share(0.0, sigma_y)

    @cached_property
    def reach(self) -> Reach:
        """A Gaussian's ellipse with the factor that the integral over pixels needs."""
        places = np.linspace(0.0, self.footprint_px / 2 + 0.5, BOUND_PLACES)
        axes_px2 = []
        log_factor = 0.0
        for sigma in self.sigma_px:
            axis_px2 = 2 * (sigma**2 + 1 / 12)
            logs = np.log(np.maximum(pixel_shares(places, sigma), 1e-300))
            axes_px2.append(axis_px2)
            log_factor += float((logs + places**2 / axis_px2).max())
        return Reach((axes_px2[0], axes_px2[1]), math.exp(log_factor))

    def shares(self, x_px: FloatArray, y_px: FloatArray) -> FloatArray:
        """The product of the shares along both axes."""
        sigma_x, sigma_y = self.sigma_px
        if sigma_x == sigma_y and x_px.shape == y_px.shape:  # one call in place of two
            both = pixel_shares(np.stack([x_px, y_px]), sigma_x)
            return np.asarray(both[0] * both[1])
        return pixel_shares(x_px, sigma_x) * pixel_shares(y_px, sigma_y)

    def stamps(
        self, fraction_px: FloatArray, electrons_per_s: FloatArray | Float32Array, side_px: int
    ) -> Float32Array:
        """See `Psf.stamps`: the share of each column times the share of each row."""
        from scipy.special import ndtr  # 0.1 s of every command that needs none of it

        first_edge = (side_px - 1) // 2 + 0.5
        edges = np.arange(side_px + 1)[:, None] - first_edge
        fraction_x, fraction_y = fraction_px
        sigma_x, sigma_y = self.sigma_px
        across = np.diff(ndtr((edges - fraction_x) / sigma_x), axis=0)
        down = np.diff(ndtr((edges - fraction_y) / sigma_y), axis=0)
        down *= electrons_per_s
        across_32 = across.astype(np.float32)
        down_32 = down.astype(np.float32)
        return np.asarray(across_32[None] * down_32[:, None])

    def drawn_stamps(
        self, fraction_px: Float32Array, rates: Float32Array, side_px: int, footprint_px: int
    ) -> Float32Array:
        """In float32, along x and along y."""
        pixel = np.arange(side_px, dtype=np.float32) - (side_px - 1) // 2
        offset_px = pixel[:, None]
        sigma_x, sigma_y = self.sigma_px
        across = shader_shares(offset_px - fraction_px[0], sigma_x, footprint_px)
        down = shader_shares(offset_px - fraction_px[1], sigma_y, footprint_px)
        down *= rates
        return across[None] * down[:, None]

    def spread(
        self,
        x_px: FloatArray,
        y_px: FloatArray,
        electrons_per_s: FloatArray,
        region: tuple[int, int, int, int],
    ) -> Float32Array:
        """One product of all rows and all columns."""
        from scipy.special import ndtr  # as in `stamps`

        left, top, width, height = region
        sigma_x, sigma_y = self.sigma_px
        edges_x = left - 0.5 + np.arange(width + 1)
        edges_y = top - 0.5 + np.arange(height + 1)
        across = np.diff(ndtr((edges_x - x_px[:, None]) / sigma_x), axis=1)
        down = np.diff(ndtr((edges_y - y_px[:, None]) / sigma_y), axis=1)
        return np.asarray((down * electrons_per_s[:, None]).T @ across, dtype=np.float32)

    def cut_share(self, size_px: int) -> float:
        """See `Psf.cut_share`: axis by axis, from the complements of both edges."""
        inside = 1.0
        for sigma in self.sigma_px:
            beyond_near = math.erfc((size_px / 2 - 0.5) / (sigma * SQRT2))
            beyond_far = math.erfc((size_px / 2 + 0.5) / (sigma * SQRT2))
            inside *= 1.0 - 0.5 * (beyond_near + beyond_far)
        return 1.0 - inside

    def outside_share(self, size_px: int) -> float:
        """See `Psf.outside_share`: that of a pixel beside the middle of an edge."""
        sigma_x, sigma_y = self.sigma_px
        beyond_px = size_px / 2
        beside_x = pixel_share(beyond_px, sigma_x) * pixel_share(0.0, sigma_y)
        beside_y = pixel_share(beyond_px, sigma_y) * pixel_share(0.0, sigma_x)
        return max(beside_x, beside_y)

    def shader(self, side_px: int) -> ShareShader:
        """A polynomial for each axis where one is exact enough (`share_polynomial`), else error
        functions.
        """
        sigma_x, sigma_y = self.sigma_px
        uniforms = {"inverse_sigma_sqrt2": (1 / (sigma_x * SQRT2), 1 / (sigma_y * SQRT2))}
        powers_x = share_polynomial(sigma_x, side_px / 2 + 0.5)
        powers_y = share_polynomial(sigma_y, side_px / 2 + 0.5)
        if powers_x is None or powers_y is None:
            return ShareShader((), uniforms)
        terms = []
        for x, y in zip_longest(powers_x, powers_y, fillvalue=0.0):
            terms.append(f"vec2({x:.9e}, {y:.9e})")
        # Written out: from an array of uniforms llvmpipe takes twice as long.
        polynomial = terms[-1]
        for term in reversed(terms[:-1]):
            polynomial = f"({polynomial} * square + {term})"
        return ShareShader((f"LOG2_SHARE(square) {polynomial}",), uniforms)

    def blurred(self, sigma_px: float) -> "GaussianPsf":
        """A wider Gaussian."""
        x, y = (math.hypot(sigma, sigma_px) for sigma in self.sigma_px)
        return GaussianPsf((x, y))


@dataclass(frozen=True, eq=False)
class SampledPsf(Psf):
    """An image of a PSF, `per_px` samples a pixel along each axis, the chief ray in the middle of
    its middle sample.

    `samples` (height, width), odd sides, x right and y down, is relative light. That of an image
    that is `pixel_integrated` is what pixels centred there would get. Between samples runs a
    spline, and beyond them all is black. A star's pixels sum to its rate: the light outside the
    footprint is shared out among them. Raises InputError for an image that is no PSF.
    """

    samples: FloatArray
    per_px: int = 1
    pixel_integrated: bool = False
    max_negative = MAX_NEGATIVE

    def __post_init__(self) -> None:
        """Refuse what is no PSF."""
        samples = self.samples
        if samples.ndim != 2 or not all(side % 2 for side in samples.shape):
            size_text = " x ".join(map(str, samples.shape[::-1]))
            raise InputError(
                f"a PSF of {size_text} samples has no middle; write an image of odd width and"
                " height"
            )
        if self.per_px < 1:
            raise InputError(f"a PSF of {self.per_px} samples a pixel; write 1 or more")
        if not np.isfinite(samples).all() or samples.sum() <= 0:
            raise InputError(
                "a PSF has samples that are not finite, or no light; write finite ones with a"
                " positive sum"
            )
        # Of stars in a pixel's middle, edges and corner: the smallest sum of shares, and the
        # largest of those below zero
        least = math.inf
        negative = 0.0
        for y in (0, 1):
            for x in (0, 1):
                shares = self._halves[y::2, x::2]
                least = min(least, float(shares.sum()))
                negative = max(negative, float(-shares.clip(max=0).sum()))
        if negative > self.max_negative:
            raise InputError(
                f"{negative:.1%} of a PSF's light is negative; subtract its background, or sample"
                f" it more finely than {self.per_px} a pixel"
            )
        if least < 1 - MAX_UNEVEN:
            raise InputError(
                f"a star's pixels get {least:.1%} of a PSF's light at one place in a pixel, and"
                " more at others: it is not pixel-integrated; write PIXINT = F"
            )
        if self.cut_share(MAX_FOOTPRINT_PX) > MAX_SAMPLED_CUT:
            raise InputError(
                f"a PSF's light reaches over more than {MAX_FOOTPRINT_PX} px; cut off what lies"
                " further out"
            )

    def _before_cut(self, x_px: FloatArray, y_px: FloatArray) -> FloatArray:
        """Shares of pixels at these columns and rows, (len(y_px), len(x_px)), of all the light
        of the image.
        """
        # 0.2 s of every command that needs none of it
        from scipy.interpolate import make_interp_spline

        density = self.samples / self.samples.sum() * self.per_px**2
        for axis, at_px in ((0, y_px), (1, x_px)):
            black = [(0, 0), (0, 0)]
            black[axis] = (BLACK_SAMPLES, BLACK_SAMPLES)
            density = np.pad(density, black)
            size = density.shape[axis]
            place_px = (np.arange(size) - size // 2) / self.per_px
            spline = make_interp_spline(place_px, density, SPLINE_DEGREE, axis=axis)
            last_px = place_px[-1]
            if self.pixel_integrated:
                density = spline(np.clip(at_px, -last_px, last_px))
            else:
                light = spline.antiderivative()
                low = light(np.clip(at_px - 0.5, -last_px, last_px))
                high = light(np.clip(at_px + 0.5, -last_px, last_px))
                density = high - low
        return np.asarray(density)

    @cached_property
    def _halves(self) -> FloatArray:
        """Shares at each half pixel, far enough that the last are black."""
        reach_samples = max(self.samples.shape) // 2 + BLACK_SAMPLES
        last = 2 * math.ceil(reach_samples / self.per_px + 1)
        at_px = np.arange(-last, last + 1) / 2
        return self._before_cut(at_px, at_px)

    @cached_property
    def width_px(self) -> tuple[float, float]:
        """Adaptive moments (Bernstein and Jarvis 2002), less a pixel's own variance."""
        at_px = self._offsets_px
        middle = np.zeros(2)
        variance = np.ones(2)
        # a Gaussian weight as wide as the PSF halves its variance and its distance
        for _ in range(WIDTH_ROUNDS):
            powers = at_px ** np.arange(3)[:, None]
            from_middle_px = at_px - middle[:, None]
            weight_x, weight_y = np.exp(-(from_middle_px**2) / (2 * variance[:, None]))
            across = powers * weight_x
            down = powers * weight_y
            sums = down @ self._table @ across.T  # powers of y, powers of x
            light = sums[0, 0]
            mean = np.array([sums[0, 1], sums[1, 0]]) / light
            mean_square = np.array([sums[0, 2], sums[2, 0]]) / light
            weighted_variance = mean_square - mean**2
            variance = np.maximum(2 * weighted_variance, PIXEL_VARIANCE)
            middle = 2 * mean - middle
        width_px2 = np.maximum(variance - PIXEL_VARIANCE, MIN_WIDTH_PX**2)
        x, y = np.sqrt(width_px2).tolist()
        return x, y

    @cached_property
    def footprint_px(self) -> int:
        """The side of the smallest odd square that cuts at most MAX_SAMPLED_CUT of the light."""
        return next(size for size in count(1, 2) if self.cut_share(size) <= MAX_SAMPLED_CUT)

    @cached_property
    def _steps(self) -> int:
        """Places of the table to a pixel, an even number."""
        side_steps = MAX_TABLE_SIDE // self.footprint_px
        fine_steps = min(FINE_STEPS_A_PX, 2 * MAX_TABLE_SIDE // self.footprint_px)
        steps = min(MAX_STEPS_A_PX, max(fine_steps, side_steps))
        return steps // 2 * 2

    @cached_property
    def _table(self) -> Float32Array:
        """Shares by offset, 1 / `_steps` px apart, from -footprint / 2 px: those of a star's pixels
        sum to 1 at each phase.

        Linear interpolation keeps their sum, and their centroid, at all phases between. At the
        edges they are 0.
        """
        side_px = self.footprint_px
        steps = self._steps
        at_px = np.arange(side_px * steps) / steps - side_px / 2
        shares = np.maximum(self._before_cut(at_px, at_px), 0.0)
        shares[0] = 0.0
        shares[:, 0] = 0.0
        of_phases = shares.reshape(side_px, steps, side_px, steps)
        of_phases /= of_phases.sum(axis=(0, 2), keepdims=True)
        # by rows: `shares` looks into the flat table, which must not be copied at each look
        return np.ascontiguousarray(np.pad(shares, (0, 1)), dtype=np.float32)

    @property
    def _offsets_px(self) -> FloatArray:
        """The offsets (n,) of the table's rows, and of its columns, px."""
        count = len(self._table)
        return np.asarray((np.arange(count) - count // 2) / self._steps)

    @cached_property
    def peak_share(self) -> float:
        """The largest of the table."""
        return float(self._table.max())

    @cached_property
    def reach(self) -> Reach:
        """The smallest ellipse with the PSF's axes that holds all shares over a ten-thousandth
        of the largest.
        """
        squares = self._offsets_px**2
        logs = np.log(np.maximum(self._table, 1e-30))
        smallest_share_log = math.log(1e-4 * self.peak_share)
        variance_x, variance_y = self.variance_px2
        smallest_px2 = math.inf
        for scale in 2 * np.geomspace(1.0, 300.0, 20):
            x = float(scale) * variance_x
            y = float(scale) * variance_y
            log_factors = logs + squares / x + squares[:, None] / y
            # the table is interpolated
            log_factor = float(log_factors.max()) + 0.01
            reach_px2 = scale * (log_factor - smallest_share_log)
            if reach_px2 < smallest_px2:
                smallest_px2 = reach_px2
                ellipse = Reach((x, y), math.exp(log_factor))
        return ellipse

    def shares(self, x_px: FloatArray, y_px: FloatArray) -> FloatArray:
        """Linear between the four nearest of the table; 0 beyond it."""
        last = len(self._table) - 1
        at_x = np.clip(x_px * self._steps + last / 2, 0, last)
        at_y = np.clip(y_px * self._steps + last / 2, 0, last)
        column = np.minimum(at_x.astype(np.intp), last - 1)
        row = np.minimum(at_y.astype(np.intp), last - 1)
        x = at_x - column
        y = at_y - row
        table = self._table.ravel()
        first = row * (last + 1) + column
        above = (1 - x) * table[first] + x * table[first + 1]
        first = first + (last + 1)
        below = (1 - x) * table[first] + x * table[first + 1]
        return np.asarray((1 - y) * above + y * below)

    def stamps(
        self, fraction_px: FloatArray, electrons_per_s: FloatArray | Float32Array, side_px: int
    ) -> Float32Array:
        """See `Psf.stamps`: all offsets at once."""
        pixel = np.arange(side_px) - (side_px - 1) // 2
        fraction_x, fraction_y = fraction_px
        x = pixel[:, None] - fraction_x
        y = pixel[:, None] - fraction_y
        shares = self.shares(x[None], y[:, None])
        return np.asarray(shares * electrons_per_s, dtype=np.float32)

    def spread(
        self,
        x_px: FloatArray,
        y_px: FloatArray,
        electrons_per_s: FloatArray,
        region: tuple[int, int, int, int],
    ) -> Float32Array:
        """Point after point: each has its own pixels."""
        left, top, width, height = region
        image = np.zeros((height, width))
        columns = np.arange(left, left + width)
        rows = np.arange(top, top + height)
        half_px = self.footprint_px / 2
        for x, y, light in zip(x_px, y_px, electrons_per_s, strict=True):
            near_x = np.abs(columns - x) < half_px
            near_y = np.abs(rows - y) < half_px
            shares = self.shares(columns[near_x] - x, rows[near_y, None] - y)
            image[np.ix_(near_y, near_x)] += light * shares
        return image.astype(np.float32)

    def cut_share(self, size_px: int) -> float:
        """See `Psf.cut_share`: the largest for stars on the four corners of a pixel, by the shares
        at half pixels.
        """
        first = len(self._halves) // 2 - size_px
        if first < 0:
            return 0.0
        end = first + 2 * size_px
        least = 1.0
        for y in (0, 2):
            for x in (0, 2):
                inside = self._halves[first + y : end + y : 2, first + x : end + x : 2]
                least = min(least, float(inside.sum()))
        return 1 - least

    def outside_share(self, size_px: int) -> float:
        """See `Psf.outside_share`: the largest share of the table beyond half of that side."""
        far = np.abs(self._offsets_px) >= size_px / 2
        in_rows = self._table[far].max(initial=1e-30)
        in_columns = self._table[:, far].max(initial=1e-30)
        return float(max(in_rows, in_columns))

    def shader(self, side_px: int) -> ShareShader:
        """See `Psf.shader`: the table by cells of its grid, each with its four coefficients of
        bilinear interpolation.
        """
        near = self._table[:-1, :-1]
        right = self._table[:-1, 1:]
        down = self._table[1:, :-1]
        both = self._table[1:, 1:]
        twist = both - right - down + near
        cells = np.stack([near, right - near, down - near, twist], axis=2)
        defines = (f"SHARE_STEPS {self._steps}.0",)
        return ShareShader(defines, {}, np.ascontiguousarray(cells))

    def blurred(self, sigma_px: float) -> "SampledPsf":
        """The samples convolved, with room for what spreads beyond them."""
        from scipy.ndimage import fourier_gaussian

        sigma = sigma_px * self.per_px
        wide = np.pad(self.samples, math.ceil(6 * sigma))
        transformed = fourier_gaussian(np.fft.fft2(wide), sigma)
        spread = np.fft.ifft2(transformed).real
        return SampledPsf(spread, self.per_px, self.pixel_integrated)


def read_psf(path: Path) -> SampledPsf:
    """The PSF of a FITS file's first image, by OVERSAMP (1) and PIXINT (F) of its header; its first
    row is the top one.

    The same file again is the same PSF. Raises InputError for a file that is no such image.
    """
    return _psf_in(path, named_bytes(path, FILE_ADVICE, MAX_FILE_BYTES))


@lru_cache(maxsize=4)
def _psf_in(path: Path, content: bytes) -> SampledPsf:
    try:
        with opened_fits(content) as hdus:
            image = np.asarray(hdus[0].data)
            header = hdus[0].header
            per_px = header.get("OVERSAMP", 1)
            integrated = header.get("PIXINT", False)
    except ImageSizeError as error:
        raise InputError(f"{path}: {error}; {FILE_ADVICE}") from error
    except Exception as error:  # astropy raises whatever a broken header causes in its layers
        raise InputError(f"{path}: not a FITS image; {FILE_ADVICE}") from error
    if not image.ndim:
        raise InputError(f"{path}: not a FITS image; {FILE_ADVICE}")
    if image.ndim == 3:
        if len(image) > 1:
            raise InputError(
                f"{path}: holds {len(image)} images, and one PSF is drawn all over the field; write"
                " one of them"
            )
        image = image.reshape(image.shape[1:])
    if type(per_px) is not int or type(integrated) is not bool:
        raise InputError(
            f"{path}: OVERSAMP is {per_px!r} and PIXINT {integrated!r}; write a whole number, and T"
            " or F"
        )
    try:
        return SampledPsf(image.astype(np.float64), per_px, integrated)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def square_points(side_px: float, psf: Psf) -> tuple[FloatArray, Psf]:
    """Gaussians that together stand for the light of an evenly lit square: their places along its
    side, in sides from its middle, and the PSF of each.

    The PSF is `psf`, widened by the variance of the square that the places lack; `side_px` is in
    its pixels.
    """
    narrow_px = min(psf.width_px)
    if isinstance(psf, GaussianPsf) and side_px <= TWO_UP_TO_SIGMAS * narrow_px:
        points = TWO
    else:
        apart_px = FINE_SIGMAS * max(narrow_px, SHARPEST_PX)
        wanted = math.ceil(side_px / apart_px)
        parts = min(max(wanted, MIN_PARTS), MAX_PARTS)
        points = (np.arange(parts) + 0.5) / parts - 0.5
    variance = float(np.mean(points**2))
    spread_px = side_px * math.sqrt(PIXEL_VARIANCE - variance)
    return points, psf.blurred(spread_px)


def pixel_share(offset_px: float, sigma_px: float) -> float:
    """The share of a Gaussian star's light, along one axis, in the pixel `offset_px` from its
    centre.

    The complement erfc of both edges keeps the far wings positive and exact where erf differences
    cancel.
    """
    near = abs(offset_px) - 0.5
    far = abs(offset_px) + 0.5
    unit_px = sigma_px * SQRT2
    return 0.5 * (math.erfc(near / unit_px) - math.erfc(far / unit_px))


def pixel_shares(offset_px: FloatArray, sigma_px: float) -> FloatArray:
    """As `pixel_share`, of an array of offsets; same shape."""
    if np.size(offset_px) <= BOUND_PLACES:  # as a bench that opens asks for
        shares = [pixel_share(at, sigma_px) for at in np.ravel(offset_px).tolist()]
        return np.array(shares).reshape(np.shape(offset_px))
    from scipy.special import erfc  # as in `stamps`

    near = np.abs(offset_px) - 0.5
    far = np.abs(offset_px) + 0.5
    unit_px = sigma_px * SQRT2
    return np.asarray(0.5 * (erfc(near / unit_px) - erfc(far / unit_px)))


def shader_shares(offset_px: Float32Array, sigma_px: float, footprint_px: int) -> Float32Array:
    """As `pixel_shares`, by the arithmetic of shaders/shares.glsl: (side, n) of pixels in rows of a
    pixel's step, within a footprint.
    """
    powers = share_polynomial(sigma_px, footprint_px / 2 + 0.5)
    if powers is None:
        half = np.float32(0.5)
        edges = np.concatenate([offset_px - half, offset_px[-1:] + half])
        edges *= np.float32(1 / (sigma_px * SQRT2))
        share: Float32Array = np.diff(_shader_erf(edges), axis=0)
        return np.maximum(share, 0) * np.float32(0.5)
    square = offset_px * offset_px
    log2 = np.full_like(square, powers[-1])
    for power in reversed(powers[:-1]):
        log2 *= square
        log2 += np.float32(power)
    return np.exp2(log2, out=log2)


def _shader_erf(value: Float32Array) -> Float32Array:
    """The error function by the rational approximation of shaders/shares.glsl."""
    x = np.clip(value, np.float32(-ERF_REACH), np.float32(ERF_REACH))
    square = x * x
    above = np.full_like(x, ERF_ABOVE[0])
    below = np.full_like(x, ERF_BELOW[0])
    for sum_, terms in ((above, ERF_ABOVE), (below, ERF_BELOW)):
        for term in terms[1:]:
            sum_ *= square
            sum_ += np.float32(term)
    return x * above / below


@lru_cache(maxsize=16)
def share_polynomial(sigma_px: float, reach_px: float) -> tuple[float, ...] | None:
    """Coefficients, constant first, of log2 of a pixel's share as a polynomial of its distance
    squared (px^2).

    Within `reach_px` its power of two is within MAX_SHARE_ERROR of `pixel_share`: one power for
    both axes takes half the time of four error functions. None where no degree up to MAX_DEGREE is
    enough: under a sigma of 0.5 px.
    """
    # close together at the edge, as Chebyshev's
    angle = np.linspace(0.0, np.pi / 2, FIT_PLACES)
    distance_px = reach_px * np.sin(angle)
    shares = np.array([pixel_share(float(place), sigma_px) for place in distance_px])
    wanted = np.log2(np.maximum(shares, shares[0] * 1e-12))
    scaled = (distance_px / reach_px) ** 2
    for degree in range(MIN_DEGREE, MAX_DEGREE + 1):
        terms = np.polynomial.chebyshev.chebvander(2 * scaled - 1, degree)
        weight = np.maximum(shares / shares[0], 1e-7)
        for _ in range(FIT_ROUNDS):
            weighted_terms = terms * weight[:, None]
            coefficients, *_ = np.linalg.lstsq(weighted_terms, wanted * weight, rcond=None)
            fitted = np.exp2(np.minimum(terms @ coefficients, 0.0))
            error = np.abs(fitted - shares)
            if error.max() <= MAX_SHARE_ERROR:
                chebyshev = np.polynomial.Chebyshev(coefficients, domain=[0.0, reach_px**2])
                power = chebyshev.convert(kind=np.polynomial.Polynomial)
                return tuple(power.coef.tolist())
            # Lawson (1961): towards the smallest maximum
            weight = weight * np.sqrt(error / error.max() + 1e-3)
    return None
