"""Real windows on a real X server (Xvfb), whose screen is read back from its own frame buffer."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from hilstar.rotation import propagate
from hilstar.run.record.records import frame_records
from tests.conftest import SMALL_BENCH, run_hilstar
from tests.support.xevents import client

SIZE_PX = (640, 480)
BENCH = SMALL_BENCH.replace("resolution_px = [320, 240]", "resolution_px = [640, 480]")
ATTITUDE = "0.6987226,0.7135120,-0.0370377,0.0362700"
LATEST_S = 20.0


@dataclass
class Server:
    """An X server: what to put into DISPLAY, and the file of its screen (X window dump)."""

    display: str
    screen_file: Path

    def screen(self) -> np.ndarray:
        """What is on the screen: (height, width, 3) uint8."""
        data = self.screen_file.read_bytes()
        head = np.frombuffer(data[:100], ">u4")
        begin, width, height, row_bytes, colours = (int(head[k]) for k in (0, 4, 5, 12, 19))
        pixels = np.frombuffer(data, np.uint8, count=row_bytes * height, offset=begin + 12 * colours)
        return pixels.reshape(height, row_bytes // 4, 4)[:, :width, 2::-1]


def started(folder: Path) -> tuple[subprocess.Popen, Server] | None:
    """An X server whose screen is in a file of `folder`, once that is there; None when it ended instead."""
    read, write = os.pipe()
    command = ["Xvfb", "-displayfd", str(write), "-screen", "0", "640x480x24", "-fbdir", str(folder), "-nolisten", "tcp"]
    with (folder / "server.log").open("wb") as told:
        process = subprocess.Popen([*command, "-noreset"], pass_fds=(write,), stdout=told, stderr=told)
    os.close(write)
    with os.fdopen(read) as pipe:
        number = pipe.readline().strip()  # the server dies if its newline finds nobody
    screen_file = folder / "Xvfb_screen0"
    end = time.monotonic() + 5
    while process.poll() is None and time.monotonic() < end:
        if number and screen_file.exists():
            return process, Server(f":{number}", screen_file)
        time.sleep(0.02)
    process.kill()
    process.wait()
    return None


@pytest.fixture(scope="module")
def server(tmp_path_factory) -> Iterator[Server]:
    running = started(tmp_path_factory.mktemp("screen"))
    assert running is not None, "no X server comes up"
    process, server = running
    yield server
    process.terminate()
    process.wait()


@pytest.fixture
def bench_file(tmp_path) -> Path:
    path = tmp_path / "bench.toml"
    path.write_text(BENCH)
    still = "\n".join(f"{t},{ATTITUDE}" for t in (0, 60))
    (tmp_path / "still.csv").write_text(f"t_s,qw,qx,qy,qz\n{still}\n")
    return path


class Shown:
    """`hilstar replay` of one attitude in a window, until it is stopped."""

    def __init__(self, server: Server, bench_file: Path, *options: str) -> None:
        command = [sys.executable, "-m", "hilstar", "replay", str(bench_file), str(bench_file.parent / "still.csv"), "--json"]
        env = {**os.environ, "DISPLAY": server.display}
        env.pop("WAYLAND_DISPLAY", None)
        self._process = subprocess.Popen(
            [*command, *options], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=env
        )
        self._server = server

    def __enter__(self) -> Shown:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.communicate()

    def wait_for(self, wanted: np.ndarray) -> np.ndarray:
        """The screen, once it shows what is wanted; as it is when that takes too long."""
        end = time.monotonic() + LATEST_S
        while time.monotonic() < end and self._process.poll() is None:
            screen = self._server.screen()
            if screen.shape == wanted.shape and (screen == wanted).all():
                return screen
            time.sleep(0.05)
        return self._server.screen()

    def stop(self) -> dict:
        """End it in order; its summary."""
        self._process.send_signal(signal.SIGTERM)
        return self.ended()

    def ended(self) -> dict:
        """Its summary, once it has ended in order."""
        out, err = self._process.communicate(timeout=20)
        assert self._process.returncode == 0, err
        return json.loads(out)


def codes_of(bench_file: Path) -> np.ndarray:
    """The code values of the attitude, by another command and without a window; (height, width, 3)."""
    path = bench_file.parent / "codes.png"
    assert run_hilstar("frame", bench_file, "--quaternion", ATTITUDE, "--codes", path).returncode == 0
    with Image.open(path) as picture:
        codes = np.array(picture)
    return codes if codes.ndim == 3 else np.repeat(codes[:, :, None], 3, axis=2)


def test_the_screen_shows_the_codes_bit_for_bit(server, bench_file):
    codes = codes_of(bench_file)
    assert codes.max() > 50
    with Shown(server, bench_file) as shown:
        assert (shown.wait_for(codes) == codes).all()
        summary = shown.stop()
    assert summary["frames"] > 0
    assert summary["stale_frames"] == 0


@pytest.mark.parametrize(
    ("keys", "turned"),
    [
        ("flip_x = true", lambda codes: codes[:, ::-1]),
        ("flip_y = true", lambda codes: codes[::-1]),
        ("rotate_deg = 180", lambda codes: codes[::-1, ::-1]),
    ],
)
def test_optics_that_mirror_are_met_by_flips(server, bench_file, keys, turned):
    codes = codes_of(bench_file)
    bench_file.write_text(BENCH.replace("[collimator]", f"{keys}\n[collimator]"))
    with Shown(server, bench_file) as shown:
        assert (shown.wait_for(turned(codes)) == turned(codes)).all()


def test_a_portrait_bench_is_turned_onto_a_landscape_screen(server, bench_file):
    portrait = BENCH.replace("[640, 480]", "[480, 640]")
    bench_file.write_text(portrait)
    codes = np.rot90(codes_of(bench_file), k=-1)
    bench_file.write_text(portrait.replace("[collimator]", "rotate_deg = 90\n[collimator]"))
    with Shown(server, bench_file) as shown:
        assert (shown.wait_for(codes) == codes).all()


def test_bit_stealing_reaches_the_screen(server, bench_file):
    bench_file.write_text(BENCH + "[render]\nbit_stealing = true\n")
    codes = codes_of(bench_file)
    assert (codes[..., 0] != codes[..., 2]).any()
    with Shown(server, bench_file) as shown:
        assert (shown.wait_for(codes) == codes).all()


def test_a_moving_run_on_the_screen_is_drawn_again_bit_for_bit_without_one(server, bench_file):
    folder = bench_file.parent
    rate = np.array([0.01, 0.02, 0.0])
    q = np.array([float(part) for part in ATTITUDE.split(",")])
    rows = [propagate(q, rate, k * 0.1) for k in range(11)]
    lines = [f"{k * 0.1},{','.join(repr(float(v)) for v in row)}" for k, row in enumerate(rows)]
    (folder / "turn.csv").write_text("\n".join(["t_s,qw,qx,qy,qz", *lines]))
    env = {**os.environ, "DISPLAY": server.display}
    ledger = folder / "run.mcap"
    shown = run_hilstar("replay", bench_file, folder / "turn.csv", "-o", folder / "shown", "--ledger", ledger, env=env)
    assert shown.returncode == 0, shown.stderr
    again = run_hilstar("replay", bench_file, ledger, "--headless", "--speed", "max", "-o", folder / "again")
    assert again.returncode == 0, again.stderr
    frames = list(frame_records(ledger))
    assert all(frame.rate is not None for frame in frames)
    names = sorted(path.name for path in (folder / "shown").glob("*.png"))
    assert len(names) == len(frames) > 20
    assert names == sorted(path.name for path in (folder / "again").glob("*.png"))
    for name in names:
        one, other = (np.array(Image.open(folder / run / name)) for run in ("shown", "again"))
        assert (one == other).all()


def lines_over(codes: np.ndarray, keys: str) -> np.ndarray:
    """The codes with a grid of 100 px about the principal point, and the crosshair through it, of code 96."""
    rows, columns = np.mgrid[0 : codes.shape[0], 0 : codes.shape[1]]
    # The middle of 640 x 480 is at 319.5, 239.5; the screen has its lines at whole pixels, half rounded to even.
    dx, dy = columns - 320, rows - 240
    wanted = codes.copy()
    if "g" in keys:
        wanted[(dx % 100 == 0) | (dy % 100 == 0)] = np.maximum(96, wanted[(dx % 100 == 0) | (dy % 100 == 0)])
    if "c" in keys:
        wanted[(dx == 0) | (dy == 0)] = np.maximum(96, wanted[(dx == 0) | (dy == 0)])
    return wanted


def test_keys_show_the_grid_the_crosshair_a_patch_and_nothing_and_end_the_run(server, bench_file):
    codes = codes_of(bench_file)
    with Shown(server, bench_file) as shown, client(server.display) as user:
        assert (shown.wait_for(codes) == codes).all()
        for keys in ("g", "gc", "c", ""):
            wanted = lines_over(codes, keys)
            user.press({"g": "g", "gc": "c", "c": "g", "": "c"}[keys])
            assert (shown.wait_for(wanted) == wanted).all(), keys
        user.press("b")
        assert (shown.wait_for(np.zeros_like(codes)) == 0).all()
        user.press("b")
        for level in (0, 64, 128, 191, 255):
            user.press("t")
            assert (shown.wait_for(np.full_like(codes, level)) == level).all()
        user.press("t")
        assert (shown.wait_for(codes) == codes).all()
        user.press("q")
        summary = shown.ended()
    assert summary["frames"] > 0


def test_the_window_s_close_button_ends_the_run_in_order(server, bench_file):
    codes = codes_of(bench_file)
    ledger = bench_file.parent / "run.mcap"
    with Shown(server, bench_file, "--ledger", str(ledger)) as shown, client(server.display) as user:
        shown.wait_for(codes)
        user.close_window()
        summary = shown.ended()
    assert summary["ledger"] == {"path": str(ledger), "failure": None, "unrecorded": 0}
    assert len(list(frame_records(ledger))) == summary["frames"]


def refused(server: Server, bench_file: Path, *options: str, display: str | None = None) -> tuple[int, str]:
    env = {**os.environ, "DISPLAY": server.display if display is None else display}
    env.pop("WAYLAND_DISPLAY", None)
    result = run_hilstar("replay", bench_file, bench_file.parent / "still.csv", *options, env=env)
    assert "Traceback" not in result.stderr
    return result.returncode, result.stderr


def test_the_gate_refuses_a_display_of_another_size_and_force_is_logged(server, bench_file):
    bench_file.write_text(BENCH.replace("[640, 480]", "[800, 600]"))
    code, said = refused(server, bench_file)
    assert code == 3
    assert "640 x 480" in said and "800 x 600" in said and "--force" in said
    code, said = refused(server, bench_file, "--force", "--stop", "0.2")
    assert code == 0
    assert "--force" in said


def test_the_gate_refuses_8_bits_where_10_are_asked_for(server, bench_file):
    bench_file.write_text(BENCH.replace("[collimator]", "bits = 10\n[collimator]"))
    code, said = refused(server, bench_file)
    assert code == 3
    assert "8 bits" in said and "10" in said


def test_without_a_refresh_of_its_own_the_display_is_paced_by_software_and_that_is_said(server, bench_file):
    code, said = refused(server, bench_file, "--stop", "0.3")
    assert code == 0
    assert "paced by software" in said


def test_a_display_that_is_not_there_gets_one_line(server, bench_file):
    bench_file.write_text(BENCH.replace("[collimator]", 'display = "DELL"\n[collimator]'))
    code, said = refused(server, bench_file)
    assert code == 2
    assert "DELL" in said and "640 x 480" in said
    bench_file.write_text(BENCH)
    code, said = refused(server, bench_file, display=":99999")
    assert code == 3
    assert "--headless" in said


def test_the_patches_of_a_plan_come_up_on_the_screen(server, tmp_path):
    """Two levels: black and white; the square of the first white one stays 5 s."""
    env = {**os.environ, "DISPLAY": server.display}
    command = ["calibrate", "plan", "-o", str(tmp_path / "plan.csv"), "--levels", "2", "--repeats", "1", "--show"]
    with subprocess.Popen(
        [sys.executable, "-m", "hilstar", *command, "--seconds", "0.4"], stderr=subprocess.PIPE, text=True, env=env
    ) as process:
        seen = set()
        end = time.monotonic() + LATEST_S
        while process.poll() is None and time.monotonic() < end:
            screen = server.screen()
            seen.add((int(screen[240, 320].max()), int(screen[20, 20].max())))
            time.sleep(0.02)
        said = process.communicate(timeout=10)[1]
    assert {(0, 0), (127, 0), (255, 0)} <= seen
    assert "code 255, channel w" in said
