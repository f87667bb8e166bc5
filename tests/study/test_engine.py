"""The engine of studies: what a spec says is what is drawn, of rows of one type and of two, and the
example of its docstring.
"""

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
from tests.support.pictures import assert_drawn
from tests.support.tables import csv_rows


@dataclass(frozen=True)
class WayError:
    """A row."""

    way: str
    at: float
    error: float


DARK = WayError("b", 1.0, 0.0)
ROWS = [WayError("a", 1.0, 2.5), WayError("b", 1.0, 0.5)]


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


@dataclass(frozen=True)
class Law:
    """The same as a law foretells it."""

    way: str
    at: float
    error: float


MEASURED = [WayError("b", 1.0, 0.0), WayError("a", 1.0, 2.0), WayError("a", 10.0, np.inf)]
LAWS = [Law("a", 1.0, 2.5), Law("b", 1.0, 0.5)]
BUSY = Load(1e3)


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
    draw_rows(tmp_path / "x", "A finding", spec_of(LineSpec("at", "error")), MEASURED[:2])
    assert lines_of(figures[0]) == [
        ("first", charts.SERIES[0], "o", [[1.0, 2.0]]),
        ("second", charts.SERIES[1], "s", [[1.0, 0.0]]),
    ]
    assert figures[0].get_suptitle() == "A finding"
    assert figures[0].axes[0].get_ylabel() == "Error [px]"


def test_a_measured_point_and_its_law_are_told_apart_by_their_type(figures, tmp_path):
    law = LineSpec("at", "error", of=Law)
    dots = LineSpec("at", "error", "", marker="x", named=False, of=WayError)
    draw_rows(tmp_path / "x", "A finding", spec_of(law, dots), [*LAWS, *MEASURED[:2]])
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
    draw_rows(tmp_path / "x", "A finding", spec, MEASURED)
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
        draw_rows(tmp_path / "x", "A finding", spec, MEASURED[:2], load)
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


def test_a_row_within_a_row_stands_as_its_own_columns(tmp_path):
    write_rows(tmp_path / "x.csv", [Nested("G", Sizes(0.5, 2.0), 7)])
    assert (tmp_path / "x.csv").read_text() == "class,rms,largest,count\nG,0.5,2.0,7\n"


def test_bars_stand_in_groups_with_a_bar_of_each_series(figures, tmp_path):
    bars = BarSpec(lambda row: f"{row.at:g}", "error", share=0.8, figures="%.1f")
    panel = PanelSpec(bars=bars, ylim=(0, 5), names=False)
    rows = [WayError(way, at, at + (way == "b")) for at in (1.0, 2.0) for way in ("a", "b")]
    spec = ChartSpec((panel,), lambda row: row.way, looks_of({"a": "first", "b": "second"}))
    draw_rows(tmp_path / "x", "A finding", spec, rows)
    axes = figures[0].axes[0]
    places = [bar.get_x() + bar.get_width() / 2 for bar in axes.patches]
    assert places == pytest.approx([-0.2, 0.8, 0.2, 1.2])
    assert [bar.get_height() for bar in axes.patches] == [1.0, 2.0, 2.0, 3.0]
    assert [text.get_text() for text in axes.texts] == ["1.0", "2.0", "2.0", "3.0"]
    assert [label.get_text() for label in axes.get_xticklabels()] == ["1", "2"]
    assert axes.get_ylim() == (0, 5)


def test_dots_of_a_row_stand_on_a_line_of_its_own_the_first_on_top(figures, tmp_path):
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
    draw_rows(tmp_path / "x", "A finding", spec, [DARK, *ROWS])
    axes = figures[0].axes[0]
    first, second, before, after = axes.get_lines()
    assert first.get_xydata().tolist() == [[1.0, 0.0], [2.5, 0.0]]
    assert second.get_xydata().tolist() == [[1.0, 1.0], [0.5, 1.0]]
    assert before.get_marker() == "s" and before.get_markerfacecolor() == "none"
    assert after.get_marker() == "o" and after.get_markerfacecolor() == charts.BLUE
    assert [label.get_text() for label in axes.get_yticklabels()] == ["a", "b"]
    assert axes.yaxis_inverted() and axes.get_xscale() == "log"
    assert [text.get_text() for text in axes.texts] == ["2.5 mag", "0.5 mag"]
    # beside each first point
    assert [text.xy for text in axes.texts] == [(1.0, 0), (1.0, 1)]


def test_keys_are_in_the_legend_alone_and_places_are_vertical(figures, tmp_path):
    panel = PanelSpec(
        (LineSpec("at", "error", "", marker="", named=False, label=lambda row: row.way),),
        keys=(SeriesLook("a key", charts.GREEN, "d"),),
        places=(LevelLine(3.0, "a limit"),),
        legend={},
    )
    looks = looks_of({"a": "first"}, "o")
    draw_rows(tmp_path / "x", "A finding", ChartSpec((panel,), lambda row: row.way, looks), ROWS)
    points, key, limit = figures[0].axes[0].get_lines()
    assert points.get_label() == HIDDEN and len(key.get_xydata()) == 0
    # a line's own marker, though it is none, replaces that of its series
    assert (points.get_marker(), key.get_marker()) == ("", "d")
    assert limit.get_xydata().tolist() == [[3.0, 0.0], [3.0, 1.0]]
    texts = figures[0].axes[0].get_legend().get_texts()
    assert [text.get_text() for text in texts] == ["a key", "a limit"]


def test_a_grid_that_is_not_full_has_no_axes_in_its_last_place(figures, tmp_path):
    panels = (PanelSpec((LineSpec("at", "error"),), names=False),) * 3
    spec = ChartSpec(panels, lambda row: row.way, looks_of({"a": "first"}), columns=2)
    with row_panels(tmp_path / "x", "A finding", spec, ROWS) as grid:
        assert len(grid) == 3
    assert [axes.axison for axes in figures[0].axes] == [True, True, True, False]


def test_curves_have_the_styles_that_are_given(figures, tmp_path):
    x = np.array([1.0, 2.0])
    panel = CurvePanel(x, {"solid": x, "dotted": -x}, PanelSpec(), styles=("-", ":"))
    draw_curves(tmp_path / "x", "A finding", (panel,))
    assert [line.get_linestyle() for line in figures[0].axes[0].get_lines()] == ["-", ":"]


def test_a_panel_s_limits_margins_and_scales_are_its_own_axes(figures, tmp_path):
    line = (LineSpec("at", "error", named=False),)
    panels = (
        PanelSpec(line, xlim=(0.5, 7.0), ylim=(-3.0, 4.0)),
        PanelSpec(line, from_zero=True, margins=(0.5, 0.25)),
        PanelSpec(line, scales=("symlog", "log")),
    )
    looks = looks_of({"a": "first", "b": "second"})
    layout = {"share_x": False}
    spec = ChartSpec(panels, lambda row: row.way, looks, layout=layout)
    rows = [WayError("a", 1.0, 2.0), WayError("a", 3.0, 6.0)]
    draw_rows(tmp_path / "x", "A finding", spec, rows)
    limited, margined, scaled = figures[0].axes
    assert (limited.get_xlim(), limited.get_ylim()) == ((0.5, 7.0), (-3.0, 4.0))
    # half of 2 beyond either end, and a quarter of 4 above
    assert margined.get_xlim() == pytest.approx((0.0, 4.0))
    assert margined.get_ylim() == pytest.approx((0.0, 7.0))
    assert (scaled.get_xscale(), scaled.get_yscale()) == ("symlog", "log")
    assert scaled.xaxis.get_transform().linthresh == 1.0


def test_curves_share_an_axis_where_they_have_one_x(figures, tmp_path):
    x = np.array([1.0, 2.0])
    for second_x, is_shared in ((x, True), (10 * x, False)):
        first = CurvePanel(x, {"first": x}, PanelSpec(names=False))
        second = CurvePanel(second_x, {"second": x}, PanelSpec(names=False))
        draw_curves(tmp_path / "x", "A finding", (first, second))
        upper, lower = figures[-1].axes
        assert (upper.get_xlim() == lower.get_xlim()) is is_shared


def test_a_size_is_drawn_at_its_floor_where_it_is_smaller_whatever_its_sign():
    sized = at_least("error", 0.1)
    sizes = [sized(WayError("a", 1.0, error)) for error in (-3.0, -0.05, 0.0, 0.2)]
    assert sizes == [3.0, 0.1, 0.1, 0.2]
    below = finite("error", 2.0)
    drawn = [below(WayError("a", 1.0, error)) for error in (1.9, 2.0, -7.0)]
    assert drawn[::2] == [1.9, -7.0] and np.isnan(drawn[1])


def test_the_example_of_the_engine_draws_a_legible_chart_and_its_table(tmp_path):
    """tests/study/conftest.py looks at the chart as it is saved."""
    names = {**vars(engine), "folder": tmp_path}
    example = doctest.DocTestParser().get_doctest(engine.__doc__, names, "engine", None, None)
    printed: list[str] = []
    result = doctest.DocTestRunner().run(example, out=printed.append)
    assert result.attempted == 9 and result.failed == 0, "".join(printed)
    assert_drawn(tmp_path / "cost.png")
    assert [row["way"] for row in csv_rows(tmp_path / "cost.csv")] == ["round"] * 2 + ["exact"] * 2
