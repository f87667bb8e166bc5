"""Try benches by chance from first light to an error budget: `python tools/any_bench.py --benches N
--seed S -o DIR`.

Each bench is drawn over what labs have, with a truth of which its bench file knows nothing
(tests/support/any_bench).
It goes through `first-light --virtual`, `verify`, `certify --quick`, 20 seconds of `serve
--headless` with a stream,
and `assess` of the virtual tracker's answers. DIR has a folder of each bench, any_bench.csv with a
row of each, any_bench_outcomes.csv with the columns that results/ keeps, and the chart. The smallest benches come first. The same command goes on where it was
stopped; a larger N adds benches.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from hilstar.basics.charts import BLUE, GREEN, MUTED, ORANGE, PURPLE, RED, TEAL, chart, write_csv
from tests.support.any_bench.draw import DrawnBench, drawn_bench
from tests.support.any_bench.judge import (
    BUSY,
    FAILED,
    GOOD_OUTCOMES,
    HEAVY,
    LATER,
    NOT_VERIFIED,
    OUTCOMES,
    REFUSED,
    TOO_WIDE,
    TRACEBACK,
    VERIFIED,
    WRONG,
)
from tests.support.any_bench.run import LIMIT_S, run_bench

HEAD, TABLE, CHART = "any_bench.json", "any_bench.csv", "any_bench"
# What results/tables.py takes, without the words of each step: results/any_bench.csv.
OUTCOME_TABLE = "any_bench_outcomes.csv"
OUTCOME_COLUMNS = (
    "bench",
    "outcome",
    "words",
    "pixel_ratio",
    "seen",
    "panel_kind",
    "panel_size_px",
    "panel_pitch_um",
    "panel_bits",
    "panel_law",
    "detector_size_px",
    "detector_pitch_um",
    "detector_focal_mm",
    "detector_psf_px",
    "collimator_mm",
    "focus_sigmas",
    "warm-up_sigmas",
    "geometry_sigmas",
    "uniformity_sigmas",
    "photometry_sigmas",
    "black_sigmas",
    "scale_sigmas",
    "latency_sigmas",
    "first-light_cpu_s",
    "memory_mb",
    "serve_missed",
    "serve_load",
)
COLOURS = {
    VERIFIED: GREEN,
    BUSY: GREEN,
    TOO_WIDE: BLUE,
    REFUSED: PURPLE,
    NOT_VERIFIED: TEAL,
    FAILED: ORANGE,
    LATER: MUTED,
    HEAVY: RED,
    WRONG: RED,
    TRACEBACK: RED,
}
MARKERS = {BUSY: "v", HEAVY: "s", WRONG: "X", TRACEBACK: "D"}


def main() -> None:
    """Run the benches that are missing, and write the table and the chart of all."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--benches",
        type=int,
        required=True,
        metavar="N",
        help="how many benches there are in the end",
    )
    parser.add_argument("--seed", type=int, default=0, metavar="S", help="seed of all benches")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR")
    parser.add_argument(
        "--limit",
        type=float,
        default=LIMIT_S,
        metavar="SECONDS",
        help="a command is stopped after so long",
    )
    parser.add_argument(
        "--keep", action="store_true", help="keep the sessions' images and the ledgers"
    )
    parser.add_argument(
        "--note",
        default="",
        metavar="TEXT",
        help="a sentence under the chart, such as what was tried",
    )
    given = parser.parse_args()
    output = given.output
    output.mkdir(parents=True, exist_ok=True)
    check_head(output / HEAD, given.seed)
    rows: list[dict[str, Any]] = []
    for number in sorted(
        range(given.benches), key=lambda number: pixels(drawn_bench(given.seed, number))
    ):
        row = run_bench(given.seed, number, output / f"{number:04}", given.limit, keep=given.keep)
        rows.append(row)
        rows.sort(key=lambda one: int(one["bench"]))
        write_table(output / TABLE, rows)
        write_table(output / OUTCOME_TABLE, [outcome_row(row) for row in rows])
        print(f"{number:4}  {row['outcome']}: {row['words']}"[:200], flush=True)
    draw(output / CHART, rows, given.note)
    for outcome in OUTCOMES:
        count = sum(row["outcome"] == outcome for row in rows)
        print(f"{outcome:28}{count}")


def pixels(bench: DrawnBench) -> int:
    """How many pixels a bench's commands go through: the smallest benches are run first."""
    (screen_w, screen_h), (width, height) = bench.panel.size_px, bench.detector.size_px
    return screen_w * screen_h + width * height


def check_head(path: Path, seed: int) -> None:
    """Refuse a folder whose benches are of another seed."""
    if path.exists() and (its := json.loads(path.read_text())["seed"]) != seed:
        sys.exit(f"{path.parent}: its benches are of seed {its}; write --seed {its}, or another -o")
    path.write_text(json.dumps({"seed": seed}))


def outcome_row(row: dict[str, Any]) -> dict[str, Any]:
    """The row of a bench for results/, its figures to six digits."""
    shown = {}
    for column in OUTCOME_COLUMNS:
        value = row.get(column)
        shown[column] = f"{value:.6g}" if isinstance(value, float) else value
    return shown


def write_table(path: Path, rows: list[dict[str, Any]]) -> None:
    """A row of each bench."""
    columns = list(dict.fromkeys(key for row in rows for key in row))
    write_csv(path, columns, [[row.get(key) for key in columns] for row in rows])


def draw(path: Path, rows: list[dict[str, Any]], note: str = "") -> None:
    """Ratio of pixels against the share of the screen that is seen, coloured by outcome."""
    good = sum(row["outcome"] in GOOD_OUTCOMES for row in rows)
    finding = (
        f"{good} of {len(rows)} benches by chance are calibrated and verified, or are refused for a"
        " reason"
    )
    note = f"{note} A share above 100 %: the tracker's field is larger than the screen.".strip()
    with chart(path, finding, height_inch=4.6, note=note) as (axes,):
        for outcome in OUTCOMES:
            those = [row for row in rows if row["outcome"] == outcome]
            if those:
                shares, ratios = (
                    [100 * row["seen"] for row in those],
                    [row["pixel_ratio"] for row in those],
                )
                label = f"{outcome} ({len(those)})"
                marker = MARKERS.get(outcome, "o")
                axes.plot(
                    shares,
                    ratios,
                    marker,
                    color=COLOURS[outcome],
                    label=label,
                    linestyle="none",
                    markersize=6,
                )
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xlabel("tracker's field, relative to the screen's [%]")
        axes.set_ylabel("side of a monitor pixel [tracker px]")
        axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))


if __name__ == "__main__":
    main()
