"""A campaign before a real tracker: a stub of it in a process of its own, over UDP, with planted
errors.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import asdict, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hilstar.basics.rotation import from_radec_roll_deg
from tests.support.benches import ROOT, bench_text
from tests.support.campaign_tracker import FOCAL_PX, WAVE_PX, Planted, wave
from tests.support.campaigns import plan_text, read_columns, rows_so_far
from tests.support.commands import assert_refused, run_hilstar_here
from tests.support.forks import HILSTAR, Started
from tests.support.senders import free_port
from tests.support.waiting import PATIENCE_S, wait_for

pytestmark = [pytest.mark.e2e, pytest.mark.usefixtures("without_charts")]
FIELD = {"kind": "field", "radec_deg": [80.0, 20.0], "radius_deg": 1.5, "roll_deg": [0.0, 0.0]}
CASES, CHECK_EVERY = 200, 40
# The rms of 400 values, two axes a case, has a sigma of 3.5 %, and that of 200 one of 5 %: 3.5 sigmas.
CROSS_SHARE, ROLL_SHARE = 0.125, 0.175
COMMAND = ("campaign", "plan.toml", "-o", "out", "--headless", "--json")


def write_bench(folder: Path, *vary: dict[str, Any], **keys: Any) -> Planted:
    """Bench and plan in a folder, and the tracker that answers there."""
    port = free_port()
    planted = Planted(str(folder / "out" / "now.json"), port)
    tracker = {"focal_length_mm": FOCAL_PX * 13e-3, "exposure_s": planted.exposure_s}
    answers = {"source": "udp", "bind": f"127.0.0.1:{port}", "format": "json", "clock": "host"}
    tables = {"tracker": tracker, "monitor": {"refresh_hz": 100.0}, "answers": answers}
    (folder / "bench.toml").write_text(bench_text(tables))
    plan = {"through": "bench", "answers": 1, "timeout_s": 1.0, "attitudes": FIELD} | keys
    (folder / "plan.toml").write_text(plan_text(*vary, **plan))
    return planted


@contextlib.contextmanager
def answering(planted: Planted) -> Iterator[subprocess.Popen[str]]:
    """The tracker while this is open; what it prints comes once its input is closed."""
    command = [sys.executable, "-m", "tests.support.campaign_tracker", json.dumps(asdict(planted))]
    with Started(
        command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def test_the_planted_budget_of_200_cases_is_found_and_wild_answers_are_named(
    tmp_path: Path,
) -> None:
    bench = write_bench(tmp_path, cases=CASES, check_every=CHECK_EVERY)
    # of 200 answers three hundredths are none once in 440 runs, eight once in 17 million
    planted = replace(bench, drift_arcsec_s=0.02, dim_mag_s=0.002, wild=0.08)
    with answering(planted) as tracker:
        result = run_hilstar_here(*COMMAND, cwd=tmp_path)
        assert result.returncode == 0, result.stderr
        wild, _ = tracker.communicate()
    found, rows = json.loads(result.stdout), read_columns(tmp_path / "out" / "cases.parquet")
    assert (
        sorted(rows["order"]) == rows["case"] == list(range(CASES))
        and rows["order"] != rows["case"]
    )
    # A machine that stands still tells the stub late what is lit: its answer is then of the case
    # before.
    before = dict(zip(rows["order"], rows["case"], strict=True))
    for each in found["wrong_cases"]:
        assert {
            each["case"],
            before.get(each["order"] - 1),
            CASES + each["order"] // CHECK_EVERY,
        } & set(json.loads(wild))
    assert found["wrong"] > 0
    assert all(each["off_deg"] > 10 for each in found["wrong_cases"])
    q = np.stack([rows[f"q{name}"] for name in "wxyz"], axis=1)
    fov = planted.fov_arcsec * wave(q, WAVE_PX)
    assert found["fov_arcsec"]["cross"] == pytest.approx(np.sqrt(fov.var(axis=0).mean()), rel=0.1)
    assert found["pixel_arcsec"]["cross"] == pytest.approx(planted.pixel_arcsec, rel=CROSS_SHARE)
    noise = found["noise_arcsec"]
    assert noise["cross"] == pytest.approx(planted.noise_arcsec[0], rel=CROSS_SHARE)
    assert noise["roll"] == pytest.approx(planted.noise_arcsec[2], rel=ROLL_SHARE)
    # The drift over the campaign's seconds is a part of the bias: half an arcsec, and four errors
    # of a mean of 200.
    error = np.array(found["bias_arcsec"]) - planted.bias_arcsec - [*fov.mean(axis=0), 0.0]
    assert np.all(np.abs(error) < 0.5 + 4 * np.array([7.5, 7.5, 12.0]) / np.sqrt(CASES))
    drift = found["drift"]
    assert (
        drift["checks"] == 6
        and drift["mag"] > 0.002
        and drift["mag"] == pytest.approx(0.002 * seconds(tmp_path), rel=0.1)
    )


def seconds(folder: Path) -> float:
    """The time from the first check case to the last."""
    lines = [
        line.split(",")[1] for line in (folder / "out" / "checks.csv").read_text().splitlines()[1:]
    ]
    return float(
        (np.datetime64(lines[-1][:-1]) - np.datetime64(lines[0][:-1])) / np.timedelta64(1, "s")
    )


def started(folder: Path) -> subprocess.Popen[str]:
    return Started(
        [*HILSTAR, *COMMAND], cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def reached(folder: Path, goal: int, hilstar: subprocess.Popen[str]) -> bool:
    return rows_so_far(folder) >= goal or hilstar.poll() is not None


def killed_once(folder: Path, planted: Planted, kills: int, cases: int) -> dict[str, Any]:
    """The table of a campaign in which hilstar and the tracker are killed in turn, `kills` times
    together.
    """
    rng = np.random.default_rng(5)
    with contextlib.ExitStack() as trackers:
        tracker, hilstar = trackers.enter_context(answering(planted)), started(folder)
        for kill in range(kills):
            goal = rows_so_far(folder) + int(rng.integers(1, max(2, cases // kills)))
            wait_for(partial(reached, folder, goal, hilstar))
            assert hilstar.poll() is None, hilstar.communicate()
            if kill % 2 == 0:
                hilstar.kill()
                hilstar.communicate()
                hilstar = started(folder)
            else:
                tracker.kill()
                tracker.wait()
                tracker = trackers.enter_context(answering(planted))
        _, said = hilstar.communicate(timeout=PATIENCE_S)
    assert hilstar.returncode == 0, said
    return read_columns(folder / "out" / "cases.parquet")


KILLS = int(os.environ.get("HILSTAR_TEST_KILLS", "2"))


def test_a_campaign_that_is_killed_on_either_side_has_the_same_cases_attitudes_and_order(
    tmp_path: Path,
) -> None:
    tables = []
    for name, kills in (("whole", 0), ("killed", KILLS)):
        folder = tmp_path / name
        folder.mkdir()
        planted = write_bench(folder, cases=16, answers=2, check_every=7)
        tables.append(killed_once(folder, planted, kills, 16))
    whole, killed = tables
    for column in ("case", "order", "status", *(f"q{name}" for name in "wxyz")):
        assert killed[column] == whole[column]
    assert set(killed["status"]) == {"done"} and sorted(killed["order"]) == list(range(16))
    assert len(set(killed["run"])) == 1 + (KILLS + 1) // 2
    by_order = sorted(zip(killed["order"], killed["run"], killed["begun_utc"], strict=True))
    assert [run for _, run, _ in by_order] == sorted(killed["run"]) and [
        at for *_, at in by_order
    ] == sorted(killed["begun_utc"])


def test_a_case_without_answers_is_a_result_and_a_first_attitude_has_its_time(
    tmp_path: Path,
) -> None:
    planted = replace(
        write_bench(tmp_path, cases=6, answers=3, timeout_s=0.5, silent_s=0.0, blank_s=0.05),
        blind=(2, 4),
        wild=0.0,
    )
    with answering(planted):
        result = run_hilstar_here(*COMMAND, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    rows = read_columns(tmp_path / "out" / "cases.parquet")
    assert rows["status"] == ["done", "done", "no-answer", "done", "no-answer", "done"]
    assert (
        json.loads(result.stdout)["no_answer"] == 2
        and rows["why"][2] == "the tracker had no attitude"
    )
    assert (
        rows["received"][2] == 0
        and rows["first_attitude_s"][2] is None
        and rows["frames"] == [3] * 6
    )
    assert all(0 < rows["first_attitude_s"][case] < 0.5 for case in (0, 1, 3, 5))
    assert all(rows["scatter_z_arcsec"][case] > 0 for case in (0, 1, 3, 5))
    assert rows["solved"] == [3, 3, 0, 3, 0, 3]


def test_without_a_tracker_every_case_is_a_result(tmp_path: Path) -> None:
    write_bench(tmp_path, cases=3, timeout_s=0.1, silent_s=0.3)
    result = run_hilstar_here(*COMMAND, cwd=tmp_path)
    assert result.returncode == 0 and "the tracker is silent" in result.stderr
    assert read_columns(tmp_path / "out" / "cases.parquet")["status"] == ["no-answer"] * 3


def test_renderers_stand_together_and_cases_in_motion_have_the_error_of_where_they_were(
    tmp_path: Path,
) -> None:
    quantised = {"key": "render.quantisation", "values": ["round", "temporal"]}
    rate = {"key": "rate_deg_s.across", "minimum": 0.1, "maximum": 0.2}
    attitudes = FIELD | {"radius_deg": 0.5}
    planted = write_bench(
        tmp_path, quantised, rate, cases=8, answers=3, settle_s=0.5, attitudes=attitudes
    )
    planted = replace(
        planted, fov_arcsec=0.0, pixel_arcsec=0.0, noise_arcsec=(0.5, 0.5, 0.5), wild=0.0
    )
    with answering(planted):
        result = run_hilstar_here(
            *COMMAND, "--console", "127.0.0.1:0", "--feed", "tcp://127.0.0.1:0", cwd=tmp_path
        )
    assert result.returncode == 0, result.stderr
    assert (
        "the operator's page is at http://127.0.0.1:" in result.stderr
        and "frames: tcp://127.0.0.1:" in result.stderr
    )
    rows = read_columns(tmp_path / "out" / "cases.parquet")
    by_order = [
        value
        for _, value in sorted(zip(rows["order"], rows["vary.render.quantisation"], strict=True))
    ]
    assert sum(a != b for a, b in pairwise(by_order)) == 1
    error = np.stack([rows[f"error_{axis}_arcsec"] for axis in "xyz"], axis=1) - planted.bias_arcsec
    # A frame that is late by its 10 ms is off by 7 arcsec, and after half a second a case has gone
    # on by 180 and more.
    assert np.median(np.abs(error[:, :2])) < 10 and np.abs(error[:, :2]).max() < 90


def test_late_answers_of_the_case_before_are_neither_s_on_a_clock_of_its_own(
    tmp_path: Path,
) -> None:
    # The latency is three times what is guessed of a tracker whose clock is its own.
    planted = replace(write_bench(tmp_path, cases=8), latency_s=0.3, answer_hz=3.0, wild=0.0)
    bench = tmp_path / "bench.toml"
    bench.write_text(bench.read_text().replace('clock = "host"\n', ""))
    with answering(planted):
        result = run_hilstar_here(*COMMAND, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    rows = read_columns(tmp_path / "out" / "cases.parquet")
    assert rows["status"] == ["done"] * 8 and rows["wrong"] == [0] * 8
    assert min(rows["first_attitude_s"]) > 0.3
    assert max(abs(error - planted.bias_arcsec[0]) for error in rows["error_x_arcsec"]) < 40


def test_a_case_goes_along_a_log(tmp_path: Path) -> None:
    # 0.1 deg/s, 340 arcsec/s across
    turning = [from_radec_roll_deg(80 + 0.01 * k, 20.0, 0.0).tolist() for k in range(300)]
    lines = ["t_s,qw,qx,qy,qz", *(",".join(map(repr, [k / 10, *q])) for k, q in enumerate(turning))]
    (tmp_path / "log.csv").write_text("\n".join(lines) + "\n")
    attitudes = {"kind": "log", "log": "log.csv"}
    planted = replace(
        write_bench(tmp_path, cases=5, answers=3, settle_s=0.2, attitudes=attitudes), wild=0.0
    )
    with answering(replace(planted, fov_arcsec=0.0, pixel_arcsec=0.0)):
        result = run_hilstar_here(*COMMAND, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    rows = read_columns(tmp_path / "out" / "cases.parquet")
    error = (
        np.stack([rows[f"error_{axis}_arcsec"] for axis in "xy"], axis=1) - planted.bias_arcsec[:2]
    )
    # 0.2 s after its begin a case that stood still would be off by 70
    assert np.median(np.abs(error)) < 15


def test_a_case_with_faults_has_its_time_to_recover(tmp_path: Path) -> None:
    (tmp_path / "faults.toml").write_text(
        '[[fault]]\nkind = "blank"\nname = "dark"\nat_s = 0.0\nfor_s = 0.3\n'
    )
    scenario = {"key": "scenario", "values": ["faults.toml", ""]}
    planted = replace(
        write_bench(tmp_path, scenario, cases=6, sampling="grid", answers=2), wild=0.0
    )
    with answering(planted):
        result = run_hilstar_here(*COMMAND, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    rows = read_columns(tmp_path / "out" / "cases.parquet")
    for named, end_s, recovery_s, first_s in zip(
        *(
            rows[name]
            for name in ("vary.scenario", "fault_end_s", "recovery_s", "first_attitude_s")
        ),
        strict=True,
    ):
        assert end_s == (pytest.approx(0.3) if named else None)
        assert (0 <= recovery_s < 0.3 and first_s > 0.3) if named else recovery_s is None


@pytest.mark.parametrize(
    ("vary", "keys", "words"),
    [
        (
            {"key": "tracker.focal_length_mm", "values": [25, 26]},
            {},
            "cannot be changed on a real bench",
        ),
        (
            {"key": "misalignment_arcsec.x", "values": [0, 10]},
            {},
            "cannot be changed on a real bench",
        ),
        ({"key": "noise_seed", "values": [1, 2]}, {}, "cannot be changed on a real bench"),
        (None, {"frames": 3}, "frames: is for through"),
        (None, {"through": "tracker"}, "answers: is for through"),
    ],
)
def test_what_a_bench_cannot_do_is_refused_before_the_first_case(
    tmp_path: Path, vary: dict[str, Any] | None, keys: dict[str, Any], words: str
) -> None:
    write_bench(tmp_path, *([] if vary is None else [vary]), cases=4, **keys)
    assert_refused(run_hilstar_here(*COMMAND, cwd=tmp_path), 2, words)
    assert not (tmp_path / "out").exists() or not list((tmp_path / "out").glob("journal/*"))


def test_a_bench_without_answers_is_refused(tmp_path: Path) -> None:
    write_bench(tmp_path, cases=4)
    text = (tmp_path / "bench.toml").read_text()
    (tmp_path / "bench.toml").write_text(text[: text.index("[answers]")])
    assert_refused(
        run_hilstar_here(*COMMAND, cwd=tmp_path), 2, "needs the tracker's answers", "[answers]"
    )
