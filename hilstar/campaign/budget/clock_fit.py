"""The tracker's clock against the run's, and the bias, by the motion itself.

With tau the telemetry's time and t the run's, tau = t + o + d (t - t_0). A time t' = t + delta at which the run is asked turns
the residual e of T C(t')* by omega delta, so that

    e_i = b + omega_i (delta_0 + delta_1 s_i) + f(place_i) + n_i,        s = (t - t_0) / T

is linear in bias and clock. First robustly without f (Tukey's weights: Beaton and Tukey 1974). Then f is a random function of
the place, a sum of bumps of variance kappa sigma^2, whose kappa and spacing make the residuals most likely; bias and clock are
the generalised least squares estimate (Aitken 1935) under its covariance. So what repeats with the place is not taken for a
clock, and a clock not for what repeats.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import linalg
from scipy.spatial import cKDTree

from hilstar.arrays import FloatArray
from hilstar.campaign.budget.coarse_clock import CoarseClock
from hilstar.campaign.budget.commanded import Commanded, Moments
from hilstar.campaign.budget.places import Bumps, axes_of, bumps_at, centres_of, places_of
from hilstar.campaign.budget.scale import Scale
from hilstar.rotation import conjugate, from_rotation_vector, multiply, normalise, to_rotation_vector
from hilstar.units import ARCSEC_PER_RAD, MAD_TO_SIGMA

CUT_SIGMAS = 8.0
AGREE_ARCSEC = 3600.0  # further from the others than a degree is no answer of this sky, however the errors are spread
ROUNDS, REFINED = 40, 3
PART_PX = 150.0  # of the field, over which an error that repeats with the place pulls a clock the same way
# What is known of a clock before anything is measured: where the motion says less, the clock cannot be told.
OFFSET_PRIOR_S = 10.0
DRIFT_PRIOR = 2e-3
TOLD = 0.3  # of the prior
DONE_ARCSEC = 1e-4
FLOOR_ARCSEC = 1e-3
MAX_BUMPS = 1000
MIN_SPACING_PX, MAX_SPACING_PX = 20.0, 1300.0
KAPPAS = np.logspace(-5, 4, 37)


@dataclass(frozen=True)
class ClockFit:
    """The clock, the bias (a rotation (4,) from commanded to reported), and which answers (n,) are of this sky.

    `offset_s` is the telemetry's time minus the run's at the run's start, `drift` how much faster its clock is; `sigma_*`
    one sigma; `*_told` whether the motion says it. `residual_arcsec` (n, 3), cam, is what bias and clock leave, at the
    commanded `moments`; NaN where those are not known.
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
    used: npt.NDArray[np.bool_]

    @property
    def offset_told(self) -> bool:
        """Whether the motion tells the offset."""
        return self.sigma_offset_s < TOLD * OFFSET_PRIOR_S

    @property
    def drift_told(self) -> bool:
        """Whether the motion tells the drift."""
        return self.sigma_drift < TOLD * DRIFT_PRIOR


@dataclass(frozen=True)
class _State:
    """A clock and a bias while they are sought: t = t_s - delay_s - stretch_s s."""

    rotation: FloatArray
    delay_s: float
    stretch_s: float


class ClockSolver:
    """Fits bias and clock of telemetry times (n,), s, with attitudes (n, 4) to what was commanded."""

    def __init__(self, commanded: Commanded, tau_s: FloatArray, reported: FloatArray, scale: Scale) -> None:
        self.commanded, self.tau_s, self.reported, self.scale = commanded, tau_s, reported, scale
        self.start_s = float(commanded.t_s[0])
        self.span_s = max(float(commanded.t_s[-1]) - self.start_s, 1e-9)

    def fit(self, coarse: CoarseClock) -> ClockFit:
        """The fit from a coarse one."""
        state, used = self._robust(_State(coarse.rotation, -coarse.offset_s, 0.0))
        for _ in range(REFINED):
            state, covariance, used = self._refined(state, used, -coarse.offset_s)
        t_s, moments, residual = self._residual(state)
        stretch = state.stretch_s / self.span_s
        drift = stretch / (1 - stretch)
        sigma = np.sqrt(np.diag(covariance))
        offset_s = self._offset_at_start(state)
        return ClockFit(
            offset_s=offset_s,
            drift=drift,
            sigma_offset_s=float(sigma[3]),
            sigma_drift=float(sigma[4]) / self.span_s,
            sigma_bias_arcsec=sigma[:3],
            rotation=state.rotation,
            moments=moments,
            t_s=t_s,
            residual_arcsec=residual,
            used=used,
        )

    def _offset_at_start(self, state: _State) -> float:
        """tau - t at t = start: tau - delay - stretch (tau - delay - start) / span = start gives tau = start + delay."""
        return state.delay_s

    def _times(self, state: _State) -> tuple[FloatArray, FloatArray]:
        """The run's times (n,) and their share of the run."""
        plain = self.tau_s - state.delay_s
        share = (plain - self.start_s) / self.span_s
        return plain - state.stretch_s * share, share

    def _residual(self, state: _State) -> tuple[FloatArray, Moments, FloatArray]:
        t_s, _ = self._times(state)
        moments = self.commanded.at(t_s)
        turn = multiply(multiply(self.reported, conjugate(moments.q)), conjugate(state.rotation))
        residual = np.full((len(t_s), 3), np.nan)
        residual[moments.known] = ARCSEC_PER_RAD * to_rotation_vector(turn[moments.known])
        return t_s, moments, residual

    def _design(self, state: _State, moments: Moments, rows: npt.NDArray[np.bool_]) -> FloatArray:
        """What a unit of bias (arcsec), delay and stretch (s) adds to the residuals: (3, rows, 5), arcsec."""
        _, share = self._times(state)
        omega = ARCSEC_PER_RAD * moments.rate_rad_s[rows]
        design = np.zeros((3, int(rows.sum()), 5))
        for axis in range(3):
            design[axis, :, axis] = 1.0
            design[axis, :, 3] = omega[:, axis]
            design[axis, :, 4] = omega[:, axis] * share[rows]
        return design

    def _moved(self, state: _State, step: FloatArray) -> _State:
        turn = from_rotation_vector(step[:3] / ARCSEC_PER_RAD)
        rotation = normalise(multiply(turn, state.rotation))
        return _State(rotation, state.delay_s + float(step[3]), state.stretch_s + float(step[4]))

    def _prior(self, state: _State, delay_s: float) -> tuple[FloatArray, FloatArray]:
        """Precision (5,) and pull (5,) of what is known before."""
        precision = np.array([0, 0, 0, 1 / OFFSET_PRIOR_S**2, 1 / (DRIFT_PRIOR * self.span_s) ** 2])
        return precision, precision * np.array([0, 0, 0, delay_s - state.delay_s, -state.stretch_s])

    def _robust(self, state: _State) -> tuple[_State, npt.NDArray[np.bool_]]:
        """Bias and clock by Tukey's weights, across and about the boresight apart."""
        begun = state.delay_s
        for _ in range(ROUNDS):
            _, moments, residual = self._residual(state)
            rows = moments.known
            sigma, weight = weights_of(residual[rows])
            design = self._design(state, moments, rows)
            precision, pull = self._prior(state, begun)
            normal, right = np.diag(precision), pull
            for axis in range(3):
                scaled = design[axis] * (weight / sigma[axis] ** 2)[:, None]
                normal, right = normal + scaled.T @ design[axis], right + scaled.T @ residual[rows, axis]
            step = np.asarray(np.linalg.solve(normal, right), dtype=np.float64)
            state = self._moved(state, step)
            if max(np.abs(step[:3]).max(), 1e3 * np.abs(step[3:]).max()) < DONE_ARCSEC:
                break
        _, moments, residual = self._residual(state)
        used = moments.known.copy()
        used[moments.known] = weights_of(residual[moments.known])[1] > 0
        return state, used

    def _refined(
        self, state: _State, used: npt.NDArray[np.bool_], begun_s: float
    ) -> tuple[_State, FloatArray, npt.NDArray[np.bool_]]:
        """One generalised least squares step, its covariance, and the answers that are of this sky by the present residuals."""
        _, moments, residual = self._residual(state)
        used = used & moments.known
        design, left = self._design(state, moments, used), residual[used]
        place = places_of(axes_of(moments.q[used]), self.scale.focal_px, self.scale.roll_px)
        precision, pull = self._prior(state, begun_s)
        normal, right = np.diag(precision), pull
        smooth = most_likely(place, left)
        pulls = np.zeros((len(left), 5))
        for axis in range(3):
            whitened = smooth.whiten(np.column_stack([design[axis], left[:, axis]]), axis)
            normal = normal + design[axis].T @ whitened[:, :5]
            right = right + design[axis].T @ whitened[:, 5]
            pulls += whitened[:, :5] * left[:, axis : axis + 1]
        covariance = np.asarray(np.linalg.inv(normal), dtype=np.float64)
        step = covariance @ right
        return self._moved(state, step), honest(covariance, pulls, place), used


def honest(covariance: FloatArray, pulls: FloatArray, place: FloatArray) -> FloatArray:
    """A covariance (5, 5), with sigmas no smaller than parts of the field differ by.

    `pulls` (n, 5) are what each answer adds to the normal equations. An error that goes on for longer than the random function
    is meant to pulls neighbours the same way (Liang and Zeger 1986).
    """
    centre = centres_of(place, PART_PX)
    _, part = cKDTree(centre).query(place)
    sums = np.stack([np.bincount(part, column, minlength=len(centre)) for column in pulls.T], axis=1)
    sums = sums - sums.mean(axis=0)
    spread = covariance @ (sums.T @ sums) @ covariance
    growth = np.sqrt(np.maximum(np.diag(spread) / np.diag(covariance), 1.0))
    return np.asarray(covariance * np.outer(growth, growth))


def weights_of(residual_arcsec: FloatArray) -> tuple[FloatArray, FloatArray]:
    """One sigma (3,) by the median deviation, and Tukey's weights (n,) of residuals (n, 3); 0 is no answer of this sky."""
    off = residual_arcsec - np.median(residual_arcsec, axis=0)
    sigma = np.maximum(MAD_TO_SIGMA * np.median(np.abs(off), axis=0), FLOOR_ARCSEC)
    squared = ((off / sigma) ** 2).sum(axis=1)
    near = (squared < CUT_SIGMAS**2) & ((off**2).sum(axis=1) < AGREE_ARCSEC**2)
    return sigma, np.where(near, (1 - squared / CUT_SIGMAS**2) ** 2, 0.0)


@dataclass(frozen=True)
class Smooth:
    """A random function of the place and white noise: bumps turned into `basis` (n, p) with squares `square` (p,).

    `kappa` (3,) and `variance` (3,), arcsec^2, are of each axis.
    """

    bumps: Bumps | None
    turn: FloatArray
    square: FloatArray
    kappa: FloatArray
    variance: FloatArray

    def whiten(self, columns: FloatArray, axis: int) -> FloatArray:
        """The inverse covariance of an axis times columns (n, k)."""
        if self.bumps is None or self.kappa[axis] == 0:
            return np.asarray(columns / self.variance[axis])
        share = self.kappa[axis] / (1 + self.kappa[axis] * self.square)
        inner = self.turn @ (share[:, None] * (self.turn.T @ (self.bumps.value.T @ columns)))
        return np.asarray((columns - self.bumps.value @ inner) / self.variance[axis])


def most_likely(place: FloatArray, residual: FloatArray) -> Smooth:
    """The spacing, and each axis's variances, under which residuals (n, 3) about their mean are most likely."""
    left = residual - residual.mean(axis=0)
    n = len(left)
    power = np.maximum((left**2).mean(axis=0), FLOOR_ARCSEC**2)
    best = Smooth(None, np.zeros((0, 0)), np.zeros(0), np.zeros(3), power)
    likely = -0.5 * n * float(np.log(power).sum())
    spacing = MIN_SPACING_PX
    while spacing <= MAX_SPACING_PX:
        centre = centres_of(place, spacing)
        if 1 < len(centre) <= min(MAX_BUMPS, n // 8):
            found, likelihood = _variances(bumps_at(place, centre, spacing), left)
            if likelihood > likely:
                best, likely = found, likelihood
        if len(centre) <= 2:
            break
        spacing *= 2
    return best


def _variances(bumps: Bumps, left: FloatArray) -> tuple[Smooth, float]:
    """The most likely variances with some bumps, and the logarithm of the likelihood."""
    square, turn = linalg.eigh(bumps.gram, check_finite=False)
    square = np.maximum(square, 0.0)
    projected = (turn.T @ (bumps.value.T @ left)) ** 2  # (p, 3)
    n, total = len(left), (left**2).sum(axis=0)
    kappa, variance, likelihood = np.zeros(3), np.zeros(3), 0.0
    grown = 1 + KAPPAS[:, None] * square  # (kappas, p)
    logs = np.log(grown).sum(axis=1)
    for axis in range(3):
        rest = total[axis] - ((KAPPAS[:, None] / grown) * projected[:, axis]).sum(axis=1)
        rest = np.maximum(rest / n, FLOOR_ARCSEC**2)
        each = -0.5 * (n * np.log(rest) + logs)
        k = int(np.argmax(each))
        kappa[axis], variance[axis] = KAPPAS[k], rest[k]
        likelihood += float(each[k])
    return Smooth(bumps, turn, square, kappa, variance), likelihood
