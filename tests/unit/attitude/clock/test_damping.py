"""Prediction that damps jitter: exact for a steady turn, never much worse than the rate, and
better where jitter is fast.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from hilstar.attitude.clock.timeline import MEMORY_S, Policy, Timeline, _Damping
from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.basics.arrays import FloatArray
from hilstar.basics.rotation import (
    angle_between_rad,
    from_radec_roll_deg,
    from_rotation_vectors,
    multiply,
    propagate,
)
from hilstar.basics.units import ARCSEC_PER_RAD, NS_PER_MS, NS_PER_S
from hilstar.instruments.study.prediction import shaken_error

START = from_radec_roll_deg(84.057, -1.2, 10.0)
TURN_RAD_S = np.radians([0.2, -1.0, 3.0])
AGE_NS = 20 * NS_PER_MS
UNIX_NS = 1_764_000_000 * NS_PER_S  # a sender's clock in 2025
MEMORIES = 10  # of which the first samples, that had nothing so far behind them,
MEMORY_LEFT = 1e-4  # are left: exp(-10)
# Rounding of quaternions, 1e-16, over a step of 10 ms and twice as far ahead; and of t_ns.
EXACT_ARCSEC = 1e-8
AUTO, RATE = (
    Policy(250 * NS_PER_MS, 250 * NS_PER_MS, prediction="auto"),
    Policy(250 * NS_PER_MS, 250 * NS_PER_MS),
)


def errors_arcsec(
    policy: Policy, samples: list[AttitudeSample], turn: FloatArray = TURN_RAD_S
) -> list[float]:
    """Of the attitude predicted just before each next sample is there, against a steady turn
    from START.
    """
    timeline, errors = Timeline(policy), []
    for sample in samples:
        timeline.add(sample)
        t_ns = sample.t_ns + AGE_NS
        attitude = timeline.at(t_ns)
        assert attitude is not None
        errors.append(
            angle_between_rad(attitude.q_icrs_to_cam, propagate(START, turn, t_ns / NS_PER_S))
            * ARCSEC_PER_RAD
        )
    return errors


def steady(hz: float = 100.0, seconds: float = 4.0, *, rates: bool = True) -> list[AttitudeSample]:
    times_ns = [round(k * NS_PER_S / hz) for k in range(round(seconds * hz))]
    return [
        AttitudeSample(
            t_ns, propagate(START, TURN_RAD_S, t_ns / NS_PER_S), TURN_RAD_S if rates else None
        )
        for t_ns in times_ns
    ]


@pytest.mark.parametrize("hz", [10, 100, 1000])
@pytest.mark.parametrize("rates", [True, False])
def test_a_steady_turn_is_as_exact_as_by_its_rate(hz, rates):
    samples = steady(hz, rates=rates)
    assert max(errors_arcsec(AUTO, samples)[1:]) < EXACT_ARCSEC
    broken = [*samples[:200], *(replace(s, t_ns=s.t_ns + NS_PER_S) for s in samples[200:400])]
    assert len(errors_arcsec(AUTO, broken)) == len(broken)


@pytest.mark.parametrize("rates", [True, False])
def test_noise_leaves_no_bias_and_is_not_amplified(rates):
    rng = np.random.default_rng(1)
    samples = []
    for sample in steady(seconds=20.0, rates=rates):
        q = multiply(
            from_rotation_vectors(rng.normal(0, 30 / ARCSEC_PER_RAD, (1, 3)))[0],
            sample.q_icrs_to_cam,
        )
        rate = None if not rates else sample.rate_cam_rad_s + rng.normal(0, math.radians(0.1), 3)
        samples.append(replace(sample, q_icrs_to_cam=q, rate_cam_rad_s=rate))
    auto, by_rate = (
        float(np.sqrt(np.mean(np.square(errors_arcsec(p, samples)[100:])))) for p in (AUTO, RATE)
    )
    newest = 30 * math.sqrt(3)  # of the newest sample by itself
    assert auto < (1.1 if rates else 1.3) * newest
    assert auto < by_rate if rates else auto < by_rate / 3


@pytest.mark.parametrize("rates", [True, False])
@pytest.mark.parametrize(("hz", "age_ms"), [(100, 5), (100, 20), (200, 20), (100, 50)])
def test_jitter_is_predicted_as_well_as_by_the_rate_or_by_the_newest_attitude(rates, hz, age_ms):
    """Below half the rate of packets: a vibration beyond it looks like a slow one."""
    for jitter_hz in (1.0, 7.0, 13.0, 37.0):
        by_rate, auto, newest = (
            shaken_error(way, jitter_hz, hz, age_ms, rates)[0] for way in ("rate", "auto", "newest")
        )
        assert auto < 1.05 * by_rate + 0.01, jitter_hz
        assert auto < 2.0 * newest, jitter_hz  # the worst of these is 1.9: 37 Hz at 50 ms
    assert age_ms < 20 or auto < by_rate / 2


def test_a_slew_that_begins_is_followed_though_jitter_was_damped_before_it():
    """5 deg/s^2 out of a vibration of 2 arcsec at 20 Hz: three sigma of jitter at most are held
    back, 20 ms long.
    """
    times_s, step_s = np.arange(0, 3, 0.01), 0.01
    rate = np.radians(5.0) * np.clip(times_s - 2.0, 0, 0.5)
    rate_jitter = 2 / ARCSEC_PER_RAD * math.tau * 20 * np.cos(math.tau * 20 * times_s + 0.4)
    angle = np.cumsum(np.append(0, (rate[1:] + rate[:-1]) / 2 * step_s))
    shaken = angle + 2 / ARCSEC_PER_RAD * np.sin(math.tau * 20 * times_s + 0.4)
    axis = np.array([0.0, 0.0, 1.0])
    timelines = [Timeline(AUTO), Timeline(RATE)]
    worst = [0.0, 0.0]
    for k in range(len(times_s) - 2):
        sample = AttitudeSample(
            round(times_s[k] * NS_PER_S),
            propagate(START, axis, shaken[k]),
            (rate + rate_jitter)[k] * axis,
        )
        for which, timeline in enumerate(timelines):
            timeline.add(sample)
            attitude = timeline.at(sample.t_ns + AGE_NS)
            assert attitude is not None
            error = (
                angle_between_rad(attitude.q_icrs_to_cam, propagate(START, axis, shaken[k + 2]))
                * ARCSEC_PER_RAD
            )
            if times_s[k] > 1.5:
                worst[which] = max(worst[which], error)
    amplitude_arcsec_s = 2 * math.tau * 20
    assert worst[0] < worst[1] + 3 / math.sqrt(2) * amplitude_arcsec_s * AGE_NS / NS_PER_S


@pytest.mark.parametrize("change", ["none", "jump", "gap", "known acceleration"])
def test_after_a_jump_a_gap_or_with_an_acceleration_a_rate_is_taken_as_it_is(rng, change):
    """Across a gap a sample's jitter says nothing of how the camera turned."""
    timeline = Timeline(AUTO)
    step_ns = 10 * NS_PER_MS
    for k in range(100):
        rate = TURN_RAD_S + rng.normal(0, math.radians(0.1), 3)
        assert timeline.add(AttitudeSample(k * step_ns, START, rate)) is None
        timeline.at(k * step_ns + 2 * step_ns)
    newest_ns = 99 * step_ns + (251 * NS_PER_MS if change == "gap" else step_ns)
    own_rad_s = TURN_RAD_S + math.radians(0.1)
    newest = AttitudeSample(newest_ns, START, own_rad_s, discontinuity=change == "jump")
    if change == "known acceleration":
        newest = replace(newest, acceleration_cam_rad_s2=np.zeros(3))
    assert timeline.add(newest) is None
    predicted_rad_s = timeline.at(newest_ns + 2 * step_ns).rate_cam_rad_s
    is_own = np.abs(predicted_rad_s - own_rad_s).max() < 1e-12
    assert is_own == (change != "none")


def test_jumps_and_gaps_begin_anew():
    samples = steady()
    jumps = [replace(s, discontinuity=k == 250) for k, s in enumerate(samples)]
    assert max(errors_arcsec(AUTO, jumps)[1:]) < EXACT_ARCSEC
    assert all(after.t_ns > before.t_ns for before, after in pairwise(samples))


@pytest.mark.parametrize(
    ("usual_steps", "steps_ahead"), [(0, 1), (1, 1), (2.4, 2), (2.6, 3), (3, 3)]
)
def test_a_steady_turn_has_no_jitter_and_is_looked_at_as_far_ahead_as_frames_predict(
    usual_steps, steps_ahead
):
    """Of a stream that nobody predicts yet, each sample is ahead of the one before by the step; else
    by the number of steps that is nearest.
    """
    step_ns = 10 * NS_PER_MS
    damping = _Damping()
    damping.usual_s = usual_steps * step_ns / NS_PER_S
    for k in range(round(MEMORIES * MEMORY_S * NS_PER_S / step_ns)):
        damped = damping.add(k * step_ns, (0.3, -0.2, 1.0), (3e-3, -2e-3, 0.01))
        assert damped.excess == pytest.approx((0, 0, 0), abs=1e-12)
    ahead_s = steps_ahead * step_ns / NS_PER_S
    assert damped.ahead_s == pytest.approx(ahead_s, rel=MEMORY_LEFT)


@pytest.mark.parametrize(("goes_on_by", "share"), [(-1.0, 1.0), (2.0, 0.0)])
def test_no_more_than_the_jitter_is_held_back_and_nothing_is_added(goes_on_by, share):
    """Where a sample's jitter goes on the other way, and where it goes on twice as large."""
    step_s = 0.01
    damping = _Damping()
    rates = np.random.default_rng(3).uniform(-1e-3, 1e-3, (200, 3))
    turns = np.roll(rates, 1, axis=0) * goes_on_by * step_s
    for k, (rate, turn) in enumerate(zip(rates.tolist(), turns.tolist(), strict=True)):
        damped = damping.add(round(k * step_s * NS_PER_S), tuple(rate), tuple(turn))
    jitter = damping._seen[-1].jitter
    assert damped.excess == pytest.approx([share * part for part in jitter], abs=1e-15)
    assert min(map(abs, jitter)) > 1e-5


def test_what_is_held_back_goes_with_the_square_of_the_prediction_up_to_the_usual_one(rng):
    """1 - sin(x) / x of a vibration: x^2 / 6 for a small x."""
    timeline = Timeline(AUTO)
    usual_ns, step_ns = 40 * NS_PER_MS, 10 * NS_PER_MS
    q = START
    for k in range(200):
        rate = TURN_RAD_S + rng.normal(0, math.radians(0.1), 3)
        assert timeline.add(AttitudeSample(k * step_ns, q, rate)) is None
        q = propagate(q, TURN_RAD_S, step_ns / NS_PER_S)
        timeline.at(k * step_ns + usual_ns)
    newest_ns = 199 * step_ns
    held_back = [
        rate - timeline.at(newest_ns + share * usual_ns // 4).rate_cam_rad_s
        for share in (0, 1, 2, 4, 6)
    ]
    nothing, quarter, half, whole, more = held_back
    assert np.abs(whole).min() > math.radians(1e-3)
    assert nothing == pytest.approx([0, 0, 0], abs=1e-15)
    assert half == pytest.approx(4 * quarter)
    # how far ahead samples were looked at is their own mean
    assert quarter == pytest.approx(whole / 16, rel=0.1)
    assert more == pytest.approx(whole, rel=1e-2)


def test_a_beginning_turn_is_held_back_by_three_sigma_either_way():
    """Noise and its mirror image, which a turn that is a hundred times as fast ends."""
    rates = np.random.default_rng(4).uniform(-1e-3, 1e-3, (200, 3))
    rates[-1] = [0.1, -0.1, 0.1]
    held_back = []
    for mirrored in (rates, -rates):
        damping = _Damping()
        for k, rate in enumerate(mirrored.tolist()):
            damped = damping.add(k * 10 * NS_PER_MS, tuple(rate), (0.0, 0.0, 0.0))
        held_back.append(damped.excess)
    assert held_back[0] == tuple(-part for part in held_back[1])
    assert np.sign(held_back[0]).tolist() == [1, -1, 1]
    sigma = 1e-3 / math.sqrt(3)  # of the uniform noise; of 200 samples within a fifth
    assert np.abs(held_back[0]) == pytest.approx(3 * sigma, rel=0.2)


@pytest.mark.parametrize("policy", [AUTO, RATE])
def test_only_differences_of_the_senders_time_count(policy):
    """A stream of any epoch is predicted to the last bit as one that begins at 0."""
    rng = np.random.default_rng(2)
    timelines = [Timeline(policy), Timeline(policy)]
    for sample in steady(seconds=0.3):
        rate = TURN_RAD_S + rng.normal(0, math.radians(0.1), 3)
        predicted = []
        for begin_ns, timeline in zip((0, UNIX_NS), timelines, strict=True):
            t_ns = begin_ns + sample.t_ns
            timeline.add(replace(sample, t_ns=t_ns, rate_cam_rad_s=rate))
            attitude = timeline.at(t_ns + AGE_NS)
            assert attitude is not None
            between = timeline.at(t_ns - NS_PER_MS)
            assert between is not None
            predicted.append((attitude.q_icrs_to_cam, between.q_icrs_to_cam))
        assert np.array_equal(*predicted)
