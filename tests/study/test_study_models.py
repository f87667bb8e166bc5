"""The models study: its tables against figures from elsewhere, its titles against its tables,
its pictures not blank.
"""

import re
import subprocess
import sys

import numpy as np
import pytest
from astropy.wcs import WCS
from PIL import Image
from scipy import constants

from hilstar.basics.charts import TITLE_COLUMNS, title_lines
from hilstar.instruments.study.models import (
    FIGURES,
    choices_finding,
    running_percentiles,
    spectra,
    zero_points,
)
from hilstar.instruments.study.rapp import SENSORS, rapp, rapp_ratios
from hilstar.instruments.study.sky_figures import star_density
from hilstar.instruments.study.study_benches import held_out_errors, study_optics
from hilstar.sky import electrons
from hilstar.sky.catalog import load_catalog
from hilstar.sky.electrons import Photometry, load_library, tabulate, tabulate_pickles
from hilstar.sky.spectrum import DATA_DIR
from tests.support.studies import undrawn
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
def whole_models(whole_study):
    found = whole_study("models", STEMS, "")
    return found.folder, dict(line.split(": ", 1) for line in found.findings)


@pytest.fixture(scope="module")
def models_study(tmp_path_factory):
    """The tables of every figure but `spectra`, which takes most of the study's time, and what they
    say.
    """
    folder = tmp_path_factory.mktemp("models")
    with undrawn():
        findings = [rapp(folder, sensor) for sensor in SENSORS]
        findings += [figure(folder) for figure in FIGURES if figure is not spectra]
    return folder, {finding.figure: finding.text for finding in findings}


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
def test_rapp_is_what_equations_5_1_to_5_3_say(models_study, sensor, weighting, power):
    table = table_columns(models_study[0] / f"rapp_{sensor}.csv")
    assert (np.diff(table["temperature_k"]) > 0).all()
    for kelvin in (3000.0, 5000.0, 50_000.0):
        row = np.flatnonzero(table["temperature_k"] == kelvin)[0]
        ratios = [table[f"rapp{k}_{weighting}"][row] for k in (1, 2, 3)]
        assert ratios == pytest.approx(
            rapp_by_quadrature(kelvin, sensor, power), rel=QUADRATURE_LIMIT
        )


def test_rapp_is_one_where_both_models_are_the_same(models_study):
    """RAPP1 at the reference's own temperature; and the thesis's '15 % up to 5 %' of hot stars
    on the CCD47-20.
    """
    ratios = rapp_ratios(np.array([9602.0]), study_optics("ccd47-20"), "energy")
    assert ratios[0, 0] == pytest.approx(1.0, rel=1e-9)
    rows = table_columns(models_study[0] / "rapp_ccd47-20.csv")
    kelvin, rapp3 = rows["temperature_k"], rows["rapp3_photon"]
    assert kelvin[0] == pytest.approx(3000) and kelvin[-1] == pytest.approx(50_000)
    assert np.interp(9000, kelvin, rapp3) == pytest.approx(0.85, abs=0.01)
    assert np.interp(50_000, kelvin, rapp3) == pytest.approx(0.97, abs=0.02)
    assert rapp3[0] > 1.7


def test_the_zero_points_differ_by_a_third_of_a_magnitude(models_study):
    table = table_columns(models_study[0] / "zero_points.csv")
    bolometric = [
        setting == ("iau-bolometric", "energy")
        for setting in zip(table["zero_point"], table["weighting"], strict=True)
    ]
    assert table["mag_against_default"][bolometric] == pytest.approx([0.31, 0.31], abs=0.01)


def test_real_spectra_beat_black_bodies_in_the_chart_as_in_the_table(whole_models):
    table, text = table_columns(whole_models[0] / "spectra.csv"), whole_models[1]["spectra"]
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


def test_the_zero_point_costs_the_same_at_every_colour(models_study):
    cost = table_columns(models_study[0] / "choices.csv")["zero_point_iau-bolometric_mag"]
    assert cost.min() == pytest.approx(0.31, abs=0.01)
    assert cost.max() == pytest.approx(0.31, abs=0.01)


def test_hot_stars_differ_as_the_thesis_says(models_study):
    """Section 5.4, CCD47-20: 'higher than 9000 K ... results that differ from 15 % up to 5 %'; 5
    % is passed at 25 000 K.
    """
    table = table_columns(models_study[0] / "rapp_ccd47-20.csv")
    hot = table["temperature_k"] >= 9000
    off = 1 - table["rapp3_photon"][hot]
    assert off[0] == pytest.approx(0.15, abs=0.005)
    assert (np.diff(off) < 0).all()
    assert 0 < off[-1] < 0.05


def test_the_source_s_step_is_in_the_table(models_study):
    table = table_columns(models_study[0] / "temperature_scales.csv")
    assert (table["bv_mag"][0], table["bv_mag"][-1]) == (-0.35, 1.8)
    zero = np.flatnonzero(table["bv_mag"] == 0)[0]
    step_k = table["wang2021_k"][zero] - table["wang2021_k"][zero - 1]
    # thesis eq. 3.13
    assert step_k == pytest.approx(8906.09411 + 3.633 - (1079.20644 + 8180.59419), abs=0.01)
    assert abs(np.diff(table["ballesteros2012_k"])[zero - 1]) < 0.01
    ratio = table["ballesteros2012_k"] / table["torres2010_k"]
    assert table["ballesteros2012_percent"] == pytest.approx(100 * (ratio - 1), abs=1e-9)


def test_the_bolometric_zero_point_is_as_faint_as_its_own_arithmetic(models_study):
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
    table = table_columns(models_study[0] / "zero_points.csv")
    cost = table["mag_against_default"]
    for k, (zero, weighting) in enumerate(
        zip(table["zero_point"], table["weighting"], strict=True)
    ):
        if zero == "iau-bolometric":
            assert cost[k] == pytest.approx(faint_mag, abs=BOLOMETRIC_MAG_LIMIT)
        elif weighting == "energy":
            assert cost[k] == 0
    assert len(cost) == 8


def test_choices_cost_what_a_bench_would_see(models_study):
    """The same stars through the tables that `hilstar frame` uses."""
    table = table_columns(models_study[0] / "choices.csv")
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
    ratios = table_columns(models_study[0] / "rapp_ccd47-20.csv")
    at = electrons.star_temperatures_k(np.array([1.0]), "ballesteros2012")
    ags_mag = 2.5 * np.log10(np.interp(at, ratios["temperature_k"], ratios["rapp3_energy"]))
    # straight lines between 400 points
    assert table["brightness_ags_mag"][row] == pytest.approx(ags_mag[0], abs=1e-4)


def test_there_are_no_percentiles_where_stars_are_few():
    bv_mag = np.concatenate([np.full(19, 0.0), np.full(20, 1.0)])
    low, middle, high, count = running_percentiles(
        bv_mag, np.arange(39.0), np.array([0.0, 1.0, 2.0])
    )
    assert count.tolist() == [19, 20, 0]
    for values in (low, middle, high):
        assert np.isnan(values).tolist() == [True, False, True]
    assert middle[1] == pytest.approx(28.5)


@pytest.mark.parametrize("sensor", HELD_OUT)
def test_real_spectra_are_as_wrong_as_measured(whole_models, sensor):
    table = table_columns(whole_models[0] / "spectra.csv")
    assert len(table["spectral_type"]) == 106
    errors = np.abs(table[f"{sensor}: pickles, leave-one-out [%]"][table["vi_mag"] < 2.5])
    assert np.percentile(errors, (50, 95)) == pytest.approx(
        HELD_OUT[sensor], abs=HUNDREDTH_OF_A_PERCENT
    )


def test_titles_say_what_the_tables_hold(models_study):
    folder, texts = models_study
    for sensor in ("ccd47-20", "kai-4021"):
        table = table_columns(folder / f"rapp_{sensor}.csv")
        at = dict(zip(table["temperature_k"], table["rapp3_energy"], strict=True))
        for words in (
            f"{at[3000]:.2f} times",
            f"{at[5000]:.2f} at 5000",
            f"{100 * at[9000] - 100:+.1f} %",
        ):
            assert words in texts[f"rapp_{sensor}"]
    zero = table_columns(folder / "zero_points.csv")
    assert f"{zero['electrons_per_s'][0] / 1e6:.1f} million" in texts["zero_points"]
    assert f"({zero['mag_against_default'][2]:.2f} mag)" in texts["zero_points"]
    flat = table_columns(folder / "choices.csv")["zero_point_iau-bolometric_mag"]
    assert f"iau-bolometric {np.median(flat):.2f}" in texts["choices"]
    assert choices_finding(
        {"zero": np.array([0.31, 0.31]), "b ags": np.array([0.16, 0.32])}
    ).endswith(
        "zero changes most: half of Hipparcos to V = 7.5 by 0.31 mag and more; a twentieth are"
        " changed most by ags, by 0.32 mag"
    )


def test_the_title_of_spectra_says_what_its_table_holds(whole_models):
    folder, texts = whole_models
    table = table_columns(folder / "spectra.csv")
    for name in ("pickles, leave-one-out", "black body, ballesteros2012"):
        errors = np.abs(table[f"kai-4021: {name} [%]"][table["vi_mag"] < 2.5])
        assert "{:.1f} % ({:.1f} %)".format(*np.percentile(errors, (50, 95))) in texts["spectra"]


def test_a_title_follows_its_data(tmp_path, monkeypatch):
    """A zero point a magnitude brighter is in the title without a change to it."""
    before = zero_points(tmp_path).text
    monkeypatch.setattr(electrons, "BOLOMETRIC_0_W_M2", electrons.BOLOMETRIC_0_W_M2 * 10**0.4)
    (old,), (new,) = (
        re.findall(r"\((-?[\d.]+) mag\)", text) for text in (before, zero_points(tmp_path).text)
    )
    assert float(new) == pytest.approx(float(old) - 1, abs=0.011)  # two figures rounded at 0.01


def test_the_thesis_s_tables_stand_beside_what_is_here(models_study):
    folder, texts = models_study
    rows = table_columns(folder / "catalogue_errors.csv")
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
    bands = table_columns(folder / "passbands.csv")
    assert list(bands["band"]) == ["U", "B", "V", "R", "I"]
    # table 2.5; Vega's own colours are not all 0
    assert bands["vega_v0"] == pytest.approx(bands["thesis_bessell"], rel=0.02)
    assert bands["effective_nm"] == pytest.approx(bands["thesis_effective_nm"], rel=0.02)
    dark = table_columns(folder / "detector_laws.csv")
    at = np.flatnonzero(dark["temperature_k"] == 293)[0]
    assert [dark[law][at] for law in list(dark)[1:]] == pytest.approx([203] * 5)
    assert "97.2 photons" in texts["zodiacal"] and "96.9 as sunlight" in texts["zodiacal"]
    assert (
        "RAPP1 at 50000 K is 1.02, and 1.56 with any curve from 300 to 1050 nm"
        in texts["rapp_kai-4021"]
    )


def test_every_figure_is_drawn_and_found(whole_models):
    folder, texts = whole_models
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


def test_the_stars_of_the_map_are_those_of_the_catalogue(models_study):
    """Figure 2.2: each cell has its stars, counted here one by one; the whole sky has 41 253
    square degrees.
    """
    table, catalog = table_columns(models_study[0] / "star_density.csv"), load_catalog()
    cell_deg2 = 41_252.96 / len(table["ra_deg"])
    assert table["stars_deg2"].sum() * cell_deg2 == pytest.approx(len(catalog), rel=1e-5)
    k = int(table["stars_deg2"].argmax())
    half = 1 / 18
    middle = np.sin(np.radians(table["dec_deg"][k]))
    near = (np.abs(catalog.ra_deg - table["ra_deg"][k]) < 5) & (
        np.abs(np.sin(np.radians(catalog.dec_deg)) - middle) < half
    )
    assert table["stars_deg2"][k] * cell_deg2 == pytest.approx(near.sum(), abs=0.5)


def test_the_camera_s_frame_is_astropy_s_tangent_plane(models_study):
    """Figure 2.11: x and y over z are Astropy's tangent plane at the boresight, west and south
    of it.
    """
    table = table_columns(models_study[0] / "frames.csv")
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


def test_zodiacal_light_near_the_earth_has_its_magnitude(models_study):
    """Figure 4.11: table 6.4's high zodiacal light is V = 22.1 through Johnson V, as the
    handbook says.
    """
    table, (nm, response) = table_columns(models_study[0] / "backgrounds.csv"), curve("johnson-v")
    # W/m2/arcsec2/nm
    per_nm = table["zodiacal"] * 6.62607015e-34 * 299_792_458 / (table["wavelength_nm"] * 1e-9)
    weight = np.interp(table["wavelength_nm"], nm, response, left=0, right=0)
    v_mag = -2.5 * np.log10((per_nm * weight).sum() / weight.sum() / (3.631e-9 * 1e-2))
    assert v_mag == pytest.approx(22.1, abs=0.03)
    assert table["earthshine_24_deg"] == pytest.approx(2 * table["earthshine_38_deg"])
    assert np.isnan(table["ground"][-1]) and table["ground"][200] > table["zodiacal"][200]


def test_the_sun_s_type_and_vega_stand_beside_their_black_bodies(models_study):
    """Figures 3.1 and 2.13: both curves have one mean through V, or Vega's flux; Planck's law is
    written here.
    """
    nm, response = curve("johnson-v")
    for stem, star, kelvin in (("sun", "g2v", 5772.0), ("vega_logarithmic", "vega", 9602.0)):
        table = table_columns(models_study[0] / f"{stem}.csv")
        weight = np.interp(table["wavelength_nm"], nm, response, left=0, right=0)
        means = [
            np.trapezoid(table[name] * weight, table["wavelength_nm"])
            for name in (star, "blackbody")
        ]
        assert means[0] == pytest.approx(means[1], rel=2e-3)
        shape = table["blackbody"] / planck(table["wavelength_nm"], kelvin)
        assert shape == pytest.approx(shape[0], rel=1e-6)


def test_the_bolometric_zero_point_has_a_quarter_fewer_electrons_than_vega(tmp_path, figures):
    """A magnitude of 0 is 2.518021e-8 W/m2 (IAU 2015, resolution B2), of which a black body of
    9602 K has the share of Planck's law at V's 551 nm, in place of Vega's 3.631e-2 W/m2/m.
    """
    peak = constants.h * constants.c / (551e-9 * constants.k * REFERENCE_K)
    exitance = 2 * np.pi * constants.h * constants.c**2 / 551e-9**5 / np.expm1(peak)
    share = exitance / (constants.sigma * REFERENCE_K**4)
    fainter_mag = -2.5 * np.log10(2.518021e-8 * share / 3.631e-2)
    text = zero_points(tmp_path).text
    percent, mag = re.search(r"(\d+) % \((\S+) mag\) fewer", text).groups()
    # V is 90 nm wide, over which the spectrum is bent: 0.02 mag
    assert float(mag) == pytest.approx(fainter_mag, abs=0.02)
    assert float(percent) == pytest.approx(100 * (1 - 10 ** (-0.4 * float(mag))), abs=1)
    assert len(figures) == 1


def test_a_cell_of_the_map_stands_at_its_middle_and_has_its_stars(tmp_path, figures):
    star_density(tmp_path)
    catalog = load_catalog()
    rows = csv_rows(tmp_path / "star_density.csv")
    assert len(rows) == 36 * 18 and len(figures) == 1
    sky_deg2 = 4 * np.pi * np.degrees(1) ** 2
    height = np.sin(np.radians(catalog.dec_deg))
    for row in rows[:: len(rows) // 12]:
        across = np.abs(catalog.ra_deg - float(row["ra_deg"])) < 5
        middle = np.sin(np.radians(float(row["dec_deg"])))
        inside = across & (np.abs(height - middle) < 1 / 18)
        density = inside.sum() / (sky_deg2 / len(rows))
        # a star or two stand on an edge to within a rounding
        assert float(row["stars_deg2"]) == pytest.approx(density, abs=2 * len(rows) / sky_deg2)
