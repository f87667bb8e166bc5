"""The spectral model (DGS) against the average one (AGS) over temperature: figures 5.19 and 5.22 of the thesis."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.charts import MUTED, SERIES, chart, label_ends, plain_ticks, write_csv
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
    title = (
        f"{SENSORS[sensor]}: a black body of 3000 K gives {coolest:.2f} times the electrons of the average model,"
        f" one of 5000 K {cool:.2f} times"
    )
    _draw(directory / finding.figure, title, kelvin, ratios, optics.range_nm)
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


def _draw(path: Path, title: str, kelvin: FloatArray, ratios: Ratios, range_nm: tuple[float, float]) -> None:
    low_nm, high_nm = range_nm
    note = f"DGS over AGS at one V, {low_nm:.0f} to {high_nm:.0f} nm. Solid: energy weighting; dotted: photon (source)."
    with chart(path, title, note=note) as (axes,):
        for k, (name, colour) in enumerate(zip(("irradiance", "photons", "electrons"), SERIES, strict=False)):
            axes.loglog(kelvin, ratios["energy"][k], color=colour, label=name)
            axes.loglog(kelvin, ratios["photon"][k], ":", color=colour, label="_photon weighting")
        axes.axhline(1, color=MUTED, lw=1)
        axes.set(xlabel="black-body temperature [K]", ylabel="ratio of the models [1]")
        plain_ticks(axes.xaxis, (3000, 5000, 9000, 15_000, 30_000, 50_000))
        label_ends(axes)
