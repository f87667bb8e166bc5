"""hilstar study faults: a chart of what each kind costs, and where stray light takes the stars
with it.
"""

from __future__ import annotations

import pytest

from hilstar.instruments.study.faults import CASES, NOWHERE, QUANTISATIONS
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
