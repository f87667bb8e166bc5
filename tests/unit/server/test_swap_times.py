"""Swaps of a model display with more back buffers, deadlines and time stamps than the usual:
gate, clock and pacer are real.
"""

from __future__ import annotations

import logging

import numpy as np
import pytest

from hilstar.attitude.clock.timeline import Attitude
from hilstar.basics.errors import MachineError
from hilstar.basics.notices import Notices
from hilstar.server.loop import FrameLoop, Limit
from hilstar.server.pacer import Moment, Shown
from hilstar.server.screen.gate import GUARDS_MS, pass_gate
from hilstar.server.screen.screen import DisplayPacer
from tests.support.model_display import model_screen

HZ = (60, 144, 240)
MS = 1e6
# of the swap clock's prediction, which stamps of a steady display settle to nanoseconds
ON_TIME_NS = 20_000
# while a queue fills, swaps return between refreshes and pull the clock a little
QUEUED_NS = 250_000
TURNING = Attitude(
    np.array([1.0, 0.0, 0.0, 0.0]), 0, False, rate_cam_rad_s=np.array([0.0, 0.03, 0.0])
)


class ModelRun:
    """A bench on a model display: past the gate, then `frames` frames."""

    def __init__(self, tmp_path, hz: float = 60, force: bool = False, **display) -> None:
        self.screen, self.display = model_screen(tmp_path, hz, **display)
        clock = self.display.clock
        self.to_light_ns = self.screen.swap_to_light_ns  # of a flip
        self.timing = pass_gate(self.screen, force, clock)
        self.notices = Notices()
        self.pacer = DisplayPacer(self.screen, self.notices, clock)
        self.moments: list[Moment] = []
        self.shown: list[Shown] = []
        self.loop = FrameLoop(
            self.screen.bench, self.shown.append, self.pacer, notices=self.notices
        )

    def frames(self, slots: int) -> np.ndarray:
        """Show so many refresh periods; how much later than predicted the light of each frame
        came, ns.
        """
        self.moments.clear()
        before = len(self.display.flips_ns)
        self.loop.paced(Limit(slots=slots), self._draw)
        flips_ns = np.array(self.display.flips_ns[before:])
        return flips_ns + self.to_light_ns - np.array([moment.light_ns for moment in self.moments])

    def _draw(self, moment: Moment) -> Shown | None:
        self.moments.append(moment)
        return self.loop.draw(moment.slot, 0, TURNING, moment)


@pytest.mark.parametrize("hz", HZ)
@pytest.mark.parametrize("stamp_ms", [-0.3, 0.0, 0.2, 0.5])
def test_a_stamp_ahead_of_now_is_the_driver_s_time_of_the_swap(tmp_path, hz, stamp_ms):
    """Linux stamps the end of a blank at its beginning: with stamps refused, light was a refresh
    late behind three buffers.
    """
    run = ModelRun(tmp_path, hz, buffers=3, stamp_ns=round(stamp_ms * MS))
    late_ns = run.frames(100)
    assert run.display.timestamp_source == "GLX_OML_sync_control"
    assert run.timing.queued == 0 and run.loop.tally.missed_frames == 0
    assert np.abs(late_ns + stamp_ms * MS).max() < ON_TIME_NS


@pytest.mark.parametrize("wrong_ms", [25.0, -1500.0])
def test_stamps_of_another_clock_are_given_up(tmp_path, caplog, wrong_ms):
    with caplog.at_level(logging.WARNING):
        run = ModelRun(tmp_path, stamp_ns=round(wrong_ms * MS))
        late_ns = run.frames(100)
    assert run.display.timestamp_source == "after-swap clock"
    assert "gives no time of swaps" in caplog.text
    assert np.abs(late_ns).max() < ON_TIME_NS


def test_single_gaps_between_stamps_cost_nothing(tmp_path, caplog):
    run = ModelRun(tmp_path, stamp_ns=0, stampless=lambda number: number % 10 == 3)
    assert np.abs(run.frames(200)).max() < ON_TIME_NS
    assert {frame.timestamp_source for frame in run.shown} == {
        "GLX_OML_sync_control",
        "after-swap clock",
    }
    assert "gives no time" not in caplog.text


@pytest.mark.parametrize("hz", HZ)
@pytest.mark.parametrize("buffers", [2, 3, 4])
def test_frames_that_a_driver_holds_back_are_found_and_refused_or_reckoned_with(
    tmp_path, hz, buffers
):
    held = buffers - 2
    if held:
        with pytest.raises(
            MachineError, match=f"holds {held} finished frame.* back.*after the swap.*--force"
        ):
            ModelRun(tmp_path, hz, buffers=buffers)
    run = ModelRun(tmp_path, hz, force=True, buffers=buffers)
    assert run.timing.queued == held
    assert np.abs(run.frames(100)[4:]).max() < (QUEUED_NS if held else ON_TIME_NS)
    assert run.loop.screen_summary()["queued_frames"] == held


@pytest.mark.parametrize(
    ("deadline_ms", "hz"), [(0.2, 60), (0.9, 60), (1.3, 60), (1.3, 240), (3.1, 60), (3.1, 144)]
)
def test_a_driver_that_needs_longer_is_found_by_the_gate(tmp_path, deadline_ms, hz):
    """With a guard of 1 ms and a driver that needs 1.3, every frame was a refresh late, at half
    the rate, for good.
    """
    run = ModelRun(tmp_path, hz, deadline_ns=round(deadline_ms * MS))
    assert run.timing.guard_ms == pytest.approx(
        min(next(guard_ms for guard_ms in GUARDS_MS if guard_ms > deadline_ms), 500 / hz)
    )
    late_ns = run.frames(200)
    assert np.abs(late_ns).max() < ON_TIME_NS
    assert run.loop.tally.missed_frames == 0
    assert run.loop.screen_summary()["guard_ms"] == run.timing.guard_ms


def test_a_driver_that_comes_to_need_longer_is_followed_within_a_second(tmp_path):
    run = ModelRun(tmp_path)
    run.frames(100)
    run.display.deadline_ns = round(1.9 * MS)
    late = np.abs(run.frames(120)) > ON_TIME_NS
    assert late[:3].any() and not late[60:].any()
    assert run.notices.counts()["guard-raised"] >= 1
    assert run.screen.budget.guard_ns > 1.9 * MS


def test_frames_that_were_late_themselves_do_not_raise_the_guard(tmp_path):
    run = ModelRun(tmp_path)
    for _ in range(20):
        assert not run.screen.budget.add_flip(lead_ns=-2 * MS, late_ns=16.7 * MS)
        assert not run.screen.budget.add_flip(lead_ns=1 * MS, late_ns=0.01 * MS)
    assert run.screen.budget.guard_ns == 1 * MS
