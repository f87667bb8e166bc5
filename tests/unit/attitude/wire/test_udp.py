"""UDP's addresses, the times of its arrivals, and how little it answers: real sockets on loopback."""

from __future__ import annotations

import socket
import time

import pytest

from hilstar.attitude.wire.packet import AttitudeSample, Status, TimeReply, TimeRequest, encode
from hilstar.attitude.wire.udp.addresses import AllowedSenders, bound_place
from hilstar.attitude.wire.udp.datagrams import Datagrams
from hilstar.attitude.wire.udp.udp_link import MAX_CREDIT_BYTES, MAX_PEERS, Credit, UdpLink
from hilstar.units import NS_PER_MS
from tests.support.senders import packet

HELD_S = 0.05
# The two clocks are read within some microseconds of each other, and the kernel stamps before `send` returns; a loaded machine
# may hold the reader up between them.
STAMP_NS = 2 * NS_PER_MS
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


def test_a_datagram_that_was_read_late_has_the_time_of_its_arrival():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        datagrams = Datagrams.bound(ANYWHERE)
        sender.connect(("127.0.0.1", datagrams.port))
        sent_ns = []
        for _ in range(5):
            sender.send(b"now")
            sent_ns.append(time.monotonic_ns())
            time.sleep(HELD_S)
        taken = datagrams.take(10)
        datagrams.close()
    late_ns = [each.host_ns - at_ns for each, at_ns in zip(taken, sent_ns, strict=True)]
    assert max(map(abs, late_ns)) < STAMP_NS


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
