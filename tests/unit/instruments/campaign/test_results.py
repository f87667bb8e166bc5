"""Results: planted errors come out of the budget and the costs, and noise alone is called noise."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from hilstar.basics.rotation import from_radec_roll_deg
from hilstar.instruments.assess.budget import Axes
from hilstar.instruments.campaign import results
from hilstar.instruments.campaign.case_table import Columns, read_cases
from hilstar.instruments.campaign.results import costs, write_results
from hilstar.instruments.campaign.store import failures, schema_of, write_table
from hilstar.server.bench.bench_file import read_bench_file
from tests.support.campaigns import write_campaign
from tests.support.refusals import refusal

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


@pytest.mark.usefixtures("without_charts")
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
    # every third: of every second there were more than are asked for
    part = read_cases(tmp_path / "t.parquet", 49)
    assert part.numbers["case"].tolist() == [*range(0, 60, 3), *range(60, 100, 3)]


def test_a_table_s_columns_are_numbers_texts_and_lists_by_their_kinds(tmp_path: Path) -> None:
    """A gap is no number, no text or an empty list."""
    kinds = {"case": "int64", "why": "text", "times": "floats", "value": "float64"}
    rows = [
        {"case": 0, "why": "late", "times": [1.0, 2.0], "value": None},
        {"case": 1, "why": None, "times": None, "value": 0.5},
    ]
    path = tmp_path / "t.parquet"
    write_table(path, schema_of(kinds, {}), iter([rows[:1], rows[1:]]))
    columns = read_cases(path)
    assert columns.texts == {"why": ["late", ""]}
    assert [values.tolist() for values in columns.lists["times"]] == [[1.0, 2.0], []]
    assert columns.numbers["case"].tolist() == [0.0, 1.0]
    assert np.array_equal(columns.numbers["value"], [np.nan, 0.5], equal_nan=True)
    path.write_text("no table")
    for read in (read_cases, failures):
        line = refusal(read, path)
        assert "t.parquet: is no table of a campaign (" in line
        assert line.endswith("delete it, and run the same command again")


def columns_of(**numbers: list[float]) -> Columns:
    """Cases with these columns of numbers."""
    columns = {name: np.array(values, dtype=float) for name, values in numbers.items()}
    return Columns(len(next(iter(columns.values()))), columns, {})


def vectors_of(form: str, names: str, rows: np.ndarray) -> dict[str, list[float]]:
    """Columns by the parts of rows (n, k)."""
    columns = {}
    for name, column in zip(names, rows.T.tolist(), strict=True):
        columns[form.format(name)] = column
    return columns


def test_a_centroider_s_figures_are_weighed_by_its_stars() -> None:
    """Cases of 3 and 9 stars with an error of 0.1 and 0.5 px: their mean is 0.4, the spread about
    it that within the cases and that between them. One star alone tells no spread.
    """
    numbers = columns_of(
        measured=[3, 9, 1],
        centroid_dx_px=[0.1, 0.5, 99.0],
        centroid_dy_px=[-0.2, -0.2, 99.0],
        centroid_sigma_x_px=[0.3, 0.3, 99.0],
        centroid_sigma_y_px=[0.1, 0.2, 99.0],
        matched=[3, 8, math.nan],
        stars=[5, 10, 5],
        false=[1, 2, 0],
        frames=[2, 2, 2],
    )
    found = results._centroids(numbers)
    between = 0.25 * 0.1**2 + 0.75 * 0.5**2 - 0.4**2
    assert found == pytest.approx(
        {
            "bias_x_px": 0.4,
            "bias_y_px": -0.2,
            "sigma_x_px": math.sqrt(0.3**2 + between),
            "sigma_y_px": math.sqrt(0.25 * 0.1**2 + 0.75 * 0.2**2),
            "found_share": 11 / 20,
            "false_a_frame": 3 / 6,
        }
    )
    assert results._centroids(columns_of(measured=[1.0])) is None
    assert results._centroids(columns_of(frames=[1.0])) is None


def test_an_answer_is_its_error_on_what_was_lit_where_that_is_known() -> None:
    """A case that was lit a degree from where it was commanded, and one of which that is not
    known.
    """
    commanded = np.array([from_radec_roll_deg(10.0, 20.0, 30.0)] * 3)
    lit = commanded.copy()
    lit[0] = from_radec_roll_deg(11.0, 20.0, 30.0)
    lit[1] = np.nan
    solved = np.full((3, 4), np.nan)
    solved[2] = from_radec_roll_deg(40.0, 0.0, 0.0)
    error_arcsec = np.array([[30.0, -20.0, 100.0], [1.0, 2.0, 3.0], [np.nan, 1.0, 1.0]])
    columns = vectors_of("q{}", "wxyz", commanded) | vectors_of("solved_q{}", "wxyz", solved)
    columns |= vectors_of("lit_q{}", "wxyz", lit)
    columns |= vectors_of("error_{}_arcsec", "xyz", error_arcsec)
    at, reported = results.attitudes_of(columns_of(**columns))
    assert at[0] == pytest.approx(lit[0])
    assert at[1] == pytest.approx(commanded[1])
    for k in range(2):
        off = (
            Rotation.from_quat(np.roll(reported[k], -1))
            * Rotation.from_quat(np.roll(at[k], -1)).inv()
        )
        assert off.as_rotvec(degrees=True) * 3600 == pytest.approx(error_arcsec[k])
    assert reported[2] == pytest.approx(solved[2])


def test_a_budget_of_many_cases_is_that_of_an_even_share_of_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator
) -> None:
    """A bias that grows from 0 to 20 arcsec over the cases, of which every fifth counts."""
    monkeypatch.setattr(results, "MAX_FITTED_CASES", 40)
    monkeypatch.setattr(results, "noise_limit", lambda file, commanded: Axes(None, None))
    write_campaign(tmp_path)
    count = 200
    at = Rotation.random(count, random_state=4).as_quat(scalar_first=True)
    errors = 0.01 * rng.standard_normal((count, 3))
    errors[:, 0] += np.linspace(0.0, 20.0, count)
    columns = vectors_of("q{}", "wxyz", at) | vectors_of("solved_q{}", "wxyz", at)
    columns |= vectors_of("error_{}_arcsec", "xyz", errors)
    columns |= vectors_of("scatter_{}_arcsec", "xyz", np.full((count, 3), np.nan))
    columns |= {"frames": [1.0] * count, "solved": [1.0] * count, "wrong": [0.0] * count}
    file = read_bench_file(tmp_path / "bench.toml")
    budget, parts = results.case_budget(columns_of(**columns), file, rng)
    assert parts is not None and len(parts.row) == 40
    assert budget["bias_arcsec"][0] == pytest.approx(errors[::5, 0].mean(), abs=1e-3)
    assert budget["availability"] == 1.0


def test_a_summary_counts_the_cases_of_each_reason_to_fail(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of ten cases three have no log and two no stars: too few for a budget, and a note says so."""
    monkeypatch.setattr(results, "noise_limit", lambda file, commanded: Axes(None, None))
    write_campaign(tmp_path)
    numbers = ["frames", "solved", "wrong"]
    for form, names in (("q{}", "wxyz"), ("solved_q{}", "wxyz"), ("error_{}_arcsec", "xyz")):
        numbers += [form.format(name) for name in names]
    numbers += [f"scatter_{axis}_arcsec" for axis in "xyz"]
    rows = []
    for case, why in enumerate(["", "no log", "no stars", "", "no log"] * 2):
        row = dict.fromkeys(numbers) | {"case": case, "why": why, "status": "done"}
        if why and case != 7:
            row["status"] = "failed"
        else:
            row |= {"frames": 4.0, "solved": 3.0, "wrong": 1.0}
        rows.append(row)
    kinds = dict.fromkeys(numbers, "float64") | {"case": "int64", "why": "text", "status": "text"}
    table = tmp_path / "cases.parquet"
    write_table(table, schema_of(kinds, {}), iter([rows]))
    summary = write_results(table, read_bench_file(tmp_path / "bench.toml"), 1)
    assert (summary["cases"], summary["failed"]) == (10, 5)
    assert summary["failed_because"] == {"no log": 4, "no stars": 1}
    assert (summary["availability"], summary["wrong"]) == (0.5, 5)
    assert summary["notes"] == ("0 answers, and 30 are needed; plan more cases",)
    assert not list(tmp_path.glob("*.png"))


def test_the_scatter_within_cases_is_that_of_those_with_several_frames() -> None:
    scatter = np.array([[3.0, 4.0, 20.0], [np.nan] * 3, [1.0, 2.0, 10.0]])
    found = results._scatter_arcsec(columns_of(**vectors_of("scatter_{}_arcsec", "xyz", scatter)))
    assert found is not None
    assert found.cross == pytest.approx(math.sqrt((5.0 + 10.0) / 2))
    assert found.roll == pytest.approx(math.sqrt(250.0))
    alone = columns_of(**vectors_of("scatter_{}_arcsec", "xyz", np.full((2, 3), np.nan)))
    assert results._scatter_arcsec(alone) is None


def test_the_lines_of_a_summary_say_each_figure_of_it() -> None:
    centroids = {"bias_x_px": 9.0, "bias_y_px": 8.0, "sigma_x_px": 0.125, "sigma_y_px": 0.25}
    centroids |= {"found_share": 0.75, "false_a_frame": 0.5}
    summary = {
        "cases": 40,
        "table": "cases.parquet",
        "sha256": "abc",
        "failed_because": {f"reason {k}": 10 - k for k in range(6)},
        "availability": 0.875,
        "wrong": 3,
        "bias_arcsec": [1.5, -2.5, 30.0],
        "fov_arcsec": Axes(0.5, None),
        "pixel_arcsec": Axes(0.25, 1.25),
        "noise_arcsec": Axes(2.0, 8.0),
        "scatter_arcsec": Axes(1.0, 4.0),
        "centroids": centroids,
        "limit_arcsec": Axes(0.125, 0.375),
        "notes": ("a note",),
        "findings": ["a finding"],
    }
    lines = [" ".join(line.split()) for line in results.lines_of(summary)]
    assert lines == [
        "40 cases in cases.parquet, sha256 abc",
        *(f"{10 - k} failed: reason {k}" for k in range(5)),
        "availability 87.5 %, 3 wrong answers",
        "bias 1.5, -2.5, 30 arcsec about x, y, z",
        "field-of-view error 0.5 arcsec cross, -",
        "pixel error 0.25 arcsec cross, 1.25 arcsec roll",
        "noise 2 arcsec cross, 8 arcsec roll",
        "noise within a case 1 arcsec cross, 4 arcsec roll",
        "centroids 0.125, 0.25 px one sigma, 75 % of stars found, 0.5 false a frame",
        "limit of its stars 0.125 arcsec across, 0.375 about the boresight (Cramer-Rao, one"
        " exposure at rest)",
        "a note",
        "a finding",
    ]
    rows = list(results.budget_rows(summary, None))
    assert [(row.quantity, row.axis, row.value) for row in rows][9:13] == [
        ("noise within a case", "cross", 1.0),
        ("noise within a case", "roll", 4.0),
        ("limit of the tracker's stars", "cross", 0.125),
        ("limit of the tracker's stars", "roll", 0.375),
    ]
    units = {row.quantity: (row.value, row.unit) for row in rows if "centroids" in row.quantity}
    assert units["centroids: sigma_y_px"] == (0.25, "px")
    assert units["centroids: found_share"] == (0.75, "1")


def test_a_case_s_measures_are_about_the_median_and_count_what_is_missing() -> None:
    rng = np.random.default_rng(1)
    count = 16
    errors = rng.normal([5.0, -7.0, 40.0], 1, (count, 3))
    centroid = {
        "centroid_dx_px": [3.0] * count,
        "centroid_dy_px": [1.0] * count,
        "centroid_sigma_x_px": [2.0] * count,
        "centroid_sigma_y_px": [0.0] * count,
    }
    cases = columns_of(
        **vectors_of("error_{}_arcsec", "xyz", errors),
        **centroid,
        solved=[8.0] * count,
        wrong=[3.0] * count,
        frames=[10.0] * count,
    )
    found = {measure.name: measure for measure in results.measures(cases)}
    x, y, z = (errors - np.median(errors, axis=0)).T
    assert found["cross"].values == pytest.approx(np.sqrt((x**2 + y**2) / 2))
    assert found["roll"].values == pytest.approx(np.abs(z))
    assert found["centroid"].values == pytest.approx(np.full(count, math.sqrt(7.0)))
    assert found["unanswered"].values == pytest.approx(np.full(count, 0.5))


def test_cases_without_a_frame_have_no_share_and_no_error() -> None:
    """A count of 0 or unknown counts as 1: nothing was answered, and nothing was asked."""
    none = np.array([0.0, math.nan])
    assert results._ratio(none, none) == 0.0
    assert results._ratio(np.array([2.0, 1.0]), np.array([3.0, 1.0])) == pytest.approx(0.75)
    cases = columns_of(
        **vectors_of("error_{}_arcsec", "xyz", np.ones((16, 3))),
        solved=[0.0] * 8 + [1.0] * 8,
        wrong=[0.0] * 16,
        frames=[0.0] * 4 + [math.nan] * 4 + [2.0] * 8,
    )
    by_name = {measure.name: measure for measure in results.measures(cases)}
    assert by_name["unanswered"].values.tolist() == [1.0] * 8 + [0.5] * 8


@pytest.mark.parametrize("count", [16, 100])
def test_a_median_is_as_sure_as_the_values_beside_the_middle_and_a_mean_as_its_scatter(count):
    """Of even values from 0 to 1 the ranks half a root of their number to either side of a half."""
    values = np.random.default_rng(3).permutation(np.linspace(0, 1, count))
    assert results._level(values, False) == pytest.approx((0.5, 0.5 / math.sqrt(count)))
    standard = values.std(ddof=1) / math.sqrt(count)
    assert results._level(values, True) == pytest.approx((0.5, standard))


def test_a_share_is_none_by_chance_and_all_where_bins_say_all():
    """Of ranks in bins that chance made, on average, none; of bins that do not overlap, nearly all."""
    rng = np.random.default_rng(4)
    index = np.repeat(np.arange(8), 10)
    # what bins of ten have by chance is 7 of 79; half of it is cut off at 0
    shares = [results._share(rng.standard_normal(80), index, 8) for _ in range(200)]
    assert np.mean(shares) < 0.04
    # ranks 1 to 3 and 4 to 6: 13.5 between the means, of which a variance of 1 each is chance
    whole = results._share(np.arange(6.0), np.array([0, 0, 0, 1, 1, 1]), 2)
    assert whole == pytest.approx((13.5 - 2) / 6 / (35 / 12))
    apart = results._share(10.0 * index + rng.random(80), index, 8)
    # within a bin the variance of ten ranks is 8.25 of 533.25
    assert apart == pytest.approx(1 - 8.25 / 533.25, abs=0.005)


def test_sure_costs_come_first_and_then_the_largest(rng: np.random.Generator):
    """Errors that grow with `slow`, more with `fast`, and not with `none`, whose few wild bins cost
    the most; a key with less than four cases in one of its bins has no cost.
    """
    count = 240
    fast, slow = rng.integers(0, 3, (2, count))
    few = np.zeros(count)
    few[:3] = 1.0
    z = (1 + 6 * fast + 2 * slow) * np.where(np.arange(count) % 2, 1.0, -1.0)
    z = z * rng.uniform(0.9, 1.1, count)
    columns = columns_of(
        case=np.arange(count).tolist(),
        frames=[1] * count,
        solved=[1] * count,
        wrong=[0] * count,
        error_x_arcsec=[0.0] * count,
        error_y_arcsec=[0.0] * count,
        error_z_arcsec=z.tolist(),
    )
    varied = {"vary.none": rng.integers(0, 3, count), "vary.few": few}
    varied |= {"vary.slow": slow, "vary.fast": fast}
    for name, values in varied.items():
        columns.numbers[name] = values.astype(float)
    found = [cost for cost in costs(columns) if cost.measure == "roll"]
    assert [cost.parameter for cost in found] == ["fast", "slow", "none"]
    assert [cost.sure for cost in found] == [True, True, False]
    assert found[0].places == (0.0, 1.0, 2.0)
    assert (found[0].best, found[0].worst) == (0, 2)
    levels = found[0].level
    assert found[0].cost == pytest.approx(math.sqrt((levels**2).mean() - levels[0] ** 2))


def test_some_cases_are_their_rows_of_every_column() -> None:
    lists = [np.arange(float(k)) for k in range(4)]
    columns = Columns(9, {"x": np.arange(4.0)}, {"why": list("abcd")}, {"times": lists})
    some = columns.some(np.array([False, True, False, True]))
    assert (some.cases, some.numbers["x"].tolist(), some.texts) == (
        9,
        [1.0, 3.0],
        {"why": ["b", "d"]},
    )
    assert [values.tolist() for values in some.lists["times"]] == [[0.0], [0.0, 1.0, 2.0]]
