"""`hilstar study`: the thesis's outputs, those of a bench, and what it refuses."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS

from hilstar.basics.errors import InputError
from hilstar.cli.study import TIMED, study_lines
from hilstar.instruments.study import rigs
from hilstar.sky.catalog import load_catalog
from tests.support.commands import assert_refused, run_hilstar_here
from tests.support.pictures import assert_drawn
from tests.support.refusals import refusal
from tests.support.studies import module_of
from tests.support.tables import csv_rows

# The thesis's own figures: the hottest star of Orion (figure 5.5), the mean temperature before
# Rosetta (figure 5.16).
HOTTEST_IN_ORION_K, MEAN_OF_ROSETTA_K = 23_559.0, 6931.0
# Stars to V = 7.5 or 9 whose centre is on the image, by Astropy's own projection
# (test_centres_are_astropy_s).
ON_IMAGE = {"orion": 572, "lyra": 127, "rosetta": 77}
BENCH = """[tracker]
aperture_mm = 20
focal_length_mm = 35
pixel_pitch_um = 5.5
resolution_px = [800, 600]
exposure_s = 0.2
quantum_efficiency = "kai-4021"
[sky]
faintest_v_mag = 6.0
[monitor]
resolution_px = [800, 600]
pixel_pitch_um = 20
[collimator]
focal_length_mm = 127
"""
IMAGES = (".fits", "_without_noise.fits")


@pytest.fixture(scope="module")
def published(tmp_path_factory, whole_study):
    folder = tmp_path_factory.mktemp("outputs")
    result = run_hilstar_here("study", "outputs", "-o", folder)
    assert result.returncode == 0, result.stderr
    lines = dict(line.split(": ", 1) for line in result.stdout.splitlines()[:-1])
    return folder, lines


def temperatures_k(folder, stem):
    return np.array([float(row["temperature_k"]) for row in csv_rows(folder / f"{stem}.csv")])


def test_the_thesis_s_outputs_are_drawn_as_published_and_mended(published):
    folder, lines = published
    for name, stars in ON_IMAGE.items():
        for stem in (name, f"{name}_as_published"):
            assert_drawn(folder / f"{stem}.png")
            assert all((folder / f"{stem}{ending}").is_file() for ending in IMAGES)
            assert lines[stem].startswith(f"{stars} stars, ")


def test_the_published_figures_have_the_thesis_s_temperatures(published):
    """Drawn with the mended temperatures, Orion's hottest star had 15 260 K and Rosetta's mean
    was 7288 K.
    """
    folder, lines = published
    assert temperatures_k(folder, "orion_as_published").max() == pytest.approx(
        HOTTEST_IN_ORION_K, abs=1
    )
    assert temperatures_k(folder, "rosetta_as_published").mean() == pytest.approx(
        MEAN_OF_ROSETTA_K, abs=1
    )
    assert "hottest 23559 K" in lines["orion_as_published"]
    assert "mean 6931 K" in lines["rosetta_as_published"]


def test_the_published_temperatures_are_equation_3_13(published):
    """Equation 3.13 written a second time, on the table's own B-V."""
    rows = csv_rows(published[0] / "orion_as_published.csv")
    bv = np.array([float(row["bv"]) for row in rows])
    blue = 1079.20644 * np.exp(-bv / 0.09824) + 8180.59419
    red = 8906.09411 * np.exp(-bv / 1.59761) + 3.633
    expected_k = np.where(bv < 0, blue, red)
    assert temperatures_k(published[0], "orion_as_published") == pytest.approx(expected_k, rel=1e-6)


@pytest.mark.parametrize("name", ON_IMAGE)
def test_centres_are_astropy_s(published, name):
    """How many of the table's stars are on the image, by the header's coordinates and Astropy
    alone.
    """
    with fits.open(published[0] / f"{name}_as_published.fits") as hdus:
        plane, truth, shape = WCS(hdus[0].header), hdus["TRUTH"].data, hdus[0].data.shape
    catalog = load_catalog()
    order = np.argsort(catalog.hip)
    row = order[np.searchsorted(catalog.hip[order], truth["hip"])]
    years = 2000.0 - 1991.25
    dec_deg = catalog.dec_deg[row] + years * catalog.pm_dec_mas_yr[row] / 3.6e6
    ra_deg = catalog.ra_deg[row] + years * catalog.pm_ra_cosdec_mas_yr[row] / 3.6e6 / np.cos(
        np.radians(dec_deg)
    )
    x_px, y_px = plane.all_world2pix(ra_deg, dec_deg, 0)
    on = (x_px >= -0.5) & (x_px < shape[1] - 0.5) & (y_px >= -0.5) & (y_px < shape[0] - 0.5)
    assert int(on.sum()) == ON_IMAGE[name]


def test_rapp_of_a_bench_is_its_sensor_s(tmp_path):
    """The KAI-4021's third ratio at 9000 K is 1.055 behind glass (figure 5.22), and 0.847 is the
    CCD47-20's.
    """
    glass = BENCH.replace('"kai-4021"\n', '"kai-4021"\ntransmission = "n-bk7-10mm"\n')
    (tmp_path / "bench.toml").write_text(glass)
    result = run_hilstar_here(
        "study", "models", tmp_path / "bench.toml", "--radec", "120,-45,10", "-o", tmp_path / "out"
    )
    assert result.returncode == 0, result.stderr
    rows = {
        float(row["temperature_k"]): row for row in csv_rows(tmp_path / "out" / "rapp_bench.csv")
    }
    assert float(rows[9000.0]["rapp3_energy"]) == pytest.approx(1.055, abs=5e-4)
    assert float(rows[50_000.0]["rapp1_energy"]) == pytest.approx(1.02, abs=5e-3)
    assert_drawn(tmp_path / "out" / "rapp_bench.png")
    stars = csv_rows(tmp_path / "out" / "rapp_stars.csv")
    assert {row["field"] for row in stars} == {"orion", "lyra", "zeta_cas", "field"}
    cool = [float(row["rapp3"]) for row in stars if float(row["bv_mag"]) > 1.4]
    # of red stars the average model has too little light, by any sensor
    assert np.median(cool) > 1.1


def test_what_a_study_does_not_use_is_refused(tmp_path):
    (tmp_path / "bench.toml").write_text(BENCH)
    bench, folder = tmp_path / "bench.toml", tmp_path / "out"
    assert_refused(
        run_hilstar_here("study", "bodies", bench, "-o", folder), 2, "has benches of its own"
    )
    assert_refused(
        run_hilstar_here("study", "outputs", "--radec", "1,2,3", "-o", folder),
        2,
        "study outputs BENCH.toml",
    )
    assert_refused(
        run_hilstar_here("study", "bodies", "--radec", "1,2,3", "-o", folder),
        2,
        "leave out --radec",
    )
    assert_refused(
        run_hilstar_here("study", "models", bench, "--radec", "1,99,3", "-o", folder),
        2,
        "declination",
    )
    assert not folder.exists()


def test_an_unwritable_directory_and_an_unknown_study_are_refused(tmp_path):
    (tmp_path / "file").write_text("")
    assert_refused(
        run_hilstar_here("study", "models", "-o", tmp_path / "file" / "x"), 2, "cannot be written"
    )
    assert_refused(run_hilstar_here("study", "weather", "-o", tmp_path), 2, "weather")
    assert_refused(run_hilstar_here("study", "models"), 2, "-o")


# What each study asks first, by whether it is quick.
MEASURES = {
    **dict.fromkeys(sorted(TIMED), ("measure", False, True)),
    "geometry": ("frames_of", False, True),
    "limits": ("every_limit", False, True),
    "rigs": ("place_rows", rigs.ATTITUDES, 4),
}


@pytest.mark.parametrize("quick", [False, True])
@pytest.mark.parametrize("name", MEASURES)
def test_a_study_is_quick_where_it_is_asked_to_be_alone(name, quick, tmp_path, monkeypatch):
    """What it measures by is read as it asks for it: a whole one takes minutes."""
    function, in_whole, if_quick = MEASURES[name]
    asked = []

    def refused(by: bool | int) -> None:
        asked.append(by)
        raise InputError("a test measures nothing")

    monkeypatch.setattr(module_of(name), function, refused)
    assert refusal(study_lines, name, tmp_path, quick) == "a test measures nothing"
    assert asked == [if_quick if quick else in_whole]
