"""Loops in real time with the virtual tracker: `python tools/measure_loop.py`, three minutes.

Writes results/loop.csv (what `hilstar demo --loop` plants in its tracker and finds of it, and where
examples/basilisk_loop.py points) and results/motion.csv (the tracker's own error by motion, of
frames without a clock), of which `python results/tables.py` makes the tables of docs/tracker.md.
Run it on an idle machine: a display that misses frames holds old ones. Needs Basilisk (`pip install
bsk`). `motion` measures motion.csv alone.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

import hilstar
from hilstar.basics.charts import write_csv
from hilstar.basics.rotation import from_radec_roll_deg
from hilstar.instruments.simulate.live_exposure import LiveTracker

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tests.support.offline_loop import off_arcsec, turning

ROOT = Path(__file__).parents[1]
RESULTS, EXAMPLES = ROOT / "results", ROOT / "examples"
HILSTAR = [sys.executable, "-m", "hilstar"]
DEMO_S, SLEW_DEG, SLEW_S = 90, 2, 25
ORION_DEG = (84.057, -1.2, 0.0)
RATES_DEG_S = (0.0, 0.2, 0.6)
AXIS_CAM = np.array([0.6, 0.8, 0.0])  # across the boresight
PERIOD_S, EXPOSURES, SEED = 0.1, 60, 1


def json_of(command: list[str], folder: Path) -> tuple[dict[str, Any], str]:
    """What a command prints as JSON, and its stderr. Raises SystemExit where it fails."""
    ran = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if ran.returncode:
        raise SystemExit(ran.stderr)
    return json.loads(ran.stdout.splitlines()[-1]), ran.stderr


def digits(value: float) -> str:
    """Three digits: more of them are another run's."""
    return f"{value:.3g}"


def demo_rows(folder: Path) -> list[tuple[str, ...]]:
    """What the demo's tracker has planted, and what its budget finds."""
    words = ["demo", "--loop", "-o", "demo", "--duration", str(DEMO_S), "--json"]
    summary, err = json_of([*HILSTAR, *words], folder)
    share = summary["missed_frames"] / summary["frames"]
    (line,) = (line for line in err.splitlines() if line.startswith('{"loop"'))
    rows: list[tuple[str, ...]] = [("demo", "frames missed", "0", digits(100 * share), "%")]
    for row in json.loads(line)["loop"]:
        figures = (digits(row["planted"]), digits(row["found"]))
        rows.append(("demo", row["quantity"], *figures, row["unit"]))
    return rows


def basilisk_rows(folder: Path) -> Iterator[tuple[str, ...]]:
    """How far from its target Basilisk's controller points, rms."""
    command = [sys.executable, str(EXAMPLES / "basilisk_loop.py"), str(SLEW_DEG), str(SLEW_S)]
    found, _ = json_of(command, folder)
    rms_arcsec = found["pointing_rms_arcsec"]
    for axis, value in rms_arcsec.items():
        yield "basilisk", axis, "0", digits(value), "arcsec"


def motion_row(bench: hilstar.Bench, rate_deg_s: float) -> tuple[str, ...]:
    """The tracker's own error at a rate: its mean about the boresight, and one sigma."""
    rng = np.random.default_rng(SEED)
    turn = np.radians(rate_deg_s) * AXIS_CAM
    with LiveTracker(bench.file, rng) as live:
        solved = turning(bench, live, from_radec_roll_deg(*ORION_DEG), turn, PERIOD_S)
        off = np.array([off_arcsec(one) for one in islice(solved, EXPOSURES)])
    scanout_ms = digits(bench.config.monitor.panel_scanout_ms)
    figures = map(digits, (*off.std(axis=0), off[:, 2].mean()))
    return digits(rate_deg_s), scanout_ms, str(EXPOSURES), *figures


def motion_rows(folder: Path) -> Iterator[tuple[str, ...]]:
    """Before a panel that lights all rows at once; and at the fastest, one after another."""
    text = (EXAMPLES / "bench.toml").read_text("utf-8")
    at_once = text.replace("[monitor]", "[monitor]\nscanout_ms = 0.0", 1)
    for name, monitor, rates in (("rows", text, RATES_DEG_S[-1:]), ("whole", at_once, RATES_DEG_S)):
        path = folder / f"{name}.toml"
        path.write_text(monitor, "utf-8")
        with hilstar.load(path) as bench:
            yield from (motion_row(bench, rate_deg_s) for rate_deg_s in rates)


def main() -> None:
    """Measure, and write both tables."""
    with TemporaryDirectory() as name:
        motion = sorted(motion_rows(Path(name)))
    heads = (
        "rate_deg_s",
        "scanout_ms",
        "exposures",
        "x_arcsec",
        "y_arcsec",
        "z_arcsec",
        "mean_z_arcsec",
    )
    write_csv(RESULTS / "motion.csv", heads, motion)
    if "motion" in sys.argv[1:]:
        return
    with TemporaryDirectory() as name:
        folder = Path(name)
        loop = [*demo_rows(folder), *basilisk_rows(folder)]
    write_csv(RESULTS / "loop.csv", ("run", "quantity", "planted", "found", "unit"), loop)


if __name__ == "__main__":
    main()
