"""Centroiders as trackers have them, on images of single stars: each (n, side, side), the star near
the middle.

Each gives x and y (n,) px from the middle; they share no code with hilstar.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.special import ndtr

BLUR_PX = 0.62  # of a tracker's optics, on the monitor


def blurred(stars, sigma_px=BLUR_PX):
    return gaussian_filter1d(
        gaussian_filter1d(stars, sigma_px, axis=1, truncate=6), sigma_px, axis=2, truncate=6
    )


def axis(stars):
    return np.arange(stars.shape[1]) - stars.shape[1] // 2


def moment(stars):
    """The plain first moment over the whole image."""
    at, light = axis(stars), stars.sum((1, 2))
    return (stars.sum(1) @ at) / light, (stars.sum(2) @ at) / light


def windowed(stars, sigma_px):
    """The mean under a Gaussian that follows the star (SExtractor's XWIN)."""
    at = axis(stars)
    x, y = moment(stars)
    for _ in range(20):
        wx, wy = (np.exp(-((at - place[:, None]) ** 2) / (2 * sigma_px**2)) for place in (x, y))
        seen = stars * wy[:, :, None] * wx[:, None, :]
        light = seen.sum((1, 2))
        x = x + 2 * ((seen.sum(1) @ at) / light - x)
        y = y + 2 * ((seen.sum(2) @ at) / light - y)
    return x, y


def fitted(stars, sigma_px):
    """Least squares of a Gaussian integrated over pixels: x, y and flux."""
    at = axis(stars)
    x, y = windowed(stars, 1.2)
    flux = stars.sum((1, 2))
    for _ in range(6):
        (share_x, slope_x), (share_y, slope_y) = (_profile(at, place, sigma_px) for place in (x, y))
        model = share_y[:, :, None] * share_x[:, None, :]
        slopes = flux[:, None, None] * np.stack(
            [
                model / flux[:, None, None],
                share_y[:, :, None] * slope_x[:, None, :],
                slope_y[:, :, None] * share_x[:, None, :],
            ]
        )
        slopes = slopes.reshape(3, len(stars), -1)
        left = (stars - flux[:, None, None] * model).reshape(len(stars), -1)
        step = np.linalg.solve(
            np.einsum("knp,lnp->nkl", slopes, slopes),
            np.einsum("knp,np->nk", slopes, left)[..., None],
        )[..., 0]
        flux, x, y = (
            flux + step[:, 0],
            x + np.clip(step[:, 1], -0.3, 0.3),
            y + np.clip(step[:, 2], -0.3, 0.3),
        )
    return x, y, flux


def _profile(at, place, sigma_px):
    edges = (np.append(at - 0.5, at[-1] + 0.5) - place[:, None]) / sigma_px
    return np.diff(ndtr(edges)), -np.diff(np.exp(-(edges**2) / 2)) / np.sqrt(2 * np.pi) / sigma_px


def box_mean(stars, half, about):
    """The centre of mass in a box about the brightest pixel of `about`, of pixels over a
    fiftieth of the peak.
    """
    at = axis(stars)
    peak = about.reshape(len(about), -1).argmax(1)
    rows, columns = peak // len(at), peak % len(at)
    near = np.arange(-half, half + 1)
    y, x = rows[:, None, None] + near[:, None], columns[:, None, None] + near
    box = stars[np.arange(len(stars))[:, None, None], y, x]
    box = np.where(box > 0.02 * stars.max((1, 2))[:, None, None], box, 0)
    light = box.sum((1, 2))
    return (box * at[x]).sum((1, 2)) / light, (box * at[y]).sum((1, 2)) / light


def family_errors_px(shown, wanted, sigma_px):
    """By how much each centroider places the stars of `shown` elsewhere than those of `wanted`,
    rms along an axis, px.
    """
    seen, sky = blurred(shown), blurred(wanted)
    wide = float(np.hypot(sigma_px, BLUR_PX))
    pairs = {
        "plain moment": (moment(shown), moment(wanted)),
        "window 1.0 px": (windowed(shown, 1.0), windowed(wanted, 1.0)),
        "window 1.6 px, blurred": (windowed(seen, 1.6), windowed(sky, 1.6)),
        "PSF fit": (fitted(shown, sigma_px)[:2], fitted(wanted, sigma_px)[:2]),
        "PSF fit, blurred": (fitted(seen, wide)[:2], fitted(sky, wide)[:2]),
        "3 x 3, blurred": (box_mean(seen, 1, sky), box_mean(sky, 1, sky)),
        "5 x 5, blurred": (box_mean(seen, 2, sky), box_mean(sky, 2, sky)),
    }
    return {
        name: float(np.sqrt(np.mean(np.square(np.subtract(*pair))))) for name, pair in pairs.items()
    }
