"""The packet's laws (head of hilstar/attitude/wire/packet.py)."""

from __future__ import annotations

import json
import struct
import zlib

import numpy as np
import pytest

from hilstar.attitude.wire.packet import (
    MAX_JSON_BYTES,
    AttitudeSample,
    Refusal,
    Status,
    TimeReply,
    TimeRequest,
    decode,
    encode,
)

Q = (0.5, 0.5, -0.5, 0.5)
# struct characters of the types that protocol.toml names.
FORMATS = {"u8": "B", "u16": "H", "u32": "I", "i64": "q", "f32": "f", "f64": "d"}


def packet(
    *, version=1, kind=1, flags=1, sequence=7, t_ns=123, q=Q, rate=(0.1, -0.2, 0.3)
) -> bytes:
    """An attitude packet, put together from the design's section 4 alone."""
    body = struct.pack("<BBHIq4d3f", version, kind, flags, sequence, t_ns, *q, *rate)
    return body + struct.pack("<I", zlib.crc32(body))


def reason(message: bytes) -> str | None:
    event = decode(message)
    return event.reason if isinstance(event, Refusal) else None


def test_a_packet_made_elsewhere_is_understood():
    sample = decode(packet())
    assert isinstance(sample, AttitudeSample)
    assert (sample.t_ns, sample.sequence, sample.discontinuity) == (123, 7, False)
    assert sample.q_icrs_to_cam.tolist() == list(Q)
    assert sample.rate_cam_rad_s is not None
    assert sample.rate_cam_rad_s.tolist() == [float(np.float32(v)) for v in (0.1, -0.2, 0.3)]


def test_what_is_encoded_is_decoded(rng):
    for flags in range(50):
        q = rng.normal(size=4)
        q /= np.linalg.norm(q)
        rate = rng.normal(size=3).astype(np.float32).astype(np.float64) if flags % 2 else None
        sent = AttitudeSample(
            int(rng.integers(-(2**62), 2**62)), q, rate, int(rng.integers(2**32)), bool(flags % 3)
        )
        got = decode(encode(sent))
        assert isinstance(got, AttitudeSample)
        assert (got.t_ns, got.sequence, got.discontinuity) == (
            sent.t_ns,
            sent.sequence,
            sent.discontinuity,
        )
        # at most one rounding of the division by the norm
        assert np.abs(got.q_icrs_to_cam - q).max() <= 2.3e-16
        assert (got.rate_cam_rad_s is None) == (rate is None)
        assert rate is None or np.array_equal(got.rate_cam_rad_s, rate)


def test_flags_say_what_is_valid():
    silent = decode(packet(flags=2, rate=(float("nan"),) * 3))
    assert isinstance(silent, AttitudeSample)
    assert silent.rate_cam_rad_s is None
    assert silent.discontinuity


@pytest.mark.parametrize(("number", "expected"), [(0, 0), (1, 1), (254, 254), (255, 0)])
def test_the_upper_byte_of_flags_is_the_sender_s_number(number, expected):
    read = decode(packet(flags=number << 8 | 3))
    assert (read.sender, read.discontinuity) == (expected, True)
    for more in ("", '"sequence": 7, '):
        in_json = f'{{"t_ns": 1, {more}"q": [1, 0, 0, 0], "sender": {number}}}'
        assert decode(in_json.encode()).sender == expected
    assert decode(encode(read)).sender == expected


@pytest.mark.parametrize("number", [-1, 256])
def test_a_sender_s_number_that_no_packet_can_hold_is_refused(number):
    in_json = f'{{"t_ns": 1, "q": [1, 0, 0, 0], "sender": {number}}}'
    assert decode(in_json.encode()) == Refusal("format", f"sender {number}; write 1 to 254, or 0")


def test_every_single_bit_error_is_refused():
    good = packet()
    for bit in range(8 * len(good)):
        bad = bytearray(good)
        bad[bit // 8] ^= 1 << bit % 8
        assert reason(bytes(bad)) in ("crc", "format"), f"bit {bit}"


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        (packet(q=(float("nan"), 0, 0, 1)), "nan"),
        (packet(q=(float("inf"), 0, 0, 1)), "nan"),
        (packet(rate=(float("nan"), 0, 0)), "nan"),
        (packet(q=(1.0011, 0, 0, 0)), "norm"),
        (packet(q=(0.9989, 0, 0, 0)), "norm"),
        (packet(q=(0, 0, 0, 0)), "norm"),
        (packet(version=2), "format"),
        (packet(kind=2), "format"),
        (packet()[:63], "format"),
        (packet() + b"\0", "format"),
        (b"", "format"),
        (b"hello", "format"),
        (b"{", "format"),
        (b'{"t_ns": 1}', "format"),
        (b'{"t_ns": "1", "q": [1,0,0,0]}', "format"),
        (b'{"t_ns": 1, "q": [1,0,0]}', "format"),
        (b'{"t_ns": 1, "q": [NaN,0,0,1]}', "nan"),
        (b'{"t_ns": 1, "q": [2,0,0,0]}', "norm"),
        (b'{"t_ns": 1, "q": [1,0,0,0], "rate": [1e200,0,0]}', "format"),
        (b'{"t_ns": 9223372036854775808, "q": [1,0,0,0]}', "format"),
        (b'{"t_ns": 1, "q": [1,0,0,0], "x": "' + b"a" * 5000 + b'"}', "format"),
        (b'{"q":' + b"[" * 2000, "format"),
    ],
)
def test_what_is_no_attitude_is_refused_with_its_reason(message, expected):
    assert reason(message) == expected


@pytest.mark.parametrize("norm", [0.9991, 1.0009])
def test_a_norm_within_a_thousandth_is_taken_and_mended(norm):
    sample = decode(packet(q=(norm, 0, 0, 0)))
    assert isinstance(sample, AttitudeSample)
    assert sample.q_icrs_to_cam.tolist() == [1, 0, 0, 0]


def test_the_json_form_is_understood():
    sample = decode(json.dumps({"t_ns": 5, "q": Q, "rate": [1, 2, 3]}).encode())
    assert isinstance(sample, AttitudeSample)
    assert sample.t_ns == 5
    assert sample.rate_cam_rad_s is not None
    assert sample.rate_cam_rad_s.tolist() == [1, 2, 3]
    bare = decode(b' {"t_ns": 5, "q": [1, 0, 0, 0], "note": "extra keys are no harm"}')
    assert isinstance(bare, AttitudeSample)
    assert bare.rate_cam_rad_s is None


def test_json_of_the_largest_size_is_taken_and_a_byte_more_is_not():
    whole = b'{"t_ns": 5, "q": [1, 0, 0, 0]}'.ljust(MAX_JSON_BYTES)
    assert isinstance(decode(whole), AttitudeSample)
    longer = decode(whole + b" ")
    assert longer == Refusal(
        "format", f"more than {MAX_JSON_BYTES} bytes of JSON; send an attitude alone"
    )


@pytest.mark.parametrize(
    ("q", "unset"),
    [
        ("[NaN, NaN, NaN, NaN]", True),
        ("[0, 0, 0, 0]", True),
        ("[Infinity, 0, 0, 1]", False),
        ("[0, 0, 0, 0.5]", False),
    ],
)
def test_zeros_and_nan_are_an_estimator_s_that_has_not_run_and_nothing_else_is(q, unset):
    event = decode(f'{{"t_ns": 1, "q": {q}}}'.encode())
    assert isinstance(event, Refusal)
    assert event.unset == unset


def test_no_bytes_raise(rng):
    """20 000 random and mutated messages: an event each, and no sample whose CRC is wrong."""
    good = packet()
    for _ in range(20_000):
        if rng.random() < 0.5:
            message = rng.bytes(int(rng.integers(0, 130)))
        else:
            mutated = bytearray(good if rng.random() < 0.5 else b'{"t_ns": 5, "q": [1, 0, 0, 0]}')
            for _ in range(int(rng.integers(1, 4))):
                mutated[int(rng.integers(len(mutated)))] = int(rng.integers(256))
            message = bytes(mutated)
        event = decode(message)
        if isinstance(event, AttitudeSample) and message[:1] != b"{" and b"{" not in message[:16]:
            assert zlib.crc32(message[:60]) == struct.unpack_from("<I", message, 60)[0]


def test_every_other_kind_comes_back_as_it_was():
    for sent in (
        TimeRequest(5, -(2**63)),
        TimeReply(2**32 - 1, 1, 2**63 - 1, -3),
        Status(0xFFFF, 7, -5, -1, 8, 9, 10),
    ):
        assert decode(encode(sent)) == sent


def test_a_status_of_a_clock_at_the_end_of_its_range_is_sent_all_the_same():
    beyond = Status(0, -1, 2**63 + 5, -(2**64), 2**32 + 1, 2**32 + 2, 2**32 + 3)
    assert decode(encode(beyond)) == Status(0, 2**32 - 1, 2**63 - 1, -(2**63), 1, 2, 3)


def test_another_kind_is_refused_for_its_crc_and_its_length():
    whole = encode(TimeReply(1, 2, 3, 4))
    assert reason(whole[:-1] + bytes([whole[-1] ^ 1])) == "crc"
    assert reason(whole[:-1]) == "format"
    assert reason(whole + b"\0") == "format"
    assert reason(bytes(36)) == "format"


def test_a_packet_with_a_flipped_bit_tells_neither_what_was_sent_nor_of_no_attitude():
    message = bytearray(packet())
    message[20] ^= 1
    event = decode(bytes(message))
    assert event == Refusal("crc", event.detail)
    assert (event.telling, event.unset) == (False, False)
