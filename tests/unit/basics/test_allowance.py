"""A token bucket: how much at once, and how much with time."""

from __future__ import annotations

import pytest

from hilstar.basics.allowance import Allowance
from hilstar.basics.units import NS_PER_S

S = NS_PER_S


def test_a_burst_at_once_and_then_its_rate():
    allowance = Allowance(3, 2.0)
    taken = [allowance.take(now_ns) for now_ns in (S, S, S, S, S * 3 // 2, S * 3 // 2, 2 * S)]
    assert taken == [True, True, True, False, True, False, True]


def test_more_than_is_left_is_refused_whole_and_takes_nothing():
    allowance = Allowance(3, 1.0)
    assert [allowance.take(S, count) for count in (2, 2, 1, 1)] == [True, False, True, False]


def test_a_long_rest_allows_no_more_than_a_burst():
    allowance = Allowance(2, 1.0)
    allowance.take(S, 2)
    assert [allowance.take(100 * S) for _ in range(3)] == [True, True, False]


@pytest.mark.parametrize("back_ns", [S, 50 * S])
def test_a_clock_that_steps_back_neither_gives_nor_takes(back_ns):
    allowance = Allowance(3, 1.0)
    assert allowance.take(100 * S)
    taken = [allowance.take(100 * S - back_ns) for _ in range(3)]
    assert taken == [True, True, False]
