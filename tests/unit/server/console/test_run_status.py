"""The live status of a run on a terminal: its lines and their marks, and the one short line."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hilstar.attitude.clock.timeline import Attitude
from hilstar.attitude.receiver import PacketCounts
from hilstar.basics.notices import Notices
from hilstar.basics.rotation import from_radec_roll_deg
from hilstar.basics.units import NS_PER_S
from hilstar.basics.wrong_sky import RATES
from hilstar.server.console import run_status
from hilstar.server.console.run_status import RunSource, RunStatus, StatusLine
from hilstar.server.pacer import Shown
from hilstar.server.summary import RunTally

BEGUN_NS = 50 * NS_PER_S
DRAWN = SimpleNamespace(star_count=31, clipped_hip=())
ATTITUDE = Attitude(
    from_radec_roll_deg(84.057, -1.2, 30.0),
    12_500_000,
    False,
    rate_cam_rad_s=np.radians([0.3, 0.0, -0.4]),
)


class Bench:
    """A status whose clock, run and ledger are the test's."""

    def __init__(self, monkeypatch, frames: float = math.inf, forced: str = "") -> None:
        self.now_ns = BEGUN_NS
        clock = SimpleNamespace(monotonic_ns=lambda: self.now_ns)
        monkeypatch.setattr(run_status, "time", clock)
        self.ledger = SimpleNamespace(current=None)
        source = RunSource("udp://*:5560", "llvmpipe", 60.0, frames, forced)
        self.status = RunStatus(source, self.ledger)
        self.tally = RunTally()
        self.packets = PacketCounts()
        self.watch = SimpleNamespace(alive_ns=0)
        self.notices = Notices()

    def follow(self) -> None:
        """The run begins."""
        loop = SimpleNamespace(tally=self.tally, watch=self.watch, notices=self.notices)
        self.status.follow(SimpleNamespace(loop=loop, packets=self.packets, answers=None))

    def show(self, frames: int = 1, **changes: Any) -> None:
        """Frames are shown now."""
        for _ in range(frames):
            self.tally.add(1, 1, 31, ())
        shown = {"number": 1, "t_ns": 0, "attitude": ATTITUDE, "drawn": DRAWN}
        self.status.see(Shown(**(shown | {"swap_ns": self.now_ns} | changes)))

    def lines(self) -> dict[str, StatusLine]:
        """The lines now, by their labels."""
        return {line.label: line for line in self.status.lines(self.now_ns)}


@pytest.fixture
def bench(monkeypatch) -> Bench:
    return Bench(monkeypatch)


def test_before_the_first_frame_only_the_source_and_the_display_are_known(bench):
    assert bench.status.line() == "no frame yet"
    assert not bench.status.begun() and not bench.status.alive()
    bench.follow()
    assert [line.label for line in bench.lines().values()] == ["frames", "source", "display"]
    assert bench.lines()["display"].text == "60 Hz, llvmpipe"
    assert bench.lines()["source"].text == "udp://*:5560"


def test_rates_are_those_since_the_lines_were_last_made(bench):
    bench.follow()
    bench.now_ns += 2 * NS_PER_S
    bench.packets.received, bench.tally.stale_frames = 10, 3
    bench.show(120)
    lines = bench.lines()
    assert lines["frames"] == StatusLine("frames", "120 (60.0/s), 0 missed, 3 stale")
    assert lines["packets"] == StatusLine("packets", "10 received (5.0/s), 0 refused")
    bench.packets.lost = 2
    text = "10 received (0.0/s), 0 refused (2 lost)"
    assert bench.lines()["packets"] == StatusLine("packets", text, False)
    bench.now_ns += NS_PER_S // 2
    bench.packets.received = 15
    bench.packets.refused_by["crc"] = 3
    bench.packets.lost = 2
    bench.tally.missed_frames, bench.tally.stale_frames = 4, 5
    bench.show(20)
    lines = bench.lines()
    assert lines["frames"] == StatusLine("frames", "140 (40.0/s), 4 missed, 5 stale", False)
    text = "15 received (10.0/s), 3 refused (crc 3, 2 lost)"
    assert lines["packets"] == StatusLine("packets", text, False)


def test_frames_of_a_run_with_an_end_are_out_of_so_many_and_a_standstill_is_said(monkeypatch):
    bench = Bench(monkeypatch, frames=900.0)
    bench.follow()
    bench.show(60)
    bench.now_ns += NS_PER_S
    assert bench.lines()["frames"] == StatusLine("frames", "60 of 900 (60.0/s), 0 missed, 0 stale")
    bench.now_ns += NS_PER_S // 2
    text = "60 of 900 (0.0/s), 0 missed, 0 stale; none for 1.5 s"
    assert bench.lines()["frames"] == StatusLine("frames", text, False)


def test_an_attitude_is_said_with_its_turn_and_its_age(bench):
    bench.follow()
    bench.show()
    text = "RA 84.0570, Dec -1.2000, roll 30.0000 deg, 0.5 deg/s, 12 ms old"
    assert bench.lines()["attitude"] == StatusLine("attitude", text)
    bench.show(stale=True)
    assert bench.lines()["attitude"] == StatusLine("attitude", f"{text}: STALE", False)
    for missing, word in ((True, "none yet"), (False, "hidden")):
        bench.show(attitude=None, missing=missing)
        text = f"{word}: the frames are blank"
        assert bench.lines()["attitude"] == StatusLine("attitude", text, False)


def test_a_wrong_sky_a_ledger_and_a_forced_screen_are_said_first_and_last(monkeypatch):
    bench = Bench(monkeypatch, forced="another monitor")
    bench.follow()
    bench.show(7)
    bench.tally.missed_frames, bench.packets.received = 3, 9
    bench.packets.refused_by["crc"] = 1
    bench.notices.begin(RATES, "twice as fast")
    bench.ledger.current = SimpleNamespace(path="run.mcap", size_bytes=2_345_678, failure=None)
    labels = [line.label for line in bench.status.lines(bench.now_ns)]
    assert labels == [
        "sky", "attitude", "frames", "packets", "ledger", "forced", "source", "display",
    ]  # fmt: skip
    lines = bench.lines()
    assert lines["sky"] == StatusLine("sky", "WRONG: twice as fast", False)
    assert lines["ledger"] == StatusLine("ledger", "run.mcap, 2.3 MB")
    assert lines["forced"] == StatusLine("forced", "another monitor", False)
    bench.ledger.current.failure = "no space"
    text = "run.mcap, 2.3 MB; failed: no space"
    assert bench.lines()["ledger"] == StatusLine("ledger", text, False)
    assert bench.status.line() == (
        "twice as fast; attitude RA 84.0570, Dec -1.2000, roll 30.0000 deg, 0.5 deg/s, 12 ms old;"
        " 7 frames, 3 missed; 9 packets, 1 refused; shown by --force"
    )


@pytest.mark.parametrize(("hz", "limit_s"), [(60.0, 1.0), (0.5, 6.0)])
def test_a_run_is_alive_while_its_loop_takes_steps(monkeypatch, hz, limit_s):
    """A second, or three refreshes of a slow display."""
    bench = Bench(monkeypatch)
    bench.status = RunStatus(RunSource("", "", hz))
    bench.follow()
    assert not bench.status.begun()
    bench.watch.alive_ns = bench.now_ns
    assert bench.status.begun()
    bench.now_ns += round((limit_s - 0.01) * NS_PER_S)
    assert bench.status.alive()
    bench.now_ns += round(0.02 * NS_PER_S)
    assert not bench.status.alive()
