"""MCAP files: attitudes on `/attitude` (JSON, which Foxglove and PlotJuggler open), the reader, and
the writer of run ledgers.

Reading is in order and in bounded memory, up to the point where the writer was killed. A chunk
states its unpacked size, which may be false: it is unpacked to that size and no further, and a
whole file to at most MAX_INFLATION times its own size. A damaged file is refused in one line.

Writing uses small chunks, for a run that may be killed and a disk that may be full:
1. A chunk is on the disk whole, with its CRC, or the file ends before it: a failed write leaves the
   file as it was.
2. Messages that could not be written are kept for the next attempt, until they are dropped by
   topic.
3. Memory does not grow with the file, except for an index of at most MAX_INDEX_BYTES; a longer file
   has none.
The library's writer obeys neither 1 nor 2, and its index grows by a megabyte in ten minutes of such
chunks.
"""

import bz2
import contextlib
import io
import logging
import os
import struct
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from types import MappingProxyType
from typing import IO, Any, NamedTuple, Self

import lz4.frame
import msgspec
from mcap import records as kinds
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import RecordLengthLimitExceeded
from mcap.opcode import Opcode
from mcap.stream_reader import CRCValidationError, StreamReader
from mcap.writer import Writer
from zstandard import ZstdCompressor
from zstandard import ZstdDecompressor as Zstd

from hilstar.attitude.wire.packet import AttitudeSample, Refusal, checked_sample
from hilstar.basics.errors import InputError, size_text
from hilstar.basics.files import MCAP_MAGIC
from hilstar.basics.reading import NOT_JSON, open_regular

Topics = Mapping[int, str]  # by channel
Messages = list[tuple[int, bytes]]  # channel and content
RUN_METADATA = "hilstar"  # the name of a ledger's head
ROS_ENCODINGS = frozenset({"cdr", "ros1"})
OWN_TOPICS = frozenset({"/attitude", "/frame"})
log = logging.getLogger(__name__)
NO_END = "has no end: cut short, or its writer was killed or still writes; what is whole is read"
ADVICE = "give an MCAP file, such as the ledger of a run"
MAX_CHUNK_BYTES = 64_000_000  # unpacked; writers make them of about 1 MB
MAX_RECORD_BYTES = 256_000_000
MAX_INFLATION, FREE_BYTES = 100, 32_000_000  # limits for a whole file; logs pack to a tenth
_record_head, _message_head, _chunk_head = (
    struct.Struct(form) for form in ("<BQ", "<HIQQ", "<QQQI8sQ")
)
_message_record, _footer_head = struct.Struct("<BQHIQQ"), struct.Struct("<BQQQ")
_message_start, ZSTD = struct.Struct("<BQH").unpack_from, b"\4\0\0\0zstd"
MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = map(
    int, (Opcode.MESSAGE, Opcode.CHUNK, Opcode.MESSAGE_INDEX, Opcode.CHUNK_INDEX)
)
HEAD_BYTES = 31  # a message's opcode, length, channel, sequence and two times
PIECE_BYTES = 1 << 18
MAX_INDEX_BYTES = 16_000_000  # about six hours at five chunks a second
LEVEL = 3  # zstd compression level
ATTITUDE_TOPIC = "/attitude"
ATTITUDE_SCHEMA_NAME = "hilstar.Attitude"
# Plain types only: Foxglove refuses a whole file over ["integer", "null"]. Unknown values are null
# in the message.
ATTITUDE_SCHEMA = msgspec.json.encode(
    {
        "title": ATTITUDE_SCHEMA_NAME,
        "type": "object",
        "properties": {
            "t_ns": {
                "type": "integer",
                "description": "sender's clock, ns; null in a refused message",
            },
            "sequence": {
                "type": "integer",
                "description": "sender's counter; null in a refused message",
            },
            "q": {
                "type": "array",
                "items": {"type": "number"},
                "description": "q_icrs_to_cam: w, x, y, z; null when refused",
            },
            "rate": {
                "type": "array",
                "items": {"type": "number"},
                "description": "of cam in icrs, cam axes, rad/s; or null",
            },
            "discontinuity": {
                "type": "boolean",
                "description": "do not interpolate from the previous attitude",
            },
            "receive_ns": {
                "type": "integer",
                "description": "receiver's clock at arrival, ns; null when not received",
            },
            "accepted": {"type": "boolean"},
            "reason": {"type": "string", "description": "why it was refused; or null"},
            "raw": {
                "type": "string",
                "description": "the packet as received, in hexadecimal; or null",
            },
        },
    }
)


class DamageError(ValueError):
    """What is wrong with a file."""


class TooLargeError(DamageError):
    """More than the limits allow."""


def part_path(path: Path, part: int) -> Path:
    """The name of part 1, 2, ... of a run whose ledger begins at `path`: RUN.0001.mcap and on."""
    if part:
        return path.with_name(f"{path.stem}.{part:04d}{path.suffix}")
    return path


def parts_of(path: Path) -> list[Path]:
    """The files of a run whose ledger begins at `path`; the file alone where it is not a first
    part. Raises InputError.
    """
    head = read_metadata(path, RUN_METADATA)
    parts = [path]
    while head.get("part") == "0" and (following := part_path(path, len(parts))).is_file():
        own_metadata = read_metadata(following, RUN_METADATA)
        if (own_metadata.get("run_id"), own_metadata.get("part")) != (
            head.get("run_id"),
            str(len(parts)),
        ):
            break
        parts.append(following)
    return parts


def read_chunks(path: Path, *, tell: bool = True) -> Iterator[tuple[Topics, Messages]]:
    """Every message of a run's files, in order, up to where its writer was killed: channel and
    content, a chunk's at once.

    With them come the topics by channel, the same object until one changes. If `tell`, the log gets
    a line of the first file that lacks its end, once all are read. Raises InputError for damage,
    and for anything but a regular file.
    """
    for part in parts_of(path):
        topics: dict[int, str] = {}
        channels: Topics = {}
        for record in records_of(part, topics):
            if isinstance(record, list):
                yield channels, record
            elif isinstance(record, kinds.Channel):
                topics[record.id] = record.topic
                channels = dict(topics)
            elif isinstance(record, kinds.Message) and record.channel_id in topics:
                yield channels, [(record.channel_id, record.data)]
    unfinished = unfinished_part(path) if tell else None
    if unfinished is not None:
        log.warning("%s %s", unfinished, NO_END)


def unfinished_part(path: Path) -> Path | None:
    """The first of a run's files that lacks the end which its writer gives it; None where all
    are whole. Raises InputError.
    """
    for part in parts_of(path):
        with open_regular(part, ADVICE) as file:
            if not _is_finished(file):
                return part
    return None


def read_messages(path: Path, topic: str, *, tell: bool = True) -> Iterator[bytes]:
    """The contents of the messages of one topic, as `read_chunks`."""
    for topics, messages in read_chunks(path, tell=tell):
        yield from [data for channel, data in messages if topics[channel] == topic]


def topics_of(path: Path) -> list[str]:
    """The topics that a file has channels for. Raises InputError for damage."""
    return sorted(
        {record.topic for record in records_of(path) if isinstance(record, kinds.Channel)}
    )


def read_metadata(path: Path, name: str) -> dict[str, str]:
    """The first metadata of that name, {} where there is none. Raises InputError for damage."""
    for record in records_of(path):
        if isinstance(record, kinds.Metadata) and record.name == name:
            return dict(record.metadata)
    return {}


def begins_as_ledger(path: Path) -> bool:
    """Whether a file has the head of a run's ledger, which stands before its topics. Raises
    InputError for damage before it.
    """
    heads = takewhile(
        lambda record: isinstance(record, kinds.Header | kinds.Metadata), records_of(path)
    )
    return any(isinstance(head, kinds.Metadata) and head.name == RUN_METADATA for head in heads)


def is_mcap(path: Path) -> bool:
    """True for a regular file that begins as MCAP does; False too where it cannot be read."""
    try:
        with open_regular(path, ADVICE) as file:
            return file.read(len(MCAP_MAGIC)) == MCAP_MAGIC
    except (InputError, OSError):
        return False


def holds_ros(path: Path) -> bool:
    """Whether the first channel that is hilstar's or ROS's is ROS's. Raises InputError for
    damage before it.
    """
    for record in records_of(path):
        if not isinstance(record, kinds.Channel):
            continue
        if record.message_encoding in ROS_ENCODINGS:
            return True
        # JSON of other topics may be anybody's
        if record.message_encoding == "json" and record.topic in OWN_TOPICS:
            return False
    return False


def records_of(path: Path, topics: Topics = MappingProxyType({})) -> Iterator[Any]:
    """Every record of one file but its indexes, chunks unpacked into their schemas, channels and
    messages.

    A chunk that is messages of known `topics` alone comes as one list. Raises InputError for
    damage.
    """
    with open_regular(path, ADVICE) as file:
        finished = _is_finished(file)
        size = file.seek(0, os.SEEK_END)
        file.seek(0)
        if not MCAP_MAGIC.startswith(file.read(len(MCAP_MAGIC))):
            raise InputError(f"{path}: is no MCAP file; {ADVICE}")
        file.seek(0)
        reader = _Reader(file, size)
        records = reader.all()
        # making one takes longer than unpacking a chunk
        room = FREE_BYTES + MAX_INFLATION * size
        zstd = Zstd()
        while True:
            try:
                record = next(records, None)
                if isinstance(record, kinds.Chunk):
                    data = _unpacked(record, room, zstd)
                else:
                    data = None
            except Exception as error:
                # the reader passes on what struct, zstd, lz4 and UTF-8 raise
                cut_off = isinstance(error, RecordLengthLimitExceeded) or reader.place == size
                if cut_off and not finished and not isinstance(error, TooLargeError):
                    return
                raise _refused(path, reader.place, error) from error
            if record is None:
                return
            if data is None:
                yield record
                continue
            room -= len(data)
            messages = _messages_in(data, topics)
            try:
                yield from _inside(data) if messages is None else (messages,)
            except Exception as error:
                raise _refused(path, reader.place, error) from error


class _Reader(StreamReader):
    """Takes whole chunks from many of a file's bytes at once, and skips indexes, which nothing here
    uses.

    The library reads field by field, which takes as long as all else of a report. It still has
    whatever is not plain. It never asks for more than the file has, whatever length a record
    states.
    """

    def __init__(self, file: IO[bytes], size: int) -> None:
        super().__init__(self, emit_chunks=True, record_size_limit=size)  # type: ignore[arg-type]
        self._file = file
        self._size = size
        self.place = 0
        self._crcs = (0, 0, 0)  # CRC-32 of the file up to two reads ago, to one, and to here

    def read(self, length: int) -> bytes:
        """At most `length` bytes, for the library. Raises TooLargeError for a record over
        MAX_RECORD_BYTES.
        """
        rest_bytes = self._size - self.place
        if MAX_RECORD_BYTES < length <= rest_bytes:
            raise TooLargeError(
                f"a record of {size_text(length)}; at most {size_text(MAX_RECORD_BYTES)} are read"
            )
        data = self._file.read(min(length, rest_bytes))
        self.place += len(data)
        self._crcs = (*self._crcs[1:], zlib.crc32(data, self._crcs[-1]))
        return data

    def all(self) -> Iterator[kinds.McapRecord]:
        """Every record, each ending before the byte `place`. Raises what the library does."""
        for record in self.records:
            yield record
            if isinstance(record, kinds.Chunk | kinds.ChunkIndex):
                yield from self._plain_chunks()

    def _plain_chunks(self) -> Iterator[kinds.Chunk]:
        """The chunks from here to the first record that is neither one nor an index, or in which
        something is odd.
        """
        at = PIECE_BYTES
        while at:
            begin = self.place
            at = 0
            piece = self._file.read(min(PIECE_BYTES, self._size - begin))
            while at + 9 <= len(piece):
                opcode, length = _record_head.unpack_from(piece, at)
                body = at + 9
                end = at + 9 + length
                if end > len(piece):
                    break
                if opcode == CHUNK and length >= _chunk_head.size:
                    first_ns, last_ns, size, crc, packing, packed = _chunk_head.unpack_from(
                        piece, body
                    )
                    if packing != ZSTD or packed != length - _chunk_head.size:
                        break
                    self.place = begin + end
                    yield kinds.Chunk(
                        "zstd", piece[end - packed : end], last_ns, first_ns, crc, size
                    )
                elif opcode == CHUNK_INDEX and length >= 68:
                    if (length - 68) % 10 == 0:
                        offsets = (length - 68).to_bytes(4, "little")
                    else:
                        offsets = b""
                    if (
                        piece[body + 32 : body + 36] != offsets
                        or piece[end - 24 : end - 16] != ZSTD
                    ):
                        break
                elif opcode != MESSAGE_INDEX:
                    break
                at = end
            self._crcs = (*self._crcs[1:], zlib.crc32(memoryview(piece)[:at], self._crcs[-1]))
            self.place = self._file.seek(begin + at)

    def _read_record(self, opcode: int, length: int) -> kinds.McapRecord | None:
        before = self._crcs[0]  # the opcode and the length were read since
        if opcode == MESSAGE_INDEX:
            record = None
        else:
            record = super()._read_record(opcode, length)
        if isinstance(record, kinds.DataEnd) and record.data_section_crc not in {0, before}:
            raise CRCValidationError(record.data_section_crc, before, record)
        return record


def _is_finished(file: IO[bytes]) -> bool:
    size = file.seek(0, os.SEEK_END)
    file.seek(max(0, size - len(MCAP_MAGIC)))
    return size > 2 * len(MCAP_MAGIC) and file.read() == MCAP_MAGIC


def _refused(path: Path, place: int, error: Exception) -> InputError:
    if isinstance(error, TooLargeError):
        return InputError(f"{path}: {error}; {ADVICE}")
    if isinstance(error, DamageError):
        detail = str(error)
    else:
        detail = f"{type(error).__name__} {error}".strip()
    return InputError(f"{path}: is damaged before byte {place} ({detail}); record the log again")


def unpacked(
    data: bytes, compression: str, limit: int, exact: bool = True, zstd: Zstd | None = None
) -> bytes:
    """What was packed: `limit` bytes, or if not `exact` at most so many. Raises DamageError, and
    what the unpackers raise.
    """
    if compression == "zstd":
        with (zstd or Zstd()).stream_reader(data) as stream:
            whole = stream.read(limit + 1)
    elif compression in {"bz2", "lz4"}:
        if compression == "bz2":
            unpacker = bz2.BZ2Decompressor()
        else:
            unpacker = lz4.frame.LZ4FrameDecompressor()
        whole = unpacker.decompress(data, max_length=limit + 1)
    else:
        whole = data
    if len(whole) > limit or (exact and len(whole) != limit):
        raise DamageError(
            f"a chunk contains {'more' if len(whole) > limit else 'less'} than the {limit} bytes"
            " that it states"
        )
    return whole


def _unpacked(chunk: kinds.Chunk, room: int, zstd: Zstd) -> bytes:
    size = chunk.uncompressed_size
    if size > MAX_CHUNK_BYTES:
        raise TooLargeError(
            f"a chunk of {size_text(size)}; at most {size_text(MAX_CHUNK_BYTES)} are unpacked"
        )
    if size > room:
        raise TooLargeError(f"unpacks to more than {MAX_INFLATION} times its size")
    if chunk.compression not in {"", "zstd", "lz4"}:
        raise DamageError(f"compression {chunk.compression[:20]!r} is neither zstd nor lz4")
    data = unpacked(chunk.data, chunk.compression, size, zstd=zstd)
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise DamageError("the CRC-32 of a chunk does not match")
    return data


def _messages_in(data: bytes, topics: Topics) -> Messages | None:
    place = 0
    end = len(data)
    messages = []
    while place + HEAD_BYTES <= end:
        opcode, length, channel = _message_start(data, place)
        if opcode != MESSAGE or length < _message_head.size or channel not in topics:
            return None
        body = place + HEAD_BYTES
        place = place + 9 + length
        messages.append((channel, data[body:place]))
    return messages if place == end else None


def _inside(data: bytes) -> Iterator[kinds.McapRecord]:
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
            yield kinds.Message(
                channel,
                log_ns,
                data[place + _message_head.size : place + length],
                publish_ns,
                sequence,
            )
        elif opcode in {Opcode.CHANNEL, Opcode.SCHEMA}:
            kind = kinds.Channel if opcode == Opcode.CHANNEL else kinds.Schema
            yield kind.read(ReadDataStream(io.BytesIO(data[place : place + length])))
        place += length


@dataclass(frozen=True, slots=True)
class JsonTopic:
    """A channel of JSON messages: its schema's name, and that schema."""

    name: str
    schema_name: str
    schema: bytes


class _Pending(NamedTuple):
    channel: int
    time_ns: int
    record: bytes


class McapWriter:
    """Writes to a file descriptor that is open for appending (O_APPEND) and empty; closing it stays
    the caller's. Raises OSError.
    """

    def __init__(
        self,
        fd: int,
        topics: Mapping[str, JsonTopic],
        metadata_name: str,
        metadata: Mapping[str, str],
    ) -> None:
        self.size_bytes = 0
        self._fd = fd
        self._ids = {key: number for number, key in enumerate(topics, start=1)}
        self._schemas = [
            kinds.Schema(i, topic.schema, "jsonschema", topic.schema_name)
            for i, topic in enumerate(topics.values(), 1)
        ]
        self._channels = [
            kinds.Channel(i, topic.name, "json", {}, i)
            for i, topic in enumerate(topics.values(), 1)
        ]
        self._pending: list[_Pending] = []
        self.pending_bytes = 0
        self.crc = 0  # CRC-32 of all that is written
        self._index = bytearray()
        self._indexed = True
        self._counts: Counter[int] = Counter()
        self._chunks = 0
        self._times_ns: list[int] = []  # the first and the last of all messages
        self._compressor = ZstdCompressor(level=LEVEL)
        head = kinds.Metadata(metadata_name, dict(metadata))
        before = MCAP_MAGIC + _bytes_of(kinds.Header("", "hilstar"))
        whole = _bytes_of(head)
        self._metadata_index = kinds.MetadataIndex(len(before), len(whole), metadata_name)
        # Outside the first chunk: most readers also look for channels there, and these are never
        # lost with a chunk.
        self._append(before + whole + _bytes_of(*self._schemas, *self._channels))

    def add(self, key: str, time_ns: int, data: bytes, sequence: int) -> None:
        """Take a message of the topic named `key`; it is written at the next flush."""
        record = (
            _message_record.pack(
                Opcode.MESSAGE, 22 + len(data), self._ids[key], sequence % 2**32, time_ns, time_ns
            )
            + data
        )
        self._pending.append(_Pending(self._ids[key], time_ns, record))
        self.pending_bytes += len(record)

    @property
    def written(self) -> int:
        """How many messages are in the file."""
        return self._counts.total()

    def take_over(self, other: Self) -> None:
        """Take the messages that another writer of the same topics has not written yet."""
        self._pending = other._pending
        self.pending_bytes = other.pending_bytes
        other._pending = []
        other.pending_bytes = 0

    def drop(self, key: str | None = None) -> int:
        """Forget the messages of a topic (None: of all) that are not written yet; returns their
        number.
        """
        if key is None:
            remaining = []
        else:
            remaining = [entry for entry in self._pending if entry.channel != self._ids[key]]
        dropped = len(self._pending) - len(remaining)
        self._pending = remaining
        self.pending_bytes = sum(len(entry.record) for entry in remaining)
        return dropped

    def flush(self) -> None:
        """Write what was added, as one chunk. Raises OSError, and keeps the messages."""
        if not self._pending:
            return
        data = b"".join(entry.record for entry in self._pending)
        times_ns = [entry.time_ns for entry in self._pending]
        first_ns = min(times_ns)
        last_ns = max(times_ns)
        packed = self._compressor.compress(data)
        chunk = _bytes_of(
            kinds.Chunk("zstd", packed, last_ns, first_ns, zlib.crc32(data), len(data))
        )
        # by channel: the times of its messages and where they begin
        entries: dict[int, list[tuple[int, int]]] = {}
        offset = 0
        for channel, time_ns, record in self._pending:
            entries.setdefault(channel, []).append((time_ns, offset))
            offset += len(record)
        indexes = b""
        offsets = {}
        place = self.size_bytes
        for channel, records in entries.items():
            offsets[channel] = place + len(chunk) + len(indexes)
            indexes += _bytes_of(kinds.MessageIndex(channel, records))
        self._append(chunk + indexes)
        self._counts.update(entry.channel for entry in self._pending)
        self._pending = []
        self.pending_bytes = 0
        self._chunks += 1
        self._times_ns += [first_ns, last_ns]
        self._times_ns = [min(self._times_ns), max(self._times_ns)]
        if self._indexed:
            entry = kinds.ChunkIndex(
                len(chunk),
                place,
                "zstd",
                len(packed),
                last_ns,
                len(indexes),
                offsets,
                first_ns,
                len(data),
            )
            self._index += _bytes_of(entry)
        if len(self._index) > MAX_INDEX_BYTES:
            self._indexed = False
            self._index = bytearray()

    def finish(self) -> None:
        """Write what was added, the index and the end. Raises OSError; the file is then as if
        its writer had been killed.
        """
        self.flush()
        end = _bytes_of(kinds.DataEnd(self.crc))
        start = self.size_bytes + len(end)
        first_ns, last_ns = self._times_ns or (0, 0)
        totals = (self.written, last_ns, first_ns)
        statistics = kinds.Statistics(
            0, len(self._channels), dict(self._counts), self._chunks, *totals, 1, len(self._schemas)
        )
        groups = {
            Opcode.SCHEMA: _bytes_of(*self._schemas),
            Opcode.CHANNEL: _bytes_of(*self._channels),
            Opcode.STATISTICS: _bytes_of(statistics),
            Opcode.CHUNK_INDEX: bytes(self._index),
            Opcode.METADATA_INDEX: _bytes_of(self._metadata_index),
        }
        summary = b""
        offsets = b""
        for opcode, group in groups.items():
            if group:
                offsets += _bytes_of(kinds.SummaryOffset(opcode, start + len(summary), len(group)))
            summary += group
        offset_start = start + len(summary)
        summary += offsets
        crc = zlib.crc32(
            _footer_head.pack(Opcode.FOOTER, 20, start, offset_start), zlib.crc32(summary)
        )
        self._append(end + summary + _bytes_of(kinds.Footer(start, offset_start, crc)) + MCAP_MAGIC)

    def _append(self, data: bytes) -> None:
        try:
            rest = memoryview(data)
            while rest:
                rest = rest[os.write(self._fd, rest) :]
        except OSError:
            with contextlib.suppress(OSError):
                os.ftruncate(self._fd, self.size_bytes)
            raise
        self.size_bytes += len(data)
        self.crc = zlib.crc32(data, self.crc)


def _bytes_of(*records: kinds.McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]


class _Form(msgspec.Struct):
    t_ns: int | None
    sequence: int | None = 0
    q: tuple[float, float, float, float] | None = None
    rate: tuple[float, float, float] | None = None
    discontinuity: bool = False
    receive_ns: int | None = None
    accepted: bool = True
    reason: str | None = None
    raw: str | None = None


ATTITUDE_TOPIC_OF_RUN = JsonTopic(ATTITUDE_TOPIC, ATTITUDE_SCHEMA_NAME, ATTITUDE_SCHEMA)

_decoder = msgspec.json.Decoder(_Form)
_encoder = msgspec.json.Encoder()


def attitude_message(
    sample: AttitudeSample, receive_ns: int | None = None, raw: bytes | None = None
) -> bytes:
    """The JSON of an accepted sample; `receive_ns` is the receiver's clock at arrival, `raw` the
    packet as received.
    """
    q = tuple(sample.q_icrs_to_cam.tolist())
    rate = sample.rate_cam_rad_s
    turning = None if rate is None else tuple(rate.tolist())
    packet = None if raw is None else raw.hex()
    return _encoder.encode(
        _Form(
            sample.t_ns, sample.sequence, q, turning, sample.discontinuity, receive_ns, raw=packet
        )
    )


def refused_message(reason: str, detail: str, receive_ns: int | None, raw: bytes | None) -> bytes:
    """The JSON of a refused packet, with "reason: detail"."""
    packet = None if raw is None else raw.hex()
    why = f"{reason}: {detail}"
    return _encoder.encode(
        _Form(None, None, receive_ns=receive_ns, accepted=False, reason=why, raw=packet)
    )


def register_attitudes(writer: Writer) -> int:
    """The id of a new `/attitude` channel in an MCAP writer that has been started."""
    schema_id = writer.register_schema(ATTITUDE_SCHEMA_NAME, "jsonschema", ATTITUDE_SCHEMA)
    return writer.register_channel(ATTITUDE_TOPIC, "json", schema_id)


def log_time_ns(t_ns: int, receive_ns: int | None = None) -> int:
    """The unsigned log time of a message: `receive_ns` where known, else `t_ns`, and 0 for
    negative times.
    """
    return max(0, t_ns if receive_ns is None else receive_ns)


def write_attitudes(file: IO[bytes], samples: Sequence[AttitudeSample]) -> None:
    """Write a whole MCAP file of samples to an open file. Raises OSError."""
    writer = Writer(file, enable_data_crcs=True)
    writer.start(profile="", library="hilstar")
    channel_id = register_attitudes(writer)
    for sample in samples:
        time_ns = log_time_ns(sample.t_ns)
        message = attitude_message(sample)
        writer.add_message(
            channel_id,
            log_time=time_ns,
            data=message,
            publish_time=time_ns,
            sequence=sample.sequence % 2**32,
        )
    writer.finish()  # type: ignore[no-untyped-call]


def read_attitudes(path: Path) -> Iterator[AttitudeSample]:
    """The samples of `read_events`. Raises InputError as it does, and for what is no attitude."""
    for where, event in read_events(path):
        if isinstance(event, Refusal):
            raise InputError(f"{path}{where}: {event.detail}")
        yield event


def read_events(path: Path) -> Iterator[tuple[str, AttitudeSample | Refusal]]:
    """Each message's place, and its sample or why it is none, in the order of the file; other
    channels and packets that were refused when they came are skipped.

    A file whose writer was killed gives everything before its last, unfinished chunk. Raises
    InputError for damage, and for a message that is not an attitude.
    """
    for number, data in enumerate(read_messages(path, ATTITUDE_TOPIC), start=1):
        place = f": message {number} of {ATTITUDE_TOPIC}"
        where = f"{path}{place}:"
        try:
            form = _decoder.decode(data)
        except NOT_JSON as error:
            raise InputError(f"{where} is not a hilstar attitude ({error})") from error
        if not form.accepted:
            continue
        if form.t_ns is None or form.q is None:
            raise InputError(f"{where} is accepted, but lacks t_ns or q")
        yield (
            place,
            checked_sample(form.t_ns, form.q, form.rate, form.sequence or 0, form.discontinuity),
        )
