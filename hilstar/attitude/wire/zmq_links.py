"""Links over ZeroMQ: a free-running stream (SUB in, XPUB out), lockstep (REP), and the feed from
one source to its heads.
"""

import contextlib
import math
import struct
from functools import partial
from typing import Any, Unpack

import msgspec
import zmq

from hilstar.attitude.wire import packet as wire
from hilstar.attitude.wire.apart import OpenStream, ReaderProcess
from hilstar.attitude.wire.keys import NO_KEYS, CurveKeys
from hilstar.attitude.wire.links import (
    Arrival,
    Decoder,
    LockstepLink,
    PacketDecoder,
    StreamLink,
)
from hilstar.attitude.wire.roads import ATTITUDES, ByteRoad, LinkCounts, RawMessage
from hilstar.attitude.wire.source import AS_SENT, SentAttitudes
from hilstar.attitude.wire.zmq_socket import (
    QUEUE_MESSAGES,
    SocketOptions,
    ZmqReply,
    ZmqSocket,
    trouble_of,
)
from hilstar.basics.notices import Notices
from hilstar.basics.process.closing import Closing
from hilstar.basics.process.interrupts import caught
from hilstar.basics.process.scheduling import HOST_CLOCK, HostClock

SEND_QUEUE_MESSAGES = 10_000
MAX_SUBSCRIPTION_BYTES = 1024
RECONNECT_S = 0.25
TEND_S = 0.05
STAMP = struct.Struct("<q")  # host time of arrival, ns: one clock for all processes of a machine


PACKET_DECODER = PacketDecoder()


class ZmqRoad(ZmqSocket):
    """A SUB socket that takes every message that begins with `topic`; it connects, or binds with
    `bind`. Of a full queue it keeps `queue_messages`, the oldest.
    """

    def __init__(
        self,
        endpoint: str,
        *,
        topic: bytes = b"",
        queue_messages: int = QUEUE_MESSAGES,
        **options: Unpack[SocketOptions],
    ) -> None:
        self._topic = topic
        self._queue_messages = queue_messages
        super().__init__(zmq.SUB, endpoint, **options)
        if not self._bind:  # a connecting socket hears nothing until a sender binds there
            self.verb = "waiting for a sender at"
        self._shut()
        self._lost_until = self._clock.within(0.0)

    def opener(self) -> OpenStream:
        """A function by which another process opens a link on the same socket."""
        more: dict[str, Any] = {
            "keys": self._keys,
            "topic": self._topic,
            "max_part_bytes": self._max_part_bytes,
        }
        return partial(ZmqReceiver, self.endpoint, bind=self._bind, **more)

    def _configure(self, made: zmq.Socket[bytes]) -> None:
        super()._configure(made)
        made.setsockopt(zmq.RCVHWM, self._queue_messages)
        made.setsockopt(zmq.SUBSCRIBE, self._topic)

    def _tend(self) -> None:
        """Connect anew where the peer is lost: libzmq does so, but not after a part over
        MAXMSGSIZE or a rejection.
        """
        super()._tend()
        keeper = self._keeper
        if self._bind or keeper is None or self._socket is None or not keeper.lost:
            self._lost_until = self._clock.within(RECONNECT_S)
        elif self._lost_until.over:
            keeper.lost = False
            with contextlib.suppress(zmq.ZMQError):  # the ended session may be gone already
                self._socket.disconnect(self._address)
            self._socket.connect(self._address)


class ZmqRoadApart(ByteRoad):
    """The socket of a road, read by a separate process.

    The road was opened to see that it can be; it is closed here, and the other process opens the
    same socket at the first read, so that no old messages collect in it. That process passes over
    what is too much.
    """

    messages = stamped = True

    def __init__(
        self, road: ZmqRoad, notices: Notices | None = None, clock: HostClock = HOST_CLOCK
    ) -> None:
        super().__init__(road.endpoint, ATTITUDES, notices, clock)
        road.close()
        self.verb = road.verb
        self.link_counts = road.link_counts
        self._bound = road.bound
        self._opener = road.opener()
        self._waiting: list[RawMessage] = []
        self._ordered = False
        self._reader = ReaderProcess(self._notices, clock=clock)

    @property
    def trouble(self) -> str:
        """See `ZmqSocket.trouble`."""
        return trouble_of(self.link_counts, self._notices)

    def await_ready(self) -> None:
        """Wait until the socket can be opened at once, or for a moment."""
        self._reader.await_ready()

    def taken(self, timeout_ms: int) -> list[RawMessage]:
        """The messages that came, oldest first, with their stamps; see `ByteRoad.taken`."""
        self.wait_for_message(timeout_ms)
        waiting = self._waiting
        self._waiting = []
        return waiting

    def wait_for_message(self, timeout_ms: int) -> bool:
        """True once a message has come."""
        if not self._ordered:
            self._ordered = True
            self._reader.read(self._opener)
        deadline = self._clock.within(timeout_ms / 1000)
        while not self._waiting:
            left_ms = math.ceil(deadline.left_s * 1000)
            if not self._reader.wait(left_ms):
                if not left_ms:
                    break
                continue
            for record in self._reader.take():
                if record.message is not None:
                    self._waiting.append(record.message)
                if record.counts is not None:
                    self._count(record.counts)
        return bool(self._waiting)

    def _count(self, grown: LinkCounts) -> None:
        """Take what the other process has counted, and told, since it did so last."""
        self.link_counts += grown
        if not self._bound:
            self.openings = self.link_counts.connections

    def close(self) -> None:
        """End the process, and with it the socket."""
        self._reader.close()


class ZmqReceiver(StreamLink):
    """What comes to a SUB socket; see `ZmqRoad`."""

    _road: ZmqRoad

    def __init__(
        self,
        endpoint: str,
        *,
        topic: bytes = b"",
        decoder: Decoder = PACKET_DECODER,
        **options: Unpack[SocketOptions],
    ) -> None:
        super().__init__(ZmqRoad(endpoint, topic=topic, **options), decoder)

    def apart(self, notices: Notices | None, clock: HostClock) -> tuple[ZmqRoadApart, Decoder]:
        """The same road, read by a separate process from now on, and the decoder."""
        return ZmqRoadApart(self._road, notices, clock), self._decoder


class ZmqApart(StreamLink):
    """A ZmqReceiver whose socket is read by a separate process; see `ZmqRoadApart`."""

    def __init__(
        self, link: ZmqReceiver, notices: Notices | None = None, clock: HostClock = HOST_CLOCK
    ) -> None:
        super().__init__(*link.apart(notices, clock))

    def taken(self, timeout_ms: int) -> list[RawMessage]:
        """See `StreamLink.taken`: the other process has passed over what is too much."""
        return self.messages(timeout_ms)


class ZmqSender(ZmqSocket):
    """An XPUB socket, which reports subscribers; it binds, or connects with `bind=False`."""

    LINGER_MS, STOPPED_LINGER_MS = 2000, 200  # for a slow subscriber, without and with a signal
    status: wire.Status | None = None  # no way back
    answer: wire.AnswerPacket | None = None

    def __init__(
        self,
        endpoint: str,
        *,
        bind: bool = True,
        keys: CurveKeys = NO_KEYS,
        clock: HostClock = HOST_CLOCK,
    ) -> None:
        self._tended_until = clock.within(0.0)
        super().__init__(zmq.XPUB, endpoint, bind=bind, keys=keys, clock=clock)
        self._ready()

    def _configure(self, made: zmq.Socket[bytes]) -> None:
        super()._configure(made)
        made.setsockopt(zmq.SNDHWM, SEND_QUEUE_MESSAGES)
        made.setsockopt(zmq.MAXMSGSIZE, MAX_SUBSCRIPTION_BYTES)  # nothing else arrives here

    def wait_for_listener(self, timeout_s: float) -> bool:
        """True once there is a subscriber; messages sent before that are lost."""
        return self._waits(timeout_s * 1000) and self._take() is not None

    def put(self, data: bytes, patience_s: float = 0.0) -> bool:
        """Send one message, never waiting."""
        if self._tended_until.over:
            self._tended_until = self._clock.within(TEND_S)
            self._tend()
            for _ in range(QUEUE_MESSAGES):  # libzmq keeps subscriptions until they are read
                if self._take() is None:
                    break
        return self._put([data])

    def close(self) -> None:
        """Close the socket; messages not sent within its linger time are lost."""
        self._shut(self.LINGER_MS if caught() is None else self.STOPPED_LINGER_MS)
        super().close()


class ZmqLockstep(LockstepLink):
    """A REP socket: one request is one attitude and gets one reply; it binds, or connects with
    `bind=False`.
    """

    _road: ZmqReply
    _json = False  # whether the last request was

    def __init__(
        self, endpoint: str, *, sent: SentAttitudes = AS_SENT, **options: Unpack[SocketOptions]
    ) -> None:
        self._decode = sent.decoder(wire.decode)
        super().__init__(ZmqReply(endpoint, **options), sent.conventions)

    def receive(self, timeout_ms: int) -> Arrival[wire.Event] | None:
        """The next request for a frame, or None; it must be answered before the next can arrive.

        Time requests are answered here.
        """
        request = self._road.request(timeout_ms)
        if request is None:
            return None
        host_ns = request.host_ns
        message = request.parts[-1]
        event = self._decode(message)
        if isinstance(event, wire.TimeRequest):
            now_ns = self._clock.now_ns()
            self._road.put(
                wire.encode(wire.TimeReply(event.sequence, event.t1_ns, host_ns, now_ns))
            )
            return None
        self._json = message[:64].lstrip()[:1] == b"{"
        return Arrival(host_ns, event, message)

    def answer(self, status: wire.Status, shown_ns: int, refusal: wire.Refusal | None) -> None:
        """Answer the request: with a status packet for a packet, with an object for JSON."""
        if not self._json:
            self._road.put(wire.encode(status))
            return
        fields = {name: getattr(status, name) for name in status.__dataclass_fields__}
        if refusal is None:
            trouble = None
        else:
            trouble = {"reason": refusal.reason, "detail": refusal.detail}
        self._road.put(msgspec.json.encode({**fields, "shown_ns": shown_ns, "refused": trouble}))


class Feed(Closing):
    """A PUB socket that hands on what a source brings; a head that is slow or gone delays no
    other.
    """

    def __init__(self, endpoint: str) -> None:
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._socket = self._context.socket(zmq.PUB)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.SNDHWM, QUEUE_MESSAGES)
        self._socket.bind(endpoint)

    def give(self, arrival: Arrival[wire.Event]) -> None:
        """Hand on a message with its time of arrival: its bytes where hilstar's own decoder reads
        them, or else a packet of the same attitude.
        """
        raw = arrival.raw
        if isinstance(arrival.event, wire.AttitudeSample) and not isinstance(
            wire.decode(raw), wire.AttitudeSample
        ):
            raw = wire.encode(arrival.event)
        with contextlib.suppress(zmq.Again):
            self._socket.send_multipart([STAMP.pack(arrival.host_ns), raw], zmq.NOBLOCK)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()
        self._context.term()


class FedDecoder(PacketDecoder):
    """Decodes what a Feed hands on: each message has the time at which it reached the feed. The
    body's attitudes become those of a head's camera.
    """

    stamped = True

    def _arrival(self, message: RawMessage) -> Arrival[wire.Event]:
        if len(message.parts) != 2 or len(message.parts[0]) != STAMP.size:
            return super()._arrival(message)
        (came_ns,) = STAMP.unpack(message.parts[0])
        raw = message.parts[1]
        return Arrival(came_ns, self.event(raw), raw)
