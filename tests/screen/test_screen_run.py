"""A second on a 1080p window under Xvfb, over 200 stars, 200 Hz of packets: every frame accounted
for, and what it shows is true.
"""

from __future__ import annotations

import json
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from hilstar.attitude.logs.log_file import read_log
from hilstar.basics.resources import resource_path
from hilstar.basics.rotation import angle_between_rad, propagate
from tests.support.commands import run_hilstar_here, run_started, typed
from tests.support.forks import HILSTAR, Started
from tests.support.ledgers import read_run
from tests.support.live_runs import MAX_EXTRAPOLATION_NS
from tests.support.run_page import run_data_of
from tests.support.senders import free_port
from tests.support.waiting import PATIENCE_S
from tests.support.x11.screens import xvfb

DURATION_S, REFRESH_HZ, PACKET_HZ = 1, 60, 200
RATE_DEG_S = 0.5
# A packet's rate is float32 of 0.0087 rad/s: 5e-10 of it, over at most 0.25 s of prediction; and
# the clock's own line, 5 us.
POINTING_ARCSEC = 0.02
ARCSEC_PER_RAD = 206_264.8


@pytest.fixture(scope="module")
def screen_run(tmp_path_factory) -> tuple[dict, Path]:
    """The demo's bench with more stars, on a virtual screen of its own."""
    folder = tmp_path_factory.mktemp("run")
    text = resource_path("configs", "demo.toml").read_text()
    port = free_port()
    text = text.replace("tcp://127.0.0.1:*", f"tcp://127.0.0.1:{port}").replace(
        "faintest_v_mag = 7.5", "faintest_v_mag = 8.0"
    )
    # frames in a row, on a busy machine too
    text = text.replace('quantisation = "exact"', 'quantisation = "round"')
    assert '"round"' in text
    bench, ledger = folder / "bench.toml", folder / "run.mcap"
    bench.write_text(text)
    serve = [*HILSTAR, *typed(f"serve --json --duration {DURATION_S} --ledger", ledger, bench)]
    spin = f"send --spin x,{RATE_DEG_S} --rate {PACKET_HZ} --duration {DURATION_S + PATIENCE_S}"
    send = [*HILSTAR, *typed(f"{spin} --to tcp://127.0.0.1:{port} --connect")]
    with xvfb(folder, "1920x1080x24") as screen, Started(send, stderr=subprocess.DEVNULL) as sender:
        try:
            done = run_started(serve, env=screen.env)
        finally:
            sender.terminate()
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout), ledger


def test_every_refresh_period_is_a_frame_or_missed(screen_run):
    summary, ledger = screen_run
    assert summary["frames"] + summary["missed_frames"] == DURATION_S * REFRESH_HZ
    frames = read_run(ledger).frames
    assert len(frames) == summary["frames"]
    assert (
        sum(frame.missed_before for frame in frames)
        == frames[-1].missed
        <= summary["missed_frames"]
    )
    assert summary["stars_drawn"]["max"] > 200
    assert summary["packets"]["refused"] == 0


def test_each_frame_says_when_it_was_drawn_predicted_swapped_and_lit(screen_run):
    frames = read_run(screen_run[1]).frames
    assert all(a.swap_ns < b.swap_ns for a, b in pairwise(frames))
    for frame in frames:
        assert frame.predicted_swap_ns is not None
        assert frame.draw_ns < frame.swap_ns
        assert frame.timestamp_source == "after-swap clock, software pacing"
        if frame.q is not None:
            assert frame.receive_ns is not None and frame.receive_ns < frame.swap_ns
            assert frame.rate is not None  # 0.5 deg/s is worth a path
            assert frame.prediction_ns > 0


def test_what_was_drawn_is_where_the_packets_say_the_camera_is_when_the_middle_row_lights(
    screen_run,
):
    ledger = screen_run[1]
    samples = read_log(ledger)
    times_ns = np.array([sample.t_ns for sample in samples])
    checked = 0
    frames = read_run(ledger).frames
    for frame in frames:
        if frame.q is None or frame.light_ns > times_ns[-1]:
            continue
        # Where the sender was held up for longer than may be predicted, the attitude is held.
        at_ns = min(frame.light_ns, frame.attitude_t_ns + MAX_EXTRAPOLATION_NS)
        sample = samples[int(np.searchsorted(times_ns, at_ns)) - 1]
        true = propagate(sample.q_icrs_to_cam, sample.rate_cam_rad_s, (at_ns - sample.t_ns) / 1e9)
        assert angle_between_rad(true, np.array(frame.q)) * ARCSEC_PER_RAD < POINTING_ARCSEC
        checked += 1
    assert checked > len(frames) / 2 > 2


def test_the_report_says_it_on_one_page(screen_run, tmp_path):
    summary, ledger = screen_run
    result = run_hilstar_here("report", ledger, "-o", tmp_path / "report", "--json")
    assert result.returncode == 0, result.stderr
    found = json.loads(result.stdout)
    assert (
        found["frames"] == summary["frames"] and found["missed_frames"] <= summary["missed_frames"]
    )
    # None without a row
    assert found["pacing_jitter_ms"] == pytest.approx(summary["screen"]["pacing_jitter_ms"])
    for key in ("attitude_age_ms", "packet_to_swap_ms", "swap_late_ms"):
        assert found[key]["p50"] is not None
    assert found["packets"]["accepted"] == summary["packets"]["accepted"]
    assert found["memory_growth_mb"] is None  # a run of less than a minute says nothing of that
    assert len(found["bench_sha256"]) == len(found["calibration_sha256"]) == 64
    page = (tmp_path / "report" / "report.html").read_text()
    data = run_data_of(page)
    assert [len(data["spans"][name][0]) for name in ("interval", "late", "age")] == 3 * [
        len(data["spans"]["t_s"])
    ]
    assert sum(data["spans"]["missed"]) == found["missed_frames"]
    # The pictures are the codes that the run showed: replay draws them again from the same ledger.
    assert len(data["pictures"]) > min(8, found["frames"] - 1)
    assert not list((tmp_path / "report").glob("*.png"))
    told = run_hilstar_here("report", ledger, "-o", tmp_path / "report")
    assert "pacing jitter" in told.stdout and "age of the attitude at light" in told.stdout


def test_paths_are_drawn_again_from_the_ledger(screen_run, tmp_path):
    """The moving stars of the run are no points, and not those of a run that stands still."""
    ledger = screen_run[1]
    bench = ledger.parent / "bench.toml"
    still = bench.parent / "still.toml"
    still.write_text(bench.read_text() + "motion_above_px = 1e6\n")
    frames = read_run(ledger).frames
    at_s = (
        next(frame for frame in frames[len(frames) // 2 :] if frame.rate).swap_ns
        - frames[0].swap_ns
    ) / 1e9
    words = f"replay --headless --speed max --start {at_s - 1e-6} --stop {at_s + 1e-6}"
    for path in (bench, still):
        drawn = run_hilstar_here(words, path, ledger, "-o", tmp_path / path.stem)
        assert drawn.returncode == 0, drawn.stderr
    name = sorted(path.name for path in (tmp_path / "bench").glob("*.png"))[0]
    moving, standing = (np.array(Image.open(tmp_path / run / name)) for run in ("bench", "still"))
    assert (moving != standing).any()


def test_the_frame_path_makes_no_cycles_for_the_collector():
    """The loop runs without Python's garbage collector: nothing may need it."""
    program = """
import gc, sys
from pathlib import Path
import numpy as np
from hilstar.basics.rotation import from_radec_roll_deg
from hilstar.attitude.clock.timeline import Attitude
from hilstar.server.bench.build import load
from hilstar.server.loop import FrameLoop
from hilstar.basics.resources import resource_path
with load(resource_path("configs", "demo.toml")) as bench:
    loop = FrameLoop(bench, moving=True)
    turning = Attitude(from_radec_roll_deg(84, 0, 0), 0, False, rate_cam_rad_s=np.array([0.001, 0.01, 0.0]))
    for number in range(10):
        loop.draw(number, 0, turning)
    gc.collect()
    gc.disable()
    for number in range(30):
        loop.draw(number, 0, turning)
    print(gc.collect())
"""
    result = run_started([sys.executable, "-c", program])
    assert result.returncode == 0, result.stderr
    assert int(result.stdout) == 0
