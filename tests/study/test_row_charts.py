"""Charts of rows: what a spec says is what is drawn, for rows of one type and of two."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hilstar.basics import charts
from hilstar.instruments.study.engine import (
    HIDDEN,
    ChartSpec,
    CurvePanel,
    LevelLine,
    LineSpec,
    PanelSpec,
    at_least,
    draw_curves,
    draw_rows,
    finite,
    looks_of,
    write_columns,
)
from hilstar.instruments.study.sweep import Load
from tests.support.tables import csv_rows

BUSY = Load(1e3)


@dataclass(frozen=True)
class Planted:
    """A row that was measured."""

    way: str
    at: float
    error: float


@dataclass(frozen=True)
class Law:
    """The same as a law foretells it."""

    way: str
    at: float
    error: float


ROWS = [Planted("b", 1.0, 0.0), Planted("a", 1.0, 2.0), Planted("a", 10.0, np.inf)]
LAWS = [Law("a", 1.0, 2.5), Law("b", 1.0, 0.5)]


def spec_of(*lines: LineSpec, **panel: object) -> ChartSpec:
    panels = (PanelSpec(lines, "error [px]", "age [ms]", **panel),)
    looks = looks_of({"a": "first", "b": "second"}, "os")
    return ChartSpec(panels, lambda row: row.way, looks, "Of nothing.")


def lines_of(figure) -> list[tuple[str, str, str, list[list[float]]]]:
    """Label, colour, marker and places of each line of the first panel."""
    return [
        (line.get_label(), line.get_color(), line.get_marker(), line.get_xydata().tolist())
        for line in figure.axes[0].get_lines()
    ]


def test_each_series_has_a_line_of_its_rows_in_the_order_of_looks(figures, tmp_path):
    draw_rows(tmp_path / "x", "A finding", spec_of(LineSpec("at", "error")), ROWS[:2])
    assert lines_of(figures[0]) == [
        ("first", charts.SERIES[0], "o", [[1.0, 2.0]]),
        ("second", charts.SERIES[1], "s", [[1.0, 0.0]]),
    ]
    assert figures[0].get_suptitle() == "A finding"
    assert figures[0].axes[0].get_ylabel() == "Error [px]"


def test_a_measured_point_and_its_law_are_told_apart_by_their_type(figures, tmp_path):
    law = LineSpec("at", "error", of=Law)
    dots = LineSpec("at", "error", "", marker="x", named=False, of=Planted)
    draw_rows(tmp_path / "x", "A finding", spec_of(law, dots), [*LAWS, *ROWS[:2]])
    drawn = [(label, marker, places[0][1]) for label, _, marker, places in lines_of(figures[0])]
    assert drawn == [
        ("first", "o", 2.5),
        (HIDDEN, "x", 2.0),
        ("second", "s", 0.5),
        (HIDDEN, "x", 0.0),
    ]


def test_floors_gaps_and_conditions_are_of_the_rows(figures, tmp_path):
    spec = spec_of(
        LineSpec("at", at_least("error", 1e-3), where=lambda row: row.way == "b"),
        LineSpec(
            "at",
            finite("error"),
            label=lambda row: f"way {row.way}",
            where=lambda row: row.way == "a",
        ),
        levels=(LevelLine(1.0, "limit"),),
        scales=("log", "log"),
        xticks=(1, 10),
    )
    draw_rows(tmp_path / "x", "A finding", spec, ROWS)
    (first, second, limit) = lines_of(figures[0])
    assert first[0] == "way a" and first[3][0] == [1.0, 2.0] and np.isnan(first[3][1][1])
    assert second[3] == [[1.0, 1e-3]]
    assert limit[0] == "limit" and limit[3] == [[0.0, 1.0], [1.0, 1.0]]
    axes = figures[0].axes[0]
    assert axes.get_xscale() == axes.get_yscale() == "log"
    assert axes.get_xticks().tolist() == [1, 10]


def test_a_busy_machine_is_told_in_the_note(figures, tmp_path):
    spec = spec_of(LineSpec("at", "error"))
    for load in (Load(), BUSY):
        draw_rows(tmp_path / "x", "A finding", spec, ROWS[:2], load)
    idle, busy = (" ".join(drawn.get_supxlabel().split()) for drawn in figures)
    assert idle == "Of nothing."
    assert busy.startswith("Of nothing. A busy machine")


def test_curves_over_one_x_and_their_table(figures, tmp_path):
    x = np.array([1.0, 2.0])
    upper = CurvePanel(x, {"light": x, "dark": -x}, PanelSpec((), "light [1]"))
    lower = CurvePanel(x, {"twice": 2 * x}, PanelSpec((), "twice [1]", "x [px]"), (charts.RED,))
    draw_curves(tmp_path / "x", "A finding", (upper, lower), "Of nothing.")
    first, second = (axes.get_lines() for axes in figures[0].axes)
    assert [line.get_label() for line in first] == ["light", "dark"]
    assert second[0].get_color() == charts.RED
    write_columns(tmp_path / "x.csv", {"x_px": x, "twice": 2 * x})
    rows = csv_rows(tmp_path / "x.csv")
    assert [(float(row["x_px"]), float(row["twice"])) for row in rows] == [(1, 2), (2, 4)]
