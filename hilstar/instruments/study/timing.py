"""The study of timing: the effect of a screen's timing on a slewing tracker, and the gain and cost
of each compensation.

The virtual tracker integrates over several frames of a simulated panel, which lights row by row and
holds each row until it is written again. Its image is compared with that of the sky in the same
exposure, star by star. Each row is at its own phase, so the stars of one exposure see the whole
beat. The beat is compared with the prediction of `server.sync`.

Before a tracker with a rolling shutter such a display shows stripes: the tracker is at rest and
without noise, the glow of the black level shows each row's light, and lines are `server.sync`'s at
each row's own phase.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from hilstar.attitude.clock.timeline import Attitude, Policy, Timeline
from hilstar.basics.arrays import FloatArray
from hilstar.basics.charts import plain_ticks
from hilstar.basics.process.closing import Closing
from hilstar.basics.rotation import from_radec_roll_deg
from hilstar.basics.units import ARCSEC_PER_RAD, NS_PER_S, magnitude
from hilstar.display.quantise import shown_light
from hilstar.display.render.renderer import Renderer
from hilstar.display.render.target import Target
from hilstar.display.response import Levels
from hilstar.instruments.campaign.display_tracker import DisplayTracker
from hilstar.instruments.simulate.bench_geometry import BenchGeometry
from hilstar.instruments.simulate.optics import TwinOptics
from hilstar.instruments.simulate.shutter import S_PER_US
from hilstar.instruments.study import study_benches
from hilstar.instruments.study.engine import (
    ChartSpec,
    LineSpec,
    PanelSpec,
    draw_rows,
    looks_of,
    row_panels,
    write_rows,
)
from hilstar.instruments.study.predictors import Movement, attitude_at
from hilstar.instruments.study.sweep import Judged, Load, OtherWork, medians_ms
from hilstar.optics.exposure_motion import Motion, smeared_sprites
from hilstar.optics.layers.view import STILL, View
from hilstar.optics.scan import Scan
from hilstar.optics.sprites import FrameLight
from hilstar.server.bench.bench_file import BenchFile, read_bench_file
from hilstar.server.bench.cameras import bench_camera, tracker_camera
from hilstar.server.bench.monitor import scan_of
from hilstar.server.sync import ARCSEC_PER_DEG, Exposures, beat, seen_at

STRIPES_RADEC_ROLL_DEG = (84.0, 0.0, 0.0)
STRIPE_ROWS, ROW_TIME_US, REFRESH_HZ = 1024, 60.0, 60.0
STRIPE_SIZE_PX = (128, STRIPE_ROWS)
EVERY_ROWS = 16  # between dots
ROUNDING = 1e-9  # a smaller departure is the arithmetic's
STRIPE_NOTE = (
    f"{REFRESH_HZ:g} Hz, scan-out of a whole refresh; {STRIPE_ROWS} rows, {ROW_TIME_US:g} us each,"
    " the top row first. Dots: glow on the virtual tracker's rows. Lines: foretold."
)
WHOLE_PT = 5.0  # width of the lines of whole refreshes: another line lies on them
RADEC_ROLL_DEG = (84.0, 0.0, 15.0)  # Orion: enough bright stars
PACKET_HZ = 200
RATE_DEG_S = 1.0
BEAT_PHASES = 801  # of the lines that are foretold
BEAT_NOTE = (
    "Lines: foretold. Dots: stars of the virtual tracker. Whole refreshes of rows that stay lit"
    " have no beat."
)
TIMING_NOTE = (
    "60 Hz panel that lights row by row and holds; exposure 0.1 s; 10 bits, exact; each way adds to"
    " the one above it."
)
PLACE_TICKS = (-100, -30, -10, -3, -1, 0, 1, 3, 10, 30, 100)
STARTS = 3  # exposure starts within a refresh, for phases between the rows of stars
MARKERS = "osd^"
STEP_S = 0.5e-3  # to either side, for a star's speed on the detector
# A window reaches the largest error here and the PSF beyond a star's path.
ISOLATION = study_benches.Isolation(margin_px=8.0, max_share=1e-3)
RATES_DEG_S = (0.01, 0.03, 0.1, 0.3, 1.0, 2.0, 4.0)
QUICK_RATES_DEG_S = (2.0,)
DRAW_TO_SWAP_S = 0.010  # from the newest packet that a frame has to its swap
EXPOSURE_S = 0.1
START_S = 0.0037  # exposure start within a refresh period
REFRESH_MS = 1e3 / 60  # the default of a bench file
FRAME_BEFORE = 1  # the first rows of an exposure still show the frame before
COST_ROUNDS = 9  # of which the median counts


def is_whole(point: "StripePoint") -> bool:
    """Whether a row's exposure is of whole refreshes."""
    return float(point.refreshes).is_integer()


STRIPE_PANEL = PanelSpec(
    (
        LineSpec("row", "foretold", where=is_whole, look={"lw": WHOLE_PT}),
        LineSpec("row", "foretold", where=lambda point: not is_whole(point)),
        LineSpec("row", "light", "", marker="o", named=False, look={"ms": 3}),
    ),
    "light / mean light",
    "row of the tracker",
    from_zero=True,
    legend={
        "loc": "upper center",
        "bbox_to_anchor": (0.5, -0.16),
        "ncols": 2,
        "frameon": False,
    },
)


@dataclass(frozen=True, slots=True)
class StripeCase:
    """Refreshes in an exposure, and how long the display's rows stay lit, ms."""

    refreshes: float
    lit_ms: float

    @property
    def words(self) -> str:
        """For a legend."""
        return f"{self.refreshes:g} refreshes, rows lit {self.lit_ms:.3g} ms"


STRIPE_CASES: tuple[StripeCase, ...] = (
    StripeCase(0.6, 4.0),
    StripeCase(2.4, 4.0),
    StripeCase(2.0, 4.0),
    StripeCase(2.4, 1e3 / REFRESH_HZ),
)


@dataclass(frozen=True, slots=True)
class StripePoint:
    """A row of one case: its light relative to the mean, measured and foretold."""

    refreshes: float
    lit_ms: float
    row: int
    light: float
    foretold: float


def stripe_points(case: StripeCase) -> list[StripePoint]:
    """The rows of one case, every EVERY_ROWS."""
    exposure_s = case.refreshes / REFRESH_HZ
    tables: dict[str, study_benches.Table] = {
        "tracker": {
            "resolution_px": STRIPE_SIZE_PX,
            "exposure_s": exposure_s,
            "transmission": study_benches.GLASS,
        },
        "sky": {"faintest_v_mag": 3.0},
        "monitor": {**study_benches.FULL_HD, "hold_ms": case.lit_ms, "calibration": "lcd-example"},
        "collimator": {"focal_length_mm": 350},
    }
    rolling: study_benches.Table = {"shutter": "rolling", "row_time_us": ROW_TIME_US}
    view = View.exposure(from_radec_roll_deg(*STRIPES_RADEC_ROLL_DEG), STILL, exposure_s)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "bench.toml"
        striped = left_edge_e(path, {**tables, "tracker.detector": rolling}, view)
        even = left_edge_e(path, tables, view)
        late = row_lateness(read_bench_file(path))
    exposures = Exposures(REFRESH_HZ, exposure_s, lit_s=case.lit_ms * 1e-3)
    foretold = seen_at(exposures, late).light
    points = []
    for row in np.flatnonzero(even).tolist():  # the first and last see past the screen
        light = float(striped[row] / even[row])
        number = row * EVERY_ROWS
        points.append(StripePoint(case.refreshes, case.lit_ms, number, light, float(foretold[row])))
    return points


def left_edge_e(path: Path, tables: Mapping[str, study_benches.Table], view: View) -> FloatArray:
    """The electrons of an exposure at the left edge, every EVERY_ROWS rows; the bright stars are
    elsewhere.

    The bench file is written to `path`.
    """
    path.write_text(study_benches.bench_text(tables), encoding="utf-8")
    tracker = DisplayTracker(read_bench_file(path))
    edge = tracker.expose(view, None).mean_e[::EVERY_ROWS, 0]
    tracker.close()
    return edge


def row_lateness(file: BenchFile) -> FloatArray:
    """How many refreshes after its part of the screen lights a row's exposure begins, every
    EVERY_ROWS rows.

    The middle rows begin together.
    """
    config = file.config
    monitor = bench_camera(config, file.folder)
    geometry = BenchGeometry(monitor, tracker_camera(config.tracker, file.folder))
    rows = np.arange(float(STRIPE_ROWS))[::EVERY_ROWS]
    x_px, y_px = geometry.to_monitor(np.zeros(len(rows)), rows)
    screen_late_s = scan_of(config.monitor).late_s(x_px, y_px, config.monitor.resolution_px)
    begin_s = (rows - (STRIPE_ROWS - 1) / 2) * ROW_TIME_US * S_PER_US
    return np.asarray(REFRESH_HZ * (begin_s - screen_late_s))


def stripe_findings(directory: Path) -> list[str]:
    """Write `stripes.csv` and its chart; its finding. Raises InputError."""
    points: list[StripePoint] = []
    for case in STRIPE_CASES:
        points += stripe_points(case)
    write_rows(directory / "stripes.csv", points)
    return [draw_stripes(directory / "stripes", points)]


def stripe_depth(points: list[StripePoint], whole: bool) -> float:
    """The largest departure of a row from the mean light, of exposures of whole refreshes or
    others.
    """
    depth = 0.0
    for point in points:
        if is_whole(point) == whole:
            depth = max(depth, abs(point.light - 1))
    return depth


def draw_stripes(path: Path, points: list[StripePoint]) -> str:
    """The chart of the cases; its finding."""
    off = max(abs(point.light - point.foretold) for point in points)
    whole = stripe_depth(points, True)
    parted = stripe_depth(points, False)
    finding = (
        f"Behind a rolling shutter a display's stripes are up to {100 * parted:.0f} % of its light,"
        f" {100 * whole:.0f} % where exposures are whole refreshes: as foretold within"
        f" {max(off, ROUNDING):.0e}"
    )
    looks = looks_of({case: case.words for case in STRIPE_CASES})
    draw_rows(path, finding, ChartSpec((STRIPE_PANEL,), stripe_case, looks, STRIPE_NOTE), points)
    return finding


def stripe_case(point: StripePoint) -> StripeCase:
    """The case of a row: the series of its chart."""
    return StripeCase(point.refreshes, point.lit_ms)


def slew(rate_deg_s: float) -> Movement:
    """A turn at a constant rate, and the packets that report it."""
    return Movement(from_radec_roll_deg(*RADEC_ROLL_DEG), rate_deg_s, PACKET_HZ, shaken=False)


@dataclass(frozen=True, slots=True)
class Compensation:
    """A bench's compensation: further keys of [monitor], and `motion` of [render]."""

    monitor_keys: study_benches.Table
    motion: str


WAYS: dict[str, Compensation] = {
    "no prediction": Compensation({}, "off"),
    "prediction": Compensation({}, "off"),
    "+ scan-out": Compensation({"hold_ms": 0}, "on"),
    "+ smear": Compensation({}, "on"),
}


def frame_weights(
    rows: FloatArray, swaps_s: Sequence[float], scan: Scan, span_s: tuple[float, float]
) -> FloatArray:
    """The share of an exposure (begin, end) for which each row (r,) shows each frame (k,): (k, r).

    `rows` run from 0 to 1. A row lights `rows` of the scan-out after the swap, and shows the frame
    until the next one reaches it.
    """
    begins = np.asarray(swaps_s)[:, None] + rows * scan.scanout_s
    ends = begins + scan.hold_s
    lit = np.minimum(ends, span_s[1]) - np.maximum(begins, span_s[0])
    return np.asarray(np.maximum(lit, 0.0) / (span_s[1] - span_s[0]))


class ScanningPanel(Closing):
    """A bench with one compensation, shown on a panel that scans, and a tracker in front of it.
    Free it with `close`.

    Rows stay lit for `lit` of a refresh, which the bench knows where it compensates smear.
    """

    def __init__(
        self, way: str, path: Path, exposure_s: float = EXPOSURE_S, lit: float = 1.0
    ) -> None:
        held: study_benches.Table = {"hold_ms": lit * REFRESH_MS} if lit < 1 else {}
        tables: dict[str, study_benches.Table] = {
            "tracker": {
                "resolution_px": (800, 640),
                "exposure_s": exposure_s,
                "transmission": study_benches.GLASS,
            },
            "sky": {"faintest_v_mag": 6.0},
            "monitor": {**study_benches.FULL_HD, "bits": 10, **WAYS[way].monitor_keys, **held},
            "collimator": {"focal_length_mm": 350},
            "render": {"quantisation": "exact", "motion": WAYS[way].motion, "brightest_v_mag": 1.5},
        }
        self.way = way
        self.start_s = START_S
        self.bench = study_benches.study_bench(path, tables)
        config = self.bench.config
        self.period_s = 1 / config.monitor.refresh_hz
        hold_s = lit * self.period_s
        self.panel_scan = replace(self.bench.scan, scanout_s=self.period_s, hold_s=hold_s)
        self.exposure_s = config.tracker.exposure_s
        self.camera = tracker_camera(config.tracker, self.bench.file.folder)
        geometry = BenchGeometry(self.bench.camera, self.camera)
        self.optics = TwinOptics(geometry, self.bench.tracker_psf)
        self.panel = self.bench.panel

    def motion(self, movement: Movement) -> Motion:
        """The camera's true motion over the exposure, from its middle."""
        middle_ns = round((self.start_s + self.exposure_s / 2) * NS_PER_S)
        return Motion(movement.at(middle_ns), movement.turn_rad_s, self.exposure_s)

    def attitude(self, movement: Movement, swap_s: float) -> Attitude:
        """The attitude that the display derives from the packets received when it starts the
        frame of a swap.
        """
        timeline = Timeline(Policy(NS_PER_S, NS_PER_S))
        for sample in movement.samples(round((swap_s - DRAW_TO_SWAP_S) * NS_PER_S)):
            timeline.add(sample)
        light_s = swap_s + self.period_s / 2
        if self.way == "no prediction":
            light_s = math.floor((swap_s - DRAW_TO_SWAP_S) * PACKET_HZ) / PACKET_HZ
        return attitude_at(timeline, round(light_s * NS_PER_S))

    def levels(self, attitude: Attitude, number: int) -> Levels:
        """Draw one frame: its levels (H, W)."""
        if self.bench.config.render.motion == "on":
            rate = attitude.rate_cam_rad_s
        else:
            rate = None
        return self.bench.draw(attitude.q_icrs_to_cam, number, rate).levels

    def exposed_e_per_s(self, movement: Movement) -> FloatArray:
        """The tracker's image (h, w) of the screen, mean over an exposure."""
        width, height = self.bench.config.monitor.resolution_px
        begin_s = self.start_s
        end_s = begin_s + self.exposure_s
        first = math.floor((begin_s - 2 * self.period_s) / self.period_s) - FRAME_BEFORE
        numbers = range(first, math.ceil(end_s / self.period_s) + 1)
        swaps_s = [number * self.period_s for number in numbers]
        rows = (np.arange(height) + 0.5) / height
        weights = frame_weights(rows, swaps_s, self.panel_scan, (begin_s, end_s))
        light = np.zeros((height, width))
        for number, swap_s, weight in zip(numbers, swaps_s, weights, strict=True):
            if weight.any():
                levels = self.levels(self.attitude(movement, swap_s), number)
                light += weight[:, None] * shown_light(levels, self.panel)
        return self.optics.image_e_per_s(light)

    def cost_ms(self, movement: Movement) -> float:
        """Median time of drawing a frame, from its attitude to its codes, ms."""
        attitude = self.attitude(movement, 0.0)

        def work(number: int) -> Levels:
            return self.levels(attitude, number)

        return medians_ms({self.way: work}, COST_ROUNDS)[self.way]

    def close(self) -> None:
        """Free the GL contexts."""
        self.bench.close()
        self.optics.close()


class TimingSky(Closing):
    """The same tracker's image of the sky itself, spread by the sprites' width. Free it with
    `close`.
    """

    def __init__(self, shown: ScanningPanel) -> None:
        self._shown = shown
        self._renderer = Renderer(Target(shown.bench.config.monitor.resolution_px, shown.bench.psf))

    def paths(self, movement: Movement) -> FrameLight:
        """Each star's path over the exposure, in monitor pixels."""
        bench = self._shown.bench
        motion = self._shown.motion(movement)
        return smeared_sprites(bench.stars, motion, bench.camera, bench.psf)

    def exposed_e_per_s(self, movement: Movement) -> FloatArray:
        """The tracker's image (h, w), mean over the exposure."""
        self._renderer.draw(self.paths(movement))
        return self._shown.optics.image_e_per_s(self._renderer.linear().astype(np.float64))

    def close(self) -> None:
        """Free the GL context."""
        self._renderer.close()


@dataclass(frozen=True, slots=True)
class TimingCase:
    """Refreshes in an exposure, and the share of a refresh for which a row stays lit."""

    refreshes: float
    lit: float = 1.0

    @property
    def exposures(self) -> Exposures:
        """The exposures, before a panel of 60 Hz."""
        return Exposures(60.0, self.refreshes / 60.0, lit_s=self.lit / 60.0)

    @property
    def words(self) -> str:
        """For a legend."""
        refreshes = f"{self.refreshes:g} refreshes"
        if self.lit == 1:
            return refreshes
        return f"{refreshes}, lit {self.lit:g} of each"


CASES: tuple[TimingCase, ...] = (
    TimingCase(6.0),
    TimingCase(6.3),
    TimingCase(2.4),
    TimingCase(6.0, 0.25),
    TimingCase(2.4, 0.25),
)
QUICK_CASES: tuple[TimingCase, ...] = (TimingCase(6.0), TimingCase(6.3), TimingCase(2.4, 0.25))


@dataclass(frozen=True, slots=True)
class BeatPoint:
    """One star of one exposure, measured and foretold.

    The exposure begins `phase` refreshes after the star's row lights. `off_arcsec` is along the
    star's motion, `light_mag` relative to the panel's mean light.
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
    movement = slew(RATE_DEG_S)
    points: list[BeatPoint] = []
    for case in QUICK_CASES if quick else CASES:
        with TemporaryDirectory() as folder, ExitStack() as stack:
            path = Path(folder) / "beat.toml"
            exposure_s = case.refreshes / 60.0
            panel = stack.enter_context(ScanningPanel("+ smear", path, exposure_s, case.lit))
            sky = stack.enter_context(TimingSky(panel))
            for number in range(STARTS):
                panel.start_s = (number + 0.2) / STARTS * panel.period_s
                points += _exposure_points(case, panel, sky, movement)
    return points


def _exposure_points(
    case: TimingCase, panel: ScanningPanel, sky: TimingSky, movement: Movement
) -> Iterator[BeatPoint]:
    shown = panel.exposed_e_per_s(movement)
    true = sky.exposed_e_per_s(movement)
    windows = lone_paths(panel, sky, movement)
    # Where each star is on the monitor in the middle of the exposure, and just before and after:
    # its row, and its speed.
    to_tracker = panel.optics.geometry.to_tracker
    camera = panel.bench.camera
    stars = [star for star, _ in windows]
    turns = panel.motion(movement).icrs_to_image(np.array([-STEP_S, 0.0, STEP_S]), camera)
    images = panel.bench.stars.vectors[stars] @ turns.transpose(0, 2, 1)
    before, now, after = (camera.project(image) for image in images)
    speed_px_s = np.subtract(to_tracker(*after), to_tracker(*before)) / (2 * STEP_S)
    row_share = (now[1] + 0.5) / camera.resolution_px[1]
    phase = (panel.start_s / panel.period_s - row_share) % 1.0
    lit_s = case.lit * panel.period_s
    foretold = seen_at(Exposures(1 / panel.period_s, panel.exposure_s, lit_s=lit_s), phase)
    arcsec_per_s = RATE_DEG_S * ARCSEC_PER_DEG
    for index, (_, window) in enumerate(windows):
        shown_px = study_benches.centroid_px(shown, window)
        true_px = study_benches.centroid_px(true, window)
        speed = speed_px_s[:, index]
        off_s = float(np.subtract(shown_px, true_px) @ speed / (speed @ speed))
        light = float(shown[window].sum() / true[window].sum())
        yield BeatPoint(
            refreshes=case.refreshes,
            lit=case.lit,
            phase=float(phase[index]),
            off_arcsec=off_s * arcsec_per_s,
            foretold_arcsec=float(foretold.off_s[index]) * arcsec_per_s,
            light_mag=magnitude(light / case.lit),
            foretold_mag=magnitude(float(foretold.light[index])),
        )


def lone_paths(
    panel: ScanningPanel, sky: TimingSky, movement: Movement
) -> list[tuple[int, study_benches.Window]]:
    """The isolated stars of an exposure, with their windows on the tracker."""
    paths = sky.paths(movement)
    x_px, y_px = panel.optics.geometry.to_tracker(paths.x_px, paths.y_px)
    size_px = panel.camera.resolution_px
    return list(study_benches.lone_windows(paths, x_px, y_px, size_px, ISOLATION))


def beat_findings(points: Sequence[BeatPoint], directory: Path) -> list[str]:
    """Write `beat.csv` and its chart; a line for each case. Raises InputError."""
    write_rows(directory / "beat.csv", points)
    cases: dict[TimingCase, list[BeatPoint]] = {}
    for point in points:
        cases.setdefault(TimingCase(point.refreshes, point.lit), []).append(point)
    finding = (
        f"The beat of exposure and refresh moves a star at {RATE_DEG_S:g} deg/s as foretold from"
        f" their phase, within {_off_arcsec(points):.2g} arcsec rms"
    )
    draw_beat(directory / "beat", finding, cases)
    return [finding, *(case_line(case, points) for case, points in cases.items())]


def case_line(case: TimingCase, points: Sequence[BeatPoint]) -> str:
    """The largest errors of a case, beside those that are foretold over all phases."""
    foretold = beat(case.exposures)
    worst_arcsec = (foretold.worst_arcsec_per_deg_s or 0.0) * RATE_DEG_S
    off_arcsec = max(abs(point.off_arcsec) for point in points)
    light_mag = max(abs(point.light_mag) for point in points)
    return (
        f"{case.words}: up to {off_arcsec:.3g} arcsec ({worst_arcsec:.3g} foretold over all phases)"
        f" and {light_mag:.2g} mag ({foretold.worst_mag:.2g});"
        f" {_off_arcsec(points):.2g} arcsec rms off that ({len(points)} stars)"
    )


def _off_arcsec(points: Sequence[BeatPoint]) -> float:
    """The rms distance of stars from their foretold places, arcsec."""
    off = np.array([point.off_arcsec - point.foretold_arcsec for point in points])
    return float(np.sqrt(np.mean(off**2)))


def draw_beat(path: Path, finding: str, cases: dict[TimingCase, list[BeatPoint]]) -> None:
    """Shift and light of stars by the phase of their exposure, and as they are foretold."""
    rows: list[BeatPoint | ForetoldBeat] = []
    for case, points in cases.items():
        rows += [*foretold_beat(case), *points]
    place = PanelSpec(
        beat_lines("off_arcsec"), "shift of its place [arcsec]", scales=("linear", "symlog")
    )
    light = PanelSpec(
        beat_lines("light_mag"),
        "change of its light [mag]",
        "start of the exposure after a row lights [refreshes]",
    )
    looks = looks_of({case: case.words for case in cases})
    spec = ChartSpec((place, light), beat_case, looks, BEAT_NOTE)
    with row_panels(path, finding, spec, rows) as panels:
        reach_arcsec = max(map(abs, panels[0].get_ylim()))
        ticks = [tick for tick in PLACE_TICKS if abs(tick) <= reach_arcsec]
        plain_ticks(panels[0].yaxis, ticks)


@dataclass(frozen=True, slots=True)
class ForetoldBeat:
    """The error that `server.sync` foretells for one phase; its columns are those of BeatPoint."""

    refreshes: float
    lit: float
    phase: float
    off_arcsec: float
    light_mag: float


def foretold_beat(case: TimingCase) -> list[ForetoldBeat]:
    """The foretold errors of a case at every phase."""
    phases = np.linspace(0, 1, BEAT_PHASES)
    foretold = seen_at(case.exposures, phases)
    off_arcsec = foretold.off_s * RATE_DEG_S * ARCSEC_PER_DEG
    rows = []
    for phase, off, light in zip(phases, off_arcsec, foretold.light, strict=True):
        mag = magnitude(float(light))
        rows.append(ForetoldBeat(case.refreshes, case.lit, float(phase), float(off), mag))
    return rows


def beat_lines(y: str) -> tuple[LineSpec, ...]:
    """Lines of what is foretold, and dots of stars, against the phase."""
    dots = LineSpec("phase", y, "", marker="o", named=False, of=BeatPoint, look={"ms": 3.5})
    return LineSpec("phase", y, of=ForetoldBeat), dots


def beat_case(row: BeatPoint | ForetoldBeat) -> TimingCase:
    """The case of a row: the series of its chart."""
    return TimingCase(row.refreshes, row.lit)


@dataclass(frozen=True, slots=True)
class TimingOutcome:
    """One compensation at one rate: rms and largest error of centroids, arcsec, rms flux error,
    mag, and the time of a frame, ms.
    """

    way: str
    rate_deg_s: float
    stars: int
    rms_arcsec: float
    worst_arcsec: float
    flux_rms_mag: float
    draw_ms: float


def compare(panel: ScanningPanel, sky: TimingSky, movement: Movement) -> TimingOutcome:
    """One compensation on one slew, against the sky."""
    shown = panel.exposed_e_per_s(movement)
    true = sky.exposed_e_per_s(movement)
    errors = []
    for _, window in lone_paths(panel, sky, movement):
        errors.append(study_benches.star_error(shown, true, window))
    flux_mag = np.array([error.flux_mag for error in errors])
    off_px = np.array([error.centroid_px for error in errors])
    off_arcsec = off_px * ARCSEC_PER_RAD / panel.camera.focal_length_px
    return TimingOutcome(
        way=panel.way,
        rate_deg_s=movement.rate_deg_s,
        stars=len(errors),
        rms_arcsec=float(np.sqrt(np.mean(off_arcsec**2))),
        worst_arcsec=float(off_arcsec.max()),
        flux_rms_mag=float(np.sqrt(np.mean(flux_mag**2))),
        draw_ms=panel.cost_ms(movement),
    )


def measure_slews(quick: bool = False) -> list[TimingOutcome]:
    """Every compensation at every rate."""
    with TemporaryDirectory() as folder, ExitStack() as stack:
        panels = []
        for k, way in enumerate(WAYS):
            panels.append(stack.enter_context(ScanningPanel(way, Path(folder) / f"{k}.toml")))
        sky = stack.enter_context(TimingSky(panels[0]))
        outcomes: list[TimingOutcome] = []
        for rate_deg_s in QUICK_RATES_DEG_S if quick else RATES_DEG_S:
            outcomes += [compare(panel, sky, slew(rate_deg_s)) for panel in panels]
        return outcomes


@dataclass(frozen=True, slots=True)
class TimingMeasured:
    """Every compensation at every rate with the work of others meanwhile, and the stars of the
    beat's exposures.
    """

    outcomes: Sequence[TimingOutcome]
    load: Load
    beats: Sequence[BeatPoint]


def run(directory: Path, quick: bool = False) -> Judged:
    """Measure, and write `timing`, `beat` and `stripes`, each as csv and png; the findings, a
    line each. Raises InputError.
    """
    return report(directory, measure(quick))


def measure(quick: bool) -> TimingMeasured:
    """The slews, and the exposures that beat with the refresh."""
    others = OtherWork()
    outcomes = measure_slews(quick)
    return TimingMeasured(outcomes, others.load(), measure_beat(quick))


def report(directory: Path, measured: TimingMeasured) -> Judged:
    """Write what was measured; the findings, a line each. Raises InputError."""
    outcomes, load = measured.outcomes, measured.load
    write_rows(directory / "timing.csv", outcomes)
    finding = draw(directory / "timing", outcomes, load)
    lines = [finding]
    for outcome in outcomes:
        if outcome.rate_deg_s == QUICK_RATES_DEG_S[0]:
            lines.append(line_of(outcome))
    lines += beat_findings(measured.beats, directory)
    lines += stripe_findings(directory)
    return load.judged(lines)


def line_of(outcome: TimingOutcome) -> str:
    """An outcome in words."""
    errors = f"{outcome.rms_arcsec:.3g} arcsec rms, {outcome.worst_arcsec:.3g} maximum"
    cost = f"{outcome.draw_ms:.1f} ms a frame ({outcome.stars} stars)"
    return f"{outcome.way}: {errors}, {outcome.flux_rms_mag:.2g} mag rms, {cost}"


def draw(path: Path, outcomes: Sequence[TimingOutcome], load: Load) -> str:
    """The chart of the outcomes; its finding."""
    rms_arcsec = {}
    for outcome in outcomes:
        if outcome.rate_deg_s == QUICK_RATES_DEG_S[0]:
            rms_arcsec[outcome.way] = outcome.rms_arcsec
    finding = (
        f"At 2 deg/s star positions are off by {rms_arcsec['prediction']:.0f} arcsec rms with"
        f" prediction alone, and by {rms_arcsec['+ smear']:.2g} with scan-out and smear compensated"
    )
    rates = sorted({outcome.rate_deg_s for outcome in outcomes})
    error = PanelSpec(
        (LineSpec("rate_deg_s", "rms_arcsec"),),
        "error of star positions, rms [arcsec]",
        scales=("log", "log"),
    )
    cost = PanelSpec(
        (LineSpec("rate_deg_s", "draw_ms"),),
        "time of a frame [ms]",
        "slew rate [deg/s]",
        scales=("log", "linear"),
        xticks=rates,
        from_zero=True,
    )
    looks = looks_of({way: way for way in WAYS}, MARKERS)
    layout = {"heights": (1.5, 1)}
    spec = ChartSpec((error, cost), lambda row: row.way, looks, TIMING_NOTE, layout=layout)
    draw_rows(path, finding, spec, outcomes, load)
    return finding
