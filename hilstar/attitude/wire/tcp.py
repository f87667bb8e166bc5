"""TCP: a road of bytes that connects to a host and port, or listens there for a peer to connect.

The kernel stamps the arrival of the bytes. It also probes a silent peer (keep-alive), so that a
connection whose cable was pulled ends within seconds.
"""

import contextlib
import select
import socket

from hilstar.attitude.wire.endpoint import AllowedSenders
from hilstar.attitude.wire.kernel_stamps import ANCILLARY_BYTES, KernelStamps
from hilstar.attitude.wire.road_use import RoadUse
from hilstar.attitude.wire.roads import ATTITUDES, MAX_READ_BYTES, ByteRoad, RawMessage
from hilstar.basics.errors import InputError
from hilstar.basics.notices import Notices
from hilstar.basics.process.scheduling import HOST_CLOCK, HostClock

CONNECT_S = 0.3  # the longest that a read may wait for a handshake (law 4 of `roads`)
# between two connections: a peer that connects in a loop does not keep a core busy
ACCEPT_EACH_S = 0.02
TOLD_S = 10.0  # how long the status shows a refused connection
# Probes begin after 3 s of silence, 1 s apart; after three without an answer, at about 6 s, the
# kernel ends the connection.
KEEPALIVE = {socket.TCP_KEEPIDLE: 3, socket.TCP_KEEPINTVL: 1, socket.TCP_KEEPCNT: 3}


class TcpRoad(ByteRoad):
    """One TCP connection at a time: to `place` (host, port), or, where `listening`, from a peer
    that connects to `place`. Raises InputError where `place` cannot be bound.

    The first peer that connects holds the line until its connection ends. With `held_s` it holds
    the line only while its last bytes are at most `held_s` seconds old. Other peers are refused
    and named in a notice meanwhile. After that the next peer that connects takes its place: a peer
    that has rebooted gets in, although its old connection was never closed.
    """

    stamped = True

    def __init__(
        self,
        place: tuple[str, int],
        allowed: AllowedSenders,
        use: RoadUse = ATTITUDES,
        notices: Notices | None = None,
        clock: HostClock = HOST_CLOCK,
        *,
        listening: bool,
        held_s: float | None = None,
    ) -> None:
        super().__init__(_endpoint(place), use, notices, clock)
        self._place = place
        self._allowed = allowed
        self._held_s = held_s
        self._listener: socket.socket | None = None
        self._connection: socket.socket | None = None
        self._peer = ""
        self._refused = ""
        self._holds = clock.within(0.0)
        self._told = clock.within(0.0)
        self._accepts = clock.within(0.0)
        self.verb = "bound to" if listening else "connecting to"
        if listening:
            self._listener = self._listen()
            self.endpoint = _endpoint((place[0], self._listener.getsockname()[1]))

    def _listen(self) -> socket.socket:
        family = socket.AF_INET6 if ":" in self._place[0] else socket.AF_INET
        try:
            made = socket.create_server(self._place, family=family)
        except OSError as error:
            raise InputError(
                f"{self._use.where}{self.endpoint}: cannot bind ({error.strerror}); write an"
                " address of this machine and a free port"
            ) from error
        made.setblocking(False)
        return made

    @property
    def trouble(self) -> str:
        """The line about a second connection that was refused within the last TOLD_S; else ""."""
        return "" if self._told.over else self._refused

    def taken(self, timeout_ms: int) -> list[RawMessage]:
        """See `ByteRoad.taken`."""
        if self._listener is None and self._connection is None:
            self._try_again(self._connect, (OSError,), timeout_ms)
            return []
        # A connection was accepted or refused less than ACCEPT_EACH_S ago, and none stands.
        if not self._ends():
            self._clock.sleep(min(self._accepts.left_s, timeout_ms / 1000))
            return []
        ready = self._ready(timeout_ms)
        # The peer's bytes are read first: they renew its hold on the line, and where the read
        # shows that it has ended, a new connection can be accepted at once.
        if self._connection is not None and self._connection in ready:
            chunks = self._read(self._connection)
        else:
            chunks = []
        if self._listener is not None and self._listener in ready:
            self._accept(self._listener)
        return chunks

    def wait_for_message(self, timeout_ms: int) -> bool:
        """True once bytes or a new connection wait, False after `timeout_ms` without either."""
        return bool(self._ends() and self._ready(timeout_ms))

    def _ends(self) -> list[socket.socket]:
        """The open sockets to poll now: the listener only where ACCEPT_EACH_S is over."""
        if self._accepts.over:
            listener = self._listener
        else:
            listener = None
        return [end for end in (listener, self._connection) if end is not None]

    def _ready(self, timeout_ms: int) -> list[socket.socket]:
        """The sockets of `_ends` with something to read; waits at most `timeout_ms` for it."""
        ends = {end.fileno(): end for end in self._ends()}
        poll = select.poll()
        for file in ends:
            poll.register(file, select.POLLIN)
        asked_ns = self._clock.now_ns()
        ready = [ends[file] for file, _ in poll.poll(timeout_ms)]
        if self._connection is not None and self._connection not in ready:
            self._stamps.empty_ns = asked_ns
        return ready

    def _read(self, connection: socket.socket) -> list[RawMessage]:
        try:
            data, ancillary, _, _ = connection.recvmsg(MAX_READ_BYTES, ANCILLARY_BYTES)
        except BlockingIOError:
            return []
        except OSError as error:
            self._shut(error.strerror or str(error))
            return []
        if not data:
            self._shut("the other side closed it")
            return []
        self._hold()
        host_ns = self._stamps.arrived_ns(ancillary, self._clock.now_ns())
        return [RawMessage(host_ns, [data], self._stamps.empty_ns)]

    def _connect(self) -> None:
        self._take(socket.create_connection(self._place, CONNECT_S), self.endpoint)

    def _accept(self, listener: socket.socket) -> None:
        try:
            made, (host, port, *_) = listener.accept()
        except OSError:  # the peer has already ended the connection
            return
        self._accepts = self._clock.within(ACCEPT_EACH_S)
        peer = f"{host}:{port}"
        if not self._allowed.admits(host):
            self.link_counts.rejected += 1
            self._notices.begin(
                "sender-not-allowed",
                f"a connection from {host} is refused: it is not in {self._use.table} allow",
            )
            made.close()
            return
        if self._is_held:
            self.link_counts.refused += 1
            self._refused = self._use.second_line.format(peer=peer, host=host, holder=self._peer)
            self._told = self._clock.within(TOLD_S)
            self._notices.tell(self._use.second, f"{self.endpoint}: {self._refused}")
            made.close()
            return
        if self._connection is not None:
            held_s = self._held_s or 0.0
            self._shut(f"{self._peer} has sent nothing for {held_s:g} s, and {peer} connects")
        self._take(made, peer)

    @property
    def _is_held(self) -> bool:
        return self._connection is not None and (self._held_s is None or not self._holds.over)

    def _hold(self) -> None:
        self._holds = self._clock.within(self._held_s or 0.0)

    def _take(self, made: socket.socket, peer: str) -> None:
        made.setblocking(False)
        made.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        made.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for option, value in KEEPALIVE.items():
            made.setsockopt(socket.IPPROTO_TCP, option, value)
        self._peer, self._refused = peer, ""
        self._connection, self._stamps = made, KernelStamps(made, self._clock)
        self._hold()
        self.link_counts.connections += 1
        self._opened()

    def _shut(self, why: str) -> None:
        connection = self._connection
        self._connection = None
        if connection is not None:
            self._lose(why)
            connection.close()

    def put(self, data: bytes, patience_s: float = 0.0) -> bool:
        """See `ByteRoad.put`; it never waits, so `patience_s` has no effect."""
        with contextlib.suppress(OSError):  # the next read notices that the connection has ended
            if self._connection is not None:
                return self._connection.send(data) == len(data)
        return False

    def close(self) -> None:
        """Close the listener and the connection."""
        for end in (self._listener, self._connection):
            if end is not None:
                end.close()
        self._listener = self._connection = None


def _endpoint(place: tuple[str, int]) -> str:
    host, port = place
    if ":" in host:
        return f"tcp://[{host}]:{port}"
    return f"tcp://{host}:{port}"
