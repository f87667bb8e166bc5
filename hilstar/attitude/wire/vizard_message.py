"""Basilisk's VizMessage, as much of it as hilstar needs: protobuf bytes in, a frozen `SimUpdate` out, no I/O.

Laws:
1. Every message gives fields or one `WireFormatError`; nothing else is raised.
2. No value is copied before its length is known to lie within the message. A `FieldReader` reads at most MAX_FIELDS fields,
   including those of nested messages, and at most MAX_PACKED_BYTES of packed numbers.

The wire format is that of the Protocol Buffers documentation (varints, wire types 0, 1, 2 and 5). Groups (3 and 4) belong to
proto2 and are refused. Field numbers are those of Basilisk's vizMessage.proto (package vizProtobufferMessage); other fields are
skipped. Of a field that is given twice the last counts, as in protobuf; one that is absent is 0 or empty.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TypeVar

from hilstar.attitude.wire.packet import INT64

VARINT, FIXED64, BYTES, FIXED32 = 0, 1, 2, 5
MAX_FIELDS = 20_000  # some 30 ms; a spacecraft has 5 to 30
MAX_PACKED_BYTES = 4096
MAX_FIELD_NUMBER = 2**29 - 1
DOUBLE = struct.Struct("<d")
INT64_SIGN = 1 << 63

Value = int | memoryview
Field = tuple[int, int, Value]
CURRENT_TIME, CELESTIAL_BODIES, SPACECRAFT, CAMERAS = 1, 2, 3, 4  # fields of a VizMessage
FRAME_NUMBER, SIM_TIME_ELAPSED = 1, 2  # fields of a TimeStamp
NAME, POSITION, VELOCITY, ROTATION, PARENT_NAME = 1, 2, 3, 4, 19  # fields of a Spacecraft; a CelestialBody has the first three
CAMERA_ID, FIELD_OF_VIEW, RESOLUTION, CAMERA_DIR_B = 1, 3, 4, 8  # fields of a CameraConfig

Components = tuple[float, ...]
T = TypeVar("T")


class WireFormatError(ValueError):
    """Bytes that are no protobuf message, or not the one that is wanted."""


class FieldReader:
    """Reads one message and those within it."""

    def __init__(self) -> None:
        self._left = MAX_FIELDS

    def fields(self, message: memoryview) -> Iterator[Field]:
        """Number, wire type and value of each field: an int of a varint, else the bytes. Raises WireFormatError."""
        at = 0
        while at < len(message):
            self._left -= 1
            if self._left < 0:
                raise WireFormatError(f"over {MAX_FIELDS} fields")
            tag, at = _varint(message, at)
            number, kind = tag >> 3, tag & 7
            if not 0 < number <= MAX_FIELD_NUMBER:
                raise WireFormatError(f"a field of number {number}")
            if kind == VARINT:
                value, at = _varint(message, at)
                yield number, kind, value
                continue
            size, at = _size(kind, message, at)
            if size > len(message) - at:
                raise WireFormatError(f"cut short: {size} bytes announced, {len(message) - at} there")
            yield number, kind, message[at : at + size]
            at += size


def _size(kind: int, message: memoryview, at: int) -> tuple[int, int]:
    """How many bytes a field that is no varint has, and where they begin."""
    if kind == BYTES:
        return _varint(message, at)
    if kind == FIXED64:
        return 8, at
    if kind == FIXED32:
        return 4, at
    raise WireFormatError(f"a field of wire type {kind}")


def _varint(message: memoryview, at: int) -> tuple[int, int]:
    """The number that begins at a byte, and where the next field does."""
    value = 0
    for place, byte in enumerate(message[at : at + 10]):
        value |= (byte & 0x7F) << 7 * place
        if byte < 0x80:
            return value & (2**64 - 1), at + place + 1
    raise WireFormatError("a number that is cut short, or longer than 10 bytes")


def as_int64(kind: int, value: Value) -> int:
    """An int32 or int64 field. Raises WireFormatError."""
    if kind != VARINT or not isinstance(value, int):
        raise WireFormatError(f"wire type {kind} where an integer is wanted")
    return value - 2 * INT64_SIGN if value & INT64_SIGN else value


def as_int64s(kind: int, value: Value) -> tuple[int, ...]:
    """A repeated integer, packed, or one element of one that is not. Raises WireFormatError."""
    if kind == VARINT:
        return (as_int64(kind, value),)
    packed, numbers, at = _packed(kind, value), [], 0
    while at < len(packed):
        number, at = _varint(packed, at)
        numbers.append(as_int64(VARINT, number))
    return tuple(numbers)


def as_double(kind: int, value: Value) -> float:
    """A double field. Raises WireFormatError."""
    if kind != FIXED64 or isinstance(value, int):
        raise WireFormatError(f"wire type {kind} where a double is wanted")
    return float(DOUBLE.unpack(value)[0])


def as_message(kind: int, value: Value) -> memoryview:
    """The bytes of a message or a string. Raises WireFormatError."""
    if kind != BYTES or isinstance(value, int):
        raise WireFormatError(f"wire type {kind} where a message or a text is wanted")
    return value


def as_text(kind: int, value: Value) -> str:
    """A string field; what is not UTF-8 in it is replaced. Raises WireFormatError."""
    return bytes(as_message(kind, value)).decode("utf-8", "replace")


def as_doubles(kind: int, value: Value) -> tuple[float, ...]:
    """A repeated double, packed, or one element of one that is not. Raises WireFormatError."""
    if kind == FIXED64:
        return (as_double(kind, value),)
    packed = _packed(kind, value)
    if len(packed) % DOUBLE.size:
        raise WireFormatError(f"{len(packed)} bytes of doubles")
    return tuple(number for (number,) in DOUBLE.iter_unpack(packed))


def _packed(kind: int, value: Value) -> memoryview:
    packed = as_message(kind, value)
    if len(packed) > MAX_PACKED_BYTES:
        raise WireFormatError(f"{len(packed)} bytes of numbers where a few are wanted")
    return packed


@dataclass(frozen=True, slots=True)
class VizSpacecraft:
    """One spacecraft: position (m), velocity (m/s) and `sigma_bn` (MRP) in and from Basilisk's inertial frame N.

    Each has three components, or none where the message has none. A part of another spacecraft names it as its `parent`.
    """

    name: str = ""
    parent: str = ""
    position_m: Components = ()
    velocity_m_s: Components = ()
    sigma_bn: Components = ()


@dataclass(frozen=True, slots=True)
class CelestialBody:
    """A planet of the simulation: position (m) and velocity (m/s) in N, with three components each or none."""

    name: str = ""
    position_m: Components = ()
    velocity_m_s: Components = ()


@dataclass(frozen=True, slots=True)
class VizCamera:
    """A camera as Basilisk describes it to Vizard: degrees along its y axis, px, and `sigma` (MRP) from its body to Unity's."""

    identity: int = 0
    field_of_view_deg: float = 0.0
    resolution_px: tuple[int, ...] = ()
    sigma: Components = ()


@dataclass(frozen=True, slots=True)
class SimUpdate:
    """One step of a simulation: `t_ns` since its start, and what it has."""

    t_ns: int
    frame: int
    spacecraft: tuple[VizSpacecraft, ...]
    cameras: tuple[VizCamera, ...]
    bodies: tuple[CelestialBody, ...] = ()


def decode_update(message: bytes) -> SimUpdate:
    """A VizMessage. Raises WireFormatError for bytes that are none, and for one without a time."""
    stamp: dict[int, float] | None = None
    spacecraft: list[VizSpacecraft] = []
    cameras: list[VizCamera] = []
    bodies: list[CelestialBody] = []
    reader = FieldReader()
    for number, kind, value in reader.fields(memoryview(message)):
        if number == CURRENT_TIME:
            stamp = (stamp or {}) | _time_stamp(reader.fields(as_message(kind, value)))
        elif number == SPACECRAFT:
            spacecraft.append(_spacecraft(reader.fields(as_message(kind, value))))
        elif number == CELESTIAL_BODIES:
            body = _spacecraft(reader.fields(as_message(kind, value)), (POSITION, VELOCITY))
            bodies.append(CelestialBody(body.name, body.position_m, body.velocity_m_s))
        elif number == CAMERAS:
            cameras.append(_camera(reader.fields(as_message(kind, value))))
    if stamp is None:
        raise WireFormatError("no currentTime")
    time_ns = stamp.get(SIM_TIME_ELAPSED, 0.0)
    if not math.isfinite(time_ns) or round(time_ns) not in INT64:
        raise WireFormatError(f"simTimeElapsed {time_ns:g} ns")
    return SimUpdate(round(time_ns), int(stamp.get(FRAME_NUMBER, 0)), tuple(spacecraft), tuple(cameras), tuple(bodies))


def _time_stamp(fields: Iterator[Field]) -> dict[int, float]:
    readers: dict[int, Callable[[int, Value], float]] = {FRAME_NUMBER: as_int64, SIM_TIME_ELAPSED: as_double}
    return {number: readers[number](kind, value) for number, kind, value in fields if number in readers}


def _spacecraft(fields: Iterator[Field], wanted: tuple[int, ...] = (POSITION, VELOCITY, ROTATION)) -> VizSpacecraft:
    texts: dict[int, str] = {}
    vectors: dict[int, Components] = {}
    for number, kind, value in fields:
        if number in {NAME, PARENT_NAME}:
            texts[number] = as_text(kind, value)
        elif number in wanted:
            vectors[number] = _extended(vectors.get(number, ()), as_doubles(kind, value), 3)
    position, velocity, rotation = (vectors.get(number, ()) for number in (POSITION, VELOCITY, ROTATION))
    return VizSpacecraft(texts.get(NAME, ""), texts.get(PARENT_NAME, ""), position, velocity, rotation)


def _camera(fields: Iterator[Field]) -> VizCamera:
    identity, field_deg = 0, 0.0
    resolution: tuple[int, ...] = ()
    sigma: Components = ()
    for number, kind, value in fields:
        if number == CAMERA_ID:
            identity = as_int64(kind, value)
        elif number == FIELD_OF_VIEW:
            field_deg = as_double(kind, value)
        elif number == RESOLUTION:
            resolution = _extended(resolution, as_int64s(kind, value), 2)
        elif number == CAMERA_DIR_B:
            sigma = _extended(sigma, as_doubles(kind, value), 3)
    return VizCamera(identity, field_deg, resolution, sigma)


def _extended(so_far: tuple[T, ...], more: tuple[T, ...], wanted: int) -> tuple[T, ...]:
    if len(so_far) + len(more) > wanted:
        raise WireFormatError(f"over {wanted} components where {wanted} are wanted")
    return so_far + more
