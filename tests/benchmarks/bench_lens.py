"""A frame through a measured lens with a field of degree 6 against one through a pinhole, in turn.

`python -m tests.benchmarks.bench_lens [--stars N] [--rounds N]`. On demand, never in CI. A lens
moves stars and stretches their paths, so that the two frames differ in what they draw: `sprites` is
what the lens itself costs.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.rotation import from_radec_roll_deg
from hilstar.instruments.study.speed.benchmark import RADEC_ROLL_DEG, own_bench_file, scene
from hilstar.instruments.study.speed.report import REFERENCE_PX
from hilstar.optics.camera import Lens, ResidualField, bounded
from hilstar.server.bench.build import open_bench
from hilstar.server.bench.frame import Bench

DEGREE, TERMS = 6, 28
MARGIN_PX = 10.0
AXIS = np.array([0.1, -0.2, 0.05]) / np.linalg.norm([0.1, -0.2, 0.05])
SPEEDS_DEG_S = (0.0, 1.0, 3.0, 13.0, 30.0)


def with_lens(bench: Bench) -> Bench:
    """The same bench behind a lens with every term."""
    x, y = np.random.default_rng(2).normal(0, 0.3, (2, TERMS))
    field = ResidualField.of_terms(x, y, DEGREE, bench.camera.resolution_px)
    lens = Lens((0.6, -1.0, 2.0), (1e-3, -1e-3), (0.017, -0.01), field)
    return replace(bench, camera=bounded(replace(bench.camera, lens=lens), MARGIN_PX))


def times_ms(
    bench: Bench, q: FloatArray, number: int, rate: FloatArray | None
) -> tuple[float, float, int]:
    """The time of a frame's sprites, of the whole frame, and the number of the sprites."""
    begin = time.perf_counter()
    sprites = bench.light(bench.view(q, rate))
    made = time.perf_counter()
    drawn = bench.draw_sprites(sprites, number)
    _ = drawn.levels
    return (
        (made - begin) * 1e3,
        (time.perf_counter() - begin) * 1e3,
        0 if sprites is None else len(sprites),
    )


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
        pinhole = bench.with_stars(
            scene(bench, bench.shown_stars, q, options.stars, np.random.default_rng(1)).stars
        )
        benches = {"pinhole": pinhole, "lens": with_lens(pinhole)}
        rates = [np.radians(speed) * AXIS if speed else None for speed in SPEEDS_DEG_S]
        found = np.array(
            [
                [[times_ms(b, q, n, rate) for b in benches.values()] for rate in rates]
                for n in range(options.rounds + 5)
            ]
        )
    for speed, (ideal, bent) in zip(SPEEDS_DEG_S, np.median(found[5:], axis=0), strict=True):
        print(
            f"{speed:4g} deg/s  sprites {ideal[0]:5.2f} and {bent[0]:5.2f} ms:"
            f" {bent[0] - ideal[0]:+.2f} ms   frame {ideal[1]:6.2f} and {bent[1]:6.2f} ms:"
            f" {bent[1] - ideal[1]:+.2f} ms   ({ideal[2]:.0f} and {bent[2]:.0f} sprites)"
        )


if __name__ == "__main__":
    main()
