"""The monitor as the tracker sees it: its pixels on the tracker's detector and back, and their
light through the optics.

A lit monitor pixel is a small square on the tracker's image, about as large as a tracker pixel:
four, nine or more Gaussians that have the square's variance together (`square_points`), spread by
the tracker's PSF. The black level is a glow over the whole monitor, by its own density on the
image.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hilstar.basics.arrays import Float32Array, FloatArray, IntArray
from hilstar.basics.process.closing import Closing
from hilstar.display.panel import Panel
from hilstar.display.primaries import channel_matrix
from hilstar.display.quantise import LitLight
from hilstar.display.render.numpy_backend import headless_context, open_backend
from hilstar.display.render.target import Target
from hilstar.instruments.simulate.bench_geometry import PIXELS_AT_ONCE, BenchGeometry
from hilstar.optics.glass.glass_psf import NodeSpline
from hilstar.optics.psf import Psf, square_points
from hilstar.optics.sprites import mean_share, pack_sprites
from hilstar.server.bench.frame import Bench
from hilstar.server.bench.monitor import bench_primaries
from hilstar.server.bench.star_rates import named_channels
from hilstar.tracker.mosaic import in_pixels

POINTS_AT_ONCE = 400_000  # bounds the memory: light of more points is spread part by part


class Primary(NamedTuple):
    """A monitor's primary before the tracker's optics: where its light lies within a pixel, and its
    glass's spectrum.

    That is each of the file's wavelengths' share (L,) of its electrons; None: as of light without a
    spectrum.
    """

    place_px: tuple[float, float] = (0.0, 0.0)
    shares: FloatArray | None = None


ALL_ALIKE = (Primary(),)


def seen_primaries(bench: Bench) -> tuple[Primary, ...]:
    """The primaries of a bench before its tracker's optics: one for all where they are not
    driven apart.
    """
    colours = bench.colours
    psf = bench.tracker_psf
    if colours is None:
        return ALL_ALIKE
    spectra: Sequence[FloatArray | None] = [None] * len(colours.places_px)
    if psf.by_colour:
        spectra = list(colours.density @ NodeSpline(psf.wavelengths_nm)(colours.nm))
    primaries = []
    for (x_px, y_px), shares in zip(colours.places_px, spectra, strict=True):
        primaries.append(Primary((float(x_px), float(y_px)), shares))
    return tuple(primaries)


@dataclass(frozen=True, slots=True)
class DisplayColours:
    """A display's light in the pixels of a tracker with a mosaic; all of it in those of a tracker
    without.

    `by_primary` (channels, primaries) are the channels' shares of a primary's electrons, `white`
    (channels,) of black's.
    """

    bayer: str | None
    by_primary: FloatArray
    white: FloatArray

    @classmethod
    def of(cls, bench: Bench) -> "DisplayColours":
        """Those of a bench. Where a mosaic's panel has no known primaries, white has the mean
        colour of the stars.
        """
        config = bench.config
        colours = bench.colours
        stars = bench.stars
        folder = bench.file.folder
        bayer = config.tracker.detector.bayer
        primaries = bench_primaries(config.monitor, folder)
        if bayer is None or stars.colours is None:
            return cls(None, np.empty((0, 0)), np.empty(0))
        if colours is not None:
            return cls(bayer, colours.by_primary, colours.by_primary @ colours.of_white)
        white = mean_share(stars.colours, stars)
        if primaries is not None:
            channels = named_channels(config.tracker, folder)
            white = channel_matrix(primaries, channels, 1.0).e_per_s.sum(axis=1)
        return cls(bayer, white[:, None], white)

    def shown(self, images: FloatArray) -> FloatArray:
        """Light of each primary (primaries, h, w) in the detector's pixels (h, w)."""
        if self.bayer is not None:
            return in_pixels(np.tensordot(self.by_primary, images, 1), self.bayer)
        if len(images) > 1:
            return np.asarray(images.sum(axis=0))
        return np.asarray(images[0])

    def grey(self, image: FloatArray) -> FloatArray:
        """The black level's light (h, w) in the detector's pixels."""
        if self.bayer is None:
            return image
        return in_pixels(np.multiply.outer(self.white, image), self.bayer)


class TwinOptics(Closing):
    """Images of a monitor on the tracker's detector. Free it with `close`, or use it as a
    context manager.
    """

    def __init__(self, geometry: BenchGeometry, psf: Psf) -> None:
        self.geometry = geometry
        side_px = geometry.tracker.focal_length_px / geometry.monitor.focal_length_px
        self._steps, self._psf = square_points(side_px, psf)
        # A pixel farther than this from the detector lights none of it, though it be twice as large
        # there as on the axis.
        self._reach_px = 2 * side_px + self._psf.footprint_px / 2 + 1
        target = Target(geometry.tracker.resolution_px, self._psf)
        self._renderer = open_backend(target, headless_context())

    def images_e_per_s(
        self, lights_e_per_s: Iterable[FloatArray | LitLight], primaries: Sequence[Primary]
    ) -> FloatArray:
        """Electrons per second of each tracker pixel by each primary's light: (primaries, h, w),
        float64.
        """
        images = []
        for light, primary in zip(lights_e_per_s, primaries, strict=True):
            images.append(self.image_e_per_s(light, primary))
        if len(images) > 1:
            return np.array(images)
        return images[0][None]

    def image_e_per_s(
        self, light_e_per_s: FloatArray | Float32Array | LitLight, primary: Primary = ALL_ALIKE[0]
    ) -> FloatArray:
        """Electrons per second of each tracker pixel (h, w) from those of monitor pixels, lit
        ones or all (H, W), float64.
        """
        if isinstance(light_e_per_s, LitLight):
            lit = light_e_per_s
        else:
            lit = LitLight.of(light_e_per_s)
        lit = self._near_the_detector(lit, primary)
        at_once = POINTS_AT_ONCE // len(self._steps) ** 2
        total = self._points(lit.part(0, at_once), primary)
        for begin in range(at_once, len(lit.place), at_once):
            total += self._points(lit.part(begin, begin + at_once), primary)
        # a measured PSF may be negative somewhere
        if self._psf.by_colour:
            return np.maximum(total, 0.0)
        return total

    def _near_the_detector(self, lit: LitLight, primary: Primary) -> LitLight:
        """The lit pixels that may light the detector, of a screen that it may see a small part
        of.
        """
        rows, columns = np.divmod(lit.place, self.geometry.monitor.resolution_px[0])
        x_px, y_px = self.geometry.to_tracker(
            columns.astype(np.float64), rows.astype(np.float64), primary.place_px
        )
        width, height = self.geometry.tracker.resolution_px
        near = (x_px >= -self._reach_px) & (x_px < width + self._reach_px)
        near &= (y_px >= -self._reach_px) & (y_px < height + self._reach_px)
        return LitLight(lit.place[near], lit.e_per_s[near])

    def _points(self, lit: LitLight, primary: Primary) -> FloatArray:
        """The light of lit pixels on the detector (h, w), each as the points of its square."""
        columns, rows = np.meshgrid(self._steps, self._steps)
        dx, dy = columns.ravel(), rows.ravel()
        row, column = np.divmod(lit.place[:, None], self.geometry.monitor.resolution_px[0])
        point_x, point_y = (column + dx).ravel(), (row + dy).ravel()
        x_px, y_px = self.geometry.to_tracker(point_x, point_y, primary.place_px)
        light = np.repeat(lit.e_per_s / len(dx), len(dx))
        star = np.zeros(len(light), dtype=np.intp)
        size_px = self.geometry.tracker.resolution_px
        sprites = pack_sprites(x_px, y_px, light, star, size_px, self._psf.footprint_px)
        if self._psf.by_colour:  # grey light has no spectrum here
            shares = self._psf.mean_shares if primary.shares is None else primary.shares
            at_px = (sprites.x_px, sprites.y_px)
            rates = sprites.data["electrons_per_s"]
            return self._psf.image(*at_px, shares, rates, size_px).astype(np.float64)
        self._renderer.draw(sprites)
        return self._renderer.linear().astype(np.float64)

    def glow_e_per_s(self, panel: Panel) -> FloatArray:
        """Electrons per second of each tracker pixel (h, w) from the black level of the whole
        monitor.

        The density of monitor pixels is that at a tracker pixel's centre; its edge is cut at the
        pixel, not within it.
        """
        width, height = self.geometry.tracker.resolution_px
        glow = np.zeros((height, width))
        if not panel.response.black:
            return glow
        rows = max(1, PIXELS_AT_ONCE // width)
        for top in range(0, height, rows):
            below = min(top + rows, height)
            # A density is a slope: of a band's first and last row, too, it needs the rows beside
            # them.
            first = max(top - 1, 0)
            last = min(below + 1, height)
            glow[top:below] = self._glow_of_rows(panel, first, last)[top - first : below - first]
        return glow

    def _glow_of_rows(self, panel: Panel, first: int, last: int) -> FloatArray:
        """The glow of the detector's rows from `first` to before `last`."""
        width, _ = self.geometry.tracker.resolution_px
        y, x = np.mgrid[first:last, 0:width].astype(np.float64)
        monitor_x, monitor_y = self.geometry.to_monitor(x.ravel(), y.ravel())
        seen_x, seen_y = monitor_x.reshape(y.shape), monitor_y.reshape(y.shape)
        x_down, x_right = np.gradient(seen_x)
        y_down, y_right = np.gradient(seen_y)
        # Beyond a lens there is no place: a pixel whose neighbour looks there has no density
        # either.
        density = np.nan_to_num(np.abs(x_right * y_down - x_down * y_right))
        screen_w, screen_h = self.geometry.monitor.resolution_px
        on_screen = np.abs(seen_x - (screen_w - 1) / 2) <= screen_w / 2
        on_screen &= np.abs(seen_y - (screen_h - 1) / 2) <= screen_h / 2
        black_e_per_s = panel.response.black * panel.flux_at_white_e_per_s
        light = np.full(on_screen.shape, black_e_per_s)
        if panel.uniformity is not None:
            column = _nearest_pixel(np.where(on_screen, seen_x, 0), screen_w)
            row = _nearest_pixel(np.where(on_screen, seen_y, 0), screen_h)
            light = light * panel.uniformity[row, column]
        return np.asarray(np.where(on_screen, light * density, 0.0))

    def close(self) -> None:
        """Free the GL context."""
        self._renderer.close()


def _nearest_pixel(places_px: FloatArray, size_px: int) -> IntArray:
    """The pixels along an axis of `size_px` that places are nearest to."""
    return np.clip(np.rint(places_px), 0, size_px - 1).astype(np.intp)
