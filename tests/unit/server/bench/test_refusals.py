"""Bench files that are refused: what is written, and the words of the one line that says so."""

from __future__ import annotations

import re

import pytest

from hilstar.server.bench.config import read_config
from tests.support.benches import SMALL_BENCH
from tests.support.refusals import refusal


def line(text: str) -> str:
    """The small bench with another line for the first key of that name."""
    key = text.partition(" =")[0]
    return re.sub(rf"(?m)^{key} = .*$", text, SMALL_BENCH, count=1)


def other_text(old: str, new: str) -> str:
    assert old in SMALL_BENCH
    return SMALL_BENCH.replace(old, new)


def without(key: str) -> str:
    return re.sub(rf"(?m)^{key} .*\n", "", SMALL_BENCH, count=1)


def more(text: str) -> str:
    return f"{SMALL_BENCH}{text}\n"


NEEDED = (
    "aperture_mm",
    "focal_length_mm",
    "pixel_pitch_um",
    "resolution_px",
    "quantum_efficiency",
)
REFUSED = [
    *((without(key), f"[tracker] the key {key} is missing") for key in NEEDED),
    (
        other_text("aperture_mm = 30", "aperture = 30"),
        "[tracker] unknown key aperture; did you mean aperture_mm?",
    ),
    (line("aperture_mm = -30"), "[tracker] aperture_mm = -30; number >= 1e-06 is wanted"),
    (line('aperture_mm = "30"'), '[tracker] aperture_mm = "30"; number is wanted'),
    (
        line("aperture_mm = 1e200"),
        "[tracker] aperture_mm = 1e200; number <= 1000000000000.0 is wanted",
    ),
    (line("aperture_mm = true"), "[tracker] aperture_mm = true; number is wanted"),
    (line("aperture_mm = nan"), "tracker.aperture_mm = nan; a finite number is wanted"),
    (
        other_text("[320, 240]", "[320]"),
        "[monitor] resolution_px = [320]; array of length 2 is wanted",
    ),
    (
        other_text("[320, 240]", "[320, 240.5]"),
        "[monitor] resolution_px = [320,240.5]; whole number is wanted",
    ),
    (
        other_text("[320, 240]", "[320, inf]"),
        "monitor.resolution_px = inf; a finite number is wanted",
    ),
    (other_text("[collimator]", "[colimator]"), "unknown key colimator; did you mean collimator?"),
    (other_text("[tracker]", "x = 1\n[tracker]"), "unknown key x; known are tracker, monitor"),
    (other_text("[tracker]", "[tracker"), "not TOML"),
    (more("q_cam_to_mon = [1,1,0,0]"), "q_cam_to_mon: its norm is 1.41421"),
    (
        more('[sky]\ntemperature = "hot"'),
        '[sky] temperature = "hot"; "ballesteros2012" or "wang2021" is wanted',
    ),
    (more("[sky]\nobserver_velocity_km_s = [3e5, 0, 0]"), "not slower than light"),
    (
        more("[background]\nelectrons_per_px = 1\nzodiacal_v_mag_arcsec2 = 22"),
        "write one of them",
    ),
    (
        more('[verify]\ncentroider = "centre"'),
        '[verify] centroider = "centre"; "window" or "wide" or "moment" or "fit" or',
    ),
    (more("[verify]\ncentroider = 3"), '[verify] centroider = 3; "window" or "wide"'),
    (more('[render]\nquantisation = "exactly"'), '"exact" or "auto" is wanted'),
    (more("[render]\ncycle_frames = 0"), "cycle_frames"),
    (more("[render]\ncycle_frames = 6.5"), "cycle_frames"),
    (more("[render]\ncycle_frames = 257"), "cycle_frames"),
    (more("[render]\nsprite_sigma_px = [0, 1]"), "sprite_sigma_px = [0,1]"),
    (more("[monitor.x]"), "[monitor] unknown key x"),
    ("x = " + "[" * 5000, ""),
    ("x = " + "[" * 900 + "]" * 900, ""),
    ("[" + ".".join(["a"] * 2000) + "]", ""),
]


@pytest.mark.parametrize(("text", "words"), REFUSED, ids=range(len(REFUSED)))
def test_what_is_wrong_is_said_with_what_to_write(tmp_path, text, words):
    path = tmp_path / "bench.toml"
    path.write_text(text)
    answer = refusal(read_config, path)
    assert answer.startswith(f"{path}: ") and words in answer


def test_a_bench_file_that_is_not_there_is_refused(tmp_path):
    assert "No such file" in refusal(read_config, tmp_path / "none.toml")
