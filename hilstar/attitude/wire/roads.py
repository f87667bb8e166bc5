"""The contract of every road into hilstar: how it opens, is lost and comes back, what it counts,
how what comes is stamped, and what goes back.

A road brings bytes and knows nothing of what they mean. An attitude's link (`links`) is a road and
a decoder behind a gate against floods; a tracker's answers (`hilstar.server.answers.reader`) are a
road and their own decoder.

Laws:
1. A road that is there at the start is opened at the start; what cannot be opened is refused there.
2. Losing the other side raises nothing: it is counted, told once, and the road is opened again, at
   first after MIN_BACK_OFF_S and at least each MAX_BACK_OFF_S; that it is back is told once.
3. A read that opens the road brings nothing: what a read brings is of the opening before it.
4. A read waits at most as long as it is told to (or for TCP's handshake, 0.3 s), and a write never,
   where it is not told to.
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

MAX_READ_BYTES = 65_536  # in one go
MIN_BACK_OFF_S = 0.05
PAUSE_S = 0.005  # a flooded receiver rests: the frame loop needs the interpreter lock
MAX_BACK_OFF_S = 0.25  # what comes back is opened within a second

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

    `connections`: made. `rejected`: failed handshakes, and datagrams of senders that are not
    allowed. `refused`: too many at once. `lost`: ended, on the side that connects. `resets`: of the
    link, for memory or for messages without end. `flooded`: messages dropped unread.
    """

    connections: int = 0
    rejected: int = 0
    refused: int = 0
    lost: int = 0
    resets: int = 0
    flooded: int = 0

    def summary(self) -> dict[str, int]:
        """The counts by name."""
        return asdict(self)

    def __add__(self, other: "LinkCounts") -> "LinkCounts":
        return LinkCounts(*map(add, astuple(self), astuple(other)))

    def __sub__(self, other: "LinkCounts") -> "LinkCounts":
        return LinkCounts(*map(sub, astuple(self), astuple(other)))


class RawMessage(NamedTuple):
    """What arrived, before it is decoded: host time in ns, its parts, and who sent it, where a link
    has several senders.

    `empty_ns` is when nothing waited last. A `timely` message woke its reader and did not wait.
    """

    host_ns: int
    parts: Sequence[bytes]
    empty_ns: int = 0
    timely: bool = True
    sender: tuple[Any, ...] | None = None

    @property
    def waited_ns(self) -> int:
        """How long it may have waited before it was stamped, ns."""
        return 0 if self.timely else self.host_ns - self.empty_ns


class ByteRoad(Closing, ABC):
    """A way by which bytes come, closed when its `with` ends.

    `verb` and `endpoint` say where it is ("connected to", "tcp://127.0.0.1:5560"). `messages`: what
    comes is whole by itself; else it is cut anywhere. `stamped`: times of arrival are the kernel's,
    or of a process that only reads; else they are of the thread that reads here. `openings` counts
    how often it was opened.
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
        """What hears of it."""
        return self._notices

    @property
    def clock(self) -> HostClock:
        """What times it."""
        return self._clock

    @property
    def reconnects(self) -> int:
        """How often the other side came back."""
        return max(0, self.openings - 1)

    @property
    def trouble(self) -> str:
        """What is wrong with it for as long as it lasts: a line; "" while nothing is."""
        return ""

    @abstractmethod
    def taken(self, timeout_ms: int) -> list[RawMessage]:
        """What has come, in order; waits at most `timeout_ms` for the first."""

    @abstractmethod
    def wait_for_message(self, timeout_ms: int) -> bool:
        """True once something unread has arrived."""

    def put(self, data: bytes, patience_s: float = 0.0) -> bool:
        """Send to the other side, waiting at most `patience_s` while it takes nothing; False
        where some was lost.
        """
        return False

    def await_ready(self) -> None:
        """Wait until a sender is heard from the first read on: for a process that reads, and not
        for long.
        """

    @abstractmethod
    def close(self) -> None:
        """Close it."""

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
        """Open what was lost once that is due; until then rest, at most `timeout_ms`."""
        if not self._retry.over:
            self._clock.sleep(min(self._retry.left_s, timeout_ms / 1000))
            return
        try:
            opens()
        except failures:
            self._retry.put_off()


def is_readable(file: int, timeout_ms: float) -> bool:
    """Whether bytes, or an end, wait at an open file, of any number; waits at most `timeout_ms`."""
    poll = select.poll()
    poll.register(file, select.POLLIN)
    return bool(poll.poll(timeout_ms))


def read_device(file: int, timeout_ms: int, clock: HostClock = HOST_CLOCK) -> list[RawMessage]:
    """The bytes that wait at an open device; waits at most `timeout_ms` for the first. Raises
    OSError where it no longer answers.
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
