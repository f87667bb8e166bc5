"""Real windows on a real X server (Xvfb), whose screen is read back from its own frame buffer."""

from __future__ import annotations

import os
import subprocess
import time
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from PIL import Image

from hilstar.basics.rotation import propagate
from hilstar.server.record.ledger_records import frame_records
from tests.support.benches import ATTITUDE, SCREEN_BENCH, still_log
from tests.support.commands import run_hilstar, run_hilstar_here, typed
from tests.support.forks import HILSTAR, Started
from tests.support.waiting import PATIENCE_S
from tests.support.x11.events import client
from tests.support.x11.screens import Screen, Shown, codes_of, lines_over, xvfb


def test_the_screen_shows_the_codes_bit_for_bit(screen, screen_file):
    codes = codes_of(screen_file)
    assert codes.max() > 50
    with Shown(screen, screen_file) as shown:
        assert (shown.wait_for(codes) == codes).all()
        summary = shown.stop()
    assert summary["frames"] > 0
    assert summary["stale_frames"] == 0


def test_optics_that_mirror_are_met_by_flips(screen, screen_file):
    mirrored = codes_of(screen_file)[:, ::-1]
    screen_file.write_text(SCREEN_BENCH.replace("[collimator]", "flip_x = true\n[collimator]"))
    with Shown(screen, screen_file) as shown:
        assert (shown.wait_for(mirrored) == mirrored).all()


def test_a_portrait_bench_is_turned_onto_a_landscape_screen(screen, screen_file):
    portrait = SCREEN_BENCH.replace("[640, 480]", "[480, 640]")
    screen_file.write_text(portrait)
    codes = np.rot90(codes_of(screen_file), k=-1)
    screen_file.write_text(portrait.replace("[collimator]", "rotate_deg = 90\n[collimator]"))
    with Shown(screen, screen_file) as shown:
        assert (shown.wait_for(codes) == codes).all()


def test_bit_stealing_reaches_the_screen(screen, screen_file):
    screen_file.write_text(SCREEN_BENCH.replace('quantisation = "exact"', "bit_stealing = true"))
    codes = codes_of(screen_file)
    assert (codes[..., 0] != codes[..., 2]).any()
    with Shown(screen, screen_file) as shown:
        assert (shown.wait_for(codes) == codes).all()


def test_a_moving_run_on_the_screen_is_drawn_again_bit_for_bit_without_one(
    screen, screen_file, tmp_path
):
    folder = tmp_path
    rate = np.array([0.01, 0.02, 0.0])
    q = np.array([float(part) for part in ATTITUDE.split(",")])
    rows = [propagate(q, rate, k * 0.1) for k in range(11)]
    lines = [f"{k * 0.1},{','.join(repr(float(v)) for v in row)}" for k, row in enumerate(rows)]
    (folder / "turn.csv").write_text("\n".join(["t_s,qw,qx,qy,qz", *lines]))
    ledger = folder / "run.mcap"
    shown = run_hilstar(
        f"replay {screen_file} {folder}/turn.csv -o {folder}/shown --ledger {ledger}",
        env=screen.env,
    )
    assert shown.returncode == 0, shown.stderr
    again = run_hilstar(
        "replay", screen_file, ledger, "--headless", "--speed", "max", "-o", folder / "again"
    )
    assert again.returncode == 0, again.stderr
    frames = list(frame_records(ledger))
    assert all(frame.rate is not None for frame in frames)
    names = sorted(path.name for path in (folder / "shown").glob("*.png"))
    assert len(names) == len(frames)
    assert names == sorted(path.name for path in (folder / "again").glob("*.png"))
    assert len(frames) > 1
    for name in names:
        one, other = (np.array(Image.open(folder / run / name)) for run in ("shown", "again"))
        assert (one == other).all()


def test_keys_show_the_grid_the_crosshair_a_patch_and_nothing_and_end_the_run(screen, screen_file):
    codes = codes_of(screen_file)
    with Shown(screen, screen_file) as shown, client(screen.display) as user:
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


def test_the_window_s_close_button_ends_the_run_in_order(screen, screen_file):
    codes = codes_of(screen_file)
    ledger = screen_file.parent / "run.mcap"
    with (
        Shown(screen, screen_file, "--ledger", str(ledger)) as shown,
        client(screen.display) as user,
    ):
        shown.wait_for(codes)
        user.close_window()
        summary = shown.ended()
    assert summary["ledger"] == {"path": str(ledger), "failure": None, "unrecorded": 0}
    assert len(list(frame_records(ledger))) == summary["frames"]


def refused_run(
    screen: Screen, screen_file: Path, *options: str, display: str | None = None
) -> tuple[int, str]:
    env = screen.env if display is None else screen.env | {"DISPLAY": display}
    with mock.patch.dict(os.environ, env, clear=True):
        result = run_hilstar_here("replay", screen_file, screen_file.parent / "still.csv", *options)
    assert "Traceback" not in result.stderr
    return result.returncode, result.stderr


def test_the_gate_refuses_a_display_of_another_size_and_force_is_logged(screen, screen_file):
    screen_file.write_text(SCREEN_BENCH.replace("[640, 480]", "[800, 600]"))
    code, said = refused_run(screen, screen_file)
    assert code == 3
    assert "640 x 480" in said and "800 x 600" in said and "--force" in said
    code, said = refused_run(screen, screen_file, "--force", "--stop", "0.2")
    assert code == 0
    assert "--force" in said


def test_the_gate_refuses_8_bits_where_10_are_asked_for(screen, screen_file):
    screen_file.write_text(SCREEN_BENCH.replace("[collimator]", "bits = 10\n[collimator]"))
    code, said = refused_run(screen, screen_file)
    assert code == 3
    assert "8 bits" in said and "10" in said


def test_without_a_refresh_of_its_own_the_display_is_paced_by_software_and_that_is_said(
    screen, screen_file
):
    code, said = refused_run(screen, screen_file, "--stop", "0.3")
    assert code == 0
    assert "paced by software" in said


def test_a_display_that_is_not_there_gets_one_line(screen, screen_file):
    screen_file.write_text(SCREEN_BENCH.replace("[collimator]", 'display = "DELL"\n[collimator]'))
    code, said = refused_run(screen, screen_file)
    assert code == 3
    assert "DELL" in said and "640 x 480" in said
    screen_file.write_text(SCREEN_BENCH)
    code, said = refused_run(screen, screen_file, display=":99999")
    assert code == 3
    assert "--headless" in said


def test_the_patches_of_a_plan_come_up_on_the_screen(screen, tmp_path):
    """Two levels between rounds of black, half and white: each comes up three times."""
    words = "calibrate plan --levels 2 --repeats 1 --show --seconds 0.2 -o"
    command = [*HILSTAR, *typed(words, tmp_path / "plan.csv")]
    with Started(command, stderr=subprocess.PIPE, text=True, env=screen.env) as process:
        seen = set()
        end = time.monotonic() + PATIENCE_S
        while process.poll() is None and time.monotonic() < end:
            pixels = screen.pixels()
            seen.add((int(pixels[240, 320].max()), int(pixels[20, 20].max())))
            time.sleep(0.02)
        said = process.communicate(timeout=PATIENCE_S)[1]
    assert {(0, 0), (127, 0), (255, 0)} <= seen, seen
    assert "code 255, channel w" in said


def test_the_dots_of_a_plan_come_up_turned_as_the_stars_are(screen, screen_file, tmp_path):
    screen_file.write_text(SCREEN_BENCH.replace("[collimator]", "flip_x = true\n[collimator]"))
    words = "calibrate dots --frames 8 --dots 10 --show --seconds 0.2"
    command = [*HILSTAR, *typed(words, screen_file, "-o", tmp_path / "plan")]
    with Started(command, stderr=subprocess.PIPE, text=True, env=screen.env) as process:
        wanted = None
        seen = False
        end = time.monotonic() + PATIENCE_S
        while process.poll() is None and time.monotonic() < end:
            last = tmp_path / "plan" / "frame_007.png"
            if wanted is None and last.exists():
                wanted = [
                    np.asarray(Image.open(tmp_path / "plan" / f"frame_{k:03}.png"))[:, ::-1]
                    for k in range(8)
                ]
            if wanted is not None:
                pixels = screen.pixels()[..., 0]
                seen |= any((pixels == image).all() for image in wanted)
            time.sleep(0.02)
        said = process.communicate(timeout=PATIENCE_S)[1]
    assert seen
    assert "frame 8 of 8" in said
    assert "8 of 8 frames shown" in said


@pytest.mark.parametrize(
    ("depth", "bits", "words"),
    [
        (
            24,
            10,
            (
                "8 bits per colour and the bench file says 10",
                "codes are not drawn as they are, (1, 1, 1) as (0, 0, 0)",
            ),
        ),
        (16, 8, ("the X screen has 5 bits per colour and the window 8, so that X converts",)),
        (30, 10, ("gamma ramp has 256 steps, too few for 10 bits",)),
    ],
)
def test_the_gate_reads_the_depth_and_every_code_of_what_is_drawn_on(tmp_path, depth, bits, words):
    screen_file = tmp_path / "bench.toml"
    screen_file.write_text(SCREEN_BENCH.replace("[collimator]", f"bits = {bits}\n[collimator]"))
    still_log(tmp_path / "still.csv")
    with xvfb(tmp_path, f"640x480x{depth}") as screen:
        code, said = refused_run(screen, screen_file, "--stop", "0.2")
        assert code == 3, said
        _, forced = refused_run(screen, screen_file, "--force", "--stop", "0.2")
    for word in words:
        assert word in forced
    assert ("codes are not drawn" in forced) == ((depth, bits) == (24, 10)), forced
