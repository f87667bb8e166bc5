"""Which studies draw times, and what they say through their load. That each of them declines on a
busy machine is part of its contract (tests/support/studies.py).
"""

from __future__ import annotations

import ast
from pathlib import Path
from typing import get_args

from hilstar.cli import study as study_command
from hilstar.instruments.study import sweep
from hilstar.instruments.study.sweep import Load
from tests.support.studies import module_of

STUDIES = get_args(study_command.Study)
# What takes times: calls of these names.
TIMERS = {"in_turn", "medians_ms", "measured", "spent", "perf_counter", "perf_counter_ns"}
# `chain` is run by a way of its own, whose times tests/study/test_study_chain.py plants.
CHAIN = "chain"


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


def test_an_idle_machine_names_its_winners():
    load = Load()
    assert load.title("a is 2 times as fast") == "a is 2 times as fast"
    assert load.note("Medians.") == "Medians."
    assert load.judged(["a line"]) == (["a line"], True)


def test_a_study_of_times_says_what_it_found_through_load():
    for study in study_command.TIMED:
        run = module_of(study).run
        assert run.__annotations__["return"] in ("Judged", sweep.Judged)
