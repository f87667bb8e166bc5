"""A sender's clock that jumps or runs slow: samples in, the same samples on a clock without jumps
out; no I/O.

Laws:
1. A jump shows in t_ns itself: its step differs from the usual one. A message that arrives slightly
   early or late while t_ns
   advances as usual had a shorter or longer delay, and is taken as it is.
2. Samples in doubt wait for the next ones. Three that agree are a jump, and continue where the old
   clock stood. An early one
   that the next contradicts is refused. Late ones that do not agree were queued, and are taken as
   they are.
3. A message that waited unread may be late by as long as it waited, and teaches nothing.
4. Until the clock is settled, a message that arrives early shows that those before it were late.

A sender that stamps with hilstar's own clock, or with Unix time, needs none of this
(`KnownClockFilter`).
"""

from collections import deque
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from hilstar.attitude.clock.sender_clock import SenderClock, Slots
from hilstar.attitude.clock.stages import StreamState
from hilstar.attitude.wire.links import SampleArrival
from hilstar.attitude.wire.packet import AttitudeSample, Refusal
from hilstar.basics.notices import Notices
from hilstar.basics.units import NS_PER_MS, NS_PER_S
from hilstar.basics.wrong_sky import CLOCK, ENDS

PACE_SLOTS = 9  # a quarter of a second each: two seconds from the first to the last
# twice what a crystal is allowed: beyond it, and steadily, t_ns runs slow or fast
MIN_ODD_PACE = 0.004
STEPS = 31
MIN_STEPS = 8
MAX_MISSING = 1000  # a sequence that advances by more does not count packets
MIN_AGREEING = 3
LATE_FOR_NS = 100 * NS_PER_MS  # a queue can be late by a constant time for this long
SURELY_A_JUMP_NS = NS_PER_S  # and never by as much as this
MIN_LIMIT_NS = 5 * NS_PER_MS
AGREEMENT_NS = 2 * NS_PER_MS
UNSETTLED_NS = 100 * NS_PER_MS
SETTLED_AFTER = 50  # messages, and
SETTLED_AFTER_NS = 2 * NS_PER_S  # as much time: a burst shows no usual delay
MAX_DOUBT_NS = 250 * NS_PER_MS
# How early a message may be against a first guess: one that waited, perhaps for minutes, or one
# that was read late.
MAX_GUESSED_LATE_NS = 60 * NS_PER_S
MAX_FOUND_LATE_NS = NS_PER_S
WAITED_UNKNOWN_NS = 2**62  # a message that was there before anybody listened
TRUSTED_WAIT_NS = NS_PER_MS  # a shorter wait is within what the clock's minimum filter removes
# late by a constant time while t_ns itself shows no jump: a sender that was stopped
CLEARLY_LATE_FOR_NS = 3 * LATE_FOR_NS
UNKNOWN_DRIFT = 1e-4  # while nothing arrives, the clocks part by this share of the time
# what a slow clock may fall behind before it is known to be slow; more is surely a jump
MAX_FOLLOWED_NS = 60 * NS_PER_S
USUAL_SHARE = 0.95
REMEDY = 'stamp with that clock, or write clock = "estimated"'
MAX_OFF_NS = NS_PER_S  # a sender may predict, or be late
MIN_FUTURE_NS = 5 * NS_PER_MS
PERSISTENT_NS = NS_PER_S  # a queue may be older for a moment
MIN_OFF = 3
# no queue makes a packet early; a step of this machine's clock is followed in 0.2 s
AHEAD_FOR_NS = 3 * NS_PER_S // 10
BEHIND, MIN_BEHIND_NS, BEHIND_EACH_NS = "clock-behind", 50 * NS_PER_MS, 2 * NS_PER_S
SHARED_FOR_NS = NS_PER_S  # how long a clock must agree before it is believed again
# By how much other clocks are behind Unix time, s: TAI - UTC is 37 s since 2017 (IERS Bulletin C),
# GPS is 19 s behind TAI.
OTHER_CLOCKS = {
    "TAI": -37.0,
    "GPS time counted from 1970": -18.0,
    "GPS time counted from 6 January 1980": 315_964_800.0 - 18.0,
    "time counted from J2000": 946_728_000.0,
    "Terrestrial Time": -69.184,
}
NEAR_S = 1.0
HOUR_S, MAX_ZONE_HOURS = 3600.0, 14
CLOCK_NAMES = {"shared": "CLOCK_MONOTONIC", "unix": "CLOCK_REALTIME (Unix time)"}


class _TimeSteps:
    """The usual step of t_ns from message to message."""

    def __init__(self) -> None:
        self._last: AttitudeSample | None = None
        self._usual_ns: deque[float] = deque(maxlen=STEPS)
        # the newest step of t_ns, and how many packets it spans
        self._newest_ns = 0
        self._packets = 1

    def add(self, sample: AttitudeSample) -> None:
        if self._last is not None:
            packets = sample.sequence - self._last.sequence
            self._newest_ns = sample.t_ns - self._last.t_ns
            self._packets = packets if 1 <= packets <= MAX_MISSING else 1
            self._usual_ns.append(self._newest_ns / self._packets)
        self._last = sample

    def show_no_jump(self, by_ns: float) -> bool:
        """Whether the newest step of t_ns rules a jump by `by_ns` out: steps are even enough to
        show it, and do not.
        """
        if len(self._usual_ns) < MIN_STEPS:
            return False
        usual_ns = np.array(self._usual_ns)
        period_ns = float(np.median(usual_ns))
        if np.median(np.abs(usual_ns - period_ns)) > abs(by_ns) / 4:
            return False
        return (
            min(abs(self._newest_ns - count * period_ns) for count in (self._packets, 1))
            < abs(by_ns) / 2
        )


class _Pace:
    """The rate of the sender's clock, from the earliest messages of each slot of the last two
    seconds.
    """

    def __init__(self) -> None:
        self.slowness = 0.0
        self._slots = Slots(maxlen=PACE_SLOTS)

    def add(self, host_ns: int, offset_ns: int) -> None:
        """Take one message's arrival and (arrival - t_ns), as sent.

        A slow or a fast clock drifts steadily; a jump or a queue is a step, and decides nothing.
        """
        if self._slots.lower(host_ns, offset_ns):
            return
        if len(self._slots) == PACE_SLOTS:
            x, y = self._slots.relative_to(self._slots[0])
            slope = y[-1] / x[-1]
            uneven_ns = np.abs(y - slope * x).max()
            if abs(slope) > MIN_ODD_PACE and uneven_ns < abs(y[-1]) / 5:
                self.slowness = float(slope)
            elif abs(slope) < MIN_ODD_PACE / 2 and uneven_ns < MIN_ODD_PACE * x[-1]:
                self.slowness = 0.0
        self._slots.begin(host_ns, offset_ns)


def _is_timely(arrival: SampleArrival) -> bool:
    """True where the arrival is known well enough to teach a clock."""
    return arrival.waited_ns <= TRUSTED_WAIT_NS


class _Doubtful(NamedTuple):
    arrival: SampleArrival
    late_ns: float


class JumpFilter:
    """Samples with the sender's times in, samples with continuous times out, in the order of
    arrival.

    It teaches `clock` what it accepts, on the continuous times.
    """

    def __init__(self, clock: SenderClock, state: StreamState) -> None:
        self.correction_ns = 0  # continuous time minus the sender's
        self.jumps = 0
        self._clock = clock
        self._state = state
        self._pace = _Pace()
        self._steps = _TimeSteps()
        self._usual_ns: deque[float] = deque(maxlen=256)  # delays that raise no doubt
        self._limit_ns: float = UNSETTLED_NS
        self._agreement_ns: float = AGREEMENT_NS
        self._doubtful: list[_Doubtful] = []
        self._first_ns: int | None = None  # when the first timely message came
        self._near_count = 0
        self._near_ns: int | None = None  # when the last one came that was neither late nor early
        self._shows_none = False  # t_ns itself advanced as usual where the samples in doubt began

    def sender_ns(self, continuous_ns: int) -> int:
        """The sender's own time, ns, of a continuous time."""
        return continuous_ns - self.correction_ns

    @property
    def settled(self) -> bool:
        """True once the clock is known well enough to say that a message is early."""
        return self._limit_ns < UNSETTLED_NS

    @property
    def slowness(self) -> float:
        """The share by which the sender's clock is slow: 0.5 at half speed, negative where it is
        fast.
        """
        return self._pace.slowness

    def take(self, arrival: SampleArrival) -> list[SampleArrival]:
        """The samples that this one decides, itself among them unless it is in doubt."""
        self._steps.add(arrival.event)
        late_ns = self._late_ns(arrival)
        # then packets that get later at their usual steps are queueing on the link
        known = self._clock.synchronised
        if _is_timely(arrival):
            self._pace.add(arrival.host_ns, arrival.host_ns - arrival.event.t_ns)
            if self.slowness > 0 and not known and MIN_LIMIT_NS < late_ns < MAX_FOLLOWED_NS:
                behind = self.release()
                self.correction_ns += round(late_ns)
                return [*behind, self._accept(arrival)]
        if (
            -self._early_limit_ns(arrival.host_ns)
            <= late_ns
            <= self._late_limit_ns(arrival.host_ns) + arrival.waited_ns
        ):
            # Nothing to doubt; so early ones in doubt were wrong.
            refused = [_too_early(doubt) for doubt in self._doubtful if doubt.late_ns < 0]
            self._doubtful = [doubt for doubt in self._doubtful if doubt.late_ns >= 0]
            return [*refused, *self.release(), self._accept(arrival)]
        decided: list[SampleArrival] = []
        if self._doubtful and not self._agrees(arrival, late_ns):
            decided = self.release()
            late_ns = self._late_ns(arrival)
        if not self._doubtful:
            self._shows_none = self._steps.show_no_jump(late_ns)
            if self._shows_none and (late_ns <= UNSETTLED_NS or known):
                return [*decided, self._accept(arrival)]
        self._doubtful.append(_Doubtful(arrival, late_ns))
        return [*decided, *self._jumped(arrival.host_ns)]

    def expire(self, now_ns: int) -> list[SampleArrival]:
        """Samples in doubt that nothing followed."""
        if self._doubtful and now_ns - self._doubtful[-1].arrival.host_ns > MAX_DOUBT_NS:
            return self.release()
        return []

    def release(self) -> list[SampleArrival]:
        """The samples in doubt, as they are."""
        released = [self._accept(doubt.arrival) for doubt in self._doubtful]
        self._doubtful.clear()
        return released

    def _late_limit_ns(self, host_ns: int) -> float:
        """How late a message may be without doubt, after the silence before it."""
        if self._near_ns is None:
            silent_ns = 0
        else:
            silent_ns = host_ns - self._near_ns
        return self._limit_ns + UNKNOWN_DRIFT * silent_ns

    def _early_limit_ns(self, host_ns: int) -> float:
        if self._clock.unheard:
            return MAX_GUESSED_LATE_NS
        if self.settled:
            return self._late_limit_ns(host_ns)
        return MAX_FOUND_LATE_NS

    def _agrees(self, arrival: SampleArrival, late_ns: float) -> bool:
        """Whether a sample supports those in doubt: its time is off by as much as theirs, and it
        follows them.
        """
        by_ns = AGREEMENT_NS if self._shows_none else self._agreement_ns
        # by jitter such samples may differ; a queue is never as late
        if abs(late_ns) > MAX_FOLLOWED_NS:
            by_ns = UNSETTLED_NS
        follows = arrival.event.t_ns > self._doubtful[-1].arrival.event.t_ns
        return follows and abs(late_ns - self._doubtful[0].late_ns) <= by_ns

    def _late_ns(self, arrival: SampleArrival) -> float:
        return self._clock.late_ns(arrival.event.t_ns + self.correction_ns, arrival.host_ns)

    def _accept(self, arrival: SampleArrival) -> SampleArrival:
        late_ns = self._late_ns(arrival)
        t_ns = arrival.event.t_ns + self.correction_ns
        if arrival.waited_ns == WAITED_UNKNOWN_NS:
            self._clock.guess(t_ns, arrival.host_ns)
        elif _is_timely(arrival):
            self._clock.observe(t_ns, arrival.host_ns)
            self._learn(arrival.host_ns, late_ns)
        if not self.correction_ns:  # the usual case: every packet passes here
            return arrival
        return replace(arrival, event=replace(arrival.event, t_ns=t_ns))

    def _learn(self, host_ns: int, late_ns: float) -> None:
        if self._first_ns is None:
            self._first_ns = host_ns
        if late_ns > self._late_limit_ns(host_ns):
            return
        self._near_ns = host_ns
        self._state.resumed = False
        self._usual_ns.append(max(late_ns, 0.0))
        self._near_count += 1
        if self._near_count >= SETTLED_AFTER and host_ns - self._first_ns >= SETTLED_AFTER_NS:
            self._near_count = 0
            usual_ns = sorted(self._usual_ns)
            usual_max_ns = usual_ns[int(USUAL_SHARE * len(usual_ns))]
            self._limit_ns = min(max(MIN_LIMIT_NS, 2 * usual_max_ns), UNSETTLED_NS)
            self._agreement_ns = max(AGREEMENT_NS, usual_max_ns)

    def _jumped(self, host_ns: int) -> list[SampleArrival]:
        """The samples in doubt where they prove a jump, on a clock that is carried across it;
        else [].
        """
        late_ns = [doubt.late_ns for doubt in self._doubtful]
        for_ns = host_ns - self._doubtful[0].arrival.host_ns
        if self._shows_none and not self._state.resumed:
            is_jump = for_ns >= CLEARLY_LATE_FOR_NS
        else:
            is_jump = late_ns[-1] < 0 or late_ns[-1] > SURELY_A_JUMP_NS or for_ns >= LATE_FOR_NS
        if not is_jump or len(late_ns) < MIN_AGREEING:
            return []
        is_new = not self._state.resumed
        # the earliest of them is then as late as the earliest ever was
        self.correction_ns += round(min(late_ns))
        released = self.release()
        if is_new:
            self.jumps += 1
            self._clock.widen(max(late_ns) - min(late_ns))
        return released


def _too_early(each: _Doubtful) -> SampleArrival:
    detail = (
        f"t_ns {each.arrival.event.t_ns} is {-each.late_ns / NS_PER_S:.3g} s ahead of the sender's"
        " clock so far"
    )
    return replace(each.arrival, refusal=Refusal("time", detail))


def clock_named(late_ns: int) -> str | None:
    """The clock that is behind Unix time by `late_ns`, as far as one is known by that; None for
    none.
    """
    late_s = late_ns / NS_PER_S
    for name, behind_s in OTHER_CLOCKS.items():
        if abs(late_s - behind_s) < NEAR_S:
            return name
    hours = round(4 * late_s / HOUR_S) / 4  # time zones are whole quarters of an hour
    if 0 < abs(hours) <= MAX_ZONE_HOURS and abs(late_s - hours * HOUR_S) < NEAR_S:
        return f"the local time of a zone {abs(hours):g} h {'west' if hours > 0 else 'east'} of UTC"
    return None


class KnownClockFilter:
    """Takes the place of a `JumpFilter`: refuses times far ahead, and says where the clock is
    another one, and when no more.
    """

    correction_ns = 0
    jumps = 0
    slowness = 0.0

    def __init__(self, notices: Notices, clock: SenderClock) -> None:
        self._notices = notices
        self._clock = clock
        self._off_since_ns: int | None = None
        self._shared_since_ns: int | None = None
        self._off = 0
        self._least_late_ns = 0  # of the packets that are off
        self._told = False
        # since when, and by how much the quickest packet since then was late
        self._quickest: tuple[int, int] | None = None

    def sender_ns(self, continuous_ns: int) -> int:
        """The sender's own time, ns, of a continuous time: the same, as the clock is known."""
        return continuous_ns

    def take(self, arrival: SampleArrival) -> list[SampleArrival]:
        """The sample itself, refused where its time is more than MAX_OFF_NS ahead of the
        clock's.
        """
        t_ns = arrival.event.t_ns
        host_ns = arrival.host_ns
        late_ns = round(self._clock.latency_ns(t_ns, host_ns) or 0.0)
        if -MIN_FUTURE_NS <= late_ns <= MAX_OFF_NS:
            self._off_since_ns = None
            self._off = 0
            self._shared(host_ns)
            self._look_behind(late_ns, host_ns)
            return [arrival]
        self._shared_since_ns = None
        # A link and a busy machine make packets late, and never early: the least late one is the
        # clock's.
        if self._off_since_ns is None:
            self._off_since_ns = host_ns
            self._least_late_ns = late_ns
        self._least_late_ns = min(self._least_late_ns, late_ns)
        self._off += 1
        for_ns = AHEAD_FOR_NS if late_ns < 0 else PERSISTENT_NS
        if self._off >= MIN_OFF and host_ns - self._off_since_ns >= for_ns and not self._told:
            self._told = True
            self._notices.begin(CLOCK, self._line(self._least_late_ns), self._off_since_ns)
        if late_ns >= -MAX_OFF_NS:
            return [arrival]
        ahead = f"t_ns is {self._place(late_ns)}: {REMEDY}"
        return [replace(arrival, refusal=Refusal("time", ahead, telling=True))]

    def _shared(self, host_ns: int) -> None:
        """A packet's time may be this machine's: the condition ends once that has lasted."""
        if self._shared_since_ns is None:
            self._shared_since_ns = host_ns
        if self._told and host_ns - self._shared_since_ns >= SHARED_FOR_NS:
            self._told = False
            self._notices.end(
                CLOCK,
                ENDS[CLOCK],
                f"t_ns agrees with {CLOCK_NAMES[self._clock.mode]} of this machine again",
            )

    def _look_behind(self, late_ns: int, host_ns: int) -> None:
        """Tell the user where even the quickest packet of some seconds comes late. The times alone
        do not say whether the link is slow or the sender's clock behind.
        """
        if self._quickest is None or host_ns - self._quickest[0] > 2 * BEHIND_EACH_NS:
            self._quickest = host_ns, late_ns
            return
        since_ns, quickest_ns = self._quickest
        if host_ns - since_ns < BEHIND_EACH_NS:
            self._quickest = since_ns, min(quickest_ns, late_ns)
            return
        self._quickest = host_ns, late_ns
        if quickest_ns < MIN_BEHIND_NS:
            self._notices.end(
                BEHIND, "clock-behind-no-more", "packets come soon after their t_ns again"
            )
            return
        self._notices.begin(
            BEHIND,
            f'[attitude] clock = "{self._clock.mode}", and each packet comes'
            f" {quickest_ns / NS_PER_MS:.0f} ms or more after its t_ns: the link is as slow, or the"
            " sender's clock as far behind; then the sky is drawn as far ahead",
        )

    def _line(self, late_ns: int) -> str:
        other = clock_named(late_ns)
        looks = "" if other is None else f", as {other} is"
        wrong = ""
        if late_ns < -MAX_OFF_NS:
            wrong = "; its packets are refused"
        elif late_ns < 0:
            wrong = f"; the sky drawn is {-late_ns / NS_PER_S:.3f} s old"
        return (
            f'[attitude] clock = "{self._clock.mode}", but t_ns is {self._place(late_ns)}'
            f"{looks}{wrong}: {REMEDY}"
        )

    def _place(self, late_ns: int) -> str:
        """Where a packet's time lies on this machine's clock."""
        sense = "behind" if late_ns > 0 else "ahead of"
        name = CLOCK_NAMES[self._clock.mode]
        return f"{abs(late_ns) / NS_PER_S:.3f} s {sense} {name} of this machine"

    def expire(self, now_ns: int) -> list[SampleArrival]:
        """No sample is ever in doubt."""
        return []

    def release(self) -> list[SampleArrival]:
        """No sample is ever in doubt."""
        return []
