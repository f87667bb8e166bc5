"""Bags whose packed bytes unpack to far more: refused before the memory or the disk is full."""

from __future__ import annotations

import bz2
import io
import tracemalloc
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from backports import zstd
from rosbags.rosbag2.storage_mcap import ChunkInfo

from hilstar.attitude.logs import bag_unpacking
from hilstar.attitude.logs.entries import Stated
from hilstar.attitude.logs.log_file import open_log
from hilstar.basics.errors import InputError
from tests.support.sources.ros_bags import (
    POSE_STAMPED,
    START_NS,
    Make,
    Sent,
    write_bag1,
    write_bag2,
    write_mcap,
)

LIMIT_BYTES = 1_000_000
# A frame's name of this length packs into a few hundred bytes.
NAME_CHARACTERS = 8 * LIMIT_BYTES
UNIT = (1.0, 0.0, 0.0, 0.0)
ICRS = Stated(reference="icrs")


def poses_in_frame(release: str, frame: str) -> Iterator[Sent]:
    make = Make(release)
    for k in range(3):
        t_ns = START_NS + k * 10**8
        message = make.of(POSE_STAMPED, t_ns, frame, "", UNIT, ())
        yield "/pose", POSE_STAMPED, t_ns, message


WRITERS: dict[str, Callable[[Path, str], Path]] = {
    "ROS 1, bz2": lambda path, name: write_bag1(
        path / "a.bag", poses_in_frame("noetic", name), "bz2"
    ),
    "ROS 1, lz4": lambda path, name: write_bag1(
        path / "a.bag", poses_in_frame("noetic", name), "lz4"
    ),
    "MCAP, zstd": lambda path, name: write_bag2(
        path / "a", poses_in_frame("jazzy", name), mcap=True, compression="storage"
    ),
    "MCAP, lz4": lambda path, name: write_mcap(path / "a.mcap", poses_in_frame("humble", name)),
    "messages": lambda path, name: write_bag2(
        path / "a", poses_in_frame("jazzy", name), compression="message"
    ),
    "files": lambda path, name: write_bag2(
        path / "a", poses_in_frame("jazzy", name), compression="file"
    ),
}


@pytest.fixture
def low_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bag_unpacking, "MAX_UNPACKED_BYTES", LIMIT_BYTES)
    monkeypatch.setattr(bag_unpacking, "MAX_FILE_BYTES", LIMIT_BYTES)


@pytest.mark.usefixtures("low_limits")
@pytest.mark.parametrize("kind", WRITERS)
def test_a_bag_that_unpacks_to_more_than_the_limit_is_refused(tmp_path: Path, kind: str) -> None:
    bomb = WRITERS[kind](tmp_path, "x" * NAME_CHARACTERS)
    with pytest.raises(InputError, match=r"unpacks? to over 1 MB; ") as refusal:
        open_log(bomb, ICRS)
    assert str(refusal.value).startswith(f"{bomb}: ")


@pytest.mark.usefixtures("low_limits")
@pytest.mark.parametrize("kind", WRITERS)
def test_a_bag_within_the_limit_is_read(tmp_path: Path, kind: str) -> None:
    bag = WRITERS[kind](tmp_path, "icrs")
    times_ns = [sample.t_ns for sample in open_log(bag, ICRS).samples]
    assert times_ns == [START_NS + k * 10**8 for k in range(3)]


@pytest.mark.usefixtures("low_limits")
def test_unpacking_stops_at_the_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    """A bomb of 64 MB takes memory of a few limits."""
    packed = bz2.compress(bytes(64 * LIMIT_BYTES))
    unpacked = bag_unpacking._unpacker(bz2.BZ2File)
    tracemalloc.start()
    try:
        with pytest.raises(bag_unpacking.UnpackingError):
            unpacked(packed)
        _, peak_bytes = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak_bytes < 8 * LIMIT_BYTES


@pytest.mark.usefixtures("low_limits")
def test_as_much_as_the_limit_is_unpacked_and_a_byte_more_is_refused() -> None:
    unpacked = bag_unpacking._unpacker(bz2.BZ2File)
    assert unpacked(bz2.compress(bytes(LIMIT_BYTES))) == bytes(LIMIT_BYTES)
    with pytest.raises(bag_unpacking.UnpackingError, match="unpack to over 1 MB"):
        unpacked(bz2.compress(bytes(LIMIT_BYTES + 1)))


@pytest.mark.usefixtures("low_limits")
def test_every_frame_of_a_packed_message_is_unpacked() -> None:
    """Two frames one after another are what two writes of a recorder make."""
    packed = zstd.compress(b"first ") + zstd.compress(b"second")
    assert bag_unpacking._unpacker(zstd.ZstdFile)(packed) == b"first second"


def test_chunks_of_one_time_are_bounded_together() -> None:
    def chunk(start: int, end: int) -> ChunkInfo:
        half = bag_unpacking.MAX_TOGETHER_BYTES // 2
        return ChunkInfo(start, end, 0, 0, {}, 0, "zstd", 100, half, {})

    one_after_another = [chunk(10 * k, 10 * k + 9) for k in range(40)]
    bag_unpacking.refuse_overlaps(Path("a.mcap"), one_after_another)
    with pytest.raises(InputError, match="chunks of one time unpack to over 1 GB"):
        bag_unpacking.refuse_overlaps(Path("a.mcap"), [chunk(0, 9), chunk(0, 9), chunk(9, 12)])


def test_a_file_on_the_disk_is_bounded(low_limits: None) -> None:
    packed = io.BytesIO(zstd.compress(bytes(4 * LIMIT_BYTES)))
    file = bag_unpacking._BoundedFile(packed)
    with file, pytest.raises(bag_unpacking.UnpackingError, match="zstd -d"):
        while file.read(100_000):
            pass
