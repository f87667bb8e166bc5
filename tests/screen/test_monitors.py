"""Monitors that have names, gamma ramps and a refresh rate, and that come and go: a real X.Org
server, dummy driver.
"""

from __future__ import annotations

import json
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.support.benches import SCREEN_BENCH, still_log
from tests.support.commands import assert_refused, run_hilstar, run_hilstar_here, typed
from tests.support.forks import HILSTAR, Started
from tests.support.waiting import PATIENCE_S, wait_for
from tests.support.x11.events import client
from tests.support.x11.screens import recorded
from tests.support.x11.xorg import Xorg

OTHER_GAMMA = "1.7:1.4:1.2"


def on_dummy(folder: Path, keys: str = 'display = "DUMMY0"') -> Path:
    path = folder / "bench.toml"
    path.write_text(SCREEN_BENCH.replace("[collimator]", f"refresh_hz = 60\n{keys}\n[collimator]"))
    still_log(folder / "still.csv")
    return path


@contextmanager
def showing(server: Xorg, path: Path, *options: str) -> Iterator[subprocess.Popen]:
    """A run on the screen, its ledger growing."""
    ledger = path.parent / "run.mcap"
    files = (path, path.parent / "still.csv", "--ledger", ledger)
    command = [*HILSTAR, *typed("replay --force --json", *files), *options]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with Started(command, env=server.env, **pipes) as process:
        try:
            wait_for(lambda: frame_count(path) > 10 or process.poll() is not None)
            yield process
        finally:
            if process.poll() is None:
                process.terminate()
                try:
                    process.communicate(timeout=PATIENCE_S)
                finally:
                    process.kill()


def refusal_here(path: Path) -> str:
    """The line by which the gate of this process's display refuses a bench."""
    result = run_hilstar_here("replay", path, path.parent / "still.csv")
    assert result.returncode == 3, result.stderr
    assert "Traceback" not in result.stderr
    return result.stderr.splitlines()[-1]


def frame_count(path: Path) -> int:
    return len(recorded(path.parent / "run.mcap"))


def test_the_ramp_is_straight_while_the_bench_runs_and_given_back_after_a_signal(server, tmp_path):
    server.xrandr("--output", "DUMMY0", "--gamma", OTHER_GAMMA)
    before = server.gamma("DUMMY0")
    assert before != (1.0, 1.0, 1.0)
    with showing(server, on_dummy(tmp_path)) as process:
        assert server.gamma("DUMMY0") == (1.0, 1.0, 1.0)
        process.send_signal(signal.SIGTERM)
        out, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, err
    assert server.gamma("DUMMY0") == before
    assert json.loads(out)["screen"]["timestamp_source"].startswith("after-swap clock")
    server.xrandr("--output", "DUMMY0", "--gamma", "1:1:1")


def test_swaps_that_do_not_wait_for_a_known_refresh_are_refused(here, tmp_path):
    line = refusal_here(on_dummy(tmp_path))
    assert "vertical sync" in line and "--force" in line


def test_the_monitor_that_is_named_is_the_one_that_is_filled(here, tmp_path):
    here.xrandr("--output", "DUMMY1", "--mode", "800x600", "--right-of", "DUMMY0")
    try:
        listed = run_hilstar_here("doctor", "--json")
        checks = {check["name"]: check["detail"] for check in json.loads(listed.stdout)["checks"]}
        detail = checks["display"]
        assert "DUMMY0, 640 x 480, 60 Hz" in detail and "DUMMY1, 800 x 600" in detail
        path = on_dummy(tmp_path, 'display = "dummy1"')
        path.write_text(
            path.read_text().replace("resolution_px = [640, 480]", "resolution_px = [800, 600]")
        )
        with showing(here, path) as process:
            process.terminate()
            _, said = process.communicate(timeout=PATIENCE_S)
        assert frame_count(path) > 10
        assert "other displays, DUMMY0" in said and "X screen of its own" in said
        wrong = on_dummy(tmp_path, 'display = "DUMMY1"')
        assert "800 x 600" in refusal_here(wrong)
    finally:
        here.xrandr("--output", "DUMMY1", "--off")


@pytest.mark.parametrize(("wanted_hz", "shown_hz"), [(120, 119.88), (75, 59.94)])
def test_a_display_keeps_its_refresh_or_takes_the_bench_s_where_it_has_it(
    server, tmp_path, wanted_hz, shown_hz
):
    """Left to itself GLFW opens a window at the highest refresh that a display has."""
    assert server.refresh_hz("DUMMY0") == 59.94
    path = on_dummy(tmp_path)
    path.write_text(path.read_text().replace("refresh_hz = 60", f"refresh_hz = {wanted_hz}"))
    with showing(server, path):
        assert server.refresh_hz("DUMMY0") == shown_hz
    assert server.refresh_hz("DUMMY0") == 59.94


def test_a_session_of_wayland_alone_is_refused_in_a_plain_line(server, tmp_path):
    env = {name: value for name, value in server.env.items() if name != "DISPLAY"}
    env |= {"WAYLAND_DISPLAY": "wayland-0", "XDG_SESSION_TYPE": "wayland"}
    result = run_hilstar("replay", on_dummy(tmp_path), tmp_path / "still.csv", env=env)
    assert_refused(result, 3, "Wayland", "Xorg session", "--headless")


def test_x11_is_used_where_the_session_says_wayland(server, tmp_path):
    env = server.env | {"XDG_SESSION_TYPE": "wayland", "WAYLAND_DISPLAY": "wayland-0"}
    result = run_hilstar(
        "replay", on_dummy(tmp_path), tmp_path / "still.csv", "--force", "--stop", "0.3", env=env
    )
    assert result.returncode == 0, result.stderr


def test_a_display_that_another_one_mirrors_is_refused(here, tmp_path):
    here.xrandr("--output", "DUMMY1", "--mode", "640x480", "--same-as", "DUMMY0")
    try:
        assert "DUMMY1 mirrors this one" in refusal_here(on_dummy(tmp_path))
    finally:
        here.xrandr("--output", "DUMMY1", "--off")


def test_a_display_that_is_unplugged_and_returns_is_filled_again(server, tmp_path):
    server.xrandr("--output", "DUMMY1", "--mode", "640x480", "--right-of", "DUMMY0")
    try:
        path = on_dummy(tmp_path, 'display = "DUMMY1"')
        server.xrandr("--output", "DUMMY1", "--gamma", OTHER_GAMMA)
        with showing(server, path) as process:
            server.xrandr("--output", "DUMMY1", "--off")
            gone = frame_count(path)
            wait_for(lambda: frame_count(path) > gone + 30)
            server.xrandr("--output", "DUMMY1", "--mode", "640x480", "--right-of", "DUMMY0")
            back = frame_count(path)
            wait_for(lambda: frame_count(path) > back + 30)
            wait_for(lambda: server.gamma("DUMMY1") == (1.0, 1.0, 1.0))
            assert process.poll() is None
            process.terminate()
            _, err = process.communicate(timeout=PATIENCE_S)
        assert process.returncode == 0, err
        assert "DUMMY1 is gone" in err and "DUMMY1 is back" in err
    finally:
        server.xrandr("--output", "DUMMY1", "--off")


def test_a_compositing_manager_is_refused(here, tmp_path):
    with client(here.display) as manager:
        manager.composite()
        assert "compositing manager" in refusal_here(on_dummy(tmp_path))
