"""The tracker's clock against the run's: a coarse offset from angular speeds, then clock and bias
together.

**Coarse**, to some tenths of a second. The angular speed of an attitude is the same in every
convention of axes and quaternions. So the speeds of the run and of the telemetry are correlated at
every offset at once, by Fourier transforms; where the speed does not vary, the attitudes themselves
are compared. The best offset is the one at which the rotation from commanded to reported attitudes
is most nearly constant. Of offsets as good as that, zero is preferred, then the smallest rotation.

**Fine.** With tau the telemetry's time and t the run's, tau = t + o + d (t - t_0). Reading the run
at t' = t + delta adds omega delta to the residual e of T C(t')*, so that

    e_i = b + omega_i (delta_0 + delta_1 s_i) + f(place_i) + n_i,        s = (t - t_0) / T

is linear in bias and clock. They are first fitted robustly without f (Tukey's weights: Beaton and
Tukey 1974). Then f is a random function of the place, a sum of bumps of variance kappa sigma^2,
with the kappa and the spacing under which the residuals are most likely. Bias and clock are the
generalised least squares estimate (Aitken 1935) under its covariance. So an error that repeats with
the place is not taken for a clock, and a clock not for such an error.

An answer whose exposure touches a frame that was held for missed ones saw another sky than the
commanded one. It is in no fit.
"""

from dataclasses import dataclass

import numpy as np
from scipy import fft, linalg, optimize, sparse
from scipy.spatial import cKDTree

from hilstar.basics.arrays import BoolArray, FloatArray
from hilstar.basics.rotation import (
    conjugate,
    from_rotation_vector,
    multiply,
    normalise,
    to_matrix,
    to_rotation_vector,
)
from hilstar.basics.units import ARCSEC_PER_RAD, MAD_TO_SIGMA, NS_PER_S
from hilstar.instruments.assess.places import (
    Scale,
    bumps_at,
    centres_of,
    places_of,
    spread_rows,
)
from hilstar.server.record.commanded import Commanded, Moments

# Coarse.
STEP_S = 0.5  # step of the grid on which speeds are compared; larger for slow telemetry
MAX_BINS, MIN_BINS = 2_000_000, 8
MIN_OVERLAP = 0.1  # smallest overlap, as a share of the shorter recording
TRIED = 12  # offsets tried
COMPARED = 400  # attitudes compared at each
STARTS = 40  # rotations that are tried as the one with half of all nearest to it
SCANNED = 3000  # offsets of the scan by attitudes
# a spread up to this factor and this angle above the smallest is as good
AS_GOOD, SMALL_RAD = 1.2, 1e-4
OVERLAP_SHARE = 0.8  # offsets with a smaller share of the largest overlap are dropped
# a tracker reports nearly the commanded attitude; a run that repeats itself elsewhere does not
TURN_RAD = np.radians(0.5)
# Fine.
CUT_SIGMAS = 8.0
AGREE_ARCSEC = 3600.0  # an answer further from the others is of another sky, whatever their spread
ROUNDS, REFINED = 40, 3
MIN_USED = 5  # answers, as many as the fit has unknowns
PART_PX = 150.0  # size of the parts of the field whose errors are compared for the clock's sigma
# Prior sigmas of the clock; it is told once its sigma is below TOLD of them.
OFFSET_PRIOR_S, DRIFT_PRIOR, TOLD = 10.0, 2e-3, 0.3
DONE_ARCSEC = 1e-4
FLOOR_ARCSEC = 1e-3
MAX_BUMPS = 1000
MIN_SPACING_PX, MAX_SPACING_PX = 20.0, 1300.0
KAPPAS = np.logspace(-5, 4, 37)


@dataclass(frozen=True, slots=True)
class CoarseClock:
    """Seconds to add to the telemetry's times, and how nearly its attitudes then follow the
    commanded ones.

    `rotation` (4,) leads from the commanded to the reported attitudes, half of which lie within
    `spread_rad` of it. `compared` counts the attitudes with a commanded one.
    """

    offset_s: float
    spread_rad: float
    rotation: FloatArray
    compared: int

    @property
    def turn_rad(self) -> float:
        """The angle of the rotation."""
        sine = np.linalg.norm(self.rotation[1:])
        cosine = abs(self.rotation[0])
        return float(2 * np.arctan2(sine, cosine))


def coarse_offset(
    commanded: Commanded, t_s: FloatArray, reported: FloatArray
) -> CoarseClock | None:
    """The coarse offset of telemetry with times (n,) and attitudes (n, 4); None where no offset
    gives an overlap.
    """
    few = spread_rows(len(t_s), COMPARED)
    t = t_s[few]
    q = reported[few]
    # Starts or ends together, and where speeds or attitudes agree.
    starts_s = float(commanded.t_s[0] - t_s[0])
    ends_s = float(commanded.t_s[-1] - t_s[-1])
    places = [(starts_s, 0.0), (ends_s, 0.0)]
    for search in (_by_speed, _by_attitude):
        peaks, reach_s = search(commanded, t_s, reported)
        places += [(offset_s, reach_s) for offset_s in peaks.tolist()]
    tried = []
    for offset_s, reach_s in places:
        clock = _spread_at(commanded, t, q, offset_s)
        if clock is not None:
            tried.append((clock, reach_s))
    if not tried:
        return None
    known = _refined(commanded, t, q, tried)
    smallest_rad = min(clock.spread_rad for clock in known)
    limit = AS_GOOD * smallest_rad + SMALL_RAD
    good = [clock for clock in known if clock.spread_rad <= limit]
    largest = max(clock.compared for clock in good)
    many = OVERLAP_SHARE * largest
    good = [clock for clock in good if clock.compared >= many]
    best = min(good, key=lambda clock: clock.turn_rad)
    as_they_are = _spread_at(commanded, t, q, 0.0)
    if as_they_are is None or as_they_are.compared < many or as_they_are.spread_rad > limit:
        return best
    if as_they_are.turn_rad <= best.turn_rad + TURN_RAD:
        return as_they_are
    return best


def speed_offsets(commanded: Commanded, t_s: FloatArray, reported: FloatArray) -> FloatArray:
    """Offsets (k,), s, at which the angular speeds agree, best first, and zero. They hold in
    every convention.
    """
    offsets_s, _ = _by_speed(commanded, t_s, reported)
    return np.append(offsets_s, 0.0)


def _refined(
    commanded: Commanded,
    t_s: FloatArray,
    reported: FloatArray,
    tried: list[tuple[CoarseClock, float]],
) -> list[CoarseClock]:
    """The best offset within reach, s, of each that was tried, where that may be as good as the
    best of them.

    Within its reach an offset moves no attitude by more than the fastest turn of the run, and the
    angle between two by twice as much. An attitude is held until the next frame.
    """
    frame_q = commanded.q[commanded.shown]
    interval_s = np.diff(commanded.t_s[commanded.shown])
    turns_rad = to_rotation_vector(multiply(frame_q[1:], conjugate(frame_q[:-1])))
    rates_rad_s = np.linalg.norm(turns_rad, axis=1) / np.maximum(interval_s, 1 / NS_PER_S)
    fastest_rad_s = float(rates_rad_s.max(initial=0.0))
    held_s = float(interval_s.max(initial=0.0))
    smallest_rad = min(clock.spread_rad for clock, _ in tried)
    limit_rad = AS_GOOD * smallest_rad + SMALL_RAD
    refined = []
    for clock, reach_s in tried:
        better_rad = 2 * fastest_rad_s * (reach_s + held_s)
        if reach_s > 0 and clock.spread_rad - better_rad <= limit_rad:
            clock = _nearby(commanded, t_s, reported, clock, reach_s)
        refined.append(clock)
    return refined


def _nearby(
    commanded: Commanded,
    t_s: FloatArray,
    reported: FloatArray,
    first: CoarseClock,
    reach_s: float,
) -> CoarseClock:
    """The best offset within reach of one, or that."""

    def spread(offset: float) -> float:
        clock = _spread_at(commanded, t_s, reported, offset)
        if clock is None:
            return np.pi
        return clock.spread_rad

    bounds = (first.offset_s - reach_s, first.offset_s + reach_s)
    better = optimize.minimize_scalar(
        spread, bounds=bounds, method="bounded", options={"maxiter": 12}
    )
    best = _spread_at(commanded, t_s, reported, float(better.x))
    if best is not None and best.spread_rad < first.spread_rad:
        return best
    return first


def _spread_at(
    commanded: Commanded, t_s: FloatArray, reported: FloatArray, offset_s: float
) -> CoarseClock | None:
    moments = commanded.at(t_s + offset_s)
    known = moments.known
    compared = int(known.sum())
    if compared < max(3, MIN_OVERLAP * len(t_s)):
        return None
    back = conjugate(moments.q[known])
    rotations = multiply(reported[known], back)
    rotation, spread_rad = nearest_to_half(rotations)
    return CoarseClock(offset_s, spread_rad, rotation, compared)


def nearest_to_half(rotations: FloatArray) -> tuple[FloatArray, float]:
    """The rotation among (n, 4) about which half of all lie within the smallest angle, and that
    angle, rad.
    """
    starts = rotations[spread_rows(len(rotations), STARTS)]
    cosine = np.abs(rotations @ starts.T)
    # The chord is exact for tiny angles, where the cosine is not.
    chord = np.sqrt(np.maximum(2 - 2 * cosine, 0))
    sine = np.minimum(chord / 2, 1)
    angle_rad = 4 * np.arcsin(sine)
    half_rad = np.quantile(angle_rad, 0.5, axis=0, method="higher")
    best = int(np.argmin(half_rad))
    return starts[best], float(half_rad[best])


def _by_attitude(
    commanded: Commanded, t_s: FloatArray, reported: FloatArray
) -> tuple[FloatArray, float]:
    """The offsets at which attitudes are nearest to the commanded ones, and the step of the
    scan.
    """
    few = spread_rows(len(t_s), COMPARED // 4)
    t = t_s[few]
    q = reported[few]
    first_s = commanded.t_s[0] - t_s[-1]
    last_s = commanded.t_s[-1] - t_s[0]
    reach = np.linspace(first_s, last_s, SCANNED)
    shown = commanded.shown
    frame_s = commanded.t_s[shown]
    frame_q = commanded.q[shown]
    # The frame after each moment is near enough for a scan.
    frame = np.searchsorted(frame_s, t + reach[:, None])
    inside = (frame > 0) & (frame < len(frame_s))
    enough = inside.sum(axis=1) >= max(3, MIN_OVERLAP * len(t))
    commanded_q = frame_q[np.minimum(frame[enough], len(frame_s) - 1)]
    cosine = np.abs(np.einsum("onk,nk->on", commanded_q, q))
    away = np.where(inside[enough], 1 - np.minimum(cosine, 1), np.nan)
    angle = np.full(len(reach), np.inf)
    angle[enough] = np.nanmedian(away, axis=1)
    step_s = float(reach[1] - reach[0])
    return _peaks(-angle, reach), step_s


def _by_speed(
    commanded: Commanded, t_s: FloatArray, reported: FloatArray
) -> tuple[FloatArray, float]:
    """The offsets at which angular speeds correlate best, and the step of the grid."""
    if len(t_s) > 1:
        cycle_s = float(np.median(np.diff(t_s)))
    else:
        cycle_s = 0.0
    run_start_s = commanded.t_s[0]
    start_s = t_s[0]
    run_span_s = commanded.t_s[-1] - run_start_s
    span_s = t_s[-1] - start_s
    step_s = max(STEP_S, 2 * cycle_s, 2 * commanded.interval_s)
    step_s = max(step_s, max(run_span_s, span_s) / MAX_BINS)
    shown = commanded.shown
    frame_s = commanded.t_s[shown]
    of_run = _speeds(frame_s, commanded.q[shown], step_s, run_start_s, run_span_s)
    of_tracker = _speeds(t_s, reported, step_s, start_s, span_s)
    if min(len(of_run), len(of_tracker)) < MIN_BINS:
        return np.zeros(0), step_s
    score, lag = _correlation(of_run, of_tracker)
    offset_s = run_start_s - start_s + step_s * lag
    return _peaks(score, offset_s), step_s


def _speeds(
    t_s: FloatArray, q: FloatArray, step_s: float, start_s: float, span_s: float
) -> FloatArray:
    """The median angular speed, rad/s, in each bin of a grid, over turns of about one step; NaN
    in an empty bin.
    """
    bins = int(span_s / step_s) + 1
    after = np.searchsorted(t_s, t_s + step_s)
    inside = after < len(t_s)
    before = np.flatnonzero(inside)
    after = after[inside]
    gap_s = t_s[after] - t_s[before]
    cosine = np.abs((q[before] * q[after]).sum(axis=1))
    chord = np.sqrt(2 - 2 * np.minimum(cosine, 1))
    sine = np.minimum(chord / 2, 1)
    speed = 4 * np.arcsin(sine) / gap_s
    middle_s = (t_s[before] + t_s[after]) / 2
    steps = (middle_s - start_s) / step_s
    place = np.clip(steps.astype(int), 0, bins - 1)
    good = gap_s < 3 * step_s
    place = place[good]
    speed = speed[good]
    order = np.lexsort((speed, place))
    place = place[order]
    speed = speed[order]
    numbers = np.arange(bins)
    first = np.searchsorted(place, numbers)
    count = np.searchsorted(place, numbers, side="right") - first
    median = np.full(bins, np.nan)
    filled = count > 0
    middle = first + count // 2
    median[filled] = speed[middle[filled]]
    return median


def _correlation(a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
    """How well b, begun `lag` bins after a, explains it: common bins times the information per
    bin; and the lags.
    """
    size = fft.next_fast_len(len(a) + len(b), real=True)
    weight_a = np.isfinite(a).astype(float)
    weight_b = np.isfinite(b).astype(float)
    # A wild pair of answers turns at any speed: speeds above twice the run's largest are clipped.
    limit = 2 * float(np.nanmax(a, initial=0.0)) + 1e-12
    a = np.nan_to_num(a)
    b = np.minimum(np.nan_to_num(b), limit)
    mean = float(a.sum() / max(weight_a.sum(), 1))
    a = (a - mean) * weight_a
    b = (b - mean) * weight_b

    def over_lags(x: FloatArray, y: FloatArray) -> FloatArray:
        spectrum_x = fft.rfft(x, size)
        spectrum_y = fft.rfft(y, size)
        return np.asarray(fft.irfft(spectrum_x * np.conj(spectrum_y), size))

    count = np.maximum(np.rint(over_lags(weight_a, weight_b)), 0)
    sum_a = over_lags(a, weight_b)
    sum_b = over_lags(weight_a, b)
    with np.errstate(divide="ignore", invalid="ignore"):
        covariance = over_lags(a, b) - sum_a * sum_b / count
        spread_a = over_lags(a * a, weight_b) - sum_a**2 / count
        spread_b = over_lags(weight_a, b * b) - sum_b**2 / count
        power_a = float((a * a).sum())
        floor = 1e-9 * max(power_a, 1e-300)
        varies = (spread_a > floor) & (spread_b > floor)
        r = covariance / np.sqrt(spread_a * spread_b)
        r = np.where(varies, r, 0.0)
    fewer = min(weight_a.sum(), weight_b.sum())
    enough = count >= max(MIN_BINS, MIN_OVERLAP * fewer)
    r = np.where(enough, np.nan_to_num(r), 0.0)
    r = np.clip(r, 0.0, 1 - 1e-9)
    information = -count * np.log1p(-(r**2))
    lag = np.arange(size)
    return information, np.where(lag < len(a), lag, lag - size)


def _peaks(score: FloatArray, at: FloatArray) -> FloatArray:
    """The places of a score's highest peaks, best first."""
    order = np.argsort(at)
    score = score[order]
    at = at[order]
    inner = np.r_[-np.inf, score, -np.inf]
    rises = score >= inner[:-2]
    falls = score >= inner[2:]
    peak = np.flatnonzero(rises & falls & np.isfinite(score))
    best_first = np.argsort(-score[peak])
    highest = peak[best_first][:TRIED]
    return at[highest]


@dataclass(frozen=True)
class ClockFit:
    """The clock, the bias (a rotation (4,) from commanded to reported), and which answers (n,) are
    of this sky.

    `offset_s` is the telemetry's time minus the run's at the run's start, `drift` the excess rate
    of its clock, `sigma_*` one sigma, `*_told` whether the motion determines it.
    `residual_arcsec` (n, 3), cam, is the error beyond bias and clock at the commanded `moments`;
    NaN where those are not known.
    """

    offset_s: float
    drift: float
    sigma_offset_s: float
    sigma_drift: float
    sigma_bias_arcsec: FloatArray
    rotation: FloatArray
    moments: Moments
    t_s: FloatArray
    residual_arcsec: FloatArray
    used: BoolArray
    offset_told: bool
    drift_told: bool

    def run_s(self, tau_s: FloatArray, start_s: float) -> FloatArray:
        """Times (n,) of the telemetry's clock on that of a run that began at `start_s`, s."""
        return start_s + (tau_s - self.offset_s - start_s) / (1 + self.drift)


class ClockSolver:
    """Fits bias and clock of telemetry with times (n,), s, and attitudes (n, 4) to the commanded
    attitudes.

    t = tau - delay_s - stretch_s share, with the share of the run in [0, 1]; `rotation` (4,) is the
    bias.
    """

    def __init__(
        self, commanded: Commanded, tau_s: FloatArray, reported: FloatArray, scale: Scale
    ) -> None:
        self.commanded = commanded
        self.tau_s = tau_s
        self.reported = reported
        self.scale = scale
        self.start_s = float(commanded.t_s[0])
        self.span_s = max(float(commanded.t_s[-1]) - self.start_s, 1e-9)

    def fit(self, coarse: CoarseClock) -> ClockFit:
        """The fit, begun at a coarse clock."""
        self.rotation = coarse.rotation
        self.delay_s = -coarse.offset_s
        self.stretch_s = 0.0
        self._align()
        used = self._robust(-coarse.offset_s)
        precision, _ = self._prior(0.0)
        loose = np.diag([1.0, 1.0, 1.0, 0.0, 0.0]) / AGREE_ARCSEC**2
        covariance = np.linalg.inv(precision + loose)
        for _ in range(REFINED):
            used = used & self.free
            if used.sum() < MIN_USED:
                break
            covariance = self._refine(used, -coarse.offset_s)
        stretch = self.stretch_s / self.span_s
        sigma = np.sqrt(np.diag(covariance))
        return ClockFit(
            # tau - delay - stretch (tau - delay - start) / span = start gives tau = start + delay
            offset_s=self.delay_s,
            drift=stretch / (1 - stretch),
            sigma_offset_s=float(sigma[3]),
            sigma_drift=float(sigma[4]) / self.span_s,
            sigma_bias_arcsec=sigma[:3],
            rotation=self.rotation,
            moments=self.moments,
            t_s=self.t_s,
            residual_arcsec=self.residual,
            used=used,
            offset_told=bool(sigma[3] < TOLD * OFFSET_PRIOR_S),
            drift_told=bool(sigma[4] < TOLD * DRIFT_PRIOR * self.span_s),
        )

    def _align(self, step: FloatArray | None = None) -> None:
        """Take a step (5,) of bias, arcsec, delay and stretch, and find the run's times and the
        residuals there.
        """
        if step is not None:
            turn = from_rotation_vector(step[:3] / ARCSEC_PER_RAD)
            self.rotation = normalise(multiply(turn, self.rotation))
            self.delay_s += float(step[3])
            self.stretch_s += float(step[4])
        plain = self.tau_s - self.delay_s
        self.share = (plain - self.start_s) / self.span_s
        self.t_s = plain - self.stretch_s * self.share
        self.moments = self.commanded.at(self.t_s)
        known = self.moments.known
        self.free = known & (self.moments.held_s == 0)
        reported_from_commanded = multiply(self.reported, conjugate(self.moments.q))
        turn = multiply(reported_from_commanded, conjugate(self.rotation))
        turn_rad = to_rotation_vector(turn[known])
        self.residual = np.full((len(self.t_s), 3), np.nan)
        self.residual[known] = ARCSEC_PER_RAD * turn_rad

    def _design(self, rows: BoolArray) -> FloatArray:
        """The change of the residuals per unit of bias (arcsec), delay and stretch (s): (3,
        rows, 5), arcsec.
        """
        omega = ARCSEC_PER_RAD * self.moments.rate_rad_s[rows]
        design = np.zeros((3, int(rows.sum()), 5))
        for axis in range(3):
            design[axis, :, axis] = 1.0
            design[axis, :, 3] = omega[:, axis]
            design[axis, :, 4] = omega[:, axis] * self.share[rows]
        return design

    def _prior(self, delay_s: float) -> tuple[FloatArray, FloatArray]:
        """The prior's precision (5, 5), and its pull (5,) towards it."""
        of_delay = 1 / OFFSET_PRIOR_S**2
        of_stretch = 1 / (DRIFT_PRIOR * self.span_s) ** 2
        precision = np.array([0, 0, 0, of_delay, of_stretch])
        away = np.array([0, 0, 0, delay_s - self.delay_s, -self.stretch_s])
        return np.diag(precision), precision * away

    def _robust(self, begun_s: float) -> BoolArray:
        """Bias and clock by Tukey's weights, scaled for each axis; which answers (n,) are not
        wild.
        """
        for _ in range(ROUNDS):
            rows = self.free
            residual = self.residual[self.free]
            if rows.sum() < MIN_USED:
                break
            sigma, weight = weights_of(residual)
            if (weight > 0).sum() < MIN_USED:  # no one rotation: the caller refuses them
                break
            design = self._design(rows)
            normal, right = self._prior(begun_s)
            for axis in range(3):
                scaled = design[axis] * (weight / sigma[axis] ** 2)[:, None]
                normal = normal + scaled.T @ design[axis]
                right = right + scaled.T @ residual[:, axis]
            step = np.asarray(np.linalg.solve(normal, right), dtype=np.float64)
            self._align(step)
            bias_step = np.abs(step[:3]).max()
            clock_step = 1e3 * np.abs(step[3:]).max()
            if max(bias_step, clock_step) < DONE_ARCSEC:
                break
        used: BoolArray = self.free.copy()
        if used.sum() >= MIN_USED:
            _, weight = weights_of(self.residual[self.free])
            used[self.free] = weight > 0
        return used

    def _refine(self, used: BoolArray, begun_s: float) -> FloatArray:
        """One generalised least squares step; its covariance (5, 5)."""
        design = self._design(used)
        residual = self.residual[used]
        axes = to_matrix(self.moments.q[used])
        place = places_of(axes, self.scale.focal_px, self.scale.roll_px)
        normal, right = self._prior(begun_s)
        smooth = most_likely(place, residual)
        pulls = np.zeros((len(residual), 5))
        for axis in range(3):
            columns = np.column_stack([design[axis], residual[:, axis]])
            whitened = smooth.whiten(columns, axis)
            white_design = whitened[:, :5]
            normal = normal + design[axis].T @ white_design
            right = right + design[axis].T @ whitened[:, 5]
            pulls += white_design * residual[:, axis : axis + 1]
        covariance = np.asarray(np.linalg.inv(normal), dtype=np.float64)
        self._align(covariance @ right)
        return honest(covariance, pulls, place)


def honest(covariance: FloatArray, pulls: FloatArray, place: FloatArray) -> FloatArray:
    """A covariance (5, 5) whose sigmas are at least those by which parts of the field differ.

    `pulls` (n, 5) are the answers' terms in the normal equations. An error that lasts longer than
    the random function allows pulls neighbours the same way (Liang and Zeger 1986).
    """
    centre = centres_of(place, PART_PX)
    _, part = cKDTree(centre).query(place)
    parts = len(centre)
    columns = []
    for column in pulls.T:
        columns.append(np.bincount(part, column, minlength=parts))
    sums = np.stack(columns, axis=1)
    sums = sums - sums.mean(axis=0)
    spread = covariance @ (sums.T @ sums) @ covariance
    ratio = np.diag(spread) / np.diag(covariance)
    growth = np.sqrt(np.maximum(ratio, 1.0))
    return np.asarray(covariance * np.outer(growth, growth))


def weights_of(residual_arcsec: FloatArray) -> tuple[FloatArray, FloatArray]:
    """One sigma (3,) by the median deviation, and Tukey's weights (n,) of residuals (n, 3); 0
    for a wild answer.
    """
    off = residual_arcsec - np.median(residual_arcsec, axis=0)
    deviation = np.median(np.abs(off), axis=0)
    sigma = np.maximum(MAD_TO_SIGMA * deviation, FLOOR_ARCSEC)
    squared = ((off / sigma) ** 2).sum(axis=1)
    squared_arcsec2 = (off**2).sum(axis=1)
    near = (squared < CUT_SIGMAS**2) & (squared_arcsec2 < AGREE_ARCSEC**2)
    weight = (1 - squared / CUT_SIGMAS**2) ** 2
    return sigma, np.where(near, weight, 0.0)


@dataclass(frozen=True)
class Smooth:
    """A random function of the place and white noise, with `kappa` (3,) and `variance` (3,),
    arcsec^2, of each axis.

    `turn` (p, p) and `square` (p,) are the eigenvectors and eigenvalues of the bumps' normal
    matrix.
    """

    bumps: sparse.csr_matrix | None
    turn: FloatArray
    square: FloatArray
    kappa: FloatArray
    variance: FloatArray

    def whiten(self, columns: FloatArray, axis: int) -> FloatArray:
        """An axis's inverse covariance times columns (n, k)."""
        if self.bumps is None or self.kappa[axis] == 0:
            return np.asarray(columns / self.variance[axis])
        kappa = self.kappa[axis]
        share = kappa / (1 + kappa * self.square)
        turned = self.turn.T @ (self.bumps.T @ columns)
        inner = self.turn @ (share[:, None] * turned)
        rest = columns - self.bumps @ inner
        return np.asarray(rest / self.variance[axis])


def most_likely(place: FloatArray, residual: FloatArray) -> Smooth:
    """The spacing, and each axis's variances, under which residuals (n, 3) about their mean are
    most likely.
    """
    centred = residual - residual.mean(axis=0)
    n = len(centred)
    power = np.maximum((centred**2).mean(axis=0), FLOOR_ARCSEC**2)
    best = Smooth(None, np.zeros((0, 0)), np.zeros(0), np.zeros(3), power)
    likely = -0.5 * n * float(np.log(power).sum())
    spacing = MIN_SPACING_PX
    while spacing <= MAX_SPACING_PX:
        centre = centres_of(place, spacing)
        if 1 < len(centre) <= min(MAX_BUMPS, n // 8):
            bumps = bumps_at(place, centre, spacing)
            variances, likelihood = _variances(bumps, centred)
            if likelihood > likely:
                best = variances
                likely = likelihood
        if len(centre) <= 2:
            break
        spacing *= 2
    return best


def _variances(bumps: sparse.csr_matrix, left: FloatArray) -> tuple[Smooth, float]:
    """The most likely variances with these bumps, and the logarithm of their likelihood."""
    normal = np.asarray((bumps.T @ bumps).todense())
    square, turn = linalg.eigh(normal, check_finite=False)
    square = np.maximum(square, 0.0)
    projected = (turn.T @ (bumps.T @ left)) ** 2  # (p, 3)
    n = len(left)
    total = (left**2).sum(axis=0)
    kappa = np.zeros(3)
    variance = np.zeros(3)
    likelihood = 0.0
    grown = 1 + KAPPAS[:, None] * square  # (kappas, p)
    logs = np.log(grown).sum(axis=1)
    shares = KAPPAS[:, None] / grown
    for axis in range(3):
        explained = (shares * projected[:, axis]).sum(axis=1)
        rest = total[axis] - explained
        rest = np.maximum(rest / n, FLOOR_ARCSEC**2)
        likelihoods = -0.5 * (n * np.log(rest) + logs)
        k = int(np.argmax(likelihoods))
        kappa[axis] = KAPPAS[k]
        variance[axis] = rest[k]
        likelihood += float(likelihoods[k])
    return Smooth(bumps, turn, square, kappa, variance), likelihood
