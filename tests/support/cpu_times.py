"""A plugin of pytest that writes the CPU time of each test: `-p tests.support.cpu_times`, for
tests/support/slow_tests.py.

It writes a file a process into the folder that HILSTAR_CPU_TIMES names: a row a test, its seconds
of CPU with those of its children, a tab, and its name. CPU time is the same on a busy machine as on
an idle one, within a fifth.
"""

from __future__ import annotations

import os
import resource
from collections.abc import Generator
from pathlib import Path

import pytest

FOLDER = "HILSTAR_CPU_TIMES"


def cpu_s() -> float:
    """What this process and its ended children have used, s."""
    own = resource.getrusage(resource.RUSAGE_SELF)
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return own.ru_utime + own.ru_stime + children.ru_utime + children.ru_stime


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """A row of a test, its fixtures included."""
    before_s = cpu_s()
    outcome = yield
    folder = Path(os.environ[FOLDER])
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{os.getpid()}.tsv"
    with path.open("a", encoding="utf-8") as rows:
        rows.write(f"{cpu_s() - before_s:.4f}\t{item.nodeid}\n")
    return outcome
