"""What a real lens and a tilted screen do to the places of a pinhole camera, in float64.

A direction (u, v, 1) in image axes is bent by Brown's polynomials (Brown 1966, eq. 13, in Conrady's form), meets a plane that
is tilted about the foot of the axis, and is moved by a smooth residual field over the pixels. All three are closed forms from
direction to pixel, the way that every frame goes; `Camera.tangents` is the way back.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from hilstar.arrays import FloatArray, IntArray

FIELD_EDGE = 1.1  # of half the image: beyond it the field stands still, where its polynomials would run away

ANY_TANGENT = (-1e9, 1e9)  # finite: a product with it is a number


@dataclass(frozen=True, slots=True)
class ResidualField:
    """A smooth shift of pixels: sums of Chebyshev polynomials over the image, `x` and `y` (n, n) coefficients in px.

    Entry (i, j) belongs to T_i of the column and T_j of the row, both from -1 to 1 over the image.
    """

    x: FloatArray
    y: FloatArray
    resolution_px: tuple[int, int]

    @classmethod
    def of_terms(cls, x: FloatArray, y: FloatArray, degree: int, resolution_px: tuple[int, int]) -> ResidualField:
        """The field of coefficients (terms,) in the order of `field_terms`."""
        squares = np.zeros((2, degree + 1, degree + 1))
        i, j = _exponents(degree)
        squares[0, i, j], squares[1, i, j] = x, y
        return cls(squares[0], squares[1], resolution_px)

    def at(self, x_px: FloatArray, y_px: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The shift at pixels (k,), px."""
        columns, rows = _polynomials(x_px, y_px, self.resolution_px, len(self.x) - 1)
        return np.einsum("ik,ik->k", self.x.T @ columns, rows), np.einsum("ik,ik->k", self.y.T @ columns, rows)


def field_terms(x_px: FloatArray, y_px: FloatArray, resolution_px: tuple[int, int], degree: int) -> FloatArray:
    """The polynomials T_i T_j of total degree up to `degree` at pixels (k,): (k, terms)."""
    columns, rows = _polynomials(x_px, y_px, resolution_px, degree)
    i, j = _exponents(degree)
    return np.asarray((columns[i] * rows[j]).T)


def _exponents(degree: int) -> tuple[IntArray, IntArray]:
    i, j = np.indices((degree + 1, degree + 1)).reshape(2, -1)
    kept = i + j <= degree
    return i[kept], j[kept]


def _polynomials(
    x_px: FloatArray, y_px: FloatArray, resolution_px: tuple[int, int], degree: int
) -> tuple[FloatArray, FloatArray]:
    place = np.empty((2, len(x_px)))
    for row, at, size in zip(place, (x_px, y_px), resolution_px, strict=True):
        np.multiply(at, 2 / size, out=row)
        row -= (size - 1) / size
    terms = _chebyshev(np.clip(place, -FIELD_EDGE, FIELD_EDGE, out=place), degree + 1)
    return terms[:, 0], terms[:, 1]


def _chebyshev(t: FloatArray, count: int) -> FloatArray:
    """T_0 to T_(count - 1) at places of any shape: (count, ...). Few and large operations: a frame has 0.3 ms for its lens."""
    terms = np.empty((count, *t.shape))
    terms[0] = 1.0
    if count > 1:
        terms[1] = t
    twice = 2 * t
    for k in range(2, count):
        np.multiply(twice, terms[k - 1], out=terms[k])
        terms[k] -= terms[k - 2]
    return terms


@dataclass(frozen=True, slots=True)
class Lens:
    """Distortion k1 to k3 and p1, p2 (of tangents of field angles), the plane's tilt about its x and y axes, and the field.

    `max_tangent` bounds the directions that it is used for: the largest radius of (u, v) that reaches the image, or that was
    calibrated. Farther out the polynomials turn back, and would show stars that are not in view. `box` bounds u and v.
    """

    radial: tuple[float, float, float] = (0.0, 0.0, 0.0)
    tangential: tuple[float, float] = (0.0, 0.0)
    tilt_rad: tuple[float, float] = (0.0, 0.0)
    field: ResidualField | None = None
    max_tangent: float = np.inf
    box: tuple[tuple[float, float], tuple[float, float]] = (ANY_TANGENT, ANY_TANGENT)

    def bent(self, u: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Places on the tilted plane, in focal lengths from the foot of the axis, of directions (u, v, 1); NaN beyond."""
        k1, k2, k3 = self.radial
        p1, p2 = self.tangential
        r2 = u * u + v * v
        gain = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        gain[~(r2 <= self.max_tangent**2)] = np.nan
        if p1 or p2:
            gain += 2 * (p1 * v + p2 * u)
        rays = np.ones((3, len(u)))
        np.multiply(u, gain, out=rays[0])
        np.multiply(v, gain, out=rays[1])
        if p1 or p2:
            rays[0] += p2 * r2
            rays[1] += p1 * r2
        return _on_plane(rays, self.tilt_rad)


def _on_plane(rays: FloatArray, tilt_rad: tuple[float, float]) -> tuple[FloatArray, FloatArray]:
    """Where rays (3, n) of z 1 meet a plane through (0, 0, 1) that is turned about x, then about y, in its own axes."""
    if tilt_rad == (0.0, 0.0):
        return rays[0], rays[1]
    right, down, normal = _onto_plane(tilt_rad) @ rays
    normal[~(normal > 0)] = np.nan
    return right / normal, down / normal


@lru_cache(maxsize=16)
def _onto_plane(tilt_rad: tuple[float, float]) -> FloatArray:
    """The map of rays to the plane as a matrix of homogeneous places."""
    axes = plane_axes(tilt_rad)
    right, down, normal = axes.T
    foot = axes[2]
    return np.array([foot[2] * right - foot[0] * normal, foot[2] * down - foot[1] * normal, normal])


def plane_axes(tilt_rad: tuple[float, float]) -> FloatArray:
    """Right, down and normal of the tilted plane as columns (3, 3), in the axes of the plane before its tilt."""
    a, b = tilt_rad
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, np.cos(a), -np.sin(a)], [0.0, np.sin(a), np.cos(a)]])
    about_y = np.array([[np.cos(b), 0.0, np.sin(b)], [0.0, 1.0, 0.0], [-np.sin(b), 0.0, np.cos(b)]])
    return np.asarray(about_y @ about_x)
