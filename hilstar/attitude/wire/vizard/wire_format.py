"""The protobuf wire format, as far as reading needs it: a message's fields in their order, without their meaning; no I/O.

Laws:
1. Every message gives fields or one `WireFormatError`; nothing else is raised.
2. No value is copied before its length is known to lie within the message; a `Reader` reads at most MAX_FIELDS fields, in
   messages within messages too, and at most MAX_PACKED_BYTES of packed numbers.

Source: the encoding in the Protocol Buffers documentation (varints, wire types 0, 1, 2 and 5). Groups (3 and 4) belong to
proto2 and are refused.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator

VARINT, FIXED64, BYTES, FIXED32 = 0, 1, 2, 5
MAX_FIELDS = 20_000  # some 30 ms; a spacecraft has 5 to 30
MAX_PACKED_BYTES = 4096
MAX_FIELD_NUMBER = 2**29 - 1
DOUBLE = struct.Struct("<d")
INT64_SIGN = 1 << 63

Value = int | memoryview
Field = tuple[int, int, Value]


class WireFormatError(ValueError):
    """Bytes that are no protobuf message, or not the one that is wanted."""


class Reader:
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
