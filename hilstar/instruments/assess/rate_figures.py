"""The angular rate that answers report against the commanded one, by axis:

reported minus commanded = bias + scale x rate - lag x acceleration + noise
"""

from dataclasses import dataclass

import numpy as np

from hilstar.attitude.clock.rate_causes import UNITS
from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.instruments.assess.bounded_figures import BoundedFigure, TooFewCases
from hilstar.instruments.assess.case_fits import (
    SILENT,
    CaseFit,
    fit_by_cases,
    largest_size,
    refuse_few,
    root_mean,
)

RATE_TERMS = ("rate-bias", "rate-scale", "rate-lag")  # of the linear fit of a rate
RATE_NOISE = "rate-noise"
NEAR_SHARE = 0.1  # by which rates in another unit may be off


@dataclass(frozen=True, slots=True)
class RateTable:
    """Commanded rates (n, 3), deg/s, cam axes, with the errors of the reported ones, NaN where none
    is reported, the angular accelerations (n, 3), deg/s2, and the case (n,) of each row.
    """

    case: IntArray
    rates_deg_s: FloatArray
    errors_deg_s: FloatArray
    accelerations_deg_s2: FloatArray


def rate_figure(
    quantity: str,
    table: RateTable,
    axes: list[int],
    confidence: float,
    rng: np.random.Generator,
) -> BoundedFigure:
    """A figure of the reported rate about these axes, of several the larger one. Raises
    TooFewCases.
    """
    known = np.isfinite(table.errors_deg_s).all(axis=1)
    if not known.any():
        raise TooFewCases(SILENT.format("rate"), 0)
    rates = table.rates_deg_s[known]
    errors = table.errors_deg_s[known]
    accelerations = table.accelerations_deg_s2[known]
    _refuse_other_units(rates, rates + errors)
    case = table.case[known]
    refuse_few(case, "rate")
    fits = []
    for k in axes:
        fits.append(_rate_fit(errors[:, k], rates[:, k], accelerations[:, k], case))
    fitted_cases = fits[0].cases
    if quantity == RATE_NOISE:
        residual = np.stack([fit.residual for fit in fits], axis=1)
        rows = len(case)
        freedom = max(rows - 3, 1) / rows
        squares = (residual**2).mean(axis=1) / freedom
        return root_mean(squares, np.ones(rows), case, confidence, rng)
    if quantity == "rate-scale" and not _varies(rates[:, axes]):
        raise TooFewCases("no case turns at several rates about that axis", fitted_cases)
    if quantity == "rate-lag" and not _varies(accelerations[:, axes]):
        raise TooFewCases("no case accelerates about that axis", fitted_cases)
    column = RATE_TERMS.index(quantity)
    return largest_size(fits, column, confidence, "linear fit, Student's t")


def _refuse_other_units(rates: FloatArray, reported: FloatArray) -> None:
    """Refuse (TooFewCases) reported rates (n, 3) that are the commanded ones in another unit, or of
    the opposite sign: no figure of theirs is the tracker's.
    """
    power = float((rates**2).sum())
    if not power:
        return
    factor = float((rates * reported).sum()) / power
    left = reported - factor * rates
    if float((left**2).sum()) > NEAR_SHARE * float((reported**2).sum()):
        return
    for unit, size in (*UNITS.items(), ("rad/s", 1.0)):
        sign = "" if factor > 0 else " of the opposite sign"
        is_right = unit == "rad/s" and factor > 0
        if not is_right and abs(abs(factor) / size - 1) < NEAR_SHARE:
            raise TooFewCases(
                f"the reported rates are {factor:.4g} times the commanded ones, as in {unit}{sign};"
                " send the turn of cam with respect to icrs in cam axes, rad/s",
                0,
            )


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
