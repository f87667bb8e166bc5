"""ROS bags of every storage format: one file, or the directory of a ROS 2 bag with its metadata.yaml.

- ROS 2 in SQLite (.db3): the tables `topics` and `messages`, and `message_definitions` from Iron on.
- ROS 2 in MCAP, its default, which other programs write with ROS's schemas too.
- ROS 1, format 2.0 (wiki.ros.org/Bags/Format/2.0), read from the front in bounded memory. A record is a header of NAME=VALUE
  fields and its data; chunks hold connections (a topic and its type) and messages. A closed bag repeats its connections in an
  index at its end. A bag whose recorder was killed has no index and is cut anywhere; all its whole records are read.

A bag states the unpacked sizes of its chunks, which may be false: nothing is unpacked beyond the limits below.
"""

import contextlib
import io
import os
import re
import sqlite3
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Literal, NamedTuple
from urllib.parse import quote

import zstandard
from mcap.records import Channel, Schema
from mcap.records import Message as McapMessage

from hilstar.attitude.logs.mcap_log import ROS_ENCODINGS, records_of, unpacked
from hilstar.errors import InputError, shortened
from hilstar.files import temporary_folder
from hilstar.reading import (
    HEAD_BYTES,
    MCAP_MAGIC,
    ROSBAG_MAGIC,
    SQLITE_MAGIC,
    by_number,
    open_regular,
    read_text,
    refuse_kind,
    size_text,
)
from hilstar.units import NS_PER_S

BAG_ADVICE = "give a bag of ROS 1 (.bag) or ROS 2 (.db3, .mcap, or the bag's directory)"
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
MAX_CHUNK_BYTES = 256_000_000  # unpacked; recorders make them of about 1 MB
MAX_MESSAGE_BYTES = 64_000_000
MAX_INFLATION, FREE_BYTES = 100, 32_000_000  # limits for a whole file; logs pack to a tenth
PIECE_BYTES = 1 << 20

Encoding = Literal["ros1", "cdr"]
MAX_TOPICS = 10_000
VERSION = b"#ROSBAG V2.0\n"
MESSAGE, CHUNK, CONNECTION = 2, 5, 7  # operations of records
MAX_HEADER_BYTES = 1_000_000
_u32, _u64, _time = struct.Struct("<I"), struct.Struct("<Q"), struct.Struct("<II")
# What the bytes of a record that is not one raise, in struct, in the fields and in the unpackers.
FAULTS = (struct.error, KeyError, ValueError, OSError, EOFError, RuntimeError)
Fields = dict[bytes, bytes]
METADATA = "metadata.yaml"
MAX_METADATA_BYTES = 2_000_000
MAX_FILES = 10_000
MAX_NAME_CHARACTERS = 255
FILE_LIST = re.compile(r"^[ ]*relative_file_paths:[ ]*(?:\[([^\]\n]*)\]|\n((?:[ ]*-[ ][^\n]*(?:\n|\Z))+))", re.MULTILINE)
FILE_NAME = re.compile(r".*\.(db3|mcap)(\.zstd)?")


class BagTopic(NamedTuple):
    """A topic of a bag: `type` as PACKAGE/msg/NAME; `definition` is the type's text in the bag, "" where it has none."""

    name: str
    type: str
    encoding: Encoding
    definition: str = ""


class Message(NamedTuple):
    """What a bag holds of one message: when it was recorded, ns of the recorder's clock, and its serialised bytes."""

    receive_ns: int
    data: bytes


def type_name(text: str) -> str:
    """A type as PACKAGE/msg/NAME, however a bag writes it."""
    parts = text.replace("::", "/").split("/")
    return f"{parts[0]}/msg/{parts[1]}" if len(parts) == 2 else "/".join(parts)


def _message_bytes(data: bytes) -> bytes:
    """A message's bytes, unpacked where the recorder packed each by itself (no CDR begins as Zstandard does)."""
    return unpacked(data, "zstd", MAX_CHUNK_BYTES, exact=False) if data[:4] == ZSTD_MAGIC else data


def _damaged(path: Path, reason: object, where: str = "") -> InputError:
    words = shortened(" ".join(str(reason).split()))
    return InputError(f"{path}: the bag is damaged{where} ({words}); record it again, or repair it with ROS's own tools")


class _Db3File:
    """A .db3 file: topics, messages as recorded, and notices of what is missing. Its methods raise InputError for damage."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def topics(self) -> list[BagTopic]:
        with self._open() as database:
            texts = {}
            if self._tables(database, "message_definitions"):
                rows = database.execute("SELECT topic_type, encoding, encoded_message_definition FROM message_definitions")
                texts = {name: text for name, encoding, text in rows.fetchmany(MAX_TOPICS) if encoding == "ros2msg"}
            rows = database.execute("SELECT name, type FROM topics WHERE serialization_format = 'cdr' ORDER BY id")
            found = [
                BagTopic(str(name), type_name(str(kind)), "cdr", str(texts.get(kind, "")))
                for name, kind in rows.fetchmany(MAX_TOPICS)
            ]
            return list(dict.fromkeys(found))

    def messages(self, topic: BagTopic) -> Iterator[Message]:
        with self._open() as database:
            topics = database.execute("SELECT id, name, type FROM topics").fetchmany(MAX_TOPICS)
            ids = [number for number, name, kind in topics if (name, type_name(str(kind))) == (topic.name, topic.type)]
            marks = ",".join("?" * len(ids))
            rows = database.execute(f"SELECT timestamp, data FROM messages WHERE topic_id IN ({marks}) ORDER BY id", ids)
            for receive_ns, data in rows:
                if not isinstance(receive_ns, int) or not isinstance(data, bytes):
                    raise _damaged(self._path, "a message without time or bytes")
                yield Message(receive_ns, _message_bytes(data))

    def told(self) -> list[tuple[str, str]]:
        log = self._path.with_name(self._path.name + "-wal")
        if not log.is_file() or not log.stat().st_size:
            return []
        advice = f"merge it with: sqlite3 {self._path.name} 'PRAGMA wal_checkpoint'"
        return [("log-cut", f"what {log.name} has is not read, since its recorder did not close the bag; {advice}")]

    @contextlib.contextmanager
    def _open(self) -> Iterator[sqlite3.Connection]:
        place = f"file:{quote(str(self._path.absolute()))}?mode=ro&immutable=1"
        try:
            with contextlib.closing(sqlite3.connect(place, uri=True)) as database:
                database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_MESSAGE_BYTES)
                database.execute("PRAGMA trusted_schema = off")
                if self._tables(database, "topics", "messages") != 2:
                    raise InputError(f"{self._path}: an SQLite database, but no bag of ROS 2: it lacks topics and messages")
                yield database
        except (sqlite3.Error, ValueError, OverflowError, zstandard.ZstdError) as error:
            raise _damaged(self._path, error) from error

    def _tables(self, database: sqlite3.Connection, *names: str) -> int:
        """How many of the names are tables (a view would run what the file says)."""
        marks = ",".join("?" * len(names))
        query = f"SELECT count(*) FROM sqlite_master WHERE type = 'table' AND name IN ({marks})"
        return int(database.execute(query, names).fetchone()[0])


class _McapBag:
    def __init__(self, path: Path) -> None:
        self._path = path

    def topics(self) -> list[BagTopic]:
        return list(dict.fromkeys(found for found in self._records() if isinstance(found, BagTopic)))

    def messages(self, topic: BagTopic) -> Iterator[Message]:
        for found in self._records(topic):
            if isinstance(found, Message):
                yield found

    def told(self) -> list[tuple[str, str]]:
        with self._path.open("rb") as file:
            file.seek(-min(len(MCAP_MAGIC), self._path.stat().st_size), os.SEEK_END)
            if file.read() == MCAP_MAGIC:
                return []
        return [("log-cut", f"{self._path} was not closed by its recorder; all chunks that are whole are read")]

    def _records(self, wanted: BagTopic | None = None) -> Iterator[BagTopic | Message]:
        """Every topic, and each message of the wanted one."""
        channels: dict[int, BagTopic] = {}
        schemas: dict[int, Schema] = {}
        for record in records_of(self._path):
            if isinstance(record, McapMessage):
                if wanted is not None and channels.get(record.channel_id) == wanted:
                    try:
                        yield Message(record.log_time, _message_bytes(record.data))
                    except (ValueError, zstandard.ZstdError) as error:
                        raise _damaged(self._path, error) from error
            elif isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel) and record.message_encoding in ROS_ENCODINGS and record.schema_id in schemas:
                schema = schemas[record.schema_id]
                text = schema.data.decode(errors="replace") if schema.encoding in {"ros2msg", "ros1msg"} else ""
                encoding: Encoding = "ros1" if record.message_encoding == "ros1" else "cdr"
                channels[record.id] = BagTopic(record.topic, type_name(schema.name), encoding, text)
                yield channels[record.id]


class _CutError(Exception):
    """The file ends within a record."""


class _BagFile:
    def __init__(self, path: Path) -> None:
        self._path = path
        self._cut_at: int | None = None
        self._topics: dict[int, BagTopic] = {}

    def topics(self) -> list[BagTopic]:
        """The connections of the index; without one, those of all chunks."""
        for start in (self._index_at(), len(VERSION)):
            if start and not self._topics:  # an index that names nothing is not where the bag says
                for _ in self._records(start):
                    pass
        return list(dict.fromkeys(self._topics.values()))

    def messages(self, topic: BagTopic) -> Iterator[Message]:
        for connection, message in self._records(len(VERSION)):
            if self._topics.get(connection) == topic:
                yield message

    def told(self) -> list[tuple[str, str]]:
        if self._cut_at is None:
            return []
        return [("log-cut", f"{self._path} ends within a record at byte {self._cut_at}; all that is whole before it is read")]

    def _index_at(self) -> int:
        """Where the index begins, 0 where the bag has none."""
        with open_regular(self._path, BAG_ADVICE) as file:
            if file.readline(len(VERSION)) != VERSION:
                raise InputError(f"{self._path}: a ROS 1 bag of another version than 2.0; convert it with rosbag's own tools")
            try:
                fields, _ = _record(file) or ({b"index_pos": bytes(_u64.size)}, b"")
                if fields.get(b"encryptor"):
                    raise InputError(f"{self._path}: an encrypted bag; decrypt it with rosbag's own tools")
                at: int = _u64.unpack(fields[b"index_pos"])[0]
            except FAULTS as error:
                raise _damaged(self._path, error) from error
            except _CutError:
                return 0
        return at if at < self._path.stat().st_size else 0

    def _records(self, start: int) -> Iterator[tuple[int, Message]]:
        """Every message from byte `start`, with its connection's number; connections are kept as they come."""
        with open_regular(self._path, BAG_ADVICE) as file:
            room = FREE_BYTES + MAX_INFLATION * self._path.stat().st_size
            file.seek(start)
            try:
                while (record := _record(file)) is not None:
                    fields, data = record
                    if _operation(fields) == CHUNK:
                        size, compression = _u32.unpack(fields[b"size"])[0], fields[b"compression"].decode()
                        if size > MAX_CHUNK_BYTES:
                            raise ValueError(f"a chunk of {size_text(size)}; at most {size_text(MAX_CHUNK_BYTES)} are unpacked")
                        if compression not in {"none", "bz2", "lz4", "zstd"}:
                            raise ValueError(f"compression {compression[:20]!r} is not one of bz2, lz4 and zstd")
                        chunk = unpacked(data, compression, size)
                        room -= size
                        if room < 0:
                            raise ValueError(f"unpacks to more than {MAX_INFLATION} times its size")
                        yield from self._inside(io.BytesIO(chunk))
                    elif _operation(fields) == CONNECTION:
                        self._connect(fields, data)
            except _CutError:
                self._cut_at = file.tell()
            except FAULTS as error:
                raise _damaged(self._path, error, f" before byte {file.tell()}") from error

    def _inside(self, chunk: IO[bytes]) -> Iterator[tuple[int, Message]]:
        try:
            while (record := _record(chunk)) is not None:
                fields, data = record
                if _operation(fields) == MESSAGE:
                    seconds, ns = _time.unpack(fields[b"time"])
                    yield _u32.unpack(fields[b"conn"])[0], Message(seconds * NS_PER_S + ns, data)
                elif _operation(fields) == CONNECTION:
                    self._connect(fields, data)
        except _CutError as error:
            raise ValueError("a record is longer than its chunk") from error

    def _connect(self, fields: Fields, data: bytes) -> None:
        more = _fields(data)
        name, kind = fields[b"topic"].decode(), type_name(more[b"type"].decode())
        self._topics[_u32.unpack(fields[b"conn"])[0]] = BagTopic(name, kind, "ros1", more[b"message_definition"].decode())


def _record(file: IO[bytes]) -> tuple[Fields, bytes] | None:
    """The next record, None at the end. Raises CutError where the file ends within it, ValueError for one over the limits."""
    head = file.read(_u32.size)
    if not head:
        return None
    fields = _fields(_part(file, head, MAX_HEADER_BYTES))
    return fields, _part(file, file.read(_u32.size), MAX_CHUNK_BYTES)


def _part(file: IO[bytes], length: bytes, limit: int) -> bytes:
    if len(length) < _u32.size:
        raise _CutError
    size: int = _u32.unpack(length)[0]
    if size > limit:
        raise ValueError(f"a record of {size} bytes; at most {limit} are read")
    data = file.read(size)
    if len(data) < size:
        raise _CutError
    return data


def _fields(data: bytes) -> Fields:
    fields, place = {}, 0
    while place < len(data):
        size = _u32.unpack_from(data, place)[0]
        place += _u32.size
        name, equals, value = data[place : place + size].partition(b"=")
        if not equals or place + size > len(data):
            raise ValueError("a header's field is not NAME=VALUE")
        fields[name] = value
        place += size
    return fields


def _operation(fields: Fields) -> int:
    return fields[b"op"][0] if fields.get(b"op") else 0


Storage = _Db3File | _McapBag | _BagFile  # one file of a bag


class Bag:
    """A bag that is open for reading."""

    def __init__(self, path: Path, files: list[Storage], told: list[tuple[str, str]]) -> None:
        self.path, self._files, self._told = path, files, told
        self._topics: list[BagTopic] | None = None

    def topics(self) -> list[BagTopic]:
        """The topics of all files, each once; the files are looked through once. Raises InputError for damage."""
        if self._topics is None:
            self._topics = list(dict.fromkeys(topic for file in self._files for topic in file.topics()))
        return self._topics

    def messages(self, topic: BagTopic) -> Iterator[Message]:
        """The messages of a topic, file by file. Raises InputError for damage."""
        for file in self._files:
            yield from file.messages(topic)

    def told(self) -> list[tuple[str, str]]:
        """Notices of what was read so far."""
        return [*self._told, *(notice for file in self._files for notice in file.told())]


def is_bag_directory(path: Path) -> bool:
    """Whether a directory has what a bag of ROS 2 has. Raises OSError where it cannot be listed."""
    return path.is_dir() and any(file.name == METADATA or FILE_NAME.fullmatch(file.name) for file in path.iterdir())


@contextlib.contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """A .bag, .db3 or .mcap file, or a directory of the latter two. Raises InputError."""
    told: list[tuple[str, str]] = []
    paths = _files_of(path, told) if is_bag_directory(path) else [path]
    with temporary_folder("bag") as place:
        yield Bag(path, [_storage(file, place) for file in paths], told)


def _files_of(path: Path, told: list[tuple[str, str]]) -> list[Path]:
    """The files that the bag's metadata names; without it, all of the directory."""
    metadata = path / METADATA
    if not metadata.is_file():
        told.append(("log-cut", f"{path} has no {METADATA} (its recorder was killed?); all of its bag files are read"))
        files = [file for file in path.iterdir() if FILE_NAME.fullmatch(file.name)]  # NAME_2 comes before NAME_10
        return sorted(files, key=by_number)
    # relative_file_paths, one to a line or in brackets, as ROS 2 writes them; a YAML reader's time has no bound.
    found = FILE_LIST.search(read_text(metadata, "give a bag of ROS 2", MAX_METADATA_BYTES))
    if found is None:
        raise InputError(f"{metadata}: has no relative_file_paths; remove the file to read all of the directory")
    items = found[1].split(",") if found[1] is not None else [line.strip()[1:] for line in found[2].splitlines()]
    names = [name for item in items if (name := item.strip().strip("'\""))]
    if not names or len(names) > MAX_FILES or max(map(len, names)) > MAX_NAME_CHARACTERS:
        raise InputError(f"{metadata}: names no files of a bag; remove it to read all of the directory")
    files = [path / Path(name).name for name in names]
    missing = [file.name for file in files if not file.is_file()]
    if missing:
        raise InputError(f"{path}: lacks {shortened(', '.join(missing))}, which its {METADATA} names; copy the whole bag")
    return files


def _storage(path: Path, place: Path) -> Storage:
    """The reader of a file, by its first bytes; what is packed is unpacked into `place` first."""
    with open_regular(path, BAG_ADVICE) as file:
        head = file.read(HEAD_BYTES)
        if head.startswith(ZSTD_MAGIC):
            whole, room = place / path.stem, FREE_BYTES + MAX_INFLATION * path.stat().st_size
            file.seek(0)
            try:
                with whole.open("wb") as target, zstandard.ZstdDecompressor().stream_reader(file) as stream:
                    while piece := stream.read(PIECE_BYTES):
                        room -= len(piece)
                        if room < 0:
                            raise InputError(f"{path}: unpacks to more than {MAX_INFLATION} times its size; {BAG_ADVICE}")
                        target.write(piece)
            except zstandard.ZstdError as error:
                raise _damaged(path, error) from error
            return _storage(whole, place)
    for magic, kind in ((ROSBAG_MAGIC, _BagFile), (SQLITE_MAGIC, _Db3File), (MCAP_MAGIC, _McapBag)):
        if head.startswith(magic):
            return kind(path)
    refuse_kind(path, head, BAG_ADVICE)
    raise InputError(f"{path}: not a file of a bag; {BAG_ADVICE}")
