"""A bench of another family than any model of hilstar's: chief rays traced by Snell's law through a real doublet onto a screen.

Millimetres and cam axes: the tracker's pupil is at the origin and looks along +z. The doublet has the prescription of a
100 mm achromat (N-BK7 and SF5, radii 62.8, -45.7 and -128.2 mm, 4.0 and 2.5 mm thick), scaled to the focal length.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hilstar.arrays import FloatArray

RADII_MM = (62.8, -45.7, -128.2)
THICKNESS_MM = (4.0, 2.5)
INDEX = (1.0, 1.5168, 1.6727, 1.0)
BACK_FOCUS_MM = 97.1
DESIGN_FOCAL_MM = 100.0


def turned(a_deg: float, b_deg: float, c_deg: float = 0.0) -> FloatArray:
    """Rotation about x, then y, then z: columns are the turned axes."""
    a, b, c = np.radians([a_deg, b_deg, c_deg])
    x = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    z = np.array([[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]])
    return np.asarray(z @ y @ x)


@dataclass(frozen=True, slots=True)
class TracedBench:
    """A doublet, tilted and decentred, before a tilted screen: angles in degrees, lengths in mm."""

    resolution_px: tuple[int, int] = (1920, 1080)
    pitch_mm: float = 0.05765
    focal_mm: float = 350.0
    to_lens_mm: float = 60.0
    lens_tilt_deg: tuple[float, float] = (0.6, -0.4)
    lens_shift_mm: tuple[float, float] = (0.8, -0.5)
    screen_tilt_deg: tuple[float, float, float] = (1.0, 0.3, 0.2)
    screen_shift_mm: tuple[float, float] = (0.5, 0.3)

    def places_px(self, directions: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Where on the screen, px, the rays of directions (n, 3) in cam end, (n,) each."""
        scale = self.focal_mm / DESIGN_FOCAL_MM
        axes = turned(*self.lens_tilt_deg)
        vertex = np.array([*self.lens_shift_mm, self.to_lens_mm])
        ray = directions / np.linalg.norm(directions, axis=1, keepdims=True) @ axes
        at = np.broadcast_to((-vertex) @ axes, ray.shape)
        for radius, before, after, step in zip(RADII_MM, INDEX[:-1], INDEX[1:], (*THICKNESS_MM, 0.0), strict=True):
            at, ray = _refracted(at, ray, radius * scale, before / after)
            at = at - np.array([0.0, 0.0, step * scale])
        at, ray = (at + np.array([0.0, 0.0, sum(THICKNESS_MM) * scale])) @ axes.T + vertex, ray @ axes.T
        screen = turned(*self.screen_tilt_deg)
        middle = np.array([*self.screen_shift_mm, self.to_lens_mm + (BACK_FOCUS_MM + sum(THICKNESS_MM)) * scale])
        normal = screen[:, 2]
        hit = at + ray * (((middle - at) @ normal) / (ray @ normal))[:, None]
        x, y = ((hit - middle) @ screen[:, :2] / self.pitch_mm).T
        return x + (self.resolution_px[0] - 1) / 2, y + (self.resolution_px[1] - 1) / 2

    def directions(self, x_px: FloatArray, y_px: FloatArray) -> FloatArray:
        """The directions (n, 3) in cam of pixels (n,): the inverse, by Newton's method with differences."""
        u = (np.asarray(x_px) - (self.resolution_px[0] - 1) / 2) * self.pitch_mm / self.focal_mm
        v = (np.asarray(y_px) - (self.resolution_px[1] - 1) / 2) * self.pitch_mm / self.focal_mm
        ones, step = np.ones_like(u), 1e-6
        for _ in range(12):
            x, y = self.places_px(np.column_stack([u, v, ones]))
            xu, yu = self.places_px(np.column_stack([u + step, v, ones]))
            xv, yv = self.places_px(np.column_stack([u, v + step, ones]))
            a, b, c, d = (xu - x) / step, (xv - x) / step, (yu - y) / step, (yv - y) / step
            area, off_x, off_y = a * d - b * c, x - x_px, y - y_px
            u, v = u - (d * off_x - b * off_y) / area, v - (a * off_y - c * off_x) / area
        return np.column_stack([u, v, ones]) / np.sqrt(u**2 + v**2 + 1)[:, None]


def _refracted(at: FloatArray, ray: FloatArray, radius: float, ratio: float) -> tuple[FloatArray, FloatArray]:
    """Points on, and directions behind, a sphere whose vertex is at the origin; `ratio` is n before over n after."""
    to_centre = at - [0.0, 0.0, radius]
    half = (ray * to_centre).sum(axis=1)
    root = np.sqrt(half**2 - (to_centre**2).sum(axis=1) + radius**2)
    at = at + ray * (-half - np.sign(radius) * root)[:, None]
    normal = (at - [0.0, 0.0, radius]) / radius
    cosine = -(ray * normal).sum(axis=1)
    turned_back = np.sqrt(1 - ratio**2 * (1 - cosine**2))
    return at, ratio * ray + (ratio * cosine - turned_back)[:, None] * normal
