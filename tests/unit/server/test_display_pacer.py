"""The pacer of a display, against a screen that swaps on a grid of its own and sometimes skips:
no X server, no waiting.
"""

from __future__ import annotations

import itertools
from types import SimpleNamespace

import numpy as np
import pytest

from hilstar.attitude.clock.timeline import Attitude
from hilstar.basics.notices import Notices
from hilstar.optics.layers.view import View
from hilstar.server.bench.config import parse_config
from hilstar.server.loop import FrameLoop, Limit
from hilstar.server.operator import Aids
from hilstar.server.pacer import Moment, Shown
from hilstar.server.screen.screen import DisplayPacer, DrawBudget, SwapClock
from tests.support.benches import SMALL_BENCH
from tests.support.fake_clock import FakeClock, WellGpu
from tests.support.model_display import model_screen

PERIOD_NS = 16_666_667
FIRST_SWAP_NS = 1_000_000_000
TO_LIGHT_NS = 9_000_000
DRAW_NS = 4_000_000
GUARD_NS = DrawBudget.GUARD_NS
TURNING = Attitude(
    np.array([1.0, 0.0, 0.0, 0.0]), 0, False, rate_cam_rad_s=np.array([0.0, 0.1, 0.0])
)
SETTLED = DrawBudget.FRAMES // 4  # frames after which the budget follows what frames cost


class FakeScreen:
    """A screen whose swap ends at the first refresh that it can still reach; `closes_at` is its
    last frame.
    """

    def __init__(
        self, clock: FakeClock, by_screen: bool = True, closes_at: int | None = None
    ) -> None:
        self.clock = SwapClock(FIRST_SWAP_NS, PERIOD_NS, by_screen)
        self.budget = DrawBudget(PERIOD_NS)
        self.queued = 0
        self.swap_to_light_ns = TO_LIGHT_NS
        self.timestamp_source = "a fake"
        self.window = SimpleNamespace(hidden="", gone=None, ramp_changed=False, presented={})
        self.output = None
        self.forced = ()
        self.aids = Aids()
        self.presented: list[int] = []
        self._host, self._by_screen, self._closes_at = clock, by_screen, closes_at

    def present(self, number: int) -> int:
        self.presented.append(number)
        return number % 2

    def swap(self) -> int:
        if self._by_screen:
            refreshes = -(-(self._host.ns - FIRST_SWAP_NS) // PERIOD_NS)
            self._host.ns = FIRST_SWAP_NS + refreshes * PERIOD_NS
        self.clock.update(self._host.ns)
        return self._host.ns

    @property
    def closing(self) -> bool:
        return self._closes_at is not None and self.presented[-1] >= self._closes_at


class PacedRun:
    """A run on a fake screen; a frame's sprites take `cost(number)` ns."""

    def __init__(self, tmp_path, limit: Limit, cost=lambda number: DRAW_NS, **screen) -> None:
        self.host = FakeClock(FIRST_SWAP_NS + 1)
        self.screen = FakeScreen(self.host, **screen)
        self.notices = Notices()
        self.pacer = DisplayPacer(self.screen, self.notices, self.host)
        self.shown: list[Shown] = []
        self.moments: list[Moment] = []
        self.rates: list[object] = []
        self._cost = cost
        config = parse_config(tmp_path / "bench.toml", SMALL_BENCH)
        bench = SimpleNamespace(
            effort=SimpleNamespace(is_chosen=False),
            config=config,
            renderer=WellGpu(),
            view=View,
            light=self._light,
            draw_sprites=self._draw,
        )
        self.loop = FrameLoop(bench, self.shown.append, self.pacer, notices=self.notices)
        self.loop.paced(limit, self._draw_slot)

    def _light(self, view, faults=None):
        self.rates.append(view.rate_cam_rad_s)
        self.host.work(self._cost(self.moments[-1].slot))

    def _draw(self, sprites, number):
        return SimpleNamespace(levels=None, star_count=0, clipped_hip=(), capped=0)

    def _draw_slot(self, moment: Moment) -> Shown | None:
        self.moments.append(moment)
        return self.loop.draw(moment.slot, 0, TURNING, moment)


def test_each_refresh_has_a_frame_that_is_swapped_when_predicted(tmp_path):
    run = PacedRun(tmp_path, Limit(slots=200))
    assert [frame.number for frame in run.shown] == list(range(200))
    assert run.loop.tally.missed_frames == 0
    for frame in run.shown:
        assert frame.predicted_swap_ns is not None
        assert abs(frame.swap_ns - frame.predicted_swap_ns) <= 1
    steps = np.diff([frame.swap_ns for frame in run.shown])
    assert set(steps.tolist()) == {PERIOD_NS}


def test_the_moment_of_light_is_the_middle_row_s_after_the_predicted_swap(tmp_path):
    run = PacedRun(tmp_path, Limit(slots=50))
    for moment in run.moments:
        assert moment.swap_ns is not None
        assert moment.light_ns == moment.light_if_begun_at(123) == moment.swap_ns + TO_LIGHT_NS


def test_a_frame_is_begun_as_late_as_the_last_ones_allow(tmp_path):
    run = PacedRun(tmp_path, Limit(slots=100))
    early = [frame.predicted_swap_ns - frame.draw_ns for frame in run.shown]
    assert all(ahead == pytest.approx(DRAW_NS + GUARD_NS, abs=1) for ahead in early[SETTLED:])


def test_a_slow_frame_is_swapped_late_and_what_it_missed_is_counted(tmp_path):
    run = PacedRun(
        tmp_path, Limit(slots=100), lambda number: 1.5 * PERIOD_NS if number == 60 else DRAW_NS
    )
    (late,) = [
        frame for frame in run.shown if abs(frame.swap_ns - frame.predicted_swap_ns) > PERIOD_NS / 2
    ]
    assert late.number == 60
    missed = [frame.missed_before for frame in run.shown if frame.missed_before]
    assert sum(missed) == run.loop.tally.missed_frames >= 1
    assert run.loop.tally.frames + run.loop.tally.missed_frames == 100


def test_a_frame_far_past_its_swap_is_given_up_and_counted_with_those_it_missed(tmp_path):
    run = PacedRun(
        tmp_path, Limit(slots=100), lambda number: 5 * PERIOD_NS if number == 60 else DRAW_NS
    )
    assert 60 not in [frame.number for frame in run.shown]
    assert run.loop.tally.given_up_frames == run.notices.counts()["frame-given-up"] == 1
    after = next(frame for frame in run.shown if frame.number > 60)
    assert after.missed_before == after.number - 60 == run.loop.tally.missed_frames


def test_a_display_without_a_refresh_of_its_own_is_paced_by_the_clock(tmp_path):
    run = PacedRun(tmp_path, Limit(slots=100), by_screen=False)
    assert {frame.swap_ns - frame.predicted_swap_ns for frame in run.shown} == {0}
    assert np.diff([frame.swap_ns for frame in run.shown]) == pytest.approx(PERIOD_NS, abs=1)


def test_the_run_ends_with_its_window(tmp_path):
    run = PacedRun(tmp_path, Limit(), closes_at=7)
    assert [frame.number for frame in run.shown] == list(range(8))
    assert run.loop.stop.is_set()
    assert "window-gone" not in run.notices.counts()


def test_a_run_of_so_many_frames_presents_so_many(tmp_path):
    run = PacedRun(tmp_path, Limit(frames=12))
    assert run.screen.presented == list(range(12))


def test_frames_say_how_they_were_timed_and_what_the_photodiode_saw(tmp_path):
    run = PacedRun(tmp_path, Limit(slots=4))
    assert [frame.marker for frame in run.shown] == [0, 1, 0, 1]
    assert {frame.timestamp_source for frame in run.shown} == {"a fake"}
    said = run.loop.screen_summary()
    assert said["timestamp_source"] == "a fake"
    assert said["swap_late_ms"]["max"] == pytest.approx(0, abs=1e-5)
    assert said["operator"] == {"frames": 0, "s": 0.0}
    assert "SCHED_FIFO" in said["scheduling"] or said["scheduling"].startswith("normal")


def test_stars_move_within_the_frames_of_a_display(tmp_path):
    run = PacedRun(tmp_path, Limit(slots=1))
    assert run.rates == [TURNING.rate_cam_rad_s]


def test_an_idle_screen_is_kept_alive_and_ends_the_run_when_its_window_goes(tmp_path):
    run = PacedRun(tmp_path, Limit(slots=0))
    run.loop.idle()
    assert run.screen.presented == [0] and not run.loop.stop.is_set()
    run.screen.aids.toggle("blank")  # a key that was pressed meanwhile
    run.loop.idle()
    assert run.notices.counts()["operator"] == 1
    run.screen.window.gone = "its display was unplugged"
    run.loop.idle()
    assert run.notices.counts()["window-gone"] == 1


def test_slots_count_the_refreshes_between_two_frames_of_a_period_with_a_fraction():
    host = FakeClock(FIRST_SWAP_NS + 1)
    screen = FakeScreen(host)
    screen.clock = SwapClock(FIRST_SWAP_NS, 1e9 / 60, True)
    pacer = DisplayPacer(screen, Notices(), host)
    moments = []
    for moment in itertools.islice(pacer.moments(), 60):
        moments.append(moment)
        host.ns = moment.swap_ns + round(1.2e9 / 60)  # so long a frame takes
    assert [moment.slot for moment in moments] == list(range(0, 120, 2))


def test_the_grid_follows_a_screen_that_runs_a_little_slower():
    true_ns = PERIOD_NS * 1.0005
    clock = SwapClock(0, PERIOD_NS, True)
    for k in range(1, 2000):
        clock.update(round(k * true_ns))
    assert clock.period_ns == pytest.approx(true_ns, rel=1e-6)
    assert clock.next_after(2000 * true_ns - 1e6) == pytest.approx(2000 * true_ns, abs=1000)


def test_a_swap_some_periods_late_pulls_the_period_by_its_share_of_each():
    """4 us over four periods are 1 us each, of which the loop takes 0.4 %; a tenth of all pulls
    the phase.
    """
    clock = SwapClock(0, PERIOD_NS, True)
    clock.update(4 * PERIOD_NS + 4000)
    assert clock.period_ns == pytest.approx(PERIOD_NS + 4.0, abs=1e-6)
    assert clock.next_after(4 * PERIOD_NS) == 4 * PERIOD_NS + 400


def test_the_middle_row_lights_half_a_scan_out_and_the_panel_s_delay_after_the_swap(tmp_path):
    screen, _ = model_screen(tmp_path, monitor="scanout_ms = 12.0\npanel_delay_ms = 3.0\n")
    assert screen.swap_to_light_ns == 9_000_000
    period_ns = round(screen.clock.period_ns)
    # two frames held back are two refreshes later, however often that is said
    for queued in (2, 2, 0):
        screen.keep_ahead(1.0, queued)
        assert screen.swap_to_light_ns == pytest.approx(9_000_000 + queued * period_ns, abs=2)
    screen.keep_ahead(1.0, 2)
    screen.keep_time(screen.clock.period_ns / 1e6, True, 0)
    assert screen.swap_to_light_ns == 9_000_000


def test_the_budget_is_a_period_until_frames_have_been_timed_and_then_passes_over_two_outliers():
    budget = DrawBudget(PERIOD_NS)
    assert budget.ns == PERIOD_NS and budget.min_ns == 0
    for cost_ns in [DRAW_NS] * DrawBudget.FRAMES:
        budget.add(cost_ns)
    for _ in range(2):
        budget.add(3 * DRAW_NS)
    assert budget.ns == DRAW_NS + GUARD_NS
    assert budget.min_ns == DRAW_NS
    budget.add(3 * DRAW_NS)
    assert budget.ns == 3 * DRAW_NS + GUARD_NS


@pytest.mark.parametrize(
    ("well", "is_raised"), [(0, True), (116, True), (117, False), (300, False)]
)
def test_a_guard_is_raised_by_three_late_flips_of_one_hundred_and_twenty(well, is_raised):
    budget = DrawBudget(PERIOD_NS)
    late = (2e6, PERIOD_NS)
    told = [budget.add_flip(*late) for _ in range(2)]
    told += [budget.add_flip(2e6, 0.0) for _ in range(well)]
    assert not any(told)
    assert budget.add_flip(*late) is is_raised
    assert budget.guard_ns == (1.25 * 2e6 if is_raised else GUARD_NS)


@pytest.mark.parametrize(
    ("leads_ns", "guard_ns"),
    [
        ((3e6, 1e6, 2e6), 1.25 * 2e6),  # the middle one, whenever it came
        ((0.48 * PERIOD_NS,) * 3, 0.5 * PERIOD_NS),  # half a period at most
        ((0.52 * PERIOD_NS,) * 3, GUARD_NS),  # so early that a driver was not the cause
        ((0.5e6,) * 3, GUARD_NS),  # never lowered
    ],
)
def test_a_guard_is_a_quarter_more_than_the_middle_lead_of_late_flips(leads_ns, guard_ns):
    budget = DrawBudget(PERIOD_NS)
    raised = [budget.add_flip(lead_ns, PERIOD_NS) for lead_ns in leads_ns]
    assert raised == [False, False, guard_ns > GUARD_NS] and budget.guard_ns == guard_ns


def test_a_frame_is_never_begun_more_than_a_period_before_its_swap():
    budget = DrawBudget(PERIOD_NS)
    for _ in range(DrawBudget.FRAMES):
        budget.add(round(1.5 * PERIOD_NS))
    assert budget.ns == PERIOD_NS and budget.min_ns == round(1.5 * PERIOD_NS)
