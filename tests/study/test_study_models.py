"""The models study: its tables against figures from elsewhere, its titles against its tables,
its pictures not blank.
"""

import re
import subprocess
import sys
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import numpy as np
import pytest
from astropy.wcs import WCS
from matplotlib.figure import Figure
from PIL import Image
from scipy import constants

from hilstar.basics import charts
from hilstar.basics.charts import TITLE_COLUMNS, title_lines
from hilstar.instruments.study import models
from hilstar.instruments.study.models import (
    FIGURES,
    choices_finding,
    running_percentiles,
    zero_points,
)
from hilstar.instruments.study.rapp import SENSORS, rapp, rapp_ratios
from hilstar.instruments.study.study_benches import held_out_errors, study_optics
from hilstar.sky import electrons
from hilstar.sky.air import NIGHT_SKY
from hilstar.sky.catalog import load_catalog
from hilstar.sky.electrons import Photometry, load_library, tabulate, tabulate_pickles
from hilstar.sky.facts import facts_of
from hilstar.sky.spectrum import DATA_DIR
from tests.support.tables import csv_rows
from tests.support.waiting import PATIENCE_S

STEMS = (
    "rapp_ccd47-20",
    "rapp_kai-4021",
    "temperature_scales",
    "zero_points",
    "choices",
    "spectra",
)
STEMS += ("catalogue_errors", "passbands", "curves", "detector_laws", "zodiacal")
STEMS += ("star_density", "frames", "sun", "vega_logarithmic", "backgrounds")

# Planck, the zero point and Johnson V written a second time, integrated by pieces to 1e-15; the
# study's
# Gauss-Legendre is good to 1e-13, and the constants below are CODATA's, rounded at 1e-9.
QUADRATURE_LIMIT = 1e-6
HC_OVER_K_NM_K = 1.438776877e7
REFERENCE_K = 9602.0
BOLOMETRIC_MAG_LIMIT = 5e-4  # what three decimals of a magnitude hold

# tests/authority/test_pickles.py holds the same: median and 95 % of the errors of held-out stars,
# %, V-I < 2.5.
HELD_OUT = {"ccd47-20": (0.79, 2.42), "kai-4021": (0.58, 2.57)}
HUNDREDTH_OF_A_PERCENT = 0.006

# The table that benches use, against the integral that the study uses: 1e-6 of the rate
# (electrons.py).
TABLE_MAG_LIMIT = 2e-6


@pytest.fixture(scope="module")
def models_study(whole_study):
    found = whole_study("models", STEMS, "")
    return found.folder, dict(line.split(": ", 1) for line in found.findings)


@dataclass(frozen=True)
class Made:
    """A figure of the study alone: the folder of its tables, its finding and its chart."""

    folder: Path
    text: str
    chart: Figure

    def table(self, name):
        return table_columns(self.folder / f"{name}.csv")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Makes one figure of the study, once; no chart is saved."""
    folder = tmp_path_factory.mktemp("models")
    makers = {f"rapp_{sensor}": partial(rapp, sensor=sensor) for sensor in SENSORS}
    makers |= {figure.__name__.replace("_spectrum", ""): figure for figure in FIGURES}

    @cache
    def once(stem):
        saved = []
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(charts, "save", lambda drawn, path: saved.append(drawn))
            finding = makers[stem](folder)
        assert finding.figure == stem
        (chart,) = saved
        return Made(folder, finding.text, chart)

    return once


def table_columns(path):
    """A table's columns by name: numbers where they are numbers."""
    rows = csv_rows(path)

    def numbers(texts):
        try:
            return np.array([float(text) for text in texts])
        except ValueError:
            return texts

    return {name: numbers([row[name] for row in rows]) for name in rows[0]}


def planck(nm, kelvin):
    """Relative B(lambda, T)."""
    return nm**-5.0 / np.expm1(HC_OVER_K_NM_K / (nm * kelvin))


def curve(name):
    """A packaged curve, read without hilstar."""
    return np.loadtxt(DATA_DIR / f"{name}.csv", delimiter=",", comments=("#", "w")).T


def integral(function, knots_nm):
    """Over straight pieces, each by 12 nodes: adaptive quadrature agrees within 1e-15."""
    nodes, weights = np.polynomial.legendre.leggauss(12)
    half = np.diff(knots_nm)[:, None] / 2
    return float(
        (half * weights * function(np.asarray(knots_nm)[:-1, None] + half * (1 + nodes))).sum()
    )


def rapp_by_quadrature(kelvin, sensor, power):
    """RAPP1 to RAPP3; `power` of lambda in Johnson V: 0 is energy, 1 photon."""
    qe, glass, johnson = curve(sensor), curve("n-bk7-10mm"), curve("johnson-v")
    low, high = qe[0][0], qe[0][-1]
    knots = np.union1d(qe[0], glass[0])
    knots = knots[(knots >= low) & (knots <= high)]

    def light(temperature, response):
        v_band = integral(
            lambda nm: planck(nm, temperature) * np.interp(nm, *johnson) * nm**power, johnson[0]
        )
        return integral(lambda nm: planck(nm, temperature) * response(nm), knots) / v_band

    def seen(nm):
        return np.interp(nm, *qe) * np.interp(nm, *glass)

    mean_nm, width_nm = (low + high) / 2, high - low
    mean_qe, mean_glass = (
        integral(lambda nm, c=c: np.interp(nm, *c), knots) / width_nm for c in (qe, glass)
    )
    average = light(REFERENCE_K, lambda nm: 1.0)
    return (
        light(kelvin, lambda nm: 1.0) / average,
        light(kelvin, lambda nm: nm) / (average * mean_nm),
        light(kelvin, lambda nm: nm * seen(nm)) / (average * mean_nm * mean_qe * mean_glass),
    )


@pytest.mark.parametrize("sensor", ["ccd47-20", "kai-4021"])
@pytest.mark.parametrize(("weighting", "power"), [("energy", 0), ("photon", 1)])
def test_rapp_is_what_equations_5_1_to_5_3_say(made, sensor, weighting, power):
    table = made(f"rapp_{sensor}").table(f"rapp_{sensor}")
    assert (np.diff(table["temperature_k"]) > 0).all()
    for kelvin in (3000.0, 5000.0, 50_000.0):
        row = np.flatnonzero(table["temperature_k"] == kelvin)[0]
        ratios = [table[f"rapp{k}_{weighting}"][row] for k in (1, 2, 3)]
        assert ratios == pytest.approx(
            rapp_by_quadrature(kelvin, sensor, power), rel=QUADRATURE_LIMIT
        )


def test_rapp_is_one_where_both_models_are_the_same(made):
    """RAPP1 at the reference's own temperature."""
    ratios = rapp_ratios(np.array([9602.0]), study_optics("ccd47-20"), "energy")
    assert ratios[0, 0] == pytest.approx(1.0, rel=1e-9)
    rows = made("rapp_ccd47-20").table("rapp_ccd47-20")
    kelvin, rapp3 = rows["temperature_k"], rows["rapp3_photon"]
    assert kelvin[0] == pytest.approx(3000) and kelvin[-1] == pytest.approx(50_000)
    assert rapp3[0] > 1.7


def test_real_spectra_beat_black_bodies_in_the_chart_as_in_the_table(models_study):
    table, text = table_columns(models_study[0] / "spectra.csv"), models_study[1]["spectra"]
    assert table["spectral_type"] == list(load_library().spectral_type)
    median = {}
    for name in ("pickles, leave-one-out", "black body, ballesteros2012"):
        errors = np.abs(table[f"ccd47-20: {name} [%]"])[table["vi_mag"] < 2.5]
        median[name] = np.median(errors)
        assert f"{np.median(errors):.1f} %" in text
    assert (
        median["pickles, leave-one-out"]
        < 1.0
        < 3 * median["pickles, leave-one-out"]
        < median["black body, ballesteros2012"]
    )


def test_a_held_out_star_is_not_in_its_own_table():
    """A star made ten times brighter moves no other star's error by more than its share, and its
    own by all of it.
    """
    library = load_library()
    rates = np.exp(library.vi_mag)
    plain = held_out_errors(rates)
    changed = rates.copy()
    changed[40] *= 10
    assert held_out_errors(changed)[40] == pytest.approx((plain[40] + 1) / 10 - 1, rel=1e-9)


def test_the_zero_point_costs_the_same_at_every_colour(made):
    cost = made("choices").table("choices")["zero_point_iau-bolometric_mag"]
    assert cost.min() == pytest.approx(0.31, abs=0.01)
    assert cost.max() == pytest.approx(0.31, abs=0.01)


def test_hot_stars_differ_as_the_thesis_says(made):
    """Section 5.4, CCD47-20: 'higher than 9000 K ... results that differ from 15 % up to 5 %'; 5
    % is passed at 25 000 K.
    """
    table = made("rapp_ccd47-20").table("rapp_ccd47-20")
    hot = table["temperature_k"] >= 9000
    off = 1 - table["rapp3_photon"][hot]
    assert off[0] == pytest.approx(0.15, abs=0.005)
    assert (np.diff(off) < 0).all()
    assert off[-1] == pytest.approx(0.03, abs=0.02)


def test_the_source_s_step_is_in_the_table(made):
    table = made("temperature_scales").table("temperature_scales")
    assert (table["bv_mag"][0], table["bv_mag"][-1]) == (-0.35, 1.8)
    zero = np.flatnonzero(table["bv_mag"] == 0)[0]
    step_k = table["wang2021_k"][zero] - table["wang2021_k"][zero - 1]
    # thesis eq. 3.13
    assert step_k == pytest.approx(8906.09411 + 3.633 - (1079.20644 + 8180.59419), abs=0.01)
    percent = 100 * -step_k / table["wang2021_k"][zero - 1]
    step = f"wang2021 steps down by {-step_k:.0f} K ({percent:.1f} %) at B-V = 0"
    assert made("temperature_scales").text.startswith(step)
    assert abs(np.diff(table["ballesteros2012_k"])[zero - 1]) < 0.01
    ratio = table["ballesteros2012_k"] / table["torres2010_k"]
    assert table["ballesteros2012_percent"] == pytest.approx(100 * (ratio - 1), abs=1e-9)


def test_the_bolometric_zero_point_is_as_faint_as_its_own_arithmetic(made):
    """2.518e-8 W/m2 over sigma T^4, times pi B through Johnson V, against 3.631e-9 erg/s/cm2/A
    (Bessell 1998).
    """
    johnson = curve("johnson-v")
    h, c, k, sigma = 6.62607015e-34, 299792458.0, 1.380649e-23, 5.670374419e-8

    def exitance(nm):
        return (
            2
            * np.pi
            * h
            * c**2
            / (nm * 1e-9) ** 5
            / np.expm1(h * c / (nm * 1e-9 * k * REFERENCE_K))
        )

    mean = integral(lambda nm: exitance(nm) * np.interp(nm, *johnson), johnson[0])
    mean /= integral(lambda nm: np.interp(nm, *johnson), johnson[0])
    faint_mag = -2.5 * np.log10(2.518021002e-8 / (sigma * REFERENCE_K**4) * mean / 3.631e-2)
    table = made("zero_points").table("zero_points")
    cost = table["mag_against_default"]
    for k, (zero, weighting) in enumerate(
        zip(table["zero_point"], table["weighting"], strict=True)
    ):
        if zero == "iau-bolometric":
            assert cost[k] == pytest.approx(faint_mag, abs=BOLOMETRIC_MAG_LIMIT)
        elif weighting == "energy":
            assert cost[k] == 0
    assert len(cost) == 8


def test_choices_cost_what_a_bench_would_see(made):
    """The same stars through the tables that `hilstar frame` uses."""
    table = made("choices").table("choices")
    stars, optics = load_catalog().brighter_than(7.5), study_optics("ccd47-20")
    ones = np.zeros(len(stars))
    kelvin = electrons.star_temperatures_k(stars.bv_mag, "ballesteros2012")
    body = tabulate("dgs", optics, Photometry()).electrons_per_s(ones, kelvin)
    real = tabulate_pickles(optics, Photometry()).electrons_per_s(ones, stars.bv_mag, stars.vi_mag)
    near = np.abs(stars.bv_mag - 1.0) <= 0.05
    row = np.flatnonzero(table["bv_mag"] == 1.0)[0]
    mags = -2.5 * np.log10(real / body)[near]
    found = [table[f"pickles_{name}_mag"][row] for name in ("p5", "median", "p95")]
    assert found == pytest.approx(np.percentile(mags, (5, 50, 95)), abs=TABLE_MAG_LIMIT)
    assert table["stars_in_window"][row] == near.sum()
    rapp = made("rapp_ccd47-20").table("rapp_ccd47-20")
    at = electrons.star_temperatures_k(np.array([1.0]), "ballesteros2012")
    ags_mag = 2.5 * np.log10(np.interp(at, rapp["temperature_k"], rapp["rapp3_energy"]))
    # straight lines between 400 points
    assert table["brightness_ags_mag"][row] == pytest.approx(ags_mag[0], abs=1e-4)


def test_titles_say_what_the_tables_hold(made):
    for sensor in ("ccd47-20", "kai-4021"):
        table = made(f"rapp_{sensor}").table(f"rapp_{sensor}")
        at = dict(zip(table["temperature_k"], table["rapp3_energy"], strict=True))
        for words in (
            f"{at[3000]:.2f} times",
            f"{at[5000]:.2f} at 5000",
            f"{100 * at[9000] - 100:+.1f} %",
        ):
            assert words in made(f"rapp_{sensor}").text
    zero = made("zero_points").table("zero_points")
    assert f"{zero['electrons_per_s'][0] / 1e6:.1f} million" in made("zero_points").text
    fewer_mag = zero["mag_against_default"][2]
    fewer = f"{100 * (1 - 10 ** (-0.4 * fewer_mag)):.0f} % ({fewer_mag:.2f} mag) fewer"
    assert fewer in made("zero_points").text
    flat = made("choices").table("choices")["zero_point_iau-bolometric_mag"]
    assert f"iau-bolometric {np.median(flat):.2f}" in made("choices").text
    assert choices_finding(
        {"zero": np.array([0.31, 0.31]), "b ags": np.array([0.16, 0.32])}
    ).endswith(
        "zero changes most: half of Hipparcos to V = 7.5 by 0.31 mag and more; a twentieth are"
        " changed most by ags, by 0.32 mag"
    )


def test_the_note_of_spectra_counts_those_beyond_its_dashed_line(made):
    """The reddest spectra, whose V-I tells little."""
    vi_mag = made("spectra").table("spectra")["vi_mag"]
    notes = " ".join(text.get_text().replace("\n", " ") for text in made("spectra").chart.texts)
    assert f"each held out in turn; {(vi_mag >= 2.5).sum()} are redder than the" in notes


def test_a_title_follows_its_data(tmp_path, monkeypatch):
    """A zero point a magnitude brighter is in the title without a change to it."""
    before = zero_points(tmp_path).text
    monkeypatch.setattr(electrons, "BOLOMETRIC_0_W_M2", electrons.BOLOMETRIC_0_W_M2 * 10**0.4)
    (old,), (new,) = (
        re.findall(r"\((-?[\d.]+) mag\)", text) for text in (before, zero_points(tmp_path).text)
    )
    assert float(new) == pytest.approx(float(old) - 1, abs=0.011)  # two figures rounded at 0.01


def test_the_thesis_s_tables_stand_beside_what_is_here(made):
    rows = made("catalogue_errors").table("catalogue_errors")
    here, thesis = (dict(zip(rows["what"], rows[name], strict=True)) for name in ("here", "thesis"))
    assert thesis["V from T"] == here["V from T"] == 409  # table 2.2
    for name in (
        "sigma_bv_mag",
        "sigma_ra_mas",
        "sigma_dec_mas",
        "sigma_parallax_mas",
        "sigma_pm_ra_mas_yr",
    ):
        assert here[name] == pytest.approx(thesis[name], abs=0.025)  # table 2.3
    bands = made("passbands").table("passbands")
    assert list(bands["band"]) == ["U", "B", "V", "R", "I"]
    # table 2.5; Vega's own colours are not all 0
    assert bands["vega_v0"] == pytest.approx(bands["thesis_bessell"], rel=0.02)
    assert bands["effective_nm"] == pytest.approx(bands["thesis_effective_nm"], rel=0.02)
    dark = made("detector_laws").table("detector_laws")
    at = np.flatnonzero(dark["temperature_k"] == 293)[0]
    assert [dark[law][at] for law in list(dark)[1:]] == pytest.approx([203] * 5)
    assert "97.2 photons" in made("zodiacal").text
    assert "96.9 as sunlight" in made("zodiacal").text
    assert (
        "RAPP1 at 50000 K is 1.02, and 1.56 with any curve from 300 to 1050 nm"
        in made("rapp_kai-4021").text
    )


def test_every_figure_is_drawn_and_found(models_study):
    folder, texts = models_study
    table = table_columns(folder / "findings.csv")
    assert tuple(table["figure"]) == tuple(texts) == STEMS
    assert table["finding"] == list(texts.values())
    for stem in STEMS:
        with Image.open(folder / f"{stem}.png") as image:
            pixels = np.asarray(image.convert("RGB"), dtype=int)
        assert pixels.shape[1] > 700
        coloured = pixels.max(axis=2) - pixels.min(axis=2) > 60
        assert coloured[pixels.shape[0] // 8 :].mean() > 0.002
        # A title cut off would touch the sides; the margins are white.
        assert (pixels[:, :2] == 255).all() and (pixels[:, -2:] == 255).all()


def test_a_title_is_whole_in_even_lines():
    text = "CCD47-20 is off by 15 % at 9000 K and B-V = 0, " * 5
    lines = title_lines(text).split("\n")
    assert " ".join(lines).replace("\N{NO-BREAK SPACE}", " ") == text.strip()
    assert max(map(len, lines)) <= TITLE_COLUMNS
    assert min(map(len, lines)) > TITLE_COLUMNS / 2
    assert title_lines(text).count("15\N{NO-BREAK SPACE}%") == 5


def test_matplotlib_is_imported_by_a_drawing_and_pyplot_by_none():
    code = (
        "import sys, tempfile; from pathlib import Path; from hilstar.instruments.study import"
        " models;assert 'matplotlib' not in"
        " sys.modules;models.zero_points(Path(tempfile.mkdtemp())); assert 'matplotlib.pyplot' not"
        " in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=PATIENCE_S)


def test_the_stars_of_the_map_are_those_of_the_catalogue(made):
    """Figure 2.2: each cell has its stars, counted here one by one; the whole sky has 41 253
    square degrees.
    """
    table, catalog = made("star_density").table("star_density"), load_catalog()
    count = len(table["ra_deg"])
    assert count == 36 * 18
    cell_deg2 = 41_252.96 / count
    assert table["stars_deg2"].sum() * cell_deg2 == pytest.approx(len(catalog), rel=1e-5)
    height = np.sin(np.radians(catalog.dec_deg))
    for k in (int(table["stars_deg2"].argmax()), *range(0, count, count // 12)):
        across = np.abs(catalog.ra_deg - table["ra_deg"][k]) < 5
        middle = np.sin(np.radians(table["dec_deg"][k]))
        stars = (across & (np.abs(height - middle) < 1 / 18)).sum()
        # a star or two stand on an edge to within a rounding
        assert table["stars_deg2"][k] * cell_deg2 == pytest.approx(stars, abs=2)


def test_the_camera_s_frame_is_astropy_s_tangent_plane(made):
    """Figure 2.11: x and y over z are Astropy's tangent plane at the boresight, west and south
    of it.
    """
    table = made("frames").table("frames")
    plane = WCS(naxis=2)
    plane.wcs.ctype, plane.wcs.crval, plane.wcs.cdelt = (
        ["RA---TAN", "DEC--TAN"],
        [84.057, -1.2],
        [1.0, 1.0],
    )
    plane.wcs.crpix = [1.0, 1.0]
    ra_deg = np.degrees(np.arctan2(table["y_icrs"], table["x_icrs"])) % 360
    east_deg, north_deg = plane.all_world2pix(ra_deg, np.degrees(np.arcsin(table["z_icrs"])), 0)
    assert -np.degrees(table["x_cam"] / table["z_cam"]) == pytest.approx(east_deg, abs=1e-9)
    assert -np.degrees(table["y_cam"] / table["z_cam"]) == pytest.approx(north_deg, abs=1e-9)
    assert len(ra_deg) == 572


def test_zodiacal_light_near_the_earth_has_its_magnitude(made):
    """Figure 4.11: table 6.4's high zodiacal light is V = 22.1 through Johnson V, as the
    handbook says.
    """
    table, (nm, response) = made("backgrounds").table("backgrounds"), curve("johnson-v")
    # W/m2/arcsec2/nm
    per_nm = table["zodiacal"] * 6.62607015e-34 * 299_792_458 / (table["wavelength_nm"] * 1e-9)
    weight = np.interp(table["wavelength_nm"], nm, response, left=0, right=0)
    v_mag = -2.5 * np.log10((per_nm * weight).sum() / weight.sum() / (3.631e-9 * 1e-2))
    assert v_mag == pytest.approx(22.1, abs=0.03)
    assert table["earthshine_24_deg"] == pytest.approx(2 * table["earthshine_38_deg"])
    assert np.isnan(table["ground"][-1]) and table["ground"][200] > table["zodiacal"][200]
    glow = table["ground"] * 6.62607015e-34 * 299_792_458 / (table["wavelength_nm"] * 1e-9)
    glow_mag = -2.5 * np.log10(np.nansum(glow * weight) / weight.sum() / (3.631e-9 * 1e-2))
    assert glow_mag == pytest.approx(21.7, abs=0.03)
    for degrees, times in ((24, 2.0), (38, 1.0), (50, 0.5)):
        total = np.nansum(table[f"earthshine_{degrees}_deg"])
        assert total == pytest.approx(times * np.nansum(table["earthshine_38_deg"]))
        assert f"{total:.0f} at {degrees}" in made("backgrounds").text
    # known where its spectrum is, both ends included
    night_nm = np.loadtxt(NIGHT_SKY, delimiter=",", comments=("#", "w"))[:, 0]
    known = (table["wavelength_nm"] >= night_nm[0]) & (table["wavelength_nm"] <= night_nm[-1])
    assert np.isfinite(table["ground"]).tolist() == known.tolist()


def test_the_sun_s_type_and_vega_stand_beside_their_black_bodies(made):
    """Figures 3.1 and 2.13: both curves have one mean through V, or Vega's flux; Planck's law is
    written here.
    """
    nm, response = curve("johnson-v")
    for stem, star, kelvin in (("sun", "g2v", 5772.0), ("vega_logarithmic", "vega", 9602.0)):
        table = made(stem).table(stem)
        weight = np.interp(table["wavelength_nm"], nm, response, left=0, right=0)
        means = [
            np.trapezoid(table[name] * weight, table["wavelength_nm"])
            for name in (star, "blackbody")
        ]
        assert means[0] == pytest.approx(means[1], rel=2e-3)
        shape = table["blackbody"] / planck(table["wavelength_nm"], kelvin)
        assert shape == pytest.approx(shape[0], rel=1e-6)
    vega = made("vega_logarithmic").table("vega_logarithmic")
    over = vega["vega"] / vega["blackbody"]
    near, far = np.interp([350.0, 5000.0], vega["wavelength_nm"], over)
    fall = np.interp(1000, vega["wavelength_nm"], vega["vega"])
    fall /= np.interp(5000, vega["wavelength_nm"], vega["vega"])
    assert made("vega_logarithmic").text == (
        f"From 1 to 5 micrometres Vega's light falls by {fall:.0f} times; it has {near:.2f} of the"
        f" black body's at 350 nm, {far:.2f} at 5 micrometres"
    )
    g2v = made("sun").table("sun")
    for at_nm in (350, 400, 900):
        share = (g2v["g2v"] / g2v["blackbody"])[g2v["wavelength_nm"] == at_nm][0]
        assert f"{share:.2f} at {at_nm} nm" in made("sun").text


def mean_through_v(nm, values):
    """The mean of a spectrum (n,) at nm (n,) through Johnson V."""
    band_nm, response = curve("johnson-v")
    weight = np.interp(nm, band_nm, response, left=0, right=0)
    return float(np.trapezoid(values * weight, nm) / np.trapezoid(weight, nm))


def test_dark_current_and_read_noise_go_by_their_laws(made):
    """203 e-/s at 293 K by Boltzmann's factor of 0.56 eV, and by e2v's two laws (AIMO 1.14e6 T^3
    exp(-9080 / T), NIMO 122 T^3 exp(-6400 / T)); 2 e- at 1 MHz by the root of the band.
    """
    table = made("detector_laws").table("detector_laws")
    kelvin = table["temperature_k"]
    ev_per_k = constants.k / constants.e
    laws = {
        "Arrhenius, 0.56 eV": lambda t: np.exp(-0.56 / (ev_per_k * t)),
        "e2v AIMO": lambda t: t**3 * np.exp(-9080 / t),
        "e2v NIMO": lambda t: t**3 * np.exp(-6400 / t),
    }
    for name, law in laws.items():
        np.testing.assert_allclose(table[name], 203 * law(kelvin) / law(293.0), rtol=1e-6)
        at_273 = float(table[name][kelvin == 273][0])
        assert f"{at_273:.0f} by" in made("detector_laws").text
    carriers = table["depletion alone"] / 203
    np.testing.assert_allclose(table["half diffusion"] / 203, (carriers + carriers**2) / 2)
    hz = np.array([2e4, 1e6, 5e6])
    noises = models.read_noises(hz)
    assert list(noises) == [f"1/f corner {khz} kHz" for khz in (0, 10, 100)]
    for corner_hz, noise_e in zip((0.0, 1e4, 1e5), noises.values(), strict=True):
        wanted_e = 2 * np.sqrt((hz + corner_hz) / (1e6 + corner_hz))
        np.testing.assert_allclose(noise_e, wanted_e)


def test_zodiacal_light_of_each_colour_has_the_same_magnitude(made):
    table = made("zodiacal").table("zodiacal")
    nm = table.pop("wavelength_nm")
    assert (nm[0], nm[-1], len(nm)) == (330.0, 1100.0, 771)
    for light in table.values():
        w_m2_m = light * constants.h * constants.c / (nm * 1e-9) * 1e9
        v_mag = -2.5 * np.log10(mean_through_v(nm, w_m2_m) / 3.631e-2)
        # of straight pieces between nm, whose ends are half counted: 1e-4 of the light
        assert v_mag == pytest.approx(22.1, abs=1e-3)
        assert f"{np.trapezoid(light, nm):.1f}" in made("zodiacal").text
    sun, far, near = (light * nm**-1.0 for light in table.values())
    np.testing.assert_allclose(sun / planck(nm, 5772.0), (sun / planck(nm, 5772.0))[0], rtol=1e-6)
    # redder than the Sun, and more so near it
    assert far[-1] / far[0] > sun[-1] / sun[0]
    assert abs(near[-1] / near[0] - far[-1] / far[0]) > 0.01 * far[-1] / far[0]


def test_sensors_glass_and_black_bodies_are_the_packaged_curves_and_planck_s(made):
    table = made("curves").table("curves")
    nm = table["wavelength_nm"]
    for name in ("ccd47-20", "kai-4021", "n-bk7-10mm"):
        knots_nm, response = curve(name)
        np.testing.assert_allclose(table[name], np.interp(nm, knots_nm, response, left=0, right=0))
        if name != "n-bk7-10mm":
            peak_nm = knots_nm[response.argmax()]
            words = f"{knots_nm[0]:.0f} to {knots_nm[-1]:.0f} nm, most at {peak_nm:.0f}"
            assert words in made("curves").text
    for kelvin in (3000, 5000, 9000, 30_000):
        light = planck(nm, kelvin)
        np.testing.assert_allclose(
            table[f"blackbody_{kelvin}_k"], light / light.max(), rtol=QUADRATURE_LIMIT
        )


def test_passbands_are_weighed_by_vega_s_light(made):
    """Of V the flux is the zero point itself; Vega at V = 0 has it, and so has the black body."""
    table, light = made("passbands").table("passbands"), made("passbands").table("vega")
    assert table["vega_v0"][2] == pytest.approx(3.631e-9)
    nm = light["wavelength_nm"]
    for name in ("vega", "blackbody_9602_k"):
        assert mean_through_v(nm, light[name]) == pytest.approx(1.0, rel=2e-3)
    body = light["blackbody_9602_k"] / planck(nm, REFERENCE_K)
    np.testing.assert_allclose(body, body[0], rtol=QUADRATURE_LIMIT)
    # by R and I, whose ends lie within the table of Vega
    for row, band in ((3, "r"), (4, "i")):
        band_nm, response = curve(f"bessell-{band}")
        weight = np.interp(nm, band_nm, response, left=0, right=0) * light["vega"]
        assert table["effective_nm"][row] == pytest.approx((weight * nm).sum() / weight.sum(), 1e-3)
        share = weight.sum() / np.interp(nm, band_nm, response, left=0, right=0).sum()
        assert table["vega_v0"][row] == pytest.approx(3.631e-9 * share, rel=3e-3)
    off = np.abs(table["vega_v0"] / table["thesis_bessell"] - 1).max()
    assert f"within {100 * off:.1f} %" in made("passbands").text
    assert f"it has {np.interp(350, nm, light['vega'] / light['blackbody_9602_k']):.2f} of" in (
        made("passbands").text
    )


def test_a_scale_s_error_is_in_electrons_of_its_own_temperature(made):
    table = made("temperature_scales").table("temperature_scales")
    qe, glass, johnson = curve("ccd47-20"), curve("n-bk7-10mm"), curve("johnson-v")
    knots_nm = np.union1d(qe[0], glass[0])
    knots_nm = knots_nm[(knots_nm >= qe[0][0]) & (knots_nm <= qe[0][-1])]

    def detected(kelvin):
        seen = integral(
            lambda nm: planck(nm, kelvin) * np.interp(nm, *qe) * np.interp(nm, *glass) * nm,
            knots_nm,
        )
        return seen / integral(lambda nm: planck(nm, kelvin) * np.interp(nm, *johnson), johnson[0])

    for name in ("torres2010_supergiant", "ballesteros2012", "wang2021"):
        for row in (3, 60, 200):
            ratio = detected(table[f"{name}_k"][row]) / detected(table["torres2010_k"][row])
            wanted_mag = -2.5 * np.log10(ratio)
            assert table[f"{name}_mag"][row] == pytest.approx(wanted_mag, abs=1e-5)
    stars = load_catalog()
    bv_mag = stars.bv_mag[(stars.v_mag <= 7.5) & (stars.bv_mag >= -0.35) & (stars.bv_mag <= 1.8)]
    for name in ("ballesteros2012", "wang2021"):
        off_mag = np.abs(np.interp(bv_mag, table["bv_mag"], table[f"{name}_mag"]))
        half, most = np.percentile(off_mag, (50, 95))
        assert f"{half:.3f} ({most:.2f}) mag by {name}" in made("temperature_scales").text


def test_the_catalogue_s_errors_are_of_its_bright_stars_and_its_maps_of_their_cells(made):
    catalog, errors = load_catalog(), made("catalogue_errors")
    table = errors.table("catalogue_errors")
    here = dict(zip(table["what"], table["here"], strict=True))
    facts = facts_of(catalog.hip)
    bright = catalog.v_mag < 9
    assert here["sigma_bv_mag"] == pytest.approx(facts["sigma_bv_mag"].mean())
    for name in ("sigma_ra_mas", "sigma_pm_dec_mas_yr"):
        assert here[name] == pytest.approx(np.median(facts[name][bright]))
    # rows without a place, V or B-V are not packaged: 1 % of the thesis's
    for name, thesis in zip(table["what"][:6], table["thesis"][:6], strict=True):
        assert here[name] <= thesis and here[name] == pytest.approx(thesis, rel=0.015)
    assert sum(here[f"V from {source}"] for source in "GHT") == len(catalog)
    maps = errors.chart.axes[6:8]
    assert all("Sky map" in axes.get_title(loc="left") for axes in maps)
    for axes, name in zip(maps, ("sigma_ra_mas", "sigma_dec_mas"), strict=True):
        medians = np.asarray(axes.collections[0].get_array()).reshape(36, 72)
        # 40 to 45 degrees, sine of the declination 1/18 to 2/18
        cell = (catalog.ra_deg // 5 == 8) & (np.sin(np.radians(catalog.dec_deg)) * 18 // 1 == 1)
        assert medians[19, 8] == pytest.approx(np.median(facts[name][cell]))
        # 200 to 205 degrees, near the southern pole: cells are of equal areas
        cell = (catalog.ra_deg // 5 == 40) & (np.sin(np.radians(catalog.dec_deg)) < -17 / 18)
        assert cell.sum() > 5
        assert medians[0, 40] == pytest.approx(np.median(facts[name][cell]))
        assert np.isfinite(medians).all()


@pytest.mark.parametrize(
    "stem", ["rapp_ccd47-20", "curves", "zodiacal", "sun", "vega_logarithmic", "backgrounds"]
)
def test_every_curve_of_a_chart_is_a_column_of_its_table(made, stem):
    x, *columns = made(stem).table(stem).values()
    drawn = []
    for axes in made(stem).chart.axes:
        for line in axes.get_lines():
            if len(line.get_xdata()) == len(x):
                np.testing.assert_array_equal(line.get_xdata(), x)
                drawn.append(line.get_ydata())
    assert len(drawn) == len(columns)
    for column in columns:
        assert any(np.array_equal(column, curve, equal_nan=True) for curve in drawn)


def test_the_chart_of_spectra_says_what_half_and_95_percent_of_stars_are_within(
    tmp_path, figures, monkeypatch
):
    library = load_library()
    late = (library.vi_mag >= 2.5) & [name.endswith("III") for name in library.spectral_type]
    sure = library.vi_mag < 2.5
    assert late.sum() > 3

    def real(count):
        return np.where(late, -200.0, np.linspace(-3, 1, count))

    def body(count):
        return np.where(late, 900.0, np.linspace(-40, 10, count))

    def by_type(count):
        return np.where(late, 5.0, np.linspace(-2, 8, count))

    rows = []
    for sensor, factor in (("ccd47-20", 3.0), ("kai-4021", 2.0)):
        for method, planted in (
            (models.HELD_OUT, real),
            (models.BY_TYPE, by_type),
            ("black body, wang2021", body),
            (models.BODY, body),
        ):
            percent = factor * planted(len(library.vi_mag))
            rows.append(models.SpectrumErrors(sensor, method, percent))
    monkeypatch.setattr(models, "spectrum_errors", lambda: rows)
    text = models.spectra(tmp_path).text
    half, most = np.percentile(np.abs(real(106))[sure], (50, 95))
    body_half, body_most = np.percentile(np.abs(body(106))[sure], (50, 95))
    thrice = f"CCD47-20 {3 * half:.1f} % ({3 * most:.1f} %)"
    assert f"{thrice} by real spectra and V-I, {3 * body_half:.1f} %" in text
    assert f"{2 * half:.1f} % ({2 * most:.1f} %) by real spectra" in text
    type_most = np.percentile(np.abs(by_type(106))[sure], 95)
    assert f"CCD47-20 600 % by V-I, 15.0 % by MK type (others {3 * type_most:.1f} %)" in text
    (figure,) = figures
    title = " ".join(figure.get_suptitle().replace("\N{NO-BREAK SPACE}", " ").split())
    # of the worse of both sensors, the first
    assert f"within {3 * most:.1f} % for 95 % of stars" in title
    assert f"by B-V within {3 * body_most:.0f} %" in title
    for axes, factor in zip(figure.axes, (3.0, 2.0), strict=True):
        by_label = {line.get_label(): line for line in axes.get_lines()}
        np.testing.assert_array_equal(by_label[models.HELD_OUT].get_xdata(), library.vi_mag)
        np.testing.assert_array_equal(by_label[models.HELD_OUT].get_ydata(), factor * real(106))
        np.testing.assert_array_equal(by_label[models.BODY].get_ydata(), factor * body(106))
    table = table_columns(tmp_path / "spectra.csv")
    assert table["spectral_type"] == list(library.spectral_type)
    np.testing.assert_allclose(table[f"kai-4021: {models.BY_TYPE} [%]"], 2 * by_type(106))


def test_black_bodies_are_as_wrong_as_recorded(monkeypatch):
    """Real spectra by colour within 0.79 and 2.42 % on the CCD47-20 (tests/authority); by type they
    are another test's, and none here.
    """
    monkeypatch.setattr(models, "held_out_by_type", lambda rates: np.arange(2.0 * 106))
    rows = {(row.sensor, row.method): row for row in models.spectrum_errors()}
    sure = load_library().vi_mag < 2.5
    for sensor, figures in HELD_OUT.items():
        within = rows[sensor, models.HELD_OUT].within(sure)
        assert within == pytest.approx(figures, abs=HUNDREDTH_OF_A_PERCENT)
        assert rows[sensor, models.BY_TYPE].percent.tolist() == (100 * np.arange(106.0)).tolist()
    optics = study_optics("ccd47-20")
    real = electrons.library_electrons_per_s(load_library(), optics, Photometry())
    kelvin = electrons.star_temperatures_k(load_library().bv_mag, "ballesteros2012")
    body = tabulate("dgs", optics, Photometry()).electrons_per_s(np.zeros(106), kelvin)
    np.testing.assert_allclose(
        rows["ccd47-20", models.BODY].percent, 100 * (body / real - 1), atol=1e-3
    )


def test_a_study_s_findings_are_of_its_figures_in_their_order(tmp_path, monkeypatch):
    def figure(name):
        return lambda folder: models.ChartFinding(name, f"{name} in {folder.name}")

    def of_sensor(folder, sensor):
        return models.ChartFinding(f"rapp_{sensor}", folder.name)

    monkeypatch.setattr(models, "FIGURES", (figure("b"), figure("a")))
    monkeypatch.setattr(models, "rapp", of_sensor)
    found = models.run(tmp_path)
    names = ["rapp_ccd47-20", "rapp_kai-4021", "b", "a"]
    assert [finding.figure for finding in found] == names
    rows = csv_rows(tmp_path / "findings.csv")
    assert [(row["figure"], row["finding"]) for row in rows] == [
        (finding.figure, finding.text) for finding in found
    ]


def test_a_star_s_electrons_are_planck_s_through_30_mm_of_glass_and_the_ccd(made):
    """Thesis eq. 3.1 at V = 0 and 9602 K: pi/4 D^2 times 3.631e-2 W/m2/m through Johnson V, by
    h c / lambda each, the quantum efficiency and 10 mm of N-BK7.
    """
    qe, glass, johnson = curve("ccd47-20"), curve("n-bk7-10mm"), curve("johnson-v")
    knots_nm = np.union1d(qe[0], glass[0])
    knots_nm = knots_nm[(knots_nm >= qe[0][0]) & (knots_nm <= qe[0][-1])]
    in_v = integral(lambda nm: planck(nm, REFERENCE_K) * np.interp(nm, *johnson), johnson[0])
    in_v /= integral(lambda nm: np.interp(nm, *johnson), johnson[0])
    seen = integral(
        lambda nm: planck(nm, REFERENCE_K) * np.interp(nm, *qe) * np.interp(nm, *glass) * nm,
        knots_nm,
    )
    # nm twice: of the wavelength, and of its interval
    per_m2 = 3.631e-2 * seen / in_v * 1e-18 / (constants.h * constants.c)
    table = made("zero_points").table("zero_points")
    assert table["electrons_per_s"][0] == pytest.approx(np.pi / 4 * 0.03**2 * per_m2, rel=1e-6)


def test_v_and_b_v_are_from_as_many_stars_as_table_2_2_has_but_for_those_without_a_place():
    """The thesis counts all 118 218 rows; the catalogue has those with a place and a V."""
    counts = {row.what: row.here for row in models.source_counts(load_catalog())}
    assert (counts["V from T"], counts["B-V from T"]) == (409, 75_732)
    assert counts["B-V from H"] == 0
    for what, printed in (("V from G", 23_139), ("V from H", 94_669), ("B-V from G", 41_205)):
        assert 0.98 * printed < counts[what] < printed
    assert sum(counts[f"V from {source}"] for source in "GHT") <= len(load_catalog())


def test_the_percentiles_at_a_colour_are_of_the_stars_within_a_twentieth_of_a_magnitude():
    """Twenty stars are enough, and nineteen are none."""
    bv_mag = np.arange(60) * 0.005
    percentiles = running_percentiles(bv_mag, 2 * bv_mag, np.array([0.1, 0.0473, 0.0423, 9.0]))
    # 0.05 to 0.15; 0 to 0.0973; 0 to 0.0923
    assert percentiles[3].tolist() == [21, 20, 19, 0]
    assert percentiles[:3, 0] == pytest.approx([0.11, 0.2, 0.29])
    assert np.isfinite(percentiles[:3]).all(axis=0).tolist() == [True, True, False, False]


def test_a_star_s_choice_costs_what_it_costs_alone():
    optics = study_optics("ccd47-20")
    stars = load_catalog().taken(np.array([5, 100, 7, 40_000]))
    assert len(set(stars.bv_mag.tolist())) == 4
    together = models.star_costs_mag(stars, optics)
    last = models.star_costs_mag(stars.taken(np.array([3])), optics)
    for name, mag in together.items():
        assert mag[3:] == pytest.approx(last[name], abs=1e-9), name
    assert len(set(together["spectrum pickles"].round(6).tolist())) == 4


def test_torres_has_supergiants_of_their_own_and_wang_steps_down_at_zero():
    errors = models.scale_errors()
    zero = int(np.flatnonzero(errors.bv == 0.0)[0])
    wang_k = errors.kelvin["wang2021"]
    assert errors.bv[zero - 1] == -1e-9
    assert wang_k[zero - 1] - wang_k[zero] > 100 > abs(wang_k[zero + 1] - wang_k[zero])
    # Torres 2010, table 2, has a polynomial of their own
    one = int(np.flatnonzero(errors.bv == 1.0)[0])
    assert abs(errors.percent[models.SUPERGIANTS][one]) > 1.0
    within = errors.within["wang2021"]
    assert 0 < within[0] < within[1]


def test_stars_beyond_a_scale_s_colours_are_not_within_anything():
    """Of an error that rises from 0 to 1 mag over B-V of 0.5 to 0.6."""
    bright = load_catalog()
    bv_mag = bright.bv_mag[bright.v_mag <= 7.5]
    inside = bv_mag[(bv_mag >= 0.5) & (bv_mag <= 0.6)]
    assert 1000 < len(inside) < 0.1 * len(bv_mag)
    wanted = np.percentile((inside - 0.5) / 0.1, (50, 95))
    assert models.within_mag(np.array([0.5, 0.6]), np.array([0.0, 1.0])) == pytest.approx(wanted)
