"""The contract of every link into hilstar: what it can do, messages with their time of arrival,
limits against floods.

A packet has two names on its way in: what arrived (`RawMessage`, once decoded `Arrival`), and the
`AttitudeSample` in it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import asdict, astuple, dataclass
from operator import add, sub
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Literal, NamedTuple, TypeAlias, TypeVar

from hilstar.attitude.wire.packet import AttitudeSample, Event, Packet, Refusal, Status
from hilstar.attitude.wire.source import PACKETS, Conventions
from hilstar.basics.notices import Notices
from hilstar.basics.process.closing import Closing
from hilstar.basics.process.scheduling import HOST_CLOCK, HostClock
from hilstar.basics.units import NS_PER_S

if TYPE_CHECKING:
    from hilstar.basics.arrays import FloatArray

MAX_PACKETS_PER_S = 3000  # decoded: some 10 % of one core, and more than any serial line carries
MAX_BURST = 1000  # as many as may have waited while the receiver was stopped
PAUSE_S = 0.005  # a flooded receiver rests: the frame loop needs the interpreter lock
OVER_NS = NS_PER_S  # a flood is over once no packet was dropped for this long
MAX_LOOKED_AT = 1000  # passed-over packets searched for a discontinuity, which is declared once
CLIENT_REJECTED = "client-rejected"  # the notice that a connection to a socket that binds was none
WRONG_PEER = "link-rejected"  # the notice that something else than a sender is at the other side
E_co = TypeVar("E_co", bound=Event, covariant=True)


@dataclass(slots=True)
class LinkCounts:
    """The counts of a link's connections and messages.

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

    def __add__(self, other: LinkCounts) -> LinkCounts:
        return LinkCounts(*map(add, astuple(self), astuple(other)))

    def __sub__(self, other: LinkCounts) -> LinkCounts:
        return LinkCounts(*map(sub, astuple(self), astuple(other)))


class FloodGate:
    """Admits MAX_PACKETS_PER_S, and MAX_BURST at once, the newest. The others are passed over:
    counted and reported.
    """

    def __init__(self, counts: LinkCounts, notices: Notices, clock: HostClock = HOST_CLOCK) -> None:
        self._counts = counts
        self._notices = notices
        self._clock = clock
        self._left = float(MAX_BURST)
        self._seen_ns = clock.now_ns()
        self._dropped_ns = self._seen_ns - OVER_NS - 1

    def newest(
        self, waiting: list[RawMessage], declares_discontinuity: Callable[[bytes], bool]
    ) -> list[RawMessage]:
        """The newest of the waiting messages (oldest first), as many as may be decoded. Pauses
        where others are passed over.

        The newest passed-over message whose last part declares a discontinuity is taken too: no
        attitude is interpolated across it.
        """
        now_ns = self._clock.now_ns()
        self._left = min(
            self._left + (now_ns - self._seen_ns) * MAX_PACKETS_PER_S / NS_PER_S, MAX_BURST
        )
        self._seen_ns = now_ns
        passed_over = max(len(waiting) - int(self._left), 0)
        self._left -= len(waiting) - passed_over
        if not passed_over:
            return waiting
        self._counts.flooded += passed_over
        if now_ns - self._dropped_ns > OVER_NS:
            limits = f"over {MAX_PACKETS_PER_S} packets per second, or {MAX_BURST} at once"
            self._notices.tell(
                "flood", f"{limits}: taking the newest, passing over the others unread"
            )
        self._dropped_ns = now_ns
        self._clock.sleep(PAUSE_S)
        for k in range(passed_over - 1, max(passed_over - MAX_LOOKED_AT, 0) - 1, -1):
            if declares_discontinuity(waiting[k].parts[-1]):
                self._counts.flooded -= 1
                return [waiting[k], *waiting[passed_over:]]
        return waiting[passed_over:]


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


@dataclass(frozen=True, slots=True)
class Arrival(Generic[E_co]):
    """What arrived: host time, what it says, its bytes as received, and how long it may have waited
    unread.

    `refusal` says why a packet that is an attitude is not used. `back` sends to the sender of this
    message, and `address` is where that is, where a link has several senders.
    """

    host_ns: int
    event: E_co
    raw: bytes = b""
    waited_ns: int = 0
    refusal: Refusal | None = None
    back: Callable[[Packet], None] | None = None
    address: tuple[Any, ...] | None = None


SampleArrival: TypeAlias = Arrival[AttitudeSample]


@dataclass(frozen=True, slots=True)
class TrackerCamera:
    """The bench's tracker: its mounting, its size, and its field of view along y, degrees."""

    q_body_to_cam: FloatArray
    resolution_px: tuple[int, int]
    field_of_view_deg: float


# The picture (a PNG) of the tracker at an attitude, for a simulation that asks for it.
Pictures = Callable[[AttitudeSample], bytes]


class Link(Closing, ABC):
    """A link into hilstar, closed when its `with` ends.

    `verb` and `endpoint` say where it is ("connected to", "tcp://127.0.0.1:5560"), `conventions`
    what its numbers mean. `steps`: its simulation waits for a frame after each attitude (lockstep).
    `two_way`: packets can go back to the sender. `stamped`: times of arrival are the kernel's, or
    of a process that only reads; else they are of the thread that reads here.
    """

    steps: ClassVar[bool]
    two_way: bool = False
    stamped: bool = False
    asks_for_pictures: ClassVar[bool] = False
    verb: str
    endpoint: str
    conventions: Conventions = PACKETS

    def __init__(self, notices: Notices | None, clock: HostClock) -> None:
        self._notices = Notices() if notices is None else notices
        self._clock = clock
        self.link_counts = LinkCounts()
        self._gate = FloodGate(self.link_counts, self._notices, clock)

    @abstractmethod
    def close(self) -> None:
        """Close the link."""

    @property
    def trouble(self) -> str:
        """Why the other side gives no messages, as far as that shows: a line; "" where it does
        not.
        """
        counts = self.link_counts
        wrong_peer = self._notices.latest(WRONG_PEER)
        if wrong_peer:
            return "" if counts.connections else wrong_peer
        # who binds counts connections from their begin on, so also those that it then rejects
        is_alone = counts.connections <= counts.rejected
        if is_alone:
            return self._notices.latest(CLIENT_REJECTED)
        return ""

    def await_ready(self) -> None:
        """Wait until a sender is heard from the first read on: for a process that reads, and not
        for long.
        """


class StreamLink(Link):
    """A link whose sender runs freely."""

    steps: ClassVar[Literal[False]] = False
    bound: bool = False  # ZeroMQ's, to which any number of senders connect: none of them comes back

    @property
    def reconnects(self) -> int:
        """How often the sender came back."""
        if self.bound:
            return 0
        return max(0, self.link_counts.connections - 1)

    @abstractmethod
    def receive(self, timeout_ms: int) -> list[Arrival[Event]]:
        """The messages so far, oldest first; waits at most `timeout_ms` for the first. A lost
        peer raises nothing.
        """

    @abstractmethod
    def wait_for_message(self, timeout_ms: int) -> bool:
        """True once something unread has arrived."""

    def send(self, packet: Packet) -> None:
        """Send to the other side, never waiting; lost if there is no listener."""

    def wire_ns(self, packet: Packet) -> int:
        """How long the wire alone takes for a packet, ns; negligible on most."""
        return 0


class LockstepLink(Link):
    """A link whose sender asks for one frame at a time, and waits for the answer."""

    steps: ClassVar[Literal[True]] = True

    @abstractmethod
    def receive(self, timeout_ms: int) -> Arrival[Event] | None:
        """The next request for a frame, or None; it must be answered before the next can arrive."""

    @abstractmethod
    def answer(self, status: Status, shown_ns: int, refusal: Refusal | None) -> None:
        """Answer the request, shown at a host time; a refused one left the last frame."""

    def show_camera(self, tracker: TrackerCamera, pictures: Pictures | None) -> None:
        """What to answer a simulation that asks for its camera's pictures."""
