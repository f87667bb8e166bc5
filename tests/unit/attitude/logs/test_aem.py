"""CCSDS AEM: order, direction, frames and rates against SciPy and the standard's own figures."""

from __future__ import annotations

import re
from datetime import UTC, datetime
from xml.etree import ElementTree

import erfa
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hilstar.attitude.logs.log_file import open_log, read_log, write_log
from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.basics.rotation import from_radec_roll_deg, propagate, to_matrix
from tests.support.sources.aem_messages import EPOCHS, kvn, read, rows_of, xml_of

# Quaternions are written with 17 digits here; a matrix from one is a sum of four products, a few
# roundings of 1.
MATRIX_TOLERANCE = 1e-14
SEVEN_DECIMALS = 6e-8  # half of the last of those that are shown, and a rounding
# The reference derivative is a central difference over 2 h = 2e-4 s: h^2 rate^3 / 24 = 1e-9 1/s and
# rounding 1e-16 / h.
DIFFERENCE_S = 1e-4
DERIVATIVE_TOLERANCE_RAD_S = 1e-8
# 504.0-B-2 annex F prints its example to four digits.
ANNEX_F_TOLERANCE = 1e-4
# EME2000 against ICRF: the frame bias of the IAU 2000 precession-nutation, -16.6, -6.8 and -14.6
# mas about x, y and z.
FRAME_BIAS_MAS = 23.15
FRAME_BIAS_TOLERANCE_MAS = 0.01

RATE_CAM_RAD_S = np.array([0.3, -1.1, 0.7])

# CCSDS 504.0-B-2, figure G-4 (without the lines that stand for omitted records).
FIGURE_G4 = """CCSDS_AEM_VERS = 2.0
CREATION_DATE = 2002-11-04T17:22:31
ORIGINATOR    = NASA/JPL
MESSAGE_ID    = A701523

META_START
COMMENT This file was produced by M.R. Somebody, MSOO NAV/JPL.
OBJECT_NAME       = MARS_GLOBAL_SURVEYOR
OBJECT_ID         = 1996-062A
CENTER_NAME       = MARS BARYCENTER
REF_FRAME_A         = EME2000
REF_FRAME_B         = SC_BODY_1
TIME_SYSTEM       = UTC
START_TIME        = 1996-11-28T21:29:07.2555
USEABLE_START_TIME = 1996-11-28T22:08:02.5555
USEABLE_STOP_TIME  = 1996-11-30T01:18:02.5555
STOP_TIME         = 1996-11-30T01:28:02.5555
ATTITUDE_TYPE     = QUATERNION
INTERPOLATION_METHOD = HERMITE
INTERPOLATION_DEGREE = 7
META_STOP

DATA_START
1996-11-28T21:29:07.2555 0.56748 0.03146 0.45689 0.68427
1996-11-28T22:08:03.5555 0.42319 -0.45697 0.23784 0.74533
1996-11-28T22:08:04.5555 -0.84532 0.26974 -0.06532 0.45652
1996-11-30T01:28:02.5555 0.74563 -0.45375 0.36875 0.31964
DATA_STOP

META_START
COMMENT This block begins after trajectory correction maneuver TCM-3.
OBJECT_NAME       = mars_global_surveyor
OBJECT_ID         = 1996-062A
CENTER_NAME       = MARS BARYCENTER
REF_FRAME_A         = EME2000
REF_FRAME_B         = SC_BODY_1
TIME_SYSTEM       = UTC
START_TIME        = 1996-12-18T12:05:00.5555
STOP_TIME         = 1996-12-28T21:28:00.5555
ATTITUDE_TYPE     = QUATERNION
META_STOP

DATA_START
1996-12-18T12:05:00.5555 -0.64585 0.018542 -0.23854 0.72501
1996-12-18T12:10:05.5555 0.87451 -0.43475 0.13458 0.16767
1996-12-18T12:10:10.5555 0.03125 -0.65874 0.23458 0.71418
1996-12-28T21:28:00.5555 -0.25485 0.58745 -0.36845 0.67394
DATA_STOP
"""


def ccsds_quaternion(second_from_first):
    """Q1 Q2 Q3 QC of annex F: of the rotation that takes the first frame's axes to the second's."""
    return Rotation.from_matrix(second_from_first.as_matrix().T).as_quat()


def camera_turn(seconds=0.0):
    """The rotation of cam's components into ICRS components, turning at RATE_CAM_RAD_S."""
    return Rotation.from_quat([0.1, -0.5, 0.7, 0.3]) * Rotation.from_rotvec(
        RATE_CAM_RAD_S * seconds
    )


def second_from_first(frame_a, direction, seconds=0.0):
    """The rotation whose quaternion a file has to hold, and whether its second frame is the
    camera.
    """
    to_cam = (frame_a == "ICRF") == (direction == "A2B")
    return (camera_turn(seconds).inv() if to_cam else camera_turn(seconds)), to_cam


def frame_keywords(frame_a):
    return {"REF_FRAME_A": frame_a, "REF_FRAME_B": "SC_BODY_1" if frame_a == "ICRF" else "ICRF"}


# Conventions


@pytest.mark.parametrize("order", ["FIRST", "LAST"])
@pytest.mark.parametrize("direction", ["A2B", "B2A"])
@pytest.mark.parametrize("frame_a", ["ICRF", "SC_BODY_1"])
def test_each_order_direction_and_frame_of_version_1_gives_the_same_attitude(
    tmp_path, frame_a, direction, order
):
    q = ccsds_quaternion(second_from_first(frame_a, direction)[0])
    row = np.roll(q, 1) if order == "FIRST" else q
    text = kvn(
        rows_of(row), ATTITUDE_DIR=direction, QUATERNION_TYPE=order, **frame_keywords(frame_a)
    )
    (sample,) = read(tmp_path, text)
    assert to_matrix(sample.q_icrs_to_cam) == pytest.approx(
        camera_turn().inv().as_matrix(), abs=MATRIX_TOLERANCE
    )
    assert sample.rate_cam_rad_s is None
    # and again in the file's own words, of which q and -q are one attitude
    path = tmp_path / "again.aem"
    path.write_text(text)
    said = open_log(path).conventions.written(sample.q_icrs_to_cam)
    names = {"FIRST": "QC Q1 Q2 Q3", "LAST": "Q1 Q2 Q3 QC"}[order]
    assert said.startswith(f"{names} = (")
    again = np.array(said.partition("(")[2].rstrip(")").split(", "), dtype=float)
    assert again * np.sign(again @ row) == pytest.approx(row, abs=SEVEN_DECIMALS)


@pytest.mark.parametrize("frame_a", ["ICRF", "SC_BODY_1"])
def test_version_2_is_scalar_last_and_from_a_to_b(tmp_path, frame_a):
    q = ccsds_quaternion(second_from_first(frame_a, "A2B")[0])
    (sample,) = read(tmp_path, kvn(rows_of(q), "2.0", **frame_keywords(frame_a)))
    assert to_matrix(sample.q_icrs_to_cam) == pytest.approx(
        camera_turn().inv().as_matrix(), abs=MATRIX_TOLERANCE
    )


@pytest.mark.parametrize("order", ["FIRST", "LAST"])
@pytest.mark.parametrize("direction", ["A2B", "B2A"])
@pytest.mark.parametrize(("frame_a", "norm"), [("ICRF", 1.0), ("SC_BODY_1", 1.0), ("ICRF", 1.0005)])
def test_a_quaternions_derivative_gives_the_rate_of_the_camera(
    tmp_path, frame_a, norm, direction, order
):
    """Whatever the quaternion's norm, within what is taken: the derivative is of the same one."""
    before, q, after = (
        ccsds_quaternion(second_from_first(frame_a, direction, s)[0])
        for s in (-DIFFERENCE_S, 0.0, DIFFERENCE_S)
    )
    before, after = (other * np.sign(other @ q) for other in (before, after))
    parts = [q, (after - before) / (2 * DIFFERENCE_S)]
    row = np.concatenate([np.roll(part, 1) if order == "FIRST" else part for part in parts])
    row *= norm
    keywords = {
        "ATTITUDE_TYPE": "QUATERNION/DERIVATIVE",
        "ATTITUDE_DIR": direction,
        "QUATERNION_TYPE": order,
    }
    (sample,) = read(tmp_path, kvn(rows_of(row), **keywords, **frame_keywords(frame_a)))
    assert sample.rate_cam_rad_s == pytest.approx(RATE_CAM_RAD_S, abs=DERIVATIVE_TOLERANCE_RAD_S)


@pytest.mark.parametrize(("version", "direction"), [("1.0", "A2B"), ("1.0", "B2A"), ("2.0", "A2B")])
@pytest.mark.parametrize("named", ["by name", "by keyword"])
@pytest.mark.parametrize("resolved_in", ["ICRF", "SC_BODY_1"])
@pytest.mark.parametrize("frame_a", ["ICRF", "SC_BODY_1"])
def test_an_angular_velocity_gives_the_rate_of_the_camera(
    tmp_path, frame_a, direction, resolved_in, named, version
):
    rotation, to_cam = second_from_first(frame_a, direction)
    rate = RATE_CAM_RAD_S if to_cam else -RATE_CAM_RAD_S
    if resolved_in == "ICRF":
        rate = camera_turn().apply(rate)
    row = np.concatenate([ccsds_quaternion(rotation), np.degrees(rate)])
    frame = (
        resolved_in
        if named == "by name"
        else ("REF_FRAME_A" if resolved_in == frame_a else "REF_FRAME_B")
    )
    keywords = {"ATTITUDE_TYPE": "QUATERNION/RATE", "RATE_FRAME": frame, "ATTITUDE_DIR": direction}
    if version == "2.0":
        keywords = {"ATTITUDE_TYPE": "QUATERNION/ANGVEL", "ANGVEL_FRAME": frame}
    (sample,) = read(tmp_path, kvn(rows_of(row), version, **keywords, **frame_keywords(frame_a)))
    assert sample.rate_cam_rad_s == pytest.approx(RATE_CAM_RAD_S, abs=MATRIX_TOLERANCE)


def test_the_rate_that_is_read_carries_the_attitude_on():
    seconds = 0.8
    start = from_radec_roll_deg(84.057, -1.2, 30.0)
    moved = Rotation.from_matrix(to_matrix(start)).inv() * Rotation.from_rotvec(
        RATE_CAM_RAD_S * seconds
    )
    carried = to_matrix(propagate(start, RATE_CAM_RAD_S, seconds))
    assert carried == pytest.approx(moved.inv().as_matrix(), abs=MATRIX_TOLERANCE)


# The standard's own figures


def test_annex_f_turns_x_into_minus_y(tmp_path):
    # 504.0-B-2 F2.2: X_A = [1, 0, 0] has X_B = [0, -1, 0].
    (sample,) = read(tmp_path, kvn(rows_of([0, 0, 0.7071, 0.7071]), "2.0"))
    assert to_matrix(sample.q_icrs_to_cam) @ [1, 0, 0] == pytest.approx(
        [0, -1, 0], abs=ANNEX_F_TOLERANCE
    )


def figure_in_version_1():
    meta = "ATTITUDE_DIR = A2B\nQUATERNION_TYPE = LAST\nATTITUDE_TYPE"
    return FIGURE_G4.replace("CCSDS_AEM_VERS = 2.0", "CCSDS_AEM_VERS = 1.0").replace(
        "ATTITUDE_TYPE", meta
    )


@pytest.mark.parametrize("text", [FIGURE_G4, figure_in_version_1()], ids=["2.0", "1.0"])
def test_figure_g4_is_read_as_two_blocks_with_a_break_between(tmp_path, text):
    samples = read(tmp_path, text)
    assert [s.discontinuity for s in samples] == [False] * 4 + [True] + [False] * 3
    first = datetime(1996, 11, 28, 21, 29, 7, 255500, UTC)
    assert samples[0].t_ns == round(first.timestamp() * 10**4) * 10**5
    q = np.array([0.68427, -0.56748, -0.03146, -0.45689])
    assert samples[0].q_icrs_to_cam == pytest.approx(q / np.linalg.norm(q), abs=MATRIX_TOLERANCE)


@pytest.mark.parametrize("version", ["1.0", "2.0"])
def test_xml_and_kvn_hold_the_same(tmp_path, version):
    row = np.array([0.56748, 0.03146, 0.45689, 0.68427, 0.4, -0.2, 7.0])
    turning = {
        "1.0": {"ATTITUDE_TYPE": "QUATERNION/RATE", "RATE_FRAME": "REF_FRAME_B"},
        "2.0": {"ATTITUDE_TYPE": "QUATERNION/ANGVEL", "ANGVEL_FRAME": "SC_BODY_1"},
    }[version]
    text = kvn(rows_of(row), version, **turning)
    q = "<QC>0.68427</QC><Q1>0.56748</Q1><Q2>0.03146</Q2><Q3>0.45689</Q3>"
    if version == "2.0":
        q = "<Q1>0.56748</Q1><Q2>0.03146</Q2><Q3>0.45689</Q3><QC>0.68427</QC>"
    axes = ("Z_RATE", 7), ("X_RATE", 0.4), ("Y_RATE", -0.2)
    rates = "".join(
        f'<rotation{i} rate="{axis}">{value}</rotation{i}>'
        for i, (axis, value) in enumerate(axes, start=1)
    )
    if version == "2.0":
        rates = (
            '<ANGVEL_X units="deg/s">0.4</ANGVEL_X><ANGVEL_Y>-0.2</ANGVEL_Y><ANGVEL_Z>7</ANGVEL_Z>'
        )
    state, part = {
        "1.0": ("quaternionEulerRate", "rotationRates"),
        "2.0": ("quaternionAngVel", "angVel"),
    }[version]
    data = f"<{state}><EPOCH>{EPOCHS[0]}</EPOCH><quaternion>{q}</quaternion><{part}>{rates}</{part}></{state}>"
    xml = xml_of(text, [data])
    (from_kvn,), (from_xml,) = read(tmp_path, text), read(tmp_path, xml)
    assert from_xml.t_ns == from_kvn.t_ns
    assert from_xml.q_icrs_to_cam.tolist() == from_kvn.q_icrs_to_cam.tolist()
    assert from_kvn.rate_cam_rad_s is not None
    assert from_xml.rate_cam_rad_s is not None
    assert from_xml.rate_cam_rad_s.tolist() == from_kvn.rate_cam_rad_s.tolist()


# Frames


def test_eme2000_and_icrf_differ_by_the_frame_bias():
    j2000 = 2451545.0
    bias = Rotation.from_matrix(erfa.bp00(j2000, 0.0)[0]).magnitude()
    assert np.degrees(bias) * 3_600_000 == pytest.approx(
        FRAME_BIAS_MAS, abs=FRAME_BIAS_TOLERANCE_MAS
    )


@pytest.mark.parametrize("inertial", ["ICRF", "icrf2", "EME2000", "J2000"])
@pytest.mark.parametrize(
    "body",
    ["SC_BODY_1", "sc body", "INSTRUMENT_A", "STARTRACKER_1", "AST_2", "ACC_0", "CAM", "CAMERA_1"],
)
def test_the_icrf_or_eme2000_and_a_spacecraft_frame_are_taken(tmp_path, inertial, body):
    assert (
        len(read(tmp_path, kvn(rows_of([0, 0, 0, 1]), REF_FRAME_A=inertial, REF_FRAME_B=body))) == 1
    )


# Writing


def turning_samples():
    times = [0, 10, 20, 30]
    return [
        AttitudeSample(t, from_radec_roll_deg(10.0 * t, 5.0, 0.0), RATE_CAM_RAD_S, 0, t == 20)
        for t in times
    ]


STATED = {
    **{
        "REF_FRAME_A": "ICRF",
        "REF_FRAME_B": "STARTRACKER_1",
        "ATTITUDE_DIR": "A2B",
        "QUATERNION_TYPE": "LAST",
    },
    **{"TIME_SYSTEM": "TAI", "ATTITUDE_TYPE": "QUATERNION/DERIVATIVE"},
}
BLOCKS_NS = ((0, 10), (20, 30))


def written_epoch(t_ns):
    return f"1970-01-01T00:00:00.{t_ns:09}"


def expected_row(sample):
    """Q1 Q2 Q3 QC and their derivatives in time, by SciPy and differences."""
    q, ahead, behind = (
        ccsds_quaternion(
            Rotation.from_matrix(to_matrix(propagate(sample.q_icrs_to_cam, RATE_CAM_RAD_S, s)))
        )
        for s in (0.0, DIFFERENCE_S, -DIFFERENCE_S)
    )
    ahead, behind = ahead * np.sign(ahead @ q), behind * np.sign(behind @ q)
    return np.concatenate([q, (ahead - behind) / (2 * DIFFERENCE_S)])


def assert_row(numbers, sample):
    written, expected = np.array(numbers, dtype=float), expected_row(sample)
    sign = np.sign(written[:4] @ expected[:4])
    assert sign * written[:4] == pytest.approx(expected[:4], abs=MATRIX_TOLERANCE)
    assert sign * written[4:] == pytest.approx(expected[4:], abs=DERIVATIVE_TOLERANCE_RAD_S)


def test_kvn_that_is_written_states_all_that_it_means_and_holds_the_numbers(tmp_path):
    write_log(tmp_path / "a.aem", turning_samples(), "TAI")
    lines = (tmp_path / "a.aem").read_text().splitlines()
    assert lines[0].split() == ["CCSDS_AEM_VERS", "=", "1.0"]
    assert [line for line in lines if re.fullmatch("[A-Z_]+", line)] == [
        *("META_START", "META_STOP", "DATA_START", "DATA_STOP"),
        *("META_START", "META_STOP", "DATA_START", "DATA_STOP"),
    ]
    samples = {written_epoch(sample.t_ns): sample for sample in turning_samples()}
    for number, times in enumerate(BLOCKS_NS):
        block = "\n".join(lines).split("META_START")[number + 1]
        meta = dict(re.findall(r"^(\w+) += (.*)$", block, re.MULTILINE))
        epochs = {"START_TIME": written_epoch(times[0]), "STOP_TIME": written_epoch(times[1])}
        assert meta == STATED | epochs | {"OBJECT_NAME": "UNKNOWN", "OBJECT_ID": "UNKNOWN"}
        rows = [
            line.split()
            for line in block.split("DATA_START")[1].split("DATA_STOP")[0].splitlines()
            if line
        ]
        assert [row[0] for row in rows] == list(map(written_epoch, times))
        for epoch, *numbers in rows:
            assert_row(numbers, samples[epoch])


def test_xml_that_is_written_states_all_that_it_means_and_holds_the_numbers(tmp_path):
    """The elements and their order are those of the schema ndmxml-2.0.0-aem-1.0."""
    write_log(tmp_path / "a.xml", turning_samples(), "TAI")
    root = ElementTree.parse(tmp_path / "a.xml").getroot()
    assert (root.tag, root.attrib) == ("aem", {"id": "CCSDS_AEM_VERS", "version": "1.0"})
    assert [child.tag for child in root] == ["header", "body"]
    assert [child.tag for child in root[0]] == ["CREATION_DATE", "ORIGINATOR"]
    samples = {written_epoch(sample.t_ns): sample for sample in turning_samples()}
    for segment, times in zip(root[1], BLOCKS_NS, strict=True):
        metadata, data = segment
        meta = {child.tag: child.text for child in metadata if child.tag != "COMMENT"}
        order = (
            "OBJECT_NAME OBJECT_ID REF_FRAME_A REF_FRAME_B ATTITUDE_DIR TIME_SYSTEM START_TIME"
            " STOP_TIME ATTITUDE_TYPE"
        )
        assert list(meta) == [*order.split(), "QUATERNION_TYPE"]
        assert {key: meta[key] for key in STATED} == STATED
        assert [state.findtext("quaternionDerivative/EPOCH") for state in data] == list(
            map(written_epoch, times)
        )
        for state in data:
            epoch, quaternion, rate = state[0]
            assert [child.tag for child in quaternion] == ["QC", "Q1", "Q2", "Q3"]
            assert [child.tag for child in rate] == ["QC_DOT", "Q1_DOT", "Q2_DOT", "Q3_DOT"]
            numbers = [[float(child.text) for child in part] for part in (quaternion, rate)]
            assert_row(
                [*numbers[0][1:], numbers[0][0], *numbers[1][1:], numbers[1][0]],
                samples[epoch.text],
            )


@pytest.mark.parametrize("form", ["aem", "xml"])
def test_what_is_written_is_read_to_the_last_bit_but_one(tmp_path, form):
    """The conjugate's conjugate is the quaternion itself; a rate goes through its derivative and
    back.
    """
    write_log(tmp_path / f"a.{form}", turning_samples())
    for read_back, sample in zip(read_log(tmp_path / f"a.{form}"), turning_samples(), strict=True):
        assert (read_back.t_ns, read_back.discontinuity) == (sample.t_ns, sample.discontinuity)
        assert read_back.q_icrs_to_cam == pytest.approx(sample.q_icrs_to_cam, abs=MATRIX_TOLERANCE)
        assert read_back.rate_cam_rad_s == pytest.approx(RATE_CAM_RAD_S, abs=MATRIX_TOLERANCE)


def test_quaternions_without_rates_are_written_as_such(tmp_path):
    write_log(tmp_path / "a.xml", [AttitudeSample(7, from_radec_roll_deg(10.0, 5.0, 0.0))])
    root = ElementTree.parse(tmp_path / "a.xml").getroot()
    assert root.findtext("body/segment/metadata/ATTITUDE_TYPE") == "QUATERNION"
    assert root.findtext("body/segment/data/attitudeState/quaternionState/EPOCH") == written_epoch(
        7
    )


@pytest.mark.parametrize("without", [0, 1, 2])
def test_quaternions_of_which_one_has_no_rate_are_written_without(tmp_path, without):
    rates: list[np.ndarray | None] = [np.zeros(3)] * 3
    rates[without] = None
    q = from_radec_roll_deg(10.0, 5.0, 0.0)
    samples = [AttitudeSample(k, q, rate) for k, rate in enumerate(rates)]
    write_log(tmp_path / "a.xml", samples)
    root = ElementTree.parse(tmp_path / "a.xml").getroot()
    assert root.findtext("body/segment/metadata/ATTITUDE_TYPE") == "QUATERNION"


@pytest.mark.parametrize(
    ("begin_s", "scale", "system"),
    [
        (0, None, "SCLK"),
        (-5, None, "SCLK"),
        (946_684_799, None, "SCLK"),
        (1_735_689_600, None, "UTC"),
        (0, "TAI", "TAI"),
        (0, "UTC", "UTC"),
    ],
)
@pytest.mark.parametrize("ending", ["aem", "xml"])
def test_a_log_without_dates_is_not_written_as_utc_of_1970(
    tmp_path, begin_s, scale, system, ending
):
    samples = [
        AttitudeSample((begin_s + k) * 10**9, np.array([1.0, 0.0, 0.0, 0.0])) for k in range(2)
    ]
    path = tmp_path / f"a.{ending}"
    write_log(path, samples, scale)
    assert re.search(r"TIME_SYSTEM\W+(\w+)", path.read_text())[1] == system
    again = open_log(path)
    assert [sample.t_ns for sample in again.samples] == [sample.t_ns for sample in samples]
    assert again.conventions.scale == system
