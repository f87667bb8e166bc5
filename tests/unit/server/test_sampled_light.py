"""A run without a screen reads no time-of-measurement bias into a tracker: the frame loop, the feed,
the virtual tracker's exposures and the judge's lit attitudes on a clock of the test's own.

The truth is closed: the camera turns at a constant rate, so the mean attitude of an exposure is that
of its middle.
"""

from __future__ import annotations

from queue import SimpleQueue
from types import SimpleNamespace

import numpy as np
import pytest

from hilstar.attitude.clock.timeline import Attitude
from hilstar.basics.rotation import propagate
from hilstar.basics.units import ARCSEC_PER_RAD, NS_PER_S
from hilstar.instruments.simulate.live_exposure import WatchedFrames
from hilstar.optics.layers.fault_kinds import Drop, Now
from hilstar.server.answers.light_times import FrameLight, lit_times_ns, on_screen
from hilstar.server.answers.pairing import LitFrame, LitFrames, residual_arcsec
from hilstar.server.bench.config import parse_config
from hilstar.server.frame_feed import FrameFeed
from hilstar.server.loop import FaultyFrames, FrameLoop, Limit
from hilstar.server.pacer import Moment, Pacer, Shown
from tests.support.benches import SMALL_BENCH
from tests.support.fake_clock import FakeClock, WellGpu
from tests.support.waiting import wait_for

START = np.array([0.5, 0.5, -0.5, 0.5])
RATE_RAD_S = np.radians([0.3, -0.8, 0.5])
SECONDS = 4
TIMEOUT_S = 60.0  # far beyond what the feed's thread takes on any machine
# Times are whole ns, at which 1 deg/s is 4e-6 arcsec; the mean of small turns is of second order in
# the turn over an exposure: (1 deg/s x 0.15 s)^3 / 24 is 1.5e-4 arcsec.
EXACT_ARCSEC = 1e-3
EXACT_S = EXACT_ARCSEC / (ARCSEC_PER_RAD * float(np.linalg.norm(RATE_RAD_S)))


def attitude_at(t_ns: int) -> np.ndarray:
    return propagate(START, RATE_RAD_S, t_ns / NS_PER_S)


class Sender:
    """A watcher's end of the feed, in place of a socket."""

    endpoint = "tcp://nowhere"

    def __init__(self, watches: bool = True) -> None:
        self.frames: SimpleQueue = SimpleQueue()
        self.watches = watches

    def look(self) -> bool:
        return self.watches

    def put_frame(self, frame) -> None:
        self.frames.put(frame)

    def close(self) -> None:
        """Nothing is open."""


class BusyBench:
    """A bench whose frames take a share of the period that is drawn anew for each."""

    effort = SimpleNamespace(is_chosen=False)
    calibration = SimpleNamespace(response=SimpleNamespace(rgb=None))
    file = SimpleNamespace(sha256="")

    def __init__(self, tmp_path, clock: FakeClock, refresh_hz: float, load, motion: str) -> None:
        text = SMALL_BENCH.replace("[monitor]", f"[monitor]\nrefresh_hz = {refresh_hz}")
        self.config = parse_config(
            tmp_path / "bench.toml", f'{text}[render]\nmotion = "{motion}"\n'
        )
        assert self.config.monitor.refresh_hz == refresh_hz
        self.renderer = WellGpu()
        self.scan = SimpleNamespace(hold_s=1 / refresh_hz)
        self._clock, self._load = clock, load

    def view(self, q, rate, *_):
        return rate

    def light(self, rate, faults=None):
        self._clock.work(self._load() / self.config.monitor.refresh_hz * NS_PER_S)
        return rate

    def draw_sprites(self, rate, number):
        levels = np.zeros((1, 8), dtype=np.uint8)
        return SimpleNamespace(
            levels=levels, sprites=None, star_count=7, clipped_hip=(), capped=0, rate_cam_rad_s=rate
        )


class HeadlessRun:
    """SECONDS of a paced run without a screen, as `serve` draws it; what a watcher of its feed got,
    and what the judge keeps.
    """

    def __init__(self, tmp_path, refresh_hz: float, load, *, motion="auto", faults=None, late_ns=0):
        clock = FakeClock(wakes_late_ns=late_ns)
        bench = BusyBench(tmp_path, clock, refresh_hz, load, motion)
        self.period_ns = NS_PER_S / refresh_hz
        self.shown: list[Shown] = []
        loop = FrameLoop(
            bench, self.shown.append, Pacer(self.period_ns, clock, None), faults=faults
        )

        def draw_slot(moment: Moment) -> Shown | None:
            host_ns = moment.light_if_begun_at(clock.now_ns())
            clock.work(300_000)  # between the attitude and the drawing, as a [sync] pulse takes
            attitude = Attitude(attitude_at(host_ns), 0, False, rate_cam_rad_s=tuple(RATE_RAD_S))
            return loop.draw(moment.slot, host_ns, attitude, moment.lit_at(host_ns))

        loop.paced(Limit(slots=round(SECONDS * refresh_hz)), draw_slot)
        self.missed = loop.tally.missed_frames
        self.watched = WatchedFrames(lambda frame: np.zeros((len(frame.codes), 1)))
        sender = Sender()
        with FrameFeed(sender, bench) as feed:
            wait_for(lambda: feed.watched)
            for shown in self.shown:
                feed.see(shown)
                self.watched.add(sender.frames.get(timeout=TIMEOUT_S))
        self.lit = LitFrames(self.period_ns, bench.scan.hold_s)
        for shown in self.shown:
            q, rate = shown.attitude.q_icrs_to_cam, shown.drawn.rate_cam_rad_s
            moment_ns = shown.moment_ns
            self.lit.add(LitFrame(shown.number, moment_ns, moment_ns, q, rate, shown.fades))

    def biases_s(self, exposure_s: float, rng) -> tuple[float, float]:
        """How late the tracker's attitudes are, and the judge's: means over exposures at any
        phase of the frames.
        """
        begins_ns = rng.uniform(1.5e9, 4.5e9, 60).astype(np.int64)
        late: tuple[list[float], list[float]] = ([], [])
        for begin_ns in begins_ns.tolist():
            end_ns = begin_ns + round(exposure_s * NS_PER_S)
            truth = attitude_at((begin_ns + end_ns) // 2)
            seen = (self.watched.exposed(begin_ns, end_ns), self.lit.over(begin_ns, end_ns))
            for kept, mean in zip(late, (seen[0].q_icrs_to_cam, seen[1].q), strict=True):
                turn_rad = residual_arcsec(mean, truth) / ARCSEC_PER_RAD
                # v_cam' = -omega x v_cam: a later attitude is turned by -omega
                kept.append(float(turn_rad @ RATE_RAD_S / (RATE_RAD_S @ RATE_RAD_S)))
        return float(np.mean(late[0])), float(np.mean(late[1]))


LOADS = {
    "idle": lambda rng: 0.0,
    "busy": lambda rng: rng.uniform(0.2, 0.9),
    "misses frames": lambda rng: rng.uniform(0.2, 3.0),
    "misses every other one": lambda rng: 1.3,
}


@pytest.mark.parametrize("refresh_hz", [30.0, 60.0, 100.0])
@pytest.mark.parametrize("load", LOADS)
def test_neither_tracker_nor_judge_is_late_by_frames_without_a_screen(
    tmp_path, rng, refresh_hz, load
):
    run = HeadlessRun(tmp_path, refresh_hz, lambda: LOADS[load](rng), late_ns=200_000)
    assert (run.missed > 0) == load.startswith("misses")
    for exposure_s in (0.02, 0.1, 0.15):
        for late_s in run.biases_s(exposure_s, rng):
            assert abs(late_s) < EXACT_S


@pytest.mark.parametrize("refresh_hz", [30.0, 100.0])
def test_frames_drawn_in_motion_are_not_early_by_half_a_frame(tmp_path, rng, refresh_hz):
    run = HeadlessRun(tmp_path, refresh_hz, lambda: 1.3, motion="on")
    assert run.shown[5].drawn.rate_cam_rad_s is not None
    for late_s in run.biases_s(0.1, rng):
        assert abs(late_s) < EXACT_S


def test_a_dropped_frame_leaves_the_one_before_on_the_display(tmp_path, rng):
    """Every other frame is dropped: each stands for two periods, and is late by half of one."""
    dropping = (Now(1, Drop(name="drop"), 0),)
    slots = iter(range(10**6))
    faults = FaultyFrames(lambda t_ns: dropping if next(slots) % 2 else (), SimpleNamespace())
    run = HeadlessRun(tmp_path, 60.0, lambda: 0.0, faults=faults)
    assert len(run.shown) == 30 * SECONDS and not any(shown.fades for shown in run.shown[1:])
    # 60 exposures at random phases: the spread of a phase's error, at most 1/8 of (2/60)^2 / 0.1 s
    for late_s in run.biases_s(0.1, rng):
        assert late_s == pytest.approx(0.5 / 60, abs=4 * 1.4e-3 / np.sqrt(60))


def test_the_first_frame_of_a_watcher_is_dated_by_the_one_before_it(tmp_path):
    """Its light begins to pass half way between the two moments, whoever saw the earlier one."""
    clock = FakeClock()
    bench = BusyBench(tmp_path, clock, 60.0, lambda: 0.0, "off")
    drawn = bench.draw_sprites(None, 0)
    moments_ns = [10**9, 2 * 10**9, 9 * 10**9, 9_016_000_000]
    shown = [
        Shown(k, t_ns, None, drawn, light_ns=t_ns, fades=True) for k, t_ns in enumerate(moments_ns)
    ]
    sender = Sender(watches=False)
    with FrameFeed(sender, bench) as feed:
        for frame in shown[:3]:
            feed.see(frame)
        sender.watches = True
        wait_for(lambda: feed.watched)
        feed.see(shown[3])
        head = sender.frames.get(timeout=TIMEOUT_S).head
    assert (head.frame, head.lit_ns) == (3, (moments_ns[2] + moments_ns[3]) // 2)


def test_on_a_screen_a_frame_is_lit_until_the_next_begins():
    frames = [on_screen(t_ns) for t_ns in (0, 100, 300)]
    assert lit_times_ns(frames, 50, 350, 350).tolist() == [50, 200, 50]
    assert lit_times_ns(frames, 50, 450, 400).tolist() == [50, 200, 100]
    assert lit_times_ns(frames[:1], 10, 30, 20).tolist() == [10]


def test_light_passes_evenly_between_two_moments_of_frames_without_a_screen():
    frames = [FrameLight(-50, 0, True), FrameLight(50, 100, True), FrameLight(250, 300, True)]
    # over the whole way each half; over its first quarter the later frame has 1/16 of half of it
    assert lit_times_ns(frames, 0, 100, 900).tolist() == [50, 50, 0]
    assert lit_times_ns(frames, 0, 25, 900).tolist() == pytest.approx([25 - 3.125, 3.125, 0])
    assert lit_times_ns(frames, 0, 300, 900).tolist() == [50, 150, 100]
    assert lit_times_ns(frames, 200, 400, 350).tolist() == [0, 25, 125]
    held = [frames[0], frames[1]._replace(fades=False)]
    assert lit_times_ns(held, 0, 100, 900).tolist() == [50, 50]
    assert lit_times_ns(held, 0, 75, 900).tolist() == [50, 25]
