"""hilstar first-light on a real X server's screen: past the gate, then each pattern while a command takes its image."""

from __future__ import annotations

import json

import pytest

from tests.support import plain_camera
from tests.support.benches import TWIN, bench_text
from tests.support.commands import run_hilstar


def test_the_display_shows_each_pattern_while_the_command_runs(screen, tmp_path):
    (tmp_path / "bench.toml").write_text(bench_text(TWIN, {"monitor": {"bits": 8}}))
    with plain_camera.on_duty() as camera:
        grab = f"{camera} {screen.file} {{output}} --reversed"
        words = ["first-light", tmp_path / "bench.toml", "-o", tmp_path / "s", "--grab", grab, "--patches", "0", "--json"]
        result = run_hilstar(*words, env=screen.env, timeout=180)
    assert result.returncode == 0, result.stderr
    steps = {step["name"]: step for step in json.loads(result.stdout)["steps"]}
    assert steps["display"]["verdict"] == "done"
    # The figure was seen upside down, and then upright on the turned screen.
    assert steps["orientation"]["figures"]["seen"] == "mirrored top to bottom"
    assert steps["geometry"]["figures"]["focal_length_px"] == pytest.approx(120e3 / 57.65, rel=1e-4)
    assert steps["verify"]["figures"]["star_rms_px"] < 0.05
