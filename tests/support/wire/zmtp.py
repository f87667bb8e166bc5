"""ZeroMQ's wire protocol (ZMTP 3.0, no keys) by hand: what no ZeroMQ library would send."""

from __future__ import annotations

import contextlib
import socket
import struct

from tests.support.waiting import PATIENCE_S

SILENT_S = 5.0  # the other side may say nothing
GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x00" + b"NULL".ljust(20, b"\0") + bytes(32)


def greeted(port: int, kind: bytes = b"PUB") -> socket.socket:
    """A connection that has said hello as a socket of that kind."""
    connection = socket.create_connection(("127.0.0.1", port))
    try:
        _greet(connection, kind)
    except OSError:
        connection.close()
        raise
    connection.settimeout(PATIENCE_S)
    return connection


def _greet(connection: socket.socket, kind: bytes) -> None:
    ready = b"\x05READY" + b"\x0bSocket-Type" + struct.pack(">I", len(kind)) + kind
    connection.sendall(GREETING + b"\x04" + bytes([len(ready)]) + ready)
    # a message before the other's READY is against the protocol
    with contextlib.suppress(TimeoutError):
        connection.settimeout(SILENT_S)
        said = b""
        while len(said) < 66 or len(said) < 66 + said[65]:
            said += connection.recv(1024) or b"closed" * 100


def part(body: bytes, *, more: bool) -> bytes:
    """One part of a message."""
    if len(body) < 256:
        return bytes([more, len(body)]) + body
    return bytes([2 + more]) + struct.pack(">Q", len(body)) + body
