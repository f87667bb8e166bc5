"""A bench's geometry fitted to centroids of dots: parameters, robust least squares, choice of a
model, uncertainty.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import distance_transform_edt

from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.rotation import conjugate, from_rotation_vector, multiply, to_matrix
from hilstar.basics.units import ARCSEC_PER_RAD, MAD_TO_SIGMA
from hilstar.instruments.calibrate.geometric.dots import DotPlan
from hilstar.instruments.calibrate.geometric.observed import Observed
from hilstar.optics.camera import Camera, Lens, ResidualField, field_terms

# A parameter is its step times a number of order 1, so that one damping suits all of them.
STEPS = {
    "rotation_x": 0.01,
    "rotation_y": 0.01,
    "rotation_z": 0.01,
    "log_focal": 0.01,
    "centre_x": 100.0,
    "centre_y": 100.0,
    "tilt_x": 0.1,
    "tilt_y": 0.1,
    "k1": 1.0,
    "k2": 10.0,
    "k3": 100.0,
    "p1": 0.1,
    "p2": 0.1,
}
# A turn about the boresight leaves a radial distortion as it is: what no pose tells apart is taken
# as the collimator's.
TRACKER_STEPS = {"tracker_k1": 0.1, "tracker_k2": 1.0, "tracker_p1": 0.1, "tracker_p2": 0.1}
TRACKER_ROUND = ("tracker_k1", "tracker_k2")
POSE_STEP_RAD = 0.01
PINHOLE = ("rotation_x", "rotation_y", "rotation_z", "log_focal")
RADIAL = (*PINHOLE, "k1")
BROWN_CONRADY = tuple(STEPS)
HUBER = 2.5  # sigmas: beyond it a residual counts by its size, not by its square
PRIOR = 0.3  # weight on a parameter's number: so weak that it decides only what the data leave open
# Weight on the tracker's radial terms, which the collimator's can replace. Free, they follow what
# neither lens can follow. How well they are known is a matter of PRIOR all the same.
ROUND_PRIOR = 30.0
FIELD_PRIOR_PX = 2.0  # sigma of the field's coefficients
FAR_SIGMA = 1e6  # residual of a centroid that a trial puts behind the lens
MAX_STEPS, MAX_DAMPINGS = 60, 12
FIRST_DAMPING, MIN_DAMPING = 1e-3, 1e-12
# A step that lowers the loss by less is the last, in half squares of a sigma, or of what residuals
# scatter by where the model does not fit them: that of the fit that is kept, and that of a fit that
# is compared with other models'. Tilt, centre and distortion replace one another along a bent
# valley, down which forty more steps change the held-out error by 1 %, and a choice takes 2 %.
MIN_GAIN, COMPARED_GAIN = 0.02, 0.5
DIFFERENCE = 1e-5  # step of a parameter's number for its numerical derivative
FOLDS = 5
FIELD_DEGREES = (3, 4, 5, 6, 7)
# A larger model is taken where it brings the held-out error below this share of the smaller one's,
# and beyond chance by so many sigmas: of eight models of 50 dots, one is 2 % better than another by
# chance.
GAIN, GAIN_SIGMAS = 0.98, 2.5
CENTROIDS_PER_NUMBER = 3.0
MAP_PLACES = (17, 11)
FIELD_PLACES = 17  # along each side of the tracker's field
MODE_SHARE = 1e-6  # a share of the variance over the screen: less is in no interval's digits


@dataclass(frozen=True, slots=True)
class Nominal:
    """The bench file's geometry: the ideal camera of the monitor, its rotation, and the
    tracker's own camera.
    """

    monitor: Camera
    q_cam_to_mon: FloatArray
    tracker: Camera


@dataclass(frozen=True, slots=True)
class Model:
    """The free parameters and the number of tracker poses; each pose beyond the first has its
    own rotation.
    """

    names: tuple[str, ...]
    tracker_names: tuple[str, ...] = ()
    poses: int = 1

    @property
    def size(self) -> int:
        """How many numbers the model has."""
        return len(self.names) + len(self.tracker_names) + 3 * (self.poses - 1)


@dataclass(frozen=True, slots=True)
class Geometry:
    """The cameras of one set of parameters; `q_poses` (poses, 4) turns cam, the first pose's
    axes, into each pose's.
    """

    monitor: Camera
    q_cam_to_mon: FloatArray
    tracker: Camera
    q_poses: FloatArray


def geometry_of(
    model: Model, nominal: Nominal, q_poses: FloatArray, numbers: FloatArray
) -> Geometry:
    """The cameras of parameters (size,); the poses' rotations are applied after `q_poses`
    (poses, 4).
    """
    values = dict.fromkeys(STEPS, 0.0)
    values |= {
        name: STEPS[name] * float(number)
        for name, number in zip(model.names, numbers, strict=False)
    }
    # The principal point moves with a turn, so that the image's middle stays: else the loss has one
    # long valley in the two.
    follow = (
        np.array([values["centre_y"], -values["centre_x"], 0.0]) / nominal.monitor.focal_length_px
    )
    turn = np.array([values["rotation_x"], values["rotation_y"], values["rotation_z"]]) + follow
    q = multiply(from_rotation_vector(turn), nominal.q_cam_to_mon)
    cx, cy = nominal.monitor.principal_point_px
    tilt = (values["tilt_x"], values["tilt_y"])
    lens = Lens((values["k1"], values["k2"], values["k3"]), (values["p1"], values["p2"]), tilt)
    monitor = Camera(
        nominal.monitor.resolution_px,
        nominal.monitor.focal_length_px * float(np.exp(values["log_focal"])),
        (cx + values["centre_x"], cy + values["centre_y"]),
        to_matrix(q),
        lens if "k1" in model.names else None,
    )
    tracker = nominal.tracker
    rest = numbers[len(model.names) :]
    if model.tracker_names:
        lens_values = {
            name: TRACKER_STEPS[name] * float(n)
            for name, n in zip(model.tracker_names, rest, strict=False)
        }
        radial = (lens_values["tracker_k1"], lens_values["tracker_k2"], 0.0)
        tangential = (lens_values["tracker_p1"], lens_values["tracker_p2"])
        tracker = replace(tracker, lens=Lens(radial, tangential))
    steps = POSE_STEP_RAD * rest[len(model.tracker_names) :].reshape(-1, 3)
    turned = []
    for step, pose in zip(steps, q_poses[1:], strict=True):
        turned.append(multiply(from_rotation_vector(step), pose))
    return Geometry(monitor, q, tracker, np.array([q_poses[0], *turned]))


def directions_in_cam(
    geometry: Geometry, pose: IntArray, x_px: FloatArray, y_px: FloatArray
) -> FloatArray:
    """Directions (n, 3) in cam of pixels in the tracker's image, each seen in its own pose."""
    u, v = geometry.tracker.tangents(x_px, y_px)
    rays = np.stack([u, v, np.ones_like(u)], axis=-1)
    back = np.stack([to_matrix(conjugate(q)) for q in geometry.q_poses])
    return np.asarray(np.einsum("nij,nj->ni", back[pose], rays))


@dataclass(frozen=True, slots=True)
class MatchedDots:
    """Centroids (n,) and the number of each one's dot (n,)."""

    seen: Observed
    dot: IntArray

    def __len__(self) -> int:
        return len(self.dot)

    def at(self, chosen: IntArray) -> "MatchedDots":
        """The matches at indices `chosen`."""
        return MatchedDots(self.seen.at(chosen), self.dot[chosen])


@dataclass(frozen=True, slots=True)
class Problem:
    """The data of a fit: the plan's dots, the bench file's geometry, and a centroid's error in
    tracker px.
    """

    plan: DotPlan
    nominal: Nominal
    q_poses: FloatArray
    noise_px: float

    @property
    def monitor_px_per_px(self) -> float:
        """Monitor pixels per tracker pixel, on the axis."""
        return self.nominal.monitor.focal_length_px / self.nominal.tracker.focal_length_px


@dataclass(frozen=True, slots=True)
class Fit:
    """A fitted model: its parameters, followed by the residual field's coefficients in x and in
    y, and its geometry.
    """

    model: Model
    field_degree: int
    numbers: FloatArray
    geometry: Geometry


@dataclass(frozen=True, slots=True)
class _Loss:
    """The function that is minimised: Huber's loss of the residuals plus a weak prior.

    It is over the model's parameters and the residual field's coefficients together: a lens fitted
    alone would follow what only the field can follow.
    """

    problem: Problem
    model: Model
    field_degree: int
    data: MatchedDots

    def geometry(self, numbers: FloatArray) -> Geometry:
        lens = numbers[: self.model.size]
        field = numbers[self.model.size :]
        geometry = geometry_of(self.model, self.problem.nominal, self.problem.q_poses, lens)
        if not self.field_degree:
            return geometry
        x, y = field.reshape(2, -1)
        camera = geometry.monitor
        residual = ResidualField.of_terms(x, y, self.field_degree, camera.resolution_px)
        return replace(
            geometry, monitor=replace(camera, lens=replace(camera.lens or Lens(), field=residual))
        )

    def residuals(self, numbers: FloatArray) -> FloatArray:
        return self._off(self.geometry(numbers))

    def _off(self, geometry: Geometry, directions: FloatArray | None = None) -> FloatArray:
        off = residuals_sigma(self.problem, geometry, self.data, directions)
        return np.where(np.isfinite(off), off, FAR_SIGMA)

    def slopes(self, numbers: FloatArray, off: FloatArray) -> FloatArray:
        """Derivatives of the residuals by each number (2 n, numbers).

        For the lens they are finite differences without the field, which hardly changes along a
        step; the field is linear.
        """
        lens = numbers[: self.model.size]
        pose_numbers = len(self.model.names) + len(self.model.tracker_names)
        poses = (len(lens) - pose_numbers) // 3
        # A pose turns its own centroids alone: one trial turns all poses about one axis.
        turns = np.hstack([np.zeros((3, pose_numbers)), np.tile(np.eye(3), (1, poses))])[
            : 3 * poses
        ]
        steps = DIFFERENCE * np.vstack([np.eye(pose_numbers, len(lens)), turns])
        bare, *varied = (
            geometry_of(self.model, self.problem.nominal, self.problem.q_poses, lens + n)
            for n in (0 * lens, *steps)
        )
        seen_dots = self.data.seen
        # the same for all terms of the monitor's camera
        directions = directions_in_cam(bare, seen_dots.pose, seen_dots.x_px, seen_dots.y_px)
        if self.field_degree:
            base = self._off(bare, directions)
        else:
            base = off
        offs = []
        for number, geometry in enumerate(varied):
            is_of_monitor = number < len(self.model.names)
            offs.append(self._off(geometry, directions if is_of_monitor else None))
        slope = np.stack([(trial - base) / DIFFERENCE for trial in offs], axis=1)
        is_its = np.tile(seen_dots.pose, 2)[:, None] == np.repeat(np.arange(1, poses + 1), 3)
        columns = np.hstack(
            [
                slope[:, :pose_numbers],
                np.where(is_its, np.tile(slope[:, pose_numbers:], poses), 0.0),
            ]
        )
        if not self.field_degree:
            return columns
        terms = np.nan_to_num(
            field_terms(
                *_places_px(bare, self.data, directions),
                bare.monitor.resolution_px,
                self.field_degree,
            )
        )
        terms /= (self.problem.monitor_px_per_px * seen_dots.sigma_px * self.problem.noise_px)[
            :, None
        ]
        return np.hstack([columns, _blocks(terms)])

    def prior(self, count: int) -> FloatArray:
        weight = np.where(np.arange(count) < self.model.size, PRIOR, 1 / FIELD_PRIOR_PX)
        for k, name in enumerate(self.model.tracker_names, start=len(self.model.names)):
            weight[k] = ROUND_PRIOR if name in TRACKER_ROUND else PRIOR
        return weight**2

    def value(self, off: FloatArray, numbers: FloatArray) -> float:
        size = np.abs(off)
        losses = np.where(size <= HUBER, 0.5 * size**2, HUBER * (size - HUBER / 2))
        return float(losses.sum() + 0.5 * self.prior(len(numbers)) @ numbers**2)


def fit(
    problem: Problem,
    model: Model,
    field_degree: int,
    data: MatchedDots,
    start: FloatArray | None = None,
    *,
    min_gain: float = MIN_GAIN,
) -> Fit:
    """Fit a model with a residual field of a total degree (0 for none) to `data`, starting at
    `start`, until a step gains less than `min_gain`.
    """
    loss = _Loss(problem, model, field_degree, data)
    if start is None and field_degree:
        lens = fit(problem, model, 0, data, min_gain=min_gain).numbers
        start = np.concatenate([lens, np.zeros((field_degree + 1) * (field_degree + 2))])
    numbers = _smallest(loss, np.zeros(model.size) if start is None else start, min_gain)
    return Fit(model, field_degree, numbers, loss.geometry(numbers))


def _smallest(loss: _Loss, numbers: FloatArray, min_gain: float) -> FloatArray:
    """The numbers with the smallest loss (Levenberg and Marquardt, reweighted)."""
    prior = loss.prior(len(numbers))
    off = loss.residuals(numbers)
    damping = FIRST_DAMPING
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
        numbers = numbers + step
        off = new_off
        value = new_value
        damping = max(damping / 10, MIN_DAMPING)
        if gain <= min_gain * max(1.0, 2 * value / len(off)):
            break
    return numbers


def residuals_px(
    problem: Problem, geometry: Geometry, data: MatchedDots, directions: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Distance of each centroid from its dot along x and y (n,), on the monitor, scaled to tracker
    px.

    `directions` (n, 3) are the centroids' `directions_in_cam` where they are known.
    """
    plan = problem.plan
    scale = problem.monitor_px_per_px
    x_px, y_px = _places_px(geometry, data, directions)
    return (x_px - plan.x_px[data.dot]) / scale, (y_px - plan.y_px[data.dot]) / scale


def residuals_sigma(
    problem: Problem, geometry: Geometry, data: MatchedDots, directions: FloatArray | None = None
) -> FloatArray:
    """The residuals (2 n,), x then y, each in its own sigma."""
    sigma = data.seen.sigma_px * problem.noise_px
    return np.concatenate(
        [part / sigma for part in residuals_px(problem, geometry, data, directions)]
    )


def _places_px(
    geometry: Geometry, data: MatchedDots, directions: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Places of the centroids (n,) on the monitor by a geometry, px."""
    if directions is None:
        directions = directions_in_cam(geometry, data.seen.pose, data.seen.x_px, data.seen.y_px)
    return geometry.monitor.project(directions @ geometry.monitor.cam_to_image.T)


def noise_of_repeats(data: MatchedDots) -> float | None:
    """The error of one centroid along one axis, px, from the scatter of dots seen in several
    frames; None where none is.

    It needs no model. It uses the median absolute deviation, so a few false matches do not count.
    """
    key = data.seen.pose * (int(data.dot.max(initial=0)) + 1) + data.dot
    order = np.argsort(key, kind="stable")
    deviations = []
    for group in np.split(order, np.flatnonzero(np.diff(key[order])) + 1):
        if len(group) > 2:
            share = np.sqrt(len(group) / (len(group) - 1))
            for part in (data.seen.x_px, data.seen.y_px):
                deviations.append(
                    share * (part[group] - part[group].mean()) / data.seen.sigma_px[group]
                )
    if not deviations:
        return None
    return float(MAD_TO_SIGMA * np.median(np.abs(np.concatenate(deviations))))


@dataclass(frozen=True, slots=True)
class Candidate:
    """A model, its name, and its error on dots that were held out of its fit.

    `off_arcsec` (dots, 2) is the mean error of each dot in `dot` (dots,); it includes the
    centroids' noise.
    """

    name: str
    model: Model
    field_degree: int
    dot: IntArray
    off_arcsec: FloatArray

    @property
    def rms_arcsec(self) -> float:
        """Root mean square of the held-out error."""
        return float(np.sqrt((self.off_arcsec**2).sum(axis=1).mean()))

    @property
    def max_arcsec(self) -> float:
        """Largest held-out error."""
        return float(np.hypot(*self.off_arcsec.T).max())


def candidates(
    problem: Problem, data: MatchedDots, tracker_names: tuple[str, ...]
) -> list[Candidate]:
    """Every model that the number of centroids allows, simplest first, each with its error on
    held-out dots.
    """
    poses = len(problem.q_poses)
    wanted = [
        ("pinhole", PINHOLE, 0),
        ("pinhole + k1", RADIAL, 0),
        ("Brown-Conrady + tilt", BROWN_CONRADY, 0),
    ]
    wanted += [
        (f"Brown-Conrady + tilt + field of degree {n}", BROWN_CONRADY, n) for n in FIELD_DEGREES
    ]
    candidate_models: list[Candidate] = []
    for name, names, degree in wanted:
        model = Model(names, tracker_names if names is BROWN_CONRADY else (), poses)
        numbers = model.size + (degree + 1) * (degree + 2)
        # A dot has two numbers of its own. Half as many are left over: a field of 55 numbers
        # followed 42 dots' own errors.
        if 2 * len(data) >= CENTROIDS_PER_NUMBER * numbers and len(np.unique(data.dot)) > numbers:
            candidate_models.append(held_out(problem, name, model, degree, data))
        if (
            len(candidate_models) > 4
            and candidate_models[-1].rms_arcsec
            > candidate_models[-2].rms_arcsec
            > candidate_models[-3].rms_arcsec
        ):
            break  # larger fields only follow the noise
    return candidate_models


def held_out(
    problem: Problem, name: str, model: Model, degree: int, data: MatchedDots
) -> Candidate:
    """The error of a model on each dot by a fit to the others, a fifth of the dots at a time."""
    dots = np.unique(data.dot)
    fold = np.zeros(int(dots.max()) + 1, dtype=np.intp)
    fold[dots] = np.arange(len(dots)) % FOLDS
    start = fit(problem, model, degree, data, min_gain=COMPARED_GAIN).numbers
    off = np.full((len(data), 2), np.nan)
    for k in range(FOLDS):
        out = fold[data.dot] == k
        if out.any() and not out.all():
            others = data.at(np.flatnonzero(~out))
            trained = fit(problem, model, degree, others, start, min_gain=COMPARED_GAIN)
            off[out] = np.stack(
                residuals_px(problem, trained.geometry, data.at(np.flatnonzero(out))), axis=1
            )
    arcsec = (
        np.nan_to_num(off, nan=np.inf) * ARCSEC_PER_RAD / problem.nominal.tracker.focal_length_px
    )
    count = np.bincount(data.dot, minlength=len(fold))[dots]
    sum_x = np.bincount(data.dot, arcsec[:, 0], minlength=len(fold))[dots]
    sum_y = np.bincount(data.dot, arcsec[:, 1], minlength=len(fold))[dots]
    means = np.stack([sum_x / count, sum_y / count], axis=1)
    return Candidate(name, model, degree, dots, means)


def best_of(found: list[Candidate]) -> Candidate:
    """The simplest model whose held-out error no larger model clearly reduces."""
    best = found[0]
    for candidate in found[1:]:
        if candidate.rms_arcsec < GAIN * best.rms_arcsec and _is_beyond_chance(best, candidate):
            best = candidate
    return best


def _is_beyond_chance(smaller: Candidate, larger: Candidate) -> bool:
    """Whether the larger model's gain on the held-out dots is more than the dots' scatter makes
    by chance.
    """
    squares = [(model_fit.off_arcsec**2).sum(axis=1) for model_fit in (smaller, larger)]
    with np.errstate(invalid="ignore"):  # a dot that both put behind the lens
        gain = np.nan_to_num(squares[0] - squares[1], nan=0.0)
    # A dot that a model throws far off counts as one dot, not as all of them.
    limit = HUBER * MAD_TO_SIGMA * float(np.median(np.abs(gain)))
    gain = np.clip(gain, -limit, limit)
    chance = float(gain.std()) / math.sqrt(len(gain))
    return float(gain.mean()) > GAIN_SIGMAS * chance


@dataclass(frozen=True, slots=True)
class Uncertainty:
    """One sigma of each parameter, and of a star's place over the screen, edges included:
    `map_arcsec` (rows, columns).

    `field_arcsec` (n,) is that of places that the tracker sees, edges included: it may see 2 % of
    the screen. `modes_arcsec` (modes, 2 places) times its transpose is the covariance of places
    along x and y, row by row of the map.
    The map is NaN where the tracker saw no dots. From the covariance of the whole lens, also where
    a simpler one was chosen, and from what the whole lens would move each place by: a simple lens
    is chosen where the dots' noise hides its lack of fit. Scaled up where residuals, or their means
    over a dot's frames, exceed the centroids' noise. Errors that no parameter can follow show in
    the error of held-out dots alone.
    """

    sigma: dict[str, float]
    map_arcsec: FloatArray
    modes_arcsec: FloatArray
    field_arcsec: FloatArray

    @property
    def rms_arcsec(self) -> float:
        """Root mean square over what the tracker sees of the screen."""
        return float(np.sqrt(np.mean(self.field_arcsec**2)))

    @property
    def max_arcsec(self) -> float:
        """Largest value on what the tracker sees of the screen."""
        return float(np.max(self.field_arcsec))


def uncertainty_of(problem: Problem, fit: Fit, data: MatchedDots) -> Uncertainty:
    """The uncertainty of a fit to `data`, by the covariance of the whole lens and by what that
    would move.
    """
    monitor = fit.geometry.monitor
    fit, is_simpler = _with_whole_lens(fit), fit.model.names != BROWN_CONRADY
    off = residuals_sigma(problem, fit.geometry, data)
    residual = np.abs(off)
    weight = np.sqrt(np.minimum(1.0, HUBER / np.maximum(residual, 1e-12)))
    rows = _slopes_of_residuals(problem, fit, data) * weight[:, None]
    size = fit.model.size
    field_numbers = rows.shape[1] - size
    prior = np.concatenate([np.full(size, PRIOR), np.full(field_numbers, 1 / FIELD_PRIOR_PX)])
    # times its transpose: the covariance
    root = np.linalg.inv(np.linalg.qr(np.vstack([rows, np.diag(prior)]))[1])
    scale = max(
        1.0, MAD_TO_SIGMA * float(np.median(residual)), _scatter_of_dots(data, off, rows.shape[1])
    )
    if is_simpler:
        # One step of Gauss and Newton from the simple lens to the whole one, as one more error
        # beside the covariance's.
        downhill = rows.T @ (weight * off) + prior**2 * fit.numbers
        root = np.column_stack([root, root @ (root.T @ downhill) / scale])
    steps = [STEPS[name] for name in fit.model.names] + [
        TRACKER_STEPS[name] for name in fit.model.tracker_names
    ]
    spread = scale * np.linalg.norm(root, axis=1)
    names = (*fit.model.names, *fit.model.tracker_names)
    sigma = {name: float(step * s) for name, step, s in zip(names, steps, spread, strict=False)}
    along = (
        np.linspace(-0.5, size - 0.5, n)
        for size, n in zip(monitor.resolution_px, MAP_PLACES, strict=True)
    )
    to_arcsec = scale * ARCSEC_PER_RAD / problem.nominal.monitor.focal_length_px
    place_x, place_y = _slopes_of_places(
        problem, fit, *(part.ravel() for part in np.meshgrid(*along))
    )
    slopes = np.stack([place_x, place_y]) @ root * to_arcsec
    in_field = (
        np.stack(_slopes_of_places(problem, fit, *_seen_places(fit.geometry))) @ root * to_arcsec
    )
    is_visible = np.asarray(np.isfinite(slopes).all(axis=(0, 2))).reshape(MAP_PLACES[::-1])
    row, column = distance_transform_edt(
        (~is_visible).astype(np.int64), return_distances=False, return_indices=True
    )
    # a place that was not seen has those of its neighbour
    slopes = slopes[:, (row * is_visible.shape[1] + column).ravel()]
    variance = np.where(is_visible, (slopes**2).sum(axis=(0, 2)).reshape(is_visible.shape), np.nan)
    _, size_of, modes = np.linalg.svd(
        slopes.reshape(2 * is_visible.size, -1).T, full_matrices=False
    )
    modes = (size_of[:, None] * modes)[size_of**2 > MODE_SHARE * (size_of**2).sum()]
    return Uncertainty(sigma, np.sqrt(variance), modes, np.sqrt((in_field**2).sum(axis=(0, 2))))


def _seen_places(geometry: Geometry) -> tuple[FloatArray, FloatArray]:
    """Pixels (n,) of the monitor at a grid over the tracker's field in all its poses."""
    sides = (np.linspace(-0.5, size - 0.5, FIELD_PLACES) for size in geometry.tracker.resolution_px)
    u_px, v_px = (part.ravel() for part in np.meshgrid(*sides))
    monitor = geometry.monitor
    places = []
    for pose in range(len(geometry.q_poses)):
        rays = directions_in_cam(geometry, np.full(len(u_px), pose), u_px, v_px)
        places.append(np.stack(monitor.project(rays @ monitor.cam_to_image.T)))
    x_px, y_px = np.concatenate(places, axis=1)
    width, height = monitor.resolution_px
    with np.errstate(invalid="ignore"):
        on_screen = (np.abs(x_px - (width - 1) / 2) <= width / 2) & (
            np.abs(y_px - (height - 1) / 2) <= height / 2
        )
    return x_px[on_screen], y_px[on_screen]


def _scatter_of_dots(data: MatchedDots, off: FloatArray, numbers: int) -> float:
    """The scatter of dots' mean residuals in sigmas of their noise, of a fit of so many numbers.

    A dot is at one place in all its frames: what a detector's pixels do to it there is no average
    of the frames.
    """
    dots, place, count = np.unique(data.dot, return_inverse=True, return_counts=True)
    means = [np.bincount(place, part) / np.sqrt(count) for part in np.split(off, 2)]
    free = max(2 * len(dots) - numbers, 1)
    typical = MAD_TO_SIGMA * float(np.median(np.abs(np.concatenate(means))))
    return typical * math.sqrt(2 * len(dots) / free)


def _with_whole_lens(fit: Fit) -> Fit:
    """The same geometry as a fit of BROWN_CONRADY, whose parameters are 0 where the model lacks
    them.
    """
    names = fit.model.names
    own_count = len(fit.model.names)
    if names == BROWN_CONRADY:
        return fit
    by_name = dict(zip(names, fit.numbers[:own_count], strict=True))
    whole = [by_name.get(name, 0.0) for name in BROWN_CONRADY]
    return replace(
        fit,
        model=replace(fit.model, names=BROWN_CONRADY),
        numbers=np.concatenate([whole, fit.numbers[own_count:]]),
    )


def _varied(problem: Problem, fit: Fit, number: int) -> Geometry:
    """The geometry with one parameter slightly larger, and the same residual field."""
    step = np.zeros(fit.model.size)
    step[number] = DIFFERENCE
    varied = geometry_of(
        fit.model, problem.nominal, problem.q_poses, fit.numbers[: fit.model.size] + step
    )
    if fit.geometry.monitor.lens is not None:
        field = fit.geometry.monitor.lens.field
    else:
        field = None
    if field is None:
        lens = varied.monitor.lens
    else:
        lens = replace(varied.monitor.lens or Lens(), field=field)
    return replace(varied, monitor=replace(varied.monitor, lens=lens))


def _slopes_of_residuals(problem: Problem, fit: Fit, data: MatchedDots) -> FloatArray:
    """Derivatives of the residuals by each parameter and each coefficient of the field (2 n,
    numbers).
    """
    base = residuals_sigma(problem, fit.geometry, data)
    varied = []
    for k in range(fit.model.size):
        varied.append(residuals_sigma(problem, _varied(problem, fit, k), data))
    slopes = np.stack([(varied_residual - base) / DIFFERENCE for varied_residual in varied], axis=1)
    if not fit.field_degree:
        return np.asarray(slopes)
    dots = problem.plan
    terms = field_terms(
        dots.x_px[data.dot],
        dots.y_px[data.dot],
        problem.nominal.monitor.resolution_px,
        fit.field_degree,
    )
    terms = terms / (problem.monitor_px_per_px * data.seen.sigma_px * problem.noise_px)[:, None]
    return np.hstack([slopes, _blocks(terms)])


def _slopes_of_places(
    problem: Problem, fit: Fit, x_px: FloatArray, y_px: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Derivatives of the places of the directions now at (x, y) by each number, monitor px (n,
    numbers), along x and y.
    """
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
