"""What a FITS header says of its image, by the standard and by the software of cameras; each
case as a small file.
"""

from __future__ import annotations

import gzip
import io
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.time import Time

from hilstar.basics.errors import InputError
from hilstar.basics.fits_headers import read_fits_image, utc_ns
from hilstar.basics.image_files import ImageSizeError
from hilstar.instruments.calibrate.geometric.observed import read_exposed
from hilstar.instruments.confront.images import read_photographs

SIDE_PX = 64
EIGHT_PM = "2024-03-01T20:00:00"
LEVELS = {"R": 1000, "G": 2000, "B": 3000}
UTC_TOLERANCE_NS = 1000  # Astropy's text has ns; an MJD as float64 has a microsecond


def mosaic(pattern: str) -> np.ndarray:
    """An image whose levels say the colour of a pattern from its first pixel, and a little
    noise.
    """
    cell = np.array([LEVELS[colour] for colour in pattern]).reshape(2, 2)
    noise = np.random.default_rng(1).integers(0, 50, (SIDE_PX, SIDE_PX))
    return (np.tile(cell, (SIDE_PX // 2, SIDE_PX // 2)) + noise).astype(np.uint16)


def file_of(*hdus) -> bytes:
    buffer = io.BytesIO()
    fits.HDUList(list(hdus)).writeto(buffer)
    return buffer.getvalue()


def mosaic_hdu(cards: dict | list, pattern: str = "RGGB", kind=fits.PrimaryHDU) -> fits.PrimaryHDU:
    made = kind(mosaic(pattern))
    for key, value in dict(cards).items():
        made.header[key] = value
    return made


def read_image(cards: dict, pattern: str = "RGGB"):
    return read_fits_image(file_of(mosaic_hdu(cards, pattern)))


@pytest.mark.parametrize(
    ("cards", "seconds"),
    [
        ({"EXPTIME": 10.0}, 10.0),
        ({"EXPOSURE": 10.0}, 10.0),
        ({"XPOSURE": 10.0}, 10.0),
        ({"TEXPOSUR": 10.0}, 10.0),
        ({"EXP_TIME": 10.0}, 10.0),
        ({"EXPTIME": 10}, 10.0),
        ({"EXPTIME": "10.0"}, 10.0),
        ({"EXPTIME": "10 s"}, 10.0),
        ({"EXPTIME": "1.5 min"}, 90.0),
        ({"EXPTIME": "250 ms"}, 0.25),
        ({"EXPTIME": (250.0, "[ms] exposure time")}, 0.25),
        ({"EXPTIME": (250.0, "Exposure time (ms)")}, 0.25),
        ({"EXPOSURE": (250.0, "exposure in milliseconds")}, 0.25),
        ({"EXPTIME": (250000, "[us]")}, 0.25),
        ({"EXPTIME": (10.0, "[s] time in seconds")}, 10.0),
        ({"EXPTIME": (10.0, "Exposure time")}, 10.0),
        ({"EXPTIME": (250.0, "milliseconds")}, 0.25),
        ({"EXPTIME": (250.0, "duration, msec")}, 0.25),
        ({"EXPTIME": (250000, "Exposure time in microsec")}, 0.25),
        ({"EXPTIME": (10.0, "of the minimum, sec")}, 10.0),
        ({"EXP_MS": 250.0}, 0.25),
        ({"TEXP": 10.0}, 10.0),
        ({"HIERARCH EXPOSURE TIME": 10.0}, 10.0),
        ({"HIERARCH ESO DET DIT": 10.0}, 10.0),
        ({"EXPTIME": (10.0, "in total")}, 10.0),
        ({"EXPOINUS": 250000}, 0.25),
        ({"EXPTIME": 0.25, "EXPOINUS": 250000}, 0.25),
        ({"EXPTIME": 0.0}, 0.0),
        ({}, None),
    ],
)
def test_an_exposure_is_in_seconds(cards, seconds):
    found = read_image(cards)
    assert found.exposure_s == (None if seconds is None else pytest.approx(seconds))
    assert not found.notes


@pytest.mark.parametrize("value", ["long", "1/200 s", -1.0, True, "10 parsec"])
def test_an_exposure_that_is_none_is_said(value):
    found = read_image({"EXPTIME": value})
    assert found.exposure_s is None
    assert "EXPTIME" in found.notes[0] and "no exposure in seconds" in found.notes[0]


@pytest.mark.parametrize("key", ["SHUTTER", "EXPDUR", "TELAPSE", "FRAMETIM", "HIERARCH ESO EXPT"])
def test_a_keyword_that_may_be_an_exposure_is_named(key):
    found = read_image({key: 10.0})
    assert found.exposure_s is None
    name = key.removeprefix("HIERARCH ")
    assert f"{name} is no keyword of an exposure that is known" in found.notes[0]
    assert not read_image({key: "open"}).notes


def test_two_exposures_that_differ_are_said():
    found = read_image({"EXPTIME": 10.0, "EXPOSURE": 20.0})
    assert found.exposure_s == 10.0
    assert found.notes == ("EXPTIME says 10 s and EXPOSURE 20 s: EXPTIME is taken",)
    shorter = read_image({"EXPTIME": 10.0, "EXPOSURE": 5.0})
    assert shorter.notes == ("EXPTIME says 10 s and EXPOSURE 5 s: EXPTIME is taken",)
    assert not read_image({"EXPTIME": 10.0, "EXPOSURE": 9.995}).notes  # one of them is rounded


def astropy_ns(text: str, scale: str) -> int:
    """UTC of a time in another scale, by Astropy."""
    at = Time(text, scale=scale, precision=9).utc.isot
    return int(np.datetime64(at, "ns").astype(np.int64))


@pytest.mark.parametrize(
    ("cards", "expected"),
    [
        ({"DATE-OBS": EIGHT_PM}, "2024-03-01T20:00:05"),
        ({"DATE-OBS": EIGHT_PM + "Z"}, "2024-03-01T20:00:05"),
        ({"DATE-OBS": "2024-03-01 20:00:00"}, "2024-03-01T20:00:05"),
        ({"DATE-OBS": EIGHT_PM + ".250"}, "2024-03-01T20:00:05.25"),
        ({"DATE-OBS": EIGHT_PM + "+01:00"}, "2024-03-01T19:00:05"),
        ({"DATE-OBS": EIGHT_PM + "-0530"}, "2024-03-02T01:30:05"),
        ({"DATE-BEG": EIGHT_PM}, "2024-03-01T20:00:05"),
        ({"DATE-AVG": EIGHT_PM}, "2024-03-01T20:00:00"),
        ({"DATE-END": EIGHT_PM}, "2024-03-01T19:59:55"),
        ({"DATE-OBS": (EIGHT_PM, "UTC of mid exposure")}, "2024-03-01T20:00:00"),
        ({"DATE-OBS": (EIGHT_PM, "end of exposure")}, "2024-03-01T19:59:55"),
        ({"DATE-OBS": EIGHT_PM, "DATE-END": "2024-03-01T20:00:10"}, "2024-03-01T20:00:05"),
        ({"DATE-OBS": "2024-03-01", "TIME-OBS": "20:00:00"}, "2024-03-01T20:00:05"),
        ({"DATE-OBS": "2024-03-01", "UT": "20:00:00.5"}, "2024-03-01T20:00:05.5"),
        ({"DATE-OBS": "2024-03-01", "UTSTART": "20 00 00"}, "2024-03-01T20:00:05"),
        ({"DATE-OBS": "2024-03-01", "TIME": "20:00"}, "2024-03-01T20:00:05"),
        ({"DATE-OBS": "2024-03-01", "OBSSTART": "20:00:00"}, "2024-03-01T20:00:05"),
        ({"DATE-OBS": "2024-03-01", "MJD-OBS": 60370.5}, "2024-03-01T12:00:05"),
        ({"MJD-OBS": 60370.5}, "2024-03-01T12:00:05"),
        ({"MJD-AVG": 60370.5}, "2024-03-01T12:00:00"),
        ({"MJD-AVG": 60370.5 + 0.25 / 86400}, "2024-03-01T12:00:00.250"),
        ({"MJD-END": 60370.5}, "2024-03-01T11:59:55"),
        ({"DATE-OBS": "01/03/99", "TIME-OBS": "20:00:00"}, "1999-03-01T20:00:05"),
        ({"DATE-OBS": EIGHT_PM, "TIMESYS": "UTC"}, "2024-03-01T20:00:05"),
        ({"DATE-MID": EIGHT_PM}, "2024-03-01T20:00:00"),
        ({"OBS-DATE": EIGHT_PM}, "2024-03-01T20:00:05"),
        ({"DATE-OBS": "2024-03-01", "UTSHUT": "20:00:00"}, "2024-03-01T20:00:05"),
        ({"DATE-OBS": "2024-03-01", "TIMEOBS": "20:00:00"}, "2024-03-01T20:00:05"),
    ],
)
def test_a_time_is_the_middle_of_the_exposure(cards, expected):
    found = read_image({**cards, "EXPTIME": 10.0})
    assert found.t_ns == pytest.approx(utc_ns(expected), abs=UTC_TOLERANCE_NS)
    assert not found.notes


@pytest.mark.parametrize(
    ("name", "scale"), [("TAI", "tai"), ("TT", "tt"), ("TDB", "tdb"), ("tai", "tai")]
)
def test_scales_are_turned_into_utc(name, scale):
    found = read_image({"DATE-OBS": EIGHT_PM, "TIMESYS": name, "EXPTIME": 0.0})
    assert found.t_ns == pytest.approx(astropy_ns(EIGHT_PM, scale), abs=UTC_TOLERANCE_NS)


def test_gps_is_18_s_ahead_of_utc():
    found = read_image({"DATE-OBS": EIGHT_PM, "TIMESYS": "GPS", "EXPTIME": 0.0})
    assert found.t_ns == pytest.approx(utc_ns("2024-03-01T19:59:42"), abs=UTC_TOLERANCE_NS)
    by_days = read_image({"MJD-OBS": 60370.5, "TIMESYS": "TAI", "EXPTIME": 0.0})
    assert by_days.t_ns == pytest.approx(utc_ns("2024-03-01T11:59:23"), abs=UTC_TOLERANCE_NS)


@pytest.mark.parametrize(
    ("cards", "words"),
    [
        ({"DATE-OBS": "2024-03-01"}, "DATE-OBS = 2024-03-01 tells no time of day"),
        ({"DATE-OBS": "2024-03-01", "UT": 20.5}, "tells no time of day"),
        (
            {"DATE-OBS": EIGHT_PM, "TIMESYS": "LOCAL"},
            "DATE-OBS is in LOCAL, which is no known time from UTC: undated",
        ),
        ({"DATE-OBS": (EIGHT_PM, "local time of start")}, "DATE-OBS is in local time"),
        ({"DATE-OBS": "1 March 2024"}, "DATE-OBS = 1 March 2024 is no date"),
        ({"DATE-OBS": "2024-13-41T20:00:00"}, "DATE-OBS = 2024-13-41T20:00:00 is no date"),
        ({"MJD-OBS": "yesterday"}, "MJD-OBS = yesterday is no date"),
    ],
)
def test_an_image_without_a_time_is_undated_and_said(cards, words):
    found = read_image({**cards, "EXPTIME": 10.0})
    assert found.t_ns is None
    assert any(words in note for note in found.notes), found.notes


@pytest.mark.parametrize("key", ["DATE-AVG", "DATE-END"])
def test_a_time_of_day_of_its_own_is_that_of_the_exposure_s_start_alone(key):
    found = read_image({key: "2024-03-01", "TIME-OBS": "20:00:00", "EXPTIME": 10.0})
    assert found.t_ns is None
    assert "tells no time of day" in found.notes[-1]


def test_an_undated_image_is_said_beside_what_else_is():
    found = read_image({"DATE-OBS": "2024-03-01", "EXPTIME": "long"})
    assert len(found.notes) == 2 and "tells no time of day" in found.notes[1]


def test_local_time_gives_way_to_days_of_utc():
    found = read_image({"DATE-OBS": (EIGHT_PM, "local time"), "MJD-OBS": 60370.5, "EXPTIME": 10.0})
    assert found.t_ns == pytest.approx(utc_ns("2024-03-01T12:00:05"), abs=UTC_TOLERANCE_NS)


def test_what_contradicts_or_is_assumed_is_said():
    apart = read_image({"DATE-OBS": EIGHT_PM, "MJD-OBS": 60370.5, "EXPTIME": 1.0})
    assert apart.t_ns == utc_ns("2024-03-01T20:00:00.5")
    assert apart.notes == ("MJD-OBS is -28800 s off DATE-OBS, which is taken",)
    unknown = read_image({"DATE-OBS": EIGHT_PM})
    assert unknown.t_ns == utc_ns(EIGHT_PM)
    assert unknown.notes == ("no exposure is known: DATE-OBS, its start, is taken for its middle",)
    both = read_image({"DATE-BEG": EIGHT_PM, "DATE-END": "2024-03-01T20:00:08"})
    assert both.t_ns == utc_ns("2024-03-01T20:00:04") and not both.notes


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("JD", 2460371.3333333),
        ("MJD", 60370.5),
        ("UNIXTIME", 1709323200.0),
        ("UTC", EIGHT_PM),
        ("GPS_UTC", EIGHT_PM),
    ],
)
def test_a_keyword_that_may_be_a_time_is_named(key, value):
    found = read_image({key: value, "EXPTIME": 10.0})
    assert found.t_ns is None
    assert found.notes == (f"{key} is no keyword of a time that is known: undated; write DATE-OBS",)


@pytest.mark.parametrize("key", ["DATE", "DATE-LOC"])
def test_the_date_of_the_file_or_of_another_clock_is_no_time(key):
    found = read_image({key: EIGHT_PM, "EXPTIME": 10.0})
    assert found.t_ns is None and not found.notes


@pytest.mark.parametrize("key", ["CFA_PATT", "BAYERIND", "MOSAIC", "COLORMOD"])
def test_a_pattern_in_a_keyword_that_is_not_known_is_taken_and_said(key):
    found = read_image({key: "gbrg"})
    assert found.bayer == "GBRG"
    assert found.notes == (f"{key} = GBRG is taken for the mosaic's pattern",)
    assert read_image({key: "gbrg", "BAYERPAT": "NONE"}).bayer == ""


def test_a_binned_mosaic_is_said():
    binned = read_image({"BAYERPAT": "RGGB", "XBINNING": 2, "YBINNING": 2})
    assert binned.notes[0].startswith("XBINNING = 2: a binned mosaic may mix colours")
    assert not read_image({"BAYERPAT": "RGGB", "XBINNING": 1}).notes
    assert not read_image({"XBINNING": 2}).notes


@pytest.mark.parametrize(
    ("pixels", "cards"),
    [
        ("RGGB", {"BAYERPAT": "RGGB"}),
        ("RGGB", {"BAYERPAT": "RG/GB"}),
        ("RGGB", {"BAYERPAT": "BayerRG12"}),
        ("GBRG", {"BAYERPAT": "SGBRG10P"}),
        ("GRBG", {"BAYERPAT": "GRBG_16"}),
        ("RGGB", {"BAYERPAT": "rggb"}),
        ("RGGB", {"BAYERPAT": "'RGGB'"}),
        ("RGGB", {"COLORTYP": "RGGB"}),
        ("GBRG", {"CFATYPE": "GBRG"}),
        ("GRBG", {"BAYERPAT": "RGGB", "XBAYROFF": 1, "YBAYROFF": 0}),
        ("GBRG", {"BAYERPAT": "RGGB", "XBAYROFF": 0, "YBAYROFF": 1}),
        ("BGGR", {"BAYERPAT": "RGGB", "XBAYROFF": 1, "YBAYROFF": 1}),
        ("RGGB", {"BAYERPAT": "RGGB", "XBAYROFF": 2, "YBAYROFF": -2}),
        ("GRBG", {"BAYERPAT": "RGGB", "BAYOFFX": 1.0, "BAYOFFY": 0.0}),
        ("BGGR", {"BAYERPAT": "BGGR", "ROWORDER": "TOP-DOWN"}),
        # From the bottom: the pattern is that of the picture, whose top row is the last of 64.
        ("GBRG", {"BAYERPAT": "RGGB", "ROWORDER": "BOTTOM-UP"}),
    ],
)
def test_planes_have_the_names_of_their_colours(tmp_path: Path, pixels, cards):
    path = tmp_path / "mosaic.fits"
    path.write_bytes(file_of(mosaic_hdu(cards, pixels)))
    planes = {photo.plane: int(photo.dn.mean()) // 1000 for photo in read_photographs(path, None)}
    assert planes == {"r": 1, "g1": 2, "g2": 2, "b": 3}


@pytest.mark.parametrize("value", [None, "NONE", "mono", False, "", "N/A"])
def test_a_grey_image_is_one_plane(value):
    assert read_image({} if value is None else {"BAYERPAT": value}).bayer == ""


@pytest.mark.parametrize(
    "value", ["GGRGGBGGBGGRBRGRBGGGBGGRGGRGGBRBGBRG", "TRUE", True, "X-TRANS", "CYGM", "RGBG"]
)
def test_a_mosaic_of_another_kind_is_refused(tmp_path: Path, value):
    path = tmp_path / "mosaic.fits"
    path.write_bytes(file_of(mosaic_hdu({"BAYERPAT": value})))
    with pytest.raises(
        InputError,
        match=r"mosaic\.fits: BAYERPAT is .*a mosaic of a kind that is not read; write RGGB",
    ):
        read_photographs(path, None)


@pytest.mark.parametrize(
    "cards", [{"XBAYROFF": 0.5}, {"YBAYROFF": "one"}, {"ROWORDER": "SIDEWAYS"}]
)
def test_a_layout_that_is_none_is_refused(cards):
    with pytest.raises(InputError, match=next(iter(cards))):
        read_image({"BAYERPAT": "RGGB", **cards})


def test_rows_from_the_bottom_are_turned_over():
    given = mosaic_hdu({"ROWORDER": "BOTTOM-UP"})
    assert (read_fits_image(file_of(given)).pixels == given.data[::-1]).all()


def test_of_several_images_the_first_is_taken_and_tables_are_none_of_them():
    table = fits.BinTableHDU.from_columns([fits.Column("a", "J", array=np.arange(3))])
    first = fits.ImageHDU(mosaic("RGGB"))
    other = fits.ImageHDU(mosaic("RGGB") + 1)
    found = read_fits_image(file_of(fits.PrimaryHDU(), table, first, other))
    assert (found.pixels == first.data).all()
    assert found.notes == ("holds 2 images, of which the first is taken",)


KEYS = {"BAYERPAT": "RGGB", "DATE-OBS": EIGHT_PM, "EXPTIME": 10.0}


@pytest.mark.parametrize("own", [fits.ImageHDU, fits.CompImageHDU])
def test_an_extension_inherits_what_the_primary_header_says(own):
    primary = fits.PrimaryHDU()
    primary.header.update(KEYS)
    found = read_fits_image(file_of(primary, own(mosaic("RGGB"))))
    assert (found.bayer, found.exposure_s, found.t_ns) == (
        "RGGB",
        10.0,
        utc_ns("2024-03-01T20:00:05"),
    )


@pytest.mark.parametrize("own", [fits.ImageHDU, fits.CompImageHDU])
def test_an_extension_s_own_keywords_count_first(own):
    primary = fits.PrimaryHDU()
    primary.header.update(KEYS)
    mine = own(mosaic("RGGB"))
    mine.header["EXPTIME"] = 4.0
    assert read_fits_image(file_of(primary, mine)).exposure_s == 4.0
    for no in (False, "F"):
        apart = fits.ImageHDU(mosaic("RGGB"))
        apart.header["INHERIT"] = no
        found = read_fits_image(file_of(primary, apart))
        assert (found.bayer, found.exposure_s, found.t_ns) == ("", None, None)


def test_the_first_of_several_images_is_taken_and_said():
    found = read_fits_image(
        file_of(mosaic_hdu({}), fits.ImageHDU(np.zeros((8, 8), dtype=np.uint8)))
    )
    assert found.pixels.shape == (SIDE_PX, SIDE_PX)
    assert found.notes == ("holds 2 images, of which the first is taken",)


@pytest.mark.parametrize(
    "reader", [lambda path: read_photographs(path, None)[0].dn, lambda path: read_exposed(path)[0]]
)
def test_a_packed_file_is_the_same_image(tmp_path: Path, reader):
    plain, packed = tmp_path / "a.fits", tmp_path / "a.fits.gz"
    plain.write_bytes(file_of(mosaic_hdu({})))
    packed.write_bytes(gzip.compress(plain.read_bytes()))
    assert (reader(plain) == reader(packed)).all()
    packed.write_bytes(gzip.compress(plain.read_bytes())[:-40])
    with pytest.raises(InputError, match="a damaged gzip file"):
        reader(packed)


def test_scaled_levels_are_the_image_s():
    stored = fits.PrimaryHDU(mosaic("RGGB").astype(np.int16))
    stored.header["BSCALE"], stored.header["BZERO"] = 1.0, 0.0
    assert (read_fits_image(file_of(stored)).pixels == mosaic("RGGB")).all()
    halves = fits.PrimaryHDU(mosaic("RGGB") / 2)
    halves.scale("int16", bscale=0.5)
    assert read_fits_image(file_of(halves)).pixels == pytest.approx(mosaic("RGGB") / 2)


def test_pixels_without_a_value_are_refused():
    """BLANK is stored before BZERO: 0 of an unsigned 16-bit image is stored as -32768."""
    unsigned = fits.PrimaryHDU(mosaic("RGGB"))
    unsigned.data[3, :5] = 0
    unsigned.header["BLANK"] = -32768
    with pytest.raises(InputError, match=r"5 pixels have no value \(BLANK = -32768\)"):
        read_fits_image(file_of(unsigned))


def test_what_is_no_fits_is_told():
    with pytest.raises(ImageSizeError, match="not a FITS image"):
        read_fits_image(b"BZh91AY")


@pytest.mark.parametrize(("off_s", "is_said"), [(5.9, False), (6.1, True), (-5.9, False)])
def test_a_second_time_may_be_off_by_half_the_exposure_and_a_second(off_s, is_said):
    """Programs differ in whether DATE-OBS is the start."""
    other = str(np.datetime64(utc_ns(EIGHT_PM) + round(off_s * 1e9), "ns"))
    found = read_image({"DATE-AVG": EIGHT_PM, "DATE-MID": other, "EXPTIME": 10.0})
    assert found.t_ns == utc_ns(EIGHT_PM)
    assert bool(found.notes) is is_said
