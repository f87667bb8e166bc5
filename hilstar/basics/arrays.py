"""Names for the array types that cross room borders, and columns more for a structured one."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
Float32Array = npt.NDArray[np.float32]
IntArray = npt.NDArray[np.intp]
BoolArray = npt.NDArray[np.bool_]


def with_columns(
    table: npt.NDArray[np.void], added: Mapping[str, npt.NDArray[Any]], rows: IntArray | None = None
) -> npt.NDArray[np.void]:
    """A table's rows (n,) with columns more, of values of all rows or of `rows` (k,); others have
    NaN or False.
    """
    where = np.arange(len(table)) if rows is None else rows
    wider = np.zeros(
        len(table),
        dtype=[*table.dtype.descr, *((name, values.dtype) for name, values in added.items())],
    )
    for name in table.dtype.names or ():
        wider[name] = table[name]
    for name, values in added.items():
        wider[name] = False if values.dtype == np.bool_ else np.nan
        wider[name][where] = values
    return wider
