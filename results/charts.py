"""Charts of docs/ whose figures are times, redrawn from the CSV files beside this script: `python results/charts.py`.

Measuring needs an idle machine, drawing does not. The other charts of docs/ are written by the commands that their pages name.
"""

from __future__ import annotations

import csv
from pathlib import Path

from hilstar.charts import read_records
from hilstar.study import codes, colour, stripes, timing
from hilstar.study.sweep import Figure, Trial, Trials
from hilstar.study.tradeoff import run as tradeoff
from hilstar.study.tradeoff.light import ROUNDING_MAG

HERE = Path(__file__).parent
DOCS = HERE.parent / "docs"
MACHINE = "llvmpipe (LLVM 15.0.6, 256 bits), 2 cores"  # as machine.txt has it
TRADEOFF_STEP = "psf"
TRUE = "True"


def tradeoff_step(name: str) -> Trials:
    """A step of tradeoff.csv as the study measured it, whose errors below ROUNDING_MAG are none."""
    with (HERE / "tradeoff.csv").open(encoding="utf-8", newline="") as file:
        table = [row for row in csv.DictReader(file) if row["step"] == name]
    error, second = (Figure(table[0][f"{key}_is"], table[0][f"{key}_unit"], ROUNDING_MAG) for key in ("error", "second"))
    trials = [
        Trial(
            row["method"],
            float(row["error"]),
            float(row["second"]),
            lambda: None,
            row["default"] == TRUE,
            row["exact"] == TRUE,
            time_ms=float(row["time_ms"]),
            quartiles_ms=(float(row["quartile_1_ms"]), float(row["quartile_3_ms"])),
            on_front=row["front"] == TRUE,
        )
        for row in table
    ]
    return Trials(name, table[0]["work"], error, second, "", trials)


def colour_rows() -> list[tuple[str | float, ...]]:
    """The rows of colour.csv: three names, then figures."""
    with (HERE / "colour.csv").open(encoding="utf-8", newline="") as file:
        return [(*row[:3], *map(float, row[3:])) for row in list(csv.reader(file))[1:]]


if __name__ == "__main__":
    colour.draw(DOCS / "colour.svg", colour_rows())
    timing.draw(DOCS / "timing.svg", read_records(HERE / "timing.csv", timing.TimingOutcome))
    stripes.draw(DOCS / "stripes.svg", read_records(HERE / "stripes.csv", stripes.StripePoint))
    codes.draw(DOCS / "over_frames.svg", read_records(HERE / "over_frames.csv", codes.OverFrames))
    tradeoff.draw(DOCS / "tradeoff.svg", tradeoff_step(TRADEOFF_STEP), MACHINE)
