"""One star at every sub-pixel phase through a quantisation method: the errors of its flux and
centroid.
"""

import math
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np

from hilstar.basics.arrays import Float32Array, FloatArray
from hilstar.basics.units import flux_ratio, magnitude
from hilstar.display.balance import Balance
from hilstar.display.panel import Panel
from hilstar.display.quantise import Quantiser, UnquantisedFrame, shown_light
from hilstar.optics.psf import GaussianPsf, Psf
from hilstar.optics.sprites import FrameLight, pack_sprites

USUAL_PSF = GaussianPsf((0.85, 0.85))
WHITE = 1.0
MARGIN_PX = 2  # dark pixels between two stars
# frames of `temporal` before an exposure: the first of a sequence is no special case
FRAMES_BEFORE = 2
MIDDLES = (0.5, 0.5)
# no star is another's mirror image: with MIDDLES only one of eight is like no other
UNLIKE = (0.25, 0.375)


@dataclass(frozen=True, slots=True)
class Errors:
    """Over all phases: rms and largest flux error, mag, and centroid error, px; infinite where a
    star showed nothing.
    """

    flux_rms_mag: float
    flux_max_mag: float
    centroid_rms_px: float
    centroid_max_px: float


def phase_grid(
    count: int, psf: Psf = USUAL_PSF, first: tuple[float, float] = MIDDLES
) -> tuple[FrameLight, int]:
    """count^2 stars, one in each tile at its own phase, as bright as white when centred on a pixel;
    and the tile's side, px.

    The first phase along x and y is `first`, in steps of 1 / count px.
    """
    tile = psf.footprint_px + MARGIN_PX
    steps = np.arange(count)
    places = ((steps + 0.5) * tile + (steps + start) / count - 0.5 for start in first)
    x_px, y_px = (axis.ravel() for axis in np.meshgrid(*places))
    flux = np.full(count**2, WHITE / psf.peak_share)
    size_px = count * tile, count * tile
    return pack_sprites(x_px, y_px, flux, np.arange(count**2), size_px, psf.footprint_px), tile


def line_places(sprites: FrameLight) -> tuple[FloatArray, FloatArray]:
    """Where a `phase_grid` has the stars of each column of tiles, x (count,) in px, and of each
    row, y.
    """
    count = math.isqrt(len(sprites))
    return sprites.x_px[:count], sprites.y_px[::count]


def phase_image(sprites: FrameLight, psf: Psf, tile_px: int | None = None) -> FloatArray:
    """The light (h, w) of the stars of a `phase_grid`: all are as bright, and stand in columns
    and rows of tiles of `tile_px`, by default those of `phase_grid`.
    """
    count = math.isqrt(len(sprites))
    if tile_px is None:
        tile = sprites.footprint_px + MARGIN_PX
    else:
        tile = tile_px
    at = np.arange(sprites.footprint_px) - (sprites.footprint_px - 1) // 2
    pixels = []
    offsets = []
    for axis, places in enumerate(line_places(sprites)):
        line = sprites.data["pixel"][:, axis][:: count if axis else 1][:count, None] + at
        pixels.append(line.ravel())
        offsets.append((line - places[:, None]).ravel())
    image = np.zeros((count * tile,) * 2)
    shares = psf.shares(offsets[0][None], offsets[1][:, None])
    image[np.ix_(pixels[1], pixels[0])] = float(sprites.data["electrons_per_s"][0]) * shares
    return image


def fainter(sprites: FrameLight, mag: float | FloatArray) -> FrameLight:
    """The same stars, `mag` magnitudes fainter: all, or each by its own (n,)."""
    data = sprites.data.copy()
    data["electrons_per_s"] *= flux_ratio(mag)
    return replace(sprites, data=data)


def measure(wanted: FloatArray, shown: FloatArray, tile: int) -> Errors:
    """The errors over all tiles of two images with one star in each tile."""
    light, x_px, y_px = _sums(wanted, tile)
    lit, lit_x_px, lit_y_px = _sums(shown, tile)
    flux = np.abs(magnitude(lit / light))
    off = np.where(lit > 0, np.hypot(lit_x_px - x_px, lit_y_px - y_px), np.inf)
    rms = (float(np.sqrt(np.mean(np.square(error)))) for error in (flux, off))
    return Errors(next(rms), float(flux.max()), next(rms), float(off.max()))


def _sums(image: FloatArray, tile: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Light and centroid (x, y), px, of each tile; the centroid is 0 where there is no light."""
    count = len(image) // tile
    tiles = image.reshape(count, tile, count, tile).transpose(0, 2, 1, 3)
    light = tiles.sum(axis=(2, 3))
    at = np.arange(tile)
    divisor = np.where(light > 0, light, 1.0)
    return light, tiles.sum(axis=2) @ at / divisor, tiles.sum(axis=3) @ at / divisor


def shown_by(
    kind: type[Quantiser],
    exposure_frames: int,
    panel: Panel,
    linear: Float32Array,
    sprites: FrameLight,
    balance: Balance,
) -> FloatArray:
    """The light (h, w) that a kind of quantiser shows for a linear image, of several frames their
    mean over `exposure_frames`.

    `balance` is that of `exact`, with the sprites' PSF.
    """
    quantiser = kind(panel, linear.shape[::-1], balance.psf, balance.seen)
    exposed = quantiser.exposure(FRAMES_BEFORE, exposure_frames)
    levels = (
        quantiser.draw(UnquantisedFrame(sprites, lambda: linear, lambda: linear, number))
        for number in range(exposed.stop)
    )
    shown = (
        shown_light(frame_levels, panel) for frame_levels in islice(levels, exposed.start, None)
    )
    return np.asarray(sum(shown) / len(exposed))
