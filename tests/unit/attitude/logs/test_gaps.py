"""A log's gaps by its own samples: what lies between them, against motion that is known at every
moment.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hilstar.attitude.clock.timeline import Policy
from hilstar.attitude.logs.entries import GAP_INTERVALS, log_joins
from hilstar.attitude.logs.log_file import log_timeline
from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.basics.rotation import angle_between_rad, from_radec_roll_deg, propagate, to_matrix
from hilstar.instruments.simulate.exposures import log_views
from hilstar.server.send_log import log_samples

S = 1_000_000_000
START = from_radec_roll_deg(84, -1.2, 30)
# of a live stream, which a log ignores
STREAM = Policy(max_extrapolation_ns=100_000_000, stale_after_ns=250_000_000)


def coning(spin_rad_s: float, nutation_rad_s: float, t_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Attitude and rate of a spin about z that turns about x: exact at any time."""
    q = propagate(START, np.array([0, 0, spin_rad_s]), t_s)
    turn = propagate(np.array([1.0, 0, 0, 0]), np.array([nutation_rad_s, 0, 0]), t_s)
    rate = np.array([nutation_rad_s, 0, 0]) + to_matrix(turn) @ np.array([0, 0, spin_rad_s])
    return propagate(q, np.array([nutation_rad_s, 0, 0]), t_s), rate


def coning_samples(times_s, spin=0.02, nutation=0.03, *, rate=True):
    moments = [(t, *coning(spin, nutation, t)) for t in times_s]
    return [
        AttitudeSample(round(t * S), q, omega if rate else None, k)
        for k, (t, q, omega) in enumerate(moments)
    ]


def worst_arcsec(samples, spin=0.02, nutation=0.03, policy=STREAM) -> float:
    timeline = log_timeline(samples, policy)
    errors = []
    for t_ns in np.linspace(samples[1].t_ns, samples[-2].t_ns, 401):
        attitude = timeline.at(round(t_ns))
        assert attitude is not None
        errors.append(
            angle_between_rad(attitude.q_icrs_to_cam, coning(spin, nutation, round(t_ns) / S)[0])
        )
    return float(np.degrees(max(errors)) * 3600)


# The error of SLERP is a T^2 / 8, with a = spin x nutation; the blend's is of the next order, and
# measured here.
@pytest.mark.parametrize(
    ("step_s", "spin", "nutation", "limit_arcsec"),
    [(0.5, 0.02, 0.03, 0.002), (4.0, 2e-3, 1e-3, 0.01), (4.0, 0.02, 0.03, 8.0)],
)
def test_a_slow_log_with_rates_is_blended_and_not_cut_at_the_corners(
    step_s, spin, nutation, limit_arcsec
):
    times = np.arange(0, 200, step_s)
    blended = worst_arcsec(coning_samples(times, spin, nutation), spin, nutation)
    slerped = worst_arcsec(coning_samples(times, spin, nutation, rate=False), spin, nutation)
    assert slerped == pytest.approx(np.degrees(spin * nutation) * 3600 * step_s**2 / 8, rel=0.1)
    assert blended < limit_arcsec
    assert blended < slerped / 30


def test_the_display_and_the_twin_and_the_sender_take_a_log_alike():
    samples = coning_samples(np.arange(0, 60, 4.0))
    display = log_timeline(samples, STREAM)
    for motion, t_ns in zip(
        log_views(samples, 57, 0.1), np.linspace(0, samples[-1].t_ns, 57), strict=True
    ):
        attitude = display.at(round(t_ns))
        assert attitude is not None
        assert angle_between_rad(attitude.q_icrs_to_cam, motion.q_icrs_to_cam) < 1e-12
    for sent in log_samples(samples, 2.0):
        attitude = display.at(sent.t_ns)
        assert attitude is not None
        assert angle_between_rad(attitude.q_icrs_to_cam, sent.q_icrs_to_cam) < 1e-12


def test_more_than_a_half_turn_between_samples_is_made_where_rates_say_so():
    samples = coning_samples(
        np.arange(0, 40, 4.0), spin=1.2, nutation=0.0
    )  # 275 degrees an interval
    assert worst_arcsec(samples, 1.2, 0.0) < 1e-3


def test_a_gap_of_a_log_without_rates_is_held_and_told():
    times = [*np.arange(0, 10, 0.5), *np.arange(30, 40, 0.5)]
    samples = coning_samples(times, rate=False)
    joins = log_joins(samples)
    assert joins.told == [
        (
            "log-gap",
            (
                "the log has 1 gap, the longest 20.5 s (over 5 times its usual 0.5 s); the attitude"
                " is held there"
            ),
        ),
    ]
    timeline = log_timeline(samples, STREAM)
    before = samples[19].q_icrs_to_cam
    for t_s, stale in ((9.6, False), (12.0, True), (29.99, True)):
        attitude = timeline.at(round(t_s * S))
        assert attitude is not None
        assert angle_between_rad(attitude.q_icrs_to_cam, before) < 1e-12
        assert (attitude.stale, attitude.rate_cam_rad_s) == (stale, None)
    after = timeline.at(30 * S)
    assert after is not None
    assert not after.stale
    assert angle_between_rad(after.q_icrs_to_cam, samples[20].q_icrs_to_cam) < 1e-12
    (broken,) = [sent.t_ns for sent in log_samples(samples, 1.0) if sent.discontinuity]
    assert broken == 30 * S


def test_a_few_lost_samples_are_no_gap():
    times = np.delete(np.arange(0, 20, 0.5), range(8, 8 + GAP_INTERVALS - 1))
    assert log_joins(coning_samples(times, rate=False)).told == []


def test_a_gap_that_the_rates_on_both_sides_explain_is_blended():
    """A steady turn, five radians in the gap: its rates lead from the one side to the other to a
    degree.
    """
    times = [*np.arange(0, 10, 0.5), *np.arange(600, 610, 0.5)]
    samples = coning_samples(times, spin=0.008, nutation=0.0)
    assert log_joins(samples).told == []
    assert worst_arcsec(samples, 0.008, 0.0) < 0.1
    other = [
        *samples[:20],
        *(AttitudeSample(s.t_ns, START, s.rate_cam_rad_s) for s in samples[20:]),
    ]
    assert [kind for kind, _ in log_joins(other).told] == ["log-gap", "log-rates"]


def test_the_longest_gap_is_of_those_that_are_held():
    """Rates explain the turn in 100.5 s, and not the one in 20.5 s."""
    times = [*np.arange(0, 10, 0.5), *np.arange(110, 120, 0.5), *np.arange(140, 150, 0.5)]
    samples = coning_samples(times, spin=0.002, nutation=0.0)
    samples[40:] = [replace(sample, q_icrs_to_cam=START) for sample in samples[40:]]
    assert log_joins(samples).told[0][1].startswith("the log has 1 gap, the longest 20.5 s (")


def told_of_rates_that_are_off(off: float, end_s: float, spin: float) -> list[str]:
    """What is told of ten seconds on either side of a gap to `end_s`, whose rates are off by a
    share.
    """
    times = [*np.arange(0, 10, 0.5), *np.arange(end_s, end_s + 10, 0.5)]
    samples = coning_samples(times, spin=spin, nutation=0.0)
    rate = samples[0].rate_cam_rad_s * (1 + off)
    samples = [replace(sample, rate_cam_rad_s=rate) for sample in samples]
    return [kind for kind, _ in log_joins(samples).told]


# Of 0.2 rad in a gap of 100 s, and of 1 mrad between two samples: over a gap a rate is asked more.
@pytest.mark.parametrize(
    ("off", "told"),
    [(0.015, []), (0.03, ["log-gap"]), (0.24, ["log-gap"]), (0.27, ["log-gap", "log-rates"])],
)
def test_rates_may_be_off_by_a_fifth_of_the_turn_and_over_a_gap_by_a_fiftieth(off, told):
    assert told_of_rates_that_are_off(off, end_s=110, spin=0.002) == told


@pytest.mark.parametrize(("off", "told"), [(0.002, []), (0.01, ["log-gap"])])
def test_of_a_long_gap_s_turn_a_degree_may_be_missing(off, told):
    """Five radians: a degree is a third of a hundredth."""
    assert told_of_rates_that_are_off(off, end_s=600, spin=0.0085) == told


def test_a_discontinuity_with_rates_of_another_turn_is_no_misfit():
    samples = coning_samples(np.arange(0, 10, 0.5))
    samples[7:] = [replace(sample, q_icrs_to_cam=START) for sample in samples[7:8]]
    samples[7] = replace(samples[7], discontinuity=True)
    assert log_joins(samples).told == []


def test_rates_that_do_not_fit_the_attitudes_are_not_used_and_told():
    """Two samples at rest but for a rate that each claims: the way between is the straight one."""
    samples = [AttitudeSample(k * S // 2, START, np.array([0.0, 0.0, 2.0])) for k in range(4)]
    assert log_joins(samples).told == [
        (
            "log-rates",
            "in 3 intervals the log's rates do not fit its attitudes, and are ignored there",
        )
    ]
    attitude = log_timeline(samples, STREAM).at(S // 4)
    assert attitude is not None
    assert angle_between_rad(attitude.q_icrs_to_cam, START) < 1e-12


def test_a_discontinuity_holds_whatever_the_interval_and_the_rates():
    samples = coning_samples(np.arange(0, 10, 0.5))
    samples[7] = AttitudeSample(
        samples[7].t_ns, samples[7].q_icrs_to_cam, samples[7].rate_cam_rad_s, 7, True
    )
    attitude = log_timeline(samples, STREAM).at(round(3.4 * S))
    assert attitude is not None
    assert angle_between_rad(attitude.q_icrs_to_cam, samples[6].q_icrs_to_cam) < 1e-12
    assert not attitude.stale


def test_times_beyond_64_bits_of_difference_do_no_harm():
    samples = [AttitudeSample(t, START) for t in (-(2**63), 0, 2**63 - 1)]
    assert log_joins(samples).told == []
    assert log_joins(samples[:1]).told == []


def test_a_log_s_rates_in_deg_s_are_named():
    samples = [
        replace(each, rate_cam_rad_s=np.degrees(each.rate_cam_rad_s))
        for each in coning_samples(np.arange(0, 60, 0.5))
    ]
    told = dict(log_joins(samples).told)["log-rates"]
    assert told.startswith("in 119 intervals") and told.endswith(
        "probably they are in deg/s; send rad/s"
    )
