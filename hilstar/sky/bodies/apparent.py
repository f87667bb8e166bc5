"""Where the sky is seen from near the Earth: parallax, light bent by the Sun, aberration."""

from __future__ import annotations

from dataclasses import dataclass

import erfa
import numpy as np

from hilstar.arrays import FloatArray
from hilstar.sky.astrometry import aberrate
from hilstar.sky.bodies.magnitudes import KM_PER_AU

SUN_MASSES = 1.0
MAS_PER_DEG = 3_600_000.0
# ERFA's own at 1 au (`ldsun`), 4 arcmin from the Sun's centre: within its disc the formula has no meaning.
DEFLECTION_LIMIT = 1e-6


@dataclass(frozen=True, slots=True)
class Viewpoint:
    """An observer: place and velocity about the barycentre, km and km/s, and the vector from the Sun to it, km; ICRS axes."""

    place_km: FloatArray
    velocity_km_s: FloatArray
    from_sun_km: FloatArray


def apparent_bodies(seen_km: FloatArray, view: Viewpoint) -> FloatArray:
    """Unit vectors (n, 3) of the Sun and other bodies at vectors `seen_km` (n, 3) from the observer, light time included.

    The Sun bends the light of the others: Klioner 2003, AJ 125, 1580, by ERFA's `ld`. The bending by planets, 0.02 arcsec
    beside Jupiter's limb, is left out.
    """
    directions = _unit(seen_km)
    distance_km = float(np.linalg.norm(view.from_sun_km))
    outward = view.from_sun_km / distance_km
    from_sun = _unit(seen_km[1:] + view.from_sun_km)
    directions[1:] = erfa.ld(SUN_MASSES, directions[1:], from_sun, outward, distance_km / KM_PER_AU, DEFLECTION_LIMIT)
    return aberrate(directions, view.velocity_km_s)


def apparent_stars(directions: FloatArray, parallax_mas: FloatArray, view: Viewpoint) -> FloatArray:
    """Unit vectors (n, 3) of stars in directions (n, 3) from the barycentre; a parallax of NaN or below 0 counts as 0."""
    shift_rad = np.radians(np.fmax(parallax_mas, 0.0) / MAS_PER_DEG)
    directions = _unit(directions - shift_rad[:, None] * (view.place_km / KM_PER_AU))
    distance_km = float(np.linalg.norm(view.from_sun_km))
    bent = erfa.ldsun(directions, view.from_sun_km / distance_km, distance_km / KM_PER_AU)
    return aberrate(_unit(bent), view.velocity_km_s)


def _unit(vectors: FloatArray) -> FloatArray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))
