"""Catalogues as texts: VizieR's own, any encoding and dialect, and what without a unit may be
another one.
"""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from astropy.table import Table

from hilstar.basics.errors import InputError
from hilstar.basics.reading import warn_once
from hilstar.sky import table_reader
from hilstar.sky.catalog import load_catalog
from hilstar.sky.star_table import TableChoice, choose_catalog
from tests.support.refusals import refusal

RA = [78.63, 88.79, 81.28, 84.05, 85.19, 83.0]
DEC = [-8.2, 7.41, 6.35, -1.2, -1.94, -0.3]
V = [0.2, 0.5, 1.6, 1.7, 1.8, 2.2]
BV = [-0.03, 1.5, -0.22, -0.18, -0.2, -0.2]
PLACES_DEG = 1e-9  # of nine decimals, and of radians and hours in 17 figures


@pytest.fixture
def read(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    warn_once.cache_clear()

    def choose(text, encoding="utf-8", name="stars.txt", **choice):
        if text is not None:
            (tmp_path / name).write_bytes(text.encode(encoding))
        catalog = choose_catalog(TableChoice(tmp_path / name, **choice))
        return catalog, np.argsort(catalog.v_mag)

    return choose


def lines(header, *columns, between=","):
    rows = [between.join(str(cell) for cell in row) for row in zip(*columns, strict=True)]
    return "\n".join([*header, *rows, ""])


def assert_stars(catalog, order):
    assert np.allclose(catalog.ra_deg[order], RA, rtol=0, atol=PLACES_DEG)
    assert np.allclose(catalog.dec_deg[order], DEC, rtol=0, atol=PLACES_DEG)
    assert catalog.v_mag[order].tolist() == V
    assert catalog.bv_mag[order].tolist() == BV


VIZIER_HEAD = [
    "#",
    "#RESOURCE=yCat_9999",
    "#Name: I/239/hip_main",
    '#Column\tRAICRS\t(F12.8)\tright ascension (5")',
    "",
]


@pytest.mark.parametrize("between", ["\t", ";", "|"])
@pytest.mark.parametrize("unit", ["deg", "rad", "h"])
def test_vizier_s_texts_are_read_in_the_units_of_their_second_line(read, between, unit):
    per_unit = {"deg": (1, 1), "rad": (np.radians(1), np.radians(1)), "h": (1 / 15, 1)}[unit]
    head = [
        *VIZIER_HEAD,
        "HIP|RAICRS|DEICRS|Vmag|B-V|Note",
        f" |{unit}|{unit.replace('h', 'deg')}|mag|mag| ",
        "---|---|---|---|---|---",
    ]
    rows = [
        ["1", "2", "", "4", "5", "6"],
        np.multiply(RA, per_unit[0]),
        np.multiply(DEC, per_unit[1]),
        V,
        BV,
        ['5"', "", "a b", "é", "", ""],
    ]
    catalog, order = read(
        lines([line.replace("|", between) for line in head], *rows, between=between) + "\n"
    )
    assert_stars(catalog, order)
    assert catalog.hip[order].tolist() == [1, 2, 0, 4, 5, 6]


def test_vizier_s_sexagesimal_places_are_read_by_their_unit(read):
    head = [
        *VIZIER_HEAD,
        "RAJ2000\tDEJ2000\tVmag\tB-V",
        '"h:m:s"\t"d:m:s"\tmag\tmag',
        "---\t---\t---\t---",
    ]
    text = lines(
        head, ["05 14 31.2", "05 55 09.6"], ["-08 12 00", "+07 24 36"], V[:2], BV[:2], between="\t"
    )
    catalog, order = read(text)
    assert np.allclose(catalog.ra_deg[order], RA[:2], rtol=0, atol=PLACES_DEG)
    assert np.allclose(catalog.dec_deg[order], DEC[:2], rtol=0, atol=PLACES_DEG)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "cp1252"])
def test_names_beyond_ascii_are_no_matter(read, encoding, caplog):
    names = ["Bételgeuse", "α Ori".replace("α", "ä"), "x", "", "ÿ", "µ"]
    catalog, order = read(lines(["étoile,ra,dec,vmag,b-v"], names, RA, DEC, V, BV), encoding)
    assert_stars(catalog, order)
    assert ("is read as Windows-1252" in caplog.text) == (encoding == "cp1252")


def test_dialects_of_a_catalogue_are_read(read):
    for k, (between, decimal, end) in enumerate(itertools.product(",;\t|", ".,", ("\n", "\r\n"))):
        if between == decimal:
            continue
        text = lines(["name;ra_deg;dec_deg;vmag;b-v"], ["a"] * 6, RA, DEC, V, BV, between=";")
        text = (
            text.replace(".", decimal)
            .replace(";", between)
            .replace("-", "−" if k % 2 else "-")
            .replace("b−v", "b-v")
        )
        catalog, order = read(text.replace("\n", end), name=f"{k}.txt")
        assert_stars(catalog, order)
    text = lines(["# ra_deg dec_deg vmag b-v"], RA, DEC, V, BV, between="   ")
    assert_stars(*read(text, name="blanks.txt"))


@pytest.mark.parametrize(
    "header",
    [
        "ra_h,dec",
        "ra_hours,dec_deg",
        "RA (h),DEC (deg)",
        "RA [hours],Dec [deg]",
        "ra hours,dec deg",
    ],
)
def test_hours_are_read_where_a_name_says_so(read, header, caplog):
    assert_stars(*read(lines([f"{header},vmag,b-v"], np.divide(RA, 15), DEC, V, BV)))
    assert "and is multiplied by 15" in caplog.text


@pytest.mark.parametrize("header", ["RArad,DErad", "ra_rad,dec_rad", "ra [rad],dec [rad]"])
def test_radians_are_read_where_a_name_says_so(read, header, caplog):
    assert_stars(*read(lines([f"{header},vmag,b-v"], np.radians(RA), np.radians(DEC), V, BV)))
    assert "is in rad, and is multiplied by 57.2957795" in caplog.text


PLACES_REFUSED = {
    "hours": (
        "ra,dec",
        np.divide(RA, 15),
        DEC,
        "so it is in hours, or of one field in degrees; give the column its unit: ra_deg",
    ),
    "radians": (
        "ra,dec",
        np.radians(RA),
        np.radians(DEC),
        "radians, hours or degrees? give the column its unit",
    ),
    "west": ("raj2000,dej2000", np.radians(RA) - 3, np.radians(DEC), "radians, hours or degrees?"),
    "one southern field": (
        "ra,dec",
        [1.0, 2.0, 3.0, 4.0, 5.0, 6.0],
        [-78.0, -76.0, -75.0, -77.0, -79.0, -76.5],
        "so it is in hours, or of one field in degrees; give the column its unit: ra_deg",
    ),
    "degrees as radians": (
        "rarad,derad",
        RA,
        DEC,
        "column rarad is in rad and runs to 88.79; name it ra_deg",
    ),
    "degrees as hours": (
        "ra_h,dec_deg",
        RA,
        DEC,
        "column ra_h is in h and runs to 88.79; name it ra_deg",
    ),
    "twice": ("ra,dec,RA", RA, DEC, "column ra is there twice"),
}


@pytest.mark.parametrize("name", PLACES_REFUSED)
def test_places_that_may_be_in_another_unit_are_refused(read, name):
    header, ra, dec, words = PLACES_REFUSED[name]
    more = [[0] * 6] * (header.count(",") - 1)
    assert words in refusal(read, lines([f"{header},vmag,b-v"], ra, dec, *more, V, BV))


def test_one_field_near_zero_is_read_where_its_unit_is_stated(read):
    catalog, order = read(lines(["ra_deg,dec_deg,vmag,b-v"], np.subtract(RA, 77), DEC, V, BV))
    assert catalog.ra_deg[order] == pytest.approx(np.subtract(RA, 77))


PM = np.array([1.9, 27.3, -8.8, 1.5, 4.0, 1.7]), np.array([-0.6, 10.9, -13.3, -1.1, 2.5, 0.6])


@pytest.mark.parametrize(
    ("names", "per_mas", "factor"),
    [
        ("pmra_arcsec_yr,pmdec_arcsec_yr", 1e-3, "1000"),
        ("pmRA [arcsec/yr],pmDE (arcsec/yr)", 1e-3, "1000"),
        ("pmra_deg_yr,pmdec_deg_yr", 1 / 3.6e6, "3600000"),
        ("pm_ra_mas_yr,pm_dec_mas_yr", 1, ""),
        ("pmra,pmdec", 1, ""),
    ],
)
def test_motions_are_in_the_unit_of_their_names(read, names, per_mas, factor, caplog):
    ra, dec = (np.round(motion * per_mas, 15) for motion in PM)
    text = lines([f"ra,dec,{names},vmag,b-v"], RA, DEC, ra, dec, V, BV)
    catalog, order = read(text, epoch_jyear=2000.0)
    assert np.allclose(catalog.pm_ra_cosdec_mas_yr[order], PM[0], rtol=1e-7)
    assert np.allclose(catalog.pm_dec_mas_yr[order], PM[1], rtol=1e-7)
    assert (f"multiplied by {factor}" in caplog.text) == bool(factor)


@pytest.mark.parametrize("per_mas", [1e-3, 1 / 3.6e6, 1e-3 / 15])
def test_motions_too_small_for_mas_are_refused_without_a_unit(read, per_mas):
    text = lines(["ra,dec,pmra,pmdec,vmag,b-v"], RA, DEC, PM[0] * per_mas, PM[1] * per_mas, V, BV)
    with pytest.raises(
        InputError, match=r"column pmra has no unit, and half .* so they are in arcsec a year"
    ):
        read(text, epoch_jyear=2000.0)


@pytest.mark.parametrize("moving", [[1.0, 2.0, 3.0], [1e-3, 2e-3]], ids=["in mas", "too few"])
def test_stars_that_stand_still_say_nothing_of_a_motion_s_unit(read, moving):
    motions = [*moving, *[0.0] * (len(RA) - len(moving))]
    text = lines(["ra,dec,pmra,pmdec,vmag,b-v"], RA, DEC, motions, motions, V, BV)
    catalog, order = read(text, epoch_jyear=2000.0)
    assert catalog.pm_ra_cosdec_mas_yr[order].tolist() == motions


GAIA = "ref_epoch,ra,dec,phot_g_mean_mag,bp_rp"
IDENTIFIERS = {
    "rounded": ["4.000000000e+18"] * 6,
    "rounded apart": [f"{4_000_000_000_000_000_000 + 10**15 * k:.6e}" for k in range(6)],
    "one blank": ["3.4474092e+18", "", "2.5e+18", "1.5e+18", "1.25e+18", "1.125e+18"],
    "repeated": ["5"] * 6,
}


@pytest.mark.parametrize("name", IDENTIFIERS)
def test_identifiers_that_name_no_star_alone_are_not_used_and_that_is_said(read, name, caplog):
    text = lines([f"source_id,{GAIA}"], IDENTIFIERS[name], [2016.0] * 6, RA, DEC, V, BV)
    for _ in range(2):  # the second time from the cache
        caplog.clear()
        catalog, _ = read(text)
        assert sorted(map(catalog.name, range(6))) == [f"stars row {k}" for k in range(1, 7)]
        assert "6 of its stars have no identifier of their own" in caplog.text


def test_a_hip_number_of_several_stars_stays_with_the_brightest_and_that_is_said(read, caplog):
    numbers = [32349, 32349, 32349, 30438, 30438, 0]
    text = lines(["hip,ra_deg,dec_deg,v_mag,bv_mag"], numbers, RA, DEC, V, BV)
    for _ in range(2):  # the second time from the cache
        caplog.clear()
        catalog, _ = read(text)
        assert sorted(catalog.hip.tolist()) == [0, 0, 0, 0, 30438, 32349]
        assert "2 HIP numbers are of several stars each (HIP 32349 of 3)" in caplog.text
    # a row that is no star, for it has no colour, takes part in nothing
    for name, numbers, words in (
        ("other.csv", [1, 2, 3, 4, 5, 5], ""),
        ("one.csv", [7, 7, 3, 4, 5, 5], "1 HIP number is of several stars each (HIP 7 of 2)"),
    ):
        caplog.clear()
        colours = [*BV[:5], ""]
        read(lines(["hip,ra_deg,dec_deg,v_mag,bv_mag"], numbers, RA, DEC, V, colours), name=name)
        assert ("of several stars" in caplog.text) == bool(words)
        assert words in caplog.text


def test_float_identifiers_in_fits_are_not_used_where_they_cannot_hold_them(read, tmp_path, caplog):
    for k, kind in enumerate((np.float64, np.float32, np.int64)):
        identifiers = np.array([4_000_000_000_000_000_000 + 3 * star for star in range(6)]).astype(
            kind
        )
        columns = dict(
            zip(
                f"source_id,{GAIA}".split(","),
                [identifiers, [2016.0] * 6, RA, DEC, V, BV],
                strict=True,
            )
        )
        Table(columns).write(tmp_path / f"{k}.fits")
        catalog, _ = read(None, name=f"{k}.fits")
        assert (catalog.designation == "Gaia DR3") == (kind is np.int64)
    assert "no identifier of their own" in caplog.text


@pytest.mark.parametrize(
    ("kind", "first", "name"),
    [
        (np.float32, 2**24 - 12, "Gaia DR3"),
        (np.float32, 2**24 + 2, "stars row"),
        (np.float64, 2**24 + 2, "Gaia DR3"),
        (np.float64, 2**53 + 2, "stars row"),
    ],
)
def test_a_float_holds_identifiers_up_to_its_digits(read, tmp_path, kind, first, name):
    """Even ones beyond would be held, too, but which they were nobody knows."""
    cells = [np.arange(first, first + 12, 2)[:6].astype(kind), [2016.0] * 6, RA, DEC, V, BV]
    columns = dict(zip(f"source_id,{GAIA}".split(","), cells, strict=True))
    Table(columns).write(tmp_path / "stars.fits")
    catalog, _ = read(None, name="stars.fits")
    assert catalog.designation.startswith(name)


@pytest.mark.parametrize(("other_jyear", "release"), [(2015.5, "Gaia DR2"), (2016.0, "Gaia DR3")])
def test_a_release_is_the_second_where_every_epoch_is(read, other_jyear, release):
    epochs = [2015.5] * 5 + [other_jyear]
    catalog, _ = read(lines([f"source_id,{GAIA}"], range(11, 17), epochs, RA, DEC, V, BV))
    assert catalog.designation == release


def test_right_ascensions_west_of_0_are_turned(read):
    catalog, order = read(lines(["ra_deg,dec_deg,vmag,b-v"], [-80.0, -180.0, *RA[2:]], DEC, V, BV))
    assert catalog.ra_deg[order].tolist() == [280.0, 180.0, *RA[2:]]


def test_a_table_is_as_long_as_its_pieces_together(read, monkeypatch):
    monkeypatch.setattr(table_reader, "CHUNK_BYTES", 40)
    monkeypatch.setattr(table_reader, "MAX_ROWS", 6)
    assert_stars(*read(lines(["ra,dec,vmag,b-v"], RA, DEC, V, BV)))
    longer = lines(["ra,dec,vmag,b-v"], [*RA, 1.0], [*DEC, 1.0], [*V, 3.0], [*BV, 0.0])
    with pytest.raises(InputError, match="rows"):
        read(longer, name="longer.txt")


@pytest.mark.parametrize(
    ("role", "unit", "by"),
    [("ra_deg", "h", 15.0), ("dec_deg", "arcmin", 1 / 60), ("pm_dec_mas_yr", "arcsec/yr", 1000.0)],
)
def test_a_column_s_unit_is_the_one_that_it_states(tmp_path, role, unit, by):
    assert table_reader.factor_to(role, "column", unit, tmp_path) == pytest.approx(by)
    assert table_reader.factor_to(role, "column", "", tmp_path) == 1.0


def test_a_colour_that_few_stars_have_gives_that_of_the_reddest_that_twenty_have():
    stars = load_catalog()
    bins = np.round(stars.vi_mag / 0.05)
    middles, counts = np.unique(bins[np.isfinite(bins)], return_counts=True)
    for middle in middles[counts == 20]:
        wanted = np.median(stars.bv_mag[bins == middle])
        assert table_reader.bv_from_vi(middle * 0.05) == pytest.approx(wanted, abs=1e-6)
    full = max(middles[counts >= 20])
    reddest = np.median(stars.bv_mag[bins == full])
    most = np.nanmax(stars.vi_mag)
    assert most > full * 0.05 + 1.0
    found = table_reader.bv_from_vi(np.array([most, full * 0.05 + 0.3]))
    assert found == pytest.approx(reddest, abs=1e-6)


def test_a_declination_in_hours_is_refused(tmp_path):
    line = refusal(table_reader.factor_to, "dec_deg", "de", "h", tmp_path)
    assert line.endswith("column de is in 'h'; give it in deg")


def test_whole_floats_that_hold_their_identifiers_are_used(read):
    text = lines(
        [f"source_id,{GAIA}"], [f"{k}.0" for k in range(11, 17)], [2016.0] * 6, RA, DEC, V, BV
    )
    catalog, _ = read(text)
    assert sorted(map(catalog.name, range(6))) == [f"Gaia DR3 {k}" for k in range(11, 17)]


def test_a_row_of_other_cells_is_named_with_its_line(read):
    text = lines(["ra,dec,vmag,b-v"], RA, DEC, V, BV)
    for wrong in ("1,2,3", "1,2,3,4,5"):
        with pytest.raises(
            InputError, match=rf"cannot be read \(8: {wrong.count(',') + 1} cells and 4 columns"
        ):
            read(f"{text}{wrong}\n")
    catalog, order = read(text.replace("\n", ",\n").replace("b-v,", "b-v"), name="trailing.txt")
    assert_stars(catalog, order)


def test_a_catalogue_cut_off_is_said(read, caplog):
    text = lines(["ra,dec,b-v,vmag"], RA, DEC, BV, [f"{v:.4f}" for v in V])
    read(text[:-3])
    assert "stars.txt:7: the last line has no line end, and may be cut off" in caplog.text


def test_a_field_of_gaia_s_own_table_is_taken_as_its_archive_has_it_and_that_is_said(read, caplog):
    text = lines([f"source_id,{GAIA}"], range(1, 7), [2016.0] * 6, np.subtract(RA, 77), DEC, V, BV)
    catalog, order = read(text)
    assert catalog.ra_deg[order] == pytest.approx(np.subtract(RA, 77))
    assert "or of one field in degrees" in caplog.text
    assert "taken as Gaia's archive has it" in caplog.text
