"""The stars about a field, kept from frame to frame: most frames show a field that has turned by a part of a degree."""

from __future__ import annotations

import math
from dataclasses import dataclass

from hilstar.arrays import FloatArray, IntArray
from hilstar.scene.camera import Camera
from hilstar.sky.stars import Stars

# How far the field may turn before its stars are looked for again. A frame's work grows with it by the stars around the image.
KEPT_TURN_RAD = math.radians(1.0)
# The square of the chord between two attitudes is right to 1e-15, so an angle this near to the limit is over it.
ROUNDING_RAD = 1e-6


@dataclass(frozen=True, slots=True)
class _Kept:
    """Stars found about a field at an attitude: their places in `stars`, directions (3, n) and electron rates."""

    stars: Stars
    camera: Camera
    margin_px: float
    icrs_to_image: FloatArray
    near: IntArray
    directions: FloatArray
    electrons_per_s: FloatArray

    def holds(self, stars: Stars, icrs_to_image: FloatArray, camera: Camera, margin_px: float) -> bool:
        """Whether every star near that field is among these."""
        kept = self.stars
        same = stars.vectors is kept.vectors and stars.electrons_per_s is kept.electrons_per_s and stars.grid is kept.grid
        if not same or camera is not self.camera or margin_px != self.margin_px:
            return False
        difference = (icrs_to_image - self.icrs_to_image).ravel()
        # |R - S| by its elements is sqrt(8) sin(angle / 2), whatever the axis of the turn from R to S: roll counts as well.
        chord = math.sqrt(float(difference @ difference) / 8)
        return 2 * math.asin(min(1.0, chord)) <= KEPT_TURN_RAD - ROUNDING_RAD


class Candidates:
    """The stars near a camera's field, looked for again once it has turned by KEPT_TURN_RAD from where they were.

    No direction of the field moves farther than the field turns, so none that comes into view is missed. Stars among which
    bodies are moved, or whose observer moves, are looked for in every frame.
    """

    def __init__(self) -> None:
        self._kept: _Kept | None = None

    def near(
        self, stars: Stars, icrs_to_image: FloatArray, camera: Camera, margin_px: float
    ) -> tuple[IntArray, FloatArray, FloatArray]:
        """The stars within `margin_px` of the image, and some more: places in `stars`, rising, and what `stars` has for them.

        That is directions (3, n), ICRS, and electrons per second (n,). None of it is the caller's to change.
        """
        kept, keeps = self._kept, not stars.bodies and stars.velocity_km_s is None
        if keeps and kept is not None and kept.holds(stars, icrs_to_image, camera, margin_px):
            return kept.near, kept.directions, kept.electrons_per_s
        near = stars_about(stars, icrs_to_image, camera, margin_px, KEPT_TURN_RAD if keeps else 0.0)
        directions, electrons_per_s = stars.directions(near).T, stars.electrons_per_s.take(near)
        if keeps:
            self._kept = _Kept(stars, camera, margin_px, icrs_to_image.copy(), near, directions, electrons_per_s)
        return near, directions, electrons_per_s


def stars_about(stars: Stars, icrs_to_image: FloatArray, camera: Camera, margin_px: float, reach_rad: float = 0.0) -> IntArray:
    """Every star that can come within `margin_px` of the image by a turn of `reach_rad`, and some more; rising."""
    radius_rad, edges = camera.field(margin_px)
    return stars.near(icrs_to_image[2], radius_rad, edges @ icrs_to_image, reach_rad)
