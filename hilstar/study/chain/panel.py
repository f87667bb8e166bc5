"""What a tracker's exposure gathers from a panel that lights row by row: each row's share of each frame."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from hilstar.arrays import FloatArray, IntArray
from hilstar.bench.frame import Bench
from hilstar.scene.frame_motion import Scan
from hilstar.units import NS_PER_S

# The pixels that a frame lights, as places in its flattened image (n,), and the light of each, electrons per second.
Lit = tuple[IntArray, FloatArray]
START_S = 0.0037  # of the exposure after a frame's first light, within a refresh
MAX_FRAMES = 16


@dataclass(frozen=True, slots=True)
class Exposure:
    """An exposure before a panel: its begin and length, and the frames in it by number and moment of light, ns.

    `weights` (frames, H, 1), of a panel that is turned (frames, 1, W), are what each row of a frame's light is multiplied by.
    """

    begin_s: float
    length_s: float
    numbers: tuple[int, ...]
    light_ns: tuple[int, ...]
    weights: FloatArray

    def middle_ns(self) -> int:
        """The middle of the exposure."""
        return round((self.begin_s + self.length_s / 2) * NS_PER_S)

    def mean(self, light_of: Callable[[int, int], Lit], size_px: tuple[int, int]) -> FloatArray:
        """The mean light (H, W) of an image of `size_px` by what each frame lights, by its number and moment of light."""
        width, height = size_px
        total = np.zeros(height * width)
        for number, light_ns, weight in zip(self.numbers, self.light_ns, self.weights, strict=True):
            place, light = light_of(number, light_ns)
            at = place // width if weight.shape[1] == 1 else place % width
            total[place] += weight.ravel()[at] * light
        return total.reshape(height, width)

    def at_rest(self, light_of: Callable[[int, int], Lit], size_px: tuple[int, int]) -> FloatArray:
        """The same where all frames are alike: by the first of them."""
        whole = self.weights.sum(axis=0, keepdims=True)
        return replace(self, numbers=self.numbers[:1], light_ns=self.light_ns[:1], weights=whole).mean(light_of, size_px)


def exposure_s(bench: Bench) -> float:
    """The tracker's exposure, or MAX_FRAMES refreshes of a longer one."""
    return min(bench.config.tracker.exposure_s, MAX_FRAMES / bench.config.monitor.refresh_hz)


def shortened_line(bench: Bench) -> str | None:
    """What is said where an exposure is longer than what is measured of it; None where it is not."""
    whole_s, measured_s = bench.config.tracker.exposure_s, exposure_s(bench)
    if measured_s == whole_s:
        return None
    return f"exposures of {MAX_FRAMES} refreshes, {measured_s:.3g} s, in the place of [tracker] exposure_s = {whole_s:g}"


def exposure(bench: Bench, first_frame: int) -> Exposure:
    """An exposure that begins START_S after the first light of a frame's middle row."""
    period_s, length_s, scan = 1 / bench.config.monitor.refresh_hz, exposure_s(bench), bench.scan
    begin_s = first_frame * period_s + START_S % period_s
    late_s = row_delays_s(scan, bench.camera.resolution_px)
    before = math.ceil((scan.scanout_s / 2 + scan.hold_s) / period_s) + 1
    numbers = range(first_frame - before, first_frame + math.ceil(length_s / period_s) + before + 1)
    weights = np.stack([row_share(number * period_s + late_s, scan, period_s, (begin_s, length_s)) for number in numbers])
    used = [bool(weight.any()) for weight in weights]
    kept = tuple(number for number, is_used in zip(numbers, used, strict=True) if is_used)
    return Exposure(begin_s, length_s, kept, tuple(round(n * period_s * NS_PER_S) for n in kept), weights[used])


def row_delays_s(scan: Scan, resolution_px: tuple[int, int]) -> FloatArray:
    """How long after the middle row each row lights, (H, 1); each column of a panel that is turned, (1, W)."""
    width, height = resolution_px
    if scan.down[0]:
        x_px = np.arange(width, dtype=np.float64)
        return scan.late_s(x_px, np.full(width, (height - 1) / 2), resolution_px)[None, :]
    y_px = np.arange(height, dtype=np.float64)
    return scan.late_s(np.full(height, (width - 1) / 2), y_px, resolution_px)[:, None]


def row_share(lit_s: FloatArray, scan: Scan, period_s: float, span_s: tuple[float, float]) -> FloatArray:
    """What a frame's rows that light at `lit_s` add to the mean over an exposure (begin, length).

    1 over all frames where the exposure is a whole number of refreshes: a panel that flashes gives a refresh's light at once.
    """
    begin_s, length_s = span_s
    if not scan.hold_s:
        return np.asarray(((lit_s >= begin_s) & (lit_s < begin_s + length_s)) * (period_s / length_s))
    lit = np.minimum(lit_s + scan.hold_s, begin_s + length_s) - np.maximum(lit_s, begin_s)
    return np.asarray(np.maximum(lit, 0.0) / scan.hold_s * (period_s / length_s))
