"""The search for two keys that together bring a bench within its tolerance, where what is within is
known in closed form.
"""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from hilstar.server.bench.config import RenderSettings
from hilstar.server.bench.would_do import _smallest_pair, _Trial

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
