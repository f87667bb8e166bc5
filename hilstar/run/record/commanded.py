"""What the bench commanded at any moment: attitude and rate between the frames of a run."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hilstar.arrays import FloatArray
from hilstar.rotation import conjugate, from_rotation_vectors, multiply, normalise, to_rotation_vector

MAX_GAP_S = 0.5  # between two frames: beyond it, and beyond three usual intervals, nothing says what was shown in between
USUAL_INTERVALS = 3.0
MAX_STEP_RAD = np.radians(2.0)  # between two frames: more is a jump
# And so is a step between two frames that both stand nearly still beside it.
JUMP_RAD, JUMP_RATIO = np.radians(0.02), 4.0
SAME_RAD = 1e-9
UNEVEN = 1.6  # the ratio of neighbouring intervals up to which a cubic goes through four frames


@dataclass(frozen=True, slots=True)
class Moments:
    """The commanded `q_icrs_to_cam` (n, 4) and rate (n, 3), rad/s, cam, at some moments; NaN where not `known` (n,)."""

    q: FloatArray
    rate_rad_s: FloatArray
    known: npt.NDArray[np.bool_]


class Commanded:
    """The attitudes of a run's frames, interpolated between them.

    `t_s` (m,) rises; `q` (m, 4), unit q_icrs_to_cam, is NaN where the sky was not shown as commanded.
    """

    def __init__(self, t_s: FloatArray, q: FloatArray) -> None:
        self.t_s, self.q = t_s, q
        gap_s = np.diff(t_s)
        self.interval_s = float(np.median(gap_s)) if len(gap_s) else 0.0
        self._step = to_rotation_vector(multiply(q[1:], conjugate(q[:-1])))  # frame k to k + 1
        turned = np.linalg.norm(self._step, axis=1)
        near = gap_s <= max(MAX_GAP_S, USUAL_INTERVALS * self.interval_s)
        with np.errstate(invalid="ignore"):
            self.joined = np.isfinite(turned) & ((near & (turned <= MAX_STEP_RAD)) | (turned <= SAME_RAD))
            self.joined &= ~_jumps(turned, gap_s)
        self._gap_s = gap_s

    @property
    def shown(self) -> npt.NDArray[np.bool_]:
        """Which frames (m,) have an attitude."""
        return np.asarray(np.isfinite(self.q[:, 0]))

    def at(self, t_s: FloatArray) -> Moments:
        """The commanded attitudes at times (n,), s: a cubic through four frames, or the great arc between two.

        Of a trajectory of angular acceleration change j (rad/s^3) the cubic is off by less than j dt^3 / 15.
        """
        before = np.clip(np.searchsorted(self.t_s, t_s, side="right") - 1, 0, len(self.t_s) - 2)
        known = (t_s >= self.t_s[0]) & (t_s <= self.t_s[-1]) & self.joined[before]
        gap_s, step = self._gap_s[before, None], self._step[before]
        share = np.clip((t_s - self.t_s[before]) / gap_s[:, 0], 0, 1)[:, None]
        bend_before, bend_after = self._bends(before)
        # Hermite's cubic of the rotation vector from the frame before, whose ends turn by (step + bend) per interval.
        start, end = step + bend_before, step + bend_after
        squared, cubed = share**2, share**3
        moved = (cubed - 2 * squared + share) * start + (3 * squared - 2 * cubed) * step + (cubed - squared) * end
        speed = (3 * squared - 4 * share + 1) * start + (6 * share - 6 * squared) * step + (3 * squared - 2 * share) * end
        rate = -speed / gap_s  # v_cam' = -omega x v_cam
        q = normalise(multiply(from_rotation_vectors(np.where(known[:, None], moved, 0.0)), self.q[before]))
        return Moments(np.where(known[:, None], q, np.nan), np.where(known[:, None], rate, np.nan), known)

    def _bends(self, before: npt.NDArray[np.intp]) -> tuple[FloatArray, FloatArray]:
        """How far the turn at each end of an interval, rad, differs from its own: half the change to the neighbour's."""
        last = len(self._step) - 1
        bends = []
        for other in (before - 1, before + 1):
            near = np.clip(other, 0, last)
            ratio = self._gap_s[near] / self._gap_s[before]
            even = (ratio < UNEVEN) & (ratio > 1 / UNEVEN) & (other >= 0) & (other <= last) & self.joined[near]
            # Finite differences at the common frame, weighted for unequal intervals.
            change = (self._step[near] / ratio[:, None] - self._step[before]) / (1 + ratio[:, None])
            bends.append(np.where(even[:, None], change, 0.0))
        return bends[0], bends[1]


def _jumps(turned_rad: FloatArray, gap_s: FloatArray) -> npt.NDArray[np.bool_]:
    """Which steps (n,) are much faster than the one before and the one after them."""
    rate = np.nan_to_num(turned_rad) / gap_s
    before, after = np.append(0.0, rate[:-1]), np.append(rate[1:], 0.0)
    return np.asarray((np.nan_to_num(turned_rad) > JUMP_RAD) & (rate > JUMP_RATIO * np.maximum(before, after)))
