"""The frame loop and the pacer of a run without a screen, on a clock of the test's own: every
slot is a frame or missed.
"""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest

from hilstar.attitude.clock.timeline import Attitude
from hilstar.optics.layers.view import View
from hilstar.server.bench.config import AttitudeSettings, parse_config
from hilstar.server.loop import FrameLoop, Limit, policy_of
from hilstar.server.pacer import Moment, Pacer, Shown
from tests.support.benches import SMALL_BENCH
from tests.support.fake_clock import FakeClock, WellGpu

PERIOD_NS = 16_666_667  # 60 Hz, as the small bench's monitor has it
STILL = Attitude(np.array([1.0, 0.0, 0.0, 0.0]), 0, False)
OLD = Attitude(np.array([1.0, 0.0, 0.0, 0.0]), 10**9, True)


class SlowBench:
    """A bench whose sprites take as many ns as `cost` says of a frame's number, and whose
    drawing takes a millisecond. Its errors are claimed of turns up to 1 deg/s.
    """

    effort = SimpleNamespace(is_chosen=True, claimed_turn_deg_s=1.0)
    capped: ClassVar[dict[int, int]] = {}  # stars with coarser paths, by the frame's number

    def __init__(self, tmp_path, clock: FakeClock, cost, more: str = "") -> None:
        self.config = parse_config(tmp_path / "bench.toml", SMALL_BENCH + more)
        self.renderer = WellGpu()
        self.asked: list[object] = []
        self._clock, self._cost, self._number = clock, cost, 0

    def begin(self, number: int) -> None:
        self._number = number

    view = View

    def light(self, view, faults=None):
        self.asked.append(view.rate_cam_rad_s)
        self._clock.work(self._cost(self._number))
        return view.q_icrs_to_cam

    def draw_sprites(self, sprites, number):
        self._clock.work(1e6)
        return SimpleNamespace(
            levels=None,
            star_count=0 if sprites is None else 7,
            clipped_hip=(),
            capped=self.capped.get(number, 0),
        )


class LoopRun:
    """A paced run of `limit` on a fake clock."""

    def __init__(
        self, tmp_path, limit: Limit, cost=lambda number: 0, more: str = "", attitude=STILL
    ) -> None:
        self.clock = FakeClock()
        bench = SlowBench(tmp_path, self.clock, cost, more)
        self.shown: list[Shown] = []
        self.loop = FrameLoop(bench, self.shown.append, Pacer(PERIOD_NS, self.clock))
        self.lights_ns: list[int] = []

        def draw_slot(moment: Moment) -> Shown | None:
            bench.begin(moment.slot)
            self.lights_ns.append(moment.light_if_begun_at(self.clock.now_ns()))
            return self.loop.draw(moment.slot, 0, attitude, moment)

        self.loop.paced(limit, draw_slot)

    @property
    def numbers(self) -> list[int]:
        return [frame.number for frame in self.shown]


def test_frames_stand_on_a_grid_of_the_clock(tmp_path):
    run = LoopRun(tmp_path, Limit(slots=100))
    assert run.numbers == list(range(100))
    assert run.lights_ns == [1_000_000_000 + k * PERIOD_NS for k in range(100)]
    assert run.loop.tally.missed_frames == 0


def test_a_wait_that_wakes_late_shifts_no_later_frame(tmp_path):
    clock = FakeClock(wakes_late_ns=100_000)
    pacer = Pacer(PERIOD_NS, clock)
    begins = []
    for moment in pacer.moments():
        clock.wait_until(moment.begin_ns, pacer.stop)
        begins.append(moment.begin_ns)
        if moment.slot == 50:
            break
    assert begins == [1_000_000_000 + k * PERIOD_NS for k in range(51)]


@pytest.mark.parametrize(("cost_periods", "missed"), [(0.5, 0), (1.5, 1), (1.96, 2)])
def test_a_slow_frame_misses_the_slots_that_pass_meanwhile(tmp_path, cost_periods, missed):
    """With the millisecond of drawing, 1.96 periods are more than two."""
    run = LoopRun(
        tmp_path, Limit(slots=20), lambda number: cost_periods * PERIOD_NS if number == 5 else 0
    )
    assert run.numbers == [*range(6), *range(6 + missed, 20)]
    assert run.loop.tally.missed_frames == missed
    assert [frame.missed_before for frame in run.shown if frame.missed_before] == (
        [missed] if missed else []
    )


def test_a_frame_whose_sprites_took_too_long_is_given_up_and_the_next_is_shown(tmp_path):
    run = LoopRun(tmp_path, Limit(slots=20), lambda number: 3.5 * PERIOD_NS if number == 3 else 0)
    assert run.numbers == [0, 1, 2, *range(7, 20)]
    tally = run.loop.tally
    assert (tally.given_up_frames, tally.missed_frames, tally.frames) == (1, 4, 16)
    assert run.shown[3].missed_before == 4  # its own slot, and the three that passed
    assert run.loop.notices.counts()["frame-given-up"] == 1


@pytest.mark.parametrize(("turn_deg_s", "told"), [(0.0, 0), (1.05, 0), (5.0, 1), (30.0, 1)])
def test_a_turn_beyond_what_effort_claims_is_told_once(tmp_path, turn_deg_s, told):
    turning = replace(STILL, rate_cam_rad_s=(0.0, math.radians(turn_deg_s), 0.0))
    for motion, count in (("on", told), ("off", 0)):
        more = f'[render]\nmotion = "{motion}"\n'
        run = LoopRun(tmp_path, Limit(slots=20), more=more, attitude=turning)
        assert run.loop.notices.counts().get("beyond-claim", 0) == count


def test_frames_with_coarser_paths_are_counted_and_the_first_is_told(tmp_path, monkeypatch):
    monkeypatch.setattr(SlowBench, "capped", {2: 3, 4: 5})
    run = LoopRun(tmp_path, Limit(slots=6))
    assert run.loop.tally.capped_frames == 2
    assert run.loop.notices.counts()["capped"] == 1


def test_no_two_frames_in_a_row_are_given_up(tmp_path):
    run = LoopRun(tmp_path, Limit(slots=60), lambda number: 3.5 * PERIOD_NS)
    begun = len(run.shown) + run.loop.tally.given_up_frames
    assert len(run.shown) == begun // 2 > 5
    assert run.loop.tally.frames + run.loop.tally.missed_frames == 60


def test_each_frame_says_how_many_slots_before_it_had_none_of_their_own(tmp_path, rng):
    """Whatever they cost, given up or not, in a row or not: half of the frames take up to five
    periods.
    """
    costs_periods = np.maximum(rng.uniform(-5, 5, 200), 0)
    run = LoopRun(tmp_path, Limit(slots=200), lambda number: costs_periods[number] * PERIOD_NS)
    assert run.loop.tally.given_up_frames > 10
    without = np.diff(run.numbers) - 1
    assert [frame.missed_before for frame in run.shown[1:]] == without.tolist()


def test_a_run_ends_after_so_many_frames_whatever_was_missed(tmp_path):
    run = LoopRun(
        tmp_path, Limit(frames=10), lambda number: 1.5 * PERIOD_NS if number % 4 == 0 else 0
    )
    assert len(run.shown) == 10
    assert run.loop.tally.missed_frames == sum(frame.missed_before for frame in run.shown)


def test_slots_after_the_end_of_a_run_are_not_missed(tmp_path):
    run = LoopRun(tmp_path, Limit(slots=6), lambda number: 10.5 * PERIOD_NS if number == 4 else 0)
    assert run.numbers == [0, 1, 2, 3]
    assert run.loop.tally.frames + run.loop.tally.missed_frames == 6


def test_a_stopped_run_draws_no_other_frame(tmp_path):
    clock = FakeClock()
    loop = FrameLoop(SlowBench(tmp_path, clock, lambda number: 0), pacer=Pacer(PERIOD_NS, clock))
    drawn = []

    def draw_slot(moment: Moment) -> Shown | None:
        drawn.append(moment.slot)
        if moment.slot == 3:
            loop.stop.set()
        return loop.draw(moment.slot, 0, STILL, moment)

    loop.paced(Limit(), draw_slot)
    assert drawn == [0, 1, 2, 3]


def test_frames_of_a_lead_in_are_not_counted(tmp_path):
    clock = FakeClock()
    shown = []
    loop = FrameLoop(
        SlowBench(tmp_path, clock, lambda number: 0), shown.append, Pacer(PERIOD_NS, clock)
    )
    loop.lead_in(lambda moment: loop.draw(moment.slot, 0, None, moment), lambda: len(shown) == 5)
    assert [frame.missing for frame in shown] == [True] * 5
    loop.paced(Limit(slots=7), lambda moment: loop.draw(moment.slot, 0, STILL, moment))
    assert (loop.tally.frames, loop.tally.stale_frames, loop.tally.missed_frames) == (7, 0, 0)
    assert [frame.number for frame in shown[5:]] == list(range(7))


def test_a_stopped_lead_in_ends(tmp_path):
    clock = FakeClock()
    loop = FrameLoop(SlowBench(tmp_path, clock, lambda number: 0), pacer=Pacer(PERIOD_NS, clock))
    loop.stop.set()
    loop.lead_in(lambda moment: pytest.fail("it was stopped"), lambda: False)
    assert loop.tally.frames == 0


@pytest.mark.parametrize(("stage", "frames"), [("blank", 61), ("paced", 61), ("idle", 0)])
def test_a_gpu_that_is_lost_ends_a_run_whatever_its_loop_does(tmp_path, monkeypatch, stage, frames):
    """It is looked for once a second: before the first attitude, between frames, and while no
    frame is due.
    """
    clock = FakeClock()
    shown: list[Shown] = []
    bench = SlowBench(tmp_path, clock, lambda number: 0)
    loop = FrameLoop(bench, shown.append, Pacer(PERIOD_NS, clock))
    monkeypatch.setattr(WellGpu, "fault", lambda gpu: "the GPU was reset")

    def draw(moment: Moment) -> Shown | None:
        return loop.draw(moment.slot, 0, STILL, moment)

    if stage == "blank":
        loop.lead_in(draw, lambda: len(shown) == 200)
    elif stage == "paced":
        loop.paced(Limit(slots=200), draw)
    else:
        clock.work(1.1e9)
        loop.idle()
    assert loop.stop.is_set()
    assert loop.notices.counts()["gpu-lost"] == 1
    assert len(shown) == frames


@pytest.mark.parametrize(("on_stale", "blank"), [("hold", False), ("blank", True)])
def test_a_stale_attitude_is_held_or_blank_as_the_bench_file_says(tmp_path, on_stale, blank):
    run = LoopRun(
        tmp_path, Limit(slots=3), more=f'[attitude]\non_stale = "{on_stale}"\n', attitude=OLD
    )
    assert [frame.attitude is None for frame in run.shown] == [blank] * 3
    assert run.loop.tally.stale_frames == 3


def test_a_paused_sky_stays_while_the_link_is_stale(tmp_path):
    clock = FakeClock()
    bench = SlowBench(tmp_path, clock, lambda number: 0, '[attitude]\non_stale = "blank"\n')
    loop = FrameLoop(bench, pacer=Pacer(PERIOD_NS, clock))
    blank = []
    for attitude, paused in ((STILL, False), (OLD, True), (OLD, False)):
        loop.pacer.operator.aids.set("pause", paused)
        shown = loop.draw(0, 0, attitude)
        blank.append((shown.stale, shown.attitude is None))
    assert blank == [(False, False), (True, False), (True, True)]


def test_without_an_attitude_a_frame_is_blank_and_says_so(tmp_path):
    run = LoopRun(tmp_path, Limit(slots=2), attitude=None)
    assert all(
        frame.missing and frame.attitude is None and frame.drawn.star_count == 0
        for frame in run.shown
    )


def test_a_frame_that_has_no_moment_is_never_late(tmp_path):
    clock = FakeClock()
    loop = FrameLoop(
        SlowBench(tmp_path, clock, lambda number: 100 * PERIOD_NS), pacer=Pacer(PERIOD_NS, clock)
    )
    assert loop.draw(0, 0, STILL) is not None
    assert loop.tally.given_up_frames == 0
    assert loop.notices.counts() == {"first-attitude": 1}


@pytest.mark.parametrize(("motion", "paths"), [("auto", False), ("on", True), ("off", False)])
def test_stars_move_within_a_frame_on_a_screen_only_unless_the_bench_file_says_otherwise(
    tmp_path, motion, paths
):
    clock = FakeClock()
    bench = SlowBench(tmp_path, clock, lambda number: 0, f'[render]\nmotion = "{motion}"\n')
    rate = np.array([0.0, 0.1, 0.0])
    FrameLoop(bench, pacer=Pacer(PERIOD_NS, clock)).draw(
        0, 0, Attitude(STILL.q_icrs_to_cam, 0, False, rate_cam_rad_s=rate)
    )
    assert (bench.asked[0] is rate) == paths


def test_a_frame_starts_when_it_is_due_or_on_a_screen_when_that_has_swapped_it(tmp_path):
    clock = FakeClock()
    bench = SlowBench(tmp_path, clock, lambda number: 0)
    loop, started = FrameLoop(bench, pacer=Pacer(PERIOD_NS, clock)), []
    loop.on_frame = lambda number, frame_ns: started.append((number, frame_ns, clock.now_ns()))
    due_ns = clock.now_ns()
    loop.draw(0, 0, STILL, Moment(0, due_ns, due_ns))
    assert started == [(0, due_ns, due_ns)]  # before it is drawn
    due_ns = clock.now_ns() + PERIOD_NS
    swapped = loop.draw(1, 0, STILL, Moment(1, clock.now_ns(), due_ns, swap_ns=due_ns))
    at_once = loop.draw(2, 0, STILL)
    assert started[1:] == [
        (frame.number, frame.swap_ns, frame.swap_ns) for frame in (swapped, at_once)
    ]
    assert swapped.swap_ns > swapped.draw_ns


def test_a_frame_that_is_given_up_has_no_start_on_a_screen(tmp_path):
    clock = FakeClock()
    loop, started = (
        FrameLoop(SlowBench(tmp_path, clock, lambda number: 1e8), pacer=Pacer(PERIOD_NS, clock)),
        [],
    )
    loop.on_frame = lambda number, frame_ns: started.append(number)
    due_ns = clock.now_ns()
    assert loop.draw(0, 0, STILL, Moment(0, due_ns, due_ns, swap_ns=due_ns)) is None
    assert started == []


def test_the_timeline_s_policy_is_the_bench_file_s_in_nanoseconds_and_radians():
    policy = policy_of(
        AttitudeSettings(max_extrapolation_ms=80.0, stale_after_ms=250.0, max_rate_deg_s=90.0)
    )
    assert policy.max_extrapolation_ns == 80_000_000
    assert policy.stale_after_ns == 250_000_000
    assert policy.max_rate_rad_s == pytest.approx(math.pi / 2)
