"""The tiles of a large disc: those in which its light is as good as linear, those about its edges, and none where it is not.

A Lambert or lunar face changes little over a tile that is far from limb and terminator, and the air over a part of its scale
height: the light at corners and straight lines between them are then within SMOOTH of the radiance under a zenith Sun, of the
air within AIR_SMOOTH. The other tiles are drawn ray by ray. In software a whole field is thus drawn several times faster.
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
# Of a scale height: along it the air's light, 1 - exp(-depth exp(-height)), has a second derivative of at most 0.2 of its most.
AIR_STEP = 0.4
AIR_SMOOTH = AIR_STEP**2 / 8 * 0.2
MAX_PARTS = 6  # of a tile's side: thinner air is drawn ray by ray
REACH_SIGMAS = 5.0
WIDER = 1.5  # an angle across a tile, for a lens, a field's corner and a flattened body
CORNERS = ((0, 0), (0, 1), (1, 0), (0, 1), (1, 1), (1, 0))  # of two triangles: rows, columns

Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Tiles:
    """Tiles in `region`: corners (n, 4) of two triangles each, x and y in pixels' edges, light and cover, of `edges` none."""

    region: Rectangle
    linear: Float32Array
    edges: Float32Array


def disc_tiles(light: DiscLight, region: Rectangle) -> Tiles | None:
    """The tiles of a disc in a rectangle of its image; None where that is small."""
    left, top, width, height = region
    if width * height < LEAST_PX:
        return None
    x, y = (begin + TILE_PX * np.arange(-(-size // TILE_PX) + 1) for begin, size in ((left, width), (top, height)))
    places = np.stack(np.meshgrid(x, y), axis=-1).astype(np.float64)
    seen, sr = _rays(light, places.reshape(-1, 2))
    directions, shape = seen @ light.icrs_to_image, places.shape[:2]
    impact = light.disc.impact(directions).reshape(shape)
    rates = (light.disc.radiance(directions) * sr * light.times).reshape(shape)
    px_per_rad = light.camera.scales_px_rad()[0]
    beside = _all(_beside(light, directions, px_per_rad).reshape(shape))
    face = _face(light, impact, rates > 0, px_per_rad) & ~beside
    parts = _parts(light, px_per_rad)
    air = np.zeros_like(face) if parts is None else _all(impact > 1 + _margin(light, px_per_rad)) & ~beside
    drawn = np.argwhere(~beside)
    if not len(drawn):
        return Tiles((left, top, 0, 0), *np.empty((2, 0, 4), dtype=np.float32))
    (first_y, first_x), (last_y, last_x) = drawn.min(axis=0) * TILE_PX, (drawn.max(axis=0) + 1) * TILE_PX
    inner = left + first_x, top + first_y, min(width, last_x) - first_x, min(height, last_y) - first_y
    of_face = np.concatenate([places, rates[..., None], np.ones((*shape, 1))], axis=-1)
    return Tiles(
        (int(inner[0]), int(inner[1]), int(inner[2]), int(inner[3])),
        np.concatenate([_corners(of_face, face), _air(light, places[:-1, :-1][air], parts or 1)]),
        _corners(of_face, ~face & ~air & ~beside),
    )


def _rays(light: DiscLight, places: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Directions (n, 3), image axes, of places (n, 2) in pixels' edges while they are lit, and steradians to a pixel there."""
    x_px, y_px = places.T - 0.5
    u, v = light.camera.tangents(x_px, y_px)
    seen = np.stack([u, v, np.ones_like(u)], axis=1)
    if light.shear is not None:
        seen += light.shear.late_s(x_px, y_px)[:, None] * np.cross(light.shear.rate_image_rad_s, seen)
    a, b, c, d = light.camera.slopes(u, v)
    return seen, 1 / ((a * d - b * c) * np.linalg.norm(seen, axis=1) ** 3)


def _face(light: DiscLight, impact: FloatArray, lit: Mask, px_per_rad: float) -> Mask:
    """Which tiles are far enough within the limb, and off the terminator where that would be seen."""
    disc = light.disc
    inside = np.minimum(impact, 1.0)  # NaN stays
    tile_radii = TILE_PX * np.sqrt(np.maximum(disc.distance_radii**2 - inside**2, 0.0)) / px_per_rad
    # A face's height over the plane of its limb goes as the root of 1 - impact^2, whose second derivative is its power -3/2.
    flat = (1 - inside**2) ** 1.5 > tile_radii**2 / (8 * SMOOTH)
    flat &= impact < 1 - _margin(light, px_per_rad)
    one_sort = _all(lit) | _all(~lit) | _all(tile_radii < STEEP)
    return np.asarray(_all(flat) & one_sort)


def _margin(light: DiscLight, px_per_rad: float) -> float:
    """How many radii the Gaussian reaches at most."""
    return float(REACH_SIGMAS * max(light.variance_px) ** 0.5 * light.disc.distance_radii / px_per_rad)


def _parts(light: DiscLight, px_per_rad: float) -> int | None:
    """Into how many parts a tile's side is divided for air; None where there is none, or too thin a shell."""
    disc = light.disc
    if disc.air is None or disc.distance_radii <= 1:
        return None
    # A height at the limb, px: impact grows by the cosine of the angle from the middle there
    scale_px = disc.air_radii * px_per_rad / np.sqrt(disc.distance_radii**2 - 1)
    parts = int(np.ceil(TILE_PX / (AIR_STEP * scale_px)))
    return parts if parts <= MAX_PARTS else None


def _air(light: DiscLight, tiles: FloatArray, parts: int) -> Float32Array:
    """Corners of the parts of tiles of air, whose first corners are (n, 2)."""
    if not len(tiles):
        return np.empty((0, 4), dtype=np.float32)
    steps = TILE_PX / parts * np.arange(parts + 1)
    places = tiles[:, None, None, :] + np.stack(np.meshgrid(steps, steps), axis=-1)
    seen, sr = _rays(light, places.reshape(-1, 2))
    radiance, cover = light.disc.air_light(seen @ light.icrs_to_image)
    corners = np.concatenate([places.reshape(-1, 2), (radiance * sr * light.times)[:, None], cover[:, None]], axis=1)
    return _corners(corners.reshape(*places.shape[:3], 4))


def _beside(light: DiscLight, directions: FloatArray, px_per_rad: float) -> Mask:
    """Which corners (n,) are so far beside that the disc, its air and the Gaussian do not reach their tiles."""
    disc = light.disc
    seen = directions @ disc.to_sphere.T
    angle = np.arctan2(np.hypot(seen[:, 0], seen[:, 1]), seen[:, 2])
    rim = np.arcsin(min(1.0, (1 + AIR_TOP * disc.air_radii) / disc.distance_radii))
    more_px = TILE_PX * np.sqrt(2) + REACH_SIGMAS * max(light.variance_px) ** 0.5
    return np.asarray(angle > rim + WIDER * more_px / px_per_rad)


def _all(nodes: Mask) -> Mask:
    """Which tiles have it at all corners."""
    return nodes[:-1, :-1] & nodes[1:, :-1] & nodes[:-1, 1:] & nodes[1:, 1:]


def _corners(nodes: FloatArray, tiles: Mask | None = None) -> Float32Array:
    """Of two triangles a tile (n, 4), from lattices (..., rows, columns, 4); of all tiles, or of those of a mask."""
    size = nodes.shape[-3] - 1, nodes.shape[-2] - 1
    parts = [nodes[..., row : row + size[0], column : column + size[1], :] for row, column in CORNERS]
    found = np.stack(parts, axis=-2)
    return (found if tiles is None else found[tiles]).reshape(-1, 4).astype(np.float32)
