"""Who sends: a sender that hangs or whose clock has stopped, and a second sender on the same link; no I/O.

A link does not say who sent a packet, so the packets themselves must. Two senders have two counters: where their packets
alternate, `sequence` goes back while `t_ns` advances, again and again, and each counter by itself is regular; a single sender
does that once, when it restarts. Without a sequence the attitudes must tell: alternately near one of two, and each time far
from the other. A declared jump (discontinuity), a reordered packet and a new target are not a second sender.
"""

from __future__ import annotations

from dataclasses import dataclass

from hilstar.attitude.wire.packet import U32, AttitudeSample, Refusal
from hilstar.notices import Notices
from hilstar.rotation import angle_between_rad, propagate
from hilstar.units import NS_PER_S

SECOND, FROZEN = "second-sender", "source-frozen"
MIN_REPEATS = 10  # and
MIN_REPEATED_NS = NS_PER_S // 4
MIN_TURNS = 3  # from the other sender back to the first, within
TURNS_WITHIN_NS = 5 * NS_PER_S
MIN_TURNS_BY_MOTION = 8  # attitudes alone are weaker evidence than two counters
FAR_RATIO = 4.0  # of the distance from one sender to that from the other
MIN_FAR_RAD = 5e-5  # 10 arcsec
MAX_FIRST_LOSSES = 16  # packets missing, while their period is not known yet
MAX_STEP_NS = 10 * NS_PER_S
MAX_REORDERED = 64


class Repeats:
    """Refuses messages that repeat the time of the previous one, and reports a sender that keeps doing so."""

    def __init__(self, notices: Notices) -> None:
        self._notices = notices
        self._last: bytes | None = None
        self._last_t_ns: int | None = None
        self._since_ns = 0
        self._count = 0
        self._frozen = False

    def judge(self, sample: AttitudeSample, host_ns: int, raw: bytes) -> Refusal | None:
        """Why this one is refused; None where its time differs from that of the previous one."""
        if sample.t_ns != self._last_t_ns:
            self._last, self._last_t_ns, self._since_ns, self._count = raw, sample.t_ns, host_ns, 0
            return None
        self._count += 1
        if self._count >= MIN_REPEATS and host_ns - self._since_ns >= MIN_REPEATED_NS:
            what = (
                "the sender repeats one packet"
                if raw == self._last
                else f"the sender's clock has stopped at t_ns {sample.t_ns}"
            )
            self._frozen = True
            self._notices.begin(FROZEN, f"{what}: refused (time), and the attitude shown is getting old")
        return Refusal("time", f"t_ns {sample.t_ns} repeats that of the previous packet")

    def resumed(self) -> bool:
        """True once after a freeze: the newest message is not a repeat."""
        if not self._frozen or self._count:
            return False
        self._frozen = False
        self._notices.end(FROZEN, "source-resumed", "the sender's clock runs again")
        return True


@dataclass(slots=True)
class _Track:
    """What is known of one sender: its newest sample, when that arrived, and how its packets advance."""

    sample: AttitudeSample
    host_ns: int
    period_ns: float | None = None
    still: bool = True  # it does not count: its sequence never changes

    def step(self, sample: AttitudeSample) -> int:
        """By how much `sequence` advances from here, modulo 2^32, taken the shorter way."""
        return (sample.sequence - self.sample.sequence + U32 // 2) % U32 - U32 // 2

    def may_reach(self, sample: AttitudeSample, host_ns: int) -> bool:
        """True where this counter may have reached that sequence by now."""
        step, later_ns = self.step(sample), sample.t_ns - self.sample.t_ns
        if self.still and step == 0:
            return later_ns > 0
        gap_ns = max(later_ns if 0 < later_ns < MAX_STEP_NS else 0, host_ns - self.host_ns)
        max_step = MAX_FIRST_LOSSES if self.period_ns is None else 2 + 2 * gap_ns / self.period_ns
        return 1 <= step <= max_step

    def far_rad(self, sample: AttitudeSample) -> float:
        """The angle from that attitude to this sender's last one, propagated to its time."""
        at = self.sample
        later_s = min(max(sample.t_ns - at.t_ns, 0), NS_PER_S) / NS_PER_S
        q = at.q_icrs_to_cam if at.rate_cam_rad_s is None else propagate(at.q_icrs_to_cam, at.rate_cam_rad_s, later_s)
        return angle_between_rad(q, sample.q_icrs_to_cam)

    def move(self, sample: AttitudeSample, host_ns: int) -> None:
        """Take the next sample of this sender."""
        step, later_ns = self.step(sample), sample.t_ns - self.sample.t_ns
        if 0 < later_ns < MAX_STEP_NS:
            period_ns = later_ns / max(step, 1)
            self.period_ns = period_ns if self.period_ns is None else self.period_ns + (period_ns - self.period_ns) / 8
        self.sample, self.host_ns, self.still = sample, host_ns, self.still and step == 0


class Senders:
    """Follows the sender that was there first, until it has been silent for `silent_after_ns`."""

    def __init__(self, silent_after_ns: int, notices: Notices) -> None:
        self._silent_after_ns = silent_after_ns
        self._notices = notices
        self._main: _Track | None = None
        self._other: _Track | None = None
        self._turn_ns = 0
        self._turns = 0
        self._other_spoke = False
        self._at_odds = False
        self._previous: _Track | None = None
        self._two = False

    def judge(self, sample: AttitudeSample, host_ns: int, waited_ns: int = 0) -> Refusal | None:
        """Why a sample read at `host_ns`, which may have waited, is refused: it is from another sender than the one shown."""
        main = self._main
        self._compare(sample, host_ns)
        if main is None:
            self._main = _Track(sample, host_ns)
            return None
        if self._two and (self._other is None or host_ns - self._other.host_ns > TURNS_WITHIN_NS):
            self._part("the second sender is silent")
        if not self._is_silent(main, host_ns - waited_ns):  # a sender that was not read for a while was not silent
            return self._assign(main, sample, host_ns)
        other = self._two and self._is_other(main, sample, host_ns)
        if other:
            self._part("the first sender is silent; showing the other one")
        if main.may_reach(sample, host_ns) and not other:
            main.move(sample, host_ns)
        else:
            self._main, self._other, self._turns = _Track(sample, host_ns), None, 0
        return None

    def _compare(self, sample: AttitudeSample, host_ns: int) -> None:
        """Against the previous message: a single sender's count and time advance together, and its time as the host's."""
        if self._previous is not None:
            before = self._previous
            later_ns, step = sample.t_ns - before.sample.t_ns, before.step(sample)
            backwards = step <= 0 < later_ns or later_ns < 0 < step
            self._at_odds |= backwards or abs(later_ns - (host_ns - before.host_ns)) > NS_PER_S
        self._previous = _Track(sample, host_ns)

    def _is_other(self, main: _Track, sample: AttitudeSample, host_ns: int) -> bool:
        if not main.may_reach(sample, host_ns):
            return True
        other = self._other
        return other is not None and other.may_reach(sample, host_ns) and other.far_rad(sample) < main.far_rad(sample)

    def _is_silent(self, main: _Track, host_ns: int) -> bool:
        return host_ns - main.host_ns > max(self._silent_after_ns, 3 * (main.period_ns or 0.0))

    def _assign(self, main: _Track, sample: AttitudeSample, host_ns: int) -> Refusal | None:
        other = self._other
        if main.still and main.step(sample) == 0:
            is_main = self._nearer_main(main, other, sample)
        elif self._out_of_order(main, sample):
            return None
        else:
            is_main = main.may_reach(sample, host_ns)
            if is_main and other is not None and other.may_reach(sample, host_ns):
                is_main = main.far_rad(sample) <= other.far_rad(sample)
        if is_main:
            main.move(sample, host_ns)
            self._count_turn(host_ns)
            return None
        if other is None or not other.may_reach(sample, host_ns):
            self._turns = self._turns if other is None else 0  # a sender that counts like that is not a second one
            self._other = _Track(sample, host_ns)
        else:
            other.move(sample, host_ns)
            self._other_spoke = True
        if not self._two:
            return None
        return Refusal("source", "from a second sender on the same link; the one that was there first is shown")

    def _out_of_order(self, main: _Track, sample: AttitudeSample) -> bool:
        return -MAX_REORDERED <= main.step(sample) <= 0 and sample.t_ns <= main.sample.t_ns

    def _nearer_main(self, main: _Track, other: _Track | None, sample: AttitudeSample) -> bool:
        """By motion alone, where no sender counts; a sample near both or neither decides nothing, and is the first sender's."""
        far_rad = main.far_rad(sample)
        if other is None or self._two:
            if other is not None:
                return far_rad <= other.far_rad(sample)
            return sample.discontinuity or far_rad < MIN_FAR_RAD
        other_rad = other.far_rad(sample)
        clear = max(far_rad, other_rad) > max(FAR_RATIO * min(far_rad, other_rad), MIN_FAR_RAD)
        if not clear or sample.discontinuity:
            self._other, self._turns = None, 0
            return True
        return far_rad < other_rad

    def _count_turn(self, host_ns: int) -> None:
        """The first sender has sent; the other one may have since the first last did."""
        if not self._other_spoke or not self._at_odds:
            return
        self._other_spoke = self._at_odds = False
        self._turns = self._turns + 1 if host_ns - self._turn_ns < TURNS_WITHIN_NS else 1
        self._turn_ns = host_ns
        counted = self._main is not None and not self._main.still
        if self._turns >= (MIN_TURNS if counted else MIN_TURNS_BY_MOTION) and not self._two:
            self._two = True
            self._notices.begin(SECOND, "two senders on one link: showing the first, refusing the other (source)")

    def _part(self, why: str) -> None:
        self._two, self._turns = False, 0
        self._notices.end(SECOND, "second-sender-gone", why)
