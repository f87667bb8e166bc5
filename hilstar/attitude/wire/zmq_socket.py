"""The ZeroMQ socket under every ZeroMQ link: its context, its keys, its limits against floods, and
how it is reopened.

libzmq reports connections on a monitor socket and limits nothing: it accepts until the process has
no file descriptors left. `_Doorkeeper` closes connections over MAX_CONNECTIONS at once, the newest
first: the established ones stay. libzmq itself closes a peer that does not finish its handshake
within HANDSHAKE_MS. `_MemoryWatch` bounds what libzmq keeps of a message that never ends.
"""

import contextlib
import ctypes
import errno
import math
import os
import resource
import socket
import struct
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple, TypedDict, Unpack

import zmq

from hilstar.attitude.wire.endpoint import ENDPOINT_FORM, PATH_FORM, check_use, parse_endpoint
from hilstar.attitude.wire.keys import (
    NO_KEYS,
    AllowList,
    CurveKeys,
    check_reach,
    load_public,
    load_secret,
)
from hilstar.attitude.wire.road_use import RoadUse
from hilstar.attitude.wire.roads import ATTITUDES, PAUSE_S, ByteRoad, LinkCounts, RawMessage
from hilstar.attitude.wire.zmq_peer import PeerLook
from hilstar.basics.errors import InputError
from hilstar.basics.notices import Notices
from hilstar.basics.process.scheduling import HOST_CLOCK, HostClock
from hilstar.basics.units import NS_PER_MS

if TYPE_CHECKING:
    from zmq.auth.thread import ThreadAuthenticator

CLIENT_REJECTED = "client-rejected"  # the notice that a connection to a socket that binds was none
WRONG_PEER = "link-rejected"  # the notice that something else than a sender is at the other side
MAX_TAKEN_BYTES = 8_000_000  # in one go
MAX_GROWTH_BYTES = 256_000_000
LOOK_S = 0.01
FREED_WITHIN_S = 2.0
PAGE_BYTES = resource.getpagesize()
WANTED_FILES = 65_536
MAX_CONNECTIONS = 64
MAX_EVENTS = 500  # in one go; more wait in the monitor, and then libzmq waits
FEW_EVENTS = 50  # in one go; after more the link pauses, so that a flood is read at a bounded rate
SENDER = replace(
    ATTITUDES,
    lost_line="lost the connection to the sender; waiting for it",
    back_line="reconnected to the sender",
)
# zmq_socket_monitor(3): event, value; pyzmq's parser of it would bring asyncio
EVENT = struct.Struct("=Hi")
HANDSHAKE_MS = 2000  # peers that never finish it would take up all MAX_CONNECTIONS
LEFT_EARLY = (
    "it left before its handshake, as another type of ZeroMQ socket does,"
    f" or did not finish it within {HANDSHAKE_MS / 1000:g} s"
)
FAILED = {
    zmq.EVENT_HANDSHAKE_FAILED_AUTH: "its key is not among those allowed",
    zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL: "it is another type of ZeroMQ socket, or it has no keys",
    zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL: LEFT_EARLY,
}
HANDSHAKE_NS = HANDSHAKE_MS * NS_PER_MS
EVENTS = (
    zmq.EVENT_ACCEPTED
    | zmq.EVENT_CONNECTED
    | zmq.EVENT_DISCONNECTED
    | zmq.EVENT_HANDSHAKE_SUCCEEDED
    | sum(FAILED)
)
# At most QUEUE_MESSAGES of a flood wait here; the rest wait at the sender or are lost there. A part
# over MAX_PART_BYTES drops its connection, which is then made anew. Of a message of more than
# MAX_PARTS the rest is passed over, for other senders' wait behind it; one of more than
# MAX_PASSED_OVER drops every connection. A message that never ends is limited only by MemoryWatch.
QUEUE_MESSAGES = 1000
MAX_PART_BYTES = 1 << 18
MAX_PARTS, MAX_PASSED_OVER = 64, 10_000
# A peer whose cable was pulled says nothing: it is asked, and its connection made anew.
HEARTBEAT_MS = 1000
HEARTBEAT_TIMEOUT_MS = 3000
MAX_RECONNECT_MS = 500
REBIND_S = 2.0  # a port is free again some milliseconds after its socket was closed
BIND_RETRY_S = 0.002


class _MemoryWatch:
    """Whether this process has grown by more than MAX_GROWTH_BYTES since `begin`.

    libzmq keeps a message until its last part arrives, with no limit on parts, and does not report
    what it keeps: only the memory of the process shows it. Without /proc nothing is watched.
    """

    def __init__(self, clock: HostClock = HOST_CLOCK) -> None:
        self._clock = clock
        self._file = -1
        # kept open: a process out of descriptors must still see its memory
        with contextlib.suppress(OSError):
            self._file = os.open("/proc/self/statm", os.O_RDONLY | os.O_CLOEXEC)
        self._base_bytes = self._used_bytes()
        self._next_look = clock.within(0.0)

    def begin(self) -> None:
        self._base_bytes = self._used_bytes()

    def grown_bytes(self) -> int:
        """The growth since `begin`; looked up at most every LOOK_S, 0 in between."""
        if not self._next_look.over:
            return 0
        self._next_look = self._clock.within(LOOK_S)
        return self._used_bytes() - self._base_bytes

    def await_release(self) -> None:
        """Wait a moment for freed memory to be returned; what remains was not the link's, and
        becomes the new baseline.
        """
        deadline = self._clock.within(FREED_WITHIN_S)
        while (used_bytes := self._used_bytes()) > self._base_bytes + MAX_GROWTH_BYTES / 2:
            if deadline.over:
                self._base_bytes = used_bytes
                return
            self._clock.sleep(LOOK_S)
            # else glibc keeps freed memory, which would count as growth
            with contextlib.suppress(AttributeError, OSError):
                ctypes.CDLL(None).malloc_trim(0)

    def _used_bytes(self) -> int:
        if self._file < 0:
            return 0
        with contextlib.suppress(OSError, ValueError, IndexError):
            return int(os.pread(self._file, 256, 0).split()[1]) * PAGE_BYTES
        return 0

    def close(self) -> None:
        if self._file >= 0:
            os.close(self._file)
        self._file = -1


def _raise_file_limit() -> None:
    """Raise the limit of open files up to WANTED_FILES: each connection needs one, and so do
    ledger and display.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard == resource.RLIM_INFINITY:
        wanted = WANTED_FILES
    else:
        wanted = min(hard, WANTED_FILES)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        with contextlib.suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


class ConnectionsTold(NamedTuple):
    """Who is told that a connection that we made has had its handshake, and why it ended."""

    opened: Callable[[], None]
    lost: Callable[[str], None]


class _Doorkeeper:
    """Reads the monitor of one socket, made before it is bound or connected.

    `lost` says that a connection has ended, and `left` has its file, unless another connection has
    that number by now; the code that acts on them resets them. `place` is the port or path that was
    bound. A connection that ends before its handshake was with no partner: `look` finds out what is
    there, None where we bind.
    """

    def __init__(
        self,
        watched: zmq.Socket[bytes],
        *,
        look: PeerLook | None,
        counts: LinkCounts,
        told: ConnectionsTold,
        notices: Notices,
        clock: HostClock = HOST_CLOCK,
    ) -> None:
        self.lost = False
        self.left: set[int] = set()
        self.place: int | str = ""
        self._watched = watched
        self._look = look
        self._counts = counts
        self._told = told
        self._notices = notices
        self._clock = clock
        self._bound = look is None
        self._greeted = False  # whether the connection that we made had its handshake
        self._open: dict[int, str] = {}  # file descriptor: peer, in the order of arrival
        # Those whose handshake is not known to have ended. libzmq names no peer of one that
        # succeeded: the oldest is taken.
        self._ungreeted: dict[int, int] = {}  # file descriptor: when it was accepted, host ns
        self._shut: set[int] = set()
        self._failure = ""
        self.monitor = watched.get_monitor_socket(EVENTS)

    def is_open(self, file: int) -> bool:
        """Whether a connection has this file, by the events so far."""
        if file not in self._open:
            self.tend()
        return file in self._open

    def tend(self) -> None:
        events = 0
        with contextlib.suppress(zmq.ZMQError):
            while events < MAX_EVENTS:
                what, _peer_endpoint = self.monitor.recv_multipart(zmq.NOBLOCK)
                self._take(*EVENT.unpack(what))
                events += 1
        if self._bound and len(self._open) > MAX_CONNECTIONS:
            self._shut_newest()
        self._tell_look()
        if events > FEW_EVENTS:
            self._clock.sleep(PAUSE_S)

    def _take(self, event: int, value: int) -> None:
        if event == zmq.EVENT_ACCEPTED:
            self._counts.connections += 1
            self._open.pop(value, None)
            self._open[value] = ""
            self._ungreeted[value] = self._clock.now_ns()
            self.left.discard(value)
            with _connection(value) as connection:
                if connection is None:
                    name = ()
                else:
                    name = connection.getpeername()
                self._open[value] = (
                    f"{name[0]}:{name[1]}" if isinstance(name, tuple) and len(name) > 1 else ""
                )
        elif event == zmq.EVENT_DISCONNECTED:
            self._leave(value)
        elif event == zmq.EVENT_HANDSHAKE_SUCCEEDED and self._bound:
            self._ungreeted.pop(next(iter(self._ungreeted), -1), None)
        elif event == zmq.EVENT_HANDSHAKE_SUCCEEDED:
            self._greeted = True
            self._counts.connections += 1
            self._told.opened()
        elif event in FAILED:
            self._failure = FAILED[zmq.Event(event)]

    def _leave(self, file: int) -> None:
        self.lost = True
        if self._bound:
            self.left.add(file)
        who = self._open.pop(file, "")
        failure = self._failure
        greeted = self._greeted
        self._failure = ""
        self._greeted = False
        accepted_ns = self._ungreeted.pop(file, None)
        if (
            accepted_ns is not None
            and not failure
            and self._clock.now_ns() - accepted_ns < HANDSHAKE_NS
        ):
            failure = LEFT_EARLY
        if file in self._shut:
            self._shut.remove(file)
        elif failure and self._bound:
            self._counts.rejected += 1
            self._notices.tell(
                CLIENT_REJECTED,
                f"a connection from {who or 'an unknown peer'} was rejected: {failure}",
            )
        elif self._look is None:
            pass
        elif failure or not greeted:
            self._counts.rejected += 1
            self._look.begin()
        else:
            self._told.lost("the other side closed it")

    def _tell_look(self) -> None:
        trouble = "" if self._look is None else self._look.take()
        if trouble:
            self._notices.tell(WRONG_PEER, trouble)

    def _shut_newest(self) -> None:
        newest = [file for file in list(self._open)[MAX_CONNECTIONS:] if file not in self._shut]
        if not newest:
            return
        if not self._shut:
            who = self._open[newest[0]] or "an unknown peer"
            self._notices.tell(
                "connections-refused",
                f"over {MAX_CONNECTIONS} connections at once; closing further ones, from {who}",
            )
        for file in newest:
            self._counts.refused += 1
            self._shut.add(file)
            with _connection(file) as connection:
                if connection is not None:
                    # the descriptor may have been reused for another file
                    name = connection.getsockname()
                    if (name[1] if isinstance(name, tuple) else name) == self.place:
                        connection.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Stop watching; before its socket is closed."""
        self.tend()  # libzmq blocks on a full monitor, and would block for ever on a closed one
        with contextlib.suppress(zmq.ZMQError):
            self._watched.disable_monitor()
        self.monitor.close(linger=0)


@contextlib.contextmanager
def _connection(file: int) -> Iterator[socket.socket | None]:
    """libzmq's own connection for a moment, through a duplicate of its descriptor; None where it
    is gone.
    """
    try:
        connection = socket.socket(fileno=os.dup(file))
    except OSError:
        yield None
        return
    with connection, contextlib.suppress(OSError):
        yield connection


def zmq_version() -> str:
    """The version of libzmq."""
    return zmq.zmq_version()


class SocketOptions(TypedDict, total=False):
    """How a socket is opened: whether it binds, whose keys it has, who hears of it, its largest
    part, the clock, and what it is for.
    """

    bind: bool
    keys: CurveKeys
    notices: Notices | None
    max_part_bytes: int
    clock: HostClock
    use: RoadUse


class ZmqSocket(ByteRoad):
    """A socket and its context, bound or connected; reopened after a flood.

    Only what it connects to is lost and comes back: to one that binds, any number connect.

    A socket that binds is opened at once, to check that it can be. One that receives a stream is
    then closed until its first read, so that no old messages and no flood collect in it while the
    display is prepared. One that answers stays open: a request that is lost with the first socket
    would leave its sender waiting for ever.
    """

    messages = True

    def __init__(self, kind: int, endpoint: str, **options: Unpack[SocketOptions]) -> None:
        clock = options.get("clock", HOST_CLOCK)
        super().__init__(endpoint, options.get("use", SENDER), options.get("notices"), clock)
        self._max_part_bytes = options.get("max_part_bytes", MAX_PART_BYTES)
        bind = options.get("bind", False)
        keys = options.get("keys", NO_KEYS)
        self._place = parse_endpoint(endpoint)
        check_reach(self._place, endpoint, bind=bind, keys=keys)
        check_use(self._place, endpoint, bind=bind)
        self.verb = "bound to" if bind else "connected to"
        self._kind, self._bind, self._address = kind, bind, self._place.address
        self._keys = keys
        self._pair = None if keys.secret_key is None else load_secret(keys.secret_key)
        self._server_key = None if bind or keys.server_key is None else load_public(keys.server_key)
        if bind and keys.allowed_clients is not None:
            allowed = AllowList(keys.allowed_clients)
        else:
            allowed = None
        _raise_file_limit()
        self._memory = _MemoryWatch(self._clock)
        self._context = zmq.Context()
        self._authenticator: ThreadAuthenticator | None = None
        self._socket: zmq.Socket[bytes] | None = None
        self._keeper: _Doorkeeper | None = None
        self._in_use = False
        self._poller = zmq.Poller()
        try:
            if allowed is not None:
                from zmq.auth import thread  # brings asyncio

                self._authenticator = thread.ThreadAuthenticator(self._context)
                self._authenticator.start()
                self._authenticator.configure_curve_callback("*", allowed)
            if bind:
                self._open(0.0)
        except InputError:
            self.close()
            raise

    def _open(self, patience_s: float = REBIND_S) -> zmq.Socket[bytes]:
        made: zmq.Socket[bytes] = self._context.socket(self._kind)
        self._configure(made)
        self._socket = made
        kind = zmq.SocketType(self._kind).name
        if self._bind:
            look = None
        else:
            look = PeerLook(self._address, kind, keys=self._pair is not None)
        self._keeper = _Doorkeeper(
            made,
            look=look,
            counts=self.link_counts,
            told=ConnectionsTold(self._opened, self._lose),
            notices=self._notices,
            clock=self._clock,
        )
        self._poller = zmq.Poller()
        self._poller.register(made, zmq.POLLIN)
        self._poller.register(self._keeper.monitor, zmq.POLLIN)
        try:
            if self._bind:
                self._bind_within(made, patience_s)
                self._keeper.place = str(self._place.path or "") or int(
                    self._address.rpartition(":")[2]
                )
            else:
                made.connect(self._address)
        except zmq.ZMQError as error:
            raise InputError(_endpoint_trouble(self.endpoint, self._bind, error)) from error
        return made

    def _bind_within(self, made: zmq.Socket[bytes], patience_s: float) -> None:
        """Bind, waiting for a previous socket of this process at the same place to close."""
        deadline = self._clock.within(patience_s)
        path = self._place.path
        while path is not None and path.exists() and not deadline.over:
            self._clock.sleep(BIND_RETRY_S)
        check_use(self._place, self.endpoint, bind=True)
        while True:
            try:
                made.bind(self._address)
            except zmq.ZMQError as error:
                if error.errno != zmq.EADDRINUSE or deadline.over:
                    raise
                self._clock.sleep(BIND_RETRY_S)
                continue
            self._address = self.endpoint = made.getsockopt_string(zmq.LAST_ENDPOINT)
            return

    def _configure(self, made: zmq.Socket[bytes]) -> None:
        made.setsockopt(zmq.LINGER, 0)
        made.setsockopt(zmq.IPV6, "[" in self._address)
        made.setsockopt(zmq.MAXMSGSIZE, self._max_part_bytes)
        made.setsockopt(zmq.RCVHWM, QUEUE_MESSAGES)
        made.setsockopt(zmq.HANDSHAKE_IVL, HANDSHAKE_MS)
        made.setsockopt(zmq.HEARTBEAT_IVL, HEARTBEAT_MS)
        made.setsockopt(zmq.HEARTBEAT_TIMEOUT, HEARTBEAT_TIMEOUT_MS)
        made.setsockopt(zmq.RECONNECT_IVL_MAX, MAX_RECONNECT_MS)
        if self._pair is not None:
            made.curve_publickey, made.curve_secretkey = self._pair
            if self._server_key is None:
                made.curve_server = True
            else:
                made.curve_serverkey = self._server_key

    def _ready(self) -> zmq.Socket[bytes]:
        if self._socket is None:
            self._memory.begin()
            return self._open()
        return self._socket

    @property
    def bound(self) -> bool:
        """Whether others connect to it."""
        return self._bind

    @property
    def trouble(self) -> str:
        """See `ByteRoad.trouble`: what is there in the place of a partner."""
        return trouble_of(self.link_counts, self._notices)

    def _opened(self) -> None:
        super()._opened()
        if self.openings == 1:
            self._notices.mention("connected", "connected to the sender")

    def taken(self, timeout_ms: int) -> list[RawMessage]:
        """The waiting messages, oldest first; see `ByteRoad.taken`."""
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
        return waiting

    def wait_for_message(self, timeout_ms: int) -> bool:
        """True once a message waits."""
        return self._waits(timeout_ms)

    def _waits(self, timeout_ms: float) -> bool:
        """True once a message waits; connections and memory are checked meanwhile."""
        deadline = self._clock.within(timeout_ms / 1000)
        while True:
            self._tend()
            ready = dict(self._poller.poll(math.ceil(deadline.left_s * 1000)))
            if self._socket in ready:
                return True
            if deadline.over:
                return False

    def _tend(self) -> None:
        self._ready()
        if not self._in_use:  # what was prepared until now is not the link's
            self._memory.begin()
            self._in_use = True
        if self._keeper is not None:
            self._keeper.tend()
        if self._memory.grown_bytes() > MAX_GROWTH_BYTES:
            self._reset(
                f"memory grew by more than {MAX_GROWTH_BYTES / 1e6:.0f} MB, as by a message that"
                " never ends"
            )

    def _take(self) -> bytes | None:
        parts = self._take_parts()
        return None if parts is None else parts[-1]

    def _take_parts(self) -> list[bytes] | None:
        """The parts of the next message; None where none is complete, or it had more than
        MAX_PARTS.
        """
        taken = self._ready()
        try:
            parts = [taken.recv(zmq.NOBLOCK)]
            for _ in range(MAX_PARTS):
                if not taken.getsockopt(zmq.RCVMORE):
                    return parts
                parts.append(taken.recv(zmq.NOBLOCK))
            # a REP socket that was asked has to answer
            if self._kind == zmq.REP:
                passed_over = 0
            else:
                passed_over = MAX_PASSED_OVER
            for _ in range(passed_over):
                if not taken.getsockopt(zmq.RCVMORE):
                    self._notices.tell(
                        "long-message",
                        f"{self.endpoint}: a message of more than {MAX_PARTS} parts is passed over",
                    )
                    return None
                taken.recv(zmq.NOBLOCK, copy=False)
        except zmq.Again:
            return None
        self._reset(f"a message of more than {passed_over or MAX_PARTS} parts")
        return None

    def _put(self, parts: list[bytes]) -> bool:
        """Send one message, never waiting; False where no peer takes it."""
        with contextlib.suppress(zmq.Again):
            self._ready().send_multipart(parts, zmq.NOBLOCK)
            return True
        return False

    def _reset(self, why: str) -> None:
        """Drop every connection, and what libzmq keeps of it."""
        self.link_counts.resets += 1
        self._shut()
        self._memory.await_release()
        try:
            self._open()
        finally:
            # Told once the old socket takes nobody: a request of who connects by this line would be
            # lost with it, and never answered.
            self._notices.tell(
                "flood", f"{self.endpoint}: {why}; dropping every connection and reconnecting"
            )

    def _shut(self, linger_ms: int = 0) -> None:
        if self._keeper is not None:
            self._keeper.close()
        if self._socket is not None:
            self._socket.close(linger=linger_ms)
        self._keeper = self._socket = None

    def close(self) -> None:
        """Close the socket."""
        self._shut()
        if self._authenticator is not None:
            self._authenticator.stop()
        self._context.term()
        self._memory.close()


class ZmqReply(ZmqSocket):
    """A REP socket: each request gets one reply before the next can arrive; it binds, or connects
    with `bind=False`.
    """

    def __init__(self, endpoint: str, **options: Unpack[SocketOptions]) -> None:
        options.setdefault("bind", True)
        super().__init__(zmq.REP, endpoint, **options)

    def request(self, timeout_ms: int) -> RawMessage | None:
        """The next request, or None; waits at most `timeout_ms`.

        libzmq announces a request without its delimiter, then drops it: none is waited for.
        """
        parts = self._take_parts() if self._waits(timeout_ms) else None
        return None if parts is None else RawMessage(self._clock.now_ns(), parts)

    def put(self, data: bytes, patience_s: float = 0.0) -> bool:
        """Reply; a peer that is gone, or does not read, gets none."""
        return self._put([data])

    def put_parts(self, parts: list[bytes]) -> bool:
        """Reply with a message of several parts."""
        return self._put(parts)


def trouble_of(counts: LinkCounts, notices: Notices) -> str:
    """Why a socket of these counts gives no messages, as far as its notices say; "" where they do
    not.
    """
    wrong_peer = notices.latest(WRONG_PEER)
    if wrong_peer:
        return "" if counts.connections else wrong_peer
    # who binds counts connections from their begin on, so also those that it then rejects
    is_alone = counts.connections <= counts.rejected
    if is_alone:
        return notices.latest(CLIENT_REJECTED)
    return ""


def _endpoint_trouble(endpoint: str, bind: bool, error: zmq.ZMQError) -> str:
    if error.errno == zmq.EADDRINUSE:
        return (
            f"{endpoint}: the port is in use; stop the program that has it, or choose another port"
        )
    if bind and error.errno in {errno.ENODEV, zmq.EADDRNOTAVAIL}:
        return (
            f"{endpoint}: not an address of this machine, so it cannot be bound; connect"
            " (--connect, bind = false) instead"
        )
    verb = "bind" if bind else "connect"
    if endpoint.startswith("ipc:"):
        form = PATH_FORM
    else:
        form = ENDPOINT_FORM
    return f"{endpoint}: cannot {verb} ({zmq.strerror(error.errno or 0)}); {form}"
