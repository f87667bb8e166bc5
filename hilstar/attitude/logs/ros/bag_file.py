"""Bags of ROS 1, format 2.0 (wiki.ros.org/Bags/Format/2.0), read from the front and in bounded memory.

A record is a header of NAME=VALUE fields and its data. Chunks hold connections (a topic and its type) and messages; a bag that
was closed repeats its connections in an index at its end. A bag whose recorder was killed has no index and ends anywhere: it
gives all that is whole.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from hilstar.attitude.logs.ros.storage import (
    ADVICE,
    FREE_BYTES,
    MAX_CHUNK_BYTES,
    MAX_INFLATION,
    Message,
    Topic,
    damaged,
    type_name,
    unpacked,
)
from hilstar.errors import InputError
from hilstar.reading import open_regular

VERSION = b"#ROSBAG V2.0\n"
MESSAGE, BAG_HEADER, CHUNK, CONNECTION = 2, 3, 5, 7
MAX_HEADER_BYTES = 1_000_000
_u32, _u64, _time = struct.Struct("<I"), struct.Struct("<Q"), struct.Struct("<II")
# What the bytes of a record that is not one raise, in struct, in the fields and in the unpackers.
FAULTS = (struct.error, KeyError, ValueError, OSError, EOFError, RuntimeError)
Fields = dict[bytes, bytes]


class CutError(Exception):
    """The file ends within a record."""


class BagFile:
    """A .bag file; see Storage."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._cut_at: int | None = None
        self._topics: dict[int, Topic] = {}

    def topics(self) -> list[Topic]:
        """The connections of the index; without one, those of all chunks."""
        with open_regular(self._path, ADVICE) as file:
            self._check_version(file)
            index = self._index_at(file)
        for start in (index, len(VERSION)):
            if start and not self._topics:  # an index that names nothing is not where the bag says
                for _ in self._records(start):
                    pass
        return list(dict.fromkeys(self._topics.values()))

    def messages(self, topic: Topic) -> Iterator[Message]:
        """The messages of a topic, in the order of the file."""
        for connection, message in self._records(len(VERSION)):
            if self._topics.get(connection) == topic:
                yield message

    def told(self) -> list[tuple[str, str]]:
        """That the bag was cut short."""
        if self._cut_at is None:
            return []
        return [("log-cut", f"{self._path} ends within a record at byte {self._cut_at}; all that is whole before it is read")]

    def _check_version(self, file: IO[bytes]) -> None:
        line = file.readline(len(VERSION))
        if line != VERSION:
            raise InputError(f"{self._path}: a ROS 1 bag of another version than 2.0; convert it with rosbag's own tools")

    def _index_at(self, file: IO[bytes]) -> int:
        """Where the index begins, 0 where the bag has none."""
        try:
            record = _record(file, MAX_CHUNK_BYTES)
            if record is None:
                return 0
            fields = record[0]
            if fields.get(b"encryptor"):
                raise InputError(f"{self._path}: an encrypted bag; decrypt it with rosbag's own tools")
            at: int = _u64.unpack(fields[b"index_pos"])[0]
        except FAULTS as error:
            raise damaged(self._path, error) from error
        except CutError:
            return 0
        return at if at < self._path.stat().st_size else 0

    def _records(self, start: int) -> Iterator[tuple[int, Message]]:
        """Every message from byte `start`, with its connection's number; connections are kept as they come."""
        with open_regular(self._path, ADVICE) as file:
            room = FREE_BYTES + MAX_INFLATION * self._path.stat().st_size
            file.seek(start)
            try:
                while (record := _record(file, MAX_CHUNK_BYTES)) is not None:
                    fields, data = record
                    if _operation(fields) == CHUNK:
                        chunk = unpacked(data, fields[b"compression"].decode(), _u32.unpack(fields[b"size"])[0])
                        room -= len(chunk)
                        if room < 0:
                            raise ValueError(f"unpacks to more than {MAX_INFLATION} times its size")
                        yield from self._inside(io.BytesIO(chunk))
                    elif _operation(fields) == CONNECTION:
                        self._connect(fields, data)
            except CutError:
                self._cut_at = file.tell()
            except FAULTS as error:
                raise damaged(self._path, error, f" before byte {file.tell()}") from error

    def _inside(self, chunk: IO[bytes]) -> Iterator[tuple[int, Message]]:
        try:
            while (record := _record(chunk, MAX_CHUNK_BYTES)) is not None:
                fields, data = record
                if _operation(fields) == MESSAGE:
                    seconds, ns = _time.unpack(fields[b"time"])
                    yield _u32.unpack(fields[b"conn"])[0], Message(seconds * 10**9 + ns, data)
                elif _operation(fields) == CONNECTION:
                    self._connect(fields, data)
        except CutError as error:
            raise ValueError("a record is longer than its chunk") from error

    def _connect(self, fields: Fields, data: bytes) -> None:
        more = _fields(data)
        name, kind = fields[b"topic"].decode(), type_name(more[b"type"].decode())
        self._topics[_u32.unpack(fields[b"conn"])[0]] = Topic(name, kind, "ros1", more[b"message_definition"].decode())


def _record(file: IO[bytes], limit: int) -> tuple[Fields, bytes] | None:
    """The next record, None at the end. Raises CutError where the file ends within it, ValueError for one over the limits."""
    head = file.read(_u32.size)
    if not head:
        return None
    fields = _fields(_part(file, head, MAX_HEADER_BYTES))
    return fields, _part(file, file.read(_u32.size), limit)


def _part(file: IO[bytes], length: bytes, limit: int) -> bytes:
    if len(length) < _u32.size:
        raise CutError
    size: int = _u32.unpack(length)[0]
    if size > limit:
        raise ValueError(f"a record of {size} bytes; at most {limit} are read")
    data = file.read(size)
    if len(data) < size:
        raise CutError
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
