"""What a tracker sees of dots on a bench of traced rays (hilstar.study.geometry.doublet), in any pose, with any loss."""

from __future__ import annotations

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.calibrate.geometric.dots import DotPlan
from hilstar.calibrate.geometric.observed import Observed
from hilstar.scene.camera import Camera
from hilstar.study.geometry.doublet import TracedBench, turned

__all__ = ["TracedBench", "observed_dots", "turned"]


def observed_dots(
    bench: TracedBench,
    plan: DotPlan,
    tracker: Camera,
    rng: np.random.Generator,
    noise_px: float = 0.02,
    lost: float = 0.05,
    false: float = 0.05,
    pose_matrix: FloatArray | None = None,
    pose: int = 0,
) -> Observed:
    """What a tracker, turned by `pose_matrix`, sees of a plan's dots: a share lost, as many false ones, Gaussian noise."""
    directions = bench.directions(plan.x_px, plan.y_px)
    x, y = tracker.project(directions if pose_matrix is None else directions @ pose_matrix.T)
    width, height = tracker.resolution_px
    inside = (x > 0) & (x < width - 1) & (y > 0) & (y < height - 1)
    frames, xs, ys = [], [], []
    for frame in range(plan.frames):
        dots = np.flatnonzero(plan.lit[:, frame] & inside)
        dots = dots[rng.uniform(size=len(dots)) >= lost]
        count = rng.poisson(false * len(dots))
        frames.append(np.full(len(dots) + count, frame))
        xs.append(np.concatenate([x[dots] + rng.normal(0, noise_px, len(dots)), rng.uniform(0, width, count)]))
        ys.append(np.concatenate([y[dots] + rng.normal(0, noise_px, len(dots)), rng.uniform(0, height, count)]))
    frame = np.concatenate(frames)
    return Observed(frame, np.full(len(frame), pose), np.concatenate(xs), np.concatenate(ys), np.ones(len(frame)))
