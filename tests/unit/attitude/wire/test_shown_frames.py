"""Frames on their way to a watcher: what was shown comes back, and what is no frame is refused."""

from __future__ import annotations

import socket
from contextlib import closing

import msgspec
import numpy as np
import pytest

from hilstar.attitude.wire.shown_frames import (
    MAX_TOPICS,
    FrameHead,
    FrameSender,
    FrameWatch,
    ShownFrame,
    frame_parts,
    read_frame,
)
from hilstar.server.frame_feed import lit_pixels
from tests.support.waiting import PATIENCE_S, wait_for

HEAD = FrameHead(frame=7, lit_ns=123, width=5, height=3, bits=8, q=(1.0, 0.0, 0.0, 0.0))
LIT = np.array([2, 14], dtype=np.uint32)


@pytest.mark.parametrize(
    ("bits", "channels", "largest"), [(8, 1, 255), (10, 1, 1023), (8, 3, 255), (12, 3, 4095)]
)
def test_a_frame_comes_back_as_it_was_shown(bits, channels, largest):
    head = msgspec.structs.replace(HEAD, bits=bits, channels=channels)
    codes = np.array([[1, 2, 3], [largest, 0, 1]], dtype=np.uint16)[:, :channels].squeeze()
    back = read_frame(frame_parts(ShownFrame(head, LIT, codes)))
    assert isinstance(back, ShownFrame), back
    assert back.head == head
    assert np.array_equal(back.lit, LIT)
    assert np.array_equal(back.codes, codes)


@pytest.mark.parametrize(
    "change",
    [
        lambda parts: parts[:2],
        lambda parts: [*parts, b""],
        lambda parts: [parts[0][:-1], *parts[1:]],
        # index 14 is outside
        lambda parts: [parts[0].replace(b'"width":5', b'"width":4'), *parts[1:]],
        lambda parts: [parts[0].replace(b"1.0,", b"1.1,"), *parts[1:]],
        lambda parts: [parts[0].replace(b"1.0,", b"0.9,"), *parts[1:]],
        lambda parts: [parts[0], parts[1][::-1], parts[2]],
        lambda parts: [parts[0], parts[1][:4] * 2, parts[2]],  # one pixel twice
        lambda parts: [parts[0], parts[1][:-1], parts[2]],
        lambda parts: [parts[0], parts[1], parts[2] + b"\1"],
        lambda parts: [parts[0].replace(b'"channels":1', b'"channels":3'), *parts[1:]],
        lambda parts: [parts[0].replace(b'"bits":8', b'"bits":17'), parts[1], bytes(4)],
        lambda parts: [parts[0].replace(b'"bits":8', b'"bits":0'), *parts[1:]],
        lambda parts: [parts[0].replace(b'"channels":1', b'"channels":2'), *parts[1:]],
        # of 15 pixels the last one is index 14
        lambda parts: [parts[0], parts[1].replace(b"\x0e", b"\x0f"), parts[2]],
    ],
)
def test_what_is_no_frame_is_refused(change):
    parts = frame_parts(ShownFrame(HEAD, LIT, np.array([9, 9], dtype=np.uint8)))
    assert isinstance(read_frame(parts), ShownFrame)
    assert isinstance(read_frame(change(parts)), str)


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
@pytest.mark.parametrize("width", [8, 13])
def test_lit_pixels_are_those_over_code_zero(kind, width, rng):
    levels = (rng.integers(0, 300, (7, width)) * (rng.random((7, width)) < 0.2)).astype(kind)
    assert np.array_equal(lit_pixels(levels), np.flatnonzero(levels))


# ZMTP 3.0 (RFC 23)
GREETING = bytes([0xFF, *7 * [0], 0x01, 0x7F, 3, 0]) + b"NULL".ljust(20, b"\0") + bytes(32)
READY = b"\x04\x19\x05READY\x0bSocket-Type\x00\x00\x00\x03SUB"
FRAME = ShownFrame(HEAD, LIT, np.array([9, 9], dtype=np.uint8))


class RawWatcher:
    """A subscriber that sends what it likes: libzmq's own leaves out what it never subscribed
    to.
    """

    def __init__(self, endpoint: str) -> None:
        self.socket = socket.create_connection(
            ("127.0.0.1", int(endpoint.rpartition(":")[2])), PATIENCE_S
        )
        self.socket.sendall(GREETING + READY)
        heard = b""
        while b"READY" not in heard:  # a message before that would end the handshake
            heard += self.socket.recv(4096)

    def says(self, *bodies: bytes) -> None:
        """Send messages of one part each: 1 or 0, and a topic."""
        self.socket.sendall(b"".join(bytes([0, len(body)]) + body for body in bodies))

    def crash(self) -> None:
        self.socket.close()


@pytest.fixture
def frame_sender():
    with closing(FrameSender("tcp://127.0.0.1:*")) as opened:
        yield opened


def seen_by(watcher: FrameWatch, frame_sender: FrameSender) -> None:
    """Wait until a frame that the sender sends, while it believes to be watched, arrives."""

    def arrives() -> bool:
        if frame_sender.look():
            frame_sender.put_frame(FRAME)
        return bool(watcher.frames(10))

    wait_for(arrives, "a frame")


def settled(frame_sender: FrameSender) -> None:
    """Wait until what was sent before has been read: a further watcher, which subscribes last,
    is seen, and leaves.
    """
    with closing(FrameWatch(frame_sender.endpoint)) as last:
        seen_by(last, frame_sender)


@pytest.mark.parametrize(
    "said",
    [
        [b"\1other", b"\0other"],
        [b"\0"],  # what it never subscribed to, and the watcher did
        [b"\1", b"\0", b"\0", b"\0"],
        [b"\1", b"\1", b"\0"],
        [b"\1" + str(k).encode() for k in range(3000)],
        [b'\1{"frame":' + str(k).encode() for k in range(3 * MAX_TOPICS)],
        [b'\0{"frame":1', b"\0{", b"hello", b""],
    ],
)
@pytest.mark.parametrize("crashes", [True, False])
def test_a_watcher_goes_on_whatever_another_subscribes_to_and_however_it_leaves(
    frame_sender, said, crashes
):
    with closing(FrameWatch(frame_sender.endpoint)) as watcher:
        seen_by(watcher, frame_sender)
        other = RawWatcher(frame_sender.endpoint)
        other.says(*said)
        settled(frame_sender)
        if crashes:
            other.crash()
        assert frame_sender.look()
        seen_by(watcher, frame_sender)
        other.crash()
    wait_for(lambda: not frame_sender.look(), "nobody watches any more")


def topics(kind: bytes, count: int) -> list[tuple[int, bytes]]:
    """What connection 7 says of so many topics: that it subscribes, or no more."""
    return [(7, kind + b'{"frame":%d' % k) for k in range(count)]


@pytest.mark.parametrize(
    ("said", "watching"),
    [
        ([(7, b"\1{")], {7}),
        ([(7, b"\1"), (8, b'\1{"frame":5')], {7, 8}),  # all messages; frames of one kind
        ([(7, b"\1{"), (7, b"\0{")], set()),
        ([(7, b"\1{"), (7, b"\1"), (7, b"\0{")], {7}),
        ([(7, b"\1{"), (8, b"\0{")], {7}),  # of another connection, which had none
        ([(7, b"\1{"), (7, b"\0")], {7}),
        ([(7, b"\1other"), (8, b"\2{")], set()),
        # of more topics than are recorded some are left when all that are recorded have ended
        ([*topics(b"\1", MAX_TOPICS + 1), *topics(b"\0", MAX_TOPICS)], {7}),
        ([*topics(b"\1", MAX_TOPICS - 1), *topics(b"\0", MAX_TOPICS - 1)], set()),
    ],
)
def test_each_connection_watches_from_its_subscription_to_its_own_end_of_it(
    frame_sender, monkeypatch, said, watching
):
    frame_sender.look()
    monkeypatch.setattr(type(frame_sender._keeper), "is_open", lambda keeper, file: True)
    for file, message in said:
        frame_sender._take_subscription(file, message)
    assert set(frame_sender._topics) == watching


def test_what_is_no_frame_is_counted_with_what_is_wrong_with_the_last(frame_sender):
    with closing(FrameWatch(frame_sender.endpoint)) as watcher:
        seen_by(watcher, frame_sender)
        for parts in ([b'{"frame":1}'], [b'{"frame":2}', b"", b""], [b'{"frame":3']):
            frame_sender._ready().send_multipart(parts)
        wait_for(lambda: watcher.frames(10) or watcher.refused == 3, "three that are no frames")
        assert watcher.why_refused == read_frame([b'{"frame":3'])
        seen_by(watcher, frame_sender)


def test_who_asks_for_another_topic_or_has_unsubscribed_does_not_watch(frame_sender):
    other = RawWatcher(frame_sender.endpoint)
    other.says(b"\1other")
    settled(frame_sender)
    wait_for(lambda: not frame_sender.look(), "it does not watch")
    other.says(b"\1{")
    wait_for(frame_sender.look, "it watches")
    other.says(b"\0{")
    wait_for(lambda: not frame_sender.look(), "it has unsubscribed")
    other.crash()
