"""The writer of run ledgers by what the library reads of its files, and what it keeps of a failed
write.
"""

from __future__ import annotations

import errno
import os
import struct
import zlib

import pytest
from mcap.reader import make_reader
from mcap.records import Chunk, MessageIndex
from mcap.stream_reader import StreamReader
from zstandard import ZstdDecompressor

from hilstar.attitude.logs import mcap_log
from hilstar.attitude.logs.mcap_log import JsonTopic, McapWriter, parts_of, read_messages

TOPICS = {key: JsonTopic(f"/{key}", "any", b"{}") for key in ("one", "two")}


@pytest.fixture
def writer_of(tmp_path):
    files = []

    def opened(name="a.mcap", **metadata):
        files.append(os.open(tmp_path / name, os.O_RDWR | os.O_CREAT | os.O_APPEND))
        return McapWriter(files[-1], TOPICS, mcap_log.RUN_METADATA, metadata)

    yield opened
    for file in files:
        os.close(file)


def read(path):
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        messages = list(reader.iter_messages(log_time_order=False))
        return reader.get_summary(), [
            (channel.topic, message.log_time, message.sequence, message.data)
            for _, channel, message in messages
        ]


def test_what_is_written_is_what_the_library_reads(tmp_path, writer_of):
    writer = writer_of()
    for key, time_ns, sequence in (("one", 5, 2**33 + 2**31 + 7), ("two", 3, 1), ("one", 9, 2)):
        writer.add(key, time_ns, f"{time_ns}".encode(), sequence)
    writer.flush()
    writer.add("two", 1, b"1", 3)
    assert writer.written == 3
    writer.finish()
    summary, messages = read(tmp_path / "a.mcap")
    assert messages == [
        ("/one", 5, 2**31 + 7, b"5"),
        ("/two", 3, 1, b"3"),
        ("/one", 9, 2, b"9"),
        ("/two", 1, 3, b"1"),
    ]
    chunks = [(one.message_start_time, one.message_end_time) for one in summary.chunk_indexes]
    assert chunks == [(3, 9), (1, 1)]
    totals = summary.statistics
    assert (totals.message_start_time, totals.message_end_time, totals.message_count) == (1, 9, 4)
    assert (totals.chunk_count, totals.channel_message_counts) == (2, {1: 2, 2: 2})
    assert (tmp_path / "a.mcap").stat().st_size == writer.size_bytes


def test_the_footer_says_where_the_summary_begins_and_its_checksum(tmp_path, writer_of):
    """MCAP's specification: the CRC-32 from the summary's first byte to the footer's field before
    it; the first record of ours is a schema, opcode 3, and of its offsets opcode 14.
    """
    writer = writer_of()
    writer.add("one", 5, b"5", 1)
    writer.finish()
    whole = (tmp_path / "a.mcap").read_bytes()
    opcode, length, start, offsets, crc = struct.unpack("<BQQQI", whole[-37:-8])
    assert (opcode, length) == (2, 20)
    assert (whole[start], whole[offsets]) == (3, 14)
    assert crc == zlib.crc32(whole[start:-12])


def test_each_message_lies_where_its_chunk_s_index_has_it(tmp_path, writer_of):
    """Both index and place are read by the library, and each message's head (MCAP: opcode 5, length,
    channel, sequence, log time) is looked up at its place.
    """
    writer = writer_of()
    for number in range(2):
        for key, time_ns in (("one", 5), ("two", 3), ("one", 9), ("two", 7)):
            writer.add(key, 10 * number + time_ns, b"x" * time_ns, number)
        writer.flush()
    writer.finish()
    with (tmp_path / "a.mcap").open("rb") as file:
        records = list(StreamReader(file, emit_chunks=True).records)
        file.seek(0)
        summary = make_reader(file).get_summary()
    by_index: list[tuple[int, int]] = []
    data = b""
    for record in records:
        if isinstance(record, Chunk):
            data = ZstdDecompressor().decompress(record.data, record.uncompressed_size)
        elif isinstance(record, MessageIndex):
            for time_ns, place in record.records:
                opcode, _, channel, _, logged_ns = struct.unpack_from("<BQHIQ", data, place)
                assert (opcode, channel, logged_ns) == (5, record.channel_id, time_ns)
                by_index.append((channel, time_ns))
    times = [(1, 5), (1, 9), (2, 3), (2, 7)]
    assert by_index == [*times, *((channel, 10 + time_ns) for channel, time_ns in times)]
    raw = (tmp_path / "a.mcap").read_bytes()
    for chunk in summary.chunk_indexes:
        assert raw[chunk.chunk_start_offset] == 6
        for channel, place in chunk.message_index_offsets.items():
            assert struct.unpack_from("<BQH", raw, place)[::2] == (7, channel)


def test_a_topic_s_messages_are_dropped_and_the_others_stay(writer_of):
    writer = writer_of()
    writer.add("one", 1, b"123", 1)
    of_one = writer.pending_bytes
    writer.add("two", 1, b"12345", 1)
    assert writer.drop("two") == 1 and writer.pending_bytes == of_one > 3
    other = writer_of("b.mcap")
    other.take_over(writer)
    assert (writer.pending_bytes, other.pending_bytes) == (0, of_one)
    assert (writer.drop(), other.drop(), other.pending_bytes) == (0, 1, 0)


def test_a_failed_write_leaves_the_file_as_it_was_and_keeps_the_messages(
    tmp_path, writer_of, monkeypatch
):
    writer = writer_of()
    before = (tmp_path / "a.mcap").read_bytes()
    writer.add("one", 1, b"1", 1)
    write = os.write

    def half(fd, data):
        if len(data) == 1:
            raise OSError(errno.ENOSPC, "full")
        return write(fd, data[: len(data) // 2])

    monkeypatch.setattr(mcap_log.os, "write", half)
    with pytest.raises(OSError, match="full"):
        writer.flush()
    assert (tmp_path / "a.mcap").read_bytes() == before
    monkeypatch.undo()
    assert writer.pending_bytes
    writer.finish()
    assert [data for *_, data in read(tmp_path / "a.mcap")[1]] == [b"1"]


def test_an_index_that_is_too_large_is_left_out_from_then_on(tmp_path, writer_of, monkeypatch):
    monkeypatch.setattr(mcap_log, "MAX_INDEX_BYTES", 150)
    writer = writer_of()
    for k in range(4):
        writer.add("one", k, b"1", k)
        writer.flush()
    writer.finish()
    summary, messages = read(tmp_path / "a.mcap")
    assert summary.chunk_indexes == [] and len(messages) == summary.statistics.message_count == 4


@pytest.mark.parametrize(
    ("run_id", "part", "is_read"), [("a", "1", True), ("b", "1", False), ("a", "2", False)]
)
def test_the_files_of_a_run_are_those_of_its_name_and_number(
    tmp_path, writer_of, run_id, part, is_read
):
    first, second = tmp_path / "a.mcap", tmp_path / "a.0001.mcap"
    for path, metadata in (
        (first, {"run_id": "a", "part": "0"}),
        (second, {"run_id": run_id, "part": part}),
    ):
        writer = writer_of(path.name, **metadata)
        writer.add("one", 1, path.name.encode(), 1)
        writer.finish()
    assert parts_of(first) == ([first, second] if is_read else [first])
    assert parts_of(second) == [second]
    assert list(read_messages(first, "/one")) == [b"a.mcap", b"a.0001.mcap"][: 1 + is_read]
