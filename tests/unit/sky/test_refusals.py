"""Curves, maps, orbits and tables of stars that are refused, and the words of the one line."""

from __future__ import annotations

import io

import numpy as np
import pytest
from astropy.io import fits

from hilstar.sky import diffuse, spectrum, table_reader
from hilstar.sky.bodies.oem import OemOrbit
from hilstar.sky.diffuse import read_diffuse_map
from hilstar.sky.spectrum import Curve, _check_curve, read_curve_csv
from hilstar.sky.table_reader import read_table
from tests.support.refusals import assert_file_refused, refusal, says
from tests.support.sources.oem_messages import START_NS, oem, segment

HEAD = "wavelength_nm,value\n"
CURVES = [
    ("", ": 0 rows; "),
    (HEAD + "500,0.5\n", ": 1 rows; write at least two rows"),
    (HEAD + "500,0.5\n400,0.5\n", ": wavelengths do not rise from row to row"),
    (HEAD + "500,0.5\n500,0.5\n", ": wavelengths do not rise from row to row"),
    (HEAD + "0,0.5\n500,0.5\n", ": wavelengths do not rise from row to row; ..."),
    (HEAD + "500,0.5\n600,1.0001\n", ": values from 0.5 to 1.0001; write fractions from 0 to 1"),
    (HEAD + "500,-0.1\n600,0.5\n", ": values from -0.1 to 0.5; write fractions from 0 to 1"),
    (HEAD + "500,nan\n600,0.5\n", ":2: "),
    (HEAD + "300,0.5\n9e9,0.5\n", ": "),
]


@pytest.mark.parametrize(("text", "words"), CURVES, ids=range(len(CURVES)))
def test_what_is_no_curve_is_refused(tmp_path, text, words):
    (tmp_path / "curve.csv").write_text(text)
    assert_file_refused(read_curve_csv, tmp_path / "curve.csv", words)


def test_a_curve_s_ends_and_rows_are_bounded(tmp_path, monkeypatch):
    path = tmp_path / "curve.csv"
    path.write_text(HEAD + "500,0.5\n510,0.5\n520,0.5\n")
    monkeypatch.setattr(spectrum, "MAX_CURVE_ROWS", 3)
    assert len(read_curve_csv(path).value) == 3
    monkeypatch.setattr(spectrum, "MAX_CURVE_ROWS", 2)
    assert_file_refused(read_curve_csv, path, ": more than 2 rows; remove some")
    low_nm, high_nm = spectrum.RANGE_NM
    half = np.full(2, 0.5)
    _check_curve(Curve(np.array([low_nm, high_nm]), half), path, 1.0)
    for ends in ((0.9 * low_nm, high_nm), (low_nm, 1.1 * high_nm)):
        line = refusal(_check_curve, Curve(np.array(ends), half), path, 1.0)
        assert says(line, f"wavelengths from ...; write {low_nm:g} to {high_nm:g} nm")
    for numbers in ((np.array([500.0, np.inf]), half), (np.array([500.0, 600.0]), half * np.nan)):
        line = refusal(_check_curve, Curve(*numbers), path, 1.0)
        assert says(line, "a wavelength or a value is not finite; write numbers")


def healpix_file(count: int = 192, **header: object) -> fits.HDUList:
    """A map of nside 4."""
    column = fits.Column("LIGHT", "E", "W/(m2 um sr)", array=np.ones(count))
    table = fits.BinTableHDU.from_columns([column])
    usual = {"PIXTYPE": "HEALPIX", "ORDERING": "RING", "NSIDE": 4, "COORDSYS": "G"}
    table.header.update(usual | {"INDXSCHM": "IMPLICIT"} | header)
    return fits.HDUList([fits.PrimaryHDU(), table])


def image_file(unit: str | None, **header: object) -> fits.HDUList:
    image = fits.PrimaryHDU(np.ones((8, 6)))
    wcs = {"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CRVAL1": 10.0, "CRVAL2": 20.0}
    wcs |= {"CRPIX1": 3.5, "CRPIX2": 4.5, "CDELT1": -0.1, "CDELT2": 0.1}
    image.header.update(wcs | header | ({} if unit is None else {"BUNIT": unit}))
    return fits.HDUList([image])


DIFFUSE = [
    (fits.HDUList([fits.PrimaryHDU()]), ": has neither an image nor a HEALPix table; "),
    (healpix_file(COORDSYS="X"), ": COORDSYS = 'X'; write G (galactic), C (ICRS) or E"),
    (healpix_file(COORDSYS=""), ": COORDSYS = ''; write G (galactic)"),
    (healpix_file(191), ": 191 pixels of 192; give a map of the whole sky"),
    (healpix_file(INDXSCHM="EXPLICIT"), ": 192 pixels of 192; give a map of the whole sky"),
    (image_file(None), ": no unit; "),
    (image_file("m"), ": unit 'm', which is no surface brightness; "),
    (image_file("W/(m2 um sr)", CTYPE1="LINEAR", CTYPE2="LINEAR"), ": an image of shape (8, 6) w"),
]


@pytest.mark.parametrize(("content", "words"), DIFFUSE, ids=[words[2:40] for _, words in DIFFUSE])
def test_what_is_no_map_of_the_sky_is_refused(tmp_path, content, words):
    content.writeto(tmp_path / "map.fits")
    assert_file_refused(read_diffuse_map, tmp_path / "map.fits", words)


def test_a_map_that_unpacks_to_more_than_the_limit_is_refused(tmp_path, monkeypatch):
    image_file("W/(m2 um sr)").writeto(tmp_path / "map.fits.gz")
    assert len(read_diffuse_map(tmp_path / "map.fits.gz")) == 1
    monkeypatch.setattr(diffuse, "MAX_FILE_BYTES", 4000)
    assert_file_refused(read_diffuse_map, tmp_path / "map.fits.gz", ": ")


ORBIT = oem(segment(range(0, 600, 60)))
EPOCH = next(line.split()[0] for line in ORBIT.splitlines() if line.startswith("2008"))
ORBITS = [
    (
        ORBIT.replace("META_START\n", "META_START\nno equals sign\n", 1),
        "in the metadata; write KEYW",
    ),
    (
        ORBIT.replace("CCSDS_OEM_VERS = ", "CCSDS_OEM_VERS ", 1),
        "in the header; write KEYWORD = value",
    ),
    *(
        (ORBIT.replace(EPOCH, epoch, 1), f"the epoch is {epoch!r}; write YYYY-MM-DDThh:mm:ss.f")
        for epoch in (
            "yesterday",
            "2008-13-01T00:00:00",
            "2008-09-20T24:00:00",
            "2008-367T00:00:00",
        )
    ),
    (
        ORBIT.replace("T12:31:00.000", "T12:30:00.000", 1),
        "the epoch is not after the one before it",
    ),
    (ORBIT.replace(EPOCH, "2008-09-20T00:60:00", 1), "the epoch is"),
    (ORBIT.replace(EPOCH, "2008-09-20T00:00:60", 1), "the epoch is"),
]


@pytest.mark.parametrize(("text", "words"), ORBITS, ids=range(len(ORBITS)))
def test_what_is_no_orbit_is_refused(text, words):
    assert text != ORBIT
    OemOrbit(ORBIT, "a.oem", START_NS)
    line = refusal(OemOrbit, text, "a.oem", START_NS)
    rows = zip(ORBIT.splitlines(), text.splitlines(), strict=False)
    changed = [number for number, (was, now) in enumerate(rows, start=1) if was != now]
    assert line.startswith(f"a.oem:{changed[0]}: ")
    assert words in line


def test_a_segment_of_an_orbit_has_nothing_of_the_one_before():
    text = oem(segment(range(0, 600, 60)), segment(range(600, 900, 60), CENTER_NAME=None))
    line = refusal(OemOrbit, text, "a.oem", START_NS)
    assert line.startswith("a.oem: REF_FRAME is EME2000 and CENTER_NAME missing")


def table_file(*columns: fits.Column) -> bytes:
    file = io.BytesIO()
    fits.HDUList(
        [fits.PrimaryHDU(), *([fits.BinTableHDU.from_columns(columns)] if columns else [])]
    ).writeto(file)
    return file.getvalue()


def gaia(count: int, kind: str = "D") -> list[fits.Column]:
    names = ("ra", "dec", "phot_g_mean_mag", "bp_rp", "pmra", "pmdec", "parallax")
    return [fits.Column(name, kind, array=np.ones(count)) for name in ("source_id", *names)]


TABLES = [
    (b"", ": is empty; "),
    (table_file(), ": holds no table; "),
    (table_file(*gaia(2))[:5000], ": "),
    (b'<?xml version="1.0"?><VOTABLE><RESOURCE><TABLE', ": "),
    (b"PK\x03\x04 and so on", ": ...it is a zip archive"),
]


@pytest.mark.parametrize(("content", "words"), TABLES, ids=range(len(TABLES)))
def test_what_is_no_table_of_stars_is_refused(tmp_path, content, words):
    (tmp_path / "stars.fits").write_bytes(content)
    assert_file_refused(read_table, tmp_path / "stars.fits", words)


def test_rows_and_sizes_of_tables_are_bounded(tmp_path, monkeypatch):
    path = tmp_path / "stars.fits"
    path.write_bytes(table_file(*gaia(3)))
    monkeypatch.setattr(table_reader, "MAX_ROWS", 3)
    assert read_table(path).row_count == 3
    monkeypatch.setattr(table_reader, "MAX_ROWS", 2)
    assert_file_refused(read_table, path, ": has more than 2 rows; cut it to the magnitudes")
    votable = tmp_path / "stars.vot"
    votable.write_bytes(b'<?xml version="1.0"?>' + b" " * 100)
    monkeypatch.setattr(table_reader, "MAX_XML_BYTES", 100)
    assert_file_refused(read_table, votable, ": ...a VOTable of ... at most...; give it as FITS")


def test_a_column_of_text_is_no_column_of_numbers(tmp_path):
    path = tmp_path / "stars.fits"
    columns = [column for column in gaia(2) if column.name != "dec"]
    path.write_bytes(
        table_file(*columns, fits.Column("dec", "8A", array=np.array(["north", "south"])))
    )
    assert_file_refused(
        read_table, path, ": column dec is no column of numbers (its first is 'north')"
    )
    columns = [column for column in gaia(0) if column.name != "dec"]
    path.write_bytes(table_file(*columns, fits.Column("dec", "8A", array=np.array([], dtype="U8"))))
    assert_file_refused(read_table, path, ": has no rows; ")
