"""Bytes as they come: serial lines, UDP, TCP, ZeroMQ and growing files, each reopened where it is
lost; what asks is sent.

For the process that reads a tracker's answers (see `hilstar.server.answers.reader`). What comes is
not looked at here.
"""

import contextlib
import errno
import os
import select
import socket
import stat
from abc import abstractmethod
from pathlib import Path

import serial

from hilstar.attitude.wire.endpoint import AllowedSenders, UdpPlace
from hilstar.attitude.wire.links import LinkCounts, RawMessage
from hilstar.attitude.wire.serial_link import LOST, open_port, opening_refusal
from hilstar.attitude.wire.udp import Datagrams
from hilstar.attitude.wire.zmq_links import ZmqReceiver
from hilstar.basics.errors import InputError, one_line
from hilstar.basics.notices import Notices
from hilstar.basics.process.closing import Closing
from hilstar.basics.process.scheduling import HOST_CLOCK, BackOff, HostClock

MAX_READ_BYTES = 65_536
MAX_DATAGRAMS = 200
MIN_BACK_OFF_S, MAX_BACK_OFF_S = 0.05, 0.5
CONNECT_S = 0.5
FILE_LOOK_S = 0.005
HELD_S = 3.0  # for so long after its last byte a tracker's connection holds the line
# between two connections: whoever connects in a loop does not keep a core busy
ACCEPT_EACH_S = 0.02
TOLD_S = 10.0  # for so long after the last one a refused connection stands in the status
Place = tuple[str, int]
KINDS = {
    stat.S_IFDIR: "a directory",
    stat.S_IFIFO: "a FIFO",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFSOCK: "a socket",
}


class ByteLink(Closing):
    """A road by which bytes come; `messages` says that each chunk is whole by itself. Losing the
    other side raises nothing.
    """

    messages = False

    def __init__(self, endpoint: str, notices: Notices, clock: HostClock = HOST_CLOCK) -> None:
        self.endpoint = endpoint
        self.link_counts = LinkCounts()
        self._notices = notices
        self._clock = clock
        self._retry = BackOff(MIN_BACK_OFF_S, MAX_BACK_OFF_S, clock)

    def trouble(self) -> str:
        """What is wrong with the line for as long as it lasts, "" while nothing is."""
        return ""

    @abstractmethod
    def taken(self, timeout_ms: int) -> list[RawMessage]:
        """What has come, in order; waits at most `timeout_ms`."""

    def put(self, data: bytes) -> None:
        """Send to the other side, never waiting; lost where nobody is there."""

    def _lose(self, why: str) -> None:
        self.link_counts.lost += 1
        self._notices.tell(
            "answers-lost",
            f"{self.endpoint}: the tracker's line is lost ({one_line(why)}); waiting for it",
        )
        self._retry.put_off(anew=True)

    def _opened(self) -> None:
        self.link_counts.connections += 1
        if self.link_counts.connections > 1:
            self._notices.tell("answers-back", f"{self.endpoint}: the tracker's line is back")

    def _rest(self, timeout_ms: int) -> list[RawMessage]:
        self._clock.sleep(min(self._retry.left_s, timeout_ms / 1000))
        return []

    def _chunk(self, data: bytes) -> list[RawMessage]:
        return [RawMessage(self._clock.now_ns(), [data])]

    def close(self) -> None:
        """Close it."""


class SerialBytes(ByteLink):
    """A serial port. Raises InputError where it cannot be opened at the start."""

    def __init__(
        self, port: str, baud: int, notices: Notices, clock: HostClock = HOST_CLOCK
    ) -> None:
        super().__init__(f"serial:{port}@{baud}", notices, clock)
        self._port = port
        self._baud = baud
        try:
            self._device: serial.Serial | None = self._open()
        except (OSError, ValueError, OverflowError) as error:
            raise opening_refusal(f"[answers] {self.endpoint}", error, port) from error

    def _open(self) -> serial.Serial:
        device = open_port(self._port, self._baud)
        self._opened()
        return device

    def taken(self, timeout_ms: int) -> list[RawMessage]:
        """See `ByteLink.taken`."""
        try:
            if self._device is None:
                if not self._retry.over:
                    return self._rest(timeout_ms)
                self._device = self._open()
            if not select.select([self._device.fileno()], [], [], timeout_ms / 1000)[0]:
                return []
            data = os.read(self._device.fileno(), MAX_READ_BYTES)
            if not data:
                raise OSError(errno.EIO, "it was readable, and nothing came")
            return self._chunk(data)
        except BlockingIOError:
            return []
        except LOST as error:
            if self._device is None:
                self._retry.put_off()
            else:
                self._lose(str(getattr(error, "strerror", None) or error))
                self.close()
            return []

    def put(self, data: bytes) -> None:
        """See `ByteLink.put`."""
        with contextlib.suppress(*LOST):
            if self._device is not None:
                os.write(self._device.fileno(), data)

    def close(self) -> None:
        """Close the port."""
        device = self._device
        self._device = None
        if device is not None:
            with contextlib.suppress(*LOST):
                device.close()


class UdpBytes(ByteLink):
    """UDP: bound to a place, with the senders that are allowed, or connected to a tracker that
    is asked. Raises InputError.
    """

    messages = True

    def __init__(
        self,
        place: UdpPlace | Place,
        allowed: AllowedSenders,
        notices: Notices,
        clock: HostClock = HOST_CLOCK,
    ) -> None:
        super().__init__(
            str(place) if isinstance(place, UdpPlace) else f"udp://{place[0]}:{place[1]}",
            notices,
            clock,
        )
        self._allowed = allowed if isinstance(place, UdpPlace) else None
        try:
            self._datagrams = (
                Datagrams.bound(place, clock)
                if isinstance(place, UdpPlace)
                else Datagrams.connected(*place)
            )
        except OSError as error:
            raise InputError(
                f"[answers] {self.endpoint}: {error.strerror}; write the tracker's address"
            ) from error
        except InputError as error:
            raise InputError(f"[answers] {error}") from error

    def taken(self, timeout_ms: int) -> list[RawMessage]:
        """See `ByteLink.taken`."""
        if not self._datagrams.wait(timeout_ms):
            return []
        chunks = []
        for datagram in self._datagrams.take(MAX_DATAGRAMS):
            host = (datagram.sender or ("",))[0]
            if self._allowed is None or self._allowed.admits(host):
                chunks.append(datagram)
                continue
            self.link_counts.rejected += 1
            notice = (
                f"datagrams from {host} are dropped: it is not in [answers] allow; further ones are"
                " only counted"
            )
            self._notices.begin("sender-not-allowed", notice)
        return chunks

    def put(self, data: bytes) -> None:
        """See `ByteLink.put`."""
        if self._allowed is None:
            self._datagrams.put(data)

    def close(self) -> None:
        """Close the socket."""
        self._datagrams.close()


class TcpBytes(ByteLink):
    """TCP: connects to a tracker, or listens for the one that connects. Raises InputError.

    Of several that connect the first holds the line while it has sent within HELD_S; others are
    refused and named meanwhile. Then the next one to connect takes its place: a tracker that
    rebooted behind a line that never closed.
    """

    def __init__(
        self,
        place: UdpPlace | Place,
        allowed: AllowedSenders,
        notices: Notices,
        clock: HostClock = HOST_CLOCK,
    ) -> None:
        host, port = (str(place.host), place.port) if isinstance(place, UdpPlace) else place
        super().__init__(f"tcp://{f'[{host}]' if ':' in host else host}:{port}", notices, clock)
        self._place = (host, port)
        self._allowed = allowed
        self._listener = self._connection = None
        self._peer = ""
        self._refused = ""
        self._holds = clock.within(0.0)
        self._told = clock.within(0.0)
        self._accepts = clock.within(0.0)
        if isinstance(place, UdpPlace):
            try:
                if place.host.version == 6:
                    family = socket.AF_INET6
                else:
                    family = socket.AF_INET
                self._listener = socket.create_server((host, port), family=family)
            except OSError as error:
                refusal = (
                    f"cannot listen ({error.strerror}); write an address of this machine and a free"
                    " port"
                )
                raise InputError(f"[answers] listen: {self.endpoint}: {refusal}") from error
            self._listener.setblocking(False)

    _listener: socket.socket | None
    _connection: socket.socket | None

    def taken(self, timeout_ms: int) -> list[RawMessage]:
        """See `ByteLink.taken`."""
        if self._listener is None and self._connection is None:
            if not self._retry.over:
                return self._rest(timeout_ms)
            self._connect()
        if self._accepts.over:
            waited_for = self._listener
        else:
            waited_for = None
        ends = [end for end in (waited_for, self._connection) if end is not None]
        if not ends:  # a connection was refused a moment ago
            self._clock.sleep(min(self._accepts.left_s, timeout_ms / 1000))
            return []
        ready = select.select(ends, [], [], timeout_ms / 1000)[0]
        # The tracker's own bytes first: they hold the line, and its end lets a new connection in.
        if self._connection in ready:
            chunks = self._read(self._connection)
        else:
            chunks = []
        if self._listener in ready:
            self._accept()
        return chunks

    def _read(self, connection: socket.socket | None) -> list[RawMessage]:
        if connection is None:
            return []
        try:
            data = connection.recv(MAX_READ_BYTES)
        except BlockingIOError:
            return []
        except OSError as error:
            self._shut(error.strerror or str(error))
            return []
        if not data:
            self._shut("the other side closed it")
            return []
        self._holds = self._clock.within(HELD_S)
        return self._chunk(data)

    def trouble(self) -> str:
        """See `ByteLink.trouble`."""
        return "" if self._told.over else self._refused

    def _connect(self) -> None:
        try:
            self._take(socket.create_connection(self._place, CONNECT_S), self.endpoint)
        except OSError:
            self._retry.put_off()

    def _accept(self) -> None:
        if self._listener is None:
            return
        try:
            made, (host, port, *_) = self._listener.accept()
        except OSError:  # it has gone again
            return
        self._accepts = self._clock.within(ACCEPT_EACH_S)
        peer = f"{host}:{port}"
        if not self._allowed.admits(host):
            self.link_counts.rejected += 1
            self._notices.begin(
                "sender-not-allowed",
                f"a connection from {host} is refused: it is not in [answers] allow",
            )
            made.close()
            return
        if self._connection is not None and not self._holds.over:
            self.link_counts.rejected += 1
            self._refused = (
                f"a second connection, from {peer}, is refused: {self._peer} holds the line and"
                " sends"
            )
            self._told = self._clock.within(TOLD_S)
            self._notices.tell("second-connection", f"{self.endpoint}: {self._refused}")
            made.close()
            return
        self._shut(f"{self._peer} has sent nothing for {HELD_S:g} s, and {peer} connects")
        self._take(made, peer)

    def _take(self, made: socket.socket, peer: str) -> None:
        self._peer, self._holds, self._refused = peer, self._clock.within(HELD_S), ""
        made.setblocking(False)
        made.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        self._connection = made
        self._opened()

    def _shut(self, why: str) -> None:
        if self._connection is not None:
            self._lose(why)
            self._connection.close()
            self._connection = None

    def put(self, data: bytes) -> None:
        """See `ByteLink.put`."""
        with contextlib.suppress(OSError):
            if self._connection is not None:
                self._connection.send(data)

    def close(self) -> None:
        """Close both sockets."""
        for end in (self._listener, self._connection):
            if end is not None:
                end.close()


class ZmqBytes(ByteLink):
    """A ZeroMQ SUB socket: the last part of each message."""

    messages = True

    def __init__(
        self, receiver: ZmqReceiver, notices: Notices, clock: HostClock = HOST_CLOCK
    ) -> None:
        super().__init__(receiver.endpoint, notices, clock)
        self._receiver = receiver
        self.link_counts = receiver.link_counts

    def taken(self, timeout_ms: int) -> list[RawMessage]:
        """See `ByteLink.taken`."""
        return [
            message._replace(parts=message.parts[-1:])
            for message in self._receiver.taken(timeout_ms)
        ]

    def close(self) -> None:
        """Close the socket."""
        self._receiver.close()


def no_file_kind(mode: int) -> str:
    """What a file's mode says that it is, "" for a regular file."""
    if stat.S_ISREG(mode):
        return ""
    return KINDS.get(stat.S_IFMT(mode), "no file")


def refuse_no_file(path: Path) -> None:
    """Refuse (InputError) a path that names something other than a regular file; it may name
    nothing yet.
    """
    try:
        kind = no_file_kind(path.stat().st_mode)
    except OSError:
        return
    if kind:
        raise InputError(
            f"[answers] path = {path}: {kind}; write the file to which answers are appended"
        )


class FileBytes(ByteLink):
    """What is appended to a regular file after the start; one that is made anew or cut is read from
    its beginning.

    A path that comes to name something else (a device, a FIFO, a directory) is let go and told: a
    device may have bytes for ever. It is looked at again until it names a file. So is a path that
    names nothing, or what may not be read; a file that was open is read on meanwhile.
    """

    def __init__(self, path: Path, notices: Notices, clock: HostClock = HOST_CLOCK) -> None:
        super().__init__(str(path), notices, clock)
        self._path = path
        self._file = -1
        self._trouble = ""
        self._follow()
        if self._file >= 0:
            os.lseek(self._file, 0, os.SEEK_END)

    def trouble(self) -> str:
        """See `ByteLink.trouble`."""
        return self._trouble

    def _open(self) -> None:
        """Open what the path names, if that is a regular file. Raises OSError."""
        file = os.open(self._path, os.O_RDONLY | os.O_NONBLOCK)
        kind = no_file_kind(os.fstat(file).st_mode)
        if kind:
            os.close(file)
            self._let_go(kind)
            return
        self._file = file
        self._trouble = ""
        self._opened()

    def _let_go(self, kind: str) -> None:
        self.close()
        trouble = f"it is {kind} now, and no regular file"
        if self._trouble != trouble:
            self._trouble = trouble
            self._lose(trouble)

    def taken(self, timeout_ms: int) -> list[RawMessage]:
        """See `ByteLink.taken`."""
        end = self._clock.within(timeout_ms / 1000)
        while True:
            data = b""
            with contextlib.suppress(OSError):
                if self._file >= 0:
                    data = os.read(self._file, MAX_READ_BYTES)
                # One that has more than a tracker says in a look may never end, while another
                # stands in its place.
                if not data or len(data) == MAX_READ_BYTES:
                    self._follow()
            if data:
                return self._chunk(data)
            if end.over:
                return []
            self._clock.sleep(min(FILE_LOOK_S, end.left_s))

    def _follow(self) -> None:
        """Read what the path names now; why it cannot be read is told while that lasts."""
        try:
            self._take(self._path.stat())
        except OSError as error:
            self._trouble = f"{self._path} cannot be read ({error.strerror})"

    def _take(self, named: os.stat_result) -> None:
        kind = no_file_kind(named.st_mode)
        if kind:
            self._let_go(kind)
            return
        if self._file < 0:
            self._open()
            return
        self._trouble = ""
        held = os.fstat(self._file)
        if (held.st_ino, held.st_dev) != (named.st_ino, named.st_dev):
            self.close()
            self._open()
        elif named.st_size < os.lseek(self._file, 0, os.SEEK_CUR):
            os.lseek(self._file, 0, os.SEEK_SET)

    def close(self) -> None:
        """Close the file."""
        if self._file >= 0:
            os.close(self._file)
        self._file = -1
