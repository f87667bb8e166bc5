"""Figures of cases with their one-sided limits, and the statistics that give such limits."""

import math
from dataclasses import dataclass

import numpy as np
from scipy import optimize, stats

from hilstar.basics.arrays import FloatArray, IntArray

MAX_BLOCKS, DRAWS = 200, 1000  # the bootstrap's
MIN_ERROR_SHARE = 1e-3  # of a standard error that a draw of nearly equal cases has at least
SMALL_SHARE = 1e-3  # of a sum that all cases but a heavy one have


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
    total, weight, drawn = _drawn_blocks(sums, weights, rng)
    drawn_total = total[drawn].sum(axis=1)
    drawn_weight = weight[drawn].sum(axis=1)
    ratio = drawn_total / np.maximum(drawn_weight, 1e-300)
    return np.asarray(np.quantile(ratio, [1 - confidence, confidence]))


def studentized_limits(
    sums: FloatArray, weights: FloatArray, rng: np.random.Generator, confidence: float
) -> tuple[float, float]:
    """The limits of sum over weight of cases (n,), by the bootstrap-t over blocks of them (Hall
    1988).

    Of cases that differ, as noise by the field's stars does, a few heavy ones set both the figure
    and its standard error: without one both are too small. So each draw is off by so many of its
    own standard errors, and the upper end is the longer one.
    """
    total, weight, drawn = _drawn_blocks(sums, weights, rng)
    value, error = ratios(total[None], weight[None])
    if not error[0]:  # cases that are all alike, as of a tracker without noise
        return float(value[0]), float(value[0])
    drawn_value, drawn_error = ratios(total[drawn], weight[drawn])
    off = (drawn_value - value) / np.maximum(drawn_error, MIN_ERROR_SHARE * error)
    least, most = np.quantile(off, [1 - confidence, confidence])
    return float(value[0] - most * error[0]), float(value[0] - least * error[0])


def _drawn_blocks(
    sums: FloatArray, weights: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Sums and weights of blocks (b,) of cases (n,), and the blocks (draws, b) that are drawn."""
    cases = len(sums)
    blocks = min(MAX_BLOCKS, cases)
    block = np.arange(cases) * blocks // cases
    total = np.asarray(np.bincount(block, sums, blocks), dtype=np.float64)
    weight = np.asarray(np.bincount(block, weights, blocks), dtype=np.float64)
    drawn = rng.integers(0, blocks, (DRAWS, blocks))
    return total, weight, np.asarray(drawn, dtype=np.intp)


def ratios(sums: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The ratio (m,) of sums to weights (m, n), and its standard error: a heavy case draws the
    ratio to itself, so its residual counts more (MacKinnon and White 1985, HC3).
    """
    whole = weights.sum(axis=1, keepdims=True)
    ratio = sums.sum(axis=1, keepdims=True) / np.maximum(whole, 1e-300)
    left = np.maximum(1 - weights / np.maximum(whole, 1e-300), SMALL_SHARE)
    residual = (sums - weights * ratio) / left
    error = np.sqrt((residual**2).sum(axis=1)) / np.maximum(whole[:, 0], 1e-300)
    return ratio[:, 0], error
