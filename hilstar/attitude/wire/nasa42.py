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

import re
from calendar import isleap
from collections.abc import Sequence
from datetime import date

import numpy as np

from hilstar.attitude.wire.endpoint import AllowedSenders, check_use, parse_endpoint
from hilstar.attitude.wire.links import (
    Arrival,
    Decoder,
    LockstepLink,
    MessageLink,
    StreamLink,
    pieces,
)
from hilstar.attitude.wire.packet import AttitudeSample, Event, Refusal, Status, checked_sample
from hilstar.attitude.wire.road_use import RoadUse
from hilstar.attitude.wire.roads import RawMessage
from hilstar.attitude.wire.source import Conventions, Mounting, components
from hilstar.attitude.wire.tcp import TcpRoad
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
THIS_MACHINE = AllowedSenders()
USE = RoadUse(
    table="[attitude]",
    where="",
    lost="lost",
    lost_line="{endpoint}: 42 closed the connection; waiting for it to come back",
    back="back",
    back_line="42 is connected again",
    second_line="a second connection, from {host}, is closed; 42 has one already",
)


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
    if not (year >= 1 and hour < 24 and minute < 60 and second <= 60):
        return None
    if not 1 <= day_of_year <= 365 + isleap(year):
        return None
    days = date(year, 1, 1).toordinal() - 1 + day_of_year - EPOCH_DAY
    seconds = days * SECONDS_PER_DAY + hour * 3600 + minute * 60 + second
    return seconds * NS_PER_S + int((match[6] or "").ljust(9, "0"))


def tcp_road(
    endpoint: str,
    *,
    bind: bool = False,
    allowed: AllowedSenders = THIS_MACHINE,
    notices: Notices | None = None,
    clock: HostClock = HOST_CLOCK,
) -> TcpRoad:
    """The TCP connection to 42 of an endpoint. Raises InputError where it is none, or cannot be
    bound.
    """
    place = parse_endpoint(endpoint)
    check_use(place, endpoint, bind=bind)
    if place.path is not None:
        raise InputError(
            f"{endpoint}: 42 speaks TCP; write tcp://HOST:PORT, such as tcp://127.0.0.1:10001"
        )
    host, _, port = place.address.removeprefix("tcp://").rpartition(":")
    host = "0.0.0.0" if host == "*" else host.strip("[]")
    number = 0 if port == "*" else int(port)
    road = TcpRoad((host, number), allowed, USE, notices, clock, listening=bind)
    if not bind:
        road.endpoint = endpoint  # as it was written
    return road


class MessageDecoder(Decoder):
    """42's messages, cut anywhere as they come, for one spacecraft."""

    conventions = CONVENTIONS

    def __init__(self, reader: MessageReader) -> None:
        self._reader = reader
        self.begin()

    def begin(self) -> None:
        """See `Decoder.begin`."""
        self._splitter = MessageSplitter()

    def whole(self, chunk: RawMessage) -> list[RawMessage]:
        """See `Decoder.whole`."""
        return pieces(chunk, self._splitter.feed(chunk.parts[0]))

    def event(self, message: bytes) -> Event:
        """See `Decoder.event`."""
        return self._reader.decode(message)


class _Nasa42(MessageLink):
    """42 waits for an acknowledgement of each message."""

    def __init__(
        self,
        endpoint: str,
        reader: MessageReader,
        *,
        bind: bool = False,
        allowed: AllowedSenders = THIS_MACHINE,
        notices: Notices | None = None,
        clock: HostClock = HOST_CLOCK,
    ) -> None:
        road = tcp_road(endpoint, bind=bind, allowed=allowed, notices=notices, clock=clock)
        super().__init__(road, MessageDecoder(reader))

    def _acknowledge(self, count: int = 1) -> None:
        """Let 42 compute on."""
        if count:
            self._road.put(ACK * count)


class Nasa42Link(_Nasa42, StreamLink):
    """42 runs freely: each message is acknowledged as it is read."""

    def messages(self, timeout_ms: int) -> list[RawMessage]:
        """See `MessageLink.messages`; each is acknowledged."""
        messages = super().messages(timeout_ms)
        self._acknowledge(len(messages))
        return messages


class Nasa42Lockstep(_Nasa42, LockstepLink):
    """42 waits for each frame: its message is acknowledged once the frame is shown."""

    _waiting: Sequence[RawMessage] = ()

    def receive(self, timeout_ms: int) -> Arrival[Event] | None:
        """The next message, or None."""
        self._waiting = self._waiting or self.messages(timeout_ms)
        if not self._waiting:
            return None
        first, *self._waiting = self._waiting
        return self._decoder.arrivals([first])[0]

    def answer(self, status: Status, shown_ns: int, refusal: Refusal | None) -> None:
        """Let 42 compute on."""
        self._acknowledge()
