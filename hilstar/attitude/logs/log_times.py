"""Whether the times of a log are in the unit that its format states: by its rates where it has
them, else by its own steps.

Rates and quaternions say how far a body turns from one sample to the next; the times say how long
that took. In another unit than the stated one, the turn by the rates is that many times too large,
for every interval alike and about the same axis.
"""

from collections.abc import Sequence
from decimal import Decimal
from itertools import pairwise

import numpy as np

from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.basics.arrays import FloatArray
from hilstar.basics.rotation import conjugate, multiply, to_rotation_vector
from hilstar.basics.units import NS_PER_S

# Times before 2000 are those of a simulated clock that began at 0, not dates.
FIRST_DATE_NS = 946_684_800 * NS_PER_S
TIMES = "log-times"  # the kind of these notices
LOOKED_AT = 2000  # intervals
MIN_INTERVALS = 5
MIN_TURN_RAD = 1e-6  # 0.2 arcsec: below that a quaternion's own digits are the turn
MAX_OFF = 0.1  # of the ratio: rates and quaternions of one motion agree better
MIN_COSINE = 0.98  # between the two axes
MIN_STEP_S, MAX_STEP_S = 1e-4, 10.0
# How many seconds a log's second is, for units that people write instead; of ns, how many ns.
SECONDS = {
    "ns": 1e-9,
    "100 ns": 1e-7,
    "us": 1e-6,
    "ms": 1e-3,
    "minutes": 60.0,
    "hours": 3600.0,
    "days": 86400.0,
}
OF_NS = {"100 ns": 100.0, "us": 1e3, "ms": 1e6, "s": 1e9}
# What rates of another unit look like, by the same factor.
RATES_LIKE = {1e-3: "mrad/s", 1e3: "rad/ms"}


def median_step_s(samples: Sequence[AttitudeSample]) -> float:
    """The median interval of a log, s; NaN of a single sample."""
    t_ns = np.array([sample.t_ns for sample in samples], dtype=object)
    if len(samples) > 1:
        return float(np.median(np.asarray(np.diff(t_ns) / NS_PER_S, dtype=np.float64)))
    return float("nan")


def span_line(samples: Sequence[AttitudeSample]) -> str:
    """How long a log is, for a person: its span, its attitudes and their step."""
    span_s = (samples[-1].t_ns - samples[0].t_ns) / NS_PER_S
    if len(samples) < 2:
        return "the log is a single attitude"
    return (
        f"the log is {span_s:.6g} s long: {len(samples)} attitudes, a step of"
        f" {median_step_s(samples):.4g} s (median)"
    )


def time_notices(samples: Sequence[AttitudeSample], unit: str) -> list[tuple[str, str]]:
    """What to tell of the times of a log whose format states `unit` ("s", "ms", "us" or "ns"):
    another one by the rates, or an odd step.
    """
    if len(samples) < 2:
        return []
    step_s = median_step_s(samples)
    unit_line = _named(samples, unit, step_s)
    if unit_line:
        return [
            (TIMES, f"the rates do not fit the times: probably {unit_line}; the format has {unit}")
        ]
    if MIN_STEP_S <= step_s <= MAX_STEP_S:
        return []
    if step_s > MAX_STEP_S:
        limit = f"over {MAX_STEP_S:g} s"
    else:
        limit = f"under {MIN_STEP_S * 1e3:g} ms"
    return [
        (
            TIMES,
            (
                f"{span_line(samples)}, which is {limit}: are its times in {unit}, as the format"
                " has them?"
            ),
        )
    ]


def _named(samples: Sequence[AttitudeSample], unit: str, step_s: float) -> str:
    """The unit of the times, or of the rates where that is as likely; "" where the rates fit, or
    say nothing.
    """
    ratio = _too_far(samples[: LOOKED_AT + 1])
    for name, factor in _other_units(unit).items():
        if not abs(ratio * factor - 1) <= MAX_OFF:  # NaN too
            continue
        line = f"the times are in {name}"
        rates = RATES_LIKE.get(factor)
        if rates is None or not MIN_STEP_S <= step_s <= MAX_STEP_S:
            return line
        other = f"the rates are in {rates}"
        if MIN_STEP_S <= step_s * factor <= MAX_STEP_S:
            return f"{line}, or {other}"
        return other
    return ""


def _other_units(unit: str) -> dict[str, float]:
    """How many of a stated unit the units are that people write instead."""
    if unit == "ns":
        return OF_NS
    units = {"s": 1.0} | SECONDS
    stated = units.pop(unit)
    return {name: seconds / stated for name, seconds in units.items()}


def _too_far(samples: Sequence[AttitudeSample]) -> float:
    """How many times as far as the quaternions the rates turn, the median; NaN where they have no
    rates or another axis.
    """
    before: list[AttitudeSample] = []
    after: list[AttitudeSample] = []
    for sample, following in pairwise(samples):
        has_rates = sample.rate_cam_rad_s is not None and following.rate_cam_rad_s is not None
        if has_rates and not following.discontinuity:
            before.append(sample)
            after.append(following)
    if len(before) < MIN_INTERVALS:
        return float("nan")
    q_before, rate_before = _attitudes_and_rates(before)
    q_after, rate_after = _attitudes_and_rates(after)
    seconds = np.array([(b.t_ns - a.t_ns) / NS_PER_S for a, b in zip(before, after, strict=True)])
    turned = -to_rotation_vector(multiply(q_after, conjugate(q_before)))
    by_rate = (rate_before + rate_after) / 2 * seconds[:, None]
    return _ratio(turned, by_rate)


def _attitudes_and_rates(samples: Sequence[AttitudeSample]) -> tuple[FloatArray, FloatArray]:
    """The quaternions (n, 4) and rates (n, 3) of samples, all of which have a rate."""
    q = np.array([sample.q_icrs_to_cam for sample in samples])
    rate = np.array([sample.rate_cam_rad_s for sample in samples])
    return q, rate


def _ratio(turned: FloatArray, by_rate: FloatArray) -> float:
    lengths = np.linalg.norm(turned, axis=1)
    others = np.linalg.norm(by_rate, axis=1)
    turns = (lengths > MIN_TURN_RAD) & (others > 0)
    if turns.sum() < MIN_INTERVALS:
        return float("nan")
    turned = turned[turns]
    by_rate = by_rate[turns]
    lengths = lengths[turns]
    others = others[turns]
    cosines = (turned * by_rate).sum(axis=1) / (lengths * others)
    if np.median(cosines) > MIN_COSINE:
        return float(np.median(others / lengths))
    return float("nan")


def refuse_grouped(digits: str) -> None:
    """Raise ValueError for numbers such as 1_0, which Python alone reads, as 10."""
    if "_" in digits:
        raise ValueError


def ns_of_seconds(seconds: str) -> int:
    """Decimal seconds as nanoseconds, to the nearest; a float of today's Unix time would be off by
    100 ns.

    Raises ValueError or ArithmeticError.
    """
    value = Decimal(seconds)
    refuse_grouped(seconds)
    if not value.is_finite() or value.adjusted() > 40:
        raise ValueError
    return int(value.scaleb(9).to_integral_value())
