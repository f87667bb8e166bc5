"""How sharp the tracker sees the dots: one number, the sigma of its point spread function."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from hilstar.arrays import FloatArray
from hilstar.errors import InputError
from hilstar.tracker.centroids import CentroidSettings, find_stars, noisiest_background

THRESHOLD_SIGMA = 8.0
MIN_DOTS = 5
ROUNDS = 40
RADIUS_PX = 10
START_SIGMA_PX = 1.5
MIN_SIGMA_PX, MAX_SIGMA_PX = 0.25, 5.0
MODEL_SIGMAS_PX = np.geomspace(0.15, 6.0, 28)
MODEL_PHASES = 4  # places of a dot within a tracker pixel, along each axis
MODEL_POINTS = 9  # of a dot, along each axis


@dataclass(frozen=True, slots=True)
class Sharpness:
    """Dots as the tracker saw them: places (n,), the sigma of each (n,), px, that of the PSF (n,) with the dot's own width out.

    `psf_sigma_px` is the median of the last.
    """

    x_px: FloatArray
    y_px: FloatArray
    sigma_px: FloatArray
    each_psf_sigma_px: FloatArray
    psf_sigma_px: float


def sharpness(image: FloatArray, dot_side_px: float) -> Sharpness:
    """The sharpness of an image (h, w) of dots above its dark frame; a dot is a square of `dot_side_px` tracker px.

    Raises InputError where too few dots are there.
    """
    settings = CentroidSettings(threshold_sigma=THRESHOLD_SIGMA, minimum_pixels=2, window_sigma_px=1.5)
    found = find_stars(image, settings, noisiest_background(image))
    kept = ~found.at_edge
    x_px, y_px = found.x_px[kept], found.y_px[kept]
    if len(x_px) < MIN_DOTS:
        raise InputError(f"{len(x_px)} dots are in the image and {MIN_DOTS} are needed; expose longer, or look at the focus")
    level = float(np.median(image))
    sigma_px = _sigmas(np.pad(image - level, RADIUS_PX), x_px, y_px)
    expected = [_model_sigma(float(psf), dot_side_px) for psf in MODEL_SIGMAS_PX]
    each = np.interp(sigma_px, np.maximum.accumulate(expected), MODEL_SIGMAS_PX)
    return Sharpness(x_px, y_px, sigma_px, each, float(np.median(each)))


def _model_sigma(psf_sigma_px: float, dot_side_px: float) -> float:
    """The sigma that is measured of a square dot under a PSF of that sigma, integrated over pixels, at places within one."""
    side = 4 * RADIUS_PX + 1
    phase = (np.arange(MODEL_PHASES) + 0.5) / MODEL_PHASES - 0.5
    point = ((np.arange(MODEL_POINTS) + 0.5) / MODEL_POINTS - 0.5) * dot_side_px
    edge = np.arange(side + 1) - 2 * RADIUS_PX - 0.5 - phase[:, None, None] - point[:, None]
    profile = np.diff(ndtr(edge / psf_sigma_px), axis=2).mean(axis=1)  # (phases, side)
    tiles = profile[:, None, :, None] * profile[None, :, None, :]
    strip = tiles.reshape(-1, side, side).transpose(1, 0, 2).reshape(side, -1)
    down, right = (part.ravel() for part in np.meshgrid(phase, phase, indexing="ij"))
    x_px = np.arange(MODEL_PHASES**2) * side + 2 * RADIUS_PX + right
    return float(np.median(_sigmas(np.pad(strip, RADIUS_PX), x_px, 2 * RADIUS_PX + down)))


def _sigmas(padded: FloatArray, x_px: FloatArray, y_px: FloatArray) -> FloatArray:
    """The sigma (n,) of each spot by its second moment under a Gaussian window of that same sigma, found by repetition.

    Under a window of its own width a Gaussian's moment is half of its variance (Bernstein and Jarvis 2002, section 3).
    """
    reach = np.arange(-RADIUS_PX, RADIUS_PX + 1)
    column, row = (np.rint(place).astype(np.intp)[:, None] + reach for place in (x_px, y_px))
    values = padded[row[:, :, None] + RADIUS_PX, column[:, None, :] + RADIUS_PX]
    r2 = (column - x_px[:, None])[:, None, :] ** 2 + (row - y_px[:, None])[:, :, None] ** 2
    variance = np.full(len(x_px), START_SIGMA_PX**2)
    for _ in range(ROUNDS):
        weighted = values * np.exp(-0.5 * r2 / variance[:, None, None])
        total = np.maximum(weighted.sum(axis=(1, 2)), 1e-9)
        # Half of the sum over both axes is the moment of one, and that half of the variance.
        found = (weighted * r2).sum(axis=(1, 2)) / total
        variance = np.clip(found, MIN_SIGMA_PX**2, MAX_SIGMA_PX**2)
    return np.asarray(np.sqrt(variance))
