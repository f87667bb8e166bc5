"""A bench's geometry fitted to centroids of dots: parameters, robust least squares, choice of a
model, uncertainty.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import distance_transform_edt

from hilstar.basics.arrays import BoolArray, FloatArray, IntArray
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
        lens_numbers = len(self.names) + len(self.tracker_names)
        return lens_numbers + 3 * (self.poses - 1)


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
    for name, number in zip(model.names, numbers, strict=False):
        values[name] = STEPS[name] * float(number)
    # The principal point moves with a turn, so that the image's middle stays: else the loss has one
    # long valley in the two.
    shift_px = np.array([values["centre_y"], -values["centre_x"], 0.0])
    follow = shift_px / nominal.monitor.focal_length_px
    turn = np.array([values["rotation_x"], values["rotation_y"], values["rotation_z"]]) + follow
    q = multiply(from_rotation_vector(turn), nominal.q_cam_to_mon)
    cx, cy = nominal.monitor.principal_point_px
    lens = None
    if "k1" in model.names:
        radial = (values["k1"], values["k2"], values["k3"])
        tilt = (values["tilt_x"], values["tilt_y"])
        lens = Lens(radial, (values["p1"], values["p2"]), tilt)
    monitor = Camera(
        resolution_px=nominal.monitor.resolution_px,
        focal_length_px=nominal.monitor.focal_length_px * float(np.exp(values["log_focal"])),
        principal_point_px=(cx + values["centre_x"], cy + values["centre_y"]),
        cam_to_image=to_matrix(q),
        lens=lens,
    )
    tracker_numbers = numbers[len(model.names) :]
    tracker = nominal.tracker
    if model.tracker_names:
        tracker = replace(tracker, lens=_tracker_lens(model.tracker_names, tracker_numbers))
    pose_numbers = tracker_numbers[len(model.tracker_names) :].reshape(-1, 3)
    turned = [q_poses[0]]
    for step, pose in zip(POSE_STEP_RAD * pose_numbers, q_poses[1:], strict=True):
        turned.append(multiply(from_rotation_vector(step), pose))
    return Geometry(monitor, q, tracker, np.array(turned))


def _tracker_lens(names: tuple[str, ...], numbers: FloatArray) -> Lens:
    """The tracker's own lens by the numbers of its parameters; further ones are not read."""
    values = {}
    for name, number in zip(names, numbers, strict=False):
        values[name] = TRACKER_STEPS[name] * float(number)
    radial = (values["tracker_k1"], values["tracker_k2"], 0.0)
    return Lens(radial, (values["tracker_p1"], values["tracker_p2"]))


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

    centroids: Observed
    dot: IntArray

    def __len__(self) -> int:
        return len(self.dot)

    def at(self, chosen: IntArray) -> "MatchedDots":
        """The matches at indices `chosen`."""
        return MatchedDots(self.centroids.at(chosen), self.dot[chosen])


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

    def sites(self, data: MatchedDots) -> IntArray:
        """The place of each centroid (n,), as the number of the first dot there."""
        return self.plan.sites[data.dot]


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
        lens_numbers = numbers[: self.model.size]
        geometry = geometry_of(self.model, self.problem.nominal, self.problem.q_poses, lens_numbers)
        if not self.field_degree:
            return geometry
        x, y = numbers[self.model.size :].reshape(2, -1)
        camera = geometry.monitor
        field = ResidualField.of_terms(x, y, self.field_degree, camera.resolution_px)
        lens = replace(camera.lens or Lens(), field=field)
        return replace(geometry, monitor=replace(camera, lens=lens))

    def residuals(self, numbers: FloatArray) -> FloatArray:
        """The residuals (2 n,) in sigmas, x then y, by numbers."""
        return self._off(self.geometry(numbers))

    def _off(self, geometry: Geometry, directions: FloatArray | None = None) -> FloatArray:
        off = residuals_sigma(self.problem, geometry, self.data, directions)
        return np.where(np.isfinite(off), off, FAR_SIGMA)

    def _varied(self, numbers: FloatArray) -> Geometry:
        """The cameras of the lens's and the poses' numbers, without the field."""
        return geometry_of(self.model, self.problem.nominal, self.problem.q_poses, numbers)

    def slopes(self, numbers: FloatArray, off: FloatArray) -> FloatArray:
        """Derivatives of the residuals by each number (2 n, numbers).

        For the lens they are finite differences without the field, which hardly changes along a
        step; the field is linear.
        """
        lens_numbers = numbers[: self.model.size]
        first_pose = len(self.model.names) + len(self.model.tracker_names)
        poses = (len(lens_numbers) - first_pose) // 3
        centroids = self.data.centroids
        bare = self._varied(lens_numbers)
        # the same for all terms of the monitor's camera
        directions = directions_in_cam(bare, centroids.pose, centroids.x_px, centroids.y_px)
        base = off
        if self.field_degree:
            base = self._off(bare, directions)
        slopes = []
        for number, step in enumerate(self._steps(first_pose, poses)):
            geometry = self._varied(lens_numbers + step)
            if number < len(self.model.names):
                trial = self._off(geometry, directions)
            else:
                trial = self._off(geometry)
            slopes.append((trial - base) / DIFFERENCE)
        slope = np.stack(slopes, axis=1)
        pose_of_number = np.repeat(np.arange(1, poses + 1), 3)
        is_its = np.tile(centroids.pose, 2)[:, None] == pose_of_number
        pose_slopes = np.where(is_its, np.tile(slope[:, first_pose:], poses), 0.0)
        columns = np.hstack([slope[:, :first_pose], pose_slopes])
        if not self.field_degree:
            return columns
        x_px, y_px = _places_px(bare, self.data, directions)
        terms = field_terms(x_px, y_px, bare.monitor.resolution_px, self.field_degree)
        terms = np.nan_to_num(terms)
        sigma_px = self.problem.monitor_px_per_px * centroids.sigma_px * self.problem.noise_px
        terms /= sigma_px[:, None]
        return np.hstack([columns, _blocks(terms)])

    def _steps(self, first_pose: int, poses: int) -> FloatArray:
        """A step of each number, and of all poses about one axis: a pose turns its own centroids
        alone, and one trial serves all.
        """
        size = first_pose + 3 * poses
        lens_steps = np.eye(first_pose, size)
        before = np.zeros((3, first_pose))
        axes = np.tile(np.eye(3), (1, poses))
        turns = np.hstack([before, axes])[: 3 * poses]
        return np.asarray(DIFFERENCE * np.vstack([lens_steps, turns]))

    def prior(self, count: int) -> FloatArray:
        """The prior's weights (count,) on the squares of the numbers."""
        is_field = np.arange(count) >= self.model.size
        weight = np.where(is_field, 1 / FIELD_PRIOR_PX, PRIOR)
        first = len(self.model.names)
        for k, name in enumerate(self.model.tracker_names):
            if name in TRACKER_ROUND:
                weight[first + k] = ROUND_PRIOR
        return weight**2

    def value(self, off: FloatArray, numbers: FloatArray) -> float:
        """The loss of residuals and numbers."""
        return loss_of(off, numbers, self.prior(len(numbers)))


def loss_of(off: FloatArray, numbers: FloatArray, prior: FloatArray) -> float:
    """Huber's loss of the residuals (n,), in sigmas, and that of numbers by their prior's weights
    (m,).
    """
    size = np.abs(off)
    losses = np.where(size <= HUBER, 0.5 * size**2, HUBER * (size - HUBER / 2))
    prior_loss = 0.5 * prior @ numbers**2
    return float(losses.sum() + prior_loss)


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
    if start is None:
        start = np.zeros(model.size)
        if field_degree:
            lens = fit(problem, model, 0, data, min_gain=min_gain).numbers
            start = np.concatenate([lens, np.zeros((field_degree + 1) * (field_degree + 2))])
    numbers = _smallest(loss, start, min_gain)
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
        diagonal = np.diag(np.diag(normal))
        for _ in range(MAX_DAMPINGS):
            step = np.linalg.solve(normal + damping * diagonal, -downhill)
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
    dx_px = (x_px - plan.x_px[data.dot]) / scale
    dy_px = (y_px - plan.y_px[data.dot]) / scale
    return dx_px, dy_px


def residuals_sigma(
    problem: Problem, geometry: Geometry, data: MatchedDots, directions: FloatArray | None = None
) -> FloatArray:
    """The residuals (2 n,), x then y, each in its own sigma."""
    sigma = data.centroids.sigma_px * problem.noise_px
    dx_px, dy_px = residuals_px(problem, geometry, data, directions)
    return np.concatenate([dx_px / sigma, dy_px / sigma])


def _places_px(
    geometry: Geometry, data: MatchedDots, directions: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Places of the centroids (n,) on the monitor by a geometry, px."""
    if directions is None:
        centroids = data.centroids
        directions = directions_in_cam(geometry, centroids.pose, centroids.x_px, centroids.y_px)
    return geometry.monitor.project(directions @ geometry.monitor.cam_to_image.T)


def noise_of_repeats(data: MatchedDots) -> float | None:
    """The error of one centroid along one axis, px, from the scatter of dots seen in several
    frames; None where none is.

    It needs no model. It uses the median absolute deviation, so a few false matches do not count.
    """
    centroids = data.centroids
    dots = int(data.dot.max(initial=0)) + 1
    key = centroids.pose * dots + data.dot
    order = np.argsort(key, kind="stable")
    first_of_group = np.flatnonzero(np.diff(key[order])) + 1
    deviations = []
    for group in np.split(order, first_of_group):
        if len(group) > 2:
            bessel = np.sqrt(len(group) / (len(group) - 1))
            for places in (centroids.x_px[group], centroids.y_px[group]):
                off = bessel * (places - places.mean())
                deviations.append(off / centroids.sigma_px[group])
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
    def rms_error_arcsec(self) -> float:
        """Standard error of that rms: of n dots with two axes each, which are 2 n numbers."""
        return self.rms_arcsec / math.sqrt(4 * len(self.dot))

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
    forms = [
        ("pinhole", PINHOLE, 0),
        ("pinhole + k1", RADIAL, 0),
        ("Brown-Conrady + tilt", BROWN_CONRADY, 0),
    ]
    for degree in FIELD_DEGREES:
        forms.append((f"Brown-Conrady + tilt + field of degree {degree}", BROWN_CONRADY, degree))
    models: list[Candidate] = []
    for name, names, degree in forms:
        model = Model(names, (), poses)
        if names is BROWN_CONRADY:
            model = replace(model, tracker_names=tracker_names)
        numbers = model.size + (degree + 1) * (degree + 2)
        # A dot has two numbers of its own. Half as many are left over: a field of 55 numbers
        # followed 42 dots' own errors.
        has_centroids = 2 * len(data) >= CENTROIDS_PER_NUMBER * numbers
        if has_centroids and len(np.unique(problem.sites(data))) > numbers:
            models.append(held_out(problem, name, model, degree, data))
        if len(models) > 4:
            third, second, last = (candidate.rms_arcsec for candidate in models[-3:])
            if last > second > third:
                break  # larger fields only follow the noise
    return models


def held_out(
    problem: Problem, name: str, model: Model, degree: int, data: MatchedDots
) -> Candidate:
    """The error of a model on each dot by a fit to the others, a fifth of the dots at a time.

    Dots at one place are one: held out alone, its own error would be in the others.
    """
    site = problem.sites(data)
    dots = np.unique(site)
    fold = np.zeros(int(dots.max()) + 1, dtype=np.intp)
    fold[dots] = np.arange(len(dots)) % FOLDS
    start = fit(problem, model, degree, data, min_gain=COMPARED_GAIN).numbers
    off_px = np.full((len(data), 2), np.nan)
    for k in range(FOLDS):
        is_held_out = fold[site] == k
        if is_held_out.any() and not is_held_out.all():
            others = data.at(np.flatnonzero(~is_held_out))
            tested = data.at(np.flatnonzero(is_held_out))
            trained = fit(problem, model, degree, others, start, min_gain=COMPARED_GAIN)
            fold_off_px = residuals_px(problem, trained.geometry, tested)
            off_px[is_held_out] = np.stack(fold_off_px, axis=1)
    known_px = np.nan_to_num(off_px, nan=np.inf)
    arcsec = known_px * ARCSEC_PER_RAD / problem.nominal.tracker.focal_length_px
    count = np.bincount(site, minlength=len(fold))[dots]
    sum_x = np.bincount(site, arcsec[:, 0], minlength=len(fold))[dots]
    sum_y = np.bincount(site, arcsec[:, 1], minlength=len(fold))[dots]
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
    smaller_squares = (smaller.off_arcsec**2).sum(axis=1)
    larger_squares = (larger.off_arcsec**2).sum(axis=1)
    with np.errstate(invalid="ignore"):  # a dot that both put behind the lens
        gain = np.nan_to_num(smaller_squares - larger_squares, nan=0.0)
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
    is_simpler = fit.model.names != BROWN_CONRADY
    fit = _with_whole_lens(fit)
    root = _covariance_root(problem, fit, data, is_simpler=is_simpler)
    spread = np.linalg.norm(root, axis=1)
    names = (*fit.model.names, *fit.model.tracker_names)
    sigma = {}
    for name, one_sigma in zip(names, spread, strict=False):
        sigma[name] = float((STEPS | TRACKER_STEPS)[name] * one_sigma)
    to_arcsec = ARCSEC_PER_RAD / problem.nominal.monitor.focal_length_px
    field_x_px, field_y_px = _seen_places(fit.geometry)
    field_places = np.stack(_slopes_of_places(problem, fit, field_x_px, field_y_px))
    field_slopes = field_places @ root * to_arcsec
    field_arcsec = np.sqrt((field_slopes**2).sum(axis=(0, 2)))
    map_x_px, map_y_px = _grid_px(fit.geometry.monitor.resolution_px, MAP_PLACES)
    map_places = np.stack(_slopes_of_places(problem, fit, map_x_px, map_y_px))
    slopes = map_places @ root * to_arcsec
    columns, rows = MAP_PLACES
    is_visible = np.asarray(np.isfinite(slopes).all(axis=(0, 2))).reshape(rows, columns)
    # a place that was not seen has those of its neighbour
    slopes = slopes[:, _nearest_true(is_visible).ravel()]
    variance = (slopes**2).sum(axis=(0, 2)).reshape(is_visible.shape)
    map_arcsec = np.sqrt(np.where(is_visible, variance, np.nan))
    by_place = slopes.reshape(2 * is_visible.size, -1)
    _, sizes, vectors = np.linalg.svd(by_place.T, full_matrices=False)
    is_large = sizes**2 > MODE_SHARE * (sizes**2).sum()
    modes_arcsec = (sizes[:, None] * vectors)[is_large]
    return Uncertainty(sigma, map_arcsec, modes_arcsec, field_arcsec)


def _covariance_root(
    problem: Problem, fit: Fit, data: MatchedDots, *, is_simpler: bool
) -> FloatArray:
    """A matrix (numbers, errors) that times its transpose is the covariance of a fit's numbers.

    Where the lens `is_simpler` than the whole one, a column more has what the whole one would move.
    """
    off = residuals_sigma(problem, fit.geometry, data)
    residual = np.abs(off)
    weight = np.sqrt(np.minimum(1.0, HUBER / np.maximum(residual, 1e-12)))
    rows = _slopes_of_residuals(problem, fit, data) * weight[:, None]
    size = fit.model.size
    numbers = rows.shape[1]
    field_prior = np.full(numbers - size, 1 / FIELD_PRIOR_PX)
    prior = np.concatenate([np.full(size, PRIOR), field_prior])
    _, triangle = np.linalg.qr(np.vstack([rows, np.diag(prior)]))
    root = np.linalg.inv(triangle)
    residual_scatter = MAD_TO_SIGMA * float(np.median(residual))
    scale = max(1.0, residual_scatter, _scatter_of_dots(problem.sites(data), off, numbers))
    if not is_simpler:
        return np.asarray(scale * root)
    # One step of Gauss and Newton from the simple lens to the whole one, as one more error
    # beside the covariance's.
    downhill = rows.T @ (weight * off) + prior**2 * fit.numbers
    moved = root @ (root.T @ downhill)
    return np.column_stack([scale * root, moved])


def _nearest_true(mask: BoolArray) -> IntArray:
    """The number, row by row, of the nearest true place (h, w) of a mask (h, w)."""
    row, column = distance_transform_edt(
        (~mask).astype(np.int64), return_distances=False, return_indices=True
    )
    return np.asarray(row * mask.shape[1] + column)


def _grid_px(size_px: tuple[int, int], places: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
    """Places (n,) on a grid over an image, edges included, row by row: x and y, px."""
    width, height = size_px
    columns = np.linspace(-0.5, width - 0.5, places[0])
    rows = np.linspace(-0.5, height - 0.5, places[1])
    x_px, y_px = np.meshgrid(columns, rows)
    return x_px.ravel(), y_px.ravel()


def _seen_places(geometry: Geometry) -> tuple[FloatArray, FloatArray]:
    """Pixels (n,) of the monitor at a grid over the tracker's field in all its poses."""
    u_px, v_px = _grid_px(geometry.tracker.resolution_px, (FIELD_PLACES, FIELD_PLACES))
    monitor = geometry.monitor
    places = []
    for pose in range(len(geometry.q_poses)):
        rays = directions_in_cam(geometry, np.full(len(u_px), pose), u_px, v_px)
        places.append(np.stack(monitor.project(rays @ monitor.cam_to_image.T)))
    x_px, y_px = np.concatenate(places, axis=1)
    width, height = monitor.resolution_px
    with np.errstate(invalid="ignore"):
        across = np.abs(x_px - (width - 1) / 2) <= width / 2
        down = np.abs(y_px - (height - 1) / 2) <= height / 2
    on_screen = across & down
    return x_px[on_screen], y_px[on_screen]


def _scatter_of_dots(site: IntArray, off: FloatArray, numbers: int) -> float:
    """The scatter of mean residuals of the dots at each site (n,) in sigmas of their noise, of a
    fit of so many numbers.

    A dot is at one place in all its frames: what a detector's pixels do to it there is no average
    of the frames.
    """
    dots, dot, count = np.unique(site, return_inverse=True, return_counts=True)
    x_off, y_off = np.split(off, 2)
    root_count = np.sqrt(count)
    x_means = np.bincount(dot, x_off) / root_count
    y_means = np.bincount(dot, y_off) / root_count
    free = max(2 * len(dots) - numbers, 1)
    median = float(np.median(np.abs(np.concatenate([x_means, y_means]))))
    return MAD_TO_SIGMA * median * math.sqrt(2 * len(dots) / free)


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
    numbers = fit.numbers[: fit.model.size] + step
    varied = geometry_of(fit.model, problem.nominal, problem.q_poses, numbers)
    fitted_lens = fit.geometry.monitor.lens
    lens = varied.monitor.lens
    if fitted_lens is not None and fitted_lens.field is not None:
        lens = replace(lens or Lens(), field=fitted_lens.field)
    return replace(varied, monitor=replace(varied.monitor, lens=lens))


def _slopes_of_residuals(problem: Problem, fit: Fit, data: MatchedDots) -> FloatArray:
    """Derivatives of the residuals by each parameter and each coefficient of the field (2 n,
    numbers).
    """
    base = residuals_sigma(problem, fit.geometry, data)
    columns = []
    for k in range(fit.model.size):
        varied = residuals_sigma(problem, _varied(problem, fit, k), data)
        columns.append((varied - base) / DIFFERENCE)
    slopes = np.stack(columns, axis=1)
    if not fit.field_degree:
        return np.asarray(slopes)
    x_px = problem.plan.x_px[data.dot]
    y_px = problem.plan.y_px[data.dot]
    resolution_px = problem.nominal.monitor.resolution_px
    terms = field_terms(x_px, y_px, resolution_px, fit.field_degree)
    sigma_px = problem.monitor_px_per_px * data.centroids.sigma_px * problem.noise_px
    return np.hstack([slopes, _blocks(terms / sigma_px[:, None])])


def _slopes_of_places(
    problem: Problem, fit: Fit, x_px: FloatArray, y_px: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Derivatives of the places of the directions now at (x, y) by each number, monitor px (n,
    numbers), along x and y.
    """
    monitor = fit.geometry.monitor
    directions = monitor.rays(x_px, y_px)
    x_columns = []
    y_columns = []
    for k in range(fit.model.size):
        varied = _varied(problem, fit, k).monitor
        x, y = varied.project(directions @ varied.cam_to_image.T)
        x_columns.append((x - x_px) / DIFFERENCE)
        y_columns.append((y - y_px) / DIFFERENCE)
    x_slopes = np.stack(x_columns, axis=1)
    y_slopes = np.stack(y_columns, axis=1)
    if not fit.field_degree:
        return x_slopes, y_slopes
    terms = field_terms(x_px, y_px, monitor.resolution_px, fit.field_degree)
    nothing = np.zeros_like(terms)
    return np.hstack([x_slopes, terms, nothing]), np.hstack([y_slopes, nothing, terms])


def _blocks(terms: FloatArray) -> FloatArray:
    """Terms (n, k) for x and for y: (2 n, 2 k)."""
    nothing = np.zeros_like(terms)
    return np.block([[terms, nothing], [nothing, terms]])
