"""A star's path across the image as sprites: the part on the image, and the number of its Gauss-Legendre nodes."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from hilstar.arrays import FloatArray, IntArray
from hilstar.scene.camera import Camera

MAX_NODES = 64  # on one path: leggauss is an eigenvalue problem, 1 ms for 64 nodes and minutes for 10 000


@lru_cache(maxsize=1)
def _node_table() -> tuple[IntArray, FloatArray, FloatArray]:
    """Where the nodes of each count begin, and nodes and weights over -1 to 1 of all counts to MAX_NODES, end to end."""
    rules = [np.polynomial.legendre.leggauss(count) for count in range(1, MAX_NODES + 1)]
    first = np.cumsum([0, 0, *range(1, MAX_NODES)])
    return first, np.concatenate([nodes for nodes, _ in rules]), np.concatenate([weights for _, weights in rules])


@dataclass(frozen=True, slots=True)
class Nodes:
    """Nodes of several paths, end to end: the path of each, its place from -1 to 1 on it, and its share of the path's light."""

    path: IntArray
    place: FloatArray
    share: FloatArray


def nodes_of(counts: IntArray) -> Nodes:
    """The Gauss-Legendre nodes of paths that have `counts` (n,) of them, each 0 to MAX_NODES."""
    first, places, weights = _node_table()
    path = np.repeat(np.arange(len(counts)), counts)
    begin = np.cumsum(counts) - counts
    entry = np.arange(len(path)) + np.repeat(first[counts] - begin, counts)
    return Nodes(path, places[entry], weights[entry] / 2)


def within_budget(wanted: IntArray, extra: int) -> IntArray:
    """The nodes (n,) that paths get of those they want: at most MAX_NODES each, and at most `extra` beyond one each.

    What exceeds `extra` is reduced in proportion; a path that wants any keeps one.
    """
    counts = np.minimum(wanted, MAX_NODES)
    beyond = np.maximum(counts - 1, 0)
    total = int(beyond.sum())
    if total <= extra:
        return np.asarray(counts)
    return np.asarray(np.minimum(counts, 1) + (beyond * (extra / total)).astype(np.intp))


class Paths:
    """Directions (n, 3) in image axes, seen by a camera that turns with a constant rate (3,) in the same axes, rad/s.

    By Rodrigues' formula; seconds count from the moment when the directions are those given.
    """

    def __init__(self, seen: FloatArray, rate_image_rad_s: FloatArray, camera: Camera) -> None:
        self.camera = camera
        self.speed_rad_s = float(np.linalg.norm(rate_image_rad_s))
        x, y, z = rate_image_rad_s / (self.speed_rad_s or 1.0)
        axis = np.array([x, y, z])
        # Component by component (3, n): several times faster than direction by direction.
        self._seen = np.ascontiguousarray(seen.T)
        self._cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]) @ self._seen
        self._along = axis[:, None] * (axis @ self._seen)

    def __len__(self) -> int:
        return int(self._seen.shape[1])

    def through(self, camera: Camera) -> Paths:
        """The same paths seen by another camera that turns with this one."""
        paths = copy(self)
        paths.camera = camera
        return paths

    def places_px(self, star: IntArray | slice, seconds: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Pixel x and y of the stars at places `star` (k,), each at its own of `seconds` (k,); NaN behind the camera."""
        return self._places_px(self._seen[:, star], self._cross[:, star], self._along[:, star], seconds)

    def all_places_px(self, seconds: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Pixel x and y (m, n) of all stars at `seconds` (m, 1), or (m, n) of their own; NaN behind the camera."""
        shape = len(seconds), len(self)
        x_px, y_px = self._places_px(self._seen[:, None], self._cross[:, None], self._along[:, None], seconds)
        return x_px.reshape(shape), y_px.reshape(shape)

    def _places_px(
        self, seen: FloatArray, cross: FloatArray, along: FloatArray, seconds: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        angle = self.speed_rad_s * seconds
        cosine = np.cos(angle)
        turned = seen * cosine
        turned -= cross * np.sin(angle)
        turned += along * (1 - cosine)
        return self.camera.project_outward(turned.reshape(3, -1).T)


@dataclass(frozen=True, slots=True)
class Chords:
    """The straight ways between the ends of n paths, px, (2, n) each: begin and end; NaN behind the camera."""

    x_px: FloatArray
    y_px: FloatArray

    def to(self, longer: FloatArray) -> Chords:
        """The same ways from their begins, so many times (n,) as long."""
        x_px, y_px = (np.stack([ends[0], ends[0] + (ends[1] - ends[0]) * longer]) for ends in (self.x_px, self.y_px))
        return Chords(x_px, y_px)

    def length_sigma(self, sigma_px: tuple[float, float]) -> FloatArray:
        """How long each is in sigmas; NaN where an end is behind the camera."""
        return np.asarray(
            np.hypot(*(np.diff(ends, axis=0)[0] / s for ends, s in zip((self.x_px, self.y_px), sigma_px, strict=True)))
        )

    def on_image(self, resolution_px: tuple[int, int], margin_px: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Begin and end (n,) of the part of each, 0 to 1, that is within `margin_px` of the image; 1 and 0 for none.

        (Liang and Barsky 1984.) A chord with one end behind the camera counts whole where the other end is on the image.
        """
        begin, end = np.zeros(self.x_px.shape[1]), np.ones(self.x_px.shape[1])
        for ends, size in ((self.x_px, resolution_px[0]), (self.y_px, resolution_px[1])):
            low, high = -0.5 - np.asarray(margin_px), size - 0.5 + np.asarray(margin_px)
            step = ends[1] - ends[0]
            still = np.abs(step) < 1e-9
            step = np.where(still, 1.0, step)
            a, b = (low - ends[0]) / step, (high - ends[0]) / step
            outside = still & ((ends[0] < low) | (ends[0] > high))
            begin = np.maximum(begin, np.where(still, np.where(outside, 1.0, 0.0), np.minimum(a, b)))
            end = np.minimum(end, np.where(still, np.where(outside, 0.0, 1.0), np.maximum(a, b)))
        seen = end > begin
        half_seen = self._half_seen(resolution_px)
        begin, end = np.where(seen, begin, 1.0), np.where(seen, end, 0.0)
        begin[half_seen], end[half_seen] = 0.0, 1.0
        return begin, end

    def _half_seen(self, resolution_px: tuple[int, int]) -> npt.NDArray[np.bool_]:
        finite = np.isfinite(self.x_px)
        width, height = resolution_px
        there = (np.abs(self.x_px - width / 2) <= width) & (np.abs(self.y_px - height / 2) <= height)
        return np.asarray((finite.sum(axis=0) == 1) & there.any(axis=0))


def node_counts(length_sigma: FloatArray, per_sigma: float, at_rest: int, shortest_sigma: float) -> IntArray:
    """ceil(per_sigma length + at_rest) nodes for each length in sigmas, 1 under `shortest_sigma`.

    A length that is not finite gets MAX_NODES.
    """
    length = np.where(np.isfinite(length_sigma), np.minimum(length_sigma, 1e9), MAX_NODES / per_sigma)
    counts = np.ceil(per_sigma * length + at_rest)
    return np.asarray(np.where(length < shortest_sigma, 1, counts), dtype=np.intp)
