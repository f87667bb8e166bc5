"""`hilstar optics`, as a user types it, and the file that it writes in a bench."""

from __future__ import annotations

import json

import numpy as np
import pytest
from astropy.io import fits

from tests.support.benches import bench_text
from tests.support.commands import assert_refused, run_hilstar_here
from tests.support.glass import SIDE_PX, illumination, stack

POINTING = ("--radec", "84.057,-1.2,0")


@pytest.fixture
def map_files(tmp_path):
    given = stack()
    fits.writeto(tmp_path / "stack.fits", given.images)
    rows = [f"{x},{y},{nm},{illumination(x, y)}" for x, y, nm, _ in given.at]
    (tmp_path / "points.csv").write_text(
        "\n".join(["x_px,y_px,wavelength_nm,relative_illumination", *rows]) + "\n"
    )
    return tmp_path


def mapped_psf(folder, *options):
    return run_hilstar_here(
        f"optics map {folder}/stack.fits {folder}/points.csv -o {folder}/psf.fits", *options
    )


def test_a_map_becomes_the_tracker_s_glass(map_files):
    result = mapped_psf(map_files, "--oversampling", "4", "--json")
    assert result.returncode == 0, result.stderr
    told = json.loads(result.stdout)
    assert (told["points"], told["wavelengths_nm"], told["focuses_um"]) == (
        25,
        [450, 550, 650, 750],
        [0],
    )
    assert told["residual"] <= 1e-3
    tracker = {"resolution_px": [SIDE_PX, SIDE_PX], "focal_length_mm": 12}
    (map_files / "bench.toml").write_text(
        bench_text({"tracker": tracker, "tracker.optics": {"psf": "psf.fits"}})
    )
    result = run_hilstar_here(
        "simulate",
        map_files / "bench.toml",
        *POINTING,
        "-o",
        map_files / "a.fits",
        "--noise",
        "none",
    )
    assert result.returncode == 0, result.stderr
    truth = fits.getdata(map_files / "a.fits", 1)
    assert np.abs(truth["x_centroid_px"] - truth["x_px"]).max() > 0.02
    assert 0.95 > truth["relative_illumination"].min() > 0.8


def test_a_plain_map_says_what_it_made(map_files):
    result = mapped_psf(map_files, "--oversampling", "4", "--tolerance", "0.01")
    assert result.returncode == 0, result.stderr
    assert "25 field points, 4 wavelengths, 1 focus positions:" in result.stdout


@pytest.mark.parametrize(
    ("points", "advice"),
    [
        ("x_px,wavelength_nm\n1,2\n", "column y_px is missing"),
        ("x_px,y_px,wavelength_nm\n1,2,blue\n", "wavelength_nm = 'blue' is not a finite number"),
        ("x_px,y_px\n1,2\n", "write one point for each image"),
    ],
)
def test_a_table_that_does_not_fit_is_one_line(map_files, points, advice):
    (map_files / "points.csv").write_text(points)
    assert_refused(mapped_psf(map_files, "--oversampling", "4"), 2, "points.csv", advice)


def test_a_stack_that_is_none_is_one_line(map_files):
    (map_files / "stack.fits").write_bytes(b"no image")
    assert_refused(mapped_psf(map_files), 2, "stack.fits", "not a FITS image")
    assert not (map_files / "psf.fits").exists()
