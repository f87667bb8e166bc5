"""What looks like a field-of-view error: the clock's offset and drift, and a slow change in time.

A clock that is off by delta turns the residual by omega delta. Where the run returns to a place at
another rate, that is no function of the place, and the run tells the two apart. Where it does not,
any share of omega delta may as well be a field-of-view error. So the clock is known as well as
least squares know it beside the bumps of the field (Frisch and Waugh 1933):

    C^-1 = C_prior^-1 + sum over axes of X^T (1 - P) X / sigma^2,     X = [omega, omega (t - t_0)],

with P the projection onto the bumps. Bumps of any height would hide any clock. A field's error has
many shapes, so what of it goes with omega delta is taken to be, one sigma, as large as what shows:
that is C_prior. The fit of the clock takes the field for smooth besides. That is the better guess,
but its sigma is that of fields as smooth as it takes them.

In the same way a change in time, a sum of cosines over the run, is told from the field where the
run comes back to a place at another time. What may have gone into the field's fit is P T c, with c
as the residuals tell it; before them, the change is as large as the noise, one sigma.
"""

from dataclasses import dataclass

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.units import ARCSEC_PER_RAD
from hilstar.instruments.assess.places import Projector

SLOW_WAVES = 4  # half waves over the run, of a change in time
SURE_SIGMAS = 1.96
STRETCHES, MIN_STRETCH = 40, 5  # of the run, and answers in each, whose errors are compared
FLOOR_ARCSEC = 1e-3


@dataclass(frozen=True)
class LookAlikes:
    """What may be in the fit of a field-of-view error without being one.

    `turn` (n, 3, 2) is what an offset of 1 s and a drift of 1 add to each answer's residual,
    arcsec, `covariance` (2, 2) the clock's, and `slow_variance` (3,), arcsec^2, what a slow change
    in time may have added at most (97.5 %).
    """

    turn: FloatArray
    covariance: FloatArray
    slow_variance: FloatArray

    @property
    def bias_variance(self) -> FloatArray:
        """The variance (3,), arcsec^2, that the clock's error gives the mean residual."""
        mean = self.turn.mean(axis=0)
        return np.asarray(np.einsum("ai,ij,aj->a", mean, self.covariance, mean))


def turns_of(rate_rad_s: FloatArray, elapsed_s: FloatArray) -> FloatArray:
    """What an offset of 1 s and a drift of 1 add to residuals (n, 3, 2), arcsec, at rates (n, 3)
    and times (n,) since the run's start.
    """
    omega = ARCSEC_PER_RAD * rate_rad_s
    return np.stack([omega, omega * elapsed_s[:, None]], axis=2)


def clock_covariance(
    turn: FloatArray,
    bumps: Projector | None,
    left: FloatArray,
    field_variance: FloatArray,
    prior_sigma: FloatArray,
) -> FloatArray:
    """The covariance (2, 2) of a clock's offset and drift beside a field-of-view error.

    `left` (n, 3), arcsec, are the residuals about the field's fit, `field_variance` (3,) that of
    the error that shows, `prior_sigma` (2,) what is known of a clock without a run. Errors that
    last pull neighbours the same way: the sigmas are at least those by which stretches of the run
    differ (Liang and Zeger 1986).
    """
    variance = variance_about(left, bumps)
    # in units of the prior, which offset and drift do not share
    precision = np.eye(2)
    pulls = np.zeros((len(left), 2))
    for axis in range(3):
        columns = turn[:, axis] * prior_sigma
        apart = columns - columns.mean(axis=0)
        if bumps is not None:
            mean_square = apart.T @ apart / len(left)
            precision += mean_square / (3 * max(field_variance[axis], FLOOR_ARCSEC**2))
            apart = apart - bumps.fit(apart)
        precision += apart.T @ apart / variance[axis]
        pulls += apart * left[:, axis : axis + 1] / variance[axis]
    covariance = np.linalg.inv(precision)
    stretches = max(2, min(STRETCHES, len(left) // MIN_STRETCH))
    starts = np.arange(stretches) * len(left) // stretches
    sums = np.add.reduceat(pulls, starts, axis=0)
    spread = covariance @ (sums.T @ sums) @ covariance
    growth = np.sqrt(np.maximum(np.diag(spread) / np.diag(covariance), 1.0))
    return np.asarray(covariance * np.outer(growth * prior_sigma, growth * prior_sigma))


def variance_about(left: FloatArray, bumps: Projector | None) -> FloatArray:
    """The variance (3,) of errors of which residuals (n, 3) are left by a fit of bumps."""
    freedom = len(left) - 1.0
    if bumps is not None:
        freedom -= bumps.freedom
    mean_square = (left**2).sum(axis=0) / max(freedom, 1.0)
    return np.asarray(np.maximum(mean_square, FLOOR_ARCSEC**2))


def slow_variance(elapsed_s: FloatArray, bumps: Projector, left: FloatArray) -> FloatArray:
    """The largest mean square (3,), arcsec^2, at 97.5 %, that a slow change in time may have added
    to the fit of the field, by what the residuals (n, 3) about it show.
    """
    variance = variance_about(left, bumps)
    share = elapsed_s / max(float(elapsed_s.max()), 1e-9)
    waves = np.cos(np.pi * share[:, None] * np.arange(1, SLOW_WAVES + 1))
    waves = waves - waves.mean(axis=0)
    in_field = bumps.fit(waves)
    apart = waves - in_field
    # a wave's mean square is a half; all together have the noise's variance
    before = np.eye(SLOW_WAVES) * SLOW_WAVES / 2
    inverse = np.linalg.inv(apart.T @ apart + before)
    coefficient = inverse @ (apart.T @ left)
    taken = in_field.T @ in_field / len(left)
    # of a quadratic form in normal coefficients: its mean, and its variance
    spread = taken @ inverse
    size = np.einsum("ia,ij,ja->a", coefficient, taken, coefficient)
    mixed = np.einsum("ia,ij,ja->a", coefficient, taken @ inverse @ taken, coefficient)
    by_noise = variance * float(np.trace(spread))
    sigma = np.sqrt(2 * variance**2 * float(np.trace(spread @ spread)) + 4 * variance * mixed)
    return np.asarray(size + by_noise + SURE_SIGMAS * sigma)
