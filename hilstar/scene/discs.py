"""Discs of bodies as light for the renderer: a small one as a map of its spread places, a larger one ray by ray."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hilstar.arrays import Float32Array, FloatArray
from hilstar.scene.camera import Camera
from hilstar.scene.extended import DiscLight, ExtendedLight, LightMap, clipped
from hilstar.scene.psf import footprint_px
from hilstar.sky.bodies.disc import Disc

# Of the Gaussian and a pixel together, in a radius: below, limb and middle are not apart and disc.frag is off by 1 % at 5.5.
SMALL_SIGMAS = 8.0
NODES_A_SIGMA = 4.0  # along a radius: places in the face's middle are then 0.8 sigma apart
MIN_NODES = 10  # 1e-4 of the light


def disc_light(disc: Disc, icrs_to_image: FloatArray, camera: Camera, sigma_px: tuple[float, float]) -> ExtendedLight | None:
    """A body's disc spread by a Gaussian of `sigma_px`; None where it does not touch the image."""
    light = DiscLight(disc, icrs_to_image, camera, sigma_px)
    radius_px = np.tan(min(disc.radius_rad, 1.0)) * camera.focal_length_px
    sigmas = float(radius_px) / min(light.variance_px) ** 0.5
    if sigmas < SMALL_SIGMAS:
        return _disc_map(light, max(MIN_NODES, int(np.ceil(NODES_A_SIGMA * sigmas))))
    return None if light.region(camera.resolution_px) is None else light


def _disc_map(light: DiscLight, nodes: int) -> LightMap | None:
    """The sum of the disc's places, each spread as a star is; its air, if any, is too thin to be seen."""
    disc, reach_px = light.disc, footprint_px(light.sigma_px) / 2
    face = replace(disc, law="uniform")
    directions, whole_sr = face.points(nodes)
    x_px, y_px = light.camera.project(directions @ light.icrs_to_image.T)
    known = np.isfinite(x_px)
    if not known.any():
        return None
    x_px, y_px, whole_sr = x_px[known], y_px[known], whole_sr[known]
    edges = (x_px.min() - reach_px, y_px.min() - reach_px, x_px.max() + reach_px + 1, y_px.max() + reach_px + 1)
    region = clipped(edges, light.camera.resolution_px)
    if region is None:
        return None
    cover = _spread(x_px, y_px, whole_sr * _px_per_sr(light), region, light.sigma_px)
    directions, law_sr = disc.points(nodes)
    x_px, y_px = light.camera.project(directions @ light.icrs_to_image.T)
    known = np.isfinite(x_px)
    rates = disc.normal_e_per_s_sr * law_sr[known]
    image = _spread(x_px[known], y_px[known], rates, region, light.sigma_px)
    return LightMap(image, (region[0], region[1]), 1.0, np.minimum(cover, np.float32(1)))


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
