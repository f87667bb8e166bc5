"""What a check of a certified bench tells from noise, by SciPy's distributions."""

from __future__ import annotations

import math

import pytest
from scipy.stats import f, t

from hilstar.instruments.certify.check import TOLERANCES, _Change

# of a change that is none, told as one: so many of a million
PROBABILITY = 1e-4


@pytest.mark.parametrize("dof", [3.0, 20.0, 1e6])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_change_is_told_where_noise_of_either_sign_would_make_it_as_rarely_as_asked(dof, sign):
    tolerance, _ = TOLERANCES["latency"]
    limit = tolerance + 0.02 * t.isf(PROBABILITY / 2, dof)
    for value, in_tolerance in ((0.99 * limit, True), (1.01 * limit, False)):
        figure = _Change("latency", sign * value, 0.02, dof).judged(PROBABILITY)
        assert figure.threshold == pytest.approx(limit, rel=1e-6)
        assert bool(figure.in_tolerance) is in_tolerance
        assert (figure.upper - figure.lower) / 2 == pytest.approx(0.02 * t.isf(0.025, dof))


def test_a_root_mean_square_is_told_by_f():
    tolerance, _ = TOLERANCES["psf"]
    limit = math.hypot(tolerance, 0.3 * math.sqrt(f.isf(PROBABILITY, 12.0, 40.0)))
    assert _Change("psf", limit, 0.3, 40.0, 12.0).judged(PROBABILITY).threshold == pytest.approx(
        limit
    )
