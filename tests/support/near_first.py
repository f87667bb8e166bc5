"""A plugin of pytest that runs the tests nearest to a module first, for tools/mutants.py:
`-p tests.support.near_first`, the module's dotted name in HILSTAR_NEAR.

Nearest are files that name the module, then those that name its room.
"""

from __future__ import annotations

import os

import pytest

MODULE = os.environ.get("HILSTAR_NEAR", "hilstar")


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Sort by the distance of each test's file; the order within a file stays."""
    room = MODULE.rpartition(".")[0]
    distances: dict[str, int] = {}
    for item in items:
        path = str(item.path)
        if path not in distances:
            text = item.path.read_text(encoding="utf-8")
            distances[path] = 0 if MODULE in text else 1 if room in text else 2
    items.sort(key=lambda item: distances[str(item.path)])
