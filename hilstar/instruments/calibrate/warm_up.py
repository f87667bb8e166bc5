"""Warm-up: from readings of white against time, when white is stable to 0.2 %, and the drift that
remains.

White is stable at a time t when it changes by less than 0.2 % in the ten minutes after t. That
change is taken from the law that explains the readings best (Akaike's criterion), fitted by least
squares:

    line          white = w + s t
    exponential   white = w + a exp(-t / tau)

Where neither explains them (a step, a second time constant at the start), the first eighth of the
readings is left out, then the second, and so on. A law is refused where successive residuals are
alike (von Neumann 1941) or one of them jumps.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.special import stdtrit

from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError
from hilstar.basics.units import MAD_TO_SIGMA, NS_PER_S

STABLE = 2e-3  # relative change of white
AHEAD_S = 600.0  # in which white may not change by more
EVERY_S, LONGEST_S = 10.0, 1800.0
MIN_READINGS, PARTS = 12, 8
ALIKE_SIGMAS, JUMP_SIGMAS = 3.0, 6.0  # beyond which a law is refused
CONFIDENCE = 0.975  # one-sided bound: both sides together leave 5 %
FLOOR = 1e-6  # relative: an instrument's rounding, below which residuals say nothing
LIKELY = 6.0  # Akaike's criterion above the best law's: one in twenty as likely
# time constants that are tried, from a step between readings to 3 times their span
TAUS, MAX_TAU = 12, 3.0
END_SHARE = 0.01  # of the step between two time constants: nearer to the last one is at the end
S_PER_H = 3600.0


@dataclass(frozen=True, slots=True)
class WarmUp:
    """When white is stable, and how it drifts at the last reading, relative to white there; errors
    are standard errors.

    `stable_after_s` is on the clock of the readings: infinite where the law never is stable, after
    the last reading where it will be. `ahead` is the relative change in the next ten minutes;
    `is_stable` says that it is within `limit` at 95 %. `law` explains the readings from `from_s`
    on; it is "none" where no law does, and then the figures are not known (nan).
    """

    law: str
    is_stable: bool
    limit: float
    stable_after_s: float = math.inf
    stable_after_error_s: float = math.nan
    drift_percent_per_h: float = math.nan
    drift_error_percent_per_h: float = math.nan
    ahead: float = math.nan
    ahead_error: float = math.nan
    tau_s: float = math.nan
    noise: float = math.nan
    dof: int = 0
    from_s: float = 0.0

    @property
    def bound(self) -> float:
        """The relative change in the next ten minutes that is not exceeded at 95 %; nan where no
        law is found.
        """
        student = float(stdtrit(self.dof, CONFIDENCE))
        return abs(self.ahead) + student * self.ahead_error

    @property
    def line(self) -> str:
        """The finding in a sentence."""
        limit = f"{100 * self.limit:g} %"
        if self.law == "none":
            return (
                f"white is not stable to {limit}: the last readings follow neither a line nor an"
                " exponential"
            )
        drift = (
            f"it drifts by {self.drift_percent_per_h:+.2f} +- {self.drift_error_percent_per_h:.2f}"
            " %/h at the end"
        )
        after = f"{self.stable_after_s:.0f} +- {self.stable_after_error_s:.0f} s"
        if self.is_stable:
            since = f"after {after}"
            if self.stable_after_s <= self.from_s:
                since = f"from the first reading, at {self.from_s:.0f} s, on"
            return f"white is stable to {limit} {since}; {drift}"
        if self.law == "exponential":
            return (
                f"white is not yet stable to {limit}: by its exponential it is after {after};"
                f" {drift}"
            )
        return f"white is not shown to be stable to {limit}: {drift}"

    @property
    def cure(self) -> str:
        """What to do where white is not stable."""
        if self.law == "exponential" and math.isfinite(self.stable_after_s):
            return "wait until then, and watch it again"
        return (
            "watch it for longer (--warm-up), and look at dynamic contrast, local dimming and stray"
            " light"
        )


@dataclass(frozen=True, slots=True)
class _Law:
    """A law's parameters (w, s) or (w, a, tau), their covariance, and relative residuals (n,).

    `at_end` says that the time constant is at an end of those that are tried: the readings do not
    have it.
    """

    parameters: FloatArray
    covariance: FloatArray
    residual: FloatArray
    dof: int
    at_end: bool = False

    @property
    def criterion(self) -> float:
        """Akaike's, up to a constant: the smaller the likelier."""
        mean_square = float(np.mean(self.residual**2)) + FLOOR**2
        return len(self.residual) * math.log(mean_square) + 2 * len(self.parameters)

    @property
    def is_refused(self) -> bool:
        """Whether the readings contradict it: successive residuals are alike, or one jumps."""
        if self.at_end:
            return True
        steps = np.diff(self.residual)
        by_steps = float(np.mean(steps**2)) / 2 + FLOOR**2
        by_residuals = float(self.residual @ self.residual) / self.dof + FLOOR**2
        # von Neumann's ratio is 1 for independent residuals
        lowest_ratio = 1 - ALIKE_SIGMAS / math.sqrt(len(self.residual))
        if by_steps / by_residuals < lowest_ratio:
            return True
        largest_step = float(np.abs(steps).max())
        scatter = MAD_TO_SIGMA * float(np.median(np.abs(steps)))
        return largest_step > JUMP_SIGMAS * scatter + 10 * FLOOR

    @property
    def noise(self) -> float:
        """The noise of one reading, relative."""
        return math.sqrt(float(self.residual @ self.residual) / self.dof)

    def died_away(self, at_s: float) -> bool:
        """Whether an exponential is far below a reading's noise by a time."""
        if len(self.parameters) < 3:
            return False
        _, change, tau_s = self.parameters
        return bool(abs(change) * math.exp(-at_s / tau_s) < self.noise / 3)

    def foretold(self, span_s: float, limit: float) -> tuple[list[float], list[float]]:
        """At `span_s`: slope, 1/s, and change in the next ten minutes, relative; when white is
        stable, s; and their errors.
        """
        at = self._figures(self.parameters, span_s, limit)
        # small where an error is: the figures are linear there
        steps = 1e-4 * np.sqrt(np.diag(self.covariance))
        slopes = np.empty((len(steps), len(at)))
        for row, step in enumerate(np.diag(steps)):
            moved = self._figures(self.parameters + step, span_s, limit)
            slopes[row] = (moved - at) / step.sum()
        variance = np.einsum("pi,pq,qi->i", slopes, self.covariance, slopes)
        return at.tolist(), np.sqrt(np.maximum(variance, 0.0)).tolist()

    @staticmethod
    def _figures(parameters: FloatArray, span_s: float, limit: float) -> FloatArray:
        """Slope, change in the next ten minutes, and when it is within the limit, as in
        `foretold`.
        """
        w, a, *tau = parameters.tolist()
        if not tau:
            slope = a / (w + a * span_s)
            return np.array([slope, slope * AHEAD_S, 0.0])
        (tau_s,) = tau
        falls = -math.expm1(-AHEAD_S / tau_s)
        rest = a * math.exp(-span_s / tau_s)
        white = w + rest
        change = abs(a) * falls / white
        stable_s = tau_s * math.log(max(change, 1e-300) / limit)
        fall_share = -rest / white
        return np.array([fall_share / tau_s, fall_share * falls, stable_s])


def watch_white(
    read: Callable[[], float],
    clock_ns: Callable[[], int],
    wait: Callable[[float], object],
    longest_s: float = LONGEST_S,
) -> tuple[FloatArray, FloatArray]:
    """Times (n,), s from the first, and readings (n,) of white, every EVERY_S until it is stable or
    `longest_s` are over.

    `wait` lets seconds pass. At least 12 readings are taken. Raises InputError for a reading
    without light.
    """
    t_s: list[float] = []
    light: list[float] = []
    first_ns = clock_ns()
    while True:
        begun_ns = clock_ns()
        value = float(read())
        ended_ns = clock_ns()
        t_s.append(((begun_ns + ended_ns) / 2 - first_ns) / NS_PER_S)
        if not (math.isfinite(value) and value > 0):
            raise InputError(
                f"white reads {value:g} after {t_s[-1]:.0f} s; look at what the instrument sees"
            )
        light.append(value)
        over = (ended_ns - first_ns) / NS_PER_S + EVERY_S > longest_s
        if len(light) >= MIN_READINGS:
            times = np.array(t_s)
            readings = np.array(light)
            if over or judge_warm_up(times, readings).is_stable:
                return times, readings
        wait(max(EVERY_S - (ended_ns - begun_ns) / NS_PER_S, 1e-3))


def judge_warm_up(t_s: FloatArray, light: FloatArray, limit: float = STABLE) -> WarmUp:
    """When white is stable to `limit`, by readings (n,) at times (n,). Raises InputError for
    fewer than 12, or no readings.
    """
    is_usable = len(light) >= MIN_READINGS
    is_usable = is_usable and bool(np.isfinite(light).all() and (light > 0).all())
    if not is_usable or not (np.diff(t_s) > 0).all():
        raise InputError(
            f"{len(light)} readings of white: a warm-up takes {MIN_READINGS} or more, above 0, at"
            " rising times"
        )
    for part in range(PARTS):
        first = part * len(light) // PARTS
        if len(light) - first < MIN_READINGS:
            break
        judgements = _likely(t_s[first:], light[first:], limit)
        if judgements:  # white is stable only if it is by each law that is likely
            is_stable = all(judgement.is_stable for judgement in judgements)
            return replace(judgements[0], is_stable=is_stable)
    return WarmUp("none", False, limit)


def _likely(t_s: FloatArray, light: FloatArray, limit: float) -> list[WarmUp]:
    """The figures of each law that readings (n,) do not contradict and that is about as likely as
    the likeliest, which is the first.
    """
    laws = [law for law in _laws(t_s, light) if not law.is_refused]
    laws.sort(key=lambda law: law.criterion)
    judgements = []
    for law in laws:
        if law.criterion < laws[0].criterion + LIKELY:
            judgements.append(_judged(law, t_s, light, limit))
    return judgements


def _judged(law: _Law, t_s: FloatArray, light: FloatArray, limit: float) -> WarmUp:
    """The figures of a law of readings (n,) at `t_s` (n,)."""
    span_s = float(t_s[-1] - t_s[0])
    half = len(t_s) // 2
    # An exponential that has died away says nothing of the drift: a line through the last half of
    # the readings does.
    end = law
    end_span_s = span_s
    if law.died_away(float(t_s[half] - t_s[0])):
        end = _line(t_s[half:], light[half:])
        end_span_s = 0.0
    (_, _, stable_s), (_, _, stable_error_s) = law.foretold(span_s, limit)
    (slope, ahead, _), (slope_error, ahead_error, _) = end.foretold(end_span_s, limit)
    if len(law.parameters) == 2:
        name = "line"
        tau_s = math.nan
        stable_s = 0.0
        if abs(ahead) >= limit:
            stable_s = math.inf
    else:
        name = "exponential"
        tau_s = float(law.parameters[2])
        stable_s = max(stable_s, 0.0)
    bound = abs(ahead) + stdtrit(end.dof, CONFIDENCE) * ahead_error
    if not stable_s:
        stable_error_s = 0.0
    start_s = float(t_s[0])
    return WarmUp(
        law=name,
        is_stable=bool(bound < limit),
        limit=limit,
        stable_after_s=start_s + stable_s,
        stable_after_error_s=stable_error_s,
        drift_percent_per_h=100 * S_PER_H * slope,
        drift_error_percent_per_h=100 * S_PER_H * slope_error,
        ahead=ahead,
        ahead_error=ahead_error,
        tau_s=tau_s,
        noise=law.noise,
        dof=end.dof,
        from_s=start_s,
    )


def fitted_white(found: WarmUp, t_s: FloatArray, light: FloatArray) -> FloatArray:
    """White (n,) by the law that was found in these readings (n,), in their unit, for a chart;
    nan before `from_s`.
    """
    drawn = np.full(len(t_s), np.nan)
    used = t_s >= found.from_s
    if found.law != "none":
        law = _laws(t_s[used], light[used])[found.law == "exponential"]
        white = float(np.median(light[used]))
        drawn[used] = light[used] - white * law.residual
    return drawn


def _laws(t_s: FloatArray, light: FloatArray) -> tuple[_Law, _Law]:
    """The line and the exponential that fit readings (n,) best."""
    time = t_s - t_s[0]
    value = light / np.median(light)

    def misfit(log_tau: float) -> float:
        residual = _law(time, value, math.exp(log_tau)).residual
        return float(residual @ residual)

    shortest_s = float(np.median(np.diff(time)))
    longest_s = MAX_TAU * float(time[-1])
    tried = np.linspace(math.log(shortest_s), math.log(longest_s), TAUS)
    best = int(np.argmin([misfit(log_tau) for log_tau in tried]))
    lowest = tried[max(best - 1, 0)]
    highest = tried[min(best + 1, TAUS - 1)]
    log_tau = float(minimize_scalar(misfit, bounds=(lowest, highest), method="bounded").x)
    margin = END_SHARE * (tried[1] - tried[0])
    at_end = not tried[0] + margin < log_tau < tried[-1] - margin
    exponential = _law(time, value, math.exp(log_tau))
    return _line(t_s, light), replace(exponential, at_end=at_end)


def _line(t_s: FloatArray, light: FloatArray) -> _Law:
    return _law(t_s - t_s[0], light / np.median(light))


def _law(time: FloatArray, value: FloatArray, tau: float | None = None) -> _Law:
    """Least squares at times (n,) from 0 on: a line, or an exponential of a time constant."""
    shape = time
    if tau is not None:
        shape = np.exp(-time / tau)
    columns = np.stack([np.ones_like(time), shape], axis=1)
    coefficients = np.linalg.lstsq(columns, value, rcond=None)[0]
    residual = value - columns @ coefficients
    if tau is not None:
        by_tau = coefficients[1] * shape * time / tau**2
        columns = np.column_stack([columns, by_tau])
        coefficients = np.append(coefficients, tau)
    dof = len(value) - columns.shape[1]
    size = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    scaled = columns / size
    inverse = np.linalg.pinv(scaled.T @ scaled, rcond=1e-13)
    noise2 = float(residual @ residual) / dof + FLOOR**2
    covariance = np.asarray(noise2 * inverse / np.outer(size, size), dtype=np.float64)
    return _Law(np.asarray(coefficients, dtype=np.float64), covariance, residual, dof)
