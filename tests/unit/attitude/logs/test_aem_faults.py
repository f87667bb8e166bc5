"""CCSDS AEM: epochs, blocks, and every way that a message can be wrong."""

from __future__ import annotations

import re
from itertools import pairwise

import numpy as np
import pytest

from hilstar.attitude.clock.timeline import Policy
from hilstar.attitude.logs import aem, aem_blocks
from hilstar.attitude.logs.log_file import log_timeline, open_log, write_log
from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.basics.errors import InputError
from hilstar.basics.units import NS_PER_S
from tests.support.sources.aem_messages import EPOCHS, aem_refusal, kvn, read, rows_of

# Epochs


@pytest.mark.parametrize(
    ("text", "t_ns"),
    [
        ("1970-01-01T00:00:00", 0),
        ("1969-12-31T23:59:59.999999999Z", -1),
        ("2024-060T00:00:00.000000001", 1_709_164_800 * NS_PER_S + 1),
        ("2024-02-29T00:00:00.0000000014999", 1_709_164_800 * NS_PER_S + 1),
        ("2016-12-31T23:59:60.5", 1_483_228_800 * NS_PER_S + NS_PER_S // 2),
        ("2262-04-11T23:47:16.854775807", 2**63 - 1),
        ("1677-09-21T00:12:43.145224192", -(2**63)),
    ],
)
def test_both_forms_of_epoch_are_read_to_the_nanosecond(text, t_ns):
    assert aem_blocks.epoch_ns("", text) == t_ns


def test_epochs_are_written_with_nine_digits():
    assert aem_blocks.epoch_text(-1) == "1969-12-31T23:59:59.999999999"
    assert aem_blocks.epoch_text(2**63 - 1) == "2262-04-11T23:47:16.854775807"


@pytest.mark.parametrize(
    "text",
    [
        "2024-02-30T00:00:00",
        "2023-366T00:00:00",
        "2024-000T00:00:00",
        "2024-01-01T24:00:00",
        "2024-01-01T00:60:00",
        "2024-01-01T00:00:60",
        "0000-01-01T00:00:00",
        "2024-01-01T00:00:00+01:00",
        "2024-01-01 00:00:00",
        "2024-1-1T00:00:00",
        "12.5",
    ],
)
def test_an_epoch_that_is_none_is_refused(tmp_path, text):
    assert ":17: " in aem_refusal(tmp_path, kvn([f"{text.replace(' ', '_')} 0 0 0 1"]))


def test_an_epoch_outside_64_bits_is_refused(tmp_path):
    assert "64 bits" in aem_refusal(tmp_path, kvn(["2262-04-11T23:47:16.854775808 0 0 0 1"]))


# Blocks


def two_blocks(first, second, **keywords):
    one = kvn([f"{epoch} 0 0 0 1" for epoch in first])
    two = kvn([f"{epoch} 0 0 0 1" for epoch in second], **keywords)
    return one + two[two.index("META_START") :]


def test_blocks_are_put_in_order_of_time(tmp_path):
    text = two_blocks(
        ["2024-01-02T00:00:00", "2024-01-02T00:00:01"],
        ["2024-01-01T00:00:00", "2024-01-01T00:00:01"],
    )
    samples = read(tmp_path, text)
    assert [s.t_ns for s in samples] == sorted(s.t_ns for s in samples)
    assert [s.discontinuity for s in samples] == [False, False, True, False]


def test_blocks_may_share_an_epoch_and_the_earlier_then_ends_a_nanosecond_before(tmp_path):
    # 504.0-B-1 4.2.5.4.1 allows it; the attitude before the break is then known up to the break.
    text = two_blocks(
        ["2024-01-01T00:00:00", "2024-01-01T00:00:01"],
        ["2024-01-01T00:00:01", "2024-01-01T00:00:02"],
    )
    samples = read(tmp_path, text)
    assert [s.t_ns - samples[0].t_ns for s in samples] == [0, NS_PER_S - 1, NS_PER_S, 2 * NS_PER_S]
    assert [s.discontinuity for s in samples] == [False, False, True, False]


TURN_DEG_S = 3.0


def segment_turn(number, second):
    """Of segment `number`, about z at a constant rate; each segment has an offset of its own, so
    that it can be told.
    """
    angle = np.radians(TURN_DEG_S * second + 40.0 * number) / 2
    return f"2024-01-01T00:00:{second:02d} 0 0 {float(np.sin(angle))!r} {float(np.cos(angle))!r}"


def overlapping(*segments):
    """Segments, each its seconds and its keywords, as one message."""
    text = ""
    for number, (seconds, keywords) in enumerate(segments):
        own = kvn(
            [segment_turn(number, second) for second in seconds], REF_FRAME_B="CAM", **keywords
        )
        text += own if not number else own[own.index("META_START") :]
    return text


def which_at(samples, second):
    """Of which segment the sky is at a time, from the attitude there."""
    timeline = log_timeline(samples, Policy(0, NS_PER_S))
    q = timeline.at(samples[0].t_ns + round(second * NS_PER_S)).q_icrs_to_cam
    angle = np.degrees(2 * np.arctan2(-q[3], q[0]))  # the conjugate of what the file has
    return ((angle - TURN_DEG_S * second) / 40.0 + 0.5) % 9 - 0.5


def useable(start, stop):
    return {
        f"USEABLE_{key}_TIME": f"2024-01-01T00:00:{second:02d}"
        for key, second in (("START", start), ("STOP", stop))
    }


@pytest.mark.parametrize(
    ("segments", "wanted"),
    [
        # Without USEABLE times: the later segment from its beginning; and where it has ended, the
        # earlier one again.
        ([([0, 20, 40], {}), ([25, 45], {})], {24: 0, 25: 1, 26: 1, 44: 1}),
        ([([0, 20, 40], {}), ([25, 30], {})], {24: 0, 26: 1, 29: 1, 30.5: 0, 39: 0}),
        # By USEABLE times, between attitudes too: the earlier one goes on to its end there.
        (
            [([0, 20, 40], useable(0, 33)), ([30, 50], useable(33, 50))],
            {29: 0, 32: 0, 32.9: 0, 33.1: 1, 49: 1},
        ),
        # Where only one segment has a time, it is taken whether it is useable there or not.
        ([([0, 20, 40], useable(5, 28)), ([30, 50], useable(35, 45))], {1: 0, 29: 0, 31: 1, 49: 1}),
        # In the file's order they need not be; of two that begin together the later in the file is
        # taken.
        ([([30, 50], {}), ([0, 20, 40], {})], {29: 1, 31: 0, 49: 0}),
        ([([0, 20], {}), ([0, 20], {})], {1: 1, 19: 1}),
        # One attitude alone has no duration, and is left out within another segment.
        ([([0, 20], {}), ([10], {})], {9: 0, 11: 0}),
    ],
)
@pytest.mark.parametrize("form", ["kvn", "xml"])
def test_segments_that_overlap_are_read_by_their_useable_times_then_the_later_one(
    tmp_path, segments, wanted, form
):
    text = overlapping(*segments)
    (tmp_path / "log").write_text(text if form == "kvn" else in_xml(text))
    log = open_log(tmp_path / "log")
    times = [sample.t_ns for sample in log.samples]
    assert all(before < after for before, after in pairwise(times))
    for second, number in wanted.items():
        assert which_at(log.samples, second) == pytest.approx(number, abs=1e-9), (second, number)
    [notice] = [line for kind, line in log.told if kind == "aem-overlap"]
    assert "2 segments overlap" in notice and "USEABLE" in notice
    changes = sum(before != after for before, after in pairwise(wanted.values()))
    assert sum(sample.discontinuity for sample in log.samples) == changes


def in_xml(text):
    """A message of quaternions, scalar last, in XML."""
    body = ""
    for block in text.split("META_START")[1:]:
        meta, data = block.split("META_STOP")
        keywords = "".join(
            f"<{key}>{value}</{key}>" for key, value in re.findall(r"(\w+) = (.*)", meta)
        )
        states = ""
        for row in data.replace("DATA_START", "").replace("DATA_STOP", "").strip().splitlines():
            epoch, *q = row.split()
            values = "".join(
                f"<{key}>{value}</{key}>"
                for key, value in zip(("Q1", "Q2", "Q3", "QC"), q, strict=True)
            )
            state = f"<EPOCH>{epoch}</EPOCH><quaternion>{values}</quaternion>"
            states += f"<attitudeState><quaternionState>{state}</quaternionState></attitudeState>"
        body += f"<segment><metadata>{keywords}</metadata><data>{states}</data></segment>"
    return f'<aem id="CCSDS_AEM_VERS" version="1.0"><body>{body}</body></aem>'


def test_useable_times_of_segments_that_do_not_overlap_change_nothing(tmp_path):
    (tmp_path / "log").write_text(
        overlapping(([0, 10, 20], useable(5, 15)), ([30, 40], useable(35, 36)))
    )
    log = open_log(tmp_path / "log")
    assert len(log.samples) == 5
    assert "aem-overlap" not in dict(log.told)


def test_rows_that_go_back_in_time_are_refused_as_ever(tmp_path):
    assert "time does not increase" in aem_refusal(
        tmp_path, overlapping(([0, 20, 10], {}), ([15, 30], {}))
    )


@pytest.mark.parametrize(
    ("keywords", "words"),
    [
        (useable(20, 5), "USEABLE_STOP_TIME is before USEABLE_START_TIME"),
        ({"USEABLE_START_TIME": "soon"}, "the epoch is 'SOON'"),
    ],
)
def test_useable_times_that_cannot_be_are_refused_where_they_are_needed(tmp_path, keywords, words):
    assert words in aem_refusal(tmp_path, overlapping(([0, 20], keywords), ([15, 30], {})))


def test_thousands_of_segments_that_overlap_are_refused(tmp_path):
    one = overlapping(([0, 20], {}))
    text = one + one[one.index("META_START") :] * aem.MAX_OVERLAPPING
    assert "1001 segments overlap, and 1000 may" in aem_refusal(tmp_path, text)


def test_blocks_of_two_time_systems_are_refused(tmp_path):
    text = two_blocks(["2024-01-01T00:00:00"], ["2024-01-02T00:00:00"], TIME_SYSTEM="TAI")
    assert "TIME_SYSTEM changes" in aem_refusal(tmp_path, text)


# What is refused


@pytest.mark.parametrize("version", ["1.0", "2.0"])
@pytest.mark.parametrize("kind", ["SPIN/NUTATIONS", "EULER", "DCM"])
def test_other_types_are_refused_with_those_that_work(tmp_path, kind, version):
    message = aem_refusal(tmp_path, kvn(rows_of([0, 0, 0, 1]), version, ATTITUDE_TYPE=kind))
    assert f"ATTITUDE_TYPE = {kind}" in message
    assert (
        "QUATERNION, QUATERNION/DERIVATIVE, QUATERNION/"
        + ("RATE" if version == "1.0" else "ANGVEL")
        in message
    )


@pytest.mark.parametrize(
    ("keywords", "word"),
    [
        ({"ATTITUDE_DIR": None}, "ATTITUDE_DIR is missing; write A2B or B2A"),
        ({"ATTITUDE_DIR": "UP"}, "ATTITUDE_DIR is UP"),
        ({"QUATERNION_TYPE": None}, "QUATERNION_TYPE is missing; write FIRST or LAST"),
        ({"TIME_SYSTEM": None}, "TIME_SYSTEM is missing"),
        ({"REF_FRAME_A": None}, "REF_FRAME_A is missing"),
        ({"ATTITUDE_TYPE": None}, "ATTITUDE_TYPE is missing"),
        ({"ATTITUDE_TYPE": "QUATERNION/RATE"}, "an epoch and 7 numbers"),
    ],
)
def test_a_keyword_that_is_missing_or_wrong_is_named(tmp_path, keywords, word):
    assert word in aem_refusal(tmp_path, kvn(rows_of([0, 0, 0, 1]), **keywords))


@pytest.mark.parametrize(
    ("keywords", "word"),
    [
        ({}, "RATE_FRAME is missing; write ICRF or SC_BODY_1"),
        ({"RATE_FRAME": "INSTRUMENT_A"}, "RATE_FRAME is INSTRUMENT_A"),
        (
            {"RATE_FRAME": "REF_FRAME_B", "EULER_ROT_SEQ": "321"},
            "rates of Euler angles are not read",
        ),
    ],
)
def test_a_rate_without_one_meaning_is_refused(tmp_path, keywords, word):
    text = kvn(rows_of([0, 0, 0, 1, 0, 0, 0]), ATTITUDE_TYPE="QUATERNION/RATE", **keywords)
    assert word in aem_refusal(tmp_path, text)


GOOD = kvn(rows_of([0, 0, 0, 1], [0, 0, 0, 1]))


@pytest.mark.parametrize(
    ("text", "place", "word"),
    [
        (GOOD.replace("VERS = 1.0", "VERS = 3.0"), "", "CCSDS_AEM_VERS is 3.0; write 1.0 or 2.0"),
        (GOOD.replace("DATA_STOP\n", ""), ":18:", "cut off"),
        (GOOD[: GOOD.index("META_STOP")], ":14:", "the file ends in the metadata"),
        ("CCSDS_AEM_VERS = 1.0\n", ":1:", "with 0 complete blocks"),
        (GOOD.replace("DATA_START\n", ""), ":16:", "in the gap before DATA_START"),
        (GOOD.replace("META_STOP", "DATA_START"), ":15:", "DATA_START in the metadata"),
        (GOOD.replace("0.0 1.0\n", "0.0 1.0 0.0\n", 1), ":17:", "an epoch and 4 numbers"),
        (GOOD.replace("0.0 1.0\n", "0.0\n", 1), ":17:", "an epoch and 4 numbers"),
        (GOOD.replace("0.0 1.0\n", "0.0 one\n", 1), ":17:", "an epoch and 4 numbers"),
        (GOOD.replace("0.0 1.0\n", "0.0 inf\n", 1), ":17:", "not finite"),
        (GOOD.replace("0.0 1.0\n", "0.0 1e308\n", 1), ":17:", "norm"),
        (GOOD.replace("0.0 1.0\n", "0.0 0.5\n", 1), ":17:", "norm"),
        (GOOD.replace(EPOCHS[1], EPOCHS[0]), ":18:", "does not increase"),
        (GOOD.replace("OBJECT_ID = X", "OBJECT_ID"), ":6:", "KEYWORD = value"),
        (kvn([]), ":17:", "contains no attitude"),
        ("<aem", ":1:", "not well-formed"),
        ("<aem/>", "", "not an AEM in XML"),
        ("<html><body/></html>", "", "not an AEM in XML"),
        ('<aem id="CCSDS_AEM_VERS" version="1.0"/>', "", "not an AEM in XML"),
        (
            '<!DOCTYPE aem [<!ENTITY x "y">]><aem id="CCSDS_AEM_VERS" version="1.0">&x;</aem>',
            "",
            "DOCTYPE",
        ),
    ],
)
def test_a_message_that_is_wrong_is_refused_with_its_place(tmp_path, text, place, word):
    message = aem_refusal(tmp_path, text)
    assert message.startswith(f"{tmp_path / 'log'}{place}")
    assert word in message


def test_xml_that_is_cut_off_or_wrong_in_one_state_is_refused(tmp_path, caplog):
    samples = [AttitudeSample(t_ns, np.array([1.0, 0.0, 0.0, 0.0])) for t_ns in range(3)]
    write_log(tmp_path / "a.xml", samples)
    text = (tmp_path / "a.xml").read_text()
    assert "not well-formed" in aem_refusal(tmp_path, text[: len(text) // 2])
    assert "not an AEM in XML" in aem_refusal(tmp_path, text.replace("<QC>1.0<", "<QC>one<", 1))
    assert "not an AEM in XML" in aem_refusal(tmp_path, text.replace("<QC>1.0</QC>", "", 1))
    assert "not an AEM in XML" in aem_refusal(
        tmp_path, text.replace("<QC>1.0</QC>", "<QC>1.0</QC><QC>0.0</QC>", 1)
    )
    assert not caplog.records
    assert ", 1970-01-01T00:00:00.000000002: the quaternion's norm" in aem_refusal(
        tmp_path, "<QC>2.0</QC>".join(text.rsplit("<QC>1.0</QC>", 1))
    )
    assert "is not the QUATERNION/DERIVATIVE" in aem_refusal(
        tmp_path, text.replace("QUATERNION<", "QUATERNION/DERIVATIVE<")
    )


@pytest.mark.parametrize(
    ("old", "new", "place", "words"),
    [
        (
            "QUATERNION_TYPE = LAST",
            "QUATERNION_TYP = FIRST",
            ":10:",
            "QUATERNION_TYP is not a keyword .*; did you mean QUATERNION_TYPE",
        ),
        (
            "ATTITUDE_DIR = A2B",
            "ATTITUDE_DIRECTION = B2A",
            ":9:",
            "ATTITUDE_DIRECTION is not a keyword .*; did you mean ATTITUDE_DIR",
        ),
        (
            "OBJECT_NAME = X",
            "object_name = X",
            ":5:",
            "object_name is not a keyword .*; did you mean OBJECT_NAME",
        ),
        (
            "OBJECT_NAME = X",
            "WINDSPEED = 3",
            ":5:",
            "WINDSPEED is not a keyword .*; the keywords are OBJECT_NAME, ",
        ),
        (
            "ORIGINATOR = X",
            "ORIGINATOR = X\nATTITUDE_DIR = B2A",
            ":4:",
            "ATTITUDE_DIR is in the header; it belongs in the metadata",
        ),
        (
            "ATTITUDE_DIR = A2B",
            "ATTITUDE_DIR = A2B\nATTITUDE_DIR = B2A",
            ":9:",
            "ATTITUDE_DIR appears twice",
        ),
        (
            "META_START",
            "META_START\nORIGINATOR = Y",
            ":5:",
            "ORIGINATOR is in the metadata; it belongs in the header",
        ),
    ],
)
def test_a_keyword_that_would_be_passed_over_is_refused_with_its_line(
    tmp_path, old, new, place, words
):
    assert old in GOOD
    message = aem_refusal(tmp_path, GOOD.replace(old, new, 1))
    line = int(place.strip(":")) + (1 if "appears twice" in words else 0)
    assert message.startswith(f"{tmp_path / 'log'}:{line}:"), message
    assert re.search(words, message), message


def test_comments_may_stand_anywhere(tmp_path):
    assert (
        len(read(tmp_path, GOOD.replace("OBJECT_ID", "COMMENT QUATERNION_TYP = FIRST\nOBJECT_ID")))
        == 2
    )


def test_gcrf_has_the_axes_of_icrf(tmp_path):
    wanted, found = read(tmp_path, GOOD), read(tmp_path, GOOD.replace("= ICRF", "= GCRF"))
    assert [s.q_icrs_to_cam.tolist() for s in found] == [s.q_icrs_to_cam.tolist() for s in wanted]


@pytest.fixture
def xml(tmp_path):
    write_log(
        tmp_path / "a.xml", [AttitudeSample(k, np.array([1.0, 0.0, 0.0, 0.0])) for k in range(3)]
    )
    return (tmp_path / "a.xml").read_text()


HEAD = '<aem id="CCSDS_AEM_VERS" version="1.0">'


def _n(text, count):
    """So many lines of a text."""
    return f"{text}\n" * count


@pytest.mark.parametrize(
    ("text", "word"),
    [
        (f"{HEAD}<body>{'<segment>' * 30}", "nested too deep"),
        (f"{HEAD}<header>{_n('<COMMENT/>', 100_001)}", "too many"),
        (f"<ndm><oem>{_n('<a/>', 100_001)}", "too many"),
        (f"{HEAD}<header {_n('a=_', 300_000)}/></aem>", "a million characters"),
        (
            f"{HEAD}<header><COMMENT>{_n('x', 500_001)}</COMMENT></header></aem>",
            "a million characters",
        ),
        ('<!DOCTYPE aem SYSTEM "file:///etc/passwd"><aem/>', "has a DOCTYPE"),
        (
            (
                '<?xml version="1.0"?><!DOCTYPE a [<!ENTITY a "aaaa"><!ENTITY b'
                ' "&a;&a;">]><aem>&b;</aem>'
            ),
            "has a DOCTYPE",
        ),
        (f"{HEAD}&b;</aem>", "not well-formed XML (undefined entity)"),
    ],
    ids=[
        "deep",
        "wide",
        "a wide neighbour",
        "attributes",
        "text",
        "external",
        "entities",
        "no entity",
    ],
)
def test_xml_made_to_fill_the_memory_or_to_read_other_files_is_refused(tmp_path, text, word):
    assert word in aem_refusal(tmp_path, text)


@pytest.mark.parametrize(
    ("old", "new", "word"),
    [
        ("<metadata>", "<metadata>QUATERNION_TYPE", "'QUATERNION_TYPE' stands in <metadata>"),
        ("<data>", "<data>1 0 0 0", "'1 0 0 0' stands in <data>"),
        ("<quaternion>", "<quaternion>1", "'1' stands in <quaternion>"),
        ("<Q1>", '<Q1 units="deg">', "<Q1> in 'deg'; write no units"),
        ("<Q1>", '<Q1 scale="2">', "<Q1> has no scale"),
        (
            "<QUATERNION_TYPE>LAST",
            "<QUATERNION_TYPE>LEAST",
            "QUATERNION_TYPE is LEAST; write FIRST or LAST",
        ),
        (
            "<TIME_SYSTEM>",
            "<TIME_SYSTEM>TAI</TIME_SYSTEM><TIME_SYSTEM>",
            "TIME_SYSTEM appears twice in the metadata",
        ),
        ("<quaternion>", "<quaternion/><quaternion>", "has no place in a <quaternionState>"),
        ("<EPOCH>", "<EPOCH>1970-01-01T00:00:00</EPOCH><EPOCH>", "has one EPOCH"),
        ("<attitudeState>", "<state/><attitudeState>", "<state> where <COMMENT> belongs"),
        ("</segment>", "<data/></segment>", "one <metadata>, then one <data>"),
        ("</body>", "</body><body/>", "one <header>, then one <body>"),
        ('id="CCSDS_AEM_VERS"', 'id="CCSDS_OEM_VERS"', 'no id="CCSDS_AEM_VERS"'),
        ('version="1.0">', 'version="3.0">', "CCSDS_AEM_VERS is 3.0; write 1.0 or 2.0"),
        ("<aem", "<oem", "<oem> where <aem> or <ndm> belongs"),
    ],
)
def test_what_xml_would_hide_is_refused(tmp_path, xml, old, new, word):
    text = xml.replace(old, new, 1)
    assert word in aem_refusal(
        tmp_path, text.replace("</aem>", "</oem>") if old == "<aem" else text
    )


def test_names_with_a_namespace_and_another_message_beside_the_aem_are_read(tmp_path, xml):
    body = xml[xml.index("<aem") :]
    named = re.sub(r"<(/?)(\w)", r"<\1ndm:\2", body).replace(
        "<ndm:aem", '<ndm:aem xmlns:ndm="urn:ccsds:schema:ndmxml"', 1
    )
    assert [sample.t_ns for sample in read(tmp_path, named)] == [0, 1, 2]
    assert [
        sample.t_ns for sample in read(tmp_path, f"<ndm><oem><body>9</body></oem>{body}</ndm>")
    ] == [0, 1, 2]


@pytest.mark.parametrize(
    ("version", "key", "value", "other"),
    [
        ("2.0", "ATTITUDE_DIR", "B2A", "2.0 always turns from REF_FRAME_A to REF_FRAME_B"),
        ("2.0", "QUATERNION_TYPE", "FIRST", "2.0 always has the scalar last"),
        ("2.0", "RATE_FRAME", "SC_BODY_1", "2.0 has ANGVEL_FRAME"),
        ("1.0", "ANGVEL_FRAME", "SC_BODY_1", "1.0 has RATE_FRAME"),
    ],
)
def test_a_keyword_of_the_other_version_is_refused_with_both_named(
    tmp_path, version, key, value, other
):
    """504.0-B-2 annex J."""
    own = {"1.0": "2.0", "2.0": "1.0"}[version]
    words = f"{key} is of AEM {own}, and CCSDS_AEM_VERS is {version}; {other}"
    text = kvn(rows_of([0, 0, 0, 1]), version, **{key: value})
    line = text[: text.index(key)].count("\n") + 1
    assert f"log:{line}: {words}" in aem_refusal(tmp_path, text)
    meta = "".join(
        f"<{k}>{v}</{k}>" for k, v in re.findall(r"(\w+) = (.*)", text[text.index("META_START") :])
    )
    document = (
        '<aem id="CCSDS_AEM_VERS"'
        f' version="{version}"><body><segment><metadata>{meta}</metadata></segment></body></aem>'
    )
    assert words in aem_refusal(tmp_path, document)


def test_an_element_that_would_be_passed_over_is_refused_with_its_line(tmp_path, xml):
    lines = xml.splitlines()
    number = next(k for k, line in enumerate(lines, start=1) if "<QUATERNION_TYPE>" in line)
    message = aem_refusal(tmp_path, xml.replace("QUATERNION_TYPE>", "QUATERNION_TYP>"))
    assert message.startswith(
        f"{tmp_path / 'log'}:{number}: QUATERNION_TYP is not a keyword of an AEM's metadata; did"
        " you mean"
    )


def test_one_aem_in_an_ndm_is_read_and_several_are_not(tmp_path, xml):
    body = xml[xml.index("<aem") :]
    samples = read(tmp_path, f"<ndm><MESSAGE_ID>1</MESSAGE_ID>{body}</ndm>")
    assert [s.t_ns for s in samples] == [0, 1, 2]
    for count, inside in ((0, ""), (2, body + body)):
        assert f"the <ndm> contains {count} <aem>; write one" in aem_refusal(
            tmp_path, f"<ndm>{inside}</ndm>"
        )


@pytest.mark.parametrize("part", ["segment", "metadata", "data", "body", "header"])
def test_an_empty_part_is_one_line_that_names_no_python(tmp_path, xml, part):
    start, end = xml.index(f"<{part}>"), xml.index(f"</{part}>")
    for text in (
        xml[: start + len(part) + 2] + xml[end:],
        xml[:start] + xml[end + len(part) + 3 :],
    ):
        try:
            samples = read(tmp_path, text)
        except InputError as error:
            line = str(error)
            assert "\n" not in line
            assert not re.search(r"NoneType|__init__|attribute|Error\b|argument", line), line
        else:
            assert part == "header" and len(samples) == 3


@pytest.mark.parametrize(
    ("decimals", "ns"),
    [("0000000004", 0), ("0000000005", 1), ("9999999995", 10**9), ("1234567891", 123_456_789)],
)
def test_an_epoch_is_rounded_to_the_nanosecond(decimals, ns):
    day_ns = 86_400 * 10**9
    assert aem_blocks.epoch_ns("", f"1970-01-02T00:00:00.{decimals}") == day_ns + ns
    assert aem_blocks.epoch_ns("", f"1970-002T00:00:00.{decimals}Z") == day_ns + ns
