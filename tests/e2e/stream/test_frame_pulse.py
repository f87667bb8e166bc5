"""Pulses at a run's frames, over a real socket to a serial port of another thread (RFC 2217)."""

from __future__ import annotations

import json
import os
import threading
import time

import numpy as np
import pytest

from tests.support.benches import bench_text, still_log
from tests.support.commands import assert_refused, run_hilstar_here
from tests.support.rts_server import RtsServer
from tests.support.waiting import CoreWaits

# pyserial's client asks every 50 ms whether the server has set its line: a pulse is two of those,
# and 0.4 s apart.
EVERY, REFRESH_HZ, SECONDS = 24, 60, 1.7
APART_MS = 400.0


def pulse_bench(tmp_path, port, **sync):
    path = tmp_path / "bench.toml"
    tables = {
        "render": {"quantisation": "round"},
        "sync": {"port": port, "every_frames": EVERY, **sync},
    }
    path.write_text(bench_text(tables))
    return path


@pytest.fixture
def pulse_server():
    with RtsServer() as pulse_server:
        yield pulse_server


def replayed_pulses(tmp_path, bench_file):
    log = still_log(tmp_path / "still.csv")
    kept = ("--ledger", tmp_path / "run.mcap")
    done = run_hilstar_here(
        "replay", bench_file, log, "--headless", "--stop", str(SECONDS), "--json", *kept
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout), done.stderr


@pytest.mark.timing
def test_the_far_port_sees_as_many_pulses_as_are_told_each_so_many_frames(tmp_path, pulse_server):
    with CoreWaits(os.getpid()) as waited:
        summary, _ = replayed_pulses(tmp_path, pulse_bench(tmp_path, pulse_server.url, pulse_ms=20))
    told, pulses = summary["sync"], pulse_server.pulses()
    assert told["port"] == pulse_server.url
    assert (
        len(pulses) == told["pulses"]
        and told["pulses"] + told["skipped"] <= 1 + int(SECONDS * REFRESH_HZ) // EVERY
    )
    assert told["lost"] == 0
    assert told["pulses"] >= 2, told
    assert min(down - up for up, down in pulses) >= 20e6
    # Seen from the far port, against the grid of frames: what the summary calls jitter, and the
    # socket's own.
    rises_ms = np.array([up for up, _ in pulses]) / 1e6
    off_ms = rises_ms - rises_ms[0] - np.round((rises_ms - rises_ms[0]) / APART_MS) * APART_MS
    assert np.abs(off_ms).max() < APART_MS / 4 + 1000 * waited.s, (off_ms, waited.s)
    assert told["jitter_ms"] <= told["max_delay_ms"]
    assert pulse_server.line.edges[-1][1] is False


def test_a_port_that_is_cut_stops_no_frame(tmp_path, pulse_server):
    def cut():
        # the first is over for the run too, which waits for the server's word
        while len(pulse_server.pulses()) < 2:
            time.sleep(0.01)
        pulse_server.cut()

    thread = threading.Thread(target=cut, daemon=True)
    thread.start()
    summary, said = replayed_pulses(
        tmp_path, pulse_bench(tmp_path, f"{pulse_server.url}?timeout=0.3")
    )
    thread.join()
    assert summary["sync"]["lost"] == 1 and summary["sync"]["pulses"] >= 1
    assert summary["frames"] + summary["missed_frames"] >= int(SECONDS * REFRESH_HZ)
    assert summary["events"]["sync-lost"] == 1
    assert said.count("frames go on without their pulse") == 1
    # What the run says of its pulses is in its ledger, and in the report of that.
    counts = {
        name: summary["sync"][key]
        for name, key in (("sent", "pulses"), ("skipped", "skipped"), ("lost", "lost"))
    }
    reported = run_hilstar_here(
        "report", tmp_path / "run.mcap", "-o", tmp_path / "report", "--json"
    )
    assert json.loads(reported.stdout)["pulses"] == counts
    told = run_hilstar_here("report", tmp_path / "run.mcap", "-o", tmp_path / "report").stdout
    assert (
        f"{counts['sent']} at their frames, {counts['skipped']} skipped, losses of the line: 1"
        in told
    )
    assert "only_counted" not in summary["ledger"]


def test_a_port_that_is_not_there_is_the_machine_s(tmp_path):
    path = pulse_bench(tmp_path, "/dev/nothing-there")
    result = run_hilstar_here("serve", path, "--headless", "--frames", "1")
    assert_refused(result, 3, "[sync] port = /dev/nothing-there", "plug it in")


def served_pulses(tmp_path, *changes):
    path = tmp_path / "beat.toml"
    tables = {
        "render": {"quantisation": "round", "tolerance_px": 0.02},
        "collimator": {"focal_length_mm": 350},
        "sky": {"faintest_v_mag": 3.0},
    }
    path.write_text(bench_text(tables, *changes))
    done = run_hilstar_here("serve", path, "--headless", "--frames", "2", "--json")
    assert done.returncode == 4, done.stderr  # nobody sends
    return json.loads(done.stdout).get("beat"), [
        line for line in done.stderr.splitlines() if "refreshes" in line
    ]


def test_serve_says_a_beat_that_matters_and_nothing_of_one_that_does_not(tmp_path):
    beat, lines = served_pulses(tmp_path, {"tracker": {"exposure_s": 0.105}})
    assert (
        len(lines) == 1
        and "[tracker] exposure_s = 0.1" in lines[0]
        and "1 arcsec at 1 deg/s" in lines[0]
    )
    assert beat["matters"] and beat["proposal"] == {
        "refresh_hz": pytest.approx(400 / 7),
        "exposure_s": 0.1,
        "frame_hz": None,
    }
    assert beat["refreshes_per_exposure"] == pytest.approx(6.3)
    assert beat["worst_arcsec"] == pytest.approx(1.0, rel=1e-6) and beat[
        "period_s"
    ] == pytest.approx(0.35)
    beat, lines = served_pulses(tmp_path)
    assert (
        lines == []
        and beat["worst_arcsec"] == 0.0
        and not beat["matters"]
        and beat["proposal"] is None
    )
