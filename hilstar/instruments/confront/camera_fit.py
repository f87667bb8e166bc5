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
        """Some of them."""
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
            return math.degrees(math.asin(float(np.clip(self.boresight @ self.air.up, -1, 1))))
        if self.zenith is None:
            return None
        return 90 - math.degrees(math.atan(math.hypot(*self.zenith)))

    def seen(self, vectors: FloatArray) -> FloatArray:
        """Directions (n, 3), ICRS, as the air bends them."""
        if self.air is not None:
            return self.air.bent(vectors)
        if self.zenith is None:
            return vectors
        matrix = to_matrix(self.q_icrs_to_cam)
        return np.asarray(refracted(vectors @ matrix.T, np.array([self.zenith])) @ matrix)

    def places_px(self, camera: Camera, vectors: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Pixels of directions (n, 3), ICRS."""
        return camera.project(self.seen(vectors) @ to_matrix(self.q_icrs_to_cam).T)


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
            residuals.append(
                np.nan_to_num(np.column_stack([photograph.x_px - x, photograph.y_px - y]), nan=1e3)
            )
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
        lens = Lens(
            (values.get("k1", k1), values.get("k2", k2), k3),
            (values.get("p1", p1), values.get("p2", p2)),
        )
    cx, cy = camera.principal_point_px
    return replace(
        camera,
        focal_length_px=camera.focal_length_px * math.exp(values.get("log_focal", 0.0)),
        principal_point_px=(cx + values.get("centre_x", 0.0), cy + values.get("centre_y", 0.0)),
        lens=lens,
    )


class _CameraLoss:
    """The residuals of places in sigmas by a camera's numbers, each photograph's turn, and its
    zenith where that is fitted.
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
        self.owner = np.repeat(
            np.arange(len(photographs)), [len(photograph.x_px) for photograph in photographs]
        )
        self.x_px, self.y_px, sigma_px = (
            np.concatenate([getattr(photograph, name) for photograph in photographs])
            for name in ("x_px", "y_px", "sigma_px")
        )
        self.sigma_px = np.hypot(sigma_px, floor_px)
        star_vectors = [  # in cam as it is, behind an air that is known
            (photograph.air.bent(places.vectors) if photograph.air is not None else places.vectors)
            @ to_matrix(photograph.q_icrs_to_cam).T
            for photograph, places in zip(pointings, photographs, strict=True)
        ]
        self.cam = np.concatenate(star_vectors)
        self.bent = np.array(
            [photograph.zenith is not None and photograph.air is None for photograph in pointings],
            dtype=bool,
        )
        self.zenith_of = np.cumsum(self.bent) - 1  # the row of a photograph's zenith

    def start(self) -> FloatArray:
        """The numbers of the base and the pointings as they are."""
        lens = self.base.lens or Lens()
        lens_values = dict(zip(LENS_NAMES, (*lens.radial[:2], *lens.tangential), strict=True))
        zeniths = []
        for pointing, bent in zip(self.pointings, self.bent, strict=True):
            if bent and pointing.zenith:
                zeniths.append(pointing.zenith)
        turns = np.zeros(3 * len(self.pointings))
        return np.concatenate(
            [
                [lens_values.get(name, 0.0) / STEPS[name] for name in self.names],
                turns,
                np.ravel(zeniths),
            ]
        )

    def parts(self, numbers: FloatArray) -> tuple[Camera, FloatArray, FloatArray]:
        """The camera, each photograph's turn (m, 4), and the fitted zeniths (z, 2) of numbers."""
        camera_count = len(self.names)
        last = len(self.names) + 3 * len(self.pointings)
        camera = with_values(
            self.base,
            {name: STEPS[name] * float(n) for name, n in zip(self.names, numbers, strict=False)},
        )
        # the image's middle stays where it is when the principal point moves: else the loss is one
        # long valley
        dx, dy = (
            a - b
            for a, b in zip(camera.principal_point_px, self.base.principal_point_px, strict=True)
        )
        follow = np.array([dy, -dx, 0.0]) / camera.focal_length_px
        turns = from_rotation_vectors(
            ATTITUDE_STEP_RAD * numbers[camera_count:last].reshape(-1, 3) + follow
        )
        return camera, turns, numbers[last:].reshape(-1, 2)

    def unpacked(self, numbers: FloatArray) -> tuple[Camera, tuple[Pointing, ...]]:
        camera, turns, zeniths = self.parts(numbers)
        pointings = []
        for p, q in zip(self.pointings, turns, strict=True):
            pointings.append(replace(p, q_icrs_to_cam=multiply(q, p.q_icrs_to_cam)))
        for i in np.flatnonzero(self.bent):
            pointings[i] = replace(pointings[i], zenith=tuple(zeniths[self.zenith_of[i]].tolist()))
        return camera, tuple(pointings)

    def residuals(self, numbers: FloatArray) -> FloatArray:
        """Those of all places, x and then y, then the priors."""
        camera, turns, zeniths = self.parts(numbers)
        cam = np.einsum("nij,nj->ni", to_matrix(turns)[self.owner], self.cam)
        if len(zeniths):
            some = self.bent[self.owner]
            cam[some] = refracted(cam[some], zeniths[self.zenith_of[self.owner[some]]])
        x, y = camera.project(cam)
        parts = [(self.x_px - x) / self.sigma_px, (self.y_px - y) / self.sigma_px]
        parts += [
            numbers[: len(self.names)] / [PRIOR[name] for name in self.names],
            zeniths.ravel() / ZENITH_PRIOR,
        ]
        return np.asarray(np.clip(np.nan_to_num(np.concatenate(parts), nan=1e4), -1e4, 1e4))

    def slopes(self, numbers: FloatArray, off: FloatArray) -> FloatArray:
        """Derivatives by differences: a photograph's own numbers move its own places alone, all
        photographs' at once.
        """
        camera_count = len(self.names)
        stars = len(self.owner)
        photographs = len(self.pointings)
        found = np.zeros((len(off), len(numbers)))

        def changed(columns: IntArray) -> FloatArray:
            moved = numbers.copy()
            moved[columns] += DIFFERENCE
            return (self.residuals(moved) - off) / DIFFERENCE

        for k in range(camera_count):
            found[:, k] = changed(np.array([k]))
        axis_places = [
            (
                np.arange(camera_count + k, camera_count + 3 * photographs, 3),
                self.owner,
                np.arange(stars),
            )
            for k in range(3)
        ]
        if self.bent.any():
            lit = np.flatnonzero(self.bent[self.owner])
            zenith = self.zenith_of[self.owner[lit]]
            axis_places += [
                (np.arange(camera_count + 3 * photographs + k, len(numbers), 2), zenith, lit)
                for k in range(2)
            ]
        for columns, which, rows in axis_places:
            change = changed(columns)
            for first in (0, stars):
                found[first + rows, columns[which]] = change[first + rows]
        priors = np.arange(camera_count + 3 * photographs, len(numbers))
        found[2 * stars + camera_count + np.arange(len(priors)), priors] = 1 / ZENITH_PRIOR
        return found


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
    covariance = np.asarray(np.linalg.pinv(hessian), dtype=np.float64)
    return *loss.unpacked(numbers), covariance[: len(names), : len(names)]


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

    def value(off: FloatArray) -> float:
        size = np.abs(off)
        return float(np.where(size <= HUBER, size**2 / 2, HUBER * (size - HUBER / 2)).sum())

    off = residuals(numbers)
    damping = FIRST_DAMPING
    best = value(off)
    normal = np.eye(len(numbers))
    for _ in range(MAX_STEPS):
        design = slopes(numbers, off)
        weight = np.minimum(1.0, HUBER / np.maximum(np.abs(off), HUBER))
        normal = design.T @ (weight[:, None] * design)
        downhill = design.T @ (weight * off)
        for _ in range(MAX_DAMPINGS):
            step = np.linalg.solve(normal + damping * np.diag(np.diag(normal) + 1e-12), -downhill)
            trial = residuals(numbers + step)
            new = value(trial)
            if new <= best:
                break
            damping *= 10
        else:
            break
        gain = best - new
        numbers = numbers + step
        off = trial
        best = new
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
    sigma = np.repeat(np.concatenate([photograph.sigma_px for photograph in photographs]), 2)
    scale = math.sqrt(len(off) / max(len(off) - numbers, 1))
    low = 0.0
    high = 10.0
    for _ in range(40):
        middle = (low + high) / 2
        if len(off):
            spread = scale * MAD_TO_SIGMA * float(np.median(np.abs(off / np.hypot(sigma, middle))))
        else:
            spread = 0.0
        low, high = (middle, high) if spread > 1 else (low, middle)
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
    count = sum(len(photograph.x_px) for photograph in photographs)
    numbers = 3 * len(bare)
    enough = {
        name: names
        for name, names in MODELS.items()
        if 2 * count > STARS_A_NUMBER * (len(names) + numbers)
    }
    models: dict[str, tuple[str, ...]] = {"fixed": ()} if fixed else enough
    if not models:
        models = {"pinhole": MODELS["pinhole"]}
    largest, camera, bare, floor = _largest(base, bare, photographs, models)
    if not last:
        return CameraFit(_bounded(camera) or camera, bare, largest, floor_px=floor)
    models = {name: models[name] for name in [*models][: [*models].index(largest) + 1]}
    chosen = largest
    best = math.inf
    held = {}
    for name, names in models.items():
        held[name] = _held_out(base, bare, photographs, names, floor)
        if held[name] < GAIN * best:
            best = held[name]
            chosen = name
    names = models[chosen]
    if chosen != largest:
        camera, bare, floor = _settled(base, bare, photographs, names)
    if any(photograph.air is None for photograph in bare):
        bent = tuple(
            photograph if photograph.air else _with_zenith(camera, photograph, places, floor)
            for photograph, places in zip(bare, photographs, strict=True)
        )
        if chosen == largest:
            plain_px = best
        else:
            plain_px = _held_out(camera, bare, photographs, names, floor)
        bent_px = _held_out(camera, bent, photographs, names, floor)
        held[f"{chosen}, refraction"] = bent_px
        if bent_px < GAIN * plain_px:
            camera, bare, floor = _settled(camera, bent, photographs, names)
            chosen += ", refraction"
    camera, bare, covariance = fit_model(camera, bare, photographs, names, floor)
    sigma = {name: STEPS[name] * math.sqrt(covariance[k, k]) for k, name in enumerate(names)}
    return CameraFit(_bounded(camera) or camera, bare, chosen, sigma, held, floor)


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
    floor = 0.05
    for _ in range(3):
        camera, pointings, _ = fit_model(camera, pointings, photographs, names, floor)
        fit = CameraFit(camera, pointings, "")
        floor = own_floor_px(
            fit.residuals_px(photographs),
            photographs,
            len(names) + sum(3 + 2 * (p.zenith is not None) for p in pointings),
        )
    return camera, pointings, floor


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
        out = [np.arange(len(photograph.x_px)) % FOLDS == fold for photograph in photographs]
        fitted_stars = [
            photograph.at(~mask) for photograph, mask in zip(photographs, out, strict=True)
        ]
        held_camera, turned, _ = fit_model(camera, pointings, fitted_stars, names, floor_px)
        tested = [photograph.at(mask) for photograph, mask in zip(photographs, out, strict=True)]
        for photograph, off in zip(
            tested, CameraFit(held_camera, turned, "").residuals_px(tested), strict=True
        ):
            sigma = np.hypot(photograph.sigma_px, floor_px)[:, None]
            squares += float((np.clip(off / sigma, -HUBER - 1, HUBER + 1) ** 2).sum())
            weights += 2 * float((1 / sigma**2).sum())
    return math.sqrt(squares / max(weights, 1e-12))


def _with_zenith(camera: Camera, pointing: Pointing, places: Places, floor_px: float) -> Pointing:
    def off(trial: Pointing) -> FloatArray:
        return (
            CameraFit(camera, (trial,), "").residuals_px([places])[0]
            / np.hypot(places.sigma_px, floor_px)[:, None]
        )

    # a zenith (a, b) squeezes a field by 1 + a^2 along x, 1 + b^2 along y and a b across both: it
    # is known but for its sign
    (cx, cy), zero = camera.principal_point_px, np.zeros(len(places.x_px))
    u = places.x_px - cx
    v = places.y_px - cy
    ones = zero + 1
    columns = [(ones, zero), (zero, ones), (v, -u), (u, v), (u, -v), (v, u)]
    weight = 1 / np.hypot(places.sigma_px, floor_px)
    design = np.stack([np.concatenate([x * weight, y * weight]) for x, y in columns], axis=1)
    plain = np.clip(off(replace(pointing, zenith=None)).T.ravel(), -5, 5)
    *_, p, q = np.linalg.lstsq(design, plain, rcond=None)[0].tolist()
    tangent = math.sqrt(2 * math.hypot(p, q) / REFRACTION_RAD)
    angle = math.atan2(-q, -p) / 2
    tangent = min(max(tangent, 0.3), 3.0)
    starts = []
    for s in (1, -1):
        starts.append(
            replace(pointing, zenith=(s * tangent * math.cos(angle), s * tangent * math.sin(angle)))
        )
    fits = [fit_model(camera, [start], [places], (), floor_px)[1][0] for start in starts]
    return min(fits, key=lambda trial: float(np.minimum(off(trial) ** 2, 9).sum()))
