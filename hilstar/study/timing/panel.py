"""A simulated panel that lights row by row and holds each row until it is written again, before the virtual tracker."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.attitude.clock.timeline import Attitude
from hilstar.bench.build import load
from hilstar.bench.cameras import tracker_camera
from hilstar.monitor.quantise import shown_light
from hilstar.render.renderer import Renderer, Target
from hilstar.scene.exposure_motion import Motion, smeared_sprites
from hilstar.scene.frame_motion import Scan
from hilstar.scene.sprites import Sprites
from hilstar.study.shared.bench_text import Table, bench_text
from hilstar.study.timing.slew import PACKET_HZ, Slew
from hilstar.twin.optics import BenchGeometry, TwinOptics
from hilstar.units import NS_PER_S


@dataclass(frozen=True, slots=True)
class Compensation:
    """What a bench compensates: further keys of [monitor], and `motion` of [render]."""

    monitor_keys: Table
    motion: str

    def bench_text(self, exposure_s: float) -> str:
        """The bench file with this compensation."""
        tables: dict[str, Table] = {
            "tracker": {"resolution_px": (800, 640), "exposure_s": exposure_s, "transmission": "n-bk7-10mm"},
            "sky": {"faintest_v_mag": 6.0},
            "monitor": {"resolution_px": (1920, 1080), "pixel_pitch_um": 57.65, "bits": 10, **self.monitor_keys},
            "collimator": {"focal_length_mm": 350},
            "render": {"quantisation": "exact", "motion": self.motion, "brightest_v_mag": 1.5},
        }
        return bench_text(tables)


WAYS = {
    "no prediction": Compensation({}, "off"),
    "prediction": Compensation({}, "off"),
    "+ scan-out": Compensation({"hold_ms": 0}, "on"),
    "+ smear": Compensation({}, "on"),
}
DRAW_TO_SWAP_S = 0.010
EXPOSURE_S = 0.1
START_S = 0.0037  # of the exposure, within a refresh period
REFRESH_MS = 1e3 / 60  # the default of a bench file
FRAME_BEFORE = 1  # the first rows of an exposure still show the frame before
COST_ROUNDS = 9


def frame_weights(rows: FloatArray, swaps_s: Sequence[float], scan: Scan, span_s: tuple[float, float]) -> FloatArray:
    """The share of an exposure (begin, end) for which each row (r,) shows each frame (k,), (k, r); `rows` from 0 to 1.

    A row lights `rows` of the scan-out after the swap, and shows the frame until the next one reaches it.
    """
    begins = np.asarray(swaps_s)[:, None] + rows * scan.scanout_s
    ends = begins + scan.hold_s
    lit = np.minimum(ends, span_s[1]) - np.maximum(begins, span_s[0])
    return np.asarray(np.maximum(lit, 0.0) / (span_s[1] - span_s[0]))


class ScanningPanel:
    """A bench that shows on a panel that scans, with one compensation, and a tracker in front of it. Free it with `close`.

    Rows stay lit for `lit` of a refresh, which the bench knows where it compensates smear.
    """

    def __init__(self, way: str, path: Path, exposure_s: float = EXPOSURE_S, lit: float = 1.0) -> None:
        compensation = WAYS[way]
        if lit < 1:
            compensation = replace(compensation, monitor_keys={**compensation.monitor_keys, "hold_ms": lit * REFRESH_MS})
        path.write_text(compensation.bench_text(exposure_s))
        self.way = way
        self.start_s = START_S
        self.bench = load(path)
        config = self.bench.config
        self.period_s = 1 / config.monitor.refresh_hz
        self.panel_scan = replace(self.bench.scan, scanout_s=self.period_s, hold_s=lit * self.period_s)
        tracker = config.tracker
        self.exposure_s = tracker.exposure_s
        self.camera = tracker_camera(tracker, self.bench.file.folder)
        self.optics = TwinOptics(BenchGeometry(self.bench.camera, self.camera), tracker.psf_sigma_px)
        self.panel = self.bench.panel

    def attitude(self, slew: Slew, swap_s: float) -> Attitude:
        """The attitude that the display derives from the packets received when it starts the frame of a swap."""
        timeline = slew.packets_until(swap_s - DRAW_TO_SWAP_S)
        light_s = swap_s + self.period_s / 2
        if self.way == "no prediction":
            light_s = math.floor((swap_s - DRAW_TO_SWAP_S) * PACKET_HZ) / PACKET_HZ
        attitude = timeline.at(round(light_s * NS_PER_S))
        if attitude is None:
            raise AssertionError("the timeline has packets")
        return attitude

    def draw(self, attitude: Attitude, number: int) -> FloatArray:
        """The light of one frame, (H, W)."""
        rate = attitude.rate_cam_rad_s if self.bench.config.render.motion == "on" else None
        return shown_light(self.bench.draw(attitude.q_icrs_to_cam, number, rate).levels, self.panel)

    def exposed_e_per_s(self, slew: Slew) -> FloatArray:
        """The tracker's image (h, w) of the screen, mean over an exposure."""
        height = self.bench.config.monitor.resolution_px[1]
        span_s = (self.start_s, self.start_s + self.exposure_s)
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
        """Median time of drawing a frame, from its attitude to its codes, ms."""
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

    def __init__(self, shown: ScanningPanel) -> None:
        self._shown = shown
        render = shown.bench.config.render
        self._sigma_px = render.sprite_sigma_px
        self._renderer = Renderer(Target(shown.bench.config.monitor.resolution_px, self._sigma_px))

    def paths(self, slew: Slew) -> Sprites:
        """Each star's path over the exposure, in monitor pixels."""
        middle_s = self._shown.start_s + self._shown.exposure_s / 2
        motion = Motion(slew.at(middle_s), slew.rate_cam_rad_s, self._shown.exposure_s)
        bench = self._shown.bench
        return smeared_sprites(bench.stars, motion, bench.camera, self._renderer.footprint_px, self._sigma_px)

    def exposed_e_per_s(self, slew: Slew) -> FloatArray:
        """The tracker's image (h, w), mean over the exposure."""
        self._renderer.draw(self.paths(slew))
        return self._shown.optics.image_e_per_s(self._renderer.linear().astype(np.float64))

    def close(self) -> None:
        """Free the GL context."""
        self._renderer.close()
