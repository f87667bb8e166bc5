"""When a tracker's exposures begin: one after another by its own clock, at its camera's client's
rate, or at its triggers.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from types import SimpleNamespace

from hilstar.basics.units import NS_PER_MS, NS_PER_S
from hilstar.instruments.simulate.exposure_times import CameraExposures, FreeExposures
from hilstar.instruments.simulate.tracker_process import OwnClock, Planted

BEGUN_NS = 10**12
PERIOD_NS = 100 * NS_PER_MS
STEADY = OwnClock(Planted(), BEGUN_NS)


def begins_ms(times, count: int) -> list[float]:
    """When `count` exposures begin, ms after the first frame; each is done at once."""
    begins = []
    for _ in range(count):
        begins.append((times.next_ns() - BEGUN_NS) / NS_PER_MS)
        times.done()
    return begins


def test_exposures_follow_each_other_by_the_tracker_s_own_clock():
    """A clock that is fast by a thousandth exposes so much more often, whatever time it shows."""
    fast = OwnClock(Planted(drift_ppm=1000.0, offset_s=-7.0), BEGUN_NS)
    times = FreeExposures(fast, BEGUN_NS, PERIOD_NS)
    assert times.next_ns() == BEGUN_NS
    for _ in range(1001):
        times.done()
    # 1001 of its own periods are 100 s of the host's
    assert abs(times.next_ns() - BEGUN_NS - 100 * NS_PER_S) < 2


def test_a_tracker_that_is_late_passes_over_what_should_have_begun_meanwhile():
    """One that ends at 150 ms and is done at 460 ms: of those at 200, 300 and 400 the last is made."""
    times = FreeExposures(STEADY, BEGUN_NS, PERIOD_NS)
    times.done()
    times.done()
    end_ns = BEGUN_NS + 150 * NS_PER_MS
    assert times.pass_over(end_ns, BEGUN_NS + 460 * NS_PER_MS) == 2
    assert begins_ms(times, 2) == [400.0, 500.0]
    # in time, or late by less than a period, it passes over none
    for late_ms in (0, 90, 199):
        assert times.pass_over(end_ns, end_ns + late_ms * NS_PER_MS) == 0


@dataclass
class Camera:
    """What a tracker asks of its camera: whether a client wants images, how, and since when."""

    wanted: bool = False
    started_ns: int = 0
    triggers_ns: deque[int] = field(default_factory=deque)
    settings: SimpleNamespace = field(
        default_factory=lambda: SimpleNamespace(triggered=False, rate_hz=10.0)
    )

    def trigger_ns(self) -> int | None:
        return self.triggers_ns.popleft() if self.triggers_ns else None


def test_without_a_client_nothing_is_exposed_unless_the_tracker_answers_too():
    assert CameraExposures(STEADY, BEGUN_NS, Camera(), always=False).next_ns() is None
    always = CameraExposures(STEADY, BEGUN_NS, Camera(), always=True)
    assert begins_ms(always, 3) == [0.0, 100.0, 200.0]


def test_a_stream_begins_when_it_is_asked_for_and_a_new_rate_with_the_next_exposure():
    camera = Camera()
    times = CameraExposures(STEADY, BEGUN_NS, camera, always=False)
    camera.wanted, camera.started_ns = True, BEGUN_NS + 30 * NS_PER_MS
    assert begins_ms(times, 3) == [30.0, 130.0, 230.0]
    camera.settings.rate_hz = 20.0
    assert begins_ms(times, 3) == [280.0, 330.0, 380.0]  # 230 has been exposed
    camera.wanted = False
    assert times.next_ns() is None
    camera.wanted, camera.started_ns = True, BEGUN_NS + 900 * NS_PER_MS
    assert begins_ms(times, 2) == [900.0, 950.0]


def test_each_trigger_begins_one_exposure_and_none_is_passed_over():
    camera = Camera(wanted=True)
    camera.settings.triggered = True
    times = CameraExposures(STEADY, BEGUN_NS, camera, always=True)
    assert times.next_ns() is None
    # one came before the display's first frame, whose light it has
    moments = (-50, 70, 71)
    camera.triggers_ns.extend(BEGUN_NS + moment_ms * NS_PER_MS for moment_ms in moments)
    assert times.next_ns() == times.next_ns() == BEGUN_NS  # until it is done
    assert times.pass_over(BEGUN_NS, BEGUN_NS + NS_PER_S) == 0
    assert begins_ms(times, 3) == [0.0, 70.0, 71.0]
    assert times.next_ns() is None


def test_a_stream_after_triggers_exposes_the_last_one_s_moment_no_second_time():
    camera = Camera(wanted=True)
    camera.settings.triggered = True
    times = CameraExposures(STEADY, BEGUN_NS, camera, always=True)
    camera.triggers_ns.append(BEGUN_NS + 400 * NS_PER_MS)
    assert begins_ms(times, 1) == [400.0]
    camera.settings.triggered = False
    assert begins_ms(times, 2) == [500.0, 600.0]


def test_a_triggered_tracker_that_answers_passes_over_free_exposures_while_no_client_is_there():
    camera = Camera()
    camera.settings.triggered = True
    times = CameraExposures(STEADY, BEGUN_NS, camera, always=True)
    assert begins_ms(times, 1) == [0.0]
    assert times.pass_over(BEGUN_NS, BEGUN_NS + 350 * NS_PER_MS) == 2
    assert begins_ms(times, 1) == [300.0]
