"""HILSTAR_DRAW: which of the two ways draws stars, as commands, doctor and ledgers say."""

from __future__ import annotations

import json
import os

import numpy as np
import pytest
from PIL import Image

from hilstar.server.record.ledger_records import read_head
from tests.support.benches import SMALL_BENCH, still_log
from tests.support.commands import assert_refused, run_hilstar

AT = ("--radec", "84.057,-1.2,0")
OTHER = 1e-4  # of lit pixels, whose light is within rounding of a threshold


@pytest.fixture
def round_bench(small_bench_file):
    small_bench_file.write_text(SMALL_BENCH + '[render]\nquantisation = "round"\n')
    return small_bench_file


def by(way: str, **more: str) -> dict[str, str]:
    return os.environ | {"HILSTAR_DRAW": way} | more


@pytest.mark.parametrize("way", ["opengl", "CPU", "gl "])
def test_another_word_is_refused_in_one_line(way, round_bench, tmp_path, no_opengl):
    for environment in (by(way), by(way, **no_opengl)):
        result = run_hilstar("frame", round_bench, *AT, "-o", tmp_path / "x.fits", env=environment)
        assert_refused(result, 2, f"HILSTAR_DRAW={way}", "gl or cpu")


def test_points_that_are_asked_for_need_opengl_and_the_processor_does_not(
    round_bench, tmp_path, no_opengl
):
    words = ("frame", round_bench, *AT, "-o", tmp_path / "x.fits")
    refused = run_hilstar(*words, env=by("gl", **no_opengl))
    assert_refused(refused, 3, "HILSTAR_DRAW=gl", "no OpenGL")
    drawn = run_hilstar(*words, env=by("cpu", **no_opengl))
    assert drawn.returncode == 0, drawn.stderr


def test_both_ways_draw_the_same_codes_and_ledger_summary_and_doctor_say_which(
    round_bench, tmp_path
):
    log = still_log(tmp_path / "log.csv", seconds=1)
    codes, paths = {}, {}
    for way in ("gl", "cpu"):
        ledger, picture = tmp_path / f"{way}.mcap", tmp_path / f"{way}.png"
        framed = run_hilstar("frame", round_bench, *AT, "--codes", picture, env=by(way))
        assert framed.returncode == 0, framed.stderr
        codes[way] = np.array(Image.open(picture)).astype(int)
        words = ("replay", round_bench, log, "--headless", "--speed", "max", "--json")
        played = run_hilstar(*words, "--ledger", ledger, env=by(way))
        assert played.returncode == 0, played.stderr
        paths[way] = json.loads(played.stdout)["render_path"]
        assert read_head(ledger)["render_path"] == paths[way]
        assert f"round by {paths[way]}" in run_hilstar("doctor", env=by(way)).stdout
    assert paths == {"gl": "points", "cpu": "CPU"}
    lit = np.count_nonzero(codes["gl"])
    assert lit > 100
    assert np.count_nonzero(codes["gl"] != codes["cpu"]) <= OTHER * lit
