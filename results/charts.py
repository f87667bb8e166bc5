"""Charts of docs/ whose figures are times, redrawn from the CSV files beside this script: `python results/charts.py`.

Measuring needs an idle machine, drawing does not. The other charts of docs/ are written by the commands that their pages name.
"""

from __future__ import annotations

from pathlib import Path

from hilstar.charts import read_records
from hilstar.study.timing import run as timing

HERE = Path(__file__).parent
DOCS = HERE.parent / "docs"


if __name__ == "__main__":
    timing.draw(DOCS / "timing.svg", read_records(HERE / "timing.csv", timing.Outcome))
