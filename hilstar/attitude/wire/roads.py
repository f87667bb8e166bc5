"""The contract of every road into hilstar, a way by which bytes come (a serial line, UDP, TCP,
ZeroMQ, a file): how it opens, is lost and comes back, what it counts, how arrivals are stamped, and
how bytes are sent back.

A road brings bytes and knows nothing of what they mean. A link of attitudes (`links`) is a road and
a decoder behind a gate against floods; a tracker's answers (`hilstar.server.answers.reader`) come
by a road with a decoder of their own.

Laws:
1. A road whose other side is there at the start is opened at the start. One that cannot be opened
   is refused there.
2. Losing the other side raises nothing. It is counted, and one notice says so. The road is opened
   again, first after MIN_BACK_OFF_S and then at least every MAX_BACK_OFF_S, and one notice says
   that it is back.
3. A read that opens the road returns nothing: what a read returns came by an earlier opening.
4. A read waits at most for its `timeout_ms` (or for TCP's handshake, 0.3 s). A write waits at most
   for its `patience_s`, by default not at all.
"""

import errno
import os
import select
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import asdict, astuple, dataclass
from operator import add, sub
from typing import Any, ClassVar, NamedTuple

from hilstar.attitude.wire.road_use import RoadUse
from hilstar.basics.errors import one_line
from hilstar.basics.notices import Notices
from hilstar.basics.process.closing import Closing
from hilstar.basics.process.scheduling import HOST_CLOCK, BackOff, HostClock

MAX_READ_BYTES = 65_536  # in one read
MIN_BACK_OFF_S = 0.05
PAUSE_S = 0.005  # a flooded receiver rests: the frame loop needs the interpreter lock
MAX_BACK_OFF_S = 0.25  # so that a road is open again within a second of coming back

ATTITUDES = RoadUse(
    table="[attitude]",
    where="",
    lost="lost",
    lost_line="{endpoint} disconnected ({why}); waiting for it to come back",
    back="back",
    back_line="{endpoint} is back",
)
ANSWERS = RoadUse(
    table="[answers]",
    where="[answers] ",
    lost="answers-lost",
    lost_line="{endpoint}: the tracker's line is lost ({why}); waiting for it",
    back="answers-back",
    back_line="{endpoint}: the tracker's line is back",
    second="second-connection",
    second_line="a second connection, from {peer}, is refused: {holder} holds the line and sends",
)


@dataclass(slots=True)
class LinkCounts:
    """The counts of a road's connections and messages.

    `connections`: connections made. `rejected`: failed handshakes, and connections and datagrams
    of senders that are not allowed. `refused`: connections refused because there were too many at
    once. `lost`: losses of the other side. `resets`: restarts of the link, because of its memory or
    of messages without end. `flooded`: messages dropped unread.
    """

    connections: int = 0
    rejected: int = 0
    refused: int = 0
    lost: int = 0
    resets: int = 0
    flooded: int = 0

    def summary(self) -> dict[str, int]:
        """The counts by their names."""
        return asdict(self)

    def __add__(self, other: "LinkCounts") -> "LinkCounts":
        return LinkCounts(*map(add, astuple(self), astuple(other)))

    def __sub__(self, other: "LinkCounts") -> "LinkCounts":
        return LinkCounts(*map(sub, astuple(self), astuple(other)))


class RawMessage(NamedTuple):
    """What arrived, before it is decoded: its parts, the host time of its arrival in ns, and the
    address of its sender, where a link has several senders.

    `empty_ns` is the last host time at which nothing waited, ns. A `timely` message was read as it
    arrived; one that is not may have waited since `empty_ns`.
    """

    host_ns: int
    parts: Sequence[bytes]
    empty_ns: int = 0
    timely: bool = True
    sender: tuple[Any, ...] | None = None

    @property
    def waited_ns(self) -> int:
        """How long the message may have waited before it was stamped, ns; 0 if it was timely."""
        return 0 if self.timely else self.host_ns - self.empty_ns


class ByteRoad(Closing, ABC):
    """A way by which bytes come; it is closed when its `with` ends.

    `verb` and `endpoint` say where it is ("connected to", "tcp://127.0.0.1:5560"). `messages`: each
    item that comes is one whole message; otherwise bytes come in pieces that are cut anywhere.
    `stamped`: the kernel, or a process that only reads, stamps arrivals; otherwise the thread that
    reads here does. `openings` counts how often the road was opened.
    """

    messages: ClassVar[bool] = False
    stamped: ClassVar[bool] = False
    verb: str = "reading"

    def __init__(
        self,
        endpoint: str,
        use: RoadUse = ATTITUDES,
        notices: Notices | None = None,
        clock: HostClock = HOST_CLOCK,
    ) -> None:
        self.endpoint = endpoint
        self.link_counts = LinkCounts()
        self.openings = 0
        self._use = use
        self._notices = Notices() if notices is None else notices
        self._clock = clock
        self._retry = BackOff(MIN_BACK_OFF_S, MAX_BACK_OFF_S, clock)

    @property
    def notices(self) -> Notices:
        """The notices to which the road reports losses and returns."""
        return self._notices

    @property
    def clock(self) -> HostClock:
        """The clock by which the road stamps and waits."""
        return self._clock

    @property
    def reconnects(self) -> int:
        """How often the other side came back."""
        return max(0, self.openings - 1)

    @property
    def trouble(self) -> str:
        """A line about what is wrong with the road at present; "" where nothing is."""
        return ""

    @abstractmethod
    def taken(self, timeout_ms: int) -> list[RawMessage]:
        """The messages or pieces of bytes that have come, in order; waits at most `timeout_ms` for
        the first.
        """

    @abstractmethod
    def wait_for_message(self, timeout_ms: int) -> bool:
        """True once something unread has arrived, False after `timeout_ms` without it."""

    def put(self, data: bytes, patience_s: float = 0.0) -> bool:
        """Send to the other side, waiting at most `patience_s` while it accepts nothing; False
        where not all bytes were sent.
        """
        return False

    def await_ready(self) -> None:
        """Wait, not for long, until no message is missed from the first read on. Only a road that
        is read by a separate process needs this.
        """

    @abstractmethod
    def close(self) -> None:
        """Close the road."""

    def _opened(self) -> None:
        self.openings += 1
        if self.openings > 1:
            self._tell(self._use.back, self._use.back_line)

    def _lose(self, why: str) -> None:
        self.link_counts.lost += 1
        self._tell(self._use.lost, self._use.lost_line, why=one_line(why))
        self._retry.put_off(anew=True)

    def _tell(self, kind: str, line: str, **words: str) -> None:
        self._notices.tell(kind, line.format(endpoint=self.endpoint, **words))

    def _try_again(
        self, opens: Callable[[], None], failures: tuple[type[Exception], ...], timeout_ms: int
    ) -> None:
        """Open a lost road again by `opens` where the next attempt is due, and put the attempt
        after it off where this raises one of `failures`; before that only sleep, at most
        `timeout_ms`.
        """
        if not self._retry.over:
            self._clock.sleep(min(self._retry.left_s, timeout_ms / 1000))
            return
        try:
            opens()
        except failures:
            self._retry.put_off()


def is_readable(file: int, timeout_ms: float) -> bool:
    """Whether bytes, or the end, can be read at a file descriptor; waits at most `timeout_ms`."""
    # poll, as select refuses descriptors from 1024 on
    poll = select.poll()
    poll.register(file, select.POLLIN)
    return bool(poll.poll(timeout_ms))


def read_device(file: int, timeout_ms: int, clock: HostClock = HOST_CLOCK) -> list[RawMessage]:
    """The bytes that wait at an open device, as at most one message; waits at most `timeout_ms` for
    them. Raises OSError where the device has gone.
    """
    if not is_readable(file, timeout_ms):
        return []
    try:
        data = os.read(file, MAX_READ_BYTES)
    except BlockingIOError:
        return []
    if not data:
        raise OSError(errno.EIO, "it was readable, and nothing came")
    now_ns = clock.now_ns()
    return [RawMessage(now_ns, [data], now_ns)]
