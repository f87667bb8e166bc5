"""The TCP connection to 42: hilstar connects, again and again until 42 is there, or listens where 42 is the client.

42 waits for an acknowledgement of each message before it computes on.
"""

from __future__ import annotations

import contextlib
import select
import socket
import time
from types import TracebackType
from typing import Self

from hilstar.attitude.wire.endpoint import Endpoint, check_use, parse_endpoint
from hilstar.attitude.wire.flood_limits import FloodGate, LinkCounts
from hilstar.attitude.wire.links import Arrival
from hilstar.attitude.wire.nasa42.messages import CONVENTIONS, MessageReader, MessageSplitter
from hilstar.attitude.wire.packet import Event, Packet
from hilstar.attitude.wire.udp.addresses import AllowedSenders
from hilstar.attitude.wire.udp.kernel_stamps import ANCILLARY_BYTES, KernelStamps
from hilstar.errors import InputError
from hilstar.notices import Notices

ACK = b"Ack\n"
CONNECT_S = 0.3
RETRY_S = 0.25
MAX_READ_BYTES = 65_536
# A peer whose cable was pulled says nothing: the kernel asks.
KEEPALIVE = {socket.TCP_KEEPIDLE: 3, socket.TCP_KEEPINTVL: 1, socket.TCP_KEEPCNT: 3}


class Nasa42Link:
    """One connection at a time; a second one is closed at once. Raises InputError where it cannot be bound."""

    two_way = False
    conventions = CONVENTIONS

    def __init__(
        self,
        endpoint: str,
        reader: MessageReader,
        *,
        bind: bool = False,
        allowed: AllowedSenders | None = None,
        notices: Notices | None = None,
    ) -> None:
        place = parse_endpoint(endpoint)
        check_use(place, endpoint, bind=bind)
        if place.path is not None:
            raise InputError(f"{endpoint}: 42 speaks TCP; write tcp://HOST:PORT, such as tcp://127.0.0.1:10001")
        self.endpoint, self.verb = endpoint, "bound to" if bind else "connecting to"
        self.link_counts = LinkCounts()
        self._host, self._port = _host_and_port(place)
        self._reader, self._splitter = reader, MessageSplitter()
        self._allowed = AllowedSenders() if allowed is None else allowed
        self._notices = Notices() if notices is None else notices
        self._gate = FloodGate(self.link_counts, self._notices)
        self._connection: socket.socket | None = None
        self._retry_s = 0.0
        self._listener = self._listen() if bind else None

    @property
    def reconnects(self) -> int:
        """How often 42 came back."""
        return max(0, self.link_counts.connections - 1)

    def _listen(self) -> socket.socket:
        try:
            made = socket.create_server(
                (self._host, self._port), family=socket.AF_INET6 if ":" in self._host else socket.AF_INET
            )
        except OSError as error:
            raise InputError(f"{self.endpoint}: cannot bind ({error.strerror}); write another address or port") from error
        made.setblocking(False)
        host = f"[{self._host}]" if ":" in self._host else self._host
        self.endpoint = f"tcp://{host}:{made.getsockname()[1]}"
        return made

    def receive(self, timeout_ms: int) -> list[Arrival[Event]]:
        """The messages that have arrived; each is acknowledged."""
        if self._connection is None and self._listener is None:
            self._connect(timeout_ms)
        if not self.wait_for_message(timeout_ms):
            return []
        chunk, host_ns = self._read()
        if not chunk:  # the connection says no more for now, or ever
            self._accept()
            return []
        messages = self._splitter.feed(chunk)
        self._read_messages(len(messages))
        admitted = self._gate.newest(messages, lambda message: False)  # 42 declares none
        arrivals: list[Arrival[Event]] = []
        for k, message in enumerate(admitted, 1):
            # The kernel's stamp is that of the last.
            waited_ns = 0 if k == len(admitted) else host_ns - self._stamps.empty_ns
            arrivals.append(Arrival(host_ns, self._reader.decode(message), message, waited_ns=waited_ns, stamped=True))
        return arrivals

    def _read(self) -> tuple[bytes, int]:
        """What has come, and when the last of it did."""
        if self._connection is None:
            return b"", 0
        with contextlib.suppress(OSError):
            try:
                chunk, ancillary, _, _ = self._connection.recvmsg(MAX_READ_BYTES, ANCILLARY_BYTES)
            except BlockingIOError:
                return b"", 0
            if chunk:
                return chunk, self._stamps.arrived_ns(ancillary, time.monotonic_ns())
        self._lose()
        return b"", 0

    def _read_messages(self, count: int) -> None:
        """So many messages were read: 42 may compute on."""
        self.acknowledge(count)

    def acknowledge(self, count: int = 1) -> None:
        """Let 42 compute on: it waits after each message."""
        if self._connection is not None and count:
            with contextlib.suppress(OSError):  # one that is gone is noticed by the next read
                self._connection.send(ACK * count)

    def _connect(self, timeout_ms: int) -> None:
        wait_s = self._retry_s - time.monotonic()
        if wait_s > 0:
            time.sleep(min(wait_s, timeout_ms / 1000))
            return
        self._retry_s = time.monotonic() + RETRY_S
        with contextlib.suppress(OSError):
            self._take(socket.create_connection((self._host, self._port), timeout=CONNECT_S))

    def _accept(self) -> None:
        while self._listener is not None:
            try:
                made, peer = self._listener.accept()
            except OSError:
                return
            if not self._allowed.admits(peer[0]):
                self.link_counts.rejected += 1
                self._notices.begin(
                    "sender-not-allowed", f"a connection from {peer[0]} is closed: it is not in [attitude] allow"
                )
            elif self._connection is not None:
                self.link_counts.refused += 1
                self._notices.tell("connections-refused", f"a second connection, from {peer[0]}, is closed; 42 has one already")
            else:
                self._take(made)
                continue
            made.close()

    def _take(self, made: socket.socket) -> None:
        self.link_counts.connections += 1
        made.setblocking(False)
        made.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        made.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for option, value in KEEPALIVE.items():
            made.setsockopt(socket.IPPROTO_TCP, option, value)
        self._splitter = MessageSplitter()
        self._connection, self._stamps = made, KernelStamps(made)
        if self.link_counts.connections > 1:
            self._notices.tell("back", "42 is connected again")

    def _lose(self) -> None:
        self.link_counts.lost += 1
        self._notices.tell("lost", f"{self.endpoint}: 42 closed the connection; waiting for it to come back")
        self._shut()

    def wait_for_message(self, timeout_ms: int) -> bool:
        """True once unread bytes or a new connection wait."""
        waited = [each for each in (self._listener, self._connection) if each is not None]
        if not waited:
            return False
        poll = select.poll()
        for each in waited:
            poll.register(each, select.POLLIN)
        asked_ns = time.monotonic_ns()
        waits = bool(poll.poll(timeout_ms))
        if not waits and self._connection is not None:
            self._stamps.empty_ns = asked_ns
        return waits

    def send(self, packet: Packet) -> None:
        """42 hears acknowledgements and nothing else."""

    def wire_ns(self, packet: Packet) -> int:
        """Negligible."""
        return 0

    def _shut(self) -> None:
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.close()

    def close(self) -> None:
        """Close the connection; 42 ends at its next message."""
        self._shut()
        if self._listener is not None:
            self._listener.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


class Nasa42Lockstep(Nasa42Link):
    """42 waits for each frame: whoever shows it acknowledges its message."""

    def _read_messages(self, count: int) -> None:
        """Nothing is acknowledged yet."""


def _host_and_port(place: Endpoint) -> tuple[str, int]:
    host, _, port = place.address.removeprefix("tcp://").rpartition(":")
    return "0.0.0.0" if host == "*" else host.strip("[]"), 0 if port == "*" else int(port)
