"""The tables and charts of docs/beside.md, drawn from results/beside_*.csv."""

from __future__ import annotations

import pytest

from hilstar.basics import charts
from tests.support.benches import ROOT
from tests.support.beside.steps import COLUMNS, Beside, Step, write_beside
from tests.support.figures import assert_legible
from tests.support.tables import csv_rows

RECORDED = sorted((ROOT / "results").glob("beside_*.csv"))


def recorded_rows(path) -> tuple[Beside, str]:
    rows = csv_rows(path)
    steps = tuple(
        Step(row["subject"], row["unit"], row["step"], float(row["size"])) for row in rows
    )
    first = rows[0]
    return Beside(first["program"], first["version"], "a finding", steps), first["date"]


@pytest.mark.parametrize("path", RECORDED, ids=lambda path: path.stem)
def test_a_recorded_run_is_written_as_it_was_and_its_chart_is_legible(path, tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(charts, "save", lambda figure, path: drawn.append(figure))
    beside, date = recorded_rows(path)
    name = path.stem.removeprefix("beside_")
    write_beside(tmp_path, name, beside, date)
    assert (tmp_path / path.name).read_text() == path.read_text()
    assert_legible(drawn[0])
    assert (ROOT / "docs" / f"{path.stem}.svg").exists()


def test_each_program_of_the_issue_has_a_recorded_run():
    programs = {recorded_rows(path)[0].program for path in RECORDED}
    assert {
        "GalSim",
        "astrometry.net",
        "LOST",
        "Basilisk",
        "Pyxel",
        "SatSim",
        "Stellarium",
    } <= programs


def test_a_step_is_found_by_its_subject_and_first_words():
    beside = Beside(
        "p", "1", "f", (Step("s", "px", "as both come", 2.0), Step("t", "px", "x", 1.0))
    )
    assert beside.size("s", "as both") == 2.0
    with pytest.raises(KeyError, match="s: x"):
        beside.size("s", "x")
    assert COLUMNS[-1] == "size"
