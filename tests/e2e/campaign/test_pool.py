"""The pool: the same table whoever runs it, whatever is killed, and with cases that fail."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from pathlib import Path

import pytest

from tests.support.campaigns import read_columns, rows_so_far, write_campaign
from tests.support.commands import HILSTAR, assert_refused, run_hilstar_here
from tests.support.forks import Started
from tests.support.servers import workers_of
from tests.support.undrawn import charts_left_out
from tests.support.waiting import PATIENCE_S, wait_for

# Slow enough to be killed in its middle; its answer, and the images that it fails over, are those
# of the pixels alone.
SOLVER = """
import time
from pathlib import Path
def solve(image, tracker):
    time.sleep(0.4 if Path(__file__).with_name("slow").exists() else 0.0)
    if int(image.sum()) % 5 == 0:
        raise ValueError(f"not this one: {int(image.sum())}")
    return None if int(image.sum()) % 7 == 0 else [1.0, 0.0, 0.0, 0.0]
"""
OPTIONS = ("--solver", "python:sleepy:solve", "--json")


@pytest.fixture
def pool_folder(tmp_path: Path) -> Path:
    write_campaign(tmp_path)
    (tmp_path / "sleepy.py").write_text(SOLVER)
    return tmp_path


def start(pool_folder: Path, workers: int) -> subprocess.Popen[str]:
    command = [*HILSTAR, "campaign", "plan.toml", "-o", "out", "--workers", str(workers), *OPTIONS]
    pipe = subprocess.PIPE
    return Started(
        command, cwd=pool_folder, stdout=pipe, stderr=pipe, text=True, start_new_session=True
    )


def runs(pid: int) -> bool:
    """Whether a process is there, and no zombie that waits for its new parent."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(") ")[2][0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.usefixtures("without_charts")
def test_the_table_is_the_same_after_every_kind_of_end_and_with_cases_that_fail(
    pool_folder: Path,
) -> None:
    whole = run_hilstar_here(
        "campaign", "plan.toml", "-o", "whole", "--workers", "2", *OPTIONS, cwd=pool_folder
    )
    assert whole.returncode == 0, whole.stderr
    wanted = json.loads(whole.stdout)

    (pool_folder / "slow").touch()
    stopped = start(pool_folder, 1)  # Ctrl-C
    wait_for(lambda: rows_so_far(pool_folder) >= 3)
    stopped.send_signal(signal.SIGINT)
    _, err = stopped.communicate(timeout=PATIENCE_S)
    assert stopped.returncode == 130 and "the same command goes on" in err, err
    after_stop = rows_so_far(pool_folder)
    assert 3 <= after_stop < 30

    killed = start(pool_folder, 2)  # a worker, then the driver itself
    wait_for(lambda: rows_so_far(pool_folder) > after_stop + 1)
    second = run_hilstar_here("campaign", "plan.toml", "-o", "out", *OPTIONS[:2], cwd=pool_folder)
    assert_refused(second, 2, "another campaign is running")
    victims = workers_of(killed)
    os.kill(victims[0], signal.SIGKILL)
    after_kill = rows_so_far(pool_folder)
    wait_for(lambda: rows_so_far(pool_folder) > after_kill + 2)
    left = workers_of(killed)
    assert victims[0] not in left
    os.kill(killed.pid, signal.SIGKILL)
    killed.communicate()
    wait_for(lambda: not any(runs(pid) for pid in left), "workers outlive their driver")
    after_both = rows_so_far(pool_folder)

    (pool_folder / "slow").unlink()
    last = run_hilstar_here(
        "campaign", "plan.toml", "-o", "out", "--workers", "1", *OPTIONS, cwd=pool_folder
    )
    assert last.returncode == 0, last.stderr
    summary = json.loads(last.stdout)
    assert after_both < 30 and summary["sha256"] == wanted["sha256"]
    assert (pool_folder / "out" / "cases.parquet").read_bytes() == (
        pool_folder / "whole" / "cases.parquet"
    ).read_bytes()

    columns = read_columns(pool_folder / "out" / "cases.parquet")
    assert columns["case"] == list(range(30))
    failed = [
        why
        for why, status in zip(columns["why"], columns["status"], strict=True)
        if status == "failed"
    ]
    assert (
        failed
        and len(failed) == summary["failed"]
        and all("ValueError: not this one" in why for why in failed)
    )
    assert all(
        why == "the solver found no attitude" for why in columns["why"] if why and why not in failed
    )


def test_another_plan_and_a_budget_that_is_too_small_are_refused(pool_folder: Path) -> None:
    short = run_hilstar_here(
        "campaign", "plan.toml", "-o", "out", "--memory", "1MB", *OPTIONS[:2], cwd=pool_folder
    )
    last = short.stderr.splitlines()[-1]  # a busy machine has told its progress before
    assert (
        (short.returncode, short.stdout) == (2, "") and "--memory" in last and "or more" in last
    ), short.stderr
    before = rows_so_far(pool_folder)
    write_campaign(pool_folder, seed=8)
    other = run_hilstar_here("campaign", "plan.toml", "-o", "out", *OPTIONS[:2], cwd=pool_folder)
    assert_refused(other, 2, "seed was 7 and is 8")
    assert rows_so_far(pool_folder) == before == 1


REQUIRE = """
[[require]]
quantity = "noise"
maximum = {0}
condition = "rate_deg_s.across <= 0.5"
[[require]]
quantity = "availability"
minimum = 0.999
confidence = 0.9
"""
ALL_COLUMNS = "quantity,axis,condition,limit,bound,confidence,cases,verdict"


def test_requirements_are_judged_and_judged_again_without_running_a_case(tmp_path: Path) -> None:
    plan = write_campaign(tmp_path, cases=64)
    text = plan.read_text()
    command = ("campaign", "plan.toml", "-o", "out", "--workers", "1", "--strict")
    plan.write_text(text + REQUIRE.format(1000.0))
    result = run_hilstar_here(*command, "--json", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    noise, availability = json.loads(result.stdout)["requirements"]
    assert noise["verdict"] == "met" and noise["axis"] == "cross" and 30 <= noise["cases"] < 64
    assert availability["verdict"] == "not shown" and availability["more_cases"] > 1000
    header, *rows = (tmp_path / "out" / "requirements.csv").read_text().splitlines()
    assert header == ALL_COLUMNS and len(rows) == 2
    assert rows[0].startswith("noise,cross,rate_deg_s.across <= 0.5,1000.0,") and rows[0].endswith(
        ",met"
    )
    assert rows[1].startswith("availability,,,0.999,") and rows[1].endswith(",0.9,64,not shown")
    page = (tmp_path / "out" / "requirements.html").read_text()
    assert all(words in page for words in ("Signature", "not shown", "data:image/svg+xml;base64,"))
    assert "http" not in page.replace("http://www.w3.org", "")
    whole = (tmp_path / "out" / "campaign.html").read_text()
    assert "Campaign of 64 cases" in whole and "<h2>Budget</h2>" in whole
    assert 'data-state="ok"><div><strong>The tracker was right in 100 % of the frames' in whole
    table = (tmp_path / "out" / "cases.parquet").read_bytes()
    plan.write_text(text + REQUIRE.format(0.001))  # another limit is no other campaign
    with charts_left_out():
        again = run_hilstar_here(*command, cwd=tmp_path)
    assert (
        again.returncode == 1
        and "noise cross at most 0.001 arcsec where rate_deg_s.across <= 0.5: not met"
        in again.stdout
    )
    assert (tmp_path / "out" / "cases.parquet").read_bytes() == table
    plan.write_text(text + REQUIRE.format(1.0).replace("rate_deg_s", "speed"))
    assert_refused(
        run_hilstar_here(*command, cwd=tmp_path), 2, "speed.across is no key that the plan varies"
    )
