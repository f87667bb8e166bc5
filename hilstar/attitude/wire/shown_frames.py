"""The frames that a display shows, sent over ZeroMQ to every program that watches. Each frame is
one message of three parts.

1. A JSON object: `frame` (the frame's number), `lit_ns` (when its light begins, in ns of this
   machine's `time.monotonic_ns()`: with a screen, when the middle row lights; without a screen,
   midway between the moment before and its own), `q` (q_icrs_to_cam, unit, scalar first; null for
   a blank frame), `width` and `height` (px), `bits` of a code, `channels` (1, or 3 where the
   primaries are driven apart), `bench_sha256`, `moment_ns` (null with a screen; without one, the
   moment of `q`), `fades` (whether, without a screen, light passes evenly from the frame before to
   this one between their moments; else the one before stays lit until `lit_ns`).
2. The flat indices of the lit pixels, row * width + column, in rising order: uint32,
   little-endian. All other pixels have code 0.
3. The codes of these pixels, `channels` for each: uint8 up to 8 bits, else uint16, little-endian.

A frame of stars has some thousand lit pixels of two million, so its message has 20 to 100 kB and
needs no shared memory.
With a screen a frame stays lit until the next one is. The sender queues few frames for each
watcher: a slow watcher loses frames, and notices it by a gap in `frame`.
"""

import contextlib
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt
import zmq

from hilstar.attitude.wire.keys import NO_KEYS
from hilstar.attitude.wire.protocol import NORM_TOLERANCE
from hilstar.attitude.wire.zmq_links import ZmqRoad, ZmqSender
from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import one_line

KEPT_FRAMES = 8  # the sender's queue for each watcher, an eighth of a second at 60 Hz
WAITING_FRAMES = 64  # the watcher's own queue: it reads only between two answers
MAX_FRAME_BYTES = 1 << 27  # a part with every pixel of 4K, three channels of 16 bits, fits
MAX_SIDE_PX = 32_768
# ZeroMQ matches the beginning of a message: a topic selects frames where it begins with this, or
# this begins with it.
HEAD_BEGINS = b'{"frame":'
SUBSCRIBES, UNSUBSCRIBES = 1, 0  # first byte of a subscription message (ZMTP)
# recorded of a connection; one with more counts as watching until it ends
MAX_TOPICS = 64
MAX_READ = 1000  # subscriptions read in one call: a flood of them delays no frame


class FrameHead(msgspec.Struct, frozen=True):
    """The first part of a frame's message (see the module)."""

    frame: int
    lit_ns: int
    width: int
    height: int
    bits: int
    q: tuple[float, float, float, float] | None = None
    channels: int = 1
    bench_sha256: str = ""
    moment_ns: int | None = None
    fades: bool = False


@dataclass(frozen=True, slots=True)
class ShownFrame:
    """A frame as it was shown: `lit` (n,) are the flat indices of the pixels above code 0, and
    `codes` (n,) or (n, 3) are their codes.
    """

    head: FrameHead
    lit: npt.NDArray[np.uint32]
    codes: npt.NDArray[np.unsignedinteger[Any]]

    @property
    def q_icrs_to_cam(self) -> FloatArray | None:
        """The frame's attitude (4,), a unit quaternion, scalar first; None for a blank frame."""
        if self.head.q is None:
            return None
        return np.array(self.head.q)


_heads = msgspec.json.Decoder(FrameHead)


def frame_parts(frame: ShownFrame) -> list[bytes]:
    """The three parts of a frame's message, as the module describes them."""
    kind = "<u1" if frame.head.bits <= 8 else "<u2"
    return [
        msgspec.json.encode(frame.head),
        frame.lit.astype("<u4").tobytes(),
        frame.codes.astype(kind).tobytes(),
    ]


def read_frame(parts: list[bytes]) -> ShownFrame | str:
    """The frame that a message's parts describe, or a line of text that says why they describe
    none.
    """
    try:
        return _checked(*parts)
    except (TypeError, ValueError, RecursionError, msgspec.MsgspecError) as error:
        return one_line(str(error))


def _checked(first: bytes, indices: bytes, values: bytes) -> ShownFrame:
    head = _heads.decode(first)
    sizes = 0 < head.width <= MAX_SIDE_PX and 0 < head.height <= MAX_SIDE_PX
    if not (sizes and 1 <= head.bits <= 16 and head.channels in {1, 3}):
        raise ValueError(
            f"{head.width} x {head.height} pixels of {head.channels} x {head.bits} bits"
        )
    if head.q is not None and not abs(float(np.linalg.norm(head.q)) - 1) <= NORM_TOLERANCE:
        raise ValueError("its quaternion is not unit")
    lit = np.frombuffer(indices, dtype="<u4")
    if len(lit) and not (lit[-1] < head.width * head.height and (lit[1:] > lit[:-1]).all()):
        raise ValueError("its indices do not rise within the image")
    code_dtype = "<u1" if head.bits <= 8 else "<u2"
    codes = np.frombuffer(values, dtype=code_dtype)
    if head.channels == 3:
        return ShownFrame(head, lit, codes.reshape(len(lit), 3))
    return ShownFrame(head, lit, codes.reshape(len(lit)))


class FrameSender(ZmqSender):
    """Sends frames to watchers, and never waits for one.

    It records subscriptions by connection. libzmq also passes on an unsubscription from a
    connection that never subscribed; and where a connection ends without unsubscribing, it does
    not report whose subscription ended. So an unsubscription removes only a topic of its own
    connection, and all topics of a connection are removed when it ends.
    """

    LINGER_MS, STOPPED_LINGER_MS = 0, 0

    def _configure(self, made: zmq.Socket[bytes]) -> None:
        super()._configure(made)
        made.setsockopt(zmq.SNDHWM, KEPT_FRAMES)
        # report every connection's subscriptions, not only the first and the last of a topic
        made.setsockopt(zmq.XPUB_VERBOSER, 1)
        self._topics: dict[int, set[bytes]] = {}  # by the connection's file descriptor

    def look(self) -> bool:
        """Read the subscriptions that have come, without waiting; True while any watcher is
        subscribed.
        """
        self._tend()
        if self._keeper is not None:
            for file in self._keeper.left:
                self._topics.pop(file, None)
            self._keeper.left.clear()
        for _ in range(MAX_READ):
            try:
                subscription = self._ready().recv(zmq.NOBLOCK, copy=False)
            except zmq.Again:
                break
            # what libzmq itself reports of an ended connection has no file descriptor
            with contextlib.suppress(zmq.ZMQError):
                self._take_subscription(subscription.get(zmq.SRCFD), subscription.bytes)
        return bool(self._topics)

    def _take_subscription(self, file: int, said: bytes) -> None:
        kind = said[:1]
        topic = said[1:]
        if not (HEAD_BEGINS.startswith(topic) or topic.startswith(HEAD_BEGINS)):
            return
        # libzmq may deliver a subscription after its connection has ended
        if self._keeper is None or not self._keeper.is_open(file):
            return
        if kind == bytes([SUBSCRIBES]):
            topics = self._topics.setdefault(file, set())
            if len(topics) < MAX_TOPICS:
                topics.add(topic)
        elif kind == bytes([UNSUBSCRIBES]) and file in self._topics:
            topics = self._topics[file]
            if len(topics) < MAX_TOPICS:
                topics.discard(topic)
            if not topics:
                del self._topics[file]

    def put_frame(self, frame: ShownFrame) -> None:
        """Send one frame to every watcher; a watcher whose queue is full does not get it."""
        with contextlib.suppress(zmq.Again):
            self._ready().send_multipart(frame_parts(frame), zmq.NOBLOCK, copy=False)


class FrameWatch(ZmqRoad):
    """The watcher's end, which connects to a `FrameSender`. `refused` counts the messages that
    were no frames, and `why_refused` says what was wrong with the last of them.
    """

    def __init__(self, endpoint: str) -> None:
        self.refused = 0
        self.why_refused = ""
        super().__init__(
            endpoint,
            queue_messages=WAITING_FRAMES,
            keys=NO_KEYS,
            max_part_bytes=MAX_FRAME_BYTES,
        )

    def frames(self, timeout_ms: int) -> list[ShownFrame]:
        """The frames that have arrived, oldest first; waits at most `timeout_ms` for the first."""
        frames_shown = []
        for message in self.taken(timeout_ms):
            frame = read_frame(list(message.parts))
            if isinstance(frame, ShownFrame):
                frames_shown.append(frame)
            else:
                self.refused = self.refused + 1
                self.why_refused = frame
        return frames_shown
