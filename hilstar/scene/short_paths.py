"""Paths of stars over a short turn as polynomials in time, through a few places that are exact.

A place on such a path costs two short sums, where an exact one costs a rotation and, behind a real lens, a hundred operations.
"""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import replace
from functools import lru_cache

import numpy as np

from hilstar.arrays import FloatArray, IntArray
from hilstar.scene.camera import Camera
from hilstar.scene.paths import Paths

# A place may be off by the larger of these: px, and of the path's length within the turn. Either changes a pixel of a star of
# sigma 0.5 px by 5e-4 of its flux, half of what the nodes may: the longer a path, the fainter it is.
LIMIT_PX = 1e-3
LIMIT_SHARE = 5e-4
POINTS = (2, 3)
# Half a turn that 3 points draw through 350 mm and a strong lens with a field of degree 6: 0.29 deg, 28 deg/s at 60 Hz.
MAX_HALF_TURN_RAD = 0.04
NARROWER = 2**-0.25  # from one half turn that is tried to the next; the error falls with its power of the number of points
TRIES = 40
TRIED_PLACES, TRIED_MOMENTS = 13, 9  # along each side of the image, and within a turn
TRIED_AXES = [(x, y, z) for x in (-1.0, 0.0, 1.0) for y in (-1.0, 0.0, 1.0) for z in (0.0, 1.0) if (x, y, z) != (0.0, 0.0, 0.0)]
# A path may begin or end beyond what its lens is known for. Straight lines from there would put a kink into it.
BEYOND_LENS = 1.05


class ShortPaths:
    """The paths of `exact` (n), each within `half_s` of its own `middle_s` (n,), through as many of its places as `points`.

    These are at the roots of a Chebyshev polynomial. Off by at most LIMIT_PX or LIMIT_SHARE where `points_within` gave them.
    """

    def __init__(self, exact: Paths, middle_s: FloatArray, half_s: float, points: int) -> None:
        self.camera = exact.camera
        self.speed_rad_s = exact.speed_rad_s
        self._count = len(exact)
        self._middle_s, self._half_s = middle_s, half_s
        at = np.cos((np.arange(points) + 0.5) * (np.pi / points))
        places = np.stack(exact.through(_beyond(exact.camera)).all_places_px(middle_s + half_s * at[:, None]), axis=1)
        powers = np.linalg.inv(np.vander(at, increasing=True))
        self._terms = (powers @ places.reshape(points, -1)).reshape(places.shape)

    def __len__(self) -> int:
        return self._count

    def places_px(self, star: IntArray | slice, seconds: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Pixel x and y of the stars at places `star` (k,), each at its own of `seconds` (k,)."""
        at = (seconds - self._middle_s[star]) / self._half_s
        terms = self._terms[:, :, star]
        places = terms[-1] * at
        for term in terms[-2:0:-1]:
            places += term
            places *= at
        places += terms[0]
        return places[0], places[1]


def points_within(camera: Camera, half_turn_rad: float) -> int | None:
    """How many points keep paths within LIMIT_PX or LIMIT_SHARE, for a turn of twice that angle; None where no few do."""
    for points, longest_rad in zip(POINTS, _longest_half_turns_rad(camera), strict=True):
        if 0 < half_turn_rad <= longest_rad:
            return points
    return None


@lru_cache(maxsize=16)
def bend_px(camera: Camera) -> float:
    """The farthest that a lens moves a direction from where a pinhole has it, on the image."""
    if camera.lens is None:
        return 0.0
    u, v = camera.tangents(*camera.grid_px(TRIED_PLACES))
    bent, ideal = (np.stack(seen.places_px(u, v)) for seen in (camera, replace(camera, lens=None)))
    return float(np.nanmax(np.hypot(*(bent - ideal))))


@lru_cache(maxsize=16)
def _longest_half_turns_rad(camera: Camera) -> tuple[float, ...]:
    """The longest half turn that each of POINTS can draw, tried on this camera: 0 where even a short one is off."""
    turns = [MAX_HALF_TURN_RAD * NARROWER**k for k in range(TRIES)]
    firsts = [bisect_left(turns, True, key=lambda turn: _excess(camera, turn, points) <= 1.0) for points in POINTS]
    return tuple([*turns, 0.0][first] for first in firsts)


def _excess(camera: Camera, half_turn_rad: float, points: int) -> float:
    """The largest error on the image, about several axes, as a multiple of what it may be: of paths that begin on the image."""
    camera = _beyond(camera)
    u, v = camera.tangents(*camera.grid_px(TRIED_PLACES))
    seen = np.column_stack([u, v, np.ones_like(u)])[np.isfinite(u)]
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    middle_px, half_px = ((np.array(camera.resolution_px)[:, None, None] - k) / 2 for k in (1, 0))
    worst = 0.0
    for axis in TRIED_AXES:
        exact = Paths(seen, np.array(axis), camera)
        half_s = half_turn_rad / exact.speed_rad_s
        moments = np.linspace(0.0, 2 * half_s, TRIED_MOMENTS)
        short = ShortPaths(exact, np.full(len(seen), half_s), half_s, points)
        found = [short.places_px(slice(None), np.full(len(seen), moment)) for moment in moments]
        places = np.stack(exact.all_places_px(moments[:, None]))
        allowed = np.maximum(LIMIT_PX, LIMIT_SHARE * np.hypot(*(places[:, -1] - places[:, 0])))
        on_image = (np.abs(places - middle_px) <= half_px).all(axis=0)
        excess = np.hypot(*(np.stack(found, axis=1) - places)) / allowed
        worst = max(worst, float(excess[on_image].max(initial=0.0)))
    return worst


def _beyond(camera: Camera) -> Camera:
    lens = camera.lens
    return camera if lens is None else replace(camera, lens=replace(lens, max_tangent=lens.max_tangent * BEYOND_LENS))
