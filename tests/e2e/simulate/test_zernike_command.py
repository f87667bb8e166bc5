"""`hilstar optics zernike`, as a user types it."""

from __future__ import annotations

import json
import sys

import pytest

from hilstar.optics.glass.psf_file import read_glass
from tests.support.commands import assert_refused, run_hilstar_here

PUPIL = """
aperture_mm = 30
focal_length_mm = 300
pixel_pitch_um = 5
resolution_px = [100, 80]
wavelengths_nm = [650, 500]
points = 2
half_px = 4
lateral_per_nm = 1e-5
[[terms]]
kind = "W131"
nm = 200
"""


def zernike_psf(folder, text=PUPIL, *options):
    (folder / "lens.toml").write_text(text)
    return run_hilstar_here(
        "optics", "zernike", folder / "lens.toml", "-o", folder / "psf.fits", *options
    )


def test_aberrations_become_the_tracker_s_glass(tmp_path):
    """At F/10 the finest detail of 500 nm is 2.5 um: a seventh of a pixel of 17 um."""
    pytest.importorskip("poppy")
    text = PUPIL.replace("pixel_pitch_um = 5", "pixel_pitch_um = 17")
    result = zernike_psf(tmp_path, text, "--json")
    assert result.returncode == 0, result.stderr
    told = json.loads(result.stdout)
    assert (told["points"], told["wavelengths_nm"]) == (4, [500, 650])
    assert 0 < told["outside_share"] < 0.1
    glass = read_glass(tmp_path / "psf.fits")
    assert glass.history == ("hilstar optics zernike of lens.toml",)
    assert glass.per_px == 7
    assert glass.lateral_px[0, 1, 0, 0] == pytest.approx(100 * 1e-5 * -49.5)
    simple = text.replace("points = 2", "points = 1").replace("[650, 500]", "[650]")
    zernike_psf(tmp_path, simple, "--oversampling", "5")
    assert read_glass(tmp_path / "psf.fits").per_px == 5


@pytest.mark.parametrize(
    ("text", "advice"),
    [
        (PUPIL.replace("points", "pints"), "pints"),
        (PUPIL.replace("W131", "W999"), "W999"),
        (PUPIL.replace("nm = 200", "nm = 200000"), "write smaller coefficients"),
        ("aperture_mm = 30", "focal_length_mm"),
        ("aperture", "not TOML"),
    ],
)
def test_a_file_that_is_none_is_one_line(tmp_path, text, advice):
    pytest.importorskip("poppy")
    assert_refused(zernike_psf(tmp_path, text), 2, "lens.toml", advice)


def test_without_poppy_it_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "poppy", None)
    monkeypatch.setitem(sys.modules, "poppy.matrixDFT", None)
    assert_refused(zernike_psf(tmp_path), 3, "pip install 'hilstar[optics]'")
