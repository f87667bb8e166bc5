"""What a campaign before a real tracker says beside its budget: its order, its wrong answers, and
how its bench drifted.
"""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from hilstar.instruments.campaign.bench_results import bench_lines, bench_summary
from hilstar.instruments.campaign.bench_run import NO_ANSWER, BenchOrder, drift_of, write_checks
from hilstar.instruments.campaign.cases import CaseMaker
from hilstar.instruments.campaign.plan import Design, parse_plan
from hilstar.server.bench.bench_file import read_bench_file
from tests.support.campaigns import write_campaign
from tests.support.tables import csv_rows

CASES = 7
# of check cases 0 to 3: hours after the first, and errors about x, y, z, arcsec, and mag
HOURS = np.array([0.0, 1.0, 2.0, 4.0])
ERRORS = np.array([[1.0, 3.0, 2.0, 8.0], [5.0, 4.0, 3.0, 1.0], [0.0, 10.0, 20.0, 40.0]])
MAGS = np.array([-9.0, -9.1, -9.2, -9.4])


def check_rows() -> list[dict[str, Any]]:
    """The rows of four check cases; the third has no attitude, and no light."""
    rows = []
    for k, hour in enumerate(HOURS.tolist()):
        row: dict[str, Any] = {
            "case": CASES + k,
            "begun_utc": f"2026-11-29T{10 + round(hour):02}:00:00.000Z",
            "run": 1 + k // 2,
            "received": 3,
            "signal_mag": MAGS[k] if k != 2 else None,
        }
        for axis, errors in zip("xyz", ERRORS, strict=True):
            row[f"error_{axis}_arcsec"] = errors[k] if k != 2 else None
        rows.append(row)
    return rows


def line_of(values: np.ndarray, known: list[int]) -> tuple[float, float]:
    """The change from the first to the last hour by least squares, and its standard error."""
    hours = HOURS[known]
    (slope, _), covariance = np.polyfit(hours, values[known], 1, cov="unscaled")
    rest = values[known] - np.polyval(np.polyfit(hours, values[known], 1), hours)
    sigma = np.sqrt((rest**2).sum() / (len(known) - 2) * covariance[0, 0])
    return float(slope * HOURS[-1]), float(sigma * HOURS[-1])


def test_a_bench_s_drift_is_last_less_first_along_the_line_through_its_check_cases(
    tmp_path: Path,
) -> None:
    path = tmp_path / "checks.csv"
    write_checks(path, check_rows(), CASES)
    rows = csv_rows(path)
    assert [row["check"] for row in rows] == ["0", "1", "2", "3"]
    assert [row["run"] for row in rows] == ["1", "1", "2", "2"]
    assert [row["error_y_arcsec"] for row in rows] == ["5.0", "4.0", "", "1.0"]
    drift = drift_of(path)
    assert drift is not None
    assert drift["checks"] == 4
    for k, errors in enumerate(ERRORS):
        change, sigma = line_of(errors, [0, 1, 3])
        assert drift["arcsec"][k] == pytest.approx(change)
        assert drift["sigma_arcsec"][k] == pytest.approx(sigma, abs=1e-9)
    assert drift["mag"] == pytest.approx(-0.4)
    assert drift["sigma_mag"] == pytest.approx(0.0, abs=1e-9)


def test_two_checks_tell_a_drift_without_its_error_and_one_or_those_of_one_moment_none(
    tmp_path: Path,
) -> None:
    path = tmp_path / "checks.csv"
    write_checks(path, check_rows()[:2], CASES)
    drift = drift_of(path)
    assert drift is not None
    assert drift["arcsec"] == pytest.approx([2.0, -1.0, 10.0])
    assert (drift["sigma_arcsec"], drift["sigma_mag"]) == ([None] * 3, None)
    write_checks(path, check_rows()[:1], CASES)
    assert drift_of(path) is None
    rows = check_rows()[:2]
    rows[1]["begun_utc"] = rows[0]["begun_utc"]
    write_checks(path, rows, CASES)
    assert drift_of(path) is None


def write_table(folder: Path) -> Path:
    """Six cases: two wrong ones, one of which has no size, and two without an answer."""
    path = folder / "cases.parquet"
    table = {
        "case": [4, 0, 2, 1, 5, 3],
        "order": [0, 1, 2, 3, 4, 5],
        "begun_utc": [f"2026-11-29T20:00:0{k}Z" for k in range(6)],
        "status": ["done", NO_ANSWER, "done", "done", NO_ANSWER, "done"],
        "wrong": [2, 0, None, 1, 0, 3],
        "wrong_deg": [12.345, None, None, None, None, 90.5],
    }
    pq.write_table(pa.table(table), path)
    return path


def test_wrong_answers_are_named_by_case_order_and_size(tmp_path: Path) -> None:
    summary = bench_summary(write_table(tmp_path))
    assert summary["no_answer"] == 2
    assert summary["drift"] is None
    assert summary["wrong_cases"] == [
        {"case": 4, "order": 0, "begun_utc": "2026-11-29T20:00:00Z", "wrong": 2, "off_deg": 12.345},
        {"case": 3, "order": 5, "begun_utc": "2026-11-29T20:00:05Z", "wrong": 3, "off_deg": 90.5},
    ]
    with (tmp_path / "wrong.csv").open(newline="") as file:
        rows = list(csv.reader(file))
    assert rows == [
        ["case", "order", "begun_utc", "wrong", "off_deg"],
        ["4", "0", "2026-11-29T20:00:00Z", "2", "12.345"],
        ["3", "5", "2026-11-29T20:00:05Z", "3", "90.5"],
    ]
    write_checks(tmp_path / "checks.csv", check_rows(), CASES)
    assert bench_summary(tmp_path / "cases.parquet")["drift"]["checks"] == 4


def test_lines_say_what_the_summary_holds() -> None:
    wrong = [{"case": k, "off_deg": 1.25 + k} for k in range(11)]
    drift = {
        "arcsec": [1.5, -2.25, 30.0],
        "sigma_arcsec": [0.25, 0.5, None],
        "mag": -0.4,
        "sigma_mag": 0.02,
        "checks": 5,
    }
    summary: dict[str, Any] = {"no_answer": 3, "wrong_cases": wrong, "drift": drift}
    silent, named, drifted = bench_lines(summary)
    assert silent == "3 cases without an answer"
    assert named.startswith("wrong answers in 11 cases: case 0 by 1.25 deg, case 1 by 2.25 deg,")
    assert named.endswith("case 9 by 10.2 deg, ...")
    assert " ".join(drifted.split()) == (
        "drift of the bench 1.5 +- 0.25, -2.25 +- 0.5, 30 arcsec about x, y, z, -0.4 +- 0.02 mag,"
        " by 5 check cases"
    )
    assert bench_lines({"no_answer": 0, "wrong_cases": wrong[:10], "drift": None}) == [
        named.replace("11 cases", "10 cases").removesuffix(", ...")
    ]
    assert " mag" not in bench_lines(summary | {"drift": drift | {"mag": None}})[2]


def order_of(folder: Path, *vary: dict[str, Any], **keys: Any) -> BenchOrder:
    """The order of seven cases."""
    path = write_campaign(folder, *vary, through="bench", cases=CASES, **keys)
    plan, file = parse_plan(path, path.read_text()), read_bench_file(folder / "bench.toml")
    maker = CaseMaker(plan, file, folder)
    values = [1] * len(maker.parameters)
    design = Design("sobol", plan.seed, CASES, maker.attitude_dimensions, values)
    return BenchOrder(plan, CASES, maker, design)


def test_check_cases_stand_before_every_third_case_and_at_the_end(tmp_path: Path) -> None:
    order = order_of(tmp_path, {"key": "time_s", "values": [0.0]}, check_every=3)
    assert order.checks == 4
    turns = list(order.turns())
    shown = [number for _, number, _ in turns]
    cases = [number for number in shown if number < CASES]
    assert sorted(cases) == list(range(CASES))
    assert cases == order.order.tolist()
    a, b, c, d, e, f, g = cases
    assert shown == [7, a, b, c, 8, d, e, f, 9, g, 10]
    assert [place for _, _, place in turns] == [0, 0, 1, 2, 3, 3, 4, 5, 6, 6, 7]
    still = order.case(8)
    assert still.first.q_icrs_to_cam.tolist() == order.case(0).first.q_icrs_to_cam.tolist()
    assert not np.any(still.first.turn.rate_cam_rad_s)


def test_without_check_cases_there_are_the_cases_alone_and_renderers_stand_together(
    tmp_path: Path,
) -> None:
    key = "sky.faintest_v_mag"
    order = order_of(tmp_path, {"key": key, "values": [5.0, 6.0, 7.0]})
    assert order.checks == 0
    turns = list(order.turns())
    assert sorted(number for _, number, _ in turns) == list(range(CASES))
    renderers = [renderer for renderer, _, _ in turns]
    changes = sum(renderers[k] != renderers[k - 1] for k in range(1, CASES))
    assert changes == len(set(renderers)) - 1 > 0
    for renderer, number, _ in turns:
        assert renderer == f"[{order.case(number).values[key]}]"


def test_cases_of_one_scenario_stand_together(tmp_path: Path) -> None:
    (tmp_path / "dark.toml").write_text(
        '[[fault]]\nname = "dark"\nkind = "blank"\nat_s = 0.5\nfor_s = 0.5\n'
    )
    order = order_of(tmp_path, {"key": "scenario", "values": ["", "dark.toml"]})
    renderers = [renderer for renderer, _, _ in order.turns()]
    assert len(set(renderers)) == 2
    changes = sum(renderers[k] != renderers[k - 1] for k in range(1, CASES))
    assert changes == 1
    for renderer, number, _ in order.turns():
        assert ("dark.toml" in renderer) == ("dark.toml" in str(order.case(number).values))
