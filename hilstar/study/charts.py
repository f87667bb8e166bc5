"""How studies write: one style of figure, whose title is its finding, and the table behind it."""

from __future__ import annotations

import csv
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hilstar.errors import InputError

if TYPE_CHECKING:
    from matplotlib.axes import Axes

INCH = (9.0, 5.4)  # of one panel
TITLE_COLUMNS = 95
STYLE: Any = {"font.size": 11, "axes.grid": True, "grid.alpha": 0.3, "legend.frameon": False, "lines.linewidth": 1.8}


def write_csv(path: Path, columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """A table with a header. Raises InputError where it cannot be written."""
    try:
        with path.open("w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(columns)
            writer.writerows(rows)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); choose another place") from error


@contextmanager
def chart(path: Path, finding: str, panels: int = 1) -> Iterator[list[Axes]]:
    """A PNG with `panels` side by side, titled by its finding; draw on the axes that it yields."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    with pyplot.rc_context(STYLE):
        figure, grid = pyplot.subplots(1, panels, figsize=(INCH[0] * (1 + 0.6 * (panels - 1)), INCH[1]), squeeze=False)
        try:
            yield list(grid[0])
            figure.suptitle("\n".join(textwrap.wrap(finding, round(TITLE_COLUMNS * (0.5 + 0.5 * panels)))), fontsize=12)
            figure.tight_layout()
            save(figure, path)
        finally:
            pyplot.close(figure)


def save(figure: Any, path: Path) -> None:
    """Write a figure. Raises InputError where it cannot be written."""
    try:
        figure.savefig(path, dpi=110)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); choose another place") from error
