"""The sockets that attitudes come and go through: ZeroMQ, free-running (SUB) or in lockstep (REP)."""

from __future__ import annotations

import contextlib
import errno
import re
import time
from types import TracebackType
from typing import Self

import msgspec
import zmq
from zmq.auth.thread import ThreadAuthenticator

from hilstar.attitude.curve import NO_KEYS, CurveKeys, check_allow_list, check_reach, load_public, load_secret
from hilstar.attitude.packet import Packet, Refusal, Status, TimeReply, decode, encode
from hilstar.attitude.receiver import Arrival
from hilstar.errors import InputError
from hilstar.interrupts import caught

# A flood is held here, at most QUEUE_MESSAGES * LONGEST_MESSAGE_BYTES = 256 MB of it; what is over waits at the sender or
# is lost there. A longer message drops its connection, which is then made anew.
QUEUE_MESSAGES = 1000
LONGEST_MESSAGE_BYTES = 1 << 18
SEND_QUEUE_MESSAGES = 10_000
# A peer whose cable was pulled says nothing: it is asked, and its connection made anew.
HEARTBEAT_MS = 1000
HEARTBEAT_TIMEOUT_MS = 3000
LONGEST_RECONNECT_MS = 500
ENDPOINT_FORM = "write tcp://HOST:PORT, such as tcp://127.0.0.1:5560"


def zmq_version() -> str:
    """The version of libzmq."""
    return zmq.zmq_version()


class _ZmqLink:
    """A socket and its context, bound or connected."""

    def __init__(self, kind: int, endpoint: str, *, bind: bool, keys: CurveKeys = NO_KEYS) -> None:
        self._context = zmq.Context()
        self._authenticator: ThreadAuthenticator | None = None
        self._socket: zmq.Socket[bytes] = self._context.socket(kind)
        self._socket.setsockopt(zmq.LINGER, 0)
        try:
            _check_endpoint(endpoint)
            check_reach(endpoint, bind=bind, keys=keys)
            self._configure()
            self._socket.setsockopt(zmq.IPV6, "[" in endpoint)
            self._secure(keys, bind)
            (self._socket.bind if bind else self._socket.connect)(endpoint)
        except zmq.ZMQError as error:
            self.close()
            raise InputError(_endpoint_trouble(endpoint, bind, error)) from error
        except InputError:
            self.close()
            raise
        self.verb = "bound to" if bind else "connected to"
        self.endpoint = self._socket.getsockopt_string(zmq.LAST_ENDPOINT) if bind else endpoint

    def _configure(self) -> None:
        """Set the options that must come before bind or connect."""
        self._socket.setsockopt(zmq.MAXMSGSIZE, LONGEST_MESSAGE_BYTES)
        self._socket.setsockopt(zmq.HEARTBEAT_IVL, HEARTBEAT_MS)
        self._socket.setsockopt(zmq.HEARTBEAT_TIMEOUT, HEARTBEAT_TIMEOUT_MS)
        self._socket.setsockopt(zmq.RECONNECT_IVL_MAX, LONGEST_RECONNECT_MS)

    def _secure(self, keys: CurveKeys, bind: bool) -> None:
        if keys.secret_key is None:
            return
        self._socket.curve_publickey, self._socket.curve_secretkey = load_secret(keys.secret_key)
        if bind and keys.allowed_clients is not None:
            check_allow_list(keys.allowed_clients)
            self._authenticator = ThreadAuthenticator(self._context)
            self._authenticator.start()
            self._authenticator.configure_curve(domain="*", location=keys.allowed_clients)
            self._socket.curve_server = True
        elif keys.server_key is not None:
            self._socket.curve_serverkey = load_public(keys.server_key)

    def close(self) -> None:
        """Close the socket; what it has not sent within its linger time is lost."""
        self._socket.close()
        if self._authenticator is not None:
            self._authenticator.stop()
        self._context.term()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


def _check_endpoint(endpoint: str) -> None:
    """libzmq takes any port modulo 65536."""
    tcp = re.fullmatch(r"tcp://.+:(\*|\d+)", endpoint)
    if not (tcp or re.match(r"(ipc|inproc)://.", endpoint)) or (tcp and tcp[1] != "*" and int(tcp[1]) > 65_535):
        raise InputError(f"{endpoint}: not an endpoint; {ENDPOINT_FORM}")


def _endpoint_trouble(endpoint: str, bind: bool, error: zmq.ZMQError) -> str:
    if error.errno == zmq.EADDRINUSE:
        return f"{endpoint}: the port is in use; stop the program that has it, or choose another port"
    if bind and error.errno in {errno.ENODEV, zmq.EADDRNOTAVAIL}:
        return f"{endpoint}: is no address of this machine, so nothing can bind it; connect (--connect, bind = false) instead"
    verb = "bind" if bind else "connect"
    return f"{endpoint}: cannot {verb} ({zmq.strerror(error.errno or 0)}); {ENDPOINT_FORM}"


class ZmqReceiver(_ZmqLink):
    """A SUB socket that takes every message; it connects, or binds with `bind`."""

    two_way = False
    reconnects = 0

    def __init__(self, endpoint: str, *, bind: bool = False, keys: CurveKeys = NO_KEYS) -> None:
        self._dropped: zmq.Socket[bytes] | None = None
        super().__init__(zmq.SUB, endpoint, bind=bind, keys=keys)
        if not bind:
            self._dropped = self._socket.get_monitor_socket(zmq.EVENT_DISCONNECTED)

    def _configure(self) -> None:
        super()._configure()
        self._socket.setsockopt(zmq.RCVHWM, QUEUE_MESSAGES)
        self._socket.setsockopt(zmq.SUBSCRIBE, b"")

    def receive(self, timeout_ms: int) -> list[Arrival]:
        """Every message that waits, oldest first; only the last part of each is read.

        Waits at most `timeout_ms` for the first, and for no other.
        """
        arrivals: list[Arrival] = []
        self._connect_anew_if_dropped()
        if self._socket.poll(timeout_ms):
            try:
                while len(arrivals) < QUEUE_MESSAGES:
                    message = self._socket.recv_multipart(zmq.NOBLOCK)[-1]
                    arrivals.append(Arrival(time.monotonic_ns(), decode(message), message))
            except zmq.Again:
                pass
        return arrivals

    def wait_for_message(self, timeout_ms: int) -> bool:
        """True once a message waits."""
        return bool(self._socket.poll(timeout_ms))

    def send(self, packet: Packet) -> None:
        """A subscriber has no way back."""

    def wire_ns(self, packet: Packet) -> int:
        """Too little to count."""
        return 0

    def _connect_anew_if_dropped(self) -> None:
        """libzmq itself reconnects after a lost peer, and never after a message over MAXMSGSIZE."""
        if self._dropped is None or not self._dropped.poll(0):
            return
        while self._dropped.poll(0):
            self._dropped.recv_multipart()
        with contextlib.suppress(zmq.ZMQError):  # the ended session may be gone already
            self._socket.disconnect(self.endpoint)
        self._socket.connect(self.endpoint)

    def close(self) -> None:
        """Close the socket and what watches it."""
        if self._dropped is not None:
            self._socket.disable_monitor()
            self._dropped.close(linger=0)
        super().close()


class ZmqLockstep(_ZmqLink):
    """A REP socket: one request is one attitude and gets one reply; it binds, or connects with `bind=False`."""

    def __init__(self, endpoint: str, *, bind: bool = True, keys: CurveKeys = NO_KEYS) -> None:
        super().__init__(zmq.REP, endpoint, bind=bind, keys=keys)
        self._json = False

    def receive(self, timeout_ms: int) -> Arrival | None:
        """The next request, or None; each one has to be answered before the next can come.

        A message without the empty part that ends a request's address is none: libzmq says that one waits, and drops it.
        """
        if not self._socket.poll(timeout_ms):
            return None
        try:
            message = self._socket.recv_multipart(zmq.NOBLOCK)[-1]
        except zmq.Again:
            return None
        self._json = message.lstrip()[:1] == b"{"
        return Arrival(time.monotonic_ns(), decode(message), message)

    def reply(self, status: Status, shown_ns: int, refusal: Refusal | None) -> None:
        """Say what became of the request: a status packet for a packet, an object for JSON."""
        if not self._json:
            self._socket.send(encode(status))
            return
        fields = {name: getattr(status, name) for name in status.__dataclass_fields__}
        trouble = None if refusal is None else {"reason": refusal.reason, "detail": refusal.detail}
        self._socket.send(msgspec.json.encode({**fields, "shown_ns": shown_ns, "refused": trouble}))

    def reply_time(self, reply: TimeReply) -> None:
        """Answer a time request."""
        self._socket.send(encode(reply))


class ZmqSender(_ZmqLink):
    """A publisher that knows when somebody listens (XPUB); it binds, or connects with `bind=False`."""

    LINGER_MS, STOPPED_LINGER_MS = 2000, 200  # for a listener that is slow, without and with a signal

    def __init__(self, endpoint: str, *, bind: bool = True, keys: CurveKeys = NO_KEYS) -> None:
        super().__init__(zmq.XPUB, endpoint, bind=bind, keys=keys)

    def _configure(self) -> None:
        super()._configure()
        self._socket.setsockopt(zmq.LINGER, self.LINGER_MS)
        self._socket.setsockopt(zmq.SNDHWM, SEND_QUEUE_MESSAGES)

    def wait_for_listener(self, timeout_s: float) -> bool:
        """True once a subscriber is there; what is sent before that is lost."""
        if not self._socket.poll(round(timeout_s * 1000)):
            return False
        self._socket.recv()
        return True

    def put(self, message: bytes) -> None:
        """Send one message, never waiting."""
        self._socket.send(message, zmq.NOBLOCK)

    def close(self) -> None:
        """Close the socket; what its listeners do not take within its linger time is lost."""
        if caught() is not None and not self._socket.closed:
            self._socket.setsockopt(zmq.LINGER, self.STOPPED_LINGER_MS)
        super().close()
