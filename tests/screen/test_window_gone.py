"""An X server that dies and a window that another program takes away: the run ends in order, and says why."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from hilstar.run.record.records import frame_records
from tests.screen.test_window import ATTITUDE, BENCH, LATEST_S, Server, started
from tests.support.xevents import client

MCAP_END = b"\x89MCAP0\r\n"  # of a file that is finished


def kill_server(process: subprocess.Popen, server: Server) -> None:
    process.kill()


def destroy_window(process: subprocess.Popen, server: Server) -> None:
    with client(server.display) as user:
        user.destroy_window()


def xkill(process: subprocess.Popen, server: Server) -> None:
    with client(server.display) as user:
        user.kill_client()


def wait_for(true: Callable[[], object]) -> None:
    end = time.monotonic() + LATEST_S
    while not true():
        assert time.monotonic() < end
        time.sleep(0.05)


@pytest.mark.parametrize(("how", "said"), [(kill_server, "X server"), (destroy_window, "another program"), (xkill, "closed")])
def test_a_window_that_goes_away_ends_the_run_in_order(tmp_path, how, said):
    running = started(tmp_path)
    assert running is not None, "no X server comes up"
    server_process, server = running
    try:
        out, err, code = ended_by(server, tmp_path, lambda: how(server_process, server))
    finally:
        server_process.kill()
        server_process.wait()
    assert code == 3, err
    assert said in err.splitlines()[-1]
    assert "Traceback" not in err
    summary = json.loads(out)
    ledger = tmp_path / "run.mcap"
    assert summary["ledger"]["failure"] is None
    assert summary["events"]["window-gone"] == 1
    assert len(list(frame_records(ledger))) == summary["frames"] > 10
    assert ledger.read_bytes().endswith(MCAP_END)


def ended_by(server: Server, folder: Path, end: Callable[[], None]) -> tuple[str, str, int]:
    bench, log, ledger = folder / "bench.toml", folder / "still.csv", folder / "run.mcap"
    bench.write_text(BENCH)
    log.write_text(f"t_s,qw,qx,qy,qz\n0,{ATTITUDE}\n60,{ATTITUDE}\n")
    command = [sys.executable, "-m", "hilstar", "replay", str(bench), str(log), "--json", "--ledger", str(ledger)]
    env = {**os.environ, "DISPLAY": server.display}
    env.pop("WAYLAND_DISPLAY", None)
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=env) as process:
        try:
            wait_for(lambda: process.poll() is not None or (ledger.exists() and len(list(frame_records(ledger))) > 20))
            end()
            out, err = process.communicate(timeout=LATEST_S)
        finally:
            process.kill()
    return out, err, process.returncode
