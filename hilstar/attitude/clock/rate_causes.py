"""What is wrong with rates that are not those of their own attitudes, from stretches of packets; no
I/O.

A stretch has the turn of its quaternions and the mean of its rates, each with its own noise. A
cause without a free number (a unit, a sign, an order of axes) is found in MIN_STRETCHES in a row.
One with a free number (a factor, a rotation, a constant) needs more. Rates may be right and the
quaternions read in the wrong convention: then the rates fit another reading of their four numbers.
Rates that are late fit and do not fit by turns: they are compared with the turn some time before
(`lag_of`).
"""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from msgspec import structs

from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.attitude.wire.source import HILSTARS, Convention, Conventions, Mounting
from hilstar.basics.arrays import BoolArray, FloatArray
from hilstar.basics.rotation import conjugate, multiply, rotate, to_rotation_vector
from hilstar.basics.units import NS_PER_MS, NS_PER_S
from hilstar.basics.wrong_sky import CONVENTION, RATES

MIN_INTERVALS = 5  # between packets, in a stretch that is judged
MIN_STRETCHES, MORE_STRETCHES, MANY_STRETCHES = 4, 6, 12
LONGEST_S = 0.5
MAX_STEP_RAD = 1.5  # from packet to packet: half a turn has no direction
MIN_TURN_RAD_S = math.radians(0.01)  # a slower turn counts as rest, at which rates show nothing
MIN_OFF_RAD_S, MIN_GROSS_RAD_S = math.radians(0.05), math.radians(1.0)
OFF_SHARE, FIT_SHARE, AXES_SHARE, GROSS_SHARE = 0.2, 0.1, 0.03, 0.5  # shares of the faster turn
# maximum share of packets that repeat an attitude: a turn in steps is not the camera's
MAX_HELD_SHARE = 0.2
OFF_SIGMA, FIT_SIGMA, TURN_SIGMA = 6.0, 4.0, 3.0
MIN_BETTER = 3.0  # a cause leaves at most a third of the error
# white noise of rates, summed up: the slope of its sum is off by sqrt(6/5) of its mean's error
WALK = 1.1
STEADY_SHARE = 0.2  # of the fastest turn: one that changes by more makes late rates look wrong
SHARP_SHARE = 0.25  # the shares of the turn that noise may hide, for another reading
MUCH_LESS = 0.5
MIN_HISTORY_S = 3.0
MAX_LAG_S, LAG_SPAN_S = 0.5, 0.2  # lags that are tried, and the time over which each turn is taken
LAG_STEPS_S = (0.01, 0.002)  # coarse, then fine
MIN_LAG_S = 0.02  # a shorter lag is not named
MIN_TURNS = 5
NOISE_RATIO = 2.0  # over ten and more turns a chance error is within 1.5 times the noise
LAG_TIE = 0.02  # share of the range of errors
KEY = "[attitude] convention"
HOW_IT_SENDS = "look at what the simulator puts into its quaternion"
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
OFTEN_OFF = (
    "they are off for seconds, and no lag explains that: are they new in each packet, and all axes?"
)
GROSS = "no unit, sign or order of axes explains them"


@dataclass(frozen=True, slots=True)
class ReadAs:
    """How a sender's four numbers become the camera's attitude: as `[attitude] convention` says,
    then by `q_body_to_cam` (4,).

    That is None where they are the camera's own. `has_key` says whether the key states how the
    source is read; a source with a convention of its own refuses it. `stated_by` is what states it:
    that key, or a command's option.
    """

    convention: Convention = HILSTARS
    q_body_to_cam: FloatArray | None = None
    has_key: bool = True
    stated_by: str = KEY

    @classmethod
    def of(
        cls,
        conventions: Conventions,
        convention: Convention,
        mounting: Mounting,
        stated_by: str = KEY,
    ) -> "ReadAs":
        """How a source of these conventions is read, where `convention` and `mounting` are
        stated.
        """
        if conventions.of_body:
            q_body_to_cam = mounting.q_body_to_cam
        else:
            q_body_to_cam = None
        if not conventions.of_packets:
            return cls(q_body_to_cam=q_body_to_cam, has_key=False)
        return cls(convention, q_body_to_cam, stated_by=stated_by)

    def q_icrs_to_cam(self, sent: FloatArray) -> FloatArray:
        """The camera's attitude (n, 4) by the four numbers that were sent."""
        q = self.convention.q_icrs_to_frame(sent)
        if self.q_body_to_cam is None:
            return q
        return multiply(self.q_body_to_cam, q)

    def sent(self, q_icrs_to_cam: FloatArray) -> FloatArray:
        """The four numbers (n, 4) that were sent for an attitude of the camera."""
        q = q_icrs_to_cam
        if self.q_body_to_cam is not None:
            q = multiply(conjugate(self.q_body_to_cam), q)
        return self.convention.as_sent(q)

    def advice(self, parts: Sequence[tuple[str, str]]) -> str:
        """What to write for another reading, by its keys and their values."""
        if not self.has_key:
            return HOW_IT_SENDS
        if self.stated_by != KEY:
            return f"write {self.stated_by} {','.join(f'{key}={value}' for key, value in parts)}"
        keys = ", ".join(f'{key} = "{value}"' for key, value in parts)
        return f"write {KEY} = {{ {keys} }}"


AS_PACKETS = ReadAs()


class Reading(NamedTuple):
    """Another reading of a quaternion's four numbers: what it is, what to write for it, and how
    the numbers are read now and by it.
    """

    text: str
    advice: str
    now: ReadAs
    other: ReadAs

    def read(self, q: FloatArray) -> FloatArray:
        """Attitudes (n, 4) as they are read now, by this reading."""
        return self.other.q_icrs_to_cam(self.now.sent(q))


def readings(read_as: ReadAs = AS_PACKETS) -> tuple[Reading, ...]:
    """The other readings of quaternions that are read like this."""
    others = []
    for scalar, direction in itertools.product(("first", "last"), ("icrs_to_cam", "cam_to_icrs")):
        convention = structs.replace(read_as.convention, scalar=scalar, direction=direction)
        if convention == read_as.convention:
            continue
        other = replace(read_as, convention=convention)
        text = _words(read_as.convention, convention)
        others.append(Reading(text, _advice(read_as, convention), read_as, other))
    return tuple(others)


def _words(now: Convention, other: Convention) -> str:
    words = "quaternions"
    if other.direction != now.direction:
        words = "conjugate of the quaternions"
    if other.scalar != now.scalar:
        words += f" read with the scalar {other.scalar}"
    return words


def _advice(read_as: ReadAs, other: Convention) -> str:
    """What to write for another reading; a default that holds now and then need not be written."""
    now = read_as.convention
    parts: list[tuple[str, str]] = []
    if (now.scalar, other.scalar) != ("first", "first"):
        parts.append(("scalar", other.scalar))
    if (now.direction, other.direction) != ("icrs_to_cam", "icrs_to_cam"):
        parts.append(("direction", other.direction))
    if read_as.q_body_to_cam is not None:
        parts.append(("frame", "body"))
    return read_as.advice(parts)


@dataclass(slots=True)
class Stretch:
    """Some packets in a row: (3,) rates, rad/s, cam, and their standard errors, rad/s; times ns of
    the sender's clock.

    `turn` is that of the quaternions, `rate` the mean of the rates, and `rate_as_icrs` the same if
    they had ICRS components. `turned_rad` and `summed_rad` (n, 3) are turn and rates summed up to
    the times `at_s` (n,) after `from_ns`. `error` is how far turn and rate are apart, rad/s, and
    `is_off` says that this is more than their noise and what rates may be off.
    """

    turn: FloatArray
    rate: FloatArray
    rate_as_icrs: FloatArray
    turn_sigma: float
    rate_sigma: float
    from_ns: int
    to_ns: int
    q: FloatArray
    whole: BoolArray
    at_s: FloatArray
    turned_rad: FloatArray
    summed_rad: FloatArray
    error: float = 0.0
    is_off: bool = False
    _read: dict[str, FloatArray] = field(default_factory=dict)

    @property
    def turns(self) -> bool:
        """Whether its attitude turns by more than its noise."""
        return _turning(self) > max(MIN_TURN_RAD_S, TURN_SIGMA * self.turn_sigma)

    def turn_as(self, reading: Reading) -> FloatArray:
        """The turn (3,) of its quaternions in another reading of their numbers."""
        turn_rad_s = self._read.get(reading.text)
        if turn_rad_s is None:
            turned = np.cumsum(_turns_rad(reading.read(self.q))[self.whole], axis=0)
            weight = self.at_s - self.at_s.mean()
            turn_rad_s = self._read[reading.text] = np.asarray(
                weight[1:] @ turned / float(weight @ weight)
            )
        return turn_rad_s


@dataclass(frozen=True, slots=True)
class Cause:
    """A way in which rates may be wrong: `mends` (3, 3) turns them into right ones, and multiplies
    their noise by `scale`.

    Rates have ICRS components where `in_icrs`, else the camera's. `constant` (3,), rad/s, is added
    to all of them, and `lag_s` is how late they are. Where they fit another `reading` of the
    quaternions, the quaternions are read wrongly: the sky is wrong, not the rates.
    """

    text: str
    mends: FloatArray
    scale: float = 1.0
    in_icrs: bool = False
    constant: FloatArray | None = None
    reading: Reading | None = None
    lag_s: float = 0.0

    @property
    def kind(self) -> str:
        """The kind of condition that it is."""
        return RATES if self.reading is None else CONVENTION

    def error(self, stretch: Stretch) -> float:
        """How far turn and rate of a stretch are apart once the cause is mended, rad/s."""
        if self.reading is None:
            turn = stretch.turn
        else:
            turn = stretch.turn_as(self.reading)
        if self.in_icrs:
            sent = stretch.rate_as_icrs
        else:
            sent = stretch.rate
        mended = self.mends @ sent
        if self.constant is not None:
            mended = mended - self.constant
        return math.hypot(*(turn - mended).tolist())


def _causes() -> Iterator[Cause]:
    for unit, size in UNITS.items():
        yield Cause(f"they are in {unit}; send rad/s", SAME / size, 1 / size)
    for unit, size in DEGREES:
        yield Cause(
            f"they have the wrong sign{unit}; send the turn of the camera in the sky, rad/s",
            -SAME / size,
            1 / size,
        )
    for unit, size in (("", 1.0), (", in deg/s", UNITS["deg/s"])):
        yield Cause(
            f"they have ICRS components{unit}; send the camera's, rad/s",
            SAME / size,
            1 / size,
            in_icrs=True,
        )


def read_otherwise(others: Sequence[Reading]) -> Iterator[Cause]:
    """The causes by which rates fit another reading of the quaternions."""
    for unit, size in DEGREES:
        for reading in others:
            yield Cause(
                f"they fit the {reading.text}{unit}", SAME / size, 1 / size, reading=reading
            )


def _permutations() -> Iterator[Cause]:
    """Every order and sign of the axes but the right one and its opposite."""
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1, -1), repeat=3):
            if order == (0, 1, 2) and abs(sum(signs)) == 3:
                continue
            matrix = np.zeros((3, 3))
            matrix[range(3), order] = signs
            axes_sent = []
            for camera_axis in range(3):
                place = order.index(camera_axis)
                sign = "" if signs[place] > 0 else "-"
                axes_sent.append(sign + "xyz"[place])
            sent = ", ".join(axes_sent)
            if order == (0, 1, 2):
                what = "some of their axes have the wrong sign"
            else:
                what = "their axes are in another order"
            for unit, size in DEGREES:
                yield Cause(
                    f"{what}{unit}: the camera's ({sent}) is sent as (x, y, z)",
                    matrix / size,
                    1 / size,
                )


CAUSES, PERMUTATIONS = tuple(_causes()), tuple(_permutations())
READ_OTHERWISE = tuple(read_otherwise(readings()))


def _sums_from_zero(steps: FloatArray) -> FloatArray:
    """The sums (n + 1, k) of steps (n, k) up to each, from 0."""
    return np.vstack((np.zeros(steps.shape[1]), np.cumsum(steps, axis=0)))


def _turns_rad(q: FloatArray) -> FloatArray:
    """The turn (n - 1, 3) from each attitude (n, 4) to the next, as a rate times a second."""
    return -to_rotation_vector(multiply(q[1:], conjugate(q[:-1])))


def stretch_of(samples: Sequence[AttitudeSample]) -> Stretch | None:
    """Turn and mean rate of packets in the order of their times; None where most of them follow
    a break.
    """
    t_s = np.array([sample.t_ns - samples[0].t_ns for sample in samples]) / NS_PER_S
    q = np.array([sample.q_icrs_to_cam for sample in samples])
    rate = np.array([sample.rate_cam_rad_s for sample in samples])
    step_s = np.diff(t_s)[:, None]
    turn_rad = _turns_rad(q)
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
    at_s = _sums_from_zero(step_s[whole])
    turned = _sums_from_zero(turn_rad[whole])
    summed = _sums_from_zero((mean * step_s)[whole])
    as_icrs = _sums_from_zero((rotate(q[1:], mean) * step_s)[whole])
    weight = at_s[:, 0] - at_s.mean()
    spread_s2 = float(weight @ weight)
    turn = weight @ turned / spread_s2
    scatter = turned - turned.mean(axis=0) - weight[:, None] * turn
    turn_sigma = math.sqrt(float((scatter**2).sum()) / (3 * (count - 1)) / spread_s2)
    rate_sigma = WALK * math.sqrt(
        float((np.diff(rate, axis=0)[whole] ** 2).sum()) / (6 * count) / count
    )
    stretch = Stretch(
        turn,
        weight @ summed / spread_s2,
        weight @ as_icrs / spread_s2,
        turn_sigma,
        rate_sigma,
        samples[0].t_ns,
        samples[-1].t_ns,
        q,
        whole,
        at_s[:, 0],
        turned,
        summed,
    )
    limit = max(MIN_OFF_RAD_S, OFF_SHARE * _turning(stretch), OFF_SIGMA * _noise_of(stretch))
    stretch.error = _error(stretch, stretch.rate)
    stretch.is_off = stretch.turns and stretch.error > limit
    return stretch


def cause_of(
    stretches: Sequence[Stretch],
    length_s: float,
    history_s: float = math.inf,
    others: Sequence[Cause] = READ_OTHERWISE,
) -> Cause | None:
    """What is wrong with the rates of these stretches, all but one in MORE_STRETCHES of them; None
    where they may be right.

    `length_s` is how long a stretch is meant to be, `history_s` for how long `lag_of` could look
    already, and `others` are the other readings of the quaternions.
    """
    if sum(not stretch.is_off for stretch in stretches) > len(stretches) // MORE_STRETCHES:
        return None
    if not any(stretch.rate.any() for stretch in stretches):
        coherent = np.linalg.norm(sum(s.turn for s in stretches)) > GROSS_SHARE * sum(
            np.linalg.norm(s.turn) for s in stretches
        )
        if coherent:
            return Cause("they are zero; leave them out", SAME)
        return None
    sharp = all(FIT_SIGMA * _noise_of(s) < SHARP_SHARE * _turning(s) for s in stretches)
    read = next((cause for cause in others if _explains(stretches, cause, AXES_SHARE)), None)
    if read is not None and not sharp and length_s < LONGEST_S:
        return None  # in noise a longer stretch tells it from a sign and an order of axes
    return _definite(stretches, read, sharp) or _indefinite(stretches, length_s, history_s)


def _explains(stretches: Sequence[Stretch], cause: Cause, share: float) -> bool:
    """Whether a cause explains the rates: mended of it they fit, all but one in MORE_STRETCHES of
    the stretches, and their median error falls to a third (MIN_BETTER) or less.
    """
    errors = []
    misfits = 0
    for stretch in stretches:
        error = cause.error(stretch)
        errors.append(error)
        misfits += not error <= _limit(stretch, share, FIT_SIGMA, cause.scale)
        # of some eighty causes that are tried in a row most end here, after two or three stretches
        if misfits > len(stretches) // MORE_STRETCHES:
            return False
    off = np.median([_error(stretch, stretch.rate) for stretch in stretches])
    return bool(off >= MIN_BETTER * np.median(errors))


def _definite(stretches: Sequence[Stretch], read: Cause | None, sharp: bool) -> Cause | None:
    """The simplest of the causes without a free choice that explains the rates.

    `read` is the other reading of the quaternions that does; `sharp` says that noise hides no other
    turn.
    """
    if read is None or read.reading is None:
        other = ""
    else:
        other = f", or {_stated(read.reading)}"
    for cause in CAUSES:
        if _explains(stretches, cause, FIT_SHARE):
            # Of a turn about an axis that both readings share nothing tells a sign from a
            # conjugate.
            return replace(cause, text=cause.text + other)
    if read is not None and sharp:
        return read
    sharp = all(FIT_SIGMA * _noise_of(s) < FIT_SHARE * _faster(s) for s in stretches)
    causes = [cause for cause in PERMUTATIONS if _explains(stretches, cause, AXES_SHARE)]
    if not causes:
        return read
    if sharp and len(causes) == 1:
        return causes[0]
    return replace(causes[0], text=OTHER_AXES + other)


def _stated(reading: Reading) -> str:
    return f"they are right and fit the {reading.text}: {reading.advice}"


def _indefinite(stretches: Sequence[Stretch], length_s: float, history_s: float) -> Cause | None:
    """A cause with a free number that explains the rates, or that nothing does though they are
    far off.
    """
    if len(stretches) < MORE_STRETCHES:
        return None
    turns = np.array([stretch.turn for stretch in stretches])
    rates = np.array([stretch.rate for stretch in stretches])
    factor = float((rates * rates).sum()) / float((rates * turns).sum() or math.inf)
    if abs(factor) > 0:
        times = Cause(
            f"they are {factor:.3g} times the quaternions' own turn", SAME / factor, 1 / abs(factor)
        )
        if _explains(stretches, times, AXES_SHARE):
            return times
    # The rotation that turns rates best into turns (Kabsch 1976).
    u, _, vt = np.linalg.svd(turns.T @ rates)
    rotation = np.asarray(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt)
    for unit, size in (("", 1.0), (", and in deg/s", UNITS["deg/s"])):
        turned = Cause(OTHER_FRAME + unit, rotation / size, 1 / size)
        if _explains(stretches, turned, AXES_SHARE):
            return turned
    if len(stretches) >= MANY_STRETCHES and length_s >= LONGEST_S:
        return _constant(stretches, rates - turns)
    # While the turn changes, late rates are off as far: `lag_of` is to look first.
    changes = (
        np.linalg.norm(turns - turns.mean(axis=0), axis=1).max()
        > STEADY_SHARE * np.linalg.norm(turns, axis=1).max()
    )
    if changes and history_s < MIN_HISTORY_S:
        return None
    gross = [_error(s, s.rate) > max(MIN_GROSS_RAD_S, GROSS_SHARE * _faster(s)) for s in stretches]
    return Cause(GROSS, SAME) if all(gross) else None


def _constant(stretches: Sequence[Stretch], off: FloatArray) -> Cause | None:
    """A constant that is added to the rates; `off` (n, 3) is by how much they differ from the
    turns, rad/s.
    """
    constant = off.mean(axis=0)
    x, y, z = np.degrees(constant).tolist()
    cause = Cause(
        f"a constant ({x:.3g}, {y:.3g}, {z:.3g}) deg/s is added to them", SAME, constant=constant
    )
    if _explains(stretches, cause, AXES_SHARE):
        return cause
    return None


def off_share(stretch: Stretch) -> float:
    """By which share of its turn the rates of a stretch are off."""
    return _error(stretch, stretch.rate) / _turning(stretch)


def fits(stretch: Stretch, was_off: float) -> bool:
    """Whether a turn shows that its rates are right again, where they were off by a share of the
    turn: noise hides no half.
    """
    limit = _limit(stretch, FIT_SHARE, FIT_SIGMA)
    return stretch.turns and _error(
        stretch, stretch.rate
    ) <= limit < MUCH_LESS * was_off * _turning(stretch)


def _error(stretch: Stretch, rate: FloatArray) -> float:
    return math.hypot(*(stretch.turn - rate).tolist())  # plain floats: each stretch passes here


def _faster(stretch: Stretch) -> float:
    return max(_turning(stretch), math.hypot(*stretch.rate.tolist()))


def _turning(stretch: Stretch) -> float:
    return math.hypot(*stretch.turn.tolist())


def _noise_of(stretch: Stretch) -> float:
    return math.hypot(stretch.turn_sigma, stretch.rate_sigma)


def _limit(stretch: Stretch, share: float, sigma: float, scale: float = 1.0) -> float:
    """How far turn and rate may be apart: a share of the turn, and the noise of both."""
    if scale == 1.0:
        size = _faster(stretch)
    else:
        size = _turning(stretch)
    return max(share * size, sigma * math.hypot(stretch.turn_sigma, scale * stretch.rate_sigma))


class LagFit(NamedTuple):
    """Rates against the turn over some seconds, medians, rad/s: how fast it turned, how far off
    rates are, and their lag.

    `is_off` says that this is more than their noise and what rates may be off. `lag_s` is by how
    much rates are late, negative where they are early; 0 where none explains the error.
    """

    fast_rad_s: float
    off_rad_s: float
    is_off: bool = False
    lag_s: float = 0.0

    @property
    def lag_text(self) -> str:
        """The lag in words; at the end of those that are tried it may be a longer one."""
        sense = "late" if self.lag_s > 0 else "early"
        if abs(self.lag_s) > MAX_LAG_S - LAG_STEPS_S[0]:
            more = " or more"
        else:
            more = ""
        return f"{abs(self.lag_s) * NS_PER_S / NS_PER_MS:.0f} ms {sense}{more}"


def lag_of(stretches: Sequence[Stretch]) -> LagFit | None:
    """Whether rates are those of the turn some time before; None where successive stretches are too
    short to say.

    Medians: of a single jump a mean would be mended by any lag that moves it out of what is
    compared.
    """
    if not stretches or stretches[-1].to_ns - stretches[0].from_ns < MIN_HISTORY_S * NS_PER_S:
        return None
    # The stretches' own figures say at little cost that there is nothing to look for.
    fast = _turning_median(stretches)
    off = float(np.median([stretch.error for stretch in stretches]))
    if off <= 0.5 * max(MIN_OFF_RAD_S, OFF_SHARE * fast):
        return LagFit(fast, off)
    zero_ns = stretches[0].from_ns
    parts = [(stretch.at_s + (stretch.from_ns - zero_ns) / NS_PER_S)[1:] for stretch in stretches]
    t_s = np.concatenate([[0.0], *parts])
    turned = _joined([stretch.turned_rad for stretch in stretches])
    summed = _joined([stretch.summed_rad for stretch in stretches])
    edges_s = np.arange(MAX_LAG_S, t_s[-1] - MAX_LAG_S, LAG_SPAN_S)
    if t_s[-1] < MIN_HISTORY_S or len(edges_s) <= MIN_TURNS:
        return None
    rate = _between(t_s, summed, edges_s) / LAG_SPAN_S

    def off_by(lags_s: FloatArray) -> FloatArray:
        turn = _between(t_s, turned, edges_s[None, :] - lags_s[:, None]) / LAG_SPAN_S
        return np.asarray(np.median(np.linalg.norm(turn - rate, axis=2), axis=1))

    turn = _between(t_s, turned, edges_s) / LAG_SPAN_S
    fast = max(float(np.median(np.linalg.norm(part, axis=1))) for part in (turn, rate))
    off = float(off_by(np.zeros(1))[0])
    if off <= max(MIN_OFF_RAD_S, OFF_SHARE * fast):
        return LagFit(fast, off)
    noise = _noise(stretches)
    if off <= NOISE_RATIO * noise:
        return LagFit(fast, off)
    lags_s = np.arange(-MAX_LAG_S, MAX_LAG_S + LAG_STEPS_S[0] / 2, LAG_STEPS_S[0])
    lag_s = _least(lags_s, off_by(lags_s))
    near_s = lag_s + np.arange(-LAG_STEPS_S[0], LAG_STEPS_S[0] + LAG_STEPS_S[1] / 2, LAG_STEPS_S[1])
    near_s = near_s[np.abs(near_s) <= MAX_LAG_S]
    rest_rad_s = off_by(near_s)
    explained = (
        float(rest_rad_s.min()) <= min(off / MIN_BETTER, max(FIT_SHARE * fast, NOISE_RATIO * noise))
        and abs(lag_s) >= MIN_LAG_S
    )
    if explained:
        lag_s = float(near_s[rest_rad_s.argmin()])
    else:
        lag_s = 0.0
    return LagFit(fast, off, is_off=True, lag_s=lag_s)


def _turning_median(stretches: Sequence[Stretch]) -> float:
    return float(np.median([_faster(stretch) for stretch in stretches]))


def _noise(stretches: Sequence[Stretch]) -> float:
    """How far apart noise alone brings turn and rate over LAG_SPAN_S, rms, rad/s."""
    squares = []
    for stretch in stretches:
        slope = np.outer(stretch.at_s - stretch.at_s.mean(), stretch.turn)
        scatter = stretch.turned_rad - stretch.turned_rad.mean(axis=0) - slope
        of_turn = 2 * float((scatter**2).sum(axis=1).mean()) / LAG_SPAN_S**2
        of_rate = 3 * stretch.rate_sigma**2 * float(stretch.at_s[-1]) / LAG_SPAN_S
        squares.append(of_turn + of_rate)
    return math.sqrt(float(np.median(squares)))


def _joined(parts: Sequence[FloatArray]) -> FloatArray:
    """One running sum (n, 3), from 0, of the running sums of successive stretches, each of which
    begins at 0.
    """
    ends = np.cumsum([part[-1] for part in parts], axis=0)
    begins = np.vstack((np.zeros(3), ends[:-1]))
    return np.vstack(
        [np.zeros(3), *(part[1:] + begin for part, begin in zip(parts, begins, strict=True))]
    )


def _between(t_s: FloatArray, summed: FloatArray, edges_s: FloatArray) -> FloatArray:
    """What a sum (n, 3) over times (n,) gains between edges (..., m): (..., m - 1, 3)."""
    at_edges = np.stack([np.interp(edges_s, t_s, axis) for axis in summed.T], axis=-1)
    return np.diff(at_edges, axis=-2)


def _least(lags_s: FloatArray, off: FloatArray) -> float:
    """The lag with the smallest error. Of those nearly as good the shortest: in a periodic swing a
    lag that is a whole period longer fits as well.
    """
    good = lags_s[off <= off.min() + LAG_TIE * (off.max() - off.min())]
    return float(good[np.abs(good).argmin()])
