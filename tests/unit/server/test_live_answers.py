"""The tracker in the loop of a run: what is recorded, told and counted of its answers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from hilstar.attitude.clock.timeline import Attitude
from hilstar.attitude.wire import protocol
from hilstar.attitude.wire.packet import AnswerPacket
from hilstar.basics.notices import Notices
from hilstar.basics.units import NS_PER_MS, NS_PER_S
from hilstar.server import serve
from hilstar.server.answers.answer import Answer, ReportedStar
from hilstar.server.answers.judge import Judged
from hilstar.server.answers.pairing import Lit
from hilstar.server.bench.config import parse_config
from hilstar.server.live_answers import MAX_JUDGED_HZ, LiveAnswers, wrong_line
from hilstar.server.operator import OnScreen
from hilstar.server.pacer import Shown
from hilstar.server.record.ledger_records import AnswerRecord, schema_of
from tests.support.benches import SMALL_BENCH
from tests.support.drawn import drawn
from tests.support.fake_clock import FakeClock
from tests.support.queued_answers import RULES, Queued
from tests.support.waiting import wait_for

Q = np.array([1.0, 0.0, 0.0, 0.0])
AWAY = np.array([np.cos(0.1), 0.0, np.sin(0.1), 0.0])  # 11 degrees
MONITOR = parse_config(Path("bench.toml"), SMALL_BENCH).monitor
DRAWN = drawn(np.zeros((3, 4), np.uint8))


class Kept:
    """What a ledger would keep."""

    def __init__(self) -> None:
        self.on, self.records = True, []

    def answer(self, record: AnswerRecord) -> None:
        self.records.append(record)


def second_of_frames(answers: LiveAnswers, **more) -> None:
    for k in range(60):
        at_ns = k * NS_PER_S // 60
        attitude = Attitude(Q, 0, False)
        answers.frame(Shown(k, at_ns, attitude, DRAWN, draw_ns=at_ns, **more), at_ns + 5)


def test_widths_of_stars_are_the_focus_and_stay_in_the_ledger():
    source, kept, clock = Queued(), Kept(), FakeClock(NS_PER_S)
    answers = LiveAnswers(MONITOR, RULES, source, Notices(), kept, clock=clock)
    stars = tuple(ReportedStar(9.0, 9.0, 300.0, None, width) for width in (1.2, 1.3, 1.4))
    with answers.running():
        second_of_frames(answers)
        for at_ns in (NS_PER_S // 4, 3 * NS_PER_S // 4):
            source.waiting.append(Answer(at_ns, b"\x01", at_ns, Q, centroids=stars))
        wait_for(lambda: answers.widths.state)
        source.waiting.append(Answer(NS_PER_S, b"\x01", NS_PER_S, Q, centroids=stars[:0]))
        wait_for(lambda: len(kept.records) == 3)
    state = answers.widths.state
    assert (state.what, state.sigma_px, state.count) == ("star sigma", 1.3, 6)
    assert [record.widths_px for record in kept.records] == [(1.2, 1.3, 1.4)] * 2 + [()]


def test_answers_are_judged_recorded_and_told_beside_the_frames():
    source, kept, notices, clock = Queued(), Kept(), Notices(), FakeClock(NS_PER_S)
    answers = LiveAnswers(MONITOR, RULES, source, notices, kept, clock=clock)
    heard, passed_on = [], []
    answers.heard = lambda live: heard.append(live.figures)
    answers.passed_on = lambda answer, middle_ns: passed_on.append((answer.raw, middle_ns))
    at_ns = NS_PER_S // 2
    with answers.running():
        assert answers.figures.answers == 0 and answers.figures.silent == ""
        second_of_frames(answers)
        star = ReportedStar(1.5, 2.0, 300.0, 26311)
        source.waiting.append(
            Answer(at_ns + 9, b"\x01\xff", at_ns, Q, np.zeros(3), True, "track", 7, 1.2, (star,))
        )
        source.waiting.append(Answer(at_ns + 9, b"\x02", at_ns, AWAY, mode="x" * 99))
        source.waiting.append(Answer(at_ns + 9, b"\x03", at_ns, None, valid=False))
        source.refused = {"checksum": 2}
        wait_for(lambda: heard)
        clock.work(4 * NS_PER_S)
        wait_for(lambda: answers.figures.silent)
    assert (heard[0].right, heard[0].wrong, heard[0].invalid, heard[0].refused) == (
        1,
        1,
        1,
        {"checksum": 2},
    )
    assert notices.counts() == {"wrong-answer": 1, "tracker-silent": 1}
    # each is handed on as it was judged, whatever the verdict
    assert passed_on == [(raw, at_ns) for raw in (b"\x01\xff", b"\x02", b"\x03")]
    right, wrong, invalid = kept.records
    assert (right.raw, right.verdict, right.stars, right.centroids) == (
        "01ff",
        "right",
        7,
        ((1.5, 2.0, 300.0, 26311),),
    )
    assert (right.middle_ns, right.light_ns, right.q_lit, right.residual_arcsec) == (
        at_ns,
        at_ns + 5,
        tuple(Q),
        (0, 0, 0),
    )
    assert (right.first_frame, right.last_frame) == (27, 33)
    assert (
        wrong.verdict == "wrong" and abs(wrong.residual_arcsec[1] - np.degrees(0.2) * 3600) < 1e-3
    )
    assert len(wrong.mode) == 40
    assert (invalid.verdict, invalid.q, invalid.q_lit) == ("invalid", None, None)
    # as the ledger writes and reads it, with a schema that readers of MCAP know
    for record in kept.records:
        assert msgspec.json.decode(msgspec.json.encode(record), type=AnswerRecord) == record
    types = {
        field["type"]
        for field in msgspec.json.decode(schema_of(AnswerRecord, "x"))["properties"].values()
    }
    assert types == {"integer", "string", "array", "boolean", "number"}


@pytest.mark.parametrize("changed", [OnScreen(operator="grid"), OnScreen(hidden="minimised")])
def test_frames_that_an_operator_changed_or_a_window_hides_are_no_sky_to_compare_with(changed):
    source = Queued()
    answers = LiveAnswers(MONITOR, RULES, source, Notices(), Kept(), clock=FakeClock(NS_PER_S))
    second_of_frames(answers, on_screen=changed)
    source.waiting.append(Answer(NS_PER_S // 2, b"", NS_PER_S // 2, Q))
    with answers.running():
        wait_for(lambda: answers.figures.answers)
    assert answers.figures.unpaired == 1


def test_a_flood_of_answers_is_judged_up_to_a_rate_and_counted_beyond():
    source, kept, clock = Queued(), Kept(), FakeClock(2 * NS_PER_S)
    answers = LiveAnswers(MONITOR, RULES, source, Notices(), kept, clock=clock)
    second_of_frames(answers)
    source.waiting.extend(Answer(NS_PER_S + k, b"", NS_PER_S // 2, Q) for k in range(5000))
    with answers.running():
        wait_for(lambda: answers.figures.answers)
    assert answers.figures.answers == MAX_JUDGED_HZ
    judged = [record for record in kept.records if record.verdict != "unjudged"]
    assert len(judged) == MAX_JUDGED_HZ and len(kept.records) == 5000
    assert answers.figures.refused == {"too many": 5000 - MAX_JUDGED_HZ}


def test_a_source_that_fails_ends_neither_the_run_nor_what_comes_after():
    source, notices, kept = Queued(), Notices(), Kept()
    answers = LiveAnswers(MONITOR, RULES, source, notices, kept, clock=FakeClock(NS_PER_S))
    second_of_frames(answers)
    source.waiting.append(Answer(NS_PER_S // 2, b"\x07", NS_PER_S // 2, np.ones(3)))
    source.waiting.append(Answer(NS_PER_S // 2, b"", NS_PER_S // 2, Q))
    with answers.running():
        wait_for(lambda: answers.figures.right)
    assert notices.counts() == {"answers-failed": 1}
    # The one that could not be judged is counted and recorded all the same.
    assert (answers.figures.answers, answers.figures.unjudged) == (2, 1)
    assert [(record.raw, record.verdict) for record in kept.records] == [
        ("07", "unjudged"),
        ("", "right"),
    ]


def test_a_reader_that_does_not_read_is_told_in_the_tracker_s_place():
    source, notices, clock = Queued(), Notices(), FakeClock(NS_PER_S)
    answers = LiveAnswers(MONITOR, RULES, source, notices, Kept(), clock=clock)

    def told(words: str) -> bool:
        clock.work(NS_PER_S // 5)
        return words in answers.figures.silent

    with answers.running():
        second_of_frames(answers)
        source.unread = "the reader (python:a:b) does not return"
        wait_for(lambda: told("no answer is read: the reader (python:a:b) does not return"))
        source.unread = ""
        wait_for(lambda: told("the tracker has not answered"))
    assert notices.counts() == {"answers-unread": 1, "answers-read": 1, "tracker-silent": 1}


def test_a_valid_answer_is_passed_on_with_the_stamp_of_the_sender_s_own_clock():
    """A sender whose clock is 7 s behind the host's. An answer without an attitude, or before that
    clock is known, is not passed on.
    """
    answer = Answer(20 * NS_PER_S, b"", None, np.array([1.0, 0.0, 0.0, 0.0]))
    q, still = (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    assert serve.answer_packet(answer, 12 * NS_PER_S, 7000.0) == AnswerPacket(
        0, protocol.ANSWER_VALID, 5 * NS_PER_S, q, still, 0
    )
    turning = replace(answer, rate_cam_rad_s=np.array([0.1, -0.2, 0.3]), star_count=9)
    flags = protocol.ANSWER_VALID | protocol.ANSWER_RATE_VALID
    assert serve.answer_packet(turning, 13 * NS_PER_S, 7000.0) == AnswerPacket(
        0, flags, 6 * NS_PER_S, q, (0.1, -0.2, 0.3), 9
    )
    for other in (replace(answer, valid=False), replace(answer, q_icrs_to_cam=None)):
        assert serve.answer_packet(other, 12 * NS_PER_S, 7000.0) is None
    assert serve.answer_packet(answer, 12 * NS_PER_S, None) is None


def test_a_frame_is_lit_a_swap_s_delay_after_its_swap_on_a_screen_and_else_at_its_moment():
    shown = Shown(0, 1000, Attitude(Q, 0, False), DRAWN, draw_ns=1000, swap_ns=3000)
    lit = []
    for delay_ns in (700, None):
        answers = LiveAnswers(
            *(MONITOR, RULES, Queued(), Notices(), Kept()),
            swap_to_light_ns=delay_ns,
            clock=FakeClock(NS_PER_S),
        )
        answers.frame(shown, 1005)
        newest = answers._frames.newest
        assert newest is not None
        lit.append((newest.host_ns, newest.light_ns))
    assert lit == [(3700, 1005), (1000, 1005)]


def judged(*residual_arcsec: float) -> Judged:
    """An answer that was wrong, and came 250 ms after its frames."""
    answer = Answer(NS_PER_S + 250 * NS_PER_MS, b"", None, Q)
    lit = Lit(Q, np.zeros(3), NS_PER_S, first=7, last=9)
    return Judged(answer, "wrong", NS_PER_S, 0.0, lit, np.array(residual_arcsec))


def test_a_wrong_answer_is_off_by_arcsec_or_by_degrees_as_a_person_reads_it():
    assert wrong_line(judged(300.0, 0.0, -400.0)) == (
        "the tracker's answer is off by 500 arcsec (x 300, y 0, z -400) in frames 7 to 9,"
        " 250 ms ago"
    )
    assert wrong_line(judged(10_800.0, 0.0, -14_400.0)) == (
        "the tracker's answer is off by 5.00 deg (x 3.00, y 0.00, z -4.00) in frames 7 to 9,"
        " 250 ms ago"
    )
