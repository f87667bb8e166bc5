"""Footprints of stars as arrays: which pixels each star lights, how much, and what the monitor
cannot show of it.

`PixelOrder` sorts a footprint's pixels by distance from the star, for each sub-pixel phase: `exact`
decides them in that order.
"""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from hilstar.basics.arrays import Float32Array, FloatArray, IntArray
from hilstar.basics.errors import InputError
from hilstar.basics.units import magnitude
from hilstar.display.panel import Panel
from hilstar.display.response import Levels
from hilstar.optics.psf import Psf
from hilstar.optics.sprites import FrameLight

PlaceArray = npt.NDArray[np.int32]  # half the memory of intp: these arrays are the method's largest
PHASES = 8  # sub-pixel phases per axis for which the order is tabulated
# Radius within which `exact` may light pixels that the star's own light leaves dark; 3 doubles the
# error of a 267-step star.
REACH_SIGMA = 3.4
MIN_REACH_PX = 1.6  # narrower stars still get their eight neighbours, to choose among
# Share of a step below which a pixel stays dark; 0.1 adds 20 % to the error of stars of 17 steps,
# 0.02 gains nothing.
LEAST_LIGHT = 0.07
FEWEST = 9  # minimum number of pixels to choose among


class PixelOrder:
    """The order for sprites of one PSF: `size` is the footprint's side, the first `near` pixels lie
    within reach.

    `first` is the footprint's first column (and row), in whole pixels from the star's own; `row`
    and `column`
    (size^2, PHASES^2) count from there, nearest first. `bias` is added to a star's place in its
    pixel for its phase, and `area_px2` is 2 pi times the product of the sigmas, a pixel's width
    among them.
    """

    def __init__(self, psf: Psf) -> None:
        self.size = psf.footprint_px
        self.first = -((self.size - 1) // 2)
        self.bias = 0.5 if self.size % 2 else 0.0
        spread_px = np.sqrt(psf.variance_px2)
        steps = np.arange(self.size) + self.first
        away_px = steps[:, None] - self._middles
        x = (away_px / spread_px[0]) ** 2
        y = (away_px / spread_px[1]) ** 2
        # The footprint's pixels from a star of each phase, in sigmas
        by_axes = np.sqrt(y[:, None, :, None] + x[None, :, None, :])
        distance = by_axes.reshape(self.size**2, PHASES**2)
        self._least_spread_px = float(spread_px.min())
        reach_sigmas = max(REACH_SIGMA, MIN_REACH_PX / self._least_spread_px)
        is_near = distance <= reach_sigmas
        self.near = int(is_near.sum(axis=0).max())
        order = np.argsort(distance, axis=0, kind="stable")
        last_near = order[self.near - 1 : self.near]
        self._farthest_sigmas = float(np.take_along_axis(distance, last_near, axis=0).max())
        self.area_px2 = 2 * np.pi * float(spread_px.prod())
        self.row = (order // self.size).astype(np.int32)
        self.column = (order % self.size).astype(np.int32)

    @property
    def _middles(self) -> FloatArray:
        """The middle of each phase along one axis (PHASES,), px from the star's own pixel."""
        return (np.arange(PHASES) + 0.5) / PHASES - self.bias

    def near_sigmas(self, more_px: float = 0.0) -> float:
        """Distance of the farthest near pixel of any phase in sigmas (a pixel's width included),
        plus `more_px`.

        All phases have as many near pixels: where few lie within reach, some lie beyond it.
        """
        return self._farthest_sigmas + more_px / self._least_spread_px

    def reach(self, steps: Float32Array) -> IntArray:
        """Number of nearest pixels (n,) that hold enough light to choose among, for stars of
        `steps` (n,) steps of light.
        """
        # A Gaussian's k-th nearest pixel has exp(-k / area) of its peak.
        least = np.float32(1 / (self.area_px2 * LEAST_LIGHT))
        pixels = np.float32(self.area_px2) * np.log(np.maximum(steps * least, np.float32(1)))
        return np.asarray(np.clip(pixels.astype(np.intp), min(FEWEST, self.near), self.near))

    def places(self) -> IntArray:
        """The pixels of a footprint from the star's own, nearest first, by phase: x and y (2,
        PHASES^2, pixels).
        """
        from_corner = np.stack([self.column.T, self.row.T])
        return from_corner.astype(np.intp) + self.first

    @property
    def phases(self) -> FloatArray:
        """The middle of each phase, px from the star's own pixel: x and y (2, PHASES^2)."""
        x = np.tile(self._middles, PHASES)
        y = np.repeat(self._middles, PHASES)
        return np.stack([x, y])


@dataclass(frozen=True, slots=True)
class Footprints:
    """Pixels of n stars, nearest first, each (pixels, n). A pixel that several stars light belongs
    to the brightest there.

    `light` is the whole light in the pixel, electrons per second, 0 where it is another star's or
    off the image, and
    `place` its place in the flat image, there one past the end. `offset_px` (2, pixels, n) are x
    and y in whole pixels from the star's own, `fraction_px` (2, n) is the star's centre from there.
    `rate_e_per_s` (n,) is the star's own light.
    """

    light: Float32Array
    place: PlaceArray
    offset_px: Float32Array
    fraction_px: Float32Array
    rate_e_per_s: Float32Array


class FootprintMap:
    """Finds the footprints of sprites of one PSF on one image."""

    def __init__(self, resolution_px: tuple[int, int], psf: Psf) -> None:
        self.resolution_px = resolution_px
        self.pixels = resolution_px[0] * resolution_px[1]
        self._psf = psf
        self.order = PixelOrder(psf)
        self._last_entry = np.empty(self.pixels + 1, dtype=np.int32)
        self._contested = np.zeros(self.pixels + 1, dtype=np.bool_)

    def find(self, sprites: FrameLight) -> Footprints:
        """The footprints of `sprites`. Raises InputError for sprites of another PSF's footprint."""
        order = self.order
        if sprites.footprint_px != order.size:
            raise InputError(
                f"sprites of {sprites.footprint_px} px where the PSF needs {order.size} px"
            )
        data = sprites.data
        count = len(sprites)
        fraction = data["fraction_px"].astype(np.float64).T
        in_phases = (fraction + order.bias) * PHASES
        phase_x, phase_y = np.clip(in_phases, 0, PHASES - 1).astype(np.intp)
        phase = phase_y * PHASES + phase_x
        row = order.row.take(phase, axis=1)
        column = order.column.take(phase, axis=1)
        if self._psf.by_colour and sprites.spectra is not None:
            x_px, y_px = data["pixel"].T + fraction
            stamps = self._psf.stamps_at(x_px, y_px, sprites.spectra, data["electrons_per_s"])
            if stamps.shape[1] != order.size:
                raise InputError(f"a PSF that varies has a footprint of {order.size} px, not odd")
            stamps = np.ascontiguousarray(np.moveaxis(stamps, 0, 2))
        else:
            stamps = self._psf.stamps(fraction, data["electrons_per_s"], order.size)
        # the stamps are (rows, columns, n)
        in_stamp = row * order.size + column
        light = stamps.take(in_stamp * count + np.arange(count, dtype=np.int32))
        row += order.first
        column += order.first
        place = self._places(data["pixel"], row, column)
        light[place == self.pixels] = 0.0
        if len(sprites):
            self._settle(light, place)
        offset = np.stack([column, row]).astype(np.float32)
        return Footprints(light, place, offset, data["fraction_px"].T, data["electrons_per_s"])

    def _places(self, pixel: PlaceArray, row: PlaceArray, column: PlaceArray) -> PlaceArray:
        """The places (pixels, n) in the flat image of pixels so far from the stars' own (n, 2)."""
        width, height = self.resolution_px
        x = pixel[:, 0].astype(np.int32)
        y = pixel[:, 1].astype(np.int32)
        place = row * width + column
        place += y * width + x
        reach = self.order.size
        is_by_side = (x < reach) | (x >= width - reach)
        is_by_end = (y < reach) | (y >= height - reach)
        # the few stars whose footprints may reach over the edge
        cut = np.flatnonzero(is_by_side | is_by_end)
        if len(cut):
            at_x = x[cut] + column[:, cut]
            at_y = y[cut] + row[:, cut]
            inside = (at_x >= 0) & (at_x < width) & (at_y >= 0) & (at_y < height)
            place[:, cut] = np.where(inside, place[:, cut], self.pixels)
        return place

    def _settle(self, light: Float32Array, place: PlaceArray) -> None:
        """Assign each pixel that several stars touch to the brightest there, with the light of
        all.
        """
        flat_light = light.ravel()
        flat_place = place.ravel()
        entry = np.arange(flat_place.size, dtype=np.int32)
        self._last_entry[flat_place] = entry  # the last of several stays
        is_on_image = flat_place != self.pixels
        is_beaten = (self._last_entry[flat_place] != entry) & is_on_image
        if not is_beaten.any():
            return
        contested = flat_place[is_beaten]
        self._contested[contested] = True
        rivals = np.flatnonzero(self._contested[flat_place])
        self._contested[contested] = False
        rival_light = flat_light[rivals]
        _, group = np.unique(flat_place[rivals], return_inverse=True)
        total = np.bincount(group, rival_light)
        # group by group, the brightest last
        by_light = np.lexsort((rival_light, group))
        last_of_group = np.flatnonzero(np.diff(group[by_light], append=-1))
        winner = rivals[by_light[last_of_group]]
        place_of_winner = flat_place[winner]
        flat_light[rivals] = 0.0
        flat_place[rivals] = self.pixels
        flat_light[winner] = total
        flat_place[winner] = place_of_winner


def star_losses_mag(
    sprites: FrameLight, panel: Panel, footprints: FootprintMap, levels: Levels
) -> FloatArray:
    """How many magnitudes fainter than wanted each of n sprites is in `levels` (height, width),
    (n,).

    Infinite for a star that shows nothing, NaN for one without a pixel on the image. A pixel that
    several stars light
    counts for the brightest there, with the light of all. A star without a pixel of its own loses,
    in each of its pixels, the share that the pixel's owner loses.
    """
    star_light = footprints.find(sprites)
    wanted = star_light.light.sum(axis=0, dtype=np.float64)
    shown = _shown(star_light.place, panel, levels).sum(axis=0)
    hidden = np.flatnonzero(wanted == 0)
    if len(hidden):
        whole = np.bincount(
            star_light.place.ravel(), star_light.light.ravel(), minlength=footprints.pixels + 1
        )
    for k in hidden.tolist():
        spectra = sprites.spectra
        if spectra is not None and spectra.ndim > 1:
            spectra = spectra[k : k + 1]
        alone = footprints.find(replace(sprites, data=sprites.data[k : k + 1], spectra=spectra))
        light = alone.light[:, 0].astype(np.float64)
        lit = light > 0
        place = alone.place[lit, 0]
        owners_light = _shown(place, panel, levels)
        wanted[k] = light.sum()
        shown[k] = (light[lit] * owners_light / whole[place]).sum()
    with np.errstate(invalid="ignore"):
        return np.asarray(magnitude(shown / wanted))


def _shown(place: PlaceArray, panel: Panel, levels: Levels) -> FloatArray:
    """The light, e-/s, that a panel shows at places of the flat image, 0 for those off it."""
    if levels.ndim == 3:
        light = np.zeros(place.shape)
        for k, primary in enumerate(panel.primaries):
            light += _shown(place, primary, Levels(levels[..., k]))
        return light
    # the place one past the end is that of pixels off the image
    with_dark = np.append(levels.ravel(), levels.dtype.type(0))
    share = np.asarray(panel.response.light[with_dark[place]], dtype=np.float64)
    if panel.uniformity is not None:
        uniformity = np.append(panel.uniformity.ravel(), 1.0)
        share = share * uniformity[place]
    return share * panel.flux_at_white_e_per_s
