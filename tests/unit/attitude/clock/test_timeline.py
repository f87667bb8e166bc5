"""Attitudes between, before and past samples; refusals; staleness."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hilstar.attitude.clock.timeline import Attitude, Policy, StaleGate, Timeline
from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.basics.rotation import (
    angle_between_rad,
    from_radec_roll_deg,
    propagate,
    rate_between_rad_s,
)
from tests.support.claims import holds

MS = 1_000_000
S = 1000 * MS
RATE = np.array([0.01, -0.02, 0.03])
START = from_radec_roll_deg(10.0, 20.0, 30.0)
# Constant-rate motion through SLERP and the exponential is exact but for float64 rounding.
EXACT_RAD = 1e-12


def timeline_sample(
    t_ms: float, *, rate: bool = False, discontinuity: bool = False, sign: int = 1
) -> AttitudeSample:
    q = sign * propagate(START, RATE, t_ms / 1000)
    return AttitudeSample(round(t_ms * MS), q, RATE if rate else None, 0, discontinuity)


def filled(
    *samples: AttitudeSample, max_extrapolation_ms: float = 100, stale_after_ms: float = 250
) -> Timeline:
    timeline = Timeline(Policy(round(max_extrapolation_ms * MS), round(stale_after_ms * MS)))
    for each in samples:
        assert timeline.add(each) is None
    return timeline


def error_rad(timeline: Timeline, t_ms: float, truth_ms: float) -> float:
    attitude = timeline.at(round(t_ms * MS))
    assert attitude is not None
    return angle_between_rad(attitude.q_icrs_to_cam, propagate(START, RATE, truth_ms / 1000))


def test_an_empty_timeline_has_no_attitude():
    assert filled().at(0) is None


def test_constant_rate_motion_is_reproduced_between_samples():
    timeline = filled(*(timeline_sample(t) for t in (0, 10, 37, 100)))
    for t in (0, 1, 10, 20, 36.9, 64.2, 100):
        assert error_rad(timeline, t, t) < EXACT_RAD


def test_a_sign_flip_between_samples_changes_nothing():
    timeline = filled(timeline_sample(0), timeline_sample(10, sign=-1), timeline_sample(20))
    for t in (3, 10, 17):
        assert error_rad(timeline, t, t) < EXACT_RAD


def test_prediction_uses_the_packet_s_rate_and_then_stops():
    timeline = filled(timeline_sample(0, rate=True))
    assert error_rad(timeline, 60, 60) < EXACT_RAD
    assert error_rad(timeline, 100, 100) < EXACT_RAD
    assert error_rad(timeline, 200, 100) < EXACT_RAD
    rates = [timeline.at(t_ms * MS).rate_cam_rad_s for t_ms in (0, 100, 101)]
    assert rates[0] == pytest.approx(rates[1])
    assert rates[2] is None  # held


def test_prediction_without_a_rate_uses_the_last_two_samples():
    timeline = filled(timeline_sample(0), timeline_sample(10))
    assert error_rad(timeline, 60, 60) < EXACT_RAD


def test_two_samples_around_a_silence_do_not_tell_a_rate_to_predict_with():
    """Over more than stale_after_ms the camera may have turned any way."""
    assert error_rad(filled(timeline_sample(0), timeline_sample(250)), 300, 300) < EXACT_RAD
    assert error_rad(filled(timeline_sample(0), timeline_sample(251)), 300, 251) < EXACT_RAD


def test_a_lone_sample_without_a_rate_is_held():
    assert error_rad(filled(timeline_sample(0)), 60, 0) < EXACT_RAD


def test_nothing_is_interpolated_or_estimated_across_a_discontinuity():
    jump = AttitudeSample(10 * MS, from_radec_roll_deg(200.0, -50.0, 0.0), None, 0, True)
    timeline = filled(timeline_sample(0), jump)
    assert error_rad(timeline, 9.9, 0) < EXACT_RAD
    after = timeline.at(30 * MS)
    assert after is not None
    assert angle_between_rad(after.q_icrs_to_cam, jump.q_icrs_to_cam) < EXACT_RAD


def test_an_old_sample_is_stale():
    timeline = filled(timeline_sample(0), timeline_sample(10))
    for t_ms, stale in ((10, False), (259, False), (261, True), (5000, True)):
        attitude = timeline.at(t_ms * MS)
        assert attitude is not None
        assert attitude.stale is stale
        assert attitude.age_ns == (t_ms - 10) * MS


def test_what_is_held_before_a_jump_is_not_stale_however_old_and_in_a_log_s_gap_it_is():
    jump = AttitudeSample(1000 * MS, from_radec_roll_deg(200.0, -50.0, 0.0), None, 0, True)
    for joins, last, is_stale in (
        (None, jump, False),
        (lambda before, after: "hold", timeline_sample(1000), True),
    ):
        timeline = Timeline(Policy(100 * MS, 250 * MS), joins=joins)
        for sample in (timeline_sample(0), last):
            assert timeline.add(sample) is None
        held = [timeline.at(t_ms * MS) for t_ms in (250, 251, 999)]
        assert [attitude.stale for attitude in held] == [False, is_stale, is_stale]
        assert [attitude.age_ns for attitude in held] == [250 * MS, 251 * MS, 999 * MS]


def test_time_that_does_not_rise_is_refused_and_changes_nothing():
    timeline = filled(timeline_sample(0), timeline_sample(10))
    for t in (10, 9, -5):
        refusal = timeline.add(timeline_sample(t))
        assert refusal is not None
        assert refusal.reason == "time"
    assert len(timeline) == 2


def test_a_long_stream_keeps_its_newest_samples_and_bounded_memory():
    timeline = Timeline(Policy(0, S), capacity=100)
    for k in range(1000):
        assert timeline.add(timeline_sample(10 * k)) is None
    assert 100 <= len(timeline) <= 200
    assert error_rad(timeline, 9985, 9985) < EXACT_RAD


# A slew as a reaction wheel makes it: 3 deg/s at most, period 20 s, about an axis that turns too.
def swing(t_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Attitude and rate at a time, by 20 000 small exact steps."""
    return SWING_Q[round(t_s * 1000)], swing_rate(t_s)


def swing_rate(t_s: float) -> np.ndarray:
    return np.radians(3.0) * np.array(
        [np.sin(0.6 * t_s), 0.5 * np.cos(0.9 * t_s), 0.3 * np.sin(1.3 * t_s + 1)]
    )


def integrated(step_s: float = 1e-3, seconds: float = 4.0) -> list[np.ndarray]:
    """Attitudes each ms: the midpoint rule, 1e-10 rad off after 4 s (steps of 0.1 ms differ by
    less).
    """
    q = START
    path = [q]
    for k in range(round(seconds / step_s)):
        q = propagate(q, swing_rate((k + 0.5) * step_s), step_s)
        path.append(q)
    return path


SWING_Q = integrated()


def swinging(step_ms: int, *, rate: bool) -> Timeline:
    samples = []
    for t_ms in range(0, 4001, step_ms):
        q, omega = swing(t_ms / 1000)
        samples.append(AttitudeSample(t_ms * MS, q, omega if rate else None))
    return filled(*samples, stale_after_ms=1000)


def worst_arcsec(timeline: Timeline) -> float:
    errors = []
    for t_ms in range(400, 3600, 7):
        attitude = timeline.at(t_ms * MS)
        assert attitude is not None
        errors.append(angle_between_rad(attitude.q_icrs_to_cam, SWING_Q[t_ms]))
    return float(np.degrees(max(errors))) * 3600


def test_rates_make_the_curve_between_samples_two_hundred_times_better():
    """At 10 Hz SLERP cuts the corners by a T^2/8 (a = 0.036 rad/s2: 9.4 arcsec)."""
    slerped, blended = (
        worst_arcsec(swinging(100, rate=False)),
        worst_arcsec(swinging(100, rate=True)),
    )
    holds("swing-slerp", slerped)
    holds("swing-blend", blended)


def test_the_blend_s_error_falls_with_the_third_power_of_the_step_and_more():
    wide, narrow = worst_arcsec(swinging(400, rate=True)), worst_arcsec(swinging(200, rate=True))
    assert wide / narrow > 2**3


def test_the_rate_within_a_blend_is_that_of_the_turn_there():
    """About one axis under a constant acceleration, both samples' rates lead to it exactly."""
    axis, rate_rad_s, bend_rad_s2 = np.array([0.48, -0.6, 0.64]), 0.02, 0.05

    def sample(t_s: float) -> AttitudeSample:
        turned_rad = rate_rad_s * t_s + bend_rad_s2 * t_s**2 / 2
        q = propagate(START, axis * turned_rad, 1.0)
        return AttitudeSample(round(t_s * 1e9), q, axis * (rate_rad_s + bend_rad_s2 * t_s))

    samples = [sample(t_s) for t_s in (0.0, 0.1, 0.3, 0.4)]
    timeline = filled(*samples, stale_after_ms=1000)
    for t_s in (0.02, 0.1, 0.15, 0.2, 0.27, 0.3, 0.38):
        attitude = timeline.at(round(t_s * 1e9))
        assert attitude.rate_cam_rad_s == pytest.approx(sample(t_s).rate_cam_rad_s, abs=1e-12)
        assert angle_between_rad(attitude.q_icrs_to_cam, sample(t_s).q_icrs_to_cam) < EXACT_RAD


def test_the_blend_is_c2_at_its_samples():
    """Rate and acceleration from both sides of a sample, by differences over 1 ms, agree to the
    differences' own error.
    """
    timeline = swinging(100, rate=True)

    def q(t_ms: float) -> np.ndarray:
        attitude = timeline.at(round(t_ms * MS))
        assert attitude is not None
        return attitude.q_icrs_to_cam

    for t_ms in (1000, 1500, 2700):
        before = [rate_between_rad_s(q(t_ms - k - 1), q(t_ms - k), 1e-3) for k in (0, 1)]
        after = [rate_between_rad_s(q(t_ms + k), q(t_ms + k + 1), 1e-3) for k in (0, 1)]
        left, right = (before[0] - before[1]) / 1e-3, (after[1] - after[0]) / 1e-3
        # an acceleration of 0.06 rad/s2 over 1 ms, twice
        assert np.abs(after[0] - before[0]).max() < 2e-4
        # its change over 2 ms; a C1 curve is off by 0.1 and more
        assert np.abs(left - right).max() < 2e-2


@pytest.mark.parametrize(("later_ns", "is_blended"), [(0, True), (1, False)])
def test_a_gap_as_long_as_stale_after_is_blended_and_a_longer_one_takes_the_shorter_way(
    later_ns, is_blended
):
    """A blend begins with the sample's own rate, SLERP with that of the whole turn."""
    own_rate, still = np.array([0.0, 0.0, 0.2]), np.array([1.0, 0.0, 0.0, 0.0])
    last = AttitudeSample(250 * MS + later_ns, still, own_rate)
    timeline = filled(AttitudeSample(0, still, own_rate), last, stale_after_ms=250)
    attitude = timeline.at(0)
    assert attitude is not None
    wanted = own_rate if is_blended else np.zeros(3)
    assert attitude.rate_cam_rad_s == pytest.approx(wanted, abs=1e-12)


def test_a_log_backwards_is_the_same_curve():
    forward = swinging(100, rate=True)
    end = 4000
    back = []
    for t_ms in range(end, -1, -100):
        q, omega = swing(t_ms / 1000)
        back.append(AttitudeSample((end - t_ms) * MS, q, -omega))
    backward = filled(*back, stale_after_ms=1000)
    for t_ms in (33, 150, 2018, 3999):
        a, b = forward.at(t_ms * MS), backward.at((end - t_ms) * MS)
        assert a is not None and b is not None
        assert angle_between_rad(a.q_icrs_to_cam, b.q_icrs_to_cam) < EXACT_RAD


def test_the_attitude_is_unit_everywhere():
    timeline = swinging(100, rate=True)
    for t_ms in np.linspace(-10, 4500, 301):
        attitude = timeline.at(round(t_ms * MS))
        assert attitude is not None
        assert abs(np.linalg.norm(attitude.q_icrs_to_cam) - 1) < 1e-15 * 4


def test_constant_rate_motion_with_rates_is_reproduced():
    timeline = filled(
        *(
            timeline_sample(t, rate=True, sign=(-1) ** k)
            for k, t in enumerate((0, 10, 37, 100, 180))
        )
    )
    for t in (0, 1, 10, 20, 36.9, 64.2, 100, 179):
        assert error_rad(timeline, t, t) < EXACT_RAD


def test_nothing_overshoots_across_a_gap():
    """Two samples at rest but for a rate that each claims: over a gap longer than stale_after
    the way is the straight one.
    """
    fast = np.array([0.0, 0.0, 2.0])
    timeline = filled(
        AttitudeSample(0, START, fast), AttitudeSample(S, START, fast), stale_after_ms=250
    )
    for t_ms in range(0, 1000, 10):
        attitude = timeline.at(t_ms * MS)
        assert attitude is not None
        assert angle_between_rad(attitude.q_icrs_to_cam, START) < EXACT_RAD


def test_stale_has_hysteresis_and_is_counted():
    gate = StaleGate(250 * MS)
    fresh = [
        Attitude(START, age * MS, age > 250) for age in (10, 249, 251, 300, 126, 124, 10, 300, 5)
    ]
    assert gate.update(None) is True
    assert [gate.update(a) for a in fresh] == [
        False,
        False,
        True,
        True,
        True,
        False,
        False,
        True,
        False,
    ]
    assert gate.events == 2


# A turn that no rate explains

MAX_RATE_RAD_S = np.radians(60.0)


def limited(*samples: AttitudeSample) -> Timeline:
    timeline = Timeline(Policy(250 * MS, 250 * MS, MAX_RATE_RAD_S))
    for each in samples:
        assert timeline.add(each) is None
    return timeline


def retarget(degrees: float, *, rate: bool) -> list[AttitudeSample]:
    """200 Hz, at rest at START, then at rest `degrees` further, without a word."""
    there = propagate(START, np.array([0.0, np.radians(degrees), 0.0]), 1.0)
    still = np.zeros(3) if rate else None
    return [AttitudeSample(k * 5 * MS, START if k < 3 else there, still) for k in range(6)]


@pytest.mark.parametrize("rate", [False, True])
@pytest.mark.parametrize("degrees", [20.0, 90.0, 179.0])
def test_a_retarget_without_discontinuity_is_a_jump_and_no_turn(degrees, rate):
    samples = retarget(degrees, rate=rate)
    timeline = limited(*samples[:4])
    for t_ms in (10.0, 12.5, 14.999):
        attitude = timeline.at(round(t_ms * MS))
        assert angle_between_rad(attitude.q_icrs_to_cam, START) < EXACT_RAD
    beyond = timeline.at(40 * MS)
    assert angle_between_rad(beyond.q_icrs_to_cam, samples[3].q_icrs_to_cam) < EXACT_RAD
    assert beyond.rate_cam_rad_s is None or not beyond.rate_cam_rad_s.any()


def test_a_turn_just_under_the_limit_is_drawn_as_a_turn():
    rate = np.array([0.0, 0.99 * MAX_RATE_RAD_S, 0.0])
    timeline = limited(
        *(AttitudeSample(k * 5 * MS, propagate(START, rate, k * 0.005)) for k in range(4))
    )
    for t_ms in (7.0, 22.0):
        assert (
            angle_between_rad(
                timeline.at(round(t_ms * MS)).q_icrs_to_cam, propagate(START, rate, t_ms / 1000)
            )
            < EXACT_RAD
        )


def test_a_rate_over_the_limit_is_refused_by_name_with_its_unit():
    fast = AttitudeSample(0, START, np.float32([0.0, 0.0, 1.001 * MAX_RATE_RAD_S]).astype(float))
    refusal = limited().add(fast)
    assert refusal.reason == "rate"
    for word in ("max_rate_deg_s = 60", "rad/s", "60.06 deg/s"):
        assert word in refusal.detail
    # 60 deg/s itself, as a packet carries it
    rounded = np.float32([0.0, 0.0, MAX_RATE_RAD_S]).astype(float)
    assert limited().add(AttitudeSample(0, START, rounded)) is None


def orbiting(t_ms: float, **more) -> AttitudeSample:
    """A circle of 7000 km, 7.5 km/s."""
    angle = 7.5 / 7000 * t_ms / 1e3
    place, ahead = (
        7000 * np.array([np.cos(angle), np.sin(angle), 0]),
        7.5 * np.array([-np.sin(angle), np.cos(angle), 0]),
    )
    return replace(timeline_sample(t_ms, **more), place_km=place, velocity_km_s=ahead)


@pytest.mark.parametrize(
    ("t_ms", "limit_km"),
    [
        (-5.0, 0.04),  # the first sample's, 5 ms away
        (0.0, 1e-12),
        # of a cubic: the jerk's derivative, 1e-8 km/s^4, times (10 s)^4 / 384, is 3e-7
        (4000.0, 1e-5),
        (10_080.0, 3e-5),  # straight on: 8e-3 km/s^2 (80 ms)^2 / 2
        (10_100.0, 5e-5),
    ],
)
def test_an_observer_s_place_is_on_its_orbit_between_samples_and_straight_on_for_as_long_as_predicted(
    t_ms, limit_km
):
    timeline = filled(orbiting(0), orbiting(10_000), max_extrapolation_ms=100)
    found = timeline.at(round(t_ms * 1e6))
    assert found is not None
    assert np.linalg.norm(found.place_km - orbiting(t_ms).place_km) < limit_km
    held = timeline.at(60_000_000_000)
    assert held is not None
    assert np.linalg.norm(held.place_km - orbiting(10_100).place_km) < 5e-5


def test_an_observer_s_place_does_not_go_across_a_jump():
    timeline = filled(
        orbiting(0), orbiting(1_000_000, discontinuity=True), max_extrapolation_ms=100
    )
    before = timeline.at(900_000_000_000)
    assert before is not None
    assert np.linalg.norm(before.place_km - orbiting(100).place_km) < 5e-5


class WatchedLock:
    is_held = False

    def __enter__(self) -> None:
        self.is_held = True

    def __exit__(self, *_: object) -> None:
        self.is_held = False


def test_samples_are_added_dropped_and_read_under_a_lock():
    """One thread adds times and samples, to two lists, while another reads both."""
    lock = WatchedLock()

    class Guarded(list):
        def append(self, item):
            assert lock.is_held
            super().append(item)

        def __getitem__(self, place):
            # the thread that adds may look at its own newest sample
            assert lock.is_held or place == -1
            return super().__getitem__(place)

        def __delitem__(self, place):
            assert lock.is_held
            super().__delitem__(place)

    capacity = 4
    timeline = Timeline(Policy(S, S), capacity)
    timeline._lock, timeline._t_ns, timeline._samples = lock, Guarded(), Guarded()
    for number in range(2 * capacity + 1):
        timeline.add(AttitudeSample(number * S, np.array([1.0, 0.0, 0.0, 0.0])))
    assert timeline.at(2 * capacity * S - S // 2) is not None
    assert len(timeline) == capacity + 1
