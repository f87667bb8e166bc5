"""STK's attitude files: each form against numbers by hand, AGI's own examples and SciPy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hilstar.attitude.logs.earth import q_icrs_to_itrs
from hilstar.attitude.logs.log_file import open_log
from hilstar.basics.rotation import to_radec_roll_deg
from tests.support.sources.attitude_texts import stk_text

ROUNDING = 1e-12
EPOCH_NS = 1_735_689_600 * 10**9  # 2025-01-01T00:00:00
# Alnilam in the middle, north up, as STK has it: the conjugate of hilstar's q, scalar last.
ALNILAM = "-0.7135120 0.0370377 -0.0362700 0.6987226"
# AGI's example of AttitudeTimeQuatAngVels: a body that turns at +6 deg/s about its z.
AGI_SPIN = [
    "0 0 0 0 1 0 0 6",
    "10 0 0 0.5 0.866025403784439 0 0 6",
    "20 0 0 0.866025403784439 0.5 0 0 6",
]
# AGI's example of AttitudeTimeDCM (1 Jul 2005), rows of a matrix from J2000 to the body.
AGI_MATRIX = (
    "0.45959131992578 0.65939233328195 0.59496014106650 -0.09650521823583 -0.62885739983663"
    " 0.77150833665228 0.88287176956914 -0.41199529303100 -0.22538260140960"
)


@pytest.fixture
def stk_log(tmp_path):
    def opened(rows, *arguments, **keywords):
        path = tmp_path / "a.a"
        path.write_text(stk_text(rows, *arguments, **keywords))
        return open_log(path)

    return opened


def body_turns(stk_log):
    """The rotations of components from the reference to the body."""
    return Rotation.from_quat(
        [sample.q_icrs_to_cam for sample in stk_log.samples], scalar_first=True
    )


def test_quaternions_are_the_conjugates_of_hilstars_scalar_last_or_first(stk_log):
    last = stk_log([f"0.0 {ALNILAM}", f"10.5 {ALNILAM}"])
    assert [sample.t_ns for sample in last.samples] == [EPOCH_NS, EPOCH_NS + 10_500_000_000]
    x, y, z, w = ALNILAM.split()
    first = stk_log([f"0 {w} {x} {y} {z}"], "AttitudeTimeQuatScalarFirst")
    for each in (last, first):
        ra_deg, dec_deg, roll_deg = to_radec_roll_deg(each.samples[0].q_icrs_to_cam)
        assert (ra_deg, dec_deg) == pytest.approx((84.057, -1.2), abs=1e-5)
        assert abs(np.remainder(roll_deg + 180, 360) - 180) < 1e-5
        assert each.conventions.of_body and each.conventions.scale == "UTC"


def test_a_body_that_turns_by_agis_example_turns_as_its_rates_say(stk_log):
    spun = stk_log(AGI_SPIN, "AttitudeTimeQuatAngVels")
    about_z = body_turns(spun).as_rotvec()[:, 2]
    # components turn the other way
    assert about_z == pytest.approx(-np.radians([0, 60, 120]), abs=ROUNDING)
    for sample in spun.samples:
        assert sample.rate_cam_rad_s == pytest.approx([0, 0, np.radians(6)], abs=ROUNDING)
    assert not spun.joins().misfits


def test_angular_velocities_are_in_the_body_s_own_components(stk_log):
    """Of a body that stands askew, about an axis that is none of its own."""
    rate_deg_s = np.array([1.0, -2.0, 3.0])
    askew = Rotation.from_rotvec([0.7, 1.1, -0.4])
    rows = []
    for t_s in (0.0, 0.5, 1.0):
        to_body = Rotation.from_rotvec(-np.radians(rate_deg_s) * t_s) * askew
        numbers = (*to_body.inv().as_quat().tolist(), *rate_deg_s.tolist())
        rows.append(" ".join(map(repr, (t_s, *numbers))))
    spun = stk_log(rows, "AttitudeTimeQuatAngVels")
    for sample in spun.samples:
        assert sample.rate_cam_rad_s == pytest.approx(np.radians(rate_deg_s), abs=ROUNDING)
    assert not spun.joins().misfits


def test_euler_angles_are_turns_of_the_axes_in_the_order_of_the_sequence(stk_log):
    angles = [10.0, 20.0, 30.0]
    for sequence, axes in (("321", "ZYX"), ("313", "ZXZ"), ("123", "XYZ")):
        found = body_turns(
            stk_log(
                [f"0 {' '.join(map(str, angles))}"], "AttitudeTimeEulerAngles", Sequence=sequence
            )
        )
        wanted = Rotation.from_euler(axes, angles, degrees=True).inv()
        assert (found[0] * wanted.inv()).magnitude() < ROUNDING
    # the second of AGI_SPIN
    spun = body_turns(stk_log(["0 60 0 0"], "AttitudeTimeEulerAngles", Sequence="313"))
    assert spun[0].as_rotvec()[2] == pytest.approx(-np.radians(60), abs=ROUNDING)


def test_a_matrix_is_by_rows_from_the_axes_to_the_body(stk_log):
    wanted = Rotation.from_matrix(np.array(AGI_MATRIX.split(), dtype=float).reshape(3, 3))
    for form, more in (("AttitudeTimeDCM", ""), ("AttitudeTimeDCMAngVels", " 0 0 6")):
        found = stk_log([f"0 {AGI_MATRIX}{more}"], form)
        assert (body_turns(found)[0] * wanted.inv()).magnitude() < ROUNDING
        assert (found.samples[0].rate_cam_rad_s is None) == (not more)


def test_axes_that_are_fixed_to_the_earth_turn_with_it(stk_log):
    fixed = stk_log(AGI_SPIN, "AttitudeTimeQuatAngVels", CoordinateAxes="Fixed")
    inertial = body_turns(stk_log(AGI_SPIN, "AttitudeTimeQuatAngVels", CoordinateAxes="ICRF"))
    t_ns = np.array([sample.t_ns for sample in fixed.samples])
    to_earth = Rotation.from_quat(q_icrs_to_itrs(t_ns), scalar_first=True)
    assert (body_turns(fixed) * (inertial * to_earth).inv()).magnitude().max() < ROUNDING
    earth_rad_s = 7.292115e-5
    assert fixed.samples[0].rate_cam_rad_s[2] - np.radians(6) == pytest.approx(
        earth_rad_s, abs=1e-9
    )


@pytest.mark.parametrize(
    ("keywords", "times", "since_s"),
    [
        ({"TimeFormat": "EpSec"}, ["1.5", "2e0"], [1.5, 2.0]),
        ({"TimeFormat": "EpMin"}, ["1.5", "2"], [90.0, 120.0]),
        ({"TimeFormat": "EpHr"}, ["1.5", "2"], [5400.0, 7200.0]),
        ({"TimeFormat": "EpDay"}, ["0.5", "1"], [43_200.0, 86_400.0]),
        ({"TimeFormat": "UTCG"}, ["1 Jan 2025 00:00:01.500", "01 January 2025 0:1:0"], [1.5, 60.0]),
        ({"TimeFormat": "ISO-YMD"}, ["2025-01-01T00:00:01.5", "2025-01-01T00:01:00"], [1.5, 60.0]),
        ({"TimeFormat": "ISO-YD"}, ["2025-001T00:00:01.5", "2025-001T00:01:00"], [1.5, 60.0]),
        ({"ScenarioEpoch": '"1 Jan 2025 0:0:0.0000"'}, ["1.5", "2"], [1.5, 2.0]),
        ({"ScenarioEpoch": "2025-01-01T00:00:00"}, ["1.5", "2"], [1.5, 2.0]),
    ],
)
def test_times_are_of_the_epoch_and_the_format(stk_log, keywords, times, since_s):
    found = stk_log([f"{time} 0 0 0 1" for time in times], **keywords)
    assert [sample.t_ns - EPOCH_NS for sample in found.samples] == [int(s * 1e9) for s in since_s]


@pytest.mark.parametrize(("unit", "seconds"), [(None, 1), ("EpMin", 60), ("EpDay", 86_400)])
def test_without_an_epoch_times_are_no_dates(stk_log, unit, seconds):
    rows = ["1 0 0 0 1", "2 0 0 0 1"]
    undated = stk_log(rows, ScenarioEpoch=None, TimeFormat=unit)
    assert [sample.t_ns for sample in undated.samples] == [seconds * 10**9, 2 * seconds * 10**9]
    assert undated.conventions.scale is None
    no_date = "seconds of the file, no dates: it states no ScenarioEpoch"
    assert dict(undated.told)["log-times"] == f"its times are {no_date}"
    assert undated.conventions.time == no_date


def test_what_follows_a_hash_is_a_comment_wherever_it_stands(stk_log):
    rows = ["# all of it", "1 0 0 0 1 # a row's end", "  # 2 0 0 0 1", "3 0 0 0 1#4"]
    commented = stk_log(rows, CoordinateAxes="ICRF # the axes")
    assert [sample.t_ns - EPOCH_NS for sample in commented.samples] == [10**9, 3 * 10**9]


ROWS = [f"{k} 0 0 0 1" for k in range(3)]
WHOLE = stk_text(ROWS)
COUNT = "NumberOfAttitudePoints"


@pytest.mark.parametrize(
    ("text", "count", "kind", "words"),
    [
        (WHOLE, 3, None, ""),
        (WHOLE.replace("END Attitude", ""), 3, None, ""),
        (
            WHOLE.replace("END Attitude", "").replace(f"{COUNT} 3", ""),
            3,
            "log-cut",
            "neither END Attitude nor",
        ),
        (
            WHOLE.replace(f"{COUNT} 3", f"{COUNT} 2.000"),
            2,
            "log-count",
            "is 2, and 3 are there; 2 are read",
        ),
        (
            WHOLE.replace(f"{COUNT} 3", f"{COUNT} 9"),
            3,
            "log-count",
            "is 9, and 3 are there; 3 are read",
        ),
    ],
)
def test_the_end_and_the_count_of_a_file_say_whether_it_is_whole(
    tmp_path, text, count, kind, words
):
    (tmp_path / "a.a").write_text(text)
    found = open_log(tmp_path / "a.a")
    assert len(found.samples) == count
    told = dict(found.told)
    told.pop("mounting")
    assert list(told) == ([kind] if kind else [])
    assert words in "".join(told.values())


def test_inertial_axes_of_another_body_are_read(stk_log):
    assert len(stk_log(ROWS, CentralBody="Mars").samples) == 3


@pytest.mark.parametrize(
    ("form", "row", "scalar"),
    [
        ("AttitudeTimeQuaternions", "0 0 0 0 1", "scalar last (q1, q2, q3, q4)"),
        ("AttitudeTimeQuatScalarFirst", "0 1 0 0 0", "scalar first"),
    ],
)
def test_what_a_file_s_numbers_mean_is_said_by_its_form(stk_log, form, row, scalar):
    found = stk_log([row, row.replace("0", "60", 1)], form)
    assert found.conventions.scalar.startswith(scalar)
