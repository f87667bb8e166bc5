"""What every kind of bag gives: its topics, and the bytes of a topic's messages; and how what is packed is unpacked.

A bag states the sizes of what it packs, which may be false: nothing is unpacked beyond the limits here.
"""

from __future__ import annotations

import bz2
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Literal, NamedTuple, Protocol

import lz4.frame
import zstandard

from hilstar.errors import InputError, shortened
from hilstar.reading import size_text

ADVICE = "give a bag of ROS 1 (.bag) or ROS 2 (.db3, .mcap, or the bag's directory)"
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
MAX_CHUNK_BYTES = 256_000_000  # unpacked; recorders make them of about 1 MB
MAX_MESSAGE_BYTES = 64_000_000
MAX_INFLATION, FREE_BYTES = 100, 32_000_000  # of a whole file; logs pack to a tenth
PIECE_BYTES = 1 << 20

Encoding = Literal["ros1", "cdr"]


class Topic(NamedTuple):
    """A topic of a bag: `type` as PACKAGE/msg/NAME; `definition` is the type's text in the bag, "" where it has none."""

    name: str
    type: str
    encoding: Encoding
    definition: str = ""


class Message(NamedTuple):
    """What a bag holds of one message: when it was recorded, ns of the recorder's clock, and its serialised bytes."""

    receive_ns: int
    data: bytes


class Storage(Protocol):
    """One file of a bag."""

    def topics(self) -> list[Topic]:
        """Its topics. Raises InputError for damage."""

    def messages(self, topic: Topic) -> Iterator[Message]:
        """The messages of a topic as recorded. Raises InputError for damage."""

    def told(self) -> list[tuple[str, str]]:
        """Notices of the file: that it was cut short."""


def type_name(text: str) -> str:
    """A type as PACKAGE/msg/NAME, however a bag writes it."""
    parts = text.replace("::", "/").split("/")
    return f"{parts[0]}/msg/{parts[1]}" if len(parts) == 2 else "/".join(parts)


def unpacked(data: bytes, compression: str, size: int | None = None) -> bytes:
    """A chunk or a message, unpacked to the `size` that the bag states. Raises ValueError, and what the unpackers raise."""
    limit = MAX_CHUNK_BYTES if size is None else size
    if limit > MAX_CHUNK_BYTES:
        raise ValueError(f"a chunk of {size_text(limit)}; at most {size_text(MAX_CHUNK_BYTES)} are unpacked")
    if compression == "bz2":
        whole = bz2.BZ2Decompressor().decompress(data, max_length=limit + 1)
    elif compression == "lz4":
        whole = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=limit + 1)
    elif compression == "zstd":
        with zstandard.ZstdDecompressor().stream_reader(data) as stream:
            whole = stream.read(limit + 1)
    elif compression == "none":
        whole = data
    else:
        raise ValueError(f"compression {compression[:20]!r} is not one of bz2, lz4 and zstd")
    if len(whole) > limit or (size is not None and len(whole) != size):
        raise ValueError(f"a chunk contains {'more' if len(whole) > limit else 'less'} than the {limit} bytes that it states")
    return whole


def message_bytes(data: bytes) -> bytes:
    """A message's bytes, unpacked where the recorder packed each by itself (no CDR begins as Zstandard does)."""
    return unpacked(data, "zstd") if data[:4] == ZSTD_MAGIC else data


def unpack_file(path: Path, source: IO[bytes], target: IO[bytes]) -> None:
    """A Zstandard file into another one. Raises InputError."""
    room = FREE_BYTES + MAX_INFLATION * path.stat().st_size
    try:
        with zstandard.ZstdDecompressor().stream_reader(source) as stream:
            while piece := stream.read(PIECE_BYTES):
                room -= len(piece)
                if room < 0:
                    raise InputError(f"{path}: unpacks to more than {MAX_INFLATION} times its size; {ADVICE}")
                target.write(piece)
    except zstandard.ZstdError as error:
        raise damaged(path, error) from error


def damaged(path: Path, reason: object, where: str = "") -> InputError:
    """The refusal of a bag that is not whole."""
    words = shortened(" ".join(str(reason).split()))
    return InputError(f"{path}: the bag is damaged{where} ({words}); record it again, or repair it with ROS's own tools")
