"""Logs from hand to hand: convert, replay and its span, send from any of them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from hilstar.basics.rotation import from_radec_roll_deg, propagate
from tests.support.commands import assert_refused, run_hilstar, run_hilstar_here
from tests.support.sources.aem_messages import EPOCHS, kvn, rows_of
from tests.support.tables import csv_rows

RATE = np.radians([0.3, -0.2, 2.0])


@pytest.fixture
def rated(tmp_path) -> Path:
    """Two seconds at 10 Hz, in JSON lines with rates."""
    path = tmp_path / "log.jsonl"
    start = from_radec_roll_deg(84, -1, 0)
    lines = [
        json.dumps(
            {
                "t_ns": 10**9 + k * 10**8,
                "q": propagate(start, RATE, k / 10).tolist(),
                "rate": RATE.tolist(),
            }
        )
        for k in range(21)
    ]
    path.write_text("\n".join(lines))
    return path


def replayed_log(bench: Path, rated: Path, output: Path, *options: str) -> list[dict[str, str]]:
    result = run_hilstar_here(
        "replay", bench, rated, "--headless", "--speed", "max", "-o", output, *options
    )
    assert result.returncode == 0, result.stderr
    return csv_rows(output / "frames.csv")


def quaternion(row: dict[str, str]) -> list[float]:
    return [float(row[name]) for name in ("qw", "qx", "qy", "qz")]


@pytest.mark.parametrize("suffix", ["csv", "jsonl", "aem", "kvn", "xml", "mcap"])
def test_every_form_of_a_log_replays_to_the_same_frames(tmp_path, small_bench_file, rated, suffix):
    other = tmp_path / f"other.{suffix}"
    converted = run_hilstar_here("convert", rated, other)
    assert converted.returncode == 0, converted.stderr
    assert "21 attitudes" in converted.stdout
    ours, theirs = (
        replayed_log(small_bench_file, path, tmp_path / path.suffix, "--step", "0.25")
        for path in (rated, other)
    )
    assert len(ours) == len(theirs) == 9
    for a, b in zip(ours, theirs, strict=True):
        # AEM's rates come back through q and q_dot, to some 1e-15.
        assert quaternion(a) == pytest.approx(quaternion(b), abs=1e-13)
    frames = [
        np.array(Image.open(tmp_path / path.suffix / "frame_000004.png")) for path in (rated, other)
    ]
    assert (frames[0] != frames[1]).mean() < 1e-4
    assert frames[0].max() > 50


def test_a_replay_s_span_and_step_are_those_asked_for(tmp_path, small_bench_file, rated):
    rows = replayed_log(
        small_bench_file,
        rated,
        tmp_path / "out",
        "--start",
        "0.5",
        "--stop",
        "1.5",
        "--step",
        "0.1",
    )
    assert [float(row["t_s"]) for row in rows] == pytest.approx([1.5 + 0.1 * k for k in range(11)])


def test_a_replay_at_four_times_the_speed_takes_a_quarter_of_the_time(small_bench_file, rated):
    result = run_hilstar("replay", small_bench_file, rated, "--headless", "--speed", "4", "--json")
    summary = json.loads(result.stdout)
    assert summary["frames"] + summary["missed_frames"] == 31
    assert summary["duration_s"] == pytest.approx(0.5, abs=0.1)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--speed", "fast"], "realtime"),
        (["--speed", "0"], "0.001"),
        (["--speed", "2", "--step", "0.1"], "--step"),
        (["--start", "5"], "its length, 2"),
        (["--start", "1.5", "--stop", "1"], "--stop"),
        (["--step", "-1"], "--step"),
        (["--speed", "max", "--step", "1e-12"], "longer --step"),
    ],
)
def test_a_speed_or_span_that_gives_no_frame_gets_one_line(small_bench_file, rated, options, said):
    assert_refused(
        run_hilstar_here("replay", small_bench_file, rated, "--headless", *options), 2, said
    )


@pytest.mark.parametrize("system", ["TAI", "UTC"])
def test_convert_writes_times_on_the_scale_of_its_log(tmp_path, system):
    (tmp_path / "log.aem").write_text(kvn(rows_of([0, 0, 0, 1], [0, 0, 1, 0]), TIME_SYSTEM=system))
    done = run_hilstar_here("convert", tmp_path / "log.aem", tmp_path / "out.xml")
    assert done.returncode == 0, done.stderr
    written = (tmp_path / "out.xml").read_text()
    assert f"<TIME_SYSTEM>{system}</TIME_SYSTEM>" in written
    assert all(epoch in written for epoch in EPOCHS)


def test_convert_says_what_it_cannot(tmp_path, rated):
    assert_refused(run_hilstar_here("convert", rated, tmp_path / "out.doc"), 2, ".csv", "out.doc")
    assert_refused(
        run_hilstar_here("convert", tmp_path / "none.csv", tmp_path / "out.csv"), 2, "none.csv"
    )
    assert_refused(run_hilstar_here("convert", rated, tmp_path / "no" / "out.csv"), 2, "out.csv")


def test_convert_says_what_a_log_s_rates_and_digits_say_against_it(tmp_path, rated):
    turned = rated.with_name("conjugates.jsonl")
    rows = [json.loads(line) for line in rated.read_text().splitlines()]
    for row in rows:
        row["q"] = [row["q"][0], *(-part for part in row["q"][1:])]
    turned.write_text("\n".join(map(json.dumps, rows)))
    told = run_hilstar_here("convert", turned, tmp_path / "out.csv").stderr
    assert "the conjugate of the quaternions: write --convention direction=cam_to_icrs" in told
    for row in rows:
        row["q"] = [round(part, 3) for part in row["q"]]
    turned.write_text("\n".join(map(json.dumps, rows)))
    told = run_hilstar_here("convert", turned, tmp_path / "out.csv").stderr
    assert "steps of 0.001" in told
    assert run_hilstar_here("convert", rated, tmp_path / "out.csv").stderr == ""


def test_fault_options_stand_alone_or_take_a_share(tmp_path):
    for options, said in (
        (["--lose", "110%"], "--lose 110%"),
        (["--corrupt", "60%", "--lose", "60%"], "100 %"),
    ):
        assert_refused(
            run_hilstar_here("send", "--spin", "z,1", "--to", "tcp://127.0.0.1:*", *options),
            2,
            said,
        )
    result = run_hilstar_here(
        "send", "--spin", "z,1", "--to", "tcp://127.0.0.1:*", "--rate", "5000", "--count", "4000", "--wait", "0",
        "--json", "--reorder", "--corrupt", "--lose", "0.1",
    )  # fmt: skip
    told = json.loads(result.stdout)
    assert told["packets"] == 4000
    for name, share in (("lost", 0.1), ("corrupted", 0.05), ("reordered", 0.05)):
        # Four sigma of a binomial count; a packet that is to be held back while another is held
        # back goes on.
        assert told[name] == pytest.approx(4000 * share, abs=4 * np.sqrt(4000 * share) + 12)


def test_a_resampled_log_keeps_its_breaks_and_its_rates(tmp_path):
    from hilstar.attitude.logs.log_file import read_log
    from hilstar.server.send_log import log_samples

    lines = [
        {"t_ns": 0, "q": [1, 0, 0, 0], "rate": [0, 0, 0.1]},
        {"t_ns": 10**9, "q": [1, 0, 0, 0], "rate": [0, 0, 0.3]},
        {"t_ns": 2 * 10**9, "q": [0, 1, 0, 0], "rate": [0, 0, 0.5], "discontinuity": True},
        {"t_ns": 3 * 10**9, "q": [0, 1, 0, 0], "rate": [0, 0, 0.5]},
    ]
    path = tmp_path / "breaks.jsonl"
    path.write_text("\n".join(map(json.dumps, lines)))
    sent = list(log_samples(read_log(path), 2.0))
    assert [sample.discontinuity for sample in sent] == [False] * 4 + [True, False, False]
    assert [float(sample.rate_cam_rad_s[2]) for sample in sent] == pytest.approx(
        [0.1, 0.2, 0.3, 0.3, 0.5, 0.5, 0.5]
    )


def test_a_gap_in_a_log_is_held_and_said_once(tmp_path, small_bench_file):
    path = tmp_path / "gap.csv"
    rows = [
        (t, propagate(from_radec_roll_deg(84, -1, 0), RATE, t)) for t in (0, 0.5, 1, 1.5, 9, 9.5)
    ]
    path.write_text(
        "\n".join(["t_s,qw,qx,qy,qz", *(f"{t},{','.join(map(repr, q.tolist()))}" for t, q in rows)])
    )
    result = run_hilstar_here(
        "replay", small_bench_file, path, "--headless", "--speed", "max", "--step", "0.5", "--json"
    )
    assert result.stderr.count("1 gap, the longest 7.5 s (over") == 1
    summary = json.loads(result.stdout)
    assert summary["events"]["log-gap"] == 1
    assert summary["stale_frames"] == 14  # 2.0 to 8.5 s
