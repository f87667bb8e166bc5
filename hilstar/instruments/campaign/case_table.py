"""A campaign's table as columns: numbers, texts and lists of all cases, or of an even share."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError

MAX_READ_CASES = 50_000  # cases read for the figures, spread evenly over a larger table
VARY = "vary."


@dataclass(frozen=True)
class Columns:
    """Columns (n,) by name: numbers as float64 with NaN where there are none, text, and lists of
    numbers (k,). `cases` counts the whole table's.
    """

    cases: int
    numbers: dict[str, FloatArray]
    texts: dict[str, list[str]]
    lists: dict[str, list[FloatArray]] = field(default_factory=dict)

    @property
    def varied(self) -> list[str]:
        """The names of the varied columns."""
        return [name for name in (*self.numbers, *self.texts) if name.startswith(VARY)]

    def some(self, chosen: npt.NDArray[np.bool_]) -> "Columns":
        """The chosen (n,) cases alone."""
        rows = np.flatnonzero(chosen).tolist()
        numbers = {name: column[chosen] for name, column in self.numbers.items()}
        texts: dict[str, list[str]] = {}
        for name, column_texts in self.texts.items():
            texts[name] = [column_texts[row] for row in rows]
        lists: dict[str, list[FloatArray]] = {}
        for name, values in self.lists.items():
            lists[name] = [values[row] for row in rows]
        return Columns(self.cases, numbers, texts, lists)

    def vectors(self, form: str, names: str) -> FloatArray:
        """Columns (n, k) side by side: `form` with each of `names` in it."""
        return np.stack([self.numbers[form.format(name)] for name in names], axis=1)


def read_cases(path: Path, max_cases: int = MAX_READ_CASES) -> Columns:
    """A campaign's table, or an even share of its cases. Raises InputError for another file."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    numbers: dict[str, list[FloatArray]] = {}
    texts: dict[str, list[str]] = {}
    lists: dict[str, list[FloatArray]] = {}
    try:
        file = pq.ParquetFile(path)
        step = -(-file.metadata.num_rows // max_cases) or 1
        for group in range(file.num_row_groups):
            table = file.read_row_group(group)
            table = table.take(pa.array(np.arange(0, table.num_rows, step)))
            for name in table.column_names:
                column: Any = table.column(name)
                if pa.types.is_string(column.type):
                    texts.setdefault(name, []).extend(value or "" for value in column.to_pylist())
                elif pa.types.is_list(column.type):
                    for values in column.to_pylist():
                        row = np.array(values or [], dtype=np.float64)
                        lists.setdefault(name, []).append(row)
                else:
                    numbers.setdefault(name, []).append(_floats(column.to_pylist()))
        return Columns(
            file.metadata.num_rows,
            {name: np.concatenate(parts) for name, parts in numbers.items()},
            texts,
            lists,
        )
    except (OSError, pa.ArrowException, ValueError) as error:
        raise InputError(
            f"{path}: is no table of a campaign ({error}); delete it, and run the same command"
            " again"
        ) from error


def _floats(values: list[Any]) -> FloatArray:
    """Numbers (n,), NaN for None."""
    numbers = np.full(len(values), np.nan)
    for row, value in enumerate(values):
        if value is not None:
            numbers[row] = value
    return numbers
