"""The motion of a case against its derivatives, and vibration against the width that it gives a
star.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from hilstar.basics.rotation import (
    angle_between_rad,
    from_radec_roll_deg,
    from_rotation_vector,
    multiply,
    rate_between_rad_s,
)
from hilstar.basics.units import ARCSEC_PER_RAD, NS_PER_S
from hilstar.instruments.campaign.acceptance_verdicts import ClauseVerdict
from hilstar.instruments.campaign.case_motion import PIECES_A_PERIOD, CaseMotion
from hilstar.instruments.simulate.exposures import faulty_exposure
from hilstar.instruments.simulate.simulator import Simulator
from hilstar.server.bench.bench_file import bench_file_of
from hilstar.server.bench.scenario import NO_SCENARIO
from tests.support.acceptance import accepted
from tests.support.benches import SMALL_BENCH

Q = from_radec_roll_deg(84.0, -1.2, 30.0)
RATE_RAD_S = np.radians([0.4, -0.3, 1.0])
ACCELERATION_RAD_S2 = np.radians([0.2, 0.1, -0.5])
JITTER_RAD = np.array([30.0, -40.0, 20.0]) / ARCSEC_PER_RAD
MOTION_S, JITTER_HZ = 1.5, 7.0
SHAKEN = CaseMotion(Q, RATE_RAD_S, ACCELERATION_RAD_S2, MOTION_S, JITTER_RAD, JITTER_HZ, 0.8)
STEP_S = 1e-4
# A central difference is off by the step squared over 6 times the next derivative but one: for the
# rate A w^3, 260e-6 rad times (44 rad/s)^3, times 2e-9.
RATE_ERROR = 1e-7
# and the swing turns the axes of the rate, by A w times the rate
ACCELERATION_ERROR = 2e-3


@pytest.mark.parametrize("seconds", [-0.05, 0.3, 1.2, 1.9])
def test_rate_and_acceleration_are_the_derivatives_of_the_attitude(seconds: float) -> None:
    before, after = (SHAKEN.at(seconds + step_s) for step_s in (-STEP_S, STEP_S))
    mean_rate_rad_s = rate_between_rad_s(before.q_icrs_to_cam, after.q_icrs_to_cam, 2 * STEP_S)
    np.testing.assert_allclose(SHAKEN.at(seconds).rate_cam_rad_s, mean_rate_rad_s, atol=RATE_ERROR)
    change_rad_s2 = (after.rate_cam_rad_s - before.rate_cam_rad_s) / (2 * STEP_S)
    np.testing.assert_allclose(
        SHAKEN.acceleration_at(seconds), change_rad_s2, atol=ACCELERATION_ERROR
    )


def test_a_slew_ends_and_the_sky_stands() -> None:
    motion = CaseMotion(Q, RATE_RAD_S, ACCELERATION_RAD_S2, MOTION_S)
    last = motion.at(MOTION_S)
    for seconds in (MOTION_S + 1e-6, 10.0):
        turn = motion.at(seconds)
        assert not turn.rate_cam_rad_s.any()
        assert not motion.acceleration_at(seconds).any()
        assert np.array_equal(turn.q_icrs_to_cam, last.q_icrs_to_cam)
    # a constant acceleration about a fixed axis turns by rate t + acceleration t^2 / 2
    about_z = CaseMotion(Q, np.array([0, 0, 0.1]), np.array([0, 0, 0.2]), MOTION_S)
    angle_rad = 0.1 * MOTION_S + 0.1 * MOTION_S**2
    turned = multiply(from_rotation_vector(np.array([0, 0, -angle_rad])), Q)
    assert angle_between_rad(about_z.at(5.0).q_icrs_to_cam, turned) < 1e-12


def test_pieces_fill_an_exposure_and_keep_to_the_swing() -> None:
    exposure_s, seconds = 0.4, 1.45
    pieces = SHAKEN.pieces(seconds, exposure_s, round(seconds * NS_PER_S))
    assert sum(piece.exposure_s for piece in pieces) == pytest.approx(exposure_s)
    chord = 1 - math.cos(math.pi / PIECES_A_PERIOD)
    largest_rad = chord * float(np.linalg.norm(JITTER_RAD))
    begin_s = seconds - exposure_s / 2
    for piece in pieces:
        middle_s = begin_s + piece.exposure_s / 2
        for share in (-0.5, -0.25, 0.0, 0.25, 0.5):
            at_s = share * piece.exposure_s
            drawn = CaseMotion(piece.q_icrs_to_cam, piece.turn.rate_cam_rad_s).at(at_s)
            true = SHAKEN.at(middle_s + at_s)
            off_rad = angle_between_rad(drawn.q_icrs_to_cam, true.q_icrs_to_cam)
            assert off_rad <= largest_rad
        begin_s += piece.exposure_s
    still = CaseMotion(Q, RATE_RAD_S, ACCELERATION_RAD_S2)
    (whole,) = still.pieces(seconds, exposure_s, 0)
    assert np.array_equal(whole.q_icrs_to_cam, still.at(seconds).q_icrs_to_cam)


@pytest.mark.parametrize("seconds", [MOTION_S - 0.1, MOTION_S + 0.1])
def test_a_motion_that_ends_within_an_exposure_parts_it_there(seconds: float) -> None:
    """Before its middle or after it; then the sky stands."""
    motion = CaseMotion(Q, RATE_RAD_S, ACCELERATION_RAD_S2, MOTION_S)
    exposure_s = 0.5
    moving, still = motion.pieces(seconds, exposure_s, 0)
    begin_s, end_s = seconds - exposure_s / 2, seconds + exposure_s / 2
    assert moving.exposure_s == pytest.approx(MOTION_S - begin_s)
    assert still.exposure_s == pytest.approx(end_s - MOTION_S)
    for piece, middle_s in ((moving, (begin_s + MOTION_S) / 2), (still, (MOTION_S + end_s) / 2)):
        assert piece.t_ns == pytest.approx((middle_s - seconds) * NS_PER_S, abs=1)
        assert piece.q_icrs_to_cam == pytest.approx(motion.at(middle_s).q_icrs_to_cam)
    assert np.linalg.norm(moving.turn.rate_cam_rad_s) > 0.01
    assert still.turn.rate_cam_rad_s == pytest.approx(np.zeros(3), abs=1e-12)


def test_what_was_before_a_case_s_begin_leads_to_it() -> None:
    before = CaseMotion(Q, RATE_RAD_S, ACCELERATION_RAD_S2).at(-2.0)
    motion = CaseMotion(before.q_icrs_to_cam, before.rate_cam_rad_s, ACCELERATION_RAD_S2)
    begun = motion.at(2.0)
    assert angle_between_rad(begun.q_icrs_to_cam, Q) < 1e-12
    assert begun.rate_cam_rad_s == pytest.approx(RATE_RAD_S)


def test_a_vibration_of_whole_swings_widens_a_star_by_half_its_square(tmp_path: Path) -> None:
    """A sine's mean square is half of its amplitude's; the exposure has two swings."""
    with Simulator(bench_file_of(tmp_path / "bench.toml", SMALL_BENCH)) as simulator:
        tracker = simulator.config.tracker
        focal_px = tracker.focal_length_mm * 1e3 / tracker.pixel_pitch_um
        amplitude_px = 1.5
        # about x: along y in the image, and of two swings
        jitter_rad = np.array([amplitude_px / focal_px, 0.0, 0.0])
        swings_hz = 2 / tracker.exposure_s
        still = CaseMotion(Q, np.zeros(3))
        shaken = CaseMotion(Q, np.zeros(3), jitter_rad=jitter_rad, jitter_hz=swings_hz)
        images = []
        for motion in (still, shaken):
            pieces = motion.pieces(0.0, tracker.exposure_s, 0)
            faults = faulty_exposure(simulator, pieces, NO_SCENARIO, 0)
            exposure = simulator.expose(motion.exposure(0.0, tracker.exposure_s, 0), None, faults)
            images.append(exposure.mean_e)
        truth = exposure.truth
        middle_px = (np.array(tracker.resolution_px) - 1) / 2
        near = np.hypot(truth["x_px"] - middle_px[0], truth["y_px"] - middle_px[1]) < 250
        brightest = truth[near][np.argmax(truth["electrons_per_s"][near])]
    widths = [_second_moments(image, brightest["x_px"], brightest["y_px"]) for image in images]
    (x_still, y_still), (x_shaken, y_shaken) = widths
    # chords between points on the sine have less of it: 1 - cos(pi / 16) of an amplitude at most
    mean_square_px2 = amplitude_px**2 / 2
    assert y_shaken - y_still == pytest.approx(mean_square_px2, rel=0.04)
    assert abs(x_shaken - x_still) < 0.02 * mean_square_px2


def _second_moments(image_e: np.ndarray, x_px: float, y_px: float) -> tuple[float, float]:
    """The variances along x and y, px2, of the light within 8 px of a star, over the rim's."""
    left, top = round(float(x_px)) - 8, round(float(y_px)) - 8
    stamp = image_e[top : top + 17, left : left + 17]
    stamp = stamp - np.median(np.concatenate([stamp[0], stamp[-1]]))
    steps = np.arange(17)
    variances = []
    for axis in (0, 1):
        light = stamp.sum(axis=axis)
        mean = (light * steps).sum() / light.sum()
        variances.append(float((light * (steps - mean) ** 2).sum() / light.sum()))
    return variances[0], variances[1]


AFTER_SLEW = """
[cases.after-slew]
cases = 8
frames = 20
step_s = 0.1
[[cases.after-slew.vary]]
key = "rate_deg_s.across"
minimum = 50.0
maximum = 100.0
[[cases.after-slew.vary]]
key = "motion_s"
values = [0.72]
[[clause]]
capability = "Recovery after a slew"
of = "after-slew"
quantity = "recovery"
share = 0.5
maximum = 1.0
"""


@pytest.mark.parametrize(("planted_s", "recovery_s"), [(0.0, 0.13), (0.5, 0.63)])
def test_recovery_counts_from_the_end_of_a_slew(
    tmp_path: Path, planted_s: float, recovery_s: float
) -> None:
    """Exposures are centred on tenths of a second, and end half of 0.1 s later."""
    planted = f"[planted]\nrecovery_s = {planted_s}\n"
    verdict: ClauseVerdict = accepted(tmp_path, planted + AFTER_SLEW)["recovery"]
    assert verdict.verdict is not None
    assert verdict.verdict.value == pytest.approx(recovery_s)
    assert verdict.word == "met"
