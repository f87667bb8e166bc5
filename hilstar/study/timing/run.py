"""What the timing of a screen does to a tracker on a slew, and what each compensation is worth and costs.

The virtual tracker integrates over several frames of a simulated panel that scans. Its image is compared with that of the sky
in the same exposure, star by star.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from hilstar.charts import chart, label_ends, plain_ticks, write_records
from hilstar.scene.camera import Camera
from hilstar.study.shared.lone_stars import Isolation, lone_windows, star_error
from hilstar.study.timing.beat import beat_findings, measure_beat
from hilstar.study.timing.panel import WAYS, ScanningPanel, Sky
from hilstar.study.timing.slew import Slew
from hilstar.units import ARCSEC_PER_RAD

RATES_DEG_S = (0.01, 0.03, 0.1, 0.3, 1.0, 2.0, 4.0)
QUICK_RATES_DEG_S = (2.0,)
# A window reaches the largest error here and the PSF beyond a star's path.
ISOLATION = Isolation(margin_px=8.0, max_share=1e-3)


@dataclass(frozen=True, slots=True)
class Outcome:
    """One compensation at one rate: rms and largest error of centroids, arcsec, rms flux error, mag, and drawing time, ms."""

    way: str
    rate_deg_s: float
    stars: int
    rms_arcsec: float
    worst_arcsec: float
    flux_rms_mag: float
    draw_ms: float


def compare(panel: ScanningPanel, sky: Sky, slew: Slew) -> Outcome:
    """One compensation on one slew, against the sky."""
    shown, true = panel.exposed_e_per_s(slew), sky.exposed_e_per_s(slew)
    camera: Camera = panel.camera
    paths = sky.paths(slew)
    places = panel.optics.geometry.to_tracker(paths.x_px, paths.y_px)
    windows = lone_windows(paths, *places, camera.resolution_px, ISOLATION)
    errors = [star_error(shown, true, window) for _, window in windows]
    flux_mag = np.array([error.flux_mag for error in errors])
    off_arcsec = np.array([error.centroid_px for error in errors]) * ARCSEC_PER_RAD / camera.focal_length_px
    rms_arcsec, rms_mag = (float(np.sqrt(np.mean(np.square(v)))) for v in (off_arcsec, flux_mag))
    return Outcome(panel.way, slew.rate_deg_s, len(errors), rms_arcsec, float(off_arcsec.max()), rms_mag, panel.cost_ms(slew))


@contextmanager
def _opened() -> Iterator[tuple[list[ScanningPanel], Sky]]:
    with TemporaryDirectory() as folder, ExitStack() as stack:
        panels = []
        for number, way in enumerate(WAYS):
            panels.append(ScanningPanel(way, Path(folder) / f"{number}.toml"))
            stack.callback(panels[-1].close)
        sky = Sky(panels[0])
        stack.callback(sky.close)
        yield panels, sky


def measure(quick: bool = False) -> list[Outcome]:
    """Every compensation at every rate."""
    with _opened() as (panels, sky):
        rates = QUICK_RATES_DEG_S if quick else RATES_DEG_S
        return [compare(panel, sky, Slew(rate)) for rate in rates for panel in panels]


def run(directory: Path, quick: bool = False) -> list[str]:
    """Measure, and write `timing` and `beat`, each as csv and png; the findings, a line each. Raises InputError."""
    outcomes = measure(quick)
    write_records(directory / "timing.csv", outcomes)
    at = {(o.way, o.rate_deg_s): o for o in outcomes}
    finding = draw(directory / "timing", outcomes)
    return [finding, *(_line(at[way, 2.0]) for way in WAYS), *beat_findings(measure_beat(quick), directory)]


def _line(outcome: Outcome) -> str:
    errors = f"{outcome.rms_arcsec:.3g} arcsec rms, {outcome.worst_arcsec:.3g} maximum, {outcome.flux_rms_mag:.2g} mag rms"
    return f"{outcome.way}: {errors}, {outcome.draw_ms:.1f} ms a frame ({outcome.stars} stars)"


def draw(path: Path, outcomes: list[Outcome]) -> str:
    """The chart of the outcomes; its finding."""
    at = {(o.way, o.rate_deg_s): o for o in outcomes}
    plain, best = (at[way, QUICK_RATES_DEG_S[0]] for way in ("prediction", "+ smear"))
    finding = (
        f"At 2 deg/s star positions are off by {plain.rms_arcsec:.0f} arcsec rms with prediction alone,"
        f" and by {best.rms_arcsec:.2g} with scan-out and smear compensated"
    )
    note = "60 Hz panel that lights row by row and holds; exposure 0.1 s; 10 bits, exact; each way adds to the one above it."
    with chart(path, finding, panels=2, note=note, heights=(1.5, 1)) as (error, cost):
        for way, marker in zip(WAYS, "osd^", strict=True):
            mine = [o for o in outcomes if o.way == way]
            rates = [o.rate_deg_s for o in mine]
            error.loglog(rates, [o.rms_arcsec for o in mine], marker=marker, label=way)
            cost.semilogx(rates, [o.draw_ms for o in mine], marker=marker, label=way)
        error.set_ylabel("error of star positions, rms [arcsec]")
        cost.set_ylabel("time of a frame [ms]")
        cost.set_ylim(bottom=0)
        cost.set_xlabel("slew rate [deg/s]")
        plain_ticks(cost.xaxis, sorted({o.rate_deg_s for o in outcomes}))
        for axes in (error, cost):
            label_ends(axes)
    return finding
