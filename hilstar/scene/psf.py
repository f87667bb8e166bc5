"""The Gaussian sprite of a star, integrated over pixels (thesis eq. 4.7): its footprint and its peak.

A pixel's share along one axis is (erf((d + 1/2)/(s sqrt 2)) - erf((d - 1/2)/(s sqrt 2)))/2, d from the star's centre
to the pixel's centre and s the sigma, both in pixels.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.errors import InputError

# The maximum share of a star's flux outside its footprint, at the worst sub-pixel phase. 1e-5 would be enough for the
# flux; but at sigma 3 px the centroid would then move by 1e-4 px, so a tenth of that is cut, at the cost of one pixel.
# results/tradeoff.csv, psf: 10 px at sigma 0.85 are on the front; 8 px save a tenth and cut 4e-5 mag.
MAX_CUT = 1e-6
SQRT2 = math.sqrt(2.0)
# Error of the polynomial in a pixel along one axis, relative to a star's flux. The float32 erf is 4.4e-7 off.
MAX_SHARE_ERROR = 1e-7
MIN_DEGREE, MAX_DEGREE = 3, 8  # beyond it a polynomial costs as much as erf
FIT_PLACES, FIT_ROUNDS = 120, 15
BOUND_PLACES = 200


def pixel_share(offset_px: float, sigma_px: float) -> float:
    """The share of a star's light, along one axis, in the pixel `offset_px` from its centre.

    The complement erfc of both edges keeps the far wings positive and exact where erf differences cancel.
    """
    near, far = abs(offset_px) - 0.5, abs(offset_px) + 0.5
    return 0.5 * (math.erfc(near / (sigma_px * SQRT2)) - math.erfc(far / (sigma_px * SQRT2)))


def pixel_shares(offset_px: FloatArray, sigma_px: float) -> FloatArray:
    """Shares of a star's light along one axis in pixels at `offset_px` from its centre; same shape."""
    from scipy.special import erfc  # 0.1 s of every command that needs none of it

    near, far = np.abs(offset_px) - 0.5, np.abs(offset_px) + 0.5
    return np.asarray(0.5 * (erfc(near / (sigma_px * SQRT2)) - erfc(far / (sigma_px * SQRT2))))


def peak_share(sigma_px: tuple[float, float]) -> float:
    """The largest share that one pixel can get: that of a star centred on it."""
    return pixel_share(0.0, sigma_px[0]) * pixel_share(0.0, sigma_px[1])


def cut_share(size_px: int, sigma_px: tuple[float, float]) -> float:
    """The flux outside a square footprint of `size_px`, for a star half a pixel off its centre (the worst)."""
    inside = 1.0
    for sigma in sigma_px:
        inside_axis = 1.0 - 0.5 * sum(math.erfc((size_px / 2 + side) / (sigma * SQRT2)) for side in (-0.5, 0.5))
        inside *= inside_axis
    return 1.0 - inside


def outside_share(size_px: int, sigma_px: tuple[float, float]) -> float:
    """The largest share of a star's light in one pixel outside a square sprite, at the worst phase."""
    (x, y), beyond = sigma_px, size_px / 2
    return max(pixel_share(beyond, x) * pixel_share(0.0, y), pixel_share(beyond, y) * pixel_share(0.0, x))


def footprint_px(sigma_px: tuple[float, float], largest_cut: float = MAX_CUT) -> int:
    """The side of the smallest square footprint that cuts at most `largest_cut` of a star's flux."""
    size = 1
    while cut_share(size, sigma_px) > largest_cut:
        size += 1
        if size > 100_000:
            raise InputError(f"sprite sigma {sigma_px} px: too large for any footprint; write a few pixels")
    return size


@lru_cache(maxsize=8)
def share_bound(sigma_px: tuple[float, float], size_px: int) -> tuple[tuple[float, float], float]:
    """How far a share of light may lie, (x, y) in px^2, and a factor: an ellipse of a pixel's distance from its star.

    Of the pixels of a footprint of `size_px` those with more than a share s of the light have x^2 / scale_x + y^2 / scale_y
    under log(factor / s). That is a Gaussian's ellipse with the factor that the integral over pixels needs.
    """
    scale = [2 * (sigma**2 + 1 / 12) for sigma in sigma_px]
    places = np.linspace(0.0, size_px / 2 + 0.5, BOUND_PLACES)
    shares = [np.maximum(pixel_shares(places, sigma), 1e-300) for sigma in sigma_px]
    more = [float((np.log(share) + places**2 / along).max()) for share, along in zip(shares, scale, strict=True)]
    return (scale[0], scale[1]), math.exp(sum(more))


@lru_cache(maxsize=8)
def share_polynomial(sigma_px: float, reach_px: float) -> tuple[float, ...] | None:
    """Coefficients, constant first, of log2 of a pixel's share as a polynomial of its distance squared (px^2).

    Within `reach_px` its power of two is within MAX_SHARE_ERROR of `pixel_share`: one power for both axes takes half the time
    of four error functions. None where no degree up to MAX_DEGREE is enough: under a sigma of 0.5 px.
    """
    distance_px = reach_px * np.sin(np.linspace(0.0, np.pi / 2, FIT_PLACES))  # close together at the edge, as Chebyshev's
    shares = np.array([pixel_share(float(place), sigma_px) for place in distance_px])
    wanted, scaled = np.log2(np.maximum(shares, shares[0] * 1e-12)), (distance_px / reach_px) ** 2
    for degree in range(MIN_DEGREE, MAX_DEGREE + 1):
        terms = np.polynomial.chebyshev.chebvander(2 * scaled - 1, degree)
        weight = np.maximum(shares / shares[0], 1e-7)
        for _ in range(FIT_ROUNDS):
            found = np.linalg.lstsq(terms * weight[:, None], wanted * weight, rcond=None)[0]
            error = np.abs(np.exp2(np.minimum(terms @ found, 0.0)) - shares)
            if error.max() <= MAX_SHARE_ERROR:
                power = np.polynomial.Chebyshev(found, domain=[0.0, reach_px**2]).convert(kind=np.polynomial.Polynomial)
                return tuple(power.coef.tolist())
            weight = weight * np.sqrt(error / error.max() + 1e-3)  # Lawson (1961): towards the smallest maximum
    return None
