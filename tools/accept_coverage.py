"""Count the verdicts of acceptances of a healthy virtual tracker, and how often intervals hold the
truth.

`python tools/accept_coverage.py RUNS -o FILE.csv [--seed S] [--bench FILE] [--plan FILE] [--whole]
[--keep DIR]` runs the plan's acceptance RUNS times in this process, by the seeds from S on, with
its cases of --quick unless --whole. FILE.csv has a row for each clause of each run, written after
the run; seeds that it has are left out, so the same command goes on where it was. DIR keeps the
cases, so that another FILE.csv judges them again, as after a change of the figures.

A healthy tracker's verdict is false where it is "not met". A harder count needs no limit: how often
the whole interval lies beyond the truth (the tracker would be accused, were its limit the truth)
and how often before it (it would be excused). Each may happen in 5 % of runs at 95 %. The truth is
TRUTHS where a healthy tracker's is known, else the figure of all runs together.
"""

from __future__ import annotations

import argparse
import csv
import math
import re
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from hilstar.instruments.assess.bounded_figures import clopper_pearson
from hilstar.instruments.campaign.acceptance import Acceptance
from hilstar.instruments.campaign.acceptance_plan import plan_path, read_acceptance_plan
from hilstar.instruments.campaign.acceptance_verdicts import ClauseVerdict
from hilstar.instruments.campaign.requirements import MET, NOT_MET, NOT_SHOWN
from tests.support.acceptance import run_here, write_bench

CONFIDENCE = 0.975  # of each end of a count's interval
SEED_LINE = re.compile(r"^seed = \d+$", re.MULTILINE)
COLUMNS = (
    *("seed", "capability", "quantity", "axis", "side", "limit"),
    *("verdict", "value", "low", "high", "cases"),
)
# of a tracker that adds nothing to what is lit, whose answers are of their exposure's middle; a
# rate is that of two attitudes 0.2 s apart, half a step old
TRUTHS = {
    "availability": 1.0,
    "false-attitude": 0.0,
    "no-attitude": 0.0,
    "rate-bias": 0.0,
    "rate-scale": 0.0,
    "rate-lag": 0.1,
    "time-bias": 0.0,
    "aberration": 0.0,
    "proper-motion": 0.0,
    "catalogue-age": 0.0,
    "parallax": 0.0,
    "star-colour": 0.0,
}
SIZES = ("bias",)  # a size of several axes, which runs do not tell by their mean
SIGMAS = ("nea", "rate-noise", "star-noise")


@dataclass(frozen=True, slots=True)
class ClauseCount:
    """The verdicts of a clause over runs, and how many of its intervals lie wholly on the side of
    the truth that accuses the tracker, or excuses it.
    """

    capability: str
    verdicts: list[str]
    truth: float
    accused: int
    excused: int


def accepted(plan: Path, bench: Path, folder: Path, seed: int, whole: bool) -> list[ClauseVerdict]:
    """The verdicts of an acceptance of a healthy tracker by this seed."""
    text, count = SEED_LINE.subn(f"seed = {seed}", plan.read_text())
    if count != 1:
        raise SystemExit(f"{plan}: has no line such as seed = 1")
    seeded = folder / "plan.toml"
    seeded.write_text(text)
    checked = read_acceptance_plan(seeded, bench, not whole, "tracker")
    acceptance = Acceptance(checked, bench, folder / "out", "centroids", 10.0)
    acceptance.check()
    (folder / "out").mkdir(exist_ok=True)
    return acceptance.verdicts(acceptance.run(run_here))


def rows_of(seed: int, verdicts: list[ClauseVerdict]) -> Iterator[list[str]]:
    """The rows of a run."""
    for judged in verdicts:
        clause = judged.clause
        side = "maximum" if clause.minimum is None else "minimum"
        row = [str(seed), clause.capability, clause.quantity, clause.axis or "", side]
        row += [f"{clause.limit:g}", judged.word]
        verdict = judged.verdict
        figures: tuple[float | None, ...] = (None, None, None, None)
        if verdict is not None:
            figures = (verdict.value, verdict.low, verdict.high, verdict.cases)
        yield [*row, *("" if figure is None else f"{figure:.9g}" for figure in figures)]


def numbers(rows: list[dict[str, str]], name: str, missing: float) -> np.ndarray:
    """A column (n,) of rows; `missing` where a row has no figure."""
    return np.array([float(row[name]) if row[name] else missing for row in rows])


def truth_of(quantity: str, values: np.ndarray) -> float:
    """What runs (n,) would tell, had they no errors; NaN where nobody knows."""
    if quantity in SIZES:
        return math.nan
    if quantity in TRUTHS:
        return TRUTHS[quantity]
    if quantity in SIGMAS:
        return math.sqrt(float(np.nanmean(values**2)))
    return float(np.nanmedian(values))


def counted(rows: list[dict[str, str]]) -> ClauseCount:
    """The count of a clause's rows, one of each run."""
    first = rows[0]
    truth = truth_of(first["quantity"], numbers(rows, "value", math.nan))
    above = int((numbers(rows, "low", -math.inf) > truth).sum())
    below = int((numbers(rows, "high", math.inf) < truth).sum())
    accused, excused = (above, below) if first["side"] == "maximum" else (below, above)
    verdicts = [row["verdict"] for row in rows]
    return ClauseCount(first["capability"], verdicts, truth, accused, excused)


def share_text(count: int, of: int) -> str:
    """A count with its interval, %."""
    low, high = clopper_pearson(count, of, CONFIDENCE)
    return f"{count} ({100 * low:.1f} to {100 * high:.1f} %)"


def lines_of(rows: list[dict[str, str]]) -> Iterator[str]:
    """A line for each clause, and one for all."""
    by_clause: dict[str, list[dict[str, str]]] = {}
    for row in rows:
        by_clause.setdefault(row["capability"], []).append(row)
    counts = [counted(some) for some in by_clause.values()]
    for count in counts:
        runs = len(count.verdicts)
        words = ", ".join(
            f"{count.verdicts.count(word)} {word}" for word in (MET, NOT_MET, NOT_SHOWN)
        )
        false = share_text(count.verdicts.count(NOT_MET), runs)
        yield f"{count.capability}: {runs} runs, {words}; false {false}; truth {count.truth:.4g},"
        yield f"    accused {share_text(count.accused, runs)}, excused {share_text(count.excused, runs)}"
    known = [count for count in counts if not math.isnan(count.truth)]
    trials = sum(len(count.verdicts) for count in known)
    everything = sum(len(count.verdicts) for count in counts)
    wrong = sum(count.verdicts.count(NOT_MET) for count in counts)
    accused = sum(count.accused for count in known)
    excused = sum(count.excused for count in known)
    yield f"all: {wrong} of {everything} verdicts false; of {trials} whose truth is known"
    yield f"    {accused} accused, {excused} excused"


def main() -> None:
    """Run what is missing, and print the counts."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("runs", type=int)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--bench", type=Path)
    parser.add_argument("--plan", type=Path, default=Path("ecss.toml"))
    parser.add_argument("--keep", type=Path, help="a directory for the cases")
    parser.add_argument("--whole", action="store_true", help="all cases, not those of --quick")
    asked = parser.parse_args()
    output: Path = asked.output
    if not output.exists():
        with output.open("w", newline="") as file:
            csv.writer(file, lineterminator="\n").writerow(COLUMNS)
    rows = read_rows(output)
    done = {int(row["seed"]) for row in rows}
    plan = plan_path(asked.plan)
    for seed in range(asked.seed, asked.seed + asked.runs):
        if seed in done:
            continue
        started_s = time.process_time()
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            if asked.keep is not None:
                folder = asked.keep / f"seed-{seed}"
                folder.mkdir(parents=True, exist_ok=True)
            bench = asked.bench or write_bench(folder)
            new = list(rows_of(seed, accepted(plan, bench, folder, seed, asked.whole)))
        with output.open("a", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows(new)
        print(f"seed {seed}: {time.process_time() - started_s:.1f} s of CPU", flush=True)
    print("\n".join(lines_of(read_rows(output))))


def read_rows(path: Path) -> list[dict[str, str]]:
    """The rows of a file."""
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


if __name__ == "__main__":
    main()
