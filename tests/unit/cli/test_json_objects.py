"""Every command has --json: one object on stdout, and nothing else there."""

from __future__ import annotations

import json
import math

import pytest

from hilstar.cli.app import built
from tests.support.benches import ROOT, SMALL_BENCH
from tests.support.commands import assert_refused, run_hilstar_here

LOG = ROOT / "examples" / "slew.csv"


def told(*words, cwd):
    """The one object of a command with --json."""
    done = run_hilstar_here(*words, cwd=cwd)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("\n") == 1
    return json.loads(done.stdout)


def test_every_command_has_it():
    for name, command in built(None).commands.items():
        if name == "help":
            continue
        for inner in getattr(command, "commands", {name: command}).values():
            assert "--json" in {word for parameter in inner.params for word in parameter.opts}, name


def test_convert_counts_what_it_wrote(tmp_path):
    found = told("convert", LOG, "slew.jsonl", "--json", cwd=tmp_path)
    rows = (tmp_path / "slew.jsonl").read_text().splitlines()
    assert found["attitudes"] == len(rows)
    assert found["written"] == ["slew.jsonl"]
    first, last = (json.loads(rows[k])["t_ns"] for k in (0, -1))
    assert found["duration_s"] == (last - first) / 1e9


def test_convert_notes_what_a_log_is_doubted_for(tmp_path):
    # four digits: steps of 20 arcsec, which a turn of 0.1 deg/s makes into jumps
    half_rad = [math.radians(0.1 * 0.01 * k) / 2 for k in range(400)]
    rows = [
        f"{0.01 * k:.2f},{math.cos(a):.4f},{math.sin(a):.4f},0,0" for k, a in enumerate(half_rad)
    ]
    (tmp_path / "coarse.csv").write_text("\n".join(["t_s,qw,qx,qy,qz", *rows]) + "\n")
    words = ("convert", "coarse.csv", "out.jsonl")
    plain = run_hilstar_here(*words, cwd=tmp_path)
    found = told(*words, "--json", cwd=tmp_path)
    assert found["notes"] == plain.stderr.splitlines()
    assert found["notes"]


def test_keys_are_listed(tmp_path):
    found = told("keys", "-o", "secret", "--json", cwd=tmp_path)
    assert {tmp_path / name for name in found["written"]} == {
        path for path in (tmp_path / "secret").rglob("*") if path.is_file()
    }
    assert_refused(run_hilstar_here("keys", "-o", "secret", "--json", cwd=tmp_path), 2, "secret")


@pytest.fixture
def service_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.setattr("hilstar.cli.service.can_confine", lambda: True)
    (tmp_path / "room.toml").write_text(SMALL_BENCH)
    return tmp_path


def test_a_service_is_its_unit_and_its_token(service_folder):
    shown = told("service", "install", "room.toml", "--print", "--json", cwd=service_folder)
    assert shown["written"] == []
    outside = ("--", "--console", "0.0.0.0:8765")
    found = told("service", "install", "room.toml", "--json", *outside, cwd=service_folder)
    assert found["service"] == "hilstar-room.service"
    unit = service_folder / "config" / "systemd" / "user" / "hilstar-room.service"
    assert found["written"] == [str(unit)] == [found["unit"]]
    assert found["text"] == unit.read_text()
    assert found["token_file"] == str(unit.with_suffix(".env"))
    gone = told("service", "uninstall", "room", "--json", cwd=service_folder)
    assert gone == {"unit": str(unit), "stopped": False}
    assert not unit.exists()
