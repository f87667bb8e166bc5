"""Linear light in float64: the sky's own over an exposure, and a display's that rounds nothing."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.bench.frame import Bench
from hilstar.rotation import to_matrix
from hilstar.scene.psf import pixel_shares
from hilstar.scene.sprites import Sprites, make_sprites
from hilstar.study.chain.motion import Movement
from hilstar.study.chain.panel import Exposure, Lit
from hilstar.units import NS_PER_S

# Gauss-Legendre over the exposure: 1.02 nodes to a sigma of path and three more are right to 1e-6 of a star in every pixel
# (scene/exposure_motion.py); JITTER's 37 Hz over the longest exposure are well within the minimum.
NODES_PER_SIGMA, MIN_NODES = 1.02, 24
SPRITES_AT_ONCE = 20_000


@dataclass(frozen=True, slots=True)
class Instants:
    """The moments (k,) of an exposure that its light is summed over, ns, and their shares."""

    t_ns: tuple[int, ...]
    share: FloatArray


def instants(bench: Bench, movement: Movement, seen: Exposure) -> Instants:
    """So many that every star's path is exact; one at rest."""
    if not movement.turns:
        return Instants((seen.middle_ns(),), np.ones(1))
    path_rad = math.radians(abs(movement.rate_deg_s)) * seen.length_s
    sigmas = path_rad * bench.camera.scales_px_rad()[1] / min(bench.config.render.sprite_sigma_px)
    nodes, weights = np.polynomial.legendre.leggauss(max(MIN_NODES, math.ceil(NODES_PER_SIGMA * sigmas) + 3))
    t_s = seen.begin_s + seen.length_s * (nodes + 1) / 2
    return Instants(tuple(round(t * NS_PER_S) for t in t_s), weights / 2)


def points(bench: Bench, q_icrs_to_cam: FloatArray) -> Sprites:
    """All of the bench's stars as whole sprites at an attitude."""
    icrs_to_image = bench.camera.cam_to_image @ to_matrix(q_icrs_to_cam)
    return make_sprites(bench.stars, icrs_to_image, bench.camera, bench.renderer.footprint_px)


def sky_light(bench: Bench, movement: Movement, at: Instants) -> FloatArray:
    """The mean light (H, W) that the sky itself has over the exposure, electrons per second."""
    total = np.zeros(bench.camera.resolution_px[::-1])
    for t_ns, share in zip(at.t_ns, at.share, strict=True):
        add_light(total, points(bench, movement.at(t_ns)), bench.config.render.sprite_sigma_px, float(share))
    return total


def linear_light(bench: Bench, sprites: Sprites) -> Lit:
    """The pixels that a frame's sprites light, and their light, rounded to nothing."""
    image = np.zeros(bench.camera.resolution_px[::-1])
    add_light(image, sprites, bench.config.render.sprite_sigma_px)
    place = np.flatnonzero(image)
    return place, image.ravel()[place]


def add_light(image: FloatArray, sprites: Sprites, sigma_px: tuple[float, float], share: float = 1.0) -> None:
    """Add the light of sprites to an image (H, W): `render.reference.linear_image`, all sprites at once."""
    height, width = image.shape
    steps = np.arange(sprites.footprint_px) - (sprites.footprint_px - 1) // 2
    flat = image.reshape(-1)
    for begin in range(0, len(sprites), SPRITES_AT_ONCE):
        part = slice(begin, begin + SPRITES_AT_ONCE)
        columns = sprites.data["pixel"][part, 0, None] + steps
        rows = sprites.data["pixel"][part, 1, None] + steps
        across = pixel_shares(columns - sprites.x_px[part, None], sigma_px[0])
        down = pixel_shares(rows - sprites.y_px[part, None], sigma_px[1])
        across *= (columns >= 0) & (columns < width)
        down *= (rows >= 0) & (rows < height)
        light = share * sprites.data["electrons_per_s"][part].astype(np.float64)
        parts = (light[:, None, None] * down[:, :, None] * across[:, None, :]).ravel()
        places = np.clip(rows, 0, height - 1)[:, :, None] * width + np.clip(columns, 0, width - 1)[:, None, :]
        np.add.at(flat, places.ravel(), parts)
