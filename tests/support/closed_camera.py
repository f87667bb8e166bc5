"""A camera of first light in closed form: a screen of squares of light before a pinhole and a
Gaussian, without hilstar's drawing, lens or detector.

The bench is small and nowhere symmetric: neither screen nor detector is square, the screen ends
within the detector at the left and below and reaches beyond it elsewhere, and the lens's axis is
beside both middles.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.special import ndtr

from hilstar.basics.arrays import FloatArray
from hilstar.instruments.calibrate.first_light.context import StepContext
from hilstar.instruments.calibrate.first_light.image_sources import (
    CodeImage,
    ImageSource,
    Pattern,
    on_screen,
)
from hilstar.server.bench.bench_file import BenchFile, read_bench_file
from hilstar.server.bench.monitor import orientation_of
from tests.support.benches import Tables, bench_text

SCREEN_PX, DETECTOR_PX = (120, 96), (124, 92)
BITS, EXPOSURE_S = 10, 0.1
FULL_DN, OFFSET_DN, GAIN_E_PER_DN, READ_DN = 4095, 50.0, 4.0, 1.5
SIGMA_PX = 0.7
# places of the lens's axis on the detector and on the screen, px
AXIS_PX, SCREEN_AXIS_PX = (64.0, 43.0), (50.0, 55.0)
# focal lengths over pitches: 10 mm over 13 um, 40 mm over 57.65 um
RATIO = (10e3 / 13) / (40e3 / 57.65)
CLOSED: Tables = {
    "tracker": {
        "focal_length_mm": 10,
        "resolution_px": list(DETECTOR_PX),
        "principal_point_px": list(AXIS_PX),
        "psf_sigma_px": [SIGMA_PX, SIGMA_PX],
        "exposure_s": EXPOSURE_S,
    },
    "tracker.detector": {
        "bits": 12,
        "gain_e_per_dn": GAIN_E_PER_DN,
        "offset_dn": OFFSET_DN,
        "read_noise_e": READ_DN * GAIN_E_PER_DN,
        "dark_e_per_s": 0.0,
        "prnu": 0.0,
        "full_well_e": 100_000.0,
    },
    "monitor": {"resolution_px": list(SCREEN_PX), "bits": BITS},
    "collimator": {"focal_length_mm": 40, "principal_point_px": list(SCREEN_AXIS_PX)},
    "render": {"quantisation": "round", "flux_at_white_e_per_s": 80_000.0},
}


def power_of(exponent: float) -> FloatArray:
    """Light above black by code, relative to white."""
    white = 2**BITS - 1
    return (np.arange(white + 1) / white) ** exponent


def shares(detector_px: int, screen_px: int, axis_px: float, screen_axis_px: float) -> FloatArray:
    """Along one axis, the share of each of the screen's pixels in each of the detector's: a square
    of light by a Gaussian.
    """
    edges = np.arange(detector_px + 1)[:, None] - 0.5
    middles = axis_px + RATIO * (np.arange(screen_px) - screen_axis_px)

    def gathered(place: FloatArray) -> FloatArray:
        """The integral of the Gaussian's own integral."""
        u = place / SIGMA_PX
        return SIGMA_PX * (u * ndtr(u) + np.exp(-(u**2) / 2) / math.sqrt(2 * math.pi))

    half = RATIO / 2
    below = (gathered(edges - middles + half) - gathered(edges - middles - half)) / RATIO
    # far from a square both integrals are alike but for their rounding
    return np.maximum(np.diff(below, axis=0), 0.0)


ACROSS = shares(DETECTOR_PX[0], SCREEN_PX[0], AXIS_PX[0], SCREEN_AXIS_PX[0])
DOWN = shares(DETECTOR_PX[1], SCREEN_PX[1], AXIS_PX[1], SCREEN_AXIS_PX[1])


# shares of white's light of a screen's red, green and blue
PRIMARY_SHARES = np.array([0.25, 0.65, 0.10])


def upright(screen: CodeImage) -> CodeImage:
    """How a screen that stands as it should is seen."""
    return screen


@dataclass
class ClosedCamera(ImageSource):
    """Its screen's light by code, at white, of black, and against place; the clock of a warm-up.

    `white_dn_per_s` is the light of a pixel at white, all over the detector; `black` is relative to
    that. `at_time` is what white is at a time, s, `mounted` how a screen's rows and columns are
    seen. `taken` has what was looked at; with `saves` images are files that others read, too.
    """

    response: FloatArray = field(default_factory=lambda: power_of(2.2))
    white_dn_per_s: float = 20_000.0
    black: float = 0.0
    even: FloatArray | float = 1.0
    has_unlit: bool = True
    sets_exposure: bool = True
    at_time: Callable[[float], float] = lambda t_s: 1.0
    mounted: Callable[[CodeImage], CodeImage] = upright
    saves: bool = False
    now_s: float = 0.0
    taken: list[tuple[str, float]] = field(default_factory=list)
    images: dict[Path, FloatArray] = field(default_factory=dict)
    identity = "closed camera"

    def exposed(self, stem: Path, light: FloatArray, exposure_s: float) -> Path:
        """An image of the screen's light, relative to white, with noise, as an ADC reads it."""
        rng = np.random.default_rng(zlib.crc32(stem.name.encode()) + len(self.taken))
        self.taken.append((stem.name, exposure_s))
        mean_dn = DOWN @ light @ ACROSS.T * self.white_dn_per_s * exposure_s
        photons = rng.poisson(mean_dn * GAIN_E_PER_DN) / GAIN_E_PER_DN
        read_dn = rng.normal(OFFSET_DN, READ_DN, mean_dn.shape)
        path = stem.with_name(stem.name + ".png")
        image = np.clip(np.rint(photons + read_dn), 0, FULL_DN)
        if self.saves:
            Image.fromarray(image.astype(np.uint16)).save(path, compress_level=1)
        else:
            path.touch()
        self.images[path] = image
        return path

    def look(self, file: BenchFile, pattern: Pattern, stem: Path, exposure_s: float) -> Path:
        """The image of a pattern, of which the bench file says how it is turned for the screen."""
        light = np.mean([self.light_of(self.seen(file, codes)) for codes in pattern.frames], axis=0)
        return self.exposed(stem, light, exposure_s)

    def seen(self, file: BenchFile, codes: CodeImage) -> CodeImage:
        """Codes as the camera sees them."""
        return self.mounted(on_screen(codes, orientation_of(file.config.monitor)))

    def light_of(self, codes: CodeImage) -> FloatArray:
        """The light (h, w) of codes (h, w) or (h, w, 3), relative to white."""
        lit = self.response[codes]
        if codes.ndim == 3:
            lit = lit @ PRIMARY_SHARES
        return (lit * self.at_time(self.now_s) + self.black) * self.even

    def pixels(self, path: Path, resolution_px: tuple[int, int]) -> FloatArray:
        """The image that was taken."""
        assert self.images[path].shape == resolution_px[::-1]
        return self.images[path]

    def unlit(self, stem: Path) -> Path | None:
        """The detector alone."""
        if not self.has_unlit:
            return None
        return self.exposed(stem, np.zeros(SCREEN_PX[::-1]), EXPOSURE_S)

    def clock_ns(self) -> int:
        """The time of the screen."""
        return round(self.now_s * 1e9)

    def hold(self, file: BenchFile, pattern: Pattern, seconds: float) -> None:
        """Let seconds pass."""
        self.now_s += seconds


def closed_context(folder: Path, camera: ClosedCamera, *changes: Tables, **more) -> StepContext:
    """The context of a step before the camera, by a bench file in `folder`."""
    path = folder / "bench.toml"
    path.write_text(bench_text(CLOSED, *changes))
    patches = more.pop("patches", 0)
    known = more.pop("known", {})
    file = read_bench_file(path)
    return StepContext(file, folder, folder / "images", camera, known, {}, patches, **more)
