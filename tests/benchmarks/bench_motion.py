"""A turning frame against a still one, in turn: `python -m tests.benchmarks.bench_motion [--stars
N]`.

On demand, never in CI.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from hilstar.basics.rotation import from_radec_roll_deg
from hilstar.instruments.study.speed.benchmark import RADEC_ROLL_DEG, own_bench_file, scene
from hilstar.instruments.study.speed.report import REFERENCE_PX
from hilstar.server.bench.build import open_bench

RATES_RAD_S = (0.0, 0.002, 0.0087, 0.035, 0.1, 0.35, 1.0, 10.0, 57.0, 900.0, 1e6)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--stars", type=int, default=1000)
    parser.add_argument("--rounds", type=int, default=60)
    options = parser.parse_args()
    q = from_radec_roll_deg(*RADEC_ROLL_DEG)
    axis = np.array([0.6, -0.7, 0.2]) / np.linalg.norm([0.6, -0.7, 0.2])
    with (
        TemporaryDirectory() as folder,
        open_bench(own_bench_file(Path(folder) / "bench.toml", REFERENCE_PX, motion="on")) as bench,
    ):
        bench = bench.with_stars(
            scene(bench, bench.shown_stars, q, options.stars, np.random.default_rng(1)).stars
        )
        times_ms: dict[float, list[float]] = {rate: [] for rate in RATES_RAD_S}
        told: dict[float, str] = {}
        for number in range(options.rounds):
            for rate in RATES_RAD_S:
                begin = time.perf_counter()
                drawn = bench.draw(q, number, rate * axis)
                _ = drawn.levels
                times_ms[rate].append((time.perf_counter() - begin) * 1e3)
                told[rate] = f"{drawn.star_count:6} stars, {drawn.capped:6} capped"
    still = float(np.median(times_ms[0.0]))
    for rate, each in times_ms.items():
        median = float(np.median(each))
        print(f"{rate:10g} rad/s  {median:8.2f} ms  {median / still:6.2f} x still   {told[rate]}")


if __name__ == "__main__":
    main()
