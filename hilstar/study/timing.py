"""What a screen's timing does to a tracker on a slew, and what each compensation is worth and costs.

A simulated panel lights row by row and holds each row until it is written anew; the virtual tracker integrates over several
of its frames. Its image is set against that of the sky in the same exposure, star by star.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.attitude.clock.timeline import Attitude, Policy, Timeline
from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.bench.build import Bench
from hilstar.charts import chart, plain_ticks, write_csv
from hilstar.monitor.geometry import monitor_camera
from hilstar.monitor.quantise import Panel, shown_light
from hilstar.render.renderer import Renderer, Target
from hilstar.rotation import from_radec_roll_deg, propagate
from hilstar.scene.camera import Camera
from hilstar.scene.exposure_motion import Motion, smeared_sprites
from hilstar.scene.frame_motion import Scan
from hilstar.scene.sprites import Sprites
from hilstar.study.economy import moments
from hilstar.twin.optics import Mounting, TwinOptics
from hilstar.twin.simulator import NO_ALIGNMENT
from hilstar.units import ARCSEC_PER_RAD, NS_PER_S

BENCH = """
[tracker]
aperture_mm = 30
focal_length_mm = 70
pixel_pitch_um = 13
resolution_px = [800, 640]
exposure_s = 0.1
quantum_efficiency = "ccd47-20"
transmission = "n-bk7-10mm"
[sky]
faintest_v_mag = 6.0
[monitor]
resolution_px = [1920, 1080]
pixel_pitch_um = 57.65
bits = 10
{monitor}
[collimator]
focal_length_mm = 350
[render]
quantisation = "exact"
motion = "{motion}"
brightest_v_mag = 1.5
"""
# Of each way: its name, its keys of [monitor], and whether anything moves within a frame.
WAYS = {
    "no prediction": ("", "off"),
    "prediction": ("", "off"),
    "+ scan-out": ("hold_ms = 0", "on"),
    "+ smear": ("", "on"),
}
RATES_DEG_S = (0.01, 0.03, 0.1, 0.3, 1.0, 2.0, 4.0)
QUICK_RATES_DEG_S = (2.0,)
AXIS = np.array([0.6, 0.8, 0.0])  # across rows and columns
RADEC_ROLL_DEG = (84.0, 0.0, 15.0)  # Orion: stars enough that are bright
PACKET_HZ = 200.0
DRAW_TO_SWAP_S = 0.010
START_S = 0.0037  # of the exposure, within a refresh period
FRAME_BEFORE = 1  # the first rows of an exposure still show the frame before
MARGIN_PX = 8.0  # of a star's window around its path: the largest error here, and the PSF
ALONE = 1e-3  # of its light, at most, that others may bring into a star's window
COST_ROUNDS = 9


@dataclass(frozen=True, slots=True)
class Outcome:
    """One way at one rate: errors of the tracker's centroids, arcsec, their rms and worst, of flux, mag rms; time to draw."""

    way: str
    rate_deg_s: float
    stars: int
    rms_arcsec: float
    worst_arcsec: float
    flux_rms_mag: float
    draw_ms: float


@dataclass(frozen=True, slots=True)
class Slew:
    """A turn at a constant rate from t = 0 on, and the packets that tell of it."""

    rate_deg_s: float

    @property
    def rate_cam_rad_s(self) -> FloatArray:
        """Of cam in icrs, cam components."""
        return np.asarray(math.radians(self.rate_deg_s) * AXIS)

    def at(self, seconds: float) -> FloatArray:
        """The true attitude."""
        return propagate(from_radec_roll_deg(*RADEC_ROLL_DEG), self.rate_cam_rad_s, seconds)

    def packets_until(self, seconds: float) -> Timeline:
        """What has come by then."""
        timeline = Timeline(Policy(NS_PER_S, NS_PER_S))
        last = math.floor(seconds * PACKET_HZ)
        for number in range(last - 3, last + 1):
            t_s = number / PACKET_HZ
            timeline.add(AttitudeSample(round(t_s * NS_PER_S), self.at(t_s), self.rate_cam_rad_s, number))
        return timeline


def frame_weights(rows: FloatArray, swaps_s: Sequence[float], scan: Scan, span_s: tuple[float, float]) -> FloatArray:
    """The share of an exposure (begin, end) for which each row (r,) shows each frame (k,), (k, r); `rows` from 0 to 1.

    A row lights `rows` of the scan-out after the swap, and shows the frame until the next one reaches it.
    """
    begins = np.asarray(swaps_s)[:, None] + rows * scan.scanout_s
    ends = begins + scan.hold_s
    lit = np.minimum(ends, span_s[1]) - np.maximum(begins, span_s[0])
    return np.asarray(np.maximum(lit, 0.0) / (span_s[1] - span_s[0]))


class Stand:
    """A bench of one way before a panel that scans, and a tracker that looks at it. Free it with `close`."""

    def __init__(self, way: str, path: Path) -> None:
        keys, motion = WAYS[way]
        path.write_text(BENCH.format(monitor=keys, motion=motion))
        self.way = way
        self.bench = Bench(path)
        config = self.bench.config
        self.period_s = 1 / config.monitor.refresh_hz
        self.panel_scan = replace(self.bench.scan, scanout_s=self.period_s, hold_s=self.period_s)
        tracker = config.tracker
        self.exposure_s = tracker.exposure_s
        self.camera = monitor_camera(tracker.resolution_px, tracker.pixel_pitch_um, tracker.focal_length_mm, NO_ALIGNMENT)
        self.optics = TwinOptics(Mounting(self.bench.camera, self.camera), tracker.psf_sigma_px)
        self.panel = Panel(self.bench.calibration.response, self.bench.flux_at_white_e_per_s, self.bench.uniformity)

    def attitude(self, slew: Slew, swap_s: float) -> Attitude:
        """What the display makes of the packets that have come when it begins the frame of a swap."""
        timeline = slew.packets_until(swap_s - DRAW_TO_SWAP_S)
        light_s = swap_s + self.period_s / 2
        if self.way == "no prediction":
            light_s = math.floor((swap_s - DRAW_TO_SWAP_S) * PACKET_HZ) / PACKET_HZ
        attitude = timeline.at(round(light_s * NS_PER_S))
        if attitude is None:
            raise AssertionError("packets have come")
        return attitude

    def draw(self, attitude: Attitude, number: int) -> FloatArray:
        """The light of one frame, (H, W)."""
        rate = attitude.rate_cam_rad_s if self.bench.config.render.motion == "on" else None
        return shown_light(self.bench.draw(attitude.q_icrs_to_cam, number, rate).levels, self.panel)

    def exposed_e_per_s(self, slew: Slew) -> FloatArray:
        """The tracker's image (h, w) of the screen, mean over an exposure."""
        height = self.bench.config.monitor.resolution_px[1]
        span_s = (START_S, START_S + self.exposure_s)
        first = math.floor((span_s[0] - 2 * self.period_s) / self.period_s) - FRAME_BEFORE
        numbers = range(first, math.ceil(span_s[1] / self.period_s) + 1)
        swaps_s = [number * self.period_s for number in numbers]
        weights = frame_weights((np.arange(height) + 0.5) / height, swaps_s, self.panel_scan, span_s)
        light = np.zeros((height, self.bench.config.monitor.resolution_px[0]))
        for number, swap_s, weight in zip(numbers, swaps_s, weights, strict=True):
            if weight.any():
                light += weight[:, None] * self.draw(self.attitude(slew, swap_s), number)
        return self.optics.image_e_per_s(light)

    def cost_ms(self, slew: Slew) -> float:
        """Median time of drawing a frame, attitude in to codes ready."""
        attitude = self.attitude(slew, 0.0)
        rate = attitude.rate_cam_rad_s if self.bench.config.render.motion == "on" else None
        times = []
        for number in range(COST_ROUNDS):
            begin_s = time.perf_counter()
            _ = self.bench.draw(attitude.q_icrs_to_cam, number, rate).levels
            times.append((time.perf_counter() - begin_s) * 1e3)
        return float(np.median(times))

    def close(self) -> None:
        """Free the GL contexts."""
        self.bench.close()
        self.optics.close()


class Sky:
    """The same tracker's image of the sky itself, spread by the sprites' width. Free it with `close`."""

    def __init__(self, stand: Stand) -> None:
        self._stand = stand
        render = stand.bench.config.render
        self._sigma_px = render.sprite_sigma_px
        self._renderer = Renderer(Target(stand.bench.config.monitor.resolution_px, self._sigma_px))

    def paths(self, slew: Slew) -> Sprites:
        """Each star's path over the exposure, in monitor pixels."""
        middle_s = START_S + self._stand.exposure_s / 2
        motion = Motion(slew.at(middle_s), slew.rate_cam_rad_s, self._stand.exposure_s)
        bench = self._stand.bench
        return smeared_sprites(bench.stars, motion, bench.camera, self._renderer.footprint_px, self._sigma_px)

    def exposed_e_per_s(self, slew: Slew) -> FloatArray:
        """The tracker's image (h, w), mean over the exposure."""
        self._renderer.draw(self.paths(slew))
        return self._stand.optics.image_e_per_s(self._renderer.linear().astype(np.float64))

    def close(self) -> None:
        """Free the GL context."""
        self._renderer.close()


def star_windows(paths: Sprites, mounting: Mounting, size_px: tuple[int, int]) -> Iterator[tuple[slice, slice]]:
    """Rows and columns of the tracker's image around each star's path, of stars that are alone there and whole on it."""
    x_px, y_px = mounting.to_tracker(paths.x_px, paths.y_px)
    light = paths.data["electrons_per_s"]
    width, height = size_px
    for star in np.unique(paths.star):
        own = paths.star == star
        left, right = x_px[own].min() - MARGIN_PX, x_px[own].max() + MARGIN_PX
        top, bottom = y_px[own].min() - MARGIN_PX, y_px[own].max() + MARGIN_PX
        if left < 0 or top < 0 or right > width - 1 or bottom > height - 1:
            continue
        reach = MARGIN_PX
        near = (x_px > left - reach) & (x_px < right + reach) & (y_px > top - reach) & (y_px < bottom + reach) & ~own
        if light[near].sum() < ALONE * light[own].sum():
            yield slice(int(top), int(bottom) + 1), slice(int(left), int(right) + 1)


def compare(stand: Stand, sky: Sky, slew: Slew) -> Outcome:
    """One way on one slew, against the sky."""
    shown, true = stand.exposed_e_per_s(slew), sky.exposed_e_per_s(slew)
    camera: Camera = stand.camera
    flux_mag, off_px = [], []
    for window in star_windows(sky.paths(slew), stand.optics.mounting, camera.resolution_px):
        (light, x_px, y_px), (true_light, true_x_px, true_y_px) = moments(shown, window), moments(true, window)
        flux_mag.append(-2.5 * math.log10(light / true_light))
        off_px.append(math.hypot(x_px - true_x_px, y_px - true_y_px))
    off_arcsec = np.array(off_px) * ARCSEC_PER_RAD / camera.focal_length_px
    rms_arcsec, rms_mag = (float(np.sqrt(np.mean(np.square(v)))) for v in (off_arcsec, flux_mag))
    return Outcome(stand.way, slew.rate_deg_s, len(off_px), rms_arcsec, float(off_arcsec.max()), rms_mag, stand.cost_ms(slew))


@contextmanager
def _stands() -> Iterator[tuple[list[Stand], Sky]]:
    with TemporaryDirectory() as folder, ExitStack() as stack:
        stands = []
        for number, way in enumerate(WAYS):
            stands.append(Stand(way, Path(folder) / f"{number}.toml"))
            stack.callback(stands[-1].close)
        sky = Sky(stands[0])
        stack.callback(sky.close)
        yield stands, sky


def measure(quick: bool = False) -> list[Outcome]:
    """Every way at every rate."""
    with _stands() as (stands, sky):
        rates = QUICK_RATES_DEG_S if quick else RATES_DEG_S
        return [compare(stand, sky, Slew(rate)) for rate in rates for stand in stands]


def run(directory: Path, quick: bool = False) -> list[str]:
    """Measure, and write `timing.csv` and `timing.png`; what was found. Raises InputError where they cannot be written."""
    outcomes = measure(quick)
    write_csv(directory / "timing.csv", Outcome.__slots__, [[getattr(o, name) for name in Outcome.__slots__] for o in outcomes])
    at = {(o.way, o.rate_deg_s): o for o in outcomes}
    plain, best = (at[way, 2.0] for way in ("prediction", "+ smear"))
    finding = (
        f"At 2 deg/s on a 60 Hz panel and 0.1 s of exposure a star is {plain.rms_arcsec:.0f} arcsec off with prediction alone, "
        f"{best.rms_arcsec:.2g} with each row at its own moment and paths within the frame"
    )
    _draw(directory / "timing.png", finding, outcomes)
    return [finding, *(_line(at[way, 2.0]) for way in WAYS)]


def _line(outcome: Outcome) -> str:
    errors = f"{outcome.rms_arcsec:.3g} arcsec rms, {outcome.worst_arcsec:.3g} at worst, {outcome.flux_rms_mag:.2g} mag rms"
    return f"{outcome.way}: {errors}, {outcome.draw_ms:.1f} ms a frame ({outcome.stars} stars)"


def _draw(path: Path, finding: str, outcomes: list[Outcome]) -> None:
    with chart(path, finding, panels=2) as (error, cost):
        for way, marker in zip(WAYS, "osd^", strict=True):
            mine = [o for o in outcomes if o.way == way]
            rates = [o.rate_deg_s for o in mine]
            error.loglog(rates, [o.rms_arcsec for o in mine], marker=marker, label=way)
            cost.semilogx(rates, [o.draw_ms for o in mine], marker=marker, label=way)
        error.set_ylabel("star position error, arcsec rms")
        error.legend(loc="upper left")
        cost.set_ylabel("time to draw a frame, ms")
        cost.set_ylim(bottom=0)
        cost.set_xlabel("slew rate, deg/s")
        plain_ticks(cost.xaxis, sorted({o.rate_deg_s for o in outcomes}))
