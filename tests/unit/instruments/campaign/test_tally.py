"""What a case's row has of its exposures and answers: each figure counted by hand, of answers whose
stamps, faults and stars all differ.
"""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np
import pytest

from hilstar.basics.rotation import from_radec_roll_deg, from_rotation_vector, multiply, propagate
from hilstar.basics.units import ARCSEC_PER_RAD
from hilstar.instruments.campaign.solver_answer import CentroidErrors, SolverAnswer
from hilstar.instruments.campaign.tally import CaseTally
from hilstar.instruments.simulate.simulator import Exposure
from hilstar.optics.frame_motion import CameraTurn
from hilstar.optics.layers.truth import TRUTH_DTYPE
from hilstar.optics.layers.view import View

START_Q = from_radec_roll_deg(84.0, -1.2, 30.0)
RATE_RAD_S = np.radians([0.4, -0.3, 1.0])
EXPOSURE_S, STEP_S = 0.1, 0.5


def turn_at(seconds: float) -> CameraTurn:
    return CameraTurn(propagate(START_Q, RATE_RAD_S, seconds), RATE_RAD_S)


def exposure(number: int) -> Exposure:
    """An exposure of four by three pixels, with two stars more than its number."""
    view = View.exposure(START_Q, np.zeros(3), EXPOSURE_S)
    dn = np.full((3, 4), number, dtype=np.uint16)
    return Exposure(view, dn, np.zeros((3, 4)), np.zeros(2 + number, dtype=TRUTH_DTYPE))


def answered(at_s: float, error_arcsec: tuple[float, float, float], stamp_s: float = 0.0) -> Any:
    """An answer that is off by so much from the attitude at its stamp."""
    turn = from_rotation_vector(np.array(error_arcsec) / ARCSEC_PER_RAD)
    q = multiply(turn, turn_at(at_s + stamp_s).q_icrs_to_cam)
    return SolverAnswer(q, rate_cam_rad_s=1.01 * RATE_RAD_S, stamp_s=stamp_s)


def tally(**keys: Any) -> CaseTally:
    return CaseTally(with_centroids=True, wrong_above_arcsec=100.0, turn_at=turn_at, **keys)


def heard(case: CaseTally, answers: list[Any]) -> dict[str, Any]:
    """The row of a case that heard these answers, an exposure each."""
    for number, answer in enumerate(answers):
        case.see(exposure(number))
        at_s = number * STEP_S
        told = answer(at_s) if callable(answer) else answer
        case.hear(exposure(number), told, at_s)
    return case.into({"recovery_s": None})


def test_a_row_counts_frames_answers_and_wrong_ones_and_has_the_errors_of_the_others() -> None:
    """Five frames: none, wrong, and three with errors about one stamp that is late, one early."""
    errors = [(3.0, -5.0, 40.0), (1.0, -1.0, 20.0), (5.0, -3.0, 90.0)]
    row = heard(
        tally(),
        [
            SolverAnswer(None, "clouds"),
            lambda at_s: answered(at_s, (80.0, 0.0, 61.0)),
            lambda at_s: answered(at_s, errors[0], 0.2),
            lambda at_s: answered(at_s, errors[1], -0.1),
            lambda at_s: answered(at_s, errors[2]),
        ],
    )
    counts = [row[name] for name in ("frames", "solved", "wrong", "stars_in_view", "why")]
    assert counts == [5, 4, 1, 2 + 3 + 4 + 5 + 6, "clouds"]
    for k, axis in enumerate("xyz"):
        values = np.array(errors)[:, k]
        assert row[f"error_{axis}_arcsec"] == pytest.approx(values.mean(), abs=1e-6)
        assert row[f"scatter_{axis}_arcsec"] == pytest.approx(values.std(ddof=1), abs=1e-6)
    # to the end of the exposure whose middle is 1 s after that of the first, which begins the case
    assert row["first_attitude_s"] == pytest.approx(2 * STEP_S + EXPOSURE_S)
    # the first exposure had no attitude
    assert "solved_qw" not in row
    pixels = b"".join(exposure(number).dn.tobytes() for number in range(5))
    assert row["image_sha256"] == hashlib.sha256(pixels).hexdigest()


def test_a_first_exposure_s_attitude_is_kept_though_it_is_wrong() -> None:
    wrong = answered(0.0, (0.0, 100.5, 0.0))
    row = heard(tally(), [wrong, lambda at_s: answered(at_s, (0.0, 99.5, 0.0))])
    solved = [row[f"solved_{name}"] for name in ("qw", "qx", "qy", "qz")]
    assert solved == wrong.q_icrs_to_cam.tolist()
    assert (row["wrong"], row["solved"], row["why"]) == (1, 2, "")
    assert "scatter_x_arcsec" not in row


def test_a_case_has_its_first_reason() -> None:
    row = heard(tally(), [SolverAnswer(None, why) for why in ("clouds", "few stars", "")])
    assert (row["why"], row["solved"], row["first_attitude_s"]) == ("clouds", 0, None)


@pytest.mark.parametrize(
    ("end_s", "recovery_s"), [(1.0, 0.05), (1.01, 0.54), (0.3, 0.25), (None, None), (9.0, None)]
)
def test_recovery_is_from_the_fault_s_end_to_that_of_the_first_exposure_after_it(end_s, recovery_s):
    """Exposures have their middles each half second, and end 50 ms later."""
    right = [lambda at_s: answered(at_s, (1.0, 1.0, 1.0))] * 4
    row = heard(tally(fault_end_s=end_s), right)
    assert row["recovery_s"] == (None if recovery_s is None else pytest.approx(recovery_s))
    assert row["fault_end_s"] == end_s
    # wrong answers are no recovery
    wrong = [lambda at_s: answered(at_s, (900.0, 1.0, 1.0))] * 4
    assert heard(tally(fault_end_s=end_s), wrong)["recovery_s"] is None


def test_frames_have_their_rates_and_the_errors_of_those_reported() -> None:
    row = heard(
        tally(further=("rate", "time")),
        [
            lambda at_s: answered(at_s, (1.0, -2.0, 3.0)),
            lambda at_s: answered(at_s, (900.0, 0.0, 0.0)),
            lambda at_s: SolverAnswer(turn_at(at_s).q_icrs_to_cam),
        ],
    )
    rates_deg_s = np.degrees(RATE_RAD_S)
    for k, axis in enumerate("xyz"):
        assert row[f"frame_rate_{axis}_deg_s"] == pytest.approx([rates_deg_s[k]] * 2)
        reported, silent = row[f"frame_rate_error_{axis}_deg_s"]
        assert reported == pytest.approx(0.01 * rates_deg_s[k])
        assert np.isnan(silent)
        own = [(1.0, -2.0, 3.0)[k], 0.0]
        assert row[f"frame_error_{axis}_arcsec"] == pytest.approx(own, abs=1e-6)


def centroids(stars: int, found: int, dx_px: list[float], v_mag: list[float]) -> SolverAnswer:
    """An answer without an attitude, of centroids whose errors along y are three times those along
    x.
    """
    dx = np.array(dx_px)
    errors = CentroidErrors(
        stars=stars,
        found=found,
        matched=len(dx_px),
        false=found - len(dx_px),
        dx_px=dx,
        dy_px=3 * dx,
        v_mag=np.array(v_mag),
        star=np.zeros(len(dx_px), dtype=[("hip", "i4")]),
    )
    return SolverAnswer(None, "not asked", errors)


def test_centroids_of_all_frames_are_told_together() -> None:
    row = heard(
        tally(), [centroids(9, 5, [0.1, 0.3, -0.1], [4.0, 6.5, 5.0]), centroids(7, 1, [0.5], [3.0])]
    )
    names = ("stars", "found", "matched", "false", "measured")
    assert [row[name] for name in names] == [16, 6, 4, 2, 4]
    dx = np.array([0.1, 0.3, -0.1, 0.5])
    assert row["centroid_dx_px"] == pytest.approx(dx.mean())
    assert row["centroid_dy_px"] == pytest.approx(3 * dx.mean())
    assert row["centroid_sigma_x_px"] == pytest.approx(dx.std(ddof=1))
    assert row["centroid_sigma_y_px"] == pytest.approx(3 * dx.std(ddof=1))
    assert row["limit_v_mag"] == 6.5
    none = heard(tally(), [centroids(4, 0, [], [])])
    assert (none["stars"], none["measured"]) == (4, 0)
    assert "centroid_dx_px" not in none and "limit_v_mag" not in none
