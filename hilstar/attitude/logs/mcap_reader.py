"""MCAP files read in order and in bounded memory, up to where their writer was killed.

A chunk states its unpacked size, which may be false: it is unpacked to that size and no further, and a whole file to at most
MAX_INFLATION times its own. A damaged file is refused in one line.
"""

from __future__ import annotations

import io
import logging
import os
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import RecordLengthLimitExceeded
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import StreamReader

from hilstar.errors import InputError
from hilstar.reading import MCAP_MAGIC, open_regular, size_text

RUN_METADATA = "hilstar"  # the name of a ledger's head
ROS_ENCODINGS = frozenset({"cdr", "ros1"})
OWN_TOPICS = frozenset({"/attitude", "/frame"})
log = logging.getLogger(__name__)
NO_END = "has no end: cut short, or its writer was killed or still writes; what is whole is read"
ADVICE = "give an MCAP file, such as the ledger of a run"
MAX_CHUNK_BYTES = 64_000_000  # unpacked; writers make them of about 1 MB
MAX_RECORD_BYTES = 256_000_000
MAX_INFLATION, FREE_BYTES = 100, 32_000_000  # of a whole file; logs pack to a tenth
_record_head = struct.Struct("<BQ")
_message_head = struct.Struct("<HIQQ")


class DamageError(Exception):
    """What is wrong with a file."""


class TooLargeError(DamageError):
    """More than the limits allow."""


def part_path(path: Path, part: int) -> Path:
    """The name of part 1, 2, ... of a run whose ledger begins at `path`: RUN.0001.mcap and on."""
    return path.with_name(f"{path.stem}.{part:04d}{path.suffix}") if part else path


def parts_of(path: Path) -> list[Path]:
    """The files of a run whose ledger begins at `path`; the file alone where it is not a first part. Raises InputError."""
    head = read_metadata(path, RUN_METADATA)
    parts = [path]
    while head.get("part") == "0" and (following := part_path(path, len(parts))).is_file():
        own = read_metadata(following, RUN_METADATA)
        if (own.get("run_id"), own.get("part")) != (head.get("run_id"), str(len(parts))):
            break
        parts.append(following)
    return parts


def read_topics(path: Path, *, tell: bool = True) -> Iterator[tuple[str, bytes]]:
    """Topic and content of every message of a run's files, in their order, up to where its writer was killed.

    A file that ends so is said in one line of the log, once it is read, unless not `tell`. Raises InputError for damage, and
    for anything but a regular file.
    """
    for part in parts_of(path):
        channels: dict[int, str] = {}
        for record in records_of(part):
            if isinstance(record, Channel):
                channels[record.id] = record.topic
            elif isinstance(record, Message) and record.channel_id in channels:
                yield channels[record.channel_id], record.data
    unfinished = unfinished_part(path) if tell else None
    if unfinished is not None:
        log.warning("%s %s", unfinished, NO_END)


def unfinished_part(path: Path) -> Path | None:
    """The first of a run's files that lacks the end which its writer gives it; None where all are whole. Raises InputError."""
    for part in parts_of(path):
        with open_regular(part, ADVICE) as file:
            if not _is_finished(file):
                return part
    return None


def read_messages(path: Path, topic: str, *, tell: bool = True) -> Iterator[bytes]:
    """What the messages of one topic hold; a file without its end is said unless not `tell`. Raises InputError for damage."""
    yield from (data for name, data in read_topics(path, tell=tell) if name == topic)


def topics_of(path: Path) -> list[str]:
    """The topics that a file has channels for. Raises InputError for damage."""
    return sorted({record.topic for record in records_of(path) if isinstance(record, Channel)})


def read_metadata(path: Path, name: str) -> dict[str, str]:
    """The first metadata of that name, {} where there is none. Raises InputError for damage."""
    return next((dict(r.metadata) for r in records_of(path) if isinstance(r, Metadata) and r.name == name), {})


def is_mcap(path: Path) -> bool:
    """True for a regular file that begins as MCAP does; False too where it cannot be read."""
    try:
        with open_regular(path, ADVICE) as file:
            return file.read(len(MCAP_MAGIC)) == MCAP_MAGIC
    except (InputError, OSError):
        return False


def holds_ros(path: Path) -> bool:
    """Whether the first channel that is hilstar's or ROS's is ROS's. Raises InputError for damage before it."""
    for record in records_of(path):
        if isinstance(record, Channel):
            if record.message_encoding in ROS_ENCODINGS:
                return True
            if record.message_encoding == "json" and record.topic in OWN_TOPICS:
                return False
    return False


def records_of(path: Path) -> Iterator[McapRecord]:
    """Every record of one file, chunks unpacked into their schemas, channels and messages. Raises InputError for damage."""
    with open_regular(path, ADVICE) as file:
        yield from _open_records(path, file)


class _Capped:
    """A file that is never asked for more than it has, whatever length a record states."""

    def __init__(self, file: IO[bytes], size: int) -> None:
        self._file, self.left = file, size

    def read(self, length: int) -> bytes:
        """At most `length` bytes. Raises TooLargeError for a record over MAX_RECORD_BYTES."""
        if MAX_RECORD_BYTES < length <= self.left:
            raise TooLargeError(f"a record of {size_text(length)}; at most {size_text(MAX_RECORD_BYTES)} are read")
        data = self._file.read(min(length, self.left))
        self.left -= len(data)
        return data


def _is_finished(file: IO[bytes]) -> bool:
    """Whether a file has the end that a writer gives it, and not what a crash leaves."""
    size = file.seek(0, os.SEEK_END)
    file.seek(max(0, size - len(MCAP_MAGIC)))
    return size > 2 * len(MCAP_MAGIC) and file.read() == MCAP_MAGIC


def _open_records(path: Path, file: IO[bytes]) -> Iterator[McapRecord]:
    finished = _is_finished(file)
    size = file.seek(0, os.SEEK_END)
    file.seek(0)
    if not MCAP_MAGIC.startswith(file.read(len(MCAP_MAGIC))):
        raise InputError(f"{path}: is no MCAP file; {ADVICE}")
    file.seek(0)
    capped = _Capped(file, size)
    reader = StreamReader(capped, emit_chunks=True, validate_crcs=True, record_size_limit=size)  # type: ignore[arg-type]
    records = reader.records
    room = FREE_BYTES + MAX_INFLATION * size
    while True:
        try:
            record = next(records, None)
            inner = []
            if isinstance(record, Chunk):
                inner = [_unpacked(record, room)]
                room -= len(inner[0])
        except Exception as error:  # the reader passes on what struct, zstd, lz4 and UTF-8 raise
            cut_off = isinstance(error, RecordLengthLimitExceeded) or not capped.left
            if cut_off and not finished and not isinstance(error, TooLargeError):
                return
            raise _refused(path, file, error) from error
        if record is None:
            return
        if not inner:
            yield record
        for data in inner:
            try:
                yield from _inside(data)
            except Exception as error:
                raise _refused(path, file, error) from error


def _refused(path: Path, file: IO[bytes], error: Exception) -> InputError:
    if isinstance(error, TooLargeError):
        return InputError(f"{path}: {error}; {ADVICE}")
    detail = str(error) if isinstance(error, DamageError) else f"{type(error).__name__} {error}".strip()
    return InputError(f"{path}: is damaged before byte {file.tell()} ({detail}); record the log again")


def _unpacked(chunk: Chunk, room: int) -> bytes:
    """A chunk's content, once its size and CRC are those that it states."""
    size = chunk.uncompressed_size
    if size > MAX_CHUNK_BYTES:
        raise TooLargeError(f"a chunk of {size_text(size)}; at most {size_text(MAX_CHUNK_BYTES)} are unpacked")
    if size > room:
        raise TooLargeError(f"unpacks to more than {MAX_INFLATION} times its size")
    if chunk.compression == "zstd":
        with zstandard.ZstdDecompressor().stream_reader(chunk.data) as stream:
            data = stream.read(size + 1)
    elif chunk.compression == "lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
    elif chunk.compression:
        raise DamageError(f"compression {chunk.compression[:20]!r} is neither zstd nor lz4")
    else:
        data = chunk.data
    if len(data) != size:
        raise DamageError(f"a chunk contains {'more' if len(data) > size else 'less'} than the {size} bytes that it states")
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise DamageError("the CRC-32 of a chunk does not match")
    return data


def _inside(data: bytes) -> Iterator[McapRecord]:
    """The schemas, channels and messages of a chunk."""
    place = 0
    while place < len(data):
        opcode, length = _record_head.unpack_from(data, place)
        place += _record_head.size
        if length > len(data) - place:
            raise DamageError("a record is longer than its chunk")
        if opcode == Opcode.MESSAGE:
            if length < _message_head.size:
                raise DamageError("a message is shorter than its head")
            channel, sequence, log_ns, publish_ns = _message_head.unpack_from(data, place)
            yield Message(channel, log_ns, data[place + _message_head.size : place + length], publish_ns, sequence)
        elif opcode in {Opcode.CHANNEL, Opcode.SCHEMA}:
            kind = Channel if opcode == Opcode.CHANNEL else Schema
            yield kind.read(ReadDataStream(io.BytesIO(data[place : place + length])))
        place += length
