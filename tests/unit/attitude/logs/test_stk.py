"""STK's attitude files: each form against numbers by hand, AGI's own examples and SciPy, and
what is refused.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hilstar.attitude.logs.earth import q_icrs_to_itrs
from hilstar.attitude.logs.log_file import open_log
from hilstar.attitude.logs.stk import COUNTS, TYPES
from hilstar.basics.errors import InputError
from hilstar.basics.rotation import to_radec_roll_deg
from tests.support.refusals import refusal
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
    third = "0.5773503 0.5773503 0.5773503"
    for matrix in (
        f"{third} {third} {third}",
        "1 0 0 0 1 0 0 0 -1",
        "2 0 0 0 2 0 0 0 2",
        "nan 0 0 0 1 0 0 0 1",
    ):
        with pytest.raises(
            InputError, match=r"a\.a:9: the nine numbers are no rotation matrix by rows"
        ):
            stk_log([f"0 {matrix}"], "AttitudeTimeDCM")


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


def test_without_an_epoch_times_are_no_dates_and_what_moves_is_refused(stk_log):
    undated = stk_log(["1 0 0 0 1", "2 0 0 0 1"], ScenarioEpoch=None)
    assert [sample.t_ns for sample in undated.samples] == [10**9, 2 * 10**9]
    assert undated.conventions.scale is None
    assert "states no ScenarioEpoch" in dict(undated.told)["log-times"]
    with pytest.raises(InputError, match="states no ScenarioEpoch; write it as 1 Jan 2025"):
        stk_log(["1 0 0 0 1"], ScenarioEpoch=None, CoordinateAxes="Fixed")


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


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (
            "CoordinateAxes J2000",
            "CoordinateAxes AWB UpWestSouth Satellite/A",
            ":7: CoordinateAxes AWB UpWestSouth Satel",
        ),
        (
            "CoordinateAxes J2000",
            "CoordinateAxes TEMEOfEpoch",
            ":7: CoordinateAxes TEMEOfEpoch are not read; write J2000",
        ),
        ("CoordinateAxes J2000", "", "states no CoordinateAxes; write CoordinateAxes and J2000"),
        (
            "CoordinateAxes J2000",
            "CoordinateSystem J2000",
            ":7: CoordinateSystem is not read; did you mean Coordin",
        ),
        (
            "CentralBody Earth",
            "CentralBody Mars\nCoordinateAxes Fixed",
            ":8: CoordinateAxes is there twice",
        ),
        ("BEGIN Attitude", "BEGIN Ephemeris", ":3: 'BEGIN Ephemeris' where BEGIN Attitude belongs"),
        (
            "CentralBody Earth",
            "CoordinateAxesEpoch 1 Jan 2025",
            ":6: CoordinateAxesEpoch is not read; did you mean",
        ),
        (
            "CentralBody Earth",
            "RepeatPattern",
            ":6: RepeatPattern is not read; read are NumberOfAttitudePoints",
        ),
        (
            "CentralBody Earth",
            "CentralBody Earth\nCentralBody Earth",
            ":7: CentralBody is there twice",
        ),
        (
            "CentralBody Earth",
            "TimeFormat LCLG",
            ":6: TimeFormat lclg is not read; write EpSec, EpMin",
        ),
        (
            "AttitudeTimeQuaternions",
            "AttitudeTimeYPRAngles",
            ":8: AttitudeTimeYPRAngles is not read; write one of Att",
        ),
        (
            "AttitudeTimeQuaternions",
            "AttitudeTimeECIVector",
            ":8: AttitudeTimeECIVector is not read",
        ),
        (
            "AttitudeTimeQuaternions",
            "AttitudeTimeEulerAngles",
            ":9: '0 0 0 0 1': write a time and 3 numbers",
        ),
        (
            "1 Jan 2025 00:00:00.000",
            "1 Foo 2025 00:00:00",
            ":5: the date is '1 Foo 2025 00:00:00'; write it as 1 Jan",
        ),
        (
            "1 Jan 2025 00:00:00.000",
            "31 Feb 2025 00:00:00",
            ":5: the date is '31 Feb 2025 00:00:00'",
        ),
        ("1 0 0 0 1", "1 0 0 0", ":10: '1 0 0 0': write a time and 4 numbers"),
        ("1 0 0 0 1", "one 0 0 0 1", ":10: the time is 'one'"),
        ("1 0 0 0 1", "1 0 0 0 x", ":10: '1 0 0 0 x'"),
        ("1 0 0 0 1", "1 0 0 0 2", ":10: the quaternion's norm is 2"),
        ("2 0 0 0 1", "1 0 0 0 1", ":11: time does not increase"),
        ("END Attitude", "END Attitude\nmore", ":13: 'more' after END Attitude"),
        (f"{COUNT} 3", f"{COUNT} many", ":4: NumberOfAttitudePoints is no count"),
    ],
)
def test_what_would_be_another_attitude_is_refused_by_name_and_line(tmp_path, old, new, words):
    path = tmp_path / "a.a"
    assert old in WHOLE
    path.write_text(WHOLE.replace(old, new))
    line = refusal(open_log, path)
    assert line.startswith(str(path)) and words in line


@pytest.mark.parametrize("form", TYPES)
def test_a_row_of_fewer_numbers_than_its_form_has_is_refused_by_its_line(stk_log, form):
    """A short row of a long form left a time and its other numbers, and so a traceback."""
    whole = COUNTS[form]
    for count in range(whole):
        row = " ".join(["0", *["0"] * count])
        with pytest.raises(InputError, match=f":10: .*: write a time and {whole} numbers for"):
            stk_log([row], form=form, Sequence="321")


def test_axes_of_another_body_are_refused_unless_they_are_inertial(stk_log):
    with pytest.raises(
        InputError,
        match=r"a\.a:7: CoordinateAxes fixed of CentralBody Mars are not read; write J2000",
    ):
        stk_log(ROWS, CentralBody="Mars", CoordinateAxes="Fixed")
    assert len(stk_log(ROWS, CentralBody="Mars").samples) == 3


def test_a_sequence_that_is_none_is_refused(stk_log):
    for sequence in ("322", "421", "32"):
        with pytest.raises(
            InputError, match=rf"a\.a:8: Sequence is {sequence}; write three axes such as 321"
        ):
            stk_log(["0 1 2 3"], "AttitudeTimeEulerAngles", Sequence=sequence)
    assert "Sequence is missing" in refusal(stk_log, ["0 1 2 3"], "AttitudeTimeEulerAngles")


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
