"""UDP's addresses, the times of its arrivals, and how little it answers: real sockets on
loopback.
"""

from __future__ import annotations

import ipaddress
import socket
import struct

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
    UdpRoad,
    filter_program,
)
from hilstar.basics.notices import Notices
from hilstar.basics.process.scheduling import HostClock
from hilstar.basics.units import NS_PER_S
from tests.support.fake_clock import FakeClock
from tests.support.refusals import refusal
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


@pytest.mark.parametrize(
    ("bind", "port", "endpoint", "words"),
    [
        ("224.0.0.1:5560", "", None, "224.0.0.1 is not an address of one machine"),
        ("[ff02::1]:5560", "", None, "ff02::1 is not an address of one machine"),
        ("[::ffff:10.0.0.1]:5560", "", None, "is not an address of one machine"),
        ("bench-pc:5560", "", None, "bench-pc is not an address of this machine"),
        ("127.0.0.1:65536", "", None, "not a port"),
        (None, 65536, None, "not a port"),
        (None, "-1", None, "not a port"),
        (None, "", "tcp://127.0.0.1:5560", "not a UDP endpoint"),
        ("127.0.0.1:5560", 5561, None, "disagree"),
        ("127.0.0.1", "", "udp://127.0.0.2:5560", "disagree"),
        (False, "", None, "over UDP hilstar binds"),
    ],
)
def test_what_is_no_place_of_this_machine_is_refused(bind, port, endpoint, words):
    assert words in refusal(bound_place, bind, port, endpoint)


def test_senders_are_admitted_by_address_and_network():
    assert AllowedSenders().admits("127.0.0.2") and AllowedSenders().admits("::1")
    assert not AllowedSenders().admits("10.0.0.1")
    listed = AllowedSenders(["10.0.0.1", "192.168.0.0/16", "fd00::/64", "fe80::/10"])
    for host in ("10.0.0.1", "192.168.255.1", "fd00::1", "fe80::1%lo"):
        assert listed.admits(host), host
    for host in ("10.0.0.2", "127.0.0.1", "192.169.0.1", "::1", "fd00:0:0:1::1"):
        assert not listed.admits(host), host


def ip_header(source: str, destination: str) -> bytes:
    """An IP header: of version 4 (RFC 791, 3.1) or 6 (RFC 8200, 3)."""
    packed = [ipaddress.ip_address(text).packed for text in (source, destination)]
    if len(packed[0]) == 4:
        return struct.pack(">BBHHHBBH4s4s", 0x45, 0, 28, 0, 0, 64, 17, 0, *packed)
    return struct.pack(">IHBB16s16s", 6 << 28, 8, 17, 64, *packed)


def admitted_by(program: bytes, header: bytes) -> bool:
    """What classic BPF answers for a datagram: Linux's Documentation/networking/filter.rst, with
    loads from SKF_NET_OFF on, which count from the IP header.
    """
    code = list(struct.iter_unpack("=HBBI", program))
    accumulator = at = 0
    while True:
        operation, if_true, if_false, operand = code[at]
        at += 1
        if operation == 0x20:  # ld [k]
            (accumulator,) = struct.unpack_from(">I", header, operand - 0xFFF00000)
        elif operation == 0x54:  # and #k
            accumulator &= operand
        elif operation == 0x15:  # jeq #k
            at += if_true if accumulator == operand else if_false
        else:
            assert operation == 0x06  # ret #k
            return bool(operand)


def test_the_kernel_s_filter_admits_the_senders_that_the_list_does():
    """Of each IP version, by networks that end within a word, at its end and behind it."""
    listed_texts = ["10.1.0.0/16", "192.168.7.64/27", "127.0.0.1"]
    listed_texts += ["::1", "fd00:1:2:3::/64", "2001:db8::/33", "fe80::/10"]
    networks = [ipaddress.ip_network(text) for text in listed_texts]
    senders = ["10.1.255.0", "10.2.0.0", "192.168.7.95", "192.168.7.96", "127.0.0.1", "127.0.0.2"]
    senders += ["::1", "::2", "1::1", "fd00:1:2:3::9", "fd00:1:2:4::9", "fd00:2:2:3::9"]
    senders += ["2001:db8:7fff::", "2001:db8:8000::", "2001:db9::", "febf::1", "fec0::1"]
    for text in senders:
        sender = ipaddress.ip_address(text)
        # the bench's own address is of no listed network, and is not looked at
        header = ip_header(text, "203.0.113.9" if sender.version == 4 else "2001:4::9")
        listed = any(sender in network for network in networks)
        assert admitted_by(filter_program(networks, sender.version), header) is listed, text
        assert not admitted_by(filter_program([], sender.version), header)


class ChangedClock(HostClock):
    """The host's clock some time later, beside a calendar that somebody has set back by an hour."""

    later_ns = 0

    def now_ns(self) -> int:
        return super().now_ns() + self.later_ns

    def monotonic_minus_realtime_ns(self) -> int:
        return super().monotonic_minus_realtime_ns() - 3600 * NS_PER_S


@pytest.mark.parametrize("look", [lambda link: link.wait(0), lambda link: link.take(1)])
def test_a_datagram_came_after_the_last_look_that_found_none(look):
    """However wrong the calendar, by which the kernel stamps it."""
    clock = ChangedClock()
    receiving = Datagrams.bound(ANYWHERE, clock)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        clock.later_ns = 1000 * NS_PER_S
        before_ns = clock.now_ns()
        assert not look(receiving)
        after_ns = clock.now_ns()
        sender.sendto(b"1", ("127.0.0.1", receiving.port))
        assert receiving.wait(10_000)
        (datagram,) = receiving.take(1)
    receiving.close()
    assert before_ns <= datagram.host_ns <= after_ns


def test_what_the_kernel_drops_is_counted_once():
    """The kernel's count grows for as long as the socket is open; it is looked at each second."""
    clock = ChangedClock()
    road = UdpRoad(ANYWHERE, AllowedSenders(["127.0.0.3"]), clock=clock)
    place = ("127.0.0.1", int(road.endpoint.rpartition(":")[2]))
    assert road._datagrams.keep_only(AllowedSenders(["127.0.0.3"]).networks)
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listed,
    ):
        listed.bind(("127.0.0.3", 0))
        for strangers, in_all in ((5, 5), (0, 5), (2, 7), (0, 7)):
            for _ in range(strangers):
                stranger.sendto(b"1", place)
            listed.sendto(b"2", place)
            clock.later_ns += 2 * NS_PER_S
            assert [message.parts for message in road.taken(10_000)] == [[b"2"]]
            assert road.link_counts.flooded == in_all
    road.close()


def test_strangers_are_counted_anew_each_second():
    """Two thirds of the limit in each of three seconds, which do not make the kernel drop any."""
    clock, notices = ChangedClock(), Notices()
    road = UdpRoad(ANYWHERE, AllowedSenders(["127.0.0.3"]), notices=notices, clock=clock)
    per_second = 2 * MAX_STRANGERS // 3
    batch = 50  # the socket's buffer holds that many
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.connect(("127.0.0.1", int(road.endpoint.rpartition(":")[2])))
        for _ in range(3):
            for _ in range(per_second // batch):
                for _ in range(batch):
                    stranger.send(b"1")
                assert road.taken(10_000) == []
            clock.later_ns += 2 * NS_PER_S
            stranger.send(b"1")
            assert road.taken(10_000) == []
    road.close()
    assert road.link_counts.rejected == 3 * (per_second // batch * batch + 1)
    assert notices.counts() == {"sender-not-allowed": 1}


def test_a_datagram_goes_out_though_the_last_one_found_nobody():
    """The kernel tells of the last refusal where the next one is sent, and sends nothing."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as closed:
        closed.bind(("127.0.0.1", 0))
        port = closed.getsockname()[1]
    sender = Datagrams.connected("127.0.0.1", port)
    assert sender.put(b"nobody is there")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        opened.bind(("127.0.0.1", port))
        opened.settimeout(10)
        assert sender.put(b"somebody is")
        assert opened.recv(99) == b"somebody is"
    sender.close()


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


@pytest.mark.parametrize("place", ["127.0.0.1:0", "[::1]:0"])
def test_a_socket_is_connected_to_a_peer_of_either_ip_version(place):
    bound = Datagrams.bound(bound_place(place, "", None))
    host = place.rpartition(":")[0].strip("[]")
    connected = Datagrams.connected(host, bound.port)
    assert connected.put(b"there")
    (came,) = bound.take(1)
    assert came.parts == [b"there"] and came.sender[:2] == (host, connected.port)
    bound.close()
    connected.close()


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
