"""The page of a session: its verdict, its cards, and what changed in the bench file."""

from __future__ import annotations

import pytest

from hilstar.instruments.calibrate.first_light.context import SessionFile, StepRecord
from hilstar.instruments.calibrate.first_light.page import write_page
from hilstar.instruments.calibrate.first_light.steps import STEPS


def page_of_session(folder, changes: dict[str, dict], steps: int = len(STEPS)) -> str:
    """The page of so many steps, which passed but for `changes` by name."""
    before, bench = folder / "before.toml", folder / "bench.toml"
    before.write_text("a = 1\nb = 2\n")
    bench.write_text("a = 1\nb = 3\n")
    records = []
    for step in STEPS[:steps]:
        record = {
            "name": step.name,
            "verdict": "done",
            "line": "measured",
            "exit_code": 0,
            "state_sha256": "",
            "figures": {},
            "files": {},
            "pictures": [],
            "changes": [],
            "ended": "now",
            "seconds": 1.0,
        }
        records.append(StepRecord(**(record | changes.get(step.name, {}))))
    session = SessionFile(
        kind="first-light",
        hilstar="0",
        bench=str(bench),
        bench_sha256="",
        seen_by="a camera",
        running=None,
        steps=records,
    )
    return write_page(folder, session, before).read_text()


@pytest.mark.parametrize(
    ("verdicts", "steps", "words"),
    [
        ({}, 11, "The bench is ready"),
        ({"latency": "skipped"}, 11, "What was measured is in order"),
        ({}, 10, "What was measured is in order"),
        ({"latency": "skipped", "focus": "failed"}, 11, "Not ready: focus failed"),
    ],
)
def test_a_bench_is_ready_where_all_steps_passed_and_a_failed_one_says_its_cure(
    tmp_path, verdicts, steps, words
):
    assert len(STEPS) == 11
    changes = {name: {"verdict": verdict} for name, verdict in verdicts.items()}
    page = page_of_session(tmp_path, changes, steps)
    headlines = ("The bench is ready", "What was measured is in order", "Not ready")
    assert [headline for headline in headlines if headline in page] == [words.split(":")[0]]
    assert words in page
    for step in STEPS[:steps]:
        is_told = f"--again {step.name}" in page
        assert is_told == (verdicts.get(step.name) == "failed")
    assert "-b = 2\n+b = 3" in page


def test_a_card_has_each_figure_once_and_counts_the_files_that_it_does_not_list(tmp_path):
    (tmp_path / "drawn.svg").write_text("<svg/>")
    figures = {f"figure_{number}": f"value{number:02}" for number in range(20)}
    files = {f"file{number:02}": f"digest{number:02}" for number in range(15)}
    changes = {"focus": {"figures": figures, "files": files, "pictures": ["drawn.svg"]}}
    page = page_of_session(tmp_path, changes)
    assert [page.count(value) for value in figures.values()] == [1] * 20
    assert [page.count(digest) for digest in files.values()] == [1] * 12 + [0] * 3
    assert "and 3 files more" in page
    assert page.count("files more") == 1
