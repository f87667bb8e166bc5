"""A star's path across the image as sprites: the part on the image, and the number of its
Gauss-Legendre nodes.

Paths of stars over a short turn as polynomials in time, through a few places that are exact.

A place on such a path costs two short sums, where an exact one costs a rotation and, behind a real
lens, a hundred operations.
"""

from bisect import bisect_left
from copy import copy
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.optics.camera import Camera, Lens

# on one path: leggauss is an eigenvalue problem, 1 ms for 64 nodes and minutes for 10 000
MAX_NODES = 64
# A place may be off by the larger of these: px, and of the path's length within the turn. Either
# changes a pixel of a star of sigma 0.5 px by 5e-4 of its flux, half of what the nodes may: the
# longer a path, the fainter it is.
LIMIT_PX = 1e-3
LIMIT_SHARE = 5e-4
POINTS = (2, 3)
# Through a lens one place, with slopes and curvature of the lens there, costs less than two exact
# ones and reaches farther.
LENS_POINTS = (1, 3)
# across the wider side of a lens's table, which reaches BESIDE_TABLE of a side beyond the lens's
# box
TABLE_STEPS = 240
BESIDE_TABLE = 0.05
TABLE_PX = LIMIT_PX / 2  # what a table may be off on the image
WIDEST_TABLE = 2.5  # largest tangent: beyond it a path may begin behind the camera
# Half a turn that 3 points draw through 350 mm and a strong lens with a field of degree 6: 0.29
# deg, 28 deg/s at 60 Hz.
MAX_HALF_TURN_RAD = 0.04
# from one half turn that is tried to the next; the error falls with its power of the number of
# points
NARROWER = 2**-0.25
TRIES = 40
TRIED_PLACES, TRIED_MOMENTS = 13, 9  # along each side of the image, and within a turn
TRIED_AXES = [
    (x, y, z)
    for x in (-1.0, 0.0, 1.0)
    for y in (-1.0, 0.0, 1.0)
    for z in (0.0, 1.0)
    if (x, y, z) != (0.0, 0.0, 0.0)
]
# A path may begin or end beyond what its lens is known for. Straight lines from there would put a
# kink into it.
BEYOND_LENS = 1.05


class NodeTable(NamedTuple):
    """Gauss-Legendre nodes and weights over -1 to 1 for all counts to MAX_NODES, end to end;
    each count's begin at `first`.
    """

    first: IntArray
    places: FloatArray
    weights: FloatArray


@lru_cache(maxsize=1)
def _node_table() -> NodeTable:
    """The table of all rules, made once."""
    places = []
    weights = []
    for count in range(1, MAX_NODES + 1):
        count_places, count_weights = np.polynomial.legendre.leggauss(count)
        places.append(count_places)
        weights.append(count_weights)
    first = np.cumsum([0, 0, *range(1, MAX_NODES)])
    return NodeTable(first, np.concatenate(places), np.concatenate(weights))


@dataclass(frozen=True, slots=True)
class Nodes:
    """Nodes of several paths, end to end: the path of each, its place from -1 to 1 on it, and
    its share of the path's light.
    """

    path: IntArray
    place: FloatArray
    share: FloatArray


def nodes_of(counts: IntArray) -> Nodes:
    """The Gauss-Legendre nodes of paths that have `counts` (n,) of them, each 0 to MAX_NODES."""
    table = _node_table()
    path = np.repeat(np.arange(len(counts)), counts)
    begin = np.cumsum(counts) - counts
    to_entry = np.repeat(table.first[counts] - begin, counts)
    entry = np.arange(len(path)) + to_entry
    return Nodes(path, table.places[entry], table.weights[entry] / 2)


def within_budget(wanted: IntArray, extra: int) -> IntArray:
    """The nodes (n,) that paths get of those they want: at most MAX_NODES each, and at most `extra`
    beyond one each.

    What exceeds `extra` is reduced in proportion; a path that wants any keeps one.
    """
    counts = np.minimum(wanted, MAX_NODES)
    beyond = np.maximum(counts - 1, 0)
    total = int(beyond.sum())
    if total <= extra:
        return np.asarray(counts)
    reduced = (beyond * (extra / total)).astype(np.intp)
    return np.asarray(np.minimum(counts, 1) + reduced)


class Paths:
    """Directions (n, 3) in image axes, seen by a camera that turns with a constant rate (3,) in the
    same axes, rad/s.

    By Rodrigues' formula; seconds count from the moment when the directions are those given.
    """

    def __init__(self, seen: FloatArray, rate_image_rad_s: FloatArray, camera: Camera) -> None:
        self.camera = camera
        self.speed_rad_s = float(np.linalg.norm(rate_image_rad_s))
        x, y, z = rate_image_rad_s / (self.speed_rad_s or 1.0)
        axis = np.array([x, y, z])
        # Component by component (3, n): several times faster than direction by direction.
        self._seen = np.ascontiguousarray(seen.T)
        cross_with_axis = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        self._cross = cross_with_axis @ self._seen
        self._along = axis[:, None] * (axis @ self._seen)

    def __len__(self) -> int:
        return int(self._seen.shape[1])

    def through(self, camera: Camera) -> "Paths":
        """The same paths seen by another camera that turns with this one."""
        paths = copy(self)
        paths.camera = camera
        return paths

    def places_px(
        self, star: IntArray | slice, seconds: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Pixel x and y of the stars at places `star` (k,), each at its own of `seconds` (k,);
        NaN behind the camera.
        """
        seen = self._seen[:, star]
        cross = self._cross[:, star]
        along = self._along[:, star]
        return self._places_px(seen, cross, along, seconds)

    def all_places_px(self, seconds: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Pixel x and y (m, n) of all stars at `seconds` (m, 1), or (m, n) of their own; NaN
        behind the camera.
        """
        shape = (len(seconds), len(self))
        seen = self._seen[:, None]
        cross = self._cross[:, None]
        along = self._along[:, None]
        x_px, y_px = self._places_px(seen, cross, along, seconds)
        return x_px.reshape(shape), y_px.reshape(shape)

    def tangents_at(
        self, seconds: FloatArray, unit_s: float
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Tangents (2, n) of all stars at `seconds` (n,), their change in `unit_s` and half of
        the change of that.
        """
        angle = self.speed_rad_s * seconds
        turn = self.speed_rad_s * unit_s
        cosine = np.cos(angle)
        sine = np.sin(angle)
        across = self._seen - self._along
        faster = self._cross * cosine
        turned = across * cosine
        turned -= self._cross * sine
        faster += across * sine  # the axis times what is seen
        bend = turned * (-turn * turn / 2)
        turned += self._along
        faster *= -turn
        near = 1 / turned[2]
        at = turned[:2] * near
        first = (faster[:2] - at * faster[2]) * near
        second = (bend[:2] - at * bend[2] - first * faster[2]) * near
        return at, first, second

    def _places_px(
        self, seen: FloatArray, cross: FloatArray, along: FloatArray, seconds: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Pixel x and y of directions, by their parts across and along the axis (see
        `__init__`).
        """
        angle = self.speed_rad_s * seconds
        cosine = np.cos(angle)
        turned = seen * cosine
        turned -= cross * np.sin(angle)
        turned += along * (1 - cosine)
        return self.camera.project_outward(turned.reshape(3, -1).T)


@dataclass(frozen=True, slots=True)
class Chords:
    """Straight ways between the ends of n paths, px: x and y (2, n), begin and end; NaN behind the
    camera.
    """

    x_px: FloatArray
    y_px: FloatArray

    def to(self, longer: FloatArray) -> "Chords":
        """The chords with the same begins, each so many times (n,) as long."""
        x_begin, x_end = self.x_px
        y_begin, y_end = self.y_px
        x_px = np.stack([x_begin, x_begin + (x_end - x_begin) * longer])
        y_px = np.stack([y_begin, y_begin + (y_end - y_begin) * longer])
        return Chords(x_px, y_px)

    def length_sigma(self, width_px: tuple[float, float]) -> FloatArray:
        """How long each is in widths of a PSF (see `Psf.width_px`); NaN where an end is behind
        the camera.
        """
        across = (self.x_px[1] - self.x_px[0]) / width_px[0]
        down = (self.y_px[1] - self.y_px[0]) / width_px[1]
        return np.asarray(np.hypot(across, down))

    def on_image(
        self, resolution_px: tuple[int, int], margin_px: npt.ArrayLike
    ) -> tuple[FloatArray, FloatArray]:
        """Begin and end (n,) of the part of each, 0 to 1, that is within `margin_px` of the image;
        1 and 0 for none.

        (Liang and Barsky 1984.) A chord with one end behind the camera counts whole where the other
        end is on the image.
        """
        begin = np.zeros(self.x_px.shape[1])
        end = np.ones(self.x_px.shape[1])
        margin = np.asarray(margin_px)
        width, height = resolution_px
        for (first, last), size in ((self.x_px, width), (self.y_px, height)):
            low = -0.5 - margin
            high = size - 0.5 + margin
            step = last - first
            still = np.abs(step) < 1e-9
            step = np.where(still, 1.0, step)
            at_low = (low - first) / step
            at_high = (high - first) / step
            # a chord that stands still along an axis is within these limits or it is not
            outside = still & ((first < low) | (first > high))
            enters = np.where(still, np.where(outside, 1.0, 0.0), np.minimum(at_low, at_high))
            leaves = np.where(still, np.where(outside, 0.0, 1.0), np.maximum(at_low, at_high))
            begin = np.maximum(begin, enters)
            end = np.minimum(end, leaves)
        is_crossed = end > begin
        is_near = np.abs(self.x_px - width / 2) <= width
        is_near &= np.abs(self.y_px - height / 2) <= height
        ends_in_front = np.isfinite(self.x_px).sum(axis=0)
        half_seen = (ends_in_front == 1) & is_near.any(axis=0)
        begin = np.where(is_crossed, begin, 1.0)
        end = np.where(is_crossed, end, 0.0)
        begin[half_seen] = 0.0
        end[half_seen] = 1.0
        return begin, end


def node_counts(
    length_sigma: FloatArray, per_sigma: float, at_rest: int, shortest_sigma: float
) -> IntArray:
    """ceil(per_sigma length + at_rest) nodes for each length in sigmas, 1 under `shortest_sigma`.

    A length that is not finite gets MAX_NODES + at_rest.
    """
    finite = np.minimum(length_sigma, 1e9)
    length = np.where(np.isfinite(length_sigma), finite, MAX_NODES / per_sigma)
    counts = np.ceil(per_sigma * length + at_rest)
    return np.asarray(np.where(length < shortest_sigma, 1, counts), dtype=np.intp)


class ShortPaths:
    """Paths (n) that approximate those of `exact`, each within `half_s` of its own `middle_s` (n,):
    polynomials through `points` of its places.

    The places are at the roots of a Chebyshev polynomial. With one point, slope and curvature of
    the path come from a table of the lens. Paths are off by at most LIMIT_PX or LIMIT_SHARE where
    `points_within` gave the number of points.
    """

    def __init__(self, exact: Paths, middle_s: FloatArray, half_s: float, points: int) -> None:
        self.camera = exact.camera
        self.speed_rad_s = exact.speed_rad_s
        self._count = len(exact)
        self._middle_s = middle_s
        self._half_s = half_s
        if points == 1:
            table = _lens_table(*_mapping(exact.camera))
            self._terms = table.along(*exact.tangents_at(middle_s, half_s))
            return
        half_steps = np.arange(points) + 0.5
        at = np.cos(half_steps * (np.pi / points))
        outward = exact.through(_beyond(exact.camera))
        x_px, y_px = outward.all_places_px(middle_s + half_s * at[:, None])
        places = np.stack([x_px, y_px], axis=1)
        powers = np.linalg.inv(np.vander(at, increasing=True))
        terms = powers @ places.reshape(points, -1)
        self._terms = terms.reshape(places.shape)

    def __len__(self) -> int:
        return self._count

    def places_px(
        self, star: IntArray | slice, seconds: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Pixel x and y of the stars at places `star` (k,), each at its own of `seconds` (k,)."""
        at = (seconds - self._middle_s[star]) / self._half_s
        if isinstance(star, slice):
            terms = self._terms[:, :, star]
        else:
            terms = self._terms.take(star, axis=2)
        places = terms[-1] * at
        for term in terms[-2:0:-1]:
            places += term
            places *= at
        places += terms[0]
        return places[0], places[1]


@dataclass(frozen=True, slots=True, eq=False)
class LensTable:
    """Where a lens images tangents: a polynomial of second degree about each node of a grid over
    the lens's box.

    `terms` (6, 2, nodes) are x and y, px: the place, its changes by a step along u and v, and its
    bends by uu / 2, uv and vv / 2. On the image places are off by up to `off_px`.
    """

    first: FloatArray
    steps: float  # a tangent
    shape: tuple[int, int]  # along u and v
    terms: FloatArray
    off_px: float = 0.0

    def along(self, at: FloatArray, by: FloatArray, bend: FloatArray) -> FloatArray:
        """The terms (3, 2, n) of 1, t and t^2 of the pixels of tangents at + by t + bend t^2,
        each (2, n).
        """
        off = (at - self.first) * self.steps
        node = np.rint(off)
        along_u, along_v = self.shape
        node[0].clip(0, along_u - 1, out=node[0])
        node[1].clip(0, along_v - 1, out=node[1])
        off -= node
        number = (node[1] * along_u + node[0]).astype(np.intp)
        place, by_u, by_v, uu, uv, vv = self.terms.take(number, axis=2)
        u, v = off
        first_u, first_v = by * self.steps
        bend_u, bend_v = bend * self.steps
        steep_u = uu * u
        steep_v = vv * v
        place += u * (by_u + steep_u)
        cross = uv * u
        place += v * (by_v + cross + steep_v)
        by_u += uv * v + 2 * steep_u
        by_v += cross + 2 * steep_v
        first = by_u * first_u + by_v * first_v
        second = by_u * bend_u + by_v * bend_v
        second += (uu * first_u + uv * first_v) * first_u
        second += vv * (first_v * first_v)
        return np.stack([place, first, second])


def _mapping(camera: Camera) -> tuple[tuple[int, int], float, tuple[float, float], Lens | None]:
    """The part of a camera by which directions become pixels: the key by which lens tables are
    kept.
    """
    return camera.resolution_px, camera.focal_length_px, camera.principal_point_px, camera.lens


@lru_cache(maxsize=4)
def _lens_table(
    size_px: tuple[int, int], focal_px: float, principal_px: tuple[float, float], lens: Lens
) -> LensTable:
    """The table of a bounded lens: its places at the grid's nodes, their slopes and bends by
    differences.
    """
    camera = _beyond(Camera(size_px, focal_px, principal_px, np.eye(3), lens))
    low, high = np.clip(np.array(lens.box).T, -lens.max_tangent, lens.max_tangent)
    beside = BESIDE_TABLE * (high - low)
    low = low - beside
    high = high + beside
    width, height = high - low
    step = float(max(width, height)) / TABLE_STEPS
    # one more node at each end
    across = np.arange(-1, round(width / step) + 2)
    down = np.arange(-1, round(height / step) + 2)
    u, v = np.meshgrid(low[0] + step * across, low[1] + step * down)
    at = np.stack(camera.places_outward_px(u.ravel(), v.ravel())).reshape(2, *u.shape)
    middle = at[:, 1:-1, 1:-1]
    row = at[:, 1:-1]
    column = at[..., 1:-1]
    left = row[..., :-2]
    right = row[..., 2:]
    above = column[:, :-2]
    below = column[:, 2:]
    by_u = (right - left) / 2
    by_v = (below - above) / 2
    half_uu = (left + right) / 2 - middle
    half_vv = (above + below) / 2 - middle
    corners = at[:, 2:, 2:] - at[:, 2:, :-2] - at[:, :-2, 2:] + at[:, :-2, :-2]
    terms = np.stack([middle, by_u, by_v, half_uu, corners / 4, half_vv])
    shape = (len(across) - 2, len(down) - 2)
    table = LensTable(low[:, None], 1 / step, shape, terms.reshape(6, 2, -1))
    nodes = np.stack([u.ravel(), v.ravel()])
    between = nodes + step / 2  # where a table of second degree is worst
    interpolated, _, _ = table.along(between, *np.zeros((2, 2, 1)))
    exact = np.stack(camera.places_outward_px(*between))
    error_px = np.hypot(*(interpolated - exact))
    on_image = camera.contains_px(*exact)
    return replace(table, off_px=float(error_px[on_image].max(initial=0.0)))


def points_within(camera: Camera, half_turn_rad: float) -> int | None:
    """The fewest places through which a path is within LIMIT_PX or LIMIT_SHARE of the exact one,
    for a camera that turns by twice that angle; None where none are enough.
    """
    for points, longest_rad in _longest_half_turns_rad(*_mapping(camera)):
        if 0 < half_turn_rad <= longest_rad:
            return points
    return None


@lru_cache(maxsize=16)
def bend_px(camera: Camera) -> float:
    """The largest distance on the image between where a lens and where a pinhole of its focal
    length has a direction, px.
    """
    if camera.lens is None:
        return 0.0
    u, v = camera.tangents(*camera.grid_px(TRIED_PLACES))
    bent = np.stack(camera.places_px(u, v))
    ideal = np.stack(replace(camera, lens=None).places_px(u, v))
    return float(np.nanmax(np.hypot(*(bent - ideal))))


@lru_cache(maxsize=16)
def _longest_half_turns_rad(
    size_px: tuple[int, int], focal_px: float, principal_px: tuple[float, float], lens: Lens | None
) -> tuple[tuple[int, float], ...]:
    """Numbers of points, and the longest half turn that each can draw, tried on such a camera; 0
    where none is short enough.
    """
    camera = Camera(size_px, focal_px, principal_px, np.eye(3), lens)
    turns = [MAX_HALF_TURN_RAD * NARROWER**k for k in range(TRIES)]
    few = POINTS
    if lens is not None and lens.max_tangent < WIDEST_TABLE:
        table = _lens_table(size_px, focal_px, principal_px, lens)
        if table.off_px <= TABLE_PX:
            few = LENS_POINTS
    longest = []
    for points in few:
        # the first that is narrow enough; 0 after the last
        first = bisect_left(turns, True, key=lambda turn: _excess(camera, turn, points) <= 1.0)
        longest.append((points, [*turns, 0.0][first]))
    return tuple(longest)


def _excess(camera: Camera, half_turn_rad: float, points: int) -> float:
    """The largest error of short paths that begin on the image, as a multiple of what is allowed,
    over turns about TRIED_AXES.
    """
    camera = _beyond(camera)
    u, v = camera.tangents(*camera.grid_px(TRIED_PLACES))
    directions = np.column_stack([u, v, np.ones_like(u)])[np.isfinite(u)]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    size = np.array(camera.resolution_px)[:, None, None]
    middle_px = (size - 1) / 2
    half_px = size / 2
    moment = np.ones(len(directions))
    worst = 0.0
    for axis in TRIED_AXES:
        exact = Paths(directions, np.array(axis), camera)
        half_s = half_turn_rad / exact.speed_rad_s
        moments = np.linspace(0.0, 2 * half_s, TRIED_MOMENTS)
        short = ShortPaths(exact, moment * half_s, half_s, points)
        short_px = []
        for at_s in moments:
            short_px.append(short.places_px(slice(None), moment * at_s))
        exact_px = np.stack(exact.all_places_px(moments[:, None]))
        length_px = np.hypot(*(exact_px[:, -1] - exact_px[:, 0]))
        allowed_px = np.maximum(LIMIT_PX, LIMIT_SHARE * length_px)
        on_image = (np.abs(exact_px - middle_px) <= half_px).all(axis=0)
        error_px = np.hypot(*(np.stack(short_px, axis=1) - exact_px))
        excess = error_px / allowed_px
        worst = max(worst, float(excess[on_image].max(initial=0.0)))
    return worst


def _beyond(camera: Camera) -> Camera:
    """The camera with its lens used somewhat beyond what it is known for."""
    lens = camera.lens
    if lens is None:
        return camera
    return replace(camera, lens=replace(lens, max_tangent=lens.max_tangent * BEYOND_LENS))
