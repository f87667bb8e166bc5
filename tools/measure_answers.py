"""The errors of the chain's choices on panels of 8, 10 and 12 bits: `python
tools/measure_answers.py`, about five minutes.

Writes results/chain.csv and results/chain_budget.csv, from which `python results/tables.py` makes
the table of answers at the head of docs/accuracy-speed.md. The bench is configs/demo.toml. No
machine changes errors, so no times are measured here: those of the page are of the machine of
results/machine.txt.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import astuple, fields, replace
from pathlib import Path

from msgspec import structs

from hilstar.basics.charts import write_csv, write_records
from hilstar.basics.resources import resource_path
from hilstar.instruments.study.chain.choices import Parts, five_scenes
from hilstar.instruments.study.chain.measuring import (
    CombinationRow,
    ErrorPart,
    Rounds,
    SceneMeasurement,
    error_budget,
)
from hilstar.instruments.study.chain.tracker import StudyTracker
from hilstar.server.bench.bench_file import BenchFile, read_bench_file

RESULTS = Path(__file__).parents[1] / "results"
BITS = (8, 10, 12)
SCENES = ("average field", "1 deg/s", "10 deg/s")


def bench_of(bits: int) -> BenchFile:
    """The demo's bench with a panel of so many bits."""
    file = read_bench_file(resource_path("configs", "demo.toml"))
    monitor = structs.replace(file.config.monitor, bits=bits)
    return replace(file, config=structs.replace(file.config, monitor=monitor))


def measured(bits: int) -> Iterator[tuple[list[CombinationRow], list[ErrorPart]]]:
    """The rows and the error budget of each scene on a panel of so many bits."""
    with Parts(bench_of(bits)) as parts, StudyTracker(parts.own) as tracker:
        for scene in five_scenes(parts.own):
            if scene.name in SCENES:
                measurement = SceneMeasurement(parts, tracker, scene, Rounds())
                yield measurement.untimed(), error_budget(measurement, measurement.marks.auto)


def main() -> None:
    """Measure, and write both tables."""
    rows: list[CombinationRow] = []
    budget: list[tuple[object, ...]] = []
    for bits in BITS:
        for errors, parts in measured(bits):
            rows += errors
            budget += [(bits, *astuple(part)) for part in parts]
    write_records(RESULTS / "chain.csv", rows)
    write_csv(
        RESULTS / "chain_budget.csv", ("bits", *(field.name for field in fields(ErrorPart))), budget
    )


if __name__ == "__main__":
    main()
