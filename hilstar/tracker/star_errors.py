"""What a tracker finds wrong with a display's stars: each centroider, in the tracker's own pixels
after its own blur.

A lit monitor pixel is a square of light. The tracker's optics blur it (a Gaussian), and its pixels,
of any width, collect it. Stars stand in the tiles of a square image (`monitor.phases`); each row
and column of tiles meets the tracker's pixels at a phase of its own.
"""

import math
from dataclasses import dataclass

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.units import magnitude
from hilstar.tracker.centroiders import (
    BOX_SHARE,
    FAMILY,
    Centroider,
    Pixels,
    Sigma,
    brightest,
    star_places,
)

# a pixel's width twice: a star is sampled by squares, and shown by squares
SQUARES_VARIANCE = 1 / 6
REACH_SIGMAS = 5.0  # of a star, where it is looked at: beyond lie 6e-7 of a Gaussian
BOX_SIDE = 9  # tracker pixels: a box of 5, and two on either side for its centre
# Pixels finer than this show windows and fits the same star: its sigma is 0.85 px and more.
FINEST_PX = 0.5
BOXES = ("box3", "box5")
GOLDEN = 0.6180339887498949  # its multiples fill a pixel most evenly
MIN_BLUR_PX = 1e-3  # in place of none, by which places would be divided


@dataclass(frozen=True, slots=True)
class StarErrors:
    """Of n stars: flux errors, mag, positive too faint, and how far off each centroider finds them,
    px along x and y (2, n).

    Infinite where a star shows nothing.
    """

    flux_mag: FloatArray
    off_px: dict[Centroider, FloatArray]

    @property
    def flux_rms_mag(self) -> float:
        """The rms of the flux errors."""
        return _rms(self.flux_mag)

    @property
    def flux_max_mag(self) -> float:
        """The largest flux error."""
        return float(np.abs(self.flux_mag).max())

    def axis_rms_px(self, kind: Centroider) -> float:
        """The rms along an axis."""
        return _rms(self.off_px[kind])

    def max_px(self, kind: Centroider) -> float:
        """The largest distance."""
        return float(np.hypot(*self.off_px[kind]).max())

    def worst(self) -> Centroider:
        """The centroider with the largest distance."""
        return max(self.off_px, key=self.max_px)


def _rms(errors: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(errors))))


class Judge:
    """A tracker that measures the stars in the tiles of an image against the same stars in the
    image that is wanted.

    `wanted` (count * tile, count * tile) has one star near the middle of each tile: those of a
    column of tiles at one x of `places_px`, those of a row at one y (count,). `sigma_px` (x, y) is
    a star's; `blur_px` and `pixel_px` are the tracker's; all in monitor pixels. `box_share` is the
    threshold of its boxes. `phases` (count,) along x and y say where in a tracker's pixel the stars
    of a column and of a row are; by default they are spread evenly.
    """

    def __init__(
        self,
        wanted: FloatArray,
        places_px: tuple[FloatArray, FloatArray],
        sigma_px: Sigma,
        blur_px: float,
        pixel_px: float,
        *,
        box_share: float = BOX_SHARE,
        phases: tuple[FloatArray, FloatArray] | None = None,
    ) -> None:
        self._box_share = box_share
        self._count = len(places_px[0])
        if phases is None:
            evenly = spread_phases(self._count)
            phases = (evenly, evenly)
        self._phases = phases
        self._tile = len(wanted) // self._count
        self._pixel_px = pixel_px
        tile_first_px = self._tile * np.arange(self._count)
        self._in_tile_px = [place_px - tile_first_px for place_px in places_px]
        self._sampled_px = max(pixel_px, FINEST_PX)
        self._sigma_px = _shown_sigma(sigma_px, blur_px, self._sampled_px)
        half = max(BOX_SIDE // 2, math.ceil(REACH_SIGMAS * max(self._sigma_px)))
        blur_px = max(blur_px, MIN_BLUR_PX)
        self._views = {self._sampled_px: self._views_of(self._sampled_px, blur_px, half)}
        self._views.setdefault(pixel_px, self._views_of(pixel_px, blur_px, BOX_SIDE // 2))
        self._light = self._light_of(wanted)
        self._pixels = brightest(self._seen(wanted, pixel_px))
        self._wanted = wanted
        self._places: dict[Centroider, FloatArray] = {}

    def errors(
        self,
        shown: FloatArray,
        share: float | FloatArray = 1.0,
        kinds: tuple[Centroider, ...] = FAMILY,
    ) -> StarErrors:
        """The errors of an image of the same stars, whose light should be `share` of those
        wanted: all's, or each one's.
        """
        light = self._light_of(shown)
        off_px = {}
        for kind in kinds:
            if kind not in self._places:
                self._places[kind] = self._places_of(self._wanted, kind)
            error_px = self._places_of(shown, kind) - self._places[kind]
            off_px[kind] = np.where(light > 0, error_px, np.inf)
        flux_ratio = light / (share * self._light)
        return StarErrors(np.asarray(magnitude(flux_ratio)), off_px)

    def _places_of(self, image: FloatArray, kind: Centroider) -> FloatArray:
        """The places (2, n), px, at which a centroider finds the stars, from the tracker's pixel in
        the middle.
        """
        if kind == "moment":  # no blur and no pixel changes it
            tiles = self._tiles(image, self._tile)
            at = np.arange(self._tile)
            light = np.maximum(tiles.sum(axis=(1, 2)), np.finfo(float).tiny)
            x = tiles.sum(axis=1) @ at / light
            y = tiles.sum(axis=2) @ at / light
            return np.stack([x, y])
        boxed = kind in BOXES
        pixel_px = self._pixel_px if boxed else self._sampled_px
        stamps = self._seen(image, pixel_px)
        middles = self._middles(stamps, boxed)
        places = star_places(stamps, kind, self._sigma_px, middles, self._box_share)
        return np.stack(places) * pixel_px

    def _middles(self, stamps: FloatArray, boxed: bool) -> Pixels:
        """The pixels that centroiders begin at: a box's is the brightest of the stars wanted."""
        if boxed:
            return self._pixels
        middle = np.full(len(stamps), stamps.shape[1] // 2)
        return middle, middle

    def _light_of(self, image: FloatArray) -> FloatArray:
        """The light (n,) of each tile."""
        return np.asarray(self._tiles(image, self._tile).sum(axis=(1, 2)))

    def _tiles(self, image: FloatArray, side: int) -> FloatArray:
        """An image of tiles with so many pixels along a side as (n, side, side), row by row."""
        count = self._count
        by_tile = image.reshape(count, side, count, side).transpose(0, 2, 1, 3)
        return by_tile.reshape(-1, side, side)

    def _views_of(self, pixel_px: float, blur_px: float, half: int) -> list[FloatArray]:
        """What tracker pixels collect of a tile's columns and of its rows (see `_collected`)."""
        views = []
        for place_px, phase in zip(self._in_tile_px, self._phases, strict=True):
            views.append(_collected(place_px, self._tile, pixel_px, blur_px, half, phase))
        return views

    def _seen(self, image: FloatArray, pixel_px: float) -> FloatArray:
        """The tracker's pixels about each star, (n, side, side)."""
        columns, rows = self._views[pixel_px]
        count = self._count
        tile = self._tile
        side = rows.shape[1]
        by_column = image.reshape(count * tile, count, tile).transpose(1, 0, 2)
        across = by_column @ columns.transpose(0, 2, 1)  # (column of tiles, y, side)
        by_row = across.reshape(count, count, tile, side).transpose(1, 2, 0, 3)
        pixels = rows @ by_row.reshape(count, tile, count * side)
        return self._tiles(np.asarray(pixels), side)


def _shown_sigma(sigma_px: Sigma, blur_px: float, sampled_px: float) -> Sigma:
    """A star's sigma (x, y) as a tracker sees it, in its sampled pixels."""
    sigma_x, sigma_y = sigma_px
    x_px = math.sqrt(sigma_x**2 + SQUARES_VARIANCE + blur_px**2)
    y_px = math.sqrt(sigma_y**2 + SQUARES_VARIANCE + blur_px**2)
    return x_px / sampled_px, y_px / sampled_px


def stamp_errors(
    shown: FloatArray,
    wanted: FloatArray,
    sigma_px: Sigma,
    blur_px: float,
    pixel_px: float,
    *,
    box_share: float = BOX_SHARE,
) -> dict[Centroider, FloatArray]:
    """How far off each centroider finds the stars of squares `shown` from those `wanted`, both (n,
    side, side): px (2, n).

    Stars may be paths; sigmas, blur, pixels and threshold as for a `Judge`. Infinite where nothing
    is shown.
    """
    count, side = wanted.shape[:2]
    phases = spread_phases(count)
    at = np.arange(side)
    light = wanted.sum(axis=(1, 2))
    middle_x = wanted.sum(axis=1) @ at / light
    middle_y = wanted.sum(axis=2) @ at / light
    sampled_px = max(pixel_px, FINEST_PX)
    blur_px = max(blur_px, MIN_BLUR_PX)
    shown_sigma = _shown_sigma(sigma_px, blur_px, sampled_px)

    def seen(images: FloatArray, width_px: float, half: int) -> FloatArray:
        columns = _collected(middle_x, side, width_px, blur_px, half, phases)
        rows = _collected(middle_y, side, width_px, blur_px, half, phases)
        return rows @ images @ columns.transpose(0, 2, 1)

    # Centroiders of a box see the tracker's pixels in it; all others the whole star.
    box_half = BOX_SIDE // 2
    boxed_wanted = seen(wanted, pixel_px, box_half)
    boxed_shown = seen(shown, pixel_px, box_half)
    half = max(box_half, math.ceil(side / 2 / sampled_px))
    whole_wanted = seen(wanted, sampled_px, half)
    whole_shown = seen(shown, sampled_px, half)
    middle = np.full(count, half)
    box_pixels = brightest(boxed_wanted)
    is_lit = shown.sum(axis=(1, 2)) > 0
    off_px: dict[Centroider, FloatArray] = {}
    for kind in FAMILY:
        if kind in BOXES:
            wanted_at = star_places(boxed_wanted, kind, shown_sigma, box_pixels, box_share)
            shown_at = star_places(boxed_shown, kind, shown_sigma, box_pixels, box_share)
            width_px = pixel_px
        else:
            wanted_at = star_places(whole_wanted, kind, shown_sigma, (middle, middle))
            shown_at = star_places(whole_shown, kind, shown_sigma, (middle, middle))
            width_px = sampled_px
        error_px = np.stack(shown_at) * width_px - np.stack(wanted_at) * width_px
        off_px[kind] = np.where(is_lit, error_px, np.inf)
    return off_px


def spread_phases(count: int) -> FloatArray:
    """Places (count,) within a pixel, -0.5 to 0.5, spread evenly by the golden ratio."""
    turned = np.arange(count) * GOLDEN
    return np.asarray(turned % 1.0 - 0.5)


def _collected(
    star_px: FloatArray,
    side: int,
    pixel_px: float,
    blur_px: float,
    half: int,
    phase: FloatArray,
) -> FloatArray:
    """What each of 2 half + 1 tracker pixels about a star collects of each of `side` monitor
    pixels, along one axis.

    (n, 2 half + 1, side), for stars at places (n,) from the first monitor pixel; each meets the
    tracker's pixels at its `phase` (n,).
    """
    steps = np.arange(-half, half + 1) + phase[:, None]
    middles = (star_px[:, None] + pixel_px * steps)[:, :, None]
    edges = np.arange(side + 1) - 0.5
    to_left = middles - pixel_px / 2 - edges
    to_right = middles + pixel_px / 2 - edges
    # Cumulative light of a blurred point up to a place, and the integral of that over a monitor
    # pixel.
    within = _ramp(to_right, blur_px) - _ramp(to_left, blur_px)
    return -np.diff(within, axis=-1)


def _ramp(to_px: FloatArray, blur_px: float) -> FloatArray:
    """The integral of a Gaussian's distribution up to each place."""
    from scipy.special import ndtr  # 0.1 s of every command that needs none of it

    sigmas = to_px / blur_px
    density = np.exp(-np.square(sigmas) / 2) / math.sqrt(2 * math.pi)
    return np.asarray(blur_px * (sigmas * ndtr(sigmas) + density))
