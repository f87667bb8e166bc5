"""Pictures of a user's: small files that unpack to gigabytes, and files of other formats under a
picture's name.
"""

from __future__ import annotations

import ast
import bz2
import functools
import gzip
import io
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from PIL import Image, ImageFile

from hilstar.basics.errors import InputError
from hilstar.basics.image_files import (
    ImageSizeError,
    opened_fits,
    opened_picture,
    unpacked,
)
from hilstar.instruments.calibrate.geometric.observed import read_image
from hilstar.instruments.confront.images import read_photographs
from hilstar.optics.glass.psf_file import read_glass
from hilstar.optics.layers.stray_light import read_map
from hilstar.sky.diffuse import read_diffuse_map
from tests.support.benches import ROOT
from tests.support.refusals import refusal

SIDE_PX = 13_000  # 1.4 GB as float64
EPS = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 64 64\n%%EndComments\n(x) run\n%%EOF\n"
READERS = [read_image, lambda path: read_photographs(path, None), read_map]
OPENERS = {
    ("Image", "open"),
    ("fits", "open"),
    ("fits", "getdata"),
    ("np", "load"),
    ("plt", "imread"),
}
# Of hilstar's own files, such as the frames that `compare` takes, of tables that are read by
# columns, and of its own process.
OWN = {
    "image_files.py",
    "ck.py",
    "star_table.py",
    "electrons.py",
    "facts.py",
    "catalog.py",
    "quantise.py",
    "table_reader.py",
}


def chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


@functools.cache
def png_bomb(side_px: int = SIDE_PX) -> bytes:
    """A dark PNG of side_px x side_px, in some 170 kB."""
    packer, rows = zlib.compressobj(9), []
    for _ in range(side_px):
        rows.append(packer.compress(bytes(side_px + 1)))
    data = b"".join([*rows, packer.flush()])
    head = struct.pack(">IIBBBBB", side_px, side_px, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


@pytest.fixture
def undecoded(monkeypatch):
    """Whoever decodes a picture fails."""

    def load(self):
        raise AssertionError("it was decoded")

    monkeypatch.setattr(ImageFile.ImageFile, "load", load)


@pytest.mark.parametrize("reader", READERS)
def test_a_picture_that_unpacks_to_gigabytes_is_refused_before_it_is_decoded(
    tmp_path: Path, undecoded, reader
):
    (tmp_path / "bomb.png").write_bytes(data := png_bomb())
    assert len(data) < 200_000
    with pytest.raises(InputError, match=f"is {SIDE_PX} x {SIDE_PX} px"):
        reader(tmp_path / "bomb.png")


def test_a_picture_of_another_size_is_refused_before_it_is_decoded(tmp_path: Path, undecoded):
    path = tmp_path / "small.png"
    Image.fromarray(np.zeros((40, 50), dtype=np.uint8)).save(path)
    for reader in (read_image, read_photographs):
        assert "is 50 x 40 px" in refusal(reader, path, (64, 64))


@pytest.mark.parametrize("reader", READERS)
def test_a_file_of_another_format_is_no_picture_whatever_its_name(
    tmp_path: Path, monkeypatch, reader
):
    ghost = pytest.importorskip("PIL.EpsImagePlugin")
    monkeypatch.setattr(
        ghost, "Ghostscript", lambda *arguments, **named: pytest.fail("Ghostscript was called")
    )
    (tmp_path / "eps.png").write_bytes(EPS)
    with pytest.raises(InputError):
        reader(tmp_path / "eps.png")


def test_fits_that_is_packed_is_bounded_by_what_it_unpacks_to(tmp_path: Path):
    whole = io.BytesIO()
    fits.PrimaryHDU(np.zeros((64, 64), dtype=np.uint16)).writeto(whole)
    with opened_fits(whole.getvalue(), (64, 64)) as hdus:
        assert hdus[0].data.shape == (64, 64)
    with (
        pytest.raises(ImageSizeError, match="is 64 x 64 px"),
        opened_fits(whole.getvalue(), (64, 65)),
    ):
        pass
    several = io.BytesIO()
    fits.HDUList(
        [fits.PrimaryHDU(np.zeros((64, 32), dtype=np.float32)), fits.ImageHDU(np.zeros((9, 7)))]
    ).writeto(several)
    with opened_fits(several.getvalue(), (32, 64)) as hdus:  # the first alone has to have it
        assert [hdu.data.shape for hdu in hdus] == [(64, 32), (9, 7)]
    # floats, whose BITPIX is below 0
    card = b"NAXIS2  = " + b"64".rjust(20)
    promised = several.getvalue().replace(card, card[:10] + b"99999999".rjust(20), 1)
    with pytest.raises(ImageSizeError, match=r"unpacks to 12\.8 GB, and"), opened_fits(promised):
        pass
    packed = gzip.compress(whole.getvalue())
    with opened_fits(packed, (64, 64)) as hdus:
        assert hdus[0].data.shape == (64, 64)
    with pytest.raises(ImageSizeError, match="is 64 x 64 px"), opened_fits(packed, (64, 65)):
        pass
    size_bytes = len(whole.getvalue())
    assert unpacked(packed, size_bytes) == whole.getvalue()
    with pytest.raises(ImageSizeError, match="unpacks to more than"):
        unpacked(packed, size_bytes - 1)
    (tmp_path / "packed.fits").write_bytes(packed)
    assert read_image(tmp_path / "packed.fits").shape == (64, 64)
    with pytest.raises(InputError):
        read_glass(tmp_path / "packed.fits")  # a dark image is no PSF
    with (
        pytest.raises(ImageSizeError, match="unpack it first"),
        opened_fits(bz2.compress(whole.getvalue())),
    ):
        pass
    made = io.BytesIO()
    fits.HDUList(
        [fits.PrimaryHDU(), fits.CompImageHDU(np.zeros((64, 64), dtype=np.int16))]
    ).writeto(made)
    bomb = made.getvalue()
    for key in (b"ZNAXIS1 ", b"ZNAXIS2 "):
        at = bomb.index(key)
        bomb = bomb[:at] + key + b"=" + b"40000".rjust(21) + bomb[at + 30 :]
    (tmp_path / "tiles.fits").write_bytes(bomb)
    for reader in (lambda path: read_photographs(path, None), read_map, read_diffuse_map):
        with pytest.raises(InputError, match=r"unpacks to 3\.2 GB"):
            reader(tmp_path / "tiles.fits")


def test_pictures_are_opened_by_one_function():
    for path in (ROOT / "hilstar").rglob("*.py"):
        if path.name in OWN or "study" in path.parts:
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
                assert (node.value.id, node.attr) not in OPENERS, (path, node.lineno)


def test_the_formats_that_are_let_in_are_read(rng):
    image = Image.fromarray(rng.integers(0, 255, (30, 40)).astype(np.uint8))
    for name in ("PNG", "TIFF", "JPEG", "BMP", "PPM"):
        made = io.BytesIO()
        image.save(made, name)
        with opened_picture(made.getvalue(), (40, 30)) as picture:
            assert np.asarray(picture).shape == (30, 40)


def saved_stack(path: Path, other_px: int) -> Path:
    """A TIFF of two images, the first of 64 x 64 px, the second of a size of its own."""
    first, second = (Image.new("L", (size, size), 9) for size in (64, other_px))
    first.save(path, save_all=True, append_images=[second])
    return path


def test_a_stack_of_exposures_is_refused_and_a_preview_beside_an_image_is_not(tmp_path: Path):
    with pytest.raises(InputError, match="holds 2 images of one size; write one image a file"):
        read_image(saved_stack(tmp_path / "stack.tiff", 64))
    image = read_image(saved_stack(tmp_path / "preview.tiff", 16))
    assert image.shape == (64, 64) and (image == 9).all()
