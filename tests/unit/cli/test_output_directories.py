"""The directory after -o: refused before any work where nothing can be written, and not made for
an input that is refused.
"""

from __future__ import annotations

import os

import pytest

from tests.support.commands import assert_refused, run_hilstar_here
from tests.support.heads import heads_file

COMMANDS = {
    "verify": ["verify", "{bench}"],
    "budget": ["budget", "{bench}"],
    "noise": ["budget", "{bench}", "--noise"],
    "benchmark": ["benchmark", "{bench}"],
    "study": ["study", "chain", "{bench}"],
    "assess": ["assess", "{bench}", "{bench}"],
    "report": ["report", "{bench}"],
    "compare": ["compare", "{bench}", "{bench}"],
    "campaign": ["campaign", "{bench}"],
    "dots": ["calibrate", "dots", "{bench}"],
    "simulate": ["simulate", "{bench}", "--log", "{bench}"],
    "first-light": ["first-light", "{bench}"],
}


@pytest.mark.parametrize("command", COMMANDS.values(), ids=COMMANDS)
def test_a_directory_is_looked_at_before_the_work_and_made_after_the_input_is_read(
    command, tmp_path, monkeypatch, small_bench_file
):
    broken = tmp_path / "broken.toml"
    broken.write_text("[")
    line = [part.format(bench=broken) for part in command]
    assert_refused(run_hilstar_here(*line, "-o", tmp_path / "out"), 2, "broken.toml")
    assert not (tmp_path / "out").exists()
    # root may write anywhere
    monkeypatch.setattr(os, "access", lambda path, mode: mode != os.W_OK | os.X_OK)
    line = [part.format(bench=small_bench_file) for part in command]
    refused = run_hilstar_here(*line, "-o", tmp_path / "out" / "deep")
    assert_refused(
        refused, 2, "out/deep: cannot be written (Permission denied); choose another place"
    )
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["budget", "noise", "benchmark", "study", "dots", "first-light"])
def test_a_file_of_heads_in_a_bench_file_s_place_is_refused_in_words(name, tmp_path):
    line = [part.format(bench=heads_file(tmp_path, 5599)) for part in COMMANDS[name]]
    assert_refused(
        run_hilstar_here(*line, "-o", tmp_path / "out"),
        2,
        "heads.toml: ",
        "give one of its heads' files",
    )
    assert not (tmp_path / "out").exists()


def test_what_heads_have_no_use_for_is_refused_and_not_ignored(tmp_path):
    path = heads_file(tmp_path, 5599)
    assert_refused(
        run_hilstar_here("verify", path, "-o", tmp_path / "out"),
        2,
        "verify -o: is of one bench",
        "heads.toml",
    )
    assert_refused(
        run_hilstar_here("verify", path, "--strict"), 2, "verify --strict: is of one bench"
    )
    assert not (tmp_path / "out").exists()
