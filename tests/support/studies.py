"""The contract of every study: its command ends well, its findings are lines, its tables have rows
without a gap in their head, and its charts are those that it is known for, none of them blank. One
that draws times names no winner where others worked meanwhile.

That a chart's title says a figure that is drawn, and that no text lies over another, is held as
each is saved (tests/study/conftest.py).
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from hilstar.basics import charts
from hilstar.cli import study as study_command
from hilstar.instruments.study import sweep
from hilstar.instruments.study.sweep import NOT_JUDGED, Load, OtherWork
from hilstar.instruments.study.trials import judged
from tests.support.commands import run_hilstar_here
from tests.support.pictures import assert_drawn
from tests.support.tables import csv_rows

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LIMIT_S = 3600  # minutes of work, on a machine whose other work takes most of it
IDLE, BUSY = Load(), Load(float(os.cpu_count() or 1))
TIME_LABEL = re.compile(r"\btime\b.*\[(ms|us|s)\]|\(\d+ us\)|, time$", re.IGNORECASE | re.DOTALL)
TIMES_IN_TITLE = re.compile(
    r"\d m?s\b(?! of latency)|\d us\b|times as (fast|long|SLOW)|of its time"
)
WINNERS = re.compile(r"times as (fast|long|SLOW)|less time")


@dataclass(frozen=True)
class Studied:
    """What a study wrote, its findings in their order, and whether all was right; None where that
    cannot be judged.
    """

    folder: Path
    findings: list[str]
    right: bool | None

    def rows(self, table: str) -> list[dict[str, str]]:
        """The rows of a table, by its name without an ending."""
        return csv_rows(self.folder / f"{table}.csv")


@dataclass(frozen=True)
class WholeStudy:
    """Runs a study and holds it to the contract; `known_charts` are the names of its own."""

    directories: pytest.TempPathFactory

    def __call__(self, name: str, known_charts: Collection[str], words: str = "--quick") -> Studied:
        """`hilstar study NAME`."""
        folder = self.directories.mktemp(name)
        line = f"study {name} {words} -o {folder} --json"
        result = run_hilstar_here(line, timeout=LIMIT_S)
        assert result.returncode == 0, result.stderr
        told = json.loads(result.stdout)
        assert (told["study"], told["directory"]) == (name, str(folder))
        found = Studied(folder, told["findings"], told["right"])
        assert_whole(found, known_charts)
        return found

    def reported(
        self, name: str, known_charts: Collection[str], measured: Any, part: Any = None
    ) -> Studied:
        """What a study of times reports of what it has measured, on an idle machine; on a busy one
        it declines, by all of that or a `part`.
        """
        study = module_of(name)
        folder = self.directories.mktemp(name)
        found = Studied(folder, *study.report(folder, with_load(measured, IDLE)))
        assert_whole(found, known_charts)
        assert found.right is True
        assert_declines(study, self.directories.mktemp(f"{name}_busy"), part or measured)
        return found


def assert_whole(found: Studied, known_charts: Collection[str]) -> None:
    """Fail unless findings, charts and tables are as those of every study."""
    assert any(found.findings)  # a blank one parts their groups
    assert not any("\n" in line for line in found.findings)
    drawn = {path.stem for path in found.folder.glob("*.png")}
    assert drawn == set(known_charts), drawn
    for path in found.folder.glob("*.png"):
        assert_drawn(path)
    tables = sorted(found.folder.glob("*.csv"))
    assert tables
    for path in tables:
        rows = csv_rows(path)
        assert rows, path
        assert all(rows[0]), path
        assert all(None not in row and None not in row.values() for row in rows), path


def module_of(name: str) -> ModuleType:
    """The module of a study that has its `run`."""
    room = ".run" if name in study_command.ROOMS else ""
    return import_module(f"hilstar.instruments.study.{name}{room}")


def with_load(measured: Any, load: Load) -> Any:
    """What a study of times has measured, beside this work of others."""
    if isinstance(measured, list):  # the steps of `tradeoff`, each with a load of its own
        return [judged(replace(step, load=load)) for step in measured]
    return replace(measured, load=load)


def assert_declines(study: ModuleType, folder: Path, measured: Any) -> None:
    """Fail unless a study whose times were taken on a busy machine names no winner."""
    from tests.support.figures import MAX_TITLE_LINES  # brings matplotlib

    with timed_figures() as figures:
        lines, right = study.report(folder, with_load(measured, BUSY))
    assert right is None
    assert lines[-1] == BUSY.caution
    assert not [line for line in lines if WINNERS.search(line)]
    assert figures, "no chart of times was seen"
    for figure in figures:
        assert len(figure.get_suptitle().splitlines()) <= MAX_TITLE_LINES
        title = " ".join(figure.get_suptitle().split())
        note = " ".join(figure.get_supxlabel().split())
        assert "busy machine" in note
        assert NOT_JUDGED in title or not TIMES_IN_TITLE.search(title), title


@contextmanager
def timed_figures() -> Iterator[Sequence[Figure]]:
    """The figures of times that are saved. They differ from those of an idle machine, which are
    drawn and looked at, by their titles and notes: none is laid out or drawn.
    """
    figures: list[Figure] = []

    def keep(figure: Figure, path: Path) -> None:
        if is_of_times(figure):
            figures.append(figure)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(charts, "finish", lambda figure: None)
        patch.setattr(charts, "save", keep)
        yield figures


def is_of_times(figure: Figure) -> bool:
    """Whether a label of a figure names a time."""
    return any(TIME_LABEL.search(words) for words in words_of(figure))


def words_of(figure: Figure) -> list[str]:
    """The labels of a figure's axes and lines."""
    words = []
    for axes in figure.axes:
        words += [axes.get_xlabel(), axes.get_ylabel(), axes.get_title(loc="left")]
        words += [text.get_text() for text in axes.texts]
        # which become names at the ends of lines once a chart is finished
        words += [str(line.get_label()) for line in axes.get_lines()]
    return words


@contextmanager
def times_are_watched() -> Iterator[None]:
    """Whoever times works counts what others do from before the first of them to after the last."""
    is_counted = False
    begin, spent = OtherWork.__init__, sweep.spent

    def begun(others: OtherWork) -> None:
        nonlocal is_counted
        is_counted = True
        begin(others)

    def ended(others: OtherWork) -> Load:
        nonlocal is_counted
        is_counted = False
        return Load()

    def timed(work: Callable[[], object]) -> sweep.Spent:
        assert is_counted
        return spent(work)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(OtherWork, "__init__", begun)
        patch.setattr(OtherWork, "load", ended)
        patch.setattr(sweep, "spent", timed)
        yield


@dataclass(frozen=True)
class SmallRun:
    """What a study's own function wrote and returned at a small size, in this process; its charts
    by their stems, which are not laid out, and of which no file is saved.
    """

    folder: Path
    told: Any
    charts: Mapping[str, Figure]

    def rows(self, table: str) -> list[dict[str, str]]:
        """The rows of a table, by its name without an ending."""
        return csv_rows(self.folder / f"{table}.csv")

    def title(self, stem: str) -> str:
        """The title of a chart, in one line."""
        title = self.charts[stem].get_suptitle()
        return " ".join(title.replace("\N{NO-BREAK SPACE}", " ").split())

    def note(self, stem: str) -> str:
        """The note below a chart, in one line."""
        return " ".join(self.charts[stem].get_supxlabel().split())

    def lines(self, stem: str, panel: int) -> list[tuple[str, list[float], list[float]]]:
        """Label, x and y of each line of a chart's panel."""
        lines = []
        for line in self.charts[stem].axes[panel].get_lines():
            x, y = (np.asarray(values, dtype=float).tolist() for values in line.get_data())
            lines.append((str(line.get_label()), x, y))
        return lines

    def levels(self, stem: str, panel: int) -> dict[str, float]:
        """Where each line across a chart's whole panel stands, by its label."""
        across = {}
        for label, x, y in self.lines(stem, panel):
            if x == [0.0, 1.0] and y[0] == y[-1]:
                across[label] = y[0]
        return across

    def places(self, stem: str, panel: int) -> list[float]:
        """Where the lines from the bottom to the top of a chart's panel stand."""
        return [x[0] for _, x, y in self.lines(stem, panel) if y == [0.0, 1.0] and x[0] == x[-1]]
