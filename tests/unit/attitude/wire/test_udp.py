"""UDP's addresses, the times of its arrivals, and how little it answers: real sockets on
loopback.
"""

from __future__ import annotations

import socket

import pytest

from hilstar.attitude.wire.endpoint import MAX_KNOWN, AllowedSenders, bound_place
from hilstar.attitude.wire.kernel_stamps import SO_TIMESTAMPNS, TIMESPEC, KernelStamps
from hilstar.attitude.wire.packet import Status, TimeReply, TimeRequest, encode
from hilstar.attitude.wire.udp import (
    MAX_CREDIT_BYTES,
    MAX_PEERS,
    MAX_STRANGERS,
    Credit,
    Datagrams,
    UdpLink,
)
from hilstar.basics.notices import Notices
from hilstar.basics.units import NS_PER_S
from tests.support.fake_clock import FakeClock
from tests.support.senders import packet

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


@pytest.mark.parametrize(
    ("stamp_ns", "arrived_ns"),
    [(70, 1070), (99, 1099), (101, 1100), (40, 1050), (None, 1100)],
    ids=[
        "stamped",
        "just now",
        "later than it was read",
        "before the socket was empty",
        "not stamped",
    ],
)
def test_an_arrival_has_the_kernel_s_stamp_on_the_host_s_clock_between_the_last_look_and_now(
    stamp_ns, arrived_ns
):
    """The calendar's clock shows 10 s when the host's shows 1000 ns."""
    clock = FakeClock(1000)
    clock.realtime_ns = lambda: 10 * NS_PER_S + clock.now_ns() - 1000
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiving:
        stamps = KernelStamps(receiving, clock)
    stamps.empty_ns = 1050
    told = (
        []
        if stamp_ns is None
        else [(socket.SOL_SOCKET, SO_TIMESTAMPNS, TIMESPEC.pack(10, stamp_ns))]
    )
    assert stamps.arrived_ns(told, 1100) == arrived_ns


def test_no_address_gets_more_than_it_sent_but_for_statuses():
    """An asker whose 20 bytes would each bring 36: of a hundred requests so many are answered as
    their bytes pay for.
    """
    with (
        UdpLink(ANYWHERE, AllowedSenders()) as link,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asker,
    ):
        asker.connect(("127.0.0.1", int(link.endpoint.rpartition(":")[2])))
        asker.setblocking(False)  # loopback hands a datagram over before `sendto` returns
        for k in range(100):
            asker.send(encode(TimeRequest(k, 0)))
        for arrival in link.receive(100):
            assert isinstance(arrival.event, TimeRequest)
            assert arrival.back is not None
            arrival.back(TimeReply(arrival.event.sequence, 0, 1, 2))
        arrival.back(Status(0, 0, 0, 0, 0, 0, 0))
        back = []
        with pytest.raises(BlockingIOError):
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
        assert received(bound, b"x" * 64, sources) == {
            source for source in sources if allowed.admits(source)
        }, texts
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
