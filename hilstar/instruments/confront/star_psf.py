"""The point spread function of photographs: a core that changes over the field and with colour, and
wings; and stars by it.

The core is an elliptical Gaussian whose covariance is a polynomial of the place, times a factor of
B-V (a lens focuses one colour). The wings are a round Gaussian with a share of the light. Both are
integrated over pixels.
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
NODES = 3  # within a pixel: right to 1e-3 of its light from 0.35 px of sigma
START_ROUNDS = 4  # of each star's own Gaussian, from whose median the PSF's starts
MIN_SIGMA_PX, MAX_SIGMA_PX = 0.15, 5.0
MEAN_BV_MAG = 0.65
PLACE_STEPS, SHAPE_ROUNDS = 8, 2
PLACE_DONE_PX = 1e-3
SHAPE_GAIN = 0.1  # a step of the PSF's numbers that lowers the loss by less is the last
WING_SIGMA_PX = 0.8, 6.0
# share of a pixel's light by which the model may be wrong: so no bright star outvotes all others
MODEL_ERROR = 0.01
STARS_FOR = ((40, 6), (12, 2), (0, 1))  # stars that a number of terms of the field takes


@dataclass(frozen=True, slots=True)
class StarPsf:
    """`covariance` (3, terms) of xx, yy and xy, px^2, `colour` its relative change per magnitude of
    B-V, and the wings.

    Terms are 1, r^2, u, v, u^2 - v^2, u v of the place (u, v) from the image's middle in half
    diagonals.
    """

    covariance: FloatArray
    colour: float
    wing_share: float
    wing_sigma_px: float
    size_px: tuple[int, int]

    def core(self, x_px: FloatArray, y_px: FloatArray, bv_mag: FloatArray) -> FloatArray:
        """Covariances (n, 3) at places."""
        terms = field_terms(x_px, y_px, self.size_px)[:, : self.covariance.shape[1]]
        core_light = terms @ self.covariance.T
        core_light *= np.clip(
            1 + self.colour * (np.nan_to_num(bv_mag, nan=MEAN_BV_MAG) - MEAN_BV_MAG), 0.3, 3.0
        )[:, None]
        core_light[:, :2] = np.clip(core_light[:, :2], MIN_SIGMA_PX**2, MAX_SIGMA_PX**2)
        limit = 0.9 * np.sqrt(core_light[:, 0] * core_light[:, 1])
        core_light[:, 2] = np.clip(core_light[:, 2], -limit, limit)
        return core_light

    def fwhm_px(self, x_px: FloatArray, y_px: FloatArray) -> FloatArray:
        """Full width at half maximum of what pixels get, (n,): of core, wings and a pixel, all
        made round.
        """
        core = self.core(x_px, y_px, np.full(len(x_px), MEAN_BV_MAG))
        narrow = (core[:, 0] + core[:, 1]) / 2 + 1 / 12
        wide = np.full(len(x_px), self.wing_sigma_px**2 + 1 / 12)
        radius = np.linspace(0, 12, 1201)
        parts = ((1 - self.wing_share, narrow), (self.wing_share, wide))
        light = np.sum(
            [share / v[:, None] * np.exp(-(radius**2) / (2 * v[:, None])) for share, v in parts],
            axis=0,
        )
        return np.asarray(2 * radius[(light > light[:, :1] / 2).sum(axis=1) - 1])

    def on_pixels(
        self, dx: FloatArray, dy: FloatArray, core: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Shares of light in pixels at offsets dx (n, columns), dy (n, rows) from the stars, (n,
        rows, columns).

        With them their derivatives by the star's x and y.
        """
        narrow = _gaussians(dx, dy, core).slopes()
        wide = _gaussians(dx, dy, self._wing(len(core))).slopes()
        share, by_x, by_y = (
            (1 - self.wing_share) * of_core + self.wing_share * of_wing
            for of_core, of_wing in zip(narrow, wide, strict=True)
        )
        return share, by_x, by_y

    def by_shape(
        self, dx: FloatArray, dy: FloatArray, core: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Shares as `on_pixels`, and their derivatives (5, n, rows, columns) by xx, yy, xy, the
        wings' share and sigma.
        """
        share = self.wing_share
        narrow = _gaussians(dx, dy, core).slopes(shape=True)
        wide = _gaussians(dx, dy, self._wing(len(core))).slopes(shape=True)
        by_wing = share * 2 * self.wing_sigma_px * (wide[3] + wide[4])
        by_core = [(1 - share) * slope for slope in narrow[3:]]
        slopes = np.stack([*by_core, wide[0] - narrow[0], by_wing])
        return (1 - share) * narrow[0] + share * wide[0], slopes

    def _wing(self, count: int) -> FloatArray:
        return np.broadcast_to([self.wing_sigma_px**2, self.wing_sigma_px**2, 0.0], (count, 3))

    def samples(self, x_px: float, y_px: float, per_px: int, half_px: int) -> FloatArray:
        """The light itself on a grid of `per_px` samples a pixel, (side, side), without the
        pixel; sums to 1.
        """
        at = np.arange(-half_px * per_px, half_px * per_px + 1) / per_px
        xx, yy, xy = self.core(np.array([x_px]), np.array([y_px]), np.array([MEAN_BV_MAG]))[0]
        x, y = np.meshgrid(at, at)
        square = (yy * x * x - 2 * xy * x * y + xx * y * y) / (xx * yy - xy * xy)
        core = np.exp(-square / 2)
        wing = np.exp(-(x * x + y * y) / (2 * self.wing_sigma_px**2))
        found = (1 - self.wing_share) * core / core.sum() + self.wing_share * wing / wing.sum()
        return np.asarray(found / found.sum())


def field_terms(x_px: FloatArray, y_px: FloatArray, size_px: tuple[int, int]) -> FloatArray:
    """Terms (n, 6) of the field."""
    half = math.hypot(*size_px) / 2
    u = (x_px - (size_px[0] - 1) / 2) / half
    v = (y_px - (size_px[1] - 1) / 2) / half
    ones, u, v, uu, uv, vv = place_terms(u, v).T
    return np.column_stack([ones, uu + vv, u, v, uu - vv, uv])


def _gaussians(dx: FloatArray, dy: FloatArray, covariance: FloatArray) -> PixelGaussians:
    """Gaussians of points in pixels at offsets from them."""
    return PixelGaussians(dx, dy, covariance, np.zeros(len(dx)), NODES)


@dataclass(frozen=True, slots=True)
class Stamps:
    """Squares of pixels about stars: values over the background and variances (n, k, k), DN;
    (column, row) of each middle.

    `variance` is infinite where a pixel does not count. `bv_mag` (n,) is each star's colour.
    """

    values: FloatArray
    variance: FloatArray
    column: FloatArray
    row: FloatArray
    bv_mag: FloatArray

    def __len__(self) -> int:
        return len(self.column)

    def at(self, chosen: BoolArray) -> "Stamps":
        """Some of them."""
        return Stamps(
            self.values[chosen],
            self.variance[chosen],
            self.column[chosen],
            self.row[chosen],
            self.bv_mag[chosen],
        )


def join(parts: Sequence[Stamps]) -> Stamps:
    """All stamps of several photographs."""
    return Stamps(
        *(
            np.concatenate([getattr(part, name) for part in parts])
            for name in ("values", "variance", "column", "row", "bv_mag")
        )
    )


@dataclass(frozen=True, slots=True)
class Measured:
    """Stars by the PSF: place, px, and flux, DN, with one sigma of place and flux, and reduced
    chi^2, (n,).
    """

    x_px: FloatArray
    y_px: FloatArray
    dn: FloatArray
    sigma_px: FloatArray
    sigma_dn: FloatArray
    chi2: FloatArray


def cut_stamps(
    above: FloatArray, variance: FloatArray, x_px: FloatArray, y_px: FloatArray, bv_mag: FloatArray
) -> Stamps:
    """Stamps of an image above its background about places (n,), and the variance of its pixels
    without the stars'.
    """
    height, width = above.shape
    reach = np.arange(-HALF, HALF + 1)
    column = np.rint(x_px)
    row = np.rint(y_px)
    columns = column[:, None] + reach
    rows = row[:, None] + reach
    inside = ((rows >= 0) & (rows < height))[:, :, None] & ((columns >= 0) & (columns < width))[
        :, None, :
    ]
    at = (
        np.clip(rows, 0, height - 1).astype(np.intp)[:, :, None],
        np.clip(columns, 0, width - 1).astype(np.intp)[:, None, :],
    )
    return Stamps(
        np.where(inside, above[at], 0.0),
        np.where(inside, variance[at], np.inf),
        column,
        row,
        bv_mag,
    )


def measure(
    stamps: Stamps, psf: StarPsf, x_px: FloatArray, y_px: FloatArray, gain_e_per_dn: float
) -> Measured:
    """Stars by least squares of place, flux and a level, from starting places; photon noise by
    `gain_e_per_dn`.
    """
    x = x_px.copy()
    y = y_px.copy()
    reach = np.arange(-HALF, HALF + 1)
    core = psf.core(x, y, stamps.bv_mag)
    weight = 1 / stamps.variance
    flux = np.zeros(len(x))
    level = np.zeros(len(x))
    for number in range(PLACE_STEPS):
        dx = stamps.column[:, None] + reach - x[:, None]
        dy = stamps.row[:, None] + reach - y[:, None]
        shape, by_x, by_y = psf.on_pixels(dx, dy, core)
        # photon noise of the model, not of what was seen: else faint stars come out too faint
        if number:
            star = np.maximum(flux, 0)[:, None, None] * shape
            weight = 1 / (stamps.variance + star / gain_e_per_dn + (MODEL_ERROR * star) ** 2)
        if number:
            flux = np.maximum(flux, 1e-3)
        else:
            flux = _linear(shape, stamps.values, weight)[0].clip(min=1e-3)
        columns = np.stack(
            [flux[:, None, None] * by_x, flux[:, None, None] * by_y, shape, np.ones_like(shape)],
            axis=1,
        )
        flat = columns.reshape(len(x), 4, -1)
        off = (stamps.values - flux[:, None, None] * shape - level[:, None, None]).reshape(
            len(x), -1
        )
        w = weight.reshape(len(x), -1)
        normal, right = normal_equations(flat, w, off)
        normal += 1e-12 * np.eye(4)
        move = np.linalg.solve(normal, right[..., None])[..., 0]
        x += np.clip(move[:, 0], -0.5, 0.5)
        y += np.clip(move[:, 1], -0.5, 0.5)
        flux = flux + move[:, 2]
        level = level + move[:, 3]
        if np.quantile(np.abs(move[:, :2]), 0.98) < PLACE_DONE_PX:
            break
    covariance = np.linalg.inv(normal)
    counted = np.isfinite(stamps.variance).sum(axis=(1, 2))
    chi2 = (off**2 * w).sum(axis=1) / np.maximum(counted - 4, 1)
    place = np.sqrt((covariance[:, 0, 0] + covariance[:, 1, 1]) / 2)
    return Measured(x, y, flux, place, np.sqrt(covariance[:, 2, 2]), chi2)


def _linear(
    shape: FloatArray, values: FloatArray, weight: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Flux and level (n,) by least squares."""
    s, v, w = (part.reshape(len(shape), -1) for part in (shape, values, weight))
    sw = w.sum(axis=1)
    s1 = (w * s).sum(axis=1)
    ss = (w * s * s).sum(axis=1)
    v1 = (w * v).sum(axis=1)
    vs = (w * v * s).sum(axis=1)
    det = np.maximum(ss * sw - s1 * s1, 1e-300)
    return (vs * sw - v1 * s1) / det, (ss * v1 - s1 * vs) / det


def fit_psf(
    stamps: Stamps,
    x_px: FloatArray,
    y_px: FloatArray,
    size_px: tuple[int, int],
    gain_e_per_dn: float,
) -> StarPsf:
    """The PSF of stars that stand alone and are not saturated, from starting places."""
    terms = next(count for least, count in STARS_FOR if len(stamps) >= least)
    start = np.zeros((3, terms))
    start[:, 0] = _first_covariance(stamps, x_px, y_px)
    psf = StarPsf(start, 0.0, 0.05, 2.0, size_px)
    x = x_px
    y = y_px
    measured = measure(stamps, psf, x, y, gain_e_per_dn)
    for number in range(SHAPE_ROUNDS):
        psf = _shape(stamps, measured, psf, gain_e_per_dn, wide=number > 0)
        near = np.hypot(measured.x_px - x_px, measured.y_px - y_px) < 2
        measured = measure(
            stamps,
            psf,
            np.where(near, measured.x_px, x_px),
            np.where(near, measured.y_px, y_px),
            gain_e_per_dn,
        )
    return psf


def _first_covariance(stamps: Stamps, x_px: FloatArray, y_px: FloatArray) -> FloatArray:
    """The median covariance, xx, yy and xy, px^2, of the stars, each by a Gaussian of its own."""
    weight = 1 / stamps.variance
    none_px = np.zeros(len(stamps))
    points = PointImages(stamps.values, weight, stamps.column, stamps.row, none_px)
    width = _first_width(stamps)
    covariance = np.tile([width, width, 0.0], (len(stamps), 1))
    fitted = fit_each(points, PointGaussians(x_px, y_px, covariance), START_ROUNDS)
    return np.asarray(np.median(fitted.covariance, axis=0))


def _first_width(stamps: Stamps) -> float:
    """A variance, px^2, from how much of a star's light its highest pixel and the eight about it
    have.
    """
    middle = stamps.values[:, HALF - 3 : HALF + 4, HALF - 3 : HALF + 4]
    peak = np.median(middle.max(axis=(1, 2)) / np.maximum(middle.sum(axis=(1, 2)), 1e-9))
    return float(np.clip(1 / (2 * math.pi * np.clip(peak, 0.02, 0.6)), 0.15, 9.0))


def _shape(
    stamps: Stamps, at: Measured, psf: StarPsf, gain_e_per_dn: float, *, wide: bool
) -> StarPsf:
    """The PSF's numbers with the stars where they are; flux and level of each follow."""
    reach = np.arange(-HALF, HALF + 1)
    dx = stamps.column[:, None] + reach - at.x_px[:, None]
    dy = stamps.row[:, None] + reach - at.y_px[:, None]
    count = psf.covariance.shape[1]
    terms = field_terms(at.x_px, at.y_px, psf.size_px)[:, :count]
    light = (
        np.maximum(at.dn, 0)[:, None, None]
        * psf.on_pixels(dx, dy, psf.core(at.x_px, at.y_px, stamps.bv_mag))[0]
    )
    weight = 1 / (stamps.variance + light / gain_e_per_dn + (MODEL_ERROR * light) ** 2)
    root = np.sqrt(weight)
    redder = np.nan_to_num(stamps.bv_mag, nan=MEAN_BV_MAG) - MEAN_BV_MAG
    ratio = np.clip(psf.wing_share, 0.01, 0.49) / 0.5
    if wide:
        tail = [psf.colour, math.log(ratio / (1 - ratio)), math.log(psf.wing_sigma_px)]
    else:
        tail = []
    start = np.concatenate([psf.covariance.ravel(), tail])
    # weak: terms of the field are 0 +- 1 px^2, and the wings stay within factors of those before
    prior = np.eye(len(start))
    about = np.where(np.arange(len(start)) < 3 * count, 0.0, start)
    prior = prior[[*(np.arange(3 * count) % count > 0), *(False, True, True)[: len(tail)]]]

    def of(numbers: FloatArray) -> StarPsf:
        covariance = numbers[: 3 * count].reshape(3, count)
        if not wide:
            return replace(psf, covariance=covariance)
        share = 0.5 * float(expit(numbers[-2]))
        sigma = math.exp(np.clip(numbers[-1], *np.log(WING_SIGMA_PX)))
        return replace(
            psf,
            covariance=covariance,
            colour=float(numbers[-3]),
            wing_share=share,
            wing_sigma_px=sigma,
        )

    def residuals(numbers: FloatArray) -> FloatArray:
        trial = of(numbers)
        shape = trial.on_pixels(dx, dy, trial.core(at.x_px, at.y_px, stamps.bv_mag))[0]
        flux, level = _linear(shape, stamps.values, weight)
        off = (stamps.values - flux[:, None, None] * shape - level[:, None, None]) * root
        return np.concatenate([np.clip(off.ravel(), -30, 30), prior @ (numbers - about)])

    def slopes(numbers: FloatArray, off: FloatArray) -> FloatArray:
        """Derivatives with each star's flux and level following (Kaufman 1975)."""
        trial = of(numbers)
        shape, by = trial.by_shape(dx, dy, trial.core(at.x_px, at.y_px, stamps.bv_mag))
        redness = 1 + trial.colour * redder
        columns = [
            by[k] * (redness * terms[:, t])[:, None, None] for k in range(3) for t in range(count)
        ]
        if wide:
            plain = terms @ trial.covariance.T
            columns.append(sum(by[k] * (plain[:, k] * redder)[:, None, None] for k in range(3)))
            columns += [
                by[3] * trial.wing_share * (1 - 2 * trial.wing_share),
                by[4] * trial.wing_sigma_px,
            ]
        flux = _linear(shape, stamps.values, weight)[0][:, None, None]
        differences = []
        for column in columns:
            of_shape, of_level = _linear(shape, flux * column, weight)
            change = flux * column - of_shape[:, None, None] * shape - of_level[:, None, None]
            differences.append(np.concatenate([-(change * root).ravel(), np.zeros(len(prior))]))
        found = np.stack(differences, axis=1)
        found[len(off) - len(prior) :] = prior
        return found

    return of(minimised(residuals, slopes, start, SHAPE_GAIN)[0])
