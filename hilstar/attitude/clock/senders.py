"""Who sends: a sender that hangs or whose clock has stopped, and a second sender on the same link;
no I/O.

A sender that gives its number (`AttitudeSample.sender`) is known by it, and over UDP one without a
number by its address and port. Any other message must itself say who sent it: a sender is known by
its clock (`t_ns` advances as the host's does, or by its usual step for each count), its count
(`sequence` advances), and its sky (the attitude goes on as it turned).

Laws:
0. A message of another number, or without one of another address, than the sender shown is a
   second sender's: it is refused until the first has been silent for `stale_after_ms`. The laws
   below are for messages of one number or one address, and for links that show neither.
1. A message that agrees with the sender shown in two of the three is its own: it may restart its
   count, set its clock, or turn
   to a new target without saying so, and it may mix packets that count with messages that do not.
2. Any other message is a stranger's. It waits until the sender shown speaks again, and is then
   refused: there are two. Where
   that one stays silent for longer than it usually is, it was the same sender, begun anew, and goes
   on from there.
3. A sender that comes back on the course that it had before a stranger took its place was not that
   stranger.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, NamedTuple

from hilstar.attitude.wire.links import SampleArrival
from hilstar.attitude.wire.packet import U32, AttitudeSample, Refusal
from hilstar.basics.notices import Notices
from hilstar.basics.units import NS_PER_MS, NS_PER_S

SECOND, FROZEN = "second-sender", "source-frozen"
MIN_REPEATS = 10  # and
MIN_REPEATED_NS = NS_PER_S // 4
# at one time of a clock that stands, an attitude that far away is another sender's
MIN_ANOTHERS_RAD = 0.1
# messages of one stranger, before and after the first sender spoke again: they are a second one's
MIN_STRANGE = 3
ANOTHER_COURSE_WITHIN_NS = 5 * NS_PER_S
MAX_STRANGERS = 4
# from message to message t_ns may run ahead of the host's clock, or go back, by this and be one's
EARLY_NS = 50 * NS_PER_MS
MIN_FAR_RAD = 5e-5  # 10 arcsec
FAR_RATIO = 3.0  # times the recent deviation of the attitudes from their course
PLAUSIBLE_RAD_S = math.radians(60.0)
STEADY = (0.7, 1.4)  # times the usual step of t_ns
MAX_FIRST_LOSSES = 16  # packets missing, while their period is not known yet
MAX_STEP_NS = 10 * NS_PER_S
MIN_KNOWN, MIN_KNOWN_NS = 8, NS_PER_S  # before a sender's usual silences are known
USUAL_SILENCES, SLACK_NS = 3, 20 * NS_PER_MS
FORGETS, LEARNS = 0.98, 1 / 32  # decay and gain with each message, for silences and errors
MIN_COURSES = 8  # attitudes alone are weaker evidence than clocks and counters

Turn = tuple[float, float, float]
# a number, or an address and port; None where a message shows neither
Identity = int | tuple[Any, ...] | None


class Repeats:
    """Refuses messages that repeat the time of the previous one, and reports a sender that keeps
    doing so.
    """

    def __init__(self, notices: Notices) -> None:
        self._notices = notices
        self._last: bytes | None = None
        self._last_sample: AttitudeSample | None = None
        self._since_ns = 0
        self._count = 0
        self._frozen = False

    def judge(self, sample: AttitudeSample, host_ns: int, raw: bytes) -> Refusal | None:
        """Why this one is refused; None where its time differs from that of the previous one, or
        it is another sender's.
        """
        last = self._last_sample
        same_time = last is not None and sample.t_ns == last.t_ns
        if last is not None and same_time and raw != self._last:
            turned = _turn_rad(last.q_icrs_to_cam.tolist(), sample.q_icrs_to_cam.tolist())
            same_time = math.hypot(*turned) <= MIN_ANOTHERS_RAD
        if not same_time:
            self._last, self._last_sample, self._since_ns, self._count = raw, sample, host_ns, 0
            return None
        self._count += 1
        if self._count >= MIN_REPEATS and host_ns - self._since_ns >= MIN_REPEATED_NS:
            what = f"the sender's clock has stopped at t_ns {sample.t_ns}"
            what = "the sender repeats one packet" if raw == self._last else what
            self._frozen = True
            self._notices.begin(
                FROZEN, f"{what}: refused (time), and the attitude shown is getting old"
            )
        self._last_sample = sample
        return Refusal("time", f"t_ns {sample.t_ns} repeats that of the previous packet")

    def resumed(self) -> bool:
        """True once after a freeze: the newest message is not a repeat."""
        if not self._frozen or self._count:
            return False
        self._frozen = False
        self._notices.end(FROZEN, "source-resumed", "the sender's clock runs again")
        return True


def _steps(before: int, sequence: int) -> int:
    """The advance of `sequence`, modulo 2^32, the shorter way."""
    return (sequence - before + U32 // 2) % U32 - U32 // 2


def _turn_rad(a: Sequence[float], b: Sequence[float]) -> Turn:
    """The turn from attitude `a` to `b` as a rate times a second; plain floats, for every packet
    passes here.
    """
    w = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]
    x = a[0] * b[1] - a[1] * b[0] - a[3] * b[2] + a[2] * b[3]
    y = a[0] * b[2] - a[2] * b[0] - a[1] * b[3] + a[3] * b[1]
    z = a[0] * b[3] - a[3] * b[0] - a[2] * b[1] + a[1] * b[2]
    sine = math.sqrt(x * x + y * y + z * z)
    scale = -2.0 if sine < 1e-9 else -2.0 * math.atan2(sine, abs(w)) / sine
    if w < 0:
        scale = -scale
    return x * scale, y * scale, z * scale


@dataclass(frozen=True, slots=True)
class _CourseAgreement:
    """Where a message agrees with a sender; `far_rad` is the distance of its attitude from the
    sender's course.
    """

    clock: bool
    count: bool
    sky: bool
    plausible: bool  # a spacecraft could have turned so far since the last message
    steady: bool  # t_ns advanced by its usual step
    far_rad: float

    @property
    def score(self) -> int:
        return self.clock + self.count + self.sky


@dataclass(slots=True)
class _KnownSender:
    """One sender: its newest message, when that arrived, and how its messages advance."""

    sample: AttitudeSample
    host_ns: int
    waited_ns: int = 0
    heard: int = 1
    since_ns: int = 0
    count: int = 0  # its newest `sequence`; count_t_ns is the time of that message
    count_t_ns: int = 0
    period_ns: float | None = None  # step of t_ns for each count, or for each message
    still: bool = True  # it does not count: its sequence never changes
    turning_rad_s: Turn | None = None
    far_rad: float = 0.0  # recent deviation of its attitudes from their course
    silence_ns: float = 0.0  # recent silence between messages
    q: list[float] = field(default_factory=list)

    @classmethod
    def of(cls, arrival: SampleArrival) -> "_KnownSender":
        sample = arrival.event
        made = cls(
            sample,
            arrival.host_ns,
            arrival.waited_ns,
            since_ns=arrival.host_ns,
            count=sample.sequence,
        )
        made.count_t_ns, made.q, made.turning_rad_s = (
            sample.t_ns,
            sample.q_icrs_to_cam.tolist(),
            _rate_of(sample),
        )
        return made

    def agrees(self, arrival: SampleArrival) -> _CourseAgreement:
        sample, period_ns = arrival.event, self.period_ns
        later_ns, gap_ns = sample.t_ns - self.sample.t_ns, arrival.host_ns - self.host_ns
        step = _steps(self.count, sample.sequence)
        clock = (
            -EARLY_NS
            <= later_ns
            <= max(gap_ns + EARLY_NS + min(self.waited_ns, NS_PER_S), 3 * (period_ns or 0.0))
        )
        # time and count may advance together, however late it is
        if not self.still and period_ns is not None and step:
            usual_ns = step * period_ns
            off_ns = abs(sample.t_ns - self.count_t_ns - usual_ns)
            clock = clock or off_ns <= 0.5 * period_ns + 0.05 * abs(usual_ns)
        counted_ns = max(later_ns if 0 < later_ns < MAX_STEP_NS else 0, gap_ns)
        max_step = MAX_FIRST_LOSSES if period_ns is None else 2 + 2 * counted_ns / period_ns
        steady = (
            period_ns is not None and STEADY[0] < later_ns / (period_ns * max(step, 1)) < STEADY[1]
        )
        turned = _turn_rad(self.q, sample.q_icrs_to_cam.tolist())
        far_rad = self._far_rad(turned, later_ns if abs(later_ns) < MAX_STEP_NS else max(gap_ns, 0))
        if not clock:
            far_rad = min(far_rad, self._far_rad(turned, max(gap_ns, 0)))
        seconds = max(abs(later_ns) if clock else gap_ns, 0) / NS_PER_S
        return _CourseAgreement(
            clock,
            1 <= step <= max_step,
            far_rad <= MIN_FAR_RAD + FAR_RATIO * self.far_rad,
            far_rad <= MIN_FAR_RAD + PLAUSIBLE_RAD_S * seconds,
            steady,
            far_rad,
        )

    def _far_rad(self, turned: Turn, meanwhile_ns: float) -> float:
        """The distance from its predicted attitude or its last one, whichever is nearer."""
        stood_rad = math.hypot(*turned)
        if self.turning_rad_s is None:
            return stood_rad
        seconds = max(-NS_PER_S, min(meanwhile_ns, NS_PER_S)) / NS_PER_S
        return min(stood_rad, math.dist(turned, [seconds * rate for rate in self.turning_rad_s]))

    def move(self, arrival: SampleArrival, agreed: _CourseAgreement) -> None:
        sample = arrival.event
        later_ns, step = sample.t_ns - self.sample.t_ns, _steps(self.count, sample.sequence)
        if agreed.clock and later_ns <= 0:  # out of order
            return
        if self.still or sample.sequence:  # 0: it mixes in a message that does not count
            counted_ns = sample.t_ns - self.count_t_ns
            if 0 < counted_ns < MAX_STEP_NS and (agreed.count or self.still):
                period_ns = counted_ns / max(step, 1)
                self.period_ns = (
                    period_ns
                    if self.period_ns is None
                    else self.period_ns + (period_ns - self.period_ns) / 8
                )
            self.still = self.still and step == 0
            self.count, self.count_t_ns = sample.sequence, sample.t_ns
        if agreed.sky or (agreed.plausible and not self.still):
            self.far_rad = max(agreed.far_rad, FORGETS * self.far_rad)
        elif agreed.plausible and not sample.discontinuity:
            self.far_rad += (agreed.far_rad - self.far_rad) * LEARNS
        q = sample.q_icrs_to_cam.tolist()
        known = _rate_of(sample)
        if known is None and NS_PER_MS <= later_ns < NS_PER_S // 4 and agreed.plausible:
            known = tuple(turn * NS_PER_S / later_ns for turn in _turn_rad(self.q, q))  # type: ignore[assignment]
        if known is not None or not agreed.plausible:
            self.turning_rad_s = known
        self.silence_ns = max(arrival.host_ns - self.host_ns, FORGETS * self.silence_ns)
        self.heard += 1
        self.sample, self.q, self.host_ns, self.waited_ns = (
            sample,
            q,
            arrival.host_ns,
            arrival.waited_ns,
        )

    def patience_ns(self, silent_after_ns: int) -> float:
        if self.heard < MIN_KNOWN or self.host_ns - self.since_ns < MIN_KNOWN_NS:
            return silent_after_ns
        return min(silent_after_ns, USUAL_SILENCES * self.silence_ns + SLACK_NS)


def _rate_of(sample: AttitudeSample) -> Turn | None:
    if sample.rate_cam_rad_s is None:
        return None
    x, y, z = sample.rate_cam_rad_s.tolist()
    return x, y, z


class _Waiting(NamedTuple):
    arrival: SampleArrival
    sender: _KnownSender


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

    def __init__(self, silent_after_ns: int, notices: Notices) -> None:
        self._silent_after_ns = silent_after_ns
        self._notices = notices
        self._main: _KnownSender | None = None
        # of the sender shown
        self._identity: Identity = None
        # host time of the newest message of another identity; it is the second sender's once the
        # sender shown has spoken after it
        self._other: Identity = None
        self._other_ns: int | None = None
        # the sender shown as it was before it went elsewhere, or another took its place
        self._left: _KnownSender | None = None
        self._strangers: list[_KnownSender] = []
        self._waiting: list[_Waiting] = []
        self._courses = 0  # between which the sender shown went to and fro
        self._two = False

    def take(self, arrival: SampleArrival) -> list[SampleArrival]:
        """The messages that this one decides, in order, those of another sender than the one
        shown with a refusal.
        """
        main, host_ns = self._main, arrival.host_ns
        if main is None:
            return self._begin(arrival)
        if _identity(arrival) != self._identity:
            return self._take_other(main, arrival)
        if self._other_ns is not None:
            self._see_other(arrival.host_ns, self._other_ns)
        self._strangers = [
            each for each in self._strangers if host_ns - each.host_ns < ANOTHER_COURSE_WITHIN_NS
        ]
        if self._two and not self._strangers and self._other_ns is None:
            self._part("the second sender is silent")
        agreed = main.agrees(arrival)
        rival = self._rival(arrival, agreed)
        own = rival is None and self._is_its_own(main, arrival.event, agreed)
        comes_back = (
            not agreed.sky and not arrival.event.discontinuity and self._comes_back(arrival, agreed)
        )
        if own and not (comes_back and self._is_too_often(main, arrival.event)):
            self._courses = self._courses + comes_back if comes_back or agreed.sky else 0
            return self._speaks(main, arrival, agreed)
        if comes_back:
            return self._return(main, arrival)
        return self._take_strange(main, arrival, rival)

    def _begin(self, arrival: SampleArrival) -> list[SampleArrival]:
        """Show this message's sender, of which nothing but this is known."""
        self._main, self._left = _KnownSender.of(arrival), None
        self._identity = _identity(arrival)
        self._strangers = []
        return [arrival]

    def _take_other(self, main: _KnownSender, arrival: SampleArrival) -> list[SampleArrival]:
        """Refuse a message of another identity, or show its sender where the first is silent."""
        # one that was not read for a while was not silent
        silent_ns = arrival.host_ns - arrival.waited_ns - main.host_ns
        if silent_ns <= self._silent_after_ns:
            self._other, self._other_ns = _identity(arrival), arrival.host_ns
            return [_refused(arrival)]
        if self._two:
            self._part("the first sender is silent; showing the other one")
        waiting = [_refused(each.arrival) for each in self._emptied()]
        self._other_ns = None
        return [*waiting, *self._begin(arrival)]

    def _see_other(self, host_ns: int, other_ns: int) -> None:
        """The sender shown has spoken after another one: there are two, until that is silent."""
        if host_ns - other_ns >= ANOTHER_COURSE_WITHIN_NS:
            self._other_ns = None
        elif not self._two:
            shown, refused = _named(self._identity), _named(self._other)
            self._tell_two(f"showing {shown}, refusing {refused}")

    def expire(self, host_ns: int) -> list[SampleArrival]:
        """Strangers' messages, where the sender shown has been silent for longer than it usually
        is.
        """
        main = self._main
        if (
            main is None
            or not self._waiting
            or host_ns - main.host_ns <= main.patience_ns(self._silent_after_ns)
        ):
            return []
        return self._give_way(main, self._waiting[-1].sender)

    def release(self) -> list[SampleArrival]:
        """The messages that still wait, undecided."""
        return [each.arrival for each in self._emptied()]

    def _rival(self, arrival: SampleArrival, agreed: _CourseAgreement) -> _KnownSender | None:
        """The stranger that a message fits better than the sender shown, if there is one."""
        best: _KnownSender | None = None
        score, far_rad = agreed.score, agreed.far_rad if agreed.sky else FAR_RATIO * agreed.far_rad
        for each in self._strangers:
            its = each.agrees(arrival)
            if (its.clock or its.count) and (
                its.score > score or (its.score == score and FAR_RATIO * its.far_rad < far_rad)
            ):
                best, score, far_rad = each, its.score, its.far_rad
        return best

    def _is_its_own(
        self, main: _KnownSender, sample: AttitudeSample, agreed: _CourseAgreement
    ) -> bool:
        """Two of three agree; a turn to a new target is said, or could have been made, or comes
        by the usual step.
        """
        if agreed.sky:
            return agreed.clock or agreed.count
        if agreed.count and not agreed.clock:
            return agreed.plausible
        turned = sample.discontinuity or agreed.plausible or agreed.steady
        counts = agreed.count or (main.still and sample.sequence == main.count)
        return agreed.clock and (counts and turned)

    def _speaks(
        self, main: _KnownSender, arrival: SampleArrival, agreed: _CourseAgreement
    ) -> list[SampleArrival]:
        """The sender shown has spoken: what strangers said meanwhile is refused, unless it
        continues in one count.
        """
        if not agreed.sky or not agreed.clock:
            self._left = replace(main)
        elif (
            self._left is not None
            and arrival.host_ns - self._left.host_ns > self._left.patience_ns(self._silent_after_ns)
        ):
            self._left = None
        waiting = self._emptied()
        counts = [
            main.count,
            *(each.arrival.event.sequence for each in waiting),
            arrival.event.sequence,
        ]
        main.move(arrival, agreed)
        if all(1 <= _steps(before, after) <= 2 for before, after in pairwise(counts)):
            return [*(each.arrival for each in waiting), arrival]
        if any(each.sender.heard >= MIN_STRANGE for each in waiting):
            self._tell_two()
        return [*(_refused(each.arrival) for each in waiting), arrival]

    def _tell_two(self, which: str = "showing the first, refusing the other") -> None:
        self._two = True
        self._notices.begin(SECOND, f"two senders on one link: {which} (source)")

    def _is_too_often(self, main: _KnownSender, sample: AttitudeSample) -> bool:
        """True where one sender would hardly go to and fro like that: it has only begun to
        count, or it never counts.
        """
        if sample.sequence:
            return main.heard <= 2
        return main.still and self._courses >= MIN_COURSES and self._courses % 2 == 0

    def _comes_back(self, arrival: SampleArrival, agreed: _CourseAgreement) -> bool:
        """Whether the sender that was left is there again, and goes on as if nothing had been
        between.
        """
        left = self._left
        if left is None or arrival.host_ns - left.host_ns > max(
            left.patience_ns(self._silent_after_ns), self._silent_after_ns
        ):
            return False
        its = left.agrees(arrival)
        return its.sky and its.score > agreed.score and (its.clock or its.count)

    def _return(self, main: _KnownSender, arrival: SampleArrival) -> list[SampleArrival]:
        """Show the first sender again; who took its place is a stranger."""
        left = self._left
        if left is None:
            raise AssertionError("only a sender that was left comes back")
        self._main, self._left, self._courses = left, None, 0
        self._add_stranger(main)
        if main.heard - left.heard >= MIN_STRANGE:
            self._tell_two()
        return self._speaks(left, arrival, left.agrees(arrival))

    def _take_strange(
        self, main: _KnownSender, arrival: SampleArrival, rival: _KnownSender | None
    ) -> list[SampleArrival]:
        sender = rival or self._known(arrival)
        if sender is None:
            sender = _KnownSender.of(arrival)
            self._add_stranger(sender)
        elif arrival.event.t_ns == sender.sample.t_ns:
            refusal = Refusal(
                "time", f"t_ns {arrival.event.t_ns} repeats that of an earlier packet"
            )
            return [replace(arrival, refusal=refusal)]
        else:
            sender.move(arrival, sender.agrees(arrival))
        self._waiting.append(_Waiting(arrival, sender))
        # one that was not read for a while was not silent
        silent_ns = arrival.host_ns - arrival.waited_ns - main.host_ns
        patience_ns = main.patience_ns(self._silent_after_ns)
        if silent_ns > max(self._silent_after_ns, 3 * (main.period_ns or 0.0)):
            self._left = None
            return self._give_way(main, sender, for_good=True)
        if not self._two and silent_ns > patience_ns:
            return self._give_way(main, sender)
        if self._two:
            return [_refused(each.arrival) for each in self._emptied()]
        return []

    def _known(self, arrival: SampleArrival) -> _KnownSender | None:
        """The stranger that this message continues in two of three, or that repeats itself in
        it.
        """
        for each in self._strangers:
            its = each.agrees(arrival)
            if (
                its.score >= 2
                or (its.clock and its.plausible)
                or arrival.event.t_ns == each.sample.t_ns
            ):
                return each
        return None

    def _give_way(
        self, main: _KnownSender, sender: _KnownSender, *, for_good: bool = False
    ) -> list[SampleArrival]:
        """The sender shown is silent: another one is shown, or the same one begun anew."""
        if self._two:
            self._part("the first sender is silent; showing the other one")
        self._main, self._left = sender, None if for_good else main
        self._strangers = [each for each in self._strangers if each is not sender]
        if for_good:
            self._add_stranger(main)
        return [
            each.arrival if each.sender is sender else _refused(each.arrival)
            for each in self._emptied()
        ]

    def _emptied(self) -> list[_Waiting]:
        waiting, self._waiting = self._waiting, []
        return waiting

    def _add_stranger(self, sender: _KnownSender) -> None:
        self._strangers = [*self._strangers[-MAX_STRANGERS + 1 :], sender]

    def _part(self, why: str) -> None:
        self._two = False
        self._notices.end(SECOND, "second-sender-gone", why)


def _refused(arrival: SampleArrival) -> SampleArrival:
    detail = "from a second sender on the same link; the one that was there first is shown"
    return replace(arrival, refusal=Refusal("source", detail))
