"""Whether the rates that packets carry are those of their own attitudes, and what is probably wrong where they are not; no I/O.

Laws:
1. Stretches of packets are compared: the turn of their quaternions with the mean of their rates, each with its own noise.
2. A stretch whose attitude turns by less than its noise says nothing; nor does one that jumps, or stands and steps.
3. Rates are wrong where all of MIN_STRETCHES in a row (or all but one of MORE_STRETCHES) are off by far more than the noise and
   either one cause explains them all, or the error is gross. They are right again where all of MIN_STRETCHES fit.
4. Stretches of several lengths are compared: a short one finds a fast turn in half a second, a long one a slow turn in noise.
"""

import itertools
import math
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.notices import Notices
from hilstar.rotation import conjugate, multiply, rotate, to_rotation_vector
from hilstar.units import NS_PER_S

WrongRates = Literal["use-quaternions", "warn", "off"]
WRONG, RIGHT = "rates-wrong", "rates-right"

STRETCHES_S = (0.1, 0.2, 0.5)
MIN_INTERVALS = 5
MIN_STRETCHES, MORE_STRETCHES = 4, 6
MANY_WITHOUT = 20
MAX_GAP_NS = NS_PER_S // 2
RESTART_NS = NS_PER_S  # t_ns goes back by as much where a sender starts anew; by less where packets overtake each other
MAX_STEP_RAD = 1.5  # from packet to packet: half a turn has no direction
MIN_TURN_RAD_S = math.radians(0.01)
MIN_OFF_RAD_S, MIN_GROSS_RAD_S = math.radians(0.05), math.radians(1.0)
OFF_SHARE, FIT_SHARE, AXES_SHARE, GROSS_SHARE = 0.2, 0.1, 0.03, 0.5  # shares of the faster turn
MAX_HELD_SHARE = 0.2  # maximum share of packets that repeat an attitude: a turn in steps is not the camera's
OFF_SIGMA, FIT_SIGMA, TURN_SIGMA = 6.0, 4.0, 3.0
MIN_BETTER = 3.0  # a cause leaves at most a third of the error
WALK = 1.1  # white noise of rates, summed up: the slope of its sum is off by sqrt(6/5) of its mean's error


class _Stretch(NamedTuple):
    """Some packets in a row: (3,) rates, rad/s, cam, and their standard errors, rad/s.

    `turn` is that of the quaternions, `rate` the mean of the rates, and `rate_as_icrs` the same if they had ICRS components.
    """

    turn: FloatArray
    rate: FloatArray
    rate_as_icrs: FloatArray
    turn_sigma: float
    rate_sigma: float

    @property
    def turns(self) -> bool:
        return float(np.linalg.norm(self.turn)) > max(MIN_TURN_RAD_S, TURN_SIGMA * self.turn_sigma)


@dataclass(frozen=True, slots=True)
class _Cause:
    """What may be wrong with rates: `mends` (3, 3) makes them right, and `scale` is what that multiplies their noise by.

    They are taken to have ICRS components where `in_icrs`, else the camera's.
    """

    text: str
    mends: FloatArray
    scale: float = 1.0
    in_icrs: bool = False

    def mended(self, stretch: _Stretch) -> FloatArray:
        return np.asarray(self.mends @ (stretch.rate_as_icrs if self.in_icrs else stretch.rate))


# What a rate of 1 rad/s is in units that senders confuse with it.
UNITS = {
    "deg/s": math.degrees(1.0),
    "arcsec/s": math.degrees(3600.0),
    "mrad/s": 1e3,
    "rad/ms": 1e-3,
    "rpm": 60 / math.tau,
    "revolutions/s": 1 / math.tau,
    "rad/s times pi/180": math.radians(1.0),
}
DEGREES = (("", 1.0), (" and in deg/s", UNITS["deg/s"]))
SAME = np.eye(3)
OTHER_FRAME = "they are of another frame than the camera's, such as the body's"
OTHER_AXES = f"their axes are in another order or have the wrong sign, or {OTHER_FRAME}"
GROSS = "no unit, sign or order of axes explains them"


def _causes() -> Iterator[_Cause]:
    for unit, size in UNITS.items():
        yield _Cause(f"they are in {unit}; send rad/s", SAME / size, 1 / size)
    for unit, size in DEGREES:
        yield _Cause(f"they have the wrong sign{unit}; send the turn of the camera in the sky, rad/s", -SAME / size, 1 / size)
    for unit, size in (("", 1.0), (", in deg/s", UNITS["deg/s"])):
        yield _Cause(f"they have ICRS components{unit}; send the camera's, rad/s", SAME / size, 1 / size, in_icrs=True)


def _permutations() -> Iterator[_Cause]:
    """Every order and sign of the axes but the right one and its opposite."""
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1, -1), repeat=3):
            if order == (0, 1, 2) and abs(sum(signs)) == 3:
                continue
            matrix = np.zeros((3, 3))
            matrix[range(3), order] = signs
            sent = ", ".join(("" if signs[order.index(k)] > 0 else "-") + "xyz"[order.index(k)] for k in range(3))
            what = "some of their axes have the wrong sign" if order == (0, 1, 2) else "their axes are in another order"
            for unit, size in DEGREES:
                yield _Cause(f"{what}{unit}: the camera's ({sent}) is sent as (x, y, z)", matrix / size, 1 / size)


CAUSES, PERMUTATIONS = tuple(_causes()), tuple(_permutations())


def _stretch_of(samples: Sequence[AttitudeSample]) -> _Stretch | None:
    """Turn and mean rate of packets in the order of their times; None where most of them follow a break."""
    t_s = np.array([sample.t_ns - samples[0].t_ns for sample in samples]) / NS_PER_S
    q = np.array([sample.q_icrs_to_cam for sample in samples])
    rate = np.array([sample.rate_cam_rad_s for sample in samples])
    step_s = np.diff(t_s)[:, None]
    turn_rad = -to_rotation_vector(multiply(q[1:], conjugate(q[:-1])))
    mean = (rate[1:] + rate[:-1]) / 2
    held = (q[1:] == q[:-1]).all(axis=1)
    if MAX_HELD_SHARE < held.mean() < 1.0:
        return None
    whole = np.array([not sample.discontinuity for sample in samples[1:]])
    for vectors_rad in (turn_rad, mean * step_s):
        whole &= np.linalg.norm(vectors_rad, axis=1) < MAX_STEP_RAD
    count = int(whole.sum())
    if count < max(MIN_INTERVALS, (len(samples) - 1) / 2):
        return None
    at_s, turned, summed, as_icrs = (
        np.vstack((np.zeros(part.shape[1]), np.cumsum(part[whole], axis=0)))
        for part in (step_s, turn_rad, mean * step_s, rotate(q[1:], mean) * step_s)
    )
    weight = at_s[:, 0] - at_s.mean()
    spread_s2 = float(weight @ weight)
    turn = weight @ turned / spread_s2
    scatter = turned - turned.mean(axis=0) - weight[:, None] * turn
    turn_sigma = math.sqrt(float((scatter**2).sum()) / (3 * (count - 1)) / spread_s2)
    rate_sigma = WALK * math.sqrt(float((np.diff(rate, axis=0)[whole] ** 2).sum()) / (6 * count) / count)
    return _Stretch(turn, weight @ summed / spread_s2, weight @ as_icrs / spread_s2, turn_sigma, rate_sigma)


def _cause_of(stretches: Sequence[_Stretch]) -> _Cause | None:
    """What is wrong with the rates of these stretches, all but one in MORE_STRETCHES of them; None where they may be right."""
    off = [s.turns and _error(s, s.rate) > max(MIN_OFF_RAD_S, _limit(s, OFF_SHARE, OFF_SIGMA)) for s in stretches]
    if off.count(False) > len(stretches) // MORE_STRETCHES:
        return None
    if not any(stretch.rate.any() for stretch in stretches):
        coherent = np.linalg.norm(sum(s.turn for s in stretches)) > GROSS_SHARE * sum(np.linalg.norm(s.turn) for s in stretches)
        return _Cause("they are zero; leave them out", SAME) if coherent else None
    return _definite(stretches) or _indefinite(stretches)


def _explains(stretches: Sequence[_Stretch], cause: _Cause, share: float) -> bool:
    """Whether without this cause the rates fit, all but one in MORE_STRETCHES of them, and far better than with it."""
    off = float(np.median([_error(stretch, stretch.rate) for stretch in stretches]))
    errors = [_error(stretch, cause.mended(stretch)) for stretch in stretches]
    fits = [error <= _limit(s, share, FIT_SIGMA, cause.scale) for s, error in zip(stretches, errors, strict=True)]
    return fits.count(False) <= len(stretches) // MORE_STRETCHES and off >= MIN_BETTER * float(np.median(errors))


def _definite(stretches: Sequence[_Stretch]) -> _Cause | None:
    """The simplest of the causes without a free choice that explains the rates."""
    for cause in CAUSES:
        if _explains(stretches, cause, FIT_SHARE):
            return cause
    found = [cause for cause in PERMUTATIONS if _explains(stretches, cause, AXES_SHARE)]
    if not found:
        return None
    sharp = all(FIT_SIGMA * math.hypot(s.turn_sigma, s.rate_sigma) < FIT_SHARE * _faster(s) for s in stretches)
    return found[0] if sharp and len(found) == 1 else replace(found[0], text=OTHER_AXES)


def _indefinite(stretches: Sequence[_Stretch]) -> _Cause | None:
    """A rotation that explains the rates, or that nothing does though they are far off: of MORE_STRETCHES alone."""
    if len(stretches) < MORE_STRETCHES:
        return None
    # The rotation that turns rates best into turns (Kabsch 1976).
    u, _, vt = np.linalg.svd(sum(np.outer(stretch.turn, stretch.rate) for stretch in stretches))
    rotation = np.asarray(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt)
    for unit, size in (("", 1.0), (", and in deg/s", UNITS["deg/s"])):
        turned = _Cause(OTHER_FRAME + unit, rotation / size, 1 / size)
        if _explains(stretches, turned, AXES_SHARE):
            return turned
    gross = [_error(s, s.rate) > max(MIN_GROSS_RAD_S, GROSS_SHARE * _faster(s)) for s in stretches]
    return _Cause(GROSS, SAME) if all(gross) else None


def cause_in(samples: Sequence[AttitudeSample]) -> _Cause | None:
    """The first cause that a log's samples show, all of which have rates; None where they show none."""
    length = _Length(0.0)
    for sample in samples:
        if length.add(sample) and (newest := length.newest(MIN_STRETCHES)) and (cause := _cause_of(newest)):
            return cause
    return None


def fits(stretch: _Stretch) -> bool:
    """Whether a turn shows that its rates are right."""
    return stretch.turns and _error(stretch, stretch.rate) <= _limit(stretch, FIT_SHARE, FIT_SIGMA)


def _error(stretch: _Stretch, rate: FloatArray) -> float:
    return float(np.linalg.norm(stretch.turn - rate))


def _faster(stretch: _Stretch) -> float:
    return float(max(np.linalg.norm(stretch.turn), np.linalg.norm(stretch.rate)))


def _limit(stretch: _Stretch, share: float, sigma: float, scale: float = 1.0) -> float:
    """How far turn and rate may be apart: a share of the turn, and the noise of both."""
    size = _faster(stretch) if scale == 1.0 else float(np.linalg.norm(stretch.turn))
    return max(share * size, sigma * math.hypot(stretch.turn_sigma, scale * stretch.rate_sigma))


class _Length:
    def __init__(self, length_s: float) -> None:
        self._length_ns = round(length_s * NS_PER_S)
        self.samples: list[AttitudeSample] = []
        self.stretches: deque[_Stretch] = deque(maxlen=MORE_STRETCHES)

    def add(self, sample: AttitudeSample) -> bool:
        """Take the next packet; True where it completes a stretch."""
        samples = self.samples
        samples.append(sample)
        if len(samples) <= MIN_INTERVALS or sample.t_ns - samples[0].t_ns < self._length_ns:
            return False
        stretch = _stretch_of(samples)
        self.samples = [sample]
        if stretch is None:
            return False
        self.stretches.append(stretch)
        return True

    def newest(self, count: int) -> list[_Stretch]:
        return list(self.stretches)[-count:] if len(self.stretches) >= count else []


class RateCheck:
    """Follows one sender: tells of wrong rates once, and of right ones after that.

    `wrong` says what is done with rates that are: "off" looks at nothing. `used` is False for a run that draws without rates.
    """

    def __init__(self, wrong: WrongRates, notices: Notices, *, used: bool = True) -> None:
        self._use = wrong
        self._used = used
        self._notices = notices
        self._lengths = [_Length(length_s) for length_s in STRETCHES_S]
        self._last_ns: int | None = None
        self._without = 0  # packets in a row without a rate
        self.cause: _Cause | None = None

    @property
    def distrusts(self) -> bool:
        """Whether rates are left out now."""
        return self.cause is not None and self._use == "use-quaternions"

    def see(self, sample: AttitudeSample) -> None:
        """Take the next packet as it was sent, on the sender's own clock."""
        if self._use == "off" or not self._follows(sample):
            return
        self._without = self._without + 1 if sample.rate_cam_rad_s is None else 0
        if self._without:
            if self._without == MANY_WITHOUT:
                self._end("the packets carry no rates any more")
            return
        for length in self._lengths:
            if length.add(sample):
                self._judge(length)

    def believed(self, sample: AttitudeSample) -> AttitudeSample:
        """The sample as it is to be drawn: without its rate where rates are wrong."""
        if not self.distrusts or sample.rate_cam_rad_s is None:
            return sample
        return replace(sample, rate_cam_rad_s=None, acceleration_cam_rad_s2=None)

    def _follows(self, sample: AttitudeSample) -> bool:
        """False for a packet that others overtook; a gap and a sender that starts anew begin anew."""
        last_ns = self._last_ns
        if last_ns is not None and last_ns - RESTART_NS < sample.t_ns <= last_ns:
            return False
        if last_ns is not None and not 0 < sample.t_ns - last_ns <= MAX_GAP_NS:
            self._restart()
        self._last_ns = sample.t_ns
        return True

    def _judge(self, length: _Length) -> None:
        newest = length.newest(MIN_STRETCHES)
        if not newest:
            return
        if self.cause is not None:
            if all(fits(stretch) for stretch in newest):
                self._end("the packets' rates are those of their quaternions again")
            return
        more = length.newest(MORE_STRETCHES)
        self.cause = _cause_of(newest) or (_cause_of(more) if more else None)
        if self.cause is not None:
            self._notices.begin(WRONG, self._line(self.cause, newest[-1]))

    def _line(self, cause: _Cause, stretch: _Stretch) -> str:
        turn_deg_s, rate_rad_s = np.degrees(np.linalg.norm(stretch.turn)), np.linalg.norm(stretch.rate)
        done = "the sky is drawn by the quaternions' own turn" if self.distrusts else "they are used all the same"
        if not self._used:
            done = "nothing is drawn by them"
        return (
            f"the packets' rates are wrong, probably because {cause.text}: the quaternions turn at {turn_deg_s:.3g} deg/s, the"
            f" rates say {rate_rad_s:.3g} rad/s ({math.degrees(rate_rad_s):.3g} deg/s); {done} ([attitude] check_rates)"
        )

    def _end(self, why: str) -> None:
        self._restart()
        if self.cause is not None:
            self.cause = None
            self._notices.end(WRONG, RIGHT, why)

    def _restart(self) -> None:
        for length in self._lengths:
            length.samples.clear()
            length.stretches.clear()
