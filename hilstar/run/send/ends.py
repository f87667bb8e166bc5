"""The sender's ends of the wire: each puts packets, and those of a two-way road listen to what comes back."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Protocol, Self

from hilstar.attitude.wire.keys import NO_KEYS, CurveKeys
from hilstar.attitude.wire.links import Arrival, LinkCounts
from hilstar.attitude.wire.packet import DELIMITER, Event, Packet, Status, TimeReply, TimeRequest, decode, encode, framed
from hilstar.attitude.wire.serial_link import SerialLink, serial_target
from hilstar.attitude.wire.udp import Datagrams
from hilstar.attitude.wire.zmq_links import ZmqSender
from hilstar.errors import InputError, shortened
from hilstar.process.interrupts import caught

LISTEN_MS = 20
PATIENCE_S = 0.5  # a line that accepts nothing for this long has no reader
MAX_TAKEN = 100
PROBE_S = 0.02
UDP = re.compile(r"udp://(?:\[([0-9A-Fa-f:.]+(?:%\w+)?)\]|([^:\[\]/\s]+)):(\d{1,5})")


Clock = Callable[[], int]


class SenderEnd(Protocol):
    """Where a sender puts its packets. One that listens too is a `TwoWay`."""

    endpoint: str
    link_counts: LinkCounts

    def wait_for_listener(self, timeout_s: float) -> bool:
        """True once somebody listens, or where the road cannot tell."""

    def put(self, packet: bytes) -> None:
        """Send one packet."""

    def close(self) -> None:
        """Close it, once what was put has left."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /
    ) -> None: ...


def open_sender(to: str, *, connect: bool = False, keys: CurveKeys = NO_KEYS, clock: Clock = time.monotonic_ns) -> SenderEnd:
    """The end that `to` names: a serial line, UDP, or else a ZeroMQ endpoint; `clock` (ns) stamps its time replies.

    Raises InputError.
    """
    line = serial_target(to)
    if line is None and not to.startswith("udp:"):
        return ZmqSender(to, bind=not connect, keys=keys)
    if keys.given or connect:
        raise InputError(f"{to}: only ZeroMQ has keys, and a side that connects (--connect); remove them")
    return UdpSender(to, clock) if line is None else SerialSender(*line, clock)


class Listener:
    """A thread that answers time requests by `clock`, and keeps the newest status, from whatever `receive` brings."""

    def __init__(self, receive: Callable[[int], list[Arrival[Event]]], send: Callable[[Packet], None], clock: Clock) -> None:
        self.status: Status | None = None
        self.statuses = self.requests = 0
        self.answered = threading.Event()
        self._receive, self._send, self._clock = receive, send, clock
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._listen, name="hilstar-sender", daemon=True)
        self._thread.start()

    def _listen(self) -> None:
        while not self._stop.is_set():
            for arrival in self._receive(LISTEN_MS):
                match arrival.event:
                    case TimeRequest(sequence, t1_ns):
                        self.requests += 1
                        waited_ns = time.monotonic_ns() - arrival.host_ns
                        self._send(TimeReply(sequence, t1_ns, self._clock() - waited_ns, self._clock()))
                    case TimeReply():
                        self.answered.set()
                    case Status() as status:
                        self.status, self.statuses = status, self.statuses + 1

    def stop(self) -> None:
        """Stop listening."""
        self._stop.set()
        self._thread.join()


class TwoWay:
    """What an end hears."""

    _listener: Listener

    @property
    def status(self) -> Status | None:
        """The newest status."""
        return self._listener.status

    @property
    def statuses(self) -> int:
        """How many statuses came."""
        return self._listener.statuses

    @property
    def requests(self) -> int:
        """How many time requests came, and were answered."""
        return self._listener.requests


class SerialSender(TwoWay, SerialLink):
    """The sender's end of a serial line."""

    def __init__(self, port: str, baud: int, clock: Clock = time.monotonic_ns) -> None:
        super().__init__(port, baud)
        self.unsent = 0
        self.send_bytes(DELIMITER)
        self._listener = Listener(self.receive, self.send, clock)

    def wait_for_listener(self, timeout_s: float) -> bool:
        """A serial line cannot tell whether anybody listens."""
        return True

    def put(self, packet: bytes) -> None:
        """Frame a packet and send it, at the speed of the line."""
        self.unsent += not self.send_bytes(framed(packet), PATIENCE_S)

    def close(self) -> None:
        """Stop listening, and close the port once everything has been sent; after a signal at once."""
        self._listener.stop()
        if caught() is None:
            self.drain()
        super().close()


class UdpSender(TwoWay):
    """The sender's end of UDP: a connected socket. Raises InputError where the endpoint is wrong or its host unknown."""

    def __init__(self, to: str, clock: Clock = time.monotonic_ns) -> None:
        match = UDP.fullmatch(to)
        if match is None or not 0 < int(match[3]) < 65_536:
            raise InputError(f"{shortened(to)}: write udp://HOST:PORT, such as udp://127.0.0.1:5560 or udp://[::1]:5560")
        try:
            self._datagrams = Datagrams.connected(match[1] or match[2], int(match[3]))
        except OSError as error:
            raise InputError(f"{shortened(to)}: {error.strerror}; write the address of hilstar's machine") from error
        self.endpoint = to
        self.link_counts = LinkCounts()
        self.unsent = 0
        self._listener = Listener(self._receive, lambda packet: self.put(encode(packet)), clock)

    def _receive(self, timeout_ms: int) -> list[Arrival[Event]]:
        self._datagrams.wait(timeout_ms)
        return [Arrival(each.host_ns, decode(each.data), each.data) for each in self._datagrams.take(MAX_TAKEN)]

    def wait_for_listener(self, timeout_s: float) -> bool:
        """True once hilstar has answered a time request."""
        deadline_s = time.monotonic() + timeout_s
        while True:
            self.put(encode(TimeRequest(0, time.monotonic_ns())))
            if self._listener.answered.wait(PROBE_S):
                return True
            if time.monotonic() > deadline_s:
                return False

    def put(self, packet: bytes) -> None:
        """Send one datagram, never waiting."""
        self.unsent += not self._datagrams.put(packet)

    def close(self) -> None:
        """Stop listening, and close the socket."""
        self._listener.stop()
        self._datagrams.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None) -> None:
        self.close()
