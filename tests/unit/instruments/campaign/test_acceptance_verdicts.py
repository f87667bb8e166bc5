"""How an acceptance judges cases that are there: verdicts shared by all clauses, what is not tested
and why, and failures over all levels of a sweep. No case is run.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from hilstar.basics.units import ARCSEC_PER_RAD
from hilstar.instruments.assess.bounded_figures import clopper_pearson
from hilstar.instruments.campaign.acceptance import PLAN_FILE, Acceptance
from hilstar.instruments.campaign.acceptance_plan import read_acceptance_plan
from hilstar.instruments.campaign.acceptance_verdicts import ClauseVerdict, SetResult
from hilstar.instruments.campaign.case_table import Columns
from hilstar.instruments.campaign.requirements import MET, NOT_MET, NOT_SHOWN
from hilstar.instruments.campaign.run import Campaign
from hilstar.instruments.campaign.star_motion import StarMotion
from hilstar.instruments.campaign.store import Directory
from hilstar.server.bench.bench_file import read_bench_file
from hilstar.server.bench.cameras import bench_camera
from tests.support.acceptance import write_bench
from tests.support.certificates import a_certificate
from tests.support.planted_answers import answers

CASES, SILENT = 60, 20  # of which so many have no attitude
BIAS_ARCSEC = 3.0
LOST = "[cases.lost]\ncases = 60\n"


def clause(quantity: str, limit: str, of: str = "lost") -> str:
    return f'[[clause]]\ncapability = "x"\nof = "{of}"\nquantity = "{quantity}"\n{limit}\n'


def acceptance_of(folder: Path, text: str) -> Acceptance:
    bench = write_bench(folder)
    plan = folder / "plan.toml"
    plan.write_text(text)
    checked = read_acceptance_plan(plan, bench, False, None)
    return Acceptance(checked, bench, folder / "out", "centroids", 10.0)


def judged(folder: Path, text: str, cases: Columns) -> list[ClauseVerdict]:
    """The verdicts on the cases of a plan's only set."""
    acceptance = acceptance_of(folder, text)
    (case_set,) = acceptance.sets
    return acceptance.verdicts([SetResult(case_set, cases)])


def lost_cases() -> Columns:
    solved = np.ones(CASES)
    solved[:SILENT] = 0.0
    numbers = {"case": np.arange(float(CASES)), "frames": np.ones(CASES)}
    return Columns(CASES, numbers | {"solved": solved, "wrong": np.zeros(CASES)}, {})


@pytest.mark.parametrize(("others", "together"), [(0, NOT_MET), (2, NOT_MET), (3, NOT_SHOWN)])
def test_a_clause_that_is_not_met_is_judged_again_with_its_part_of_the_doubt(
    tmp_path: Path, others: int, together: str
) -> None:
    """No attitude in 20 of 60 cases: over the limit with a third of 5 % of doubt, not with a
    quarter.
    """
    lows = [clopper_pearson(SILENT, CASES, 1 - 0.05 / part)[0] for part in (3, 4)]
    text = LOST + clause("no-attitude", f"maximum = {sum(lows) / 2!r}")
    # 40 of 60 are surely more than these
    text += "".join(clause("availability", f"minimum = 0.{k + 1}") for k in range(others))
    found, *more = judged(tmp_path, text, lost_cases())
    assert (found.word, found.together) == (NOT_MET, together)
    assert {(each.word, each.together) for each in more} <= {(MET, "")}


def test_a_clause_that_more_cases_would_decide_is_tested_and_one_without_its_column_is_not(
    tmp_path: Path,
) -> None:
    cases = answers(np.random.default_rng(4), 7)  # eight cases tell a stamp
    text = LOST + clause("time-bias", "maximum = 1.0") + clause("recovery", "maximum = 1.0")
    few, none = judged(tmp_path, text, cases)
    assert few.verdict is not None and few.verdict.more == 1
    assert (few.word, few.untested, few.unit) == (NOT_SHOWN, "", "s")
    assert none.verdict is None
    assert (none.word, none.unit) == ("not tested", "s")
    assert none.untested.startswith("recovery_s: the table has no such column")


def test_the_clauses_of_a_set_that_cannot_run_are_not_tested_and_share_no_doubt(
    tmp_path: Path,
) -> None:
    """Of two sets one is refused. The other's clause, which is then the only one that is tested, is
    not met at 5 % of doubt, and would be open at a third of it.
    """
    lows = [clopper_pearson(SILENT, CASES, 1 - 0.05 / part)[0] for part in (1, 3)]
    text = LOST + "[cases.other]\ncases = 60\n"
    text += clause("no-attitude", f"maximum = {sum(lows) / 2!r}")
    text += clause("bias", "maximum = 1.0", "other") + clause(
        "availability", "minimum = 0", "other"
    )
    acceptance = acceptance_of(tmp_path, text)
    lost, other = acceptance.sets
    refused = replace(other, refused="no display here")
    found, *untested = acceptance.verdicts([SetResult(lost, lost_cases()), SetResult(refused)])
    assert (found.word, found.together) == (NOT_MET, NOT_MET)
    assert [(each.word, each.verdict, each.untested, each.unit) for each in untested] == [
        ("not tested", None, "no display here", "arcsec"),
        ("not tested", None, "no display here", ""),
    ]


@pytest.mark.parametrize("through", ["tracker", "display"])
def test_a_share_of_proper_motion_that_the_tracker_lacks_is_found_by_the_fields_own_turns(
    tmp_path: Path, through: str
) -> None:
    """At dates over 40 years a tracker has followed three quarters of the motion of its stars,
    which are those on the display where it looks at one.
    """
    rng = np.random.default_rng(6)
    text = f'through = "{through}"\n' + LOST + clause("proper-motion", "maximum = 0.2")
    acceptance = acceptance_of(tmp_path, text)
    # half as wide as the field of 4.8 degrees
    monitor = {"resolution_px": [44, 44], "pixel_pitch_um": 57.65}
    acceptance.file = read_bench_file(write_bench(tmp_path, monitor=monitor))
    cases = answers(rng)
    jyears = 2016.0 + rng.uniform(-20.0, 20.0, cases.cases)
    cases.numbers["vary.sky.epoch_jyear"] = jyears
    display = None
    if through == "display":
        display = bench_camera(acceptance.file.config, acceptance.file.folder)
    motion = StarMotion.of(acceptance.file, display)
    q = cases.vectors("q{}", "wxyz")
    turns = [motion.likely_turn_rad(attitude, acceptance.scale) for attitude in q]
    missed_arcsec = 0.25 * ARCSEC_PER_RAD * np.array(turns) * (jyears - motion.jyear)[:, None]
    for axis, arcsec in zip("xyz", missed_arcsec.T, strict=True):
        cases.numbers[f"error_{axis}_arcsec"] = BIAS_ARCSEC + arcsec
    (case_set,) = acceptance.sets
    (found,) = acceptance.verdicts([SetResult(case_set, cases)])
    assert found.word == NOT_MET and found.verdict is not None
    assert found.verdict.value == pytest.approx(0.25, rel=1e-3)


def test_a_certified_bench_s_own_errors_narrow_the_limits_of_attitude_and_of_time(
    tmp_path: Path,
) -> None:
    text = LOST + clause("nea", "maximum = 30.0") + clause("time-bias", "maximum = 1.0")
    acceptance = acceptance_of(tmp_path, text)
    (case_set,) = acceptance.sets
    rng = np.random.default_rng(4)
    cases = answers(rng)
    for axis in "xyz":
        cases.numbers[f"scatter_{axis}_arcsec"] = rng.uniform(1.0, 3.0, cases.cases)
    cases.numbers.update(solved=cases.numbers["frames"], wrong=np.zeros(cases.cases))
    for certificate, guards in ((None, (0.0, 0.0)), (a_certificate(), (4.5, 0.00855))):
        acceptance.certificate = certificate
        verdicts = [each.verdict for each in acceptance.verdicts([SetResult(case_set, cases)])]
        assert [each.guard for each in verdicts if each is not None] == pytest.approx(guards)


def test_a_bootstrap_s_draws_are_by_the_plan_s_seed(tmp_path: Path) -> None:
    text = LOST + clause("time-jitter", "maximum = 1.0")
    cases = answers(np.random.default_rng(4), stamp_jitter=0.02)
    ends = []
    for seed in (5, 5, 6):
        (each,) = judged(tmp_path, f"seed = {seed}\n{text}", cases)
        assert each.verdict is not None
        ends.append(each.verdict.high)
    assert ends[0] == ends[1] != ends[2]


def test_verdicts_stand_in_the_order_of_their_clauses_whatever_set_each_is_of(
    tmp_path: Path,
) -> None:
    sets = LOST + "[cases.other]\ncases = 60\n"
    clauses = [("availability", "other"), ("no-attitude", "lost"), ("no-attitude", "other")]
    text = sets + "".join(clause(name, "maximum = 0.5", of) for name, of in clauses)
    acceptance = acceptance_of(tmp_path, text.replace("maximum", "minimum", 1))
    results = [SetResult(each, lost_cases()) for each in acceptance.sets]
    found = [each.clause for each in acceptance.verdicts(results)]
    assert [(each.quantity, each.of) for each in found] == clauses


@pytest.mark.parametrize(
    ("clock", "stamp", "tells"),
    [
        ("unix", "middle", True),
        ("host", "start", True),
        ("own", "middle", False),
        ("unix", "arrival", False),
        ("own", "arrival", False),
        (None, None, False),
    ],
)
def test_stamps_of_an_own_clock_or_of_arrivals_tell_no_time_of_measurement(
    tmp_path: Path, clock: str | None, stamp: str | None, tells: bool
) -> None:
    acceptance = acceptance_of(tmp_path, LOST + clause("time-bias", "maximum = 1.0"))
    tables = {}
    if clock is not None:
        udp = {"source": "udp", "bind": "127.0.0.1:9", "format": "json"}
        tables["answers"] = udp | {"clock": clock, "stamp": stamp}
    acceptance.file = read_bench_file(write_bench(tmp_path, **tables))
    acceptance.on_bench = True
    (case_set,) = acceptance.sets
    cases = answers(np.random.default_rng(4))
    (found,) = acceptance.verdicts([SetResult(case_set, cases)])
    assert (found.word == MET) == tells
    assert ("the stamps are of the tracker's own clock" in found.untested) == (not tells)


@pytest.mark.parametrize("by_stars", [False, True])
def test_failures_of_all_levels_of_a_sweep_count_together_and_each_level_has_its_folder(
    tmp_path: Path, by_stars: bool
) -> None:
    """A tracker that answers up to 2 deg/s, with attitudes or with its stars to V = 5; of each
    level's 16 cases one fails.
    """
    acceptance = acceptance_of(
        tmp_path,
        "[cases.limit]\ncases = 16\n[cases.limit.sweep]\n"
        'key = "rate_deg_s.across"\nstart = 1.0\nstop = 5.0\nrounds = 2\n'
        + "star_v_mag = 5.0\n" * by_stars
        + clause("edge", "minimum = 1.5", "limit"),
    )
    ran = []

    def run_cases(campaign: Campaign, directory: Directory, of: str) -> None:
        level = float(of.rpartition(" ")[2])
        assert [each.values for each in campaign.plan.vary] == [[level]]
        ran.append(of)
        is_seen = level <= 2.0
        table: dict[str, list[Any]] = {
            "case": list(range(16)),
            "status": ["failed", *["done"] * 15],
            "why": ["lens cap", *[""] * 15],
            "frames": [1] * 16,
            "solved": [int(is_seen and not by_stars)] * 16,
            "wrong": [0] * 16,
            "star_frames": [1] * 16,
            "star_v_mag": [[4.0, 6.0]] * 16,
            "star_dx_px": [[0.0 if is_seen else np.nan, np.nan]] * 16,
        }
        pq.write_table(pa.table(table), directory.table)

    (tmp_path / "out").mkdir()
    (result,) = acceptance.run(run_cases)
    levels = [count.level for count in result.levels]
    assert levels == [1.0, 5.0, 3.0, 2.0]
    assert ran == [f"limit at {level:.4g}" for level in levels]
    assert result.failed == {"lens cap": 4}
    names = [folder.name for folder in result.folders]
    assert names == ["level-00", "level-01", "level-02", "level-03"]
    assert (tmp_path / "out" / PLAN_FILE).read_text() == acceptance.plan.text
    # and again: nothing is run, and the same is read
    (again,) = acceptance.run(run_cases)
    assert len(ran) == 4
    assert (again.levels, again.failed) == (result.levels, result.failed)
    (verdict,) = acceptance.verdicts([result])
    assert verdict.verdict is not None
    assert (verdict.verdict.value, verdict.verdict.low) == (2.5, 2.0)
    assert (verdict.word, verdict.unit) == (MET, "")
