"""What the brightness models make of a star: DGS against AGS, temperatures, zero points, black body against real spectra."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.sky.catalog import load_catalog
from hilstar.sky.electrons import (
    REFERENCE_TEMPERATURE_K,
    Optics,
    Photometry,
    Weighting,
    ags_electrons_per_s,
    dgs_electrons_per_s,
    reference_mean_w_m2_m,
    star_temperatures_k,
    v_band_mean_w_m2_m,
)
from hilstar.sky.pickles import fit_table, library_electrons_per_s, load_library, tabulate_pickles
from hilstar.sky.spectrum import (
    LIGHT_M_S,
    PLANCK_J_S,
    TEMPERATURE_SCALES,
    blackbody_exitance_w_m2_m,
    integration_nodes,
    load_curve,
)
from hilstar.study.charts import chart, write_csv

SENSORS = ("ccd47-20", "kai-4021")
APERTURE_MM = 30.0
GLASS = "n-bk7-10mm"
WEIGHTINGS: tuple[Weighting, ...] = ("energy", "photon")
# log10 T over B-V: Torres 2010 (AJ 140, 1158, table 2), Flower 1996 corrected.
TORRES_DWARFS_AND_GIANTS = (
    3.979145106714099,
    -0.654992268598245,
    1.740690042385095,
    -4.608815154057166,
    6.792599779944473,
    -5.396909891322525,
    2.192970376522490,
    -0.359495739295671,
)
TORRES_SUPERGIANTS = (
    4.012559732366214,
    -1.055043117465989,
    2.133394538571825,
    -2.459769794654992,
    1.349423943497744,
    -0.283942579112032,
)
BRIGHT_V_MAG = 7.5
REDDEST_RELIABLE_VI_MAG = 2.5


@dataclass(frozen=True, slots=True)
class Finding:
    """One figure and what it says."""

    figure: str
    text: str


def run(directory: Path) -> list[Finding]:
    """Write every figure (PNG) and its table (CSV) into `directory`, and `findings.csv`."""
    findings = [rapp(directory, sensor) for sensor in SENSORS]
    findings += [temperature_scales(directory), zero_points(directory), choices(directory), spectra(directory)]
    write_csv(directory / "findings.csv", ("figure", "finding"), [(f.figure, f.text) for f in findings])
    return findings


def study_optics(sensor: str) -> Optics:
    """A sensor behind 30 mm and N-BK7."""
    return Optics(APERTURE_MM, load_curve(sensor, sensor), load_curve(GLASS, GLASS))


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


def rapp(directory: Path, sensor: str) -> Finding:
    """Figures 5.19 and 5.22."""
    kelvin = np.geomspace(3000, 50_000, 400)
    ratios = {weighting: rapp_ratios(kelvin, study_optics(sensor), weighting) for weighting in WEIGHTINGS}
    at = {t: float(np.interp(t, kelvin, ratios["energy"][2])) for t in (3000.0, 5000.0, 9000.0, 50_000.0)}
    text = (
        f"{sensor}: against the average model a star of 3000 K gives {at[3000.0]:.2f} times the electrons,"
        f" of 5000 K {at[5000.0]:.2f}, of 9000 K {at[9000.0]:.2f}, of 50000 K {at[50_000.0]:.2f}"
    )
    stem = f"rapp_{sensor}"
    with chart(directory / f"{stem}.png", text) as (axis,):
        names = ("RAPP1 irradiance", "RAPP2 photons", "RAPP3 electrons")
        for k, name in enumerate(names):
            (line,) = axis.plot(kelvin, ratios["energy"][k], label=name)
            axis.plot(kelvin, ratios["photon"][k], "--", color=line.get_color(), label=f"{name}, source's weighting")
        axis.axhline(1, color="0.5", lw=1)
        axis.set(xscale="log", yscale="log", xlabel="black-body temperature [K]", ylabel="DGS / AGS at equal V")
        axis.legend()
    columns = ("temperature_k", *(f"rapp{k}_{weighting}" for weighting in WEIGHTINGS for k in (1, 2, 3)))
    table = np.column_stack((kelvin, *(ratios[weighting][k] for weighting in WEIGHTINGS for k in range(3))))
    write_csv(directory / f"{stem}.csv", columns, table.tolist())
    return Finding(stem, text)


def torres2010_k(bv_mag: FloatArray, supergiant: bool = False) -> FloatArray:
    """Effective temperature from B-V (Torres 2010, table 2); shape of `bv_mag`."""
    coefficients = TORRES_SUPERGIANTS if supergiant else TORRES_DWARFS_AND_GIANTS
    return np.asarray(10 ** np.polynomial.polynomial.polyval(bv_mag, coefficients))


def temperature_scales(directory: Path) -> Finding:
    """The scales on offer beside Torres 2010, and what they cost in electrons."""
    bv = np.linspace(-0.3, 1.7, 801)
    torres = torres2010_k(bv)
    optics, photometry = study_optics("ccd47-20"), Photometry()
    base = dgs_electrons_per_s(torres, optics, photometry)
    kelvin = {name: scale(bv) for name, scale in TEMPERATURE_SCALES.items()}
    mag = {name: -2.5 * np.log10(dgs_electrons_per_s(t, optics, photometry) / base) for name, t in kelvin.items()}
    step = float(np.diff(TEMPERATURE_SCALES["wang2021"](np.array([-1e-9, 0.0])))[0])
    common = (bv > -0.2) & (bv < 1.5)
    worst = {name: float(np.abs(m[common]).max()) for name, m in mag.items()}
    text = (
        "From B-V -0.2 to 1.5 the scales differ from Torres 2010 by at most "
        + " and ".join(f"{worst[name]:.2f} mag ({name})" for name in mag)
        + f" in CCD47-20 electrons; wang2021 steps by {step:.0f} K at 0"
    )
    with chart(directory / "temperature_scales.png", text, panels=2) as (left, right):
        left.plot(bv, torres, "k", label="Torres 2010, dwarfs to giants")
        left.plot(bv, torres2010_k(bv, supergiant=True), "k:", label="Torres 2010, supergiants")
        for name, t in kelvin.items():
            left.plot(bv, t, label=name)
            right.plot(bv, mag[name], label=name)
        left.set(yscale="log", xlabel="B-V [mag]", ylabel="temperature [K]")
        left.legend()
        right.axhline(0, color="k", lw=1)
        right.set(xlabel="B-V [mag]", ylabel="electrons against Torres 2010 [mag], + is fainter")
        right.legend()
    columns = ("bv_mag", "torres2010_k", "torres2010_supergiant_k", *(f"{n}_k" for n in kelvin), *(f"{n}_mag" for n in mag))
    table = np.column_stack((bv, torres, torres2010_k(bv, True), *kelvin.values(), *mag.values()))
    write_csv(directory / "temperature_scales.csv", columns, table.tolist())
    return Finding("temperature_scales", text)


def zero_points(directory: Path) -> Finding:
    """Electrons of a V = 0 star of 9602 K by zero point and weighting."""
    settings = [Photometry(zero, weighting) for zero in ("vega", "iau-bolometric") for weighting in WEIGHTINGS]
    names = [f"{p.zero_point}, {p.weighting}" for p in settings]
    rates = {
        sensor: [float(dgs_electrons_per_s(REFERENCE_TEMPERATURE_K, study_optics(sensor), p)) for p in settings]
        for sensor in SENSORS
    }
    base = rates["ccd47-20"]
    cost = -2.5 * np.log10(base[2] / base[0])
    text = (
        f"A V = 0 star of 9602 K gives {base[0]:.3g} electrons/s through 30 mm and a CCD47-20 by Vega's flux;"
        f" the bolometric zero point makes it {cost:.2f} mag fainter ({100 * (1 - base[2] / base[0]):.0f} %)"
    )
    with chart(directory / "zero_points.png", text) as (axis,):
        place = np.arange(len(names))
        for k, sensor in enumerate(SENSORS):
            bars = axis.bar(place + 0.4 * k - 0.2, np.array(rates[sensor]) / 1e6, 0.38, label=sensor)
            axis.bar_label(bars, fmt="%.2f")
        axis.set_xticks(place, names)
        axis.set(ylabel="electrons per second [millions]", xlabel="zero point, passband weighting")
        axis.legend()
    rows = [
        (sensor, p.zero_point, p.weighting, rate, -2.5 * np.log10(rate / rates[sensor][0]))
        for sensor in SENSORS
        for p, rate in zip(settings, rates[sensor], strict=True)
    ]
    columns = ("sensor", "zero_point", "weighting", "electrons_per_s", "mag_against_default")
    write_csv(directory / "zero_points.csv", columns, rows)
    return Finding("zero_points", text)


def choices(directory: Path) -> Finding:
    """What each choice costs in magnitudes, against a black body by ballesteros2012, Vega and the energy weighting."""
    optics, default = study_optics("ccd47-20"), Photometry()
    bv = np.linspace(-0.3, 2.0, 461)
    kelvin = {name: star_temperatures_k(bv, name) for name in TEMPERATURE_SCALES}
    base = dgs_electrons_per_s(kelvin["ballesteros2012"], optics, default)
    rates = {
        "temperature wang2021": dgs_electrons_per_s(kelvin["wang2021"], optics, default),
        "weighting photon": dgs_electrons_per_s(kelvin["ballesteros2012"], optics, Photometry("vega", "photon")),
        "zero point iau-bolometric": dgs_electrons_per_s(kelvin["ballesteros2012"], optics, Photometry("iau-bolometric")),
        "brightness ags": np.full_like(bv, ags_electrons_per_s(optics, default)),
    }
    cost = {name: -2.5 * np.log10(rate / base) for name, rate in rates.items()}
    centre, low, middle, high = _pickles_on_real_stars(optics, default)
    red = (centre > 1.4) & (centre < 1.7)
    text = (
        f"Through a CCD47-20 the source's zero point costs {cost['zero point iau-bolometric'].mean():.2f} mag;"
        f" a black body instead of real spectra {np.abs(middle[centre < 1.2]).max():.2f} mag at most (median of stars)"
        f" to B-V 1.2 and {np.abs(middle[red]).max():.2f} at 1.4 to 1.7"
    )
    with chart(directory / "choices.png", text) as (axis,):
        for name, mag in cost.items():
            axis.plot(bv, mag, label=name)
        axis.plot(centre, middle, "k", label="spectrum pickles: median of Hipparcos V <= 7.5")
        axis.fill_between(centre, low, high, color="0.7", alpha=0.6, label="5 to 95 % of them")
        axis.set(xlabel="B-V [mag]", ylabel="cost against the black body by default [mag], + is fainter", ylim=(-2.5, 1.5))
        axis.legend(fontsize=9)
    table = np.column_stack((bv, *cost.values(), *(np.interp(bv, centre, v) for v in (low, middle, high))))
    columns = (
        "bv_mag",
        *(f"{n.replace(' ', '_')}_mag" for n in cost),
        "pickles_p5_mag",
        "pickles_median_mag",
        "pickles_p95_mag",
    )
    write_csv(directory / "choices.csv", columns, table.tolist())
    return Finding("choices", text)


def _pickles_on_real_stars(optics: Optics, photometry: Photometry) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """B-V bins (0.05 mag, 20 stars at least) and the 5, 50 and 95 % of pickles against the black body, mag."""
    stars = load_catalog().brighter_than(BRIGHT_V_MAG)
    zero = np.zeros(len(stars))
    real = tabulate_pickles(optics, photometry).electrons_per_s(zero, stars.bv_mag, stars.vi_mag)
    body = dgs_electrons_per_s(star_temperatures_k(stars.bv_mag, "ballesteros2012"), optics, photometry)
    mag = -2.5 * np.log10(real / body)
    rows = []
    for edge in np.arange(-0.3, 2.0, 0.05):
        inside = (stars.bv_mag >= edge) & (stars.bv_mag < edge + 0.05)
        if inside.sum() >= 20:
            rows.append((edge + 0.025, *np.percentile(mag[inside], (5, 50, 95))))
    centre, low, middle, high = np.array(rows).T
    return centre, low, middle, high


def leave_one_out(rates: FloatArray) -> FloatArray:
    """Relative error (m,) of each library star's rate by a table fitted to all the others."""
    library = load_library()
    errors = np.empty(len(rates))
    for k in range(len(rates)):
        rest = np.arange(len(rates)) != k
        table = fit_table(library.bv_mag[rest], library.vi_mag[rest], rates[rest])
        one = table.electrons_per_s(np.zeros(1), library.bv_mag[k : k + 1], library.vi_mag[k : k + 1])
        errors[k] = one[0] / rates[k] - 1
    return errors


def spectra(directory: Path) -> Finding:
    """Black bodies and the Pickles relation (leave-one-out) against the Pickles spectra themselves, over V-I."""
    library = load_library()
    errors: dict[tuple[str, str], FloatArray] = {}
    for sensor in SENSORS:
        rates = library_electrons_per_s(library, study_optics(sensor), Photometry())
        errors[sensor, "pickles, leave-one-out"] = leave_one_out(rates)
        for scale in TEMPERATURE_SCALES:
            body = dgs_electrons_per_s(star_temperatures_k(library.bv_mag, scale), study_optics(sensor), Photometry())
            errors[sensor, f"black body, {scale}"] = body / rates - 1
    sure = library.vi_mag < REDDEST_RELIABLE_VI_MAG
    figures = {key: np.percentile(100 * np.abs(error[sure]), (50, 95)) for key, error in errors.items()}
    real, body_ = (figures["ccd47-20", name] for name in ("pickles, leave-one-out", "black body, ballesteros2012"))
    text = (
        f"Real spectra by V-I are right within {real[0]:.1f} % (median) and {real[1]:.1f} % (95 %) for V-I < 2.5"
        f" through a CCD47-20; a black body by B-V within {body_[0]:.1f} % and {body_[1]:.0f} %"
    )
    with chart(directory / "spectra.png", text, panels=2) as axes:
        for axis, sensor in zip(axes, SENSORS, strict=True):
            for (owner, name), error in errors.items():
                if owner == sensor:
                    axis.plot(library.vi_mag, 100 * error, "o" if name.startswith("pickles") else "x", ms=5, label=name)
            axis.axvline(REDDEST_RELIABLE_VI_MAG, color="0.5", lw=1)
            axis.axhline(0, color="k", lw=1)
            axis.set_yscale("symlog", linthresh=5)
            axis.set(xlabel="V-I [mag]", ylabel="error of the electron rate [%]", title=sensor)
            axis.legend()
    columns = ("spectral_type", "bv_mag", "vi_mag", *(f"{s}: {n} [%]" for s, n in errors))
    table = zip(library.spectral_type, library.bv_mag, library.vi_mag, *(100 * e for e in errors.values()), strict=True)
    write_csv(directory / "spectra.csv", columns, table)
    return Finding("spectra", text)
