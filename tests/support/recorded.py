"""What results/ has of a study beside what the study measures now: the pages' tables are made of
those files, and a test of a table's figures alone would not see that they are another program's.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from tests.support.benches import ROOT
from tests.support.tables import csv_rows

WITHIN, SMALLEST = 0.02, 1e-9  # of a figure: other drivers round a few codes otherwise


def assert_recorded(measured: Path, keys: Sequence[str], figures: Sequence[str]) -> None:
    """Fail unless each row of a study's file that results/ has, too, by its keys, has figures
    within WITHIN of those there, and some row is there.
    """
    recorded = {key_of(row, keys): row for row in rows_of(ROOT / "results" / measured.name, keys)}
    pairs = []
    for row in rows_of(measured, keys):
        if key_of(row, keys) in recorded:
            pairs.append((row, recorded[key_of(row, keys)]))
    assert pairs, f"results/{measured.name} has no row of the study's"
    for now, then in pairs:
        for figure in figures:
            assert is_near(now[figure], then[figure]), (measured.name, figure, now, then)


def assert_row(name: str, keys: Mapping[str, object], figures: Mapping[str, float]) -> None:
    """Fail unless a file of results/ has one row with these keys, and near figures in it."""
    wanted = tuple(str(value) for value in keys.values())
    matching = []
    for row in rows_of(ROOT / "results" / name, list(keys)):
        if key_of(row, list(keys)) == wanted:
            matching.append(row)
    assert len(matching) == 1, (name, wanted, len(matching))
    for figure, now in figures.items():
        then = matching[0][figure]
        assert is_near(str(now), then), (name, figure, now, then)


def rows_of(path: Path, keys: Sequence[str]) -> list[dict[str, str]]:
    """The rows of a file, which has to have the keys."""
    rows = csv_rows(path)
    assert rows and set(keys) <= set(rows[0]), path
    return rows


def key_of(row: dict[str, str], keys: Sequence[str]) -> tuple[str, ...]:
    """What a row is of."""
    return tuple(row[key] for key in keys)


def is_near(now: str, then: str) -> bool:
    """Whether two cells are the same text, or near numbers."""
    if now == then:
        return True
    return math.isclose(float(now), float(then), rel_tol=WITHIN, abs_tol=SMALLEST)
