"""The sockets that attitudes come and go through: ZeroMQ."""

from __future__ import annotations

import contextlib
import re
import time
from types import TracebackType
from typing import Self

import zmq

from hilstar.errors import InputError

# A flood is held here, not in memory without end; a longer message drops its connection, which is then made anew.
QUEUE_MESSAGES = 10_000
LONGEST_MESSAGE_BYTES = 1 << 20
ENDPOINT_FORM = "write tcp://HOST:PORT, such as tcp://127.0.0.1:5560"


class _ZmqLink:
    """A socket and its context, bound or connected."""

    def __init__(self, kind: int, endpoint: str, *, bind: bool) -> None:
        self._context = zmq.Context()
        self._socket: zmq.Socket[bytes] = self._context.socket(kind)
        self._socket.setsockopt(zmq.LINGER, 0)
        try:
            _check_endpoint(endpoint)
            self._configure()
            (self._socket.bind if bind else self._socket.connect)(endpoint)
        except zmq.ZMQError as error:
            self.close()
            raise InputError(_endpoint_trouble(endpoint, bind, error)) from error
        except InputError:
            self.close()
            raise
        self.endpoint = self._socket.getsockopt_string(zmq.LAST_ENDPOINT) if bind else endpoint

    def _configure(self) -> None:
        """Set the options that must come before bind or connect."""

    def close(self) -> None:
        """Close the socket; what it has not sent within its linger time is lost."""
        self._socket.close()
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
    verb = "bind" if bind else "connect"
    if error.errno == zmq.EADDRINUSE:
        return f"{endpoint}: the port is in use; stop the program that has it, or choose another port"
    return f"{endpoint}: cannot {verb} ({zmq.strerror(error.errno or 0)}); {ENDPOINT_FORM}"


class ZmqReceiver(_ZmqLink):
    """A SUB socket that takes every message; it connects, or binds with `bind`."""

    def __init__(self, endpoint: str, *, bind: bool = False) -> None:
        self._dropped: zmq.Socket[bytes] | None = None
        super().__init__(zmq.SUB, endpoint, bind=bind)
        if not bind:
            self._dropped = self._socket.get_monitor_socket(zmq.EVENT_DISCONNECTED)

    def _configure(self) -> None:
        self._socket.setsockopt(zmq.RCVHWM, QUEUE_MESSAGES)
        self._socket.setsockopt(zmq.MAXMSGSIZE, LONGEST_MESSAGE_BYTES)
        self._socket.setsockopt(zmq.SUBSCRIBE, b"")

    def receive(self, timeout_ms: int) -> list[tuple[int, bytes]]:
        """Every message that waits, oldest first, as (host time of arrival in ns, last part).

        Waits at most `timeout_ms` for the first, and for no other.
        """
        messages: list[tuple[int, bytes]] = []
        self._connect_anew_if_dropped()
        if self._socket.poll(timeout_ms):
            try:
                while len(messages) < QUEUE_MESSAGES:
                    message = self._socket.recv_multipart(zmq.NOBLOCK)[-1]
                    messages.append((time.monotonic_ns(), message))
            except zmq.Again:
                pass
        return messages

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

    def wait_for_message(self, timeout_ms: int) -> bool:
        """True once a message waits."""
        return bool(self._socket.poll(timeout_ms))


class ZmqSender(_ZmqLink):
    """A publisher that knows when somebody listens (XPUB); it binds, or connects with `bind=False`."""

    LINGER_MS = 2000

    def __init__(self, endpoint: str, *, bind: bool = True) -> None:
        super().__init__(zmq.XPUB, endpoint, bind=bind)

    def _configure(self) -> None:
        self._socket.setsockopt(zmq.LINGER, self.LINGER_MS)
        self._socket.setsockopt(zmq.SNDHWM, QUEUE_MESSAGES)

    def wait_for_listener(self, timeout_s: float) -> bool:
        """True once a subscriber is there; what is sent before that is lost."""
        if not self._socket.poll(round(timeout_s * 1000)):
            return False
        self._socket.recv()
        return True

    def send(self, message: bytes) -> None:
        """Send one message, never waiting."""
        self._socket.send(message, zmq.NOBLOCK)
