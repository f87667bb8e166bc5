"""The functions that studies measure by, each against a closed form, without a study: centroids and
attitudes of rigs, light over frames, predictors, lone stars, rays through a lens, and limbs.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.constants import c, h
from scipy.special import ndtr, ndtri

from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.basics.rotation import (
    angle_between_rad,
    from_rotation_vector,
    propagate,
    to_matrix,
    to_radec_roll_deg,
)
from hilstar.basics.units import ARCSEC_PER_RAD, NS_PER_S
from hilstar.display.panel import Panel
from hilstar.display.quantise import shown_light
from hilstar.display.response import Levels, gamma_response
from hilstar.instruments.study import (
    bodies,
    codes,
    colour,
    economy,
    faults,
    geometry,
    limits,
    models,
    predictors,
    rigs,
    sky_figures,
    study_benches,
    timing,
)
from hilstar.instruments.study.sweep import Spent, beaten_by, spent
from hilstar.instruments.study.timing import stripe_depth
from hilstar.optics.frame_motion import CameraTurn
from hilstar.optics.sprites import pack_sprites
from hilstar.server.bench.bench_file import read_bench_file
from tests.support.benches import ORION_Q, ROOT
from tests.support.tables import csv_rows

ROUNDING = 1e-9
NEAR = predictors.NEAR


def star_image(x_px: float, y_px: float, sigma_px: float, size_px=(640, 480)) -> np.ndarray:
    """A star of 1000 DN, integrated over pixels by erf, on no background."""
    across = np.diff(ndtr((np.arange(size_px[0] + 1) - 0.5 - x_px) / sigma_px))
    down = np.diff(ndtr((np.arange(size_px[1] + 1) - 0.5 - y_px) / sigma_px))
    return 1000 * np.outer(down, across)


def test_a_centre_of_mass_is_along_its_own_axis():
    image = star_image(100.3, 49.8, 0.7)
    x_px, y_px = rigs.centre_of_mass(image, np.array([100]), np.array([50]))
    # a Gaussian of 0.7 px has 1e-5 of its light beyond 3 px
    assert (x_px[0], y_px[0]) == pytest.approx((100.3, 49.8), abs=1e-3)


def test_a_parabola_s_top_is_that_of_a_sampled_gaussian_s_logarithm():
    at = np.arange(-2, 3)
    lines = np.exp(-((at - 0.37) ** 2) / (2 * 0.8**2))[None, None, :] * [[[50.0], [200.0], [90.0]]]
    assert rigs._vertex(lines)[0] == pytest.approx(0.37)
    # light without a top, and light whose top is beyond the pixels
    rising = np.exp(at / 2 + at**2)[None, None, :]
    assert rigs._vertex(rising)[0] == 0.0
    beyond = np.exp(-((at - 7.0) ** 2) / 200)[None, None, :]
    assert rigs._vertex(beyond)[0] == 2.0


def test_a_star_is_found_in_its_own_column_and_row_away_from_the_edge():
    image = np.full((480, 640), rigs.DARK_DN)
    image += star_image(300.2, 100.4, 1.0) + star_image(3.0, 200.0, 1.0)
    columns, rows = rigs.found_stars(image)
    assert (columns.tolist(), rows.tolist()) == ([300], [100])


def rig_field(turn_rad=(0.0, 0.0, 0.0)) -> tuple[rigs.RigField, np.ndarray]:
    """Stars of a grid, and their places (2, n), px, for a camera that is turned."""
    x, y = np.meshgrid(np.linspace(-0.08, 0.08, 5), np.linspace(-0.05, 0.05, 4))
    directions = np.column_stack([x.ravel(), y.ravel(), np.ones(20)])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    principal = np.array(rigs.PRINCIPAL_PX)[:, None]
    at_rest = rigs.FOCAL_PX * (directions[:, :2] / directions[:, 2:]).T + principal
    turned = directions @ to_matrix(from_rotation_vector(np.array(turn_rad))).T
    places = rigs.FOCAL_PX * (turned[:, :2] / turned[:, 2:]).T + principal
    return rigs.RigField(directions, at_rest, at_rest), places


def test_an_attitude_s_error_is_the_turn_of_its_stars():
    turn_arcsec = np.array([6.0, -9.0, 30.0])
    field, places_px = rig_field(turn_arcsec / ARCSEC_PER_RAD)
    about, x, y = rigs.attitude_error(field, *places_px)
    # its sign is the solver's; its size and axes are the turn's, to the second order
    sign = math.copysign(1, about) * math.copysign(1, turn_arcsec[2])
    assert sign * np.array([x, y, about]) == pytest.approx(turn_arcsec, abs=0.01)
    # a centroid of no star does not count
    stray = np.column_stack([places_px, [[20.0], [20.0]]])
    assert rigs.attitude_error(field, *stray) == pytest.approx([about, x, y], abs=1e-6)
    assert rigs.attitude_error(field, *places_px[:, :2]) is None


def test_attitudes_are_even_over_the_sky():
    declinations_deg = [to_radec_roll_deg(q)[1] for q in rigs.attitudes(600)]
    sines = np.sin(np.radians(declinations_deg))
    # of an even sine: mean 0, and square a third; 4 of its sigmas
    assert np.mean(sines) == pytest.approx(0, abs=4 * math.sqrt(1 / 3 / 600))
    assert np.mean(sines**2) == pytest.approx(1 / 3, abs=4 * math.sqrt(4 / 45 / 600))


def test_pixels_turn_an_attitude_by_their_error_over_the_root_of_the_stars(monkeypatch):
    monkeypatch.setattr(rigs, "TRIALS", 300)
    pixel_arcsec, stars = 30.0, 25
    about, across = rigs.pixel_attitudes_arcsec(stars, (10.0, 10.0), pixel_arcsec)
    one_arcsec = pixel_arcsec / math.sqrt(12)
    # about the boresight by the stars' distances: a side of 2 a has a mean square of 2 a^2 / 3
    lever = math.sqrt(2 / 3) * math.tan(math.radians(5))
    assert across == pytest.approx(one_arcsec / math.sqrt(stars), rel=0.1)
    assert about == pytest.approx(one_arcsec / math.sqrt(stars) / lever, rel=0.1)


def test_light_adds_up_over_frames_and_within_one():
    panel = Panel(gamma_response(8), 100.0)
    shown = [np.array([[255]]), np.array([[0]]), np.array([[255]])]
    to_frame = codes.light_to_frames(lambda k: Levels(shown[k]), panel, (1, 1), 3)
    assert to_frame[:, 0, 0] == pytest.approx([0.0, 100.0, 100.0, 200.0])
    assert codes.light_until(to_frame, 0.25)[0, 0] == pytest.approx(25.0)
    assert codes.light_until(to_frame, 2.75)[0, 0] == pytest.approx(175.0)
    assert codes.light_until(to_frame, 1.0)[0, 0] == pytest.approx(100.0)


def test_jitter_is_the_amplitudes_that_are_stated():
    still = predictors.shaken(predictors.ORION, 0.0)
    off_rad = []
    for t_s in np.linspace(0, 1, 400):
        q = predictors.shaken(predictors.ORION, float(t_s))
        off_rad.append(angle_between_rad(predictors.ORION, q))
    # three sines on each of three axes, half of each one's square on average
    squares_arcsec2 = 3 * sum(size**2 / 2 for size, _ in predictors.JITTER)
    rms_arcsec = math.sqrt(np.mean(np.square(off_rad))) * ARCSEC_PER_RAD
    assert rms_arcsec == pytest.approx(math.sqrt(squares_arcsec2), rel=0.05)
    assert angle_between_rad(still, predictors.ORION) > 0


def test_jitter_is_another_wave_on_each_axis_and_in_the_rate():
    """Sines of each frequency, 2 f rad further from axis to axis, small enough to add up."""
    for t_s in (0.0, 0.0123, 1.7):
        q = predictors.shaken(predictors.ORION, t_s)
        off = to_matrix(q) @ to_matrix(predictors.ORION).T
        turns_rad = np.array([off[1, 2] - off[2, 1], off[2, 0] - off[0, 2], off[0, 1] - off[1, 0]])
        waves_arcsec = np.zeros(3)
        for axis in range(3):
            for size_arcsec, hz in predictors.JITTER:
                wave = math.sin(math.tau * hz * t_s + 2 * axis * hz)
                waves_arcsec[axis] += size_arcsec * wave
        sign = np.sign(turns_rad @ waves_arcsec)
        np.testing.assert_allclose(
            sign * turns_rad / 2 * ARCSEC_PER_RAD,
            waves_arcsec,
            atol=1e-3 * np.abs(waves_arcsec).max(),
        )
    shaken = predictors.Movement(predictors.ORION, 0.5)
    rates = np.array([shaken.rate_rad_s(ns) for ns in (10**9, 10**9 + 3_000_000)])
    steady = math.radians(0.5) * predictors.AXIS
    # of 2 pi f size and more, in arcsec a second
    jitter_arcsec_s = np.abs(rates - steady).max() * ARCSEC_PER_RAD
    fastest = sum(math.tau * hz * size for size, hz in predictors.JITTER)
    assert 0.05 * fastest < jitter_arcsec_s < 1.01 * fastest


def test_a_movement_s_samples_end_with_the_newest_at_its_rate():
    movement = predictors.Movement(predictors.ORION, 0.5, packet_hz=50, shaken=False)
    samples = movement.samples(1_234_000_000)
    assert [sample.t_ns for sample in samples] == [1_160_000_000 + 20_000_000 * k for k in range(4)]
    turn_rad = angle_between_rad(samples[0].q_icrs_to_cam, samples[-1].q_icrs_to_cam)
    assert turn_rad == pytest.approx(math.radians(0.5) * 0.06, rel=1e-6)
    rate_rad_s = predictors.rate_of(movement.at, 10**9)
    assert rate_rad_s == pytest.approx(math.radians(0.5) * predictors.AXIS, rel=1e-6)
    rest = predictors.Movement(predictors.ORION, 0.0)
    assert rest.at(10**9) is rest.q_icrs_to_cam


def spinning_up(t_ns: int) -> AttitudeSample:
    """A camera whose turn about x speeds up by 0.02 rad/s^2."""
    t_s = t_ns / NS_PER_S
    q = propagate(predictors.ORION, np.array([0.01 * t_s**2, 0.0, 0.0]), 1.0)
    return AttitudeSample(t_ns, q, np.array([0.02 * t_s, 0.0, 0.0]))


@pytest.mark.parametrize("load", [predictors._accelerated, predictors._spline])
def test_a_constant_acceleration_is_predicted_whole(load):
    step_ns = 50_000_000
    samples = [spinning_up(k * step_ns) for k in range(NEAR)]
    ahead_ns = samples[-1].t_ns + 3 * step_ns
    predicted = load(samples)(ahead_ns)
    assert angle_between_rad(predicted, spinning_up(ahead_ns).q_icrs_to_cam) < 1e-7


def lone(x_px, y_px, light, star=None, margin_px=5.0, max_share=0.01, size_px=(100, 60)):
    """The lone stars of sprites, each with its window."""
    star = np.arange(len(x_px)) if star is None else np.array(star)
    isolation = study_benches.Isolation(margin_px, max_share)
    places = np.array(x_px, dtype=float), np.array(y_px, dtype=float)
    sprites = pack_sprites(*places, np.array(light), star, size_px, 9)
    return list(study_benches.lone_windows(sprites, *places, size_px, isolation))


def test_a_star_is_alone_where_others_add_less_than_a_share_of_its_light():
    (only,) = lone([50], [30], [10.0])
    assert only == (0, (slice(25, 36), slice(45, 56)))
    # a bright star, one of a hundredth of it within twice the margin, and one beyond
    found = lone([50, 59, 75], [30, 30, 30], [1000.0, 10.0, 500.0])
    assert [star for star, _ in found] == [0, 2]
    assert [star for star, _ in lone([50, 59], [30, 30], [1000.0, 10.1])] == []
    # two sprites of one star are no others to each other
    (moved,) = lone([50, 56], [30, 32], [5.0, 5.0], star=[3, 3])
    assert moved == (3, (slice(25, 38), slice(45, 62)))


@pytest.mark.parametrize(
    ("x_px", "y_px", "is_whole"),
    [(5, 5, True), (94, 54, True), (4.9, 30, False), (94.1, 30, False), (50, 54.1, False)],
)
def test_a_lone_star_s_window_is_whole_on_the_image(x_px, y_px, is_whole):
    assert bool(lone([x_px], [y_px], [1.0])) is is_whole


def test_windows_are_in_the_middle_of_equal_squares():
    image = np.arange(200.0).reshape(10, 20)
    windows = [(slice(2, 5), slice(3, 8)), (slice(0, 1), slice(0, 1))]
    stamps = study_benches.squares(image, windows)
    assert stamps.shape == (2, 5, 5)
    np.testing.assert_array_equal(stamps[0, 1:4], image[2:5, 3:8])
    assert stamps[1, 2, 2] == image[0, 0]
    assert stamps.sum() == pytest.approx(image[2:5, 3:8].sum() + image[0, 0])


def test_a_star_s_error_is_its_light_in_magnitudes_and_its_way_in_pixels():
    true = np.zeros((20, 30))
    true[8, 12] = 100.0
    shown = np.zeros((20, 30))
    shown[8, 12] = shown[8, 18] = shown[12, 12] = 10.0
    window = (slice(5, 15), slice(10, 20))
    assert study_benches.centroid_px(shown, window) == pytest.approx((14.0, 28 / 3))
    error = study_benches.star_error(shown, true, window)
    assert error.flux_mag == pytest.approx(-2.5 * math.log10(0.3))
    assert error.centroid_px == pytest.approx(math.hypot(2, 4 / 3))
    dark = study_benches.star_error(np.zeros((20, 30)), true, window)
    assert math.isnan(dark.centroid_px)


def test_stars_that_show_nothing_are_as_far_off_as_a_study_counts():
    places = np.array([30.0, 100.0]), np.array([30.0, 60.0])
    sprites = pack_sprites(*places, np.array([100.0, 50.0]), np.arange(2), (160, 120), 9)
    image = np.zeros((120, 160))
    image[30, 30] = 80.0
    errors_mag = faults.light_errors_mag(sprites, image, (160, 120))
    assert errors_mag == pytest.approx([-2.5 * math.log10(0.8), faults.NOTHING_MAG])


def test_a_method_is_beaten_by_one_that_is_better_in_one_and_no_worse_in_the_other():
    errors, times_ms = (1.0, 1.0, 2.0, 0.5), (3.0, 3.0, 4.0, 9.0)
    beaten = beaten_by(errors, times_ms)
    assert np.argwhere(beaten).tolist() == [[2, 0], [2, 1]]


def test_equation_2_3_gives_the_check_values_of_its_quaternions():
    """q_icrs_to_cam of (283.021, 35.349, 30) deg, and of the origin."""
    for radec_roll_deg, q in (
        ((0.0, 0.0, 0.0), (0.5, 0.5, -0.5, 0.5)),
        ((283.021, 35.349, 30.0), (0.3257559, -0.0677680, -0.4540152, 0.8265354)),
    ):
        matrix = sky_figures.equation_2_3(*radec_roll_deg)
        np.testing.assert_allclose(matrix.T, to_matrix(np.array(q)), atol=1e-6)


def test_studies_have_the_tracker_of_the_demo_and_its_aperture():
    tracker = read_bench_file(ROOT / "configs" / "demo.toml").config.tracker
    for key, value in study_benches.TRACKER.items():
        assert getattr(tracker, key) == value
    area_m2 = math.pi / 4 * (1e-3 * tracker.aperture_mm) ** 2
    assert study_benches.study_optics("ccd47-20").area_m2 == pytest.approx(area_m2)
    width_px, height_px = study_benches.FULL_HD["resolution_px"]
    assert (width_px, height_px, study_benches.FULL_HD["pixel_pitch_um"]) == (1920, 1080, 57.65)


def test_orion_s_frames_show_one_sky_about_the_boresight_of_each(small_run):
    """At 84.057 and -1.2 degrees: x and z of the sky, and the middle of the camera; north is up in
    both, and east left.
    """
    run = small_run(sky_figures.frames)
    ra_rad, dec_rad = np.radians([84.057, -1.2])
    (stars, boresight), (seen, middle) = (
        [(x, y) for _, x, y in run.lines("frames", panel)] for panel in range(2)
    )
    assert boresight == (
        pytest.approx([math.cos(dec_rad) * math.cos(ra_rad)]),
        pytest.approx([math.sin(dec_rad)]),
    )
    assert middle == ([0.0], [0.0])
    rows = run.rows("frames")
    for line, x, y in ((stars, "x_icrs", "z_icrs"), (seen, "x_cam", "y_cam")):
        assert line == tuple([float(row[name]) for row in rows] for name in (x, y))
    # within 12.5 degrees of the boresight along each axis
    assert 0.9 < np.abs(seen).max() / math.sin(math.radians(12.5)) < 1.0
    assert np.corrcoef(stars[1], seen[1])[0, 1] < -0.99
    sky, image = run.charts["frames"].axes
    assert image.yaxis_inverted() and not sky.yaxis_inverted()
    assert len(rows) > 300 and f"{len(rows)} stars of Orion" in run.told.text


def test_light_is_photons_of_its_wavelength():
    photons = sky_figures._photons_of(np.ones_like(sky_figures.SHOWN_NM))
    at_nm = float(sky_figures.SHOWN_NM[40])
    # of 1 W/m2/m: 1e-9 W/m2 to a nanometre, h c / lambda each
    assert photons[40] == pytest.approx(1e-9 / (h * c / (at_nm * 1e-9)), rel=1e-6)


@pytest.mark.parametrize("radius", [50.0, -80.0])
@pytest.mark.parametrize("ratio", [1 / 1.5168, 1.5168])
def test_a_ray_meets_the_near_side_of_a_sphere_and_bends_by_snell(radius, ratio, rng):
    at = np.column_stack([rng.uniform(-6, 6, (20, 2)), np.full(20, -30.0)])
    ray = np.column_stack([rng.uniform(-0.1, 0.1, (20, 2)), np.ones(20)])
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    hit, behind = geometry._refracted(at, ray, radius, ratio)
    centre = np.array([0, 0, radius])
    np.testing.assert_allclose(np.linalg.norm(hit - centre, axis=1), abs(radius))
    # about the vertex: a sphere's sag of 15 mm is under 2.5 mm
    assert np.abs(hit[:, 2]).max() < 2.5
    np.testing.assert_allclose(np.cross(hit - at, ray), 0, atol=1e-9)
    normal = (hit - centre) / radius
    np.testing.assert_allclose(np.linalg.norm(behind, axis=1), 1.0)
    np.testing.assert_allclose(
        np.cross(behind, normal), ratio * np.cross(ray, normal), atol=ROUNDING
    )
    assert (behind[:, 2] > 0).all()


def test_a_limb_is_where_light_has_fallen_to_half_of_the_inside():
    steps = np.linspace(-3.0, 3.0, 241)
    edge_px = np.array([-1.234, 0.0, 0.4567])
    sigma_px = 0.6
    profile = 8 * ndtr((edge_px[:, None] - steps) / sigma_px)
    profile = np.vstack([profile, np.full(241, 8.0)])
    places = bodies.half_level_px(profile, steps)
    # half of what 3 px inside has; linear between steps of 0.025 px
    half = ndtr((edge_px + 3) / sigma_px) / 2
    np.testing.assert_allclose(places[:3], edge_px - sigma_px * ndtri(half), atol=1e-4)
    assert math.isnan(places[3])
    edges = bodies.edges_in_sigmas(3, np.array([1.0, 2.5]), 0.5)
    np.testing.assert_allclose(edges, [[-3, -1, 1, 3], [-6, -4, -2, 0]])


def test_stripes_are_told_apart_by_whole_refreshes():
    points = []
    for refreshes, light in ((2.0, 1.01), (2.0, 0.97), (2.5, 1.2), (2.5, 0.9)):
        points.append(timing.StripePoint(refreshes, 1.0, 0, light, 1.0))
    assert stripe_depth(points, True) == pytest.approx(0.03)
    assert stripe_depth(points, False) == pytest.approx(0.2)


def test_a_vibration_s_prediction_is_off_by_what_its_rate_leaves(monkeypatch):
    """Of A sin(w t), 20 to 30 ms after a sample with its rate: A |exp(i w s) - 1 - i w s| / 2^0.5."""
    monkeypatch.setattr(limits, "SPAN_S", 1.0)
    limit = limits.vibrations(quick=True)
    slow = limit.at < 4.0
    assert slow.sum() >= 2
    for hz, error_arcsec in zip(limit.at[slow], limit.error[slow], strict=True):
        after_s = np.linspace(0.020, 0.030, 50)
        phase = 2 * math.pi * hz * after_s
        left = np.abs(np.exp(1j * phase) - 1 - 1j * phase)
        wanted_arcsec = limits.VIBRATION_ARCSEC * math.sqrt(np.mean(left**2) / 2)
        # over some cycles, not whole ones
        assert 0.5 < error_arcsec / wanted_arcsec < 2


def test_the_bolometric_zero_point_makes_stars_a_third_of_a_magnitude_fainter():
    """A body of 9602 K has V = 0.307 by it, by SciPy's quadrature (claims.toml, zero-point)."""
    costs_mag = models.choice_costs_mag(
        np.array([0.0, 0.6]), study_benches.study_optics("ccd47-20")
    )
    assert costs_mag["zero point iau-bolometric"] == pytest.approx(np.full(2, 0.307), abs=1e-3)


def test_a_distance_is_of_both_coordinates():
    places_px = np.array([[3.0, 0.0], [4.0, 5.0]])
    assert colour.distance_rms_px(places_px) == pytest.approx(5.0)


def test_a_psf_s_fit_is_about_its_own_background():
    for share in (1.0, 0.01):
        image = share * star_image(100.3, 49.8, rigs.PSF_SIGMA_PX) + rigs.DARK_DN
        x_px, y_px = rigs.psf_fit(image, np.array([100]), np.array([50]))
        assert (x_px[0], y_px[0]) == pytest.approx((100.3, 49.8), abs=1e-3)


@pytest.fixture(scope="module")
def wide_bench(tmp_path_factory):
    """Stars to V = 6.5 on a wide panel, of which some are over white."""
    tables = {
        "tracker": {"resolution_px": (1024, 1024)},
        "sky": {"faintest_v_mag": 6.5},
        "monitor": {"resolution_px": (800, 500), "pixel_pitch_um": 150.0, "bits": 8},
        "collimator": {"focal_length_mm": 350},
        "render": {"quantisation": "exact", "brightest_v_mag": 3.0},
    }
    path = tmp_path_factory.mktemp("wide") / "bench.toml"
    with study_benches.study_bench(path, tables) as bench:
        yield bench


def test_lone_stars_are_those_of_a_frame_that_do_not_clip(wide_bench):
    """Each found by hand: whole on the panel with 7 px around it, no other within twice that, and
    no brighter than twice white in one pixel; its light in the codes against its own.
    """
    bench = wide_bench
    turn = CameraTurn(np.array(ORION_Q), np.zeros(3))
    levels = bench.draw(turn.q_icrs_to_cam).levels
    errors = study_benches.lone_errors(bench, turn, levels)
    sprites = study_benches.turning_sprites(bench, turn)
    rates = sprites.data["electrons_per_s"]
    shown = shown_light(levels, bench.panel)
    wanted_mag = []
    clipping = 0
    for x, y, rate in zip(sprites.x_px, sprites.y_px, rates, strict=True):
        if min(x, y, 799 - x, 499 - y) < 7:
            continue
        near = np.maximum(np.abs(sprites.x_px - x), np.abs(sprites.y_px - y)) < 14
        if rates[near].sum() - rate > 2e-4 * rate:
            continue
        if rate > 2 * bench.flux_at_white_e_per_s:
            clipping += 1
            continue
        part = shown[int(y - 7) : int(y + 7) + 1, int(x - 7) : int(x + 7) + 1]
        wanted_mag.append(-2.5 * math.log10(part.sum() / rate))
    assert len(wanted_mag) > 20 and clipping > 0
    found_mag = sorted(star.flux_mag for star in errors.stars)
    # a millionth of a star is beyond its sprite
    assert found_mag == pytest.approx(sorted(wanted_mag), abs=1e-5)
    for off_px in errors.off_px.values():
        assert off_px.shape == (2, len(wanted_mag))
        assert np.hypot(*off_px).max() < 0.2
    # shown somewhere else, all are off by that
    moved = levels.copy()
    moved[:, 1:] = levels[:, :-1]
    off_px = study_benches.lone_errors(bench, turn, moved).off_px["fit"]
    assert np.median(off_px[0]) == pytest.approx(1.0, abs=0.05)
    assert np.median(np.abs(off_px[1])) < 0.05


def test_a_field_s_stars_are_off_by_their_way_to_their_pixels(wide_bench):
    turn = CameraTurn(np.array(ORION_Q), np.zeros(3))
    off_px = rigs.pixel_errors(wide_bench, turn)
    sprites = study_benches.turning_sprites(wide_bench, turn)
    inside = (sprites.x_px > -0.5) & (sprites.x_px < 799.5)
    inside &= (sprites.y_px > -0.5) & (sprites.y_px < 499.5)
    assert off_px.shape == (2, inside.sum()) and (~inside).sum() > 0
    assert np.abs(off_px).max() <= 0.5
    places = np.stack([sprites.x_px, sprites.y_px])[:, inside]
    np.testing.assert_allclose((places + off_px) % 1 % 1, 0, atol=1e-9)


def test_a_work_s_time_is_milliseconds_of_the_wall_and_of_the_processor(monkeypatch):
    clocks = {"wall_s": 10.0, "cpu_s": 3.0}

    def work():
        clocks["wall_s"] += 0.25
        clocks["cpu_s"] += 0.125

    monkeypatch.setattr("time.perf_counter", lambda: clocks["wall_s"])
    monkeypatch.setattr("time.process_time", lambda: clocks["cpu_s"])
    assert spent(work) == Spent(250.0, 125.0)


@pytest.mark.parametrize(
    ("table", "column", "wanted"),
    [
        ("timing", "rate_deg_s", timing.RATES_DEG_S),
        ("timing", "way", tuple(timing.WAYS)),
        ("stripes", "lit_ms", tuple({case.lit_ms for case in timing.STRIPE_CASES})),
        ("stripes", "refreshes", tuple({case.refreshes for case in timing.STRIPE_CASES})),
        ("economy", "bits", economy.BITS),
        ("economy", "scene", tuple(scene.name for scene in economy.SCENES)),
        ("economy", "tolerance_mag", tuple({limit.mag for limit in economy.TOLERANCES})),
        ("over_frames", "frames", codes.FRAMES),
        ("over_frames", "panel", tuple(panel.name for panel in codes.frames_panels())),
        ("colour_gamut", "panel", tuple(colour.PANELS)),
        ("colour_mosaic", "sigma_px", colour.SIGMAS_PX),
        ("colour_mosaic", "temperature_k", colour.STARS_K),
        ("colour", "tracker", tuple(colour.TRACKERS)),
        ("rigs", "rig", (rigs.LASSI, rigs.NAPLES, rigs.P13)),
    ],
)
def test_a_page_s_table_has_every_case_of_its_study(table, column, wanted):
    """What a whole study varies, which the small runs of these tests do not."""
    recorded = {row[column] for row in csv_rows(ROOT / "results" / f"{table}.csv")}
    if isinstance(wanted[0], str):
        assert recorded == set(wanted)
    else:
        assert sorted(map(float, recorded)) == pytest.approx(sorted(wanted))
