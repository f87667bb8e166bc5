"""The spread of figures without keeping them."""

from __future__ import annotations

import numpy as np
import pytest

from hilstar.spread import STEP, RunningSpread

# A value is known to half a bin; a percentile of n values besides to the gap between its neighbours, here far less.
RELATIVE = STEP


@pytest.mark.parametrize(
    "values",
    [np.geomspace(0.01, 50, 5000), np.linspace(-3, 5, 5001), np.full(10, 16.7), np.array([0.0, 1e-9]), np.array([-2.5])],
    ids=["log", "both signs", "one value", "zero", "negative"],
)
def test_percentiles_are_those_of_the_values(values, rng):
    spread = RunningSpread()
    for value in rng.permutation(values):
        spread.add(float(value))
    summary = spread.summary()
    for name, percent in (("p50", 50), ("p99", 99)):
        exact = np.percentile(values, percent, method="inverted_cdf")
        assert summary[name] == pytest.approx(exact, rel=RELATIVE, abs=2e-6)
    assert summary["max"] == values.max()
    assert spread.mean == pytest.approx(values.mean(), abs=1e-12)
    if len(values) > 1:
        assert spread.deviation == pytest.approx(values.std(), rel=1e-9, abs=1e-12)


def test_nothing_has_no_spread():
    spread = RunningSpread()
    assert spread.summary() == {"p50": None, "p99": None, "max": None}
    assert spread.mean is None and spread.deviation is None


def test_what_lies_beyond_the_bins_is_counted_in_the_last():
    spread = RunningSpread()
    for value in (1e15, -1e15, 1.0):
        spread.add(value)
    assert spread.summary()["max"] == 1e15
    assert spread.percentile(50) == pytest.approx(1.0, rel=RELATIVE)
