"""How sharp the tracker is while somebody turns its ring: a figure for each image, and the best so
far.

A figure is the PSF's sigma as the step `focus` fits it, of dots on the screen, so that the width of
a monitor pixel is not taken for blur. Three things look like focus and are not:

- A dot that saturates the detector looks wider than it is: dots are dimmed, and that image has no
  figure.
- A tracker that moves draws its stars out, all in one direction: an image whose stars are drawn out
  more than in the others is no best one.
- Far from focus no dot stands out: the image has no figure, and its line says so.
"""

import itertools
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError
from hilstar.instruments.calibrate.first_light.context import darker_code
from hilstar.instruments.calibrate.first_light.focus import (
    Sharpness,
    first_dots,
    seen_sharpness,
)
from hilstar.instruments.calibrate.first_light.image_sources import ImageSource, Pattern, black
from hilstar.instruments.calibrate.geometric.dots import dot_image
from hilstar.instruments.calibrate.geometric.geometry_fit import seen_screen_of
from hilstar.instruments.calibrate.grabbed_dots import is_too_bright
from hilstar.server.bench.bench_file import BenchFile

DARK, IMAGE = "dark", "focus_{:04}"
IMAGES_KEPT = 2  # images on the disk at a time: somebody turns the ring for an hour
SIGMAS_APART = 3.0  # by which a figure is worse than the best
STREAK_SIGMAS = 1.0  # of the PSF: a streak so long widens the fitted sigma by 2 %
STREAK_FACTOR = 1.5  # over the usual one: an astigmatic lens draws stars out in each image
WINDOW_SIGMAS = 3.0  # about a dot, for its second moments
BARS = "▁▂▃▄▅▆▇█"
CURVE_WIDTH = 40


@dataclass(frozen=True, slots=True)
class FocusFigure:
    """How sharp one image is: the PSF's sigma and its error, by so many dots, and how far its
    stars are drawn out and in which direction (degrees from x to y), tracker px.
    """

    psf_sigma_px: float
    error_px: float
    dots: int
    streak_px: float
    streak_deg: float


@dataclass(frozen=True, slots=True)
class FocusReading:
    """An image's number (from 1), when it came (s since the first), the code of its dots, and its
    figure; without one, `why` says what is wrong.
    """

    number: int
    t_s: float
    code: int
    figure: FocusFigure | None
    why: str = ""


@dataclass(slots=True)
class FocusCurve:
    """The readings so far, and the best of those that held still."""

    readings: list[FocusReading] = field(default_factory=list)
    best: FocusReading | None = None

    def add(self, reading: FocusReading) -> None:
        """Take a reading."""
        self.readings.append(reading)
        if reading.figure is None or self.is_drawn_out(reading.figure):
            return
        if self.best is None or reading.figure.psf_sigma_px < self._best_figure.psf_sigma_px:
            self.best = reading

    @property
    def figures(self) -> list[FocusFigure]:
        """The figures of the images that have one."""
        return [reading.figure for reading in self.readings if reading.figure is not None]

    @property
    def _best_figure(self) -> FocusFigure:
        assert self.best is not None and self.best.figure is not None
        return self.best.figure

    def is_drawn_out(self, figure: FocusFigure) -> bool:
        """Whether an image's stars are drawn out more than a lens does it in all images."""
        usual_px = float(np.median([other.streak_px for other in self.figures]))
        limit_px = max(STREAK_SIGMAS * figure.psf_sigma_px, STREAK_FACTOR * usual_px)
        return figure.streak_px > limit_px

    def is_worse(self, figure: FocusFigure) -> bool:
        """Whether an image is less sharp than the best one, beyond both errors."""
        if self.best is None:
            return False
        apart_px = figure.psf_sigma_px - self._best_figure.psf_sigma_px
        return apart_px > SIGMAS_APART * math.hypot(figure.error_px, self._best_figure.error_px)

    def why_none(self) -> str:
        """Why there is no best image."""
        if not self.readings:
            return "no image came"
        if self.figures:
            return "the tracker moved in each image; hold it still"
        return self.readings[-1].why

    def line(self) -> str:
        """The newest reading beside the best, as a person at the ring reads it."""
        reading = self.readings[-1]
        if reading.figure is None:
            return f"{reading.number:4}  {reading.why}"
        figure = reading.figure
        text = (
            f"{reading.number:4}  PSF sigma {figure.psf_sigma_px:.3f} +- {figure.error_px:.3f} px"
        )
        if self.is_drawn_out(figure):
            length = f"{figure.streak_px:.1f} px at {figure.streak_deg:.0f} deg"
            return f"{text}; stars are drawn out {length}: hold the tracker still"
        if self.best is None or self.best is reading:
            text = f"{text}, the best so far"
        elif self.is_worse(figure):
            ago_s = reading.t_s - self.best.t_s
            text = f"{text}, best {self._best_figure.psf_sigma_px:.3f} px {ago_s:.0f} s ago"
        else:
            text = f"{text}, as the best"
        sigmas_px = [other.psf_sigma_px for other in self.figures]
        return f"{text}  {sparkline(sigmas_px, SIGMAS_APART * figure.error_px)}"


def sparkline(values: list[float], least_span: float) -> str:
    """The last CURVE_WIDTH values as bars, the smallest the lowest; the highest bar is at least
    `least_span` above it, so that noise is no curve.
    """
    shown = np.array(values[-CURVE_WIDTH:])
    span = max(float(np.ptp(shown)), least_span)
    heights = np.rint((shown - shown.min()) / span * (len(BARS) - 1)).astype(int)
    return "".join(BARS[height] for height in heights)


def focus_readings(
    file: BenchFile, source: ImageSource, folder: Path, exposure_s: float
) -> Iterator[FocusReading]:
    """Show dots and measure image after image, without end.

    Raises InputError where the bench sees no dots or no code is dark enough, NoImage, and Stopped
    where the window is closed.
    """
    tracker = file.config.tracker
    seen_screen = seen_screen_of(file)
    plan = first_dots(seen_screen)
    screen_px = file.config.monitor.resolution_px
    dark_path = source.look(file, Pattern(DARK, black(screen_px)), folder / DARK, exposure_s)
    dark = source.pixels(dark_path, tracker.resolution_px)
    code = 2**file.config.monitor.bits - 1
    begin_s = time.monotonic()
    for number in itertools.count(1):
        name = IMAGE.format(number % IMAGES_KEPT)
        pattern = Pattern(name, dot_image(plan, 0, screen_px, code))
        path = source.look(file, pattern, folder / name, exposure_s)
        t_s = time.monotonic() - begin_s
        image = source.pixels(path, tracker.resolution_px)
        if is_too_bright(image, dark, tracker.detector):
            darker = darker_code(code)
            why = f"dots saturate the tracker: code {darker} in their place"
            yield FocusReading(number, t_s, code, None, why)
            code = darker
            continue
        light = image - dark
        try:
            sharp = seen_sharpness(light, seen_screen, tracker.detector)
        except InputError as error:
            yield FocusReading(number, t_s, code, None, str(error))
            continue
        yield FocusReading(number, t_s, code, figure_of(light, sharp))


def figure_of(image: FloatArray, sharp: Sharpness) -> FocusFigure:
    """The figure of an image (h, w) above its dark frame, in which these dots are."""
    length_px, angle_deg = streak(image, sharp)
    return FocusFigure(
        sharp.psf_sigma_px, sharp.psf_sigma_error_px, len(sharp.x_px), length_px, angle_deg
    )


def streak(image: FloatArray, sharp: Sharpness) -> tuple[float, float]:
    """How far dots are drawn out, px, and in which direction, degrees from x to y.

    By their light's second moments: those of a square, a pixel and a round PSF are the same in all
    directions, and an even motion over L px adds L^2 / 12 along it.
    """
    width_px = math.hypot(sharp.psf_sigma_px, sharp.dot_side_px / 2)
    half = math.ceil(WINDOW_SIGMAS * width_px)
    steps = np.arange(-half, half + 1)
    height, width = image.shape
    moments = np.zeros((2, 2))
    for x_px, y_px in zip(sharp.x_px, sharp.y_px, strict=True):
        column = round(x_px)
        row = round(y_px)
        if not (half <= column < width - half and half <= row < height - half):
            continue
        light = image[row - half : row + half + 1, column - half : column + half + 1]
        edge = np.concatenate([light[0], light[-1], light[:, 0], light[:, -1]])
        light = light - np.median(edge)
        off_x = steps[None, :] + column - x_px
        off_y = steps[:, None] + row - y_px
        xx = (light * off_x**2).sum()
        yy = (light * off_y**2).sum()
        xy = (light * off_x * off_y).sum()
        moments += np.array([[xx, xy], [xy, yy]]) / light.sum()
    moments /= len(sharp.x_px)
    variances, axes = np.linalg.eigh(moments)
    length_px = math.sqrt(12 * max(variances[1] - variances[0], 0.0))
    angle_deg = math.degrees(math.atan2(axes[1, 1], axes[0, 1])) % 180
    return length_px, angle_deg
