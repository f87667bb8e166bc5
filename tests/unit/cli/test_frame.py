"""What `hilstar frame` says of a frame beside its files."""

from __future__ import annotations

import json

import numpy as np

from hilstar.cli.frame import clipped_text, left_out
from hilstar.server.bench import frame_files
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


def test_what_is_too_faint_to_show_is_said_with_its_percent_of_the_light(
    small_bench_file, tmp_path
):
    text = small_bench_file.read_text()
    small_bench_file.write_text(text + "[render]\nflux_at_white_e_per_s = 3e8\n")
    words = ("frame", small_bench_file, "--radec", "84,-1,0", "--codes", tmp_path / "codes.png")
    missing = json.loads(run_hilstar_here(*words, "--json").stdout)["left_out"]
    percent = 100 * missing["flux_share"]
    assert missing["stars"] > 0 and percent > 0.1
    line = f"{missing['stars']} too faint to show ({percent:.2f}% of all light)"
    assert line in run_hilstar_here(*words).stdout


def test_codes_are_written_with_the_monitor_s_bits_and_faults_as_they_are_then(
    small_bench_file, tmp_path, monkeypatch
):
    written = []
    monkeypatch.setattr(
        frame_files,
        "write_codes_png",
        lambda path, codes, bits: written.append((codes.max(), bits)),
    )
    text = small_bench_file.read_text().replace("[collimator]", "bits = 10\n[collimator]")
    small_bench_file.write_text(text)
    (tmp_path / "later.toml").write_text(SCENARIO.replace("at_s = 0.0", "at_s = 2.0\nfor_s = 1.0"))
    words = ("frame", small_bench_file, "--radec", "84,-1,0", "--codes", tmp_path / "codes.png")
    words = (*words, "--scenario", tmp_path / "later.toml", "--json", "--at")
    for at, faults in (("1", []), ("2.5", ["ghost"])):
        told = json.loads(run_hilstar_here(*words, at).stdout)
        assert told["faults"] == faults
    assert {bits for _, bits in written} == {10}
    assert written[1][0] == 1023


def test_each_file_of_a_frame_is_written_where_it_is_named(small_bench_file, tmp_path):
    files = {"-o": "f.fits", "--truth": "t.csv", "--codes": "c.png", "--preview": "p.png"}
    words = [word for pair in files.items() for word in pair]
    done = run_hilstar_here(
        "frame", small_bench_file, "--radec", "84,-1,0", *words, "--json", cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["written"] == list(files.values())
    assert all((tmp_path / name).stat().st_size for name in files.values())


def test_what_the_monitor_cannot_show_is_counted_with_its_share_of_all_stars_light():
    rows = [("", 6.0, True), ("", 1.0, False), ("Moon", 1e6, True), ("", 3.0, False)]
    kinds = [("name", "U8"), ("electrons_per_s", "f8"), ("drawn", bool)]
    assert left_out(np.array(rows, kinds)) == {"stars": 2, "flux_share": 0.4}
    assert left_out(np.array(rows[2:3], kinds)) == {"stars": 0, "flux_share": 0.0}


def test_clipped_stars_are_named_by_their_hip_numbers_once_said_and_bodies_by_name():
    losses = {24436: 0.12, "Moon": 9.81, 27989: 0.5, "ghost": 1.0}
    wanted = "HIP 24436 by 0.12 mag, 27989 by 0.50 mag, Moon by 9.81 mag, ghost by 1.00 mag"
    assert clipped_text(losses) == wanted
    assert clipped_text({"Moon": 2.0}) == "Moon by 2.00 mag"
