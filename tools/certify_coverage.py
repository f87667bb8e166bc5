"""Count how often certificates of planted benches hold the truth, and how long their intervals are.

`python tools/certify_coverage.py BENCHES [KIND] [-o FILE.csv] [--seed S] [--levels N]`: all kinds,
or one (`images` draws each image: 6 s a bench). A kind's rows in FILE.csv are replaced, every five
benches, and those of others stay.

Each bench is drawn, and read, by code apart from certify's (tests/support/planted_readings.py), and
certified as the command does by its readings. Only the figures that a kind moves are counted, as
its others are those of `as supposed`. A row is a figure of a kind: how many of its intervals held
the truth, three binomial sigmas about that for as many benches, the median ratio of the stated
uncertainty to the true error, in how many benches it was not assessed, and by which seed.
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
    DELAY,
    EXACT_LENS,
    LIGHT,
    PLACE,
    After,
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
OWN_DIRECTIONS = "tracker's own directions"
STATED = {OWN_LENS: stated_lens(), OWN_DIRECTIONS: stated_directions(), UNSTATED: ""}
ALL = (LIGHT, PLACE, DELAY)
MOVED = {
    "correlated in time": (LIGHT, DELAY),
    "correlated in place": (PLACE,),
    "uneven light": (LIGHT,),
    OWN_LENS: (PLACE,),
    OWN_DIRECTIONS: (PLACE,),
    UNSTATED: (PLACE,),
    "other response": (LIGHT,),
    "S-curve": (LIGHT,),
    "warming up": (LIGHT,),
    "pixels that talk": (LIGHT,),
}
NAMES = [*KINDS, UNSTATED, IMAGES]
WRITTEN_EVERY = 5  # benches, so that a run which is stopped has told something
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
    "seed",
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


def rows_of(
    kind: str, benches: int, seed: int, counts: dict[tuple[str, str], Counted]
) -> list[list[str]]:
    """The rows of a kind."""
    rows: list[list[str]] = []
    for (quantity, region), figure in sorted(counts.items()):
        assessed = benches - figure.absent
        cells = [kind, quantity, region, str(benches), str(figure.absent)]
        if figure.held:
            share = sum(figure.held) / len(figure.held)
            # Figures of one bench go nearly together: there are as many trials as benches.
            low, high = interval(share, assessed)
            cells += [f"{100 * percent:.1f}" for percent in (share, low, high)]
            cells.append(f"{figure.ratio:.2f}")
        else:
            cells += [""] * 4
        rows.append([*cells, str(seed)])
    return rows


def counted(
    kind: str, benches: int, seed: int, keys: str, after: After
) -> dict[tuple[str, str], Counted]:
    """Certify the benches of a kind, and count."""
    if kind == IMAGES:
        return coverage_by_images(benches, seed, after)
    draw = KINDS[OWN_LENS if kind == UNSTATED else kind]
    tables = STATED.get(kind, EXACT_LENS)
    return coverage(draw, benches, seed, keys, tables, MOVED.get(kind, ALL), after)


def written(path: Path) -> list[list[str]]:
    """The rows that a file has."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return list(csv.reader(file))[1:]


def write(path: Path | None, kind: str, rows: list[list[str]]) -> None:
    """Put the rows of a kind into a file, in the place of those that it has; None: no file."""
    if path is None:
        return
    rows = rows + [row for row in written(path) if row[0] != kind]
    rows.sort(key=lambda row: NAMES.index(row[0]))
    with path.open("w", newline="") as out:
        csv.writer(out, lineterminator="\n").writerows([COLUMNS, *rows])


def main() -> None:
    """Print the counts, and write them as CSV."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("benches", type=int)
    parser.add_argument("kind", nargs="?", choices=NAMES)
    parser.add_argument("-o", "--output", type=Path)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--levels", type=int, help="codes that are read")
    asked = parser.parse_args()
    keys = "" if asked.levels is None else f"levels = {asked.levels}\n"
    for kind in [asked.kind] if asked.kind else [name for name in NAMES if name != IMAGES]:
        started = time.process_time()

        def after(done: int, counts: dict[tuple[str, str], Counted], kind: str = kind) -> None:
            if done % WRITTEN_EVERY == 0:
                write(asked.output, kind, rows_of(kind, done, asked.seed, counts))

        counts = counted(kind, asked.benches, asked.seed, keys, after)
        rows = rows_of(kind, asked.benches, asked.seed, counts)
        seconds = (time.process_time() - started) / asked.benches
        print(f"{kind}: {seconds:.2f} s of CPU a bench", flush=True)
        for row in rows:
            print(
                f"  {row[1]:14}{row[2]:14}{row[5]:>6} % ({row[6]} to {row[7]}), ratio {row[8]}, not"
                f" assessed {row[4]}",
                flush=True,
            )
        write(asked.output, kind, rows)


if __name__ == "__main__":
    main()
