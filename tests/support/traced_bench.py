"""What a tracker sees of dots on a bench of traced rays (hilstar.instruments.study.geometry), in
any pose, with any loss.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.instruments.calibrate.geometric.dots import DotPlan
from hilstar.instruments.calibrate.geometric.observed import Observed
from hilstar.instruments.study.geometry import DotFaults, TracedBench, turned
from hilstar.instruments.study.geometry import observed_dots as dots_seen
from hilstar.optics.camera import Camera

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
    """What a tracker, turned by `pose_matrix`, sees of a plan's dots: a share lost, as many
    false ones, Gaussian noise.
    """
    directions = bench.directions(plan.x_px, plan.y_px)
    x, y = tracker.project(directions if pose_matrix is None else directions @ pose_matrix.T)
    seen = dots_seen(plan, x, y, tracker.resolution_px, DotFaults(noise_px, lost, false), rng)
    return replace(seen, pose=np.full(len(seen), pose))
