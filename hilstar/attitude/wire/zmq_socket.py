"""The ZeroMQ socket under every ZeroMQ link: its context, its keys, its limits against floods, and how it is reopened."""

from __future__ import annotations

import errno
import math
import time
from types import TracebackType
from typing import TYPE_CHECKING, Self

import zmq

from hilstar.attitude.wire.doorkeeper import HANDSHAKE_MS, Doorkeeper
from hilstar.attitude.wire.endpoint import ENDPOINT_FORM, PATH_FORM, check_use, parse_endpoint
from hilstar.attitude.wire.flood_limits import MAX_GROWTH_BYTES, LinkCounts, MemoryWatch, raise_file_limit
from hilstar.attitude.wire.keys import AllowList, CurveKeys, check_reach, load_public, load_secret
from hilstar.attitude.wire.source import PACKETS
from hilstar.errors import InputError
from hilstar.notices import Notices

if TYPE_CHECKING:
    from zmq.auth.thread import ThreadAuthenticator

# At most QUEUE_MESSAGES of a flood wait here; the rest wait at the sender or are lost there. A part over MAX_PART_BYTES drops
# its connection, which is then made anew. Of a message of more than MAX_PARTS the rest is passed over, for other senders' wait
# behind it; one of more than MAX_PASSED_OVER drops every connection. A message that never ends is limited only by the memory
# of the process (flood_limits.MemoryWatch).
QUEUE_MESSAGES = 1000
MAX_PART_BYTES = 1 << 18
MAX_PARTS, MAX_PASSED_OVER = 64, 10_000
# A peer whose cable was pulled says nothing: it is asked, and its connection made anew.
HEARTBEAT_MS = 1000
HEARTBEAT_TIMEOUT_MS = 3000
MAX_RECONNECT_MS = 500
REBIND_S = 2.0  # a port is free again some milliseconds after its socket was closed
BIND_RETRY_S = 0.002


def zmq_version() -> str:
    """The version of libzmq."""
    return zmq.zmq_version()


class ZmqSocket:
    """A socket and its context, bound or connected; reopened after a flood.

    A socket that binds is opened at once, to check that it can be. One that receives a stream is then closed until its first
    read, so that no old messages and no flood collect in it while the display is prepared. One that answers stays open: a
    request that is lost with the first socket would leave its sender waiting for ever.
    """

    conventions = PACKETS
    max_part_bytes = MAX_PART_BYTES

    def __init__(self, kind: int, endpoint: str, *, bind: bool, keys: CurveKeys, notices: Notices | None) -> None:
        self._place = parse_endpoint(endpoint)
        check_reach(self._place, endpoint, bind=bind, keys=keys)
        check_use(self._place, endpoint, bind=bind)
        self.endpoint = endpoint
        self.verb = "bound to" if bind else "connected to"
        self.link_counts = LinkCounts()
        self._notices = Notices() if notices is None else notices
        self._kind, self._bind, self._address = kind, bind, self._place.address
        self._keys = keys
        self._pair = None if keys.secret_key is None else load_secret(keys.secret_key)
        self._server_key = None if bind or keys.server_key is None else load_public(keys.server_key)
        allowed = AllowList(keys.allowed_clients) if bind and keys.allowed_clients is not None else None
        raise_file_limit()
        self._memory = MemoryWatch()
        self._context = zmq.Context()
        self._authenticator: ThreadAuthenticator | None = None
        self._socket: zmq.Socket[bytes] | None = None
        self._keeper: Doorkeeper | None = None
        self._in_use = False
        self._poller = zmq.Poller()
        try:
            if allowed is not None:
                self._authenticate(allowed)
            if bind:
                self._open(0.0)
        except InputError:
            self.close()
            raise

    def opened_as(self) -> tuple[str, bool, CurveKeys]:
        """Endpoint, whether it is bound, and keys: what another process needs to open the same."""
        return self.endpoint, self._bind, self._keys

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
        """Bind, waiting for a previous socket of this process at the same place to close."""
        deadline_s = time.monotonic() + patience_s
        path = self._place.path
        while path is not None and path.exists() and time.monotonic() < deadline_s:
            time.sleep(BIND_RETRY_S)
        check_use(self._place, self.endpoint, bind=True)
        while True:
            try:
                made.bind(self._address)
            except zmq.ZMQError as error:
                if error.errno != zmq.EADDRINUSE or time.monotonic() > deadline_s:
                    raise
                time.sleep(BIND_RETRY_S)
                continue
            self._address = self.endpoint = made.getsockopt_string(zmq.LAST_ENDPOINT)
            return

    def _configure(self, made: zmq.Socket[bytes]) -> None:
        """Set the options that must come before bind or connect."""
        made.setsockopt(zmq.LINGER, 0)
        made.setsockopt(zmq.IPV6, "[" in self._address)
        made.setsockopt(zmq.MAXMSGSIZE, self.max_part_bytes)
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
        """True once a message waits; connections and memory are checked meanwhile."""
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
        if not self._in_use:  # what was prepared until now is not the link's
            self._memory.begin()
            self._in_use = True
        if self._keeper is not None:
            self._keeper.tend()
        if self._memory.grown_bytes() > MAX_GROWTH_BYTES:
            self._reset(f"memory grew by more than {MAX_GROWTH_BYTES / 1e6:.0f} MB, as by a message that never ends")

    def _take(self) -> bytes | None:
        """The last part of the next message; None as for `_take_parts`."""
        parts = self._take_parts()
        return None if parts is None else parts[-1]

    def _take_parts(self) -> list[bytes] | None:
        """The parts of the next message; None where none is complete, or it had more than MAX_PARTS."""
        taken = self._ready()
        try:
            parts = [taken.recv(zmq.NOBLOCK)]
            for _ in range(MAX_PARTS):
                if not taken.getsockopt(zmq.RCVMORE):
                    return parts
                parts.append(taken.recv(zmq.NOBLOCK))
            passed_over = 0 if self._kind == zmq.REP else MAX_PASSED_OVER  # a REP socket that was asked has to answer
            for _ in range(passed_over):
                if not taken.getsockopt(zmq.RCVMORE):
                    self._notices.tell(
                        "long-message", f"{self.endpoint}: a message of more than {MAX_PARTS} parts is passed over"
                    )
                    return None
                taken.recv(zmq.NOBLOCK, copy=False)
        except zmq.Again:
            return None
        self._reset(f"a message of more than {passed_over or MAX_PARTS} parts")
        return None

    def _reset(self, why: str) -> None:
        """Drop every connection, and what libzmq keeps of it."""
        self.link_counts.resets += 1
        self._notices.tell("flood", f"{self.endpoint}: {why}; dropping every connection and reconnecting")
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
        """Close the socket; messages not sent within its linger time are lost."""
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
        return f"{endpoint}: not an address of this machine, so it cannot be bound; connect (--connect, bind = false) instead"
    verb = "bind" if bind else "connect"
    form = PATH_FORM if endpoint.startswith("ipc:") else ENDPOINT_FORM
    return f"{endpoint}: cannot {verb} ({zmq.strerror(error.errno or 0)}); {form}"
