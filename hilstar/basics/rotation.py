"""Unit quaternions: Hamilton, scalar first (w, x, y, z), float64. q and -q are the same attitude.

`q_icrs_to_cam` turns a vector's ICRS components into camera components: v_cam = q v_icrs q*.
Arrays of quaternions may have leading axes; the last axis has the four components.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from hilstar.basics.arrays import FloatArray

# Below this half angle, rad, sin(x)/x is 1 - x^2/6 to the last bit.
SMALL_RAD = 1e-4


def normalise(q: FloatArray) -> FloatArray:
    """`q` (..., 4) scaled to unit length."""
    return np.asarray(q / np.linalg.norm(q, axis=-1, keepdims=True))


def random_attitudes(count: int, rng: np.random.Generator) -> FloatArray:
    """Unit quaternions (count, 4), uniform over all rotations."""
    # A normal distribution has no direction of its own, so its directions are uniform.
    return normalise(rng.normal(size=(count, 4)))


def random_attitude(rng: np.random.Generator) -> FloatArray:
    """One of `random_attitudes`, (4,)."""
    return np.asarray(random_attitudes(1, rng)[0])


def conjugate(q: FloatArray) -> FloatArray:
    """The inverse rotations of unit quaternions (..., 4)."""
    return np.asarray(q * np.array([1.0, -1.0, -1.0, -1.0]))


def multiply(a: FloatArray, b: FloatArray) -> FloatArray:
    """The Hamilton product a b of quaternions (..., 4): the rotation b, then the rotation a."""
    a = np.asarray(a, dtype=np.float64)
    b = np.asarray(b, dtype=np.float64)
    # For a single quaternion Python's floats give the same bits several times faster than arrays.
    single = a.ndim == b.ndim == 1
    aw, ax, ay, az = a.tolist() if single else np.moveaxis(a, -1, 0)
    bw, bx, by, bz = b.tolist() if single else np.moveaxis(b, -1, 0)
    product = (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )
    if single:
        return np.array(product)
    return np.stack(product, axis=-1)


def to_matrix(q: FloatArray) -> FloatArray:
    """The rotation matrices R (..., 3, 3) of unit quaternions (..., 4). For q_icrs_to_cam v_cam = R
    v_icrs, so that the rows of R are the camera's axes in ICRS components.
    """
    q = np.asarray(q, dtype=np.float64)
    w, x, y, z = q.tolist() if q.ndim == 1 else np.moveaxis(q, -1, 0)
    matrix = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    if q.ndim == 1:
        return matrix
    return np.ascontiguousarray(np.moveaxis(matrix, (0, 1), (-2, -1)))


def from_rotation_vector(vector_rad: FloatArray) -> FloatArray:
    """The quaternion (4,) of the right-handed rotation of vectors by the angle |v|, rad, about the
    axis v (3,).
    """
    angle = float(np.linalg.norm(vector_rad))
    # sin(angle / 2) / angle, which numpy's sinc gives at 0 too
    share = np.sinc(angle / (2 * np.pi)) / 2
    return np.array([np.cos(angle / 2), *(share * vector_rad)])


def from_rotation_vectors(vectors_rad: FloatArray) -> FloatArray:
    """The quaternions (n, 4) of rotation vectors (n, 3), rad; see `from_rotation_vector`."""
    angle = np.linalg.norm(vectors_rad, axis=-1, keepdims=True)
    return np.concatenate(
        [np.cos(angle / 2), np.sinc(angle / (2 * np.pi)) / 2 * vectors_rad], axis=-1
    )


def rotate(q: FloatArray, vectors: FloatArray) -> FloatArray:
    """The components (n, 3) of vectors (n, 3) after rotations by unit quaternions (n, 4): q v
    q*.
    """
    pure = np.concatenate((np.zeros((len(vectors), 1)), vectors), axis=1)
    return np.asarray(multiply(multiply(q, pure), conjugate(q))[:, 1:])


def frame_turns(axis: int, angle_rad: FloatArray) -> FloatArray:
    """The quaternions (n, 4) that turn a vector's components into those of frames which are turned
    by angles (n,), rad, about their axis 0, 1 or 2.
    """
    q = np.zeros((len(angle_rad), 4))
    q[:, 0], q[:, 1 + axis] = np.cos(angle_rad / 2), -np.sin(angle_rad / 2)
    return q


def to_rotation_vector(q: FloatArray) -> FloatArray:
    """The rotation vectors (..., 3), rad, of unit quaternions (..., 4), by the shorter way; the
    inverse of `from_rotation_vectors`.
    """
    q = np.where(q[..., :1] < 0, -q, q)
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    tiny = sine < SMALL_RAD
    angle = 2 * np.arctan2(sine, q[..., :1])
    return np.asarray(
        q[..., 1:] * np.where(tiny, 2.0 + sine * sine / 3.0, angle / np.where(tiny, 1.0, sine))
    )


def from_matrix(matrix: FloatArray) -> FloatArray:
    """The quaternion (4,), w >= 0, of a rotation matrix (3, 3). The largest component is computed
    first, so that none is divided by a small one (Shepperd 1978).
    """
    trace = float(np.trace(matrix))
    squares = np.array([trace, *np.diag(matrix)])
    k = int(np.argmax(squares))
    skew = np.array(
        [matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]]
    )
    if k == 0:
        q = np.array([1 + trace, *skew])
    else:
        i = k - 1
        both = matrix + matrix.T
        q = np.array([skew[i], *both[i]])
        q[k] = 1 - trace + 2 * matrix[i, i]
    q = normalise(q)
    return q if q[0] >= 0 else -q


def direction_of(ra_deg: ArrayLike, dec_deg: ArrayLike) -> FloatArray:
    """The unit vectors (..., 3) of right ascensions and declinations (...), degrees, in the frame
    to which these refer.
    """
    ra = np.radians(ra_deg)
    dec = np.radians(dec_deg)
    return np.stack((np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)), axis=-1)


class Places(NamedTuple):
    """Right ascensions (...), from 0 to below 360, and declinations (...), degrees."""

    ra_deg: FloatArray
    dec_deg: FloatArray


def to_radec_deg(directions: FloatArray) -> Places:
    """The right ascensions and declinations of directions (..., 3), vectors of any length, in the
    same frame; the inverse of `direction_of`.
    """
    x, y, z = np.moveaxis(np.asarray(directions, dtype=np.float64), -1, 0)
    ra_deg = np.degrees(np.arctan2(y, x)) % 360.0
    return Places(ra_deg, np.degrees(np.arctan2(z, np.hypot(x, y))))


def from_radec_roll_deg(ra_deg: float, dec_deg: float, roll_deg: float) -> FloatArray:
    """q_icrs_to_cam (4,), w >= 0, of a boresight's right ascension and declination and of a roll,
    degrees (thesis eq. 2.3): R_icrs_from_cam = A3(ra-90) A1(dec-90) A3(roll).

    At roll 0 the image has north up and east left.
    """
    q_cam_to_icrs = multiply(
        multiply(_about_z(np.radians(ra_deg - 90.0)), _about_x(np.radians(dec_deg - 90.0))),
        _about_z(np.radians(roll_deg)),
    )
    q = conjugate(q_cam_to_icrs)
    return -q if q[0] < 0 else q


def to_radec_roll_deg(q_icrs_to_cam: FloatArray) -> tuple[float, float, float]:
    """The boresight's right ascension, its declination, and the roll of an attitude (4,), degrees;
    right ascension and roll from 0 to below 360. The inverse of `from_radec_roll_deg`.

    At a pole only right ascension and roll together are defined; the right ascension is then what
    `arctan2` returns.
    """
    r = to_matrix(q_icrs_to_cam)
    dec = np.arctan2(r[2, 2], np.hypot(r[2, 0], r[2, 1]))
    ra = np.arctan2(r[2, 1], r[2, 0])
    # North and east at the boresight, in camera components; roll turns north from "up" (-y).
    east = r @ np.array([-np.sin(ra), np.cos(ra), 0.0])
    roll = np.arctan2(east[1], -east[0])
    return _turn_deg(ra), float(np.degrees(dec)), _turn_deg(roll)


def angle_between_rad(a: FloatArray, b: FloatArray) -> float:
    """The angle of the rotation from attitude `a` (4,) to attitude `b` (4,), rad, 0 to pi; it is
    exact for tiny angles too.
    """
    d = multiply(a, conjugate(b))
    return float(2 * np.arctan2(np.linalg.norm(d[..., 1:]), abs(d[..., 0])))


def slerp(a: FloatArray, b: FloatArray, fraction: float) -> FloatArray:
    """The attitude (4,), unit, at `fraction` (0 to 1) of the shorter way from `a` (4,) to `b` (4,)
    at a constant rate (Shoemake 1985).
    """
    if float(np.dot(a, b)) < 0:
        b = -b
    # Half the rotation's angle from both chords is accurate from 0 to pi/2; arccos of the dot
    # product is not.
    half = 2 * np.arctan2(np.linalg.norm(b - a), np.linalg.norm(b + a))
    if half < SMALL_RAD:
        return normalise(a + fraction * (b - a))
    return np.asarray(
        (np.sin((1 - fraction) * half) * a + np.sin(fraction * half) * b) / np.sin(half)
    )


def propagate(q_icrs_to_cam: FloatArray, rate_cam_rad_s: FloatArray, seconds: float) -> FloatArray:
    """The attitude q_icrs_to_cam (4,) after `seconds` at a constant rate (3,), rad/s, of cam with
    respect to ICRS in cam components: v_cam' = -omega x v_cam.
    """
    vector = -0.5 * seconds * np.asarray(rate_cam_rad_s, dtype=np.float64)
    half = float(np.linalg.norm(vector))
    if half < SMALL_RAD:
        sinc = 1.0 - half * half / 6.0
    else:
        sinc = np.sin(half) / half
    step = np.array([np.cos(half), *(sinc * vector)])
    return normalise(multiply(step, q_icrs_to_cam))


def rate_between_rad_s(earlier: FloatArray, later: FloatArray, seconds: float) -> FloatArray:
    """The constant rate (3,), rad/s, of cam with respect to ICRS in cam components, that turns the
    attitude `earlier` (4,) into `later` (4,) by the shorter way; the inverse of `propagate`.
    """
    d = multiply(later, conjugate(earlier))
    if d[0] < 0:
        d = -d
    sine = float(np.linalg.norm(d[1:]))
    half = np.arctan2(sine, d[0])
    if half < SMALL_RAD:
        scale = 1.0 + half * half / 6.0
    else:
        scale = half / sine
    return np.asarray(-2.0 * scale * d[1:] / seconds)


def _turn_deg(angle_rad: float) -> float:
    """An angle in degrees, from 0 to below 360."""
    # the remainder of a tiny negative angle rounds to 360 itself
    turn = float(np.degrees(angle_rad)) % 360.0
    return 0.0 if turn == 360.0 else turn


def turn_text(turn_deg: float, decimals: int = 4) -> str:
    """An angle in degrees as text, which as written is from 0 to below 360: 359.99999 is
    "0.0000".
    """
    return f"{round(turn_deg, decimals) % 360:.{decimals}f}"


def _about_x(angle_rad: float) -> FloatArray:
    return np.array([np.cos(angle_rad / 2), np.sin(angle_rad / 2), 0.0, 0.0])


def _about_z(angle_rad: float) -> FloatArray:
    return np.array([np.cos(angle_rad / 2), 0.0, 0.0, np.sin(angle_rad / 2)])
