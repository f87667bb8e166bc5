"""An MCAP file of small chunks, for a run that may be killed on a disk that may be full.

Laws:
1. A chunk is on the disk whole, with its CRC, or the file ends before it: a write that fails leaves the file as it was.
2. Messages that could not be written are kept for the next attempt, until they are dropped by topic.
3. Memory does not grow with the file, except for an index of at most MAX_INDEX_BYTES; a longer file has none.

The library's writer obeys neither 1 nor 2, and its index grows by a megabyte in ten minutes of such chunks.
"""

from __future__ import annotations

import contextlib
import os
import struct
import zlib
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple, Self

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from hilstar.reading import MCAP_MAGIC

MAX_INDEX_BYTES = 16_000_000  # of about six hours of five chunks a second
LEVEL = 3  # of zstd
_message_head = struct.Struct("<BQHIQQ")
_footer_head = struct.Struct("<BQQQ")


@dataclass(frozen=True, slots=True)
class Topic:
    """A channel of JSON messages: its schema's name, and that schema."""

    name: str
    schema_name: str
    schema: bytes


class _Pending(NamedTuple):
    """A message that is not written yet."""

    channel: int
    time_ns: int
    record: bytes


class McapWriter:
    """Writes to a file descriptor that is open for writing and empty; closing it stays the caller's. Raises OSError."""

    def __init__(self, fd: int, topics: Mapping[str, Topic], metadata_name: str, metadata: Mapping[str, str]) -> None:
        self.size_bytes = 0
        self._fd = fd
        self._ids = {key: number for number, key in enumerate(topics, start=1)}
        self._schemas = [Schema(i, topic.schema, "jsonschema", topic.schema_name) for i, topic in enumerate(topics.values(), 1)]
        self._channels = [Channel(i, topic.name, "json", {}, i) for i, topic in enumerate(topics.values(), 1)]
        self._pending: list[_Pending] = []
        self.pending_bytes = 0
        self.crc = 0  # CRC-32 of all that is written
        self._index = bytearray()
        self._indexed = True
        self._counts: Counter[int] = Counter()
        self._chunks = 0
        self._times_ns: tuple[int, int] | None = None
        self._compressor = zstandard.ZstdCompressor(level=LEVEL)
        head = Metadata(metadata_name, dict(metadata))
        before = MCAP_MAGIC + _bytes_of(Header("", "hilstar"))
        whole = _bytes_of(head)
        self._metadata_index = MetadataIndex(len(before), len(whole), metadata_name)
        # Outside the first chunk: most readers also look for channels there, and these are never lost with a chunk.
        self._append(before + whole + _bytes_of(*self._schemas, *self._channels))

    def add(self, key: str, time_ns: int, data: bytes, sequence: int) -> None:
        """Take a message of the topic named `key`; it is written at the next flush."""
        record = _message_head.pack(Opcode.MESSAGE, 22 + len(data), self._ids[key], sequence % 2**32, time_ns, time_ns) + data
        self._pending.append(_Pending(self._ids[key], time_ns, record))
        self.pending_bytes += len(record)

    @property
    def written(self) -> int:
        """How many messages are in the file."""
        return self._counts.total()

    def take_over(self, other: Self) -> None:
        """Take the messages that another writer of the same topics has not written yet."""
        self._pending, self.pending_bytes = other._pending, other.pending_bytes
        other._pending, other.pending_bytes = [], 0

    def drop(self, key: str | None = None) -> int:
        """Forget the messages of a topic (None: of all) that are not written yet; returns their number."""
        kept = [] if key is None else [entry for entry in self._pending if entry.channel != self._ids[key]]
        dropped = len(self._pending) - len(kept)
        self._pending, self.pending_bytes = kept, sum(len(entry.record) for entry in kept)
        return dropped

    def flush(self) -> None:
        """Write what was added, as one chunk. Raises OSError, and keeps the messages."""
        if not self._pending:
            return
        data = b"".join(entry.record for entry in self._pending)
        times_ns = [entry.time_ns for entry in self._pending]
        first_ns, last_ns = min(times_ns), max(times_ns)
        packed = self._compressor.compress(data)
        chunk = _bytes_of(Chunk("zstd", packed, last_ns, first_ns, zlib.crc32(data), len(data)))
        indexes, offsets = self._message_indexes(self.size_bytes + len(chunk))
        place = self.size_bytes
        self._append(chunk + indexes)
        entry = ChunkIndex(len(chunk), place, "zstd", len(packed), last_ns, len(indexes), offsets, first_ns, len(data))
        self._note(entry, first_ns, last_ns)

    def finish(self) -> None:
        """Write what was added, the index and the end. Raises OSError; the file is then as if its writer had been killed."""
        self.flush()
        end = _bytes_of(DataEnd(self.crc))
        summary, offset_start = self._summary(self.size_bytes + len(end))
        start = self.size_bytes + len(end)
        crc = zlib.crc32(_footer_head.pack(Opcode.FOOTER, 20, start, offset_start), zlib.crc32(summary))
        self._append(end + summary + _bytes_of(Footer(start, offset_start, crc)) + MCAP_MAGIC)

    def _message_indexes(self, place: int) -> tuple[bytes, dict[int, int]]:
        """The index of each channel's messages in the chunk, to be written at `place`, and where each begins."""
        entries: dict[int, list[tuple[int, int]]] = {}
        offset = 0
        for channel, time_ns, record in self._pending:
            entries.setdefault(channel, []).append((time_ns, offset))
            offset += len(record)
        written, offsets = b"", {}
        for channel, records in entries.items():
            offsets[channel] = place + len(written)
            written += _bytes_of(MessageIndex(channel, records))
        return written, offsets

    def _note(self, entry: ChunkIndex, first_ns: int, last_ns: int) -> None:
        """A chunk is on the disk."""
        self._counts.update(entry.channel for entry in self._pending)
        self._pending, self.pending_bytes = [], 0
        self._chunks += 1
        self._times_ns = (first_ns, last_ns) if self._times_ns is None else _span(self._times_ns, (first_ns, last_ns))
        if self._indexed:
            self._index += _bytes_of(entry)
        if len(self._index) > MAX_INDEX_BYTES:
            self._indexed, self._index = False, bytearray()

    def _summary(self, place: int) -> tuple[bytes, int]:
        """The summary, to be written at `place`, and where the offsets in it begin."""
        first_ns, last_ns = self._times_ns or (0, 0)
        counts = dict(self._counts)
        channels = len(self._channels)
        totals = (sum(counts.values()), last_ns, first_ns)
        groups = {
            Opcode.SCHEMA: _bytes_of(*self._schemas),
            Opcode.CHANNEL: _bytes_of(*self._channels),
            Opcode.STATISTICS: _bytes_of(Statistics(0, channels, counts, self._chunks, *totals, 1, len(self._schemas))),
            Opcode.CHUNK_INDEX: bytes(self._index),
            Opcode.METADATA_INDEX: _bytes_of(self._metadata_index),
        }
        written, offsets = b"", b""
        for opcode, group in groups.items():
            if group:
                offsets += _bytes_of(SummaryOffset(opcode, place + len(written), len(group)))
            written += group
        return written + offsets, place + len(written)

    def _append(self, data: bytes) -> None:
        """Write at the end, all or nothing."""
        try:
            rest = memoryview(data)
            while rest:
                rest = rest[os.write(self._fd, rest) :]
        except OSError:
            with contextlib.suppress(OSError):
                os.ftruncate(self._fd, self.size_bytes)
                os.lseek(self._fd, self.size_bytes, os.SEEK_SET)
            raise
        self.size_bytes += len(data)
        self.crc = zlib.crc32(data, self.crc)


def _bytes_of(*records: McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]


def _span(one: tuple[int, int], other: tuple[int, int]) -> tuple[int, int]:
    return min(one[0], other[0]), max(one[1], other[1])
