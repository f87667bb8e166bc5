"""An acceptance: each planted fault of the virtual tracker is found by its clause, a healthy one is
not accused, and plans that are wrong are refused.
"""

from __future__ import annotations

import functools
import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from hilstar.basics.errors import InputError
from hilstar.instruments.campaign import acceptance
from hilstar.instruments.campaign.acceptance import Acceptance
from hilstar.instruments.campaign.acceptance_plan import CaseSet, plan_path, read_acceptance_plan
from hilstar.instruments.campaign.acceptance_verdicts import ClauseVerdict, SetResult
from hilstar.instruments.campaign.plan import PlantedFaults
from hilstar.instruments.campaign.requirements import MET, NOT_MET, NOT_SHOWN
from hilstar.instruments.campaign.store import failures
from hilstar.instruments.campaign.sweep import SweepTable
from tests.support.acceptance import accepted, write_bench
from tests.support.benches import ROOT
from tests.support.refusals import refusal
from tests.support.tables import csv_rows

# found within 10 %, or within three standard errors where those are larger
SHARE, SIGMAS = 0.1, 3.0
ONE_SIDED = 1.645  # sigmas from a figure to its one-sided limit at 95 %

FIELD = """
[cases.field.attitudes]
kind = "field"
radec_deg = [84.0, 0.0]
radius_deg = 1.0
roll_deg = [0.0, 0.0]
"""
SLEWS = "".join(
    f'[[cases.slews.vary]]\nkey = "{key}.{axis}"\nminimum = {-size}\nmaximum = {size}\n'
    for key, size in (("rate_deg_s", 0.5), ("acceleration_deg_s2", 0.1))
    for axis in "xyz"
)
VELOCITIES = "".join(
    f'[[cases.aberration.vary]]\nkey = "sky.observer_velocity_km_s.{k}"\n'
    "minimum = -30.0\nmaximum = 30.0\n"
    for k in range(3)
)
SCENARIO = '[[fault]]\nname = "dark"\nkind = "blank"\nat_s = 0.5\nfor_s = 0.5\n'
SETS = {
    "lost": "[cases.lost]\ncases = 60\nframes = 4\n",
    "field": f"[cases.field]\ncases = 60\nframes = 2\n{FIELD}",
    "slews": f"[cases.slews]\ncases = 40\nframes = 3\n{SLEWS}",
    "aberration": f"[cases.aberration]\ncases = 30\n{VELOCITIES}",
    "stars": "[cases.stars]\ncases = 40\n",
    "recovery": (
        "[cases.recovery]\ncases = 15\nframes = 17\nstep_s = 0.1\n[[cases.recovery.vary]]\n"
        'key = "scenario"\nvalues = ["dark.toml"]\n'
    ),
    "rate-limit": (
        "[cases.rate-limit]\ncases = 8\n[cases.rate-limit.sweep]\n"
        'key = "rate_deg_s.across"\nstart = 0.1\nstop = 10.0\nscale = "log"\nrounds = 7\n'
    ),
    "sun": (
        '[cases.sun]\ncases = 8\n[cases.sun.attitudes]\nkind = "body"\nbody = "sun"\n'
        '[cases.sun.sweep]\nkey = "body_deg"\nstart = 90.0\nstop = 0.0\n'
        '[[cases.sun.vary]]\nkey = "sky.epoch_utc"\nvalues = ["2026-03-20T12:00:00"]\n'
        '[[cases.sun.vary]]\nkey = "sky.bodies.sun"\nvalues = [true]\n'
    ),
    "dates": (
        '[cases.dates]\ncases = 40\n[[cases.dates.vary]]\nkey = "sky.epoch_utc"\n'
        'values = ["1906-01-01T00:00:00", "1946-04-01T00:00:00", "2006-07-01T00:00:00",'
        ' "2046-10-01T00:00:00"]\n'
    ),
    "parallax": (
        '[cases.parallax]\ncases = 60\n[[cases.parallax.vary]]\nkey = "sky.epoch_utc"\n'
        'values = ["2026-01-01T00:00:00", "2026-04-01T00:00:00", "2026-07-01T00:00:00",'
        ' "2026-10-01T00:00:00"]\n[[cases.parallax.vary]]\nkey = "spacecraft.orbit"\n'
        'values = ["geocentre"]\n'
    ),
    "earth": (
        '[cases.earth]\ncases = 8\n[cases.earth.attitudes]\nkind = "body"\nbody = "earth"\n'
        '[cases.earth.sweep]\nkey = "limb_deg"\nstart = 45.0\nstop = -30.0\n'
        '[[cases.earth.vary]]\nkey = "sky.epoch_utc"\nvalues = ["2026-03-20T12:00:00"]\n'
        '[[cases.earth.vary]]\nkey = "spacecraft.orbit"\nvalues = ["low-orbit.tle"]\n'
        '[[cases.earth.vary]]\nkey = "sky.bodies.earth"\nvalues = [true]\n'
        '[[cases.earth.vary]]\nkey = "time_s"\nminimum = -1400.0\nmaximum = 1400.0\n'
    ),
    "false-stars": (
        "[cases.false-stars]\ncases = 8\n[cases.false-stars.sweep]\n"
        'key = "tracker.detector.false_stars"\nstart = 1\nstop = 200\nscale = "log"\nwhole = true\n'
    ),
}
STAMPS = "stamp_bias_s = 0.02\nstamp_jitter_s = 0.02"
# quantity (and axis, or the sweep): its cases, what is planted, its size, and the limit's side
FAULTS: dict[str, tuple[str, str, float, str]] = {
    "bias x": ("field", "bias_arcsec = [40.0, 0.0, 300.0]", 40.0, "maximum"),
    "bias roll": ("field", "bias_arcsec = [40.0, 0.0, 300.0]", 300.0, "maximum"),
    "nea cross": ("field", "noise_arcsec = [20.0, 20.0, 100.0]", 20.0, "maximum"),
    "nea roll": ("field", "noise_arcsec = [20.0, 20.0, 100.0]", 100.0, "maximum"),
    "availability": ("lost", "missing = 0.3", 0.7, "minimum"),
    "no-attitude": ("lost", "missing = 0.3", 0.3, "maximum"),
    "false-attitude": ("lost", "wrong = 0.3", 0.3, "maximum"),
    "wrong-rate": ("lost", "wrong = 0.3", 0.3, "maximum"),
    "time-to-first-attitude": ("lost", "acquisition_s = 0.5", 0.7, "maximum"),
    "recovery": ("recovery", "recovery_s = 0.5", 0.55, "maximum"),
    "rate-bias x": ("slews", "rate_bias_deg_s = [0.02, 0.0, 0.1]", 0.02, "maximum"),
    "rate-bias roll": ("slews", "rate_bias_deg_s = [0.02, 0.0, 0.1]", 0.1, "maximum"),
    "rate-noise cross": ("slews", "rate_noise_deg_s = [0.05, 0.05, 0.05]", 0.05, "maximum"),
    "rate-scale cross": ("slews", "rate_scale = 0.05", 0.05, "maximum"),
    "rate-lag cross": ("slews", "rate_lag_s = 0.4", 0.5, "maximum"),
    "time-bias": ("slews", STAMPS, 0.02, "maximum"),
    "time-jitter": ("slews", STAMPS, 0.02, "maximum"),
    "aberration": ("aberration", "aberration = 1.0", 1.0, "maximum"),
    "proper-motion": ("dates", "proper_motion = 1.0", 1.0, "maximum"),
    "catalogue-age": ("dates", "catalogue_age_yr = 100.0", 100.0, "maximum"),
    # a whole parallax is under the noise of so few cases
    "parallax": ("parallax", "parallax = 100.0", 100.0, "maximum"),
    "star-noise": ("stars", "star_noise_px = 0.3", 0.3, "maximum"),
    "star-fov-error": ("stars", "star_fov_px = 0.3", 0.3, "maximum"),
    "star-colour": ("stars", "star_colour = 0.1", 0.1, "maximum"),
    "star-limit": ("stars", "star_limit_v_mag = 5.0", 5.0, "minimum"),
    "false-stars": ("stars", "false_stars = 2.0", 2.0, "maximum"),
    "rate-limit": ("rate-limit", "max_rate_deg_s = 2.0", 2.0, "minimum"),
    "sun edge": ("sun", "exclusion_deg = 30.0", 30.0, "maximum"),
    "earth edge": ("earth", "exclusion_deg = 20.0", 20.0, "maximum"),
    "false-stars edge": ("false-stars", "max_false_stars = 40", 40.0, "minimum"),
}
# A lag of 0.4 s is on top of the half step, 0.1 s, that a rate of two attitudes has; an attitude
# comes at the end of the first exposure (0.1 s) whose middle is over the planted time, of frames
# 0.2 s or 0.1 s apart.


def clause_text(key: str, limit: float, of: str, side: str) -> str:
    quantity, _, axis = key.partition(" ")
    lines = [f'[[clause]]\ncapability = "{key}"\nof = "{of}"\n{side} = {limit}']
    if of == "rate-limit" or axis == "edge":
        lines.append('quantity = "edge"')
    else:
        lines.append(f'quantity = "{quantity}"')
        lines += [f'axis = "{axis}"'] if axis else []
    if quantity == "recovery":
        lines.append("share = 0.8")  # 14 cases show it
    return "\n".join(lines) + "\n"


def plan_of(key: str, factor: float, planted: str = "") -> str:
    """A plan of one clause, whose limit is `factor` times what is planted for it."""
    table = f"[planted]\n{planted}\n" if planted else ""
    return f"{table}{SETS[FAULTS[key][0]]}{clause_by(key, factor)}"


def clause_by(key: str, factor: float) -> str:
    of, _, size, side = FAULTS[key]
    limit = size * factor
    if key == "availability":
        limit = min(limit, 0.95)
    return clause_text(key, limit, of, side)


@pytest.fixture(scope="module")
def planted_verdicts(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Any]:
    """The verdicts on the cases of a set with a planted fault: all clauses that find it judge one
    run.
    """

    @functools.cache
    def verdicts(of: str, planted: str) -> dict[str, ClauseVerdict]:
        folder = tmp_path_factory.mktemp("planted")
        (folder / "dark.toml").write_text(SCENARIO)
        text = f"[planted]\n{planted}\n{SETS[of]}"
        for key, (its_set, its_fault, _, side) in FAULTS.items():
            if (its_set, its_fault) == (of, planted):
                text += clause_by(key, 1.4 if side == "minimum" else 0.6)
        return accepted(folder, text)

    return verdicts


@pytest.mark.parametrize("key", FAULTS)
def test_a_planted_fault_is_found_by_its_clause(
    planted_verdicts: Callable[..., Any], key: str
) -> None:
    of, planted, size, _ = FAULTS[key]
    verdicts = planted_verdicts(of, planted)
    found = verdicts[key if key in verdicts else of]  # an edge is told by its set
    verdict = found.verdict
    assert verdict is not None, found.untested
    assert verdict.value is not None
    ends = [end for end in (verdict.low, verdict.high) if end is not None]
    sigma = (max(ends) - min(ends)) / (len(ends) * ONE_SIDED) if len(ends) == 2 else 0.0
    assert abs(verdict.value - size) <= max(SHARE * size, SIGMAS * sigma)
    if found.clause.quantity == "edge":
        assert verdict.low is not None and verdict.high is not None
        assert verdict.low <= size <= verdict.high
    assert found.word == NOT_MET
    assert verdict.margin is not None and verdict.margin < 0


@pytest.mark.parametrize("of", SETS)
def test_a_healthy_tracker_is_not_accused(tmp_path: Path, of: str) -> None:
    (tmp_path / "dark.toml").write_text(SCENARIO)
    keys = [key for key, fault in FAULTS.items() if fault[0] == of]
    text = SETS[of].replace("cases = 60", "cases = 30")  # nothing has to be shown but its absence
    for key in keys:
        _, _, size, side = FAULTS[key]
        text += clause_text(key, size * (0.6 if side == "minimum" else 1.0), of, side)
    words = {key: found.word for key, found in accepted(tmp_path, text).items()}
    assert set(words.values()) <= {MET, NOT_SHOWN}
    assert MET in words.values()


# ---- the plan ----


def read_plan_text(folder: Path, text: str, through: str | None = None) -> list[CaseSet]:
    path = folder / "plan.toml"
    path.write_text(text)
    bench = write_bench(folder)
    return list(read_acceptance_plan(path, bench, False, through).sets)  # type: ignore[arg-type]


ONE = SETS["lost"] + clause_text("availability", 0.9, "lost", "minimum")
FEW_CASES = SETS["lost"].replace("cases = 60", "cases = 8")  # none in 8 is fewer than half


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (ONE.replace('of = "lost"', 'of = "los"'), "did you mean lost"),
        (ONE + clause_text("availability", 0.9, "los", "minimum"), "[[clause]] number 2 (availability)"),
        (ONE.replace("minimum", "least"), "unknown key least"),
        (ONE.replace("[cases.lost]", '[cases."Lost case"]'), "small letters"),
        (ONE.replace("frames = 4", 'through = "tracker"'), "leave it out"),
        (ONE.replace("frames = 4", "quick_cases = 0"), "quick_cases"),
        (ONE + "share = 0.5\n", "leave share out"),
        (ONE.replace('"availability"', '"edge"'), "has no sweep"),
        (SETS["rate-limit"] + clause_text("nea", 1.0, "rate-limit", "maximum").replace(
            '"edge"', '"nea"'), "quantity is edge"),
        (SETS["rate-limit"].replace("start = 0.1", "start = 10.0")
         + clause_text("rate-limit", 1.0, "rate-limit", "minimum"), "start and stop"),
        (SETS["rate-limit"].replace("start = 0.1", "start = -0.1")
         + clause_text("rate-limit", 1.0, "rate-limit", "minimum"), "above 0"),
        (f"[planted]\nwronk = 0.1\n{ONE}", "did you mean wrong"),
    ],
)  # fmt: skip
def test_a_wrong_plan_is_refused_in_one_line(tmp_path: Path, text: str, told: str) -> None:
    with pytest.raises(InputError) as refused:
        read_plan_text(tmp_path, text)
    line = str(refused.value)
    assert "\n" not in line and "plan.toml" in line and told in line


def test_a_set_for_which_no_clause_asks_is_not_run(tmp_path: Path) -> None:
    text = ONE + SETS["rate-limit"]
    assert [case_set.name for case_set in read_plan_text(tmp_path, text)] == ["lost"]


def test_a_condition_on_no_column_is_refused_before_the_first_case(tmp_path: Path) -> None:
    text = ONE + 'condition = "rate_deg_s.x < 1"\n'
    assert "no key that the plan varies" in refusal(accepted, tmp_path, text)
    assert not (tmp_path / "out").exists()


def test_a_set_has_the_plan_s_seed_unless_it_has_its_own_and_the_columns_that_its_clauses_ask_for(
    tmp_path: Path,
) -> None:
    """A sweep of single stars is found from their columns, and a set keeps those that it names."""
    sets = (
        "seed = 5\n[cases.a]\ncases = 4\n[cases.b]\ncases = 4\nseed = 9\ncolumns = ['time']\n"
        "[cases.c]\ncases = 4\n[cases.c.sweep]\nkey = 'rate_deg_s.x'\nstart = 1\nstop = 2\n"
        "star_v_mag = 4.0\n"
    )
    clauses = [
        clause_text("availability", 0.9, "a", "minimum"),
        clause_text("rate-bias x", 0.9, "b", "maximum"),
        clause_text("c edge", 1.5, "c", "minimum"),
    ]
    plain, own, swept = read_plan_text(tmp_path, sets + "".join(clauses))
    assert [each.tables["seed"] for each in (plain, own, swept)] == [5, 9, 5]
    assert "columns" not in plain.tables
    assert own.tables["columns"] == ["rate", "time"]
    assert swept.tables["columns"] == ["stars"]


@pytest.mark.parametrize(("whole", "value"), [(False, 2.6), (True, 3)])
def test_a_level_is_varied_beside_what_its_set_varies(whole: bool, value: float) -> None:
    sweep = SweepTable(key="rate_deg_s.x", start=1.0, stop=9.0, whole=whole)
    other = {"key": "time_s", "values": [0.0]}
    case_set = CaseSet("name", "", {"cases": 4, "vary": [other]}, sweep)
    told = tomllib.loads(case_set.text(2.6))
    assert told == {"cases": 4, "vary": [other, {"key": "rate_deg_s.x", "values": [value]}]}
    assert tomllib.loads(case_set.text())["vary"] == [other]
    alone = CaseSet("name", "", {"cases": 4}, sweep)
    assert len(tomllib.loads(alone.text(2.6))["vary"]) == 1


def test_what_a_display_cannot_change_is_not_tested_on_a_bench(tmp_path: Path) -> None:
    edge = clause_text("false-stars edge", 10.0, "false-stars", "minimum")
    lost, false_stars = read_plan_text(
        tmp_path, SETS["lost"] + SETS["false-stars"] + edge + ONE[len(SETS["lost"]) :], "bench"
    )
    assert not lost.refused and lost.tables["answers"] == 4 and "frames" not in lost.tables
    assert "tracker.detector.false_stars" in false_stars.refused


def test_the_plan_that_ships_has_a_comment_and_quick_cases_for_every_clause(tmp_path: Path) -> None:
    path = plan_path(Path("ecss.toml"))
    assert path == ROOT / "configs" / "plans" / "ecss.toml"
    whole, quick = (
        read_acceptance_plan(path, write_bench(tmp_path), is_quick, None)
        for is_quick in (False, True)
    )
    for whole_set, quick_set in zip(whole.sets, quick.sets, strict=True):
        assert quick_set.tables["cases"] < whole_set.tables["cases"]
        assert whole_set.about and whole.clauses_of(whole_set.name)
    quantities = {clause.quantity for clause in whole.clauses}
    assert {"rate-bias", "time-bias", "star-noise", "edge", "aberration", "recovery"} <= quantities
    assert whole.untested


def test_every_planted_key_has_a_clause_that_finds_it() -> None:
    planted = " ".join(fault[1] for fault in FAULTS.values())
    missing = [name for name in PlantedFaults.__struct_fields__ if name not in planted]
    assert missing == ["lost_roll"]  # found below


def test_a_lost_roll_is_no_attitude_of_the_sky(tmp_path: Path) -> None:
    text = SETS["lost"] + clause_text("false-attitude", 0.1, "lost", "maximum")
    (found,) = accepted(tmp_path, f"[planted]\nlost_roll = true\n{text}").values()
    assert found.word == NOT_MET and found.verdict is not None
    # any roll is within 1800 arcsec of the true one in 2 x 0.5 of 360 degrees
    assert found.verdict.value == pytest.approx(1 - 1 / 360, abs=0.02)


def test_files_of_a_plan_stand_beside_it_or_ship(tmp_path: Path) -> None:
    earth = SETS["earth"] + clause_text("earth edge", 20.0, "earth", "maximum")
    shipped = ROOT / "configs" / "plans" / "low-orbit.tle"

    def orbit() -> str:
        (earth_set,) = read_plan_text(tmp_path, earth)
        values = {varied["key"]: varied.get("values") for varied in earth_set.tables["vary"]}
        return str(values["spacecraft.orbit"][0])

    assert orbit() == str(shipped)
    own = tmp_path / "low-orbit.tle"
    own.write_text(shipped.read_text())
    assert orbit() == str(own)


def test_an_acceptance_goes_on_where_it_was_and_is_judged_again(tmp_path: Path) -> None:
    text = FEW_CASES + clause_text("availability", 0.9, "lost", "minimum")
    accepted(tmp_path, text)
    table = tmp_path / "out" / "lost" / "cases.parquet"
    made_ns = table.stat().st_mtime_ns
    more = SETS["aberration"] + clause_text("aberration", 0.5, "aberration", "maximum")
    found = accepted(tmp_path, text.replace("minimum = 0.9", "maximum = 0.5") + more)
    assert table.stat().st_mtime_ns == made_ns
    assert found["availability"].word == NOT_MET and found["aberration"].word == MET


def test_an_uncorrected_aberration_is_no_parallax(tmp_path: Path) -> None:
    """It turns with the seasons, too: a thousand times as far as a field's parallax."""
    text = plan_of("parallax", 1.0, "aberration = 1.0")
    found = accepted(tmp_path, text)["parallax"].verdict
    assert found is not None and found.value is not None and found.high is not None
    sigma = (found.high - found.value) / ONE_SIDED
    assert found.value <= SIGMAS * sigma and sigma < 30.0


def test_one_clause_of_many_that_is_barely_not_met_may_be_chance(tmp_path: Path) -> None:
    def judged(limit: float, others: int) -> ClauseVerdict:
        text = f"[planted]\nmissing = 0.3\n{SETS['lost']}"
        text += clause_text("no-attitude", limit, "lost", "maximum")
        for k in range(others):
            text += clause_text("availability", 0.1 + k / 1000, "lost", "minimum")
        return accepted(tmp_path, text)["no-attitude"]

    sure = judged(0.1, 40)
    assert (sure.word, sure.together) == (NOT_MET, NOT_MET)
    assert sure.verdict is not None and sure.verdict.low is not None
    barely = 0.99 * sure.verdict.low
    alone, of_many = judged(barely, 0), judged(barely, 40)
    assert (alone.word, alone.together) == (NOT_MET, NOT_MET)
    assert (of_many.word, of_many.together) == (NOT_MET, NOT_SHOWN)


def test_a_plan_with_other_cases_does_not_go_on(tmp_path: Path) -> None:
    few = ONE.replace(SETS["lost"], FEW_CASES)
    accepted(tmp_path, few)
    with pytest.raises(InputError, match="the plan's cases was 8 and is 9"):
        accepted(tmp_path, few.replace("cases = 8", "cases = 9"))


def test_a_plan_s_time_is_that_of_its_cases_on_their_workers_and_of_what_opens_them(
    tmp_path: Path,
) -> None:
    """A case takes 3 s at a sweep's start, 6 s in its middle and 9 s at its end, and a session 1 s;
    nine levels of 8 cases on 4 workers take 9 (8 x 6 / 4 + 1) s.
    """
    plan = tmp_path / "plan.toml"
    clauses = "".join(
        f'[[clause]]\ncapability = "{of}"\nof = "{of}"\nquantity = "{quantity}"\n{limit}\n'
        for of, quantity, limit in (
            ("field", "availability", "minimum = 0.5"),
            ("rate-limit", "edge", "minimum = 0.2"),
        )
    )
    plan.write_text(SETS["field"] + SETS["rate-limit"] + clauses)
    bench = write_bench(tmp_path)
    checked = read_acceptance_plan(plan, bench, False, None)
    made = Acceptance(checked, bench, tmp_path / "out", "centroids", 10.0)
    at_s = iter([(2.0, 5.0), (3.0, 0.5), (6.0, 1.0), (9.0, 1.5)])
    field, sweep = made.costs(4, lambda campaign: next(at_s))
    assert (field.case_set.name, field.cases) == ("field", 60)
    assert field.seconds == pytest.approx(60 * 2 / 4 + 5, abs=5)
    levels = 2 + 7
    assert (sweep.case_set.name, sweep.cases) == ("rate-limit", levels * 8)
    assert sweep.seconds == pytest.approx(levels * (8 * 6 / 4 + 1), abs=10)
    # of more workers than cases some have nothing to do
    at_s = iter([(2000.0, 500.0), (3e3, 0.0), (3e3, 0.0), (3e3, 0.0)])
    field, sweep = made.costs(100, lambda campaign: next(at_s))
    assert field.seconds == pytest.approx(2500, abs=5)
    assert sweep.seconds == pytest.approx(levels * 3e3, abs=45)
    made.sets = tuple(replace(case_set, refused="no GPU") for case_set in made.sets)
    assert list(made.costs(4)) == []


def test_a_ledger_has_a_row_for_each_case_of_each_set_with_the_level_of_its_sweep(
    tmp_path: Path,
) -> None:
    sweep = SweepTable(key="k", start=1.0, stop=9.0)
    results = [
        SetResult(CaseSet("plain", "", {}, None)),
        SetResult(CaseSet("swept", "", {}, sweep)),
    ]
    expected = []
    plain, swept = results
    folders = ((plain, None), (swept, 2.5), (swept, 7.0))
    for number, (result, level) in enumerate(folders):
        folder = tmp_path / str(number)
        folder.mkdir()
        result.folders.append(folder)
        table: dict[str, list[Any]] = {
            "case": [0, 1],
            "status": ["done", "failed"],
            "why": ["", "x"],
        }
        table |= {"error_x_arcsec": [1.23456789 + number, None], "solved": [3, 0]}
        if level is not None:
            table["vary.k"] = [level, level]
        pq.write_table(pa.table(table), folder / "cases.parquet")
        text = "" if level is None else f"{level}"
        expected += [
            (result.case_set.name, text, "0", "done", "", "3", f"{1.23456789 + number:.9g}"),
            (result.case_set.name, text, "1", "failed", "x", "0", ""),
        ]
    assert acceptance.write_ledger(tmp_path / "ledger.csv", results) == len(expected)
    rows = csv_rows(tmp_path / "ledger.csv")
    names = ("set", "level", "case", "status", "why", "solved", "error_x_arcsec")
    assert [tuple(row[name] for name in names) for row in rows] == expected
    assert {row["ra_deg"] for row in rows} == {""}
    assert failures(tmp_path / "2" / "cases.parquet") == {"x": 1}
