"""What a virtual tracker sees of the dots on a traced bench: some lost, as many false, the rest with Gaussian noise."""

from __future__ import annotations

import numpy as np

from hilstar.calibrate.geometric.dots import DotPlan
from hilstar.calibrate.geometric.observed import Observed
from hilstar.scene.camera import Camera
from hilstar.study.geometry.doublet import TracedBench

LOST_SHARE = FALSE_SHARE = 0.05


def observed_dots(bench: TracedBench, plan: DotPlan, tracker: Camera, noise_px: float, rng: np.random.Generator) -> Observed:
    """Centroids of the dots in the tracker's field, each off by `noise_px` (one sigma, one axis)."""
    x, y = tracker.project(bench.directions(plan.x_px, plan.y_px))
    width, height = tracker.resolution_px
    inside = (x > 0) & (x < width - 1) & (y > 0) & (y < height - 1)
    frames, xs, ys = [], [], []
    for frame in range(plan.frames):
        dots = np.flatnonzero(plan.lit[:, frame] & inside)
        dots = dots[rng.uniform(size=len(dots)) >= LOST_SHARE]
        count = rng.poisson(FALSE_SHARE * len(dots))
        frames.append(np.full(len(dots) + count, frame))
        xs.append(np.concatenate([x[dots] + rng.normal(0, noise_px, len(dots)), rng.uniform(0, width, count)]))
        ys.append(np.concatenate([y[dots] + rng.normal(0, noise_px, len(dots)), rng.uniform(0, height, count)]))
    frame_of = np.concatenate(frames)
    return Observed(frame_of, np.zeros_like(frame_of), np.concatenate(xs), np.concatenate(ys), np.ones(len(frame_of)))
