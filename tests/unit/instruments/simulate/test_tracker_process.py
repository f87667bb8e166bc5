"""What the virtual tracker's process makes of an exposure's answer: its stamp by its own clock, when
it is sent, and what it counts.
"""

from __future__ import annotations

import itertools
import threading
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hilstar.basics.rotation import from_rotation_vector, multiply, random_attitude
from hilstar.basics.units import ARCSEC_PER_RAD, NS_PER_S
from hilstar.instruments.simulate import tracker_process
from hilstar.instruments.simulate.live_exposure import LOST, TRACKING, Exposed, Solved
from hilstar.instruments.simulate.tracker_process import Planted, TrackerProcess
from hilstar.server.answers.answer import Answer
from hilstar.tracker.identify import Identified
from tests.support.fake_clock import FakeClock

LATENCY_S, SILENT_FROM_S, SILENT_S = 0.3, 20.0, 5.0
PLANTED = Planted(
    latency_s=LATENCY_S, drift_ppm=50.0, offset_s=2.0, silent_s=SILENT_S, after_s=SILENT_FROM_S
)
UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])


class Clock:
    """The host's clock, as a test sets it."""

    def __init__(self, now_ns: int) -> None:
        self.ns = now_ns

    def now_ns(self) -> int:
        return self.ns


@pytest.fixture
def process(rng):
    """A tracker before no display, whose answers a test hands it."""
    tracker = SimpleNamespace(
        config=SimpleNamespace(monitor=SimpleNamespace(refresh_hz=60.0)),
        camera=SimpleNamespace(focal_length_px=5000.0),
        rate_cam_rad_s=lambda: np.array([0.0, 0.01, 0.0]),
        reported_stars=lambda solved: [],
    )
    made = TrackerProcess(tracker, None, PLANTED, 10.0, rng)
    made._host = Clock(made._begun_ns)
    return made


def solved_at(process: TrackerProcess, at_s: float, mode: str = TRACKING, stars: int = 9) -> Solved:
    """An exposure of 0.1 s, its middle `at_s` after the first frame; none is found of 0 stars."""
    middle_ns = process._begun_ns + round(at_s * NS_PER_S)
    span_ns = (middle_ns - NS_PER_S // 20, middle_ns + NS_PER_S // 20)
    exposed = Exposed(span_ns, np.zeros(0), np.zeros((0, 1)), UPRIGHT, 6, 1.0)
    identified = None
    if stars:
        identified = Identified(UPRIGHT, np.arange(stars), np.arange(stars), 1e-6)
    return Solved(exposed, mode, None, identified)


def sent_by(process: TrackerProcess, at_s: float) -> list:
    """What it has sent by a time after the first frame."""
    answers = []
    process._host.ns = process._begun_ns + round(at_s * NS_PER_S)
    process._put(answers.append)
    return answers


@pytest.mark.parametrize("at_s", [0.5, 10.0, 1000.0])
def test_an_answer_is_stamped_by_the_tracker_s_own_clock_in_mid_exposure(process, at_s):
    """Ahead by 2 s, and by 50 us for each second that passed; sent with its latency."""
    process._report(solved_at(process, at_s))
    assert sent_by(process, at_s + LATENCY_S - 1e-6) == []
    (answer,) = sent_by(process, at_s + LATENCY_S)
    middle_ns = process._begun_ns + round(at_s * NS_PER_S)
    assert answer.host_ns == middle_ns
    assert answer.t_ns == pytest.approx(middle_ns + (2 + 50e-6 * at_s) * NS_PER_S, abs=1000)
    assert process.tally.latency_ms.percentiles().max == pytest.approx(1e3 * LATENCY_S, rel=1e-6)


def test_only_a_tracker_that_tracks_tells_a_rate_and_none_without_stars(process):
    for at_s, mode, stars in ((1.0, TRACKING, 9), (2.0, LOST, 9), (3.0, LOST, 0)):
        process._report(solved_at(process, at_s, mode, stars))
    tracking, lost, blind = sent_by(process, 4.0)
    assert tracking.rate_cam_rad_s is not None and lost.rate_cam_rad_s is None
    assert [each.star_count for each in (tracking, lost, blind)] == [9, 9, 0]
    assert [each.valid for each in (tracking, lost, blind)] == [True, True, False]
    assert blind.q_icrs_to_cam is None
    tally = process.tally
    assert (tally.answers, tally.valid, tally.modes) == (3, 2, {TRACKING: 1, LOST: 2})


def test_a_tracker_is_silent_from_its_time_for_its_time(process):
    times_s = (SILENT_FROM_S - 0.1, SILENT_FROM_S, SILENT_FROM_S + SILENT_S - 0.1)
    times_s += (SILENT_FROM_S + SILENT_S,)
    for at_s in times_s:
        process._report(solved_at(process, at_s))
    answers = sent_by(process, 100.0)
    seconds = [(answer.host_ns - process._begun_ns) / NS_PER_S for answer in answers]
    assert seconds == pytest.approx([times_s[0], times_s[-1]])
    assert (process.tally.answers, process.tally.unsent) == (2, 2)


def test_its_own_error_is_counted_before_anything_is_planted(process):
    for at_s in (1.0, 2.0):
        process._report(solved_at(process, at_s))
    summary = process.tally.summary()
    assert summary["own_bias_arcsec"] == pytest.approx([0.0] * 3, abs=1e-9)
    assert summary["answers"] == 2


def test_its_own_bias_turns_the_true_attitude_to_the_one_it_found(process, rng):
    """Found by 3, -2 and 7 arcsec about cam x, y and z beyond the truth, give or take 1 arcsec
    about x.
    """
    true = random_attitude(rng)
    for about_x_arcsec in (2.0, 4.0):
        turn_rad = np.array([about_x_arcsec, -2.0, 7.0]) / ARCSEC_PER_RAD
        found = multiply(from_rotation_vector(turn_rad), true)
        solved = solved_at(process, 1.0)
        exposed = replace(solved.exposed, q_icrs_to_cam=true)
        identified = replace(solved.identified, q_icrs_to_cam=found)
        process._report(replace(solved, exposed=exposed, identified=identified))
    summary = process.tally.summary()
    assert summary["own_bias_arcsec"] == pytest.approx([3.0, -2.0, 7.0], abs=1e-6)
    assert summary["own_sigma_arcsec"] == pytest.approx([1.0, 0.0, 0.0], abs=1e-6)


RATE_HZ, EXPOSURE_S, REFRESH_HZ = 5.0, 0.1, 50.0
DRIFTING = Planted(latency_s=LATENCY_S, drift_ppm=10_000.0, offset_s=2.0)
FRAME_NS = round(NS_PER_S / REFRESH_HZ)


class Display:
    """A watch of frames that come with time, and a tracker before it that takes `solve_s` an
    answer.
    """

    def __init__(self, clock: FakeClock, solve_s: float = 0.0) -> None:
        self.clock = clock
        self.solve_s = solve_s
        self.exposure_s = EXPOSURE_S
        self.adjusted: list[tuple[float, float]] = []
        self.spans_ns: list[tuple[int, int]] = []
        self.frames = SimpleNamespace(received=0, newest_ns=0, exposed=self.exposed)
        self.tracker = SimpleNamespace(
            config=SimpleNamespace(monitor=SimpleNamespace(refresh_hz=REFRESH_HZ)),
            camera=SimpleNamespace(focal_length_px=5000.0),
            rate_cam_rad_s=lambda: np.zeros(3),
            reported_stars=lambda solved: [],
            frames=self.frames,
            take=self.taken,
            expose=lambda exposed: exposed.span_ns,
            solve=self.solve,
            adjust=self.adjust,
            exposure_s=EXPOSURE_S,
        )
        self.watch = SimpleNamespace(frames=self.seen)

    def seen(self, timeout_ms: int) -> list[int]:
        """The frame of each refresh that passed."""
        self.clock.work(timeout_ms * 1e6)
        return [self.clock.ns // FRAME_NS * FRAME_NS]

    def taken(self, frame_ns: int) -> None:
        self.frames.received += 1
        self.frames.newest_ns = frame_ns

    def exposed(self, begin_ns: int, end_ns: int) -> Exposed:
        assert self.frames.newest_ns >= end_ns, "no frame was lit after its end"
        return Exposed((begin_ns, end_ns), np.zeros(0), np.zeros((0, 1)), UPRIGHT, 6, 1.0)

    def solve(self, exposed: Exposed, dn: object) -> Solved:
        assert dn == exposed.span_ns
        self.spans_ns.append(exposed.span_ns)
        self.clock.work(self.solve_s * 1e9)
        identified = Identified(UPRIGHT, np.arange(9), np.arange(9), 1e-6)
        return Solved(exposed, TRACKING, None, identified)

    def adjust(self, exposure_s: float, gain_db: float) -> None:
        self.adjusted.append((exposure_s, gain_db))
        self.tracker.exposure_s = exposure_s


def ran(
    monkeypatch: pytest.MonkeyPatch, display: Display, duration_s: float, camera: Any = None
) -> tuple[TrackerProcess, list[tuple[int, Answer]]]:
    """A process that has run, and its answers with when they were sent."""
    monkeypatch.setattr(tracker_process, "HOST_CLOCK", display.clock)
    rng = np.random.default_rng(1)
    process = TrackerProcess(display.tracker, display.watch, DRIFTING, RATE_HZ, rng, camera)
    sent: list[tuple[int, Answer]] = []
    process.run(
        lambda answer: sent.append((display.clock.ns, answer)), threading.Event(), duration_s
    )
    return process, sent


def test_exposures_follow_the_tracker_s_own_clock_from_the_first_frame_to_the_run_s_end(
    monkeypatch,
) -> None:
    """A clock that is fast by 1 % has a period of 198 ms of the host's; in 2 s eleven begin."""
    display = Display(FakeClock())
    cpu_s = itertools.count(0.0, 0.25)
    monkeypatch.setattr(tracker_process.time, "process_time", lambda: next(cpu_s))
    process, sent = ran(monkeypatch, display, 2.0)
    assert process.tally.cpu_ms.percentiles().max == 250.0
    begin_ns = np.array([begin for begin, _ in display.spans_ns])
    first_ns = begin_ns[0]
    assert first_ns == process._begun_ns == first_ns // FRAME_NS * FRAME_NS
    assert np.diff(begin_ns) == pytest.approx(NS_PER_S / RATE_HZ / 1.01, rel=1e-6)
    assert len(begin_ns) == 11
    assert {end - begin for begin, end in display.spans_ns} == {round(EXPOSURE_S * NS_PER_S)}
    # every answer is sent, late by the latency, on the tracker's own clock
    assert len(sent) == len(begin_ns)
    for (at_ns, answer), (begin, end) in zip(sent, display.spans_ns, strict=True):
        middle_ns = (begin + end) // 2
        assert answer.host_ns == middle_ns
        late_ns = at_ns - middle_ns
        assert LATENCY_S * NS_PER_S <= late_ns < (LATENCY_S + 0.05) * NS_PER_S
        own_ns = first_ns + 2 * NS_PER_S + 1.01 * (middle_ns - first_ns)
        assert answer.t_ns == pytest.approx(own_ns, abs=2)
    assert process.tally.passed_over == 0


def test_exposures_that_a_slow_solver_leaves_no_time_for_are_passed_over_and_counted(
    monkeypatch,
) -> None:
    """Of a solver that takes 0.9 s at five exposures a second: it goes on with the next one due."""
    display = Display(FakeClock(), solve_s=0.9)
    process, _ = ran(monkeypatch, display, 6.0)
    begin_ns = np.array([begin for begin, _ in display.spans_ns])
    periods = np.rint(np.diff(begin_ns) / (NS_PER_S / RATE_HZ / 1.01)).astype(int)
    assert set(periods.tolist()) == {4, 5}
    # the last exposure's are counted, too
    assert process.tally.passed_over - (periods - 1).sum() in {3, 4}


def test_a_camera_s_client_sets_the_exposure_and_gets_the_image_with_its_beginning(
    monkeypatch,
) -> None:
    taken: list[tuple[object, int]] = []
    settings = SimpleNamespace(exposure_s=0.04, gain_db=6.0, triggered=False, rate_hz=RATE_HZ)
    camera = SimpleNamespace(
        settings=settings,
        wanted=True,
        started_ns=0,
        own_ns=None,
        take=lambda dn, begin_ns: taken.append((dn, begin_ns)),
    )
    display = Display(FakeClock())
    process, _ = ran(monkeypatch, display, 1.0, camera)
    assert set(display.adjusted) == {(0.04, 6.0)}
    assert [begin_ns for _, begin_ns in taken] == [begin for begin, _ in display.spans_ns]
    assert all(dn == span for (dn, _), span in zip(taken, display.spans_ns, strict=True))
    assert {end - begin for begin, end in display.spans_ns} == {40_000_000}
    host_ns = process._begun_ns + NS_PER_S
    assert camera.own_ns(host_ns) == process._begun_ns + round(3.01 * NS_PER_S)


def test_a_display_that_falls_silent_is_waited_for_by_three_refreshes(monkeypatch) -> None:
    """Of 50 Hz 60 ms; then the exposure is computed of what came."""
    display = Display(FakeClock())
    silent_from_ns = display.clock.ns + round(0.5 * NS_PER_S)
    late_ms: list[float] = []
    seen = display.seen

    def seen_until(timeout_ms: int) -> list[int]:
        frames = seen(timeout_ms)
        return frames if display.clock.ns < silent_from_ns else []

    def exposed(begin_ns: int, end_ns: int) -> None:
        late_ms.append((display.clock.ns - end_ns) / 1e6)

    display.watch.frames = seen_until
    display.frames.exposed = exposed
    ran(monkeypatch, display, 1.0)
    assert late_ms[-1] == pytest.approx(60.0, abs=1.0)
    assert late_ms[0] < 21.0
