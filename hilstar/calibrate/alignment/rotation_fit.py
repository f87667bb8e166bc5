"""One rotation from many that should be the same: a robust mean on the sphere of quaternions.

Each pair gives a rotation. The start is the one among them that has half of all nearest to it; from there the mean is
iterated in the tangent space with Tukey's weights (Beaton and Tukey 1974), whose scale is the median absolute deviation,
across the boresight and about it apart, since a tracker knows its roll several times worse.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hilstar.arrays import FloatArray, IntArray
from hilstar.rotation import conjugate, from_rotation_vector, multiply, normalise, to_rotation_vector
from hilstar.units import ARCSEC_PER_RAD, MAD_TO_SIGMA

AGREE_RAD = np.radians(1.0)  # two rotations further apart are not of one alignment, whatever the noise
STARTS = 100  # of which one is near the truth but for 2^-100, while fewer than half are wild
# Tukey's weights end here, in sigmas of three axes together: 7e-8 of a Gaussian lies beyond. The scale of a few pairs is itself
# uncertain, so for n of them it is 6 (1 + (10 / n)^2): of 1000 clean sets of 3 pairs 12 then lose one, of 4 and more 2 at most.
CUT_SIGMAS = 6.0
FEW = 10.0
FLOOR_RAD = 0.01 / ARCSEC_PER_RAD  # of the scale: quaternions are written with so many digits
ROUNDS = 50
DONE_RAD = 1e-13


@dataclass(frozen=True, slots=True)
class RotationFit:
    """The rotation (4,), and each pair's residual (n, 3), rad, and weight (n,).

    A weight of 0 is a wild pair.
    """

    q: FloatArray
    residual_rad: FloatArray
    weight: FloatArray

    @property
    def used(self) -> npt.NDArray[np.bool_]:
        """Which pairs (n,) are not wild."""
        return np.asarray(self.weight > 0)

    def sigma_rad(self, group: IntArray) -> FloatArray:
        """One sigma (3,) of the rotation, cam axes; errors of one `group` (n,) are taken as common to it.

        Of a single group its pairs count as independent, which says nothing of an error that the attitude itself has.
        """
        weighted = self.weight[:, None] * self.residual_rad
        if len(np.unique(group[self.used])) == 1:
            group = np.arange(len(group))
        sums = np.stack([np.bincount(group, weighted[:, k]) for k in range(3)], axis=1)
        groups = max(len(np.unique(group[self.used])), 2)
        total = float(self.weight.sum())
        return np.asarray(np.sqrt((sums**2).sum(axis=0) * groups / (groups - 1)) / total)


def start_of(rotations: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The rotation among (n, 4) that has half of all nearest to it, and the angle (n,) of each to it, rad."""
    chosen = np.unique(np.linspace(0, len(rotations) - 1, STARTS).astype(int))
    best, angles, reach = rotations[0], np.zeros(len(rotations)), np.inf
    for candidate in rotations[chosen]:
        cosine = np.abs(rotations @ candidate)
        # The chord is exact for tiny angles, where the cosine is not.
        chord = np.linalg.norm(rotations - np.where((rotations @ candidate)[:, None] < 0, -1.0, 1.0) * candidate, axis=1)
        angle = np.where(cosine > 0.5, 4 * np.arcsin(np.minimum(chord / 2, 1.0)), 2 * np.arccos(np.minimum(cosine, 1.0)))
        half = float(np.quantile(angle, 0.5, method="higher"))
        if half < reach:
            best, angles, reach = candidate, angle, half
    return best, angles


def fit_rotation(rotations: FloatArray) -> RotationFit:
    """The robust mean of rotations (n, 4), of which more than half agree within AGREE_RAD."""
    q, angle = start_of(rotations)
    near = angle <= AGREE_RAD
    q = _moved(q, np.median(_residuals(rotations[near], q), axis=0))
    cut = CUT_SIGMAS * (1 + (FEW / max(int(near.sum()), 1)) ** 2)
    for _ in range(ROUNDS):
        residual = _residuals(rotations, q)
        weight = _weights(residual, near, cut)
        step = (weight[:, None] * residual).sum(axis=0) / weight.sum()
        q = _moved(q, step)
        if np.linalg.norm(step) < DONE_RAD:
            break
    residual = _residuals(rotations, q)
    return RotationFit(q, residual, _weights(residual, near, cut))


def _residuals(rotations: FloatArray, q: FloatArray) -> FloatArray:
    return to_rotation_vector(multiply(rotations, conjugate(q)))


def _moved(q: FloatArray, step_rad: FloatArray) -> FloatArray:
    return normalise(multiply(from_rotation_vector(step_rad), q))


def _weights(residual: FloatArray, near: npt.NDArray[np.bool_], cut: float) -> FloatArray:
    """Tukey's weights (n,); 0 for what is not near."""
    off = np.abs(residual[near])
    cross = max(MAD_TO_SIGMA * float(np.median(off[:, :2])), FLOOR_RAD)
    roll = max(MAD_TO_SIGMA * float(np.median(off[:, 2])), FLOOR_RAD)
    squared = (residual[:, 0] ** 2 + residual[:, 1] ** 2) / cross**2 + residual[:, 2] ** 2 / roll**2
    weight = np.where(near & (squared < cut**2), (1 - squared / cut**2) ** 2, 0.0)
    return weight if weight.any() else near.astype(np.float64)
