"""How a tracker's exposures beat with a screen's refresh: what a star's place and light cost by the phase between the two.

An exposure of n + f refreshes (f under 1) sees all of n frames or so, and of one at each end a part. Each frame has a star
right in the middle of its own light; a frame of which only a part is seen still counts there, and not where that part was.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.errors import InputError

ARCSEC_PER_DEG = 3600.0
# Closer to whole refreshes than this there is no beat: a screen's clock and a tracker's differ by more.
NO_BEAT = 1e-6
PHASES = 1024
EDGE = 1e-9  # refreshes: phases to either side of a jump
SHORTEST_LIT = 1e-6  # of a refresh, for a panel that flashes


@dataclass(frozen=True, slots=True)
class Exposures:
    """A tracker before a screen: refresh rate, exposure, how often it exposes, and how long a row stays lit in a refresh.

    `frame_hz` None: one exposure follows the other without a gap. `lit_s` None: the whole refresh; no longer than that counts.
    `triggered` exposures begin with a frame. Raises InputError for a refresh rate or frame rate that is none, and for an
    exposure or light that is negative or no number.
    """

    refresh_hz: float
    exposure_s: float
    frame_hz: float | None = None
    lit_s: float | None = None
    triggered: bool = False

    def __post_init__(self) -> None:
        for name, value, zero_is_wrong in (
            ("refresh_hz", self.refresh_hz, True),
            ("frame_hz", 1.0 if self.frame_hz is None else self.frame_hz, True),
            ("exposure_s", self.exposure_s, False),
            ("lit_s", 0.0 if self.lit_s is None else self.lit_s, False),
        ):
            if not math.isfinite(value) or value < 0 or (zero_is_wrong and not value):
                raise InputError(f"{name} = {value:g}: write a finite number{' above 0' if zero_is_wrong else ', 0 or more'}")

    @property
    def refreshes(self) -> float:
        """Refreshes in an exposure."""
        return self.refresh_hz * self.exposure_s

    @property
    def lit(self) -> float:
        """The part of a refresh for which a row stays lit."""
        return 1.0 if self.lit_s is None else min(max(self.lit_s * self.refresh_hz, SHORTEST_LIT), 1.0)


@dataclass(frozen=True, slots=True)
class Beat:
    """A beat: refreshes in an exposure, the period in which the errors repeat, and the largest errors.

    `period_s` is None where nothing beats, and where the tracker exposes at a whole part of the refresh rate: then its phase
    stands, until the clocks drift. `worst_arcsec_per_deg_s` is that of a star's place in a turn of 1 deg/s, None for an
    exposure of no length; `worst_mag` that of its light, infinite where an exposure may see none.
    """

    refreshes_per_exposure: float
    period_s: float | None
    worst_arcsec_per_deg_s: float | None
    worst_mag: float = 0.0


@dataclass(frozen=True, slots=True)
class SeenBeat:
    """What exposures see, by the phase at which each begins, (n,).

    `off_s`: the middle of the light seen after the middle of the exposure, NaN without any. `light`: relative to the mean.
    """

    off_s: FloatArray
    light: FloatArray


def seen_at(exposures: Exposures, phase: FloatArray) -> SeenBeat:
    """What is seen by an exposure that begins `phase` (n,) refreshes after a row lights, any number.

    The integrals of a row's light, and of its light times the middle of its frame, are closed forms of whole refreshes and a
    rest; an exposure is the difference of two. A star that turns at a rate is off by that rate times `off_s`.
    """
    begin = np.asarray(phase, dtype=np.float64) % 1.0
    length, lit = exposures.refreshes, exposures.lit
    (light, moment), (light_0, moment_0) = _integrals(begin + length, lit), _integrals(begin, lit)
    light = light - light_0
    with np.errstate(divide="ignore", invalid="ignore"):
        middle = np.where(light > EDGE * lit, (moment - moment_0) / light, np.nan)
        relative = light / (length * lit)
    return SeenBeat((middle - begin - length / 2) / exposures.refresh_hz, relative)


def _integrals(time: FloatArray, lit: float) -> tuple[FloatArray, FloatArray]:
    """Of a row's light up to a time (n,) in refreshes, and of that times the middle of its frame's light."""
    whole = np.floor(time)
    part = np.minimum(time - whole, lit)
    return whole * lit + part, lit * whole * (whole - 1 + lit) / 2 + part * (whole + lit / 2)


def beat(exposures: Exposures) -> Beat:
    """The beat of a screen's refresh and a tracker's exposures.

    While rows stay lit for the whole refresh a star is off by at most f (1 - f) / 2 of one refresh's path, divided by n + f,
    and whole refreshes cure it. Where they flash it is off by up to half of the dark, however long the exposure is: no exposure
    cures that.
    """
    length = exposures.refreshes
    if length <= 0:
        return Beat(length, None, None)
    if exposures.triggered:
        return Beat(length, None, 0.0)
    seen = seen_at(exposures, _phases(exposures))
    arcsec = float(np.nanmax(np.abs(seen.off_s))) * ARCSEC_PER_DEG
    dim, bright = float(seen.light.min()), float(seen.light.max())
    mag = math.inf if dim <= 0 else 2.5 * max(math.log10(bright), -math.log10(dim))
    if abs(length - round(length)) < NO_BEAT and exposures.lit == 1.0:
        return Beat(length, None, 0.0)
    return Beat(length, _period_s(exposures), arcsec, mag)


def _phases(exposures: Exposures) -> FloatArray:
    """Phases all over a refresh, and to either side of those at which an exposure begins or ends with a row's light."""
    length, lit = exposures.refreshes, exposures.lit
    edges = np.array([0.0, lit, -length, lit - length])
    return np.concatenate([np.arange(PHASES) / PHASES, *(edges + side for side in (-EDGE, 0.0, EDGE))])


def _period_s(exposures: Exposures) -> float | None:
    """After how long exposures begin at the same phase again; None where each begins at that of the one before.

    The refresh as the tracker's frames sample it: the difference from the nearest multiple of their rate.
    """
    frame_hz = 1 / exposures.exposure_s if exposures.frame_hz is None else exposures.frame_hz
    rest = exposures.refresh_hz / frame_hz
    rest -= round(rest)
    return None if abs(rest) < NO_BEAT else 1 / (abs(rest) * frame_hz)
