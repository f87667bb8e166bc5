"""Packets out of a byte stream: COBS frames, each followed by 0x00, cut anywhere, with anything between them; no I/O.

Laws:
1. However the bytes are cut into chunks, the events are the same.
2. A frame is accepted only if `packet.decode` accepts its content, so never with a wrong CRC-32.
3. Whatever came before, the next complete frame after a 0x00 is decoded.
4. At most MAX_FRAME_BYTES are kept between chunks: a sender that never sends 0x00 costs one refusal for each stretch
   of garbage, and no memory.
5. The bytes before the stream's first 0x00 may be the end of a frame: they count only if they are a complete one.
6. A frame that is passed over undecoded loses nothing of the next.
"""

from __future__ import annotations

from cobs import cobs

from hilstar.attitude.wire import protocol
from hilstar.attitude.wire.packet import Event, Packet, Refusal, declares_discontinuity, decode, encode

DELIMITER = b"\x00"
# COBS adds one byte to anything shorter than 254. Only packets are framed: JSON goes over ZeroMQ.
MAX_FRAME_BYTES = max(protocol.PACKET_BYTES.values()) + 1
FLAGS_AT = 3  # of an attitude's frame: behind the COBS byte, version and kind, of which none is 0


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

    def feed(self, chunk: bytes) -> list[tuple[Event, bytes]]:
        """The events that `chunk` completes, in order, each with its bytes as they came."""
        return [(decode_frame(frame), frame) for frame in self.frames(chunk)]

    def frames(self, chunk: bytes) -> list[bytes]:
        """The frames that `chunk` completes, undecoded, in order; of garbage without a 0x00 its beginning, once."""
        first, *others = chunk.split(DELIMITER)
        found: list[bytes] = []
        self._keep(first, found)
        if not others:
            return found
        self._end_frame(found)
        rest = others.pop()
        found += [frame[: MAX_FRAME_BYTES + 1] for frame in others if frame]
        self._keep(rest, found)
        return found

    def _keep(self, part: bytes, found: list[bytes]) -> None:
        if self._overlong:
            return
        self._kept += part[: MAX_FRAME_BYTES + 1 - len(self._kept)]
        if len(self._kept) > MAX_FRAME_BYTES:
            self._overlong = True
            if self._synchronised:
                found.append(bytes(self._kept))
            self._kept.clear()

    def _end_frame(self, found: list[bytes]) -> None:
        body, overlong, whole = bytes(self._kept), self._overlong, self._synchronised
        self._kept.clear()
        self._overlong = False
        self._synchronised = True
        if body and not overlong and (whole or not isinstance(decode_frame(body), Refusal)):
            found.append(body)


def decode_frame(body: bytes) -> Event:
    """What a frame says, or why it says nothing."""
    if len(body) > MAX_FRAME_BYTES:
        return Refusal("format", f"no 0x00 within {MAX_FRAME_BYTES} bytes; send COBS frames, each followed by 0x00")
    try:
        message = cobs.decode(body)
    except cobs.DecodeError as error:
        return Refusal("format", f"not COBS ({error})")
    if message.lstrip()[:1] == b"{":
        return Refusal("format", f"a frame that starts with {message[:1]!r}; send JSON over ZeroMQ")
    return decode(message)


def frame_declares_discontinuity(body: bytes) -> bool:
    """Whether a frame is an attitude that must not be interpolated to; quick where it is not."""
    if len(body) != protocol.ATTITUDE_BYTES + 1 or not body[FLAGS_AT] & protocol.FLAG_DISCONTINUITY:
        return False
    try:
        return declares_discontinuity(cobs.decode(body))
    except cobs.DecodeError:
        return False
