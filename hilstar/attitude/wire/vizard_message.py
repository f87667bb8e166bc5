"""Basilisk's VizMessage, as much of it as hilstar needs: protobuf bytes in, a frozen `SimUpdate` out, no I/O.

Laws:
1. Every message gives fields or one `WireFormatError`; nothing else is raised.
2. No value is copied before its length is known to lie within the message. A `_FieldReader` reads at most MAX_FIELDS fields,
   including those of nested messages, and at most MAX_PACKED_BYTES of packed numbers.

The wire format is that of the Protocol Buffers documentation (varints, wire types 0, 1, 2 and 5). Groups (3 and 4) belong to
proto2 and are refused. Field numbers are those of Basilisk's vizMessage.proto (package vizProtobufferMessage); other fields are
skipped. Of a field that is given twice the last counts, as in protobuf; one that is absent is 0 or empty.
"""

import math
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

from hilstar.attitude.wire.packet import INT64

VARINT, FIXED64, BYTES, FIXED32 = 0, 1, 2, 5
FIXED_BYTES = {FIXED64: 8, FIXED32: 4}
MAX_FIELDS = 20_000  # some 30 ms; a spacecraft has 5 to 30
MAX_PACKED_BYTES = 4096
MAX_FIELD_NUMBER = 2**29 - 1
DOUBLE = struct.Struct("<d")
INT64_SIGN = 1 << 63

Value = int | memoryview
Components = tuple[float, ...]


class WireFormatError(ValueError):
    """Bytes that are no protobuf message, or not the one that is wanted."""


class _FieldReader:
    """Reads one message and those within it."""

    def __init__(self) -> None:
        self._left = MAX_FIELDS

    def fields(self, message: memoryview) -> Iterator[tuple[int, int, Value]]:
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
            if kind not in {VARINT, BYTES, *FIXED_BYTES}:
                raise WireFormatError(f"a field of wire type {kind}")
            if kind in FIXED_BYTES:
                size = FIXED_BYTES[kind]
            else:
                size, at = _varint(message, at)
            if kind == VARINT:
                yield number, kind, size
                continue
            if size > len(message) - at:
                raise WireFormatError(f"cut short: {size} bytes announced, {len(message) - at} there")
            yield number, kind, message[at : at + size]
            at += size

    def read(self, message: memoryview, form: "Form") -> dict[str, Any]:
        """The fields of a message that its form names. Raises WireFormatError."""
        found: dict[str, Any] = {}
        for number, kind, value in self.fields(message):
            if number not in form:
                continue
            name, read, most = form[number]
            content = read(kind, value)
            if most:
                content = found.get(name, ()) + content
                if len(content) > most:
                    raise WireFormatError(f"over {most} components where {most} are wanted")
            found[name] = content
        return found


def _varint(message: memoryview, at: int) -> tuple[int, int]:
    """The number that begins at a byte, and where the next field does."""
    value = 0
    for place, byte in enumerate(message[at : at + 10]):
        value |= (byte & 0x7F) << 7 * place
        if byte < 0x80:
            return value & (2**64 - 1), at + place + 1
    raise WireFormatError("a number that is cut short, or longer than 10 bytes")


def _int64(kind: int, value: Value) -> int:
    if kind != VARINT or not isinstance(value, int):
        raise WireFormatError(f"wire type {kind} where an integer is wanted")
    return value - 2 * INT64_SIGN if value & INT64_SIGN else value


def _double(kind: int, value: Value) -> float:
    if kind != FIXED64 or isinstance(value, int):
        raise WireFormatError(f"wire type {kind} where a double is wanted")
    return float(DOUBLE.unpack(value)[0])


def _message(kind: int, value: Value) -> memoryview:
    if kind != BYTES or isinstance(value, int):
        raise WireFormatError(f"wire type {kind} where a message or a text is wanted")
    return value


def _text(kind: int, value: Value) -> str:
    """A string; what is not UTF-8 in it is replaced."""
    return bytes(_message(kind, value)).decode("utf-8", "replace")


def _int64s(kind: int, value: Value) -> tuple[int, ...]:
    """A repeated integer, packed, or one element of one that is not."""
    if kind == VARINT:
        return (_int64(kind, value),)
    packed, numbers, at = _packed(kind, value), [], 0
    while at < len(packed):
        number, at = _varint(packed, at)
        numbers.append(_int64(VARINT, number))
    return tuple(numbers)


def _doubles(kind: int, value: Value) -> tuple[float, ...]:
    """A repeated double, packed, or one element of one that is not."""
    if kind == FIXED64:
        return (_double(kind, value),)
    packed = _packed(kind, value)
    if len(packed) % DOUBLE.size:
        raise WireFormatError(f"{len(packed)} bytes of doubles")
    return tuple(number for (number,) in DOUBLE.iter_unpack(packed))


def _packed(kind: int, value: Value) -> memoryview:
    packed = _message(kind, value)
    if len(packed) > MAX_PACKED_BYTES:
        raise WireFormatError(f"{len(packed)} bytes of numbers where a few are wanted")
    return packed


@dataclass(frozen=True, slots=True)
class VizBody:
    """A spacecraft or planet: position (m), velocity (m/s) and `sigma_bn` (MRP) in and from Basilisk's inertial frame N.

    Each has three components, or none where the message has none; a planet has no `sigma_bn`. A part of another spacecraft
    names it as its `parent`.
    """

    name: str = ""
    parent: str = ""
    position_m: Components = ()
    velocity_m_s: Components = ()
    sigma_bn: Components = ()


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
    spacecraft: tuple[VizBody, ...]
    cameras: tuple[VizCamera, ...]
    bodies: tuple[VizBody, ...] = ()


class _FormField(NamedTuple):
    """A field of a message: its name here, how it is read, and how many components it has; 0 where it is no list."""

    name: str
    read: Callable[[int, Value], Any]
    components: int = 0


Form = dict[int, _FormField]
CURRENT_TIME, CELESTIAL_BODIES, SPACECRAFT, CAMERAS = 1, 2, 3, 4  # fields of a VizMessage
TIME_STAMP = {1: _FormField("frame", _int64), 2: _FormField("elapsed_ns", _double)}
PLANET = {1: _FormField("name", _text), 2: _FormField("position_m", _doubles, 3), 3: _FormField("velocity_m_s", _doubles, 3)}
CRAFT = {**PLANET, 4: _FormField("sigma_bn", _doubles, 3), 19: _FormField("parent", _text)}
CAMERA = {
    1: _FormField("identity", _int64),
    3: _FormField("field_of_view_deg", _double),
    4: _FormField("resolution_px", _int64s, 2),
    8: _FormField("sigma", _doubles, 3),
}


def decode_update(message: bytes) -> SimUpdate:
    """A VizMessage. Raises WireFormatError for bytes that are none, and for one without a time."""
    stamp: dict[str, Any] | None = None
    spacecraft, cameras, bodies = [], [], []
    reader = _FieldReader()
    for number, kind, value in reader.fields(memoryview(message)):
        if number == CURRENT_TIME:
            stamp = (stamp or {}) | reader.read(_message(kind, value), TIME_STAMP)
        elif number == SPACECRAFT:
            spacecraft.append(VizBody(**reader.read(_message(kind, value), CRAFT)))
        elif number == CELESTIAL_BODIES:
            bodies.append(VizBody(**reader.read(_message(kind, value), PLANET)))
        elif number == CAMERAS:
            cameras.append(VizCamera(**reader.read(_message(kind, value), CAMERA)))
    if stamp is None:
        raise WireFormatError("no currentTime")
    time_ns = stamp.get("elapsed_ns", 0.0)
    if not math.isfinite(time_ns) or round(time_ns) not in INT64:
        raise WireFormatError(f"simTimeElapsed {time_ns:g} ns")
    return SimUpdate(round(time_ns), stamp.get("frame", 0), tuple(spacecraft), tuple(cameras), tuple(bodies))
