"""What the tests share: markers by folder, bench files, and benches that fail on a GL error."""

from __future__ import annotations

import gc
import os
import signal
import sys
from collections import Counter
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

# A worker fills its core: threads of BLAS that wait for another make small products slow. Before
# NumPy is loaded.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Hundreds of commands are started: each that may not keep its compiled modules compiles all of
# hilstar, over a second of CPU.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# Hypothesis would load trio for its plugin, 0.3 s in each worker; no test is a coroutine.
os.environ.setdefault("HYPOTHESIS_NO_PLUGINS", "1")

# until what is collected is there: a fifth of collecting 6000 tests was the collector's rounds
gc.disable()

import numpy as np
import pytest
from xdist.workermanage import WorkerController

import hilstar
from hilstar.instruments.study.sweep import OtherWork
from tests.support import leftovers, selection
from tests.support.benches import SMALL_BENCH
from tests.support.undrawn import charts_left_out

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# A shell ignores SIGINT for what it runs with `&`, and what ignores it hands that on: a test's
# Ctrl-C would reach nobody.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

leftovers.adopt_orphans()


def pytest_xdist_auto_num_workers() -> int:
    """One more worker than cores: half of the long tests wait for packets, frames and signals to
    come by the clock.
    """
    return (os.cpu_count() or 1) + 1


MARKERS = {"study": "study", "gpu": "gpu", "screen": "screen", "e2e": "e2e", "examples": "e2e"}
FILES = pytest.StashKey[int]()
FILES_A_FREEZE = 15


def pytest_addoption(parser: pytest.Parser) -> None:
    selection.add_options(parser)


@pytest.hookimpl(tryfirst=True)
def pytest_collection(session: pytest.Session) -> None:
    """In a fresh checkout pytest compiles every test file, 11 s of CPU. Each worker begins with a
    part of its own: workers that went through them in step would each compile them all.
    """
    worker_input = getattr(session.config, "workerinput", None)
    if worker_input is not None and selection.imports_every_file(session.config):
        selection.import_own_part_first(
            int(worker_input["workerid"].removeprefix("gw")), worker_input["workercount"]
        )


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    return selection.holds_nothing_for(config, collection_path) or None


def pytest_pycollect_makeitem(
    collector: pytest.Module, name: str, obj: object
) -> list[pytest.Item] | None:
    if selection.is_of_the_bare_command(collector.config, collector.path, name, obj):
        return []
    return None


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark what lies in a folder, and leave out what the command does not ask for."""
    for item in items:
        folder = selection.folders_of(item.path)[0]
        if folder in MARKERS:
            item.add_marker(MARKERS[folder])
        if folder == "timing":
            item.add_marker("timing")
        if selection.is_slow(item.nodeid):
            item.add_marker("slow")
    selection.select(config, items)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None, object, object]:
    """Beside a claim of time stands what else the machine did meanwhile."""
    if item.get_closest_marker("timing") is None:
        return (yield)
    other_work = OtherWork()
    try:
        return (yield)
    finally:
        item.user_properties.append(("other_cores", other_work.cores()))


def pytest_sessionfinish(session: pytest.Session) -> None:
    selection.hand_on(session)


@pytest.hookimpl(optionalhook=True)
def pytest_configure_node(node: WorkerController) -> None:
    node.workerinput["is_bare"] = selection.is_bare(node.config)


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: WorkerController) -> None:
    """Every worker has collected the same: one's counts are all."""
    output = getattr(node, "workeroutput", {})
    node.config.stash[selection.LEFT_OUT] = output.get("left_out", {})


def pytest_collection_finish() -> None:
    """The garbage collector passes over what collecting 11 000 tests has made: each of its rounds
    would take 0.15 s. One before it takes 0.6 s: without it, sockets of a session that has ended
    are told as unclosed.
    """
    gc.collect()
    gc.freeze()
    gc.enable()


@pytest.hookimpl(trylast=True)
def pytest_runtest_teardown(item: pytest.Item, nextitem: pytest.Item | None) -> None:
    """The collector passes over what tests have loaded, too, from time to time: each paced run
    begins with a round of it, which took 0.25 s for all that was loaded by then.
    """
    if nextitem is None or nextitem.path == item.path:
        return
    files = item.config.stash.get(FILES, 0) + 1
    item.config.stash[FILES] = files
    if files % FILES_A_FREEZE == 0:
        gc.collect()
        gc.freeze()


def pytest_terminal_summary(
    terminalreporter: pytest.TerminalReporter, config: pytest.Config
) -> None:
    """What was left out; with --durations, the seconds of each folder too: where a suite's time
    is.
    """
    selection.report(terminalreporter, config)
    report_other_work(terminalreporter)
    if config.getoption("durations") is None:
        return
    seconds: Counter[str] = Counter()
    for reports in terminalreporter.stats.values():
        for report in reports:
            if isinstance(report, pytest.TestReport):
                seconds["/".join(report.nodeid.split("/")[1:3]).partition("::")[0]] += (
                    report.duration
                )
    terminalreporter.section("seconds by folder, summed over workers")
    for folder, duration in seconds.most_common(20):
        terminalreporter.write_line(f"{duration:8.1f} s  {folder}")


def report_other_work(reporter: pytest.TerminalReporter) -> None:
    """For each test that claims a time: how long it took, and the cores that others had."""
    rows: list[tuple[str, float, float]] = []
    for outcome in ("passed", "failed"):
        for report in reporter.stats.get(outcome, []):
            cores = dict(report.user_properties).get("other_cores")
            if report.when == "call" and cores is not None:
                rows.append((report.nodeid, report.duration, cores))
    if rows:
        reporter.section(f"claims of time; cores that other work took of {os.cpu_count()}")
    for nodeid, duration_s, cores in rows:
        reporter.write_line(f"{duration_s:8.1f} s {cores:5.1f} cores  {nodeid}")


@pytest.fixture(scope="session", autouse=True)
def nothing_is_left_behind() -> Iterator[None]:
    """Whatever a test did, none of hilstar's commands runs on when the tests are over; the last
    one fails where one did.
    """
    yield
    left = leftovers.end_hilstar_leftovers()
    assert not left, f"left behind by some test, and killed now: {left}"


@pytest.fixture
def rng() -> np.random.Generator:
    """The same numbers in every test."""
    return np.random.default_rng(20260101)


@pytest.fixture
def without_charts() -> Iterator[None]:
    """Charts are neither laid out nor drawn: for tests that look at none. A fixture of a module
    uses `charts_left_out`.
    """
    with charts_left_out():
        yield


@pytest.fixture
def figures(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """The figures that are saved, of which no file is written."""
    from hilstar.basics import charts

    saved: list[Figure] = []
    monkeypatch.setattr(charts, "save", lambda drawn, path: saved.append(drawn))
    return saved


@pytest.fixture
def small_bench_file(tmp_path: Path) -> Path:
    """A file of its own with the small bench."""
    path = tmp_path / "bench.toml"
    path.write_text(SMALL_BENCH)
    return path


@pytest.fixture
def bench_with(tmp_path: Path) -> Iterator[Callable[[str], hilstar.Bench]]:
    """Benches made of the small one and more TOML; each must end without a GL error."""
    opened: list[hilstar.Bench] = []

    def make(more: str = "") -> hilstar.Bench:
        path = tmp_path / f"bench{len(opened)}.toml"
        path.write_text(SMALL_BENCH + more)
        bench = hilstar.load(path)
        assert bench.renderer.gl_error() == "GL_NO_ERROR"
        opened.append(bench)
        return bench

    yield make
    for bench in opened:
        assert bench.renderer.gl_error() == "GL_NO_ERROR"
        bench.close()
