"""Checks, packet by packet, whether the rates in packets are those of the packets' own attitudes.
It does no I/O.

Laws:
1. Stretches of successive packets are compared: the turn of their quaternions with the mean of
   their rates, each with its own noise.
2. A stretch whose attitude turns by less than its noise says nothing; nor does one whose attitude
   jumps, or stands still and steps.
3. Rates are wrong where all of MIN_STRETCHES in a row (or all but one of MORE_STRETCHES) are off by
   far more than the noise, and either one cause explains them all, or the error is gross. They are
   right again where all of MIN_STRETCHES in a row fit.
4. Stretches of several lengths are compared: short ones show a fast turn within half a second, long
   ones a slow turn in noise.
5. Rates that are late or seldom renewed fit at some times and not at others. So the rates of the
   last HISTORY_S are also compared with the turn as it was earlier. Rates that this shows to be off
   in OFF_LOOKS comparisons in a row are wrong, even if no lag explains them. Such rates are right
   again only by this comparison.
"""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from hilstar.attitude.clock.rate_causes import (
    AS_PACKETS,
    LONGEST_S,
    MANY_STRETCHES,
    MIN_INTERVALS,
    MIN_STRETCHES,
    MORE_STRETCHES,
    MUCH_LESS,
    OFTEN_OFF,
    SAME,
    Cause,
    LagFit,
    ReadAs,
    Stretch,
    cause_of,
    fits,
    lag_of,
    off_share,
    read_otherwise,
    readings,
    stretch_of,
)
from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.basics.notices import Notices
from hilstar.basics.units import NS_PER_S
from hilstar.basics.wrong_sky import ENDS, RATES

WrongRates = Literal["use-quaternions", "warn", "off"]
WRONG, RIGHT = RATES, ENDS[RATES]

STRETCHES_S = (0.1, 0.2, LONGEST_S)
MANY_WITHOUT = 20
MAX_GAP_NS = NS_PER_S // 2
# Where t_ns goes back by so much or more, the sender has started anew; where it goes back by less,
# packets have overtaken each other.
RESTART_NS = NS_PER_S
HISTORY_S = 4.0
LAG_EACH_NS = NS_PER_S // 2
# Comparisons in a row that must fit before late rates count as right again: in a slow swing there
# are times without an error.
LATE_NO_MORE = 8
# Comparisons in a row that must be off before rates that no lag explains count as wrong: a constant
# error has been named by then.
OFF_LOOKS = 8


def cause_in(samples: Sequence[AttitudeSample], read_as: ReadAs = AS_PACKETS) -> Cause | None:
    """The first cause of wrong rates that a log's samples, all of which have rates, show; None
    where they show none. `read_as` is how the log's quaternions have been read.
    """
    length = _Length(0.0)
    others = tuple(read_otherwise(readings(read_as)))
    for sample in samples:
        if not length.add(sample):
            continue
        cause = _first_cause(length, math.inf, others)
        if cause is not None:
            return cause
    return None


def _first_cause(length: "_Length", history_s: float, others: Sequence[Cause]) -> Cause | None:
    """The cause of wrong rates that the newest stretches of a length show, by the few newest first,
    then by more; None where they show none.
    """
    for count in (MIN_STRETCHES, MORE_STRETCHES, MANY_STRETCHES):
        newest = length.newest(count)
        if not newest:
            continue
        cause = cause_of(newest, length.length_s or LONGEST_S, history_s, others)
        if cause is not None:
            return cause
    return None


class _Length:
    def __init__(self, length_s: float) -> None:
        self.length_s = length_s
        self._length_ns = round(length_s * NS_PER_S)
        self.samples: list[AttitudeSample] = []
        self.stretches: deque[Stretch] = deque(maxlen=MANY_STRETCHES)

    def add(self, sample: AttitudeSample) -> bool:
        """Add the next packet; True where it completes a stretch that can be compared."""
        samples = self.samples
        samples.append(sample)
        if len(samples) <= MIN_INTERVALS or sample.t_ns - samples[0].t_ns < self._length_ns:
            return False
        stretch = stretch_of(samples)
        self.samples = [sample]
        if stretch is None:
            return False
        self.stretches.append(stretch)
        return True

    def newest(self, count: int) -> list[Stretch]:
        if len(self.stretches) >= count:
            return list(self.stretches)[-count:]
        return []


class _History:
    """The last HISTORY_S of rates and turns, as stretches that follow each other without a
    break.
    """

    def __init__(self) -> None:
        self._stretches: deque[Stretch] = deque()
        self._next_ns: int | None = None
        self._has_looked = False

    @property
    def looked_s(self) -> float:
        """The length of the history, s, once rates and turn have been compared over it; else 0."""
        if not self._has_looked:
            return 0.0
        return (self._stretches[-1].to_ns - self._stretches[0].from_ns) / NS_PER_S

    @property
    def from_ns(self) -> int:
        return self._stretches[0].from_ns

    def clear(self) -> None:
        self._stretches.clear()
        self._has_looked = False

    def add(self, stretch: Stretch) -> LagFit | None:
        """Add the next stretch. Returns, twice a second, how rates and turn compare over the
        history; else None.
        """
        if not stretch.whole.all() or (
            self._stretches and self._stretches[-1].to_ns != stretch.from_ns
        ):
            self.clear()
        if not stretch.whole.all():
            return None
        self._stretches.append(stretch)
        while stretch.to_ns - self._stretches[0].to_ns > HISTORY_S * NS_PER_S:
            self._stretches.popleft()
        # The comparison is not yet due. A due time far ahead is from before the sender started
        # anew, and does not count.
        if self._next_ns is not None and 0 <= self._next_ns - stretch.to_ns <= LAG_EACH_NS:
            return None
        self._next_ns = stretch.to_ns + LAG_EACH_NS
        fit = lag_of(self._stretches)
        self._has_looked = self._has_looked or fit is not None
        return fit


class RateCheck:
    """Checks the rates of one sender. One notice says that they are wrong, and one that they are
    right again after that.

    `wrong` says what to do with wrong rates; with "off" nothing is checked. `used` is False for a
    run that draws without rates. `read_as` is how quaternions have been read.
    """

    def __init__(
        self,
        wrong: WrongRates,
        notices: Notices,
        *,
        used: bool = True,
        read_as: ReadAs = AS_PACKETS,
    ) -> None:
        self._others = tuple(read_otherwise(readings(read_as)))
        self._use = wrong
        self._used = used
        self._notices = notices
        self._lengths = [_Length(length_s) for length_s in STRETCHES_S]
        self._history = _History()
        # the comparison by which the history showed rates to be late or off; None for others
        self._late: LagFit | None = None
        self._no_more = self._off_looks = 0
        # the share of the turn by which rates were off when they were judged wrong
        self._was_off = 0.0
        self._last_ns: int | None = None
        self._without = 0  # packets in a row without a rate
        self.cause: Cause | None = None

    @property
    def distrusts(self) -> bool:
        """Whether rates are wrong at present, and are not to be used."""
        return self.cause is not None and self._use == "use-quaternions"

    def see(self, sample: AttitudeSample, host_ns: int | None = None) -> None:
        """Check the next packet as it was sent, with times on the sender's own clock; `host_ns` is
        the host time at which it came, None for a log.
        """
        if self._use == "off" or not self._follows(sample):
            return
        self._without = self._without + 1 if sample.rate_cam_rad_s is None else 0
        if self._without:
            if self._without == MANY_WITHOUT:
                self._end("the packets carry no rates any more")
            return
        for number, length in enumerate(self._lengths):
            if length.add(sample):
                if number == 0:
                    self._judge_lag(length.stretches[-1], host_ns)
                self._judge(length, host_ns)

    def believed(self, sample: AttitudeSample) -> AttitudeSample:
        """The sample to draw: without rate and acceleration where rates are not to be used."""
        if not self.distrusts or sample.rate_cam_rad_s is None:
            return sample
        return replace(sample, rate_cam_rad_s=None, acceleration_cam_rad_s2=None)

    def _follows(self, sample: AttitudeSample) -> bool:
        """Whether a packet follows the last one; False for one that others have overtaken. After a
        gap, or where the sender starts anew, the stretches begin anew.
        """
        last_ns = self._last_ns
        # A packet that is a little earlier was overtaken, or sent twice.
        if last_ns is not None and last_ns - RESTART_NS < sample.t_ns <= last_ns:
            return False
        # One that is much earlier is of a sender that starts anew; and across a gap nothing says
        # how the attitude turned.
        if last_ns is not None and not 0 < sample.t_ns - last_ns <= MAX_GAP_NS:
            self._restart()
        self._last_ns = sample.t_ns
        return True

    def _judge(self, length: _Length, host_ns: int | None) -> None:
        newest = length.newest(MIN_STRETCHES)
        if not newest or self._late is not None:
            return
        if self.cause is not None:
            if all(fits(stretch, self._was_off) for stretch in newest):
                self._end("the packets' rates are those of their quaternions again")
            return
        cause = _first_cause(length, self._history.looked_s, self._others)
        if cause is not None:
            self._begin(cause, newest[-1], newest[0].from_ns, host_ns)

    def _judge_lag(self, stretch: Stretch, host_ns: int | None) -> None:
        lag = self._history.add(stretch)
        if lag is None:
            return
        self._off_looks = self._off_looks + 1 if lag.is_off else 0
        if self.cause is None and (lag.lag_s or self._off_looks == OFF_LOOKS):
            self._late = lag
            late = f"they are {lag.lag_text}: they fit the turn of another moment"
            cause = Cause(late if lag.lag_s else OFTEN_OFF, SAME, lag_s=lag.lag_s)
            self._begin(cause, stretch, self._history.from_ns, host_ns)
        elif self._late is not None and lag.fast_rad_s > MUCH_LESS * self._late.fast_rad_s:
            was = self._late.off_rad_s / self._late.fast_rad_s
            fitting = not lag.lag_s and lag.off_rad_s < MUCH_LESS * was * lag.fast_rad_s
            self._no_more = self._no_more + 1 if fitting else 0
            if self._no_more == LATE_NO_MORE:
                self._end("the packets' rates are those of their quaternions again")

    def _begin(self, cause: Cause, stretch: Stretch, from_ns: int, host_ns: int | None) -> None:
        self.cause = cause
        self._was_off = off_share(stretch)
        self._no_more = self._off_looks = 0
        if host_ns is None:
            since_ns = None
        else:
            since_ns = host_ns - (stretch.to_ns - from_ns)
        self._notices.begin(cause.kind, self._line(cause, stretch), since_ns)

    def _line(self, cause: Cause, stretch: Stretch) -> str:
        turn_deg_s = np.degrees(np.linalg.norm(stretch.turn))
        rate_rad_s = np.linalg.norm(stretch.rate)
        if cause.reading is not None:
            return (
                f"the packets' rates do not fit their quaternions as they are read; {cause.text}:"
                f" the sky is drawn at another place; {cause.reading.advice} (both turn at"
                f" {turn_deg_s:.3g} deg/s)"
            )
        if self.distrusts:
            done = "the sky is drawn by the quaternions' own turn"
        else:
            done = "they are used all the same"
        if not self._used:
            done = "nothing is drawn by them"
        return (
            f"the packets' rates are wrong, probably because {cause.text}: the quaternions turn at"
            f" {turn_deg_s:.3g} deg/s, the rates say {rate_rad_s:.3g} rad/s"
            f" ({math.degrees(rate_rad_s):.3g} deg/s); {done} ([attitude] check_rates)"
        )

    def _end(self, why: str) -> None:
        self._restart()
        if self.cause is not None:
            kind = self.cause.kind
            self.cause = None
            self._late = None
            self._notices.end(kind, ENDS[kind], why)

    def _restart(self) -> None:
        self._off_looks = 0
        self._history.clear()
        for length in self._lengths:
            length.samples.clear()
            length.stretches.clear()
