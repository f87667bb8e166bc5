"""What the virtual tracker of a campaign reports: its own rate, faults that a plan plants in time,
its stars, and the aberration that it leaves; each without a run.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hilstar.basics.rotation import (
    from_radec_roll_deg,
    propagate,
    to_matrix,
    to_radec_roll_deg,
)
from hilstar.basics.units import LIGHT_KM_S
from hilstar.instruments.campaign import acceptance
from hilstar.instruments.campaign.case_motion import CaseMotion
from hilstar.instruments.campaign.plan import PlantedFaults
from hilstar.instruments.campaign.planted import (
    CaseConditions,
    CaseTracker,
    aberration_rad,
    lit_stars,
)
from hilstar.instruments.campaign.solver_answer import SolverAnswer
from hilstar.instruments.simulate.simulator import Exposure
from hilstar.optics.layers.view import View
from hilstar.server.answers.answer import ReportedStar

START_Q = from_radec_roll_deg(84.0, -1.2, 30.0)
RATE_RAD_S = np.radians([0.4, -0.3, 1.0])
EXPOSURE_S = 0.2
TRUTH = [
    ("name", "U10"), ("x_px", "f8"), ("y_px", "f8"), ("v_mag", "f8"), ("bv", "f8"),
    ("electrons_per_s", "f8"), ("drawn", "?"),
]  # fmt: skip


def exposure(truth: Any = (), faults: Any = (), rate_rad_s: Any = RATE_RAD_S) -> Exposure:
    """An exposure of a detector of 300 by 200 px."""
    view = View.exposure(START_Q, np.array(rate_rad_s), EXPOSURE_S)
    dn = np.zeros((200, 300), dtype=np.uint16)
    return Exposure(view, dn, np.zeros(dn.shape), np.array(list(truth), dtype=TRUTH), 0, faults)


def tracker(with_rate: bool = False, conditions: Any = None, **planted: Any) -> CaseTracker:
    still = CaseConditions(np.zeros(3), CaseMotion(START_Q, RATE_RAD_S))
    faults = PlantedFaults(**planted) if planted else None
    return CaseTracker(faults, 7, conditions or still, with_rate)


def solved_at(seconds: float) -> SolverAnswer:
    return SolverAnswer(propagate(START_Q, RATE_RAD_S, seconds))


@pytest.mark.parametrize("step_s", [0.1, 2.0])
def test_a_tracker_without_a_gyroscope_has_the_rate_of_its_last_two_attitudes(step_s):
    this = tracker(with_rate=True)
    first = this.reported(solved_at(0.0), exposure(), 0.0)
    assert first.rate_cam_rad_s is None
    for number in (1, 2, 5):  # two answers of these do not come
        told = this.reported(solved_at(number * step_s), exposure(), number * step_s)
        assert told.rate_cam_rad_s == pytest.approx(RATE_RAD_S, abs=1e-9)
    own = SolverAnswer(START_Q, rate_cam_rad_s=np.ones(3))
    assert this.reported(own, exposure(), 9.0).rate_cam_rad_s.tolist() == [1.0, 1.0, 1.0]
    assert tracker().reported(solved_at(0.0), exposure(), 0.0).rate_cam_rad_s is None


def silences(times_s: list[float], conditions: Any = None, **planted: Any) -> list[str]:
    """Why a tracker is silent at these middles of exposures; "" where it is not."""
    this = tracker(conditions=conditions, **planted)
    return [this.reported(solved_at(at_s), exposure(), at_s).why for at_s in times_s]


def test_a_recovery_is_from_the_fault_s_end_on_and_an_acquisition_from_the_case_s_begin():
    """A fault that ends at 2 s, and half a second to recover; an attitude from 0.6 s after the
    first exposure's begin on, 0.1 s before whose middle that is.
    """
    ended = CaseConditions(np.zeros(3), CaseMotion(START_Q, RATE_RAD_S), fault_end_s=2.0)
    said = "planted: recovery_s"
    told = silences([0.0, 1.9, 2.0, 2.49, 2.5, 9.0], ended, recovery_s=0.5)
    assert told == ["", "", said, said, "", ""]
    assert silences([0.0, 2.0, 2.4], None, recovery_s=0.5) == ["", "", ""]
    first = "planted: acquisition_s"
    assert silences([0.0, 0.49, 0.5, 0.6], None, acquisition_s=0.6) == [first, first, "", ""]


def test_a_tracker_is_silent_beyond_each_of_its_limits():
    motion = CaseMotion(START_Q, RATE_RAD_S)
    for beyond, conditions in (
        (False, CaseConditions(np.zeros(3), motion, false_stars=40, body_deg=30.0)),
        (True, CaseConditions(np.zeros(3), motion, false_stars=41, body_deg=29.9)),
    ):
        (stars,) = silences([0.0], conditions, max_false_stars=40)
        assert (stars == "planted: max_false_stars") is beyond
        (body,) = silences([0.0], conditions, exclusion_deg=30.0)
        assert (body == "planted: exclusion_deg") is beyond
    rate_deg_s = float(np.degrees(np.linalg.norm(RATE_RAD_S)))
    for limit_deg_s, beyond in ((rate_deg_s + 1e-6, False), (rate_deg_s - 1e-6, True)):
        (rate,) = silences([0.0], None, max_rate_deg_s=limit_deg_s)
        assert (rate == "planted: max_rate_deg_s") is beyond


def test_a_planted_bias_is_about_the_tracker_s_own_axes():
    bias_arcsec = np.array([20.0, -10.0, 300.0])
    told = tracker(bias_arcsec=tuple(bias_arcsec)).reported(solved_at(0.0), exposure(), 0.0)
    error = Rotation.from_matrix(to_matrix(told.q_icrs_to_cam) @ to_matrix(START_Q).T)
    turn_arcsec = np.degrees(error.as_rotvec()) * 3600
    assert turn_arcsec == pytest.approx(bias_arcsec, abs=1e-6)


def test_a_lost_roll_is_any_and_leaves_the_boresight_where_it_is():
    """Of 60 answers the largest gap between two rolls is far below a quarter of a turn."""
    this = tracker(lost_roll=True)
    told = [this.reported(solved_at(0.0), exposure(), 0.0).q_icrs_to_cam for _ in range(60)]
    pointings = np.array([to_radec_roll_deg(q) for q in told])
    assert pointings[:, :2] == pytest.approx(np.tile([84.0, -1.2], (60, 1)))
    rolls_deg = np.sort(pointings[:, 2] % 360.0)
    assert np.diff([*rolls_deg, rolls_deg[0] + 360.0]).max() < 60.0


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_wrong_and_missing_answers_are_shares_of_frames(share):
    """Of 200 frames within four sigmas; a wrong attitude is anywhere, a missing one has no rate."""
    told = {}
    for name in ("wrong", "missing"):
        this = tracker(with_rate=True, **{name: share})
        told[name] = [this.reported(solved_at(at_s), exposure(), at_s) for at_s in range(200)]
    turned = [propagate(START_Q, RATE_RAD_S, at_s) for at_s in range(200)]
    wrong = [
        abs(answer.q_icrs_to_cam @ q) < 0.999
        for answer, q in zip(told["wrong"], turned, strict=True)
    ]
    missing = [answer for answer in told["missing"] if answer.q_icrs_to_cam is None]
    within = 4 * np.sqrt(200 * share * (1 - share))
    assert sum(wrong) == pytest.approx(200 * share, abs=within)
    assert len(missing) == pytest.approx(200 * share, abs=within)
    assert {(answer.why, answer.rate_cam_rad_s) for answer in missing} <= {
        ("planted: missing", None)
    }


@pytest.mark.parametrize(("motion_s", "lags"), [(2.0, True), (0.5, False)])
def test_planted_rates_are_scaled_biased_and_late(motion_s, lags):
    """A rate that lags by 0.5 s under 0.2 deg/s2 is 0.1 deg/s short of it, as long as it lasts."""
    acceleration = np.radians([0.2, 0.0, -0.4])
    motion = CaseMotion(START_Q, RATE_RAD_S, acceleration, motion_s)
    conditions = CaseConditions(np.zeros(3), motion)
    this = tracker(
        conditions=conditions, rate_lag_s=0.5, rate_scale=0.02, rate_bias_deg_s=(0.1, -0.2, 0.3)
    )
    answer = SolverAnswer(START_Q, rate_cam_rad_s=RATE_RAD_S)
    told = this.reported(answer, exposure(), 1.0).rate_cam_rad_s
    wanted = 1.02 * RATE_RAD_S + np.radians([0.1, -0.2, 0.3]) - 0.5 * lags * acceleration
    assert told == pytest.approx(wanted)


@pytest.mark.parametrize("seed", range(4))
def test_an_aberration_that_is_left_is_the_turn_of_the_field_s_stars(seed):
    """Stars' directions with v / c added to them, laid onto the true ones by Wahba's problem: of a
    field that is small and even about the boresight.
    """
    rng = np.random.default_rng(seed)
    q = Rotation.random(random_state=rng).as_quat(scalar_first=True)
    velocity_km_s = rng.uniform(-30, 30, 3)
    to_cam = to_matrix(q)
    angle = 2 * np.pi * np.arange(24) / 24
    field = np.column_stack([0.02 * np.cos(angle), 0.02 * np.sin(angle), np.ones(24)])
    true = field / np.linalg.norm(field, axis=1, keepdims=True)
    seen = true + to_cam @ velocity_km_s / LIGHT_KM_S
    turn, _ = Rotation.align_vectors(seen / np.linalg.norm(seen, axis=1, keepdims=True), true)
    wanted = turn.as_rotvec()
    # stars beside the middle move by their square less
    assert aberration_rad(q, velocity_km_s)[:2] == pytest.approx(wanted[:2], abs=1e-3 * 1e-4)
    assert abs(wanted[2]) < 1e-8


# name, place, V, B-V, light, drawn
STARS = (
    ("a", 10.0, 20.0, 3.0, 0.5, 900.0, True),
    ("hot star", 50.0, 60.0, 4.0, 0.5, 800.0, True),
    ("b", 299.4, 199.4, 5.0, 1.5, 700.0, True),
    ("c", 250.0, 60.0, 5.5, 1.5, 600.0, True),
    ("outside", 300.0, 100.0, 5.0, 0.5, 700.0, True),
    ("hidden", 90.0, 90.0, 5.0, 0.5, 700.0, False),
    ("dark", 120.0, 90.0, 5.0, 0.5, 0.0, True),
)


def test_lit_stars_are_those_of_the_sky_that_are_drawn_on_the_detector():
    lit = lit_stars(exposure(STARS, faults=("hot star",)))
    assert lit.v_mag.tolist() == [3.0, 5.0, 5.5]
    assert lit.electrons_per_s.tolist() == [900.0, 700.0, 600.0]
    assert lit_stars(exposure(STARS)).v_mag.tolist() == [3.0, 4.0, 5.0, 5.5]


def test_planted_stars_are_fainter_by_their_colour_and_moved_by_the_field():
    """Colour of 0.2 mag a mag, and waves of the root of two times 0.3 px over the detector."""
    reported = [
        ReportedStar(10.0, 20.0, 100.0, 7),
        ReportedStar(250.0, 60.0, 50.0, 8),
        ReportedStar(150.0, 100.0, 9.0),
    ]
    this = tracker(star_colour=0.2, star_fov_px=0.3)
    answer = SolverAnswer(START_Q, stars=tuple(reported))
    found = this.reported(answer, exposure(STARS), 0.0).stars
    assert found is not None
    assert [star.hip for star in found] == [7, 8, None]
    signals = [100 * 10 ** (-0.4 * 0.1), 50 * 10 ** (-0.4 * 0.3), 9.0]
    assert [star.dn for star in found] == pytest.approx(signals)
    for star, given in zip(found, reported, strict=True):
        wave_x = 0.3 * np.sqrt(2) * np.sin(2 * np.pi * given.x_px / 300)
        wave_y = 0.3 * np.sqrt(2) * np.sin(2 * np.pi * given.y_px / 200)
        assert (star.x_px - given.x_px, star.y_px - given.y_px) == pytest.approx((wave_x, wave_y))
    limited = tracker(star_limit_v_mag=4.9).reported(answer, exposure(STARS), 0.0).stars
    assert limited == (reported[0],)
    many = tracker(false_stars=40.0).reported(answer, exposure(STARS), 0.0).stars
    assert many is not None and many[:3] == tuple(reported)
    assert 20 < len(many) - 3 < 64  # three sigmas and more of Poisson's
    places = np.array([(star.x_px, star.y_px) for star in many[3:]])
    assert places[:, 0].max() > 200 and (places <= [299, 199]).all() and (places >= 0).all()


def test_a_case_s_time_is_that_of_the_first_two_after_one_that_warms_up(monkeypatch):
    """A session opens in 2 s, its first case takes 5 s and the others 1 and 3 s: 2 s a case, and
    5 s more for the first one with its session.
    """
    now_s = 100.0
    took_s = iter([5.0, 1.0, 3.0])

    class Slow:
        closed = False

        def __init__(self, job: str) -> None:
            self.pass_s(2.0)
            self.rows: list[int] = []
            assert job == "job"

        @staticmethod
        def pass_s(seconds: float) -> None:
            nonlocal now_s
            now_s += seconds

        def row(self, number: int, point: str) -> None:
            assert point == f"point {number}"
            self.pass_s(next(took_s))

        def close(self) -> None:
            type(self).closed = True

    monkeypatch.setattr(acceptance, "Session", Slow)
    monkeypatch.setattr(acceptance, "time", SimpleNamespace(perf_counter=lambda: now_s))
    design = SimpleNamespace(points=lambda begin, end: [f"point {k}" for k in range(begin, end)])
    campaign: Any = SimpleNamespace(cases=60, design=design, job="job")
    assert acceptance.first_cases_s(campaign) == (2.0, 5.0)
    assert Slow.closed
