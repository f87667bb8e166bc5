"""What a ledger keeps of a frame and of an answer, field by field, and how packets are counted."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from msgspec import structs

from hilstar.attitude.clock.timeline import Attitude
from hilstar.attitude.wire.source import Convention
from hilstar.optics.layers.fault_kinds import Now
from hilstar.server.answers.answer import Answer, ReportedStar
from hilstar.server.answers.judge import Judged, unjudged
from hilstar.server.answers.pairing import Lit
from hilstar.server.bench.config import parse_config
from hilstar.server.bench.drawn import Drawn
from hilstar.server.operator import OnScreen
from hilstar.server.pacer import Shown
from hilstar.server.record.ledger import TOPICS
from hilstar.server.record.ledger_records import (
    MAX_CENTROIDS,
    MAX_RAW_BYTES,
    MAX_REASON_CHARACTERS,
    MAX_REASONS,
    AnswerRecord,
    CountRecord,
    FrameRecord,
    PacketForm,
    PacketTally,
    answer_record,
    codes_ms_of,
    frame_record,
    raw_convention,
)
from tests.support.benches import SMALL_BENCH
from tests.support.drawn import drawn, stars_at

Q = (0.1, -0.5, 0.7, -0.5)
RATE = np.array([0.01, -0.02, 0.03])
MIN_NS, MAX_NS = -(2**63), 2**63 - 1


def drawn_frame(rate=RATE) -> Drawn:
    """What was drawn in a frame: 31 stars, of which three clip and five are coarse."""
    stars = stars_at(range(31), range(31), rate_cam_rad_s=rate)
    levels = np.zeros((3, 4), np.uint8)
    return drawn(levels, replace(stars, capped=5), (7, 8, "Moon"))


def test_a_frame_s_record_has_each_of_its_figures():
    attitude = Attitude(
        np.array(Q),
        age_ns=40,
        stale=True,
        sequence=12,
        received_ns=600,
        prediction_ns=90,
        rate_cam_rad_s=-RATE,
        velocity_km_s=np.array([1.0, 2.0, -3.0]),
        place_km=np.array([7000.0, -8.0, 9.0]),
    )
    shown = Shown(
        number=70,
        t_ns=1000,
        attitude=attitude,
        drawn=drawn_frame(),
        draw_ns=200,
        predicted_swap_ns=300,
        swap_ns=310,
        stale=True,
        timestamp_source="GLX",
        missed_before=2,
        marker=1,
        on_screen=OnScreen("grid", "covered"),
        faults=(Now(4, None, 55), Now(6, None, 66)),
        light_ns=999,
    )
    record = frame_record(shown, light_ns=5040, missed=11, below_step=13)
    assert record == FrameRecord(
        frame=70,
        t_ns=1000,
        light_ns=5040,
        draw_ns=200,
        predicted_swap_ns=300,
        swap_ns=310,
        timestamp_source="GLX",
        q=Q,
        rate=(0.01, -0.02, 0.03),  # as the stars' paths were drawn
        velocity_km_s=(1.0, 2.0, -3.0),
        place_km=(7000.0, -8.0, 9.0),
        attitude_sequence=12,
        attitude_t_ns=5000,  # of the sender's clock, as the light is
        receive_ns=600,
        age_ns=40,
        prediction_ns=90,
        stale=True,
        stars_drawn=31,
        clipped=3,
        below_step=13,
        capped=5,
        missed_before=2,
        missed=11,
        marker=1,
        operator="grid",
        hidden="covered",
        faults=(4, 6),
        fault_since_ns=(55, 66),
    )


def test_a_blank_frame_has_no_attitude_and_an_absurd_stamp_is_cut():
    blank = frame_record(Shown(1, 2, None, drawn_frame(None), swap_ns=3), 4, 0, 0)
    of_none = (blank.q, blank.rate, blank.attitude_t_ns, blank.age_ns, blank.receive_ns)
    assert of_none == (None,) * 5
    for age_ns, t_ns in ((2**63 + 9, MIN_NS), (-(2**63) - 9, MAX_NS)):
        absurd = Attitude(np.array(Q), age_ns=age_ns, stale=False)
        record = frame_record(Shown(1, 2, absurd, drawn_frame()), 0, 0, 0)
        assert (record.attitude_t_ns, record.age_ns) == (t_ns, MAX_NS if age_ns > 0 else MIN_NS)


STARS = (
    ReportedStar(1.5, 2.5, 300.0, 24436, 0.75),
    ReportedStar(-3.5, 4.25, None, None, None),
)


def test_an_answer_s_record_has_each_of_its_figures():
    answer = Answer(
        host_ns=900,
        raw=b"\x01\xfe" * MAX_RAW_BYTES,
        t_ns=77,
        q_icrs_to_cam=np.array(Q),
        rate_cam_rad_s=RATE,
        mode="trac\x1bk" + "k" * 100,
        star_count=9,
        rms_arcsec=1.25,
        centroids=STARS,
    )
    q_lit = np.array([0.5, 0.5, 0.5, -0.5])
    lit = Lit(q_lit, -RATE, light_ns=456, first=30, last=34)
    residual = np.array([5.0, -6.0, 70.0])
    record = answer_record(Judged(answer, "wrong", 850, 0.5, lit, residual))
    assert record == AnswerRecord(
        host_ns=900,
        raw="01fe" * (MAX_RAW_BYTES // 2),
        t_ns=77,
        q=Q,
        rate=(0.01, -0.02, 0.03),
        valid=True,
        mode=record.mode,
        stars=9,
        rms_arcsec=1.25,
        centroids=((1.5, 2.5, 300.0, 24436), (-3.5, 4.25, None, None)),
        widths_px=(0.75, None),
        verdict="wrong",
        middle_ns=850,
        light_ns=456,
        q_lit=(0.5, 0.5, 0.5, -0.5),
        residual_arcsec=(5.0, -6.0, 70.0),
        first_frame=30,
        last_frame=34,
    )
    assert len(record.mode) == MAX_REASON_CHARACTERS and "\x1b" not in record.mode


def test_an_answer_that_was_compared_with_nothing_has_no_residual():
    many = Answer(900, b"", t_ns=2**70, valid=False, centroids=STARS[1:] * (MAX_CENTROIDS + 1))
    record = answer_record(unjudged(many))
    assert (record.verdict, record.middle_ns, record.valid) == ("unjudged", 900, False)
    of_none = (record.q, record.q_lit, record.residual_arcsec, record.first_frame, record.light_ns)
    assert of_none == (None,) * 5
    assert (record.t_ns, len(record.centroids), record.widths_px) == (MAX_NS, MAX_CENTROIDS, ())


KINDS = {int: "integer", float: "number", str: "string", bool: "boolean", list: "array"}


@pytest.mark.parametrize("key", [key for key in TOPICS if key != "packet"])
def test_a_ledger_s_schemas_say_what_its_messages_hold(key):
    """Each field of a whole message has the type that its schema states."""
    full = {
        "frame": FrameRecord(
            frame=1, t_ns=2, light_ns=3, draw_ns=4, swap_ns=5, q=Q, rate=(1.0, 2.0, 3.0),
            velocity_km_s=(1.0, 2.0, 3.0), place_km=(1.0, 2.0, 3.0), predicted_swap_ns=6,
            attitude_sequence=7, attitude_t_ns=8, receive_ns=9, age_ns=10, marker=1,
        ),
        "answer": AnswerRecord(
            host_ns=1, raw="", t_ns=2, q=Q, rate=(1.0, 2.0, 3.0), stars=3, rms_arcsec=1.5,
            light_ns=4, q_lit=Q, residual_arcsec=(1.0, 2.0, 3.0), first_frame=5, last_frame=6,
        ),
        "count": CountRecord(host_ns=1, kind="packet", reason="crc", count=2),
    }  # fmt: skip
    properties = json.loads(TOPICS[key].schema)["properties"]
    if key not in full:
        assert properties["host_ns"] == {"type": "integer"}
        return
    for name, value in msgspec.to_builtins(full[key]).items():
        kind = KINDS[list if isinstance(value, (list, tuple)) else type(value)]
        assert properties[name]["type"] == kind, name


def test_packets_are_counted_by_reason_and_beyond_many_reasons_as_others():
    tally = PacketTally()
    tally.add(PacketForm())
    tally.add(PacketForm(accepted=False, reason="json: no object"))
    tally.add(CountRecord(host_ns=1, kind="frame", reason="no room", count=5))
    tally.add(CountRecord(host_ns=1, kind="packet", reason="x" * 99, count=3))
    assert tally.counts == {"accepted": 1, "json": 1, "x" * MAX_REASON_CHARACTERS: 3}
    for k in range(2 * MAX_REASONS):
        tally.count(f"reason {k}", 2)
    tally.count("accepted", 4)
    assert len(tally.counts) == MAX_REASONS + 1
    assert tally.counts["accepted"] == 5
    assert tally.counts["others"] == 2 * (MAX_REASONS + 3)
    assert sum(tally.counts.values()) == 1 + 1 + 3 + 4 * MAX_REASONS + 4


@pytest.mark.parametrize(
    ("text", "wanted"), [("[1.5, 2.5]", (1.5, 2.5)), ("null", None), ("[1]", None), ("{", None)]
)
def test_the_times_of_codes_in_a_ledger_s_head_are_both_or_none(text, wanted):
    assert codes_ms_of({"codes_ms": text}) == wanted
    assert codes_ms_of({}) is None


@pytest.mark.parametrize(
    ("source", "frame", "wanted"),
    [("zmq", "body", [0.5, 0.5, 0.5, 0.5]), ("udp", "cam", None), ("log", "body", "nothing")],
)
def test_a_head_says_by_what_its_raw_bytes_were_turned(source, frame, wanted):
    convention = Convention(scalar="last", direction="cam_to_icrs", frame=frame)
    plain = parse_config(Path("bench.toml"), SMALL_BENCH)
    config = structs.replace(
        plain,
        attitude=structs.replace(plain.attitude, source=source, convention=convention),
        tracker=structs.replace(plain.tracker, q_body_to_cam=(0.5, 0.5, 0.5, 0.5)),
    )
    told = json.loads(raw_convention(config))
    if wanted == "nothing":
        assert told is None
    else:
        assert told == {
            "scalar": "last",
            "direction": "cam_to_icrs",
            "frame": frame,
            "q_body_to_cam": wanted,
        }
