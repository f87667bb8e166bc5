"""UDP's addresses, the times of its arrivals, and how little it answers: real sockets on loopback."""

from __future__ import annotations

import socket
import time

import pytest

from hilstar.attitude.wire.endpoint import MAX_KNOWN, AllowedSenders, bound_place
from hilstar.attitude.wire.packet import AttitudeSample, Status, TimeReply, TimeRequest, encode
from hilstar.attitude.wire.udp import MAX_CREDIT_BYTES, MAX_PEERS, MAX_STRANGERS, Credit, Datagrams, UdpLink
from hilstar.notices import Notices
from hilstar.units import NS_PER_S
from tests.support.senders import packet
from tests.support.waiting import wait_for

HELD_S = 0.05
# A datagram stamped when it is read is off by HELD_S or more; stamped on arrival it is off by microseconds.
STAMP_NS = round(HELD_S / 2 * NS_PER_S)
ANYWHERE = bound_place("127.0.0.1:0", "", None)


@pytest.mark.parametrize(
    ("bind", "port", "endpoint", "place"),
    [
        (None, "", None, "udp://127.0.0.1:5560"),
        (True, 5561, None, "udp://127.0.0.1:5561"),
        ("localhost", "5561", None, "udp://127.0.0.1:5561"),
        ("0.0.0.0", "", None, "udp://0.0.0.0:5560"),
        ("::1", 7, None, "udp://[::1]:7"),
        ("[::1]", "", None, "udp://[::1]:5560"),
        ("[::]:9", 9, "udp://[::]:9", "udp://[::]:9"),
        ("[0:0::1]:9", "", "udp://[::1]:9", "udp://[::1]:9"),
        (None, "", "udp://localhost:9", "udp://127.0.0.1:9"),
    ],
)
def test_three_keys_say_one_place(bind, port, endpoint, place):
    assert str(bound_place(bind, port, endpoint)) == place


def test_senders_are_admitted_by_address_and_network():
    assert AllowedSenders().admits("127.0.0.2") and AllowedSenders().admits("::1")
    assert not AllowedSenders().admits("10.0.0.1")
    listed = AllowedSenders(["10.0.0.1", "192.168.0.0/16", "fd00::/64", "fe80::/10"])
    for host in ("10.0.0.1", "192.168.255.1", "fd00::1", "fe80::1%lo"):
        assert listed.admits(host), host
    for host in ("10.0.0.2", "127.0.0.1", "192.169.0.1", "::1", "fd00:0:0:1::1"):
        assert not listed.admits(host), host


def test_however_many_addresses_ask_each_is_judged_by_the_list():
    listed = AllowedSenders(["10.0.1.0/24"])
    for _ in range(2):
        for k in range(3 * MAX_KNOWN):
            assert listed.admits(f"10.0.{k // 256}.{k % 256}") is (k // 256 == 1)
        assert len(listed._known) <= MAX_KNOWN


def test_a_datagram_that_was_read_late_has_the_time_of_its_arrival():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        datagrams = Datagrams.bound(ANYWHERE)
        sender.connect(("127.0.0.1", datagrams.port))

        def held(count: int) -> list[tuple[int, int]]:
            """How long after each began to be sent, and after it was sent, so many datagrams that were read late arrived."""
            sent_ns = []
            for _ in range(count):
                before_ns = time.monotonic_ns()
                sender.send(b"now")
                sent_ns.append((before_ns, time.monotonic_ns()))
                time.sleep(HELD_S)
            taken = datagrams.take(2 * count)
            return [(each.host_ns - began, each.host_ns - ended) for each, (began, ended) in zip(taken, sent_ns, strict=True)]

        # The kernel switches its stamps on from a work queue, some time after the socket asks for them.
        wait_for(lambda: held(1)[0][1] < STAMP_NS, "stamps")
        late_ns = held(5)
        datagrams.close()
    # The stamp is made while the datagram is sent, however long this process is held up there.
    assert all(after_begin > -STAMP_NS and after_end < STAMP_NS for after_begin, after_end in late_ns), late_ns


def test_no_address_gets_more_than_it_sent_but_for_statuses():
    """An asker whose 20 bytes would each bring 36: of a hundred requests so many are answered as their bytes pay for."""
    with (
        UdpLink(ANYWHERE, AllowedSenders()) as link,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asker,
    ):
        asker.connect(("127.0.0.1", int(link.endpoint.rpartition(":")[2])))
        asker.settimeout(0.2)
        for k in range(100):
            asker.send(encode(TimeRequest(k, 0)))
        for arrival in link.receive(100):
            assert isinstance(arrival.event, TimeRequest)
            assert arrival.back is not None
            arrival.back(TimeReply(arrival.event.sequence, 0, 1, 2))
        arrival.back(Status(0, 0, 0, 0, 0, 0, 0))
        back = []
        with pytest.raises(TimeoutError):
            while True:
                back.append(asker.recv(100))
    replies = [data for data in back if len(data) == 36]
    assert len(back) == len(replies) + 1
    assert 0 < sum(map(len, replies)) <= 100 * 20
    assert len(replies) == 100 * 20 // 36


def test_credit_is_bounded_in_bytes_and_in_addresses():
    credit = Credit()
    for k in range(10 * MAX_PEERS):
        credit.earn(("127.0.0.1", k), 10**9)
    assert not credit.spend(("127.0.0.1", 0), 1)
    newest = ("127.0.0.1", 10 * MAX_PEERS - 1)
    assert credit.spend(newest, MAX_CREDIT_BYTES)
    assert not credit.spend(newest, 1)


def test_the_link_itself_sends_to_nobody():
    with UdpLink(ANYWHERE, AllowedSenders()) as link, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.connect(("127.0.0.1", int(link.endpoint.rpartition(":")[2])))
        sender.settimeout(HELD_S)
        sender.send(packet(1, 5))
        assert link.wait_for_message(1000)
        (arrival,) = link.receive(0)
        assert isinstance(arrival.event, AttitudeSample)
        link.send(TimeRequest(1, 1))
        with pytest.raises(TimeoutError):
            sender.recv(100)


def received(bound: Datagrams, data: bytes, sources: list[str]) -> set[str]:
    """The sources whose datagram comes through."""
    family = socket.AF_INET6 if ":" in sources[0] else socket.AF_INET
    for source in sources:
        with socket.socket(family, socket.SOCK_DGRAM) as sender:
            sender.bind((source, 0))
            sender.sendto(data, ("::1" if ":" in source else "127.0.0.1", bound.port))
    return {datagram.sender[0] for datagram in bound.take(len(sources))}


def test_the_kernel_s_filter_lets_in_whom_the_list_admits():
    sources = ["127.0.0.1", "127.0.0.2", "127.1.0.1", "127.1.255.254", "127.2.0.1", "127.200.3.4"]
    for texts in (
        ["127.0.0.2"],
        ["127.1.0.0/16", "127.200.3.4"],
        ["::/0"],
        ["10.0.0.0/8"],
        ["0.0.0.0/0"],
        ["127.0.0.0/30"],
        [],
    ):
        allowed, bound = AllowedSenders(texts), Datagrams.bound(ANYWHERE)
        assert bound.keep_only(allowed.networks)
        assert received(bound, b"x" * 64, sources) == {source for source in sources if allowed.admits(source)}, texts
        assert bound.dropped() == sum(not allowed.admits(source) for source in sources)
        bound.close()


def test_so_it_does_over_ipv6():
    for texts, admitted in (
        (["::1"], True),
        (["::/96"], True),
        (["fd00::/64", "::1"], True),
        (["fd00::/64"], False),
        ([], True),
    ):
        allowed, bound = AllowedSenders(texts), Datagrams.bound(bound_place("[::1]:0", "", None))
        assert bound.keep_only(allowed.networks)
        assert received(bound, b"x", ["::1"]) == ({"::1"} if admitted else set()), texts
        bound.close()


def test_a_flood_from_elsewhere_leaves_room_for_those_who_are_listed():
    """Once the kernel drops it, a burst of more than the socket's buffer holds displaces nobody."""
    notices = Notices()
    with (
        UdpLink(ANYWHERE, AllowedSenders(["127.0.0.1"]), notices) as link,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listed,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger,
    ):
        stranger.bind(("127.0.0.2", 0))
        for each in (listed, stranger):
            each.connect(("127.0.0.1", int(link.endpoint.rpartition(":")[2])))
        while "flood" not in notices.counts():
            for _ in range(200):
                stranger.send(bytes(64))
            assert link.receive(100) == []
        while link.wait_for_message(0):  # what had come before the filter did
            link.receive(0)
        for _ in range(20_000):
            stranger.send(bytes(64))
        for k in range(100):
            listed.send(packet(k, k))
        assert len(link.receive(100)) == 100
    assert link.link_counts.rejected > MAX_STRANGERS
    assert notices.counts() == {"sender-not-allowed": 1, "flood": 1}
