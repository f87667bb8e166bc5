"""Links over ZeroMQ: a free-running stream (SUB in, XPUB out), lockstep (REP), and the feed from
one source to its heads.
"""

import contextlib
import math
import struct
from collections.abc import Iterable
from functools import partial
from typing import Any, Unpack

import msgspec
import zmq

from hilstar.attitude.wire import packet as wire
from hilstar.attitude.wire.apart import OpenStream, ReaderProcess
from hilstar.attitude.wire.keys import NO_KEYS, CurveKeys
from hilstar.attitude.wire.links import Arrival, LockstepLink, RawMessage, StreamLink
from hilstar.attitude.wire.source import AS_SENT, SentAttitudes
from hilstar.attitude.wire.zmq_socket import QUEUE_MESSAGES, SocketOptions, ZmqSocket
from hilstar.basics.notices import Notices
from hilstar.basics.process.closing import Closing
from hilstar.basics.process.interrupts import caught
from hilstar.basics.process.scheduling import HOST_CLOCK, HostClock

MAX_TAKEN_BYTES = 8_000_000  # in one go
SEND_QUEUE_MESSAGES = 10_000
MAX_SUBSCRIPTION_BYTES = 1024
RECONNECT_S = 0.25
TEND_S = 0.05
STAMP = struct.Struct("<q")  # host time of arrival, ns: one clock for all processes of a machine


class PacketDecoder:
    """Says what the messages of a free stream mean: packets or JSON, of which only the last part
    counts.
    """

    stamped = False  # whether messages carry their own times of arrival

    def __init__(self, sent: SentAttitudes = AS_SENT) -> None:
        self.conventions = sent.conventions
        self.decode = sent.decoder(wire.decode)

    def arrivals(self, messages: Iterable[RawMessage]) -> list[Arrival[wire.Event]]:
        """What messages say."""
        return [self._arrival(message) for message in messages]

    def _arrival(self, message: RawMessage) -> Arrival[wire.Event]:
        raw = message.parts[-1]
        return Arrival(message.host_ns, self.decode(raw), raw, message.waited_ns)


PACKET_DECODER = PacketDecoder()


class ZmqReceiver(ZmqSocket, StreamLink):
    """A SUB socket that takes every message that begins with `topic`; it connects, or binds with
    `bind`.
    """

    def __init__(
        self,
        endpoint: str,
        *,
        topic: bytes = b"",
        decoder: PacketDecoder = PACKET_DECODER,
        **options: Unpack[SocketOptions],
    ) -> None:
        self.topic = topic
        self.decoder = decoder
        self.bound = options.get("bind", False)
        self.conventions = decoder.conventions
        self.stamped = decoder.stamped
        super().__init__(zmq.SUB, endpoint, **options)
        if not self.bound:  # a connecting socket hears nothing until a sender binds there
            self.verb = "waiting for a sender at"
        self._shut()
        self._lost_until = self._clock.within(0.0)

    def opener(self) -> OpenStream:
        """A function by which another process opens the same socket."""
        more: dict[str, Any] = {
            "keys": self._keys,
            "topic": self.topic,
            "max_part_bytes": self._max_part_bytes,
        }
        return partial(ZmqReceiver, self.endpoint, bind=self._bind, **more)

    def _configure(self, made: zmq.Socket[bytes]) -> None:
        super()._configure(made)
        made.setsockopt(zmq.SUBSCRIBE, self.topic)

    def receive(self, timeout_ms: int) -> list[Arrival[wire.Event]]:
        """The waiting messages, oldest first, and only the newest of a flood; waits at most
        `timeout_ms` for the first.
        """
        return self.decoder.arrivals(self.taken(timeout_ms))

    def taken(self, timeout_ms: int) -> list[RawMessage]:
        """The same, not decoded."""
        if not self._waits(timeout_ms):
            return []
        waiting: list[RawMessage] = []
        taken_bytes = 0
        while len(waiting) < QUEUE_MESSAGES and taken_bytes < MAX_TAKEN_BYTES:
            parts = self._take_parts()
            if parts is None:
                break
            waiting.append(RawMessage(self._clock.now_ns(), parts))
            taken_bytes += sum(map(len, parts))
        return self._gate.newest(waiting, wire.declares_discontinuity)

    def wait_for_message(self, timeout_ms: int) -> bool:
        """True once a message waits."""
        return self._waits(timeout_ms)

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


class ZmqApart(StreamLink):
    """A ZeroMQ stream whose socket is read by a separate process.

    `link` was opened to see that it can be; it is closed here, and the other process opens the same
    socket at the first read, so that no old messages collect in it.
    """

    stamped = True

    def __init__(
        self, link: ZmqReceiver, notices: Notices | None = None, clock: HostClock = HOST_CLOCK
    ) -> None:
        super().__init__(notices, clock)
        link.close()
        self.verb = link.verb
        self.endpoint = link.endpoint
        self.conventions = link.conventions
        self.link_counts = link.link_counts
        self._decoder = link.decoder
        self.bound = link.bound
        self._opener = link.opener()
        self._waiting: list[RawMessage] = []
        self._ordered = False
        self._reader = ReaderProcess(self._notices, clock=clock)

    def await_ready(self) -> None:
        """Wait until the socket can be opened at once, or for a moment."""
        self._reader.await_ready()

    def receive(self, timeout_ms: int) -> list[Arrival[wire.Event]]:
        """The messages that came, oldest first, with their stamps; waits at most `timeout_ms`
        for the first.
        """
        self.wait_for_message(timeout_ms)
        waiting = self._waiting
        self._waiting = []
        return self._decoder.arrivals(waiting)

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
                    self.link_counts += record.counts
        return bool(self._waiting)

    def close(self) -> None:
        """End the process, and with it the socket."""
        self._reader.close()


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

    def put(self, message: bytes) -> None:
        """Send one message, never waiting."""
        if self._tended_until.over:
            self._tended_until = self._clock.within(TEND_S)
            self._tend()
            for _ in range(QUEUE_MESSAGES):  # libzmq keeps subscriptions until they are read
                if self._take() is None:
                    break
        with contextlib.suppress(zmq.Again):
            self._ready().send(message, zmq.NOBLOCK)

    def close(self) -> None:
        """Close the socket; messages not sent within its linger time are lost."""
        self._shut(self.LINGER_MS if caught() is None else self.STOPPED_LINGER_MS)
        super().close()


class ZmqLockstep(ZmqSocket, LockstepLink):
    """A REP socket: one request is one attitude and gets one reply; it binds, or connects with
    `bind=False`.
    """

    _json = False  # whether the last request was

    def __init__(
        self, endpoint: str, *, sent: SentAttitudes = AS_SENT, **options: Unpack[SocketOptions]
    ) -> None:
        self.conventions = sent.conventions
        self._decode = sent.decoder(wire.decode)
        options.setdefault("bind", True)
        super().__init__(zmq.REP, endpoint, **options)

    def receive(self, timeout_ms: int) -> Arrival[wire.Event] | None:
        """The next request for a frame, or None; it must be answered before the next can arrive.

        Time requests are answered here. libzmq announces a request without its delimiter, then
        drops it: none is waited for.
        """
        if self._waits(timeout_ms):
            message = self._take()
        else:
            message = None
        if message is None:
            return None
        host_ns = self._clock.now_ns()
        event = self._decode(message)
        if isinstance(event, wire.TimeRequest):
            self._answer(
                wire.encode(
                    wire.TimeReply(event.sequence, event.t1_ns, host_ns, self._clock.now_ns())
                )
            )
            return None
        self._json = message[:64].lstrip()[:1] == b"{"
        return Arrival(host_ns, event, message)

    def answer(self, status: wire.Status, shown_ns: int, refusal: wire.Refusal | None) -> None:
        """Answer the request: with a status packet for a packet, with an object for JSON."""
        if not self._json:
            self._answer(wire.encode(status))
            return
        fields = {name: getattr(status, name) for name in status.__dataclass_fields__}
        if refusal is None:
            trouble = None
        else:
            trouble = {"reason": refusal.reason, "detail": refusal.detail}
        self._answer(msgspec.json.encode({**fields, "shown_ns": shown_ns, "refused": trouble}))

    def _answer(self, message: bytes) -> None:
        """A peer that is gone, or does not read, gets no answer."""
        with contextlib.suppress(zmq.Again):
            self._ready().send(message, zmq.NOBLOCK)


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
        return Arrival(came_ns, self.decode(raw), raw)
