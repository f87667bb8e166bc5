"""What the process that reads a link says to the one that shows stars: bytes in, records out, no I/O.

Laws:
1. A record is a length, a kind and a payload, and comes out once it is whole, in order, however it was cut on its way.
2. Both ends are hilstar: a record that neither would write is a ValueError.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator, Sequence
from enum import IntEnum
from typing import Any, NamedTuple

HEAD = struct.Struct("<IB")  # bytes of the payload, kind
STAMP = struct.Struct("<qq?")  # host_ns, empty_ns, timely
LENGTH = struct.Struct("<I")
MAX_PAYLOAD_BYTES = 1 << 27  # 64 parts (zmq_socket) of a few MB


class Kind(IntEnum):
    """What a record is."""

    MESSAGE = 1  # a Stamped
    NOTICE = 2  # JSON: the method of Notices, its arguments, and what COUNTS says by then
    COUNTS = 3  # JSON: LinkCounts by name
    GONE = 4  # text: the device does not answer, and why
    ENDS = 5  # text: the process ends, and why
    READY = 6  # what it needs is imported, and it does at once what it is asked for; again and again, as a sign of life


class Stamped(NamedTuple):
    """A message as it came: host time of its arrival, its parts, when nothing waited last, and whether it did not wait."""

    host_ns: int
    empty_ns: int
    timely: bool
    parts: list[bytes]

    @property
    def waited_ns(self) -> int:
        """How long it may have waited before it was stamped, ns."""
        return 0 if self.timely else self.host_ns - self.empty_ns


Record = tuple[Kind, bytes]


def pack(kind: Kind, payload: bytes) -> bytes:
    """A record's bytes."""
    return HEAD.pack(len(payload), kind) + payload


def pack_message(host_ns: int, empty_ns: int, timely: bool, parts: Sequence[bytes]) -> bytes:
    """The record of a message."""
    body = b"".join(LENGTH.pack(len(part)) + part for part in parts)
    return pack(Kind.MESSAGE, STAMP.pack(host_ns, empty_ns, timely) + body)


def pack_object(kind: Kind, told: Any) -> bytes:
    """A record whose payload is JSON."""
    return pack(kind, json.dumps(told).encode())


def unpack_message(payload: bytes) -> Stamped:
    """The message of a record. Raises ValueError for bytes that `pack_message` does not write."""
    if len(payload) < STAMP.size:
        raise ValueError(f"a message record of {len(payload)} bytes")
    host_ns, empty_ns, timely = STAMP.unpack_from(payload)
    parts, at = [], STAMP.size
    while at < len(payload):
        if len(payload) - at < LENGTH.size:
            raise ValueError("a part without its length")
        (count,) = LENGTH.unpack_from(payload, at)
        at += LENGTH.size + count
        if at > len(payload):
            raise ValueError(f"a part of {count} bytes, cut short")
        parts.append(payload[at - count : at])
    return Stamped(host_ns, empty_ns, timely, parts)


class RecordStream:
    """Puts records together again from what a stream brings."""

    def __init__(self) -> None:
        self._kept = bytearray()

    def feed(self, chunk: bytes) -> Iterator[Record]:
        """The records that `chunk` completes, in order. Raises ValueError for what is no record."""
        self._kept += chunk
        at = 0
        while len(self._kept) - at >= HEAD.size:
            count, kind = HEAD.unpack_from(self._kept, at)
            if count > MAX_PAYLOAD_BYTES:
                raise ValueError(f"a record of {count} bytes")
            begin = at + HEAD.size
            if len(self._kept) - begin < count:
                break
            at = begin + count
            yield Kind(kind), bytes(self._kept[begin:at])
        del self._kept[:at]
