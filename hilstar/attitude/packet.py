"""The attitude packet, and its JSON form: bytes in, frozen events out, no I/O.

Laws:
1. Every message gives exactly one event: an `AttitudeSample` or a `Refusal`. Nothing raises.
2. A sample is finite, its quaternion unit to 1e-15; the sender's was unit to NORM_TOLERANCE.
3. A 64-byte message that does not start with "{" is accepted only if its CRC-32 is right.
4. `decode(encode(sample))` gives the sample back, bit for bit where its quaternion is already unit.

The layout is that of firmware_protocol/protocol.toml.
"""

from __future__ import annotations

import math
import struct
import zlib
from dataclasses import dataclass
from typing import Literal

import msgspec
import numpy as np

from hilstar.arrays import FloatArray

VERSION = 1
KIND_ATTITUDE = 1
FLAG_RATE_VALID = 1
FLAG_DISCONTINUITY = 2
BODY = struct.Struct("<BBHIq4d3f")
CRC = struct.Struct("<I")
PACKET_BYTES = BODY.size + CRC.size
LONGEST_JSON_BYTES = 4096
NORM_TOLERANCE = 1e-3
FASTEST_RAD_S = 1e6  # no bench turns so fast; beyond, a prediction would overflow
INT64 = range(-(2**63), 2**63)

Reason = Literal["crc", "norm", "nan", "time", "format"]
REASONS: tuple[Reason, ...] = ("crc", "norm", "nan", "time", "format")


@dataclass(frozen=True, slots=True)
class AttitudeSample:
    """Where the camera points at `t_ns` of the sender's clock; `rate_cam_rad_s` (3,) or None when unknown."""

    t_ns: int
    q_icrs_to_cam: FloatArray
    rate_cam_rad_s: FloatArray | None = None
    sequence: int = 0
    discontinuity: bool = False


@dataclass(frozen=True, slots=True)
class Refusal:
    """Why a message is not an attitude."""

    reason: Reason
    detail: str


class _JsonAttitude(msgspec.Struct):
    t_ns: int
    q: tuple[float, float, float, float]
    rate: tuple[float, float, float] | None = None
    sequence: int = 0
    discontinuity: bool = False


_json_decoder = msgspec.json.Decoder(_JsonAttitude)


def encode(sample: AttitudeSample) -> bytes:
    """The 64 bytes of a sample."""
    rate = sample.rate_cam_rad_s
    flags = (0 if rate is None else FLAG_RATE_VALID) | (FLAG_DISCONTINUITY if sample.discontinuity else 0)
    rates = (0.0, 0.0, 0.0) if rate is None else rate
    body = BODY.pack(VERSION, KIND_ATTITUDE, flags, sample.sequence % 2**32, sample.t_ns, *sample.q_icrs_to_cam, *rates)
    return body + CRC.pack(zlib.crc32(body))


def decode(message: bytes) -> AttitudeSample | Refusal:
    """One message of either form: 64 bytes, or a JSON object that starts with "{"."""
    if message[:1] == b"{" or message[:16].lstrip()[:1] == b"{":
        return _decode_json(message)
    if len(message) != PACKET_BYTES:
        return Refusal("format", f"{len(message)} bytes; an attitude is {PACKET_BYTES} bytes or a JSON object")
    if CRC.unpack_from(message, BODY.size)[0] != zlib.crc32(message[: BODY.size]):
        return Refusal("crc", "the CRC-32 does not fit the packet")
    version, kind, flags, sequence, t_ns, w, x, y, z, *rate = BODY.unpack_from(message)
    if (version, kind) != (VERSION, KIND_ATTITUDE):
        return Refusal("format", f"version {version}, kind {kind}; version {VERSION}, kind {KIND_ATTITUDE} is wanted")
    known_rate = tuple(rate) if flags & FLAG_RATE_VALID else None
    return checked_sample(t_ns, (w, x, y, z), known_rate, sequence, bool(flags & FLAG_DISCONTINUITY))


def checked_sample(
    t_ns: int,
    q: tuple[float, ...],
    rate: tuple[float, ...] | None,
    sequence: int = 0,
    discontinuity: bool = False,
) -> AttitudeSample | Refusal:
    """A sample from raw numbers, or why they are none: every road into hilstar passes here."""
    if not all(map(math.isfinite, (*q, *(rate or ())))):
        return Refusal("nan", "a quaternion or rate component is not finite")
    if rate is not None and math.hypot(*rate) > FASTEST_RAD_S:
        return Refusal("format", f"a rate of {math.hypot(*rate):.3g} rad/s; at most {FASTEST_RAD_S:g} is taken")
    norm = math.hypot(*q)
    if abs(norm - 1.0) > NORM_TOLERANCE:
        return Refusal("norm", f"the quaternion's norm is {norm:.6g}; 1 within {NORM_TOLERANCE:g} is wanted")
    if t_ns not in INT64:
        return Refusal("format", f"t_ns {t_ns} does not fit 64 bits")
    unit = np.array(q, dtype=np.float64) / norm
    return AttitudeSample(t_ns, unit, None if rate is None else np.array(rate, dtype=np.float64), sequence, discontinuity)


def _decode_json(message: bytes) -> AttitudeSample | Refusal:
    if len(message) > LONGEST_JSON_BYTES:
        return Refusal("format", f"{len(message)} bytes of JSON; at most {LONGEST_JSON_BYTES} are read")
    try:
        form = _json_decoder.decode(message)
    except (msgspec.MsgspecError, RecursionError, UnicodeDecodeError) as error:
        if b"NaN" in message or b"Infinity" in message:
            return Refusal("nan", "a number is NaN or Infinity")
        return Refusal("format", f'{error}; {{"t_ns":..., "q":[w,x,y,z], "rate":[x,y,z]}} is wanted')
    return checked_sample(form.t_ns, form.q, form.rate, form.sequence, form.discontinuity)
