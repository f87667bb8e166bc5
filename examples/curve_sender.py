"""Send attitudes to hilstar over an encrypted ZeroMQ connection: `python curve_sender.py
tcp://HOST:5560 KEYS [SECONDS]`.

KEYS is a directory with client.key_secret and server.key of `hilstar keys`. Needs pyzmq, and
nothing of hilstar.
Exit codes: 0 done; 1 hilstar did not let this sender in, or the command was wrong.
"""

from __future__ import annotations

import math
import struct
import sys
import time
import zlib
from pathlib import Path

import zmq
import zmq.auth

SENDS_HZ = 100
RATE_CAM_RAD_S = math.radians(0.5)  # about the boresight
FLAG_RATE_VALID = 1
WAIT_MS = 10_000


def attitude(t_ns: int, since_start_s: float, sequence: int) -> bytes:
    """The 64-byte packet of a steady turn about the boresight, from RA 0, Dec 0, roll 0."""
    half_rad = -0.5 * RATE_CAM_RAD_S * since_start_s  # q turns ICRS into camera components: minus
    w, z = math.cos(half_rad), math.sin(half_rad)
    # the turn times (0.5, 0.5, -0.5, 0.5)
    q = (0.5 * (w - z), 0.5 * (w + z), 0.5 * (z - w), 0.5 * (w + z))
    body = struct.pack(
        "<BBHIq4d3f", 1, 1, FLAG_RATE_VALID, sequence, t_ns, *q, 0.0, 0.0, RATE_CAM_RAD_S
    )
    return body + struct.pack("<I", zlib.crc32(body))


def open_socket(
    context: zmq.Context[zmq.Socket[bytes]], endpoint: str, keys: Path
) -> zmq.Socket[bytes] | None:
    """A PUB socket with a subscriber; None where hilstar is not there, or did not let this sender
    in.

    XPUB is a PUB that reads the subscriptions: what is sent before the first one is lost.
    """
    socket = context.socket(zmq.XPUB)
    socket.linger = 1000
    socket.curve_publickey, socket.curve_secretkey = zmq.auth.load_certificate(
        keys / "client.key_secret"
    )
    socket.curve_serverkey, _ = zmq.auth.load_certificate(keys / "server.key")
    socket.connect(endpoint)
    if socket.poll(WAIT_MS):
        return socket
    socket.close(linger=0)
    return None


def send(socket: zmq.Socket[bytes], seconds: float) -> int:
    """Send at a steady rate; how many packets left."""
    start_ns = time.monotonic_ns()
    count = round(seconds * SENDS_HZ)
    for sequence in range(count):
        due_s = sequence / SENDS_HZ
        time.sleep(max(0.0, due_s - (time.monotonic_ns() - start_ns) * 1e-9))
        t_ns = time.monotonic_ns()
        socket.send(attitude(t_ns, (t_ns - start_ns) * 1e-9, sequence))
    return count


def main(endpoint: str, keys: str, seconds: str = "10") -> int:
    """Send for so many seconds."""
    with zmq.Context() as context:
        socket = open_socket(context, endpoint, Path(keys))
        if socket is None:
            print(
                f"{endpoint}: nobody listens; start hilstar, and put client.key into its"
                " allowed_clients",
                file=sys.stderr,
            )
            return 1
        with socket:
            print(f"{send(socket, float(seconds))} attitudes sent")
    return 0


if __name__ == "__main__":
    if len(sys.argv) not in {3, 4}:
        sys.exit("write python curve_sender.py tcp://HOST:PORT KEYS [SECONDS]")
    sys.exit(main(*sys.argv[1:]))
