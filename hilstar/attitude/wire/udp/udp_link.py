"""UDP: one packet or JSON object a datagram, from listed addresses only, and answers that never amount to more.

Laws:
1. A datagram from an address that is not allowed is counted and never answered; a flood of such ones is dropped by the kernel.
2. To an address go at most as many bytes of time requests and replies as came from it; statuses besides, at their own rate.
3. A flood costs the reading of MAX_TAKEN datagrams every PAUSE_S, and the decoding of what `FloodGate` admits.
"""

from __future__ import annotations

import time
from collections import OrderedDict
from functools import partial
from types import TracebackType
from typing import Self

from hilstar.attitude.wire.flood_limits import PAUSE_S, FloodGate, LinkCounts
from hilstar.attitude.wire.links import Arrival
from hilstar.attitude.wire.packet import Event, Packet, Status, declares_discontinuity, decode, encode
from hilstar.attitude.wire.source import PACKETS
from hilstar.attitude.wire.udp.addresses import AllowedSenders, Place
from hilstar.attitude.wire.udp.datagrams import Datagram, Datagrams, SocketAddress
from hilstar.notices import Notices

MAX_TAKEN = 1000  # in one go
MAX_STRANGERS = 1000  # datagrams a second of senders that are not allowed, before the kernel is asked
LOOK_S = 1.0
MAX_CREDIT_BYTES = 4096
MAX_PEERS = 64  # whose credit is kept


class Credit:
    """How many bytes may go back to each address: what came from it, less what went."""

    def __init__(self) -> None:
        self._bytes: OrderedDict[SocketAddress, int] = OrderedDict()

    def earn(self, peer: SocketAddress, count: int) -> None:
        """So many bytes came from there."""
        self._bytes[peer] = min(self._bytes.pop(peer, 0) + count, MAX_CREDIT_BYTES)
        if len(self._bytes) > MAX_PEERS:
            self._bytes.popitem(last=False)

    def spend(self, peer: SocketAddress, count: int) -> bool:
        """Whether so many bytes may go there; they are taken off."""
        left = self._bytes.get(peer, 0) - count
        if left < 0:
            return False
        self._bytes[peer] = left
        return True


class UdpLink:
    """A bound socket. Raises InputError where it cannot be bound.

    Each arrival says how to answer its sender (`Arrival.back`); the link itself has nobody to send to.
    """

    two_way = True
    verb = "bound to"
    conventions = PACKETS
    reconnects = 0

    def __init__(self, place: Place, allowed: AllowedSenders, notices: Notices | None = None) -> None:
        self.link_counts = LinkCounts()
        self._notices = Notices() if notices is None else notices
        self._allowed = allowed
        self._gate = FloodGate(self.link_counts, self._notices)
        self._credit = Credit()
        self._strangers = self._dropped = 0
        self._filtered = False
        self._looked_s = 0.0
        self._datagrams = Datagrams.bound(place)
        self.endpoint = str(Place(place.host, self._datagrams.port))

    def receive(self, timeout_ms: int) -> list[Arrival[Event]]:
        """The waiting datagrams of allowed senders, oldest first, and only the newest of a flood."""
        if not self._datagrams.wait(timeout_ms):
            return []
        taken = self._datagrams.take(MAX_TAKEN)
        waiting = [datagram for datagram in taken if self._admits(datagram)]
        self._look(len(taken) - len(waiting))
        admitted = self._gate.newest(waiting, lambda datagram: declares_discontinuity(datagram.data))
        if len(taken) == MAX_TAKEN:
            time.sleep(PAUSE_S)
        return [self._arrival(datagram) for datagram in admitted]

    def _admits(self, datagram: Datagram) -> bool:
        host = datagram.sender[0]
        if self._allowed.admits(host):
            return True
        self.link_counts.rejected += 1
        said = f"datagrams from {host} are dropped: it is not in [attitude] allow; further ones are only counted"
        self._notices.begin("sender-not-allowed", said)
        return False

    def _look(self, strangers: int) -> None:
        """Count what the kernel dropped, and have it drop the strangers where they are many."""
        self._strangers += strangers
        now_s = time.monotonic()
        if self._strangers > MAX_STRANGERS and not self._filtered:
            self._filtered = True
            if self._datagrams.keep_only(self._allowed.networks):
                said = f"over {MAX_STRANGERS} datagrams a second from senders that are not allowed: the kernel drops them now"
                self._notices.tell("flood", said)
        if now_s - self._looked_s > LOOK_S:
            self._looked_s, self._strangers = now_s, 0
            dropped = self._datagrams.dropped()
            self.link_counts.flooded += dropped - self._dropped
            self._dropped = dropped

    def _arrival(self, datagram: Datagram) -> Arrival[Event]:
        self._credit.earn(datagram.sender, len(datagram.data))
        back = partial(self._answer, datagram.sender)
        return Arrival(datagram.host_ns, decode(datagram.data), datagram.data, back=back, stamped=True)

    def _answer(self, peer: SocketAddress, packet: Packet) -> None:
        data = encode(packet)
        if isinstance(packet, Status) or self._credit.spend(peer, len(data)):
            self._datagrams.put(data, peer)

    def wait_for_message(self, timeout_ms: int) -> bool:
        """True once a datagram waits."""
        return self._datagrams.wait(timeout_ms)

    def send(self, packet: Packet) -> None:
        """To nobody: until an attitude has come, no sender is known."""

    def wire_ns(self, packet: Packet) -> int:
        """Negligible."""
        return 0

    def close(self) -> None:
        """Close the socket."""
        self._datagrams.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None) -> None:
        self.close()
