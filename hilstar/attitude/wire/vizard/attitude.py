"""The attitude of one spacecraft of Basilisk: modified Rodrigues parameters to quaternions, and rates by differences.

Basilisk's sigma_BN = e tan(Phi/4) stands for the matrix [BN], which turns components of its inertial frame N into those of
the body B (Schaub and Junkins, Analytical Mechanics of Space Systems, section 3.5). N is taken as ICRS.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.attitude.wire.packet import U32, AttitudeSample, Refusal, checked_sample
from hilstar.attitude.wire.source import Conventions, Mounting
from hilstar.attitude.wire.vizard.message import SimUpdate, Spacecraft, decode_update
from hilstar.attitude.wire.vizard.state import named, state_about_earth, velocity_km_s
from hilstar.attitude.wire.vizard.wire_format import WireFormatError
from hilstar.errors import printable, shortened
from hilstar.rotation import rate_between_rad_s
from hilstar.units import NS_PER_S

MAX_NAMES = 8  # of spacecraft, in a refusal


def quaternion_of_mrp(sigma: tuple[float, ...]) -> tuple[float, float, float, float]:
    """The quaternion (w, x, y, z) that turns N's components into the body's; an MRP and its shadow give q and -q."""
    x, y, z = sigma
    square = x * x + y * y + z * z
    share = -2.0 / (1.0 + square)  # 0 where the square overflows: then the shadow is 0
    w = (1.0 - square) / (1.0 + square) if math.isfinite(square) else -1.0
    return w, share * x, share * y, share * z


def mrp_of_quaternion(q: FloatArray) -> FloatArray:
    """The MRP (3,) of at most length 1 of a quaternion that turns N's components into the body's."""
    return np.asarray(-q[1:] / (1.0 + q[0]) if q[0] >= 0 else q[1:] / (1.0 - q[0]))


def _written(q: FloatArray) -> str:
    return f"sigma_BN = ({', '.join(f'{c:.7f}' for c in mrp_of_quaternion(q))})"


TURNS = "sigma_BN turns components of Basilisk's inertial frame N, taken as ICRS (J2000), into body components"
VELOCITY = "the spacecraft's velocity, added to [sky] observer_velocity_km_s, aberrates the stars"
PLACE = "its place and velocity about the Earth (at N's origin, where the message has none) are those of the observer"
Taken = Literal["attitude", "velocity", "state"]  # of a message, besides the attitude
TOLD: dict[Taken, tuple[str, ...]] = {"attitude": (), "velocity": (VELOCITY,), "state": (PLACE,)}

CONVENTIONS = Conventions(
    "Basilisk's Vizard stream",
    TURNS,
    "modified Rodrigues parameters; the shadow set is the same attitude",
    "nanoseconds since the simulation began; it has no date",
    of_body=True,
    written=_written,
)


class DifferenceRates:
    """The rate and the acceleration at each sample from the attitudes of the last three.

    The mean rates of the last two intervals, carried on linearly to the newest sample: for steps h and a rate whose second
    derivative is j, the rate is short of the true one by j h^2 / 3 and the acceleration by j h. (The mean of the last interval
    alone would lag by half a step's change.) None for the first two of a row; a row ends where time goes back or stands, where
    a step is longer than `max_step_ns`, and where the turn exceeds `max_rate_rad_s`, which is a jump.
    """

    def __init__(self, max_step_ns: int, max_rate_rad_s: float) -> None:
        self._max_step_ns, self._max_rate_rad_s = max_step_ns, max_rate_rad_s
        self._last: AttitudeSample | None = None
        self._mean: tuple[FloatArray, float] | None = None

    def moving(self, sample: AttitudeSample) -> AttitudeSample:
        """The sample with its rate (3,), rad/s, and acceleration (3,), rad/s^2, in the components of its own frame."""
        before, self._last = self._last, sample
        earlier, self._mean = self._mean, None
        if before is None or not 0 < sample.t_ns - before.t_ns <= self._max_step_ns:
            return sample
        step_s = (sample.t_ns - before.t_ns) / NS_PER_S
        mean = rate_between_rad_s(before.q_icrs_to_cam, sample.q_icrs_to_cam, step_s)
        if math.hypot(*mean) > self._max_rate_rad_s:
            return sample
        self._mean = mean, step_s
        if earlier is None:
            return sample
        earlier_mean, earlier_s = earlier
        acceleration = (mean - earlier_mean) / ((step_s + earlier_s) / 2)
        rate = mean + acceleration * (step_s / 2)
        if math.hypot(*rate) > self._max_rate_rad_s:
            return sample
        return replace(sample, rate_cam_rad_s=rate, acceleration_cam_rad_s2=acceleration)


class Follower:
    """The attitudes of one spacecraft from messages: that of the `name`, or the only one there is.

    Each has the spacecraft's velocity with respect to the origin of Basilisk's frame, of `taken` "velocity"; or its place and
    velocity about the Earth, of "state".
    """

    def __init__(self, name: str | None, mounting: Mounting, rates: DifferenceRates, taken: Taken = "attitude") -> None:
        self._name, self._mounting, self._rates = name, mounting, rates
        self._taken = taken
        self.conventions = replace(CONVENTIONS, turns="; ".join((TURNS, *TOLD[taken])))

    def take(self, message: bytes) -> tuple[AttitudeSample | Refusal, SimUpdate | None]:
        """The camera's attitude in a VizMessage, or why there is none; and the message itself where it is one."""
        try:
            update = decode_update(message)
        except WireFormatError as error:
            return Refusal("format", f"not Basilisk's VizMessage: {error}"), None
        chosen = self._chosen(update.spacecraft)
        if isinstance(chosen, Refusal):
            return chosen, update
        if len(chosen.sigma_bn) != 3:
            what = f"spacecraft {named(chosen)}: {len(chosen.sigma_bn)} components of its rotation (sigma_BN), not 3"
            return Refusal("format", what), update
        sample = checked_sample(update.t_ns, quaternion_of_mrp(chosen.sigma_bn), None, update.frame % U32)
        state = self._state(update, chosen)
        if isinstance(state, Refusal):
            return state, update
        if isinstance(sample, AttitudeSample):
            sample = replace(sample, place_km=state[0], velocity_km_s=state[1])
            sample = self._mounting.sample(self._rates.moving(sample))
        return sample, update

    def _state(self, update: SimUpdate, craft: Spacecraft) -> tuple[FloatArray | None, FloatArray | None] | Refusal:
        """Place and velocity, as far as they are taken."""
        if self._taken == "state":
            return state_about_earth(update, craft)
        velocity = velocity_km_s(craft) if self._taken == "velocity" else None
        return velocity if isinstance(velocity, Refusal) else (None, velocity)

    def _chosen(self, spacecraft: tuple[Spacecraft, ...]) -> Spacecraft | Refusal:
        """The spacecraft that is followed; parts of others (a parent is named) are taken only by their own name."""
        if self._name is None:
            found = [craft for craft in spacecraft if craft.parent in {"", craft.name}]
        else:
            found = [craft for craft in spacecraft if craft.name == self._name]
        if len(found) == 1:
            return found[0]
        names = ", ".join(map(named, (found if self._name is None else spacecraft)[:MAX_NAMES])) or "none"
        if self._name is None:
            return Refusal("format", f'spacecraft: {names}; write the one that is meant, [attitude] spacecraft = "NAME"')
        wanted = shortened(printable(self._name))
        return Refusal("format", f"[attitude] spacecraft = {wanted}: {len(found)} have that name; there: {names}")
