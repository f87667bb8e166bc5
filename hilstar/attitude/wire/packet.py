"""The packets of the wire, the attitude's JSON form, and COBS frames on a serial line: bytes in,
frozen events out, no I/O.

Laws of a message:
1. Every message gives exactly one event: a packet or a `Refusal`. Nothing raises.
2. A sample is finite, and its quaternion is unit to 1e-15; the sender's was unit to NORM_TOLERANCE.
3. A message that does not start with "{" is accepted only if its CRC-32 is correct.
4. `decode(encode(packet))` returns the packet, bit for bit where the quaternion is already unit.

Laws of the byte stream, whose frames are each followed by 0x00:
1. However the bytes are cut into chunks, the events are the same.
2. A frame is accepted only if `decode` accepts its content, so never with a wrong CRC-32.
3. Whatever came before, the next complete frame after a 0x00 is decoded.
4. At most MAX_KEPT_BYTES are kept between chunks: a sender that never sends 0x00 costs one refusal
   for each stretch
   of garbage, and no memory.
5. The bytes before the stream's first 0x00 may be the end of a frame: they count only if they are a
   complete one, or too many
   for any.
6. Passing over a frame undecoded loses nothing of the next.

The layout is that of firmware_protocol/protocol.toml.
"""

from __future__ import annotations  # docs/python-api.md shows annotations as they are written

import math
import struct
import zlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import msgspec
from cobs import cobs

from hilstar.attitude.wire import protocol
from hilstar.attitude.wire.likeness import (
    Likeness,
    frame_likeness,
    likeness,
    numbers_likeness,
    packet_likeness,
)
from hilstar.attitude.wire.protocol import FASTEST_RAD_S, NORM_TOLERANCE, VERSION

if TYPE_CHECKING:
    from hilstar.basics.arrays import FloatArray

CRC = struct.Struct("<I")
ATTITUDE_HEAD = bytes([VERSION, protocol.KIND_ATTITUDE])
MAX_JSON_BYTES = 4096
INT64 = range(-(2**63), 2**63)
U32 = 2**32
MESSAGE_FORM = f"send an attitude of {protocol.ATTITUDE_BYTES} bytes or a JSON object"
FRAME_FORM = (
    f"send attitudes of {protocol.ATTITUDE_BYTES} bytes as COBS frames, each followed by 0x00"
)
JSON_FORM = '{"t_ns":..., "q":[w,x,y,z], "rate":[x,y,z]}'
# the number of a sender that sets every flag; in JSON it says as little
UNSTATED_SENDER = 255
UNIT = 1e-15  # this close, dividing by the norm would only move the last bit

Reason = Literal["crc", "norm", "nan", "time", "format", "rate", "source"]
# Reasons in the message itself, listed in the summary even where their count is 0; and in the
# stream, listed where they occur.
MESSAGE_REASONS: tuple[Reason, ...] = ("crc", "norm", "nan", "time", "format")
STREAM_REASONS: tuple[Reason, ...] = ("rate", "source")
REASONS = MESSAGE_REASONS + STREAM_REASONS
# distance from the Earth's centre: the limits of an orbit file, too
MIN_PLACE_KM, MAX_PLACE_KM = 6000.0, 1e7
RATE_ROUNDING = 1e-6  # a packet's rate is float32
DELIMITER = b"\x00"
# COBS adds one byte to anything shorter than 254. Only packets are framed: JSON goes over ZeroMQ.
MAX_FRAME_BYTES = max(protocol.PACKET_BYTES.values()) + 1
# of bytes without a 0x00: enough to hold a whole frame wherever they begin
MAX_KEPT_BYTES = 2 * MAX_FRAME_BYTES
FLAGS_AT = 3  # in an attitude's frame, behind the COBS byte, version and kind, of which none is 0


@dataclass(frozen=True, slots=True)
class AttitudeSample:
    """Where the camera points at `t_ns` of the sender's clock; `rate_cam_rad_s` (3,) or None when
    unknown.

    `acceleration_cam_rad_s2` (3,) is that of the rate, for sources without noise; `velocity_km_s`
    (3,), ICRS, the observer's with respect to the origin of the sender's frame, and `place_km` (3,)
    its place, about the Earth's centre both where there is one. Each is None where nobody says.
    `sender` is the sender's number, 1 to 254; 0 where it is not given.
    """

    t_ns: int
    q_icrs_to_cam: FloatArray
    rate_cam_rad_s: FloatArray | None = None
    sequence: int = 0
    discontinuity: bool = False
    acceleration_cam_rad_s2: FloatArray | None = None
    velocity_km_s: FloatArray | None = None
    place_km: FloatArray | None = None
    sender: int = 0


@dataclass(frozen=True, slots=True)
class Refusal:
    """Why a message is not used as an attitude.

    `telling`: the bytes show what was sent in an attitude's place, and `detail` says it with what
    to send.
    `unset`: its quaternion is zeros or NaN, as an estimator that has not run yet leaves it.
    """

    reason: Reason
    detail: str
    telling: bool = False
    unset: bool = False


@dataclass(frozen=True, slots=True)
class TimeRequest:
    """One side asks for the other's time; `t1_ns` is the asker's clock when the request left."""

    sequence: int
    t1_ns: int


@dataclass(frozen=True, slots=True)
class TimeReply:
    """The answer: `t2_ns` when the request arrived, `t3_ns` when the reply left, both on the
    answerer's clock.
    """

    sequence: int
    t1_ns: int
    t2_ns: int
    t3_ns: int


@dataclass(frozen=True, slots=True)
class Status:
    """What goes back to the sender: the last frame shown, when its light leaves the screen
    (sender's clock), and health.

    `health` is the sum of protocol.HEALTH_ bits; `attitude_age_ns` is -1 while there is no
    attitude.
    """

    health: int
    frame: int
    light_t_ns: int
    attitude_age_ns: int
    attitude_sequence: int
    accepted: int
    refused: int


@dataclass(frozen=True, slots=True)
class AnswerPacket:
    """What a star tracker found, as it is on the wire; `flags` is the sum of protocol.ANSWER_
    bits.
    """

    sequence: int
    flags: int
    t_ns: int
    q_icrs_to_cam: tuple[float, ...]
    rate_cam_rad_s: tuple[float, ...] = (0.0, 0.0, 0.0)
    stars: int = 0


Packet = AttitudeSample | TimeRequest | TimeReply | Status | AnswerPacket
Event = Packet | Refusal


class _JsonAttitude(msgspec.Struct):
    t_ns: int
    q: tuple[float, float, float, float]
    rate: tuple[float, float, float] | None = None
    sequence: int = 0
    discontinuity: bool = False
    sender: int = 0


_json_decoder = msgspec.json.Decoder(_JsonAttitude)


def encode(packet: Packet) -> bytes:
    """The bytes of a packet; counters wrap at 2^32, and a status's times are clamped to 64 bits."""
    match packet:
        case AttitudeSample(rate_cam_rad_s=rate):
            flags = packet.sender << protocol.SENDER_FIRST_BIT
            if packet.discontinuity:
                flags |= protocol.FLAG_DISCONTINUITY
            rate_numbers = [0.0, 0.0, 0.0]
            if rate is not None:
                flags |= protocol.FLAG_RATE_VALID
                rate_numbers = list(rate)
            head = (VERSION, protocol.KIND_ATTITUDE, flags, packet.sequence % U32, packet.t_ns)
            body = protocol.ATTITUDE_BODY.pack(*head, *packet.q_icrs_to_cam, *rate_numbers)
        case TimeRequest(sequence, t1_ns):
            body = protocol.TIME_REQUEST_BODY.pack(
                VERSION, protocol.KIND_TIME_REQUEST, 0, sequence % U32, t1_ns
            )
        case TimeReply(sequence):
            times = (packet.t1_ns, packet.t2_ns, packet.t3_ns)
            body = protocol.TIME_REPLY_BODY.pack(
                VERSION, protocol.KIND_TIME_REPLY, 0, sequence % U32, *times
            )
        case Status():
            counts = (packet.attitude_sequence % U32, packet.accepted % U32, packet.refused % U32)
            held = (
                min(max(t_ns, INT64[0]), INT64[-1])
                for t_ns in (packet.light_t_ns, packet.attitude_age_ns)
            )
            body = protocol.STATUS_BODY.pack(
                VERSION, protocol.KIND_STATUS, packet.health, packet.frame % U32, *held, *counts
            )
        case AnswerPacket():
            head = (VERSION, protocol.KIND_ANSWER, packet.flags, packet.sequence % U32, packet.t_ns)
            body = protocol.ANSWER_BODY.pack(
                *head, *packet.q_icrs_to_cam, *packet.rate_cam_rad_s, packet.stars
            )
    return body + CRC.pack(zlib.crc32(body))


def decode(message: bytes) -> Event:
    """Decode one message: a packet's bytes, or an attitude as a JSON object."""
    if message[:1] == b"{" or message[:16].lstrip()[:1] == b"{":
        return decode_json(message)
    return _decode_packet(message, MESSAGE_FORM)


def _decode_packet(message: bytes, form: str) -> Event:
    """Decode a packet's bytes; `form` is what is expected on its road."""
    if len(message) > 1:
        head = (message[0], message[1])
    else:
        head = (-1, -1)
    if head[0] == VERSION:
        size = protocol.PACKET_BYTES.get(head[1])
    else:
        size = None
    if len(message) not in {size, protocol.ATTITUDE_BYTES}:
        return named_refusal("format", f"{len(message)} bytes", likeness(message), form)
    if CRC.unpack_from(message, len(message) - CRC.size)[0] != zlib.crc32(message[: -CRC.size]):
        detail = "the CRC-32 does not match the packet"
        likely = packet_likeness(message)
        if likely is None:
            return Refusal("crc", detail)
        return named_refusal("crc", detail, likely, form)
    if len(message) != size:
        return Refusal(
            "format", f"version {head[0]}, kind {head[1]}; send version {VERSION}, kind 1"
        )
    return _decode_body(head[1], message)


def named_refusal(reason: Reason, detail: str, found: Likeness, form: str) -> Refusal:
    """The refusal of a message that looks like something else."""
    return Refusal(reason, f"{detail}: {found.what}; {found.instead or form}", telling=True)


def declares_discontinuity(message: bytes) -> bool:
    """Whether a message is an attitude that must not be interpolated to; quick where it is not."""
    if message[:2] == ATTITUDE_HEAD:
        if (
            len(message) != protocol.ATTITUDE_BYTES
            or not message[len(ATTITUDE_HEAD)] & protocol.FLAG_DISCONTINUITY
        ):
            return False
    elif b"discontinuity" not in message[:MAX_JSON_BYTES]:
        return False
    event = decode(message)
    return isinstance(event, AttitudeSample) and event.discontinuity


def _decode_body(kind: int, message: bytes) -> Event:
    if kind == protocol.KIND_TIME_REQUEST:
        return TimeRequest(*protocol.TIME_REQUEST_BODY.unpack_from(message)[3:])
    if kind == protocol.KIND_TIME_REPLY:
        return TimeReply(*protocol.TIME_REPLY_BODY.unpack_from(message)[3:])
    if kind == protocol.KIND_STATUS:
        return Status(*protocol.STATUS_BODY.unpack_from(message)[2:])
    if kind == protocol.KIND_ANSWER:
        _, _, flags, sequence, t_ns, *numbers = protocol.ANSWER_BODY.unpack_from(message)
        return AnswerPacket(
            sequence, flags, t_ns, tuple(numbers[:4]), tuple(numbers[4:7]), numbers[7]
        )
    _, _, flags, sequence, t_ns, w, x, y, z, *rate = protocol.ATTITUDE_BODY.unpack_from(message)
    if flags & protocol.FLAG_RATE_VALID:
        known_rate = tuple(rate)
    else:
        known_rate = None
    discontinuity = bool(flags & protocol.FLAG_DISCONTINUITY)
    number = flags >> protocol.SENDER_FIRST_BIT
    sender = 0 if number == UNSTATED_SENDER else number
    event = checked_sample(t_ns, (w, x, y, z), known_rate, sequence, discontinuity, sender)
    if isinstance(event, Refusal):
        likely = numbers_likeness(message)
        if likely is not None:
            return named_refusal(event.reason, event.detail, likely, MESSAGE_FORM)
    return event


def is_unset(q: tuple[float, ...]) -> bool:
    """Whether a quaternion is zeros or NaN, which an estimator that has not run yet leaves."""
    return not any(q) or any(map(math.isnan, q))


def checked_sample(
    t_ns: int,
    q: tuple[float, ...],
    rate: tuple[float, ...] | None,
    sequence: int = 0,
    discontinuity: bool = False,
    sender: int = 0,
) -> AttitudeSample | Refusal:
    """A sample from raw numbers, or why they are not one: every source of attitudes passes
    through here.
    """
    import numpy as np  # 70 ms; a process that only stamps packets never comes here

    if not all(map(math.isfinite, (*q, *(rate or ())))):
        return Refusal("nan", "a quaternion or rate component is not finite", unset=is_unset(q))
    if rate is not None and math.hypot(*rate) > FASTEST_RAD_S:
        return Refusal(
            "format", f"a rate of {math.hypot(*rate):.3g} rad/s; the maximum is {FASTEST_RAD_S:g}"
        )
    norm = math.hypot(*q)
    if abs(norm - 1.0) > NORM_TOLERANCE:
        return Refusal(
            "norm",
            f"the quaternion's norm is {norm:.6g}; it must be 1 within {NORM_TOLERANCE:g}",
            unset=is_unset(q),
        )
    if t_ns not in INT64:
        return Refusal("format", f"t_ns {t_ns} does not fit 64 bits")
    if not 0 <= sender <= protocol.MAX_SENDER:
        return Refusal("format", f"sender {sender}; write 1 to {protocol.MAX_SENDER}, or 0")
    unit = np.array(q, dtype=np.float64)
    if abs(norm - 1.0) > UNIT:
        unit /= norm
    rate_cam_rad_s = None if rate is None else np.array(rate, dtype=np.float64)
    return AttitudeSample(t_ns, unit, rate_cam_rad_s, sequence, discontinuity, sender=sender)


def rate_refusal(sample: AttitudeSample, max_rate_rad_s: float) -> Refusal | None:
    """Why a sample's rate is over the limit ([attitude] max_rate_deg_s); None where it is not."""
    if sample.rate_cam_rad_s is None:
        return None
    rate_rad_s = math.hypot(*sample.rate_cam_rad_s.tolist())
    if rate_rad_s <= max_rate_rad_s * (1 + RATE_ROUNDING):
        return None
    return Refusal(
        "rate",
        f"a rate of {rate_rad_s:.4g} rad/s ({math.degrees(rate_rad_s):.4g} deg/s) exceeds"
        f" [attitude] max_rate_deg_s = {math.degrees(max_rate_rad_s):g}; send rates in rad/s, or"
        " write a larger max_rate_deg_s",
    )


def decode_json(message: bytes, max_bytes: int = MAX_JSON_BYTES) -> AttitudeSample | Refusal:
    """Decode an attitude as a JSON object; other keys are not looked at."""
    if len(message) > max_bytes:
        return Refusal("format", f"more than {max_bytes} bytes of JSON; send an attitude alone")
    try:
        form = _json_decoder.decode(message)
    except (msgspec.MsgspecError, RecursionError, UnicodeDecodeError) as error:
        if b"NaN" in message or b"Infinity" in message:
            return Refusal("nan", "a number is NaN or Infinity", unset=b"NaN" in message)
        return Refusal("format", f"{error}; write {JSON_FORM}")
    if form.sender != UNSTATED_SENDER:
        sender = form.sender
    else:
        sender = 0
    return checked_sample(form.t_ns, form.q, form.rate, form.sequence, form.discontinuity, sender)


def frame(packet: Packet) -> bytes:
    """A packet as it goes on the wire: COBS, then 0x00."""
    return framed(encode(packet))


def framed(message: bytes) -> bytes:
    """A packet's bytes as they go on the wire."""
    return bytes(cobs.encode(message)) + DELIMITER


class StreamDecoder:
    """Bytes in, frames out; `decode_frame` says what one means."""

    def __init__(self) -> None:
        self._kept = bytearray()
        self._overlong = False
        self._synchronised = False

    @property
    def unended(self) -> bytes:
        """The bytes since the last 0x00, which are no frame yet; none where they were refused
        already.
        """
        return bytes(self._kept)

    def feed(self, chunk: bytes) -> list[tuple[Event, bytes]]:
        """The events that `chunk` completes, in order, each with its bytes as they came."""
        return [(decode_frame(frame), frame) for frame in self.frames(chunk)]

    def frames(self, chunk: bytes) -> list[bytes]:
        """The frames that `chunk` completes, undecoded, in order; of garbage without a 0x00 its
        beginning, once.
        """
        first, *others = chunk.split(DELIMITER)
        whole_frames: list[bytes] = []
        self._keep(first, whole_frames)
        if not others:
            return whole_frames
        body = bytes(self._kept)
        overlong = self._overlong
        whole = self._synchronised
        self._kept.clear()
        self._overlong = False
        self._synchronised = True
        whole = whole or len(body) > MAX_FRAME_BYTES
        if body and not overlong and (whole or not isinstance(decode_frame(body), Refusal)):
            whole_frames.append(body)
        rest = others.pop()
        whole_frames += [frame[: MAX_KEPT_BYTES + 1] for frame in others if frame]
        self._keep(rest, whole_frames)
        return whole_frames

    def _keep(self, part: bytes, found: list[bytes]) -> None:
        if self._overlong:
            return
        self._kept += part[: MAX_KEPT_BYTES + 1 - len(self._kept)]
        if len(self._kept) > MAX_KEPT_BYTES:
            self._overlong = True
            found.append(bytes(self._kept))
            self._kept.clear()


def decode_frame(body: bytes) -> Event:
    """What a frame says, or why it says nothing."""
    if len(body) > MAX_FRAME_BYTES:
        return named_refusal(
            "format", f"no 0x00 within {MAX_FRAME_BYTES} bytes", frame_likeness(body), FRAME_FORM
        )
    try:
        message = cobs.decode(body)
    except cobs.DecodeError as error:
        return named_refusal(
            "format",
            f"not COBS ({error})",
            frame_likeness(body),
            f"{FRAME_FORM}, at this line's baud rate",
        )
    if message.lstrip()[:1] == b"{":
        return Refusal(
            "format",
            f"a frame that starts with {message[:1]!r}; send JSON over ZeroMQ or UDP",
            telling=True,
        )
    event = _decode_packet(message, FRAME_FORM)
    if isinstance(event, Refusal) and event.reason == "format":
        likely = frame_likeness(body)
        if likely.known:
            return named_refusal("format", f"{len(message)} bytes", likely, FRAME_FORM)
    return event


def unended_line(data: bytes) -> str:
    """Why bytes of a serial line gave no packet, though no frame of theirs has ended."""
    likely = frame_likeness(data)
    return (
        f"{len(data)} bytes came, and no frame ended: {likely.what}; {likely.instead or FRAME_FORM}"
    )


def frame_declares_discontinuity(body: bytes) -> bool:
    """Whether a frame is an attitude that must not be interpolated to; quick where it is not."""
    if len(body) != protocol.ATTITUDE_BYTES + 1 or not body[FLAGS_AT] & protocol.FLAG_DISCONTINUITY:
        return False
    try:
        return declares_discontinuity(cobs.decode(body))
    except cobs.DecodeError:
        return False
