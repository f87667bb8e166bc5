"""Charts of rows: what a spec says is what is drawn, for rows of one type and of two."""

from __future__ import annotations

import doctest
from dataclasses import dataclass

import numpy as np
import pytest

from hilstar.basics import charts
from hilstar.instruments.study import engine
from hilstar.instruments.study.engine import (
    HIDDEN,
    BarSpec,
    ChartSpec,
    CurvePanel,
    DotsSpec,
    LevelLine,
    LineSpec,
    PanelSpec,
    SeriesLook,
    at_least,
    draw_curves,
    draw_rows,
    finite,
    looks_of,
    row_panels,
    write_columns,
    write_rows,
)
from hilstar.instruments.study.sweep import Load
from tests.support.pictures import assert_drawn, table

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


@pytest.fixture
def figure(monkeypatch):
    """The figure that is saved last."""
    saved = []
    monkeypatch.setattr(charts, "save", lambda drawn, path: saved.append(drawn))
    return saved


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


def test_each_series_has_a_line_of_its_rows_in_the_order_of_looks(figure, tmp_path):
    draw_rows(tmp_path / "x", "A finding", spec_of(LineSpec("at", "error")), ROWS[:2])
    assert lines_of(figure[0]) == [
        ("first", charts.SERIES[0], "o", [[1.0, 2.0]]),
        ("second", charts.SERIES[1], "s", [[1.0, 0.0]]),
    ]
    assert figure[0].get_suptitle() == "A finding"
    assert figure[0].axes[0].get_ylabel() == "Error [px]"


def test_a_measured_point_and_its_law_are_told_apart_by_their_type(figure, tmp_path):
    law = LineSpec("at", "error", of=Law)
    dots = LineSpec("at", "error", "", marker="x", named=False, of=Planted)
    draw_rows(tmp_path / "x", "A finding", spec_of(law, dots), [*LAWS, *ROWS[:2]])
    drawn = [(label, marker, places[0][1]) for label, _, marker, places in lines_of(figure[0])]
    assert drawn == [
        ("first", "o", 2.5),
        (HIDDEN, "x", 2.0),
        ("second", "s", 0.5),
        (HIDDEN, "x", 0.0),
    ]


def test_floors_gaps_and_conditions_are_of_the_rows(figure, tmp_path):
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
    (first, second, limit) = lines_of(figure[0])
    assert first[0] == "way a" and first[3][0] == [1.0, 2.0] and np.isnan(first[3][1][1])
    assert second[3] == [[1.0, 1e-3]]
    assert limit[0] == "limit" and limit[3] == [[0.0, 1.0], [1.0, 1.0]]
    axes = figure[0].axes[0]
    assert axes.get_xscale() == axes.get_yscale() == "log"
    assert axes.get_xticks().tolist() == [1, 10]


def test_a_busy_machine_is_told_in_the_note(figure, tmp_path):
    spec = spec_of(LineSpec("at", "error"))
    for load in (Load(), BUSY):
        draw_rows(tmp_path / "x", "A finding", spec, ROWS[:2], load)
    idle, busy = (" ".join(drawn.get_supxlabel().split()) for drawn in figure)
    assert idle == "Of nothing."
    assert busy.startswith("Of nothing. A busy machine")


def test_curves_over_one_x_and_their_table(figure, tmp_path):
    x = np.array([1.0, 2.0])
    upper = CurvePanel(x, {"light": x, "dark": -x}, PanelSpec((), "light [1]"))
    lower = CurvePanel(x, {"twice": 2 * x}, PanelSpec((), "twice [1]", "x [px]"), (charts.RED,))
    draw_curves(tmp_path / "x", "A finding", (upper, lower), "Of nothing.")
    first, second = (axes.get_lines() for axes in figure[0].axes)
    assert [line.get_label() for line in first] == ["light", "dark"]
    assert second[0].get_color() == charts.RED
    write_columns(tmp_path / "x.csv", {"x_px": x, "twice": 2 * x})
    rows = table(tmp_path / "x.csv")
    assert [(float(row["x_px"]), float(row["twice"])) for row in rows] == [(1, 2), (2, 4)]


@dataclass(frozen=True)
class Sizes:
    """Figures that stand in a row as its own columns."""

    rms: float
    largest: float


@dataclass(frozen=True)
class Nested:
    """A row with a row in it, and a column whose name is a word of Python's."""

    class_: str
    sizes: Sizes
    count: int


def test_a_row_within_a_row_stands_as_its_own_columns(tmp_path):
    write_rows(tmp_path / "x.csv", [Nested("G", Sizes(0.5, 2.0), 7)])
    assert (tmp_path / "x.csv").read_text() == "class,rms,largest,count\nG,0.5,2.0,7\n"


def test_bars_stand_in_groups_with_a_bar_of_each_series(figure, tmp_path):
    bars = BarSpec(lambda row: f"{row.at:g}", "error", share=0.8, figures="%.1f")
    panel = PanelSpec(bars=bars, ylim=(0, 5), names=False)
    rows = [Planted(way, at, at + (way == "b")) for at in (1.0, 2.0) for way in ("a", "b")]
    spec = ChartSpec((panel,), lambda row: row.way, looks_of({"a": "first", "b": "second"}))
    draw_rows(tmp_path / "x", "A finding", spec, rows)
    axes = figure[0].axes[0]
    places = [bar.get_x() + bar.get_width() / 2 for bar in axes.patches]
    assert places == pytest.approx([-0.2, 0.8, 0.2, 1.2])
    assert [bar.get_height() for bar in axes.patches] == [1.0, 2.0, 2.0, 3.0]
    assert [text.get_text() for text in axes.texts] == ["1.0", "2.0", "2.0", "3.0"]
    assert [label.get_text() for label in axes.get_xticklabels()] == ["1", "2"]
    assert axes.get_ylim() == (0, 5)


def test_dots_of_a_row_stand_on_a_line_of_its_own_the_first_on_top(figure, tmp_path):
    dots = DotsSpec(
        (
            ("at", SeriesLook("before", charts.ORANGE, "s", is_open=True)),
            ("error", SeriesLook("after", charts.BLUE)),
        ),
        where=lambda row: row.error > 0,
        name=lambda row: row.way,
        note=lambda row: f"{row.error:g} mag",
    )
    spec = ChartSpec((PanelSpec(dots=dots, names=False),), lambda row: row.way, {})
    draw_rows(tmp_path / "x", "A finding", spec, [ROWS[0], *LAWS])
    axes = figure[0].axes[0]
    first, second, before, after = axes.get_lines()
    assert first.get_xydata().tolist() == [[1.0, 0.0], [2.5, 0.0]]
    assert second.get_xydata().tolist() == [[1.0, 1.0], [0.5, 1.0]]
    assert before.get_marker() == "s" and before.get_markerfacecolor() == "none"
    assert after.get_marker() == "o" and after.get_markerfacecolor() == charts.BLUE
    assert [label.get_text() for label in axes.get_yticklabels()] == ["a", "b"]
    assert axes.yaxis_inverted() and axes.get_xscale() == "log"
    assert [text.get_text() for text in axes.texts] == ["2.5 mag", "0.5 mag"]


def test_keys_are_in_the_legend_alone_and_places_are_vertical(figure, tmp_path):
    panel = PanelSpec(
        (LineSpec("at", "error", "", named=False),),
        keys=(SeriesLook("a key", charts.GREEN, "d"),),
        places=(LevelLine(3.0, "a limit"),),
        legend={},
    )
    looks = looks_of({"a": "first"})
    draw_rows(tmp_path / "x", "A finding", ChartSpec((panel,), lambda row: row.way, looks), LAWS)
    points, key, limit = figure[0].axes[0].get_lines()
    assert points.get_label() == HIDDEN and len(key.get_xydata()) == 0
    assert limit.get_xydata().tolist() == [[3.0, 0.0], [3.0, 1.0]]
    texts = figure[0].axes[0].get_legend().get_texts()
    assert [text.get_text() for text in texts] == ["a key", "a limit"]


def test_a_grid_that_is_not_full_has_no_axes_in_its_last_place(figure, tmp_path):
    panels = (PanelSpec((LineSpec("at", "error"),), names=False),) * 3
    spec = ChartSpec(panels, lambda row: row.way, looks_of({"a": "first"}), columns=2)
    with row_panels(tmp_path / "x", "A finding", spec, LAWS) as grid:
        assert len(grid) == 3
    assert [axes.axison for axes in figure[0].axes] == [True, True, True, False]


def test_curves_have_the_styles_that_are_given(figure, tmp_path):
    x = np.array([1.0, 2.0])
    panel = CurvePanel(x, {"solid": x, "dotted": -x}, PanelSpec(), styles=("-", ":"))
    draw_curves(tmp_path / "x", "A finding", (panel,))
    assert [line.get_linestyle() for line in figure[0].axes[0].get_lines()] == ["-", ":"]


def test_the_example_of_the_engine_draws_a_legible_chart_and_its_table(tmp_path):
    """tests/study/conftest.py looks at the chart as it is saved."""
    names = {**vars(engine), "folder": tmp_path}
    example = doctest.DocTestParser().get_doctest(engine.__doc__, names, "engine", None, None)
    printed: list[str] = []
    result = doctest.DocTestRunner().run(example, out=printed.append)
    assert result.attempted == 9 and result.failed == 0, "".join(printed)
    assert_drawn(tmp_path / "cost.png")
    assert [row["way"] for row in table(tmp_path / "cost.csv")] == ["round"] * 2 + ["exact"] * 2
