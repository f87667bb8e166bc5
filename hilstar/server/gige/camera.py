"""The virtual tracker as a GigE Vision camera on this machine's network: sockets and threads of
`control` and `stream`.

Laws:
1. Datagrams from addresses that are not allowed are read and dropped, or dropped by the kernel when
   they are many; they are never answered.
2. Of all who do not control the camera, MAX_OTHERS_PER_S datagrams a second are answered: a crowd
   costs the reading of its datagrams. The controller's are all read.
3. Whoever computes images never waits for the network: an image before which WAITING_BLOCKS wait
   is dropped and counted.
"""

import errno
import fcntl
import ipaddress
import queue
import select
import socket
import struct
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hilstar.attitude.wire.endpoint import AllowedSenders
from hilstar.attitude.wire.udp import keep_only_networks
from hilstar.basics.allowance import Allowance
from hilstar.basics.errors import InputError
from hilstar.basics.notices import Notices
from hilstar.basics.process.closing import Closing
from hilstar.basics.process.scheduling import HOST_CLOCK, HostClock
from hilstar.basics.units import NS_PER_S
from hilstar.server.gige.control import (
    PORT,
    ControlChannel,
    FeatureCommand,
    FiredPacket,
    Peer,
    Released,
    Resend,
)
from hilstar.server.gige.description import describe
from hilstar.server.gige.features import ACQUISITION_MODES
from hilstar.server.gige.registers import (
    STREAM_DELAY,
    STREAM_SOURCE_PORT,
    CameraIdentity,
    CameraSettings,
    Registers,
)
from hilstar.server.gige.stream import ImageBlock, image_block, next_block, unavailable

DEFAULT_ADDRESS = "127.0.0.2"
MAX_DATAGRAM_BYTES = 1024
MAX_TAKEN = 512  # datagrams in one go
# A client's search takes one datagram, its look at the description some 40.
MAX_OTHERS_PER_S = 200
LOOK_MS = 20
# Under a crowd datagrams are read this far apart: to be woken by each costs more than reading it.
PAUSE_S = 0.005
CROWD = 4  # datagrams in one look
# A machine that stands still for three seconds delays images of 10 Hz, and loses none.
WAITING_BLOCKS, KEPT_BLOCKS = 32, 8
# Packets between two pauses: half of what an ordinary socket holds (212 992 bytes, of which the
# kernel counts twice a packet of 1500).
BURST = 32
SPREAD = 0.3  # the share of a period over which an image's packets are spread
MAX_RESENT_PER_S = 50_000
WANTED_BUFFER_BYTES = 1 << 22
LOOPBACK_BROADCAST = "127.255.255.255"
SIOCGIFADDR, SIOCGIFBRDADDR = 0x8915, 0x8919  # linux/sockios.h
# struct ifreq (net/if.h): an interface's name, and a sockaddr_in whose address is its bytes 4 to 7
INTERFACE_REQUEST = struct.Struct("16s24s")
ADDRESS_PLACE = slice(20, 24)
TROUBLE = {
    errno.EADDRINUSE: (
        f"its port {PORT} is in use; stop the camera that has it, or write another address, such"
        " as 127.0.0.3"
    ),
    errno.EADDRNOTAVAIL: "not an address of this machine; write one that `ip addr` lists",
    errno.EACCES: f"not permitted to bind port {PORT}",
}


@dataclass(slots=True)
class CameraCounts:
    """Images sent, dropped for want of time or of a client, and packets sent again."""

    images: int = 0
    dropped: int = 0
    resent: int = 0
    triggers: int = 0


def camera_address(text: str) -> ipaddress.IPv4Address:
    """The address to bind. Raises InputError for another than a numeric IPv4 address."""
    try:
        address = ipaddress.IPv4Address(text)
    except ValueError as error:
        raise InputError(
            f"--camera {text}: write an IPv4 address of this machine, such as {DEFAULT_ADDRESS}"
        ) from error
    if address.is_unspecified or address.is_multicast:
        raise InputError(
            f"--camera {text}: a camera has one address; write one that `ip addr` lists"
        )
    return address


class GigECamera(Closing):
    """A GigE Vision camera that is bound to an address. Free it with `close`.

    `settings` are what its client has set. `own_ns` turns host time into the camera's clock. Raises
    InputError where the address cannot be bound.
    """

    def __init__(
        self,
        identity: CameraIdentity,
        settings: CameraSettings,
        allowed: AllowedSenders,
        notices: Notices,
        clock: HostClock = HOST_CLOCK,
    ) -> None:
        self.settings = settings
        self.counts = CameraCounts()
        self.own_ns: Callable[[int], int] = int
        self._allowed = allowed
        self._notices = notices
        self._clock = clock
        self._control_socket = _bound(identity.address, PORT)
        self._searches = _broadcasts(identity.address)
        self._stream_socket = _bound(identity.address, 0)
        self._stream_socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, WANTED_BUFFER_BYTES)
        self.registers = Registers(identity, settings, describe(identity.model, settings))
        self.registers.put_word(STREAM_SOURCE_PORT, self._stream_socket.getsockname()[1])
        self.channel = ControlChannel(self.registers)
        self._triggers_ns: deque[int] = deque()
        self.started_ns = 0  # the newest start, host time: no exposure of a stream began before
        self._remaining: int | None = None
        self._others = Allowance(MAX_OTHERS_PER_S, MAX_OTHERS_PER_S)
        self._again = Allowance(MAX_RESENT_PER_S, MAX_RESENT_PER_S)
        self._filtered = False
        self._block = 0
        self._blocks: deque[ImageBlock] = deque(maxlen=KEPT_BLOCKS)
        self._waiting: queue.Queue[ImageBlock | None] = queue.Queue(WAITING_BLOCKS)
        self._stop = threading.Event()
        self._threads = [
            threading.Thread(target=target, name=name, daemon=True)
            for target, name in (
                (self._serve, "hilstar-camera"),
                (self._stream, "hilstar-camera-stream"),
            )
        ]
        for thread in self._threads:
            thread.start()

    # ---- what the tracker asks ----

    @property
    def wanted(self) -> bool:
        """Whether a client waits for images."""
        return self.settings.streaming and self.channel.destination is not None

    def trigger_ns(self) -> int | None:
        """When the oldest trigger came that has begun no exposure yet, host time."""
        if self._triggers_ns:
            return self._triggers_ns.popleft()
        return None

    def take(self, dn: npt.NDArray[np.uint16], begin_ns: int) -> None:
        """Send an image (height, width), DN, whose exposure began at `begin_ns`, host time;
        nothing is sent where no client waited for it then.
        """
        if not self.wanted or begin_ns < self.started_ns:
            return
        self._block = next_block(self._block)
        packet_bytes = self.channel.packet_bytes
        block = image_block(self._block, dn, self.own_ns(begin_ns), self.settings, packet_bytes)
        try:
            self._waiting.put_nowait(block)
        except queue.Full:
            self.counts.dropped += 1
            return
        if self._remaining is not None:
            self._remaining -= 1
            if self._remaining <= 0:
                self.settings.streaming = False

    # ---- control ----

    def _serve(self) -> None:
        poll = select.poll()
        for listening in (self._control_socket, *self._searches):
            poll.register(listening, select.POLLIN)
        while not self._stop.is_set():
            poll.poll(LOOK_MS)
            count = sum(map(self._read, (self._control_socket, *self._searches)))
            self.channel.tick(self._clock.now_ns())
            self._do()
            if count > CROWD:
                self._stop.wait(PAUSE_S)

    def _read(self, listening: socket.socket) -> int:
        """Answer the datagrams that wait at a socket; how many there were."""
        count = strangers = 0
        host = ""
        while count < MAX_TAKEN:
            try:
                data, peer = listening.recvfrom(MAX_DATAGRAM_BYTES)
            except OSError:
                break
            count += 1
            if not self._allowed.admits(peer[0]):
                strangers += 1
                host = peer[0]
            elif self.channel.is_client(peer) or self._others.take(self._clock.now_ns()):
                self._answer(data, peer)
        if strangers:
            self._refuse(strangers, host, directed=listening is self._control_socket)
        return count

    def _answer(self, data: bytes, peer: Peer) -> None:
        now_ns = self._clock.now_ns()
        self.registers.time_ns = self.own_ns(now_ns)
        answer = self.channel.receive(data, peer, now_ns)
        if answer is not None:
            _send(self._control_socket, [answer], peer)
        self._do()

    def _refuse(self, strangers: int, host: str, *, directed: bool) -> None:
        # A search goes to every camera, and says nothing about this one.
        if directed:
            self._notices.begin(
                "camera-sender-not-allowed",
                f"datagrams to the camera from {host} are dropped: --allow does not name it;"
                " further ones are only counted",
            )
        if strangers > CROWD and not self._filtered:
            self._filtered = True
            for listening in (self._control_socket, *self._searches):
                keep_only_networks(listening, self._allowed.networks)

    def _do(self) -> None:
        """Do what the control channel's events ask for."""
        for event in self.channel.take_events():
            if isinstance(event, FeatureCommand):
                self._obey(event.name)
            elif isinstance(event, Resend):
                self._resend(event)
            elif isinstance(event, FiredPacket):
                self._fire(event.packet_bytes)
            elif isinstance(event, Released):
                self.settings.streaming = False
                if event.silent:
                    self._notices.tell("camera", "the camera's client fell silent; it is let go")

    def _obey(self, name: str) -> None:
        settings = self.settings
        if name == "AcquisitionStart":
            counts = {
                ACQUISITION_MODES["SingleFrame"]: 1,
                ACQUISITION_MODES["MultiFrame"]: settings.frame_count,
            }
            self._remaining = counts.get(settings.mode)
            self._triggers_ns.clear()
            self.started_ns = self._clock.now_ns()
            settings.streaming = True
        elif name == "AcquisitionStop":
            settings.streaming = False
        elif settings.triggered and settings.streaming:
            self.counts.triggers += 1
            self._triggers_ns.append(self._clock.now_ns())

    def _fire(self, packet_bytes: int) -> None:
        """Send a packet of a size, which a client uses to find the largest that passes."""
        destination = self.channel.destination
        if destination is not None:
            _send(self._stream_socket, [bytes(max(packet_bytes - 28, 8))], destination)

    def _resend(self, request: Resend) -> None:
        destination = self.channel.destination
        count = request.last - request.first + 1
        if destination is None or not self._again.take(self._clock.now_ns(), count):
            return
        block = next(
            (sent_block for sent_block in list(self._blocks) if sent_block.number == request.block),
            None,
        )
        if block is None:
            _send(self._stream_socket, [unavailable(request.block, request.first)], destination)
            return
        for number in range(request.first, min(request.last, block.last) + 1):
            _send(self._stream_socket, block.packet(number), destination)
            self.counts.resent += 1

    # ---- stream ----

    def _stream(self) -> None:
        while (block := self._waiting.get()) is not None:
            self._blocks.append(block)
            self._send_block(block)

    def _send_block(self, block: ImageBlock) -> None:
        destination = self.channel.destination
        if destination is None:
            self.counts.dropped += 1
            return
        delay_ns = self.registers.word(STREAM_DELAY)
        spread_ns = SPREAD * NS_PER_S / self.settings.rate_hz / (block.last + 1)
        pace_ns = max(delay_ns, spread_ns)
        begun_ns = self._clock.now_ns()
        for number, packet in enumerate(block.packets()):
            if number % BURST == 0:
                ahead_ns = begun_ns + number * pace_ns - self._clock.now_ns()
                if ahead_ns > 0:
                    time.sleep(ahead_ns / NS_PER_S)
            _send(self._stream_socket, packet, destination)
        self.counts.images += 1

    def close(self) -> None:
        """End both threads and close the sockets."""
        self._stop.set()
        with self._waiting.mutex:
            self._waiting.queue.clear()
        self._waiting.put(None)
        for thread in self._threads:
            thread.join()
        for made in (self._control_socket, self._stream_socket, *self._searches):
            made.close()


def _bound(address: ipaddress.IPv4Address, port: int) -> socket.socket:
    made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        made.bind((str(address), port))
    except OSError as error:
        made.close()
        trouble = TROUBLE.get(error.errno or 0, f"cannot be bound ({error.strerror})")
        raise InputError(f"--camera {address}: {trouble}") from error
    made.setblocking(False)
    return made


def _broadcasts(address: ipaddress.IPv4Address) -> list[socket.socket]:
    """Sockets for a client's search, which it sends to all: to the network of the camera's
    interface, and to no network in particular. Several cameras of a machine share them.
    """
    made = []
    for broadcast in {_broadcast_of(address), "255.255.255.255"}:
        listening = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listening.bind((broadcast, PORT))
        except OSError:  # a client then asks at the camera's own address
            listening.close()
            continue
        listening.setblocking(False)
        made.append(listening)
    return made


def _broadcast_of(address: ipaddress.IPv4Address) -> str:
    """The broadcast address of the interface that has an address."""
    if address.is_loopback:
        return LOOPBACK_BROADCAST
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
        for _, name in socket.if_nameindex():
            request = INTERFACE_REQUEST.pack(name.encode(), b"")
            with suppress(OSError):
                interface_reply = fcntl.ioctl(asking, SIOCGIFADDR, request)
                if interface_reply[ADDRESS_PLACE] == address.packed:
                    broadcast_reply = fcntl.ioctl(asking, SIOCGIFBRDADDR, request)
                    return str(ipaddress.IPv4Address(broadcast_reply[ADDRESS_PLACE]))
    return str(address)


def _send(sending: socket.socket, parts: list[bytes | memoryview], peer: Peer) -> None:
    """Send a datagram; one that finds no room waits for it a moment, and is then lost."""
    for _ in range(3):
        try:
            sending.sendmsg(parts, (), 0, peer)
            return
        except BlockingIOError:
            select.select((), (sending,), (), 0.01)
        except OSError:
            return
