"""The search for two keys that together bring a bench within its tolerance, where what is within is
known in closed form.
"""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from hilstar.server.bench import would_do as keys_that_would_do
from hilstar.server.bench.config import RenderSettings
from hilstar.server.bench.would_do import MAX_PAIRS, _smallest_pair, _Trial, _Trials, would_do

VALUES = (1, 2, 3, 4)


class KnownTrials:
    """Trials of two keys, each with the values 1 to 4; `within` says of a pair whether it does."""

    def __init__(self, within):
        self.start = _Trial(RenderSettings(), 8, 7.0)
        self._within = within

    def effort(self, trial):
        values = {change.key: change.value for change in trial.changes}
        return SimpleNamespace(within=self._within(values.get("a", 0), values.get("b", 0)))


def cheaper(trial):
    for value in VALUES:
        yield trial.but("a", value)


def dearer(trial):
    for value in VALUES:
        yield trial.but("b", value)


@pytest.mark.parametrize(
    ("within", "pair"),
    [
        (lambda a, b: a >= 2 and b >= 3, (2, 3)),
        # with all of the cheaper one the dearer one needs 2: then 2 of the cheaper one do
        (lambda a, b: b >= 2 and a + b >= 4, (2, 2)),
        (lambda a, b: a == b == 4, (4, 4)),
        (lambda a, b: a + b >= 9, None),
    ],
)
def test_a_pair_has_the_least_of_the_dearer_key_and_then_of_the_cheaper(within, pair):
    trial = _smallest_pair(KnownTrials(within), cheaper, dearer)
    values = None if trial is None else tuple(change.value for change in trial.changes)
    assert values == pair


def test_two_ways_to_change_one_key_are_no_pair():
    assert _smallest_pair(KnownTrials(lambda a, b: True), cheaper, cheaper) is None


class KnownBench:
    """Trials of so many keys, "a" on, the cheapest first; `within` says of their values, by the
    key, whether they do. A key at 4 leaves 1 mag, at 0 5 mag.
    """

    def __init__(self, monkeypatch, count: int, within) -> None:
        monkeypatch.setattr(keys_that_would_do, "_Trials", lambda bench: self)
        self.start = _Trial(RenderSettings(), 8, 7.0)
        self._names = "abcdefg"[:count]
        self._within = within
        self.ways = [self._way(name) for name in self._names]

    @staticmethod
    def _way(name: str):
        def way(trial):
            for value in VALUES:
                yield trial.but(name, value)

        return way

    def effort(self, trial):
        values = dict.fromkeys(self._names, 0)
        values |= {change.key: change.value for change in trial.changes}
        error_mag = 5.0 - sum(values.values())
        is_within = self._within(values)
        return SimpleNamespace(within=is_within, error_mag=error_mag, error_px=-error_mag)

    def found(self) -> list[dict[str, int]]:
        """What would do, by the keys of each remedy; its errors are the trial's."""
        remedies = would_do(SimpleNamespace(effort=SimpleNamespace(within=False)))
        for remedy in remedies:
            total = sum(change.value for change in remedy.changes)
            assert (remedy.error_mag, remedy.error_px) == (5.0 - total, total - 5.0)
        return [{change.key: change.value for change in remedy.changes} for remedy in remedies]


def test_each_key_that_does_alone_is_told_with_its_smallest_change(monkeypatch):
    bench = KnownBench(monkeypatch, 3, lambda values: values["a"] >= 3 or values["c"] >= 2)
    assert bench.found() == [{"a": 3}, {"c": 2}]


def test_where_none_does_alone_the_cheapest_pairs_are_told_by_their_dearer_key(monkeypatch):
    """Of four keys any two do that sum up to five."""
    bench = KnownBench(monkeypatch, 4, lambda values: sum(values.values()) >= 5)
    pairs = bench.found()
    assert [set(pair) for pair in pairs] == [{"a", "b"}, {"a", "c"}, {"b", "c"}]
    assert len(pairs) == MAX_PAIRS
    # least of the dearer one with any of the cheaper, and then of the cheaper
    assert pairs == [{"a": 4, "b": 1}, {"a": 4, "c": 1}, {"b": 4, "c": 1}]


def test_where_no_pair_does_each_key_s_largest_change_is_told(monkeypatch):
    bench = KnownBench(monkeypatch, 3, lambda values: False)
    assert bench.found() == [{"a": 4}, {"b": 4}, {"c": 4}]


def test_a_bench_that_is_within_needs_nothing():
    assert would_do(SimpleNamespace(effort=SimpleNamespace(within=True))) == []


def values_of(way, trials, trial=None):
    start = trial or _Trial(RenderSettings(), 12, 7.0)
    return [trial.changes[-1].value for trial in way(trials, start)]


def test_a_full_scale_comes_down_by_magnitudes_and_to_the_faintest_star_at_most():
    trials = SimpleNamespace(_stars=SimpleNamespace(v_mag=np.array([0.0, 2.2])))
    measured = _Trial(RenderSettings(flux_at_white_e_per_s=1e6), 12, 7.0)
    wanted = [6.31e5, 3.98e5, 2.51e5, 1.58e5, 1.0e5, 6.31e4, 2.51e4]  # 10^(-0.4 mag), three digits
    assert values_of(_Trials._brighter, trials, measured) == wanted
    stated = _Trial(RenderSettings(brightest_v_mag=1.0), 12, 7.0)
    assert values_of(_Trials._brighter, trials, stated) == [1.5, 2.0]
    assert values_of(_Trials._brighter, trials) == [0.5, 1.0, 1.5, 2.0]


def test_a_catalogue_ends_no_brighter_than_its_brightest_star():
    trials = SimpleNamespace(_stars=SimpleNamespace(v_mag=np.array([5.4, 7.0])))
    assert values_of(_Trials._shallower, trials) == [6.5, 6.0, 5.5]


@pytest.mark.parametrize(
    ("frames", "codes", "values"),
    [(1, "round", []), (2, "round", ["temporal"]), (9, "temporal", [])],
)
def test_codes_over_frames_are_of_exposures_of_several(frames, codes, values):
    light = SimpleNamespace(exposure_frames=frames)
    bench = SimpleNamespace(effort=SimpleNamespace(light=light, quantisation=codes))
    assert values_of(_Trials._codes_over_frames, SimpleNamespace(_bench=bench)) == values


@pytest.mark.parametrize(("is_formula", "values"), [(True, [14]), (False, [])])
def test_bits_are_more_than_there_are_and_of_a_response_that_has_them(is_formula, values):
    bench = SimpleNamespace(calibration=SimpleNamespace(is_formula=is_formula))
    trials = SimpleNamespace(_bench=bench, _exists=lambda trial: trial.bits != 16)
    assert values_of(_Trials._more_bits, trials) == values
