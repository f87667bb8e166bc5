"""A turn at a constant rate, and the packets that tell of it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.attitude.clock.timeline import Policy, Timeline
from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.rotation import from_radec_roll_deg, propagate
from hilstar.units import NS_PER_S

AXIS = np.array([0.6, 0.8, 0.0])  # across rows and columns
RADEC_ROLL_DEG = (84.0, 0.0, 15.0)  # Orion: enough bright stars
PACKET_HZ = 200.0


@dataclass(frozen=True, slots=True)
class Slew:
    """A turn at a constant rate from t = 0 on, and the packets that tell of it."""

    rate_deg_s: float

    @property
    def rate_cam_rad_s(self) -> FloatArray:
        """Of cam in icrs, cam components."""
        return np.asarray(math.radians(self.rate_deg_s) * AXIS)

    def at(self, seconds: float) -> FloatArray:
        """The true attitude."""
        return propagate(from_radec_roll_deg(*RADEC_ROLL_DEG), self.rate_cam_rad_s, seconds)

    def packets_until(self, seconds: float) -> Timeline:
        """The packets received by then."""
        timeline = Timeline(Policy(NS_PER_S, NS_PER_S))
        last = math.floor(seconds * PACKET_HZ)
        for number in range(last - 3, last + 1):
            t_s = number / PACKET_HZ
            timeline.add(AttitudeSample(round(t_s * NS_PER_S), self.at(t_s), self.rate_cam_rad_s, number))
        return timeline
