"""The sockets that attitudes come and go through: ZeroMQ, free-running (SUB) or in lockstep (REP)."""

from __future__ import annotations

import contextlib
import errno
import math
import time
from types import TracebackType
from typing import TYPE_CHECKING, Self

import msgspec
import zmq

from hilstar.attitude.wire.doorkeeper import HANDSHAKE_MS, Doorkeeper
from hilstar.attitude.wire.endpoint import ENDPOINT_FORM, PATH_FORM, check_use, parse_endpoint
from hilstar.attitude.wire.flood_limits import MAX_GROWTH_BYTES, FloodGate, LinkCounts, MemoryWatch, raise_file_limit
from hilstar.attitude.wire.keys import NO_KEYS, AllowList, CurveKeys, check_reach, load_public, load_secret
from hilstar.attitude.wire.links import Arrival
from hilstar.attitude.wire.packet import Event, Packet, Refusal, Status, TimeReply, decode, encode
from hilstar.errors import InputError
from hilstar.notices import Notices
from hilstar.process.interrupts import caught

if TYPE_CHECKING:
    from zmq.auth.thread import ThreadAuthenticator

# A flood waits here, at most QUEUE_MESSAGES; what is over waits at the sender or is lost there. A part over MAX_PART_BYTES
# drops its connection, which is then made anew, and a message of more than MAX_PARTS every connection. What nobody limits,
# a message that does not end, is bounded by the memory of the process (bounds.MemoryWatch).
QUEUE_MESSAGES = 1000
MAX_PART_BYTES = 1 << 18
MAX_PARTS = 64
MAX_TAKEN_BYTES = 8_000_000  # in one go
SEND_QUEUE_MESSAGES = 10_000
MAX_SUBSCRIPTION_BYTES = 1024
# A peer whose cable was pulled says nothing: it is asked, and its connection made anew.
HEARTBEAT_MS = 1000
HEARTBEAT_TIMEOUT_MS = 3000
MAX_RECONNECT_MS = 500
RECONNECT_S = 0.25
REBIND_S = 2.0  # a port is free again some milliseconds after its socket was closed
TEND_S = 0.05


def zmq_version() -> str:
    """The version of libzmq."""
    return zmq.zmq_version()


class _ZmqLink:
    """A socket and its context, bound or connected; opened anew when a flood asks for it.

    A socket that binds is opened at once, to see that it can be; one that receives is then shut until it is first read, so
    that nothing waits in it, old, and no flood grows in it, while the display is made ready.
    """

    def __init__(self, kind: int, endpoint: str, *, bind: bool, keys: CurveKeys, notices: Notices | None) -> None:
        self._place = parse_endpoint(endpoint)
        check_reach(self._place, endpoint, bind=bind, keys=keys)
        check_use(self._place, endpoint, bind=bind)
        self.endpoint = endpoint
        self.verb = "bound to" if bind else "connected to"
        self.link_counts = LinkCounts()
        self._notices = Notices() if notices is None else notices
        self._kind, self._bind, self._address = kind, bind, self._place.address
        self._pair = None if keys.secret_key is None else load_secret(keys.secret_key)
        self._server_key = None if bind or keys.server_key is None else load_public(keys.server_key)
        allowed = AllowList(keys.allowed_clients) if bind and keys.allowed_clients is not None else None
        raise_file_limit()
        self._memory = MemoryWatch()
        self._context = zmq.Context()
        self._authenticator: ThreadAuthenticator | None = None
        self._socket: zmq.Socket[bytes] | None = None
        self._keeper: Doorkeeper | None = None
        self._poller = zmq.Poller()
        try:
            if allowed is not None:
                self._authenticate(allowed)
            if bind:
                self._open(0.0)
        except InputError:
            self.close()
            raise

    def _authenticate(self, allowed: AllowList) -> None:
        from zmq.auth.thread import ThreadAuthenticator  # brings asyncio

        self._authenticator = ThreadAuthenticator(self._context)
        self._authenticator.start()
        self._authenticator.configure_curve_callback("*", allowed)

    def _open(self, patience_s: float = REBIND_S) -> zmq.Socket[bytes]:
        """The socket, opened. Raises InputError where it cannot be bound within `patience_s`."""
        made: zmq.Socket[bytes] = self._context.socket(self._kind)
        self._configure(made)
        self._secure(made)
        self._socket = made
        self._keeper = Doorkeeper(made, bound=self._bind, counts=self.link_counts, notices=self._notices)
        self._poller = zmq.Poller()
        self._poller.register(made, zmq.POLLIN)
        self._poller.register(self._keeper.monitor, zmq.POLLIN)
        try:
            if self._bind:
                self._bind_within(made, patience_s)
                self._keeper.place = str(self._place.path or "") or int(self._address.rpartition(":")[2])
            else:
                made.connect(self._address)
        except zmq.ZMQError as error:
            raise InputError(_endpoint_trouble(self.endpoint, self._bind, error)) from error
        return made

    def _bind_within(self, made: zmq.Socket[bytes], patience_s: float) -> None:
        """Bind, and wait for a socket of our own at this place that is about to close."""
        deadline_s = time.monotonic() + patience_s
        path = self._place.path
        while path is not None and path.exists() and time.monotonic() < deadline_s:
            time.sleep(0.002)
        check_use(self._place, self.endpoint, bind=True)
        while True:
            try:
                made.bind(self._address)
            except zmq.ZMQError as error:
                if error.errno != zmq.EADDRINUSE or time.monotonic() > deadline_s:
                    raise
                time.sleep(0.002)
                continue
            self._address = self.endpoint = made.getsockopt_string(zmq.LAST_ENDPOINT)
            return

    def _configure(self, made: zmq.Socket[bytes]) -> None:
        """Set the options that must come before bind or connect."""
        made.setsockopt(zmq.LINGER, 0)
        made.setsockopt(zmq.IPV6, "[" in self._address)
        made.setsockopt(zmq.MAXMSGSIZE, MAX_PART_BYTES)
        made.setsockopt(zmq.RCVHWM, QUEUE_MESSAGES)
        made.setsockopt(zmq.HANDSHAKE_IVL, HANDSHAKE_MS)
        made.setsockopt(zmq.HEARTBEAT_IVL, HEARTBEAT_MS)
        made.setsockopt(zmq.HEARTBEAT_TIMEOUT, HEARTBEAT_TIMEOUT_MS)
        made.setsockopt(zmq.RECONNECT_IVL_MAX, MAX_RECONNECT_MS)

    def _secure(self, made: zmq.Socket[bytes]) -> None:
        if self._pair is None:
            return
        made.curve_publickey, made.curve_secretkey = self._pair
        if self._server_key is None:
            made.curve_server = True
        else:
            made.curve_serverkey = self._server_key

    def _ready(self) -> zmq.Socket[bytes]:
        """The socket, open."""
        if self._socket is None:
            self._memory.begin()
            return self._open()
        return self._socket

    def _waits(self, timeout_ms: float) -> bool:
        """True once a message waits; connections and memory are looked after meanwhile."""
        deadline_s = time.monotonic() + timeout_ms / 1000
        while True:
            self._tend()
            ready = dict(self._poller.poll(math.ceil(max(0.0, deadline_s - time.monotonic()) * 1000)))
            if self._socket in ready:
                return True
            if time.monotonic() >= deadline_s:
                return False

    def _tend(self) -> None:
        self._ready()
        if self._keeper is not None:
            self._keeper.tend()
        if self._memory.grown_bytes() > MAX_GROWTH_BYTES:
            self._reset(f"memory grew by over {MAX_GROWTH_BYTES / 1e6:.0f} MB, as of a message that does not end")

    def _take(self) -> bytes | None:
        """The last part of the next message; None where none is whole, or it had more than MAX_PARTS."""
        taken = self._ready()
        try:
            part = taken.recv(zmq.NOBLOCK)
            for _ in range(MAX_PARTS):
                if not taken.getsockopt(zmq.RCVMORE):
                    return part
                part = taken.recv(zmq.NOBLOCK)
        except zmq.Again:
            return None
        self._reset(f"a message of more than {MAX_PARTS} parts")
        return None

    def _reset(self, why: str) -> None:
        """Drop every connection, and what libzmq keeps of it."""
        self.link_counts.resets += 1
        self._notices.tell("flood", f"{self.endpoint}: {why}; every connection is dropped and made anew")
        self._shut()
        self._memory.await_release()
        self._open()

    def _shut(self, linger_ms: int = 0) -> None:
        if self._keeper is not None:
            self._keeper.close()
        if self._socket is not None:
            self._socket.close(linger=linger_ms)
        self._keeper = self._socket = None

    def close(self) -> None:
        """Close the socket; what it has not sent within its linger time is lost."""
        self._shut(self._linger_ms())
        if self._authenticator is not None:
            self._authenticator.stop()
        self._context.term()
        self._memory.close()

    def _linger_ms(self) -> int:
        return 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


def _endpoint_trouble(endpoint: str, bind: bool, error: zmq.ZMQError) -> str:
    if error.errno == zmq.EADDRINUSE:
        return f"{endpoint}: the port is in use; stop the program that has it, or choose another port"
    if bind and error.errno in {errno.ENODEV, zmq.EADDRNOTAVAIL}:
        return f"{endpoint}: is no address of this machine, so nothing can bind it; connect (--connect, bind = false) instead"
    verb = "bind" if bind else "connect"
    form = PATH_FORM if endpoint.startswith("ipc:") else ENDPOINT_FORM
    return f"{endpoint}: cannot {verb} ({zmq.strerror(error.errno or 0)}); {form}"


class ZmqReceiver(_ZmqLink):
    """A SUB socket that takes every message; it connects, or binds with `bind`."""

    two_way = False

    def __init__(self, endpoint: str, *, bind: bool = False, keys: CurveKeys = NO_KEYS, notices: Notices | None = None) -> None:
        super().__init__(zmq.SUB, endpoint, bind=bind, keys=keys, notices=notices)
        self._shut()
        self._gate = FloodGate(self.link_counts, self._notices)
        self._reconnect_s = 0.0

    @property
    def reconnects(self) -> int:
        """How often the sender was there again."""
        return 0 if self._bind else max(0, self.link_counts.connections - 1)

    def _configure(self, made: zmq.Socket[bytes]) -> None:
        super()._configure(made)
        made.setsockopt(zmq.SUBSCRIBE, b"")

    def receive(self, timeout_ms: int) -> list[Arrival[Event]]:
        """The messages that wait, oldest first; only the last part of each is read, and only the newest of a flood.

        Waits at most `timeout_ms` for the first, and for no other.
        """
        if not self._waits(timeout_ms):
            return []
        waiting: list[tuple[int, bytes]] = []
        taken_bytes = 0
        while len(waiting) < QUEUE_MESSAGES and taken_bytes < MAX_TAKEN_BYTES and (message := self._take()) is not None:
            waiting.append((time.monotonic_ns(), message))
            taken_bytes += len(message)
        admitted = self._gate.admit(len(waiting))
        return [Arrival(host_ns, decode(message), message) for host_ns, message in waiting[len(waiting) - admitted :]]

    def wait_for_message(self, timeout_ms: int) -> bool:
        """True once a message waits."""
        return self._waits(timeout_ms)

    def send(self, packet: Packet) -> None:
        """A subscriber has no way back."""

    def wire_ns(self, packet: Packet) -> int:
        """Too little to count."""
        return 0

    def _tend(self) -> None:
        super()._tend()
        if not self._bind:
            self._connect_anew_if_lost()

    def _connect_anew_if_lost(self) -> None:
        """libzmq itself reconnects after a lost peer, and never after a part over MAXMSGSIZE, or where it was rejected."""
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


class ZmqLockstep(_ZmqLink):
    """A REP socket: one request is one attitude and gets one reply; it binds, or connects with `bind=False`."""

    def __init__(self, endpoint: str, *, bind: bool = True, keys: CurveKeys = NO_KEYS, notices: Notices | None = None) -> None:
        super().__init__(zmq.REP, endpoint, bind=bind, keys=keys, notices=notices)
        self._shut()
        self._json = False

    def receive(self, timeout_ms: int) -> Arrival[Event] | None:
        """The next request, or None; each one has to be answered before the next can come.

        A request without its delimiter is announced by libzmq and then dropped: it is not waited for.
        """
        message = self._take() if self._waits(timeout_ms) else None
        if message is None:
            return None
        self._json = message[:64].lstrip()[:1] == b"{"
        return Arrival(time.monotonic_ns(), decode(message), message)

    def reply(self, status: Status, shown_ns: int, refusal: Refusal | None) -> None:
        """Say what became of the request: a status packet for a packet, an object for JSON."""
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
        """An asker that is gone, or takes nothing, gets no answer."""
        with contextlib.suppress(zmq.Again):
            self._ready().send(message, zmq.NOBLOCK)


class ZmqSender(_ZmqLink):
    """A publisher that knows when somebody listens (XPUB); it binds, or connects with `bind=False`."""

    LINGER_MS, STOPPED_LINGER_MS = 2000, 200  # for a listener that is slow, without and with a signal

    def __init__(self, endpoint: str, *, bind: bool = True, keys: CurveKeys = NO_KEYS, notices: Notices | None = None) -> None:
        self._tended_s = 0.0
        super().__init__(zmq.XPUB, endpoint, bind=bind, keys=keys, notices=notices)
        self._ready()

    def _configure(self, made: zmq.Socket[bytes]) -> None:
        super()._configure(made)
        made.setsockopt(zmq.SNDHWM, SEND_QUEUE_MESSAGES)
        made.setsockopt(zmq.MAXMSGSIZE, MAX_SUBSCRIPTION_BYTES)  # nothing else comes this way

    def wait_for_listener(self, timeout_s: float) -> bool:
        """True once a subscriber is there; what is sent before that is lost."""
        return self._waits(timeout_s * 1000) and self._take() is not None

    def put(self, message: bytes) -> None:
        """Send one message, never waiting."""
        now_s = time.monotonic()
        if now_s - self._tended_s > TEND_S:
            self._tended_s = now_s
            self._tend()
            for _ in range(QUEUE_MESSAGES):  # who subscribes, and to what, is kept until it is read
                if self._take() is None:
                    break
        with contextlib.suppress(zmq.Again):
            self._ready().send(message, zmq.NOBLOCK)

    def _linger_ms(self) -> int:
        return self.LINGER_MS if caught() is None else self.STOPPED_LINGER_MS
