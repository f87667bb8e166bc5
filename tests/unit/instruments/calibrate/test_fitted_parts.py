"""Parts of fits and readings of calibrations, each against a closed form."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hilstar.basics.rotation import from_rotation_vector, normalise, to_matrix
from hilstar.basics.units import ARCSEC_PER_RAD
from hilstar.instruments.calibrate.attitude_pairs import _boresight_rad
from hilstar.instruments.calibrate.camera_edges import check_rate
from hilstar.instruments.calibrate.first_light.uniformity import _White, light_of_dots
from hilstar.instruments.calibrate.geometric import fit, match
from hilstar.instruments.calibrate.geometric.dots import DotPlan
from hilstar.instruments.calibrate.geometric.fit import (
    CENTROIDS_PER_NUMBER,
    HUBER,
    PINHOLE,
    POSE_STEP_RAD,
    STEPS,
    Geometry,
    MatchedDots,
    Model,
    Nominal,
    Problem,
    candidates,
    geometry_of,
    loss_of,
    residuals_sigma,
)
from hilstar.instruments.calibrate.geometric.match import (
    MAX_CHANCE,
    MIN_MOTION_PX,
    MOTION_NOISE,
    motion_limit_px,
)
from hilstar.instruments.calibrate.geometric.observed import Observed
from hilstar.instruments.calibrate.latency import Edges, pair
from hilstar.instruments.calibrate.measurements import read_measurements
from hilstar.instruments.calibrate.photometric import errors_of, fit_channel, held_out
from hilstar.instruments.calibrate.reference import Reading, _check_apart
from hilstar.instruments.calibrate.scale import scale_of
from hilstar.optics.camera import Camera
from tests.support.closed_camera import ClosedCamera, closed_context
from tests.support.refusals import refusal
from tests.support.tables import write_readings


def test_a_loss_is_a_square_that_goes_on_as_a_line():
    def value(*off: float) -> float:
        return loss_of(np.array(off), np.zeros(0), np.zeros(0))

    near, far = HUBER - 1e-6, HUBER + 1e-6
    assert value(near) == pytest.approx(HUBER**2 / 2, rel=1e-5)
    # no jump, and no bend, where one leads into the other
    assert value(far) - value(near) == pytest.approx(2e-6 * HUBER, rel=1e-5)
    assert value(-9.0) - value(-8.0) == pytest.approx(HUBER)
    assert value(0.3, -0.4) == pytest.approx(0.125)
    # half of four times the numbers' squares
    prior = np.full(2, 4.0)
    assert loss_of(np.zeros(1), np.array([0.5, 1.0]), prior) == pytest.approx(2.5)


@pytest.fixture
def white(tmp_path):
    """The fit of white's response by two readings of each of 18 levels."""
    codes = np.repeat(np.arange(0, 256, 15), 2)
    noisy = 1 + 1e-3 * np.tile([1.0, -1.0], 18)
    rows = zip(codes.tolist(), ["w"] * 36, (codes / 255) ** 2.2 * noisy, strict=True)
    return fit_channel(read_measurements(write_readings(tmp_path / "m.csv", list(rows))), "w")


def test_held_out_levels_count_down_to_three_decades(white):
    fit = replace(
        white,
        light=np.array([0.0, 9e-4, 1e-3, 0.1, 1.0]),
        levels=replace(white.levels, code=np.arange(5)),
        residual=np.array([0.5, 0.03, -0.04, 0.0]),
        residual_error=np.full(4, 0.01),
    )
    figures = held_out(fit)
    assert figures["rms_percent"] == pytest.approx(100 * math.sqrt(0.0025 / 3))
    assert figures["max_percent"] == pytest.approx(4.0)
    assert figures["p95_sigmas"] == pytest.approx(3.9)


def test_a_calibration_of_primaries_has_no_errors_of_white(white):
    once = replace(white, levels=replace(white.levels, relative_noise=math.nan))
    assert not once.levels.has_errors
    assert errors_of({"w": white}) is not None
    for fits in ({}, {"r": white}, {"w": white, "r": white}, {"w": once}):
        assert errors_of(fits) is None


def test_a_reading_of_white_is_noisier_than_the_mean_of_four(white):
    levels = replace(
        white.levels,
        stated=np.array([9.0, 3.0]),
        count=np.array([1, 4]),
        mean=np.array([1.0, 100.0]),
    )
    assert levels.reading_noise(0.08) == pytest.approx(0.1)
    # an exact black beside a white with its error is a reading with errors
    assert replace(levels, stated=np.array([0.0, 3.0])).has_errors
    assert not replace(levels, stated=np.zeros(2)).has_errors


def test_readings_weigh_alike_unless_the_noise_of_each_is_known():
    ratios = np.array([1.0, 1.1, 1.5])
    unknown = scale_of(100.0, ratios, np.array([0.01, 0.0, 0.02]))
    assert unknown.weights.tolist() == [1.0, 1.0, 1.0]
    assert unknown.noise_mag == 0.0
    known = scale_of(100.0, ratios, np.array([0.01, 0.5, 0.02]))
    assert known.weights[0] > known.weights[2] > 100 * known.weights[1]
    assert known.noise_mag == pytest.approx(known.weights.sum() ** -0.5)
    # the one far off counts for nothing where it is that noisy
    far = scale_of(10.0, np.array([1.0, 1.02, 0.98, 2.0]), np.array([0.01, 0.01, 0.01, 0.5]))
    assert far.flux_at_white_e_per_s == pytest.approx(10.0, abs=0.06)


@pytest.mark.parametrize(
    ("vector", "off_rad"), [((0.3, 0.0, 0.0), 0.3), ((0.0, 2.8, 0.0), 2.8), ((0.0, 0.0, 1.0), 0.0)]
)
def test_a_boresight_may_be_turned_backwards(vector, off_rad):
    q = from_rotation_vector(np.array(vector))
    assert _boresight_rad(q) == pytest.approx(off_rad, abs=1e-9)


@pytest.mark.parametrize(("apart_deg", "tells"), [(0.0, False), (90.0, True), (180.0, False)])
def test_parallel_and_opposite_faces_tell_no_rotation(apart_deg, tells):
    turned = [math.cos(math.radians(apart_deg)), math.sin(math.radians(apart_deg)), 0.0]
    directions = (np.array([1.0, 0.0, 0.0]), np.array(turned), None)
    readings = [Reading(2, "+x", "A", 0.0, 0.0, None, direction) for direction in directions]
    if tells:
        _check_apart(Path("cube.csv"), "faces", readings)
    else:
        assert "read another one" in refusal(_check_apart, Path("cube.csv"), "faces", readings)


def test_edges_are_paired_within_half_a_period_and_after_the_last_frame(rng):
    """60 changes at 16 ms, seen 12.5 ms later, of which one is seen 10 ms later still; the last is
    seen after the last frame, and one that no frame made half a second after that.
    """
    period_ns = 16e6
    changes_ns = (np.cumsum(rng.integers(3, 9, 60)) * period_ns).astype(np.int64)
    level = np.arange(60) % 2
    seen_ns = changes_ns + 12_500_000
    seen_ns[30] += 10_000_000
    seen_ns = np.append(seen_ns, changes_ns[-1] + 600_000_000)
    seen = Edges(seen_ns, np.append(level, 0))
    paired = pair(seen, Edges(changes_ns, level), period_ns)
    assert len(paired.latency_ns) == 59
    assert set(paired.latency_ns.tolist()) == {12_500_000.0}
    assert paired.unmatched == 1


def test_residuals_are_in_the_sigmas_of_their_own_centroids():
    """Sigmas of 1, 2 and 4 in a noise of half a pixel, of a monitor that is seen pixel by pixel."""
    camera = Camera((120, 80), 900.0, (50.0, 45.0), np.eye(3))
    upright = np.array([1.0, 0.0, 0.0, 0.0])
    x_px, y_px = np.array([20.0, 50.0, 90.0]), np.array([10.0, 30.0, 70.0])
    plan = DotPlan(x_px, y_px, np.ones((3, 1), dtype=bool))
    problem = Problem(plan, Nominal(camera, upright, camera), upright[None], noise_px=0.5)
    zero = np.zeros(3, dtype=int)
    seen_at = x_px + 1.0, y_px + np.array([2.0, -2.0, 2.0])
    centroids = Observed(zero, zero, *seen_at, np.array([1.0, 2.0, 4.0]))
    geometry = Geometry(camera, upright, camera, upright[None])
    found = residuals_sigma(problem, geometry, MatchedDots(centroids, np.arange(3)))
    assert found == pytest.approx([2.0, 1.0, 0.5, 4.0, -2.0, 1.0])


# A square may change every 50 ms.
@pytest.mark.parametrize(
    ("period_ms", "exposure_s", "is_quick"),
    [(30, 0.019, True), (30, 0.021, False), (51, 0.0, False), (None, 0.001, False)],
)
def test_an_exposure_lies_within_a_refresh_with_what_comes_between(period_ms, exposure_s, is_quick):
    count = 1 if period_ms is None else 40
    begin_ns = np.arange(count) * (period_ms or 0) * 10**6
    if is_quick:
        check_rate(begin_ns, exposure_s, 20.0)
    else:
        assert "may change every 50 ms" in refusal(check_rate, begin_ns, exposure_s, 20.0)


def test_a_glow_is_taken_from_the_lit_pixels_by_their_number():
    """Three lit pixels of 100 DN, and a glow of 4 DN in five beside them."""
    image = np.array([[100.0, 100, 100, 7, 7], [4, 4, 4, 4, 4]])
    assert light_of_dots(image, image == 100, image == 4) == 300 - 3 * 4


def test_white_is_watched_in_images_that_do_not_stay(tmp_path):
    camera = ClosedCamera()
    white = _White(closed_context(tmp_path, camera))
    taken = len(camera.taken)
    light = [white.read() for _ in range(2)]
    assert light[0] == pytest.approx(light[1], rel=0.01)
    assert [name for name, _ in camera.taken[taken:]] == ["white_000", "white_001"]
    left = {path.stem for path in tmp_path.rglob("white_*.png")}
    assert not left & {"white_000", "white_001"}


def test_the_median_of_few_dots_moves_by_chance():
    """Four dots a frame, whose median scatters by half as much as one."""
    by_chance_px = MAX_CHANCE * 10.0 / 2
    assert by_chance_px > max(MIN_MOTION_PX, MOTION_NOISE * 10.0)
    assert motion_limit_px(10.0, 4) == pytest.approx(by_chance_px)


@pytest.mark.parametrize("share", [0.99, 1.01])
def test_frames_between_which_the_image_moved_are_named(share):
    """Nine dots in each of four frames, without noise."""
    frame, dot = (part.ravel() for part in np.mgrid[0:4, 0:9])
    shift_px = np.array([0.0, 0.3, -0.7, 0.1]) * share * MIN_MOTION_PX
    still_px = 40.0 * np.arange(9)
    seen_at = still_px[dot] + shift_px[frame], still_px[dot]
    data = MatchedDots(Observed(frame, np.zeros_like(frame), *seen_at, np.ones(36)), dot)
    if share < 1:
        match.refuse_motion(data)
    else:
        assert "in x between frames 1 and 2" in refusal(match.refuse_motion, data)


@pytest.mark.parametrize(("fitting", "is_found"), [(20, True), (13, True), (11, False)])
def test_a_map_that_less_than_a_third_of_many_dots_fit_is_none(rng, fitting, is_found):
    """36 decoded dots, of which the first stand where a map has them."""
    x_px, y_px = rng.uniform(0, 1000, (2, 36))
    u, v = x_px / 2000 - 0.2, y_px / 2000 + 0.1
    u[fitting:], v[fitting:] = rng.uniform(-0.5, 0.5, (2, 36 - fitting))
    found = match.fitting_map(np.stack([u, v]), np.stack([x_px, y_px]), 1.0, rng)
    assert (found is not None) == is_found
    if is_found:
        np.testing.assert_allclose(found @ [0.05, -0.1, 1.0], [500, -400, 1.0], atol=3.0)


def test_a_geometry_is_its_numbers_in_their_steps():
    """A focal length by the power of e; a principal point about which the camera turns, so that its
    axis stays on its pixel; and poses that turn after those that were matched.
    """
    monitor = Camera((1920, 1080), 6000.0, (950.0, 530.0), np.eye(3))
    nominal = Nominal(monitor, np.array([1.0, 0.0, 0.0, 0.0]), monitor)
    rng = np.random.default_rng(3)
    q_poses = normalise(rng.normal(size=(2, 4)))
    shift_px, turn_rad = np.array([3.0, -5.0]), rng.normal(size=3)
    model = Model(("log_focal", "centre_x", "centre_y"), (), 2)
    numbers = [0.3 / STEPS["log_focal"], *(shift_px / STEPS["centre_x"])]
    found = geometry_of(model, nominal, q_poses, np.array([*numbers, *(turn_rad / POSE_STEP_RAD)]))
    assert found.monitor.focal_length_px == pytest.approx(6000.0 * math.exp(0.3))
    assert found.monitor.principal_point_px == pytest.approx((953.0, 525.0))
    same_focal = replace(found.monitor, focal_length_px=6000.0)
    axis_px = np.ravel(same_focal.project(same_focal.cam_to_image[:, 2][None]))
    # to second order: 5 px of 6000, squared
    assert axis_px == pytest.approx([950.0, 530.0], abs=0.01)
    turned = Rotation.from_rotvec(turn_rad) * Rotation.from_quat(q_poses[1], scalar_first=True)
    assert to_matrix(found.q_poses[1]) == pytest.approx(turned.as_matrix())
    assert found.q_poses[0].tolist() == q_poses[0].tolist()


def dots_seen(
    count: int, noise_px: tuple[float, float], frames: int = 1
) -> tuple[Problem, MatchedDots]:
    """Dots of a monitor that is seen pixel by pixel, each in some frames, with noise along x and y."""
    rng = np.random.default_rng(8)
    camera = Camera((1200, 800), 9000.0, (590.0, 410.0), np.eye(3))
    upright = np.array([1.0, 0.0, 0.0, 0.0])
    x_px, y_px = rng.uniform(0, 1200, count), rng.uniform(0, 800, count)
    plan = DotPlan(x_px, y_px, np.ones((count, frames), dtype=bool))
    frame = np.repeat(np.arange(frames), count)
    seen = [
        np.tile(place, frames) + rng.normal(0, noise, frames * count)
        for place, noise in zip((x_px, y_px), noise_px, strict=True)
    ]
    centroids = Observed(frame, np.zeros_like(frame), *seen, np.ones(len(frame)))
    problem = Problem(plan, Nominal(camera, upright, camera), upright[None], max(noise_px))
    return problem, MatchedDots(centroids, np.tile(np.arange(count), frames))


def test_a_dot_s_held_out_error_is_the_mean_of_its_frames_along_each_axis():
    """Noise of 0.02 px along x and of 0.06 along y, in four frames: half of it each."""
    problem, data = dots_seen(400, (0.02, 0.06), frames=4)
    found = fit.held_out(problem, "pinhole", Model(PINHOLE), 0, data)
    assert found.dot.tolist() == list(range(400))
    rms_px = np.sqrt((found.off_arcsec**2).mean(axis=0)) / ARCSEC_PER_RAD * 9000.0
    # of 400 dots, each known to 1 / sqrt(800) of its sigma
    assert rms_px == pytest.approx([0.01, 0.03], rel=5 / math.sqrt(800))


@pytest.mark.parametrize(("name", "numbers"), [("pinhole", 4 + 2), ("pinhole + k1", 5 + 2)])
def test_a_model_is_tried_from_so_many_centroids_and_places_a_number_on(name, numbers):
    """A model's own numbers and a shift's two, three of a centroid's to each; and of more places than
    numbers.
    """
    enough = math.ceil(CENTROIDS_PER_NUMBER * numbers / 2)
    for count, is_tried in ((enough, True), (enough - 1, False)):
        tried = candidates(*dots_seen(count, (0.02, 0.02)), ())
        assert (name in [model.name for model in tried]) == is_tried
    # as many centroids of few dots
    few, data = dots_seen(numbers, (0.02, 0.02), frames=9)
    assert name not in [model.name for model in candidates(few, data, ())]
