"""The search for keys that bring a bench within its tolerance, where what is within is known in
closed form; and the changes that each key has.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import pytest

from hilstar.server.bench.config import RenderSettings
from hilstar.server.bench.would_do import (
    MAX_PAIRS,
    Trial,
    Way,
    _Trials,
    brighter,
    codes_over_frames,
    first_trials,
    more_bits,
    shallower,
    smallest_pair,
)

START = Trial(RenderSettings(), 12, 7.0)
VALUES = (1, 2, 3, 4)


def way(name: str) -> Way:
    """A key with the values 1 to 4."""

    def changed(trial: Trial) -> Iterator[Trial]:
        for value in VALUES:
            yield trial.but(name, value)

    return changed


def values_of(trial: Trial) -> dict[str, object]:
    """The values of a trial by their keys."""
    return {change.key: change.value for change in trial.changes}


@pytest.mark.parametrize(
    ("within", "pair"),
    [
        (lambda a, b: a >= 2 and b >= 3, {"a": 2, "b": 3}),
        # with all of the cheaper one the dearer one needs 2: then 2 of the cheaper one do
        (lambda a, b: b >= 2 and a + b >= 4, {"a": 2, "b": 2}),
        (lambda a, b: a == b == 4, {"a": 4, "b": 4}),
        (lambda a, b: a + b >= 9, None),
    ],
)
def test_a_pair_has_the_least_of_the_dearer_key_and_then_of_the_cheaper(within, pair):
    trial = smallest_pair(START, way("a"), way("b"), lambda trial: within(**values_of(trial)))
    assert (None if trial is None else values_of(trial)) == pair


def test_two_ways_to_change_one_key_are_no_pair():
    assert smallest_pair(START, way("a"), way("a"), lambda trial: True) is None


def found(count: int, within: Callable[[dict[str, object]], bool]) -> list[dict[str, object]]:
    """What is tried of so many keys, "a" on, the cheapest first; `within` says of their values
    whether they do.
    """
    names = "abcdefg"[:count]

    def is_within(trial: Trial) -> bool:
        return within(dict.fromkeys(names, 0) | values_of(trial))

    return [values_of(trial) for trial in first_trials(START, list(map(way, names)), is_within)]


def test_each_key_that_does_alone_is_told_with_its_smallest_change():
    assert found(3, lambda values: values["a"] >= 3 or values["c"] >= 2) == [{"a": 3}, {"c": 2}]


def test_where_none_does_alone_the_cheapest_pairs_are_told_by_their_dearer_key():
    """Of four keys any two do that sum up to five: least of the dearer one with any of the cheaper,
    and then of the cheaper.
    """
    pairs = [{"a": 4, "b": 1}, {"a": 4, "c": 1}, {"b": 4, "c": 1}]
    assert found(4, lambda values: sum(values.values()) >= 5) == pairs
    assert len(pairs) == MAX_PAIRS


def test_where_no_pair_does_each_key_s_largest_change_is_told():
    assert found(3, lambda values: False) == [{"a": 4}, {"b": 4}, {"c": 4}]


def last_values(trials: Iterable[Trial]) -> list[object]:
    """What each trial changes last."""
    return [trial.changes[-1].value for trial in trials]


def test_a_full_scale_comes_down_by_magnitudes_and_to_the_faintest_star_at_most():
    measured = Trial(RenderSettings(flux_at_white_e_per_s=1e6), 12, 7.0)
    wanted = [6.31e5, 3.98e5, 2.51e5, 1.58e5, 1.0e5, 6.31e4, 2.51e4]  # 10^(-0.4 mag), three digits
    assert last_values(brighter(measured, 2.2)) == wanted
    stated = Trial(RenderSettings(brightest_v_mag=1.0), 12, 7.0)
    assert last_values(brighter(stated, 2.2)) == [1.5, 2.0]
    assert last_values(brighter(START, 2.2)) == [0.5, 1.0, 1.5, 2.0]


def test_a_catalogue_ends_no_brighter_than_its_brightest_star():
    assert last_values(shallower(START, 5.4)) == [6.5, 6.0, 5.5]


@pytest.mark.parametrize(
    ("frames", "codes", "values"),
    [(1, "round", []), (2, "round", ["temporal"]), (9, "temporal", [])],
)
def test_codes_over_frames_are_of_exposures_of_several(frames, codes, values):
    assert last_values(codes_over_frames(START, frames, codes)) == values


def test_bits_are_more_than_there_are_and_of_a_response_that_has_them():
    assert last_values(more_bits(START, lambda trial: trial.bits != 16)) == [14]


def test_a_response_that_was_measured_has_no_other_bits(small_bench):
    measured = replace(small_bench.calibration, name="measured")
    trials = _Trials(replace(small_bench, calibration=measured))
    assert last_values(trials.ways[0](START)) == []
