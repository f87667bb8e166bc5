"""Latency by a photodiode: a watcher of the X server's real frame buffer tells of edges over a
real pty.
"""

from __future__ import annotations

import contextlib
import json
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from hilstar.server.screen.screen import marker_light
from tests.support.benches import ATTITUDE, SCREEN_BENCH, still_log
from tests.support.commands import run_hilstar, run_hilstar_here
from tests.support.forks import HILSTAR, Started
from tests.support.ledgers import read_run
from tests.support.waiting import PATIENCE_S, best_of_three, in_time, real_time, wait_for
from tests.support.wire.ptys import Cable
from tests.support.x11.diode import Diode
from tests.support.x11.screens import Screen, xvfb

# The watcher looks every 0.2 ms or so, and sleeps between; a shared machine may keep it from that
# now and then.
MIN_EDGES, MAX_UNMATCHED = 40, 0.05  # share of the edges
MEDIAN_MS = 2.0
ADDED_MS = 40.0
WATCHED_S = 2  # some 60 edges of the code
DEVICE_MS = 0.5  # of the same edges, a few more or less
PERIOD_NS = 1e9 / 60
STEADY_NS = 1e6  # by which the pairing takes latencies together


@pytest.fixture(scope="module")
def screen(tmp_path_factory) -> Iterator[Screen]:
    """A screen that shows at once what it is sent."""
    with contextlib.ExitStack() as stack:
        with real_time():
            running = stack.enter_context(xvfb(tmp_path_factory.mktemp("screen")))
        yield running


@contextmanager
def still_sky(screen: Screen, folder: Path, kind: str):
    """A still sky with the photodiode square, kept in a ledger, while this is open."""
    bench = folder / "bench.toml"
    keys = f'photodiode_px = 40\nphotodiode = "{kind}"\nscanout_ms = 0'
    bench.write_text(SCREEN_BENCH.replace("[collimator]", f"{keys}\n[collimator]"))
    still_log(folder / "still.csv")
    command = [
        "replay",
        str(bench),
        str(folder / "still.csv"),
        "--ledger",
        str(folder / "run.mcap"),
        "--json",
        "--overwrite",
    ]
    (folder / "run.mcap").unlink(missing_ok=True)
    with Started(
        [*HILSTAR, *command], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=screen.env
    ) as process:
        try:
            ledger = folder / "run.mcap"
            wait_for(
                lambda: (
                    process.poll() is not None
                    or (ledger.exists() and ledger.stat().st_size > 5_000)
                )
            )
            assert process.poll() is None
            yield bench
            process.terminate()
            process.communicate(timeout=PATIENCE_S)
        finally:
            process.kill()


def measured_latency(
    screen: Screen, folder: Path, kind: str, added_ms: float, device_clock: bool, *options: str
) -> tuple[dict, Path]:
    with (
        Cable(folder) as cable,
        still_sky(screen, folder, kind) as bench,
        Diode(screen, cable.sender, added_ms, device_clock),
    ):
        diode = ["--diode", f"serial:{cable.host}@921600", "--duration", str(WATCHED_S)]
        output = ["--json", "--save", folder / "edges.csv", "--overwrite"]
        with real_time():
            result = run_hilstar("latency", folder / "run.mcap", *diode, *output, *options)
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout), bench


def measured_undisturbed(*wanted, edges: int = MIN_EDGES) -> tuple[dict, Path]:
    """A measurement in which the diode saw what was shown: the diode is a thread here, and a
    busy machine holds it up.
    """
    deadline_s = time.monotonic() + PATIENCE_S
    while True:
        found, bench = measured_latency(*wanted)
        if found["edges"] > edges and found["unmatched"] <= MAX_UNMATCHED * found["edges"]:
            return found, bench
        assert time.monotonic() < deadline_s, (
            f"in each measurement too many edges belong to no frame: {found}"
        )


@best_of_three("the diode is a thread of this process: while it has no core, it sees a light late")
def test_a_delay_that_was_added_is_found_and_written_into_the_bench_file(screen, tmp_path):
    """The screen shows a swap within a millisecond; what is added to the diode's line comes out
    as the panel's delay.
    """
    plain, _ = measured_undisturbed(screen, tmp_path, "code", 0.0, False)
    in_time(abs(plain["latency_ms"]["p50"]) < MEDIAN_MS, plain)
    assert not plain["ambiguous"]
    # Its line keeps this diode from looking for so long: not every edge is seen, and those that
    # are, are as late as this.
    late, bench = measured_latency(
        *(screen, tmp_path, "code", ADDED_MS, False),
        *("--write", tmp_path / "bench.toml", "-o", tmp_path / "charts"),
    )
    added_ms = late["latency_ms"]["p50"] - plain["latency_ms"]["p50"]
    in_time(abs(added_ms - ADDED_MS) < MEDIAN_MS, (plain, late))
    assert late["swap_to_square_ms"] == 0
    assert f"panel_delay_ms = {round(late['panel_delay_ms'], 3)}\n" in bench.read_text()
    assert (
        run_hilstar_here(
            "frame", bench, "--quaternion", ATTITUDE, "--truth", tmp_path / "t.csv"
        ).returncode
        == 0
    )
    assert (tmp_path / "charts" / "latency.png").stat().st_size > 10_000
    again = run_hilstar_here(
        "latency", tmp_path / "run.mcap", "--edges", tmp_path / "edges.csv", "--json"
    )
    # The run went on after the edges were read: the last few find their frames only now.
    assert json.loads(again.stdout)["latency_ms"]["p50"] == pytest.approx(
        late["latency_ms"]["p50"], abs=DEVICE_MS
    )


@best_of_three("the diode is a thread of this process: while it has no core, it sees a light late")
def test_a_square_that_toggles_is_known_but_for_pairs_of_frames_and_a_device_s_own_clock_is_followed(
    screen, tmp_path
):
    found, _ = measured_undisturbed(screen, tmp_path, "toggle", 0.0, True, edges=70)
    run = read_run(tmp_path / "run.mcap")
    steady = np.abs(np.diff([frame.swap_ns for frame in run.frames]) - PERIOD_NS) < STEADY_NS
    # A busy machine swaps at uneven times, and they tell one pair of frames from the next as a code
    # does.
    assert found["ambiguous"] or steady.mean() < 0.95
    # The device's stamps are of its own clock; its least delay on the line, 1 ms here, is what a
    # one-way line cannot tell.
    in_time(abs(found["latency_ms"]["p50"] - 1.0) < MEDIAN_MS, found)
    assert [frame.marker for frame in run.frames] == [
        marker_light(frame.frame, "toggle") for frame in run.frames
    ]
    assert run.process and run.process[0].resident_bytes > 1e6
