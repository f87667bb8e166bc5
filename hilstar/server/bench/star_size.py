"""How wide a star of the display is on the tracker's detector, against a star of the sky, and what
would make it narrower.

A star of the display is a sprite of monitor pixels, each an evenly lit square, seen through the
tracker's lens: where a monitor pixel is several of the tracker's, no focus makes that as narrow as
a star of the sky. Its variance in tracker pixels is that of the sprite and of two monitor pixels
(one in which the sprite is summed up, one that is lit), and the lens's.
"""

import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.units import magnitude
from hilstar.optics.camera import Camera
from hilstar.optics.psf import PIXEL_VARIANCE, GaussianPsf, Psf, square_points
from hilstar.server.bench.cameras import (
    before_detector,
    display_psf,
    figure,
    tracker_camera,
    tracker_psf,
)
from hilstar.server.bench.config import GAUSSIAN, BenchConfig

MM_PER_INCH, UM_PER_MM = 25.4, 1e3
NOTHING_PX2 = 1e-6  # of variance: no panel is that fine
WHOLE = 0.999  # of the tracker's field: the rest is rounding
UNSEEN_SHARE = 1e-4  # of a monitor pixel's light in the brightest one's: left out
# Beyond so many tracker pixels to a monitor pixel, its light is summed up in coarser squares: it is
# even over most of them.
FINEST = 12.0
# Panels that are sold: diagonal in inches and pixels, from which the pitch follows.
PANELS = (
    ("0.71-inch microdisplay", 0.71, (1920, 1080)),
    ("1.3-inch microdisplay", 1.3, (3552, 3840)),
    ("5.5-inch 4K", 5.5, (3840, 2160)),
    ("8.9-inch 2560 x 1600", 8.9, (2560, 1600)),
    ("13.3-inch 4K", 13.3, (3840, 2160)),
    ("15.6-inch 4K", 15.6, (3840, 2160)),
    ("24-inch Full HD", 23.8, (1920, 1080)),
    ("27-inch 2560 x 1440", 27.0, (2560, 1440)),
    ("27-inch 4K", 27.0, (3840, 2160)),
    ("27-inch 5K", 27.0, (5120, 2880)),
    ("32-inch 6K", 32.0, (6016, 3384)),
    ("32-inch 8K", 31.5, (7680, 4320)),
)


@dataclass(frozen=True, slots=True)
class PanelOption:
    """A panel of today before this tracker, and between which focal lengths of a collimator it
    would do; None where none does.

    At the shorter one the star is at the limit, at the longer one the tracker's field just fits on
    the screen. `sigma_ratio` is the star's at the longer one.
    """

    panel: str
    resolution_px: tuple[int, int]
    pixel_pitch_um: float
    collimator_mm: tuple[float, float] | None
    sigma_ratio: float


@dataclass(frozen=True, slots=True)
class StarRemedy:
    """What would bring a star within the limit: one of these lengths in place of the bench's.

    `collimator_mm` leaves `field_on_screen` of the tracker's field on the screen, and `field_fits`
    says whether that is no less than now. A panel of `pixel_pitch_um` behind the same collimator
    has to have `resolution_px`. All are None where no length does, because the limit is under what
    the lens makes of a point.
    """

    tracker_px_a_monitor_px: float | None
    collimator_mm: float | None
    field_on_screen: float | None
    field_fits: bool
    pixel_pitch_um: float | None
    resolution_px: tuple[int, int] | None
    panels: tuple[PanelOption, ...]

    def text(self) -> str:
        """What would do, for a person."""
        if self.collimator_mm is None or self.resolution_px is None:
            return (
                "no collimator and no panel would do: the lens alone makes a point wider than that"
            )
        width, height = self.resolution_px
        panel = f"a panel of {self.pixel_pitch_um:.4g} um and {width} x {height} px or more"
        collimator = f"a collimator of {self.collimator_mm:.4g} mm"
        if self.field_fits:
            return f"{collimator} would do, or {panel}"
        field_text = f"{100 * (self.field_on_screen or 0.0):.0f} % of the tracker's field"
        return f"{panel} would do; {collimator} leaves {field_text} on this screen"

    def lines(self) -> Iterator[str]:
        """The table of panels, for a person."""
        yield (
            f"{'panel':24}{'pitch':>8}  collimator, its star within the limit and the field on the"
            " screen"
        )
        for option in self.panels:
            lengths = (
                f"none: the star is {option.sigma_ratio:.1f} times as wide where the field fits"
            )
            if option.collimator_mm is not None:
                low, high = option.collimator_mm
                lengths = f"{low:.0f} to {high:.0f} mm"
            yield f"{option.panel:24}{option.pixel_pitch_um:5.1f} um  {lengths}"


@dataclass(frozen=True, slots=True)
class StarSize:
    """A star of the display as the tracker will see it, and one of the sky through the same lens.

    Sigmas in tracker pixels, before the pixel; `sigma_ratio` has the pixel in both, and `limit` is
    `[verify] star_sigma_ratio`. `peak_loss_mag` is how much fainter its brightest pixel is, both in
    the middle of a pixel. `shared_px` is over how many pixels its light is shared out: 1 over the
    sum of the squares of their shares. `would_do` is None within the limit.
    """

    sigma_px: float
    sky_sigma_px: float
    sigma_ratio: float
    limit: float
    peak_loss_mag: float
    shared_px: float
    sky_shared_px: float
    would_do: StarRemedy | None

    @property
    def too_wide(self) -> bool:
        """Whether it is over the limit."""
        return self.sigma_ratio > self.limit

    def line(self) -> str:
        """ "star 1.0 px sigma, of the sky 0.55; brightest pixel 1.1 mag fainter; 13.6 px share
        it, of the sky 4.5".
        """
        return (
            f"star {figure(self.sigma_px)} px sigma, of the sky {figure(self.sky_sigma_px)};"
            f" brightest pixel {self.peak_loss_mag:.1f} mag fainter;"
            f" {figure(self.shared_px)} px share it, of the sky {figure(self.sky_shared_px)}"
        )

    def fault(self) -> str | None:
        """What is wrong with it, by how much, and what would do; None within the limit."""
        if self.would_do is None:
            return None
        limit = f"limit [verify] star_sigma_ratio = {self.limit:g}"
        wide = f"a star is {self.sigma_ratio:.2g} times as wide as the sky's ({limit})"
        return f"{wide}: {self.would_do.text()}"

    def keys(self) -> dict[str, Any]:
        """As --json has it."""
        return asdict(self)


@dataclass(frozen=True, slots=True)
class _Widths:
    """Variances in tracker pixels squared: of the sky's star, and of the display's: one that goes
    with the square of the tracker pixels to a monitor pixel, per that square, and one that does
    not.
    """

    sky_px2: float
    by_ratio: float
    fixed_px2: float

    def sigma_ratio(self, ratio: float) -> float:
        """The display's sigma to the sky's at so many tracker pixels to a monitor pixel, the
        tracker's pixel in both.
        """
        shown_px2 = self.by_ratio * ratio**2 + self.fixed_px2
        return math.sqrt((shown_px2 + PIXEL_VARIANCE) / (self.sky_px2 + PIXEL_VARIANCE))

    def largest_ratio(self, limit: float) -> float | None:
        """The largest of those at which that is within the limit; None where none is."""
        left_px2 = limit**2 * (self.sky_px2 + PIXEL_VARIANCE) - PIXEL_VARIANCE - self.fixed_px2
        if left_px2 > NOTHING_PX2:
            return math.sqrt(left_px2 / self.by_ratio)
        return None


def star_size(config: BenchConfig, folder: Path, display: Camera) -> StarSize:
    """The star of a bench whose monitor stands as `display` has it. Raises InputError."""
    tracker = tracker_camera(config.tracker, folder)
    limit = config.verify.star_sigma_ratio
    ratio = tracker.focal_length_px / display.focal_length_px
    sprite = display_psf(config, folder, display)
    lens = before_detector(config, folder, display).in_the_middle
    sky = tracker_psf(config.tracker, folder).in_the_middle
    blur_px = config.collimator.psf_sigma_px
    sprite_px2 = _variance_px2(sprite)
    # `lens` has the collimator's blur at this ratio.
    by_ratio = 2 * PIXEL_VARIANCE + blur_px**2
    fixed_px2 = _variance_px2(lens) - (blur_px * ratio) ** 2
    # A sprite that is the tracker's own PSF is as wide on the detector whatever the ratio.
    if config.render.psf == GAUSSIAN:
        by_ratio += sprite_px2
    else:
        fixed_px2 += sprite_px2 * ratio**2
    widths = _Widths(_variance_px2(sky), by_ratio, fixed_px2)
    shown = _shown_shares(sprite, lens, ratio)
    of_sky = _sky_shares(sky)
    sigma_ratio = widths.sigma_ratio(ratio)
    would_do = None
    if sigma_ratio > limit:
        would_do = _remedy(config, display, tracker, widths, limit)
    return StarSize(
        sigma_px=math.sqrt(widths.by_ratio * ratio**2 + widths.fixed_px2),
        sky_sigma_px=math.sqrt(widths.sky_px2),
        sigma_ratio=sigma_ratio,
        limit=limit,
        peak_loss_mag=float(magnitude(shown.peak / of_sky.peak)),
        shared_px=shown.shared_px,
        sky_shared_px=of_sky.shared_px,
        would_do=would_do,
    )


def _variance_px2(psf: Psf) -> float:
    """The mean variance along both axes."""
    x_px, y_px = psf.width_px
    return (x_px**2 + y_px**2) / 2


class _Shares(NamedTuple):
    """A star in the middle of a pixel: its brightest pixel's share, and over how many pixels its
    light is shared out.
    """

    peak: float
    shared_px: float


def _shown_shares(sprite: Psf, lens: Psf, ratio: float) -> _Shares:
    """Those of a star in the middle of a monitor pixel that lies in the middle of a tracker
    pixel, side by side.
    """
    if ratio > FINEST:
        coarser = ratio / FINEST
        wide, high = lens.width_px
        narrower = GaussianPsf((wide / coarser, high / coarser))
        shares = _shown_shares(sprite, narrower, FINEST)
        return _Shares(shares.peak / coarser**2, shares.shared_px * coarser**2)
    reach = sprite.footprint_px // 2 + 1
    pixels = np.arange(-reach, reach + 1)
    grid = np.meshgrid(pixels.astype(np.float64), pixels.astype(np.float64))
    weights = sprite.shares(*grid)
    lit = weights > UNSEEN_SHARE * weights.max()
    rows, columns = np.nonzero(lit)
    # Each lit monitor pixel is an even square of points.
    points, narrow = square_points(ratio, lens)
    right, down = np.meshgrid(points, points)
    x_px = ratio * (pixels[columns][:, None] + right.ravel()).ravel()
    y_px = ratio * (pixels[rows][:, None] + down.ravel()).ravel()
    light = np.repeat(weights[lit] / right.size, right.size)
    reach_px = np.abs(x_px).max(initial=0.0) + narrow.footprint_px / 2
    half = math.ceil(reach_px) + 1
    side = 2 * half + 1
    image = narrow.spread(x_px, y_px, light, (-half, -half, side, side))
    return _image_shares(image.astype(np.float64))


def _sky_shares(sky: Psf) -> _Shares:
    half = sky.footprint_px // 2 + 1
    pixels = np.arange(-half, half + 1, dtype=np.float64)
    return _image_shares(sky.shares(*np.meshgrid(pixels, pixels)))


def _image_shares(image: FloatArray) -> _Shares:
    image = image / image.sum()
    square_sum = float((image**2).sum())
    return _Shares(float(image.max()), 1 / square_sum)


def _remedy(
    config: BenchConfig, display: Camera, tracker: Camera, widths: _Widths, limit: float
) -> StarRemedy:
    """What would bring the star within the limit."""
    largest = widths.largest_ratio(limit)
    ratio = tracker.focal_length_px / display.focal_length_px
    pitch_um = config.monitor.pixel_pitch_um
    collimator_mm = display.focal_length_px * pitch_um / UM_PER_MM
    panels = tuple(_panel_option(*panel, tracker, widths, largest) for panel in PANELS)
    if largest is None:
        return StarRemedy(None, None, None, False, None, None, panels)
    longer = ratio / largest
    on_screen = _field_share(display, tracker, longer)
    now = _field_share(display, tracker, 1.0)
    wide, high = (math.ceil(size / largest) for size in tracker.resolution_px)
    return StarRemedy(
        tracker_px_a_monitor_px=largest,
        collimator_mm=collimator_mm * longer,
        field_on_screen=on_screen,
        field_fits=on_screen >= WHOLE * now,
        pixel_pitch_um=pitch_um / longer,
        resolution_px=(wide, high),
        panels=panels,
    )


def _field_share(display: Camera, tracker: Camera, longer: float) -> float:
    """The share of the tracker's field on the screen behind a collimator so many times as long."""
    share = 1.0
    for screen_px, field_px in zip(display.resolution_px, tracker.resolution_px, strict=True):
        # Half of each as a tangent.
        screen = screen_px / 2 / display.focal_length_px / longer
        field = field_px / 2 / tracker.focal_length_px
        share *= min(1.0, screen / field)
    return share


def _panel_option(
    name: str,
    inches: float,
    size_px: tuple[int, int],
    tracker: Camera,
    widths: _Widths,
    largest: float | None,
) -> PanelOption:
    pitch_mm = inches * MM_PER_INCH / math.hypot(*size_px)
    width, height = tracker.resolution_px
    # Where the tracker's field just fits on the screen.
    screen_px_a_tracker_px = min(size_px[0] / width, size_px[1] / height)
    longest_mm = screen_px_a_tracker_px * tracker.focal_length_px * pitch_mm
    lengths_mm = None
    if largest is not None:
        shortest_mm = tracker.focal_length_px * pitch_mm / largest
        if shortest_mm <= longest_mm:
            lengths_mm = (shortest_mm, longest_mm)
    sigma_ratio = widths.sigma_ratio(1 / screen_px_a_tracker_px)
    return PanelOption(name, size_px, pitch_mm * UM_PER_MM, lengths_mm, sigma_ratio)
