"""A plugin of pytest that writes which tests run each line, for tools/mutants.py --by-lines:
`-n0 -p tests.support.line_map`, the file to write in HILSTAR_LINE_MAP. It needs `coverage`.

The file is JSON: `seconds` of each test function, all its cases together, and of each file, and
`tests` by path and line. What a fixture of a file or wider runs counts for its whole file. What
tests run in other processes is not in it.
"""

from __future__ import annotations

import json
import os
import time
from collections import defaultdict
from collections.abc import Generator
from pathlib import Path

import coverage
import pytest

FILE = "HILSTAR_LINE_MAP"
ROOT = Path(__file__).parent.parent.parent
COVERAGE = coverage.Coverage(data_file=None, source=[str(ROOT / "hilstar")])
SECONDS: defaultdict[str, float] = defaultdict(float)


@pytest.hookimpl(tryfirst=True)
def pytest_sessionstart() -> None:
    COVERAGE.start()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """A test's lines are its function's."""
    function = item.nodeid.partition("[")[0]
    COVERAGE.switch_context(function)
    begun_s = time.monotonic()
    try:
        return (yield)
    finally:
        passed_s = time.monotonic() - begun_s
        SECONDS[function] += passed_s
        SECONDS[function.partition("::")[0]] += passed_s
        COVERAGE.switch_context("")


@pytest.hookimpl(wrapper=True)
def pytest_fixture_setup(
    fixturedef: pytest.FixtureDef[object], request: pytest.FixtureRequest
) -> Generator[None, object, object]:
    """A fixture that several tests share: its lines are the file's."""
    if fixturedef.scope == "function":
        return (yield)
    function = request._pyfuncitem.nodeid.partition("[")[0]
    COVERAGE.switch_context(function.partition("::")[0])
    try:
        return (yield)
    finally:
        COVERAGE.switch_context(function)


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish() -> None:
    COVERAGE.stop()
    data = COVERAGE.get_data()
    tests: dict[str, dict[int, list[str]]] = {}
    for file in sorted(data.measured_files()):
        by_line = data.contexts_by_lineno(file)
        path = Path(file).relative_to(ROOT).as_posix()
        tests[path] = {line: sorted(set(names) - {""}) for line, names in by_line.items()}
    content = {"seconds": SECONDS, "tests": tests}
    Path(os.environ[FILE]).write_text(json.dumps(content), encoding="utf-8")
