"""The display's errors of all stars: without their common zero point, and what a wrong geometry explains of them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.error_spread import error_spread
from hilstar.twin.verify.displacement import GeometryFit, fit_geometry
from hilstar.twin.verify.measured import Measured, Star


@dataclass(frozen=True, slots=True)
class DisplayErrors:
    """The stars with their common zero point subtracted; `codes_zero_point_mag` is the one that the codes alone would have.

    `lost` stars have NaN for errors; `geometry` is None with too few stars.
    """

    stars: list[Star]
    lost: list[Star]
    zero_point_mag: float
    codes_zero_point_mag: float
    geometry: GeometryFit | None

    @property
    def looked_for(self) -> int:
        """How many stars should have been found."""
        return len(self.stars) + len(self.lost)

    def flux_mag(self) -> FloatArray:
        """Flux errors (n,), magnitudes, positive too faint."""
        return np.array([star.flux_mag for star in self.stars])

    def centroid_px(self) -> FloatArray:
        """Centroid errors (n,), tracker pixels."""
        return np.array([math.hypot(star.dx_px, star.dy_px) for star in self.stars])

    def codes_mag(self) -> FloatArray:
        """Flux errors (n,) of the codes alone, magnitudes, NaN where the codes alone lose the star."""
        return np.array([star.codes_mag for star in self.stars])

    def codes_px(self) -> FloatArray:
        """Centroid errors (n,) of the codes alone, tracker pixels."""
        return np.array([star.codes_px for star in self.stars])

    def floor_mag(self) -> FloatArray:
        """Flux errors (n,) of the estimator itself, magnitudes, none of them negative."""
        return np.abs([star.floor_mag for star in self.stars])

    def floor_px(self) -> FloatArray:
        """Centroid errors (n,) of the estimator itself, tracker pixels."""
        return np.array([star.floor_px for star in self.stars])


def display_errors(measured: Measured) -> DisplayErrors:
    """The errors of all fields' stars."""
    stars = measured.tally.stars
    zero_point, codes_zero_point = median([s.flux_mag for s in stars]), median([s.codes_mag for s in stars])
    stars = [replace(s, flux_mag=s.flux_mag - zero_point, codes_mag=s.codes_mag - codes_zero_point) for s in stars]
    geometry = fit_geometry(measured.tally.displaced, measured.camera, measured.config.verify.centroid_px)
    return DisplayErrors(stars, measured.tally.lost, zero_point, codes_zero_point, geometry)


def median(values: list[float]) -> float:
    """The median of the finite values, 0 without any."""
    finite_values = [value for value in values if math.isfinite(value)]
    return float(np.median(finite_values)) if finite_values else 0.0


def p95(errors: FloatArray) -> float:
    """The 95th percentile of some errors (n,), 0 without any."""
    return error_spread(errors).p95 or 0.0
