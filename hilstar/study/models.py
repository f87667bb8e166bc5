"""What the brightness models make of a star: DGS against AGS, temperatures, zero points, black body against real spectra."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.charts import chart, plain_ticks, write_csv
from hilstar.sky.catalog import Catalog, load_catalog
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

SENSORS = {"ccd47-20": "CCD47-20", "kai-4021": "KAI-4021 (approximate QE)"}
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
THESIS_HOT_STARS = {"ccd47-20": " (thesis: 15 % to 5 %)"}  # section 5.4, of figure 5.19
BRIGHT_V_MAG = 7.5
BV_MAG = np.arange(-35, 181) / 100  # where Torres 2010 holds; exact at 0, where wang2021 steps
WINDOW_MAG = 0.05  # half the width of the running percentiles in B-V
FEWEST_STARS = 20
REDDEST_RELIABLE_VI_MAG = 2.5


@dataclass(frozen=True, slots=True)
class Finding:
    """One figure and what it says."""

    figure: str
    text: str


def run(directory: Path) -> list[Finding]:
    """Write every figure (PNG) and its table (CSV) into `directory`, and `findings.csv`."""
    findings = [rapp(directory, sensor) for sensor in SENSORS]
    findings += [study(directory) for study in (temperature_scales, zero_points, choices, spectra)]
    write_csv(directory / "findings.csv", ("figure", "finding"), [(f.figure, f.text) for f in findings])
    return findings


def study_optics(sensor: str) -> Optics:
    """A sensor behind 30 mm and N-BK7."""
    return Optics(APERTURE_MM, load_curve(sensor, sensor), load_curve(GLASS, GLASS))


def mag_against(rate: FloatArray, base: FloatArray) -> FloatArray:
    """Magnitudes by which `rate` is fainter than `base`; the shapes broadcast."""
    return np.asarray(-2.5 * np.log10(rate / base))


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
    quoted_k = (3000.0, 5000.0, 9000.0, 50_000.0)
    kelvin = np.union1d(np.geomspace(3000, 50_000, 400)[1:-1], quoted_k)
    optics = study_optics(sensor)
    ratios = {weighting: rapp_ratios(kelvin, optics, weighting) for weighting in WEIGHTINGS}
    coolest, cool, hot, hottest = ratios["energy"][2][np.searchsorted(kelvin, quoted_k)]
    text = (
        f"{SENSORS[sensor]}: the spectral model gives {coolest:.2f} times the electrons of the average one at 3000 K,"
        f" {cool:.2f} at 5000 K; at 9000 K it is off by {100 * (hot - 1):+.1f} %, at 50000 K by {100 * (hottest - 1):+.1f} %"
        + THESIS_HOT_STARS.get(sensor, "")
    )
    stem = f"rapp_{sensor}"
    with chart(directory / f"{stem}.png", text) as (axis,):
        for k, name in enumerate(("RAPP1 irradiance", "RAPP2 photons", "RAPP3 electrons")):
            (line,) = axis.plot(kelvin, ratios["energy"][k], label=f"{name}, energy weighting")
            axis.plot(kelvin, ratios["photon"][k], "--", color=line.get_color(), label=f"{name}, photon weighting (source)")
        axis.axhline(1, color="0.5", lw=1)
        low_nm, high_nm = optics.range_nm
        axis.set(xscale="log", yscale="log", ylabel=f"DGS / AGS at the same V, {low_nm:.0f} to {high_nm:.0f} nm [1]")
        axis.set(xlabel="black-body temperature [K]")
        plain_ticks(axis.xaxis, (3000, 4000, 5000, 7000, 9000, 15_000, 20_000, 30_000, 50_000))
        plain_ticks(axis.yaxis, (0.8, 0.9, 1, 1.2, 1.4, 1.6, 2, 2.5))
        axis.legend(loc="upper right" if sensor == "kai-4021" else "upper center", fontsize=10)
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
    bv = np.union1d(BV_MAG, -1e-9)  # both sides of wang2021's step
    torres = torres2010_k(bv)
    optics, photometry = study_optics("ccd47-20"), Photometry()
    base = dgs_electrons_per_s(torres, optics, photometry)
    kelvin = {"torres2010_supergiant": torres2010_k(bv, supergiant=True)}
    kelvin |= {name: scale(bv) for name, scale in TEMPERATURE_SCALES.items()}
    percent = {name: 100 * (t / torres - 1) for name, t in kelvin.items()}
    mag = {name: mag_against(dgs_electrons_per_s(t, optics, photometry), base) for name, t in kelvin.items()}
    stars_bv = load_catalog().brighter_than(BRIGHT_V_MAG).bv_mag
    stars_bv = stars_bv[(stars_bv >= bv[0]) & (stars_bv <= bv[-1])]
    within = {n: np.percentile(np.abs(np.interp(stars_bv, bv, mag[n])), (50, 95)) for n in TEMPERATURE_SCALES}
    zero = int(np.searchsorted(bv, 0.0))
    step_k = kelvin["wang2021"][zero - 1] - kelvin["wang2021"][zero]
    text = (
        f"wang2021 steps down by {step_k:.0f} K ({100 * step_k / kelvin['wang2021'][zero - 1]:.1f} %) at B-V = 0; half of"
        " Hipparcos to V = 7.5 (95 %) is within "
        + ", ".join(f"{half:.3f} ({most:.2f}) mag by {name}" for name, (half, most) in within.items())
        + " of Torres 2010"
    )
    with chart(directory / "temperature_scales.png", text, panels=3) as axes:
        axes[0].plot(bv, torres, "k", label="Torres 2010 (Flower), dwarfs to giants: the reference below")
        for axis, values in zip(axes, (kelvin, percent, mag), strict=True):
            for (name, value), style in zip(values.items(), ("k:", "C0", "C1"), strict=True):
                axis.plot(bv, value, style, label=name.replace("torres2010_supergiant", "Torres 2010, supergiants"))
        for axis in axes[1:]:
            axis.axhline(0, color="k", lw=1)
        axes[0].set(yscale="log", ylabel="temperature [K]")
        plain_ticks(axes[0].yaxis, (3000, 4000, 6000, 10_000, 20_000, 40_000))
        axes[1].set(ylabel="temperature against Torres 2010 [%]", ylim=(-75, 45))
        axes[2].set(xlabel="B-V [mag]", ylabel="CCD47-20 electrons against\nTorres 2010 [mag], + is fainter")
        for axis in axes:
            axis.legend(fontsize=10)
    groups = (("k", kelvin), ("percent", percent), ("mag", mag))
    columns = ("bv_mag", "torres2010_k", *(f"{name}_{unit}" for unit, values in groups for name in values))
    table = np.column_stack((bv, torres, *(value for _, values in groups for value in values.values())))
    write_csv(directory / "temperature_scales.csv", columns, table.tolist())
    return Finding("temperature_scales", text)


def zero_points(directory: Path) -> Finding:
    """Electrons of a V = 0 star of 9602 K by zero point and weighting."""
    settings = [Photometry(zero, weighting) for zero in ("vega", "iau-bolometric") for weighting in WEIGHTINGS]
    rates = {
        sensor: np.array([dgs_electrons_per_s(REFERENCE_TEMPERATURE_K, study_optics(sensor), p) for p in settings])
        for sensor in SENSORS
    }
    mag = {sensor: mag_against(rate, rate[0]) for sensor, rate in rates.items()}
    base, cost = rates["ccd47-20"], mag["ccd47-20"]
    text = (
        f"A V = 0 star of 9602 K gives {base[0] / 1e6:.1f} million electrons/s by Vega's flux (CCD47-20, 30 mm),"
        f" {100 * (1 - base[2] / base[0]):.0f} % ({cost[2]:.2f} mag) fewer by the IAU's bolometric zero point"
    )
    with chart(directory / "zero_points.png", text, panels=2) as (upper, lower):
        place = np.arange(len(settings))
        for k, (sensor, name) in enumerate(SENSORS.items()):
            for axis, height, figure in ((upper, rates[sensor] / 1e6, "%.2f"), (lower, mag[sensor], "%+.3f")):
                bars = axis.bar(place + 0.4 * k - 0.2, height, 0.38, label=name)
                axis.bar_label(bars, fmt=figure, padding=2)
        upper.set(ylabel="electrons per second [millions]", ylim=(0, 1.15 * base.max() / 1e6))
        lower.set_xticks(place, [f"{p.zero_point},\n{p.weighting} weighting" for p in settings])
        lower.set(
            ylabel="against vega, energy [mag],\n+ is fainter", xlabel="zero point, passband weighting", ylim=(-0.05, 0.38)
        )
        upper.legend()
        lower.legend(loc="upper left")
    rows = [
        (sensor, p.zero_point, p.weighting, float(rate), float(m))
        for sensor in SENSORS
        for p, rate, m in zip(settings, rates[sensor], mag[sensor], strict=True)
    ]
    columns = ("sensor", "zero_point", "weighting", "electrons_per_s", "mag_against_default")
    write_csv(directory / "zero_points.csv", columns, rows)
    return Finding("zero_points", text)


def choice_costs_mag(bv_mag: FloatArray, optics: Optics) -> dict[str, FloatArray]:
    """What each choice costs, mag (n,), against a black body by ballesteros2012, vega and energy; + is fainter."""
    default = Photometry()
    kelvin = star_temperatures_k(bv_mag, "ballesteros2012")
    rates = {
        "temperature wang2021": dgs_electrons_per_s(star_temperatures_k(bv_mag, "wang2021"), optics, default),
        "weighting photon": dgs_electrons_per_s(kelvin, optics, Photometry("vega", "photon")),
        "zero point iau-bolometric": dgs_electrons_per_s(kelvin, optics, Photometry("iau-bolometric")),
        "brightness ags": np.full_like(bv_mag, ags_electrons_per_s(optics, default)),
    }
    base = dgs_electrons_per_s(kelvin, optics, default)
    return {name: mag_against(rate, base) for name, rate in rates.items()}


def choices(directory: Path) -> Finding:
    """What each choice costs in magnitudes over B-V, and what it costs the stars of Hipparcos."""
    optics = study_optics("ccd47-20")
    bv = np.arange(-30, 201) / 100
    cost = choice_costs_mag(bv, optics)
    stars = load_catalog().brighter_than(BRIGHT_V_MAG)
    real = pickles_cost_mag(stars, optics)
    low, middle, high, count = running_percentiles(stars.bv_mag, real, bv)
    on_stars = choice_costs_mag(stars.bv_mag, optics) | {"spectrum pickles": real}
    paid = {name: np.percentile(np.abs(mag), (50, 95)) for name, mag in on_stars.items()}
    text = "What a choice moves half of Hipparcos to V = 7.5 by (95 %), CCD47-20 mag: " + ", ".join(
        f"{name.split()[-1]} {half:.2f} ({most:.2f})" for name, (half, most) in paid.items()
    )
    with chart(directory / "choices.png", text, panels=2) as (upper, lower):
        for name, mag in cost.items():
            upper.plot(bv, mag, label=name)
        for axis in (upper, lower):
            axis.plot(bv, middle, "k", label="spectrum pickles, median of real stars")
            axis.axhline(0, color="0.5", lw=1)
            axis.set(ylabel="cost against the black body [mag],\n+ is fainter")
        label = f"5 to 95 % of {len(stars)} Hipparcos stars to V = {BRIGHT_V_MAG:g}"
        lower.fill_between(bv, low, high, color="0.7", alpha=0.6, label=label)
        reddest = (
            f"M giants share their B-V with K giants and give up to {-np.nanmin(low):.1f} mag more than the black body (5 %)"
        )
        lower.set(xlabel="B-V [mag]")
        lower.set_title(reddest, fontsize=11)
        upper.legend(fontsize=10, loc="lower left")
        lower.legend(fontsize=10, loc="lower left")
    columns = ("bv_mag", *(f"{n.replace(' ', '_')}_mag" for n in cost))
    columns += ("pickles_p5_mag", "pickles_median_mag", "pickles_p95_mag", "stars_in_window")
    write_csv(directory / "choices.csv", columns, np.column_stack((bv, *cost.values(), low, middle, high, count)).tolist())
    return Finding("choices", text)


def pickles_cost_mag(stars: Catalog, optics: Optics) -> FloatArray:
    """Real spectra against the black body by ballesteros2012 for catalogue stars, mag (n,); + is fainter."""
    zero = np.zeros(len(stars))
    real = tabulate_pickles(optics, Photometry()).electrons_per_s(zero, stars.bv_mag, stars.vi_mag)
    return mag_against(real, dgs_electrons_per_s(star_temperatures_k(stars.bv_mag, "ballesteros2012"), optics, Photometry()))


def running_percentiles(bv_mag: FloatArray, value: FloatArray, at_bv_mag: FloatArray) -> FloatArray:
    """5, 50 and 95 % of `value` (n,) within WINDOW_MAG of each colour, and the count, shape (4, m).

    NaN where fewer than FEWEST_STARS are.
    """
    rows = np.full((4, len(at_bv_mag)), np.nan)
    for k, centre in enumerate(at_bv_mag):
        inside = value[np.abs(bv_mag - centre) <= WINDOW_MAG]
        rows[3, k] = len(inside)
        if len(inside) >= FEWEST_STARS:
            rows[:3, k] = np.percentile(inside, (5, 50, 95))
    return rows


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
    text = "Electrons are off by (95 %), V-I < 2.5: " + "; ".join(
        f"{SENSORS[sensor].split()[0]} {real[0]:.1f} % ({real[1]:.1f} %) by real spectra and V-I,"
        f" {body[0]:.1f} % ({body[1]:.1f} %) by black bodies and B-V"
        for sensor in SENSORS
        for real, body in [(figures[sensor, "pickles, leave-one-out"], figures[sensor, "black body, ballesteros2012"])]
    )
    with chart(directory / "spectra.png", text, panels=2) as axes:
        for axis, sensor in zip(axes, SENSORS, strict=True):
            named = [(name, error) for (owner, name), error in errors.items() if owner == sensor]
            for (name, error), mark in zip(reversed(named), ("+", "x", "o"), strict=True):
                axis.plot(library.vi_mag, 100 * error, mark, ms=5, label=name)
            axis.axvline(
                REDDEST_RELIABLE_VI_MAG, color="0.5", lw=1, ls="--", label=f"V-I = 2.5: {(~sure).sum()} spectra are redder"
            )
            axis.axhline(0, color="k", lw=1)
            axis.set_yscale("symlog", linthresh=5)
            plain_ticks(axis.yaxis, (-90, -50, -20, -10, -5, 0, 5, 10, 20, 50, 100))
            axis.set(ylabel="error of the electron rate [%]", title=SENSORS[sensor], ylim=(-130, 900))
            axis.legend(fontsize=10, loc="upper right")
        axes[-1].set(xlabel="V-I [mag]")
    columns = ("spectral_type", "bv_mag", "vi_mag", *(f"{s}: {n} [%]" for s, n in errors))
    table = zip(library.spectral_type, library.bv_mag, library.vi_mag, *(100 * e for e in errors.values()), strict=True)
    write_csv(directory / "spectra.csv", columns, table)
    return Finding("spectra", text)
