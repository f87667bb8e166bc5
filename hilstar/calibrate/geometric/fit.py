"""A geometry fitted to centroids of dots: robust least squares in tracker pixels, then a smooth field on what is left."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from hilstar.arrays import FloatArray, IntArray
from hilstar.calibrate.geometric.dots import DotPlan
from hilstar.calibrate.geometric.model import Geometry, Model, Nominal, directions_in_cam, geometry_of
from hilstar.calibrate.geometric.observed import Observed
from hilstar.scene.camera import Camera
from hilstar.scene.lens import Lens, ResidualField, field_terms
from hilstar.units import MAD_TO_SIGMA

HUBER = 2.5  # sigmas: beyond it a residual counts by its size, not by its square
PRIOR = 0.3  # of a parameter's number: so weak that it decides only what the data leave open
FIELD_PRIOR_PX = 2.0  # sigma of the field's coefficients
FIELD_ROUNDS = 4
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
    """A fitted model: its numbers, the geometry that they make (field included), and the terms of its field."""

    model: Model
    field_degree: int
    numbers: FloatArray
    geometry: Geometry


def fit(problem: Problem, model: Model, field_degree: int, data: Matched, start: FloatArray | None = None) -> Fit:
    """The model with its residual field of a total degree (0 for none) that suits `data` best."""
    numbers = np.zeros(model.size) if start is None else start

    def residuals(trial: FloatArray) -> FloatArray:
        off = residuals_sigma(problem, geometry_of(model, problem.nominal, problem.q_poses, trial), data)
        return np.where(np.isfinite(off), off, FAR_SIGMA)

    found = smallest(residuals, numbers)
    geometry = geometry_of(model, problem.nominal, problem.q_poses, found)
    if field_degree:
        geometry = with_field(problem, geometry, field_degree, data)
    return Fit(model, field_degree, found, geometry)


def smallest(residuals: Callable[[FloatArray], FloatArray], numbers: FloatArray) -> FloatArray:
    """The numbers with the smallest Huber loss of their residuals and a weak prior (Levenberg and Marquardt, reweighted)."""
    off, damping = residuals(numbers), FIRST_DAMPING
    loss = _huber(off, numbers)
    for _ in range(MAX_STEPS):
        slopes = np.stack(
            [(residuals(numbers + step) - off) / DIFFERENCE for step in DIFFERENCE * np.eye(len(numbers))], axis=1
        )
        weight = np.minimum(1.0, HUBER / np.maximum(np.abs(off), HUBER))[:, None]
        normal = slopes.T @ (weight * slopes) + PRIOR**2 * np.eye(len(numbers))
        downhill = slopes.T @ (weight[:, 0] * off) + PRIOR**2 * numbers
        for _ in range(MAX_DAMPINGS):
            step = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), -downhill)
            new_off = residuals(numbers + step)
            new_loss = _huber(new_off, numbers + step)
            if new_loss <= loss:
                break
            damping *= 10
        else:
            return numbers
        gain = loss - new_loss
        numbers, off, loss, damping = numbers + step, new_off, new_loss, max(damping / 10, MIN_DAMPING)
        if gain <= MIN_GAIN:
            break
    return numbers


def _huber(off: FloatArray, numbers: FloatArray) -> float:
    size = np.abs(off)
    each = np.where(size <= HUBER, 0.5 * size**2, HUBER * (size - HUBER / 2))
    return float(each.sum() + 0.5 * PRIOR**2 * (numbers**2).sum())


def residuals_px(problem: Problem, geometry: Geometry, data: Matched) -> tuple[FloatArray, FloatArray]:
    """How far each centroid is from its dot, x and y (n,), on the monitor but in tracker px."""
    seen, plan = data.seen, problem.plan
    directions = directions_in_cam(geometry, seen.pose, seen.x_px, seen.y_px)
    x_px, y_px = geometry.monitor.project(directions @ geometry.monitor.cam_to_image.T)
    scale = problem.monitor_px_per_px
    return (x_px - plan.x_px[data.dot]) / scale, (y_px - plan.y_px[data.dot]) / scale


def residuals_sigma(problem: Problem, geometry: Geometry, data: Matched) -> FloatArray:
    """The residuals (2 n,), x then y, each in its own sigma."""
    sigma = data.seen.sigma_px * problem.noise_px
    return np.concatenate([part / sigma for part in residuals_px(problem, geometry, data)])


def with_field(problem: Problem, geometry: Geometry, degree: int, data: Matched) -> Geometry:
    """The geometry with a residual field of a total degree on its monitor: linear least squares, robust by reweighting."""
    seen, scale = data.seen, problem.monitor_px_per_px
    directions = directions_in_cam(geometry, seen.pose, seen.x_px, seen.y_px)
    x_px, y_px = geometry.monitor.project(directions @ geometry.monitor.cam_to_image.T)
    terms = field_terms(x_px, y_px, geometry.monitor.resolution_px, degree)
    sigma_px = seen.sigma_px * problem.noise_px * scale
    columns = []
    for wanted, place in ((problem.plan.x_px, x_px), (problem.plan.y_px, y_px)):
        off = wanted[data.dot] - place
        weight = 1 / sigma_px
        for _ in range(FIELD_ROUNDS):
            a = np.concatenate([terms * weight[:, None], np.eye(terms.shape[1]) / FIELD_PRIOR_PX])
            coefficient = np.linalg.lstsq(a, np.concatenate([off * weight, np.zeros(terms.shape[1])]), rcond=None)[0]
            left = np.abs(off - terms @ coefficient) / sigma_px
            weight = np.sqrt(np.minimum(1.0, HUBER / np.maximum(left, 1e-12))) / sigma_px
        columns.append(coefficient)
    field = ResidualField.of_terms(columns[0], columns[1], degree, geometry.monitor.resolution_px)
    return replace(geometry, monitor=_with(geometry.monitor, field))


def _with(camera: Camera, field: ResidualField) -> Camera:
    return replace(camera, lens=replace(camera.lens or Lens(), field=field))


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
