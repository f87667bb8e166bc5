"""What bytes look like that are no packet: each named, with what to send instead."""

import json
import pickle
import struct
import zlib

import numpy as np
import pytest
from cobs import cobs, cobsr

from hilstar.attitude.wire.likeness import MAX_LOOKED_AT, likeness, unframed_packet
from hilstar.attitude.wire.packet import (
    AttitudeSample,
    Refusal,
    StreamDecoder,
    decode,
    decode_frame,
    frame,
)

Q = (0.6987226, 0.7135120, -0.0370377, 0.0362700)
# without any of these the other three are no unit quaternion
HALVES = (0.5, -0.5, 0.5, -0.5)
FIELDS = "BBHIq4d3f"
LITTLE = struct.pack("<" + FIELDS, 1, 1, 1, 7, 123456789, *Q, 0.0, 0.0, 0.0)
BIG = struct.pack(">" + FIELDS, 1, 1, 1, 7, 123456789, *Q, 0.0, 0.0, 0.0)
ALL_ONES = 0xFFFFFFFF


def crc_mpeg2(data: bytes) -> int:
    """CRC-32/MPEG-2, bit by bit: polynomial 04C11DB7, most significant bit first, begun with
    ones, not inverted.
    """
    crc = ALL_ONES
    for byte in data:
        crc ^= byte << 24
        for _ in range(8):
            crc = (crc << 1) ^ (0x04C11DB7 if crc & 0x80000000 else 0)
            crc &= ALL_ONES
    return crc


def stm32_words(data: bytes) -> bytes:
    """What an STM32's CRC unit sees of little-endian memory: 32-bit words, the most significant
    byte first.
    """
    return b"".join(data[at : at + 4][::-1] for at in range(0, len(data), 4))


def little(number: int) -> bytes:
    return struct.pack("<I", number)


def big(number: int) -> bytes:
    return struct.pack(">I", number)


PACKETS = {
    "big-endian": (BIG + big(zlib.crc32(BIG)), "the packet is big-endian"),
    "its fields alone": (BIG + little(zlib.crc32(BIG)), "read as big-endian"),
    "its CRC alone": (LITTLE + big(zlib.crc32(LITTLE)), "swap the CRC-32's bytes"),
    "big-endian, another CRC": (BIG + little(0x12345678), "read as big-endian"),
    "JAMCRC": (LITTLE + little(zlib.crc32(LITTLE) ^ ALL_ONES), "JAMCRC"),
    "MPEG-2": (LITTLE + little(crc_mpeg2(LITTLE)), "MPEG-2"),
    "BZIP2": (LITTLE + little(crc_mpeg2(LITTLE) ^ ALL_ONES), "BZIP2"),
    "STM32": (LITTLE + little(crc_mpeg2(stm32_words(LITTLE))), "STM32"),
    "no CRC computed": (LITTLE + little(0), "none was computed"),
    "no CRC": (LITTLE, "without its CRC-32"),
}


@pytest.mark.parametrize(("message", "words"), PACKETS.values(), ids=PACKETS)
@pytest.mark.parametrize("road", ["datagram", "serial line"])
def test_a_packet_in_another_order_or_of_another_crc_is_named(
    message: bytes, words: str, road: str
) -> None:
    event = decode(message) if road == "datagram" else decode_frame(cobs.encode(message))
    assert isinstance(event, Refusal)
    assert event.telling
    assert words in event.detail


def test_a_big_endian_packet_of_each_other_kind_is_named() -> None:
    for kind, form in ((2, ">BBHIq"), (3, ">BBHIqqq")):
        body = struct.pack(form, 1, kind, 0, 7, *[5] * (len(form) - 5))
        event = decode(body + big(zlib.crc32(body)))
        assert isinstance(event, Refusal)
        assert "big-endian" in event.detail


def test_a_bit_error_is_none_of_these() -> None:
    whole = LITTLE + little(zlib.crc32(LITTLE))
    for bit in range(16, 8 * len(whole)):
        damaged = bytearray(whole)
        damaged[bit // 8] ^= 1 << bit % 8
        event = decode(bytes(damaged))
        assert event == Refusal("crc", "the CRC-32 does not match the packet")


MESSAGES = {
    "text": (b"tick 12\r\n", "text, 'tick 12"),
    "text of 64 bytes": (b"attitude".ljust(63, b".") + b"\n", "text, 'attitude...."),
    "UTF-8": ("Lagequaternion für Kamera".encode(), "text, 'Lagequaternion"),
    "UTF-16": ("t_ns 12".encode("utf-16"), "UTF-16 text"),
    "UTF-16 without its mark": ("t_ns".encode("utf-16-le"), "UTF-16 text"),
    "UTF-16 of the other order": (b"\xfe\xff" + "t_ns".encode("utf-16-be"), "UTF-16 text"),
    "numbers of 16 bits": (struct.pack("<4H", 1, 0, 7, 0), "binary, 01 00 00 00 07 00 00 00"),
    "topic before JSON": (b'attitude {"t_ns": 1, "q": [1,0,0,0]}', "a part of its own"),
    "JSON array": (b'[{"t_ns": 1, "q": [1,0,0,0]}]', "one object for each attitude"),
    "pickle": (pickle.dumps({"t_ns": 1, "q": list(Q)}), "a Python pickle"),
    "JSON array with a name": (
        '[{"t_ns": 1, "q": [1,0,0,0], "of": "Münster"}]'.encode(),
        "one object for each attitude",
    ),
    "topic before JSON with a name": (
        'star {"t_ns": 1, "q": [1,0,0,0], "of": "Münster"}'.encode(),
        "send a topic as a part of its own",
    ),
    "MessagePack": (b"\x82\xa4t_ns\x01\xa1q\x94\x01\x00\x00\x00", "such as MessagePack"),
    "HTTP request": (b"POST /attitude HTTP/1.1\r\nHost: bench\r\n\r\n", "HTTP"),
    "HTTP answer": (b"HTTP/1.0 400 Bad Request\r\n\r\n", "HTTP"),
    "TLS": (b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc", "TLS"),
    "TLS, kind and version alone": (b"\x16\x03\x01", "TLS"),
    "TLS 1.2": (b"\x17\x03\x03\x00\x20", "TLS"),
    "TLS 1.3 as its drafts had it": (b"\x14\x03\x04\x00\x01\x01", "TLS"),
    "no TLS of this version": (b"\x16\x03\x05\x00\x01", "binary, 16 03 05 00 01"),
    "no kind of TLS record": (b"\x18\x03\x01\x00\x01", "binary, 18 03 01 00 01"),
    "six letters before binary": (b"hello!\x01\x02", "text before binary, 'hello!'"),
    "five letters before binary": (b"hello\x01\x02", "binary, 68 65 6c 6c 6f 01 02"),
    "ZeroMQ": (b"\xff" + bytes(8) + b"\x7f\x03\x00NULL", "ZeroMQ"),
    "NMEA": (b"$GPGGA,123519,4807.038,N*47\r\n", "NMEA"),
    "MAVLink 1": (b"\xfe\x09" + bytes(15), "a MAVLink frame"),
    "MAVLink 2": (b"\xfd\x09" + bytes(19), "a MAVLink frame"),
    "MAVLink 2, signed": (b"\xfd\x09\x01" + bytes(31), "a MAVLink frame"),
    "UBX": (b"\xb5\x62\x01\x07\x5c\x00", "UBX"),
    "COBS in a datagram": (
        frame(AttitudeSample(1, np.array([1.0, 0, 0, 0]))),
        "as on a serial line",
    ),
    "quaternion": (struct.pack("<4d", *Q), "a bare quaternion of little-endian"),
    "time and quaternion": (struct.pack(">q4d", 5, *HALVES), "a bare quaternion of big-endian"),
    "quaternion and rate": (struct.pack("<7d", *HALVES, 1, 2, 3), "a bare quaternion of little"),
    "time, quaternion and rate": (
        struct.pack("<q7d", 5, *HALVES, 1, 2, 3),
        "a bare quaternion of little-endian",
    ),
}


@pytest.mark.parametrize(("message", "words"), MESSAGES.values(), ids=MESSAGES)
def test_a_message_that_is_something_else_is_named(message: bytes, words: str) -> None:
    event = decode(message)
    assert isinstance(event, Refusal)
    assert event.telling
    assert words in event.detail


def test_a_packet_outside_any_frame_is_named_by_what_stands_around_it() -> None:
    packet = LITTLE + little(zlib.crc32(LITTLE))
    named = {
        packet: "a bare packet",
        b"\xc0" + packet + b"\xc0": "a packet in SLIP",
        b"\x05" + packet: "a bare packet",
        b"\xc0\x05" + packet: "a bare packet",
    }
    for data, what in named.items():
        found = unframed_packet(data)
        assert found is not None
        assert found.what == what
    assert unframed_packet(packet[:-1]) is None


LINES = {
    "text": (b"tick 12\r\n" * 20, "text, 'tick 12"),
    "JSON": (b'{"t_ns":1,"q":[1,0,0,0]}\n' * 8, "JSON, '{"),
    "no 0x00": (frame(AttitudeSample(1, np.array(Q)))[:-1] * 4, "COBS frames without an end"),
    "no 0x00, from the middle": (
        frame(AttitudeSample(1, np.array(Q)))[30:-1]
        + frame(AttitudeSample(1, np.array(Q)))[:-1] * 4,
        "without an end",
    ),
    "line ends": (
        (frame(AttitudeSample(1, np.array(Q))) + b"\r\n") * 3,
        "a line end before a frame",
    ),
    "text between": (b"\0tick 5\r\n" + frame(AttitudeSample(1, np.array(Q))), "text, 'tick 5"),
    "stuck": (b"\xff" * 300, "the byte 0xff"),
}


@pytest.mark.parametrize(("stream", "words"), LINES.values(), ids=LINES)
def test_a_serial_line_of_something_else_is_named(stream: bytes, words: str) -> None:
    events = [event for event, _ in StreamDecoder().feed(stream)]
    details = [event.detail for event in events if isinstance(event, Refusal)]
    assert any(words in detail for detail in details)


def test_the_reduced_form_of_cobs_is_named() -> None:
    body = LITTLE + little(zlib.crc32(LITTLE))
    for sequence in range(100):
        body = struct.pack("<" + FIELDS, 1, 1, 1, sequence, 5, *Q, 0.0, 0.0, 0.0)
        body += little(zlib.crc32(body))
        reduced = cobsr.encode(body)
        if len(reduced) < len(body) + 1:
            break
    event = decode_frame(reduced)
    assert isinstance(event, Refusal)
    assert "COBS/R" in event.detail


def test_any_bytes_have_a_likeness(rng: np.random.Generator) -> None:
    starts = [b"", b"{", b"$G", b"\x16\x03", b"\xfd", b"\x80\x04", b"\xff\xfe", bytes([1, 1])]
    for start in starts:
        for size in (*range(70), MAX_LOOKED_AT, 5000):
            data = start + rng.bytes(size)
            found = likeness(data)
            assert found.what
            assert len(found.what) < 200
            assert isinstance(decode(data), Refusal | AttitudeSample)


def test_json_is_named_as_json_on_a_line_that_takes_none() -> None:
    event = decode_frame(json.dumps({"t_ns": 1, "q": list(Q)}).encode() * 3)
    assert isinstance(event, Refusal)
    assert "COBS" in event.detail


@pytest.mark.parametrize("before", [b"", b" \r\n"])
def test_json_in_a_frame_is_told_where_it_is_taken(before):
    event = decode_frame(cobs.encode(before + json.dumps({"t_ns": 1, "q": list(Q)}).encode()))
    assert "send JSON over ZeroMQ or UDP" in event.detail
