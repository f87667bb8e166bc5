"""The picture: a column a scene; error against time in arcsec and in mag, and where error and time come from."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hilstar.charts import STYLE, plain_ticks, save, title_lines
from hilstar.study.chain.budget import RSS, WHOLE
from hilstar.study.chain.combinations import QUANTISATIONS
from hilstar.study.chain.table import AUTO, DEFAULT, BudgetRow, Row, StageRow

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis

COLOURS: dict[str, str] = dict(zip(QUANTISATIONS, ("C7", "C1", "C2", "C0"), strict=True))
MARKERS = {("path", "rate"): "o", ("path", "two samples"): "v", ("point", "rate"): "s", ("point", "held"): "^"}
MARKER_WORDS = {
    ("path", "rate"): "paths, predicted by the rate",
    ("path", "two samples"): "paths, by two samples",
    ("point", "rate"): "points, by the rate",
    ("point", "held"): "points, held",
}
COLUMN_INCH, HEIGHT_INCH = 4.4, 17.0
ROWS = (3.0, 3.0, 1.7, 1.7, 1.1)
FLOOR_SHARE = 1e-3  # of the whole error: bars below it are of no account
WORDS = {RSS: "root sum square", "refresh": "refresh of the panel", "codes": "quantisation", "sprites": "cut sprites"}
NAME_ROOM = 0.7  # of the axes: right of here a name has no room to the right of its point
CHOSEN = {DEFAULT: ("D", "black"), AUTO: ("*", "C3")}


def draw(
    path: Path, rows: Sequence[Row], budget: Sequence[BudgetRow], stages: Sequence[StageRow], head: tuple[str, str]
) -> None:
    """Write the picture, with its finding and the machine of its times. Raises InputError where it cannot be written."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    scenes = list(dict.fromkeys(row.scene for row in rows))
    with rc_context(STYLE):
        figure = Figure(figsize=(COLUMN_INCH * max(len(scenes), 2), HEIGHT_INCH), layout="constrained")
        grid = figure.subplots(5, len(scenes), squeeze=False, height_ratios=ROWS)
        for column, name in enumerate(scenes):
            own = [row for row in rows if row.scene == name]
            _scatter(grid[0][column], own, "error_arcsec")
            _scatter(grid[1][column], own, "error_mag")
            parts = [part for part in budget if part.scene == name]
            _bars(grid[2][column], parts, "error_arcsec")
            _bars(grid[3][column], parts, "error_mag")
            _times(grid[4][column], [one for one in stages if one.scene == name])
            grid[0][column].set_title(f"{name}, {own[0].stars} stars")
            grid[1][column].set_xlabel("median time of a frame [ms]")
            grid[2][column].set_xlabel("arcsec, rms, at auto")
            grid[3][column].set_xlabel("mag, rms, at auto")
            grid[4][column].set_xlabel("ms a frame, at auto")
        for column in range(1, len(scenes)):
            for row in (2, 3, 4):
                grid[row][column].set_yticklabels([])
        for row, label in enumerate(
            ("star's place, rms [arcsec]", "star's light, rms [mag]", "error from", "error from", "time")
        ):
            grid[row][0].set_ylabel(label)
        figure.legend(handles=_legend(rows), loc="outside lower center", ncols=5, fontsize=10)
        finding, machine = head
        figure.suptitle(f"{title_lines(finding)}\n{machine}", fontsize=14)
        save(figure, path)


def _scatter(axes: Axes, rows: Sequence[Row], error: str) -> None:
    front = "on_front" if error == "error_arcsec" else "on_front_mag"
    floor = FLOOR_SHARE * min((getattr(row, error) for row in rows if getattr(row, error) > 0), default=1.0)
    line = [(row.time_ms, max(getattr(row, error), floor)) for row in rows if getattr(row, front) == "true"]
    axes.step(*zip(*line, strict=True), where="post", color="black", lw=1.3, zorder=1)
    for row in rows:
        _dot(axes, row, max(getattr(row, error), floor), getattr(row, front) == "true")
    axes.set(xscale="log", yscale="log")
    axes.margins(0.1, 0.12)
    for row in rows:
        for name, (marker, colour) in CHOSEN.items():
            if row.chosen == name:
                _label(axes, name, (row.time_ms, max(getattr(row, error), floor)), (marker, colour))
    for axis, (low, high) in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
        _round_ticks(axis, low, high)


def _dot(axes: Axes, row: Row, error: float, on_front: bool) -> None:
    colour, stealing = COLOURS[row.quantisation], row.bit_stealing == "true"
    size = {"full": 8.0, "cut": 6.0, "coarse": 4.0}[row.sprite]
    style: dict[str, Any] = {"marker": MARKERS[row.smear, row.prediction], "ms": size, "mec": colour, "mew": 1.4}
    half = row.noise_ms
    axes.plot([max(row.time_ms - half, row.time_ms / 2), row.time_ms + half], [error] * 2, color=colour, lw=1.0, alpha=0.5)
    style |= {"mfc": "white" if stealing else colour, "alpha": 1.0 if on_front else 0.65}
    axes.plot(row.time_ms, error, ls="none", zorder=3 if on_front else 2, **style)


def _label(axes: Axes, name: str, place: tuple[float, float], look: tuple[str, str]) -> None:
    """A ring around a point, and its name: beside it where the axes have room, `default` below and others above."""
    marker, colour = look
    axes.plot(*place, marker=marker, ms=17, mfc="none", mec=colour, mew=1.8, ls="none", zorder=4)
    at_end = axes.transAxes.inverted().transform(axes.transData.transform(place))[0] > NAME_ROOM
    axes.annotate(
        name,
        place,
        xytext=(-12 if at_end else 12, -16 if name == DEFAULT else 12),
        textcoords="offset points",
        ha="right" if at_end else "left",
        color=colour,
        fontsize=11,
        fontweight="bold",
        zorder=5,
    )


def _bars(axes: Axes, parts: Sequence[BudgetRow], error: str) -> None:
    values = [getattr(part, error) for part in parts][::-1]
    names = [WORDS.get(part.step, part.step) for part in parts][::-1]
    colours = ["C3" if part.step == WHOLE else "0.5" if part.step == RSS else "C0" for part in parts][::-1]
    largest = max([value for value in values if math.isfinite(value)], default=1.0) or 1.0
    axes.barh(names, values, color=colours)
    for place, value in enumerate(values):
        text = "0" if value == 0 else f"{value:.2g}"
        axes.annotate(f" {text}", (value, place), va="center", fontsize=9)
    axes.set_xlim(0, 1.25 * largest)
    axes.grid(visible=False, axis="y")


def _times(axes: Axes, stages: Sequence[StageRow]) -> None:
    values, names = [one.time_ms for one in stages][::-1], [one.stage for one in stages][::-1]
    axes.barh(names, values, color="C4")
    for place, value in enumerate(values):
        axes.annotate(f" {value:.2g}", (value, place), va="center", fontsize=9)
    axes.set_xlim(0, 1.25 * max(values, default=1.0))
    axes.grid(visible=False, axis="y")


def _round_ticks(axis: Axis, low: float, high: float) -> None:
    first, last = math.floor(math.log10(low)), math.ceil(math.log10(high))
    steps = (1, 1.5, 2, 3, 5, 7) if high < 8 * low else (1, 2, 5) if high < 200 * low else (1,)
    ticks = [step * 10.0**power for power in range(first, last + 1) for step in steps]
    plain_ticks(axis, [tick for tick in ticks if low <= tick <= high])


def _legend(rows: Sequence[Row]) -> list[Any]:
    from matplotlib.lines import Line2D

    plain: dict[str, Any] = {"ls": "none", "color": "0.3"}
    handles = [Line2D([], [], color="black", lw=1.3, label="front: nothing is as right and as fast")]
    for name, (marker, colour) in CHOSEN.items():
        word = "hilstar's defaults" if name == DEFAULT else 'effort = "auto"'
        handles.append(Line2D([], [], marker=marker, ms=13, mfc="none", mec=colour, mew=1.8, ls="none", label=word))
    handles += [Line2D([], [], marker="o", color=colour, ls="none", label=name) for name, colour in COLOURS.items()]
    handles.append(Line2D([], [], marker="o", mfc="white", mec="0.3", ls="none", label="open: bit stealing"))
    seen = {(row.smear, row.prediction) for row in rows}
    handles += [Line2D([], [], marker=m, label=MARKER_WORDS[key], **plain) for key, m in MARKERS.items() if key in seen]
    handles.append(Line2D([], [], marker="o", ms=4, label="large, medium, small: sprites full, cut, coarse", **plain))
    return handles
