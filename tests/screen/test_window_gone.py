"""An X server that dies and a window that another program takes away: the run ends in order, and
says why.
"""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from hilstar.server.record.ledger_records import frame_records
from tests.support.benches import SCREEN_BENCH, still_log
from tests.support.forks import HILSTAR, Started
from tests.support.waiting import PATIENCE_S, wait_for
from tests.support.x11.events import client
from tests.support.x11.screens import Screen, recorded, xvfb

MCAP_END = b"\x89MCAP0\r\n"  # of a file that is finished


def kill_server(screen: Screen) -> None:
    screen.process.kill()


def destroy_window(screen: Screen) -> None:
    with client(screen.display) as user:
        user.destroy_window()


def xkill(screen: Screen) -> None:
    with client(screen.display) as user:
        user.kill_client()


@pytest.mark.parametrize(
    ("how", "said"),
    [(kill_server, "X server"), (destroy_window, "another program"), (xkill, "closed")],
)
def test_a_window_that_goes_away_ends_the_run_in_order(tmp_path, how, said):
    with xvfb(tmp_path) as screen:
        out, err, code = ended_by(screen, tmp_path, lambda: how(screen))
    assert code == 3, err
    assert said in err.splitlines()[-1]
    assert "Traceback" not in err
    summary = json.loads(out)
    ledger = tmp_path / "run.mcap"
    assert summary["ledger"]["failure"] is None
    assert summary["events"]["window-gone"] == 1
    assert len(list(frame_records(ledger))) == summary["frames"] > 10
    assert ledger.read_bytes().endswith(MCAP_END)


def ended_by(screen: Screen, folder: Path, end: Callable[[], None]) -> tuple[str, str, int]:
    bench, log, ledger = folder / "bench.toml", folder / "still.csv", folder / "run.mcap"
    bench.write_text(SCREEN_BENCH)
    still_log(log)
    command = [*HILSTAR, "replay", str(bench), str(log), "--json", "--ledger", str(ledger)]
    with Started(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=screen.env
    ) as process:
        try:
            wait_for(lambda: process.poll() is not None or len(recorded(ledger)) > 20)
            end()
            out, err = process.communicate(timeout=PATIENCE_S)
        finally:
            process.kill()
    return out, err, process.returncode
