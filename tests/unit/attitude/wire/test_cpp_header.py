"""The C++17 header against the vectors and against Python: as strict as compilers are, and
without exceptions.
"""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest

from hilstar.attitude.wire.packet import AttitudeSample, TimeReply, decode, encode, framed
from tests.support.benches import ROOT
from tests.support.compilers import STRICT_CPP, compiled

FOLDER = ROOT / "firmware_protocol"
VECTORS = json.loads((FOLDER / "vectors.json").read_text())
# What the types cannot hold: flags that nobody knows, and a rate that is not valid.
UNHELD = {"all flags, known and unknown", "a rate that is not valid is not looked at"}
ERRORS = {"format": -1, "crc": -2, "nan": -3, "norm": -4}
COMPILER = ["g++", "-std=c++17", *STRICT_CPP]
SANITIZERS = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all"]


@pytest.fixture(scope="module")
def driver(tmp_path_factory) -> Path:
    target = tmp_path_factory.mktemp("cpp") / "driver"
    source = Path(__file__).parent / "cpp_driver.cpp"
    return compiled(target, *COMPILER, *SANITIZERS, "-I", FOLDER, source)


def driven(driver: Path, lines: list[str]) -> list[list[str]]:
    """The words of each answer."""
    result = subprocess.run(
        [driver],
        input="".join(f"{line}\n" for line in lines),
        capture_output=True,
        text=True,
        check=True,
    )
    return [answer.split() for answer in result.stdout.splitlines()]


def test_every_vector_is_read_and_written_again_bit_for_bit(driver):
    held = [
        vector
        for vector in VECTORS
        if "refused" not in vector and vector["name"].split(": ")[1] not in UNHELD
    ]
    assert len(held) == sum("refused" not in vector for vector in VECTORS) - len(UNHELD)
    for vector, answer in zip(
        held, driven(driver, [f"d {vector['packet_hex']}" for vector in held]), strict=True
    ):
        assert answer == [str(vector["kind"]), vector["packet_hex"], vector["frame_hex"]], vector[
            "name"
        ]


def test_what_is_refused_has_its_fault(driver):
    refused = [
        vector
        for vector in VECTORS
        if vector.get("refused", "time") != "time" and vector["packet_hex"] is not None
    ]
    for vector, answer in zip(
        refused,
        driven(driver, [f"d {vector['packet_hex'] or '-'}" for vector in refused]),
        strict=True,
    ):
        found = int(answer[0]) if int(answer[0]) < 0 else int(answer[3])
        assert found == ERRORS[vector["refused"]], vector["name"]


def test_random_attitudes_are_those_of_python(driver, rng):
    samples = []
    for k in range(200):
        q = rng.normal(size=4)
        rate = None if k % 3 == 0 else rng.normal(size=3).astype(np.float32).astype(float)
        times = int(rng.integers(-(2**63), 2**63 - 1))
        samples.append(
            AttitudeSample(
                times, q / np.linalg.norm(q), rate, int(rng.integers(2**32)), bool(k % 2)
            )
        )
    packets = [encode(sample) for sample in samples]
    for packet, answer in zip(
        packets, driven(driver, [f"d {packet.hex()}" for packet in packets]), strict=True
    ):
        assert answer == ["1", packet.hex(), framed(packet).hex()]


def test_packets_come_out_of_a_stream_with_garbage_in_it(driver, rng):
    reply = encode(TimeReply(7, -1, 2, 3))
    stream = (
        b"\0"
        + framed(reply)
        + rng.bytes(300).replace(b"\0", b"\1")
        + b"\0"
        + framed(reply)[:9]
        + b"\0"
        + framed(reply)
    )
    _, answer = driven(driver, ["i", f"p {stream.hex()}"])
    assert [word for word in answer if ":" in word] == [f"3:{reply.hex()}"] * 2
    assert answer[-2:] == ["2", "2"]
    assert isinstance(decode(reply), TimeReply)
