"""Writes hilstar/instruments/study/stability/*.csv: the figures of failing methods that no machine
changes.

Run without arguments.

The cases and curves are those of tests/authority/failing_methods, which hold them with every
commit.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from hilstar.basics.charts import write_csv  # noqa: E402
from hilstar.instruments.study.stability import COLUMNS  # noqa: E402
from tests.authority.failing_methods import (  # noqa: E402
    CATALOGUE_AND_GEOMETRY,
    CURVES,
    DETECTOR_AND_ATTITUDE,
)

OUTPUT = ROOT / "hilstar" / "instruments" / "study" / "stability"

if __name__ == "__main__":
    for name, cases in (
        ("catalogue_and_geometry", CATALOGUE_AND_GEOMETRY),
        ("detector_and_attitude", DETECTOR_AND_ATTITUDE),
    ):
        write_csv(OUTPUT / f"{name}.csv", COLUMNS, [measure().row() for measure in cases])
    for name, curve in CURVES.items():
        columns = curve()
        write_csv(
            OUTPUT / f"{name}.csv", tuple(columns), np.column_stack(list(columns.values())).tolist()
        )
