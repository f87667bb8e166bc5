"""The point spread function (PSF) of photographs, a core that changes over the field and with
colour, and wings; and the measurement of stars by it.

The core is an elliptical Gaussian. Its covariance is a polynomial of the place in the image, times
a factor that depends on B-V, as a lens focuses one colour only. The wings are a round Gaussian with
a share of the light. Both are integrated over pixels.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import expit

from hilstar.basics.arrays import BoolArray, FloatArray
from hilstar.instruments.confront.camera_fit import minimised
from hilstar.optics.psf_fit import (
    PixelGaussians,
    PointGaussians,
    PointImages,
    fit_each,
    normal_equations,
    place_terms,
)

STAMP_PX = 11
HALF = STAMP_PX // 2
NODES = 3  # of quadrature in a pixel: its light is right to 1e-3 for a sigma of 0.35 px or more
# Rounds in which each star's own Gaussian is fitted; the fit of the PSF begins at their median.
START_ROUNDS = 4
MIN_SIGMA_PX, MAX_SIGMA_PX = 0.15, 5.0
MEAN_BV_MAG = 0.65
PLACE_STEPS, SHAPE_ROUNDS = 8, 2
PLACE_DONE_PX = 1e-3
SHAPE_GAIN = 0.1  # the fit ends with a step that lowers the loss by less
WING_SIGMA_PX = 0.8, 6.0
# Error of the model as a share of a pixel's light. It limits the weight of bright stars, so that
# none outvotes all others.
MODEL_ERROR = 0.01
STARS_FOR = ((40, 6), (12, 2), (0, 1))  # from how many stars on how many field terms are fitted


@dataclass(frozen=True, slots=True)
class StarPsf:
    """A point spread function over an image of `size_px`.

    `covariance` (3, terms) are the coefficients, px^2, of the core's xx, yy and xy. The terms are
    1, r^2, u, v, u^2 - v^2 and u v, of the place (u, v) from the image's middle in half diagonals.
    `colour` is the relative change of the covariance per magnitude of B-V. `wing_share` is the
    wings' share of the light, `wing_sigma_px` their sigma.
    """

    covariance: FloatArray
    colour: float
    wing_share: float
    wing_sigma_px: float
    size_px: tuple[int, int]

    def core(self, x_px: FloatArray, y_px: FloatArray, bv_mag: FloatArray) -> FloatArray:
        """The core's covariances xx, yy and xy (n, 3), px^2, at places (n,), px, for stars of
        colour B-V (n,), without the widening by pixels. NaN as a colour counts as MEAN_BV_MAG.
        """
        count = self.covariance.shape[1]
        terms = field_terms(x_px, y_px, self.size_px)[:, :count]
        covariance = terms @ self.covariance.T
        redness_mag = np.nan_to_num(bv_mag, nan=MEAN_BV_MAG) - MEAN_BV_MAG
        factor = np.clip(1 + self.colour * redness_mag, 0.3, 3.0)
        covariance *= factor[:, None]
        covariance[:, :2] = np.clip(covariance[:, :2], MIN_SIGMA_PX**2, MAX_SIGMA_PX**2)
        # kept positive definite, which requires |xy| < sqrt(xx yy)
        limit = 0.9 * np.sqrt(covariance[:, 0] * covariance[:, 1])
        covariance[:, 2] = np.clip(covariance[:, 2], -limit, limit)
        return covariance

    def fwhm_px(self, x_px: FloatArray, y_px: FloatArray) -> FloatArray:
        """The full width at half maximum (n,), px, at places (n,), of core and wings as pixels
        widen them, all approximated as round Gaussians.
        """
        core = self.core(x_px, y_px, np.full(len(x_px), MEAN_BV_MAG))
        # a square pixel's variance along an axis is 1/12
        core_variance = (core[:, 0] + core[:, 1]) / 2 + 1 / 12
        wing_variance = np.full(len(x_px), self.wing_sigma_px**2 + 1 / 12)
        radius = np.linspace(0, 12, 1201)
        core_light = _round_light(1 - self.wing_share, core_variance, radius)
        wing_light = _round_light(self.wing_share, wing_variance, radius)
        light = core_light + wing_light
        is_over_half = light > light[:, :1] / 2
        return np.asarray(2 * radius[is_over_half.sum(axis=1) - 1])

    def on_pixels(
        self, dx: FloatArray, dy: FloatArray, core: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The shares (n, rows, columns) of a star's light in pixels at offsets dx (n, columns) and
        dy (n, rows), px, from the stars, and their derivatives by the star's x and by its y, 1/px.
        `core` (n, 3) are the covariances of `StarPsf.core`.
        """
        narrow = _gaussians(dx, dy, core).slopes()
        wide = _gaussians(dx, dy, self._wing(len(core))).slopes()
        core_share = 1 - self.wing_share
        parts = []
        for of_core, of_wing in zip(narrow, wide, strict=True):
            parts.append(core_share * of_core + self.wing_share * of_wing)
        share, by_x, by_y = parts
        return share, by_x, by_y

    def by_shape(
        self, dx: FloatArray, dy: FloatArray, core: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """The shares (n, rows, columns) of `on_pixels`, and their derivatives (5, n, rows, columns)
        by the core's xx, yy and xy, and by the wings' share and sigma.
        """
        wing_share = self.wing_share
        core_share = 1 - wing_share
        narrow = _gaussians(dx, dy, core).slopes(shape=True)
        wide = _gaussians(dx, dy, self._wing(len(core))).slopes(shape=True)
        by_core = [core_share * slope for slope in narrow[3:]]
        by_wing_share = wide[0] - narrow[0]
        by_wing_sigma = wing_share * 2 * self.wing_sigma_px * (wide[3] + wide[4])
        slopes = np.stack([*by_core, by_wing_share, by_wing_sigma])
        share = core_share * narrow[0] + wing_share * wide[0]
        return share, slopes

    def _wing(self, count: int) -> FloatArray:
        """The wings' covariance xx, yy and xy, px^2, repeated: (count, 3)."""
        variance = self.wing_sigma_px**2
        return np.broadcast_to([variance, variance, 0.0], (count, 3))

    def samples(self, x_px: float, y_px: float, per_px: int, half_px: int) -> FloatArray:
        """The PSF (side, side) at a place of the image, on a grid of `per_px` samples a pixel that
        reaches `half_px` to each side, without the widening by pixels. Its sum is 1.
        """
        half = half_px * per_px
        offsets_px = np.arange(-half, half + 1) / per_px
        x, y = np.meshgrid(offsets_px, offsets_px)
        cores = self.core(np.array([x_px]), np.array([y_px]), np.array([MEAN_BV_MAG]))
        xx, yy, xy = cores[0]
        determinant = xx * yy - xy * xy
        square = (yy * x * x - 2 * xy * x * y + xx * y * y) / determinant
        core = np.exp(-square / 2)
        wing = np.exp(-(x * x + y * y) / (2 * self.wing_sigma_px**2))
        core_light = (1 - self.wing_share) * core / core.sum()
        wing_light = self.wing_share * wing / wing.sum()
        light = core_light + wing_light
        return np.asarray(light / light.sum())


def _round_light(share: float, variance_px2: FloatArray, radius_px: FloatArray) -> FloatArray:
    """The surface brightness (n, radii), in arbitrary units, of round Gaussians with a `share` of
    the light and variances (n,), at radii (radii,).
    """
    variance = variance_px2[:, None]
    profile = np.exp(-(radius_px**2) / (2 * variance))
    return np.asarray(share / variance * profile)


def field_terms(x_px: FloatArray, y_px: FloatArray, size_px: tuple[int, int]) -> FloatArray:
    """The field terms (n, 6) at places (n,), px: 1, r^2, u, v, u^2 - v^2 and u v; see `StarPsf`."""
    half = math.hypot(*size_px) / 2
    u = (x_px - (size_px[0] - 1) / 2) / half
    v = (y_px - (size_px[1] - 1) / 2) / half
    ones, u, v, uu, uv, vv = place_terms(u, v).T
    return np.column_stack([ones, uu + vv, u, v, uu - vv, uv])


def _gaussians(dx: FloatArray, dy: FloatArray, covariance: FloatArray) -> PixelGaussians:
    """Gaussians of covariances (n, 3), px^2, in pixels at offsets dx (n, columns) and dy (n, rows)
    from their middles.
    """
    return PixelGaussians(dx, dy, covariance, np.zeros(len(dx)), NODES)


@dataclass(frozen=True, slots=True)
class Stamps:
    """Squares of k x k pixels about n stars: their `values` (n, k, k), DN above the background, the
    `variance` (n, k, k), DN^2, without the stars' own noise, and the `column` and `row` (n,) of
    each square's middle pixel.

    `variance` is infinite where a pixel does not count. `bv_mag` (n,) is each star's B-V.
    """

    values: FloatArray
    variance: FloatArray
    column: FloatArray
    row: FloatArray
    bv_mag: FloatArray

    def __len__(self) -> int:
        return len(self.column)

    def at(self, chosen: BoolArray) -> "Stamps":
        """The stamps for which `chosen` (n,) is True."""
        return Stamps(
            self.values[chosen],
            self.variance[chosen],
            self.column[chosen],
            self.row[chosen],
            self.bv_mag[chosen],
        )

    def middle(self, reach: int) -> FloatArray:
        """The values (n, side, side), DN, of the pixels up to `reach` pixels from the middle
        one.
        """
        near = slice(HALF - reach, HALF + reach + 1)
        return self.values[:, near, near]

    def offsets(self, x_px: FloatArray, y_px: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The offsets dx (n, k) and dy (n, k), px, of the stamps' columns and rows from places
        (n,), px, in the image.
        """
        reach = np.arange(-HALF, HALF + 1)
        dx = self.column[:, None] + reach - x_px[:, None]
        dy = self.row[:, None] + reach - y_px[:, None]
        return dx, dy

    def weight(self, light_dn: FloatArray, gain_e_per_dn: float) -> FloatArray:
        """The weights (n, k, k), 1/DN^2, of pixels with the light `light_dn` (n, k, k) of their
        stars: one over the variance of background, photons and the model's error.
        """
        photon_variance = light_dn / gain_e_per_dn
        model_variance = (MODEL_ERROR * light_dn) ** 2
        return np.asarray(1 / (self.variance + photon_variance + model_variance))


def join(parts: Sequence[Stamps]) -> Stamps:
    """All stamps of several photographs."""
    columns = []
    for name in ("values", "variance", "column", "row", "bv_mag"):
        columns.append(np.concatenate([getattr(part, name) for part in parts]))
    return Stamps(*columns)


@dataclass(frozen=True, slots=True)
class Measured:
    """Stars measured by the PSF, each (n,): the place, px, the flux, DN, one sigma of a place along
    an axis and of the flux, and the reduced chi^2.
    """

    x_px: FloatArray
    y_px: FloatArray
    dn: FloatArray
    sigma_px: FloatArray
    sigma_dn: FloatArray
    chi2: FloatArray

    @property
    def places_px(self) -> FloatArray:
        """The places (n, 2), x and y, px."""
        return np.column_stack([self.x_px, self.y_px])


def cut_stamps(
    above: FloatArray, variance: FloatArray, x_px: FloatArray, y_px: FloatArray, bv_mag: FloatArray
) -> Stamps:
    """Cut stamps about places (n,), px, from the image `above` its background (height, width), DN,
    and from the `variance` (height, width), DN^2, of its pixels without the stars' own noise.
    Pixels beyond the image's edge do not count.
    """
    height, width = above.shape
    reach = np.arange(-HALF, HALF + 1)
    column = np.rint(x_px)
    row = np.rint(y_px)
    columns = column[:, None] + reach
    rows = row[:, None] + reach
    in_columns = (columns >= 0) & (columns < width)
    in_rows = (rows >= 0) & (rows < height)
    inside = in_rows[:, :, None] & in_columns[:, None, :]
    pixel_rows = np.clip(rows, 0, height - 1).astype(np.intp)
    pixel_columns = np.clip(columns, 0, width - 1).astype(np.intp)
    pixels = (pixel_rows[:, :, None], pixel_columns[:, None, :])
    values = np.where(inside, above[pixels], 0.0)
    stamp_variance = np.where(inside, variance[pixels], np.inf)
    return Stamps(values, stamp_variance, column, row, bv_mag)


def measure(
    stamps: Stamps, psf: StarPsf, x_px: FloatArray, y_px: FloatArray, gain_e_per_dn: float
) -> Measured:
    """Measure stars by least squares of place, flux and a level of the background, from starting
    places (n,), px. Their photon noise follows from `gain_e_per_dn`.
    """
    count = len(x_px)
    x = x_px.copy()
    y = y_px.copy()
    core = psf.core(x, y, stamps.bv_mag)
    flux = np.zeros(count)
    level = np.zeros(count)
    for number in range(PLACE_STEPS):
        dx, dy = stamps.offsets(x, y)
        shape, by_x, by_y = psf.on_pixels(dx, dy, core)
        if number:
            # The photon noise is that of the model. By that of the measured light, low pixels would
            # weigh more, and faint stars would come out too faint.
            star_dn = np.maximum(flux, 0)[:, None, None] * shape
            weight = stamps.weight(star_dn, gain_e_per_dn)
            flux = np.maximum(flux, 1e-3)
        else:
            weight = 1 / stamps.variance
            flux = _linear(shape, stamps.values, weight)[0].clip(min=1e-3)
        flux_dn = flux[:, None, None]
        slopes = np.stack([flux_dn * by_x, flux_dn * by_y, shape, np.ones_like(shape)], axis=1)
        model = flux_dn * shape
        off = (stamps.values - model - level[:, None, None]).reshape(count, -1)
        pixel_weight = weight.reshape(count, -1)
        normal, right = normal_equations(slopes.reshape(count, 4, -1), pixel_weight, off)
        normal += 1e-12 * np.eye(4)
        move = np.linalg.solve(normal, right[..., None])[..., 0]
        x += np.clip(move[:, 0], -0.5, 0.5)
        y += np.clip(move[:, 1], -0.5, 0.5)
        flux = flux + move[:, 2]
        level = level + move[:, 3]
        # The last 2 % of stars, which may never converge (blends, cosmic rays), are not waited for.
        if np.quantile(np.abs(move[:, :2]), 0.98) < PLACE_DONE_PX:
            break
    covariance = np.linalg.inv(normal)
    counted = np.isfinite(stamps.variance).sum(axis=(1, 2))
    chi2 = (off**2 * pixel_weight).sum(axis=1) / np.maximum(counted - 4, 1)
    sigma_px = np.sqrt((covariance[:, 0, 0] + covariance[:, 1, 1]) / 2)
    sigma_dn = np.sqrt(covariance[:, 2, 2])
    return Measured(x, y, flux, sigma_px, sigma_dn, chi2)


def _linear(
    shape: FloatArray, values: FloatArray, weight: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The flux (n,) and the level (n,) of stars by weighted least squares, from their pixels'
    shares `shape`, `values` and weights, each (n, rows, columns).
    """
    count = len(shape)
    s = shape.reshape(count, -1)
    v = values.reshape(count, -1)
    w = weight.reshape(count, -1)
    sw = w.sum(axis=1)
    s1 = (w * s).sum(axis=1)
    ss = (w * s * s).sum(axis=1)
    v1 = (w * v).sum(axis=1)
    vs = (w * v * s).sum(axis=1)
    determinant = np.maximum(ss * sw - s1 * s1, 1e-300)
    flux = (vs * sw - v1 * s1) / determinant
    level = (ss * v1 - s1 * vs) / determinant
    return flux, level


def fit_psf(
    stamps: Stamps,
    x_px: FloatArray,
    y_px: FloatArray,
    size_px: tuple[int, int],
    gain_e_per_dn: float,
) -> StarPsf:
    """The PSF of an image of `size_px`, by stars that stand alone and are not saturated, from their
    starting places (n,), px.
    """
    terms = next(count for minimum, count in STARS_FOR if len(stamps) >= minimum)
    start = np.zeros((3, terms))
    start[:, 0] = _first_covariance(stamps, x_px, y_px)
    psf = StarPsf(start, 0.0, 0.05, 2.0, size_px)
    measured = measure(stamps, psf, x_px, y_px, gain_e_per_dn)
    for number in range(SHAPE_ROUNDS):
        # colour and wings are fitted only after a first fit of the core
        psf = _shape(stamps, measured, psf, gain_e_per_dn, wide=number > 0)
        moved_px = np.hypot(measured.x_px - x_px, measured.y_px - y_px)
        is_near = moved_px < 2
        x = np.where(is_near, measured.x_px, x_px)
        y = np.where(is_near, measured.y_px, y_px)
        measured = measure(stamps, psf, x, y, gain_e_per_dn)
    return psf


def _first_covariance(stamps: Stamps, x_px: FloatArray, y_px: FloatArray) -> FloatArray:
    """The median of the stars' covariances xx, yy and xy (3,), px^2, each by a Gaussian fitted to
    the star alone.
    """
    weight = 1 / stamps.variance
    none_px = np.zeros(len(stamps))
    points = PointImages(stamps.values, weight, stamps.column, stamps.row, none_px)
    width = _first_width(stamps)
    covariance = np.tile([width, width, 0.0], (len(stamps), 1))
    fitted = fit_each(points, PointGaussians(x_px, y_px, covariance), START_ROUNDS)
    return np.asarray(np.median(fitted.covariance, axis=0))


def _first_width(stamps: Stamps) -> float:
    """A first estimate of the stars' variance along an axis, px^2, from the median share of a
    star's light in its brightest pixel.
    """
    middle = stamps.middle(3)
    total = np.maximum(middle.sum(axis=(1, 2)), 1e-9)
    peak_share = np.median(middle.max(axis=(1, 2)) / total)
    # a Gaussian's middle pixel has 1 / (2 pi sigma^2) of its light
    variance = 1 / (2 * math.pi * np.clip(peak_share, 0.02, 0.6))
    return float(np.clip(variance, 0.15, 9.0))


def _shape(
    stamps: Stamps, at: Measured, psf: StarPsf, gain_e_per_dn: float, *, wide: bool
) -> StarPsf:
    """The PSF fitted with the stars at fixed places, and with the flux and the level of each star
    at their best.

    Without `wide` only the core's covariance is fitted, with it also colour and wings.
    """
    loss = _ShapeLoss(stamps, at, psf, gain_e_per_dn, wide=wide)
    numbers, _ = minimised(loss.residuals, loss.slopes, loss.start, SHAPE_GAIN)
    return loss.psf_of(numbers)


class _ShapeLoss:
    """The residuals of stamps, in sigmas, as a function of the PSF's parameters: the coefficients
    of the covariance and, with `wide`, the colour, the logit of the wings' share, and the logarithm
    of their sigma.
    """

    def __init__(
        self, stamps: Stamps, at: Measured, psf: StarPsf, gain_e_per_dn: float, *, wide: bool
    ) -> None:
        self.stamps = stamps
        self.at = at
        self.psf = psf
        self.wide = wide
        self.dx, self.dy = stamps.offsets(at.x_px, at.y_px)
        self.count = psf.covariance.shape[1]
        self.terms = field_terms(at.x_px, at.y_px, psf.size_px)[:, : self.count]
        self.redness_mag = np.nan_to_num(stamps.bv_mag, nan=MEAN_BV_MAG) - MEAN_BV_MAG
        share = psf.on_pixels(self.dx, self.dy, self._core(psf))[0]
        light_dn = np.maximum(at.dn, 0)[:, None, None] * share
        self.weight = stamps.weight(light_dn, gain_e_per_dn)
        self.root = np.sqrt(self.weight)
        tail = []
        if wide:
            # The share is half a logistic function of its parameter, so that no step leads out of 0
            # to 0.5.
            ratio = np.clip(psf.wing_share, 0.01, 0.49) / 0.5
            tail = [psf.colour, math.log(ratio / (1 - ratio)), math.log(psf.wing_sigma_px)]
        self.start = np.concatenate([psf.covariance.ravel(), tail])
        is_field_term = np.arange(3 * self.count) % self.count > 0
        is_held = [*is_field_term, *(False, True, True)[: len(tail)]]
        # Weak priors: the field's coefficients are 0 +- 1 px^2, and the wings' logit and logarithm
        # are within +- 1 of those before.
        self.prior = np.eye(len(self.start))[is_held]
        is_covariance = np.arange(len(self.start)) < 3 * self.count
        self.prior_mean = np.where(is_covariance, 0.0, self.start)

    def _core(self, psf: StarPsf) -> FloatArray:
        return psf.core(self.at.x_px, self.at.y_px, self.stamps.bv_mag)

    def psf_of(self, numbers: FloatArray) -> StarPsf:
        """The PSF with these parameters."""
        covariance = numbers[: 3 * self.count].reshape(3, self.count)
        if not self.wide:
            return replace(self.psf, covariance=covariance)
        log_sigma = np.clip(numbers[-1], *np.log(WING_SIGMA_PX))
        return replace(
            self.psf,
            covariance=covariance,
            colour=float(numbers[-3]),
            wing_share=0.5 * float(expit(numbers[-2])),
            wing_sigma_px=math.exp(log_sigma),
        )

    def residuals(self, numbers: FloatArray) -> FloatArray:
        """The residuals of all pixels, with the flux and level of each star that fit best, and then
        those of the priors.
        """
        values = self.stamps.values
        trial = self.psf_of(numbers)
        shape = trial.on_pixels(self.dx, self.dy, self._core(trial))[0]
        flux, level = _linear(shape, values, self.weight)
        model = flux[:, None, None] * shape
        off = (values - model - level[:, None, None]) * self.root
        # so that a pixel of a neighbour that no catalogue has counts by 30 sigmas at most
        clipped = np.clip(off.ravel(), -30, 30)
        return np.concatenate([clipped, self.prior @ (numbers - self.prior_mean)])

    def slopes(self, numbers: FloatArray, off: FloatArray) -> FloatArray:
        """The derivatives (residuals, parameters) of `residuals`, with the flux and level of each
        star adjusted along with the parameters (Kaufman 1975).
        """
        trial = self.psf_of(numbers)
        shape, by_shape = trial.by_shape(self.dx, self.dy, self._core(trial))
        flux = _linear(shape, self.stamps.values, self.weight)[0][:, None, None]
        no_prior = np.zeros(len(self.prior))
        columns = []
        for light_slope in self._light_slopes(trial, by_shape):
            slope_dn = flux * light_slope
            of_shape, of_level = _linear(shape, slope_dn, self.weight)
            followed_dn = of_shape[:, None, None] * shape
            change_dn = slope_dn - followed_dn - of_level[:, None, None]
            column = -(change_dn * self.root).ravel()
            columns.append(np.concatenate([column, no_prior]))
        jacobian = np.stack(columns, axis=1)
        jacobian[len(off) - len(self.prior) :] = self.prior
        return jacobian

    def _light_slopes(self, trial: StarPsf, by_shape: FloatArray) -> list[FloatArray]:
        """The derivatives (n, rows, columns) of a star's shares by each parameter in turn."""
        redness = 1 + trial.colour * self.redness_mag
        slopes = []
        for k in range(3):
            for term in range(self.count):
                factor = redness * self.terms[:, term]
                slopes.append(by_shape[k] * factor[:, None, None])
        if not self.wide:
            return slopes
        colourless = self.terms @ trial.covariance.T
        by_colour = np.zeros_like(by_shape[0])
        for k in range(3):
            factor = colourless[:, k] * self.redness_mag
            by_colour += by_shape[k] * factor[:, None, None]
        by_logit = by_shape[3] * trial.wing_share * (1 - 2 * trial.wing_share)
        by_log_sigma = by_shape[4] * trial.wing_sigma_px
        return [*slopes, by_colour, by_logit, by_log_sigma]
