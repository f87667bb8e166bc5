"""A plugin of pytest that runs the tests nearest to a module first, for tools/mutants.py:
`-p tests.support.near_first`, the module's dotted name in HILSTAR_NEAR.

Nearest are files that name the module, then those that name its room; with HILSTAR_NEAR_ALONE=1 no
others are collected.
"""

from __future__ import annotations

import os
import re
from functools import cache
from pathlib import Path

import pytest

MODULE = os.environ.get("HILSTAR_NEAR", "hilstar")
ROOM, _, NAME = MODULE.rpartition(".")
# as in `from hilstar.sky import air`, over one line or several
IMPORTED = re.compile(rf"from {re.escape(ROOM)} import (?:\([^)]*|[^(\n]*)\b{re.escape(NAME)}\b")
FAR = 2


@cache
def distance(path: Path) -> int:
    """0 for a file that names the module, 1 for one that names its room, else FAR."""
    text = path.read_text(encoding="utf-8")
    if re.search(rf"\b{re.escape(MODULE)}\b", text) or IMPORTED.search(text):
        return 0
    return 1 if ROOM in text else FAR


@pytest.hookimpl
def pytest_ignore_collect(collection_path: Path) -> bool | None:
    """With HILSTAR_NEAR_ALONE files of tests that are far are not read any further."""
    if "HILSTAR_NEAR_ALONE" not in os.environ or not collection_path.match("test_*.py"):
        return None
    return distance(collection_path) == FAR or None


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Sort by the distance of each test's file; the order within a file stays."""
    items.sort(key=lambda item: distance(item.path))
