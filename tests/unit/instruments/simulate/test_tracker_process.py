"""What the virtual tracker's process makes of an exposure's answer: its stamp by its own clock, when
it is sent, and what it counts.
"""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from hilstar.basics.units import NS_PER_S
from hilstar.instruments.simulate.live_exposure import LOST, TRACKING, Exposed, Solved
from hilstar.instruments.simulate.tracker_process import Planted, TrackerProcess
from hilstar.tracker.identify import Identified

LATENCY_S, SILENT_FROM_S, SILENT_S = 0.3, 20.0, 5.0
PLANTED = Planted(
    latency_s=LATENCY_S,
    drift_ppm=50.0,
    offset_s=2.0,
    silent_s=SILENT_S,
    after_s=SILENT_FROM_S,
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
