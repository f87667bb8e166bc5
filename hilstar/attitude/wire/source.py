"""What a source of attitudes means by its numbers, and how the attitude of a body becomes that of the camera."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from hilstar.attitude.wire.packet import AttitudeSample

if TYPE_CHECKING:  # NumPy takes 70 ms, and a process that only stamps packets needs none
    from hilstar.arrays import FloatArray

Components = tuple[float, float, float, float]
IDENTITY: Components = (1.0, 0.0, 0.0, 0.0)
# Orion's belt at roll 0, which everybody finds: the star is Alnilam (HIP 26311), 15 arcsec from the boresight.
CHECK_RADEC_DEG, CHECK_STAR = (84.057, -1.200), "Alnilam"
UNSTATED = (
    "the source holds the body's attitude, and the tracker's axes are taken as the body's; "
    "write [tracker] q_body_to_cam (without a bench file: --mounting W,X,Y,Z)"
)


class Mounting:
    """How the camera sits in the body: `q_body_to_cam`, which turns body components into camera components.

    None where nobody has said: the camera's axes are then taken as the body's, and `told` says so.
    """

    def __init__(self, q_body_to_cam: Components | None = None) -> None:
        import numpy as np

        from hilstar.rotation import normalise, to_matrix

        self.q_body_to_cam = normalise(np.array(q_body_to_cam or IDENTITY, dtype=np.float64))
        self.told = [] if q_body_to_cam else [("mounting", UNSTATED)]
        self._matrix = to_matrix(self.q_body_to_cam)
        self._plain = q_body_to_cam in {None, IDENTITY}

    def sample(self, body: AttitudeSample) -> AttitudeSample:
        """The camera's attitude and motion of a sample that holds the body's: q_icrs_to_body, rate in body components."""
        if self._plain:
            return body
        from hilstar.rotation import multiply

        rate, acceleration = body.rate_cam_rad_s, body.acceleration_cam_rad_s2
        return replace(
            body,
            q_icrs_to_cam=multiply(self.q_body_to_cam, body.q_icrs_to_cam),
            rate_cam_rad_s=None if rate is None else self._matrix @ rate,
            acceleration_cam_rad_s2=None if acceleration is None else self._matrix @ acceleration,
        )

    def q_icrs_to_body(self, q_icrs_to_cam: FloatArray) -> FloatArray:
        """The body's attitude of the camera's."""
        from hilstar.rotation import conjugate, multiply

        return multiply(conjugate(self.q_body_to_cam), q_icrs_to_cam)


@dataclass(frozen=True, slots=True)
class Conventions:
    """What a source means by its numbers: `--explain` shows it, and the documentation says the same.

    `turns` says from which frame to which; `scalar` the order of the components; `time` the scale and the zero of its times;
    `of_body` whether `[tracker] q_body_to_cam` applies; `written` gives an attitude in the source's own words; `scale` is the
    time scale (UTC, TAI, TT, TDB, GPS) whose ns since 1970-01-01T00:00:00 its times are, in days of 86400 s; None for others.
    """

    source: str
    turns: str
    scalar: str
    time: str
    of_body: bool
    written: Callable[[FloatArray], str]
    scale: str | None = None

    def lines(self, mounting: Mounting) -> list[str]:
        """The conventions, and the self-check, for a person."""
        from hilstar.rotation import from_radec_roll_deg

        q = from_radec_roll_deg(*CHECK_RADEC_DEG, 0.0)
        own = mounting.q_icrs_to_body(q) if self.of_body else q
        ra_deg, dec_deg = CHECK_RADEC_DEG
        mounted = f"it is the body's; [tracker] q_body_to_cam = {components(mounting.q_body_to_cam)} makes it the camera's"
        seen = f"{CHECK_STAR} (RA {ra_deg:g}, Dec {dec_deg:g}) is in the middle, north up"
        return [
            f"{self.source}: {self.turns}; {self.scalar}",
            f"attitude: {mounted if self.of_body else 'it is the camera itself; q_body_to_cam is not used'}",
            f"time: {self.time}",
            f"self-check: at {self.written(own)} {seen}; yours should be too",
        ]


def components(q: FloatArray) -> str:
    """Components as text with seven digits, in the order given."""
    return "(" + ", ".join(f"{c:.7f}" for c in q) + ")"


PACKETS = Conventions(
    "hilstar's packets and logs",
    "q_icrs_to_cam turns ICRS components into camera components",
    "scalar first (w, x, y, z), Hamilton",
    "the sender's own clock, of any zero",
    of_body=False,
    written=lambda q: f"q = {components(q)}",
)
