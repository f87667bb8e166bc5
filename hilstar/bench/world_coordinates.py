"""The world coordinate system of an image as FITS keywords: a tangent plane, and what a lens bends as SIP polynomials.

SIP (Shupe et al. 2005): a pixel at (X, Y) from CRPIX is at CD (X + A(X, Y), Y + B(X, Y)) on the tangent plane, and AP and BP
lead back. Of their degree the smallest is taken that is right to GOOD_PX at pixels which were held out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from hilstar.arrays import FloatArray, IntArray
from hilstar.rotation import to_matrix
from hilstar.scene.camera import Camera

GOOD_PX = 0.01
MAX_SIP_PX = 0.1  # a polynomial that is further off is not written
MAX_DEGREE = 9  # of the convention
FITTED, HELD_OUT = 28, 25  # places along each side of the image; the latter have its edges among them

Keywords = dict[str, str | float]


@dataclass(frozen=True, slots=True)
class Sip:
    """SIP of one degree, about `origin_px`: the linear part (2, 2), of pixels to those of an ideal image, and all other terms.

    `forward` and `back` (terms, 2) are A, B and AP, BP by `_powers`. `error_px` is their largest error over the image.
    """

    degree: int
    origin_px: tuple[float, float]
    linear: FloatArray
    forward: FloatArray
    back: FloatArray
    error_px: float


def world_coordinates(camera: Camera, q_icrs_to_cam: FloatArray) -> Keywords:
    """The FITS keywords of an image: TAN, exact for a pinhole; behind a lens with SIP, or TAN alone where no SIP fits.

    `LENSERR` is the largest distance, px, on the image between where they and the camera have a star.
    """
    if camera.lens is None:
        return _tangent_plane(camera, q_icrs_to_cam, camera.principal_point_px, np.eye(2))
    sip = fit_sip(camera)
    if sip is None:
        tan = _tangent_plane(camera, q_icrs_to_cam, camera.principal_point_px, np.eye(2))
        return tan | {"LENS": True, "LENSERR": round(_tan_error_px(camera), 4)}
    keywords = _tangent_plane(camera, q_icrs_to_cam, sip.origin_px, sip.linear)
    keywords |= {"CTYPE1": "RA---TAN-SIP", "CTYPE2": "DEC--TAN-SIP", "LENS": True, "LENSERR": round(sip.error_px, 6)}
    for names, terms, first in ((("A", "B"), sip.forward, 2), (("AP", "BP"), sip.back, 1)):
        for name, column in zip(names, terms.T, strict=True):
            keywords[f"{name}_ORDER"] = sip.degree
            keywords |= {f"{name}_{p}_{q}": float(c) for p, q, c in zip(*_powers(sip.degree, first), column, strict=True)}
    return keywords


def _tangent_plane(camera: Camera, q_icrs_to_cam: FloatArray, origin_px: tuple[float, float], linear: FloatArray) -> Keywords:
    right, down, normal = camera.cam_to_image @ to_matrix(q_icrs_to_cam)
    ra, dec = np.arctan2(normal[1], normal[0]), np.arctan2(normal[2], np.hypot(normal[0], normal[1]))
    east = np.array([-np.sin(ra), np.cos(ra), 0.0])
    north = np.array([-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra), np.cos(dec)])
    deg_per_px = np.degrees(1.0 / camera.focal_length_px)
    cd = np.array([[right @ east, down @ east], [right @ north, down @ north]]) @ linear * deg_per_px
    return {
        "CTYPE1": "RA---TAN",
        "CTYPE2": "DEC--TAN",
        "RADESYS": "ICRS",
        "CUNIT1": "deg",
        "CUNIT2": "deg",
        "LONPOLE": 180.0,
        "CRVAL1": float(np.degrees(ra) % 360),
        "CRVAL2": float(np.degrees(dec)),
        "CRPIX1": origin_px[0] + 1.0,
        "CRPIX2": origin_px[1] + 1.0,
        "CD1_1": float(cd[0, 0]),
        "CD1_2": float(cd[0, 1]),
        "CD2_1": float(cd[1, 0]),
        "CD2_2": float(cd[1, 1]),
    }


@lru_cache(maxsize=4)
def fit_sip(camera: Camera) -> Sip | None:
    """The SIP of a camera with a lens, by least squares over its image; None where no degree is within MAX_SIP_PX."""
    x_px, y_px = camera.places_px(np.zeros(1), np.zeros(1))
    origin_px = float(x_px[0]), float(y_px[0])
    fitted, held_out = (_pairs(camera, origin_px, count) for count in (FITTED, HELD_OUT))
    degree, whole = _whole(fitted, held_out)
    linear = whole[[_place(degree, 1, 0), _place(degree, 0, 1)]].T
    of_pixels = np.linalg.inv(linear).T  # rows of ideal places to pixels
    forward = whole[np.add(*_powers(degree, 1)) >= 2] @ of_pixels
    pixel, flat = fitted[0], fitted[1] @ of_pixels
    back = _solved(flat, pixel - flat, degree)
    pixel, flat = held_out[0], held_out[1] @ of_pixels
    there = pixel + _terms(pixel, degree, 2) @ forward - flat
    again = flat + _terms(flat, degree, 1) @ back - pixel
    error_px = max(float(np.hypot(*off.T).max()) for off in (there, again))
    return Sip(degree, origin_px, linear, forward, back, error_px) if error_px <= MAX_SIP_PX else None


def _whole(fitted: tuple[FloatArray, FloatArray], held_out: tuple[FloatArray, FloatArray]) -> tuple[int, FloatArray]:
    """The degree and the terms (n, 2) of the polynomials from pixels to the ideal image."""
    found = []
    for degree in range(2, MAX_DEGREE + 1):
        whole = _solved(*fitted, degree)
        error_px = float(np.hypot(*(_terms(held_out[0], degree, 1) @ whole - held_out[1]).T).max())
        found.append((error_px, degree, whole))
        if error_px <= GOOD_PX:
            return degree, whole
    return min(found, key=lambda one: one[0])[1:]


def _pairs(camera: Camera, origin_px: tuple[float, float], count: int) -> tuple[FloatArray, FloatArray]:
    """Pixels and their places on the ideal image, both (n, 2) px from the origin; those that the lens knows."""
    x, y = camera.grid_px(count)
    u, v = camera.tangents(x, y)
    seen = np.isfinite(u)
    pixel = np.column_stack([x - origin_px[0], y - origin_px[1]])[seen]
    return pixel, camera.focal_length_px * np.column_stack([u, v])[seen]


def _solved(at: FloatArray, wanted: FloatArray, degree: int) -> FloatArray:
    """The coefficients (terms, 2), without a constant, by least squares; scaled, because powers of pixels are large."""
    terms = _terms(at, degree, 1)
    scale = np.abs(terms).max(axis=0)
    return np.asarray(np.linalg.lstsq(terms / scale, wanted, rcond=None)[0] / scale[:, None])


def _powers(degree: int, first: int) -> tuple[IntArray, IntArray]:
    """The powers p and q of all terms of total degree `first` to `degree`."""
    p, q = np.indices((degree + 1, degree + 1)).reshape(2, -1)
    kept = (p + q >= first) & (p + q <= degree)
    return p[kept], q[kept]


def _place(degree: int, p: int, q: int) -> int:
    powers = _powers(degree, 1)
    return int(np.flatnonzero((powers[0] == p) & (powers[1] == q))[0])


def _terms(at: FloatArray, degree: int, first: int) -> FloatArray:
    """The powers X^p Y^q at places (n, 2): (n, terms)."""
    p, q = _powers(degree, first)
    return np.asarray(at[:, :1] ** p * at[:, 1:] ** q)


def _tan_error_px(camera: Camera) -> float:
    """The largest distance on the image between where a camera and TAN without SIP have a star, px."""
    x_px, y_px = camera.grid_px(HELD_OUT)
    tan_x, tan_y = replace(camera, lens=None).places_px(*camera.tangents(x_px, y_px))
    return float(np.nanmax(np.hypot(tan_x - x_px, tan_y - y_px)))
