"""What every link into hilstar offers: messages with the time of their arrival, and a way back where there is one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Generic, Protocol, Self, TypeAlias, TypeVar

from hilstar.attitude.wire.flood_limits import LinkCounts
from hilstar.attitude.wire.packet import AttitudeSample, Event, Packet, Refusal
from hilstar.attitude.wire.source import Conventions

E_co = TypeVar("E_co", bound=Event, covariant=True)


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
