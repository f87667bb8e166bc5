"""How exact a disc is at each size: what the renderer draws against rays in float64, and what a point in its place would be."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.render.renderer import Renderer, Target
from hilstar.scene.camera import Camera
from hilstar.scene.extended import DiscView, ExtendedLight, Pose, disc_lights
from hilstar.scene.sprites import Sprites, pack_sprites
from hilstar.sky.bodies.disc import Disc, lunar_share

SIGMA_PX = (0.85, 0.85)
MIDDLE_PX = (0.2, -0.3)  # of the disc, from the middle pixel's centre: no symmetry helps
FOCAL_PX = 6000.0
RADII_PX = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 4.0, 6.0, 8.0, 12.0, 20.0, 40.0, 80.0)
QUICK_RADII_PX = (0.1, 2.0, 12.0)
PHASES_DEG = (0.0, 60.0, 120.0, 150.0)
FEWEST_RAYS, RAYS_A_PX, MOST_RAYS = 600, 16, 2400  # along each side: at most 0.07 px apart, under a tenth of sigma
LIMB_PX = 4.0  # a smaller disc has no edge that falls from a middle
PLACES = 60
MARGIN_PX = 8


@dataclass(frozen=True, slots=True)
class Exactness:
    """A body of one radius at one phase: its light, the place of its limb (NaN: none) or of its middle, single pixels.

    `flux_off` and `pixel_off` are relative to all its light and to its brightest pixel; `point_pixel_off` is that of a point.
    """

    body: str
    phase_deg: float
    radius_px: float
    flux_off: float
    middle_off_px: float
    limb_off_px: float
    pixel_off: float
    point_pixel_off: float


def moon(radius_px: float, phase_deg: float) -> Disc:
    """A Moon of that radius off the middle of an image."""
    ahead = np.array([MIDDLE_PX[0] / FOCAL_PX, MIDDLE_PX[1] / FOCAL_PX, 1.0])
    ahead /= np.linalg.norm(ahead)
    side = np.cross(ahead, [0.3, 1.0, 0.0])
    side /= np.linalg.norm(side)
    phase = np.radians(phase_deg)
    sun = -np.cos(phase) * ahead + np.sin(phase) * side
    far = 1 / np.sin(radius_px / FOCAL_PX)
    disc = Disc("Moon", ahead, far, 1.0, 1.0, np.array([0.0, 1.0, 0.0]), sun, "lunar-lambert", 1.0, lunar_share(phase_deg))
    return disc.of_rate(1e6)


def measure(radius_px: float, phase_deg: float) -> Exactness:
    """A Moon as it is drawn, against rays."""
    disc = moon(radius_px, phase_deg)
    half = int(np.ceil(radius_px)) + MARGIN_PX
    size = (2 * half + 1, 2 * half + 1)
    camera = Camera(size, FOCAL_PX, (half, half), np.eye(3))
    with Renderer(Target(size, SIGMA_PX)) as renderer:
        point = _point(disc, camera, renderer.footprint_px)
        lights = disc_lights(disc, DiscView(camera, SIGMA_PX, (Pose(np.eye(3)),)), covers=True)
        renderer.draw(_dark(point, tuple(lights)))
        drawn = renderer.linear().astype(np.float64)
        renderer.draw(point)
        as_point = renderer.linear().astype(np.float64)
    truth = traced(disc, camera)
    off_px = np.array(_middle(drawn)) - np.array(_middle(truth))
    limb = np.nan
    if radius_px >= LIMB_PX and phase_deg <= 90:
        limb = float(np.nanmax(np.abs(_edges(drawn, radius_px, phase_deg) - _edges(truth, radius_px, phase_deg))))
    brightest = truth.max()
    return Exactness(
        body=disc.name,
        phase_deg=phase_deg,
        radius_px=radius_px,
        flux_off=float(drawn.sum() / truth.sum() - 1),
        middle_off_px=float(np.abs(off_px).max()),
        limb_off_px=limb,
        pixel_off=float(np.abs(drawn - truth).max() / brightest),
        point_pixel_off=float(np.abs(as_point - truth).max() / brightest),
    )


def traced(disc: Disc, camera: Camera) -> FloatArray:
    """The image of a disc by rays on a lattice about it, float64, each ray's light spread by the Gaussian over the pixels."""
    from scipy.special import ndtr

    radius_px = np.tan(disc.radius_rad) * camera.focal_length_px * 1.001
    count = int(np.clip(RAYS_A_PX * 2 * radius_px, FEWEST_RAYS, MOST_RAYS))
    step_px = 2 * radius_px / count
    (x_mid,), (y_mid,) = camera.project(disc.direction[None])
    along = (np.arange(count) + 0.5) * step_px - radius_px
    x_px, y_px = np.meshgrid(x_mid + along, y_mid + along)
    rays = camera.rays(x_px.ravel(), y_px.ravel())
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    # The solid angle of a square of the image plane: the cube of the ray's cosine to the axis
    light = disc.radiance(rays) * (step_px / camera.focal_length_px) ** 2 * rays[:, 2] ** 3
    width, height = camera.resolution_px
    across = np.diff(ndtr((np.arange(width + 1) - 0.5 - (x_mid + along)[:, None]) / SIGMA_PX[0]), axis=1)
    down = np.diff(ndtr((np.arange(height + 1) - 0.5 - (y_mid + along)[:, None]) / SIGMA_PX[1]), axis=1)
    return np.asarray(down.T @ light.reshape(count, count) @ across)


def _dark(point: Sprites, lights: tuple[ExtendedLight, ...]) -> Sprites:
    return replace(point, data=point.data[:0], star=point.star[:0], x_px=point.x_px[:0], y_px=point.y_px[:0], extended=lights)


def _point(disc: Disc, camera: Camera, footprint_px: int) -> Sprites:
    x_px, y_px = camera.project(disc.direction[None])
    return pack_sprites(x_px, y_px, np.array([1e6]), np.zeros(1, dtype=np.intp), camera.resolution_px, footprint_px)


def _middle(image: FloatArray) -> tuple[float, float]:
    """The centroid of an image, px."""
    y_px, x_px = np.indices(image.shape)
    return float((image * x_px).sum() / image.sum()), float((image * y_px).sum() / image.sum())


def _edges(image: FloatArray, radius_px: float, phase_deg: float) -> FloatArray:
    """Where an image falls to half of what it has 3 px inside the limb, on its lit side, px outward of it."""
    from scipy.ndimage import map_coordinates

    half = image.shape[0] // 2
    lit = 1.0 if phase_deg else np.pi  # radians to either side of the Sun's
    ahead = np.array([MIDDLE_PX[0] / FOCAL_PX, MIDDLE_PX[1] / FOCAL_PX, 1.0])
    sun = np.cross(ahead, [0.3, 1.0, 0.0])
    angle = np.arctan2(sun[1], sun[0]) + np.linspace(-lit, lit, PLACES)
    steps = np.linspace(-3.0, 3.0, 241)
    way = radius_px + steps[None, :]
    x_px = half + MIDDLE_PX[0] + way * np.cos(angle)[:, None]
    y_px = half + MIDDLE_PX[1] + way * np.sin(angle)[:, None]
    profile = map_coordinates(image, [y_px, x_px], order=3, mode="nearest")
    level = profile[:, :1] / 2
    below = profile < level
    first = np.maximum(np.argmax(below, axis=1), 1)
    rows = np.arange(PLACES)
    high, low = profile[rows, first - 1], profile[rows, first]
    place = steps[first - 1] + (steps[1] - steps[0]) * (high - level[:, 0]) / (high - low)
    return np.asarray(np.where(below.any(axis=1), place, np.nan))
