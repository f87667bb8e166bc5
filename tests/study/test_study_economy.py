"""What auto effort saves: each scene within its tolerance, at full effort and at what it needs."""

from __future__ import annotations

import csv

import pytest

from hilstar.study import economy
from hilstar.study.economy import SCENES, run
from hilstar.tracker.centroiders import FAMILY


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    folder = tmp_path_factory.mktemp("economy")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(economy, "QUICK_ROUNDS", 1)  # no claim here is of a time
        lines, _ = run(folder, quick=True)
    with (folder / "economy.csv").open() as file:
        return folder, lines, list(csv.DictReader(file))


def test_a_scene_that_needs_less_gets_it_and_stays_within_its_tolerance(study):
    full, auto = [row for row in study[2] if row["scene"] == SCENES[2].name]
    assert (full["effort"], auto["effort"]) == ("full", "auto")
    assert auto["quantisation"] == "round" and full["quantisation"] == "exact"
    for row in (full, auto):
        places_px = [float(row[f"max_px_{kind}"]) for kind in FAMILY]
        assert max(float(row["flux_max_mag"]), float(row["centroid_max_px"]), *places_px) <= float(row["tolerance"])
        assert len(set(places_px)) == 6 and float(row["max_px_fit"]) < float(row["max_px_moment"])
    assert int(auto["measured_stars"]) == int(full["measured_stars"]) > 100
    assert float(full["flux_max_mag"]) < float(auto["flux_max_mag"])


def test_the_study_has_five_scenes_each_within_its_tolerance(study):
    folder, lines, rows = study
    assert len(lines) == len(SCENES) == 5
    assert all("within" in line for line in lines)
    assert (folder / "economy.png").stat().st_size > 20_000
    assert len(rows) == 10
