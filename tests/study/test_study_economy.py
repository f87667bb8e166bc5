"""What auto effort saves: each scene within its tolerance, at full effort and at what it needs."""

from __future__ import annotations

import pytest

from hilstar.instruments.study import economy
from hilstar.instruments.study.economy import BITS, SCENES, TOLERANCES
from hilstar.tracker.centroiders import FAMILY
from tests.support.recorded import assert_recorded


@pytest.fixture(scope="module")
def economy_study(whole_study):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(economy, "QUICK_ROUNDS", 1)  # no claim here is of a time
        found = whole_study("economy", {"economy"})
    return found.folder, found.findings, found.rows("economy")


def test_the_page_s_errors_are_of_what_is_measured_now(economy_study):
    figures = ("flux_max_mag", "claimed_mag", "claimed_px", *(f"max_px_{kind}" for kind in FAMILY))
    keys = ("scene", "bits", "tolerance")
    assert_recorded(economy_study[0] / "economy.csv", keys, figures)


def test_a_scene_that_needs_less_gets_it_and_stays_within_its_tolerance(economy_study):
    full, *autos = [
        row for row in economy_study[2] if (row["scene"], row["bits"]) == (SCENES[2].name, "12")
    ]
    assert full["tolerance"] == "full" and full["quantisation"] == "exact"
    assert [row["tolerance"] for row in autos] == ["default", "0.1"]
    for row in autos:
        assert (
            row["quantisation"] == "round"
            and int(row["measured_stars"]) == int(full["measured_stars"]) > 100
        )
        places_px = [float(row[f"max_px_{kind}"]) for kind in FAMILY]
        assert float(row["max_px_fit"]) < float(row["max_px_moment"])
        assert max(float(row["centroid_max_px"]), *places_px) <= float(row["tolerance_px"])
        assert (
            float(full["flux_max_mag"]) < float(row["flux_max_mag"]) <= float(row["tolerance_mag"])
        )


def test_what_is_within_by_the_plan_is_within_by_its_stars(economy_study):
    claimed = [row for row in economy_study[2] if row["claimed_within"].lower() == "true"]
    assert len(claimed) > 20
    for row in claimed:
        assert float(row["flux_max_mag"]) <= float(row["tolerance_mag"])
        assert float(row["flux_max_mag"]) <= float(row["claimed_mag"])
        assert float(row["claimed_mag"]) <= float(row["tolerance_mag"])


def test_the_study_has_five_scenes_of_three_depths_at_two_tolerances(economy_study):
    _, lines, rows = economy_study
    assert len(rows) == len(SCENES) * len(BITS) * (1 + len(TOLERANCES)) == 45
    assert len([line for line in lines if " bits, " in line and "instead of" in line]) == 30
