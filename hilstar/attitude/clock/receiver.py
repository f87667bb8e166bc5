"""A thread that takes what a link brings, counts it, keeps the clock, answers time requests, and fills a timeline."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Protocol

from hilstar.attitude.clock.jumps import MIN_LIMIT_NS, WAITED_UNKNOWN_NS, Arrived, JumpFilter
from hilstar.attitude.clock.sender_clock import BenchClock
from hilstar.attitude.clock.senders import Repeats, Senders
from hilstar.attitude.clock.shared_clock import SharedTimes
from hilstar.attitude.clock.timeline import Timeline
from hilstar.attitude.wire.packet import (
    REASONS,
    AttitudeSample,
    Event,
    Packet,
    Reason,
    Refusal,
    Status,
    TimeReply,
    TimeRequest,
)
from hilstar.attitude.wire.protocol import HEALTH_MISSED, HEALTH_REFUSED
from hilstar.notices import Notices
from hilstar.running_statistics import RunningStatistics
from hilstar.units import NS_PER_MS, NS_PER_S

POLL_MS = 20
FIRST_ASKS = 8  # quickly, so that the clock is soon known
QUICK_ASK_NS = NS_PER_S // 10
ASK_NS = NS_PER_S // 2
TOLD_ONCE = HEALTH_MISSED | HEALTH_REFUSED
# What is found when the frames begin was there before; what comes so soon after may have been on its way through a queue.
QUEUED_NS = NS_PER_S // 10
QUEUE_NEVER_EMPTY_NS = NS_PER_S
FIRST_BACK_OFF_NS = NS_PER_S // 20
LONGEST_BACK_OFF_NS = NS_PER_S
log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Arrival:
    """One message: its arrival at the host, what it says, and its bytes as they came."""

    host_ns: int
    event: Event
    raw: bytes


class Link(Protocol):
    """What a road into hilstar offers."""

    two_way: bool

    def receive(self, timeout_ms: int) -> list[Arrival]:
        """What has come; waits at most `timeout_ms` for the first, and for no other. A lost peer raises nothing."""

    def wait_for_message(self, timeout_ms: int) -> bool:
        """True once something has come that was not read."""

    def send(self, packet: Packet) -> None:
        """Send to the bench, never waiting; lost where nobody listens."""

    def wire_ns(self, packet: Packet) -> int:
        """How long the wire alone takes for a packet."""


@dataclass(slots=True)
class PacketCounts:
    """How many attitude messages arrived, and how many of those were refused, by reason."""

    received: int = 0
    refused_by: dict[Reason, int] = field(default_factory=lambda: dict.fromkeys(REASONS, 0))

    @property
    def refused(self) -> int:
        """Messages refused, for whatever reason."""
        return sum(self.refused_by.values())


# Who wants to know of every attitude message: its arrival, its bytes, what it says, and why it was refused, if it was.
Watch = Callable[[int, bytes, AttitudeSample | None, Refusal | None], None]


def nobody_watches(host_ns: int, raw: bytes, sample: AttitudeSample | None, refusal: Refusal | None) -> None:
    """The watch of a run without a ledger."""


@dataclass(frozen=True, slots=True)
class Traffic:
    """What goes back to the bench on a two-way link, so many statuses a second and time requests; and whose clock it has."""

    status_hz: float = 0.0
    time_requests: bool = False
    shared_clock: bool = False


QUIET = Traffic()


class Receiver:
    """Runs `link` into `timeline` until closed. Nothing that arrives ends it.

    What comes before `learn` is called fills the timeline, and says little of the sender's clock.
    """

    def __init__(
        self,
        link: Link,
        timeline: Timeline,
        traffic: Traffic = QUIET,
        watch: Watch = nobody_watches,
        notices: Notices | None = None,
    ) -> None:
        self.counts = PacketCounts()
        self._notices = Notices() if notices is None else notices
        self.clock = BenchClock(shared=traffic.shared_clock)
        self.jumps = SharedTimes(self._notices) if traffic.shared_clock else JumpFilter()
        self.latency_ms = RunningStatistics()
        self._link = link
        self._timeline = timeline
        self._traffic = traffic
        self._watch = watch
        self._repeats = Repeats(self._notices)
        self._senders = Senders(timeline.stale_after_ns, self._notices)
        self._begun_ns: int | None = None
        self._learn_from_ns: int | None = None
        self._empty_ns = 0
        self._status: Status | None = None
        self._posting = threading.Lock()
        self._next_status_ns = 0
        self._asked: dict[int, TimeRequest] = {}
        self._asks = 0
        self._quick_asks = FIRST_ASKS
        self._jumps_told = 0
        self._next_ask_ns = 0
        self._stop = threading.Event()
        self._failure = ""
        self._started_ns = self._retry_ns = 0
        self._back_off_ns = FIRST_BACK_OFF_NS
        self._thread = threading.Thread(target=self._run, name="hilstar-receiver", daemon=True)

    def start(self) -> None:
        """Begin to listen."""
        self._started_ns = time.monotonic_ns()
        self._thread.start()

    def learn(self) -> None:
        """The frames begin: what comes from now on teaches the clock."""
        self._begun_ns = time.monotonic_ns()

    def tend(self) -> None:
        """Start the thread anew where it ended, and say so; for the frame loop, with each frame."""
        if self._thread.is_alive() or self._stop.is_set():
            return
        now_ns = time.monotonic_ns()
        if not self._retry_ns:
            if now_ns - self._started_ns > 10 * LONGEST_BACK_OFF_NS:
                self._back_off_ns = FIRST_BACK_OFF_NS
            self._retry_ns = now_ns + self._back_off_ns
            self._back_off_ns = min(2 * self._back_off_ns, LONGEST_BACK_OFF_NS)
            why = self._failure or "without a word"
            self._notices.tell("receiver-failed", f"the receiver of the attitudes ended ({why}); it is started again")
        if now_ns >= self._retry_ns:
            self._retry_ns, self._failure = 0, ""
            self._thread = threading.Thread(target=self._run, name="hilstar-receiver", daemon=True)
            self.start()

    def close(self) -> None:
        """Stop listening; the link itself stays the caller's."""
        self._stop.set()
        self._thread.join()

    def bench_ns(self, continuous_ns: int) -> int:
        """A time of the timeline as the bench's own clock has it."""
        return continuous_ns - self.jumps.correction_ns

    def clock_summary(self) -> dict[str, float | int | str | None]:
        """The clock's summary, its offset that of the sender's clock as it is now, after all jumps."""
        told = self.clock.summary()
        offset_ms = told["offset_ms"]
        if isinstance(offset_ms, float):
            told["offset_ms"] = offset_ms + self.jumps.correction_ns / NS_PER_MS
        uncertainty_ms = told["uncertainty_ms"]
        if self.jumps.slowness > 0 and told["mode"] == "one-way" and isinstance(uncertainty_ms, float):
            told["uncertainty_ms"] = uncertainty_ms + 2 * MIN_LIMIT_NS / NS_PER_MS  # a step, and what is missing to the next
        return told | {"jumps": self.jumps.jumps}

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                self._listen()
            self._settle(self.jumps.release())
        except BaseException as error:  # whatever it is: the display goes on, and `tend` starts another
            self._failure = f"{type(error).__name__}: {error}"

    def _listen(self) -> None:
        waits = self._link.wait_for_message(0)
        now_ns = time.monotonic_ns()
        if not waits:
            self._empty_ns = now_ns
        self._begin_to_learn(now_ns, waits)
        arrivals = self._link.receive(POLL_MS)
        for k, arrival in enumerate(arrivals):
            # The newest of those that came while this thread slept is what woke it; what else was there had to wait.
            timely = not waits and k == len(arrivals) - 1
            self._take(arrival, 0 if timely else arrival.host_ns - self._empty_ns)
        now_ns = time.monotonic_ns()
        self._settle(self.jumps.expire(now_ns))
        if self._link.two_way:
            self._talk(now_ns)

    def _begin_to_learn(self, now_ns: int, waits: bool) -> None:
        begun_ns = self._begun_ns
        if begun_ns is None or self._learn_from_ns is not None:
            return
        if not waits or now_ns - begun_ns > QUEUE_NEVER_EMPTY_NS:
            self._learn_from_ns = now_ns + QUEUED_NS

    def _take_sample(self, sample: AttitudeSample, arrival: Arrival, waited_ns: int) -> None:
        host_ns, raw = arrival.host_ns, arrival.raw
        refusal = self._repeats.judge(sample, host_ns, raw) or self._senders.judge(sample, host_ns, waited_ns)
        if refusal is not None:
            self._refuse(host_ns, raw, sample, refusal)
            return
        if self._repeats.resumed():
            self.jumps.forgive()
        if self._learn_from_ns is None or host_ns < self._learn_from_ns:
            waited_ns = WAITED_UNKNOWN_NS
        elif self.clock.unheard:
            self._quick_asks, self._next_ask_ns = FIRST_ASKS, host_ns  # now somebody is there to answer
        self.jumps.clock_known = self.clock.synchronised
        self._settle(self.jumps.take(Arrived(sample, host_ns, raw, None, waited_ns)))
        if not self.clock.synchronised:
            self._tell_pace(self.jumps.slowness)

    def _tell_pace(self, slowness: float) -> None:
        if not slowness:
            return
        detail = f"t_ns goes on at {1 - slowness:.3g} of real time; it is followed in small steps"
        if slowness > 0:
            detail += " (a slow clock, or a road that cannot carry all packets)"
        self._notices.begin("source-slow" if slowness > 0 else "source-fast", detail)

    def _take(self, arrival: Arrival, waited_ns: int) -> None:
        match arrival.event:
            case AttitudeSample() as sample:
                self.counts.received += 1
                self._take_sample(sample, arrival, waited_ns)
            case TimeRequest(sequence, t1_ns) if self._link.two_way:
                self._link.send(TimeReply(sequence, t1_ns, arrival.host_ns, time.monotonic_ns()))
            case TimeReply() as reply if self._link.two_way:
                self._take_reply(reply, arrival.host_ns)
            case Refusal() as refusal:
                self.counts.received += 1
                self._refuse(arrival.host_ns, arrival.raw, None, refusal)
            case other:
                self.counts.received += 1
                refusal = Refusal("format", f"a {type(other).__name__} packet, which says nothing on this road")
                self._refuse(arrival.host_ns, arrival.raw, None, refusal)

    def _settle(self, decided: list[Arrived]) -> None:
        jumps = self.jumps.jumps
        for arrived in decided:
            sample, host_ns = arrived.sample, arrived.host_ns
            refusal = arrived.refusal or self._timeline.add(sample, host_ns)
            if refusal is not None:
                self._refuse(host_ns, arrived.raw, sample, refusal)
                continue
            if arrived.waited_ns == WAITED_UNKNOWN_NS:
                self.clock.guess(sample.t_ns, host_ns)
            else:
                if arrived.timely:
                    self.clock.observe(sample.t_ns, host_ns)
                latency_ns = self.clock.latency_ns(sample.t_ns, host_ns)
                self.latency_ms.add((latency_ns or 0.0) / NS_PER_MS)
            self._watch(host_ns, arrived.raw, sample, None)
        if jumps > self._jumps_told:
            self._jumps_told = jumps
            self.clock.widen(self.jumps.spread_ns)
            total_s = self.jumps.correction_ns / NS_PER_S
            self._notices.tell("jump", f"the sender's clock jumped: {total_s:.3f} s in all; its stream is carried on")

    def _refuse(self, host_ns: int, raw: bytes, sample: AttitudeSample | None, refusal: Refusal) -> None:
        self.counts.refused_by[refusal.reason] += 1
        if self.counts.refused_by[refusal.reason] == 1:
            log.warning("packet refused (%s): %s; further ones are only counted", refusal.reason, refusal.detail)
        self._watch(host_ns, raw, sample, refusal)

    def post(self, status: Status) -> None:
        """The newest status; it leaves when its turn comes, with what those that never left had to tell once."""
        with self._posting:
            if self._status is not None:
                status = replace(status, health=status.health | self._status.health & TOLD_ONCE)
            self._status = status

    def _talk(self, now_ns: int) -> None:
        if self._traffic.time_requests and self._learn_from_ns is not None and now_ns >= self._next_ask_ns:
            self._ask(now_ns)
        if self._traffic.status_hz and self._status is not None and now_ns >= self._next_status_ns:
            with self._posting:
                status, self._status = self._status, None
            self._next_status_ns = max(self._next_status_ns + round(NS_PER_S / self._traffic.status_hz), now_ns)
            self._link.send(status)

    def _ask(self, now_ns: int) -> None:
        self._asks += 1
        request = TimeRequest(self._asks, time.monotonic_ns())
        self._asked = {sequence: asked for sequence, asked in self._asked.items() if self._asks - sequence < FIRST_ASKS}
        self._asked[self._asks] = request
        self._quick_asks -= 1
        self._next_ask_ns = now_ns + (QUICK_ASK_NS if self._quick_asks > 0 else ASK_NS)
        self._link.send(request)

    def _take_reply(self, reply: TimeReply, t4_ns: int) -> None:
        request = self._asked.pop(reply.sequence, None)
        if request is None or request.t1_ns != reply.t1_ns:
            return
        correction_ns = self.jumps.correction_ns
        bench_ns = (reply.t2_ns + correction_ns, reply.t3_ns + correction_ns)
        wire_ns = (self._link.wire_ns(request), self._link.wire_ns(reply))
        self.clock.exchange((request.t1_ns, t4_ns), bench_ns, wire_ns)
