"""Figures of what answers carry beside the attitude: rates, times of measurement, single stars; and
the aberration that a tracker leaves.

Each is a linear fit or a mean over frames or stars, with the case as the unit that is independent
of others: covariances are sums over cases (Liang and Zeger 1986; Bell and McCaffrey 2002),
bootstraps draw cases.

    rate       reported minus commanded = bias + scale x rate - lag x acceleration, by axis
    time       error = bias of each axis + (stamp's bias) x rate; what a late stamp adds is along
               the motion, and turns its sign with the slew
    jitter     along a slew the error's variance exceeds that across it by (rate x jitter)^2
    aberration error = bias + share x the turn by v / c; a share of 1 leaves it all
    motion     error = bias + (share x years since the bench's date + age) x the turn in a year by
               the stars' proper motion; a share of 1 leaves the stars where they are
    parallax   error = bias + share x the turn by the stars' parallax + (a nuisance) share x the
               turn by v / c, which goes with the seasons, too
    stars      place error = a smooth map over the detector + noise; signal against B-V; a logistic
               curve of detection against V
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import optimize, stats

from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.units import ARCSEC_PER_RAD, MAD_TO_SIGMA
from hilstar.instruments.campaign.case_motion import AXES
from hilstar.instruments.campaign.case_table import VARY, Columns
from hilstar.instruments.campaign.cases import (
    FALSE_STARS,
    FRAME_ERRORS,
    FRAME_RATE_ERRORS,
    FRAME_RATES,
    REPORTED_FRAMES,
    STAR_LISTS,
    Q,
)
from hilstar.instruments.campaign.figures import (
    BoundedFigure,
    TooFewCases,
    drawn_limits,
    lowest_size,
)
from hilstar.instruments.campaign.plan import MOTION_QUANTITIES, PARALLAX, Require
from hilstar.instruments.campaign.planted import aberration_rad
from hilstar.instruments.campaign.star_motion import (
    OBSERVER_KM_S,
    PARALLAX_TURN,
    YEARLY_TURN,
    YEARS,
)
from hilstar.optics.camera import field_terms

MIN_CASES = 8
MAP_DEGREE = 5  # of the polynomials of a star's place error over the detector
WILD_SIGMAS = 6.0
SMALL_RATE_DEG_S = 1e-6
MAX_EXPONENT = 50.0
SMALL_SHARE = 1e-3  # of a sum that all cases but a heavy one have
JITTER_ROUNDS = 3  # of weights by the jitter that the last ones gave
LIMIT_BIN_MAG = 0.05
LIMIT_DRAWS = 200  # of the bootstrap of a detection curve
MIN_SLOPE_MAG = 0.01  # width of a detection curve: a sharper one cannot be told from its bins
RATE_TERMS = ("rate-bias", "rate-scale", "rate-lag")  # of the linear fit of a rate
SILENT = "the answers carry no {}"


@dataclass(frozen=True, slots=True)
class CaseFit:
    """A least-squares fit over rows of cases: coefficients (k,), their covariance (k, k) by cases,
    the degrees of freedom of each variance (k,), the residuals (n,), and the number of cases.
    """

    value: FloatArray
    covariance: FloatArray
    freedom: FloatArray
    residual: FloatArray
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
    number = _numbered(case)
    cases = int(number.max()) + 1
    terms = design.shape[1]
    root = _square_root(inverse)
    score = np.zeros((cases, terms))
    weight = np.zeros((cases, terms))  # of each case's errors in a coefficient, squared
    shared = np.zeros((cases, terms, terms))  # what the fit itself takes of that
    rows_by_case = np.split(np.argsort(number, kind="stable"), np.cumsum(np.bincount(number))[:-1])
    for k, rows in enumerate(rows_by_case):
        own = design[rows]
        axes, pull, _ = np.linalg.svd(own @ root, full_matrices=False)
        free = np.maximum(1 - pull**2, SMALL_SHARE)
        # (1 - H)^-1/2 of the case's own part of the hat matrix H, less 1
        scale = axes * (1 / np.sqrt(free) - 1)
        score[k] = own.T @ (residual[rows] + scale @ (axes.T @ residual[rows]))
        errors = own @ inverse
        errors = errors + scale @ (axes.T @ errors)
        weight[k] = (errors**2).sum(axis=0)
        shared[k] = own.T @ errors
    covariance = inverse @ score.T @ score @ inverse
    freedom = np.zeros(terms)
    for term in range(terms):
        freedom[term] = _freedom(weight[:, term], shared[:, :, term], inverse)
    return CaseFit(value, covariance, freedom, residual, cases)


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


def _numbered(case: IntArray) -> IntArray:
    """Cases (n,) numbered from 0, without gaps."""
    _, number = np.unique(case, return_inverse=True)
    return number.reshape(-1)


def answer_figure(
    require: Require,
    cases: Columns,
    axes: list[int],
    resolution_px: tuple[int, int],
    rng: np.random.Generator,
) -> BoundedFigure:
    """The figure that a requirement limits. Raises TooFewCases where the cases do not tell it."""
    quantity = require.quantity
    if quantity.startswith("rate-"):
        return _rate_figure(require, cases, axes, rng)
    if quantity.startswith("time-"):
        return _time_figure(require, cases, rng)
    if quantity == "aberration":
        return _aberration(require, cases)
    if quantity in MOTION_QUANTITIES:
        return _proper_motion(require, cases)
    if quantity == PARALLAX:
        return _parallax(require, cases)
    return _star_figure(require, cases, resolution_px, rng)


def _star_figure(
    require: Require, cases: Columns, resolution_px: tuple[int, int], rng: np.random.Generator
) -> BoundedFigure:
    """A figure of single stars."""
    quantity = require.quantity
    # without a reported star there are no false ones to count, either
    stars = StarTable.of(cases)
    if quantity == "star-noise":
        return _star_noise(require, stars, resolution_px, rng)
    if quantity == "star-fov-error":
        return _star_map(require, stars, resolution_px, rng)
    if quantity == "star-colour":
        return _star_colour(require, stars)
    if quantity == "star-limit":
        return _star_limit(require, stars, rng)
    return _false_stars(require, cases, rng)


def _joined(cases: Columns, names: tuple[str, ...]) -> tuple[FloatArray, IntArray]:
    """Lists of columns side by side (n, k), and the case of each row (n,)."""
    counts = list(map(len, cases.lists.get(names[0], [])))
    case = np.repeat(np.arange(len(counts)), counts)
    if not len(case):
        return np.zeros((0, len(names))), case
    columns = []
    for name in names:
        lists = cases.lists.get(name, [])
        columns.append(np.concatenate(lists))
    return np.stack(columns, axis=1), case


def _enough(case: IntArray, what: str) -> None:
    """Refuse (TooFewCases) rows of too few cases."""
    cases = len(np.unique(case))
    if not cases:
        raise TooFewCases(SILENT.format(what), 0)
    if cases < MIN_CASES:
        why = f"{cases} cases tell it, and {MIN_CASES} are needed"
        raise TooFewCases(why, cases, MIN_CASES - cases)


def _size(fits: list[CaseFit], column: int, confidence: float, method: str) -> BoundedFigure:
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


def _root_mean(
    squares: FloatArray,
    weights: FloatArray,
    case: IntArray,
    require: Require,
    rng: np.random.Generator,
    method: str = "bootstrap over cases",
) -> BoundedFigure:
    """The root of the sum of squares (n,) over that of weights (n,), by the bootstrap over cases;
    squares may be below 0.
    """
    number = _numbered(case)
    sums = _summed(squares, number)
    whole = _summed(weights, number)
    c = require.confidence
    low, high = drawn_limits(sums, whole, rng, c).tolist()
    variance = float(sums.sum() / whole.sum())
    # few cases draw limits that are too narrow: by their scatter and Student's t they are wider,
    # and skew, as a variance is
    if variance > 0 and len(sums) > 1:
        wide = _spread(sums, whole, c)
        exponent = min(wide / variance, MAX_EXPONENT)
        high = max(high, variance * math.exp(exponent))
        low = min(low, variance - wide)
    value = _root(variance)
    lower = min(_root(low), value)
    upper = max(_root(high), value)
    return BoundedFigure(value, lower, upper, len(sums), method)


def _root(variance: float) -> float:
    """The square root of a variance, 0 where noise has made it negative."""
    return math.sqrt(max(variance, 0.0))


def _spread(sums: FloatArray, whole: FloatArray, confidence: float) -> float:
    """How far the sum of `sums` (n,) over that of `whole` (n,) may be off, by the cases' scatter.

    A heavy case draws the ratio to itself, so its residual counts more (MacKinnon and White 1985,
    HC3), and fewer cases tell the scatter (Satterthwaite).
    """
    total = whole.sum()
    share = whole / total
    residual = sums - whole * sums.sum() / total
    off = residual / np.maximum(1 - share, SMALL_SHARE)
    squares = share**2
    fourths = squares**2
    effective_cases = float(squares.sum() ** 2 / fourths.sum())
    freedom = max(effective_cases - 1, 1.0)
    off_square = float((off**2).sum())
    sigma = math.sqrt(off_square) / float(total)
    return float(stats.t.ppf(confidence, freedom)) * sigma


def _summed(values: FloatArray, number: IntArray) -> FloatArray:
    """Sums of values (n,) by the number of their case."""
    sums = np.bincount(number, values)
    return np.asarray(sums, dtype=np.float64)


# ---- angular rate ----


def _rate_figure(
    require: Require, cases: Columns, axes: list[int], rng: np.random.Generator
) -> BoundedFigure:
    rates, case = _joined(cases, FRAME_RATES)
    errors, _ = _joined(cases, FRAME_RATE_ERRORS)
    if not len(errors):
        raise TooFewCases(SILENT.format("rate"), 0)
    known = np.isfinite(errors).all(axis=1)
    rates, errors, case = rates[known], errors[known], case[known]
    _enough(case, "rate")
    accelerations = _accelerations(cases)[case]
    fits = []
    for k in axes:
        fits.append(_rate_fit(errors[:, k], rates[:, k], accelerations[:, k], case))
    fitted_cases = fits[0].cases
    quantity = require.quantity
    if quantity == "rate-noise":
        residual = np.stack([fit.residual for fit in fits], axis=1)
        rows = len(case)
        freedom = max(rows - 3, 1) / rows
        squares = (residual**2).mean(axis=1) / freedom
        return _root_mean(squares, np.ones(rows), case, require, rng)
    if quantity == "rate-scale" and not _varies(rates[:, axes]):
        raise TooFewCases("no case turns at several rates about that axis", fitted_cases)
    if quantity == "rate-lag" and not _varies(accelerations[:, axes]):
        raise TooFewCases("no case accelerates about that axis", fitted_cases)
    column = RATE_TERMS.index(quantity)
    return _size(fits, column, require.confidence, "linear fit, Student's t")


def _varies(values: FloatArray) -> bool:
    """Whether every column of values (n, k) has more than one value."""
    return bool(np.ptp(values, axis=0).all())


def _rate_fit(
    error: FloatArray, rate: FloatArray, acceleration: FloatArray, case: IntArray
) -> CaseFit:
    # the terms in the order of RATE_TERMS
    ones = np.ones(len(rate))
    design = np.stack([ones, rate, -acceleration], axis=1)
    return fit_by_cases(design, error, case)


def _accelerations(cases: Columns) -> FloatArray:
    """The angular acceleration of each case (n, 3), deg/s2."""
    count = len(cases.numbers["frames"])
    columns = []
    for axis in AXES:
        name = f"{VARY}acceleration_deg_s2.{axis}"
        columns.append(cases.numbers.get(name, np.zeros(count)))
    return np.stack(columns, axis=1)


# ---- time of measurement ----


def _time_figure(require: Require, cases: Columns, rng: np.random.Generator) -> BoundedFigure:
    errors, case = _joined(cases, FRAME_ERRORS)
    rates_deg_s, _ = _joined(cases, FRAME_RATES)
    _enough(case, "attitude")
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
    if require.quantity == "time-bias":
        method = "linear fit over slews of both signs, Student's t"
        return _column_size(fit, 3, require, method)
    residual = fit.residual.reshape(3, -1).T * noise
    return _jitter(require, residual, rates, case, rng)


def _both_signs(rates_deg_s: FloatArray) -> bool:
    """Whether some axis turns in both senses, by rates (n, 3)."""
    turning = np.abs(rates_deg_s).max(axis=1) > SMALL_RATE_DEG_S
    if not turning.any():
        return False
    senses = np.sign(rates_deg_s[turning])
    return bool(np.ptp(senses, axis=0).max() >= 2)


def _column_size(fit: CaseFit, column: int, require: Require, method: str) -> BoundedFigure:
    """The size of a coefficient of a fit, with its limits."""
    return _size([fit], column, require.confidence, method)


def _jitter(
    require: Require,
    residual: FloatArray,
    rates: FloatArray,
    case: IntArray,
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
    method = "excess of the error along slews over that across them, bootstrap over cases"
    variance = float(normal_square.mean())
    weights = _jitter_weights(excess, square, variance)
    return _root_mean(excess * weights, square * weights, slewing, require, rng, method)


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


# ---- aberration ----


def _aberration(require: Require, cases: Columns) -> BoundedFigure:
    errors = cases.vectors("error_{}_arcsec", "xyz")[:, :2]
    count = len(errors)
    velocity = []
    for k in range(3):
        name = f"{VARY}sky.observer_velocity_km_s.{k}"
        velocity.append(cases.numbers.get(name, np.zeros(count)))
    q = np.stack([cases.numbers[name] for name in Q], axis=1)
    known = _finite_rows(errors) & _finite_rows(q)
    velocities = np.stack(velocity, axis=1)
    if not known.any() or not np.ptp(velocities[known], axis=0).any():
        raise TooFewCases("cases at several velocities of the observer tell it", int(known.sum()))
    case = np.flatnonzero(known)
    _enough(case, "attitude")
    predicted = _aberrations_arcsec(q[case], velocities[case])
    fit = _turn_fit(errors[case], predicted[:, :, None], case)
    method = "linear fit over the observer's velocity, Student's t"
    return _turn_figure(fit, 0, require, method)


def _aberrations_arcsec(q: FloatArray, velocities_km_s: FloatArray) -> FloatArray:
    """The turns (n, 2), cam, across, of attitudes (n, 4) that take the aberration of velocities
    (n, 3), ICRS, for none.
    """
    turns = np.zeros((len(q), 2))
    for k, velocity_km_s in enumerate(velocities_km_s):
        turns[k] = aberration_rad(q[k], velocity_km_s)[:2]
    return ARCSEC_PER_RAD * turns


def _finite_rows(values: FloatArray) -> npt.NDArray[np.bool_]:
    """Which rows of values (n, k) have no gap."""
    return np.asarray(np.isfinite(values).all(axis=1), dtype=np.bool_)


def _turn_fit(errors: FloatArray, predicted: FloatArray, case: IntArray) -> CaseFit:
    """The fit of errors (n, 2) of each case, across, by a bias of each axis and by predicted turns
    (n, 2, k).
    """
    count, axes, terms = predicted.shape
    design = np.zeros((axes * count, axes + terms))
    for k in range(axes):
        rows = slice(k * count, (k + 1) * count)
        design[rows, k] = 1.0
        design[rows, axes:] = predicted[:, k]
    return fit_by_cases(design, errors.T.ravel(), np.tile(case, axes))


def _turn_figure(fit: CaseFit, term: int, require: Require, method: str) -> BoundedFigure:
    """The figure of a term of `_turn_fit`."""
    return _column_size(fit, 2 + term, require, method)


# ---- proper motion ----


def _proper_motion(require: Require, cases: Columns) -> BoundedFigure:
    """The share of proper motion that the attitude has not followed, or the age of the places at
    the bench's date.
    """
    errors = cases.vectors("error_{}_arcsec", "xyz")[:, :2]
    yearly = cases.vectors(YEARLY_TURN, "xy")
    years = cases.numbers[YEARS]
    known = _finite_rows(errors) & _finite_rows(yearly)
    case = np.flatnonzero(known)
    _enough(case, "attitude")
    if require.quantity == "proper-motion" and not np.ptp(years[case]):
        raise TooFewCases("cases at several dates tell it", len(case))
    a_year = yearly[case]
    since_date = a_year * years[case, None]
    turns = np.stack([since_date, a_year], axis=2)
    fit = _turn_fit(errors[case], turns, case)
    term = MOTION_QUANTITIES.index(require.quantity)
    method = "linear fit over the yearly turn of each field, Student's t"
    return _turn_figure(fit, term, require, method)


# ---- parallax ----


def _parallax(require: Require, cases: Columns) -> BoundedFigure:
    """The share of the stars' parallax that is left in the attitude."""
    errors = cases.vectors("error_{}_arcsec", "xyz")[:, :2]
    parallax = cases.vectors(PARALLAX_TURN, "xy")
    velocities = cases.vectors(OBSERVER_KM_S, "xyz")
    if not np.isfinite(velocities).any():
        raise TooFewCases("cases with an observer, such as [spacecraft] has, tell it", 0)
    known = _finite_rows(errors) & _finite_rows(parallax) & _finite_rows(velocities)
    case = np.flatnonzero(known)
    _enough(case, "attitude")
    turns = parallax[case]
    q = cases.vectors("q{}", "wxyz")[case]
    both = np.stack([turns, _aberrations_arcsec(q, velocities[case])], axis=2)
    fit = _turn_fit(errors[case], both, case)
    size_arcsec = math.sqrt(float((turns**2).sum(axis=1).mean()))
    method = f"linear fit over turns of {size_arcsec:.2g} arcsec rms, Student's t"
    return _turn_figure(fit, 0, require, method)


# ---- single stars ----


@dataclass(frozen=True, slots=True)
class StarTable:
    """Lit stars (n,) of all cases and their reports, by the names of STAR_LISTS; `case` (n,)."""

    case: IntArray
    x_px: FloatArray
    y_px: FloatArray
    v_mag: FloatArray
    bv: FloatArray
    dx_px: FloatArray
    dy_px: FloatArray
    signal_mag: FloatArray

    @classmethod
    def of(cls, cases: Columns) -> "StarTable":
        """The stars of a campaign's table. Raises TooFewCases where no star is reported."""
        rows, case = _joined(cases, STAR_LISTS)
        if not len(rows) or not np.isfinite(rows[:, 4]).any():
            raise TooFewCases(SILENT.format("single stars"), 0)
        return cls(case, *rows.T)

    @property
    def found(self) -> npt.NDArray[np.bool_]:
        """Which stars (n,) were reported."""
        return np.isfinite(self.dx_px)


@dataclass(frozen=True, slots=True)
class PlaceFit:
    """The map of stars' place errors: polynomials (terms, 2), the stars in it (n,) by their case,
    their errors by the map and the residuals (n, 2), px.
    """

    solution: FloatArray
    case: IntArray
    fitted_px: FloatArray
    residual_px: FloatArray


@dataclass(frozen=True, slots=True)
class PlaceOffsets:
    """Places (n,) on the detector and how far reported stars are off there, px."""

    x_px: FloatArray
    y_px: FloatArray
    dx_px: FloatArray
    dy_px: FloatArray


def fitted_places(stars: StarTable, resolution_px: tuple[int, int]) -> PlaceFit:
    """The map of reported stars' place errors; wild ones do not count. Raises TooFewCases."""
    reported = np.flatnonzero(stars.found)
    offsets = np.stack([stars.dx_px, stars.dy_px], axis=1)[reported]
    terms = field_terms(stars.x_px[reported], stars.y_px[reported], resolution_px, MAP_DEGREE)
    needed = 4 * terms.shape[1]
    near = np.ones(len(reported), dtype=np.bool_)
    for _ in range(3):
        if near.sum() < needed:
            raise TooFewCases(f"{int(near.sum())} stars, and {needed} are needed for a map", 0)
        found_terms = np.linalg.lstsq(terms[near], offsets[near], rcond=None)[0]
        solution = np.asarray(found_terms, dtype=np.float64)
        residual = offsets - terms @ solution
        distance = np.abs(residual)
        spread = MAD_TO_SIGMA * np.median(distance[near], axis=0)
        close = distance <= WILD_SIGMAS * np.maximum(spread, 1e-9)
        near = np.asarray(close.all(axis=1), dtype=np.bool_)
    fitted = terms[near] @ solution
    case = stars.case[reported][near]
    return PlaceFit(solution, case, fitted, residual[near])


def place_map(found: StarTable, resolution_px: tuple[int, int], side: int) -> PlaceOffsets:
    """The map at `side` by `side` places of the detector, less its mean. Raises TooFewCases."""
    fit = fitted_places(found, resolution_px)
    width, height = resolution_px
    centres = np.arange(side) + 0.5
    columns_px, rows_px = np.meshgrid(centres * width / side, centres * height / side)
    x_px, y_px = columns_px.ravel(), rows_px.ravel()
    terms = field_terms(x_px, y_px, resolution_px, MAP_DEGREE)
    offsets = terms @ fit.solution
    offsets = offsets - offsets.mean(axis=0)
    dx_px, dy_px = offsets.T
    return PlaceOffsets(x_px, y_px, dx_px, dy_px)


def _star_noise(
    require: Require, found: StarTable, resolution_px: tuple[int, int], rng: np.random.Generator
) -> BoundedFigure:
    """The noise of stars' places about their map, px an axis."""
    fit = fitted_places(found, resolution_px)
    count = len(fit.case)
    freedom = count - len(fit.solution)
    squares = (fit.residual_px**2).mean(axis=1) * count / freedom
    return _root_mean(squares, np.ones(count), fit.case, require, rng, _map_method(count))


def _map_method(stars: int) -> str:
    return f"map of degree {MAP_DEGREE} over {stars} stars, bootstrap over cases"


def _star_map(
    require: Require, found: StarTable, resolution_px: tuple[int, int], rng: np.random.Generator
) -> BoundedFigure:
    """The rms of the map of stars' places, px an axis."""
    fit = fitted_places(found, resolution_px)
    count = len(fit.case)
    terms = len(fit.solution)
    residual_square = float((fit.residual_px**2).sum())
    variance = residual_square / (2 * (count - terms))
    fitted = fit.fitted_px - fit.fitted_px.mean(axis=0)
    # what the noise alone puts into so many terms
    taken = variance * (terms - 1) / count
    number = _numbered(fit.case)
    squares = (fitted**2).mean(axis=1)
    sums = _summed(squares, number)
    counts = _summed(np.ones(count), number)
    low, high = drawn_limits(sums, counts, rng, require.confidence).tolist()
    power = float(sums.sum() / counts.sum()) - taken
    # the spread of the fit's own power by noise: each term has one degree of freedom an axis
    free = 2 * (terms - 1)
    sigmas = float(stats.norm.ppf(require.confidence))
    hidden = sigmas * taken * math.sqrt(2 / free)
    mixed = max(power, 0.0) * variance / (2 * count)
    hidden += 2 * math.sqrt(mixed)
    upper = max(high - taken, power) + hidden
    lower = min(low - taken, power) - hidden
    return BoundedFigure(_root(power), _root(lower), _root(upper), len(counts), _map_method(count))


def _star_colour(require: Require, found: StarTable) -> BoundedFigure:
    """How a star's signal goes with its B-V, magnitudes a magnitude."""
    known = np.isfinite(found.signal_mag) & np.isfinite(found.bv)
    _enough(found.case[known], "stars' signal")
    signal = found.signal_mag[known]
    off = np.abs(signal - np.median(signal))
    middle = max(float(np.median(off)), 1e-9)
    near = off <= WILD_SIGMAS * MAD_TO_SIGMA * middle
    bv = found.bv[known][near]
    case = found.case[known][near]
    design = np.stack([np.ones(len(bv)), bv], axis=1)
    fit = fit_by_cases(design, signal[near], case)
    method = f"linear fit over B-V of {len(bv)} stars, Student's t"
    return _column_size(fit, 1, require, method)


def _star_limit(require: Require, found: StarTable, rng: np.random.Generator) -> BoundedFigure:
    """The V at which half of the stars are reported."""
    _enough(found.case, "single stars")
    place = np.floor(found.v_mag / LIMIT_BIN_MAG).astype(np.int64)
    first = int(place.min())
    bins = int(place.max()) - first + 1
    number = _numbered(found.case)
    cases = int(number.max()) + 1
    shape = (cases, bins)
    size = cases * bins
    index = number * bins + place - first
    lit = np.bincount(index, minlength=size).reshape(shape)
    reported = np.bincount(index[found.found], minlength=size).reshape(shape)
    middles = np.arange(bins) + first + 0.5
    middle_mag = np.asarray(middles * LIMIT_BIN_MAG, dtype=np.float64)
    value = half_seen(middle_mag, reported.sum(axis=0), lit.sum(axis=0))
    drawn = []
    for _ in range(LIMIT_DRAWS):
        chosen = rng.integers(0, cases, cases)
        drawn_reported = reported[chosen].sum(axis=0)
        drawn_lit = lit[chosen].sum(axis=0)
        drawn.append(half_seen(middle_mag, drawn_reported, drawn_lit))
    low, high = np.quantile(drawn, [1 - require.confidence, require.confidence])
    # a curve that is sharper than a bin is known to within one
    low = min(float(low), value) - LIMIT_BIN_MAG / 2
    high = max(float(high), value) + LIMIT_BIN_MAG / 2
    method = f"logistic curve over {int(lit.sum())} stars, bootstrap over cases"
    if high >= middle_mag[-1]:
        high = math.inf
        method += "; sky.faintest_v_mag bounds it"
    return BoundedFigure(value, low, high, cases, method)


def half_seen(v_mag: FloatArray, seen: IntArray, lit: IntArray) -> float:
    """The magnitude at which a logistic curve of detection falls to a half: counts of stars seen
    (n,) of those lit (n,) at magnitudes (n,).
    """

    unseen = lit - seen

    def loss(parameters: FloatArray) -> float:
        limit_mag, log_width = parameters
        width = MIN_SLOPE_MAG + math.exp(log_width)
        share = stats.logistic.cdf((limit_mag - v_mag) / width)
        share = np.clip(share, 1e-9, 1 - 1e-9)
        log_likelihood = seen * np.log(share) + unseen * np.log1p(-share)
        return -float(log_likelihood.sum())

    # begun where the counts split best by one magnitude
    faintest_mag = v_mag[-1]
    missed = np.concatenate([[0], np.cumsum(unseen)])
    from_faint = np.cumsum(seen[::-1])
    beyond = np.concatenate([from_faint[::-1], [0]])
    cut = int(np.argmin(missed + beyond))
    half_bin_mag = LIMIT_BIN_MAG / 2
    edges = np.concatenate([v_mag - half_bin_mag, [faintest_mag + half_bin_mag]])
    start = np.array([edges[cut], math.log(0.1)])
    fitted = optimize.minimize(loss, start, method="Nelder-Mead", options={"xatol": 1e-3})
    half_mag = max(fitted.x[0], v_mag[0])
    return float(min(half_mag, faintest_mag))


def _false_stars(require: Require, cases: Columns, rng: np.random.Generator) -> BoundedFigure:
    """False stars a frame."""
    some = cases.numbers[REPORTED_FRAMES] > 0
    frames = cases.numbers[REPORTED_FRAMES][some]
    false = cases.numbers[FALSE_STARS][some]
    count = len(frames)
    if not count:
        raise TooFewCases(SILENT.format("single stars"), 0)
    total = float(false.sum())
    exposed = float(frames.sum())
    c = require.confidence
    low = 0.0
    if total:
        low = float(stats.gamma.ppf(1 - c, total)) / exposed
    high = float(stats.gamma.ppf(c, total + 1)) / exposed
    drawn_low, drawn_high = drawn_limits(false, frames, rng, c).tolist()
    method = "Poisson, or the bootstrap over cases where that is wider"
    return BoundedFigure(total / exposed, min(low, drawn_low), max(high, drawn_high), count, method)
