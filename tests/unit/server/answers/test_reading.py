"""What the process that reads a tracker's line hands over: answers as they were decoded, counts of
refusals with examples, and of a flood no more than its limits, by a clock that stands.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hilstar.attitude.wire.roads import RawMessage
from hilstar.basics.notices import Notices
from hilstar.basics.units import NS_PER_S
from hilstar.server.answers.formats import RefusedAnswer
from hilstar.server.answers.reader import (
    FLOOD,
    FLOOD_REST_S,
    MAX_ANSWERS_PER_S,
    MAX_BURST_BYTES,
    MAX_BYTES_PER_S,
    MAX_DETAILS,
    MAX_WORK_S,
    PIECE_BYTES,
    WORK_SHARE,
    DecodingLink,
    HandedOver,
    ReadPlan,
    handed_over,
    live_answers,
    newest_details,
    recorded_answers,
)
from tests.support.fake_clock import FakeClock
from tests.unit.server.answers.test_formats import settings_of

JSON = {"format": "json", "fields": []}
ANSWER = {
    "t_ns": 77,
    "q": [0.1, -0.5, 0.7, -0.5],
    "rate": [0.01, -0.02, 0.03],
    "mode": "track",
    "stars": 9,
    "centroids": [[1.5, 2.5, 300.0, 24436], [3.5, 4.5]],
}
POLLED = {"poll_hex": "0aff", "connect": "127.0.0.1:7000"}
LINE = json.dumps(ANSWER).encode() + b"\n"


class Road:
    """A line whose bytes are the test's: chunks by the call of `taken` that gives them."""

    endpoint = "a test"
    link_counts = SimpleNamespace(lost=3)

    def __init__(self, clock: FakeClock, chunks: Sequence[list[bytes]], messages: bool) -> None:
        self.messages = messages
        self.trouble = ""
        self.asked: list[bytes] = []
        self.waited_ms: list[int] = []
        self._clock = clock
        self._chunks = list(chunks)

    def taken(self, timeout_ms: int) -> list[RawMessage]:
        self.waited_ms.append(timeout_ms)
        if not self._chunks:
            self._clock.work(timeout_ms * 1e6)
            return []
        chunks = self._chunks.pop(0)
        return [RawMessage(self._clock.ns - 5, [b"topic", chunk]) for chunk in chunks]

    def put(self, data: bytes) -> None:
        self.asked.append(data)

    def close(self) -> None:
        """Nothing to close."""


class Link:
    """The reader of a line that gives chunks, and what it handed over at each call."""

    def __init__(
        self, chunks: Sequence[list[bytes]], *, messages: bool = False, **keys: Any
    ) -> None:
        self.clock = FakeClock(100 * NS_PER_S)
        self.road = Road(self.clock, chunks, messages)
        plan = ReadPlan(settings_of(**(JSON | keys)), Path(), None)
        opened = SimpleNamespace(
            settings=plan.settings, open=lambda *_: self.road, decoder=plan.decoder
        )
        self.link = DecodingLink(opened, Notices(), self.clock)

    def take(self) -> list[HandedOver]:
        """What one call hands over."""
        return [handed_over(message.parts[0]) for message in self.link.taken(50)]


def test_an_answer_is_handed_over_with_each_of_its_figures():
    link = Link([[LINE[:40], LINE[40:] + LINE]])
    first, second, line = link.take()
    assert line.trouble == ""
    answer = first.answer
    assert answer is not None and second.answer is not None
    assert (answer.host_ns, answer.t_ns, answer.valid) == (100 * NS_PER_S - 5, 77, True)
    assert (answer.mode, answer.star_count) == ("track", 9)
    norm = np.linalg.norm(ANSWER["q"])
    np.testing.assert_allclose(answer.q_icrs_to_cam, np.array(ANSWER["q"]) / norm, rtol=1e-12)
    np.testing.assert_allclose(answer.rate_cam_rad_s, ANSWER["rate"])
    assert [tuple(star)[:4] for star in answer.centroids] == [
        (1.5, 2.5, 300.0, 24436),
        (3.5, 4.5, None, None),
    ]
    assert answer.raw == LINE.strip()
    assert link.take() == []  # the line is as it was
    assert not link.link.wait_for_message(10) and link.link.link_counts.lost == 3


def test_refusals_are_counted_by_reason_with_the_newest_example():
    link = Link([[b'{"q": 3}\n[1]\n{"q": [1, 0, 0, "x"]}\n', LINE]])
    answered, refused, _ = link.take()
    assert answered.answer is not None
    assert sum(refused.refused.values()) == 3 and set(refused.details) == set(refused.refused)
    assert refused.answer is None and FLOOD not in refused.refused
    assert link.clock.slept_s == [0.0]


def test_of_many_reasons_the_examples_of_the_newest_are_kept():
    many = {str(k): f"of {k}" for k in range(MAX_DETAILS)}
    kept = newest_details(many, {"new": "a new one", "3": "another of 3"})
    assert list(kept) == [str(k) for k in range(1, MAX_DETAILS) if k != 3] + ["new", "3"]
    assert (kept["3"], kept["4"]) == ("another of 3", "of 4")


def test_a_fault_of_the_line_is_told_when_it_changes():
    link = Link([[], [], [], []])
    assert [told.trouble for told in link.take()] == [""]
    link.road.trouble = "unplugged"
    assert [told.trouble for told in link.take()] == ["unplugged"]
    assert link.take() == []
    link.road.trouble = ""
    assert [told.trouble for told in link.take()] == [""]


def test_of_a_flood_of_answers_so_many_a_second_are_handed_over():
    many = [LINE] * (MAX_ANSWERS_PER_S + 50)
    link = Link([many, [LINE] * 60], messages=True)
    told = link.take()
    assert sum(each.answer is not None for each in told) == MAX_ANSWERS_PER_S
    (refused,) = [each for each in told if each.refused]
    assert refused.refused == {FLOOD: 50}
    assert "200 answers a second" in refused.details[FLOOD]
    assert link.clock.slept_s == [FLOOD_REST_S]
    # a tenth of a second after the first look there is room for a tenth of them
    link.clock.work(0.1 * NS_PER_S - FLOOD_REST_S * NS_PER_S)
    told = link.take()
    assert sum(each.answer is not None for each in told) == MAX_ANSWERS_PER_S // 10


def test_of_a_flood_of_bytes_a_burst_is_read_and_then_so_many_a_second():
    noise = b"x" * PIECE_BYTES
    burst = MAX_BURST_BYTES // PIECE_BYTES
    link = Link([[noise * (burst + 9)], [noise * 40]])
    (refused,) = [each for each in link.take() if FLOOD in each.refused]
    assert refused.refused[FLOOD] == 9
    assert "500000 bytes a second" in refused.details[FLOOD]
    link.clock.work(0.1 * NS_PER_S - FLOOD_REST_S * NS_PER_S)
    (refused,) = [each for each in link.take() if FLOOD in each.refused]
    left_bytes = MAX_BURST_BYTES - burst * PIECE_BYTES + MAX_BYTES_PER_S / 10
    assert refused.refused[FLOOD] == 40 - int(left_bytes // PIECE_BYTES)
    # a line that was idle for a minute has saved up no more than a burst
    link.road._chunks = [[noise * (burst + 9)]]
    link.clock.work(60 * NS_PER_S)
    (refused,) = [each for each in link.take() if FLOOD in each.refused]
    assert refused.refused[FLOOD] == 9


def test_a_message_is_decoded_whole_and_a_stream_in_pieces():
    """A message of more than a burst is dropped; a stream as long is read as far as the burst."""
    long = b" " * (MAX_BURST_BYTES + 1)
    (refused,) = [each for each in Link([[long]], messages=True).take() if each.refused]
    assert refused.refused == {FLOOD: 1}
    padded = LINE.strip().ljust(3 * PIECE_BYTES) + b"\n"
    for messages in (True, False):
        told = Link([[padded]], messages=messages).take()
        assert sum(each.answer is not None for each in told) == 1


def test_noise_that_takes_long_to_search_leaves_most_of_the_time_to_others():
    link = Link([[LINE] * 10, [LINE] * 10], messages=True)
    decode = link.link._decoder.feed

    def slow(host_ns: int, data: bytes):
        link.clock.work(0.03 * NS_PER_S)
        return decode(host_ns, data)

    link.link._decoder.feed = slow
    told = link.take()
    # 0.1 s of work at once: the fourth of 30 ms each begins within it
    assert sum(each.answer is not None for each in told) == 4
    spent_s = 4 * 0.03
    rest_s = FLOOD_REST_S
    link.clock.work((0.35 - rest_s) * NS_PER_S)
    # the clock has gone on by the work itself, too
    left_s = MAX_WORK_S - spent_s + (spent_s + 0.35) * WORK_SHARE
    told = link.take()
    assert sum(each.answer is not None for each in told) == int(np.ceil(left_s / 0.03))


def test_no_answer_is_lost_where_other_programs_have_the_core():
    link = Link([[LINE] * 10], messages=True)
    decode = link.link._decoder.feed

    def held_up(host_ns: int, data: bytes):
        link.clock.hold_up(0.3 * NS_PER_S)
        return decode(host_ns, data)

    link.link._decoder.feed = held_up
    told = link.take()
    assert sum(each.answer is not None for each in told) == 10


def test_a_tracker_that_is_polled_is_asked_at_its_rate_and_waited_for_no_longer():
    link = Link([[]], poll_hz=20.0, **POLLED)
    for _ in range(8):
        link.take()
        link.clock.work(0.01 * NS_PER_S)
    # the first look takes no time, so that the second comes before the next question is due
    assert link.road.waited_ms == [50, 40] + [50] * 6
    assert link.road.asked == [b"\x0a\xff"] * 7


def test_a_tracker_that_speaks_by_itself_is_not_asked():
    link = Link([[]])
    link.take()
    assert (link.road.asked, link.road.waited_ms) == ([], [50])


def test_a_recorded_line_gives_its_answers_and_the_last_one_without_an_end(tmp_path):
    path = tmp_path / "line.bin"
    path.write_bytes(LINE + b"[1]\n" + LINE.strip())
    plan = ReadPlan(settings_of(**JSON), tmp_path, None)
    first, refused, last = recorded_answers(plan, plan.decoder(False), path)
    assert isinstance(refused, RefusedAnswer)
    assert (first.t_ns, last.t_ns, first.host_ns) == (77, 77, 0)


@pytest.mark.parametrize(
    ("polled", "waited_ms", "asked"),
    [
        ({}, {100}, 0),
        (POLLED | {"poll_hz": 10.0}, {100}, 10),
        # no longer than until the next question, and no longer than a look
        (POLLED | {"poll_hz": 25.0}, {40}, 24),
        (POLLED | {"poll_hz": 4.0}, {100, 50}, 4),
    ],
)
def test_an_open_line_is_read_for_so_long(polled, waited_ms, asked):
    clock = FakeClock(100 * NS_PER_S)
    road = Road(clock, [[LINE], [], [LINE]], messages=True)
    plan = ReadPlan(settings_of(**(JSON | polled)), Path(), None)
    found = list(live_answers(plan, road, plan.decoder(True), 0.95, lambda: False, clock))
    assert [answer.host_ns for answer in found] == [100 * NS_PER_S - 5] * 2
    assert clock.ns == pytest.approx(101 * NS_PER_S, abs=0.06 * NS_PER_S)
    assert set(road.waited_ms) == waited_ms
    assert road.asked == [b"\x0a\xff"] * asked


def test_an_open_line_is_read_until_it_is_stopped():
    clock = FakeClock(100 * NS_PER_S)
    road = Road(clock, [[LINE]] * 9, messages=True)
    plan = ReadPlan(settings_of(**JSON), Path(), None)
    found = []
    for answer in live_answers(plan, road, plan.decoder(True), 1e9, lambda: len(found) > 2, clock):
        found.append(answer)
    assert len(found) == 3
