"""Count how often certificates of planted benches hold the truth: `python tools/certify_coverage.py [BENCHES] [SEED] [LEVELS]`.

Each bench is drawn apart from certify's code (tests/support/planted_certify.py) and certified as the command does, by its
readings; the truth is the file that it was drawn into. With LEVELS, so many codes are read, each as often as `repeats`.
"""

from __future__ import annotations

import datetime
import sys
from collections import defaultdict
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from hilstar.bench.bench_file import read_bench_file
from hilstar.certify.certificate import certify
from hilstar.certify.readings import VirtualReader
from tests.support.planted_certify import drawn, plant

NOW = datetime.datetime(2026, 11, 26, tzinfo=datetime.UTC)


def coverage(benches: int, seed: int, keys: str = "") -> dict[tuple[str, str], list[bool]]:
    """By quantity and region, whether each stated interval holds the truth."""
    rng, held = np.random.default_rng(seed), defaultdict(list)
    with TemporaryDirectory() as folder:
        for number in range(benches):
            paths = plant(Path(folder), drawn(rng), f"[certify]\nfields = 1\n{keys}")
            bench, truth = (read_bench_file(path) for path in paths)
            found, _ = certify(bench, VirtualReader(bench, truth, number), NOW, quick=True)
            for each in found.figures:
                if each.truth is not None:
                    region = "field" if each.region.startswith("field") else each.region
                    held[each.quantity, region].append(each.lower <= each.truth <= each.upper)
    return dict(held)


def main() -> None:
    """Print the counts."""
    benches, seed, levels = (int(word) for word in [*sys.argv[1:], *("40", "1", "0")[len(sys.argv) - 1 :]])
    for (quantity, region), held in sorted(coverage(benches, seed, f"levels = {levels}\n" if levels else "").items()):
        print(f"{quantity:14}{region:14}{sum(held):7} of {len(held):7}  {100 * sum(held) / len(held):.1f} %")


if __name__ == "__main__":
    main()
