"""What a tracker sees of a plan's dots: some lost, some false, the rest with Gaussian noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hilstar.arrays import FloatArray, IntArray
from hilstar.calibrate.geometric.dots import DotPlan
from hilstar.calibrate.geometric.observed import Observed


@dataclass(frozen=True, slots=True)
class Faults:
    """The noise of a centroid (one sigma, one axis), the share of lit dots that are lost, and that of false ones."""

    noise_px: float = 0.02
    lost: float = 0.05
    false: float = 0.05


def observed_dots(
    plan: DotPlan, x_px: FloatArray, y_px: FloatArray, resolution_px: tuple[int, int], faults: Faults, rng: np.random.Generator
) -> Observed:
    """Centroids of the lit dots that are at (x, y) (n,) in a tracker's image of `resolution_px`, frame by frame."""
    width, height = resolution_px
    inside = (x_px > 0) & (x_px < width - 1) & (y_px > 0) & (y_px < height - 1)
    frames: list[IntArray] = []
    xs: list[FloatArray] = []
    ys: list[FloatArray] = []
    for frame in range(plan.frames):
        dots = np.flatnonzero(plan.lit[:, frame] & inside)
        dots = dots[rng.uniform(size=len(dots)) >= faults.lost]
        false = rng.poisson(faults.false * len(dots))
        frames.append(np.full(len(dots) + false, frame))
        for places, found, size in ((x_px, xs, width), (y_px, ys, height)):
            seen = places[dots] + rng.normal(0, faults.noise_px, len(dots))
            found.append(np.concatenate([seen, rng.uniform(0, size, false)]))
    frame_of = np.concatenate(frames)
    return Observed(frame_of, np.zeros_like(frame_of), np.concatenate(xs), np.concatenate(ys), np.ones(len(frame_of)))
