"""The spectral model (DGS) against the average one (AGS) over temperature: figures 5.19 and 5.22 of the thesis."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.charts import chart, plain_ticks, write_csv
from hilstar.sky.electrons import (
    REFERENCE_TEMPERATURE_K,
    Optics,
    Photometry,
    Weighting,
    ags_electrons_per_s,
    dgs_electrons_per_s,
    reference_mean_w_m2_m,
    v_band_mean_w_m2_m,
)
from hilstar.sky.spectrum import PLANCK_J_S, blackbody_exitance_w_m2_m, integration_nodes
from hilstar.study.models.finding import Finding
from hilstar.study.models.settings import SENSORS, WEIGHTINGS
from hilstar.study.shared.brightness import study_optics
from hilstar.units import LIGHT_M_S

QUOTED_K = (3000.0, 5000.0, 9000.0, 50_000.0)
THESIS_HOT_STARS = {"ccd47-20": " (thesis: 15 % to 5 %)"}  # section 5.4, of figure 5.19

Ratios = dict[Weighting, FloatArray]


def rapp(directory: Path, sensor: str) -> Finding:
    """The three ratios of a sensor, 3000 to 50 000 K, for both passband weightings."""
    kelvin = np.union1d(np.geomspace(3000, 50_000, 400)[1:-1], QUOTED_K)
    optics = study_optics(sensor)
    ratios: Ratios = {weighting: rapp_ratios(kelvin, optics, weighting) for weighting in WEIGHTINGS}
    coolest, cool, hot, hottest = ratios["energy"][2][np.searchsorted(kelvin, QUOTED_K)]
    text = (
        f"{SENSORS[sensor]}: the spectral model gives {coolest:.2f} times the electrons of the average one at 3000 K,"
        f" {cool:.2f} at 5000 K; at 9000 K they differ by {100 * (hot - 1):+.1f} %, at 50000 K by {100 * (hottest - 1):+.1f} %"
        + THESIS_HOT_STARS.get(sensor, "")
    )
    finding = Finding(f"rapp_{sensor}", text)
    _draw(directory, finding, kelvin, ratios, optics.range_nm)
    columns = ("temperature_k", *(f"rapp{k}_{weighting}" for weighting in WEIGHTINGS for k in (1, 2, 3)))
    table = np.column_stack((kelvin, *(ratios[weighting][k] for weighting in WEIGHTINGS for k in range(3))))
    write_csv(directory / f"{finding.figure}.csv", columns, table.tolist())
    return finding


def rapp_ratios(temperature_k: FloatArray, optics: Optics, weighting: Weighting) -> FloatArray:
    """RAPP1, RAPP2 and RAPP3, shape (3, n): DGS over AGS in irradiance, photons and electrons (thesis eq. 5.1 to 5.3)."""
    photometry = Photometry(weighting=weighting)
    wavelength_nm, weight_m = integration_nodes(optics.quantum_efficiency, optics.transmission)
    low_nm, high_nm = optics.range_nm
    photons_per_j = wavelength_nm * 1e-9 / (PLANCK_J_S * LIGHT_M_S)
    mean_photons_per_j = (low_nm + high_nm) / 2 * 1e-9 / (PLANCK_J_S * LIGHT_M_S)
    reference = reference_mean_w_m2_m(photometry)

    def in_range(kelvin: FloatArray, response: FloatArray) -> FloatArray:
        spectrum = blackbody_exitance_w_m2_m(wavelength_nm, kelvin[:, None])
        return np.asarray(reference / v_band_mean_w_m2_m(kelvin, weighting) * (spectrum @ (response * weight_m)))

    ones = np.ones_like(wavelength_nm)
    average = in_range(np.array([REFERENCE_TEMPERATURE_K]), ones)[0]
    irradiance = in_range(temperature_k, ones) / average
    photons = in_range(temperature_k, photons_per_j) / (average * mean_photons_per_j)
    electrons = dgs_electrons_per_s(temperature_k, optics, photometry) / ags_electrons_per_s(optics, photometry)
    return np.stack((irradiance, photons, electrons))


def _draw(directory: Path, finding: Finding, kelvin: FloatArray, ratios: Ratios, range_nm: tuple[float, float]) -> None:
    low_nm, high_nm = range_nm
    with chart(directory / f"{finding.figure}.png", finding.text) as (axis,):
        for k, name in enumerate(("RAPP1 irradiance", "RAPP2 photons", "RAPP3 electrons")):
            (line,) = axis.plot(kelvin, ratios["energy"][k], label=f"{name}, energy weighting")
            axis.plot(kelvin, ratios["photon"][k], "--", color=line.get_color(), label=f"{name}, photon weighting (source)")
        axis.axhline(1, color="0.5", lw=1)
        axis.set(xscale="log", yscale="log", ylabel=f"DGS / AGS at the same V, {low_nm:.0f} to {high_nm:.0f} nm [1]")
        axis.set(xlabel="black-body temperature [K]")
        plain_ticks(axis.xaxis, (3000, 4000, 5000, 7000, 9000, 15_000, 20_000, 30_000, 50_000))
        plain_ticks(axis.yaxis, (0.8, 0.9, 1, 1.2, 1.4, 1.6, 2, 2.5))
        axis.legend(loc="upper right" if finding.figure.endswith("kai-4021") else "upper center", fontsize=10)
