"""The inputs of a certificate's budget are standardised, and its intervals cover what they say."""

from __future__ import annotations

import math

import pytest
from scipy import stats

from hilstar.instruments.certify.budget import Input, by_trials, first_order

DRAWS = 100_000
# a standard deviation of n draws is known to 1 / sqrt(2 n), of a normal one; five of these
SIGMA_ERROR = 5 / math.sqrt(2 * DRAWS)
# a quantile of 95 % of 200 000 draws: five of sqrt(p (1 - p) / n) over the density there
TAIL_ERROR = 0.03


@pytest.mark.parametrize("distribution", ["normal", "rectangular", "triangular"])
def test_variables_of_every_distribution_have_a_standard_deviation_of_one(distribution, rng):
    drawn = Input("x", distribution, "", 1, 1.0, "px").draw(DRAWS, rng)
    assert drawn.std() == pytest.approx(1.0, abs=SIGMA_ERROR)
    assert drawn.mean() == pytest.approx(0.0, abs=5 / math.sqrt(DRAWS))


def test_few_readings_widen_the_interval_by_student_s_t():
    """2 u of an input with 4 degrees of freedom: 2.776 u, not 1.960 u (JCGM 100, table G.2)."""
    found = first_order(lambda z: 2 * z[0], [Input("x", "Student t", "", 1, 1.0, "px", 4.0)])
    assert found.dof[0] == pytest.approx(4.0)
    assert found.upper[0] == pytest.approx(2 * 2.776, abs=1e-2)
    assert found.lower[0] == pytest.approx(-2 * 2.776, abs=1e-2)


def test_trials_leave_a_fortieth_at_either_side(rng):
    found = by_trials(lambda z: z[0], [Input("x", "normal", "", 1, 1.0, "px")], rng, 200_000)
    limit = float(stats.norm.ppf(0.975))
    assert (found.lower[0], found.upper[0]) == pytest.approx((-limit, limit), abs=TAIL_ERROR)
