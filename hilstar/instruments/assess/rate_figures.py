"""The angular rate that answers report against the commanded one, by axis:

reported minus commanded = bias + scale x rate - lag x acceleration + noise
"""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from hilstar.attitude.clock.rate_causes import UNITS
from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.units import MAD_TO_SIGMA
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
WILD_SIGMAS = 8.0  # of a rate's noise; as of an attitude's
WILD_SHARE = 0.04  # of rates that may be left out: one case of 25
WILD_ROUNDS = 3
SMALL_DEG_S = 1e-9
LEFT_OUT = f"left out, beyond {WILD_SIGMAS:g} sigmas"
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

    def some(self, chosen: npt.NDArray[np.bool_]) -> "RateTable":
        """The chosen (n,) rows alone."""
        return RateTable(
            self.case[chosen],
            self.rates_deg_s[chosen],
            self.errors_deg_s[chosen],
            self.accelerations_deg_s2[chosen],
        )

    def fits(self, axes: list[int]) -> list[CaseFit]:
        """The fit of the errors about each of these axes, with terms in the order of RATE_TERMS."""
        ones = np.ones(len(self.case))
        fits = []
        for k in axes:
            columns = [ones, self.rates_deg_s[:, k], -self.accelerations_deg_s2[:, k]]
            design = np.stack(columns, axis=1)
            fits.append(fit_by_cases(design, self.errors_deg_s[:, k], self.case))
        return fits


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
    known = np.asarray(np.isfinite(table.errors_deg_s).all(axis=1), dtype=np.bool_)
    if not known.any():
        raise TooFewCases(SILENT.format("rate"), 0)
    told = table.some(known)
    _refuse_other_units(told.rates_deg_s, told.rates_deg_s + told.errors_deg_s)
    refuse_few(told.case, "rate")
    if quantity == RATE_NOISE:
        return _rate_noise(told, axes, confidence, rng)
    fits = told.fits(axes)
    fitted_cases = fits[0].cases
    if quantity == "rate-scale" and not _varies(told.rates_deg_s[:, axes]):
        raise TooFewCases("no case turns at several rates about that axis", fitted_cases)
    if quantity == "rate-lag" and not _varies(told.accelerations_deg_s2[:, axes]):
        raise TooFewCases("no case accelerates about that axis", fitted_cases)
    column = RATE_TERMS.index(quantity)
    return largest_size(fits, column, confidence, "linear fit, Student's t")


def _rate_noise(
    table: RateTable, axes: list[int], confidence: float, rng: np.random.Generator
) -> BoundedFigure:
    """The noise of the reported rate about its fit.

    A field of a few stars close together tells a turn many times worse than most do, and is rare:
    so few cases never tell how often. Its rates count as wild, and the method says how many.
    """
    residual = np.stack([fit.residual for fit in table.fits(axes)], axis=1)
    near = _near_rates(residual)
    kept = table.some(near)
    noise = np.stack([fit.even for fit in kept.fits(axes)], axis=1)
    squares = (noise**2).mean(axis=1)
    figure = root_mean(squares, np.ones(len(squares)), kept.case, confidence, rng)
    wild = int((~near).sum())
    if not wild:
        return figure
    return replace(figure, method=f"{figure.method}; {wild} of {len(near)} rates {LEFT_OUT}")


def _near_rates(residual: FloatArray) -> npt.NDArray[np.bool_]:
    """Which residuals (n, k) are within WILD_SIGMAS scatters about every axis. All are where more
    than WILD_SHARE are beyond: so many are no outliers, but what the tracker does.
    """
    size = np.abs(residual)
    near = np.ones(len(residual), dtype=np.bool_)
    for _ in range(WILD_ROUNDS):
        scatter = MAD_TO_SIGMA * np.median(size[near], axis=0)
        within = size <= WILD_SIGMAS * np.maximum(scatter, SMALL_DEG_S)
        near = np.asarray(within.all(axis=1), dtype=np.bool_)
    if 1 - near.mean() > WILD_SHARE:
        near[:] = True
    return near


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
