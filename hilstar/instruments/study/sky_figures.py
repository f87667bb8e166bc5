"""Figures of chapters 2 to 4 about the sky: star density, frames, Sun, Vega, background light."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.charts import (
    BLUE,
    GREEN,
    INK,
    MUTED,
    ORANGE,
    PURPLE,
    SMALL_PT,
    chart,
    write_csv,
)
from hilstar.basics.rotation import from_radec_roll_deg, to_matrix
from hilstar.basics.units import LIGHT_M_S, flux_ratio
from hilstar.instruments.study.engine import (
    ChartFinding,
    CurvePanel,
    PanelSpec,
    draw_curves,
    write_columns,
)
from hilstar.instruments.study.fields import FIELDS
from hilstar.sky.air import NIGHT_SKY
from hilstar.sky.catalog import load_catalog
from hilstar.sky.electrons import REFERENCE_TEMPERATURE_K, SUN_TEMPERATURE_K, load_library
from hilstar.sky.spectrum import (
    DATA_DIR,
    PLANCK_J_S,
    Curve,
    blackbody_exitance_w_m2_m,
    load_curve,
    read_curve_csv,
)
from hilstar.sky.stars import unit_vectors_icrs
from hilstar.sky.synthetic import ZERO_W_M2_M, curve_mean, vega

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SKY_DEG2 = 4 * np.pi * np.degrees(1) ** 2
CELLS = (36, 18)  # of the map, across and down: 10 degrees of right ascension, equal areas
FRAME_DEG = 25.0  # side of Orion's field, whose stars are shown in both frames
FRAME_V_MAG, FRAME_EPOCH = 7.5, 2000.0
SUN_TYPE = "G2V"
SHOWN_NM = np.arange(300.0, 1101.0)
QUOTED_NM = (350.0, 400.0, 900.0)
VEGA_NM = (200.0, 10_000.0)
VEGA_TICKS_NM = (200, 500, 1000, 2000, 5000, 10_000)
GLOW_V_MAG = 21.7  # of a dark sky's zenith, from the ground
EARTHSHINE, HST_ZODIACAL = DATA_DIR / "earthshine.csv", DATA_DIR / "hst-zodiacal.csv"
EARTHSHINES = {
    "earthshine, 24°": 2.0,
    "earthshine, 38°": 1.0,
    "earthshine, 50°": 0.5,
}  # by degrees from the Earth's limb
ZODIACAL = "zodiacal, V = 22.1"
LIGHT_COLOURS = (BLUE, MUTED, GREEN, PURPLE, ORANGE)
LIGHT_COLUMNS = (
    "zodiacal",
    "earthshine_24_deg",
    "earthshine_38_deg",
    "earthshine_50_deg",
    "ground",
)
W_M2_M_OF_ERG = 1e7  # erg/s/cm2/A in W/m2/m


def star_density(directory: Path) -> ChartFinding:
    """Figure 2.2: how many stars of Hipparcos a square degree of the sky has."""
    catalog = load_catalog()
    across = np.linspace(0, 360, CELLS[0] + 1)
    down = np.linspace(-1, 1, CELLS[1] + 1)
    height = np.sin(np.radians(catalog.dec_deg))
    cells = (across, down)
    ra_mod_deg = catalog.ra_deg % 360
    stars, _, _ = np.histogram2d(ra_mod_deg, height, cells)
    cell_deg2 = SKY_DEG2 / stars.size
    density = stars.T / cell_deg2
    low, high = np.percentile(density, (5, 95))
    mean = len(catalog) / SKY_DEG2
    text = (
        f"Hipparcos has {mean:.2f} stars a square degree, {low:.1f} to {high:.1f} in 90 % of the"
        " sky: most along the Milky Way"
    )
    note = (
        f"{len(catalog)} stars with V and B-V. Cells of equal area, {cell_deg2:.0f} square degrees"
        " each."
    )
    with chart(directory / "star_density", text, note=note, height_inch=4.2) as (axes,):
        draw_density(axes, density)
    ra_deg = (across[:-1] + across[1:]) / 2
    sine = (down[:-1] + down[1:]) / 2
    dec_deg = np.degrees(np.arcsin(sine))
    ra_grid, dec_grid = np.meshgrid(ra_deg, dec_deg)
    columns = {
        "ra_deg": ra_grid.ravel(),
        "dec_deg": dec_grid.ravel(),
        "stars_deg2": density.ravel(),
    }
    write_columns(directory / "star_density.csv", columns)
    return ChartFinding("star_density", text)


def draw_density(axes: "Axes", density: FloatArray) -> None:
    """A map of the sky in cells of equal area."""
    image = axes.imshow(
        density,
        extent=(0, 360, -1, 1),
        origin="lower",
        aspect="auto",
        cmap="viridis",
        interpolation="nearest",
    )
    declinations = np.array([-90, -60, -30, 0, 30, 60, 90])
    sines = np.sin(np.radians(declinations))
    names = [str(degree) for degree in declinations]
    axes.set_yticks(sines, names)
    hours_deg = np.arange(0, 361, 60)
    axes.set_xticks(hours_deg)
    axes.set(xlim=(360, 0), xlabel="right ascension [deg]", ylabel="declination [deg]")
    axes.grid(False)
    axes.figure.colorbar(image, ax=axes, label="Stars a square degree")


def frames(directory: Path) -> ChartFinding:
    """Figure 2.11: the directions of Orion's stars in the celestial frame and in the camera's."""
    catalog = load_catalog().brighter_than(FRAME_V_MAG)
    vectors = unit_vectors_icrs(catalog, FRAME_EPOCH)
    angles = FIELDS[0].radec_roll_deg
    q_icrs_to_cam = from_radec_roll_deg(*angles)
    matrix = to_matrix(q_icrs_to_cam)
    cam = vectors @ matrix.T
    half_field_rad = np.radians(FRAME_DEG / 2)
    limit = np.tan(half_field_rad) * cam[:, 2:]
    off_axis = np.abs(cam[:, :2])
    in_front = cam[:, 2] > 0
    in_field = off_axis < limit
    inside = in_front & in_field.all(axis=1)
    icrs = vectors[inside]
    cam = cam[inside]
    count = len(cam)
    off = icrs @ equation_2_3(*angles) - cam
    error = float(np.abs(off).max())
    agreement = f"{error:.0e}".replace("e-", " x 10^-")
    text = (
        f"{count} stars of Orion, in the celestial frame about +y, stand about +z in the camera's;"
        f" equation 2.3 and hilstar's quaternion agree to {agreement}"
    )
    finding = (
        f"{count} stars of Orion stand about +y in the celestial frame, and about +z in the"
        " camera's"
    )
    draw_frames(directory / "frames", finding, icrs, cam, matrix[2])
    _write_frames(directory / "frames.csv", catalog.hip[inside], icrs, cam)
    return ChartFinding("frames", text)


def draw_frames(
    path: Path, finding: str, icrs: FloatArray, cam: FloatArray, boresight: FloatArray
) -> None:
    """Directions (n, 3) of stars in both frames, and the boresight (3,), ICRS."""
    note = "Unit vectors. North is up in both, as roll is 0; the camera's y points down."
    with chart(path, finding, 1, 2, note=note, share_x=False, height_inch=4.4) as (sky, image):
        sky.plot(icrs[:, 0], icrs[:, 2], ".", ms=3, color=BLUE)
        sky.plot(boresight[0], boresight[2], "+", ms=14, mew=2, color=ORANGE)
        sky.set(xlabel="x [1]", ylabel="z [1]", title="Celestial frame (ICRS)", aspect="equal")
        image.plot(cam[:, 0], cam[:, 1], ".", ms=3, color=BLUE)
        image.plot(0, 0, "+", ms=14, mew=2, color=ORANGE)
        for axes, name, colour in ((sky, "stars", BLUE), (image, "boresight", ORANGE)):
            style: Any = {"color": colour, "ha": "right", "fontsize": SMALL_PT}
            axes.text(1, 1.03, name, transform=axes.transAxes, **style)
        image.invert_yaxis()
        image.set(xlabel="x [1]", ylabel="y [1]", title="Camera frame (cam)", aspect="equal")


def _write_frames(path: Path, hip: IntArray, icrs: FloatArray, cam: FloatArray) -> None:
    columns = ["hip"]
    for frame in ("icrs", "cam"):
        columns += [f"{axis}_{frame}" for axis in "xyz"]
    table = np.column_stack((icrs, cam)).tolist()
    rows = []
    for number, row in zip(hip.tolist(), table, strict=True):
        rows.append((number, *row))
    write_csv(path, columns, rows)


def equation_2_3(ra_deg: float, dec_deg: float, roll_deg: float) -> FloatArray:
    """The matrix (3, 3) of camera components to celestial ones: A3(a3) A1(a2) A3(a1), table 2.4."""
    angles_rad = np.radians([roll_deg, dec_deg - 90, ra_deg - 90])
    roll, down, across = angles_rad
    return np.asarray(_about_z(across) @ _about_x(down) @ _about_z(roll))


def _about_z(angle: float) -> FloatArray:
    cosine = np.cos(angle)
    sine = np.sin(angle)
    return np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])


def _about_x(angle: float) -> FloatArray:
    cosine = np.cos(angle)
    sine = np.sin(angle)
    return np.array([[1, 0, 0], [0, cosine, -sine], [0, sine, cosine]])


def scaled_in_v(nm: FloatArray, flux: FloatArray) -> Curve:
    """A spectrum over its mean through Johnson V."""
    johnson_v = load_curve("johnson-v", "johnson-v")
    mean = curve_mean(Curve(nm, flux), johnson_v)
    return Curve(nm, flux / mean)


def sun(directory: Path) -> ChartFinding:
    """Figure 3.1: a star of the Sun's type and the black body of the Sun's temperature."""
    library = load_library()
    nm = library.wavelength_nm
    number = library.spectral_type.index(SUN_TYPE)
    star = library.flux[number]
    spectrum = scaled_in_v(nm, star)
    exitance = blackbody_exitance_w_m2_m(nm, SUN_TEMPERATURE_K)
    body = scaled_in_v(nm, exitance)
    quoted = []
    for at_nm in QUOTED_NM:
        place_nm = np.array([at_nm])
        share = float(spectrum(place_nm)[0] / body(place_nm)[0])
        quoted.append(f"{share:.2f} at {at_nm:.0f} nm")
    quoted_shares = ", ".join(quoted)
    text = (
        f"A star of the Sun's type ({SUN_TYPE}) over the black body of {SUN_TEMPERATURE_K:.0f} K,"
        f" scaled in V: {quoted_shares}"
    )
    note = (
        "Pickles 1998, mean of stars of that type; no spectrum of the Sun itself is in the package."
    )
    observed = spectrum(SHOWN_NM)
    shown_body = body(SHOWN_NM)
    curves = {
        f"{SUN_TYPE}, observed": observed,
        f"black body, {SUN_TEMPERATURE_K:.0f} K": shown_body,
    }
    spec = PanelSpec(ylabel="F_lambda over its mean in V [1]", xlabel="wavelength [nm]", legend={})
    panel = CurvePanel(SHOWN_NM, curves, spec, (INK, ORANGE))
    draw_curves(directory / "sun", text, (panel,), note)
    columns = {"wavelength_nm": SHOWN_NM, "g2v": observed, "blackbody": shown_body}
    write_columns(directory / "sun.csv", columns)
    return ChartFinding("sun", text)


def vega_logarithmic(directory: Path) -> ChartFinding:
    """Figure 2.13, right: Vega on logarithmic scales, beside the thesis's black body."""
    light = vega()
    first_nm, last_nm = VEGA_NM
    after_first = light.wavelength_nm >= first_nm
    before_last = light.wavelength_nm <= last_nm
    shown = after_first & before_last
    nm = light.wavelength_nm[shown]
    johnson_v = load_curve("johnson-v", "johnson-v")
    mean = curve_mean(light, johnson_v)
    flux = light.value[shown] / mean * ZERO_W_M2_M["v"]
    body = blackbody_exitance_w_m2_m(nm, REFERENCE_TEMPERATURE_K)
    body_mean = curve_mean(Curve(nm, body), johnson_v)
    body *= ZERO_W_M2_M["v"] / body_mean
    falls = float(np.interp(1000, nm, flux) / np.interp(5000, nm, flux))
    over_body = flux / body
    blue, red = np.interp([350.0, 5000.0], nm, over_body)
    text = (
        f"From 1 to 5 micrometres Vega's light falls by {falls:.0f} times; it has {blue:.2f} of"
        " the black body's at 350 nm,"
        f" {red:.2f} at 5 micrometres"
    )
    note = f"CALSPEC, scaled to V = 0. Black body: {REFERENCE_TEMPERATURE_K:.0f} K, scaled in V."
    spec = PanelSpec(
        (),
        "F_lambda [W/m2/m]",
        "wavelength [nm]",
        scales=("log", "log"),
        xlim=VEGA_NM,
        xticks=VEGA_TICKS_NM,
        legend={},
    )
    curves = {"Vega": flux, "black body": body}
    panel = CurvePanel(nm, curves, spec, (INK, ORANGE))
    draw_curves(directory / "vega_logarithmic", text, (panel,), note)
    columns = {"wavelength_nm": nm, "vega": flux, "blackbody": body}
    write_columns(directory / "vega_logarithmic.csv", columns)
    return ChartFinding("vega_logarithmic", text)


def backgrounds(directory: Path) -> ChartFinding:
    """Figure 4.11: zodiacal light and the other lights between the stars near the Earth."""
    zodiacal = read_curve_csv(HST_ZODIACAL)
    earthshine = read_curve_csv(EARTHSHINE)
    high = _photons(earthshine)
    lights = {ZODIACAL: _photons(zodiacal)}
    for name, times in EARTHSHINES.items():
        lights[name] = times * high
    lights["from the ground"] = _glow_photons()
    total = {}
    for name, values in lights.items():
        total[name] = float(np.nansum(values))
    at_24_deg = total["earthshine, 24°"]
    at_38_deg = total["earthshine, 38°"]
    at_50_deg = total["earthshine, 50°"]
    text = (
        f"Zodiacal light of V = 22.1 has {total[ZODIACAL]:.0f} photons/s/m2/arcsec2 (300 to 1100"
        f" nm); earthshine adds {at_38_deg:.0f} at 38 degrees from the Earth's limb,"
        f" {at_24_deg:.0f} at 24, {at_50_deg:.0f} at 50"
    )
    note = (
        "STIS Instrument Handbook, table 6.4. Ground: Paranal's glow (Hanuschik 2003) at V ="
        f" {GLOW_V_MAG:g}, zodiacal"
        " light within it. The geocoronal lines lie under 250 nm."
    )
    spec = PanelSpec((), "photons/s/m2/arcsec2/nm", "wavelength [nm]", scales=("linear", "log"))
    panel = CurvePanel(SHOWN_NM, lights, spec, LIGHT_COLOURS, {"lw": 1.5})
    draw_curves(directory / "backgrounds", text, (panel,), note)
    columns = dict(zip(LIGHT_COLUMNS, lights.values(), strict=True))
    write_columns(directory / "backgrounds.csv", {"wavelength_nm": SHOWN_NM, **columns})
    return ChartFinding("backgrounds", text)


def _photons(erg_s_cm2_a_arcsec2: Curve) -> FloatArray:
    """Photons/s/m2/arcsec2/nm at SHOWN_NM of a spectrum in erg/s/cm2/A/arcsec2."""
    w_m2_m = erg_s_cm2_a_arcsec2(SHOWN_NM) * W_M2_M_OF_ERG
    return _photons_of(w_m2_m)


def _photons_of(w_m2_m: FloatArray) -> FloatArray:
    metres = SHOWN_NM * 1e-9
    joules = PLANCK_J_S * LIGHT_M_S / metres
    return np.asarray(w_m2_m * 1e-9 / joules)


def _glow_photons() -> FloatArray:
    """The night sky's, NaN where its spectrum ends."""
    spectrum = read_curve_csv(NIGHT_SKY, highest=np.inf)
    johnson_v = load_curve("johnson-v", "johnson-v")
    mean = curve_mean(spectrum, johnson_v)
    level = flux_ratio(GLOW_V_MAG) * ZERO_W_M2_M["v"]
    first_nm, last_nm = spectrum.wavelength_nm[[0, -1]]
    known = (first_nm <= SHOWN_NM) & (last_nm >= SHOWN_NM)
    return np.where(known, _photons_of(spectrum(SHOWN_NM) / mean * level), np.nan)


FIGURES: tuple[Callable[[Path], ChartFinding], ...] = (
    star_density,
    frames,
    sun,
    vega_logarithmic,
    backgrounds,
)
