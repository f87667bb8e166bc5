"""A frame through a measured lens with a field of degree 6 against one through a pinhole, in turn.

`python -m tests.benchmarks.bench_lens [--stars N] [--rounds N]`. On demand, never in CI.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from hilstar.bench.build import open_bench
from hilstar.bench.frame import Bench
from hilstar.rotation import from_radec_roll_deg
from hilstar.scene.camera import bounded
from hilstar.scene.lens import Lens, ResidualField
from hilstar.study.speed.benchmark import RADEC_ROLL_DEG, own_bench_file
from hilstar.study.speed.result import REFERENCE_PX
from hilstar.study.speed.scenes import scene

DEGREE, TERMS = 6, 28
MARGIN_PX = 10.0
RATE_RAD_S = np.array([0.1, -0.2, 0.05])


def with_lens(bench: Bench) -> Bench:
    """The same bench behind a lens with every term."""
    x, y = np.random.default_rng(2).normal(0, 0.3, (2, TERMS))
    field = ResidualField.of_terms(x, y, DEGREE, bench.camera.resolution_px)
    lens = Lens((0.6, -1.0, 2.0), (1e-3, -1e-3), (0.017, -0.01), field)
    return replace(bench, camera=bounded(replace(bench.camera, lens=lens), MARGIN_PX))


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--stars", type=int, default=1000)
    parser.add_argument("--rounds", type=int, default=200)
    options = parser.parse_args()
    q = from_radec_roll_deg(*RADEC_ROLL_DEG)
    with (
        TemporaryDirectory() as folder,
        open_bench(own_bench_file(Path(folder) / "bench.toml", REFERENCE_PX, motion="on")) as bench,
    ):
        pinhole = bench.with_stars(scene(bench, bench.shown_stars, q, options.stars, np.random.default_rng(1)).stars)
        benches = {"pinhole": pinhole, "lens": with_lens(pinhole)}
        kinds = [(name, rate) for rate in (None, RATE_RAD_S) for name in benches]
        times_ms: dict[tuple[str, bool], list[float]] = {(name, rate is None): [] for name, rate in kinds}
        for number in range(options.rounds + 5):
            for name, rate in kinds:
                begin = time.perf_counter()
                drawn = benches[name].draw(q, number, rate)
                _ = drawn.levels
                if number >= 5:
                    times_ms[name, rate is None].append((time.perf_counter() - begin) * 1e3)
    for still, words in ((True, "still"), (False, "turning")):
        ideal, bent = (float(np.median(times_ms[name, still])) for name in benches)
        print(f"{words:8} pinhole {ideal:6.2f} ms, lens {bent:6.2f} ms: {bent - ideal:+.2f} ms, {bent / ideal:.3f} x")


if __name__ == "__main__":
    main()
