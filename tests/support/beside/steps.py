"""A difference to another program, cause by cause: its table and its chart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from hilstar.basics.charts import (
    BLUE,
    MUTED,
    SMALL_PT,
    chart,
    log_ticks,
    two_digits,
    write_csv,
)

COLUMNS = ("program", "version", "date", "subject", "unit", "step", "size")
ROW_INCH, PANEL_INCH, HEAD_INCH = 0.3, 0.75, 1.0
SMALLEST = 1e-16  # of a double: a logarithmic axis has no 0


@dataclass(frozen=True, slots=True)
class Step:
    """How far hilstar and a program are apart in a subject, in its unit.

    `step` says what was taken out before, in the words of the table; the first of a subject has
    nothing taken out.
    """

    subject: str
    unit: str
    step: str
    size: float


@dataclass(frozen=True, slots=True)
class Beside:
    """What a run beside a program found: its name, its version, and the steps, in order."""

    program: str
    version: str
    finding: str
    steps: tuple[Step, ...]

    def size(self, subject: str, step: str) -> float:
        """The size of a step by its subject and its first words. Raises KeyError."""
        for one in self.steps:
            if one.subject == subject and one.step.startswith(step):
                return one.size
        raise KeyError(f"{subject}: {step}")


def write_beside(folder: Path, name: str, beside: Beside, date: str) -> None:
    """Write beside_NAME.csv and the chart beside_NAME of a run on a date."""
    folder.mkdir(parents=True, exist_ok=True)
    rows = []
    for one in beside.steps:
        head = (beside.program, beside.version, date)
        rows.append((*head, one.subject, one.unit, one.step, f"{one.size:.3g}"))
    write_csv(folder / f"beside_{name}.csv", COLUMNS, rows)
    draw(folder / f"beside_{name}", beside, date)


def draw(path: Path, beside: Beside, date: str) -> None:
    """A panel a subject, a point a step, the first on top."""
    subjects: dict[str, list[Step]] = {}
    for one in beside.steps:
        subjects.setdefault(one.subject, []).append(one)
    counts = [len(steps) for steps in subjects.values()]
    height = HEAD_INCH + sum(PANEL_INCH + ROW_INCH * count for count in counts)
    layout = {
        "note": f"{beside.program} {beside.version}, {date}. Downwards one cause after the other is"
        " taken out.",
        "share_x": False,
        "heights": [count + 0.8 for count in counts],
        "height_inch": height,
    }
    with chart(path, beside.finding, len(subjects), **layout) as panels:
        for axes, (subject, steps) in zip(panels, subjects.items(), strict=True):
            draw_steps(axes, subject, steps)


def draw_steps(axes: object, subject: str, steps: Sequence[Step]) -> None:
    """One panel: the steps of a subject."""
    from matplotlib.axes import Axes

    assert isinstance(axes, Axes)
    sizes = [max(abs(one.size), SMALLEST) for one in steps]
    places = range(len(steps))
    axes.hlines(places, min(sizes) / 3, sizes, color=MUTED, lw=1)
    axes.plot(sizes, places, "o", color=BLUE)
    for place, size in zip(places, sizes, strict=True):
        axes.annotate(
            two_digits(size),
            (size, place),
            (6, 0),
            textcoords="offset points",
            va="center",
            fontsize=SMALL_PT,
            color=BLUE,
        )
    axes.set_xscale("log")
    axes.set_xlim(min(sizes) / 3, max(sizes) * (max(sizes) / min(sizes)) ** 0.25 * 3)
    axes.set_ylim(len(steps) - 0.5, -0.5)
    axes.set_yticks(places, [one.step for one in steps])
    axes.set_title(f"{subject} [{steps[0].unit}]")
    axes.grid(visible=False, axis="y")
    log_ticks(axes.xaxis, 5)
