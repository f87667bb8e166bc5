"""How much of the newest rate's jitter to carry on, from how the last second's rates carried on; no I/O.

A rate has a steady part, which a filter follows without lag through any constant acceleration, and jitter about it. Over a time
ahead x / (2 pi f) a vibration of frequency f goes on by sin(x) / x of its rate, noise by nothing: the regression of what
followed on the jitter before it, over samples that lie as far apart as frames predict, says by how much. A constant rate has no
jitter, and is left as it is to the last bit.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

from hilstar.units import NS_PER_S

STEADY_S = 0.3  # time constant of the steady part
MEMORY_S = 0.5  # of the regression: what is a second old counts an eighth
MIN_SAMPLES = 10
MAX_KEPT = 256  # samples to look back on: a quarter of a second at 1000 Hz
MAX_SIGMAS = 3.0  # of the jitter: what exceeds it is a turn that begins, and is carried on whole
AGE_SHARE = 0.1  # of each frame in the usual time ahead

Vector = tuple[float, float, float]
NOTHING: Vector = (0.0, 0.0, 0.0)


class Damped(NamedTuple):
    """What to take from a sample's rate, rad/s, cam, for a prediction by `ahead_s`; less of it for a shorter one."""

    excess: Vector
    ahead_s: float

    def by(self, seconds: float) -> Vector:
        """The part of the rate to leave out where the attitude is predicted by so long."""
        share = 1.0 if seconds >= self.ahead_s else (seconds / self.ahead_s) ** 2  # 1 - sin(x) / x goes with the square
        x, y, z = self.excess
        return share * x, share * y, share * z


UNDAMPED = Damped(NOTHING, 1.0)


class _Seen(NamedTuple):
    t_ns: int
    turned: Vector  # since the beginning, the sum of the samples' own turns, rad
    steady: Vector
    jitter: Vector


class Damping:
    """Follows one stream's rates. `usual_s` is how far ahead frames predict: anybody may set it."""

    def __init__(self) -> None:
        self.usual_s = 0.0
        self.restart()

    def restart(self) -> None:
        """Forget the samples so far: what follows does not continue them."""
        self._seen: deque[_Seen] = deque(maxlen=MAX_KEPT)
        self._trend = [0.0, 0.0, 0.0]
        self._weight = 0.0
        self._ahead_s = 0.0
        self._xx, self._xy = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]

    def asked(self, seconds: float) -> None:
        """A frame was predicted by so long."""
        self.usual_s += AGE_SHARE * (seconds - self.usual_s)

    def add(self, t_ns: int, rate: Vector, turn: Vector | None) -> Damped:
        """Take the next sample, which turned by `turn` (rad) since the one before it; what to take from its rate."""
        if turn is None or not self._seen:
            self.restart()
            self._seen.append(_Seen(t_ns, NOTHING, rate, NOTHING))
            return UNDAMPED
        last = self._seen[-1]
        new = self._follow(last, t_ns, rate, turn)
        self._learn(new, (t_ns - last.t_ns) / NS_PER_S)
        self._seen.append(new)
        if len(self._seen) <= MIN_SAMPLES:
            return UNDAMPED
        x, y, z = (self._excess(axis, new.jitter[axis]) for axis in range(3))
        return Damped((x, y, z), self._ahead_s)

    def _follow(self, last: _Seen, t_ns: int, rate: Vector, turn: Vector) -> _Seen:
        """The steady part and its trend, by the critically damped filter of second order (Brookner 1998, 1.2)."""
        step_s = (t_ns - last.t_ns) / NS_PER_S
        keeps = math.exp(-step_s / STEADY_S)
        alpha, beta = 1 - keeps * keeps, (1 - keeps) ** 2
        steady, turned = list(last.steady), list(last.turned)
        for axis in range(3):
            expected = steady[axis] + self._trend[axis] * step_s
            off = rate[axis] - expected
            steady[axis] = expected + alpha * off
            self._trend[axis] += beta * off / step_s
            turned[axis] += turn[axis]
        jitter = rate[0] - steady[0], rate[1] - steady[1], rate[2] - steady[2]
        return _Seen(t_ns, (turned[0], turned[1], turned[2]), (steady[0], steady[1], steady[2]), jitter)

    def _learn(self, new: _Seen, step_s: float) -> None:
        """How a sample's jitter went on until the newest one, as far ahead as frames predict."""
        from_ns = new.t_ns - round(self.usual_s * NS_PER_S)
        for before in reversed(self._seen):
            if before.t_ns <= from_ns + round(step_s * NS_PER_S / 2):
                break
        ahead_s = (new.t_ns - before.t_ns) / NS_PER_S
        keeps = math.exp(-step_s / MEMORY_S)
        self._weight = keeps * self._weight + 1
        self._ahead_s += (ahead_s - self._ahead_s) / self._weight
        for axis in range(3):
            x = before.jitter[axis]
            y = (new.turned[axis] - before.turned[axis]) / ahead_s - before.steady[axis]
            self._xx[axis] = keeps * self._xx[axis] + x * x
            self._xy[axis] = keeps * self._xy[axis] + x * y

    def _excess(self, axis: int, jitter: float) -> float:
        xx = self._xx[axis]
        if xx <= 0.0:
            return 0.0
        most = MAX_SIGMAS * math.sqrt(xx / self._weight)
        goes_on = min(max(self._xy[axis] / xx, 0.0), 1.0)
        return (1.0 - goes_on) * min(max(jitter, -most), most)
