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
from scipy.spatial import cKDTree

from hilstar.basics.arrays import BoolArray, FloatArray, IntArray
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
MODEL_NAMES = {  # by the number of the spline's terms over the field
    0: "Gaussian",
    1: "spline, constant over the field",
    3: "spline, linear over the field",
    6: "spline, quadratic over the field",
}


@dataclass(frozen=True, slots=True)
class Dots:
    """Mean images of n dots (n, side, side), DN, and their variance, DN^2; the middle pixels, the
    dots' places and sides, px, (n,) each.
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
    def places_px(self) -> FloatArray:
        """Places (n, 2), x and y."""
        return np.stack([self.x_px, self.y_px], axis=1)

    @property
    def offsets(self) -> tuple[FloatArray, FloatArray]:
        """Pixels' places less their dot's, along x and y (n, side)."""
        side = self.images.shape[1]
        reach = np.arange(side) - side // 2
        across = (self.column - self.x_px)[:, None] + reach
        down = (self.row - self.y_px)[:, None] + reach
        return across, down


@dataclass(frozen=True, slots=True)
class Effective:
    """An effective PSF over the field: a Gaussian's covariance (T, 3) and a spline (T', m, m), both
    by coefficients of polynomials of the place.

    A place counts from `middle_px` in units of `scale_px`. `knots_px` (m,) are the middles of the
    spline's functions, along each axis.
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
            coefficients = self._of(x_px, y_px, self.spline)
            across = _functions(self.knots_px, offsets[0], side_px)
            down = _functions(self.knots_px, offsets[1], side_px)
            shares += down @ coefficients @ across.transpose(0, 2, 1)
        return shares

    def place(self, places_px: FloatArray) -> FloatArray:
        """Places (n, 2), px, as those of the polynomials: from -1 to 1 over the dots' field."""
        return np.asarray((places_px - self.middle_px) / self.scale_px)

    def _of(self, x_px: FloatArray, y_px: FloatArray, coefficients: FloatArray) -> FloatArray:
        """Polynomials with coefficients (T, ...) at places (n,): (n, ...)."""
        place = self.place(np.stack([x_px, y_px], axis=1))
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
    integral = basis_spline.antiderivative()
    end_px = 2 * KNOT_PX
    half = np.maximum(side_px, 1e-3)[:, None, None] / 2
    off = offset_px[:, :, None] - knots_px
    high = integral(np.clip(off + half, -end_px, end_px))
    low = integral(np.clip(off - half, -end_px, end_px))
    return np.asarray((high - low) / (2 * half))


def effective_psf(
    file: BenchFile, images: Sequence[Path], plan: Path, dark: Path | None, per_px: int
) -> "Found":
    """The effective PSF from a tracker's images of planned dots. Raises InputError."""
    resolution_px = file.config.tracker.resolution_px
    nominal = nominal_of(file)
    dots = read_plan(plan)
    observed = measure_images(images, dark, resolution_px, dot_sigma_px(file))
    look = first_look(dots, nominal, observed, np.random.default_rng(SEED))
    _, data = matched(dots, nominal, observed, look)
    count = len(np.unique(data.dot))
    if count < MIN_DOTS:
        raise InputError(
            f"{count} dots were recognised and {MIN_DOTS} are needed; show more dots or frames"
        )
    dark_image = None
    if dark is not None:
        dark_image = read_image(dark, resolution_px)
    sides_px = _dot_sides(data, dots.x_px, dots.y_px)
    cut = cut_out(numbered(images), resolution_px, dark_image, data, sides_px)
    return fit_effective(cut, per_px)


def _dot_sides(data: MatchedDots, x_px: FloatArray, y_px: FloatArray) -> FloatArray:
    """The side of a dot where each centroid is, tracker px (n,), by a cubic map from the tracker
    to the monitor.
    """
    tracker_px = np.stack([data.centroids.x_px, data.centroids.y_px], axis=1)
    monitor_px = np.stack([x_px[data.dot], y_px[data.dot]], axis=1)
    middle = tracker_px.mean(axis=0)
    scale = float(np.abs(tracker_px - middle).max())
    u, v = ((tracker_px - middle) / scale).T
    # a cubic map has ten terms; few dots determine a linear one
    degree = 3 if len(data) > 40 else 1
    terms = []
    by_u = []
    by_v = []
    for i in range(degree + 1):
        slope_u = i * u ** max(i - 1, 0)
        for j in range(degree + 1 - i):
            slope_v = v ** max(j - 1, 0)
            terms.append(u**i * v**j)
            by_u.append(slope_u * v**j / scale)
            by_v.append(j * u**i * slope_v / scale)
    maps = np.linalg.lstsq(np.stack(terms, axis=1), monitor_px, rcond=None)[0]
    x_by_u, y_by_u = (np.stack(by_u, axis=1) @ maps).T
    x_by_v, y_by_v = (np.stack(by_v, axis=1) @ maps).T
    # monitor pixels in one of the tracker's
    area = np.abs(x_by_u * y_by_v - x_by_v * y_by_u)
    return np.asarray(DOT_PX / np.sqrt(area))


@dataclass(frozen=True, slots=True)
class _Sums:
    """Sums of n dots' images over frames, and of their squares (n, s, s), and how many frames
    there were (n,).
    """

    total: FloatArray
    squares: FloatArray
    frames: FloatArray

    @classmethod
    def none(cls, count: int) -> "_Sums":
        """Sums before the first frame."""
        side = 2 * MAX_HALF_PX + 1
        shape = (count, side, side)
        return cls(np.zeros(shape), np.zeros(shape), np.zeros(count))

    def add(self, dot: IntArray, cutouts: FloatArray) -> None:
        """Add images of some dots (k, s, s)."""
        self.total[dot] += cutouts
        self.squares[dot] += cutouts**2
        self.frames[dot] += 1


@dataclass(frozen=True, slots=True)
class _Places:
    """Middle pixels of n dots, their places, px, and the sides of their squares, px, (n,) each."""

    column: IntArray
    row: IntArray
    x_px: FloatArray
    y_px: FloatArray
    side_px: FloatArray

    @classmethod
    def of(cls, x_px: FloatArray, y_px: FloatArray, side_px: FloatArray) -> "_Places":
        """Those of dots at places (n,)."""
        column = np.rint(x_px).astype(np.intp)
        row = np.rint(y_px).astype(np.intp)
        return cls(column, row, x_px, y_px, side_px)

    def cutouts(self, image: FloatArray, dot: IntArray) -> FloatArray:
        """Squares (k, s, s) of an image (h, w) about some dots; NaN beyond its edges."""
        padded = np.pad(image, MAX_HALF_PX, constant_values=np.nan)
        # the margin is as wide as the reach: a dot's first pixel is at its own middle's index
        steps = np.arange(2 * MAX_HALF_PX + 1)
        rows = self.row[dot, None] + steps
        columns = self.column[dot, None] + steps
        return np.asarray(padded[rows[:, :, None], columns[:, None, :]])


def are_alone(x_px: FloatArray, y_px: FloatArray, half_px: int) -> BoolArray:
    """Which places (n,) have no other within 2 `half_px` along both axes."""
    places_px = np.stack([x_px, y_px], axis=1)
    # the nearest of all is the place itself; a table of all pairs of a lattice takes a gigabyte
    distances: Any = cKDTree(places_px).query(places_px, k=[2], p=np.inf)[0]
    return np.asarray(distances[:, 0] > 2 * half_px)


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
    _, dot = np.unique(np.stack([data.centroids.pose, data.dot]), axis=1, return_inverse=True)
    dot = dot.ravel()
    count = np.bincount(dot)
    x_px = np.bincount(dot, data.centroids.x_px) / count
    y_px = np.bincount(dot, data.centroids.y_px) / count
    side_px = np.bincount(dot, sides_px) / count
    places = _Places.of(x_px, y_px, side_px)
    sums = _Sums.none(len(count))
    for (frame, pose), path in paths.items():
        in_frame = np.flatnonzero((data.centroids.frame == frame) & (data.centroids.pose == pose))
        if not len(in_frame):
            continue
        image = read_image(path, resolution_px)
        if dark is not None:
            image = image - dark
        is_alone = are_alone(
            data.centroids.x_px[in_frame], data.centroids.y_px[in_frame], MAX_HALF_PX
        )
        alone = dot[in_frame[is_alone]]
        sums.add(alone, places.cutouts(image, alone))
    return _of_frames(sums, places)


def dots_of_image(image: FloatArray, x_px: FloatArray, y_px: FloatArray, side_px: float) -> Dots:
    """Dots of `side_px` at places (n,) of one image (h, w) that stand alone. Raises InputError
    where they are too few.
    """
    places = _Places.of(x_px, y_px, np.full(len(x_px), side_px))
    alone = np.flatnonzero(are_alone(x_px, y_px, MAX_HALF_PX))
    sums = _Sums.none(len(x_px))
    sums.add(alone, places.cutouts(image, alone))
    return _of_frames(sums, places)


def _of_frames(sums: _Sums, places: _Places) -> Dots:
    """Dots by the sums of their images, without those that the image's edge cuts. Raises
    InputError for too few.
    """
    is_whole = np.isfinite(sums.total).all(axis=(1, 2))
    usable = np.flatnonzero((sums.frames > 0) & is_whole)
    if len(usable) < MIN_DOTS:
        raise InputError(
            f"{len(usable)} dots stand alone by {2 * MAX_HALF_PX} px in some frame, and {MIN_DOTS}"
            " are needed; plan fewer --dots in a frame"
        )
    frames = sums.frames[usable]
    pixel_frames = frames[:, None, None]
    mean = sums.total[usable] / pixel_frames
    spread = sums.squares[usable] / pixel_frames - mean**2
    dots = Dots(
        images=mean,
        variance=_variance(mean, spread, frames) / pixel_frames,
        column=places.column[usable],
        row=places.row[usable],
        x_px=places.x_px[usable],
        y_px=places.y_px[usable],
        side_px=places.side_px[usable],
    )
    half = _half_px(dots)
    inner = slice(MAX_HALF_PX - half, MAX_HALF_PX + half + 1)
    inner_images = dots.images[:, inner, inner]
    return replace(dots, images=inner_images, variance=dots.variance[:, inner, inner])


def _variance(mean: FloatArray, spread: FloatArray, lit: FloatArray) -> FloatArray:
    """The variance of one frame's pixels (n, s, s), DN^2: linear in their light, fitted to how
    frames of one dot differ.

    `mean` and `spread` (n, s, s) are the mean and the variance of `lit` (n,) frames.
    """
    repeated = np.flatnonzero(lit > 1)
    light = mean - np.median(mean)
    if not len(repeated):
        # without repeats the edges of the squares, where light is least
        first_row = mean[:, 0].ravel()
        last_row = mean[:, -1].ravel()
        edge = np.concatenate([first_row, last_row])
        return np.full(mean.shape, float(np.var(edge)) + QUANTISED_DN2)
    bessel = lit[repeated] / (lit[repeated] - 1)
    variance = (spread[repeated] * bessel[:, None, None]).ravel()
    repeated_light = light[repeated].ravel()
    dim_limit = np.median(repeated_light) + 0.1 * np.ptp(repeated_light)
    is_dim = repeated_light < dim_limit
    flat = max(float(variance[is_dim].mean()), QUANTISED_DN2)
    bright_light = repeated_light[~is_dim]
    products = ((variance - flat) * repeated_light)[~is_dim]
    light_square = max((bright_light**2).sum(), 1e-300)
    slope = max(float(products.sum() / light_square), 0.0)
    return flat + slope * light.clip(min=0)


def _half_px(dots: Dots) -> int:
    """Half the side of the square beyond which the dots have no light."""
    count, side, _ = dots.images.shape
    from_middle = np.abs(np.indices((side, side)) - side // 2)
    ring = from_middle.max(axis=0).ravel()
    first_row = dots.images[:, :1].mean(axis=(1, 2), keepdims=True)
    flux = (dots.images - first_row).reshape(count, -1).sum(axis=0)
    variance = dots.variance.reshape(count, -1).sum(axis=0)
    size = np.bincount(ring)
    mean = np.bincount(ring, flux) / size
    sigma = np.sqrt(np.bincount(ring, variance)) / size
    is_lit = (mean > SEEN_SIGMAS * sigma) & (mean > SEEN_SHARE * mean[0])
    last_lit = np.flatnonzero(is_lit).max(initial=0)
    return int(np.clip(last_lit + 2, MIN_HALF_PX, MAX_HALF_PX))


@dataclass(frozen=True, slots=True)
class HeldOut:
    """Errors of a model on dots held out of its fit: rms of their pixels relative to the dot's
    brightest one, that which noise alone makes, and the reduced chi square of each dot.
    """

    name: str
    rms: float
    noise: float
    chi2: FloatArray


@dataclass(frozen=True, slots=True)
class Found:
    """An effective PSF as a tracker's glass, the models tried on dots held out of their fits, and
    the one chosen; `sigma_px` is the Gaussian's, along x and y in the middle of the field.
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
    places_px = dots.places_px
    middle = (places_px.max(axis=0) + places_px.min(axis=0)) / 2
    scale = max(float(np.ptp(places_px, axis=0).max()) / 2, 1.0)
    dots, covariance = _each_gaussian(dots)
    counts = []
    for degree in range(MAX_DEGREE + 1):
        terms = (degree + 1) * (degree + 2) // 2
        if terms * DOTS_A_TERM <= len(places_px):
            counts.append(terms)
    start = Effective(
        middle_px=middle,
        scale_px=scale,
        covariance=np.zeros((counts[-1], 3)),
        knots_px=_knots(dots),
        spline=np.zeros((0, 0, 0)),
    )
    fold = np.random.default_rng(SEED).permutation(len(places_px)) % FOLDS
    models = [_held_out(start, dots, covariance, fold, count) for count in (0, *counts)]
    gaussian, *splines = models
    best = min(splines, key=lambda model: float(model.chi2.mean()))
    gain = gaussian.chi2 - best.chi2
    gain_error = gain.std(ddof=1) / np.sqrt(len(gain))
    asks = bool(gain.mean() > ASKS_SIGMAS * gain_error)
    chosen = gaussian
    count = 0
    if asks:
        chosen = best
        count = counts[splines.index(best)]
    final, _ = _fitted(start, dots, covariance, count)
    half = dots.images.shape[1] // 2
    x_variance, y_variance = final.covariance[0, :XY].clip(min=MIN_VARIANCE_PX2)
    return Found(
        glass=_glass(final, places_px, half, per_px),
        models=models,
        chosen=chosen,
        asks_for_more=asks,
        sigma_px=(float(x_variance**0.5), float(y_variance**0.5)),
        dots=len(places_px),
        half_px=half,
    )


def _knots(dots: Dots) -> FloatArray:
    """The middles (m,) of the spline's functions, px, as far as the dots' images reach."""
    half_side_px = float(np.median(dots.side_px)) / 2
    reach_px = dots.images.shape[1] / 2 - half_side_px - 2 * KNOT_PX
    count = int(max(1.5, reach_px) / KNOT_PX)
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
        light = np.maximum(np.abs(solved[:, :1]), SMALLEST)
        steps = np.clip(solved[:, 2:] / light, -MAX_STEP_PX, MAX_STEP_PX)
        step_x, step_y = steps.T
        dots = replace(dots, x_px=dots.x_px + step_x, y_px=dots.y_px + step_y)
    shares = model.of(x_px, y_px, dots.offsets, dots.side_px)
    return dots, shares, amplitudes((shares, np.ones_like(shares)), weight, dots.images)


def _fitted(
    start: Effective, dots: Dots, covariance: FloatArray, count: int
) -> tuple[Effective, Dots]:
    """A model of dots: the Gaussian's covariance over the field, and a spline with `count` terms
    over the field.
    """
    terms = terms_of(start.place(dots.places_px), len(start.covariance))
    coefficients = over_field(terms, covariance)
    gaussian = replace(start, covariance=coefficients)
    if not count:
        return gaussian, dots
    model = gaussian
    for _ in range(SPLINE_ROUNDS):
        dots, _, amplitudes = _placed(model, dots)
        model = replace(gaussian, spline=_spline(gaussian, dots, amplitudes, count))
    return model, dots


def _spline(gaussian: Effective, dots: Dots, amplitudes: FloatArray, count: int) -> FloatArray:
    """The spline (count, m, m) of what dots have beside a Gaussian, by least squares with a
    prior of PRIOR_SHARE.
    """
    from scipy.sparse.linalg import LinearOperator, lsqr

    flux, background = amplitudes.T[:, :, None, None]
    flux = np.maximum(flux, 1e-9)
    sigma = np.sqrt(dots.variance) / flux
    shares = (dots.images - background) / flux
    rest = shares - gaussian.of(dots.x_px, dots.y_px, dots.offsets, dots.side_px)
    across_px, down_px = dots.offsets
    across = _functions(gaussian.knots_px, across_px, dots.side_px)
    down = _functions(gaussian.knots_px, down_px, dots.side_px)
    terms = terms_of(gaussian.place(dots.places_px), count)
    size = len(gaussian.knots_px)

    def forward(coefficients: FloatArray) -> FloatArray:
        of_dot = np.tensordot(terms, coefficients.reshape(count, size, size), axes=1)
        model = down @ of_dot @ across.transpose(0, 2, 1)
        return np.asarray((model / sigma).ravel())

    def backward(values: FloatArray) -> FloatArray:
        weighted = values.reshape(sigma.shape) / sigma
        of_dot = down.transpose(0, 2, 1) @ weighted @ across
        return np.asarray(np.tensordot(terms.T, of_dot, axes=1).ravel())

    shape = (sigma.size, count * size * size)
    operator = LinearOperator(shape, matvec=forward, rmatvec=backward, dtype=np.float64)
    solution = lsqr(
        operator,
        (rest / sigma).ravel(),
        damp=1 / PRIOR_SHARE,
        iter_lim=SPLINE_STEPS,
        atol=1e-5,
        btol=1e-5,
    )
    return np.asarray(solution[0].reshape(count, size, size))


def _held_out(
    start: Effective, dots: Dots, covariance: FloatArray, fold: IntArray, count: int
) -> HeldOut:
    """How far a model is off dots that it was not fitted to; only their places, light and
    background are.
    """
    chi2 = np.zeros(len(fold))
    rms = np.zeros(len(fold))
    noise = np.zeros(len(fold))
    for number in range(FOLDS):
        known = np.flatnonzero(fold != number)
        held = np.flatnonzero(fold == number)
        model, _ = _fitted(start, dots.at(known), covariance[known], count)
        placed, shares, amplitudes = _placed(model, dots.at(held))
        flux, background = amplitudes.T[:, :, None, None]
        squares = (placed.images - background - flux * shares) ** 2
        peak = np.abs(flux[:, 0, 0]) * shares.max(axis=(1, 2))
        square = squares.mean(axis=(1, 2))
        variance = placed.variance.mean(axis=(1, 2))
        chi2[held] = (squares / placed.variance).mean(axis=(1, 2))
        rms[held] = np.sqrt(square) / peak
        noise[held] = np.sqrt(variance) / peak
    return HeldOut(MODEL_NAMES[count], _rms(rms), _rms(noise), chi2)


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _glass(model: Effective, place: FloatArray, half_px: int, per_px: int) -> Glass:
    """The model at points over the dots' field, each with its centroid in the middle."""
    low = place.min(axis=0)
    high = place.max(axis=0)
    columns, rows = np.linspace(low, high, POINTS).T
    grid_x, grid_y = np.meshgrid(columns, rows)
    x_px = grid_x.ravel()
    y_px = grid_y.ravel()
    count = len(x_px)
    reach = half_px * per_px
    steps = np.arange(-reach, reach + 1) / per_px
    no_side = np.zeros(count)
    across = np.tile(steps, (count, 1))
    down = np.tile(steps, (count, 1))
    for _ in range(3):
        images = model.of(x_px, y_px, (across, down), no_side)
        total = images.sum(axis=(1, 2))
        x_centroid = images.sum(axis=1) @ steps / total
        y_centroid = images.sum(axis=2) @ steps / total
        across = across + x_centroid[:, None]
        down = down + y_centroid[:, None]
    images = model.of(x_px, y_px, (across, down), no_side)
    in_focus = np.zeros(count)
    at = np.column_stack([x_px, y_px, np.full(count, np.nan), in_focus])
    history = (
        f"hilstar calibrate psf: {len(place)} dots",
        "collimator and tracker together, without the dots' squares; centroids in the middle",
    )
    stack = Stack(images, at, facts_of(count), per_px, pixel_integrated=True)
    return glass_of(stack, history=history)


def draw_effective(path: Path, found: Found) -> None:
    """Draw the PSFs at the corners, edges and middle of the field."""
    images = found.glass.images[:, 0, 0]
    finding = (
        f"Held-out dots: {found.chosen.name} is off by {found.chosen.rms:.2%} of the peak, noise by"
        f" {found.chosen.noise:.2%}"
    )
    with chart(path, finding, height_inch=6.6) as (axes,):
        grid = images.reshape(POINTS, POINTS, *images.shape[1:])
        picked = grid[:: POINTS // 2, :: POINTS // 2]
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
    for model in found.models:
        models.append({"name": model.name, **_errors(model)})
    return {
        "dots": found.dots,
        "half_px": found.half_px,
        "sigma_px": list(found.sigma_px),
        "model": found.chosen.name,
        "more_than_gaussian": found.asks_for_more,
        "held_out": _errors(found.chosen),
        "models": models,
        "components": len(found.glass.basis),
    }


def _errors(model: HeldOut) -> dict[str, float]:
    """Errors on held-out dots, by the keys of --json."""
    return {"rms": model.rms, "noise": model.noise, "reduced_chi2": float(model.chi2.mean())}


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
