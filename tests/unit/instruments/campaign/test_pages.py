"""What a user reads of requirements and of an acceptance: pages, drawings, tables and lines of
verdicts whose figures all differ.
"""

from __future__ import annotations

import json
import math
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from matplotlib.figure import Figure
from msgspec import structs
from scipy.stats import beta, binom

from hilstar.basics.arrays import FloatArray
from hilstar.basics.pages import BAD, DASH, OK, WARN, Verdict
from hilstar.instruments.assess.figure_rows import FigureRow
from hilstar.instruments.campaign import acceptance_page, requirements_page
from hilstar.instruments.campaign.acceptance_plan import (
    AcceptancePlan,
    CaseSet,
    ClauseTable,
    UntestedTable,
)
from hilstar.instruments.campaign.acceptance_verdicts import (
    LEDGER,
    AcceptedBench,
    ClauseVerdict,
    SetResult,
)
from hilstar.instruments.campaign.case_table import Columns, read_cases
from hilstar.instruments.campaign.page import MeasureCosts, verdict_of, write_campaign_page
from hilstar.instruments.campaign.plan import parse_plan
from hilstar.instruments.campaign.requirements import (
    MET,
    NOT_MET,
    NOT_SHOWN,
    RequirementVerdict,
    verdicts_of,
)
from hilstar.instruments.campaign.sweep import NOT_EVEN, STILL, LevelCount, SweepTable
from hilstar.server.bench.bench_file import read_bench_file
from tests.support.acceptance import write_bench
from tests.support.campaigns import write_campaign
from tests.support.card_texts import BAND, CELL, card_lines, drawn_figures
from tests.support.certificates import a_certificate
from tests.support.tables import csv_rows

CASES = 48
RATES = {"key": "rate_deg_s.across", "minimum": 0.01, "maximum": 2.0}
REQUIRE = """
[[require]]
quantity = "wrong-rate"
maximum = 0.5
[[require]]
quantity = "nea"
maximum = 30.0
confidence = 0.9
condition = "rate_deg_s.across <= 1.0"
[[require]]
quantity = "availability"
minimum = 0.999
"""


def write_cases(path: Path) -> dict[str, FloatArray]:
    """Cases whose error grows with their rate, 10 arcsec about a bias, of ten frames each; one of
    them is wild, and one has no attitude.
    """
    rng = np.random.default_rng(2)
    rate = np.linspace(0.02, 2.0, CASES)
    table: dict[str, Any] = {"case": np.arange(CASES), "vary.rate_deg_s.across": rate}
    for k, axis in enumerate("xyz"):
        error = 50.0 * (k + 1) + 10.0 * rate * rng.standard_normal(CASES)
        error[5] = 5e4
        error[7] = np.nan
        table[f"error_{axis}_arcsec"] = error
        table[f"scatter_{axis}_arcsec"] = np.where(np.isnan(error), np.nan, 2.0 + k)
    table["frames"] = np.full(CASES, 10.0)
    table["solved"] = np.where(np.arange(CASES) == 7, 0.0, 10.0)
    table["wrong"] = np.zeros(CASES)
    pq.write_table(pa.table(table), path)
    return table


@pytest.fixture(scope="module")
def required(
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[Path, list[RequirementVerdict], list[Figure], dict[str, FloatArray]]:
    folder = tmp_path_factory.mktemp("requirements")
    path = write_campaign(folder, RATES)
    plan = parse_plan(path, path.read_text() + REQUIRE)
    table = folder / "cases.parquet"
    cases = write_cases(table)
    with drawn_figures() as drawn, pytest.MonkeyPatch.context() as patch:
        patch.setattr(requirements_page, "png", lambda figure: b"")
        file = read_bench_file(folder / "bench.toml")
        verdicts = requirements_page.write_requirements(plan, path, table, file)
    return folder, verdicts, drawn, cases


def test_requirements_are_judged_by_their_cases_in_table_and_page(required) -> None:
    """Of 47 cases none was wrong, and of 480 frames 470 have an attitude."""
    folder, verdicts, _, _ = required
    assert [each.verdict for each in verdicts] == [MET, verdicts[1].verdict, NOT_MET]
    rows = csv_rows(folder / "requirements.csv")
    assert [row["quantity"] for row in rows] == ["wrong-rate", "nea", "availability"]
    assert [row["axis"] for row in rows] == ["", "cross", ""]
    assert [row["confidence"] for row in rows] == ["0.95", "0.9", "0.95"]
    assert rows[1]["condition"] == "rate_deg_s.across <= 1.0"
    for row, each in zip(rows, verdicts, strict=True):
        assert float(row["bound"]) == each.bound
        assert (row["verdict"], int(row["cases"])) == (each.verdict, each.cases)
    cards = card_lines((folder / "requirements.html").read_text())
    assert cards[BAND][:2] == ["Requirements of plan.toml", "A requirement is not met"]
    states = [each.verdict for each in verdicts]
    assert f"{states.count(MET)} met" in cards[BAND][2]
    lines = [line.split(" | ") for line in cards["Verdicts"][1:4]]
    assert [line[0] for line in lines] == [each.require.words for each in verdicts]
    assert [line[1] for line in lines] == states
    assert lines[2][2] == f"{470 / 480:.4g}"
    assert [line[4] for line in lines] == ["95 %", "90 %", "95 %"]
    about = dict(line.split(" | ", 1) for line in cards["Campaign"])
    digest = sha256((folder / "cases.parquet").read_bytes()).hexdigest()
    assert about["cases"] == f"{CASES} through tracker, in cases.parquet, sha256 {digest}"
    assert about["bench"].endswith(read_bench_file(folder / "bench.toml").sha256)
    assert cards["Signed"] == ["NameRoleDateSignature"]


@pytest.mark.parametrize("through", ["bench", "tracker"])
def test_a_certified_bench_s_own_errors_are_taken_off_a_campaign_s_requirements(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, through: str
) -> None:
    """Of attitude and time, where the bench itself was before the tracker."""
    path = write_campaign(tmp_path, RATES, through=through)
    plan = parse_plan(path, path.read_text() + REQUIRE)
    write_cases(tmp_path / "cases.parquet")
    told = []

    def judged(*given: Any) -> list[RequirementVerdict]:
        told.append(given[4:])
        return verdicts_of(*given)

    monkeypatch.setattr(requirements_page, "png", lambda figure: b"")
    monkeypatch.setattr(requirements_page, "verdicts_of", judged)
    monkeypatch.setattr(requirements_page, "bench_certificate", lambda file: a_certificate())
    file = read_bench_file(tmp_path / "bench.toml")
    requirements_page.write_requirements(plan, path, tmp_path / "cases.parquet", file)
    (own,) = told
    assert own == (((4.5, 10.0), pytest.approx(0.00855)) if through == "bench" else (None, 0.0))


def test_the_chart_has_each_case_s_error_an_axis_about_the_median_at_its_rate(required) -> None:
    _, verdicts, (figure,), cases = required
    (axes,) = figure.axes
    dots, bins, limit = axes.get_lines()
    known = np.isfinite(cases["error_x_arcsec"])
    x, y = (cases[f"error_{axis}_arcsec"][known] for axis in "xy")
    error = np.sqrt(((x - np.median(x)) ** 2 + (y - np.median(y)) ** 2) / 2)
    assert dots.get_xdata() == pytest.approx(cases["vary.rate_deg_s.across"][known])
    assert dots.get_ydata() == pytest.approx(error)
    # of 47 cases three bins; the median of a Rayleigh distribution is sqrt(ln 4) sigmas
    sigmas = [float(np.median(part)) for part in np.array_split(error, 3)]
    assert bins.get_ydata() == pytest.approx(np.array(sigmas) * math.sqrt(2 / math.log(4)))
    assert limit.get_xdata() == pytest.approx([0.02, 1.0])
    assert limit.get_ydata() == pytest.approx([30.0, 30.0])
    assert axes.texts[0].get_text() == f"nea {verdicts[1].verdict}"
    assert axes.get_xscale() == "log"
    assert 30.0 < axes.get_ylim()[1] < 5e3
    met = [each.verdict for each in verdicts].count(MET)
    assert figure.get_suptitle() == f"{met} of 3 requirements are met"


def test_the_chart_of_errors_across_has_the_limits_of_such_errors_alone(
    tmp_path: Path, required
) -> None:
    write_cases(tmp_path / "cases.parquet")
    cases = read_cases(tmp_path / "cases.parquet")
    of_nea = required[1][1]
    verdicts = []
    for number, axis in enumerate((None, "cross", "x", "y", "z", "roll")):
        require = structs.replace(of_nea.require, axis=axis, maximum=10.0 + number)
        verdicts.append(replace(of_nea, require=require))
    (axes,) = requirements_page._chart(cases, verdicts).axes
    _, _, *limits = axes.get_lines()
    assert [float(line.get_ydata()[0]) for line in limits] == [10.0, 11.0, 12.0, 13.0]


@pytest.mark.parametrize(
    ("words", "whole", "state"),
    [
        ([MET, MET], MET, OK),
        ([MET, NOT_SHOWN], NOT_SHOWN, WARN),
        ([NOT_SHOWN, NOT_MET, MET], NOT_MET, BAD),
    ],
)
def test_the_verdict_of_all_requirements_is_the_worst(required, words, whole, state) -> None:
    verdicts = [replace(required[1][0], verdict=word) for word in words]
    assert requirements_page.verdict_of(verdicts) == whole
    assert requirements_page._verdict(verdicts).state == state
    assert acceptance_page.verdict_of([clause_of(word) for word in words]) == whole
    untested = ClauseVerdict(clause_of(MET).clause, None, "", "no clock")
    assert acceptance_page.verdict_of([untested]) == NOT_SHOWN
    told = requirements_page._verdict(verdicts).words
    assert told.startswith(f"Of {len(words)}: ")
    for word in set(words):
        assert f"{words.count(word)} {word}" in told


@pytest.mark.parametrize(
    ("condition", "span"),
    [
        ("rate_deg_s.across > 0.5", (0.5, 2.0)),
        ("rate_deg_s.across >= 0.5 and rate_deg_s.across < 1", (0.5, 1.0)),
        ("rate_deg_s.across == 0.7", (0.7, 0.7)),
        ("rate_deg_s.across < 5", (0.1, 2.0)),
        ("tracker.psf_sigma_px < 1", (0.1, 2.0)),
        ("", (0.1, 2.0)),
    ],
)
def test_a_requirement_is_drawn_over_the_rates_of_its_condition(condition, span) -> None:
    assert requirements_page._span(condition, 0.1, 2.0) == span


def require_of(**keys: Any) -> dict[str, Any]:
    return {"capability": "a capability", "of": "slews", "quantity": "nea", "maximum": 4.0} | keys


def clause_of(word: str = MET, unit: str = "arcsec", **keys: Any) -> ClauseVerdict:
    """A clause with its verdict."""
    of_clause = {name: keys.pop(name) for name in list(keys) if name in CLAUSE_KEYS}
    together = keys.pop("together", "")
    clause = ClauseTable(**require_of(**of_clause))
    figures: dict[str, Any] = {"value": 2.5, "low": 2.25, "high": 2.875, "guard": 0.5}
    figures |= {"cases": 31, "bound": 2.875, "more": None, "method": "by hand"} | keys
    verdict = RequirementVerdict(clause.require, verdict=word, **figures)
    return ClauseVerdict(clause, verdict, unit, together=together)


CLAUSE_KEYS = ("capability", "of", "quantity", "maximum", "minimum", "condition", "share", "axis")
SWEEP = SweepTable(key="tracker.psf_sigma_px", start=1.0, stop=9.0, share=0.75, unit="px")
LEVELS = [
    LevelCount(9.0, 1, 20),
    LevelCount(1.0, 20, 20),
    LevelCount(5.0, 9, 18),
    LevelCount(7.0, 0, 0),
]


def some_verdicts() -> list[ClauseVerdict]:
    """One of each word, and an edge."""
    edge = {"capability": "width", "of": "widths", "quantity": "edge", "maximum": None}
    first = {"capability": "first", "of": "starts", "quantity": "time-to-first-attitude"}
    untested = ClauseTable(**require_of(capability="stamps", of="none", quantity="time-bias"))
    return [
        clause_of(MET, capability="noise", condition="rate_deg_s.across < 1"),
        clause_of(NOT_SHOWN, "px", **edge, minimum=3.0, value=4.0, low=2.0, high=6.0, more=17),
        clause_of(NOT_MET, "s", **first, share=0.9, value=7.0, low=6.0, high=1234.5, guard=0.0),
        ClauseVerdict(untested, None, "s", "no clock of its own"),
    ]


@pytest.fixture(scope="module")
def accepted(
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[AcceptedBench, list[SetResult], dict[str, Any], list[Figure]]:
    folder = tmp_path_factory.mktemp("acceptance")
    (folder / LEDGER).write_text("set,level\n")
    verdicts = some_verdicts()
    sets = (
        CaseSet("widths", "wider and wider stars", {}, SWEEP),
        CaseSet("starts", "", {}, None),
    )
    plan = AcceptancePlan(
        path=folder / "plan.toml",
        text="a plan",
        title="Trial",
        seed=1,
        through="tracker",
        sets=sets,
        clauses=tuple(judged.clause for judged in verdicts),
        untested=(UntestedTable(capability="dust", why="no dust here"),),
        quick=True,
    )
    path = write_bench(folder, monitor={"panel_delay_ms": 8.0})
    bench = AcceptedBench(plan, path, folder, "centroids")
    bench.certificate = a_certificate()
    times_s = np.concatenate([0.25 * np.arange(1, 19), [np.nan, np.nan]])
    cases = Columns(20, {"first_attitude_s": times_s, "case": np.arange(20.0)}, {})
    results = [
        SetResult(sets[0], levels=LEVELS, failed={"no light": 3}),
        SetResult(sets[1], cases=cases),
    ]
    with drawn_figures() as drawn:
        summary = acceptance_page.write_acceptance(bench, results, verdicts, 58)
    return bench, results, summary, drawn


def test_an_acceptance_s_object_and_table_have_each_clause_s_own_figures(accepted) -> None:
    bench, _, summary, _ = accepted
    told = json.loads((bench.directory / "acceptance.json").read_text())
    assert told["verdict"] == summary["verdict"] == NOT_MET
    assert told["cases"] == 58
    assert told["plan_sha256"] == sha256(b"a plan").hexdigest()
    assert told["bench_sha256"] == read_bench_file(bench.file.path).sha256
    # attitude_x is within -4.5 and attitude_z within 10 arcsec, and the latency from 7.75 to 8.55 ms,
    # of which 8 ms are stated and taken into account
    assert told["bench_off_arcsec"] == {"cross": 4.5, "roll": 10.0}
    assert told["bench_off_s"] == pytest.approx(0.00055)
    assert told["untested"] == [{"capability": "dust", "why": "no dust here"}]
    noise, width, first, stamps = told["clauses"]
    assert (noise["axis"], width["axis"], first["axis"]) == ("cross", "", "")
    assert [clause["side"] for clause in told["clauses"]] == [
        "maximum",
        "minimum",
        "maximum",
        "maximum",
    ]
    assert [clause["limit"] for clause in told["clauses"]] == [4.0, 3.0, 4.0, 4.0]
    # the limit, less the guard band and the interval's end
    assert [clause["margin"] for clause in told["clauses"]] == [0.625, -1.5, -1230.5, None]
    assert (noise["low"], noise["value"], noise["high"], noise["guard"]) == (2.25, 2.5, 2.875, 0.5)
    assert (noise["cases"], width["more_cases"], first["more_cases"]) == (31, 17, None)
    assert (stamps["verdict"], stamps["why"]) == ("not tested", "no clock of its own")
    rows = csv_rows(bench.directory / "acceptance.csv")
    for row, clause in zip(rows, told["clauses"], strict=True):
        for name, text in row.items():
            value = clause[name]
            expected = "" if value is None else value
            if isinstance(value, (int, float)):
                assert float(text) == pytest.approx(value)
            else:
                assert text == expected


def test_an_acceptance_s_page_has_its_verdict_clauses_and_ledger(accepted) -> None:
    bench, _, _, _ = accepted
    cards = card_lines((bench.directory / "accept.html").read_text())
    assert cards[BAND][:2] == ["Trial: bench.toml", "A clause is not met"]
    assert cards[BAND][2].startswith("Of 4: 1 met, 1 not met, 1 not shown, 1 not tested. Tested:")
    assert cards[BAND][3:] == ["1", "met", "1", "not met", "1", "not shown", "1", "not tested"]
    clauses = [[cell.strip(" |") for cell in line.split(" | ")] for line in cards["Clauses"][1:4]]
    assert clauses[0][:7] == [
        "noise",
        "at most 4 arcsec where rate_deg_s.across < 1",
        "2.5 (2.25 to 2.88) arcsec",
        "0.5 arcsec",
        "0.625 arcsec (16 %)",
        "met",
        "31",
    ]
    assert clauses[1][:6] == [
        "width",
        "at least 3 px",
        "4 (2 to 6) px",
        "0.5 px",
        "-1.5 px (-50 %)",
        "not shown",
    ]
    assert clauses[1][7] == "about 17 more cases would decide"
    assert clauses[2][1:5] == ["at most 4 s in 90 % of cases", "7 (6 to 1230) s", "", "-1230 s"]
    assert cards["Not tested"] == [
        "capability | why",
        "stamps | no clock of its own",
        "dust | no dust here",
    ]
    assert cards["Failed cases"][1] == "widths | 3 | no light"
    assert cards["width"][0] == "wider and wider stars"
    levels = ["1 | 20 | 20", "5 | 9 | 18", "7 | 0 | 0", "9 | 1 | 20"]
    assert cards["width"][-4:] == levels
    about = cards["Bench, plan and ledger"]
    ledger = sha256((bench.directory / LEDGER).read_bytes()).hexdigest()
    assert f"ledger | 58 cases in {LEDGER}, sha256 {ledger}" in about
    assert "tested | the bench file's virtual tracker before the sky, no real one" in about
    assert about[-2:] == ["widths | 58 | wider and wider stars", "starts | 20 |"]
    assert any(line.startswith("certificate | certificate H20261126-0a1b2c3d") for line in about)


def test_a_sweep_is_drawn_with_the_interval_of_each_level_and_the_edge(accepted) -> None:
    figure = accepted[3][0]
    (axes,) = figure.axes
    (points,) = axes.containers
    xy = np.asarray(points[0].get_xydata())
    assert xy[:, 0] == pytest.approx([1.0, 5.0, 9.0])
    assert xy[:, 1] == pytest.approx([1.0, 0.5, 0.05])
    (bars,) = points[2]
    for segment, (successes, cases) in zip(
        bars.get_segments(), ((20, 20), (9, 18), (1, 20)), strict=True
    ):
        low = beta.ppf(0.025, successes, cases - successes + 1)
        high = 1.0 if successes == cases else beta.ppf(0.975, successes + 1, cases - successes)
        assert segment[:, 1] == pytest.approx([low, high])
    (edge,) = axes.patches
    assert edge.get_extents().transformed(axes.transData.inverted()).intervalx == pytest.approx(
        [2.0, 6.0]
    )
    assert any(list(line.get_ydata()) == [0.75, 0.75] for line in axes.get_lines())
    assert " ".join(figure.get_suptitle().split()) == "An attitude up to 4 (2 to 6) px"


def test_first_attitudes_are_shares_of_all_cases_with_limits_by_order_statistics(accepted) -> None:
    """Of 20 cases 18 have an attitude, one each quarter of a second."""
    cards = card_lines((accepted[0].directory / "accept.html").read_text())
    lines = [line.split(" | ") for line in cards["Time to the first attitude: starts"]]
    rows = {line[0]: line[1:] for line in lines if len(line) == 4}
    # the tenth of 20; so few above or below it are as rare as 2.5 %
    low = int(binom.ppf(0.025, 20, 0.5))
    high = int(binom.ppf(0.975, 20, 0.5)) + 1
    assert rows["50 %"] == ["2.5", f"{0.25 * low:.4g}", f"{0.25 * high:.4g}"]
    assert rows["90 %"][0] == "4.5"
    assert rows["95 %"][0] == rows["99 %"][0] == "more than was waited"
    figure = accepted[3][1]
    (steps,) = figure.axes[0].get_lines()
    assert steps.get_xdata() == pytest.approx(0.25 * np.arange(1, 19))
    assert steps.get_ydata() == pytest.approx(np.arange(1, 19) / 20)
    title = " ".join(figure.get_suptitle().split())
    assert title == "An attitude within 4.5 s in 90 % of cases"


def test_lines_name_each_clause_what_is_not_tested_and_what_failed(accepted) -> None:
    bench, results, _, _ = accepted
    chance = clause_of(NOT_MET, capability="turn", together=NOT_SHOWN)
    lines = acceptance_page.lines_of(bench, results, [*some_verdicts(), chance])
    assert lines == [
        "noise   met         at most 4 arcsec where rate_deg_s.across < 1: 2.5 (2.25 to 2.88) arcsec",
        "width   not shown   at least 3 px: 4 (2 to 6) px; about 17 more cases would decide",
        "first   not met     at most 4 s in 90 % of cases: 7 (6 to 1230) s",
        "stamps  not tested  no clock of its own",
        "turn    not met     at most 4 arcsec: 2.5 (2.25 to 2.88) arcsec; may be chance among so"
        " many clauses; more cases would tell",
        "dust    not tested  no dust here",
        "widths: 3 cases failed: no light",
    ]


@pytest.mark.parametrize(
    ("keys", "text"),
    [
        ({"value": None}, DASH),
        ({"low": None}, "2.5 (2.88 or less) arcsec"),
        ({"high": None}, "2.5 (2.25 or more) arcsec"),
        ({"low": None, "high": None}, "2.5 (interval unknown) arcsec"),
        ({"value": 12345.0, "low": 999.0, "high": -23456.0}, "12300 (999 to -23500) arcsec"),
        (
            {"quantity": "edge", "high": None, "method": f"m; {STILL} the stop"},
            f"{STILL} 2.5 arcsec",
        ),
        (
            {"quantity": "edge", "low": None, "method": f"m; {NOT_EVEN} it"},
            f"{NOT_EVEN} 2.5 arcsec",
        ),
    ],
)
def test_a_figure_without_an_end_says_so(keys, text) -> None:
    assert acceptance_page._measured(clause_of(MET, **keys)) == text


@pytest.mark.parametrize(
    ("keys", "text"),
    [
        ({"maximum": 0.0, "high": 0.0}, "0 deg"),
        ({"maximum": 0.0, "high": 0.5}, "-0.5 deg"),
        ({"maximum": -4.0, "high": -5.0}, "1 deg (25 %)"),
        ({"maximum": 4.0, "high": 8.0}, "-4 deg (-100 %)"),
        ({"maximum": 4.0, "high": 8.5}, "-4.5 deg"),
        ({"maximum": 4.0, "high": None}, None),
        ({"maximum": None, "minimum": 0.0, "low": 0.0}, "0 deg"),
        ({"maximum": None, "minimum": 1.0, "low": None}, None),
    ],
)
def test_a_margin_is_a_share_of_its_limit_where_that_is_not_zero(keys, text) -> None:
    judged = clause_of(MET, "deg", quantity="edge", guard=0.0, **keys)
    assert acceptance_page._margin(judged) == text


@pytest.mark.parametrize(
    ("keys", "finding"),
    [
        ({"method": f"{STILL} the stop", "high": None}, "An attitude even at 2.5 px"),
        ({"method": f"{NOT_EVEN} it", "low": None}, "An attitude is not there even at 2.5 px"),
        ({}, "An attitude up to 2.5 (2.25 to 2.88) px"),
        ({"value": None}, "An attitude: no edge"),
    ],
)
def test_an_edge_s_finding_says_up_to_where(keys, finding) -> None:
    judged = clause_of(MET, "px", quantity="edge", maximum=None, minimum=1.0, **keys)
    assert acceptance_page._edge_finding(SWEEP, judged) == finding


def test_a_sweep_down_and_one_of_stars_say_so() -> None:
    judged = clause_of(MET, "px", quantity="edge", maximum=None, minimum=1.0)
    down = SweepTable(key="k", start=9.0, stop=1.0, star_v_mag=5.5)
    finding = acceptance_page._edge_finding(down, judged)
    assert finding == "Half of the stars to V 5.5 down to 2.5 (2.25 to 2.88) px"
    untested = ClauseVerdict(judged.clause, None, "px", "no light")
    assert acceptance_page._edge_finding(SWEEP, untested) == "An attitude: no light"


def test_what_is_open_is_more_cases_or_why_there_is_no_figure() -> None:
    why = {"value": None, "method": "too few"}
    assert acceptance_page._more(clause_of(NOT_SHOWN, **why)) == "too few"
    assert acceptance_page._more(clause_of(NOT_SHOWN)) == ""
    assert acceptance_page._more(clause_of(MET, **why)) == ""
    assert acceptance_page._more(clause_of(NOT_MET, together=NOT_MET)) == ""
    tested = [clause_of(MET)]
    assert [tile.state for tile in acceptance_page._counts(tested)] == [OK]
    assert [tile.state for tile in acceptance_page._counts([clause_of(NOT_MET)])] == [WARN, BAD]


def test_a_case_s_rate_is_that_of_all_axes_together_and_its_error_one_of_two(tmp_path) -> None:
    """3 and 4 deg/s are 5; 6 and 8 arcsec about the median are 10 of two axes."""
    numbers = {
        "error_x_arcsec": np.array([10.0, 16.0, 4.0, np.nan]),
        "error_y_arcsec": np.array([20.0, 28.0, 12.0, np.nan]),
        "vary.rate_deg_s.x": np.array([0.0, 3.0, -3.0, 1.0]),
        "vary.rate_deg_s.y": np.array([1.0, -4.0, 4.0, 0.0]),
        "vary.tracker.exposure_s": np.full(4, 9.0),
    }
    error, rate = requirements_page._error_and_rate(Columns(4, numbers, {}))
    assert error[:3] == pytest.approx(np.array([0.0, 10.0, 10.0]) / np.sqrt(2))
    assert rate == pytest.approx([1.0, 5.0, 5.0, 1.0])


def campaign_summary(**changes: Any) -> dict[str, Any]:
    """What a campaign's page is of."""
    usual = {
        "cases": 25_000,
        "failed": 0,
        "failed_because": {},
        "wrong": 0,
        "availability": 1.0,
        "limit_arcsec": None,
        "table": "out/cases.parquet",
        "sha256": "ab" * 32,
        "notes": [],
    }
    return usual | changes


@pytest.mark.parametrize(
    ("changes", "state", "headline"),
    [
        ({}, OK, "100 %"),
        ({"availability": 0.99996}, WARN, "99.99 %"),
        ({"availability": 0.97}, WARN, "97 %"),
        ({"failed": 3}, WARN, "100 %"),
        ({"failed": 3, "wrong": 1}, BAD, "100 %"),
    ],
)
def test_a_campaign_is_judged_by_wrong_answers_then_by_what_is_missing(
    changes: dict[str, Any], state: str, headline: str
) -> None:
    summary = campaign_summary(**changes)
    verdict = verdict_of(summary)
    counts = f"25000 cases, {summary['failed']} failed, {summary['wrong']} wrong answers."
    assert verdict == Verdict(state, f"The tracker was right in {headline} of the frames", counts)


def test_the_page_of_a_campaign_says_what_failed_and_the_known_rows_of_its_budget(
    tmp_path: Path,
) -> None:
    """Of 22 reasons the page has 20; a figure's half width is that of its interval; a cure stands
    once.
    """
    because = {f"reason {k}": 100 - k for k in range(22)}
    summary = campaign_summary(failed=1969, failed_because=because, wrong=7, notes=["a note"])
    budget = [
        FigureRow("noise", "cross", 2.0, "arcsec", 1.7, 2.3),
        FigureRow("noise", "roll", 30.0, "arcsec", 25.0, 35.0),
        FigureRow("pixel error", "cross", None, "arcsec"),
        FigureRow("pixel error", "roll", 9.0, "arcsec", 8.0, 10.0),
    ]
    costs = {}
    for measure, cost in (("noise", 3), ("bias", 4)):
        costs[measure] = MeasureCosts(f"{cost} arcsec", f"cost of {measure}", [], Figure())
    with drawn_figures():
        write_campaign_page(tmp_path / "campaign.html", summary, budget, costs)
    text = (tmp_path / "campaign.html").read_text()
    cards = card_lines(text)
    failed = cards["Failed cases"]
    assert f"100{CELL}reason 0" in failed and f"81{CELL}reason 19" in failed
    assert not any("reason 20" in line for line in failed)
    band = " ".join(cards[BAND])
    for words in (
        "Campaign of 25000 cases",
        "2.00 \N{PLUS-MINUS SIGN} 0.30 arcsec noise across, one sigma",
        "pixel error across: cannot be told",
        "7 wrong answers",
        "1969 failed cases",
    ):
        assert words in band, band
    assert 'data-state="bad">7<small>wrong answers' in text
    assert text.count("column `wrong` is over 0") == 1
    assert "a note" in " ".join(cards["Table and notes"])
    known = [line for line in cards["Budget"] if line.startswith("pixel error")]
    assert known == [f"pixel error{CELL}about the boresight{CELL}9.0 (8.0 to 10.0) arcsec"]
