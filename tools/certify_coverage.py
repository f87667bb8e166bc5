"""Count how often certificates of planted benches hold the truth: `python tools/certify_coverage.py [BENCHES] [SEED] [LEVELS]`.

Each bench is drawn apart from certify's code (tests/support/planted_certify.py) and certified as the command does, by its
readings; the truth is the file that it was drawn into. With LEVELS, so many codes are read, each as often as `repeats`.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tests.support.planted_certify import coverage


def main() -> None:
    """Print the counts."""
    benches, seed, levels = (int(word) for word in [*sys.argv[1:], *("40", "1", "0")[len(sys.argv) - 1 :]])
    for (quantity, region), held in sorted(coverage(benches, seed, f"levels = {levels}\n" if levels else "").items()):
        print(f"{quantity:14}{region:14}{sum(held):7} of {len(held):7}  {100 * sum(held) / len(held):.1f} %")


if __name__ == "__main__":
    main()
