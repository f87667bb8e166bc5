"""What the benchmark measured, as lines for a person, a CSV and a chart."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from hilstar.charts import STYLE, plain_ticks, save, title_lines, write_csv

COLORS = {"hilstar": "C3", "numpy": "C0", "numba": "C1", "galsim": "C2", "photutils": "C4"}
COLUMN = 12
NAME = 26
Row = dict[str, Any]


def lines(result: Row) -> Iterator[str]:
    """A table for each image size: medians in ms, a column for each star count; then what else is known."""
    machine = result["machine"]
    software = f"Python {machine['python']}, NumPy {machine['numpy']}; {result['gl_renderer']}"
    yield f"{machine['cpu']}, {machine['cores']} cores, load {machine['load']:.1f} before; {software}"
    for size, rows in _by_size(result["rows"]):
        counts = _counts(rows)
        yield ""
        yield f"{size + ', ms (median)':{NAME}}" + "".join(f"{f'{count} stars':>{COLUMN}}" for count in counts)
        for name, values in _named(rows).items():
            yield f"{name:{NAME}}" + "".join(f"{_ms(values.get(count)):>{COLUMN}}" for count in counts)
        python = {row["stars"]: row["ms"]["median"] for _, some in _by_size(result["python_ms"], size) for row in some}
        yield f"{'  Python outside GL':{NAME}}" + "".join(f"{_ms(python.get(count)):>{COLUMN}}" for count in counts)
    yield ""
    yield from _notes(result)


def _notes(result: Row) -> Iterator[str]:
    yield "whole frame: attitude in to codes in memory. linear only: the image alone, places and light given"
    yield "stages are waited for, one after the other; gpu: the same by the driver's own timers"
    for name, does in result["does"].items():
        worst = [row["worst_of_peak"] for row in result["agreement"] if row["method"] == name]
        yield f"{name:11}{does}" + (f"; off by {max(worst):.1g} of our brightest pixel at most" if worst else "; not run")
    for row in result["scenes"]:
        if row["random"]:
            yield f"{_size(row)}, {row['stars']} stars: {row['catalogue']} of the catalogue, {row['random']} random"
    for row in result["skipped"]:
        where = f" at {_size(row)}, {row['stars']} stars" if "stars" in row else ""
        yield f"{row['method']}{where}: {row['why']}"
    yield (
        f"import {result['import_ms']:.0f} ms, first frame {result['first_frame_ms']:.0f} ms, "
        f"{result['memory_mb']:.0f} MB at most, in a fresh process"
    )
    for aim in result["aims"]:
        word = "reached" if aim["reached"] else "NOT reached"
        yield f"aim {word}: {aim['what']} {aim['measured_ms']:.2f} ms (at most {aim['aim_ms']:g})"


def write(result: Row, folder: Path) -> None:
    """bench.csv and bench.png in `folder`. Raises InputError where they cannot be written."""
    columns = ("width", "height", "stars", "method", "kind")
    times = ("median", "min", "max")
    table = [[row[name] for name in columns] + [row["ms"][name] for name in times] for row in result["rows"]]
    write_csv(folder / "bench.csv", (*columns, *(f"{name}_ms" for name in times)), table)
    _draw(folder / "bench.png", result)


def _draw(path: Path, result: Row) -> None:
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    panels = list(_by_size(result["rows"]))
    across = min(2, len(panels))
    down = -(-len(panels) // across)
    with rc_context(STYLE):
        figure = Figure(figsize=(2.0 + 5.5 * across, 2.2 + 4.0 * down), layout="constrained")
        grid = figure.subplots(down, across, sharex=True, sharey=True, squeeze=False).ravel()
        for axis in grid[len(panels) :]:
            axis.set_axis_off()
        for axis, (size, rows) in zip(grid, panels, strict=False):
            for method, kind in _lines_of(rows):
                points = [(row["stars"], row["ms"]["median"]) for row in rows if (row["method"], row["kind"]) == (method, kind)]
                style = "o-" if kind == "whole_frame" else "o--"
                label = f"{method}, {'whole frame to codes' if kind == 'whole_frame' else 'linear image only'}"
                axis.plot(*zip(*points, strict=True), style, color=COLORS[method], ms=4, label=label)
            axis.set(title=size, xscale="log", yscale="log", xlabel="stars in view", ylabel="ms a frame (median)")
            plain_ticks(axis.xaxis, _counts(rows))
        handles = {label: line for axis in grid for line, label in zip(*axis.get_legend_handles_labels(), strict=True)}
        figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=min(2 * across, len(handles)))
        figure.suptitle(title_lines(_finding(result)), fontsize=12)
        save(figure, path)


def _finding(result: Row) -> str:
    whole = [row for row in result["rows"] if row["kind"] == "whole_frame"]
    first, last = (pick(whole, key=lambda row: row["ms"]["median"]) for pick in (min, max))
    parts = [f"{row['ms']['median']:.1f} ms with {row['stars']} stars on {_size(row)}" for row in (first, last)]
    return f"A whole frame takes {parts[0]} and {parts[1]} ({result['gl_renderer']}, {result['machine']['cores']} cores)"


def _lines_of(rows: list[Row]) -> list[tuple[str, str]]:
    return list(dict.fromkeys((row["method"], row["kind"]) for row in rows if row["kind"] in ("whole_frame", "linear_only")))


def _by_size(rows: list[Row], only: str | None = None) -> Iterator[tuple[str, list[Row]]]:
    for size in dict.fromkeys(map(_size, rows)):
        if only in (None, size):
            yield size, [row for row in rows if _size(row) == size]


def _named(rows: list[Row]) -> dict[str, dict[int, float]]:
    """Medians by star count of each line of the table, our stages indented under the whole frame."""
    named: dict[str, dict[int, float]] = {}
    for wanted in (True, False):
        for row in rows:
            stage = row["kind"] not in ("whole_frame", "linear_only")
            if wanted == (stage or row["kind"] == "whole_frame"):
                kind = row["kind"].replace("_", " ")
                name = f"  {kind}" if stage else f"{row['method']}, {kind}"
                named.setdefault(name, {})[row["stars"]] = row["ms"]["median"]
    return named


def _counts(rows: list[Row]) -> list[int]:
    return sorted({row["stars"] for row in rows})


def _size(row: Row) -> str:
    return f"{row['width']} x {row['height']}"


def _ms(value: float | None) -> str:
    return "n/a" if value is None else f"{value:.3g}" if value < 100 else f"{value:.0f}"
