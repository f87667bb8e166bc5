"""Shares of a bad cable, and what recorded answers are counted as."""

from __future__ import annotations

import json

import pytest

from tests.support.benches import SMALL_BENCH
from tests.support.commands import run_hilstar_here

ANSWERS = '[answers]\nsource = "file"\npath = "line.bin"\nformat = "json"\n'
LINES = [
    '{"q": [1, 0, 0, 0], "t_ns": 5}',
    '{"q": [1, 0, 0, 0], "t_ns": 6, "valid": false}',
    "no answer",
    '{"q": [0, 1, 0, 0], "t_ns": 7}',
]


@pytest.mark.parametrize(
    ("lost", "corrupted", "reordered", "words"),
    [
        ("50%", "25%", "25%", "gone.jsonl"),
        ("50%", "25%", "26%", "add up to more than 100 %"),
        ("0", "1", "0.01", "add up to more than 100 %"),
    ],
)
def test_a_cable_s_faults_add_up_to_every_packet_at_most(lost, corrupted, reordered, words):
    shares = ["--lose", lost, "--corrupt", corrupted, "--reorder", reordered]
    refused = run_hilstar_here("send", "gone.jsonl", *shares)
    assert refused.returncode == 2 and words in refused.stderr


def test_recorded_answers_are_counted_valid_ones_apart_and_refused_ones_by_reason(tmp_path):
    (tmp_path / "bench.toml").write_text(SMALL_BENCH + ANSWERS)
    (tmp_path / "line.bin").write_text("\n".join(LINES) + "\n")
    words = ["answers", "bench.toml", "--from", "line.bin"]
    told = json.loads(run_hilstar_here(*words, "--json", cwd=tmp_path).stdout)
    counts = told["counts"]
    (reason,) = counts.keys() - {"answers", "valid"}
    assert (counts["answers"], counts["valid"], counts[reason]) == (3, 2, 1)
    rows = told["answers"]
    assert [row.get("valid") for row in rows] == [True, False, None, True]
    assert rows[2]["refused"] == reason
    assert [bytes.fromhex(row["raw"]).decode() for row in rows][:2] == LINES[:2]
    spoken = run_hilstar_here(*words, cwd=tmp_path)
    assert f"3 answers, 2 valid; refused: 1 {reason}" in spoken.stderr
    assert len(spoken.stdout.splitlines()) == 4
