"""Other methods for a linear image of the same stars: NumPy, and where they are installed numba, GalSim and photutils.

Each gets the places and the light that hilstar has found, so culling and projecting are not in its time; no codes are made.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np
from scipy.special import erf

from hilstar.arrays import Float32Array, FloatArray, IntArray
from hilstar.process.interrupts import held
from hilstar.scene.psf import SQRT2
from hilstar.scene.sprites import Sprites, pack_sprites

INSTALL = "pip install 'hilstar[benchmark]'"
FWHM_PER_SIGMA = 2 * math.sqrt(2 * math.log(2))
Sigma = tuple[float, float]
_ONE = np.ones(1)
FIRST = pack_sprites(_ONE, _ONE, _ONE, np.zeros(1, dtype=np.intp), (8, 8), 4)
Draw = Callable[[Sprites, Sigma, tuple[int, int]], Float32Array]


@dataclass(frozen=True, slots=True)
class OtherMethod:
    """A method for a linear image: `draw` takes sprites, their sigma in px and the image's (height, width)."""

    name: str
    does: str
    draw: Draw


def other_methods() -> tuple[list[OtherMethod], dict[str, str]]:
    """The methods that are installed here, imported and compiled, and by name what to install for each of the others."""
    found, missing = [], {}
    for name, does, make in METHODS:
        try:
            other = OtherMethod(name, does, make())
        except ImportError as error:
            missing[name] = f"not installed ({error}): {INSTALL}"
            continue
        with held():  # numba compiles, and LLVM calls Python back meanwhile: an exception there is printed, and lost
            other.draw(FIRST, (0.85, 0.85), (8, 8))
        found.append(other)
    return found, missing


def numpy_linear(sprites: Sprites, sigma_px: Sigma, shape: tuple[int, int]) -> Float32Array:
    """The baseline: separable erf differences and np.add.at. float32 (height, width), electrons per second."""
    image = np.zeros(shape, np.float32)
    steps = np.arange(sprites.footprint_px) - (sprites.footprint_px - 1) // 2
    columns = sprites.data["pixel"][:, :1] + steps
    rows = sprites.data["pixel"][:, 1:] + steps
    share_y = _shares(rows, sprites.y_px, sigma_px[1]) * sprites.data["electrons_per_s"][:, None]
    light = (share_y[:, :, None] * _shares(columns, sprites.x_px, sigma_px[0])[:, None, :]).astype(np.float32)
    inside = ((rows >= 0) & (rows < shape[0]))[:, :, None] & ((columns >= 0) & (columns < shape[1]))[:, None, :]
    place = rows[:, :, None] * shape[1] + columns[:, None, :]
    np.add.at(image.ravel(), place[inside], light[inside])
    return image


def _shares(pixels: IntArray, centre_px: FloatArray, sigma_px: float) -> FloatArray:
    edges = np.concatenate([pixels - 0.5, pixels[:, -1:] + 0.5], axis=1)
    return np.asarray(0.5 * np.diff(erf((edges - centre_px[:, None]) / (sigma_px * SQRT2)), axis=1))


def _add_stars(image: Any, first: Any, centre_px: Any, electrons_per_s: Any, scale: Any, size: int) -> None:
    """The plain loop that numba compiles: `first` (n, 2) is each footprint's first pixel, `scale` is 1 / (sigma sqrt 2)."""
    height, width = image.shape
    share = np.empty((2, size))
    for k in range(len(first)):
        for axis in range(2):
            before = math.erf((first[k, axis] - 0.5 - centre_px[axis, k]) * scale[axis])
            for i in range(size):
                after = math.erf((first[k, axis] + i + 0.5 - centre_px[axis, k]) * scale[axis])
                share[axis, i] = 0.5 * (after - before)
                before = after
        for j in range(max(0, -first[k, 1]), min(size, height - first[k, 1])):
            row = share[1, j] * electrons_per_s[k]
            for i in range(max(0, -first[k, 0]), min(size, width - first[k, 0])):
                image[first[k, 1] + j, first[k, 0] + i] += row * share[0, i]


def _make_numba() -> Draw:
    add_stars = import_module("numba").njit(_add_stars)

    def draw(sprites: Sprites, sigma_px: Sigma, shape: tuple[int, int]) -> Float32Array:
        image = np.zeros(shape, np.float32)
        first = sprites.data["pixel"] - (sprites.footprint_px - 1) // 2
        centre_px = np.stack([sprites.x_px, sprites.y_px])
        light = np.ascontiguousarray(sprites.data["electrons_per_s"])
        add_stars(image, first, centre_px, light, 1 / (np.array(sigma_px) * SQRT2), sprites.footprint_px)
        return image

    return draw


def _stamps(sprites: Sprites) -> Iterator[tuple[float, float, float, int, int]]:
    """Each star's x, y, light, and its footprint's first column and row."""
    first = (sprites.data["pixel"] - (sprites.footprint_px - 1) // 2).tolist()
    light = sprites.data["electrons_per_s"].tolist()
    for (column, row), x, y, electrons in zip(first, sprites.x_px.tolist(), sprites.y_px.tolist(), light, strict=True):
        yield x, y, electrons, column, row


def _make_galsim() -> Draw:
    galsim = import_module("galsim")

    def draw(sprites: Sprites, sigma_px: Sigma, shape: tuple[int, int]) -> Float32Array:
        image = galsim.ImageF(np.zeros(shape, np.float32), xmin=0, ymin=0)
        profile = galsim.Gaussian(sigma=1.0).transform(sigma_px[0], 0, 0, sigma_px[1])
        last = sprites.footprint_px - 1
        for x, y, electrons, column, row in _stamps(sprites):
            bounds = galsim.BoundsI(column, column + last, row, row + last) & image.bounds
            star = profile.withFlux(electrons)
            star.drawImage(image=image[bounds], scale=1.0, center=galsim.PositionD(x, y), add_to_image=True)
        return np.asarray(image.array)

    return draw


def _make_photutils() -> Draw:
    make_model_image = import_module("photutils.datasets").make_model_image
    model = import_module("photutils.psf").GaussianPRF
    table = import_module("astropy.table").QTable

    def draw(sprites: Sprites, sigma_px: Sigma, shape: tuple[int, int]) -> Float32Array:
        stars = table({"x_0": sprites.x_px, "y_0": sprites.y_px, "flux": sprites.data["electrons_per_s"].astype(float)})
        fwhm = {"x_fwhm": sigma_px[0] * FWHM_PER_SIGMA, "y_fwhm": sigma_px[1] * FWHM_PER_SIGMA}
        side = sprites.footprint_px | 1
        return np.asarray(make_model_image(shape, model(**fwhm), stars, model_shape=(side, side)), dtype=np.float32)

    return draw


METHODS: tuple[tuple[str, str, Callable[[], Draw]], ...] = (
    ("numpy", "separable erf differences and np.add.at; our stamps", lambda: numpy_linear),
    ("numba", "the same as a compiled loop on one core, compiled before; our stamps", _make_numba),
    ("galsim", "drawImage of a Gaussian convolved with the pixel, by FFT; our stamps", _make_galsim),
    ("photutils", "make_model_image of GaussianPRF, exact in the pixel; stamps of the next odd side", _make_photutils),
)
