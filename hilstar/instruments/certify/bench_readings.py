"""What is read of a bench: light by code, dots, and neighbours' light; and the bench as its file
has it.

Who computes with readings needs no source of images: that is readings.py's.
"""

import math
from dataclasses import dataclass

import numpy as np

from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.display.calibration import load_calibration
from hilstar.display.response import Response
from hilstar.instruments.simulate.bench_geometry import BenchGeometry
from hilstar.server.bench.bench_file import BenchFile
from hilstar.server.bench.cameras import bench_camera, tracker_camera
from hilstar.server.bench.monitor import calibration_source, orientation_of


@dataclass(frozen=True, slots=True)
class BesideRatio:
    """Light of a pixel among lit ones of its code, relative to that of one alone: 1 where pixels
    leave each other's light as it is. `error` is one standard error.
    """

    ratio: float
    error: float

    @property
    def excess(self) -> float:
        """How far the ratio is from 1 beyond its noise, one sigma."""
        square = (self.ratio - 1) ** 2 - self.error**2
        return math.sqrt(max(square, 0.0))


@dataclass(frozen=True, slots=True)
class LightReadings:
    """Light (n,) of one monitor pixel at the middle of the screen, black included, e-/s, by code
    (n,), at t_s (n,).

    It may be the mean over a square of pixels, `square_px` (left, top, side). What several readings
    have in common, as the ratios of lattices, is in `common` (n, inputs), one sigma, e-/s. `noise`
    (n,) is each reading's noise, e-/s, up to a factor that their scatter tells; None where it goes
    with light. `beside` is None where no neighbouring pixels were read.
    """

    code: IntArray
    light: FloatArray
    t_s: FloatArray
    square_px: tuple[int, int, int] | None = None
    common: FloatArray | None = None
    noise: FloatArray | None = None
    beside: BesideRatio | None = None


@dataclass(frozen=True, slots=True)
class DotReadings:
    """Dots: places on the monitor and in the tracker's image (n,), px, and relative light (n,);
    `psf_px` is the PSF's sigma.
    """

    x_px: FloatArray
    y_px: FloatArray
    seen_x_px: FloatArray
    seen_y_px: FloatArray
    light: FloatArray
    psf_px: float = math.nan
    psf_u_px: float = 0.0


def geometry_of(file: BenchFile) -> BenchGeometry:
    """Monitor and tracker as a bench file has them."""
    return BenchGeometry(
        bench_camera(file.config, file.folder), tracker_camera(file.config.tracker, file.folder)
    )


def in_true_image(
    file: BenchFile, truth: BenchFile, x_px: FloatArray, y_px: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The pixels (n,) of the truth's image that are those of the bench file's, on one screen.

    A screen can be stated in several ways: flipped both ways it is turned by 180 degrees, and
    turned by nearly 45 degrees it may be taken for a quarter turn.
    """
    mine = file.config.monitor
    its = truth.config.monitor
    on_screen = orientation_of(mine).to_screen(x_px, y_px, mine.resolution_px)
    return orientation_of(its).to_image(*on_screen, its.resolution_px)


def grey_response(file: BenchFile) -> Response:
    """The response of greys, code by code, whatever the bench's quantisation."""
    monitor = file.config.monitor
    return load_calibration(calibration_source(monitor, file.folder), monitor.bits).response


def code_of_light(file: BenchFile, share: float) -> int:
    """The grey code of about a share of white's light."""
    return int(np.searchsorted(grey_response(file).light, share))
