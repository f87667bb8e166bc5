"""The study of brightness models: DGS against AGS, temperature scales, zero points, black bodies
against real spectra.

Charts: figures 5.19 and 5.22 of the thesis (RAPP); temperatures against Torres 2010; the electrons
of a star of V = 0 by zero point and passband weighting; the cost of each choice over B-V and for
Hipparcos; spectra against the library's own.

Then figures of the thesis's chapters 2 to 5 that need no simulation, each with the thesis's value
beside the one here.
"""

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from msgspec import structs

from hilstar.basics.arrays import FloatArray
from hilstar.basics.charts import (
    BLUE,
    GREEN,
    INK,
    MUTED,
    ORANGE,
    PURPLE,
    SERIES,
    SMALL_PT,
    chart,
    label_ends,
    plain_ticks,
    two_digits,
    write_csv,
)
from hilstar.basics.units import LIGHT_M_S, flux_ratio, magnitude
from hilstar.instruments.study.rapp import SENSORS, WEIGHTINGS, ChartFinding, rapp
from hilstar.instruments.study.row_charts import (
    CurvePanel,
    PanelSpec,
    draw_curve_panel,
    draw_curves,
    write_columns,
)
from hilstar.instruments.study.sky_figures import FIGURES as SKY_FIGURES
from hilstar.instruments.study.study_benches import (
    APERTURE_MM,
    MAX_RELIABLE_VI_MAG,
    held_out_by_type,
    held_out_errors,
    study_optics,
)
from hilstar.sky.catalog import Catalog, load_catalog
from hilstar.sky.electrons import (
    REFERENCE_TEMPERATURE_K,
    SUN_TEMPERATURE_K,
    Optics,
    Photometry,
    ags_electrons_per_s,
    dgs_electrons_per_s,
    library_electrons_per_s,
    load_library,
    star_temperatures_k,
    tabulate_pickles,
    v_band_mean_w_m2_m,
)
from hilstar.sky.facts import facts_of
from hilstar.sky.spectral_types import bare_and_dusty
from hilstar.sky.spectrum import (
    DATA_DIR,
    PLANCK_J_S,
    TEMPERATURE_SCALES,
    Curve,
    blackbody_exitance_w_m2_m,
    load_curve,
    read_curve_csv,
    torres2010_k,
)
from hilstar.sky.synthetic import VEGA_V_MAG, ZERO_W_M2_M, curve_mean, vega
from hilstar.sky.zodiacal import NEAR_SLOPES, relative_spectrum
from hilstar.tracker.settings import DetectorSettings

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap

# Table 2.3, whose medians are those of stars to about V = 9: unit and value by the fact's name.
TABLE_2_3 = {
    "sigma_bv_mag": ("mag", 0.0281),
    "sigma_ra_mas": ("mas", 0.77),
    "sigma_dec_mas": ("mas", 0.64),
    "sigma_parallax_mas": ("mas", 0.97),
    "sigma_pm_ra_mas_yr": ("mas/yr", 0.88),
    "sigma_pm_dec_mas_yr": ("mas/yr", 0.74),
}
NAMES_2_3 = (
    "B-V, mean",
    "right ascension",
    "declination",
    "parallax",
    "motion in RA",
    "motion in Dec",
)
TABLE_2_3_V_MAG = 9.0
CLIPPED_TIMES = 4  # errors over so many times the thesis's are drawn at the edge
# Table 2.2: V and B-V from the ground, from Hipparcos, from Tycho; of all 118 218 rows.
TABLE_2_2 = {"G": (23_139, 41_205), "H": (94_669, 0), "T": (409, 75_732)}
# Table 2.5: flux of magnitude 0 by Johnson and by Bessell, erg/s/cm2/A, and Bessell's effective
# wavelength, nm.
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
BRIGHT_V_MAG = 7.5
HELD_OUT = "pickles, leave-one-out"
BY_TYPE = "mk, leave-one-out"
SETTINGS = [
    Photometry(zero, weighting) for zero in ("vega", "iau-bolometric") for weighting in WEIGHTINGS
]
# where Torres 2010 holds; exact at 0, where wang2021 steps
SCALE_BV_MAG = np.arange(-35, 181) / 100
BV_MAG = np.arange(-30, 201) / 100
WINDOW_MAG = 0.05  # half the width of the running percentiles in B-V
MIN_STARS = 20


def catalogue_errors(directory: Path) -> ChartFinding:
    """Figures 2.3 to 2.8 and tables 2.2 and 2.3: the errors of Hipparcos's figures, and where V
    and B-V are from.
    """
    catalog = load_catalog()
    facts = facts_of(catalog.hip)
    bright = catalog.v_mag < TABLE_2_3_V_MAG
    origins = [Counter(facts[name].tolist()) for name in ("v_source", "bv_source")]
    rows: list[tuple[str, str, float, float]] = []
    for source, both in TABLE_2_2.items():
        for what, count, stars in zip(("V", "B-V"), origins, both, strict=True):
            rows.append((f"{what} from {source}", "stars", count[source.encode()], stars))
    for name, (unit, printed) in TABLE_2_3.items():
        if name == "sigma_bv_mag":
            here = facts[name].mean()
        else:
            here = np.median(facts[name][bright])
        rows.append((name, unit, float(here), printed))
    write_csv(directory / "catalogue_errors.csv", ("what", "unit", "here", "thesis"), rows)
    medians = {name: here for name, _, here, _ in rows if name in TABLE_2_3}
    largest = max(abs(medians[name] - printed) for name, (_, printed) in TABLE_2_3.items())
    text = (
        f"Hipparcos's errors: B-V {medians['sigma_bv_mag']:.4f} mag (thesis: 0.0281), places"
        f" {medians['sigma_ra_mas']:.2f} and {medians['sigma_dec_mas']:.2f} mas (0.77, 0.64); all"
        f" of table 2.3 within {largest:.3f}"
    )
    draw_catalogue_errors(directory / "catalogue_errors", text, catalog, medians)
    return ChartFinding("catalogue_errors", text)


def draw_catalogue_errors(
    path: Path,
    text: str,
    catalog: Catalog,
    medians: Mapping[str, float],
) -> None:
    """Each error against the figure that it is of, with its median and the thesis's, and maps."""
    facts = facts_of(catalog.hip)
    against = measured_values(catalog)
    largest = max(abs(medians[name] - printed) for name, (_, printed) in TABLE_2_3.items())
    note = (
        f"Density of all {len(catalog)} stars; errors over {CLIPPED_TIMES} times the thesis's stand"
        " at the top edge. Solid: the figures above them, medians of stars to V ="
        f" {TABLE_2_3_V_MAG:g} (B-V: the mean of all). Dashed: the thesis's, within {largest:.3f}."
    )
    layout: dict[str, Any] = {"note": note, "share_x": False, "height_inch": 11.0}
    with chart(path, text, 4, 2, **layout) as panels:
        titles = dict(zip(TABLE_2_3, NAMES_2_3, strict=True))
        for axes, (name, (unit, printed)) in zip(panels, TABLE_2_3.items(), strict=False):
            value = against[name]
            high = CLIPPED_TIMES * printed
            style: dict[str, Any] = {"cmap": density(), "norm": "log", "rasterized": True}
            style |= {"bins": (120, 60), "range": (value.limits, (0.0, high))}
            axes.hist2d(value.of_star, np.minimum(facts[name], high), **style)
            axes.set(ylabel=f"error [{unit}]", xlabel=value.label)
            axes.set_title(f"{titles[name]}: {two_digits(medians[name])} {unit}")
            axes.axhline(medians[name], color=INK, label="_here")
            axes.axhline(printed, color=MUTED, ls="--", label="_thesis")
        for axes, name in zip(panels[6:], ("sigma_ra_mas", "sigma_dec_mas"), strict=True):
            sky_map(axes, catalog, name, facts[name])


@dataclass(frozen=True, slots=True)
class MeasuredValue:
    """A figure of the catalogue's stars (n,), the label of its axis, and the limits that are
    drawn.
    """

    of_star: FloatArray
    label: str
    limits: tuple[float, float]


def measured_values(catalog: Catalog) -> dict[str, MeasuredValue]:
    """The figure that each error of table 2.3 belongs to, by the error's name."""
    pm_ra = catalog.pm_ra_cosdec_mas_yr
    pm_dec = catalog.pm_dec_mas_yr
    return {
        "sigma_bv_mag": MeasuredValue(catalog.bv_mag, "B-V [mag]", (-0.4, 2.2)),
        "sigma_ra_mas": MeasuredValue(catalog.ra_deg, "right ascension [deg]", (0.0, 360.0)),
        "sigma_dec_mas": MeasuredValue(catalog.dec_deg, "declination [deg]", (-90.0, 90.0)),
        "sigma_parallax_mas": MeasuredValue(catalog.parallax_mas, "parallax [mas]", (-5.0, 40.0)),
        "sigma_pm_ra_mas_yr": MeasuredValue(pm_ra, "motion in RA [mas/yr]", (-200.0, 200.0)),
        "sigma_pm_dec_mas_yr": MeasuredValue(pm_dec, "motion in Dec [mas/yr]", (-200.0, 200.0)),
    }


def density() -> "Colormap":
    """From clear to blue, on light pages and on dark ones."""
    from matplotlib.colors import LinearSegmentedColormap, to_rgba

    return LinearSegmentedColormap.from_list("density", [to_rgba(BLUE, 0.06), to_rgba(BLUE, 1.0)])


def sky_map(axes: "Axes", catalog: Catalog, name: str, error_mas: FloatArray) -> None:
    """The median of an error over the sky, which Hipparcos scanned about the ecliptic's poles."""
    ra_edges = np.linspace(0, 360, 73)
    dec_edges = np.degrees(np.arcsin(np.linspace(-1, 1, 37)))
    column = np.digitize(catalog.ra_deg, ra_edges) - 1
    row = np.digitize(catalog.dec_deg, dec_edges) - 1
    medians = np.full((len(dec_edges) - 1, len(ra_edges) - 1), np.nan)
    for at in np.unique(row * medians.shape[1] + column):
        cell = divmod(int(at), medians.shape[1])
        medians[cell] = np.median(error_mas[(row == cell[0]) & (column == cell[1])])
    style: dict[str, Any] = {"cmap": density(), "vmin": 0.5, "vmax": 1.3, "rasterized": True}
    image = axes.pcolormesh(ra_edges, dec_edges, medians, **style)
    title = f"Sky map: {NAMES_2_3[list(TABLE_2_3).index(name)]}, medians"
    axes.set(title=title, xlabel="right ascension [deg]", ylabel="declination [deg]")
    axes.figure.colorbar(image, ax=axes, label="Error [mas]", fraction=0.06, pad=0.02)


def passbands(directory: Path) -> ChartFinding:
    """Figures 2.12, 2.13 and 3.7, and table 2.5: UBVRI, Vega, and the black body that the thesis
    takes for it.
    """
    light = vega()
    curves = {}
    for b in TABLE_2_5:
        curves[b] = read_curve_csv(DATA_DIR / f"{'johnson' if b == 'v' else 'bessell'}-{b}.csv")
    in_v = curve_mean(light, curves["v"])
    scale = ZERO_W_M2_M["v"] / in_v  # a star with Vega's spectrum and V = 0
    rows = []
    for band, (johnson, bessell, printed_nm) in TABLE_2_5.items():
        weighted = Curve(
            light.wavelength_nm, light.value * light.wavelength_nm / light.wavelength_nm.max()
        )
        effective = (
            curve_mean(weighted, curves[band])
            / curve_mean(light, curves[band])
            * light.wavelength_nm.max()
        )
        rows.append(
            (
                band.upper(),
                effective,
                printed_nm,
                scale * curve_mean(light, curves[band]) / ERG_S_CM2_A,
                bessell,
                johnson,
            )
        )
    columns = (
        "band",
        "effective_nm",
        "thesis_effective_nm",
        "vega_v0",
        "thesis_bessell",
        "thesis_johnson",
    )
    write_csv(directory / "passbands.csv", columns, rows)
    off = max(abs(row[3] / row[4] - 1) for row in rows)
    nm = np.arange(300.0, 1101.0)
    body = blackbody_exitance_w_m2_m(nm, REFERENCE_TEMPERATURE_K) / v_band_mean_w_m2_m(
        REFERENCE_TEMPERATURE_K, "energy"
    )
    shown = {"Vega": light(nm) / in_v, "black body, 9602 K": body}
    blue = float(shown["Vega"][50] / body[50])
    text = (
        f"Vega's spectrum at V = 0 has table 2.5's second fluxes within {100 * off:.1f} %;"
        f" at 350 nm it has {blue:.2f} of the black body of 9602 K"
    )
    note = (
        f"Vega: CALSPEC, V = {VEGA_V_MAG:g}; both scaled to one mean through V. Passbands: Bessell"
        " 1990."
    )
    with chart(directory / "passbands", text, panels=2, note=note) as (upper, lower):
        for (band, curve), colour in zip(
            curves.items(), (PURPLE, BLUE, GREEN, ORANGE, INK), strict=True
        ):
            upper.plot(curve.wavelength_nm, curve.value, color=colour, label="_")
            peak = curve.value.argmax()
            upper.annotate(
                band.upper(),
                (curve.wavelength_nm[peak], curve.value[peak]),
                va="bottom",
                ha="center",
                color=colour,
            )
        upper.set(ylabel="response [1]", ylim=(0, 1.15))
        spec = PanelSpec((), "relative F_lambda [1]", "wavelength [nm]", legend={})
        draw_curve_panel(lower, CurvePanel(nm, shown, spec, (INK, ORANGE)))
    columns_nm = {"wavelength_nm": nm, "vega": shown["Vega"], "blackbody_9602_k": body}
    write_columns(directory / "vega.csv", columns_nm)
    return ChartFinding("passbands", text)


def curves(directory: Path) -> ChartFinding:
    """Figures 5.1, 5.2, 5.20 and 5.21: sensors, glass, and the black bodies that they see."""
    names = ("ccd47-20", "kai-4021", "n-bk7-10mm")
    loaded = {name: load_curve(name, name) for name in names}
    labels = {}
    for name, curve in loaded.items():
        first_nm, last_nm = curve.wavelength_nm[[0, -1]]
        peak_nm = curve.wavelength_nm[curve.value.argmax()]
        labels[name] = f"{first_nm:.0f} to {last_nm:.0f} nm, most at {peak_nm:.0f}"
    text = f"The CCD47-20 sees {labels['ccd47-20']}; the approximate KAI-4021 {labels['kai-4021']}"
    note = (
        "CCD47-20: ULTRACAM's red arm, not the thesis's midband coating. KAI-4021: recalled, not"
        " digitised. Lines: V."
    )
    nm = np.arange(300.0, 1101.0, 2.0)
    kelvin = (3000.0, 5000.0, 9000.0, 30_000.0)
    bodies = [blackbody_exitance_w_m2_m(nm, temperature_k) for temperature_k in kelvin]
    bodies = [temperature_k / temperature_k.max() for temperature_k in bodies]
    v = load_curve("johnson-v", "johnson-v").wavelength_nm
    of_sensors = {name: curve(nm) for name, curve in loaded.items()}
    of_bodies = {
        f"{temperature_k:.0f} K": body for temperature_k, body in zip(kelvin, bodies, strict=True)
    }
    edges = PanelSpec((), "exitance over its largest [1]", "wavelength [nm]")
    with chart(directory / "curves", text, panels=2, note=note) as (upper, lower):
        spec = PanelSpec((), "electrons a photon, transmission [1]")
        draw_curve_panel(upper, CurvePanel(nm, of_sensors, spec))
        draw_curve_panel(lower, CurvePanel(nm, of_bodies, edges))
        for edge in (v[0], v[-1]):
            lower.axvline(edge, color=MUTED, lw=1)
    columns = {
        f"blackbody_{temperature_k:.0f}_k": body
        for temperature_k, body in zip(kelvin, bodies, strict=True)
    }
    write_columns(directory / "curves.csv", {"wavelength_nm": nm, **of_sensors, **columns})
    return ChartFinding("curves", text)


def detector_laws(directory: Path) -> ChartFinding:
    """Equation 4.12 and figures 4.12 and 4.15: dark current by temperature, read noise by
    readout frequency.
    """
    kelvin = np.arange(230.0, 300.5, 1.0)
    hz = np.geomspace(1e4, 1e7, 61)
    dark = {}
    for name, law in DARK_LAWS.items():
        detectors = [
            structs.replace(TABLE_4_2_DARK, temperature_k=t, **law) for t in kelvin.tolist()
        ]
        dark[name] = np.array([203 * detector.dark_factor for detector in detectors])
    read = {}
    for corner_hz in CORNERS_HZ:
        detector = structs.replace(TABLE_4_2_DARK, read_noise_corner_hz=corner_hz)
        detectors = [structs.replace(detector, readout_hz=f) for f in hz.tolist()]
        read[corner_hz] = np.array([detector.read_noise_now_e for detector in detectors])
    at = {name: float(values[kelvin == COLD_K][0]) for name, values in dark.items()}
    text = (
        f"Of 203 e-/s at 293 K (table 4.2) {COLD_K:.0f} K leaves {at['e2v AIMO']:.0f} by e2v's AIMO"
        f" law, {at['e2v NIMO']:.0f} by its NIMO law, {at['Arrhenius, 0.56 eV']:.0f} by Arrhenius"
        " with half of silicon's gap"
    )
    note = (
        "e2v's constants were seen in public code, not on a data sheet. Read noise: 2 e- at 1 MHz,"
        " white and 1/f noise."
    )
    upper = PanelSpec((), "dark current [e-/s]", "temperature [K]", scales=("linear", "log"))
    lower = PanelSpec((), "read noise [e-]", "readout frequency [Hz]", scales=("log", "log"))
    by_corner = {f"1/f corner {corner / 1e3:g} kHz": noise for corner, noise in read.items()}
    panels = CurvePanel(kelvin, dark, upper), CurvePanel(hz, by_corner, lower)
    draw_curves(directory / "detector_laws", text, panels, note)
    write_columns(directory / "detector_laws.csv", {"temperature_k": kelvin, **dark})
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
        f"Zodiacal light of V = {ZODIACAL_V_MAG:g} has {far:.1f} photons/s/m2/arcsec2 90 degrees"
        f" from the Sun (330 to 1100 nm), {near:.1f} at 30 degrees, {sun:.1f} as sunlight"
    )
    note = (
        f"V = {ZODIACAL_V_MAG:g}. Leinert 1998, table 19 and equation 22, through Johnson V. The"
        " WFC3 handbook's spectrum, V = 22.15, gives 101.6."
    )
    with_totals = {f"{name}: {total[name]:.1f} in all": light for name, light in spectra.items()}
    spec = PanelSpec((), "photons/s/m2/arcsec2/nm", "wavelength [nm]", legend={})
    draw_curves(directory / "zodiacal", text, (CurvePanel(nm, with_totals, spec),), note)
    write_columns(directory / "zodiacal.csv", {"wavelength_nm": nm, **spectra})
    return ChartFinding("zodiacal", text)


FIGURES = (catalogue_errors, passbands, curves, detector_laws, zodiacal_spectrum)


def spectra(directory: Path) -> ChartFinding:
    """Black bodies and the Pickles relation, each star held out in turn, against the Pickles
    spectra over V-I.
    """
    library = load_library()
    photometry = Photometry()
    errors: dict[tuple[str, str], FloatArray] = {}  # relative, of each star, by sensor and method
    for sensor in SENSORS:
        optics = study_optics(sensor)
        rates = library_electrons_per_s(library, optics, photometry)
        errors[sensor, HELD_OUT] = held_out_errors(rates)
        errors[sensor, BY_TYPE] = held_out_by_type(
            library_electrons_per_s(bare_and_dusty(), optics, photometry)
        )[: len(rates)]
        for scale in TEMPERATURE_SCALES:
            body = dgs_electrons_per_s(
                star_temperatures_k(library.bv_mag, scale), optics, photometry
            )
            errors[sensor, f"black body, {scale}"] = body / rates - 1
    sure = library.vi_mag < MAX_RELIABLE_VI_MAG
    figures = {
        key: np.percentile(100 * np.abs(error[sure]), (50, 95)) for key, error in errors.items()
    }
    by_sensor = []
    for sensor in SENSORS:
        real, real_95 = figures[sensor, HELD_OUT]
        body, body_95 = figures[sensor, "black body, ballesteros2012"]
        by_sensor.append(
            f"{SENSORS[sensor].split()[0]} {real:.1f} % ({real_95:.1f} %) by real spectra and V-I,"
            f" {body:.1f} % ({body_95:.1f} %) by black bodies and B-V"
        )
    text = f"Median error of the electron rate (95 %), V-I < 2.5: {'; '.join(by_sensor)}"
    worst_real = max(figures[sensor, HELD_OUT][1] for sensor in SENSORS)
    worst_body = max(figures[sensor, "black body, ballesteros2012"][1] for sensor in SENSORS)
    late = ~sure & np.array([name.endswith("III") for name in library.spectral_type])
    of_late = {key: np.percentile(100 * np.abs(error[late]), 95) for key, error in errors.items()}
    text += "; late M giants (95 %), " + "; ".join(
        f"{SENSORS[sensor].split()[0]} {of_late[sensor, HELD_OUT]:.0f} % by V-I,"
        f" {of_late[sensor, BY_TYPE]:.1f} % by MK type (others {figures[sensor, BY_TYPE][1]:.1f} %)"
        for sensor in SENSORS
    )
    finding = (
        f"Real spectra by V-I give the electron rate within {worst_real:.1f} % for 95 % of stars to"
        f" V-I = {MAX_RELIABLE_VI_MAG:g}, black bodies by B-V within {worst_body:.0f} %"
    )
    note = (
        f"A mark a Pickles spectrum, each held out in turn; {(~sure).sum()} are redder than the"
        " dashed line."
    )
    with chart(directory / "spectra", finding, panels=2, note=note) as panels:
        for axes, sensor in zip(panels, SENSORS, strict=True):
            named = [(name, error) for (owner, name), error in errors.items() if owner == sensor]
            for (name, error), mark, colour in zip(
                reversed(named), "+x^o", (GREEN, ORANGE, INK, BLUE), strict=True
            ):
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
    table = zip(
        library.spectral_type,
        library.bv_mag,
        library.vi_mag,
        *(100 * e for e in errors.values()),
        strict=True,
    )
    write_csv(directory / "spectra.csv", columns, table)
    return ChartFinding("spectra", text)


def zero_points(directory: Path) -> ChartFinding:
    """Electrons of a V = 0 star of 9602 K by zero point and weighting."""
    rates = {}
    for sensor in SENSORS:
        optics = study_optics(sensor)
        of_settings = [dgs_electrons_per_s(REFERENCE_TEMPERATURE_K, optics, p) for p in SETTINGS]
        rates[sensor] = np.array(of_settings)
    mag = {sensor: magnitude(rate / rate[0]) for sensor, rate in rates.items()}
    base = rates["ccd47-20"]
    cost = mag["ccd47-20"]
    text = (
        f"A V = 0 star of 9602 K gives {base[0] / 1e6:.1f} million electrons/s by Vega's flux"
        f" (CCD47-20, 30 mm), {100 * (1 - base[2] / base[0]):.0f} % ({cost[2]:.2f} mag) fewer by"
        " the IAU's bolometric zero point"
    )
    note = f"A black body of {REFERENCE_TEMPERATURE_K:.0f} K, V = 0, behind {APERTURE_MM:g} mm."
    with chart(directory / "zero_points", text, panels=2, note=note) as (upper, lower):
        place = np.arange(len(SETTINGS))
        for k, ((sensor, name), colour) in enumerate(
            zip(SENSORS.items(), (BLUE, ORANGE), strict=True)
        ):
            for axes, height, figure in (
                (upper, rates[sensor] / 1e6, "%.2f"),
                (lower, mag[sensor], "%+.3f"),
            ):
                bars = axes.bar(place + 0.4 * k - 0.2, height, 0.38, color=colour, label=name)
                axes.bar_label(bars, fmt=figure, padding=2, fontsize=SMALL_PT)
        upper.set(ylabel="electrons a second [millions]", ylim=(0, 1.3 * base.max() / 1e6))
        low = min(0.0, *(m.min() for m in mag.values()))
        high = max(m.max() for m in mag.values())
        # with room for figures and names
        limits = (low - 0.15 * (high - low), high + 0.4 * (high - low))
        lower.set_xticks(place, [f"{p.zero_point},\n{p.weighting} weighting" for p in SETTINGS])
        lower.set(
            ylabel="fainter than vega, energy [mag]",
            xlabel="zero point, weighting of the passband",
            ylim=limits,
        )
        for axes in (upper, lower):
            axes.grid(visible=False, axis="x")
            axes.legend(loc="upper left", ncols=2)
    rows = []
    for sensor in SENSORS:
        for p, rate, cost_mag in zip(SETTINGS, rates[sensor], mag[sensor], strict=True):
            rows.append((sensor, p.zero_point, p.weighting, float(rate), float(cost_mag)))
    columns = ("sensor", "zero_point", "weighting", "electrons_per_s", "mag_against_default")
    write_csv(directory / "zero_points.csv", columns, rows)
    return ChartFinding("zero_points", text)


def temperature_scales(directory: Path) -> ChartFinding:
    """The scales that a bench file can choose, beside Torres 2010, and their error in electrons."""
    bv = np.union1d(SCALE_BV_MAG, -1e-9)  # both sides of wang2021's step
    torres = torres2010_k(bv)
    optics = study_optics("ccd47-20")
    photometry = Photometry()
    base = dgs_electrons_per_s(torres, optics, photometry)
    kelvin = {"torres2010_supergiant": torres2010_k(bv, supergiant=True)}
    kelvin |= {name: scale(bv) for name, scale in TEMPERATURE_SCALES.items()}
    percent = {name: 100 * (t / torres - 1) for name, t in kelvin.items()}
    mag = {
        name: magnitude(dgs_electrons_per_s(t, optics, photometry) / base)
        for name, t in kelvin.items()
    }
    stars_bv = load_catalog().brighter_than(BRIGHT_V_MAG).bv_mag
    stars_bv = stars_bv[(stars_bv >= bv[0]) & (stars_bv <= bv[-1])]
    within = {}
    for n in TEMPERATURE_SCALES:
        within[n] = np.percentile(np.abs(np.interp(stars_bv, bv, mag[n])), (50, 95))
    zero = int(np.searchsorted(bv, 0.0))
    wang = kelvin["wang2021"]
    step_k = wang[zero - 1] - wang[zero]
    text = (
        f"wang2021 steps down by {step_k:.0f} K ({100 * step_k / wang[zero - 1]:.1f} %) at B-V = 0;"
        " half of Hipparcos to V = 7.5 (95 %) is within "
        + ", ".join(
            f"{half:.3f} ({most:.2f}) mag by {name}" for name, (half, most) in within.items()
        )
        + " of Torres 2010"
    )
    finding = (
        f"The scale wang2021 steps down by {step_k:.0f} K at B-V = 0; half of Hipparcos is within "
        + ", ".join(f"{half:.3f} mag by {name}" for name, (half, _) in within.items())
    )
    note = (
        "Torres 2010 (Flower 1996) for dwarfs and giants is the reference. Electrons: CCD47-20, +"
        " is fainter."
    )
    groups = {"k": kelvin, "percent": percent, "mag": mag}
    with chart(
        directory / "temperature_scales", f"{finding} of Torres 2010", panels=3, note=note
    ) as panels:
        panels[0].plot(bv, torres, color=INK, label="Torres 2010")
        for axes, values in zip(panels, groups.values(), strict=True):
            for (name, value), style, colour in zip(
                values.items(), (":", "-", "-"), (MUTED, BLUE, ORANGE), strict=True
            ):
                label = name.replace("torres2010_supergiant", "Torres, supergiants")
                if axes is panels[2] and name in within:
                    label = f"{name}: half within {within[name][0]:.3f}"
                axes.plot(bv, value, style, color=colour, label=label)
        for axes in panels[1:]:
            axes.axhline(0, color=INK, lw=1)
        panels[0].set(yscale="log", ylabel="temperature [K]")
        panels[1].set(ylabel="difference [%]")
        panels[2].set(xlabel="B-V [mag]", ylabel="difference in electrons [mag]")
        label_ends(*panels)
    columns = (
        "bv_mag",
        "torres2010_k",
        *(f"{name}_{unit}" for unit, values in groups.items() for name in values),
    )
    table = np.column_stack(
        (bv, torres, *(value for values in groups.values() for value in values.values()))
    )
    write_csv(directory / "temperature_scales.csv", columns, table.tolist())
    return ChartFinding("temperature_scales", text)


def choices(directory: Path) -> ChartFinding:
    """The cost of each choice in magnitudes, over B-V and for the stars of Hipparcos."""
    optics = study_optics("ccd47-20")
    stars = load_catalog().brighter_than(BRIGHT_V_MAG)
    cost = choice_costs_mag(BV_MAG, optics)
    real = tabulate_pickles(optics, Photometry()).electrons_per_s(
        np.zeros(len(stars)), stars.bv_mag, stars.vi_mag
    )
    # a spectrum for each colour, of which there are few
    bv_mag, star = np.unique(stars.bv_mag, return_inverse=True)
    body = dgs_electrons_per_s(
        star_temperatures_k(bv_mag, "ballesteros2012"), optics, Photometry()
    )[star]
    on_stars = {name: mag[star] for name, mag in choice_costs_mag(bv_mag, optics).items()}
    on_stars["spectrum pickles"] = magnitude(real / body)
    low, middle, high, _ = percentiles = running_percentiles(
        stars.bv_mag, on_stars["spectrum pickles"], BV_MAG
    )
    paid = {name: np.percentile(np.abs(mag), (50, 95)) for name, mag in on_stars.items()}
    text = (
        "What each choice costs half of Hipparcos to V = 7.5 (95 %), CCD47-20, mag: "
        + ", ".join(
            f"{name.split()[-1]} {half:.2f} ({most:.2f})" for name, (half, most) in paid.items()
        )
    )
    finding = choices_finding(paid)
    note = (
        f"At a name: half of {len(stars)} Hipparcos stars change by as much (a twentieth). Band: 5"
        f" to 95 % of them. M giants share the B-V of K giants, and are up to {-np.nanmin(low):.1f}"
        " mag brighter than the black body. + is fainter; CCD47-20."
    )
    with chart(directory / "choices", finding, panels=2, note=note) as (upper, lower):
        for (name, mag), colour in zip(cost.items(), SERIES, strict=False):
            half, most = paid[name]
            upper.plot(
                BV_MAG, mag, color=colour, label=f"{name.split()[-1]}: {half:.2f} ({most:.2f})"
            )
        half, most = paid["spectrum pickles"]
        names = {upper: f"pickles: {half:.2f} ({most:.2f})", lower: "pickles, median"}
        for axes, name in names.items():
            axes.plot(BV_MAG, middle, color=INK, label=name)
            axes.axhline(0, color=MUTED, lw=1)
            axes.set(ylabel="cost against a black body [mag]")
        lower.fill_between(BV_MAG, low, high, color=MUTED, alpha=0.35, lw=0)
        lower.set(xlabel="B-V [mag]")
        label_ends(upper, lower)
    columns = ("bv_mag", *(f"{n.replace(' ', '_')}_mag" for n in cost))
    columns += ("pickles_p5_mag", "pickles_median_mag", "pickles_p95_mag", "stars_in_window")
    write_csv(
        directory / "choices.csv",
        columns,
        np.column_stack((BV_MAG, *cost.values(), *percentiles)).tolist(),
    )
    return ChartFinding("choices", text)


def choices_finding(paid: Mapping[str, FloatArray]) -> str:
    """Which choice changes half of the stars most, and which a twentieth; mag (2,) by choice."""
    dearest = max(paid, key=lambda name: float(paid[name][0]))
    for_few = max(paid, key=lambda name: float(paid[name][1]))
    half, most = paid[dearest]
    text = (
        f"Of the choices of brightness {dearest.split()[-1]} changes most: half of Hipparcos to"
        f" V = {BRIGHT_V_MAG:g} by {half:.2f} mag and more"
    )
    if for_few == dearest:
        return f"{text}, a twentieth by {most:.2f} mag"
    few = f"{for_few.split()[-1]}, by {paid[for_few][1]:.2f} mag"
    return f"{text}; a twentieth are changed most by {few}"


def choice_costs_mag(bv_mag: FloatArray, optics: Optics) -> dict[str, FloatArray]:
    """The cost of each choice, mag (n,), against a black body by ballesteros2012, vega and
    energy; + is fainter.
    """
    default = Photometry()
    kelvin = star_temperatures_k(bv_mag, "ballesteros2012")
    rates = {
        "temperature wang2021": dgs_electrons_per_s(
            star_temperatures_k(bv_mag, "wang2021"), optics, default
        ),
        "weighting photon": dgs_electrons_per_s(kelvin, optics, Photometry("vega", "photon")),
        "zero point iau-bolometric": dgs_electrons_per_s(
            kelvin, optics, Photometry("iau-bolometric")
        ),
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
    """Write every chart and its table (CSV) into `directory`, and `findings.csv`. Raises
    InputError.
    """
    findings = [rapp(directory, sensor) for sensor in SENSORS]
    findings += [
        chart_of(directory)
        for chart_of in (temperature_scales, zero_points, choices, spectra, *FIGURES, *SKY_FIGURES)
    ]
    write_csv(
        directory / "findings.csv", ("figure", "finding"), [(f.figure, f.text) for f in findings]
    )
    return findings
