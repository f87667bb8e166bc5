"""Which dot each centroid is: by the code that it blinks, with no guess of where it should be.

A dot stands still, so centroids of different frames at one place are one dot; the frames that it was seen in are its code. The
codes that match one dot's and no other's give a first map; by that map every centroid is then asked which lit dot it lies on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from hilstar.arrays import FloatArray, IntArray
from hilstar.calibrate.geometric.dots import DotPlan
from hilstar.calibrate.geometric.observed import Observed

MAX_LINK_PX = 3.0  # a dot's centroids lie closer together than this in the tracker's image
LINK_SHARE = 0.2  # of the distance between dots, if that is less
CODE_LEAD = 2  # by how many frames the next code must be farther than the best
MAX_CODE_ERRORS = 3
TRIALS = 600  # of four dots each
INLIER_SHARE = 0.03  # of the screen's width: what a lens may bend a homography by
MIN_DECODED = 6


@dataclass(frozen=True, slots=True)
class Decoded:
    """Dots of one pose that their codes name: the dot, and where the tracker saw it (mean of its centroids), (n,) each."""

    dot: IntArray
    x_px: FloatArray
    y_px: FloatArray


def decode(plan: DotPlan, seen: Observed) -> Decoded:
    """The dots of one pose whose code is nearest one dot's and clearly farther from every other's; each dot once."""
    group = _groups(seen, plan)
    pattern = np.zeros((int(group.max()) + 1 if len(group) else 0, plan.frames), dtype=bool)
    inside = seen.frame < plan.frames
    pattern[group[inside], seen.frame[inside]] = True
    far = pattern.astype(np.int32) @ (~plan.lit).T.astype(np.int32) + (~pattern).astype(np.int32) @ plan.lit.T.astype(np.int32)
    if far.shape[1] < 2 or not len(far):
        return Decoded(*(np.zeros(0, dtype=kind) for kind in (np.intp, float, float)))
    order = np.argsort(far, axis=1, kind="stable")
    rows = np.arange(len(far))
    best, next_best = far[rows, order[:, 0]], far[rows, order[:, 1]]
    sure = np.flatnonzero((best <= MAX_CODE_ERRORS) & (next_best >= best + CODE_LEAD) | (best == 0))
    # Of several places that blink one dot's code the one with the fewest errors is it, if there is one such.
    by_dot: dict[int, list[int]] = {}
    for k in sure:
        by_dot.setdefault(int(order[k, 0]), []).append(int(k))
    chosen = {dot: min(places, key=lambda k: far[k, dot]) for dot, places in by_dot.items()}
    kept = sorted(chosen.items())
    means = [(seen.x_px[group == k].mean(), seen.y_px[group == k].mean()) for _, k in kept]
    x_px, y_px = np.array(means).reshape(-1, 2).T
    return Decoded(np.array([dot for dot, _ in kept], dtype=np.intp), x_px, y_px)


def _groups(seen: Observed, plan: DotPlan) -> IntArray:
    """A number for each centroid: those close to each other share one."""
    places = np.column_stack([seen.x_px, seen.y_px])
    area = float(np.prod(np.ptp(places, axis=0))) if len(places) else 0.0
    link_px = min(MAX_LINK_PX, LINK_SHARE * np.sqrt(area / max(len(plan), 1)))
    pairs = cKDTree(places).query_pairs(link_px, output_type="ndarray")
    linked = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(places), len(places)))
    return np.asarray(connected_components(linked, directed=False)[1], dtype=np.intp)


def homography(u: FloatArray, v: FloatArray, x: FloatArray, y: FloatArray) -> FloatArray:
    """The projective map (3, 3) from (u, v) to (x, y) by least squares (Hartley and Zisserman 2004, 4.1, normalised)."""
    into, out = _normal(u, v), _normal(x, y)
    a, b, _ = into @ np.stack([u, v, np.ones_like(u)])
    c, d, _ = out @ np.stack([x, y, np.ones_like(x)])
    zero, one = np.zeros_like(a), np.ones_like(a)
    rows = np.concatenate(
        [
            np.stack([a, b, one, zero, zero, zero, -c * a, -c * b, -c], axis=1),
            np.stack([zero, zero, zero, a, b, one, -d * a, -d * b, -d], axis=1),
        ]
    )
    solution = np.linalg.svd(rows)[2][-1].reshape(3, 3)
    found = np.linalg.inv(out) @ solution @ into
    return np.asarray(found / found[2, 2])


def _normal(x: FloatArray, y: FloatArray) -> FloatArray:
    """A similarity (3, 3) that brings points to the origin, at a mean square distance of 2."""
    scale = np.sqrt(2.0) / max(float(np.sqrt(np.var(x) + np.var(y))), 1e-300)
    return np.array([[scale, 0.0, -scale * x.mean()], [0.0, scale, -scale * y.mean()], [0.0, 0.0, 1.0]])


def mapped(matrix: FloatArray, u: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(u, v) through a projective map (3, 3)."""
    x, y, w = matrix @ np.stack([u, v, np.ones_like(u)])
    with np.errstate(divide="ignore", invalid="ignore"):
        return x / w, y / w


@dataclass(frozen=True, slots=True)
class FirstMap:
    """A projective map (3, 3) from tangents of tracker directions to monitor px, and which of the decoded dots it fits."""

    matrix: FloatArray
    inlier: npt.NDArray[np.bool_]


def first_map(
    tangents: tuple[FloatArray, FloatArray], dots_px: tuple[FloatArray, FloatArray], width_px: float, rng: np.random.Generator
) -> FirstMap | None:
    """The map that most decoded dots agree with (random samples of four, Fischler and Bolles 1981); None where few do."""
    (u, v), (x, y) = tangents, dots_px
    if len(u) < MIN_DECODED:
        return None
    best = np.zeros(len(u), dtype=bool)
    for _ in range(TRIALS):
        four = rng.choice(len(u), 4, replace=False)
        try:
            inlier = _inliers(homography(u[four], v[four], x[four], y[four]), tangents, dots_px, width_px)
        except np.linalg.LinAlgError:
            continue
        if inlier.sum() > best.sum():
            best = inlier
    if best.sum() < max(MIN_DECODED, len(u) / 3):
        return None
    matrix = homography(u[best], v[best], x[best], y[best])
    return FirstMap(matrix, _inliers(matrix, tangents, dots_px, width_px))


def _inliers(
    matrix: FloatArray, tangents: tuple[FloatArray, FloatArray], dots_px: tuple[FloatArray, FloatArray], width_px: float
) -> npt.NDArray[np.bool_]:
    x, y = mapped(matrix, *tangents)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.hypot(x - dots_px[0], y - dots_px[1]) < INLIER_SHARE * width_px)
