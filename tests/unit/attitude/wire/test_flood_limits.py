"""What a flood may cost, at the smallest scale: the gate, a serial line of junk, and a line that takes nothing."""

from __future__ import annotations

import contextlib
import os
import time
import tty

import pytest

from hilstar.attitude.wire.cobs import StreamDecoder, framed
from hilstar.attitude.wire.flood_limits import MAX_BURST, MAX_PACKETS_PER_S, OVER_S, FloodGate, LinkCounts
from hilstar.attitude.wire.packet import AttitudeSample, encode
from hilstar.attitude.wire.serial_link import SerialLink
from hilstar.errors import InputError
from hilstar.notices import Notices
from hilstar.run.send.ends import SerialSender
from tests.support.waiting import PATIENCE_S
from tests.support.wire.samples import sample

FRAME = framed(encode(sample(7)))


def test_a_burst_passes_and_a_flood_does_not():
    now_s = 100.0
    counts, notices = LinkCounts(), Notices()
    gate = FloodGate(counts, notices, lambda: now_s)
    assert gate.admit(MAX_BURST) == MAX_BURST
    admitted = 0
    for _ in range(20):
        now_s += 0.002
        admitted += gate.admit(MAX_BURST)
    assert admitted == pytest.approx(20 * 0.002 * MAX_PACKETS_PER_S, abs=1)
    assert counts.flooded == 20 * MAX_BURST - admitted
    assert notices.counts() == {"flood": 1}
    now_s += OVER_S
    assert gate.admit(MAX_BURST) == MAX_BURST


def test_of_a_chunk_the_newest_frames_are_taken_whatever_was_kept_before():
    decoder = StreamDecoder()
    decoder.feed(b"\0" + FRAME[:30])
    chunk = b"".join(framed(encode(sample(k))) for k in range(10))
    newest = decoder.feed_newest(chunk + FRAME[:20], 3)
    assert [event.sequence for event, _ in newest if isinstance(event, AttitudeSample)] == [7, 8, 9]
    assert [type(event) for event, _ in decoder.feed(FRAME[20:])] == [AttitudeSample]
    assert decoder.feed_newest(chunk, 0) == []
    assert len(decoder.feed_newest(chunk, 10)) == 10
    assert len(decoder.feed_newest(chunk, 99)) == 10


def test_a_line_of_short_junk_is_read_at_a_bounded_rate_and_a_good_frame_after_it_is_taken():
    master, slave = os.openpty()
    tty.setraw(slave)
    os.set_blocking(master, False)
    with SerialLink(os.ttyname(slave), 921_600) as link:
        begin_s, events, sent = time.monotonic(), 0, 0
        while time.monotonic() - begin_s < 0.5 or link.link_counts.flooded <= 1000:
            assert time.monotonic() - begin_s < PATIENCE_S
            with contextlib.suppress(BlockingIOError):
                sent += os.write(master, b"\x55\0" * 2000)
            events += len(link.receive(1))
        assert sent > 2 * events
        assert events < MAX_BURST + MAX_PACKETS_PER_S * (time.monotonic() - begin_s)
        while link.receive(20):
            pass
        os.write(master, FRAME)
        assert [type(arrival.event) for arrival in link.receive(1000)] == [AttitudeSample]
    os.close(master)
    os.close(slave)


def test_a_line_that_is_not_read_blocks_neither_a_write_nor_the_end():
    master, slave = os.openpty()
    tty.setraw(slave)
    begin_s = time.monotonic()
    with SerialSender(os.ttyname(slave), 921_600) as line:
        while line.send_bytes(b"\x55" * 4096):
            assert time.monotonic() - begin_s < PATIENCE_S
        assert not line.send_bytes(b"\x55" * 4096)
        end_s = time.monotonic()
    assert time.monotonic() - end_s < PATIENCE_S
    os.close(master)
    os.close(slave)


@pytest.mark.parametrize("kind", ["pipe", "file", "directory", "zero"])
def test_what_is_no_serial_port_gets_one_line_and_stays_as_it_is(tmp_path, kind):
    path = tmp_path / kind
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "file":
        path.write_text("measured")
    elif kind == "directory":
        path.mkdir()
    else:
        path.symlink_to("/dev/zero")
    begin_s = time.monotonic()
    with pytest.raises(InputError, match=kind):
        SerialLink(str(path), 115_200)
    assert time.monotonic() - begin_s < PATIENCE_S
    if kind == "file":
        assert path.read_text() == "measured"
