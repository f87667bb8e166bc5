"""The attitude of a photograph of which only the field of view is known, to 20 %.

Triangles of bright stars, told apart by the ratios of their sides: those of the brightest stars in
circles all over the sky against those of the brightest sources in circles all over the image. A
candidate counts where the other bright stars of the field lie on sources too, by more than chance
allows. The camera is a pinhole here; a lens of some per cent is within the tolerance.
"""

import itertools
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

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


@dataclass(frozen=True, slots=True)
class Triangles:
    """Triangles of stars: triples (t, 3), corners by the side opposite, longest first; which way
    round they go (t,); and a tree of their stretched keys.
    """

    triples: IntArray
    turns: FloatArray
    tree: cKDTree


# the triangles of the sky last solved, by the field's size, with its stars' directions
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
        in_focal_lengths = self.places_px / focal_length_px
        rays = np.column_stack([in_focal_lengths, np.ones(len(self.places_px))])
        return _unit(rays)


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
    smaller_px = min(field.width_px, field.height_px)
    smaller_rad = 2 * math.atan(smaller_px / 2 / focal_length_px)
    if near is None:
        return _solved(field, focal_length_px, vectors, _triangles_kept(vectors, smaller_rad))
    reach = 2.5 * math.atan(field.diagonal_px / 2 / focal_length_px)
    rows = np.flatnonzero(vectors @ near > math.cos(min(reach, math.pi)))
    sky = _triangles_of_sky(vectors[rows], smaller_rad, near, reach)
    solution = _solved(field, focal_length_px, vectors[rows], sky)
    if solution is None:
        return None
    return replace(solution, star=rows[solution.star])


def _triangles_kept(vectors: FloatArray, smaller_rad: float) -> Triangles:
    """The triangles of the whole sky: those of the last one, where that is the same but for its
    date.
    """
    cached = _KEPT.get(smaller_rad)
    if cached is not None and cached[0].shape == vectors.shape:
        moved = np.abs(cached[0][:KEPT_STARS] - vectors[:KEPT_STARS])
        if moved.max() <= KEPT_RAD:
            return cached[1]
    sky = _triangles_of_sky(vectors, smaller_rad)
    _KEPT.clear()
    _KEPT[smaller_rad] = vectors, sky
    return sky


def _solved(
    field: SourceField, focal_length_px: float, vectors: FloatArray, sky: Triangles
) -> SolvedField | None:
    """The attitude by the first hypothesis of the focal length that is proved."""
    for factor in HYPOTHESES:
        solution = _by_hypothesis(field, focal_length_px * factor, vectors, sky)
        if solution is not None:
            return solution
    return None


def _triangles_of_sky(
    vectors: FloatArray, smaller_rad: float, near: FloatArray | None = None, reach: float = math.pi
) -> Triangles:
    """Triangles of the brightest stars in circles all over the sky, or within a reach of a
    direction.
    """
    radius_rad = smaller_rad * CIRCLE
    # enough stars for the circles, and for the proof
    area_sr = 2 * math.pi * (1 - math.cos(radius_rad))
    count = math.ceil(2.5 * STARS_A_CIRCLE * 4 * math.pi / area_sr)
    bright = vectors[: min(len(vectors), count)]
    centres = _spread(radius_rad * 0.8)
    if near is not None:
        centres = centres[centres @ near > math.cos(min(reach, math.pi))]
    chord = 2 * math.sin(radius_rad / 2)
    circles = cKDTree(bright).query_ball_point(centres, chord, return_sorted=True)
    triples = _triples(circles, len(vectors))
    if not len(triples):
        return Triangles(triples, np.empty(0), cKDTree(np.empty((0, 3))))
    ordered, keys, turns = _keys(triples, vectors)
    shortest_rad = MIN_SIDE * 2 * radius_rad * 0.8
    is_wide = keys[:, 0] > math.log(shortest_rad)
    tree = cKDTree(keys[is_wide] * STRETCH)
    return Triangles(ordered[is_wide], turns[is_wide], tree)


def _spread(spacing_rad: float) -> FloatArray:
    """Directions (n, 3) spread evenly over the sky, on a spiral of golden angles."""
    count = math.ceil(4 * math.pi / spacing_rad**2)
    number = np.arange(count) + 0.5
    z = 1 - 2 * number / count
    azimuth = number * math.pi * (3 - math.sqrt(5))
    level = np.sqrt(1 - z * z)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), z], axis=1)


def _triples(circles: Iterable[Any], stars: int) -> IntArray:
    """All triples (t, 3), each once, of the brightest of `stars` stars in each circle."""
    by_size: dict[int, list[list[int]]] = {}
    for rows in circles:
        brightest = rows[:STARS_A_CIRCLE]
        by_size.setdefault(len(brightest), []).append(brightest)
    parts = []
    for size in range(3, STARS_A_CIRCLE + 1):
        if size in by_size:
            rows_of_size = np.array(by_size[size], dtype=np.intp)
            corners = list(itertools.combinations(range(size), 3))
            parts.append(rows_of_size[:, corners].reshape(-1, 3))
    if not parts:
        return np.empty((0, 3), dtype=np.intp)
    # one number a triple, in order: three times as quick to sort as rows
    code = np.unique(np.concatenate(parts) @ np.array([stars**2, stars, 1]))
    return np.column_stack([code // stars**2, code // stars % stars, code % stars])


def _keys(triples: IntArray, vectors: FloatArray) -> tuple[IntArray, FloatArray, FloatArray]:
    """Triples ordered by the side opposite each corner, longest first; log of the longest side
    and two ratios; handedness.
    """
    corners = vectors[triples]
    opposite = corners[:, [1, 2, 0]] - corners[:, [2, 0, 1]]
    sides = 2 * np.arcsin(np.linalg.norm(opposite, axis=2) / 2)
    order = np.argsort(-sides, axis=1)
    sides = np.take_along_axis(sides, order, axis=1)
    triples = np.take_along_axis(triples, order, axis=1)
    first, second, third = np.moveaxis(vectors[triples], 1, 0)
    turn = np.sign(np.einsum("ij,ij->i", first, np.cross(second, third)))
    # a ratio's tolerance is the tree's unit; the scale's is STEP
    ratios = sides[:, 1:] / sides[:, :1]
    keys = np.column_stack([np.log(sides[:, 0]), ratios])
    return triples, keys, turn


def _image_triples(field: SourceField) -> Iterator[tuple[int, int, int]]:
    """Triples of the brightest sources in circles over the image, those of the brightest ones
    first.
    """
    radius = CIRCLE * min(field.width_px, field.height_px)
    step = max(radius / 2, 1.0)
    x_reach = field.width_px / 2 - radius
    y_reach = field.height_px / 2 - radius
    columns = np.arange(-x_reach, x_reach + 1, step)
    rows = np.arange(-y_reach, y_reach + 1, step)
    source_x, source_y = field.places_px.T
    # an order that does not change, without repeats
    triples: dict[tuple[int, int, int], None] = {}
    for x, y in itertools.product(columns, rows):
        distance = np.hypot(source_x - x, source_y - y)
        near = np.flatnonzero(distance < radius)[:SOURCES_A_CIRCLE]
        for triple in itertools.combinations(near.tolist(), 3):
            triples[triple] = None
    yield from sorted(triples, key=sum)


def _by_hypothesis(
    field: SourceField, focal_px: float, vectors: FloatArray, sky: Triangles
) -> SolvedField | None:
    """The attitude by triangles of sources that are alike to those of stars, at about a focal
    length.
    """
    rays = field.rays(focal_px)
    image_triples = np.array(list(_image_triples(field)), dtype=np.intp).reshape(-1, 3)
    if not len(image_triples) or not len(sky.triples):
        return None
    image_triples, keys, turn = _keys(image_triples, rays)
    proof = _Proof(field, vectors)
    tried = 0
    near = sky.tree.query_ball_point(keys * STRETCH, MAX_RATIO_OFF * 1.2)
    for row, candidates in enumerate(near):
        for candidate in candidates:
            if sky.turns[candidate] != turn[row]:
                continue
            tried += 1
            if tried > MAX_CANDIDATES:
                return None
            log_side = sky.tree.data[candidate, 0] / STRETCH[0]
            scale = math.exp(keys[row, 0] - log_side)
            stars = sky.triples[candidate]
            solution = proof.of(image_triples[row], stars, focal_px * scale)
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
        # that a random place is within the radius of some source
        area_px = field.width_px * field.height_px
        circles_px = len(self.places) * math.pi * self.radius_px**2
        self.chance = min(0.5, circles_px / area_px)
        self.sky = cKDTree(vectors)

    def of(self, sources: IntArray, stars: IntArray, focal_px: float) -> SolvedField | None:
        """The attitude by three pairs, where it holds."""
        matrix = turned(self.field.rays(focal_px)[sources], self.vectors[stars])
        in_image = self._seen(matrix, focal_px)
        if len(in_image) < MIN_MATCHED:
            return None
        star, source = self._pairs(in_image, matrix, focal_px)
        if len(star) < MIN_MATCHED:
            return None
        # the three pairs match by themselves
        more = len(star) - 3
        others = len(in_image) - 3
        if betainc(more, others - more + 1, self.chance) > MAX_CHANCE:
            return None
        for _ in range(3):
            matrix, focal_px = _refined(self.places[source], self.vectors[star], matrix, focal_px)
            in_image = self._seen(matrix, focal_px)
            star, source = self._pairs(in_image, matrix, focal_px)
            if len(star) < MIN_MATCHED:
                return None
        return SolvedField(from_matrix(matrix), focal_px, source, star)

    def _seen(self, matrix: FloatArray, focal_px: float) -> IntArray:
        """The brightest stars on the image, as many as there are sources."""
        radius_rad = math.atan(self.field.diagonal_px / 2 / focal_px)
        boresight = matrix[2]
        near = np.sort(self.sky.query_ball_point(boresight, 2 * math.sin(radius_rad / 2)))
        x, y = self._places(self.vectors[near], matrix, focal_px).T
        across = np.abs(x) < self.field.width_px / 2
        down = np.abs(y) < self.field.height_px / 2
        return np.asarray(near[across & down][: len(self.places)], dtype=np.intp)

    def _places(self, vectors: FloatArray, matrix: FloatArray, focal_px: float) -> FloatArray:
        """Places (n, 2) of stars from the image's middle, px."""
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
    distances, sources = tree.query(places_px, distance_upper_bound=radius_px)
    near = np.flatnonzero(np.isfinite(np.asarray(distances)))
    source = np.asarray(sources)
    # the first, which is the brightest, of the places at a source
    _, first = np.unique(source[near], return_index=True)
    near = near[np.sort(first)]
    return near, source[near]


def turned(cam: FloatArray, icrs: FloatArray) -> FloatArray:
    """The rotation (3, 3) from ICRS to cam that fits pairs of unit vectors (n, 3) best (Markley
    1988).
    """
    u, _, vt = np.linalg.svd(cam.T @ icrs)
    handedness = np.linalg.det(u) * np.linalg.det(vt)
    return np.asarray(u @ np.diag([1.0, 1.0, handedness]) @ vt)


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
    return turned(_unit(rays), vectors), focal_px


def _unit(rays: FloatArray) -> FloatArray:
    """Directions (n, 3) of norm 1."""
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))
