"""The attitude of a photograph of which only the field of view is known, to 20 %.

Triangles of bright stars, told apart by the ratios of their sides: those of the brightest stars in
circles all over the sky against those of the brightest sources in circles all over the image. A
candidate counts where the other bright stars of the field lie on sources too, by more than chance
allows. The camera is a pinhole here; a lens of some per cent is within the tolerance.
"""

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import betainc

from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.rotation import from_matrix

# Half steps of 5 % about each hypothesis cover +-22 %.
HYPOTHESES = (1.0, 1.1, 0.91, 1.2, 0.83)
STEP = 0.055
# a triangle's sides relative to its longest: a distortion of 0.1 over 6 deg is 0.001
MAX_RATIO_OFF = 0.004
STARS_A_CIRCLE, SOURCES_A_CIRCLE = 9, 9  # whose triangles are compared
CIRCLE = 0.5  # radius, of the field's smaller side
MIN_SIDE = 0.15  # shortest side of a triangle, of the circle's diameter
MAX_SOURCES = 60  # brightest sources that may prove an attitude
NEAR = 0.006  # a share of the image's diagonal: within it a star and a source are one
# Chance is that of as many random places on the image; with 1e5 candidates at most, 1e-9 leaves
# 1e-4 for a false attitude.
MAX_CHANCE = 1e-9
MAX_CANDIDATES = 20_000  # for one hypothesis
MIN_MATCHED = 5
# The triangles of one sky serve others of about its date: an arcminute changes a ratio by less than
# a tenth of its tolerance.
KEPT_STARS, KEPT_RAD = 1000, 3e-4
# scales the triangles' keys, so that one distance is every tolerance
STRETCH = np.array([MAX_RATIO_OFF / STEP, 1.0, 1.0])
# triples (t, 3), which way round they go (t,), and their stretched keys
Triangles = tuple[IntArray, FloatArray, cKDTree]
_KEPT: dict[float, tuple[FloatArray, Triangles]] = {}


@dataclass(frozen=True, slots=True)
class SolvedField:
    """An attitude and a focal length, with the sources and stars (m,) that agree on it."""

    q_icrs_to_cam: FloatArray
    focal_length_px: float
    source: IntArray
    star: IntArray


@dataclass(frozen=True, slots=True)
class SourceField:
    """Sources (n, 2) of an image, px from its middle, brightest first, and the image's size, px."""

    places_px: FloatArray
    width_px: int
    height_px: int

    @property
    def diagonal_px(self) -> float:
        """The image's diagonal."""
        return math.hypot(self.width_px, self.height_px)

    def rays(self, focal_length_px: float) -> FloatArray:
        """Unit vectors (n, 3) in cam by a pinhole."""
        rays = np.column_stack([self.places_px / focal_length_px, np.ones(len(self.places_px))])
        return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def solve_lost(
    field: SourceField, focal_length_px: float, vectors: FloatArray, near: FloatArray | None = None
) -> SolvedField | None:
    """The attitude of a field whose focal length is known to 20 %; `vectors` (n, 3) are stars,
    ICRS, brightest first.

    With a direction `near` (3,) of the boresight, known to a field or so, only stars about it are
    looked at.
    """
    if len(field.places_px) < MIN_MATCHED:
        return None
    smaller_rad = 2 * math.atan(min(field.width_px, field.height_px) / 2 / focal_length_px)
    reach = math.pi
    if near is not None:
        reach = 2.5 * math.atan(field.diagonal_px / 2 / focal_length_px)
        rows = np.flatnonzero(vectors @ near > math.cos(min(reach, math.pi)))
        solution = _solved(
            field,
            focal_length_px,
            vectors[rows],
            _triangles_of_sky(vectors[rows], smaller_rad, near, reach),
        )
        if solution is None:
            return None
        return replace(solution, star=rows[solution.star])
    table = _KEPT.get(smaller_rad)
    if (
        table is None
        or table[0].shape != vectors.shape
        or np.abs(table[0][:KEPT_STARS] - vectors[:KEPT_STARS]).max() > KEPT_RAD
    ):
        table = vectors, _triangles_of_sky(vectors, smaller_rad)
        _KEPT.clear()
        _KEPT[smaller_rad] = table
    return _solved(field, focal_length_px, vectors, table[1])


def _solved(
    field: SourceField, focal_length_px: float, vectors: FloatArray, sky: Triangles
) -> SolvedField | None:
    tries = (_by_hypothesis(field, focal_length_px * times, vectors, sky) for times in HYPOTHESES)
    return next((solution for solution in tries if solution is not None), None)


def _triangles_of_sky(
    vectors: FloatArray, smaller_rad: float, near: FloatArray | None = None, reach: float = math.pi
) -> Triangles:
    """Triangles of stars."""
    radius_rad = smaller_rad * CIRCLE
    spacing_rad = radius_rad * 0.8
    circles = math.ceil(4 * math.pi / spacing_rad**2)
    # enough stars for the circles, and for the proof
    area_sr = 2 * math.pi * (1 - math.cos(radius_rad))
    bright = vectors[: min(len(vectors), math.ceil(2.5 * STARS_A_CIRCLE * 4 * math.pi / area_sr))]
    number = np.arange(circles) + 0.5
    z = 1 - 2 * number / circles
    azimuth = number * math.pi * (3 - math.sqrt(5))
    level = np.sqrt(1 - z * z)
    centres = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), z], axis=1)
    if near is not None:
        centres = centres[centres @ near > math.cos(min(reach, math.pi))]
    within = cKDTree(bright).query_ball_point(
        centres, 2 * math.sin(radius_rad / 2), return_sorted=True
    )
    sets = [row[:STARS_A_CIRCLE] for row in within if len(row) >= 3]
    every = []
    for size in range(3, STARS_A_CIRCLE + 1):
        rows = np.array([row for row in sets if len(row) == size], dtype=np.intp)
        if len(rows):
            every.append(rows[:, list(itertools.combinations(range(size), 3))].reshape(-1, 3))
    if not every:
        return np.empty((0, 3), dtype=np.intp), np.empty(0), cKDTree(np.empty((0, 3)))
    count = len(vectors)  # one number a triple, in order: three times as quick to sort as rows
    code = np.unique(np.concatenate(every) @ np.array([count**2, count, 1]))
    triples = np.column_stack([code // count**2, code // count % count, code % count])
    ordered, keys, turns = _keys(triples, vectors)
    wide = keys[:, 0] > math.log(MIN_SIDE * 2 * radius_rad * 0.8)
    return ordered[wide], turns[wide], cKDTree(keys[wide] * STRETCH)


def _keys(triples: IntArray, vectors: FloatArray) -> tuple[IntArray, FloatArray, FloatArray]:
    """Triples ordered by the side opposite each corner, longest first; log of the longest side
    and two ratios; handedness.
    """
    corners = vectors[triples]
    sides = 2 * np.arcsin(np.linalg.norm(corners[:, [1, 2, 0]] - corners[:, [2, 0, 1]], axis=2) / 2)
    order = np.argsort(-sides, axis=1)
    sides = np.take_along_axis(sides, order, axis=1)
    triples = np.take_along_axis(triples, order, axis=1)
    corners = vectors[triples]
    turn = np.sign(np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])))
    # a ratio's tolerance is the tree's unit; the scale's is STEP
    keys = np.column_stack([np.log(sides[:, 0]), sides[:, 1:] / sides[:, :1]])
    return triples, keys, turn


def _image_triples(field: SourceField) -> Iterator[tuple[int, int, int]]:
    """Triples of the brightest sources in circles over the image, those of the brightest ones
    first.
    """
    radius = CIRCLE * min(field.width_px, field.height_px)
    ways = []
    for size in (field.width_px, field.height_px):
        ways.append(np.arange(-(size / 2 - radius), size / 2 - radius + 1, max(radius / 2, 1.0)))
    known_triples: set[tuple[int, int, int]] = set()
    triples: list[tuple[int, int, int]] = []
    for x, y in itertools.product(*ways):
        near = np.flatnonzero(
            np.hypot(field.places_px[:, 0] - x, field.places_px[:, 1] - y) < radius
        )[:SOURCES_A_CIRCLE]
        for triple in itertools.combinations(near.tolist(), 3):
            if triple not in known_triples:
                known_triples.add(triple)
                triples.append(triple)
    yield from sorted(triples, key=sum)


def _by_hypothesis(
    field: SourceField, focal_px: float, vectors: FloatArray, sky: Triangles
) -> SolvedField | None:
    triples, turns, tree = sky
    rays = field.rays(focal_px)
    mine = np.array(list(_image_triples(field)), dtype=np.intp).reshape(-1, 3)
    if not len(mine) or not len(triples):
        return None
    mine, keys, turn = _keys(mine, rays)
    proof = _Proof(field, vectors)
    tried = 0
    near = tree.query_ball_point(keys * STRETCH, MAX_RATIO_OFF * 1.2)
    for row, candidates in enumerate(near):
        for candidate in candidates:
            if turns[candidate] != turn[row]:
                continue
            tried += 1
            if tried > MAX_CANDIDATES:
                return None
            scale = math.exp(keys[row, 0] - tree.data[candidate, 0] / STRETCH[0])
            solution = proof.of(mine[row], triples[candidate], focal_px * scale)
            if solution is not None:
                return solution
    return None


class _Proof:
    """Whether the other bright stars of a field lie on sources too."""

    def __init__(self, field: SourceField, vectors: FloatArray) -> None:
        self.field = field
        self.vectors = vectors
        self.places = field.places_px[:MAX_SOURCES]
        self.tree = cKDTree(self.places)
        self.radius_px = NEAR * field.diagonal_px
        self.chance = min(
            0.5, len(self.places) * math.pi * self.radius_px**2 / (field.width_px * field.height_px)
        )
        self.sky = cKDTree(vectors)

    def of(self, sources: IntArray, stars: IntArray, focal_px: float) -> SolvedField | None:
        """The attitude by three pairs, where it holds."""
        matrix = turned(self.field.rays(focal_px)[sources], self.vectors[stars])
        in_image = self._seen(matrix, focal_px)
        if len(in_image) < MIN_MATCHED:
            return None
        star, source = self._pairs(in_image, matrix, focal_px)
        more = len(star) - 3
        of = len(in_image) - 3
        if len(star) < MIN_MATCHED or betainc(more, of - more + 1, self.chance) > MAX_CHANCE:
            return None
        for _ in range(3):
            matrix, focal_px = _refined(self.places[source], self.vectors[star], matrix, focal_px)
            star, source = self._pairs(self._seen(matrix, focal_px), matrix, focal_px)
            if len(star) < MIN_MATCHED:
                return None
        return SolvedField(from_matrix(matrix), focal_px, source, star)

    def _seen(self, matrix: FloatArray, focal_px: float) -> IntArray:
        """The brightest stars on the image, as many as there are sources."""
        radius = math.atan(self.field.diagonal_px / 2 / focal_px)
        near = np.sort(self.sky.query_ball_point(matrix[2], 2 * math.sin(radius / 2)))
        at = self._places(self.vectors[near], matrix, focal_px)
        inside = (np.abs(at[:, 0]) < self.field.width_px / 2) & (
            np.abs(at[:, 1]) < self.field.height_px / 2
        )
        return np.asarray(near[inside][: len(self.places)], dtype=np.intp)

    def _places(self, vectors: FloatArray, matrix: FloatArray, focal_px: float) -> FloatArray:
        cam = vectors @ matrix.T
        return np.asarray(focal_px * cam[:, :2] / cam[:, 2:])

    def _pairs(
        self, seen: IntArray, matrix: FloatArray, focal_px: float
    ) -> tuple[IntArray, IntArray]:
        """Stars and the sources on which they lie, each once."""
        places = self._places(self.vectors[seen], matrix, focal_px)
        star_index, source = nearest_once(self.tree, places, self.radius_px)
        return seen[star_index], source


def nearest_once(
    tree: cKDTree, places_px: FloatArray, radius_px: float
) -> tuple[IntArray, IntArray]:
    """Which places (n, 2), brightest first, have a source of a tree within a radius, each source
    once, and that source.
    """
    off, source = map(np.asarray, tree.query(places_px, distance_upper_bound=radius_px))
    here = np.flatnonzero(np.isfinite(off))
    here = here[np.sort(np.unique(source[here], return_index=True)[1])]
    return here, source[here]


def turned(cam: FloatArray, icrs: FloatArray) -> FloatArray:
    """The rotation (3, 3) from ICRS to cam that fits pairs of unit vectors (n, 3) best (Markley
    1988).
    """
    u, _, vt = np.linalg.svd(cam.T @ icrs)
    return np.asarray(u @ np.diag([1.0, 1.0, np.linalg.det(u) * np.linalg.det(vt)]) @ vt)


def _refined(
    places: FloatArray, vectors: FloatArray, matrix: FloatArray, focal_px: float
) -> tuple[FloatArray, float]:
    """Attitude and focal length by all pairs."""
    cam = vectors @ matrix.T
    plane = cam[:, :2] / cam[:, 2:]
    plane -= plane.mean(axis=0)
    centred_px = places - places.mean(axis=0)
    focal_px = float(np.sqrt((centred_px**2).sum() / (plane**2).sum()))
    rays = np.column_stack([places / focal_px, np.ones(len(places))])
    return turned(rays / np.linalg.norm(rays, axis=1, keepdims=True), vectors), focal_px
