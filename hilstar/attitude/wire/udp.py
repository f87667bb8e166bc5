"""UDP: one packet or JSON object a datagram, from listed addresses only, and answers that never
amount to more.

Laws:
1. A datagram from an address that is not allowed is counted and never answered; the kernel drops a
   flood of them, by a socket
   filter (classic BPF; Linux, Documentation/networking/filter.rst), before it costs buffer space or
   a read.
2. To an address go at most as many bytes of time requests, replies and answers as came from it;
   statuses besides, at a rate.
3. A flood costs the reading of MAX_TAKEN datagrams every PAUSE_S, and the decoding of what
   `FloodGate` admits.

The kernel stamps the arrival (SO_TIMESTAMPNS), however late a datagram is read; `KernelStamps` does
the same for TCP.
"""

import contextlib
import ctypes
import errno
import select
import socket
import struct
from collections import OrderedDict
from collections.abc import Sequence
from functools import partial
from typing import Any

from hilstar.attitude.wire.endpoint import AllowedSenders, Network, UdpPlace
from hilstar.attitude.wire.kernel_stamps import ANCILLARY_BYTES, KernelStamps
from hilstar.attitude.wire.links import Arrival, PacketDecoder, StreamLink
from hilstar.attitude.wire.packet import MAX_JSON_BYTES, Event, Packet, Status, encode
from hilstar.attitude.wire.road_use import RoadUse
from hilstar.attitude.wire.roads import ATTITUDES, PAUSE_S, ByteRoad, RawMessage
from hilstar.attitude.wire.source import AS_SENT, SentAttitudes
from hilstar.basics.errors import InputError
from hilstar.basics.notices import Notices
from hilstar.basics.process.scheduling import HOST_CLOCK, HostClock
from hilstar.basics.units import NS_PER_S

SO_ATTACH_FILTER = 26  # asm-generic/socket.h
SKF_NET_OFF = 0xFFF00000
SOURCE_AT = {4: 12, 6: 8}  # in the IP header
WORD_BYTES = 4
LOAD_WORD, AND, JUMP_IF_EQUAL, RETURN = 0x20, 0x54, 0x15, 0x06
WHOLE, NOTHING = 0xFFFF, 0
INSTRUCTION = struct.Struct("=HBBI")
MAX_INSTRUCTIONS = 4096
# the rest of a longer one is cut off, and `packet.decode` refuses what is left
MAX_DATAGRAM_BYTES = MAX_JSON_BYTES + 1
# the kernel gives what it allows; a small datagram takes some 800 bytes of it
WANTED_BUFFER_BYTES = 1 << 20
SO_MEMINFO = 55  # Linux's number, which Python does not name (asm-generic/socket.h)
MEMINFO = struct.Struct("=9I")  # linux/sock_diag.h; the last is SK_MEMINFO_DROPS

TROUBLE = {
    errno.EADDRINUSE: "the port is in use; stop the program that has it, or choose another port",
    errno.EADDRNOTAVAIL: (
        "not an address of this machine; write one that `ip addr` lists, or 0.0.0.0 for all"
    ),
    errno.EACCES: "not permitted; write a port from 1024 to 65535",
}
SocketAddress = tuple[Any, ...]
MAX_TAKEN = 1000  # in one go
# datagrams a second of senders that are not allowed, before the kernel is asked
MAX_STRANGERS = 1000
LOOK_NS = NS_PER_S
MAX_CREDIT_BYTES = 4096
MAX_PEERS = 64  # whose credit is kept


def filter_program(networks: Sequence[Network], version: int) -> bytes:
    """The program that keeps what comes from these networks, all of that IP version, and drops
    the rest.
    """
    code = []
    for network in networks:
        if network.version != version:
            continue
        address, mask = network.network_address.packed, network.netmask.packed
        word_places = range(0, len(address), WORD_BYTES)
        # each word of the source address must be the network's, else go on after this network
        for k, at in enumerate(word_places):
            address_word = int.from_bytes(address[at : at + WORD_BYTES], "big")
            mask_word = int.from_bytes(mask[at : at + WORD_BYTES], "big")
            to_next_network = 3 * (len(word_places) - k - 1) + 1
            code.append(INSTRUCTION.pack(LOAD_WORD, 0, 0, SKF_NET_OFF + SOURCE_AT[version] + at))
            code.append(INSTRUCTION.pack(AND, 0, 0, mask_word))
            code.append(INSTRUCTION.pack(JUMP_IF_EQUAL, 0, to_next_network, address_word))
        code.append(INSTRUCTION.pack(RETURN, 0, 0, WHOLE))
    return b"".join([*code, INSTRUCTION.pack(RETURN, 0, 0, NOTHING)])


def keep_only_networks(receiving: socket.socket, networks: Sequence[Network]) -> bool:
    """Have the kernel drop datagrams from other addresses at a socket; False where it does not
    take the filter.
    """
    code = filter_program(networks, 6 if receiving.family == socket.AF_INET6 else 4)
    count = len(code) // INSTRUCTION.size
    if count > MAX_INSTRUCTIONS:
        return False
    program = ctypes.create_string_buffer(code, len(code))
    with contextlib.suppress(OSError):
        pointer = struct.pack("@HP", count, ctypes.addressof(program))
        receiving.setsockopt(socket.SOL_SOCKET, SO_ATTACH_FILTER, pointer)
        return True
    return False


class Datagrams:
    """A socket, bound to a place of this machine or connected to a peer, that never waits but in
    `wait`.
    """

    def __init__(self, made: socket.socket, clock: HostClock = HOST_CLOCK) -> None:
        self._socket = made
        self._clock = clock
        self._poll = select.poll()
        self._poll.register(made, select.POLLIN)
        made.setblocking(False)
        made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, WANTED_BUFFER_BYTES)
        self._stamps = KernelStamps(made, clock)

    @classmethod
    def bound(cls, place: UdpPlace, clock: HostClock = HOST_CLOCK) -> "Datagrams":
        """Bound to a place. Raises InputError where it cannot be."""
        made = socket.socket(
            socket.AF_INET6 if place.host.version == 6 else socket.AF_INET, socket.SOCK_DGRAM
        )
        try:
            if place.host.version == 6:
                made.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
            addresses = socket.getaddrinfo(
                str(place.host), place.port, type=socket.SOCK_DGRAM, flags=socket.AI_NUMERICHOST
            )
            made.bind(addresses[0][4])
        except OSError as error:
            made.close()
            trouble = TROUBLE.get(
                error.errno or 0,
                f"cannot bind ({error.strerror}); write an address of this machine",
            )
            raise InputError(f"{place}: {trouble}") from error
        return cls(made, clock)

    @classmethod
    def connected(cls, host: str, port: int, clock: HostClock = HOST_CLOCK) -> "Datagrams":
        """Connected to a peer: only its datagrams arrive. Raises OSError where the host is
        unknown.
        """
        addresses = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)
        made = socket.socket(addresses[0][0], socket.SOCK_DGRAM)
        try:
            made.connect(addresses[0][4])
        except OSError:
            made.close()
            raise
        return cls(made, clock)

    @property
    def port(self) -> int:
        """The port of this end."""
        return int(self._socket.getsockname()[1])

    def wait(self, timeout_ms: float) -> bool:
        """True once a datagram waits."""
        asked_ns = self._clock.now_ns()
        if self._poll.poll(timeout_ms):
            return True
        self._stamps.empty_ns = asked_ns
        return False

    def take(self, count: int) -> list[RawMessage]:
        """The datagrams that wait, oldest first, `count` at most."""
        offset_ns = self._clock.monotonic_minus_realtime_ns()
        taken: list[RawMessage] = []
        for _ in range(count):
            asked_ns = self._clock.now_ns()
            try:
                data, ancillary, _, sender = self._socket.recvmsg(
                    MAX_DATAGRAM_BYTES, ANCILLARY_BYTES
                )
            except BlockingIOError:
                self._stamps.empty_ns = asked_ns
                break
            except OSError:  # a connected socket hears that nobody listens at its peer's port
                continue
            host_ns = self._stamps.arrived_ns(ancillary, asked_ns, offset_ns)
            taken.append(RawMessage(host_ns, [data], sender=sender))
        return taken

    def put(self, data: bytes, to: SocketAddress | None = None) -> bool:
        """Send without waiting; False where it did not leave."""
        # a connected socket's send may report what became of an earlier datagram, and sends nothing
        for _ in range(2):
            try:
                if to is None:
                    sent = self._socket.send(data)
                else:
                    sent = self._socket.sendto(data, to)
            except ConnectionRefusedError:
                continue
            except OSError:
                return False
            return sent == len(data)
        return False

    def keep_only(self, networks: Sequence[Network]) -> bool:
        """Have the kernel drop datagrams from other addresses; False where it does not take the
        filter.
        """
        return keep_only_networks(self._socket, networks)

    def dropped(self) -> int:
        """How many datagrams the kernel dropped so far: by that filter, or for want of room."""
        with contextlib.suppress(OSError, struct.error):
            memory_info = self._socket.getsockopt(socket.SOL_SOCKET, SO_MEMINFO, MEMINFO.size)
            return int(MEMINFO.unpack(memory_info)[-1])
        return 0

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class Credit:
    """How many bytes may go back to each address: what came from it, less what went."""

    def __init__(self) -> None:
        self._bytes: OrderedDict[SocketAddress, int] = OrderedDict()

    def earn(self, peer: SocketAddress, count: int) -> None:
        """Credit a peer with the bytes that came from it."""
        self._bytes[peer] = min(self._bytes.pop(peer, 0) + count, MAX_CREDIT_BYTES)
        if len(self._bytes) > MAX_PEERS:
            self._bytes.popitem(last=False)

    def spend(self, peer: SocketAddress, count: int) -> bool:
        """Whether `count` bytes may go to a peer; if so, they are deducted."""
        rest_bytes = self._bytes.get(peer, 0) - count
        if rest_bytes < 0:
            return False
        self._bytes[peer] = rest_bytes
        return True


class UdpRoad(ByteRoad):
    """Datagrams: bound to a place, with the senders that are allowed, or connected to a peer.

    Raises InputError where that cannot be.
    """

    messages = stamped = True
    verb = "bound to"

    def __init__(
        self,
        place: UdpPlace | tuple[str, int],
        allowed: AllowedSenders,
        use: RoadUse = ATTITUDES,
        notices: Notices | None = None,
        clock: HostClock = HOST_CLOCK,
    ) -> None:
        self._allowed: AllowedSenders | None = None
        self._strangers = self._dropped = self._looked_ns = 0
        self._filtered = False
        if isinstance(place, UdpPlace):
            self._allowed = allowed
            try:
                self._datagrams = Datagrams.bound(place, clock)
            except InputError as error:
                raise InputError(f"{use.where}{error}") from error
            endpoint = str(UdpPlace(place.host, self._datagrams.port))
        else:
            endpoint = f"udp://{place[0]}:{place[1]}"
            try:
                self._datagrams = Datagrams.connected(*place, clock)
            except OSError as error:
                raise InputError(
                    f"{use.where}{endpoint}: {error.strerror}; write the tracker's address"
                ) from error
        super().__init__(endpoint, use, notices, clock)
        self._opened()

    def taken(self, timeout_ms: int) -> list[RawMessage]:
        """The waiting datagrams of allowed senders, oldest first; see `ByteRoad.taken`."""
        if not self._datagrams.wait(timeout_ms):
            return []
        datagrams = self._datagrams.take(MAX_TAKEN)
        if self._allowed is None:
            return datagrams
        admitted: list[RawMessage] = []
        for datagram in datagrams:
            host = (datagram.sender or ("",))[0]
            if self._allowed.admits(host):
                admitted.append(datagram)
                continue
            self.link_counts.rejected += 1
            notice = (
                f"datagrams from {host} are dropped: it is not in {self._use.table} allow; further"
                " ones are only counted"
            )
            self._notices.begin("sender-not-allowed", notice)
        self._look(self._allowed, len(datagrams) - len(admitted))
        if len(datagrams) == MAX_TAKEN:
            self._clock.sleep(PAUSE_S)
        return admitted

    def _look(self, allowed: AllowedSenders, strangers: int) -> None:
        """Count what the kernel dropped, and have it drop the strangers where they are many."""
        self._strangers += strangers
        now_ns = self._clock.now_ns()
        if self._strangers > MAX_STRANGERS and not self._filtered:
            self._filtered = True
            if self._datagrams.keep_only(allowed.networks):
                notice = (
                    f"over {MAX_STRANGERS} datagrams a second from senders that are not allowed:"
                    " the kernel drops them now"
                )
                self._notices.tell("flood", notice)
        if now_ns - self._looked_ns > LOOK_NS:
            self._looked_ns = now_ns
            self._strangers = 0
            dropped = self._datagrams.dropped()
            self.link_counts.flooded += dropped - self._dropped
            self._dropped = dropped

    def wait_for_message(self, timeout_ms: int) -> bool:
        """True once a datagram waits."""
        return self._datagrams.wait(timeout_ms)

    def put(self, data: bytes, patience_s: float = 0.0) -> bool:
        """See `ByteRoad.put`; nothing is waited for, and a bound road knows nobody to send to."""
        return self._allowed is None and self._datagrams.put(data)

    def put_to(self, peer: SocketAddress, data: bytes) -> bool:
        """Send to one of several senders, never waiting; False where it did not leave."""
        return self._datagrams.put(data, peer)

    def close(self) -> None:
        """Close the socket."""
        self._datagrams.close()


class DatagramDecoder(PacketDecoder):
    """Packets of several senders, each of which is answered for itself, and never by more bytes
    than came from it; statuses besides.
    """

    def __init__(self, road: UdpRoad, sent: SentAttitudes = AS_SENT) -> None:
        super().__init__(sent)
        self._road = road
        self._credit = Credit()

    def _arrival(self, message: RawMessage) -> Arrival[Event]:
        host_ns, (data,), _, _, sender = message
        peer = sender or ()
        self._credit.earn(peer, len(data))
        back = partial(self._answer, peer)
        return Arrival(host_ns, self.event(data), data, back=back, address=sender)

    def _answer(self, peer: SocketAddress, packet: Packet) -> None:
        data = encode(packet)
        if isinstance(packet, Status) or self._credit.spend(peer, len(data)):
            self._road.put_to(peer, data)


class UdpLink(StreamLink):
    """A bound socket. Raises InputError where it cannot be bound.

    Each arrival says how to answer its sender (`Arrival.back`); the link itself knows no sender to
    send to.
    """

    two_way = True

    def __init__(
        self,
        place: UdpPlace,
        allowed: AllowedSenders,
        notices: Notices | None = None,
        clock: HostClock = HOST_CLOCK,
        *,
        sent: SentAttitudes = AS_SENT,
    ) -> None:
        road = UdpRoad(place, allowed, ATTITUDES, notices, clock)
        super().__init__(road, DatagramDecoder(road, sent))
