"""The memory between a run and its page: whole records only, whoever is faster, and none of it
left behind.
"""

from __future__ import annotations

import os
import threading

import numpy as np

from hilstar.server.console.messages import EVENTS, FRAMES, PictureRequest, Ring, SharedMemory

SLOTS, SLOT_BYTES = 4, 100


def ring() -> Ring:
    return Ring(memoryview(bytearray(Ring.size(SLOTS, SLOT_BYTES))), SLOTS, SLOT_BYTES)


def test_records_are_read_in_order_and_old_ones_are_gone():
    records = ring()
    assert records.last() is None and list(records.after(0)) == []
    for k in range(1, 8):
        records.put(b"%d" % k)
        assert records.last() == (k, b"%d" % k)
    kept = list(records.after(0))
    assert kept == [(5, b"5"), (6, b"6"), (7, b"7")]  # the slot that is written next is never read
    assert list(records.after(6)) == [(7, b"7")]
    assert records.read(1) is None and records.read(8) is None


def test_a_record_that_is_being_written_is_not_read():
    records = ring()
    records.put(b"whole")
    records.begin()
    records.room(5)[:] = b"torn!"
    assert records.last() == (1, b"whole")
    assert records.read(2) is None
    records.end(5, 0)
    assert records.last() == (2, b"torn!")


def test_a_slot_that_is_written_anew_has_no_record_before_it_is_whole():
    """A picture has no CRC: the slot alone says that it is being written over."""
    records = ring()
    for _ in range(SLOTS + 1):
        records.begin()
        records.room(3)[:] = b"old"
        records.end(3, 0)
    oldest = 2
    assert records.read(oldest) == b"old"
    records.begin()
    assert records.read(oldest) is None


def test_a_record_that_was_changed_is_not_taken_for_whole():
    memory = bytearray(Ring.size(SLOTS, SLOT_BYTES))
    records = Ring(memoryview(memory), SLOTS, SLOT_BYTES)
    records.put(b"A" * 50)
    memory[memory.index(b"A") + 7] ^= 1
    assert records.read(1) is None


def test_a_record_that_is_too_long_is_cut_at_its_slot_s_end():
    records = ring()
    records.put(bytes(range(SLOT_BYTES + 3)))
    records.put(b"next")
    assert list(records.after(0)) == [(1, bytes(range(SLOT_BYTES))), (2, b"next")]


def test_a_writer_of_a_memory_with_records_goes_on_with_their_numbers():
    memory = memoryview(bytearray(Ring.size(SLOTS, SLOT_BYTES)))
    first = Ring(memory, SLOTS, SLOT_BYTES)
    for k in range(1, 7):
        first.put(b"%d" % k)
    Ring(memory, SLOTS, SLOT_BYTES).put(b"new")
    assert list(first.after(0)) == [(5, b"5"), (6, b"6"), (7, b"new")]


class OvertakenMemory(bytearray):
    """A memory whose writer takes the slot anew while a reader copies its bytes."""

    writer: Ring | None = None

    def __getitem__(self, key):
        copied = super().__getitem__(key)
        if self.writer is not None:
            for _ in range(SLOTS):
                self.writer.begin()
                self.writer.room(3)[:] = b"new"
                self.writer.end(3, 0)
        return copied


def test_a_slot_that_is_begun_anew_while_it_is_copied_is_not_read():
    memory = OvertakenMemory(Ring.size(SLOTS, SLOT_BYTES))
    writer = Ring(memoryview(memory), SLOTS, SLOT_BYTES)
    writer.begin()
    writer.room(3)[:] = b"old"
    writer.end(3, 0)
    reader = Ring(memory, SLOTS, SLOT_BYTES)
    assert reader.read(1) == b"old"
    memory.writer = writer
    assert reader.read(1) is None


def test_where_the_newest_records_are_damaged_the_newest_whole_one_is_read():
    memory = bytearray(Ring.size(SLOTS, SLOT_BYTES))
    records = Ring(memoryview(memory), SLOTS, SLOT_BYTES)
    for k in range(1, 7):
        records.put(b"%d" % k * 50)
    for damaged, whole in ((b"6", 5), (b"5", 4)):
        memory[memory.index(damaged * 50) + 7] ^= 1
        assert records.last() == (whole, b"%d" % whole * 50)
    memory[memory.index(b"4" * 50) + 7] ^= 1
    assert records.last() is None  # the slot that is written next is never read


def test_no_ring_lies_in_another_s_memory():
    memory = SharedMemory.make(320 * 240)
    rings = [memory.frames, memory.states, memory.events, memory.answers, memory.pictures]
    for number, each in enumerate(rings, 1):
        for _ in range(each._slots):
            each.put(bytes([number]) * each.slot_bytes)
    for number, each in enumerate(rings, 1):
        for k in range(1, each._slots + 1):
            assert each.read(k) == bytes([number]) * each.slot_bytes
    memory.want = PictureRequest(5, 7)
    assert memory.frames.read(1) == b"\1" * memory.frames.slot_bytes


def test_a_reader_beside_a_writer_sees_whole_records_alone():
    records = ring()
    stop, torn, seen = threading.Event(), [], []

    def read() -> None:
        while not stop.is_set():
            found = records.last()
            if found is not None:
                seen.append(found[0])
                torn.extend([found] if len(set(found[1])) != 1 else [])

    reader = threading.Thread(target=read)
    reader.start()
    for k in range(20_000):
        records.put(bytes([k % 251]) * SLOT_BYTES)
    stop.set()
    reader.join()
    assert not torn and seen == sorted(seen) and seen


def test_a_board_is_seen_by_whoever_has_its_descriptor():
    memory = SharedMemory.make(320 * 240)
    other = SharedMemory(os.dup(memory.fd), 320 * 240)
    memory.frames.put(b"frame")
    memory.events.put(b"event")
    other.want = PictureRequest(125_000_000, 7)
    assert other.frames.last() == (1, b"frame") and other.events.last() == (1, b"event")
    other.wrong_since_s = 12.5
    assert memory.want == PictureRequest(125_000_000, 7) and memory.wrong_since_s == 12.5
    picture = np.arange(320 * 240, dtype=np.uint8)
    memory.pictures.begin()
    np.copyto(np.frombuffer(memory.pictures.room(picture.nbytes), dtype=np.uint8), picture)
    memory.pictures.end(picture.nbytes, 0)
    found = other.pictures.last()
    assert found is not None and found[1] == picture.tobytes()
    # a page that comes back has a second of frames and the newest events
    assert FRAMES >= 60 and EVENTS >= 100
