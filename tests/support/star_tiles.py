"""A star at each of SIDE^2 sub-pixel phases, each in a tile of its own."""

from __future__ import annotations

import numpy as np

from hilstar.optics.psf import GaussianPsf
from hilstar.optics.sprites import FrameLight, pack_sprites

WHITE = 1e6
SIGMA = (0.85, 0.85)
TILE, SIDE = 22, 12  # px of a star's own, stars along a side
SIZE = (TILE * SIDE, TILE * SIDE)


def flux_of(mag: float) -> np.ndarray:
    """The light of a star so far under white."""
    return WHITE * 10 ** (-0.4 * np.asarray(mag)) / GaussianPsf(SIGMA).peak_share


def places(shift_x: float = 0.0, shift_y: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Where the stars are, moved by a shift, px (n,)."""
    middle = (np.arange(SIDE) + 0.5) * TILE - 0.5 + (np.arange(SIDE) + 0.5) / SIDE - 0.5
    x, y = (axis.ravel() for axis in np.meshgrid(middle, middle))
    return x + shift_x, y + shift_y


def stars(x, y, flux, numbers=None, size=SIZE) -> FrameLight:
    """Stars at those places, by their numbers."""
    numbers = np.arange(len(x)) if numbers is None else numbers
    fluxes = np.broadcast_to(np.asarray(flux, float), x.shape)
    return pack_sprites(x, y, fluxes, numbers, size, GaussianPsf(SIGMA).footprint_px)


def tiles(image: np.ndarray) -> np.ndarray:
    """An image by its stars (stars, TILE - 1, TILE - 1)."""
    by_star = image.reshape(SIDE, TILE, SIDE, TILE).transpose(0, 2, 1, 3)
    return np.asarray(by_star.reshape(-1, TILE, TILE)[:, :-1, :-1], float)
