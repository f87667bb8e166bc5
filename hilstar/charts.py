"""Charts and their tables: one style of figure, whose title is its finding, and the CSV behind it."""

from __future__ import annotations

import csv
import re
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hilstar.files import whole_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis

SIZE_INCH = (9.0, 5.4)  # of one panel; each further one adds SHARE of the height
SHARE = 0.65
TITLE_COLUMNS = 92
STYLE: Any = {"font.size": 11, "axes.grid": True, "grid.alpha": 0.3, "legend.frameon": False, "lines.linewidth": 1.8}


def write_csv(path: Path, columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """A table with a header. Raises InputError where it cannot be written."""
    with whole_file(path) as part, part.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(rows)


def write_records(path: Path, records: Sequence[Any]) -> None:
    """A table of frozen dataclasses of one class, a column for each field. Raises InputError where it cannot be written."""
    columns = [field.name for field in fields(records[0])]
    write_csv(path, columns, [[getattr(record, name) for name in columns] for record in records])


@contextmanager
def chart(path: Path, finding: str, panels: int = 1, share_x: bool = True) -> Iterator[list[Axes]]:
    """A PNG titled by its finding, with `panels` one above the other, which may share x; draw on the axes that it yields."""
    # Not pyplot: it would change the backend of a program that imports this.
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(STYLE):
        size = SIZE_INCH[0], SIZE_INCH[1] * (1 + SHARE * (panels - 1))
        figure = Figure(figsize=size, layout="constrained")
        grid = figure.subplots(panels, 1, sharex=share_x, squeeze=False)
        yield list(grid[:, 0])
        figure.suptitle(title_lines(finding), fontsize=12)
        save(figure, path)


def title_lines(finding: str) -> str:
    """A finding in the fewest lines of about equal length, with no line break between a figure and its unit."""
    bound = re.sub(r"(?<=\d) (?=%|(K|mag|mm)\b)", "\N{NO-BREAK SPACE}", finding)

    def wrapped(columns: int) -> list[str]:
        return textwrap.wrap(bound, columns, break_on_hyphens=False)

    count = len(wrapped(TITLE_COLUMNS))
    narrowest = next(w for w in range(len(bound) // count, TITLE_COLUMNS + 1) if len(wrapped(w)) == count)
    return "\n".join(wrapped(narrowest))


def plain_ticks(axis: Axis, values: Sequence[float]) -> None:
    """Ticks of a logarithmic axis as a person writes them: 3000, not 3 x 10^3."""
    axis.set_ticks(values, labels=[f"{value:g}" for value in values])
    axis.set_ticks([], minor=True)


def save(figure: Any, path: Path) -> None:
    """Write a figure. Raises InputError where it cannot be written."""
    with whole_file(path) as part:
        figure.savefig(part, dpi=110)
