"""The engine of studies: rows become a table and charts.

A study is three things: a row (a frozen dataclass, whose fields are the table's columns), a
function that measures rows, and specs of charts (x, y, series, scales, note). `write_rows` writes
the table, `draw_rows` a chart. A value of a row is the name of a field, or a function of the row
where the chart draws something else (a floor, another unit). Rows of two types may share a chart:
what was measured, and the law that foretells it. A panel has lines and points (`LineSpec`), upright
bars (`BarSpec`), or some values of each row on a line of its own (`DotsSpec`). A study in short:

    >>> @dataclass(frozen=True)
    ... class Cost:
    ...     way: str
    ...     stars: int
    ...     frame_ms: float
    >>> rows = [Cost("round", 100, 0.4), Cost("round", 1000, 2.1)]
    >>> rows += [Cost("exact", 100, 0.9), Cost("exact", 1000, 5.2)]
    >>> line = LineSpec("stars", "frame_ms")
    >>> panel = PanelSpec((line,), "time of a frame [ms]", "stars", scales=("log", "log"))
    >>> looks = looks_of({"round": "rounded codes", "exact": "exact codes"}, "os")
    >>> spec = ChartSpec((panel,), lambda row: row.way, looks, "Medians.")
    >>> write_rows(folder / "cost.csv", rows)
    >>> draw_rows(folder / "cost", "Exact codes take 5.2 ms with 1000 stars", spec, rows)

Methods with an error and a time are `Trials` (trials.py); a method that fails is a `FailureCase`
(stability) or a `StressLimit` (limits.py); curves over one x are `CurvePanel`s, without rows.
"""

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.charts import (
    INK,
    MUTED,
    SERIES,
    SMALL_PT,
    chart,
    label_ends,
    plain_ticks,
    write_csv,
)
from hilstar.instruments.study.sweep import Load

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Value = str | Callable[[Any], float]
Where = Callable[[Any], bool]
Scale = Literal["linear", "log", "symlog"]
HIDDEN = "_"  # matplotlib names no line whose label begins so
LEVEL_WIDTH = 1.2
# The half width of a symlog axis's linear part.
SCALE_KEYWORDS: dict[str, dict[str, Any]] = {"symlog": {"linthresh": 1.0}}
IDLE = Load()
BESIDE: Any = {"textcoords": "offset points", "va": "center", "fontsize": SMALL_PT}
NOTE_OFFSET_PT = (6, 0)


@dataclass(frozen=True, slots=True)
class ChartFinding:
    """A chart, by the stem of its files, and what it says."""

    figure: str
    text: str


@dataclass(frozen=True, slots=True)
class SeriesLook:
    """The name, colour and marker of the lines or bars of one series; an open marker has no fill.

    `more` are further keywords of what is drawn.
    """

    label: str
    colour: str
    marker: str = ""
    is_open: bool = False
    more: Mapping[str, Any] = field(default_factory=dict)

    @property
    def style(self) -> dict[str, Any]:
        """The keywords of its points."""
        style: dict[str, Any] = {"color": self.colour, "label": self.label, **self.more}
        if self.is_open:
            style["mfc"] = "none"
        return style


@dataclass(frozen=True, slots=True)
class LineSpec:
    """`y` against `x` of the rows `where` it holds, and of type `of`; a line for each series.

    `marker` replaces the series's. Only a `named` line stands at the side, by `label` of its first
    row where that is given.
    """

    x: Value
    y: Value
    style: str = "-"
    marker: str | None = None
    named: bool = True
    label: Callable[[Any], str] | None = None
    where: Where | None = None
    of: type = object
    look: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class BarSpec:
    """Upright bars: a group for each value of `group`, in it a bar of each series.

    The bars of a group take a `share` of its room. `figures` is the format of a figure over each
    bar; where it is empty there is none.
    """

    group: Callable[[Any], str]
    value: Value
    share: float = 0.84
    figures: str = ""
    named: bool = True
    look: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class DotsSpec:
    """Some values of each row as points on a line of its own, on a logarithmic axis.

    `points` are fields and their looks; a thin line joins the first to the second. `name` names the
    lines beside the axis, the first on top, and `note` stands beside each first point.
    """

    points: tuple[tuple[str, SeriesLook], ...]
    where: Where | None = None
    name: Callable[[Any], str] | None = None
    note: Callable[[Any], str] | None = None


@dataclass(frozen=True, slots=True)
class LevelLine:
    """A line over the whole panel, as a limit; `label` names it at the side.

    It is horizontal among a panel's `levels`, vertical among its `places`.
    """

    at: float
    label: str
    colour: str = INK
    style: str = "--"
    width: float = LEVEL_WIDTH

    @property
    def keywords(self) -> dict[str, Any]:
        """Matplotlib's keywords of the line."""
        return {"color": self.colour, "ls": self.style, "lw": self.width, "label": self.label}


@dataclass(frozen=True, slots=True)
class PanelSpec:
    """One panel: what it draws, its levels and places, its labels with units, its scales and ticks.

    `from_zero` begins the y axis at 0. `legend` has the keywords of a legend in the place of names
    at the side, and `keys` are looks that the legend alone shows.
    """

    lines: tuple[LineSpec, ...] = ()
    ylabel: str = ""
    xlabel: str = ""
    title: str = ""
    levels: tuple[LevelLine, ...] = ()
    scales: tuple[Scale, Scale] = ("linear", "linear")
    xlim: tuple[float, float] | None = None
    ylim: tuple[float, float] | None = None
    xticks: Sequence[float] = ()
    yticks: Sequence[float] = ()
    from_zero: bool = False
    names: bool = True
    legend: Mapping[str, Any] | None = None
    bars: BarSpec | None = None
    dots: DotsSpec | None = None
    places: tuple[LevelLine, ...] = ()
    keys: tuple[SeriesLook, ...] = ()
    margins: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True)
class ChartSpec:
    """The panels of a chart; `by` is the series of a row, and `looks` has each series's look, in
    the order in which they are drawn.

    `layout` has the keywords of `basics.charts.panels_of`.
    """

    panels: tuple[PanelSpec, ...]
    by: Callable[[Any], Any]
    looks: Mapping[Any, SeriesLook]
    note: str = ""
    columns: int = 1
    layout: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class CurvePanel:
    """Curves (n,) by their names against one x (n,); `spec` has the labels, scales and ticks.

    `colours` are SERIES's and `styles` solid where none are given; `look` has the keywords of every
    line.
    """

    x: FloatArray
    curves: Mapping[str, FloatArray]
    spec: PanelSpec
    colours: tuple[str, ...] = ()
    look: Mapping[str, Any] = field(default_factory=dict)
    styles: tuple[str, ...] = ()


# Tables


def cells_of(row: Any) -> dict[str, Any]:
    """The cells of a row by column: its fields, `class_` as `class`.

    A field that is itself a row stands as its own columns.
    """
    cells: dict[str, Any] = {}
    for column in fields(row):
        value = getattr(row, column.name)
        if is_dataclass(value):
            cells |= cells_of(value)
        else:
            cells[column.name.removesuffix("_")] = value
    return cells


def write_rows(path: Path, rows: Sequence[Any]) -> None:
    """Write rows of one type, at least one, as a table. Raises InputError where it cannot be
    written.
    """
    table = [cells_of(row) for row in rows]
    write_csv(path, list(table[0]), [list(cells.values()) for cells in table])


def write_columns(path: Path, tables: Mapping[str, FloatArray]) -> None:
    """Write columns (n,) by their names as a table. Raises InputError where it cannot be
    written.
    """
    write_csv(path, list(tables), np.column_stack(list(tables.values())).tolist())


def write_findings(directory: Path, findings: Sequence[ChartFinding]) -> None:
    """Write what charts say as findings.csv. Raises InputError where it cannot be written."""
    table = [(finding.figure, finding.text) for finding in findings]
    write_csv(directory / "findings.csv", ("figure", "finding"), table)


# Charts of rows


def looks_of(labels: Mapping[Any, str], markers: str = "") -> dict[Any, SeriesLook]:
    """The looks of series by their labels, in the order of SERIES's colours and of `markers`."""
    looks = {}
    for place, (key, label) in enumerate(labels.items()):
        marker = markers[place] if markers else ""
        looks[key] = SeriesLook(label, SERIES[place], marker)
    return looks


def draw_rows(
    path: Path, finding: str, spec: ChartSpec, rows: Sequence[Any], load: Load = IDLE
) -> None:
    """Draw a chart of rows, titled by its finding. Raises InputError where it cannot be written.

    On a busy machine `load` adds its caution to the note.
    """
    with row_panels(path, finding, spec, rows, load):
        pass


@contextmanager
def row_panels(
    path: Path, finding: str, spec: ChartSpec, rows: Sequence[Any], load: Load = IDLE
) -> "Iterator[list[Axes]]":
    """Draw a chart of rows, and yield its panels for what a ChartSpec cannot say. The chart is
    written when the context ends.
    """
    down = math.ceil(len(spec.panels) / spec.columns)
    note = load.note(spec.note)
    with chart(path, finding, down, spec.columns, note=note, **spec.layout) as grid:
        for axes, panel in zip(grid, spec.panels, strict=False):
            draw_panel(axes, panel, spec, rows)
        for axes in grid[len(spec.panels) :]:
            axes.set_axis_off()
        yield grid[: len(spec.panels)]


def draw_panel(axes: "Axes", panel: PanelSpec, spec: ChartSpec, rows: Sequence[Any]) -> None:
    """Draw one panel of a chart of rows."""
    for key, look in spec.looks.items():
        series = [row for row in rows if spec.by(row) == key]
        for line in panel.lines:
            draw_line(axes, line, look, series)
    if panel.bars is not None:
        draw_bars(axes, panel.bars, spec, rows)
    if panel.dots is not None:
        draw_dots(axes, panel.dots, rows)
    finish_panel(axes, panel)


def draw_line(axes: "Axes", line: LineSpec, look: SeriesLook, series: Sequence[Any]) -> None:
    """Draw one line of the rows of one series; nothing where no row belongs to it."""
    rows = [row for row in series if isinstance(row, line.of) and holds(line.where, row)]
    if not rows:
        return
    marker = line.marker
    if marker is None:
        marker = look.marker
    label = HIDDEN
    if line.named:
        label = look.label
    if line.named and line.label is not None:
        label = line.label(rows[0])
    style = {**look.style, "ls": line.style, "label": label, **line.look}
    axes.plot(values(rows, line.x), values(rows, line.y), marker=marker, **style)


def draw_bars(axes: "Axes", bars: BarSpec, spec: ChartSpec, rows: Sequence[Any]) -> None:
    """Draw a group of bars for each group of rows, a bar for each series of a group."""
    groups = list(dict.fromkeys(bars.group(row) for row in rows))
    middles = np.arange(len(groups))
    width = bars.share / len(spec.looks)
    first = -(len(spec.looks) - 1) / 2 * width
    for place, (key, look) in enumerate(spec.looks.items()):
        series = [row for row in rows if spec.by(row) == key]
        style = {"width": width, **look.style, **bars.look}
        if not bars.named:
            style["label"] = HIDDEN
        drawn = axes.bar(middles + first + place * width, values(series, bars.value), **style)
        if bars.figures:
            axes.bar_label(drawn, fmt=bars.figures, padding=2, fontsize=SMALL_PT)
    axes.set_xticks(middles, groups)
    axes.grid(visible=False, axis="x")


def draw_dots(axes: "Axes", dots: DotsSpec, rows: Sequence[Any]) -> None:
    """Draw some values of each row on a line of its own, the first row's at 0."""
    drawn = [row for row in rows if holds(dots.where, row)]
    places = range(len(drawn))
    first, second = (values(drawn, name) for name, _ in dots.points[:2])
    for place, (low, high) in enumerate(zip(first, second, strict=True)):
        axes.plot([low, high], [place, place], color=MUTED, lw=1)
    for name, look in dots.points:
        axes.plot(values(drawn, name), places, look.marker or "o", **look.style)
    axes.set_xscale("log")
    axes.grid(visible=False, axis="y")
    if dots.note is not None:
        for place, row in enumerate(drawn):
            axes.annotate(dots.note(row), (first[place], place), NOTE_OFFSET_PT, **BESIDE)
    if dots.name is not None:
        axes.set_yticks(places, [dots.name(row) for row in drawn])
        axes.invert_yaxis()


def finish_panel(axes: "Axes", panel: PanelSpec) -> None:
    """Draw a panel's levels and places, and set its labels, scales, ticks and names."""
    for key in panel.keys:
        axes.plot([], [], key.marker or "o", **key.style)
    for level in panel.levels:
        axes.axhline(level.at, **level.keywords)
    for place in panel.places:
        axes.axvline(place.at, **place.keywords)
    axes.set(xlabel=panel.xlabel, ylabel=panel.ylabel, title=panel.title)
    set_scales(axes, panel)
    if panel.legend is not None:
        axes.legend(**panel.legend)
    elif panel.names:
        label_ends(axes)


def set_scales(axes: "Axes", panel: PanelSpec) -> None:
    """Set the scales, limits and ticks that a panel states."""
    x_scale, y_scale = panel.scales
    # What a panel draws may have set a scale of its own.
    if x_scale != "linear":
        axes.set_xscale(x_scale, **SCALE_KEYWORDS.get(x_scale, {}))
    if y_scale != "linear":
        axes.set_yscale(y_scale, **SCALE_KEYWORDS.get(y_scale, {}))
    if panel.margins is not None:
        axes.margins(*panel.margins)
    if panel.xlim is not None:
        axes.set_xlim(panel.xlim)
    if panel.ylim is not None:
        axes.set_ylim(panel.ylim)
    if panel.from_zero:
        axes.set_ylim(bottom=0)
    if panel.xticks:
        plain_ticks(axes.xaxis, panel.xticks)
    if panel.yticks:
        plain_ticks(axes.yaxis, panel.yticks)


# Values of rows


def holds(where: Where | None, row: Any) -> bool:
    """Whether a row is drawn."""
    return where is None or where(row)


def values(rows: Iterable[Any], value: Value) -> list[float]:
    """A value of each row."""
    if callable(value):
        return [value(row) for row in rows]
    return [getattr(row, value) for row in rows]


def at_least(name: str, floor: float) -> Callable[[Any], float]:
    """The size of a field, and `floor` where it is smaller: a logarithmic axis has no 0."""
    return lambda row: max(abs(getattr(row, name)), floor)


def finite(name: str, below: float = np.inf) -> Callable[[Any], float]:
    """A field; NaN, which is not drawn, where it is `below` or more."""

    def value(row: Any) -> float:
        size = float(getattr(row, name))
        return size if size < below else np.nan

    return value


# Charts of curves


def draw_curves(path: Path, finding: str, panels: Sequence[CurvePanel], note: str = "") -> None:
    """Draw curves whose x is the same for all of a panel, one panel above the other. Raises
    InputError where it cannot be written.
    """
    share_x = all(panel.x is panels[0].x for panel in panels)
    with chart(path, finding, len(panels), note=note, share_x=share_x) as grid:
        for axes, panel in zip(grid, panels, strict=True):
            draw_curve_panel(axes, panel)


def draw_curve_panel(axes: "Axes", panel: CurvePanel) -> None:
    """Draw the curves of one panel."""
    colours = panel.colours or SERIES
    styles = panel.styles or itertools.repeat("-")
    for (name, values_y), colour, style in zip(panel.curves.items(), colours, styles, strict=False):
        axes.plot(panel.x, values_y, ls=style, color=colour, label=name, **panel.look)
    finish_panel(axes, panel.spec)
