"""What a flood may cost, at the smallest scale: the gate, a serial line of junk, and a line that
takes nothing.
"""

from __future__ import annotations

import contextlib
import os
import time
import tty
from collections.abc import Sequence
from dataclasses import replace

import pytest

from hilstar.attitude.wire.links import (
    MAX_BURST,
    MAX_PACKETS_PER_S,
    OVER_NS,
    FloodGate,
)
from hilstar.attitude.wire.packet import (
    AttitudeSample,
    StreamDecoder,
    declares_discontinuity,
    decode,
    encode,
    framed,
)
from hilstar.attitude.wire.roads import PAUSE_S, LinkCounts, RawMessage
from hilstar.attitude.wire.serial_link import SerialLink, SerialRoad
from hilstar.basics.errors import InputError
from hilstar.basics.notices import Notices
from hilstar.basics.units import NS_PER_S
from hilstar.server.sender import SerialSender
from tests.support.fake_clock import FakeClock
from tests.support.waiting import PATIENCE_S
from tests.support.wire.samples import sample

FRAME = framed(encode(sample(7)))


def plain(_: object) -> bool:
    return False


def test_a_burst_passes_and_a_flood_does_not():
    clock, counts, notices = FakeClock(), LinkCounts(), Notices()
    gate = FloodGate(counts, notices, clock)
    burst = [RawMessage(k, [b""]) for k in range(MAX_BURST)]
    assert gate.newest(burst, plain) == burst
    admitted = 0
    for _ in range(20):
        clock.work(0.002 * NS_PER_S)
        taken = gate.newest(burst, plain)
        assert taken == burst[MAX_BURST - len(taken) :]
        admitted += len(taken)
    rested_s = sum(clock.slept_s)
    assert rested_s == pytest.approx(20 * PAUSE_S)
    assert admitted == pytest.approx((20 * 0.002 + 19 * PAUSE_S) * MAX_PACKETS_PER_S, abs=1)
    assert counts.flooded == 20 * MAX_BURST - admitted
    assert notices.counts() == {"flood": 1}
    clock.work(OVER_NS)
    assert gate.newest(burst, plain) == burst


def flooded_messages(jumped: set[int]) -> list[AttitudeSample]:
    return [replace(sample(7), sequence=k, discontinuity=k in jumped) for k in range(3 * MAX_BURST)]


class ReadLine(SerialRoad):
    """A port whose bytes were read a frame at a time, all of them before anybody looked."""

    chunks: Sequence[RawMessage] = ()

    def taken(self, timeout_ms: int) -> list[RawMessage]:
        chunks = list(self.chunks)
        self.chunks = ()
        return chunks


class Line(SerialLink):
    """A line on which every frame was read by itself, all of them before anybody looked."""

    road_kind = ReadLine

    def __init__(self, samples: list[AttitudeSample], damaged: set[int] = frozenset()) -> None:
        self.clock = FakeClock()
        self._master, self._slave = os.openpty()
        frames = [framed(encode(each)) for each in samples]
        for k in damaged:
            frames[k] = frames[k][:20] + bytes([frames[k][20] % 255 + 1]) + frames[k][21:]
        super().__init__(os.ttyname(self._slave), 921_600, clock=self.clock)
        self._road.chunks = [RawMessage(k, [data], k) for k, data in enumerate([b"\0", *frames])]

    def close(self) -> None:
        super().close()
        os.close(self._master)
        os.close(self._slave)


def test_of_a_line_that_brings_more_the_newest_are_taken_in_one_go():
    """Frame by frame each one that was too many cost a pause of 5 ms, and the oldest were taken:
    ages of seconds, no end.
    """
    with Line(flooded_messages(set())) as line:
        taken = [arrival.event.sequence for arrival in line.receive(0)]
        assert taken == list(range(2 * MAX_BURST, 3 * MAX_BURST))
        assert line.link_counts.flooded == 2 * MAX_BURST
        assert line.clock.slept_s == [PAUSE_S]


def test_a_jump_that_is_passed_over_still_separates_what_is_before_it_from_what_is_after():
    """Of two that declare one and were passed over the newest whole one is taken, on every road."""
    jumped = {500, 1500, 1800}
    samples = flooded_messages(jumped)
    with Line(samples, damaged={1800}) as line:
        on_line = [arrival.event for arrival in line.receive(0)]
    messages = [encode(each) for each in samples]
    messages[1800] = messages[1800][:20] + b"?" + messages[1800][21:]
    as_json = [b'{"t_ns":%d,"q":[1,0,0,0],"sequence":%d,"discontinuity":true}' % (k, k) if k in jumped else message
               for k, message in enumerate(messages)]  # fmt: skip
    as_json[1800] = b'{"discontinuity":true}'
    for form in (messages, as_json):
        waiting = [RawMessage(k, [message]) for k, message in enumerate(form)]
        taken = FloodGate(LinkCounts(), Notices()).newest(waiting, declares_discontinuity)
        events = [decode(message.parts[0]) for message in taken]
        for found in (events, on_line):
            assert [event.sequence for event in found] == [
                1500,
                *range(2 * MAX_BURST, 3 * MAX_BURST),
            ]
            assert [event.discontinuity for event in found[:2]] == [True, False]


def test_a_frame_of_which_the_end_comes_after_a_flood_is_taken():
    decoder = StreamDecoder()
    assert decoder.frames(b"\0" + FRAME[:30]) == []
    chunk = FRAME[30:] + FRAME * 3 + FRAME[:20]
    assert decoder.frames(chunk) == [FRAME[:-1]] * 4
    assert [type(event) for event, _ in decoder.feed(FRAME[20:])] == [AttitudeSample]


def test_a_line_of_short_junk_is_read_at_a_bounded_rate_and_a_good_frame_after_it_is_taken():
    master, slave = os.openpty()
    tty.setraw(slave)
    os.set_blocking(master, False)
    clock = FakeClock()
    with SerialLink(os.ttyname(slave), 921_600, clock=clock) as link:
        begin_ns, events, sent = clock.now_ns(), 0, 0
        while clock.now_ns() - begin_ns < NS_PER_S // 2 or link.link_counts.flooded <= 1000:
            with contextlib.suppress(BlockingIOError):
                sent += os.write(master, b"\x55\0" * 2000)
            events += len(link.receive(1))
            clock.work(NS_PER_S // 1000)
        assert sent > 2 * events
        assert events < MAX_BURST + MAX_PACKETS_PER_S * (clock.now_ns() - begin_ns) / NS_PER_S
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
