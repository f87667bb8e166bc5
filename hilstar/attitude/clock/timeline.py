"""The attitude at any time, from samples: interpolated between them, predicted for a bounded time
past the last; no I/O.

Times are nanoseconds on one continuous clock: the sender's, with its jumps removed (`jumps`).

Prediction damps the jitter of the newest rate (`_Damping`). A rate has a steady part, which a
filter follows without lag through any constant acceleration, and jitter about it. Over a prediction
time x / (2 pi f) a vibration of frequency f keeps sin(x) / x of its rate, noise keeps nothing. The
share to keep is the regression of what followed on the jitter before it, over samples as far apart
as frames predict. A constant rate has no jitter and passes unchanged to the last bit.
"""

import math
import threading
from bisect import bisect_right
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

from hilstar.attitude.wire.packet import AttitudeSample, Refusal, rate_refusal
from hilstar.basics.arrays import FloatArray
from hilstar.basics.rotation import angle_between_rad, propagate, rate_between_rad_s, slerp
from hilstar.basics.units import NS_PER_S

STEADY_S = 0.3  # time constant of the steady part
MEMORY_S = 0.5  # time constant of the regression: a second-old sample counts an eighth
MIN_SAMPLES = 10
MAX_KEPT = 256  # samples to look back on: a quarter of a second at 1000 Hz
MAX_SIGMAS = 3.0  # larger jitter is the beginning of a turn, and is not damped
AGE_SHARE = 0.1  # weight of each frame in the usual prediction time

Vector = tuple[float, ...]  # three components
NOTHING: Vector = (0.0, 0.0, 0.0)
# A live timeline keeps one to two times this many samples, 5 s or more at 200 Hz: far more than a
# frame looks back.
LIVE_CAPACITY = 1024
# A stale attitude is fresh again once it is younger than this share of `stale_after`, so that it
# does not flicker at the limit.
FRESH_AGAIN = 0.5

# Between two samples: the first one is held, SLERP takes the shorter way, or both are blended (C2)
# with their rates.
Join = Literal["hold", "slerp", "blend"]
# Past the newest: by its rate, or by what of that rate's jitter the last second's samples show to
# go on.
Prediction = Literal["rate", "auto"]
Joins = Callable[[AttitudeSample, AttitudeSample], Join]


class _Damped(NamedTuple):
    """The excess of a sample's rate, rad/s, cam, over what a prediction by `ahead_s` uses; less
    for a shorter one.
    """

    excess: Vector
    ahead_s: float

    def by(self, seconds: float) -> Vector:
        # 1 - sin(x) / x goes with the square
        if seconds >= self.ahead_s:
            share = 1.0
        else:
            share = (seconds / self.ahead_s) ** 2
        x, y, z = self.excess
        return share * x, share * y, share * z


UNDAMPED = _Damped(NOTHING, 1.0)


class _SeenSample(NamedTuple):
    t_ns: int
    turned: Vector  # since the beginning, the sum of the samples' own turns, rad
    steady: Vector
    jitter: Vector


class _Damping:
    """Follows one stream's rates. `usual_s` is how far ahead frames predict: anybody may set it."""

    def __init__(self) -> None:
        self.usual_s = 0.0
        self.restart()

    def restart(self) -> None:
        self._seen: deque[_SeenSample] = deque(maxlen=MAX_KEPT)
        self._trend = [0.0, 0.0, 0.0]
        self._weight = 0.0
        self._ahead_s = 0.0
        self._xx = [0.0, 0.0, 0.0]
        self._xy = [0.0, 0.0, 0.0]

    def asked(self, seconds: float) -> None:
        self.usual_s += AGE_SHARE * (seconds - self.usual_s)

    def add(self, t_ns: int, rate: Vector, turn: Vector | None) -> _Damped:
        """Take the next sample, with its turn (rad) since the previous one; returns how to damp its
        rate.

        The steady part and its trend follow by the critically damped filter of second order
        (Brookner 1998, 1.2).
        """
        if turn is None or not self._seen:
            self.restart()
            self._seen.append(_SeenSample(t_ns, NOTHING, rate, NOTHING))
            return UNDAMPED
        last = self._seen[-1]
        step_s = (t_ns - last.t_ns) / NS_PER_S
        keeps = math.exp(-step_s / STEADY_S)
        alpha = 1 - keeps * keeps
        beta = (1 - keeps) ** 2
        steady = list(last.steady)
        turned = list(last.turned)
        jitter = [0.0, 0.0, 0.0]
        for axis in range(3):
            expected = steady[axis] + self._trend[axis] * step_s
            off = rate[axis] - expected
            steady[axis] = expected + alpha * off
            self._trend[axis] += beta * off / step_s
            turned[axis] += turn[axis]
            jitter[axis] = rate[axis] - steady[axis]
        # How a sample's jitter went on until this one, as far ahead as frames predict.
        from_ns = t_ns - round(self.usual_s * NS_PER_S)
        for before in reversed(self._seen):
            if before.t_ns <= from_ns + round(step_s * NS_PER_S / 2):
                break
        ahead_s = (t_ns - before.t_ns) / NS_PER_S
        keeps = math.exp(-step_s / MEMORY_S)
        self._weight = keeps * self._weight + 1
        self._ahead_s += (ahead_s - self._ahead_s) / self._weight
        excess = [0.0, 0.0, 0.0]
        for axis in range(3):
            x = before.jitter[axis]
            y = (turned[axis] - before.turned[axis]) / ahead_s - before.steady[axis]
            self._xx[axis] = keeps * self._xx[axis] + x * x
            self._xy[axis] = keeps * self._xy[axis] + x * y
            if self._xx[axis] > 0.0:
                most = MAX_SIGMAS * math.sqrt(self._xx[axis] / self._weight)
                goes_on = min(max(self._xy[axis] / self._xx[axis], 0.0), 1.0)
                excess[axis] = (1.0 - goes_on) * min(max(jitter[axis], -most), most)
        self._seen.append(_SeenSample(t_ns, tuple(turned), tuple(steady), tuple(jitter)))
        if len(self._seen) <= MIN_SAMPLES:
            return UNDAMPED
        return _Damped(tuple(excess), self._ahead_s)


@dataclass(frozen=True, slots=True)
class Attitude:
    """An attitude at one time, with the age, sequence and arrival of the newest sample behind it,
    and whether it is too old.

    `prediction_ns` is how far the attitude was propagated past that sample, and `rate_cam_rad_s`
    the rate at that time, None where the attitude is held. `velocity_km_s` is that of the sample
    before it, and `place_km` is carried on from that sample.
    """

    q_icrs_to_cam: FloatArray
    age_ns: int
    stale: bool
    sequence: int = 0
    received_ns: int | None = None
    prediction_ns: int = 0
    rate_cam_rad_s: FloatArray | None = None
    velocity_km_s: FloatArray | None = None
    place_km: FloatArray | None = None


@dataclass(frozen=True, slots=True)
class Policy:
    """How far to predict past the newest sample, how long it counts as fresh, and the maximum rate.

    With `prediction` "auto" a rate's jitter is carried on only as far as the samples show that it
    goes on. A sample whose rate exceeds `max_rate_rad_s` is refused; two samples farther apart than
    that are a jump.
    """

    max_extrapolation_ns: int
    stale_after_ns: int
    max_rate_rad_s: float = math.inf
    prediction: Prediction = "rate"


class Timeline:
    """Samples in order of time. One thread may add while another asks.

    `joins` says how two of them join; the default suits a live stream.
    """

    def __init__(
        self, policy: Policy, capacity: int = LIVE_CAPACITY, joins: Joins | None = None
    ) -> None:
        self.policy = policy
        self._joins = joins
        self._capacity = capacity
        self._t_ns: list[int] = []
        self._samples: list[AttitudeSample] = []
        self._received_ns: int | None = None  # when the newest sample arrived
        self._damping = _Damping() if policy.prediction == "auto" else None
        self._damped = UNDAMPED  # for the newest sample
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._samples)

    def add(self, sample: AttitudeSample, received_ns: int | None = None) -> Refusal | None:
        """Append a sample, or say why it is refused: its time does not increase, or its rate is
        too high.
        """
        too_fast = rate_refusal(sample, self.policy.max_rate_rad_s)
        if too_fast is not None:
            return too_fast
        damped = self._damp(sample)
        with self._lock:
            if self._t_ns and sample.t_ns <= self._t_ns[-1]:
                return Refusal(
                    "time", f"t_ns {sample.t_ns} is not after {self._t_ns[-1]} of an earlier packet"
                )
            self._t_ns.append(sample.t_ns)
            self._samples.append(sample)
            self._received_ns = received_ns
            self._damped = damped
            if len(self._samples) > 2 * self._capacity:
                del self._t_ns[: self._capacity], self._samples[: self._capacity]
            return None

    def at(self, t_ns: int) -> Attitude | None:
        """The attitude at `t_ns`, or None before any sample has come.

        Before the first sample it is the first. Between two it is the C2 blend of both where both
        have rates, else SLERP; before a discontinuity, in a log's gap, and for a turn faster than
        `max_rate_rad_s` the earlier one is held. Past the newest it is predicted with the sample's
        rate (else that of the last two samples; where the policy says "auto", less what `damping`
        takes from it), and its acceleration where it has one, for at most `max_extrapolation_ns`,
        and then held.
        """
        with self._lock:
            if not self._samples:
                return None
            i = bisect_right(self._t_ns, t_ns) - 1
            near = self._samples[max(i - 1, 0) : i + 3]
            received_ns = self._received_ns
            damped = self._damped
        place = max(min(i, 1), 0)
        if i >= 0:
            state = self._at(t_ns, near, place, received_ns, damped)
        else:
            state = _held(near[0], 0, False)
        if near[place].velocity_km_s is None:
            return state
        return replace(
            state,
            velocity_km_s=near[place].velocity_km_s,
            place_km=self._place_km(near, place, t_ns),
        )

    def _place_km(self, near: list[AttitudeSample], place: int, t_ns: int) -> FloatArray | None:
        """Where the observer is: on the cubic through two samples, else straight on for as long
        as attitudes are predicted.
        """
        before = near[place]
        if before.place_km is None or before.velocity_km_s is None:
            return None
        age_ns = max(t_ns - before.t_ns, 0)
        if place + 1 < len(near):
            after = near[place + 1]
        else:
            after = before
        if (
            after is before
            or after.place_km is None
            or after.velocity_km_s is None
            or self._jumped(before, after)
        ):
            return before.place_km + before.velocity_km_s * (
                min(age_ns, self.policy.max_extrapolation_ns) / NS_PER_S
            )
        gap_s = (after.t_ns - before.t_ns) / NS_PER_S
        u = age_ns / (after.t_ns - before.t_ns)
        straight = after.place_km - before.place_km
        bend = (1 - u) * (before.velocity_km_s * gap_s - straight) - u * (
            after.velocity_km_s * gap_s - straight
        )
        return before.place_km + u * straight + u * (1 - u) * bend

    def _at(
        self,
        t_ns: int,
        near: list[AttitudeSample],
        place: int,
        received_ns: int | None,
        damped: _Damped,
    ) -> Attitude:
        newest = near[place]
        age_ns = t_ns - newest.t_ns
        if place + 1 < len(near):
            join = self._joined(newest, near[place + 1])
            if join == "hold":
                gap = age_ns > self.policy.stale_after_ns and not self._jumped(
                    newest, near[place + 1]
                )
                return _held(newest, age_ns, gap)
            q, rate = self._between(near, place, age_ns, join)
            return Attitude(q, age_ns, False, newest.sequence, rate_cam_rad_s=rate)
        own_rate = self._rate_of(near[place - 1] if place else None, newest)
        return replace(self._predict(newest, own_rate, age_ns, damped), received_ns=received_ns)

    def _between(
        self, near: list[AttitudeSample], place: int, age_ns: int, join: Join
    ) -> tuple[FloatArray, FloatArray]:
        """Attitude and rate between two samples; in a blend the rates are blended too."""
        before = near[place]
        after = near[place + 1]
        gap_ns = after.t_ns - before.t_ns
        rate = before.rate_cam_rad_s
        rate_after = after.rate_cam_rad_s
        if rate is None or rate_after is None or join == "slerp":
            rate = rate_between_rad_s(before.q_icrs_to_cam, after.q_icrs_to_cam, gap_ns / NS_PER_S)
            return slerp(before.q_icrs_to_cam, after.q_icrs_to_cam, age_ns / gap_ns), rate
        forward = age_ns / NS_PER_S
        backward = (age_ns - gap_ns) / NS_PER_S
        bend, bend_after = (self._acceleration_rad_s2(near, k) for k in (place, place + 1))
        from_before = propagate(before.q_icrs_to_cam, rate + 0.5 * forward * bend, forward)
        from_after = propagate(
            after.q_icrs_to_cam, rate_after + 0.5 * backward * bend_after, backward
        )
        u = age_ns / gap_ns
        # first and second derivatives 0 at both ends (Perlin 2002)
        share = u * u * u * (10.0 + u * (6.0 * u - 15.0))
        turning = (1 - share) * (rate + forward * bend) + share * (
            rate_after + backward * bend_after
        )
        return slerp(from_before, from_after, share), turning

    def _acceleration_rad_s2(self, near: list[AttitudeSample], k: int) -> FloatArray:
        """At sample `k`, from its neighbours' rates: equal for the intervals on both sides,
        which makes the blend C2.
        """
        if k and self._joined(near[k - 1], near[k]) == "blend":
            earlier = k - 1
        else:
            earlier = k
        if k + 1 < len(near) and self._joined(near[k], near[k + 1]) == "blend":
            later = k + 1
        else:
            later = k
        rate = near[earlier].rate_cam_rad_s
        rate_later = near[later].rate_cam_rad_s
        if rate is None or rate_later is None or earlier == later:
            raise AssertionError("a sample of a blend has a rate and a neighbour")
        return (rate_later - rate) / ((near[later].t_ns - near[earlier].t_ns) / NS_PER_S)

    def _joined(self, before: AttitudeSample, after: AttitudeSample) -> Join:
        if self._jumped(before, after):
            return "hold"
        if self._joins is not None:
            return self._joins(before, after)
        # Rates say little about a long silence: propagated across it from both sides they
        # overshoot; SLERP cannot.
        known = before.rate_cam_rad_s is not None and after.rate_cam_rad_s is not None
        if known and after.t_ns - before.t_ns <= self.policy.stale_after_ns:
            return "blend"
        return "slerp"

    def _jumped(self, before: AttitudeSample, after: AttitudeSample) -> bool:
        """True where the attitude jumps: the sample says so, or the turn would exceed the
        maximum rate.
        """
        if after.discontinuity:
            return True
        seconds = (after.t_ns - before.t_ns) / NS_PER_S
        return (
            angle_between_rad(before.q_icrs_to_cam, after.q_icrs_to_cam)
            > self.policy.max_rate_rad_s * seconds
        )

    def _rate_of(
        self, previous: AttitudeSample | None, newest: AttitudeSample
    ) -> FloatArray | None:
        """The rate for predicting past a sample: its own, else that of the turn to it; None
        where neither is known.
        """
        if newest.rate_cam_rad_s is not None or previous is None or self._jumped(previous, newest):
            return newest.rate_cam_rad_s
        gap_ns = newest.t_ns - previous.t_ns
        if gap_ns > self.policy.stale_after_ns:
            return None
        return rate_between_rad_s(previous.q_icrs_to_cam, newest.q_icrs_to_cam, gap_ns / NS_PER_S)

    def _damp(self, sample: AttitudeSample) -> _Damped:
        """How far the rate of the next sample is damped before it is used to predict; not at all
        where its acceleration is known.
        """
        damping = self._damping
        previous = self._samples[-1] if self._samples else None
        if damping is None or (previous is not None and sample.t_ns <= previous.t_ns):
            return UNDAMPED
        rate = self._rate_of(previous, sample)
        if rate is None or sample.acceleration_cam_rad_s2 is not None:
            damping.restart()
            return UNDAMPED
        # Across a gap or a jump the attitudes do not say how the camera turned.
        if (
            previous is None
            or sample.t_ns - previous.t_ns > self.policy.stale_after_ns
            or self._jumped(previous, sample)
        ):
            return damping.add(sample.t_ns, tuple(rate.tolist()), None)
        turn = rate_between_rad_s(previous.q_icrs_to_cam, sample.q_icrs_to_cam, 1.0)
        return damping.add(sample.t_ns, tuple(rate.tolist()), tuple(turn.tolist()))

    def _predict(
        self, newest: AttitudeSample, rate: FloatArray | None, age_ns: int, damped: _Damped
    ) -> Attitude:
        stale = age_ns > self.policy.stale_after_ns
        if rate is None:
            return _held(newest, age_ns, stale)
        # results/tradeoff.csv, prediction: 5.5 arcsec by the rate of the sample; a cubic spline 17,
        # holding 144.
        prediction_ns = min(age_ns, self.policy.max_extrapolation_ns)
        seconds = prediction_ns / NS_PER_S
        bend = newest.acceleration_cam_rad_s2
        if self._damping is not None:
            self._damping.asked(seconds)
            if damped is not UNDAMPED:
                rate = rate - damped.by(seconds)
        mean, last = (
            (rate, rate) if bend is None else (rate + 0.5 * seconds * bend, rate + seconds * bend)
        )
        q = propagate(newest.q_icrs_to_cam, mean, seconds)
        turning = last if prediction_ns == age_ns else None  # held past that
        return Attitude(
            q, age_ns, stale, newest.sequence, prediction_ns=prediction_ns, rate_cam_rad_s=turning
        )


def _held(sample: AttitudeSample, age_ns: int, stale: bool) -> Attitude:
    return Attitude(sample.q_icrs_to_cam, age_ns, stale, sample.sequence)


class StaleGate:
    """Whether the attitude is stale, with hysteresis, and how often it became so."""

    def __init__(self, stale_after_ns: int) -> None:
        self._fresh_again_ns = FRESH_AGAIN * stale_after_ns
        self.stale = False
        self.events = 0

    def update(self, attitude: Attitude | None) -> bool:
        """True while the attitude is too old; None (before the first) is stale, but not counted."""
        if attitude is None:
            return True
        if attitude.stale and not self.stale:
            self.events += 1
        self.stale = attitude.stale or (self.stale and attitude.age_ns > self._fresh_again_ns)
        return self.stale
