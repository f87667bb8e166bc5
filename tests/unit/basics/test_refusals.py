"""Files, values and user code that the basics refuse, and the words of the one line."""

from __future__ import annotations

import io
import os
import sys
from pathlib import Path

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from PIL import Image

from hilstar.basics import image_files
from hilstar.basics.attitudes import angle_deg_of, quaternion_of, t_ns_of
from hilstar.basics.files import NewFile, lock_alone, stdout_bytes
from hilstar.basics.fits_headers import read_fits_image
from hilstar.basics.image_files import ImageSizeError, npy_array, opened_picture
from hilstar.basics.process.user_code import UserCodeError, user_function
from hilstar.basics.reading import as_text, open_lines, read_bytes
from tests.support.refusals import assert_file_refused, refusal, says

ADVICE, LIMIT = "give another", 1000


def test_stdout_that_is_closed_takes_no_bytes(monkeypatch):
    assert stdout_bytes() is sys.__stdout__.buffer
    monkeypatch.setattr(sys, "__stdout__", None)
    assert says(refusal(stdout_bytes), "stdout: ...it is closed...; write the name of a file")


def test_a_ledger_is_a_file_of_its_own(tmp_path):
    (tmp_path / "folder").mkdir()
    line = refusal(NewFile, tmp_path / "folder", overwrite=True)
    assert says(line, "it is no file...; choose another place for the ledger")
    file = NewFile(tmp_path / "new")
    os.write(file.fd, b"kept")
    assert says(refusal(NewFile, tmp_path / "new"), "...new")
    file.close()
    assert (tmp_path / "new").read_bytes() == b"kept"


def test_a_lock_is_no_link(tmp_path):
    (tmp_path / "link").symlink_to(tmp_path / "target")
    assert says(refusal(lock_alone, tmp_path / "link", "held"), f"{tmp_path / 'link'}: ")
    assert not (tmp_path / "target").exists()


def lines_of(path: Path) -> list[str]:
    with open_lines(path, ADVICE, LIMIT) as lines:
        return list(lines)


WIDE = "a text".encode("utf-16")
NO_UTF8 = b"a text\nand \xff\xfe\n"


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (WIDE, "it is text in UTF-16, not UTF-8...; give another"),
        (NO_UTF8, ""),
        (b"\x89PNG\r\n\x1a\n", "it is a PNG"),
    ],
)
def test_what_is_no_text_is_refused(tmp_path, content, words):
    assert as_text(tmp_path / "a", "é\n".encode("utf-8-sig"), ADVICE) == "é\n"
    assert says(refusal(as_text, tmp_path / "a", content, ADVICE), words)


def test_a_file_that_cannot_be_read_is_refused_by_each_way_of_reading(tmp_path):
    (tmp_path / "large").write_bytes(b"x" * (LIMIT + 1))
    (tmp_path / "whole").write_bytes(b"x" * LIMIT)
    assert read_bytes(tmp_path / "whole", ADVICE, LIMIT) == b"x" * LIMIT
    assert lines_of(tmp_path / "whole") == ["x" * LIMIT]
    ways = (lambda path: read_bytes(path, ADVICE, LIMIT), lines_of)
    for read in ways:
        for name in ("large", "none", "."):
            assert_file_refused(read, tmp_path / name, ": ...; give another")


def png(size: tuple[int, int]) -> bytes:
    file = io.BytesIO()
    Image.new("L", size).save(file, "PNG")
    return file.getvalue()


def picture_px(content: bytes, wanted_px: tuple[int, int] | None = None) -> tuple[int, int]:
    with opened_picture(content, wanted_px) as picture:
        return picture.size


def test_a_picture_has_the_size_that_is_wanted_and_no_more_pixels_than_are_decoded(monkeypatch):
    assert picture_px(png((6, 4)), (6, 4)) == (6, 4)
    with pytest.raises(ImageSizeError, match=r"is 6 x 4 px, and .*resolution_px is 4 x 6 px"):
        picture_px(png((6, 4)), (4, 6))
    monkeypatch.setattr(image_files, "MAX_PIXELS", 24)
    assert picture_px(png((6, 4))) == (6, 4)
    with pytest.raises(ImageSizeError, match="is 5 x 5 px, and at most 24 pixels are decoded"):
        picture_px(png((5, 5)))
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 10)
    with pytest.raises(ImageSizeError, match="has more pixels than any image that is decoded"):
        picture_px(png((6, 4)), (6, 4))


def npy(values: np.ndarray, version: tuple[int, int] | None = None) -> bytes:
    file = io.BytesIO()
    np.lib.format.write_array(file, values, version)
    return file.getvalue()


def test_an_npy_file_holds_what_its_header_promises():
    values = np.arange(6.0).reshape(2, 3)
    for version in ((1, 0), (2, 0)):
        assert (npy_array(npy(values, version)) == values).all()
    content = npy(values)
    with pytest.raises(ValueError, match="version"):
        npy_array(content[:6] + bytes((9, 0)) + content[8:])
    with pytest.raises(ValueError, match=r"\(9000, 3\) values of float64 in"):
        npy_array(content.replace(b"(2, 3), }   ", b"(9000, 3), }"))
    with pytest.raises(ValueError, match="allow_pickle"):
        npy_array(npy(np.array([{}], dtype=object)))


def test_a_fits_file_without_an_image_has_none():
    file = io.BytesIO()
    fits.PrimaryHDU().writeto(file)
    assert refusal(read_fits_image, file.getvalue()) == "has no image; give a FITS file of one"


VALUES = [
    (t_ns_of, 1.5, "t_ns 1.5: write whole nanoseconds"),
    (t_ns_of, True, "t_ns True: write whole nanoseconds"),
    (t_ns_of, "1", "t_ns '1': write whole nanoseconds"),
    (angle_deg_of, [1.0, 2.0], "[1.0, 2.0]: "),
    (angle_deg_of, float("nan"), "nan: "),
    (angle_deg_of, "north", "'north': "),
    (quaternion_of, "Orion", "'Orion': "),
    (quaternion_of, SkyCoord([1, 2], [3, 4], unit="deg"), "SkyCoord: holds 2 places; give one"),
    (
        quaternion_of,
        SkyCoord(1, 2, unit="deg", frame="altaz"),
        "SkyCoord in altaz: has no place in ICRS",
    ),
]


@pytest.mark.parametrize(("read", "value", "words"), VALUES, ids=[words for *_, words in VALUES])
def test_what_is_no_attitude_no_angle_and_no_time_is_refused(read, value, words):
    name = () if read is quaternion_of else ("roll_deg" if read is angle_deg_of else "t_ns",)
    assert says(refusal(read, value, *name), words)


def test_user_code_is_a_function_of_a_module_beside_the_file(tmp_path):
    (tmp_path / "hooks_of_a_test.py").write_text("LIMIT = 3\n\ndef twice(x):\n    return 2 * x\n")
    assert user_function("python:hooks_of_a_test:twice", tmp_path, ())(4) == 8
    for name, words in (
        ("python:hooks_of_a_test:thrice", "hooks_of_a_test has no function thrice"),
        ("python:hooks_of_a_test:LIMIT", "hooks_of_a_test has no function LIMIT"),
        ("python:hooks_of_a_test", "names no function"),
        ("python::twice", "names no function"),
        ("python:no_hooks:twice", "no module no_hooks stands in"),
    ):
        with pytest.raises(UserCodeError, match=words):
            user_function(name, tmp_path, ())
