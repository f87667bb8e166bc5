"""What a flood may cost, at the smallest scale: the gate, a serial line of junk, and a line that
takes nothing.
"""

from __future__ import annotations

import contextlib
import gc
import os
import socket
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import zmq

from hilstar.attitude.wire import zmq_socket
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
    decode_frame,
    encode,
    frame_declares_discontinuity,
    framed,
)
from hilstar.attitude.wire.roads import PAUSE_S, LinkCounts, RawMessage
from hilstar.attitude.wire.serial_link import SerialLink
from hilstar.attitude.wire.zmq_socket import (
    EVENT,
    FREED_WITHIN_S,
    LOOK_S,
    MAX_GROWTH_BYTES,
    _Doorkeeper,
    _MemoryWatch,
)
from hilstar.basics.errors import InputError
from hilstar.basics.notices import Notices
from hilstar.basics.units import NS_PER_S
from hilstar.server.sender import SerialSender
from tests.support.fake_clock import FakeClock
from tests.support.waiting import PATIENCE_S, wait_for
from tests.support.wire.ptys import serial_line
from tests.support.wire.samples import sample

GROWN_BYTES = 100_000_000
FRAME = framed(encode(sample(7)))
COUNT = 3 * MAX_BURST
# one is too old to be looked at, and of two that are whole the newer counts
JUMPED, DAMAGED = {500, 1200, 1500, 1800}, 1800


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


def test_a_long_silence_lets_no_more_than_one_burst_pass():
    clock = FakeClock()
    gate = FloodGate(LinkCounts(), Notices(), clock)
    clock.work(10 * NS_PER_S)
    waiting = [RawMessage(k, [b""]) for k in range(COUNT)]
    assert gate.newest(waiting, plain) == waiting[-MAX_BURST:]


def test_a_jump_that_is_taken_anyway_is_not_taken_twice_where_few_are_passed_over():
    clock, counts = FakeClock(), LinkCounts()
    gate = FloodGate(counts, Notices(), clock)
    gate.newest([RawMessage(k, [b""]) for k in range(MAX_BURST)], plain)
    clock.work(2.5 / MAX_PACKETS_PER_S * NS_PER_S)
    waiting = [RawMessage(k, [b"jump" if k == 4 else b""]) for k in range(5)]
    assert gate.newest(waiting, bool) == waiting[3:]
    assert counts.flooded == 3


@pytest.mark.parametrize("oldest", [0, 1, 2])
def test_of_a_few_that_are_passed_over_each_may_be_the_jump_that_is_taken(oldest):
    clock, counts = FakeClock(), LinkCounts()
    gate = FloodGate(counts, Notices(), clock)
    gate.newest([RawMessage(k, [b""]) for k in range(MAX_BURST)], plain)
    clock.work(2.5 / MAX_PACKETS_PER_S * NS_PER_S)
    waiting = [RawMessage(k, [b"jump" if k == oldest else b""]) for k in range(5)]
    assert gate.newest(waiting, bool) == [waiting[oldest], *waiting[3:]]
    assert counts.flooded == 2


@pytest.mark.parametrize("sender", [0, 1, 2, 4, 253])
@pytest.mark.parametrize("sequence", [0, 1, 2, 255, 256, 2**16, 2**32 - 1])
def test_a_jump_is_seen_undecoded_whatever_else_a_frame_has(sender, sequence):
    """COBS moves zeros: the bytes about the flags depend on what follows them."""
    for jump in (False, True):
        jumped = replace(sample(7), sequence=sequence, discontinuity=jump, sender=sender)
        assert declares_discontinuity(encode(jumped)) == jump
        assert frame_declares_discontinuity(framed(encode(jumped))[:-1]) == jump


def test_the_newest_whole_jump_that_is_passed_over_is_taken_in_every_form():
    """Of three that declare one and were passed over; a fourth is damaged."""
    samples = [replace(sample(7), sequence=k, discontinuity=k in JUMPED) for k in range(COUNT)]
    packets = [encode(each) for each in samples]
    packets[DAMAGED] = packets[DAMAGED][:20] + b"?" + packets[DAMAGED][21:]
    json = list(packets)
    for k in JUMPED:
        json[k] = b'{"t_ns":%d,"q":[1,0,0,0],"sequence":%d,"discontinuity":true}' % (k, k)
    json[DAMAGED] = b'{"discontinuity":true}'
    frames = [framed(packet)[:-1] for packet in packets]
    for form, declares, read in (
        (packets, declares_discontinuity, decode),
        (json, declares_discontinuity, decode),
        (frames, frame_declares_discontinuity, decode_frame),
    ):
        waiting = [RawMessage(k, [message]) for k, message in enumerate(form)]
        taken = FloodGate(LinkCounts(), Notices()).newest(waiting, declares)
        events = [read(message.parts[0]) for message in taken]
        assert [event.sequence for event in events] == [1500, *range(2 * MAX_BURST, COUNT)]
        assert [event.discontinuity for event in events[:2]] == [True, False]


def test_a_frame_of_which_the_end_comes_after_a_flood_is_taken():
    decoder = StreamDecoder()
    assert decoder.frames(b"\0" + FRAME[:30]) == []
    chunk = FRAME[30:] + FRAME * 3 + FRAME[:20]
    assert decoder.frames(chunk) == [FRAME[:-1]] * 4
    assert [type(event) for event, _ in decoder.feed(FRAME[20:])] == [AttitudeSample]


def test_a_line_of_short_junk_is_read_at_a_bounded_rate_and_a_good_frame_after_it_is_taken():
    clock = FakeClock()
    with (
        serial_line() as (device, name),
        SerialLink(name, 921_600, clock=clock) as link,
    ):
        os.set_blocking(device, False)
        begin_ns, events, sent = clock.now_ns(), 0, 0
        while clock.now_ns() - begin_ns < NS_PER_S // 2 or link.link_counts.flooded <= 1000:
            with contextlib.suppress(BlockingIOError):
                sent += os.write(device, b"\x55\0" * 2000)
            events += len(link.receive(1))
            clock.work(NS_PER_S // 1000)
        assert sent > 2 * events
        assert events < MAX_BURST + MAX_PACKETS_PER_S * (clock.now_ns() - begin_ns) / NS_PER_S
        while link.receive(20):
            pass
        os.write(device, FRAME)
        assert [type(arrival.event) for arrival in link.receive(1000)] == [AttitudeSample]


def test_a_line_that_is_not_read_blocks_neither_a_write_nor_the_end():
    begin_s = time.monotonic()
    with serial_line() as (_, name):
        with SerialSender(name, 921_600) as line:
            while line.send_bytes(b"\x55" * 4096):
                assert time.monotonic() - begin_s < PATIENCE_S
            assert not line.send_bytes(b"\x55" * 4096)
            end_s = time.monotonic()
        assert time.monotonic() - end_s < PATIENCE_S


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


def test_memory_that_is_used_is_seen_at_most_every_look():
    clock = FakeClock()
    watch = _MemoryWatch(clock)
    gc.collect()  # what earlier tests held must not be returned meanwhile
    watch.begin()
    kept = np.ones(GROWN_BYTES // 8)
    assert watch.grown_bytes() == pytest.approx(kept.nbytes, rel=0.1)
    assert watch.grown_bytes() == 0
    clock.sleep(LOOK_S)
    assert watch.grown_bytes() == pytest.approx(kept.nbytes, rel=0.1)
    watch.close()


@pytest.mark.parametrize("is_freed", [True, False])
def test_memory_that_is_not_returned_counts_no_more_and_what_is_returned_does(
    monkeypatch, is_freed
):
    """A reset frees what a link held; what stays for FREED_WITHIN_S was something else's."""
    clock = FakeClock()
    used_bytes = 10**9
    monkeypatch.setattr(_MemoryWatch, "_used_bytes", lambda watch: used_bytes)
    watch = _MemoryWatch(clock)
    watch.begin()
    used_bytes += 2 * MAX_GROWTH_BYTES
    assert watch.grown_bytes() == 2 * MAX_GROWTH_BYTES
    if is_freed:
        used_bytes = 10**9
    watch.await_release()
    waited_s = sum(clock.slept_s)
    clock.sleep(LOOK_S)
    assert watch.grown_bytes() == 0
    if is_freed:
        assert waited_s == 0
    else:
        assert FREED_WITHIN_S <= waited_s <= FREED_WITHIN_S + LOOK_S
    watch.close()


class Monitor:
    """A socket's monitor that has these events, and then no more."""

    def __init__(self, *events: tuple[int, int]) -> None:
        self._events = list(events)

    def recv_multipart(self, flags: int) -> list[bytes]:
        if not self._events:
            raise zmq.Again
        return [EVENT.pack(*self._events.pop(0)), b"tcp://127.0.0.1:9"]


class Look:
    """A look at what is there in the place of a partner, which finds nothing."""

    begun = 0

    def begin(self) -> None:
        self.begun += 1

    def take(self) -> str:
        return ""


@contextlib.contextmanager
def doorkeeper(
    counts: LinkCounts, told: zmq_socket.ConnectionsTold, look: Look | None = None
) -> Iterator[_Doorkeeper]:
    """The keeper of a real socket, whose monitor is its own again at the end."""
    with contextlib.ExitStack() as opened:
        context = opened.enter_context(zmq.Context())
        watched = opened.enter_context(context.socket(zmq.SUB))
        keeper = _Doorkeeper(watched, look=look, counts=counts, told=told, notices=Notices())
        opened.callback(keeper.close)
        opened.callback(setattr, keeper, "monitor", keeper.monitor)
        yield keeper


def test_each_connection_that_we_made_ends_by_its_own_handshake_and_failure():
    """One that was greeted is lost; the next, which was not, is no partner's, and neither is one
    whose handshake failed; the last is lost again.
    """
    greeted = (zmq.EVENT_HANDSHAKE_SUCCEEDED, 7)
    failed = (zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL, 7)
    ended = (zmq.EVENT_DISCONNECTED, 7)
    ends = (
        ((greeted, ended), (1, 1, 0)),
        ((ended,), (1, 1, 1)),
        ((failed, ended), (1, 1, 2)),
        ((greeted, ended), (2, 2, 2)),
        ((ended,), (2, 2, 3)),
    )
    counts, look, opened, lost = LinkCounts(), Look(), [], []
    told = zmq_socket.ConnectionsTold(lambda: opened.append(1), lost.append)
    with doorkeeper(counts, told, look) as keeper:
        for events, expected in ends:
            keeper.monitor = Monitor(*events)
            keeper.tend()
            assert (len(opened), len(lost), look.begun) == expected
            assert keeper.lost
            keeper.lost = False
        assert (counts.connections, counts.rejected) == (2, 3)


def test_a_descriptor_that_is_used_again_is_another_connection(monkeypatch):
    """The second of two is over the limit, and ends unrejected; the number's next one stands, and
    its failed handshake counts.
    """
    monkeypatch.setattr(zmq_socket, "MAX_CONNECTIONS", 1)
    # beyond all limits of open files
    first, second = 2**30, 2**30 + 1
    failed = (zmq.EVENT_HANDSHAKE_FAILED_AUTH, second)
    steps = (
        ([(zmq.EVENT_ACCEPTED, first), (zmq.EVENT_ACCEPTED, second)], set(), (1, 0)),
        ([(zmq.EVENT_DISCONNECTED, second)], {second}, (1, 0)),
        # it left before its handshake
        ([(zmq.EVENT_DISCONNECTED, first)], {first, second}, (1, 1)),
        ([(zmq.EVENT_ACCEPTED, second)], {first}, (1, 1)),
        ([failed, (zmq.EVENT_DISCONNECTED, second)], {first, second}, (1, 2)),
    )
    counts = LinkCounts()
    told = zmq_socket.ConnectionsTold(lambda: None, lambda why: None)
    with doorkeeper(counts, told) as keeper:
        for events, left, expected in steps:
            keeper.monitor = Monitor(*events)
            keeper.tend()
            assert keeper.left == left
            assert (counts.refused, counts.rejected) == expected
        assert counts.connections == 3


def test_connections_over_the_limit_are_ended_unless_their_descriptor_is_another_s(monkeypatch):
    """Real sockets, of which one is kept; the last one's descriptor is of another port by now."""
    monkeypatch.setattr(zmq_socket, "MAX_CONNECTIONS", 1)
    counts = LinkCounts()
    told = zmq_socket.ConnectionsTold(lambda: None, lambda why: None)
    with contextlib.ExitStack() as opened:
        context = opened.enter_context(zmq.Context())
        watched = opened.enter_context(context.socket(zmq.SUB))
        keeper = _Doorkeeper(watched, look=None, counts=counts, told=told, notices=Notices())
        ours, another_s = (
            opened.enter_context(socket.create_server(("127.0.0.1", 0))) for _ in range(2)
        )
        keeper.place = ours.getsockname()[1]
        peers = []
        for server in (ours, ours, another_s):
            peer = opened.enter_context(socket.create_connection(server.getsockname()))
            accepted = opened.enter_context(server.accept()[0])
            keeper._open[accepted.fileno()] = "a peer"
            peer.setblocking(False)
            peers.append(peer)
        keeper._shut_newest()
        wait_for(lambda: is_ended(peers[1]), "the second is over the limit")
        assert [is_ended(peer) for peer in peers] == [False, True, False]
        assert counts.refused == 2
        keeper.close()


def is_ended(peer: socket.socket) -> bool:
    try:
        return peer.recv(1) == b""
    except BlockingIOError:
        return False
