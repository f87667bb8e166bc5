"""Where centroiders of several kinds find a star: in squares of pixels around it, one star to a
square.

`moment`: the plain first moment. `window`: the mean under a Gaussian that follows the star and is
as wide, a pixel at least (SExtractor's XWIN_IMAGE); `wide`: under one half as wide again. `fit`:
least squares of a Gaussian integrated over pixels. `psf`: least squares of any PSF that it is told.
`box3`, `box5`: the centre of mass of 3 x 3 or 5 x 5 pixels, of those over a fiftieth of the
brightest. What a display does to a star's light, each sees differently.
"""

from collections.abc import Callable
from functools import partial
from typing import Literal, get_args

import numpy as np

from hilstar.basics.arrays import FloatArray, IntArray

Kind = Literal["moment", "window", "wide", "fit", "box3", "box5"]
Centroider = Literal[Kind, "psf"]  # which is `fit` where a star is a Gaussian
FAMILY: tuple[Kind, ...] = get_args(Kind)
WIDE = 1.5  # in units of the star's sigma
MIN_WINDOW_PX = 1.0  # a narrower one sees the one pixel that it stands on
FIT_STEPS, WINDOW_STEPS = 8, 20  # at most: stars that have settled end them before
FIRST_STEPS = 3  # steps with a window before a fit
# A window as wide as the star moves the mean half of the way, one on a single pixel all of it: both
# come to rest by this.
PACE = 1.5
SETTLED_PX = 1e-6  # a step under it moves no star any more
MAX_STEP_PX = 0.3  # largest step of a fit: its model is nearly linear within that
BOX_SHARE = 0.02  # of its brightest pixel: darker ones do not count in a box
BOX_HALVES: dict[str, int] = {"box3": 1, "box5": 2}
MIN_LIGHT = 1e-30  # a square with less is dark
SLOPE_PX = 0.02  # to either side of a place, for a told PSF's slope


Pixels = tuple[IntArray, IntArray]  # rows and columns (n,)
Sigma = tuple[float, float]
Places = tuple[FloatArray, FloatArray]
# Shares (n, side, side) of stars at x and y (n,), px from the middles of their squares.
ToldPsf = Callable[[FloatArray, FloatArray], FloatArray]


def star_places(
    stamps: FloatArray,
    kind: Centroider,
    sigma_px: Sigma,
    pixels: Pixels | None = None,
    box_share: float = BOX_SHARE,
) -> Places:
    """Each star's x and y (n,), px from the middle of its square (n, side, side), side odd; 0 for a
    square without light.

    `sigma_px` (x, y) is the star's. A box is about one of `pixels`, at least two from the edge, by
    default the brightest: two images of a star between two pixels are to be compared in one box.
    The others begin there. Of a box those pixels count that have over `box_share` of its brightest.
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
    """Each star's x and y (n,), px from the middle of its square (n, side, side), by least squares
    of a PSF from `first` on.

    The place is that of the PSF's middle, the chief ray: with coma the star's light lies beside it.
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
        # where there is no light, no step
        divisor = np.where(flux > MIN_LIGHT, flux, np.inf)
        dx = np.clip(flux_dx / divisor, -MAX_STEP_PX, MAX_STEP_PX)
        dy = np.clip(flux_dy / divisor, -MAX_STEP_PX, MAX_STEP_PX)
        x = np.clip(x + dx, -half, half)
        y = np.clip(y + dy, -half, half)
        if not len(dx) or _are_settled(dx, dy):
            break
    return x, y


def _told_parts(told: ToldPsf, x: FloatArray, y: FloatArray) -> FloatArray:
    """Shares of a told PSF at places (n,), and their slopes along x and y: (n, 3, side, side)."""
    shares = told(x, y)
    by_x = (told(x + SLOPE_PX, y) - told(x - SLOPE_PX, y)) / (2 * SLOPE_PX)
    by_y = (told(x, y + SLOPE_PX) - told(x, y - SLOPE_PX)) / (2 * SLOPE_PX)
    return np.stack([shares, by_x, by_y], axis=1)


def _ridge(normal: FloatArray) -> FloatArray:
    """What is added to normal matrices (n, 3, 3), so that a star without light has a solution."""
    trace = np.trace(normal, axis1=1, axis2=2)
    weight = np.maximum(1e-12 * trace, MIN_LIGHT)
    return np.asarray(np.eye(3) * weight[:, None, None])


def _are_settled(dx_px: FloatArray, dy_px: FloatArray) -> bool:
    """Whether no star takes a step that matters any more."""
    largest_px = max(np.abs(dx_px).max(), np.abs(dy_px).max())
    return bool(largest_px < SETTLED_PX)


def brightest(stamps: FloatArray) -> Pixels:
    """The brightest pixel of each square, two or more from its edge."""
    side = stamps.shape[1]
    inner = stamps[:, 2 : side - 2, 2 : side - 2]
    place = inner.reshape(len(stamps), -1).argmax(axis=1)
    rows, columns = np.divmod(place, side - 4)
    return rows + 2, columns + 2


def _axis(stamps: FloatArray) -> FloatArray:
    """The places (side,), px from the middle, of the pixels of squares along a side."""
    side = stamps.shape[1]
    return np.asarray(np.arange(side) - side // 2, dtype=np.float64)


def _moment(stamps: FloatArray, sigma_px: Sigma, pixels: Pixels) -> Places:
    """See the module: places (n,) by the plain first moment."""
    at = _axis(stamps)
    light = stamps.sum(axis=(1, 2))
    x = stamps.sum(axis=1) @ at / light
    y = stamps.sum(axis=2) @ at / light
    # noise below 0 may leave little light
    return np.clip(x, at[0], at[-1]), np.clip(y, at[0], at[-1])


def _window(
    stamps: FloatArray,
    sigma_px: Sigma,
    pixels: Pixels,
    wide: float = 1.0,
    steps: int = WINDOW_STEPS,
) -> Places:
    """See the module: places (n,) by a Gaussian window, `wide` times as wide as the star, that
    follows it.
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
    """Sums of each square under products of `rows` (n, j, side) and `columns` (n, side, k): (n,
    j, k).
    """
    return np.asarray(rows @ (stamps @ columns))


def _fit(stamps: FloatArray, sigma_px: Sigma, pixels: Pixels) -> Places:
    """See the module: places (n,) by least squares of a Gaussian, after some steps of a window."""
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
    """Sums along a side of shares and their slopes (n, 2, side): shares squared, shares times
    slopes, and slopes squared.
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
    """What least squares adds to flux, x and y, (n, 3).

    `across` and `down` (n, 2, side) are a star's shares and their slopes in columns and rows,
    `sums` (n, 2, 2) those of the square under their products.
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
    """A star's shares in a row of pixels, and how they change with its place, (n, 2, side)."""
    from scipy.special import ndtr  # 0.1 s of every command that needs none of it

    edges_px = np.append(at - 0.5, at[-1] + 0.5)
    edges = (edges_px - place[:, None]) / sigma_px
    shares = np.diff(ndtr(edges))
    density = np.exp(-(edges**2) / 2)
    slopes = -np.diff(density) / (np.sqrt(2 * np.pi) * sigma_px)
    return np.stack([shares, slopes], axis=1)


def _box(stamps: FloatArray, half: int, pixels: Pixels, share: float = BOX_SHARE) -> Places:
    """See the module: places (n,) by the centre of mass of boxes that reach `half` pixels from
    `pixels`.
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
