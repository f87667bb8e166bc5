"""The camera behind photographs: attitude and refraction of each, focal length, principal point and distortion of all.

Robust least squares of places. A larger lens, and refraction, are taken where stars that were held out of the fit ask for
them.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from hilstar.arrays import BoolArray, FloatArray, IntArray
from hilstar.rotation import from_rotation_vector, multiply, to_matrix
from hilstar.scene.camera import Camera, Lens
from hilstar.sky.stars import AirAbove
from hilstar.units import MAD_TO_SIGMA

REFRACTION_RAD = 2.826e-4  # 58.3 arcsec times tan z, at 1010 hPa and 10 C (Astronomical Almanac)
MIN_COS_ZENITH = 0.1  # the formula is wrong by 20 arcsec at 84 deg
MAX_STEPS, MAX_DAMPINGS, FIRST_DAMPING = 30, 10, 1e-4
MIN_GAIN = 1e-3  # a step that lowers the loss by less, in half squares of a sigma, is the last
DIFFERENCE = 1e-4  # of a number, for its derivative
HUBER = 2.0
FOLDS = 5
GAIN = 0.985  # a larger model is taken where it brings the held-out error below this share of the smaller one's
STARTS = 8  # directions of the zenith from which refraction is fitted
# name -> step that makes a number of order 1
STEPS = {"log_focal": 1e-3, "centre_x": 10.0, "centre_y": 10.0, "k1": 0.1, "k2": 1.0, "p1": 1e-3, "p2": 1e-3}
# sigma of a number's prior, in its steps: so wide that it decides only what stars leave open
PRIOR = {"log_focal": 1e3, "centre_x": 10.0, "centre_y": 10.0, "k1": 10.0, "k2": 10.0, "p1": 10.0, "p2": 10.0}
LENS_NAMES = ("k1", "k2", "p1", "p2")
ZENITH_PRIOR = 1.5  # sigma of the tangent of a zenith distance
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
    """Stars of one photograph: where they were seen, px, with one sigma (n,), and their directions (n, 3), ICRS."""

    x_px: FloatArray
    y_px: FloatArray
    sigma_px: FloatArray
    vectors: FloatArray

    def at(self, chosen: BoolArray | IntArray) -> "Places":
        """Some of them."""
        return Places(self.x_px[chosen], self.y_px[chosen], self.sigma_px[chosen], self.vectors[chosen])


@dataclass(frozen=True, slots=True)
class Pointing:
    """Attitude of a photograph, and its zenith in cam as tangents (x, y) from the boresight; None where none is fitted.

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
        return None if self.zenith is None else 90 - math.degrees(math.atan(math.hypot(*self.zenith)))

    def seen(self, vectors: FloatArray) -> FloatArray:
        """Directions (n, 3), ICRS, as the air bends them."""
        if self.air is not None:
            return self.air.bent(vectors)
        if self.zenith is None:
            return vectors
        up = np.array([*self.zenith, 1.0]) / math.hypot(1.0, *self.zenith) @ to_matrix(self.q_icrs_to_cam)
        cosine = np.maximum(vectors @ up, MIN_COS_ZENITH)
        bent = vectors + REFRACTION_RAD * (up / cosine[:, None] - vectors)
        return np.asarray(bent / np.linalg.norm(bent, axis=1, keepdims=True))

    def places_px(self, camera: Camera, vectors: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Pixels of directions (n, 3), ICRS."""
        return camera.project(self.seen(vectors) @ to_matrix(self.q_icrs_to_cam).T)


@dataclass(frozen=True, slots=True)
class CameraFit:
    """The camera and the pointings; `sigma` of its figures by name, and the rms error of held-out stars by model, px an axis.

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
        found = []
        for one, pointing in zip(photographs, self.pointings, strict=True):
            x, y = pointing.places_px(self.camera, one.vectors)
            found.append(np.nan_to_num(np.column_stack([one.x_px - x, one.y_px - y]), nan=1e3))
        return found


def with_values(camera: Camera, values: dict[str, float]) -> Camera:
    """The camera changed by a model's values: its focal length and principal point from its own, its lens anew."""
    lens = camera.lens
    if set(LENS_NAMES) & set(values):
        old = camera.lens or Lens()
        k1, k2, k3 = old.radial
        p1, p2 = old.tangential
        lens = Lens((values.get("k1", k1), values.get("k2", k2), k3), (values.get("p1", p1), values.get("p2", p2)))
    cx, cy = camera.principal_point_px
    return replace(
        camera,
        focal_length_px=camera.focal_length_px * math.exp(values.get("log_focal", 0.0)),
        principal_point_px=(cx + values.get("centre_x", 0.0), cy + values.get("centre_y", 0.0)),
        lens=lens,
    )


@dataclass(frozen=True, slots=True)
class _Loss:
    """The residuals of places in sigmas by a camera's numbers and each photograph's own: a turn, and its zenith if fitted."""

    base: Camera
    pointings: Sequence[Pointing]
    photographs: Sequence[Places]
    names: tuple[str, ...]
    floor_px: float

    @property
    def sizes(self) -> list[int]:
        """How many numbers each photograph has."""
        return [3 if one.zenith is None else 5 for one in self.pointings]

    @property
    def ends(self) -> list[int]:
        """Where each photograph's numbers end."""
        return [len(self.names) + int(end) for end in np.cumsum(self.sizes)]

    def start(self) -> FloatArray:
        """The numbers of the base and the pointings as they are."""
        numbers = np.zeros(len(self.names) + sum(self.sizes))
        lens = self.base.lens or Lens()
        own = dict(zip(LENS_NAMES, (*lens.radial[:2], *lens.tangential), strict=True))
        numbers[: len(self.names)] = [own.get(name, 0.0) / STEPS[name] for name in self.names]
        for one, end in zip(self.pointings, self.ends, strict=True):
            if one.zenith is not None:
                numbers[end - 2 : end] = one.zenith
        return numbers

    def unpacked(self, numbers: FloatArray) -> tuple[Camera, list[Pointing]]:
        """The camera and the pointings of numbers."""
        camera = with_values(self.base, {name: STEPS[name] * float(n) for name, n in zip(self.names, numbers, strict=False)})
        # the image's middle stays where it is when the principal point moves: else the loss is one long valley
        dx, dy = (a - b for a, b in zip(camera.principal_point_px, self.base.principal_point_px, strict=True))
        follow = np.array([dy, -dx, 0.0]) / camera.focal_length_px
        found = []
        for one, end, size in zip(self.pointings, self.ends, self.sizes, strict=True):
            own = numbers[end - size : end]
            q = multiply(from_rotation_vector(ATTITUDE_STEP_RAD * own[:3] + follow), one.q_icrs_to_cam)
            found.append(replace(one, q_icrs_to_cam=q, zenith=None if size == 3 else (float(own[3]), float(own[4]))))
        return camera, found

    def residuals(self, numbers: FloatArray) -> FloatArray:
        """Those of the places, x and then y of each photograph, then the priors."""
        camera, found = self.unpacked(numbers)
        parts = []
        for one, places in zip(found, self.photographs, strict=True):
            x, y = one.places_px(camera, places.vectors)
            sigma = np.hypot(places.sigma_px, self.floor_px)
            parts += [(places.x_px - x) / sigma, (places.y_px - y) / sigma]
        parts.append(np.array([numbers[k] / PRIOR[name] for k, name in enumerate(self.names)]))
        parts += [np.array(one.zenith) / ZENITH_PRIOR for one in found if one.zenith is not None]
        return np.clip(np.nan_to_num(np.concatenate(parts), nan=1e4), -1e4, 1e4)

    def slopes(self, numbers: FloatArray, off: FloatArray) -> FloatArray:
        """Derivatives by differences: a photograph's own numbers move its own places alone, all photographs' at once."""
        owner = np.repeat(np.arange(len(self.photographs)), [2 * len(places.x_px) for places in self.photographs])
        found = np.zeros((len(off), len(numbers)))

        def changed(columns: Sequence[int]) -> FloatArray:
            moved = numbers.copy()
            moved[list(columns)] += DIFFERENCE
            return (self.residuals(moved) - off) / DIFFERENCE

        for k in range(len(self.names)):
            found[:, k] = changed([k])
        row = len(owner) + len(self.names)
        for k in range(max(self.sizes, default=0)):
            mine = [(i, end - size + k) for i, (end, size) in enumerate(zip(self.ends, self.sizes, strict=True)) if k < size]
            change = changed([column for _, column in mine])
            for i, column in mine:
                rows = np.flatnonzero(owner == i)
                found[rows, column] = change[rows]
        for end, size in zip(self.ends, self.sizes, strict=True):
            if size == 5:
                found[row, end - 2] = found[row + 1, end - 1] = 1 / ZENITH_PRIOR
                row += 2
        return found


def fit_model(
    base: Camera, pointings: Sequence[Pointing], photographs: Sequence[Places], names: tuple[str, ...], floor_px: float
) -> tuple[Camera, tuple[Pointing, ...], FloatArray]:
    """The camera and pointings that fit places best, and the covariance of the camera's numbers, in the order of `names`.

    `base` is the camera about which the numbers count. A pointing with a zenith has it fitted.
    """
    loss = _Loss(base, pointings, photographs, names, floor_px)
    numbers, hessian = _minimised(loss)
    camera, every = loss.unpacked(numbers)
    covariance = np.asarray(np.linalg.pinv(hessian), dtype=np.float64)
    return camera, tuple(every), covariance[: len(names), : len(names)]


def _minimised(loss: _Loss) -> tuple[FloatArray, FloatArray]:
    """The numbers with the smallest Huber loss (Levenberg and Marquardt, reweighted), and the normal matrix there."""

    def value(off: FloatArray) -> float:
        size = np.abs(off)
        return float(np.where(size <= HUBER, size**2 / 2, HUBER * (size - HUBER / 2)).sum())

    numbers = loss.start()
    off, damping = loss.residuals(numbers), FIRST_DAMPING
    best, normal = value(off), np.eye(len(numbers))
    for _ in range(MAX_STEPS):
        design = loss.slopes(numbers, off)
        weight = np.minimum(1.0, HUBER / np.maximum(np.abs(off), HUBER))
        normal, downhill = design.T @ (weight[:, None] * design), design.T @ (weight * off)
        for _ in range(MAX_DAMPINGS):
            step = np.linalg.solve(normal + damping * np.diag(np.diag(normal) + 1e-12), -downhill)
            trial = loss.residuals(numbers + step)
            new = value(trial)
            if new <= best:
                break
            damping *= 10
        else:
            break
        gain, numbers, off, best, damping = best - new, numbers + step, trial, new, damping / 10
        if gain < MIN_GAIN:
            break
    return numbers, normal


def own_floor_px(residuals: Sequence[FloatArray], photographs: Sequence[Places], numbers: int) -> float:
    """The error of a place along an axis beyond its own noise, px, by the residuals' spread without their tails."""
    off = np.concatenate(residuals).ravel()
    sigma = np.repeat(np.concatenate([one.sigma_px for one in photographs]), 2)
    scale = math.sqrt(len(off) / max(len(off) - numbers, 1))
    low, high = 0.0, 10.0
    for _ in range(40):
        middle = (low + high) / 2
        spread = scale * MAD_TO_SIGMA * float(np.median(np.abs(off / np.hypot(sigma, middle)))) if len(off) else 0.0
        low, high = (middle, high) if spread > 1 else (low, middle)
    return high


def fit_camera(
    base: Camera, pointings: Sequence[Pointing], photographs: Sequence[Places], *, fixed: bool, refraction: bool
) -> CameraFit:
    """The camera of photographs, least model that held-out stars ask for; `fixed`: the pointings alone.

    `refraction`: whether it may be fitted; a pointing that has a zenith already keeps one.
    """
    bare = tuple(pointings)
    count = sum(len(one.x_px) for one in photographs)
    numbers = 3 * len(bare)
    enough = {name: names for name, names in MODELS.items() if 2 * count > STARS_A_NUMBER * (len(names) + numbers)}
    models: dict[str, tuple[str, ...]] = {"fixed": ()} if fixed else enough
    if not models:
        models = {"pinhole": MODELS["pinhole"]}
    # the error of a place by the largest model, so that all are weighed alike
    camera, bare, floor = _settled(base, bare, photographs, list(models.values())[-1])
    chosen, best, held = next(iter(models)), math.inf, {}
    for name, names in models.items():
        held[name] = _held_out(base, bare, photographs, names, floor)
        if held[name] < GAIN * best:
            best, chosen = held[name], name
    names = () if fixed else MODELS[chosen]
    camera, bare, floor = _settled(base, bare, photographs, names)
    if refraction and any(one.air is None for one in bare):
        bent = tuple(
            one if one.zenith or one.air else _with_zenith(camera, one, places, floor)
            for one, places in zip(bare, photographs, strict=True)
        )
        plain_px = _held_out(camera, bare, photographs, names, floor)
        bent_px = _held_out(camera, bent, photographs, names, floor)
        held[f"{chosen}, refraction"] = bent_px
        if bent_px < GAIN * plain_px:
            camera, bare, floor = _settled(camera, bent, photographs, names)
            chosen += ", refraction"
    camera, bare, covariance = fit_model(camera, bare, photographs, names, floor)
    sigma = {name: STEPS[name] * math.sqrt(covariance[k, k]) for k, name in enumerate(names)}
    return CameraFit(camera, bare, chosen, sigma, held, floor)


def _settled(
    camera: Camera, pointings: tuple[Pointing, ...], photographs: Sequence[Places], names: tuple[str, ...]
) -> tuple[Camera, tuple[Pointing, ...], float]:
    """A fit whose floor is that of its own residuals."""
    floor = 0.05
    for _ in range(3):
        camera, pointings, _ = fit_model(camera, pointings, photographs, names, floor)
        fit = CameraFit(camera, pointings, "")
        floor = own_floor_px(
            fit.residuals_px(photographs), photographs, len(names) + sum(3 + 2 * (p.zenith is not None) for p in pointings)
        )
    return camera, pointings, floor


def _held_out(
    camera: Camera, pointings: Sequence[Pointing], photographs: Sequence[Places], names: tuple[str, ...], floor_px: float
) -> float:
    """Rms error of stars that were held out, px an axis, weighed by their errors, each counted up to HUBER + 1 sigmas."""
    squares = weights = 0.0
    for fold in range(FOLDS):
        out = [np.arange(len(one.x_px)) % FOLDS == fold for one in photographs]
        kept = [one.at(~mask) for one, mask in zip(photographs, out, strict=True)]
        found, turned, _ = fit_model(camera, pointings, kept, names, floor_px)
        for one, pointing, mask in zip(photographs, turned, out, strict=True):
            tested = one.at(mask)
            x, y = pointing.places_px(found, tested.vectors)
            off = np.column_stack([tested.x_px - x, tested.y_px - y])
            sigma = np.hypot(tested.sigma_px, floor_px)[:, None]
            squares += float((np.clip(np.nan_to_num(off / sigma, nan=1e3), -HUBER - 1, HUBER + 1) ** 2).sum())
            weights += 2 * float((1 / sigma**2).sum())
    return math.sqrt(squares / max(weights, 1e-12))


def _with_zenith(camera: Camera, pointing: Pointing, places: Places, floor_px: float) -> Pointing:
    """The pointing with the zenith that fits best, the camera as it is."""

    def loss(trial: Pointing) -> float:
        off = CameraFit(camera, (trial,), "").residuals_px([places])[0] / np.hypot(places.sigma_px, floor_px)[:, None]
        return float(np.minimum(off**2, 9).sum())

    fits: list[Pointing] = []
    for k in range(STARTS):
        angle = 2 * math.pi * k / STARTS
        start = Pointing(pointing.q_icrs_to_cam, (math.cos(angle), math.sin(angle)))
        _, (found,), _ = fit_model(camera, [start], [places], (), floor_px)
        fits.append(found)
    return min(fits, key=loss)
