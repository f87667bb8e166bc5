"""What a solver is asked, what it answers, and how it fails."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.bench.config import BenchConfig
from hilstar.errors import shortened
from hilstar.scene.camera import Camera
from hilstar.twin.simulator import Exposure

MAX_NORM_ERROR = 1e-3  # of a quaternion that is unit but for its decimals


class SolverFault(Exception):
    """A solver failed: it raised, ended with an error, took too long, or answered what is no attitude."""


class Tracker(Protocol):
    """The tracker whose images are solved."""

    config: BenchConfig
    camera: Camera


@dataclass(frozen=True, slots=True)
class StarErrors:
    """Centroids of one image against the truth: counts, and x and y errors (n,), px, measured minus true, of matched stars.

    `stars` are on the detector, `matched` of them found within MATCH_PX, and `false` finds are no star's. The errors are those
    of stars that are neither clipped, nor at the edge, nor crowded; `x_px`, `y_px` (n,) are their true places and `v_mag`
    (n,) their magnitudes.
    """

    stars: int
    found: int
    matched: int
    false: int
    dx_px: FloatArray
    dy_px: FloatArray
    x_px: FloatArray
    y_px: FloatArray
    v_mag: FloatArray


@dataclass(frozen=True, slots=True)
class Answer:
    """An attitude, or None and why there is none; with centroids, their errors."""

    q_icrs_to_cam: FloatArray | None
    why: str = ""
    star_errors: StarErrors | None = None


class Solver(Protocol):
    """Anything that solves an image. Raises SolverFault."""

    def solve(self, exposure: Exposure, tracker: Tracker) -> Answer:
        """The attitude of one exposure."""
        ...


def checked_attitude(numbers: object, who: str) -> FloatArray:
    """An answer as a unit quaternion (4,), scalar first. Raises SolverFault where it is none."""
    try:
        q = np.asarray(numbers, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise SolverFault(f"{who}: answered {shortened(numbers)}; four numbers w, x, y, z are wanted") from error
    if q.shape != (4,) or not np.isfinite(q).all():
        raise SolverFault(f"{who}: answered {shortened(numbers)}; four numbers w, x, y, z are wanted")
    norm = float(np.linalg.norm(q))
    if abs(norm - 1) > MAX_NORM_ERROR:
        raise SolverFault(f"{who}: answered a quaternion of norm {norm:.6g}; a unit one is wanted")
    return np.asarray(q / norm)
