"""Bounds of what rosbags unpacks: a small bag of packed zeros would fill the memory or the disk.

rosbags unpacks each chunk, message or file whole, however large. `bound_unpacking` puts unpackers
in their place that stop at MAX_UNPACKED_BYTES, and for a file that goes to the disk at
MAX_FILE_BYTES. Of chunks that overlap in time rosbags has all at once: `refuse_overlaps`.
"""

import bz2
import io
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path
from types import SimpleNamespace, TracebackType
from typing import IO, TYPE_CHECKING, Any

from hilstar.basics.errors import InputError, size_text

if TYPE_CHECKING:
    from rosbags.rosbag2.storage_mcap import ChunkInfo

# Recorders close a chunk after 0.8 to 4 MB; one message of a camera may take 50 MB.
MAX_UNPACKED_BYTES = 256_000_000
MAX_TOGETHER_BYTES = 1_000_000_000
MAX_FILE_BYTES = 4_000_000_000
ADVICE = "is it damaged? write the bag again without compression, with its attitudes alone"
FILE_ADVICE = "unpack its files with zstd -d, and give that bag"
Opener = Callable[[IO[bytes]], Any]


class UnpackingError(Exception):
    """What is packed is larger than anything of a bag."""


@cache
def bound_unpacking() -> None:
    """Let rosbags unpack no more than the limits, in this process."""
    from backports import zstd
    from lz4.frame import LZ4FrameFile
    from rosbags.rosbag1 import reader as ros1
    from rosbags.rosbag2 import reader as ros2
    from rosbags.rosbag2 import storage_mcap as mcap

    unpack_lz4 = _unpacker(LZ4FrameFile)
    unpack_zstd = _unpacker(zstd.ZstdFile)
    ros1.decompressors.update(bz2=_unpacker(bz2.BZ2File), lz4=unpack_lz4)
    mcap.DECOMPRESSORS["lz4"] = lambda packed, _: unpack_lz4(packed)
    mcap.DECOMPRESSORS["zstd"] = lambda packed, _: unpack_zstd(packed)
    bounded = SimpleNamespace(decompress=unpack_zstd, open=_BoundedFile)
    vars(ros2)["zstd"] = bounded


def _unpacker(opener: Opener) -> Callable[[bytes], bytes]:
    """What unpacks bytes by a file object that unpacks as it is read."""

    def unpacked(packed: bytes) -> bytes:
        with opener(io.BytesIO(packed)) as file:
            raw: bytes = file.read(MAX_UNPACKED_BYTES + 1)
        if len(raw) > MAX_UNPACKED_BYTES:
            sizes = f"{size_text(len(packed))} unpack to over {size_text(MAX_UNPACKED_BYTES)}"
            raise UnpackingError(f"{sizes}; {ADVICE}")
        return raw

    return unpacked


class _BoundedFile:
    """A file of Zstandard that is read up to MAX_FILE_BYTES, as rosbags opens one."""

    def __init__(self, packed: IO[bytes], mode: str = "rb") -> None:
        from backports import zstd

        self._file = zstd.ZstdFile(packed, "r")
        self._count = 0

    def __enter__(self) -> "_BoundedFile":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._file.close()

    def read(self, size: int) -> bytes:
        """The next bytes, at most `size`. Raises UnpackingError beyond the limit."""
        raw = self._file.read(size)
        self._count += len(raw)
        if self._count > MAX_FILE_BYTES:
            raise UnpackingError(
                f"a file unpacks to over {size_text(MAX_FILE_BYTES)}; {FILE_ADVICE}"
            )
        return raw


def refuse_overlaps(path: Path, chunks: Iterable["ChunkInfo"]) -> None:
    """Refuse (InputError) chunks of an MCAP that are unpacked at one time, and too large then."""
    changes: list[tuple[int, int]] = []
    for chunk in chunks:
        changes.append((chunk.message_start_time, chunk.uncompressed_size))
        # At one time the chunks that begin count before those that have ended.
        changes.append((chunk.message_end_time + 1, -chunk.uncompressed_size))
    together_bytes = 0
    for _, size_bytes in sorted(changes):
        together_bytes += size_bytes
        if together_bytes > MAX_TOGETHER_BYTES:
            sizes = f"its chunks of one time unpack to over {size_text(MAX_TOGETHER_BYTES)}"
            raise InputError(f"{path}: {sizes}; {ADVICE}")
