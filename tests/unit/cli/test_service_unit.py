"""The unit that `hilstar service install` writes: what systemd would run, and what is refused."""

from __future__ import annotations

import shlex
import shutil
import stat
import subprocess

import pytest

from tests.support.benches import SMALL_BENCH
from tests.support.commands import assert_refused, run_hilstar_here
from tests.support.waiting import PATIENCE_S


@pytest.fixture
def bench(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.delenv("HILSTAR_TOKEN", raising=False)
    (tmp_path / "room 7.toml").write_text(SMALL_BENCH)
    return tmp_path / "room 7.toml"


def install(bench, *words: str):
    return run_hilstar_here("service", "install", bench, "--name", "room7", *words, cwd=bench.parent)


def keys_of(text: str) -> dict[str, str]:
    return dict(line.split("=", 1) for line in text.splitlines() if "=" in line and not line.startswith("#"))


def test_the_unit_serves_the_bench_and_is_watched_and_started_again(bench):
    result = install(bench, "--", "--console", "--ledger", "a b$c%d-{utc}.mcap")
    assert result.returncode == 0, result.stderr
    path = bench.parent / "config" / "systemd" / "user" / "hilstar-room7.service"
    assert result.stdout == f"{path}\n"
    keys = keys_of(path.read_text())
    # As systemd reads it: $$ is $, %% is %.
    words = shlex.split(keys["ExecStart"].replace("$$", "$").replace("%%", "%"))
    assert words[-5:] == [str(bench), "--console", "127.0.0.1:8765", "--ledger", "a b$c%d-{utc}.mcap"]
    assert (keys["Type"], keys["Restart"], keys["WatchdogSec"]) == ("notify", "always", "3")
    assert not path.with_suffix(".env").exists()
    assert_refused(install(bench), 2, "hilstar-room7.service", "--overwrite")
    assert install(bench, "--overwrite").returncode == 0


def test_beyond_loopback_its_token_is_in_a_file_of_its_own(bench):
    result = install(bench, "--", "--console", "0.0.0.0:8765")
    tokens = bench.parent / "config" / "systemd" / "user" / "hilstar-room7.env"
    assert str(tokens) in result.stderr and stat.S_IMODE(tokens.stat().st_mode) == 0o600
    token = tokens.read_text().removeprefix("HILSTAR_TOKEN=").strip()
    assert len(token) >= 40
    assert token not in result.stderr + result.stdout + tokens.with_suffix(".service").read_text()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--", "--nonsense"), "--nonsense"),
        (("--", "--console", "127.0.0.1:99999"), "99999"),
        (("--", "--console", "--token", "abcdefghijklmnopqrst"), "HILSTAR_TOKEN"),
        (("--", "--ledger", "run.mcap"), "{utc}"),
        (("--name", "../x"), "--name"),
    ],
)
def test_what_would_not_start_is_refused(bench, words, said):
    assert_refused(install(bench, *words), 2, said)


def test_systemd_takes_the_unit(bench, tmp_path, monkeypatch):
    assert install(bench, "--", "--console", "--ledger", "$x%y-{utc}.mcap").returncode == 0
    analyze = shutil.which("systemd-analyze")
    if analyze is None:
        return
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    path = tmp_path / "config" / "systemd" / "user" / "hilstar-room7.service"
    verified = subprocess.run(
        [analyze, "--user", "verify", str(path)], capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )
    assert "hilstar-room7" not in verified.stderr, verified.stderr
