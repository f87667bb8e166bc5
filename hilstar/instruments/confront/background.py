"""The background of a photograph, smooth over the field, and the noise about it; sources above
both.

With several photographs also the detector's fixed pattern: what pixels, columns and rows have in
common in different parts of the sky.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from hilstar.basics.arrays import BoolArray, FloatArray
from hilstar.basics.units import MAD_TO_SIGMA

PATTERN_CLIP = 4.0  # sigmas beyond which a pixel of one photograph does not count
LEVELS = 16  # parts of an image by their light, each with a sigma of its own
SAME_LEVEL = 1e-9  # relative variance of light that rounding alone makes
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
# radii of rings, in half of the shorter side: three of sky, and two in the corners of the image
RINGS = (0.2, 0.5, 0.8, 1.15, 1.25)
RING_WIDTH = 0.1
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
        rms = []
        for square, error in zip(self.squares, self.errors, strict=True):
            is_known = square > FOUND_SIGMAS * error
            rms.append(math.sqrt(square) if is_known else 0.0)
        return tuple(rms)

    def variance_dn2(self, light_dn: FloatArray) -> FloatArray:
        """Variance of a pixel about its neighbours at a level of light."""
        response, *offsets = self.rms
        offset_variance = math.fsum(offset**2 for offset in offsets)
        return np.asarray((response * light_dn) ** 2 + offset_variance)

    def words(self) -> str:
        """What was found, or under what it is (two sigmas)."""
        parts = []
        for k, name in enumerate(NAMES):
            if not math.isfinite(self.errors[k]):
                continue
            if name == NAMES[0]:
                text = f"{self._figure(k, 100)} %"
            else:
                text = f"{self._figure(k, 1)} DN"
            parts.append(f"{name} {text}")
        return ", ".join(parts)

    def _figure(self, k: int, factor: float) -> str:
        """Component `k` times a factor, with its error, or its upper limit."""
        error = self.errors[k]
        rms = self.rms[k]
        if rms:
            return f"{factor * rms:.3g} +- {factor * error / (2 * rms):.2g}"
        limit = math.sqrt(max(self.squares[k], 0.0) + 2 * error)
        return f"under {factor * limit:.2g}"


@dataclass(frozen=True, slots=True)
class _Square:
    """The square of a component, one sigma of it by noise, for these elements, and one by the
    scatter of elements, for others of their kind.
    """

    value: float
    error: float
    scatter: float

    def less(self, pixels: "_Square", count: int) -> "_Square":
        """A line's square without the share that `count` pixels' own patterns leave in its mean."""
        return replace(self, value=self.value - pixels.value / count)


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
    for off, level, mask in photographs:
        is_lit = mask & (level > 0)
        if not is_lit.any():
            continue
        use = _quiet(off, level, is_lit)
        off = np.where(use, off - off[use].mean(), 0.0)
        level = np.where(use, level, 1.0)
        column_mean, is_column_known = _line_means(off, use, 0)
        columns.add(column_mean, is_column_known)
        rows.add(*_line_means(off, use, 1))
        # a column's offset is no pixel's
        off = off - column_mean
        use = use & is_column_known
        # neighbours' differences: what is smooth is the sky's or the lens's
        off = (off[:, 1:] - off[:, :-1]) / math.sqrt(2)
        use = use[:, 1:] & use[:, :-1]
        level = (level[:, 1:] + level[:, :-1]) / 2
        pixels.add(off, use)
        shares.add(off / level, use)
        light.add(level, use)
        inverse.add(1 / level, use)
    if pixels.photographs < 2 or not pixels.pairs:
        return None
    height = use.shape[0]
    width = use.shape[1] + 1
    both = pixels.mean()
    share = shares.mean()
    column = columns.mean().less(both, height)
    row = rows.mean().less(both, width)
    lit = light.mean().value
    dim = inverse.mean().value
    # both = response^2 lit + offsets^2, share = response^2 + offsets^2 dim; they weigh pixels
    # differently, and so scatter apart: products of neighbours' differences correlate by 1/4
    both_scatter = both.scatter * math.sqrt(1.5)
    share_scatter = share.scatter * math.sqrt(1.5)
    determinant = lit * dim - 1
    response = both.value / lit
    response_error = both.error / lit
    offset, offset_error = 0.0, math.inf
    if determinant > SAME_LEVEL:
        offset = (share.value * lit - both.value) / determinant
        offset_error = math.hypot(share_scatter * lit, both_scatter) / determinant
    if offset >= FOUND_SIGMAS * offset_error:
        response = (both.value * dim - share.value) / determinant
        response_error = math.hypot(both_scatter * dim, share_scatter) / determinant
    return FixedPattern(
        (response, offset, column.value, row.value),
        (response_error, offset_error, column.scatter, row.scatter),
    )


def _quiet(off: FloatArray, level: FloatArray, mask: BoolArray) -> BoolArray:
    """Pixels of a mask that are no further off than PATTERN_CLIP sigmas of those of their level.

    One sigma of the whole image would leave out what a bright part has of response.
    """
    edges = np.quantile(level[mask], np.linspace(0, 1, LEVELS + 1)[1:-1])
    part = np.searchsorted(edges, level[mask], side="right")
    count = np.maximum(np.bincount(part, minlength=LEVELS), 1)
    squares = np.bincount(part, off[mask] ** 2, minlength=LEVELS)
    sigma = np.sqrt(squares / count)
    use = mask.copy()
    use[mask] = np.abs(off[mask]) <= PATTERN_CLIP * sigma[part]
    return use


def _line_means(off: FloatArray, use: BoolArray, axis: int) -> tuple[FloatArray, BoolArray]:
    """Means along an axis of the pixels in use, and whether a line has enough of them."""
    count = use.sum(axis=axis)
    mean = off.sum(axis=axis) / np.maximum(count, 1)
    return mean, count > use.shape[axis] / 4


class _Pairs:
    """The mean product of each two of several arrays, by their sums."""

    def __init__(self) -> None:
        self.photographs = 0
        self._sum = self._squares = self._count = np.zeros(1)

    def add(self, values: FloatArray, use: BoolArray) -> None:
        self.photographs += 1
        used = np.where(use, values, 0.0)
        self._sum = self._sum + used
        self._squares = self._squares + used**2
        self._count = self._count + use

    @property
    def pairs(self) -> float:
        return float((self._count * (self._count - 1) / 2).sum())

    def mean(self) -> _Square:
        """The mean product."""
        pairs_of_each = self._count * (self._count - 1) / 2
        pairs = max(self.pairs, 1.0)
        products = (self._sum**2 - self._squares) / 2
        mean = float(products.sum()) / pairs
        variances = self._squares / np.maximum(self._count, 1)
        error = math.sqrt(float((pairs_of_each * variances**2).sum())) / pairs
        scatter = float(np.linalg.norm(products - mean * pairs_of_each)) / pairs
        return _Square(mean, error, scatter)


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
    whole_blocks = dn[: rows * high, : columns * wide].reshape(rows, high, columns, wide)
    blocks = whole_blocks.swapaxes(1, 2).reshape(rows, columns, -1)
    rounding = step / 12**0.5
    middle = np.median(blocks, axis=2, keepdims=True)
    deviation = np.median(np.abs(blocks - middle), axis=2, keepdims=True)
    # half a step more: the deviation of most pixels is 0 where the noise is under a step
    sigma = MAD_TO_SIGMA * deviation + step / 2
    for _ in range(ROUNDS):
        is_sky = np.abs(blocks - middle) <= CLIP * sigma
        count = np.maximum(is_sky.sum(axis=2, keepdims=True), 1)
        middle = (blocks * is_sky).sum(axis=2, keepdims=True) / count
        squares = ((blocks - middle) ** 2 * is_sky).sum(axis=2, keepdims=True)
        sigma = np.maximum(np.sqrt(squares / count) / CLIPPED, rounding)
    level = middle[..., 0]
    noise = sigma[..., 0]
    if min(level.shape) > 2:  # a block full of a bright star's light is as its neighbours
        others = ndimage.median_filter(level, 3, mode="nearest")
        quiet = ndimage.median_filter(noise, 3, mode="nearest")
        is_bright = level > others + BRIGHT_BLOCK * quiet
        level = np.where(is_bright, others, level)
        noise = np.minimum(noise, NOISY_BLOCK * quiet)
    row_places = (np.arange(height) - (high - 1) / 2) / high
    column_places = (np.arange(width) - (wide - 1) / 2) / wide
    smooth_level = _between(level, row_places, column_places)
    smooth_noise = _between(noise, row_places, column_places)
    return SkyLevel(smooth_level, np.maximum(smooth_noise, rounding), side)


def is_round(dn: FloatArray) -> bool:
    """Whether an image is that of an all-sky lens: sky in a circle, and nothing in corners
    beyond it, level to its edge.
    """
    height, width = dn.shape
    y, x = np.mgrid[:height, :width]
    distance_px = np.hypot(x - (width - 1) / 2, y - (height - 1) / 2)
    radius = distance_px / (min(height, width) / 2)
    rings = [dn[(radius >= low) & (radius < low + RING_WIDTH)] for low in RINGS]
    if min(map(len, rings)) < MIN_RING_PX:
        return False
    *sky, near, far = map(np.median, rings)
    noise = MAD_TO_SIGMA * float(np.median(np.abs(rings[-1] - far)))
    lit = min(sky[:2]) - far
    unsure = 4 * noise / len(rings[-1]) ** 0.5
    is_lit = lit > max(0.3 * noise, 10 * unsure)
    are_corners_level = abs(near - far) < 0.05 * lit + unsure
    return bool(is_lit and are_corners_level)


def _between(blocks: FloatArray, rows: FloatArray, columns: FloatArray) -> FloatArray:
    """Values of blocks at places, cubic between their middles and straight on beyond."""
    from scipy.interpolate import make_interp_spline

    for axis, places in ((0, rows), (1, columns)):
        count = blocks.shape[axis]
        if count == 1:
            blocks = np.repeat(blocks, len(places), axis=axis)
            continue
        spline = make_interp_spline(np.arange(count), blocks, k=min(3, count - 1), axis=axis)
        inner = np.clip(places, 0, count - 1)
        slope = spline.derivative()(inner)
        beyond = np.expand_dims(places - inner, 1 - axis)
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
    def places_px(self) -> FloatArray:
        """Places (n, 2), x and y."""
        return np.column_stack([self.x_px, self.y_px])

    @property
    def trail(self) -> BoolArray:
        """Which are long and thin."""
        is_thin = self.length_px > MIN_TRAIL_RATIO * self.width_px
        return is_thin & (self.length_px > MIN_TRAIL_PX)


def find_sources(sigmas: FloatArray) -> FoundSources:
    """Sources of an image in sigmas: connected pixels of it, smoothed, above THRESHOLD."""
    # noise of one sigma a pixel is one sigma in the smoothed image, too
    norm = float(np.sqrt((_kernel() ** 2).sum()))
    smooth = ndimage.gaussian_filter(sigmas, KERNEL_PX, mode="nearest", truncate=4.0) / norm
    is_above = smooth > THRESHOLD
    labels, count = ndimage.label(is_above, structure=EIGHT_NEIGHBOURS)
    y, x = np.nonzero(is_above)
    source = labels[y, x] - 1
    value = smooth[y, x]
    area = np.maximum(np.bincount(source, minlength=count), 1)
    total = np.maximum(np.bincount(source, value, minlength=count), 1e-9)
    x_px = np.bincount(source, value * x, minlength=count) / total
    y_px = np.bincount(source, value * y, minlength=count) / total
    dx = x - x_px[source]
    dy = y - y_px[source]
    # second moments of the pixels' area, each of them a square: 1/12 of its own along an axis
    xx = np.bincount(source, dx * dx, minlength=count) / area + 1 / 12
    yy = np.bincount(source, dy * dy, minlength=count) / area + 1 / 12
    xy = np.bincount(source, dx * dy, minlength=count) / area
    middle = (xx + yy) / 2
    spread = np.hypot((xx - yy) / 2, xy)
    # sides of the rectangle that has these moments
    length_px = np.sqrt(12 * (middle + spread))
    width_px = np.sqrt(12 * np.maximum(middle - spread, 1 / 12))
    peak = np.zeros(count)
    np.maximum.at(peak, source, value)
    half_area = np.bincount(source, value > peak[source] / 2, minlength=count)
    fwhm_px = 2 * np.sqrt(half_area / np.pi)
    order = np.argsort(-peak * np.sqrt(area), kind="stable")[:MAX_SOURCES]
    return FoundSources(
        x_px=x_px[order],
        y_px=y_px[order],
        snr=peak[order],
        length_px=length_px[order],
        width_px=width_px[order],
        fwhm_px=fwhm_px[order],
        single=_single(sigmas, x_px[order], y_px[order]),
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
        half_length_px = round(float(sources.length_px[k]) / 2)
        half_px = min(half_length_px, MAX_MASK_PX) + grow_px
        first_row = max(rows[k] - half_px, 0)
        first_column = max(columns[k] - half_px, 0)
        lit[first_row : rows[k] + half_px + 1, first_column : columns[k] + half_px + 1] = True
    return lit


def _kernel() -> FloatArray:
    """The Gaussian (17, 17) by which sources are looked for; sums to 1."""
    spot = np.zeros((17, 17))
    spot[8, 8] = 1
    return np.asarray(ndimage.gaussian_filter(spot, KERNEL_PX, truncate=4.0))


def _single(sigmas: FloatArray, x_px: FloatArray, y_px: FloatArray) -> BoolArray:
    """Whether the highest pixel about a place has no light beside it: less than a star of 0.35
    px of sigma leaves there.
    """
    margin = 3
    padded = np.pad(sigmas, margin)
    reach = np.arange(-1, 2) + margin
    middle_row = np.rint(y_px).astype(np.intp)
    middle_column = np.rint(x_px).astype(np.intp)
    rows = middle_row[:, None] + reach
    columns = middle_column[:, None] + reach
    patch = padded[rows[:, :, None], columns[:, None, :]].reshape(len(x_px), 9)
    highest = patch.argmax(axis=1)
    row = middle_row + highest // 3 + margin - 1
    column = middle_column + highest % 3 + margin - 1
    beside = []
    for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        beside.append(padded[row + dy, column + dx])
    # 0.75 is 1.5 sigmas of the noise of a mean of four
    highest_beside = np.mean(beside, axis=0) + 0.75
    return np.asarray(highest_beside < 0.04 * padded[row, column])
