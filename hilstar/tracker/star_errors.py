"""The errors that a tracker measures in a display's stars, by each centroider, in the tracker's own
pixels and after its own blur.

A lit monitor pixel is a square of light. The tracker's optics blur it by a Gaussian, and its
pixels, of any width, collect it. The stars are in the tiles of a square image, one to a tile; the
stars of each row and column of tiles lie at another phase of the tracker's pixels.
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

# px^2: twice the variance 1/12 of a pixel's width, as a star is sampled and shown by squares
SQUARES_VARIANCE = 1 / 6
REACH_SIGMAS = 5.0  # half the side of a star's square, in sigmas: 6e-7 of a Gaussian lie beyond
BOX_SIDE = 9  # tracker pixels: a box of 5, and two to each side, as its middle may move
# Windows and fits see the same star in any finer pixels, as its sigma is 0.85 px or more; so they
# get pixels of this width at least.
FINEST_PX = 0.5
BOXES = ("box3", "box5")
GOLDEN = 0.6180339887498949  # multiples of it, modulo 1, fill a pixel most evenly
MIN_BLUR_PX = 1e-3  # replaces a blur of 0, by which `_ramp` would divide


@dataclass(frozen=True, slots=True)
class StarErrors:
    """The errors of n stars: `flux_mag` (n,), mag, positive for a star that is too faint, and for
    each centroider `off_px` (2, n), the error of a star's place along x and y, monitor pixels.

    Both are infinite for a star of which nothing is shown.
    """

    flux_mag: FloatArray
    off_px: dict[Centroider, FloatArray]

    @property
    def flux_rms_mag(self) -> float:
        """The rms of the flux errors, mag."""
        return _rms(self.flux_mag)

    @property
    def flux_max_mag(self) -> float:
        """The largest flux error, mag, without its sign."""
        return float(np.abs(self.flux_mag).max())

    def axis_rms_px(self, kind: Centroider) -> float:
        """The rms of a centroider's errors along one axis, px, over both axes."""
        return _rms(self.off_px[kind])

    def max_px(self, kind: Centroider) -> float:
        """The largest distance of a star from its place by a centroider, px."""
        return float(np.hypot(*self.off_px[kind]).max())

    def worst(self) -> Centroider:
        """The centroider whose largest distance is the largest."""
        return max(self.off_px, key=self.max_px)


def _rms(errors: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(errors))))


class Judge:
    """A tracker that measures the stars in the tiles of a shown image, and compares them with the
    same stars in the `wanted` image.

    `wanted` (count * tile, count * tile) has one star near the middle of each tile. `places_px` are
    the stars' x (count,), one for each column of tiles, and y (count,), one for each row.
    `sigma_px` (x, y) is the sigma of a star, `blur_px` that of the tracker's blur, `pixel_px` the
    width of its pixels; all in monitor pixels. `box_share` is the threshold of its boxes. `phases`
    (x, y), each (count,), say where in a tracker's pixel the stars of a column and of a row are; by
    default they are spread evenly.
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
        """The errors of an image with the same stars. Their light should be `share`, one number or
        (n,), of that of the wanted stars.
        """
        light = self._light_of(shown)
        unknown = tuple(kind for kind in kinds if kind not in self._places)
        self._places |= self._places_by(self._wanted, unknown)
        off_px = {}
        for kind, place_px in self._places_by(shown, kinds).items():
            error_px = place_px - self._places[kind]
            off_px[kind] = np.where(light > 0, error_px, np.inf)
        flux_ratio = light / (share * self._light)
        return StarErrors(np.asarray(magnitude(flux_ratio)), off_px)

    def _places_by(
        self, image: FloatArray, kinds: tuple[Centroider, ...]
    ) -> dict[Centroider, FloatArray]:
        """By centroider, the x and y (2, n) of the stars, monitor pixels, from the middle of the
        tracker's pixel in the middle (by `moment`, from the tile's first pixel).
        """
        places: dict[Centroider, FloatArray] = {}
        stamps_by_px: dict[float, FloatArray] = {}
        for kind in kinds:
            if kind == "moment":  # neither blur nor pixels change a first moment
                places[kind] = self._moments_of(image)
                continue
            boxed = kind in BOXES
            pixel_px = self._pixel_px if boxed else self._sampled_px
            if pixel_px not in stamps_by_px:
                stamps_by_px[pixel_px] = self._seen(image, pixel_px)
            stamps = stamps_by_px[pixel_px]
            middles = self._middles(stamps, boxed)
            at = star_places(stamps, kind, self._sigma_px, middles, self._box_share)
            places[kind] = np.stack(at) * pixel_px
        return places

    def _moments_of(self, image: FloatArray) -> FloatArray:
        """The first moments x and y (2, n) of the tiles, monitor pixels from their first one."""
        tiles = self._tiles(image, self._tile)
        at = np.arange(self._tile)
        light = np.maximum(tiles.sum(axis=(1, 2)), np.finfo(float).tiny)
        x = tiles.sum(axis=1) @ at / light
        y = tiles.sum(axis=2) @ at / light
        return np.stack([x, y])

    def _middles(self, stamps: FloatArray, boxed: bool) -> Pixels:
        """The pixels at which centroiders begin: a box at the brightest pixel of the wanted star,
        so that both images are measured in one box; the others in the middle.
        """
        if boxed:
            return self._pixels
        middle = np.full(len(stamps), stamps.shape[1] // 2)
        return middle, middle

    def _light_of(self, image: FloatArray) -> FloatArray:
        """The light (n,) of each tile."""
        return np.asarray(self._tiles(image, self._tile).sum(axis=(1, 2)))

    def _tiles(self, image: FloatArray, side: int) -> FloatArray:
        """The tiles (n, side, side) of an image (count * side, count * side), row by row."""
        count = self._count
        by_tile = image.reshape(count, side, count, side).transpose(0, 2, 1, 3)
        return by_tile.reshape(-1, side, side)

    def _views_of(self, pixel_px: float, blur_px: float, half: int) -> list[FloatArray]:
        """The shares of a tile's columns, and of its rows, that tracker pixels collect, each as
        `_collected` returns them.
        """
        views = []
        for place_px, phase in zip(self._in_tile_px, self._phases, strict=True):
            views.append(_collected(place_px, self._tile, pixel_px, blur_px, half, phase))
        return views

    def _seen(self, image: FloatArray, pixel_px: float) -> FloatArray:
        """The light (n, side, side) in the tracker's pixels, of width `pixel_px`, about each
        star.
        """
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
    """A star's sigma (x, y) after the display's pixels, the tracker's blur and its pixels, in units
    of `sampled_px`.
    """
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
    """By centroider, the error (2, n) along x and y, monitor pixels, of the stars in the squares
    `shown` with respect to those in `wanted`, both (n, side, side).

    Stars may be paths. Sigmas, blur, pixels and threshold are those of a `Judge`. The error is
    infinite where nothing is shown.
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

    # Centroiders of a box see the tracker's pixels about it; all others see the whole star.
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
    """The share (n, 2 half + 1, side) of the light of each of `side` monitor pixels that each of
    2 half + 1 tracker pixels about a star collects, along one axis.

    `star_px` (n,) are the stars' places from the first monitor pixel. The middle tracker pixel is
    centred `phase` (n,) tracker pixels after its star. Lengths are in monitor pixels.
    """
    steps = np.arange(-half, half + 1) + phase[:, None]
    middles = (star_px[:, None] + pixel_px * steps)[:, :, None]
    edges = np.arange(side + 1) - 0.5
    to_left = middles - pixel_px / 2 - edges
    to_right = middles + pixel_px / 2 - edges
    # `_ramp` integrates the light of a blurred point up to a place: its difference over a monitor
    # pixel's two edges is the light of that pixel up to a tracker pixel's edge.
    within = _ramp(to_right, blur_px) - _ramp(to_left, blur_px)
    return -np.diff(within, axis=-1)


def _ramp(to_px: FloatArray, blur_px: float) -> FloatArray:
    """The integral, px, of a Gaussian's cumulative distribution (sigma `blur_px`) up to each
    place.
    """
    # The import takes 0.1 s, which commands without a judge save.
    from scipy.special import ndtr

    sigmas = to_px / blur_px
    density = np.exp(-np.square(sigmas) / 2) / math.sqrt(2 * math.pi)
    return np.asarray(blur_px * (sigmas * ndtr(sigmas) + density))
