"""What goes back to the sender on a two-way link: statuses, time requests, and replies to its own time requests."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

from hilstar.attitude.clock.exchanges import Exchange
from hilstar.attitude.wire.links import Arrival, Link, SampleArrival
from hilstar.attitude.wire.packet import Event, Packet, Status, TimeReply, TimeRequest
from hilstar.attitude.wire.protocol import HEALTH_MISSED, HEALTH_REFUSED
from hilstar.units import NS_PER_S

FIRST_ASKS = 8  # quickly, so that the clock is soon known
QUICK_ASK_NS = NS_PER_S // 10
ASK_NS = NS_PER_S // 2
TOLD_ONCE = HEALTH_MISSED | HEALTH_REFUSED


@dataclass(frozen=True, slots=True)
class Traffic:
    """What goes back to the sender on a two-way link, and whether its clock is this machine's own."""

    status_hz: float = 0.0
    time_requests: bool = False
    shared_clock: bool = False


QUIET = Traffic()


class BackChannel:
    """Sends what is due over `link`, to the sender of the newest attitude shown where it has several.

    The receiver's thread calls it, but for `post`.
    """

    def __init__(self, link: Link, traffic: Traffic) -> None:
        self._link = link
        self._send: Callable[[Packet], None] = link.send
        self._traffic = traffic
        self._posting = threading.Lock()
        self._status: Status | None = None
        self._next_status_ns = 0
        self._asked: dict[int, TimeRequest] = {}
        self._asks = 0
        self._quick_asks = FIRST_ASKS
        self._next_ask_ns = 0

    def post(self, status: Status) -> None:
        """Take the newest status; it leaves when it is due, with the one-time health bits of those that never left."""
        with self._posting:
            if self._status is not None:
                status = replace(status, health=status.health | self._status.health & TOLD_ONCE)
            self._status = status

    def talk(self, now_ns: int, *, ask: bool) -> None:
        """Send what is due; time requests only where `ask`."""
        if ask and self._traffic.time_requests and now_ns >= self._next_ask_ns:
            self._ask(now_ns)
        if self._traffic.status_hz and self._status is not None and now_ns >= self._next_status_ns:
            with self._posting:
                status, self._status = self._status, None
            period_ns = round(NS_PER_S / self._traffic.status_hz)
            due_ns = self._next_status_ns + period_ns
            self._next_status_ns = due_ns if due_ns > now_ns else now_ns + period_ns  # never two at once, after a pause either
            self._send(status)

    def ask_quickly(self, now_ns: int) -> None:
        """Begin again with quick time requests: now there is a sender to answer."""
        self._quick_asks, self._next_ask_ns = FIRST_ASKS, now_ns

    def _ask(self, now_ns: int) -> None:
        self._asks += 1
        request = TimeRequest(self._asks, time.monotonic_ns())
        self._asked = {sequence: asked for sequence, asked in self._asked.items() if self._asks - sequence < FIRST_ASKS}
        self._asked[self._asks] = request
        self._quick_asks -= 1
        self._next_ask_ns = now_ns + (QUICK_ASK_NS if self._quick_asks > 0 else ASK_NS)
        self._send(request)

    def follow(self, arrival: SampleArrival) -> None:
        """This attitude is shown: statuses and time requests go to its sender."""
        if arrival.back is not None:
            self._send = arrival.back

    def answer(self, request: TimeRequest, arrival: Arrival[Event]) -> None:
        """Answer a sender's own time request."""
        send = self._link.send if arrival.back is None else arrival.back
        send(TimeReply(request.sequence, request.t1_ns, arrival.host_ns, time.monotonic_ns()))

    def exchange(self, reply: TimeReply, t4_ns: int, correction_ns: int) -> Exchange | None:
        """The exchange that a reply completes, its sender times made continuous; None for a reply to nothing."""
        request = self._asked.pop(reply.sequence, None)
        if request is None or request.t1_ns != reply.t1_ns:
            return None
        there_ns, back_ns = self._link.wire_ns(request), self._link.wire_ns(reply)
        return Exchange(request.t1_ns, reply.t2_ns + correction_ns, reply.t3_ns + correction_ns, t4_ns, there_ns, back_ns)
