"""What bytes that are no packet look like: text, HTTP, TLS, a packet in another byte order. Every
link uses this to describe what it refuses.

Nothing is accepted here. A refused message, or bytes that never end, are only named, so that the
user can mend their sender. Laws:
1. Any bytes give a `Likeness`; nothing raises, and `likeness` looks at MAX_LOOKED_AT bytes at most.
2. `instead` says what to change where the bytes show it. It is "" where they do not, and only a
   description of the expected form helps.
"""

from __future__ import annotations

import math
import re
import struct
import zlib
from typing import NamedTuple

from cobs import cobs, cobsr

from hilstar.attitude.wire import protocol
from hilstar.attitude.wire.protocol import NORM_TOLERANCE, VERSION
from hilstar.basics.errors import printable

MAX_LOOKED_AT = 512
SHOWN_CHARACTERS = 32
SHOWN_BYTES = 8
MIN_TEXT_BYTES = 4  # shorter is not called text: 4 random bytes are all printable once in 50 times
MIN_LEADING_TEXT_BYTES = 6  # before binary: 6 random bytes are all printable once in 300 times
CRC_BYTES = 4
ALL_ONES = 0xFFFFFFFF
FRAME_BYTES = protocol.ATTITUDE_BYTES + 1  # an attitude's COBS frame, without its 0x00 at the end
HEAD = bytes([VERSION, protocol.KIND_ATTITUDE])
# the quaternion's offset in an attitude: version, kind, flags, sequence and t_ns precede it
Q_AT = struct.calcsize("<BBHIq")
HTTP = re.compile(
    rb"(?:GET|POST|PUT|HEAD|OPTIONS|DELETE|PATCH|CONNECT|TRACE) \S{1,300} HTTP/|HTTP/\d",
    re.IGNORECASE,
)
NMEA = re.compile(rb"[$!][A-Z]{2,5}[A-Z0-9]{0,8},")
LEADING_TEXT = re.compile(rb"[\t\r\n\x20-\x7e]+")
ZMTP_SIGNATURE_BYTES = 10  # 0xFF, eight of padding, 0x7F (rfc.zeromq.org, 23/ZMTP)
TLS_RECORDS = range(0x14, 0x18)  # RFC 8446, section 5.1: the type, then version 3.x
SLIP_END = 0xC0  # RFC 1055
PICKLE_PROTOCOLS = range(2, 6)
# By the first byte of a frame, of version 1 and 2: how many bytes a frame has besides its payload,
# without a signature and (version 2) with one.
MAVLINK = {
    0xFE: (8,),
    0xFD: (12, 25),
}
UBX = b"\xb5\x62"
BITS_REVERSED = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))
LITTLE_ENDIAN = "send it little-endian, CRC-32 included"
ZLIB_CRC = "end each packet with the CRC-32 of zlib, little-endian"


class Likeness(NamedTuple):
    """`what` bytes look like, and what to send `instead` ("" where the bytes do not show that).

    `known` is False for bytes that look like nothing in particular: noise, or a damaged packet.
    """

    what: str
    instead: str = ""
    known: bool = True


def likeness(data: bytes) -> Likeness:
    """What a message, or the beginning of a stream, looks like, by its first MAX_LOOKED_AT
    bytes.
    """
    beginning = data[:MAX_LOOKED_AT]
    for kind in (_protocol, _packet_inside, _serialised, _text):
        likely = kind(beginning)
        if likely is not None:
            return likely
    if not beginning:
        return Likeness("nothing", known=False)
    if len(set(beginning)) == 1 and len(beginning) >= MIN_TEXT_BYTES:
        return Likeness(
            f"the byte 0x{beginning[0]:02x} {len(beginning)} times",
            "check the line's polarity, ground and baud rate",
        )
    return Likeness(f"binary, {_in_hex(beginning)}", known=False)


def packet_likeness(message: bytes) -> Likeness | None:
    """What is wrong with a packet (its last 4 bytes a CRC-32) whose CRC-32 does not fit: the
    wrong CRC, the wrong byte order, or no packet at all. None where the bytes do not show it.
    """
    body = message[:-CRC_BYTES]
    given = message[-CRC_BYTES:]
    crc = zlib.crc32(body)
    if given == crc.to_bytes(CRC_BYTES, "big"):
        if (
            len(message) == protocol.ATTITUDE_BYTES
            and _is_unit(message, "<")
            and not _is_unit(message, ">")
        ):
            return Likeness(
                "its CRC-32 fits byte-swapped, and its other fields are little-endian",
                "swap the CRC-32's bytes",
            )
        return Likeness("its CRC-32 fits byte-swapped: the packet is big-endian", LITTLE_ENDIAN)
    for order in ("little", "big"):
        name = _other_crc(body, int.from_bytes(given, order))
        if name:
            return Likeness(f"its CRC is {name}", ZLIB_CRC)
    if message[: len(HEAD)] == HEAD and not any(given):
        return Likeness("its CRC-32 is 0: none was computed", ZLIB_CRC)
    return _big_endian_numbers(message) or _telling(message)


def numbers_likeness(message: bytes) -> Likeness | None:
    """What is wrong with an attitude packet whose CRC-32 fits and whose numbers are refused: their
    byte order. None where the bytes do not show it.
    """
    return _big_endian_numbers(message)


def _telling(message: bytes) -> Likeness | None:
    """The likeness of a message that is something other than a packet; None where it may be a
    packet that was damaged on its way.
    """
    likely = likeness(message)
    if likely.known and message[: len(HEAD)] != HEAD:
        return likely
    return None


def _big_endian_numbers(message: bytes) -> Likeness | None:
    if (
        len(message) != protocol.ATTITUDE_BYTES
        or _is_unit(message, "<")
        or not _is_unit(message, ">")
    ):
        return None
    return Likeness("its quaternion is a unit one read as big-endian", LITTLE_ENDIAN)


def _is_unit(attitude: bytes, order: str) -> bool:
    return _unit_at(attitude, Q_AT, order)


def _unit_at(data: bytes, at: int, order: str) -> bool:
    """Whether the four float64 at the offset `at`, in byte order `order` ("<" or ">"), have the
    norm 1, within NORM_TOLERANCE. Other fields read as float64 are mostly denormal, so their norm
    is not 1.
    """
    norm = math.hypot(*struct.unpack_from(f"{order}4d", data, at))
    return abs(norm - 1.0) <= NORM_TOLERANCE


def _other_crc(body: bytes, given: int) -> str:
    """The name of another usual CRC of the same polynomial by which `given` fits `body`; "" for
    none.

    Parameters are those of the catalogue of parametrised CRC algorithms
    (reveng.sourceforge.io/crc-catalogue). An STM32's unit takes the body as 32-bit words, the most
    significant bit first; the words are little-endian in memory, so their bytes are swapped here.
    """
    forward = _unreflected(body)
    swapped = b"".join(body[at : at + CRC_BYTES][::-1] for at in range(0, len(body), CRC_BYTES))
    names = {
        zlib.crc32(body) ^ ALL_ONES: "CRC-32/JAMCRC, which lacks the last inversion",
        forward: "CRC-32/BZIP2, whose bits are in the other order",
        forward ^ ALL_ONES: "CRC-32/MPEG-2, whose bits are in the other order",
        _unreflected(swapped)
        ^ ALL_ONES: "that of an STM32's CRC unit as it starts: CRC-32/MPEG-2 of 32-bit words",
    }
    return names.get(given, "")


def _unreflected(body: bytes) -> int:
    """The CRC-32/BZIP2 of `body`: zlib's CRC-32, with the bits of each byte and of the result in
    the other order.
    """
    reversed_crc = zlib.crc32(body.translate(BITS_REVERSED)).to_bytes(CRC_BYTES, "little")
    return int.from_bytes(reversed_crc.translate(BITS_REVERSED), "big")


def _protocol(data: bytes) -> Likeness | None:
    """Another protocol that `data` begins like (HTTP, TLS, ZeroMQ, or one of vehicles); None where
    it begins like none.
    """
    if HTTP.match(data):
        return Likeness(
            f"HTTP, {_quoted(data)}",
            "an HTTP client or server is there; give the sender's own address and port",
        )
    if len(data) >= 3 and data[0] in TLS_RECORDS and data[1] == 3 and data[2] <= 4:
        return Likeness("TLS", "send without TLS; ZeroMQ has keys of its own (hilstar keys)")
    if (
        len(data) >= ZMTP_SIGNATURE_BYTES
        and data[0] == 0xFF
        and data[ZMTP_SIGNATURE_BYTES - 1] == 0x7F
    ):
        return Likeness("the greeting of a ZeroMQ socket", 'write source = "zmq" for it')
    return _protocol_of_vehicles(data)


def _protocol_of_vehicles(data: bytes) -> Likeness | None:
    if NMEA.match(data):
        return Likeness(
            f"NMEA 0183, {_quoted(data)}", "a GNSS or compass is on this line; give the simulator's"
        )
    if data.startswith(UBX):
        return Likeness("u-blox UBX", "a GNSS receiver is on this line; give the simulator's")
    if len(data) > 1 and len(data) - data[1] in MAVLINK.get(data[0], ()):
        return Likeness(
            "a MAVLink frame",
            "send hilstar's packets; docs/sources.md says how to bring a log of PX4",
        )
    return None


def _packet_inside(data: bytes) -> Likeness | None:
    """A packet of hilstar itself that is framed as on another kind of link, or lacks its CRC-32;
    None where there is none.
    """
    unframed = unframed_packet(data)
    if unframed is not None:
        return unframed
    if any(_is_attitude_frame(body) for body in data.split(b"\0")):
        return Likeness(
            "a COBS frame, as on a serial line", "send the packet's 64 bytes as they are"
        )
    if len(data) == protocol.ATTITUDE_BYTES - CRC_BYTES and data[: len(HEAD)] == HEAD:
        return Likeness("an attitude without its CRC-32", ZLIB_CRC)
    return None


def unframed_packet(data: bytes) -> Likeness | None:
    """The likeness of serial bytes that contain a whole attitude outside any COBS frame, bare or
    in SLIP; None where they contain none.
    """
    for at in range(len(data) - protocol.ATTITUDE_BYTES + 1):
        message = data[at : at + protocol.ATTITUDE_BYTES]
        if message.startswith(HEAD) and _crc_fits(message):
            if data[max(at - 1, 0)] == SLIP_END:
                what = "a packet in SLIP"
            else:
                what = "a bare packet"
            return Likeness(what, "send each as a COBS frame, followed by 0x00")
    return None


def frame_likeness(body: bytes) -> Likeness:
    """What a frame's body, or bytes without a 0x00, look like where they are not the COBS encoding
    of a packet.
    """
    for at in range(len(body) - FRAME_BYTES + 1):
        if _is_attitude_frame(body[at : at + FRAME_BYTES]):
            return _beside_a_frame(body[:at], body[at + FRAME_BYTES :])
    try:
        if _crc_fits(cobsr.decode(body)):
            return Likeness("COBS/R, the reduced form", "send plain COBS")
    except cobsr.DecodeError:
        pass
    return likeness(body)


def _beside_a_frame(before: bytes, after: bytes) -> Likeness:
    """What to say of a whole frame with bytes before or after it, where only a 0x00 belongs."""
    if after or not before:
        return Likeness(
            "COBS frames without an end", "send 0x00 after each, which COBS libraries do not add"
        )
    if before.isspace():
        what = "a line end"
    else:
        what = f"{likeness(before).what}, stands"
    return Likeness(
        f"{what} before a frame", "send nothing between one frame's 0x00 and the next frame"
    )


def _is_attitude_frame(body: bytes) -> bool:
    """Whether a body is the COBS encoding of a whole attitude. The attitude's first bytes, HEAD,
    are never 0, so COBS leaves them as they are, after its own first byte.
    """
    if len(body) != FRAME_BYTES or body[1 : 1 + len(HEAD)] != HEAD:
        return False
    try:
        return _crc_fits(cobs.decode(body))
    except cobs.DecodeError:
        return False


def _crc_fits(message: bytes) -> bool:
    return zlib.crc32(message[:-CRC_BYTES]).to_bytes(CRC_BYTES, "little") == message[-CRC_BYTES:]


def _serialised(data: bytes) -> Likeness | None:
    """An object in a binary form (pickle, MessagePack, CBOR), or a quaternion of bare float64;
    None for neither.
    """
    if len(data) > 2 and data[0] == 0x80 and data[1] in PICKLE_PROTOCOLS:
        return Likeness("a Python pickle", "send json.dumps of the object")
    # No binary form begins with a letter or a bracket and is UTF-8 to its end.
    is_text = LEADING_TEXT.match(data) is not None and _is_utf8(data)
    if b"t_ns" in data and not is_text:
        return Likeness(
            "an object in a binary form, such as MessagePack or CBOR", "send it as JSON text"
        )
    # A quaternion alone is 32 bytes; with a time before it 40, with a rate after it 56, with both
    # 64. So it begins at 0, or after the time at 8.
    for at in (0, 8) if len(data) in {32, 40, 56, 64} else ():
        for order, name in (("<", "little"), (">", "big")):
            if at + 32 <= len(data) and _unit_at(data, at, order):
                return Likeness(
                    f"a bare quaternion of {name}-endian float64",
                    "put it into hilstar's packet, or send JSON",
                )
    return None


def _text(data: bytes) -> Likeness | None:
    """Text of any kind: UTF-16, UTF-8, or text before binary; None for no text."""
    text = data.removeprefix(b"\xef\xbb\xbf")  # the byte order mark of UTF-8
    # UTF-16 begins with its own mark, or has a 0x00 as every other byte (of Latin letters).
    if data[:2] in {b"\xff\xfe", b"\xfe\xff"} or (
        len(data) >= 2 * MIN_TEXT_BYTES and not any(data[1::2]) and all(data[::2])
    ):
        return Likeness("UTF-16 text", "write it as UTF-8")
    leading = LEADING_TEXT.match(text)
    length = 0 if leading is None else len(leading[0])
    if length == len(text) >= MIN_TEXT_BYTES or (length and _is_utf8(text)):
        return _kind_of_text(text)
    if length >= MIN_LEADING_TEXT_BYTES and leading is not None:
        return Likeness(
            f"text before binary, {_quoted(leading[0])}",
            "let nothing but packets go over this line",
        )
    return None


def _is_utf8(text: bytes) -> bool:
    """Whether bytes are UTF-8 text, of which the last character may be cut off."""
    # a character has 4 bytes at most, so a cut one has up to 3
    whole = text.decode(errors="ignore")
    return (
        len(text) >= MIN_TEXT_BYTES
        and len(text) - len(whole.encode()) < 4
        and all(c.isprintable() or c.isspace() for c in whole)
    )


def _kind_of_text(text: bytes) -> Likeness:
    start = text.lstrip()[:1]
    quoted = _quoted(text)
    if start == b"[":
        return Likeness(f"a JSON array, {quoted}", "send one object for each attitude")
    if start == b"{":
        return Likeness(f"JSON, {quoted}")
    if b"{" in text and b'"q"' in text:
        return Likeness(
            f"text before JSON, {quoted}",
            "send a topic as a part of its own, before the JSON, or leave it out",
        )
    return Likeness(f"text, {quoted}")


def _quoted(data: bytes) -> str:
    """The first SHOWN_CHARACTERS characters in quotes, as a person can read them."""
    shown = printable(data[:SHOWN_CHARACTERS].decode(errors="backslashreplace"))
    return f"'{shown}{'...' if len(data) > SHOWN_CHARACTERS else ''}'"


def _in_hex(data: bytes) -> str:
    return data[:SHOWN_BYTES].hex(" ") + (" ..." if len(data) > SHOWN_BYTES else "")
