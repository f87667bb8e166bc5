"""Centroiders of several kinds: each computes a star's place in a square of pixels around it, one
star to a square. A display's artefacts shift the result of each kind differently.

- `moment`: the plain first moment.
- `window`: the mean under a Gaussian window that follows the star and is as wide as the star, but
  at least a pixel (SExtractor's XWIN_IMAGE).
- `wide`: the same with a window one and a half times as wide.
- `fit`: least squares of a Gaussian integrated over pixels.
- `psf`: least squares of any PSF that is given.
- `box3`, `box5`: the centre of mass of those of 3 x 3 or 5 x 5 pixels that have more than a
  fiftieth of the brightest pixel's light.
"""

from collections.abc import Callable
from functools import partial
from typing import Literal, get_args

import numpy as np

from hilstar.basics.arrays import FloatArray, IntArray

Kind = Literal["moment", "window", "wide", "fit", "box3", "box5"]
Centroider = Literal[Kind, "psf"]  # without a given PSF, "psf" is "fit": the star is a Gaussian
FAMILY: tuple[Kind, ...] = get_args(Kind)
WIDE = 1.5  # sigma of the wide window, in units of the star's sigma
MIN_WINDOW_PX = 1.0  # a narrower window sees only the one pixel that it stands on
FIT_STEPS, WINDOW_STEPS = 8, 20  # at most: they end before once no star moves any more
FIRST_STEPS = 3  # steps with a window before a fit
# A step with a window as wide as the star moves the mean half of the way to the star, one with all
# light in a single pixel the whole way. Steps lengthened by this factor converge for both.
PACE = 1.5
SETTLED_PX = 1e-6  # a shorter step does not matter any more
MAX_STEP_PX = 0.3  # largest step of a fit: its model is nearly linear within that
BOX_SHARE = 0.02  # pixels with less than this share of the box's brightest do not count
BOX_HALVES: dict[str, int] = {"box3": 1, "box5": 2}  # pixels from the middle of a box to its edge
MIN_LIGHT = 1e-30  # a square with less light is dark
SLOPE_PX = 0.02  # the slope of a given PSF is the difference over so much to either side


Pixels = tuple[IntArray, IntArray]  # rows and columns (n,)
Sigma = tuple[float, float]  # along x and y, px
Places = tuple[FloatArray, FloatArray]  # x and y (n,), px from the middles of the stars' squares
# A PSF: from x and y (n,), px from the middles of squares, the shares (n, side, side) of a star's
# light in each pixel of its square.
ToldPsf = Callable[[FloatArray, FloatArray], FloatArray]


def star_places(
    stamps: FloatArray,
    kind: Centroider,
    sigma_px: Sigma,
    pixels: Pixels | None = None,
    box_share: float = BOX_SHARE,
) -> Places:
    """The x and y (n,) of stars, px from the middles of their squares `stamps` (n, side, side),
    side odd; 0 for a square without light.

    `sigma_px` (x, y) is the sigma of a star. `pixels`, at least two from the edge, are the middles
    of boxes, and where the iterating kinds begin; by default they are the brightest pixels. Give
    them to compare two images of a star that lies between two pixels: both need the same box. In a
    box only pixels with more than `box_share` of its brightest pixel count.
    """
    x = np.zeros(len(stamps))
    y = np.zeros(len(stamps))
    lit = np.flatnonzero(stamps.sum(axis=(1, 2)) > MIN_LIGHT)
    if not len(lit):
        return x, y
    if pixels is None:
        pixels = brightest(stamps)
    rows, columns = pixels
    near = (rows[lit], columns[lit])
    if kind == "psf":
        kind = "fit"
    if kind in BOX_HALVES:
        lit_x, lit_y = _box(stamps[lit], BOX_HALVES[kind], near, box_share)
    else:
        places_of = _KINDS[kind]
        lit_x, lit_y = places_of(stamps[lit], sigma_px, near)
    x[lit] = lit_x
    y[lit] = lit_y
    return x, y


def psf_places(stamps: FloatArray, told: ToldPsf, first: Places) -> Places:
    """The x and y (n,) of stars, px from the middles of their squares `stamps` (n, side, side), by
    least squares of the PSF `told`, beginning at the places `first`.

    A place is that of the PSF's middle, the chief ray; with coma most of the star's light lies to
    one side of it.
    """
    half = stamps.shape[1] // 2
    first_x, first_y = first
    x = np.clip(first_x, -half, half)
    y = np.clip(first_y, -half, half)
    pixels = stamps.reshape(len(stamps), -1, 1)
    for _ in range(FIT_STEPS):
        parts = _told_parts(told, x, y).reshape(len(stamps), 3, -1)
        normal = parts @ parts.transpose(0, 2, 1)
        right_side = parts @ pixels
        solution = np.linalg.solve(normal + _ridge(normal), right_side)
        flux, flux_dx, flux_dy = solution[..., 0].T
        # a star without light takes no step: its derivatives divided by infinity are 0
        divisor = np.where(flux > MIN_LIGHT, flux, np.inf)
        dx = np.clip(flux_dx / divisor, -MAX_STEP_PX, MAX_STEP_PX)
        dy = np.clip(flux_dy / divisor, -MAX_STEP_PX, MAX_STEP_PX)
        x = np.clip(x + dx, -half, half)
        y = np.clip(y + dy, -half, half)
        if not len(dx) or _are_settled(dx, dy):
            break
    return x, y


def _told_parts(told: ToldPsf, x: FloatArray, y: FloatArray) -> FloatArray:
    """The pixels' shares of a star's light by the PSF `told` at places x and y (n,), px, and their
    derivatives by x and y, 1/px: (n, 3, side, side).
    """
    shares = told(x, y)
    by_x = (told(x + SLOPE_PX, y) - told(x - SLOPE_PX, y)) / (2 * SLOPE_PX)
    by_y = (told(x, y + SLOPE_PX) - told(x, y - SLOPE_PX)) / (2 * SLOPE_PX)
    return np.stack([shares, by_x, by_y], axis=1)


def _ridge(normal: FloatArray) -> FloatArray:
    """The diagonal matrices (n, 3, 3) to add to normal matrices (n, 3, 3), so that a star without
    light has a solution too.
    """
    trace = np.trace(normal, axis1=1, axis2=2)
    weight = np.maximum(1e-12 * trace, MIN_LIGHT)
    return np.asarray(np.eye(3) * weight[:, None, None])


def _are_settled(dx_px: FloatArray, dy_px: FloatArray) -> bool:
    """Whether the largest of all stars' steps, dx and dy (n,), px, is below SETTLED_PX."""
    largest_px = max(np.abs(dx_px).max(), np.abs(dy_px).max())
    return bool(largest_px < SETTLED_PX)


def brightest(stamps: FloatArray) -> Pixels:
    """The row and column (n,) of the brightest pixel of each square (n, side, side), at least two
    pixels from the edge: a box of 5 x 5 about it lies within the square.
    """
    side = stamps.shape[1]
    inner = stamps[:, 2 : side - 2, 2 : side - 2]
    place = inner.reshape(len(stamps), -1).argmax(axis=1)
    rows, columns = np.divmod(place, side - 4)
    return rows + 2, columns + 2


def _axis(stamps: FloatArray) -> FloatArray:
    """The places (side,) of a square's pixels along one axis, px from its middle."""
    side = stamps.shape[1]
    return np.asarray(np.arange(side) - side // 2, dtype=np.float64)


def _moment(stamps: FloatArray, sigma_px: Sigma, pixels: Pixels) -> Places:
    """Places by `moment`; see the module."""
    at = _axis(stamps)
    light = stamps.sum(axis=(1, 2))
    x = stamps.sum(axis=1) @ at / light
    y = stamps.sum(axis=2) @ at / light
    # Noise below 0 may make the sum of the light nearly 0, and the quotient far outside the square.
    return np.clip(x, at[0], at[-1]), np.clip(y, at[0], at[-1])


def _window(
    stamps: FloatArray,
    sigma_px: Sigma,
    pixels: Pixels,
    wide: float = 1.0,
    steps: int = WINDOW_STEPS,
) -> Places:
    """Places by `window`, or by `wide`: with a window `wide` times as wide as the star. See the
    module.
    """
    at = _axis(stamps)
    x, y = _box(stamps, 2, pixels)
    sigma_x = wide * max(sigma_px[0], MIN_WINDOW_PX)
    sigma_y = wide * max(sigma_px[1], MIN_WINDOW_PX)
    for _ in range(steps):
        across = np.exp(-np.square(at - x[:, None]) / (2 * sigma_x**2))
        down = np.exp(-np.square(at - y[:, None]) / (2 * sigma_y**2))
        rows = np.stack([down, at * down], axis=1)
        columns = np.stack([across, at * across], axis=2)
        sums = _sums(stamps, rows, columns)
        light = np.maximum(sums[:, 0, 0], MIN_LIGHT)
        mean_x = sums[:, 0, 1] / light
        mean_y = sums[:, 1, 0] / light
        dx = PACE * (mean_x - x)
        dy = PACE * (mean_y - y)
        x = np.clip(x + dx, at[0], at[-1])
        y = np.clip(y + dy, at[0], at[-1])
        if _are_settled(dx, dy):
            break
    return x, y


def _sums(stamps: FloatArray, rows: FloatArray, columns: FloatArray) -> FloatArray:
    """The sums (n, j, k) of each square (n, side, side), weighted by the products of each of its
    `rows` (n, j, side) with each of its `columns` (n, side, k).
    """
    return np.asarray((rows @ stamps) @ columns)  # a fifth less time than columns first


def _fit(stamps: FloatArray, sigma_px: Sigma, pixels: Pixels) -> Places:
    """Places by `fit`; see the module. It begins where FIRST_STEPS steps of a window end."""
    at = _axis(stamps)
    x, y = _window(stamps, sigma_px, pixels, steps=FIRST_STEPS)
    sigma_x, sigma_y = sigma_px
    flux = stamps.sum(axis=(1, 2))
    for _ in range(FIT_STEPS):
        across = _profile(at, x, sigma_x)
        down = _profile(at, y, sigma_y)
        sums = _sums(stamps, down, across.transpose(0, 2, 1))
        step = _fit_step(sums, across, down, flux)
        flux = np.maximum(flux + step[:, 0], MIN_LIGHT)
        dx = np.clip(step[:, 1], -MAX_STEP_PX, MAX_STEP_PX)
        dy = np.clip(step[:, 2], -MAX_STEP_PX, MAX_STEP_PX)
        x = np.clip(x + dx, at[0], at[-1])
        y = np.clip(y + dy, at[0], at[-1])
        if _are_settled(dx, dy):
            break
    return x, y


def _products(profile: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Three sums (n,) along a side of `profile` (n, 2, side), shares and their slopes: of shares
    squared, of shares times slopes, and of slopes squared.
    """
    share = profile[:, 0]
    slope = profile[:, 1]
    share_share = np.einsum("ns,ns->n", share, share)
    share_slope = np.einsum("ns,ns->n", share, slope)
    slope_slope = np.einsum("ns,ns->n", slope, slope)
    return share_share, share_slope, slope_slope


def _fit_step(
    sums: FloatArray, across: FloatArray, down: FloatArray, flux: FloatArray
) -> FloatArray:
    """The step (n, 3) in flux, x (px) and y (px) by least squares, linearised at the star's present
    place.

    `across` and `down` (n, 2, side) are a star's shares and their slopes (see `_profile`) along x
    and y; `sums` (n, 2, 2) are the square's sums weighted by their products, rows first; `flux`
    (n,) is the star's.
    """
    xx, xd, dd = _products(across)
    yy, yd, ee = _products(down)
    star_star = xx * yy
    star_by_x = flux * yy * xd
    star_by_y = flux * yd * xx
    squared = flux**2
    by_x_by_x = squared * yy * dd
    by_x_by_y = squared * yd * xd
    by_y_by_y = squared * ee * xx
    by_star = np.stack([star_star, star_by_x, star_by_y], axis=-1)
    by_x = np.stack([star_by_x, by_x_by_x, by_x_by_y], axis=-1)
    by_y = np.stack([star_by_y, by_x_by_y, by_y_by_y], axis=-1)
    normal = np.stack([by_star, by_x, by_y], axis=1)
    light_by_x = flux * sums[:, 0, 1]
    light_by_y = flux * sums[:, 1, 0]
    light = np.stack([sums[:, 0, 0], light_by_x, light_by_y], axis=-1)
    unexplained = light - flux[:, None] * by_star
    solution = np.linalg.solve(normal + _ridge(normal), unexplained[..., None])
    return np.asarray(solution[..., 0])


def _profile(at: FloatArray, place: FloatArray, sigma_px: float) -> FloatArray:
    """The shares of a Gaussian star at `place` (n,), px, in the pixels at `at` (side,), px, along
    one axis, and their derivatives by its place, 1/px: (n, 2, side).
    """
    # The import takes 0.1 s, which commands without a fit save.
    from scipy.special import ndtr

    edges_px = np.append(at - 0.5, at[-1] + 0.5)
    edges = (edges_px - place[:, None]) / sigma_px
    shares = np.diff(ndtr(edges))
    density = np.exp(-(edges**2) / 2)
    slopes = -np.diff(density) / (np.sqrt(2 * np.pi) * sigma_px)
    return np.stack([shares, slopes], axis=1)


def _box(stamps: FloatArray, half: int, pixels: Pixels, share: float = BOX_SHARE) -> Places:
    """Places by `box3` (`half` 1) or `box5` (2): the centre of mass in boxes that reach `half`
    pixels to each side of `pixels`. See the module.
    """
    rows, columns = pixels
    side = stamps.shape[1]
    near = np.arange(-half, half + 1)
    y = rows[:, None, None] + near[:, None]
    x = columns[:, None, None] + near
    star = np.arange(len(stamps))
    box = stamps[star[:, None, None], y, x]
    is_bright = box > share * box.max(axis=(1, 2), keepdims=True)
    box = np.where(is_bright, box, 0.0)
    light = np.maximum(box.sum(axis=(1, 2)), MIN_LIGHT)
    middle = side // 2
    moment_x = (box * (x - middle)).sum(axis=(1, 2))
    moment_y = (box * (y - middle)).sum(axis=(1, 2))
    return moment_x / light, moment_y / light


_KINDS: dict[Kind, Callable[[FloatArray, Sigma, Pixels], Places]] = {
    "moment": _moment,
    "window": _window,
    "wide": partial(_window, wide=WIDE),
    "fit": _fit,
}
