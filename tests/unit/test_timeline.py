"""Attitudes between, before and past samples; refusals; restarts; the clock."""

from __future__ import annotations

import numpy as np
import pytest

from hilstar.attitude.packet import AttitudeSample
from hilstar.attitude.quaternion import angle_between_rad, from_radec_roll_deg, propagate
from hilstar.attitude.timeline import RESTART_SAMPLES, ClockOffset, Policy, Timeline

MS = 1_000_000
S = 1000 * MS
RATE = np.array([0.01, -0.02, 0.03])
START = from_radec_roll_deg(10.0, 20.0, 30.0)
# Constant-rate motion through SLERP and the exponential is exact but for float64 rounding.
EXACT_RAD = 1e-12


def sample(t_ms: float, *, rate: bool = False, discontinuity: bool = False, sign: int = 1) -> AttitudeSample:
    q = sign * propagate(START, RATE, t_ms / 1000)
    return AttitudeSample(round(t_ms * MS), q, RATE if rate else None, 0, discontinuity)


def filled(*samples: AttitudeSample, max_extrapolation_ms: float = 100, stale_after_ms: float = 250) -> Timeline:
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
    timeline = filled(*(sample(t) for t in (0, 10, 37, 100)))
    for t in (0, 1, 10, 20, 36.9, 64.2, 100):
        assert error_rad(timeline, t, t) < EXACT_RAD


def test_a_sign_flip_between_samples_changes_nothing():
    timeline = filled(sample(0), sample(10, sign=-1), sample(20))
    for t in (3, 10, 17):
        assert error_rad(timeline, t, t) < EXACT_RAD


def test_prediction_uses_the_packet_s_rate_and_then_stops():
    timeline = filled(sample(0, rate=True))
    assert error_rad(timeline, 60, 60) < EXACT_RAD
    assert error_rad(timeline, 100, 100) < EXACT_RAD
    assert error_rad(timeline, 200, 100) < EXACT_RAD


def test_prediction_without_a_rate_uses_the_last_two_samples():
    timeline = filled(sample(0), sample(10))
    assert error_rad(timeline, 60, 60) < EXACT_RAD


def test_a_lone_sample_without_a_rate_is_held():
    assert error_rad(filled(sample(0)), 60, 0) < EXACT_RAD


def test_nothing_is_interpolated_or_estimated_across_a_discontinuity():
    jump = AttitudeSample(10 * MS, from_radec_roll_deg(200.0, -50.0, 0.0), None, 0, True)
    timeline = filled(sample(0), jump)
    assert error_rad(timeline, 9.9, 0) < EXACT_RAD
    after = timeline.at(30 * MS)
    assert after is not None
    assert angle_between_rad(after.q_icrs_to_cam, jump.q_icrs_to_cam) < EXACT_RAD


def test_an_old_sample_is_stale():
    timeline = filled(sample(0), sample(10))
    for t_ms, stale in ((10, False), (259, False), (261, True), (5000, True)):
        attitude = timeline.at(t_ms * MS)
        assert attitude is not None
        assert attitude.stale is stale
        assert attitude.age_ns == (t_ms - 10) * MS


def test_time_that_does_not_rise_is_refused_and_changes_nothing():
    timeline = filled(sample(0), sample(10))
    for t in (10, 9, -5):
        refusal = timeline.add(sample(t))
        assert refusal is not None
        assert refusal.reason == "time"
    assert len(timeline) == 2


def test_one_late_packet_after_a_silence_is_refused_and_a_restarted_sender_is_taken_up():
    timeline = Timeline(Policy(0, 250 * MS))
    assert timeline.add(sample(1000), host_ns=0) is None
    assert timeline.add(sample(5), host_ns=10 * S) is not None
    assert timeline.add(sample(4), host_ns=10 * S + 1) is not None  # not rising: the count begins anew
    for k in range(1, RESTART_SAMPLES - 1):
        assert timeline.add(sample(4 + k), host_ns=10 * S + 1 + k) is not None
    assert timeline.restarts == 0
    assert timeline.add(sample(20), host_ns=11 * S) is None
    assert timeline.restarts == 1
    assert len(timeline) == 1


def test_packets_that_go_back_in_a_live_stream_are_never_a_restart():
    timeline = Timeline(Policy(0, 250 * MS))
    for k in range(100):
        assert timeline.add(sample(1000 + 10 * k), host_ns=10 * k * MS) is None
        assert timeline.add(sample(10 * k), host_ns=(10 * k + 1) * MS) is not None
    assert timeline.restarts == 0


def test_a_long_stream_keeps_its_newest_samples_and_bounded_memory():
    timeline = Timeline(Policy(0, S), capacity=100)
    for k in range(1000):
        assert timeline.add(sample(10 * k)) is None
    assert 100 <= len(timeline) <= 200
    assert error_rad(timeline, 9985, 9985) < EXACT_RAD


def test_the_clock_offset_is_that_of_the_least_delayed_message(rng):
    clock = ClockOffset()
    assert clock.to_sender_ns(77) == 77
    offset, least = 5 * S, 0.2 * MS
    delays = least + rng.exponential(2 * MS, size=2000)
    for k, delay in enumerate(delays):
        clock.observe(k * 5 * MS, round(offset + k * 5 * MS + delay))
    recent = delays[-2000:].min()
    assert clock.to_sender_ns(offset) == pytest.approx(-recent, abs=1)


def test_the_clock_forgets_and_so_follows_a_drift():
    clock = ClockOffset()
    for k in range(6000):  # a minute at 100 Hz, 100 ppm fast
        clock.observe(round(k * 10 * MS * 1.0001), k * 10 * MS)
    lag_ns = clock.to_sender_ns(60 * S) - 60 * S * 1.0001
    # The window is 10 to 11 s long: 100 ppm of that.
    assert abs(lag_ns) <= 11 * S * 1e-4
