"""Shares of a bad cable, and what recorded answers are counted as."""

from __future__ import annotations

import json

import pytest

from tests.support.benches import SMALL_BENCH
from tests.support.commands import run_hilstar_here
from tests.support.senders import free_port

ANSWERS = '[answers]\nsource = "file"\npath = "line.bin"\nformat = "json"\n'
LINES = [
    '{"q": [1, 0, 0, 0], "t_ns": 1000}',
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


@pytest.mark.parametrize(
    ("rate", "words"),
    [
        ("0.001", None),
        ("10000", None),
        ("0.0009", "--rate 0.0009: write packets per second, 0.001 to 10000"),
        ("10001", "--rate 10001: write packets per second, 0.001 to 10000"),
    ],
)
def test_packets_leave_from_one_in_a_thousand_seconds_to_ten_a_millisecond(rate, words):
    to = f"udp://127.0.0.1:{free_port()}"
    spin = ("send", "--spin", "z,0", "--to", to, "--wait", "0", "--duration", "0.0001", "--json")
    sent = run_hilstar_here(*spin, "--rate", rate)
    if words is None:
        assert json.loads(sent.stdout)["packets"] == 1
    else:
        assert sent.returncode == 2 and words in sent.stderr


@pytest.mark.parametrize(("duration", "packets"), [("0.1", 3), ("0.04", 2)])
def test_a_duration_counts_from_the_log_s_first_sample_and_ends_before_its_end(
    tmp_path, duration, packets
):
    times_s = (1000.0, 1000.02, 1000.04, 1000.5)
    rows = [f"{t_s},1,0,0,0" for t_s in times_s]
    (tmp_path / "log.csv").write_text("\n".join(["t_s,qw,qx,qy,qz", *rows]) + "\n")
    words = ["send", "log.csv", "--to", f"udp://127.0.0.1:{free_port()}", "--wait", "0", "--json"]
    sent = run_hilstar_here(*words, "--duration", duration, cwd=tmp_path)
    assert sent.returncode == 0, sent.stderr
    assert json.loads(sent.stdout)["packets"] == packets


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
    said = spoken.stdout.splitlines()
    assert len(said) == 4
    assert said[0].startswith("t 0.000001 s, q +1.0000000 +0.0000000 +0.0000000 +0.0000000, RA ")
