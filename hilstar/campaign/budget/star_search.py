"""The direction in the sky whose phase within a pixel an error follows, where nobody says which star counts.

The phase of one direction makes a wave; another direction, eta px away, has the wave of another frequency as soon as the camera
rolls. So short stretches of the run, in which the roll changes little, are correlated with the waves of a coarse grid of
directions, and their powers are added; then both are refined by halves, until the whole run is one stretch.
"""

from __future__ import annotations

import numpy as np

from hilstar.arrays import FloatArray, IntArray
from hilstar.campaign.budget.scale import Scale

MIN_FORWARD = 0.3  # of a direction along the boresight, for its place on the detector's plane
GRID = 40  # directions along each side
PHASE_CYCLES = 0.25  # that a stretch may lose at the edge of a grid's cell
MIN_STRETCH, MAX_STRETCH = 16, 256  # answers
COARSE_ANSWERS, FINE_ANSWERS = 3000, 8000  # that are looked at, spread over the run
KEPT = 4  # directions, from one grid to the next
LEVELS = 14
FINEST_PX = 0.02


def best_direction(residual_arcsec: FloatArray, axes: FloatArray, scale: Scale) -> FloatArray | None:
    """The direction (3,), ICRS, whose waves explain most of residuals (n, 3); None where the run sees no common half sky."""
    boresight = axes[:, 2]
    mean = boresight.mean(axis=0)
    size = float(np.linalg.norm(mean))
    if size < MIN_FORWARD or (boresight @ mean).min() < 2 * MIN_FORWARD * size:
        return None
    frame = _frame(mean / size)
    seen = boresight @ frame.T
    trace = seen[:, :2] / seen[:, 2:]
    margin = 0.5 * max(scale.resolution_px) / scale.focal_px
    low, high = trace.min(axis=0) - margin, trace.max(axis=0) + margin
    step = (high - low) / (GRID - 1)
    grid = np.stack(np.meshgrid(*(np.linspace(a, b, GRID) for a, b in zip(low, high, strict=True))), axis=-1).reshape(-1, 2)
    value = residual_arcsec / np.maximum(residual_arcsec.std(axis=0), 1e-9)
    search = _Search(value, axes, frame, scale)
    best = grid
    for level in range(LEVELS):
        score = search.score(best, step, COARSE_ANSWERS if level == 0 else FINE_ANSWERS)
        order = np.argsort(-score)
        best = best[order[: KEPT if level < LEVELS - 1 else 1]]
        if float(np.max(step)) * scale.focal_px < FINEST_PX:
            break
        step = step / 2
        around = np.stack(np.meshgrid((-1, 0, 1), (-1, 0, 1)), axis=-1).reshape(-1, 2) * step
        best = (best[:, None] + around).reshape(-1, 2)
    return np.asarray(search.directions(best[:1])[0])


def _frame(z: FloatArray) -> FloatArray:
    """Axes (3, 3) of a right-handed frame with the third along `z` (3,)."""
    aside = np.eye(3)[int(np.argmin(np.abs(z)))]
    x = np.cross(aside, z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


class _Search:
    """Residuals (n, 3) in units of their spread, and the camera's axes (n, 3, 3), in which waves are sought."""

    def __init__(self, value: FloatArray, axes: FloatArray, frame: FloatArray, scale: Scale) -> None:
        self.value, self.axes, self.frame, self.scale = value, axes, frame, scale
        steps = axes[1:] @ np.swapaxes(axes[:-1], 1, 2)
        self.roll = np.concatenate([[0.0], np.cumsum(np.abs(steps[:, 0, 1]))])  # rad, the way that it goes

    def directions(self, tangent: FloatArray) -> FloatArray:
        """Unit vectors (k, 3), ICRS, of points (k, 2) of the plane about the frame's third axis."""
        vector = np.concatenate([tangent, np.ones((len(tangent), 1))], axis=1) @ self.frame
        return np.asarray(vector / np.linalg.norm(vector, axis=1, keepdims=True))

    def score(self, tangent: FloatArray, step: FloatArray, answers: int) -> FloatArray:
        """The power (k,) of each direction's waves in stretches that its cell of the grid allows."""
        start = self._stretches(float(np.max(step)) * self.scale.focal_px)
        if answers < len(self.value):
            start, rows = _some(start, len(self.value), answers)
        else:
            rows = np.arange(len(self.value))
        value, axes = self.value[rows], self.axes[rows]
        scores = np.zeros(len(tangent))
        for k, direction in enumerate(self.directions(tangent)):
            seen = axes @ direction
            angle = (2 * np.pi * self.scale.focal_px) * (seen[:, :2] / seen[:, 2:])
            for wave in (np.cos(angle), np.sin(angle)):
                sums = np.add.reduceat((value[:, :, None] * wave[:, None]).reshape(-1, 6), start, axis=0)
                scores[k] += float((sums**2).sum())
        return scores

    def _stretches(self, cell_px: float) -> IntArray:
        """Where stretches (m,) begin whose phase holds over a cell."""
        turn = PHASE_CYCLES / cell_px
        by_roll = np.floor(self.roll / turn).astype(np.int64)
        longest = len(self.roll) if cell_px < 1 else MAX_STRETCH
        by_count = np.arange(len(self.roll)) // longest
        start = np.flatnonzero(np.diff(by_roll, prepend=-1) | np.diff(by_count, prepend=-1))
        kept = [0]
        for each in start[1:].tolist():
            if each - kept[-1] >= MIN_STRETCH:
                kept.append(each)
        return np.array(kept)


def _some(start: IntArray, total: int, answers: int) -> tuple[IntArray, IntArray]:
    """Stretches spread over the run that have about so many answers together: their beginnings, and all their rows."""
    end = np.append(start[1:], total)
    many = max(4, round(len(start) * answers / total))
    chosen = np.unique(np.linspace(0, len(start) - 1, many).astype(int))
    length = (end - start)[chosen]
    rows = np.concatenate([np.arange(start[k], end[k]) for k in chosen])
    return np.concatenate([[0], np.cumsum(length)[:-1]]), rows
