"""The tiles of a large disc: those in which its light is as good as linear, those about its edges, and none where it is not.

A Lambert or lunar face changes little over a tile that is far from limb and terminator: the light at its corners, by
`Disc.radiance`, and straight lines between them are then within SMOOTH of the radiance under a zenith Sun. The others are drawn
ray by ray. In software a whole field is thus drawn several times faster.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hilstar.arrays import Float32Array, FloatArray
from hilstar.scene.extended import DiscLight, Rectangle
from hilstar.sky.bodies.disc import AIR_TOP

TILE_PX = 24
LEAST_PX = 40_000  # of a rectangle: a smaller one is drawn whole
SMOOTH = 5e-4  # of the radiance under a zenith Sun
STEEP = 4 * SMOOTH  # of a tile in radii: over a wider one the terminator bends light by more than SMOOTH
REACH_SIGMAS = 5.0
WIDER = 1.5  # an angle across a tile, for a lens, a field's corner and a flattened body
CORNERS = ((0, 0), (0, 1), (1, 0), (0, 1), (1, 1), (1, 0))  # of two triangles: rows, columns


@dataclass(frozen=True, slots=True)
class Tiles:
    """Tiles of TILE_PX, corners (n, 3) of two triangles each: x and y in pixels' edges, and the light, of `edges` none."""

    region: Rectangle
    linear: Float32Array
    edges: Float32Array


def disc_tiles(light: DiscLight, region: Rectangle) -> Tiles | None:
    """The tiles of a disc in a rectangle of its image; None where that is small."""
    left, top, width, height = region
    if width * height < LEAST_PX:
        return None
    x, y = (begin + TILE_PX * np.arange(-(-size // TILE_PX) + 1) for begin, size in ((left, width), (top, height)))
    x_px, y_px = np.meshgrid(x - 0.5, y - 0.5)
    seen, sr = _rays(light, x_px.ravel(), y_px.ravel())
    shape = len(y), len(x)
    directions = seen @ light.icrs_to_image
    impact = light.disc.impact(directions).reshape(shape)
    rates = (light.disc.radiance(directions) * sr * light.times).reshape(shape)
    px_per_rad = light.camera.scales_px_rad()[0]
    beside = _beside(light, directions, px_per_rad).reshape(shape)
    beside = _all(beside)
    linear = _linear(light, impact, rates > 0, px_per_rad) & ~beside
    drawn = np.argwhere(~beside)
    if not len(drawn):
        return Tiles((left, top, 0, 0), *np.empty((2, 0, 3), dtype=np.float32))
    (first_y, first_x), (last_y, last_x) = drawn.min(axis=0) * TILE_PX, (drawn.max(axis=0) + 1) * TILE_PX
    inner = left + first_x, top + first_y, min(width, last_x) - first_x, min(height, last_y) - first_y
    return Tiles(
        (int(inner[0]), int(inner[1]), int(inner[2]), int(inner[3])),
        _corners(linear, x, y, rates),
        _corners(~linear & ~beside, x, y, np.zeros(shape)),
    )


def _rays(light: DiscLight, x_px: FloatArray, y_px: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Directions (n, 3), image axes, of places on the image while they are lit, and steradians to a pixel there (n,)."""
    u, v = light.camera.tangents(x_px, y_px)
    seen = np.stack([u, v, np.ones_like(u)], axis=1)
    if light.shear is not None:
        seen += light.shear.late_s(x_px, y_px)[:, None] * np.cross(light.shear.rate_image_rad_s, seen)
    a, b, c, d = light.camera.slopes(u, v)
    return seen, 1 / ((a * d - b * c) * np.linalg.norm(seen, axis=1) ** 3)


def _linear(light: DiscLight, impact: FloatArray, lit: npt.NDArray[np.bool_], px_per_rad: float) -> npt.NDArray[np.bool_]:
    """Which tiles are far enough within the limb, and off the terminator where that would be seen."""
    disc = light.disc
    inside = np.minimum(impact, 1.0)  # NaN stays
    tile_radii = TILE_PX * np.sqrt(np.maximum(disc.distance_radii**2 - inside**2, 0.0)) / px_per_rad
    # A face's height over the plane of its limb goes as the root of 1 - impact^2, whose second derivative is its power -3/2.
    flat = (1 - inside**2) ** 1.5 > tile_radii**2 / (8 * SMOOTH)
    flat &= 1 - impact > REACH_SIGMAS * max(light.variance_px) ** 0.5 * disc.distance_radii / px_per_rad
    one_sort = _all(lit) | _all(~lit) | _all(tile_radii < STEEP)
    return np.asarray(_all(flat) & one_sort)


def _beside(light: DiscLight, directions: FloatArray, px_per_rad: float) -> npt.NDArray[np.bool_]:
    """Which corners (n,) are so far beside that the disc, its air and the Gaussian do not reach their tiles."""
    disc = light.disc
    seen = directions @ disc.to_sphere.T
    angle = np.arctan2(np.hypot(seen[:, 0], seen[:, 1]), seen[:, 2])
    rim = np.arcsin(min(1.0, (1 + AIR_TOP * disc.air_radii) / disc.distance_radii))
    more_px = TILE_PX * np.sqrt(2) + REACH_SIGMAS * max(light.variance_px) ** 0.5
    return np.asarray(angle > rim + WIDER * more_px / px_per_rad)


def _all(nodes: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Which tiles have it at all corners."""
    return nodes[:-1, :-1] & nodes[1:, :-1] & nodes[:-1, 1:] & nodes[1:, 1:]


def _corners(
    tiles: npt.NDArray[np.bool_], x: npt.NDArray[np.int64], y: npt.NDArray[np.int64], rates: FloatArray
) -> Float32Array:
    """Of two triangles a tile (n, 3): x, y and light."""
    row, column = np.nonzero(tiles)
    down, right = np.array(CORNERS).T
    rows, columns = (row[:, None] + down).ravel(), (column[:, None] + right).ravel()
    return np.stack([x[columns], y[rows], rates[rows, columns]], axis=1).astype(np.float32)
