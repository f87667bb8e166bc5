"""CCSDS AEM that are refused: what is written, and the words of the one line that says so."""

from __future__ import annotations

import re

import pytest

from hilstar.attitude.logs import aem
from hilstar.attitude.logs.log_file import read_log
from hilstar.basics.errors import InputError
from tests.support.refusals import assert_file_refused
from tests.support.sources.aem_messages import (
    EPOCHS,
    angle_elements,
    in_xml,
    joined,
    kvn,
    overlapping,
    read,
    rows_of,
    useable,
    xml_of,
)

UPRIGHT = rows_of([0, 0, 0, 1])
GOOD = kvn(rows_of([0, 0, 0, 1], [0, 0, 0, 1]))


def good(old: str, new: str) -> str:
    assert old in GOOD
    return GOOD.replace(old, new, 1)


def keyword(**keywords: str | None) -> str:
    """With other keywords; None leaves one out."""
    return kvn(UPRIGHT, **keywords)


def rates(**keywords: str) -> str:
    rows = rows_of([0, 0, 0, 1, 0, 0, 0])
    return kvn(rows, **({"ATTITUDE_TYPE": "QUATERNION/RATE"} | keywords))


NO_EPOCHS = (
    "2024-02-30T00:00:00",
    "2023-366T00:00:00",
    "2024-000T00:00:00",
    "2024-01-01T24:00:00",
    "2024-01-01T00:60:00",
    "2024-01-01T00:00:60",
    "0000-01-01T00:00:00",
    "2024-01-01T00:00:00+01:00",
    "2024-01-01_00:00:00",
    "2024-1-1T00:00:00",
    "12.5",
)
LATE = "2262-04-11T23:47:16.854775808 0 0 0 1"
TWO_BLOCKS = overlapping(([0, 10], {}), ([20, 30], {}))
BLOCKS = [
    *((kvn([f"{epoch} 0 0 0 1"]), ":17: ") for epoch in NO_EPOCHS),
    (kvn([LATE]), "64 bits"),
    (overlapping(([0, 20, 10], {}), ([15, 30], {})), "time does not increase"),
    (
        overlapping(([0, 20], useable(20, 5)), ([15, 30], {})),
        "USEABLE_STOP_TIME is before USEABLE_START_TIME",
    ),
    (
        overlapping(([0, 20], {"USEABLE_START_TIME": "soon"}), ([15, 30], {})),
        "the epoch is 'SOON'",
    ),
    (joined(GOOD, keyword(TIME_SYSTEM="TAI")), "TIME_SYSTEM changes"),
    (
        joined(GOOD, keyword(REF_FRAME_B="STARTRACKER_1").replace("2024-02-29", "2024-02-28")),
        "the spacecraft's frame changes from block to block",
    ),
]
ALL_TYPES = "QUATERNION, QUATERNION/DERIVATIVE, QUATERNION/"
KEYWORDS = [
    *(
        (
            kvn(UPRIGHT, version, ATTITUDE_TYPE=kind),
            f"ATTITUDE_TYPE = {kind}...{ALL_TYPES}{turning}",
        )
        for version, turning in (("1.0", "RATE"), ("2.0", "ANGVEL"))
        for kind in ("SPIN/NUTATIONS", "EULER", "DCM")
    ),
    (keyword(ATTITUDE_DIR=None), "ATTITUDE_DIR is missing; write A2B or B2A"),
    (keyword(ATTITUDE_DIR="UP"), "ATTITUDE_DIR is UP"),
    (keyword(QUATERNION_TYPE=None), "QUATERNION_TYPE is missing; write FIRST or LAST"),
    (keyword(TIME_SYSTEM=None), "TIME_SYSTEM is missing"),
    (keyword(REF_FRAME_A=None), "REF_FRAME_A is missing"),
    (keyword(ATTITUDE_TYPE=None), "ATTITUDE_TYPE is missing"),
    (keyword(ATTITUDE_TYPE="QUATERNION/RATE"), "an epoch and 7 numbers"),
    (rates(), "RATE_FRAME is missing; write ICRF or SC_BODY_1"),
    (rates(RATE_FRAME="INSTRUMENT_A"), "RATE_FRAME is INSTRUMENT_A"),
    (rates(RATE_FRAME="REF_FRAME_B", EULER_ROT_SEQ="321"), "rates of Euler angles are not read"),
    (
        good("QUATERNION_TYPE = LAST", "QUATERNION_TYP = FIRST"),
        ":10: QUATERNION_TYP is not a keyword ...; did you mean QUATERNION_TYPE",
    ),
    (
        good("ATTITUDE_DIR = A2B", "ATTITUDE_DIRECTION = B2A"),
        ":9: ATTITUDE_DIRECTION is not a keyword ...; did you mean ATTITUDE_DIR",
    ),
    (
        good("OBJECT_NAME = X", "object_name = X"),
        ":5: object_name is not a keyword ...; did you mean OBJECT_NAME",
    ),
    (
        good("OBJECT_NAME = X", "WINDSPEED = 3"),
        ":5: WINDSPEED is not a keyword ...; the keywords are OBJECT_NAME, ",
    ),
    (
        good("ORIGINATOR = X", "ORIGINATOR = X\nATTITUDE_DIR = B2A"),
        ":4: ATTITUDE_DIR is in the header; it belongs in the metadata",
    ),
    (
        good("ATTITUDE_DIR = A2B", "ATTITUDE_DIR = A2B\nATTITUDE_DIR = B2A"),
        ":10: ATTITUDE_DIR appears twice",
    ),
    (
        good("META_START", "META_START\nORIGINATOR = Y"),
        ":5: ORIGINATOR is in the metadata; it belongs in the header",
    ),
]
MESSAGES = [
    (good("VERS = 1.0", "VERS = 3.0"), "CCSDS_AEM_VERS is 3.0; write 1.0 or 2.0"),
    (good("DATA_STOP\n", ""), ":18: ...cut off"),
    # after a block that is whole, in the second one's data and in its metadata
    (TWO_BLOCKS.removesuffix("DATA_STOP\n"), "with 1 complete blocks of data; is it cut off?"),
    (TWO_BLOCKS[: TWO_BLOCKS.rindex("META_STOP")], "ends in the metadata, with 1 complete"),
    (GOOD[: GOOD.index("META_STOP")], ":14: ...the file ends in the metadata"),
    ("CCSDS_AEM_VERS = 1.0\n", ":1: ...with 0 complete blocks"),
    (good("DATA_START\n", ""), ":16: ...in the gap before DATA_START"),
    (good("META_STOP", "DATA_START"), ":15: ...DATA_START in the metadata"),
    (good("0.0 1.0\n", "0.0 1.0 0.0\n"), ":17: ...an epoch and 4 numbers"),
    (good("0.0 1.0\n", "0.0\n"), ":17: ...an epoch and 4 numbers"),
    (good("0.0 1.0\n", "0.0 one\n"), ":17: ...an epoch and 4 numbers"),
    (good("0.0 1.0\n", "0.0 inf\n"), ":17: ...not finite"),
    (good("0.0 1.0\n", "0.0 1e308\n"), ":17: ...norm"),
    (good("0.0 1.0\n", "0.0 0.5\n"), ":17: ...norm"),
    (GOOD.replace(EPOCHS[1], EPOCHS[0]), ":18: ...does not increase"),
    (good("OBJECT_ID = X", "OBJECT_ID"), ":6: ...KEYWORD = value"),
    (kvn([]), ":17: ...contains no attitude"),
]
# Frames that are neither the stars', nor the Earth's, nor a body's.
NO_FRAMES = ("ITRF-9", "ITRFX", "GRC", "GTOD", "TEMEOFEPOCH", "TDR", "B1950", "ICRF4", "EME")
NO_BODIES = ("RTN", "RSW", "TNW", "LVLH", "QSW", "NTW", "VNC", "ICRF", "EME2000", "GCRF")
NO_BODIES += ("SATELLITE", "ASTRO", "CAMEL", "X")
PAIRS = [
    *((frame, "SC_BODY_1") for frame in NO_FRAMES),
    *(("ICRF", frame) for frame in NO_BODIES),
    ("SC_BODY_1", "RTN"),
]
FRAMES = [
    (
        keyword(REF_FRAME_A=first, REF_FRAME_B=second),
        f"REF_FRAME_A = {first}, REF_FRAME_B = {second}; one must be ICRF, EME2000, MOD",
    )
    for pair in PAIRS
    for first, second in (pair, pair[::-1])
]
OF_DATE = [
    (
        kvn(["2024-02-29T23:59:59.25 0 0 0 1"], "2.0", REF_FRAME_A="ITRF", TIME_SYSTEM="UT1"),
        "TIME_SYSTEM = UT1 does not tell UTC",
    ),
    (kvn(["9999-01-01T00:00:00 0 0 0 1"], "2.0", REF_FRAME_A="TEME"), "do not fit 64 bits"),
]


def angles(sequence: str | None) -> str:
    row = rows_of([10, 20, -30])
    meta = {"ATTITUDE_TYPE": "EULER_ANGLE", "QUATERNION_TYPE": None, "EULER_ROT_SEQ": sequence}
    return kvn(row, **meta)


XYZ = f"<rotationAngles>{angle_elements('angle', 'XYZ')}</rotationAngles>"
ANGLES = [
    *(
        (
            angles(names),
            f"EULER_ROT_SEQ is {names or 'missing'}; write three axes such as 321 or ZYX",
        )
        for names in (None, "7051995", "ZZX", "12", "ABC", "3211")
    ),
    (
        xml_of(angles("321"), [f"<eulerAngle><EPOCH>{EPOCHS[0]}</EPOCH>{XYZ}</eulerAngle>"]),
        "rotation1 is the X_ANGLE, and EULER_ROT_SEQ has Z_ANGLE there",
    ),
]
GOOD_XML = in_xml(kvn([f"1970-01-01T00:00:00.00000000{k} 0.0 0.0 0.0 1.0" for k in range(3)]))
NO_AEM = "not an AEM in XML"


def xml(old: str, new: str) -> str:
    assert old in GOOD_XML
    return GOOD_XML.replace(old, new, 1)


def line_of_xml(tag: str) -> int:
    """The line, from 1, of an element."""
    return GOOD_XML[: GOOD_XML.index(tag)].count("\n") + 1


XML = [
    ("<aem", ":1: ...not well-formed"),
    (GOOD_XML[: len(GOOD_XML) // 2], "not well-formed"),
    ("<aem/>", NO_AEM),
    ("<html><body/></html>", NO_AEM),
    ('<aem id="CCSDS_AEM_VERS" version="1.0"/>', NO_AEM),
    (xml("<QC>1.0<", "<QC>one<"), NO_AEM),
    (xml("<QC>1.0</QC>", ""), NO_AEM),
    (xml("<QC>1.0</QC>", "<QC>1.0</QC><QC>0.0</QC>"), NO_AEM),
    (
        "<QC>2.0</QC>".join(GOOD_XML.rsplit("<QC>1.0</QC>", 1)),
        ", 1970-01-01T00:00:00.000000002: the quaternion's norm",
    ),
    (xml("QUATERNION<", "QUATERNION/DERIVATIVE<"), "is not the QUATERNION/DERIVATIVE"),
    (
        GOOD_XML.replace("QUATERNION_TYPE>", "QUATERNION_TYP>"),
        f":{line_of_xml('<QUATERNION_TYPE>')}: QUATERNION_TYP is not a keyword of an AEM's"
        " metadata; did you mean",
    ),
    (xml("<metadata>", "<metadata>QUATERNION_TYPE"), "'QUATERNION_TYPE' stands in <metadata>"),
    (xml("<data>", "<data>1 0 0 0"), "'1 0 0 0' stands in <data>"),
    (xml("<quaternion>", "<quaternion>1"), "'1' stands in <quaternion>"),
    (xml("<Q1>", '<Q1 units="deg">'), "<Q1> in 'deg'; write no units"),
    (xml("<Q1>", '<Q1 scale="2">'), "<Q1> has no scale"),
    (
        xml("<QUATERNION_TYPE>LAST", "<QUATERNION_TYPE>LEAST"),
        "QUATERNION_TYPE is LEAST; write FIRST or LAST",
    ),
    (
        xml("<TIME_SYSTEM>", "<TIME_SYSTEM>TAI</TIME_SYSTEM><TIME_SYSTEM>"),
        "TIME_SYSTEM appears twice in the metadata",
    ),
    (xml("<quaternion>", "<quaternion/><quaternion>"), "has no place in a <quaternionState>"),
    (xml("<EPOCH>", "<EPOCH>1970-01-01T00:00:00</EPOCH><EPOCH>"), "has one EPOCH"),
    (xml("<attitudeState>", "<state/><attitudeState>"), "<state> where <COMMENT> belongs"),
    (xml("</segment>", "<data/></segment>"), "one <metadata>, then one <data>"),
    (xml("</body>", "</body><body/>"), "one <header>, then one <body>"),
    (xml('id="CCSDS_AEM_VERS"', 'id="CCSDS_OEM_VERS"'), 'no id="CCSDS_AEM_VERS"'),
    (xml('version="1.0">', 'version="3.0">'), "CCSDS_AEM_VERS is 3.0; write 1.0 or 2.0"),
    (xml("<aem", "<oem").replace("</aem", "</oem"), "<oem> where <aem> or <ndm> belongs"),
    ("<ndm></ndm>", "the <ndm> contains 0 <aem>; write one"),
    (
        f"<ndm>{2 * GOOD_XML[GOOD_XML.index('<aem') :]}</ndm>",
        "the <ndm> contains 2 <aem>; write one",
    ),
]
HEAD = '<aem id="CCSDS_AEM_VERS" version="1.0">'
ONE_OVERLAPPING = overlapping(([0, 20], {}))
# What is made to fill the memory: seconds of CPU.
LARGE = [
    (
        joined(ONE_OVERLAPPING, *[ONE_OVERLAPPING] * aem.MAX_OVERLAPPING),
        "1001 segments overlap, and 1000 may",
    ),
    (f"{HEAD}<header>" + "<COMMENT/>\n" * 100_001, "too many"),
    ("<ndm><oem>" + "<a/>\n" * 100_001, "too many"),
    (f"{HEAD}<header " + "a=_\n" * 300_000 + "/></aem>", "a million characters"),
    (
        f"{HEAD}<header><COMMENT>" + "x\n" * 500_001 + "</COMMENT></header></aem>",
        "a million characters",
    ),
]
# What is made to fill the memory, or to read other files, in few bytes.
HOSTILE = [
    (f"{HEAD}<body>{'<segment>' * 30}", "nested too deep"),
    ('<!DOCTYPE aem [<!ENTITY x "y">]>' + f"{HEAD}&x;</aem>", "DOCTYPE"),
    ('<!DOCTYPE aem SYSTEM "file:///etc/passwd"><aem/>', "has a DOCTYPE"),
    (
        '<?xml version="1.0"?><!DOCTYPE a [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]><aem>&b;</aem>',
        "has a DOCTYPE",
    ),
    (f"{HEAD}&b;</aem>", "not well-formed XML (undefined entity)"),
]
# 504.0-B-2 annex J
OTHER_VERSIONS = [
    ("2.0", "ATTITUDE_DIR", "B2A", "2.0 always turns from REF_FRAME_A to REF_FRAME_B"),
    ("2.0", "QUATERNION_TYPE", "FIRST", "2.0 always has the scalar last"),
    ("2.0", "RATE_FRAME", "SC_BODY_1", "2.0 has ANGVEL_FRAME"),
    ("1.0", "ANGVEL_FRAME", "SC_BODY_1", "1.0 has RATE_FRAME"),
]


def of_other_version(version: str, key: str, value: str, other: str) -> list[tuple[str, str]]:
    """The rows of a keyword of the other version, in KVN and in XML."""
    own = {"1.0": "2.0", "2.0": "1.0"}[version]
    words = f"{key} is of AEM {own}, and CCSDS_AEM_VERS is {version}; {other}"
    text = kvn(UPRIGHT, version, **{key: value})
    line = text[: text.index(key)].count("\n") + 1
    return [(text, f":{line}: {words}"), (in_xml(text), words)]


REFUSED = [
    *BLOCKS,
    *KEYWORDS,
    *MESSAGES,
    *FRAMES,
    *OF_DATE,
    *ANGLES,
    *XML,
    *HOSTILE,
    *(row for case in OTHER_VERSIONS for row in of_other_version(*case)),
]


@pytest.mark.parametrize(("text", "words"), REFUSED, ids=[words[:60] for _, words in REFUSED])
def test_a_message_that_is_wrong_is_refused_in_one_line_with_its_place(
    tmp_path, text, words, caplog
):
    path = tmp_path / "log"
    path.write_text(text)
    assert_file_refused(read_log, path, words)
    assert not caplog.records


@pytest.mark.parametrize(("text", "words"), LARGE, ids=range(len(LARGE)))
def test_a_message_made_to_fill_the_memory_is_refused_in_one_line(tmp_path, text, words):
    path = tmp_path / "log"
    path.write_text(text)
    assert_file_refused(read_log, path, words)


@pytest.mark.parametrize("part", ["segment", "metadata", "data", "body", "header"])
def test_an_empty_part_is_one_line_that_names_no_python(tmp_path, part):
    before, after = GOOD_XML.split(f"<{part}>")[0], GOOD_XML.split(f"</{part}>")[1]
    for text in (f"{before}<{part}></{part}>{after}", before + after):
        try:
            samples = read(tmp_path, text)
        except InputError as error:
            line = str(error)
            assert "\n" not in line
            assert not re.search(r"NoneType|__init__|attribute|Error\b|argument", line), line
        else:
            assert part == "header" and len(samples) == 3
