"""CCSDS AEM: epochs, blocks and segments that overlap, in KVN and XML."""

from __future__ import annotations

import re
from itertools import pairwise

import numpy as np
import pytest

from hilstar.attitude.clock.timeline import Policy
from hilstar.attitude.logs import aem, aem_blocks
from hilstar.attitude.logs.log_file import log_timeline, open_log
from hilstar.basics.units import NS_PER_S
from tests.support.refusals import refusal
from tests.support.sources.aem_messages import (
    OFFSET_DEG,
    TURN_DEG_S,
    in_xml,
    joined,
    kvn,
    overlapping,
    read,
    rows_of,
    useable,
)

GOOD = kvn(rows_of([0, 0, 0, 1], [0, 0, 0, 1]))
XML = in_xml(kvn([f"1970-01-01T00:00:00.00000000{k} 0 0 0 1" for k in range(3)]))


def blocks(*epochs):
    """A message of a block for each list of epochs."""
    return joined(*(kvn([f"{epoch} 0 0 0 1" for epoch in of_block]) for of_block in epochs))


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


# Blocks


def test_blocks_are_put_in_order_of_time(tmp_path):
    text = blocks(
        ["2024-01-02T00:00:00", "2024-01-02T00:00:01"],
        ["2024-01-01T00:00:00", "2024-01-01T00:00:01"],
    )
    samples = read(tmp_path, text)
    assert [s.t_ns for s in samples] == sorted(s.t_ns for s in samples)
    assert [s.discontinuity for s in samples] == [False, False, True, False]


def test_blocks_may_share_an_epoch_and_the_earlier_then_ends_a_nanosecond_before(tmp_path):
    # 504.0-B-1 4.2.5.4.1 allows it; the attitude before the break is then known up to the break.
    text = blocks(
        ["2024-01-01T00:00:00", "2024-01-01T00:00:01"],
        ["2024-01-01T00:00:01", "2024-01-01T00:00:02"],
    )
    samples = read(tmp_path, text)
    assert [s.t_ns - samples[0].t_ns for s in samples] == [0, NS_PER_S - 1, NS_PER_S, 2 * NS_PER_S]
    assert [s.discontinuity for s in samples] == [False, False, True, False]


def which_at(samples, second):
    """Of which segment the sky is at a time, from the attitude there."""
    timeline = log_timeline(samples, Policy(0, NS_PER_S))
    q = timeline.at(samples[0].t_ns + round(second * NS_PER_S)).q_icrs_to_cam
    angle = np.degrees(2 * np.arctan2(-q[3], q[0]))  # the conjugate of what the file has
    return ((angle - TURN_DEG_S * second) / OFFSET_DEG + 0.5) % 9 - 0.5


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
        # USEABLE times beside all of a segment's own: it is useable nowhere.
        ([([0, 20, 40], useable(50, 59)), ([25, 45], {})], {24: 0, 26: 1, 44: 1}),
        ([([0, 20, 40], {}), ([25, 45], useable(0, 10))], {24: 0, 26: 0, 39: 0, 41: 1}),
        # The first goes on behind one that lies within it, until a third begins.
        (
            [([0, 20, 40], {}), ([10, 15], {}), ([30, 50], {})],
            {9: 0, 12: 1, 16: 0, 29: 0, 31: 2, 49: 2},
        ),
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
    # no segment has rates, and an end that is interpolated gets none
    assert all(sample.rate_cam_rad_s is None for sample in log.samples)
    for second, number in wanted.items():
        assert which_at(log.samples, second) == pytest.approx(number, abs=1e-9), (second, number)
    [notice] = [line for kind, line in log.told if kind == "aem-overlap"]
    assert f"{len(segments)} segments overlap" in notice and "USEABLE" in notice
    changes = sum(before != after for before, after in pairwise(wanted.values()))
    assert sum(sample.discontinuity for sample in log.samples) == changes


def test_the_elements_of_a_state_that_was_read_count_no_more(tmp_path, monkeypatch):
    """Eight elements a state, of which only those of one are held at one time."""
    monkeypatch.setattr(aem_blocks, "MAX_ELEMENTS", 100)
    (tmp_path / "log").write_text(in_xml(overlapping((range(30), {}), (range(30, 60), {}))))
    assert len(open_log(tmp_path / "log").samples) == 60


@pytest.mark.parametrize("allowed", [2, 3])
def test_segments_overlap_up_to_a_number(tmp_path, monkeypatch, allowed):
    monkeypatch.setattr(aem, "MAX_OVERLAPPING", allowed)
    (tmp_path / "log").write_text(overlapping(([0, 20], {}), ([5, 25], {}), ([10, 30], {})))
    if allowed == 3:
        assert len(open_log(tmp_path / "log").samples) == 6
        return
    line = refusal(open_log, tmp_path / "log")
    assert line.endswith(": 3 segments overlap, and 2 may; write a file for each")


def test_useable_times_of_segments_that_do_not_overlap_change_nothing(tmp_path):
    (tmp_path / "log").write_text(
        overlapping(([0, 10, 20], useable(5, 15)), ([30, 40], useable(35, 36)))
    )
    log = open_log(tmp_path / "log")
    assert len(log.samples) == 5
    assert "aem-overlap" not in dict(log.told)
    # nor do two that share an epoch overlap
    (tmp_path / "log").write_text(overlapping(([0, 20], {}), ([20, 40], {})))
    assert "aem-overlap" not in dict(open_log(tmp_path / "log").told)


def test_comments_may_stand_anywhere(tmp_path):
    assert (
        len(read(tmp_path, GOOD.replace("OBJECT_ID", "COMMENT QUATERNION_TYP = FIRST\nOBJECT_ID")))
        == 2
    )


def test_gcrf_has_the_axes_of_icrf(tmp_path):
    wanted, found = read(tmp_path, GOOD), read(tmp_path, GOOD.replace("= ICRF", "= GCRF"))
    assert [s.q_icrs_to_cam.tolist() for s in found] == [s.q_icrs_to_cam.tolist() for s in wanted]


def test_names_with_a_namespace_and_an_aem_within_an_ndm_are_read(tmp_path):
    body = XML[XML.index("<aem") :]
    named = re.sub(r"<(/?)(\w)", r"<\1ndm:\2", body).replace(
        "<ndm:aem", '<ndm:aem xmlns:ndm="urn:ccsds:schema:ndmxml"', 1
    )
    beside = f"<ndm><oem><body>9</body></oem>{body}</ndm>"
    for text in (named, beside, f"<ndm><MESSAGE_ID>1</MESSAGE_ID>{body}</ndm>"):
        assert [sample.t_ns for sample in read(tmp_path, text)] == [0, 1, 2]


@pytest.mark.parametrize(
    ("decimals", "ns"),
    [("0000000004", 0), ("0000000005", 1), ("9999999995", 10**9), ("1234567891", 123_456_789)],
)
def test_an_epoch_is_rounded_to_the_nanosecond(decimals, ns):
    day_ns = 86_400 * 10**9
    assert aem_blocks.epoch_ns("", f"1970-01-02T00:00:00.{decimals}") == day_ns + ns
    assert aem_blocks.epoch_ns("", f"1970-002T00:00:00.{decimals}Z") == day_ns + ns
