"""How bright a satellite is: a diffuse sphere in sunlight, in and out of the Earth's shadow, and its flashes.

A standard magnitude is V at 1000 km and 90 degrees of phase, in full sunlight at 1 au (McCants, Heavens-Above). A diffuse
sphere's light goes with sin p + (pi - p) cos p of the phase angle p (Lambert; Hejduk 2011, AMOS Conference, eq. 2), which is 1
there, and with the square of the distance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hilstar.arrays import FloatArray, IntArray
from hilstar.units import flux_ratio

STANDARD_KM = 1000.0
SUN_KM, KM_PER_AU = 695_700.0, 149_597_870.7
EARTH_KM, EARTH_FLATTENING = 6378.137, 1 / 298.257  # IERS Conventions 2010
MAX_PHASE_FACTOR = np.pi  # at full phase
FWHM_SIGMAS = 2 * float(np.sqrt(2 * np.log(2)))
NEIGHBOURS = np.arange(-3, 4)  # a flash lasts at most half a period: 3 periods are 14 sigmas
SHORTEST_S = 1e-6  # a mean over less is the light of a moment


@dataclass(frozen=True, slots=True, eq=False)
class Brightness:
    """What is known of n satellites, (n,) each: see `table`. `standard_e_per_s` are electron rates at the standard magnitude.

    Without `period_s` (NaN) a satellite's light is steady; with `flash_s` (else NaN) it flashes, otherwise it goes up and down.
    """

    standard_e_per_s: FloatArray
    period_s: FloatArray
    amplitude_mag: FloatArray
    flash_s: FloatArray
    flash_at_s: FloatArray
    size_m: FloatArray

    def most(self, which: IntArray) -> FloatArray:
        """The largest factor by which each of these is ever brighter than its mean (in a flash: than without)."""
        ratio = flux_ratio(-self.amplitude_mag[which])
        varied = np.where(np.isnan(self.flash_s[which]), 2 * ratio / (ratio + 1), ratio)
        return np.where(np.isnan(self.period_s[which]), 1.0, varied)

    def variation(self, which: IntArray, begin_s: FloatArray, end_s: FloatArray) -> FloatArray:
        """The mean factor of each of these (n,) between two times, seconds after `epoch_utc`, in closed form.

        Up and down: a cosine of the flux whose extremes are `amplitude_mag` apart, with a mean of 1. Flashes: Gaussian ones of
        `flash_s` at half height, `amplitude_mag` brighter at their top. A maximum is at `flash_at_s`.
        """
        factor = np.ones(len(which))
        steady = np.isnan(self.period_s[which])
        if steady.all():
            return factor
        end_s = np.maximum(end_s, begin_s + SHORTEST_S)
        flashing = ~np.isnan(self.flash_s[which]) & ~steady
        for chosen, mean in ((~flashing & ~steady, self._waved), (flashing, self._flashed)):
            factor[chosen] = mean(which[chosen], begin_s[chosen], end_s[chosen])
        return factor

    def _waved(self, which: IntArray, begin_s: FloatArray, end_s: FloatArray) -> FloatArray:
        ratio, per_s = flux_ratio(-self.amplitude_mag[which]), 1 / self.period_s[which]
        middle = ((begin_s + end_s) / 2 - self.flash_at_s[which]) * per_s
        depth = (ratio - 1) / (ratio + 1)
        return np.asarray(1 + depth * np.cos(2 * np.pi * middle) * np.sinc((end_s - begin_s) * per_s))

    def _flashed(self, which: IntArray, begin_s: FloatArray, end_s: FloatArray) -> FloatArray:
        from scipy.special import ndtr  # 0.1 s, which only flashes need

        period_s, sigma_s = self.period_s[which], self.flash_s[which] / FWHM_SIGMAS
        # The light of all flashes up to each end, in flashes: whole periods, and those near that have not ended
        until = []
        for seconds in (begin_s, end_s):
            turn = np.floor((seconds - self.flash_at_s[which]) / period_s)
            rest_s = seconds - self.flash_at_s[which] - turn * period_s
            near = ndtr((rest_s[:, None] - NEIGHBOURS * period_s[:, None]) / sigma_s[:, None]).sum(axis=1)
            until.append((turn, near))
        (turn, near), (last_turn, last_near) = until
        flashes = (last_turn - turn) + (last_near - near)
        extra = flux_ratio(-self.amplitude_mag[which]) - 1
        return np.asarray(1 + extra * flashes * sigma_s * np.sqrt(2 * np.pi) / (end_s - begin_s))


def reflected_share(from_observer_km: FloatArray, place_km: FloatArray, sun_km: FloatArray) -> FloatArray:
    """Flux over that of the standard magnitude (n,), of satellites at vectors from the observer and from the Earth (n, 3).

    The Sun stands at a vector (3,) from the Earth; the Earth's shadow is in it.
    """
    distance_au = float(np.linalg.norm(sun_km)) / KM_PER_AU
    to_sun = sun_km / np.linalg.norm(sun_km)  # from any satellite of the Earth within 1 arcmin
    range_km = np.linalg.norm(from_observer_km, axis=1)
    diffuse = phase_factor(np.clip(-(from_observer_km @ to_sun) / range_km, -1.0, 1.0))
    return np.asarray((STANDARD_KM / range_km) ** 2 / distance_au**2 * diffuse * sunlit_share(place_km, sun_km))


def phase_factor(cos_phase: FloatArray) -> FloatArray:
    """The light of a diffuse sphere over that at 90 degrees of phase (n,), by the cosines of its phase angles."""
    return np.asarray(np.sqrt(1 - cos_phase**2) + (np.pi - np.arccos(cos_phase)) * cos_phase)


def sunlit_share(place_km: FloatArray, sun_km: FloatArray) -> FloatArray:
    """The share (n,) of the Sun's disc that the Earth leaves free, seen from places (n, 3) about the Earth; without its air.

    The area of two overlapping circles, in space stretched along the Earth's axis so that it is a sphere.
    """
    place, sun = _stretched(place_km), _stretched(sun_km)
    distance = np.linalg.norm(place, axis=1)
    to_sun = sun - place
    far = np.linalg.norm(to_sun, axis=1)
    earth = np.arcsin(np.minimum(1.0, EARTH_KM / distance))
    disc = np.arcsin(SUN_KM / far)
    apart = np.arccos(np.clip(-np.einsum("ij,ij->i", place, to_sun) / (distance * far), -1.0, 1.0))
    within = np.abs(earth - disc)
    share = np.where(apart <= within, np.maximum(0.0, 1 - (earth / disc) ** 2), 1.0)
    partly = np.flatnonzero((apart > within) & (apart < earth + disc))
    if len(partly):
        share[partly] = 1 - _overlap(earth[partly], disc[partly], apart[partly]) / (np.pi * disc[partly] ** 2)
    return share


def _overlap(a: FloatArray, b: FloatArray, apart: FloatArray) -> FloatArray:
    """The area that circles of radii a and b share, on a plane."""
    from_a = (apart**2 + a**2 - b**2) / (2 * apart)
    in_a, in_b = (np.arccos(np.clip(x / r, -1.0, 1.0)) for x, r in ((from_a, a), (apart - from_a, b)))
    return np.asarray(a**2 * (in_a - np.sin(2 * in_a) / 2) + b**2 * (in_b - np.sin(2 * in_b) / 2))


def in_front(observer_km: FloatArray, place_km: FloatArray, depth_km: float = 0.0) -> FloatArray:
    """0 (n,) for places (n, 3) that the Earth hides from observers (n, 3), else 1; an observer inside it sees all.

    What is seen through less than `depth_km` of it counts as seen.
    """
    observer, place = _stretched(observer_km), _stretched(place_km)
    way = place - observer
    share = np.clip(-np.einsum("ij,ij->i", observer, way) / np.einsum("ij,ij->i", way, way), 0.0, 1.0)
    closest = np.linalg.norm(observer + share[:, None] * way, axis=1)
    inside = np.linalg.norm(observer, axis=1) < EARTH_KM
    return np.where((closest < EARTH_KM - depth_km) & ~inside, 0.0, 1.0)


def _stretched(vectors_km: FloatArray) -> FloatArray:
    """Vectors in axes in which the Earth is a sphere of its equatorial radius; its axis is ICRS z within 0.2 degrees."""
    return np.asarray(vectors_km * np.array([1.0, 1.0, 1 / (1 - EARTH_FLATTENING)]))
