"""How well a fitted geometry is known: parameters with their sigma, and the error of a star's place over the screen."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.calibrate.geometric.fit import DIFFERENCE, FIELD_PRIOR_PX, HUBER, PRIOR, Fit, Matched, Problem, residuals_sigma
from hilstar.calibrate.geometric.model import STEPS, TRACKER_STEPS, Geometry, geometry_of
from hilstar.scene.camera import Camera
from hilstar.scene.lens import Lens, field_terms
from hilstar.units import ARCSEC_PER_RAD, MAD_TO_SIGMA

MAP_PLACES = (17, 11)


@dataclass(frozen=True, slots=True)
class Uncertainty:
    """One sigma of each parameter, and of a star's place: `map_arcsec` (rows, columns) over the screen, edges included,
    NaN where the tracker saw no dots.

    By the covariance of the fit, scaled by its residuals where they are larger than the centroids' noise. What no parameter
    can follow is not in it: the error on dots that were held out is.
    """

    sigma: dict[str, float]
    map_arcsec: FloatArray

    @property
    def rms_arcsec(self) -> float:
        """Over the screen."""
        return float(np.sqrt(np.nanmean(self.map_arcsec**2)))

    @property
    def max_arcsec(self) -> float:
        """At the place that is known worst."""
        return float(np.nanmax(self.map_arcsec))


def uncertainty_of(problem: Problem, fit: Fit, data: Matched) -> Uncertainty:
    """The covariance of a fit to `data`, carried to its parameters and over the screen."""
    monitor = fit.geometry.monitor
    rows = _slopes_of_residuals(problem, fit, data)
    left = np.abs(residuals_sigma(problem, fit.geometry, data))
    rows *= np.sqrt(np.minimum(1.0, HUBER / np.maximum(left, 1e-12)))[:, None]
    size = fit.model.size
    field_numbers = rows.shape[1] - size
    prior = np.concatenate([np.full(size, PRIOR), np.full(field_numbers, 1 / FIELD_PRIOR_PX)])
    covariance = np.linalg.inv(rows.T @ rows + np.diag(prior**2))
    scale = max(1.0, MAD_TO_SIGMA * float(np.median(left)))
    steps = [STEPS[name] for name in fit.model.names] + [TRACKER_STEPS[name] for name in fit.model.tracker_names]
    spread = scale * np.sqrt(np.diag(covariance))
    names = (*fit.model.names, *fit.model.tracker_names)
    sigma = {name: float(step * s) for name, step, s in zip(names, steps, spread, strict=False)}
    place_x, place_y = _slopes_of_places(problem, fit, *_map_px(monitor))
    variance = sum(np.einsum("ni,ij,nj->n", part, covariance, part) for part in (place_x, place_y))
    arcsec = scale * np.sqrt(variance) * ARCSEC_PER_RAD / problem.nominal.monitor.focal_length_px
    return Uncertainty(sigma, arcsec.reshape(MAP_PLACES[::-1]))


def _map_px(monitor: Camera) -> tuple[FloatArray, FloatArray]:
    x, y = np.meshgrid(*(np.linspace(-0.5, size - 0.5, n) for size, n in zip(monitor.resolution_px, MAP_PLACES, strict=True)))
    return x.ravel(), y.ravel()


def _varied(problem: Problem, fit: Fit, number: int) -> Geometry:
    """The geometry with one number a little larger, and the same field."""
    step = np.zeros(fit.model.size)
    step[number] = DIFFERENCE
    varied = geometry_of(fit.model, problem.nominal, problem.q_poses, fit.numbers[: fit.model.size] + step)
    field = fit.geometry.monitor.lens.field if fit.geometry.monitor.lens is not None else None
    lens = varied.monitor.lens if field is None else replace(varied.monitor.lens or Lens(), field=field)
    return replace(varied, monitor=replace(varied.monitor, lens=lens))


def _slopes_of_residuals(problem: Problem, fit: Fit, data: Matched) -> FloatArray:
    """By each number of the model and each coefficient of the field: (2 n, numbers)."""
    base = residuals_sigma(problem, fit.geometry, data)
    varied = [residuals_sigma(problem, _varied(problem, fit, k), data) for k in range(fit.model.size)]
    slopes = np.stack([(each - base) / DIFFERENCE for each in varied], axis=1)
    if not fit.field_degree:
        return np.asarray(slopes)
    dots = problem.plan
    terms = field_terms(dots.x_px[data.dot], dots.y_px[data.dot], problem.nominal.monitor.resolution_px, fit.field_degree)
    terms = terms / (problem.monitor_px_per_px * data.seen.sigma_px * problem.noise_px)[:, None]
    return np.hstack([slopes, _blocks(terms)])


def _slopes_of_places(problem: Problem, fit: Fit, x_px: FloatArray, y_px: FloatArray) -> tuple[FloatArray, FloatArray]:
    """How the places of the directions that now are at (x, y) move by each number, monitor px: (n, numbers) each."""
    monitor = fit.geometry.monitor
    directions = monitor.rays(x_px, y_px)
    moved = []
    for k in range(fit.model.size):
        varied = _varied(problem, fit, k).monitor
        moved.append(varied.project(directions @ varied.cam_to_image.T))
    columns = (
        np.stack([(x - x_px) / DIFFERENCE for x, _ in moved], axis=1),
        np.stack([(y - y_px) / DIFFERENCE for _, y in moved], axis=1),
    )
    if not fit.field_degree:
        return columns
    terms = field_terms(x_px, y_px, monitor.resolution_px, fit.field_degree)
    nothing = np.zeros_like(terms)
    return np.hstack([columns[0], terms, nothing]), np.hstack([columns[1], nothing, terms])


def _blocks(terms: FloatArray) -> FloatArray:
    nothing = np.zeros_like(terms)
    return np.block([[terms, nothing], [nothing, terms]])
