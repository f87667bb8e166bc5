"""A command that computes or waits for long says so on a terminal's stderr, and nowhere else."""

from __future__ import annotations

import json
import os
import pty
import subprocess
import threading

from hilstar.basics.resources import resource_path
from tests.support.benches import bench_text
from tests.support.forks import HILSTAR
from tests.support.senders import free_port
from tests.support.waiting import wait_for

DEMO = str(resource_path("configs", "demo.toml"))
LIMIT_S = 120


def on_a_terminal(*words, cwd, awaited=""):
    """The exit code, stdout and stderr of a command whose stderr is a terminal, and whose stdout
    nobody reads before `awaited` is on it.
    """
    ours, theirs = pty.openpty()
    shown = bytearray()

    def read():
        try:
            while part := os.read(ours, 4096):
                shown.extend(part)
        except OSError:  # the other end is closed
            return

    reader = threading.Thread(target=read)
    reader.start()
    environment = dict(os.environ, TERM="xterm")
    with subprocess.Popen(
        [*HILSTAR, *map(str, words)],
        stdout=subprocess.PIPE,
        stderr=theirs,
        cwd=cwd,
        env=environment,
    ) as process:
        os.close(theirs)
        wait_for(lambda: awaited.encode() in shown or process.poll() is not None)
        out, _ = process.communicate(timeout=LIMIT_S)
    reader.join(LIMIT_S)
    os.close(ours)
    return process.returncode, out.decode(), shown.decode(errors="replace")


def test_a_catalogue_is_computed_before_ones_eyes(tmp_path):
    """Its 5 MB do not fit into a pipe: the command takes as long as nobody reads them."""
    words = ("catalogue", DEMO, "--faintest", "7", "-o", "-")
    code, out, shown = on_a_terminal(*words, cwd=tmp_path, awaited="computing the catalogue")
    assert code == 0
    assert len(out.splitlines()) > 10_000
    assert "computing the catalogue" in shown


def test_waiting_for_an_attitude_is_seen(tmp_path):
    attitude = {"source": "udp", "bind": f"127.0.0.1:{free_port()}"}
    (tmp_path / "bench.toml").write_text(bench_text({"attitude": attitude}))
    code, out, shown = on_a_terminal("attitude", "bench.toml", "--wait", "3", cwd=tmp_path)
    assert (code, out) == (2, "")
    assert "waiting for an attitude, 3 s at most" in shown


def test_waiting_for_a_listener_is_seen(tmp_path):
    to = f"tcp://127.0.0.1:{free_port()}"
    words = ("send", "--spin", "z,1", "--to", to, "--wait", "2", "--count", "1", "--json")
    code, out, shown = on_a_terminal(*words, cwd=tmp_path)
    assert code == 0
    assert json.loads(out)["sent"] == 1
    assert "1/2" in shown
