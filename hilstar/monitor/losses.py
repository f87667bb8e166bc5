"""What the monitor cannot show: stars under its smallest step of light, and stars over its white."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hilstar.arrays import FloatArray
from hilstar.monitor.footprints import FootprintMap
from hilstar.monitor.quantise import Panel
from hilstar.monitor.response import Codes
from hilstar.scene.clipping import CLIP_TOLERANCE
from hilstar.scene.sprites import Sprites
from hilstar.units import magnitude


@dataclass(frozen=True, slots=True)
class StarLosses:
    """For n sprites: fainter than half the smallest step, over white in a pixel, and the magnitudes lost.

    `loss_mag` is infinite for a star that shows nothing and NaN for one all of whose pixels are brighter stars'.
    """

    below_step: npt.NDArray[np.bool_]
    clipped: npt.NDArray[np.bool_]
    loss_mag: FloatArray


def star_losses(sprites: Sprites, panel: Panel, footprints: FootprintMap, levels: Codes | None = None) -> StarLosses:
    """What each sprite loses: at best on this panel, or in these `levels` (height, width).

    A pixel that several stars touch belongs to the brightest there, with the light of all; a star's fluxes are sums over its
    own pixels.
    """
    found = footprints.find(sprites)
    response = panel.response
    output = np.ones(1) if panel.uniformity is None else np.append(panel.uniformity.ravel(), 1.0)
    # White in each pixel, and in the one that stands for those off the image.
    white = output[found.place if len(output) > 1 else np.zeros_like(found.place)] * panel.flux_at_white_e_per_s
    wanted = found.light.sum(axis=0, dtype=np.float64)
    below_step = sprites.data["electrons_per_s"] < white[0] * response.light[1] / 2
    if levels is None:
        shown = np.where(below_step, 0.0, np.minimum(found.light, white).sum(axis=0))
    else:
        level = np.append(levels.ravel(), levels.dtype.type(0))[found.place]
        shown = (response.light[level] * white).sum(axis=0)
    clipped = np.any(found.light > white * (1 + CLIP_TOLERANCE), axis=0)
    with np.errstate(invalid="ignore"):
        loss_mag = magnitude(shown / wanted)
    return StarLosses(below_step, clipped, loss_mag)
