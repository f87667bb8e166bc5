"""At which ticks a CK is read, and the samples there.

1. Where a segment holds attitudes at given times (types 1 and 3), those are read.
2. Types 2, 4, 5 and 6 are functions of time: they are read at even steps, halved until what is shown between them is off by
   TARGET_RAD at most (and what the clock does not resolve), or MAX_STEPS is reached.
3. Between two pieces of coverage lies a break, unless they touch and their attitudes agree.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from hilstar.arrays import FloatArray
from hilstar.attitude.clock.timeline import Policy, Timeline
from hilstar.attitude.logs.ck.pieces import Piece
from hilstar.attitude.logs.ck.pointing import Structure
from hilstar.attitude.logs.entries import MAX_SAMPLES
from hilstar.attitude.logs.gaps import GAP_INTERVALS, log_joins
from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.errors import InputError
from hilstar.rotation import angle_between_rad

SMOOTH = frozenset({2, 4, 5, 6})
TARGET_RAD = math.radians(1e-3 / 3600)  # 1 mas, a hundredth of the best tracker's error
FIRST_STEPS, MAX_STEPS = 128, 100_000  # of all smooth pieces together: 10 s at 0.1 ms each
PROBES = 200  # places between samples at which the error is looked at
PROBED = (math.sqrt(5) - 1) / 2  # of a step: no symmetry of an interpolation hides its error there
DIFFERENCE_STEPS = 1 / 16  # a rate by difference, whose error h^2 w''/6 is then 1/256 of that over the step
BESIDE_S = 2e-6  # beside a boundary: twenty times what ephemeris time resolves
JUMP_RAD = math.radians(1e-2 / 3600)  # a boundary's attitudes agree within this, and three times the turn in BESIDE_S
ALL = Policy(max_extrapolation_ns=0, stale_after_ns=0)


@dataclass(frozen=True, slots=True)
class Sampled:
    """n attitudes of a structure, and how good they are.

    `t_ns` (n,); `q` (n, 4) is q_icrs_to_body; `rate` (n, 3), rad/s, in the structure's components, NaN where there is none;
    `breaks` (n,) where nothing leads from the one before; `tick` (n,). For segments that are functions of time, the step
    between them, s, and the largest error found between them, rad; the lengths of the gaps of coverage, s.
    """

    t_ns: npt.NDArray[np.int64]
    q: FloatArray
    rate: FloatArray
    breaks: npt.NDArray[np.bool_]
    tick: FloatArray
    step_s: float | None
    error_rad: float
    gaps_s: list[float]


def sample(structure: Structure, pieces: Sequence[Piece]) -> Sampled:
    """The attitudes of pieces in order of time. Raises InputError for more than MAX_SAMPLES of them."""
    smooth = [piece for piece in pieces if piece.segment.kind in SMOOTH and piece.stop > piece.start]
    step = error_rad = 0.0
    if smooth:
        step, error_rad = _step_of(structure, smooth)
    ticks = [_ticks(piece, step) for piece in pieces]
    if sum(map(len, ticks)) > MAX_SAMPLES:
        raise InputError(f"{structure.path}: contains more than {MAX_SAMPLES} attitudes; cut it into several (ckslicer)")
    broken, gaps_s = _parted(structure, pieces, ticks)
    step_s = structure.t_s(smooth[0].start + step) - structure.t_s(smooth[0].start) if smooth else None
    parts = [_attitudes(structure, *pair) for pair in zip(pieces, ticks, strict=True)]
    t_ns, q, rate = (np.concatenate(each) for each in zip(*parts, strict=True))
    breaks = np.zeros(len(t_ns), dtype=np.bool_)
    breaks[np.cumsum([0, *map(len, ticks[:-1])])] = broken
    return Sampled(t_ns, q, rate, breaks, np.concatenate(ticks), step_s, error_rad, gaps_s)


def _ticks(piece: Piece, step: float) -> FloatArray:
    """The ticks at which a piece is read, both ends among them; a long pause between them is filled, as the file covers it."""
    if piece.stop <= piece.start:
        return np.array([piece.start])
    if piece.segment.kind in SMOOTH:
        return np.linspace(piece.start, piece.stop, max(math.ceil((piece.stop - piece.start) / step), 2) + 1)
    ticks = np.concatenate(([piece.start], piece.epochs, [piece.stop]))
    spacing = np.diff(ticks)
    longest = (GAP_INTERVALS - 1) * float(np.median(spacing))
    if piece.segment.kind != 3 or not (spacing > longest).any() or (piece.stop - piece.start) / longest > MAX_STEPS:
        return ticks
    parts = np.ceil(spacing / longest).astype(int).tolist()
    inner = [np.linspace(a, b, n, endpoint=False) for a, b, n in zip(ticks[:-1], ticks[1:], parts, strict=True)]
    return np.concatenate([*inner, ticks[-1:]])


def _step_of(structure: Structure, smooth: Sequence[Piece]) -> tuple[float, float]:
    """The step of the smooth pieces, ticks, and the largest error between samples that far apart, rad."""
    total = sum(piece.stop - piece.start for piece in smooth)
    steps = FIRST_STEPS
    while True:
        step = total / steps
        ticks = [_ticks(piece, step) for piece in smooth]
        counts = np.cumsum([len(each) - 1 for each in ticks])
        error_rad = excess_rad = 0.0
        for place in np.unique(np.linspace(0, counts[-1] - 1, PROBES).astype(int)).tolist():
            k = int(np.searchsorted(counts, place, "right"))
            within = place - (int(counts[k - 1]) if k else 0)
            found_rad, clock_rad = _error_rad(structure, smooth[k], ticks[k], within)
            error_rad, excess_rad = max(error_rad, found_rad), max(excess_rad, found_rad - clock_rad)
        if excess_rad <= TARGET_RAD or 2 * steps > MAX_STEPS:
            return step, error_rad
        steps *= 2


def _error_rad(structure: Structure, piece: Piece, ticks: FloatArray, k: int) -> tuple[float, float]:
    """How far the log's interpolation is off at one place between the ticks k and k + 1 of a piece, rad.

    And the share of it that no step mends: the turn in the time that a double of ephemeris time does not resolve.
    """
    near = [
        AttitudeSample(t_ns, q, rate)
        for t_ns, q, rate in zip(*_attitudes(structure, piece, ticks[max(k - 1, 0) : k + 3]), strict=True)
    ]
    timeline = Timeline(ALL, len(near), log_joins(near))
    for event in near:
        timeline.add(event)
    tick = float(ticks[k] + PROBED * (ticks[k + 1] - ticks[k]))
    shown = timeline.at(structure.t_ns(tick))
    if shown is None or shown.rate_cam_rad_s is None:
        raise AssertionError("a tick between two samples of a piece has an attitude")
    clock_rad = 2.0 * float(np.spacing(abs(structure.t_s(tick))) * np.linalg.norm(shown.rate_cam_rad_s))
    return angle_between_rad(shown.q_icrs_to_cam, structure.q_icrs_to_body(tick)), clock_rad


def _attitudes(structure: Structure, piece: Piece, ticks: FloatArray) -> tuple[npt.NDArray[np.int64], FloatArray, FloatArray]:
    """Times (n,), attitudes (n, 4) and rates (n, 3) of a piece; a smooth segment without rates has them by difference."""
    by_difference = piece.segment.kind in SMOOTH and not piece.segment.has_rate and len(ticks) > 1
    step = float(ticks[1] - ticks[0]) * DIFFERENCE_STEPS if by_difference else 0.0
    t_ns, q = np.empty(len(ticks), dtype=np.int64), np.empty((len(ticks), 4))
    rates = np.full((len(ticks), 3), np.nan)
    for k, tick in enumerate(ticks.tolist()):
        t_ns[k] = structure.t_ns(tick)
        q[k], rate = structure.attitude(tick, piece.segment.has_rate)
        if by_difference:
            rate = structure.rate_by_difference(tick, step, (piece.start, piece.stop))
        if rate is not None:
            rates[k] = rate
    return t_ns, q, rates


def _parted(structure: Structure, pieces: Sequence[Piece], ticks: list[FloatArray]) -> tuple[list[bool], list[float]]:
    """Whether each piece begins with a break, after a gap or a jump, and the lengths of the gaps, s.

    Where two pieces touch, both ends lie on one tick: `ticks` is changed to have one of them, or both beside it.
    """
    broken, gaps_s = [False], []
    for k, (before, after) in enumerate(pairwise(pieces), start=1):
        if before.stop < after.start:
            gaps_s.append(structure.t_s(after.start) - structure.t_s(before.stop))
            broken.append(True)
            continue
        beside = _beside(structure, before, after)
        broken.append(_jumps(structure, before.stop, beside))
        if broken[-1]:
            ticks[k - 1][-1] -= beside
            ticks[k][0] += beside
        else:
            ticks[k - 1] = ticks[k - 1][:-1]
    return broken, gaps_s


def _beside(structure: Structure, before: Piece, after: Piece) -> float:
    """Ticks away from the boundary of two pieces that touch: BESIDE_S, or a part of a shorter piece."""
    s_per_tick = (structure.t_s(after.stop) - structure.t_s(before.start)) / (after.stop - before.start)
    shortest = min(before.stop - before.start, after.stop - after.start)
    return max(min(BESIDE_S / s_per_tick, shortest / 8), 2 * float(np.spacing(before.stop)))


def _jumps(structure: Structure, tick: float, beside: float) -> bool:
    """Whether the attitude jumps at a tick: more than it turns in the same time before it."""
    earlier, before, after = (structure.q_icrs_to_body(tick + n * beside) for n in (-3, -1, 1))
    return angle_between_rad(before, after) > JUMP_RAD + 3 * angle_between_rad(earlier, before)
