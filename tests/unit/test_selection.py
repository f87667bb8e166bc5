"""What the bare command leaves out are tests that there are."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from tests.support.selection import (
    SLOW,
    TESTS,
    holds_nothing_for,
    is_bare,
    is_of_the_bare_command,
    is_slow,
    slow_functions,
)
from tests.support.slow_tests import KEPT_CPU_S, kept_cases


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


def test_of_the_bare_command_s_functions_no_cases_are_made_for_the_rest():
    file, _, slow = next(name for name in sorted(SLOW) if "tests/unit/" in name).partition("::")
    path = TESTS.parent / file
    rest = asking_for(rest=True)
    timed = SimpleNamespace(pytestmark=[SimpleNamespace(name="timing")])
    assert is_of_the_bare_command(rest, path, "test_another", None)
    assert not is_of_the_bare_command(rest, path, slow, None)
    assert not is_of_the_bare_command(rest, path, "helper", None)
    assert not is_of_the_bare_command(rest, path, "test_another", timed)
    for other in (asking_for(), asking_for(rest=True, all=True), asking_for(timing=True)):
        assert not is_of_the_bare_command(other, path, "test_another", None)
    for folder in ("screen", "e2e/browser", "study"):
        assert not is_of_the_bare_command(rest, TESTS / folder / "test_a.py", "test_another", None)


def test_a_slow_function_s_cases_that_stand_below_it_are_not_left_out():
    kept = slow_functions("a.py::one\n  [x-1.0]\n  [two words]\nb.py::other\n")
    assert kept == {"a.py::one": {"[x-1.0]", "[two words]"}, "b.py::other": set()}
    function, cases = next((name, cases) for name, cases in SLOW.items() if cases)
    assert is_slow(function)
    assert is_slow(f"{function}[no such case]")
    assert not any(is_slow(function + case) for case in cases)


def test_of_a_slow_function_the_longest_cases_that_fit_are_kept():
    cases = {"[a]": 0.5, "[b]": 0.15, "[c]": 0.1, "[d]": 0.04, "[e]": 0.02}
    assert KEPT_CPU_S == 0.2
    assert kept_cases(cases) == {"[b]", "[d]"}
    assert kept_cases(cases | {"[f]": 0.019}) == {"[b]", "[d]", "[f]"}  # a quick case always
    assert kept_cases({"": 0.9}) == set()


@pytest.mark.parametrize(
    ("more", "bare"),
    [({}, True), ({"lf": False, "failedfirst": False}, True), ({"lf": True}, False)],
    ids=["no cache", "nothing asked", "what failed"],
)
def test_a_command_is_bare_with_and_without_pytest_s_cache(more, bare):
    option = SimpleNamespace(keyword="", markexpr="", **more)
    config: Any = SimpleNamespace(option=option, args_source=pytest.Config.ArgsSource.TESTPATHS)
    assert is_bare(config) == bare
