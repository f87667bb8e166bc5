"""UDP: each datagram is one packet or JSON object. Only listed addresses are read, and a sender
gets no more bytes in answer than it sent.

Laws:
1. A datagram from an address that is not allowed is counted and never answered. The kernel drops a
   flood of them by a socket filter (classic BPF; Linux, Documentation/networking/filter.rst),
   before they cost buffer space or a read.
2. An address gets at most as many bytes of time requests, replies and answers as came from it.
   Statuses do not count in this; they go at a limited rate.
3. A flood costs the reading of MAX_TAKEN datagrams every PAUSE_S, and the decoding of those that
   `FloodGate` admits.

The kernel stamps the arrival (SO_TIMESTAMPNS), so that the stamp is right however late a datagram
is read; `KernelStamps` does the same for TCP.
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
SKF_NET_OFF = 0xFFF00000  # linux/filter.h: offsets from here on count from the IP header
SOURCE_AT = {4: 12, 6: 8}  # offset of the source address in the IP header, by IP version
WORD_BYTES = 4
# opcodes of classic BPF: BPF_LD | BPF_W | BPF_ABS, BPF_ALU | BPF_AND, BPF_JMP | BPF_JEQ, BPF_RET
LOAD_WORD, AND, JUMP_IF_EQUAL, RETURN = 0x20, 0x54, 0x15, 0x06
WHOLE, NOTHING = 0xFFFF, 0  # how many bytes of the datagram a filter lets through
INSTRUCTION = struct.Struct("=HBBI")  # struct sock_filter: code, jump if true, if false, operand
MAX_INSTRUCTIONS = 4096  # BPF_MAXINSNS of linux/bpf_common.h
# A longer datagram is cut to one byte over the limit, which `packet.decode` then refuses.
MAX_DATAGRAM_BYTES = MAX_JSON_BYTES + 1
# the kernel gives as much as it allows; a small datagram takes some 800 bytes of it
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
MAX_TAKEN = 1000  # datagrams read in one call
# datagrams a second from senders that are not allowed; above it the kernel is made to drop them
MAX_STRANGERS = 1000
LOOK_NS = NS_PER_S  # the second over which strangers are counted
MAX_CREDIT_BYTES = 4096
MAX_PEERS = 64  # whose credit is recorded


def filter_program(networks: Sequence[Network], version: int) -> bytes:
    """The classic BPF program, as bytes, that lets datagrams from `networks` through and drops all
    others. It serves a socket of one IP `version`, 4 or 6; networks of the other are left out.
    """
    code = []
    for network in networks:
        if network.version != version:
            continue
        address, mask = network.network_address.packed, network.netmask.packed
        word_places = range(0, len(address), WORD_BYTES)
        # Each word of the source address, under the mask, must be the network's. Otherwise jump
        # over the network's other words, three instructions each, and its RETURN.
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
    """Make the kernel drop datagrams from all other addresses at a socket; False where the filter
    is too long, or the kernel refuses it.
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
    """A UDP socket, bound to an address of this machine or connected to a peer. Only `wait`
    waits.
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
        """A socket bound to `place`. Raises InputError where that cannot be bound."""
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
        """A socket connected to a peer, which receives the peer's datagrams alone. Raises OSError
        where the host is unknown or cannot be reached.
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
        """The port of this machine that the socket is bound to."""
        return int(self._socket.getsockname()[1])

    def wait(self, timeout_ms: float) -> bool:
        """True once a datagram waits, False after `timeout_ms` without one."""
        asked_ns = self._clock.now_ns()
        if self._poll.poll(timeout_ms):
            return True
        self._stamps.empty_ns = asked_ns
        return False

    def take(self, count: int) -> list[RawMessage]:
        """The datagrams that wait, at most `count`, oldest first; it does not wait for one."""
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
            except OSError:  # a connected socket reports that nobody listens at its peer's port
                continue
            host_ns = self._stamps.arrived_ns(ancillary, asked_ns, offset_ns)
            taken.append(RawMessage(host_ns, [data], sender=sender))
        return taken

    def put(self, data: bytes, to: SocketAddress | None = None) -> bool:
        """Send a datagram without waiting, to the address `to` or to the connected peer; False
        where it was not sent.
        """
        # Where a connected socket's peer refused an earlier datagram, the next send reports that
        # and sends nothing: so it is tried once more.
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
        """Make the kernel drop datagrams from all other addresses; False where the filter is too
        long, or the kernel refuses it.
        """
        return keep_only_networks(self._socket, networks)

    def dropped(self) -> int:
        """How many datagrams the kernel has dropped so far, by the filter or because the buffer
        was full; 0 where it does not say.
        """
        with contextlib.suppress(OSError, struct.error):
            memory_info = self._socket.getsockopt(socket.SOL_SOCKET, SO_MEMINFO, MEMINFO.size)
            return int(MEMINFO.unpack(memory_info)[-1])
        return 0

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class Credit:
    """How many bytes may be sent to each address: the bytes that came from it less those sent to
    it, at most MAX_CREDIT_BYTES. Of more than MAX_PEERS addresses the one last heard longest ago
    is forgotten.
    """

    def __init__(self) -> None:
        self._bytes: OrderedDict[SocketAddress, int] = OrderedDict()

    def earn(self, peer: SocketAddress, count: int) -> None:
        """Add `count` bytes that came from a peer to its credit."""
        self._bytes[peer] = min(self._bytes.pop(peer, 0) + count, MAX_CREDIT_BYTES)
        if len(self._bytes) > MAX_PEERS:
            self._bytes.popitem(last=False)

    def spend(self, peer: SocketAddress, count: int) -> bool:
        """Whether `count` bytes may be sent to a peer; if so, they are deducted."""
        rest_bytes = self._bytes.get(peer, 0) - count
        if rest_bytes < 0:
            return False
        self._bytes[peer] = rest_bytes
        return True


class UdpRoad(ByteRoad):
    """Datagrams, at a socket that is bound to a `UdpPlace` and reads the `allowed` senders, or is
    connected to a peer (host, port).

    Raises InputError where `place` cannot be bound or reached.
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
        """Count the `strangers`, datagrams of senders that are not allowed, and make the kernel
        drop them where there are more than MAX_STRANGERS a second; once a second count what the
        kernel has dropped.
        """
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
        """True once a datagram waits, False after `timeout_ms` without one."""
        return self._datagrams.wait(timeout_ms)

    def put(self, data: bytes, patience_s: float = 0.0) -> bool:
        """See `ByteRoad.put`. It never waits, so `patience_s` has no effect; a bound road sends
        nothing here, as it has no single peer.
        """
        return self._allowed is None and self._datagrams.put(data)

    def put_to(self, peer: SocketAddress, data: bytes) -> bool:
        """Send to one of several senders without waiting; False where nothing was sent."""
        return self._datagrams.put(data, peer)

    def close(self) -> None:
        """Close the socket."""
        self._datagrams.close()


class DatagramDecoder(PacketDecoder):
    """Decodes the packets of several senders. Each arrival can be answered to its own sender, with
    no more bytes than came from that sender; statuses do not count in this.
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
    """Attitudes from a bound UDP socket. Raises InputError where it cannot be bound.

    Each arrival has a function that answers its sender (`Arrival.back`); the link itself has no
    single peer to send to.
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
