"""How a log's samples join: its own usual interval says what a gap is, never the stale limit of a live stream.

1. Before a discontinuity the attitude is held.
2. Two samples whose rates fit the turn between them are blended, however long the interval.
3. Other samples are joined by SLERP, the shorter way.
4. But an interval of more than GAP_INTERVALS usual ones is a gap: the attitude within it is unknown, and is held.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hilstar.arrays import FloatArray
from hilstar.attitude.clock.rate_check import cause_in
from hilstar.attitude.clock.timeline import Join
from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.rotation import conjugate, multiply
from hilstar.units import NS_PER_S

GAP_INTERVALS = 5  # usual (median) intervals; four packets lost in a row are not a gap
# Rates fit where their mean turns one attitude into the other within this share of the turn. For a sine the mean is off by
# (2 pi / samples per period)^2 / 12: seven samples per period still fit.
FIT_SHARE, GAP_FIT_SHARE = 0.2, 0.02
FIT_RAD, GAP_FIT_RAD = 0.5, np.radians(1.0)  # and at most this: after many turns a share of them means nothing
ALIKE_RAD = np.radians(1 / 3600)  # this close, all ways of joining agree
LOOKED_AT = 2000  # samples, for the cause of rates that do not fit
NO_GAPS: frozenset[int] = frozenset()


@dataclass(frozen=True, slots=True)
class LogJoins:
    """How each sample of a log joins the next, and what the user must know of it; the sets hold the earlier sample's t_ns."""

    blended_ns: frozenset[int] = NO_GAPS
    held_ns: frozenset[int] = NO_GAPS
    usual_s: float = 0.0
    longest_s: float = 0.0
    misfits: int = 0
    cause: str = ""

    def __call__(self, before: AttitudeSample, after: AttitudeSample) -> Join:
        """How a timeline joins two successive samples."""
        if after.discontinuity or before.t_ns in self.held_ns:
            return "hold"
        return "blend" if before.t_ns in self.blended_ns else "slerp"

    @property
    def told(self) -> list[tuple[str, str]]:
        """The kind and the text of each notice for the user."""
        lines = []
        if self.held_ns:
            gaps = "1 gap" if len(self.held_ns) == 1 else f"{len(self.held_ns)} gaps"
            sizes = f"the longest {self.longest_s:.6g} s (over {GAP_INTERVALS} times its usual {self.usual_s:.6g} s)"
            lines.append(("log-gap", f"the log has {gaps}, {sizes}; the attitude is held there"))
        if self.misfits:
            misfits = f"in {self.misfits} intervals the log's rates do not fit its attitudes"
            why = f"; probably {self.cause}" if self.cause else ""
            lines.append(("log-rates", f"{misfits}, and are ignored there{why}"))
        return lines


def log_joins(samples: Sequence[AttitudeSample]) -> LogJoins:
    """How the samples of a log join; their times must increase."""
    if len(samples) < 2:
        return LogJoins()
    t_ns = np.array([sample.t_ns for sample in samples], dtype=object)
    seconds = np.asarray(np.diff(t_ns) / NS_PER_S, dtype=np.float64)
    usual_s = float(np.median(seconds))
    gap = seconds > GAP_INTERVALS * usual_s
    known, fits = _fits(samples, seconds, gap)
    broken = np.array([sample.discontinuity for sample in samples[1:]])
    held = gap & ~fits & ~broken
    misfit = known & ~fits & ~broken & ~gap
    cause = ""
    if misfit.any():  # what is probably wrong with the rates from the first one on that does not fit
        first = int(misfit.argmax())
        found = cause_in([sample for sample in samples[first : first + LOOKED_AT] if sample.rate_cam_rad_s is not None])
        cause = "" if found is None else found.text
    return LogJoins(
        frozenset(t_ns[:-1][fits & ~broken].tolist()),
        frozenset(t_ns[:-1][held].tolist()),
        usual_s,
        float(seconds[held].max(initial=0.0)),
        int(misfit.sum()),
        cause,
    )


def _fits(
    samples: Sequence[AttitudeSample], seconds: FloatArray, gap: npt.NDArray[np.bool_]
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
    """Two masks (n,) over intervals: both samples have rates; and those fit the turn between them."""
    nothing = np.full(3, np.nan)
    rate = np.array([nothing if s.rate_cam_rad_s is None else s.rate_cam_rad_s for s in samples])
    q = np.array([sample.q_icrs_to_cam for sample in samples])
    mean = (rate[1:] + rate[:-1]) / 2
    known = np.isfinite(mean).all(axis=1)
    turned_rad = seconds * (np.linalg.norm(rate[1:], axis=1) + np.linalg.norm(rate[:-1], axis=1)) / 2
    vector = -0.5 * seconds[:, None] * mean
    half = np.linalg.norm(vector, axis=1)
    step = np.column_stack((np.cos(half), np.sinc(half / np.pi)[:, None] * vector))
    rest = multiply(multiply(q[1:], conjugate(q[:-1])), conjugate(step))
    off_rad = 2 * np.arctan2(np.linalg.norm(rest[:, 1:], axis=1), np.abs(rest[:, 0]))
    share, most_rad = np.where(gap, GAP_FIT_SHARE, FIT_SHARE), np.where(gap, GAP_FIT_RAD, FIT_RAD)
    return known, known & (off_rad <= np.minimum(share * turned_rad, most_rad) + ALIKE_RAD)
