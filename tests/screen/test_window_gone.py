"""An X server that dies and a window that another program takes away: the run ends in order, and
says why.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from hilstar.server.record.ledger_records import frame_records
from hilstar.server.screen.gate import GATE_FRAMES
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


# A replay whose X server is dead, and its connections closed, when swap SWAP asks it. It ends with 99
# where anything is drawn on the window after that.
DIES_WITHIN_A_SWAP = """
import os, pathlib, signal, sys, time
server, folder = int(sys.argv[1]), sys.argv[2]
from hilstar.display.render.presenter import Presenter
from hilstar.display.window.library import glfw
swaps, swap_buffers = [], glfw.swap_buffers
def swap(window):
    swaps.append(window)
    if len(swaps) == SWAP:
        os.kill(server, signal.SIGKILL)
        while ") Z " not in pathlib.Path(f"/proc/{server}/stat").read_text():
            time.sleep(0.01)
    swap_buffers(window)
glfw.swap_buffers = swap
def checked(draw):
    return lambda *arguments: os._exit(99) if len(swaps) >= SWAP else draw(*arguments)
Presenter.present, Presenter.wait = checked(Presenter.present), checked(Presenter.wait)
from hilstar.__main__ import main
sys.argv = ["hilstar", "replay", folder + "/bench.toml", folder + "/still.csv"]
main()
"""


@pytest.mark.parametrize("swap", [GATE_FRAMES // 2, GATE_FRAMES + 40])
def test_a_server_that_dies_within_a_swap_ends_the_gate_and_a_run_in_order(tmp_path, swap):
    """Mesa's driver may crash where anything is drawn on a window that was lost in a swap."""
    (tmp_path / "bench.toml").write_text(SCREEN_BENCH)
    still_log(tmp_path / "still.csv")
    code = DIES_WITHIN_A_SWAP.replace("SWAP", str(swap))
    with xvfb(tmp_path) as screen:
        command = [sys.executable, "-c", code, str(screen.process.pid), str(tmp_path)]
        with Started(command, stderr=subprocess.PIPE, text=True, env=screen.env) as process:
            err = process.communicate(timeout=PATIENCE_S)[1]
    assert process.returncode == 3, err
    assert "the X server is gone" in err.splitlines()[-1]
    assert "Traceback" not in err


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
