"""The inputs of a certificate's budget are standardised, and its intervals cover what they say."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from hilstar.instruments.certify.budget import (
    BudgetTrials,
    Combined,
    Input,
    _settled,
    by_trials,
    first_order,
    why_they_differ,
)

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


def test_trials_of_few_readings_have_student_s_tails(rng):
    """2.5 % of the draws lie beyond 2.776, of 4 degrees of freedom (JCGM 100, table G.2)."""
    drawn = Input("x", "Student t", "", 1, 1.0, "px", 4.0).draw(DRAWS, rng)
    share = 0.05
    sure = 5 * math.sqrt(share * (1 - share) / DRAWS)
    assert (np.abs(drawn) > 2.776).mean() == pytest.approx(share, abs=sure)


def test_variables_of_one_input_share_the_estimate_of_their_spread(rng):
    """With n degrees of freedom the mean of x^2 y^2 is n^2 / ((n - 2) (n - 4)), and of estimates of
    their own (n / (n - 2))^2.
    """
    dof = 20.0
    drawn = Input("x", "Student t", "", 2, 1.0, "px", dof).draw(DRAWS, rng)
    both = (drawn**2).prod(axis=1)
    wanted = dof**2 / ((dof - 2) * (dof - 4))
    sure = 5 * both.std() / math.sqrt(DRAWS)
    assert both.mean() == pytest.approx(wanted, abs=sure)
    assert wanted - (dof / (dof - 2)) ** 2 > sure  # which tells them apart


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


@pytest.mark.parametrize("row", range(4), ids=["mean", "standard", "lower", "upper"])
@pytest.mark.parametrize(("standard", "half_digit"), [(0.99, 0.005), (0.1, 0.005), (1.01, 0.05)])
def test_trials_go_on_until_two_digits_of_the_spread_and_of_both_ends_stand(
    row, standard, half_digit
):
    """Of four batches, as far above as below: their mean is known to 2 / sqrt(3) of that at two
    sigmas. Nothing is stated by the mean.
    """
    for share, stands in ((0.99, True), (1.01, row == 0)):
        batches = np.ones((4, 4, 2))
        batches[:, 1] = standard
        off = share * half_digit * math.sqrt(3) / 2
        batches[:, row, 1] += off * np.array([1.0, -1.0, 1.0, -1.0])
        assert _settled(batches) == stands


NORMAL = Input("steady", "normal", "", 1, 1.0, "px")
FLAT = Input("flat", "rectangular", "", 1, 1.0, "px")
PEAKED = Input("peaked", "triangular", "", 1, 1.0, "px")
FEW = Input("few", "Student t", "", 1, 1.0, "px", 4.0)


# Of a figure of 10 +- 2 to first order, whose trials end there: 5 % of the half width is 0.1.
@pytest.mark.parametrize(
    ("ends", "parts", "why"),
    [
        ((8.09, 11.91), {FLAT: 1.0}, ""),
        ((7.91, 12.09), {FLAT: 1.0}, ""),
        ((8.11, 11.89), {FLAT: 1.0}, "the largest input (flat) is rectangular, whose tails"),
        ((7.89, 12.11), {NORMAL: 0.7, PEAKED: 0.72}, "the largest input (peaked) is triangular"),
        # half of the variance is not most of it
        ((7.89, 12.11), {NORMAL: 0.7, FLAT: 0.7}, "over the inputs' range"),
        ((7.89, 12.11), {NORMAL: 0.68, PEAKED: 0.69, FEW: 0.2}, "few readings (few): Welch"),
        # a Student's t of less than one per cent of the variance tells nothing
        ((7.89, 12.11), {NORMAL: 1.0, FEW: 0.09}, "the model is not linear over the inputs' range"),
        ((8.5, 12.5), {FLAT: 1.0}, "its interval is not even about the value"),
        ((8.0, 12.11), {NORMAL: 1.0}, "the model is not linear over the inputs' range"),
        ((7.89, 12.0), {NORMAL: 1.0}, "the model is not linear over the inputs' range"),
    ],
)
def test_why_two_ways_of_an_interval_differ(ends, parts, why):
    contribution = np.array([[0.0, *parts.values()]])
    number = np.array([10.0]), np.array([1.0]), np.array([math.inf])
    combined = Combined(*number, np.array([8.0]), np.array([12.0]), contribution)
    one = np.ones(1)
    drawn = BudgetTrials(one, one, np.array(ends[:1]), np.array(ends[1:]), 9, True)
    unused = Input("unused", "triangular", "", 1, 1.0, "px", 2.0)
    said = why_they_differ(combined, drawn, [unused, *parts], 0)
    assert why in said and bool(said) == bool(why)
