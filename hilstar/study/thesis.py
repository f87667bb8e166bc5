"""Figures of the thesis's chapters 2 to 5 that need no simulation, each with the thesis's value beside the one here.

Called by the study of models, whose tables and findings these join.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import structs

from hilstar.arrays import FloatArray
from hilstar.charts import BLUE, GREEN, INK, MUTED, ORANGE, PURPLE, SERIES, chart, label_ends, write_csv
from hilstar.sky.catalog import load_catalog
from hilstar.sky.electrons import REFERENCE_TEMPERATURE_K, SUN_TEMPERATURE_K, v_band_mean_w_m2_m
from hilstar.sky.facts import facts_of
from hilstar.sky.spectrum import DATA_DIR, PLANCK_J_S, Curve, blackbody_exitance_w_m2_m, load_curve, read_curve_csv
from hilstar.sky.synthetic import VEGA_V_MAG, ZERO_W_M2_M, curve_mean, vega
from hilstar.sky.zodiacal import NEAR_SLOPES, relative_spectrum
from hilstar.tracker.settings import DetectorSettings
from hilstar.units import LIGHT_M_S, flux_ratio

# Table 2.3, whose medians are those of stars to about V = 9: unit and value by the fact's name.
TABLE_2_3 = {
    "sigma_bv_mag": ("mag", 0.0281),
    "sigma_ra_mas": ("mas", 0.77),
    "sigma_dec_mas": ("mas", 0.64),
    "sigma_parallax_mas": ("mas", 0.97),
    "sigma_pm_ra_mas_yr": ("mas/yr", 0.88),
    "sigma_pm_dec_mas_yr": ("mas/yr", 0.74),
}
NAMES_2_3 = ("B-V, mean", "right ascension", "declination", "parallax", "motion in RA", "motion in Dec")
BRIGHT_V_MAG = 9.0
# Table 2.2: V and B-V from the ground, from Hipparcos, from Tycho; of all 118 218 rows.
TABLE_2_2 = {"G": (23_139, 41_205), "H": (94_669, 0), "T": (409, 75_732)}
# Table 2.5: flux of magnitude 0 by Johnson and by Bessell, erg/s/cm2/A, and Bessell's effective wavelength, nm.
TABLE_2_5 = {
    "u": (4.35e-9, 4.175e-9, 366.0),
    "b": (7.20e-9, 6.32e-9, 438.0),
    "v": (3.92e-9, 3.631e-9, 545.0),
    "r": (1.76e-9, 2.177e-9, 641.0),
    "i": (8.3e-10, 1.126e-9, 798.0),
}
ERG_S_CM2_A = 1e7  # W/m2/m
TABLE_4_2_DARK = DetectorSettings(dark_e_per_s=203, read_noise_e=2)
DARK_LAWS: dict[str, dict[str, Any]] = {
    "Arrhenius, 0.56 eV": {"dark_law": "arrhenius"},
    "depletion alone": {"dark_law": "diffusion-depletion"},
    "half diffusion": {"dark_law": "diffusion-depletion", "dark_depletion_share": 0.5},
    "e2v AIMO": {"dark_law": "ccd47-20"},
    "e2v NIMO": {"dark_law": "e2v-nimo"},
}
COLD_K = 273.0
CORNERS_HZ = (0.0, 1e4, 1e5)
ZODIACAL_V_MAG, ZODIACAL_NM = 22.1, (330.0, 1100.0)


@dataclass(frozen=True, slots=True)
class ChartFinding:
    """A chart, by the stem of its files, and what it says."""

    figure: str
    text: str


def catalogue_errors(directory: Path) -> ChartFinding:
    """Figures 2.3 to 2.8 and tables 2.2 and 2.3: the errors of Hipparcos's figures, and where V and B-V are from."""
    catalog = load_catalog()
    facts = facts_of(catalog.hip)
    bright = catalog.v_mag < BRIGHT_V_MAG
    origins = [Counter(facts[name].tolist()) for name in ("v_source", "bv_source")]
    rows: list[tuple[str, str, float, float]] = [
        (f"{what} from {source}", "stars", count[source.encode()], printed)
        for source, both in TABLE_2_2.items()
        for what, count, printed in zip(("V", "B-V"), origins, both, strict=True)
    ]
    for name, (unit, printed) in TABLE_2_3.items():
        here = facts[name].mean() if name == "sigma_bv_mag" else np.median(facts[name][bright])
        rows.append((name, unit, float(here), printed))
    write_csv(directory / "catalogue_errors.csv", ("what", "unit", "here", "thesis"), rows)
    largest = max(abs(here - printed) for what, _, here, printed in rows if what in TABLE_2_3)
    text = (
        f"Hipparcos's errors: B-V {rows[-6][2]:.4f} mag (thesis: 0.0281), places {rows[-5][2]:.2f} and {rows[-4][2]:.2f} mas"
        f" (0.77, 0.64); all of table 2.3 within {largest:.3f}"
    )
    note = f"All {len(catalog)} stars, the largest errors in the last bar; lines: the thesis's mean and medians."
    with chart(directory / "catalogue_errors", text, 2, 3, note=note, share_x=False) as panels:
        for axes, title, (name, (unit, printed)) in zip(panels, NAMES_2_3, TABLE_2_3.items(), strict=True):
            axes.hist(np.clip(facts[name], 0, 5 * printed), bins=60, color=BLUE)
            axes.axvline(printed, color=INK)
            axes.set(title=title, xlabel=f"error [{unit}]", yscale="log")
    return ChartFinding("catalogue_errors", text)


def passbands(directory: Path) -> ChartFinding:
    """Figures 2.12, 2.13 and 3.7, and table 2.5: UBVRI, Vega, and the black body that the thesis takes for it."""
    light = vega()
    curves = {b: read_curve_csv(DATA_DIR / f"{'johnson' if b == 'v' else 'bessell'}-{b}.csv") for b in TABLE_2_5}
    in_v = curve_mean(light, curves["v"])
    scale = ZERO_W_M2_M["v"] / in_v  # a star with Vega's spectrum and V = 0
    rows = []
    for band, (johnson, bessell, printed_nm) in TABLE_2_5.items():
        weighted = Curve(light.wavelength_nm, light.value * light.wavelength_nm / light.wavelength_nm.max())
        effective = curve_mean(weighted, curves[band]) / curve_mean(light, curves[band]) * light.wavelength_nm.max()
        rows.append(
            (band.upper(), effective, printed_nm, scale * curve_mean(light, curves[band]) / ERG_S_CM2_A, bessell, johnson)
        )
    columns = ("band", "effective_nm", "thesis_effective_nm", "vega_v0", "thesis_bessell", "thesis_johnson")
    write_csv(directory / "passbands.csv", columns, rows)
    off = max(abs(row[3] / row[4] - 1) for row in rows)
    nm = np.arange(300.0, 1101.0)
    body = blackbody_exitance_w_m2_m(nm, REFERENCE_TEMPERATURE_K) / v_band_mean_w_m2_m(REFERENCE_TEMPERATURE_K, "energy")
    shown = {"Vega": light(nm) / in_v, "black body, 9602 K": body}
    blue = float(shown["Vega"][50] / body[50])
    text = (
        f"Vega's spectrum at V = 0 has table 2.5's second fluxes within {100 * off:.1f} %;"
        f" at 350 nm it has {blue:.2f} of the black body of 9602 K"
    )
    note = f"Vega: CALSPEC, V = {VEGA_V_MAG:g}; both scaled to one mean through V. Passbands: Bessell 1990."
    with chart(directory / "passbands", text, panels=2, note=note) as (upper, lower):
        for (band, curve), colour in zip(curves.items(), (PURPLE, BLUE, GREEN, ORANGE, INK), strict=True):
            upper.plot(curve.wavelength_nm, curve.value, color=colour, label="_")
            peak = curve.value.argmax()
            upper.annotate(band.upper(), (curve.wavelength_nm[peak], curve.value[peak]), va="bottom", ha="center", color=colour)
        for (name, values), colour in zip(shown.items(), (INK, ORANGE), strict=True):
            lower.plot(nm, values, color=colour, label=name)
        upper.set(ylabel="response [1]", ylim=(0, 1.15))
        lower.set(xlabel="wavelength [nm]", ylabel="relative F_lambda [1]")
        lower.legend()
    write_csv(directory / "vega.csv", ("wavelength_nm", "vega", "blackbody_9602_k"), np.column_stack((nm, *shown.values())))
    return ChartFinding("passbands", text)


def curves(directory: Path) -> ChartFinding:
    """Figures 5.1, 5.2, 5.20 and 5.21: sensors, glass, and the black bodies that they see."""
    names = ("ccd47-20", "kai-4021", "n-bk7-10mm")
    loaded = {name: load_curve(name, name) for name in names}
    words = {
        name: f"{c.wavelength_nm[0]:.0f} to {c.wavelength_nm[-1]:.0f} nm, most at {c.wavelength_nm[c.value.argmax()]:.0f}"
        for name, c in loaded.items()
    }
    text = f"The CCD47-20 sees {words['ccd47-20']}; the approximate KAI-4021 {words['kai-4021']}"
    note = "CCD47-20: ULTRACAM's red arm, not the thesis's midband coating. KAI-4021: recalled, not digitised. Lines: V."
    nm = np.arange(300.0, 1101.0, 2.0)
    kelvin = (3000.0, 5000.0, 9000.0, 30_000.0)
    bodies = [blackbody_exitance_w_m2_m(nm, each) for each in kelvin]
    bodies = [each / each.max() for each in bodies]
    v = load_curve("johnson-v", "johnson-v").wavelength_nm
    with chart(directory / "curves", text, panels=2, note=note) as (upper, lower):
        for (name, curve), colour in zip(loaded.items(), SERIES, strict=False):
            upper.plot(nm, curve(nm), color=colour, label=name)
        for each, body, colour in zip(kelvin, bodies, SERIES, strict=False):
            lower.plot(nm, body, color=colour, label=f"{each:.0f} K")
        for edge in (v[0], v[-1]):
            lower.axvline(edge, color=MUTED, lw=1)
        upper.set(ylabel="electrons a photon, transmission [1]")
        lower.set(xlabel="wavelength [nm]", ylabel="exitance over its largest [1]")
        label_ends(upper, lower)
    table = np.column_stack((nm, *(curve(nm) for curve in loaded.values()), *bodies))
    write_csv(directory / "curves.csv", ("wavelength_nm", *names, *(f"blackbody_{each:.0f}_k" for each in kelvin)), table)
    return ChartFinding("curves", text)


def detector_laws(directory: Path) -> ChartFinding:
    """Equation 4.12 and figures 4.12 and 4.15: dark current by temperature, read noise by readout frequency."""
    kelvin, hz = np.arange(230.0, 300.5, 1.0), np.geomspace(1e4, 1e7, 61)
    dark = {
        name: np.array([203 * structs.replace(TABLE_4_2_DARK, temperature_k=t, **law).dark_factor for t in kelvin.tolist()])
        for name, law in DARK_LAWS.items()
    }
    read = {
        corner: np.array(
            [structs.replace(TABLE_4_2_DARK, readout_hz=f, read_noise_corner_hz=corner).read_noise_now_e for f in hz.tolist()]
        )
        for corner in CORNERS_HZ
    }
    at = {name: float(values[kelvin == COLD_K][0]) for name, values in dark.items()}
    text = (
        f"Of 203 e-/s at 293 K (table 4.2) {COLD_K:.0f} K leaves {at['e2v AIMO']:.0f} by e2v's AIMO law,"
        f" {at['e2v NIMO']:.0f} by its NIMO law, {at['Arrhenius, 0.56 eV']:.0f} by Arrhenius with half of silicon's gap"
    )
    note = "e2v's constants were seen in public code, not on a data sheet. Read noise: 2 e- at 1 MHz, white and 1/f noise."
    with chart(directory / "detector_laws", text, panels=2, note=note, share_x=False) as (upper, lower):
        for (name, values), colour in zip(dark.items(), SERIES, strict=False):
            upper.semilogy(kelvin, values, color=colour, label=name)
        for (corner, values), colour in zip(read.items(), SERIES, strict=False):
            lower.loglog(hz, values, color=colour, label=f"1/f corner {corner / 1e3:g} kHz")
        upper.set(xlabel="temperature [K]", ylabel="dark current [e-/s]")
        lower.set(xlabel="readout frequency [Hz]", ylabel="read noise [e-]")
        label_ends(upper, lower)
    write_csv(directory / "detector_laws.csv", ("temperature_k", *dark), np.column_stack((kelvin, *dark.values())))
    return ChartFinding("detector_laws", text)


def zodiacal_spectrum(directory: Path) -> ChartFinding:
    """Equation 4.9 and figure 4.11: zodiacal light of V = 22.1 by table 19 and as sunlight."""
    nm = np.arange(ZODIACAL_NM[0], ZODIACAL_NM[1] + 1)
    photons_per_j = nm * 1e-9 / (PLANCK_J_S * LIGHT_M_S)
    v = load_curve("johnson-v", "johnson-v")
    level = flux_ratio(ZODIACAL_V_MAG) * ZERO_W_M2_M["v"]
    v_nm = np.arange(v.wavelength_nm[0], v.wavelength_nm[-1] + 1)
    lights: dict[str, Callable[[FloatArray], FloatArray]] = {
        "sunlight": lambda x: blackbody_exitance_w_m2_m(x, SUN_TEMPERATURE_K),
        "90 deg from the Sun": relative_spectrum,
        "30 deg from the Sun": lambda x: relative_spectrum(x, NEAR_SLOPES),
    }
    spectra: dict[str, FloatArray] = {}
    for name, light in lights.items():
        mean = float(light(v_nm) @ v(v_nm) / v(v_nm).sum())
        spectra[name] = level * light(nm) / mean * 1e-9 * photons_per_j  # photons/s/m2/arcsec2/nm
    total = {name: float(np.trapezoid(values, nm)) for name, values in spectra.items()}
    sun, far, near = total.values()
    text = (
        f"Zodiacal light of V = {ZODIACAL_V_MAG:g} has {far:.1f} photons/s/m2/arcsec2 90 degrees from the Sun (330 to"
        f" 1100 nm), {near:.1f} at 30 degrees, {sun:.1f} as sunlight"
    )
    note = "Leinert 1998, table 19 and equation 22, through Johnson V. The WFC3 handbook's spectrum, V = 22.15, gives 101.6."
    with chart(directory / "zodiacal", text, note=note) as (axes,):
        for (name, values), colour in zip(spectra.items(), SERIES, strict=False):
            axes.plot(nm, values, color=colour, label=name)
        axes.set(xlabel="wavelength [nm]", ylabel="photons/s/m2/arcsec2/nm")
        axes.legend()
    write_csv(directory / "zodiacal.csv", ("wavelength_nm", *spectra), np.column_stack((nm, *spectra.values())))
    return ChartFinding("zodiacal", text)


FIGURES = (catalogue_errors, passbands, curves, detector_laws, zodiacal_spectrum)
