"""Attitudes in MCAP: what other tools see, what a killed writer leaves, and what is refused."""

from __future__ import annotations

import io
import json

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from hilstar.attitude.logs import mcap_log
from hilstar.attitude.logs.log_file import read_log, write_log
from hilstar.attitude.logs.mcap_log import (
    ATTITUDE_SCHEMA,
    ATTITUDE_TOPIC,
    FREE_BYTES,
    _is_finished,
    attitude_message,
    log_time_ns,
    read_attitudes,
    records_of,
    refused_message,
    register_attitudes,
)
from hilstar.attitude.wire.packet import AttitudeSample, encode
from hilstar.basics.errors import InputError
from tests.support.refusals import refusal

UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])


def upright_sample(t_ns, sequence=0, rate=None):
    return AttitudeSample(t_ns, UPRIGHT, rate, sequence)


def ledger(messages, chunk_size=1024 * 1024, finish=True):
    """An MCAP file of attitude messages between those of another channel, as a live run writes
    it.
    """
    file = io.BytesIO()
    writer = Writer(file, chunk_size=chunk_size)
    writer.start(library="test")
    frames = writer.register_channel("/frame", "json", 0)
    attitudes = register_attitudes(writer)
    for i, message in enumerate(messages):
        writer.add_message(frames, i, b'{"frame":1}', i)
        writer.add_message(attitudes, i, message, i)
    if finish:
        writer.finish()
    return file.getvalue()


def test_an_mcap_log_opens_in_the_library_as_json_with_a_schema(tmp_path):
    taken = upright_sample(-5, 3, np.array([0.1, 0.2, 0.3]))
    write_log(tmp_path / "a.mcap", [taken, upright_sample(2**62, 4)])
    with (tmp_path / "a.mcap").open("rb") as file:
        (schema, channel, first), (_, _, second) = make_reader(file).iter_messages()
    assert schema is not None
    assert (schema.encoding, schema.data) == ("jsonschema", ATTITUDE_SCHEMA)
    assert (channel.topic, channel.message_encoding) == (ATTITUDE_TOPIC, "json")
    assert (first.log_time, first.publish_time, first.sequence) == (0, 0, 3)
    assert second.log_time == 2**62
    assert json.loads(first.data) == {
        "t_ns": -5,
        "sequence": 3,
        "q": [1, 0, 0, 0],
        "rate": [0.1, 0.2, 0.3],
        "discontinuity": False,
        "receive_ns": None,
        "accepted": True,
        "reason": None,
        "raw": None,
    }


def test_the_schema_names_every_field_with_one_plain_type():
    # Foxglove's reader throws for a type that is a list (foxglove/studio,
    # packages/mcap-support/src/parseJsonSchema.ts).
    properties = json.loads(ATTITUDE_SCHEMA)["properties"]
    assert list(properties) == list(json.loads(attitude_message(upright_sample(0))))
    assert {p["type"] for p in properties.values()} <= {
        "integer",
        "number",
        "boolean",
        "string",
        "array",
    }


def test_a_message_keeps_the_packet_as_it_came():
    packet = encode(upright_sample(7))
    accepted = json.loads(attitude_message(upright_sample(7), receive_ns=9, raw=packet))
    assert (bytes.fromhex(accepted["raw"]), accepted["receive_ns"]) == (packet, 9)
    refused = json.loads(refused_message("crc", "the CRC-32 does not fit", 9, b"\x00\xff"))
    assert (refused["accepted"], refused["reason"], refused["raw"]) == (
        False,
        "crc: the CRC-32 does not fit",
        "00ff",
    )
    assert (refused["t_ns"], refused["receive_ns"]) == (None, 9)


def test_log_time_is_the_receivers_clock_where_known_and_never_below_zero():
    assert log_time_ns(5) == 5
    assert log_time_ns(5, 9) == 9
    assert log_time_ns(-5) == log_time_ns(5, -9) == 0


def test_other_channels_and_refused_packets_are_passed_over(tmp_path):
    refused = refused_message("norm", "2", 1, None)
    (tmp_path / "run.mcap").write_bytes(
        ledger([attitude_message(upright_sample(1)), refused, attitude_message(upright_sample(2))])
    )
    assert [s.t_ns for s in read_log(tmp_path / "run.mcap")] == [1, 2]


def test_a_killed_writer_leaves_everything_before_its_last_chunk(tmp_path):
    count = 40
    data = ledger(
        [attitude_message(upright_sample(i)) for i in range(count)], chunk_size=1500, finish=False
    )
    seen = []
    for size in range(8, len(data) + 1, 13):
        (tmp_path / "run.mcap").write_bytes(data[:size])
        times = [s.t_ns for s in read_attitudes(tmp_path / "run.mcap")]
        assert times == list(range(len(times)))
        seen.append(len(times))
    assert seen == sorted(seen)
    assert seen[0] == 0
    assert 0.7 * count < seen[-1] < count  # the last chunk was never written


def test_a_file_that_has_no_end_is_said_in_one_line_and_a_whole_one_in_none(tmp_path, caplog):
    whole, path = (
        ledger([attitude_message(upright_sample(i)) for i in range(40)], chunk_size=1500),
        tmp_path / "run.mcap",
    )
    path.write_bytes(whole)
    assert len(list(read_attitudes(path))) == 40
    assert not caplog.messages
    path.write_bytes(whole[: len(whole) // 2])
    assert 0 < len(list(read_attitudes(path))) < 40
    (line,) = caplog.messages
    assert line.startswith(f"{path} has no end")


def test_what_all_chunks_unpack_to_is_bounded_and_not_each_alone(tmp_path):
    """Nothing but blanks packs to a ten-thousandth: two such chunks are too much for their file."""
    file = io.BytesIO()
    writer = Writer(file, chunk_size=1, compression=CompressionType.ZSTD)
    writer.start()
    attitudes = register_attitudes(writer)
    for t_ns in range(2):
        writer.add_message(attitudes, t_ns, b" " * (FREE_BYTES * 2 // 3), t_ns)
    writer.finish()
    (tmp_path / "blank.mcap").write_bytes(file.getvalue())
    assert len(file.getvalue()) < FREE_BYTES / 1000
    said = refusal(lambda path: list(records_of(path)), tmp_path / "blank.mcap")
    assert "unpacks to more than 100 times its size" in said


def test_what_is_no_mcap_file_is_called_so(tmp_path):
    (tmp_path / "run.mcap").write_text("t_s,qw,qx,qy,qz\n0,1,0,0,0\n")
    with pytest.raises(
        InputError,
        match=r"run\.mcap: is no MCAP file; give an MCAP file, such as the ledger of a run",
    ):
        list(read_attitudes(tmp_path / "run.mcap"))


@pytest.mark.parametrize(
    ("end", "is_finished"),
    [(b"\x89MCAP0\r\n", True), (b"\x89MCAP0\r", False), (b"\x89MCAP0\r\0", False)],
)
def test_a_file_is_finished_that_ends_as_the_specification_says(end, is_finished):
    """The magic of the MCAP specification, "File Structure", at the file's both ends."""
    assert _is_finished(io.BytesIO(b"\x89MCAP0\r\n" + bytes(100) + end)) == is_finished


def test_a_finished_file_that_is_damaged_is_refused(tmp_path):
    data = bytearray(ledger([attitude_message(upright_sample(i)) for i in range(40)]))
    data[len(data) // 4] ^= 0x55
    (tmp_path / "run.mcap").write_bytes(bytes(data))
    assert "damaged before byte" in refusal(read_log, tmp_path / "run.mcap")


def test_chunks_taken_at_once_read_and_are_refused_as_by_the_library(tmp_path, monkeypatch):
    whole, rng, path = (
        ledger([attitude_message(upright_sample(i)) for i in range(40)], chunk_size=1500),
        np.random.default_rng(1),
        tmp_path / "run.mcap",
    )

    def told():
        try:
            return [one.t_ns for one in read_attitudes(path)]
        except InputError as error:
            return str(error)

    refused = 0
    for place in rng.integers(8, len(whole), 40).tolist():
        data = bytearray(whole[: place if place % 3 == 0 else None])
        data[int(rng.integers(8, len(data)))] ^= 1 << int(rng.integers(8))
        path.write_bytes(data)
        at_once = told()
        with monkeypatch.context() as patched:
            patched.setattr(mcap_log, "PIECE_BYTES", 0)
            assert told() == at_once
        refused += isinstance(at_once, str)
    assert 10 < refused < 40


def test_a_sender_that_restarted_is_named_with_its_time(tmp_path):
    (tmp_path / "run.mcap").write_bytes(
        ledger([attitude_message(upright_sample(t)) for t in (100, 200, 50, 60)])
    )
    with pytest.raises(
        InputError, match=r"message 3 of /attitude: time does not increase .*; the sender restarted"
    ):
        read_log(tmp_path / "run.mcap")


@pytest.mark.parametrize(
    ("message", "word"),
    [
        (b"{", "not a hilstar attitude"),
        (b"\xff", "not a hilstar attitude"),
        (b'{"t_ns":1,"q":[1,0,0]}', "not a hilstar attitude"),
        (b'{"t_ns":null}', "lacks t_ns or q"),
        (b'{"t_ns":1,"q":[2,0,0,0]}', "norm"),
        (b'{"t_ns":9223372036854775808,"q":[1,0,0,0]}', "64 bits"),
    ],
)
def test_a_message_that_is_no_attitude_is_refused_with_its_number(tmp_path, message, word):
    (tmp_path / "run.mcap").write_bytes(ledger([attitude_message(upright_sample(1)), message]))
    with pytest.raises(InputError, match=f"message 2 of /attitude: .*{word}"):
        read_log(tmp_path / "run.mcap")


def test_a_file_without_attitudes_is_refused(tmp_path):
    (tmp_path / "run.mcap").write_bytes(ledger([]))
    assert "no attitude" in refusal(read_log, tmp_path / "run.mcap")


def test_two_attitudes_of_one_time_are_those_of_a_sender_that_restarted(tmp_path):
    path = tmp_path / "a.mcap"
    turned = AttitudeSample(5, np.array([0.0, 1.0, 0.0, 0.0]), None, 0)
    path.write_bytes(ledger([attitude_message(upright_sample(5)), attitude_message(turned)]))
    line = refusal(read_log, path)
    assert "the sender restarted here" in line and "more of its digits" not in line
