"""Figures of what answers carry beside the attitude, of a campaign's cases: rates, times of
measurement and single stars, as `hilstar assess` has them of a run; and what of aberration, proper
motion and parallax a tracker leaves.

Each is a fit or a mean over frames or stars, with the case as the unit that is independent of
others (see assess/case_fits.py).

    aberration error = bias + share x the turn by v / c; a share of 1 leaves it all
    motion     error = bias + (share x years since the bench's date + age) x the turn in a year by
               the stars' proper motion; a share of 1 leaves the stars where they are
    parallax   error = bias + share x the turn by the stars' parallax + (a nuisance) share x the
               turn by v / c, which goes with the seasons, too
"""

import math

import numpy as np
import numpy.typing as npt

from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.units import ARCSEC_PER_RAD
from hilstar.instruments.assess.bounded_figures import BoundedFigure, TooFewCases
from hilstar.instruments.assess.case_fits import (
    SILENT,
    CaseFit,
    fit_by_cases,
    largest_size,
    refuse_few,
)
from hilstar.instruments.assess.rate_figures import RateTable, rate_figure
from hilstar.instruments.assess.star_figures import StarTable, false_stars, star_figure
from hilstar.instruments.assess.time_figures import time_figure
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
from hilstar.instruments.campaign.plan import (
    MOTION_QUANTITIES,
    PARALLAX,
    STAR_QUANTITIES,
    Require,
)
from hilstar.instruments.campaign.planted import aberration_rad
from hilstar.instruments.campaign.star_motion import (
    OBSERVER_KM_S,
    PARALLAX_TURN,
    YEARLY_TURN,
    YEARS,
)


def answer_figure(
    require: Require,
    cases: Columns,
    axes: list[int],
    resolution_px: tuple[int, int],
    rng: np.random.Generator,
) -> BoundedFigure:
    """The figure that a requirement limits. Raises TooFewCases where the cases do not tell it."""
    quantity = require.quantity
    confidence = require.confidence
    if quantity.startswith("rate-"):
        return rate_figure(quantity, _rate_table(cases), axes, confidence, rng)
    if quantity.startswith("time-"):
        errors, case = _joined(cases, FRAME_ERRORS)
        rates_deg_s, _ = _joined(cases, FRAME_RATES)
        return time_figure(quantity, case, errors, rates_deg_s, confidence, rng)
    if quantity in STAR_QUANTITIES:
        return _star_figure(require, cases, resolution_px, rng)
    if quantity == PARALLAX:
        return _parallax(require, cases)
    if quantity == "aberration":
        return _aberration(require, cases)
    return _proper_motion(require, cases)


def _star_figure(
    require: Require, cases: Columns, resolution_px: tuple[int, int], rng: np.random.Generator
) -> BoundedFigure:
    """A figure of single stars."""
    confidence = require.confidence
    # without a reported star there are no false ones to count, either
    stars = star_table(cases)
    if require.quantity == "false-stars":
        some = cases.numbers[REPORTED_FRAMES] > 0
        frames = cases.numbers[REPORTED_FRAMES][some]
        return false_stars(cases.numbers[FALSE_STARS][some], frames, confidence, rng)
    return star_figure(require.quantity, stars, resolution_px, confidence, rng)


def star_table(cases: Columns) -> StarTable:
    """The stars of a campaign's table. Raises TooFewCases where no star is reported."""
    rows, case = _joined(cases, STAR_LISTS)
    if not len(rows) or not np.isfinite(rows[:, 4]).any():
        raise TooFewCases(SILENT.format("single stars"), 0)
    return StarTable(case, *rows.T)


def _rate_table(cases: Columns) -> RateTable:
    """The rates of a campaign's frames."""
    rates, case = _joined(cases, FRAME_RATES)
    errors, _ = _joined(cases, FRAME_RATE_ERRORS)
    if not len(errors):
        raise TooFewCases(SILENT.format("rate"), 0)
    return RateTable(case, rates, errors, _accelerations(cases)[case])


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


def _accelerations(cases: Columns) -> FloatArray:
    """The angular acceleration of each case (n, 3), deg/s2."""
    count = len(cases.numbers["frames"])
    columns = []
    for axis in AXES:
        name = f"{VARY}acceleration_deg_s2.{axis}"
        columns.append(cases.numbers.get(name, np.zeros(count)))
    return np.stack(columns, axis=1)


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
    refuse_few(case, "attitude")
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
    return largest_size([fit], 2 + term, require.confidence, method)


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
    refuse_few(case, "attitude")
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
    refuse_few(case, "attitude")
    turns = parallax[case]
    q = cases.vectors("q{}", "wxyz")[case]
    both = np.stack([turns, _aberrations_arcsec(q, velocities[case])], axis=2)
    fit = _turn_fit(errors[case], both, case)
    size_arcsec = math.sqrt(float((turns**2).sum(axis=1).mean()))
    method = f"linear fit over turns of {size_arcsec:.2g} arcsec rms, Student's t"
    return _turn_figure(fit, 0, require, method)
