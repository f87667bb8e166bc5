"""A photodiode's edges with the frames that caused them."""

from __future__ import annotations

import numpy as np
import pytest

from hilstar.instruments.calibrate import latency
from hilstar.instruments.calibrate.latency import (
    Edges,
    Paired,
    draw_latency,
    edges_of,
    latency_lines,
    nearest_of,
    pair,
    read_edges,
    save_edges,
    summarise,
    swap_to_square_ms,
    write_panel_delay,
)
from hilstar.server.bench.config import parse_config
from hilstar.server.screen.screen import CODE, CODE_BITS, marker_light
from tests.support.benches import ATTITUDE, SMALL_BENCH, bench_text
from tests.support.commands import assert_refused, run_hilstar_here
from tests.support.refusals import refusal

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
def test_a_device_s_own_times_are_microseconds_of_a_clock_of_its_own(drift_ppm):
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
    edges = latency.edges_in(lines, "serial:/dev/none@115200")
    np.testing.assert_allclose(edges.host_ns - true_ns, 1_000_000, atol=100_000)
    assert edges.level.tolist() == [0, 1] * 20


EDGES = Edges(np.arange(30) * 40_000_000 + 7, np.arange(30) % 2)


def test_edges_are_read_as_they_are_written(tmp_path):
    save_edges(tmp_path / "edges.csv", EDGES)
    found = read_edges(tmp_path / "edges.csv")
    assert found.host_ns.tolist() == EDGES.host_ns.tolist()
    assert found.level.tolist() == EDGES.level.tolist()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda text: "\n".join(text.splitlines()[:20]), "at least 20 edges are needed"),
        (lambda text: text.replace(",1", ",2"), "each of level 0 or 1"),
        (lambda text: text.replace("7,0", "7.5,0"), "not a file of edges"),
        (lambda text: text + f"{2**63},1\n", "not a file of edges"),
    ],
)
def test_a_file_of_other_edges_is_refused(tmp_path, change, words):
    path = tmp_path / "edges.csv"
    save_edges(path, EDGES)
    path.write_text(change(path.read_text()))
    assert words in refusal(read_edges, path)


def test_the_changes_of_a_square_are_the_swaps_at_which_its_level_differs():
    swap_ns = np.array([10, 20, 30, 40, 50])
    shown = edges_of(swap_ns, np.array([1, 1, 0, 0, 1]))
    assert (shown.host_ns.tolist(), shown.level.tolist()) == ([30, 50], [0, 1])


def test_a_moment_is_matched_with_the_nearest_on_either_side():
    moments = np.array([100, 200, 400])
    wanted = np.array([-5.0, 149.0, 151.0, 299.0, 301.0, 900.0])
    assert nearest_of(moments, wanted).tolist() == [100, 100, 200, 200, 400, 400]


def test_a_square_that_toggles_is_ambiguous_by_pairs_of_frames(rng):
    """And edges of another run are none of this one's."""
    swap_ns = np.round(np.arange(200) * PERIOD_NS).astype(np.int64)
    shown = Edges(swap_ns, np.arange(200) % 2)
    seen = Edges(swap_ns + 21_000_000, shown.level)
    paired = pair(seen, shown, PERIOD_NS)
    assert paired.ambiguous
    latency_ms = paired.latency_ns / 1e6
    # the shortest: 21 ms by whole pairs of 33.3 ms less
    assert np.ptp(latency_ms) < 1e-6
    assert (latency_ms[0] - 21) % (2e-6 * PERIOD_NS) == pytest.approx(0, abs=1e-6)
    later = Edges(seen.host_ns + 10**12, seen.level)
    assert "of 0 edges fit" in refusal(pair, later, shown, PERIOD_NS)
    chance = Edges(np.sort(rng.integers(0, swap_ns[-1], 200)), rng.integers(0, 2, 200))
    assert "during the run" in refusal(pair, chance, shown, PERIOD_NS / 20)


@pytest.mark.parametrize(
    ("rotate_deg", "share"), [(0, 1 - 12 / 240), (180, 1 - 12 / 240), (90, 1 - 12 / 320)]
)
def test_a_square_s_middle_is_half_its_side_above_the_foot(tmp_path, rotate_deg, share):
    """Of a screen of 320 x 240 px, whose scan of 8 ms runs along the image's width where it stands
    on its side.
    """
    monitor = {"photodiode_px": 24, "scanout_ms": 8.0, "rotate_deg": rotate_deg}
    config = parse_config(tmp_path / "bench.toml", bench_text({"monitor": monitor}))
    assert swap_to_square_ms(config.monitor) == pytest.approx(8.0 * share)


def test_a_measured_delay_is_written_with_its_error_and_the_rest_stays(tmp_path):
    path = tmp_path / "bench.toml"
    path.write_text(SMALL_BENCH + "# a word\n")
    write_panel_delay(path, 6.12345, 0.012345)
    config = parse_config(path, path.read_text())
    assert config.monitor.panel_delay_ms == 6.123
    assert config.certify.panel_delay_u_ms == 0.0123
    assert "# a word" in path.read_text()
    before = path.read_text()
    assert "2.50 ms before the scan-out" in refusal(write_panel_delay, path, -2.5, 0.1)
    assert path.read_text() == before


def test_the_lines_have_the_figures(tmp_path):
    config = parse_config(tmp_path / "bench.toml", SMALL_BENCH)
    level = np.array([1, 0, 1, 0, 1])
    paired = Paired(np.where(level, 20e6, 23e6), level, unmatched=4, ambiguous=True)
    lines = latency_lines(summarise(paired, config))
    text = {line[:24].strip(): line[24:] for line in lines}
    assert text["edges"] == "5 paired, 4 without a frame"
    assert text["swap to light"] == "20.00 / 20.00 / 23.00 ms (p1 / p50 / p99)"
    assert text["rise, fall"] == "20.00, 23.00 ms (medians)"
    # three at 20 ms and two at 23
    jitter_ms = 3 * np.sqrt(0.6 * 0.4)
    assert text["jitter"] == f"{jitter_ms:.3f} ms (standard deviation)"
    error_ms = 1.2533 * jitter_ms / np.sqrt(5)
    assert text["panel_delay_ms"] == f"{20 - 1e3 / 60:.3f} +- {error_ms:.3f}"
    assert "whole pairs of frames" in text["note"]
    rises = Paired(np.full(5, 20e6), np.ones(5, dtype=int), 0, ambiguous=False)
    text = {line[:24].strip(): line[24:] for line in latency_lines(summarise(rises, config))}
    assert text["rise, fall"] == "20.00, - ms (medians)"
    assert "note" not in text


def test_latencies_are_drawn_by_the_level_after_their_edge(tmp_path, figures):
    """Three rises of 20 ms, and falls of 23 and 24."""
    config = parse_config(tmp_path / "bench.toml", SMALL_BENCH)
    latency_ns = np.array([20e6, 23e6, 20e6, 24e6, 20e6])
    paired = Paired(latency_ns, np.array([1, 0, 1, 0, 1]), unmatched=0, ambiguous=False)
    draw_latency(tmp_path / "latency", paired, summarise(paired, config))
    (axes,) = figures[0].axes
    names = [text.get_text() for text in axes.get_legend().get_texts()]
    drawn = {}
    for name, bars in zip(names, axes.containers, strict=True):
        lit = [bar for bar in bars if bar.get_height()]
        drawn[name] = [
            (bar.get_height(), bar.get_x(), bar.get_x() + bar.get_width()) for bar in lit
        ]
    (rises,) = drawn["dark to light"]
    assert (rises[0], rises[1]) == (3, 20.0)
    (first, last) = drawn["light to dark"]
    assert (first[0], last[0]) == (1, 1)
    assert first[1] <= 23.0 < first[2] < last[1] < 24.0
    assert last[2] == pytest.approx(24.0)


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


def test_edges_of_which_some_have_no_time_of_the_device_s_are_those_of_their_arrival():
    """And lines that are no edges are passed over."""
    lines = [(1000 * k, f"{k % 2},{k}".encode()) for k in range(20)]
    lines[7] = (7000, b"1")
    noise = [(5, b"2,1"), (6, b"hello"), (7, b"1,-3"), (8, b"")]
    edges = latency.edges_in([*noise, *lines], "serial:/dev/none@115200")
    assert edges.host_ns.tolist() == [1000 * k for k in range(20)]
    assert edges.level.tolist() == [0, 1] * 10
    words = refusal(latency.edges_in, lines[1:], "serial:/dev/none@115200")
    assert words.startswith("serial:/dev/none@115200: 19 edges came, and at least 20 are needed")


@pytest.mark.parametrize("late_ms", [12.5, 0.5, -2.5, 340.5])
def test_the_most_frequent_delay_is_the_middle_of_its_millisecond(late_ms):
    """Of delays that scatter by a millisecond about it: others are looked for half a period to
    either side.
    """
    level = np.array([marker_light(k, "code") for k in range(200)])
    swap_ns = 5_000_000_000 + np.round(np.arange(200) * PERIOD_NS).astype(np.int64)
    shown = edges_of(swap_ns, level)
    scatter_ns = 1_000_000 * (np.arange(len(shown.host_ns)) % 3 - 1)
    seen = Edges(shown.host_ns + round(late_ms * 1e6) + scatter_ns, shown.level)
    assert latency._likely_latency_ns(seen, shown) == (late_ms * 1e6, False)
