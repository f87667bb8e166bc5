"""Confidence intervals by the block bootstrap (Kuensch 1989): errors of neighbouring answers go together.

The error budget of a tracker: of a run's telemetry, or of independent cases.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from hilstar.arrays import FloatArray, IntArray
from hilstar.assess.clock import CUT_SIGMAS, FLOOR_ARCSEC, ClockFit, ClockSolver, CoarseClock, weights_of
from hilstar.assess.components import MIN_ROWS, Component, Components, components_of
from hilstar.assess.places import Scale
from hilstar.errors import InputError
from hilstar.rotation import conjugate, multiply, to_rotation_vector
from hilstar.run.record.commanded import Commanded
from hilstar.units import ARCSEC_PER_RAD, MAD_TO_SIGMA

BLOCKS, MIN_IN_BLOCK = 40, 5
DRAWS = 1000
COVERED = (2.5, 97.5)  # percent
HALF_OF_95 = 1.96
UNUSUAL_SIGMAS = 5.0
MAX_SPREAD_ARCSEC = 600.0  # one sigma: more is no star tracker, but a motion that is somewhat alike


@dataclass(frozen=True, slots=True)
class Intervals:
    """95 % intervals, low and high: of the bias (2, 3), and (2, 2) of each part across and about the boresight, arcsec."""

    bias: FloatArray
    fov: FloatArray
    pixel: FloatArray
    noise: FloatArray


def intervals_of(parts: Components, rng: np.random.Generator, sigma_bias_arcsec: FloatArray | None) -> Intervals:
    """The intervals of components, by drawing stretches of the run anew.

    Where the clock is found together with the bias, `sigma_bias_arcsec` (3,) is how uncertain that leaves it at the least.
    """
    left, fov, pixel = parts.left, parts.fov, parts.pixel
    n = len(left)
    blocks = max(2, min(BLOCKS, n // MIN_IN_BLOCK))
    block = np.arange(n) * blocks // n
    count = np.bincount(block).astype(float)

    def sums(values: FloatArray) -> FloatArray:
        return np.stack([np.bincount(block, column) for column in values.T], axis=1)

    drawn = rng.integers(0, blocks, (DRAWS, blocks))
    rows = count[drawn].sum(axis=1)[:, None]
    total = sums(left + fov.fitted + pixel.fitted)[drawn].sum(axis=1) / rows
    spread = np.std(total, axis=0)
    if sigma_bias_arcsec is not None:
        spread = np.maximum(spread, sigma_bias_arcsec)
    freedom = n - 1 - fov.freedom - pixel.freedom
    noise = sums(left**2)[drawn].sum(axis=1) / rows * (n / max(freedom, 1.0))
    repeating = [
        np.maximum(sums(each.fitted**2)[drawn].sum(axis=1) / rows - each.freedom / n * noise, 0.0) for each in (fov, pixel)
    ]
    return Intervals(
        bias=np.stack([parts.mean - HALF_OF_95 * spread, parts.mean + HALF_OF_95 * spread]),
        fov=_covered(repeating[0]),
        pixel=_covered(repeating[1]),
        noise=_covered(noise),
    )


def _covered(variance: FloatArray) -> FloatArray:
    """Low and high one sigma across and about the boresight, (2, 2), of variances drawn (draws, 3)."""
    axes = np.sqrt(np.stack([variance[:, :2].mean(axis=1), variance[:, 2]], axis=1))
    return np.asarray(np.percentile(axes, COVERED, axis=0))


@dataclass(frozen=True, slots=True)
class Axes:
    """One sigma across the boresight (an axis) and about it, arcsec; None where it cannot be told."""

    cross: float | None
    roll: float | None


@dataclass(frozen=True)
class Decomposed:
    """A budget and what it was made of.

    `row` (k,) are the indices of the answers that count, `components` of their residuals, and `wrong` (m,) the indices of those
    that are no attitude of this sky. `commanded_q` (k, 4) and `rate_rad_s` (k, 3) are what was commanded then.
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
    clock: ClockFit | None = None
    notes: tuple[str, ...] = field(default=())


def assess_run(
    commanded: Commanded,
    tau_s: FloatArray,
    reported: FloatArray,
    coarse: CoarseClock,
    scale: Scale,
    rng: np.random.Generator,
) -> Decomposed:
    """The budget of answers (n, 4) at times (n,), s of the tracker's clock, which rise, against what a run commanded.

    `coarse` is where the telemetry lies on the run's clock (see `coarse_clock`). Raises InputError where too few answers
    were given while the sky was shown, and where half or more of them are wild.
    """
    clock = ClockSolver(commanded, tau_s, reported, scale).fit(coarse)
    known = clock.moments.known
    if known.sum() < MIN_ROWS:
        raise InputError(f"{int(known.sum())} answers fall into the run, and {MIN_ROWS} are needed; give longer telemetry")
    if 2 * clock.used.sum() <= known.sum():
        raise InputError(
            f"half or more of the answers are wild: {int(clock.used.sum())} of {int(known.sum())} agree with one rotation"
        )
    spread = MAD_TO_SIGMA * float(np.median(np.abs(clock.residual_arcsec[clock.used][:, :2])))
    if spread > MAX_SPREAD_ARCSEC:
        raise InputError(f"the answers scatter by {spread:.4g} arcsec about the commanded attitudes: they are of another run")
    total = clock.residual_arcsec + ARCSEC_PER_RAD * to_rotation_vector(clock.rotation)
    return _decomposed(total, clock.moments.q, clock.moments.rate_rad_s, (known, clock.used), (scale, rng, clock))


def assess_cases(
    commanded: FloatArray,
    reported: FloatArray,
    scale: Scale,
    rng: np.random.Generator,
    rate_rad_s: FloatArray | None = None,
) -> Decomposed:
    """The budget of cases: attitudes (n, 4) reported, NaN where none was, against those commanded (n, 4).

    `rate_rad_s` (n, 3), cam, is the turn of each case. Raises InputError for too few answers, or half of them wild.
    """
    known = np.asarray(np.isfinite(reported).all(axis=1) & np.isfinite(commanded).all(axis=1))
    if known.sum() < MIN_ROWS:
        raise InputError(f"{int(known.sum())} answers, and {MIN_ROWS} are needed; plan more cases")
    error = np.full((len(reported), 3), np.nan)
    error[known] = ARCSEC_PER_RAD * to_rotation_vector(multiply(reported[known], conjugate(commanded[known])))
    used = known.copy()
    used[known] = weights_of(error[known])[1] > 0
    if 2 * used.sum() <= known.sum():
        raise InputError(f"half or more of the answers are wild: {int(used.sum())} of {int(known.sum())} agree")
    rate = np.zeros_like(error) if rate_rad_s is None else rate_rad_s
    return _decomposed(error, commanded, rate, (known, used), (scale, rng, None))


def _decomposed(
    error_arcsec: FloatArray,
    q: FloatArray,
    rate: FloatArray,
    which: tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]],
    how: tuple[Scale, np.random.Generator, ClockFit | None],
) -> Decomposed:
    known, used = which
    scale, rng, clock = how
    row = np.flatnonzero(used)
    parts = components_of(error_arcsec[row], q[row], scale)
    stray = _stray(parts, error_arcsec[row])
    if stray.any():
        row = row[~stray]
        parts = components_of(error_arcsec[row], q[row], scale)
    right = np.zeros(len(known), dtype=bool)
    right[row] = True
    floor = None if clock is None else clock.sigma_bias_arcsec
    return Decomposed(
        bias_arcsec=parts.mean,
        fov_arcsec=_told(parts.fov),
        pixel_arcsec=_told(parts.pixel),
        noise_arcsec=axes_of_variance(parts.noise_variance),
        components=parts,
        intervals=intervals_of(parts, rng, floor),
        row=row,
        wrong=np.flatnonzero(known & ~right),
        commanded_q=q[row],
        rate_rad_s=rate[row],
        clock=clock,
        notes=tuple(each.reason for each in (parts.fov, parts.pixel) if each.reason),
    )


def _stray(parts: Components, error_arcsec: FloatArray) -> npt.NDArray[np.bool_]:
    """Answers (k,) that stand out of the noise, and out of all errors as well: where few answers are, a fit can be off."""
    sigma = np.sqrt(np.maximum(parts.noise_variance, FLOOR_ARCSEC**2))
    off = error_arcsec - np.median(error_arcsec, axis=0)
    usual = np.maximum(MAD_TO_SIGMA * np.median(np.abs(off), axis=0), FLOOR_ARCSEC)
    out_of_noise = ((parts.left / sigma) ** 2).sum(axis=1) > CUT_SIGMAS**2
    return np.asarray(out_of_noise & (((off / usual) ** 2).sum(axis=1) > UNUSUAL_SIGMAS**2))


def axes_of_variance(variance: FloatArray) -> Axes:
    """One sigma across and about the boresight, of variances (3,) of the camera's axes."""
    x, y, z = np.maximum(variance, 0.0).tolist()
    return Axes(float(np.sqrt((x + y) / 2)), float(np.sqrt(z)))


def _told(part: Component) -> Axes:
    return Axes(None, None) if part.reason else axes_of_variance(part.variance)
