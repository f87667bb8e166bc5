"""Faults over ZeroMQ: what a message does, and that no message ends a run or fills its memory."""

from __future__ import annotations

import json
import time
from pathlib import Path

import pytest
import zmq

from hilstar.basics.notices import Notices
from hilstar.server.bench.scenario import FaultSchedule, parse_scenario
from hilstar.server.faults import MAX_BURST, MAX_MESSAGE_BYTES, MAX_PER_S, FaultStream, act
from tests.support.refusals import refusal
from tests.support.senders import await_subscriber, publishing
from tests.support.waiting import wait_for

STAR = {"kind": "false-star", "name": "ghost", "tracker_px": [10, 20], "electrons": 5e4}
SCENARIO = parse_scenario(Path("f.toml"), '[[fault]]\nkind = "blank"\nname = "cover"')


def test_a_message_asks_for_a_fault_and_starts_and_stops_by_name():
    schedule = FaultSchedule(SCENARIO)
    schedule.at(0)
    act(schedule, json.dumps(STAR).encode())
    act(schedule, b'{"start": "cover"}')
    assert [now.fault.name for now in schedule.at(10)] == ["ghost", "cover"]
    act(schedule, b'{"stop": "ghost"}')
    assert [now.fault.name for now in schedule.at(20)] == ["cover"]


@pytest.mark.parametrize(
    ("raw", "said"),
    [
        (b"", "no JSON"),
        (b"\xff\xfe\x00", "no JSON"),
        (b"[1, 2]", "is list, no object"),
        (b"[" * 10_000, "no JSON"),
        (b'{"start": "ghost"}', "no fault is called 'ghost'; known are cover"),
        (b'{"stop": "cover"}', "not on"),
        (b'{"start": "cover", "for_s": 1}', "write a JSON object"),
        (b'{"kind": "false-star"}', "the key name is missing"),
        (b'{"kind": "false-star", "name": "x", "tracker_px": [1e999, 0], "electrons": 5}', ""),
        (b'{"kind": "blank", "name": "x", "why": 1}', "unknown key why"),
        (b'{"kind": ["blank"], "name": "x"}', "kind = ['blank']; did you mean blank? write one of"),
    ],
)
def test_a_bad_message_is_refused_in_a_line(raw, said):
    schedule = FaultSchedule(SCENARIO)
    assert said in refusal(act, schedule, raw)
    assert schedule.on() == []


@pytest.fixture
def stream():
    schedule, notices = FaultSchedule(SCENARIO), Notices()
    opened = FaultStream(schedule, "tcp://127.0.0.1:*", bind=True, notices=notices)
    context = zmq.Context()
    sender = publishing(context)
    try:
        wait_for(lambda: not opened._link.endpoint.endswith("*"))
        sender.connect(opened._link.endpoint)
        await_subscriber(sender)
        yield schedule, opened, sender
    finally:
        sender.close(linger=0)
        context.term()
        opened.close()


def test_faults_come_in_over_a_socket_and_bad_messages_are_counted(stream):
    schedule, opened, sender = stream
    bad = (b"nonsense", b"[]", b'{"start": 5}')
    for message in (*bad, json.dumps(STAR).encode(), b'{"start": "cover"}'):
        sender.send(message)
    wait_for(lambda: len(schedule.on()) == 2)
    assert schedule.on() == ["ghost", "cover"]
    assert opened.summary()["messages"] == 5 and opened.summary()["refused"] == 3


def test_a_flood_and_a_huge_message_leave_the_schedule_bounded_and_listening(stream):
    schedule, opened, sender = stream
    begun_s = time.monotonic()
    for number in range(3000):
        sender.send(json.dumps(STAR | {"name": f"ghost {number}"}).encode())
    wait_for(lambda: opened.messages >= 1000)
    assert len(schedule.on()) <= MAX_BURST + MAX_PER_S * (time.monotonic() - begun_s) + 1
    sender.send(b"x" * (MAX_MESSAGE_BYTES + 1))  # drops the connection
    wait_for(lambda: opened._link.link_counts.connections >= 2)
    await_subscriber(sender)
    before = opened.messages
    sender.send(b'{"start": "cover"}')
    wait_for(lambda: opened.messages > before)
