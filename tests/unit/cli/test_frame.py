"""What `hilstar frame` says of a frame beside its files."""

from __future__ import annotations

import json

from tests.support.commands import run_hilstar_here

# A hundred times what a star of V = 4, the brightest that fits, has.
SCENARIO = """
[[fault]]
kind = "false-star"
name = "ghost"
screen_px = [40, 50]
electrons_per_s = 1e8
at_s = 0.0
"""


def test_what_a_clipped_false_star_loses_is_said_with_the_stars(small_bench_file, tmp_path):
    text = small_bench_file.read_text()
    small_bench_file.write_text(text + "[render]\nbrightest_v_mag = 4\n")
    (tmp_path / "ghost.toml").write_text(SCENARIO)
    words = ("frame", small_bench_file, "--radec", "84,-1,0", "--codes", tmp_path / "codes.png")
    result = run_hilstar_here(*words, "--scenario", tmp_path / "ghost.toml", "--at", "1", "--json")
    assert result.returncode == 0, result.stderr
    told = json.loads(result.stdout)
    assert told["faults"] == ["ghost"]
    assert set(told["clipped_mag"]) == set(map(str, told["clipped"]))
    assert told["clipped_mag"]["ghost"] > 1
