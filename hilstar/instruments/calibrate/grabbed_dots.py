"""The tracker's images of planned dots, shown and taken one after another."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError
from hilstar.basics.files import make_directory
from hilstar.instruments.calibrate.first_light.context import HOT_FILL, darker_code
from hilstar.instruments.calibrate.first_light.focus import DOT_FILL
from hilstar.instruments.calibrate.first_light.image_sources import ImageSource, Pattern, black
from hilstar.instruments.calibrate.full_well import check_full_well
from hilstar.instruments.calibrate.geometric.dots import DotPlan, dot_image, read_plan
from hilstar.server.bench.bench_file import BenchFile
from hilstar.tracker.settings import DetectorSettings

IMAGES, DARK = "images", "dark"  # in the directory of a plan
FRAME = "frame_{:03}"


class DotImages(NamedTuple):
    """Images of a plan's dots in the order of its frames, and one of the black screen, if any."""

    images: list[Path]
    dark: Path | None


def grab_dots(
    file: BenchFile,
    source: ImageSource,
    plan: Path,
    exposure_s: float | None,
    *,
    overwrite: bool,
    tell: Callable[[str], None],
) -> DotImages:
    """Show each frame of the plan in the directory `plan` and take the tracker's image of it, in
    the brightest code whose dots do not saturate the tracker.

    The images stay in its `images`, which `calibrate geometric` takes, too. Raises InputError where
    some are there and not `overwrite`, where the source cannot set an exposure, NoImage, Stopped.
    """
    dots = read_plan(plan / "plan.csv")
    folder = plan / IMAGES
    if any(folder.glob("frame_*")) and not overwrite:
        raise InputError(
            f"{folder}: has images; give them in place of --grab, or add --overwrite to take them"
            " again"
        )
    exposure_s = exposure_of(file, source, exposure_s)
    make_directory(folder)

    def taken(pattern: Pattern) -> Path:
        return source.look(file, pattern, folder / pattern.name, exposure_s)

    tracker = file.config.tracker
    dark = taken(Pattern(DARK, black(file.config.monitor.resolution_px)))
    under = source.pixels(dark, tracker.resolution_px)
    code = 2**file.config.monitor.bits - 1
    images: list[Path] = []
    while len(images) < dots.frames:
        pattern = _dots_of(file, dots, len(images), code)
        path = taken(pattern)
        # Dots of all frames are alike: the first says which code is dark enough.
        if not images and is_too_bright(
            source.pixels(path, tracker.resolution_px), under, tracker.detector
        ):
            code = darker_code(code)
            tell(f"{pattern.name}: its dots saturate the tracker; code {code} in their place")
            continue
        images.append(path)
        tell(f"{pattern.name}: image {len(images)} of {dots.frames}")
    return DotImages(images, dark)


def exposure_of(file: BenchFile, source: ImageSource, exposure_s: float | None) -> float:
    """The exposure to ask a source for: the bench file's where none is given. Raises InputError for
    another than the source can set.
    """
    if exposure_s is None:
        return file.config.tracker.exposure_s
    if not source.sets_exposure:
        raise InputError("--exposure: --grab has no {exposure_s}; write where it takes it")
    return exposure_s


def _dots_of(file: BenchFile, dots: DotPlan, frame: int, code: int) -> Pattern:
    codes = dot_image(dots, frame, file.config.monitor.resolution_px, code)
    return Pattern(FRAME.format(frame), codes)


def is_too_bright(image: FloatArray, dark: FloatArray, detector: DetectorSettings) -> bool:
    """Whether dots in an image (h, w) are near the detector's saturation, hot pixels of the dark
    frame (h, w) apart. Raises InputError for an image that is cut off under it.
    """
    light = image[dark < HOT_FILL * detector.saturation_dn]
    peak_dn = float(light.max(initial=0.0))
    if peak_dn >= 2.0**detector.bits:
        # Images of more bits than the bench file's detector has are of another one: nothing is
        # known of its full well.
        return False
    check_full_well(light, dark, float(np.median(dark)), detector)
    return peak_dn >= DOT_FILL * detector.saturation_dn
