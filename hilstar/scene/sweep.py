"""Stars of one frame of a screen that lights row by row, while the camera turns.

Row y of a screen begins its light a part of a refresh period later than the first, and keeps it until it is written anew.
So a star is drawn where it is while the row under it is lit: on its path from the moment when that row lights to the end of
its light, as a chain of sprites that weigh together as much as the star. Frame by frame the paths join to one streak.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.attitude.quaternion import to_matrix
from hilstar.scene.camera import Camera
from hilstar.scene.smear import gauss_nodes
from hilstar.scene.sprites import Sprites, pack_sprites
from hilstar.sky.stars import Stars

# With ceil(0.6 r + 1) nodes on a path of r sigmas no pixel is off by more than 1e-3 of the star's flux (measured for sigma
# 0.5 to 2 px and r to 30; tests/unit/test_sweep.py holds it): its flux and centroid are exact with any number.
NODES_PER_SIGMA = 0.6
# A path of so many sigmas is a point to 1e-3 of the star's flux.
POINT_SIGMA = 0.27
LONGEST_ANGLE_RAD = 0.5  # in half a frame; a camera that turns faster is drawn as if it turned so fast


@dataclass(frozen=True, slots=True)
class Scan:
    """How a screen lights: rows in turn over `scanout_s`, each then for `hold_s`.

    `down` is the direction of the screen's rows in image axes (x right, y down), one of the four along an axis.
    """

    down: tuple[int, int] = (0, 1)
    scanout_s: float = 0.0
    hold_s: float = 0.0

    @property
    def longest_s(self) -> float:
        """For so long a star of the frame may have moved, seen from the middle row's first light."""
        return self.scanout_s / 2 + self.hold_s

    def late_s(self, x_px: FloatArray, y_px: FloatArray, resolution_px: tuple[int, int]) -> FloatArray:
        """How long after the middle row the row under a pixel lights; off the image as at its edge."""
        middle_x, middle_y = ((size - 1) / 2 for size in resolution_px)
        rows = resolution_px[0] if self.down[0] else resolution_px[1]
        place = (self.down[0] * (x_px - middle_x) + self.down[1] * (y_px - middle_y)) / rows
        return np.asarray(np.clip(place, -0.5, 0.5) * self.scanout_s)


@dataclass(frozen=True, slots=True)
class Turn:
    """The attitude when the middle row lights, and the rate of cam in icrs (3,), cam components, constant over the frame."""

    q_icrs_to_cam: FloatArray
    rate_cam_rad_s: FloatArray

    @property
    def speed_rad_s(self) -> float:
        """How fast the camera turns."""
        return float(np.linalg.norm(self.rate_cam_rad_s))


def swept_sprites(
    stars: Stars, turn: Turn, scan: Scan, camera: Camera, footprint_px: int, sigma_px: tuple[float, float]
) -> Sprites:
    """Sprites of each star on its path over the light of the row that it is on; several sprites of a star follow each other."""
    speed = turn.speed_rad_s
    longest_rad = min(speed * scan.longest_s, LONGEST_ANGLE_RAD)
    to_image = camera.cam_to_image @ to_matrix(turn.q_icrs_to_cam)
    near = stars.grid.near(to_image[2], camera.field_radius_rad(footprint_px / 2 + 1) + longest_rad)
    paths = _Paths(stars.vectors[near] @ to_image.T, camera.cam_to_image @ turn.rate_cam_rad_s, camera)
    late_s = np.zeros(len(near))
    for _ in range(2):  # each pass leaves the part of the frame that the star crosses in it: 1e-5 of it for 5 px in 1080 rows
        x_px, y_px = paths.places_px(late_s[None])
        late_s = scan.late_s(x_px[0], y_px[0], camera.resolution_px)
    count = _node_count(paths, late_s, scan.hold_s, sigma_px)
    nodes, weights = gauss_nodes(count)
    x_px, y_px = paths.places_px(late_s + (nodes[:, None] + 1) / 2 * scan.hold_s)
    light = np.outer(weights / 2, stars.electrons_per_s[near])
    star = np.broadcast_to(near, x_px.shape)
    frame = (camera.resolution_px, footprint_px)
    return replace(pack_sprites(x_px.ravel(), y_px.ravel(), light.ravel(), star.ravel(), frame), per_star=count)


class _Paths:
    """Directions (n, 3) in image axes that turn with a constant rate, by Rodrigues' formula."""

    def __init__(self, vectors: FloatArray, rate_rad_s: FloatArray, camera: Camera) -> None:
        self._camera = camera
        self._vectors = vectors
        self._speed = float(np.linalg.norm(rate_rad_s))
        axis = rate_rad_s / self._speed if self._speed else np.zeros(3)
        self._cross = np.cross(axis, vectors)
        self._along = (vectors @ axis)[:, None] * axis

    def places_px(self, seconds: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Pixel x and y at `seconds` (k, n), which each star has for itself; NaN behind the camera."""
        angle = np.clip(self._speed * seconds, -LONGEST_ANGLE_RAD, LONGEST_ANGLE_RAD)[..., None]
        cosine = np.cos(angle)
        seen = self._vectors * cosine - self._cross * np.sin(angle) + self._along * (1 - cosine)
        x_px, y_px = self._camera.project(seen.reshape(-1, 3))
        return x_px.reshape(seconds.shape), y_px.reshape(seconds.shape)


def _node_count(paths: _Paths, late_s: FloatArray, hold_s: float, sigma_px: tuple[float, float]) -> int:
    """How many sprites the longest of the paths needs."""
    if hold_s == 0 or not len(late_s):
        return 1
    x_px, y_px = paths.places_px(late_s + np.array([[0.0], [hold_s]]))
    length = np.hypot(np.diff(x_px, axis=0) / sigma_px[0], np.diff(y_px, axis=0) / sigma_px[1])
    longest = float(np.max(length, initial=0.0, where=np.isfinite(length)))
    return 1 if longest < POINT_SIGMA else int(np.ceil(NODES_PER_SIGMA * longest + 1))
