"""What is told of an attitude that comes and goes, and of frames that are late or hang; on a
clock of the test's own.
"""

from __future__ import annotations

import threading

import numpy as np
import pytest

from hilstar.attitude.clock.timeline import Attitude
from hilstar.basics.notices import Notices
from hilstar.server.watchdog import AttitudeWatch, FrameWatch, GpuWatch
from tests.support.fake_clock import FakeClock, WellGpu
from tests.support.waiting import PATIENCE_S

PERIOD_NS = 16_666_667
FRESH = Attitude(np.array([1.0, 0.0, 0.0, 0.0]), 5_000_000, False)
OLD = Attitude(np.array([1.0, 0.0, 0.0, 0.0]), 400_000_000, True)


@pytest.fixture
def told():
    """Notices, and the lines that they told."""
    notices, lines = Notices(), []
    notices.listen(lambda notice: lines.append((notice.kind, notice.detail)))
    return notices, lines


def test_two_seconds_without_an_attitude_are_told_once_and_the_first_one_with_its_wait(told):
    notices, lines = told
    clock = FakeClock()
    watch = AttitudeWatch(notices, clock)
    for _ in range(10):
        watch.see(None, True)
        clock.work(0.5e9)
    watch.see(FRESH, False)
    watch.see(FRESH, False)
    assert [kind for kind, _ in lines] == ["no-attitude", "first-attitude"]
    assert "after 5.0 s" in lines[1][1]


def test_an_attitude_that_goes_stale_is_told_with_its_age_and_when_it_is_fresh_again(told):
    notices, lines = told
    clock = FakeClock()
    watch = AttitudeWatch(notices, clock)
    watch.see(FRESH, False)
    clock.work(7e9)
    for _ in range(3):
        watch.see(OLD, True)
        clock.work(1e9)
    watch.see(FRESH, False)
    assert [kind for kind, _ in lines] == ["first-attitude", "stale", "fresh"]
    assert "0.4 s old" in lines[1][1] and "after 3.0 s" in lines[2][1]


def test_a_late_frame_is_told_with_its_stages_at_most_once_a_second(told):
    notices, lines = told
    clock = FakeClock()
    watch = FrameWatch(PERIOD_NS, notices, clock)
    for number in range(5):
        watch.begin(number)
        clock.work(60e6)
        watch.enter("draw")
        clock.work(20e6)
        watch.end(timed=True)
    assert lines == [("frame-late", "frame 0 took 80 ms: sprites 60.0, draw 20.0")]
    clock.work(1e9)
    watch.begin(5)
    clock.work(60e6)
    watch.end(timed=True)
    assert len(lines) == 2


@pytest.mark.parametrize(
    ("took_ns", "refresh_hz", "timed"),
    [(45e6, 60, True), (3e9, 60, False), (45e6, 240, True), (140e6, 20, True)],
)
def test_neither_a_frame_of_three_periods_nor_one_without_a_moment_is_late(
    told, took_ns, refresh_hz, timed
):
    """Nor one of under 50 ms where three periods are shorter."""
    notices, lines = told
    clock = FakeClock()
    watch = FrameWatch(1e9 / refresh_hz, notices, clock)
    watch.begin(0)
    clock.work(took_ns)
    watch.end(timed)
    assert lines == []


def test_a_frame_that_hangs_is_told_once_with_its_stage_while_it_hangs():
    """The watchdog's thread looks by the wall's clock, four times a second."""
    notices, clock, told = Notices(), FakeClock(), threading.Event()
    lines: list[str] = []
    notices.listen(lambda notice: (lines.append(notice.detail), told.set()))
    with FrameWatch(PERIOD_NS, notices, clock) as watch:
        watch.begin(7)
        watch.enter("swap")
        clock.work(2e9)
        assert told.wait(PATIENCE_S)
        watch.end(timed=True)
    assert lines[0] == "frame 7 hangs in its stage swap since 2.0 s"
    assert len(lines) == 2 and "frame 7 took" in lines[1]
    assert notices.counts() == {"frame-stuck": 1, "frame-late": 1}


class SleepingClock(FakeClock):
    """Of a machine that has slept for `asleep` ns in all."""

    asleep = 0

    def asleep_ns(self) -> int:
        return self.asleep


class WokenGpu(WellGpu):
    """Counts how often its images are forgotten; `changed` of its tables are not as they were."""

    forgotten = changed = 0

    def changed_tables(self) -> int:
        return self.changed

    def forget_images(self) -> None:
        self.forgotten += 1


def test_after_a_sleep_the_next_frame_is_drawn_on_black_and_lost_tables_end_the_run(told):
    """A driver may lose the GPU's memory without an error."""
    notices, lines = told
    clock, gpu, stop = SleepingClock(), WokenGpu(), threading.Event()
    watch = GpuWatch(gpu, notices, stop, clock)
    for asleep_ns, changed, forgotten in ((0, 0, 0), (10**8, 3, 0), (5 * 10**9, 0, 1)):
        clock.asleep, gpu.changed = asleep_ns, changed
        clock.work(1.1e9)
        watch.look()
        assert (gpu.forgotten, stop.is_set()) == (forgotten, False)
    clock.asleep, gpu.changed = 9 * 10**9, 2
    clock.work(0.5e9)
    watch.look()  # not before a second has passed
    assert not stop.is_set()
    clock.work(0.6e9)
    watch.look()
    assert stop.is_set()
    assert [kind for kind, _ in lines] == ["resumed", "resumed", "gpu-lost"]
    assert "slept for 4.9 s" in lines[0][1] and "2 of the tables" in lines[2][1]
