"""A tracker's frame as a picture for people: light above the sky, with a disc for each star.

Saturated pixels cannot tell bright stars apart: a disc does. What is wide enough to be seen by
itself, such as the Moon or the trail of a star, has none.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from hilstar.basics.arrays import BoolArray, FloatArray, IntArray
from hilstar.basics.units import MAD_TO_SIGMA

DigitalNumbers = npt.NDArray[np.uint16]

# side of the square over which a star's light is summed: where the middle is full, the wings still
# grow
BOX_PX = 5
MAX_RADIUS_PX = 8  # radius of the brightest star's disc
# A disc's radius goes with this power of the star's share of the brightest: enough for a sum that
# saturates, in which five magnitudes are only a factor of ten.
RADIUS_POWER = 0.77
STAR_SIGMA = 8.0  # a box sum this many sigmas above its surroundings is a star
PIXEL_GREY = 0.7  # the brightest grey of a pixel that no disc covers
MIN_NOISE_DN = 1.0
MIN_TOP_SIGMA = 50.0  # the stretch goes up to this at least: noise alone stays dark

MAX_BLOCK_PX, MIN_BLOCK_PX, BLOCKS_A_SIDE = 64, 8, 16
# The sky starts from this share of the blocks, the darkest, which a body that covers less than the
# rest does not touch.
DARKEST_SHARE = 0.5
SKY_ROUNDS = 10
SKY_SIGMA = 4.0  # a block farther from the surface is no sky

RING_PX = 25  # side of the square whose median is a star's surroundings
# a peak whose light has this share of its height as far off as MAX_RADIUS_PX is no star's
WIDE_SHARE = 0.5


class Sky(NamedTuple):
    """The level (height, width) of a frame between its stars, DN, and the noise of a pixel, DN."""

    level_dn: FloatArray
    noise_dn: float


class _Blocks(NamedTuple):
    """Medians and noise (n,) of an image's blocks, and their middles (n,), -1 to 1 over its
    sides.
    """

    level: FloatArray
    noise: FloatArray
    across: FloatArray
    down: FloatArray


def exposure_picture(dn: DigitalNumbers, full_dn: int) -> npt.NDArray[np.uint8]:
    """Greys (height, width) of a frame in DN: asinh of light above the sky, a disc for each star.

    The sky is a smooth surface over the frame. A pixel at `full_dn`, where the detector saturates,
    is white.
    """
    sky = sky_under(dn)
    light = dn.astype(np.float64) - sky.level_dn
    box_sum = ndimage.uniform_filter(light, BOX_PX) * BOX_PX**2
    box_noise = sky.noise_dn * BOX_PX
    picture = PIXEL_GREY * _stretched(light, sky.noise_dn)
    picture[dn >= full_dn] = 1.0
    row, column = _star_places(box_sum, box_noise)
    if len(row):
        flux = box_sum[row, column]
        radius = np.rint(MAX_RADIUS_PX * (flux / flux.max()) ** RADIUS_POWER)
        grey = _stretched(box_sum, box_noise)[row, column]
        discs = _discs(dn.shape, (row, column), radius, grey)
        picture = np.where(discs > 0, discs, picture)
    return np.rint(255 * np.clip(picture, 0, 1)).astype(np.uint8)


def sky_under(dn: DigitalNumbers) -> Sky:
    """The sky of a frame (height, width): a surface of second degree through its dark blocks.

    It takes a gradient of stray light away, and leaves what has a shape: a body, a galaxy, a limb.
    """
    blocks = _blocks(dn)
    noise_dn = max(float(np.median(blocks.noise)), MIN_NOISE_DN)
    chosen = blocks.level <= np.quantile(blocks.level, DARKEST_SHARE)
    terms = _terms(blocks.across, blocks.down)
    shape = _fitted(terms, blocks.level, chosen)
    for _ in range(SKY_ROUNDS):
        off = np.abs(blocks.level - terms @ shape)
        spread = MAD_TO_SIGMA * float(np.median(off[chosen]))
        near = off <= SKY_SIGMA * max(spread, noise_dn / 2)
        if np.array_equal(near, chosen) or not near.any():
            break
        chosen = near
        shape = _fitted(terms, blocks.level, chosen)
    height, width = dn.shape
    across = _middles(width, 1, width)
    down = _middles(height, 1, height)
    rows = [_terms(across, np.full(width, row)) @ shape for row in down]
    return Sky(np.array(rows), noise_dn)


def _blocks(dn: DigitalNumbers) -> _Blocks:
    """The medians and the noise of square blocks of a frame."""
    height, width = dn.shape
    side = int(np.clip(min(height, width) // BLOCKS_A_SIDE, MIN_BLOCK_PX, MAX_BLOCK_PX))
    rows = max(height // side, 1)
    columns = max(width // side, 1)
    high = height // rows
    wide = width // columns
    whole = dn[: rows * high, : columns * wide].astype(np.float64)
    by_block = whole.reshape(rows, high, columns, wide).swapaxes(1, 2)
    pixels = by_block.reshape(rows * columns, -1)
    level = np.median(pixels, axis=1)
    deviation = np.abs(pixels - level[:, None])
    noise = MAD_TO_SIGMA * np.median(deviation, axis=1)
    row, column = np.indices((rows, columns)).reshape(2, -1)
    across = _middles(columns, wide, width)[column]
    down = _middles(rows, high, height)[row]
    return _Blocks(level, noise, across, down)


def _middles(count: int, step_px: int, size_px: int) -> FloatArray:
    """The middles (count,) of parts of `step_px` along a side of `size_px`, -1 and 1 at its
    edges.
    """
    return np.asarray((2 * np.arange(count) + 1) * step_px / size_px - 1)


def _terms(across: FloatArray, down: FloatArray) -> FloatArray:
    """The terms (n, 6) of a surface of second degree."""
    ones = np.ones_like(across)
    return np.column_stack([ones, across, down, across**2, across * down, down**2])


def _fitted(terms: FloatArray, level: FloatArray, chosen: BoolArray) -> FloatArray:
    """The surface's coefficients (6,) by the chosen blocks; with few, the smallest that fit."""
    shape, *_ = np.linalg.lstsq(terms[chosen], level[chosen], rcond=1e-6)
    return np.asarray(shape)


def _stretched(light: FloatArray, noise: float) -> FloatArray:
    """Greys, 1 for the brightest, of light: an asinh of it in units of its noise."""
    top = max(float(light.max()) / noise, MIN_TOP_SIGMA)
    in_noise = np.maximum(light, 0) / noise
    return np.asarray(np.arcsinh(in_noise) / np.arcsinh(top))


def _star_places(box_sum: FloatArray, box_noise: float) -> tuple[IntArray, IntArray]:
    """Rows and columns (n,) of stars: peaks above their surroundings that end within a disc."""
    peak = box_sum == ndimage.maximum_filter(box_sum, BOX_PX)
    peak &= box_sum > STAR_SIGMA * box_noise
    row, column = np.nonzero(peak)
    star = np.zeros(len(row), dtype=bool)
    around = np.pad(box_sum, RING_PX // 2)
    for k, (y, x) in enumerate(zip(row.tolist(), column.tolist(), strict=True)):
        patch = around[y : y + RING_PX, x : x + RING_PX]
        height = box_sum[y, x] - np.median(patch)
        star[k] = height > STAR_SIGMA * box_noise and not _is_wide(patch)
    return row[star], column[star]


def _is_wide(patch: FloatArray) -> bool:
    """Whether the light in the middle of a patch reaches beyond the largest disc."""
    middle = RING_PX // 2
    inner = slice(middle - MAX_RADIUS_PX, middle + MAX_RADIUS_PX + 1)
    near = patch[inner, inner]
    peak = near[MAX_RADIUS_PX, MAX_RADIUS_PX]
    bright, _ = ndimage.label(near > WIDE_SHARE * peak)
    star = bright == bright[MAX_RADIUS_PX, MAX_RADIUS_PX]
    edge = star[0].any() or star[-1].any() or star[:, 0].any() or star[:, -1].any()
    return bool(edge)


def _discs(
    shape: tuple[int, ...],
    place: tuple[IntArray, IntArray],
    radius_px: FloatArray,
    grey: FloatArray,
) -> FloatArray:
    """Discs about places (rows, columns) on black (height, width); of two the brighter shows."""
    picture = np.zeros(shape)
    height, width = shape
    rows, columns = place
    reach = np.arange(-MAX_RADIUS_PX, MAX_RADIUS_PX + 1)
    for down in reach:
        for across in reach:
            inside = radius_px >= np.hypot(down, across)
            row = rows[inside] + down
            column = columns[inside] + across
            on = (row >= 0) & (row < height) & (column >= 0) & (column < width)
            np.maximum.at(picture, (row[on], column[on]), grey[inside][on])
    return picture
