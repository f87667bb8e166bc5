"""Stars found in an image, and their places: a threshold, connected blobs, a windowed centre of
gravity.

The Gaussian window is that of SExtractor's XWIN_IMAGE: the place x where the sum over pixels of
w(i - x) (i - x) I_i is zero, w a Gaussian of `window_sigma_px`. The plain window is the centre of
gravity of a square of pixels.

Both sample the image at pixels, so both have an S-curve: a bias that repeats with the place within
the pixel. For a
Gaussian star of s px, integrated over pixels, the plain window's is -exp(-2 pi^2 s^2) sin(2 pi x) /
pi: 0.0135 px at
s = 0.4, 0.0023 at 0.5, under 1e-5 from 0.75 on. The Gaussian window's is larger, and larger yet for
a narrow window:
0.017 px at s = 0.55 and a window of 1 px. Where the star's sigma is known (`psf_sigma_px`) the
S-curve is removed. tests/authority/test_centroids.py measures all of this, with the noise.
"""

import functools
import math
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.errors import InputError
from hilstar.basics.units import MAD_TO_SIGMA

Window = Literal["gaussian", "plain"]
BoolArray = npt.NDArray[np.bool_]

CLIP_SIGMAS = 3.0
BLOCK_PX, NOISIER_PERCENT = 32, 90
# the sigma of a normal distribution cut at 3 sigma: sqrt(1 - 6 pdf(3) / (2 cdf(3) - 1))
CLIPPED_SIGMA = 0.986578
MIN_STEP_PX = 1e-7
WITH_DIAGONALS = np.ones((3, 3), dtype=np.bool_)
# Share of s^2 by which the window can narrow the star's second moment: Newton's step is at most 10
# times the plain one, so that noise in the moment cannot throw the centre out of the window.
MIN_SLOPE = 0.1
COUNTED_TYPES, COUNTED_AT_ONCE = (np.uint8, np.uint16), 1 << 16
# where the bias is steepest, 2 pi 0.05 px a pixel, interpolation between two of them is right to
# 1e-5 px
S_CURVE_PHASES = 201
# a star's width: half the side of its square, and the ends of what is found in it
WIDTH_RADIUS_PX, MIN_WIDTH_PX, MAX_WIDTH_PX = 15, 0.3, 6.0
WIDTH_ROUNDS = 12


@dataclass(frozen=True, slots=True)
class LocalBackground:
    """The background under the stars, in the image's unit: its level, and the sigma of a pixel's
    noise.
    """

    level: float
    noise: float


@dataclass(frozen=True, slots=True)
class CentroidSettings:
    """How stars are found: pixels above `threshold_sigma`, in blobs of `minimum_pixels`, then a
    window around each.

    `window_radius_px` (default: 4 window sigmas, rounded up) is half the window's side: it is 2
    radius + 1 pixels wide. `psf_sigma_px` (x, y), where known, removes the S-curve of that Gaussian
    star from the places. Raises InputError for a value out of range.
    """

    threshold_sigma: float = 5.0
    minimum_pixels: int = 1
    window: Window = "gaussian"
    window_sigma_px: float = 1.0
    window_radius_px: int | None = None
    psf_sigma_px: tuple[float, float] | None = None
    iterations: int = 30

    def __post_init__(self) -> None:
        if self.window not in get_args(Window):
            raise InputError(f'centroids: window = {self.window!r}; write "gaussian" or "plain"')
        limits = {
            "threshold_sigma": 0,
            "minimum_pixels": 1,
            "window_sigma_px": 0.1,
            "iterations": 1,
        }
        for name, low in limits.items():
            value = getattr(self, name)
            if not low <= value < math.inf:
                raise InputError(f"centroids: {name} = {value:g}; write a number from {low:g} up")
        if self.window_radius_px is not None and not 1 <= self.window_radius_px <= 1000:
            raise InputError(
                f"centroids: window_radius_px = {self.window_radius_px}; write 1 to 1000 pixels"
            )
        psf_px = self.psf_sigma_px
        if psf_px is not None and not all(0.05 <= sigma <= 100 for sigma in psf_px):
            raise InputError(
                f"centroids: psf_sigma_px = {self.psf_sigma_px}; write two numbers from 0.05 to 100"
            )

    @property
    def radius_px(self) -> int:
        """Half the side of the window, without its middle pixel."""
        return self.window_radius_px or math.ceil(4 * self.window_sigma_px)


@dataclass(frozen=True, slots=True)
class Centroids:
    """Stars, arrays of shape (n,), brightest first; (0, 0) is the centre of the top-left pixel, x
    right, y down.

    `flux` is the sum in the window, `peak` the highest pixel of the blob, both above the background
    and in the image's unit; `pixels` counts the blob; `at_edge` says that the window leaves the
    image, which biases the place inwards.
    """

    x_px: FloatArray
    y_px: FloatArray
    flux: FloatArray
    peak: FloatArray
    pixels: IntArray
    at_edge: BoolArray

    def __len__(self) -> int:
        return len(self.x_px)


@dataclass(frozen=True, slots=True)
class _Blobs:
    """What the threshold found: arrays (n,), places by the centre of gravity of what is above
    the background.
    """

    x_px: FloatArray
    y_px: FloatArray
    peak: FloatArray
    pixels: IntArray


def estimate_background(image: npt.NDArray[Any], step: float | None = None) -> LocalBackground:
    """The background of a whole image: median and MAD, then mean and sigma of the pixels within 3
    sigma of the median.

    The second step resolves a fraction of a DN where the median, and the MAD, are whole ones. One
    level for the image: a gradient counts as noise. `step` is what the image was rounded to
    (default: 1 for whole numbers, else 0), and the noise at least rounding's, step / sqrt 12. That
    of a noiseless float image is 0, and then every pixel over the level belongs to a star: give a
    `LocalBackground` for such an image.
    """
    if step is None:
        step = 1.0 if image.dtype.kind in "iu" else 0.0
    _check(image)
    counts: IntArray | None = None
    if image.dtype in COUNTED_TYPES:
        values, counts = _counted(image)
    else:
        values = image.astype(np.float64).ravel()
    median = _median(values, counts)
    deviation = np.abs(values - median)
    sigma = MAD_TO_SIGMA * _median(deviation, counts)
    # Where the noise is under a step, a cut at 3 sigma would keep a code on one side and drop its
    # counterpart on the other.
    is_background = deviation <= CLIP_SIGMAS * max(sigma, step)
    background = values[is_background]
    weights = None
    if counts is not None:
        weights = counts[is_background]
    level = float(np.average(background, weights=weights))
    squared = (background - level) ** 2
    variance = float(np.average(squared, weights=weights))
    noise = math.sqrt(variance) / CLIPPED_SIGMA
    return LocalBackground(level, max(noise, step / math.sqrt(12)))


def _counted(image: npt.NDArray[Any]) -> tuple[FloatArray, IntArray]:
    """The values in an image of DN, in order, and how many pixels have each: ten times faster
    than pixel by pixel.
    """
    flat = image.ravel()
    counts = np.zeros(int(image.max()) + 1, dtype=np.intp)
    # whose whole numbers of 64 bits stay in a core's cache
    for begin in range(0, len(flat), COUNTED_AT_ONCE):
        part = flat[begin : begin + COUNTED_AT_ONCE]
        counts += np.bincount(part, minlength=len(counts))
    values = np.flatnonzero(counts)
    return values.astype(np.float64), counts[values]


def _median(values: FloatArray, counts: IntArray | None) -> float:
    """The median of values (n,), each so many times."""
    if counts is None:
        return float(np.median(values))
    order = np.argsort(values, kind="stable")
    below = np.cumsum(counts[order])
    pixels = below[-1]
    middle_pixels = [(pixels - 1) // 2, pixels // 2]
    middle = np.searchsorted(below, middle_pixels, side="right")
    return float(values[order][middle].mean())


def noisiest_background(image: FloatArray, step: float = 1.0) -> LocalBackground:
    """The level of an image (h, w) in steps of `step`, such as DN, and the noise of its noisier
    parts, at least rounding's.

    A screen's black glows over a part of the detector; beyond it many an ADC clips at 0, and has no
    noise at all.
    """
    # First, for a median takes a copy of the image.
    if image.dtype in COUNTED_TYPES:
        level = _median(*_counted(image))
    else:
        level = float(np.median(image))
    image_height, image_width = image.shape
    rows = max(image_height // BLOCK_PX, 1)
    columns = max(image_width // BLOCK_PX, 1)
    height = image_height // rows
    width = image_width // columns
    whole = image[: rows * height, : columns * width]
    blocks = whole.reshape(rows, height, columns, width).swapaxes(1, 2)
    # Sorted in two thirds of the time of float64, and exact for whole steps up to 2^24.
    values: npt.NDArray[Any] = blocks.reshape(rows * columns, -1).astype(np.float32)
    values -= _row_medians(values)
    deviation = np.abs(values)
    # The median deviation of whole steps is a whole one: half a step more, so that nothing of the
    # noise is cut off.
    sigma = MAD_TO_SIGMA * (_row_medians(deviation) + step / 2)
    is_background = deviation <= CLIP_SIGMAS * sigma
    values *= is_background
    squares = np.einsum("ij,ij->i", values, values, dtype=np.float64)
    variance = squares / is_background.sum(axis=1)
    noise = np.sqrt(variance) / CLIPPED_SIGMA
    noisier = float(np.percentile(noise, NOISIER_PERCENT))
    return LocalBackground(level, max(noisier, step / math.sqrt(12)))


def _row_medians(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """The median of each row of values (n, k), (n, 1) of their type: whole rows are sorted in a
    tenth of `np.median`'s time.
    """
    size = values.shape[1]
    in_order = np.sort(values, axis=1)
    middle = in_order[:, (size - 1) // 2 : size // 2 + 1]
    return np.asarray(middle.mean(axis=1, keepdims=True))


def find_stars(
    image: npt.NDArray[Any],
    settings: CentroidSettings | None = None,
    background: LocalBackground | None = None,
) -> Centroids:
    """The stars of an image (height, width) of DN or electrons. Raises InputError for NaN, infinity
    or another shape.

    Without `background` it is estimated from the image. Stars whose blobs touch are one; a
    neighbour inside the window pulls the centre towards itself.
    """
    settings = settings or CentroidSettings()
    _check(image)
    under = background or estimate_background(image)
    threshold = settings.threshold_sigma * under.noise
    blobs = _find_blobs(image, under.level, threshold, settings.minimum_pixels)
    x_px, y_px = _refine(image, under.level, blobs, settings)
    stamps, _, _ = squares(image, under.level, x_px, y_px, settings.radius_px)
    flux = stamps.sum(axis=(1, 2))
    height, width = image.shape
    reach = settings.radius_px
    column = np.rint(x_px)
    row = np.rint(y_px)
    inside = (column >= reach) & (column < width - reach)
    inside &= (row >= reach) & (row < height - reach)
    if settings.psf_sigma_px is not None:
        curve_x, curve_y = s_curves(settings)
        x_px = x_px - np.interp(x_px, curve_x.measured_px, curve_x.bias_px, period=1.0)
        y_px = y_px - np.interp(y_px, curve_y.measured_px, curve_y.bias_px, period=1.0)
    order = np.argsort(-flux, kind="stable")
    return Centroids(
        x_px[order],
        y_px[order],
        flux[order],
        blobs.peak[order],
        blobs.pixels[order],
        ~inside[order],
    )


def _check(image: npt.NDArray[Any]) -> None:
    """Raise InputError for an image that has no stars to look for."""
    if image.ndim != 2 or 0 in image.shape or image.dtype.kind not in "fiu":
        raise InputError(
            f"centroids: an image of type {image.dtype}, shape {image.shape}; give numbers (height,"
            " width)"
        )
    if image.dtype.kind == "f" and not np.isfinite(image).all():
        raise InputError(
            "centroids: the image has a pixel that is NaN or infinite; give finite numbers"
        )


def _find_blobs(
    image: npt.NDArray[Any], level: float, threshold: float, minimum_pixels: int
) -> _Blobs:
    """Connected pixels more than the threshold above the level, diagonals included, in the order
    of the rows that meet them.
    """
    cut = level + threshold
    if image.dtype.kind in "iu":  # whole numbers are compared as such
        cut = math.floor(cut)
    # Imported with the first image: a server finds no stars.
    from scipy.ndimage import label

    above = image > cut
    labels, blob_count = label(above, structure=WITH_DIAGONALS)
    lit = np.flatnonzero(above)
    y, x = np.divmod(lit, image.shape[1])
    blob = labels.ravel()[lit].astype(np.intp) - 1
    value = image.ravel()[lit].astype(np.float64) - level
    pixels = np.bincount(blob, minlength=blob_count)
    flux = np.bincount(blob, value, minlength=blob_count)
    peak = np.zeros(blob_count)
    np.maximum.at(peak, blob, value)
    # Everything above a threshold of 0 or more is positive, so no blob's flux is 0.
    x_px = np.bincount(blob, value * x, minlength=blob_count) / flux
    y_px = np.bincount(blob, value * y, minlength=blob_count) / flux
    is_large = pixels >= minimum_pixels
    return _Blobs(x_px[is_large], y_px[is_large], peak[is_large], pixels[is_large])


def squares(
    image: npt.NDArray[Any],
    level: float,
    x_px: FloatArray | IntArray,
    y_px: FloatArray | IntArray,
    radius_px: int,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Squares of an image around n places: values over the level (n, k, k), and the pixels' offsets
    dx (n, 1, k), dy (n, k, 1).

    Beyond the image values are 0.
    """
    reach = np.arange(-radius_px, radius_px + 1)
    middle_column = np.rint(x_px).astype(np.intp)
    middle_row = np.rint(y_px).astype(np.intp)
    column = middle_column[:, None] + reach
    row = middle_row[:, None] + reach
    height, width = image.shape
    nearest_row = row.clip(0, height - 1)[:, :, None]
    nearest_column = column.clip(0, width - 1)[:, None, :]
    values = image[nearest_row, nearest_column].astype(np.float64) - level
    row_beyond = (row < 0) | (row >= height)
    if row_beyond.any():
        values *= ~row_beyond[:, :, None]
    column_beyond = (column < 0) | (column >= width)
    if column_beyond.any():
        values *= ~column_beyond[:, None, :]
    dx = column - x_px[:, None]
    dy = row - y_px[:, None]
    return values, dx[:, None, :], dy[:, :, None]


def star_widths(
    image: npt.NDArray[Any], level: float, x_px: FloatArray, y_px: FloatArray
) -> FloatArray:
    """The widths (n,) of stars at places in an image (h, w): one sigma of a round Gaussian star,
    the width of a pixel included, px; NaN where none is found.

    By the second moment in a Gaussian window that is made as wide as the star: of a star of sigma
    s in a window of w it is s^2 w^2 / (s^2 + w^2) (adaptive moments, Bernstein and Jarvis 2002).
    """
    values, dx, dy = squares(image, level, x_px, y_px, WIDTH_RADIUS_PX)
    distance2 = dx**2 + dy**2
    sigma2 = np.ones(len(x_px))
    with np.errstate(divide="ignore", invalid="ignore"):
        for _ in range(WIDTH_ROUNDS):
            weighted = values * np.exp(-0.5 * distance2 / sigma2[:, None, None])
            moment = (weighted * distance2).sum(axis=(1, 2)) / weighted.sum(axis=(1, 2)) / 2
            narrowed = 1 / moment - 1 / sigma2
            sigma2 = np.clip(1 / narrowed, MIN_WIDTH_PX**2, MAX_WIDTH_PX**2)
        widths_px = np.sqrt(sigma2)
    is_found = (widths_px > MIN_WIDTH_PX) & (widths_px < MAX_WIDTH_PX)
    return np.where(is_found, widths_px, np.nan)


def _refine(
    image: npt.NDArray[Any], level: float, blobs: _Blobs, settings: CentroidSettings
) -> tuple[FloatArray, FloatArray]:
    """Places (n,), px, by the settings' window, from those of blobs on."""
    if settings.window == "gaussian":
        return _gaussian_centres(image, level, blobs, settings)
    return _plain_centres(image, level, blobs, settings)


def _gaussian_centres(
    image: npt.NDArray[Any], level: float, blobs: _Blobs, settings: CentroidSettings
) -> tuple[FloatArray, FloatArray]:
    """Places (n,), px, where the Gaussian-weighted first moment is zero, by Newton's steps.

    The slope of the weighted moment is <d^2>/s^2 - 1 of its flux. A centre that leaves its window,
    or whose window holds no light, goes back to the blob's own centre of gravity.
    """
    place = np.stack([blobs.x_px, blobs.y_px])
    start = place.copy()
    sigma2 = settings.window_sigma_px**2
    lost = np.zeros(place.shape[1], dtype=np.bool_)
    for _ in range(settings.iterations):
        x_px, y_px = place
        values, dx, dy = squares(image, level, x_px, y_px, settings.radius_px)
        distance2 = dx**2 + dy**2
        weighted = values * np.exp(-0.5 * distance2 / sigma2)
        total = weighted.sum(axis=(1, 2))
        lost |= total <= 0
        total = np.where(lost, 1.0, total)
        first_x = (weighted * dx).sum(axis=(1, 2))
        first_y = (weighted * dy).sum(axis=(1, 2))
        first_px = np.stack([first_x, first_y])
        second_x = (weighted * dx**2).sum(axis=(1, 2))
        second_y = (weighted * dy**2).sum(axis=(1, 2))
        second_px2 = np.stack([second_x, second_y])
        slope = 1 - second_px2 / total / sigma2
        step = first_px / total / np.maximum(slope, MIN_SLOPE)
        moved = np.where(lost, start, place + step)
        from_start_px = np.abs(moved - start)
        lost |= (from_start_px > settings.radius_px).any(axis=0)
        moved = np.where(lost, start, moved)
        arrived = np.abs(moved - place).max(initial=0.0) < MIN_STEP_PX
        place = moved
        if arrived:
            break
    return place[0], place[1]


def _plain_centres(
    image: npt.NDArray[Any], level: float, blobs: _Blobs, settings: CentroidSettings
) -> tuple[FloatArray, FloatArray]:
    """Places (n,), px: the centre of gravity of the square around the last place, until no square
    moves.

    A square without light, or whose centre of gravity lies outside it, leaves the blob's own.
    """
    start = np.stack([blobs.x_px, blobs.y_px])
    place = start
    middle = np.rint(start)
    for _ in range(settings.iterations):
        x_px, y_px = middle
        values, dx, dy = squares(image, level, x_px, y_px, settings.radius_px)
        total = values.sum(axis=(1, 2))
        sum_x = (values * dx).sum(axis=(1, 2))
        sum_y = (values * dy).sum(axis=(1, 2))
        sums = np.stack([sum_x, sum_y])
        step = np.divide(sums, total, out=np.zeros_like(sums), where=total > 0)
        moved = middle + step
        from_start_px = np.abs(moved - start)
        has_left = (from_start_px > settings.radius_px).any(axis=0)
        lost = (total <= 0) | has_left
        place = np.where(lost, start, moved)
        still = np.array_equal(np.rint(place), middle)
        middle = np.rint(place)
        if still:
            break
    return place[0], place[1]


@dataclass(frozen=True, slots=True)
class SCurve:
    """The bias, px, of a star's measured place within its pixel along one axis: arrays
    (S_CURVE_PHASES,), one period.
    """

    measured_px: FloatArray
    bias_px: FloatArray


@functools.lru_cache(maxsize=16)
def s_curves(settings: CentroidSettings) -> tuple[SCurve, SCurve]:
    """The S-curves along x and y of a noiseless Gaussian star of `psf_sigma_px`, by the centroider
    itself.

    Window and star are products of an x and a y part, so the curve of one axis does not depend on
    the other's place. Raises InputError where two places within a pixel are measured as one: the
    window is too narrow for that star.
    """
    if settings.psf_sigma_px is None:
        raise InputError(
            "centroids: an S-curve needs psf_sigma_px; write the star's sigma along x and y"
        )
    tile_px = 2 * settings.radius_px + 5
    middle_px = tile_px // 2
    true_px = np.linspace(-0.5, 0.5, S_CURVE_PHASES, endpoint=False)
    pixel = np.arange(tile_px) - middle_px - true_px[:, None]
    sigma_x, sigma_y = settings.psf_sigma_px
    share_x = ndtr((pixel + 0.5) / sigma_x) - ndtr((pixel - 0.5) / sigma_x)
    share_y = ndtr((pixel + 0.5) / sigma_y) - ndtr((pixel - 0.5) / sigma_y)
    tiles = share_y[:, :, None] * share_x[:, None, :]
    strip = tiles.transpose(1, 0, 2).reshape(tile_px, -1)
    offset_px = tile_px * np.arange(S_CURVE_PHASES) + middle_px
    ones = np.ones(S_CURVE_PHASES)
    stars = _Blobs(offset_px + true_px, middle_px + true_px, ones, ones.astype(np.intp))
    x_px, y_px = _refine(strip, 0.0, stars, settings)
    measured_x = x_px - offset_px
    measured_y = y_px - middle_px
    curves = SCurve(measured_x, measured_x - true_px), SCurve(measured_y, measured_y - true_px)
    if any((np.diff(curve.measured_px) <= 0).any() for curve in curves):
        raise InputError(
            f"centroids: window_sigma_px = {settings.window_sigma_px:g} is too narrow for"
            f" psf_sigma_px = {settings.psf_sigma_px}; write 1 or more"
        )
    return curves
