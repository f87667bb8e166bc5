"""The Earth from an orbit: where its disc is seen, and the radiance that its magnitude from afar
gives its ground.

Mallama and Hilton's magnitude is that of the whole globe from afar. It is taken as a Lambert
sphere's whose ground is as bright as that needs at each phase; near, the same ground is seen, and
what is in view adds up to another sum. There are no clouds, seas, city lights, moonlight or
airglow.
"""

import math

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.units import KM_PER_AU, LIGHT_KM_S, flux_ratio
from hilstar.sky.bodies.disc import Air, Disc
from hilstar.sky.bodies.light import EARTH_CURVE_DEG, body_v_mag, phase_angle_deg
from hilstar.sky.bodies.shapes import EARTH, EQUATOR_KM, MEAN_KM, POLAR_KM

LOWEST_KM = 1.0  # an orbit below the ground is seen from here
AT_CENTRE_KM = 1000.0  # an observer so near the centre has no place of its own: no Earth is seen
DARK_V_MAG = 40.0  # where nothing in view is lit
# Molecules alone: the scale height of the US Standard Atmosphere 1976 over its lowest 20 km (7.3 to
# 8.4 km), and the depth that Bodhaine et al. 1999 (J. Atmos. Oceanic Technol. 16, 1854) have at 550
# nm. Dust is lower than rays that get through.
AIR = Air(scale_km=8.0, depth=0.097)


def at_centre(place_km: FloatArray) -> bool:
    """Whether a place (3,) about the Earth's centre is that of an observer who is there."""
    return float(np.linalg.norm(place_km)) < AT_CENTRE_KM


def apparent_cone(seen_km: FloatArray, velocity_km_s: FloatArray) -> tuple[FloatArray, float]:
    """The unit vector (3,) to the middle of the Earth's disc as seen, and the distance, km, at
    which it is as wide.

    `seen_km` (3,) is the vector to its centre and the velocity (3,) that about it: the Earth's own
    drops out of light time and aberration. Every direction of the limb is aberrated by itself,
    which keeps it a circle (Penrose 1959) about another middle.
    """
    distance_km = max(float(np.linalg.norm(seen_km)), EQUATOR_KM + LOWEST_KM)
    towards = seen_km / float(np.linalg.norm(seen_km))
    radius_rad = math.asin(EQUATOR_KM / distance_km)
    beta = velocity_km_s / LIGHT_KM_S
    along = float(beta @ towards)
    middle = towards + math.cos(radius_rad) * (beta - along * towards)
    direction = middle / np.linalg.norm(middle)
    apparent_radius_rad = radius_rad - along * math.sin(radius_rad)
    return direction, EQUATOR_KM / math.sin(apparent_radius_rad)


def earth_disc(
    seen_km: FloatArray, from_sun_km: FloatArray, velocity_km_s: FloatArray, v0_e_per_s: float
) -> Disc:
    """The Earth's disc: `seen_km` and `velocity_km_s` as of `apparent_cone`, and the vector (3,)
    from the Sun to the Earth.

    A V of 0 gives `v0_e_per_s` electrons.
    """
    direction, distance_km = apparent_cone(seen_km, velocity_km_s)
    sun_km = float(np.linalg.norm(from_sun_km))
    phase_deg = phase_angle_deg(from_sun_km, seen_km)
    return Disc(
        name=EARTH,
        direction=direction,
        distance_km=distance_km,
        equator_km=EQUATOR_KM,
        polar_km=POLAR_KM,
        pole=np.array([0.0, 0.0, 1.0]),  # 0.15 degrees from the pole of 2026: 0.1 km of the limb
        sun=-from_sun_km / sun_km,
        law="lambert",
        normal_e_per_s_sr=_normal(sun_km, phase_deg, v0_e_per_s),
        air=AIR,
    )


def earth_light(disc: Disc, v0_e_per_s: float) -> tuple[float, float]:
    """V and electrons per second of all that is seen of the Earth's ground."""
    rate = disc.normal_e_per_s_sr * disc.law_integral_sr()
    dark = v0_e_per_s * flux_ratio(DARK_V_MAG)
    v_mag = -2.5 * math.log10(max(rate, dark) / v0_e_per_s)
    return v_mag, rate


def _normal(sun_km: float, phase_deg: float, v0_e_per_s: float) -> float:
    """The ground's radiance under the Sun at the zenith, electrons per second and steradian."""
    phase_deg = min(phase_deg, EARTH_CURVE_DEG)
    phase = math.radians(phase_deg)
    # From 1 au, where a Lambert sphere's integral over its disc is a closed form
    far_km = KM_PER_AU * np.array([math.cos(phase), math.sin(phase), 0.0])
    from_sun_km = np.array([sun_km, 0.0, 0.0])
    v_mag = body_v_mag(EARTH, from_sun_km, far_km, 2000.0)
    rate = v0_e_per_s * flux_ratio(v_mag)
    lambert = math.sin(phase) + (math.pi - phase) * math.cos(phase)
    return rate / (2 / 3 * (MEAN_KM / KM_PER_AU) ** 2 * lambert)
