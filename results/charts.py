"""Charts of docs/ whose figures are times, redrawn from the CSV files beside this script: `python
results/charts.py`.

Measuring needs an idle machine, drawing does not. The other charts of docs/ are written by the
commands that their pages name.
"""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any, get_type_hints

from hilstar.basics.charts import BLUE, GREEN, ORANGE, PURPLE, RED, TEAL, chart, value_bars
from hilstar.instruments.study import codes, colour, timing
from hilstar.instruments.study.sweep import Load
from hilstar.instruments.study.tradeoff.light import ROUNDING_MAG
from hilstar.instruments.study.trials import Figure, Trial, Trials, draw_trials

HERE = Path(__file__).parent
DOCS = HERE.parent / "docs"
MACHINE = "llvmpipe (LLVM 15.0.6, 256 bits), 2 cores"  # as machine.txt has it
TRADEOFF_STEP = "psf"
TRUE = "True"
IDLE = Load()  # machine.txt: nothing else was running


def tradeoff_step(name: str) -> Trials:
    """A step of tradeoff.csv as the study measured it, whose errors below ROUNDING_MAG are none."""
    with (HERE / "tradeoff.csv").open(encoding="utf-8", newline="") as file:
        table = [row for row in csv.DictReader(file) if row["step"] == name]
    error, second = (
        Figure(table[0][f"{key}_is"], table[0][f"{key}_unit"], ROUNDING_MAG)
        for key in ("error", "second")
    )
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


def draw_scale(rows: list[dict[str, str]]) -> None:
    """Six panels of scale.csv: what grows with stars, pixels, workers, packets a second and
    hours, and where it bends.
    """

    def points(axis: str, column: str) -> tuple[list[float], list[float]]:
        own = [row for row in rows if row["axis"] == axis]
        return [float(row["at"]) for row in own], [float(row[column]) for row in own]

    case_s = points("workers", "time")[1][0] / 1e3
    cores = [1.0, 2.0, 10.0, 30.0, 100.0, 300.0, 1000.0]
    # docs/campaign.md: a task takes the scheduler 3.3 ms and the command 1.8 ms, and a row the
    # command 60 us
    paper: dict[str, list[float]] = {"1 s": [], "20 ms a core": []}
    for count in cores:
        for words, seconds in (("1 s", 1.0), ("20 ms a core", max(1.0, 0.02 * count))):
            limits = (
                count / case_s,
                seconds / case_s / 3.3e-3,
                1 / (60e-6 + 1.8e-3 * case_s / seconds),
            )
            paper[words].append(min(limits))
    title = (
        "Frames grow with stars up to the cap on pixels, reports with hours; one scheduler feeds"
        " 1000 cores by longer tasks"
    )
    with chart(DOCS / "scale.svg", title, 3, 2, share_x=False) as panels:
        stars, pixels, memory, workers, packets, hours = panels
        stars.plot(*points("stars", "time"), "o-", color=RED)
        stars.axvline(250_000, color=BLUE, ls=":", label="only the brightest are drawn")
        stars.set(
            title="a frame, 1920 x 1080", xlabel="stars in view", ylabel="processor time [ms]"
        )
        pixels.plot(*points("pixels", "time"), "o-", color=RED)
        pixels.set(
            title="a frame of 1000 stars, VGA to 8K", xlabel="pixels", ylabel="processor time [ms]"
        )
        for axis, colour in (("stars", PURPLE), ("pixels", TEAL)):
            memory.plot(*points(axis, "memory_mb"), "o-", color=colour, label=f"against {axis}")
        memory.set(
            title="peak of a process's memory", xlabel="stars, or pixels", ylabel="MB", xscale="log"
        )
        for (words, rate), colour in zip(paper.items(), (ORANGE, GREEN), strict=True):
            workers.plot(cores, rate, "-", color=colour, label=f"on paper, tasks of {words}")
        at, ms = points("workers", "time")
        workers.plot(
            at,
            [n / case * 1e3 for n, case in zip(at, ms, strict=True)],
            "o",
            color=RED,
            label="measured",
        )
        workers.set(title="a campaign's cases", xlabel="workers", ylabel="cases a second")
        packets.plot(*points("packets", "time"), "o-", color=RED)
        packets.set(
            title="serve, 640 x 480 at 60 Hz",
            xlabel="packets a second",
            ylabel="of a core [%]",
            xscale="log",
        )
        at, ms = points("hours", "time")
        hours.plot(at, [value / 1e3 for value in ms], "o-", color=RED)
        memory_mb = points("hours", "memory_mb")[1]
        hours.set(
            title=f"report, in {min(memory_mb):.0f} to {max(memory_mb):.0f} MB",
            xlabel="hours, at 60 frames and packets a second",
            ylabel="processor time [s]",
        )
        for axes in (stars, pixels, workers, hours):
            axes.set(xscale="log", yscale="log")
        for axes in (stars, memory, workers):
            axes.legend(
                fontsize="small", loc="upper left" if axes in (stars, memory) else "lower right"
            )
        packets.set_ylim(bottom=0)
        memory.set_ylim(bottom=0)


def draw_tracker(rows: list[dict[str, str]]) -> None:
    """The rows of tracker.csv: each work by hilstar and beside it its peers."""
    colours = {"hilstar": RED, "numpy": BLUE, "galsim": GREEN, "photutils": PURPLE, "sep": ORANGE}
    names = [f"{row['kind'].replace('_', ' ')}, {row['method']}" for row in rows]
    ms = [float(row["median_ms"]) for row in rows]
    own = {row["kind"]: float(row["median_ms"]) for row in rows if row["method"] == "hilstar"}
    finding = (
        f"The virtual tracker takes {own['exposure']:.0f} ms for an exposure, {own['case']:.0f} ms"
        " for a campaign's case"
    )
    note = (
        "Medians of processor time, ms, in turn. 1024 x 1024 px of the demo's tracker, all noise;"
        " peers have hilstar's expected image or DN. verify: one field. First frame: a process from"
        " exec to its end, 1920 x 1080."
    )
    with chart(DOCS / "tracker_speed.svg", finding, note=note, height_inch=3.6) as (axes,):
        value_bars(axes, names, ms, [colours[row["method"]] for row in rows])


def rows_of(name: str) -> list[dict[str, str]]:
    """The rows of a CSV file here."""
    with (HERE / name).open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def read_records(path: Path, record: type[Any]) -> list[Any]:
    """The rows of a study's table as its dataclasses of texts, numbers and flags."""
    convert = {
        name: "True".__eq__ if kind is bool else kind
        for name, kind in get_type_hints(record).items()
    }
    with path.open(encoding="utf-8", newline="") as file:
        return [
            record(**{name: convert[name](text) for name, text in row.items()})
            for row in csv.DictReader(file)
        ]


if __name__ == "__main__":
    draw_scale(rows_of("scale.csv"))
    draw_tracker(rows_of("tracker.csv"))
    colour_choices = read_records(HERE / "colour.csv", colour.ColourChoice)
    colour.draw(DOCS / "colour.svg", colour_choices, IDLE)
    timing.draw(DOCS / "timing.svg", read_records(HERE / "timing.csv", timing.TimingOutcome), IDLE)
    timing.draw_stripes(
        DOCS / "stripes.svg", read_records(HERE / "stripes.csv", timing.StripePoint)
    )
    codes.draw(DOCS / "over_frames.svg", read_records(HERE / "over_frames.csv", codes.OverFrames))
    draw_trials(DOCS / "tradeoff.svg", tradeoff_step(TRADEOFF_STEP), MACHINE)
