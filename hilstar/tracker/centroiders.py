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
FIT_STEPS, WINDOW_STEPS = 8, 20
FIRST_STEPS = 3  # steps with a window before a fit
# A window as wide as the star moves the mean half of the way, one on a single pixel all of it: both
# come to rest by this.
PACE = 1.5
SETTLED_PX = 1e-6
MAX_STEP_PX = 0.3  # largest step of a fit: its model is nearly linear within that
BOX_SHARE = 0.02  # of its brightest pixel: darker ones do not count in a box
BOX_HALVES: dict[str, int] = {"box3": 1, "box5": 2}
MIN_LIGHT = 1e-30
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
    lit = np.flatnonzero(stamps.sum(axis=(1, 2)) > MIN_LIGHT)
    x = np.zeros(len(stamps))
    y = np.zeros(len(stamps))
    kind = "fit" if kind == "psf" else kind
    if len(lit):
        rows, columns = brightest(stamps) if pixels is None else pixels
        near = rows[lit], columns[lit]
        if kind in BOX_HALVES:
            x[lit], y[lit] = _box(stamps[lit], BOX_HALVES[kind], near, box_share)
        else:
            x[lit], y[lit] = _KINDS[kind](stamps[lit], sigma_px, near)
    return x, y


def psf_places(stamps: FloatArray, told: ToldPsf, first: Places) -> Places:
    """Each star's x and y (n,), px from the middle of its square (n, side, side), by least squares
    of a PSF from `first` on.

    The place is that of the PSF's middle, the chief ray: with coma the star's light lies beside it.
    """
    half = stamps.shape[1] // 2
    x, y = (np.clip(place, -half, half) for place in first)
    for _ in range(FIT_STEPS):
        shares = told(x, y)
        by_x = (told(x + SLOPE_PX, y) - told(x - SLOPE_PX, y)) / (2 * SLOPE_PX)
        by_y = (told(x, y + SLOPE_PX) - told(x, y - SLOPE_PX)) / (2 * SLOPE_PX)
        parts = np.stack([shares, by_x, by_y], axis=1).reshape(len(stamps), 3, -1)
        normal = parts @ parts.transpose(0, 2, 1)
        right_side = parts @ stamps.reshape(len(stamps), -1, 1)
        normal += (
            np.eye(3)
            * np.maximum(1e-12 * np.trace(normal, axis1=1, axis2=2), MIN_LIGHT)[:, None, None]
        )
        solution = np.linalg.solve(normal, right_side)[..., 0]  # flux, and flux times each step
        # where there is no light, no step
        flux = np.where(solution[:, 0] > MIN_LIGHT, solution[:, 0], np.inf)
        dx, dy = (np.clip(solution[:, k] / flux, -MAX_STEP_PX, MAX_STEP_PX) for k in (1, 2))
        x, y = (np.clip(place, -half, half) for place in (x + dx, y + dy))
        if not len(dx) or max(np.abs(dx).max(), np.abs(dy).max()) < SETTLED_PX:
            break
    return x, y


def brightest(stamps: FloatArray) -> Pixels:
    """The brightest pixel of each square, two or more from its edge."""
    side = stamps.shape[1]
    rows, columns = np.divmod(
        stamps[:, 2 : side - 2, 2 : side - 2].reshape(len(stamps), -1).argmax(axis=1), side - 4
    )
    return rows + 2, columns + 2


def _axis(stamps: FloatArray) -> FloatArray:
    side = stamps.shape[1]
    return np.asarray(np.arange(side) - side // 2, dtype=np.float64)


def _moment(stamps: FloatArray, sigma_px: Sigma, pixels: Pixels) -> Places:
    at = _axis(stamps)
    light = stamps.sum(axis=(1, 2))
    x, y = (
        np.clip(stamps.sum(axis=axis) @ at / light, at[0], at[-1]) for axis in (1, 2)
    )  # noise below 0 may leave little light
    return x, y


def _window(
    stamps: FloatArray,
    sigma_px: Sigma,
    pixels: Pixels,
    wide: float = 1.0,
    steps: int = WINDOW_STEPS,
) -> Places:
    at, (x, y) = _axis(stamps), _box(stamps, 2, pixels)
    sigmas = [wide * max(sigma, MIN_WINDOW_PX) for sigma in sigma_px]
    for _ in range(steps):
        across, down = (
            np.exp(-np.square(at - place[:, None]) / (2 * sigma**2))
            for place, sigma in zip((x, y), sigmas, strict=True)
        )
        sums = _sums(
            stamps, np.stack([down, at * down], axis=1), np.stack([across, at * across], axis=2)
        )
        light = np.maximum(sums[:, 0, 0], MIN_LIGHT)
        dx = PACE * (sums[:, 0, 1] / light - x)
        dy = PACE * (sums[:, 1, 0] / light - y)
        x, y = (np.clip(place, at[0], at[-1]) for place in (x + dx, y + dy))
        if max(np.abs(dx).max(), np.abs(dy).max()) < SETTLED_PX:
            break
    return x, y


def _sums(stamps: FloatArray, rows: FloatArray, columns: FloatArray) -> FloatArray:
    """Sums of each square under products of `rows` (n, j, side) and `columns` (n, side, k): (n,
    j, k).
    """
    return np.asarray(rows @ (stamps @ columns))


def _fit(stamps: FloatArray, sigma_px: Sigma, pixels: Pixels) -> Places:
    at, (x, y) = _axis(stamps), _window(stamps, sigma_px, pixels, steps=FIRST_STEPS)
    flux = stamps.sum(axis=(1, 2))
    for _ in range(FIT_STEPS):
        across, down = (
            np.stack(_profile(at, place, sigma), axis=1)
            for place, sigma in zip((x, y), sigma_px, strict=True)
        )
        step = _fit_step(_sums(stamps, down, across.transpose(0, 2, 1)), across, down, flux)
        flux = np.maximum(flux + step[:, 0], MIN_LIGHT)
        dx, dy = (np.clip(step[:, k], -MAX_STEP_PX, MAX_STEP_PX) for k in (1, 2))
        x, y = (np.clip(place, at[0], at[-1]) for place in (x + dx, y + dy))
        if max(np.abs(dx).max(), np.abs(dy).max()) < SETTLED_PX:
            break
    return x, y


def _products(profile: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Sums along a side of shares and their slopes (n, 2, side): shares squared, shares times
    slopes, and slopes squared.
    """
    share, slope = profile[:, 0], profile[:, 1]
    return (
        np.einsum("ns,ns->n", share, share),
        np.einsum("ns,ns->n", share, slope),
        np.einsum("ns,ns->n", slope, slope),
    )


def _fit_step(
    seen: FloatArray, across: FloatArray, down: FloatArray, flux: FloatArray
) -> FloatArray:
    """What least squares adds to flux, x and y, (n, 3).

    `across` and `down` (n, 2, side) are a star's shares and their slopes in columns and rows,
    `seen` (n, 2, 2) the square's sums under their products.
    """
    xx, xd, dd = _products(across)
    yy, yd, ee = _products(down)
    star_and_slopes = flux * yy * xd, flux * yd * xx  # the star with its slopes
    normal = np.stack(
        [
            xx * yy,
            *star_and_slopes,
            star_and_slopes[0],
            flux**2 * yy * dd,
            flux**2 * yd * xd,
            star_and_slopes[1],
            flux**2 * yd * xd,
            flux**2 * ee * xx,
        ],
        axis=-1,
    ).reshape(-1, 3, 3)
    unexplained = (
        np.stack([seen[:, 0, 0], flux * seen[:, 0, 1], flux * seen[:, 1, 0]], axis=-1)
        - flux[:, None] * normal[:, 0]
    )
    normal += (
        np.eye(3) * np.maximum(1e-12 * np.trace(normal, axis1=1, axis2=2), MIN_LIGHT)[:, None, None]
    )
    return np.asarray(np.linalg.solve(normal, unexplained[..., None])[..., 0])


def _profile(at: FloatArray, place: FloatArray, sigma_px: float) -> Places:
    """A star's shares in a row of pixels, and how they change with its place, (n, side)."""
    from scipy.special import ndtr  # 0.1 s of every command that needs none of it

    edges = (np.append(at - 0.5, at[-1] + 0.5) - place[:, None]) / sigma_px
    return np.diff(ndtr(edges)), -np.diff(np.exp(-(edges**2) / 2)) / (np.sqrt(2 * np.pi) * sigma_px)


def _box(stamps: FloatArray, half: int, pixels: Pixels, share: float = BOX_SHARE) -> Places:
    rows, columns = pixels
    side = stamps.shape[1]
    near = np.arange(-half, half + 1)
    y = rows[:, None, None] + near[:, None]
    x = columns[:, None, None] + near
    box = stamps[np.arange(len(stamps))[:, None, None], y, x]
    box = np.where(box > share * box.max(axis=(1, 2), keepdims=True), box, 0.0)
    light = np.maximum(box.sum(axis=(1, 2)), MIN_LIGHT)
    return (box * (x - side // 2)).sum(axis=(1, 2)) / light, (box * (y - side // 2)).sum(
        axis=(1, 2)
    ) / light


_KINDS: dict[Kind, Callable[[FloatArray, Sigma, Pixels], Places]] = {
    "moment": _moment,
    "window": _window,
    "wide": partial(_window, wide=WIDE),
    "fit": _fit,
}
