"""The generated files are those of protocol.toml, and the vectors are what Python itself reads
and writes.
"""

from __future__ import annotations

import json
import math
import shutil
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
from cobs import cobs

from hilstar.attitude.clock.timeline import Policy, Timeline
from hilstar.attitude.wire import packet, protocol
from hilstar.attitude.wire.packet import (
    DELIMITER,
    MESSAGE_REASONS,
    AttitudeSample,
    Refusal,
    StreamDecoder,
    decode,
    encode,
    frame,
)
from hilstar.basics.rotation import from_radec_roll_deg
from tests.support.benches import ROOT
from tests.support.waiting import PATIENCE_S

FOLDER = ROOT / "firmware_protocol"
VECTORS = json.loads((FOLDER / "vectors.json").read_text())
ACCEPTED = [vector for vector in VECTORS if "refused" not in vector]
REFUSED = [vector for vector in VECTORS if "refused" in vector]
# Put together from the ICD alone, the CRC-32 at the end among them; nothing of this comes from
# hilstar or from the generator.
FORMATS = {1: "<BBHIq4d3fI", 2: "<BBHIqI", 3: "<BBHIqqqI", 4: "<BBHIqqIIII", 5: "<BBHIq4d3fII"}
SIZES = {1: 64, 2: 20, 3: 36, 4: 40, 5: 68}
FIELDS = {
    1: ["flags", "sequence", "t_ns", "q_icrs_to_cam", "rate_cam_rad_s"],
    2: ["sequence", "t1_ns"],
    3: ["sequence", "t1_ns", "t2_ns", "t3_ns"],
    4: [
        "health",
        "frame",
        "light_t_ns",
        "attitude_age_ns",
        "attitude_sequence",
        "accepted",
        "refused",
    ],
    5: ["flags", "sequence", "t_ns", "q_icrs_to_cam", "rate_cam_rad_s", "stars"],
}
# The division of a quaternion by its norm rounds norm and quotient: each by half of 2.2e-16.
ROUNDED_NORM = 4.5e-16
NOT_ALWAYS = Policy(0, 1)


def names(vectors: list[dict]) -> list[str]:
    return [vector["name"] for vector in vectors]


def numbers(values: list) -> list[float]:
    return [math.nan if value == "nan" else value for value in values]


def same_bits(values: list, others: list) -> bool:
    """Equal as doubles, the signs of zeros too, and any NaN like any other."""
    pairs = zip(values, others, strict=True)
    return all(
        (a == b and math.copysign(1, a) == math.copysign(1, b)) or (math.isnan(a) and math.isnan(b))
        for a, b in pairs
    )


def wire_fields(message: bytes) -> tuple[int, dict]:
    """Kind and fields of a packet, its CRC and its fixed bytes checked: an implementation of the
    ICD of its own.
    """
    kind = message[1]
    version, _, *values, crc = struct.unpack(FORMATS[kind], message)
    assert version == 1
    assert crc == zlib.crc32(message[:-4])
    if kind == 1:
        values = [*values[:3], values[3:7], values[7:]]
    elif kind == 5:
        values = [*values[:3], values[3:7], values[7:10], values[10]]
    elif kind in (2, 3):
        assert values.pop(0) == 0
    return kind, dict(zip(FIELDS[kind], values, strict=True))


def decoded_events(stream: bytes) -> list:
    return [event for event, _ in StreamDecoder().feed(DELIMITER + stream)]


def regenerated(folder: Path, *options: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(folder / "firmware_protocol" / "generate.py"), *options]
    return subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=False)


@pytest.fixture
def copy(tmp_path):
    shutil.copytree(FOLDER, tmp_path / "firmware_protocol")
    (tmp_path / "hilstar" / "attitude" / "wire").mkdir(parents=True)
    shutil.copy(
        ROOT / "hilstar" / "attitude" / "wire" / "protocol.py",
        tmp_path / "hilstar" / "attitude" / "wire",
    )
    return tmp_path


def test_every_generated_file_is_that_of_protocol_toml():
    result = regenerated(ROOT, "--check")
    assert result.returncode == 0, result.stderr


GENERATED = [
    "firmware_protocol/hilstar_protocol.h",
    "firmware_protocol/vectors.json",
    "firmware_protocol/README.md",
    "hilstar/attitude/wire/protocol.py",
]


def test_a_changed_definition_makes_every_file_stale_and_generating_mends_it(copy):
    definition = copy / "firmware_protocol" / "protocol.toml"
    text = definition.read_text()
    assert regenerated(copy, "--check").returncode == 0
    definition.write_text(
        text.replace('"f32", count = 3', '"f64", count = 3')
        .replace("size_bytes = 64", "size_bytes = 76")
        .replace("size_bytes = 68", "size_bytes = 80")
    )
    stale = regenerated(copy, "--check")
    assert stale.returncode == 1
    assert [line for line in stale.stderr.splitlines() if line.startswith("stale")] == [
        f"stale: {name}" for name in GENERATED
    ]
    assert regenerated(copy).returncode == 0
    assert regenerated(copy, "--check").returncode == 0


@pytest.mark.parametrize("name", GENERATED)
def test_a_file_edited_by_hand_is_named(copy, name):
    edited = copy / name
    edited.write_text(edited.read_text().replace("64", "63"))
    result = regenerated(copy, "--check")
    assert result.returncode == 1
    assert f"stale: {name}" in result.stderr.splitlines()
    assert edited.read_text().count("63")  # a check mends nothing


def test_a_definition_that_contradicts_itself_is_refused(copy):
    definition = copy / "firmware_protocol" / "protocol.toml"
    text = definition.read_text()
    for right, wrong in (
        ("size_bytes = 64", "size_bytes = 65"),
        ("kind = 1\n", "kind = 7\n"),
        ("version = 1\n", "version = 2\n"),
    ):
        definition.write_text(text.replace(right, wrong))
        result = regenerated(copy, "--check")
        assert result.returncode == 1
        assert result.stderr.startswith("packet.attitude: ")
        assert len(result.stderr.splitlines()) == 1


def test_the_table_has_the_icd_s_sizes_and_bits():
    bodies = (
        protocol.ATTITUDE_BODY,
        protocol.TIME_REQUEST_BODY,
        protocol.TIME_REPLY_BODY,
        protocol.STATUS_BODY,
        protocol.ANSWER_BODY,
    )
    assert (
        {kind: struct.calcsize(form) for kind, form in FORMATS.items()}
        == SIZES
        == protocol.PACKET_BYTES
    )
    assert [body.format + "I" for body in bodies] == list(FORMATS.values())
    health = "NO_ATTITUDE STALE BLANK CLOCK_SYNCHRONISED MISSED REFUSED CLIPPED LEDGER_FAILED"
    health += " OPERATOR_OVERRIDE HIDDEN SECOND_SENDER SOURCE_FROZEN"
    assert [getattr(protocol, f"HEALTH_{name}") for name in health.split()] == [
        1 << bit for bit in range(12)
    ]
    assert (protocol.FLAG_RATE_VALID, protocol.FLAG_DISCONTINUITY) == (1, 2)
    answer = "RATE_VALID VALID LOST_IN_SPACE TRACKING TOO_FEW_STARS BLINDED"
    assert [getattr(protocol, f"ANSWER_{name}") for name in answer.split()] == [
        1 << bit for bit in range(6)
    ]
    assert (protocol.NORM_TOLERANCE, protocol.FASTEST_RAD_S) == (1e-3, 1e6)


def test_the_vectors_have_every_kind_every_reason_and_names_of_their_own():
    assert {vector["kind"] for vector in ACCEPTED} == set(SIZES)
    assert {vector["refused"] for vector in REFUSED} == set(MESSAGE_REASONS)
    assert len(set(names(VECTORS))) == len(VECTORS)


@pytest.mark.parametrize("vector", ACCEPTED, ids=names(ACCEPTED))
def test_a_vector_is_what_struct_zlib_and_cobs_say(vector):
    message = bytes.fromhex(vector["packet_hex"])
    kind, fields = wire_fields(message)
    assert kind == vector["kind"]
    assert len(message) == SIZES[kind]
    assert list(vector["fields"]) == FIELDS[kind]
    for name, said in vector["fields"].items():
        got = fields[name]
        assert same_bits(numbers(said), got) if isinstance(said, list) else said == got, name
    assert bytes.fromhex(vector["frame_hex"]) == cobs.encode(message) + b"\0"


@pytest.mark.parametrize("vector", ACCEPTED, ids=names(ACCEPTED))
def test_hilstar_reads_a_vector_and_writes_it_again(vector):
    message = bytes.fromhex(vector["packet_hex"])
    event = decode(message)
    (framed,) = decoded_events(bytes.fromhex(vector["frame_hex"]))
    assert repr(framed) == repr(event)
    assert not isinstance(event, Refusal)
    fields = vector["fields"]
    if not isinstance(event, AttitudeSample):
        got = {name: getattr(event, name) for name in fields}
        assert {
            name: list(value) if isinstance(value, tuple) else value for name, value in got.items()
        } == fields
        assert encode(event) == message
        assert frame(event).hex() == vector["frame_hex"]
        return
    assert (event.sequence, event.t_ns) == (fields["sequence"], fields["t_ns"])
    assert event.discontinuity == bool(fields["flags"] & 2)
    assert event.sender == (fields["flags"] >> 8) % 255
    q = np.array(fields["q_icrs_to_cam"])
    norm = math.hypot(*q)
    assert np.abs(event.q_icrs_to_cam - q / norm).max() <= ROUNDED_NORM
    known = bool(fields["flags"] & 1)
    assert (event.rate_cam_rad_s is not None) == known
    if event.rate_cam_rad_s is not None:
        assert same_bits(list(event.rate_cam_rad_s), fields["rate_cam_rad_s"])
    if (
        norm == 1.0
        and fields["flags"] != 0xFFFF
        and not any(value == "nan" for value in fields["rate_cam_rad_s"])
    ):
        assert encode(event) == message
        assert frame(event).hex() == vector["frame_hex"]


@pytest.mark.parametrize("vector", REFUSED, ids=names(REFUSED))
def test_hilstar_refuses_a_vector_for_the_reason_it_gives(vector):
    (event,) = decoded_events(bytes.fromhex(vector["frame_hex"]))
    if vector["refused"] == "time":
        timeline = Timeline(NOT_ALWAYS)
        before = next(other for other in ACCEPTED if other["name"] == vector["after"])
        first = decode(bytes.fromhex(before["packet_hex"]))
        assert isinstance(first, AttitudeSample)
        assert isinstance(event, AttitudeSample)
        assert timeline.add(first) is None
        event = timeline.add(event)
    assert isinstance(event, Refusal)
    assert event.reason == vector["refused"]
    if vector["packet_hex"] is not None and vector["refused"] != "time":
        again = decode(bytes.fromhex(vector["packet_hex"]))
        assert isinstance(again, Refusal)
        assert again.reason == vector["refused"]
        assert cobs.encode(bytes.fromhex(vector["packet_hex"])) + b"\0" == bytes.fromhex(
            vector["frame_hex"]
        )


def test_the_readme_s_check_values_are_hilstar_s():
    text = (FOLDER / "README.md").read_text().split("| RA, Dec, roll (deg) |")[1].split("\n\n")[0]
    rows = [line.split("|")[1:-1] for line in text.splitlines()[2:]]
    assert len(rows) == 3
    for radec, *q in rows:
        expected = from_radec_roll_deg(*(float(word) for word in radec.split(",")))
        # Seven digits are shown.
        assert (
            min(np.abs(expected - sign * np.array(q, dtype=np.float64)).max() for sign in (1, -1))
            < 0.51e-7
        )


def test_the_readme_s_python_line_makes_the_first_vector():
    """The line in the ICD, run as it stands there."""
    text = (FOLDER / "README.md").read_text()
    code = text.split("```python\n")[1].split("```")[0]
    names_: dict = {
        "flags": 1,
        "sequence": 1,
        "t_ns": 1_000_000_000,
        "w": 0.5,
        "x": 0.5,
        "y": -0.5,
        "z": 0.5,
    }
    names_ |= {"rx": 0.0, "ry": 0.0, "rz": 0.125}
    exec(code, names_)
    assert names_["packet"].hex() == VECTORS[0]["packet_hex"]
    assert isinstance(packet.decode(names_["packet"]), AttitudeSample)
