"""A photodiode's edges with the frames that caused them."""

from __future__ import annotations

import numpy as np
import pytest

from hilstar.instruments.calibrate import latency
from hilstar.instruments.calibrate.latency import (
    Edges,
    Paired,
    pair,
    read_edges,
    save_edges,
    summarise,
)
from hilstar.server.bench.config import parse_config
from hilstar.server.screen.screen import CODE, CODE_BITS, marker_light
from tests.support.benches import ATTITUDE, SMALL_BENCH
from tests.support.commands import assert_refused, run_hilstar_here

PERIOD_NS = 1e9 / 60


@pytest.mark.parametrize("latency_ms", [3.0, 21.0, 68.5, 250.0])
def test_any_latency_is_found_again_through_jitter_lost_edges_and_noise(latency_ms, rng):
    level = np.array([marker_light(k, "code") for k in range(600)])
    swap_ns = 5_000_000_000 + np.round(np.arange(600) * PERIOD_NS).astype(np.int64)
    changed = np.flatnonzero(np.diff(level)) + 1
    shown_edges = Edges(swap_ns[changed], level[changed])
    jitter_ns = np.round(rng.normal(0, 2e5, len(changed))).astype(np.int64)
    seen_ns = shown_edges.host_ns + round(latency_ms * 1e6) + jitter_ns
    kept = np.sort(rng.choice(len(changed), len(changed) * 4 // 5, replace=False))
    noise_ns = rng.integers(swap_ns[0], swap_ns[-1], 20)
    seen = Edges(
        np.concatenate([seen_ns[kept], noise_ns]),
        np.concatenate([level[changed][kept], rng.integers(0, 2, 20)]),
    )
    paired = pair(seen, shown_edges, PERIOD_NS)
    assert not paired.ambiguous
    assert np.median(paired.latency_ns) == pytest.approx(latency_ms * 1e6, abs=1e5)
    assert paired.unmatched < 20


def test_a_panel_s_delay_is_the_median_less_the_way_of_the_scan_to_the_square(tmp_path):
    """Of edges that rise after 20 ms and fall after 23 ms."""
    config = parse_config(tmp_path / "bench.toml", SMALL_BENCH)
    level = np.array([1, 0, 1, 0, 1])
    paired = Paired(np.where(level, 20e6, 23e6), level, unmatched=0, ambiguous=False)
    found = summarise(paired, config)
    assert (found["rise_ms"], found["fall_ms"]) == (20.0, 23.0)
    assert found["latency_ms"]["p50"] == 20.0
    to_square_ms = found["swap_to_square_ms"]
    assert to_square_ms == pytest.approx(1e3 / config.monitor.refresh_hz)  # the usual scan-out
    assert found["panel_delay_ms"] == pytest.approx(20.0 - to_square_ms)


@pytest.mark.parametrize("drift_ppm", [0.0, 100.0, -100.0])
def test_a_device_s_own_times_are_microseconds_of_a_clock_of_its_own(monkeypatch, drift_ppm):
    """Edges that a slow line brings late in 200 s stand where the device saw them, which was
    switched on a quarter of an hour after the host.
    """
    true_ns = 10**12 + np.arange(40) * 5_000_000_000
    device_ns = np.round((true_ns - 10**12) * (1 + 1e-6 * drift_ppm)).astype(np.int64)
    late_ns = np.resize([1_000_000, 9_000_000, 4_000_000], 40)
    lines = [
        (int(at + late), f"{k % 2},{device // 1000}".encode())
        for k, (at, late, device) in enumerate(zip(true_ns, late_ns, device_ns, strict=True))
    ]
    monkeypatch.setattr(latency, "read_lines", lambda *_: lines)
    edges = latency.capture_edges("/dev/none", 115200, 2.0)
    np.testing.assert_allclose(edges.host_ns - true_ns, 1_000_000, atol=100_000)
    assert edges.level.tolist() == [0, 1] * 20


def test_the_code_says_which_frame_by_any_seven():
    windows = {tuple(CODE[(k + j) % len(CODE)] for j in range(CODE_BITS)) for k in range(len(CODE))}
    assert len(windows) == len(CODE) == 127


def test_what_is_wrong_is_said_in_one_line(tmp_path, small_bench_file):
    edges = tmp_path / "edges.csv"
    save_edges(edges, Edges(np.arange(30) * 10**7, np.arange(30) % 2))
    assert len(read_edges(edges).host_ns) == 30
    ledger = tmp_path / "run.mcap"
    log = tmp_path / "log.csv"
    log.write_text(f"t_s,qw,qx,qy,qz\n0,{ATTITUDE}\n0.1,{ATTITUDE}\n")
    run_hilstar_here(
        "replay", small_bench_file, log, "--headless", "--speed", "max", "--ledger", ledger
    )
    assert_refused(run_hilstar_here("latency", ledger, "--edges", edges), 2, "photodiode_px")
    assert_refused(run_hilstar_here("latency", ledger), 2, "--edges", "--diode")
    assert_refused(run_hilstar_here("latency", edges, "--edges", edges), 2, "edges.csv")
    assert_refused(run_hilstar_here("latency", ledger, "--edges", log), 2, "host_ns")
    assert_refused(
        run_hilstar_here("latency", ledger, "--diode", "serial:/dev/nothing@9600"),
        3,
        "/dev/nothing",
    )
    assert_refused(run_hilstar_here("latency", ledger, "--diode", "tcp://x"), 2, "--diode")
    assert_refused(run_hilstar_here("report", log, "-o", tmp_path / "r"), 2, "log.csv")
    assert_refused(
        run_hilstar_here("report", tmp_path / "no.mcap", "-o", tmp_path / "r"), 2, "no.mcap"
    )
