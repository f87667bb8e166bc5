"""What a file's name promises is what is written there."""

from __future__ import annotations

from pathlib import Path

import pytest

from hilstar.endings import CSV, FITS, PNG, PNG_OR_TIFF, check_directory, check_ending
from hilstar.errors import InputError


@pytest.mark.parametrize("name", ["a.fits", "a.FIT", "a.fts", "a.fits.gz", "a", "a.dat", "/dev/null", "run.3"])
def test_a_name_that_says_fits_or_nothing_is_taken(name):
    check_ending("-o", Path(name), FITS)


@pytest.mark.parametrize(
    ("name", "endings", "better"),
    [
        ("d/x.png", FITS, "a FITS file is written there; write x.fits"),
        ("x.csv.gz", FITS, "write x.csv.fits"),
        ("x.jpg", PNG, "a PNG picture is written there; write x.png"),
        ("x.fits", PNG_OR_TIFF, "a PNG or TIFF picture is written there; write x.png"),
        ("x.TOML", CSV, "a CSV table is written there; write x.csv"),
    ],
)
def test_a_name_that_says_another_kind_is_refused(name, endings, better):
    with pytest.raises(InputError) as error:
        check_ending("--codes", Path(name), endings)
    assert str(error.value).startswith(f"--codes {name}: ")
    assert better in str(error.value)


def test_a_file_s_name_is_no_directory_unless_one_is_there(tmp_path):
    with pytest.raises(InputError, match=r"-o .*frames.png: several files are written, into a directory; .* such as frames"):
        check_directory("-o", tmp_path / "frames.png")
    check_directory("-o", None)
    check_directory("-o", tmp_path / "run-0.5")
    (tmp_path / "old.csv").mkdir()
    check_directory("-o", tmp_path / "old.csv")
