"""Charts and their tables: one style of figure, whose title is its finding, for light and dark
pages, and the CSV behind it.

A figure is as wide as a page shows it, so that its points are the page's points. Its SVG has the
colours of both themes.
"""

import csv
import io
import itertools
import math
import re
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal
from weakref import WeakKeyDictionary

import numpy as np

from hilstar.basics.files import as_text, whole_file, write_whole

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure
    from matplotlib.text import Annotation

SideNames = Sequence[tuple[str, tuple[float, float], str]]  # name, place in the data, colour
Share = Literal["row", "col"]

WIDTH_INCH = 7.6  # 730 CSS pixels: a column of text
PANEL_INCH, MARGIN_INCH = 2.6, 1.1  # height of each row of panels, and of title and labels
# Fewer ticks fit into a smaller panel, whose labels make it smaller: it settles in two or three.
LAYOUT_ROUNDS = 4
PNG_DPI = 150
TITLE_PT, TEXT_PT, SMALL_PT = 11.5, 10, 9
TITLE_COLUMNS, NOTE_COLUMNS = 80, 105
ENDINGS = (".png", ".svg")
# from a curve's name to its end, where they are apart
ARROW = {"arrowstyle": "-", "alpha": 0.5, "lw": 0.8, "shrinkB": 3, "relpos": (0, 0.5)}

# The colours of a chart, and of each its colour on a dark page.
INK, MUTED, GRID, PAPER = "#1f2328", "#5c6570", "#d8dde3", "#ffffff"
BLUE, ORANGE, GREEN, PURPLE, TEAL, RED = (
    "#0b62a4",
    "#c2500b",
    "#1a7f37",
    "#7b3fa0",
    "#0f7b8a",
    "#c0182b",
)
SERIES = (BLUE, ORANGE, GREEN, PURPLE, TEAL, RED)
DARK = {
    INK: "#e6e8eb",
    MUTED: "#a3acb8",
    GRID: "#3b414d",
    PAPER: "#1e2129",  # background of the documentation's dark pages
    BLUE: "#6cb6ff",
    ORANGE: "#ff9e5e",
    GREEN: "#5fd17e",
    PURPLE: "#c99bf0",
    TEAL: "#56cfe0",
    RED: "#ff7b7b",
}
KEY = re.compile(r"\w+(?:_|\.)\w")
# by figure, while it is drawn
_SIDE_NAMES: WeakKeyDictionary[Any, list[tuple[Any, SideNames]]] = WeakKeyDictionary()
STYLE: Any = {
    "font.size": TEXT_PT,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": MUTED,
    "axes.facecolor": PAPER,
    "axes.grid": True,
    "axes.formatter.useoffset": False,
    "axes.axisbelow": True,
    "axes.labelsize": SMALL_PT + 0.5,
    "axes.titlesize": TEXT_PT,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "figure.facecolor": PAPER,
    "grid.color": GRID,
    "grid.linewidth": 0.7,
    "hatch.color": MUTED,
    "legend.fontsize": SMALL_PT,
    "legend.frameon": False,
    "lines.linewidth": 1.8,
    "lines.markersize": 5,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "xtick.labelsize": SMALL_PT,
    "ytick.labelsize": SMALL_PT,
}


def write_csv(path: Path, columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """A table with a header. Raises InputError where it cannot be written."""
    with whole_file(path) as whole, as_text(whole) as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(rows)


def write_records(path: Path, records: Sequence[Any]) -> None:
    """A table of frozen dataclasses of one class, a column for each field. Raises InputError
    where it cannot be written.
    """
    columns = [field.name for field in fields(records[0])]
    rows = []
    for record in records:
        rows.append([getattr(record, name) for name in columns])
    write_csv(path, columns, rows)


@contextmanager
def chart(
    path: Path, finding: str, panels: int = 1, columns: int = 1, **layout: Any
) -> "Iterator[list[Axes]]":
    """Panels titled by their finding, laid out as `panels_of` says, and written when they are
    drawn.

    `path` without an ending gives both NAME.png and NAME.svg. Raises InputError where a file cannot
    be written.
    """
    with panels_of(finding, panels, columns, **layout) as axes:
        yield axes
    save(axes[0].figure, path)  # type: ignore[arg-type]


@contextmanager
def panels_of(
    finding: str,
    rows: int = 1,
    columns: int = 1,
    *,
    note: str = "",
    share_x: bool | Share = True,
    share_y: bool | Share = False,
    heights: Sequence[float] | None = None,
    height_inch: float | None = None,
) -> "Iterator[list[Axes]]":
    """Axes to draw on, row by row, of a figure titled by its finding; `note` says below, in
    small type, what it holds for.
    """
    # Not pyplot: it would change the backend of a program that imports this.
    from cycler import cycler
    from matplotlib.figure import Figure

    with _own_settings({**STYLE, "axes.prop_cycle": cycler(color=SERIES)}):
        if height_inch is None:
            high = MARGIN_INCH + PANEL_INCH * rows
        else:
            high = height_inch
        figure = Figure(figsize=(WIDTH_INCH, high), layout="constrained")
        figure.get_layout_engine().set(h_pad=0.07)  # type: ignore[call-arg,union-attr]
        grid = figure.subplots(
            rows, columns, sharex=share_x, sharey=share_y, squeeze=False, height_ratios=heights
        )
        finding = finding.replace(" +- ", " \N{PLUS-MINUS SIGN} ")
        figure.suptitle(title_lines(capital(finding)), x=0.01, ha="left", fontsize=TITLE_PT)
        if note:
            figure.supxlabel(
                title_lines(note, NOTE_COLUMNS), x=0.01, ha="left", fontsize=SMALL_PT, color=MUTED
            )
        yield list(grid.flat)
        finish(figure)


@contextmanager
def _own_settings(settings: Mapping[str, Any]) -> Iterator[None]:
    """Matplotlib's defaults and these settings.

    What a matplotlibrc or another library in this process sets is not taken: `figure.autolayout`,
    which Basilisk sets, ends a figure with a colour bar in an error.
    """
    from matplotlib import rc_context, rcParamsDefault

    # to set the backend would load one
    defaults = {name: rcParamsDefault[name] for name in rcParamsDefault if name != "backend"}
    with rc_context({**defaults, **settings}):
        yield


def finish(figure: "Figure") -> None:
    """Make labels, ticks and side names uniform, and lay the figure out until they want no other
    room beside their panels.
    """
    from matplotlib.ticker import LogLocator

    panels = figure.axes
    side_names = _SIDE_NAMES.pop(figure, [])
    for axes in panels:
        axes.set_title(capital(axes.get_title(loc="left")))
        # Matplotlib fits ticks into an axis by the style of now, unless it has its own size: a
        # figure that is written outside the style would have others than it was laid out with.
        axes.tick_params(labelsize=SMALL_PT)
    every: list[Any] = [axis for axes in panels for axis in (axes.xaxis, axes.yaxis)]
    for axis in every:
        axis.set_label_text(capital(axis.get_label_text()))
    log_axes = [axis for axis in every if isinstance(axis.get_major_locator(), LogLocator)]
    engine = figure.get_layout_engine()
    texts = list["Annotation"]()

    def place() -> tuple[list[object], ...]:
        """Ticks and names at the panels' present size: what of them takes room beside the
        panels.
        """
        for axis in log_axes:
            box = axis.axes.bbox
            room = box.width / 45 if axis.axis_name == "x" else box.height / 25
            log_ticks(axis, room)
        for text in texts:
            text.remove()
        texts[:] = [text for axes, named in side_names for text in _name_at_side(axes, named)]
        return [tuple(axis.get_ticklocs()) for axis in every], [text.xyann[0] for text in texts]

    room = place()
    for _ in range(LAYOUT_ROUNDS):
        if engine is not None:
            engine.execute(figure)
        if room == (room := place()):
            break
    figure.set_layout_engine(None)  # each file that is written would repeat it, and draw twice


def capital(text: str) -> str:
    """A text with a capital first, unless it begins with a symbol of one letter (x, y) or a key
    of a file (tracker.aperture_mm).
    """
    if re.match(r"\w\w|a ", text) and not KEY.match(text):
        return text[:1].upper() + text[1:]
    return text


def title_lines(finding: str, columns: int = TITLE_COLUMNS) -> str:
    """A finding in the fewest lines of about equal length, with no line break between a figure
    and its unit.
    """
    finding = re.sub(r"\d(\.\d+)?e[+-]\d+", lambda found: two_digits(float(found[0])), finding)
    bound = re.sub(
        r"(?<=\d) (?=%|(K|mag|mm|px|ms|s|deg/s|arcsec)\b)", "\N{NO-BREAK SPACE}", finding
    )

    def wrapped(width: int) -> list[str]:
        return textwrap.wrap(bound, width, break_on_hyphens=False)

    count = len(wrapped(columns))
    width = len(bound) // count
    while width < columns and len(wrapped(width)) > count:
        width += 1
    return "\n".join(wrapped(width))


def plain_ticks(axis: "Axis", values: Sequence[float]) -> None:
    """Ticks of a logarithmic axis as a person writes them: 3000, not 3 x 10^3."""
    axis.set_ticks(values, labels=[plain(value) for value in values])
    axis.set_ticks([], minor=True)


def plain(value: float) -> str:
    """A round figure as a person writes it; below 0.0001 and from a million on as a power of
    ten.
    """
    if value == 0 or 1e-4 <= abs(value) < 1e6:
        return f"{value:g}"
    mantissa, power = f"{value:.1e}".split("e")
    mantissa = mantissa.removesuffix(".0")
    raised = str(int(power)).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return f"{'' if mantissa == '1' else mantissa + '·'}10{raised}"


def two_digits(value: float) -> str:
    """A measured figure as a chart says it."""
    if math.isfinite(value):
        return plain(float(f"{value:.2g}"))
    return "-"


def log_ticks(axis: "Axis", room: float) -> None:
    """Round ticks of a logarithmic axis within its limits, as many as stand apart where there is
    room for `room`.
    """
    low, high = sorted(axis.get_view_interval())
    first = math.floor(math.log10(low))
    last = math.ceil(math.log10(high))
    within_decades: tuple[tuple[float, ...], ...] = (
        (1, 1.5, 2, 3, 4, 5, 7),
        (1, 2, 3, 5),
        (1, 2, 5),
        (1, 3),
    )
    for steps, every in [
        *((steps, 1) for steps in within_decades),
        *(((1.0,), every) for every in range(1, 20)),
    ]:
        ticks = []
        for power in range(first, last + 1):
            if power % every == 0:
                for step in steps:
                    ticks.append(step * 10.0**power)
        ticks = [tick for tick in ticks if low * 0.999 <= tick <= high * 1.001]
        smallest_ratio = min((b / a for a, b in itertools.pairwise(ticks)), default=high)
        if smallest_ratio > (high / low) ** (1 / room):
            break
    plain_ticks(axis, ticks)


def label_ends(*panels: "Axes") -> None:
    """Names of lines in their colours, right of each panel where each line ends, in place of a
    legend.
    """
    for axes in panels:
        name_at_side(axes, [])


def name_at_side(axes: "Axes", named: SideNames) -> None:
    """Names of points (x, y) of the data, with their colours, in a column right of the axes, level
    where there is room.

    Without any, lines are named where they end. The names are placed when the chart is finished.
    """
    _SIDE_NAMES.setdefault(axes.figure, []).append((axes, named))


def _line_ends(axes: "Axes") -> Iterator[tuple[str, tuple[float, float], str]]:
    """The name, the last point in view (x, y) and the colour of each line that has a name."""
    low, high = sorted(axes.get_xlim())
    for line in axes.get_lines():
        # an axhline's x is not
        x_is_data, _ = line.get_transform().contains_branch_seperately(axes.transData)
        xy = np.asarray(line.get_xydata(), dtype=float)
        ends = xy[
            np.isfinite(xy[:, 1]) & ((low <= xy[:, 0]) & (xy[:, 0] <= high) | (not x_is_data))
        ]
        if len(ends) and not str(line.get_label()).startswith("_"):
            x, y = (float(value) for value in ends[ends[:, 0].argmax()])
            if not x_is_data:
                x = high
            yield str(line.get_label()), (x, y), str(line.get_color())


def _name_at_side(axes: "Axes", named: SideNames) -> "list[Annotation]":
    """The names of a panel, kept apart at its present height, with arrows to far points."""
    gap = 1.3 * SMALL_PT / 72 * axes.figure.dpi / axes.bbox.height
    texts: list[Annotation] = []
    places = {}  # in parts of the axes
    for curve in named or _line_ends(axes):
        at_px = axes.transData.transform(curve[1])
        places[curve] = axes.transAxes.inverted().transform(at_px)
    falling = sorted(places, key=lambda curve: -places[curve][1])
    heights = spread([float(places[curve][1]) for curve in falling], gap)
    for curve, height in zip(falling, heights, strict=True):
        name, point, colour = curve
        arrow = None
        text_x = 1.015
        is_far = abs(height - places[curve][1]) > gap / 3 or places[curve][0] < 0.93
        if is_far:
            arrow = ARROW | {"color": colour}
            text_x = 1.035
        texts.append(
            axes.annotate(
                name,
                point,
                (text_x, height),
                textcoords="axes fraction",
                va="center",
                fontsize=SMALL_PT,
                color=colour,
                arrowprops=arrow,
                annotation_clip=False,
            )
        )
    return texts


def spread(heights: Sequence[float], gap: float) -> list[float]:
    """Falling heights moved apart by at least `gap`, within 0 and 1 where there is room."""
    placed: list[float] = []
    highest = 1.0
    for height in heights:
        placed.append(min(float(height), highest))
        highest = placed[-1] - gap
    lowest = 0.0
    for k in reversed(range(len(placed))):
        placed[k] = max(placed[k], lowest)
        lowest = placed[k] + gap
    return placed


def value_bars(
    axes: "Axes", names: Sequence[str], values: Sequence[float], colours: Sequence[str] | str
) -> None:
    """Horizontal bars, the first on top, each with its figure at its end in the place of an
    axis.
    """
    bars = axes.barh(range(len(names)), values, color=colours)
    axes.set_yticks(range(len(names)), names)
    axes.invert_yaxis()
    axes.bar_label(bars, [two_digits(value) for value in values], padding=3, fontsize=SMALL_PT)
    axes.margins(x=0.3)
    axes.grid(visible=False)
    axes.tick_params(length=0)
    axes.set_xticks([])
    axes.spines["bottom"].set_visible(False)


def save(figure: "Figure", path: Path) -> None:
    """Write a figure as PNG, as SVG, or where its path has no ending as both. Raises InputError
    where one cannot be written.
    """
    for target in (
        [path]
        if path.suffix in ENDINGS
        else [path.with_name(path.name + ending) for ending in ENDINGS]
    ):
        if target.suffix == ".svg":
            data = svg(figure).encode()
        else:
            data = png(figure)
        write_whole(target, data)


def png(figure: "Figure") -> bytes:
    """A figure as PNG, in the light colours."""
    data = io.BytesIO()
    with _own_settings({}):
        figure.savefig(data, format="png", dpi=PNG_DPI)
    return data.getvalue()


def svg(figure: "Figure") -> str:
    """A figure as SVG with both sets of colours: dark ones where the reader, or the page around
    it, prefers them.
    """
    data = io.StringIO()
    with _own_settings({"svg.hashsalt": "hilstar"}):  # the same figure is the same file
        figure.savefig(data, format="svg", metadata={"Date": None})
    rules = ""
    for light, dark in DARK.items():
        for what in ("fill", "stroke"):
            rules += f'[style*="{what}: {light}"]{{{what}:{dark}!important}}'
    return data.getvalue().replace(
        "</style>", f"@media (prefers-color-scheme: dark){{{rules}}}</style>", 1
    )
