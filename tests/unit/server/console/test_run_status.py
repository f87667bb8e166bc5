"""The live status of a run on a terminal: its lines and their marks, and the one short line."""

from __future__ import annotations

import io
import logging
import math
import sys
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
from hilstar.server.console.run_status import RunSource, RunStatus, StatusLine, on_terminal
from hilstar.server.loop import FrameLoop
from hilstar.server.pacer import Shown
from hilstar.server.record.ledger import Ledger, LedgerSwitch
from hilstar.server.run_progress import Running
from tests.support.drawn import drawn
from tests.support.waiting import wait_for

BEGUN_NS = 50 * NS_PER_S
DRAWN = drawn(np.zeros((3, 4), np.uint8))
ATTITUDE = Attitude(
    from_radec_roll_deg(84.057, -1.2, 30.0),
    12_500_000,
    False,
    rate_cam_rad_s=np.radians([0.3, 0.0, -0.4]),
)


class FollowedRun:
    """A status whose clock and run are the test's."""

    def __init__(self, loop: FrameLoop, frames: float = math.inf, **source: Any) -> None:
        self.now_ns = BEGUN_NS
        self.ledger = LedgerSwitch()
        known = {"refresh_hz": 60.0, "forced": ""} | source
        self.status = RunStatus(
            RunSource("udp://*:5560", "llvmpipe", frames=frames, **known),
            self.ledger,
            lambda: self.now_ns,
        )
        self.loop = loop
        self.tally, self.packets = loop.tally, PacketCounts()

    def follow(self) -> None:
        """The run begins."""
        self.status.follow(Running(self.loop, self.packets))

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
def run(loop: FrameLoop) -> FollowedRun:
    return FollowedRun(loop)


def test_before_the_first_frame_only_the_source_and_the_display_are_known(run):
    assert run.status.line() == "no frame yet"
    assert not run.status.begun() and not run.status.alive()
    run.follow()
    assert [line.label for line in run.lines().values()] == ["frames", "source", "display"]
    assert run.lines()["display"].text == "60 Hz, llvmpipe"
    assert run.lines()["source"].text == "udp://*:5560"


def test_rates_are_those_since_the_lines_were_last_made(run):
    run.follow()
    run.now_ns += 2 * NS_PER_S
    run.packets.received, run.tally.stale_frames = 10, 3
    run.show(120)
    lines = run.lines()
    assert lines["frames"] == StatusLine("frames", "120 (60.0/s), 0 missed, 3 stale")
    assert lines["packets"] == StatusLine("packets", "10 received (5.0/s), 0 refused")
    run.packets.lost = 2
    text = "10 received (0.0/s), 0 refused (2 lost)"
    assert run.lines()["packets"] == StatusLine("packets", text, False)
    run.now_ns += NS_PER_S // 2
    run.packets.received = 15
    run.packets.refused_by["crc"] = 3
    run.packets.lost = 2
    run.tally.missed_frames, run.tally.stale_frames = 4, 5
    run.show(20)
    lines = run.lines()
    assert lines["frames"] == StatusLine("frames", "140 (40.0/s), 4 missed, 5 stale", False)
    text = "15 received (10.0/s), 3 refused (crc 3, 2 lost)"
    assert lines["packets"] == StatusLine("packets", text, False)


def test_frames_of_a_run_with_an_end_are_out_of_so_many_and_a_standstill_is_said(loop):
    run = FollowedRun(loop, frames=900.0)
    run.follow()
    run.show(60)
    run.now_ns += NS_PER_S
    assert run.lines()["frames"] == StatusLine("frames", "60 of 900 (60.0/s), 0 missed, 0 stale")
    run.now_ns += NS_PER_S // 2
    text = "60 of 900 (0.0/s), 0 missed, 0 stale; none for 1.5 s"
    assert run.lines()["frames"] == StatusLine("frames", text, False)


def test_an_attitude_is_said_with_its_turn_and_its_age(run):
    run.follow()
    run.show()
    text = "RA 84.0570, Dec -1.2000, roll 30.0000 deg, 0.5 deg/s, 12 ms old"
    assert run.lines()["attitude"] == StatusLine("attitude", text)
    run.show(stale=True)
    assert run.lines()["attitude"] == StatusLine("attitude", f"{text}: STALE", False)
    for missing, word in ((True, "none yet"), (False, "hidden")):
        run.show(attitude=None, missing=missing)
        text = f"{word}: the frames are blank"
        assert run.lines()["attitude"] == StatusLine("attitude", text, False)


def test_a_wrong_sky_a_ledger_and_a_forced_screen_are_said_first_and_last(
    loop, small_bench, tmp_path, monkeypatch
):
    monkeypatch.setattr(Ledger, "size_bytes", 12_360_000)  # 11.8 MiB
    run = FollowedRun(loop, forced="another monitor")
    run.follow()
    run.show(7)
    run.tally.missed_frames, run.packets.received = 3, 9
    run.packets.refused_by["crc"] = 1
    run.loop.notices.begin(RATES, "twice as fast")
    with Ledger(tmp_path / "run.mcap", small_bench, Notices()) as ledger:
        run.ledger.current = ledger
        labels = [line.label for line in run.status.lines(run.now_ns)]
        assert labels == [
            "sky", "attitude", "frames", "packets", "ledger", "forced", "source", "display",
        ]  # fmt: skip
        lines = run.lines()
        assert lines["sky"] == StatusLine("sky", "WRONG: twice as fast", False)
        text = f"{ledger.path}, 12.4 MB"
        assert lines["ledger"] == StatusLine("ledger", text)
        assert lines["forced"] == StatusLine("forced", "another monitor", False)
        ledger.failure = "no space"
        text = f"{text}; failed: no space"
        assert run.lines()["ledger"] == StatusLine("ledger", text, False)
    assert run.status.line() == (
        "twice as fast; attitude RA 84.0570, Dec -1.2000, roll 30.0000 deg, 0.5 deg/s, 12 ms old;"
        " 7 frames, 3 missed; 9 packets, 1 refused; shown by --force"
    )


@pytest.mark.parametrize(("hz", "limit_s"), [(60.0, 1.0), (0.5, 6.0)])
def test_a_run_is_alive_while_its_loop_takes_steps(loop, hz, limit_s):
    """A second, or three refreshes of a slow display."""
    run = FollowedRun(loop, refresh_hz=hz)
    run.follow()
    assert not run.status.begun()
    run.loop.watch.alive_ns = run.now_ns
    assert run.status.begun()
    run.now_ns += round((limit_s - 0.01) * NS_PER_S)
    assert run.status.alive()
    run.now_ns += round(0.02 * NS_PER_S)
    assert not run.status.alive()


class Terminal(io.StringIO):
    """A stream that says it is a terminal."""

    def isatty(self) -> bool:
        return True


def test_log_lines_stand_above_the_live_lines_and_afterwards_where_they_stood(run, monkeypatch):
    terminal = Terminal()
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(sys, "stderr", terminal)
    handler = logging.StreamHandler(terminal)
    logging.getLogger().addHandler(handler)
    try:
        with on_terminal(run.status):
            wait_for(lambda: handler.stream is not terminal, "the live lines")
        assert handler.stream is terminal
    finally:
        logging.getLogger().removeHandler(handler)


@pytest.mark.parametrize("term", ["dumb", "unknown", "Dumb"])
def test_on_a_terminal_that_erases_no_line_a_status_is_a_line_from_time_to_time(
    run, monkeypatch, term
):
    """As in Emacs' shell or on a serial console; rich would draw nothing there."""
    terminal = Terminal()
    monkeypatch.setenv("TERM", term)
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setattr(run_status, "PLAIN_EACH_S", 0.001)
    with on_terminal(run.status):
        wait_for(lambda: terminal.getvalue().count("\n") > 1, "lines")
    lines = terminal.getvalue().splitlines()
    assert all(line.startswith("hilstar: 0 s: ") for line in lines)
    assert "\x1b" not in terminal.getvalue()
