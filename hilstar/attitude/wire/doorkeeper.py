"""The connections of a ZeroMQ socket: counted, reported, and at most MAX_CONNECTIONS at a time.

libzmq reports on a monitor socket and limits nothing: it accepts connections until the process runs out of file descriptors.
Connections over the limit are closed at once, the newest first, so that the established ones stay. libzmq itself closes a
peer that does not finish its handshake within HANDSHAKE_MS.
"""

from __future__ import annotations

import contextlib
import os
import socket
import struct
import time
from collections.abc import Iterator

import zmq

from hilstar.attitude.wire.flood_limits import PAUSE_S, LinkCounts
from hilstar.notices import Notices

MAX_CONNECTIONS = 64
MAX_EVENTS = 500  # in one go; more wait in the monitor, and then libzmq waits
FEW_EVENTS = 50
EVENT = struct.Struct("=Hi")  # of zmq_socket_monitor(3): event, value; pyzmq's parser of it would bring asyncio
HANDSHAKE_MS = 2000
FAILED = {
    zmq.EVENT_HANDSHAKE_FAILED_AUTH: "its key is not among those allowed",
    zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL: "it is another type of ZeroMQ socket, or it has no keys",
    zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL: f"it left, or did not finish its handshake within {HANDSHAKE_MS / 1000:g} s",
}
EVENTS = zmq.EVENT_ACCEPTED | zmq.EVENT_CONNECTED | zmq.EVENT_DISCONNECTED | zmq.EVENT_HANDSHAKE_SUCCEEDED | sum(FAILED)


class Doorkeeper:
    """Reads the monitor of one socket, made before it is bound or connected.

    `lost` says that a connection has ended; the code that acts on it resets it. `place` is the port or path that was bound.
    """

    def __init__(self, watched: zmq.Socket[bytes], *, bound: bool, counts: LinkCounts, notices: Notices) -> None:
        self.lost = False
        self.place: int | str = ""
        self._watched = watched
        self._bound = bound
        self._counts = counts
        self._notices = notices
        self._open: dict[int, str] = {}  # file descriptor: peer, in the order of arrival
        self._shut: set[int] = set()
        self._failure = ""
        self._monitor = watched.get_monitor_socket(EVENTS)

    @property
    def monitor(self) -> zmq.Socket[bytes]:
        """The socket to poll for events."""
        return self._monitor

    def tend(self) -> None:
        """Take the events so far."""
        events = 0
        with contextlib.suppress(zmq.ZMQError):
            while events < MAX_EVENTS:
                what, _peer_endpoint = self._monitor.recv_multipart(zmq.NOBLOCK)
                self._take(*EVENT.unpack(what))
                events += 1
        if self._bound and len(self._open) > MAX_CONNECTIONS:
            self._shut_newest()
        if events > FEW_EVENTS:
            time.sleep(PAUSE_S)

    def _take(self, event: int, value: int) -> None:
        if event == zmq.EVENT_ACCEPTED:
            self._counts.connections += 1
            self._open.pop(value, None)
            self._open[value] = _peer(value)
        elif event == zmq.EVENT_DISCONNECTED:
            self._leave(value)
        elif event == zmq.EVENT_HANDSHAKE_SUCCEEDED and not self._bound:
            self._arrive()
        elif event in FAILED:
            self._failure = FAILED[zmq.Event(event)]

    def _arrive(self) -> None:
        """A connecting socket's peer has answered, for the first time or again."""
        self._counts.connections += 1
        if self._counts.connections > 1:
            self._notices.tell("back", "reconnected to the sender")
        else:
            self._notices.mention("connected", "connected to the sender")

    def _leave(self, file: int) -> None:
        self.lost = True
        who, failure = self._open.pop(file, ""), self._failure
        self._failure = ""
        if file in self._shut:
            self._shut.remove(file)
        elif failure and self._bound:
            self._counts.rejected += 1
            self._notices.tell("client-rejected", f"a connection from {who or 'an unknown peer'} was rejected: {failure}")
        elif failure:
            self._counts.rejected += 1
            self._notices.tell(
                "link-rejected",
                "the other side rejected us: check its allowed_clients, and our curve_server_key",
            )
        elif not self._bound:
            self._counts.lost += 1
            self._notices.tell("lost", "lost the connection to the sender; waiting for it")

    def _shut_newest(self) -> None:
        newest = [file for file in list(self._open)[MAX_CONNECTIONS:] if file not in self._shut]
        if not newest:
            return
        if not self._shut:
            who = self._open[newest[0]] or "an unknown peer"
            self._notices.tell(
                "connections-refused", f"over {MAX_CONNECTIONS} connections at once; closing further ones, from {who}"
            )
        for file in newest:
            self._counts.refused += 1
            self._shut.add(file)
            with _connection(file) as connection:
                if connection is not None and self._is_ours(connection):
                    connection.shutdown(socket.SHUT_RDWR)

    def _is_ours(self, connection: socket.socket) -> bool:
        """The descriptor may belong to another file by now."""
        name = connection.getsockname()
        return bool((name[1] if isinstance(name, tuple) else name) == self.place)

    def close(self) -> None:
        """Stop watching; before its socket is closed."""
        self.tend()  # libzmq blocks on a full monitor, and would block for ever on a closed one
        with contextlib.suppress(zmq.ZMQError):
            self._watched.disable_monitor()
        self._monitor.close(linger=0)


@contextlib.contextmanager
def _connection(file: int) -> Iterator[socket.socket | None]:
    """libzmq's own connection for a moment, through a duplicate of its descriptor; None where it is gone."""
    try:
        connection = socket.socket(fileno=os.dup(file))
    except OSError:
        yield None
        return
    with connection, contextlib.suppress(OSError):
        yield connection


def _peer(file: int) -> str:
    with _connection(file) as connection:
        name = () if connection is None else connection.getpeername()
        return f"{name[0]}:{name[1]}" if isinstance(name, tuple) and len(name) > 1 else ""
    return ""
