"""The stream of a GigE Vision camera (GVSP), without I/O: an image in, its packets out.

An image is a block: a leader, its bytes in packets of one size (the last may be shorter), and a
trailer, numbered from 0. Blocks are numbered 1 to 65 535 and again from 1; 0 is never one.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hilstar.server.gige.features import PIXEL_FORMATS
from hilstar.server.gige.registers import CameraSettings, GvcpStatus

HEADER = struct.Struct(">HHI")
LEADER_BODY = struct.Struct(">HHIIIIIIIHH")
TRAILER_BODY = struct.Struct(">HHI")
LEADER, TRAILER, PAYLOAD = 1, 2, 3
FORMAT_SHIFT = 24
IMAGE = 0x0001
LAST_BLOCK = 0xFFFF
# of the size that a client asks for: the headers of IPv4 (20), UDP (8) and GVSP (8)
HEADERS_BYTES = 36


def packed(dn: npt.NDArray[np.uint16], bits: int, pixel_format: str) -> bytes:
    """The bytes of an image (height, width) of DN of `bits`, in a pixel format.

    A format of fewer bits has their upper ones; one of more has the DN as they are.
    """
    form = PIXEL_FORMATS[pixel_format]
    values = np.right_shift(dn.ravel(), max(bits - form.bits, 0), dtype=np.uint16)
    if form.stored_bits == 8:
        return values.astype(np.uint8).tobytes()
    if form.stored_bits == 16:
        return values.astype("<u2").tobytes()
    return _packed_in_threes(values, form.bits)


def _packed_in_threes(values: npt.NDArray[np.uint16], bits: int) -> bytes:
    """Two pixels in three bytes, as GigE Vision packs them: the upper 8 bits of each beside the
    lower ones of both.
    """
    if len(values) % 2:
        values = np.append(values, np.uint16(0))
    low_bits = bits - 8
    mask = (1 << low_bits) - 1
    first = values[0::2]
    second = values[1::2]
    threes = np.empty((len(first), 3), np.uint8)
    threes[:, 0] = first >> low_bits
    threes[:, 1] = (first & mask) | (second & mask) << 4
    threes[:, 2] = second >> low_bits
    return threes.tobytes()


@dataclass(frozen=True, slots=True)
class ImageBlock:
    """An image as it is sent: its number, its leader's and trailer's bodies, its bytes."""

    number: int
    leader: bytes
    payload: memoryview
    trailer: bytes
    packet_bytes: int

    @property
    def data_bytes(self) -> int:
        """Of the image in a packet."""
        return self.packet_bytes - HEADERS_BYTES

    @property
    def last(self) -> int:
        """The number of the last packet, the trailer."""
        return -(-len(self.payload) // self.data_bytes) + 1

    def packet(self, number: int) -> list[bytes | memoryview]:
        """A packet's header and what follows it."""
        if number == 0:
            kind = LEADER
            body = self.leader
        elif number == self.last:
            kind = TRAILER
            body = self.trailer
        else:
            first = (number - 1) * self.data_bytes
            return [self._header(PAYLOAD, number), self.payload[first : first + self.data_bytes]]
        return [self._header(kind, number), body]

    def packets(self) -> Iterator[list[bytes | memoryview]]:
        """All packets in their order."""
        for number in range(self.last + 1):
            yield self.packet(number)

    def _header(self, kind: int, number: int) -> bytes:
        return HEADER.pack(GvcpStatus.SUCCESS, self.number, kind << FORMAT_SHIFT | number)


def unavailable(block: int, number: int) -> bytes:
    """The packet that answers a request for one which is not kept any more."""
    return HEADER.pack(GvcpStatus.PACKET_UNAVAILABLE, block, PAYLOAD << FORMAT_SHIFT | number)


def image_block(
    number: int,
    dn: npt.NDArray[np.uint16],
    begin_ns: int,
    settings: CameraSettings,
    packet_bytes: int,
) -> ImageBlock:
    """The block of an image (height, width), DN, whose exposure began at `begin_ns` of the
    camera's clock.
    """
    height, width = dn.shape
    form = PIXEL_FORMATS[settings.pixel_format]
    leader = LEADER_BODY.pack(
        0,
        IMAGE,
        begin_ns >> 32 & 0xFFFF_FFFF,
        begin_ns & 0xFFFF_FFFF,
        form.number,
        width,
        height,
        0,
        0,
        0,
        0,
    )
    data = packed(dn, settings.bits, settings.pixel_format)
    trailer = TRAILER_BODY.pack(0, IMAGE, height)
    return ImageBlock(number, leader, memoryview(data), trailer, packet_bytes)


def next_block(number: int) -> int:
    """The number after a block's."""
    return 1 if number >= LAST_BLOCK else number + 1
