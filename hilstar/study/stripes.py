"""The stripes of a display that lights row by row behind a rolling shutter: part of the study of timing.

The virtual tracker stands before the display at rest, without noise. The black level's glow shows each row's light. Lines are
`run.sync`'s at each row's own phase.
"""

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from hilstar.bench.bench_file import read_bench_file
from hilstar.bench.build import scan_of
from hilstar.bench.cameras import bench_camera, tracker_camera
from hilstar.campaign.display_tracker import DisplayTracker
from hilstar.charts import SERIES, chart, write_records
from hilstar.frame.view import STILL, View
from hilstar.rotation import from_radec_roll_deg
from hilstar.run.sync import Exposures, seen_at
from hilstar.study.settings import FULL_HD, GLASS, Table, bench_text
from hilstar.twin.optics import BenchGeometry
from hilstar.twin.shutter import S_PER_US

RADEC_ROLL_DEG = (84.0, 0.0, 0.0)
ROWS, ROW_TIME_US, REFRESH_HZ = 1024, 60.0, 60.0
SIZE = (128, ROWS)
EVERY_ROWS = 16  # between dots
ROUNDING = 1e-9


@dataclass(frozen=True, slots=True)
class StripeCase:
    """Refreshes in an exposure, and how long the display's rows stay lit, ms."""

    refreshes: float
    lit_ms: float

    @property
    def words(self) -> str:
        """For a legend."""
        return f"{self.refreshes:g} refreshes, rows lit {self.lit_ms:.3g} ms"


CASES = (StripeCase(0.6, 4.0), StripeCase(2.4, 4.0), StripeCase(2.0, 4.0), StripeCase(2.4, 1e3 / REFRESH_HZ))


@dataclass(frozen=True, slots=True)
class StripePoint:
    """A row of one case: its light relative to the mean, seen and foretold."""

    refreshes: float
    lit_ms: float
    row: int
    light: float
    foretold: float


def measure(case: StripeCase) -> list[StripePoint]:
    """The rows of one case, every so many."""
    exposure_s = case.refreshes / REFRESH_HZ
    tables: dict[str, Table] = {
        "tracker": {"resolution_px": SIZE, "exposure_s": exposure_s, "transmission": GLASS},
        "sky": {"faintest_v_mag": 3.0},
        "monitor": {**FULL_HD, "hold_ms": case.lit_ms, "calibration": "lcd-example"},
        "collimator": {"focal_length_mm": 350},
    }
    rolling: Table = {"shutter": "rolling", "row_time_us": ROW_TIME_US}
    view, light = View.exposure(from_radec_roll_deg(*RADEC_ROLL_DEG), STILL, exposure_s), []
    for extra in ({"tracker.detector": rolling}, {}):
        with TemporaryDirectory() as folder:
            path = Path(folder) / "bench.toml"
            path.write_text(bench_text({**tables, **extra}), encoding="utf-8")
            file = read_bench_file(path)
            tracker = DisplayTracker(file)
            light.append(
                tracker.expose(view, None).mean_e[::EVERY_ROWS, 0]
            )  # the left edge: the boresight's stars are elsewhere
            tracker.close()
    config, x, y = file.config, np.zeros(ROWS)[::EVERY_ROWS], np.arange(float(ROWS))[::EVERY_ROWS]
    geometry = BenchGeometry(bench_camera(config, path.parent), tracker_camera(config.tracker, path.parent))
    screen_late_s = scan_of(config.monitor).late_s(*geometry.to_monitor(x, y), config.monitor.resolution_px)
    late = REFRESH_HZ * ((y - (ROWS - 1) / 2) * ROW_TIME_US * S_PER_US - screen_late_s)  # middle rows begin together
    foretold = seen_at(Exposures(REFRESH_HZ, exposure_s, lit_s=case.lit_ms * 1e-3), late).light
    return [
        StripePoint(case.refreshes, case.lit_ms, int(y[row]), float(light[0][row] / light[1][row]), float(foretold[row]))
        for row in np.flatnonzero(light[1])  # the first and last see past the screen
    ]


def findings(directory: Path) -> list[str]:
    """Write `stripes.csv` and its chart; its finding. Raises InputError."""
    points = [point for case in CASES for point in measure(case)]
    write_records(directory / "stripes.csv", points)
    return [draw(directory / "stripes", points)]


def draw(path: Path, points: list[StripePoint]) -> str:
    """The chart of the cases; its finding."""
    off = max(abs(point.light - point.foretold) for point in points)
    finding = (
        "A display that flashes shows as stripes behind a rolling shutter, unless exposures are whole refreshes:"
        f" as foretold within {max(off, ROUNDING):.0e} of the light"
    )
    note = (
        f"{REFRESH_HZ:g} Hz, scan-out of a whole refresh; {ROWS} rows, {ROW_TIME_US:g} us each, the top row first."
        " Dots: glow on the virtual tracker's rows. Lines: foretold."
    )
    with chart(path, finding, note=note) as (axes,):
        for case, colour in zip(CASES, SERIES, strict=False):
            mine = [point for point in points if (point.refreshes, point.lit_ms) == (case.refreshes, case.lit_ms)]
            rows = [point.row for point in mine]
            axes.plot(rows, [point.foretold for point in mine], color=colour, label=case.words)
            axes.plot(rows, [point.light for point in mine], "o", ms=3, color=colour, label="_seen")
        axes.set_ylabel("light / mean light")
        axes.set_xlabel("row of the tracker")
        axes.set_ylim(bottom=0)
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2, frameon=False)
    return finding
