"""Places of many satellites at any time: SGP4 (Vallado et al. 2006, AIAA 2006-6753) seldom, cubics between.

SGP4 takes 0.5 us a satellite, 11 ms for 20 000: most of a frame. It is therefore asked at the ends of STEP_S only, for a share
of the list at a time, and between them places follow the cubic through both places and velocities. Low orbits are then within
0.25 m of SGP4 (0.05 arcsec at 1000 km), others within 3.2 m, nowhere more than 0.07 arcsec from the Earth's centre: measured
over three days. A cubic of exact velocities would be within 5 mm; SGP4's own are not quite the slopes of its places.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from hilstar.arrays import FloatArray, IntArray
from hilstar.sky.bodies.kernel import NS_PER_DAY, UNIX_JD
from hilstar.sky.bodies.orbit import TURN_NS, icrs_from_teme
from hilstar.units import NS_PER_S

if TYPE_CHECKING:
    from sgp4.api import Satrec

STEP_S = 20
STEP_NS = STEP_S * NS_PER_S
# So many at a time take 0.3 ms; the moments of a step at which a share's turn comes are spread over it.
SHARE = 512
# Coefficients of 1, s, s^2, s^3 of the cubic through place and velocity (times the step) at both ends
HERMITE = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [-3.0, -2.0, 3.0, -1.0], [2.0, 1.0, -2.0, 1.0]])


class Swarm:
    """Satellites by their elements; a moment's places depend on that moment alone."""

    def __init__(self, satrecs: Sequence[Satrec]) -> None:
        from sgp4.api import SatrecArray

        shares = [satrecs[k : k + SHARE] for k in range(0, len(satrecs), SHARE)]
        self._shares = [SatrecArray(list(share)) for share in shares]
        self._late_ns = np.arange(len(shares)) * (STEP_NS // len(shares))
        self._step = np.full(len(shares), np.iinfo(np.int64).min)
        self._terms = np.zeros((len(satrecs), 4, 3))
        self._begin_ns = np.zeros(len(satrecs), dtype=np.int64)
        self._ends: list[FloatArray | None] = [None] * len(shares)
        # SGP4's code for what is wrong with a satellite in its present step, 0 for nothing.
        self.error = np.zeros(len(satrecs), dtype=np.uint8)

    def __len__(self) -> int:
        return len(self.error)

    def move_to(self, utc_ns: int) -> bool:
        """Be ready for moments about a UTC, ns since 1970; whether any satellite is now in another step."""
        step = (utc_ns - self._late_ns) // STEP_NS
        due = np.flatnonzero(step != self._step)
        if not len(due):
            return False
        for k in due.tolist():
            part = slice(k * SHARE, min(len(self), (k + 1) * SHARE))
            begin_ns = int(step[k]) * STEP_NS + int(self._late_ns[k])
            self._load(k, part, begin_ns, follows=step[k] == self._step[k] + 1)
            self._begin_ns[part] = begin_ns
        self._step = step
        return True

    def _load(self, k: int, part: slice, begin_ns: int, follows: bool) -> None:
        last, error = self._ends[k], np.zeros(part.stop - part.start, dtype=np.uint8)
        if last is None or not follows:
            last, error = self._states(k, begin_ns)
        else:
            error = np.where(np.isnan(last[:, 0, 0]), self.error[part], 0).astype(np.uint8)
        end, end_error = self._states(k, begin_ns + STEP_NS)
        self._terms[part] = HERMITE @ np.concatenate([last, end], axis=1)
        self.error[part] = np.where(error, error, end_error)
        self._ends[k] = end

    def _states(self, k: int, utc_ns: int) -> tuple[FloatArray, FloatArray]:
        """Place, km, and velocity times the step, (n, 2, 3), ICRS axes, and errors (n,); NaN where there is one."""
        days, rest_ns = divmod(utc_ns, NS_PER_DAY)
        error, place_km, velocity_km_s = self._shares[k].sgp4(np.array([UNIX_JD + days]), np.array([rest_ns / NS_PER_DAY]))
        states = np.stack([place_km[:, 0], velocity_km_s[:, 0] * STEP_S], axis=1) @ icrs_from_teme(utc_ns // TURN_NS).T
        error = np.where(np.isfinite(states).all(axis=(1, 2)), error[:, 0], np.maximum(error[:, 0], 1))
        states[error != 0] = np.nan
        return states, error

    def places_km(self, which: IntArray | slice, utc_ns: int, seconds: FloatArray | float = 0.0) -> FloatArray:
        """Places (n, 3), km from the Earth's centre, ICRS axes, `seconds` (n,) after the UTC it was moved to; NaN for none."""
        s = ((utc_ns - self._begin_ns[which]) / NS_PER_S + seconds)[:, None] / STEP_S
        terms = self._terms[which]
        return np.asarray(terms[:, 0] + s * (terms[:, 1] + s * (terms[:, 2] + s * terms[:, 3])))

    def motion_km(self, which: IntArray, utc_ns: int) -> FloatArray:
        """Coefficients (4, n, 3) of 1, s, s^2 and s^3 of the same places, s in seconds after that UTC."""
        s = ((utc_ns - self._begin_ns[which]) / NS_PER_S)[:, None] / STEP_S
        a, b, c, d = np.moveaxis(self._terms[which], 1, 0)
        cubic = a + s * (b + s * (c + s * d)), b + s * (2 * c + s * 3 * d), c + s * 3 * d, d
        return np.stack([term / STEP_S**power for power, term in enumerate(cubic)])
