"""What the monitor cannot show of a star: light over its white, and light under its smallest step."""

from __future__ import annotations

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.monitor.footprints import FootprintMap
from hilstar.monitor.quantise import Panel
from hilstar.monitor.response import Codes
from hilstar.scene.sprites import Sprites
from hilstar.units import magnitude


def star_losses_mag(sprites: Sprites, panel: Panel, footprints: FootprintMap, levels: Codes) -> FloatArray:
    """How many magnitudes fainter than wanted each of n sprites is in `levels` (height, width), (n,).

    Infinite for a star that shows nothing, NaN for one all of whose pixels are brighter stars'. A pixel of several stars is
    that of the brightest in it, with the light of all; both fluxes are sums over a star's own.
    """
    found = footprints.find(sprites)
    output = np.ones(1) if panel.uniformity is None else np.append(panel.uniformity.ravel(), 1.0)
    # White in each pixel, and in the one that stands for those off the image.
    white = output[found.place if len(output) > 1 else np.zeros_like(found.place)] * panel.flux_at_white_e_per_s
    wanted = found.light.sum(axis=0, dtype=np.float64)
    level = np.append(levels.ravel(), levels.dtype.type(0))[found.place]
    shown = (panel.response.light[level] * white).sum(axis=0)
    with np.errstate(invalid="ignore"):
        return np.asarray(magnitude(shown / wanted))
