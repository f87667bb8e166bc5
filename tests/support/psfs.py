"""Point spread functions in closed form, their samples, and their light in pixels by brute
force.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.special import j1

# light a px^2 at x, y in px from the chief ray
Profile = Callable[[np.ndarray, np.ndarray], np.ndarray]


def gaussian(sigma_x: float, sigma_y: float, x0: float = 0.0, y0: float = 0.0) -> Profile:
    """A Gaussian about a place, px."""
    scale = 2 * np.pi * sigma_x * sigma_y
    return lambda x, y: np.exp(-(((x - x0) / sigma_x) ** 2 + ((y - y0) / sigma_y) ** 2) / 2) / scale


def coma(sigma: float = 0.45) -> Profile:
    """A core of 60 % at the chief ray and a tail to the right and down, in two Gaussians."""
    core, near = (
        gaussian(sigma, sigma),
        gaussian(1.5 * sigma, 1.2 * sigma, 1.2 * sigma, 0.5 * sigma),
    )
    far = gaussian(2.4 * sigma, 1.8 * sigma, 3.0 * sigma, 1.3 * sigma)
    return lambda x, y: 0.6 * core(x, y) + 0.28 * near(x, y) + 0.12 * far(x, y)


def airy(lambda_f_px: float) -> Profile:
    """The diffraction of a round pupil; its first dark ring is at 1.22 `lambda_f_px`."""

    def light(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        v = np.maximum(np.pi * np.hypot(x, y) / lambda_f_px, 1e-9)
        return np.asarray((2 * j1(v) / v) ** 2 * np.pi / 4 / lambda_f_px**2)

    return light


def sampled(profile: Profile, per_px: int, half_px: int) -> np.ndarray:
    """Samples of a profile on a square of `half_px` to either side of the chief ray."""
    at = np.arange(-half_px * per_px, half_px * per_px + 1) / per_px
    return profile(at[None, :], at[:, None])


def in_pixels(profile: Profile, x_px: np.ndarray, y_px: np.ndarray, nodes: int = 12) -> np.ndarray:
    """The light in pixels centred at these columns and rows, by Gauss-Legendre quadrature in
    each of four quarters.
    """
    place, weight = np.polynomial.legendre.leggauss(nodes)
    place, weight = np.concatenate([(place - 1) / 4, (place + 1) / 4]), np.tile(weight / 4, 2)
    x, y = (
        x_px[None, :, None, None] + place[None, None, None, :],
        y_px[:, None, None, None] + place[None, None, :, None],
    )
    return np.einsum("a,b,ijab->ij", weight, weight, profile(x, y))
