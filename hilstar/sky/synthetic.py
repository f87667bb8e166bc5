"""Synthetic magnitudes: a star's spectrum through UBVRI, Gaia's G and all wavelengths, and a
tracker's own zero points.
"""

from collections.abc import Callable
from typing import Literal

import numpy as np
from numpy.polynomial import Chebyshev

from hilstar.basics.arrays import FloatArray
from hilstar.basics.units import LIGHT_M_S, flux_ratio, magnitude
from hilstar.sky import electrons
from hilstar.sky.spectral_types import bare_and_dusty, fit_types
from hilstar.sky.spectrum import (
    DATA_DIR,
    PLANCK_J_S,
    STEFAN_BOLTZMANN_W_M2_K4,
    Curve,
    blackbody_exitance_w_m2_m,
    integration_nodes,
    read_curve_csv,
    torres2010_k,
)

# F_lambda of magnitude 0, W/m2/m: Bessell, Castelli and Plez 1998, A&A 333, 231, table A2 (thesis
# table 2.5).
ZERO_W_M2_M = {
    "u": 4.175e-2,
    "b": 6.32e-2,
    "v": electrons.VEGA_V0_W_M2_M,
    "r": 2.177e-2,
    "i": 1.126e-2,
}
BANDS = ("u", "b", "r", "i", "g")
VEGA_V_MAG = 0.03  # the V and the instrument magnitude of Vega (thesis 2.4.3)
AB_0_W_M2_HZ = 3.631e-23  # Oke and Gunn 1983: 3631 Jy
TORRES_BV_MAG = (-0.35, 1.8)
END_NM = 10.0  # the end of a library spectrum to which the black body beyond it is fitted
# Beyond these a black body of 3000 K has 6e-6 of its light, hotter ones less; the knots of the
# trapezoids up to them.
ULTRAVIOLET_NM = 10.0
INFRARED_NM = 100_000.0
NODES_BEYOND = 2000

Spectrum = Literal["blackbody", "pickles", "mk"]

# Magnitudes (n,) less V of stars by their B-V, V-I and type (n, 2) or None.
Colour = Callable[[FloatArray, FloatArray, FloatArray | None], FloatArray]


def vega() -> Curve:
    """Vega's relative F_lambda (CALSPEC)."""
    return read_curve_csv(DATA_DIR / "vega.csv")


def curve_mean(spectrum: Curve, passband: Curve, weighting: str = "energy") -> float:
    """The mean of a relative F_lambda through a passband (thesis eq. 3.11)."""
    nodes_nm, weight_m = integration_nodes(passband, spectrum)
    response = _band_response(passband, weighting, nodes_nm, weight_m)
    return float(spectrum(nodes_nm) @ response / response.sum())


def _band_response(
    passband: Curve, weighting: str, nodes_nm: FloatArray, weight_m: FloatArray
) -> FloatArray:
    """What F_lambda at nodes (n,) counts in a passband's mean, with the nodes' weights; by its
    energy, or by its photons, of which there are more the longer the wave.
    """
    response = passband(nodes_nm) * weight_m
    if weighting == "photon":
        response = response * nodes_nm
    return response


def colours(
    spectrum: Spectrum, temperature: str, photometry: electrons.Photometry
) -> dict[str, Colour]:
    """The colours of BANDS and of "bolometric" (eq. 2.6, 2.7) against V, of the spectra that a
    bench gives its stars.
    """
    johnson_v = read_curve_csv(DATA_DIR / "johnson-v.csv")
    light = vega()
    colour_by_name: dict[str, Colour] = {}
    for band in BANDS:
        if band == "g":
            # Gaia's G counts photons, and Vega scaled to V = 0 has G = 0.
            weighting: electrons.Weighting = "photon"
            passband = read_curve_csv(DATA_DIR / "gaia-g.csv")
            zero = curve_mean(light, passband, weighting) / curve_mean(light, johnson_v)
        else:
            weighting = "energy"
            passband = read_curve_csv(DATA_DIR / f"bessell-{band}.csv")
            zero = ZERO_W_M2_M[band] / electrons.VEGA_V0_W_M2_M
        colour_by_name[band] = _band(spectrum, temperature, passband, weighting, zero)
    colour_by_name["bolometric"] = _bolometric(spectrum, temperature, photometry)
    return colour_by_name


def _band(
    spectrum: Spectrum,
    temperature: str,
    passband: Curve,
    weighting: electrons.Weighting,
    zero: float,
) -> Colour:
    """The colour of one passband, in which `zero` is the mean of magnitude 0 over that in V."""
    if spectrum != "blackbody":
        means = electrons.band_mean(_spectra(spectrum), passband, weighting)
        return _by_library(spectrum, means / zero)
    nodes_nm, weight_m = integration_nodes(passband)
    response = _band_response(passband, weighting, nodes_nm, weight_m)

    def log_mean(inverse_k: FloatArray) -> FloatArray:
        kelvin = 1.0 / inverse_k
        exitance = blackbody_exitance_w_m2_m(nodes_nm, kelvin[..., None])
        mean = exitance @ response / response.sum()
        v_mean = electrons.v_band_mean_w_m2_m(kelvin, "energy")
        return np.asarray(np.log(mean / v_mean / zero), dtype=np.float64)

    low_k, high_k = electrons.TABLE_RANGE_K
    inverse_range = [1.0 / high_k, 1.0 / low_k]
    table = Chebyshev.interpolate(log_mean, electrons.TABLE_DEGREE, domain=inverse_range)

    def colour(bv_mag: FloatArray, _vi: FloatArray, _kind: FloatArray | None) -> FloatArray:
        kelvin = electrons.star_temperatures_k(bv_mag, temperature)
        relative: FloatArray = np.exp(table(1.0 / kelvin))
        return magnitude(relative)

    return colour


def _spectra(spectrum: Spectrum) -> electrons.Library:
    """The library that a bench's stars have their spectra from."""
    if spectrum == "mk":
        return bare_and_dusty()
    return electrons.load_library()


def _by_library(spectrum: Spectrum, relative: FloatArray) -> Colour:
    """The colour that stars have by a library's spectra, whose fluxes over those in V are
    `relative` (n,).
    """
    if spectrum == "mk":
        by_type = fit_types(relative)

        def colour(bv: FloatArray, vi: FloatArray, kind: FloatArray | None) -> FloatArray:
            v_mag = np.zeros(len(bv))
            return magnitude(by_type.electrons_per_s(v_mag, bv, vi, kind))

        return colour
    library = electrons.load_library()
    table = electrons.fit_table(library.bv_mag, library.vi_mag, relative)

    def plain_colour(bv: FloatArray, vi: FloatArray, _kind: FloatArray | None) -> FloatArray:
        v_mag = np.zeros(len(bv))
        return magnitude(table.electrons_per_s(v_mag, bv, vi))

    return plain_colour


def _bolometric(spectrum: Spectrum, temperature: str, photometry: electrons.Photometry) -> Colour:
    """The colour of the light of all wavelengths."""
    v0 = electrons.reference_mean_w_m2_m(photometry)
    if spectrum != "blackbody":
        exitance_m = library_exitance_m(_spectra(spectrum))
        return _by_library(spectrum, v0 * exitance_m / electrons.BOLOMETRIC_0_W_M2)

    def colour(bv_mag: FloatArray, _vi: FloatArray, _kind: FloatArray | None) -> FloatArray:
        kelvin = electrons.star_temperatures_k(bv_mag, temperature)
        v_mean = electrons.v_band_mean_w_m2_m(kelvin, photometry.weighting)
        whole_m = STEFAN_BOLTZMANN_W_M2_K4 * kelvin**4 / v_mean
        return magnitude(v0 * whole_m / electrons.BOLOMETRIC_0_W_M2)

    return colour


def library_exitance_m(library: electrons.Library) -> FloatArray:
    """A library's spectra over all wavelengths, in their mean through V times m (n,).

    Beyond a spectrum's ends stands a black body of its B-V (Torres 2010), fitted to its last
    END_NM.
    """
    nm = library.wavelength_nm
    flux = library.flux
    total = np.trapezoid(flux, nm, axis=1) * 1e-9
    bv_mag = np.clip(library.bv_mag, *TORRES_BV_MAG)
    kelvin = torres2010_k(bv_mag)[:, None]
    first_nm = float(nm[0])
    last_nm = float(nm[-1])
    bluer = (np.geomspace(ULTRAVIOLET_NM, first_nm, NODES_BEYOND), nm <= first_nm + END_NM)
    redder = (np.geomspace(last_nm, INFRARED_NM, NODES_BEYOND), nm >= last_nm - END_NM)
    for beyond_nm, is_at_end in (bluer, redder):
        body = blackbody_exitance_w_m2_m(beyond_nm, kelvin)
        body_at_end = blackbody_exitance_w_m2_m(nm[is_at_end], kelvin)
        scale = flux[:, is_at_end].mean(axis=1) / body_at_end.mean(axis=1)
        total += np.trapezoid(body, beyond_nm, axis=1) * 1e-9 * scale
    return np.asarray(total)


def vega_electrons_per_s(optics: electrons.Optics, photometry: electrons.Photometry) -> float:
    """Electron rate of Vega's own spectrum scaled to V = 0.03, by the bench's zero point."""
    light = vega()
    passband = read_curve_csv(DATA_DIR / "johnson-v.csv")
    v0 = electrons.reference_mean_w_m2_m(photometry)
    mean = curve_mean(light, passband, photometry.weighting)
    scale = flux_ratio(VEGA_V_MAG) * v0 / mean
    return scale * _through(optics, light)


def ab_electrons_per_s(optics: electrons.Optics) -> float:
    """Electron rate of AB magnitude 0: 3631 Jy at every wavelength."""
    nodes_nm, weight_m = integration_nodes(optics.quantum_efficiency, optics.transmission)
    response = optics.quantum_efficiency(nodes_nm) * optics.transmission(nodes_nm) * weight_m
    # as many photons in each octave: the energy of one goes with its frequency
    octaves = (response / (nodes_nm * 1e-9)).sum()
    return float(optics.area_m2 * AB_0_W_M2_HZ / PLANCK_J_S * octaves)


def _through(optics: electrons.Optics, light: Curve) -> float:
    """Electron rate of light of this F_lambda."""
    nodes_nm, weight_m = integration_nodes(optics.quantum_efficiency, optics.transmission, light)
    photons_per_j = nodes_nm * 1e-9 / (PLANCK_J_S * LIGHT_M_S)
    efficiency = optics.quantum_efficiency(nodes_nm) * optics.transmission(nodes_nm)
    response = efficiency * photons_per_j * weight_m
    return float(optics.area_m2 * (light(nodes_nm) @ response))
