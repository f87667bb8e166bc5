"""`hilstar assess` and `hilstar budget`: what they ask for, and what they say of it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from hilstar.instruments.assess import assessment
from hilstar.instruments.assess.report import budget_of, lines_of
from tests.support.assessments import an_assessment, as_json
from tests.support.benches import bench_text
from tests.support.commands import run_hilstar_here


@pytest.mark.usefixtures("without_charts")
@pytest.mark.parametrize(
    ("words", "settings"),
    [
        ("", (None, 0.0, 12)),
        ("--stamp end --latency-ms -2.5 --display-attitudes 3 --json", ("end", -0.0025, 3)),
    ],
)
def test_an_assessment_is_told_written_and_its_notes_are_said(
    tmp_path, monkeypatch, words, settings
):
    calls: list[Any] = []
    found = an_assessment()
    monkeypatch.setattr(assessment, "assess_files", lambda *given: calls.append(given) or found)
    command = ("assess", "run.mcap", "told.csv", "-o", "out", *words.split())
    for name in ("run.mcap", "told.csv"):
        (tmp_path / name).touch()
    done = run_hilstar_here(*command, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    given = (Path("run.mcap"), Path("told.csv"), assessment.AssessSettings(*settings))
    assert calls == [given]
    assert (tmp_path / "out/budget.html").stat().st_size
    assert (tmp_path / "out/budget.csv").stat().st_size
    if "--json" in words:
        assert json.loads(done.stdout) == as_json(budget_of(found))
        assert "a note of a test" in done.stderr
    else:
        rows = [*lines_of(found), ("note", "a note of a test"), ("page", "out/budget.html")]
        assert done.stdout.splitlines() == [f"{what:24}{text}" for what, text in rows]


def test_an_assessment_s_latency_is_less_than_hours(tmp_path):
    for name in ("run.mcap", "told.csv"):
        (tmp_path / name).touch()
    for far in ("1e7", "-1e7", "nan"):
        words = ("assess", "run.mcap", "told.csv", "-o", "out", "--latency-ms", far)
        refused = run_hilstar_here(*words, cwd=tmp_path)
        assert refused.returncode == 2 and "write milliseconds, less than 1e+07" in refused.stderr


@pytest.mark.usefixtures("without_charts")
def test_a_budget_is_of_a_bench_and_a_centroider_and_may_be_drawn(tmp_path):
    render = {"quantisation": "round", "bit_stealing": True}
    (tmp_path / "bench.toml").write_text(bench_text({"render": render}))
    words = ("budget", "bench.toml", "--centroider", "box5", "--json")
    told = json.loads(run_hilstar_here(*words, cwd=tmp_path).stdout)
    assert (told["centroider"], told["star"]["limit"]) == ("box5", 2.0)
    done = run_hilstar_here("budget", "bench.toml", "-o", "out", cwd=tmp_path)
    assert done.stdout.startswith("method                round with bit stealing, 8 bits\n")
    assert "[render] bit_stealing with calibration" in done.stderr
    assert "a star is 7.9 times as wide as the sky's" in done.stderr
    assert list((tmp_path / "out").iterdir())
    refused = run_hilstar_here("budget", "bench.toml", "--centroider", "box4", cwd=tmp_path)
    assert refused.returncode == 2 and "--centroider box4: did you mean box" in refused.stderr


NOISY = {
    "tracker": {"resolution_px": [48, 48], "focal_length_mm": 12.0},
    "tracker.detector": {"read_noise_e": 12},
    "sky": {"faintest_v_mag": 3.0},
}


def test_the_noise_of_a_place_is_of_its_own_stars(tmp_path):
    """Orion's belt, and not the median of fields all over the sky."""
    (tmp_path / "bench.toml").write_text(bench_text(NOISY))
    words = ("budget", "bench.toml", "--noise", "--radec", "84.057,-1.2,0", "--json")
    done = run_hilstar_here(*words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["fields"] == 1
    assert {26311, 25930, 26727} <= {star["hip"] for star in found["stars"]}
