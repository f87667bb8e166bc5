"""CNES's CIC AEM, as the tools around VTS write it: the same attitudes as a CCSDS AEM."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hilstar.attitude.logs.log_file import open_log
from hilstar.basics.rotation import to_radec_roll_deg
from tests.support.sources.aem_messages import kvn
from tests.support.sources.attitude_texts import cic_text

ROUNDING = 1e-15
DAY_NS = 1_704_067_200 * 10**9  # 2024-01-01T00:00:00, MJD 60310
ALNILAM = "0.6987226 -0.7135120 0.0370377 -0.0362700"
ROWS = [f"60310 0.0 {ALNILAM}", f"60310\t10.25\t{ALNILAM}"]
WHOLE = cic_text(ROWS)


@pytest.fixture
def cic_log(tmp_path):
    def opened(text):
        path = tmp_path / "a.txt"
        path.write_text(text)
        return open_log(path)

    return opened


def test_a_day_with_a_leap_second_has_86401_seconds(cic_log):
    """31 December 2016, MJD 57753; in days of 86400 s its last second is the next day's first."""
    rows = [f"57753 86399.0 {ALNILAM}", f"57753 86400.5 {ALNILAM}", f"57754 1.0 {ALNILAM}"]
    begin_ns = 1_483_228_800 * 10**9  # 2017-01-01T00:00:00
    times_ns = [sample.t_ns - begin_ns for sample in cic_log(cic_text(rows)).samples]
    assert times_ns == [-(10**9), 10**9 // 2, 10**9]


def test_the_real_part_comes_first_and_times_are_days_and_seconds(cic_log):
    found = cic_log(WHOLE)
    assert [sample.t_ns for sample in found.samples] == [DAY_NS, DAY_NS + 10_250_000_000]
    assert to_radec_roll_deg(found.samples[0].q_icrs_to_cam)[:2] == pytest.approx(
        (84.057, -1.2), abs=1e-5
    )
    assert found.conventions.of_body and found.conventions.scale == "UTC"
    assert "scalar first (q0, q1, q2, q3)" in found.conventions.scalar


@pytest.mark.parametrize("direction", ["A2B", "B2A"])
@pytest.mark.parametrize("frame", ["EME2000", "ICRF", "ITRF", "TEME"])
@pytest.mark.parametrize("scale", ["UTC", "TAI"])
def test_attitudes_are_those_of_an_aem_of_the_same_numbers(
    tmp_path, cic_log, direction, frame, scale
):
    x, y, z, w = Rotation.from_euler("xyz", [10, 20, 30], degrees=True).as_quat()
    meta = {"ATTITUDE_DIR": direction, "REF_FRAME_A": frame, "TIME_SYSTEM": scale}
    found = cic_log(cic_text([f"60310 {s} {w} {x} {y} {z}" for s in (0, 1)], **meta))
    (tmp_path / "b.aem").write_text(
        kvn(
            [f"2024-01-01T00:00:0{s} {x} {y} {z} {w}" for s in (0, 1)],
            QUATERNION_TYPE="LAST",
            **meta,
        )
    )
    wanted = open_log(tmp_path / "b.aem")
    for one, other in zip(found.samples, wanted.samples, strict=True):
        assert one.t_ns == other.t_ns
        assert one.q_icrs_to_cam == pytest.approx(other.q_icrs_to_cam, abs=ROUNDING)
    assert found.conventions.scale == scale


def test_what_writers_have_besides_is_read(cic_log):
    text = cic_text(
        ROWS, QUATERNION_TYPE="FIRST", CENTER_NAME="EARTH", START_TIME="2024-01-01T00:00:00"
    )
    others = [
        text,
        text.replace("CIC_AEM_VERS = 1.0", "CIC_AEM_VERS = 2.0"),
        text.replace("META_STOP", "USER_DEFINED_CONTENT = STAR TRACKER\nMETA_STOP"),
        text.replace("60310 0.0", "2024-01-01T00:00:00"),
        text.replace("\n", "\r\n"),
        cic_text(
            ROWS, comment="days (MJD), sec (UTC), q0: real part, q1, q2, q3", QUATERNION_TYPE="LAST"
        ),
    ]
    for other in others:
        assert [sample.t_ns for sample in cic_log(other).samples] == [
            DAY_NS,
            DAY_NS + 10_250_000_000,
        ]
    unnamed = cic_log(cic_text(ROWS, REF_FRAME_B="UNDEFINED"))
    assert (
        dict(unnamed.told)["log-frame"]
        == "REF_FRAME_B = UNDEFINED is taken as the spacecraft's body"
    )


@pytest.mark.parametrize("stated", ["LAST", None])
@pytest.mark.parametrize(
    "comment",
    ["q1, q2, q3, q0 (real part)", "days (MJD), sec (UTC), Q1 Q2 Q3 QC", "x: q1 y: q2 z: q3 w: q4"],
)
def test_a_real_part_that_a_comment_has_last_is_read_there_and_that_is_said(
    cic_log, stated, comment
):
    w, x, y, z = ALNILAM.split()
    rows = [f"60310 {seconds} {x} {y} {z} {w}" for seconds in (0, 1)]
    found = cic_log(cic_text(rows, comment=comment, QUATERNION_TYPE=stated))
    first = cic_log(cic_text([f"60310 {seconds} {ALNILAM}" for seconds in (0, 1)]))
    for one, other in zip(found.samples, first.samples, strict=True):
        assert one.q_icrs_to_cam.tolist() == other.q_icrs_to_cam.tolist()
    assert "the real part is the last of four" in "".join(text for _, text in found.told)


def test_several_segments_follow_each_other(cic_log):
    second = cic_text([f"60311 0 {ALNILAM}"])
    found = cic_log(WHOLE + second[second.index("META_START") :])
    assert [sample.discontinuity for sample in found.samples] == [False, False, True]
    assert np.diff([sample.t_ns for sample in found.samples])[1] == 86_400 * 10**9 - 10_250_000_000


def test_each_segment_has_its_real_part_where_its_own_comment_has_it(cic_log):
    """Read as the first's, the second's attitude is another one: w, x, y and z differ."""
    w, x, y, z = ALNILAM.split()
    second = cic_text([f"60311 0 {x} {y} {z} {w}"], comment="q1, q2, q3, q0 (real part)")
    found = cic_log(WHOLE + second[second.index("META_START") :])
    first, _, last = (sample.q_icrs_to_cam.tolist() for sample in found.samples)
    assert first == last
