"""Which stars of a frame need more light than one pixel of the monitor has."""

from __future__ import annotations

import numpy as np

from hilstar.arrays import BoolArray, Float32Array, FloatArray, IntArray
from hilstar.scene.psf import peak_share, pixel_shares
from hilstar.scene.sprites import Sprites

# A star over white by no more than this is not called clipped: flux and white pass through float32.
CLIP_TOLERANCE = 1e-6
# Of the sprites that may clip with the light of others, only this many are tested, the brightest: the work is bounded.
MAX_DOUBTFUL = 512
FEW_PAIRS = 4096  # of pixels and sprites near them: so many are asked all together, sooner than they are sorted


def clipped_sprites(
    sprites: Sprites,
    sigma_px: tuple[float, float],
    flux_at_white_e_per_s: float,
    resolution_px: tuple[int, int],
    uniformity: Float32Array | None = None,
    darkest: float = 1.0,
) -> IntArray:
    """Positions of the sprites whose brightest pixel lies on the image and, neighbours' light included, is over white.

    White is `flux_at_white_e_per_s` times a pixel's `uniformity` (height, width), whose minimum is `darkest`.

    Only stars that alone reach half of white in a pixel are tested: two fainter ones on one pixel are not reported.
    """
    bright_e_per_s = 0.5 * flux_at_white_e_per_s * darkest / peak_share(sigma_px)
    if sprites.per_star * sprites.data["electrons_per_s"].max(initial=0.0) <= bright_e_per_s:
        return np.empty(0, dtype=np.intp)  # most frames: no star is that bright, however its light is divided
    bright = (_star_rates(sprites) > bright_e_per_s).nonzero()[0]
    x, y = np.rint(sprites.x_px[bright]).astype(int), np.rint(sprites.y_px[bright]).astype(int)
    inside = (x >= 0) & (x < resolution_px[0]) & (y >= 0) & (y < resolution_px[1])
    bright, x, y = bright[inside], x[inside], y[inside]
    limit = np.full(len(bright), flux_at_white_e_per_s * (1 + CLIP_TOLERANCE))
    if uniformity is not None:
        limit *= uniformity[y, x]
    own = sprites.data["electrons_per_s"][bright] * _share(x - sprites.x_px[bright], y - sprites.y_px[bright], sigma_px)
    over = own > limit
    doubtful = (~over).nonzero()[0]
    if len(doubtful) > MAX_DOUBTFUL:
        doubtful = doubtful[np.argpartition(-own[doubtful], MAX_DOUBTFUL)[:MAX_DOUBTFUL]]
    if len(doubtful):
        over[doubtful] = _light_at(sprites, x[doubtful], y[doubtful], sigma_px) > limit[doubtful]
    return np.asarray(bright[over], dtype=np.intp)


def _star_rates(sprites: Sprites) -> Float32Array | FloatArray:
    """The rate of each sprite's whole star, electrons per second (n,)."""
    rates: Float32Array = sprites.data["electrons_per_s"]
    if sprites.per_star == 1:
        return rates
    _, star = np.unique(sprites.star, return_inverse=True)
    return np.asarray(np.bincount(star, rates)[star], dtype=np.float64)


def _share(offset_x: FloatArray, offset_y: FloatArray, sigma_px: tuple[float, float]) -> FloatArray:
    if sigma_px[0] == sigma_px[1]:
        both = pixel_shares(np.stack([offset_x, offset_y]), sigma_px[0])
        return np.asarray(both[0] * both[1])
    return pixel_shares(offset_x, sigma_px[0]) * pixel_shares(offset_y, sigma_px[1])


def _light_at(sprites: Sprites, x: IntArray, y: IntArray, sigma_px: tuple[float, float]) -> FloatArray:
    """Light of all sprites together in the pixels at x, y (k,), electrons per second (k,)."""
    close = _close_to(sprites, x, y)
    reach = sprites.footprint_px / 2
    if len(x) * len(close) <= FEW_PAIRS:
        offset_x, offset_y = (places[close] - wanted[:, None] for places, wanted in ((sprites.x_px, x), (sprites.y_px, y)))
        share = _share(offset_x, offset_y, sigma_px)
        share[np.maximum(np.abs(offset_x), np.abs(offset_y)) > reach] = 0.0
        return np.asarray(share @ sprites.data["electrons_per_s"][close].astype(np.float64))
    order = close[np.argsort(sprites.x_px[close])]
    rising_px = sprites.x_px[order]
    first = np.searchsorted(rising_px, x - reach)
    count = np.searchsorted(rising_px, x + reach, side="right") - first
    pixel = np.repeat(np.arange(len(x)), count)
    other = order[np.arange(len(pixel)) + np.repeat(first - (np.cumsum(count) - count), count)]
    offset_y = sprites.y_px[other] - y[pixel]
    near = np.abs(offset_y) <= reach
    pixel, other, offset_y = pixel[near], other[near], offset_y[near]
    share = _share(sprites.x_px[other] - x[pixel], offset_y, sigma_px)
    return np.asarray(np.bincount(pixel, sprites.data["electrons_per_s"][other] * share, minlength=len(x)), dtype=np.float64)


def _close_to(sprites: Sprites, x: IntArray, y: IntArray) -> IntArray:
    """Positions of the sprites whose footprints can reach one of the columns `x` and rows `y` (k,), and some more."""
    pixel = sprites.data["pixel"]
    return np.flatnonzero(_reach(pixel[:, 0], x, sprites.footprint_px) & _reach(pixel[:, 1], y, sprites.footprint_px))


def _reach(pixel: IntArray, wanted: IntArray, size_px: int) -> BoolArray:
    """Which pixels (n,) of an axis are within a footprint of one of the `wanted` (k,)."""
    near = np.zeros(int(wanted.max(initial=0)) + 2 * size_px + 2, dtype=np.bool_)
    for place in set(wanted.tolist()):
        near[place : place + 2 * size_px + 1] = True
    return near.take(pixel + size_px, mode="clip")
