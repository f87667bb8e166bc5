"""Which tests the bare command `pytest` runs, and what it says of the others.

Laws. The bare command holds each room's claims in three minutes of two idle cores. It leaves out
what needs more than README installs for it (an X server, a browser), what claims a time, and what
takes longest, and counts these by reason; of a function that takes long only as it has many cases
it runs some. Tests that are asked for by a path, `-k` or `-m` are all run, and so are all by
`--all`. What `--all` adds is `--rest`, beside each other, and `--timing`,
one at a time.
"""

from __future__ import annotations

import contextlib
import importlib
from collections import Counter
from functools import cache
from pathlib import Path

import pytest

TESTS = Path(__file__).parent.parent
TIMING_REASON = "claim a time, and run one at a time"
SLOW_REASON = "take longest (tests/slow.txt)"
REASONS_BY_FOLDER = {
    "timing": TIMING_REASON,
    "screen": "need an X server",
    "browser": "need a browser",
}
# fixtures of tests/study that run a study by its command, or one that takes seconds however small it
# is: a test asks for one of them, or for a fixture that does
STUDY_RUNS = frozenset({"whole_study", "long_run"})
STUDY_REASON = "run a whole study, or one that takes seconds"
CASE_INDENT = "  "


def slow_functions(text: str) -> dict[str, frozenset[str]]:
    """The functions that tests/slow.txt names, and of each the cases, as `[4.0]`, that the bare
    command runs all the same: they stand below it, indented.
    """
    kept: dict[str, set[str]] = {}
    function = ""
    for line in text.splitlines():
        if line.startswith(CASE_INDENT):
            kept[function].add(line.removeprefix(CASE_INDENT))
        else:
            function = line
            kept[function] = set()
    return {function: frozenset(cases) for function, cases in kept.items()}


# Functions that take over a stated time of CPU, all their cases together; tests/support/slow_tests.py
# measures them and writes the file.
SLOW = slow_functions((TESTS / "slow.txt").read_text(encoding="utf-8"))
SLOW_FILES = frozenset(function.partition("::")[0] for function in SLOW)
TIMING_MARK = "mark.timing"
LEFT_OUT = pytest.StashKey[dict[str, int]]()


def add_options(parser: pytest.Parser) -> None:
    """`--all`, `--rest` and `--timing`."""
    group = parser.getgroup("hilstar")
    group.addoption("--all", action="store_true", help="every test, also those that take long")
    group.addoption("--rest", action="store_true", help="what --all adds, without --timing's")
    group.addoption("--timing", action="store_true", help="what claims a time: use it with -n0")


def is_slow(nodeid: str) -> bool:
    """Whether a test is left out as it takes long."""
    function, bracket, case = nodeid.partition("[")
    return function in SLOW and bracket + case not in SLOW[function]


@cache
def folders_of(path: Path) -> tuple[str, ...]:
    """The folders of a file below `tests`, which has them once for hundreds of tests."""
    return path.relative_to(TESTS).parts[:-1]


def reason_to_leave_out(item: pytest.Item) -> str | None:
    """Why the bare command does not run a test; None if it does."""
    if item.get_closest_marker("timing") is not None:
        return TIMING_REASON
    for folder in folders_of(item.path):
        if folder in REASONS_BY_FOLDER:
            return REASONS_BY_FOLDER[folder]
    if STUDY_RUNS.intersection(getattr(item, "fixturenames", ())):
        return STUDY_REASON
    if is_slow(item.nodeid):
        return SLOW_REASON
    return None


def is_bare(config: pytest.Config) -> bool:
    """Whether the command names no tests of its own."""
    worker_input = getattr(config, "workerinput", None)
    if worker_input is not None:
        # a worker is given every path by name, also of a command that names none
        return bool(worker_input["is_bare"])
    option = config.option
    if config.args_source is pytest.Config.ArgsSource.ARGS:
        return False
    # without pytest's cache (-p no:cacheprovider) there are no options for what failed
    has_failed_ones = getattr(option, "lf", False) or getattr(option, "failedfirst", False)
    return not (option.keyword or option.markexpr or has_failed_ones)


def imports_every_file(config: pytest.Config) -> bool:
    """Whether the command collects all test files."""
    option = config.option
    return is_bare(config) and not (option.rest or option.timing)


def import_own_part_first(worker: int, workers: int) -> None:
    """Import every test file of the bare command, `worker`'s share of all before the others'."""
    paths = sorted(TESTS.rglob("test_*.py"))
    begin = len(paths) * worker // workers
    for path in paths[begin:] + paths[:begin]:
        module = ".".join(path.relative_to(TESTS.parent).with_suffix("").parts)
        # the collection tells what cannot be imported, or skips itself
        with contextlib.suppress(Exception, pytest.skip.Exception):
            importlib.import_module(module)


def holds_nothing_for(config: pytest.Config, path: Path) -> bool:
    """Whether `--rest` or `--timing` takes no test of a file, so that it need not be imported."""
    option = config.option
    if option.all or not (option.rest or option.timing) or not path.name.startswith("test_"):
        return False
    if option.timing:
        return "timing" not in path.relative_to(TESTS).parts and TIMING_MARK not in path.read_text()
    folders = folders_of(path)
    is_slow = path.relative_to(TESTS.parent).as_posix() in SLOW_FILES
    return not is_slow and "study" not in folders and not REASONS_BY_FOLDER.keys() & set(folders)


def is_of_the_bare_command(config: pytest.Config, path: Path, name: str, test: object) -> bool:
    """Whether `--rest` takes no case of a file's function: its cases need not be made, which are
    four fifths of all.
    """
    if not config.option.rest or config.option.all or not name.startswith("test_"):
        return False
    if "study" in folders_of(path) or REASONS_BY_FOLDER.keys() & set(folders_of(path)):
        return False
    if any(mark.name == "timing" for mark in getattr(test, "pytestmark", ())):
        return False
    return f"{path.relative_to(TESTS.parent).as_posix()}::{name}" not in SLOW


def select(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Take out of `items`, in place, what this command leaves out, and count it by reason."""
    option = config.option
    asks_for_a_part = option.rest or option.timing
    if option.all or not (asks_for_a_part or is_bare(config)):
        return
    chosen: list[pytest.Item] = []
    left_out: list[pytest.Item] = []
    reasons: Counter[str] = Counter()
    for item in items:
        reason = reason_to_leave_out(item)
        if option.timing:
            is_chosen = reason == TIMING_REASON
        elif option.rest:
            is_chosen = reason not in (None, TIMING_REASON)
        else:
            is_chosen = reason is None
        if is_chosen:
            chosen.append(item)
            continue
        left_out.append(item)
        if reason is not None:
            reasons[reason] += 1
    items[:] = chosen
    config.hook.pytest_deselected(items=left_out)
    config.stash[LEFT_OUT] = dict(reasons)


def hand_on(session: pytest.Session) -> None:
    """A worker's counts go to the process that reports: workers alone collect."""
    output = getattr(session.config, "workeroutput", None)
    if output is not None:
        output["left_out"] = session.config.stash.get(LEFT_OUT, {})


def report(reporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    """A line for each reason for which tests were left out, and for which a test skipped itself."""
    left_out = config.stash.get(LEFT_OUT, {})
    skipped = Counter(
        reason_to_skip(skip) for skip in reporter.stats.get("skipped", []) if skip.longrepr
    )
    for title, reasons in (
        ("left out; pytest --all runs these too", left_out),
        ("skipped, by reason", skipped),
    ):
        if reasons:
            reporter.section(title)
        for reason, count in sorted(reasons.items(), key=lambda row: (-row[1], row[0])):
            reporter.write_line(f"{count:6d} {reason}")


def reason_to_skip(skip: pytest.TestReport) -> str:
    """What a skipped test said."""
    _, _, said = skip.longrepr  # type: ignore[misc]
    return str(said).removeprefix("Skipped: ")
