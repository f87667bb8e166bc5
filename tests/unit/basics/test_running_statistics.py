"""Statistics of a run of values without keeping them."""

from __future__ import annotations

import numpy as np
import pytest

from hilstar.basics.running_statistics import STEP, Percentiles, RunningStatistics

# A value is known to half a bin; a percentile of n values besides to the gap between its
# neighbours, here far less.
RELATIVE = STEP


@pytest.mark.parametrize(
    "values",
    [
        np.geomspace(0.01, 50, 5000),
        np.linspace(-3, 5, 5001),
        np.linspace(-5, 3, 5001),
        np.full(10, 16.7),
        np.array([0.0, 1e-9]),
        np.array([-2.5]),
    ],
    ids=["log", "both signs", "negative median", "one value", "zero", "negative"],
)
@pytest.mark.parametrize("batches", [0, 1, 7], ids=["by value", "at once", "in batches"])
def test_percentiles_are_those_of_the_values(values, batches, rng):
    statistics = RunningStatistics()
    drawn = rng.permutation(values)
    if batches:
        for batch in np.array_split(drawn, batches):
            statistics.add_all(batch)
    else:
        for value in drawn:
            statistics.add(float(value))
    assert statistics.count == len(values)
    found = statistics.percentiles()
    for name, percent in (("p50", 50), ("p99", 99)):
        exact = np.percentile(values, percent, method="inverted_cdf")
        assert getattr(found, name) == pytest.approx(exact, rel=RELATIVE, abs=2e-6)
    assert found.max == values.max()
    assert statistics.mean == pytest.approx(values.mean(), abs=1e-12)
    if len(values) > 1:
        assert statistics.deviation == pytest.approx(values.std(), rel=1e-9, abs=1e-12)


def test_no_values_have_no_statistics():
    statistics = RunningStatistics()
    assert statistics.percentiles() == Percentiles(None, None, None)
    assert statistics.mean is None and statistics.deviation is None


def test_what_lies_beyond_the_bins_is_counted_in_the_last():
    statistics = RunningStatistics()
    for value in (1e15, -1e15, 1.0):
        statistics.add(value)
    assert statistics.percentiles().max == 1e15
    assert statistics.percentile(50) == pytest.approx(1.0, rel=RELATIVE)


def test_no_percentile_is_above_the_largest_value(rng):
    """Which is exact, where a percentile is the middle of its bin."""
    for value in [*rng.uniform(0.1, 100.0, 50), *-rng.uniform(0.1, 100.0, 50), 0.0]:
        statistics = RunningStatistics()
        for one in (value, value - 1e3):
            statistics.add(one)
        assert statistics.percentile(99) <= statistics.percentile(100) <= statistics.max == value


@pytest.mark.parametrize("size", [9e-7, -9e-7, 0.0])
def test_what_is_within_a_millionth_of_0_counts_as_0_by_value_and_at_once(size):
    by_value, at_once = RunningStatistics(), RunningStatistics()
    for value in (size, size, 1.0):
        by_value.add(value)
    at_once.add_all(np.array([size, size, 1.0]))
    assert by_value.percentile(50) == at_once.percentile(50) == 0.0
