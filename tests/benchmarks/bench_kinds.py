"""Whole frames of grey stars, of three primaries and of a tracker's glass, in turn, by image size
and number of stars.

`python -m tests.benchmarks.bench_kinds [-o KINDS.csv] [--rounds N]`. On demand, never in CI: for a
graphics card too.
Times are of the wall clock, from the attitude to codes in memory; `times` is against grey frames of
the same codes.
"""

from __future__ import annotations

import argparse
import csv
import shutil
import time
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

import hilstar
from tests.support.benches import ROOT, Tables, bench_text
from tests.support.spectra import bump, channel_keys, write_channels

FIELD_MM = 100  # of a screen of 1920 pixels: 58 deg wide
SIZES = {1920: 1080, 3840: 2160, 7680: 4320}
FAINTEST_V_MAG = (7.0, 9.0)
QUANTISATIONS = ("round", "exact")
DYES_NM = {"r": 610, "g": 535, "b": 460}
PANEL: dict[str, dict[str, object]] = {
    "monitor.primaries": {"file": "primaries-lcd.csv", "layout": "rgb-stripe"},
    "render": {"colour": "star"},
}
GLASS = "planar-1897.fits"
KINDS: dict[str, Tables] = {
    "grey": {},
    "three primaries, mono": PANEL,
    "three primaries, Bayer": (PANEL | {"tracker": channel_keys(DYES_NM)}),
    "glass": {"tracker.optics": {"psf": GLASS}, "render": {"psf": "tracker"}},
}


def write_bench(folder: Path, kind: str, quantisation: str, width: int, faintest: float) -> Path:
    """Write a bench file in a folder that has the panel, the dyes and the glass."""
    scale = width // 1920
    tables: Tables = {
        "tracker": {"focal_length_mm": 70, "resolution_px": [1024, 1024]},
        "sky": {"faintest_v_mag": faintest},
        "monitor": {"resolution_px": [width, SIZES[width]], "bits": 8},
        "collimator": {"focal_length_mm": FIELD_MM * scale},
        "render": {"quantisation": quantisation, "brightest_v_mag": 1.0},
    }
    path = folder / f"{kind}-{quantisation}-{width}-{faintest}.toml".replace(" ", "_").replace(
        ",", ""
    )
    path.write_text(bench_text(tables, KINDS[kind]))
    return path


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("-o", "--output", type=Path)
    parser.add_argument("--rounds", type=int, default=40)
    parser.add_argument("--widths", type=int, nargs="+", default=list(SIZES))
    options = parser.parse_args()
    attitudes = np.random.default_rng(1).standard_normal((options.rounds + 3, 4))
    attitudes /= np.linalg.norm(attitudes, axis=1)[:, None]
    rows = [("gpu", "width", "height", "stars", "quantisation", "kind", "median_ms", "times")]
    with TemporaryDirectory() as name:
        folder = Path(name)
        for file in (GLASS, "primaries-lcd.csv"):
            shutil.copy(ROOT / "configs" / file, folder)
        at_nm = np.arange(380.0, 721.0, 10.0)
        dyes = {dye: 0.55 * bump(nm, 57, at_nm) for dye, nm in DYES_NM.items()}
        write_channels(folder, at_nm, dyes)
        for width in options.widths:
            for faintest in FAINTEST_V_MAG:
                for quantisation in QUANTISATIONS:
                    with ExitStack() as opened:
                        files = (
                            write_bench(folder, kind, quantisation, width, faintest)
                            for kind in KINDS
                        )
                        benches = [opened.enter_context(hilstar.load(file)) for file in files]
                        times_ms = np.empty((len(attitudes), len(benches)))
                        for k, q in enumerate(attitudes):
                            for number, bench in enumerate(benches):
                                begin = time.perf_counter()
                                _ = bench.draw(q).levels
                                times_ms[k, number] = (time.perf_counter() - begin) * 1e3
                        counts = (
                            sprites
                            for q in attitudes
                            if (sprites := benches[0].sprites(q)) is not None
                        )
                        stars, gpu = (
                            int(np.median([len(one) for one in counts])),
                            benches[0].renderer.gl_renderer,
                        )
                    medians = np.median(times_ms[3:], axis=0).tolist()
                    for kind, median in zip(KINDS, medians, strict=True):
                        times = f"{median / medians[0]:.3g}"
                        rows.append(
                            (
                                gpu,
                                str(width),
                                str(SIZES[width]),
                                str(stars),
                                quantisation,
                                kind,
                                f"{median:.4g}",
                                times,
                            )
                        )
                        print(*rows[-1], sep="  ", flush=True)
    if options.output is not None:
        with options.output.open("w", encoding="utf-8", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows(rows)


if __name__ == "__main__":
    main()
