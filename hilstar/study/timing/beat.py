"""How exposures beat with the refresh: what the virtual tracker sees of a panel that scans, against what `run.sync` foretells.

Each row of a panel that scans is at a phase of its own, so that the stars of one exposure see the whole beat.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.charts import SERIES, chart, label_ends, plain_ticks, write_records
from hilstar.run.sync.beat import ARCSEC_PER_DEG, Exposures, beat, seen_at
from hilstar.scene.exposure_motion import Motion
from hilstar.study.shared.lone_stars import Isolation, centroid_px, lone_windows
from hilstar.study.timing.panel import ScanningPanel, Sky
from hilstar.study.timing.slew import Slew
from hilstar.units import magnitude

RATE_DEG_S = 1.0
PLACE_TICKS = (-100, -30, -10, -3, -1, 0, 1, 3, 10, 30, 100)
STARTS = 3  # of exposures within a refresh, for phases between the rows of stars
STEP_S = 0.5e-3  # to either side, for a star's speed on the detector
ISOLATION = Isolation(margin_px=8.0, max_share=1e-3)


@dataclass(frozen=True, slots=True)
class Case:
    """Refreshes in an exposure, and for how much of a refresh a row stays lit."""

    refreshes: float
    lit: float = 1.0

    @property
    def words(self) -> str:
        """For a legend."""
        return f"{self.refreshes:g} refreshes" + ("" if self.lit == 1 else f", lit {self.lit:g} of each")


CASES = (Case(6.0), Case(6.3), Case(2.4), Case(6.0, 0.25), Case(2.4, 0.25))
QUICK_CASES = (Case(6.0), Case(6.3), Case(2.4, 0.25))


@dataclass(frozen=True, slots=True)
class BeatPoint:
    """One star of one exposure: what was seen, and foretold of an exposure that begins `phase` refreshes after its row lights.

    `off_arcsec` is along the star's motion, `light_mag` against the mean light of the panel.
    """

    refreshes: float
    lit: float
    phase: float
    off_arcsec: float
    foretold_arcsec: float
    light_mag: float
    foretold_mag: float


def measure_beat(quick: bool = False) -> list[BeatPoint]:
    """Every case at 1 deg/s, by the virtual tracker."""
    slew = Slew(RATE_DEG_S)
    with TemporaryDirectory() as folder:
        return [point for case in (QUICK_CASES if quick else CASES) for point in _case_points(case, slew, Path(folder))]


def _case_points(case: Case, slew: Slew, folder: Path) -> Iterator[BeatPoint]:
    opened = ScanningPanel("+ smear", folder / "beat.toml", case.refreshes / 60.0, case.lit)
    with closing(opened) as panel, closing(Sky(opened)) as sky:
        for number in range(STARTS):
            panel.start_s = (number + 0.2) / STARTS * panel.period_s
            yield from _exposure_points(case, panel, sky, slew)


def _exposure_points(case: Case, panel: ScanningPanel, sky: Sky, slew: Slew) -> Iterator[BeatPoint]:
    shown, true = panel.exposed_e_per_s(slew), sky.exposed_e_per_s(slew)
    paths = sky.paths(slew)
    places = panel.optics.geometry.to_tracker(paths.x_px, paths.y_px)
    windows = list(lone_windows(paths, *places, panel.camera.resolution_px, ISOLATION))
    rows, speed_px_s = _rows_and_speeds(panel, slew, np.array([star for star, _ in windows]))
    exposures = Exposures(1 / panel.period_s, panel.exposure_s, lit_s=case.lit * panel.period_s)
    phase = (panel.start_s / panel.period_s - rows) % 1.0
    foretold = seen_at(exposures, phase)
    for index, (_, window) in enumerate(windows):
        off_px = np.subtract(centroid_px(shown, window), centroid_px(true, window))
        speed = speed_px_s[:, index]
        along_s = float(off_px @ speed / (speed @ speed))
        light = float(shown[window].sum() / true[window].sum()) / case.lit
        yield BeatPoint(
            case.refreshes,
            case.lit,
            float(phase[index]),
            along_s * RATE_DEG_S * ARCSEC_PER_DEG,
            float(foretold.off_s[index]) * RATE_DEG_S * ARCSEC_PER_DEG,
            magnitude(light),
            magnitude(float(foretold.light[index])),
        )


def _rows_and_speeds(panel: ScanningPanel, slew: Slew, stars: np.ndarray) -> tuple[FloatArray, FloatArray]:
    """Each star's row on the monitor, of its height, and its speed on the detector, px/s (2, n), mid-exposure."""
    middle = Motion(slew.at(panel.start_s + panel.exposure_s / 2), slew.rate_cam_rad_s, panel.exposure_s)
    camera, vectors = panel.bench.camera, panel.bench.stars.vectors[stars]
    images = vectors @ middle.icrs_to_image(np.array([-STEP_S, 0.0, STEP_S]), camera).transpose(0, 2, 1)
    before, now, after = (camera.project(image) for image in images)
    to_tracker = panel.optics.geometry.to_tracker
    speed = np.subtract(to_tracker(*after), to_tracker(*before)) / (2 * STEP_S)
    return (now[1] + 0.5) / panel.bench.config.monitor.resolution_px[1], speed


def beat_findings(points: list[BeatPoint], directory: Path) -> list[str]:
    """Write `beat.csv` and its chart; a line for each case. Raises InputError."""
    write_records(directory / "beat.csv", points)
    cases = list(dict.fromkeys(Case(p.refreshes, p.lit) for p in points))
    lines = [_line(case, [p for p in points if Case(p.refreshes, p.lit) == case]) for case in cases]
    off = np.array([p.off_arcsec - p.foretold_arcsec for p in points])
    finding = (
        f"The beat of exposure and refresh moves a star at {RATE_DEG_S:g} deg/s as foretold from their phase,"
        f" within {np.sqrt(np.mean(off**2)):.2g} arcsec rms"
    )
    _draw(directory / "beat", finding, cases, points)
    return [finding, *lines]


def _line(case: Case, points: list[BeatPoint]) -> str:
    found = beat(Exposures(60.0, case.refreshes / 60.0, lit_s=case.lit / 60.0))
    seen, light = np.array([p.off_arcsec for p in points]), np.array([p.light_mag for p in points])
    off = seen - [p.foretold_arcsec for p in points]
    foretold_arcsec = (found.worst_arcsec_per_deg_s or 0.0) * RATE_DEG_S
    return (
        f"{case.words}: up to {np.abs(seen).max():.3g} arcsec ({foretold_arcsec:.3g} foretold over all phases) and"
        f" {np.abs(light).max():.2g} mag ({found.worst_mag:.2g}); {np.sqrt(np.mean(off**2)):.2g} arcsec rms off that"
        f" ({len(points)} stars)"
    )


def _draw(path: Path, finding: str, cases: list[Case], points: list[BeatPoint]) -> None:
    phases = np.linspace(0, 1, 801)
    note = "Lines: foretold. Dots: stars of the virtual tracker. Whole refreshes of rows that stay lit have no beat."
    with chart(path, finding, panels=2, note=note) as (place, light):
        for case, colour in zip(cases, SERIES, strict=False):
            mine = [p for p in points if Case(p.refreshes, p.lit) == case]
            foretold = seen_at(Exposures(60.0, case.refreshes / 60.0, lit_s=case.lit / 60.0), phases)
            place.plot(phases, foretold.off_s * RATE_DEG_S * ARCSEC_PER_DEG, color=colour, label=case.words)
            light.plot(phases, [magnitude(float(part)) for part in foretold.light], color=colour, label=case.words)
            for axes, seen in ((place, "off_arcsec"), (light, "light_mag")):
                axes.plot([p.phase for p in mine], [getattr(p, seen) for p in mine], "o", ms=3.5, color=colour, label="_seen")
        place.set_ylabel("shift of its place [arcsec]")
        place.set_yscale("symlog", linthresh=1.0)
        plain_ticks(place.yaxis, [tick for tick in PLACE_TICKS if abs(tick) <= max(map(abs, place.get_ylim()))])
        light.set_ylabel("change of its light [mag]")
        light.set_xlabel("start of the exposure after a row lights [refreshes]")
        for axes in (place, light):
            label_ends(axes)
