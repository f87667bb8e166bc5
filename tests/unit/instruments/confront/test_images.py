"""What a photograph's file says: its levels, its time and exposure, and whether it is a grey image
at all; files are written here by Pillow and Astropy.
"""

from __future__ import annotations

from pathlib import Path

import erfa
import numpy as np
import pytest
from astropy.coordinates import get_body, solar_system_ephemeris
from astropy.io import fits
from astropy.time import Time
from PIL import Image

from hilstar.basics.arrays import FloatArray
from hilstar.instruments.confront.images import paged, parse_utc, read_photographs
from hilstar.instruments.confront.photographed_sky import (
    dated_sky,
    earth_velocity_km_s,
    planets_seen,
)
from hilstar.server.bench.bench_file import bench_file_of
from hilstar.sky.stars import unit_vectors_icrs
from tests.support.benches import SMALL_BENCH
from tests.support.refusals import refusal

WIDTH, HEIGHT = 80, 64
EXIF_IFD, EXPOSURE, ORIGINAL, OFFSET = 0x8769, 0x829A, 0x9003, 0x9011
# half past one in the morning of the 30th, a quarter of an hour after, of an exposure of 8 s
LOCAL = "2019:07:30 01:45:10"


def ramp(dtype: type = np.uint16, step: int = 4, top: int = 3000) -> np.ndarray:
    """Levels a step apart, none of them alike along an axis."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    return (step * ((3 * rows + 7 * columns) % (top // step))).astype(dtype)


def written(folder: Path, offset: str | None = None, exposure_s: float | None = 8.0) -> Path:
    """A grey image with EXIF, and its path."""
    table: dict[int, str | float] = {ORIGINAL: LOCAL}
    if exposure_s is not None:
        table[EXPOSURE] = exposure_s
    if offset is not None:
        table[OFFSET] = offset
    exif = Image.Exif()
    exif[EXIF_IFD] = table
    path = folder / "shot.png"
    Image.fromarray(ramp()).save(path, exif=exif, compress_level=1)
    return path


def ns(utc: str) -> int:
    return int(np.datetime64(utc, "ns").astype(np.int64))


@pytest.mark.parametrize(
    ("offset", "utc"),
    [
        ("+05:30", "2019-07-29T20:15:10"),
        ("-03:00", "2019-07-30T04:45:10"),
        ("+00:00", "2019-07-30T01:45:10"),
    ],
)
def test_a_photograph_s_time_is_the_middle_of_its_exposure_in_utc(tmp_path, offset, utc) -> None:
    (photo,) = read_photographs(written(tmp_path, offset), None)
    assert photo.t_ns == ns(utc) + 4 * 10**9
    assert photo.exposure_s == 8.0
    (photo,) = read_photographs(written(tmp_path, offset, None), None)
    assert (photo.t_ns, photo.exposure_s) == (ns(utc), None)


def test_a_time_without_an_offset_is_none_and_one_that_is_given_is_it(tmp_path: Path) -> None:
    dated = written(tmp_path, "+00:00")
    assert read_photographs(dated, None)[0].t_ns is not None
    assert read_photographs(dated, None, 77)[0].t_ns == 77
    path = written(tmp_path)
    assert read_photographs(path, None)[0].t_ns is None
    assert read_photographs(path, None)[0].exposure_s == 8.0
    assert read_photographs(path, None, 77)[0].t_ns == 77
    named = path.rename(tmp_path / "night_2020-09-20T20-01-02.png")
    (photo,) = read_photographs(named, None)
    assert photo.t_ns == ns("2020-09-20T20:01:02")
    assert any("from its name" in note for note in photo.notes)
    assert parse_utc("2019-07-29T20:47:26") == ns("2019-07-29T20:47:26")
    assert "--taken" in refusal(parse_utc, "yesterday")


def saved(folder: Path, pixels: np.ndarray, name: str = "a.tiff") -> Path:
    path = folder / name
    Image.fromarray(pixels).save(path, compress_level=1)
    return path


def read(path: Path) -> FloatArray:
    return read_photographs(path, None)[0].dn


def test_levels_are_those_of_the_file_row_by_row(tmp_path: Path) -> None:
    (photo,) = read_photographs(saved(tmp_path, ramp()), (WIDTH, HEIGHT))
    assert photo.dn.tolist() == ramp().tolist()
    # 2996 is under 4095, the end of 12 bits
    assert (photo.step_dn, photo.full_dn) == (4.0, 4095.0)
    assert photo.size_px == (WIDTH, HEIGHT)
    wanted = refusal(read_photographs, tmp_path / "a.tiff", (HEIGHT, WIDTH))
    assert f"write resolution_px = [{WIDTH}, {HEIGHT}]" in wanted


def test_a_top_that_many_pixels_have_is_where_levels_end(tmp_path: Path) -> None:
    image = ramp()
    image[10, 10:30] = 3600
    assert read_photographs(saved(tmp_path, image), None)[0].full_dn == 3600.0
    image = ramp()
    image[10, 10] = 4092  # a step under the end of 12 bits
    assert read_photographs(saved(tmp_path, image), None)[0].full_dn == 4092.0


@pytest.mark.parametrize(
    ("step", "top", "pixels_at_top", "full_dn"),
    [
        # a saturated level is one less than a multiple of the step
        (16, 65535, 3, 65535.0),
        (16, 65535, 1, 65535.0),
        # one level over 12 bits is of 13, and the last of them is where they end
        (4, 4096, 1, 8191.0),
        (4, 4095, 1, 4095.0),
        (4, 3600, 2, 4095.0),
        (4, 3600, 3, 3600.0),
    ],
)
def test_levels_end_with_their_bits_or_where_three_pixels_are_clipped(
    tmp_path: Path, step: int, top: int, pixels_at_top: int, full_dn: float
) -> None:
    image = ramp(np.uint16, step)
    image[10, 10 : 10 + pixels_at_top] = top
    image[20, 20] = step * ((top - 1) // step)
    (photo,) = read_photographs(saved(tmp_path, image), None)
    assert (photo.step_dn, photo.full_dn) == (step, full_dn)


@pytest.mark.parametrize(
    ("name", "kind", "notes"),
    [("a.jpg", "JPEG", 1), ("a.mpo", "MPO", 1), ("a.webp", "WEBP", 1), ("a.png", "PNG", 0)],
)
def test_a_picture_whose_tone_curve_is_not_known_says_so(
    tmp_path: Path, name: str, kind: str, notes: int
) -> None:
    path = tmp_path / name
    picture = Image.fromarray(ramp(np.uint8, 1, 200))
    preview = {"save_all": True, "append_images": [picture.resize((40, 32))]}
    others = preview if kind == "MPO" else {}
    picture.save(path, kind, **others)
    (photo,) = read_photographs(path, None)
    assert [note.partition(":")[0] for note in photo.notes] == ["a JPEG"] * notes


def test_a_map_of_directions_is_no_photograph_and_one_of_its_keys_is_no_map(
    tmp_path: Path,
) -> None:
    header = fits.Header({"CENTAZ": 0.0})
    path = tmp_path / "a.fits"
    fits.PrimaryHDU(ramp(), header).writeto(path)
    assert read_photographs(path, None)[0].step_dn == 4.0
    header["CENTEL"] = 90.0
    fits.PrimaryHDU(ramp(), header).writeto(path, overwrite=True)
    assert "(CENTAZ, CENTEL)" in refusal(read_photographs, path, None)


def test_three_channels_that_are_alike_are_grey_and_opacity_is_none(tmp_path: Path) -> None:
    grey = ramp(np.uint8, 1, 200)
    alike = np.stack([grey] * 3, axis=2)
    opaque = np.full((HEIGHT, WIDTH, 1), 255, dtype=np.uint8)
    for number, pixels in enumerate(
        (alike, np.concatenate([alike, opaque], axis=2), np.stack([grey, opaque[..., 0]], axis=2))
    ):
        assert read(saved(tmp_path, pixels, f"{number}.png")).tolist() == grey.tolist()
    # noise is each channel's own, and light is not
    noisy = alike.copy()
    noisy[grey < 150] += np.array([12, 0, 0], dtype=np.uint8)
    assert read(saved(tmp_path, noisy, "noisy.png")).tolist() == noisy.mean(axis=2).tolist()
    coloured = alike.copy()
    coloured[..., 2] //= 2
    says = refusal(read_photographs, saved(tmp_path, coloured, "b.png"), None)
    assert "three colours for each pixel" in says


@pytest.mark.parametrize(
    ("pixels", "says"),
    [
        (np.full((HEIGHT, WIDTH), 7, dtype=np.uint16), "are saturated at 7"),
        (np.zeros((HEIGHT, WIDTH), dtype=np.uint16), "every pixel is 0"),
        (ramp()[:20, :20], "20 x 20 px is too small"),
        (ramp()[:63], "80 x 63 px is too small"),
        (np.eye(HEIGHT, dtype=bool), "of a palette or of print (1)"),
    ],
)
def test_what_is_no_photograph_of_stars_is_refused(tmp_path, pixels, says) -> None:
    assert says in refusal(read_photographs, saved(tmp_path, pixels, "a.png"), None)


def test_a_fits_file_has_its_levels_exposure_and_middle(tmp_path: Path) -> None:
    header = fits.Header()
    header["EXPTIME"] = 8.0
    header["DATE-OBS"] = "2019-07-29T20:15:10"
    path = tmp_path / "a.fits"
    fits.PrimaryHDU(ramp(), header).writeto(path)
    (photo,) = read_photographs(path, None)
    assert photo.dn.tolist() == ramp().tolist()
    assert photo.exposure_s == 8.0
    assert photo.t_ns == ns("2019-07-29T20:15:14")
    header["EXPTIME"] = 0.0
    fits.PrimaryHDU(ramp(), header).writeto(path, overwrite=True)
    assert read_photographs(path, None)[0].exposure_s is None
    broken = ramp().astype(np.float32)
    broken[3, 4] = np.nan
    fits.PrimaryHDU(broken).writeto(path, overwrite=True)
    assert "1 pixels are no finite numbers" in refusal(read_photographs, path, None)


def test_an_array_in_a_file_is_the_same(rng) -> None:
    array = rng.normal(size=(5, 7))
    stored = paged(array)
    assert stored.shape == array.shape
    assert stored.tolist() == array.tolist()


def test_a_sky_is_of_its_day_as_a_moving_observer_sees_it(tmp_path: Path) -> None:
    """Places are drawn towards the observer's motion by v / c, which over a site is the Earth's and
    that of its ground.
    """
    site = "[site]\nlatitude_deg = 40.0\nlongitude_deg = 10.0\nheight_m = 0\n"
    site += '[sky]\nepoch_utc = "2015-01-01T00:00:00Z"\n'
    t_ns = ns("2020-09-20T20:00:00")
    skies = []
    for text in (SMALL_BENCH, SMALL_BENCH + site):
        skies.append(dated_sky(bench_file_of(tmp_path / "bench.toml", text), t_ns))
    plain, over_site = skies
    assert plain.epoch_jyear == over_site.epoch_jyear == pytest.approx(2020.72, abs=0.01)
    assert (np.diff(plain.v_mag) >= 0).all()
    for sky in skies:
        assert sky.velocity_km_s is not None
        still = unit_vectors_icrs(sky.catalog, sky.epoch_jyear)[sky.order]
        moved = still + sky.velocity_km_s / 299_792.458
        moved /= np.linalg.norm(moved, axis=1, keepdims=True)
        # the square of v / c
        assert np.abs(sky.vectors - moved).max() < 1e-7
    # Sirius, the brighter of alpha Centauri, and Vega, as ESA SP-1200 has them
    three = np.array([0, 3, 4])
    assert plain.hip[three].tolist() == [32349, 71683, 91262]
    assert [plain.name(int(star)) for star in three] == ["HIP 32349", "HIP 71683", "HIP 91262"]
    v_mag, bv_mag, vi_mag = plain.columns(plain.order[three])
    assert v_mag.tolist() == plain.v_mag[three].tolist() == pytest.approx([-1.44, -0.01, 0.03])
    assert bv_mag.tolist() == plain.bv_mag[three].tolist() == pytest.approx([0.009, 0.71, -0.001])
    assert vi_mag == pytest.approx([-0.02, 0.69, -0.01])
    sigma_mag, is_double, is_variable = plain.within(three)
    assert sigma_mag.shape == (3,) and (sigma_mag > 0).all()
    assert (is_double.tolist(), is_variable.tolist()) == ([True, True, False], [True, False, True])
    assert plain.velocity_km_s.tolist() == earth_velocity_km_s(t_ns).tolist()
    ground_km_s = over_site.velocity_km_s - plain.velocity_km_s
    assert np.linalg.norm(ground_km_s) == pytest.approx(0.465 * np.cos(np.radians(40)), rel=0.01)
    east = np.cross([0.0, 0.0, 1.0], over_site.air.up)
    # the pole of date is 0.002 rad from that of the ICRS
    np.testing.assert_allclose(
        ground_km_s / np.linalg.norm(ground_km_s), east / np.linalg.norm(east), atol=0.005
    )
    assert plain.air is None
    assert plain.masses(np.array([0.0, 0.0, 1.0])) is None
    assert over_site.air is not None
    # the pole stands as high as the latitude
    assert over_site.masses(np.array([0.0, 0.0, 1.0])) == pytest.approx(
        1 / np.sin(np.radians(40)), rel=0.01
    )
    undated = dated_sky(bench_file_of(tmp_path / "bench.toml", SMALL_BENCH + site), None)
    assert undated.velocity_km_s is undated.air is None
    at_epoch = unit_vectors_icrs(undated.catalog, undated.epoch_jyear)[undated.order]
    assert undated.vectors.tolist() == at_epoch.tolist()


# of the planets' mean elements, and what moves in the light's time to the Earth; of the Moon's
PLANET_ERROR_RAD, MOON_ERROR_RAD = np.radians(2 / 60), np.radians(1.0)


def test_planets_are_where_astropy_has_them_from_the_earth() -> None:
    """On a day when the barycentre is 0.008 au from the Sun, half a degree of Mars's place."""
    when = Time("2020-09-20T20:00:00", scale="utc")
    seen = planets_seen(ns("2020-09-20T20:00:00"))
    assert len(seen) == 8
    with solar_system_ephemeris.set("builtin"):
        for name, direction in seen.items():
            body = name.removeprefix("the ").lower()
            wanted = get_body(body, when).cartesian.xyz.value
            wanted = wanted / np.linalg.norm(wanted)
            limit_rad = MOON_ERROR_RAD if body == "moon" else PLANET_ERROR_RAD
            assert np.linalg.norm(np.cross(direction, wanted)) < limit_rad
            assert direction @ wanted > 0


def test_planets_are_seen_shifted_towards_where_the_earth_moves() -> None:
    """By 20.5 arcsec times the sine of the angle from there, which is less than their elements'
    error: against their own directions at rest.
    """
    t_ns = ns("2020-09-20T20:00:00")
    seen = planets_seen(t_ns)
    jd = t_ns / 86_400e9
    about_sun, about_centre = erfa.epv00(2440587.5, jd)
    velocity_c = about_centre["v"] * 1.495978707e8 / 86_400 / 299_792.458
    for number, name in ((1, "Mercury"), (2, "Venus"), (4, "Mars"), (6, "Saturn")):
        at_rest = erfa.plan94(2440587.5, jd, number)["p"] - about_sun["p"]
        at_rest /= np.linalg.norm(at_rest)
        across_c = velocity_c - (velocity_c @ at_rest) * at_rest
        np.testing.assert_allclose(seen[name] - at_rest, across_c, atol=2e-8)
