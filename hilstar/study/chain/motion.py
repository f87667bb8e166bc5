"""How a scene's camera moves, what its sender tells of that, and the attitude that hilstar makes of it for a frame."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.attitude.clock.timeline import Attitude, Policy, Timeline
from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.bench.config import AttitudeSettings, BenchConfig
from hilstar.rotation import multiply, propagate, rate_between_rad_s
from hilstar.study.shared.predictors import JITTER, RATE_STEP_NS
from hilstar.units import NS_PER_MS, NS_PER_S

# `held`: the newest sample's attitude. `rate`: carried on by the sample's rate. `two samples`: by the last two, from a sender
# that tells no rates.
Prediction = Literal["held", "rate", "two samples"]
PREDICTIONS: tuple[Prediction, ...] = ("rate", "two samples", "held")
AXIS = np.array([0.6, 0.8, 0.0])  # across rows and columns
PACKET_HZ = 100
KEPT = 4  # of the newest samples


@dataclass(frozen=True, slots=True)
class Movement:
    """A camera's true attitude: `q_icrs_to_cam` at t = 0, a constant turn about AXIS, and jitter on it where it turns."""

    q_icrs_to_cam: FloatArray
    rate_deg_s: float

    @property
    def turns(self) -> bool:
        """Whether it is not at rest."""
        return self.rate_deg_s != 0

    def at(self, t_ns: int) -> FloatArray:
        """The true q_icrs_to_cam."""
        if not self.turns:
            return self.q_icrs_to_cam
        t_s = t_ns / NS_PER_S
        q = propagate(self.q_icrs_to_cam, math.radians(self.rate_deg_s) * AXIS, t_s)
        for axis in range(3):
            angle = sum(math.radians(arcsec / 3600) * math.sin(2 * math.pi * hz * t_s + 2 * axis * hz) for arcsec, hz in JITTER)
            turn = np.zeros(4)
            turn[0], turn[1 + axis] = math.cos(angle / 2), math.sin(angle / 2)
            q = multiply(turn, q)
        return q

    def rate_rad_s(self, t_ns: int) -> FloatArray:
        """The true rate (3,) of cam in icrs, cam components, jitter included."""
        if not self.turns:
            return np.zeros(3)
        before, after = self.at(t_ns - RATE_STEP_NS), self.at(t_ns + RATE_STEP_NS)
        return rate_between_rad_s(before, after, 2 * RATE_STEP_NS / NS_PER_S)

    def samples(self, until_ns: int) -> list[AttitudeSample]:
        """The newest samples that are there at a moment."""
        last = until_ns * PACKET_HZ // NS_PER_S
        times_ns = [round(k * NS_PER_S / PACKET_HZ) for k in range(last + 1 - KEPT, last + 1)]
        return [AttitudeSample(t_ns, self.at(t_ns), self.rate_rad_s(t_ns)) for t_ns in times_ns]


def lead_ns(config: BenchConfig) -> int:
    """From a frame's begin to the first light of its middle row: a refresh to draw it in, then the panel."""
    monitor = config.monitor
    return round((monitor.period_ms + monitor.panel_delay_ms + monitor.panel_scanout_ms / 2) * NS_PER_MS)


def filled_timeline(samples: list[AttitudeSample], prediction: Prediction, settings: AttitudeSettings) -> Timeline:
    """The timeline of a bench file's settings with these samples, as a way of prediction has it."""
    ahead_ms = settings.max_extrapolation_ms or AttitudeSettings().max_extrapolation_ms
    stale_ns = round(settings.stale_after_ms * NS_PER_MS)
    timeline = Timeline(Policy(0 if prediction == "held" else round(ahead_ms * NS_PER_MS), stale_ns))
    for sample in samples:
        timeline.add(replace(sample, rate_cam_rad_s=None) if prediction == "two samples" else sample)
    return timeline


def attitude_at(timeline: Timeline, t_ns: int) -> Attitude:
    """The attitude at a moment, of a timeline that has samples."""
    attitude = timeline.at(t_ns)
    if attitude is None:
        raise AssertionError("the timeline has samples")
    return attitude
