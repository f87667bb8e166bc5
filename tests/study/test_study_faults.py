"""hilstar study faults: a chart of what each kind costs, and where stray light takes the stars
with it.
"""

from __future__ import annotations

import numpy as np
import pytest

from hilstar.basics.rotation import angle_between_rad
from hilstar.instruments.study import faults
from hilstar.instruments.study.faults import CASES, NOWHERE, QUANTISATIONS, Stray
from hilstar.optics.layers.fault_kinds import KINDS

pytestmark = pytest.mark.study


@pytest.fixture(scope="module")
def faults_study(whole_study):
    return whole_study("faults", {"faults", "faults_cost"})


def test_every_kind_but_a_dropped_frame_has_its_cost(faults_study):
    kinds = {table["kind"] for tables in CASES.values() for table in tables}
    assert kinds == set(KINDS) - {"drop"}  # which draws nothing
    costs = faults_study.rows("faults-cost")
    assert [(row["quantisation"], row["case"]) for row in costs] == [
        (q, case) for q in QUANTISATIONS for case in CASES
    ]
    assert all(float(row["without_ms"]) > 0 for row in costs)
    assert NOWHERE in CASES and len(faults_study.findings) == 4


def test_stray_light_of_white_leaves_no_star_and_none_leaves_all(faults_study):
    strays = faults_study.rows("faults-stray")
    for quantisation in QUANTISATIONS:
        mine = {
            float(row["share_of_white"]): row
            for row in strays
            if row["quantisation"] == quantisation
        }
        assert float(mine[1.0]["lost"]) == 1.0
        assert float(mine[0.0]["lost"]) < 0.05
        assert int(mine[0.0]["stars"]) > 20


def test_the_cost_of_a_fault_is_its_frame_less_the_same_frame_without_it(
    bench_with, tmp_path, monkeypatch
):
    monkeypatch.setattr(faults, "medians_ms", lambda works, rounds: {"with": 7.0, "without": 5.0})
    cost = faults.cost_of(bench_with(), tmp_path, "blank", 1)
    assert (cost.case, cost.frame_ms, cost.without_ms, cost.cost_ms) == ("blank", 7.0, 5.0, 2.0)


def test_stray_light_spoils_from_the_least_share_beyond_which_stars_are_off():
    off_mag = {0.0: 0.5, 0.01: 0.05, 0.03: 0.2, 0.1: 0.4}
    strays = [Stray("round", share, 30, 0.0, mag, 0.0) for share, mag in off_mag.items()]
    strays.append(Stray("exact", 0.01, 30, 0.0, 0.1, 0.0))
    assert faults.spoilt_from(strays, "round") == 0.03
    assert faults.spoilt_from(strays, "exact") is None


SMALL = "[sky]\nfaintest_v_mag = 6.0\n"


def test_even_light_of_white_leaves_no_star_and_none_leaves_all_of_a_small_bench(bench_with):
    bench = bench_with(SMALL)
    clear = faults.stray_light(bench, 0.0)
    assert (clear.quantisation, clear.share_of_white) == (bench.config.render.quantisation, 0.0)
    assert clear.stars > 3 and clear.lost < 0.5
    white = faults.stray_light(bench, 1.0)
    assert (white.stars, white.lost) == (clear.stars, 1.0)
    some = faults.stray_light(bench, 0.2)
    assert clear.median_mag <= some.median_mag < white.median_mag
    assert clear.p95_mag <= some.p95_mag


@pytest.mark.parametrize("case", ["blank", "frozen", "star gone", "gradient", "wrong attitude"])
def test_a_case_s_frames_differ_from_those_without_it_as_its_fault_says(bench_with, tmp_path, case):
    frames = faults.CaseFrames(bench_with(SMALL), tmp_path, case)
    plain = frames.without(3).copy()
    assert plain.any()
    shown = frames.with_faults(3).copy()
    if case == "frozen":
        # the frame that was drawn last stays
        np.testing.assert_array_equal(shown, plain)
    elif case == "blank":
        assert not shown.any()
    elif case == "gradient":
        assert (shown > 0).mean() > (plain > 0).mean()
    else:
        assert (shown != plain).any()


def test_the_slew_turns_from_frame_to_frame_by_its_rate():
    turned_rad = angle_between_rad(faults.attitude_of(0), faults.attitude_of(30))
    rate = np.linalg.norm(faults.SLEW_RAD_S)
    assert turned_rad == pytest.approx(rate * 30 / faults.REFRESH_HZ)
