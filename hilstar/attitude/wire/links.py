"""The contract of every link into hilstar: a road, a decoder of its bytes, and limits against
floods.

On its way in a packet is first a `RawMessage`, as it arrived; once decoded it is an `Arrival`, with
an event such as an `AttitudeSample`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Literal, TypeAlias, TypeVar

from hilstar.attitude.wire.packet import (
    AttitudeSample,
    Event,
    Packet,
    Refusal,
    Status,
    declares_discontinuity,
    decode,
)
from hilstar.attitude.wire.roads import PAUSE_S, ByteRoad, LinkCounts, RawMessage
from hilstar.attitude.wire.source import AS_SENT, PACKETS, Conventions, SentAttitudes
from hilstar.basics.notices import Notices
from hilstar.basics.process.closing import Closing
from hilstar.basics.process.scheduling import HOST_CLOCK, HostClock
from hilstar.basics.units import NS_PER_S

if TYPE_CHECKING:
    from hilstar.basics.arrays import FloatArray

MAX_PACKETS_PER_S = 3000  # decoded: some 10 % of one core, and more than any serial line carries
MAX_BURST = 1000  # as many as may have waited while the receiver was stopped
OVER_NS = NS_PER_S  # a flood is over once no packet has been dropped for this long
# Dropped packets that are searched for a discontinuity: a sender declares each only once.
MAX_LOOKED_AT = 1000
E_co = TypeVar("E_co", bound=Event, covariant=True)


class FloodGate:
    """Admits at most MAX_PACKETS_PER_S messages per second, and MAX_BURST at once, always the
    newest. The others are dropped unread; they are counted, and a notice says so.
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
        """The newest of the `waiting` messages, as many as may be decoded now, both oldest first.
        Sleeps for PAUSE_S where it drops others.

        Of the dropped messages the newest whose last part declares a discontinuity is returned too,
        as no attitude may be interpolated across it.
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


@dataclass(frozen=True, slots=True)
class Arrival(Generic[E_co]):
    """A message that arrived: the host time of its arrival, ns, the event that it means, its bytes
    as received, and how long it may have waited unread, ns.

    `refusal` says why an attitude is not used. Where a link has several senders, `back` sends a
    packet to the sender of this message, whose address is `address`.
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
    """The camera of the bench's tracker: its mounting, a unit quaternion (4,), the number of its
    pixels (x, y), and its field of view along y, degrees.
    """

    q_body_to_cam: FloatArray
    resolution_px: tuple[int, int]
    field_of_view_deg: float


# Gives the tracker's image (a PNG) at an attitude, for a simulation that asks for it.
Pictures = Callable[[AttitudeSample], bytes]


class Decoder:
    """Divides the bytes of a road into messages, and decodes these into events.

    `conventions` say what the numbers in messages mean. `stamped`: messages carry their own times
    of arrival.
    """

    stamped: ClassVar[bool] = False
    conventions: Conventions = PACKETS

    def begin(self) -> None:
        """Discard an incomplete message, as the road was opened anew."""

    def whole(self, chunk: RawMessage) -> list[RawMessage]:
        """The messages that a chunk completes, in order."""
        return [chunk]

    def declares_discontinuity(self, message: bytes) -> bool:
        """Whether a message states that no attitude may be interpolated across it."""
        return False

    def arrivals(self, messages: Iterable[RawMessage]) -> list[Arrival[Event]]:
        """The arrivals that whole messages are decoded to, in their order."""
        return [self._arrival(message) for message in messages]

    def _arrival(self, message: RawMessage) -> Arrival[Event]:
        raw = message.parts[-1]
        return Arrival(message.host_ns, self.event(raw), raw, message.waited_ns)

    def event(self, message: bytes) -> Event:
        """The event that a whole message means; a `Refusal` where it cannot be read."""
        raise NotImplementedError


def pieces(chunk: RawMessage, messages: list[bytes]) -> list[RawMessage]:
    """The messages that a chunk completed, each with the chunk's stamp. The stamp is that of the
    chunk's last byte, so all messages but the last may have waited, and are not `timely`.
    """
    return [
        chunk._replace(parts=[message], timely=chunk.timely and k == len(messages))
        for k, message in enumerate(messages, 1)
    ]


class PacketDecoder(Decoder):
    """Decodes packets or JSON, of which each message is a whole one; of a message of several parts
    only the last counts.
    """

    def __init__(self, sent: SentAttitudes = AS_SENT) -> None:
        self.conventions = sent.conventions
        self._decode = sent.decoder(decode)

    def declares_discontinuity(self, message: bytes) -> bool:
        """See `Decoder.declares_discontinuity`."""
        return declares_discontinuity(message)

    def event(self, message: bytes) -> Event:
        """See `Decoder.event`."""
        return self._decode(message)


class Link(Closing, ABC):
    """A road into hilstar with a decoder of its messages; it is closed when its `with` ends.

    `verb` and `endpoint` say where it is ("connected to", "tcp://127.0.0.1:5560"), `conventions`
    what its numbers mean. `steps`: its simulation waits for a frame after each attitude (lockstep).
    `two_way`: packets can be sent back to the sender. `stamped`: the kernel, or a process that only
    reads, stamps arrivals; otherwise the thread that reads here does.
    """

    steps: ClassVar[bool]
    two_way: bool = False
    asks_for_pictures: ClassVar[bool] = False

    def __init__(self, road: ByteRoad, conventions: Conventions) -> None:
        self._road = road
        self.conventions = conventions
        self._notices = road.notices
        self._clock = road.clock

    @property
    def verb(self) -> str:
        """What the road does with its endpoint, such as "connected to"."""
        return self._road.verb

    @property
    def endpoint(self) -> str:
        """The road's endpoint, such as "tcp://127.0.0.1:5560"."""
        return self._road.endpoint

    @property
    def link_counts(self) -> LinkCounts:
        """The road's counts of connections and messages."""
        return self._road.link_counts

    @property
    def stamped(self) -> bool:
        """Whether arrivals are stamped however busy this process is."""
        return self._road.stamped

    @property
    def trouble(self) -> str:
        """A line that says why the other side sends no usable messages; "" where nothing shows
        that.
        """
        return self._road.trouble

    def await_ready(self) -> None:
        """See `ByteRoad.await_ready`."""
        self._road.await_ready()

    def close(self) -> None:
        """Close the link."""
        self._road.close()


class MessageLink(Link):
    """A link that puts messages together from the pieces of bytes that its road brings."""

    def __init__(self, road: ByteRoad, decoder: Decoder) -> None:
        super().__init__(road, decoder.conventions)
        self._decoder = decoder
        self._opening = road.openings

    @property
    def stamped(self) -> bool:
        """See `Link.stamped`."""
        return self._road.stamped or self._decoder.stamped

    def messages(self, timeout_ms: int) -> list[RawMessage]:
        """The messages that are complete by now, not decoded, oldest first; waits at most
        `timeout_ms` for the first bytes.
        """
        whole: list[RawMessage] = []
        for chunk in self._road.taken(timeout_ms):
            whole += self._decoder.whole(chunk)
        if self._road.openings != self._opening:
            again = self._opening > 0
            self._opening = self._road.openings
            if again:
                self._begin()
        return whole

    def _begin(self) -> None:
        """Begin again with the decoder, as the road was opened anew."""
        self._decoder.begin()


class StreamLink(MessageLink):
    """A link whose sender runs freely, without waiting for answers."""

    steps: ClassVar[Literal[False]] = False

    def __init__(self, road: ByteRoad, decoder: Decoder) -> None:
        super().__init__(road, decoder)
        self._gate = FloodGate(road.link_counts, road.notices, road.clock)

    @property
    def reconnects(self) -> int:
        """How often the sender came back."""
        return self._road.reconnects

    def receive(self, timeout_ms: int) -> list[Arrival[Event]]:
        """The arrivals since the last call, oldest first, and of a flood only the newest; waits at
        most `timeout_ms` for the first. A lost peer raises nothing.
        """
        return self._decoder.arrivals(self.taken(timeout_ms))

    def taken(self, timeout_ms: int) -> list[RawMessage]:
        """The same messages as `receive`, not decoded."""
        return self._gate.newest(self.messages(timeout_ms), self._decoder.declares_discontinuity)

    def wait_for_message(self, timeout_ms: int) -> bool:
        """True once something unread has arrived, False after `timeout_ms` without it."""
        return self._road.wait_for_message(timeout_ms)

    def send(self, packet: Packet) -> None:
        """Send a packet to the other side without waiting; it is lost if nobody listens."""

    def wire_ns(self, packet: Packet) -> int:
        """How long a packet takes on the wire itself, ns; 0 on links where that is negligible."""
        return 0


class LockstepLink(Link):
    """A link whose sender asks for one frame at a time, and waits for the answer."""

    steps: ClassVar[Literal[True]] = True

    @abstractmethod
    def receive(self, timeout_ms: int) -> Arrival[Event] | None:
        """The next request for a frame, or None; it must be answered before the next can arrive."""

    @abstractmethod
    def answer(self, status: Status, shown_ns: int, refusal: Refusal | None) -> None:
        """Answer the request, whose frame was shown at the host time `shown_ns`. With a `refusal`
        the request changed nothing, and the last frame stayed.
        """

    def show_camera(self, tracker: TrackerCamera, pictures: Pictures | None) -> None:
        """Set what to answer a simulation that asks for its camera's images."""
