"""What the bare command leaves out are tests that there are."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from tests.support.selection import SLOW, TESTS, holds_nothing_for


def test_each_slow_test_is_there():
    texts = {path: (TESTS.parent / path).read_text() for path in {each[0] for each in named()}}
    assert [each for each in named() if f"def {each[1]}(" not in texts[each[0]]] == []


def named() -> list[tuple[str, str]]:
    """File and function of each slow test."""
    return [(path, function) for path, _, function in (each.partition("::") for each in SLOW)]


def asking_for(**options: bool) -> Any:
    return SimpleNamespace(
        option=SimpleNamespace(**({"all": False, "rest": False, "timing": False} | options))
    )


def test_a_file_is_imported_for_the_tests_that_are_asked_for():
    quick, slow, screen, timing = (
        TESTS / name
        for name in (
            "unit/test_selection.py",
            sorted(SLOW)[0].partition("::")[0].removeprefix("tests/"),
            "screen/test_window.py",
            "timing/test_floods.py",
        )
    )
    files = (quick, slow, screen, timing)

    def imported(**options: bool) -> list[bool]:
        return [not holds_nothing_for(asking_for(**options), path) for path in files]

    assert imported() == imported(all=True) == [True] * 4
    assert imported(rest=True)[:3] == [False, True, True]
    assert imported(timing=True) == [False, False, False, True]
