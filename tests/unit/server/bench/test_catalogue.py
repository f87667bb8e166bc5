"""A bench's catalogue: magnitudes against published relations, neighbours, errors, and files as
others read them.
"""

from __future__ import annotations

import re

import numpy as np
import pyarrow.parquet
import pytest
from astropy.io import fits
from astropy.io.votable import parse_single_table
from numpy.polynomial.polynomial import polyval

from hilstar.basics.units import ARCSEC_PER_RAD, magnitude
from hilstar.server.bench.bench_file import read_bench_file
from hilstar.server.bench.catalogue import (
    bench_catalogue,
    nearest_neighbours,
    sigma_instrument_mag,
    write_catalogue,
)
from hilstar.server.bench.star_rates import bench_optics, star_kinds, star_rates
from hilstar.sky.catalog import load_catalog
from hilstar.sky.electrons import Photometry
from hilstar.sky.facts import errors_of, sigma_v_mag
from hilstar.sky.stars import unit_vectors_icrs
from hilstar.sky.synthetic import colours
from hilstar.sky.table_reader import G_LESS_I, G_LESS_V, GAIA_RANGE_MAG
from tests.support.benches import bench_text
from tests.support.claims import holds
from tests.support.tables import csv_rows

# Riello et al. 2021 (A&A 649, A3, table C.2) have 0.030 mag of scatter about G - V and 0.038 about
# G - I of BP - RP. Measured: 0.010 and 0.029 mag by colour (median, 95 %), 0.015 and 0.033 by type,
# from V-I = 0 to 2.5.
G_MEDIAN_MAG = 0.02
# B of Landolt-class ground photometry (source G): B-V has no part in cool stars' spectra. Measured:
# 0.043 and 0.119 mag.
B_MEDIAN_MAG, B_P95_MAG = 0.06, 0.15
STEP_MAG = 1e-4
DIFFERENCE_LIMIT = 0.01  # of the derivative's step, 0.01 mag over which rates bend


@pytest.fixture(scope="module")
def catalogue_bench(tmp_path_factory):
    path = tmp_path_factory.mktemp("catalogue") / "bench.toml"
    path.write_text(bench_text({"collimator": {"focal_length_mm": 350}, "sky": {"spectrum": "mk"}}))
    return read_bench_file(path)


@pytest.fixture(scope="module")
def bright(catalogue_bench):
    return bench_catalogue(catalogue_bench, 3.0, 2030.0)


@pytest.mark.parametrize("spectrum", ["pickles", "mk"])
def test_gaia_s_g_follows_the_published_relation(catalogue_bench, spectrum):
    stars = load_catalog().brighter_than(5.0)
    kind = star_kinds(catalogue_bench.config, stars)
    bp_rp = np.linspace(*GAIA_RANGE_MAG, 2000)
    g_less_v, v_less_i = (
        polyval(bp_rp, G_LESS_V),
        polyval(bp_rp, G_LESS_I) - polyval(bp_rp, G_LESS_V),
    )
    kept = (stars.vi_mag > 0) & (stars.vi_mag < 2.5)
    found = colours(spectrum, "ballesteros2012", Photometry())["g"](
        stars.bv_mag, stars.vi_mag, kind
    )
    off = np.abs(found - np.interp(stars.vi_mag, v_less_i, g_less_v))[kept]
    assert np.median(off) < G_MEDIAN_MAG
    holds("gaia-g", np.percentile(off, 95))


def test_b_is_that_of_ground_photometry(catalogue_bench):
    stars = load_catalog().brighter_than(5.0)
    kind, ground = star_kinds(catalogue_bench.config, stars), errors_of(stars)["bv_source"] == b"G"
    found = colours("mk", "ballesteros2012", Photometry())["b"](stars.bv_mag, stars.vi_mag, kind)
    off = np.abs(found - stars.bv_mag)[ground & (stars.vi_mag < 2.0)]
    assert len(off) > 1000
    assert np.median(off) < B_MEDIAN_MAG
    assert np.percentile(off, 95) < B_P95_MAG


def test_the_nearest_neighbour_is_that_of_all_distances():
    stars = load_catalog().brighter_than(5.5)
    rows = np.arange(0, len(stars), 7)
    found, arcsec = nearest_neighbours(stars, rows, 2026.0)
    vectors = unit_vectors_icrs(stars, 2026.0)
    angle = np.arctan2(
        np.linalg.norm(np.cross(vectors[rows, None], vectors), axis=2), vectors[rows] @ vectors.T
    )
    angle[np.arange(len(rows)), rows] = np.inf
    angle[stars.v_mag >= stars.v_mag[rows, None] + 3.0] = np.inf
    assert found.tolist() == angle.argmin(axis=1).tolist()
    assert arcsec == pytest.approx(angle.min(axis=1) * ARCSEC_PER_RAD, rel=1e-6)
    lone = stars.taken(np.flatnonzero(stars.hip == 32349))
    assert np.isnan(nearest_neighbours(lone, np.array([0]), 2026.0)[1]).all()


@pytest.mark.parametrize("spectrum", ["pickles", "mk"])
def test_the_error_of_an_instrument_magnitude_is_that_of_small_steps(catalogue_bench, spectrum):
    from msgspec.structs import replace

    config = replace(
        catalogue_bench.config, sky=replace(catalogue_bench.config.sky, spectrum=spectrum)
    )
    stars = load_catalog().brighter_than(3.0)
    facts, rates, kind = (
        errors_of(stars),
        star_rates(config, catalogue_bench.folder),
        star_kinds(config, stars),
    )
    v, bv, vi = stars.v_mag, stars.bv_mag, stars.vi_mag
    base, variance = rates(v, bv, vi, kind), sigma_v_mag(facts, bv) ** 2
    for name, changed in (
        ("sigma_bv_mag", (bv + STEP_MAG, vi)),
        ("sigma_vi_mag", (bv, vi + STEP_MAG)),
    ):
        slope = magnitude(rates(v, *changed, kind) / base) / STEP_MAG
        variance = variance + np.where(slope == 0, 0, slope * facts[name]) ** 2
    known = np.isfinite(variance)
    assert known.sum() > 100
    assert sigma_instrument_mag(stars, facts, rates, kind)[known] == pytest.approx(
        np.sqrt(variance[known]), rel=DIFFERENCE_LIMIT, abs=1e-4
    )
    # an unknown error is unknown wherever its colour acts
    for name, changed in (
        ("sigma_bv_mag", (bv + STEP_MAG, vi)),
        ("sigma_vi_mag", (bv, vi + STEP_MAG)),
    ):
        unknown = facts | {name: np.full(len(stars), np.nan)}
        acts = rates(v, *changed, kind) != base
        found = sigma_instrument_mag(stars, unknown, rates, kind)
        assert np.isnan(found[acts & known]).all()


@pytest.mark.parametrize("ending", ["csv", "fits", "vot", "parquet"])
def test_a_file_is_read_back_with_units_and_ucds(bright, tmp_path, ending):
    path = tmp_path / f"stars.{ending}"
    write_catalogue(path, bright)
    described = {name: (column.unit, column.ucd) for name, column in bright.columns.items()}
    if ending == "parquet":
        read = pyarrow.parquet.read_table(path)
        values = {name: np.array(read[name].to_pylist()) for name in read.column_names}
        meta = {
            field.name: {k.decode(): v.decode() for k, v in field.metadata.items()}
            for field in read.schema
        }
        units = {name: (found["unit"], found["ucd"]) for name, found in meta.items()}
    elif ending == "vot":
        votable = parse_single_table(path)
        values = {field.name: np.ma.getdata(votable.array[field.name]) for field in votable.fields}
        units = {field.name: (_unit(field.unit), field.ucd) for field in votable.fields}
    elif ending == "fits":
        with fits.open(path) as hdus:
            data, header = hdus[1].data, hdus[1].header
            values = {name: np.array(data[name]) for name in data.names}
            places = {name: k for k, name in enumerate(data.names, start=1)}
            units = {
                name: (_unit(header.get(f"TUNIT{k}")), header[f"TUCD{k}"])
                for name, k in places.items()
            }
            assert header["EPOCH"] == 2030.0
    else:
        rows = csv_rows(path)
        values = {name: np.array([row[name] for row in rows]) for name in rows[0]}
        units = described
    assert list(values) == list(bright.columns)
    described = {name: (_unit(unit), ucd) for name, (unit, ucd) in described.items()}
    assert {name: (_unit(unit), ucd) for name, (unit, ucd) in units.items()} == described
    for name, column in bright.columns.items():
        if column.values.dtype.kind == "f":
            assert values[name].astype(float) == pytest.approx(
                column.values, rel=1e-5, nan_ok=True
            ), name
        else:
            assert [str(v).strip() for v in values[name]] == [
                str(v).strip() for v in column.values
            ], name


def test_a_type_with_a_comma_stays_in_its_field(catalogue_bench, tmp_path):
    made = bench_catalogue(catalogue_bench, 6.0, None)
    assert "C0,0 (F8pe)" in made.columns["spectral_type"].values  # HIP 77442
    write_catalogue(tmp_path / "stars.csv", made)
    rows = csv_rows(tmp_path / "stars.csv")
    for name in ("spectral_type", "variable", "double", "neighbour"):
        assert [row[name] for row in rows] == made.columns[name].values.tolist()


def _unit(unit):
    from astropy import units

    return "" if not unit else units.Unit(str(unit)).to_string()


OTHER_SENSORS = (
    {"aperture_mm": 12, "quantum_efficiency": "kai-4021"},
    {"aperture_mm": 85, "quantum_efficiency": "qe.csv"},
)


@pytest.mark.parametrize("tracker", OTHER_SENSORS, ids=["kai-4021", "own curve"])
def test_instrument_magnitudes_are_those_of_own_quadrature(tmp_path, tracker):
    """Electrons of Vega's spectrum and of AB 0 by trapezia every 0.01 nm, and what the columns
    have by them.
    """
    (tmp_path / "qe.csv").write_text("wavelength_nm,value\n420,0.1\n500,0.6\n640,0.75\n880,0.2\n")
    text = bench_text({"collimator": {"focal_length_mm": 350}, "tracker": tracker})
    (tmp_path / "bench.toml").write_text(text)
    file = read_bench_file(tmp_path / "bench.toml")
    optics, made = bench_optics(file.config.tracker, file.folder), bench_catalogue(file, 2.0, None)
    low, high = optics.range_nm
    nm = np.linspace(low, high, round((high - low) * 100) + 1)
    response = (
        optics.quantum_efficiency(nm)
        * optics.transmission(nm)
        * np.pi
        / 4
        * (tracker["aperture_mm"] * 1e-3) ** 2
    )
    h, c = 6.62607015e-34, 299_792_458.0
    ab0 = np.trapezoid(response * 3.631e-23 / (h * nm * 1e-9), nm * 1e-9)
    vega_nm, vega = np.loadtxt(
        _data("vega.csv"), delimiter=",", comments="#", skiprows=_header("vega.csv"), unpack=True
    )
    v_nm, v = np.loadtxt(
        _data("johnson-v.csv"),
        delimiter=",",
        comments="#",
        skiprows=_header("johnson-v.csv"),
        unpack=True,
    )
    fine = np.linspace(v_nm[0], v_nm[-1], 40_001)
    passband = np.interp(fine, v_nm, v)
    mean = np.trapezoid(passband * np.interp(fine, vega_nm, vega), fine) / np.trapezoid(
        passband, fine
    )
    flux = np.interp(nm, vega_nm, vega) / mean * 3.631e-2 * 10 ** (-0.4 * 0.03)
    vega_e = np.trapezoid(response * flux * nm * 1e-9 / (h * c), nm * 1e-9)
    rate = made.columns["electrons_per_s"].values
    assert made.columns["instrument_mag_ab"].values == pytest.approx(
        -2.5 * np.log10(rate / ab0), abs=1e-4
    )
    assert made.columns["instrument_mag_vega"].values == pytest.approx(
        0.03 - 2.5 * np.log10(rate / vega_e), abs=1e-4
    )


def test_a_neighbour_is_as_much_fainter_at_most_as_its_description_says(bright):
    said = re.search(r"less than ([\d.]+) mag fainter", bright.columns["neighbour"].description)
    neighbour_mag = bright.columns["neighbour_v_mag"].values
    fainter_mag = neighbour_mag - bright.columns["v_mag"].values
    # of 177 stars some have one near the limit
    assert float(said[1]) - 0.1 < fainter_mag.max() < float(said[1])


@pytest.mark.parametrize("system", ["vega", "ab"])
def test_a_magnitude_s_zero_point_is_the_one_that_its_description_and_the_file_state(
    bright, tmp_path, system
):
    """The magnitude of one electron per second, to the digits that are written."""
    name = f"instrument_mag_{system}"
    rate = bright.columns["electrons_per_s"].values
    zero_mag = bright.columns[name].values + 2.5 * np.log10(rate)
    stated = re.search(r"(\d+\.\d{4}) - 2\.5 log10", bright.columns[name].description)
    assert zero_mag == pytest.approx(float(stated[1]), abs=0.6e-4)
    write_catalogue(tmp_path / "stars.fits", bright)
    header = fits.getheader(tmp_path / "stars.fits", 1)
    assert zero_mag == pytest.approx(header[f"ZP{system.upper()}"], abs=0.6e-4)


def _data(name):
    from hilstar.sky.spectrum import DATA_DIR

    return DATA_DIR / name


def _header(name):
    lines = _data(name).read_text().splitlines()
    return next(k for k, line in enumerate(lines) if line[:1].isdigit())


# Hipparcos' facts by the names that Gaia and Tycho-2 give such columns.
TABLE_NAMES = {
    "sigma_ra_mas": "ra_error", "sigma_dec_mas": "dec_error", "sigma_parallax_mas": "parallax_error",
    "sigma_pm_ra_mas_yr": "pmra_error", "sigma_pm_dec_mas_yr": "pmdec_error", "ra_dec_correlation": "ra_dec_corr",
    "ra_pm_ra_correlation": "ra_pmra_corr", "dec_pm_ra_correlation": "dec_pmra_corr", "ra_pm_dec_correlation": "ra_pmdec_corr",
    "dec_pm_dec_correlation": "dec_pmdec_corr", "pm_ra_pm_dec_correlation": "pmra_pmdec_corr", "sigma_bv_mag": "e_B-V",
    "sigma_vi_mag": "e_V-I",
}  # fmt: skip


@pytest.mark.parametrize("ending", ["csv", "fits", "vot"])
def test_a_table_s_own_errors_and_types_are_carried_as_hipparcos_s_are(
    catalogue_bench, tmp_path, ending
):
    from astropy.table import Table

    stars = load_catalog().brighter_than(2.5)
    facts = errors_of(stars)
    columns = {
        "ra": stars.ra_deg,
        "dec": stars.dec_deg,
        "pmra": stars.pm_ra_cosdec_mas_yr,
        "pmdec": stars.pm_dec_mas_yr,
    }
    columns |= {
        "Vmag": stars.v_mag,
        "B-V": stars.bv_mag,
        "V-I": stars.vi_mag,
        "Plx": stars.parallax_mas,
    }
    columns |= {name: facts[role] for role, name in TABLE_NAMES.items()} | {
        "e_Vmag": sigma_v_mag(facts, stars.bv_mag)
    }
    table = Table(columns | {"SpType": facts["spectral_type"].astype(str)})
    table["ra_error"].unit = "mas"
    forms = {
        "csv": {"format": "ascii.csv"},
        "fits": {"format": "fits"},
        "vot": {"format": "votable"},
    }
    table.write(tmp_path / f"own.{ending}", overwrite=True, **forms[ending])
    sky = {"spectrum": "mk", "catalogue": f"own.{ending}", "catalogue_epoch_jyear": 1991.25}
    (tmp_path / "bench.toml").write_text(
        bench_text({"collimator": {"focal_length_mm": 350}, "sky": sky})
    )
    own = read_bench_file(tmp_path / "bench.toml")
    found, wanted = (
        bench_catalogue(own, 2.5, 2030.0).columns,
        bench_catalogue(catalogue_bench, 2.5, 2030.0).columns,
    )
    order, theirs = (
        np.lexsort((one["dec_deg"].values, one["v_mag"].values)) for one in (found, wanted)
    )
    names = [name for name in wanted if name.startswith("sigma_") or name.endswith("correlation")]
    assert len(names) == 10
    for name in names:
        # by colour: a table's stars have no type that draws them
        if name != "sigma_instrument_mag":
            assert found[name].values[order] == pytest.approx(
                wanted[name].values[theirs], rel=1e-6, nan_ok=True
            ), name
    assert (
        found["spectral_type"].values[order].tolist()
        == wanted["spectral_type"].values[theirs].tolist()
    )
    assert set(found["v_source"].values.tolist()) == {"U"}


# the columns that are a catalogue's own figures, at its own epoch, and where those stand
OF_CATALOGUE = {
    "hip": "hip", "ra_deg": "ra_deg", "dec_deg": "dec_deg", "pm_ra_mas_yr": "pm_ra_cosdec_mas_yr",
    "pm_dec_mas_yr": "pm_dec_mas_yr", "parallax_mas": "parallax_mas", "v_mag": "v_mag",
    "b_v_mag": "bv_mag", "v_i_mag": "vi_mag", "range_mag": "range_mag", "period_d": "period_d",
}  # fmt: skip
OF_FACTS = {
    "sigma_ra_mas": "sigma_ra_mas", "sigma_dec_mas": "sigma_dec_mas",
    "sigma_pm_ra_mas_yr": "sigma_pm_ra_mas_yr", "sigma_pm_dec_mas_yr": "sigma_pm_dec_mas_yr",
    "sigma_parallax_mas": "sigma_parallax_mas", "ra_dec_correlation": "ra_dec_correlation",
    "sigma_b_v_mag": "sigma_bv_mag", "sigma_v_i_mag": "sigma_vi_mag",
}  # fmt: skip
ROUNDED = 1e-6  # of a figure in single precision, and of places with their decimals


def test_each_column_of_the_catalogue_s_own_figures_has_its_own(catalogue_bench):
    own = bench_catalogue(catalogue_bench, 2.5, 1991.25)
    stars = load_catalog().brighter_than(2.5)
    stars = stars.taken(np.argsort(stars.v_mag, kind="stable"))
    facts = errors_of(stars)
    assert len(own) == len(stars) > 80
    sources = [(OF_CATALOGUE, lambda name: getattr(stars, name)), (OF_FACTS, facts.__getitem__)]
    for names, source in sources:
        for column, name in names.items():
            wanted = np.asarray(source(name), dtype=float)
            assert len(np.unique(wanted)) > 5, name  # no column stands for another by chance
            found = np.asarray(own.columns[column].values, dtype=float)
            np.testing.assert_allclose(found, wanted, rtol=1e-6, atol=ROUNDED, err_msg=column)
    v = own.columns["v_mag"].values
    for column, colour, sign in (
        ("b_measured_mag", "b_v_mag", 1),
        ("i_measured_mag", "v_i_mag", -1),
    ):
        wanted = v + sign * own.columns[colour].values
        np.testing.assert_allclose(own.columns[column].values, wanted, atol=ROUNDED)
    # a double's two components have its light together, and differ as they were measured
    first, second = (own.columns[f"component_{k}_mag"].values for k in "ab")
    double = np.isfinite(second)
    assert double.sum() > 5
    difference = facts["difference_hp_mag"]
    np.testing.assert_allclose((second - first)[double], difference[double], atol=ROUNDED)
    together = -2.5 * np.log10(10 ** (-0.4 * first) + 10 ** (-0.4 * second))
    np.testing.assert_allclose(together[double], v[double], atol=ROUNDED)
    # absolute magnitudes are those of 10 pc, of parallaxes of five sigmas and more
    parallax = own.columns["parallax_mas"].values
    modulus = 5 * np.log10(1000 / parallax / 10)
    is_sure = parallax > 5 * own.columns["sigma_parallax_mas"].values
    for column, apparent in (
        ("absolute_mag", "v_mag"),
        ("absolute_bolometric_mag", "bolometric_mag"),
    ):
        found = own.columns[column].values
        assert np.isfinite(found[is_sure]).all()
        assert not np.isfinite(found[parallax < 5 * own.columns["sigma_parallax_mas"].values]).any()
        known = np.isfinite(found)
        wanted = own.columns[apparent].values - modulus
        np.testing.assert_allclose(found[known], wanted[known], atol=ROUNDED)


def test_a_right_ascension_that_rounds_up_to_the_full_circle_is_0(tmp_path):
    rows = [
        "ra,dec,pmra,pmdec,Vmag,B-V",
        "359.9999999999,10.0,0,0,1.0,0.5",
        "0.25,-5.5,0,0,2.0,0.5",
    ]
    (tmp_path / "own.csv").write_text("\n".join(rows))
    sky = {"catalogue": "own.csv", "catalogue_epoch_jyear": 1991.25}
    (tmp_path / "bench.toml").write_text(bench_text({"sky": sky}))
    own = bench_catalogue(read_bench_file(tmp_path / "bench.toml"), None, 1991.25)
    assert own.columns["ra_deg"].values.tolist() == [0.0, 0.25]
    assert own.columns["dec_deg"].values.tolist() == [10.0, -5.5]


def test_a_brighter_limit_is_the_command_s_and_the_file_s_where_it_gives_none(tmp_path):
    path = tmp_path / "bench.toml"
    path.write_text(bench_text({"sky": {"faintest_v_mag": 1.25, "epoch_jyear": 2010.0}}))
    file = read_bench_file(path)
    own = bench_catalogue(file, None, None)
    assert own.epoch_jyear == 2010.0
    v = own.columns["v_mag"].values
    assert (np.diff(v) >= 0).all()
    assert v.max() <= 1.25 and len(own) == len(load_catalog().brighter_than(1.25))
    brighter = bench_catalogue(file, 0.5, 2020.0)
    assert brighter.columns["v_mag"].values.max() <= 0.5 and brighter.epoch_jyear == 2020.0
