"""The messages of a few topics out of a ULog file, in one pass and in bounded memory.

docs.px4.io, "ULog File Format": a head of 16 bytes, then messages of a size (u16), a kind (one letter) and content. A logger
that lost power leaves a message cut; one whose card could not keep up, or a bad card, leaves bytes that are no message, and the
next synchronisation message says where messages begin again.

What comes out is a small ULog file for pyulog, which would read all topics, follow nested formats of any size, and search a
damaged file for a time that grows as its square.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, NamedTuple

from hilstar.errors import InputError
from hilstar.reading import ULOG_MAGIC, open_regular, size_text

ADVICE = "give a ULog file (.ulg) of PX4"
SYNC = b"\x2f\x73\x13\x20\x25\x0c\xbb\x12"
KINDS = frozenset(b"FDIMPQARSOLCB")
HEAD_BYTES = 16
APPENDED = 1  # the only incompatible flag of the format, in the first of eight bytes: data appended after a crash
MAX_FORMAT_CHARACTERS, MAX_FIELDS = 4000, 1000  # an attitude has 12 fields
MAX_SUBSCRIPTIONS = 1000
MAX_KEPT_BYTES = 1_000_000_000
PIECE_BYTES = 1 << 20
_head = struct.Struct("<HB")
_u16 = struct.Struct("<H")


class Topic(NamedTuple):
    """A topic of the log, and which of its instances."""

    name: str
    instance: int


@dataclass(slots=True)
class Sieved:
    """What is left of a log: `ulog` is a whole file of the wanted topics; `topics` are all that the log has."""

    ulog: bytes = b""
    topics: set[Topic] = field(default_factory=set)
    lost_ms: int = 0
    damaged_bytes: int = 0
    cut_at: int | None = None
    misfits: bool = False

    @property
    def told(self) -> list[tuple[str, str]]:
        """A notice of everything that is missing."""
        lines = []
        if self.cut_at is not None:
            lines.append(("log-cut", f"the log ends within a message at byte {self.cut_at}; all before it is read"))
        if self.damaged_bytes:
            lines.append(("log-damage", f"{size_text(self.damaged_bytes)} of the log are damaged, and are left out"))
        if self.misfits:
            lines.append(("log-damage", "some messages have not the size of their format, and are left out"))
        if self.lost_ms:
            lines.append(("log-dropout", f"the logger lost {self.lost_ms / 1000:.3g} s of messages"))
        return lines


def sieve(path: Path, wanted: frozenset[str]) -> Sieved:
    """The messages of topics by name. Raises InputError for what is no ULog, or one of a newer kind."""
    result = Sieved()
    kept = bytearray()
    ids: set[int] = set()
    with open_regular(path, ADVICE) as file:
        head = file.read(HEAD_BYTES)
        if len(head) < HEAD_BYTES or not head.startswith(ULOG_MAGIC):
            raise InputError(f"{path}: not a ULog file, or cut within its first {HEAD_BYTES} bytes; {ADVICE}")
        kept += head
        for kind, content in _messages(path, file, result):
            if kind == ord("O") and len(content) == _u16.size:
                result.lost_ms += _u16.unpack(content)[0]
            if _is_wanted(path, kind, content, wanted, (ids, result.topics)):
                kept += _head.pack(len(content), kind) + content
                if len(kept) > MAX_KEPT_BYTES:
                    raise InputError(f"{path}: its attitudes have more than {size_text(MAX_KEPT_BYTES)}; split the log")
    result.ulog = bytes(kept)
    return result


def _is_wanted(path: Path, kind: int, content: bytes, wanted: frozenset[str], found: tuple[set[int], set[Topic]]) -> bool:
    ids, topics = found
    if kind == ord("D"):
        return len(content) > _u16.size and _u16.unpack_from(content)[0] in ids
    if kind == ord("F"):
        name, _, fields = content.partition(b":")
        if name.decode("ascii", "replace") not in wanted:
            return False
        sizes = [int(size[:9]) for size in re.findall(rb"\[(\d+)\]", fields)]
        if len(fields) > MAX_FORMAT_CHARACTERS or sum(sizes) > MAX_FIELDS:
            raise InputError(f"{path}: its {name.decode()} has more than {MAX_FIELDS} fields, which PX4's has not; {ADVICE}")
        return True
    if kind == ord("A") and len(content) > 3:
        topic = Topic(content[3:].decode("ascii", "replace"), content[0])
        if len(topics) < MAX_SUBSCRIPTIONS:
            topics.add(topic)
        if topic.name in wanted and len(ids) < MAX_SUBSCRIPTIONS:
            ids.add(_u16.unpack_from(content, 1)[0])
            return True
    return False


def _messages(path: Path, file: IO[bytes], result: Sieved) -> Iterator[tuple[int, bytes]]:
    """Kind and content of every message that is whole; `result` gets what is not."""
    ends: list[int] = []
    last = file.tell()
    while True:
        place = file.tell()
        limit = ends[0] if ends else None
        head = file.read(_head.size)
        size, kind = _head.unpack(head) if len(head) == _head.size else (0, 0)
        if limit is not None and place + _head.size + size > limit:
            file.seek(ends.pop(0))  # what was appended after a crash; the message before it may be cut
            last = file.tell()
            continue
        if len(head) < _head.size:
            result.cut_at = place if head else result.cut_at
            return
        if kind not in KINDS or not size:
            if not _find_sync(file, last, place, result):
                return
            last = file.tell()
            continue
        content = file.read(size)
        if len(content) < size:
            result.cut_at = place
            return
        last = place
        if kind == ord("B"):
            ends = _appended(path, content, place)
        yield kind, content


def _find_sync(file: IO[bytes], last: int, place: int, result: Sieved) -> bool:
    """Go on after the next synchronisation message; the size of the message at `last` may be what is damaged."""
    file.seek(last + _head.size)
    at, tail = file.tell(), b""
    while piece := file.read(PIECE_BYTES):
        found = (tail + piece).find(SYNC)
        if found >= 0:
            begin = at - len(tail) + found
            result.damaged_bytes += max(0, begin - place)
            file.seek(begin + len(SYNC))
            return True
        at += len(piece)
        tail = (tail + piece)[-len(SYNC) + 1 :]
    result.damaged_bytes += at - place
    return False


def _appended(path: Path, content: bytes, place: int) -> list[int]:
    """Where data was appended, from the flags that are the log's first message."""
    if place != HEAD_BYTES or len(content) < 40:
        return []
    flags = content[8:16]
    if flags[0] & ~APPENDED or any(flags[1:]):
        raise InputError(f"{path}: a ULog of a newer kind (incompatible flags {flags.hex()}); convert it with PX4's own tools")
    offsets: tuple[int, ...] = struct.unpack_from("<3Q", content, 16)
    return sorted(offset for offset in offsets if offset > place) if flags[0] & APPENDED else []
