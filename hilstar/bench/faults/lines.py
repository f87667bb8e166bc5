"""Light along straight lines of the tracker's or the monitor's pixels, as one camera sees it: chains of sprites."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hilstar.arrays import FloatArray, IntArray
from hilstar.bench.faults.kinds import CosmicRays
from hilstar.scene.camera import Camera

# Sprites this many sigmas apart make a line whose brightness ripples by 2 exp(-2 pi^2 / 1.5^2) = 3e-4.
STEP_SIGMA = 1.5
MAX_STEPS = 20_000  # on one line


@dataclass(frozen=True, slots=True)
class Chain:
    """Points of light (n,): pixels of a camera, electrons per second, and which of `lines` lines each is of."""

    x_px: FloatArray
    y_px: FloatArray
    electrons_per_s: FloatArray
    line: IntArray
    lines: int


@dataclass(frozen=True, slots=True)
class Lines:
    """Straight lines (n, 2) in pixels of a camera, each with its light, electrons per second (n,), evenly along it."""

    begin_px: FloatArray
    end_px: FloatArray
    electrons_per_s: FloatArray

    def seen_by(self, camera: Camera, source: Camera, sigma_px: tuple[float, float]) -> Chain:
        """The lines in pixels of `source` as `camera` sees them; lines behind it or beyond its lens have no points."""
        ends = [np.stack(moved(camera, source, *place.T)) for place in (self.begin_px, self.end_px)]
        length_sigma = np.hypot(*((ends[1] - ends[0]) / np.array(sigma_px)[:, None]))
        known = np.nan_to_num(length_sigma, nan=-1.0, posinf=-1.0)
        counts = np.where(known < 0, 0, np.minimum(np.ceil(known / STEP_SIGMA), MAX_STEPS - 1).astype(np.intp) + 1)
        line = np.repeat(np.arange(len(counts)), counts)
        first = np.repeat(np.cumsum(counts) - counts, counts)
        # One point of a line that is none lies at its place; those of a longer one in the middles of its equal parts.
        share = ((np.arange(len(line)) - first + 0.5) / counts[line])[:, None]
        places = self.begin_px[line] * (1 - share) + self.end_px[line] * share
        x_px, y_px = moved(camera, source, *places.T)
        return Chain(x_px, y_px, self.electrons_per_s[line] / counts[line], line, len(counts))


def moved(camera: Camera, source: Camera, x_px: FloatArray, y_px: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Pixels of `camera` at pixels (n,) of `source`; NaN behind it and beyond a lens."""
    if camera is source:
        return np.asarray(x_px, dtype=np.float64), np.asarray(y_px, dtype=np.float64)
    return camera.project(source.rays(x_px, y_px) @ camera.cam_to_image.T)


def tracks(burst: CosmicRays, resolution_px: tuple[int, int], exposure_s: float, rng: np.random.Generator) -> Lines:
    """The tracks of one exposure in tracker pixels: their middles anywhere on the detector, in any direction."""
    width, height = resolution_px
    middle = rng.random((burst.number, 2)) * (width, height) - 0.5
    angle = rng.uniform(0.0, 2 * np.pi, burst.number)
    half = burst.length_px / 2 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return Lines(middle - half, middle + half, np.full(burst.number, burst.electrons / exposure_s))
