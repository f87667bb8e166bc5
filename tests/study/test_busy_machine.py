"""Beside other work no study that draws times names a winner: each of them is run on a machine
that is planted as busy.
"""

from __future__ import annotations

import ast
import os
import re
from importlib import import_module
from pathlib import Path
from typing import get_args

import pytest

from hilstar.basics import charts
from hilstar.cli import study as study_command
from hilstar.instruments.study import bodies, colour, economy, sweep
from hilstar.instruments.study.sweep import NOT_JUDGED, Load, OtherWork
from hilstar.instruments.study.tradeoff import run as tradeoff

BUSY = Load(float(os.cpu_count() or 1))
STUDIES = get_args(study_command.Study)
# What takes times: calls of these names.
TIMERS = {"in_turn", "medians_ms", "measured", "spent", "perf_counter", "perf_counter_ns"}
# `chain` is run by a way of its own, whose times tests/study/test_study_chain.py plants.
CHAIN = "chain"
TIME_LABEL = re.compile(r"\btime\b.*\[(ms|us|s)\]|\(\d+ us\)|, time$", re.IGNORECASE | re.DOTALL)
TIMES_IN_TITLE = re.compile(
    r"\d m?s\b(?! of latency)|\d us\b|times as (fast|long|SLOW)|of its time"
)
WINNERS = re.compile(r"times as (fast|long|SLOW)|less time")


def called_names(path: Path) -> set[str]:
    """The names that a module calls, with or without the module they are of."""
    calls = [
        node.func for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call)
    ]
    return {getattr(call, "attr", getattr(call, "id", "")) for call in calls}


def files_of(study: str) -> list[Path]:
    """The modules of a study."""
    folder = Path(sweep.__file__).parent
    room = folder / study
    if room.is_dir():
        return sorted(room.glob("*.py"))
    return [folder / f"{study}.py"]


def test_every_study_that_takes_times_is_known_as_one():
    timing = {
        study for study in STUDIES if any(TIMERS & called_names(path) for path in files_of(study))
    }
    assert timing == study_command.TIMED | {CHAIN}


@pytest.fixture
def fewest_rounds(monkeypatch):
    """One round, and few subjects: no claim here is of a time or an error."""
    for module, name, value in (
        (tradeoff, "QUICK_BUDGET_S", 0.0),
        (sweep, "MIN_ROUNDS", 1),
        (economy, "QUICK_ROUNDS", 1),
        # and one scene on one panel: the study's own test has all of them
        (economy, "SCENES", economy.SCENES[2:3]),
        (economy, "BITS", (12,)),
        (bodies, "QUICK_ROUNDS", 1),
        (colour, "QUICK_ROUNDS", 1),
        (colour, "SENSORS", {"Bayer, wide dyes": colour.SENSORS["Bayer, wide dyes"]}),
    ):
        monkeypatch.setattr(module, name, value)


@pytest.fixture
def timed_figures(monkeypatch):
    """The figures of times that are saved. Any other is that of an idle machine, as the study's
    own test has it: it is neither laid out nor drawn.
    """
    figures = []
    finish, save = charts.finish, charts.save

    def finish_timed(figure):
        if is_of_times(figure):
            finish(figure)

    def keep(figure, path):
        if is_of_times(figure):
            figures.append(figure)
            save(figure, path)

    monkeypatch.setattr(charts, "finish", finish_timed)
    monkeypatch.setattr(charts, "save", keep)
    return figures


def is_of_times(figure) -> bool:
    """Whether a label of a figure names a time."""
    return any(TIME_LABEL.search(words) for words in words_of(figure))


def words_of(figure) -> list[str]:
    """The labels of a figure's axes and lines."""
    words = []
    for axes in figure.axes:
        words += [axes.get_xlabel(), axes.get_ylabel(), axes.get_title(loc="left")]
        words += [text.get_text() for text in axes.texts]
        # which become names at the ends of lines once a chart is finished
        words += [line.get_label() for line in axes.get_lines()]
    return words


@pytest.mark.usefixtures("whole_study")
@pytest.mark.parametrize("study", sorted(study_command.TIMED))
def test_a_study_of_times_declines_on_a_busy_machine(
    study, tmp_path, monkeypatch, fewest_rounds, timed_figures
):
    monkeypatch.setattr(OtherWork, "load", lambda self: BUSY)
    lines, right = study_command.study_lines(study, tmp_path, quick=True)
    assert right is None
    assert lines[-1] == BUSY.caution
    assert not [line for line in lines if WINNERS.search(line)]
    assert timed_figures, "no chart of times was seen"
    for figure in timed_figures:
        title = " ".join(figure.get_suptitle().split())
        note = " ".join(figure.get_supxlabel().split())
        assert "busy machine" in note
        assert NOT_JUDGED in title or not TIMES_IN_TITLE.search(title), title


def test_an_idle_machine_names_its_winners():
    load = Load()
    assert load.title("a is 2 times as fast") == "a is 2 times as fast"
    assert load.note("Medians.") == "Medians."
    assert load.judged(["a line"]) == (["a line"], True)


def test_a_study_of_times_says_what_it_found_through_load():
    for study in study_command.TIMED:
        run = import_module(
            f"hilstar.instruments.study.{study}{'.run' if study in study_command.ROOMS else ''}"
        ).run
        assert run.__annotations__["return"] in ("Judged", sweep.Judged)
