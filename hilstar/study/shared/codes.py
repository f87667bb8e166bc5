"""The ways from light to code values that studies compare, what they have to achieve, and the stars that they are timed on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hilstar.charts import BLUE, GREEN, ORANGE, PURPLE
from hilstar.monitor.phases import SIGMA_PX, WHITE
from hilstar.monitor.quantise import EXPOSURE_FRAMES, Quantisation
from hilstar.monitor.response import Response, Weights, bit_stealing_response, srgb_response
from hilstar.scene.psf import peak_share
from hilstar.scene.sprites import Sprites, pack_sprites
from hilstar.units import flux_ratio

BITS = (8, 10, 12)
# By bits: the largest flux error allowed, mag, and the magnitudes under white over which it is allowed.
AIMS = {8: (0.05, 6.0), 10: (0.02, 8.0), 12: (0.02, 8.0)}
AIM_PX = 0.01
# Rec. 709's shares of white stand in for the primaries as a tracker sees them.
STEALING_WEIGHTS: Weights = (0.2126, 0.7152, 0.0722)
FRAME_PX = (1920, 1080)
STARS = 1000
SEED = 1
STEALING = ", bit stealing"


@dataclass(frozen=True, slots=True)
class Way:
    """One way from light to levels: its name, the renderer's method, its colour, and in how many frames it is seen."""

    name: str
    method: Quantisation
    colour: str
    stealing: bool = False
    frames: int = 1


WAYS = (
    Way("round", "round", PURPLE),
    Way("dither", "dither", ORANGE),
    Way(f"temporal, mean of {EXPOSURE_FRAMES} frames", "temporal", GREEN, frames=EXPOSURE_FRAMES),
    Way("exact", "exact", BLUE),
    Way("round" + STEALING, "round", PURPLE, stealing=True),
    Way("exact" + STEALING, "exact", BLUE, stealing=True),
)


def response_of(bits: int, way: Way) -> Response:
    """The sRGB response of a way; with bit stealing, of three equal channels."""
    grey = srgb_response(bits)
    return bit_stealing_response((grey, grey, grey), STEALING_WEIGHTS) if way.stealing else grey


def star_field(frame_px: tuple[int, int], footprint_px: int) -> Sprites:
    """STARS sprites anywhere on the frame, over eight magnitudes, three times as many in each as in the one before."""
    rng = np.random.default_rng(SEED)
    mag = 2 * np.log10(1 + rng.uniform(size=STARS) * (10 ** (8 / 2) - 1))
    flux = WHITE / peak_share(SIGMA_PX) * flux_ratio(mag)
    x_px, y_px = rng.uniform(0, 1, (2, STARS)) * np.array(frame_px)[:, None]
    return pack_sprites(x_px, y_px, flux, np.arange(STARS), frame_px, footprint_px)
