"""The effective PSF of a tracker over its field, from the dot frames of the geometric calibration.

As Anderson and King (2000, PASP 112, 1360): one model of what pixels get, built from dots at many
places within a pixel, whose places and light are fitted to it in turn. The model is a Gaussian
whose covariance changes with the field, and a spline on a grid of half pixels for all that is not
Gaussian, its coefficients polynomials over the field. The square of each dot is convolved in the
model, so what is found is without it; the pixel is integrated, and the collimator is in it. Dots
held out of the fit say how right both are, and whether the data ask for more than the Gaussian.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.charts import chart
from hilstar.basics.errors import InputError
from hilstar.instruments.calibrate.geometric.dots import DOT_PX, MIN_DOTS, read_plan
from hilstar.instruments.calibrate.geometric.fit import MatchedDots
from hilstar.instruments.calibrate.geometric.geometry_fit import (
    SEED,
    dot_sigma_px,
    matched,
    nominal_of,
)
from hilstar.instruments.calibrate.geometric.match import first_look
from hilstar.instruments.calibrate.geometric.observed import measure_images, numbered, read_image
from hilstar.optics.glass.psf_file import Glass, Stack, facts_of, glass_of
from hilstar.optics.psf_fit import (
    MAX_STEP_PX,
    MIN_VARIANCE_PX2,
    SMALLEST,
    XY,
    PixelGaussians,
    PointGaussians,
    PointImages,
    amplitudes,
    fit_each,
    over_field,
    place_terms,
)
from hilstar.server.bench.bench_file import BenchFile

MAX_HALF_PX, MIN_HALF_PX = 12, 4
# a ring about the dots is light above so many sigmas, and so much of the middle's
SEEN_SIGMAS, SEEN_SHARE = 3.0, 3e-4
FIRST_COVARIANCE_PX2 = (0.5, 0.5, 0.0)
KNOT_PX = 0.5
PRIOR_SHARE = 0.03  # sigma of a spline's coefficient, share of a dot's light in a pixel
MAX_DEGREE = 2  # polynomials over the field
DOTS_A_TERM = 5
FOLDS = 4
PLACE_ROUNDS, SPLINE_ROUNDS, SPLINE_STEPS = 1, 2, 90
STEP_PX = 1e-3  # for numerical derivatives
QUANTISED_DN2 = 1 / 12
ASKS_SIGMAS = 3.0  # by which held-out dots have to prefer the spline
POINTS = 5  # field points along each side of the file


@dataclass(frozen=True, slots=True)
class Dots:
    """Mean images of n dots (n, side, side), DN, and their variance; the middle pixels, the
    dots' places and sides, px.
    """

    images: FloatArray
    variance: FloatArray
    column: IntArray
    row: IntArray
    x_px: FloatArray
    y_px: FloatArray
    side_px: FloatArray

    def at(self, chosen: IntArray) -> "Dots":
        """The dots at indices `chosen`."""
        return Dots(*(getattr(self, name)[chosen] for name in self.__slots__))

    @property
    def offsets(self) -> tuple[FloatArray, FloatArray]:
        """Pixels' places less their dot's, along x and y (n, side)."""
        reach = np.arange(self.images.shape[1]) - self.images.shape[1] // 2
        return (self.column - self.x_px)[:, None] + reach, (self.row - self.y_px)[:, None] + reach


@dataclass(frozen=True, slots=True)
class Effective:
    """What pixels get of a point over the field: polynomials of a Gaussian's covariance (T, 3), and
    of a spline (T', m, m).

    `middle_px` and `scale_px` make places a polynomial's; `knots_px` (m,) are the middles of the
    spline's functions.
    """

    middle_px: FloatArray
    scale_px: float
    covariance: FloatArray
    knots_px: FloatArray
    spline: FloatArray

    def of(
        self,
        x_px: FloatArray,
        y_px: FloatArray,
        offsets: tuple[FloatArray, FloatArray],
        side_px: FloatArray,
    ) -> FloatArray:
        """Shares (n, h, w) of pixels at offsets (n, w), (n, h) from squares of `side_px` (n,), 0
        or more, at places (n,).
        """
        covariance = self._of(x_px, y_px, self.covariance)
        shares = PixelGaussians(*offsets, covariance, side_px).shares
        if len(self.spline):
            across, down = (_functions(self.knots_px, off, side_px) for off in offsets)
            shares += down @ self._of(x_px, y_px, self.spline) @ across.transpose(0, 2, 1)
        return shares

    def _of(self, x_px: FloatArray, y_px: FloatArray, coefficients: FloatArray) -> FloatArray:
        place = (np.stack([x_px, y_px], axis=1) - self.middle_px) / self.scale_px
        return np.tensordot(terms_of(place, len(coefficients)), coefficients, axes=1)


def terms_of(place: FloatArray, count: int) -> FloatArray:
    """The first terms (n, count) of scaled places (n, 2): 1, 3 or 6 of them."""
    return place_terms(*place.T)[:, :count]


def _functions(knots_px: FloatArray, offset_px: FloatArray, side_px: FloatArray) -> FloatArray:
    """Cubic B-splines about `knots_px` (m,), mean over a square's side about offsets (n, w): (n,
    w, m).
    """
    from scipy.interpolate import BSpline

    basis_spline = BSpline.basis_element(np.arange(-2, 3) * KNOT_PX, extrapolate=False)
    whole = basis_spline.antiderivative()
    end_px = 2 * KNOT_PX
    half = np.maximum(side_px, 1e-3)[:, None, None] / 2
    off = offset_px[:, :, None] - knots_px
    high, low = (whole(np.clip(off + step, -end_px, end_px)) for step in (half, -half))
    return np.asarray((high - low) / (2 * half))


def effective_psf(
    file: BenchFile, images: Sequence[Path], plan: Path, dark: Path | None, per_px: int
) -> "Found":
    """The effective PSF from a tracker's images of planned dots. Raises InputError."""
    config = file.config
    nominal = nominal_of(file)
    dots = read_plan(plan)
    observed = measure_images(images, dark, config.tracker.resolution_px, dot_sigma_px(file))
    look = first_look(dots, nominal, observed, np.random.default_rng(SEED))
    _, data = matched(dots, nominal, observed, look)
    if len(np.unique(data.dot)) < MIN_DOTS:
        raise InputError(
            f"{len(np.unique(data.dot))} dots were recognised and {MIN_DOTS} are needed; show more"
            " dots or frames"
        )
    if dark is None:
        under = None
    else:
        under = read_image(dark, config.tracker.resolution_px)
    sides = _dot_sides(data, dots.x_px, dots.y_px)
    cut = cut_out(numbered(images), config.tracker.resolution_px, under, data, sides)
    return fit_effective(cut, per_px)


def _dot_sides(data: MatchedDots, x_px: FloatArray, y_px: FloatArray) -> FloatArray:
    """The side of a dot where each centroid is, tracker px (n,), by a cubic map from the tracker
    to the monitor.
    """
    place = np.stack([data.seen.x_px, data.seen.y_px], axis=1)
    middle = place.mean(axis=0)
    scale = float(np.abs(place - place.mean(axis=0)).max())
    # a cubic map has ten terms; few dots determine a linear one
    degree = 3 if len(data) > 40 else 1
    powers = [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]
    u, v = ((place - middle) / scale).T
    terms = np.stack([u**i * v**j for i, j in powers], axis=1)
    by_u = np.stack([i * u ** max(i - 1, 0) * v**j for i, j in powers], axis=1) / scale
    by_v = np.stack([j * u**i * v ** max(j - 1, 0) for i, j in powers], axis=1) / scale
    maps = np.linalg.lstsq(terms, np.stack([x_px[data.dot], y_px[data.dot]], axis=1), rcond=None)[0]
    (xu, yu), (xv, yv) = (by_u @ maps).T, (by_v @ maps).T
    return np.asarray(DOT_PX / np.sqrt(np.abs(xu * yv - xv * yu)))


def cut_out(
    paths: dict[tuple[int, int], Path],
    resolution_px: tuple[int, int],
    dark: FloatArray | None,
    data: MatchedDots,
    sides_px: FloatArray,
) -> Dots:
    """The mean image of each dot in each pose over the frames in which none lies near it. Raises
    InputError.
    """
    _, which = np.unique(np.stack([data.seen.pose, data.dot]), axis=1, return_inverse=True)
    which = which.ravel()
    count = np.bincount(which)
    x_px, y_px, side_px = (
        np.bincount(which, part) / count for part in (data.seen.x_px, data.seen.y_px, sides_px)
    )
    reach = MAX_HALF_PX
    column = np.rint(x_px).astype(np.intp)
    row = np.rint(y_px).astype(np.intp)
    total, squares, lit = (
        np.zeros((len(count), *size)) for size in ((2 * reach + 1,) * 2, (2 * reach + 1,) * 2, ())
    )
    steps = np.arange(-reach, reach + 1)
    for (frame, pose), path in paths.items():
        here = np.flatnonzero((data.seen.frame == frame) & (data.seen.pose == pose))
        if not len(here):
            continue
        image = read_image(path, resolution_px)
        image = np.pad(image if dark is None else image - dark, reach, constant_values=np.nan)
        x = data.seen.x_px[here]
        y = data.seen.y_px[here]
        apart = np.maximum(np.abs(x[:, None] - x), np.abs(y[:, None] - y)) + np.where(
            np.eye(len(here)), np.inf, 0
        )
        alone = which[here[apart.min(axis=1, initial=np.inf) > 2 * MAX_HALF_PX]]
        cutouts = image[
            (row[alone, None] + reach + steps)[:, :, None],
            (column[alone, None] + reach + steps)[:, None, :],
        ]
        total[alone] += cutouts
        squares[alone] += cutouts**2
        lit[alone] += 1
    return _of_frames((total, squares, lit), (column, row, x_px, y_px, side_px))


def dots_of_image(image: FloatArray, x_px: FloatArray, y_px: FloatArray, side_px: float) -> Dots:
    """Dots of `side_px` at places (n,) of one image (h, w) that stand alone. Raises InputError
    where they are too few.
    """
    padded = np.pad(image, MAX_HALF_PX, constant_values=np.nan)
    apart = np.maximum(np.abs(x_px[:, None] - x_px), np.abs(y_px[:, None] - y_px)) + np.where(
        np.eye(len(x_px)), np.inf, 0
    )
    column = np.rint(x_px).astype(np.intp)
    row = np.rint(y_px).astype(np.intp)
    steps = np.arange(2 * MAX_HALF_PX + 1)
    cutouts = padded[(row[:, None] + steps)[:, :, None], (column[:, None] + steps)[:, None, :]]
    lit = np.where(apart.min(axis=1, initial=np.inf) > 2 * MAX_HALF_PX, 1.0, 0.0)
    return _of_frames(
        (cutouts, cutouts**2, lit), (column, row, x_px, y_px, np.full(len(x_px), side_px))
    )


def _of_frames(sums: tuple[FloatArray, FloatArray, FloatArray], places: tuple[Any, ...]) -> Dots:
    """Dots by the sums of their images, of the squares of these, and how many there were. Raises
    InputError for too few.
    """
    total, squares, lit = sums
    usable = np.flatnonzero((lit > 0) & np.isfinite(total).all(axis=(1, 2)))
    if len(usable) < MIN_DOTS:
        raise InputError(
            f"{len(usable)} dots stand alone by {2 * MAX_HALF_PX} px in some frame, and {MIN_DOTS}"
            " are needed; plan fewer --dots in a frame"
        )
    mean = total[usable] / lit[usable, None, None]
    spread = squares[usable] / lit[usable, None, None] - mean**2
    variance = _variance(mean, spread, lit[usable]) / lit[usable, None, None]
    dots = Dots(mean, variance, *(part[usable] for part in places))
    half = _half_px(dots)
    inner = slice(MAX_HALF_PX - half, MAX_HALF_PX + half + 1)
    return replace(dots, images=mean[:, inner, inner], variance=variance[:, inner, inner])


def _variance(mean: FloatArray, spread: FloatArray, lit: FloatArray) -> FloatArray:
    """The variance of one frame's pixels (n, s, s), linear in their light, by what repeats of a
    dot differ by.
    """
    again = np.flatnonzero(lit > 1)
    light = mean - np.median(mean)
    if not len(again):
        edge = np.concatenate([mean[:, 0].ravel(), mean[:, -1].ravel()])
        return np.full(mean.shape, float(np.var(edge)) + QUANTISED_DN2)
    unbiased = (spread[again] * (lit[again] / (lit[again] - 1))[:, None, None]).ravel()
    lone_light = light[again].ravel()
    dim = lone_light < np.median(lone_light) + 0.1 * np.ptp(lone_light)
    flat = max(float(unbiased[dim].mean()), QUANTISED_DN2)
    slope = max(
        float(
            ((unbiased - flat) * lone_light)[~dim].sum()
            / max((lone_light[~dim] ** 2).sum(), 1e-300)
        ),
        0.0,
    )
    return flat + slope * light.clip(min=0)


def _half_px(dots: Dots) -> int:
    """Half the side of the square beyond which the dots have no light."""
    side = dots.images.shape[1]
    ring = np.abs(np.indices((side, side)) - side // 2).max(axis=0).ravel()
    flux = (dots.images - dots.images[:, :1].mean(axis=(1, 2), keepdims=True)).reshape(
        len(dots.images), -1
    )
    flux = flux.sum(axis=0)
    variance = dots.variance.reshape(len(dots.images), -1).sum(axis=0)
    size = np.bincount(ring)
    mean = np.bincount(ring, flux) / size
    sigma = np.sqrt(np.bincount(ring, variance)) / size
    visible = np.flatnonzero((mean > SEEN_SIGMAS * sigma) & (mean > SEEN_SHARE * mean[0]))
    return int(np.clip(visible.max(initial=0) + 2, MIN_HALF_PX, MAX_HALF_PX))


@dataclass(frozen=True, slots=True)
class HeldOut:
    """Of dots held out of a fit: rms of pixels relative to a dot's brightest one, what noise
    makes, and chi square by dot.
    """

    name: str
    rms: float
    noise: float
    chi2: FloatArray


@dataclass(frozen=True, slots=True)
class Found:
    """An effective PSF as a tracker's glass, the models that were held to dots that they had not
    seen, and the one chosen.
    """

    glass: Glass
    models: list[HeldOut]
    chosen: HeldOut
    asks_for_more: bool
    sigma_px: tuple[float, float]
    dots: int
    half_px: int


def fit_effective(dots: Dots, per_px: int) -> Found:
    """Fit dots, choose the model by those held out, and make the file's glass. Raises InputError
    for dots that are none.
    """
    place = np.stack([dots.x_px, dots.y_px], axis=1)
    middle = (place.max(axis=0) + place.min(axis=0)) / 2
    scale = max(float(np.ptp(place, axis=0).max()) / 2, 1.0)
    dots, covariance = _each_gaussian(dots)
    degrees = [
        d for d in range(MAX_DEGREE + 1) if (d + 1) * (d + 2) // 2 * DOTS_A_TERM <= len(place)
    ]
    counts = [(d + 1) * (d + 2) // 2 for d in degrees]
    start = Effective(middle, scale, np.zeros((counts[-1], 3)), _knots(dots), np.zeros((0, 0, 0)))
    fold = np.random.default_rng(SEED).permutation(len(place)) % FOLDS
    models = [
        _held_out(start, dots, covariance, fold, 0),
        *(_held_out(start, dots, covariance, fold, n) for n in counts),
    ]
    gaussian = models[0]
    best = min(models[1:], key=lambda model: float(model.chi2.mean()))
    gain = gaussian.chi2 - best.chi2
    asks = bool(gain.mean() > ASKS_SIGMAS * gain.std(ddof=1) / np.sqrt(len(gain)))
    chosen = best if asks else gaussian
    final, _ = _fitted(start, dots, covariance, counts[models.index(best) - 1] if asks else 0)
    half = dots.images.shape[1] // 2
    glass = _glass(final, place, half, per_px)
    variance = final.covariance[0, :XY].clip(min=MIN_VARIANCE_PX2)
    return Found(
        glass,
        models,
        chosen,
        asks,
        (float(variance[0] ** 0.5), float(variance[1] ** 0.5)),
        len(place),
        half,
    )


def _knots(dots: Dots) -> FloatArray:
    reach = max(1.5, dots.images.shape[1] / 2 - float(np.median(dots.side_px)) / 2 - 2 * KNOT_PX)
    count = int(reach / KNOT_PX)
    return np.asarray(KNOT_PX * np.arange(-count, count + 1), dtype=np.float64)


def _each_gaussian(dots: Dots) -> tuple[Dots, FloatArray]:
    """Dots with their places, and covariances (n, 3), each by a Gaussian of its own."""
    points = PointImages(dots.images, 1 / dots.variance, dots.column, dots.row, dots.side_px)
    covariance = np.tile(FIRST_COVARIANCE_PX2, (len(dots.x_px), 1))
    fitted = fit_each(points, PointGaussians(dots.x_px, dots.y_px, covariance))
    return replace(dots, x_px=fitted.x_px, y_px=fitted.y_px), fitted.covariance


def _moved(dots: Dots) -> tuple[tuple[FloatArray, FloatArray], ...]:
    """The offsets of pixels from the dots if these were STEP_PX farther along x, and along y."""
    x, y = dots.offsets
    return (x - STEP_PX, y), (x, y - STEP_PX)


def _placed(model: Effective, dots: Dots) -> tuple[Dots, FloatArray, FloatArray]:
    """Dots with their places by a model, its shares (n, s, s), and their light and background
    (n, 2).
    """
    x_px = dots.x_px
    y_px = dots.y_px
    weight = 1 / dots.variance
    for _ in range(PLACE_ROUNDS):
        shares = model.of(x_px, y_px, dots.offsets, dots.side_px)
        columns = [shares, np.ones_like(shares)]
        for moved in _moved(dots):
            columns.append((model.of(x_px, y_px, moved, dots.side_px) - shares) / STEP_PX)
        solved = amplitudes(columns, weight, dots.images)
        steps = solved[:, 2:] / np.maximum(np.abs(solved[:, :1]), SMALLEST)
        steps = np.clip(steps, -MAX_STEP_PX, MAX_STEP_PX)
        dots = replace(dots, x_px=dots.x_px + steps[:, 0], y_px=dots.y_px + steps[:, 1])
    shares = model.of(x_px, y_px, dots.offsets, dots.side_px)
    return dots, shares, amplitudes((shares, np.ones_like(shares)), weight, dots.images)


def _fitted(
    start: Effective, dots: Dots, covariance: FloatArray, count: int
) -> tuple[Effective, Dots]:
    """A model of dots: the Gaussian's covariance over the field, and a spline with `count` terms
    over the field.
    """
    place = (np.stack([dots.x_px, dots.y_px], axis=1) - start.middle_px) / start.scale_px
    terms = terms_of(place, len(start.covariance))
    coefficients = over_field(terms, covariance)
    model = replace(start, covariance=coefficients)
    if not count:
        return model, dots
    for _ in range(SPLINE_ROUNDS):
        dots, _, amplitudes = _placed(model, dots)
        model = replace(
            model, spline=_spline(replace(model, spline=start.spline), dots, amplitudes, count)
        )
    return model, dots


def _spline(gaussian: Effective, dots: Dots, amplitudes: FloatArray, count: int) -> FloatArray:
    """The spline (count, m, m) of what dots have beside a Gaussian, by least squares with a
    prior of PRIOR_SHARE.
    """
    from scipy.sparse.linalg import LinearOperator, lsqr

    flux, background = amplitudes.T[:, :, None, None]
    flux = np.maximum(flux, 1e-9)
    sigma = np.sqrt(dots.variance) / flux
    rest = (dots.images - background) / flux - gaussian.of(
        dots.x_px, dots.y_px, dots.offsets, dots.side_px
    )
    across, down = (_functions(gaussian.knots_px, off, dots.side_px) for off in dots.offsets)
    place = (np.stack([dots.x_px, dots.y_px], axis=1) - gaussian.middle_px) / gaussian.scale_px
    terms = terms_of(place, count)
    size = len(gaussian.knots_px)

    def forward(coefficients: FloatArray) -> FloatArray:
        of_dot = np.tensordot(terms, coefficients.reshape(count, size, size), axes=1)
        return np.asarray((down @ of_dot @ across.transpose(0, 2, 1) / sigma).ravel())

    def backward(values: FloatArray) -> FloatArray:
        of_dot = down.transpose(0, 2, 1) @ (values.reshape(sigma.shape) / sigma) @ across
        return np.asarray(np.tensordot(terms.T, of_dot, axes=1).ravel())

    operator = LinearOperator(
        (sigma.size, count * size * size), matvec=forward, rmatvec=backward, dtype=np.float64
    )
    solution = lsqr(
        operator,
        (rest / sigma).ravel(),
        damp=1 / PRIOR_SHARE,
        iter_lim=SPLINE_STEPS,
        atol=1e-5,
        btol=1e-5,
    )[0]
    return np.asarray(solution.reshape(count, size, size))


def _held_out(
    start: Effective, dots: Dots, covariance: FloatArray, fold: IntArray, count: int
) -> HeldOut:
    """How far a model is off dots that it was not fitted to; only their places, light and
    background are.
    """
    chi2, rms, noise = (np.zeros(len(fold)) for _ in range(3))
    for number in range(FOLDS):
        known = np.flatnonzero(fold != number)
        held = np.flatnonzero(fold == number)
        model, _ = _fitted(start, dots.at(known), covariance[known], count)
        own_stamps, shares, amplitudes = _placed(model, dots.at(held))
        flux, background = amplitudes.T[:, :, None, None]
        off = own_stamps.images - background - flux * shares
        peak = np.abs(flux[:, 0, 0]) * shares.max(axis=(1, 2))
        chi2[held] = (off**2 / own_stamps.variance).mean(axis=(1, 2))
        rms[held] = np.sqrt((off**2).mean(axis=(1, 2))) / peak
        noise[held] = np.sqrt(own_stamps.variance.mean(axis=(1, 2))) / peak
    if count:
        name = (
            f"spline, {('constant', 'linear', 'quadratic')[(1, 3, 6).index(count)]} over the field"
        )
    else:
        name = "Gaussian"
    return HeldOut(name, float(np.sqrt(np.mean(rms**2))), float(np.sqrt(np.mean(noise**2))), chi2)


def _glass(model: Effective, place: FloatArray, half_px: int, per_px: int) -> Glass:
    """The model at points over the dots' field, each with its centroid in the middle."""
    low = place.min(axis=0)
    high = place.max(axis=0)
    x_px, y_px = (part.ravel() for part in np.meshgrid(*np.linspace(low, high, POINTS).T))
    steps = np.arange(-half_px * per_px, half_px * per_px + 1) / per_px
    none = np.zeros(len(x_px))
    off = [np.tile(steps, (len(x_px), 1)) for _ in (0, 1)]
    for _ in range(3):
        images = model.of(x_px, y_px, (off[0], off[1]), none)
        total = images.sum(axis=(1, 2))
        off[0] = off[0] + (images.sum(axis=1) @ steps / total)[:, None]
        off[1] = off[1] + (images.sum(axis=2) @ steps / total)[:, None]
    images = model.of(x_px, y_px, (off[0], off[1]), none)
    at = np.column_stack([x_px, y_px, np.full(len(x_px), np.nan), none])
    history = (
        f"hilstar calibrate psf: {len(place)} dots",
        "collimator and tracker together, without the dots' squares; centroids in the middle",
    )
    return glass_of(
        Stack(images, at, facts_of(len(at)), per_px, pixel_integrated=True), history=history
    )


def draw_effective(path: Path, found: Found) -> None:
    """Draw the PSFs at the corners, edges and middle of the field."""
    images = found.glass.images[:, 0, 0]
    finding = (
        f"Held-out dots: {found.chosen.name} is off by {found.chosen.rms:.2%} of the peak, noise by"
        f" {found.chosen.noise:.2%}"
    )
    with chart(path, finding, height_inch=6.6) as (axes,):
        picked = images.reshape(POINTS, POINTS, *images.shape[1:])[:: POINTS // 2, :: POINTS // 2]
        # points are sorted by x, then y
        picture = picked.transpose(1, 2, 0, 3).reshape(3 * images.shape[1], -1)
        axes.imshow(np.sqrt(picture.clip(min=0)), cmap="viridis", interpolation="nearest")
        axes.set(
            xticks=[],
            yticks=[],
            xlabel="left, middle and right of the dots' field",
            ylabel="bottom, middle, top",
        )
        axes.grid(visible=False)


def summary_of(found: Found) -> dict[str, Any]:
    """The figures of an effective PSF, by the keys of --json."""
    models = []
    for m in found.models:
        models.append(
            {"name": m.name, "rms": m.rms, "noise": m.noise, "reduced_chi2": float(m.chi2.mean())}
        )
    return {
        "dots": found.dots,
        "half_px": found.half_px,
        "sigma_px": list(found.sigma_px),
        "model": found.chosen.name,
        "more_than_gaussian": found.asks_for_more,
        "held_out": {
            "rms": found.chosen.rms,
            "noise": found.chosen.noise,
            "reduced_chi2": float(found.chosen.chi2.mean()),
        },
        "models": models,
        "components": len(found.glass.basis),
    }


def lines_of(found: Found) -> list[str]:
    """The same as lines of text."""
    x, y = found.sigma_px
    side_px = 2 * found.half_px + 1
    sigmas = f"sigma {x:.3f} and {y:.3f} px in the middle of the field, without dot and pixel"
    rows = [
        ("dots", f"{found.dots}, each within {side_px} x {side_px} px"),
        ("Gaussian", sigmas),
    ]
    for model in found.models:
        text = (
            f"{model.rms:.2%} of the peak off held-out dots (noise: {model.noise:.2%}), reduced chi"
            f" square {model.chi2.mean():.2f}"
        )
        rows.append((model.name, text))
    chosen = found.chosen.name
    if not found.asks_for_more:
        chosen += ": the data ask for no more"
    rows.append(("chosen", chosen))
    width = max(len(name) for name, _ in rows) + 2
    return [f"{name:{width}}{text}" for name, text in rows]
