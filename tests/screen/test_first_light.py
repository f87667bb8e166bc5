"""hilstar first-light on a real X server's screen: past the gate, then each pattern until a person
or a photodiode has seen it. A whole session through a camera is in test_camera_loop.py.
"""

from __future__ import annotations

import json
import re
import subprocess
import time

import numpy as np
import pytest

from hilstar.instruments.calibrate.first_light.image_sources import Pattern, PatternDisplay
from hilstar.server.bench.bench_file import read_bench_file
from tests.support import plain_camera
from tests.support.benches import TWIN, bench_text
from tests.support.commands import run_hilstar
from tests.support.forks import HILSTAR, Started
from tests.support.waiting import PATIENCE_S, best_of_three, in_time, wait_for
from tests.support.wire.ptys import Cable
from tests.support.x11.diode import Diode
from tests.support.x11.events import client

ADDED_MS = 25.0
# a swap is on Xvfb's screen within 2 ms; the diode is a thread here, and a busy machine holds it up
MEDIAN_MS = 4.0


def told_by(process, word):
    """The next line of a session's stderr that has a word; fails where the session ends before."""
    lines = []
    for line in process.stderr:
        if word in line:
            return line
        lines.append(line)
    raise AssertionError(f"the session ended without {word!r}: {''.join(lines)}")


def save(line, screen):
    """Do what a session asks: save the tracker's image under the name that it says.

    A person looks at the screen first: a frame that is still on its way to it is not photographed.
    """
    standing(screen, 0.04)
    plain_camera.take([str(screen.file), re.search(r"as (\S+\.png) ", line)[1], "--reversed"])


def standing(screen, still_s, is_lit=False):
    """What is on the screen once it has stood still for so long; with `is_lit`, once something is
    there.
    """
    for _ in range(500):
        before = screen.pixels()
        time.sleep(still_s)
        if (screen.pixels() == before).all() and (before.any() or not is_lit):
            return before
    raise AssertionError("nothing stands still on the screen")


def test_a_person_tells_the_mounting_by_a_key_and_saves_the_images(screen, tmp_path):
    """The tracker's rows are reversed: the largest square is at the bottom left, which is the
    third of the keys.
    """
    bench = tmp_path / "bench.toml"
    bench.write_text(bench_text(TWIN, {"monitor": {"bits": 8}}))
    command = [*HILSTAR, "first-light", str(bench), "-o", str(tmp_path / "s")]
    with (
        Started(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=screen.env
        ) as process,
        client(screen.display) as user,
    ):
        try:
            told_by(process, "now press")
            legend = [process.stderr.readline() for _ in range(8)]
            assert (
                legend[2]
                .strip()
                .startswith(
                    "3  the largest square bottom left, the next one to its right, the smallest"
                )
            )
            before = standing(screen, 0.2, is_lit=True)
            user.press("3")
            told_by(process, "now press")
            wait_for(
                lambda: np.array_equal(screen.pixels()[::-1], before), "the figure, turned over"
            )
            user.press("1")
            while "geometry-1/frame_000" not in (line := told_by(process, "now save")):
                save(line, screen)
            user.press("q")
            assert process.wait(PATIENCE_S) == 1
        finally:
            process.kill()
    session = json.loads((tmp_path / "s" / "session.json").read_text())
    steps = {step["name"]: step for step in session["steps"]}
    assert steps["orientation"]["figures"] == {"seen": "mirrored top to bottom", "told_by": "a key"}
    assert steps["focus"]["verdict"] == "done"
    assert (session["running"], list(steps)) == (
        "geometry",
        ["machine", "display", "orientation", "focus", "warm-up"],
    )
    assert "flip_y = true" in bench.read_text()


@pytest.mark.timing
@best_of_three("the diode is a thread of this process: while it has no core, it sees a light late")
def test_the_delay_of_a_real_display_is_found_by_a_photodiode(screen, tmp_path):
    """The command that takes images fails, so only what needs none is measured: what is added to
    the diode's line comes out.
    """
    bench = tmp_path / "bench.toml"
    bench.write_text(
        bench_text({"monitor": {"resolution_px": [640, 480], "photodiode_px": 40, "scanout_ms": 0}})
    )
    with Cable(tmp_path) as cable, Diode(screen, cable.sender, ADDED_MS):
        diode = f"serial:{cable.host}@921600"
        words = [
            "first-light",
            bench,
            "-o",
            tmp_path / "s",
            "--grab",
            "false {output}",
            "--diode",
            diode,
            "--json",
        ]
        result = run_hilstar(*words, env=screen.env, timeout=PATIENCE_S)
    assert result.returncode == 1, result.stderr
    steps = {step["name"]: step for step in json.loads(result.stdout)["steps"]}
    assert steps["orientation"]["verdict"] == "failed"
    in_time(steps["latency"]["verdict"] == "done", steps["latency"]["line"])
    in_time(
        abs(steps["latency"]["figures"]["panel_delay_ms"] - ADDED_MS) < MEDIAN_MS, steps["latency"]
    )
    assert f"panel_delay_ms = {steps['latency']['figures']['panel_delay_ms']}" in bench.read_text()


def test_colours_are_shown_and_frames_of_a_turn_one_after_the_other(screen, tmp_path, monkeypatch):
    monkeypatch.setenv("DISPLAY", screen.display)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    (tmp_path / "bench.toml").write_text(bench_text({"monitor": {"resolution_px": [640, 480]}}))
    file = read_bench_file(tmp_path / "bench.toml")
    rng = np.random.default_rng(1)
    table = rng.integers(0, 256, (1000, 3)).astype(np.uint16)
    colours, other = table[rng.integers(0, 1000, (2, 480, 640))]
    looks = []
    with PatternDisplay() as display:
        display.show_until(
            file, Pattern("colours", colours), lambda: looks.append(screen.pixels()) or True
        )
        assert (looks[-1] == colours).all()
        seen = set()

        def done():
            now = screen.pixels()
            seen.update(
                number for number, frame in enumerate((colours, other)) if (now == frame).all()
            )
            return len(seen) == 2

        display.show_until(file, Pattern("turn", colours, (other,)), done)
