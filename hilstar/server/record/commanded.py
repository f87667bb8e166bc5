"""The attitudes that a run commanded: read from its ledger, and interpolated between its frames."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.rotation import (
    conjugate,
    from_rotation_vectors,
    multiply,
    normalise,
    to_rotation_vector,
)

# Two frames further apart than MAX_GAP_S and USUAL_INTERVALS median intervals do not say what was
# shown between them.
MAX_GAP_S, USUAL_INTERVALS = 0.5, 3.0
# A jump: a larger step than MAX_STEP_RAD, or one over JUMP_RAD that is JUMP_RATIO times as fast as
# both of its neighbours.
MAX_STEP_RAD = np.radians(2.0)
JUMP_RAD, JUMP_RATIO = np.radians(0.02), 4.0
SAME_RAD = 1e-9  # two frames of one attitude are joined whatever lies between them
UNEVEN = 1.6  # largest ratio of neighbouring intervals for a cubic through four frames
NO_SPANS = np.zeros((0, 2))


@dataclass(frozen=True, slots=True)
class Moments:
    """The commanded `q_icrs_to_cam` (n, 4) and rate (n, 3), rad/s, cam, at some moments; NaN where
    not `known` (n,).

    `held_s` (n,) is for how long a frame was held for missed ones about a moment, 0 where none was:
    what was lit then is not what was commanded.
    """

    q: FloatArray
    rate_rad_s: FloatArray
    known: npt.NDArray[np.bool_]
    held_s: FloatArray


class Commanded:
    """The attitudes of a run's frames, interpolated between them.

    `t_s` (m,) rises; `q` (m, 4), unit q_icrs_to_cam, is NaN where the sky was not shown as
    commanded. `held_s` (k, 2), rising, are the spans from a frame to the next in which refresh
    periods had no frame of their own, `hold_s` (k,) the longest time in each for which one frame
    stood.
    """

    def __init__(
        self,
        t_s: FloatArray,
        q: FloatArray,
        held_s: FloatArray = NO_SPANS,
        hold_s: FloatArray | None = None,
    ) -> None:
        self.t_s = t_s
        self.q = q
        self.held_s = held_s
        self.hold_s = np.diff(held_s, axis=1)[:, 0] if hold_s is None else hold_s
        gap_s = np.diff(t_s)
        self.interval_s = float(np.median(gap_s)) if len(gap_s) else 0.0
        self._step = to_rotation_vector(multiply(q[1:], conjugate(q[:-1])))  # frame k to k + 1
        turned = np.linalg.norm(self._step, axis=1)
        near = gap_s <= max(MAX_GAP_S, USUAL_INTERVALS * self.interval_s)
        # A step is a jump where it is much faster than the one before and the one after it.
        rate = np.nan_to_num(turned) / gap_s
        before = np.append(0.0, rate[:-1])
        after = np.append(rate[1:], 0.0)
        jumps = (np.nan_to_num(turned) > JUMP_RAD) & (rate > JUMP_RATIO * np.maximum(before, after))
        with np.errstate(invalid="ignore"):
            self.joined = (
                np.isfinite(turned)
                & ((near & (turned <= MAX_STEP_RAD)) | (turned <= SAME_RAD))
                & ~jumps
            )
        self._gap_s = gap_s

    @property
    def shown(self) -> npt.NDArray[np.bool_]:
        """Which frames (m,) have an attitude."""
        return np.asarray(np.isfinite(self.q[:, 0]))

    def at(self, t_s: FloatArray) -> Moments:
        """The commanded attitudes at times (n,), s: a cubic through four frames, or the great arc
        between two.

        Of a trajectory of angular acceleration change j (rad/s^3) the cubic is off by less than j
        dt^3 / 15.
        """
        before = np.clip(np.searchsorted(self.t_s, t_s, side="right") - 1, 0, len(self.t_s) - 2)
        known = (t_s >= self.t_s[0]) & (t_s <= self.t_s[-1]) & self.joined[before]
        gap_s = self._gap_s[before, None]
        step = self._step[before]
        share = np.clip((t_s - self.t_s[before]) / gap_s[:, 0], 0, 1)[:, None]
        # Hermite's cubic of the rotation vector from the frame before; at its ends it turns by
        # (step + bend) per interval.
        start = step + self._bend(before, -1)
        end = step + self._bend(before, 1)
        squared = share**2
        cubed = share**3
        moved = (
            (cubed - 2 * squared + share) * start
            + (3 * squared - 2 * cubed) * step
            + (cubed - squared) * end
        )
        speed = (
            (3 * squared - 4 * share + 1) * start
            + (6 * share - 6 * squared) * step
            + (3 * squared - 2 * share) * end
        )
        rate = -speed / gap_s  # v_cam' = -omega x v_cam
        q = normalise(
            multiply(from_rotation_vectors(np.where(known[:, None], moved, 0.0)), self.q[before])
        )
        held_s = self._held_about(t_s)
        return Moments(
            np.where(known[:, None], q, np.nan),
            np.where(known[:, None], rate, np.nan),
            known,
            held_s,
        )

    def over_exposures(self, reach_s: float) -> "Commanded":
        """The same, where a moment stands for what was lit up to `reach_s` before and after it."""
        widened = self.held_s + np.array([-reach_s, reach_s])
        if not len(widened):
            return self
        # Spans that meet become one.
        apart = np.append(True, widened[1:, 0] > np.maximum.accumulate(widened[:, 1])[:-1])
        first = np.flatnonzero(apart)
        spans_s = np.stack([widened[first, 0], np.maximum.reduceat(widened[:, 1], first)], axis=1)
        return Commanded(self.t_s, self.q, spans_s, np.maximum.reduceat(self.hold_s, first))

    def _held_about(self, t_s: FloatArray) -> FloatArray:
        """How long a frame stood in the held span in which each time (n,) lies, s; 0 where it
        lies in none.
        """
        if not len(self.held_s):
            return np.zeros(len(t_s))
        start_s, end_s = self.held_s.T
        span = np.searchsorted(start_s, t_s, side="right") - 1
        inside = (span >= 0) & (t_s <= end_s[span])
        return np.where(inside, self.hold_s[span], 0.0)

    def _bend(self, interval: IntArray, side: int) -> FloatArray:
        """How far the turn at one end of each interval, rad per interval, differs from the
        interval's own (n, 3).

        `side` is -1 for the beginning and 1 for the end. Finite differences at the frame that the
        interval shares with its neighbour, weighted for unequal lengths; 0 where the neighbour is
        missing, not joined, or of another length.
        """
        last = len(self._step) - 1
        other = interval + side
        near = np.clip(other, 0, last)
        ratio = self._gap_s[near] / self._gap_s[interval]
        even = (
            (ratio < UNEVEN)
            & (ratio > 1 / UNEVEN)
            & (other >= 0)
            & (other <= last)
            & self.joined[near]
        )
        change = (self._step[near] / ratio[:, None] - self._step[interval]) / (1 + ratio[:, None])
        return np.where(even[:, None], change, 0.0)
