"""Latency by a photodiode: a watcher of the X server's real frame buffer tells of edges over a real pty."""

from __future__ import annotations

import json
import mmap
import os
import subprocess
import threading
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from hilstar.calibrate.latency import Edges, beat, pair, read_edges, save_edges
from hilstar.calibrate.toml_key import with_key
from hilstar.errors import InputError
from hilstar.run.record.records import read_run
from hilstar.run.screen.photodiode import CODE, CODE_BITS, marker_light
from tests.support.benches import ATTITUDE, SCREEN_BENCH, still_log
from tests.support.commands import HILSTAR, assert_refused, run_hilstar
from tests.support.ptys import Cable
from tests.support.screens import Screen
from tests.support.waiting import wait_for

# The watcher looks every 0.2 ms or so, and sleeps between; a shared machine may keep it from that now and then.
MEDIAN_MS = 2.0
ADDED_MS = 40.0
DEVICE_MS = 0.5  # of the same edges, a few more or less
PERIOD_NS = 1e9 / 60


class Diode:
    """Watches the screen's bottom left pixel and tells of its edges on a serial line, `added_ms` late."""

    def __init__(self, screen: Screen, line: Path, added_ms: float = 0.0, device_clock: bool = False) -> None:
        self._file, self._line, self._added_s, self._device = screen.file, line, added_ms / 1e3, device_clock
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def _watch(self) -> None:
        with self._file.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as frame:
            head = np.frombuffer(frame[:100], ">u4")
            begin, height, row_bytes, colours = (int(head[k]) for k in (0, 5, 12, 19))
            place = begin + 12 * colours + (height - 4) * row_bytes + 4 * 4
            out = os.open(self._line, os.O_WRONLY | os.O_NOCTTY)
            level, started_s = frame[place] > 127, time.monotonic()
            while not self._stop.is_set():
                if (frame[place] > 127) != level:
                    seen_s = time.monotonic()
                    level = not level
                    stamp = f",{(seen_s - started_s + 1000 + self._added_s) * 1e6:.0f}" if self._device else ""
                    time.sleep(0.001 if self._device else self._added_s)  # the line itself is late, the stamp is not
                    os.write(out, f"{int(level)}{stamp}\n".encode())
                time.sleep(0.0001)
            os.close(out)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._stop.set()
        self._thread.join()


@contextmanager
def shown(screen: Screen, folder: Path, kind: str):
    """A still sky with the photodiode square, kept in a ledger, while this is open."""
    bench = folder / "bench.toml"
    keys = f'photodiode_px = 40\nphotodiode = "{kind}"\nscanout_ms = 0'
    bench.write_text(SCREEN_BENCH.replace("[collimator]", f"{keys}\n[collimator]"))
    still_log(folder / "still.csv")
    command = ["replay", str(bench), str(folder / "still.csv"), "--ledger", str(folder / "run.mcap"), "--json", "--overwrite"]
    (folder / "run.mcap").unlink(missing_ok=True)
    with subprocess.Popen([*HILSTAR, *command], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=screen.env) as process:
        try:
            ledger = folder / "run.mcap"
            wait_for(lambda: process.poll() is not None or (ledger.exists() and ledger.stat().st_size > 20_000))
            assert process.poll() is None
            yield bench
            process.terminate()
            process.communicate(timeout=20)
        finally:
            process.kill()


def measured(screen: Screen, folder: Path, kind: str, added_ms: float, device_clock: bool, *options: str) -> tuple[dict, Path]:
    with Cable(folder) as cable, shown(screen, folder, kind) as bench, Diode(screen, cable.bench, added_ms, device_clock):
        result = run_hilstar(
            "latency",
            folder / "run.mcap",
            "--diode",
            f"serial:{cable.host}@921600",
            "--duration",
            "4",
            "--json",
            "--save",
            folder / "edges.csv",
            "--overwrite",
            "-o",
            folder / "charts",
            *options,
        )
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout), bench


def test_a_delay_that_was_added_is_found_and_written_into_the_bench_file(screen, tmp_path):
    """The screen shows a swap within a millisecond; what is added to the diode's line comes out as the panel's delay."""
    plain, _ = measured(screen, tmp_path, "code", 0.0, False)
    assert plain["edges"] > 60 and plain["unmatched"] <= 0.05 * plain["edges"]
    assert abs(plain["latency_ms"]["p50"]) < MEDIAN_MS
    assert not plain["ambiguous"]
    late, bench = measured(screen, tmp_path, "code", ADDED_MS, False, "--write", tmp_path / "bench.toml")
    assert late["latency_ms"]["p50"] - plain["latency_ms"]["p50"] == pytest.approx(ADDED_MS, abs=MEDIAN_MS)
    assert late["swap_to_square_ms"] == 0
    assert f"panel_delay_ms = {round(late['panel_delay_ms'], 3)}\n" in bench.read_text()
    assert run_hilstar("frame", bench, "--quaternion", ATTITUDE, "--truth", tmp_path / "t.csv").returncode == 0
    assert (tmp_path / "charts" / "latency.png").stat().st_size > 10_000
    again = run_hilstar("latency", tmp_path / "run.mcap", "--edges", tmp_path / "edges.csv", "--json")
    # The run went on after the edges were read: the last few find their frames only now.
    assert json.loads(again.stdout)["latency_ms"]["p50"] == pytest.approx(late["latency_ms"]["p50"], abs=DEVICE_MS)


def test_a_square_that_toggles_is_known_but_for_pairs_of_frames_and_a_device_s_own_clock_is_followed(screen, tmp_path):
    found, _ = measured(screen, tmp_path, "toggle", 0.0, True)
    assert found["ambiguous"]
    assert found["edges"] > 100
    # The device's stamps are of its own clock; its least delay on the line, 1 ms here, is what a one-way line cannot tell.
    assert found["latency_ms"]["p50"] == pytest.approx(1.0, abs=MEDIAN_MS)
    run = read_run(tmp_path / "run.mcap")
    assert [frame.marker for frame in run.frames] == [marker_light(frame.frame, "toggle") for frame in run.frames]
    assert run.process and run.process[0].resident_bytes > 1e6


def test_the_code_says_which_frame_by_any_seven():
    windows = {tuple(CODE[(k + j) % len(CODE)] for j in range(CODE_BITS)) for k in range(len(CODE))}
    assert len(windows) == len(CODE) == 127


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
    seen = Edges(np.concatenate([seen_ns[kept], noise_ns]), np.concatenate([level[changed][kept], rng.integers(0, 2, 20)]))
    paired = pair(seen, shown_edges, PERIOD_NS)
    assert not paired.ambiguous
    assert np.median(paired.latency_ns) == pytest.approx(latency_ms * 1e6, abs=1e5)
    assert paired.unmatched < 20


def test_edges_of_another_run_are_refused(rng):
    swap_ns = np.round(np.arange(400) * PERIOD_NS).astype(np.int64)
    shown_edges = Edges(swap_ns, np.arange(400) % 2)
    seen = Edges(np.sort(rng.integers(0, swap_ns[-1], 200)), rng.integers(0, 2, 200))
    with pytest.raises(InputError, match="edges fit"):
        pair(seen, shown_edges, PERIOD_NS / 4)


def test_the_beat_is_that_of_an_integral_over_frames():
    """Brute force: the mean over an exposure of where a moving star's frames are, against where it is."""
    refreshes = 6.3
    worst = 0.0
    for phase in np.linspace(0, 1, 101):
        t = phase + (np.arange(20_000) + 0.5) / 20_000 * refreshes
        worst = max(worst, abs(np.mean(np.floor(t) + 0.5 - t)))
    found = beat(60.0, refreshes / 60)
    assert found["worst_arcsec_per_deg_s"] == pytest.approx(worst * 60.0, rel=0.01)
    assert found["period_s"] == pytest.approx(refreshes / 60 / 0.3)
    assert beat(60.0, 0.1)["period_s"] is None
    assert beat(60.0, 0.0)["worst_arcsec_per_deg_s"] is None


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("[monitor]\nbits = 8\n[sky]\n", "[monitor]\nkey = 1.5\nbits = 8\n[sky]\n"),
        ("[monitor]  # ours\nkey = 9 # old\n", "[monitor]  # ours\nkey = 1.5 # old\n"),
        ("[sky]\nkey = 2\n[monitor]", "[sky]\nkey = 2\n[monitor]\nkey = 1.5\n"),
        ("[sky]\n", "[sky]\n\n[monitor]\nkey = 1.5\n"),
        ("[monitor]\nother = 2\n", "[monitor]\nkey = 1.5\n"),
    ],
)
def test_one_key_of_a_bench_file_is_set_and_nothing_else_changes(before, after):
    assert with_key(before, "monitor", "key", 1.5, instead_of=("other",)) == after


def test_what_is_wrong_is_said_in_one_line(tmp_path, small_bench_file):
    edges = tmp_path / "edges.csv"
    save_edges(edges, Edges(np.arange(30) * 10**7, np.arange(30) % 2))
    assert len(read_edges(edges).host_ns) == 30
    ledger = tmp_path / "run.mcap"
    log = tmp_path / "log.csv"
    log.write_text(f"t_s,qw,qx,qy,qz\n0,{ATTITUDE}\n0.1,{ATTITUDE}\n")
    run_hilstar("replay", small_bench_file, log, "--headless", "--speed", "max", "--ledger", ledger)
    assert_refused(run_hilstar("latency", ledger, "--edges", edges), 2, "photodiode_px")
    assert_refused(run_hilstar("latency", ledger), 2, "--edges", "--diode")
    assert_refused(run_hilstar("latency", edges, "--edges", edges), 2, "edges.csv")
    assert_refused(run_hilstar("latency", ledger, "--edges", log), 2, "host_ns")
    assert_refused(run_hilstar("latency", ledger, "--diode", "serial:/dev/nothing@9600"), 2, "/dev/nothing")
    assert_refused(run_hilstar("latency", ledger, "--diode", "tcp://x"), 2, "--diode")
    assert_refused(run_hilstar("report", log, "-o", tmp_path / "r"), 2, "log.csv")
    assert_refused(run_hilstar("report", tmp_path / "no.mcap", "-o", tmp_path / "r"), 2, "no.mcap")
