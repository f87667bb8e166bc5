"""hilstar verify with a scenario: each fault as the twin's tracker sees it, and no fault a
reason against the bench.
"""

from __future__ import annotations

import numpy as np
import pytest

from hilstar.instruments.verify.summary import summarise, summary_lines, verify
from hilstar.server.bench.bench_file import bench_file_of
from hilstar.server.bench.scenario import parse_scenario
from tests.support.benches import TWIN, bench_text

# A 10-bit monitor with exact codes: the bench's own limits for its stars (verify's defaults are
# 0.05 mag and 0.1 px).
LIMIT_MAG, LIMIT_PX = 0.02, 0.02

SCENARIO = """
[[fault]]
kind = "false-star"
name = "ghost"
at_s = 1
for_s = 2
radec_deg = [211.0, 54.0]
electrons = 5e4
[[fault]]
kind = "star-gone"
name = "dark"
star = "Rigel"
[[fault]]
kind = "glow"
name = "sun"
icrs = [0.0, 0.6, 0.8]
electrons_per_s = 800
scale_deg = 4
[[fault]]
kind = "blank"
name = "cover"
[[fault]]
kind = "attitude-step"
name = "step"
turn_deg = [1, 0, 0]
[[fault]]
kind = "drop"
name = "loss"
"""


@pytest.fixture(scope="module")
def verdicts(tmp_path_factory):
    folder = tmp_path_factory.mktemp("twin")
    # What clips is no measure of a fault: white for the brightest star.
    text = bench_text(
        TWIN, {"monitor": {"resolution_px": [480, 480]}, "render": {"brightest_v_mag": 0.0}}
    )
    file = bench_file_of(folder / "bench.toml", text)
    scenario = parse_scenario(folder / "faults.toml", SCENARIO)
    return [
        verify(file, 1, np.random.default_rng(3), scenario=wanted) for wanted in (None, scenario)
    ]


def test_the_verdict_is_that_of_the_bench_without_faults(verdicts):
    plain, faulty = verdicts
    assert (
        faulty.reasons == plain.reasons and summarise(faulty)["stars"] == summarise(plain)["stars"]
    )
    assert plain.faults == [] and [one.name for one in faulty.faults] == [
        "ghost",
        "dark",
        "sun",
        "cover",
        "step",
        "loss",
    ]


def test_each_fault_is_measured_against_what_was_asked_for(verdicts):
    seen = {one.name: one for one in verdicts[1].faults}
    assert seen["ghost"].asked_e == pytest.approx(5e4, rel=1e-3)
    for name in ("ghost", "dark"):
        assert abs(seen[name].flux_mag) < LIMIT_MAG and seen[name].off_px < LIMIT_PX
    assert seen["dark"].asked_e < 0
    assert abs(seen["sun"].flux_mag) < LIMIT_MAG and seen["sun"].asked_e > 0
    assert seen["cover"].seen_e == 0
    assert seen["step"].off_px < LIMIT_PX * 5  # the finder's own error beside faint neighbours
    assert "run's frames" in seen["loss"].note


def test_the_lines_name_every_fault(verdicts):
    lines = "\n".join(summary_lines(summarise(verdicts[1])))
    for name in ("ghost (false-star)", "dark (star-gone)", "cover (blank)", "loss (drop)"):
        assert f"fault               {name}: " in lines
