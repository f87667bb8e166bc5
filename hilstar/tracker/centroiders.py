"""Where centroiders of several kinds find a star: in squares of pixels around it, one star to a square.

`moment`: the plain first moment. `window`: the mean under a Gaussian that follows the star (SExtractor's XWIN_IMAGE). `fit`:
least squares of a Gaussian integrated over pixels. `box3`, `box5`: the centre of mass of 3 x 3 or 5 x 5 pixels, of those over a
fiftieth of the brightest. What a display does to a star's light, each sees differently.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from scipy.special import ndtr

from hilstar.arrays import FloatArray, IntArray

Centroider = Literal["moment", "window", "fit", "box3", "box5"]
FIT_STEPS, WINDOW_STEPS = 6, 20
MAX_STEP_PX = 0.3  # of a fit: its model is nearly linear within that
BOX_SHARE = 0.02
MIN_LIGHT = 1e-30


Pixels = tuple[IntArray, IntArray]  # rows and columns (n,)


def star_places(
    stamps: FloatArray, kind: Centroider, sigma_px: tuple[float, float], pixels: Pixels | None = None
) -> tuple[FloatArray, FloatArray]:
    """Each star's x and y (n,), px from the middle of its square (n, side, side), side odd; 0 for a square without light.

    `sigma_px` (x, y) is the star's. A box is about one of `pixels`, at least two from the edge, by default the brightest: two
    images of a star between two pixels are to be compared in one box.
    """
    lit = np.flatnonzero(stamps.sum(axis=(1, 2)) > MIN_LIGHT)
    x, y = np.zeros(len(stamps)), np.zeros(len(stamps))
    if len(lit):
        rows, columns = brightest(stamps) if pixels is None else pixels
        x[lit], y[lit] = _KINDS[kind](stamps[lit], sigma_px, (rows[lit], columns[lit]))
    return x, y


def brightest(stamps: FloatArray) -> Pixels:
    """The brightest pixel of each square, two or more from its edge."""
    side = stamps.shape[1]
    rows, columns = np.divmod(stamps[:, 2 : side - 2, 2 : side - 2].reshape(len(stamps), -1).argmax(axis=1), side - 4)
    return rows + 2, columns + 2


def _axis(stamps: FloatArray) -> FloatArray:
    side = stamps.shape[1]
    return np.asarray(np.arange(side) - side // 2, dtype=np.float64)


def _moment(stamps: FloatArray, sigma_px: tuple[float, float], pixels: Pixels) -> tuple[FloatArray, FloatArray]:
    at, light = _axis(stamps), stamps.sum(axis=(1, 2))
    return stamps.sum(axis=1) @ at / light, stamps.sum(axis=2) @ at / light


def _window(stamps: FloatArray, sigma_px: tuple[float, float], pixels: Pixels) -> tuple[FloatArray, FloatArray]:
    at = _axis(stamps)
    x, y = _box(stamps, 2, pixels)
    for _ in range(WINDOW_STEPS):
        across, down = (
            np.exp(-((at - place[:, None]) ** 2) / (2 * sigma**2)) for place, sigma in zip((x, y), sigma_px, strict=True)
        )
        seen = stamps * down[:, :, None] * across[:, None, :]
        light = np.maximum(seen.sum(axis=(1, 2)), MIN_LIGHT)
        # A window as wide as the star moves the mean half of the way.
        x, y = x + 2 * (seen.sum(axis=1) @ at / light - x), y + 2 * (seen.sum(axis=2) @ at / light - y)
        x, y = (np.clip(place, at[0], at[-1]) for place in (x, y))
    return x, y


def _fit(stamps: FloatArray, sigma_px: tuple[float, float], pixels: Pixels) -> tuple[FloatArray, FloatArray]:
    at, (x, y) = _axis(stamps), _window(stamps, sigma_px, pixels)
    flux = stamps.sum(axis=(1, 2))
    for _ in range(FIT_STEPS):
        (share_x, slope_x), (share_y, slope_y) = (
            _profile(at, place, sigma) for place, sigma in zip((x, y), sigma_px, strict=True)
        )
        parts = [share_y[:, :, None] * share_x[:, None, :]]
        parts += [
            flux[:, None, None] * share_y[:, :, None] * slope_x[:, None, :],
            flux[:, None, None] * slope_y[:, :, None] * share_x[:, None, :],
        ]
        slopes = np.stack(parts).reshape(3, len(stamps), -1)
        left = stamps.reshape(len(stamps), -1) - flux[:, None] * slopes[0]
        normal = np.einsum("knp,lnp->nkl", slopes, slopes)
        normal += np.eye(3) * np.maximum(1e-12 * np.trace(normal, axis1=1, axis2=2), MIN_LIGHT)[:, None, None]
        step = np.linalg.solve(normal, np.einsum("knp,np->nk", slopes, left)[..., None])[..., 0]
        flux = np.maximum(flux + step[:, 0], MIN_LIGHT)
        x, y = (place + np.clip(step[:, k], -MAX_STEP_PX, MAX_STEP_PX) for k, place in ((1, x), (2, y)))
        x, y = (np.clip(place, at[0], at[-1]) for place in (x, y))
    return x, y


def _profile(at: FloatArray, place: FloatArray, sigma_px: float) -> tuple[FloatArray, FloatArray]:
    """A star's shares in a row of pixels, and how they change with its place, (n, side)."""
    edges = (np.append(at - 0.5, at[-1] + 0.5) - place[:, None]) / sigma_px
    return np.diff(ndtr(edges)), -np.diff(np.exp(-(edges**2) / 2)) / (np.sqrt(2 * np.pi) * sigma_px)


def _box(stamps: FloatArray, half: int, pixels: Pixels) -> tuple[FloatArray, FloatArray]:
    rows, columns = pixels
    side = stamps.shape[1]
    near = np.arange(-half, half + 1)
    y, x = rows[:, None, None] + near[:, None], columns[:, None, None] + near
    box = stamps[np.arange(len(stamps))[:, None, None], y, x]
    box = np.where(box > BOX_SHARE * box.max(axis=(1, 2), keepdims=True), box, 0.0)
    light = np.maximum(box.sum(axis=(1, 2)), MIN_LIGHT)
    return (box * (x - side // 2)).sum(axis=(1, 2)) / light, (box * (y - side // 2)).sum(axis=(1, 2)) / light


def _box_of_3(stamps: FloatArray, sigma_px: tuple[float, float], pixels: Pixels) -> tuple[FloatArray, FloatArray]:
    return _box(stamps, 1, pixels)


def _box_of_5(stamps: FloatArray, sigma_px: tuple[float, float], pixels: Pixels) -> tuple[FloatArray, FloatArray]:
    return _box(stamps, 2, pixels)


_KINDS = {"moment": _moment, "window": _window, "fit": _fit, "box3": _box_of_3, "box5": _box_of_5}
