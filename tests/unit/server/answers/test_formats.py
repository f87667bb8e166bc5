"""Trackers' bytes to answers: each framing in closed form, however it is cut, and never by a
damaged frame.
"""

from __future__ import annotations

import struct
import sys
import zlib
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from cobs import cobs

from hilstar.attitude.wire import protocol
from hilstar.attitude.wire.packet import AnswerPacket, encode, framed
from hilstar.basics.errors import InputError
from hilstar.basics.rotation import (
    angle_between_rad,
    conjugate,
    from_radec_roll_deg,
    from_rotation_vector,
    multiply,
)
from hilstar.server.answers.answer import Answer
from hilstar.server.answers.explain import byte_lines, hex_line, lines_of, under_conventions
from hilstar.server.answers.formats import (
    MAX_KEPT_BYTES,
    AnswerDecoder,
    FrameDecoder,
    RefusedAnswer,
    raw_number,
    reported_stars,
)
from hilstar.server.bench.config.answers import AnswersSettings, FrameField, check_answers
from tests.support.refusals import refusal

Q = from_radec_roll_deg(283.021, 35.349, 30.0)
SCALE = 2.0**-31
ROUNDED_RAD = 4 * SCALE  # a quaternion of int32
FIELDS: list[dict[str, Any]] = [
    {"name": "t_s", "at": 4, "type": "u32be"},
    {"name": "t_sub", "at": 8, "type": "u16be", "scale": 2.0**-16},
    *(
        {"name": name, "at": 10 + 4 * k, "type": "i32be", "scale": SCALE}
        for k, name in enumerate(("qx", "qy", "qz", "qw"))
    ),
    {"name": "valid", "at": 26, "type": "u8", "mask": 1},
    {"name": "mode", "at": 26, "type": "u8", "mask": 0x30},
    {"name": "stars", "at": 27, "type": "u8"},
    {"name": "wx", "at": 28, "type": "i24be", "scale": 1e-6},
    {"name": "wy", "at": 31, "type": "i24be", "scale": 1e-6},
    {"name": "wz", "at": 34, "type": "i24be", "scale": 1e-6},
]
BODY_BYTES = 37
Q_NAMES = ("qw", "qx", "qy", "qz")
# The check values of 123456789 in the catalogue of parametrised CRC algorithms, and by hand.
CHECKS = {
    "crc16-ccitt-false": 0x29B1,
    "crc16-xmodem": 0x31C3,
    "crc32": 0xCBF43926,
    "sum8": 0xDD,
    "xor8": 0x31,
}


def settings_of(**keys: Any) -> AnswersSettings:
    settings = msgspec.convert(
        {"source": "udp", "format": "frame", "fields": FIELDS, **keys}, AnswersSettings
    )
    check_answers(settings)
    return settings


def decoder_of(*, messages: bool = False, mounted: Any = None, **keys: Any) -> AnswerDecoder:
    return AnswerDecoder(settings_of(**keys), mounted, messages)


def crc16(data: bytes, value: int = 0xFFFF) -> int:
    """CRC-16 of the polynomial 0x1021, bit by bit."""
    for byte in data:
        value ^= byte << 8
        for _ in range(8):
            value = (value << 1 ^ (0x1021 if value & 0x8000 else 0)) & 0xFFFF
    return value


def body_of(q: np.ndarray = Q, seconds: int = 1000, valid: int = 1) -> bytes:
    numbers = struct.pack(">4i", *(round(part / SCALE) for part in (*q[1:], q[0])))
    rates = b"".join(int(rate).to_bytes(3, "big", signed=True) for rate in (1, -2, 300_000))
    return (
        b"\x1a\xcf\x21\x27"
        + struct.pack(">IH", seconds, 0x8000)
        + numbers
        + bytes([valid | 0x20, 12])
        + rates
    )


def sealed(body: bytes) -> bytes:
    return body + struct.pack(">H", crc16(body))


def slip(body: bytes) -> bytes:
    return body.replace(b"\xdb", b"\xdb\xdd").replace(b"\xc0", b"\xdb\xdc") + b"\xc0"


def ccsds(body: bytes) -> bytes:
    packet = struct.pack(">HHH", 0x0812, 0xC000, len(body) + 2 - 1) + body
    return packet + struct.pack(">H", crc16(packet))


SYNC = {
    "framing": "sync",
    "sync_hex": "1A CF",
    "length": {"at": 3, "type": "u8"},
    "checksum": "crc16-ccitt-false",
}
CCSDS_FIELDS = [{**field, "at": field["at"] + 6} for field in FIELDS]
FRAMINGS: dict[str, tuple[dict[str, Any], Any]] = {
    "sync": (SYNC, sealed),
    "slip": ({"framing": "slip", "checksum": "crc16-ccitt-false"}, lambda body: slip(sealed(body))),
    "cobs": (
        {"framing": "cobs", "checksum": "crc16-ccitt-false"},
        lambda body: cobs.encode(sealed(body)) + b"\0",
    ),
    "fixed": (
        {"framing": "fixed", "length": BODY_BYTES + 2, "checksum": "crc16-ccitt-false"},
        sealed,
    ),
    "ccsds": ({"framing": "ccsds", "checksum": "crc16-ccitt-false", "fields": CCSDS_FIELDS}, ccsds),
}


def answers(found: list[Answer | RefusedAnswer]) -> list[Answer]:
    return [each for each in found if isinstance(each, Answer)]


@pytest.mark.parametrize("name", FRAMINGS)
def test_a_declared_frame_gives_every_field(name):
    keys, framed_as = FRAMINGS[name]
    (found,) = answers(decoder_of(**keys).feed(5, framed_as(body_of())))
    assert found.q_icrs_to_cam is not None
    assert found.rate_cam_rad_s is not None
    assert angle_between_rad(found.q_icrs_to_cam, Q) < ROUNDED_RAD
    assert found.rate_cam_rad_s == pytest.approx([1e-6, -2e-6, 0.3], rel=1e-12)
    assert (found.host_ns, found.t_ns, found.valid, found.mode, found.star_count) == (
        5,
        1_000_500_000_000,
        True,
        "2",
        12,
    )


def test_a_field_beyond_a_frame_is_told_by_the_byte_that_lacks_counted_from_0():
    body = bytes(range(8))
    assert raw_number(body, 4, "u32be") == 0x04050607
    with pytest.raises(IndexError, match=r"^byte 8 of 8$"):
        raw_number(body, 5, "u32be")


def test_a_fraction_beside_the_seconds_of_an_epoch_keeps_its_nanoseconds():
    """32769 / 65536 s are 500 015 258.8 ns; a float of 1.7e18 ns is known to 256."""
    keys, framed_as = FRAMINGS["fixed"]
    body = body_of(seconds=1_700_000_000).replace(b"\x80\x00", b"\x80\x01", 1)
    (found,) = answers(decoder_of(**keys).feed(5, framed_as(body)))
    assert found.t_ns == 1_700_000_000_500_015_259


@pytest.mark.parametrize("name", FRAMINGS)
def test_however_a_stream_is_cut_the_answers_are_the_same(name, rng):
    keys, framed_as = FRAMINGS[name]
    frames = [framed_as(body_of(seconds=k)) for k in range(20)]
    stream = b"\0" + b"".join(frame + rng.bytes(4 * (k % 3 == 0)) for k, frame in enumerate(frames))
    whole = [answer.t_ns for answer in answers(decoder_of(**keys).feed(0, stream))]
    # garbage that looks like a header, or hides a delimiter, takes frames after it along
    assert len(whole) >= 4
    bits, decoder = [], decoder_of(**keys)
    for byte in stream:
        bits += answers(decoder.feed(0, bytes([byte])))
    assert [answer.t_ns for answer in bits] == whole


def test_of_damaged_frames_in_a_row_each_is_refused_once_and_whole():
    """Without sync bytes each byte of them is tried as a frame's first, in silence."""
    keys, framed_as = FRAMINGS["fixed"]
    good = [framed_as(body_of(seconds=k)) for k in range(4)]
    damaged = [frame[:20] + bytes([frame[20] ^ 0x55]) + frame[21:] for frame in good]
    found = decoder_of(**keys).feed(5, b"".join([*damaged, good[3]]))
    assert [each.raw for each in found] == [*damaged, good[3]]
    assert len(answers(found)) == 1 and answers(found)[0] is found[-1]


@pytest.mark.parametrize("name", FRAMINGS)
def test_no_damaged_frame_is_taken_for_an_answer(name, rng):
    """Some 100 000 mutated bytes of each framing: a wrong answer would need a CRC-16 that is
    right by chance, 1 in 65 536.
    """
    keys, framed_as = FRAMINGS[name]
    decoder, good, taken = decoder_of(**keys), framed_as(body_of()), 0
    for _ in range(2500):
        mutant = bytearray(good)
        for _ in range(int(rng.integers(1, 5))):
            place = int(rng.integers(len(mutant)))
            mutant[place] ^= int(rng.integers(1, 256))
        if rng.random() < 0.3:
            mutant[int(rng.integers(len(mutant))) :] = rng.bytes(int(rng.integers(20)))
        for found in answers(decoder.feed(0, bytes(mutant))):
            taken += 1
            # the frame as it was, of changes that undid each other
            assert found.t_ns == 1_000_500_000_000
    kept: bytearray = decoder._cutter._kept  # type: ignore[union-attr]
    assert taken < 250
    assert len(kept) <= MAX_KEPT_BYTES
    late = decoder.feed(10**9, b"\0\xc0" + 60 * b"\0" + good * 3) + decoder.feed(2 * 10**9, good)
    # What looks like a header waits for a pause; what stands before a delimiter goes with the
    # garbage.
    assert [found.t_ns for found in answers(late)][-3:] == [1_000_500_000_000] * 3


@pytest.mark.parametrize("checksum", CHECKS)
def test_each_checksum_has_its_check_value(checksum):
    keys = {"framing": "fixed", "length": 60, "checksum": checksum, "checksum_at": 9}
    decoder = decoder_of(**keys)
    size = {"crc32": 4, "sum8": 1, "xor8": 1}.get(checksum, 2)
    right = CHECKS[checksum].to_bytes(size, "big")
    assert decoder.frames.fault(b"123456789" + right) == ""
    assert decoder.frames.fault(b"123456788" + right)
    assert zlib.crc32(b"123456789") == CHECKS["crc32"]


def test_conventions_are_undone():
    body_to_cam = np.array([0.5, 0.5, 0.5, 0.5])
    for scalar in ("first", "last"):
        for direction in ("icrs_to_cam", "cam_to_icrs"):
            for frame in ("cam", "body"):
                sent = Q if frame == "cam" else multiply(conjugate(body_to_cam), Q)
                sent = sent if direction == "icrs_to_cam" else conjugate(sent)
                sent = sent if scalar == "first" else np.roll(sent, -1)
                convention = {"scalar": scalar, "direction": direction, "frame": frame}
                decoder = AnswerDecoder(
                    settings_of(format="json", fields=[], convention=convention),
                    tuple(body_to_cam.tolist()),
                    True,
                )
                (found,) = answers(
                    decoder.feed(0, msgspec.json.encode({"t_ns": 1, "q": sent.tolist()}))
                )
                assert found.q_icrs_to_cam is not None
                assert angle_between_rad(found.q_icrs_to_cam, Q) < 1e-7
                marked = [
                    each.convention for each in under_conventions(found, decoder, Q) if each.matches
                ]
                assert [msgspec.to_builtins(each) for each in marked] == [convention]


def test_a_wrong_convention_is_named_with_what_to_write():
    decoder = decoder_of(format="json", fields=[])
    (found,) = decoder.feed(0, msgspec.json.encode({"q": np.roll(Q, -1).tolist()}) + b"\n")
    said = "\n".join(lines_of(found, decoder, Q))
    assert (
        'write [answers] convention = { scalar = "last", direction = "icrs_to_cam", frame = "cam" }'
        in said
    )
    assert "no convention matches" in "\n".join(
        lines_of(found, decoder, from_radec_roll_deg(10.0, 80.0, 5.0))
    )
    # an angle over a degree in degrees, a smaller one in arcsec
    for off_deg, angle in ((1.5, "1.50 deg"), (0.5, "1800.0 arcsec"), (1.01, "1.01 deg")):
        turned = multiply(from_rotation_vector(np.radians([0.0, 0.0, off_deg])), Q)
        assert f"  {angle} from what is shown" in "\n".join(lines_of(found, decoder, turned))


@pytest.mark.parametrize(("off_deg", "matches"), [(4.9, True), (5.1, False)])
def test_a_tracker_may_be_five_degrees_off_and_its_convention_is_told(off_deg, matches):
    """At this attitude every other convention is over 100 degrees away."""
    decoder = decoder_of(messages=True, format="json", fields=[])
    shown = from_radec_roll_deg(10.0, 0.0, 80.0)
    sent = multiply(from_rotation_vector(np.radians([off_deg, 0.0, 0.0])), shown)
    (found,) = decoder.feed(0, msgspec.json.encode({"q": sent.tolist()}))
    readings = under_conventions(found, decoder, shown)
    assert [reading.matches for reading in readings] == [matches, False, False, False]


def test_where_two_conventions_read_one_attitude_alike_neither_is_told():
    """No turn at all is its own inverse, to the last bit."""
    decoder = decoder_of(messages=True, format="json", fields=[])
    (found,) = decoder.feed(0, b'{"q": [1, 0, 0, 0]}')
    readings = under_conventions(found, decoder, np.array([1.0, 0.0, 0.0, 0.0]))
    assert [reading.off_rad for reading in readings][:2] == [0.0, 0.0]
    assert not any(reading.matches for reading in readings)


def test_a_packet_is_taken_over_every_road_and_another_kind_is_not():
    packet = AnswerPacket(7, 1 | 2 | 8, 42, tuple(Q.tolist()), (0.0, 0.25, 0.0), 9)
    for messages, sent in ((True, encode(packet)), (False, b"\0" + framed(encode(packet)))):
        (found,) = answers(decoder_of(messages=messages, format="packet", fields=[]).feed(0, sent))
        assert (found.t_ns, found.star_count, found.mode, found.valid) == (42, 9, "tracking", True)
    (lost,) = answers(
        decoder_of(messages=True, format="packet", fields=[]).feed(
            0, encode(AnswerPacket(8, 4, 43, (0.0, 0.0, 0.0, 0.0)))
        )
    )
    assert (lost.valid, lost.q_icrs_to_cam, lost.mode) == (False, None, "lost in space")


REFUSED_JSON = {
    b'{"q": [1, 0, 0]}': "format",
    b'{"q": [2, 0, 0, 0]}': "norm",
    b'{"q": [NaN, 0, 0, 0]}': "nan",
    b'{"q": [1, 0, 0, 0], "t_ns": 1e300}': "format",
    b"[" * 5000: "format",
    b"\xff\xfe": "format",
}


@pytest.mark.parametrize("line", REFUSED_JSON)
def test_a_wrong_json_answer_is_refused_with_its_reason(line):
    (found,) = decoder_of(format="json", fields=[]).feed(0, line + b"\n")
    assert isinstance(found, RefusedAnswer)
    assert found.reason == REFUSED_JSON[line]


@pytest.mark.parametrize(
    ("count", "kept"), [(0, 0), (12, 12), (1_000_000, 1_000_000), (1_000_001, None), (-1, None)]
)
def test_an_absurd_count_of_stars_is_left_out_of_its_answer(count, kept):
    said = msgspec.json.encode({"q": [1, 0, 0, 0], "stars": count})
    (found,) = answers(decoder_of(messages=True, format="json", fields=[]).feed(0, said))
    assert found.star_count == kept


@pytest.mark.parametrize(
    ("row", "hip", "width_px"),
    [
        ([1, 2, 3, 1, 1e-3], 1, 1e-3),
        ([1, 2, 3, 2**31 - 1, 1000.0], 2**31 - 1, 1000.0),
        ([1, 2, 3, 0, 0.0], None, None),
        ([1, 2, 3, 2**31, 1000.1], None, None),
        ([1, 2, 3, -5, -1.0], None, None),
    ],
)
def test_a_number_or_width_beyond_its_limits_is_left_out_of_its_star(row, hip, width_px):
    (star,) = reported_stars([row])
    assert (star.hip, star.width_px, star.dn) == (hip, width_px, 3)


@pytest.mark.parametrize(
    ("raw", "field", "wanted"),
    [
        # (raw shifted down to its mask's lowest bit) x scale + add, by hand
        ("a8", {"type": "u8", "mask": 0x38, "scale": 2.0, "add": 3.0}, 13),
        ("a8", {"type": "u8", "mask": 0x80}, 1),
        ("012c", {"type": "u16be", "scale": 0.5, "add": 10.0}, 160.0),
        ("2c01", {"type": "u16le", "scale": -2.0, "add": 0.25}, -599.75),
        ("feffff", {"type": "i24le"}, -2),
        ("fffffe", {"type": "u24be", "add": -1.0}, 0xFFFFFD),
        ("000000c0", {"type": "f32le", "scale": 3.0, "add": 1.0}, -5.0),
        ("c004000000000000", {"type": "f64be"}, -2.5),
        ("ffffffffffffff7f", {"type": "i64le", "add": -5.0}, 2**63 - 6),  # no float holds that
    ],
)
def test_a_field_s_number_is_scaled_and_then_added_to(raw, field, wanted):
    decoder = FrameDecoder(settings_of(framing="slip"))
    declared = msgspec.convert({"name": "t_ns", "at": 1, **field}, FrameField)
    value = decoder.value(b"\x55" + bytes.fromhex(raw), declared)
    assert value == wanted and type(value) is type(wanted)


@pytest.mark.parametrize(
    ("flags", "mode"),
    [
        (protocol.ANSWER_TRACKING, "tracking"),
        (protocol.ANSWER_LOST_IN_SPACE, "lost in space"),
        (protocol.ANSWER_TRACKING | protocol.ANSWER_TOO_FEW_STARS, "too few stars"),
        (protocol.ANSWER_LOST_IN_SPACE | protocol.ANSWER_TRACKING, "lost in space"),
        # whoever is blinded sees few stars, too
        (protocol.ANSWER_BLINDED | protocol.ANSWER_TOO_FEW_STARS, "blinded"),
        (0, ""),
    ],
)
def test_of_several_flags_the_cause_is_the_mode(flags, mode):
    packet = encode(AnswerPacket(8, flags, 43, tuple(Q.tolist())))
    (found,) = answers(decoder_of(messages=True, format="packet", fields=[]).feed(0, packet))
    assert found.mode == mode


def test_a_checksum_may_leave_out_a_frame_s_first_bytes():
    keys = {"framing": "fixed", "length": 60, "checksum": "sum8", "checksum_at": 11}
    decoder = decoder_of(**keys, checksum_from=2)
    assert decoder.frames.fault(b"\xff\x07123456789\xdd") == ""
    assert "is 0xde, and 0xdd by the bytes" in decoder.frames.fault(b"\xff\x07123456789\xde")
    assert decoder.frames.fault(b"\xff\x07123456789") == "too short for its checksum: 11 bytes"


def test_space_packets_of_another_version_are_none():
    """133.0-B: the upper three bits of the primary header are 0."""
    keys, framed_as = FRAMINGS["ccsds"]
    for version in range(8):
        packet = bytearray(framed_as(body_of())[:-2])
        packet[0] |= version << 5
        found = decoder_of(**keys).feed(5, sealed(bytes(packet)))
        assert len(answers(found)) == (version == 0)


def test_what_follows_an_endless_line_or_frame_is_read():
    said = msgspec.json.encode({"t_ns": 7, "q": [1, 0, 0, 0]}) + b"\n"
    lines = decoder_of(format="json", fields=[]).feed(0, b" " * 70_000 + b"\n" + said + said)
    assert [getattr(each, "reason", "") for each in lines] == ["framing", "", ""]
    # a length of 5000 bytes is none, and is not waited for
    keys = {**SYNC, "length": {"at": 2, "type": "u16be"}}
    framed = b"\x1a\xcf" + struct.pack(">H", BODY_BYTES + 2) + body_of()[4:]
    found = decoder_of(**keys).feed(0, b"\x1a\xcf" + struct.pack(">H", 5000) + sealed(framed))
    assert len(answers(found)) == 1
    assert found[0].detail == "a length that no frame has"
    # no frame, whose bytes would be fields
    assert lines_of(found[0], decoder_of(**keys), Q) == [f"  {found[0].raw.hex(' ')}"]


@pytest.mark.parametrize(("source", "taken"), [("file", 1), ("udp", 0)])
def test_a_pause_within_a_frame_ends_it_but_in_a_file(source, taken):
    keys, framed_as = FRAMINGS["sync"]
    road = {"path": "a.bin"} if source == "file" else {}
    decoder = decoder_of(**keys, source=source, **road)
    frame = framed_as(body_of())
    found = decoder.feed(10**9, frame[:20]) + decoder.feed(3 * 10**9, frame[20:])
    assert len(answers(found)) == taken


def test_an_answer_s_bytes_are_explained_field_by_field():
    fields = [
        {"name": "t_ns", "at": 0, "type": "u16be", "add": 1.0},
        *(
            {"name": name, "at": 2 + k, "type": "i8", "scale": 1 / 64}
            for k, name in enumerate(Q_NAMES)
        ),
        {"name": "stars", "at": 6, "type": "u8", "scale": 2.0, "add": -1.0},
    ]
    keys = {"framing": "fixed", "length": 13, "checksum": "crc16-xmodem"}
    # told in the order of the bytes, whatever that of the file
    decoder = decoder_of(**keys, fields=fields[::-1], messages=True)
    body = bytes([1, 2, 32, 0xE0, 32, 32, 5, 0, 0, 0, 0])
    raw = body + struct.pack(">H", crc16(body, 0))
    (found,) = answers(decoder.feed(0, raw))
    lines = lines_of(found, decoder, None)
    seal = raw[11:].hex(" ")
    assert lines[:3] == [
        f"  01 02 20 e0 20 20 05 00 00 00 00 {seal}",
        f"  bytes  11 to  12  {seal:<24} checksum: crc16-xmodem, right",
        f"  bytes   0 to   1  {'01 02':<24} t_ns  = 259  (u16be, + 1)",
    ]
    assert lines[3] == f"  bytes   2 to   2  {'20':<24} qw    = 0.5  (i8, x 0.015625)"
    assert lines[7] == f"  bytes   6 to   6  {'05':<24} stars = 9  (u8, x 2, + -1)"
    assert len(lines) == 8 + 4  # and a line for each convention


def test_a_frame_whose_scalar_is_last_has_other_names_of_its_fields_and_no_scalar_last():
    """`[answers]` refuses scalar = "last" of a frame, so it is not what to write there."""
    fields = [
        {"name": name, "at": 4 * k, "type": "i32be", "scale": SCALE}
        for k, name in enumerate(Q_NAMES)
    ]
    decoder = decoder_of(messages=True, framing="fixed", length=16, fields=fields)
    last = np.roll(Q, -1)
    (found,) = decoder.feed(0, struct.pack(">4i", *(round(part / SCALE) for part in last)))
    *_, convention, fields_line = lines_of(found, decoder, Q)
    assert convention == (
        '  write [answers] convention = { scalar = "first", direction = "icrs_to_cam", frame ='
        ' "cam" }'
    )
    assert fields_line.endswith("in the order in which they now are qw, qx, qy, qz")


def test_a_long_answer_s_first_96_bytes_are_shown_with_how_many_there_are():
    assert hex_line(b"\xa5" * 96) == " ".join(["a5"] * 96)
    assert hex_line(b"\xa5" * 97) == " ".join(["a5"] * 96) + " ... (97 bytes)"


@pytest.mark.parametrize(("at", "span"), [(0, "  0 to   1"), (6, "  6 to   7"), (-2, " 10 to  11")])
def test_a_checksum_is_told_where_it_stands(at, span):
    fields = [{"name": "t_ns", "at": 2, "type": "u16be"}]
    fields += [
        {"name": name, "at": 4 + k, "type": "i8", "scale": 1 / 64} for k, name in enumerate(Q_NAMES)
    ]
    keys = {"framing": "fixed", "length": 12, "checksum": "crc16-xmodem", "checksum_at": at}
    decoder = decoder_of(**keys, fields=fields, messages=True)
    raw = bytes(range(0x20, 0x2C))
    seal = raw[at % 12 : at % 12 + 2].hex(" ")
    (line,) = (line for line in byte_lines(raw, decoder) if "checksum: " in line)
    assert line.startswith(f"  bytes {span}  {seal} ")


@pytest.mark.parametrize(("off_deg", "matching"), [(0.05, 1), (0.2, 0)])
def test_a_convention_is_told_only_where_no_other_is_nearly_as_near(off_deg, matching):
    """A degree from the axes the camera's and the sky's quaternion are two degrees apart."""
    decoder = decoder_of(messages=True, format="json", fields=[])
    shown = from_rotation_vector(np.radians([1.0, 0.0, 0.0]))
    sent = from_rotation_vector(np.radians([1.0 + off_deg, 0.0, 0.0]))
    (found,) = decoder.feed(0, msgspec.json.encode({"q": sent.tolist()}))
    readings = under_conventions(found, decoder, shown)
    assert sum(reading.matches for reading in readings) == matching


def test_centroids_that_are_none_are_left_out():
    said = b'{"q":[1,0,0,0],"centroids":[[1.5,2.5,300,11767],[null,1],[3],[4,5]]}\n'
    (found,) = answers(decoder_of(format="json", fields=[]).feed(0, said))
    assert [tuple(star) for star in found.centroids] == [
        (1.5, 2.5, 300.0, 11767, None),
        (4.0, 5.0, None, None, None),
    ]


def test_a_python_function_decodes_and_its_faults_are_counted(tmp_path: Path):
    (tmp_path / "my_tracker.py").write_text(
        "def decode(data):\n"
        "    if data == b'boom':\n"
        "        raise KeyError('x')\n"
        "    yield {'t_ns': len(data), 'q': [0, 1, 0, 0], 'stars': 4}\n"
        "    yield {'q': 'none'}\n"
    )
    decoder = AnswerDecoder(
        settings_of(format="python:my_tracker:decode", fields=[]), None, False, tmp_path
    )
    good, bad = decoder.feed(0, b"abc")
    assert isinstance(good, Answer)
    assert (good.t_ns, good.star_count) == (3, 4)
    (raised,) = decoder.feed(0, b"boom")
    assert [getattr(each, "reason", "") for each in (bad, raised)] == ["format", "python"]
    sys.modules.pop("my_tracker")
    with pytest.raises(InputError, match="name a module beside the bench file"):
        AnswerDecoder(
            settings_of(format="python:no_such_module:decode", fields=[]), None, False, tmp_path
        )


def test_a_module_that_ends_the_program_is_refused_in_one_line(tmp_path):
    (tmp_path / "exits.py").write_text("raise SystemExit(3)\n")
    settings = settings_of(format="python:exits:decode", fields=[])
    with pytest.raises(InputError, match=r"exits cannot be imported \(SystemExit: 3\)"):
        AnswerDecoder(settings, None, False, tmp_path)


@pytest.mark.parametrize(
    "name",
    ["os:system", "subprocess:run", "numpy:load", "os.path:join", "json:loads", "builtins:exec"],
)
def test_a_function_of_a_module_that_is_not_beside_the_bench_file_is_refused(
    tmp_path: Path, name: str
):
    module, _, _ = name.partition(":")
    with pytest.raises(InputError, match="stands in"):
        AnswerDecoder(settings_of(format=f"python:{name}", fields=[]), None, False, tmp_path)
    # nor does a file of that name let it in
    (tmp_path / f"{module.partition('.')[0]}.py").write_text("")
    with pytest.raises(InputError, match="is the name of a module of Python or of hilstar"):
        AnswerDecoder(settings_of(format=f"python:{name}", fields=[]), None, False, tmp_path)


def test_a_package_that_is_trusted_may_be_named_and_only_that(tmp_path: Path):
    AnswerDecoder(
        settings_of(format="python:json:loads", fields=[], trust=["json"]), None, False, tmp_path
    )
    with pytest.raises(InputError, match="stands in"):
        AnswerDecoder(
            settings_of(format="python:os:system", fields=[], trust=["json"]), None, False, tmp_path
        )


def test_modules_of_one_name_in_two_folders_are_two(tmp_path: Path):
    for k in range(2):
        (folder := tmp_path / str(k)).mkdir()
        (folder / "same_name.py").write_text(
            "import beside\ndef decode(data): return [{'t_ns': beside.T, 'q': [1, 0, 0, 0]}]"
        )
        (folder / "beside.py").write_text("T = 7")
        decoder = AnswerDecoder(
            settings_of(format="python:same_name:decode", fields=[]), None, False, folder
        )
        assert [each.t_ns for each in decoder.feed(0, b"")] == [7]


WRONG = {
    "needs framing": {},
    "needs sync_hex": {"framing": "sync", "length": 39},
    "needs length": {"framing": "fixed"},
    "ends with byte 36": {"framing": "fixed", "length": 36},
    "lacks qw": {"framing": "slip", "fields": [{"name": "qx", "at": 0, "type": "f32"}]},
    "twice": {"framing": "slip", "fields": [*FIELDS, FIELDS[0]]},
    "u8, i8, u16": {"framing": "slip", "fields": [{**FIELDS[0], "type": "f16"}, *FIELDS[1:]]},
    'port is for source = "serial" or "udp"': {
        "framing": "slip",
        "source": "file",
        "port": "/dev/x",
        "path": "x",
    },
    "needs connect": {"framing": "slip", "poll_hex": "00"},
    "one of them": {"framing": "slip", "source": "tcp"},
    'is for format = "frame"': {"format": "json"},
    "python:MODULE:FUNCTION": {"format": "xml", "fields": []},
    "allow does not say": {"framing": "slip", "bind": "0.0.0.0:7000"},
}


@pytest.mark.parametrize("said", WRONG)
def test_a_wrong_declaration_is_refused_with_what_to_write(said):
    assert said in refusal(settings_of, **WRONG[said])
