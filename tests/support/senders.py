"""The far end of the wire, without hilstar: packets by struct, and plain ZeroMQ sockets."""

from __future__ import annotations

import itertools
import os
import socket
import struct
import time
import zlib
from collections.abc import Iterator
from contextlib import contextmanager

import zmq

from hilstar.rotation import from_radec_roll_deg
from tests.support.waiting import repeating

ORION = tuple(from_radec_roll_deg(84.0, -1.0, 0.0))
LYRA = tuple(from_radec_roll_deg(283.0, 35.0, 30.0))


def packet(sequence: int, t_ns: int, q=(0.5, 0.5, -0.5, 0.5), rate=(0.0, 0.0, 0.0)) -> bytes:
    """An attitude as docs and firmware_protocol/protocol.toml lay it out."""
    body = struct.pack("<BBHIq4d3f", 1, 1, 1, sequence, t_ns, *q, *rate)
    return body + struct.pack("<I", zlib.crc32(body))


# Ports under those that the system gives to whoever asks for any; each process of tests begins elsewhere, so that workers, and
# another session on this machine, do not ask for the same one at the same time.
PORTS = range(20_000, 32_000)
_next = itertools.count(os.getpid() * 211)


def free_port() -> int:
    """A port of this machine that nobody has, and that no other test is given."""
    for number in _next:
        port = PORTS[number % len(PORTS)]
        with socket.socket() as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
            return port
    raise AssertionError("unreachable: the ports go round")


@contextmanager
def publisher() -> Iterator[tuple[zmq.Socket, int]]:
    """A plain PUB socket, bound; and its port."""
    context = zmq.Context()
    sender = context.socket(zmq.PUB)
    sender.setsockopt(zmq.LINGER, 1000)
    sender.setsockopt(zmq.SNDHWM, 100_000)
    port = free_port()
    sender.bind(f"tcp://127.0.0.1:{port}")
    try:
        yield sender, port
    finally:
        sender.close()
        context.term()


@contextmanager
def connected(port: int, kind: int = zmq.PUB, patience_s: float = 5.0) -> Iterator[zmq.Socket]:
    """A plain socket of that kind, connected."""
    context = zmq.Context()
    end = context.socket(kind)
    end.setsockopt(zmq.LINGER, 0)
    end.setsockopt(zmq.RCVTIMEO, round(patience_s * 1000))
    end.connect(f"tcp://127.0.0.1:{port}")
    try:
        yield end
    finally:
        end.close()
        context.term()


@contextmanager
def talking(sender: zmq.Socket, rate_hz: float = 200.0, q=ORION, first: int = 0) -> Iterator[None]:
    """A sender of this process, stamped with its monotonic clock, that talks all the while."""
    sequences = itertools.count(first)
    with repeating(lambda: sender.send(packet(next(sequences), time.monotonic_ns(), q)), 1 / rate_hz):
        yield
