"""A geometry fitted to centroids of dots: robust least squares in tracker pixels, the smooth field together with the lens."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hilstar.arrays import FloatArray, IntArray
from hilstar.calibrate.geometric.dots import DotPlan
from hilstar.calibrate.geometric.model import TRACKER_ROUND, Geometry, Model, Nominal, directions_in_cam, geometry_of
from hilstar.calibrate.geometric.observed import Observed
from hilstar.scene.lens import Lens, ResidualField, field_terms
from hilstar.units import MAD_TO_SIGMA

HUBER = 2.5  # sigmas: beyond it a residual counts by its size, not by its square
PRIOR = 0.3  # of a parameter's number: so weak that it decides only what the data leave open
# Of the tracker's round terms, which the collimator's can stand for: free, they run away with what neither lens can follow.
# How well they are known is a matter of PRIOR all the same.
ROUND_PRIOR = 30.0
FIELD_PRIOR_PX = 2.0  # sigma of the field's coefficients
FAR_SIGMA = 1e6  # of a centroid that a trial puts behind the lens
MAX_STEPS, MAX_DAMPINGS = 60, 12
FIRST_DAMPING, MIN_DAMPING = 1e-3, 1e-12
MIN_GAIN = 0.02  # a step that lowers the loss by less, in half squares of a sigma, is the last
DIFFERENCE = 1e-5  # of a parameter's number


@dataclass(frozen=True, slots=True)
class Matched:
    """Centroids (n,) and the dot that each is."""

    seen: Observed
    dot: IntArray

    def __len__(self) -> int:
        return len(self.dot)

    def at(self, chosen: IntArray) -> Matched:
        """Those at places `chosen`, or where a mask is true."""
        return Matched(self.seen.at(chosen), self.dot[chosen])


@dataclass(frozen=True, slots=True)
class Problem:
    """What is fitted: the plan's dots, what the bench file says, and a centroid's error in tracker px."""

    plan: DotPlan
    nominal: Nominal
    q_poses: FloatArray
    noise_px: float

    @property
    def monitor_px_per_px(self) -> float:
        """Monitor pixels to a tracker pixel, in the middle."""
        return self.nominal.monitor.focal_length_px / self.nominal.tracker.focal_length_px


@dataclass(frozen=True, slots=True)
class Fit:
    """A fitted model: its numbers (then the coefficients of its field in x and in y), and the geometry that they make."""

    model: Model
    field_degree: int
    numbers: FloatArray
    geometry: Geometry


@dataclass(frozen=True, slots=True)
class _Loss:
    """What is made smallest: Huber's loss of the residuals of `data` and a weak prior, over the model's numbers and, after
    them, the coefficients of its field in x and in y.

    Both at once: a lens that is fitted alone leans over to what only the field can follow, and leaves it more than there was.
    """

    problem: Problem
    model: Model
    field_degree: int
    data: Matched

    def geometry(self, numbers: FloatArray) -> Geometry:
        lens, field = numbers[: self.model.size], numbers[self.model.size :]
        geometry = geometry_of(self.model, self.problem.nominal, self.problem.q_poses, lens)
        if not self.field_degree:
            return geometry
        x, y = field.reshape(2, -1)
        return _with_field(geometry, ResidualField.of_terms(x, y, self.field_degree, geometry.monitor.resolution_px))

    def residuals(self, numbers: FloatArray) -> FloatArray:
        return self._off(self.geometry(numbers))

    def _off(self, geometry: Geometry) -> FloatArray:
        off = residuals_sigma(self.problem, geometry, self.data)
        return np.where(np.isfinite(off), off, FAR_SIGMA)

    def slopes(self, numbers: FloatArray, off: FloatArray) -> FloatArray:
        """By each number (2 n, numbers): differences for the lens; for the field, which is linear, its own terms.

        The field itself hardly changes along a step of the lens: the differences are taken without it.
        """
        lens = numbers[: self.model.size]
        trials = (lens + step for step in DIFFERENCE * np.eye(len(lens)))
        bare, *varied = (geometry_of(self.model, self.problem.nominal, self.problem.q_poses, n) for n in (lens, *trials))
        base = self._off(bare) if self.field_degree else off
        columns = np.stack([(self._off(geometry) - base) / DIFFERENCE for geometry in varied], axis=1)
        if not self.field_degree:
            return columns
        terms = np.nan_to_num(field_terms(*_places_px(bare, self.data), bare.monitor.resolution_px, self.field_degree))
        terms /= (self.problem.monitor_px_per_px * self.data.seen.sigma_px * self.problem.noise_px)[:, None]
        nothing = np.zeros_like(terms)
        return np.hstack([columns, np.block([[terms, nothing], [nothing, terms]])])

    def prior(self, count: int) -> FloatArray:
        weight = np.where(np.arange(count) < self.model.size, PRIOR, 1 / FIELD_PRIOR_PX)
        for k, name in enumerate(self.model.tracker_names, start=len(self.model.names)):
            weight[k] = ROUND_PRIOR if name in TRACKER_ROUND else PRIOR
        return weight**2

    def value(self, off: FloatArray, numbers: FloatArray) -> float:
        size = np.abs(off)
        each = np.where(size <= HUBER, 0.5 * size**2, HUBER * (size - HUBER / 2))
        return float(each.sum() + 0.5 * self.prior(len(numbers)) @ numbers**2)


def fit(problem: Problem, model: Model, field_degree: int, data: Matched, start: FloatArray | None = None) -> Fit:
    """The model with its residual field of a total degree (0 for none) that suits `data` best, searched from `start`."""
    loss = _Loss(problem, model, field_degree, data)
    if start is None and field_degree:
        lens = fit(problem, model, 0, data).numbers
        start = np.concatenate([lens, np.zeros((field_degree + 1) * (field_degree + 2))])
    numbers = _smallest(loss, np.zeros(model.size) if start is None else start)
    return Fit(model, field_degree, numbers, loss.geometry(numbers))


def _smallest(loss: _Loss, numbers: FloatArray) -> FloatArray:
    """The numbers with the smallest loss (Levenberg and Marquardt, reweighted)."""
    prior = loss.prior(len(numbers))
    off, damping = loss.residuals(numbers), FIRST_DAMPING
    value = loss.value(off, numbers)
    for _ in range(MAX_STEPS):
        slopes = loss.slopes(numbers, off)
        weight = np.minimum(1.0, HUBER / np.maximum(np.abs(off), HUBER))
        normal = slopes.T @ (weight[:, None] * slopes) + np.diag(prior)
        downhill = slopes.T @ (weight * off) + prior * numbers
        for _ in range(MAX_DAMPINGS):
            step = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), -downhill)
            new_off = loss.residuals(numbers + step)
            new_value = loss.value(new_off, numbers + step)
            if new_value <= value:
                break
            damping *= 10
        else:
            return numbers
        gain = value - new_value
        numbers, off, value, damping = numbers + step, new_off, new_value, max(damping / 10, MIN_DAMPING)
        if gain <= MIN_GAIN:
            break
    return numbers


def residuals_px(problem: Problem, geometry: Geometry, data: Matched) -> tuple[FloatArray, FloatArray]:
    """How far each centroid is from its dot, x and y (n,), on the monitor but in tracker px."""
    plan, scale = problem.plan, problem.monitor_px_per_px
    x_px, y_px = _places_px(geometry, data)
    return (x_px - plan.x_px[data.dot]) / scale, (y_px - plan.y_px[data.dot]) / scale


def residuals_sigma(problem: Problem, geometry: Geometry, data: Matched) -> FloatArray:
    """The residuals (2 n,), x then y, each in its own sigma."""
    sigma = data.seen.sigma_px * problem.noise_px
    return np.concatenate([part / sigma for part in residuals_px(problem, geometry, data)])


def _places_px(geometry: Geometry, data: Matched) -> tuple[FloatArray, FloatArray]:
    """Where on the monitor, px, the centroids (n,) are by a geometry."""
    directions = directions_in_cam(geometry, data.seen.pose, data.seen.x_px, data.seen.y_px)
    return geometry.monitor.project(directions @ geometry.monitor.cam_to_image.T)


def _with_field(geometry: Geometry, field: ResidualField) -> Geometry:
    camera = geometry.monitor
    return replace(geometry, monitor=replace(camera, lens=replace(camera.lens or Lens(), field=field)))


def noise_of_repeats(data: Matched) -> float | None:
    """The error of one centroid, px, one axis, by how dots repeat in several frames; None where none repeats.

    It knows nothing of the model. By the median of the absolute deviations: a false match or two do not count.
    """
    key = data.seen.pose * (int(data.dot.max(initial=0)) + 1) + data.dot
    order = np.argsort(key, kind="stable")
    deviations = []
    for group in np.split(order, np.flatnonzero(np.diff(key[order])) + 1):
        if len(group) > 2:
            share = np.sqrt(len(group) / (len(group) - 1))
            for part in (data.seen.x_px, data.seen.y_px):
                deviations.append(share * (part[group] - part[group].mean()) / data.seen.sigma_px[group])
    if not deviations:
        return None
    return float(MAD_TO_SIGMA * np.median(np.abs(np.concatenate(deviations))))
