"""The study of brightness models: DGS against AGS, temperature scales, zero points, black bodies against real spectra.

Charts: figures 5.19 and 5.22 of the thesis (RAPP); temperatures against Torres 2010; the electrons of a star of V = 0 by zero
point and passband weighting; the cost of each choice over B-V and for Hipparcos; spectra against the library's own.
The thesis's other figures are in `hilstar/study/thesis.py`.
"""

from pathlib import Path

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.charts import BLUE, GREEN, INK, MUTED, ORANGE, SERIES, SMALL_PT, chart, label_ends, plain_ticks, write_csv
from hilstar.sky.catalog import load_catalog
from hilstar.sky.electrons import (
    REFERENCE_TEMPERATURE_K,
    Optics,
    Photometry,
    Weighting,
    ags_electrons_per_s,
    dgs_electrons_per_s,
    library_electrons_per_s,
    load_library,
    reference_mean_w_m2_m,
    star_temperatures_k,
    tabulate_pickles,
    v_band_mean_w_m2_m,
)
from hilstar.sky.spectral_types import bare_and_dusty
from hilstar.sky.spectrum import PLANCK_J_S, TEMPERATURE_SCALES, blackbody_exitance_w_m2_m, integration_nodes, torres2010_k
from hilstar.study.settings import MAX_RELIABLE_VI_MAG, held_out_by_type, held_out_errors, study_optics
from hilstar.study.thesis import FIGURES, ChartFinding
from hilstar.units import LIGHT_M_S, magnitude

SENSORS = {"ccd47-20": "CCD47-20", "kai-4021": "KAI-4021 (approximate QE)"}
WEIGHTINGS: tuple[Weighting, ...] = ("energy", "photon")
BRIGHT_V_MAG = 7.5
HELD_OUT = "pickles, leave-one-out"
BY_TYPE = "mk, leave-one-out"

SETTINGS = [Photometry(zero, weighting) for zero in ("vega", "iau-bolometric") for weighting in WEIGHTINGS]
SCALE_BV_MAG = np.arange(-35, 181) / 100  # where Torres 2010 holds; exact at 0, where wang2021 steps
QUOTED_K = (3000.0, 5000.0, 9000.0, 50_000.0)
SAID_OF_THESIS = {  # section 5.4, of figures 5.19 and 5.22
    "ccd47-20": " (thesis: 15 % to 5 %)",
    "kai-4021": "; RAPP1 at 50000 K is {:.2f}, and {:.2f} with any curve from 300 to 1050 nm (thesis: the CCD47-20's)",
}

BV_MAG = np.arange(-30, 201) / 100
WINDOW_MAG = 0.05  # half the width of the running percentiles in B-V
MIN_STARS = 20


def spectra(directory: Path) -> ChartFinding:
    """Black bodies and the Pickles relation, each star held out in turn, against the Pickles spectra over V-I."""
    library, photometry = load_library(), Photometry()
    errors: dict[tuple[str, str], FloatArray] = {}  # relative, of each star, by sensor and method
    for sensor in SENSORS:
        optics = study_optics(sensor)
        rates = library_electrons_per_s(library, optics, photometry)
        errors[sensor, HELD_OUT] = held_out_errors(rates)
        errors[sensor, BY_TYPE] = held_out_by_type(library_electrons_per_s(bare_and_dusty(), optics, photometry))[: len(rates)]
        for scale in TEMPERATURE_SCALES:
            body = dgs_electrons_per_s(star_temperatures_k(library.bv_mag, scale), optics, photometry)
            errors[sensor, f"black body, {scale}"] = body / rates - 1
    sure = library.vi_mag < MAX_RELIABLE_VI_MAG
    figures = {key: np.percentile(100 * np.abs(error[sure]), (50, 95)) for key, error in errors.items()}
    text = "Median error of the electron rate (95 %), V-I < 2.5: " + "; ".join(
        f"{SENSORS[sensor].split()[0]} {real[0]:.1f} % ({real[1]:.1f} %) by real spectra and V-I,"
        f" {body[0]:.1f} % ({body[1]:.1f} %) by black bodies and B-V"
        for sensor in SENSORS
        for real, body in [(figures[sensor, HELD_OUT], figures[sensor, "black body, ballesteros2012"])]
    )
    real, body = (max(figures[s, name][1] for s in SENSORS) for name in (HELD_OUT, "black body, ballesteros2012"))
    late = ~sure & np.array([name.endswith("III") for name in library.spectral_type])
    of_late = {key: np.percentile(100 * np.abs(error[late]), 95) for key, error in errors.items()}
    text += "; late M giants (95 %), " + "; ".join(
        f"{SENSORS[sensor].split()[0]} {of_late[sensor, HELD_OUT]:.0f} % by V-I, {of_late[sensor, BY_TYPE]:.1f} % by MK type"
        f" (others {figures[sensor, BY_TYPE][1]:.1f} %)"
        for sensor in SENSORS
    )
    finding = (
        f"Real spectra by V-I give the electron rate within {real:.1f} % for 95 % of stars to V-I = {MAX_RELIABLE_VI_MAG:g},"
        f" black bodies by B-V within {body:.0f} %"
    )
    note = f"A mark a Pickles spectrum, each held out in turn; {(~sure).sum()} are redder than the dashed line."
    with chart(directory / "spectra", finding, panels=2, note=note) as panels:
        for axes, sensor in zip(panels, SENSORS, strict=True):
            named = [(name, error) for (owner, name), error in errors.items() if owner == sensor]
            for (name, error), mark, colour in zip(reversed(named), "+x^o", (GREEN, ORANGE, INK, BLUE), strict=True):
                axes.plot(library.vi_mag, 100 * error, mark, color=colour, ms=4, label=name)
            axes.axvline(MAX_RELIABLE_VI_MAG, color=MUTED, lw=1, ls="--")
            axes.axhline(0, color=INK, lw=1)
            axes.set_yscale("symlog", linthresh=5)
            axes.set(ylabel="error of the electron rate [%]", title=SENSORS[sensor])
            axes.set_ylim(-130, 50_000)
            plain_ticks(axes.yaxis, (-50, -10, 0, 10, 50, 200))
        panels[-1].set(xlabel="V-I [mag]")
        panels[0].legend(loc="upper right")
    columns = ("spectral_type", "bv_mag", "vi_mag", *(f"{s}: {n} [%]" for s, n in errors))
    table = zip(library.spectral_type, library.bv_mag, library.vi_mag, *(100 * e for e in errors.values()), strict=True)
    write_csv(directory / "spectra.csv", columns, table)
    return ChartFinding("spectra", text)


def zero_points(directory: Path) -> ChartFinding:
    """Electrons of a V = 0 star of 9602 K by zero point and weighting."""
    rates = {
        sensor: np.array([dgs_electrons_per_s(REFERENCE_TEMPERATURE_K, study_optics(sensor), p) for p in SETTINGS])
        for sensor in SENSORS
    }
    mag = {sensor: magnitude(rate / rate[0]) for sensor, rate in rates.items()}
    base, cost = rates["ccd47-20"], mag["ccd47-20"]
    text = (
        f"A V = 0 star of 9602 K gives {base[0] / 1e6:.1f} million electrons/s by Vega's flux (CCD47-20, 30 mm),"
        f" {100 * (1 - base[2] / base[0]):.0f} % ({cost[2]:.2f} mag) fewer by the IAU's bolometric zero point"
    )
    with chart(directory / "zero_points", text, panels=2) as (upper, lower):
        place = np.arange(len(SETTINGS))
        for k, ((sensor, name), colour) in enumerate(zip(SENSORS.items(), (BLUE, ORANGE), strict=True)):
            for axes, height, figure in ((upper, rates[sensor] / 1e6, "%.2f"), (lower, mag[sensor], "%+.3f")):
                bars = axes.bar(place + 0.4 * k - 0.2, height, 0.38, color=colour, label=name)
                axes.bar_label(bars, fmt=figure, padding=2, fontsize=SMALL_PT)
        upper.set(ylabel="electrons a second [millions]", ylim=(0, 1.3 * base.max() / 1e6))
        low, high = min(0.0, *(m.min() for m in mag.values())), max(m.max() for m in mag.values())
        limits = (low - 0.15 * (high - low), high + 0.4 * (high - low))  # with room for figures and names
        lower.set_xticks(place, [f"{p.zero_point},\n{p.weighting} weighting" for p in SETTINGS])
        lower.set(ylabel="fainter than vega, energy [mag]", xlabel="zero point, weighting of the passband", ylim=limits)
        for axes in (upper, lower):
            axes.grid(visible=False, axis="x")
            axes.legend(loc="upper left", ncols=2)
    rows = [
        (sensor, p.zero_point, p.weighting, float(rate), float(m))
        for sensor in SENSORS
        for p, rate, m in zip(SETTINGS, rates[sensor], mag[sensor], strict=True)
    ]
    columns = ("sensor", "zero_point", "weighting", "electrons_per_s", "mag_against_default")
    write_csv(directory / "zero_points.csv", columns, rows)
    return ChartFinding("zero_points", text)


def temperature_scales(directory: Path) -> ChartFinding:
    """The scales that a bench file can choose, beside Torres 2010, and their error in electrons."""
    bv = np.union1d(SCALE_BV_MAG, -1e-9)  # both sides of wang2021's step
    torres, optics, photometry = torres2010_k(bv), study_optics("ccd47-20"), Photometry()
    base = dgs_electrons_per_s(torres, optics, photometry)
    kelvin = {"torres2010_supergiant": torres2010_k(bv, supergiant=True)}
    kelvin |= {name: scale(bv) for name, scale in TEMPERATURE_SCALES.items()}
    percent = {name: 100 * (t / torres - 1) for name, t in kelvin.items()}
    mag = {name: magnitude(dgs_electrons_per_s(t, optics, photometry) / base) for name, t in kelvin.items()}
    stars_bv = load_catalog().brighter_than(BRIGHT_V_MAG).bv_mag
    stars_bv = stars_bv[(stars_bv >= bv[0]) & (stars_bv <= bv[-1])]
    within = {n: np.percentile(np.abs(np.interp(stars_bv, bv, mag[n])), (50, 95)) for n in TEMPERATURE_SCALES}
    zero, wang = int(np.searchsorted(bv, 0.0)), kelvin["wang2021"]
    step_k = wang[zero - 1] - wang[zero]
    text = (
        f"wang2021 steps down by {step_k:.0f} K ({100 * step_k / wang[zero - 1]:.1f} %) at B-V = 0; half of"
        " Hipparcos to V = 7.5 (95 %) is within "
        + ", ".join(f"{half:.3f} ({most:.2f}) mag by {name}" for name, (half, most) in within.items())
        + " of Torres 2010"
    )
    finding = f"The scale wang2021 steps down by {step_k:.0f} K at B-V = 0; half of Hipparcos is within " + ", ".join(
        f"{half:.3f} mag by {name}" for name, (half, _) in within.items()
    )
    note = "Torres 2010 (Flower 1996) for dwarfs and giants is the reference. Electrons: CCD47-20, + is fainter."
    groups = {"k": kelvin, "percent": percent, "mag": mag}
    with chart(directory / "temperature_scales", f"{finding} of Torres 2010", panels=3, note=note) as panels:
        panels[0].plot(bv, torres, color=INK, label="Torres 2010")
        for axes, values in zip(panels, groups.values(), strict=True):
            for (name, value), style, colour in zip(values.items(), (":", "-", "-"), (MUTED, BLUE, ORANGE), strict=True):
                words = name.replace("torres2010_supergiant", "Torres, supergiants")
                axes.plot(bv, value, style, color=colour, label=words)
        for axes in panels[1:]:
            axes.axhline(0, color=INK, lw=1)
        panels[0].set(yscale="log", ylabel="temperature [K]")
        panels[1].set(ylabel="difference [%]")
        panels[2].set(xlabel="B-V [mag]", ylabel="difference in electrons [mag]")
        label_ends(*panels)
    columns = ("bv_mag", "torres2010_k", *(f"{name}_{unit}" for unit, values in groups.items() for name in values))
    table = np.column_stack((bv, torres, *(value for values in groups.values() for value in values.values())))
    write_csv(directory / "temperature_scales.csv", columns, table.tolist())
    return ChartFinding("temperature_scales", text)


def rapp(directory: Path, sensor: str) -> ChartFinding:
    """The three ratios of a sensor, 3000 to 50 000 K, for both passband weightings."""
    kelvin = np.union1d(np.geomspace(3000, 50_000, 400)[1:-1], QUOTED_K)
    optics = study_optics(sensor)
    ratios = {weighting: rapp_ratios(kelvin, optics, weighting) for weighting in WEIGHTINGS}
    in_full_range = rapp_ratios(kelvin[-1:], study_optics("ccd47-20"), "energy")  # which the range of wavelengths alone makes
    coolest, cool, hot, hottest = ratios["energy"][2][np.searchsorted(kelvin, QUOTED_K)]
    text = (
        f"{SENSORS[sensor]}: the spectral model gives {coolest:.2f} times the electrons of the average one at 3000 K,"
        f" {cool:.2f} at 5000 K; at 9000 K they differ by {100 * (hot - 1):+.1f} %, at 50000 K by {100 * (hottest - 1):+.1f} %"
        + SAID_OF_THESIS[sensor].format(ratios["energy"][0, -1], in_full_range[0, 0])
    )
    title = (
        f"{SENSORS[sensor]}: a black body of 3000 K gives {coolest:.2f} times the electrons of the average model,"
        f" one of 5000 K {cool:.2f} times"
    )
    low_nm, high_nm = optics.range_nm
    note = f"DGS over AGS at one V, {low_nm:.0f} to {high_nm:.0f} nm. Solid: energy weighting; dotted: photon (source)."
    with chart(directory / f"rapp_{sensor}", title, note=note) as (axes,):
        for k, (name, colour) in enumerate(zip(("irradiance", "photons", "electrons"), SERIES, strict=False)):
            axes.loglog(kelvin, ratios["energy"][k], color=colour, label=name)
            axes.loglog(kelvin, ratios["photon"][k], ":", color=colour, label="_photon weighting")
        axes.axhline(1, color=MUTED, lw=1)
        axes.set(xlabel="black-body temperature [K]", ylabel="ratio of the models [1]")
        plain_ticks(axes.xaxis, (3000, 5000, 9000, 15_000, 30_000, 50_000))
        label_ends(axes)
    columns = ("temperature_k", *(f"rapp{k}_{weighting}" for weighting in WEIGHTINGS for k in (1, 2, 3)))
    table = np.column_stack((kelvin, *(ratios[weighting][k] for weighting in WEIGHTINGS for k in range(3))))
    write_csv(directory / f"rapp_{sensor}.csv", columns, table.tolist())
    return ChartFinding(f"rapp_{sensor}", text)


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


def choices(directory: Path) -> ChartFinding:
    """The cost of each choice in magnitudes, over B-V and for the stars of Hipparcos."""
    optics, stars = study_optics("ccd47-20"), load_catalog().brighter_than(BRIGHT_V_MAG)
    cost = choice_costs_mag(BV_MAG, optics)
    real = tabulate_pickles(optics, Photometry()).electrons_per_s(np.zeros(len(stars)), stars.bv_mag, stars.vi_mag)
    body = dgs_electrons_per_s(star_temperatures_k(stars.bv_mag, "ballesteros2012"), optics, Photometry())
    on_stars = choice_costs_mag(stars.bv_mag, optics) | {"spectrum pickles": magnitude(real / body)}
    low, middle, high, _ = percentiles = running_percentiles(stars.bv_mag, on_stars["spectrum pickles"], BV_MAG)
    paid = {name: np.percentile(np.abs(mag), (50, 95)) for name, mag in on_stars.items()}
    text = "What each choice costs half of Hipparcos to V = 7.5 (95 %), CCD47-20, mag: " + ", ".join(
        f"{name.split()[-1]} {half:.2f} ({most:.2f})" for name, (half, most) in paid.items()
    )
    dearest = max(paid, key=lambda name: paid[name][1])
    finding = (
        f"Of the choices of brightness {dearest.split()[-1]} changes most: half of Hipparcos to V = {BRIGHT_V_MAG:g} by"
        f" {paid[dearest][0]:.2f} mag and more, a twentieth by {paid[dearest][1]:.2f} mag"
    )
    note = f"Band: 5 to 95 % of {len(stars)} Hipparcos stars. M giants share the B-V of K giants, and are up to"
    note += f" {-np.nanmin(low):.1f} mag brighter than the black body. + is fainter; CCD47-20."
    with chart(directory / "choices", finding, panels=2, note=note) as (upper, lower):
        for (name, mag), colour in zip(cost.items(), SERIES, strict=False):
            upper.plot(BV_MAG, mag, color=colour, label=name.split()[-1])
        for axes in (upper, lower):
            axes.plot(BV_MAG, middle, color=INK, label="pickles, median")
            axes.axhline(0, color=MUTED, lw=1)
            axes.set(ylabel="cost against a black body [mag]")
        lower.fill_between(BV_MAG, low, high, color=MUTED, alpha=0.35, lw=0)
        lower.set(xlabel="B-V [mag]")
        label_ends(upper, lower)
    columns = ("bv_mag", *(f"{n.replace(' ', '_')}_mag" for n in cost))
    columns += ("pickles_p5_mag", "pickles_median_mag", "pickles_p95_mag", "stars_in_window")
    write_csv(directory / "choices.csv", columns, np.column_stack((BV_MAG, *cost.values(), *percentiles)).tolist())
    return ChartFinding("choices", text)


def choice_costs_mag(bv_mag: FloatArray, optics: Optics) -> dict[str, FloatArray]:
    """The cost of each choice, mag (n,), against a black body by ballesteros2012, vega and energy; + is fainter."""
    default = Photometry()
    kelvin = star_temperatures_k(bv_mag, "ballesteros2012")
    rates = {
        "temperature wang2021": dgs_electrons_per_s(star_temperatures_k(bv_mag, "wang2021"), optics, default),
        "weighting photon": dgs_electrons_per_s(kelvin, optics, Photometry("vega", "photon")),
        "zero point iau-bolometric": dgs_electrons_per_s(kelvin, optics, Photometry("iau-bolometric")),
        "brightness ags": np.full_like(bv_mag, ags_electrons_per_s(optics, default)),
    }
    base = dgs_electrons_per_s(kelvin, optics, default)
    return {name: magnitude(rate / base) for name, rate in rates.items()}


def running_percentiles(bv_mag: FloatArray, value: FloatArray, at_bv_mag: FloatArray) -> FloatArray:
    """5, 50 and 95 % of `value` (n,) within WINDOW_MAG of each colour, and the count, shape (4, m).

    NaN where there are fewer than MIN_STARS.
    """
    rows = np.full((4, len(at_bv_mag)), np.nan)
    for k, centre in enumerate(at_bv_mag):
        inside = value[np.abs(bv_mag - centre) <= WINDOW_MAG]
        rows[3, k] = len(inside)
        if len(inside) >= MIN_STARS:
            rows[:3, k] = np.percentile(inside, (5, 50, 95))
    return rows


def run(directory: Path) -> list[ChartFinding]:
    """Write every chart and its table (CSV) into `directory`, and `findings.csv`. Raises InputError."""
    findings = [rapp(directory, sensor) for sensor in SENSORS]
    findings += [chart_of(directory) for chart_of in (temperature_scales, zero_points, choices, spectra, *FIGURES)]
    write_csv(directory / "findings.csv", ("figure", "finding"), [(f.figure, f.text) for f in findings])
    return findings
