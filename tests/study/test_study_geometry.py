"""What the study of geometric calibration says of a lens of another family than its models."""

from __future__ import annotations

import pytest

from hilstar.instruments.study.geometry import MODELS, ideal_arcsec
from tests.support.claims import holds


@pytest.fixture(scope="module")
def study(whole_study):
    found = whole_study("geometry", {"geometry"})
    return found.findings, found.rows("geometry")


def test_each_model_is_charted_against_dots_and_noise(study):
    _, rows = study
    assert {row["model"] for row in rows} == {model.name for model in MODELS}
    assert len({row["centroids"] for row in rows}) >= 2
    assert len({row["noise_px"] for row in rows}) >= 2


def test_simple_lenses_fail_and_are_marked_and_the_full_model_does_not(study):
    lines, rows = study
    usual = {
        row["model"]: float(row["stars_rms_arcsec"])
        for row in rows
        if row["noise_px"] == "0.02" and row["frames"] == "20"
    }
    assert ideal_arcsec() > usual["a pinhole"]
    holds("doublet-pinhole", usual["a pinhole"])
    holds("doublet-fitted", usual["the same with a field of degree 4"])
    assert sum("FAILS" in line for line in lines) >= 2


def test_held_out_dots_rank_the_models_as_the_stars_do(study):
    _, rows = study
    usual = [row for row in rows if row["noise_px"] == "0.02" and row["frames"] == "20"]
    by_dots = sorted(usual, key=lambda row: float(row["held_out_arcsec"]))
    by_stars = sorted(usual, key=lambda row: float(row["stars_rms_arcsec"]))
    assert [row["model"] for row in by_dots] == [row["model"] for row in by_stars]


def test_errors_grow_with_noise(study):
    _, rows = study
    same = [
        row for row in rows if row["frames"] == "20" and row["model"] == "Brown-Conrady with tilt"
    ]
    small, large = sorted(same, key=lambda row: float(row["noise_px"]))
    assert float(large["stars_rms_arcsec"]) > float(small["stars_rms_arcsec"])
