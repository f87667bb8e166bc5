"""The light of a virtual bench's exposures, and its levels where another monitor is the true one."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import ndtr

from hilstar.basics.rotation import from_radec_roll_deg
from hilstar.display.geometry import monitor_camera
from hilstar.display.quantise import shown_light
from hilstar.display.response import Levels, Response
from hilstar.instruments.calibrate.effective_psf import _rms
from hilstar.instruments.compare.sky_comparison import common_motion
from hilstar.instruments.simulate import twin
from hilstar.instruments.simulate.star_finder import CROWDED_SHARE, crowded
from hilstar.optics.psf import GaussianPsf
from hilstar.server.bench.bench_file import read_bench_file
from hilstar.server.bench.build import open_bench
from tests.support.benches import bench_text
from tests.support.spectra import bump, write_channels, write_panel

UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])
ORION_Q = from_radec_roll_deg(84.0, -1.2, 0.0)


@pytest.mark.parametrize("count", [5, 21, 34, 233])
def test_exposures_of_a_free_tracker_fill_a_refresh_period_evenly(count):
    """As multiples of the golden section do, of a number of Fibonacci's: in gaps of two lengths,
    1.17 and 0.72 of the mean one.
    """
    phases = np.sort([twin.free_phase(number) for number in range(7, 7 + count)])
    gaps = np.diff(phases, append=phases[0] + 1)
    assert 0.7 / count < gaps.min() < gaps.max() < 1.2 / count


@pytest.mark.parametrize("exposure_s", [0.1, 0.0999, 0.1001])
def test_an_exposure_is_the_mean_of_its_own_frames(tmp_path, exposure_s):
    """Three frames of 1/30 s from frame 7 on, each with codes of its own, on two panels."""
    path = tmp_path / "bench.toml"
    path.write_text(
        bench_text(
            {"tracker": {"exposure_s": exposure_s}, "sky": {"faintest_v_mag": 5.0}},
            {"monitor": {"refresh_hz": 30.0, "bits": 5}, "render": {"quantisation": "temporal"}},
        )
    )
    with open_bench(read_bench_file(path)) as bench:
        frame = bench.frame(ORION_Q, 7)
        panels = [bench.panel, replace(bench.panel, flux_at_white_e_per_s=1e9)]
        exposed = twin.exposure_lights(bench, frame, 7, panels)
        of_three = bench.quantiser.exposure(7 % twin.PHASES, 3)
        drawn = []
        for number in range(of_three.stop):
            drawn.append(Levels(bench.draw(ORION_Q, 7 + number).levels.copy()))
    levels = [drawn[number] for number in of_three]
    assert len(levels) == 3 and any((levels[0] != each).any() for each in levels[1:])
    for (light,), panel in zip(exposed, panels, strict=True):
        image = np.zeros(levels[0].size)
        image[light.place] = light.e_per_s
        frames = [shown_light(each, panel).ravel() for each in levels]
        np.testing.assert_allclose(image, np.mean(frames, axis=0), rtol=1e-5)


def test_a_true_monitor_s_light_is_in_the_assumed_one_s_order():
    """The assumed one has red before green; what the true one lacks lies between its neighbours."""
    black, red, green, both = (0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0)
    assumed = Response(
        8,
        np.array([0.0, 0.2, 0.5, 1.0]),
        np.array([0.1, 0.35, 0.75]),
        0.03,
        np.array([black, red, green, both], dtype=np.uint16),
    )
    true = Response(
        8, np.array([0.0, 0.4, 1.0]), np.array([0.2, 0.7]), 0.01, np.array([black, red, both])
    )
    found = twin.levels_of(assumed, true)
    np.testing.assert_allclose(found.light, [0.0, 0.4, 0.7, 1.0])
    assert found.black == 0.01
    assert found.rgb is assumed.rgb
    assert twin.levels_of(Response(8, true.light, true.threshold), true) is true


@pytest.mark.parametrize(("times", "is_crowded"), [(0.95, False), (1.05, True)])
def test_a_window_is_about_the_pixel_of_its_star(times, is_crowded):
    """A star 0.4 px right of its pixel, whose window of seven pixels ends 3.1 px from it."""
    psf = GaussianPsf((0.5, 0.5))
    x_px, y_px = np.array([10.4, 15.0]), np.array([20.0, 20.0])
    share = float(ndtr((13.5 - 15.0) / 0.5))
    flux = np.array([1.0, times * CROWDED_SHARE / share])
    assert crowded(x_px, y_px, flux, 3, psf)[0] == is_crowded


@pytest.mark.parametrize(("move_px", "is_told"), [(0.09, False), (0.11, True), (-0.11, True)])
def test_a_common_move_is_told_beyond_what_a_star_may_be_off(rng, move_px, is_told):
    places = rng.uniform(-100, 100, (12, 2))
    moves = np.tile([move_px, 0.0], (12, 1))
    motion = common_motion(places, moves, np.full(12, 0.1))
    assert (motion is not None) == is_told


def test_a_tracker_pixel_has_as_many_monitor_pixels_along_a_side_as_their_angles_say(tmp_path):
    """Of 100 mm and 50 um, a monitor pixel is 0.5 mrad; of 50 mm and 100 um, a tracker's 2 mrad."""
    tables = {
        "tracker": {"resolution_px": [40, 30], "pixel_pitch_um": 100.0, "focal_length_mm": 50.0},
        "monitor": {"resolution_px": [64, 48], "pixel_pitch_um": 50.0},
        "collimator": {"focal_length_mm": 100.0},
    }
    path = tmp_path / "bench.toml"
    path.write_text(
        bench_text(tables, {"sky": {"faintest_v_mag": 3.0}, "render": {"quantisation": "round"}})
    )
    with twin.Twin(read_bench_file(path)) as made:
        assert made.monitor_px_per_px == pytest.approx(4.0)


@pytest.mark.parametrize("times", [0.99, 1.01])
def test_stars_are_near_a_disc_up_to_a_margin_beyond_its_limb(times):
    """Of a disc of 20 mrad, 30 mrad right of the axis, and one behind the camera, which is near
    nothing: stars in its middle, and to either side of it by its radius and 4 px of 2 mrad.
    """
    camera = monitor_camera((400, 300), 100.0, 50.0, UPRIGHT)
    off_rad = 0.03 + np.array([0.0, 1.0, -1.0]) * times * (0.02 + 4 * 0.002)
    x_px, y_px = camera.project(np.stack([np.sin(off_rad), 0 * off_rad, np.cos(off_rad)], axis=1))
    image = np.zeros((1, 1))
    ahead = np.array([math.sin(0.03), 0.0, math.cos(0.03)])
    discs = ((ahead, 0.02), (np.array([0.0, 0.0, -1.0]), 0.5))
    field = twin.TwinField(
        image, image, image, np.zeros(3, dtype=[("hip", "i4")]), x_px, y_px, image, discs
    )
    assert field.near_disc(camera, 4.0).tolist() == [True, times < 1, times < 1]


def test_an_rms_is_the_root_of_the_mean_of_squares():
    assert _rms(np.array([3.0, -4.0, 0.0, 0.0])) == 2.5


@pytest.mark.parametrize("true_e_per_s", [None, 8e4])
def test_a_true_white_is_that_of_all_primaries(tmp_path, true_e_per_s):
    nm = np.arange(400.0, 701.0, 10.0)
    write_panel(tmp_path / "panel.csv", [bump(middle, 30, nm) for middle in (620, 540, 460)], nm)
    tables = {
        "tracker": write_channels(tmp_path, nm, {name: np.full_like(nm, 0.5) for name in "rgb"}),
        "monitor.primaries": {"file": "panel.csv", "layout": "rgb-stripe"},
        "render": {"colour": "star", "quantisation": "round", "flux_at_white_e_per_s": 1e5},
        "verify": {"true_flux_at_white_e_per_s": true_e_per_s},
        "sky": {"faintest_v_mag": 3.0},
    }
    path = tmp_path / "bench.toml"
    path.write_text(bench_text(tables))
    with open_bench(read_bench_file(path)) as bench:
        panel = twin.true_panel(bench)
        assumed = [primary.flux_at_white_e_per_s for primary in bench.panel.primaries]
    white_e_per_s = true_e_per_s or 1e5
    assert panel.flux_at_white_e_per_s == white_e_per_s
    parts = [primary.flux_at_white_e_per_s for primary in panel.primaries]
    assert sum(parts) == pytest.approx(white_e_per_s)
    assert parts == pytest.approx([white_e_per_s / 1e5 * part for part in assumed])
