"""The camera over real sockets on loopback: images as they were given, and hostile clients."""

from __future__ import annotations

import contextlib
import fcntl
import ipaddress
import select
import socket
import struct
import threading
import time
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hilstar.attitude.wire.endpoint import AllowedSenders
from hilstar.basics.errors import InputError
from hilstar.basics.notices import Notices
from hilstar.basics.process.scheduling import HOST_CLOCK
from hilstar.server.gige.camera import (
    MAX_RESENT_PER_S,
    GigECamera,
    _broadcast_of,
    camera_address,
)
from hilstar.server.gige.control import MAX_RESENT
from hilstar.server.gige.registers import CameraIdentity, CameraSettings
from tests.support.fake_clock import FakeClock
from tests.support.gige_client import (
    CONTROL,
    DISCOVER,
    PACKET_BYTES,
    PRIVILEGE,
    RESEND,
    STREAM_ADDRESS,
    GigEClient,
    command,
    own_address,
)
from tests.support.refusals import refusal
from tests.support.waiting import wait_for

SIDE_PX = 256
FIRE = 1 << 31
STREAM_SOURCE_PORT = 0x0D1C  # the standard's SCSP0


@contextlib.contextmanager
def served_camera(
    allow: tuple[str, ...] = (),
    rate_hz: float = 50.0,
    notices: Notices | None = None,
    clock: Any = HOST_CLOCK,
) -> Iterator[GigECamera]:
    address = own_address()
    identity = CameraIdentity(ipaddress.IPv4Address(address), "virtual tracker", "1", "abc")
    settings = CameraSettings(SIDE_PX, SIDE_PX, 12, 0.01, rate_hz)
    with GigECamera(identity, settings, AllowedSenders(allow), notices or Notices(), clock) as made:
        made.address = address  # type: ignore[attr-defined]
        yield made


@contextlib.contextmanager
def streaming(made: GigECamera) -> Iterator[GigEClient]:
    with GigEClient(made.address) as client:  # type: ignore[attr-defined]
        client.describe()
        assert client.control() == 0
        assert client.set("AcquisitionStart", 1) == 0
        wait_for(lambda: made.wanted, "the camera streams")
        yield client


def test_images_arrive_bit_for_bit_with_their_times():
    rng = np.random.default_rng(3)
    with served_camera() as made, streaming(made) as client:
        source_port = client.read(STREAM_SOURCE_PORT)
        for k in range(5):
            dn = rng.integers(0, 4096, (SIDE_PX, SIDE_PX), dtype=np.uint16)
            begin_ns = time.monotonic_ns()
            made.take(dn, begin_ns)
            number, stamp_ns, image = client.image(SIDE_PX, SIDE_PX)
            assert (number, stamp_ns) == (k + 1, begin_ns)
            np.testing.assert_array_equal(image, dn)
        made.take(dn, time.monotonic_ns())
        assert client.stream.recvfrom(65536)[1] == (made.address, source_port)
        wait_for(lambda: made.counts.images == 6, "the last image is counted")
        assert made.counts.dropped == 0


def test_an_image_is_stamped_by_the_camera_s_own_clock():
    """A clock that is 7 s behind and fast by a thousandth."""

    def own_ns(host_ns: int) -> int:
        return host_ns + host_ns // 1000 - 7_000_000_000

    dn = np.zeros((SIDE_PX, SIDE_PX), np.uint16)
    with served_camera() as made, streaming(made) as client:
        made.own_ns = own_ns
        begin_ns = time.monotonic_ns()
        made.take(dn, begin_ns)
        assert client.image(SIDE_PX, SIDE_PX)[1] == own_ns(begin_ns)


def test_a_lost_packet_is_sent_again():
    dn = np.arange(SIDE_PX * SIDE_PX, dtype=np.uint16).reshape(SIDE_PX, SIDE_PX) % 4096
    with served_camera() as made, streaming(made) as client:
        made.take(dn, time.monotonic_ns())
        number, _, packets = client.block()
        body = struct.pack(">HHII", 0, number, 3, 4)
        client.socket.sendto(command(RESEND, body, 999, flags=0), (client.address, 3956))
        again = [client.stream.recv(65536)[8:] for _ in range(2)]
        assert again == [packets[3], packets[4]]
        body = struct.pack(">HHII", 0, number + 9, 3, 4)
        client.socket.sendto(command(RESEND, body, 1000, flags=0), (client.address, 3956))
        assert struct.unpack(">H", client.stream.recv(100)[:2])[0] == 0x800C


def test_a_single_frame_is_one_and_an_exposure_begun_before_the_start_is_none():
    dn = np.zeros((SIDE_PX, SIDE_PX), np.uint16)
    with served_camera() as made, GigEClient(made.address) as client:  # type: ignore[attr-defined]
        client.describe()
        client.control()
        client.set("AcquisitionMode", 1)
        before_ns = time.monotonic_ns()
        client.set("AcquisitionStart", 1)
        wait_for(lambda: made.wanted, "the camera streams")
        made.take(dn, before_ns)
        made.take(dn + 7, time.monotonic_ns())
        assert not made.wanted
        made.take(dn + 8, time.monotonic_ns())
        number, _, image = client.image(SIDE_PX, SIDE_PX)
        assert number == 1 and (image == 7).all()
        assert not made.wanted


def test_as_many_images_are_sent_as_were_asked_for_and_a_new_start_gives_as_many_again():
    dn = np.zeros((SIDE_PX, SIDE_PX), np.uint16)
    with served_camera() as made, GigEClient(made.address) as client:  # type: ignore[attr-defined]
        client.describe()
        client.control()
        assert client.set("AcquisitionMode", 2) == client.set("AcquisitionFrameCount", 3) == 0
        for start in range(2):
            client.set("AcquisitionStart", 1)
            wait_for(lambda: made.wanted, "the camera streams")
            for value in range(5):
                made.take(dn + value, time.monotonic_ns())
            images = [client.image(SIDE_PX, SIDE_PX) for _ in range(3)]
            assert [number for number, _, _ in images] == [3 * start + k for k in (1, 2, 3)]
            assert [image.max() for _, _, image in images] == [0, 1, 2]
            assert not made.wanted
        wait_for(lambda: made.counts.images == 6, "the last image is counted")


def test_triggers_begin_exposures_in_their_order_and_none_before_a_start():
    with served_camera() as made, streaming(made) as client:
        assert client.set("TriggerSoftware", 1) == 0  # free-running: it begins nothing
        assert client.set("TriggerMode", 1) == 0
        begun_ns = time.monotonic_ns()
        for _ in range(3):
            assert client.set("TriggerSoftware", 1) == 0
        client.read(PRIVILEGE)  # what was asked for before is then done
        assert made.counts.triggers == 3
        first_ns, second_ns = made.trigger_ns(), made.trigger_ns()
        assert begun_ns <= first_ns <= second_ns <= time.monotonic_ns()
        client.set("AcquisitionStop", 1)
        client.set("TriggerSoftware", 1)
        client.set("AcquisitionStart", 1)
        client.read(PRIVILEGE)
        assert made.counts.triggers == 3 and made.trigger_ns() is None
        client.set("TriggerSoftware", 1)
        client.read(PRIVILEGE)
        assert made.counts.triggers == 4 and made.trigger_ns() >= made.started_ns


@pytest.mark.parametrize("packet_bytes", [576, 1500, 9000])
def test_a_client_that_tries_a_size_gets_one_packet_of_it(packet_bytes):
    """With its headers of IP and UDP, 28 bytes; the stream's own size is then this one."""
    with served_camera() as made, streaming(made) as client:
        assert client.write(PACKET_BYTES, FIRE | packet_bytes) == 0
        assert len(client.stream.recv(65536)) == packet_bytes - 28
        assert client.read(PACKET_BYTES) & 0xFFFF == packet_bytes
        made.take(np.zeros((SIDE_PX, SIDE_PX), np.uint16), time.monotonic_ns())
        _, _, packets = client.block()
        sizes = {len(packet) for packet in packets.values()}
        assert max(sizes) == packet_bytes - 28 - 8


def test_a_client_that_falls_silent_is_let_go_and_the_next_begins_anew():
    notices = Notices()
    ahead_ns = [0]
    clock = SimpleNamespace(now_ns=lambda: time.monotonic_ns() + ahead_ns[0])
    with served_camera(notices=notices, clock=clock) as made, streaming(made) as client:
        ahead_ns[0] = 3_100_000_000
        wait_for(lambda: not made.settings.streaming, "it is let go")
        assert not made.wanted
        wait_for(lambda: notices.counts().get("camera") == 1, "it is told")
        made.take(np.zeros((SIDE_PX, SIDE_PX), np.uint16), clock.now_ns())
        with GigEClient(made.address) as other:  # type: ignore[attr-defined]
            assert other.control() == 0
            assert client.write(PRIVILEGE, CONTROL) == 0x8006
        assert made.counts.images == 0


def test_only_the_newest_images_are_sent_again():
    """Eight are kept."""
    dn = np.zeros((SIDE_PX, SIDE_PX), np.uint16)
    with served_camera() as made, streaming(made) as client:
        for _ in range(9):
            made.take(dn, time.monotonic_ns())
            client.block()
        client.read(PRIVILEGE)  # whatever was asked for again before is then sent
        resent_before = made.counts.resent
        while select.select([client.stream], [], [], 0.0)[0]:
            client.stream.recv(65536)
        for number, status in ((1, 0x800C), (2, 0)):
            body = struct.pack(">HHII", 0, number, 0, 0)
            client.socket.sendto(
                command(RESEND, body, 999 + number, flags=0), (client.address, 3956)
            )
            answer = client.stream.recv(65536)
            assert struct.unpack(">HH", answer[:4]) == (status, number)
        wait_for(
            lambda: made.counts.resent == resent_before + 1,
            "the one that was sent again is counted",
        )


def test_what_is_asked_for_again_counts_by_its_packets_though_the_image_has_fewer():
    """50 000 in a second and no more."""
    clock = FakeClock(time.monotonic_ns())
    requests, rest = divmod(MAX_RESENT_PER_S, MAX_RESENT)
    beyond = 5000  # of an image of 90 packets
    with served_camera(clock=clock) as made, streaming(made) as client:
        made.take(np.zeros((SIDE_PX, SIDE_PX), np.uint16), clock.now_ns())
        number, *_ = client.block()
        client.read(PRIVILEGE)  # whatever was asked for again before is then sent
        clock.work(1e9)
        resent_before = made.counts.resent
        asked = [(beyond, MAX_RESENT)] * requests
        asked += [(beyond, rest), (0, 1)]
        for first, count in asked:
            body = struct.pack(">HHII", 0, number, first, first + count - 1)
            client.socket.sendto(command(RESEND, body, 999, flags=0), (client.address, 3956))
        client.read(PRIVILEGE)
        assert made.counts.resent == resent_before
        clock.work(1e9)
        client.socket.sendto(command(RESEND, body, 999, flags=0), (client.address, 3956))
        client.read(PRIVILEGE)
        assert made.counts.resent == resent_before + 1


def test_another_clients_address_is_refused_over_the_wire():
    with served_camera() as made, streaming(made) as client:
        elsewhere = int(ipaddress.IPv4Address("127.0.0.9"))
        assert client.write(STREAM_ADDRESS, elsewhere) == 0x8006


def test_a_client_that_is_not_allowed_is_never_answered_and_told_of_once():
    notices = Notices()
    with (
        served_camera(allow=("127.0.9.9",), notices=notices) as made,
        GigEClient(made.address, own="127.0.9.9") as friend,  # type: ignore[attr-defined]
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger,
    ):
        for number in range(1, 50):
            stranger.sendto(command(DISCOVER, number=number), (friend.address, 3956))
        # Answers come in order: had the stranger been answered, it was before this.
        assert friend.ask(DISCOVER)[0] == 0
        stranger.setblocking(False)
        with pytest.raises(BlockingIOError):
            stranger.recv(2048)
        wait_for(lambda: notices.lasting, "it is told")
        assert notices.lasting.keys() == {"camera-sender-not-allowed"}
        assert "from 127.0.0.1 are dropped" in notices.lasting["camera-sender-not-allowed"]


def test_hostile_clients_leave_the_controller_its_images():
    """24 of them at 100 datagrams a second each; what they cost is counted, not timed."""
    stop = threading.Event()
    rng = np.random.default_rng(1)

    def attack(address: str, seed: int) -> None:
        mine = np.random.default_rng(seed)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sending:
            while not stop.wait(0.01):
                kind = int(mine.choice([DISCOVER, 0x80, 0x82, 0x84, 0x86, 0x40, 7]))
                body = mine.bytes(int(mine.integers(0, 64)))
                sending.sendto(command(kind, body, int(mine.integers(1, 65536))), (address, 3956))

    with served_camera() as made, streaming(made) as client:
        crowd = [threading.Thread(target=attack, args=(client.address, seed)) for seed in range(24)]
        for thread in crowd:
            thread.start()
        try:
            for _ in range(20):
                dn = rng.integers(0, 4096, (SIDE_PX, SIDE_PX), dtype=np.uint16)
                made.take(dn, time.monotonic_ns())
                np.testing.assert_array_equal(client.image(SIDE_PX, SIDE_PX)[2], dn)
                assert client.read(0x0A00) == 2
        finally:
            stop.set()
            for thread in crowd:
                thread.join()
        assert made.settings.streaming


@pytest.mark.parametrize("text", ["0.0.0.0", "224.0.0.1", "camera", "::1", "127.0.0.2:3956", ""])
def test_an_address_that_is_none_is_refused_in_one_line(text):
    assert "--camera" in refusal(camera_address, text)


def test_a_client_s_search_is_heard_on_the_broadcast_address_of_the_camera_s_interface(
    monkeypatch,
):
    """By Linux's SIOCGIFADDR and SIOCGIFBRDADDR: a struct ifreq with a sockaddr_in (netdevice(7))."""
    links = {b"lo": ("127.0.0.1", "0.0.0.0"), b"eth0": ("10.1.2.3", "10.1.3.255"), b"down": None}

    def ioctl(file, number, request):
        name = request[:16].rstrip(b"\0")
        place = links[name]
        if place is None:
            raise OSError("no address")
        text = {0x8915: place[0], 0x8919: place[1]}[number]
        return request[:16] + struct.pack("=HH4s16x", 2, 0, socket.inet_aton(text))

    monkeypatch.setattr(socket, "if_nameindex", lambda: [(1, "lo"), (2, "down"), (3, "eth0")])
    monkeypatch.setattr(fcntl, "ioctl", ioctl)
    for address, broadcast in (
        ("127.0.0.2", "127.255.255.255"),
        ("10.1.2.3", "10.1.3.255"),
        ("10.9.9.9", "10.9.9.9"),
    ):
        assert _broadcast_of(ipaddress.IPv4Address(address)) == broadcast


def test_a_second_camera_at_one_address_says_what_to_do():
    with served_camera() as made:
        identity = CameraIdentity(ipaddress.IPv4Address(made.address), "m", "1", "s")  # type: ignore[attr-defined]
        settings = CameraSettings(8, 8, 12, 0.01, 10.0)
        with pytest.raises(InputError, match="in use; stop the camera"):
            GigECamera(identity, settings, AllowedSenders(()), Notices())
