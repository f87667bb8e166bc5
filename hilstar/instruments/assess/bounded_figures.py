"""Figures of cases with their one-sided limits, and the statistics that give such limits."""

import math
from dataclasses import dataclass

import numpy as np
from scipy import optimize, stats

from hilstar.basics.arrays import FloatArray

MAX_BLOCKS, DRAWS = 200, 1000  # the bootstrap's


@dataclass(frozen=True, slots=True)
class BoundedFigure:
    """A figure with its one-sided limits; `rate` (count, of) is what decides how many cases are
    wanted.
    """

    value: float
    low: float
    high: float
    cases: int
    method: str
    rate: tuple[float, float] | None = None


class TooFewCases(Exception):
    """Why a figure is not known, with how many more cases could give it (None: cases alone
    cannot).
    """

    def __init__(self, why: str, cases: int, more: int | None = None) -> None:
        super().__init__(why)
        self.cases = cases
        self.more = more


def clopper_pearson(count: float, of: float, confidence: float) -> tuple[float, float]:
    """The one-sided limits of a rate of which `count` in `of` were seen, each at this
    confidence.
    """
    if count <= 0:
        low = 0.0
    else:
        low = float(stats.beta.ppf(1 - confidence, count, of - count + 1))
    if count >= of:
        high = 1.0
    else:
        high = float(stats.beta.ppf(confidence, count + 1, of - count))
    return low, high


def quantile_limits(values: FloatArray, share: float, confidence: float) -> tuple[float, float]:
    """One-sided limits of the `share` quantile of values (n,) by order statistics; infinite
    where there are too few.
    """
    ordered = np.sort(values)
    n = len(values)
    # the smallest k with P(count <= k) >= confidence
    upper = int(stats.binom.ppf(confidence, n, share))
    lower = int(stats.binom.ppf(1 - confidence, n, share))
    if lower > 0:
        below = float(stats.binom.cdf(lower - 1, n, share))
        if below > 1 - confidence:
            lower -= 1
    low, high = -math.inf, math.inf
    if lower > 0:
        low = float(ordered[lower - 1])
    if upper < n:
        high = float(ordered[upper])
    return low, high


def sigma_limits(variance: float, freedom: float, confidence: float) -> tuple[float, float]:
    """The one-sided limits of a sigma by chi-square, of Gaussian errors."""
    squares = variance * freedom
    low = squares / stats.chi2.ppf(confidence, freedom)
    high = squares / stats.chi2.ppf(1 - confidence, freedom)
    return math.sqrt(low), math.sqrt(high)


def lowest_size(size: float, sigma: float, freedom: float, doubt: float) -> float:
    """The lower limit of the size of a figure that may have either sign, seen at `size` with a
    standard error `sigma` of so many degrees of freedom: a smaller one is seen so large with a
    probability of `doubt` at most. 0 where a figure of 0 is.
    """

    def beyond(true: float) -> float:
        as_large = stats.t.sf((size - true) / sigma, freedom)
        as_large += stats.t.sf((size + true) / sigma, freedom)  # of the other sign
        return float(as_large) - doubt

    if sigma <= 0:
        return size
    if beyond(0.0) >= 0:
        return 0.0
    return float(optimize.brentq(beyond, 0.0, size))


def drawn_limits(
    sums: FloatArray, weights: FloatArray, rng: np.random.Generator, confidence: float
) -> FloatArray:
    """The limits (2,) of sum over weight of cases (n,), by the bootstrap over blocks of them."""
    cases = len(sums)
    blocks = min(MAX_BLOCKS, cases)
    block = np.arange(cases) * blocks // cases
    total = np.bincount(block, sums, blocks)
    weight = np.bincount(block, weights, blocks)
    drawn = rng.integers(0, blocks, (DRAWS, blocks))
    drawn_total = total[drawn].sum(axis=1)
    drawn_weight = weight[drawn].sum(axis=1)
    ratio = drawn_total / np.maximum(drawn_weight, 1e-300)
    return np.asarray(np.quantile(ratio, [1 - confidence, confidence]))
