"""NASA's 42: its text protocol (no I/O), and the TCP connection over which it waits for an
acknowledgement of each message.

A message is lines of text: `TIME YYYY-DDD-hh:mm:ss.sssssssss` (UTC), then `NAME = [a b c]` for each
variable with one of the prefixes in Inp_IPC.txt, then `[ENDMSG]`. Until 2025 there were no brackets
around the values, and `[EOF]` ended a message; both are read. (42's own Source/AutoCode/TxRxIPC.c
and, before that, Source/IPC/SimWriteToSocket.c.)

Laws:
1. However the bytes are cut into chunks, the messages are the same.
2. Each message gives exactly one event, an attitude or a `Refusal`; nothing raises.
3. At most MAX_MESSAGE_BYTES are kept of a message that does not end.

hilstar connects, and retries until 42 is there, or listens where 42 is the client.
"""

import contextlib
import re
import select
import socket
from collections.abc import Sequence
from datetime import date

import numpy as np

from hilstar.attitude.wire.endpoint import AllowedSenders, check_use, parse_endpoint
from hilstar.attitude.wire.links import Arrival, Link, LockstepLink, RawMessage, StreamLink
from hilstar.attitude.wire.packet import AttitudeSample, Event, Refusal, Status, checked_sample
from hilstar.attitude.wire.source import Conventions, Mounting, components
from hilstar.attitude.wire.udp import ANCILLARY_BYTES, KernelStamps
from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError, shortened
from hilstar.basics.notices import Notices
from hilstar.basics.process.scheduling import HOST_CLOCK, HostClock
from hilstar.basics.units import NS_PER_S

MAX_MESSAGE_BYTES = 65_536  # 42's own buffer holds 16 384
TOO_LONG = b""
END = re.compile(rb"^\[(?:ENDMSG|EOF)\][^\n]*\n", re.MULTILINE)
TIME = re.compile(
    r"^TIME +(\d{4})-(\d{1,3})-(\d{1,2}):(\d{1,2}):(\d{1,2})(?:\.(\d{1,9})\d*)?\s*$", re.MULTILINE
)
SPACECRAFT = re.compile(r"(?:SC\[)?(\d{1,3})\]?")
EPOCH_DAY = date(1970, 1, 1).toordinal()
SECONDS_PER_DAY = 86_400
SHOWN_CHARACTERS = 60
ACK = b"Ack\n"
CONNECT_S = 0.3
RETRY_S = 0.25
MAX_READ_BYTES = 65_536
# A peer whose cable was pulled says nothing: the kernel asks.
KEEPALIVE = {socket.TCP_KEEPIDLE: 3, socket.TCP_KEEPINTVL: 1, socket.TCP_KEEPCNT: 3}


def written(q_icrs_to_body: FloatArray) -> str:
    """A body's attitude as 42 writes it: scalar last, of opposite sign to a Hamilton quaternion
    that turns N into B.
    """
    w, x, y, z = q_icrs_to_body
    return f"qn = {components(np.array([-x, -y, -z, w]))}"


CONVENTIONS = Conventions(
    "NASA's 42",
    "SC[i].B[0].qn is the attitude of body 0 in N, wn its rate in body components; N is taken as"
    " the ICRS, which holds (within 23 mas) where the reference orbit is about the Earth: about any"
    " other world 42's N is that world's own equator",
    "scalar last (x, y, z, w); as a Hamilton quaternion it turns body components into those of N",
    "UTC, every day of 86400 s, from 1970-01-01",
    of_body=True,
    written=written,
)


def spacecraft_number(name: str | int | None) -> int:
    """The number of the spacecraft that 0 or "SC[0]" names; 0 for None. Raises InputError."""
    match = SPACECRAFT.fullmatch(str(0 if name is None else name))
    if match is None:
        raise InputError(
            f'spacecraft = "{shortened(name)}": write 42\'s number of it, such as spacecraft ='
            ' "SC[0]"'
        )
    return int(match[1])


class MessageSplitter:
    """Bytes in, whole messages out, each with the line that ends it; TOO_LONG in the place of
    one that is.
    """

    def __init__(self) -> None:
        self._kept = bytearray()
        self._line = 0  # where its last line begins: what is before it was looked at
        self._overlong = False

    def feed(self, chunk: bytes) -> list[bytes]:
        """The messages that `chunk` completes, in order."""
        messages: list[bytes] = []
        self._kept += chunk
        if b"\n" in chunk:
            while (end := END.search(self._kept, self._line)) is not None:
                overlong = self._overlong or end.end() > MAX_MESSAGE_BYTES
                messages.append(TOO_LONG if overlong else bytes(self._kept[: end.end()]))
                del self._kept[: end.end()]
                self._line = 0
                self._overlong = False
            self._line = self._kept.rfind(b"\n") + 1
        if len(self._kept) > MAX_MESSAGE_BYTES:
            # The last line may be the beginning of the end.
            self._overlong, self._kept, self._line = (
                True,
                self._kept[self._line :][:MAX_MESSAGE_BYTES],
                0,
            )
        return messages


class MessageReader:
    """Decodes the messages for one spacecraft; `sequence` counts them."""

    def __init__(self, spacecraft: int, mounting: Mounting) -> None:
        self._mounting = mounting
        self._name = f"SC[{spacecraft}].B[0]"
        # The spacecraft's own qn and wn are those of its body 0; versions until 2025 do not send
        # them.
        names = "|".join(re.escape(name) for name in (self._name, f"SC[{spacecraft}]"))
        self._line = re.compile(rf"^(?:{names})\.(qn|wn) *= *\[?([^\]\n]*)\]?\s*$", re.MULTILINE)
        self._sequence = 0

    def decode(self, message: bytes) -> AttitudeSample | Refusal:
        """The camera's attitude that a whole message holds, or why there is none."""
        self._sequence += 1
        if message == TOO_LONG:
            return Refusal(
                "format",
                f"a message of over {MAX_MESSAGE_BYTES} bytes; write fewer prefixes in Inp_IPC.txt",
            )
        text = message.decode("latin-1")
        t_ns = _time_ns(text)
        if t_ns is None:
            return Refusal("format", f"no TIME YYYY-DDD-hh:mm:ss, but {text[:SHOWN_CHARACTERS]!r}")
        try:
            fields = {}
            for name, values in self._line.findall(text):
                fields[name] = tuple(map(float, values.split()))
        except ValueError:
            fields = {"qn": ()}
        if "qn" not in fields:
            return Refusal(
                "format", f'no {self._name}.qn; write the prefix "{self._name}" in Inp_IPC.txt'
            )
        q = fields["qn"]
        rate = fields.get("wn", ())
        if len(q) != 4 or len(rate) not in {0, 3}:
            return Refusal("format", f"{self._name}.qn must have four numbers, and wn three")
        x, y, z, w = q
        body = checked_sample(t_ns, (w, -x, -y, -z), tuple(rate) or None, self._sequence)
        if isinstance(body, Refusal):
            return body
        return self._mounting.sample(body)


def _time_ns(text: str) -> int | None:
    """Nanoseconds since 1970-01-01, every day of 86400 s; None where no time is written."""
    match = TIME.search(text)
    if match is None:
        return None
    year, day_of_year, hour, minute, second = (int(part) for part in match.groups()[:5])
    if not (year >= 1 and 1 <= day_of_year <= 366 and hour < 24 and minute < 60 and second <= 60):
        return None
    days = date(year, 1, 1).toordinal() - 1 + day_of_year - EPOCH_DAY
    seconds = days * SECONDS_PER_DAY + hour * 3600 + minute * 60 + second
    return seconds * NS_PER_S + int((match[6] or "").ljust(9, "0"))


class _Connection(Link):
    """One connection at a time; a second one is closed at once. Raises InputError where it
    cannot be bound.
    """

    stamped = True
    conventions = CONVENTIONS

    def __init__(
        self,
        endpoint: str,
        reader: MessageReader,
        *,
        bind: bool = False,
        allowed: AllowedSenders | None = None,
        notices: Notices | None = None,
        clock: HostClock = HOST_CLOCK,
    ) -> None:
        super().__init__(notices, clock)
        place = parse_endpoint(endpoint)
        check_use(place, endpoint, bind=bind)
        if place.path is not None:
            raise InputError(
                f"{endpoint}: 42 speaks TCP; write tcp://HOST:PORT, such as tcp://127.0.0.1:10001"
            )
        self.endpoint = endpoint
        self.verb = "bound to" if bind else "connecting to"
        host, _, port = place.address.removeprefix("tcp://").rpartition(":")
        self._place = (
            "0.0.0.0" if host == "*" else host.strip("[]"),
            0 if port == "*" else int(port),
        )
        self._reader = reader
        self._splitter = MessageSplitter()
        self._allowed = AllowedSenders() if allowed is None else allowed
        self._connection: socket.socket | None = None
        self._retry = clock.within(0.0)
        self._listener: socket.socket | None = None
        if bind:
            six = ":" in self._place[0]
            try:
                self._listener = socket.create_server(
                    self._place, family=socket.AF_INET6 if six else socket.AF_INET
                )
            except OSError as error:
                raise InputError(
                    f"{endpoint}: cannot bind ({error.strerror}); write another address or port"
                ) from error
            self._listener.setblocking(False)
            bound = f"[{self._place[0]}]" if six else self._place[0]
            self.endpoint = f"tcp://{bound}:{self._listener.getsockname()[1]}"

    def messages(self, timeout_ms: int) -> list[RawMessage]:
        if self._connection is None and self._listener is None:
            self._connect(timeout_ms)
        if not self.wait_for_message(timeout_ms):
            return []
        if self._connection is not None:
            try:
                chunk, ancillary, _, _ = self._connection.recvmsg(MAX_READ_BYTES, ANCILLARY_BYTES)
                host_ns = self._stamps.arrived_ns(ancillary, self._clock.now_ns())
            except BlockingIOError:
                self._accept()
                return []
            except OSError:
                chunk = b""
            if chunk:
                whole = self._splitter.feed(chunk)
                # The kernel's stamp is that of the last.
                return [
                    RawMessage(host_ns, [m], self._stamps.empty_ns, k == len(whole))
                    for k, m in enumerate(whole, 1)
                ]
            self.link_counts.lost += 1
            self._notices.tell(
                "lost", f"{self.endpoint}: 42 closed the connection; waiting for it to come back"
            )
            self._shut()
        self._accept()
        return []

    def arrival(self, message: RawMessage) -> Arrival[Event]:
        return Arrival(
            message.host_ns,
            self._reader.decode(message.parts[0]),
            message.parts[0],
            message.waited_ns,
        )

    def acknowledge(self, count: int = 1) -> None:
        """Let 42 compute on: it waits after each message."""
        if self._connection is not None and count:
            with contextlib.suppress(OSError):  # one that is gone is noticed by the next read
                self._connection.send(ACK * count)

    def _connect(self, timeout_ms: int) -> None:
        if not self._retry.over:
            self._clock.sleep(min(self._retry.left_s, timeout_ms / 1000))
            return
        self._retry = self._clock.within(RETRY_S)
        with contextlib.suppress(OSError):
            self._take(socket.create_connection(self._place, timeout=CONNECT_S))

    def _accept(self) -> None:
        while self._listener is not None:
            try:
                made, peer = self._listener.accept()
            except OSError:
                return
            if not self._allowed.admits(peer[0]):
                self.link_counts.rejected += 1
                self._notices.begin(
                    "sender-not-allowed",
                    f"a connection from {peer[0]} is closed: it is not in [attitude] allow",
                )
            elif self._connection is not None:
                self.link_counts.refused += 1
                self._notices.tell(
                    "connections-refused",
                    f"a second connection, from {peer[0]}, is closed; 42 has one already",
                )
            else:
                self._take(made)
                continue
            made.close()

    def _take(self, made: socket.socket) -> None:
        self.link_counts.connections += 1
        made.setblocking(False)
        made.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        made.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for option, value in KEEPALIVE.items():
            made.setsockopt(socket.IPPROTO_TCP, option, value)
        self._splitter = MessageSplitter()
        self._connection, self._stamps = made, KernelStamps(made, self._clock)
        if self.link_counts.connections > 1:
            self._notices.tell("back", "42 is connected again")

    def wait_for_message(self, timeout_ms: int) -> bool:
        waited = [
            waiting_socket
            for waiting_socket in (self._listener, self._connection)
            if waiting_socket is not None
        ]
        if not waited:
            return False
        poll = select.poll()
        for waiting_socket in waited:
            poll.register(waiting_socket, select.POLLIN)
        asked_ns = self._clock.now_ns()
        waits = bool(poll.poll(timeout_ms))
        if not waits and self._connection is not None:
            self._stamps.empty_ns = asked_ns
        return waits

    def _shut(self) -> None:
        connection = self._connection
        self._connection = None
        if connection is not None:
            connection.close()

    def close(self) -> None:
        self._shut()
        if self._listener is not None:
            self._listener.close()


class Nasa42Link(_Connection, StreamLink):
    """42 runs freely: each message is acknowledged as it is read."""

    def receive(self, timeout_ms: int) -> list[Arrival[Event]]:
        """The messages that have arrived, and only the newest of a flood; each is acknowledged."""
        messages = self.messages(timeout_ms)
        self.acknowledge(len(messages))
        # 42 declares none
        return [self.arrival(message) for message in self._gate.newest(messages, lambda _: False)]


class Nasa42Lockstep(_Connection, LockstepLink):
    """42 waits for each frame: its message is acknowledged once the frame is shown."""

    _waiting: Sequence[RawMessage] = ()

    def receive(self, timeout_ms: int) -> Arrival[Event] | None:
        """The next message, or None."""
        self._waiting = self._waiting or self.messages(timeout_ms)
        if not self._waiting:
            return None
        first, *self._waiting = self._waiting
        return self.arrival(first)

    def answer(self, status: Status, shown_ns: int, refusal: Refusal | None) -> None:
        """Let 42 compute on."""
        self.acknowledge()
