"""Results: planted errors come out of the budget and the costs, and noise alone is called noise."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from hilstar.basics.rotation import from_radec_roll_deg
from hilstar.instruments.campaign.case_table import Columns, read_cases
from hilstar.instruments.campaign.results import costs, write_results
from hilstar.instruments.campaign.store import schema_of, write_table
from hilstar.server.bench.bench_file import read_bench_file
from tests.support.campaigns import write_campaign

CASES = 2000
BIAS_ARCSEC = np.array([5.0, -3.0, 40.0])
NOISE_ARCSEC = np.array([1.0, 1.0, 8.0])
COST = 2.0  # the factor by which noise grows from one end of `a` to the other
BIAS_LIMIT_ARCSEC = 5 * NOISE_ARCSEC * (1 + COST) / np.sqrt(CASES)
SHARE_OF_BIAS = 0.1  # 2000 cases tell a sigma to 2 %; the growth along `a` makes them not normal


@pytest.fixture
def cases_table(tmp_path: Path, rng: np.random.Generator) -> Path:
    """A table of cases with a bias, noise that grows with `a` and not with `b` or `word`, and
    forty wild answers.
    """
    names = ("wrong", "solved", "frames")
    rows = []
    for case in range(CASES):
        a, b, word = (
            float(rng.random()),
            float(rng.random()),
            str(rng.choice(["one", "two", "three"])),
        )
        q = from_radec_roll_deg(
            360 * rng.random(), np.degrees(np.arcsin(2 * rng.random() - 1)), 360 * rng.random()
        )
        error = BIAS_ARCSEC + NOISE_ARCSEC * (1 + COST * a) * rng.standard_normal(3)
        wild = case % 50 == 7
        row = dict.fromkeys(f"error_{axis}_arcsec" for axis in "xyz") | dict.fromkeys(
            f"scatter_{axis}_arcsec" for axis in "xyz"
        )
        row |= {f"q{axis}": float(value) for axis, value in zip("wxyz", q, strict=True)}
        solved = from_radec_roll_deg(*(360 * rng.random(), 10.0, 20.0)) if wild else q
        row |= {f"solved_q{axis}": float(value) for axis, value in zip("wxyz", solved, strict=True)}
        if not wild:
            row |= {
                f"error_{axis}_arcsec": float(value)
                for axis, value in zip("xyz", error, strict=True)
            }
        row |= {"status": "done", "why": "", "vary.a": a, "vary.b": b, "vary.word": word}
        rows.append(row | dict(zip(names, (int(wild), 1, 1), strict=True)))
    texts = ("status", "why", "vary.word")
    columns = {
        name: "int64" if name in names else "text" if name in texts else "float64"
        for name in rows[0]
    }
    write_table(tmp_path / "cases.parquet", schema_of(columns, {}), iter([rows[:900], rows[900:]]))
    return tmp_path / "cases.parquet"


def test_a_planted_budget_and_what_a_parameter_costs_are_found(cases_table: Path) -> None:
    found = write_results(
        cases_table, read_bench_file(write_campaign(cases_table.parent).parent / "bench.toml"), 1
    )
    # of its own stars, whatever was planted
    assert 0 < found["limit_arcsec"].cross < 1 < found["limit_arcsec"].roll < 100
    assert np.all(np.abs(np.array(found["bias_arcsec"]) - BIAS_ARCSEC) < BIAS_LIMIT_ARCSEC)
    # The mean square of 1 + 2 a over a from 0 to 1.
    growth = np.sqrt(1 + COST + COST**2 / 3)
    assert found["noise_arcsec"].cross == pytest.approx(growth, rel=SHARE_OF_BIAS)
    assert found["noise_arcsec"].roll == pytest.approx(8 * growth, rel=SHARE_OF_BIAS)
    assert found["wrong"] == CASES // 50 and found["availability"] == pytest.approx(0.98)
    assert any("too far apart" in note for note in found["notes"])  # of an all-sky plan
    assert "a costs the most of the error across" in found["findings"][0]
    each = {
        cost.parameter: cost for cost in costs(read_cases(cases_table)) if cost.measure == "roll"
    }
    assert each["a"].sure and not each["b"].sure and not each["word"].sure
    assert each["a"].places[each["a"].worst] > 0.8
    assert each["a"].share > 3 * max(each["b"].share, each["word"].share)
    header, *lines = (cases_table.parent / "budget.csv").read_text().splitlines()
    assert header == "quantity,axis,value,unit,low_95,high_95" and lines[0].startswith("bias,x,")
    assert len((cases_table.parent / "sensitivity.csv").read_text().splitlines()) == 1 + 3 * 3
    with Image.open(cases_table.parent / "sensitivity_cross.png") as picture:
        assert picture.width > 500 and len(picture.convert("L").getcolors() or range(300)) > 10


def test_the_page_has_the_verdict_and_the_cost_of_each_parameter(cases_table: Path) -> None:
    write_results(
        cases_table, read_bench_file(write_campaign(cases_table.parent).parent / "bench.toml"), 1
    )
    text = (cases_table.parent / "campaign.html").read_text()
    assert 'data-state="bad"><div><strong>The tracker was right in 98 % of the frames' in text
    figures = re.findall('<p class="number" data-state=".*?">(.*?)<small>(.*?)</small>', text)
    assert ("40", "wrong answers") in figures
    costs_of = [figure for figure in figures if figure[1].startswith("cost of a")]
    assert len(costs_of) == 3 and all("noise" not in of for _, of in costs_of[:2])
    assert re.search(r"<td>b</td><td>[0-9.]+ arcsec \(noise\)</td><td>[0-9.]+ arcsec at 0", text)
    assert "What to do:" in text and "_arcsec" not in text
    assert re.search(r"<td>bias</td><td>x</td><td>5\.[0-9]+ \(.* to .*\) arcsec</td>", text)
    assert "<td>availability</td><td></td><td>98 %</td>" in text


def test_few_cases_have_no_budget_and_a_note_says_so(tmp_path: Path) -> None:
    rows = [dict.fromkeys(("qw", "solved_qw"), 1.0)]
    columns = read_cases_of(tmp_path, rows)
    assert columns.cases == 1 and columns.varied == []


def read_cases_of(folder: Path, rows: list[dict[str, float]]) -> Columns:
    write_table(
        folder / "t.parquet", schema_of(dict.fromkeys(rows[0], "float64"), {}), iter([rows])
    )
    return read_cases(folder / "t.parquet")


def test_a_large_table_is_read_in_part(tmp_path: Path) -> None:
    rows = [{"case": float(k)} for k in range(100)]
    write_table(
        tmp_path / "t.parquet", schema_of({"case": "float64"}, {}), iter([rows[:60], rows[60:]])
    )
    part = read_cases(tmp_path / "t.parquet", 10)
    assert part.cases == 100 and len(part.numbers["case"]) == 10
