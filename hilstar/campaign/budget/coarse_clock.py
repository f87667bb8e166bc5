"""Where telemetry lies on a run's clock, to some tenths of a second, whatever its own clock says.

How fast an attitude turns is the same in every convention of axes and quaternions. So the angular speeds of the run and of the
telemetry are correlated at every offset at once, by Fourier transforms; where the speed does not vary, attitudes
themselves are compared. Of the best offsets the one is taken at which the rotation from the commanded to the reported
attitudes is most nearly constant; of those that are as good, none at all, or the one with the smallest rotation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import fft, optimize

from hilstar.arrays import FloatArray
from hilstar.campaign.budget.commanded import Commanded
from hilstar.rotation import conjugate, multiply

STEP_S = 0.5  # of the grid on which speeds are compared; coarser for slow telemetry
MAX_BINS = 2_000_000
MIN_OVERLAP = 0.1  # of the shorter of the two
MIN_BINS = 8
TRIED = 12  # offsets
COMPARED = 400  # attitudes
SCANNED = 3000  # offsets at which attitudes are compared
AS_GOOD = 1.2  # a spread within this factor of the smallest is as good
SMALL_RAD = 1e-4
MOST = 0.8  # of the attitudes that overlap where most do
TURN_RAD = np.radians(0.5)  # a tracker stands nearly as commanded: a run that repeats itself elsewhere is not taken for it


@dataclass(frozen=True, slots=True)
class CoarseClock:
    """Seconds to add to the telemetry's times, and the median angle, rad, of its attitudes from one rotation then.

    `rotation` (4,) leads from the commanded to the reported attitudes; `compared` are the attitudes that had one.
    """

    offset_s: float
    spread_rad: float
    rotation: FloatArray
    compared: int

    @property
    def turn_rad(self) -> float:
        """The angle of the rotation."""
        return float(2 * np.arctan2(np.linalg.norm(self.rotation[1:]), abs(self.rotation[0])))


def coarse_offset(commanded: Commanded, t_s: FloatArray, reported: FloatArray) -> CoarseClock | None:
    """The offset of telemetry times (n,) with attitudes (n, 4); None where no offset gives an overlap."""
    few = np.unique(np.linspace(0, len(t_s) - 1, COMPARED).astype(int))
    t, q = t_s[few], reported[few]
    found = [_nearby(commanded, t, q, offset, reach) for offset, reach in _candidates(commanded, t_s, reported)]
    tried = [each for each in found if each is not None]
    if not tried:
        return None
    limit = AS_GOOD * min(each.spread_rad for each in tried) + SMALL_RAD
    good = [each for each in tried if each.spread_rad <= limit]
    many = MOST * max(each.compared for each in good)
    good = [each for each in good if each.compared >= many]
    best = min(good, key=lambda each: each.turn_rad)
    as_they_are = _spread_at(commanded, t, q, 0.0)
    if as_they_are is not None and as_they_are.compared >= many and as_they_are.spread_rad <= limit:
        return as_they_are if as_they_are.turn_rad <= best.turn_rad + TURN_RAD else best
    return best


def speed_offsets(commanded: Commanded, t_s: FloatArray, reported: FloatArray) -> FloatArray:
    """The offsets (k,), best first, at which the angular speeds agree, and none at all: they hold in every convention."""
    return np.append(_by_speed(commanded, t_s, reported)[0], 0.0)


def _nearby(commanded: Commanded, t_s: FloatArray, reported: FloatArray, offset_s: float, reach_s: float) -> CoarseClock | None:
    """The best offset within `reach_s` of one."""
    first = _spread_at(commanded, t_s, reported, offset_s)
    if first is None or reach_s == 0:
        return first

    def spread(offset: float) -> float:
        found = _spread_at(commanded, t_s, reported, offset)
        return np.pi if found is None else found.spread_rad

    low, high = offset_s - reach_s, offset_s + reach_s
    better = optimize.minimize_scalar(spread, bounds=(low, high), method="bounded", options={"maxiter": 12})
    found = _spread_at(commanded, t_s, reported, float(better.x))
    return found if found is not None and found.spread_rad < first.spread_rad else first


def _candidates(commanded: Commanded, t_s: FloatArray, reported: FloatArray) -> list[tuple[float, float]]:
    """Offsets worth a look, and how far around each: starts or ends together, and where speeds or attitudes agree."""
    ends = np.array([commanded.t_s[0] - t_s[0], commanded.t_s[-1] - t_s[-1]])
    found = [(float(offset), 0.0) for offset in ends]
    for peaks, reach in (_by_speed(commanded, t_s, reported), _by_attitude(commanded, t_s, reported)):
        found += [(float(offset), reach) for offset in peaks]
    return found


def _spread_at(commanded: Commanded, t_s: FloatArray, reported: FloatArray, offset_s: float) -> CoarseClock | None:
    moments = commanded.at(t_s + offset_s)
    if moments.known.sum() < max(3, MIN_OVERLAP * len(t_s)):
        return None
    rotations = multiply(reported[moments.known], conjugate(moments.q[moments.known]))
    rotation, spread = nearest_to_half(rotations)
    return CoarseClock(offset_s, spread, rotation, int(moments.known.sum()))


def nearest_to_half(rotations: FloatArray, starts: int = 40) -> tuple[FloatArray, float]:
    """The rotation among (n, 4) to which half of all are nearest, and how near, rad."""
    chosen = np.unique(np.linspace(0, len(rotations) - 1, starts).astype(int))
    cosine = np.abs(rotations @ rotations[chosen].T)
    # The chord is exact for tiny angles, where the cosine is not.
    chord = np.sqrt(np.maximum(2 - 2 * cosine, 0))
    half = np.quantile(4 * np.arcsin(np.minimum(chord / 2, 1)), 0.5, axis=0, method="higher")
    best = int(np.argmin(half))
    return rotations[chosen[best]], float(half[best])


def _by_attitude(commanded: Commanded, t_s: FloatArray, reported: FloatArray) -> tuple[FloatArray, float]:
    """The offsets at which attitudes are nearest to the commanded ones, and the step between those tried."""
    few = np.unique(np.linspace(0, len(t_s) - 1, COMPARED // 4).astype(int))
    t, q = t_s[few], reported[few]
    reach = np.linspace(commanded.t_s[0] - t_s[-1], commanded.t_s[-1] - t_s[0], SCANNED)
    angle = np.full(len(reach), np.inf)
    shown = commanded.shown
    frame_s, frame_q = commanded.t_s[shown], commanded.q[shown]
    for k, offset in enumerate(reach):  # the frame after each moment is near enough for a scan
        frame = np.searchsorted(frame_s, t + offset)
        inside = (frame > 0) & (frame < len(frame_s))
        if inside.sum() >= max(3, MIN_OVERLAP * len(t)):
            cosine = np.abs((q[inside] * frame_q[frame[inside]]).sum(axis=1))
            angle[k] = float(np.median(1 - np.minimum(cosine, 1)))
    return _peaks(-angle, reach), float(reach[1] - reach[0])


def _by_speed(commanded: Commanded, t_s: FloatArray, reported: FloatArray) -> tuple[FloatArray, float]:
    """The offsets at which angular speeds correlate best, and the step of the grid."""
    cycle_s = float(np.median(np.diff(t_s))) if len(t_s) > 1 else 0.0
    step_s = max(STEP_S, 2 * cycle_s, 2 * commanded.interval_s)
    spans = commanded.t_s[-1] - commanded.t_s[0], t_s[-1] - t_s[0]
    step_s = max(step_s, max(spans) / MAX_BINS)
    shown = commanded.shown
    of_run = _speeds(commanded.t_s[shown], commanded.q[shown], step_s, commanded.t_s[0], spans[0])
    of_tracker = _speeds(t_s, reported, step_s, t_s[0], spans[1])
    if min(len(of_run), len(of_tracker)) < MIN_BINS:
        return np.zeros(0), step_s
    score, lag = _correlation(of_run, of_tracker)
    return _peaks(score, commanded.t_s[0] - t_s[0] + step_s * lag), step_s


def _speeds(t_s: FloatArray, q: FloatArray, step_s: float, start_s: float, span_s: float) -> FloatArray:
    """The median angular speed, rad/s, in each bin of a grid, over turns that last about one step; NaN without any."""
    bins = int(span_s / step_s) + 1
    after = np.searchsorted(t_s, t_s + step_s)
    inside = after < len(t_s)
    before, after = np.flatnonzero(inside), after[inside]
    gap_s = t_s[after] - t_s[before]
    cosine = np.minimum(np.abs((q[before] * q[after]).sum(axis=1)), 1)
    chord = np.sqrt(2 - 2 * cosine)
    speed = 4 * np.arcsin(np.minimum(chord / 2, 1)) / gap_s
    place = np.clip((((t_s[before] + t_s[after]) / 2 - start_s) / step_s).astype(int), 0, bins - 1)
    good = gap_s < 3 * step_s
    place, speed = place[good], speed[good]
    order = np.lexsort((speed, place))
    place, speed = place[order], speed[order]
    first = np.searchsorted(place, np.arange(bins))
    count = np.searchsorted(place, np.arange(bins), side="right") - first
    median = np.full(bins, np.nan)
    filled = count > 0
    median[filled] = speed[(first + count // 2)[filled]]
    return median


def _correlation(a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
    """How well b explains a when it begins `lag` bins after it: bins in common times the information in each of them."""
    size = fft.next_fast_len(len(a) + len(b), real=True)
    weight_a, weight_b = np.isfinite(a).astype(float), np.isfinite(b).astype(float)
    # A wild pair of answers turns at any speed: what no run does is cut off.
    limit = 2 * float(np.nanmax(a, initial=0.0)) + 1e-12
    a, b = np.nan_to_num(a), np.minimum(np.nan_to_num(b), limit)
    mean = float(a.sum() / max(weight_a.sum(), 1))
    a, b = (a - mean) * weight_a, (b - mean) * weight_b

    def over_lags(x: FloatArray, y: FloatArray) -> FloatArray:
        return np.asarray(fft.irfft(fft.rfft(x, size) * np.conj(fft.rfft(y, size)), size))

    count = np.maximum(np.rint(over_lags(weight_a, weight_b)), 0)
    sum_a, sum_b = over_lags(a, weight_b), over_lags(weight_a, b)
    with np.errstate(divide="ignore", invalid="ignore"):
        covariance = over_lags(a, b) - sum_a * sum_b / count
        spread_a = over_lags(a * a, weight_b) - sum_a**2 / count
        spread_b = over_lags(weight_a, b * b) - sum_b**2 / count
        floor = 1e-9 * max(float((a * a).sum()), 1e-300)
        r = np.where((spread_a > floor) & (spread_b > floor), covariance / np.sqrt(spread_a * spread_b), 0.0)
    enough = count >= max(MIN_BINS, MIN_OVERLAP * min(weight_a.sum(), weight_b.sum()))
    r = np.clip(np.where(enough, np.nan_to_num(r), 0.0), 0.0, 1 - 1e-9)
    lag = np.arange(size)
    return -count * np.log1p(-(r**2)), np.where(lag < len(a), lag, lag - size)


def _peaks(score: FloatArray, at: FloatArray) -> FloatArray:
    """Where a score is largest, best first, and no two of them neighbours."""
    order = np.argsort(at)
    score, at = score[order], at[order]
    inner = np.r_[-np.inf, score, -np.inf]
    peak = np.flatnonzero((score >= inner[:-2]) & (score >= inner[2:]) & np.isfinite(score))
    return at[peak[np.argsort(-score[peak])][:TRIED]]
