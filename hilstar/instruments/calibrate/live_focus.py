"""How sharp the tracker is while somebody turns its ring: a figure for each image, or for the
answers of half a second, and the best so far.

A figure of an image is the PSF's sigma as the step `focus` fits it, of dots on the screen, so that
the width of a monitor pixel is not taken for blur. Three things look like focus and are not:

- A dot that saturates the detector looks wider than it is: dots are dimmed, and that image has no
  figure.
- A tracker that moves draws its stars out, all in one direction: an image whose stars are drawn out
  more than in the others is no best one.
- Far from focus no dot stands out: the image has no figure, and its line says so.

A figure of answers is the median of the widths that the tracker itself reports of a still sky's
stars, the width of a star on the display included: where it is smallest is the same.
"""

import itertools
import math
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError
from hilstar.basics.process.scheduling import HOST_CLOCK, HostClock
from hilstar.instruments.calibrate.first_light.context import darker_code
from hilstar.instruments.calibrate.first_light.focus import (
    Sharpness,
    first_dots,
    seen_sharpness,
)
from hilstar.instruments.calibrate.first_light.image_sources import (
    HANDED_ON_AGAIN_S,
    ImageSource,
    Pattern,
    PatternFrames,
    black,
)
from hilstar.instruments.calibrate.geometric.dots import dot_image
from hilstar.instruments.calibrate.geometric.geometry_fit import seen_screen_of
from hilstar.instruments.calibrate.grabbed_dots import is_too_bright
from hilstar.server.answers.answer import AnswerSource
from hilstar.server.answers.star_widths import AnswerWidths, FocusFigure, FocusReading
from hilstar.server.bench.bench_file import BenchFile
from hilstar.server.bench.build import open_bench

DARK, IMAGE, SKY = "dark", "focus_{:04}", "still sky"
SILENT_S = 30.0  # without an answer: a tracker may have to be started first
POLL_S = 0.02
SEE_ANSWERS = "look at `hilstar answers BENCH`"
NO_WIDTHS = (
    "the tracker's answers report no widths of stars; give --grab CMD in place of it, or add"
    " width_px to its centroids"
)
IMAGES_KEPT = 2  # images on the disk at a time: somebody turns the ring for an hour
WINDOW_SIGMAS = 3.0  # about a dot, for its second moments


def focus_readings(
    file: BenchFile,
    source: ImageSource,
    folder: Path,
    exposure_s: float,
    watch: Callable[[Pattern], None] | None = None,
) -> Iterator[FocusReading]:
    """Show dots and measure image after image, without end; `watch` sees each new pattern.

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
    watched = -1
    begin_s = time.monotonic()
    for number in itertools.count(1):
        name = IMAGE.format(number % IMAGES_KEPT)
        pattern = Pattern(name, dot_image(plan, 0, screen_px, code))
        if watch is not None and code != watched:
            watch(pattern)
            watched = code
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


def follow_answers(
    source: AnswerSource,
    hold: Callable[[Callable[[], bool]], None],
    take: Callable[[FocusReading], bool],
    stopped: Callable[[], bool],
    clock: HostClock = HOST_CLOCK,
) -> None:
    """Hand the readings of the widths that a tracker's answers report to `take`, until it returns
    true or the run is stopped; `hold` keeps a still sky on the display until what it is given is
    true.

    Raises InputError for a tracker that reports no widths, or that does not answer, and Stopped.
    """
    widths = AnswerWidths()
    silent = clock.within(SILENT_S)

    def is_over() -> bool:
        nonlocal silent
        over = stopped()
        for answer in source.take():
            silent = clock.within(SILENT_S)
            reading = widths.take(answer)
            over = over or (reading is not None and take(reading))
        return over or widths.reports_none or silent.over

    hold(is_over)
    if widths.reports_none:
        raise InputError(f"--answers: {NO_WIDTHS}")
    if silent.over and not stopped():
        trouble = source.trouble() or source.unread or "the line is silent"
        raise InputError(f"--answers: no answer in {SILENT_S:g} s: {trouble}; {SEE_ANSWERS}")


def headless_hold(
    frames: PatternFrames | None, file: BenchFile, pattern: Pattern
) -> Callable[[Callable[[], bool]], None]:
    """Holds a pattern without a window: it is handed on again and again to those who watch."""

    def hold(done: Callable[[], bool]) -> None:
        sent_s = -math.inf
        while not done():
            now_s = time.monotonic()
            if frames is not None and now_s - sent_s >= HANDED_ON_AGAIN_S:
                frames.send(file, pattern.codes, time.monotonic_ns())
                sent_s = now_s
            time.sleep(POLL_S)

    return hold


def still_sky(file: BenchFile, q_icrs_to_cam: FloatArray) -> Pattern:
    """The codes of the sky at an attitude (unit quaternion)."""
    with open_bench(file) as bench:
        levels = bench.draw(q_icrs_to_cam).levels
        return Pattern(SKY, np.array(bench.code_values(levels), dtype=np.uint16))


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
