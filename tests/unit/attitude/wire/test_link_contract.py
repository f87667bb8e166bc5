"""The one contract of all links whose sender runs freely, over real sockets and ptys, and of those
that a process of their own reads.
"""

from __future__ import annotations

import contextlib
import socket
import time
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
import pytest

from hilstar.attitude.wire.endpoint import AllowedSenders, bound_place
from hilstar.attitude.wire.links import (
    MAX_BURST,
    MAX_PACKETS_PER_S,
    Arrival,
    FloodGate,
    PacketDecoder,
    StreamLink,
    pieces,
)
from hilstar.attitude.wire.nasa42 import MessageReader, Nasa42Link
from hilstar.attitude.wire.packet import (
    AttitudeSample,
    Event,
    Refusal,
    Status,
    TimeReply,
    TimeRequest,
    decode,
    encode,
    framed,
)
from hilstar.attitude.wire.roads import LinkCounts, RawMessage
from hilstar.attitude.wire.serial_link import SerialApart
from hilstar.attitude.wire.source import Mounting
from hilstar.attitude.wire.udp import UdpLink
from hilstar.attitude.wire.zmq_links import FedDecoder, ZmqApart
from hilstar.basics.notices import Notices
from tests.support.fake_clock import FakeClock
from tests.support.waiting import wait_for
from tests.support.wire.far_ends import (
    LOOPBACK,
    FarEnd,
    Nasa42Far,
    Q,
    SerialFar,
    UdpFar,
    VizardFar,
    ZmqFar,
    attitude_packet,
)

KINDS: dict[str, Callable[..., FarEnd]] = {
    "zmq": ZmqFar,
    "serial": SerialFar,
    "udp": UdpFar,
    "42": Nasa42Far,
    "vizard": VizardFar,
}
APART: dict[str, Callable[..., FarEnd]] = {
    f"{name} apart": partial(kind, apart=True)
    for name, kind in KINDS.items()
    if kind in {ZmqFar, SerialFar, VizardFar}
}
READ_MS = 20
BATCH = 50  # as many as any road holds unread
FLOODED = 6 * BATCH

each_kind = pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)
each_kind_and_apart = pytest.mark.parametrize(
    "kind", [*KINDS.values(), *APART.values()], ids=[*KINDS, *APART]
)


class Ends:
    """Both ends of a road, and what has come so far."""

    def __init__(self, far: FarEnd, link: StreamLink, notices: Notices) -> None:
        self.far = far
        self.link = link
        self.notices = notices
        self.next_number = 0

    def read(self) -> list[Arrival[Event]]:
        return self.link.receive(READ_MS)

    def is_empty(self) -> bool:
        """Whether nothing waits but another process's signs of life, which come every 0.1 s."""
        if not self.link.wait_for_message(0):
            return True
        return isinstance(self.link, (SerialApart, ZmqApart)) and not self.read()

    def numbers(self, arrivals: list[Arrival[Event]]) -> list[int]:
        samples = [arrival.event for arrival in arrivals]
        return [self.far.number(event) for event in samples if isinstance(event, AttitudeSample)]

    def open(self) -> list[Arrival[Event]]:
        """Send until something is heard and then to the last one sent: the road stands, and is
        empty.
        """
        came: list[Arrival[Event]] = []

        def heard() -> bool:
            self.far.send(self.next_number)
            self.next_number += 1
            came.extend(self.read())
            return bool(came)

        wait_for(heard, "the road stands", poll_s=0.005)
        return came + self.until(self.next_number - 1, self.numbers(came))

    def until(self, number: int, before: list[int]) -> list[Arrival[Event]]:
        """What comes until that attitude has."""
        came: list[Arrival[Event]] = []

        def heard() -> bool:
            if number in [*before, *self.numbers(came)]:
                return True
            came.extend(self.read())
            return False

        wait_for(heard, f"attitude {number}", poll_s=0.0)
        return came

    def sent(self, count: int) -> list[Arrival[Event]]:
        """What comes of the next attitudes."""
        for _ in range(count):
            self.far.send(self.next_number)
            self.next_number += 1
        return self.until(self.next_number - 1, [])


@pytest.fixture
def ends(kind, tmp_path) -> Iterator[Ends]:
    far, notices = kind(tmp_path), Notices()
    with contextlib.closing(far.link(notices)) as link:
        yield Ends(far, link, notices)
    far.vanish()


def noticed(notices: Notices, kinds: set[str]) -> dict[str, int]:
    return {kind: count for kind, count in notices.counts().items() if kind in kinds}


@each_kind_and_apart
def test_a_new_link_says_nothing_and_brings_each_attitude_once_in_order_as_it_was_sent(ends):
    link = ends.link
    assert link.link_counts == LinkCounts()
    assert (link.reconnects, link.trouble, link.steps) == (0, "", False)
    assert link.verb and link.endpoint.partition(":")[0] in {"tcp", "udp", "serial"}
    assert ends.is_empty()
    before_ns = time.monotonic_ns()
    opened = ends.open()
    came = ends.sent(BATCH)
    after_ns = time.monotonic_ns()
    numbers = ends.numbers(opened + came)
    # all from the first that was heard
    assert numbers == list(range(numbers[0], ends.next_number))
    for arrival in came:
        q = arrival.event.q_icrs_to_cam
        assert min(np.abs(q - Q).max(), np.abs(q + Q).max()) < 1e-12
        assert before_ns <= arrival.host_ns <= after_ns
        assert arrival.waited_ns >= 0
        assert arrival.raw
    assert link.link_counts.lost == link.link_counts.flooded == link.reconnects == 0
    assert ends.is_empty()


@each_kind
def test_what_is_no_attitude_is_one_refusal_and_the_next_attitude_is_taken(ends):
    ends.open()
    for _ in range(2):
        ends.far.put(ends.far.junk)
        first, *others = ends.sent(1)
        assert isinstance(first.event, Refusal) and first.event.reason in {"format", "crc"}
        assert ends.numbers(others) == [ends.next_number - 1]
    assert ends.link.link_counts.lost == 0


@each_kind_and_apart
def test_a_sender_that_vanishes_is_counted_and_told_once_and_heard_again_when_it_is_back(ends):
    """In the midst of a message, which is nothing after that."""
    link, far = ends.link, ends.far
    ends.open()
    for round_ in (1, 2):
        if far.cut:
            far.put(far.message(10**6)[:-5])
            wait_for(lambda: link.wait_for_message(READ_MS) and not ends.read(), "the beginning")
        far.vanish()
        if far.loses:
            wait_for(
                lambda round_=round_: not ends.read() and link.link_counts.lost == round_,
                "the loss",
            )
        for _ in range(3):
            assert ends.read() == []
            link.send(TimeRequest(1, 2))
        far.come()
        if far.cut:
            wait_for(
                lambda round_=round_: not ends.read() and link.reconnects >= round_, "the road"
            )
            # a line's other end begins a frame anew, too
            assert far.came_back() == (b"\0" if far.two_way else b"")
            (first,) = ends.sent(1)
            assert ends.numbers([first]) == [ends.next_number - 1]
        numbers = ends.numbers(ends.open())
        assert numbers == list(range(numbers[0], ends.next_number))
        assert link.link_counts.lost == far.loses * round_
        # On a busy machine ZeroMQ's road connects anew beside libzmq, which is a connection more.
        assert link.reconnects >= far.loses * round_
        notices = noticed(ends.notices, {"lost", "back"})
        assert notices.get("lost", 0) == far.loses * round_
        assert notices.get("back", 0) >= far.loses * round_


def still_gate(ends: Ends) -> FakeClock:
    """The link's gate, new, with a clock that only the gate's own pauses move."""
    clock = FakeClock()
    ends.link._gate = FloodGate(ends.link.link_counts, ends.notices, clock)
    return clock


def spent(ends: Ends) -> None:
    """Let as many through as may come at once."""
    for _ in range(MAX_BURST // BATCH):
        assert len(ends.numbers(ends.sent(BATCH))) == BATCH


@each_kind
def test_of_a_flood_what_the_gate_admits_is_taken_in_order_and_the_others_are_counted(ends):
    ends.open()
    clock = still_gate(ends)
    spent(ends)
    assert ends.link.link_counts.flooded == 0
    came: list[int] = []
    reads = 0
    for at in range(0, FLOODED, BATCH):
        for _ in range(BATCH):
            ends.far.send(ends.next_number)
            ends.next_number += 1

        def all_read(sent=at + BATCH) -> bool:
            nonlocal reads
            reads += 1
            came.extend(ends.numbers(ends.read()))
            return len(came) + ends.link.link_counts.flooded == sent

        wait_for(all_read, "the batch", poll_s=0.0)
    assert came == sorted(set(came))
    assert len(came) <= MAX_PACKETS_PER_S * sum(clock.slept_s)
    assert len(clock.slept_s) <= reads  # and not at each message that is passed over
    assert ends.link.link_counts.flooded >= FLOODED // 2
    assert noticed(ends.notices, {"flood"}) == {"flood": 1}


@each_kind
def test_a_jump_that_a_flood_passes_over_is_taken_all_the_same(ends):
    """No attitude is interpolated across it; 42 and Basilisk declare none."""
    ends.open()
    still_gate(ends)
    spent(ends)
    for k in range(BATCH):
        ends.far.send(ends.next_number + k, jump=k == BATCH // 2)
    came: list[AttitudeSample] = []

    def all_read() -> bool:
        came.extend(arrival.event for arrival in ends.read())
        return len(came) + ends.link.link_counts.flooded == BATCH

    wait_for(all_read, "the batch", poll_s=0.0)
    jumps = [ends.far.number(event) for event in came if event.discontinuity]
    assert jumps == [ends.next_number + BATCH // 2] * ends.far.declares
    assert ends.link.link_counts.flooded > 0


@each_kind
def test_what_goes_back_goes_to_the_sender_and_only_where_the_road_is_two_way(ends):
    link, far = ends.link, ends.far
    ends.open()
    for _ in range(BATCH):  # 42's acknowledgements
        far.came_back()
    assert link.two_way == far.two_way
    status = Status(1, 2, 3, 4, 5, 6, 7)
    if not far.two_way:
        link.send(status)
        assert far.came_back() == b""
        return
    request = encode(TimeRequest(5, 6))
    far.put(framed(request) if far.cut else request)
    came: list[Arrival[Event]] = []
    wait_for(lambda: came.extend(ends.read()) or came, "the request")
    (arrival,) = came
    assert arrival.event == TimeRequest(5, 6)
    back = arrival.back or link.send
    # over UDP no more than came from an address goes there, but for statuses
    for packet in (status, TimeReply(5, 6, 7, 8)):
        back(packet)
        found: list[bytes] = []
        wait_for(lambda found=found: found.extend(far.packets_back()) or found, "the packet")
        assert [decode(each) for each in found] == [packet]
    if arrival.back is not None:  # who has many senders sends to none by itself
        link.send(status)
        assert far.came_back() == b""


@each_kind_and_apart
def test_a_closed_link_lets_go_of_its_place(kind, ends):
    ends.open()
    ends.link.close()
    notices = Notices()
    with ends.far.link(notices) as link:
        if isinstance(ends.far, Nasa42Far):  # the peer of the first one sees its end
            ends.far.vanish()
            ends.far.come()
        again = Ends(ends.far, link, notices)
        assert again.open()


def test_of_the_messages_in_a_chunk_only_the_last_may_not_have_waited():
    for timely in (True, False):
        chunk = RawMessage(70, [b"ab"], 50, timely)
        waited_ns = [message.waited_ns for message in pieces(chunk, [b"a", b"b"])]
        assert waited_ns == [20, 0 if timely else 20]


@pytest.mark.parametrize("decoder", [PacketDecoder(), FedDecoder()], ids=["packets", "fed"])
def test_what_a_message_holds_may_have_waited_as_long_as_the_message(decoder):
    packet = attitude_packet(3, jump=False)
    messages = [RawMessage(70, [packet], 50, timely=False), RawMessage(90, [packet], 60)]
    assert [arrival.waited_ns for arrival in decoder.arrivals(messages)] == [20, 0]


def test_a_fed_message_has_the_time_that_stands_before_it_and_any_other_its_own():
    """A part before a packet that is no time of 64 bits, little-endian, is a sender's topic."""
    packet = attitude_packet(3, jump=False)
    fed = [(-700).to_bytes(8, "little", signed=True), packet]
    others = [[packet], [b"topic", packet], [b"", packet], [*fed, packet]]
    messages = [RawMessage(900, parts) for parts in (fed, *others)]
    arrivals = FedDecoder().arrivals(messages)
    assert [arrival.host_ns for arrival in arrivals] == [-700, 900, 900, 900, 900]
    assert all(isinstance(arrival.event, AttitudeSample) for arrival in arrivals)


@pytest.mark.parametrize("kind", [SerialFar, Nasa42Far], ids=["serial", "42"])
def test_a_stream_that_is_cut_at_every_byte_brings_the_same(ends):
    ends.open()
    came: list[Arrival[Event]] = []
    numbers = [ends.next_number, ends.next_number + 1]
    for number in numbers:
        for byte in ends.far.message(number):
            ends.far.put(bytes([byte]))
            if ends.link.wait_for_message(0):
                came += ends.read()
    came += ends.until(numbers[-1], ends.numbers(came))
    assert ends.numbers(came) == numbers
    assert not any(isinstance(arrival.event, Refusal) for arrival in came)


@contextlib.contextmanager
def udp_listed(notices: Notices) -> Iterator[tuple[StreamLink, Callable[[str], bool]]]:
    allowed = AllowedSenders(["127.0.0.3"])
    with UdpLink(bound_place("127.0.0.1:0", "", None), allowed, notices) as link:
        place = (LOOPBACK, int(link.endpoint.rpartition(":")[2]))

        def send(host: str) -> bool:
            """Whether the link takes it from there, and answers."""
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as made:
                made.bind((host, 0))
                made.setblocking(False)
                made.sendto(attitude_packet(1, jump=False), place)
                for arrival in link.receive(READ_MS):
                    arrival.back(Status(1, 2, 3, 4, 5, 6, 7))
                with contextlib.suppress(BlockingIOError):
                    return bool(made.recv(100))
            return False

        yield link, send


@contextlib.contextmanager
def nasa42_listed(notices: Notices) -> Iterator[tuple[StreamLink, Callable[[str], bool]]]:
    allowed = AllowedSenders(["127.0.0.3"])
    with Nasa42Link(
        "tcp://127.0.0.1:*",
        MessageReader(0, Mounting()),
        bind=True,
        allowed=allowed,
        notices=notices,
    ) as link:
        place = (LOOPBACK, int(link.endpoint.rpartition(":")[2]))

        def send(host: str) -> bool:
            with socket.create_connection(place, source_address=(host, 0)) as made:
                made.settimeout(READ_MS / 1000)
                with contextlib.suppress(ConnectionError):
                    made.sendall(b"nonsense\n[ENDMSG]\n")
                answers: list[bytes] = []

                def answered() -> bool:
                    link.receive(READ_MS)
                    with contextlib.suppress(TimeoutError):
                        try:
                            answers.append(made.recv(100))
                        except ConnectionError:
                            answers.append(b"")
                    return bool(answers)

                wait_for(answered, "an answer, or the end", poll_s=0.0)
            return bool(answers[0])

        yield link, send


@pytest.mark.parametrize("listed", [udp_listed, nasa42_listed])
def test_an_address_that_is_not_listed_is_counted_told_once_and_never_answered(listed):
    notices = Notices()
    with listed(notices) as (link, send):
        assert not send("127.0.0.2")
        assert not send("127.0.0.2")
        assert send("127.0.0.3")
        assert link.link_counts.rejected == 2
        assert noticed(notices, {"sender-not-allowed"}) == {"sender-not-allowed": 1}
        assert "127.0.0.2" in notices.latest("sender-not-allowed")
        assert "[attitude] allow" in notices.latest("sender-not-allowed")
