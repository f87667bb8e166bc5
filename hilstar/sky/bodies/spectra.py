"""Electron rates of bodies: sunlight times their albedo, through the tracker's curves as a star's spectrum is.

Planets: geometric albedos of Mallama, Krobusek and Pavlov 2017 (Icarus 282, 19; table 7): Johnson-Cousins U, B, V, Rc, Ic and
Sloan z'. The paper's Sloan albedos u' to z' alone, measured apart, give rates within 0.05 mag; a star of the same B-V would be
0.2 mag off for Jupiter and 0.5 for Uranus, whose methane takes the red. The Moon: the ROLO model's reflectance at 45 degrees of
phase (Kieffer and Stone 2005, AJ 129, 2887, table 4); at 10 and 90 degrees its rate at equal V is within 4 %. Straight lines
between the bands, constant beyond them. Sunlight: G2V of the library.
"""

from __future__ import annotations

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.sky.bodies.magnitudes import SUN_BV_MAG
from hilstar.sky.electrons import BrightnessModel, Optics, Photometry, ags_electrons_per_s
from hilstar.sky.pickles import Library, band_mean, library_electrons_per_s, load_library
from hilstar.sky.spectrum import load_curve
from hilstar.units import magnitude

SUNLIGHT = "G2V"
BANDS_NM = (366.0, 438.0, 545.0, 641.0, 798.0, 913.0)  # U B V Rc Ic (Bessell 1998, table A2) and z' (Fukugita et al. 1996)
ALBEDOS: dict[str, tuple[float, ...]] = {
    "Mercury": (0.087, 0.105, 0.142, 0.158, 0.180, 0.237),
    "Venus": (0.348, 0.658, 0.689, 0.658, 0.640, 0.630),
    "Earth": (0.60, 0.512, 0.434, 0.392, 0.396, 0.40),  # as recalled; U and z' are no more than likely
    "Mars": (0.060, 0.088, 0.170, 0.250, 0.285, 0.325),
    "Jupiter": (0.358, 0.443, 0.538, 0.513, 0.389, 0.348),
    "Saturn": (0.203, 0.339, 0.499, 0.646, 0.543, 0.450),
    "Uranus": (0.502, 0.561, 0.488, 0.264, 0.089, 0.056),
    "Neptune": (0.578, 0.562, 0.442, 0.226, 0.072, 0.048),
}
MOON_NM = (350.0, 405.0, 441.6, 486.9, 549.1, 665.1, 745.3, 774.8, 865.3, 928.4, 1059.5)
MOON_ALBEDO = (0.0205, 0.0283, 0.0290, 0.0325, 0.0380, 0.0480, 0.0499, 0.0531, 0.0563, 0.0560, 0.0634)
B_NM, V_NM = 438.0, 545.0


def bodies_electrons_per_s(
    names: tuple[str, ...], model: BrightnessModel, optics: Optics, photometry: Photometry
) -> FloatArray:
    """Electron rates of bodies of V = 0, shape (n,). Raises InputError as `tabulate_pickles` does."""
    if model == "ags":
        return np.full(len(names), ags_electrons_per_s(optics, photometry))
    return library_electrons_per_s(reflected(names), optics, photometry)


def reflected(names: tuple[str, ...]) -> Library:
    """The spectra of bodies, as a library of their own."""
    stars = load_library()
    sunlight = stars.flux[stars.spectral_type.index(SUNLIGHT)]
    lit = [sunlight * albedo(name, stars.wavelength_nm) for name in names]
    flux = np.array(lit).reshape(len(names), len(stars.wavelength_nm))  # of no bodies too
    colour = bodies_bv_mag(names)
    unscaled = Library(stars.wavelength_nm, flux, names, colour, np.full(len(names), np.nan))
    mean = band_mean(unscaled, load_curve("johnson-v", "johnson-v"))
    return Library(stars.wavelength_nm, flux / mean[:, None], names, colour, unscaled.vi_mag)


def bodies_bv_mag(names: tuple[str, ...]) -> FloatArray:
    """B-V of bodies (n,), by the Sun's and their albedos."""
    blue, visual = (np.array([albedo(name, np.array([nm]))[0] for name in names]) for nm in (B_NM, V_NM))
    return np.asarray(SUN_BV_MAG + magnitude(blue / visual))


def albedo(name: str, wavelength_nm: FloatArray) -> FloatArray:
    """A body's albedo at wavelengths (n,), the Moon's at 45 degrees of phase; 1 for the Sun."""
    if name == "Sun":
        return np.ones_like(wavelength_nm)
    if name == "Moon":
        return np.interp(wavelength_nm, MOON_NM, MOON_ALBEDO)
    return np.interp(wavelength_nm, BANDS_NM, ALBEDOS[name])
