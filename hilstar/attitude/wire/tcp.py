"""TCP: the road that connects to the other side, or listens for the one that connects.

The kernel stamps what comes, and asks a peer that says nothing whether it is still there: a cable
that was pulled ends the connection in seconds.
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

CONNECT_S = 0.3
# between two connections: whoever connects in a loop does not keep a core busy
ACCEPT_EACH_S = 0.02
TOLD_S = 10.0  # for so long after the last one a refused connection stands in the status
KEEPALIVE = {socket.TCP_KEEPIDLE: 3, socket.TCP_KEEPINTVL: 1, socket.TCP_KEEPCNT: 3}


class TcpRoad(ByteRoad):
    """One connection at a time, to a host and port, or `listening` there. Raises InputError where
    that cannot be bound.

    Of several that connect the first holds the line, for as long as it stands, or with `held_s`
    only while it has sent within that; others are refused and named meanwhile. Then the next one
    to connect takes its place: a peer that rebooted behind a line that never closed.
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
        """See `ByteRoad.trouble`: a second connection that was refused."""
        return "" if self._told.over else self._refused

    def taken(self, timeout_ms: int) -> list[RawMessage]:
        """See `ByteRoad.taken`."""
        if self._listener is None and self._connection is None:
            self._try_again(self._connect, (OSError,), timeout_ms)
            return []
        if not self._ends():  # a connection was refused a moment ago
            self._clock.sleep(min(self._accepts.left_s, timeout_ms / 1000))
            return []
        ready = self._ready(timeout_ms)
        # The peer's own bytes first: they hold the line, and its end lets a new connection in.
        if self._connection is not None and self._connection in ready:
            chunks = self._read(self._connection)
        else:
            chunks = []
        if self._listener is not None and self._listener in ready:
            self._accept(self._listener)
        return chunks

    def wait_for_message(self, timeout_ms: int) -> bool:
        """True once bytes wait, or a connection does."""
        return bool(self._ends() and self._ready(timeout_ms))

    def _ends(self) -> list[socket.socket]:
        """The sockets that are looked at now."""
        if self._accepts.over:
            listener = self._listener
        else:
            listener = None
        return [end for end in (listener, self._connection) if end is not None]

    def _ready(self, timeout_ms: int) -> list[socket.socket]:
        """Those of them at which something waits; waits at most `timeout_ms` for the first."""
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
        except OSError:  # it has gone again
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
        """See `ByteRoad.put`; nothing is waited for."""
        with contextlib.suppress(OSError):  # one that is gone is noticed by the next read
            if self._connection is not None:
                return self._connection.send(data) == len(data)
        return False

    def close(self) -> None:
        """Close both sockets."""
        for end in (self._listener, self._connection):
            if end is not None:
                end.close()
        self._listener = self._connection = None


def _endpoint(place: tuple[str, int]) -> str:
    host, port = place
    if ":" in host:
        return f"tcp://[{host}]:{port}"
    return f"tcp://{host}:{port}"
