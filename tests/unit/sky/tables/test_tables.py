"""Tables of stars as users have them: formats, column names, units, and what is refused."""

from __future__ import annotations

import gzip
import os

import astropy.units as u
import numpy as np
import pytest
from astropy.table import MaskedColumn, Table

from hilstar.sky.catalog import load_catalog, plain_catalog
from hilstar.sky.facts import errors_of
from hilstar.sky.star_table import TableChoice, choose_catalog, table_facts
from hilstar.sky.table_reader import from_gaia
from tests.support.refusals import refusal

# CSV, ECSV and VOTable have float64 in 17 digits.
SAME = 1e-12


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def read_stars(path, **choice):
    return choose_catalog(TableChoice(path, **choice))


def gaia_table() -> Table:
    """Five stars with the columns of gaiadr3.gaia_source; the fourth has no BP, the last no
    place.
    """
    return Table(
        {
            "source_id": np.array([5, 4_295_806_720, 2**62 + 1, 7, 8]),
            "ra": MaskedColumn([10.5, 359.999, 0.0, 33.0, 0.0], mask=[0, 0, 0, 0, 1], unit=u.deg),
            "dec": MaskedColumn([-45.25, 89.9, 12.0, 1.0, 0.0], unit=u.deg),
            "ref_epoch": np.full(5, 2016.0),
            "pmra": MaskedColumn(
                [-3.5, 0.0, 100.25, 1.0, 1.0], mask=[0, 1, 0, 0, 0], unit=u.mas / u.yr
            ),
            "pmdec": np.array([1.0, 2.0, 3.0, 4.0, 5.0]) * u.mas / u.yr,
            "parallax": MaskedColumn([2.0, 0.0, 5.0, 1.0, 1.0], mask=[0, 1, 0, 0, 0], unit=u.mas),
            "phot_g_mean_mag": np.array([5.0, 6.0, 7.0, 8.0, 9.0]) * u.mag,
            "phot_bp_mean_mag": MaskedColumn(
                [5.5, 6.1, 8.0, 0.0, 9.0], mask=[0, 0, 0, 1, 0], unit=u.mag
            ),
            "phot_rp_mean_mag": MaskedColumn([4.5, 6.0, 6.0, 7.0, 8.0], unit=u.mag),
            "note": ["a b", "c,d", "", "e", "f"],
        }
    )


FORMATS = {
    "t.fits": {},
    "t.ecsv": {},
    "comma.ecsv": {"format": "ascii.ecsv", "delimiter": ","},
    "t.csv": {},
    "t.vot": {"format": "votable"},
    "binary.xml": {"format": "votable", "tabledata_format": "binary2"},
    "t.tsv": {"format": "ascii.fast_tab"},
}


@pytest.mark.parametrize("name", FORMATS)
def test_gaia_s_own_columns_are_read_from_every_format(tmp_path, name, caplog):
    gaia_table().write(tmp_path / name, **FORMATS[name])
    catalog = read_stars(tmp_path / name)
    assert [catalog.name(row) for row in np.argsort(catalog.v_mag)] == [
        "Gaia DR3 5",
        "Gaia DR3 4295806720",
        f"Gaia DR3 {2**62 + 1}",
    ]
    row = {name: row for row, name in enumerate(map(catalog.name, range(3)))}
    first, second, third = (
        row["Gaia DR3 5"],
        row["Gaia DR3 4295806720"],
        row[f"Gaia DR3 {2**62 + 1}"],
    )
    v, vi = from_gaia(np.array([5.0, 7.0]), np.array([1.0, 2.0]))
    assert catalog.v_mag[[first, third]] == pytest.approx(v, abs=SAME)
    assert catalog.vi_mag[[first, third]] == pytest.approx(vi, abs=SAME)
    assert (catalog.ra_deg[second], catalog.dec_deg[first]) == (359.999, -45.25)
    assert catalog.pm_ra_cosdec_mas_yr[[first, second, third]].tolist() == [-3.5, 0.0, 100.25]
    assert catalog.parallax_mas[third] == 5.0
    assert np.isnan(catalog.parallax_mas[second])
    assert (catalog.epoch_jyear == 2016.0).all()
    assert not catalog.hip.any()
    assert catalog.rows_read == 5
    assert "1 without a place, 1 without a magnitude and a colour" in caplog.text


def test_tycho_2_has_its_own_names_epoch_and_second_places(tmp_path):
    table = Table(
        {
            "TYC1": [1, 2, 9537],
            "TYC2": [13, 7, 12121],
            "TYC3": [1, 2, 3],
            "RAmdeg": MaskedColumn([2.25, 3.0, 0.0], mask=[0, 0, 1]),
            "DEmdeg": MaskedColumn([1.0, -2.0, 0.0], mask=[0, 0, 1]),
            "RAdeg": [2.3, 3.1, 4.0],
            "DEdeg": [1.1, -2.1, -80.0],
            "pmRA": MaskedColumn([5.0, -6.0, 0.0], mask=[0, 0, 1]),
            "pmDE": MaskedColumn([7.0, 8.0, 0.0], mask=[0, 0, 1]),
            "BTmag": [9.0, 10.0, 11.0],
            "VTmag": [9.0, 9.5, 10.0],
            "HIP": MaskedColumn([77, 77, 0], mask=[0, 0, 1]),
        }
    )
    table.write(tmp_path / "tyc2.fits")
    catalog = read_stars(tmp_path / "tyc2.fits")
    stars = {catalog.name(row): row for row in range(3)}
    # One HIP number is of one star, the brighter.
    assert sorted(stars) == ["HIP 77", "TYC 2-7-2", "TYC 9537-12121-3"]
    assert catalog.ra_deg[[stars["HIP 77"], stars["TYC 9537-12121-3"]]].tolist() == [2.25, 4.0]
    assert (catalog.epoch_jyear == 2000.0).all()
    assert np.isnan(catalog.vi_mag).all()
    # Packed by gzip it is the same table.
    (tmp_path / "tyc2.fits.gz").write_bytes(gzip.compress((tmp_path / "tyc2.fits").read_bytes()))
    assert (read_stars(tmp_path / "tyc2.fits.gz").ra_deg == catalog.ra_deg).all()


def test_units_are_the_table_s(tmp_path):
    table = Table(
        {
            "ra": np.array([6.0, 12.0]) * u.hourangle,
            "dec": np.radians([10.0, -10.0]) * u.rad,
            "pmra": np.array([0.5, -1.0]) * u.arcsec / u.yr,
            "pmdec": np.array([100.0, 0.0]) * u.mas / u.yr,
            "plx": np.array([0.1, 0.2]) * u.arcsec,
            "vmag": [3.0, 4.0],
            "b-v": [0.5, 1.0],
            "v-i": [0.6, np.nan],
        }
    )
    table.write(tmp_path / "t.ecsv")
    catalog = read_stars(tmp_path / "t.ecsv", epoch_jyear=2000.0)
    order = np.argsort(catalog.v_mag)
    assert catalog.ra_deg[order] == pytest.approx([90, 180])
    assert catalog.dec_deg[order] == pytest.approx([10, -10])
    assert catalog.pm_ra_cosdec_mas_yr[order] == pytest.approx([500, -1000])
    assert catalog.parallax_mas[order] == pytest.approx([100, 200])
    assert catalog.vi_mag[order] == pytest.approx([0.6, np.nan], nan_ok=True)


def test_a_known_name_goes_before_a_name_with_a_unit_in_whatever_order_they_stand(tmp_path):
    names = ("ra", "ra_hours", "dec", "vmag", "b-v")
    values = dict(zip(names, (90.0, 3.0, 10.0, 5.0, 0.5), strict=True))
    for order in (names, names[::-1]):
        path = tmp_path / f"{order[0]}.csv"
        row = [str(values[name]) for name in order]
        path.write_text(f"{','.join(order)}\n{','.join(row)}\n")
        assert read_stars(path).ra_deg.tolist() == [90.0]


def test_stars_of_hipparcos_in_its_own_columns_are_hipparcos(tmp_path):
    packaged = load_catalog().brighter_than(2.0)
    table = Table(
        {
            "HIP": packaged.hip,
            "RAICRS": packaged.ra_deg,
            "DEICRS": packaged.dec_deg,
            "pmRA": packaged.pm_ra_cosdec_mas_yr,
            "pmDE": packaged.pm_dec_mas_yr,
            "Vmag": packaged.v_mag,
            "B-V": packaged.bv_mag,
            "V-I": packaged.vi_mag,
        }
    )
    table.write(tmp_path / "hip.csv")
    own = read_stars(tmp_path / "hip.csv")
    order = np.argsort(own.hip)
    for name in (
        "hip",
        "ra_deg",
        "dec_deg",
        "pm_ra_cosdec_mas_yr",
        "v_mag",
        "bv_mag",
        "vi_mag",
        "epoch_jyear",
    ):
        assert np.array_equal(
            getattr(own, name)[order], getattr(packaged, name)[np.argsort(packaged.hip)]
        ), name


def test_repeated_and_impossible_rows_are_counted(tmp_path, caplog):
    rows = [
        "1,2,nan,0.1",
        "1,2,5,",
        ",2,5,1",
        "1,2,5,1",
        "1,2,5,1",
        "2,99,5,1",
        "3,3,inf,1",
        "-20,3,4,1",
    ]
    (tmp_path / "t.csv").write_text("ra,dec,vmag,b-v\n" + "\n".join(rows) + "\n")
    catalog = read_stars(tmp_path / "t.csv")
    assert sorted(catalog.ra_deg.tolist()) == [1.0, 340.0]
    # of two alike the first
    assert {catalog.name(0), catalog.name(1)} == {"t row 4", "t row 8"}
    counts = (
        "1 without a place, 3 without a magnitude and a colour, 1 beyond what a star has, 1"
        " repeated"
    )
    assert counts in caplog.text
    assert catalog.notes[0].endswith(counts)


def test_rows_that_are_no_star_repeat_no_identifier_and_a_whole_table_says_nothing(
    tmp_path, caplog
):
    head = "source_id,ra_deg,dec_deg,v_mag,bv_mag\n"
    whole = ["17,1,2,5.0,0.3", "18,3,4,6.0,0.5", "19,5,6,7.0,0.7"]
    (tmp_path / "whole.csv").write_text(head + "\n".join(whole) + "\n")
    read_stars(tmp_path / "whole.csv")
    assert caplog.text == ""
    (tmp_path / "dark.csv").write_text(head + "\n".join([*whole, "18,7,8,,0.2"]) + "\n")
    read_stars(tmp_path / "dark.csv")
    assert "not used: 1 without a magnitude" in caplog.text
    assert "identifier" not in caplog.text


def test_a_hip_number_is_the_brightest_star_s_of_the_rows_that_are_stars(tmp_path):
    """The brightest row that has the number has no colour, and is no star."""
    text = "hip,ra_deg,dec_deg,v_mag,bv_mag\n7,1,2,3.0,\n7,3,4,5.0,0.2\n7,5,6,6.0,0.3\n"
    (tmp_path / "t.csv").write_text(text)
    stars = read_stars(tmp_path / "t.csv")
    assert stars.v_mag[stars.hip == 7].tolist() == [5.0]


def sky(count: int) -> Table:
    rng = np.random.default_rng(4)
    return Table(
        {
            "ra": rng.uniform(0, 360, count),
            "dec": np.degrees(np.arcsin(rng.uniform(-1, 1, count))),
            "vmag": rng.uniform(3, 9, count),
            "b-v": np.full(count, 0.5),
        }
    )


def test_hours_and_arcseconds_without_a_unit_are_noticed(tmp_path):
    table = sky(1000)
    table["pmra"], table["pmdec"] = table["dec"] / 100, table["dec"] / 200
    table.write(tmp_path / "t.csv")
    line = refusal(read_stars, tmp_path / "t.csv", epoch_jyear=2000.0)
    assert "so they are in arcsec a year; give the column its unit" in line
    hours = sky(1000)
    hours["ra"] /= 15
    hours.write(tmp_path / "hours.csv")
    assert "so it is in hours" in refusal(read_stars, tmp_path / "hours.csv")


HEAD = "ra,dec,vmag,b-v\n"
REFUSED = {
    "": "is empty; give a table of stars",
    HEAD: "has no rows",
    "x,y\n1,2\n": (
        "no right ascension and declination among its columns (x, y); name them ra and dec"
    ),
    "ra,dec,mass\n1,2,3\n": (
        "no magnitude with a colour among its columns (ra, dec, mass); name V with B-V"
    ),
    "hello\nworld\n": "its first line names no columns",
    HEAD + "12:00:00,-01:02:03,5,0.1\n": "is no column of numbers (its first is '",
    HEAD + "1,2,nan,0.1\n1,2,5,\n": (
        "none of its 2 rows is a star (2 without a magnitude and a colour)"
    ),
    HEAD + "1,2,3,0.1\n1,2,3,4,5\n": "cannot be read",
    "ra,dec,vmag,b-v,pmra,pmdec\n1,2,3,0.1,5,5\n": "write [sky] catalogue_epoch_jyear",
    "ra,dec,vmag,b-v,pmra,pmdec,ref_epoch\n1,2,3,0.1,5,5,1\n": "column ref_epoch is no Julian year",
    "ra,dec,vmag,b-v,ref_epoch\n1,2,3,0.1,2000\n3,4,5,0.1,2448349.0625\n": (
        "column ref_epoch is no Julian year; write [sky] catalogue_epoch_jyear, such as 2000.0"
    ),
    "source_id,ra,dec,vmag,b-v\n" + "9" * 30 + ",1,2,3,0.1\n": (
        "column source_id is no column of numbers"
    ),
    HEAD.strip() + "," + "x," * 2000 + "\n": "its first line names more than 1000 columns",
    "# %ECSV 1.0\n# ---\n# datatype: {\nra dec\n1 2\n": "cannot be read",
    '<?xml version="1.0"?><VOTABLE>': "cannot be read",
    '<?xml version="1.0"?><VOTABLE><STREAM\nencoding="base64" href="http://127.0.0.1/"/></VOTABLE>': (
        "at another place"
    ),
}


@pytest.mark.parametrize("text", REFUSED)
def test_what_is_no_table_of_stars_is_refused_in_one_line(tmp_path, text):
    path = tmp_path / "t.dat"
    path.write_text(text)
    line = refusal(read_stars, path)
    assert REFUSED[text] in line and line.startswith(str(path))


def test_files_of_other_kinds_are_refused_by_name(tmp_path):
    gaia_table().write(tmp_path / "t.fits")
    whole = (tmp_path / "t.fits").read_bytes()
    (tmp_path / "cut.fits").write_bytes(whole[: len(whole) - 2880])
    (tmp_path / "t.csv.gz").write_bytes(gzip.compress(b"ra,dec\n"))
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "huge.csv").touch()
    os.truncate(tmp_path / "huge.csv", 10_000_000_000)
    refused = {
        "cut.fits": "cannot be read",
        "t.csv.gz": "it is a gzip file); unpack it first",
        "pipe": "is a pipe",
        "huge.csv": "it has 10 GB or more, and at most 4 GB are read",
        "missing.fits": "No such file",
    }
    for name, words in refused.items():
        assert words in refusal(read_stars, tmp_path / name)


def test_a_unit_of_another_kind_is_refused(tmp_path):
    table = gaia_table()
    table["pmra"] = [1.0, 2.0, 3.0, 4.0, 5.0] * u.km / u.s
    table.write(tmp_path / "t.fits")
    assert "column pmra is in 'km s-1'; give it in mas/yr" in refusal(
        read_stars, tmp_path / "t.fits"
    )


def test_a_table_beside_hipparcos_has_to_have_an_epoch(tmp_path):
    sky(3).write(tmp_path / "t.csv")
    assert len(read_stars(tmp_path / "t.csv")) == 3
    line = refusal(read_stars, tmp_path / "t.csv", with_hipparcos=True)
    assert "has no epoch of its places, and stars move; write " in line
    assert (
        len(read_stars(tmp_path / "t.csv", with_hipparcos=True, epoch_jyear=2000.0))
        == len(load_catalog()) + 3
    )


def test_keys_of_a_table_are_refused_for_hipparcos(tmp_path):
    beside = refusal(choose_catalog, TableChoice(with_hipparcos=True))
    dated = refusal(choose_catalog, TableChoice(epoch_jyear=2000.0))
    assert "[sky] with_hipparcos" in beside and "[sky] catalogue_epoch_jyear" in dated


def test_b_and_v_give_b_minus_v(tmp_path):
    path = tmp_path / "stars.csv"
    path.write_text("ra_deg,dec_deg,v_mag,b_mag\n10,20,5.25,6.5\n30,-40,1.5,1.25\n")
    catalog = read_stars(path)
    order = np.argsort(catalog.v_mag)
    np.testing.assert_allclose(catalog.v_mag[order], [1.5, 5.25], rtol=SAME)
    np.testing.assert_allclose(catalog.bv_mag[order], [-0.25, 1.25], rtol=SAME)


def test_a_table_s_own_errors_stand_in_the_place_of_hipparcos(tmp_path):
    """Each star has its own row's, in whatever order the catalogue has them; what the table does
    not say stays unknown, and a cell without a figure is none.
    """
    path = tmp_path / "stars.ecsv"
    table = gaia_table()
    table["ra_error"] = np.array([0.1, 0.2, 0.3, 0.4, 0.5]) * u.mas
    table["dec_error"] = np.array([1.0, 2.0, 3.0, 4.0, 5.0]) * u.mas
    table["parallax_error"] = MaskedColumn(
        [6.0, 7.0, 0.0, 9.0, 1.0], mask=[0, 0, 1, 0, 0], unit=u.mas
    )
    table.write(path)
    choice = TableChoice(path)
    stars = choose_catalog(choice)
    order = np.array([2, 0, 1])
    stars = stars.taken(order)
    rows = [table["source_id"].tolist().index(number) for number in stars.identifier.tolist()]
    assert len(set(rows)) == 3
    before = errors_of(stars)
    assert np.isnan(before["sigma_ra_mas"]).all()
    facts = table_facts(choice, stars, before)
    assert facts["sigma_ra_mas"] == pytest.approx([0.1 * (k + 1) for k in rows])
    assert facts["sigma_dec_mas"] == pytest.approx([1.0 + k for k in rows])
    wanted = [np.nan if k == 2 else [6.0, 7.0, 0.0, 9.0][k] for k in rows]
    assert facts["sigma_parallax_mas"] == pytest.approx(wanted, nan_ok=True)
    assert np.isnan(facts["sigma_pm_ra_mas_yr"]).all()
    assert set(facts) == set(before)
    plain = tmp_path / "plain.ecsv"
    gaia_table().write(plain)
    assert table_facts(TableChoice(plain), stars, before) is before
    assert table_facts(TableChoice(), stars, before) is before


def test_beside_hipparcos_a_star_of_hipparcos_keeps_its_errors_whatever_the_numbers(tmp_path):
    """HIP 5 and Gaia DR3 5 are two stars; a star of the table may have a HIP number, too."""
    path = tmp_path / "stars.ecsv"
    table = gaia_table()
    table["ra_error"] = np.array([0.1, 0.2, 0.3, 0.4, 0.5]) * u.mas
    table.write(path)
    numbers = [5, 5, 4295806720]
    rows = [table["source_id"].tolist().index(number) for number in numbers]
    own = [0.1 * (row + 1) for row in rows]
    columns = {name: np.zeros(3) for name in ("v_mag", "ra_deg", "dec_deg")}
    columns |= {"hip": np.array([5, 0, 7], dtype=np.int32), "identifier": np.array(numbers)}
    stars = plain_catalog("Gaia DR3", 3, columns)
    before = errors_of(stars)
    facts = table_facts(TableChoice(path, with_hipparcos=True), stars, before)
    assert facts["sigma_ra_mas"].tolist() == [before["sigma_ra_mas"][0], *own[1:]]
    assert before["sigma_ra_mas"][0] > 0.6
    alone = table_facts(TableChoice(path), stars, before)
    assert alone["sigma_ra_mas"].tolist() == own


@pytest.mark.parametrize("name", ["t.vot", "t.fits"])
def test_without_a_unit_a_column_s_own_name_says_it_in_every_format(tmp_path, name):
    table = Table({"ra_hours": [1.0, 12.5], "dec_rad": [0.5, -1.0]})
    table["vmag"], table["b-v"] = [4.0, 5.0], [0.5, 0.6]
    table.write(tmp_path / name, **FORMATS[name])
    catalog = read_stars(tmp_path / name)
    assert sorted(catalog.ra_deg.tolist()) == pytest.approx([15.0, 187.5])
    assert sorted(catalog.dec_deg.tolist()) == pytest.approx(np.degrees([-1.0, 0.5]))


def test_a_table_beside_hipparcos_says_of_its_own_rows_alone(tmp_path):
    """Row 2 is not HIP 2, and a star of the table keeps its own figures where it has a HIP number,
    too. A blank MK type is unknown, whatever stands below the mask.
    """
    table = Table(
        {
            "hip": [0, 0, 500_000],
            "ra_deg": [10.0, 20.0, 30.0],
            "dec_deg": [-50.0, -60.0, -70.0],
            "v_mag": [11.5, 12.0, 12.5],
            "bv_mag": [0.1, 0.2, 0.3],
            "sigma_v_mag": [0.01, 0.02, 0.03],
            "sptype": MaskedColumn(["B5V", "G2V", "M0"], mask=[0, 1, 0]),
        }
    )
    path = tmp_path / "a_name_of_more_than_sixteen.ecsv"
    table.write(path)
    choice = TableChoice(path, with_hipparcos=True, epoch_jyear=2000.0)
    stars = choose_catalog(choice)
    stars = stars.taken(np.flatnonzero((stars.v_mag > 11.4) | (stars.hip == 2)))
    own = {stars.name(row): row for row in range(len(stars))}
    of_table = [own["a_name_of_more_t row 1"], own["a_name_of_more_t row 2"], own["HIP 500000"]]
    of_hipparcos = np.setdiff1d(np.arange(len(stars)), of_table)
    before = errors_of(stars)
    facts = table_facts(choice, stars, before)
    for name in before:
        np.testing.assert_array_equal(facts[name][of_hipparcos], before[name][of_hipparcos], name)
    assert facts["sigma_measured_mag"][of_table].tolist() == [0.01, 0.02, 0.03]
    assert facts["spectral_type"][of_table].tolist() == [b"B5V", b"", b"M0"]
    assert facts["spectral_type_source"][of_table].tolist() == [b"U"] * 3
    assert facts["v_source"][of_table].tolist() == [b"U"] * 3


def test_a_star_without_a_colour_has_both_its_magnitudes_from_the_next_columns(tmp_path):
    """V alone gives no spectrum: Gaia's magnitudes then give V and colour together, as for a star
    that has no V at all. A star with V and B-V keeps them, whatever Gaia says.
    """
    head = "ra_deg,dec_deg,vmag,b-v,g_mag,bp_rp\n"
    rows = ["10,20,4.0,0.3,9.0,1.5", "30,40,4.0,,7.0,1.1", "50,60,,,7.0,1.1", "70,80,,0.2,7.0,1.1"]
    (tmp_path / "both.csv").write_text(head + "\n".join(rows) + "\n")
    stars = read_stars(tmp_path / "both.csv")
    order = np.argsort(stars.ra_deg)
    v_mag, bv_mag, vi_mag = stars.v_mag[order], stars.bv_mag[order], stars.vi_mag[order]
    assert np.isnan(vi_mag[0])
    _, wanted_vi_mag = from_gaia(np.array([7.0]), np.array([1.1]))
    assert vi_mag[1:] == pytest.approx(np.full(3, wanted_vi_mag))
    assert (v_mag[0], bv_mag[0]) == pytest.approx((4.0, 0.3))
    assert v_mag[1] != pytest.approx(4.0, abs=0.5)
    assert v_mag[1:] == pytest.approx(np.full(3, v_mag[2]))
    assert bv_mag[1:] == pytest.approx(np.full(3, bv_mag[2]))
