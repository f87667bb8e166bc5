"""What goes back to the sender: statuses at their rate, time requests while they are due, and
the exchanges they complete.
"""

from __future__ import annotations

import numpy as np
import pytest
import zmq

from hilstar.attitude.clock.sender_clock import MIN_EXCHANGES, Exchange
from hilstar.attitude.clock.timeline import Policy, Timeline
from hilstar.attitude.receiver import (
    ASK_NS,
    FIRST_ASKS,
    QUICK_ASK_NS,
    QUIET,
    BackChannel,
    Receiver,
    Traffic,
)
from hilstar.attitude.wire.links import Arrival
from hilstar.attitude.wire.packet import (
    AnswerPacket,
    AttitudeSample,
    Event,
    Packet,
    Status,
    TimeReply,
    TimeRequest,
    decode,
    encode,
)
from hilstar.attitude.wire.protocol import HEALTH_MISSED, HEALTH_REFUSED, HEALTH_STALE
from hilstar.attitude.wire.zmq_links import ZmqLockstep
from hilstar.basics.process.scheduling import HOST_CLOCK
from hilstar.basics.units import NS_PER_MS, NS_PER_S
from tests.support.waiting import wait_for

NOW_NS = 10**12
SENDER_AHEAD_NS = 7 * NS_PER_S


class Wire:
    """A two-way link that keeps what is sent; a packet takes 1 ms a byte."""

    two_way = True
    stamped = False

    def __init__(self) -> None:
        self.sent: list[Packet] = []

    def receive(self, timeout_ms: int) -> list[Arrival[Event]]:
        return []

    def wait_for_message(self, timeout_ms: int) -> bool:
        return False

    def send(self, packet: Packet) -> None:
        self.sent.append(packet)

    def wire_ns(self, packet: Packet) -> int:
        return len(encode(packet)) * NS_PER_MS


def status(frame: int, health: int = 0) -> Status:
    return Status(health, frame, frame, 0, 0, 0, 0)


def test_statuses_leave_at_their_rate_and_only_the_newest():
    link = Wire()
    back = BackChannel(link, Traffic(status_hz=10))
    for k in range(100):  # frames at 100 Hz
        back.post(status(k))
        back.talk(NOW_NS + k * NS_PER_S // 100, ask=True)
    assert [packet.frame for packet in link.sent if isinstance(packet, Status)] == list(
        range(0, 100, 10)
    )


def test_statuses_keep_their_rate_where_no_look_is_at_their_time():
    """Looks every 7 ms, of which few fall on a tenth of a second: the next status is due by the
    last one's own time. After a pause of a second they go on, one at a time.
    """
    link = Wire()
    back = BackChannel(link, Traffic(status_hz=10))
    sent_ns = []
    looks_ns = [
        *range(0, 10 * NS_PER_S, 7 * NS_PER_MS),
        *range(11 * NS_PER_S, 12 * NS_PER_S, NS_PER_MS),
    ]
    for k, after_ns in enumerate(looks_ns):
        back.post(status(k))
        before = len(link.sent)
        back.talk(NOW_NS + after_ns, ask=False)
        assert len(link.sent) - before <= 1
        sent_ns += [after_ns] * (len(link.sent) - before)
    steady = [after_ns for after_ns in sent_ns if after_ns < 10 * NS_PER_S]
    assert len(steady) == 100
    late_ns = np.array(steady) - np.arange(100) * NS_PER_S // 10
    assert ((late_ns >= 0) & (late_ns < 7 * NS_PER_MS)).all()
    assert len(sent_ns) - len(steady) == 10


def test_a_status_that_never_left_hands_on_what_is_told_once():
    link = Wire()
    back = BackChannel(link, Traffic(status_hz=10))
    back.post(status(1, HEALTH_MISSED | HEALTH_STALE))
    back.post(status(2, HEALTH_REFUSED))
    back.post(status(3))
    back.talk(NOW_NS, ask=False)
    assert link.sent == [status(3, HEALTH_MISSED | HEALTH_REFUSED)]


def test_a_quiet_channel_sends_nothing():
    link = Wire()
    back = BackChannel(link, QUIET)
    back.post(status(1))
    back.talk(NOW_NS, ask=True)
    assert link.sent == []


def test_time_requests_are_quick_at_first_and_again_once_there_is_a_sender():
    link = Wire()
    back = BackChannel(link, Traffic(time_requests=True))
    back.talk(NOW_NS, ask=False)
    assert link.sent == []
    asked_ns = []
    for after_ns in range(0, 5 * NS_PER_S, 10 * NS_PER_MS):
        if after_ns == 3 * NS_PER_S:
            back.ask_quickly(NOW_NS + after_ns)
        before = len(link.sent)
        back.talk(NOW_NS + after_ns, ask=True)
        asked_ns += [after_ns] * (len(link.sent) - before)
    steps_ns = np.diff(asked_ns)
    again = asked_ns.index(3 * NS_PER_S)
    assert (steps_ns[: FIRST_ASKS - 1] == QUICK_ASK_NS).all()
    assert (steps_ns[FIRST_ASKS - 1 : again - 1] == ASK_NS).all()
    assert (steps_ns[again : again + FIRST_ASKS - 1] == QUICK_ASK_NS).all()


def test_a_reply_completes_its_own_request_once_on_continuous_times():
    link = Wire()
    back = BackChannel(link, Traffic(time_requests=True))
    back.talk(NOW_NS, ask=True)
    (request,) = link.sent
    assert isinstance(request, TimeRequest)
    reply = TimeReply(request.sequence, request.t1_ns, 500, 600)
    t4_ns = request.t1_ns + NS_PER_S
    assert back.exchange(TimeReply(99, request.t1_ns, 500, 600), t4_ns, 0) is None
    assert back.exchange(reply, t4_ns, 1000) == Exchange(
        request.t1_ns, 1500, 1600, t4_ns, there_ns=20 * NS_PER_MS, back_ns=36 * NS_PER_MS
    )
    assert back.exchange(reply, t4_ns, 0) is None


def test_a_reply_to_another_program_s_request_of_the_same_number_is_none():
    """Two that ask one sender both count from 1, by clocks of their own."""
    link = Wire()
    back = BackChannel(link, Traffic(time_requests=True))
    back.talk(NOW_NS, ask=True)
    (request,) = link.sent
    for t1_ns in (request.t1_ns + 1, request.t1_ns - NS_PER_S):
        reply = TimeReply(request.sequence, t1_ns, 500, 600)
        assert back.exchange(reply, request.t1_ns + NS_PER_S, 0) is None
    own = TimeReply(request.sequence, request.t1_ns, 500, 600)
    assert back.exchange(own, request.t1_ns + NS_PER_S, 0) is not None


def test_a_request_of_the_sender_is_answered_with_its_own_time_and_the_arrival():
    link = Wire()
    BackChannel(link, QUIET, lambda: NOW_NS).answer(
        request := TimeRequest(3, 4), Arrival(5, request)
    )
    assert link.sent == [TimeReply(3, 4, 5, NOW_NS)]


class Answering(Wire):
    """A sender 7 s ahead that sends an attitude each millisecond and answers time requests at
    once.
    """

    def __init__(self) -> None:
        super().__init__()
        self.now_ns = NOW_NS
        self.answered = self._sequence = 0

    def receive(self, timeout_ms: int) -> list[Arrival[Event]]:
        self.now_ns += NS_PER_MS
        self._sequence += 1
        sample = AttitudeSample(
            self.now_ns + SENDER_AHEAD_NS, np.array([1.0, 0.0, 0.0, 0.0]), None, self._sequence
        )
        arrived: list[Arrival[Event]] = [Arrival(self.now_ns, sample, encode(sample))]
        for packet in self.sent:
            if isinstance(packet, TimeRequest):
                t_ns = self.now_ns + SENDER_AHEAD_NS
                arrived.append(
                    Arrival(self.now_ns, TimeReply(packet.sequence, packet.t1_ns, t_ns, t_ns), b"")
                )
                self.answered += 1
        self.sent.clear()
        return arrived

    def wire_ns(self, packet: Packet) -> int:
        return 0


def test_a_sender_that_answers_is_synchronised_within_what_the_summary_states():
    link = Answering()
    timeline = Timeline(Policy(NS_PER_S, NS_PER_S))
    receiver = Receiver(link, timeline, Traffic(time_requests=True), now_ns=lambda: link.now_ns)
    receiver.learn()
    while link.answered < MIN_EXCHANGES:
        receiver.listen()
    told = receiver.clock_summary()
    assert told.mode == "exchange"
    assert told.exchanges >= MIN_EXCHANGES
    assert told.offset_ms == pytest.approx(-SENDER_AHEAD_NS / NS_PER_MS, abs=told.uncertainty_ms)


def test_in_lockstep_a_time_request_is_answered_with_when_it_came_and_when_the_answer_left():
    """Both between the asker's own readings, in this order; it is no request for a frame."""
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    with ZmqLockstep("tcp://127.0.0.1:*") as link, context.socket(zmq.REQ) as asker:
        asker.setsockopt(zmq.LINGER, 0)
        asker.connect(link.endpoint)
        asked_ns = HOST_CLOCK.now_ns()
        asker.send(encode(TimeRequest(3, 4)))
        wait_for(lambda: link.receive(20) or asker.poll(0))
        reply = decode(asker.recv())
        assert isinstance(reply, TimeReply)
        assert (reply.sequence, reply.t1_ns) == (3, 4)
        assert asked_ns < reply.t2_ns < reply.t3_ns < HOST_CLOCK.now_ns()
    context.term()


def test_statuses_and_requests_go_to_the_sender_that_is_shown():
    """Of several senders at one port; of a link with one peer, to that."""
    link = Wire()
    back = BackChannel(link, Traffic(status_hz=10, time_requests=True))
    sent: dict[str, list[Packet]] = {"first": [], "second": []}
    sample = AttitudeSample(0, np.array([1.0, 0.0, 0.0, 0.0]), None, 0)
    back.follow(Arrival(NOW_NS, sample))
    back.post(status(1))
    back.talk(NOW_NS, ask=False)
    assert link.sent == [status(1)]
    for k, name in enumerate(("first", "second"), start=1):
        back.follow(Arrival(NOW_NS, sample, back=sent[name].append))
        back.post(status(k))
        back.talk(NOW_NS + k * NS_PER_S, ask=True)
        kinds = [type(packet) for packet in sent[name]]
        assert kinds == [TimeRequest, Status]
        assert sent[name][1] == status(k)
    assert len(link.sent) == 1


def test_answers_are_passed_on_in_their_order_and_each_once():
    link = Wire()
    back = BackChannel(link, Traffic())
    answers = [
        AnswerPacket(0, k, k, np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3), k) for k in range(3)
    ]
    for answer in answers[:2]:
        back.pass_on(answer)
    back.talk(NOW_NS, ask=False)
    assert link.sent == answers[:2]
    back.pass_on(answers[2])
    back.talk(NOW_NS, ask=False)
    assert link.sent == answers
