"""Monitors that have names, gamma ramps and a refresh rate, and that come and go: a real X.Org
server, dummy driver.
"""

from __future__ import annotations

import ctypes
import json
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.support.benches import SCREEN_BENCH, still_log
from tests.support.commands import assert_refused, run_hilstar
from tests.support.forks import HILSTAR, Started
from tests.support.waiting import PATIENCE_S, wait_for
from tests.support.x11.screens import recorded
from tests.support.x11.xorg import Xorg, xorg

OTHER_GAMMA = "1.7:1.4:1.2"


@pytest.fixture(scope="module")
def server(tmp_path_factory) -> Iterator[Xorg]:
    with xorg(tmp_path_factory.mktemp("xorg")) as running:
        yield running


def on_dummy(folder: Path, keys: str = 'display = "DUMMY0"') -> Path:
    path = folder / "bench.toml"
    path.write_text(SCREEN_BENCH.replace("[collimator]", f"refresh_hz = 60\n{keys}\n[collimator]"))
    still_log(folder / "still.csv")
    return path


@contextmanager
def showing(server: Xorg, path: Path, *options: str) -> Iterator[subprocess.Popen]:
    """A run on the screen, its ledger growing."""
    ledger = path.parent / "run.mcap"
    command = [
        "replay",
        str(path),
        str(path.parent / "still.csv"),
        "--force",
        "--json",
        "--ledger",
        str(ledger),
        *options,
    ]
    with Started(
        [*HILSTAR, *command],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=server.env,
    ) as process:
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


def frame_count(path: Path) -> int:
    return len(recorded(path.parent / "run.mcap"))


@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGINT])
def test_the_ramp_is_straight_while_the_bench_runs_and_given_back_after_a_signal(
    server, tmp_path, how
):
    server.xrandr("--output", "DUMMY0", "--gamma", OTHER_GAMMA)
    before = server.gamma("DUMMY0")
    assert before != (1.0, 1.0, 1.0)
    with showing(server, on_dummy(tmp_path)) as process:
        assert server.gamma("DUMMY0") == (1.0, 1.0, 1.0)
        process.send_signal(how)
        out, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, err
    assert server.gamma("DUMMY0") == before
    assert json.loads(out)["screen"]["timestamp_source"].startswith("after-swap clock")
    server.xrandr("--output", "DUMMY0", "--gamma", "1:1:1")


def test_swaps_that_do_not_wait_for_a_known_refresh_are_refused(server, tmp_path):
    path = on_dummy(tmp_path)
    result = run_hilstar("replay", path, tmp_path / "still.csv", env=server.env)
    assert result.returncode == 3, result.stderr
    assert (
        "vertical sync" in result.stderr
        and "--force" in result.stderr
        and "Traceback" not in result.stderr
    )


def test_the_monitor_that_is_named_is_the_one_that_is_filled(server, tmp_path):
    server.xrandr("--output", "DUMMY1", "--mode", "800x600", "--right-of", "DUMMY0")
    try:
        listed = run_hilstar("doctor", "--json", env=server.env)
        detail = next(
            c["detail"] for c in json.loads(listed.stdout)["checks"] if c["name"] == "display"
        )
        assert "DUMMY0, 640 x 480, 60 Hz" in detail and "DUMMY1, 800 x 600" in detail
        path = on_dummy(tmp_path, 'display = "dummy1"')
        path.write_text(
            path.read_text().replace("resolution_px = [640, 480]", "resolution_px = [800, 600]")
        )
        with showing(server, path):
            pass
        assert frame_count(path) > 10
        warned = run_hilstar(
            "replay", path, tmp_path / "still.csv", "--force", "--stop", "0.2", env=server.env
        )
        assert "other displays, DUMMY0" in warned.stderr and "X screen of its own" in warned.stderr
        wrong = on_dummy(tmp_path, 'display = "DUMMY1"')
        result = run_hilstar("replay", wrong, tmp_path / "still.csv", env=server.env)
        assert result.returncode == 3
        assert "800 x 600" in result.stderr
    finally:
        server.xrandr("--output", "DUMMY1", "--off")


@pytest.mark.parametrize(("wanted_hz", "shown_hz"), [(60, 59.94), (120, 119.88), (75, 59.94)])
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


def test_a_display_that_another_one_mirrors_is_refused(server, tmp_path):
    server.xrandr("--output", "DUMMY1", "--mode", "640x480", "--same-as", "DUMMY0")
    try:
        result = run_hilstar("replay", on_dummy(tmp_path), tmp_path / "still.csv", env=server.env)
        assert result.returncode == 3
        assert "DUMMY1 mirrors this one" in result.stderr
    finally:
        server.xrandr("--output", "DUMMY1", "--off")


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


def test_a_compositing_manager_is_refused(server, tmp_path):
    """Owning the selection is what makes a compositing manager (EWMH): a real X client owns it
    here.
    """
    x11 = ctypes.CDLL("libX11.so.6")
    x11.XOpenDisplay.restype = ctypes.c_void_p
    x11.XOpenDisplay.argtypes = [ctypes.c_char_p]
    x11.XInternAtom.restype = x11.XDefaultRootWindow.restype = x11.XCreateSimpleWindow.restype = (
        ctypes.c_ulong
    )
    x11.XInternAtom.argtypes = [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_int]
    x11.XDefaultRootWindow.argtypes = [ctypes.c_void_p]
    x11.XCreateSimpleWindow.argtypes = [
        ctypes.c_void_p,
        ctypes.c_ulong,
        *[ctypes.c_int] * 2,
        *[ctypes.c_uint] * 3,
        *[ctypes.c_ulong] * 2,
    ]
    x11.XSetSelectionOwner.argtypes = [
        ctypes.c_void_p,
        ctypes.c_ulong,
        ctypes.c_ulong,
        ctypes.c_ulong,
    ]
    x11.XSync.argtypes, x11.XCloseDisplay.argtypes = (
        [ctypes.c_void_p, ctypes.c_int],
        [ctypes.c_void_p],
    )
    client = x11.XOpenDisplay(server.display.encode())
    try:
        window = x11.XCreateSimpleWindow(
            client, x11.XDefaultRootWindow(client), 0, 0, 1, 1, 0, 0, 0
        )
        x11.XSetSelectionOwner(client, x11.XInternAtom(client, b"_NET_WM_CM_S0", 0), window, 0)
        x11.XSync(client, 0)
        result = run_hilstar("replay", on_dummy(tmp_path), tmp_path / "still.csv", env=server.env)
    finally:
        x11.XCloseDisplay(client)
    assert result.returncode == 3
    assert "compositing manager" in result.stderr
