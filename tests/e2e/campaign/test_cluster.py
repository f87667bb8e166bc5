"""A cluster: a scheduler and workers started from outside, one of another version, one killed,
and the driver killed.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import hilstar
from hilstar.instruments.campaign import cluster
from tests.support.benches import ROOT
from tests.support.campaigns import read_columns, rows_so_far, write_campaign
from tests.support.commands import HILSTAR, assert_refused, run_hilstar_here, run_started
from tests.support.forks import Started
from tests.support.undrawn import charts_left_out
from tests.support.waiting import PATIENCE_S, wait_for

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
FETCH = """
import os, signal, sys
import distributed
from hilstar.instruments.campaign import cluster
cluster.FETCH_S = 1.0
with distributed.Client(sys.argv[1]) as client:
    client.wait_for_workers(1)
    future = client.submit(sum, (1, 2), workers=list(client.scheduler_info()["workers"]))
    distributed.wait(future)
    os.kill(int(sys.argv[2]), signal.SIGKILL)
    print(future.status, cluster._fetched(future))
"""
WORKER = ("--nthreads", "1", "--no-nanny", "--no-dashboard", "--death-timeout", "60")
OPTIONS = ("--solver", "python:sleepy:solve", "--json")

pytestmark = pytest.mark.usefixtures("without_charts")


@contextlib.contextmanager
def dask_program(
    folder: Path, log: str, *words: str, **env: str
) -> Iterator[subprocess.Popen[bytes]]:
    """A program of Dask's, whose log goes to a file, until the end of this."""
    with (folder / log).open("wb") as out:
        process = Started(
            [*DASK, *words],
            cwd=folder,
            stdout=out,
            stderr=out,
            env=os.environ | env,
            start_new_session=True,
        )
    try:
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def other_version(folder: Path) -> Path:
    """A folder to import another hilstar from: the same but for its version."""
    package, basics = Path(hilstar.__file__).parent, Path("basics")
    (folder / "other" / "hilstar" / basics).mkdir(parents=True)
    for entry in [*package.iterdir(), *(package / basics).iterdir()]:
        copy = folder / "other" / "hilstar" / entry.relative_to(package)
        if entry.name == "version.py":
            copy.write_text(
                re.sub(r'__version__ = ".*"', '__version__ = "99.0"', entry.read_text())
            )
        elif entry.name not in {"__pycache__", basics.name}:
            copy.symlink_to(entry)
    for name in ("shaders", "configs"):
        (folder / "other" / name).symlink_to(ROOT / name)
    return folder / "other"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_campaign(tmp_path, cases=24)
    (tmp_path / "sleepy.py").write_text(SOLVER)
    (tmp_path / "slow").touch()
    return tmp_path


@pytest.fixture(scope="module")
def pool_table(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The table that a pool makes of the same plan."""
    folder = tmp_path_factory.mktemp("pool")
    write_campaign(folder, cases=24)
    (folder / "sleepy.py").write_text(SOLVER)
    with charts_left_out():
        result = run_hilstar_here(
            "campaign", "plan.toml", "-o", "pool", "--workers", "1", *OPTIONS, cwd=folder
        )
    assert result.returncode == 0, result.stderr
    return (folder / "pool/cases.parquet").read_bytes()


@contextlib.contextmanager
def scheduler(
    folder: Path, port: str = "0", *more: str
) -> Iterator[tuple[subprocess.Popen[bytes], str]]:
    """A scheduler and its address, once it listens there."""
    file = folder / "scheduler.json"
    file.unlink(missing_ok=True)
    where = more or ("--host", "127.0.0.1")
    start = ("scheduler", "--port", port, "--no-dashboard", "--scheduler-file", file.name, *where)
    with dask_program(folder, "scheduler.log", *start) as process:
        wait_for(lambda: file.exists() and file.stat().st_size, "no scheduler")
        yield process, json.loads(file.read_text())["address"]


def driver_of(folder: Path, address: str) -> subprocess.Popen[bytes]:
    command = [*HILSTAR, "campaign", "plan.toml", "-o", "out", "--scheduler", address, *OPTIONS]
    with (folder / "driver.log").open("wb") as log:
        return Started(command, cwd=folder, stdout=log, stderr=log)


def test_a_cluster_gives_the_pools_table_though_a_worker_and_the_driver_are_killed(
    folder: Path, pool_table: bytes
) -> None:
    with contextlib.ExitStack() as stack:
        _, address = stack.enter_context(scheduler(folder))
        other = str(other_version(folder))
        stack.enter_context(
            dask_program(
                folder, "c.log", "worker", address, *WORKER, "--name", "other", PYTHONPATH=other
            )
        )
        driver = driver_of(folder, address)
        wait_for(
            lambda: "is refused" in (folder / "driver.log").read_text(),
            "the other version is not refused",
        )

        victim = stack.enter_context(dask_program(folder, "a.log", "worker", address, *WORKER))
        stack.enter_context(dask_program(folder, "b.log", "worker", address, *WORKER))
        wait_for(lambda: rows_so_far(folder) >= 3, "nothing comes")
        os.kill(victim.pid, signal.SIGKILL)
        after_kill = rows_so_far(folder)
        wait_for(
            lambda: rows_so_far(folder) > after_kill + 2, "nothing comes after a worker was killed"
        )
        driver.kill()
        driver.wait()
        (folder / "slow").unlink()
        assert rows_so_far(folder) < 24

        last = run_hilstar_here(
            "campaign", "plan.toml", "-o", "out", "--scheduler", address, *OPTIONS, cwd=folder
        )
    assert last.returncode == 0, last.stderr
    for said in ((folder / "driver.log").read_text(), last.stderr):
        assert re.search(
            r"worker tcp://\S+ is refused: it has hilstar 99.0, and the campaign is of"
            rf" {hilstar.__version__}",
            said,
        )
    assert (folder / "out/cases.parquet").read_bytes() == pool_table
    columns = read_columns(folder / "out/cases.parquet")
    assert columns["case"] == list(range(24)) and {"done", "failed"} == set(columns["status"])


def test_a_campaign_goes_on_when_its_scheduler_was_killed_and_is_started_again(
    folder: Path,
) -> None:
    with contextlib.ExitStack() as stack:
        process, address = stack.enter_context(scheduler(folder))
        stack.enter_context(dask_program(folder, "a.log", "worker", address, *WORKER))
        driver = driver_of(folder, address)
        wait_for(lambda: rows_so_far(folder) >= 3, "nothing comes")
        process.kill()
        process.wait()
        (folder / "slow").unlink()
        stack.enter_context(scheduler(folder, address.rpartition(":")[2]))
        stack.enter_context(dask_program(folder, "b.log", "worker", address, *WORKER))
        assert driver.wait(PATIENCE_S) == 0, (folder / "driver.log").read_text()
    assert read_columns(folder / "out/cases.parquet")["case"] == list(range(24))


def test_an_answer_that_died_with_its_worker_is_not_waited_for(folder: Path) -> None:
    """The scheduler would hand the task to that worker again, as soon as it is back."""
    with contextlib.ExitStack() as stack:
        _, address = stack.enter_context(scheduler(folder))
        worker = stack.enter_context(dask_program(folder, "a.log", "worker", address, *WORKER))
        command = [sys.executable, "-c", FETCH, address, str(worker.pid)]
        fetched = run_started(command)
    assert fetched.stdout == "finished None\n", fetched.stderr


def certificates(folder: Path, name: str) -> tuple[str, ...]:
    """A CA and a certificate of it, as options of Dask's and of the campaign's."""
    ca, key, cert, asked = (
        folder / f"{name}-{part}.pem" for part in ("ca", "key", "cert", "asked")
    )
    new = ["openssl", "req", "-newkey", "rsa:2048", "-nodes", "-subj", f"/CN={name}"]
    by_ca = ["-CA", str(ca), "-CAkey", f"{ca}.key", "-CAcreateserial", "-days", "2"]
    for command in (
        [
            *new,
            "-x509",
            "-days",
            "2",
            "-keyout",
            f"{ca}.key",
            "-out",
            str(ca),
            "-subj",
            f"/CN={name} CA",
        ],
        [*new, "-keyout", str(key), "-out", str(asked)],
        ["openssl", "x509", "-req", "-in", str(asked), "-out", str(cert), *by_ca],
    ):
        subprocess.run(command, check=True, capture_output=True)
    return "--tls-ca-file", str(ca), "--tls-cert", str(cert), "--tls-key", str(key)


@pytest.mark.skipif(shutil.which("openssl") is None, reason="the system has no openssl")
def test_a_cluster_with_dasks_tls_runs_a_campaign_and_takes_nobody_elses_certificate(
    folder: Path, monkeypatch: pytest.MonkeyPatch, pool_table: bytes
) -> None:
    (folder / "slow").unlink()
    ours, theirs = certificates(folder, "ours"), certificates(folder, "theirs")
    with contextlib.ExitStack() as stack:
        _, address = stack.enter_context(
            scheduler(folder, "0", "--host", "127.0.0.1", "--protocol", "tls", *ours)
        )
        assert address.startswith("tls://127.0.0.1:")
        stack.enter_context(
            dask_program(folder, "a.log", "worker", address, *WORKER, "--host", "127.0.0.1", *ours)
        )
        words = ("campaign", "plan.toml", "-o", "out", "--scheduler", address, *OPTIONS)
        monkeypatch.setattr(cluster, "CONNECT_S", 5.0)
        refused = run_hilstar_here(*words, *theirs, cwd=folder)
        assert_refused(refused, 3, "certificate")
        assert_refused(
            run_hilstar_here(*words, cwd=folder), 2, "no certificate is named", "--tls-ca-file"
        )
        monkeypatch.undo()
        result = run_hilstar_here(*words, *ours, cwd=folder)
    assert result.returncode == 0, result.stderr
    assert json.loads(result.stdout)["cases"] == 24
    assert (folder / "out/cases.parquet").read_bytes() == pool_table


TLS = ("--tls-ca-file", "plan.toml", "--tls-cert", "plan.toml")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            ["--scheduler", "tcp://192.0.2.1:8786"],
            ["non-loopback endpoints require TLS", "--tls-ca-file", "tcp://127.0.0.1:PORT"],
        ),
        (["--scheduler", "tcp://bench-pc:8786"], ["non-loopback endpoints require TLS"]),
        (["--scheduler", "ucx://[2001:db8::1]:8786"], ["non-loopback endpoints require TLS"]),
        (["--scheduler", "tcp://0.0.0.0:8786"], ["0.0.0.0"]),
        (["--scheduler", "tcp://192.0.2.1:8786", *TLS], ["not encrypted", "tls://HOST:PORT"]),
        (["--scheduler", "tls://192.0.2.1:8786", *TLS[:2]], ["--tls-cert is missing"]),
        (["--scheduler", "tls://192.0.2.1:8786", *TLS], ["plan.toml", "--tls-key"]),
        (
            [
                "--scheduler",
                "tls://192.0.2.1:8786",
                "--tls-ca-file",
                "none.pem",
                "--tls-cert",
                "none.pem",
            ],
            ["none.pem"],
        ),
        (["--scheduler", "tls://:1"], ["tls://:1"]),
        (["--scheduler", "tcp://127.0.0.1:99999"], ["99999"]),
        ([*TLS], ["--scheduler tls://HOST:PORT"]),
    ],
)
def test_code_runs_over_no_network_without_tls(
    folder: Path, words: list[str], said: list[str]
) -> None:
    assert_refused(
        run_hilstar_here("campaign", "plan.toml", "-o", "o", *words, cwd=folder), 2, *said
    )


def test_a_scheduler_on_loopback_that_listens_to_the_network_too_is_said(folder: Path) -> None:
    write_campaign(folder, cases=2)
    (folder / "slow").unlink()
    with contextlib.ExitStack() as stack:
        _, address = stack.enter_context(scheduler(folder, "0", "--protocol", "tcp"))
        if address.startswith("tcp://127."):
            pytest.skip("this machine has no other address than loopback's")
        here = f"tcp://127.0.0.1:{address.rpartition(':')[2]}"
        stack.enter_context(
            dask_program(folder, "a.log", "worker", here, *WORKER, "--host", "127.0.0.1")
        )
        result = run_hilstar_here(
            "campaign", "plan.toml", "-o", "out", "--scheduler", here, *OPTIONS, cwd=folder
        )
    assert result.returncode == 0, result.stderr
    assert f"the scheduler listens at {address} without TLS" in result.stderr


def test_no_scheduler_and_no_address_are_one_line(folder: Path) -> None:
    assert_refused(
        run_hilstar_here("campaign", "plan.toml", "-o", "o", "--scheduler", "here", cwd=folder),
        2,
        "tcp://HOST:PORT",
    )
    both = ("--scheduler", "tcp://127.0.0.1:9", "--workers", "2")
    assert_refused(
        run_hilstar_here("campaign", "plan.toml", "-o", "o", *both, cwd=folder), 2, "--workers"
    )
