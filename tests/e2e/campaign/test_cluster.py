"""A cluster: a scheduler and workers started from outside, one of another version, one killed, and the driver killed."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import hilstar
from hilstar.campaign.store.table import read_columns
from tests.support.benches import ROOT
from tests.support.campaigns import write_campaign
from tests.support.commands import HILSTAR, assert_refused, run_hilstar_here
from tests.support.waiting import wait_for

DASK = [sys.executable, "-m", "dask"]
SOLVER = """
import time
from pathlib import Path
def solve(image, tracker):
    time.sleep(0.4 if Path(__file__).with_name("slow").exists() else 0.0)
    if int(image.sum()) % 4 == 0:
        raise ValueError(f"not this one: {int(image.sum())}")
    return [1.0, 0.0, 0.0, 0.0]
"""
OPTIONS = ("--solver", "python:sleepy:solve", "--json")


@contextlib.contextmanager
def running(folder: Path, log: str, *words: str, **env: str) -> Iterator[subprocess.Popen[bytes]]:
    """A program of Dask's, whose log goes to a file, until the end of this."""
    with (folder / log).open("wb") as out:
        process = subprocess.Popen(
            [*DASK, *words], cwd=folder, stdout=out, stderr=out, env=os.environ | env, start_new_session=True
        )
    try:
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def other_version(folder: Path) -> Path:
    """A folder to import another hilstar from: the same but for its version."""
    (folder / "other" / "hilstar").mkdir(parents=True)
    for entry in Path(hilstar.__file__).parent.iterdir():
        if entry.name == "__init__.py":
            (folder / "other/hilstar/__init__.py").write_text(
                re.sub(r'__version__ = ".*"', '__version__ = "99.0"', entry.read_text())
            )
        elif entry.name != "__pycache__":
            (folder / "other" / "hilstar" / entry.name).symlink_to(entry)
    for name in ("shaders", "configs"):
        (folder / "other" / name).symlink_to(ROOT / name)
    return folder / "other"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_campaign(tmp_path, cases=24)
    (tmp_path / "sleepy.py").write_text(SOLVER)
    (tmp_path / "slow").touch()
    return tmp_path


def rows_so_far(folder: Path) -> int:
    return sum(path.read_bytes().count(b"\n") for path in (folder / "out" / "journal").glob("*.jsonl"))


def test_a_cluster_gives_the_pools_table_though_a_worker_and_the_driver_are_killed(folder: Path) -> None:
    worker = ("--nthreads", "1", "--no-nanny", "--no-dashboard", "--death-timeout", "60")
    with contextlib.ExitStack() as stack:
        start = ("scheduler", "--port", "0", "--host", "127.0.0.1", "--no-dashboard", "--scheduler-file", "scheduler.json")
        stack.enter_context(running(folder, "scheduler.log", *start))
        wait_for(lambda: (folder / "scheduler.json").exists() and (folder / "scheduler.json").stat().st_size, "no scheduler")
        address = json.loads((folder / "scheduler.json").read_text())["address"]
        victim = stack.enter_context(running(folder, "a.log", "worker", address, *worker))
        stack.enter_context(running(folder, "b.log", "worker", address, *worker))
        other = str(other_version(folder))
        stack.enter_context(running(folder, "c.log", "worker", address, *worker, "--name", "other", PYTHONPATH=other))

        command = [*HILSTAR, "campaign", "plan.toml", "-o", "out", "--scheduler", address, *OPTIONS]
        with (folder / "driver.log").open("wb") as log:
            driver = subprocess.Popen(command, cwd=folder, stdout=log, stderr=log)
        wait_for(lambda: "is refused" in (folder / "driver.log").read_text(), "the other version is not refused")
        wait_for(lambda: rows_so_far(folder) >= 3, "nothing comes")
        os.kill(victim.pid, signal.SIGKILL)
        after_kill = rows_so_far(folder)
        wait_for(lambda: rows_so_far(folder) > after_kill + 2, "nothing comes after a worker was killed")
        driver.kill()
        driver.wait()
        (folder / "slow").unlink()
        assert rows_so_far(folder) < 24

        last = run_hilstar_here("campaign", "plan.toml", "-o", "out", "--scheduler", address, *OPTIONS, cwd=folder)
    assert last.returncode == 0, last.stderr
    for said in ((folder / "driver.log").read_text(), last.stderr):
        assert re.search(
            rf"worker tcp://\S+ is refused: it has hilstar 99.0, and the campaign is of {hilstar.__version__}", said
        )
    pool = run_hilstar_here("campaign", "plan.toml", "-o", "pool", "--workers", "1", *OPTIONS, cwd=folder)
    assert (folder / "out/cases.parquet").read_bytes() == (folder / "pool/cases.parquet").read_bytes(), pool.stderr
    columns = read_columns(folder / "out/cases.parquet")
    assert columns["case"] == list(range(24)) and {"done", "failed"} == set(columns["status"])


def test_no_scheduler_and_no_address_are_one_line(folder: Path) -> None:
    assert_refused(
        run_hilstar_here("campaign", "plan.toml", "-o", "o", "--scheduler", "here", cwd=folder), 2, "tcp://HOST:PORT"
    )
    both = ("--scheduler", "tcp://127.0.0.1:9", "--workers", "2")
    assert_refused(run_hilstar_here("campaign", "plan.toml", "-o", "o", *both, cwd=folder), 2, "--workers")
