"""Packets out of a byte stream: COBS frames, each followed by 0x00, cut anywhere, with anything between them; no I/O.

Laws:
1. However the bytes are cut into chunks, the events are the same.
2. A frame is accepted only if `packet.decode` accepts its content, so never with a wrong CRC-32.
3. Whatever came before, the next complete frame after a 0x00 is decoded.
4. At most MAX_FRAME_BYTES are kept between chunks: a sender that never sends 0x00 costs one refusal for each stretch of
   garbage, and no memory.
5. The bytes before the stream's first 0x00 may be the end of a frame: they count only if they are a complete one.
"""

from __future__ import annotations

from cobs import cobs

from hilstar.attitude.wire import protocol
from hilstar.attitude.wire.packet import Event, Packet, Refusal, decode, encode

DELIMITER = b"\x00"
# COBS adds one byte to anything shorter than 254. Only packets are framed: JSON goes over ZeroMQ.
MAX_FRAME_BYTES = max(protocol.PACKET_BYTES.values()) + 1


def frame(packet: Packet) -> bytes:
    """A packet as it goes on the wire: COBS, then 0x00."""
    return framed(encode(packet))


def framed(message: bytes) -> bytes:
    """A packet's bytes as they go on the wire."""
    return bytes(cobs.encode(message)) + DELIMITER


class StreamDecoder:
    """Bytes in, (event, its bytes as they came) out."""

    def __init__(self) -> None:
        self._kept = bytearray()
        self._overlong = False
        self._synchronised = False

    def feed_newest(self, chunk: bytes, frames: int) -> list[tuple[Event, bytes]]:
        """The events of only the last `frames` delimiters of `chunk`: earlier ones, and the bytes kept so far, are dropped."""
        before = len(chunk)
        for _ in range(frames + 1):
            before = chunk.rfind(DELIMITER, 0, before) if before > 0 else -1
        self._kept.clear()
        self._overlong, self._synchronised = False, True
        return self.feed(chunk[before + 1 :])

    def feed(self, chunk: bytes) -> list[tuple[Event, bytes]]:
        """The events that `chunk` completes, in order."""
        events: list[tuple[Event, bytes]] = []
        *whole, rest = chunk.split(DELIMITER)
        for part in whole:
            self._keep(part, events)
            self._end_frame(events)
        self._keep(rest, events)
        return events

    def _keep(self, part: bytes, events: list[tuple[Event, bytes]]) -> None:
        if self._overlong:
            return
        room = MAX_FRAME_BYTES - len(self._kept)
        self._kept += part[:room]
        if len(part) > room:
            self._overlong = True
            if self._synchronised:
                refusal = Refusal("format", f"no 0x00 within {MAX_FRAME_BYTES} bytes; send COBS frames, each followed by 0x00")
                events.append((refusal, bytes(self._kept)))

    def _end_frame(self, events: list[tuple[Event, bytes]]) -> None:
        body, overlong, whole = bytes(self._kept), self._overlong, self._synchronised
        self._kept.clear()
        self._overlong = False
        self._synchronised = True
        if overlong or not body:
            return
        event = _decode_frame(body)
        if whole or not isinstance(event, Refusal):
            events.append((event, body))


def _decode_frame(body: bytes) -> Event:
    try:
        message = cobs.decode(body)
    except cobs.DecodeError as error:
        return Refusal("format", f"not COBS ({error})")
    if message.lstrip()[:1] == b"{":
        return Refusal("format", f"a frame that starts with {message[:1]!r}; send JSON over ZeroMQ")
    return decode(message)
