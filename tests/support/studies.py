"""The contract of every study: its command ends well, its findings are lines, its tables have rows
without a gap in their head, and its charts are those that it is known for, none of them blank.

That a chart's title says a figure that is drawn, and that no text lies over another, is held as
each is saved (tests/study/conftest.py).
"""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from tests.support.commands import run_hilstar_here
from tests.support.pictures import assert_drawn
from tests.support.tables import csv_rows

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LIMIT_S = 3600  # minutes of work, on a machine whose other work takes most of it


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


def studied(
    directories: pytest.TempPathFactory,
    name: str,
    known_charts: Collection[str],
    words: str = "--quick",
) -> Studied:
    """Run `hilstar study NAME` and hold it to the contract; `known_charts` are the names of its own."""
    folder = directories.mktemp(name)
    line = f"study {name} {words} -o {folder} --json"
    result = run_hilstar_here(line, timeout=LIMIT_S)
    assert result.returncode == 0, result.stderr
    told = json.loads(result.stdout)
    assert (told["study"], told["directory"]) == (name, str(folder))
    assert any(told["findings"])  # a blank one parts their groups
    assert not any("\n" in line for line in told["findings"])
    drawn = {path.stem for path in folder.glob("*.png")}
    assert drawn == set(known_charts), drawn
    for path in folder.glob("*.png"):
        assert_drawn(path)
    tables = sorted(folder.glob("*.csv"))
    assert tables
    for path in tables:
        rows = csv_rows(path)
        assert rows, path
        assert all(rows[0]), path
        assert all(None not in row and None not in row.values() for row in rows), path
    return Studied(folder, told["findings"], told["right"])


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

    def lines(self, stem: str, panel: int) -> list[tuple[str, list[float], list[float]]]:
        """Label, x and y of each line of a chart's panel."""
        lines = []
        for line in self.charts[stem].axes[panel].get_lines():
            x, y = (np.asarray(values, dtype=float).tolist() for values in line.get_data())
            lines.append((str(line.get_label()), x, y))
        return lines
