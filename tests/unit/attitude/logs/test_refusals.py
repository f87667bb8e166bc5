"""Logs that are refused: what is written, and the words of the one line that says so."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from hilstar.attitude.logs.json_lines import MAX_OBJECT_CHARACTERS
from hilstar.attitude.logs.log_file import open_log
from hilstar.attitude.logs.stk import COUNTS, TYPES
from hilstar.basics.reading import MAX_LINE_CHARACTERS
from tests.support.refusals import assert_file_refused
from tests.support.sources.attitude_texts import cic_text, stk_text

Q = "0.6987226,0.7135120,-0.0370377,0.0362700"
OTHER = "0.5,0.5,-0.5,0.5"
HEAD = "t_s,qw,qx,qy,qz\n"
FULL_HEAD = "t_s,qw,qx,qy,qz,rx,ry,rz,sequence,discontinuity\n"


def times(header: str, time: str) -> str:
    return f"{header},qw,qx,qy,qz\n{time},{Q}\n"


DATES = [
    (times("time", "01/02/2024 00:00:00"), ":1: ...write"),
    (times("timestamp", "12:00:00.5"), ":1: ...write"),
    (times("t_s", "2024-02-30T00:00:00"), ":2: ...write"),
    (times("t_s", "2023-366T00:00:00"), ":2: ...write"),
    (times("t_s", "2024-01-01T24:00:01"), ":2: ...write"),
    (times("t_s", "1_000.5"), ":2: ...write"),
    (times("time", "2460310.5"), ":1: ...write"),
]
# words that stand for no blank
NO_NUMBERS = ("1e999", "inf", "#VALUE!", "lost", "0_5", "0.5f", "0x1")
DECIMAL_COMMA_LATE = (
    "t_s;qw;qx;qy;qz\n" + "".join(f"{k};1;0;0;0\n" for k in range(101)) + "200;1,5;0;0;0\n"
)
FINITE = "write finite numbers for t_s"
CSV = [
    ("", "no attitude"),
    (HEAD, "no attitude"),
    ("t_s,qw,qx,qy\n", ":1: ...qz"),
    ("t_s,qw,qx,qy,qz,rx,rz\n", ":1: ...ry"),
    (f"t_s,qw,qx,qy,qz,qw,qx,qy,qz\n0,{Q},{OTHER}\n", ":1: column qw is there twice"),
    (f"t_s,t_s,qw,qx,qy,qz\n0,1,{Q}\n", ":1: column t_s is there twice"),
    (f"t_s,qw,qx,qy,qz,valid,valid\n0,{Q},1,0\n", ":1: column valid is there twice"),
    (f"t_s,qw,qx,qy,qz,rx,ry,rz,rx\n0,{Q},1,2,3,4\n", ":1: column rx is there twice"),
    (times("t", "0"), ":1: column t has no unit; write t_s, or its unit as t [s]"),
    (
        f"0,{Q}\n1,{Q}\n",
        ":1: column t_s is missing, as no line names the columns; the header must have"
        " t_s,qw,qx,qy,qz",
    ),
    ("\n" * 5000 + "x\n", "t_s is missing"),
    (f"{HEAD}0,1,0,0,0\n1,nan,0,0,0\n", ":3: ...not finite"),
    (f"{HEAD}nan,1,0,0,0\n", ":2: ...finite"),
    (f"{HEAD}inf,1,0,0,0\n", ":2: ...finite"),
    (f"{HEAD}0,1,0,0,0\n0,1,0,0,0\n", ":3: ...does not increase"),
    (
        f"{HEAD}100.01,{Q}\n100.01,{Q}\n",
        ":3: time does not increase (t_ns 100010000000 after 100010000000): two attitudes have one",
    ),
    (f"{HEAD}2,{Q}\n1,{Q}\n", "; sort the log by time"),
    (f"{HEAD}0,2,0,0,0\n", ":2: ...norm"),
    (f"{HEAD}0,1,0,0\n", f":2: ...{FINITE}"),
    (f"{HEAD}0,x,0,0,0\n", f":2: ...{FINITE}"),
    (f"{HEAD}0,1,,,\n", ":2: "),
    (f"{HEAD}0,{Q}\n1,,,,\n2,{Q}\n", ":3: ...dropout"),
    *((f"{HEAD}0.0,{','.join([word] * 4)}\n0.2,{Q}\n", ":2: ") for word in NO_NUMBERS),
    (HEAD + 999 * "9" + ",y\n", f":2: ...{FINITE}"),
    (f"{HEAD}1e999999999,1,0,0,0\n", f":2: ...{FINITE}"),
    (f"{HEAD}1e30,1,0,0,0\n", ":2: ...64 bits"),
    (f"{HEAD}9223372036.854775808,1,0,0,0\n", ":2: ...64 bits"),
    (
        f"{HEAD}1763800000000,{Q}\n",
        ":2: t_s = 1763800000000 s does not fit 64 bits of ns; t_s is in seconds; name",
    ),
    (f"{FULL_HEAD}0,1,0,0,0,1,,3,0,0\n", ":2: ...all of rx,ry,rz or none"),
    (f"{FULL_HEAD}0,1,0,0,0,,,,1.5,0\n", ":2: ...whole number"),
    (f"{FULL_HEAD}0,1,0,0,0,,,,1{30 * '0'},0\n", ":2: ...whole number"),
    (f"{FULL_HEAD}0,1,0,0,0,,,,0,yes\n", ":2: ...0 or 1"),
    (
        f"{HEAD}0,0,7,0,7,0,0\n",
        ":2: 7 cells and 5 columns (a decimal comma, or commas between thousands?",
    ),
    (f"{HEAD}0,{Q},5\n", ":2: 6 cells and 5 columns"),
    (f"t_s,qw,qx,qy,qz,valid\n0,{Q},maybe\n", ":2: valid = 'maybe'; write 1 or 0"),
    (DECIMAL_COMMA_LATE, ":103: '200;1,5;0;0;0' (a decimal comma: write a point)"),
    *DATES,
    ("\xff\xfe", "contains no attitude"),  # UTF-16 of nothing
    ("\x00\xff\xfe", "it is no text: line 1 has a byte 0x00"),
    ("CCSDS_OEM_VERS = 2.0\n", "CCSDS_AEM_VERS is read"),
]
ROWS: list[dict[str, Any]] = [
    {"t_ns": k * 10**7, "q": [0.5, -0.5, 0.5, 0.5], "note": 'a } " { [ \\'} for k in range(4)
]
NOT_UNIT = {"t_ns": 10**9, "q": [1, 1, 0, 0]}
NO_QUATERNION = ("null", "[null, null, null, null]", "[NaN, NaN, NaN, NaN]")
BLANK = '{"t_ns": 0, "q": %s}\n'
SET = f'{{"t_ns": 5, "q": [{Q}]}}\n'


def lines(rows: list[dict[str, Any]]) -> str:
    return "".join(json.dumps(row) + "\n" for row in rows)


JSON = [
    ('{"t_ns":1}\n', ":1: ...q"),
    ('{"t_ns":1,"q":[1,0,0,0]}\n{"t_ns":2,"q":[NaN,0,0,0]}\n', ":2: ...NaN"),
    ('{"t_ns":1,"q":[1,0,0,0]}\nnonsense\n', ":2: ...JSON"),
    (f'{{"t_ns":1,"q":[{Q}],"q":[{OTHER}]}}\n', ':1: key "q" is there twice'),
    (f'{{"t_ns":1,"t_ns":2,"q":[{Q}]}}\n', ':1: key "t_ns" is there twice'),
    *((SET + BLANK % q, ":2: ...dropout") for q in NO_QUATERNION),
    (f'{SET}{{"t_ns":5,"q":[1,0,0,0]\n{SET.replace("5", "9", 1)}', ":2: "),
    (lines([{**ROWS[0], "valid": "maybe"}]), ":1: valid is 'maybe'; write true or false"),
    (lines([{**ROWS[0], "valid": None}]), ":1: valid is "),
    (json.dumps([*ROWS, NOT_UNIT]), ":1, object 5: the quaternion's norm is 1.41421"),
    (json.dumps([*ROWS, NOT_UNIT], indent=0), ", object 5: the quaternion's norm is 1.41421"),
    (lines(ROWS[:1])[:-30] + "\n" + lines(ROWS[1:]), ":1: "),
    (lines(ROWS[:1]) + "nonsense\n" + lines(ROWS[1:]), ":2: 'nonsense' is no JSON object; write"),
    ("[[0, 1, 0, 0, 0],\n [1, 1, 0, 0, 0]]", "is no JSON object; write JSON lines, or an array"),
    (
        json.dumps({"attitudes": ROWS}),
        ':1: key "t_ns" is there twice (an object without an end, or',
    ),
    (
        "{" * 3 * MAX_LINE_CHARACTERS,
        f":1: a JSON object of over {MAX_OBJECT_CHARACTERS} characters",
    ),
    ('{"a": "' + "x" * 3 * MAX_LINE_CHARACTERS, ":1: a JSON object of over"),
    ("[]", ": contains no attitude"),
    ("[" * MAX_LINE_CHARACTERS, ": contains no attitude"),
]
ALNILAM = "0.6987226 -0.7135120 0.0370377 -0.0362700"
CIC_WHOLE = cic_text([f"60310 0.0 {ALNILAM}", f"60310\t10.25\t{ALNILAM}"])


def cic(old: str, new: str) -> str:
    assert old in CIC_WHOLE
    return CIC_WHOLE.replace(old, new)


def cic_kind(more: str) -> str:
    """With lines behind the type."""
    return cic("ATTITUDE_TYPE = QUATERNION", f"ATTITUDE_TYPE = QUATERNION\n{more}")


def cic_direction(line: str) -> str:
    return cic("ATTITUDE_DIR = A2B", line)


def cic_time(text: str) -> str:
    return cic("60310 0.0", text)


CIC_ANGLES = cic("ATTITUDE_TYPE = QUATERNION", "ATTITUDE_TYPE = EULER_ANGLE")
CIC = [
    (CIC_ANGLES, ":13: ATTITUDE_TYPE = EULER_ANGLE of a CIC AEM is not"),
    # by their type and not by their count
    (
        CIC_ANGLES.replace(ALNILAM, "10.0 20.0 30.0"),
        ":13: ATTITUDE_TYPE = EULER_ANGLE of a CIC AEM is not",
    ),
    (
        cic_kind("QUATERNION_TYPE = LAST"),
        ":14: QUATERNION_TYPE = LAST, where CIC has the real part first and writers differ...add"
        " what its columns are: COMMENT q1, q2, q3, q0 (real part), or COMMENT q0 (real",
    ),
    (
        cic_kind("COMMENT q1 q2 q3 q0\nQUATERNION_TYPE = FIRST"),
        ":15: QUATERNION_TYPE = FIRST, and a comment has the real part last",
    ),
    (cic_kind("QUATERNION_TYPE = MIDDLE"), ":14: QUATERNION_TYPE = MIDDLE; write FIRST or LAST"),
    (
        cic("REF_FRAME_A = EME2000", "REF_FRAME_A = LVLH"),
        "REF_FRAME_A = LVLH, REF_FRAME_B = SC_BODY_1; one must be",
    ),
    (cic_direction(""), "ATTITUDE_DIR is missing in the metadata"),
    (cic_direction("ATTITUDE_DIR = A2C"), "ATTITUDE_DIR is A2C; write A2B or B2A"),
    (cic_direction("ATTITUDE_DIR = A2B\nATTITUDE_DIR = B2A"), ":12: ATTITUDE_DIR appears twice"),
    (cic_direction("ATTITUDE_DIR = A2B\nATTITUDE_DIR = A2B"), ":12: ATTITUDE_DIR appears twice"),
    (
        cic_direction("ATTITUDE_DIRECTION = A2B"),
        ":11: ATTITUDE_DIRECTION is no keyword that is read here",
    ),
    (cic("CIC_AEM_VERS = 1.0", "CIC_AEM_VERS = 3.0"), "CIC_AEM_VERS is 3.0; write 1.0 or 2.0"),
    (cic_time("27028 0.0"), ":17: the day 27028 is no modified Julian day from 36115 (1957)"),
    # 2100-01-01 is 88069: 36525 days after 2000-01-01, which is 51544
    (cic_time("88069 0.0"), ":17: the day 88069 is no modified...(1957) to 88068 (2099); days"),
    (cic_time("60310.5 0.0"), ":17: the day 60310.5 is no whole number"),
    (cic_time("60310 86401"), ":17: 86401 are no seconds of a day"),
    (cic_time("60310 -1"), ":17: -1 are no seconds of a day"),
    (cic_time("60310"), "has 5 numbers; write the modified Julian day"),
    (cic_time("60310 zero"), "write the modified Julian day, its seconds and the quaternion"),
    (cic_time("60310 20"), ":18: time does not increase"),
    (cic("META_STOP", ""), ":17: "),
    (
        cic("META_STOP", "META_START"),
        ":15: META_START in the metadata; META_START and META_STOP take turns",
    ),
    (cic(ALNILAM, "0.5 0.5 0.5 0.6"), ":17: the quaternion's norm is 1.05357"),
    (CIC_WHOLE.split("META_STOP")[0], "the file ends in its metadata; is it cut off"),
    (CIC_WHOLE.split("META_START")[0], "the file ends in its header; is it cut off"),
]
STK_ROWS = [f"{k} 0 0 0 1" for k in range(3)]
STK_WHOLE = stk_text(STK_ROWS)
COUNT = "NumberOfAttitudePoints"


def stk(old: str, new: str) -> str:
    assert old in STK_WHOLE
    return STK_WHOLE.replace(old, new)


def stk_axes(line: str) -> str:
    return stk("CoordinateAxes J2000", line)


def stk_body(line: str) -> str:
    return stk("CentralBody Earth", line)


def stk_form(line: str) -> str:
    return stk("AttitudeTimeQuaternions", line)


def stk_epoch(date: str) -> str:
    return stk("1 Jan 2025 00:00:00.000", date)


def stk_row(row: str) -> str:
    return stk("1 0 0 0 1", row)


def stk_matrix(numbers: str) -> str:
    return stk_text([f"0 {numbers}"], "AttitudeTimeDCM")


def stk_angles(sequence: str | None) -> str:
    return stk_text(["0 1 2 3"], "AttitudeTimeEulerAngles", Sequence=sequence)


THIRD = "0.5773503 0.5773503 0.5773503"
NO_MATRIX = ":9: the nine numbers are no rotation matrix by rows"
MARS_FIXED = stk_text(STK_ROWS, CentralBody="Mars", CoordinateAxes="Fixed")
UNDATED_FIXED = stk_text(["1 0 0 0 1"], ScenarioEpoch=None, CoordinateAxes="Fixed")
# A short row of a long form left a time and its other numbers, and so a traceback.
SHORT_ROWS = [
    (
        stk_text([" ".join(["0"] * (count + 1))], form, Sequence="321"),
        f":10: ...: write a time and {COUNTS[form]} numbers for",
    )
    for form in TYPES
    for count in range(COUNTS[form])
]
STK = [
    (stk_axes("CoordinateAxes AWB UpWestSouth Sat/A"), ":7: CoordinateAxes AWB UpWestSouth Sat"),
    (
        stk_axes("CoordinateAxes TEMEOfEpoch"),
        ":7: CoordinateAxes TEMEOfEpoch are not read; write J2000",
    ),
    (stk_axes(""), "states no CoordinateAxes; write CoordinateAxes and J2000"),
    (stk_axes("CoordinateSystem J2000"), ":7: CoordinateSystem is not read; did you mean Coordin"),
    (stk_body("CentralBody Mars\nCoordinateAxes Fixed"), ":8: CoordinateAxes is there twice"),
    (
        stk_body("CoordinateAxesEpoch 1 Jan 2025"),
        ":6: CoordinateAxesEpoch is not read; did you mean",
    ),
    (stk_body("RepeatPattern"), f":6: RepeatPattern is not read; read are {COUNT}"),
    (stk_body("CentralBody Earth\nCentralBody Earth"), ":7: CentralBody is there twice"),
    (stk_body("TimeFormat LCLG"), ":6: TimeFormat lclg is not read; write EpSec, EpMin"),
    (
        stk("BEGIN Attitude", "BEGIN Ephemeris"),
        ":3: 'BEGIN Ephemeris' where BEGIN Attitude belongs",
    ),
    (stk_form("AttitudeTimeYPRAngles"), ":8: AttitudeTimeYPRAngles is not read; write one of Att"),
    (stk_form("AttitudeTimeECIVector"), ":8: AttitudeTimeECIVector is not read"),
    (stk_form("AttitudeTimeEulerAngles"), ":9: '0 0 0 0 1': write a time and 3 numbers"),
    (stk_epoch("1 Foo 2025 00:00:00"), ":5: the date is '1 Foo 2025 00:00:00'; write it as 1 Jan"),
    (stk_epoch("31 Feb 2025 00:00:00"), ":5: the date is '31 Feb 2025 00:00:00'"),
    (stk_row("1 0 0 0"), ":10: '1 0 0 0': write a time and 4 numbers"),
    (stk_row("one 0 0 0 1"), ":10: the time is 'one'"),
    (stk_row("1 0 0 0 x"), ":10: '1 0 0 0 x'"),
    (stk_row("1 0 0 0 2"), ":10: the quaternion's norm is 2"),
    (stk("2 0 0 0 1", "1 0 0 0 1"), ":11: time does not increase"),
    (stk("END Attitude", "END Attitude\nmore"), ":13: 'more' after END Attitude"),
    (stk(f"{COUNT} 3", f"{COUNT} many"), f":4: {COUNT} is no count"),
    (stk(f"{COUNT} 3", f"{COUNT} 0"), f":4: {COUNT} is no count"),
    (UNDATED_FIXED, "states no ScenarioEpoch; write it as 1 Jan 2025"),
    (MARS_FIXED, ":7: CoordinateAxes fixed of CentralBody Mars are not read; write J2000"),
    (stk_matrix(f"{THIRD} {THIRD} {THIRD}"), NO_MATRIX),
    (stk_matrix("1 0 0 0 1 0 0 0 -1"), NO_MATRIX),
    (stk_matrix("2 0 0 0 2 0 0 0 2"), NO_MATRIX),
    (stk_matrix("nan 0 0 0 1 0 0 0 1"), NO_MATRIX),
    (stk_angles("322"), ":8: Sequence is 322; write three axes such as 321"),
    (stk_angles("421"), ":8: Sequence is 421; write three axes such as 321"),
    (stk_angles("32"), ":8: Sequence is 32; write three axes such as 321"),
    (stk_angles(None), "Sequence is missing"),
    *SHORT_ROWS,
]


def assert_text_refused(path: Path, text: str, words: str) -> None:
    """A text is refused as a log, with words; a character is a byte."""
    path.write_bytes(text.encode("latin-1"))
    assert_file_refused(open_log, path, words)


TABLES, MESSAGES = [*CSV, *JSON], [*CIC, *STK]


@pytest.mark.parametrize(("text", "words"), TABLES, ids=[words[:60] for _, words in TABLES])
def test_a_table_or_json_that_is_no_log_is_refused_in_one_line_with_its_place(
    tmp_path, text, words
):
    assert_text_refused(tmp_path / "log", text, words)


@pytest.mark.parametrize(("text", "words"), MESSAGES, ids=[words[:60] for _, words in MESSAGES])
def test_an_attitude_file_that_is_wrong_is_refused_in_one_line_with_its_place(
    tmp_path, text, words
):
    assert_text_refused(tmp_path / "log", text, words)
