"""The Python sender with CURVE keys against `hilstar serve`: let in with its key, told where it is not."""

from __future__ import annotations

import importlib
import json
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from hilstar.cli import app
from hilstar.errors import InputError
from tests.examples.support import commands, copied

pytestmark = pytest.mark.e2e

ANYWHERE, HERE = "tcp://*:5560", "tcp://127.0.0.1:*"  # the example's endpoint, and a free port of this machine alone


def test_with_its_key_it_is_heard_and_with_another_it_is_told(tmp_path, monkeypatch, capsys):
    folder = copied(tmp_path)
    monkeypatch.chdir(folder)
    keys, serve, send, _ = commands("A Python sender with CURVE keys")
    with pytest.raises(InputError, match="hilstar keys"):
        app(serve[1:], standalone_mode=False)
    assert not app(keys[1:], standalone_mode=False)
    assert not app([*keys[1:-1], "strange"], standalone_mode=False)
    shutil.copy("keys/server.key", "strange/server.key")

    bench = (folder / "curve_bench.toml").read_text()
    assert ANYWHERE in bench
    (folder / "curve_bench.toml").write_text(bench.replace(ANYWHERE, HERE))
    command = [sys.executable, "-m", "hilstar", *serve[1:], "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            (endpoint,) = re.findall(r"tcp://127\.0\.0\.1:\d+", process.stderr.readline())
            sent = subprocess.run(
                [sys.executable, *send[1:2], endpoint, *send[3:4], "0.5"],
                capture_output=True,
                text=True,
                check=True,
                timeout=60,
            )
            refused = stranger(monkeypatch, endpoint)
            process.send_signal(signal.SIGINT)
            out, err = process.communicate(timeout=30)
        finally:
            process.kill()
    assert sent.stdout == "50 attitudes sent\n"
    assert refused == 1
    assert "allowed_clients" in capsys.readouterr().err
    assert "its key is not among those allowed" in err
    packets = json.loads(out)["packets"]
    assert (packets["received"], packets["accepted"]) == (50, 50)


def stranger(monkeypatch: pytest.MonkeyPatch, endpoint: str) -> int:
    """The sender's exit code with keys that hilstar does not know."""
    monkeypatch.syspath_prepend(Path.cwd())
    curve_sender = importlib.import_module("curve_sender")
    monkeypatch.setattr(curve_sender, "WAIT_MS", 500)
    return curve_sender.main(endpoint, "strange")
