"""Count how often certificates of planted benches hold the truth, and how long their intervals are.

`python tools/certify_coverage.py BENCHES [KIND] [-o FILE.csv] [--seed S] [--levels N]`: all kinds,
or one (`images` draws each image: 15 s a bench).

Each bench is drawn, and read, by code apart from certify's (tests/support/planted_readings.py), and
certified as the
command does by its readings. A row is a figure of a kind: how many of its intervals held the truth,
three binomial sigmas about that for as many benches, the median ratio of the stated uncertainty to
the true error, and in how many benches it was not assessed.
"""

from __future__ import annotations

import argparse
import csv
import math
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tests.support.planted_certify import (
    EXACT_LENS,
    Counted,
    coverage,
    coverage_by_images,
    stated_directions,
    stated_lens,
)
from tests.support.planted_readings import KINDS

IMAGES = "images"
UNSTATED = "tracker's own lens, not stated"
OWN_LENS = "tracker's own lens"
STATED = {
    OWN_LENS: stated_lens(),
    "tracker's own directions": stated_directions(),
    UNSTATED: "",
}
SIGMAS = 3.0
COLUMNS = (
    "kind",
    "quantity",
    "region",
    "benches",
    "not_assessed",
    "held_percent",
    "low_percent",
    "high_percent",
    "ratio",
)


def interval(share: float, count: int) -> tuple[float, float]:
    """Three sigmas about a share of `count` trials (Wilson 1927)."""
    middle = (share + SIGMAS**2 / (2 * count)) / (1 + SIGMAS**2 / count)
    half = (
        SIGMAS
        * math.sqrt(share * (1 - share) / count + SIGMAS**2 / (4 * count**2))
        / (1 + SIGMAS**2 / count)
    )
    return middle - half, middle + half


def rows_of(kind: str, benches: int, found: dict[tuple[str, str], Counted]) -> list[list[object]]:
    """The rows of a kind."""
    rows: list[list[object]] = []
    for (quantity, region), one in sorted(found.items()):
        if not one.held:
            rows.append([kind, quantity, region, benches, one.absent, "", "", "", ""])
            continue
        share = sum(one.held) / len(one.held)
        # Figures of one bench go nearly together: there are as many trials as benches.
        low, high = interval(share, benches - one.absent)
        figures = [f"{100 * each:.1f}" for each in (share, low, high)]
        rows.append([kind, quantity, region, benches, one.absent, *figures, f"{one.ratio:.2f}"])
    return rows


def main() -> None:
    """Print the counts, and write them as CSV."""
    names = [*KINDS, UNSTATED, IMAGES]
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("benches", type=int)
    parser.add_argument("kind", nargs="?", choices=names)
    parser.add_argument("-o", "--output", type=Path)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--levels", type=int, help="codes that are read")
    asked = parser.parse_args()
    keys = "" if asked.levels is None else f"levels = {asked.levels}\n"
    rows: list[list[object]] = []
    for kind in [asked.kind] if asked.kind else [name for name in names if name != IMAGES]:
        started = time.process_time()
        if kind == IMAGES:
            found = coverage_by_images(asked.benches, asked.seed)
        else:
            draw = KINDS[OWN_LENS if kind == UNSTATED else kind]
            tables = STATED.get(kind, EXACT_LENS)
            found = coverage(draw, asked.benches, asked.seed, keys, tables)
        print(
            f"{kind}: {(time.process_time() - started) / asked.benches:.2f} s of CPU a bench",
            flush=True,
        )
        new = rows_of(kind, asked.benches, found)
        for row in new:
            print(
                f"  {row[1]:14}{row[2]:14}{row[5]:>6} % ({row[6]} to {row[7]}), ratio {row[8]}, not"
                f" assessed {row[4]}",
                flush=True,
            )
        rows += new
        if asked.output is not None:
            with asked.output.open("w", newline="") as out:
                csv.writer(out, lineterminator="\n").writerows([COLUMNS, *rows])


if __name__ == "__main__":
    main()
