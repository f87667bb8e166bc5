"""Whether packets' rates are those of their attitudes: what is wrong is named, and what is right
is never called wrong.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from hilstar.attitude.clock.rate_causes import (
    LAG_STEPS_S,
    OFTEN_OFF,
    OTHER_AXES,
    LagFit,
    ReadAs,
    Stretch,
    cause_of,
    lag_of,
    stretch_of,
)
from hilstar.attitude.clock.rate_check import RIGHT, WRONG, RateCheck
from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.attitude.wire.source import Convention
from hilstar.basics.arrays import FloatArray
from hilstar.basics.notices import Notices
from hilstar.basics.rotation import (
    conjugate,
    from_radec_roll_deg,
    from_rotation_vectors,
    multiply,
    propagate,
    rotate,
    to_matrix,
)
from hilstar.basics.units import NS_PER_S
from hilstar.basics.wrong_sky import CONVENTION

ARCSEC = math.radians(1 / 3600)
FINE_S = 1e-3  # steps of the true motion: 0.1 arcsec off in a second of the fastest of these turns
START = from_radec_roll_deg(84.057, -1.2, 10.0)
# Noise as a coarse star tracker and a coarse gyroscope have it.
Q_NOISE_RAD, RATE_NOISE_RAD_S = 30 * ARCSEC, math.radians(0.1)
TOLD_WITHIN_S = 1.0  # at 20 Hz and more, as the bench file's page says; some tens of packets below
HONEST_STREAMS = 60
TURN = np.radians([0.2, -0.35, 0.5])
AT_REST = np.zeros(3)
OTHER_FRAME = np.array([[0.6, 0.0, -0.8], [0.0, 1.0, 0.0], [0.8, 0.0, 0.6]])


def moved_attitudes(rates: FloatArray, step_s: float) -> FloatArray:
    """The attitudes (n, 4) from START at rates (n, 3), cam, that change linearly from one to the
    next.
    """
    q = np.vstack([START, from_rotation_vectors(-(rates[1:] + rates[:-1]) / 2 * step_s)])
    # The products of all steps up to each: of 1, 2, 4, 8, ... steps in turn.
    steps = 1
    while steps < len(q):
        q[steps:] = multiply(q[steps:], q[:-steps])
        steps *= 2
    return q


def samples(t_ns, q, rates, broken=()) -> list[AttitudeSample]:
    sent = rates.astype(np.float32).astype(np.float64)
    return [AttitudeSample(int(t), q[k], sent[k], k, k in broken) for k, t in enumerate(t_ns)]


def steady(
    hz: float = 100.0,
    seconds: float = 3.0,
    turn: FloatArray = TURN,
    rng: np.random.Generator | None = None,
):
    """Times, attitudes and true rates of a constant turn, noisy where a generator is given."""
    count = round(seconds * hz)
    rates = np.tile(turn, (count, 1))
    q = moved_attitudes(rates, 1 / hz)
    if rng is not None:
        q = multiply(from_rotation_vectors(rng.normal(0, Q_NOISE_RAD, (count, 3))), q)
        rates = rates + rng.normal(0, RATE_NOISE_RAD_S, (count, 3))
    return np.round(np.arange(count) * NS_PER_S / hz).astype(int), q, rates


def in_icrs(q: FloatArray, rates: FloatArray) -> FloatArray:
    pure = np.concatenate([np.zeros((len(q), 1)), rates], axis=1)
    return multiply(multiply(conjugate(q), pure), q)[:, 1:]


WRONGS: dict[str, tuple[Callable[[FloatArray, FloatArray], FloatArray], str]] = {
    "deg/s": (lambda q, rates: np.degrees(rates), "in deg/s; send rad/s"),
    "the sign": (lambda q, rates: -rates, "wrong sign"),
    "both": (lambda q, rates: -np.degrees(rates), "wrong sign and in deg/s"),
    "rad/ms": (lambda q, rates: rates / 1e3, "in rad/ms"),
    "rad twice": (lambda q, rates: np.radians(rates), "times pi/180"),
    "axes": (lambda q, rates: rates[:, [1, 2, 0]], "the camera's (y, z, x) is sent as (x, y, z)"),
    "axes and signs": (
        lambda q, rates: rates[:, [1, 0, 2]] * [1, -1, 1],
        "the camera's (y, -x, z) is sent as (x, y, z)",
    ),
    "signs": (lambda q, rates: rates * [1, -1, -1], "wrong sign: the camera's (x, -y, -z) is sent"),
    "another frame": (
        lambda q, rates: rates @ OTHER_FRAME.T,
        "another frame than the camera's, such as the body's",
    ),
    "another frame, deg/s": (
        lambda q, rates: np.degrees(rates @ OTHER_FRAME.T),
        "such as the body's, and in deg/s",
    ),
    "ICRS": (in_icrs, "ICRS components"),
    "zeros": (lambda q, rates: np.zeros_like(rates), "zero; leave them out"),
}

FACTORS = (0.5, 0.75, 1.25, 1.5, 2.5)
SWING_HZ, SWING_DEG_S = 0.5, 2.0
# the history of 3 s, and eight looks of half a second
OFTEN_OFF_WITHIN_S = 8.0
LAG_WITHIN_S = 0.03  # of a lag, by noise of a coarse gyroscope
LINES = {
    ("first", "cam_to_icrs"): '{ direction = "cam_to_icrs" }',
    ("last", "icrs_to_cam"): '{ scalar = "last" }',
    ("last", "cam_to_icrs"): '{ scalar = "last", direction = "cam_to_icrs" }',
}

# in noise these are one
AXES = {"axes", "axes and signs", "signs", "another frame", "another frame, deg/s"}


def watched(
    stream: list[AttitudeSample], mode="use-quaternions"
) -> tuple[RateCheck, list[tuple[str, str]], float | None]:
    """The check after a stream, what it told, and after how long first."""
    notices, told = Notices(), []
    notices.listen(lambda notice: told.append((notice.kind, notice.detail)))
    check, first_s = RateCheck(mode, notices), None
    for sample in stream:
        check.see(sample)
        if told and first_s is None:
            first_s = (sample.t_ns - stream[0].t_ns) / NS_PER_S
    return check, told, first_s


@pytest.mark.parametrize("wrong", WRONGS)
@pytest.mark.parametrize("noisy", [False, True])
def test_what_is_wrong_is_named_once_within_a_second(wrong, noisy):
    if wrong == "zeros" and noisy:
        return  # nobody adds noise to zeros
    change, words = WRONGS[wrong]
    t_ns, q, rates = steady(rng=np.random.default_rng(1) if noisy else None)
    _, told, first_s = watched(samples(t_ns, q, change(q, rates)))
    assert [kind for kind, _ in told] == [WRONG]
    assert words in told[0][1] or (noisy and OTHER_AXES in told[0][1] and wrong in AXES)
    for rad_s, deg_s in re.findall(r"the rates say (\S+) rad/s \((\S+) deg/s\)", told[0][1]):
        # each is told to three digits
        assert math.degrees(float(rad_s)) == pytest.approx(float(deg_s), rel=0.01)
    assert first_s < (1.3 if noisy and wrong.startswith("another") else 1.0) * TOLD_WITHIN_S


@pytest.mark.parametrize(
    ("hz", "within_s"), [(10, 2.1), (20, 1.1), (50, 1.0), (200, 1.0), (1000, 1.0)]
)
def test_deg_s_about_one_axis_is_named_at_any_rate_of_packets(hz, within_s):
    """The issue's own stream: 0.5 deg/s, and "rate": [0, 0, 0.5]."""
    t_ns, q, rates = steady(hz, turn=np.radians([0, 0, 0.5]), rng=np.random.default_rng(2))
    _, told, first_s = watched(samples(t_ns, q, np.degrees(rates)))
    assert [kind for kind, _ in told] == [WRONG]
    assert "they are in deg/s" in told[0][1]
    assert first_s < within_s


def test_arcsec_s_is_named_where_a_step_of_them_is_no_full_turn():
    t_ns, q, rates = steady(turn=np.radians([0, 0.02, 0]))
    _, told, _ = watched(samples(t_ns, q, np.degrees(rates) * 3600))
    assert [kind for kind, _ in told] == [WRONG] and "they are in arcsec/s" in told[0][1]


def test_a_slow_turn_in_noise_is_told_from_longer_stretches():
    """0.1 deg/s: in a tenth of a second 36 arcsec, of quaternions with 30 arcsec of noise each."""
    t_ns, q, rates = steady(100, 4.0, np.radians([0, 0, 0.1]), np.random.default_rng(3))
    _, told, _ = watched(samples(t_ns, q, np.degrees(rates)))
    assert [kind for kind, _ in told] == [WRONG] and "deg/s" in told[0][1]


@pytest.mark.parametrize("claim", [0.0, 0.001, 0.5])
def test_at_rest_nothing_is_said(claim):
    t_ns, q, rates = steady(turn=np.zeros(3), rng=np.random.default_rng(4))
    assert watched(samples(t_ns, q, rates + claim))[1] == []


def test_attitudes_that_stand_between_steps_accuse_no_rate():
    """Sent at 100 Hz, computed at 5: a stretch has one step or none."""
    t_ns, q, rates = steady(seconds=6.0)
    assert watched(samples(t_ns, q[np.arange(len(q)) // 20 * 20], rates))[1] == []


def test_a_stuck_rate_is_told_though_nothing_explains_it():
    t_ns, q, _ = steady(turn=np.radians([0, 0, 3.0]))
    _, told, _ = watched(samples(t_ns, q, np.tile([0.05, 0.02, 0.01], (len(q), 1))))
    assert [kind for kind, _ in told] == [WRONG]


def honest(rng: np.random.Generator) -> list[AttitudeSample]:
    """A stream whose rates are the truth, with everything that may happen to one."""
    hz = rng.choice([10, 20, 50, 100, 200, 1000])
    t_s = np.arange(0, 2 if hz == 1000 else 5, 1 / hz)
    if rng.random() < 0.3:  # irregular packets
        t_s = np.sort(t_s + rng.uniform(0, 0.4, len(t_s)) / hz)
    fine_s = np.arange(0, t_s[-1] + 2 * FINE_S, FINE_S)
    size = math.radians(10 ** rng.uniform(-2.5, 1.5))
    rates = size * rng.normal(size=3) * np.ones((len(fine_s), 1))
    if rng.random() < 0.5:  # it accelerates
        rates *= np.sin(2 * np.pi * fine_s / rng.uniform(2, 20) + rng.uniform(0, 6))[:, None]
    if rng.random() < 0.3:  # it starts and stops at once
        rates *= (fine_s // rng.uniform(0.3, 2) % 2)[:, None]
    if rng.random() < 0.3:  # it is shaken
        hz_shaken, arcsec = 10 ** rng.uniform(-0.5, 1.7), rng.uniform(0.1, 5)
        rates = (
            rates
            + 2
            * np.pi
            * hz_shaken
            * arcsec
            * ARCSEC
            * np.cos(2 * np.pi * hz_shaken * fine_s)[:, None]
        )
    at = np.round(t_s / FINE_S).astype(int)
    q, rates, t_ns = moved_attitudes(rates, FINE_S)[at], rates[at], at * round(FINE_S * NS_PER_S)
    q = multiply(
        from_rotation_vectors(rng.normal(0, rng.choice([0, Q_NOISE_RAD]), (len(at), 3))), q
    )
    rates = rates + rng.normal(0, rng.choice([0, RATE_NOISE_RAD_S]), rates.shape)
    k = int(rng.integers(1, len(at)))
    broken: set[int] = set()
    if rng.random() < 0.2:  # a new target, told or not
        q[k:] = multiply(q[k:], from_rotation_vectors(rng.normal(0, 1, (1, 3))))
        broken = {k} if rng.random() < 0.5 else set()
    if rng.random() < 0.2:  # a clock that is set, or a sender that starts anew
        t_ns[k:] += round(rng.choice([-1, 1]) * 10 ** rng.uniform(6, 13))
    if rng.random() < 0.3:  # a clock that is read late
        t_ns = t_ns + np.round(rng.exponential(0.2 / hz, len(at)) * NS_PER_S).astype(int)
    stream = samples(t_ns, q, rates, broken)
    lost = rng.choice([0, 0, 0.1, 0.5])
    return [sample for sample in stream if rng.random() >= lost]


def test_right_rates_are_never_called_wrong():
    for seed in range(HONEST_STREAMS):
        assert watched(honest(np.random.default_rng(seed)))[1] == [], seed


def test_rates_that_become_right_are_believed_again():
    t_ns, q, rates = steady(seconds=4.0, rng=np.random.default_rng(5))
    wrong = np.where(np.arange(len(rates))[:, None] < 200, np.degrees(rates), rates)
    stream = samples(t_ns, q, wrong)
    check, told, _ = watched(stream[:200])
    assert check.distrusts and check.believed(stream[199]).rate_cam_rad_s is None
    check, told, _ = watched(stream)
    assert [kind for kind, _ in told] == [WRONG, RIGHT]
    assert not check.distrusts and check.believed(stream[-1]) is stream[-1]


def test_packets_that_leave_rates_out_end_it_too():
    t_ns, q, rates = steady()
    stream = samples(t_ns, q, -rates)
    without = [
        AttitudeSample(int(t_ns[-1] + (k + 1) * NS_PER_S // 100), q[-1], None, k) for k in range(20)
    ]
    assert [kind for kind, _ in watched([*stream, *without[:19]])[1]] == [WRONG]
    _, told, _ = watched([*stream, *without])
    assert [kind for kind, _ in told] == [WRONG, RIGHT]
    assert told[1][1] == "the packets carry no rates any more"


def test_of_wrong_rates_the_acceleration_is_not_used_either():
    t_ns, q, rates = steady()
    stream = samples(t_ns, q, -rates)
    last = replace(stream[-1], acceleration_cam_rad_s2=np.array([0.1, 0.0, 0.0]))
    check, _, _ = watched([*stream[:-1], last])
    believed = check.believed(last)
    assert (believed.rate_cam_rad_s, believed.acceleration_cam_rad_s2) == (None, None)
    assert (believed.t_ns, believed.sequence) == (last.t_ns, last.sequence)


@pytest.mark.parametrize("back_s", [1.0, 50.0])
def test_a_sender_that_starts_anew_is_checked_anew(back_s):
    """Its rates were right, and are not after its clock has gone back."""
    t_ns, q, rates = steady(hz=50.0, seconds=1.5)
    begun = samples(t_ns + 100 * NS_PER_S, q, rates)
    anew_ns = begun[-1].t_ns - round(back_s * NS_PER_S)
    anew = samples(t_ns + anew_ns, q, -rates)
    assert [kind for kind, _ in watched([*begun, *anew])[1]] == [WRONG]


def test_warn_believes_the_rate_and_off_does_not_look():
    t_ns, q, rates = steady()
    stream = samples(t_ns, q, -rates)
    check, told, _ = watched(stream, "warn")
    assert [kind for kind, _ in told] == [WRONG] and "used all the same" in told[0][1]
    assert check.believed(stream[-1]) is stream[-1]
    assert watched(stream, "off")[1] == []


@pytest.mark.parametrize("factor", FACTORS)
@pytest.mark.parametrize("hz", [20, 50, 100, 1000])
def test_a_factor_is_named_at_half_a_degree_a_second(factor, hz):
    t_ns, q, rates = steady(hz, turn=np.radians([0, 0, 0.5]))
    check, told, _ = watched(samples(t_ns, q, factor * rates))
    assert [kind for kind, _ in told] == [WRONG]
    assert f"they are {factor:g} times the quaternions' own turn" in told[0][1] and check.distrusts


def test_a_factor_within_a_fifth_is_not_told():
    t_ns, q, rates = steady(turn=np.radians([0, 0, 0.5]))
    assert watched(samples(t_ns, q, 1.15 * rates))[1] == []


def test_noise_that_hides_half_of_an_error_does_not_show_that_it_is_gone():
    t_ns, q, rates = steady(100, 6.0, np.radians([0, 0, 0.5]), np.random.default_rng(2))
    assert {kind for kind, _ in watched(samples(t_ns, q, 0.5 * rates))[1]} == {WRONG}


def test_a_constant_that_is_added_is_named():
    t_ns, q, rates = steady(seconds=8.0, turn=np.radians([0, 0, 0.5]))
    _, told, _ = watched(samples(t_ns, q, rates + np.radians([0.2, 0, 0])))
    assert [kind for kind, _ in told] == [WRONG] and "a constant (0.2, " in told[0][1]


def swing(
    late_s: float, hz: float = 100.0, seconds: float = 10.0, rng: np.random.Generator | None = None
):
    """A swing of SWING_HZ whose rates are those of `late_s` before."""
    fine_s = np.arange(-1, seconds + 1, FINE_S)
    rates = (
        math.radians(SWING_DEG_S) * np.cos(math.tau * SWING_HZ * fine_s)[:, None] * [0.0, 0.6, 0.8]
    )
    t_s = np.arange(0, seconds, 1 / hz)
    now, then = (np.round((t_s + 1 - by_s) / FINE_S).astype(int) for by_s in (0.0, late_s))
    q, sent = moved_attitudes(rates, FINE_S)[now], rates[then]
    if rng is not None:
        q = multiply(from_rotation_vectors(rng.normal(0, Q_NOISE_RAD, (len(q), 3))), q)
        sent = sent + rng.normal(0, RATE_NOISE_RAD_S, sent.shape)
    return samples(np.round(t_s * NS_PER_S).astype(int), q, sent)


@pytest.mark.parametrize(("late_s", "hz"), [(0.2, 20), (0.2, 100), (-0.1, 50), (0.2, 200)])
@pytest.mark.parametrize("noisy", [False, True])
def test_late_rates_are_named_with_their_lag_and_stay_so(late_s, hz, noisy):
    check, told, _ = watched(swing(late_s, hz, rng=np.random.default_rng(7) if noisy else None))
    assert [kind for kind, _ in told] == [WRONG]
    assert abs(check.cause.lag_s - late_s) < LAG_WITHIN_S
    assert (
        f"{abs(check.cause.lag_s) * 1e3:.0f} ms {'late' if late_s > 0 else 'early'}" in told[0][1]
    )


@pytest.mark.parametrize("hz", [20, 50, 100])
@pytest.mark.parametrize("late_s", [0.4, -0.4])
def test_a_lag_is_named_before_rates_are_only_called_far_off(hz, late_s):
    """At 0.4 s of a swing of 2 s every rate is off by more than half: that alone says little."""
    check, _, _ = watched(swing(late_s, hz))
    assert abs(check.cause.lag_s - late_s) < LAG_WITHIN_S


@pytest.mark.parametrize("late_s", [-0.3, -0.1, 0.06, 0.2])
def test_the_lag_of_rates_is_positive_where_they_are_late(late_s):
    """A swing about x of 1.7 s: rates of the moment `late_s` before, in stretches of 0.1 s."""
    at_s = np.arange(0, 4.2, 0.02)
    angle_rad = 0.1 * np.sin(3.7 * at_s)
    rate_rad_s = 0.37 * np.cos(3.7 * (at_s - late_s))
    axis = np.array([1.0, 0.0, 0.0])
    q = multiply(from_rotation_vectors(-angle_rad[:, None] * axis), START)
    sent = samples(np.rint(at_s * 1e9).astype(int), q, rate_rad_s[:, None] * axis)
    stretches = [stretch_of(sent[k : k + 6]) for k in range(0, len(sent) - 6, 5)]
    lag = lag_of([stretch for stretch in stretches if stretch is not None])
    assert lag is not None and lag.is_off
    assert lag.lag_s == pytest.approx(late_s, abs=LAG_STEPS_S[1])
    assert lag.lag_text == f"{abs(late_s) * 1e3:.0f} ms {'late' if late_s > 0 else 'early'}"


def tumbling(late_s: Callable[[FloatArray], FloatArray], seconds: float = 12.0, hz: float = 50.0):
    """A turn about changing axes, whose rates are those of `late_s` (n,) before their times (n,)."""
    before_s = 1.5
    fine_s = np.arange(-before_s, seconds, FINE_S)
    phases = np.stack([0.7 * fine_s, 1.1 * fine_s + 0.3, np.full_like(fine_s, 1.2)], axis=1)
    rates = np.radians(1.5) * np.cos(phases)
    t_s = np.arange(0, seconds, 1 / hz)
    now, then = (
        np.round((at_s + before_s) / FINE_S).astype(int) for at_s in (t_s, t_s - late_s(t_s))
    )
    return samples(
        np.round(t_s * NS_PER_S).astype(int), moved_attitudes(rates, FINE_S)[now], rates[then]
    )


def test_a_lag_beyond_those_that_are_tried_is_told_as_at_least_that():
    _, told, _ = watched(tumbling(lambda t_s: np.full_like(t_s, 0.6)))
    assert [kind for kind, _ in told] == [WRONG] and " ms late or more: " in told[0][1]


def test_rates_that_are_renewed_once_in_a_second_are_wrong_though_no_lag_explains_them():
    check, told, first_s = watched(tumbling(lambda t_s: t_s % 1.0))
    assert [kind for kind, _ in told] == [WRONG] and OFTEN_OFF in told[0][1]
    assert check.distrusts and first_s < OFTEN_OFF_WITHIN_S
    assert watched(tumbling(np.zeros_like))[1] == []


def test_rates_that_are_late_no_more_are_believed_again():
    # the last four seconds count: the ten before them do not outweigh eight right ones
    late, right = swing(0.2, 50), swing(0.0, 50, seconds=8.0)
    later = [
        AttitudeSample(s.t_ns + 10 * NS_PER_S, s.q_icrs_to_cam, s.rate_cam_rad_s, s.sequence + 1000)
        for s in right
    ]
    assert [kind for kind, _ in watched(late + later)[1]] == [WRONG, RIGHT]


def as_sent(q: FloatArray, scalar: str, direction: str) -> FloatArray:
    sent = conjugate(q) if direction == "cam_to_icrs" else q
    return sent if scalar == "first" else np.roll(sent, -1, axis=1)


@pytest.mark.parametrize(("scalar", "direction"), LINES)
@pytest.mark.parametrize("noisy", [False, True])
def test_rates_that_fit_another_reading_of_the_quaternions_name_its_line(scalar, direction, noisy):
    t_ns, q, rates = steady(seconds=4.0, rng=np.random.default_rng(3) if noisy else None)
    _, told, _ = watched(samples(t_ns, as_sent(q, scalar, direction), rates))
    assert [kind for kind, _ in told] == [CONVENTION]
    assert f"write [attitude] convention = {LINES[scalar, direction]} " in told[0][1]


def test_a_stated_convention_that_is_wrong_is_told_against_what_was_sent():
    """The bench file says scalar last, and the sender has it first."""
    t_ns, q, rates = steady()
    notices, told = Notices(), []
    notices.listen(lambda notice: told.append((notice.kind, notice.detail)))
    check = RateCheck("use-quaternions", notices, read_as=ReadAs(Convention(scalar="last")))
    for sample in samples(t_ns, np.roll(q, 1, axis=1), rates):
        check.see(sample)
    assert [kind for kind, _ in told] == [CONVENTION] and '{ scalar = "first" }' in told[0][1]


def test_a_turn_that_no_reading_changes_names_the_sign_and_the_line():
    """About the boresight from (1, 0, 0, 0) a conjugate and rates of the wrong sign are one."""
    seconds = np.arange(0, 3, 0.01)
    half = np.radians(0.5) * seconds / 2
    q = np.column_stack([np.cos(half), 0 * half, 0 * half, np.sin(half)])
    rates = np.tile(np.radians([0, 0, 0.5]), (len(q), 1))
    _, told, _ = watched(samples(np.round(seconds * NS_PER_S).astype(int), q, rates))
    assert [kind for kind, _ in told] == [WRONG]
    assert (
        "wrong sign" in told[0][1]
        and '[attitude] convention = { direction = "cam_to_icrs" }' in told[0][1]
    )


def test_a_condition_says_since_when_it_holds():
    t_ns, q, rates = steady()
    notices = Notices()
    check = RateCheck("use-quaternions", notices)
    for sample in samples(t_ns, q, -rates):
        check.see(sample, sample.t_ns + 5 * NS_PER_S)
    assert [condition.since_ns for condition in notices.wrong_sky.now()] == [5 * NS_PER_S]


@pytest.mark.parametrize(("scalar", "direction"), LINES)
def test_attitudes_of_a_body_are_read_otherwise_before_they_are_mounted(scalar, direction):
    """The body's attitude and rates as they are sent, and mounted as the link does it."""
    mounting = from_radec_roll_deg(40.0, 20.0, 70.0)
    t_ns, q, rates = steady()
    sent = as_sent(q, scalar, direction)
    stream = samples(t_ns, multiply(mounting, sent), rotate(mounting, rates))
    notices = Notices()
    check = RateCheck("use-quaternions", notices, read_as=ReadAs(q_body_to_cam=mounting))
    for sample in stream:
        check.see(sample)
    line = LINES[scalar, direction].replace(" }", ', frame = "body" }')
    assert f"write [attitude] convention = {line}" in notices.lasting[CONVENTION]


def test_a_source_with_a_convention_of_its_own_is_told_no_key():
    t_ns, q, rates = steady()
    notices = Notices()
    check = RateCheck("use-quaternions", notices, read_as=ReadAs(has_key=False))
    for sample in samples(t_ns, as_sent(q, "last", "icrs_to_cam"), rates):
        check.see(sample)
    assert "[attitude] convention" not in notices.lasting[CONVENTION]
    assert "look at what the simulator puts into its quaternion" in notices.lasting[CONVENTION]


SIGNED_AXES = [
    (order, signs)
    for order in itertools.permutations(range(3))
    for signs in itertools.product((1, -1), repeat=3)
]


def stretches_of(
    turns: FloatArray, sent: np.ndarray, constant: FloatArray = AT_REST, hz: int = 40
) -> list[Stretch]:
    """A second of each of the turns (n, 3), rad/s; the rates that are sent are `sent` (3, 3) by the
    camera's own, and a constant.
    """
    stretches = []
    q = from_radec_roll_deg(84.0, -1.2, 10.0)
    for second, rate in enumerate(turns):
        samples = []
        for k in range(hz):
            t_ns = second * NS_PER_S + k * NS_PER_S // hz
            sample = AttitudeSample(t_ns, propagate(q, rate, k / hz), sent @ rate + constant, k)
            samples.append(sample)
        q = samples[-1].q_icrs_to_cam
        stretch = stretch_of(samples)
        assert stretch is not None
        stretches.append(stretch)
    return stretches


def about_any_axis(count: int, turn_deg_s: float, rng: np.random.Generator) -> FloatArray:
    """Turns (count, 3), rad/s, each about another axis."""
    axes = rng.normal(size=(count, 3))
    return np.radians(turn_deg_s) * axes / np.linalg.norm(axes, axis=1, keepdims=True)


def turning(sent: np.ndarray, rng: np.random.Generator) -> list[Stretch]:
    """Five seconds of 40 Hz, each about another axis at 4 deg/s; `sent` (3, 3) makes the rates that
    are sent of the camera's own.
    """
    stretches = stretches_of(about_any_axis(5, 4.0, rng), sent)
    for stretch in stretches:
        stretch.is_off = True
    return stretches


@pytest.mark.parametrize("unit", ["", " and in deg/s"])
def test_every_order_and_sign_of_axes_is_named_as_it_is_sent(unit, rng):
    """48 of them: which of the camera's axes is sent as x, as y and as z, and with which sign."""
    size = np.degrees(1.0) if unit else 1.0
    for order, signs in SIGNED_AXES:
        sent = np.zeros((3, 3))
        sent[range(3), order] = signs  # the k-th number sent is the camera's axis order[k]
        # another reading of the quaternions turns some of them, too
        cause = cause_of(turning(sent * size, rng), 1.0, others=())
        if order == (0, 1, 2) and sum(signs) == 3:
            assert (cause is None) == (not unit)
            assert cause is None or cause.text == "they are in deg/s; send rad/s"
            continue
        if order == (0, 1, 2) and sum(signs) == -3:
            assert cause.text.startswith(f"they have the wrong sign{unit}; send the turn")
            continue
        names = [
            ("" if sign > 0 else "-") + "xyz"[axis] for axis, sign in zip(order, signs, strict=True)
        ]
        assert cause.text.endswith(
            f"{unit}: the camera's ({', '.join(names)}) is sent as (x, y, z)"
        )
        assert ("another order" in cause.text) == (order != (0, 1, 2))
        assert cause.mends @ sent * size == pytest.approx(np.eye(3), abs=1e-12)
        assert cause.scale == pytest.approx(1 / size)


@pytest.mark.parametrize("size", [1.0, np.degrees(1.0)])
def test_rates_in_icrs_are_named_with_their_unit(size, rng):
    """The camera's rates, turned into the sky's axes at each sample."""
    stretches = []
    q = from_radec_roll_deg(84.0, -1.2, 10.0)
    for second in range(5):
        rate = rng.normal(size=3)
        rate *= np.radians(4.0) / np.linalg.norm(rate)
        samples = []
        for k in range(40):
            now = propagate(q, rate, k / 40)
            in_icrs = size * (to_matrix(now).T @ rate)
            samples.append(AttitudeSample(second * NS_PER_S + k * NS_PER_S // 40, now, in_icrs, k))
        q = samples[-1].q_icrs_to_cam
        stretches.append(stretch_of(samples))
        stretches[-1].is_off = True
    words = ", in deg/s" if size > 1 else ""
    assert cause_of(stretches, 1.0).text == (
        f"they have ICRS components{words}; send the camera's, rad/s"
    )


# What 1 rad/s is in each unit, by hand: 360 deg are 2 pi rad, and a revolution; a minute has 60 s.
RAD_S_IN = {
    "deg/s": 57.29577951,
    "arcsec/s": 206_264.8062,
    "mrad/s": 1000.0,
    "rad/ms": 0.001,
    "rpm": 9.549296586,
    "revolutions/s": 0.1591549431,
    "rad/s times pi/180": 0.01745329252,
}


@pytest.mark.parametrize("unit", RAD_S_IN)
def test_every_unit_is_named_with_how_its_rates_and_their_noise_are_mended(unit, rng):
    size = RAD_S_IN[unit]
    # a step of 40 Hz at 0.015 deg/s in arcsec/s is 1.35 rad, less than half a turn
    turn_deg_s = 0.015 if size > 1e4 else 2.0
    stretches = stretches_of(about_any_axis(4, turn_deg_s, rng), size * np.eye(3))
    cause = cause_of(stretches, 1.0)
    assert cause is not None and cause.text == f"they are in {unit}; send rad/s"
    assert cause.mends * size == pytest.approx(np.eye(3), abs=1e-9)
    assert cause.scale * size == pytest.approx(1.0, abs=1e-9)
    assert (cause.kind, cause.lag_s, cause.constant, cause.in_icrs) == (WRONG, 0.0, None, False)


def test_a_factor_and_a_frame_without_a_name_are_told_with_what_mends_them(rng):
    turns = about_any_axis(6, 4.0, rng)
    cause = cause_of(stretches_of(turns, 1.6 * np.eye(3)), 1.0, others=())
    assert cause.text == "they are 1.6 times the quaternions' own turn"
    assert cause.mends * 1.6 == pytest.approx(np.eye(3), abs=1e-9)
    for unit, size in (("", 1.0), (", and in deg/s", 180 / math.pi)):
        cause = cause_of(stretches_of(turns, size * OTHER_FRAME), 1.0, others=())
        assert cause.text == (
            f"they are of another frame than the camera's, such as the body's{unit}"
        )
        # the rotation back
        assert cause.mends * size == pytest.approx(OTHER_FRAME.T, abs=1e-9)
        assert cause.scale * size == pytest.approx(1.0, abs=1e-9)
    # fewer stretches than six do not tell a free number from chance
    assert cause_of(stretches_of(turns[:5], 1.6 * np.eye(3)), 1.0, others=()) is None


def test_rates_of_a_left_handed_frame_are_of_no_other_frame(rng):
    mirrored = OTHER_FRAME @ np.diag([1.0, 1.0, -1.0])
    cause = cause_of(stretches_of(about_any_axis(6, 4.0, rng), mirrored), 1.0, others=())
    assert cause is None or "another frame" not in cause.text


def test_a_constant_is_named_in_degrees_about_each_axis(rng):
    constant = np.radians([0.4, -0.3, 0.6])
    turns = about_any_axis(12, 1.0, rng)
    stretches = stretches_of(turns, np.eye(3), constant)
    cause = cause_of(stretches, 1.0, others=())
    assert cause.text == "a constant (0.4, -0.3, 0.6) deg/s is added to them"
    assert cause.constant == pytest.approx(constant, abs=1e-9)
    assert max(cause.error(stretch) for stretch in stretches) < 1e-9


@pytest.mark.parametrize("signs", [(1, 1, 1, 1), (1, -1, 1, -1)])
def test_zeros_are_left_out_where_the_camera_turns_and_not_where_it_shakes(signs):
    turns = np.array(signs)[:, None] * TURN
    cause = cause_of(stretches_of(turns, np.zeros((3, 3))), 1.0, others=())
    if sum(signs):
        assert cause is not None and cause.text == "they are zero; leave them out"
    else:
        assert cause is None


@pytest.mark.parametrize(("turn_deg_s", "turns"), [(0.0099, False), (0.0101, True)])
def test_a_hundredth_of_a_degree_a_second_counts_as_rest(turn_deg_s, turns):
    (slow,) = stretches_of(np.radians([[0.0, turn_deg_s, 0.0]]), 100 * np.eye(3))
    assert slow.turns == turns
    assert slow.is_off == turns


@pytest.mark.parametrize(
    ("lag_s", "text"),
    [
        (0.2, "200 ms late"),
        (-0.034, "34 ms early"),
        (0.49, "490 ms late"),
        (0.492, "492 ms late or more"),
        (-0.5, "500 ms early or more"),
    ],
)
def test_a_lag_in_words_says_where_it_may_be_longer_than_those_tried(lag_s, text):
    assert LagFit(0.1, 0.1, is_off=True, lag_s=lag_s).lag_text == text


def swung_stretches(
    pulsation_rad_s: float,
    late_s: float,
    rng: np.random.Generator | None = None,
    q_noise_rad: float = 0.0,
    rate_noise_rad_s: float = 0.0,
) -> list[Stretch]:
    """A swing about x, in stretches of 0.1 s over 4.2 s, with rates of `late_s` before."""
    at_s = np.arange(0, 4.2, 0.02)
    axis = np.array([1.0, 0.0, 0.0])
    angle_rad = 0.37 / pulsation_rad_s * np.sin(pulsation_rad_s * at_s)
    q = multiply(from_rotation_vectors(-angle_rad[:, None] * axis), START)
    rates = 0.37 * np.cos(pulsation_rad_s * (at_s - late_s))[:, None] * axis
    if rng is not None:
        q = multiply(from_rotation_vectors(rng.normal(0, q_noise_rad, (len(q), 3))), q)
        rates = rates + rng.normal(0, rate_noise_rad_s, rates.shape)
    sent = samples(np.rint(at_s * 1e9).astype(int), q, rates)
    stretches = [stretch_of(sent[k : k + 6]) for k in range(0, len(sent) - 6, 5)]
    return [stretch for stretch in stretches if stretch is not None]


@pytest.mark.parametrize("late_s", [-0.12, 0.12])
def test_of_lags_a_period_apart_the_shortest_is_named(late_s):
    """A swing of 0.6 s: 0.12 s late is 0.48 s early, too."""
    lag = lag_of(swung_stretches(math.tau / 0.6, late_s))
    assert lag is not None and lag.is_off
    assert lag.lag_s == pytest.approx(late_s, abs=LAG_STEPS_S[1])


@pytest.mark.parametrize(
    "noise", [{"rate_noise_rad_s": 0.3}, {"q_noise_rad": 0.012}], ids=["rates", "quaternions"]
)
def test_an_error_within_the_noise_of_rates_or_of_quaternions_is_no_lag(noise, rng):
    lag = lag_of(swung_stretches(3.7, 0.0, rng, **noise))
    # over a fifth of the turn, which is 0.3 rad/s
    assert lag is not None and lag.off_rad_s > 0.06
    assert not lag.is_off and lag.lag_s == 0.0
