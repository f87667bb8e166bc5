"""The Python sender with CURVE keys against `hilstar serve`: let in with its key, told where it
is not.
"""

from __future__ import annotations

import importlib
import json
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.examples.support import commands, copied
from tests.support.commands import assert_refused, run_hilstar_here
from tests.support.senders import free_port
from tests.support.servers import listening
from tests.support.waiting import PATIENCE_S

EVERYWHERE = "tcp://*:5560"


def test_with_its_key_it_is_heard_and_with_another_it_is_told(tmp_path, monkeypatch, capsys):
    folder = copied(tmp_path)
    monkeypatch.chdir(folder)
    keys, serve, send, _ = commands("A Python sender with CURVE keys")
    assert_refused(run_hilstar_here(*serve[1:]), 2, "hilstar keys")
    assert run_hilstar_here(*keys[1:]).returncode == 0
    assert run_hilstar_here(*keys[1:-1], "strange").returncode == 0
    shutil.copy("keys/server.key", "strange/server.key")

    bench = folder / "curve_bench.toml"
    # the same keys, and nothing of a test is open to the network
    endpoint = f"tcp://127.0.0.1:{free_port()}"
    assert EVERYWHERE in bench.read_text()
    bench.write_text(bench.read_text().replace(EVERYWHERE, endpoint))
    assert serve[1:4] == ["serve", bench.name, "--headless"]
    with listening(bench, f"bound to {endpoint}", *serve[4:]) as process:
        command = [sys.executable, send[1], endpoint, send[3], "0.5"]
        sent = subprocess.run(
            command, capture_output=True, text=True, check=True, timeout=PATIENCE_S
        )
        refused = stranger(monkeypatch, endpoint)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=PATIENCE_S)
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
