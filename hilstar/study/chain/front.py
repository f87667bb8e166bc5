"""Which combinations no other beats, and whether `auto` is one of them, as far as the run's own noise can tell.

A point is on the front unless another one of its scene has a time and an error that are both no larger, and one of them
smaller: two points that are equal in both are both on it. The figures are those of the table, rounded as they stand there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hilstar.arrays import BoolArray, FloatArray


@dataclass(frozen=True, slots=True)
class Point:
    """A combination's time and error, and one sigma of its median time."""

    time_ms: float
    error: float
    time_noise_ms: float = 0.0


def beaten_by(points: Sequence[Point]) -> BoolArray:
    """(n, n): whether the point of a row is beaten by that of a column."""
    time: FloatArray = np.array([point.time_ms for point in points])
    error: FloatArray = np.array([point.error for point in points])
    as_good = (time <= time[:, None]) & (error <= error[:, None])
    better = (time < time[:, None]) | (error < error[:, None])
    return np.asarray(as_good & better)


def front(points: Sequence[Point]) -> list[bool]:
    """Whether each point is on the front."""
    return [not row.any() for row in beaten_by(points)]


def beyond_noise(point: Point, other: Point) -> bool:
    """Whether `other`, which beats `point`, is faster by more than three sigmas of the difference of their medians.

    Else their times cannot be told apart, and which of them is on the front is chance, as far as this run knows.
    """
    noise_ms = 3 * float(np.hypot(point.time_noise_ms, other.time_noise_ms))
    return point.time_ms - other.time_ms > noise_ms or not noise_ms


def beaters(points: Sequence[Point], which: int) -> tuple[list[int], list[int]]:
    """The points that beat one of them: those beyond the noise, and those within it."""
    found = np.flatnonzero(beaten_by(points)[which]).tolist()
    beyond = [k for k in found if beyond_noise(points[which], points[k])]
    return beyond, [k for k in found if k not in beyond]
