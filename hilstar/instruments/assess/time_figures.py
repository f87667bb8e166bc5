"""The stamps of answers, by the errors of their attitudes in slews:

    error = bias of each axis + (stamp's bias) x rate; what a late stamp adds is along the motion,
    and turns its sign with the slew

Along a slew the error's variance exceeds that across it by (rate x jitter)^2.
"""

import numpy as np

from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.units import MAD_TO_SIGMA
from hilstar.instruments.assess.bounded_figures import BoundedFigure, TooFewCases
from hilstar.instruments.assess.case_fits import (
    MIN_CASES,
    fit_by_cases,
    largest_size,
    refuse_few,
    root_mean,
)

SMALL_RATE_DEG_S = 1e-6
JITTER_ROUNDS = 3  # of weights by the jitter that the last ones gave


def time_figure(
    quantity: str,
    case: IntArray,
    errors: FloatArray,
    rates_deg_s: FloatArray,
    confidence: float,
    rng: np.random.Generator,
) -> BoundedFigure:
    """The bias or the jitter of the stamps, s, by errors (n, 3), arcsec, at rates (n, 3), deg/s,
    cam axes. Raises TooFewCases.
    """
    refuse_few(case, "attitude")
    rates = 3600.0 * rates_deg_s
    if not _both_signs(rates_deg_s):
        why = "slews of both signs tell it, and the cases have none"
        raise TooFewCases(why, len(np.unique(case)))
    deviation = np.abs(errors - np.median(errors, axis=0))
    noise = MAD_TO_SIGMA * np.median(deviation, axis=0)
    noise = np.maximum(noise, 1e-9)
    count = len(case)
    design = np.zeros((3 * count, 4))
    for k in range(3):
        rows = slice(k * count, (k + 1) * count)
        design[rows, k] = 1 / noise[k]
        design[rows, 3] = rates[:, k] / noise[k]
    weighted = errors / noise
    fit = fit_by_cases(design, weighted.T.ravel(), np.tile(case, 3))
    if quantity == "time-bias":
        method = "linear fit over slews of both signs, Student's t"
        return largest_size([fit], 3, confidence, method)
    residual = fit.residual.reshape(3, -1).T * noise
    return stamp_jitter(residual, rates, case, confidence, rng)


def _both_signs(rates_deg_s: FloatArray) -> bool:
    """Whether some axis turns in both senses, by rates (n, 3)."""
    turning = np.abs(rates_deg_s).max(axis=1) > SMALL_RATE_DEG_S
    if not turning.any():
        return False
    senses = np.sign(rates_deg_s[turning])
    return bool(np.ptp(senses, axis=0).max() >= 2)


def stamp_jitter(
    residual: FloatArray,
    rates: FloatArray,
    case: IntArray,
    confidence: float,
    rng: np.random.Generator,
) -> BoundedFigure:
    """The jitter of the stamp, s, from residuals (n, 3), arcsec, at rates (n, 3), arcsec/s."""
    speed = np.linalg.norm(rates[:, :2], axis=1)
    slews = speed > 3600 * SMALL_RATE_DEG_S
    slewing = case[slews]
    if len(np.unique(slewing)) < MIN_CASES:
        raise TooFewCases("slews across the boresight tell it, and there are too few", 0)
    # the direction of the slew in the image plane, in which the noise has no preferred one
    across = rates[slews, :2]
    along = across / np.linalg.norm(across, axis=1, keepdims=True)
    off = residual[slews, :2]
    along_x, along_y = along.T
    off_x, off_y = off.T
    parallel = (off * along).sum(axis=1)
    normal = off_y * along_x - off_x * along_y
    normal_square = normal**2
    square = (across**2).sum(axis=1)
    excess = (parallel**2 - normal_square) / _fitted_share(square)
    method = "excess of the error along slews over that across them, bootstrap-t over cases"
    variance = float(normal_square.mean())
    weights = _jitter_weights(excess, square, variance)
    return root_mean(excess * weights, square * weights, slewing, confidence, rng, method)


def _fitted_share(square: FloatArray) -> FloatArray:
    """What the fit of bias and stamp has left of the excesses (n,) at squared rates (n,): of errors
    along the slews that grow with the rate, to the first order in 1 / n.
    """
    share = square / square.sum()
    return np.asarray(1 - 2 / len(square) - 2 * share + (share**2).sum())


def _jitter_weights(excess: FloatArray, square: FloatArray, variance: float) -> FloatArray:
    """The weights (n,) of excesses, arcsec2, at squared rates (n,): the best ones for the jitter
    that they give themselves, beside a noise of this variance. Small against the noise, fast slews
    tell it; large, every slew does.
    """
    weights = square
    for _ in range(JITTER_ROUNDS):
        weighted_excess = (excess * weights).sum()
        weighted_square = (square * weights).sum()
        jitter = max(float(weighted_excess / weighted_square), 0.0)
        # of Gaussian errors the variance of a square is twice that of the errors, squared
        along_variance = variance + jitter * square
        weights = square / (along_variance**2 + variance**2)
    return weights
