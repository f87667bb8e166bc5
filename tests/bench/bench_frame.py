"""The whole frame, attitude in to codes ready, beside a NumPy linear image, in one run: `python -m tests.bench.bench_frame`.

Prints medians in ms and their ratios. 1000 stars at 1920 x 1080 by default; `--stars N` for others. On demand, never in CI.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy.special import erf

import hilstar
from hilstar.attitude.quaternion import from_radec_roll_deg, to_matrix
from hilstar.scene.sprites import Sprites, clipped_sprites, make_sprites
from hilstar.sky.cells import cell_grid

BENCH = """
[tracker]
aperture_mm = 30
focal_length_mm = 70
pixel_pitch_um = 13
resolution_px = [1024, 1024]
quantum_efficiency = "ccd47-20"
[sky]
faintest_v_mag = 14
[monitor]
resolution_px = [1920, 1080]
pixel_pitch_um = 57.65
[collimator]
focal_length_mm = 200
[render]
flux_at_white_e_per_s = 2e6
"""


def numpy_linear(sprites: Sprites, sigma_px: float, shape: tuple[int, int]) -> np.ndarray:
    """The baseline: separable erf differences and np.add.at, the linear image only."""
    image = np.zeros(shape, np.float32)
    steps = np.arange(sprites.footprint_px) - (sprites.footprint_px - 1) // 2
    columns = sprites.data["pixel"][:, :1] + steps
    rows = sprites.data["pixel"][:, 1:] + steps
    scale = 1 / (sigma_px * np.sqrt(2))

    def shares(pixels: np.ndarray, centre_px: np.ndarray) -> np.ndarray:
        edges = np.concatenate([pixels - 0.5, pixels[:, -1:] + 0.5], axis=1)
        return 0.5 * np.diff(erf((edges - centre_px[:, None]) * scale), axis=1)

    share_y = shares(rows, sprites.y_px) * sprites.data["electrons_per_s"][:, None]
    light = (share_y[:, :, None] * shares(columns, sprites.x_px)[:, None, :]).astype(np.float32)
    inside = ((rows >= 0) & (rows < shape[0]))[:, :, None] & ((columns >= 0) & (columns < shape[1]))[:, None, :]
    place = rows[:, :, None] * shape[1] + columns[:, None, :]
    np.add.at(image.ravel(), place[inside], light[inside])
    return image


def first_stars(bench: hilstar.Bench, q: np.ndarray, count: int) -> hilstar.Bench:
    """The bench with its catalogue thinned until `count` stars are in view at `q`."""
    sprites = bench.sprites(q)
    if len(sprites) < count:
        raise SystemExit(f"{len(sprites)} stars in view; ask for fewer")
    limit = np.sort(bench.stars.v_mag[sprites.star])[count - 1]
    keep = bench.stars.v_mag <= limit
    stars = bench.stars
    columns = {n: getattr(stars, n)[keep] for n in ("hip", "vectors", "v_mag", "bv_mag", "temperature_k", "electrons_per_s")}
    grid = cell_grid(columns["vectors"])
    bench.shown_stars = bench.stars = replace(stars, **{n: c[grid.order] for n, c in columns.items()}, grid=grid)
    return bench


def interleaved(works: dict[str, Callable[[], object]], rounds: int) -> dict[str, np.ndarray]:
    """Times in ms of each work, taken in turn so that a noisy machine is noisy to all."""
    times: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(rounds):
        for name, work in works.items():
            begin = time.perf_counter()
            work()
            times[name].append((time.perf_counter() - begin) * 1e3)
    return {name: np.array(values[rounds // 10 :]) for name, values in times.items()}


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--stars", type=int, default=1000)
    parser.add_argument("--rounds", type=int, default=300)
    options = parser.parse_args()
    with TemporaryDirectory() as folder:
        path = Path(folder) / "bench.toml"
        path.write_text(BENCH)
        with hilstar.load(path) as bench:
            q = from_radec_roll_deg(84.057, -1.2, 10.0)
            first_stars(bench, q, options.stars)
            measure(bench, q, options.rounds)


def measure(bench: hilstar.Bench, q: np.ndarray, rounds: int) -> None:
    gl = bench.renderer
    width, height = bench.config.monitor.resolution_px
    sprites = bench.sprites(q)
    sigma, white = bench.config.render.sprite_sigma_px, bench.flux_at_white_e_per_s
    icrs_to_image = bench.camera.cam_to_image @ to_matrix(q)
    difference = np.abs(numpy_linear(sprites, sigma[0], (height, width)) - bench.frame(q).linear).max()
    assert difference < 1e-5 * sprites.data["electrons_per_s"].max()
    times = interleaved(
        {
            "whole frame": lambda: bench.draw(q),
            "numpy linear only": lambda: numpy_linear(sprites, sigma[0], (height, width)),
            "  cull, project, pack": lambda: make_sprites(bench.stars, icrs_to_image, bench.camera, gl.footprint_px),
            "  all Python outside GL": lambda: clipped_sprites(bench.sprites(q), sigma, white, (width, height)),
            "  draw (GL)": lambda: gl.draw(sprites),
            "  read codes (waits for GL)": gl.codes,
        },
        rounds,
    )
    print(f"{gl.gl_renderer}, {width} x {height}, {len(sprites)} stars, footprint {gl.footprint_px} px, {rounds} rounds")
    base = np.median(times["numpy linear only"])
    for name, values in times.items():
        p50, p99 = np.percentile(values, [50, 99])
        print(f"{name:28}{p50:8.3f} ms median {p99:8.3f} p99   {p50 / base:5.2f} x numpy")


if __name__ == "__main__":
    main()
