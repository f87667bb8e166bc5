"""A star tracker's answers over ZeroMQ: python zmq_tracker.py tcp://127.0.0.1:5562 RATE_HZ COUNT

Each message is a packet of kind 5. It needs only pyzmq. The bench file of the other end has
[answers] with source = "zmq".
"""

from __future__ import annotations

import struct
import sys
import time
import zlib

import zmq

RATE_VALID, VALID, LOST_IN_SPACE, TRACKING, TOO_FEW_STARS, BLINDED = (1 << bit for bit in range(6))


def answer(
    sequence: int,
    t_ns: int,
    q_icrs_to_cam: tuple[float, ...],
    rate_cam_rad_s: tuple[float, ...] | None = None,
    flags: int = VALID | TRACKING,
    stars: int = 0,
) -> bytes:
    """The 68 bytes; `t_ns` is the tracker's clock at the middle of the exposure, q is (w, x, y,
    z), the rate (x, y, z).
    """
    flags |= 0 if rate_cam_rad_s is None else RATE_VALID
    body = struct.pack(
        "<BBHIq4d3fI",
        1,
        5,
        flags,
        sequence,
        t_ns,
        *q_icrs_to_cam,
        *(rate_cam_rad_s or (0, 0, 0)),
        stars,
    )
    return body + struct.pack("<I", zlib.crc32(body))


if __name__ == "__main__":
    endpoint, rate_hz, count = sys.argv[1], float(sys.argv[2]), int(sys.argv[3])
    with zmq.Context() as context, context.socket(zmq.PUB) as sender:
        sender.bind(endpoint)
        for sequence in range(count):
            # RA 0, Dec 0, roll 0
            sender.send(answer(sequence, time.monotonic_ns(), (0.5, 0.5, -0.5, 0.5), stars=12))
            time.sleep(1 / rate_hz)
    print(f"sent {count}")
