"""A slew shaken on each axis, and the predictors that carry its samples on to the moment of
light.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.interpolate import CubicSpline

from hilstar.attitude.clock.timeline import Attitude, Policy, Timeline
from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.basics.arrays import FloatArray
from hilstar.basics.rotation import from_radec_roll_deg, multiply, propagate, rate_between_rad_s
from hilstar.basics.units import NS_PER_MS, NS_PER_S
from hilstar.server.bench.config import AttitudeSettings

ORION = from_radec_roll_deg(84.057, -1.2, 10.0)
SLEW_DEG, SLEW_S = 3.0, 20.0
# Jitter per axis: amplitude, arcsec, and frequency, Hz, as wheels and structure shake a small
# satellite.
JITTER = ((2.0, 3.1), (1.0, 11.0), (0.3, 37.0))
RATE_STEP_NS = 100_000
NEAR = 4  # samples that a predictor has
AXIS = np.array([0.6, 0.8, 0.0])  # axis of a steady turn: across rows and columns

# From the last samples to the attitude at a time, ns.
AttitudeAt = Callable[[int], FloatArray]


@dataclass(frozen=True, slots=True)
class Predictor:
    """A way to the attitude at a time: `load` takes the last samples.

    Those of one that `waits` end after that time.
    """

    name: str
    load: Callable[[Sequence[AttitudeSample]], AttitudeAt]
    is_default: bool = False
    waits: bool = False


def predictors() -> tuple[Predictor, ...]:
    """Every way. The default is hilstar's timeline with a bench file's defaults, fed with rates."""
    settings = AttitudeSettings()
    ahead_ns = round(settings.max_extrapolation_ms * NS_PER_MS)
    bench_policy = Policy(ahead_ns, round(settings.stale_after_ms * NS_PER_MS))
    hold = Policy(0, bench_policy.stale_after_ns)
    return (
        Predictor("hold", partial(_timeline, hold)),
        Predictor(
            "linear, by the sample's rate",
            partial(_timeline, bench_policy),
            is_default=bench_policy.max_extrapolation_ns > 0,
        ),
        Predictor(
            "linear, by the last two samples", partial(_timeline, bench_policy, without_rates=True)
        ),
        Predictor("rate and acceleration", _accelerated),
        Predictor(f"cubic spline through {NEAR} samples", _spline),
        Predictor("C2 blend, a sample later", partial(_timeline, bench_policy), waits=True),
    )


def slew_attitude(t_ns: int) -> FloatArray:
    """The true q_icrs_to_cam: three turns about the camera's axes on ORION, each a slow swing
    and a fast jitter.
    """
    t_s = t_ns / NS_PER_S
    angles_rad = []
    for axis in range(3):
        swing = math.sin(2 * math.pi * t_s / SLEW_S + axis)
        angles_rad.append(math.radians(SLEW_DEG) * swing)
    return shaken(ORION, t_s, angles_rad)


def shaken(
    q_icrs_to_cam: FloatArray, t_s: float, angles_rad: Sequence[float] = (0.0, 0.0, 0.0)
) -> FloatArray:
    """An attitude turned about the camera's x, y and z by these angles and JITTER."""
    q = q_icrs_to_cam
    for axis, angle in enumerate(angles_rad):
        for size_arcsec, hz in JITTER:
            phase = 2 * math.pi * hz * t_s + 2 * axis * hz
            angle += math.radians(size_arcsec / 3600) * math.sin(phase)
        turn = np.zeros(4)
        turn[0] = math.cos(angle / 2)
        turn[1 + axis] = math.sin(angle / 2)
        q = multiply(turn, q)
    return q


def rate_of(attitude: Callable[[int], FloatArray], t_ns: int) -> FloatArray:
    """The rate (3,) of a movement by differences over RATE_STEP_NS on both sides.

    It is 0.006 arcsec/s off at 37 Hz, which is 0.0003 arcsec of a predicted attitude.
    """
    before = attitude(t_ns - RATE_STEP_NS)
    after = attitude(t_ns + RATE_STEP_NS)
    return rate_between_rad_s(before, after, 2 * RATE_STEP_NS / NS_PER_S)


@dataclass(frozen=True, slots=True)
class Movement:
    """A camera's true attitude: `q_icrs_to_cam` at t = 0, a steady turn about AXIS, and JITTER
    where it is `shaken`.

    A camera at rest is not shaken.
    """

    q_icrs_to_cam: FloatArray
    rate_deg_s: float
    packet_hz: int = 100
    shaken: bool = True

    @property
    def turns(self) -> bool:
        """Whether the camera turns at all."""
        return self.rate_deg_s != 0

    @property
    def turn_rad_s(self) -> FloatArray:
        """The constant turn (3,) of cam in icrs, cam components."""
        return np.asarray(math.radians(self.rate_deg_s) * AXIS)

    def at(self, t_ns: int) -> FloatArray:
        """The true q_icrs_to_cam."""
        if not self.turns:
            return self.q_icrs_to_cam
        t_s = t_ns / NS_PER_S
        q = propagate(self.q_icrs_to_cam, self.turn_rad_s, t_s)
        return shaken(q, t_s) if self.shaken else q

    def rate_rad_s(self, t_ns: int) -> FloatArray:
        """The true rate (3,) of cam in icrs, cam components, jitter included."""
        if self.turns and self.shaken:
            return rate_of(self.at, t_ns)
        return self.turn_rad_s

    def samples(self, until_ns: int) -> list[AttitudeSample]:
        """The newest NEAR samples at time `until_ns`."""
        last = until_ns * self.packet_hz // NS_PER_S
        samples = []
        for number in range(last + 1 - NEAR, last + 1):
            t_ns = round(number * NS_PER_S / self.packet_hz)
            sample = AttitudeSample(t_ns, self.at(t_ns), self.rate_rad_s(t_ns))
            samples.append(sample)
        return samples


def attitude_at(timeline: Timeline, t_ns: int) -> Attitude:
    """The attitude at a moment, of a timeline that has samples."""
    attitude = timeline.at(t_ns)
    if attitude is None:
        raise AssertionError("a timeline with samples has an attitude")
    return attitude


def slew_sample(t_ns: int) -> AttitudeSample:
    """The attitude with its rate."""
    return AttitudeSample(t_ns, slew_attitude(t_ns), rate_of(slew_attitude, t_ns))


def _timeline(
    policy: Policy, near: Sequence[AttitudeSample], without_rates: bool = False
) -> AttitudeAt:
    timeline = Timeline(policy)
    for sample in near:
        timeline.add(replace(sample, rate_cam_rad_s=None) if without_rates else sample)
    return lambda t_ns: attitude_at(timeline, t_ns).q_icrs_to_cam


def _accelerated(near: Sequence[AttitudeSample]) -> AttitudeAt:
    """Extrapolation by the newest rate and its change since the sample before."""
    before, newest = near[-2:]
    rate_before = np.asarray(before.rate_cam_rad_s)
    rate = np.asarray(newest.rate_cam_rad_s)

    def predicted(t_ns: int) -> FloatArray:
        ahead_s = (t_ns - newest.t_ns) / NS_PER_S
        gap_s = (newest.t_ns - before.t_ns) / NS_PER_S
        bend = (rate - rate_before) / gap_s
        return propagate(newest.q_icrs_to_cam, rate + 0.5 * ahead_s * bend, ahead_s)

    return predicted


def _spline(near: Sequence[AttitudeSample]) -> AttitudeAt:
    """Extrapolation of a cubic through the samples' turns from the newest one."""
    newest = near[-1]

    def predicted(t_ns: int) -> FloatArray:
        seconds = [(s.t_ns - newest.t_ns) / NS_PER_S for s in near]
        turns = []
        for s in near:
            turns.append(rate_between_rad_s(newest.q_icrs_to_cam, s.q_icrs_to_cam, 1.0))
        turn = CubicSpline(seconds, turns)((t_ns - newest.t_ns) / NS_PER_S)
        return propagate(newest.q_icrs_to_cam, np.asarray(turn), 1.0)

    return predicted
