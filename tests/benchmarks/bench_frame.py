"""`hilstar benchmark` at 1920 x 1080, 1000 stars or `--stars N`: `python -m
tests.benchmarks.bench_frame`.

On demand, never in CI.
"""

from __future__ import annotations

import argparse

import numpy as np

from hilstar.instruments.study.speed.benchmark import BenchmarkPlan, run
from hilstar.instruments.study.speed.report import REFERENCE_PX, lines


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--stars", type=int, default=1000)
    parser.add_argument("--rounds", type=int, default=300)
    options = parser.parse_args()
    plan = BenchmarkPlan(sizes=(REFERENCE_PX,), counts=(options.stars,), rounds=options.rounds)
    print("\n".join(lines(run(plan, np.random.default_rng(1), lambda done: None))))


if __name__ == "__main__":
    main()
