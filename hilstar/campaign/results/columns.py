"""A campaign's table as arrays, of as many cases as a figure needs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.errors import InputError

MAX_CASES = 50_000  # that figures are made from; of a larger table evenly many from each part
VARY = "vary."


@dataclass(frozen=True)
class Columns:
    """Columns (n,) by name: numbers as float64 with NaN where there are none, and text. `cases` counts the whole table's."""

    cases: int
    numbers: dict[str, FloatArray]
    texts: dict[str, list[str]]

    @property
    def varied(self) -> list[str]:
        """The names of the varied columns."""
        return [name for name in (*self.numbers, *self.texts) if name.startswith(VARY)]

    def vectors(self, form: str, names: str) -> FloatArray:
        """Columns (n, k) side by side: `form` with each of `names` in it."""
        return np.stack([self.numbers[form.format(name)] for name in names], axis=1)


def read_cases(path: Path, max_cases: int = MAX_CASES) -> Columns:
    """A campaign's table. Raises InputError where it is none."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    numbers: dict[str, list[FloatArray]] = {}
    texts: dict[str, list[str]] = {}
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
                else:
                    values = np.array([np.nan if v is None else float(v) for v in column.to_pylist()])
                    numbers.setdefault(name, []).append(values)
        return Columns(file.metadata.num_rows, {name: np.concatenate(parts) for name, parts in numbers.items()}, texts)
    except (OSError, pa.ArrowException, ValueError) as error:
        raise InputError(f"{path}: is no table of a campaign ({error}); delete it, and run the same command again") from error
