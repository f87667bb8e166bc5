"""The least squares behind a camera of photographs, each part against a closed form: residuals and
their slopes, the errors of what is fitted, and which model is taken.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from hilstar.basics.errors import InputError
from hilstar.basics.rotation import from_matrix
from hilstar.instruments.confront import camera_fit
from hilstar.instruments.confront.camera_fit import (
    GAIN,
    HUBER,
    MODELS,
    STEPS,
    CameraFit,
    Places,
    Pointing,
    _affordable,
    _asked_for,
    _CameraLoss,
    _largest,
    _settled,
    _with_zeniths,
    fit_model,
    minimised,
    own_floor_px,
)
from hilstar.optics.camera import Camera, Lens
from hilstar.sky.stars import AirAbove
from tests.support.planted_sky import rotation_of

FOCAL_PX = 1500.0
BASE = Camera((640, 480), FOCAL_PX, (326.0, 234.0), np.eye(3), Lens((0.3, 0.0, 0.0), (0.01, -0.02)))
NAMES = MODELS["k1, k2, p1, p2 and principal point"]
UP = rotation_of(70.0, 60.0, 0.0)[2]  # a zenith 43 degrees from the boresights
REFRACTION_RAD = (2.9e-4, -3.3e-7)
# by central differences of 1e-3 of a number against those of 1e-4 to one side: by the curvature
SLOPE_STEP, SLOPE_SHARE = 1e-3, 1e-3
PRIOR_TANGENTS, ZENITH_PRIOR = (1.2, 0.7, -0.4, 1.5), 1.5


def directions(turn: np.ndarray, stars: int, rng: np.random.Generator) -> np.ndarray:
    """Stars (n, 3), ICRS, all over the image of a camera so turned."""
    tangents = rng.uniform([-0.2, -0.14], [0.2, 0.14], (stars, 2))
    cam = np.column_stack([tangents, np.ones(stars)])
    return (cam / np.linalg.norm(cam, axis=1, keepdims=True)) @ turn


def photographed(rng: np.random.Generator) -> tuple[list[Pointing], list[Places]]:
    """Four photographs of 5, 6, 7 and 8 stars, where the camera sees them: one with a fitted
    zenith, one behind a known air, one behind none, and another with a zenith.
    """
    pointings = []
    photographs = []
    turns_deg = ((40.0, 20.0, 10.0), (43.0, 24.0, -60.0), (38.0, 17.0, 130.0), (45.0, 15.0, 80.0))
    zeniths = ((1.2, 0.7), None, None, (-0.4, 1.5))
    for k, (turn_deg, zenith) in enumerate(zip(turns_deg, zeniths, strict=True)):
        turn = rotation_of(*turn_deg)
        air = AirAbove(UP, REFRACTION_RAD) if k == 1 else None
        pointings.append(Pointing(from_matrix(turn), zenith, air))
        vectors = directions(turn, 5 + k, rng)
        x_px, y_px = pointings[-1].places_px(BASE, vectors)
        sigma_px = np.full(len(vectors), 0.1 * (1 + k))
        photographs.append(Places(x_px, y_px, sigma_px, vectors))
    return pointings, photographs


@pytest.fixture
def loss(rng: np.random.Generator) -> _CameraLoss:
    pointings, photographs = photographed(rng)
    return _CameraLoss(BASE, pointings, photographs, NAMES, 0.05)


def test_places_where_a_camera_sees_them_have_no_residuals_but_the_priors(
    loss: _CameraLoss,
) -> None:
    start = loss.start()
    off = loss.residuals(start)
    stars = 5 + 6 + 7 + 8
    assert len(off) == 2 * stars + len(NAMES) + 4
    assert off[: 2 * stars] == pytest.approx(0, abs=1e-6)
    numbers = {"k1": 0.3, "p1": 0.01, "p2": -0.02}
    # a number's prior is ten of its steps
    priors = [numbers.get(name, 0.0) / STEPS[name] / 10 for name in NAMES]
    assert off[2 * stars : -4] == pytest.approx(priors)
    assert off[-4:] == pytest.approx(np.array(PRIOR_TANGENTS) / ZENITH_PRIOR)


def test_what_is_packed_into_numbers_comes_back(loss: _CameraLoss) -> None:
    camera, pointings = loss.unpacked(loss.start())
    assert (camera.focal_length_px, camera.principal_point_px) == (FOCAL_PX, (326.0, 234.0))
    assert camera.lens == BASE.lens
    assert [pointing.zenith for pointing in pointings] == [(1.2, 0.7), None, None, (-0.4, 1.5)]
    for pointing, given in zip(pointings, loss.pointings, strict=True):
        assert pointing.q_icrs_to_cam == pytest.approx(given.q_icrs_to_cam)


def test_slopes_are_those_of_each_number_alone(loss: _CameraLoss) -> None:
    """Of the camera, of four attitudes and of the two zeniths that are fitted."""
    numbers = loss.start()
    slopes = loss.slopes(numbers, loss.residuals(numbers))
    assert slopes.shape[1] == len(NAMES) + 4 * 3 + 2 * 2
    for column in range(len(numbers)):
        step = SLOPE_STEP * np.eye(len(numbers))[column]
        change = loss.residuals(numbers + step) - loss.residuals(numbers - step)
        wanted = change / (2 * SLOPE_STEP)
        within = SLOPE_SHARE * np.abs(wanted).max()
        assert slopes[:, column] == pytest.approx(wanted, abs=within)


@pytest.mark.parametrize("name", ["centre_x", "centre_y"])
def test_what_is_in_the_middle_stays_where_it_is_when_the_principal_point_moves(name) -> None:
    """By 10 px, of which the square over the focal length is left."""
    turn = rotation_of(40.0, 20.0, 10.0)
    pointing = Pointing(from_matrix(turn))
    one = np.ones(1)
    places = Places(326.0 * one, 234.0 * one, one, turn[2][None])
    plain = replace(BASE, lens=None)
    loss = _CameraLoss(plain, [pointing], [places], (name,), 0.0)
    off = loss.residuals(np.array([1.0, 0.0, 0.0, 0.0]))
    assert off[:2] == pytest.approx([0.0, 0.0], abs=10.0**3 / FOCAL_PX**2)


def test_residuals_are_places_seen_less_predicted_and_far_off_without_a_place() -> None:
    turn = rotation_of(40.0, 20.0, 10.0)
    vectors = np.array([turn[2], -turn[2]])
    places = Places(np.array([326.25, 0.0]), np.array([234.5, 0.0]), np.ones(2), vectors)
    fit = CameraFit(BASE, (Pointing(from_matrix(turn)),), "k1")
    (off_px,) = fit.residuals_px([places])
    assert off_px == pytest.approx(np.array([[0.25, 0.5], [1000.0, 1000.0]]))


def test_a_boresight_s_altitude_is_told_by_the_air_or_by_a_zenith() -> None:
    q_icrs_to_cam = from_matrix(rotation_of(70.0, 35.0, 0.0))
    known = Pointing(q_icrs_to_cam, (0.1, 0.1), AirAbove(UP, REFRACTION_RAD))
    assert known.altitude_deg == pytest.approx(90 - 25)
    fitted = Pointing(q_icrs_to_cam, (0.75, -1.0))
    assert fitted.altitude_deg == pytest.approx(90 - math.degrees(math.atan(1.25)))
    assert Pointing(q_icrs_to_cam).altitude_deg is None


def test_errors_of_a_scale_and_a_distortion_are_those_of_radial_least_squares() -> None:
    """Stars in pairs about the middle: a turn moves a pair alike, a scale and k1 apart. The radius
    r = f u (1 + k1 u^2) of 0.3 px of error.
    """
    turn = rotation_of(40.0, 20.0, 10.0)
    half = np.random.default_rng(4).uniform([-0.2, -0.14], [0.2, 0.14], (30, 2))
    cam = np.column_stack([np.concatenate([half, -half]), np.ones(60)])
    camera = Camera((640, 480), FOCAL_PX, (319.5, 239.5), np.eye(3), Lens())
    x_px, y_px = camera.project(cam)
    places = Places(x_px, y_px, np.full(60, 0.3), cam @ turn)
    pointing = Pointing(from_matrix(turn))
    covariance = fit_model(camera, [pointing], [places], ("log_focal", "k1"), 0.4)[2]
    u = np.hypot(*cam[:, :2].T)
    slopes = np.column_stack([FOCAL_PX * u, FOCAL_PX * u**3]) / math.hypot(0.3, 0.4)
    wanted = np.linalg.inv(slopes.T @ slopes)
    steps = np.array([STEPS["log_focal"], STEPS["k1"]])
    # the priors of 1000 and 10 steps add to the normal matrix
    wanted = np.linalg.inv(np.linalg.inv(wanted / np.outer(steps, steps)) + np.diag([1e-6, 1e-2]))
    assert covariance == pytest.approx(wanted, rel=2e-3)


@pytest.mark.parametrize("is_near", [False, True])
def test_numbers_have_the_smallest_huber_loss(is_near: bool) -> None:
    """Against SciPy's, of a line through points of which a third are outliers to one side: from
    nothing, and from where the sum of squares is smallest.
    """
    rng = np.random.default_rng(6)
    x = np.linspace(-1, 1, 60)
    y = 3 + 2 * x + rng.standard_normal(60) + 6 * (rng.uniform(size=60) < 0.35)
    design = np.column_stack([np.ones(60), x])

    def residuals(numbers: np.ndarray) -> np.ndarray:
        return np.asarray(design @ numbers - y)

    start = np.zeros(2)
    if is_near:
        start = np.linalg.lstsq(design, y, rcond=None)[0]
    numbers, normal = minimised(residuals, lambda numbers, off: design, start, 1e-12)
    reference = least_squares(residuals, np.zeros(2), loss="huber", f_scale=HUBER, xtol=1e-12)
    assert numbers == pytest.approx(reference.x, abs=1e-3)
    weight = np.minimum(1, HUBER / np.abs(residuals(numbers)))
    assert normal == pytest.approx(design.T @ (weight[:, None] * design), rel=1e-2)


@pytest.mark.parametrize("numbers", [0, 30])
def test_a_floor_is_what_residuals_spread_by_beyond_their_noise_and_freedom(numbers: int) -> None:
    """Forty of 1 px to either side: 1.4826 px by their median, of 40 less the numbers' freedom."""
    off_px = np.array([1.0, -1.0] * 20).reshape(20, 2)
    places = Places(np.zeros(20), np.zeros(20), np.full(20, 0.5), np.zeros((20, 3)))
    spread_px = 1.4826 * math.sqrt(40 / (40 - numbers))
    wanted_px = math.sqrt(spread_px**2 - 0.5**2)
    assert own_floor_px([off_px], [places], numbers) == pytest.approx(wanted_px, rel=1e-4)
    assert own_floor_px([off_px / 10], [places], 0) == pytest.approx(0, abs=1e-6)
    assert own_floor_px([np.empty((0, 2))], [places.at(np.zeros(20, dtype=bool))], 0) == 0.0


@pytest.mark.parametrize(
    ("errors_px", "chosen"),
    [
        ((1.0, 0.99, 0.986), "a"),
        ((1.0, GAIN - 0.001, 0.98), "b"),
        ((1.0, 0.9, 0.8), "c"),
        ((1.0, 1.1, 0.98), "c"),
        ((math.nan, math.nan, math.nan), "c"),
    ],
)
def test_a_larger_model_is_taken_by_a_gain_alone(errors_px, chosen) -> None:
    assert _asked_for(dict(zip("abc", errors_px, strict=True))) == chosen


@pytest.mark.parametrize(
    ("stars", "models"),
    [
        ((3,), 1),
        ((5,), 1),
        ((6,), 2),
        ((7,), 2),
        ((8,), 3),
        ((9,), 4),
        ((10,), 4),
        ((11,), 5),
        # two attitudes are six numbers: of 16 residuals two for seven and no more
        ((3, 5), 1),
        ((4, 5), 2),
        ((6, 5), 3),
    ],
)
def test_models_have_two_residuals_for_each_number_at_least(stars, models) -> None:
    """A pinhole has 1 number, and larger ones 2, 4, 5 and 7; an attitude has 3."""
    photographs = [
        Places(np.zeros(count), np.zeros(count), np.ones(count), np.zeros((count, 3)))
        for count in stars
    ]
    assert list(_affordable(photographs)) == list(MODELS)[:models]


def test_a_zenith_is_fitted_where_no_air_is_known(rng: np.random.Generator) -> None:
    pointings, photographs = photographed(rng)
    pointings[2] = replace(pointings[2], zenith=None)
    fitted = _with_zeniths(BASE, pointings[1:3], photographs[1:3], 0.01)
    assert fitted[0] is pointings[1]
    assert fitted[1].zenith is not None
    assert fitted[1].air is None


@pytest.mark.parametrize(("share", "is_refused"), [(0.29, True), (0.31, False)])
def test_a_lens_that_folds_is_refused_where_places_ask_for_it(share, is_refused, monkeypatch):
    """Its error is below three tenths of that by the largest model that does not fold."""
    fold = replace(BASE, lens=Lens((-30.0, 0.0, 0.0)))
    pinhole = replace(BASE, lens=None)
    fits = {"k1": (fold, (), share), "pinhole": (pinhole, (), 1.0)}
    by_names = {MODELS[name]: fit for name, fit in fits.items()}
    monkeypatch.setattr(
        camera_fit, "_settled", lambda base, pointings, seen, names: by_names[names]
    )
    models = {name: MODELS[name] for name in ("pinhole", "k1")}
    if is_refused:
        with pytest.raises(InputError, match="folds within the image"):
            _largest(BASE, (), [], models)
    else:
        assert _largest(BASE, (), [], models) == ("pinhole", pinhole, (), 1.0)


def test_a_floor_has_the_freedom_of_each_number_that_was_fitted(rng: np.random.Generator) -> None:
    """Of 52 residuals 1 number of the camera, 3 of each of four turns and 2 of each of two zeniths
    leave 35.
    """
    pointings, photographs = photographed(rng)
    blurred = []
    for places in photographs:
        x_px, y_px = (axis + rng.normal(0, 0.5, len(axis)) for axis in (places.x_px, places.y_px))
        blurred.append(replace(places, x_px=x_px, y_px=y_px, sigma_px=np.full(len(x_px), 0.1)))
    camera, fitted, floor_px = _settled(BASE, tuple(pointings), blurred, ("log_focal",))
    off_px = np.concatenate(CameraFit(camera, fitted, "").residuals_px(blurred))
    spread_px = 1.4826 * float(np.median(np.abs(off_px)))
    assert math.hypot(0.1, floor_px) == pytest.approx(spread_px * math.sqrt(52 / 35), rel=1e-3)
