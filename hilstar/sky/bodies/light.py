"""V magnitudes of Sun, Moon, Earth and planets, by distances and phase, for an observer near the
Earth.

Planets: Mallama and Hilton 2018 (Astron. Comput. 25, 10; arXiv:1808.01973), equations 2, 3, 4, 6,
8, 10, 14 and 16. Of Mars the terms of longitude and season are left out: 0.035 mag rms, 0.06 at
most. Saturn is globe and rings.

Moon: -12.73 + 0.026 phase + 4e-9 phase^4 at its mean distance (Allen 1973; Krisciunas and Schaefer
1991, PASP 103, 1033,
eq. 9). The ROLO model (Kieffer and Stone 2005) is within 0.08 mag of it from 6 to 97 degrees and
0.16 mag brighter at 2: the opposition surge is left out. Beyond 150 degrees as the cube of the
angle left to 180 (Russell 1916, ApJ 43, 103), without earthshine; Allen's table is within 0.1 mag
of both up to 150 degrees, and 0.25 fainter at 160.

Earth: Mallama and Hilton's curve, which was made for the whole globe from afar and is held to 170
degrees.

Electron rates of bodies: sunlight times their albedo, through the tracker's curves as a star's
spectrum is.

Planets: geometric albedos of Mallama, Krobusek and Pavlov 2017 (Icarus 282, 19; table 7):
Johnson-Cousins U, B, V, Rc, Ic and Sloan z'. The paper's Sloan albedos u' to z' alone, measured
apart, give rates within 0.05 mag; a star of the same B-V would be
0.2 mag off for Jupiter and 0.5 for Uranus, whose methane takes the red. The Moon: the ROLO model's
reflectance at 45 degrees of phase (Kieffer and Stone 2005, AJ 129, 2887, table 4); at 10 and 90
degrees its rate at equal V is within 4 %. Straight lines between the bands, constant beyond them.
Sunlight: G2V of the library.
"""

import numpy as np
from numpy.polynomial.polynomial import polyval

from hilstar.basics.arrays import FloatArray
from hilstar.basics.rotation import direction_of
from hilstar.basics.units import KM_PER_AU, magnitude
from hilstar.sky import electrons
from hilstar.sky.spectrum import load_curve

SUN_V_MAG = -26.76  # at 1 au: Willmer 2018, ApJS 236, 47
SUN_BV_MAG = 0.653  # the same source

# eq. 2
MERCURY = (-0.613, 6.3280e-02, -1.6336e-03, 3.3644e-05, -3.4265e-07, 1.6893e-09, -3.0334e-12)
VENUS = (-4.384, -1.044e-03, 3.687e-04, -2.814e-06, 8.938e-09)  # eq. 3
VENUS_CRESCENT = (236.05828, -2.81914, 8.39034e-03)  # eq. 4
VENUS_CRESCENT_DEG = 163.7
MARS = (-1.601, 2.267e-02, -1.302e-04)  # eq. 6
JUPITER = (-9.395, -3.7e-04, 6.16e-04)  # eq. 8
URANUS_MAG, URANUS_PER_DEG = -7.110, -8.4e-04  # eq. 14
# Poles of the IAU's working group (Archinal et al. 2018): right ascension and declination, degrees
SATURN_POLE_DEG, URANUS_POLE_DEG = (40.589, 83.537), (257.311, -15.175)

EARTH_TERMS = (-3.99, -1.060e-3, 2.054e-4)  # eq. 5
EARTH_CURVE_DEG = 170.0
FULL_MOON_V_MAG, MOON_PER_DEG, MOON_PER_DEG4 = -12.73, 0.026, 4e-9
MOON_DISTANCE_KM = 384_400.0
# nearer to new moon than 0.3 deg the magnitude is that at 0.3
MOON_CRESCENT_DEG, THINNEST_DEG = 150.0, 0.3
SUNLIGHT = "G2V"
# U B V Rc Ic (Bessell 1998, table A2) and z' (Fukugita et al. 1996)
BANDS_NM = (366.0, 438.0, 545.0, 641.0, 798.0, 913.0)
ALBEDOS: dict[str, tuple[float, ...]] = {
    "Mercury": (0.087, 0.105, 0.142, 0.158, 0.180, 0.237),
    "Venus": (0.348, 0.658, 0.689, 0.658, 0.640, 0.630),
    # from memory, without a source at hand; U and z' are estimates
    "Earth": (0.60, 0.512, 0.434, 0.392, 0.396, 0.40),
    "Mars": (0.060, 0.088, 0.170, 0.250, 0.285, 0.325),
    "Jupiter": (0.358, 0.443, 0.538, 0.513, 0.389, 0.348),
    "Saturn": (0.203, 0.339, 0.499, 0.646, 0.543, 0.450),
    "Uranus": (0.502, 0.561, 0.488, 0.264, 0.089, 0.056),
    "Neptune": (0.578, 0.562, 0.442, 0.226, 0.072, 0.048),
}
MOON_NM = (350.0, 405.0, 441.6, 486.9, 549.1, 665.1, 745.3, 774.8, 865.3, 928.4, 1059.5)
MOON_ALBEDO = (
    0.0205,
    0.0283,
    0.0290,
    0.0325,
    0.0380,
    0.0480,
    0.0499,
    0.0531,
    0.0563,
    0.0560,
    0.0634,
)
B_NM, V_NM = 438.0, 545.0
_POLES = {"Saturn": direction_of(*SATURN_POLE_DEG), "Uranus": direction_of(*URANUS_POLE_DEG)}


def body_v_mag(
    name: str, sun_to_body_km: FloatArray, observer_to_body_km: FloatArray, jyear: float
) -> float:
    """V of a body by the vectors (3,) to it from the Sun and from the observer, ICRS axes; the
    Sun's by the second alone.
    """
    distance_au = float(np.linalg.norm(observer_to_body_km)) / KM_PER_AU
    if name == "Sun":
        return SUN_V_MAG + 5 * float(np.log10(distance_au))
    sun_au = float(np.linalg.norm(sun_to_body_km)) / KM_PER_AU
    phase_deg = phase_angle_deg(sun_to_body_km, observer_to_body_km)
    if name == "Moon":
        return moon_v_mag(sun_au, distance_au * KM_PER_AU, phase_deg)
    if name in _POLES:
        sun_deg = latitude_deg(_POLES[name], sun_to_body_km)
        observer_deg = latitude_deg(_POLES[name], observer_to_body_km)
    # globe and rings (eq. 10); rings that are lit from the other side do not count
    if name == "Saturn":
        ring_deg = np.sqrt(max(0.0, sun_deg * observer_deg))
        sine = float(np.sin(np.radians(ring_deg)))
        opposition_mag = 0.378 * sine * float(np.exp(-2.25 * phase_deg))
        mag = -8.914 - 1.825 * sine + 0.026 * phase_deg - opposition_mag
    elif name == "Uranus":
        mean_deg = (abs(sun_deg) + abs(observer_deg)) / 2
        mag = URANUS_MAG + URANUS_PER_DEG * mean_deg
    elif name == "Neptune":  # eq. 16: it brightened from 1980 to 2000
        mag = float(np.clip(-6.89 - 0.0054 * (jyear - 1980.0), -7.00, -6.89))
    elif name == "Earth":
        mag = float(polyval(min(phase_deg, EARTH_CURVE_DEG), EARTH_TERMS))
    else:
        curves = {"Mercury": MERCURY, "Venus": VENUS, "Mars": MARS, "Jupiter": JUPITER}
        terms = curves[name]
        if name == "Venus" and phase_deg >= VENUS_CRESCENT_DEG:
            terms = VENUS_CRESCENT
        mag = float(polyval(phase_deg, terms))
    return mag + 5 * float(np.log10(sun_au * distance_au))


def phase_angle_deg(sun_to_body: FloatArray, observer_to_body: FloatArray) -> float:
    """The angle at a body between Sun and observer, degrees."""
    cross = np.linalg.norm(np.cross(sun_to_body, observer_to_body))
    return float(np.degrees(np.arctan2(cross, sun_to_body @ observer_to_body)))


def moon_v_mag(sun_au: float, distance_km: float, phase_deg: float) -> float:
    """V of the Moon."""
    plain_deg = min(phase_deg, MOON_CRESCENT_DEG)
    curve = MOON_PER_DEG * plain_deg + MOON_PER_DEG4 * plain_deg**4
    crescent_deg = max(180.0 - phase_deg, THINNEST_DEG)
    thinner_mag = float(np.log10((180.0 - MOON_CRESCENT_DEG) / crescent_deg))
    curve += 7.5 * max(0.0, thinner_mag)
    by_distance_mag = 5 * float(np.log10(sun_au * distance_km / MOON_DISTANCE_KM))
    return FULL_MOON_V_MAG + curve + by_distance_mag


def latitude_deg(pole: FloatArray, towards_body: FloatArray) -> float:
    """The planetocentric latitude below the far end of a vector to the body, degrees."""
    sine = -pole @ towards_body / np.linalg.norm(towards_body)
    return float(np.degrees(np.arcsin(np.clip(sine, -1, 1))))


def bodies_electrons_per_s(
    names: tuple[str, ...],
    model: electrons.BrightnessModel,
    optics: electrons.Optics,
    photometry: electrons.Photometry,
) -> FloatArray:
    """Electron rates of bodies of V = 0, shape (n,). Raises InputError as `tabulate_pickles`
    does.
    """
    if model == "ags":
        return np.full(len(names), electrons.ags_electrons_per_s(optics, photometry))
    return electrons.library_electrons_per_s(reflected(names), optics, photometry)


def reflected(names: tuple[str, ...]) -> electrons.Library:
    """The spectra of bodies, as a library of their own."""
    stars = electrons.load_library()
    sunlight = stars.flux[stars.spectral_type.index(SUNLIGHT)]
    lit = [sunlight * albedo(name, stars.wavelength_nm) for name in names]
    flux = np.array(lit).reshape(len(names), len(stars.wavelength_nm))  # also without bodies
    colour = bodies_bv_mag(names)
    nm = stars.wavelength_nm
    unknown_mag = np.full(len(names), np.nan)
    unscaled = electrons.Library(nm, flux, names, colour, unknown_mag)
    mean = electrons.band_mean(unscaled, load_curve("johnson-v", "johnson-v"))
    return electrons.Library(nm, flux / mean[:, None], names, colour, unknown_mag)


def bodies_bv_mag(names: tuple[str, ...]) -> FloatArray:
    """B-V of bodies (n,), by the Sun's and their albedos."""
    bands_nm = np.array([B_NM, V_NM])
    albedos = np.array([albedo(name, bands_nm) for name in names]).reshape(-1, 2)
    blue, visual = albedos.T
    return np.asarray(SUN_BV_MAG + magnitude(blue / visual))


def albedo(name: str, wavelength_nm: FloatArray) -> FloatArray:
    """A body's albedo at wavelengths (n,), the Moon's at 45 degrees of phase; 1 for the Sun."""
    if name == "Sun":
        return np.ones_like(wavelength_nm)
    if name == "Moon":
        return np.interp(wavelength_nm, MOON_NM, MOON_ALBEDO)
    return np.interp(wavelength_nm, BANDS_NM, ALBEDOS[name])
