"""The error budget of a tracker, from a run's telemetry or from independent cases, with its 95 %
intervals.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.special import stdtrit

from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.errors import InputError
from hilstar.basics.rotation import conjugate, multiply, to_rotation_vector
from hilstar.basics.units import ARCSEC_PER_RAD, MAD_TO_SIGMA
from hilstar.instruments.assess.clock import (
    CUT_SIGMAS,
    DRIFT_PRIOR,
    FLOOR_ARCSEC,
    OFFSET_PRIOR_S,
    ClockFit,
    ClockSolver,
    CoarseClock,
    weights_of,
)
from hilstar.instruments.assess.components import MIN_ROWS, Component, Components, components_of
from hilstar.instruments.assess.look_alikes import (
    SLOW_WAVES,
    LookAlikes,
    clock_covariance,
    slow_variance,
    turns_of,
    variance_about,
)
from hilstar.instruments.assess.places import Scale
from hilstar.server.record.commanded import Commanded

BLOCKS, MIN_IN_BLOCK, DRAWS = 40, 5, 1000  # the bootstrap's blocks and draws
COVERED = (2.5, 97.5)  # percent
HALF_OF_95 = 1.96  # sigmas of a normal distribution
RADII, ANGLES = 40, 90  # clocks at which the field-of-view error is looked at
ONE_SIDE_OF_95 = 0.975
UNUSUAL_SIGMAS = 5.0
# one sigma; a larger spread is no star tracker but another run with a similar motion
MAX_SPREAD_ARCSEC = 600.0


@dataclass(frozen=True, slots=True)
class Axes:
    """One sigma across the boresight (an axis) and about it, arcsec; None where it cannot be
    told.
    """

    cross: float | None
    roll: float | None


@dataclass(frozen=True, slots=True)
class Intervals:
    """95 % intervals, low and high, arcsec: the bias (2, 3), and each part across and about the
    boresight (2, 2).
    """

    bias: FloatArray
    fov: FloatArray
    pixel: FloatArray
    noise: FloatArray


@dataclass(frozen=True)
class Decomposed:
    """A budget and its ingredients.

    `row` (k,) are the indices of the right answers, `components` the parts of their residuals,
    `commanded_q` (k, 4) and `rate_rad_s` (k, 3) the attitudes and rates commanded at them. `wrong`
    (m,) are the indices of answers that are no attitude of this sky.
    """

    bias_arcsec: FloatArray
    fov_arcsec: Axes
    pixel_arcsec: Axes
    noise_arcsec: Axes
    components: Components
    intervals: Intervals
    row: IntArray
    wrong: IntArray
    commanded_q: FloatArray
    rate_rad_s: FloatArray
    notes: tuple[str, ...]


@dataclass(frozen=True)
class DecomposedRun(Decomposed):
    """The budget of a run, with the clock that was found together with the bias.

    `held` (h,) are the indices of answers that looked while a frame was held for missed ones. They
    are in no figure, and wrong only where they are further off than the field turned meanwhile.
    """

    clock: ClockFit
    held: IntArray


def assess_run(
    commanded: Commanded,
    tau_s: FloatArray,
    reported: FloatArray,
    coarse: CoarseClock,
    scale: Scale,
    rng: np.random.Generator,
) -> DecomposedRun:
    """The budget of answers (n, 4) at rising times (n,), s of the tracker's clock, against the
    attitudes that a run commanded.

    `coarse` is where the telemetry lies on the run's clock (see `clock.coarse_offset`). Raises
    InputError for fewer than MIN_ROWS answers while the sky was shown, and where half or more of
    them are wild.
    """
    clock = ClockSolver(commanded, tau_s, reported, scale).fit(coarse)
    moments = clock.moments
    known = moments.known
    held = known & (moments.held_s > 0)
    free = known & ~held
    _refuse_few(known, held, clock.used)
    deviation_arcsec = np.abs(clock.residual_arcsec[clock.used][:, :2])
    largest_arcsec = float(np.median(deviation_arcsec, axis=0).max())
    spread_arcsec = MAD_TO_SIGMA * largest_arcsec
    if spread_arcsec > MAX_SPREAD_ARCSEC:
        raise InputError(
            f"the answers scatter by {spread_arcsec:.4g} arcsec about the commanded attitudes: they"
            " are of another run"
        )
    bias_arcsec = ARCSEC_PER_RAD * to_rotation_vector(clock.rotation)
    total_arcsec = clock.residual_arcsec + bias_arcsec
    right, parts = _right_answers(total_arcsec, moments.q, clock.used, scale)
    look_alikes = _look_alikes(clock, parts, right, float(commanded.t_s[0]))
    clock = _beside_field(clock, look_alikes)
    intervals = intervals_of(parts, rng, clock.sigma_bias_arcsec, look_alikes)
    decomposed = _decomposed(parts, intervals, free, right, moments.q, moments.rate_rad_s)
    ingredients = vars(decomposed).copy()
    astray = held & _beyond_turn(clock, parts)
    ingredients["wrong"] = np.sort(np.append(decomposed.wrong, np.flatnonzero(astray)))
    held_rows = np.flatnonzero(held & ~astray)
    return DecomposedRun(**ingredients, clock=clock, held=held_rows)


def _look_alikes(clock: ClockFit, parts: Components, right: IntArray, start_s: float) -> LookAlikes:
    """What may be in the field's fit to the right answers (k,) without being of the field."""
    elapsed_s = clock.t_s[right] - start_s
    turn = turns_of(clock.moments.rate_rad_s[right], elapsed_s)
    about_field = parts.left + parts.pixel.fitted
    prior_sigma = np.array([OFFSET_PRIOR_S, DRIFT_PRIOR])
    of_answer = variance_about(about_field, parts.bumps) / len(right)
    of_fit = _of_fit(parts.fov.variance, parts.fov.freedom, of_answer)
    shows = parts.fov.variance + HALF_OF_95 * np.sqrt(of_fit)
    covariance = clock_covariance(turn, parts.bumps, about_field, shows, prior_sigma)
    slow = np.zeros(3)
    if parts.bumps is not None:
        slow = slow_variance(elapsed_s, parts.bumps, about_field)
    return LookAlikes(turn, covariance, slow)


def _beside_field(clock: ClockFit, look_alikes: LookAlikes) -> ClockFit:
    """The clock as well as it is known beside any error that repeats with the place."""
    offset_s, drift = np.sqrt(np.diag(look_alikes.covariance)).tolist()
    return replace(
        clock,
        sigma_offset_s=max(clock.sigma_offset_s, offset_s),
        sigma_drift=max(clock.sigma_drift, drift),
        sigma_bias_arcsec=np.hypot(clock.sigma_bias_arcsec, np.sqrt(look_alikes.bias_variance)),
    )


def _refuse_few(
    known: npt.NDArray[np.bool_], held: npt.NDArray[np.bool_], used: npt.NDArray[np.bool_]
) -> None:
    """Refuse (InputError) a run with too few answers (n,): known, while no frame was held, or of
    this sky.
    """
    known_count = int(known.sum())
    held_count = int(held.sum())
    used_count = int(used.sum())
    free_count = known_count - held_count
    if known_count < MIN_ROWS:
        raise InputError(
            f"{known_count} answers fall into the run, and {MIN_ROWS} are needed; give longer"
            " telemetry"
        )
    if free_count < MIN_ROWS:
        longer = ""
        if free_count:
            times = math.ceil(10 * MIN_ROWS / free_count) / 10
            longer = f"{times:g} times as long, "
        raise InputError(
            f"the run missed so many frames that {held_count} of {known_count} answers looked while"
            f" one was held, and {MIN_ROWS} others are needed; run it {longer}on a machine with"
            " less other work, or with a lower [monitor] refresh_hz"
        )
    if 2 * used_count <= free_count:
        raise InputError(
            f"half or more of the answers are wild: {used_count} of {free_count} agree with one"
            " rotation"
        )


def _beyond_turn(clock: ClockFit, parts: Components) -> npt.NDArray[np.bool_]:
    """Answers (n,) further off than noise and the field's turn while a frame was held explain."""
    moments = clock.moments
    rate_arcsec_s = ARCSEC_PER_RAD * np.linalg.norm(moments.rate_rad_s, axis=1)
    turned_arcsec = rate_arcsec_s * moments.held_s
    variance = np.maximum(parts.noise_variance, FLOOR_ARCSEC**2)
    noise_arcsec = float(np.sqrt(variance.sum()))
    off_arcsec = np.linalg.norm(clock.residual_arcsec, axis=1)
    return np.asarray(off_arcsec > turned_arcsec + CUT_SIGMAS * noise_arcsec)


def assess_cases(
    commanded: FloatArray,
    reported: FloatArray,
    scale: Scale,
    rng: np.random.Generator,
    rate_rad_s: FloatArray | None = None,
) -> Decomposed:
    """The budget of cases: reported attitudes (n, 4), NaN where there is none, against the
    commanded ones (n, 4).

    `rate_rad_s` (n, 3), cam, is the rate of each case. Raises InputError for fewer than MIN_ROWS
    answers, or half of them wild.
    """
    is_reported = np.isfinite(reported).all(axis=1)
    is_commanded = np.isfinite(commanded).all(axis=1)
    known = np.asarray(is_reported & is_commanded)
    known_count = int(known.sum())
    if known_count < MIN_ROWS:
        raise InputError(f"{known_count} answers, and {MIN_ROWS} are needed; plan more cases")
    turn = multiply(reported[known], conjugate(commanded[known]))
    error = np.full((len(reported), 3), np.nan)
    error[known] = ARCSEC_PER_RAD * to_rotation_vector(turn)
    _, weight = weights_of(error[known])
    used = known.copy()
    used[known] = weight > 0
    used_count = int(used.sum())
    if 2 * used_count <= known_count:
        raise InputError(
            f"half or more of the answers are wild: {used_count} of {known_count} agree"
        )
    if rate_rad_s is None:
        rate = np.zeros_like(error)
    else:
        rate = rate_rad_s
    right, parts = _right_answers(error, commanded, used, scale)
    intervals = intervals_of(parts, rng)
    return _decomposed(parts, intervals, known, right, commanded, rate)


def _right_answers(
    error_arcsec: FloatArray, q: FloatArray, used: npt.NDArray[np.bool_], scale: Scale
) -> tuple[IntArray, Components]:
    """The indices (k,) of the right answers among those used (n,), and the components of their
    errors.
    """
    row = np.flatnonzero(used)
    parts = components_of(error_arcsec[row], q[row], scale)
    stray = _stray(parts, error_arcsec[row])
    if stray.any():
        row = row[~stray]
        parts = components_of(error_arcsec[row], q[row], scale)
    return row, parts


def _decomposed(
    parts: Components,
    intervals: Intervals,
    known: npt.NDArray[np.bool_],
    row: IntArray,
    q: FloatArray,
    rate: FloatArray,
) -> Decomposed:
    right = np.zeros(len(known), dtype=bool)
    right[row] = True
    reasons = (parts.fov.reason, parts.pixel.reason)
    return Decomposed(
        bias_arcsec=parts.mean,
        fov_arcsec=_told(parts.fov),
        pixel_arcsec=_told(parts.pixel),
        noise_arcsec=axes_of_variance(parts.noise_variance),
        components=parts,
        intervals=intervals,
        row=row,
        wrong=np.flatnonzero(known & ~right),
        commanded_q=q[row],
        rate_rad_s=rate[row],
        notes=tuple(filter(None, reasons)),
    )


def _stray(parts: Components, error_arcsec: FloatArray) -> npt.NDArray[np.bool_]:
    """Answers (k,) far outside the noise and the errors as a whole: among few answers the fit
    alone can be far off.
    """
    sigma = np.sqrt(np.maximum(parts.noise_variance, FLOOR_ARCSEC**2))
    off = error_arcsec - np.median(error_arcsec, axis=0)
    deviation = np.median(np.abs(off), axis=0)
    usual = np.maximum(MAD_TO_SIGMA * deviation, FLOOR_ARCSEC)
    out_of_noise = ((parts.left / sigma) ** 2).sum(axis=1) > CUT_SIGMAS**2
    unusual = ((off / usual) ** 2).sum(axis=1) > UNUSUAL_SIGMAS**2
    return np.asarray(out_of_noise & unusual)


def axes_of_variance(variance: FloatArray) -> Axes:
    """One sigma across and about the boresight from the variances (3,) of the camera's axes."""
    x, y, z = np.maximum(variance, 0.0).tolist()
    cross = float(np.sqrt((x + y) / 2))
    roll = float(np.sqrt(z))
    return Axes(cross, roll)


def _told(part: Component) -> Axes:
    if part.reason:
        return Axes(None, None)
    return axes_of_variance(part.variance)


def intervals_of(
    parts: Components,
    rng: np.random.Generator,
    sigma_bias_arcsec: FloatArray | None = None,
    look_alikes: LookAlikes | None = None,
) -> Intervals:
    """The intervals of components by the block bootstrap (Kuensch 1989): errors of neighbouring
    answers go together.

    `sigma_bias_arcsec` (3,) is the smallest uncertainty of the bias, where the clock was found
    together with it. With `look_alikes` the field-of-view error is that of the run's own places.
    """
    residual = parts.left
    fov = parts.fov
    pixel = parts.pixel
    n = len(residual)
    blocks = max(2, min(BLOCKS, n // MIN_IN_BLOCK))
    block = np.arange(n) * blocks // n
    count = np.bincount(block).astype(float)

    drawn = rng.integers(0, blocks, (DRAWS, blocks))
    rows = count[drawn].sum(axis=1)[:, None]

    def means(values: FloatArray) -> FloatArray:
        sums = []
        for column in values.T:
            sums.append(np.bincount(block, column))
        by_block = np.stack(sums, axis=1)
        return np.asarray(by_block[drawn].sum(axis=1) / rows)

    total = means(residual + fov.fitted + pixel.fitted)
    spread = np.std(total, axis=0)
    if sigma_bias_arcsec is not None:
        spread = np.maximum(spread, sigma_bias_arcsec)
    # Few blocks scatter less about their own mean than about the truth: Student's t.
    few = float(stdtrit(blocks - 1, ONE_SIDE_OF_95)) / HALF_OF_95
    wider = few * math.sqrt(blocks / (blocks - 1))
    half_width = HALF_OF_95 * wider * spread
    freedom = n - 1 - fov.freedom - pixel.freedom
    drawn_noise = means(residual**2) * (n / max(freedom, 1.0))
    middle = drawn_noise.mean(axis=0)
    noise = np.maximum(middle + wider * (drawn_noise - middle), 0.0)

    def repeating(component: Component) -> FloatArray:
        noise_in_fit = component.freedom / n * noise
        variance = means(component.fitted**2) - noise_in_fit
        size = np.maximum(variance.mean(axis=0), 0.0)
        of_fit = _of_fit(size, component.freedom, middle / n)
        variance += np.sqrt(of_fit) * rng.standard_normal(variance.shape)
        return np.asarray(np.maximum(variance, 0.0))

    if look_alikes is None:
        of_field = _covered(repeating(fov))
    else:
        of_field = _field_interval(fov, middle, look_alikes)
    return Intervals(
        bias=np.stack([parts.mean - half_width, parts.mean + half_width]),
        fov=of_field,
        pixel=_covered(repeating(pixel)),
        noise=_covered(noise),
    )


def _of_fit(size: FloatArray, freedom: float, of_answer: FloatArray) -> FloatArray:
    """The variance (3,) that noise in a fit gives its mean square (3,), a noncentral chi-square: by
    the fit's cross term with noise, and by the noise's own scatter. `of_answer` (3,) is the noise's
    variance over the number of answers.
    """
    return 4 * size * of_answer + 2 * freedom * of_answer**2


def _field_interval(
    fov: Component, noise_variance: FloatArray, look_alikes: LookAlikes
) -> FloatArray:
    """The field-of-view error of a run's places, low and high, across and about (2, 2), arcsec.

    Its mean square is a quadratic function of the clock's error. Its range over the clocks within
    1.96 sigma is the profile likelihood's interval.
    """
    n = len(fov.fitted)
    about = fov.fitted - fov.fitted.mean(axis=0)
    turn = look_alikes.turn - look_alikes.turn.mean(axis=0)
    root = np.linalg.cholesky(look_alikes.covariance)
    slope = 2 * np.einsum("na,nai->ai", about, turn) @ root / n
    bend = root.T @ (np.einsum("nai,naj->aij", turn, turn) / n) @ root
    of_fit = _of_fit(fov.variance, fov.freedom, noise_variance / n)
    ends = []
    for axes in ([0, 1], [2]):
        variance = float(fov.variance[axes].mean())
        lower, higher = _range_in_disc(slope[axes].mean(axis=0), bend[axes].mean(axis=0))
        fit = HALF_OF_95 * math.sqrt(float(of_fit[axes].sum())) / len(axes)
        slow = float(look_alikes.slow_variance[axes].mean())
        # a slow change adds its own power, and goes with or against the field's error by chance
        by_chance = 2 * math.sqrt(variance * min(slow, variance) / SLOW_WAVES)
        low = max(variance - math.hypot(lower, fit, by_chance) - slow, 0.0)
        high = variance + math.hypot(higher, fit, by_chance)
        ends.append((math.sqrt(low), math.sqrt(high)))
    return np.array(ends).T


def _range_in_disc(slope: FloatArray, bend: FloatArray) -> tuple[float, float]:
    """How far slope x + x bend x goes below and above 0 within 1.96 of the origin, x (2,)."""
    radius = np.linspace(0.0, HALF_OF_95, RADII)
    angle = np.linspace(0.0, 2 * np.pi, ANGLES, endpoint=False)
    around = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    points = (radius[:, None, None] * around).reshape(-1, 2)
    lowest = -0.5 * np.linalg.pinv(bend, hermitian=True) @ slope
    if np.linalg.norm(lowest) <= HALF_OF_95:
        points = np.concatenate([points, lowest[None]])
    value = points @ slope + np.einsum("ki,ij,kj->k", points, bend, points)
    return -float(value.min()), float(value.max())


def _covered(variance: FloatArray) -> FloatArray:
    """Low and high of one sigma across and about the boresight, (2, 2), from drawn variances
    (draws, 3).
    """
    across = variance[:, :2].mean(axis=1)
    about = variance[:, 2]
    axes = np.sqrt(np.stack([across, about], axis=1))
    return np.asarray(np.percentile(axes, COVERED, axis=0))
