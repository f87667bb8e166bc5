"""Where methods fail with attitudes: two signs of one quaternion, half turns, fast turns, NaN and infinity."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from itertools import product

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.attitude.clock.timeline import Policy, Timeline
from hilstar.attitude.wire.packet import AttitudeSample, Refusal, decode, encode
from hilstar.attitude.wire.protocol import NORM_TOLERANCE
from hilstar.rotation import angle_between_rad, from_radec_roll_deg, propagate, slerp
from hilstar.study.stability.failure_case import FailureCase, Figures
from hilstar.units import ARCSEC_PER_RAD, NS_PER_S

START = from_radec_roll_deg(84.057, -1.2, 30.0)
AXIS = np.array([0.36, -0.48, 0.8])
PERIOD_S = 0.1
FRACTIONS = np.linspace(0.05, 0.95, 19)
# float64 knows an angle to 2e-16 rad, 5e-11 arcsec; times 200 for the some twenty operations from rate to attitude.
ANGLE_ARCSEC = 1e-8
NONE_TAKEN = 0.0
POLICY = Policy(max_extrapolation_ns=NS_PER_S, stale_after_ns=NS_PER_S)
TURNS_DEG = (170.0, 179.999, 180.001, 190.0, 270.0, 350.0)


Between = Callable[[FloatArray, FloatArray, float], FloatArray]


def arccos_slerp(a: FloatArray, b: FloatArray, fraction: float) -> FloatArray:
    """SLERP as it stands in the books: the angle by arccos, no look at the sign."""
    angle = np.arccos(np.clip(np.dot(a, b), -1, 1))
    return np.asarray((np.sin((1 - fraction) * angle) * a + np.sin(fraction * angle) * b) / np.sin(angle))


def straight_line(a: FloatArray, b: FloatArray, fraction: float) -> FloatArray:
    """The normalised straight line from `a` to `b`, by the shorter way."""
    mean = (1 - fraction) * a + fraction * (b if np.dot(a, b) >= 0 else -b)
    return np.asarray(mean / np.linalg.norm(mean))


def turned(turn_deg: float, fraction: float = 1.0) -> FloatArray:
    """START after a part of a turn about AXIS."""
    return propagate(START, np.radians(turn_deg) * fraction * AXIS, 1.0)


def way_error_arcsec(between: Between, sign: float, turn_deg: float) -> float:
    """The largest error of `between` (`slerp`, or one that fails) on a turn whose end has this sign, arcsec; NaN if any is."""
    with np.errstate(invalid="ignore"):
        ways = [between(START, sign * turned(turn_deg), float(f)) for f in FRACTIONS]
    errors = [angle_between_rad(q, turned(turn_deg, f)) for q, f in zip(ways, FRACTIONS, strict=True)]
    return float(np.max(errors) * ARCSEC_PER_RAD)


def two_signs() -> FailureCase:
    """A sender that writes -q for the next sample, one degree on."""
    error, fault = (way_error_arcsec(between, -1.0, 1.0) for between in (slerp, arccos_slerp))
    return FailureCase(
        "q, then -q one degree on",
        "SLERP from one to the other as they are",
        f"goes round the long way: {fault / 3600:.0f} degrees off",
        f"{error:.0e} arcsec off",
        "q and -q are one attitude: the nearer of them is taken",
        Figures(error, fault, ANGLE_ARCSEC),
    )


def antipodal() -> FailureCase:
    """The same attitude twice, with either sign."""
    error, fault = (
        float(np.max([way_error_arcsec(between, sign, 0.0) for sign in (1.0, -1.0)])) for between in (slerp, arccos_slerp)
    )
    return FailureCase(
        "SLERP from q to q and to -q",
        "SLERP by arccos",
        f"{fault:.0f}: sin(angle) is 0",
        f"{error:.0e} arcsec off",
        "the angle comes from both chords, and a small one is a straight line",
        Figures(error, fault, ANGLE_ARCSEC),
    )


def half_turn() -> FailureCase:
    """Samples nearly half a turn apart."""
    error, fault = (way_error_arcsec(between, 1.0, 179.999) for between in (slerp, straight_line))
    return FailureCase(
        "SLERP over 179.999 degrees",
        "the normalised straight line",
        f"up to {fault / 3600:.1f} degrees off, and still on the great circle",
        f"{error:.0e} arcsec off",
        "SLERP turns at a constant rate, right up to the half turn where two ways are equally short",
        Figures(error, fault, ANGLE_ARCSEC),
    )


def sampled_error_arcsec(turn_deg: float, with_rates: bool) -> float:
    """The largest error of a timeline between samples that are `turn_deg` of a steady turn apart, arcsec."""
    rate = np.radians(turn_deg) / PERIOD_S * AXIS if with_rates else None
    timeline = Timeline(POLICY)
    for k in range(3):
        timeline.add(AttitudeSample(round(k * PERIOD_S * NS_PER_S), turned(turn_deg, k), rate))
    worst = 0.0
    for fraction in FRACTIONS:
        t_ns = round((1 + fraction) * PERIOD_S * NS_PER_S)
        attitude = timeline.at(t_ns)
        if attitude is None:
            raise AssertionError("a timeline with samples has an attitude")
        worst = max(worst, angle_between_rad(attitude.q_icrs_to_cam, turned(turn_deg, t_ns / NS_PER_S / PERIOD_S)))
    return worst * ARCSEC_PER_RAD


def fast_turns() -> FailureCase:
    """Turns of about pi, and more, from sample to sample."""
    error, fault = (max(sampled_error_arcsec(turn, rates) for turn in TURNS_DEG) for rates in (True, False))
    just_under, just_over = (sampled_error_arcsec(turn, False) / 3600 for turn in TURNS_DEG[1:3])
    return FailureCase(
        f"{TURNS_DEG[0]:g} to {TURNS_DEG[-1]:g} degrees from sample to sample",
        "samples without rates",
        f"{just_under:.0e} degrees off at {TURNS_DEG[1]:g}, {just_over:.0f} at {TURNS_DEG[2]:g}: the other way is shorter",
        f"with rates: {error:.0e} arcsec off",
        "the rates say which way, and how often round; send them, or more than two samples a turn",
        Figures(error, fault, ANGLE_ARCSEC),
    )


def norm_alone(q: tuple[float, ...]) -> bool:
    """Whether a quaternion passes that is refused where abs(norm - 1) is too large: NaN is never larger."""
    return not abs(math.sqrt(sum(c * c for c in q)) - 1.0) > NORM_TOLERANCE


def not_a_number() -> FailureCase:
    """NaN and infinity in each number of a packet and of JSON."""
    taken, passed, sent = 0, 0, 0
    for place, value in product(range(7), (math.nan, math.inf, -math.inf)):
        numbers = [*START, 0.0, 0.0, 0.0]
        numbers[place] = value
        text = json.dumps({"t_ns": 1, "q": list(numbers[:4]), "rate": numbers[4:]})
        for message in (encode(AttitudeSample(1, np.array(numbers[:4]), np.array(numbers[4:]))), text.encode()):
            taken += not isinstance(decode(message), Refusal)
            passed += norm_alone(tuple(numbers[:4]))
            sent += 1
    return FailureCase(
        "NaN or infinity in an attitude",
        "a check of abs(norm - 1) > 1e-3 alone",
        f"{passed} of {sent} pass: NaN is not larger, and a rate has no norm to check",
        f"{taken} taken",
        "every number has to be finite before anything is computed from it",
        Figures(float(taken), float(passed), NONE_TAKEN),
    )
