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
from hilstar.attitude.wire.udp.kernel_stamps import ANCILLARY_BYTES, KernelStamps, monotonic_minus_realtime_ns
from hilstar.errors import InputError

MAX_DATAGRAM_BYTES = MAX_JSON_BYTES + 1  # the rest of a longer one is cut off, and `packet.decode` refuses what is left
WANTED_BUFFER_BYTES = 1 << 20  # the kernel gives what it allows; a small datagram takes some 800 bytes of it
SO_MEMINFO = 55  # Linux's number, which Python does not name (asm-generic/socket.h)
MEMINFO = struct.Struct("=9I")  # linux/sock_diag.h; the last is SK_MEMINFO_DROPS

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
        self._poll = select.poll()
        self._poll.register(made, select.POLLIN)
        made.setblocking(False)
        made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, WANTED_BUFFER_BYTES)
        self._stamps = KernelStamps(made)

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
        self._stamps.empty_ns = asked_ns
        return False

    def take(self, count: int) -> list[Datagram]:
        """The datagrams that wait, oldest first, `count` at most."""
        offset_ns = monotonic_minus_realtime_ns()
        taken: list[Datagram] = []
        for _ in range(count):
            asked_ns = time.monotonic_ns()
            try:
                data, ancillary, _, sender = self._socket.recvmsg(MAX_DATAGRAM_BYTES, ANCILLARY_BYTES)
            except BlockingIOError:
                self._stamps.empty_ns = asked_ns
                break
            except OSError:  # a connected socket hears that nobody listens at its peer's port
                continue
            taken.append(Datagram(self._stamps.arrived_ns(ancillary, asked_ns, offset_ns), data, sender))
        return taken

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


def _trouble(error: OSError) -> str:
    if error.errno == errno.EADDRINUSE:
        return "the port is in use; stop the program that has it, or choose another port"
    if error.errno == errno.EADDRNOTAVAIL:
        return "not an address of this machine; write one that `ip addr` lists, or 0.0.0.0 for all"
    if error.errno == errno.EACCES:
        return "not permitted; write a port from 1024 to 65535"
    return f"cannot bind ({error.strerror}); write an address of this machine"
