"""The test vectors: packets and frames that every implementation must read and write alike, and
some that it must refuse.

Each is an object: `name`, `kind`, `fields` (what the sender chooses; numbers exact, "nan" for a
NaN), `packet_hex` and `frame_hex`; or `name`, `packet_hex` (null: the frame contains none),
`frame_hex` and `refused`, the reason. One refused for its time has `after`: the name of the vector
that precedes it.
"""

from __future__ import annotations

import math
import struct
import zlib
from typing import Any, NamedTuple

from definition import Packet

I64_MIN, I64_MAX = -(2**63), 2**63 - 1
U32_MAX = 2**32 - 1
NAN, INF = math.nan, math.inf
TINY64 = 5e-324
TINY32 = 2.0**-149
STILL = (0.0, 0.0, 0.0)
Q = (0.5, 0.5, -0.5, 0.5)  # RA 0, Dec 0, roll 0
NEGATED_Q = (-0.5, -0.5, 0.5, -0.5)


class Attitude(NamedTuple):
    """What the sender of an attitude chooses."""

    flags: int
    sequence: int
    t_ns: int
    q_icrs_to_cam: tuple[float, ...]
    rate_cam_rad_s: tuple[float, ...]


ATTITUDES: dict[str, Attitude] = {
    "attitude: RA 0, Dec 0, roll 0, turning about the boresight": Attitude(
        1, 1, 1_000_000_000, Q, (0.0, 0.0, 0.125)
    ),
    "attitude: no rate": Attitude(0, 2, 1_010_000_000, Q, STILL),
    "attitude: the other sign of the quaternion is the same attitude": Attitude(
        1, 3, 1_020_000_000, NEGATED_Q, STILL
    ),
    "attitude: the first after a jump": Attitude(
        3, 4, 1_030_000_000, (0.6, 0.0, 0.8, 0.0), (0.25, -0.5, 1.0)
    ),
    "attitude: all zero bytes but the scalar": Attitude(0, 0, 0, (1.0, 0.0, 0.0, 0.0), STILL),
    "attitude: no zero byte in sequence and time": Attitude(
        1, 0x01020304, 0x0102030405060708, Q, (1.1, -2.2, 3.3)
    ),
    "attitude: the earliest time": Attitude(1, 5, I64_MIN, Q, STILL),
    "attitude: the latest time": Attitude(1, 6, I64_MAX, Q, STILL),
    "attitude: one nanosecond before zero": Attitude(1, 7, -1, Q, STILL),
    "attitude: the last sequence before it wraps": Attitude(1, U32_MAX, 8, Q, STILL),
    "attitude: the sequence wrapped": Attitude(1, 0, 9, Q, STILL),
    "attitude: all flags, known and unknown": Attitude(0xFFFF, 10, 10, Q, STILL),
    "attitude: of sender 7, with its rate": Attitude(0x0701, 17, 17, Q, (0.0, 0.0, 0.125)),
    "attitude: of sender 254, after a jump": Attitude(0xFE02, 18, 18, Q, STILL),
    "attitude: negative zeros": Attitude(1, 11, 11, (1.0, -0.0, 0.0, -0.0), (-0.0, 0.0, -0.0)),
    "attitude: subnormals": Attitude(
        1, 12, 12, (1.0, TINY64, -TINY64, 2.0**-1023), (TINY32, -TINY32, 2.0**-127)
    ),
    "attitude: a rate that is not valid is not looked at": Attitude(0, 13, 13, Q, (NAN, NAN, NAN)),
    "attitude: the fastest rate": Attitude(1, 14, 14, Q, (1e6, 0.0, 0.0)),
    "attitude: a norm of 1.0009 is taken, and mended": Attitude(
        1, 15, 15, (1.0009, 0.0, 0.0, 0.0), STILL
    ),
    "attitude: a norm of 0.9991 is taken, and mended": Attitude(
        1, 16, 16, (0.0, 0.0, 0.9991, 0.0), STILL
    ),
}
# The reason for which hilstar refuses it, and the attitude.
REFUSED_ATTITUDES: dict[str, tuple[str, Attitude]] = {
    "refused: NaN in the quaternion": ("nan", Attitude(1, 1, 1, (NAN, 0.0, 0.0, 1.0), STILL)),
    "refused: infinity in the quaternion": ("nan", Attitude(1, 1, 1, (0.0, INF, 0.0, 0.0), STILL)),
    "refused: minus infinity in the quaternion": (
        "nan",
        Attitude(1, 1, 1, (0.0, 0.0, 0.0, -INF), STILL),
    ),
    "refused: NaN in a valid rate": ("nan", Attitude(1, 1, 1, Q, (0.0, NAN, 0.0))),
    "refused: a norm of 1.1": ("norm", Attitude(1, 1, 1, (1.1, 0.0, 0.0, 0.0), STILL)),
    "refused: a norm of 1.0011": ("norm", Attitude(1, 1, 1, (0.0, 1.0011, 0.0, 0.0), STILL)),
    "refused: a norm of 0.9989": ("norm", Attitude(1, 1, 1, (0.0, 0.0, 0.9989, 0.0), STILL)),
    "refused: a norm of 0": ("norm", Attitude(1, 1, 1, (0.0, 0.0, 0.0, 0.0), STILL)),
    "refused: a norm too large to square": (
        "norm",
        Attitude(1, 1, 1, (1e200, 0.0, 0.0, 0.0), STILL),
    ),
    "refused: a rate of 2e6 rad/s": ("format", Attitude(1, 1, 1, Q, (0.0, 0.0, -2e6))),
}
OTHERS: dict[str, tuple[str, dict[str, Any]]] = {
    "time_request: ordinary": ("time_request", {"sequence": 1, "t1_ns": 2_000_000_000}),
    "time_request: all zeros": ("time_request", {"sequence": 0, "t1_ns": 0}),
    "time_request: extremes": ("time_request", {"sequence": U32_MAX, "t1_ns": I64_MIN}),
    "time_reply: ordinary": (
        "time_reply",
        {"sequence": 1, "t1_ns": 2_000_000_000, "t2_ns": 5_000_100_000, "t3_ns": 5_000_130_000},
    ),
    "time_reply: all zeros": ("time_reply", {"sequence": 0, "t1_ns": 0, "t2_ns": 0, "t3_ns": 0}),
    "time_reply: extremes": (
        "time_reply",
        {"sequence": U32_MAX, "t1_ns": I64_MAX, "t2_ns": I64_MIN, "t3_ns": -1},
    ),
    "status: ordinary": (
        "status",
        dict(
            zip(
                ("health", "frame", "light_t_ns", "attitude_age_ns"),
                (8, 600, 10_000_000_000, 12_500_000),
                strict=True,
            )
        )
        | {"attitude_sequence": 998, "accepted": 999, "refused": 1},
    ),
    "status: before any attitude": (
        "status",
        {
            "health": 5,
            "frame": 0,
            "light_t_ns": 0,
            "attitude_age_ns": -1,
            "attitude_sequence": 0,
            "accepted": 0,
            "refused": 0,
        },
    ),
    "answer: tracking on 12 stars": (
        "answer",
        {
            "flags": 11,
            "sequence": 1,
            "t_ns": 3_000_000_000,
            "q_icrs_to_cam": Q,
            "rate_cam_rad_s": (0.0, 0.0, 0.125),
            "stars": 12,
        },
    ),
    "answer: lost in space, blinded, no attitude": (
        "answer",
        {
            "flags": 36,
            "sequence": U32_MAX,
            "t_ns": -1,
            "q_icrs_to_cam": (0.0,) * 4,
            "rate_cam_rad_s": STILL,
            "stars": 0,
        },
    ),
    "answer: extremes, all flags": (
        "answer",
        {
            "flags": 0xFFFF,
            "sequence": 0,
            "t_ns": I64_MIN,
            "q_icrs_to_cam": NEGATED_Q,
            "rate_cam_rad_s": (TINY32, -1e6, -0.0),
        }
        | {"stars": U32_MAX},
    ),
    "status: extremes, all health bits": (
        "status",
        dict(
            zip(
                ("health", "frame", "light_t_ns", "attitude_age_ns"),
                (0xFFFF, U32_MAX, I64_MIN, I64_MAX),
                strict=True,
            )
        )
        | {"attitude_sequence": U32_MAX, "accepted": U32_MAX, "refused": U32_MAX},
    ),
}


def cobs(message: bytes) -> bytes:
    """Consistent overhead byte stuffing (Cheshire and Baker 1999) of fewer than 254 bytes."""
    if len(message) >= 254:
        raise ValueError("254 bytes and more need a second count")
    return b"".join(bytes([len(run) + 1]) + run for run in message.split(b"\0"))


def frame(packet: bytes) -> bytes:
    """A packet as it goes over a serial line."""
    return cobs(packet) + b"\0"


def sealed(body: bytes) -> bytes:
    """A packet's bytes with their CRC-32 after them."""
    return body + struct.pack("<I", zlib.crc32(body))


def packed(packet: Packet, values: dict[str, Any]) -> bytes:
    """The bytes of a packet whose sender chose `values`."""
    numbers: list[float] = []
    for f in packet.fields:
        if not f.crc:
            value = f.value if f.value is not None else values[f.name]
            numbers += value if isinstance(value, (tuple, list)) else [value]
    return sealed(struct.pack(packet.body, *numbers))


def vectors(packets: dict[str, Packet]) -> list[dict[str, Any]]:
    """All of them, in order."""
    good = [
        _accepted(packets["attitude"], name, values._asdict()) for name, values in ATTITUDES.items()
    ]
    good += [_accepted(packets[kind], name, values) for name, (kind, values) in OTHERS.items()]
    bad = [
        _refused(name, packed(packets["attitude"], values._asdict()), reason)
        for name, (reason, values) in REFUSED_ATTITUDES.items()
    ]
    first = bytes.fromhex(good[0]["packet_hex"])
    late = _refused("refused: a time that does not rise", first, "time") | {
        "after": good[1]["name"]
    }
    return [*good, *bad, *_damaged(first, packets), late]


def _accepted(packet: Packet, name: str, values: dict[str, Any]) -> dict[str, Any]:
    whole = packed(packet, values)
    fields = {f.name: _exact(f.type, values[f.name]) for f in packet.variable}
    return {
        "name": name,
        "kind": packet.kind,
        "fields": fields,
        "packet_hex": whole.hex(),
        "frame_hex": frame(whole).hex(),
    }


def _exact(form: str, value: Any) -> Any:
    """A value rounded as in the packet, so that the numbers in the JSON are exact."""
    if isinstance(value, tuple):
        return [_exact(form, item) for item in value]
    if form == "f32":
        (value,) = struct.unpack("<f", struct.pack("<f", value))
    return "nan" if isinstance(value, float) and math.isnan(value) else value


def _refused(
    name: str, packet: bytes | None, reason: str, framed: bytes | None = None
) -> dict[str, Any]:
    wire = framed if framed is not None else frame(packet or b"")
    return {
        "name": name,
        "packet_hex": None if packet is None else packet.hex(),
        "frame_hex": wire.hex(),
        "refused": reason,
    }


def _damaged(whole: bytes, packets: dict[str, Packet]) -> list[dict[str, Any]]:
    """What a noisy line or a faulty program makes of `whole`, an attitude."""
    body = whole[:-4]
    request = packed(packets["time_request"], {"sequence": 1, "t1_ns": 1})
    return [
        _refused(
            "refused: a bit of the time is wrong",
            body[:8] + bytes([body[8] ^ 1]) + whole[9:],
            "crc",
        ),
        _refused(
            "refused: a bit of the CRC is wrong", whole[:-1] + bytes([whole[-1] ^ 0x80]), "crc"
        ),
        _refused("refused: the CRC has the other byte order", body + whole[:-5:-1], "crc"),
        _refused(
            "refused: a time_request with a wrong CRC",
            request[:-1] + bytes([request[-1] ^ 1]),
            "crc",
        ),
        _refused("refused: 64 bytes of zeros", bytes(64), "crc"),
        _refused("refused: version 2", sealed(b"\x02" + body[1:]), "format"),
        _refused("refused: kind 0", sealed(b"\x01\x00" + body[2:]), "format"),
        _refused("refused: kind 6", sealed(b"\x01\x06" + body[2:]), "format"),
        _refused(
            "refused: the length of an attitude, the kind of an answer",
            sealed(b"\x01\x05" + body[2:]),
            "format",
        ),
        _refused(
            "refused: the length of an attitude, the kind of a status",
            sealed(b"\x01\x04" + body[2:]),
            "format",
        ),
        _refused("refused: a byte is missing", whole[:-1], "format"),
        _refused("refused: a byte too many", whole + b"\x07", "format"),
        _refused("refused: a byte too many, CRC made anew", sealed(body + b"\x07"), "format"),
        _refused(
            "refused: a time_request cut short, CRC made anew", sealed(request[:12]), "format"
        ),
        _refused("refused: version and kind alone", whole[:2], "format"),
        _refused("refused: one byte", whole[:1], "format"),
        _refused("refused: empty", b"", "format"),
        _refused(
            "refused: a count that points beyond the frame", None, "format", b"\x05\x01\x01\x00"
        ),
        _refused(
            "refused: the last byte before the 0x00 is missing",
            None,
            "format",
            frame(whole)[:-2] + b"\x00",
        ),
    ]
