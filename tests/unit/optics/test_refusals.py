"""PSF files, maps of stray light and faults that are refused, and the words of the one line."""

from __future__ import annotations

import io

import numpy as np
import pytest
from astropy.io import fits
from PIL import Image

from hilstar.optics.layers import stray_light
from hilstar.optics.layers.fault_kinds import fault_of
from hilstar.optics.layers.stray_light import map_sha256, read_map
from hilstar.optics.psf import MAX_FOOTPRINT_PX, SampledPsf, read_psf
from tests.support.refusals import assert_file_refused, refusal, says


def npy(values: object) -> bytes:
    file = io.BytesIO()
    np.save(file, np.asarray(values))
    return file.getvalue()


def fits_bytes(values: np.ndarray | None, **keys: object) -> bytes:
    file = io.BytesIO()
    header = fits.Header(list(keys.items()))
    fits.PrimaryHDU(values, header).writeto(file)
    return file.getvalue()


def png(values: np.ndarray) -> bytes:
    file = io.BytesIO()
    Image.fromarray(values).save(file, "PNG")
    return file.getvalue()


MAPS = [
    (npy(np.ones(4)), ": an array of shape (4,); give a FITS image"),
    (npy(np.ones((3, 4, 3))), ": an array of shape (3, 4, 3); "),
    (png(np.ones((3, 4, 3), np.uint8)), ": an array of shape (3, 4, 3); "),
    (npy(np.ones((1, 4))), ": an array of shape (1, 4); ...2 to 16384 px on a side"),
    (npy(np.ones((4, 1))), ": an array of shape (4, 1); "),
    (npy(np.ones((2, 3), dtype=complex)), ": values of type complex128; "),
    (npy([[1.0, -1e-9], [1.0, 1.0]]), ": a value is negative or not finite; "),
    (npy([[1.0, np.nan], [1.0, 1.0]]), ": a value is negative or not finite; "),
    (npy([[1.0, np.inf], [1.0, 1.0]]), ": a value is negative or not finite; "),
    (npy(np.zeros((2, 3))), ": is dark everywhere; "),
    (fits_bytes(None), ": has no image; give a FITS file of one"),
    (b"a text", ": "),
    (npy(np.ones((2, 3)))[:-9], ": "),
]


@pytest.mark.parametrize(("content", "words"), MAPS, ids=[words[:50] for _, words in MAPS])
def test_what_is_no_map_of_stray_light_is_refused(tmp_path, content, words):
    (tmp_path / "map").write_bytes(content)
    assert_file_refused(read_map, tmp_path / "map", words)


def test_a_side_of_a_map_is_bounded(tmp_path, monkeypatch):
    monkeypatch.setattr(stray_light, "MAX_SIDE_PX", 3)
    for shape, is_taken in (((3, 3), True), ((2, 4), False), ((4, 2), False)):
        (tmp_path / "map").write_bytes(npy(np.ones(shape)))
        if is_taken:
            assert read_map(tmp_path / "map").shape == shape
        else:
            assert_file_refused(read_map, tmp_path / "map", ": an array of shape")


@pytest.mark.parametrize("form", ["npy", "png", "fits"])
def test_a_map_s_first_row_is_the_top_one_in_every_form(tmp_path, form):
    """FITS begins at the bottom on a chart; its first row is the detector's first."""
    values = np.arange(12, dtype=np.uint8).reshape(3, 4)
    content = {"npy": npy, "png": png, "fits": fits_bytes}[form](values)
    (tmp_path / "map").write_bytes(content)
    found = read_map(tmp_path / "map")
    assert found.dtype == np.float64
    assert (found == values).all()


def test_a_map_is_known_by_its_content(tmp_path):
    for name, content in (("a", b"x"), ("b", b"x"), ("c", b"y")):
        (tmp_path / name).write_bytes(content)
    sums = [map_sha256(tmp_path / name) for name in "abc"]
    assert sums[0] == sums[1] != sums[2]
    # FIPS 180-4 of the one letter x
    assert sums[0] == "2d711642b726b04401627ca9fbac32f5c8530fb1903cc4db02258717921a4881"
    assert_file_refused(map_sha256, tmp_path / "none", ": ")


AT = np.arange(-6, 7) / 3
ROUND = np.exp(-(AT[:, None] ** 2 + AT**2) / 0.8)
# Each second sample along x or y: a star in a pixel's middle gets a tenth of one at its edge.
STRIPES = np.where(np.arange(-6, 7) % 2, 1.0, 0.1)
PSFS = [
    (b"no FITS", ": ...not a FITS image"),
    *(
        (fits_bytes(stripes, OVERSAMP=2, PIXINT=True), ": ...% of a PSF's light at one place in a")
        for stripes in (np.outer(np.ones(13), STRIPES), np.outer(STRIPES, np.ones(13)))
    ),
    (fits_bytes(None), ": not a FITS image"),
    (fits_bytes(np.stack([ROUND, ROUND]), OVERSAMP=3), ": holds 2 images, and one PSF is drawn"),
    (fits_bytes(ROUND, OVERSAMP=3)[:3000], ": not a FITS image"),
]


@pytest.mark.parametrize(("content", "words"), PSFS, ids=[words for _, words in PSFS])
def test_what_is_no_psf_is_refused(tmp_path, content, words):
    (tmp_path / "psf.fits").write_bytes(content)
    assert_file_refused(read_psf, tmp_path / "psf.fits", words)


def test_a_psf_s_file_read_again_is_the_same_psf(tmp_path):
    (tmp_path / "psf.fits").write_bytes(fits_bytes(ROUND, OVERSAMP=3))
    found = read_psf(tmp_path / "psf.fits")
    assert found.per_px == 3
    assert np.asarray(found.samples).shape == ROUND.shape
    assert read_psf(tmp_path / "psf.fits") is found
    # a cube of one image, as some programs write every image
    (tmp_path / "cube.fits").write_bytes(fits_bytes(ROUND[None], OVERSAMP=3))
    np.testing.assert_array_equal(read_psf(tmp_path / "cube.fits").samples, found.samples)


def test_light_that_reaches_too_far_is_no_psf():
    """A share of 3 % lies evenly over more pixels than a footprint may have."""
    side = 2 * MAX_FOOTPRINT_PX + 41
    wide = np.full((side, side), 0.03 / side**2)
    middle = side // 2
    wide[middle - 8 : middle + 9, middle - 8 : middle + 9] += np.exp(
        -(np.arange(-8, 9)[:, None] ** 2 + np.arange(-8, 9) ** 2) / 4
    )
    line = refusal(SampledPsf, wide / wide.sum(), 1, False)
    assert says(line, f"reaches over more than {MAX_FOOTPRINT_PX} px; cut off")


FAULTS = [
    ({}, "the key kind is missing; ...write one of"),
    ({"kind": "blanc"}, "kind = 'blanc'; ...blank"),
    (
        {
            "kind": "light-map",
            "name": "a",
            "file": "m.png",
            "electrons_per_s": 1.0,
            "electrons": 2.0,
        },
        "has electrons_per_s and electrons; write one of them",
    ),
]


@pytest.mark.parametrize(("table", "words"), FAULTS, ids=[words for _, words in FAULTS])
def test_what_is_no_fault_is_refused(table, words):
    assert says(refusal(fault_of, table), words)


def test_a_fault_that_is_nested_without_end_is_refused():
    inner: list[object] = []
    for _ in range(3000):
        inner = [inner]
    table = {"kind": "light-map", "name": "a", "file": "m", "electrons": inner}
    assert says(refusal(fault_of, table), "its values are nested too deep")


@pytest.mark.parametrize("name", ["", " a", "a ", "a\n", "a\x07"])
def test_a_fault_has_a_name_that_can_be_printed(name):
    assert fault_of({"kind": "blank", "name": "a b"}).name == "a b"
    assert "name" in refusal(fault_of, {"kind": "blank", "name": name})
    assert "the key name is missing" in refusal(fault_of, {"kind": "blank"})
