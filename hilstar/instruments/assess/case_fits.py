"""Figures by a fit or a mean over rows that go together by cases: stretches of a run, or the cases
of a campaign.

The case is the unit that is independent of others: covariances are sums over cases (Liang and Zeger
1986; Bell and McCaffrey 2002), bootstraps draw cases. Limits are one-sided, each at `confidence`.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy import stats

from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.instruments.assess.bounded_figures import (
    SMALL_SHARE,
    BoundedFigure,
    TooFewCases,
    lowest_size,
    ratios,
    studentized_limits,
)

MIN_CASES = 8
MAX_EXPONENT = 50.0
HEAVY_SHARE = 0.25  # of the squares: a case that has more says that few cases are too few
SILENT = "the answers carry no {}"


@dataclass(frozen=True, slots=True)
class CaseFit:
    """A least-squares fit over rows of cases: coefficients (k,), their covariance (k, k) by cases,
    the degrees of freedom of each variance (k,), the residuals (n,), and the number of cases.

    `even` (n,) are the residuals scaled up by what each case's own share in the fit took of them:
    their mean square is that of the errors, whether or not those of a case go together.
    """

    value: FloatArray
    covariance: FloatArray
    freedom: FloatArray
    residual: FloatArray
    even: FloatArray
    cases: int


def fit_by_cases(design: FloatArray, values: FloatArray, case: IntArray) -> CaseFit:
    """Fit values (n,) by a design (n, k); rows of one `case` (n,) go together.

    A heavy case draws the fit to itself, and its residuals are too small: they are scaled up so
    that errors of one size give an unbiased covariance. Few heavy cases tell a variance badly: its
    degrees of freedom are those of the cases as they weigh (Bell and McCaffrey 2002).
    """
    inverse = np.asarray(np.linalg.pinv(design.T @ design), dtype=np.float64)
    value = inverse @ (design.T @ values)
    residual = values - design @ value
    number = numbered(case)
    cases = int(number.max()) + 1
    terms = design.shape[1]
    root = _square_root(inverse)
    score = np.zeros((cases, terms))
    weight = np.zeros((cases, terms))  # of each case's errors in a coefficient, squared
    shared = np.zeros((cases, terms, terms))  # what the fit itself takes of that
    even = np.zeros_like(residual)
    rows_by_case = np.split(np.argsort(number, kind="stable"), np.cumsum(np.bincount(number))[:-1])
    for k, rows in enumerate(rows_by_case):
        own_design = design[rows]
        axes, pull, _ = np.linalg.svd(own_design @ root, full_matrices=False)
        free = np.maximum(1 - pull**2, SMALL_SHARE)
        # (1 - H)^-1/2 of the case's own part of the hat matrix H, less 1
        scale = axes * (1 / np.sqrt(free) - 1)
        even[rows] = residual[rows] + scale @ (axes.T @ residual[rows])
        score[k] = own_design.T @ even[rows]
        errors = own_design @ inverse
        errors = errors + scale @ (axes.T @ errors)
        weight[k] = (errors**2).sum(axis=0)
        shared[k] = own_design.T @ errors
    covariance = inverse @ score.T @ score @ inverse
    freedom = np.zeros(terms)
    for term in range(terms):
        freedom[term] = _freedom(weight[:, term], shared[:, :, term], inverse)
    return CaseFit(value, covariance, freedom, residual, even, cases)


def _square_root(inverse: FloatArray) -> FloatArray:
    """A root R (k, k) of a matrix R R^T that is positive, or nearly so."""
    size, axes = np.linalg.eigh(inverse)
    return np.asarray(axes * np.sqrt(np.maximum(size, 0.0)))


def _freedom(weight: FloatArray, shared: FloatArray, inverse: FloatArray) -> float:
    """Satterthwaite's degrees of freedom, tr(B)^2 / tr(B^2), of B = diag(weight) - shared inverse
    shared^T, over cases (n,) and (n, k).
    """
    own = np.einsum("gi,ij,gj->g", shared, inverse, shared)
    product = inverse @ shared.T @ shared
    trace = float(weight.sum() - np.trace(product))
    square = float((weight**2).sum() - 2 * (weight * own).sum() + (product * product.T).sum())
    if trace <= 0 or square <= 0:
        return 1.0
    return max(trace**2 / square, 1.0)


def numbered(case: IntArray) -> IntArray:
    """Cases (n,) numbered from 0, without gaps."""
    _, number = np.unique(case, return_inverse=True)
    return number.reshape(-1)


def refuse_few(case: IntArray, what: str) -> None:
    """Refuse (TooFewCases) rows of too few cases."""
    cases = len(np.unique(case))
    if not cases:
        raise TooFewCases(SILENT.format(what), 0)
    if cases < MIN_CASES:
        why = f"{cases} cases tell it, and {MIN_CASES} are needed"
        raise TooFewCases(why, cases, MIN_CASES - cases)


def largest_size(fits: list[CaseFit], column: int, confidence: float, method: str) -> BoundedFigure:
    """The largest size of a coefficient over fits, with its limits by Student's t."""
    value = np.array([fit.value[column] for fit in fits])
    sigma = np.sqrt([fit.covariance[column, column] for fit in fits])
    freedom = np.array([fit.freedom[column] for fit in fits])
    size = np.abs(value)
    upper = stats.t.ppf(confidence, freedom)
    # Bonferroni: of several axes any one may be the larger
    doubt = (1 - confidence) / len(size)
    low = max(
        lowest_size(*axis, doubt)
        for axis in zip(size.tolist(), sigma.tolist(), freedom.tolist(), strict=True)
    )
    highest = size + upper * sigma
    high = float(highest.max())
    largest = float(size.max())
    return BoundedFigure(largest, low, high, fits[0].cases, method)


def root_mean(
    squares: FloatArray,
    weights: FloatArray,
    case: IntArray,
    confidence: float,
    rng: np.random.Generator,
    method: str = "bootstrap-t over cases",
) -> BoundedFigure:
    """The root of the sum of squares (n,) over that of weights (n,), by the bootstrap-t over cases;
    squares may be below 0.
    """
    number = numbered(case)
    sums = summed(squares, number)
    whole = summed(weights, number)
    low, high = studentized_limits(sums, whole, rng, confidence)
    variance = float(sums.sum() / whole.sum())
    # few cases draw too little of the scatter: the limits are at least those by Student's t, of
    # which the upper one is skew, as a variance is
    if variance > 0 and len(sums) > 1:
        wide = _spread(sums, whole, confidence)
        exponent = min(wide / variance, MAX_EXPONENT)
        high = max(high, variance * math.exp(exponent))
        low = min(low, variance - wide)
    heaviest = float(sums.max())
    if sums.min() >= 0 and heaviest > HEAVY_SHARE * sums.sum():
        share = heaviest / sums.sum()
        method += f"; one case has {share:.0%} of the squares, and more cases would tell"
    value = root_of(variance)
    lower = min(root_of(low), value)
    upper = max(root_of(high), value)
    return BoundedFigure(value, lower, upper, len(sums), method)


def root_of(variance: float) -> float:
    """The square root of a variance, 0 where noise has made it negative."""
    return math.sqrt(max(variance, 0.0))


def _spread(sums: FloatArray, whole: FloatArray, confidence: float) -> float:
    """How far the sum of `sums` (n,) over that of `whole` (n,) may be off, by the cases' scatter:
    fewer cases tell it worse (Satterthwaite).
    """
    squares = (whole / whole.sum()) ** 2
    fourths = squares**2
    effective_cases = float(squares.sum() ** 2 / fourths.sum())
    freedom = max(effective_cases - 1, 1.0)
    _, error = ratios(sums[None], whole[None])
    return float(stats.t.ppf(confidence, freedom) * error[0])


def summed(values: FloatArray, number: IntArray) -> FloatArray:
    """Sums of values (n,) by the number of their case."""
    sums = np.bincount(number, values)
    return np.asarray(sums, dtype=np.float64)
