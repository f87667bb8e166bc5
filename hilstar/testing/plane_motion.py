"""How a whole image moves: a shift, with turn and scale, or a homography, fitted so that outliers do not matter."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hilstar.arrays import FloatArray

MORE_STARS = 0.1  # of all: how many more stars a motion with more parameters has to explain
ROUNDS = 40  # of reweighted least squares, which converge to the minimum sum of absolute residuals
FINEST_PX = 1e-4  # smaller residuals all weigh the same
MIN_SHARE = 0.5  # of the median star's displacement, which a motion must explain

# Displacements (n, 2), px, of places (n, 2), px from the middle of the image.
Motion = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True, slots=True)
class MotionFigures:
    """A motion in the middle of the image: shift, px, turn and scale; 0 for what moves no star by more than its limit."""

    shift_px: tuple[float, float]
    rotation_deg: float
    scale_error: float


def common_motion(places: FloatArray, moves: FloatArray, limits_px: FloatArray) -> Motion | None:
    """The simplest motion that explains the moves (n, 2) of stars at `places` (n, 2) from the middle; None for none."""
    before = np.hypot(*moves.T)
    if np.median(before) <= np.median(limits_px):
        return None
    best = fitted_motion(places, moves, 1)
    left = _left(best, places, moves)
    for rank in range(2, rank_for(len(places)) + 1):
        richer = fitted_motion(places, moves, rank)
        then = _left(richer, places, moves)
        more = (then <= limits_px).mean() > (left <= limits_px).mean() + MORE_STARS
        nearer = np.median(left) > np.median(limits_px) and np.median(then) < MIN_SHARE * np.median(left)
        if more or nearer:
            best, left = richer, then
    return best if np.median(left) <= MIN_SHARE * np.median(before) else None


def _left(motion: Motion, places: FloatArray, moves: FloatArray) -> FloatArray:
    return np.asarray(np.hypot(*(moves - motion(places)).T))


def rank_for(stars: int) -> int:
    """The rank of the richest motion that `stars` stars determine: 1 a shift, 2 with turn and scale, 3 a homography."""
    return 3 if stars >= 16 else 2 if stars >= 6 else 1


def fitted_motion(places: FloatArray, moves: FloatArray, rank: int) -> Motion:
    """The motion of a rank that has the minimum sum of absolute residuals."""
    scale = float(np.abs(places).max()) or 1.0
    (x, y), (u, v) = (places / scale).T, ((places + moves) / scale).T
    ones, zeros = np.ones_like(x), np.zeros_like(x)
    if rank == 1:
        columns = [(ones, zeros), (zeros, ones)]
    elif rank == 2:
        columns = [(ones, zeros), (zeros, ones), (x, y), (-y, x)]
    else:  # a homography, as of a camera that turns: u (1 + g x + h y) = a x + b y + c is linear in its eight numbers
        columns = [
            (ones, zeros),
            (zeros, ones),
            (x, zeros),
            (y, zeros),
            (zeros, x),
            (zeros, y),
            (-u * x, -v * x),
            (-u * y, -v * y),
        ]
    design = np.stack([np.stack(column, axis=-1) for column in columns], axis=-1)
    wanted = np.stack([u - x, v - y], axis=-1)
    found = _least_absolute(design, wanted, FINEST_PX / scale)
    return lambda at: _moved(at / scale, found) * scale


def _moved(at: FloatArray, found: FloatArray) -> FloatArray:
    """The displacements (n, 2) of places (n, 2) by a motion of 2, 4 or 8 numbers."""
    x, y = at.T
    if len(found) == 2:
        return np.broadcast_to(found, at.shape).copy()
    if len(found) == 4:
        right, down, grow, turn = found
        return np.stack([right + grow * x - turn * y, down + grow * y + turn * x], axis=-1)
    c, f, a, b, d, e, g, h = found
    wide = 1 + g * x + h * y
    return np.stack([(a * x + b * y + c + x) / wide - x, (d * x + e * y + f + y) / wide - y], axis=-1)


def _least_absolute(design: FloatArray, wanted: FloatArray, finest: float) -> FloatArray:
    """Coefficients (k,) of design (n, 2, k) to wanted (n, 2) with the minimum sum of distances."""
    weight, found = np.ones(len(wanted)), np.zeros(design.shape[2])
    for _ in range(ROUNDS):
        root = np.sqrt(weight)[:, None]
        weighted = (design * root[..., None]).reshape(-1, design.shape[2])
        found = np.asarray(np.linalg.lstsq(weighted, (wanted * root).ravel(), rcond=None)[0], dtype=np.float64)
        weight = 1 / np.maximum(np.hypot(*(wanted - design @ found).T), finest)
    return np.asarray(found)


def figures_of(motion: Motion, middle: FloatArray, limit_px: float) -> MotionFigures:
    """The figures of a motion of an image whose middle is at `middle` (2,), px; a star's limit is `limit_px`."""
    reach = float(np.hypot(*middle))
    step = 1.0
    here, right, down = motion(np.array([[0.0, 0.0], [step, 0.0], [0.0, step]]))
    (xx, yx), (xy, yy) = (right - here) / step, (down - here) / step
    turn, grow = math.atan2(yx - xy, 2 + xx + yy), math.sqrt((1 + xx) * (1 + yy) - xy * yx) - 1
    shift = float(here[0]), float(here[1])
    return MotionFigures(
        shift if math.hypot(*shift) > limit_px else (0.0, 0.0),
        math.degrees(turn) if abs(turn) * reach > limit_px else 0.0,
        grow if abs(grow) * reach > limit_px else 0.0,
    )
