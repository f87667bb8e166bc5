"""The C header against the vectors and against Python."""

from __future__ import annotations

import json
import math
import os
import shutil
import struct
import subprocess
import zlib
from pathlib import Path

import numpy as np
import pytest
from cobs import cobs

from hilstar.attitude.wire.packet import DELIMITER, MAX_FRAME_BYTES, TimeRequest, frame
from tests.support.benches import ROOT
from tests.support.compilers import STRICT, compiled
from tests.support.waiting import PATIENCE_S

FOLDER = ROOT / "firmware_protocol"
HEADER = ("-I", FOLDER)
VECTORS = json.loads((FOLDER / "vectors.json").read_text())
ACCEPTED = [vector for vector in VECTORS if "refused" not in vector]
REFUSED = [vector for vector in VECTORS if "refused" in vector]
SIZES = {1: 64, 2: 20, 3: 36, 4: 40, 5: 68}
C99 = ["gcc", "-std=c99", *STRICT, "-Wconversion", "-Wshadow"]
CPP = ["g++", "-x", "c++", *STRICT, "-Wconversion", "-Wshadow"]
SANITIZED = [*C99, "-g", "-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
DRIVER = Path(__file__).parent / "firmware_driver.c"
ERRORS = {"format": -1, "crc": -2, "nan": -3, "norm": -4}
# On demand: HILSTAR_FUZZ=1000000 pytest tests/unit/attitude/wire/test_firmware.py
MUTATED_FRAMES = int(os.environ.get("HILSTAR_FUZZ", "20000"))
MAX_CODE_BYTES = 4096
BAUD = 921_600
CLOCK_OFFSET_S = 1000
# Every function that firmware calls, so that the object's size includes all of them.
EVERY_FUNCTION = """
#include "hilstar_protocol.h"
size_t a(const hilstar_attitude *in, uint8_t *out) { return hilstar_encode_attitude(in, out); }
size_t b(const hilstar_time_request *in, uint8_t *out) { return hilstar_encode_time_request(in, out); }
size_t c(const hilstar_time_reply *in, uint8_t *out) { return hilstar_encode_time_reply(in, out); }
size_t d(const hilstar_status *in, uint8_t *out) { return hilstar_encode_status(in, out); }
int e(const uint8_t *in, size_t length, hilstar_attitude *out) { return hilstar_decode_attitude(in, length, out); }
int f(const uint8_t *in, size_t length, hilstar_time_request *out) { return hilstar_decode_time_request(in, length, out); }
int g(const uint8_t *in, size_t length, hilstar_time_reply *out) { return hilstar_decode_time_reply(in, length, out); }
int h(const uint8_t *in, size_t length, hilstar_status *out) { return hilstar_decode_status(in, length, out); }
size_t m(const hilstar_answer *in, uint8_t *out) { return hilstar_encode_answer(in, out); }
int n(const uint8_t *in, size_t length, hilstar_answer *out) { return hilstar_decode_answer(in, length, out); }
int i(const hilstar_attitude *in) { return hilstar_check_attitude(in); }
size_t j(const uint8_t *in, size_t length, uint8_t *out) { return hilstar_frame(in, length, out); }
void k(hilstar_decoder *decoder) { hilstar_decoder_init(decoder); }
int l(hilstar_decoder *decoder, uint8_t byte) { return hilstar_push(decoder, byte); }
"""


def driven(driver: Path, lines: list[str]) -> list[str]:
    """The driver's answers, one a line."""
    text = "".join(line + "\n" for line in lines)
    result = subprocess.run(
        [str(driver)], input=text, capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )
    assert result.returncode == 0, result.stderr[-2000:]
    answers = result.stdout.splitlines()
    assert len(answers) == len(lines)
    return answers


@pytest.fixture(scope="module")
def sanitized(tmp_path_factory) -> Path:
    return compiled(tmp_path_factory.mktemp("firmware") / "sanitized", *SANITIZED, *HEADER, DRIVER)


@pytest.fixture(scope="module", params=["C99", "C++11", "C++20"])
def driver(request, tmp_path_factory, sanitized) -> Path:
    if request.param == "C99":
        return sanitized
    target = tmp_path_factory.mktemp("firmware") / request.param
    return compiled(target, *CPP, f"-std={request.param.lower()}", "-O2", *HEADER, DRIVER)


def bits(vector: dict) -> list[int]:
    """A vector's fields as the driver has them: each number's bits. No NaN: which of its bits
    are set says nothing.
    """
    found: list[int] = []
    for name, value in vector["fields"].items():
        forms = {"q_icrs_to_cam": "<d", "rate_cam_rad_s": "<f"}
        for item in value if isinstance(value, list) else [value]:
            number = math.nan if item == "nan" else item
            size = 8 if name.endswith("_ns") or name in forms else 4
            raw = (
                struct.pack(forms[name], number)
                if name in forms
                else (number % 2 ** (8 * size)).to_bytes(size, "little")
            )
            found.append(int.from_bytes(raw, "little"))
    return found


def wire_level(message: bytes) -> int | None:
    """The kind of what version, kind, length and CRC-32 say is a packet; an implementation of
    its own.
    """
    if len(message) < 2 or message[0] != 1 or SIZES.get(message[1]) != len(message):
        return None
    return message[1] if struct.pack("<I", zlib.crc32(message[:-4])) == message[-4:] else None


def wire_error(body: bytes) -> int | None:
    """The error of what stands between two zeros, or None for a packet and for nothing."""
    if not body:
        return None
    try:
        message = cobs.decode(body)
    except cobs.DecodeError:
        return ERRORS["format"]
    if wire_level(message) is not None:
        return None
    wanted = SIZES.get(message[1]) if message[:1] == b"\1" and len(message) > 1 else None
    if len(message) not in {wanted, 64}:
        return ERRORS["format"]
    return (
        ERRORS["crc"]
        if struct.pack("<I", zlib.crc32(message[:-4])) != message[-4:]
        else ERRORS["format"]
    )


def wire_stream(stream: bytes) -> list[tuple[int, str]]:
    """The packets of a stream, by splitting it at its zeros: (kind, hex)."""
    found = []
    for body in stream.split(b"\0")[:-1]:
        try:
            message = cobs.decode(body)
        except cobs.DecodeError:
            continue
        kind = wire_level(message)
        if kind is not None:
            found.append((kind, message.hex()))
    return found


def pushed(answer: str) -> tuple[list[tuple[int, str]], list[int], list[int]]:
    """An answer to "p": packets, errors, and the counts accepted, crc, format."""
    events, counts = answer.split(". ")
    packets = [
        (int(kind), message)
        for kind, _, message in (event.partition(":") for event in events.split())
        if message
    ]
    errors = [int(event) for event in events.split() if ":" not in event]
    return packets, errors, [int(count) for count in counts.split()]


def test_every_vector_is_written_and_read_bit_for_bit(driver):
    encoded = driven(
        driver, [f"e {v['kind']} {' '.join(f'{n:x}' for n in bits(v))}" for v in ACCEPTED]
    )
    decoded = driven(driver, [f"d {v['packet_hex']}" for v in ACCEPTED])
    for vector, wrote, read in zip(ACCEPTED, encoded, decoded, strict=True):
        assert wrote == f"{vector['packet_hex']} {vector['frame_hex']}", vector["name"]
        assert read == f"{vector['kind']} 0 {' '.join(f'{n:x}' for n in bits(vector))}", vector[
            "name"
        ]


def test_every_refused_vector_is_refused_for_its_reason(driver):
    """What only a receiver's past can refuse (time) is a packet like any other to the wire."""
    whole = [vector for vector in REFUSED if vector["packet_hex"] is not None]
    for vector, answer in zip(
        whole, driven(driver, [f"d {v['packet_hex'] or '-'}" for v in whole]), strict=True
    ):
        result, check, *_ = [int(word, 16) for word in f"{answer} 0".split()]
        first = result if result < 0 else check
        assert first == (0 if vector["refused"] == "time" else ERRORS[vector["refused"]]), vector[
            "name"
        ]


def test_a_frame_of_each_vector_comes_out_of_a_stream(driver):
    lines = [line for vector in VECTORS for line in ("i", f"p 00{vector['frame_hex']}")]
    for vector, answer in zip(VECTORS, driven(driver, lines)[1::2], strict=True):
        packets, errors, counts = pushed(answer)
        expected = wire_stream(bytes.fromhex(vector["frame_hex"]))
        assert packets == expected, vector["name"]
        assert errors == ([] if expected else [ERRORS[vector["refused"]]]), vector["name"]
        assert counts == [len(packets), errors.count(-2), errors.count(-1)]


def test_the_first_whole_frame_after_garbage_and_a_delimiter_is_taken(sanitized, rng):
    good = frame(TimeRequest(7, -7))
    for garbage in (
        b"",
        b"\0" * 9,
        b"\xff" * 500,
        b"\x02",
        frame(TimeRequest(1, 1))[:-1],
        rng.bytes(3000),
    ):
        _, answer = driven(sanitized, ["i", f"p {(garbage + DELIMITER + good).hex()}"])
        assert pushed(answer)[0][-1] == (2, cobs.decode(good[:-1]).hex())


def test_a_line_that_never_brings_a_delimiter_costs_one_refusal(sanitized):
    long = "55" * (MAX_FRAME_BYTES + 1)
    answers = driven(
        sanitized,
        [
            "i",
            "p 00",
            f"p {long[2:]}",
            "p 55",
            f"p {long * 9}",
            f"p 00{frame(TimeRequest(3, 4)).hex()}",
        ],
    )
    errors = [pushed(answer)[1] for answer in answers[1:]]
    assert errors == [[], [], [-1], [], []]
    assert pushed(answers[-1])[2] == [1, 0, 1]


def test_what_was_cut_in_two_before_the_first_delimiter_is_no_refusal(sanitized):
    whole = frame(TimeRequest(3, 4))
    for first, packets in ((whole[5:], 1), (whole, 2), (b"\x55" * 999 + DELIMITER, 1)):
        _, answer = driven(sanitized, ["i", f"p {(first + whole).hex()}"])
        assert pushed(answer)[1] == []
        assert pushed(answer)[2] == [packets, 0, 0]


def mutated(frames: list[bytes], rng: np.random.Generator) -> bytes:
    """A frame with one to three of its bits, bytes or stretches wrong; sometimes with a new CRC
    over the wrong contents.
    """
    mutant = bytearray(frames[int(rng.integers(len(frames)))])
    if rng.random() < 0.3:
        message = bytearray(cobs.decode(bytes(mutant[:-1])))
        message[int(rng.integers(2 if rng.random() < 0.5 else len(message)))] = int(rng.integers(6))
        body = bytes(message[: int(rng.integers(len(message))) if rng.random() < 0.3 else -4])
        return bytes(cobs.encode(body + struct.pack("<I", zlib.crc32(body)))) + DELIMITER
    for _ in range(int(rng.integers(1, 4))):
        place = int(rng.integers(len(mutant)))
        match rng.integers(4):
            case 0:
                mutant[place] ^= 1 << int(rng.integers(8))
            case 1:
                mutant[place] = int(rng.integers(256))
            case 2 if place:
                del mutant[place:]
            case _:
                mutant[place:place] = rng.bytes(int(rng.integers(1, 90)))
    return bytes(mutant)


def test_c_takes_exactly_what_python_takes_of_mutated_frames(sanitized, rng):
    """Each mutant, then a good frame: under the address and undefined-behaviour sanitizers, in
    one decoder from end to end.
    """
    frames = [bytes.fromhex(vector["frame_hex"]) for vector in ACCEPTED]
    good = frame(TimeRequest(77, 78))
    streams = [mutated(frames, rng) + DELIMITER + good for _ in range(MUTATED_FRAMES)]
    answers = driven(sanitized, ["p 00", *(f"p {stream.hex()}" for stream in streams)])
    taken = 0
    for stream, answer in zip(streams, answers[1:], strict=True):
        packets, errors, _ = pushed(answer)
        assert packets == wire_stream(stream), stream.hex()
        assert packets[-1] == (2, cobs.decode(good[:-1]).hex())
        taken += len(packets) - 1
        assert errors == [
            error for body in stream.split(DELIMITER) if (error := wire_error(body)) is not None
        ], stream.hex()
    # Some are valid all the same, with a new CRC or a byte replaced by itself; most are not.
    assert 0.05 * MUTATED_FRAMES < taken < 0.6 * MUTATED_FRAMES
    *_, accepted, crc, form = (int(count) for count in answers[-1].split(". ")[1].split())
    assert accepted == taken + MUTATED_FRAMES
    assert min(crc, form) > 0.05 * MUTATED_FRAMES


def test_messages_as_zeromq_brings_them_are_taken_alike(sanitized, rng):
    whole = [bytes.fromhex(vector["packet_hex"]) for vector in ACCEPTED]
    messages = [rng.bytes(int(rng.integers(130))) for _ in range(1000)]
    messages += [
        cobs.decode(mutant[:-1])
        for mutant in (mutated([cobs_frame(m)], rng) for m in whole * 20)
        if is_cobs(mutant)
    ]
    answers = driven(sanitized, [f"d {message.hex() or '-'}" for message in messages])
    for message, answer in zip(messages, answers, strict=True):
        kind = int(answer.split()[0])
        assert (kind if kind > 0 else None) == wire_level(message)


def cobs_frame(message: bytes) -> bytes:
    return bytes(cobs.encode(message)) + DELIMITER


def is_cobs(wire: bytes) -> bool:
    try:
        cobs.decode(wire[:-1])
    except cobs.DecodeError:
        return False
    return True


def code_bytes(tmp_path: Path, compiler: list[str], size: str) -> int:
    """Code and constants of all the header's functions, compiled for size."""
    source = tmp_path / "every.c"
    source.write_text(EVERY_FUNCTION)
    command = (*compiler, "-std=c99", *STRICT, "-Os", "-c", *HEADER, source)
    target = compiled(tmp_path / "every.o", *command)
    table = subprocess.run(
        [size, str(target)], capture_output=True, text=True, timeout=PATIENCE_S, check=True
    ).stdout
    text, data, bss, *_ = (int(word) for word in table.splitlines()[1].split()[:3])
    assert data == bss == 0
    return text


def test_the_header_s_code_is_under_four_kilobytes(tmp_path):
    assert code_bytes(tmp_path, ["gcc"], "size") < MAX_CODE_BYTES


@pytest.mark.parametrize("core", ["cortex-m0", "cortex-m3", "cortex-m4"])
@pytest.mark.skipif(
    shutil.which("arm-none-eabi-gcc") is None, reason="arm-none-eabi-gcc is not installed"
)
def test_the_header_s_code_is_as_small_on_a_microcontroller(tmp_path, core):
    code = code_bytes(
        tmp_path, ["arm-none-eabi-gcc", "-mthumb", f"-mcpu={core}"], "arm-none-eabi-size"
    )
    assert code < MAX_CODE_BYTES
