"""The contract of every link into hilstar: messages with their time of arrival, a way back, and limits against floods."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from types import TracebackType
from typing import Generic, Protocol, Self, TypeAlias, TypeVar

from hilstar.attitude.wire.packet import AttitudeSample, Event, Packet, Refusal
from hilstar.attitude.wire.source import Conventions
from hilstar.notices import Notices

MAX_PACKETS_PER_S = 3000  # decoded: some 10 % of one core, and more than any serial line carries
MAX_BURST = 1000  # as many as may have waited while the receiver was stopped
PAUSE_S = 0.005  # of a flooded receiver: the frame loop needs the interpreter lock
OVER_S = 1.0  # a flood is over once no packet was dropped for this long
MAX_LOOKED_AT = 1000  # of what is passed over: a discontinuity is declared once, and not in each packet that is damaged
T = TypeVar("T")
E_co = TypeVar("E_co", bound=Event, covariant=True)


@dataclass(slots=True)
class LinkCounts:
    """The counts of a link's connections and messages.

    `connections` were made; `rejected` failed in the handshake, or were datagrams of senders that are not allowed; `refused`
    were too many at once; `lost` ended on the side that connects; `resets` of the link, for memory or for messages without
    end; `flooded` messages were dropped unread.
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


class FloodGate:
    """Admits MAX_PACKETS_PER_S, and MAX_BURST at once, the newest. The others are passed over: counted and reported."""

    def __init__(self, counts: LinkCounts, notices: Notices, now_s: Callable[[], float] = time.monotonic) -> None:
        self._counts = counts
        self._notices = notices
        self._now_s = now_s
        self._left = float(MAX_BURST)
        self._seen_s = now_s()
        self._dropped_s = -OVER_S

    def newest(self, waiting: list[T], declares_discontinuity: Callable[[T], bool]) -> list[T]:
        """Of all that waits, oldest first, what may be decoded: the newest. Pauses where others are passed over.

        Of those the newest that declares a discontinuity is taken too: no attitude is interpolated across it.
        """
        passed_over = len(waiting) - self._admit(len(waiting))
        for k in range(passed_over - 1, max(passed_over - MAX_LOOKED_AT, 0) - 1, -1):
            if declares_discontinuity(waiting[k]):
                self._counts.flooded -= 1
                return [waiting[k], *waiting[passed_over:]]
        return waiting[passed_over:]

    def _admit(self, waiting: int) -> int:
        """How many of the waiting packets may be decoded."""
        now_s = self._now_s()
        self._left = min(self._left + (now_s - self._seen_s) * MAX_PACKETS_PER_S, MAX_BURST)
        self._seen_s = now_s
        admitted = min(waiting, int(self._left))
        self._left -= admitted
        if admitted < waiting:
            self._drop(waiting - admitted, now_s)
        return admitted

    def _drop(self, count: int, now_s: float) -> None:
        self._counts.flooded += count
        if now_s - self._dropped_s > OVER_S:
            self._notices.tell(
                "flood",
                f"over {MAX_PACKETS_PER_S} packets per second, or {MAX_BURST} at once: taking the newest,"
                " passing over the others unread",
            )
        self._dropped_s = now_s
        time.sleep(PAUSE_S)


@dataclass(frozen=True, slots=True)
class Arrival(Generic[E_co]):
    """One message: host time of its arrival, what it says, its bytes as received, and how long it may have waited unread.

    `refusal` says why a packet that is an attitude is not used. `back` sends to whoever sent this, where a link has several
    senders. A `stamped` arrival's time and its wait are the kernel's, or of a process that does nothing else, however late it
    is read here.
    """

    host_ns: int
    event: E_co
    raw: bytes = b""
    waited_ns: int = 0
    refusal: Refusal | None = None
    back: Callable[[Packet], None] | None = None
    stamped: bool = False


SampleArrival: TypeAlias = Arrival[AttitudeSample]


class Link(Protocol):
    """A link into hilstar."""

    two_way: bool

    def receive(self, timeout_ms: int) -> list[Arrival[Event]]:
        """What has arrived; waits at most `timeout_ms` for the first, and for no other. A lost peer raises nothing."""

    def wait_for_message(self, timeout_ms: int) -> bool:
        """True once something has arrived that was not read."""

    def send(self, packet: Packet) -> None:
        """Send to the other side, never waiting; lost if there is no listener."""

    def wire_ns(self, packet: Packet) -> int:
        """How long the wire alone takes for a packet, ns."""


class StreamLink(Link, Protocol):
    """A link that runs freely: what `serve` asks of one, besides its messages.

    `verb` and `endpoint` say where it is ("connected to", "tcp://127.0.0.1:5560"), `conventions` what its numbers mean.
    """

    verb: str
    endpoint: str
    link_counts: LinkCounts
    conventions: Conventions

    @property
    def reconnects(self) -> int:
        """How often the sender reconnected."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /
    ) -> None: ...
