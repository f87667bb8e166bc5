"""The attitudes that a run commanded: read from its ledger, and interpolated between its frames."""

from dataclasses import dataclass

import numpy as np

from hilstar.basics.arrays import BoolArray, FloatArray, IntArray
from hilstar.basics.rotation import (
    conjugate,
    from_rotation_vectors,
    multiply,
    normalise,
    to_rotation_vector,
)

# What was shown between two frames is not known if they are further apart than both MAX_GAP_S and
# USUAL_INTERVALS median intervals.
MAX_GAP_S, USUAL_INTERVALS = 0.5, 3.0
# A jump: a larger step than MAX_STEP_RAD, or one over JUMP_RAD that is JUMP_RATIO times as fast as
# both of its neighbours.
MAX_STEP_RAD = np.radians(2.0)
JUMP_RAD, JUMP_RATIO = np.radians(0.02), 4.0
SAME_RAD = 1e-9  # two frames with the same attitude are joined, however long the gap between them
UNEVEN = 1.6  # largest ratio of neighbouring intervals for a cubic through four frames
NO_SPANS = np.zeros((0, 2))


@dataclass(frozen=True, slots=True)
class Moments:
    """The commanded attitude q_icrs_to_cam (n, 4) and rate (n, 3), rad/s, camera axes, at n
    moments; NaN where not `known` (n,).

    `held_s` (n,) is how long, s, a frame stood on the screen at a moment because frames after it
    were missed; 0 where none was. The screen did not show the commanded attitude then.
    """

    q: FloatArray
    rate_rad_s: FloatArray
    known: BoolArray
    held_s: FloatArray


class Commanded:
    """The attitudes that a run commanded, interpolated between its frames.

    `t_s` (m,), s, rises; `q` (m, 4), unit q_icrs_to_cam, is NaN where the sky was not shown as
    commanded. `held_s` (k, 2), s, rising, are the begin and end of each span between two frames in
    which frames were missed; `hold_s` (k,), s, is the longest time in each span for which one frame
    stood on the screen, by default the span's length.
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
        if hold_s is None:
            hold_s = held_s[:, 1] - held_s[:, 0]
        self.hold_s = hold_s
        self._gap_s = np.diff(t_s)
        self.interval_s = 0.0
        if len(self._gap_s):
            self.interval_s = float(np.median(self._gap_s))
        q_step = multiply(q[1:], conjugate(q[:-1]))  # frame k to k + 1
        self._step = to_rotation_vector(q_step)
        self.joined = self._joined()

    def _joined(self) -> BoolArray:
        """Whether it is known what was shown between each frame and the next, (m - 1,): both show
        the sky, they are near in time, and no jump lies between them.
        """
        turned = np.linalg.norm(self._step, axis=1)
        is_shown = np.isfinite(turned)
        turned = np.nan_to_num(turned)
        max_gap_s = max(MAX_GAP_S, USUAL_INTERVALS * self.interval_s)
        is_near = (self._gap_s <= max_gap_s) & (turned <= MAX_STEP_RAD)
        is_same = turned <= SAME_RAD
        rate = turned / self._gap_s
        before = np.append(0.0, rate[:-1])
        after = np.append(rate[1:], 0.0)
        usual_rate = np.maximum(before, after)
        is_jump = (turned > JUMP_RAD) & (rate > JUMP_RATIO * usual_rate)
        joined = is_shown & (is_near | is_same) & ~is_jump
        return np.asarray(joined)

    @property
    def shown(self) -> BoolArray:
        """Which frames (m,) have an attitude."""
        return np.asarray(np.isfinite(self.q[:, 0]))

    def at(self, t_s: FloatArray) -> Moments:
        """The commanded attitudes and rates at times (n,), s: a cubic through four frames, or the
        great arc between two where neighbours are missing.

        For a trajectory whose angular acceleration changes by j (rad/s^3), frames dt apart, the
        error of the cubic is below j dt^3 / 15, rad.
        """
        last_interval = len(self.t_s) - 2
        frames_before = np.searchsorted(self.t_s, t_s, side="right")
        before = np.clip(frames_before - 1, 0, last_interval)
        in_run = (t_s >= self.t_s[0]) & (t_s <= self.t_s[-1])
        known = in_run & self.joined[before]
        is_known = known[:, None]
        gap_s = self._gap_s[before]
        step = self._step[before]
        since_s = t_s - self.t_s[before]
        share = np.clip(since_s / gap_s, 0, 1)[:, None]
        # Hermite's cubic of the rotation vector from the frame before; at its ends it turns by
        # (step + bend) per interval.
        start = step + self._bend(before, -1)
        end = step + self._bend(before, 1)
        squared = share**2
        cubed = share**3
        of_start = cubed - 2 * squared + share
        of_step = 3 * squared - 2 * cubed
        of_end = cubed - squared
        moved = of_start * start + of_step * step + of_end * end
        # The derivative of each weight by the share.
        of_start = 3 * squared - 4 * share + 1
        of_step = 6 * share - 6 * squared
        of_end = 3 * squared - 2 * share
        speed = of_start * start + of_step * step + of_end * end
        rate = -speed / gap_s[:, None]  # v_cam' = -omega x v_cam
        turn = from_rotation_vectors(np.where(is_known, moved, 0.0))
        q = normalise(multiply(turn, self.q[before]))
        q = np.where(is_known, q, np.nan)
        rate = np.where(is_known, rate, np.nan)
        return Moments(q, rate, known, self._held_about(t_s))

    def over_exposures(self, reach_s: float) -> "Commanded":
        """The same attitudes for moments that stand for exposures: a moment within `reach_s`, s, of
        a held span counts as held.
        """
        if not len(self.held_s):
            return self
        start_s = self.held_s[:, 0] - reach_s
        end_s = self.held_s[:, 1] + reach_s
        # Spans that now overlap become one, so that a moment lies in one span at most.
        is_apart = start_s[1:] > end_s[:-1]
        first = np.flatnonzero(np.append(True, is_apart))
        joint_end_s = np.maximum.reduceat(end_s, first)
        spans_s = np.stack([start_s[first], joint_end_s], axis=1)
        hold_s = np.maximum.reduceat(self.hold_s, first)
        return Commanded(self.t_s, self.q, spans_s, hold_s)

    def _held_about(self, t_s: FloatArray) -> FloatArray:
        """How long, s, a frame stood on the screen in the held span that contains each time (n,); 0
        for a time outside all of them.
        """
        if not len(self.held_s):
            return np.zeros(len(t_s))
        start_s, end_s = self.held_s.T
        span = np.searchsorted(start_s, t_s, side="right") - 1
        inside = (span >= 0) & (t_s <= end_s[span])
        return np.where(inside, self.hold_s[span], 0.0)

    def _bend(self, interval: IntArray, side: int) -> FloatArray:
        """The turn at one end of each interval minus the interval's mean turn, rad per interval
        (n, 3).

        `side` is -1 for the beginning and 1 for the end. Computed as finite differences at the
        frame that the interval shares with its neighbour, weighted for unequal lengths; 0 where the
        neighbour is missing, not joined, or too different in length (UNEVEN).
        """
        last = len(self._step) - 1
        other = interval + side
        near = np.clip(other, 0, last)
        is_there = (other >= 0) & (other <= last)
        ratio = self._gap_s[near] / self._gap_s[interval]
        is_even = (ratio < UNEVEN) & (ratio > 1 / UNEVEN)
        is_usable = is_even & is_there & self.joined[near]
        ratio = ratio[:, None]
        neighbour_turn = self._step[near] / ratio  # in the interval's own time
        change = (neighbour_turn - self._step[interval]) / (1 + ratio)
        return np.where(is_usable[:, None], change, 0.0)
