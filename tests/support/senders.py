"""The far end of the wire, without hilstar: packets by struct, and plain ZeroMQ sockets."""

from __future__ import annotations

import itertools
import json
import os
import socket
import struct
import time
import zlib
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import zmq
import zmq.auth

from hilstar.basics.rotation import from_radec_roll_deg
from tests.support.waiting import PATIENCE_S, repeating

ORION = tuple(from_radec_roll_deg(84.0, -1.0, 0.0))
LYRA = tuple(from_radec_roll_deg(283.0, 35.0, 30.0))


def packet(sequence: int, t_ns: int, q=(0.5, 0.5, -0.5, 0.5), rate=(0.0, 0.0, 0.0)) -> bytes:
    """An attitude as docs and firmware_protocol/protocol.toml lay it out; a rate of None is
    none.
    """
    body = struct.pack(
        "<BBHIq4d3f", 1, 1, rate is not None, sequence, t_ns, *q, *(rate or (0.0, 0.0, 0.0))
    )
    return body + struct.pack("<I", zlib.crc32(body))


def send_attitudes(sender, attitudes, hz: float) -> None:
    """Attitudes one after the other, each a quaternion and its rate, JSON where that is None."""
    start_ns = time.monotonic_ns()
    for k, (q, rate) in enumerate(attitudes):
        due_ns = start_ns + round(k * 1e9 / hz)
        time.sleep(max(0.0, (due_ns - time.monotonic_ns()) / 1e9))
        if rate is None:
            sender.send(json.dumps({"t_ns": due_ns, "q": q, "sequence": k}).encode())
        else:
            sender.send(packet(k, due_ns, q, rate))


# Ports under those that the system gives to whoever asks for any; each process of tests begins
# elsewhere.
PORTS = range(20_000, 32_000)
MAX_HELD = 128  # of the newest ports: no test has so many, and a process may open 1024 files
_next = itertools.count(os.getpid() * 211)
_held: deque[socket.socket] = deque()


def free_port() -> int:
    """A port of this machine that nobody has, over TCP or UDP, and that no other test is given, of
    whatever process.

    Between this and the moment it is bound, a name of its own in the kernel (it goes with this
    process) keeps it from others.
    """
    for number in _next:
        port = PORTS[number % len(PORTS)]
        name = socket.socket(socket.AF_UNIX)
        try:
            name.bind(f"\0hilstar-test-port-{port}")
            for kind in (socket.SOCK_STREAM, socket.SOCK_DGRAM):
                with socket.socket(socket.AF_INET, kind) as probe:
                    probe.bind(("127.0.0.1", port))
        except OSError:
            name.close()
            continue
        _held.append(name)
        # A socket that is dropped unclosed is a warning, and a warning fails whichever test runs
        # then.
        if len(_held) > MAX_HELD:
            _held.popleft().close()
        return port
    raise AssertionError("unreachable: the ports go round")


_publishers: dict[int, zmq.Socket] = {}


@contextmanager
def publisher() -> Iterator[tuple[zmq.Socket, int]]:
    """A plain publishing socket, bound, which is told of its subscribers (an XPUB is a PUB that
    says so); and its port.
    """
    context = zmq.Context()
    sender = publishing(context)
    sender.setsockopt(zmq.LINGER, 1000)
    port = free_port()
    sender.bind(f"tcp://127.0.0.1:{port}")
    _publishers[port] = sender
    try:
        yield sender, port
    finally:
        del _publishers[port]
        sender.close()
        context.term()


def publishing(context: zmq.Context) -> zmq.Socket:
    """An XPUB socket that drops nothing for want of room, and says each subscription."""
    sender = context.socket(zmq.XPUB)
    sender.setsockopt(zmq.XPUB_VERBOSE, 1)
    sender.setsockopt(zmq.SNDHWM, 100_000)
    return sender


def await_subscriber(sender: zmq.Socket) -> None:
    """Wait for the next subscription at a publishing socket: from then on no packet is lost."""
    while True:
        assert sender.poll(PATIENCE_S * 1000), "nobody subscribes"
        if sender.recv()[:1] == b"\1":  # and not one that ends
            return


def await_subscriber_of(port: int) -> None:
    """Wait for a subscription at the publisher that is bound to a port; nothing is waited for
    where there is none.
    """
    if port in _publishers:
        await_subscriber(_publishers[port])


@contextmanager
def connected(
    port: int,
    kind: int = zmq.PUB,
    patience_s: float = PATIENCE_S,
    keys: tuple[Path, Path] | None = None,
) -> Iterator[zmq.Socket]:
    """A plain socket of that kind, connected; `keys` are two folders of `hilstar keys`, its own
    and the server's.
    """
    context = zmq.Context()
    end = context.socket(kind)
    end.setsockopt(zmq.LINGER, 0)
    end.setsockopt(zmq.RCVTIMEO, round(patience_s * 1000))
    if keys is not None:
        own, server = keys
        secret = zmq.auth.load_certificate(own / "client.key_secret")
        end.curve_publickey, end.curve_secretkey = secret
        end.curve_serverkey, _ = zmq.auth.load_certificate(server / "server.key")
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
    with repeating(
        lambda: sender.send(packet(next(sequences), time.monotonic_ns(), q)), 1 / rate_hz
    ):
        yield


ANSWER_S = 0.05  # from one answer to the next


@contextmanager
def answers_over_udp(port: int, answers: Iterator[bytes]) -> Iterator[None]:
    """A tracker that sends one of `answers` each ANSWER_S to a port of this machine."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as line:

        def send() -> None:
            with suppress(OSError):  # nobody hears it yet
                line.sendto(next(answers), ("127.0.0.1", port))

        with repeating(send, ANSWER_S):
            yield
