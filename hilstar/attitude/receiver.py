"""The receiver thread of a live stream: link to timeline, with the sender's clock kept and the
sender answered.

`BackChannel` sends what a two-way link carries back: statuses, time requests, and replies to the
sender's own time requests.
"""

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal

from hilstar.attitude.clock.jumps import (
    MIN_LIMIT_NS,
    WAITED_UNKNOWN_NS,
    JumpFilter,
    KnownClockFilter,
)
from hilstar.attitude.clock.losses import LossCount, TimeUnit
from hilstar.attitude.clock.rate_causes import AS_PACKETS, ReadAs
from hilstar.attitude.clock.rate_check import RateCheck, WrongRates
from hilstar.attitude.clock.resolution import Resolution
from hilstar.attitude.clock.sender_clock import ClockSummary, Exchange, SenderClock
from hilstar.attitude.clock.senders import Senders
from hilstar.attitude.clock.stages import Each, Stages, StreamState
from hilstar.attitude.clock.timeline import Timeline
from hilstar.attitude.wire import packet as wire
from hilstar.attitude.wire.links import Arrival, SampleArrival, StreamLink
from hilstar.attitude.wire.protocol import HEALTH_MISSED, HEALTH_REFUSED
from hilstar.basics.notices import Notices
from hilstar.basics.process.scheduling import HOST_CLOCK, UNDISCIPLINED_NS, UnixOffset
from hilstar.basics.running_statistics import RunningStatistics
from hilstar.basics.units import NS_PER_MS, NS_PER_S

FIRST_ASKS = 8  # quickly, so that the clock is soon known
QUICK_ASK_NS = NS_PER_S // 10
ASK_NS = NS_PER_S // 2  # after the FIRST_ASKS
TOLD_ONCE = HEALTH_MISSED | HEALTH_REFUSED
POLL_MS = 20
MAX_PASSED_ON = 10
# Messages found when the frames begin were there before; those that arrive this soon after may have
# queued on the way.
QUEUED_NS = NS_PER_S // 10
QUEUE_NEVER_EMPTY_NS = NS_PER_S
KNOWN_AGAIN_NS = NS_PER_S // 5  # how soon a step of this machine's clock of Unix time is followed
SAME_CLOCK = UnixOffset(0, 0)
UNDISCIPLINED = "clock-undisciplined"
UNDISCIPLINED_LINE = (
    '[attitude] clock = "unix", but nothing keeps this machine\'s clock: the kernel states an error'
    ' of 16 s; start chronyd, ntpd or phc2sys, or write clock = "estimated"'
)
MIN_BACK_OFF_NS = NS_PER_S // 20
MAX_BACK_OFF_NS = NS_PER_S


@dataclass(frozen=True, slots=True)
class Traffic:
    """What goes back to the sender on a two-way link, and what its clock is: estimated, this
    machine's own, or Unix time.
    """

    status_hz: float = 0.0
    time_requests: bool = False
    clock: Literal["estimated", "shared", "unix"] = "estimated"


QUIET = Traffic()


class BackChannel:
    """Sends what is due over `link`, to the sender of the newest attitude shown where it has
    several.

    The receiver's thread calls it, but for `post` and `pass_on`.
    """

    def __init__(
        self, link: StreamLink, traffic: Traffic, now_ns: Callable[[], int] = HOST_CLOCK.now_ns
    ) -> None:
        self._link = link
        self._now_ns = now_ns
        self._send: Callable[[wire.Packet], None] = link.send
        self._traffic = traffic
        self._posting = threading.Lock()
        self._status: wire.Status | None = None
        self._answers: deque[wire.AnswerPacket] = deque(maxlen=MAX_PASSED_ON)
        self._next_status_ns = 0
        self._asked: dict[int, wire.TimeRequest] = {}
        self._asks = 0
        self._quick_asks = FIRST_ASKS
        self._next_ask_ns = 0

    def post(self, status: wire.Status) -> None:
        """Take the newest status; it leaves when it is due, with the one-time health bits of
        those that never left.
        """
        with self._posting:
            if self._status is not None:
                status = replace(status, health=status.health | self._status.health & TOLD_ONCE)
            self._status = status

    def pass_on(self, answer: wire.AnswerPacket) -> None:
        """Take an answer of the tracker; it leaves at once. The oldest of more than
        MAX_PASSED_ON is dropped.
        """
        self._answers.append(answer)

    def talk(self, now_ns: int, *, ask: bool) -> None:
        """Send what is due; time requests only where `ask`."""
        if ask and self._traffic.time_requests and now_ns >= self._next_ask_ns:
            self._asks += 1
            request = wire.TimeRequest(self._asks, self._now_ns())
            self._asked = {
                sequence: asked
                for sequence, asked in self._asked.items()
                if self._asks - sequence < FIRST_ASKS
            }
            self._asked[self._asks] = request
            self._quick_asks -= 1
            pause_ns = QUICK_ASK_NS if self._quick_asks > 0 else ASK_NS
            self._next_ask_ns = now_ns + pause_ns
            self._send(request)
        while self._answers:
            self._send(self._answers.popleft())
        if self._traffic.status_hz and self._status is not None and now_ns >= self._next_status_ns:
            with self._posting:
                status = self._status
                self._status = None
            period_ns = round(NS_PER_S / self._traffic.status_hz)
            due_ns = self._next_status_ns + period_ns
            # never two at once, after a pause either
            self._next_status_ns = due_ns if due_ns > now_ns else now_ns + period_ns
            self._send(status)

    def ask_quickly(self, now_ns: int) -> None:
        """Begin again with quick time requests: now there is a sender to answer."""
        self._quick_asks = FIRST_ASKS
        self._next_ask_ns = now_ns

    def follow(self, arrival: SampleArrival) -> None:
        """This attitude is shown: statuses and time requests go to its sender."""
        if arrival.back is not None:
            self._send = arrival.back

    def answer(self, request: wire.TimeRequest, arrival: Arrival[wire.Event]) -> None:
        """Answer a sender's own time request."""
        send = self._link.send if arrival.back is None else arrival.back
        send(wire.TimeReply(request.sequence, request.t1_ns, arrival.host_ns, self._now_ns()))

    def exchange(self, reply: wire.TimeReply, t4_ns: int, correction_ns: int) -> Exchange | None:
        """The exchange that a reply completes, its sender times made continuous; None for a
        reply to nothing.
        """
        request = self._asked.get(reply.sequence)
        if request is None or request.t1_ns != reply.t1_ns:
            return None
        del self._asked[reply.sequence]
        there_ns = self._link.wire_ns(request)
        back_ns = self._link.wire_ns(reply)
        return Exchange(
            request.t1_ns,
            reply.t2_ns + correction_ns,
            reply.t3_ns + correction_ns,
            t4_ns,
            there_ns,
            back_ns,
        )


@dataclass(slots=True)
class PacketCounts:
    """How many attitude messages arrived, how many of those were refused, by reason, and how many
    were lost on the way.

    `shown` is what was sent instead, by reason, where the bytes of the first refused message showed
    it.
    """

    received: int = 0
    lost: int = 0
    refused_by: dict[wire.Reason, int] = field(
        default_factory=lambda: dict.fromkeys(wire.REASONS, 0)
    )
    shown: dict[wire.Reason, str] = field(default_factory=dict)

    def refuse(self, refusal: wire.Refusal) -> bool:
        """Count a refused message; True for the first of its reason."""
        self.refused_by[refusal.reason] += 1
        first = self.refused_by[refusal.reason] == 1
        if first and refusal.telling:
            self.shown[refusal.reason] = refusal.detail
        return first

    @property
    def refused(self) -> int:
        """Messages refused, for whatever reason."""
        return sum(self.refused_by.values())


# Called for every attitude message with its arrival, its bytes, what it says, and why it was
# refused, if it was.
Watch = Callable[[int, bytes, wire.AttitudeSample | None, wire.Refusal | None], None]


class Receiver:
    """Runs `link` into `timeline` until closed, on a thread of its own. Nothing that arrives ends
    it. `back` leads back.

    What arrives before `learn` is called fills the timeline, and teaches the clock little. `now_ns`
    is the host's clock. `read_as` is how the link has read quaternions. `tell_lost` is called with
    a number of packets once it is clear that they never came.
    """

    def __init__(
        self,
        link: StreamLink,
        timeline: Timeline,
        traffic: Traffic = QUIET,
        watch: Watch = lambda host_ns, raw, sample, refusal: None,
        notices: Notices | None = None,
        *,
        wrong_rates: WrongRates = "use-quaternions",
        read_as: ReadAs = AS_PACKETS,
        now_ns: Callable[[], int] = HOST_CLOCK.now_ns,
        unix_offset: Callable[[], UnixOffset] = HOST_CLOCK.unix_offset,
    ) -> None:
        self.counts = PacketCounts()
        self._now_ns = now_ns
        self._notices = Notices() if notices is None else notices
        self._unix_offset = unix_offset if traffic.clock == "unix" else None
        self._known_ns = 0
        self._state = StreamState()
        if traffic.clock == "estimated":
            self.clock = SenderClock()
            self.jumps: JumpFilter | KnownClockFilter = JumpFilter(self.clock, self._state)
        else:
            if self._unix_offset is None:
                known = SAME_CLOCK
            else:
                known = self._unix_offset()
            self.clock = SenderClock(known, traffic.clock)
            self.jumps = KnownClockFilter(self._notices, self.clock)
        self.latency_ms = RunningStatistics()
        self._link = link
        self._timeline = timeline
        self.back = BackChannel(link, traffic, now_ns)
        self._watch = watch
        self._rates = RateCheck(wrong_rates, self._notices, read_as=read_as)
        self._unit, self._resolution = TimeUnit(self._notices), Resolution(self._notices.tell)
        self._losses = LossCount()
        self.tell_lost: Callable[[int], None] = lambda number: None
        self._lost_told = self._lost_before = self._lost_look_ns = 0
        senders = Senders(timeline.policy.stale_after_ns, self._notices, self._state)
        stages = (Each(self._arrived), senders, Each(self._is_of_sender_shown), self.jumps)
        self._stages = Stages(stages, self._settle)
        self._begun_ns: int | None = None
        self._learn_from_ns: int | None = None
        self._empty_ns = 0
        self._jumps_told = 0
        self._stop = threading.Event()
        self._failure = ""
        self._started_ns = self._retry_ns = 0
        self._back_off_ns = MIN_BACK_OFF_NS

    def start(self) -> None:
        """Begin to listen."""
        self._thread = threading.Thread(target=self._run, name="hilstar-receiver", daemon=True)
        self._started_ns = self._now_ns()
        self._thread.start()

    def learn(self) -> None:
        """The frames begin: what arrives from now on teaches the clock."""
        self._begun_ns = self._now_ns()

    def tend(self) -> None:
        """Restart the thread where it ended, and say so; for the frame loop, with each frame."""
        if self._thread.is_alive() or self._stop.is_set():
            return
        now_ns = self._now_ns()
        if not self._retry_ns:
            if now_ns - self._started_ns > 10 * MAX_BACK_OFF_NS:
                self._back_off_ns = MIN_BACK_OFF_NS
            self._retry_ns = now_ns + self._back_off_ns
            self._back_off_ns = min(2 * self._back_off_ns, MAX_BACK_OFF_NS)
            why = self._failure or "no reason given"
            self._notices.tell(
                "receiver-failed", f"the attitude receiver stopped ({why}); restarting it"
            )
        if now_ns >= self._retry_ns:
            self._retry_ns = 0
            self._failure = ""
            self.start()

    def close(self) -> None:
        """Stop listening; the caller closes the link."""
        self._stop.set()
        self._thread.join()

    def clock_summary(self) -> ClockSummary:
        """The clock's summary, its offset that of the sender's clock as it is now, after all
        jumps.
        """
        summary = replace(self.clock.summary(), jumps=self.jumps.jumps)
        if summary.offset_ms is not None:
            summary = replace(
                summary, offset_ms=summary.offset_ms + self.jumps.correction_ns / NS_PER_MS
            )
        if (
            self.jumps.slowness > 0
            and summary.mode == "one-way"
            and summary.uncertainty_ms is not None
        ):
            behind_ms = 2 * MIN_LIMIT_NS / NS_PER_MS  # one step, and the way to the next
            summary = replace(summary, uncertainty_ms=summary.uncertainty_ms + behind_ms)
        return summary

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                self.listen()
            self.release()
        except BaseException as error:
            # whatever it is: the display continues, and `tend` restarts this
            self._failure = f"{type(error).__name__}: {error}"

    def release(self) -> None:
        """Take the samples still in doubt: no more will come to decide them."""
        self._stages.release()
        self._tell_clock()
        self._settle_losses(self.counts.lost)

    def _settle_losses(self, lost: int) -> None:
        """Hand on those losses that are old enough: a late packet is none."""
        if lost > self._lost_told:
            self.tell_lost(lost - self._lost_told)
            self._lost_told = lost

    def listen(self) -> None:
        """Take what the link brings within POLL_MS. The thread calls this in a loop."""
        waits = self._link.wait_for_message(0)
        now_ns = self._now_ns()
        if self._unix_offset is not None and now_ns - self._known_ns >= KNOWN_AGAIN_NS:
            self._known_ns, known = now_ns, self._unix_offset()
            self.clock.know(known)
            self._doubt(known)
        if not waits:
            self._empty_ns = now_ns
        begun_ns = self._begun_ns
        if (
            begun_ns is not None
            and self._learn_from_ns is None
            and (not waits or now_ns - begun_ns > QUEUE_NEVER_EMPTY_NS)
        ):
            self._learn_from_ns = now_ns + QUEUED_NS
        arrivals = self._link.receive(POLL_MS)
        for k, arrival in enumerate(arrivals):
            # The newest of those that arrived while this thread slept woke it; the others had to
            # wait.
            timely = not waits and k == len(arrivals) - 1
            if self._link.stamped:
                waited_ns = arrival.waited_ns
            elif timely:
                waited_ns = 0
            else:
                waited_ns = arrival.host_ns - self._empty_ns
            self._take(arrival, waited_ns)
        now_ns = self._now_ns()
        self._state.busy = bool(arrivals)
        self._stages.expire(now_ns)
        self._tell_clock()
        if now_ns - self._lost_look_ns >= NS_PER_S:
            self._settle_losses(min(self._lost_before, self.counts.lost))
            self._lost_before = self.counts.lost
            self._lost_look_ns = now_ns
        if self._link.two_way:
            self.back.talk(now_ns, ask=self._learn_from_ns is not None)

    def _doubt(self, known: UnixOffset) -> None:
        """Say while nothing keeps this machine's clock of Unix time."""
        if known.error_ns < UNDISCIPLINED_NS:
            self._notices.end(
                UNDISCIPLINED,
                "clock-disciplined",
                "this machine's clock of Unix time is kept again",
            )
        else:
            self._notices.begin(UNDISCIPLINED, UNDISCIPLINED_LINE)

    def _take(self, arrival: Arrival[wire.Event], waited_ns: int) -> None:
        match arrival.event:
            case wire.TimeRequest() as request if self._link.two_way:
                self.back.answer(request, arrival)
            case wire.TimeReply() as reply if self._link.two_way:
                exchange = self.back.exchange(reply, arrival.host_ns, self.jumps.correction_ns)
                if exchange is not None:
                    self.clock.exchange(exchange)
            case wire.AttitudeSample() as sample:
                self.counts.received += 1
                self._stages.take(
                    Arrival(
                        arrival.host_ns,
                        sample,
                        arrival.raw,
                        waited_ns,
                        back=arrival.back,
                        address=arrival.address,
                    )
                )
                self._tell_clock()
            case wire.Refusal() as refusal:
                self.counts.received += 1
                self._refuse(arrival, refusal)
            case other:
                self.counts.received += 1
                detail = f"a {type(other).__name__} packet is not an attitude"
                self._refuse(arrival, wire.Refusal("format", detail))

    def _arrived(self, arrival: SampleArrival) -> SampleArrival:
        """Look at the time of any sender's message."""
        self._unit.see(arrival.event.t_ns, arrival.host_ns)
        return arrival

    def _is_of_sender_shown(self, arrival: SampleArrival) -> SampleArrival:
        """Look at a message of the sender shown, whose times are still its own: rates are seen
        here, and believed where the sample is shown.
        """
        self._resolution.see(arrival.event)
        self._rates.see(arrival.event, arrival.host_ns)
        self._losses.see(arrival.event.sequence)
        if self._learn_from_ns is None or arrival.host_ns < self._learn_from_ns:
            return replace(arrival, waited_ns=WAITED_UNKNOWN_NS)
        if self.clock.unheard:
            self.back.ask_quickly(arrival.host_ns)
        return arrival

    def _settle(self, arrival: SampleArrival) -> None:
        """Show a sample that has passed all stages, or count it as refused."""
        sample = arrival.event
        host_ns = arrival.host_ns
        refusal = arrival.refusal or self._timeline.add(self._rates.believed(sample), host_ns)
        if refusal is not None:
            self._refuse(arrival, refusal)
            return
        self.back.follow(arrival)
        if arrival.waited_ns != WAITED_UNKNOWN_NS:
            latency_ns = self.clock.latency_ns(sample.t_ns, host_ns)
            self.latency_ms.add((latency_ns or 0.0) / NS_PER_MS)
        self._watch(host_ns, arrival.raw, sample, None)

    def _tell_clock(self) -> None:
        """Count what was lost so far; say where the sender's clock has jumped, or runs at another
        pace.
        """
        self.counts.lost = self._losses.lost
        if self.jumps.jumps > self._jumps_told:
            self._jumps_told = self.jumps.jumps
            # what makes its times continuous is the jump, the other way
            total_s = -self.jumps.correction_ns / NS_PER_S
            self._notices.tell(
                "jump",
                f"the sender's clock jumped, by {total_s:.3f} s in all so far; its stream"
                " continues",
            )
        slowness = self.jumps.slowness
        if slowness and not self.clock.synchronised and not self._unit.named:
            detail = (
                f"t_ns runs at {1 - slowness:.3g} times real time; it is followed in small steps"
            )
            if slowness > 0:
                detail += " (a slow clock, or a link too slow for all packets)"
            self._notices.begin("source-slow" if slowness > 0 else "source-fast", detail)

    def _refuse(self, arrival: Arrival[wire.Event], refusal: wire.Refusal) -> None:
        if self.counts.refuse(refusal):
            line = (
                f"packet refused ({refusal.reason}): {refusal.detail}; further ones are only"
                " counted"
            )
            self._notices.mention("refused", line)
        if isinstance(arrival.event, wire.AttitudeSample):
            sample = arrival.event
        else:
            sample = None
        self._watch(arrival.host_ns, arrival.raw, sample, refusal)
