"""The examples in the public names' docstrings run, and each name has one."""

from __future__ import annotations

import doctest

import numpy as np
import pytest

import hilstar
from tests.docs.pages import blocks_of
from tests.support.benches import ROOT
from tests.support.planted_run import write_run
from tests.support.planted_tracker import Sizes, plant, scan

BENCH = next(
    block.text
    for block in blocks_of((ROOT / "docs" / "python-api.md").read_text())
    if block.title == "bench.toml"
)
# of a planted tracker
SIZES = Sizes(offset_s=0.02)


def examples_of(name: str) -> list[doctest.DocTest]:
    """The examples of a name and of its methods, its own first."""
    names = {"hilstar": hilstar, "np": np}
    finder = doctest.DocTestFinder(exclude_empty=True)
    tests = finder.find(getattr(hilstar, name), name, module=False, globs=names)
    return sorted((test for test in tests if test.examples), key=lambda test: test.name)


@pytest.mark.parametrize("name", hilstar.__all__)
def test_each_public_name_has_an_example_that_runs(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bench.toml").write_text(BENCH)
    if name == "assess":
        write_run(tmp_path, plant(scan, SIZES, np.random.default_rng(11), seconds=60.0))
    tests = examples_of(name)
    assert name in {test.name for test in tests}
    names: dict[str, object] = {"hilstar": hilstar, "np": np}
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS)
    for test in tests:
        test.globs = names
        printed: list[str] = []
        result = runner.run(test, out=printed.append, clear_globs=False)
        assert result.failed == 0, "".join(printed)
