"""`hilstar study`: the figures are there and say what the data say."""

from __future__ import annotations

import csv

import numpy as np
import pytest
from PIL import Image

from hilstar.sky.pickles import load_library
from hilstar.study.models.choices import choices
from hilstar.study.models.rapp import rapp_ratios
from hilstar.study.models.spectra import spectra
from hilstar.study.models.temperatures import torres2010_k
from hilstar.study.models.zero_points import zero_points
from hilstar.study.shared.brightness import held_out_errors, study_optics
from hilstar.study.stability import run as stability
from tests.support.commands import assert_refused, run_hilstar, run_hilstar_here


def table(path):
    with path.open() as file:
        return list(csv.DictReader(file))


def assert_drawn(path):
    """A picture with more than a frame in it."""
    pixels = np.array(Image.open(path).convert("L"))
    assert pixels.shape[0] > 300
    assert ((pixels < 200).mean() > 0.005) and ((pixels > 250).mean() > 0.1)


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    folder = tmp_path_factory.mktemp("models")
    result = run_hilstar("study", "models", "-o", folder)
    assert result.returncode == 0, result.stderr
    return folder, result.stdout


def test_every_figure_has_its_table_and_its_finding(models):
    folder, printed = models
    stems = [row["figure"] for row in table(folder / "findings.csv")]
    assert stems == ["rapp_ccd47-20", "rapp_kai-4021", "temperature_scales", "zero_points", "choices", "spectra"]
    for stem in stems:
        assert_drawn(folder / f"{stem}.png")
        assert len(table(folder / f"{stem}.csv")) >= 8
        assert stem in printed


def test_rapp_is_one_where_both_models_are_the_same(models):
    """RAPP1 at the reference's own temperature; and the thesis's '15 % up to 5 %' of hot stars on the CCD47-20."""
    ratios = rapp_ratios(np.array([9602.0]), study_optics("ccd47-20"), "energy")
    assert ratios[0, 0] == pytest.approx(1.0, rel=1e-9)
    rows = table(models[0] / "rapp_ccd47-20.csv")
    kelvin, rapp3 = (np.array([float(row[key]) for row in rows]) for key in ("temperature_k", "rapp3_photon"))
    assert kelvin[0] == pytest.approx(3000) and kelvin[-1] == pytest.approx(50_000)
    assert np.interp(9000, kelvin, rapp3) == pytest.approx(0.85, abs=0.01)
    assert np.interp(50_000, kelvin, rapp3) == pytest.approx(0.97, abs=0.02)
    assert rapp3[0] > 1.7


def test_torres_gives_the_sun_its_temperature():
    """B-V = 0.653 (Ramirez 2012): 5772 K (IAU 2015), within the relation's own 2 %."""
    assert torres2010_k(np.array([0.653]))[0] == pytest.approx(5772, rel=0.02)


def test_the_zero_points_differ_by_a_third_of_a_magnitude(tmp_path):
    zero_points(tmp_path)
    rows = table(tmp_path / "zero_points.csv")
    cost = [float(r["mag_against_default"]) for r in rows if (r["zero_point"], r["weighting"]) == ("iau-bolometric", "energy")]
    assert cost == pytest.approx([0.31, 0.31], abs=0.01)


def test_real_spectra_beat_black_bodies_in_the_chart_as_in_the_table(tmp_path):
    finding = spectra(tmp_path)
    rows = table(tmp_path / "spectra.csv")
    library = load_library()
    assert [row["spectral_type"] for row in rows] == list(library.spectral_type)
    blue = np.array([float(row["vi_mag"]) < 2.5 for row in rows])
    median = {}
    for name in ("pickles, leave-one-out", "black body, ballesteros2012"):
        errors = np.abs([float(row[f"ccd47-20: {name} [%]"]) for row in rows])[blue]
        median[name] = np.median(errors)
        assert f"{np.median(errors):.1f} %" in finding.text
    assert median["pickles, leave-one-out"] < 1.0 < 3 * median["pickles, leave-one-out"] < median["black body, ballesteros2012"]


def test_a_held_out_star_is_not_in_its_own_table():
    """A star made ten times brighter moves no other star's error by more than its share, and its own by all of it."""
    library = load_library()
    rates = np.exp(library.vi_mag)
    plain = held_out_errors(rates)
    changed = rates.copy()
    changed[40] *= 10
    assert held_out_errors(changed)[40] == pytest.approx((plain[40] + 1) / 10 - 1, rel=1e-9)


def test_what_choices_cost_is_what_the_models_say(tmp_path):
    choices(tmp_path)
    rows = table(tmp_path / "choices.csv")
    zero = [float(r["zero_point_iau-bolometric_mag"]) for r in rows]
    assert min(zero) == pytest.approx(0.31, abs=0.01)
    assert max(zero) == pytest.approx(0.31, abs=0.01)


def test_the_thesis_s_outputs_are_drawn(tmp_path):
    result = run_hilstar_here("study", "outputs", "-o", tmp_path)
    assert result.returncode == 0, result.stderr
    for name, least in (("orion", 500), ("lyra", 100), ("rosetta", 50)):
        assert_drawn(tmp_path / f"{name}.png")
        assert (tmp_path / f"{name}.fits").is_file()
        assert len(table(tmp_path / f"{name}.csv")) > least


def test_the_stability_table_has_every_place_and_its_charts(tmp_path):
    result = run_hilstar_here("study", "stability", "-o", tmp_path, "--json")
    assert result.returncode == 0, result.stderr
    assert '"right":true' in result.stdout
    rows = table(tmp_path / "stability.csv")
    assert len(rows) == len(stability.CASES)
    for row in rows:
        assert row["verdict"] == "right" and row["failing method"] and row["its failure"] and row["why"]
        assert float(row["error"]) <= float(row["tolerance"])
        assert not float(row["its error"]) <= float(row["tolerance"])
    for stem in ("narrow_stars", "weak_perspective", "popping", "turns"):
        assert_drawn(tmp_path / f"{stem}.png")
        assert len(table(tmp_path / f"{stem}.csv")) > 25


def test_an_unwritable_directory_and_an_unknown_study_are_refused(tmp_path):
    (tmp_path / "file").write_text("")
    assert_refused(run_hilstar_here("study", "models", "-o", tmp_path / "file" / "x"), 2, "cannot be written")
    assert_refused(run_hilstar_here("study", "weather", "-o", tmp_path), 2, "weather")
    assert_refused(run_hilstar_here("study", "models"), 2, "-o")
