"""What a simulator of the tracker makes anew where its bench changes, the glow between its stars,
and how fast it turns at the ends of a log.
"""

from __future__ import annotations

import numpy as np
import pytest

from hilstar.attitude.clock.timeline import Policy
from hilstar.attitude.logs.log_file import log_timeline
from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.basics.rotation import (
    from_radec_roll_deg,
    from_rotation_vector,
    to_matrix,
)
from hilstar.basics.units import NS_PER_S
from hilstar.instruments.simulate.exposures import log_views, view_at
from hilstar.instruments.simulate.simulator import Simulator, TrackerBackground, full_e, gathered
from hilstar.optics.layers.view import View
from hilstar.server.bench.cameras import tracker_camera
from hilstar.server.bench.config.bench_config import sky_jd
from hilstar.server.bench.star_rates import bench_optics
from hilstar.sky.zodiacal import ZodiacalLight, sunward, tabled_light
from hilstar.tracker.settings import DetectorSettings
from tests.support.bench_files import filed_bench

# light is linear between 17 places along a side of 11 degrees
BETWEEN_PLACES = 1e-3


def bench(folder, *changes):
    """A bench of few stars before a small tracker."""
    small = {"tracker": {"resolution_px": [64, 48]}, "sky": {"faintest_v_mag": 3.0}}
    return filed_bench(folder, small, *changes)


@pytest.mark.parametrize(
    ("tables", "made"),
    [
        ({"verify": {"flux_mag": 0.2}}, []),
        ({"sky": {"faintest_v_mag": 5.0}}, ["sky", "tracker"]),
        ({"tracker": {"transmission": 0.5}}, ["sky", "tracker"]),
        ({"tracker.detector": {"fill_factor": 0.5}}, ["sky", "tracker"]),
        ({"tracker": {"exposure_s": 0.3}}, ["tracker"]),
        ({"background": {"electrons_per_px": 3.0}}, ["tracker"]),
    ],
)
def test_what_a_change_of_the_bench_touches_is_made_anew(tmp_path, tables, made):
    before, after = (bench(tmp_path, changes) for changes in ({}, tables))
    with Simulator(before) as simulator:
        stars, canvas, renderer = simulator.stars, simulator.canvas, simulator.renderer
        simulator.change(after)
        anew = {"sky": simulator.stars is not stars, "tracker": simulator.canvas is not canvas}
        assert [name for name, is_new in anew.items() if is_new] == made
        assert simulator.config is after.config
        # what is drawn into is opened anew for another PSF alone
        assert simulator.renderer is renderer
        simulator.change(bench(tmp_path, {"tracker": {"psf_sigma_px": [1.5, 1.5]}}))
        assert simulator.renderer is not renderer


def test_a_sky_that_moves_is_made_anew_with_every_change(tmp_path):
    bodies = {"sky": {"epoch_utc": "2026-11-21T00:00:00Z"}, "sky.bodies": {"planets": True}}
    with Simulator(bench(tmp_path, bodies)) as simulator:
        stars = simulator.stars
        simulator.change(bench(tmp_path, bodies, {"verify": {"flux_mag": 0.2}}))
        assert simulator.stars is not stars


def test_a_detector_without_a_mosaic_gathers_the_glow_of_all_channels():
    glow = np.array([[1.0, 1.5], [2.0, 2.5], [4.0, 4.5]])
    assert gathered(glow, None).tolist() == [[7.0, 8.5]]
    assert gathered(glow, "rggb") is glow


def test_a_pixel_of_a_wide_field_has_its_own_solid_angle_across_and_down(tmp_path):
    """The cube of the cosine of a pixel's angle from the axis, on 300 x 200 px."""
    tracker = {"resolution_px": [300, 200], "focal_length_mm": 5.0, "pixel_pitch_um": 13.0}
    file = filed_bench(
        tmp_path, {"tracker": tracker}, {"background": {"zodiacal_v_mag_arcsec2": 20.0}}
    )
    light_e = TrackerBackground(
        file.config, tmp_path, tracker_camera(file.config.tracker, tmp_path)
    ).steady_e
    for row, column in ((0, 150), (100, 0), (100, 299), (199, 299)):
        tangent = np.hypot(column - 149.5, row - 99.5) * 13e-3 / 5.0
        share = light_e[row, column] / light_e[100, 150]
        # light is linear between places 0.05 rad apart
        assert share == pytest.approx((1 + tangent**2) ** -1.5, rel=2e-3)


def test_zodiacal_light_is_that_of_each_pixel_s_own_direction(tmp_path):
    """On 300 x 200 px of a pinhole 60 degrees from the Sun: the light of the direction of a pixel,
    over its solid angle.
    """
    tracker = {"resolution_px": [300, 200], "focal_length_mm": 20.0, "pixel_pitch_um": 13.0}
    changes = {
        "sky": {"epoch_utc": "2026-03-20T12:00:00Z"},
        "background": {"zodiacal": "leinert1998"},
    }
    file = filed_bench(tmp_path, {"tracker": tracker}, changes)
    config = file.config
    background = TrackerBackground(config, tmp_path, tracker_camera(config.tracker, tmp_path))
    # the Sun stands at the vernal equinox
    q_icrs_to_cam = from_radec_roll_deg(60.0, 20.0, 30.0)
    light_e = background.of_view_e(View(q_icrs_to_cam, t_ns=0))
    light = ZodiacalLight.through(bench_optics(config.tracker, tmp_path))
    for row, column in ((0, 0), (0, 299), (100, 150), (199, 0), (199, 299)):
        tangents = np.array([column - 149.5, row - 99.5]) * 13e-3 / 20.0
        ray = np.append(tangents, 1.0) / np.hypot(1.0, np.hypot(*tangents))
        angles = sunward(ray[None] @ to_matrix(q_icrs_to_cam), sky_jd(config, 0))
        rate = float(light.electrons_per_s_sr(angles, tabled_light(angles))[0])
        pixel_sr = (13e-3 / 20.0) ** 2 * ray[2] ** 3
        wanted_e = rate * pixel_sr * config.tracker.exposure_s
        added_e = light_e[row, column] - background.steady_e[row, column]
        assert added_e == pytest.approx(wanted_e, rel=BETWEEN_PLACES)


@pytest.mark.parametrize("t_ns", [0, 10**7, 5 * 10**8, 99 * 10**7, 10**9])
def test_a_log_s_exposures_turn_as_fast_at_its_ends(t_ns):
    """A second of 0.3 rad/s about the second axis, beyond which nothing turns."""

    turned = from_rotation_vector(np.array([0.0, 0.3, 0.0]))
    samples = [AttitudeSample(0, np.array([1.0, 0, 0, 0])), AttitudeSample(10**9, turned)]
    timeline = log_timeline(samples, Policy(0, NS_PER_S))
    view = view_at(timeline, (0, 10**9), t_ns, 0.1)
    assert abs(view.rate_cam_rad_s[1]) == pytest.approx(0.3, rel=1e-6)
    assert view.rate_cam_rad_s[[0, 2]] == pytest.approx([0.0, 0.0], abs=1e-9)


@pytest.mark.parametrize(
    ("frame_count", "times_ns"),
    [(None, [0, 3 * 10**8, 10**9]), (5, [0, 25 * 10**7, 5 * 10**8, 75 * 10**7, 10**9]), (1, [0])],
)
def test_exposures_are_at_a_log_s_samples_or_evenly_from_the_first_to_the_last(
    frame_count, times_ns
):
    """A turn by 0.3 rad/s about the second axis."""
    samples = []
    for t_ns in (0, 3 * 10**8, 10**9):
        turned = from_rotation_vector(np.array([0.0, 0.3 * t_ns / NS_PER_S, 0.0]))
        samples.append(AttitudeSample(t_ns, turned))
    views = log_views(samples, frame_count, 0.1)
    assert [view.t_ns for view in views] == times_ns
    for view in views:
        turned = from_rotation_vector(np.array([0.0, 0.3 * view.t_ns / NS_PER_S, 0.0]))
        assert view.q_icrs_to_cam == pytest.approx(turned, abs=1e-9)
        assert abs(view.rate_cam_rad_s[1]) == pytest.approx(0.3, rel=1e-6)


def test_a_view_of_a_tracker_has_all_that_it_is_given_in_the_middle_of_its_exposure(tmp_path):
    q_icrs_to_cam = from_rotation_vector(np.array([0.1, 0.2, 0.3]))
    rate_rad_s, velocity_km_s, place_km = np.array([[0.4, 0.5, 0.6], [7.0, 8.0, 9.0], [1e3, 2, 3]])
    with Simulator(bench(tmp_path)) as simulator:
        view = simulator.view(q_icrs_to_cam, rate_rad_s, 12345, velocity_km_s, place_km)
        exposure_s = simulator.config.tracker.exposure_s
    assert view.q_icrs_to_cam.tolist() == q_icrs_to_cam.tolist()
    assert view.rate_cam_rad_s.tolist() == rate_rad_s.tolist()
    assert view.t_ns == 12345
    assert view.velocity_km_s.tolist() == velocity_km_s.tolist()
    assert view.place_km.tolist() == place_km.tolist()
    assert (view.scan.hold_s, view.exposed) == (exposure_s, True)


@pytest.mark.parametrize(("full_well_e", "full"), [(9_000.0, 8_000.0), (5_000.0, 5_000.0)])
def test_a_pixel_is_full_by_its_well_or_by_the_adc_above_its_offset(full_well_e, full):
    """Codes to 1023, of which 23 are the offset, of 8 electrons each."""
    detector = DetectorSettings(bits=10, offset_dn=23.0, gain_e_per_dn=8.0, full_well_e=full_well_e)
    assert full_e(detector) == full
