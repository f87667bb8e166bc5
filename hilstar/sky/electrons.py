"""Electron rates of stars: DGS (thesis eq. 3.1) and AGS (eq. 3.2), with the corrections that the functions state.

Both are `10^(-0.4 V)` times the rate at V = 0. For DGS that rate depends on the star's temperature
alone, so it is tabulated once per bench; for AGS it is one number.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.polynomial import Chebyshev

from hilstar.arrays import FloatArray
from hilstar.errors import InputError
from hilstar.sky.spectrum import (
    PLANCK_J_S,
    STEFAN_BOLTZMANN_W_M2_K4,
    TEMPERATURE_SCALES,
    Curve,
    blackbody_exitance_w_m2_m,
    integration_nodes,
    load_curve,
)
from hilstar.units import LIGHT_M_S, flux_ratio

VEGA_V0_W_M2_M = 3.631e-2  # Bessell 1998, A&A 333, 231, table A2: 3.631e-9 erg/s/cm2/A at 545 nm
BOLOMETRIC_0_W_M2 = 2.518021002e-8  # IAU 2015 Resolution B2
SUN_TEMPERATURE_K = 5772.0  # IAU 2015 Resolution B3
REFERENCE_TEMPERATURE_K = 9602.0  # the thesis's Vega-like black body, section 3.4

# Where neither the quantum efficiency nor the transmission has a table: the range of silicon.
SILICON_RANGE_NM = (300.0, 1100.0)

# ln(electrons at V = 0) is smooth in 1/T. Degree 40 over this range is within 1e-11 of the integral
# (tests/authority/test_electrons.py holds it to 1e-6 for every star of the catalogue).
TABLE_RANGE_K = (1000.0, 200_000.0)
# results/tradeoff.csv, brightness: as accurate as the integral in a fortieth of its time.
TABLE_DEGREE = 40

BrightnessModel = Literal["dgs", "ags"]
ZeroPoint = Literal["vega", "iau-bolometric"]
Weighting = Literal["energy", "photon"]


@dataclass(frozen=True, slots=True)
class Optics:
    """The optics and sensor that turn starlight into electrons: aperture, quantum efficiency, transmission."""

    aperture_mm: float
    quantum_efficiency: Curve
    transmission: Curve

    def __post_init__(self) -> None:
        if not len(self.quantum_efficiency.wavelength_nm) and not len(self.transmission.wavelength_nm):
            flat = Curve(np.array(SILICON_RANGE_NM), np.full(2, self.quantum_efficiency.value[0]))
            object.__setattr__(self, "quantum_efficiency", flat)

    @property
    def area_m2(self) -> float:
        """The aperture's area, m2."""
        return np.pi / 4 * (self.aperture_mm * 1e-3) ** 2

    @property
    def range_nm(self) -> tuple[float, float]:
        """The wavelengths that the tracker detects: where both curves have values."""
        ranged = [c.wavelength_nm for c in (self.quantum_efficiency, self.transmission) if len(c.wavelength_nm)]
        return max(w[0] for w in ranged), min(w[-1] for w in ranged)


@dataclass(frozen=True, slots=True)
class Photometry:
    """How a V magnitude becomes a spectral irradiance."""

    zero_point: ZeroPoint = "vega"
    weighting: Weighting = "energy"


def v_band_mean_w_m2_m(temperature_k: float | FloatArray, weighting: Weighting) -> FloatArray:
    """<pi B(T)> through Johnson V, W/m2/m; shape of `temperature_k` (thesis eq. 3.11).

    Bessell's V is an energy response; "photon" multiplies it by lambda once more, as the thesis does.
    """
    passband = load_curve("johnson-v", "johnson-v")
    wavelength_nm, weight_m = integration_nodes(passband)
    response = passband(wavelength_nm) * weight_m
    if weighting == "photon":
        response = response * wavelength_nm
    spectrum = blackbody_exitance_w_m2_m(wavelength_nm, np.asarray(temperature_k, dtype=np.float64)[..., None])
    return np.asarray(spectrum @ response / response.sum())


def reference_mean_w_m2_m(photometry: Photometry) -> float:
    """<F_ref> of a V = 0 star through Johnson V, W/m2/m.

    "vega" is the published band average itself, whatever the weighting. "iau-bolometric" is the thesis's:
    a 9602 K black body with the IAU's bolometric zero point (eq. 3.14, 3.15).
    """
    if photometry.zero_point == "vega":
        return VEGA_V0_W_M2_M
    dilution = BOLOMETRIC_0_W_M2 / (STEFAN_BOLTZMANN_W_M2_K4 * REFERENCE_TEMPERATURE_K**4)
    return float(dilution * v_band_mean_w_m2_m(REFERENCE_TEMPERATURE_K, photometry.weighting))


def dgs_electrons_per_s(temperature_k: float | FloatArray, optics: Optics, photometry: Photometry) -> FloatArray:
    """Electron rate of a V = 0 black body by direct integration (thesis eq. 3.1); shape of `temperature_k`."""
    wavelength_nm, weight_m = integration_nodes(optics.quantum_efficiency, optics.transmission)
    electrons_per_j = wavelength_nm * 1e-9 / (PLANCK_J_S * LIGHT_M_S)
    response = optics.quantum_efficiency(wavelength_nm) * optics.transmission(wavelength_nm) * electrons_per_j * weight_m
    temperature_k = np.asarray(temperature_k, dtype=np.float64)
    exitance = blackbody_exitance_w_m2_m(wavelength_nm, temperature_k[..., None])
    dilution = reference_mean_w_m2_m(photometry) / v_band_mean_w_m2_m(temperature_k, photometry.weighting)
    return np.asarray(optics.area_m2 * dilution * (exitance @ response))


def zodiacal_electrons_per_s_arcsec2(v_mag_arcsec2: float, optics: Optics, photometry: Photometry) -> float:
    """Electron rate of zodiacal light per square arcsecond of sky: sunlight of that V surface brightness.

    Zodiacal light is a little redder than the Sun: the WFC3 handbook's spectrum gives 5 % more photons from 330 to 1100 nm.
    """
    return float(flux_ratio(v_mag_arcsec2) * dgs_electrons_per_s(SUN_TEMPERATURE_K, optics, photometry))


def ags_electrons_per_s(optics: Optics, photometry: Photometry) -> float:
    """Electron rate of any V = 0 star in the average model (thesis eq. 3.2, 3.16, 3.17).

    Every curve is replaced by its mean over the tracker's range, every star by the 9602 K reference.
    """
    low_nm, high_nm = optics.range_nm
    wavelength_nm, weight_m = integration_nodes(optics.quantum_efficiency, optics.transmission)
    width_m = (high_nm - low_nm) * 1e-9
    mean_qe = optics.quantum_efficiency(wavelength_nm) @ weight_m / width_m
    mean_transmission = optics.transmission(wavelength_nm) @ weight_m / width_m
    dilution = reference_mean_w_m2_m(photometry) / v_band_mean_w_m2_m(REFERENCE_TEMPERATURE_K, photometry.weighting)
    irradiance_w_m2 = dilution * (blackbody_exitance_w_m2_m(wavelength_nm, REFERENCE_TEMPERATURE_K) @ weight_m)
    mean_wavelength_m = (low_nm + high_nm) / 2 * 1e-9
    photons_per_j = mean_wavelength_m / (PLANCK_J_S * LIGHT_M_S)
    return float(optics.area_m2 * irradiance_w_m2 * photons_per_j * mean_qe * mean_transmission)


def star_temperatures_k(bv_mag: FloatArray, scale: str) -> FloatArray:
    """Temperatures (n,) by a scale of TEMPERATURE_SCALES, held within TABLE_RANGE_K.

    Only `wang2021` reaches the lower end: it gives the carbon star with B-V = 5.46 a temperature of 296 K.
    """
    low_k, high_k = TABLE_RANGE_K
    return np.clip(TEMPERATURE_SCALES[scale](bv_mag), low_k, high_k)


@dataclass(frozen=True, slots=True)
class RateTable:
    """Electrons per second of a V = 0 star against its temperature, tabulated once per bench."""

    log_rate: Chebyshev

    def electrons_per_s(self, v_mag: FloatArray, temperature_k: FloatArray) -> FloatArray:
        """Electron rates of stars (n,), whose temperatures lie within TABLE_RANGE_K."""
        return np.asarray(flux_ratio(v_mag) * np.exp(self.log_rate(1.0 / temperature_k)))


def tabulate(model: BrightnessModel, optics: Optics, photometry: Photometry) -> RateTable:
    """The rate table of a bench. Raises InputError when the tracker detects no light at all."""
    low_k, high_k = TABLE_RANGE_K
    domain = [1.0 / high_k, 1.0 / low_k]
    if not (dgs_electrons_per_s(REFERENCE_TEMPERATURE_K, optics, photometry) > 0):
        raise InputError("tracker: quantum efficiency times transmission is zero everywhere; no star gives an electron")
    if model == "ags":
        return RateTable(Chebyshev([np.log(ags_electrons_per_s(optics, photometry))], domain=domain))

    def log_rate(inverse_k: FloatArray) -> FloatArray:
        with np.errstate(divide="ignore"):
            return np.log(dgs_electrons_per_s(1.0 / inverse_k, optics, photometry))

    table = Chebyshev.interpolate(log_rate, TABLE_DEGREE, domain=domain)
    if not np.isfinite(table.coef).all():
        raise InputError("tracker: detects no light of the coolest stars at all; give a quantum efficiency that reaches 400 nm")
    return RateTable(table)
