"""Who sends: a sender that hangs or whose clock stands, and a second one on the same road; no I/O.

A road says nothing of who sent a packet, so the packets themselves have to. Two senders have two counters: where their packets
come by turns, `sequence` goes back while `t_ns` goes on, again and again, and each counter by itself goes on as ever; one
sender does that once, when it starts anew. Without a sequence their attitudes must tell: by turns near one of two, and each
time far from the other. A jump that says so (discontinuity), a reordered packet and a new target are none of this.
"""

from __future__ import annotations

from dataclasses import dataclass

from hilstar.attitude.wire.packet import U32, AttitudeSample, Refusal
from hilstar.notices import Notices
from hilstar.rotation import angle_between_rad, propagate
from hilstar.units import NS_PER_S

SECOND, FROZEN = "second-sender", "source-frozen"
REPEATS = 10  # and
REPEATED_FOR_NS = NS_PER_S // 4
TURNS = 3  # from the other sender back to the first, within
TURNS_WITHIN_NS = 5 * NS_PER_S
TURNS_BY_MOTION = 8  # attitudes alone say less than two counters
FAR = 4.0  # so many times farther from one than from the other
MIN_FAR_RAD = 5e-5  # 10 arcsec
FIRST_LOSSES = 16  # how many packets may be missing while nobody knows how often they come
MAX_STEP_NS = 10 * NS_PER_S
REORDERED = 64


class Repeats:
    """Refuses what repeats the time of the message before, and says so once when it goes on."""

    def __init__(self, notices: Notices) -> None:
        self._notices = notices
        self._last: bytes | None = None
        self._last_t_ns: int | None = None
        self._since_ns = 0
        self._count = 0
        self._frozen = False

    def judge(self, sample: AttitudeSample, host_ns: int, raw: bytes) -> Refusal | None:
        """Why this one is refused; None where its time is another than that of the one before."""
        if sample.t_ns != self._last_t_ns:
            self._last, self._last_t_ns, self._since_ns, self._count = raw, sample.t_ns, host_ns, 0
            return None
        self._count += 1
        if self._count >= REPEATS and host_ns - self._since_ns >= REPEATED_FOR_NS:
            what = "the sender repeats one packet" if raw == self._last else f"the sender's clock stands at t_ns {sample.t_ns}"
            self._frozen = True
            self._notices.begin(FROZEN, f"{what}: refused (time), and the attitude on show grows old")
        return Refusal("time", f"t_ns {sample.t_ns} is that of the packet before it")

    def resumed(self) -> bool:
        """True once after a freeze: the newest message is no repeat any more."""
        if not self._frozen or self._count:
            return False
        self._frozen = False
        self._notices.end(FROZEN, "source-resumed", "the sender's clock goes on")
        return True


@dataclass(slots=True)
class _Track:
    """What is known of one sender: its newest sample, when that came, and how its packets go on."""

    sample: AttitudeSample
    host_ns: int
    period_ns: float | None = None
    still: bool = True  # it does not count: its sequence is always the same

    def step(self, sample: AttitudeSample) -> int:
        """By how much `sequence` goes on from here, modulo 2^32, as the smaller of the two ways."""
        return (sample.sequence - self.sample.sequence + U32 // 2) % U32 - U32 // 2

    def goes_on(self, sample: AttitudeSample, host_ns: int) -> bool:
        """True where this counter may have come to that sequence by now."""
        step, later_ns = self.step(sample), sample.t_ns - self.sample.t_ns
        if self.still and step == 0:
            return later_ns > 0
        gap_ns = max(later_ns if 0 < later_ns < MAX_STEP_NS else 0, host_ns - self.host_ns)
        most = FIRST_LOSSES if self.period_ns is None else 2 + 2 * gap_ns / self.period_ns
        return 1 <= step <= most

    def far_rad(self, sample: AttitudeSample) -> float:
        """How far that attitude is from where this sender's last one turned to."""
        at = self.sample
        later_s = min(max(sample.t_ns - at.t_ns, 0), NS_PER_S) / NS_PER_S
        q = at.q_icrs_to_cam if at.rate_cam_rad_s is None else propagate(at.q_icrs_to_cam, at.rate_cam_rad_s, later_s)
        return angle_between_rad(q, sample.q_icrs_to_cam)

    def move(self, sample: AttitudeSample, host_ns: int) -> None:
        """The next one of this sender."""
        step, later_ns = self.step(sample), sample.t_ns - self.sample.t_ns
        if 0 < later_ns < MAX_STEP_NS:
            period_ns = later_ns / max(step, 1)
            self.period_ns = period_ns if self.period_ns is None else self.period_ns + (period_ns - self.period_ns) / 8
        self.sample, self.host_ns, self.still = sample, host_ns, self.still and step == 0


class Senders:
    """Keeps to the sender that was there first, until it has been silent for `silent_after_ns`."""

    def __init__(self, silent_after_ns: int, notices: Notices) -> None:
        self._silent_after_ns = silent_after_ns
        self._notices = notices
        self._main: _Track | None = None
        self._other: _Track | None = None
        self._turn_ns = 0
        self._turns = 0
        self._other_spoke = False
        self._at_odds = False
        self._previous: tuple[AttitudeSample, int] | None = None
        self._two = False

    def judge(self, sample: AttitudeSample, host_ns: int, waited_ns: int = 0) -> Refusal | None:
        """Why this one is refused, read at `host_ns` after it may have waited: it is another sender's than the one shown."""
        main = self._main
        self._compare(sample, host_ns)
        if main is None:
            self._main = _Track(sample, host_ns)
            return None
        if self._two and (self._other is None or host_ns - self._other.host_ns > TURNS_WITHIN_NS):
            self._part("the second sender is silent")
        if not self._is_silent(main, host_ns - waited_ns):  # who was not read for a while was not silent
            return self._assign(main, sample, host_ns)
        other = self._two and self._is_other(main, sample, host_ns)
        if other:
            self._part("the first sender is silent; the other one is shown")
        if main.goes_on(sample, host_ns) and not other:
            main.move(sample, host_ns)
        else:
            self._main, self._other, self._turns = _Track(sample, host_ns), None, 0
        return None

    def _compare(self, sample: AttitudeSample, host_ns: int) -> None:
        """With the message before it: of one sender count and time go the same way, and its time goes on as the host's."""
        if self._previous is not None:
            before, then_ns = self._previous
            later_ns = sample.t_ns - before.t_ns
            step = _Track(before, then_ns).step(sample)
            backwards = step <= 0 < later_ns or later_ns < 0 < step
            self._at_odds |= backwards or abs(later_ns - (host_ns - then_ns)) > NS_PER_S
        self._previous = (sample, host_ns)

    def _is_other(self, main: _Track, sample: AttitudeSample, host_ns: int) -> bool:
        if not main.goes_on(sample, host_ns):
            return True
        other = self._other
        return other is not None and other.goes_on(sample, host_ns) and other.far_rad(sample) < main.far_rad(sample)

    def _is_silent(self, main: _Track, host_ns: int) -> bool:
        return host_ns - main.host_ns > max(self._silent_after_ns, 3 * (main.period_ns or 0.0))

    def _assign(self, main: _Track, sample: AttitudeSample, host_ns: int) -> Refusal | None:
        other = self._other
        if main.still and main.step(sample) == 0:
            is_main = self._nearer_main(main, other, sample)
        elif self._out_of_order(main, sample):
            return None
        else:
            is_main = main.goes_on(sample, host_ns)
            if is_main and other is not None and other.goes_on(sample, host_ns):
                is_main = main.far_rad(sample) <= other.far_rad(sample)
        if is_main:
            main.move(sample, host_ns)
            self._count_turn(host_ns)
            return None
        if other is None or not other.goes_on(sample, host_ns):
            self._turns = self._turns if other is None else 0  # whoever counts like that is no second sender
            self._other = _Track(sample, host_ns)
        else:
            other.move(sample, host_ns)
            self._other_spoke = True
        if not self._two:
            return None
        return Refusal("source", "another sender's, which speaks at the same time; the one that was there first is shown")

    def _out_of_order(self, main: _Track, sample: AttitudeSample) -> bool:
        return -REORDERED <= main.step(sample) <= 0 and sample.t_ns <= main.sample.t_ns

    def _nearer_main(self, main: _Track, other: _Track | None, sample: AttitudeSample) -> bool:
        """By motion alone, where nobody counts; what is near both or neither says nothing, and is the first sender's."""
        far_rad = main.far_rad(sample)
        if other is None or self._two:
            if other is not None:
                return far_rad <= other.far_rad(sample)
            return sample.discontinuity or far_rad < MIN_FAR_RAD
        other_rad = other.far_rad(sample)
        clear = max(far_rad, other_rad) > max(FAR * min(far_rad, other_rad), MIN_FAR_RAD)
        if not clear or sample.discontinuity:
            self._other, self._turns = None, 0
            return True
        return far_rad < other_rad

    def _count_turn(self, host_ns: int) -> None:
        """The first sender speaks; the other may have since it last did."""
        if not self._other_spoke or not self._at_odds:
            return
        self._other_spoke = self._at_odds = False
        self._turns = self._turns + 1 if host_ns - self._turn_ns < TURNS_WITHIN_NS else 1
        self._turn_ns = host_ns
        counted = self._main is not None and not self._main.still
        if self._turns >= (TURNS if counted else TURNS_BY_MOTION) and not self._two:
            self._two = True
            self._notices.begin(SECOND, "two senders speak at the same time; the first is shown, the other refused (source)")

    def _part(self, why: str) -> None:
        self._two, self._turns = False, 0
        self._notices.end(SECOND, "second-sender-gone", why)
