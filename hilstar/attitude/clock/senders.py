"""Who sends: a sender that hangs or whose clock has stopped, and a second sender on the same link;
no I/O.

A sender that gives its number (`AttitudeSample.sender`) is known by it, and over UDP one without a
number by its address and port. Any other is known by its counter alone: with each message
`sequence` and `t_ns` advance as they did before.

Laws:
0. A message of another number, or without one of another address, than the sender shown is a
   second sender's: it is refused until the first has been silent for `stale_after_ms`. The laws
   below are for messages of one number or one address, and for links that show neither.
1. A message that continues the counter shown is taken. So is a late one, whose count is missing;
   the timeline refuses it where it is old. A repeated one is refused.
2. Any other message is held. Where the counter shown goes on, it is refused; and there are two
   senders once a second counter has run for MIN_RUN messages.
3. Where the counter shown is silent for longer than it usually is, a counter that has run for
   MIN_RUN messages is the same sender's, begun anew, and is released. Any is after
   `stale_after_ms`.
4. A sender whose counts fit no counter, or advance by ever other steps, is taken whole, until one
   counter has run evenly for REGULAR_AFTER messages.
"""

import math
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, NamedTuple

from hilstar.attitude.clock.stages import StreamState
from hilstar.attitude.wire.links import SampleArrival
from hilstar.attitude.wire.packet import U32, AttitudeSample, Refusal
from hilstar.basics.notices import Notices
from hilstar.basics.units import NS_PER_MS, NS_PER_S

SECOND, FROZEN = "second-sender", "source-frozen"
MIN_REPEATS = 10  # and
MIN_REPEATED_NS = NS_PER_S // 4
MIN_RUN = 3  # messages: a counter, and no stray
# messages: from then on the counter shown decides at once what is not its own
ESTABLISHED_AFTER = 8
# other counters begun, and no fewer than the messages of the one shown: there is no counter
MAX_BEGUN = 3
REGULAR_AFTER = 16  # messages, before it is known whether a counter runs evenly
# share of steps that are as the one before: 0.5 where 3 of 10 packets are lost, 0.05 where 9 are
REGULAR_SHARE, IRREGULAR_SHARE = 0.5, 0.25
OTHER_LIFE_NS = 5 * NS_PER_S
MAX_OTHERS = 4
RECENT = 4096  # counts: an older message is not known again
AWAITED_SHARE = 0.25  # of a period: how far a message is from the very time that its count has
# from message to message t_ns may run ahead of the host's clock, or go back, by this and be one's
EARLY_NS = 50 * NS_PER_MS
MAX_FIRST_LOSSES = 16  # packets missing, while their period is not known yet
MAX_QUEUED_NS = NS_PER_S // 4  # as much is counted at once where messages come in bursts
MAX_STEP_NS = 10 * NS_PER_S  # between two messages, for their period
MIN_KNOWN, MIN_KNOWN_NS = 8, NS_PER_S  # before a sender's usual silences are known
USUAL_SILENCES, SLACK_NS = 3, 20 * NS_PER_MS
FORGETS = 0.98  # decay of a silence with each message
PERIOD_GAIN = EVEN_GAIN = 1 / 8  # each message's weight in the running means

# a number, or an address and port; None where a message shows neither
Identity = int | tuple[Any, ...] | None


def _steps(before: int, sequence: int) -> int:
    """The advance of `sequence`, modulo 2^32, the shorter way."""
    return (sequence - before + U32 // 2) % U32 - U32 // 2


class _Taken(NamedTuple):
    sequence: int
    t_ns: int


class _Wrap(NamedTuple):
    """Where a sender's counter began anew: what comes after `last` is `first`."""

    last: int
    first: int


@dataclass(slots=True)
class _Counter:
    """One sender: its newest message, and how its messages advance."""

    sequence: int
    t_ns: int
    host_ns: int
    waited_ns: int
    raw: bytes
    first: int
    since_ns: int
    count_t_ns: int  # of the newest message that counts
    heard: int = 1
    period_ns: float | None = None  # step of t_ns for each count
    step: int = 1  # the newest advance of the count
    even_share: float = 1.0  # recent share of steps that are as the one before
    silence_ns: float = 0.0  # recent silence between messages
    shown: bool = False
    repeats: bool = False  # several messages have one count; so have all of one that does not count
    mixes: bool = False  # it mixes in messages that do not count, whose sequence is 0
    wrap: _Wrap | None = None
    taken: dict[int, _Taken] = field(default_factory=dict)

    @classmethod
    def of(cls, arrival: SampleArrival) -> "_Counter":
        sample = arrival.event
        counter = cls(
            sample.sequence,
            sample.t_ns,
            arrival.host_ns,
            arrival.waited_ns,
            arrival.raw,
            first=sample.sequence,
            since_ns=arrival.host_ns,
            count_t_ns=sample.t_ns,
        )
        counter.taken[sample.sequence % RECENT] = _Taken(sample.sequence, sample.t_ns)
        return counter

    @property
    def established(self) -> bool:
        return self.heard >= ESTABLISHED_AFTER

    @property
    def regular(self) -> bool:
        """Whether its counts come so evenly that a message that does not continue them is another
        sender's.
        """
        return self.heard >= REGULAR_AFTER and self.even_share >= REGULAR_SHARE

    def off_ns(self, arrival: SampleArrival) -> float | None:
        """How far the time of a message that continues this counter is from its usual step, ns;
        None where it does not continue it.
        """
        sample = arrival.event
        period_ns = self.period_ns
        later_ns = sample.t_ns - self.t_ns
        gap_ns = arrival.host_ns - self.host_ns
        step = self._advance(sample.sequence, later_ns, gap_ns)
        if step is None:
            return None
        if period_ns is None:
            if -EARLY_NS <= later_ns <= MAX_STEP_NS:
                return math.inf
            return None
        off_ns = abs(sample.t_ns - self.count_t_ns - step * period_ns)
        waited_ns = min(self.waited_ns, NS_PER_S)
        if -EARLY_NS <= later_ns <= max(gap_ns + EARLY_NS + waited_ns, 3 * period_ns):
            return off_ns
        # time and count may advance together, however late it is
        if step and off_ns <= (0.5 + 0.05 * step) * period_ns:
            return off_ns
        return None

    def counts(self, arrival: SampleArrival) -> bool:
        """Whether a message goes on from the newest in its count, whatever its time."""
        later_ns = arrival.event.t_ns - self.t_ns
        gap_ns = arrival.host_ns - self.host_ns
        return self._advance(arrival.event.sequence, later_ns, gap_ns) is not None

    def _advance(self, sequence: int, later_ns: int, gap_ns: int) -> int | None:
        """By how much a count goes on from the newest; None where it does not."""
        step = _steps(self.sequence, sequence)
        if step == 0:
            # two that were started together have one count by turns
            return 0 if self.repeats or not self.shown else None
        counted_ns = max(min(later_ns, MAX_QUEUED_NS), gap_ns)
        max_step: float = MAX_FIRST_LOSSES
        if self.period_ns is not None:
            max_step = 2 + 2 * counted_ns / self.period_ns
        if 0 < step <= max_step:
            return step
        wrap = self.wrap
        if wrap is not None and wrap.first <= sequence < self.sequence <= wrap.last:
            step = wrap.last - self.sequence + 1 + sequence - wrap.first
            if step <= max_step:
                return step
        return 0 if sequence == 0 and self.mixes else None

    def awaited_off_ns(self, arrival: SampleArrival) -> float | None:
        """As `off_ns`, of a message that comes at the very time that its count has, however much
        later; None for any other.
        """
        if not self.regular or self.repeats or self.period_ns is None:
            return None
        step = _steps(self.sequence, arrival.event.sequence)
        off_ns = abs(arrival.event.t_ns - self.count_t_ns - step * self.period_ns)
        if step > 0 and off_ns < AWAITED_SHARE * self.period_ns:
            return off_ns
        return None

    def has(self, sample: AttitudeSample) -> bool:
        """Whether this very message was taken before."""
        return self.taken.get(sample.sequence % RECENT) == (sample.sequence, sample.t_ns)

    def overtook(self, sample: AttitudeSample) -> bool:
        """Whether a message is late: older than the newest in time and count, and missing."""
        step = _steps(self.sequence, sample.sequence)
        if not -RECENT < step < 0 or sample.t_ns >= self.t_ns:
            return False
        # older by more than twice what its count says: of another counter
        if sample.t_ns < self.t_ns + 2 * step * (self.period_ns or 0.0) - EARLY_NS:
            return False
        taken = self.taken.get(sample.sequence % RECENT)
        return taken is None or taken.sequence != sample.sequence

    def move(self, arrival: SampleArrival) -> None:
        """Take a message that continues this counter."""
        sample = arrival.event
        if sample.t_ns <= self.t_ns:  # out of order
            return
        self.repeats = self.repeats or sample.sequence == self.sequence
        if sample.sequence or not self.sequence:
            self._count(sample)
        self.silence_ns = max(arrival.host_ns - self.host_ns, FORGETS * self.silence_ns)
        self.heard += 1
        self.t_ns = sample.t_ns
        self.raw = arrival.raw
        self.host_ns = arrival.host_ns
        self.waited_ns = arrival.waited_ns

    def _count(self, sample: AttitudeSample) -> None:
        step = max(_steps(self.sequence, sample.sequence), 1)
        counted_ns = sample.t_ns - self.count_t_ns
        if 0 < counted_ns < MAX_STEP_NS:
            period_ns = counted_ns / step
            if self.period_ns is None:
                self.period_ns = period_ns
            else:
                self.period_ns += (period_ns - self.period_ns) * PERIOD_GAIN
        self.even_share += ((step == self.step) - self.even_share) * EVEN_GAIN
        self.step = step
        self.sequence = sample.sequence
        self.count_t_ns = sample.t_ns
        self.taken[sample.sequence % RECENT] = _Taken(sample.sequence, sample.t_ns)

    def patience_ns(self, silent_after_ns: int) -> float:
        """The silence after which another counter is taken for the same sender, started anew."""
        if self.heard < MIN_KNOWN or self.host_ns - self.since_ns < MIN_KNOWN_NS:
            return silent_after_ns
        return min(silent_after_ns, USUAL_SILENCES * self.silence_ns + SLACK_NS)


class Repeats:
    """Refuses messages with the time of the newest one shown, and reports a sender that keeps
    sending them.
    """

    def __init__(self, notices: Notices, state: StreamState) -> None:
        self._notices = notices
        self._state = state
        self._count = 0
        self._frozen = False

    def refused(self, arrival: SampleArrival, newest: _Counter) -> SampleArrival:
        """A message that repeats the time of the newest, or an earlier message, refused."""
        if arrival.event.t_ns != newest.t_ns:
            return _refused_as_repeat(arrival)
        self._count += 1
        if self._count >= MIN_REPEATS and arrival.host_ns - newest.host_ns >= MIN_REPEATED_NS:
            what = f"the sender's clock has stopped at t_ns {newest.t_ns}"
            if arrival.raw == newest.raw:
                what = "the sender repeats one packet"
            self._frozen = True
            self._notices.begin(
                FROZEN, f"{what}: refused (time), and the attitude shown is getting old"
            )
        detail = f"t_ns {newest.t_ns} repeats that of the previous packet"
        return replace(arrival, refusal=Refusal("time", detail))

    def end(self) -> None:
        """A message with another time is shown."""
        self._count = 0
        if self._frozen:
            self._frozen, self._state.resumed = False, True
            self._notices.end(FROZEN, "source-resumed", "the sender's clock runs again")


class _Held(NamedTuple):
    arrival: SampleArrival
    counter: _Counter
    in_count: bool  # its count continued the counter shown; its time did not


def _identity(arrival: SampleArrival) -> Identity:
    """Who sent a message, as far as that is stated: its number, else its address, else None."""
    return arrival.event.sender or arrival.address


def _named(identity: Identity) -> str:
    """An identity in words."""
    if identity is None:
        return "the one without a number"
    if isinstance(identity, int):
        return f"number {identity}"
    return f"the one at {identity[0]} port {identity[1]}"


class Senders:
    """Follows the sender that was there first, until it has been silent for `silent_after_ns`."""

    def __init__(self, silent_after_ns: int, notices: Notices, state: StreamState) -> None:
        self._silent_after_ns = silent_after_ns
        self._notices = notices
        self._state = state
        self._repeats = Repeats(notices, state)
        self._main: _Counter | None = None
        # of the sender shown
        self._identity: Identity = None
        # host time of the newest message of another identity; it is the second sender's once the
        # sender shown has spoken after it
        self._other: Identity = None
        self._other_ns: int | None = None
        self._others: list[_Counter] = []
        # in order of arrival; those of the counter shown are among them while it is not established
        self._held: list[_Held] = []
        self._begun = 0  # counters, since the one shown began
        self._irregular = False
        self._two = False  # counters
        self._told = False

    def take(self, arrival: SampleArrival) -> list[SampleArrival]:
        """The messages that this one decides, in order; a refusal says which are not shown."""
        main = self._main
        sample = arrival.event
        if main is None:
            return self._begin(arrival)
        if _identity(arrival) != self._identity:
            return self._take_other(main, arrival)
        self._look_for_others(arrival.host_ns)
        if sample.t_ns == main.t_ns or main.has(sample):
            return [self._repeats.refused(arrival, main)]
        off_ns = main.off_ns(arrival)
        if off_ns is None and main.overtook(sample):
            return [arrival]
        other = self._other_of(arrival, off_ns)
        if off_ns is not None and other is None:
            return self._speaks(main, arrival)
        return self._take_strange(main, arrival, other)

    def expire(self, now_ns: int) -> list[SampleArrival]:
        """Messages held, where the sender shown has been silent for longer than it usually is."""
        main = self._main
        if main is None or not self._held or self._state.busy:
            return []
        counter = self._held[-1].counter
        if not self._gives_way(main, counter, now_ns - main.host_ns):
            return []
        if counter is main or not main.established:
            return self._released()
        return self._give_way(main, counter)

    def release(self) -> list[SampleArrival]:
        """The messages still held, where no more come to decide them."""
        if self._main is not None and self._main.established and not self._irregular:
            return self._decided(self._main)
        return self._released()

    def _begin(self, arrival: SampleArrival) -> list[SampleArrival]:
        """Show this message's sender, of which nothing but this is known."""
        self._show(_Counter.of(arrival))
        self._identity = _identity(arrival)
        self._others = []
        return [arrival]

    def _show(self, counter: _Counter) -> None:
        self._main = counter
        counter.shown = True
        self._begun = 0
        self._irregular = False
        self._repeats.end()

    def _take_other(self, main: _Counter, arrival: SampleArrival) -> list[SampleArrival]:
        """Refuse a message of another identity, or show its sender where the first is silent."""
        # one that was not read for a while was not silent
        silent_ns = arrival.host_ns - arrival.waited_ns - main.host_ns
        if silent_ns <= self._silent_after_ns:
            self._other = _identity(arrival)
            self._other_ns = arrival.host_ns
            return [_refused(arrival)]
        self._part("the first sender is silent; showing the other one")
        undecided = [_refused(held.arrival) for held in self._emptied()]
        self._other_ns = None
        return [*undecided, *self._begin(arrival)]

    def _look_for_others(self, host_ns: int) -> None:
        """The sender shown may have spoken after one of another identity: there are two. Forget
        others that are silent.
        """
        if self._others:
            self._others = [
                other for other in self._others if host_ns - other.host_ns < OTHER_LIFE_NS
            ]
        if self._other_ns is not None:
            if host_ns - self._other_ns >= OTHER_LIFE_NS:
                self._other_ns = None
            elif not self._told:
                shown = _named(self._identity)
                refused = _named(self._other)
                self._tell(f"showing {shown}, refusing {refused}")
        if self._told and not self._others and self._other_ns is None:
            self._part("the second sender is silent")

    def _other_of(self, arrival: SampleArrival, off_ns: float | None) -> _Counter | None:
        """The other counter that a message continues. Where it continues the one shown, too, off
        its usual step by `off_ns`, only one that awaits it.
        """
        nearest = None
        both = off_ns is not None
        for other in self._others:
            if both:
                other_off_ns = other.awaited_off_ns(arrival)
            else:
                other_off_ns = other.off_ns(arrival)
            if other_off_ns is not None and (off_ns is None or other_off_ns < off_ns):
                nearest = other
                off_ns = other_off_ns
        return nearest

    def _speaks(self, main: _Counter, arrival: SampleArrival) -> list[SampleArrival]:
        """The counter shown goes on."""
        if not self._held:
            self._moves(main, arrival)
            return [arrival]
        ascends = self._ascends(main, arrival)
        self._moves(main, arrival)
        if ascends or self._irregular:
            return [*self._all_own(), arrival]
        self._held.append(_Held(arrival, main, in_count=True))
        if any(held.counter.heard >= MIN_RUN for held in self._held if held.counter is not main):
            self._two = True
            self._tell("showing the first, refusing the other")
        if self._two or main.established:
            return self._decided(main)
        return []

    def _moves(self, main: _Counter, arrival: SampleArrival) -> None:
        main.move(arrival)
        self._repeats.end()
        if self._irregular:
            self._irregular = not main.regular
        elif main.even_share < IRREGULAR_SHARE:
            self._irregular = True

    def _ascends(self, main: _Counter, arrival: SampleArrival) -> bool:
        """Whether what is held lies between the counter shown and a message that continues it:
        all are of one counter, whose times are uneven.
        """
        counts = [held.arrival.event.sequence for held in self._held]
        counts = [main.sequence, *counts, arrival.event.sequence]
        steps = [_steps(before, after) for before, after in pairwise(counts)]
        return all(0 < step < U32 // 2 for step in steps)

    def _take_strange(
        self, main: _Counter, arrival: SampleArrival, counter: _Counter | None
    ) -> list[SampleArrival]:
        """Hold a message that does not continue the counter shown, or decide it."""
        sample = arrival.event
        stands = counter is not None and sample.sequence == counter.sequence
        if counter is not None:
            counter.move(arrival)
        elif any(sample.t_ns == other.t_ns for other in self._others):
            return [_refused_as_repeat(arrival)]
        else:
            counter = self._begin_other(arrival)
        if self._irregular:
            return self._take_irregular(counter, arrival)
        in_count = main.counts(arrival)
        self._held.append(_Held(arrival, counter, in_count))
        if not main.established and not self._two:
            if stands and sample.sequence in (main.sequence, 0):
                main.repeats = main.repeats or sample.sequence == main.sequence
                main.mixes = main.mixes or sample.sequence == 0
                return self._all_own()
            if self._begun >= max(MAX_BEGUN, main.heard):
                self._show(counter)
                self._irregular = True
                return self._all_own()
        # one that was not read for a while was not silent
        silent_ns = arrival.host_ns - arrival.waited_ns - main.host_ns
        if self._gives_way(main, counter, silent_ns):
            return self._give_way(main, counter)
        return self._decided(main) if self._two else []

    def _begin_other(self, arrival: SampleArrival) -> _Counter:
        counter = _Counter.of(arrival)
        self._others = [*self._others[-MAX_OTHERS + 1 :], counter]
        self._begun += 1
        return counter

    def _take_irregular(self, counter: _Counter, arrival: SampleArrival) -> list[SampleArrival]:
        """Take any message while no counter fits; look for one from the newest on."""
        if counter.regular or self._begun >= MAX_BEGUN:
            self._show(counter)
            self._others = []
            self._irregular = not counter.regular
        return [arrival]

    def _all_own(self) -> list[SampleArrival]:
        """The messages held back: they turned out to be of the sender shown. Their counters are no
        longer others'.
        """
        counters = {id(held.counter) for held in self._held}
        self._others = [other for other in self._others if id(other) not in counters]
        return self._released()

    def _released(self) -> list[SampleArrival]:
        return [held.arrival for held in self._emptied()]

    def _decided(self, main: _Counter) -> list[SampleArrival]:
        """The messages held back, each with a refusal unless it is of this counter."""
        arrivals: list[SampleArrival] = []
        for held in self._emptied():
            if held.counter is main:
                arrivals.append(held.arrival)
            else:
                arrivals.append(_refused_beside(held))
        return arrivals

    def _gives_way(self, main: _Counter, counter: _Counter, silent_ns: int) -> bool:
        """Whether the counter shown has been silent for so long that another takes its place."""
        if silent_ns > max(self._silent_after_ns, 3 * (main.period_ns or 0.0)):
            return True
        runs = counter.heard >= MIN_RUN or counter is main
        return runs and not self._two and silent_ns > main.patience_ns(self._silent_after_ns)

    def _give_way(self, main: _Counter, counter: _Counter) -> list[SampleArrival]:
        """The sender shown is silent: another one is shown, or the same one begun anew."""
        if not self._two and counter.first < main.sequence:
            counter.wrap = _Wrap(main.sequence, counter.first)
        if self._two:
            self._part("the first sender is silent; showing the other one")
        self._others = [main, *(other for other in self._others if other is not counter)]
        self._show(counter)
        return self._decided(counter)

    def _emptied(self) -> list[_Held]:
        held = self._held
        self._held = []
        return held

    def _tell(self, which: str) -> None:
        if not self._told:
            self._told = True
            self._notices.begin(SECOND, f"two senders on one link: {which} (source)")

    def _part(self, why: str) -> None:
        if self._told:
            self._notices.end(SECOND, "second-sender-gone", why)
        self._two = self._told = False


def _refused(arrival: SampleArrival) -> SampleArrival:
    detail = "from a second sender on the same link; the one that was there first is shown"
    return replace(arrival, refusal=Refusal("source", detail))


def _refused_beside(held: _Held) -> SampleArrival:
    """A message that the counter shown has passed by."""
    if held.counter.heard >= MIN_RUN or not held.in_count:
        return _refused(held.arrival)
    detail = f"t_ns {held.arrival.event.t_ns} does not go on from that of the packets before it"
    return replace(held.arrival, refusal=Refusal("time", detail))


def _refused_as_repeat(arrival: SampleArrival) -> SampleArrival:
    detail = f"t_ns {arrival.event.t_ns} repeats that of an earlier packet"
    return replace(arrival, refusal=Refusal("time", detail))
