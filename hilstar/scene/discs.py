"""Discs of bodies as light for the renderer: a small one as a map of its spread places, a larger one ray by ray."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hilstar.arrays import Float32Array, FloatArray
from hilstar.scene.camera import Camera
from hilstar.scene.extended import DiscLight, ExtendedLight, LightMap, Shear, clipped
from hilstar.scene.psf import footprint_px
from hilstar.sky.bodies.disc import Disc

# Of the Gaussian and a pixel together, in a radius: below, limb and middle are not apart and disc.frag is off by 1 % at 5.5.
SMALL_SIGMAS = 8.0
NODES_A_SIGMA = 4.0  # along a radius: places in the face's middle are then 0.8 sigma apart
WHOLE = 0.999  # of a pixel: the rest is the sum's error, and the Sun behind it may be a billion times white
MAX_NODES = 64  # for a Gaussian ten times as wide along one axis as along the other
MIN_NODES = 10  # 1e-4 of the light


@dataclass(frozen=True, slots=True)
class Pose:
    """The camera at one moment of a frame: the map (3, 3) of ICRS to image axes, and the moment's share of the light."""

    icrs_to_image: FloatArray
    share: float = 1.0


@dataclass(frozen=True, slots=True)
class View:
    """A camera whose image is spread by a Gaussian of `sigma_px`, at the poses of a frame, and how it turns meanwhile."""

    camera: Camera
    sigma_px: tuple[float, float]
    poses: tuple[Pose, ...]
    shear: Shear | None = None


def disc_lights(disc: Disc, view: View, covers: bool) -> list[ExtendedLight]:
    """A body's disc at all poses, none of it where it does not touch the image; where it `covers`, it hides what is behind."""
    if len(view.poses) == 1:
        pose = view.poses[0]
        return _at_pose(DiscLight(disc, pose.icrs_to_image, view.camera, view.sigma_px, pose.share, covers, view.shear))
    lights: list[ExtendedLight] = []
    if covers:
        # Poses hide together what one in the middle hides: each after the other would hide the light of those before.
        middle = view.poses[len(view.poses) // 2].icrs_to_image
        lights += _at_pose(DiscLight(disc, middle, view.camera, view.sigma_px, 0.0, True, view.shear))
    for pose in view.poses:
        lights += _at_pose(DiscLight(disc, pose.icrs_to_image, view.camera, view.sigma_px, pose.share, False, view.shear))
    return lights


def _at_pose(light: DiscLight) -> list[ExtendedLight]:
    camera = light.camera
    radius_px = float(np.tan(min(light.disc.radius_rad, 1.0)) * camera.focal_length_px)
    if radius_px < SMALL_SIGMAS * max(light.variance_px) ** 0.5:
        nodes = int(np.ceil(NODES_A_SIGMA * radius_px / min(light.variance_px) ** 0.5))
        drawn = _disc_map(light, min(max(MIN_NODES, nodes), MAX_NODES))
        return [] if drawn is None else [drawn]
    return [] if light.region(camera.resolution_px) is None else [light]


def _seen(light: DiscLight, directions: FloatArray) -> FloatArray:
    """Directions (n, 3), ICRS, in image axes while their own pixels are lit."""
    seen = directions @ light.icrs_to_image.T
    if light.shear is None:
        return np.asarray(seen)
    x_px, y_px = light.camera.project(seen)
    late_s = np.nan_to_num(light.shear.late_s(x_px, y_px))
    return np.asarray(seen - late_s[:, None] * np.cross(light.shear.rate_image_rad_s, seen))


def _disc_map(light: DiscLight, nodes: int) -> LightMap | None:
    """The sum of the disc's places, each spread as a star is; its air, if any, is too thin to be seen."""
    disc, camera, reach_px = light.disc, light.camera, footprint_px(light.sigma_px) / 2
    x_px, y_px, law_sr = _places(light, disc, nodes)
    whole = _places(light, replace(disc, law="uniform"), nodes) if light.covers else (x_px, y_px, law_sr)
    if not len(whole[0]):
        return None
    (left, right), (top, bottom) = ((float(part.min()), float(part.max())) for part in whole[:2])
    edges = (left - reach_px, top - reach_px, right + reach_px + 1, bottom + reach_px + 1)
    region = clipped(edges, camera.resolution_px)
    if region is None:
        return None
    cover = None
    if light.covers:
        share = _spread(*whole[:2], whole[2] * _px_per_sr(light), region, light.sigma_px)
        cover = np.where(share > WHOLE, np.float32(1), share)
    image = _spread(x_px, y_px, light.times * disc.normal_e_per_s_sr * law_sr, region, light.sigma_px)
    return LightMap(image, (region[0], region[1]), 1.0, cover, disc.name, lasting=False)


def _places(light: DiscLight, disc: Disc, nodes: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Places of the face that are on any pixel, (n,) each: x and y, and the law's function times their steradian."""
    directions, law_sr = disc.points(nodes)
    x_px, y_px = light.camera.project(_seen(light, directions))
    known = np.isfinite(x_px)
    return (x_px, y_px, law_sr) if known.all() else (x_px[known], y_px[known], law_sr[known])


def _px_per_sr(light: DiscLight) -> float:
    """Pixels to a steradian at the disc's middle: nearly the same over a small disc."""
    u, v, w = light.icrs_to_image @ light.disc.direction
    a, b, c, d = light.camera.slopes(np.array([u / w]), np.array([v / w]))
    return float(np.nan_to_num(a * d - b * c)[0] / abs(w) ** 3)


def _spread(
    x_px: FloatArray, y_px: FloatArray, rates: FloatArray, region: tuple[int, int, int, int], sigma_px: tuple[float, float]
) -> Float32Array:
    """Points' light in the pixels of a region, each point a Gaussian integrated over the pixels."""
    from scipy.special import ndtr  # 0.1 s of every command that draws no disc

    left, top, width, height = region
    across = np.diff(ndtr((left - 0.5 + np.arange(width + 1) - x_px[:, None]) / sigma_px[0]), axis=1)
    down = np.diff(ndtr((top - 0.5 + np.arange(height + 1) - y_px[:, None]) / sigma_px[1]), axis=1)
    return np.asarray((down * rates[:, None]).T @ across, dtype=np.float32)
