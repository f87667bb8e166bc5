"""Stars of a camera that turns during its exposure: each one's path as a chain of sprites.

The mean of a star's light over the exposure is an integral over time; Gauss-Legendre quadrature turns it into a sum of
sprites that weigh together as much as the star. It is exact in the limit, so each star gets only as many as its path needs.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from hilstar.arrays import FloatArray, IntArray
from hilstar.attitude.quaternion import to_matrix
from hilstar.scene.camera import Camera
from hilstar.scene.sprites import Sprites, join_sprites, make_sprites, pack_sprites
from hilstar.sky.stars import Stars

# With ceil(1.02 r + 3) nodes on a path of r sigmas no pixel is off by more than 1e-6 of the star's flux (measured for
# sigma 0.3 to 3 px and r up to 300; tests/unit/test_smear.py holds it). A path under 0.005 sigma is a point to 1e-6.
# results/tradeoff.csv, smear: evenly spaced sprites are slower and worse.
NODES_PER_SIGMA = 1.02
NODES_AT_REST = 3
SHORTEST_PATH_SIGMA = 0.005
# Node counts are rounded up to such steps, so that stars with like paths are done together.
NODE_STEP = 1.15
# A longer turn is cut in pieces of this, so that a piece of a path is short beside the field.
LONGEST_PIECE_RAD = 0.05
MIDDLE_S = np.zeros(1)


@dataclass(frozen=True, slots=True)
class Motion:
    """An exposure: the attitude in its middle, the rate of cam in icrs (3,) in cam components, and how long it lasts."""

    q_icrs_to_cam: FloatArray
    rate_cam_rad_s: FloatArray
    exposure_s: float

    def icrs_to_image(self, seconds: FloatArray, camera: Camera) -> FloatArray:
        """Matrices (k, 3, 3) from ICRS to image axes at `seconds` (k,) after the middle of the exposure.

        A constant rate turns about one axis: Rodrigues' formula on the attitude in the middle.
        """
        speed = float(np.linalg.norm(self.rate_cam_rad_s))
        x, y, z = self.rate_cam_rad_s / speed if speed else np.zeros(3)
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        angle = -speed * seconds[:, None, None]
        turn = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * (cross @ cross)
        return np.asarray(camera.cam_to_image @ turn @ to_matrix(self.q_icrs_to_cam))


def smeared_sprites(stars: Stars, motion: Motion, camera: Camera, footprint_px: int, sigma_px: tuple[float, float]) -> Sprites:
    """Sprites whose sum is each star's mean light over the exposure; a star at rest is one sprite."""
    angle_rad = float(np.linalg.norm(motion.rate_cam_rad_s)) * motion.exposure_s
    if angle_rad == 0:
        return make_sprites(stars, motion.icrs_to_image(MIDDLE_S, camera)[0], camera, footprint_px)
    pieces = int(np.ceil(angle_rad / LONGEST_PIECE_RAD))
    edges_s = np.linspace(-0.5, 0.5, pieces + 1) * motion.exposure_s
    chain = []
    for begin_s, end_s in itertools.pairwise(edges_s):
        piece = _Piece(motion, camera, float(begin_s), float(end_s))
        margin_rad = angle_rad / pieces
        near = stars.grid.near(piece.to_image(MIDDLE_S)[0, 2], camera.field_radius_rad(footprint_px / 2 + 1) + margin_rad)
        nodes = _node_counts(stars.vectors[near], piece, sigma_px)
        for count in np.unique(nodes):
            if count:
                chain.append(_piece_sprites(stars, near[nodes == count], piece, int(count), (footprint_px, pieces)))
    return join_sprites(chain, footprint_px)


@dataclass(frozen=True, slots=True)
class _Piece:
    """A part of an exposure, over which t runs from -1 to 1."""

    motion: Motion
    camera: Camera
    begin_s: float
    end_s: float

    def to_image(self, t: FloatArray) -> FloatArray:
        seconds = (self.begin_s + self.end_s) / 2 + t * (self.end_s - self.begin_s) / 2
        return self.motion.icrs_to_image(seconds, self.camera)

    def places_px(self, vectors: FloatArray, t: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Pixel x and y of n directions at k times, (k, n) each; NaN behind the camera."""
        seen = vectors @ self.to_image(t).transpose(0, 2, 1)
        x_px, y_px = self.camera.project(seen.reshape(-1, 3))
        return x_px.reshape(len(t), -1), y_px.reshape(len(t), -1)


def _node_counts(vectors: FloatArray, piece: _Piece, sigma_px: tuple[float, float]) -> IntArray:
    """How many nodes each star's path needs, from its length in sigmas over two chords; 0 for one behind the camera."""
    x_px, y_px = piece.places_px(vectors, np.array([-1.0, 0.0, 1.0]))
    length = np.hypot(np.diff(x_px, axis=0) / sigma_px[0], np.diff(y_px, axis=0) / sigma_px[1]).sum(axis=0)
    seen = np.isfinite(length)
    needed = np.where(seen, np.ceil(NODES_PER_SIGMA * np.where(seen, length, 0.0) + NODES_AT_REST), 0)
    needed[seen & (length < SHORTEST_PATH_SIGMA)] = 1
    many = needed > NODES_AT_REST + 1
    needed[many] = np.ceil(NODE_STEP ** np.ceil(np.log(needed[many]) / np.log(NODE_STEP)))
    return needed.astype(np.intp)


@lru_cache(maxsize=64)
def gauss_nodes(count: int) -> tuple[FloatArray, FloatArray]:
    """Gauss-Legendre nodes and weights over -1 to 1: an eigenvalue problem, 10 ms for 300 nodes."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return nodes, weights


def _piece_sprites(stars: Stars, chosen: IntArray, piece: _Piece, count: int, shape: tuple[int, int]) -> Sprites:
    """The sprites of the `chosen` stars at the `count` nodes of a piece; `shape` is (footprint, number of pieces)."""
    footprint_px, pieces = shape
    nodes, weights = gauss_nodes(count)
    x_px, y_px = piece.places_px(stars.vectors[chosen], nodes)
    share = np.outer(weights / 2 / pieces, stars.electrons_per_s[chosen])
    star = np.broadcast_to(chosen, x_px.shape)
    frame = (piece.camera.resolution_px, footprint_px)
    return pack_sprites(x_px.ravel(), y_px.ravel(), share.ravel(), star.ravel(), frame)
