"""The camera behind photographs: attitude and refraction of each, focal length, principal point and
distortion of all.

Robust least squares of places. A larger lens, and refraction, are taken where stars that were held
out of the fit ask for them.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from hilstar.basics.arrays import BoolArray, FloatArray, IntArray
from hilstar.basics.errors import InputError
from hilstar.basics.rotation import from_rotation_vectors, multiply, to_matrix
from hilstar.basics.units import MAD_TO_SIGMA
from hilstar.optics.camera import Camera, Lens, bounded
from hilstar.sky.stars import AirAbove

REFRACTION_RAD = 2.826e-4  # 58.3 arcsec times tan z, at 1010 hPa and 10 C (Astronomical Almanac)
MIN_COS_ZENITH = 0.1  # the formula is wrong by 20 arcsec at 84 deg
MAX_STEPS, MAX_DAMPINGS, FIRST_DAMPING = 30, 10, 1e-4
MIN_GAIN = 1e-3  # a step that lowers the loss by less, in half squares of a sigma, is the last
DIFFERENCE = 1e-4  # step of a number, for its derivative
HUBER = 2.0
FOLDS = 5
EDGE_PX = 10.0  # beyond an image's edges, to which its lens is used
# a larger model is taken where it brings the held-out error below this share of the smaller one's
GAIN = 0.985
# name -> step that makes a number of order 1
STEPS = {
    "log_focal": 1e-3,
    "centre_x": 10.0,
    "centre_y": 10.0,
    "k1": 0.1,
    "k2": 1.0,
    "p1": 1e-3,
    "p2": 1e-3,
}
# sigma of a number's prior, in its steps: so wide that it decides only what stars leave open
PRIOR = {
    "log_focal": 1e3,
    "centre_x": 10.0,
    "centre_y": 10.0,
    "k1": 10.0,
    "k2": 10.0,
    "p1": 10.0,
    "p2": 10.0,
}
LENS_NAMES = ("k1", "k2", "p1", "p2")
ZENITH_PRIOR = 1.5  # sigma of the tangent of a zenith distance
# error of a place by a lens that folds, of that by the largest that does not: such a lens is what
# is there
FOLDED = 0.3
MODELS: dict[str, tuple[str, ...]] = {
    "pinhole": ("log_focal",),
    "k1": ("log_focal", "k1"),
    "k1 and principal point": ("log_focal", "k1", "centre_x", "centre_y"),
    "k1, k2 and principal point": ("log_focal", "k1", "k2", "centre_x", "centre_y"),
    "k1, k2, p1, p2 and principal point": tuple(STEPS),
}
STARS_A_NUMBER = 2.0  # residuals for each number of a model, at least
ATTITUDE_STEP_RAD = 1e-4


@dataclass(frozen=True, slots=True)
class Places:
    """Stars of one photograph: where they were seen, px, with one sigma (n,), and their
    directions (n, 3), ICRS.
    """

    x_px: FloatArray
    y_px: FloatArray
    sigma_px: FloatArray
    vectors: FloatArray

    def at(self, chosen: BoolArray | IntArray) -> "Places":
        """The places that are `chosen`, by a mask or by their numbers."""
        return Places(
            self.x_px[chosen], self.y_px[chosen], self.sigma_px[chosen], self.vectors[chosen]
        )


@dataclass(frozen=True, slots=True)
class Pointing:
    """Attitude of a photograph, and its zenith in cam as tangents (x, y) from the boresight; None
    where none is fitted.

    With `air` zenith and refraction are known.
    """

    q_icrs_to_cam: FloatArray
    zenith: tuple[float, float] | None = None
    air: AirAbove | None = None

    @property
    def boresight(self) -> FloatArray:
        """The direction of the boresight (3,), ICRS."""
        return np.asarray(to_matrix(self.q_icrs_to_cam)[2])

    @property
    def altitude_deg(self) -> float | None:
        """Height of the boresight over the horizon, where the air or refraction told it."""
        if self.air is not None:
            sine = float(np.clip(self.boresight @ self.air.up, -1, 1))
            return math.degrees(math.asin(sine))
        if self.zenith is None:
            return None
        return 90 - math.degrees(math.atan(math.hypot(*self.zenith)))

    def seen(self, vectors: FloatArray) -> FloatArray:
        """Directions (n, 3), ICRS, as the air bends them."""
        if self.air is not None:
            return self.air.bent(vectors)
        if self.zenith is None:
            return vectors
        icrs_to_cam = to_matrix(self.q_icrs_to_cam)
        bent = refracted(vectors @ icrs_to_cam.T, np.array([self.zenith]))
        return np.asarray(bent @ icrs_to_cam)

    def places_px(self, camera: Camera, vectors: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Pixels of directions (n, 3), ICRS; NaN for those that the camera has no place for."""
        icrs_to_cam = to_matrix(self.q_icrs_to_cam)
        return camera.project(self.seen(vectors) @ icrs_to_cam.T)


def refracted(cam: FloatArray, zenith: FloatArray) -> FloatArray:
    """Directions (n, 3) in cam, bent towards zeniths (n, 2) or (1, 2), which are tangents from
    the boresight.
    """
    up = np.column_stack([zenith, np.ones(len(zenith))])
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    cosine = np.maximum((cam * up).sum(axis=1), MIN_COS_ZENITH)
    bent = cam + REFRACTION_RAD * (up / cosine[:, None] - cam)
    return np.asarray(bent / np.linalg.norm(bent, axis=1, keepdims=True))


@dataclass(frozen=True, slots=True)
class CameraFit:
    """The camera and the pointings; `sigma` of its figures by name, and the rms error of held-out
    stars by model, px an axis.

    `floor_px` is the error of a place beyond its own noise.
    """

    camera: Camera
    pointings: tuple[Pointing, ...]
    model: str
    sigma: dict[str, float] = field(default_factory=dict)
    held_out_px: dict[str, float] = field(default_factory=dict)
    floor_px: float = 0.0

    def residuals_px(self, photographs: Sequence[Places]) -> list[FloatArray]:
        """Seen minus predicted (n, 2) of each photograph, px."""
        residuals = []
        for photograph, pointing in zip(photographs, self.pointings, strict=True):
            x, y = pointing.places_px(self.camera, photograph.vectors)
            off_px = np.column_stack([photograph.x_px - x, photograph.y_px - y])
            # a star that the lens has no place for is far off
            residuals.append(np.nan_to_num(off_px, nan=1e3))
        return residuals


def with_values(camera: Camera, values: dict[str, float]) -> Camera:
    """The camera changed by a model's values: its focal length and principal point from its own,
    its lens anew.
    """
    lens = camera.lens
    if set(LENS_NAMES) & set(values):
        old = camera.lens or Lens()
        k1, k2, k3 = old.radial
        p1, p2 = old.tangential
        radial = (values.get("k1", k1), values.get("k2", k2), k3)
        tangential = (values.get("p1", p1), values.get("p2", p2))
        lens = Lens(radial, tangential)
    cx, cy = camera.principal_point_px
    scale = math.exp(values.get("log_focal", 0.0))
    return replace(
        camera,
        focal_length_px=camera.focal_length_px * scale,
        principal_point_px=(cx + values.get("centre_x", 0.0), cy + values.get("centre_y", 0.0)),
        lens=lens,
    )


class _CameraLoss:
    """The residuals of places, in sigmas, as a function of numbers: those of the camera by `names`,
    three of each photograph's turn, and two of its zenith where that is fitted.

    `owner` (n,) is the photograph of each star.
    """

    def __init__(
        self,
        base: Camera,
        pointings: Sequence[Pointing],
        photographs: Sequence[Places],
        names: tuple[str, ...],
        floor_px: float,
    ) -> None:
        self.base = base
        self.pointings = pointings
        self.names = names
        counts = [len(photograph.x_px) for photograph in photographs]
        self.owner = np.repeat(np.arange(len(photographs)), counts)
        self.x_px = np.concatenate([photograph.x_px for photograph in photographs])
        self.y_px = np.concatenate([photograph.y_px for photograph in photographs])
        sigma_px = np.concatenate([photograph.sigma_px for photograph in photographs])
        self.sigma_px = np.hypot(sigma_px, floor_px)
        cam = []
        bent = []
        for pointing, photograph in zip(pointings, photographs, strict=True):
            vectors = photograph.vectors
            if pointing.air is not None:
                # an air that is known does not change with the numbers
                vectors = pointing.air.bent(vectors)
            cam.append(vectors @ to_matrix(pointing.q_icrs_to_cam).T)
            bent.append(pointing.zenith is not None and pointing.air is None)
        self.cam = np.concatenate(cam)
        self.bent = np.array(bent, dtype=bool)
        self.zenith_of = np.cumsum(self.bent) - 1  # the row of a photograph's zenith

    def start(self) -> FloatArray:
        """The numbers of the base and the pointings as they are."""
        lens = self.base.lens or Lens()
        lens_values = dict(zip(LENS_NAMES, (*lens.radial[:2], *lens.tangential), strict=True))
        camera_numbers = [lens_values.get(name, 0.0) / STEPS[name] for name in self.names]
        turns = np.zeros(3 * len(self.pointings))
        zeniths = []
        for pointing, bent in zip(self.pointings, self.bent, strict=True):
            if bent and pointing.zenith:
                zeniths.append(pointing.zenith)
        return np.concatenate([camera_numbers, turns, np.ravel(zeniths)])

    def parts(self, numbers: FloatArray) -> tuple[Camera, FloatArray, FloatArray]:
        """The camera, each photograph's turn (m, 4), and the fitted zeniths (z, 2) of numbers."""
        first_turn = len(self.names)
        first_zenith = first_turn + 3 * len(self.pointings)
        values = {}
        for name, number in zip(self.names, numbers, strict=False):
            values[name] = STEPS[name] * float(number)
        camera = with_values(self.base, values)
        # the image's middle stays where it is when the principal point moves: else the loss is one
        # long valley
        cx, cy = camera.principal_point_px
        base_cx, base_cy = self.base.principal_point_px
        follow = np.array([cy - base_cy, -(cx - base_cx), 0.0]) / camera.focal_length_px
        turn_numbers = numbers[first_turn:first_zenith].reshape(-1, 3)
        turns = from_rotation_vectors(ATTITUDE_STEP_RAD * turn_numbers + follow)
        return camera, turns, numbers[first_zenith:].reshape(-1, 2)

    def unpacked(self, numbers: FloatArray) -> tuple[Camera, tuple[Pointing, ...]]:
        """The camera and the pointings of numbers."""
        camera, turns, zeniths = self.parts(numbers)
        pointings = []
        for k, pointing in enumerate(self.pointings):
            zenith = pointing.zenith
            if self.bent[k]:
                x, y = zeniths[self.zenith_of[k]].tolist()
                zenith = (x, y)
            q_icrs_to_cam = multiply(turns[k], pointing.q_icrs_to_cam)
            pointings.append(replace(pointing, q_icrs_to_cam=q_icrs_to_cam, zenith=zenith))
        return camera, tuple(pointings)

    def residuals(self, numbers: FloatArray) -> FloatArray:
        """Those of all places, x and then y, then the priors."""
        camera, turns, zeniths = self.parts(numbers)
        cam = np.einsum("nij,nj->ni", to_matrix(turns)[self.owner], self.cam)
        if len(zeniths):
            is_bent = self.bent[self.owner]
            star_zeniths = zeniths[self.zenith_of[self.owner[is_bent]]]
            cam[is_bent] = refracted(cam[is_bent], star_zeniths)
        x, y = camera.project(cam)
        x_off = (self.x_px - x) / self.sigma_px
        y_off = (self.y_px - y) / self.sigma_px
        camera_prior = numbers[: len(self.names)] / [PRIOR[name] for name in self.names]
        zenith_prior = zeniths.ravel() / ZENITH_PRIOR
        off = np.concatenate([x_off, y_off, camera_prior, zenith_prior])
        return np.asarray(np.clip(np.nan_to_num(off, nan=1e4), -1e4, 1e4))

    def slopes(self, numbers: FloatArray, off: FloatArray) -> FloatArray:
        """Derivatives by differences: a photograph's own numbers move its own places alone, all
        photographs' at once.
        """
        first_turn = len(self.names)
        first_zenith = first_turn + 3 * len(self.pointings)
        stars = len(self.owner)
        jacobian = np.zeros((len(off), len(numbers)))

        def changed(columns: IntArray) -> FloatArray:
            moved = numbers.copy()
            moved[columns] += DIFFERENCE
            return (self.residuals(moved) - off) / DIFFERENCE

        def change_each(columns: IntArray, column: IntArray, rows: IntArray) -> None:
            """Change one number of every photograph; stars `rows` depend on columns[column]."""
            change = changed(columns)
            for axis_rows in (rows, stars + rows):
                jacobian[axis_rows, columns[column]] = change[axis_rows]

        for k in range(first_turn):
            jacobian[:, k] = changed(np.array([k]))
        for k in range(3):
            columns = np.arange(first_turn + k, first_zenith, 3)
            change_each(columns, self.owner, np.arange(stars))
        if self.bent.any():
            bent_stars = np.flatnonzero(self.bent[self.owner])
            zenith = self.zenith_of[self.owner[bent_stars]]
            for k in range(2):
                columns = np.arange(first_zenith + k, len(numbers), 2)
                change_each(columns, zenith, bent_stars)
        zenith_numbers = np.arange(first_zenith, len(numbers))
        first_prior = 2 * stars + first_turn
        prior_rows = first_prior + np.arange(len(zenith_numbers))
        jacobian[prior_rows, zenith_numbers] = 1 / ZENITH_PRIOR
        return jacobian


def fit_model(
    base: Camera,
    pointings: Sequence[Pointing],
    photographs: Sequence[Places],
    names: tuple[str, ...],
    floor_px: float,
) -> tuple[Camera, tuple[Pointing, ...], FloatArray]:
    """The camera and pointings that fit places best, and the covariance of the camera's numbers, in
    the order of `names`.

    `base` is the camera about which the numbers count. A pointing with a zenith has it fitted.
    """
    loss = _CameraLoss(base, pointings, photographs, names, floor_px)
    numbers, hessian = minimised(loss.residuals, loss.slopes, loss.start())
    camera, fitted_pointings = loss.unpacked(numbers)
    covariance = np.asarray(np.linalg.pinv(hessian), dtype=np.float64)
    count = len(names)
    return camera, fitted_pointings, covariance[:count, :count]


def minimised(
    residuals: Callable[[FloatArray], FloatArray],
    slopes: Callable[[FloatArray, FloatArray], FloatArray],
    numbers: FloatArray,
    least_gain: float = MIN_GAIN,
) -> tuple[FloatArray, FloatArray]:
    """The numbers with the smallest Huber loss (Levenberg and Marquardt, reweighted), and the
    normal matrix there.

    `slopes` are the derivatives of residuals, which it is given too.
    """

    def loss_of(off: FloatArray) -> float:
        size = np.abs(off)
        huber = np.where(size <= HUBER, size**2 / 2, HUBER * (size - HUBER / 2))
        return float(huber.sum())

    off = residuals(numbers)
    damping = FIRST_DAMPING
    best = loss_of(off)
    normal = np.eye(len(numbers))
    for _ in range(MAX_STEPS):
        design = slopes(numbers, off)
        weight = np.minimum(1.0, HUBER / np.maximum(np.abs(off), HUBER))
        normal = design.T @ (weight[:, None] * design)
        downhill = design.T @ (weight * off)
        diagonal = np.diag(normal) + 1e-12
        for _ in range(MAX_DAMPINGS):
            damped = normal + damping * np.diag(diagonal)
            step = np.linalg.solve(damped, -downhill)
            trial_off = residuals(numbers + step)
            trial = loss_of(trial_off)
            if trial <= best:
                break
            damping *= 10
        else:
            break
        gain = best - trial
        numbers = numbers + step
        off = trial_off
        best = trial
        damping = damping / 10
        if gain < least_gain:
            break
    return numbers, normal


def own_floor_px(
    residuals: Sequence[FloatArray], photographs: Sequence[Places], numbers: int
) -> float:
    """The error of a place along an axis beyond its own noise, px, by the residuals' spread
    without their tails.
    """
    off = np.concatenate(residuals).ravel()
    if not len(off):
        return 0.0
    sigma_px = np.concatenate([photograph.sigma_px for photograph in photographs])
    axis_sigma_px = np.repeat(sigma_px, 2)
    scale = math.sqrt(len(off) / max(len(off) - numbers, 1))
    low = 0.0
    high = 10.0
    # the floor at which residuals spread by one sigma, by halving: the spread falls with it
    for _ in range(40):
        middle = (low + high) / 2
        sigmas = off / np.hypot(axis_sigma_px, middle)
        spread = scale * MAD_TO_SIGMA * float(np.median(np.abs(sigmas)))
        if spread > 1:
            low = middle
        else:
            high = middle
    return high


def fit_camera(
    base: Camera,
    pointings: Sequence[Pointing],
    photographs: Sequence[Places],
    *,
    fixed: bool,
    last: bool,
) -> CameraFit:
    """The camera of photographs, least model that held-out stars ask for; `fixed`: the pointings
    alone.

    Refraction may be fitted. Where better places are to come, and it is not the `last`, the largest
    model serves without it.
    """
    bare = tuple(pointings)
    models: dict[str, tuple[str, ...]] = {"fixed": ()}
    if not fixed:
        models = _affordable(photographs)
    largest, camera, bare, floor_px = _largest(base, bare, photographs, models)
    if not last:
        return CameraFit(_bounded(camera) or camera, bare, largest, floor_px=floor_px)
    held_out_px = {}
    for name, names in models.items():
        held_out_px[name] = _held_out(base, bare, photographs, names, floor_px)
        if name == largest:
            break  # larger ones fold
    chosen = _asked_for(held_out_px)
    names = models[chosen]
    if chosen != largest:
        camera, bare, floor_px = _settled(base, bare, photographs, names)
    if any(pointing.air is None for pointing in bare):
        bent = _with_zeniths(camera, bare, photographs, floor_px)
        plain_px = held_out_px[chosen]
        if chosen != largest:
            plain_px = _held_out(camera, bare, photographs, names, floor_px)
        bent_px = _held_out(camera, bent, photographs, names, floor_px)
        held_out_px[f"{chosen}, refraction"] = bent_px
        if bent_px < GAIN * plain_px:
            camera, bare, floor_px = _settled(camera, bent, photographs, names)
            chosen += ", refraction"
    camera, bare, covariance = fit_model(camera, bare, photographs, names, floor_px)
    sigma = {}
    for k, name in enumerate(names):
        sigma[name] = STEPS[name] * math.sqrt(covariance[k, k])
    return CameraFit(_bounded(camera) or camera, bare, chosen, sigma, held_out_px, floor_px)


def _asked_for(held_out_px: dict[str, float]) -> str:
    """The smallest model, of those in order of size, that no larger one improves upon by GAIN; the
    largest where errors are not known.
    """
    *_, chosen = held_out_px
    best_px = math.inf
    for name, error_px in held_out_px.items():
        if error_px < GAIN * best_px:
            best_px = error_px
            chosen = name
    return chosen


def _affordable(photographs: Sequence[Places]) -> dict[str, tuple[str, ...]]:
    """The models for which there are STARS_A_NUMBER residuals for each number; the smallest
    always.
    """
    residuals = 2 * sum(len(photograph.x_px) for photograph in photographs)
    attitude_numbers = 3 * len(photographs)
    models: dict[str, tuple[str, ...]] = {}
    for name, names in MODELS.items():
        if residuals > STARS_A_NUMBER * (len(names) + attitude_numbers):
            models[name] = names
    if not models:
        models["pinhole"] = MODELS["pinhole"]
    return models


def _largest(
    base: Camera,
    pointings: tuple[Pointing, ...],
    photographs: Sequence[Places],
    models: dict[str, tuple[str, ...]],
) -> tuple[str, Camera, tuple[Pointing, ...], float]:
    """The largest model that does not fold within the image, its fit, and the error of a place by
    it, so that all weigh alike.

    Raises InputError where the smallest fits far worse than those that fold.
    """
    folding_px = math.inf
    for name in reversed(models):
        camera, turned, floor = _settled(base, pointings, photographs, models[name])
        if _bounded(camera) is not None:
            break
        # too many terms for so few stars, or a lens of another kind
        folding_px = min(folding_px, floor)
    if folding_px < FOLDED * floor:
        raise InputError(
            "the stars ask for a distortion that folds within the image: two directions share a"
            " pixel near its corners; give frames that are cut to the middle ([tracker]"
            " resolution_px with them), or of a longer focal length"
        )
    return name, camera, turned, floor


def k1_camera(
    base: Camera, pointings: Sequence[Pointing], photographs: Sequence[Places]
) -> tuple[Camera, list[Pointing]]:
    """The camera of least terms that has a distortion, and the pointings."""
    camera, fitted_pointings, _ = _settled(base, tuple(pointings), photographs, MODELS["k1"])
    return _bounded(camera) or camera, list(fitted_pointings)


def _bounded(camera: Camera) -> Camera | None:
    """The camera without directions far outside, which its polynomials fold into the image; None
    if it folds inside.
    """
    try:
        return bounded(camera, EDGE_PX)
    except InputError:
        return None


def _settled(
    camera: Camera,
    pointings: tuple[Pointing, ...],
    photographs: Sequence[Places],
    names: tuple[str, ...],
) -> tuple[Camera, tuple[Pointing, ...], float]:
    """A fit whose floor is that of its own residuals."""
    floor_px = 0.05
    for _ in range(3):
        camera, pointings, _ = fit_model(camera, pointings, photographs, names, floor_px)
        numbers = len(names) + 3 * len(pointings)
        numbers += 2 * sum(pointing.zenith is not None for pointing in pointings)
        residuals_px = CameraFit(camera, pointings, "").residuals_px(photographs)
        floor_px = own_floor_px(residuals_px, photographs, numbers)
    return camera, pointings, floor_px


def _held_out(
    camera: Camera,
    pointings: Sequence[Pointing],
    photographs: Sequence[Places],
    names: tuple[str, ...],
    floor_px: float,
) -> float:
    """Rms error of stars that were held out, px an axis, weighed by their errors, each counted
    up to HUBER + 1 sigmas.
    """
    squares = weights = 0.0
    # from which folds are near
    camera, pointings, _ = fit_model(camera, pointings, photographs, names, floor_px)
    for fold in range(FOLDS):
        fitted = []
        tested = []
        for photograph in photographs:
            is_held_out = np.arange(len(photograph.x_px)) % FOLDS == fold
            fitted.append(photograph.at(~is_held_out))
            tested.append(photograph.at(is_held_out))
        fold_camera, turned, _ = fit_model(camera, pointings, fitted, names, floor_px)
        residuals_px = CameraFit(fold_camera, turned, "").residuals_px(tested)
        for photograph, off_px in zip(tested, residuals_px, strict=True):
            sigma_px = np.hypot(photograph.sigma_px, floor_px)[:, None]
            clipped = np.clip(off_px / sigma_px, -HUBER - 1, HUBER + 1)
            squares += float((clipped**2).sum())
            weights += 2 * float((1 / sigma_px**2).sum())
    return math.sqrt(squares / max(weights, 1e-12))


def _with_zeniths(
    camera: Camera, pointings: Sequence[Pointing], photographs: Sequence[Places], floor_px: float
) -> tuple[Pointing, ...]:
    """The pointings, each with a zenith where its air is not known."""
    bent = []
    for pointing, places in zip(pointings, photographs, strict=True):
        if pointing.air is None:
            bent.append(_with_zenith(camera, pointing, places, floor_px))
        else:
            bent.append(pointing)
    return tuple(bent)


def _with_zenith(camera: Camera, pointing: Pointing, places: Places, floor_px: float) -> Pointing:
    """The pointing with the zenith by which refraction explains the places best."""
    sigma_px = np.hypot(places.sigma_px, floor_px)

    def off(trial: Pointing) -> FloatArray:
        residuals_px = CameraFit(camera, (trial,), "").residuals_px([places])
        return residuals_px[0] / sigma_px[:, None]

    # a zenith (a, b) squeezes a field by 1 + a^2 along x, 1 + b^2 along y and a b across both: it
    # is known but for its sign
    cx, cy = camera.principal_point_px
    u = places.x_px - cx
    v = places.y_px - cy
    zero = np.zeros(len(u))
    ones = zero + 1
    weight = 1 / sigma_px
    columns = []
    # shifts, a turn, a scale, and the two squeezes
    for x, y in ((ones, zero), (zero, ones), (v, -u), (u, v), (u, -v), (v, u)):
        columns.append(np.concatenate([x * weight, y * weight]))
    without = np.clip(off(replace(pointing, zenith=None)).T.ravel(), -5, 5)
    coefficients = np.linalg.lstsq(np.stack(columns, axis=1), without, rcond=None)[0]
    *_, along, across = coefficients.tolist()
    tangent = math.sqrt(2 * math.hypot(along, across) / REFRACTION_RAD)
    angle_rad = math.atan2(-across, -along) / 2
    tangent = min(max(tangent, 0.3), 3.0)
    fits = []
    for sign in (1, -1):
        zenith = (sign * tangent * math.cos(angle_rad), sign * tangent * math.sin(angle_rad))
        start = replace(pointing, zenith=zenith)
        _, fitted, _ = fit_model(camera, [start], [places], (), floor_px)
        fits.append(fitted[0])
    return min(fits, key=lambda trial: float(np.minimum(off(trial) ** 2, 9).sum()))
