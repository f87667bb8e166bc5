"""Links over ZeroMQ: a free-running stream (SUB in, XPUB out), lockstep (REP), and the feed from one source to its heads."""

from __future__ import annotations

import contextlib
import struct
import time
from collections.abc import Iterable
from dataclasses import replace
from types import TracebackType
from typing import NamedTuple, Self

import msgspec
import zmq

from hilstar.attitude.wire.keys import NO_KEYS, CurveKeys
from hilstar.attitude.wire.links import Arrival, FloodGate
from hilstar.attitude.wire.packet import (
    AttitudeSample,
    Event,
    Packet,
    Refusal,
    Status,
    TimeReply,
    declares_discontinuity,
    decode,
    encode,
)
from hilstar.attitude.wire.source import Conventions, Mounting
from hilstar.attitude.wire.zmq_socket import QUEUE_MESSAGES, ZmqSocket
from hilstar.notices import Notices
from hilstar.process.interrupts import caught

MAX_TAKEN_BYTES = 8_000_000  # in one go
SEND_QUEUE_MESSAGES = 10_000
MAX_SUBSCRIPTION_BYTES = 1024
RECONNECT_S = 0.25
TEND_S = 0.05
STAMP = struct.Struct("<q")  # host time of arrival, ns: one clock for all processes of a machine


class Taken(NamedTuple):
    """A message: when it came, host time in ns, its parts, and how long it may have waited unread, where that is known."""

    host_ns: int
    parts: list[bytes]
    waited_ns: int | None = None

    def declares_discontinuity(self) -> bool:
        """Whether it is a packet or JSON object whose attitude must not be interpolated to."""
        return declares_discontinuity(self.parts[-1])


class ZmqReceiver(ZmqSocket):
    """A SUB socket that takes every message that begins with its `topic`; it connects, or binds with `bind`."""

    two_way = False
    topic = b""

    def __init__(self, endpoint: str, *, bind: bool = False, keys: CurveKeys = NO_KEYS, notices: Notices | None = None) -> None:
        super().__init__(zmq.SUB, endpoint, bind=bind, keys=keys, notices=notices)
        if not bind:  # who connects is told of nothing until a sender binds there
            self.verb = "waiting for a sender at"
        self._shut()
        self._gate = FloodGate(self.link_counts, self._notices)
        self._reconnect_s = 0.0

    @property
    def reconnects(self) -> int:
        """How often the sender reconnected."""
        return 0 if self._bind else max(0, self.link_counts.connections - 1)

    def _configure(self, made: zmq.Socket[bytes]) -> None:
        super()._configure(made)
        made.setsockopt(zmq.SUBSCRIBE, self.topic)

    def receive(self, timeout_ms: int) -> list[Arrival[Event]]:
        """The waiting messages, oldest first, and only the newest of a flood; of packets only the last part counts.

        Waits at most `timeout_ms` for the first, and for no other.
        """
        return self.arrivals(self.taken(timeout_ms))

    def taken(self, timeout_ms: int) -> list[Taken]:
        """What `receive` makes its arrivals of."""
        if not self._waits(timeout_ms):
            return []
        waiting: list[Taken] = []
        taken_bytes = 0
        while len(waiting) < QUEUE_MESSAGES and taken_bytes < MAX_TAKEN_BYTES and (parts := self._take_parts()) is not None:
            waiting.append(Taken(time.monotonic_ns(), parts))
            taken_bytes += sum(map(len, parts))
        return self._gate.newest(waiting, Taken.declares_discontinuity)

    def arrivals(self, taken: Iterable[Taken]) -> list[Arrival[Event]]:
        """What messages say."""
        out = []
        for each in taken:
            arrival = self._arrival(each.host_ns, each.parts)
            if each.waited_ns is not None:
                arrival = replace(arrival, waited_ns=each.waited_ns, stamped=True)
            out.append(arrival)
        return out

    def _arrival(self, host_ns: int, parts: list[bytes]) -> Arrival[Event]:
        return Arrival(host_ns, decode(parts[-1]), parts[-1])

    def wait_for_message(self, timeout_ms: int) -> bool:
        """True once a message waits."""
        return self._waits(timeout_ms)

    def send(self, packet: Packet) -> None:
        """A subscriber cannot reply."""

    def wire_ns(self, packet: Packet) -> int:
        """Negligible."""
        return 0

    def _tend(self) -> None:
        super()._tend()
        if not self._bind:
            self._connect_anew_if_lost()

    def _connect_anew_if_lost(self) -> None:
        """libzmq itself reconnects after a lost peer, but not after a part over MAXMSGSIZE or a rejection."""
        if self._keeper is None or self._socket is None or not self._keeper.lost:
            return
        now_s = time.monotonic()
        if not self._reconnect_s:
            self._reconnect_s = now_s + RECONNECT_S
        if now_s < self._reconnect_s:
            return
        self._keeper.lost, self._reconnect_s = False, 0.0
        with contextlib.suppress(zmq.ZMQError):  # the ended session may be gone already
            self._socket.disconnect(self._address)
        self._socket.connect(self._address)


class ZmqSender(ZmqSocket):
    """An XPUB socket, which knows when somebody subscribes; it binds, or connects with `bind=False`."""

    LINGER_MS, STOPPED_LINGER_MS = 2000, 200  # for a slow subscriber, without and with a signal

    def __init__(self, endpoint: str, *, bind: bool = True, keys: CurveKeys = NO_KEYS, notices: Notices | None = None) -> None:
        self._tended_s = 0.0
        super().__init__(zmq.XPUB, endpoint, bind=bind, keys=keys, notices=notices)
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
        now_s = time.monotonic()
        if now_s - self._tended_s > TEND_S:
            self._tended_s = now_s
            self._tend()
            for _ in range(QUEUE_MESSAGES):  # libzmq keeps subscriptions until they are read
                if self._take() is None:
                    break
        with contextlib.suppress(zmq.Again):
            self._ready().send(message, zmq.NOBLOCK)

    def _linger_ms(self) -> int:
        return self.LINGER_MS if caught() is None else self.STOPPED_LINGER_MS


class ZmqLockstep(ZmqSocket):
    """A REP socket: one request is one attitude and gets one reply; it binds, or connects with `bind=False`."""

    def __init__(self, endpoint: str, *, bind: bool = True, keys: CurveKeys = NO_KEYS, notices: Notices | None = None) -> None:
        super().__init__(zmq.REP, endpoint, bind=bind, keys=keys, notices=notices)
        self._json = False

    def receive(self, timeout_ms: int) -> Arrival[Event] | None:
        """The next request, or None; each must be answered before the next can arrive.

        libzmq announces a request without its delimiter and then drops it: it is not waited for.
        """
        message = self._take() if self._waits(timeout_ms) else None
        if message is None:
            return None
        self._json = message[:64].lstrip()[:1] == b"{"
        return Arrival(time.monotonic_ns(), decode(message), message)

    def reply(self, status: Status, shown_ns: int, refusal: Refusal | None) -> None:
        """Answer the request: with a status packet for a packet, with an object for JSON."""
        if not self._json:
            self._answer(encode(status))
            return
        fields = {name: getattr(status, name) for name in status.__dataclass_fields__}
        trouble = None if refusal is None else {"reason": refusal.reason, "detail": refusal.detail}
        self._answer(msgspec.json.encode({**fields, "shown_ns": shown_ns, "refused": trouble}))

    def reply_time(self, reply: TimeReply) -> None:
        """Answer a time request."""
        self._answer(encode(reply))

    def _answer(self, message: bytes) -> None:
        """A peer that is gone, or does not read, gets no answer."""
        with contextlib.suppress(zmq.Again):
            self._ready().send(message, zmq.NOBLOCK)


class Feed:
    """A PUB socket that hands on what a source brings; a head that is slow or gone delays no other."""

    def __init__(self, endpoint: str) -> None:
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._socket = self._context.socket(zmq.PUB)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.SNDHWM, QUEUE_MESSAGES)
        self._socket.bind(endpoint)

    def give(self, arrival: Arrival[Event]) -> None:
        """Hand on a message: its bytes, or where those are the source's own words a packet of the same attitude."""
        raw = arrival.raw
        if isinstance(arrival.event, AttitudeSample) and not isinstance(decode(raw), AttitudeSample):
            raw = encode(arrival.event)
        with contextlib.suppress(zmq.Again):
            self._socket.send_multipart([STAMP.pack(arrival.host_ns), raw], zmq.NOBLOCK)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._socket.close()
        self._context.term()


class FedReceiver(ZmqReceiver):
    """A head's end of a Feed: the body's attitudes become its camera's, with the time at which they reached the feed."""

    def __init__(self, endpoint: str, mounting: Mounting, conventions: Conventions, notices: Notices | None = None) -> None:
        super().__init__(endpoint, notices=notices)
        self._mounting = mounting
        self.conventions = conventions

    def _arrival(self, host_ns: int, parts: list[bytes]) -> Arrival[Event]:
        if len(parts) != 2 or len(parts[0]) != STAMP.size:
            return super()._arrival(host_ns, parts)
        (came_ns,) = STAMP.unpack(parts[0])
        event = decode(parts[1])
        if not isinstance(event, AttitudeSample):
            return Arrival(came_ns, event, parts[1], stamped=True)
        camera = self._mounting.sample(event)
        return Arrival(came_ns, camera, encode(camera), stamped=True)
