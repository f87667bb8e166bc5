"""A plugin of pytest that writes the CPU time of each test: `-p tests.support.cpu_times`, for
tests/support/slow_tests.py.

It writes a file a process into the folder that HILSTAR_CPU_TIMES names: a row a test, its seconds
of CPU with those of its children, a tab, and its name. What a fixture of a file or wider takes is
no test's: to leave out the first that asks would leave it to the next. CPU time is the same on a
busy machine as on an idle one, within a fifth.
"""

from __future__ import annotations

import os
import resource
from collections.abc import Generator
from pathlib import Path

import pytest

FOLDER = "HILSTAR_CPU_TIMES"
SHARED_S = pytest.StashKey[float]()  # what shared fixtures took within a test


def cpu_s() -> float:
    """What this process and its ended children have used, s."""
    own = resource.getrusage(resource.RUSAGE_SELF)
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return own.ru_utime + own.ru_stime + children.ru_utime + children.ru_stime


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """A row of a test, its own fixtures included."""
    item.stash[SHARED_S] = 0.0
    before_s = cpu_s()
    outcome = yield
    folder = Path(os.environ[FOLDER])
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{os.getpid()}.tsv"
    with path.open("a", encoding="utf-8") as rows:
        rows.write(f"{cpu_s() - before_s - item.stash[SHARED_S]:.4f}\t{item.nodeid}\n")
    return outcome


@pytest.hookimpl(wrapper=True)
def pytest_fixture_setup(
    fixturedef: pytest.FixtureDef[object], request: pytest.FixtureRequest
) -> Generator[None, object, object]:
    """What a shared fixture takes, without those that it asks for: these were set up before it."""
    if fixturedef.scope == "function":
        return (yield)
    before_s = cpu_s()
    try:
        return (yield)
    finally:
        request._pyfuncitem.stash[SHARED_S] += cpu_s() - before_s
