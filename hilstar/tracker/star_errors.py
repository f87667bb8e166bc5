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
MIN_BLUR_PX = 1e-3


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
        return float(np.sqrt(np.mean(np.square(self.flux_mag))))

    @property
    def flux_max_mag(self) -> float:
        """The largest flux error."""
        return float(np.abs(self.flux_mag).max())

    def axis_rms_px(self, kind: Centroider) -> float:
        """The rms along an axis."""
        return float(np.sqrt(np.mean(np.square(self.off_px[kind]))))

    def max_px(self, kind: Centroider) -> float:
        """The largest distance."""
        return float(np.hypot(*self.off_px[kind]).max())

    def worst(self) -> Centroider:
        """Who is furthest off."""
        return max(self.off_px, key=self.max_px)


class Judge:
    """A tracker that looks at stars of a sigma (x, y) in the tiles of an image, and knows where
    they should be.

    `wanted` (count * tile, count * tile) has a star in each tile, near its middle: those of a
    column of tiles at an
    x of `places_px`, those of a row at a y (count,). `blur_px` and `pixel_px` are the tracker's, in
    monitor pixels, and `box_share` the threshold of its boxes. `phases` (count,) along x and y say
    where in a tracker's pixel the stars of a column and of a row are, by default anywhere.
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
        self._phases = phases or (spread_phases(self._count),) * 2
        self._tile = len(wanted) // self._count
        self._pixel_px = pixel_px
        self._in_tile_px = [place - self._tile * np.arange(self._count) for place in places_px]
        self._sampled_px = max(pixel_px, FINEST_PX)
        x, y = (math.sqrt(sigma**2 + SQUARES_VARIANCE + blur_px**2) for sigma in sigma_px)
        self._sigma_px = x / self._sampled_px, y / self._sampled_px
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
                self._places[kind] = self._found(self._wanted, kind)
            off_px[kind] = np.where(
                light > 0, self._found(shown, kind) - self._places[kind], np.inf
            )
        return StarErrors(np.asarray(magnitude(light / (share * self._light))), off_px)

    def _found(self, image: FloatArray, kind: Centroider) -> FloatArray:
        """The stars' places (2, n), px, from where the tracker's pixel in the middle is."""
        if kind == "moment":  # no blur and no pixel changes it
            tiles = self._tiles(image, self._tile)
            at = np.arange(self._tile)
            light = np.maximum(tiles.sum(axis=(1, 2)), np.finfo(float).tiny)
            return np.stack([tiles.sum(axis=1) @ at / light, tiles.sum(axis=2) @ at / light])
        boxed = kind in BOXES
        pixel_px = self._pixel_px if boxed else self._sampled_px
        stamps = self._seen(image, pixel_px)
        places = star_places(
            stamps, kind, self._sigma_px, self._middles(stamps, boxed), self._box_share
        )
        return np.stack(places) * pixel_px

    def _middles(self, stamps: FloatArray, boxed: bool) -> Pixels:
        if boxed:
            return self._pixels
        middle = np.full(len(stamps), stamps.shape[1] // 2)
        return middle, middle

    def _light_of(self, image: FloatArray) -> FloatArray:
        return np.asarray(self._tiles(image, self._tile).sum(axis=(1, 2)))

    def _tiles(self, image: FloatArray, side: int) -> FloatArray:
        count = self._count
        return image.reshape(count, side, count, side).transpose(0, 2, 1, 3).reshape(-1, side, side)

    def _views_of(self, pixel_px: float, blur_px: float, half: int) -> list[FloatArray]:
        return [
            _collected(place_px, self._tile, pixel_px, blur_px, half, phase)
            for place_px, phase in zip(self._in_tile_px, self._phases, strict=True)
        ]

    def _seen(self, image: FloatArray, pixel_px: float) -> FloatArray:
        """The tracker's pixels about each star, (n, side, side)."""
        (columns, rows), count, tile = self._views[pixel_px], self._count, self._tile
        side = rows.shape[1]
        # (column, y, side)
        wide = image.reshape(count * tile, count, tile).transpose(1, 0, 2) @ columns.transpose(
            0, 2, 1
        )
        lines = (
            wide.reshape(count, count, tile, side)
            .transpose(1, 2, 0, 3)
            .reshape(count, tile, count * side)
        )
        return np.asarray(
            (rows @ lines)
            .reshape(count, side, count, side)
            .transpose(0, 2, 1, 3)
            .reshape(-1, side, side)
        )


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
    middles = wanted.sum(axis=1) @ at / light, wanted.sum(axis=2) @ at / light
    sampled_px = max(pixel_px, FINEST_PX)
    blur_px = max(blur_px, MIN_BLUR_PX)
    x, y = (math.sqrt(sigma**2 + SQUARES_VARIANCE + blur_px**2) / sampled_px for sigma in sigma_px)

    def seen(images: FloatArray, width_px: float, half: int) -> FloatArray:
        columns, rows = (
            _collected(middle, side, width_px, blur_px, half, phases) for middle in middles
        )
        return rows @ images @ columns.transpose(0, 2, 1)

    # Centroiders of a box see the tracker's pixels in it; all others the whole star.
    box_half = BOX_SIDE // 2
    boxed = seen(wanted, pixel_px, box_half), seen(shown, pixel_px, box_half)
    half = max(box_half, math.ceil(side / 2 / sampled_px))
    whole = seen(wanted, sampled_px, half), seen(shown, sampled_px, half)
    middle = np.full(count, half)
    is_lit = shown.sum(axis=(1, 2)) > 0
    off_px: dict[Centroider, FloatArray] = {}
    for kind in FAMILY:
        if kind in BOXES:
            views, width_px, pixels = boxed, pixel_px, brightest(boxed[0])
        else:
            views, width_px, pixels = whole, sampled_px, (middle, middle)
        there, here = (
            np.stack(star_places(view, kind, (x, y), pixels, box_share)) * width_px
            for view in views
        )
        off_px[kind] = np.where(is_lit, here - there, np.inf)
    return off_px


def spread_phases(count: int) -> FloatArray:
    """Places (count,) within a pixel, -0.5 to 0.5, spread evenly by the golden ratio."""
    return np.asarray((np.arange(count) * GOLDEN) % 1.0 - 0.5)


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
    middles = star_px[:, None] + pixel_px * (np.arange(-half, half + 1) + phase[:, None])
    edges = np.arange(side + 1) - 0.5
    to_left, to_right = (middles[:, :, None] + way * pixel_px / 2 - edges for way in (-1, 1))
    # Cumulative light of a blurred point up to a place, and the integral of that over a monitor
    # pixel.
    within = [_ramp(to, blur_px) for to in (to_left, to_right)]
    return -np.diff(within[1] - within[0], axis=-1)


def _ramp(to_px: FloatArray, blur_px: float) -> FloatArray:
    """The integral of a Gaussian's distribution up to each place."""
    from scipy.special import ndtr  # 0.1 s of every command that needs none of it

    sigmas = to_px / blur_px
    return np.asarray(
        blur_px * (sigmas * ndtr(sigmas) + np.exp(-np.square(sigmas) / 2) / math.sqrt(2 * math.pi))
    )
