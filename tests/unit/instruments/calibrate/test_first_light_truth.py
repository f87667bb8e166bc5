"""What a virtual session says of its truth: the drift and the geometry that were planted, and the
twin of both benches.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from hilstar.instruments.calibrate.first_light.stars import _against_truth, _known_glow, _twin_file
from hilstar.instruments.calibrate.first_light.uniformity import _warm_up_truth
from hilstar.instruments.verify.measure import GlowFit
from hilstar.server.bench.bench_file import read_bench_file
from hilstar.server.bench.config.certify import VirtualSettings
from tests.support.benches import bench_text
from tests.support.closed_camera import CLOSED, SCREEN_PX

ARCSEC_PER_RAD = 206264.806


def bench(folder, name, *changes):
    """A bench file of the closed camera's, in a folder of its own."""
    path = folder / name / "bench.toml"
    path.parent.mkdir(exist_ok=True)
    path.write_text(bench_text(CLOSED, *changes))
    return read_bench_file(path)


@pytest.mark.parametrize("change_percent", [-4.0, 3.0])
def test_a_planted_warm_up_drifts_by_its_slope_at_the_end_of_the_watch(change_percent):
    """White comes near by an exponential of 5 minutes, and drifts on by 0.3 %/h. The monitor was on
    for 200 s when the watch began, and the watch is over after 900 s of its own.
    """
    virtual = VirtualSettings(warm_up_min=5.0, cold_percent=change_percent, drift_percent_per_h=0.3)
    figures = _warm_up_truth(virtual, 0.002, 1100.0, 900.0)

    def white(t_s: float) -> float:
        return 1 - change_percent / 100 * math.exp(-t_s / 300) + 0.003 * t_s / 3600

    slope_per_h = (white(1101.0) - white(1099.0)) / 2 * 3600
    assert figures["truth_drift_percent_per_h"] == pytest.approx(100 * slope_per_h, rel=1e-5)
    stable_s = figures["truth_stable_after_s"] + 200
    ahead = (
        abs(change_percent) / 100 * (math.exp(-stable_s / 300) - math.exp(-(stable_s + 600) / 300))
    )
    assert ahead == pytest.approx(0.002, rel=1e-6)
    late = _warm_up_truth(virtual, 0.9, 1100.0, 900.0)
    assert late["truth_stable_after_s"] == 0.0


def test_a_truth_s_directions_are_off_by_the_angle_between_them(tmp_path):
    """The truth's screen is turned by 0.4 mrad about its x axis and by 4 mrad about the boresight:
    every direction by the cross product with both.
    """
    file = bench(tmp_path, "filed")
    truth = bench(tmp_path, "true", {"collimator": {"q_cam_to_mon": [1.0, 2e-4, 0.0, 2e-3]}})
    figures = _against_truth(file, truth)
    focal_px = 40e3 / 57.65
    x, y = np.meshgrid(np.linspace(0, SCREEN_PX[0] - 1, 21), np.linspace(0, SCREEN_PX[1] - 1, 21))
    right, down = (x - 50.0) / focal_px, (y - 55.0) / focal_px
    rays = np.stack([right, down, np.ones_like(right)], axis=-1)
    moved = np.cross([4e-4, 0.0, 4e-3], rays / np.linalg.norm(rays, axis=-1, keepdims=True))
    off_arcsec = np.linalg.norm(moved, axis=-1) * ARCSEC_PER_RAD
    assert off_arcsec.std() > 0.1 * off_arcsec.mean()
    assert figures["truth_rms_arcsec"] == pytest.approx(np.sqrt((off_arcsec**2).mean()), rel=1e-3)
    assert figures["truth_max_arcsec"] == pytest.approx(off_arcsec.max(), rel=1e-3)
    assert figures["truth_share_of_screen"] == 1.0


def test_the_twin_of_a_virtual_session_has_the_truth_s_light_and_the_file_s_limits(tmp_path):
    file = bench(tmp_path, "filed", {"verify": {"flux_mag": 0.07, "lost_share": 0.3}})
    true = {
        "render": {"flux_at_white_e_per_s": 70_000.0},
        "monitor": {"pixel_pitch_um": 58.0, "calibration": "gamma2.2"},
        "collimator": {"focal_length_mm": 41.0, "q_cam_to_mon": [1.0, 0.0, 1e-3, 0.0]},
        "verify": {"flux_mag": 0.5},
    }
    truth = bench(tmp_path, "true", true)
    verify = _twin_file(file, truth).config.verify
    assert verify.true_flux_at_white_e_per_s == pytest.approx(70_000.0)
    assert verify.true_calibration == "gamma2.2"
    assert (verify.true_focal_length_mm, verify.true_pixel_pitch_um) == (41.0, 58.0)
    assert verify.true_q_cam_to_mon == pytest.approx((1.0, 0.0, 1e-3, 0.0), abs=1e-6)
    assert verify.true_geometry is None
    assert (verify.flux_mag, verify.lost_share) == (0.07, 0.3)
    assert _twin_file(file, None) is file


@pytest.mark.parametrize(
    ("figures", "share"),
    [
        ({}, 0.0),
        # of a full scale known to 0.05 mag
        ({"scale.error_mag": 0.05}, 0.05 * math.log(10) / 2.5),
        # and of a black level known to a tenth beside it
        (
            {
                "scale.error_mag": 0.05,
                "photometry.black_level": 2e-3,
                "photometry.black_level_error": 2e-4,
            },
            math.hypot(0.05 * math.log(10) / 2.5, 0.1),
        ),
    ],
)
def test_a_glow_is_judged_no_closer_than_the_session_knows_it(figures, share):
    """To three sigmas of 100 e-/s, where the bench's own limit is 4."""
    known = _known_glow(GlowFit(100.0, 117.0, 4.0), figures)
    limit = max(4.0, 3 * share * 100.0)
    assert known == GlowFit(100.0, 117.0, pytest.approx(limit))
