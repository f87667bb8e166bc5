"""The unit of a log's times, by its rates where it has them and by its own steps where not."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hilstar.attitude.logs.log_file import open_log, read_log
from hilstar.attitude.logs.log_times import _ratio, span_line, time_notices
from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.basics.rotation import from_rotation_vector
from tests.support.benches import SMALL_BENCH
from tests.support.commands import run_hilstar_here
from tests.support.sources.aem_messages import kvn

RATE = np.radians([0.1, -0.3, 1.0])
COUNT = 50


def rows_in_time(step_s: float, rates: bool, scale: float = 1.0):
    for k in range(COUNT):
        turn = Rotation.from_rotvec(-RATE * step_s * k) * Rotation.from_euler(
            "xyz", [10, 20, 30], degrees=True
        )
        yield (
            k * step_s,
            turn.as_quat(scalar_first=True).tolist(),
            (RATE * scale).tolist() if rates else None,
        )


def log_in_units(
    tmp_path, kind: str, unit_s: float, step_s: float, rates: bool, scale: float = 1.0
):
    """A log whose times are written in a unit of `unit_s` seconds."""
    path = tmp_path / f"a.{kind}"
    if kind == "csv":
        lines = ["t_s,qw,qx,qy,qz,rx,ry,rz"]
        for t_s, q, rate in rows_in_time(step_s, rates, scale):
            turning = ["", "", ""] if rate is None else map(repr, rate)
            lines.append(",".join([repr(t_s / unit_s), *map(repr, q), *turning]))
    else:
        lines = []
        for t_s, q, rate in rows_in_time(step_s, rates, scale):
            lines.append(
                json.dumps({"t_ns": round(t_s / unit_s), "q": q} | ({"rate": rate} if rate else {}))
            )
    path.write_text("\n".join(lines) + "\n")
    return path


def notices(path) -> tuple[str, str]:
    log = open_log(path)
    return dict(log.told).get("log-times", ""), dict(log.joins().told).get("log-rates", "")


@pytest.mark.parametrize("step_s", [0.005, 0.02, 0.1])
@pytest.mark.parametrize(
    ("unit", "unit_s"),
    [("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9), ("minutes", 60.0), ("days", 86400.0)],
)
def test_the_rates_of_a_csv_name_the_unit_of_its_times(tmp_path, unit, unit_s, step_s):
    said, rates = notices(log_in_units(tmp_path, "csv", unit_s, step_s, rates=True))
    assert said.startswith(f"the rates do not fit the times: probably the times are in {unit}")
    assert said.endswith("; the format has s")
    assert "probably" not in rates, "one cause is named, not two"


@pytest.mark.parametrize("unit", ["s", "ms", "us", "ns"])
def test_a_csv_has_the_unit_that_its_column_s_name_states(tmp_path, unit):
    path = tmp_path / "a.csv"
    path.write_text(f"t_{unit},qw,qx,qy,qz\n0,1,0,0,0\n5,1,0,0,0\n")
    assert open_log(path).conventions.time_unit == unit


@pytest.mark.parametrize(("unit", "unit_s"), [("us", 1e-6), ("ms", 1e-3), ("100 ns", 1e-7)])
def test_the_rates_of_json_lines_name_the_unit_of_their_times(tmp_path, unit, unit_s):
    said, _ = notices(log_in_units(tmp_path, "jsonl", unit_s, 0.02, rates=True))
    assert f"the times are in {unit}" in said
    assert said.endswith("; the format has ns")


def test_rates_of_another_unit_are_named_where_the_times_would_be_odd(tmp_path):
    said, _ = notices(log_in_units(tmp_path, "csv", 1.0, 0.02, rates=True, scale=1e3))
    assert "probably the rates are in mrad/s" in said
    said, _ = notices(log_in_units(tmp_path, "csv", 1e-3, 0.005, rates=True))
    # 5 s or 5 ms: both are a log's
    assert "the times are in ms, or the rates are in mrad/s" in said


@pytest.mark.parametrize("rates", [False, True])
@pytest.mark.parametrize(("kind", "unit_s"), [("csv", 1.0), ("jsonl", 1e-9)])
def test_nothing_is_said_of_times_that_are_right(tmp_path, kind, unit_s, rates):
    for step_s in (0.001, 0.02, 1.0):
        assert notices(log_in_units(tmp_path, kind, unit_s, step_s, rates)) == ("", "")


@pytest.mark.parametrize(
    ("kind", "unit_s", "limit"),
    [("csv", 1e-3, "over 10 s"), ("csv", 1e3, "under 0.1 ms"), ("jsonl", 1e-6, "under 0.1 ms")],
)
def test_without_rates_an_odd_step_is_told(tmp_path, kind, unit_s, limit):
    said, _ = notices(
        log_in_units(tmp_path, kind, unit_s, 0.02 if unit_s != 1e3 else 0.05, rates=False)
    )
    assert limit in said
    assert "a step of" in said


def test_a_format_that_has_dates_is_not_asked(tmp_path):
    path = tmp_path / "a.aem"
    path.write_text(kvn([f"2026-01-01T00:{k:02}:00 0 0 0 1" for k in range(5)]))
    assert notices(path) == ("", "")


@pytest.mark.parametrize("command", ["replay", "attitude", "convert", "simulate", "send"])
def test_every_command_that_reads_a_log_tells_of_an_odd_step(tmp_path, command):
    bench = tmp_path / "bench.toml"
    bench.write_text(SMALL_BENCH)
    log = log_in_units(tmp_path, "csv", 1e-3, 0.02, rates=False)
    words = {
        "replay": (bench, log, "--headless", "--speed", "max", "--step", "400"),
        "attitude": (log,),
        "convert": (log, tmp_path / "b.csv"),
        "simulate": (bench, "--log", log, "--frames", "1", "-o", tmp_path / "out"),
        "send": (log, "--to", "udp://127.0.0.1:9", "--wait", "0", "--count", "1"),
    }
    result = run_hilstar_here(command, *words[command])
    assert result.returncode == 0, result.stderr
    assert (
        "the log is 980 s long: 50 attitudes, a step of 20 s (median), which is over 10 s"
        in result.stderr
    )


def test_a_replay_says_how_long_its_log_is(tmp_path):
    bench = tmp_path / "bench.toml"
    bench.write_text(SMALL_BENCH)
    log = log_in_units(tmp_path, "csv", 1.0, 0.02, rates=False)
    result = run_hilstar_here("replay", bench, log, "--headless", "--speed", "max", "--step", "0.5")
    assert "the log is 0.98 s long: 50 attitudes, a step of 0.02 s (median)\n" in result.stderr
    assert "which is" not in result.stderr


@pytest.mark.parametrize(
    ("t_s", "words"),
    [
        ((7,), "the log is a single attitude"),
        ((7, 9), "the log is 2 s long: 2 attitudes, a step of 2 s (median)"),
        ((7, 9, 10, 20), "the log is 13 s long: 4 attitudes, a step of 2 s (median)"),
    ],
)
def test_a_log_s_length_is_from_its_first_attitude_to_its_last(t_s, words):
    q = np.array([1.0, 0, 0, 0])
    assert span_line([AttitudeSample(second * 10**9, q) for second in t_s]) == words


def test_a_csv_with_t_ns_is_read_in_ns_and_says_so(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("t_ns,qw,qx,qy,qz\n0,1,0,0,0\n1763800000123456789,1,0,0,0\n")
    result = run_hilstar_here("attitude", path)
    assert result.returncode == 0
    assert "column t_ns is in ns: its numbers are multiplied by 1e-9, to be in s" in result.stderr
    assert [sample.t_ns for sample in read_log(path)] == [0, 1763800000123456789]


def test_a_unit_that_no_rates_are_written_in_is_named_alone(tmp_path):
    said, _ = notices(log_in_units(tmp_path, "csv", 60.0, 0.1, rates=True))
    assert said.startswith("the rates do not fit the times: probably the times are in minutes;")


@pytest.mark.parametrize(
    ("kind", "unit_s", "scale", "words"),
    [
        ("csv", 1.0, 1e3, "the rates are in mrad/s"),
        ("csv", 1.0, 1e-3, ""),
        ("jsonl", 1e-9, 1e-3, "the times are in us, or the rates are in rad/ms"),
        ("jsonl", 1e-9, 1e3, ""),
    ],
)
def test_rates_of_another_unit_are_named_in_each_format_s_unit(
    tmp_path, kind, unit_s, scale, words
):
    """A step of 5 ms: of times in us it would be 5 s, which a log may have, too."""
    said, _ = notices(log_in_units(tmp_path, kind, unit_s, 0.005, rates=True, scale=scale))
    if words:
        assert f"probably {words};" in said
    else:
        assert "rates are in" not in said


# The turn by rates about z is 1000 times the quaternions', about an axis that is inclined so far.
@pytest.mark.parametrize(("inclined_deg", "is_named"), [(8.0, True), (15.0, False)])
def test_rates_about_another_axis_say_nothing_of_the_times(inclined_deg, is_named):
    axis = np.array([np.sin(np.radians(inclined_deg)), 0.0, np.cos(np.radians(inclined_deg))])
    samples = [
        AttitudeSample(
            k * 10**9,
            from_rotation_vector(-axis * 1e-4 * k),
            np.array([0.0, 0.0, 0.1]),
        )
        for k in range(10)
    ]
    assert bool(time_notices(samples, "s")) is is_named


def test_a_turn_across_a_jump_says_nothing_of_the_times_and_one_after_it_does():
    """A log of pairs 20 ms apart, its times in ms: before each pair it jumps about x."""
    axis = np.array([0.0, 0.0, 1.0])
    samples = []
    for k in range(20):
        turned = Rotation.from_rotvec(-0.002 * axis * (k % 2)) * Rotation.from_rotvec(
            [k // 2, 0, 0]
        )
        q = turned.as_quat(scalar_first=True)
        jumps = k % 2 == 0
        samples.append(AttitudeSample(k * 20 * 10**9, q, 0.1 * axis, k, discontinuity=jumps))
    ((_, said),) = time_notices(samples, "s")
    assert "the times are in ms" in said


def turning_in_ms(rates_rad_s: list[float | None], turns: list[float]) -> list[AttitudeSample]:
    """A log about z whose times are in ms and read as s: samples 20 ms apart, with rates; by each
    of `turns`, rad, it turns to the next.
    """
    samples = []
    for k, rate in enumerate(rates_rad_s):
        q = Rotation.from_rotvec([0, 0, -sum(turns[:k])]).as_quat(scalar_first=True)
        known = None if rate is None else np.array([0.0, 0.0, rate])
        samples.append(AttitudeSample(k * 20 * 10**9, q, known, k))
    return samples


ACCELERATING = [0.1 * 1.5**k for k in range(9)]
# a gyroscope's own drift, of a body that rests
RESTING = 1e-12


@pytest.mark.parametrize(
    ("rates_rad_s", "turns", "is_named"),
    [
        ([0.1] * 6, [0.002] * 5, True),
        ([0.1] * 5, [0.002] * 4, False),  # too few intervals
        ([0.1] * 5 + [RESTING] * 9, [0.002] * 4 + [0.0] * 9, False),
        ([0.1] * 6 + [RESTING] * 9, [0.002] * 5 + [0.0] * 9, True),
        ([0.1] * 6 + [None] + [0.1] * 2, [0.002] * 8, True),
        ([0.1, None] * 6, [0.002] * 11, False),  # no interval has a rate at both of its ends
        # by the mean of its ends' rates, 1.25 times the first
        (ACCELERATING, [0.02 * 1.25 * rate for rate in ACCELERATING[:-1]], True),
    ],
)
def test_the_unit_of_a_log_s_times_is_named_by_five_intervals_that_turn(
    rates_rad_s, turns, is_named
):
    told = time_notices(turning_in_ms(rates_rad_s, turns), "s")
    assert any("the times are in ms" in line for _, line in told) is is_named


def test_the_ratio_of_rates_and_turns_is_that_of_most_intervals():
    """One rate of twenty is a hundred times as long as the others."""
    turned = np.tile([0.01, 0.0, 0.0], (20, 1))
    by_rate = 1000.0 * turned
    by_rate[7] *= 100.0
    assert _ratio(turned, by_rate) == pytest.approx(1000.0)
