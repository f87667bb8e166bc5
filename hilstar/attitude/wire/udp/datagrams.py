"""A UDP socket that knows when each datagram arrived: the kernel stamps it, however late it is read."""

from __future__ import annotations

import contextlib
import errno
import select
import socket
import struct
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from hilstar.attitude.wire.packet import MAX_JSON_BYTES
from hilstar.attitude.wire.udp.addresses import Network, Place
from hilstar.attitude.wire.udp.kernel_filter import keep_only
from hilstar.errors import InputError
from hilstar.units import NS_PER_S

MAX_DATAGRAM_BYTES = MAX_JSON_BYTES + 1  # the rest of a longer one is cut off, and `packet.decode` refuses what is left
WANTED_BUFFER_BYTES = 1 << 20  # the kernel gives what it allows; a small datagram takes some 800 bytes of it
# Linux's numbers, which Python does not name (asm-generic/socket.h). Its stamp is a timespec of CLOCK_REALTIME.
SO_TIMESTAMPNS = 35
SO_MEMINFO = 55
MEMINFO = struct.Struct("=9I")  # linux/sock_diag.h; the last is SK_MEMINFO_DROPS
TIMESPEC = struct.Struct("@ll")
ANCILLARY_BYTES = socket.CMSG_SPACE(TIMESPEC.size)
CLOCK_TRIES = 3
NEAR_NS = 20_000

SocketAddress = tuple[Any, ...]


@dataclass(frozen=True, slots=True)
class Datagram:
    """When it arrived (host time), its bytes, and who sent it."""

    host_ns: int
    data: bytes
    sender: SocketAddress


class Datagrams:
    """A socket, bound to a place of this machine or connected to a peer, that never waits but in `wait`."""

    def __init__(self, made: socket.socket) -> None:
        self._socket = made
        self._empty_ns = time.monotonic_ns()  # what is read arrived later than that
        self._poll = select.poll()
        self._poll.register(made, select.POLLIN)
        made.setblocking(False)
        made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, WANTED_BUFFER_BYTES)
        with contextlib.suppress(OSError):  # a kernel without stamps: then the time of reading
            made.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)

    @classmethod
    def bound(cls, place: Place) -> Datagrams:
        """Bound to a place. Raises InputError where it cannot be."""
        made = socket.socket(socket.AF_INET6 if place.host.version == 6 else socket.AF_INET, socket.SOCK_DGRAM)
        try:
            if place.host.version == 6:
                made.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
            made.bind(_first_address(str(place.host), place.port))
        except OSError as error:
            made.close()
            raise InputError(f"{place}: {_trouble(error)}") from error
        return cls(made)

    @classmethod
    def connected(cls, host: str, port: int) -> Datagrams:
        """Connected to a peer: only its datagrams arrive. Raises OSError where the host is unknown."""
        found = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)
        made = socket.socket(found[0][0], socket.SOCK_DGRAM)
        try:
            made.connect(found[0][4])
        except OSError:
            made.close()
            raise
        return cls(made)

    @property
    def port(self) -> int:
        """The port of this end."""
        return int(self._socket.getsockname()[1])

    def wait(self, timeout_ms: float) -> bool:
        """True once a datagram waits."""
        asked_ns = time.monotonic_ns()
        if self._poll.poll(timeout_ms):
            return True
        self._empty_ns = asked_ns
        return False

    def take(self, count: int) -> list[Datagram]:
        """The datagrams that wait, oldest first, `count` at most."""
        offset_ns = _monotonic_minus_realtime_ns()
        taken: list[Datagram] = []
        for _ in range(count):
            asked_ns = time.monotonic_ns()
            try:
                data, ancillary, _, sender = self._socket.recvmsg(MAX_DATAGRAM_BYTES, ANCILLARY_BYTES)
            except BlockingIOError:
                self._empty_ns = asked_ns
                break
            except OSError:  # a connected socket hears that nobody listens at its peer's port
                continue
            taken.append(Datagram(self._arrived_ns(ancillary, offset_ns, asked_ns), data, sender))
        return taken

    def _arrived_ns(self, ancillary: list[tuple[int, int, bytes]], offset_ns: int, now_ns: int) -> int:
        """The kernel's stamp on the monotonic clock; a realtime clock that was set moves it by no more than it waited."""
        for _, kind, stamp in ancillary:
            if kind == SO_TIMESTAMPNS and len(stamp) == TIMESPEC.size:
                seconds, ns = TIMESPEC.unpack(stamp)
                stamped_ns: int = seconds * NS_PER_S + ns + offset_ns
                return min(max(stamped_ns, self._empty_ns), now_ns)
        return now_ns

    def put(self, data: bytes, to: SocketAddress | None = None) -> bool:
        """Send without waiting; False where it did not leave."""
        for _ in range(2):  # a connected socket's send may report what became of an earlier datagram, and sends nothing
            try:
                sent = self._socket.send(data) if to is None else self._socket.sendto(data, to)
            except ConnectionRefusedError:
                continue
            except OSError:
                return False
            return sent == len(data)
        return False

    def keep_only(self, networks: Sequence[Network]) -> bool:
        """Have the kernel drop what comes from anywhere else; False where it cannot."""
        return keep_only(self._socket, networks)

    def dropped(self) -> int:
        """How many datagrams the kernel dropped so far: by that filter, or for want of room."""
        with contextlib.suppress(OSError, struct.error):
            told = self._socket.getsockopt(socket.SOL_SOCKET, SO_MEMINFO, MEMINFO.size)
            return int(MEMINFO.unpack(told)[-1])
        return 0

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


def _first_address(host: str, port: int) -> SocketAddress:
    return socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM, flags=socket.AI_NUMERICHOST)[0][4]


def _monotonic_minus_realtime_ns() -> int:
    """The offset between the two clocks of this machine, both read within a few microseconds where that succeeds."""
    best_ns, offset_ns = None, 0
    for _ in range(CLOCK_TRIES):
        before_ns, realtime_ns, after_ns = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        took_ns = after_ns - before_ns
        if best_ns is None or took_ns < best_ns:
            best_ns, offset_ns = took_ns, (before_ns + after_ns) // 2 - realtime_ns
        if took_ns < NEAR_NS:
            break
    return offset_ns


def _trouble(error: OSError) -> str:
    if error.errno == errno.EADDRINUSE:
        return "the port is in use; stop the program that has it, or choose another port"
    if error.errno == errno.EADDRNOTAVAIL:
        return "not an address of this machine; write one that `ip addr` lists, or 0.0.0.0 for all"
    if error.errno == errno.EACCES:
        return "not permitted; write a port from 1024 to 65535"
    return f"cannot bind ({error.strerror}); write an address of this machine"
