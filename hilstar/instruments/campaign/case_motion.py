"""How a case's sky moves: at a rate that may change, and shaken by jitter, until it stands."""

import itertools
import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError
from hilstar.basics.rotation import (
    from_rotation_vector,
    multiply,
    propagate,
    rate_between_rad_s,
    to_matrix,
)
from hilstar.basics.units import ARCSEC_PER_RAD, NS_PER_S
from hilstar.optics.frame_motion import CameraTurn
from hilstar.optics.layers.view import View

AXES = ("x", "y", "z")
ACROSS = "across"  # about an axis in the image plane that each case draws
RATE, ACCELERATION, JITTER = "rate_deg_s", "acceleration_deg_s2", "jitter_arcsec"
JITTER_HZ, MOTION_S = "jitter_hz", "motion_s"
AXIS_STREAM = 2  # stream of a case's seed for the axis across the boresight and the jitter's phase
MAX_STEP_S = 0.01  # of a turn that accelerates
# Within an exposure a swing is drawn by straight pieces: a chord of a sixteenth of the period is
# off by at most 1 - cos(pi / 16), 1.9 % of the amplitude.
PIECES_A_PERIOD = 16
MAX_PIECES = 400  # of an exposure, each of which is drawn as a whole image
STILL = np.zeros(3)


@dataclass(frozen=True, slots=True)
class CaseMotion:
    """The turn of cam with respect to icrs from a case's begin: attitude (4,), rate (3,), rad/s,
    and acceleration (3,), rad/s2, cam.

    Jitter turns cam about its own axes by `jitter_rad` (3,) times the sine of `jitter_hz` from
    `phase_rad` on. After `motion_s` cam stands.
    """

    q_icrs_to_cam: FloatArray
    rate_rad_s: FloatArray
    acceleration_rad_s2: FloatArray = field(default_factory=lambda: STILL)
    motion_s: float = math.inf
    jitter_rad: FloatArray = field(default_factory=lambda: STILL)
    jitter_hz: float = 0.0
    phase_rad: float = 0.0

    @classmethod
    def of(
        cls, q_icrs_to_cam: FloatArray, values: dict[str, Any], rng: np.random.Generator
    ) -> "CaseMotion":
        """The motion by a case's values, whose generator draws the axis across the boresight, and
        then the jitter's phase.
        """
        angle_rad = rng.uniform(0.0, 2 * math.pi)
        axis = np.array([math.cos(angle_rad), math.sin(angle_rad), 0.0])
        return cls(
            q_icrs_to_cam,
            np.radians(_vector(values, RATE, axis)),
            np.radians(_vector(values, ACCELERATION, axis)),
            float(values.get(MOTION_S, math.inf)),
            _vector(values, JITTER, axis) / ARCSEC_PER_RAD,
            float(values.get(JITTER_HZ, 0.0)),
            rng.uniform(0.0, 2 * math.pi),
        )

    @property
    def _swing_rad_s(self) -> float:
        """The jitter's angular frequency."""
        return 2 * math.pi * self.jitter_hz

    def at(self, seconds: float) -> CameraTurn:
        """The attitude and the rate so long after the case's begin."""
        if seconds > self.motion_s:
            return CameraTurn(self.at(self.motion_s).q_icrs_to_cam, STILL)
        start = CameraTurn(self.q_icrs_to_cam, self.rate_rad_s)
        q, rate_rad_s = accelerated(start, self.acceleration_rad_s2, seconds)
        if not self.jitter_rad.any():
            return CameraTurn(q, rate_rad_s)
        phase_rad = self._swing_rad_s * seconds + self.phase_rad
        # components turn against the camera
        swing = from_rotation_vector(-self.jitter_rad * math.sin(phase_rad))
        swing_rate_rad_s = self.jitter_rad * self._swing_rad_s * math.cos(phase_rad)
        return CameraTurn(multiply(swing, q), to_matrix(swing) @ rate_rad_s + swing_rate_rad_s)

    def acceleration_at(self, seconds: float) -> FloatArray:
        """The acceleration (3,), rad/s2, so long after the case's begin."""
        if seconds > self.motion_s:
            return STILL
        phase_rad = self._swing_rad_s * seconds + self.phase_rad
        swing_rad_s2 = -self.jitter_rad * self._swing_rad_s**2 * math.sin(phase_rad)
        return self.acceleration_rad_s2 + swing_rad_s2

    def exposure(self, seconds: float, exposure_s: float, t_ns: int) -> View:
        """The view of an exposure whose middle is so long after the case's begin, at `t_ns`: its
        light as if the rate of that moment lasted (see `pieces`).
        """
        turn = self.at(seconds)
        return View.exposure(turn.q_icrs_to_cam, turn.rate_cam_rad_s, exposure_s, t_ns)

    def pieces(self, seconds: float, exposure_s: float, t_ns: int) -> list[View]:
        """Views, one after the other, of an exposure whose middle is so long after the case's
        begin, at `t_ns`, each at the mean rate of its part; one without jitter or the motion's end.
        """
        edges_s = self._edges_s(seconds, exposure_s)
        if len(edges_s) <= 2:  # the mean rate of a constant acceleration is that of the middle
            return [self.exposure(seconds, exposure_s, t_ns)]
        views = []
        for begin_s, end_s in itertools.pairwise(edges_s):
            middle_s = (begin_s + end_s) / 2
            begin, middle, end = (self.at(moment_s) for moment_s in (begin_s, middle_s, end_s))
            rate_rad_s = rate_between_rad_s(begin.q_icrs_to_cam, end.q_icrs_to_cam, end_s - begin_s)
            since_ns = round((middle_s - seconds) * NS_PER_S)
            views.append(
                View.exposure(middle.q_icrs_to_cam, rate_rad_s, end_s - begin_s, t_ns + since_ns)
            )
        return views

    def _edges_s(self, seconds: float, exposure_s: float) -> list[float]:
        """The ends of an exposure's pieces."""
        begin_s = seconds - exposure_s / 2
        end_s = seconds + exposure_s / 2
        edges = {begin_s, end_s}
        if begin_s < self.motion_s < end_s:
            edges.add(self.motion_s)
        if self.jitter_rad.any():
            count = swing_pieces(exposure_s, self.jitter_hz)
            edges.update(np.linspace(begin_s, end_s, count + 1).tolist())
        return sorted(edges)


def swing_pieces(exposure_s: float, jitter_hz: float) -> int:
    """How many pieces an exposure with jitter is drawn by. Raises InputError for more than
    MAX_PIECES.
    """
    count = math.ceil(exposure_s * jitter_hz * PIECES_A_PERIOD)
    if count > MAX_PIECES:
        max_hz = MAX_PIECES / PIECES_A_PERIOD / exposure_s
        raise InputError(
            f"{jitter_hz:g} Hz is too fast for an exposure of {exposure_s:g} s; write at most"
            f" {max_hz:.4g}"
        )
    return count


def by_axis(values: dict[str, Any], key: str) -> FloatArray:
    """The values (3,) of a key's x, y and z; 0 where a case has none."""
    vector = np.zeros(3)
    for k, axis in enumerate(AXES):
        vector[k] = float(values.get(f"{key}.{axis}", 0.0))
    return vector


def _vector(values: dict[str, Any], key: str, across: FloatArray) -> FloatArray:
    """The values (3,) of a key by axis, and about an axis (3,) across the boresight."""
    return by_axis(values, key) + float(values.get(f"{key}.{ACROSS}", 0.0)) * across


def accelerated(
    turn: CameraTurn, acceleration_rad_s2: FloatArray, seconds: float
) -> tuple[FloatArray, FloatArray]:
    """Attitude (4,) and rate (3,) after turning at a rate that changes at a constant rate, cam
    components: the midpoint rule in steps of MAX_STEP_S.
    """
    rate_rad_s = turn.rate_cam_rad_s
    if not seconds:
        return turn.q_icrs_to_cam, rate_rad_s
    if not acceleration_rad_s2.any():
        return propagate(turn.q_icrs_to_cam, rate_rad_s, seconds), rate_rad_s
    q = turn.q_icrs_to_cam
    steps = max(1, math.ceil(abs(seconds) / MAX_STEP_S))
    step_s = seconds / steps
    for step in range(steps):
        middle_s = (step + 0.5) * step_s
        q = propagate(q, rate_rad_s + acceleration_rad_s2 * middle_s, step_s)
    return q, rate_rad_s + acceleration_rad_s2 * seconds
