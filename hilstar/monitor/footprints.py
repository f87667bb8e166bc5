"""The footprints of all stars as arrays: each pixel's light, and the star that it belongs to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hilstar.arrays import Float32Array, FloatArray
from hilstar.errors import InputError
from hilstar.monitor.pixel_order import PHASES, PixelOrder
from hilstar.scene.sprites import Sprites

PlaceArray = npt.NDArray[np.int32]  # half the memory of intp: these arrays are the method's largest


@dataclass(frozen=True, slots=True)
class Footprints:
    """Pixels of n stars, nearest first, each (pixels, n); a pixel of several stars belongs to the brightest in it.

    `light` is the whole light in the pixel, electrons per second, 0 where it is another star's or off the image, and
    `place` its place in the flat image, there one past the end. `offset_px` (2, pixels, n) are x and y in whole pixels from
    the star's own, `fraction_px` (2, n) is the star's centre from there. `rate_e_per_s` (n,) is the star's own light.
    """

    light: Float32Array
    place: PlaceArray
    offset_px: Float32Array
    fraction_px: Float32Array
    rate_e_per_s: Float32Array


class FootprintMap:
    """Finds the footprints of sprites of one sigma on one image."""

    def __init__(self, resolution_px: tuple[int, int], sigma_px: tuple[float, float]) -> None:
        self.resolution_px = resolution_px
        self.pixels = resolution_px[0] * resolution_px[1]
        self._sigma_px = sigma_px
        self.order = PixelOrder(sigma_px)
        self._last_entry = np.empty(self.pixels + 1, dtype=np.int32)
        self._contested = np.zeros(self.pixels + 1, dtype=np.bool_)

    def find(self, sprites: Sprites) -> Footprints:
        """The footprints of `sprites`. Raises InputError for sprites of another sigma's footprint."""
        order = self.order
        if sprites.footprint_px != order.size:
            raise InputError(f"sprites of {sprites.footprint_px} px where the sigma needs {order.size} px")
        data, count = sprites.data, len(sprites)
        fraction = data["fraction_px"].astype(np.float64).T
        cell = np.clip((fraction + order.bias) * PHASES, 0, PHASES - 1).astype(np.intp)
        row, column = (table.take(cell[1] * PHASES + cell[0], axis=1) for table in (order.row, order.column))
        share_x, share_y = (self._shares(f, s) for f, s in zip(fraction, self._sigma_px, strict=True))
        share_y *= data["electrons_per_s"]
        star = np.arange(count, dtype=np.int32)
        light = share_x.astype(np.float32).take(column * count + star)
        light *= share_y.astype(np.float32).take(row * count + star)
        row += order.first
        column += order.first
        place = self._places(data["pixel"], row, column)
        light[place == self.pixels] = 0.0
        if len(sprites):
            self._settle(light, place)
        offset = np.stack([column, row]).astype(np.float32)
        return Footprints(light, place, offset, data["fraction_px"].T, data["electrons_per_s"])

    def _shares(self, fraction_px: FloatArray, sigma_px: float) -> FloatArray:
        """A star's share in each column (or row) of its footprint, (size, n)."""
        from scipy.special import ndtr

        edges = np.arange(self.order.size + 1)[:, None] + (self.order.first - 0.5) - fraction_px
        return np.diff(ndtr(edges / sigma_px), axis=0)

    def _places(self, pixel: PlaceArray, row: PlaceArray, column: PlaceArray) -> PlaceArray:
        width, height = self.resolution_px
        x, y = pixel[:, 0].astype(np.int32), pixel[:, 1].astype(np.int32)
        place = row * width + column
        place += y * width + x
        reach = self.order.size
        cut = np.flatnonzero((x < reach) | (x >= width - reach) | (y < reach) | (y >= height - reach))
        if len(cut):
            at_x, at_y = x[cut] + column[:, cut], y[cut] + row[:, cut]
            inside = (at_x >= 0) & (at_x < width) & (at_y >= 0) & (at_y < height)
            place[:, cut] = np.where(inside, place[:, cut], self.pixels)
        return place

    def _settle(self, light: Float32Array, place: PlaceArray) -> None:
        """Assign each pixel that several stars touch to the brightest there, with the light of all."""
        flat_light, flat_place = light.ravel(), place.ravel()
        entry = np.arange(flat_place.size, dtype=np.int32)
        self._last_entry[flat_place] = entry  # the last of several stays
        beaten = (self._last_entry[flat_place] != entry) & (flat_place != self.pixels)
        if not beaten.any():
            return
        contested = flat_place[beaten]
        self._contested[contested] = True
        rivals = np.flatnonzero(self._contested[flat_place])
        self._contested[contested] = False
        _, group = np.unique(flat_place[rivals], return_inverse=True)
        total = np.bincount(group, flat_light[rivals])
        by_light = np.lexsort((flat_light[rivals], group))
        winner = rivals[by_light[np.flatnonzero(np.diff(group[by_light], append=-1))]]
        flat_place_of_winner = flat_place[winner]
        flat_light[rivals], flat_place[rivals] = 0.0, self.pixels
        flat_light[winner], flat_place[winner] = total, flat_place_of_winner
