"""The benchmark's result: the command's JSON object, lines for a person, a CSV and a chart."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from msgspec import UNSET, UnsetType

from hilstar.basics.charts import BLUE, GREEN, ORANGE, PURPLE, RED, write_csv
from hilstar.instruments.study.engine import (
    ChartSpec,
    LineSpec,
    PanelSpec,
    SeriesLook,
    row_panels,
)
from hilstar.instruments.study.sweep import Load

Size = tuple[int, int]
REFERENCE_PX: Size = (1920, 1080)
COLOURS = {"hilstar": RED, "numpy": BLUE, "numba": ORANGE, "galsim": GREEN, "photutils": PURPLE}
COLUMN = 12
NAME = 26
OF_AN_IMAGE = ("whole_frame", "turning", "linear_only")
# By the kind of a row: its name, marker and line.
LABELS = {
    "whole_frame": ("whole frame to codes", "o", "-"),
    "turning": ("the same turning by 10 deg/s", "o", ":"),
    "linear_only": ("linear image only", "o", "--"),
}


@dataclass(frozen=True, slots=True)
class TimeSpread:
    """Times of a work, ms."""

    median: float
    min: float
    max: float


@dataclass(frozen=True, slots=True)
class ImageSize:
    """An image size, px."""

    width: int
    height: int

    @property
    def size(self) -> Size:
        """Width and height, px."""
        return self.width, self.height


@dataclass(frozen=True, slots=True)
class Cell(ImageSize):
    """An image size and a number of stars in view."""

    stars: int


@dataclass(frozen=True, slots=True)
class MethodTiming(Cell):
    """How long a method takes in a cell; `kind` is the whole frame, the linear image alone or a
    stage of hilstar's.
    """

    method: str
    kind: str
    ms: TimeSpread


@dataclass(frozen=True, slots=True)
class PythonTime(Cell):
    """How long all of a frame takes that is not OpenGL."""

    ms: TimeSpread


@dataclass(frozen=True, slots=True)
class SceneOrigin(Cell):
    """How many of a cell's stars are the catalogue's, and how many are random."""

    catalogue: int
    random: int


@dataclass(frozen=True, slots=True)
class Agreement(Cell):
    """The largest difference of a method's linear image from hilstar's, as a share of hilstar's
    brightest pixel.
    """

    method: str
    worst_of_peak: float


@dataclass(frozen=True, slots=True)
class Skipped:
    """A method that was not measured, in one cell or in any, and why."""

    width: int | UnsetType = UNSET
    height: int | UnsetType = UNSET
    stars: int | UnsetType = UNSET
    method: str = ""
    why: str = ""


@dataclass(frozen=True, slots=True)
class ProcessStart(ImageSize):
    """Times of import and first frame in a process of its own, and its peak memory."""

    import_ms: float
    first_frame_ms: float
    memory_mb: float


@dataclass(frozen=True, slots=True)
class Aim:
    """A time that the project set itself, and whether this run reached it; None on a busy
    machine.
    """

    what: str
    aim_ms: float
    measured_ms: float
    reached: bool | None


@dataclass(frozen=True, slots=True)
class Machine:
    """Where the times were taken; `load` is the average of the last minute before, which is in
    the times too.
    """

    cpu: str
    cores: int
    load: float
    python: str
    numpy: str


@dataclass(slots=True)
class Result:
    """The JSON object of `hilstar benchmark`; it grows while the benchmark runs."""

    machine: Machine
    gl_renderer: str = ""
    rows: list[MethodTiming] = field(default_factory=list)
    tracker: list[MethodTiming] = field(default_factory=list)
    scenes: list[SceneOrigin] = field(default_factory=list)
    agreement: list[Agreement] = field(default_factory=list)
    startup: list[ProcessStart] = field(default_factory=list)
    python_ms: list[PythonTime] = field(default_factory=list)
    does: dict[str, str] = field(default_factory=dict)
    skipped: list[Skipped] = field(default_factory=list)
    import_ms: float = 0.0
    first_frame_ms: float = 0.0
    memory_mb: float = 0.0
    aims: list[Aim] = field(default_factory=list)
    others_cores: float = 0.0  # that other processes took while it ran

    @property
    def load(self) -> Load:
        """The same, and what may be said of the times."""
        return Load(self.others_cores)


def lines(result: Result) -> Iterator[str]:
    """A table for each image size: medians in ms, a column for each star count; then notes."""
    machine = result.machine
    software = f"Python {machine.python}, NumPy {machine.numpy}; {result.gl_renderer}"
    yield f"{machine.cpu}, {machine.cores} cores, load {machine.load:.1f} before; {software}"
    for size in _sizes(result.rows):
        rows = [row for row in result.rows if row.size == size]
        counts = _counts(rows)
        yield ""
        yield f"{_words(size) + ', ms (median)':{NAME}}" + "".join(
            f"{f'{count} stars':>{COLUMN}}" for count in counts
        )
        for name, values in _named(rows).items():
            yield f"{name:{NAME}}" + "".join(
                f"{_ms(values.get(count)):>{COLUMN}}" for count in counts
            )
        python = {row.stars: row.ms.median for row in result.python_ms if row.size == size}
        yield f"{'  Python outside GL':{NAME}}" + "".join(
            f"{_ms(python.get(count)):>{COLUMN}}" for count in counts
        )
    yield ""
    yield from _tracker_lines(result.tracker)
    yield from _notes(result)
    if result.load.busy:
        yield result.load.caution


def _tracker_lines(rows: Sequence[MethodTiming]) -> Iterator[str]:
    own_ms = {row.kind: row.ms.median for row in rows if row.method == "hilstar"}
    for row in rows:
        if row is rows[0]:
            yield (
                f"the virtual tracker, {_words(row.size)}, {row.stars} stars, ms of the processor"
                " (median)"
            )
        if row.method == "hilstar":
            beside = ""
        else:
            beside = f"   {row.ms.median / own_ms[row.kind]:.2f} of hilstar's"
        yield f"  {row.kind.replace('_', ' '):12}{row.method:11}{row.ms.median:8.1f}{beside}"
    yield from [""] * bool(rows)


def _notes(result: Result) -> Iterator[str]:
    yield (
        "whole frame: from attitude to codes in memory. turning: the same at 10 deg/s, with stars"
        " drawn along their paths"
    )
    yield "linear only: the image alone, from given places and light"
    yield "stages are waited for, one after the other; gpu: the same by the driver's own timers"
    for name, does in result.does.items():
        worst = [row.worst_of_peak for row in result.agreement if row.method == name]
        yield f"{name:11}{does}" + (
            f"; differs by at most {max(worst):.1g} of our brightest pixel"
            if worst
            else "; not run"
        )
    for row in result.scenes:
        if row.random:
            yield (
                f"{_words(row.size)}, {row.stars} stars: {row.catalogue} from the catalogue,"
                f" {row.random} random"
            )
    for skipped in result.skipped:
        if skipped.stars is UNSET:
            where = ""
        else:
            where = f" at {skipped.width} x {skipped.height}, {skipped.stars} stars"
        yield f"{skipped.method}{where}: {skipped.why}"
    yield (
        f"import {result.import_ms:.0f} ms, first frame {result.first_frame_ms:.0f} ms, "
        f"peak memory {result.memory_mb:.0f} MB, in a fresh process"
    )
    for aim in result.aims:
        if aim.reached is None:
            word = "not judged"
        elif aim.reached:
            word = "reached"
        else:
            word = "NOT reached"
        yield f"aim {word}: {aim.what} {aim.measured_ms:.2f} ms (at most {aim.aim_ms:.4g})"


def write(result: Result, folder: Path) -> None:
    """Write bench.csv, tracker.csv and the chart into `folder`. Raises InputError where they
    cannot be written.
    """
    columns = ("width", "height", "stars", "method", "kind", "median_ms", "min_ms", "max_ms")
    for name, rows in (("bench.csv", result.rows), ("tracker.csv", result.tracker)):
        table = []
        for r in rows:
            table.append(
                (r.width, r.height, r.stars, r.method, r.kind, r.ms.median, r.ms.min, r.ms.max)
            )
        write_csv(folder / name, columns, table)
    _draw(folder / "bench", result)


def _draw(path: Path, result: Result) -> None:
    """The time of a frame against the stars in view, a panel for each image size."""
    sizes = _sizes(result.rows)
    rows = [row for row in result.rows if row.kind in OF_AN_IMAGE]
    across = min(2, len(sizes))
    down = -(-len(sizes) // across)
    looks = {}
    for method, kind in dict.fromkeys(map(_series, rows)):
        label, marker, _ = LABELS[kind]
        looks[method, kind] = SeriesLook(f"{method}, {label}", COLOURS[method], marker)
    panels = []
    for number, size in enumerate(sizes):
        xlabel = "stars in view" if number // across == down - 1 else ""
        ylabel = "time of a frame [ms]" if number % across == 0 else ""
        panels.append(replace(_size_panel(size, rows), xlabel=xlabel, ylabel=ylabel))
    layout = {"share_x": True, "share_y": True, "height_inch": 2.1 + 2.5 * down}
    spec = ChartSpec(tuple(panels), _series, looks, "Medians, in turn.", across, layout)
    with row_panels(path, _finding(result), spec, rows, result.load) as grid:
        handles = {}
        for axes in grid:
            for line, label in zip(*axes.get_legend_handles_labels(), strict=True):
                handles[label] = line
        names = handles.values(), handles.keys()
        grid[0].figure.legend(*names, loc="outside lower center", ncols=2)


def _series(row: MethodTiming) -> tuple[str, str]:
    """The series of a row: its method and its kind."""
    return row.method, row.kind


def _size_panel(size: Size, rows: Sequence[MethodTiming]) -> PanelSpec:
    """The times on one image size."""
    lines = []
    for kind, (_, _, style) in LABELS.items():

        def is_drawn(row: MethodTiming, kind: str = kind) -> bool:
            return row.size == size and row.kind == kind

        lines.append(LineSpec("stars", _median_ms, style, where=is_drawn, look={"ms": 4}))
    counts = _counts([row for row in rows if row.size == size])
    return PanelSpec(
        tuple(lines), title=_words(size), scales=("log", "log"), xticks=counts, names=False
    )


def _median_ms(row: MethodTiming) -> float:
    """What is drawn of a row."""
    return row.ms.median


def _finding(result: Result) -> str:
    whole = [row for row in result.rows if row.kind == "whole_frame"]
    first, last = (pick(whole, key=lambda row: row.ms.median) for pick in (min, max))
    parts = [
        f"{row.ms.median:.1f} ms with {row.stars} stars on {_words(row.size)}"
        for row in (first, last)
    ]
    where = f"{result.gl_renderer}, {result.machine.cores} cores"
    return result.load.title(
        f"A whole frame takes {parts[0]} and {parts[1]} ({where})",
        "A whole frame beside other renderers",
    )


def _named(rows: Sequence[MethodTiming]) -> dict[str, dict[int, float]]:
    """Medians by star count of each line of the table, hilstar's stages indented under the whole
    frame.
    """
    named: dict[str, dict[int, float]] = {}
    for wanted in (True, False):
        for row in rows:
            stage = row.kind not in OF_AN_IMAGE
            if wanted == (stage or row.kind == "whole_frame"):
                kind = row.kind.replace("_", " ")
                name = f"  {kind}" if stage else f"{row.method}, {kind}"
                named.setdefault(name, {})[row.stars] = row.ms.median
    return named


def _sizes(rows: Sequence[Cell]) -> list[Size]:
    return list(dict.fromkeys(row.size for row in rows))


def _counts(rows: Sequence[Cell]) -> list[int]:
    return sorted({row.stars for row in rows})


def _words(size: Size) -> str:
    return f"{size[0]} x {size[1]}"


def _ms(value: float | None) -> str:
    if value is None:
        return "n/a"
    if value < 100:
        return f"{value:.3g}"
    return f"{value:.0f}"
