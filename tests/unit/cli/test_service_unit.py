"""The unit that `hilstar service install` writes: what systemd would run, and what is refused."""

from __future__ import annotations

import os
import pwd
import re
import shlex
import shutil
import stat
import subprocess
from pathlib import Path

import pytest

from hilstar.basics.errors import InputError
from hilstar.cli.service import unit_name, unit_text, units_folder, user_name
from tests.support.benches import SMALL_BENCH
from tests.support.commands import assert_refused, run_hilstar_here
from tests.support.waiting import PATIENCE_S


@pytest.fixture
def service_bench(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.delenv("HILSTAR_TOKEN", raising=False)
    # as on a bench PC, whatever container this is
    monkeypatch.setattr("hilstar.cli.service.can_confine", lambda: True)
    (tmp_path / "room 7.toml").write_text(SMALL_BENCH)
    return tmp_path / "room 7.toml"


def install(service_bench, *words: str):
    return run_hilstar_here(
        "service", "install", service_bench, "--name", "room7", *words, cwd=service_bench.parent
    )


def keys_of(text: str) -> dict[str, str]:
    return dict(
        line.split("=", 1) for line in text.splitlines() if "=" in line and not line.startswith("#")
    )


def as_systemd_reads(line: str) -> list[str]:
    """The words of a command line of a unit, in which $$ is $ and %% is %; one alone stands for
    something else.
    """
    single = line.replace("$$", "").replace("%%", "")
    assert "$" not in single
    assert "%" not in single
    return shlex.split(line.replace("$$", "$").replace("%%", "%"))


def test_the_unit_serves_the_bench_and_is_watched_and_started_again(service_bench):
    result = install(service_bench, "--", "--console", "--ledger", "a b$c%d-{utc}.mcap")
    assert result.returncode == 0, result.stderr
    path = service_bench.parent / "config" / "systemd" / "user" / "hilstar-room7.service"
    assert result.stdout == f"{path}\n"
    keys = keys_of(path.read_text())
    words = as_systemd_reads(keys["ExecStart"])
    assert words[-5:] == [
        str(service_bench),
        "--console",
        "127.0.0.1:8765",
        "--ledger",
        "a b$c%d-{utc}.mcap",
    ]
    assert (keys["Type"], keys["Restart"], keys["WatchdogSec"]) == ("notify", "always", "3")
    # what is wrong in the command or in a file is wrong the next time, too
    assert keys["RestartPreventExitStatus"] == str(InputError.exit_code)
    assert (keys["StartLimitIntervalSec"], keys["RestartSec"]) == ("0", "200ms")
    assert (keys["WorkingDirectory"], keys["UMask"]) == (str(service_bench.parent), "0027")
    assert not path.with_suffix(".env").exists()
    assert_refused(install(service_bench), 2, "hilstar-room7.service", "--overwrite")
    assert install(service_bench, "--overwrite").returncode == 0


def test_beyond_loopback_its_token_is_in_a_file_of_its_own(service_bench):
    result = install(service_bench, "--", "--console", "0.0.0.0:8765")
    tokens = service_bench.parent / "config" / "systemd" / "user" / "hilstar-room7.env"
    assert str(tokens) in result.stderr and stat.S_IMODE(tokens.stat().st_mode) == 0o600
    token = tokens.read_text().removeprefix("HILSTAR_TOKEN=").strip()
    assert len(token) >= 40
    assert token not in result.stderr + result.stdout + tokens.with_suffix(".service").read_text()
    again = install(service_bench, "--overwrite", "--", "--console", "0.0.0.0:8765")
    assert again.returncode == 0, again.stderr
    # a page that is open stays so
    assert tokens.read_text().removeprefix("HILSTAR_TOKEN=").strip() == token


def test_a_name_has_64_characters_at_most():
    assert unit_name("a" * 64) == f"hilstar-{'a' * 64}.service"
    with pytest.raises(InputError, match="write letters, digits"):
        unit_name("a" * 65)


@pytest.mark.parametrize("stated", [{}, {"XDG_CONFIG_HOME": ""}, {"XDG_CONFIG_HOME": "config"}])
def test_a_folder_of_settings_that_is_relative_is_none(stated):
    """As the XDG base directory specification has it."""
    assert units_folder(stated) == Path.home() / ".config" / "systemd" / "user"
    absolute = units_folder({"XDG_CONFIG_HOME": "/etc/of mine"})
    assert absolute == Path("/etc/of mine/systemd/user")


def test_a_user_of_a_container_has_a_number_for_a_name_and_may_have_no_home(monkeypatch):
    """As `docker run --user 1234` has it."""
    for name in ("LOGNAME", "USER", "LNAME", "USERNAME", "HOME"):
        monkeypatch.delenv(name, raising=False)

    def unknown(uid: int):
        raise KeyError(f"getpwuid(): uid not found: {uid}")

    monkeypatch.setattr(pwd, "getpwuid", unknown)
    assert user_name() == str(os.getuid())
    with pytest.raises(InputError, match=r"no home directory .* set HOME"):
        units_folder({})


def test_a_unit_has_the_displays_that_are_named_and_no_others(tmp_path):
    environment = {"DISPLAY": ":1", "XAUTHORITY": "", "WAYLAND_DISPLAY": "wayland $1", "HOME": "/"}
    text = unit_text(tmp_path / "u", tmp_path / "b.toml", [], environment=environment)
    named = [line for line in text.splitlines() if line.startswith("Environment=")]
    assert named == ["Environment=DISPLAY=:1", 'Environment="WAYLAND_DISPLAY=wayland $$1"']


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
def test_what_would_not_start_is_refused(service_bench, words, said):
    assert_refused(install(service_bench, *words), 2, said)


def test_systemd_takes_the_unit(service_bench, tmp_path, monkeypatch):
    assert install(service_bench, "--", "--console", "--ledger", "$x%y-{utc}.mcap").returncode == 0
    analyze = shutil.which("systemd-analyze")
    if analyze is None:
        return
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    path = tmp_path / "config" / "systemd" / "user" / "hilstar-room7.service"
    verified = subprocess.run(
        [analyze, "--user", "verify", str(path)],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert "hilstar-room7" not in verified.stderr, verified.stderr


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="no systemd here")
def test_the_unit_exposes_less_than_4_of_10(service_bench):
    assert install(service_bench, "--", "--console").returncode == 0
    path = service_bench.parent / "config" / "systemd" / "user" / "hilstar-room7.service"
    told = subprocess.run(
        ["systemd-analyze", "security", "--offline=true", "--no-pager", str(path)],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    found = re.search(r"Overall exposure level for \S+: ([\d.]+)", told.stdout)
    assert found is not None, told.stdout + told.stderr
    assert float(found[1]) < 4.0


def test_the_unit_takes_nothing_that_a_run_needs(service_bench):
    keys = keys_of(install(service_bench, "--print").stdout)
    # Devices (GPU, serial ports), /tmp (the X server's socket), real-time priority, OpenGL's
    # compiler, ledgers anywhere.
    for key in (
        "PrivateDevices",
        "DevicePolicy",
        "PrivateTmp",
        "RestrictRealtime",
        "MemoryDenyWriteExecute",
        "ProtectHome",
    ):
        assert key not in keys
    assert "@resources" not in keys["SystemCallFilter"]
    assert keys["NoNewPrivileges"] == "yes" and keys["CapabilityBoundingSet"] == ""


def test_where_users_have_no_namespace_the_unit_asks_for_none(service_bench, monkeypatch):
    monkeypatch.setattr("hilstar.cli.service.can_confine", lambda: False)
    result = install(service_bench, "--print")
    assert "the unit keeps the capabilities" in result.stderr
    keys = keys_of(result.stdout)
    assert "PrivateUsers" not in keys and "CapabilityBoundingSet" not in keys
    assert keys["NoNewPrivileges"] == "yes"


@pytest.mark.parametrize("name", ["room7", "hilstar-room7.service", "room7.toml"])
def test_what_was_installed_can_be_uninstalled(service_bench, name, monkeypatch):
    units = service_bench.parent / "config" / "systemd" / "user"
    done = install(service_bench, "--", "--console", "0.0.0.0:8765")
    assert f"loginctl enable-linger {user_name()}" in done.stderr
    (units / "mine.service").write_text("kept")
    asked = service_bench.parent / "asked.txt"
    (service_bench.parent / "systemctl").write_text(f"#!/bin/sh\necho $* >> '{asked}'\n")
    (service_bench.parent / "systemctl").chmod(0o755)
    monkeypatch.setenv("PATH", str(service_bench.parent), prepend=":")
    assert_refused(
        run_hilstar_here("service", "uninstall", "other"),
        2,
        "hilstar-other.service",
        "there is room7",
    )
    result = run_hilstar_here("service", "uninstall", name)
    assert (result.returncode, result.stdout) == (
        0,
        f"{units / 'hilstar-room7.service'}\n",
    ), result.stderr
    assert [path.name for path in units.iterdir()] == ["mine.service"]
    assert asked.read_text() == "--user disable --now hilstar-room7.service\n--user daemon-reload\n"
    assert_refused(run_hilstar_here("service", "uninstall", name), 2, "there is none")


def test_without_systemd_uninstall_says_what_is_left_to_do(service_bench, monkeypatch):
    assert install(service_bench).returncode == 0
    monkeypatch.setenv("PATH", str(service_bench.parent))
    result = run_hilstar_here("service", "uninstall", "room7")
    assert result.returncode == 0
    assert "systemctl --user stop hilstar-room7.service" in result.stderr
