"""Over ZeroMQ in one process: requests in lockstep and their answers, and what a feed hands on."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import zmq

from hilstar.attitude.wire.links import Arrival
from hilstar.attitude.wire.packet import (
    AttitudeSample,
    Event,
    Refusal,
    Status,
    TimeReply,
    TimeRequest,
    decode,
    encode,
)
from hilstar.attitude.wire.zmq_links import (
    MAX_SUBSCRIPTION_BYTES,
    FedDecoder,
    Feed,
    ZmqLockstep,
    ZmqReceiver,
    ZmqRoad,
    ZmqSender,
)
from tests.support.fake_clock import FakeClock
from tests.support.waiting import wait_for

SAMPLE = AttitudeSample(1_500, np.array([0.5, -0.5, 0.5, 0.5]), np.array([0.25, 0.0, -0.5]), 7)
STATUS = Status(3, 41, 2_000, 500, 7, 40, 1)
SOON_MS = 20
LATE_MS = 20_000  # a bound alone: an answer waits already


@contextmanager
def client_of(endpoint: str) -> Iterator[zmq.Socket[bytes]]:
    """A simulation that asks."""
    with zmq.Context() as context, context.socket(zmq.REQ) as client:
        client.setsockopt(zmq.LINGER, 0)
        client.setsockopt(zmq.RCVTIMEO, LATE_MS)
        client.connect(endpoint)
        yield client


def asked(link: ZmqLockstep, client: zmq.Socket[bytes], message: bytes) -> Arrival[Event]:
    """A request of a simulation, as the link has it."""
    client.send(message)
    came: list[Arrival[Event]] = []

    def is_here() -> bool:
        arrival = link.receive(SOON_MS)
        if arrival is not None:
            came.append(arrival)
        return bool(came)

    wait_for(is_here, "the request")
    return came[0]


@pytest.mark.parametrize("refusal", [None, Refusal("norm", "its norm is 2")])
def test_a_request_is_answered_in_the_form_in_which_it_was_asked(tmp_path: Path, refusal) -> None:
    endpoint = f"ipc://{tmp_path}/lockstep"
    with ZmqLockstep(endpoint) as link, client_of(endpoint) as client:
        q, rate = SAMPLE.q_icrs_to_cam.tolist(), [0.25, 0.0, -0.5]
        form = json.dumps({"t_ns": 1_500, "q": q, "rate": rate, "sequence": 7}).encode()
        for message in (encode(SAMPLE), b" \n" + form, encode(SAMPLE)):
            arrival = asked(link, client, message)
            assert encode(arrival.event) == encode(SAMPLE)
            assert arrival.raw == message
            link.answer(STATUS, 1_990, refusal)
            answer = client.recv()
            if message[:1] == b"\x01":
                assert decode(answer) == STATUS
                continue
            trouble = None
            if refusal is not None:
                trouble = {"reason": "norm", "detail": "its norm is 2"}
            assert json.loads(answer) == {
                "health": 3,
                "frame": 41,
                "light_t_ns": 2_000,
                "attitude_age_ns": 500,
                "attitude_sequence": 7,
                "accepted": 40,
                "shown_ns": 1_990,
                "refused": trouble,
            }


def test_a_request_for_the_time_is_answered_by_itself(tmp_path: Path) -> None:
    endpoint = f"ipc://{tmp_path}/lockstep"
    clock = FakeClock(9_000)
    with ZmqLockstep(endpoint, clock=clock) as link, client_of(endpoint) as client:
        client.send(encode(TimeRequest(12, 345)))
        wait_for(lambda: link.receive(0) is None and client.poll(SOON_MS), "the reply")
        assert decode(client.recv()) == TimeReply(12, 345, 9_000, 9_000)


@pytest.mark.parametrize("is_hilstar_s", [True, False])
def test_a_feed_hands_on_hilstar_s_own_bytes_and_packets_of_any_other_attitude(
    tmp_path: Path, is_hilstar_s: bool
) -> None:
    """What a source of another form brought, heads could not decode."""
    endpoint = f"ipc://{tmp_path}/feed"
    raw = encode(SAMPLE) if is_hilstar_s else b"42: another program's text"
    with Feed(endpoint) as feed, ZmqReceiver(endpoint, decoder=FedDecoder()) as link:
        came: list[Arrival[Event]] = []

        def is_here() -> bool:
            feed.give(Arrival(-77, SAMPLE, raw))  # one before the subscription is lost
            came.extend(link.receive(SOON_MS))
            return bool(came)

        wait_for(is_here, "what the feed hands on")
    assert {arrival.host_ns for arrival in came} == {-77}
    assert {arrival.raw for arrival in came} == {encode(SAMPLE)}


def test_a_subscriber_that_reads_late_loses_nothing_of_ten_seconds_at_400_hz(
    tmp_path: Path,
) -> None:
    """4000 messages of 1 kB: more than libzmq's own queue of 1000 and the kernel's buffer take."""
    endpoint = f"ipc://{tmp_path}/late"
    count, message = 4000, bytes(1000)
    with (
        zmq.Context() as context,
        context.socket(zmq.SUB) as subscriber,
        ZmqSender(endpoint) as sender,
    ):
        subscriber.setsockopt(zmq.RCVTIMEO, LATE_MS)
        subscriber.setsockopt(zmq.RCVHWM, 100)
        subscriber.subscribe(b"")
        subscriber.connect(endpoint)
        assert sender.wait_for_listener(LATE_MS / 1000)
        sent = sum(sender.put(message) for _ in range(count))
        came = sum(len(subscriber.recv()) == len(message) for _ in range(count))
    assert sent == came == count


def test_a_road_keeps_as_many_messages_as_it_was_given(tmp_path: Path) -> None:
    with ZmqRoad(f"ipc://{tmp_path}/queue", queue_messages=37) as road:
        road.wait_for_message(0)  # it opens
        assert road._socket is not None
        assert road._socket.getsockopt(zmq.RCVHWM) == 37


def test_another_process_opens_a_road_with_its_topic(tmp_path: Path) -> None:
    endpoint = f"ipc://{tmp_path}/topic"
    with ZmqRoad(endpoint, topic=b"star ") as road:
        open_again = road.opener()
    came: list[bytes] = []
    with Feed(endpoint) as feed, open_again(notices=None) as link:

        def is_here() -> bool:
            for text in (b"sun 1", b"star 2"):
                feed._socket.send(text)
            came.extend(arrival.raw for arrival in link.receive(SOON_MS))
            return bool(came)

        wait_for(is_here, "a message of the topic")
    assert set(came) == {b"star 2"}


def test_a_feed_hands_on_what_is_no_attitude_as_it_came(tmp_path: Path) -> None:
    endpoint = f"ipc://{tmp_path}/feed"
    refused = Refusal("format", "no packet")
    with Feed(endpoint) as feed, ZmqReceiver(endpoint, decoder=FedDecoder()) as link:
        came: list[Arrival[Event]] = []

        def is_here() -> bool:
            feed.give(Arrival(5, refused, b"nonsense"))
            came.extend(link.receive(SOON_MS))
            return bool(came)

        wait_for(is_here, "what the feed hands on")
    assert came[0].raw == b"nonsense"
    assert isinstance(came[0].event, Refusal)


def test_a_subscription_is_short_and_who_sends_another_is_disconnected(tmp_path: Path) -> None:
    """A subscriber's topic is all that a sender reads; a megabyte of it would fill its memory."""
    endpoint = f"ipc://{tmp_path}/feed"
    with ZmqSender(endpoint) as sender, zmq.Context() as context:
        with context.socket(zmq.SUB) as usual:
            usual.setsockopt(zmq.SUBSCRIBE, b"x" * (MAX_SUBSCRIPTION_BYTES // 2))
            usual.connect(endpoint)
            assert sender.wait_for_listener(LATE_MS / 1000)
        with context.socket(zmq.SUB) as long:
            long.linger = 0
            monitor = long.get_monitor_socket(zmq.EVENT_DISCONNECTED)
            monitor.setsockopt(zmq.RCVTIMEO, LATE_MS)
            long.setsockopt(zmq.SUBSCRIBE, b"x" * (4 * MAX_SUBSCRIPTION_BYTES))
            long.connect(endpoint)

            def is_dropped() -> bool:
                sender.put(b"")
                return monitor.poll(SOON_MS) != 0

            wait_for(is_dropped, "the end of the connection")
            long.disable_monitor()
            monitor.close()
