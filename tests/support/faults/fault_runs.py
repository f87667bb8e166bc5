"""The tests of one pytest session, run for one fault after another: collected once, each fault in a
process of its own that is forked from it. That takes 0.5 to 2 s a fault in place of a minute.

A fault of what runs when its module is imported needs a new process, in a copy of the checkout.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import multiprocessing
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path

import pytest
from _pytest.runner import runtestprotocol

from tests.support import selection
from tests.support.faults.code_swap import NotSwappable, swap

ROOT = Path(__file__).parent.parent.parent.parent
HANGS = "it does not end"
# Tests of one fault take a tenth of it when the machine is idle; those of one that never ends
# wait as long.
MAX_RUN_S = 240.0
# tests of one fault that fail for other reasons, before its outcome is "none found"
MAX_PASSED_OVER = 5
FAILED = re.compile(r"^(?:FAILED|ERROR) (.+?)(?: - .*)?$", re.MULTILINE)
NOTHING_FAILED = (0, 5)  # pytest's exit codes: all pass, there is nothing to run
FORK = multiprocessing.get_context("fork")
FAR = 2


@dataclass(frozen=True, slots=True)
class ChangedFile:
    """A file of the checkout, its text, and its text with a fault."""

    path: str
    text: str
    changed_text: str

    def plant(self) -> None:
        """Put the fault into the module that this process has imported, or imports now.

        NotSwappable as `swap`.
        """
        swap(importlib.import_module(dotted_name(self.path)), self.text, self.changed_text)


@dataclass(slots=True)
class Session:
    """The collected tests by their function, in the order of their files; `copy` is a folder for a
    copy of the checkout, made when a fault needs it.
    """

    items: dict[str, list[pytest.Item]]
    copy: Path
    passes: dict[str, bool] = field(default_factory=dict)

    def near(self, module: str) -> list[str]:
        """The functions of files that name a module, then those of files that name its room."""
        distances = {file: distance(ROOT / file, module) for file in self.files}
        functions = [
            function for function in self.items if distances[function.partition("::")[0]] < FAR
        ]
        return sorted(functions, key=lambda function: distances[function.partition("::")[0]])

    @property
    def files(self) -> set[str]:
        """The files of the tests."""
        return {function.partition("::")[0] for function in self.items}

    def test_that_finds(self, fault: ChangedFile, functions: Sequence[str]) -> str:
        """The first test of these functions that fails with a fault and passes without it, ""
        where none does; one that does not end is one that fails.
        """
        passed_over: set[str] = set()
        while len(passed_over) < MAX_PASSED_OVER:
            test = self.first_failure(fault, functions, passed_over)
            if not test.startswith("tests/") or self.passes_unchanged(test):
                return test
            print(f"{fault.path}: {test} does not count: it fails without it, too", flush=True)
            passed_over.add(test)
        return ""

    def passes_unchanged(self, test: str) -> bool:
        """Whether a test passes by itself, without a fault."""
        if test not in self.passes:
            function = self.items[test.partition("[")[0]]
            items = [item for item in function if item.nodeid == test]
            self.passes[test] = not apart(lambda: first_failing(items, set()))
        return self.passes[test]

    def first_failure(
        self, fault: ChangedFile, functions: Sequence[str], passed_over: set[str]
    ) -> str:
        """The first test of these functions that fails, but for those passed over."""
        items = [item for function in functions for item in self.items[function]]
        tests = [item.nodeid for item in items if item.nodeid not in passed_over]
        if not tests:
            return ""

        def failing_with_fault() -> str:
            gc.unfreeze()
            try:
                fault.plant()
            except (NotSwappable, ImportError):
                return self._first_in_copy(fault, tests)
            return first_failing(items, passed_over)

        test = apart(failing_with_fault)
        if test == HANGS:  # it may have been killed with the fault in the copy
            shutil.rmtree(self.copy)
            self.copy.mkdir()
        return test

    def _first_in_copy(self, fault: ChangedFile, tests: Sequence[str]) -> str:
        """The first that fails in a process that imports the module anew."""
        if not (self.copy / "hilstar").exists():
            copy_checkout(self.copy)
        names = self.copy / "chosen_tests.txt"
        names.write_text("\n".join(tests), encoding="utf-8")
        changed = self.copy / fault.path
        changed.write_text(fault.changed_text, encoding="utf-8")
        try:
            command = [sys.executable, "-m", "pytest", "-x", "-q", "-n0", f"@{names}"]
            environment = os.environ | {"PYTHONPATH": str(self.copy)}
            run = subprocess.run(
                command, cwd=self.copy, env=environment, capture_output=True, text=True, check=False
            )
        finally:
            changed.write_text(fault.text, encoding="utf-8")
        if run.returncode in NOTHING_FAILED:
            return ""
        failed = FAILED.search(run.stdout)
        # a fault with which pytest itself does not begin is found by each of its tests
        return tests[0] if failed is None else failed[1]


def dotted_name(path: str) -> str:
    """The module of a file of the package."""
    return path.removesuffix(".py").replace("/", ".").removesuffix(".__init__")


def distance(file: Path, module: str) -> int:
    """0 where a file names a module, 1 where it names its room, else FAR."""
    text = file.read_text(encoding="utf-8")
    room, _, name = module.rpartition(".")
    # as in `from hilstar.sky import air`, over one line or several
    imported = rf"from {re.escape(room)} import (?:\([^)]*|[^(\n]*)\b{re.escape(name)}\b"
    if re.search(rf"\b{re.escape(module)}\b", text) or re.search(imported, text):
        return 0
    return 1 if room in text else FAR


def first_failing(items: Sequence[pytest.Item], passed_over: set[str]) -> str:
    """The first test that fails in this process but for those passed over."""
    for item, following in zip(items, [*items[1:], None], strict=True):
        reports = runtestprotocol(item, log=False, nextitem=following)
        is_failed = any(report.failed for report in reports)
        if is_failed and item.nodeid not in passed_over:
            return item.nodeid
    return ""


def apart(run: Callable[[], str]) -> str:
    """What `run` gives in a forked process; HANGS where that does not end."""
    receiver, sender = FORK.Pipe(duplex=False)
    process = FORK.Process(target=_send, args=(run, sender))
    process.start()
    sender.close()
    try:
        if not receiver.poll(MAX_RUN_S):
            return HANGS
        return str(receiver.recv())
    except EOFError:
        return f"the process ends with {process.exitcode}"
    finally:
        # its children, too
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid or 0, signal.SIGKILL)
        process.join()


def _send(run: Callable[[], str], sender: Connection) -> None:
    os.setsid()
    silence = os.open(os.devnull, os.O_RDWR)
    os.dup2(silence, 1)
    os.dup2(silence, 2)
    sender.send(run())
    sender.close()
    os._exit(0)  # without what a session of pytest does at its end


def copy_checkout(folder: Path) -> None:
    """The tracked files as they are now, in `folder`."""
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, check=True, capture_output=True)
    archive = subprocess.run(
        ["tar", "-c", "-T", "-"], cwd=ROOT, check=True, capture_output=True, input=listed.stdout
    )
    subprocess.run(["tar", "-x", "-C", folder], input=archive.stdout, check=True)


@dataclass(slots=True)
class _Loop:
    """A plugin in place of pytest's loop: what it collected goes to `use`."""

    use: Callable[[Session], None]
    is_rest: bool

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        items: defaultdict[str, list[pytest.Item]] = defaultdict(list)
        for item in session.items:
            if bool(selection.reason_to_leave_out(item)) == self.is_rest:
                items[item.nodeid.partition("[")[0]].append(item)
        gc.collect()
        gc.freeze()  # a forked process shares what none collects
        with tempfile.TemporaryDirectory() as folder:
            self.use(Session(dict(items), Path(folder)))
        return True


@contextlib.contextmanager
def _in_checkout() -> Iterator[None]:
    before = Path.cwd()
    os.chdir(ROOT)
    try:
        yield
    finally:
        os.chdir(before)


def with_tests(use: Callable[[Session], None], *, is_rest: bool) -> None:
    """Collect README's tests, or with `is_rest` those that its command leaves out, and use them."""
    options = ["-q", "-n0", "-p", "no:cacheprovider"]
    if is_rest:
        options.append("tests")  # what a path asks for is all there
    with _in_checkout():
        pytest.main(options, plugins=[_Loop(use, is_rest)])
