"""One star at every sub-pixel phase through a quantisation method: the errors of its flux and
centroid.
"""

import math
from dataclasses import dataclass, replace

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
    middles = (steps + 0.5) * tile
    first_x, first_y = first
    columns_px = middles + (steps + first_x) / count - 0.5
    rows_px = middles + (steps + first_y) / count - 0.5
    grid_x_px, grid_y_px = np.meshgrid(columns_px, rows_px)
    flux = np.full(count**2, WHITE / psf.peak_share)
    number = np.arange(count**2)
    size_px = count * tile, count * tile
    sprites = pack_sprites(
        grid_x_px.ravel(), grid_y_px.ravel(), flux, number, size_px, psf.footprint_px
    )
    return sprites, tile


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
    tile = tile_px or sprites.footprint_px + MARGIN_PX
    steps = np.arange(sprites.footprint_px) - (sprites.footprint_px - 1) // 2
    x_px, y_px = line_places(sprites)
    pixel = sprites.data["pixel"]
    columns = pixel[:count, 0, None] + steps
    rows = pixel[::count, 1, None] + steps
    away_x = (columns - x_px[:, None]).ravel()
    away_y = (rows - y_px[:, None]).ravel()
    shares = psf.shares(away_x[None], away_y[:, None])
    e_per_s = float(sprites.data["electrons_per_s"][0])
    image = np.zeros((count * tile, count * tile))
    image[np.ix_(rows.ravel(), columns.ravel())] = e_per_s * shares
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
    return Errors(_rms(flux), float(flux.max()), _rms(off), float(off.max()))


def _rms(errors: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(errors))))


def _sums(image: FloatArray, tile: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Light and centroid (x, y), px, of each tile; the centroid is 0 where there is no light."""
    count = len(image) // tile
    tiles = image.reshape(count, tile, count, tile).transpose(0, 2, 1, 3)
    light = tiles.sum(axis=(2, 3))
    pixels = np.arange(tile)
    divisor = np.where(light > 0, light, 1.0)
    x_px = tiles.sum(axis=2) @ pixels / divisor
    y_px = tiles.sum(axis=3) @ pixels / divisor
    return light, x_px, y_px


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
    total = np.zeros(linear.shape)
    for number in range(exposed.stop):
        levels = quantiser.draw(UnquantisedFrame(sprites, lambda: linear, lambda: linear, number))
        if number in exposed:
            total += shown_light(levels, panel)
    return total / len(exposed)
