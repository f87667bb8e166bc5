"""The steps in which a sender rounds its quaternions, and what is not rounded."""

from __future__ import annotations

import numpy as np
import pytest

from hilstar.attitude.clock.resolution import COARSE, Resolution, _evidence, coarse_lines
from hilstar.attitude.wire.packet import AttitudeSample, checked_sample
from hilstar.basics.rotation import angle_between_rad, from_radec_roll_deg, propagate
from hilstar.basics.units import ARCSEC_PER_RAD, NS_PER_S

TURN_RAD_S = np.radians([0.1, -0.2, 0.5])
START = from_radec_roll_deg(84.057, -1.2, 10.0)


def rounded_turn(rounded, count: int = 100) -> list[AttitudeSample]:
    made = []
    for k in range(count):
        q = rounded(propagate(START, TURN_RAD_S, k / 50))
        made.append(checked_sample(k * NS_PER_S // 50, tuple(q.tolist()), None))
    assert all(isinstance(sample, AttitudeSample) for sample in made)
    return made


@pytest.mark.parametrize("decimals", [3, 4, 5])
def test_decimals_are_told_in_arcsec_as_they_are_off(decimals):
    stream = rounded_turn(lambda q: np.round(q, decimals))
    ((kind, line),) = coarse_lines(stream)
    assert kind == COARSE and f"steps of {10.0**-decimals:.3g}:" in line
    truth = [propagate(START, TURN_RAD_S, k / 50) for k in range(len(stream))]
    off = [angle_between_rad(q, s.q_icrs_to_cam) for q, s in zip(truth, stream, strict=True)]
    said_arcsec = float(line.split("off by ")[1].split()[0])
    # The norm takes one of four components back: 3/4 of the squares are left, which the estimate's
    # three axes are.
    assert said_arcsec == pytest.approx(np.sqrt(np.mean(np.square(off))) * ARCSEC_PER_RAD, rel=0.15)


@pytest.mark.parametrize("is_coarse_first", [True, False])
def test_a_log_s_first_samples_say_in_which_steps_it_is(is_coarse_first):
    coarse, fine = rounded_turn(lambda q: np.round(q, 3), 60), rounded_turn(lambda q: q, 60)
    samples = [*coarse, *fine] if is_coarse_first else [*fine, *coarse]
    assert [kind for kind, _ in coarse_lines(samples)] == [COARSE] * is_coarse_first


@pytest.mark.parametrize(("step", "is_told"), [(2.0**-17, True), (2.0**-18, False)])
def test_a_step_of_less_than_an_arcsecond_is_not_worth_a_word(step, is_told):
    """Steps of 1.57 and 0.79 arcsec."""
    assert bool(coarse_lines(rounded_turn(lambda q: np.round(q / step) * step))) is is_told


@pytest.mark.parametrize("count", [20, 49, 50])
def test_a_log_of_few_samples_says_in_which_steps_it_is(count):
    samples = rounded_turn(lambda q: np.round(q, 3), count)
    assert [kind for kind, _ in coarse_lines(samples)] == [COARSE]


@pytest.mark.parametrize("step", [2.0**-15, 1 / 32767])
def test_fixed_point_numbers_are_told(step):
    assert (
        f"steps of {step:.3g}:"
        in coarse_lines(rounded_turn(lambda q: np.round(q / step) * step))[0][1]
    )


def test_a_rounded_attitude_at_rest_is_told_and_a_sender_is_told_of_once():
    told: list[str] = []
    resolution = Resolution(lambda kind, line: told.append(kind))
    for sample in [rounded_turn(lambda q: np.round(q, 3), 1)[0]] * 500:
        resolution.see(sample)
    assert told == [COARSE]


@pytest.mark.parametrize(
    "rounded", [lambda q: q, lambda q: q.astype(np.float32).astype(float), lambda q: np.round(q, 7)]
)
def test_fine_quaternions_are_not_told(rounded):
    assert coarse_lines(rounded_turn(rounded)) == []


@pytest.mark.parametrize("signs", [(1, 1, 1, 1), (1, -1, 1, -1), (-1, 1, -1, 1), (-1, -1, -1, -1)])
@pytest.mark.parametrize(
    ("steps", "evidence"), [((16, 16, 16, 96), 1), ((20, 20, 33, 90), 2), ((12, 30, 35, 88), 3)]
)
def test_components_of_one_size_show_as_much_as_one_whatever_their_signs(steps, evidence, signs):
    q = np.array(steps) * np.array(signs) / np.linalg.norm(steps)
    assert _evidence(q.tolist(), 0.01) == evidence
    q[1] += 1e-4
    assert _evidence(q.tolist(), 0.01) is None


@pytest.mark.parametrize("steps", [(57, 57, 57, 7), (58, 58, 58, 11)])
def test_steps_whose_norm_is_off_by_a_hundredth_are_no_sender_s(steps):
    """Their quaternion would be refused, which is unit within a thousandth."""
    q = np.array(steps) / np.linalg.norm(steps)
    assert _evidence(q.tolist(), 0.01) is None


@pytest.mark.parametrize(
    "q", [(1.0, 0.0, 0.0, 0.0), (0.5, 0.5, -0.5, 0.5), (0.6, 0.8, 0.0, 0.0), (0.1, 0.7, 0.5, 0.5)]
)
def test_an_exact_attitude_is_not_rounded(q):
    sample = checked_sample(0, q, None)
    assert coarse_lines([sample] * 100) == []
