"""`hilstar attitude` and `hilstar convert`: what they pass on of a log and of its time scale."""

from __future__ import annotations

import json

import pytest

from hilstar.attitude.logs.log_file import write_log
from hilstar.basics.rotation import from_radec_roll_deg
from tests.support.benches import ATTITUDE, bench_text
from tests.support.commands import assert_refused, run_hilstar_here
from tests.support.log_files import SAMPLES

MOON_UTC = "2026-11-29T00:00:00Z"
# Astropy's get_body("moon"), ephemeris "builtin": then, and how far it is six hours later
MOON_RADEC_DEG = (130.0288, 19.8249)
MOON_AFTER_S, MOON_AWAY_DEG = 21600, 3.59
SHOWN_DEG = 0.011  # two decimals, and an ephemeris of the Moon that is good to arcseconds


def test_a_log_s_stars_and_bodies_are_those_of_the_attitude_s_time(tmp_path):
    sky = {"epoch_utc": MOON_UTC, "faintest_v_mag": 2.0}
    changes = {"sky": sky, "sky.bodies": {"moon": True}}
    (tmp_path / "bench.toml").write_text(bench_text(changes))
    q = ",".join(map(repr, from_radec_roll_deg(*MOON_RADEC_DEG, 0.0).tolist()))
    rows = f"0,{q}\n{MOON_AFTER_S},{q}\n"
    (tmp_path / "moon.csv").write_text(f"t_s,qw,qx,qy,qz\n{rows}")
    words = f"attitude moon.csv --bench bench.toml --json --time {MOON_AFTER_S}"
    moon = json.loads(run_hilstar_here(words, cwd=tmp_path).stdout)["stars"][0]
    assert moon["name"] == "Moon"
    assert moon["from_boresight_deg"] == pytest.approx(MOON_AWAY_DEG, abs=SHOWN_DEG)


def test_a_gap_in_a_log_is_said(tmp_path):
    """No rate says how the sky turned within it."""
    rows = [f"{time_s},{ATTITUDE}" for time_s in range(5)]
    rows.append("14,0.5,0.5,-0.5,0.5")
    (tmp_path / "log.csv").write_text("\n".join(["t_s,qw,qx,qy,qz", *rows, ""]))
    said = run_hilstar_here("attitude", "log.csv", cwd=tmp_path)
    assert "the log has 1 gap, the longest 10 s" in said.stderr


def test_a_bench_file_is_a_live_stream_whatever_the_case_of_its_ending(tmp_path):
    (tmp_path / "BENCH.TOML").write_text(bench_text())
    refused = run_hilstar_here("attitude", "BENCH.TOML", "--time", "3", cwd=tmp_path)
    assert_refused(refused, 2, "--time 3: a live stream has only its present")


@pytest.mark.parametrize("system", ["TAI", "UTC"])
def test_a_message_that_is_converted_to_one_keeps_its_time_scale(tmp_path, system):
    write_log(tmp_path / "a.aem", SAMPLES, system)
    done = run_hilstar_here("convert", "a.aem", "b.xml", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert f"<TIME_SYSTEM>{system}</TIME_SYSTEM>" in (tmp_path / "b.xml").read_text()
