"""Attitudes given by angles: Euler angles and spins of CCSDS 504.0-B-1 and B-2.

1. EULER_ROT_SEQ names the axes of three turns of the frame, one after another, from the first frame to the second; each turn
   is about an axis of the frame that the turns before it made. The angles come in that order.
2. A spin axis is +z of the second frame, at right ascension alpha and declination delta of the first. The spin angle is the
   third of the turns ZXZ by alpha + 90, 90 - delta and that angle (as Orekit has it).
3. A spin with nutation turns at its spin rate about +z and at the rate of nutation about the angular momentum. Its phase
   gives the momentum's place in the second frame, (sin n cos p, -sin n sin p, cos n); the type with _MOM gives it in the first.
"""

from __future__ import annotations

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.attitude.logs.aem.blocks import EULER_DERIVATIVE, SPIN, SPIN_NUTATION, SPIN_NUTATION_MOM, AemFaultError
from hilstar.rotation import conjugate, direction_of, from_rotation_vectors, multiply

AXES = {"1": 0, "2": 1, "3": 2, "X": 0, "Y": 1, "Z": 2}


def sequence(meta: dict[str, str]) -> tuple[int, int, int]:
    """The axes (0 to 2) of EULER_ROT_SEQ, such as 321 or ZYX. Raises AemFaultError."""
    text = meta.get("EULER_ROT_SEQ", "missing")
    axes = [AXES.get(letter, -1) for letter in text]
    if len(axes) != 3 or -1 in axes or axes[0] == axes[1] or axes[1] == axes[2]:
        raise AemFaultError("", f"EULER_ROT_SEQ is {text[:40]}; write three axes such as 321 or ZYX, no two alike side by side")
    return axes[0], axes[1], axes[2]


def turned(angles_rad: FloatArray, axes: tuple[int, int, int]) -> FloatArray:
    """The rotations (n, 4) of components from the first frame to the second, by angles (n, 3) about axes."""
    return multiply(
        _turn(angles_rad[:, 2], axes[2]), multiply(_turn(angles_rad[:, 1], axes[1]), _turn(angles_rad[:, 0], axes[0]))
    )


def euler(values: FloatArray, meta: dict[str, str]) -> tuple[FloatArray, FloatArray | None]:
    """Rotations (n, 4) from first to second, and their rates (n, 3), rad/s in the second's components, for EULER_DERIVATIVE.

    `values` (n, 3 or 6) are degrees and degrees per second.
    """
    axes, values = sequence(meta), np.radians(values)
    q = turned(values[:, :3], axes)
    if meta["ATTITUDE_TYPE"] != EULER_DERIVATIVE:
        return q, None
    rate = np.zeros((len(values), 3))
    for k, axis in enumerate(axes):  # each turn's rate, then carried through the turns after it
        rate[:, axis] += values[:, 3 + k]
        if k < 2:
            rate = rotated(_turn(values[:, k + 1], axes[k + 1]), rate)
    return q, rate


def spin(values: FloatArray, kind: str) -> tuple[FloatArray, FloatArray]:
    """Rotations (n, 4) from first to second and rates (n, 3), rad/s in the second's components.

    `values` (n, 4 or 7) are alpha, delta, the angle (degrees) and its rate (degrees per second); then, with nutation, the
    angle of nutation, its period (s) and its phase, or the momentum's alpha and delta and the rate of nutation.
    """
    alpha, delta, angle, spin_rate = np.radians(values[:, :4].T)
    q = turned(np.column_stack((np.pi / 2 + alpha, np.pi / 2 - delta, angle)), (2, 0, 2))
    rate = np.zeros((len(values), 3))
    rate[:, 2] = spin_rate
    if kind == SPIN_NUTATION:
        nutation, phase = np.radians(values[:, 4]), np.radians(values[:, 6])
        momentum = np.stack((np.sin(nutation) * np.cos(phase), -np.sin(nutation) * np.sin(phase), np.cos(nutation)), axis=1)
        rate += (2 * np.pi / values[:, 5])[:, None] * momentum
    elif kind == SPIN_NUTATION_MOM:
        momentum = direction_of(values[:, 4], values[:, 5])
        rate += np.radians(values[:, 6])[:, None] * rotated(q, momentum)
    elif kind != SPIN:
        raise AssertionError(kind)
    return q, rate


def rotated(q: FloatArray, vectors: FloatArray) -> FloatArray:
    """The components (n, 3) of vectors after rotations (n, 4) of unit length."""
    pure = np.concatenate((np.zeros((len(vectors), 1)), vectors), axis=1)
    return multiply(multiply(q, pure), conjugate(q))[:, 1:]


def _turn(angle_rad: FloatArray, axis: int) -> FloatArray:
    """Components in a frame that is turned by angles (n,) about an axis of the old one."""
    vectors = np.zeros((len(angle_rad), 3))
    vectors[:, axis] = -angle_rad
    return from_rotation_vectors(vectors)
