"""The study of brightness models: DGS against AGS, temperature scales, zero points, black bodies
against real spectra.

Charts: figures 5.19 and 5.22 of the thesis (RAPP); temperatures against Torres 2010; the electrons
of a star of V = 0 by zero point and passband weighting; the cost of each choice over B-V and for
Hipparcos; spectra against the library's own.

Then figures of the thesis's chapters 2 to 5 that need no simulation, each with the thesis's value
beside the one here.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from msgspec import structs

from hilstar.basics.arrays import BoolArray, FloatArray
from hilstar.basics.charts import (
    BLUE,
    GREEN,
    INK,
    MUTED,
    ORANGE,
    PURPLE,
    SERIES,
    chart,
    label_ends,
    plain_ticks,
    two_digits,
    write_csv,
)
from hilstar.basics.units import LIGHT_M_S, flux_ratio, magnitude
from hilstar.instruments.study.engine import (
    HIDDEN,
    BarSpec,
    ChartFinding,
    ChartSpec,
    CurvePanel,
    LevelLine,
    PanelSpec,
    draw_curve_panel,
    draw_curves,
    draw_rows,
    looks_of,
    write_columns,
    write_findings,
    write_rows,
)
from hilstar.instruments.study.rapp import SENSORS, WEIGHTINGS, rapp
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
    ZeroPoint,
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
BODIES_K = (3000.0, 5000.0, 9000.0, 30_000.0)
BAND_COLOURS = (PURPLE, BLUE, GREEN, ORANGE, INK)
CORNERS_HZ = (0.0, 1e4, 1e5)  # of 1/f noise
ZODIACAL_V_MAG, ZODIACAL_NM = 22.1, (330.0, 1100.0)
BRIGHT_V_MAG = 7.5  # to which Hipparcos is complete
HELD_OUT = "pickles, leave-one-out"
BY_TYPE = "mk, leave-one-out"
BODY = "black body, ballesteros2012"
ZERO_POINTS: tuple[ZeroPoint, ...] = ("vega", "iau-bolometric")
SETTINGS = [Photometry(*setting) for setting in product(ZERO_POINTS, WEIGHTINGS)]
# where Torres 2010 holds; exact at 0, where wang2021 steps
SCALE_BV_MAG = np.arange(-35, 181) / 100
BV_MAG = np.arange(-30, 201) / 100
PERCENTILE_COLUMNS = ("pickles_p5_mag", "pickles_median_mag", "pickles_p95_mag", "stars_in_window")
# By the order in which methods are drawn, the last first.
SPECTRUM_MARKS = (("+", GREEN), ("x", ORANGE), ("^", INK), ("o", BLUE))
SUPERGIANTS = "torres2010_supergiant"
SCALE_STYLES, SCALE_COLOURS = (":", "-", "-"), (MUTED, BLUE, ORANGE)
ZERO_LINE = LevelLine(0, HIDDEN, style="-", width=1)
BAR = {"width": 0.38}
WINDOW_MAG = 0.05  # half the width of the running percentiles in B-V
MIN_STARS = 20  # 5 % of fewer is no star


@dataclass(frozen=True, slots=True)
class CatalogueFigure:
    """A figure of Hipparcos, here and as the thesis prints it."""

    what: str
    unit: str
    here: float
    thesis: float


@dataclass(frozen=True, slots=True)
class MeasuredValue:
    """A figure of the catalogue's stars (n,), its axis's label, and the drawn limits."""

    of_star: FloatArray
    label: str
    limits: tuple[float, float]


def catalogue_errors(directory: Path) -> ChartFinding:
    """Figures 2.3 to 2.8 and tables 2.2 and 2.3: the errors of Hipparcos's figures, and where V
    and B-V are from.
    """
    catalog = load_catalog()
    errors = catalogue_medians(catalog)
    counts = source_counts(catalog)
    write_rows(directory / "catalogue_errors.csv", [*counts, *errors])
    medians = {row.what: row.here for row in errors}
    largest = max(abs(row.here - row.thesis) for row in errors)
    places = f"{medians['sigma_ra_mas']:.2f} and {medians['sigma_dec_mas']:.2f} mas"
    text = (
        f"Hipparcos's errors: B-V {medians['sigma_bv_mag']:.4f} mag (thesis: 0.0281), places"
        f" {places} (0.77, 0.64); all of table 2.3 within {largest:.3f}"
    )
    draw_catalogue_errors(directory / "catalogue_errors", text, catalog, errors)
    return ChartFinding("catalogue_errors", text)


def source_counts(catalog: Catalog) -> list[CatalogueFigure]:
    """Table 2.2: how many stars have V and B-V from each source."""
    facts = facts_of(catalog.hip)
    v_sources = Counter(facts["v_source"].tolist())
    bv_sources = Counter(facts["bv_source"].tolist())
    rows = []
    for source, (v_stars, bv_stars) in TABLE_2_2.items():
        key = source.encode()
        of_v = CatalogueFigure(f"V from {source}", "stars", v_sources[key], v_stars)
        rows.append(of_v)
        of_bv = CatalogueFigure(f"B-V from {source}", "stars", bv_sources[key], bv_stars)
        rows.append(of_bv)
    return rows


def catalogue_medians(catalog: Catalog) -> list[CatalogueFigure]:
    """Table 2.3: the median errors of bright stars; of B-V the mean of all."""
    facts = facts_of(catalog.hip)
    bright = catalog.v_mag < TABLE_2_3_V_MAG
    rows = []
    for name, (unit, printed) in TABLE_2_3.items():
        if name == "sigma_bv_mag":
            here = facts[name].mean()
        else:
            here = np.median(facts[name][bright])
        rows.append(CatalogueFigure(name, unit, float(here), printed))
    return rows


def draw_catalogue_errors(
    path: Path, text: str, catalog: Catalog, errors: Sequence[CatalogueFigure]
) -> None:
    """Each error against the figure that it is of, with its median and the thesis's, and maps."""
    facts = facts_of(catalog.hip)
    against = measured_values(catalog)
    largest = max(abs(row.here - row.thesis) for row in errors)
    note = (
        f"Density of all {len(catalog)} stars; errors over {CLIPPED_TIMES} times the thesis's stand"
        " at the top edge. Solid: the figures above them, medians of stars to V ="
        f" {TABLE_2_3_V_MAG:g} (B-V: the mean of all). Dashed: the thesis's, within {largest:.3f}."
    )
    layout: dict[str, Any] = {"note": note, "share_x": False, "height_inch": 11.0}
    with chart(path, text, 4, 2, **layout) as panels:
        for axes, row, title in zip(panels[:6], errors, NAMES_2_3, strict=True):
            value = against[row.what]
            high = CLIPPED_TIMES * row.thesis
            style: dict[str, Any] = {"cmap": density(), "norm": "log", "rasterized": True}
            style |= {"bins": (120, 60), "range": (value.limits, (0.0, high))}
            errors_shown = np.minimum(facts[row.what], high)
            axes.hist2d(value.of_star, errors_shown, **style)
            axes.set(ylabel=f"error [{row.unit}]", xlabel=value.label)
            here = two_digits(row.here)
            axes.set_title(f"{title}: {here} {row.unit}")
            axes.axhline(row.here, color=INK, label="_here")
            axes.axhline(row.thesis, color=MUTED, ls="--", label="_thesis")
        for axes, name in zip(panels[6:], ("sigma_ra_mas", "sigma_dec_mas"), strict=True):
            sky_map(axes, catalog, name, facts[name])


def measured_values(catalog: Catalog) -> dict[str, MeasuredValue]:
    """The catalogue's figure behind each error of table 2.3, by the error's name."""
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
    """A colour map from clear to blue, for light and dark pages."""
    from matplotlib.colors import LinearSegmentedColormap, to_rgba

    clear = to_rgba(BLUE, 0.06)
    full = to_rgba(BLUE, 1.0)
    return LinearSegmentedColormap.from_list("density", [clear, full])


def sky_map(axes: "Axes", catalog: Catalog, name: str, error_mas: FloatArray) -> None:
    """A map of the median of an error; Hipparcos scanned the sky about the ecliptic's poles."""
    ra_edges = np.linspace(0, 360, 73)
    sines = np.linspace(-1, 1, 37)
    dec_edges = np.degrees(np.arcsin(sines))
    column = np.digitize(catalog.ra_deg, ra_edges) - 1
    row = np.digitize(catalog.dec_deg, dec_edges) - 1
    rows_and_columns = (len(dec_edges) - 1, len(ra_edges) - 1)
    medians = np.full(rows_and_columns, np.nan)
    cells = row * medians.shape[1] + column
    for at in np.unique(cells):
        cell_row, cell_column = divmod(int(at), medians.shape[1])
        in_cell = (row == cell_row) & (column == cell_column)
        medians[cell_row, cell_column] = np.median(error_mas[in_cell])
    style: dict[str, Any] = {"cmap": density(), "vmin": 0.5, "vmax": 1.3, "rasterized": True}
    image = axes.pcolormesh(ra_edges, dec_edges, medians, **style)
    place = list(TABLE_2_3).index(name)
    title = f"Sky map: {NAMES_2_3[place]}, medians"
    axes.set(title=title, xlabel="right ascension [deg]", ylabel="declination [deg]")
    axes.figure.colorbar(image, ax=axes, label="Error [mas]", fraction=0.06, pad=0.02)


@dataclass(frozen=True, slots=True)
class PassbandRow:
    """A band: its effective wavelength, nm, and Vega's flux through it, erg/s/cm2/A, here and as
    the thesis prints them.
    """

    band: str
    effective_nm: float
    thesis_effective_nm: float
    vega_v0: float
    thesis_bessell: float
    thesis_johnson: float


def passband_curves() -> dict[str, Curve]:
    """The responses of UBVRI by band."""
    responses = {}
    for band in TABLE_2_5:
        author = "johnson" if band == "v" else "bessell"
        responses[band] = read_curve_csv(DATA_DIR / f"{author}-{band}.csv")
    return responses


def passband_rows(responses: Mapping[str, Curve]) -> list[PassbandRow]:
    """Table 2.5 by Vega's spectrum, scaled to V = 0."""
    light = vega()
    johnson_v = curve_mean(light, responses["v"])
    scale = ZERO_W_M2_M["v"] / johnson_v
    longest_nm = light.wavelength_nm.max()
    by_nm = light.value * light.wavelength_nm / longest_nm
    by_wavelength = Curve(light.wavelength_nm, by_nm)
    rows = []
    for band, (johnson, bessell, printed_nm) in TABLE_2_5.items():
        mean = curve_mean(light, responses[band])
        weighted = curve_mean(by_wavelength, responses[band])
        effective_nm = weighted / mean * longest_nm
        flux = scale * mean / ERG_S_CM2_A
        rows.append(PassbandRow(band.upper(), effective_nm, printed_nm, flux, bessell, johnson))
    return rows


def passbands(directory: Path) -> ChartFinding:
    """Figures 2.12, 2.13 and 3.7, and table 2.5: UBVRI, Vega, and the black body that the thesis
    takes for it.
    """
    responses = passband_curves()
    rows = passband_rows(responses)
    write_rows(directory / "passbands.csv", rows)
    off = max(abs(row.vega_v0 / row.thesis_bessell - 1) for row in rows)
    nm = np.arange(300.0, 1101.0)
    light = vega()
    exitance = blackbody_exitance_w_m2_m(nm, REFERENCE_TEMPERATURE_K)
    body = exitance / v_band_mean_w_m2_m(REFERENCE_TEMPERATURE_K, "energy")
    vega_shown = light(nm) / curve_mean(light, responses["v"])
    shown = {"Vega": vega_shown, "black body, 9602 K": body}
    blue = float(shown["Vega"][50] / body[50])
    off_percent = 100 * off
    text = (
        f"Vega's spectrum at V = 0 has table 2.5's second fluxes within {off_percent:.1f} %;"
        f" at 350 nm it has {blue:.2f} of the black body of 9602 K"
    )
    note = (
        f"Vega: CALSPEC, V = {VEGA_V_MAG:g}; both scaled to one mean through V. Passbands: Bessell"
        " 1990."
    )
    with chart(directory / "passbands", text, panels=2, note=note) as (upper, lower):
        draw_passbands(upper, responses)
        spec = PanelSpec((), "relative F_lambda [1]", "wavelength [nm]", legend={})
        lower_panel = CurvePanel(nm, shown, spec, (INK, ORANGE))
        draw_curve_panel(lower, lower_panel)
    columns_nm = {"wavelength_nm": nm, "vega": shown["Vega"], "blackbody_9602_k": body}
    write_columns(directory / "vega.csv", columns_nm)
    return ChartFinding("passbands", text)


def draw_passbands(axes: "Axes", responses: Mapping[str, Curve]) -> None:
    """The responses of UBVRI, each named at its peak."""
    for (band, curve), colour in zip(responses.items(), BAND_COLOURS, strict=True):
        axes.plot(curve.wavelength_nm, curve.value, color=colour, label="_")
        peak = curve.value.argmax()
        place = curve.wavelength_nm[peak], curve.value[peak]
        axes.annotate(band.upper(), place, va="bottom", ha="center", color=colour)
    axes.set(ylabel="response [1]", ylim=(0, 1.15))


def sensor_words(curve: Curve) -> str:
    """The range of a sensor and its peak, in words."""
    first_nm, last_nm = curve.wavelength_nm[[0, -1]]
    peak = curve.value.argmax()
    peak_nm = curve.wavelength_nm[peak]
    return f"{first_nm:.0f} to {last_nm:.0f} nm, most at {peak_nm:.0f}"


def curves(directory: Path) -> ChartFinding:
    """Figures 5.1, 5.2, 5.20 and 5.21: sensors, glass, and the black bodies that they see."""
    names = ("ccd47-20", "kai-4021", "n-bk7-10mm")
    responses = {}
    for name in names:
        responses[name] = load_curve(name, name)
    ccd = sensor_words(responses["ccd47-20"])
    kai = sensor_words(responses["kai-4021"])
    text = f"The CCD47-20 sees {ccd}; the approximate KAI-4021 {kai}"
    note = (
        "CCD47-20: ULTRACAM's red arm, not the thesis's midband coating. KAI-4021: recalled, not"
        " digitised. Lines: V."
    )
    nm = np.arange(300.0, 1101.0, 2.0)
    columns = {"wavelength_nm": nm}
    of_sensors = {}
    for name, curve in responses.items():
        of_sensors[name] = curve(nm)
    columns |= of_sensors
    of_bodies = {}
    for kelvin in BODIES_K:
        exitance = blackbody_exitance_w_m2_m(nm, kelvin)
        relative = exitance / exitance.max()
        of_bodies[f"{kelvin:.0f} K"] = relative
        columns[f"blackbody_{kelvin:.0f}_k"] = relative
    v_nm = load_curve("johnson-v", "johnson-v").wavelength_nm
    edges = []
    for edge_nm in v_nm[[0, -1]]:
        edges.append(LevelLine(float(edge_nm), HIDDEN, MUTED, "-", 1))
    sensors_spec = PanelSpec((), "electrons a photon, transmission [1]")
    bodies_spec = PanelSpec(
        (), "exitance over its largest [1]", "wavelength [nm]", places=tuple(edges)
    )
    sensors_panel = CurvePanel(nm, of_sensors, sensors_spec)
    bodies_panel = CurvePanel(nm, of_bodies, bodies_spec)
    panels = sensors_panel, bodies_panel
    draw_curves(directory / "curves", text, panels, note)
    write_columns(directory / "curves.csv", columns)
    return ChartFinding("curves", text)


def dark_currents(kelvin: FloatArray) -> dict[str, FloatArray]:
    """The dark current, e-/s, of table 4.2's detector at temperatures (n,) by each law."""
    dark = {}
    for name, law in DARK_LAWS.items():
        currents = []
        for temperature_k in kelvin.tolist():
            detector = structs.replace(TABLE_4_2_DARK, temperature_k=temperature_k, **law)
            current_e = TABLE_4_2_DARK.dark_e_per_s * detector.dark_factor
            currents.append(current_e)
        dark[name] = np.array(currents)
    return dark


def read_noises(hz: FloatArray) -> dict[str, FloatArray]:
    """The read noise, e-, at readout frequencies (n,) by the corner of 1/f noise."""
    noises = {}
    for corner_hz in CORNERS_HZ:
        noise_e = []
        for readout_hz in hz.tolist():
            detector = structs.replace(
                TABLE_4_2_DARK, read_noise_corner_hz=corner_hz, readout_hz=readout_hz
            )
            noise_e.append(detector.read_noise_now_e)
        corner_khz = corner_hz / 1e3
        noises[f"1/f corner {corner_khz:g} kHz"] = np.array(noise_e)
    return noises


def detector_laws(directory: Path) -> ChartFinding:
    """Equation 4.12 and figures 4.12 and 4.15: dark current by temperature, read noise by
    readout frequency.
    """
    kelvin = np.arange(230.0, 300.5, 1.0)
    hz = np.geomspace(1e4, 1e7, 61)
    dark = dark_currents(kelvin)
    cold = {}
    for name, values in dark.items():
        cold[name] = float(values[kelvin == COLD_K][0])
    text = (
        f"Of 203 e-/s at 293 K (table 4.2) {COLD_K:.0f} K leaves {cold['e2v AIMO']:.0f} by e2v's"
        f" AIMO law, {cold['e2v NIMO']:.0f} by its NIMO law, {cold['Arrhenius, 0.56 eV']:.0f} by"
        " Arrhenius with half of silicon's gap"
    )
    note = (
        "e2v's constants were seen in public code, not on a data sheet. Read noise: 2 e- at 1 MHz,"
        " white and 1/f noise."
    )
    upper = PanelSpec((), "dark current [e-/s]", "temperature [K]", scales=("linear", "log"))
    lower = PanelSpec((), "read noise [e-]", "readout frequency [Hz]", scales=("log", "log"))
    noises = read_noises(hz)
    dark_panel = CurvePanel(kelvin, dark, upper)
    noise_panel = CurvePanel(hz, noises, lower)
    panels = dark_panel, noise_panel
    draw_curves(directory / "detector_laws", text, panels, note)
    write_columns(directory / "detector_laws.csv", {"temperature_k": kelvin, **dark})
    return ChartFinding("detector_laws", text)


def sunlight(nm: FloatArray) -> FloatArray:
    """The spectrum of sunlight, a black body's."""
    return blackbody_exitance_w_m2_m(nm, SUN_TEMPERATURE_K)


def near_the_sun(nm: FloatArray) -> FloatArray:
    """The spectrum of zodiacal light 30 degrees from the Sun."""
    return relative_spectrum(nm, NEAR_SLOPES)


ZODIACAL_LIGHTS: dict[str, Callable[[FloatArray], FloatArray]] = {
    "sunlight": sunlight,
    "90 deg from the Sun": relative_spectrum,
    "30 deg from the Sun": near_the_sun,
}


def zodiacal_photons(nm: FloatArray) -> dict[str, FloatArray]:
    """Zodiacal light of V = 22.1, photons/s/m2/arcsec2/nm at nm (n,), by each spectrum."""
    joule_m = PLANCK_J_S * LIGHT_M_S
    photons_per_j = nm * 1e-9 / joule_m
    v = load_curve("johnson-v", "johnson-v")
    v_nm = np.arange(v.wavelength_nm[0], v.wavelength_nm[-1] + 1)
    level = flux_ratio(ZODIACAL_V_MAG) * ZERO_W_M2_M["v"]
    spectra = {}
    for name, light in ZODIACAL_LIGHTS.items():
        weights = v(v_nm)
        mean = float(light(v_nm) @ weights / weights.sum())
        spectra[name] = level * light(nm) / mean * 1e-9 * photons_per_j
    return spectra


def zodiacal_spectrum(directory: Path) -> ChartFinding:
    """Equation 4.9 and figure 4.11: zodiacal light of V = 22.1 by table 19 and as sunlight."""
    nm = np.arange(ZODIACAL_NM[0], ZODIACAL_NM[1] + 1)
    spectra = zodiacal_photons(nm)
    totals = {}
    for name, values in spectra.items():
        totals[name] = float(np.trapezoid(values, nm))
    sun, far, near = totals.values()
    text = (
        f"Zodiacal light of V = {ZODIACAL_V_MAG:g} has {far:.1f} photons/s/m2/arcsec2 90 degrees"
        f" from the Sun (330 to 1100 nm), {near:.1f} at 30 degrees, {sun:.1f} as sunlight"
    )
    note = (
        f"V = {ZODIACAL_V_MAG:g}. Leinert 1998, table 19 and equation 22, through Johnson V. The"
        " WFC3 handbook's spectrum, V = 22.15, gives 101.6."
    )
    with_totals = {}
    for name, light in spectra.items():
        with_totals[f"{name}: {totals[name]:.1f} in all"] = light
    spec = PanelSpec((), "photons/s/m2/arcsec2/nm", "wavelength [nm]", legend={})
    panel = CurvePanel(nm, with_totals, spec)
    draw_curves(directory / "zodiacal", text, (panel,), note)
    write_columns(directory / "zodiacal.csv", {"wavelength_nm": nm, **spectra})
    return ChartFinding("zodiacal", text)


@dataclass(frozen=True, slots=True)
class SpectrumErrors:
    """The errors (n,) of the electron rates of library stars by one method and sensor, %."""

    sensor: str
    method: str
    percent: FloatArray

    def within(self, stars: BoolArray) -> tuple[float, float]:
        """The errors that half and 95 % of some stars are within, %."""
        off_percent = np.abs(self.percent[stars])
        half, at_95 = np.percentile(off_percent, (50, 95)).tolist()
        return half, at_95


def spectrum_errors() -> list[SpectrumErrors]:
    """Every sensor by every method: held-out spectra, and black bodies."""
    library = load_library()
    photometry = Photometry()
    rows = []
    for sensor in SENSORS:
        optics = study_optics(sensor)
        rates = library_electrons_per_s(library, optics, photometry)
        dusty = bare_and_dusty()
        dusty_rates = library_electrons_per_s(dusty, optics, photometry)
        by_type = held_out_by_type(dusty_rates)[: len(rates)]
        held_out_percent = 100 * held_out_errors(rates)
        rows.append(SpectrumErrors(sensor, HELD_OUT, held_out_percent))
        type_percent = 100 * by_type
        rows.append(SpectrumErrors(sensor, BY_TYPE, type_percent))
        for scale in TEMPERATURE_SCALES:
            kelvin = star_temperatures_k(library.bv_mag, scale)
            off = dgs_electrons_per_s(kelvin, optics, photometry) / rates - 1
            body_percent = 100 * off
            rows.append(SpectrumErrors(sensor, f"black body, {scale}", body_percent))
    return rows


def spectra(directory: Path) -> ChartFinding:
    """Black bodies and the Pickles relation, each star held out in turn, against the Pickles
    spectra over V-I.
    """
    library = load_library()
    rows = spectrum_errors()
    by_method = {(row.sensor, row.method): row for row in rows}
    sure = library.vi_mag < MAX_RELIABLE_VI_MAG
    is_giant = []
    for name in library.spectral_type:
        is_giant.append(name.endswith("III"))
    late = ~sure & np.array(is_giant)
    usual = []
    late_giants = []
    worst_real = 0.0
    worst_body = 0.0
    for sensor, title in SENSORS.items():
        name = title.split()[0]
        real = by_method[sensor, HELD_OUT]
        by_type = by_method[sensor, BY_TYPE]
        body = by_method[sensor, BODY]
        usual_words = spectra_words(real, body, sure)
        usual.append(f"{name} {usual_words}")
        giant_words = late_words(real, by_type, late, sure)
        late_giants.append(f"{name} {giant_words}")
        worst_real = max(worst_real, real.within(sure)[1])
        worst_body = max(worst_body, body.within(sure)[1])
    text = (
        f"Median error of the electron rate (95 %), V-I < 2.5: {'; '.join(usual)}; late M giants"
        f" (95 %), {'; '.join(late_giants)}"
    )
    finding = (
        f"Real spectra by V-I give the electron rate within {worst_real:.1f} % for 95 % of stars to"
        f" V-I = {MAX_RELIABLE_VI_MAG:g}, black bodies by B-V within {worst_body:.0f} %"
    )
    count = (~sure).sum()
    note = (
        f"A mark a Pickles spectrum, each held out in turn; {count} are redder than the"
        " dashed line."
    )
    with chart(directory / "spectra", finding, panels=2, note=note) as panels:
        for axes, sensor in zip(panels, SENSORS, strict=True):
            draw_spectra(axes, sensor, [row for row in rows if row.sensor == sensor])
        panels[-1].set(xlabel="V-I [mag]")
        panels[0].legend(loc="upper right")
    columns = ["spectral_type", "bv_mag", "vi_mag"]
    columns += [f"{row.sensor}: {row.method} [%]" for row in rows]
    errors = [row.percent for row in rows]
    table = zip(library.spectral_type, library.bv_mag, library.vi_mag, *errors, strict=True)
    write_csv(directory / "spectra.csv", columns, table)
    return ChartFinding("spectra", text)


def spectra_words(real: SpectrumErrors, body: SpectrumErrors, sure: BoolArray) -> str:
    """The errors of real spectra and of black bodies, in words."""
    real_half, real_95 = real.within(sure)
    body_half, body_95 = body.within(sure)
    return (
        f"{real_half:.1f} % ({real_95:.1f} %) by real spectra and V-I, {body_half:.1f} %"
        f" ({body_95:.1f} %) by black bodies and B-V"
    )


def late_words(
    real: SpectrumErrors, by_type: SpectrumErrors, late: BoolArray, sure: BoolArray
) -> str:
    """The errors of late M giants by colour and by type, and of the others by type, in words."""
    by_colour_95 = real.within(late)[1]
    by_type_95 = by_type.within(late)[1]
    others_95 = by_type.within(sure)[1]
    return f"{by_colour_95:.0f} % by V-I, {by_type_95:.1f} % by MK type (others {others_95:.1f} %)"


def draw_spectra(axes: "Axes", sensor: str, rows: Sequence[SpectrumErrors]) -> None:
    """The errors of one sensor over V-I, a mark a star."""
    vi_mag = load_library().vi_mag
    for row, (mark, colour) in zip(reversed(rows), SPECTRUM_MARKS, strict=True):
        axes.plot(vi_mag, row.percent, mark, color=colour, ms=4, label=row.method)
    axes.axvline(MAX_RELIABLE_VI_MAG, color=MUTED, lw=1, ls="--")
    axes.axhline(0, color=INK, lw=1)
    axes.set_yscale("symlog", linthresh=5)
    axes.set(ylabel="error of the electron rate [%]", title=SENSORS[sensor])
    axes.set_ylim(-130, 50_000)
    plain_ticks(axes.yaxis, (-50, -10, 0, 10, 50, 200))


@dataclass(frozen=True, slots=True)
class ZeroPointRow:
    """The electrons of a star of V = 0 by one zero point and weighting, and how much fainter it is
    than by the default.
    """

    sensor: str
    zero_point: str
    weighting: str
    electrons_per_s: float
    mag_against_default: float

    @property
    def millions(self) -> float:
        """The electrons a second, millions."""
        return self.electrons_per_s / 1e6

    @property
    def words(self) -> str:
        """The setting, in two lines."""
        return f"{self.zero_point},\n{self.weighting} weighting"


def zero_point_rows() -> list[ZeroPointRow]:
    """Every sensor by every setting; the default is the first setting."""
    rows = []
    for sensor in SENSORS:
        optics = study_optics(sensor)
        default_rate = None
        for setting in SETTINGS:
            rate = dgs_electrons_per_s(REFERENCE_TEMPERATURE_K, optics, setting)
            default_rate = default_rate or rate
            cost_mag = float(magnitude(rate / default_rate))
            figures = float(rate), cost_mag
            rows.append(ZeroPointRow(sensor, setting.zero_point, setting.weighting, *figures))
    return rows


def zero_points(directory: Path) -> ChartFinding:
    """Electrons of a V = 0 star of 9602 K by zero point and weighting."""
    rows = zero_point_rows()
    write_rows(directory / "zero_points.csv", rows)
    default, bolometric = rows[0], rows[2]
    share = bolometric.electrons_per_s / default.electrons_per_s
    fewer = 100 * (1 - share)
    text = (
        f"A V = 0 star of 9602 K gives {default.millions:.1f} million electrons/s by Vega's flux"
        f" (CCD47-20, 30 mm), {fewer:.0f} % ({bolometric.mag_against_default:.2f} mag) fewer by the"
        " IAU's bolometric zero point"
    )
    note = f"A black body of {REFERENCE_TEMPERATURE_K:.0f} K, V = 0, behind {APERTURE_MM:g} mm."
    largest = max(row.millions for row in rows if row.sensor == default.sensor)
    costs_mag = [row.mag_against_default for row in rows]
    low = min(0.0, *costs_mag)
    high = max(costs_mag)
    extent = high - low
    legend = {"loc": "upper left", "ncols": 2}
    millions = BarSpec(setting_words, "millions", 0.8, "%.2f", look=BAR)
    upper = PanelSpec(
        ylabel="electrons a second [millions]",
        bars=millions,
        ylim=(0, 1.3 * largest),
        legend=legend,
    )
    fainter_mag = BarSpec(setting_words, "mag_against_default", 0.8, "%+.3f", look=BAR)
    lowest = low - 0.15 * extent
    highest = high + 0.4 * extent
    lower = PanelSpec(
        ylabel="fainter than vega, energy [mag]",
        xlabel="zero point, weighting of the passband",
        bars=fainter_mag,
        # with room for figures and names
        ylim=(lowest, highest),
        legend=legend,
    )
    looks = looks_of(SENSORS)
    spec = ChartSpec((upper, lower), lambda row: row.sensor, looks, note)
    draw_rows(directory / "zero_points", text, spec, rows)
    return ChartFinding("zero_points", text)


def setting_words(row: ZeroPointRow) -> str:
    """The group of a row: its setting."""
    return row.words


def names_with(figures: Mapping[str, tuple[float, float]], form: str) -> str:
    """Names with their two figures, as `form` writes them, in one line."""
    named = []
    for name, (half, most) in figures.items():
        last_name = name.split()[-1]
        named.append(form.format(name=last_name, half=half, most=most))
    return ", ".join(named)


def within_mag(bv: FloatArray, mag: FloatArray) -> tuple[float, float]:
    """What half and 95 % of Hipparcos to V = 7.5 are within, mag, by errors (n,) over B-V (n,)."""
    stars_bv = load_catalog().brighter_than(BRIGHT_V_MAG).bv_mag
    in_scale = (stars_bv >= bv[0]) & (stars_bv <= bv[-1])
    stars_bv = stars_bv[in_scale]
    off_mag = np.abs(np.interp(stars_bv, bv, mag))
    half, most = np.percentile(off_mag, (50, 95)).tolist()
    return half, most


@dataclass(frozen=True, slots=True)
class ScaleErrors:
    """Scales by name at B-V (n,): kelvin, their difference from Torres 2010's in percent, and that
    of their electrons in mag. `within` has the half and the 95 % of Hipparcos's stars, mag.
    """

    bv: FloatArray
    torres_k: FloatArray
    kelvin: dict[str, FloatArray]
    percent: dict[str, FloatArray]
    mag: dict[str, FloatArray]
    within: dict[str, tuple[float, float]]


def scale_errors() -> ScaleErrors:
    """The scales that a bench file can choose, beside Torres 2010, and their error in electrons."""
    bv = np.union1d(SCALE_BV_MAG, -1e-9)  # both sides of wang2021's step
    torres_k = torres2010_k(bv)
    kelvin = {SUPERGIANTS: torres2010_k(bv, supergiant=True)}
    for name, scale in TEMPERATURE_SCALES.items():
        kelvin[name] = scale(bv)
    optics = study_optics("ccd47-20")
    base = dgs_electrons_per_s(torres_k, optics, Photometry())
    percent = {}
    mag = {}
    for name, scale_k in kelvin.items():
        percent[name] = 100 * (scale_k / torres_k - 1)
        electrons = dgs_electrons_per_s(scale_k, optics, Photometry())
        mag[name] = magnitude(electrons / base)
    within = {}
    for name in TEMPERATURE_SCALES:
        within[name] = within_mag(bv, mag[name])
    return ScaleErrors(bv, torres_k, kelvin, percent, mag, within)


def temperature_scales(directory: Path) -> ChartFinding:
    """The chart and the table of `scale_errors`, and what they say."""
    errors = scale_errors()
    within = errors.within
    zero = int(np.searchsorted(errors.bv, 0.0))
    before_step_k = errors.kelvin["wang2021"][zero - 1]
    step_k = before_step_k - errors.kelvin["wang2021"][zero]
    with_most = names_with(within, "{half:.3f} ({most:.2f}) mag by {name}")
    step_percent = 100 * step_k / before_step_k
    text = (
        f"wang2021 steps down by {step_k:.0f} K ({step_percent:.1f} %) at B-V = 0;"
        f" half of Hipparcos to V = 7.5 (95 %) is within {with_most} of Torres 2010"
    )
    with_half = names_with(within, "{half:.3f} mag by {name}")
    finding = (
        f"The scale wang2021 steps down by {step_k:.0f} K at B-V = 0; half of Hipparcos is within"
        f" {with_half} of Torres 2010"
    )
    draw_scales(errors, directory / "temperature_scales", finding)
    columns = {"bv_mag": errors.bv, "torres2010_k": errors.torres_k}
    for unit, values in (("k", errors.kelvin), ("percent", errors.percent), ("mag", errors.mag)):
        columns |= relabelled(values, {name: f"{name}_{unit}" for name in values})
    write_columns(directory / "temperature_scales.csv", columns)
    return ChartFinding("temperature_scales", text)


def draw_scales(errors: ScaleErrors, stem: Path, title: str) -> None:
    """Draw the scales, and their differences in percent and in electrons, below each other."""
    note = (
        "Torres 2010 (Flower 1996) for dwarfs and giants is the reference. Electrons: CCD47-20, +"
        " is fainter."
    )
    above = PanelSpec(ylabel="temperature [K]", scales=("linear", "log"))
    middle = PanelSpec(ylabel="difference [%]", levels=(ZERO_LINE,))
    below = PanelSpec(
        ylabel="difference in electrons [mag]", xlabel="B-V [mag]", levels=(ZERO_LINE,)
    )
    labels = {name: name.replace(SUPERGIANTS, "Torres, supergiants") for name in errors.kelvin}
    mag_labels = dict(labels)
    for name, (half, _) in errors.within.items():
        mag_labels[name] = f"{name}: half within {half:.3f}"
    bv = errors.bv
    scales = {"Torres 2010": errors.torres_k, **relabelled(errors.kelvin, labels)}
    percent_curves = relabelled(errors.percent, labels)
    mag_curves = relabelled(errors.mag, mag_labels)
    kelvin_colours = (INK, *SCALE_COLOURS)
    kelvin_styles = ("-", *SCALE_STYLES)
    panels = (
        CurvePanel(bv, scales, above, kelvin_colours, styles=kelvin_styles),
        CurvePanel(bv, percent_curves, middle, SCALE_COLOURS, styles=SCALE_STYLES),
        CurvePanel(bv, mag_curves, below, SCALE_COLOURS, styles=SCALE_STYLES),
    )
    draw_curves(stem, title, panels, note)


def relabelled(
    curves: Mapping[str, FloatArray], labels: Mapping[str, str]
) -> dict[str, FloatArray]:
    """Curves by their labels."""
    by_label = {}
    for name, values in curves.items():
        by_label[labels[name]] = values
    return by_label


def choices(directory: Path) -> ChartFinding:
    """The cost of each choice in magnitudes, over B-V and for the stars of Hipparcos."""
    optics = study_optics("ccd47-20")
    stars = load_catalog().brighter_than(BRIGHT_V_MAG)
    cost = choice_costs_mag(BV_MAG, optics)
    on_stars = star_costs_mag(stars, optics)
    percentiles = running_percentiles(stars.bv_mag, on_stars["spectrum pickles"], BV_MAG)
    low, middle, high, _ = percentiles
    paid = {}
    for name, mag in on_stars.items():
        off_mag = np.abs(mag)
        half, most = np.percentile(off_mag, (50, 95)).tolist()
        paid[name] = half, most
    costs_words = names_with(paid, "{name} {half:.2f} ({most:.2f})")
    text = (
        f"What each choice costs half of Hipparcos to V = 7.5 (95 %), CCD47-20, mag: {costs_words}"
    )
    brighter_mag = -np.nanmin(low)
    note = (
        f"At a name: half of {len(stars)} Hipparcos stars change by as much (a twentieth). Band: 5"
        f" to 95 % of them. M giants share the B-V of K giants, and are up to {brighter_mag:.1f}"
        " mag brighter than the black body. + is fainter; CCD47-20."
    )
    finding = choices_finding(paid)
    with chart(directory / "choices", finding, panels=2, note=note) as panels:
        upper, lower = panels
        for (name, mag), colour in zip(cost.items(), SERIES, strict=False):
            upper.plot(BV_MAG, mag, color=colour, label=cost_label(name, paid))
        pickles_label = cost_label("spectrum pickles", paid)
        upper.plot(BV_MAG, middle, color=INK, label=pickles_label)
        lower.plot(BV_MAG, middle, color=INK, label="pickles, median")
        for axes in panels:
            axes.axhline(0, color=MUTED, lw=1)
            axes.set(ylabel="cost against a black body [mag]")
        lower.fill_between(BV_MAG, low, high, color=MUTED, alpha=0.35, lw=0)
        lower.set(xlabel="B-V [mag]")
        label_ends(upper, lower)
    columns = {"bv_mag": BV_MAG}
    for name, mag in cost.items():
        column = name.replace(" ", "_")
        columns[f"{column}_mag"] = mag
    columns |= dict(zip(PERCENTILE_COLUMNS, percentiles, strict=True))
    write_columns(directory / "choices.csv", columns)
    return ChartFinding("choices", text)


def cost_label(name: str, paid: Mapping[str, tuple[float, float]]) -> str:
    """A choice, what half of the stars pay for it, and what a twentieth pays."""
    half, most = paid[name]
    choice = name.rsplit(maxsplit=1)[-1]
    return f"{choice}: {half:.2f} ({most:.2f})"


def star_costs_mag(stars: Catalog, optics: Optics) -> dict[str, FloatArray]:
    """The cost of each choice for stars (n,), mag, that of real spectra included."""
    table = tabulate_pickles(optics, Photometry())
    v_mag = np.zeros(len(stars))
    real = table.electrons_per_s(v_mag, stars.bv_mag, stars.vi_mag)
    # a spectrum for each colour, of which there are few
    bv_mag, star = np.unique(stars.bv_mag, return_inverse=True)
    kelvin = star_temperatures_k(bv_mag, "ballesteros2012")
    body_rates = dgs_electrons_per_s(kelvin, optics, Photometry())
    body = body_rates[star]
    costs = {}
    for name, mag in choice_costs_mag(bv_mag, optics).items():
        costs[name] = mag[star]
    costs["spectrum pickles"] = magnitude(real / body)
    return costs


def choices_finding(paid: Mapping[str, tuple[float, float]]) -> str:
    """The choice that changes half of the stars most, and the one that changes a twentieth most."""
    dearest = max(paid, key=lambda name: paid[name][0])
    for_few = max(paid, key=lambda name: paid[name][1])
    half, most = paid[dearest]
    dearest_name = dearest.split()[-1]
    text = (
        f"Of the choices of brightness {dearest_name} changes most: half of Hipparcos to"
        f" V = {BRIGHT_V_MAG:g} by {half:.2f} mag and more"
    )
    if for_few == dearest:
        return f"{text}, a twentieth by {most:.2f} mag"
    few_name = for_few.split()[-1]
    few_mag = paid[for_few][1]
    few = f"{few_name}, by {few_mag:.2f} mag"
    return f"{text}; a twentieth are changed most by {few}"


def choice_costs_mag(bv_mag: FloatArray, optics: Optics) -> dict[str, FloatArray]:
    """The cost of each choice, mag (n,), against a black body by ballesteros2012, vega and
    energy; + is fainter.
    """
    default = Photometry()
    kelvin = star_temperatures_k(bv_mag, "ballesteros2012")
    wang_k = star_temperatures_k(bv_mag, "wang2021")
    photon = Photometry("vega", "photon")
    bolometric = Photometry("iau-bolometric")
    average = ags_electrons_per_s(optics, default)
    rates = {
        "temperature wang2021": dgs_electrons_per_s(wang_k, optics, default),
        "weighting photon": dgs_electrons_per_s(kelvin, optics, photon),
        "zero point iau-bolometric": dgs_electrons_per_s(kelvin, optics, bolometric),
        "brightness ags": np.full_like(bv_mag, average),
    }
    base = dgs_electrons_per_s(kelvin, optics, default)
    costs_mag = {}
    for name, rate in rates.items():
        costs_mag[name] = magnitude(rate / base)
    return costs_mag


def running_percentiles(bv_mag: FloatArray, value: FloatArray, at_bv_mag: FloatArray) -> FloatArray:
    """5, 50 and 95 % of `value` (n,) within WINDOW_MAG of each colour, and the count, shape (4, m).

    NaN where there are fewer than MIN_STARS.
    """
    rows = np.full((4, len(at_bv_mag)), np.nan)
    for k, centre in enumerate(at_bv_mag):
        near = np.abs(bv_mag - centre) <= WINDOW_MAG
        inside = value[near]
        rows[3, k] = len(inside)
        if len(inside) >= MIN_STARS:
            rows[:3, k] = np.percentile(inside, (5, 50, 95))
    return rows


FIGURES: tuple[Callable[[Path], ChartFinding], ...] = (
    *(temperature_scales, zero_points, choices, spectra),
    *(catalogue_errors, passbands, curves, detector_laws, zodiacal_spectrum),
    *SKY_FIGURES,
)


def run(directory: Path) -> list[ChartFinding]:
    """Write every chart and its table (CSV) into `directory`, and `findings.csv`. Raises
    InputError.
    """
    findings = []
    for sensor in SENSORS:
        findings.append(rapp(directory, sensor))
    for figure in FIGURES:
        findings.append(figure(directory))
    write_findings(directory, findings)
    return findings
