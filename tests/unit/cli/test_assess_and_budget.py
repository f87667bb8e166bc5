"""`hilstar assess` and `hilstar budget`: what they hand to their engines, which are the test's, and
what they say of the results.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from hilstar.instruments.assess import assessment, page, report
from hilstar.instruments.simulate import budget
from hilstar.server.bench import frame
from hilstar.server.bench.star_size import star_size
from tests.support.benches import bench_text
from tests.support.commands import run_hilstar_here


class Found:
    """A result, with the notes of an assessment."""

    notes = ("few answers",)


class Budget(dict[str, Any]):
    """A budget: as JSON an object, and its star."""

    def __init__(self, star: Any) -> None:
        super().__init__(stars=3)
        self.star = star


@pytest.mark.parametrize(
    ("words", "settings"),
    [
        ("", (None, 0.0, 12)),
        ("--stamp end --latency-ms -2.5 --display-attitudes 3", ("end", -0.0025, 3)),
    ],
)
def test_an_assessment_is_told_written_and_its_notes_are_said(
    tmp_path, monkeypatch, words, settings
):
    found = Found()
    calls: list[Any] = []
    monkeypatch.setattr(assessment, "assess_files", lambda *given: calls.append(given) or found)
    monkeypatch.setattr(report, "write_tables", lambda *given: calls.append(given))
    monkeypatch.setattr(page, "write_page", lambda *given: calls.append(given))
    monkeypatch.setattr(report, "lines_of", lambda result: [("bias", "20 arcsec")])
    monkeypatch.setattr(report, "budget_of", lambda result: {"bias": 20})
    command = ("assess", "run.mcap", "told.csv", "-o", "out", *words.split())
    for name in ("run.mcap", "told.csv"):
        (tmp_path / name).touch()
    done = run_hilstar_here(*command, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert calls == [
        (Path("run.mcap"), Path("told.csv"), assessment.AssessSettings(*settings)),
        (Path("out"), found),
        (Path("out/budget.html"), found),
    ]
    assert (tmp_path / "out").is_dir()
    assert done.stdout.splitlines() == [
        f"{'bias':24}20 arcsec",
        f"{'note':24}few answers",
        f"{'page':24}out/budget.html",
    ]
    done = run_hilstar_here(*command, "--json", cwd=tmp_path)
    assert json.loads(done.stdout) == {"bias": 20} and "few answers" in done.stderr
    for far in ("1e7", "-1e7", "nan"):
        refused = run_hilstar_here(*command[:5], "--latency-ms", far, cwd=tmp_path)
        assert refused.returncode == 2 and "write milliseconds, less than 1e+07" in refused.stderr


@pytest.mark.parametrize(("words", "centroider"), [((), None), (("--centroider", "box5"), "box5")])
def test_a_budget_is_of_a_bench_and_a_centroider_and_may_be_drawn(
    tmp_path, monkeypatch, words, centroider
):
    calls: list[Any] = []

    def found(bench: Any, by: Any) -> dict[str, Any]:
        calls.append((bench.file.path, by))
        return Budget(star_size(bench.config, bench.file.folder, bench.camera))

    monkeypatch.setattr(budget, "budget", found)
    monkeypatch.setattr(budget, "budget_lines", lambda result: ["three stars"])
    monkeypatch.setattr(budget, "write_report", lambda folder, result: calls.append(folder))
    monkeypatch.setattr(frame, "colour_line", lambda bench: "the primaries are assumed")
    (tmp_path / "bench.toml").write_text(bench_text({"render": {"quantisation": "round"}}))
    done = run_hilstar_here("budget", "bench.toml", *words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "three stars\n" and "the primaries are assumed" in done.stderr
    done = run_hilstar_here("budget", "bench.toml", "-o", "out", "--json", *words, cwd=tmp_path)
    assert json.loads(done.stdout) == {"stars": 3}
    assert calls == [(Path("bench.toml"), centroider)] * 2 + [Path("out")]
    refused = run_hilstar_here("budget", "bench.toml", "--centroider", "box4", cwd=tmp_path)
    assert refused.returncode == 2 and "--centroider box4: did you mean box" in refused.stderr
