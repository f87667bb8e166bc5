"""A sender's clock that jumps or runs slow: samples in, the same samples on a clock without jumps out; no I/O.

Laws:
1. A jump shows in t_ns itself: its step is not the usual one. A message that comes early or late by a small amount while t_ns
   goes on as ever was under way for a shorter or longer time, and is taken as it is.
2. Samples in doubt wait for the next ones: three that agree are a jump, and go on from where the old clock stood; an early
   one that the next contradicts is refused; late ones that do not agree were queued, and go on as they are.
3. A message that waited unread for so long is allowed to be late by as much, and teaches nothing.
4. Until the clock is settled, a message that comes early says that those before it were late.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from hilstar.attitude.clock.sender_clock import SLOT_NS, OneWayFilter
from hilstar.attitude.wire.packet import AttitudeSample, Refusal
from hilstar.units import NS_PER_MS, NS_PER_S

ENOUGH = 3
LATE_FOR_NS = 100 * NS_PER_MS  # a queue can be late by the same for a moment
SURELY_A_JUMP_NS = NS_PER_S  # and never for as long as this
MIN_LIMIT_NS = 5 * NS_PER_MS
AGREEMENT_NS = 2 * NS_PER_MS
UNSETTLED_NS = 100 * NS_PER_MS
SETTLED_AFTER = 50  # messages, and
SETTLED_AFTER_NS = 2 * NS_PER_S
LONGEST_DOUBT_NS = 250 * NS_PER_MS
# How early a message may be with respect to a first guess: one that waited, for minutes perhaps, or one read late.
GUESSED_LATE_NS = 60 * NS_PER_S
FOUND_LATE_NS = NS_PER_S
WAITED_UNKNOWN_NS = 2**62  # a message that was there before anybody listened
TRUSTED_WAIT_NS = NS_PER_MS  # the clock's filter of minima deals with what is shorter
CLEARLY_LATE_FOR_NS = 3 * LATE_FOR_NS  # late by the same, where t_ns itself shows no jump: a sender that was stopped
UNKNOWN_DRIFT = 1e-4  # while nothing comes, the clocks part by so much of the time
PACE_SLOTS = 9
FOLLOWED_NS = 60 * NS_PER_S  # what a slow clock may fall behind before it is known to be slow; more is a jump
ODD_PACE = 0.004  # of itself, steadily: twice what a crystal is allowed, so t_ns runs slow or fast
STEPS = 31
ENOUGH_STEPS = 8
MOST_MISSING = 1000  # a sequence that goes on by more is not one


@dataclass(frozen=True, slots=True)
class Arrived:
    """A sample, when it was read (host time), its bytes, why it is refused, if it is, and how long it may have waited."""

    sample: AttitudeSample
    host_ns: int
    raw: bytes = b""
    refusal: Refusal | None = None
    waited_ns: int = 0

    @property
    def timely(self) -> bool:
        """True where its arrival is known well enough to teach a clock."""
        return self.waited_ns <= TRUSTED_WAIT_NS


class Steps:
    """By how much t_ns usually goes on from one message to the next."""

    def __init__(self) -> None:
        self._last: AttitudeSample | None = None
        self._usual_ns: deque[float] = deque(maxlen=STEPS)
        self._step_ns: tuple[int, int] = (0, 1)  # the newest: ns, and packets

    def add(self, sample: AttitudeSample) -> None:
        """Take in the next message, refused or not."""
        if self._last is not None:
            packets = sample.sequence - self._last.sequence
            self._step_ns = (sample.t_ns - self._last.t_ns, packets if 1 <= packets <= MOST_MISSING else 1)
            self._usual_ns.append(self._step_ns[0] / self._step_ns[1])
        self._last = sample

    def show_no_jump(self, by_ns: float) -> bool:
        """True where a jump by `by_ns` would show in the newest step of t_ns, and does not."""
        if len(self._usual_ns) < ENOUGH_STEPS:
            return False
        usual_ns = np.array(self._usual_ns)
        period_ns = float(np.median(usual_ns))
        if np.median(np.abs(usual_ns - period_ns)) > abs(by_ns) / 4:
            return False
        step_ns, packets = self._step_ns
        irregular_ns = min(abs(step_ns - packets * period_ns), abs(step_ns - period_ns))
        return irregular_ns < abs(by_ns) / 2


class Pace:
    """How fast the sender's clock goes, from the least late messages of the last two seconds."""

    def __init__(self) -> None:
        self.slowness = 0.0
        self._slots: deque[tuple[int, int, int]] = deque(maxlen=PACE_SLOTS)  # (slot, host_ns, offset_ns), offsets as sent

    def add(self, host_ns: int, offset_ns: int) -> None:
        """Take in one message's arrival and (arrival - t_ns)."""
        slot = host_ns // SLOT_NS
        if self._slots and self._slots[-1][0] == slot:
            if offset_ns < self._slots[-1][2]:
                self._slots[-1] = (slot, host_ns, offset_ns)
            return
        if len(self._slots) == PACE_SLOTS:
            self._look()
        self._slots.append((slot, host_ns, offset_ns))

    def _look(self) -> None:
        """Slow, or fast, is what goes on steadily; a jump or a queue is a step, and says nothing."""
        _, first_ns, base_ns = self._slots[0]
        x = np.array([host_ns - first_ns for _, host_ns, _ in self._slots], dtype=np.float64)
        y = np.array([offset_ns - base_ns for *_, offset_ns in self._slots], dtype=np.float64)
        slope = y[-1] / x[-1]
        uneven_ns = np.abs(y - slope * x).max()
        if abs(slope) > ODD_PACE and uneven_ns < abs(y[-1]) / 5:
            self.slowness = float(slope)
        elif abs(slope) < ODD_PACE / 2 and uneven_ns < ODD_PACE * x[-1]:
            self.slowness = 0.0


class JumpFilter:
    """Samples with the bench's times in, samples with continuous times out, in the order of arrival.

    `spread_ns` is by how much the samples differed that agreed on the last jump.
    """

    def __init__(self) -> None:
        self.correction_ns = 0  # continuous time minus the bench's
        self.jumps = 0
        self.spread_ns = 0.0
        self.clock_known = False  # by exchanges: what comes ever later, in its usual steps, queues on the road
        self._pace = Pace()
        self._model = OneWayFilter()
        self._base_ns: int | None = None
        self._steps = Steps()
        self._usual_ns: deque[float] = deque(maxlen=256)  # how late messages are that raise no doubt
        self._limit_ns: float = UNSETTLED_NS
        self._agreement_ns: float = AGREEMENT_NS
        self._doubtful: list[tuple[Arrived, float]] = []
        self._first_ns: int | None = None  # when the first timely message came
        self._near_count = 0
        self._near_ns: int | None = None  # when the last one came that was neither late nor early
        self._shows_none = False  # t_ns itself went on as usual where the samples in doubt began
        self._resumes = False

    @property
    def settled(self) -> bool:
        """True once the clock is known well enough to say that a message is early."""
        return self._limit_ns < UNSETTLED_NS

    @property
    def slowness(self) -> float:
        """By what part of itself the sender's clock is slow: 0.5 at half speed, negative where it is fast."""
        return self._pace.slowness

    def forgive(self) -> None:
        """The sender's clock stood: where it goes on from there, it did not jump."""
        self._resumes = True

    def take(self, arrived: Arrived) -> list[Arrived]:
        """The samples that this one decides, itself among them unless it is in doubt."""
        self._steps.add(arrived.sample)
        late_ns = self._late_ns(arrived)
        if arrived.timely:
            self._pace.add(arrived.host_ns, arrived.host_ns - arrived.sample.t_ns)
        if self.slowness > 0 and not self.clock_known and arrived.timely and MIN_LIMIT_NS < late_ns < FOLLOWED_NS:
            return [*self._carry_on(late_ns, self.release()), self._accept(arrived)]
        if self._usual(arrived, late_ns):
            return [*self._contradicted(), self._accept(arrived)]
        decided: list[Arrived] = []
        if self._doubtful and not self._agrees(arrived, late_ns):
            decided = self.release()
            late_ns = self._late_ns(arrived)
        if not self._doubtful:
            self._shows_none = self._steps.show_no_jump(late_ns)
            if self._shows_none and (late_ns <= UNSETTLED_NS or self.clock_known):
                return [*decided, self._accept(arrived)]
        self._doubtful.append((arrived, late_ns))
        if self._is_jump(arrived.host_ns):
            decided += self._jump()
        return decided

    def expire(self, host_ns: int) -> list[Arrived]:
        """Samples in doubt that nothing followed."""
        if self._doubtful and host_ns - self._doubtful[-1][0].host_ns > LONGEST_DOUBT_NS:
            return self.release()
        return []

    def release(self) -> list[Arrived]:
        """The samples in doubt, as they are."""
        released = [self._accept(arrived) for arrived, _ in self._doubtful]
        self._doubtful.clear()
        return released

    def _usual(self, arrived: Arrived, late_ns: float) -> bool:
        """What comes so is no reason for doubt."""
        limit_ns = self._limit_after_silence_ns(arrived.host_ns)
        if late_ns >= 0:
            return late_ns <= limit_ns + arrived.waited_ns
        if self._model.guessed:
            return -late_ns <= GUESSED_LATE_NS
        return -late_ns <= (limit_ns if self.settled else FOUND_LATE_NS)

    def _limit_after_silence_ns(self, host_ns: int) -> float:
        silent_ns = 0 if self._near_ns is None else host_ns - self._near_ns
        return self._limit_ns + UNKNOWN_DRIFT * silent_ns

    def _agrees(self, arrived: Arrived, late_ns: float) -> bool:
        """This one supports the samples in doubt: it is off by the same, and goes on from them."""
        last = self._doubtful[-1][0].sample
        by_ns = AGREEMENT_NS if self._shows_none else self._agreement_ns
        return arrived.sample.t_ns > last.t_ns and abs(late_ns - self._doubtful[0][1]) <= by_ns

    def _contradicted(self) -> list[Arrived]:
        """The samples in doubt, once one came that is as late as usual: early ones were never true."""
        early = [item for item in self._doubtful if item[1] < 0]
        self._doubtful = [item for item in self._doubtful if item[1] >= 0]
        refused = [
            replace(
                arrived, refusal=Refusal("time", f"t_ns {arrived.sample.t_ns} is {-late / NS_PER_S:.3g} s ahead of the bench")
            )
            for arrived, late in early
        ]
        return refused + self.release()

    def _offset_ns(self, arrived: Arrived) -> int:
        offset_ns = arrived.host_ns - arrived.sample.t_ns - self.correction_ns
        if self._base_ns is None:
            self._base_ns = offset_ns
        return offset_ns - self._base_ns

    def _late_ns(self, arrived: Arrived) -> float:
        offset_ns = self._offset_ns(arrived)
        return 0.0 if self._model.line is None else offset_ns - self._model.line.at(arrived.host_ns)

    def _accept(self, arrived: Arrived) -> Arrived:
        late_ns = self._late_ns(arrived)
        if arrived.waited_ns == WAITED_UNKNOWN_NS:
            self._model.guess(arrived.host_ns, self._offset_ns(arrived))
        elif arrived.timely:
            self._model.observe(arrived.host_ns, self._offset_ns(arrived))
            self._learn(arrived.host_ns, late_ns)
        return replace(arrived, sample=replace(arrived.sample, t_ns=arrived.sample.t_ns + self.correction_ns))

    def _learn(self, host_ns: int, late_ns: float) -> None:
        if self._first_ns is None:
            self._first_ns = host_ns
        if late_ns > self._limit_after_silence_ns(host_ns):
            return
        self._near_ns = host_ns
        self._resumes = False
        self._usual_ns.append(max(late_ns, 0.0))
        self._near_count += 1
        if self._near_count >= SETTLED_AFTER and host_ns - self._first_ns >= SETTLED_AFTER_NS:
            self._settle()

    def _settle(self) -> None:
        self._near_count = 0
        usual_ns = sorted(self._usual_ns)
        most_ns = usual_ns[int(0.95 * len(usual_ns))]
        self._limit_ns = min(max(MIN_LIMIT_NS, 2 * most_ns), UNSETTLED_NS)
        self._agreement_ns = max(AGREEMENT_NS, most_ns)

    def _is_jump(self, host_ns: int) -> bool:
        if len(self._doubtful) < ENOUGH:
            return False
        late_ns = self._doubtful[-1][1]
        for_ns = host_ns - self._doubtful[0][0].host_ns
        if self._shows_none and not self._resumes:
            return for_ns >= CLEARLY_LATE_FOR_NS
        return late_ns < 0 or late_ns > SURELY_A_JUMP_NS or for_ns >= LATE_FOR_NS

    def _jump(self) -> list[Arrived]:
        """Carry the clock on: the least late of the samples in doubt is as late as the least late ever was."""
        self.jumps += not self._resumes
        late_ns = [late for _, late in self._doubtful]
        self.spread_ns = max(late_ns) - min(late_ns)
        return self._carry_on(min(late_ns), [])

    def _carry_on(self, late_ns: float, decided: list[Arrived]) -> list[Arrived]:
        self.correction_ns += round(late_ns)
        return decided + self.release()
