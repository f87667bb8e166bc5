"""Sizes, flattening, poles and laws of the light of Sun, Moon, Earth and planets."""

import math

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.rotation import direction_of
from hilstar.sky.bodies.disc import Law

# The Moon by phase, degrees: McEwen 1996, Lunar Planet. Sci. 27, 841; clipped to 0 and 1 beyond the
# fitted range.
LUNAR_SHARE = (1.0, -0.019, 2.42e-4, -1.46e-6)
EARTH = "Earth"
EQUATOR_KM, POLAR_KM = 6378.1366, 6356.7519  # IERS Conventions 2010, table 1.1
MEAN_KM = math.sqrt(EQUATOR_KM * POLAR_KM)  # mean radius of the outline seen from the equator
# Equatorial, Archinal et al. 2018 and, the Sun's, IAU 2015 Resolution B3
RADII_KM = {
    "Sun": 695_700.0,
    "Moon": 1737.4,
    "Mercury": 2440.53,
    "Venus": 6051.8,
    "Mars": 3396.19,
    "Jupiter": 71_492.0,
    "Saturn": 60_268.0,
    "Uranus": 25_559.0,
    "Neptune": 24_764.0,
    EARTH: EQUATOR_KM,
}
# Polar, and poles (right ascension and declination, degrees), of those that are flat enough to see:
# the same source
POLAR_RADII_KM = {"Jupiter": 66_854.0, "Saturn": 54_364.0, "Uranus": 24_973.0, "Neptune": 24_341.0}
POLES_DEG = {
    "Jupiter": (268.057, 64.495),
    "Saturn": (40.589, 83.537),
    "Uranus": (257.311, -15.175),
    "Neptune": (299.36, 43.46),
}
LAWS: dict[str, Law] = {"Sun": "limb-darkened", "Moon": "lunar-lambert"}  # planets: lambert
NORTH = np.array([0.0, 0.0, 1.0])


def lunar_share(phase_deg: float) -> float:
    """The Moon's share of Lommel-Seeliger's law at a phase angle."""
    return float(np.clip(np.polynomial.polynomial.polyval(phase_deg, LUNAR_SHARE), 0.0, 1.0))


def pole(name: str) -> FloatArray:
    """The unit vector (3,) of a body's north pole, ICRS axes; the ICRS's own of one that is
    round.
    """
    if name not in POLES_DEG:
        return NORTH
    return direction_of(*POLES_DEG[name])
