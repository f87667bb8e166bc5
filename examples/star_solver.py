"""A small solver, lost in space: from an image alone to the attitude, by pairs of stars that other
stars confirm.

As a command: python star_solver.py IMAGE.fits FOCAL_LENGTH_PX prints w x y z of q_icrs_to_cam, or
nothing where it finds none. As a function: --solver python:star_solver:solve.
"""

from __future__ import annotations

import functools
import sys
from itertools import combinations
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import KDTree

from hilstar.rotation import from_matrix
from hilstar.sky.catalog import load_catalog
from hilstar.sky.stars import unit_vectors_icrs
from hilstar.tracker.centroids import find_stars

Array = npt.NDArray[np.float64]

FAINTEST_V_MAG = 7.5
PAIRED = 8  # stars of a field, about, that pairs are made of
BRIGHT = 6  # of the image's stars are tried in pairs
CHECKED = 16  # of them have to be where an attitude says
TOLERANCE_PX = 0.4
MIN_CONFIRMED, MIN_SHARE = 5, 0.6
EPOCH_JYEAR = 2026.0


@functools.lru_cache(maxsize=2)
def sky(field_rad: float, epoch_jyear: float) -> tuple[Array, KDTree, npt.NDArray[np.intp], Array]:
    """Directions (n, 3) of the stars, a tree of them, and pairs (m, 2) nearer than the field,
    sorted by chords (m,).

    Pairs are of the brightest stars, so many that PAIRED of them are in a field; a wide one would
    have millions otherwise.
    """
    catalog = load_catalog().brighter_than(FAINTEST_V_MAG)
    vectors = unit_vectors_icrs(catalog, epoch_jyear)[np.argsort(catalog.v_mag, kind="stable")]
    tree = KDTree(vectors)
    paired = int(PAIRED * 8 / (1 - np.cos(field_rad / 2)) / 2)
    pairs = KDTree(vectors[:paired]).query_pairs(2 * np.sin(field_rad / 2), output_type="ndarray")
    chords = np.linalg.norm(vectors[pairs[:, 0]] - vectors[pairs[:, 1]], axis=1)
    order = np.argsort(chords, kind="stable")
    return vectors, tree, pairs[order], chords[order]


def solve(image: npt.NDArray[Any], tracker: dict[str, Any]) -> list[float] | None:
    """q_icrs_to_cam of an image (height, width), or None. `tracker` has `focal_length_px`, and
    may have `epoch_jyear`.
    """
    focal_px = float(tracker["focal_length_px"])
    height, width = image.shape
    found = find_stars(image)
    centre = tracker.get("principal_point_px") or ((width - 1) / 2, (height - 1) / 2)
    seen = np.stack(
        [found.x_px - centre[0], found.y_px - centre[1], np.full(len(found), focal_px)], axis=1
    )[~found.at_edge]
    seen = (seen / np.linalg.norm(seen, axis=1, keepdims=True))[:CHECKED]
    field_rad = 2 * np.arctan(np.hypot(width, height) / 2 / focal_px)
    stars, tree, pairs, chords = sky(
        round(float(field_rad), 3), float(tracker.get("epoch_jyear", EPOCH_JYEAR))
    )
    tolerance = TOLERANCE_PX / focal_px
    for i, j in combinations(range(min(BRIGHT, len(seen))), 2):
        chord = np.linalg.norm(seen[i] - seen[j])
        first, last = np.searchsorted(chords, [chord - 2 * tolerance, chord + 2 * tolerance])
        both = np.concatenate([pairs[first:last], pairs[first:last, ::-1]])
        attitude = confirmed(seen, (i, j), stars[both], tree, tolerance)
        if attitude is not None:
            return [
                float(component)
                for component in from_matrix(refined(attitude, seen, stars, tree, tolerance))
            ]
    return None


def confirmed(
    seen: Array, pair: tuple[int, int], stars: Array, tree: KDTree, tolerance: float
) -> Array | None:
    """The rotation (3, 3) from ICRS to cam, of those that put two seen stars on pairs (m, 2, 3),
    that most stars confirm.
    """
    if not len(stars):
        return None
    cam, icrs = triad(seen[pair[0]][None], seen[pair[1]][None]), triad(stars[:, 0], stars[:, 1])
    icrs_from_cam = icrs @ cam.transpose(0, 2, 1)
    distance, _ = tree.query(
        np.einsum("mij,kj->mki", icrs_from_cam, seen), distance_upper_bound=4 * tolerance
    )
    count = np.isfinite(distance).sum(axis=1)
    best = int(np.argmax(count))
    if count[best] < max(MIN_CONFIRMED, MIN_SHARE * len(seen)):
        return None
    return np.asarray(icrs_from_cam[best].T)


def triad(a: Array, b: Array) -> Array:
    """Right-handed axes (m, 3, 3), as columns, of directions (m, 3) and (m, 3): the middle, the
    normal, and the third.
    """
    middle, normal = a + b, np.cross(a, b)
    middle, normal = (
        part / np.linalg.norm(part, axis=1, keepdims=True) for part in (middle, normal)
    )
    return np.stack([middle, normal, np.cross(middle, normal)], axis=2)


def refined(
    cam_from_icrs: Array, seen: Array, stars: Array, tree: KDTree, tolerance: float
) -> Array:
    """The rotation by all confirmed stars together: Wahba's problem by SVD."""
    for _ in range(3):
        distance, star = tree.query(seen @ cam_from_icrs, distance_upper_bound=4 * tolerance)
        good = np.isfinite(distance)
        u, _, vt = np.linalg.svd(seen[good].T @ stars[np.asarray(star)[good]])
        cam_from_icrs = u @ np.diag([1.0, 1.0, np.linalg.det(u) * np.linalg.det(vt)]) @ vt
    return cam_from_icrs


if __name__ == "__main__":
    from astropy.io import fits

    answer = solve(fits.getdata(sys.argv[1]), {"focal_length_px": float(sys.argv[2])})
    if answer is not None:
        print(*answer)
