"""The background of a photograph, smooth over the field, and the noise about it; sources above
both.

With several photographs also the detector's fixed pattern: what pixels, columns and rows have in
common in different parts of the sky.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from hilstar.basics.arrays import BoolArray, FloatArray
from hilstar.basics.units import MAD_TO_SIGMA

PATTERN_CLIP = 4.0  # sigmas beyond which a pixel of one photograph does not count
FOUND_SIGMAS = 4.0


KINDS = ("response", "offsets_dn", "columns_dn", "rows_dn")
NAMES = ("response of pixels", "offsets of pixels", "of columns", "of rows")
EIGHT_NEIGHBOURS = np.ones((3, 3), dtype=np.int8)
MIN_BLOCKS = 12  # along the shorter side; a block is 64 px or less
BLOCK_PX = 64
MIN_BLOCK_PX = 16
CLIP = 2.5  # sigmas beyond which a pixel of a block is a star's
CLIPPED = 0.9543  # sigma of a normal distribution cut at 2.5 sigma
ROUNDS = 4
BRIGHT_BLOCK, NOISY_BLOCK = 0.5, 1.2  # sigmas over its neighbours' median, and times their noise
MIN_RING_PX = 100
KERNEL_PX = 1.0  # sigma of the Gaussian by which sources are looked for
THRESHOLD = 5.0
MIN_TRAIL_PX, MIN_TRAIL_RATIO = 18.0, 5.0
MAX_SOURCES = 20_000
MAX_MASK_PX = 80  # half of what is left out about a long source


@dataclass(frozen=True, slots=True)
class FixedPattern:
    """One sigma of the pixels' response, as a share of the light, and of offsets of pixels, of
    columns and of rows, DN.

    `squares` has the square of each, without what noise adds, and `errors` one sigma of these.
    """

    squares: tuple[float, ...] = (0.0,) * 4
    errors: tuple[float, ...] = (math.inf,) * 4

    @property
    def rms(self) -> tuple[float, ...]:
        """Response, pixels, columns, rows; 0 where it is within FOUND_SIGMAS of its error."""
        return tuple(
            math.sqrt(s) if s > FOUND_SIGMAS * e else 0.0
            for s, e in zip(self.squares, self.errors, strict=True)
        )

    def variance_dn2(self, light_dn: FloatArray) -> FloatArray:
        """Variance of a pixel about its neighbours at a level of light."""
        response, *offsets = self.rms
        return np.asarray((response * light_dn) ** 2 + math.fsum(offset**2 for offset in offsets))

    def words(self) -> str:
        """What was found, or under what it is (two sigmas)."""
        parts = []
        for name, square, error, rms in zip(
            NAMES, self.squares, self.errors, self.rms, strict=True
        ):
            if not math.isfinite(error):
                continue
            times, unit = (100, "%") if name == NAMES[0] else (1, "DN")
            if rms:
                found = f"{times * rms:.3g} +- {times * error / (2 * rms):.2g}"
            else:
                found = ""
            parts.append(
                f"{name} {found or f'under {times * math.sqrt(max(square, 0.0) + 2 * error):.2g}'}"
                f" {unit}"
            )
        return ", ".join(parts)


NO_PATTERN = FixedPattern()


def fixed_pattern(
    photographs: Iterable[tuple[FloatArray, FloatArray, BoolArray]],
) -> FixedPattern | None:
    """The pattern by products of each two of several photographs, whose noise has mean 0; None with
    fewer than two.

    Each gives its pixels less their smooth level, that level above the pedestal, DN, and which
    pixels count (height, width). Response and offsets are told apart by levels that differ; all is
    response where they do not.
    """
    pixels, shares, columns, rows, light, inverse = (_Pairs() for _ in range(6))
    for off, level, use in photographs:
        use = (
            use
            & (np.abs(off) < PATTERN_CLIP * math.sqrt(float((off[use] ** 2).mean())))
            & (level > 0)
        )
        off = np.where(use, off - off[use].mean(), 0.0)
        level = np.where(use, level, 1.0)
        for axis, sums in ((0, columns), (1, rows)):
            count = use.sum(axis=axis)
            sums.add(off.sum(axis=axis) / np.maximum(count, 1), count > use.shape[axis] / 4)
        # neighbours' differences: what is smooth is the sky's or the lens's
        off = (off[:, 1:] - off[:, :-1]) / math.sqrt(2)
        use = use[:, 1:] & use[:, :-1]
        level = (level[:, 1:] + level[:, :-1]) / 2
        for sums, values in (
            (pixels, off),
            (shares, off / level),
            (light, level),
            (inverse, 1 / level),
        ):
            sums.add(values, use)
    if pixels.photographs < 2 or not pixels.pairs:
        return None
    (column, column_error), (row, row_error), (both, both_error), (share, share_error) = (
        component.mean() for component in (columns, rows, pixels, shares)
    )
    height = use.shape[0]
    width = use.shape[1] + 1
    (column, column_error), (row, row_error) = _lines_alone(
        (column, column_error), (row, row_error), both, (height, width)
    )
    lit = light.mean()[0]
    dim = inverse.mean()[0]
    both = both - max(column, 0.0)
    share = share - max(column, 0.0) * dim
    # both = response^2 lit + offsets^2, share = response^2 + offsets^2 dim
    apart = lit * dim - 1
    response = (both * dim - share) / apart
    offset = (share * lit - both) / apart
    response_error = math.hypot(both_error * dim, share_error) / apart
    offset_error = math.hypot(share_error * lit, both_error) / apart
    if offset < FOUND_SIGMAS * offset_error:
        response = both / lit
        response_error = both_error / lit
    return FixedPattern(
        (response, offset, column, row), (response_error, offset_error, column_error, row_error)
    )


def _lines_alone(
    column: tuple[float, float], row: tuple[float, float], both: float, size: tuple[int, int]
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Squares of columns and rows, with their errors, without the share that pixels' own patterns
    leave in their means.

    `both` is the square of pixels and columns together, `size` (height, width).
    """
    height, width = size
    of_columns = (column[0] - both / height) / (1 - 1 / height)
    pixel = max(both - of_columns, 0.0)
    of_rows = row[0] - pixel / width
    column_error = math.hypot(column[1], math.sqrt(2 / width) * pixel / height)
    row_error = math.hypot(row[1], math.sqrt(2 / height) * pixel / width)
    return (of_columns, column_error), (of_rows, row_error)


class _Pairs:
    """The mean product of each two of several arrays, by their sums."""

    def __init__(self) -> None:
        self.photographs = 0
        self._sum = self._squares = self._count = np.zeros(1)

    def add(self, values: FloatArray, use: BoolArray) -> None:
        self.photographs += 1
        values = np.where(use, values, 0.0)
        self._sum, self._squares, self._count = (
            self._sum + values,
            self._squares + values**2,
            self._count + use,
        )

    @property
    def pairs(self) -> float:
        return float((self._count * (self._count - 1) / 2).sum())

    def mean(self) -> tuple[float, float]:
        product = float((self._sum**2 - self._squares).sum()) / 2 / max(self.pairs, 1.0)
        variance = float(self._squares.sum()) / max(float(self._count.sum()), 1.0)
        return product, variance / math.sqrt(max(self.pairs, 1.0))


@dataclass(frozen=True, slots=True)
class SkyLevel:
    """Level and noise (height, width) of a photograph between its stars, DN, and whether a pixel
    is a star's.
    """

    level: FloatArray
    noise: FloatArray
    block_px: int

    def above(self, dn: FloatArray) -> FloatArray:
        """A photograph above its background, in sigmas."""
        return np.asarray((dn - self.level) / self.noise)


def sky_level(dn: FloatArray, step: float) -> SkyLevel:
    """The background of an image (height, width) in steps of `step`: means of blocks without
    their stars, smooth between.
    """
    height, width = dn.shape
    side = int(np.clip(min(height, width) // MIN_BLOCKS, MIN_BLOCK_PX, BLOCK_PX))
    rows = max(height // side, 1)
    columns = max(width // side, 1)
    high = height // rows
    wide = width // columns
    blocks = (
        dn[: rows * high, : columns * wide]
        .reshape(rows, high, columns, wide)
        .swapaxes(1, 2)
        .reshape(rows, columns, -1)
    )
    middle = np.median(blocks, axis=2, keepdims=True)
    sigma = MAD_TO_SIGMA * np.median(np.abs(blocks - middle), axis=2, keepdims=True) + step / 2
    for _ in range(ROUNDS):
        is_sky = np.abs(blocks - middle) <= CLIP * sigma
        count = np.maximum(is_sky.sum(axis=2, keepdims=True), 1)
        middle = (blocks * is_sky).sum(axis=2, keepdims=True) / count
        sigma = (
            np.sqrt(((blocks - middle) ** 2 * is_sky).sum(axis=2, keepdims=True) / count) / CLIPPED
        )
        sigma = np.maximum(sigma, step / 12**0.5)
    level = middle[..., 0]
    noise = sigma[..., 0]
    if min(level.shape) > 2:  # a block full of a bright star's light is as its neighbours
        others, quiet = (ndimage.median_filter(part, 3, mode="nearest") for part in (level, noise))
        bright = level > others + BRIGHT_BLOCK * quiet
        level = np.where(bright, others, level)
        noise = np.minimum(noise, NOISY_BLOCK * quiet)
    places = []
    for size, size_px in ((height, high), (width, wide)):
        places.append((np.arange(size) - (size_px - 1) / 2) / size_px)
    return SkyLevel(
        _between(level, *places), np.maximum(_between(noise, *places), step / 12**0.5), side
    )


def is_round(dn: FloatArray) -> bool:
    """Whether an image is that of an all-sky lens: sky in a circle, and nothing in corners
    beyond it, level to its edge.
    """
    height, width = dn.shape
    y, x = np.mgrid[:height, :width]
    radius = np.hypot(x - (width - 1) / 2, y - (height - 1) / 2) / (min(height, width) / 2)
    rings = [dn[(radius >= low) & (radius < low + 0.1)] for low in (0.2, 0.5, 0.8, 1.15, 1.25)]
    if min(map(len, rings)) < MIN_RING_PX:
        return False
    *sky, near, far = map(np.median, rings)
    noise = MAD_TO_SIGMA * float(np.median(np.abs(rings[-1] - far)))
    lit = min(sky[:2]) - far
    unsure = 4 * noise / len(rings[-1]) ** 0.5
    return bool(lit > max(0.3 * noise, 10 * unsure) and abs(near - far) < 0.05 * lit + unsure)


def _between(blocks: FloatArray, rows: FloatArray, columns: FloatArray) -> FloatArray:
    """Values of blocks at places, cubic between their middles and straight on beyond."""
    from scipy.interpolate import make_interp_spline

    for axis, at in ((0, rows), (1, columns)):
        count = blocks.shape[axis]
        if count == 1:
            blocks = np.repeat(blocks, len(at), axis=axis)
            continue
        spline = make_interp_spline(np.arange(count), blocks, k=min(3, count - 1), axis=axis)
        inner = np.clip(at, 0, count - 1)
        slope = spline.derivative()(inner)
        beyond = (at - inner).reshape((-1, 1) if axis == 0 else (1, -1))
        blocks = spline(inner) + slope * beyond
    return np.asarray(blocks)


@dataclass(frozen=True, slots=True)
class FoundSources:
    """Sources (n,) of a photograph, brightest first: places, px, signal over noise, and the length
    and width of each, px.

    Length and width are of all that stands out, `fwhm_px` is a circle's as large as what has half
    of the peak. `single` says that one pixel has all of the light: it is the detector's, or a
    cosmic ray.
    """

    x_px: FloatArray
    y_px: FloatArray
    snr: FloatArray
    length_px: FloatArray
    width_px: FloatArray
    fwhm_px: FloatArray
    single: BoolArray

    def __len__(self) -> int:
        return len(self.x_px)

    @property
    def trail(self) -> BoolArray:
        """Which are long and thin."""
        return (self.length_px > MIN_TRAIL_PX) & (self.length_px > MIN_TRAIL_RATIO * self.width_px)


def find_sources(sigmas: FloatArray) -> FoundSources:
    """Sources of an image in sigmas: connected pixels of it, smoothed, above THRESHOLD."""
    norm = float(np.sqrt((_kernel(sigmas.shape) ** 2).sum()))
    smooth = ndimage.gaussian_filter(sigmas, KERNEL_PX, mode="nearest", truncate=4.0) / norm
    above = smooth > THRESHOLD
    labels, count = ndimage.label(above, structure=EIGHT_NEIGHBOURS)
    y, x = np.nonzero(above)
    blob = labels[y, x] - 1
    value = smooth[y, x]
    total = np.maximum(np.bincount(blob, value, minlength=count), 1e-9)
    mx, my = (np.bincount(blob, value * part, minlength=count) / total for part in (x, y))
    area = np.maximum(np.bincount(blob, minlength=count), 1)
    dx = x - mx[blob]
    dy = y - my[blob]
    xx, yy, xy = (
        np.bincount(blob, part, minlength=count) / area + 1 / 12 * same
        for part, same in ((dx * dx, 1), (dy * dy, 1), (dx * dy, 0))
    )
    middle = (xx + yy) / 2
    spread = np.hypot((xx - yy) / 2, xy)
    length = np.sqrt(12 * (middle + spread))
    width = np.sqrt(12 * np.maximum(middle - spread, 1 / 12))
    peak = np.zeros(count)
    np.maximum.at(peak, blob, value)
    fwhm = 2 * np.sqrt(np.bincount(blob, value > peak[blob] / 2, minlength=count) / np.pi)
    order = np.argsort(-peak * np.sqrt(area), kind="stable")[:MAX_SOURCES]
    single = _single(sigmas, mx[order], my[order])
    return FoundSources(
        mx[order], my[order], peak[order], length[order], width[order], fwhm[order], single
    )


def source_mask(sources: FoundSources, sigmas: FloatArray, grow_px: int) -> BoolArray:
    """Pixels of an image (height, width) within some pixels of a source, or of an end of a long
    one.
    """
    height, width = sigmas.shape
    spots = sigmas > THRESHOLD
    rows = np.clip(np.rint(sources.y_px).astype(np.intp), 0, height - 1)
    columns = np.clip(np.rint(sources.x_px).astype(np.intp), 0, width - 1)
    spots[rows, columns] = True
    lit = np.asarray(ndimage.binary_dilation(spots, iterations=grow_px))
    for k in np.flatnonzero(sources.length_px > 2 * grow_px):
        half = min(round(float(sources.length_px[k]) / 2), MAX_MASK_PX) + grow_px
        lit[
            max(rows[k] - half, 0) : rows[k] + half + 1,
            max(columns[k] - half, 0) : columns[k] + half + 1,
        ] = True
    return lit


def _kernel(shape: tuple[int, ...]) -> FloatArray:
    spot = np.zeros((17, 17))
    spot[8, 8] = 1
    return np.asarray(ndimage.gaussian_filter(spot, KERNEL_PX, truncate=4.0))


def _single(sigmas: FloatArray, x_px: FloatArray, y_px: FloatArray) -> BoolArray:
    """Whether the highest pixel about a place has no light beside it: less than a star of 0.35
    px of sigma leaves there.
    """
    padded = np.pad(sigmas, 3)
    reach = np.arange(-1, 2)
    rows, columns = (np.rint(place).astype(np.intp)[:, None] + reach + 3 for place in (y_px, x_px))
    patch = padded[rows[:, :, None], columns[:, None, :]].reshape(len(x_px), 9)
    best = patch.argmax(axis=1)
    row = np.rint(y_px).astype(np.intp) + best // 3 + 2
    column = np.rint(x_px).astype(np.intp) + best % 3 + 2
    around = [padded[row + dy, column + dx] for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0))]
    return np.asarray(np.mean(around, axis=0) + 0.75 < 0.04 * padded[row, column])
