"""The attitude of one structure at spacecraft clock ticks, as SPICE evaluates it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.errors import InputError
from hilstar.rotation import from_matrix, rate_between_rad_s
from hilstar.units import NS_PER_S

# J2000 is 2000-01-01T12:00:00 TDB; days of 86400 s since 1970-01-01T00:00:00 TDB.
J2000_S = 946_728_000
SAME_MATRIX = 1e-12  # ckgp and ckgpav turn a frame by two routes, a few roundings apart
FRAME = "J2000"  # SPICE's name of the axes of the ICRF


@dataclass(frozen=True)
class Structure:
    """A structure whose CK is loaded: `body` its id, `clock` that of its clock; `turning` where all its segments have rates."""

    path: Path
    spice: Any
    body: int
    turning: bool

    @cached_property
    def clock(self) -> int:
        """The id of the clock that counts its ticks."""
        return int(self.spice.ckmeta(self.body, "SCLK"))

    def t_s(self, tick: float) -> float:
        """Ephemeris time (TDB seconds past J2000)."""
        return float(self.spice.sct2e(self.clock, tick))

    def t_ns(self, tick: float) -> int:
        """TDB nanoseconds since 1970-01-01T00:00:00 TDB; a double of ephemeris time resolves 0.1 us."""
        seconds = self.t_s(tick)
        whole = int(seconds // 1)
        return (whole + J2000_S) * NS_PER_S + round((seconds - whole) * NS_PER_S)

    def matrix(self, tick: float) -> FloatArray:
        """The C-matrix (3, 3), which turns ICRS components into the structure's. Raises InputError where there is none."""
        matrix, _, found = self.spice.ckgp(self.body, tick, 0, FRAME)
        if not found:
            raise InputError(f"{self.path}: SPICE has no attitude of {self.body} at tick {tick:.17g}, which its segments cover")
        return np.asarray(matrix, dtype=np.float64)

    def q_icrs_to_body(self, tick: float) -> FloatArray:
        """The attitude (4,)."""
        return from_matrix(self.matrix(tick))

    def attitude(self, tick: float, with_rate: bool) -> tuple[FloatArray, FloatArray | None]:
        """The attitude (4,), and the angular velocity (3,), rad/s, in the structure's components, where its segment has one.

        SPICE gives the angular velocity in components of the reference frame, and passes over segments without one.
        """
        if not with_rate:
            return self.q_icrs_to_body(tick), None
        matrix, rate, _, found = self.spice.ckgpav(self.body, tick, 0, FRAME)
        if not (found and (self.turning or np.abs(matrix - self.matrix(tick)).max() < SAME_MATRIX)):
            return self.q_icrs_to_body(tick), None
        return from_matrix(matrix), matrix @ np.asarray(rate, dtype=np.float64)

    def rate_by_difference(self, tick: float, step: float, span: tuple[float, float]) -> FloatArray:
        """The rate (3,) at a tick of a smooth segment, from attitudes `step` ticks away on both sides within `span`.

        At an end of the span, from two on one side (second order: 2 r(h) - r(2 h)).
        """
        start, stop = span
        s_per_tick = (self.t_s(stop) - self.t_s(start)) / (stop - start)
        if start + step <= tick <= stop - step:
            return self._mean_rate(tick - step, tick + step, s_per_tick)
        away = step if tick < start + step else -step
        near, far = (self._mean_rate(min(tick, tick + n * away), max(tick, tick + n * away), s_per_tick) for n in (1, 2))
        return 2.0 * near - far

    def _mean_rate(self, before: float, after: float, s_per_tick: float) -> FloatArray:
        return rate_between_rad_s(self.q_icrs_to_body(before), self.q_icrs_to_body(after), (after - before) * s_per_tick)
