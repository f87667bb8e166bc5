"""Charts of a study's rows: a spec says x, y, series, scales and note, and one function draws it.

A row is a frozen dataclass, whose fields are the table's columns. A value of a row is the name of a
field, or a function of the row where the chart draws something else (a floor, another unit). Rows
of two types may share a chart: what was measured, and the law that foretells it.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.charts import INK, MUTED, SERIES, chart, label_ends, plain_ticks, write_csv
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


@dataclass(frozen=True, slots=True)
class SeriesLook:
    """The name, colour and marker of the lines of one series."""

    label: str
    colour: str
    marker: str = ""


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
class LevelLine:
    """A horizontal line over the whole panel, as a limit; `label` names it at the side."""

    at: float
    label: str
    colour: str = INK
    style: str = "--"
    width: float = LEVEL_WIDTH


@dataclass(frozen=True, slots=True)
class PanelSpec:
    """One panel: its lines and levels, its labels with units, its scales and ticks.

    `from_zero` begins the y axis at 0, `legend` has the keywords of a legend in the place of names
    at the side.
    """

    lines: tuple[LineSpec, ...]
    ylabel: str = ""
    xlabel: str = ""
    title: str = ""
    levels: tuple[LevelLine, ...] = ()
    scales: tuple[Scale, Scale] = ("linear", "linear")
    xlim: tuple[float, float] | None = None
    xticks: Sequence[float] = ()
    yticks: Sequence[float] = ()
    from_zero: bool = False
    names: bool = True
    legend: Mapping[str, Any] | None = None


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

    `colours` are SERIES's where none are given, `look` the keywords of every line.
    """

    x: FloatArray
    curves: Mapping[str, FloatArray]
    spec: PanelSpec
    colours: tuple[str, ...] = ()
    look: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class PairSpec:
    """Two values of each row on one line, as of a thing without and with something.

    `looks` are those of the two points, of which the first is an open circle where it is
    `open_first`.
    """

    first: str
    second: str
    looks: tuple[SeriesLook, SeriesLook]
    open_first: bool = False


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
    """The panels of a chart of rows, for what a ChartSpec does not have; the chart is written when
    the context ends.
    """
    down = len(spec.panels) // spec.columns
    note = load.note(spec.note)
    with chart(path, finding, down, spec.columns, note=note, **spec.layout) as grid:
        for axes, panel in zip(grid, spec.panels, strict=True):
            draw_panel(axes, panel, spec, rows)
        yield grid


def draw_panel(axes: "Axes", panel: PanelSpec, spec: ChartSpec, rows: Sequence[Any]) -> None:
    """Draw one panel of a chart of rows."""
    for key, look in spec.looks.items():
        series = [row for row in rows if spec.by(row) == key]
        for line in panel.lines:
            draw_line(axes, line, look, series)
    finish_panel(axes, panel)


def finish_panel(axes: "Axes", panel: PanelSpec) -> None:
    """Draw a panel's levels, and set its labels, scales, ticks and names."""
    for level in panel.levels:
        style: dict[str, Any] = {"color": level.colour, "ls": level.style, "lw": level.width}
        axes.axhline(level.at, label=level.label, **style)
    axes.set(xlabel=panel.xlabel, ylabel=panel.ylabel, title=panel.title)
    axes.set_xscale(panel.scales[0], **SCALE_KEYWORDS.get(panel.scales[0], {}))
    axes.set_yscale(panel.scales[1], **SCALE_KEYWORDS.get(panel.scales[1], {}))
    if panel.xlim is not None:
        axes.set_xlim(panel.xlim)
    if panel.from_zero:
        axes.set_ylim(bottom=0)
    if panel.xticks:
        plain_ticks(axes.xaxis, panel.xticks)
    if panel.yticks:
        plain_ticks(axes.yaxis, panel.yticks)
    if panel.legend is not None:
        axes.legend(**panel.legend)
    elif panel.names:
        label_ends(axes)


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
    for (name, values_y), colour in zip(panel.curves.items(), colours, strict=False):
        axes.plot(panel.x, values_y, color=colour, label=name, **panel.look)
    finish_panel(axes, panel.spec)


def columns_of(tables: Mapping[str, FloatArray]) -> list[list[float]]:
    """The rows of a table by its columns (n,)."""
    return np.column_stack(list(tables.values())).tolist()  # type: ignore[no-any-return]


def write_columns(path: Path, tables: Mapping[str, FloatArray]) -> None:
    """Write columns (n,) by their names as a table. Raises InputError where it cannot be
    written.
    """
    write_csv(path, list(tables), columns_of(tables))


def draw_line(axes: "Axes", line: LineSpec, look: SeriesLook, series: Sequence[Any]) -> None:
    """Draw what a line has of the rows of one series; nothing where it has none."""
    rows = [row for row in series if isinstance(row, line.of) and holds(line.where, row)]
    if not rows:
        return
    label = HIDDEN
    if line.named:
        if line.label is None:
            label = look.label
        else:
            label = line.label(rows[0])
    if line.marker is None:
        marker = look.marker
    else:
        marker = line.marker
    style: dict[str, Any] = {"ls": line.style, "color": look.colour, "label": label}
    axes.plot(values(rows, line.x), values(rows, line.y), marker=marker, **{**style, **line.look})


def holds(where: Where | None, row: Any) -> bool:
    """Whether a row is of those that are drawn."""
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
    """A field, and NaN, which is not drawn, from `below` on."""

    def value(row: Any) -> float:
        size = float(getattr(row, name))
        return size if size < below else np.nan

    return value


def draw_pairs(axes: "Axes", spec: PairSpec, rows: Sequence[Any]) -> None:
    """Draw the pairs of rows, the first row's place 0, on a logarithmic axis."""
    places = range(len(rows))
    first = values(rows, spec.first)
    second = values(rows, spec.second)
    for place, (low, high) in enumerate(zip(first, second, strict=True)):
        axes.plot([low, high], [place, place], color=MUTED, lw=1)
    first_look, second_look = spec.looks
    face: dict[str, Any] = {}
    if spec.open_first:
        face["mfc"] = "none"
    axes.plot(first, places, "o", color=first_look.colour, label=first_look.label, **face)
    axes.plot(second, places, "o", color=second_look.colour, label=second_look.label)
    axes.set_xscale("log")
    axes.grid(visible=False, axis="y")


def name_places(axes: "Axes", names: Sequence[str]) -> None:
    """The names of a panel's places, the first on top."""
    axes.set_yticks(range(len(names)), names)
    axes.invert_yaxis()
