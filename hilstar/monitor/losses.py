"""What the monitor cannot show of a star: light over its white, and light under its smallest step."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.monitor.footprints import FootprintMap, PlaceArray
from hilstar.monitor.quantise import Panel
from hilstar.monitor.response import Codes
from hilstar.scene.sprites import Sprites
from hilstar.units import magnitude


def star_losses_mag(sprites: Sprites, panel: Panel, footprints: FootprintMap, levels: Codes) -> FloatArray:
    """How many magnitudes fainter than wanted each of n sprites is in `levels` (height, width), (n,).

    Infinite for a star that shows nothing, NaN for one of which no pixel is on the image. A pixel of several stars is that
    of the brightest in it, with the light of all; both fluxes are sums over a star's own. A star all of whose pixels are
    brighter stars' loses of its light what they do, pixel for pixel.
    """
    found = footprints.find(sprites)
    wanted = found.light.sum(axis=0, dtype=np.float64)
    shown = _shown(found.place, panel, levels).sum(axis=0)
    hidden = np.flatnonzero(wanted == 0)
    if len(hidden):
        whole = np.bincount(found.place.ravel(), found.light.ravel(), minlength=footprints.pixels + 1)
    for k in hidden.tolist():
        alone = footprints.find(replace(sprites, data=sprites.data[k : k + 1]))
        place, light = alone.place[:, 0], alone.light[:, 0].astype(np.float64)
        lit = light > 0
        wanted[k] = light.sum()
        shown[k] = (light[lit] * _shown(place[lit], panel, levels) / whole[place[lit]]).sum()
    with np.errstate(invalid="ignore"):
        return np.asarray(magnitude(shown / wanted))


def _shown(place: PlaceArray, panel: Panel, levels: Codes) -> FloatArray:
    """The light of `levels` at places in the flat image, electrons per second; none in the one past its end."""
    level = np.append(levels.ravel(), levels.dtype.type(0))[place]
    share = np.asarray(panel.response.light[level], dtype=np.float64)
    if panel.uniformity is not None:
        share = share * np.append(panel.uniformity.ravel(), 1.0)[place]
    return share * panel.flux_at_white_e_per_s
